"""A model's derivatives: against finite differences of itself, and the exact lens."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from lens_models import KINDS, model, prepared
from torch import Tensor

from neurolens.base import status as st
from neurolens.optics.pupils import camera_rays
from neurolens.optics.trace import film_derivatives, trace_differentials
from neurolens.surrogates.domain import FilmRays, sample_domain
from neurolens.surrogates.fit import ModelSettings, fit_model
from neurolens.surrogates.model import LensModel

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
