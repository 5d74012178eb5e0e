"""Polynomial fits of data that cannot tell all terms apart, and what each part of a fit is worth."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import torch

from neurolens.base.errors import InputError
from neurolens.optics.lensfile import read_lens
from neurolens.surrogates.cores import InvariantPolynomial
from neurolens.surrogates.domain import domain_of, sample_domain
from neurolens.surrogates.fit import ModelSettings, Prepared, fit_model, prepare
from neurolens.surrogates.fits.polynomial import fit_polynomial
from neurolens.surrogates.lightfield import LightField
from neurolens.surrogates.model import LensModel
from neurolens.surrogates.pairs import PairSet, PairSettings, make_pairs, trace_pairs
from neurolens.surrogates.settings import NETWORK_ABLATIONS, POLYNOMIAL_ABLATIONS, ablated
from neurolens.surrogates.targets import targets_of

ROOT = Path(__file__).parents[2] / "lenses"
SETTINGS = ModelSettings(terms=30, growth=1)


@cache
def prepared(stem: str = "brendel_tessar_100") -> Prepared:
    lens = read_lens(ROOT / f"{stem}.toml")
    return prepare(make_pairs(lens, domain_of(lens), PairSettings(3000, 3000, 3000)))


def like(column: str, value: float) -> PairSet:
    """Rays of the domain with one input column (or two, for the film) replaced, exactly traced; those that pass."""
    pairs = prepared().pairs
    rays = sample_domain(pairs.domain, 4000, seed=3)
    new = {"film_x": value, "film_y": value} if column == "film" else {column: value}
    rays = replace(rays, **{k: torch.full_like(rays.film_x, v) for k, v in new.items()})
    found = trace_pairs(pairs.lens, rays, pairs.domain.pupil_z_mm)
    return found.select(found.status == 0)


POOR = {
    "one ray many times": lambda: prepared().pairs.train.select(torch.zeros(500, dtype=torch.long)),
    "five rays many times": lambda: prepared().pairs.train.select(torch.arange(500) % 5),
    "one wavelength": lambda: like("wavelength_nm", 550.0),
    "the axis": lambda: like("film", 0.0),
    "one meridian": lambda: like("film_x", 0.0),
    "hardly more rays than terms": lambda: prepared().pairs.train.select(slice(0, 31)),
}


@pytest.mark.parametrize("method", ["ols", "omp", "adaptive", "dense"])
@pytest.mark.parametrize("kind", POOR)
def test_poor_data_are_fitted_as_far_as_they_tell(kind: str, method: str) -> None:
    """Finite, sound in float32, and right on the rays that there were."""
    train = POOR[kind]()
    pairs = replace(prepared().pairs, train=train)
    settings = ModelSettings(method, terms=30, degree=4, growth=1)  # type: ignore[arg-type]
    core = fit_polynomial(replace(prepared(), pairs=pairs), settings)
    assert isinstance(core, InvariantPolynomial)
    assert np.isfinite(core.ab).all() and np.isfinite(core.scalars).all()
    targets = targets_of(pairs.lens, prepared().encoding, train)
    in_float32 = core(LightField(*(c.float() for c in targets.field)))[0].double()
    off = (in_float32 - targets.vectors)[:2]
    assert float(off.square().sum(1).mean().sqrt()) < 1e-3


def test_the_axis_ray_alone() -> None:
    rays = sample_domain(prepared().pairs.domain, 64, seed=3)
    zero = torch.zeros_like(rays.film_x)
    rays = replace(rays, film_x=zero, film_y=zero, pupil_x=zero, pupil_y=zero)
    train = trace_pairs(prepared().pairs.lens, rays, prepared().pairs.domain.pupil_z_mm)
    pairs = replace(prepared().pairs, train=train)
    core = fit_polynomial(replace(prepared(), pairs=pairs), ModelSettings(terms=10, degree=3))
    vectors, _ = core(prepared().encoding(rays))
    assert float(vectors[:2].abs().max()) < 1e-9


@pytest.mark.parametrize("rays", [1, 10, 30])
def test_fewer_rays_than_terms_are_refused(rays: int) -> None:
    pairs = replace(prepared().pairs, train=prepared().pairs.train.select(slice(0, rays)))
    with pytest.raises(InputError, match="train.*more training rays than the 30 terms"):
        fit_polynomial(replace(prepared(), pairs=pairs), ModelSettings(terms=30))


# ---- ablations ----


@cache
def direction_rms(settings: ModelSettings) -> float:
    model: LensModel = fit_model(prepared("angenieux_retrofocus_35"), settings)
    targets = targets_of(model.lens, model.encoding, prepared("angenieux_retrofocus_35").pairs.held_out)
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
        model = fit_model(prepared(stem), replace(SETTINGS, planes=False, transmittance_terms=most))
        truth = prepared(stem).pairs.held_out
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
