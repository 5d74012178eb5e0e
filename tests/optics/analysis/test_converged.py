"""Figures that are integrals over the pupil: closed forms, dense sampling, and how far two samplings agree."""

import math
from pathlib import Path

import numpy as np
import pytest
import torch
from analysis_lenses import cartesian, grid, library
from shipped import whole
from test_bundles import D, moved

from neurolens.optics.analysis.bundles import Bundle, Filled, bundle
from neurolens.optics.analysis.fields import Scene
from neurolens.optics.analysis.spots import (
    mtf,
    mtf_over_height,
    spots,
    working_f_number,
)
from neurolens.optics.readers.lensfile import read_lens
from neurolens.optics.setting.pupil_nodes import LEVELS, lit_nodes, lit_part

FUJINON = Path(__file__).parents[2] / "data" / "fujinon_35.toml"
Tensor = torch.Tensor
BOX = torch.tensor([[-3.0, -3.0]], dtype=torch.float64)


def area(passes: object, level: int) -> float:
    part = lit_part(passes, BOX, -BOX, 0 * BOX)  # type: ignore[arg-type]
    nodes = lit_nodes(passes, part, level)  # type: ignore[arg-type]
    return float((nodes.area * passes(nodes.u, nodes.v)).sum())  # type: ignore[operator]


def test_area_of_two_discs_overlap_and_of_a_ring() -> None:
    """The vignetted pupil: 2 acos(d / 2) - d / 2 sqrt(4 - d^2) of unit discs d apart; its corners converge slowest."""

    def cats_eye(u: Tensor, v: Tensor) -> Tensor:
        return (u * u + v * v <= 1) & ((u - 1.2) ** 2 + v * v <= 1)

    wanted = 2 * math.acos(0.6) - 0.6 * math.sqrt(4 - 1.44)
    errors = [abs(area(cats_eye, level) / wanted - 1) for level in range(LEVELS)]
    assert errors[0] < 0.01 and errors[-1] < 2e-4
    assert area(lambda u, v: (u - 0.3) ** 2 + 4 * v * v <= 1, 0) == pytest.approx(math.pi / 2, rel=1e-4)
    # What is dark inside the outline is left out ray by ray: an annular pupil.
    assert area(lambda u, v: ((u * u + v * v) - 0.6).abs() <= 0.4, LEVELS - 1) == pytest.approx(0.8 * math.pi, rel=0.02)
    assert area(lambda u, v: u > 10, 0) == 0


def rms_um(rays: Bundle) -> float:
    weight = rays.weight / rays.weight.sum()
    places = [torch.nan_to_num(p) for p in (rays.tangential_mm, rays.sagittal_mm)]
    return 1000 * math.sqrt(sum(float((weight * (p - (weight * p).sum()) ** 2).sum()) for p in places))


@pytest.mark.parametrize(
    ("given", "field", "rel"), [("laikin", 24.0, 1e-3), *whole(("laikin", 12.0, 1e-3), ("fujinon", 16.5, 0.012))]
)
def test_spots_are_those_of_dense_sampling(given: str, field: float, rel: float) -> None:
    """90,000 rays and more. Sixteen rings gave 23.6 instead of 31.4 um for the Fujinon's steep aspheres."""
    lens = library("laikin_double_gauss_50") if given == "laikin" else Scene(read_lens(FUJINON))
    found, dense = spots(lens, [field], [D]), bundle(lens, [field], [D], grid(340 if given == "laikin" else 400))
    assert found.rms_um[0] == pytest.approx(rms_um(dense), rel=rel)
    assert found.passed[0] == pytest.approx(float(dense.weight.sum() / dense.open_weight.sum()), abs=6e-4)
    assert found.rms_um[0] == pytest.approx(found.rms_by_wavelength_um[0, 0])


def test_light_that_enters_the_stop_is_that_of_aimed_rays() -> None:
    """Filled from in front, against bundles that are aimed at points of the stop; a near object, and blades."""
    given = library("laikin_double_gauss_50", focus_m=1.0)
    aimed = bundle(given.open, [0.0, 15.0], [D], grid(80)).open_weight.sum((1, 2))
    filled = Filled(given, [0.0, 15.0], [D], to_stop=True).energy(2)
    assert filled.tolist() == pytest.approx(aimed.tolist(), rel=2e-3)


def hopkins(frequency: np.ndarray, waves: float, cut_off: float) -> np.ndarray:
    """MTF of a round pupil with some waves of defocus at its edge (Hopkins 1955), by a fine sum over the overlap."""
    found = []
    for f in frequency:
        s = 2 * f / cut_off  # shift of the two pupils in radii
        x = (np.arange(20000) + 0.5) / 20000 * (2 - s) - (1 - s / 2)
        y = np.sqrt(1 - (np.abs(x) + s / 2) ** 2)
        found.append(abs(np.sum(2 * y * np.exp(4j * np.pi * waves * s * x))) * (2 - s) / 20000 / np.pi)
    return np.array(found)


def test_geometric_mtf_is_that_of_diffraction_for_many_waves_of_defocus() -> None:
    given = cartesian(stop_mm=5.0)
    n = working_f_number(given, D)
    cut_off, waves = 1e6 / (D * n), 10.0
    f = np.linspace(0.002, 0.05, 7) * cut_off
    found = mtf(moved(given, waves * 8 * D * 1e-6 * n * n), [0.0], [D], frequency_per_mm=f)
    assert found.tangential[0] == pytest.approx(hopkins(f, waves, cut_off), abs=0.03)
    assert found.sagittal[0] == pytest.approx(found.tangential[0], abs=1e-3)


def test_mtf_over_height_is_mtf_at_its_fields() -> None:
    given = library("laikin_double_gauss_50")
    chart = mtf_over_height(given, frequency_per_mm=[40, 10], fields=5)
    assert chart.frequency_per_mm.tolist() == [10, 40] and chart.height_mm[-1] == pytest.approx(21.6, abs=1e-4)
    single = mtf(given, [chart.field_deg[2]], frequency_per_mm=[10, 40])
    assert chart.tangential[2] == pytest.approx(single.tangential[0], abs=1e-3)
    assert chart.sagittal[2] == pytest.approx(single.sagittal[0], abs=1e-3)
