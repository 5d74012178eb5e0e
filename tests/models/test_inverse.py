"""Derivatives and inverse maps, here and as files: finite differences, the exact lens, étendue; or they say no."""

import math
from dataclasses import replace
from functools import cache
from itertools import pairwise
from pathlib import Path

import lens_models
import numpy as np
import onnxruntime
import pytest
import torch
from lens_models import KINDS, model, prepared
from shipped import whole
from torch import Tensor

from neurolens.base import status as st
from neurolens.base.errors import InputError, ModelError
from neurolens.cameras.cameragraph import D_FILM
from neurolens.cameras.model import load_model
from neurolens.graph.derive import derivative, with_derivatives
from neurolens.graph.interpret import evaluate
from neurolens.graph.loworder import with_film_derivatives
from neurolens.graph.program import RAY, WAVELENGTH
from neurolens.models.export import export_inverse, export_onnx
from neurolens.models.fit import ModelSettings, fit_model
from neurolens.models.fitted import FilmRays
from neurolens.models.inverse import InverseModel, convergence, front_index, inverse_of, passing_rays
from neurolens.models.model import LensModel
from neurolens.models.pairs import PairSet, sample_domain, trace_pairs
from neurolens.optics.trace.shapes import sag_and_derivatives
from neurolens.optics.trace.surfaces import Rays, front_rays
from neurolens.optics.trace.tracegraph import exact_graph

GAUSS, FISHEYE, ASPHERE = "laikin_double_gauss_50", "horimoto_fisheye_16", "canon_aspheric_50"


@cache
def inverse(name: str = GAUSS) -> InverseModel:
    return inverse_of(fit_model(prepared(name), ModelSettings("dense", degree=5)))


def _passing(name: str) -> PairSet:
    return prepared(name).pairs.train


def _numpy(rays: FilmRays, dtype: type = np.float64) -> tuple[np.ndarray, np.ndarray]:
    """Rays [5, N] and film planes [N]."""
    return rays.rows.numpy().astype(dtype), rays.film_z.numpy().astype(dtype)


def _forward(model: LensModel, rays: np.ndarray, film_z: np.ndarray) -> dict[str, np.ndarray]:
    """The model's own answers, with the status [N]."""
    radius = np.full((1, 1), model.domain.stop_radius_mm)
    out = evaluate(model.graph, {"rays": rays, "film_z_mm": film_z[None], "stop_radius_mm": radius})
    return out | {"status": out["status"][0]}


def differentiated(model: LensModel, rays: FilmRays) -> tuple[Tensor, Tensor, Tensor]:
    """Which rays pass [N], and derivatives of the scene ray [6, 5, N] and of the stop crossing [2, 5, N] by the columns
    of `FilmRays` but the film plane."""
    names = ("scene_ray", "stop_xy_mm")
    graph = with_derivatives(model.graph, names, [("rays", k) for k in range(5)])
    radius = torch.full((1, 1), model.domain.stop_radius_mm, dtype=torch.float64)
    out = evaluate(graph, {"rays": rays.rows, "film_z_mm": rays.film_z[None], "stop_radius_mm": radius})
    rows = [[out[derivative(name, row)].expand(-1, len(rays)) for row in (*RAY, WAVELENGTH)] for name in names]
    return out["status"][0] == st.PASSED, *(torch.stack(some, 1) for some in rows)  # type: ignore[return-value]


@pytest.mark.parametrize("dtype", [np.float64, np.float32])
@pytest.mark.parametrize("name", [GAUSS, FISHEYE, *whole(ASPHERE)])
def test_stop_points_of_passing_rays_lead_to_those_rays(name: str, dtype: type) -> None:
    inv, pairs = inverse(name), _passing(name)
    k = inv.model.lens.stop_index
    stop = np.stack([pairs.cross_x[k], pairs.cross_y[k]])
    rays, film_z = _numpy(pairs.inputs, dtype)
    out = inv.through_stop(rays[:2], stop.astype(dtype), rays[4], film_z)
    assert out.residual.dtype == dtype
    assert (out.residual < 1e-4).mean() >= 0.9999
    off = np.hypot(*(out.rays[2:4] - rays[2:4]))
    assert off.max() < 0.03 * inv.model.domain.pupil_radius_mm  # the same ray, not another of the same crossing
    assert np.hypot(*(out.stop_xy_mm - stop)).max() < 1.01e-4 * inv.model.scales.stop_mm


@pytest.mark.parametrize("name", [GAUSS, FISHEYE, *whole(ASPHERE)])
def test_scene_rays_lead_back_to_film_and_pupil(name: str) -> None:
    inv = inverse(name)
    rays, film_z = _numpy(sample_domain(inv.model.domain, 4000, seed=4))
    forward = _forward(inv.model, rays, film_z)
    passed, ray = forward["status"] == st.PASSED, forward["scene_ray"]
    # From a point well before the lens, as light tracing has it.
    out = inv.from_scene(ray[:3] + 70.0 * ray[3:], ray[3:], rays[4], film_z, steps=4)
    assert np.abs(out.rays - rays)[:, passed].max() < 1e-6 * inv.model.domain.film_radius_mm
    assert np.abs(out.scene_ray - ray)[:, passed].max() < 1e-6 * inv.model.scales.position_mm
    assert (out.status == forward["status"])[passed].all()
    np.testing.assert_allclose(out.transmittance[passed], forward["transmittance"][0, passed], atol=1e-6)


def test_both_directions_agree_on_what_is_blocked() -> None:
    inv = inverse()
    rays, film_z = _numpy(sample_domain(inv.model.domain, 20000, seed=5))
    forward = _forward(inv.model, rays, film_z)
    out = inv.from_scene(forward["scene_ray"][:3], forward["scene_ray"][3:], rays[4], film_z, steps=4)
    found = (np.hypot(*(out.rays - rays)[[0, 2]]) < 1e-7) & (out.residual < 1e-9)
    assert (found & (forward["status"] >= 4)).sum() > 1000
    assert (out.status == forward["status"])[found].all()


def test_a_scene_point_and_a_point_of_the_front_make_a_ray() -> None:
    inv = inverse()
    lens, film_z = inv.model.lens, inv.model.domain.film_z_mm[0]
    x = np.linspace(-8, 8, 33)
    y = 0.3 * x + 1
    point = np.array([[120.0], [-60.0], [-900.0]])
    d = point - np.stack([x, y, sag_and_derivatives(lens.surfaces[0], x, y)[0]])
    out = inv.from_scene(point + 0 * d, d / np.linalg.norm(d, axis=0), 550.0, film_z)
    passed = out.status == st.PASSED
    assert passed.sum() > 10
    np.testing.assert_allclose(out.scene_ray[0, passed], x[passed], atol=1e-4 * inv.model.scales.position_mm)
    # The exact lens images the point where the model does: its own ray from there passes the point.
    columns = (torch.from_numpy(c[passed]) for c in (*out.rays[:2], np.full_like(x, film_z), *out.rays[2:]))
    exact = trace_pairs(lens, FilmRays(*columns), inv.model.domain.pupil_z_mm).scene
    along = (point[2, 0] - exact.z) / exact.dz
    miss = torch.hypot(exact.x + along * exact.dx - point[0, 0], exact.y + along * exact.dy - point[1, 0])
    assert float(miss.max()) < 0.05  # mm, at 0.9 m


def test_sampling_the_stop_weighs_as_sampling_the_pupil() -> None:
    inv = inverse()
    domain, count = inv.model.domain, 40000
    film = np.stack([np.full(count, 0.6 * domain.film_radius_mm), np.zeros(count)])
    film_z, waves = np.full(count, domain.film_z_mm[0]), np.full((1, count), 550.0)
    uniform = _numpy(sample_domain(domain, count, seed=6))[0][2:4]
    passed = _forward(inv.model, np.concatenate([film, uniform, waves]), film_z)["status"] == st.PASSED
    by_pupil = math.pi * domain.pupil_radius_mm**2 * passed.mean()
    radius = domain.stop_radius_mm
    out = inv.through_stop(film, uniform * 0.99999 * radius / domain.pupil_radius_mm, 550.0, film_z)
    lit = out.status == st.PASSED
    by_stop = math.pi * radius**2 * (lit / out.density).mean()
    assert by_stop == pytest.approx(by_pupil, rel=0.01)
    some = np.flatnonzero(lit)[:200]
    x, y, u, v, w = torch.from_numpy(out.rays[:, some])
    _, _, stop = differentiated(inv.model, FilmRays(x, y, torch.from_numpy(film_z[some]), u, v, w))
    area = torch.linalg.det(stop[:, 2:4].permute(2, 0, 1)).abs().numpy()
    np.testing.assert_allclose(area, out.density[some], rtol=1e-9)


@pytest.mark.parametrize("name", [GAUSS, FISHEYE, *whole(ASPHERE)])
def test_the_density_of_scene_rays_conserves_etendue(name: str) -> None:
    """cos dA d(solid angle) is the same on both sides of a lens in air, whatever its aberrations."""
    inv, pairs = inverse(name), _passing(name)
    rays, film_z = _numpy(pairs.inputs)
    scene = torch.stack([*pairs.scene]).numpy()
    out = inv.from_scene(scene[:3], scene[3:], rays[4], film_z)
    gap = film_z - inv.model.domain.pupil_z_mm
    slope2 = ((rays[2:4] - rays[:2]) ** 2).sum(0) / gap**2
    film_side = (1 + slope2) ** -2 / gap**2  # cos^4 / Z^2, per mm^2 of film and of pupil plane
    _, sx, sy = sag_and_derivatives(inv.model.lens.surfaces[0], scene[0], scene[1])
    front_side = np.abs(scene[3] * sx + scene[4] * sy - scene[5])  # |d . n / n_z|, per mm^2 of (x, y) and steradian
    ratio = out.density * film_side / front_side
    assert np.sqrt(np.mean((ratio - 1) ** 2)) < 0.01


def test_nothing_makes_it_diverge() -> None:
    inv = inverse()
    odd = [0.0, -0.0, 1e-320, 1e-30, 1.0, 30.0, 1e6, 1e30, math.inf, -math.inf, math.nan]
    mixed = np.stack(np.meshgrid(odd, odd, odd)).reshape(3, -1)
    a, b, c = mixed
    rays, film_z = _numpy(sample_domain(inv.model.domain, len(a), seed=8))
    wild = (~np.isfinite(mixed) | (np.abs(mixed) > 100)).any(0)
    for dtype in (np.float64, np.float32):
        with np.errstate(over="ignore"):
            film, stop = (np.stack(v).astype(dtype) for v in ((a, rays[1]), (b, c)))
            line = np.stack([a, b, c]).astype(dtype), np.stack([b, c, a]).astype(dtype)
        starts = [inv.through_stop(film, stop, rays[4], film_z, steps=n) for n in (0, 3, 30)]
        for before, after in pairwise(starts):
            # To the rounding of what a residual is the difference of, which is not the same on every processor.
            rounding = 16 * np.finfo(dtype).eps * (1 + before.residual)
            assert (after.residual <= before.residual + rounding).all()
        assert not (starts[1].status == st.PASSED)[wild].any()
        out = inv.from_scene(*line, rays[4], film_z)
        assert not (out.status == st.PASSED)[~np.isfinite(mixed).all(0)].any()
    for bad in (np.zeros(3), [["a"], ["b"]]):
        with pytest.raises(InputError, match="film_xy_mm"):
            inv.through_stop(bad, np.zeros((2, 3)), 550.0, film_z[0])
    for place, waves, word in ((film_z[:2], 550.0, "film_z_mm"), (film_z[0], np.full(4, 550.0), "wavelength_nm")):
        with pytest.raises(InputError, match=word):
            inv.through_stop(np.zeros((2, 3)), np.zeros((2, 3)), waves, place)


def test_a_stop_point_that_no_ray_reaches_has_a_status() -> None:
    inv = inverse()
    rays, film_z = _numpy(sample_domain(inv.model.domain, 3000, seed=9))
    angle = np.linspace(0, 6, 3000)
    stop = 1.3 * inv.model.domain.stop_radius_mm * np.stack([np.cos(angle), np.sin(angle)])
    assert (inv.through_stop(rays[:2], stop, rays[4], film_z).status != st.PASSED).all()
    rays[0] += 3 * inv.model.domain.film_radius_mm
    assert (inv.through_stop(rays[:2], 0 * stop, rays[4], film_z).status != st.PASSED).all()


@pytest.mark.parametrize("kind", ["thick", "fisheye", *whole("network")])
def test_other_cores_have_inverses_too(kind: str) -> None:
    model = lens_models.model(kind)
    found = convergence(inverse_of(model), *passing_rays(model, 3000, seed=3))
    for shares in found.values():
        assert shares["converged"] >= 0.9999 and shares["other"] == 0


def test_a_zoom_has_inverses_at_its_states() -> None:
    zoom = load_model(lens_models.LENSES.with_name("models") / "nikon_zoom_80_200-range.states-64.onnx")
    model = zoom.at(113.0).fitted
    found = convergence(inverse_of(model), *passing_rays(model, 3000, seed=3))
    assert min(shares["converged"] for shares in found.values()) >= 0.9999


def test_a_published_core_without_direction_vectors_is_refused() -> None:
    with pytest.raises(InputError, match="direction vectors"):
        inverse_of(lens_models.model("hanika"))


def test_the_guess_alone_is_not_enough_and_a_caller_learns_how_often_it_converges() -> None:
    inv = inverse()
    rays = passing_rays(inv.model, 3000, seed=12)
    assert all(s["converged"] >= 0.9999 and s["other"] == 0 for s in convergence(inv, *rays).values())
    ray = _forward(inv.model, *rays)["scene_ray"]
    starts = [inv.from_scene(ray[:3], ray[3:], rays[0][4], rays[1], steps=n).residual for n in (0, 3)]
    assert np.median(starts[0]) > 1e-6 and np.median(starts[1]) < 1e-12


COLUMNS = ("film_x", "film_y", "pupil_x", "pupil_y", "wavelength_nm")


def _outputs(model: LensModel, rays: FilmRays) -> Tensor:
    out = model.predict(rays)
    return torch.stack([*out.rays, out.stop_x, out.stop_y])


CYLINDERS = [pytest.param(kind, marks=pytest.mark.slow) for kind in ("cylinders",)]


@pytest.mark.parametrize("kind", [*KINDS, "residual", *CYLINDERS])
def test_derivatives_are_the_finite_differences_of_the_model(kind: str) -> None:
    m = model(kind)
    rays = sample_domain(m.domain, 3000, seed=3)
    ok, ray, stop = differentiated(m, rays)
    for k, name in enumerate(COLUMNS):
        step = 1e-2 if name == "wavelength_nm" else 1e-4
        ends = [_outputs(m, replace(rays, **{name: getattr(rays, name) + s * step})) for s in (1, -1)]
        central = ((ends[0] - ends[1]) / (2 * step))[:, ok]
        found = torch.cat([ray[:, k], stop[:, k]])[:, ok]
        for rows in (slice(0, 3), slice(3, 6), slice(6, 8)):
            scale = central[rows].abs().max().clamp_min(1e-12)
            assert float((found - central)[rows].abs().max() / scale) < 1e-6, (name, rows)


@pytest.mark.parametrize("name", ["muller_fisheye_100", *whole("laikin_double_gauss_50", "canon_aspheric_50")])
def test_differentials_are_those_of_the_exact_lens_to_one_percent(name: str) -> None:
    known = prepared(name)
    m = fit_model(known, ModelSettings("ols", terms=64, planes=False))
    rays = known.pairs.train.inputs.select(slice(0, 2000))
    d_film = differentiated(m, rays)[1][:, :2]
    graph = with_film_derivatives(exact_graph(m.lens, m.domain.pupil_z_mm, m.domain.wavelength_nm))
    points = np.stack([c.numpy() for c in (rays.film_x, rays.film_y, rays.pupil_x, rays.pupil_y, rays.wavelength_nm)])
    given = {"rays": points, "film_z_mm": rays.film_z.numpy()[None]}
    exact = evaluate(graph, given | {"stop_radius_mm": np.array([[m.lens.stop_radius_mm]])})
    wanted = torch.from_numpy(np.stack([exact[name] for name in D_FILM], 1))  # [6, 2, N]
    for rows in (slice(0, 3), slice(3, 6)):
        off = (d_film - wanted)[rows].square().mean().sqrt() / wanted[rows].square().mean().sqrt()
        assert float(off) < 0.01, (name, rows)


# ---- as files ----


FILE_KINDS = ("invariants", "network", "thick", "fisheye")


def _rays(kind: str, count: int = 3000) -> FilmRays:
    """Rays of the domain's farthest film plane, as float32 holds them."""
    domain = lens_models.model(kind).domain
    rays = sample_domain(domain, count, seed=21)
    plane = torch.full_like(rays.film_z, domain.film_z_mm[1])
    columns = (rays.film_x, rays.film_y, plane, rays.pupil_x, rays.pupil_y, rays.wavelength_nm)
    return FilmRays(*(c.float().double() for c in columns))


@pytest.mark.parametrize("kind", FILE_KINDS)
def test_derivatives_of_the_file_are_those_of_the_model(kind: str, tmp_path: Path) -> None:
    m = lens_models.model(kind)
    plain = load_model(lens_models.exported(kind))
    loaded = load_model(export_onnx(m, tmp_path / "m.onnx", derivatives=True))
    rays = _rays(kind)
    film, pupil = (torch.stack(p).float().numpy() for p in ((rays.film_x, rays.film_y), (rays.pupil_x, rays.pupil_y)))
    w, plane, stop = rays.wavelength_nm.float().numpy(), float(rays.film_z[0]), m.domain.stop_radius_mm
    session = onnxruntime.InferenceSession(loaded.path.read_bytes(), providers=["CPUExecutionProvider"])
    feeds = {"rays": np.concatenate([film, pupil, w[None]]), "film_z_mm": np.float32([plane])}
    names = ["scene_ray_d_film", "scene_ray_d_pupil"]
    found = [np.moveaxis(a, 0, 1) for a in session.run(names, feeds | {"stop_radius_mm": np.float32([stop])})]
    passed, wanted, _ = differentiated(m, rays)
    ok = passed.numpy()
    for a, b in zip(found, (wanted[:, :2].numpy(), wanted[:, 2:4].numpy()), strict=True):
        for rows in (slice(0, 3), slice(3, 6)):
            assert np.abs(a - b)[rows][..., ok].max() < 1e-5 * np.abs(b[rows][..., ok]).max()
    # Those who do not ask get what the plain file gives.
    for a, b in zip(loaded.rays(film, pupil, w, plane), plain.rays(film, pupil, w, plane), strict=True):
        np.testing.assert_allclose(a[..., ok], b[..., ok], atol=2e-5, rtol=1e-5)


@pytest.mark.parametrize("kind", ["network", "fisheye", *whole("invariants")])
def test_exported_maps_are_the_inverse_maps(kind: str, tmp_path: Path) -> None:
    """Other programs run the files as they are."""
    inv, sampled = inverse_of(lens_models.model(kind)), _rays(kind)
    found = export_inverse(inv, tmp_path / "m.onnx", {"rms_um": 1.0})
    rays, film_z = _numpy(sampled)
    forward = _forward(inv.model, rays, film_z)
    stop, scene = forward["stop_xy_mm"], forward["scene_ray"]
    front, solid = front_rays(inv.model.front, Rays(*scene), index=front_index(inv.model), wavelength_nm=rays[4])
    given = {"stop": ("stop_rays", [*rays[:2], *stop, rays[4]]), "scene": ("front_rays", [*front, rays[4]])}
    wanted = {
        "stop": inv.through_stop(rays[:2], stop, rays[4], film_z),
        "scene": inv.from_scene(scene[:3], scene[3:], rays[4], film_z),
    }
    sure = (forward["status"] == st.PASSED) & (np.hypot(*stop) < 0.999 * inv.model.domain.stop_radius_mm)
    for name, (key, columns) in given.items():
        assert found[name]["converged"] >= 0.9999
        session = onnxruntime.InferenceSession(found[name]["file"], providers=["CPUExecutionProvider"])
        call = {"film_z_mm": film_z[:1], "stop_radius_mm": [inv.model.domain.stop_radius_mm]}
        feeds = {k: np.array(v, np.float32) for k, v in (call | {key: columns}).items()}
        out = dict(zip((o.name for o in session.get_outputs()), session.run(None, feeds), strict=True))
        assert (out["status"] == wanted[name].status)[sure].mean() > 0.999
        assert np.abs(out["rays"][:4] - wanted[name].rays[:4])[:, sure].max() < 2e-4 * inv.model.domain.pupil_radius_mm
        density = out["density"] if name == "stop" else out["density"] / solid
        np.testing.assert_allclose(density[sure], wanted[name].density[sure], rtol=2e-3 if name == "stop" else 5e-3)
        odd = np.array([0.0, 1e-40, 5.0, 1e6, 1e38, np.inf, -np.inf, np.nan], np.float32)
        wild = np.stack([v.ravel() for v in np.meshgrid(*[odd] * 4)] + [np.full(8**4, 550.0)]).astype(np.float32)
        out = dict(zip((o.name for o in session.get_outputs()), session.run(None, feeds | {key: wild}), strict=True))
        lost = ~np.isfinite(wild).all(0) | (np.abs(wild[:4]) > 1e4).any(0)
        assert (out["status"] != st.PASSED)[lost].all()
    with pytest.raises(ModelError):
        load_model(tmp_path / "m.scene.onnx")
