"""Properties of tracing that hold for any lens at all, random ones that could be built; the same at every run."""

import math
from dataclasses import replace
from typing import Any

import torch
from hypothesis import HealthCheck, given, settings, strategies as hs
from shipped import WHOLE, turned

from experiments.accuracy.extreme_cases import Case, disc, unit
from experiments.accuracy.extremes import measure
from neurolens.base import status as st
from neurolens.optics.lens.figures import SPHERE, Cylinder
from neurolens.optics.lens.prescription import Lens, Surface
from neurolens.optics.trace.rays import Rays, trace
from neurolens.optics.trace.shapes import sag_mm

RIM_MM = 10.0


def numbers(low: float, high: float) -> hs.SearchStrategy[float]:
    return hs.floats(low, high, allow_nan=False, width=64)


@hs.composite
def surfaces(draw: Any, cylinders: bool = True) -> Surface:
    """A surface of semi-diameter 6 to 10 mm, its radius from just above that to a plane; medium and gap come later."""
    rim = draw(numbers(6.0, RIM_MM))
    kind = draw(hs.sampled_from(["sphere", "sphere", "plane", "conic", "asphere"] + ["cylinder"] * cylinders))
    if kind == "plane":
        return Surface(math.inf, 0.0, 2 * rim)
    ratio = draw(hs.sampled_from([1.001, 1.05]) | numbers(1.2, 4.0) | numbers(4.0, 1e4))
    radius = draw(hs.sampled_from([1, -1])) * rim * ratio
    surface = Surface(radius, 0.0, 2 * rim)
    if kind == "sphere":
        return surface
    if kind == "cylinder":
        return replace(surface, figure=Cylinder(cylinder=draw(hs.sampled_from(["x", "y"]))))
    # 1 - (1 + K) (h / R)^2 stays positive to the rim.
    conic = draw(numbers(-4.0, 0.8 * (ratio * ratio - 1)).filter(lambda k: k < 20)) if ratio > 1.1 else -0.5
    surface = replace(surface, figure=replace(surface.figure, conic=conic))
    if kind == "conic":
        return surface
    powers = draw(hs.sets(hs.sampled_from([2, 3, 4, 5, 6, 8, 10]), min_size=1, max_size=3))
    share = {2: 0.02, 3: 0.02}
    terms = tuple((p, draw(numbers(-1, 1)) * share.get(p, 0.01) * rim / rim**p) for p in sorted(powers))
    return replace(surface, figure=replace(surface.figure, asphere=terms))


@hs.composite
def lenses(draw: Any, cylinders: bool = True) -> Lens:
    """One to four elements, some cemented, with a stop behind one of them, film not set."""
    rows: list[Surface] = []
    for _ in range(draw(hs.integers(1, 4))):
        for _ in range(draw(hs.integers(1, 2))):
            index = draw(numbers(1.35, 2.0) | hs.just(1.6) | hs.just(1.6 + 1e-6))
            rows.append(replace(draw(surfaces(cylinders)), n_d=index, V_d=draw(hs.just(None) | numbers(20, 80))))
        rows.append(draw(surfaces(cylinders)))
        if draw(hs.booleans()):
            rows.append(Surface(math.inf, 0.0, draw(numbers(4.0, 2 * RIM_MM))))
    stop = draw(hs.integers(0, len(rows) - 1))
    gaps = [
        gap_mm(a, b) + draw(numbers(0.0, 8.0)) for a, b in zip(rows, [*rows[1:], Surface(math.inf, 0, 1)], strict=True)
    ]
    made = (replace(s, thickness_mm=g, stop=k == stop) for k, (s, g) in enumerate(zip(rows, gaps, strict=True)))
    return Lens("random", "", tuple(made), 2.0)


def gap_mm(a: Surface, b: Surface) -> float:
    """The least distance of two vertices that keeps the surfaces clear of each other inside their rims."""
    rim = min(a.semi_diameter_mm, b.semi_diameter_mm)
    places = [rim * i / 16 for i in range(17)]
    points = [*((h, 0.0) for h in places), *((0.0, h) for h in places), *((0.7 * h, 0.7 * h) for h in places)]
    return max(0.0, *(sag_mm(a, *at) - sag_mm(b, *at) for at in points)) + 1e-3


SETTINGS = settings(
    max_examples=60 if WHOLE else 20,
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
    window = replace(window, figure=SPHERE, stop=False)
    longer = replace(lens, surfaces=(window, *lens.surfaces))
    out, other = results(lens, start), results(longer, Rays(*start[:2], start.z + 1.0, *start[3:]))
    same = torch.where(out.status == 0, 0, out.status + 4) == other.status
    assert (~same).sum() <= 1
    passed = same & (out.status == st.PASSED)
    for a, b in zip(out.rays[:2] + out.rays[3:], other.rays[:2] + other.rays[3:], strict=True):
        assert ((a - b)[passed].abs() < 1e-10).all()
