"""Zones of the film with a fit of their own: less error, the same symmetry, the same graph."""

from __future__ import annotations

import math
from pathlib import Path

import pytest
import torch
from lens_models import prepared

from neurolens.base.errors import InputError
from neurolens.cameras.model import load_model
from neurolens.evaluate.measure import onnx_predictor
from neurolens.surrogates.cores import Partitioned
from neurolens.surrogates.domain import FilmRays
from neurolens.surrogates.export import export_onnx
from neurolens.surrogates.fit import ModelSettings, fit_model
from neurolens.surrogates.model import LensModel


@pytest.fixture(scope="module")
def zoned() -> LensModel:
    return fit_model(prepared(), ModelSettings(method="adaptive", terms=16, partitions=3))


def rms_deg(model: LensModel) -> float:
    held = prepared().pairs.held_out
    out = model.predict(held.inputs).rays
    return math.degrees(float(((out.dx - held.scene.dx) ** 2 + (out.dy - held.scene.dy) ** 2).mean().sqrt()))


def test_zones_lower_the_error(zoned: LensModel) -> None:
    whole = fit_model(prepared(), ModelSettings(method="adaptive", terms=16))
    assert isinstance(zoned.core, Partitioned) and len(zoned.core.parts) == 3
    assert rms_deg(zoned) < 0.8 * rms_deg(whole)


def test_zones_keep_the_rotational_symmetry(zoned: LensModel) -> None:
    rays = prepared().pairs.held_out.inputs.select(slice(0, 500))
    c, s = math.cos(0.7), math.sin(0.7)
    turned = FilmRays(
        c * rays.film_x - s * rays.film_y,
        s * rays.film_x + c * rays.film_y,
        rays.film_z,
        c * rays.pupil_x - s * rays.pupil_y,
        s * rays.pupil_x + c * rays.pupil_y,
        rays.wavelength_nm,
    )
    a, b = zoned.predict(rays).rays, zoned.predict(turned).rays
    assert torch.allclose(c * a.dx - s * a.dy, b.dx, atol=1e-12)


def test_the_graph_chooses_the_same_zone(zoned: LensModel, tmp_path: Path) -> None:
    model = load_model(export_onnx(zoned, tmp_path / "zoned.onnx"))
    rays = prepared().pairs.held_out.inputs
    expected, found = zoned.predict(rays).rays, onnx_predictor(model)(rays).rays
    gap = torch.hypot(found.dx.double() - expected.dx, found.dy.double() - expected.dy)
    # A ray on the edge between zones may fall on either side in float32.
    assert float(gap.quantile(0.99)) < 1e-6


def test_more_zones_than_rays_can_fill_are_refused() -> None:
    with pytest.raises(InputError, match="partitions"):
        fit_model(prepared(), ModelSettings(terms=16, partitions=10_000))
