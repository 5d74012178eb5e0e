"""The medium after a surface: from the catalogue, else from n_d and V_d; absorption; and what a lens file states."""

from __future__ import annotations

import math
import warnings
from pathlib import Path

import pytest
import torch

from neurolens.base.errors import InputError, NeurolensWarning
from neurolens.optics import catalogue
from neurolens.optics.glass import (
    LINE_C_NM,
    LINE_D_NM,
    LINE_F_NM,
    absorption_of,
    check_against_table,
    index_at,
    index_of,
    table_notes,
)
from neurolens.optics.lensfile import read_lens
from neurolens.optics.prescription import Surface

LENS = """schema = 1
name = "a singlet"
source = "test"
f_number = 4
rims = "source"
surfaces = [
  {{ radius_mm = 50.0, thickness_mm = 5.0, diameter_mm = 20.0, {medium} }},
  {{ radius_mm = -50.0, thickness_mm = 1.0, diameter_mm = 20.0 }},
  {{ radius_mm = inf, thickness_mm = 45.0, diameter_mm = 10.0, stop = true }},
]
"""


def surface(**medium: object) -> Surface:
    return Surface(50.0, 5.0, 20.0, **medium)  # type: ignore[arg-type]


@pytest.mark.parametrize(("n_d", "V_d"), [(1.5168, 64.17), (1.7847, 25.7), (1.9, 20.0), (1.4338, 95.2)])
def test_index_and_abbe_number_come_back(n_d: float, V_d: float) -> None:
    assert index_at(n_d, V_d, LINE_D_NM) == pytest.approx(n_d, rel=1e-15)
    spread = index_at(n_d, V_d, LINE_F_NM) - index_at(n_d, V_d, LINE_C_NM)
    assert (n_d - 1) / spread == pytest.approx(V_d, rel=1e-12)
    wavelength = torch.linspace(380, 780, 100, dtype=torch.float64)
    n = index_at(n_d, V_d, wavelength)
    assert (n[1:] < n[:-1]).all() and (n > 1).all()


def test_unknown_dispersion_is_constant() -> None:
    assert index_at(1.6, None, 400.0) == index_at(1.6, None, 700.0) == 1.6


def test_cauchy_is_near_the_catalogue_glass() -> None:
    """N-BK7 by Sellmeier's equation (Schott catalogue) at the ends of the visible: within 0.001."""
    b, c = (1.03961212, 0.231792344, 1.01046945), (0.00600069867, 0.0200179144, 103.560653)
    for wavelength in (404.66, 486.13, 706.52):
        square = (wavelength / 1000) ** 2
        catalogued = (1 + sum(p * square / (square - q) for p, q in zip(b, c, strict=True))) ** 0.5
        assert index_at(1.5168, 64.17, wavelength) == pytest.approx(catalogued, abs=1e-3)
        assert index_of(surface(glass="N-BK7"), wavelength) == pytest.approx(catalogued, abs=1e-14)


def test_the_catalogue_rules_over_the_stated_index() -> None:
    assert index_of(surface(n_d=1.6, V_d=50.0), LINE_D_NM) == pytest.approx(1.6)
    assert index_of(surface(n_d=1.6), 450.0) == 1.6
    assert index_of(surface(n_d=1.6, V_d=50.0, glass="N-BK7"), LINE_D_NM) == pytest.approx(1.5168, abs=1e-6)
    assert index_of(surface(), 450.0) == 1.0
    with pytest.raises(InputError, match="N-BK7"):
        index_of(surface(glass="N-BK77"), 500.0)


def test_absorption_of_glass_and_of_a_grey_filter_add_up() -> None:
    assert absorption_of(surface(), 500.0) is None
    assert absorption_of(surface(n_d=1.5, V_d=60.0), 500.0) is None
    assert absorption_of(surface(n_d=1.5, absorption_per_mm=0.1), 500.0) == 0.1
    glass = absorption_of(surface(glass="N-BK7"), 500.0)
    assert absorption_of(surface(glass="N-BK7", absorption_per_mm=0.1), 500.0) == pytest.approx(0.1 + glass)
    # The source gives no absorption for plastics.
    assert absorption_of(surface(glass="PMMA"), 500.0) is None
    assert absorption_of(surface(glass="PMMA", absorption_per_mm=0.1), 500.0) == 0.1


def test_a_contradiction_warns_and_names_a_namesake_that_agrees() -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_against_table(surface(n_d=1.517, V_d=64.2, glass="N-BK7"), "a.toml", "surface 3, ")
        check_against_table(surface(n_d=1.517, V_d=64.2), "a.toml", "surface 3, ")
        check_against_table(surface(glass="N-BK7"), "a.toml", "surface 3, ")
    with pytest.warns(NeurolensWarning, match=r"a\.toml: surface 3, n_d = 1\.5185 is stated.*1\.5168"):
        check_against_table(surface(n_d=1.5185, V_d=64.2, glass="N-BK7"), "a.toml", "surface 3, ")
    with pytest.warns(NeurolensWarning, match=r"surface 3, V_d = 63 is stated"):
        check_against_table(surface(n_d=1.5168, V_d=63.0, glass="N-BK7"), "a.toml", "surface 3, ")
    # F2 of Schott is 1.6200, 36.4; CDGM's is 1.6129, 37.0.
    with pytest.warns(NeurolensWarning, match=r"CDGM:F2 would agree"):
        check_against_table(surface(n_d=1.6129, V_d=37.0, glass="F2"), "a.toml", "surface 3, ")


def test_a_formula_that_does_not_reach_over_the_visible_warns() -> None:
    with pytest.warns(NeurolensWarning, match=r"generic:PMMA is stated for 420-1620 nm"):
        check_against_table(surface(glass="PMMA"), "a.toml", "")
    assert any("one term" in note for note in table_notes(surface(glass="Zeonex E48R")))


def test_a_lens_file_names_its_glass(tmp_path: Path) -> None:
    path = tmp_path / "lens.toml"
    path.write_text(LENS.format(medium='glass = "n bk7"'))
    assert read_lens(path).surfaces[0].n_d == pytest.approx(1.5168, abs=1e-6)
    path.write_text(LENS.format(medium='n_d = 1.7, V_d = 64.17, glass = "n bk7"'))
    with pytest.warns(NeurolensWarning, match=r"surface 0, n_d = 1\.7 is stated, but Schott:N-BK7"):
        read_lens(path)
    path.write_text(LENS.format(medium='glass = "N-BK77"'))
    with pytest.raises(InputError, match=r"surface 0, glass: got 'N-BK77', expected .*N-BK7 \(Schott\)"):
        read_lens(path)


@pytest.mark.parametrize("name", ["N-BK7", "TAFD30"])
def test_index_and_absorption_compile_to_the_same_figures(name: str) -> None:
    row = surface(glass=name, absorption_per_mm=0.01)
    wavelength = torch.linspace(380, 780, 101)
    eager = index_of(row, wavelength), absorption_of(row, wavelength)
    compiled = torch.compile(lambda w: (index_of(row, w), absorption_of(row, w)), backend="eager", fullgraph=True)
    for a, b in zip(eager, compiled(wavelength), strict=True):
        torch.testing.assert_close(a, b, rtol=1e-6, atol=1e-9)


def test_wavelengths_that_are_none_give_an_index_that_is_none() -> None:
    for name in ("N-BK7", "TAFD30"):
        n = index_of(surface(glass=name), torch.tensor([500.0, math.nan]))
        assert torch.isfinite(n[0]) and torch.isnan(n[1])
        assert math.isnan(catalogue.find(name).index(math.nan))
    # Just beyond the pole at 264 nm, where the square of the index is negative.
    assert math.isnan(catalogue.find("N-SF66").index(262.0))
