"""Plots: whole PNG files with something on them, geometry of the lens section, scales, bad input."""

import math
from dataclasses import replace
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest

from neurolens.base.errors import InputError
from neurolens.optics.analysis.layout import Layout, Line, Section
from neurolens.optics.analysis.plots import drawing
from neurolens.studies import plots, scenes
from neurolens.studies.rays import Illumination


def biconvex(**changes: Any) -> Layout:
    front, back = Section(0.0, 50.0, 12.0, 1.5168), Section(6.0, -50.0, 11.0, 1.0)
    stop = Section(9.0, math.inf, 5.0, 1.0, stop=True)
    rays = [Line(np.array([[-20, y], [0, y], [6, 0.9 * y], [55, 0]]), f"{10 * k}°", k) for k in (0, 1) for y in (-4, 4)]
    return replace(Layout((front, back, stop), tuple(rays), 55.0, 20.0, "y", "B", ""), **changes)


@pytest.mark.parametrize(("radius", "h"), [(50.0, 12.0), (-30.0, 29.9), (math.inf, 7.0), (10.0, 10.0)])
def test_an_arc_lies_on_its_sphere_up_to_the_rim(radius: float, h: float) -> None:
    points = Section(3.0, radius, h, 1.0).arc()
    assert points[0, 1] == pytest.approx(-h) and points[-1, 1] == pytest.approx(h)
    if math.isfinite(radius):
        assert np.hypot(points[:, 0] - 3.0 - radius, points[:, 1]) == pytest.approx(abs(radius))
        assert (np.sign(points[0, 0] - 3.0)) == np.sign(radius)
    else:
        assert points[:, 0] == pytest.approx(3.0)


@pytest.mark.parametrize("semi_diameter_mm", [0.0, -1.0, math.inf, math.nan])
def test_a_surface_without_extent_is_refused(semi_diameter_mm: float) -> None:
    with pytest.raises(InputError, match="surface 0, semi_diameter_mm"):
        biconvex(surfaces=(Section(0.0, 5.0, semi_diameter_mm, 1.0),))


def test_bad_images_are_refused(tmp_path: Path) -> None:
    picture, path = np.ones((4, 6, 3)), tmp_path / "x.png"
    with pytest.raises(InputError, match="finite"):
        scenes.side_by_side({"a": math.nan * picture}, {}, path)
    for bad in ({}, {"ols": Illumination([0.0, 10.0], [1.0, math.nan], [1.0, 0.8], 0.0)}):
        with pytest.raises(InputError, match="illumination"):
            plots.illumination_plot(bad, path)
    assert not list(tmp_path.iterdir())


def test_any_name_of_a_lens_makes_a_picture_that_is_xml(tmp_path: Path) -> None:
    with drawing(tmp_path / "a.svg", 3, 2, "a\x01b", "c\x08d\ue000") as figure:
        figure.subplots().set_xlabel("e\x0cf")
    ElementTree.parse(tmp_path / "a.svg")
