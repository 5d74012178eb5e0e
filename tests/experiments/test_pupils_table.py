"""Passage rates: ours above the literature's, theirs as the theses say, nothing lost."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import pytest

from experiments import pupils as passage
from experiments.pupils import CASES, DRAWN, TABLE_5_3, Case

pytestmark = pytest.mark.filterwarnings("ignore::neurolens.base.errors.NeurolensWarning")
LENSES = Path(__file__).parents[2] / "lenses"
SAMPLES = 2**13


@cache
def measured(lens: str, f_number: float) -> passage.Passage:
    case = next(c for c in CASES if (c.lens, c.f_number) == (lens, f_number))
    return passage.measure(case, LENSES, SAMPLES)


@pytest.mark.parametrize(
    ("lens", "f_number", "goal"), [("muller_fisheye_100", 5.6, 0.97), ("brendel_tessar_100", 4.0, 0.99)]
)
def test_ours_passes_most_and_loses_nothing(lens: str, f_number: float, goal: float) -> None:
    found = measured(lens, f_number)
    ours = found.rates[passage.OURS]
    assert ours.passed >= goal
    assert ours.light == pytest.approx(1, abs=0.01) and found.lost < 1e-4
    assert all(rate.passed < ours.passed for name, rate in found.rates.items() if name != passage.OURS)
    assert 0 <= found.dark < 0.1


def test_tessar_through_the_rear_rim_is_steinerts() -> None:
    rates = measured("brendel_tessar_100", 4.0)
    for method in ("rear rim", "pixel disc"):
        assert 100 * rates.rates[method].passed == pytest.approx(rates.case.theirs[method], abs=3)


def test_every_case_is_a_lens_of_the_library_and_every_figure_a_method() -> None:
    for case in CASES:
        assert (LENSES / f"{case.lens}.toml").exists()
        assert set(case.theirs) <= set(passage.METHODS) and bool(case.theirs) == bool(case.source)
    assert len(DRAWN) == 3


def test_pixel_of_table_5_3() -> None:
    rows = list(passage.pixel_rates(LENSES, SAMPLES))
    assert [n for n, _, _ in rows] == list(TABLE_5_3)
    rates = [rate for _, rate, _ in rows]
    # Once vignetting is past, the rate goes with the area of the stop.
    for (n, rate), (m, later) in zip(
        list(zip(TABLE_5_3, rates, strict=True))[1:5], list(zip(TABLE_5_3, rates, strict=True))[2:6], strict=True
    ):
        assert later / rate == pytest.approx((n / m) ** 2, rel=0.1)


def test_a_lens_with_one_wavelength() -> None:
    """Without known dispersion the outline is for one wavelength."""
    case = Case("muller_fisheye_100", 14.0, 4.0)
    assert len(passage.camera_of(case, LENSES).film.outline.wavelength_nm) == 1
