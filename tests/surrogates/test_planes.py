"""The planes of the light field: a linear change that loses nothing, and makes sparse fits better."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cache
from pathlib import Path

import pytest
import torch

from neurolens.optics.lensfile import read_lens
from neurolens.surrogates.bases import invariant_exponents, monomials, solve, vector_columns
from neurolens.surrogates.domain import domain_of
from neurolens.surrogates.fit import ModelSettings, Prepared, fit_model, prepare
from neurolens.surrogates.fits.planes import fit_planes, shifted
from neurolens.surrogates.lightfield import Encoding
from neurolens.surrogates.model import LensModel
from neurolens.surrogates.pairs import PairSettings, make_pairs
from neurolens.surrogates.targets import targets_of

ROOT = Path(__file__).parents[2] / "lenses"
SETTINGS = ModelSettings(terms=40, growth=1)


@cache
def prepared(stem: str = "angenieux_retrofocus_35") -> Prepared:
    """Focused from infinity to 1 m, so that the film planes of the rays differ."""
    lens = read_lens(ROOT / f"{stem}.toml")
    return prepare(make_pairs(lens, domain_of(lens, focus_m=(math.inf, 1.0)), PairSettings(4000, 4000, 4000)))


@cache
def fitted(planes: bool) -> LensModel:
    return fit_model(prepared(), replace(SETTINGS, planes=planes))


def direction_rms(model: LensModel) -> float:
    truth = prepared().pairs.held_out
    targets = targets_of(model.lens, model.encoding, truth)
    return float((model.core(targets.field)[0][1] - targets.vectors[1]).square().sum(0).mean().sqrt())


SHIFTS = [(0.0, 0.0), (-0.6, 0.2), (0.3, -0.2), (1.2, 0.5)]


@pytest.mark.parametrize("shift", SHIFTS)
def test_shifts_are_what_they_say(shift: tuple[float, float]) -> None:
    """q is along p - m u and the new u along u - k q, for every ray, whatever its film plane."""
    pairs, encoding = prepared().pairs, prepared().encoding
    old, new = encoding(pairs.train.inputs), shifted(encoding, pairs.train, shift)(pairs.train.inputs)
    q = old.p - shift[1] * old.u
    for got, wanted in ((new.p, q), (new.u, old.u - shift[0] * q)):
        scale = (got * wanted).sum() / (wanted * wanted).sum()
        assert abs(scale) > 0
        torch.testing.assert_close(got, scale * wanted, rtol=0, atol=1e-12)
        assert float(got.norm(dim=0).max()) == pytest.approx(1)


@pytest.mark.parametrize("shift", SHIFTS[1:])
def test_full_degree_fits_do_not_see_the_planes(shift: tuple[float, float]) -> None:
    """A linear change of variables: what all terms of a degree tell together stays the same."""
    pairs = prepared().pairs
    found = []
    for encoding in (prepared().encoding, shifted(prepared().encoding, pairs.train, shift)):
        targets = targets_of(pairs.lens, encoding, pairs.train)
        columns = vector_columns(monomials(targets.field.invariants(), invariant_exponents(2)), targets.field)
        found.append(solve(columns, targets.vectors[:2].flatten(1)) @ columns)
    torch.testing.assert_close(found[0], found[1], rtol=0, atol=1e-9)


def test_sparse_fits_gain() -> None:
    assert direction_rms(fitted(True)) < 0.7 * direction_rms(fitted(False))


def test_float32_keeps_what_the_fit_reached() -> None:
    model, rays = fitted(True), prepared().pairs.held_out.inputs
    fine = model.predict(rays).rays
    coarse = model.predict(type(rays)(*(c.float() for c in rays.columns()))).rays
    off = torch.stack([a - b for a, b in zip(fine[3:], coarse[3:], strict=True)]).norm(dim=0)
    assert float(off.square().mean().sqrt()) < 0.1 * direction_rms(model)


def test_the_same_model_bit_for_bit() -> None:
    one, two = fitted(True), fit_model(prepared(), SETTINGS)
    assert one.encoding == two.encoding
    assert one.core.exponents.tolist() == two.core.exponents.tolist()  # type: ignore[attr-defined]
    for name in ("ab", "scalars"):
        assert (getattr(one.core, name) == getattr(two.core, name)).all()


def test_too_few_rays_for_a_trial_leave_the_planes_alone() -> None:
    pairs = replace(prepared().pairs, train=prepared().pairs.train.select(slice(0, 50)))
    assert fit_planes(pairs, prepared().encoding, 40, 2.0) is prepared().encoding


def test_lenses_with_cylinders_keep_their_planes() -> None:
    encoding = Encoding(50.0, 10.0, 0.3, 20.0, 7.0, 4.1, 2.1, chief_y=0.2, pupil_scale_y_mm=6.0)
    assert fit_planes(prepared().pairs, encoding, 40, 2.0) is encoding
