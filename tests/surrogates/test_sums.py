"""Cores of several parts: zones of the film with fits of their own, and a network added to a polynomial."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from lens_models import prepared

from neurolens.base.errors import InputError
from neurolens.surrogates.cores import Partitioned, Residual
from neurolens.surrogates.fit import ModelSettings, fit_model
from neurolens.surrogates.model import LensModel
from neurolens.surrogates.targets import film_equivalent, targets_of


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


def test_more_zones_than_rays_can_fill_are_refused() -> None:
    with pytest.raises(InputError, match="partitions"):
        fit_model(prepared(), ModelSettings(terms=16, partitions=10_000))


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


def test_zones_and_what_is_refused() -> None:
    zoned = fit_model(prepared(), replace(SETTINGS, units=3, steps=5, partitions=2))
    assert isinstance(zoned.core, Partitioned)
    assert all(isinstance(part, Residual) for part in zoned.core.parts)
    with pytest.raises(InputError, match="basis"):
        fit_model(prepared(), replace(SETTINGS, basis="raw", degree=3))
