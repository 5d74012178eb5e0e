"""Conics, cylinders and aspheres: perfect foci, known points, equal shapes; the graph of a lens agrees."""

import json
import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import shipped
import torch
from torch import Tensor

from neurolens.base import status as st
from neurolens.graph.program import FILM_Z, RAY, SCENE_RAY, STATUS, STOP_RADIUS, TRANSMITTANCE, WAVELENGTH
from neurolens.graph.scalars import lower
from neurolens.optics.lens.figures import figure_of
from neurolens.optics.lens.paraxial import first_order
from neurolens.optics.lens.prescription import Coating, Lens, Surface
from neurolens.optics.trace.rays import Rays, Traced, trace
from neurolens.optics.trace.shapes import sag_and_derivatives, sag_mm, traced_curve
from neurolens.optics.trace.surfaces import AIR, meet, normal_at
from neurolens.optics.trace.tensors import Tensors
from neurolens.optics.trace.tracegraph import exact_graph

PRECISIONS = [torch.float64, torch.float32]
GLASS = 1.5


def lens_of(*surfaces: Surface) -> Lens:
    """A lens whose stop lies behind everything, too wide to clip."""
    return Lens("test", "", (*surfaces, Surface(math.inf, 50.0, 1e4, stop=True)), 2.0)


def surface(radius_mm: float, diameter_mm: float = 20.0, n_d: float = GLASS, **shape: Any) -> Surface:
    return Surface(radius_mm, 5.0, diameter_mm, n_d, figure=figure_of(shape))


def rays_of(points: Tensor, directions: Tensor) -> Rays:
    """Rays from [N, 3] points and directions of any length."""
    directions = directions / directions.norm(dim=1, keepdim=True)
    return Rays(*points.T.contiguous(), *directions.T.contiguous())


def parallel(heights: Tensor, azimuth: float = 0.3) -> Rays:
    x, y = heights * math.cos(azimuth), heights * math.sin(azimuth)
    zero = torch.zeros_like(x)
    return Rays(x, y, zero - 40, zero, zero, zero + 1)


def first_point(lens: Lens, rays: Rays) -> Traced:
    return trace(lens, rays, towards="film", path=True)


@pytest.mark.parametrize("dtype", PRECISIONS, ids=str)
def test_a_hyperboloid_of_eccentricity_n_focuses_a_beam_perfectly(dtype: torch.dtype) -> None:
    # Plane front, K = -n^2 on the back: collimated light inside the glass meets in the focus R / (n - 1) behind it.
    back = surface(-20.0, 60.0, 1.0, conic=-(GLASS**2))
    lens = lens_of(surface(math.inf, 60.0), replace(back, thickness_mm=0.0))
    out = trace(lens, parallel(torch.linspace(0, 29, 50, dtype=dtype)), towards="film")
    assert (out.status == 0).all()
    focus = 5.0 + 20.0 / (GLASS - 1)
    reach = (focus - out.rays.z) / out.rays.dz
    error = torch.hypot(out.rays.x + reach * out.rays.dx, out.rays.y + reach * out.rays.dy)
    assert error.max() < (1e-12 if dtype == torch.float64 else 5e-5)


@pytest.mark.parametrize("dtype", PRECISIONS, ids=str)
def test_an_ellipsoid_of_eccentricity_1_over_n_focuses_inside_the_glass(dtype: torch.dtype) -> None:
    front = surface(20.0, 2 * 0.99 * 20 / math.sqrt(1 - GLASS**-2), conic=-(GLASS**-2))
    focus = 20.0 * GLASS / (GLASS - 1)
    lens = Lens("test", "", (front, Surface(math.inf, 0.0, 1e4, GLASS, stop=True)), 2.0)
    lens = replace(lens, surfaces=(replace(front, thickness_mm=focus), lens.surfaces[1]))
    # To 0.95 of the ellipsoid's end, where its slope is 72 degrees.
    heights = torch.linspace(0, 0.95 * front.semi_diameter_mm, 50, dtype=dtype)
    out = trace(lens, parallel(heights), towards="film")
    assert (out.status == 0).all()
    assert torch.hypot(out.rays.x, out.rays.y).max() < (1e-12 if dtype == torch.float64 else 3e-5)


SHAPES = {
    "sphere": surface(30.0),
    "paraboloid": surface(-25.0, conic=-1.0),
    "hyperboloid": surface(15.0, conic=-4.0),
    "oblate": surface(30.0, conic=3.0),
    "even": surface(30.0, conic=-0.5, asphere=((4, -2e-5), (6, 1e-7), (8, -3e-10))),
    "odd": surface(-30.0, conic=1.2, asphere=((3, 1e-4), (4, 1e-5), (5, -1e-6))),
    "square": surface(50.0, asphere=((2, 0.01), (4, 1e-6))),
    "on a plane": surface(math.inf, asphere=((4, 2e-5), (6, -5e-8))),
    "corrector": surface(math.inf, asphere=((2, -0.004), (4, 4e-5))),
    "dome": surface(10.2, conic=-0.1, asphere=((4, 1e-6),)),
    "ideal": surface(math.inf, n_d=1.0, focal_mm=40.0),
    "Qcon": surface(30.0, conic=-0.5, qcon=(0.3, -0.1, 0.03, -8e-3, 2e-3, 1e-3), norm_mm=10.0),
    "Qcon of 20 terms": surface(-60.0, qcon=tuple(1e-3 * (-1) ** m for m in range(20)), norm_mm=11.0),
    "cylinder x": surface(25.0, cylinder="x"),
    "cylinder y": surface(-25.0, cylinder="y", conic=-0.7),
    "acylinder": surface(25.0, cylinder="y", asphere=((4, 3e-5),)),
    "toroid": surface(25.0, cylinder="y", across=(-40.0, None)),
    "toroid, bent": surface(-18.0, cylinder="x", conic=-0.6, asphere=((2, 1e-3), (4, 2e-5)), across=(30.0, None)),
    "biconic": surface(25.0, cylinder="y", conic=-1.5, across=(14.0, 0.4)),
    "saddle": surface(-25.0, cylinder="x", conic=0.5, across=(30.0, -2.0)),
}


def aimed(s: Surface, count: int, dtype: torch.dtype, steepest_deg: float = 75.0) -> tuple[Rays, Tensor]:
    """Rays that meet the surface in points [N, 3] known beforehand, at up to `steepest_deg` from its normal."""
    g = torch.Generator().manual_seed(5)
    u = torch.rand(4, count, generator=g, dtype=torch.float64)
    r, a = 0.97 * s.semi_diameter_mm * u[0].sqrt(), 2 * math.pi * u[1]
    x, y = r * a.cos(), r * a.sin()
    z, step = sag_mm(s, x, y), 1e-5
    slopes = [
        (sag_mm(s, x + dx, y + dy) - sag_mm(s, x - dx, y - dy)) / (2 * step) for dx, dy in ((step, 0.0), (0.0, step))
    ]
    normal = torch.stack([-slopes[0], -slopes[1], torch.ones_like(x)], 1)
    normal = normal / normal.norm(dim=1, keepdim=True)
    across = torch.linalg.cross(normal, torch.tensor([[0.3, 1.0, 0.1]], dtype=torch.float64).expand_as(normal))
    across = across / across.norm(dim=1, keepdim=True)
    other = torch.linalg.cross(normal, across)
    tilt, turn = math.radians(steepest_deg) * u[2], 2 * math.pi * u[3]
    sideways = across * turn.cos()[:, None] + other * turn.sin()[:, None]
    d = normal * tilt.cos()[:, None] + sideways * tilt.sin()[:, None]
    points = torch.stack([x, y, z], 1)
    # From a place that is near enough for the vertex's side of the surface to be the first one met.
    return Rays(*(c.to(dtype) for c in rays_of(points - 0.5 * d, d))), points


@pytest.mark.parametrize("dtype", PRECISIONS, ids=str)
@pytest.mark.parametrize("name", SHAPES)
def test_points_known_beforehand_are_found(name: str, dtype: torch.dtype) -> None:
    rays, points = aimed(SHAPES[name], 4000, dtype)
    lens = lens_of(SHAPES[name])
    out = first_point(lens, rays)
    missed = (out.status == st.blocked(0, st.MISSED)).sum()
    assert missed == 0, f"{missed} of 4000 rays miss"
    x, y, z = (c.double() for c in out.path[0][:3])
    error = torch.stack([x, y, z], 1) - points
    assert error.abs().max() < (2e-13 if dtype == torch.float64 else 2e-5)
    if dtype == torch.float64:  # on the surface to rounding
        assert (z - sag_mm(SHAPES[name], x, y)).abs().max() < 1e-13


def test_a_deep_asphere_lets_in_light_from_110_degrees() -> None:
    # The front of a fisheye: nearly a hemisphere, with an even polynomial. Rays from all sides meet the outer side
    # wherever they were aimed, at up to 110 degrees from the axis.
    dome = surface(10.0, 18.8, conic=0.02, asphere=((4, -2e-5), (6, 5e-8)))
    rays, points = aimed(dome, 20000, torch.float64, 85.0)
    angle = torch.rad2deg(torch.acos(rays.dz))
    assert angle.max() > 110
    out = first_point(lens_of(dome), rays)
    assert (out.status != st.blocked(0, st.MISSED)).all()
    assert (torch.stack(out.path[0][:3], 1) - points).abs().max() < 1e-12


def definition(s: Surface, mp: Any) -> Any:
    """The sag of a surface at (x, y) from the definition of its figure, in the digits of `mp`."""
    data, c = s.figure.record(), mp.mpf(1) / mp.mpf(s.radius_mm) if math.isfinite(s.radius_mm) else mp.mpf(0)

    def conic(c: Any, k: Any, h: Any) -> Any:
        return c * h * h / (1 + mp.sqrt(1 - (1 + mp.mpf(k)) * (c * h) ** 2))

    def curve(h: Any) -> Any:
        u = h / data.get("norm_mm", 1)
        strong = u**4 * sum(mp.mpf(a) * mp.jacobi(m, 0, 4, 2 * u * u - 1) for m, a in enumerate(data.get("qcon", ())))
        powers = sum(mp.mpf(a) * h**p for p, a in data.get("asphere", ()))
        return conic(c, data.get("conic", 0.0), h) + powers + strong

    def sag(x: Any, y: Any) -> Any:
        if "cylinder" not in data:
            return curve(mp.sqrt(x * x + y * y))
        h, a = (abs(x), y) if data["cylinder"] == "x" else (abs(y), x)
        if "across" not in data:
            return curve(h)
        radius, k = data["across"]
        if k is None:  # a circle about a point of the line, through the curve
            way = mp.mpf(radius) - curve(h)
            return radius - mp.sign(way) * mp.sqrt(way * way - a * a)
        ca, kh = 1 / mp.mpf(radius), data.get("conic", 0.0)
        root = mp.sqrt(1 - (1 + mp.mpf(kh)) * (c * h) ** 2 - (1 + mp.mpf(k)) * (ca * a) ** 2)
        return (c * h * h + ca * a * a) / (1 + root)

    return sag


@pytest.mark.parametrize("name", SHAPES)
def test_sag_slope_and_normal_in_50_digits(name: str) -> None:
    mp = pytest.importorskip("mpmath").mp.clone()
    mp.dps = 50
    s, places = SHAPES[name], [(0.0, 0.3), (2.0, -1.0), (-5.0, 4.0), (3.0, 8.0), (-9.0, -2.5)]
    sag, (x, y) = definition(s, mp), np.array(places).T
    exact = np.array(
        [[float(sag(*at)), *(float(mp.diff(sag, at, n)) for n in ((1, 0), (0, 1)))]
         for at in ((mp.mpf(a), mp.mpf(b)) for a, b in places)]
    ).T  # fmt: skip
    assert np.abs(np.stack(sag_and_derivatives(s, x, y)) - exact).max() < 1e-13
    rays = Rays(*(torch.from_numpy(v) for v in (x, y, 0 * x - 1, 0 * x, 0 * x, 0 * x + 1)))
    o = Tensors(False, torch.float64)
    met = meet(o, rays, traced_curve(s), 1, AIR)
    found = torch.stack(normal_at(o, met, s.curvature)).numpy()
    normal = np.stack([-exact[1], -exact[2], 0 * x + 1])
    assert np.abs(met.z.numpy() - exact[0]).max() < 1e-13
    assert np.abs(found - normal / np.linalg.norm(normal, axis=0)).max() < 1e-13


@pytest.mark.parametrize("name", SHAPES)
def test_a_figure_scales_and_comes_back_from_its_numbers(name: str) -> None:
    s, (x, y) = SHAPES[name], np.array([[0.5, 4.0, -6.0], [-0.2, 5.0, 7.0]])
    assert figure_of(s.figure.record()) == s.figure and figure_of(json.loads(json.dumps(s.figure.record()))) == s.figure
    twice = replace(s, radius_mm=2 * s.radius_mm, diameter_mm=2 * s.diameter_mm, figure=s.figure.scaled(2.0))
    np.testing.assert_allclose(sag_mm(twice, 2 * x, 2 * y), 2 * sag_mm(s, x, y), rtol=0, atol=1e-13)
    assert s.figure.bounds(s.semi_diameter_mm) and all(low <= v <= high for _, v, low, high, _ in s.figure.bounds(10.0))


@pytest.mark.parametrize("name", [n for n in SHAPES if not SHAPES[n].figure.axis])
def test_seidel_terms_are_those_of_the_series(name: str) -> None:
    mp = pytest.importorskip("mpmath").mp.clone()
    mp.dps = 50
    s = SHAPES[name]
    series = mp.taylor(lambda h: definition(s, mp)(mp.mpf(0), h), mp.mpf(0), 4, direction=1)
    c, k = float(s.curvature), float(s.figure.conic)
    assert float(s.vertex_curvature("y")) == pytest.approx(float(2 * series[2]), rel=1e-14, abs=1e-30)
    fourth = (1 + k) * c**3 / 8 + dict(s.figure.powers).get(4, 0.0)
    assert fourth == pytest.approx(float(series[4]), rel=1e-10, abs=1e-20)


@pytest.mark.parametrize("s", [surface(math.inf, asphere=((4, 0.0),)), surface(1e15, conic=1.0, asphere=((2, 0.0),))])
@pytest.mark.parametrize("rim", [20.0, math.inf])
def test_an_asphere_of_nothing_is_a_plane(s: Surface, rim: float) -> None:
    rays, _ = aimed(SHAPES["paraboloid"], 500, torch.float64, 40.0)
    one = trace(lens_of(replace(s, diameter_mm=rim)), rays, towards="film")
    other = trace(lens_of(surface(math.inf, rim)), rays, towards="film")
    assert torch.equal(one.status, other.status) and (one.status == 0).sum() > 100
    torch.testing.assert_close(torch.stack(one.rays), torch.stack(other.rays), rtol=0, atol=1e-12)


def test_the_square_counts_in_the_focal_length() -> None:
    back = Surface(math.inf, 0.0, 20.0)
    square = first_order(lens_of(surface(50.0, asphere=((2, 0.01),)), back))
    assert square.efl_mm == pytest.approx(1 / ((GLASS - 1) * (1 / 50 + 0.02)), rel=1e-14)


@pytest.mark.parametrize("curved", ["x", "y"])
def test_a_cylinder_is_a_sphere_along_one_axis_and_a_plane_along_the_other(curved: str) -> None:
    lens = lens_of(surface(25.0, cylinder=curved), Surface(math.inf, 0.0, 20.0))
    h = torch.linspace(-9, 9, 31, dtype=torch.float64)
    zero = torch.zeros_like(h)
    for axis in ("x", "y"):
        x, y = (h, zero) if axis == "x" else (zero, h)
        plain = lens_of(surface(25.0 if axis == curved else math.inf), Surface(math.inf, 0.0, 20.0))
        rays = Rays(x, y, zero - 10, zero, zero, zero + 1)
        found, wanted = (trace(one, rays, towards="film").rays for one in (lens, plain))
        torch.testing.assert_close(torch.stack(found), torch.stack(wanted), rtol=0, atol=1e-14)
        efl = 1 / ((GLASS - 1) / 25.0) if axis == curved else math.inf
        if math.isfinite(efl):
            assert first_order(lens, meridian=axis).efl_mm == pytest.approx(efl, rel=1e-12)  # type: ignore[arg-type]


@pytest.mark.parametrize("name", SHAPES)
def test_there_and_back_again(name: str) -> None:
    rays, _ = aimed(SHAPES[name], 500, torch.float64, 40.0)
    lens = lens_of(SHAPES[name])
    there = trace(lens, rays, towards="film")
    ok = there.status == 0
    assert ok.sum() > 200
    back = trace(lens, Rays(*there.rays[:3], *(-c for c in there.rays[3:])), towards="scene")
    assert (back.status[ok] == 0).all()
    x, y, z, dx, dy, dz = (c[ok] for c in back.rays)
    reach = ((rays.x[ok] - x) * dx + (rays.y[ok] - y) * dy + (rays.z[ok] - z) * dz)[None]
    start = torch.stack([x, y, z]) + reach * torch.stack([dx, dy, dz])
    torch.testing.assert_close(start, torch.stack([c[ok] for c in rays[:3]]), rtol=0, atol=1e-12)


@pytest.mark.parametrize("name", SHAPES)
def test_wild_rays_never_become_nan_and_agree_in_both_precisions(name: str) -> None:
    g = torch.Generator().manual_seed(2)
    points = (torch.rand(4000, 3, generator=g, dtype=torch.float64) - 0.5) * torch.tensor([60.0, 60.0, 40.0])
    directions = torch.randn(4000, 3, generator=g, dtype=torch.float64)
    rays = rays_of(points, directions)
    rays = Rays(*(c.float().double() for c in rays))
    double = trace(lens_of(SHAPES[name]), rays, towards="film")
    single = trace(lens_of(SHAPES[name]), Rays(*(c.float() for c in rays)), towards="film")
    for out in (double, single):
        assert all(torch.isfinite(c).all() for c in out.rays)
    assert (double.status != single.status).double().mean() < 2e-3  # those within rounding of an edge


def test_absorption_follows_the_way_through_the_glass() -> None:
    plate = Surface(math.inf, 5.0, 50.0, GLASS, absorption_per_mm=0.02)
    lens = lens_of(plate, Surface(math.inf, 0.0, 50.0))
    clear = lens_of(replace(plate, absorption_per_mm=0.0), Surface(math.inf, 0.0, 50.0))
    tilt = torch.deg2rad(torch.tensor([0.0, 20.0, 50.0], dtype=torch.float64))
    zero = torch.zeros_like(tilt)
    rays = Rays(zero, zero, zero - 1, tilt.sin(), zero, tilt.cos())
    way = 5.0 / torch.sqrt(1 - (tilt.sin() / GLASS) ** 2)
    grey, bare = (trace(one, rays, towards="film", transmittance=True).transmittance for one in (lens, clear))
    torch.testing.assert_close(grey / bare, torch.exp(-0.02 * way), rtol=1e-13, atol=0)


@pytest.mark.parametrize("towards", ["film", "scene"])
def test_a_quarter_wave_film_counts_in_both_directions(towards: Any) -> None:
    index = math.sqrt(GLASS)
    film = Coating("perfect", ((index, 550 / (4 * index)),))
    ray = shipped.rays((0, 0, -1, 0, 0, 1) if towards == "film" else (0, 0, 9, 0, 0, -1))
    plate = (Surface(math.inf, 5.0, 50.0, GLASS, coating=film), Surface(math.inf, 0.0, 50.0, coating=film))
    out = trace(lens_of(*plate), ray, 550.0, towards=towards, transmittance=True)
    assert float(out.transmittance) == pytest.approx(1.0, abs=1e-14)


FILM_MM = 60.0
BEFORE_FILM: dict[str, tuple[float, dict[str, Any]]] = {
    "ellipsoid": (14.0, {"conic": -0.4}),
    "paraboloid": (-11.0, {"conic": -1.0}),
    "hyperboloid": (9.0, {"conic": -2.3}),
    "oblate, nearly hemispherical": (10.4, {"conic": 0.05}),
    "cylinder x": (-13.0, {"cylinder": "x"}),
    "cylinder y": (13.0, {"cylinder": "y"}),
    "conic cylinder": (15.0, {"cylinder": "y", "conic": -1.4}),
    "asphere": (18.0, {"conic": -0.7, "asphere": ((4, 2e-5), (6, -3e-7), (10, 4e-12))}),
    "asphere on a plane": (math.inf, {"asphere": ((2, 0.02), (4, -4e-5))}),
    "odd asphere": (-25.0, {"asphere": ((3, -2e-4), (4, 1e-5), (5, 2e-7))}),
    "asphere on a cylinder": (22.0, {"cylinder": "x", "asphere": ((4, 3e-5),)}),
    "strong asphere": (12.0, {"conic": -3.0, "asphere": ((4, 1.5e-4), (8, -6e-9))}),
    "bent back": (-12.0, {"asphere": ((4, 3e-5), (6, 1e-7))}),
    "toroid": (13.0, {"cylinder": "y", "across": (-30.0, None)}),
    "aspheric toroid": (-16.0, {"cylinder": "x", "conic": -1.2, "asphere": ((4, 2e-5),), "across": (14.0, None)}),
    "biconic": (14.0, {"cylinder": "x", "conic": -1.2, "across": (12.0, 0.2)}),
    "Qcon": (20.0, {"conic": -1.2, "qcon": (-0.3, 0.05, -0.02, 4e-3), "norm_mm": 9.0}),
    "ideal": (math.inf, {"focal_mm": -30.0}),
}


def lens_before_film(radius_mm: float, shape: dict[str, Any]) -> Lens:
    """A plane stop, a plane into glass, and the surface, as light comes from the film; the rim at 10 mm."""
    glass: dict[str, Any] = {} if "focal_mm" in shape else {"n_d": 1.6, "V_d": 40.0}
    front = Surface(radius_mm, 9.0, 20.0, figure=figure_of(shape), **glass)
    return Lens("one", "", (front, Surface(math.inf, 3.0, 40.0), Surface(math.inf, 30.0, 30.0, stop=True)), 2.0)


@pytest.mark.parametrize("name", BEFORE_FILM)
def test_graph_and_tracer_agree(name: str) -> None:
    lens, count = lens_before_film(*BEFORE_FILM[name]), 20_000
    rng = np.random.default_rng(len(name))
    film, pupil = rng.uniform(-25, 25, (2, count)), rng.uniform(-14, 14, (2, count))
    film[:, :3], pupil[:, :3] = 0, [[0, 1e-6, 9.0], [0, 0, 0]]
    points, wavelength = np.concatenate([film, pupil]).astype(np.float32), rng.uniform(400, 700, count)
    given = dict(zip(RAY, points, strict=True)) | {WAVELENGTH: wavelength.astype(np.float32)}
    given |= {FILM_Z: np.float32(FILM_MM), STOP_RADIUS: np.float32(lens.stop_radius_mm)}
    found = lower(exact_graph(lens, 12.0, (400.0, 700.0))).evaluate(given)

    x, y, px, py = (torch.from_numpy(v).double() for v in points)
    way = torch.stack([px - x, py - y, torch.full_like(x, 12.0 - FILM_MM)])
    way /= way.norm(dim=0)
    rays = Rays(x, y, torch.full_like(x, FILM_MM), *way)
    exact = trace(lens, rays, torch.from_numpy(given[WAVELENGTH]).double(), transmittance=True)
    status = exact.status.numpy()
    assert np.mean(found[STATUS] != status) < 5e-4
    passed = (status == st.PASSED) & (found[STATUS] == st.PASSED)
    assert 0.1 < passed.mean() < 0.95 and len(np.unique(status)) > 1
    scale = 1 + np.abs(np.stack([c.numpy() for c in exact.rays])[3:]).max()
    for output, column in zip(SCENE_RAY, exact.rays, strict=True):
        error = np.abs(found[output] - column.numpy())[passed]
        assert np.quantile(error, 0.999) < 1e-5 * scale and error.max() < 2e-3, output
    assert np.quantile(np.abs(found[TRANSMITTANCE] - exact.transmittance.numpy())[passed], 0.999) < 1e-4


def test_rays_that_are_none_do_not_pass() -> None:
    lens = lens_before_film(*BEFORE_FILM["asphere"])
    strange = np.float32([math.nan, math.inf, -math.inf, 3e38, 1e-40])
    given = {name: np.zeros(5, np.float32) for name in RAY} | {RAY[0]: strange, WAVELENGTH: np.full(5, 550, np.float32)}
    given |= {FILM_Z: np.float32(FILM_MM), STOP_RADIUS: np.float32(lens.stop_radius_mm)}
    found = lower(exact_graph(lens, 12.0, (400.0, 700.0))).evaluate(given)
    assert (found[STATUS][:4] != st.PASSED).all() and found[STATUS][4] == st.PASSED
