"""The exact tracer against closed forms and symmetries, here and on an accelerator; no number is of another tracer."""

import math
import shutil
import sysconfig
from functools import partial
from pathlib import Path

import pytest
import torch
from shipped import backwards, focused, rays, whole
from torch import Tensor

from experiments.accuracy.extreme_cases import from_film, generator
from experiments.peers.rays import compile_tracing
from neurolens.base import status as st
from neurolens.optics.lens.paraxial import first_order
from neurolens.optics.lens.prescription import Lens, Surface
from neurolens.optics.setting.pupils import camera_rays, pupil_plane_z_mm
from neurolens.optics.trace.arrays import passing
from neurolens.optics.trace.rays import CHUNK, Rays, Towards, trace

INF = math.inf
WIDE = 1000.0


def lens(*surfaces: Surface) -> Lens:
    return Lens("test", "", surfaces, 2.0)


def bundle(table: Lens, count: int = 400, film: float = 0.6) -> Rays:
    """Camera rays from a square on the film (`film` rear radii to each side) to a square round the exit pupil."""
    g = torch.Generator().manual_seed(0)
    rear, pupil_z = table.surfaces[-1].semi_diameter_mm, pupil_plane_z_mm(table)
    data = first_order(table)
    at_pupil = pupil_z == data.exit_pupil_z_mm
    reach = min(0.6 * data.exit_pupil_diameter_mm, 2 * rear) if at_pupil else rear
    u = 2 * torch.rand((4, count), generator=g, dtype=torch.float64) - 1
    return camera_rays(u[2] * film * rear, u[3] * film * rear, table.film_z_mm, u[0] * reach, u[1] * reach, pupil_z)


def distance_from_line(point: tuple[float, float, float], r: Rays) -> Tensor:
    """[N] perpendicular distance of a point from each ray's line."""
    offset = torch.stack([p - c for p, c in zip(point, r[:3], strict=True)])
    return torch.linalg.cross(offset.T, torch.stack(r[3:]).T).norm(dim=1)


# ---- one surface ----


@pytest.mark.parametrize("index", [1.3, 1.5168, 1.9])
@pytest.mark.parametrize("degrees", [0.0, 1e-6, 20.0, 60.0, 89.0])
def test_snell_at_a_plane(index: float, degrees: float) -> None:
    i = math.radians(degrees)
    start = rays((1, 2, -1, math.sin(i), 0, math.cos(i)))
    out = trace(lens(Surface(INF, 1, WIDE, index, stop=True)), start, towards="film")
    assert float(out.rays.dx[0]) == pytest.approx(math.sin(i) / index, abs=1e-15)
    assert float(out.rays.x[0]) == pytest.approx(1 + math.tan(i), rel=1e-14)
    assert (float(out.rays.y[0]), float(out.rays.z[0])) == (2.0, 0.0)


def test_aplanatic_points_of_a_sphere_image_perfectly() -> None:
    """Rays towards the point n R from the centre of a glass sphere all meet at R / n from it (Born and Wolf, 4.2.3)."""
    n, radius = 1.5168, 10.0
    ball = lens(Surface(radius, 5, 2 * radius, n, stop=True))
    heights = torch.linspace(-0.8, 0.8, 33, dtype=torch.float64) * radius
    target = radius + n * radius  # the centre lies at z = R
    d = torch.stack([-heights, 0.5 * heights, torch.full_like(heights, target + 20.0)])
    d = d / d.norm(dim=0)
    start = Rays(heights, -0.5 * heights, torch.full_like(heights, -20.0), *d)
    out = trace(ball, start, towards="film")
    assert (out.status == 0).all()
    assert distance_from_line((0.0, 0.0, radius + radius / n), out.rays).max() < 1e-13 * radius * 10


def test_a_nearly_hemispherical_surface() -> None:
    """Rays at 99.99% of the radius meet it where they should; just beyond the radius they miss."""
    radius = 10.0
    dome = lens(Surface(radius, 30, 2 * radius, 1.5, stop=True))
    out = trace(dome, rays((9.999, 0, -1, 0, 0, 1), (0, -9.999, -1, 0, 0, 1), (10.001, 0, -1, 0, 0, 1)), towards="film")
    assert out.status.tolist() == [0, 0, st.blocked(0, st.MISSED)]
    sag = radius - math.sqrt(radius**2 - 9.999**2)
    torch.testing.assert_close(out.rays.z[:2], torch.full((2,), sag, dtype=torch.float64), rtol=0, atol=1e-12)
    # Steeply from the side onto the far half of the sphere, where there is no glass.
    far = trace(dome, rays((-30, 0, 13, 1, 0, 0.1)), towards="film")
    assert far.status.tolist() == [st.blocked(0, st.MISSED)]


# ---- total reflection and rims ----


@pytest.mark.parametrize("towards", ["film", "scene"])
@pytest.mark.parametrize("step", [1e-9, 1e-5, 0.1])
def test_total_reflection_begins_at_the_critical_angle(towards: str, step: float) -> None:
    """A plane from glass to air, either way; the ray enters the glass along the normal of a concentric sphere."""
    n, angles = 1.6, [math.asin(1 / 1.6) + s for s in (-step, step)]
    if towards == "film":
        block = lens(Surface(-50.0, 50, WIDE, n), Surface(INF, 1, WIDE, stop=True))
        out = trace(block, rays(*((0, 0, -50, math.sin(a), 0, math.cos(a)) for a in angles)), towards="film")
    else:
        block = lens(Surface(INF, 50, WIDE, n, stop=True), Surface(50.0, 1, WIDE))
        out = trace(block, rays(*((0, 0, 100, 0, math.sin(a), -math.cos(a)) for a in angles)), towards="scene")
    assert out.status.tolist() == [0, st.blocked(1 if towards == "film" else 0, st.TOTAL_REFLECTION)]


@pytest.mark.parametrize("angle", [0.0, 0.7, 2.5, 4.0])
@pytest.mark.parametrize("k", [0, 1, 2])
def test_rims_and_stop_are_circles(k: int, angle: float) -> None:
    """Just inside passes, just outside does not, whatever the azimuth."""
    openings = [40.0, 40.0, 40.0]
    openings[k] = 10.0
    plates = lens(*(Surface(INF, 2, d, stop=i == 1) for i, d in enumerate(openings)))
    rows = [
        (r * math.cos(angle), r * math.sin(angle), z, 0, 0, d)
        for z, d in ((-5, 1), (50, -1))
        for r in (5 - 1e-9, 5 + 1e-9)
    ]
    for towards, some in (("film", rows[:2]), ("scene", rows[2:])):
        assert trace(plates, rays(*some), towards=towards).status.tolist() == [0, st.blocked(k, st.RIM)]  # type: ignore[arg-type]


def test_the_first_failure_along_the_travel_rules() -> None:
    """One ray outside every rim: each direction names its own first surface; a miss goes before the rim."""
    plates = lens(*(Surface(INF, 2, 10, stop=k == 1) for k in range(3)))
    assert trace(plates, rays((6, 0, -1, 0, 0, 1)), towards="film").status.tolist() == [st.blocked(0, st.RIM)]
    assert trace(plates, rays((6, 0, 9, 0, 0, -1)), towards="scene").status.tolist() == [st.blocked(2, st.RIM)]
    dome = lens(Surface(INF, 2, 100, stop=True), Surface(5.0, 2, 8), Surface(INF, 2, 6))
    out = trace(dome, rays((4.5, 0, -1, 0, 0, 1), (5.5, 0, -1, 0, 0, 1), (3.5, 0, -1, 0, 0, 1)), towards="film")
    assert out.status.tolist() == [st.blocked(1, st.RIM), st.blocked(1, st.MISSED), st.blocked(2, st.RIM)]


# ---- whole lenses ----


def test_ball_lens() -> None:
    """EFL = n D / (4 (n - 1)), and every ray bent twice by the same angle: 2 (i - t) about the centre."""
    n, diameter = 1.5168, 20.0
    ball = lens(
        Surface(diameter / 2, diameter / 2, diameter, n),
        Surface(INF, diameter / 2, diameter, n, stop=True),
        Surface(-diameter / 2, 1, diameter),
    )
    assert first_order(ball).efl_mm == pytest.approx(n * diameter / (4 * (n - 1)), rel=1e-14)
    heights = [-9.5, -3.0, 1e-3, 0.5, 5.0, 9.0]
    out = trace(ball, rays(*((0, h, -1, 0, 0, 1) for h in heights)), towards="film")
    assert (out.status == 0).all()
    for i, h in enumerate(heights):
        incidence = math.asin(2 * h / diameter)
        bend = 2 * (incidence - math.asin(2 * h / diameter / n))
        assert math.atan2(float(out.rays.dy[i]), float(out.rays.dz[i])) == pytest.approx(-bend, abs=1e-14)
        # The distance from the centre is kept, so is the plane of incidence.
        along = torch.linalg.cross(
            torch.tensor([0.0, float(out.rays.y[i]), float(out.rays.z[i]) - diameter / 2], dtype=torch.float64),
            torch.stack([c[i] for c in out.rays[3:]]),
        )
        assert abs(float(along[0])) == pytest.approx(abs(h), rel=1e-12)


@pytest.mark.parametrize("degrees", [0.0, 1e-4, 30.0, 80.0])
def test_a_plate_shifts_rays(degrees: float) -> None:
    """t sin i (1 - cos i / (n cos t)), direction unchanged."""
    n, thickness, i = 1.6, 7.0, math.radians(degrees)
    plate = lens(Surface(INF, thickness, WIDE, n), Surface(INF, 1, WIDE, stop=True))
    start = rays((3, 0, -2, math.sin(i), 0, math.cos(i)))
    out = trace(plate, start, towards="film")
    shift = thickness * math.sin(i) * (1 - math.cos(i) / (n * math.cos(math.asin(math.sin(i) / n))))
    assert float(distance_from_line((3.0, 0.0, -2.0), out.rays)[0]) == pytest.approx(abs(shift), abs=1e-13)
    torch.testing.assert_close(torch.stack(out.rays[3:]), torch.stack(start[3:]), rtol=0, atol=1e-15)


def test_fisheye_rays_from_behind_the_camera_are_reversible() -> None:
    """The 220-degree fisheye sees more than 90 degrees off its axis; such rays enter its front the same way."""
    fisheye = focused("shimizu_fisheye_220")
    start = bundle(fisheye, 60000, film=1.3)
    out = trace(fisheye, start)
    behind = (out.status == 0) & (out.rays.dz > 0.17)  # more than 100 degrees from -z
    assert behind.sum() > 20
    scene = Rays(*(c[behind] for c in out.rays))
    assert float(torch.rad2deg(torch.acos(-scene.dz)).max()) > 104
    for travel in (0.01, 10.0, 1000.0):
        there = trace(fisheye, backwards(scene, travel), towards="film")
        assert (there.status == 0).all()
        reach = (start.z[behind] - there.rays.z) / there.rays.dz
        for k in (0, 1):
            atol = 1e-10 * max(1.0, travel / 10)
            torch.testing.assert_close(there.rays[k] + reach * there.rays[3 + k], start[k][behind], rtol=0, atol=atol)


# ---- arrays ----


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_chunks_change_no_bit(dtype: torch.dtype) -> None:
    """A batch over the chunk boundary equals the same rays traced in any other division."""
    singlet = focused("thorlabs_lb1471_biconvex_50")
    start = Rays(*(c.to(dtype) for c in bundle(singlet, CHUNK + 777)))
    wavelength = torch.linspace(400, 700, CHUNK + 777, dtype=dtype)
    whole = trace(singlet, start, wavelength, transmittance=True, record=[0, 2])
    cut = 4097
    for part in (slice(0, cut), slice(cut, 2 * cut), slice(CHUNK - 5, CHUNK + 5)):
        one = trace(singlet, Rays(*(c[part] for c in start)), wavelength[part], transmittance=True, record=[0, 2])
        for a, b in zip(one.rays, whole.rays, strict=True):
            assert torch.equal(a, b[part])
        assert torch.equal(one.status, whole.status[part])
        assert torch.equal(one.transmittance, whole.transmittance[part])
        for k in (0, 2):
            assert all(torch.equal(a, b[part]) for a, b in zip(one.crossings[k], whole.crossings[k], strict=True))


def test_an_empty_batch() -> None:
    singlet, none = focused("thorlabs_lb1471_biconvex_50"), Rays(*torch.empty((6, 0)))
    out = trace(singlet, none, torch.empty(0), transmittance=True, record=[1])
    assert out.status.shape == out.rays.x.shape == out.crossings[1].x.shape == (0,)
    assert out.status.dtype == torch.int32


def test_recording_changes_no_status() -> None:
    """Rays that are learnt from are traced with guards; the guards decide nothing."""
    table = focused("muller_fisheye_100")
    start = bundle(table, 5000)
    plain, watched = trace(table, start), trace(table, start, record=range(12), transmittance=True)
    assert torch.equal(plain.status, watched.status)
    passed = plain.status == 0
    for a, b in zip(plain.rays, watched.rays, strict=True):
        torch.testing.assert_close(a[passed], b[passed], rtol=0, atol=1e-12)


@pytest.mark.parametrize("towards", ["scene", "film"])
@pytest.mark.parametrize("name", ["muller_fisheye_100", "canon_aspheric_50", "schneider_anamorphic_31"])
def test_passing_is_status_0_without_the_lost_rays(name: str, towards: Towards) -> None:
    """Over several chunks, of which most rays are lost; NaN and no ray at all, too."""
    table = focused(name)
    start = bundle(table, 2 * CHUNK + 5, film=1.5)
    if towards == "film":
        out = trace(table, start)
        start = Rays(*(torch.where(torch.rand(c.shape) < 0.5, c, c.flip(0)) for c in out.rays))
        start = Rays(*start[:3], *(-c for c in start[3:]))
    start.x[7] = math.nan
    start = Rays(*(c.to(torch.float64) for c in start))
    found = passing(table, Rays(*(c.numpy() for c in start)), 500.0, towards)
    assert torch.equal(torch.from_numpy(found), trace(table, start, 500.0, towards=towards).status == 0)
    assert 0 < found.sum() < 0.8 * len(found)
    assert passing(table, Rays(*(c[:0].numpy() for c in start)), 500.0).shape == (0,)


@pytest.mark.slow
@pytest.mark.parametrize("backend", ["aot_eager", *whole("inductor")])  # torch's own compiler takes a minute
def test_compiled_equals_eager(backend: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """The trace is one graph of torch, with the prescription in it as constants, whatever makes code of the graph."""
    if backend == "inductor" and not any(map(shutil.which, ("c++", "g++", "clang++"))):
        pytest.skip("no C++ compiler")
    if backend == "inductor" and not Path(sysconfig.get_paths()["include"], "Python.h").is_file():
        pytest.skip("no Python.h (Debian: python3-dev)")
    monkeypatch.setattr(torch, "compile", partial(torch.compile, backend=backend))
    table, wavelength = focused("thorlabs_lb1471_biconvex_50"), torch.linspace(400, 700, 1024)
    start = Rays(*(c.float() for c in bundle(table, 1024)))
    with torch.no_grad():
        eager = trace(table, start, wavelength, transmittance=True)
        run = partial(trace, table, transmittance=True)
        compiled = compile_tracing(run, table, fullgraph=True)(start, wavelength)
    assert int((eager.status != compiled.status).sum()) <= 1  # a ray may pass an edge closely
    both = (eager.status == 0) & (compiled.status == 0)
    assert both.sum() > 100
    for a, b in zip(eager.rays, compiled.rays, strict=True):
        torch.testing.assert_close(a[both], b[both], rtol=0, atol=2e-5)
    torch.testing.assert_close(eager.transmittance, compiled.transmittance, rtol=0, atol=2e-6)


ON_DEVICE = ["laikin_double_gauss_50", "canon_aspheric_50", "schneider_anamorphic_31", "shimizu_fisheye_220"]
needs_cuda = pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device here: nothing was run on one")


def device_rays(lens: Lens, count: int, dtype: torch.dtype) -> tuple[Rays, torch.Tensor]:
    rays = from_film(lens, count, generator())
    return Rays(*(c.to(dtype) for c in rays)), torch.linspace(400, 700, count, dtype=dtype)


def on(device: str, rays: Rays, wavelength_nm: torch.Tensor) -> tuple[Rays, torch.Tensor]:
    return Rays(*(c.to(device) for c in rays)), wavelength_nm.to(device)


@needs_cuda
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("name", ON_DEVICE)
def test_the_same_results_on_cuda(name: str, dtype: torch.dtype) -> None:
    lens = focused(name)
    start = device_rays(lens, 20000, dtype)
    here = trace(lens, *start, transmittance=True)
    there = trace(lens, *on("cuda", *start), transmittance=True)
    status = there.status.cpu()
    assert int((status != here.status).sum()) <= (20 if dtype == torch.float32 else 0)
    passed = (status == 0) & (here.status == 0)
    assert passed.sum() > 1000
    for a, b in zip(there.rays, here.rays, strict=True):
        assert (a.cpu() - b)[passed].abs().max() < (1e-3 if dtype == torch.float32 else 1e-11)
    assert (there.transmittance.cpu() - here.transmittance)[passed].abs().max() < 1e-4
