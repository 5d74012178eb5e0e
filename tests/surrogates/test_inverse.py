"""Derivatives and inverse maps, in torch and as files: finite differences, the exact lens, étendue; or they say no."""

import math
import shutil
from dataclasses import replace
from functools import cache
from itertools import pairwise
from pathlib import Path

import lens_models
import numpy as np
import onnxruntime
import pytest
import torch
from lens_models import KINDS, edited, model, prepared
from shipped import whole
from torch import Tensor

from neurolens.base import status as st
from neurolens.base.errors import InputError, ModelError
from neurolens.cameras.cameragraph import D_FILM
from neurolens.cameras.model import load_model
from neurolens.cameras.onnxlens import load_inverse
from neurolens.graph.interpret import evaluate
from neurolens.graph.loworder import with_film_derivatives
from neurolens.surrogates.card import MODEL_KEY
from neurolens.surrogates.domain import FilmRays, sample_domain
from neurolens.surrogates.export import export_inverse, export_onnx
from neurolens.surrogates.fit import ModelSettings, fit_model
from neurolens.surrogates.inverse import InverseModel, InverseRays
from neurolens.surrogates.inverse_fit import convergence, fit_inverse
from neurolens.surrogates.model import LensModel
from neurolens.surrogates.pairs import PairSet, trace_pairs
from neurolens.trace.shapes import sag_and_derivatives
from neurolens.trace.surfaces import Rays
from neurolens.trace.tracegraph import exact_graph

GAUSS, FISHEYE, ASPHERE = "laikin_double_gauss_50", "horimoto_fisheye_16", "canon_aspheric_50"


@cache
def inverse(name: str = GAUSS) -> InverseModel:
    known = prepared(name)
    return fit_inverse(fit_model(known, ModelSettings("dense", degree=5)), known.pairs)


def _through(inverse: InverseModel, rays: FilmRays, x: Tensor, y: Tensor, **options: int) -> InverseRays:
    return inverse.through_stop(rays.film_x, rays.film_y, rays.film_z, x, y, rays.wavelength_nm, **options)


def _passing(name: str) -> PairSet:
    return prepared(name).pairs.train


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
@pytest.mark.parametrize("name", [GAUSS, FISHEYE, *whole(ASPHERE)])
def test_stop_points_of_passing_rays_lead_to_those_rays(name: str, dtype: torch.dtype) -> None:
    inv, pairs = inverse(name), _passing(name)
    stop = pairs.cross_x[inv.model.lens.stop_index], pairs.cross_y[inv.model.lens.stop_index]
    rays = pairs.inputs.to(dtype)
    out = _through(inv, rays, *(s.to(dtype) for s in stop))
    assert float((out.residual < 1e-4).double().mean()) >= 0.9999
    off = torch.hypot(out.rays.pupil_x - rays.pupil_x, out.rays.pupil_y - rays.pupil_y)
    assert float(off.max()) < 0.03 * inv.model.domain.pupil_radius_mm  # the same ray, not another of the same crossing
    crossing = torch.stack([out.prediction.stop_x, out.prediction.stop_y])
    assert float((crossing - torch.stack(stop)).norm(dim=0).max()) < 1.01e-4 * inv.model.scales.stop_mm


@pytest.mark.parametrize("name", [GAUSS, FISHEYE, *whole(ASPHERE)])
def test_scene_rays_lead_back_to_film_and_pupil(name: str) -> None:
    inv = inverse(name)
    rays = sample_domain(inv.model.domain, 4000, seed=4)
    forward = inv.model.predict(rays)
    passed = forward.status == st.PASSED
    # From a point well before the lens, as light tracing has it.
    far = Rays(*(o + 70.0 * d for o, d in zip(forward.rays[:3], forward.rays[3:], strict=True)), *forward.rays[3:])
    out = inv.from_scene(far, rays.film_z, rays.wavelength_nm, steps=4)
    scale = inv.model.domain.film_radius_mm
    for found, wanted in zip(out.rays.columns(), rays.columns(), strict=True):
        assert float((found - wanted)[passed].abs().max()) < 1e-6 * scale
    again = torch.stack([*out.prediction.rays]) - torch.stack([*forward.rays])
    assert float(again[:, passed].abs().max()) < 1e-6 * inv.model.scales.position_mm
    assert bool((out.prediction.status == forward.status)[passed].all())
    assert torch.allclose(out.prediction.transmittance[passed], forward.transmittance[passed], atol=1e-6)


def test_both_directions_agree_on_what_is_blocked() -> None:
    inv = inverse()
    rays = sample_domain(inv.model.domain, 20000, seed=5)
    forward = inv.model.predict(rays)
    out = inv.from_scene(forward.rays, rays.film_z, rays.wavelength_nm, steps=4)
    same = torch.hypot(out.rays.film_x - rays.film_x, out.rays.pupil_x - rays.pupil_x) < 1e-7
    found = same & (out.residual < 1e-9)
    blocked = found & (forward.status >= 4)
    assert int(blocked.sum()) > 1000
    assert bool((out.prediction.status == forward.status)[found].all())


def test_a_scene_point_and_a_point_of_the_front_make_a_ray() -> None:
    inv = inverse()
    lens, film_z = inv.model.lens, inv.model.domain.film_z_mm[0]
    x = torch.linspace(-8, 8, 33, dtype=torch.float64)
    y = 0.3 * x + 1
    z = torch.from_numpy(sag_and_derivatives(lens.surfaces[0], x.numpy(), y.numpy())[0])
    point = torch.tensor([120.0, -60.0, -900.0], dtype=torch.float64)
    d = point[:, None] - torch.stack([x, y, z])
    ray = Rays(*(point[:, None] + 0 * d), *(d / d.norm(dim=0)))
    out = inv.from_scene(ray, torch.full_like(x, film_z), torch.full_like(x, 550.0))
    passed = out.prediction.status == st.PASSED
    assert int(passed.sum()) > 10
    assert torch.allclose(out.prediction.rays.x[passed], x[passed], atol=1e-4 * inv.model.scales.position_mm)
    # The exact lens images the point where the model does: its own ray from there passes the point.
    exact = trace_pairs(lens, out.rays.select(passed), inv.model.domain.pupil_z_mm).scene
    along = (point[2] - exact.z) / exact.dz
    miss = torch.hypot(exact.x + along * exact.dx - point[0], exact.y + along * exact.dy - point[1])
    assert float(miss.max()) < 0.05  # mm, at 0.9 m


def test_sampling_the_stop_weighs_as_sampling_the_pupil() -> None:
    inv = inverse()
    domain, count = inv.model.domain, 40000
    film = torch.full((count,), 0.6 * domain.film_radius_mm, dtype=torch.float64)
    zero = torch.zeros_like(film)
    at = FilmRays(film, zero, zero + domain.film_z_mm[0], zero, zero, zero + 550.0)
    uniform = sample_domain(domain, count, seed=6)
    on_pupil = FilmRays(film, zero, at.film_z, uniform.pupil_x, uniform.pupil_y, at.wavelength_nm)
    passed = inv.model.predict(on_pupil).status == st.PASSED
    by_pupil = math.pi * domain.pupil_radius_mm**2 * float(passed.double().mean())
    radius = domain.stop_radius_mm
    scale = 0.99999 * radius / domain.pupil_radius_mm
    out = _through(inv, at, uniform.pupil_x * scale, uniform.pupil_y * scale)
    lit = out.prediction.status == st.PASSED
    by_stop = math.pi * radius**2 * float((lit / out.density).mean())
    assert by_stop == pytest.approx(by_pupil, rel=0.01)
    some = lit.nonzero()[:200, 0]
    _, _, stop = inv.model.differentiate(out.rays.select(some))
    area = torch.linalg.det(stop[:, 2:4].permute(2, 0, 1)).abs()
    assert torch.allclose(area, out.density[some], rtol=1e-9)


@pytest.mark.parametrize("name", [GAUSS, FISHEYE, *whole(ASPHERE)])
def test_the_density_of_scene_rays_conserves_etendue(name: str) -> None:
    """cos dA d(solid angle) is the same on both sides of a lens in air, whatever its aberrations."""
    inv, pairs = inverse(name), _passing(name)
    rays, scene = pairs.inputs, pairs.scene
    out = inv.from_scene(scene, rays.film_z, rays.wavelength_nm)
    gap = rays.film_z - inv.model.domain.pupil_z_mm
    slope2 = ((rays.pupil_x - rays.film_x) ** 2 + (rays.pupil_y - rays.film_y) ** 2) / gap**2
    film_side = (1 + slope2) ** -2 / gap**2  # cos^4 / Z^2, per mm^2 of film and of pupil plane
    _, sx, sy = (
        torch.from_numpy(v) for v in sag_and_derivatives(inv.model.lens.surfaces[0], scene.x.numpy(), scene.y.numpy())
    )
    front_side = (scene.dx * sx + scene.dy * sy - scene.dz).abs()  # |d . n / n_z|, per mm^2 of (x, y) and steradian
    ratio = out.density * film_side / front_side
    assert float((ratio - 1).square().mean().sqrt()) < 0.01


def test_nothing_makes_it_diverge() -> None:
    inv = inverse()
    odd = torch.tensor([0.0, -0.0, 1e-320, 1e-30, 1.0, 30.0, 1e6, 1e30, math.inf, -math.inf, math.nan])
    mixed = torch.cartesian_prod(odd, odd, odd).double()
    count = len(mixed)
    base = sample_domain(inv.model.domain, count, seed=8)
    for dtype in (torch.float64, torch.float32):
        columns = [c.to(dtype) for c in (mixed[:, 0], base.film_y, base.film_z, mixed[:, 1], mixed[:, 2])]
        starts = [inv.through_stop(*columns, base.wavelength_nm.to(dtype), steps=n) for n in (0, 3, 30)]
        for before, after in pairwise(starts):
            # To the rounding of what a residual is the difference of, which is not the same on every processor.
            rounding = 16 * torch.finfo(dtype).eps * (1 + before.residual)
            assert bool((after.residual <= before.residual + rounding).all())
        wild = (mixed.abs() > 100).any(1) | ~torch.isfinite(mixed).all(1)
        assert not bool((starts[1].prediction.status == st.PASSED)[wild].any())
        ray = Rays(*(mixed[:, i].to(dtype) for i in (0, 1, 2, 1, 2, 0)))
        out = inv.from_scene(ray, base.film_z.to(dtype), base.wavelength_nm.to(dtype))
        assert not bool((out.prediction.status == st.PASSED)[~torch.isfinite(mixed).all(1)].any())


def test_a_stop_point_that_no_ray_reaches_has_a_status() -> None:
    inv = inverse()
    rays = sample_domain(inv.model.domain, 3000, seed=9)
    angle = torch.linspace(0, 6, 3000, dtype=torch.float64)
    radius = 1.3 * inv.model.domain.stop_radius_mm
    out = _through(inv, rays, radius * torch.cos(angle), radius * torch.sin(angle))
    assert bool((out.prediction.status != st.PASSED).all())
    rays = FilmRays(rays.film_x + 3 * inv.model.domain.film_radius_mm, *rays.columns()[1:])
    assert bool((_through(inv, rays, 0 * angle, 0 * angle).prediction.status != st.PASSED).all())


def test_pairs_of_another_lens_are_refused() -> None:
    with pytest.raises(InputError, match="pairs"):
        fit_inverse(inverse().model, prepared(FISHEYE).pairs)


@pytest.mark.parametrize("kind", ["thick", *whole("network")])
def test_other_cores_have_inverses_too(kind: str) -> None:
    model = lens_models.model(kind)
    inv = fit_inverse(model, prepared().pairs)
    rays = prepared().pairs.train.inputs.select(slice(0, 1000))
    forward = model.predict(rays)
    back = _through(inv, rays, forward.stop_x, forward.stop_y)
    assert float((back.residual < 1e-4).double().mean()) >= 0.999
    scene = inv.from_scene(forward.rays, rays.film_z, rays.wavelength_nm)
    assert float((scene.residual < 1e-4).double().mean()) >= 0.999
    assert np.isfinite(inv.report["seconds"])


def test_the_report_says_how_often_it_converges() -> None:
    inv = inverse()
    for name in ("stop", "scene"):
        assert inv.report[name]["converged"] >= 0.9999
        assert inv.report[name]["other"] == 0
    rays = sample_domain(inv.model.domain, 3000, seed=12)
    assert convergence(inv, rays, steps=0)["stop"]["converged"] < 0.99  # the guess alone is not enough


COLUMNS = ("film_x", "film_y", "pupil_x", "pupil_y", "wavelength_nm")


def _outputs(model: LensModel, rays: FilmRays) -> Tensor:
    out = model.predict(rays)
    return torch.stack([*out.rays, out.stop_x, out.stop_y])


CYLINDERS = [pytest.param(kind, marks=pytest.mark.slow) for kind in ("cylinders",)]


@pytest.mark.parametrize("kind", [*KINDS, "residual", *CYLINDERS])
def test_derivatives_are_the_finite_differences_of_the_model(kind: str) -> None:
    m = model(kind)
    rays = sample_domain(m.domain, 3000, seed=3)
    prediction, ray, stop = m.differentiate(rays)
    ok = prediction.status == st.PASSED
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
    d_film = m.differentiate(rays)[1][:, :2]
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


@cache
def inverse_of_kind(kind: str) -> InverseModel:
    name = "horimoto_fisheye_16" if kind == "fisheye" else "laikin_double_gauss_50"
    return fit_inverse(lens_models.model(kind), prepared(name).pairs)


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
    prediction, wanted, _ = m.differentiate(rays)
    ok = (prediction.status == st.PASSED).numpy()
    for a, b in zip(found, (wanted[:, :2].numpy(), wanted[:, 2:4].numpy()), strict=True):
        for rows in (slice(0, 3), slice(3, 6)):
            assert np.abs(a - b)[rows][..., ok].max() < 1e-5 * np.abs(b[rows][..., ok]).max()
    # Those who do not ask get what the plain file gives.
    for a, b in zip(loaded.rays(film, pupil, w, plane), plain.rays(film, pupil, w, plane), strict=True):
        np.testing.assert_allclose(a[..., ok], b[..., ok], atol=2e-5, rtol=1e-5)


@pytest.mark.parametrize("kind", ["network", "fisheye", *whole("invariants")])
def test_inverse_maps_of_the_file_are_those_of_torch(kind: str, tmp_path: Path) -> None:
    inv, rays = inverse_of_kind(kind), _rays(kind)
    export_inverse(inv, tmp_path / "m.onnx", {"rms_um": 1.0})
    loaded = load_inverse(tmp_path / "m.onnx", lens=inv.model.lens.sha256)
    forward = inv.model.predict(rays)
    film, w, plane = torch.stack([rays.film_x, rays.film_y]).numpy(), rays.wavelength_nm.numpy(), float(rays.film_z[0])
    stop = torch.stack([forward.stop_x, forward.stop_y])
    found = loaded.through_stop(film, stop.numpy(), w, plane)
    wanted = inv.through_stop(rays.film_x, rays.film_y, rays.film_z, stop[0], stop[1], rays.wavelength_nm)
    passed = (forward.status == st.PASSED).numpy()
    rim = (stop.norm(dim=0) > 0.999 * inv.model.domain.stop_radius_mm).numpy()
    sure = passed & ~rim
    assert (found.status == wanted.prediction.status.numpy())[sure].mean() > 0.999
    scale = inv.model.domain.pupil_radius_mm
    assert np.abs(found.rays[2] - wanted.rays.pupil_x.numpy())[sure].max() < 2e-4 * scale
    np.testing.assert_allclose(found.density[sure], wanted.density.numpy()[sure], rtol=2e-3)
    scene = torch.stack(list(forward.rays)).numpy()
    back = loaded.from_scene(scene[:3] + 50 * scene[3:], scene[3:], w, plane)
    side = inv.from_scene(forward.rays, rays.film_z, rays.wavelength_nm)
    assert (back.status == side.prediction.status.numpy())[sure].mean() > 0.999
    inverted = (side.rays.film_x, side.rays.film_y, side.rays.pupil_x, side.rays.pupil_y)
    for row, column in zip(back.rays[:4], inverted, strict=True):
        assert np.abs(row - column.numpy())[sure].max() < 2e-4 * scale
    np.testing.assert_allclose(back.density[sure], side.density.numpy()[sure], rtol=5e-3)
    fit = loaded.card["inverse"]["fit"]
    assert min(fit["stop"]["converged"], fit["scene"]["converged"]) >= 0.999


def test_nonsense_gets_a_status(tmp_path: Path) -> None:
    export_inverse(inverse_of_kind("invariants"), tmp_path / "m.onnx")
    loaded = load_inverse(tmp_path / "m.onnx")
    odd = np.array([0.0, 1e-40, 5.0, 1e6, 1e38, np.inf, -np.inf, np.nan])
    a, b, c = (v.ravel() for v in np.meshgrid(odd, odd, odd))
    points = np.stack([a, b, c])
    wild = (~np.isfinite(points) | (np.abs(points) > 100)).any(0)
    out = loaded.through_stop(np.stack([a, np.zeros_like(a)]), np.stack([b, c]), 550.0)
    assert (out.status != st.PASSED)[wild].all()
    back = loaded.from_scene(points, np.stack([c, a, b]), 550.0)
    assert (back.status != st.PASSED)[~np.isfinite(points).all(0)].all()
    for bad in (np.zeros(3), [["a"], ["b"]]):
        with pytest.raises(InputError, match="film_xy_mm"):
            loaded.through_stop(bad, np.zeros((2, 3)), 550.0)


def test_files_that_are_no_inverse_maps_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ModelError, match="no such files"):
        load_inverse(tmp_path / "m.onnx")
    shutil.copy(lens_models.exported("invariants"), tmp_path / "m.stop.onnx")
    with pytest.raises(ModelError, match="inverse"):
        load_inverse(tmp_path / "m.onnx")
    export_inverse(inverse_of_kind("invariants"), tmp_path / "m.onnx")
    with pytest.raises(ModelError, match="another lens"):
        load_inverse(tmp_path / "m.onnx", lens="0" * 64)
    scene = shutil.copy(tmp_path / "m.scene.onnx", tmp_path / "whole.onnx")
    edited(scene, tmp_path / "m.scene.onnx", lambda card: card["inverse"].update(map="stop"))
    with pytest.raises(ModelError, match="card: inverse"):
        load_inverse(tmp_path / "m.onnx")
    for change in (
        lambda d: d.pop("guess"),
        lambda d: d["guess"]["ab"].update(shape=[1, 1]),
        lambda d: d["guess"].pop("ab"),
    ):
        edited(scene, tmp_path / "m.scene.onnx", change, MODEL_KEY)
        with pytest.raises(ModelError, match="first guess"):
            load_inverse(tmp_path / "m.onnx")
    shutil.copy(scene, tmp_path / "m.scene.onnx")
    (tmp_path / "m.stop.onnx").unlink()
    with pytest.raises(InputError, match="map"):
        load_inverse(tmp_path / "m.onnx").through_stop(np.zeros((2, 1)), np.zeros((2, 1)), 550.0)
    with pytest.raises(ModelError):
        load_model(tmp_path / "m.scene.onnx")
