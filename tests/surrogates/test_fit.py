"""Settings of a fit, what is refused, cores of several parts, and what each part of a fit is worth."""

import math
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import pytest
import torch
from lens_models import LENSES, prepared

from experiments.methods import NETWORK_ABLATIONS, POLYNOMIAL_ABLATIONS, ablated
from neurolens.base.errors import InputError
from neurolens.readers.lensfile import read_lens
from neurolens.surrogates.bases import invariant_exponents, raw_exponents
from neurolens.surrogates.cores import Partitioned, Residual
from neurolens.surrogates.domain import domain_of
from neurolens.surrogates.fit import ModelSettings, Prepared, fit_model, prepare
from neurolens.surrogates.fits import checkpoint
from neurolens.surrogates.model import LensModel
from neurolens.surrogates.pairs import PairSettings, make_pairs
from neurolens.surrogates.targets import film_equivalent, targets_of


@pytest.mark.parametrize(
    ("field", "value"),
    [
        *(("degree", v) for v in (-1, 17, 10**9)),
        *(("terms", v) for v in (0, -3, 2001)),
        *(("partitions", v) for v in (0, 65)),
        *(("units", v) for v in (0, 513)),
        *(("layers", v) for v in (0, 9)),
        *(("steps", v) for v in (0, 10**9)),
    ],
)
def test_numbers_without_bounds_are_refused(field: str, value: Any) -> None:
    with pytest.raises(InputError, match=field):
        ModelSettings(**{field: value})


def test_raw_candidates_are_bounded_by_their_number() -> None:
    with pytest.raises(InputError, match="degree"):
        ModelSettings(basis="raw", degree=12)
    assert len(raw_exponents(ModelSettings(basis="raw", degree=11).degree)) <= 5000
    assert 2 * len(invariant_exponents(ModelSettings(degree=16).degree)) <= 5000


def test_checkpoints_of_zones_are_kept_apart_and_removed_together(tmp_path: Path) -> None:
    file = tmp_path / "m.training.npz"
    settings = ModelSettings("mlp", units=3, layers=1, steps=4, partitions=2)
    first = fit_model(prepared(), settings, checkpoint=file)
    assert sorted(f.name for f in tmp_path.iterdir()) == ["m.training.1.npz", "m.training.2.npz", "m.training.npz"]
    spent = checkpoint.spent_s(file)
    assert 0 < spent <= first.fit_s
    assert fit_model(prepared(), settings, checkpoint=file).fit_s >= spent  # earlier runs count
    checkpoint.clear(file)
    assert not list(tmp_path.iterdir()) and checkpoint.spent_s(file) == 0


# ---- what each part of a fit is worth ----


@cache
def _infinity(stem: str) -> Prepared:
    lens = read_lens(LENSES / f"{stem}.toml")
    return prepare(make_pairs(lens, domain_of(lens), PairSettings(3000, 3000, 3000)))


@cache
def direction_rms(settings: ModelSettings) -> float:
    model = fit_model(_infinity("angenieux_retrofocus_35"), settings)
    targets = targets_of(model.lens, model.encoding, _infinity("angenieux_retrofocus_35").pairs.held_out)
    return float((model.core(targets.field)[0][1] - targets.vectors[1]).square().sum(0).mean().sqrt())


@pytest.mark.slow
def test_every_part_of_the_fit_is_worth_something() -> None:
    whole = direction_rms(ModelSettings(terms=24))
    for name in ("planes not searched", "forward selection alone", "matching pursuit", "raw monomials"):
        assert whole < 0.8 * direction_rms(ablated(ModelSettings(terms=24), name)), name


def test_transmittance_terms_follow_absorption() -> None:
    """A lens whose glasses absorb the blue; the ray's own terms hold low powers of the wavelength only."""
    stem = "laikin_double_gauss_127"
    off = []
    for most in (0, 16):
        model = fit_model(_infinity(stem), ModelSettings(terms=30, growth=1, planes=False, transmittance_terms=most))
        truth = _infinity(stem).pairs.held_out
        off.append(float((model.predict(truth.inputs).transmittance - truth.transmittance).square().mean().sqrt()))
    assert off[1] < 4e-4 < off[0]


def test_ablations_name_what_exists() -> None:
    for settings, names in ((ModelSettings(terms=20), POLYNOMIAL_ABLATIONS), (ModelSettings("mlp"), NETWORK_ABLATIONS)):
        labels = [ablated(settings, name).label for name in names]
        assert len(set(labels)) == len(labels)
        assert all(
            ablated(settings, n) != replace(settings, name=label) for n, label in zip(names, labels, strict=True)
        )
    with pytest.raises(InputError, match="ablation"):
        ablated(settings, "no magic")


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
