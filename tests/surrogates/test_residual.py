"""A polynomial and a network added: less error than the polynomial, the same in every form that a model has."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from lens_models import prepared

from neurolens.base.errors import InputError
from neurolens.cameras.model import load_model
from neurolens.surrogates.cores import Partitioned, Residual
from neurolens.surrogates.export import export_onnx
from neurolens.surrogates.fit import ModelSettings, fit_model
from neurolens.surrogates.model import LensModel
from neurolens.surrogates.specialise import at_wavelength
from neurolens.surrogates.stored import load_fitted
from neurolens.surrogates.targets import film_equivalent, targets_of

SETTINGS = ModelSettings("ols+mlp", terms=12, degree=5, planes=False, units=8, layers=1, steps=60)


@pytest.fixture(scope="module")
def model() -> LensModel:
    return fit_model(prepared(), SETTINGS)


def _rms_um(model: LensModel) -> float:
    pairs = prepared().pairs
    targets = targets_of(pairs.lens, model.encoding, pairs.held_out)
    off = film_equivalent(pairs.lens, pairs.domain, model.core(targets.field)[0] - targets.vectors)
    return float((off**2).sum(1).mean().sqrt())


def test_the_network_takes_most_of_what_the_polynomial_leaves(model: LensModel) -> None:
    assert isinstance(model.core, Residual)
    assert _rms_um(model) < 0.3 * _rms_um(replace(model, core=model.core.parts[0]))


def test_it_is_the_sum_of_its_parts(model: LensModel) -> None:
    assert isinstance(model.core, Residual)
    field = model.encoding(prepared().pairs.held_out.inputs.select(slice(0, 100)))
    for total, one, other in zip(model.core(field), *(part(field) for part in model.core.parts), strict=True):
        torch.testing.assert_close(total, one + other, rtol=0, atol=1e-13)


def test_the_exported_graph_gives_the_same_rays(model: LensModel, tmp_path) -> None:
    file = export_onnx(model, tmp_path / "residual.onnx")
    onnx, inputs = load_model(file), prepared().pairs.held_out.inputs.select(slice(0, 500))
    columns = [c.numpy().astype(np.float32) for c in inputs.columns()]
    out = onnx.rays(np.stack(columns[:2]), np.stack(columns[3:5]), columns[5], columns[2])
    wanted = model.predict(inputs)
    assert np.array_equal(out.status, wanted.status.numpy())
    mm = 2e-6 * abs(onnx.card["lens"]["efl_mm"])
    for k, c in enumerate(wanted.rays):
        assert np.abs(out.scene_ray[k] - c.numpy()).max() < (mm if k < 3 else 2e-6)
    assert np.abs(out.transmittance - wanted.transmittance.numpy()).max() < 1e-5
    assert isinstance(load_fitted(file).core, Residual)


def test_one_wavelength_of_it(model: LensModel) -> None:
    inputs = prepared().pairs.held_out.inputs
    inputs = type(inputs)(*inputs.columns()[:5], torch.full_like(inputs.film_x, 550.0))
    whole, one = model.predict(inputs), at_wavelength(model, 550.0).predict(inputs)
    assert torch.allclose(torch.stack(list(whole.rays)), torch.stack(list(one.rays)), atol=1e-10)


def test_zones_and_what_is_refused() -> None:
    zoned = fit_model(prepared(), replace(SETTINGS, units=3, steps=5, partitions=2))
    assert isinstance(zoned.core, Partitioned)
    assert all(isinstance(part, Residual) for part in zoned.core.parts)
    with pytest.raises(InputError, match="basis"):
        fit_model(prepared(), replace(SETTINGS, basis="raw", degree=3))


def test_its_name_is_that_of_a_file() -> None:
    assert SETTINGS.label == "ols-12-mlp-8x1"
