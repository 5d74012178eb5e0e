"""A table of exact rays: exact at its nodes, of second order between them, the same after a turn about the axis."""

from __future__ import annotations

import lens_models
import numpy as np
import pytest
import torch

from neurolens.evaluate.rays import ray_errors
from neurolens.surrogates.domain import FilmRays
from neurolens.surrogates.fit import ModelSettings, fit_model
from neurolens.surrogates.pairs import trace_pairs


@pytest.mark.parametrize("turned", (0.0, 2.0))
def test_rays_of_nodes_are_exact(turned: float) -> None:
    model = fit_model(lens_models.prepared(), ModelSettings("ray-lut", units=5))
    e, pairs = model.encoding, lens_models.prepared().pairs
    radius, across, along = (
        torch.tensor(v, dtype=torch.float64) for v in ((0.25, 0.5, 1.0), (0.5, -0.5, 0), (0.5, 0, 0))
    )
    film = torch.stack([0 * radius, radius * e.film_scale_mm])
    pupil = torch.stack([across, along]) * e.pupil_scale_mm + e.chief * film
    turn = torch.tensor([[np.cos(turned), -np.sin(turned)], [np.sin(turned), np.cos(turned)]], dtype=torch.float64)
    wavelength = 1000 / (e.w_middle + torch.tensor([-1.0, 0.0, 1.0], dtype=torch.float64) * e.w_half) ** 0.5
    rays = FilmRays(*(turn @ film), 0 * radius + e.film_plane_z_mm, *(turn @ pupil), wavelength)
    exact, found = trace_pairs(pairs.lens, rays, pairs.domain.pupil_z_mm), model.predict(rays)
    assert found.status.tolist() == [0, 0, 0] == exact.status.tolist()
    assert torch.allclose(torch.stack(list(found.rays)), torch.stack(list(exact.scene)), rtol=0, atol=1e-9)
    assert torch.allclose(found.transmittance, exact.transmittance, rtol=0, atol=1e-12)


def test_half_the_step_leaves_a_quarter_of_the_error() -> None:
    pairs = lens_models.prepared().pairs
    errors = [
        ray_errors(
            pairs.lens,
            pairs.domain,
            pairs.held_out,
            fit_model(lens_models.prepared(), ModelSettings("ray-lut", units=n)).predict,
        ).rms_um
        for n in (9, 17)
    ]
    assert 3 < errors[0] / errors[1] < 5
