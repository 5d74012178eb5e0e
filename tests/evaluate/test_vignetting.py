"""Vignetting errors: a hole has closed forms; a real lens must agree with itself."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from vignetting_oracle import vignetting_errors

from neurolens.base import status as st
from neurolens.evaluate.vignetting import deciding_rim_ratio, relative_illumination
from neurolens.optics.lensfile import read_lens
from neurolens.optics.prescription import Lens, Surface
from neurolens.optics.pupils import PupilBounds
from neurolens.surrogates.domain import Domain, FilmRays, domain_of, sample_domain
from neurolens.surrogates.pairs import trace_pairs

LENSES = Path(__file__).parents[2] / "lenses"
FILM_Z, FILM_RADIUS = 50.0, 15.0


def hole(radius_mm: float) -> tuple[Lens, Domain]:
    """A hole in an opaque plane, its rays sampled on that plane to 1.05 radii."""
    lens = Lens("hole", "test", (Surface(math.inf, FILM_Z, 2 * radius_mm, stop=True),), 2.5)
    row = (radius_mm, radius_mm)
    bounds = PupilBounds(0.0, FILM_RADIUS, (-radius_mm, -radius_mm), row, row, radius_mm)
    planes, focus, nanometres = (FILM_Z, FILM_Z), (math.inf, math.inf), (500.0, 600.0)
    return lens, Domain(FILM_RADIUS, planes, focus, 0.0, 1.05 * radius_mm, nanometres, radius_mm, bounds)


def opening(
    factor: float, transmittance: float = 1.0, beyond_mm: float = 0.0
) -> Callable[[FilmRays, float | None], SimpleNamespace]:
    """A model of the hole whose radius is wrong by `factor` for film points beyond `beyond_mm`."""

    def predict(rays: FilmRays, stop_radius_mm: float | None) -> SimpleNamespace:
        assert stop_radius_mm is not None
        wrong = torch.hypot(rays.film_x, rays.film_y) >= beyond_mm
        limit = stop_radius_mm * torch.where(wrong, factor, 1.0)
        passes = torch.hypot(rays.pupil_x, rays.pupil_y) <= limit
        status = torch.where(passes, st.PASSED, st.blocked(0, st.RIM))
        return SimpleNamespace(status=status, transmittance=torch.full_like(rays.film_x, transmittance))

    return predict


def stopped_down(lens: Lens, domain: Domain, predict: Any, count: int) -> list[dict[str, Any]]:
    """At full aperture, and closed by two and by four stops."""
    radii = [domain.stop_radius_mm / 2 ** (closed / 2) for closed in (0, 2, 4)]
    return [vignetting_errors(lens, domain, predict, stop_radius_mm=r, count=count) for r in radii]


@pytest.mark.parametrize(
    ("factor", "wrong", "share", "near_rim"),
    [
        (1.0, "false_pass", 0.0, 0.0),
        # Too large, it passes the ring; too small, it blocks it.
        (1.01, "false_pass", (1.01**2 - 1) / 1.01**2, (1.01**2 - 1) / (1.01**2 - 0.98**2)),
        (0.99, "false_block", 1 - 0.99**2, (1 - 0.99**2) / (1 - 0.98**2)),
    ],
)
def test_false_shares_of_a_hole(factor: float, wrong: str, share: float, near_rim: float) -> None:
    result = vignetting_errors(*hole(10.0), opening(factor), count=131072)
    assert result[wrong] == pytest.approx(share, rel=0.02)
    assert result[f"{wrong}_near_rim"] == pytest.approx(near_rim, rel=0.02)
    assert result["false_block" if wrong == "false_pass" else "false_pass"] == 0
    assert result["passing_share"] == pytest.approx(1 / 1.05**2, rel=2e-3)


def test_stopping_down_keeps_the_shares_of_a_hole() -> None:
    lens, domain = hole(10.0)
    results = stopped_down(lens, domain, opening(1.01), count=262144)
    assert [result["stop_radius_mm"] for result in results] == pytest.approx([10, 5, 2.5])
    for result in results:
        assert result["false_pass"] == pytest.approx((1.01**2 - 1) / 1.01**2, rel=0.05)


def test_zones_tell_where_on_the_film() -> None:
    zones = vignetting_errors(*hole(10.0), opening(1.01, beyond_mm=FILM_RADIUS * 2 / 3), count=65536)["zones"]
    assert zones["centre"]["false_pass"] == zones["mid"]["false_pass"] == 0
    assert zones["edge"]["false_pass"] == pytest.approx((1.01**2 - 1) / 1.01**2, rel=0.05)


def test_illumination_of_a_small_hole_is_cos4() -> None:
    result = relative_illumination(*hole(0.2), opening(1.0, 0.9), points=4096, rows=9)
    expected = [math.cos(math.atan2(r, FILM_Z)) ** 4 for r in result.film_radius_mm]
    assert result.exact == pytest.approx(expected, rel=1e-4)
    assert result.model == pytest.approx([0.9 * e for e in expected], rel=1e-4)
    assert result.max_difference == pytest.approx(0.1, rel=1e-4)
    assert result.film_radius_mm[-1] == FILM_RADIUS


def test_the_deciding_rim_agrees_with_the_tracer() -> None:
    lens = read_lens(LENSES / "laikin_double_gauss_50.toml").at()
    domain = domain_of(lens)
    rays = trace_pairs(lens, sample_domain(domain, 20000, 1), domain.pupil_z_mm)
    ratio = deciding_rim_ratio(lens, rays)
    passed, by_rim = rays.status == st.PASSED, rays.status % 4 == st.RIM
    assert bool((ratio[passed] <= 1).all())
    assert bool((ratio[by_rim] > 1).all())
    assert int(by_rim.sum()) > 1000


def test_a_real_lens_against_itself_stopped_down() -> None:
    lens = read_lens(LENSES / "laikin_double_gauss_50.toml").at()
    domain = domain_of(lens)

    def exactly(rays: FilmRays, stop_radius_mm: float | None) -> SimpleNamespace:
        assert stop_radius_mm is not None
        traced = trace_pairs(lens.with_stop_radius(stop_radius_mm), rays, domain.pupil_z_mm)
        return SimpleNamespace(status=traced.status, transmittance=traced.transmittance)

    for result in stopped_down(lens, domain, exactly, count=32768):
        assert result["false_pass"] == result["false_block"] == 0
    light = relative_illumination(lens, domain, exactly, points=2048, rows=5)
    assert light.max_difference == 0
    assert light.exact[0] == 1 and light.exact[-1] < 0.5  # a fast double Gauss darkens by over a stop in the corner
