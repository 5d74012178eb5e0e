"""Properties of tracing that hold for any lens at all; the same random lenses at every run."""

import math
from dataclasses import replace

import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as hs
from random_lenses import lenses
from shipped import turned

from experiments.extreme_cases import Case, disc, unit
from experiments.extremes import measure
from neurolens.base import status as st
from neurolens.optics.prescription import Lens
from neurolens.optics.trace import Rays, trace

SETTINGS = settings(
    max_examples=60,
    derandomize=True,
    deadline=None,
    suppress_health_check=[HealthCheck.too_slow, HealthCheck.filter_too_much],
)
RAYS = 96
WAVELENGTH_NM = 520.0


def bundle(lens: Lens, seed: int, towards: str, slope: float = 0.5) -> Rays:
    """Rays onto the whole first surface that they meet, and a little beyond its rim."""
    g = torch.Generator().manual_seed(seed)
    last = len(lens.surfaces) - 1
    first = lens.surfaces[0 if towards == "film" else last]
    x, y = disc(g, RAYS, 1.05 * first.semi_diameter_mm)
    sx, sy = disc(g, RAYS, slope)
    sense = 1.0 if towards == "film" else -1.0
    z = 0.0 if towards == "film" else float(lens.vertices_mm[last])
    d = unit(sx, sy, torch.full_like(sx, sense))
    return Rays(x - 12 * sx, y - 12 * sy, torch.full_like(x, z - 12 * sense), *d)


def results(lens: Lens, rays: Rays, towards: str = "film"):  # type: ignore[no-untyped-def]
    return trace(lens, rays, WAVELENGTH_NM, towards=towards, transmittance=True)  # type: ignore[arg-type]


@SETTINGS
@given(lenses(), hs.integers(0, 99), hs.sampled_from(["film", "scene"]))
def test_statuses_are_known_and_numbers_finite(lens: Lens, seed: int, towards: str) -> None:
    out = results(lens, bundle(lens, seed, towards, slope=3.0), towards)
    assert all(torch.isfinite(c).all() for c in (*out.rays, out.transmittance))
    assert ((out.transmittance >= 0) & (out.transmittance <= 1 + 1e-12)).all()
    surfaces = range(len(lens.surfaces))
    known = {0, *(st.blocked(k, reason) for k in surfaces for reason in (st.MISSED, st.RIM, st.TOTAL_REFLECTION))}
    assert set(out.status.tolist()) <= known


@SETTINGS
@given(lenses(), hs.integers(0, 99), hs.sampled_from(["film", "scene"]))
def test_precisions_and_50_digits_agree(lens: Lens, seed: int, towards: str) -> None:
    """No status differs away from an edge, between float32, float64 and 50 digits."""
    case = Case("", "", lens, bundle(lens, seed, towards), WAVELENGTH_NM, towards)  # type: ignore[arg-type]
    row = measure(case)
    assert (row.beyond, row.not_finite, row.exact_status) == (0, 0, 0)
    assert row.exact_mm < 1e-10


@SETTINGS
@given(lenses(), hs.integers(0, 99))
def test_the_way_back_is_the_way_there(lens: Lens, seed: int) -> None:
    start = bundle(lens, seed, "film", slope=0.2)
    out = results(lens, start)
    passed = out.status == st.PASSED
    there = Rays(*(c[passed] for c in out.rays))
    back = results(lens, Rays(*there[:3], -there.dx, -there.dy, -there.dz), "scene")
    again = back.status == st.PASSED
    assert (~again).sum() <= 1  # a ray may touch an edge
    for k in (0, 1):
        reach = (start.z[passed] - back.rays.z) / back.rays.dz
        found = back.rays[k] + reach * back.rays[3 + k]
        assert ((found - start[k][passed])[again].abs() < 1e-8).all()
    assert ((back.transmittance - out.transmittance[passed])[again].abs() < 1e-9).all()


@SETTINGS
@given(lenses(cylinders=False), hs.integers(0, 99), hs.floats(0, 6.3))
def test_lenses_without_cylinders_are_round(lens: Lens, seed: int, angle: float) -> None:
    start = bundle(lens, seed, "film")
    out, other = results(lens, start), results(lens, turned(start, angle))
    same = out.status == other.status
    assert (~same).sum() <= 1
    passed = same & (out.status == st.PASSED)
    for a, b in zip(other.rays, turned(out.rays, angle), strict=True):
        assert ((a - b)[passed].abs() < 1e-9).all()


@SETTINGS
@given(lenses(), hs.integers(0, 99), hs.sampled_from([0.125, 2.0, 64.0, 3.7]))
def test_angles_do_not_depend_on_size(lens: Lens, seed: int, factor: float) -> None:
    start = bundle(lens, seed, "film")
    big = Rays(*(factor * c for c in start[:3]), *start[3:])
    out, other = results(lens, start), results(lens.scaled(factor), big)
    same = out.status == other.status
    assert (~same).sum() <= 1
    passed = same & (out.status == st.PASSED)
    for k, (a, b) in enumerate(zip(out.rays, other.rays, strict=True)):
        assert ((a * (factor if k < 3 else 1) - b)[passed].abs() < 1e-9 * max(1.0, factor)).all()


@SETTINGS
@given(lenses(), hs.integers(0, 99))
def test_a_plane_without_glass_changes_nothing(lens: Lens, seed: int) -> None:
    """A wide window of nothing before the lens, and cutting a gap in two, leave every ray as it was."""
    start = bundle(lens, seed, "film")
    window = replace(lens.surfaces[0], radius_mm=math.inf, thickness_mm=1.0, diameter_mm=1e4, n_d=1.0, V_d=None)
    window = replace(window, conic=0.0, asphere=(), cylinder=None, stop=False)
    longer = replace(lens, surfaces=(window, *lens.surfaces))
    out, other = results(lens, start), results(longer, Rays(*start[:2], start.z + 1.0, *start[3:]))
    same = torch.where(out.status == 0, 0, out.status + 4) == other.status
    assert (~same).sum() <= 1
    passed = same & (out.status == st.PASSED)
    for a, b in zip(out.rays[:2] + out.rays[3:], other.rays[:2] + other.rays[3:], strict=True):
        assert ((a - b)[passed].abs() < 1e-10).all()
