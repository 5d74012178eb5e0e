"""Lenses with cylinders: two planes of symmetry, held exactly, in torch and in the exported graph."""

import re
from dataclasses import replace

import numpy as np
import pytest
import torch
from lens_models import anamorphic
from vignetting_oracle import vignetting_errors

from neurolens.base.errors import InputError
from neurolens.lens.prescription import Lens
from neurolens.study.rays import ray_errors
from neurolens.surrogates.domain import sample_domain
from neurolens.surrogates.fit import ModelSettings, Prepared, fit_model
from neurolens.surrogates.fits.mirror import mirror_exponents
from neurolens.surrogates.model import LensModel

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def prepared() -> Prepared:
    return anamorphic()


@pytest.fixture(scope="module")
def lens(prepared: Prepared) -> Lens:
    return prepared.pairs.lens


@pytest.fixture(scope="module")
def model(prepared: Prepared) -> LensModel:
    return fit_model(prepared, ModelSettings(terms=96, degree=4))


def test_fits_rays_and_rims(lens: Lens, model: LensModel, prepared: Prepared) -> None:
    errors = ray_errors(lens, model.domain, prepared.pairs.held_out, model.predict)
    assert errors.direction_rms_deg < 0.002
    assert errors.rms_um < 1.5
    assert errors.position_rms_um < 10
    assert errors.transmittance_rms < 5e-4
    shares = vignetting_errors(lens, model.domain, model.predict, count=30_000)
    assert shares["false_pass"] < 0.005 and shares["false_block"] < 0.005


@pytest.fixture(scope="module")
def network(prepared: Prepared) -> LensModel:
    return fit_model(prepared, ModelSettings(method="mlp", units=12, layers=2, steps=25))


@pytest.fixture(params=["model", "network"])
def either(request: pytest.FixtureRequest) -> LensModel:
    found: LensModel = request.getfixturevalue(request.param)
    return found


def test_a_network_fits_rays_and_rims(lens: Lens, network: LensModel, prepared: Prepared) -> None:
    errors = ray_errors(lens, network.domain, prepared.pairs.held_out, network.predict)
    assert errors.direction_rms_deg < 0.004
    shares = vignetting_errors(lens, network.domain, network.predict, count=30_000)
    assert shares["false_pass"] < 0.005 and shares["false_block"] < 0.005


@pytest.mark.parametrize("axis", [0, 1])
def test_mirrored_rays_have_mirrored_images(either: LensModel, axis: int) -> None:
    model = either
    rays = sample_domain(model.domain, 2000, 3)
    names = [("film_x", "pupil_x"), ("film_y", "pupil_y")][axis]
    mirrored = replace(rays, **{n: -getattr(rays, n) for n in names})
    a, b = model.predict(rays), model.predict(mirrored)
    for name in ("x", "y", "dx", "dy"):
        sign = -1 if name.endswith("xy"[axis]) else 1
        assert torch.equal(getattr(a.rays, name), sign * getattr(b.rays, name))
    assert torch.equal(a.transmittance, b.transmittance) and torch.equal(a.status, b.status)


def test_is_not_round(model: LensModel) -> None:
    # A quarter turn of the film changes the image: an anamorphic model that were rotation-symmetric would be wrong.
    rays = sample_domain(model.domain, 500, 3)
    turned = replace(rays, film_x=-rays.film_y, film_y=rays.film_x, pupil_x=-rays.pupil_y, pupil_y=rays.pupil_x)
    a, b = model.predict(rays), model.predict(turned)
    assert float((a.rays.dx - b.rays.dy).abs().median()) > 0.01


def test_candidates_are_all_different(prepared: Prepared) -> None:
    # The columns of one component's candidates must be independent functions: no monomial of the raw coordinates twice.
    for axis in (0, 1):
        seen = set()
        for row in mirror_exponents(3, axis):
            squares = [(2 * row[0] + row[1], 2 * row[2] + row[1]), (2 * row[3] + row[4], 2 * row[5] + row[4])]
            for side in (0, 1):
                own = np.array(squares[axis]) + np.eye(2, dtype=int)[side]
                key = (*own.tolist(), *squares[1 - axis], int(row[6]))
                assert key not in seen
                seen.add(key)


@pytest.mark.parametrize("method", ["ols+mlp", "thick", "adaptive"])
def test_other_fits_are_refused_by_name(prepared: Prepared, method: str) -> None:
    with pytest.raises(InputError, match=re.escape(f"method: got {method!r}")):
        fit_model(prepared, ModelSettings(method=method))  # type: ignore[arg-type]
