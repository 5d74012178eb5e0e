"""A model's derivatives: against finite differences of itself, torch's differentiation, and the exact lens."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from lens_models import KINDS, model, prepared
from torch import Tensor

from neurolens.base import status as st
from neurolens.optics.differentials import film_tangents, trace_differentials
from neurolens.optics.pupil_rays import camera_rays
from neurolens.surrogates.cores import Core, MirrorPolynomial, Partitioned
from neurolens.surrogates.domain import FilmRays, sample_domain
from neurolens.surrogates.fit import ModelSettings, fit_model
from neurolens.surrogates.inversion.derivatives import differentiate, forward_mode, slopes_of
from neurolens.surrogates.lightfield import LightField
from neurolens.surrogates.model import LensModel

COLUMNS = ("film_x", "film_y", "pupil_x", "pupil_y", "wavelength_nm")


def _outputs(model: LensModel, rays: FilmRays) -> Tensor:
    out = model.predict(rays)
    return torch.stack([*out.rays, out.stop_x, out.stop_y])


@pytest.mark.parametrize("kind", KINDS)
def test_derivatives_are_the_finite_differences_of_the_model(kind: str) -> None:
    m = model(kind)
    rays = sample_domain(m.domain, 3000, seed=3)
    d = differentiate(m, rays)
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


def _mirror_core() -> MirrorPolynomial:
    generator = torch.Generator().manual_seed(1)
    exponents = np.array([[0] * 7, [1, 0, 0, 0, 0, 0, 0], [0, 1, 0, 2, 0, 0, 1], [0, 0, 1, 0, 1, 1, 0]], dtype=np.int64)
    ab = torch.randn(3, 2, 2, 4, generator=generator, dtype=torch.float64)
    return MirrorPolynomial(exponents, ab, torch.zeros(1, 4, dtype=torch.float64))


@pytest.mark.parametrize("kind", [*KINDS, "mirror", "zones"])
def test_analytic_slopes_are_those_of_forward_mode(kind: str) -> None:
    core: Core
    if kind == "mirror":
        core = _mirror_core()
    elif kind == "zones":
        core = Partitioned((0.3,), (model("invariants").core, model("network").core))  # type: ignore[arg-type]
    else:
        core = model(kind).core
    v = torch.rand(5, 500, generator=torch.Generator().manual_seed(0), dtype=torch.float64) * 2 - 1
    field = LightField(v[:2], v[2:4], v[4])
    values, slopes = slopes_of(core)(field)
    by_torch = forward_mode(core, field)
    assert torch.allclose(values, by_torch[0], atol=1e-13)
    assert torch.allclose(slopes, by_torch[1], atol=1e-12)
    some = slopes_of(core, vectors=[2])(field)
    assert torch.allclose(some[1][0], slopes[2], atol=1e-13)


def test_a_core_of_another_kind_is_differentiated_all_the_same() -> None:
    inner = model("invariants").core

    class Doubled:
        coefficients = coefficients_per_vector = 0

        def __call__(self, field: LightField) -> tuple[Tensor, Tensor]:
            vectors, scalars = inner(field)
            return 2 * vectors, scalars

        def to(self, dtype: torch.dtype) -> Doubled:
            return self

    rays = sample_domain(model("invariants").domain, 200, seed=3)
    field = model("invariants").encoding(rays)
    assert torch.allclose(slopes_of(Doubled())(field)[1], 2 * slopes_of(inner)(field)[1], atol=1e-12)


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
    d = differentiate(m, rays)
    plane = m.domain.pupil_z_mm
    start = camera_rays(rays.film_x, rays.film_y, rays.film_z, rays.pupil_x, rays.pupil_y, plane)
    distance = torch.sqrt(
        (rays.film_x - rays.pupil_x) ** 2 + (rays.film_y - rays.pupil_y) ** 2 + (rays.film_z - plane) ** 2
    )
    exact = trace_differentials(m.lens, start, film_tangents(start, distance), rays.wavelength_nm)
    wanted = torch.stack([torch.stack(list(t)) for t in exact.derivatives], 1)  # [6, 2, N]
    for rows in (slice(0, 3), slice(3, 6)):
        off = (d.d_film - wanted)[rows].square().mean().sqrt() / wanted[rows].square().mean().sqrt()
        assert float(off) < 0.01, (name, rows)
