"""Derivatives of models and inverse maps: against finite differences, the exact lens, and étendue; or they say no."""

import math
from dataclasses import replace
from functools import cache
from itertools import pairwise

import lens_models
import numpy as np
import pytest
import torch
from lens_models import KINDS, model, prepared
from torch import Tensor

from neurolens.base import status as st
from neurolens.base.errors import InputError
from neurolens.setting.pupils import camera_rays
from neurolens.surrogates.domain import FilmRays, sample_domain
from neurolens.surrogates.fit import ModelSettings, fit_model
from neurolens.surrogates.inverse import InverseModel, InverseRays
from neurolens.surrogates.inverse_fit import convergence, fit_inverse
from neurolens.surrogates.model import LensModel
from neurolens.surrogates.pairs import PairSet
from neurolens.trace.rays import film_derivatives, trace_differentials
from neurolens.trace.shapes import sag_and_derivatives
from neurolens.trace.surfaces import Rays

GAUSS, FISHEYE, ASPHERE = "laikin_double_gauss_50", "horimoto_fisheye_16", "canon_aspheric_50"


@cache
def inverse(name: str = GAUSS) -> InverseModel:
    known = prepared(name)
    return fit_inverse(fit_model(known, ModelSettings("dense", degree=5)), known.pairs)


def _through(inverse: InverseModel, rays: FilmRays, x: Tensor, y: Tensor, **options: int) -> InverseRays:
    return inverse.through_stop(rays.film_x, rays.film_y, rays.film_z, x, y, rays.wavelength_nm, **options)


def _passing(name: str) -> PairSet:
    return prepared(name).pairs.train


def _cast(rays: FilmRays, dtype: torch.dtype) -> FilmRays:
    return FilmRays(*(c.to(dtype) for c in rays.columns()))


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
@pytest.mark.parametrize("name", [GAUSS, FISHEYE, ASPHERE])
def test_stop_points_of_passing_rays_lead_to_those_rays(name: str, dtype: torch.dtype) -> None:
    inv, pairs = inverse(name), _passing(name)
    stop = pairs.cross_x[inv.model.lens.stop_index], pairs.cross_y[inv.model.lens.stop_index]
    rays = _cast(pairs.inputs, dtype)
    out = _through(inv, rays, *(s.to(dtype) for s in stop))
    assert float((out.residual < 1e-4).double().mean()) >= 0.9999
    off = torch.hypot(out.rays.pupil_x - rays.pupil_x, out.rays.pupil_y - rays.pupil_y)
    assert float(off.max()) < 0.03 * inv.model.domain.pupil_radius_mm  # the same ray, not another of the same crossing
    crossing = torch.stack([out.prediction.stop_x, out.prediction.stop_y])
    assert float((crossing - torch.stack(stop)).norm(dim=0).max()) < 1.01e-4 * inv.model.scales.stop_mm


@pytest.mark.parametrize("name", [GAUSS, FISHEYE, ASPHERE])
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
    from neurolens.surrogates.pairs import trace_pairs

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
    d = inv.model.differentiate(out.rays.select(some))
    area = torch.linalg.det(d.stop_d_pupil.permute(2, 0, 1)).abs()
    assert torch.allclose(area, out.density[some], rtol=1e-9)


@pytest.mark.parametrize("name", [GAUSS, FISHEYE, ASPHERE])
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


@pytest.mark.parametrize("kind", ["raw", "network", "thick"])
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


CYLINDERS = [pytest.param(kind, marks=pytest.mark.slow) for kind in ("cylinders", "cylinders network")]


@pytest.mark.parametrize("kind", [*KINDS, "zones", "residual", *CYLINDERS])
def test_derivatives_are_the_finite_differences_of_the_model(kind: str) -> None:
    m = model(kind)
    rays = sample_domain(m.domain, 3000, seed=3)
    d = m.differentiate(rays)
    ok = d.prediction.status == st.PASSED
    ray = torch.cat([d.d_film, d.d_pupil, d.d_wavelength[:, None]], 1)
    stop = torch.cat([d.stop_d_film, d.stop_d_pupil, d.stop_d_wavelength[:, None]], 1)
    for k, name in enumerate(COLUMNS):
        step = 1e-2 if name == "wavelength_nm" else 1e-4
        ends = [_outputs(m, replace(rays, **{name: getattr(rays, name) + s * step})) for s in (1, -1)]
        central = ((ends[0] - ends[1]) / (2 * step))[:, ok]
        found = torch.cat([ray[:, k], stop[:, k]])[:, ok]
        for rows in (slice(0, 3), slice(3, 6), slice(6, 8)):
            scale = central[rows].abs().max().clamp_min(1e-12)
            assert float((found - central)[rows].abs().max() / scale) < 1e-6, (name, rows)


@pytest.mark.parametrize(
    "name",
    [
        "laikin_double_gauss_50",
        "muller_fisheye_100",
        pytest.param("canon_aspheric_50", marks=pytest.mark.slow),
        pytest.param("nikon_zoom_70_200", marks=pytest.mark.slow),
    ],
)
def test_differentials_are_those_of_the_exact_lens_to_one_percent(name: str) -> None:
    known = prepared(name)
    m = fit_model(known, ModelSettings("ols", terms=64, planes=False))
    rays = known.pairs.train.inputs.select(slice(0, 2000))
    d = m.differentiate(rays)
    plane = m.domain.pupil_z_mm
    start = camera_rays(rays.film_x, rays.film_y, rays.film_z, rays.pupil_x, rays.pupil_y, plane)
    distance = torch.sqrt(
        (rays.film_x - rays.pupil_x) ** 2 + (rays.film_y - rays.pupil_y) ** 2 + (rays.film_z - plane) ** 2
    )
    exact = trace_differentials(m.lens, start, film_derivatives(start, distance), rays.wavelength_nm)
    wanted = torch.stack([torch.stack(list(t)) for t in exact.derivatives], 1)  # [6, 2, N]
    for rows in (slice(0, 3), slice(3, 6)):
        off = (d.d_film - wanted)[rows].square().mean().sqrt() / wanted[rows].square().mean().sqrt()
        assert float(off) < 0.01, (name, rows)
