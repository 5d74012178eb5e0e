"""Which edge of the field an analysis reached, and that text, JSON and pictures say so."""

import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from analysis_lenses import INF, library, scene
from command_line import run_json
from shipped import whole

from neurolens.cli import main
from neurolens.optics.analysis import plots
from neurolens.optics.analysis.field_curves import distortion, illumination
from neurolens.optics.analysis.fields import Scene
from neurolens.optics.lens.prescription import Lens, Surface
from neurolens.optics.readers.any_format import read_any
from neurolens.optics.readers.lensfile import write_lens
from neurolens.optics.setting.states import set_lens

FUJINON = Path(__file__).parents[2] / "data" / "fujinon_35.toml"
CASE = Path(__file__).parents[4] / "shared" / "data" / "cases" / "04_field_cut_xf35.zmx"


@pytest.mark.parametrize("file", [FUJINON, *whole(CASE)])
def test_a_lens_of_steep_aspheres_reaches_the_edge_of_its_film(file: Path) -> None:
    """Case 04: r^20 aspheres. ray-optics 0.9.8 has 20 degrees at 12.1875 mm and 22 degrees at 13.3284 mm."""
    if not file.exists():
        pytest.skip(f"{file} is not here")
    given = Scene(read_any(file))
    assert given.chief_rays([20.0, 22.0]).height_mm.tolist() == pytest.approx([12.1875, 13.3284], abs=6e-5)
    edge = given.edge
    assert edge.reached and edge.warning is None and edge.name == "the edge of the film, 14.2 mm"
    assert edge.height_mm == pytest.approx(14.2, abs=1e-6) and edge.field_deg == pytest.approx(23.58, abs=0.015)
    found = distortion(given)
    assert found.edge_percent == pytest.approx(-7.9, abs=0.06) and found.edge == edge.name
    passed = illumination(given, fields=5).passed
    assert (passed <= 1 + 1e-3).all() and passed[-1] < 0.6  # "rims pass 171.5%" once


@pytest.mark.parametrize(("name", "field"), [("isshiki_fisheye_10", 135.0), ("shimizu_fisheye_220", 110.0)])
def test_the_stated_half_field_is_the_edge_where_no_film_is_stated(name: str, field: float) -> None:
    given = library(name)
    edge = replace(given, lens=replace(given.lens, half_field_deg=field)).edge
    assert edge.reached and edge.field_deg == pytest.approx(field, abs=1e-9) and "stated half field" in edge.name


def test_the_edge_of_the_film_counts_before_a_stated_field_and_beyond_90_degrees() -> None:
    given = library("mizuguchi_fisheye_10")
    assert given.edge.field_deg > 90.5 and given.edge.height_mm == pytest.approx(14.175, abs=1e-6)
    lens = replace(given.lens, half_field_deg=None)
    assert Scene(lens).edge == given.edge and Scene(lens).wide


def blind() -> Lens:
    """A plane front and a film that is wider than the image of the half space before it."""
    rows = (Surface(INF, 5.0, 40.0, 1.5), Surface(INF, 20.0, 8.0, 1.5, stop=True), Surface(-30.0, 60.0, 40.0))
    return replace(Lens("Window", "test", rows, 8.0, image_radius_mm=200.0), film_z_mm=85.0)


def test_a_field_that_was_not_reached_is_a_warning_everywhere(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    edge = Scene(blind()).edge
    assert not edge.reached and 89 < edge.field_deg < 90 and edge.height_mm < 150
    warning = "no chief ray comes from the edge of the film, 200 mm"
    assert edge.warning is not None and warning in edge.warning
    path = tmp_path / "window.toml"
    write_lens(blind(), path)
    data = run_json(capsys, "analyse", path, "distortion")
    assert data["edge"]["reached"] is False and any(warning in w for w in data["warnings"])
    made: list[Any] = []
    new_figure = plots.new_figure
    monkeypatch.setattr(plots, "new_figure", lambda *s: made.append(new_figure(*s)) or made[-1])
    assert main(["analyse", str(path), "distortion", "-o", str(tmp_path / "pictures")]) == 0
    assert f"Warning: {warning}; fields end at" in capsys.readouterr().out
    (figure,) = made
    assert any("no chief ray comes" in t.get_text() for t in figure.findobj(lambda a: hasattr(a, "get_text")))


def test_other_light_is_analysed_at_its_own_wavelengths() -> None:
    """A lens for 1.55 um; its glass disperses, so that the d line would be another focal length."""
    rows = (Surface(INF, 0.0, 4.0, stop=True), Surface(20.0, 3.0, 10.0, 1.5168, 64.17), Surface(-20.0, 18.0, 10.0))
    lens = set_lens(Lens("ir", "", rows, 5.0, half_field_deg=3.0, wavelengths_nm=(1550.0, 1500.0, 1600.0)))
    given = Scene(lens)
    assert given.waves_nm == (1550.0, 1500.0, 1600.0)
    here, visible = (float(given.chief_rays([2.0], nm).height_mm[0]) for nm in (None, 587.5618))
    assert here == pytest.approx(float(given.chief_rays([2.0], 1550.0).height_mm[0])) and abs(here - visible) > 1e-4
    assert distortion(given).wavelength_nm == 1550.0
    json.dumps(given.edge.to_dict())
    assert scene([*rows]).waves_nm[0] == pytest.approx(587.56, abs=0.01) and math.isfinite(given.edge.field_deg)
