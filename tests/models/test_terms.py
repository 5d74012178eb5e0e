"""Choosing terms: the sweep against plain least squares, and what each rule promises."""

import math

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from sklearn import linear_model

from experiments.accuracy.published.data import raw_exponents
from neurolens.graph.interpret import monomials
from neurolens.models.cores import LightField
from neurolens.models.terms import (
    SPANNED,
    Sweep,
    backward,
    forward,
    invariant_exponents,
    replace_terms,
    solve,
    vector_columns,
    vector_gram,
)

Floats = NDArray[np.float64]


def sweep_of(columns: Floats, outputs: Floats) -> Sweep:
    """Columns [M, N], outputs [R, N]."""
    return Sweep(columns @ columns.T, columns @ outputs.T, (outputs**2).sum(1))


def residual(columns: Floats, outputs: Floats, chosen: list[int]) -> float:
    """The same by numpy's least squares."""
    if not chosen:
        return float((outputs**2).sum())
    found = np.linalg.lstsq(columns[chosen].T, outputs.T, rcond=None)[0]
    return float(((outputs - found.T @ columns[chosen]) ** 2).sum())


def correlated(seed: int = 0, count: int = 40, rays: int = 400) -> Floats:
    """Columns with large common parts and lengths from 1e-3 to 1e3, as monomials have."""
    rng = np.random.default_rng(seed)
    mixed = rng.normal(size=(count, rays)) + 3 * rng.normal(size=(count, 4)) @ rng.normal(size=(4, rays))
    return mixed * 10.0 ** rng.uniform(-3, 3, size=(count, 1))


def test_sweep_is_least_squares() -> None:
    columns, outputs = correlated(), np.random.default_rng(1).normal(size=(3, 400))
    sweep, rng = sweep_of(columns, outputs), np.random.default_rng(2)
    assert sweep.residual == pytest.approx(residual(columns, outputs, []))
    for step in range(60):  # in and out at random
        k = int(rng.integers(40))
        (sweep.drop if k in sweep.chosen else sweep.add)(k)
        assert sweep.residual == pytest.approx(residual(columns, outputs, sweep.chosen), rel=1e-9), step
    before, chosen = sweep.residual, list(sweep.chosen)
    sweep.refresh()
    assert sweep.chosen == chosen and sweep.residual == pytest.approx(before, rel=1e-9)


@pytest.mark.parametrize("seed", range(5))
def test_ols_with_replacement_finds_planted_terms(seed: int) -> None:
    """Six terms among forty correlated ones, for two outputs that share them."""
    rng = np.random.default_rng(seed)
    columns = correlated(seed)
    unit = columns / np.linalg.norm(columns, axis=1, keepdims=True)
    planted = sorted(int(k) for k in rng.choice(40, 6, replace=False))
    outputs = rng.uniform(1, 2, size=(2, 6)) * rng.choice([-1, 1], size=(2, 6)) @ unit[planted]
    sweep = sweep_of(columns, outputs)
    forward(sweep, 6)
    replace_terms(sweep)
    assert sorted(sweep.chosen) == planted
    assert sweep.residual < 1e-12 * float((outputs**2).sum())


@pytest.mark.parametrize("seed", range(8))
def test_replacement_never_raises_the_residual(seed: int) -> None:
    columns, outputs = correlated(seed, rays=60), np.random.default_rng(seed + 50).normal(size=(2, 60))
    sweep = sweep_of(columns, outputs)
    forward(sweep, 8, "omp")
    before = residual(columns, outputs, sweep.chosen)
    exchanged = replace_terms(sweep)
    after = residual(columns, outputs, sweep.chosen)
    assert len(set(sweep.chosen)) == 8
    assert after <= before * (1 + 1e-9)
    assert (after < before * (1 - 1e-9)) == (exchanged > 0)


@pytest.mark.parametrize("seed", range(6))
def test_elimination_drops_the_term_that_costs_least(seed: int) -> None:
    rng = np.random.default_rng(seed)
    columns = rng.normal(size=(14, 80)) + 0.8 * rng.normal(size=80)
    outputs = rng.normal(size=(2, 80))
    sweep = sweep_of(columns, outputs)
    forward(sweep, 9)
    nine = list(sweep.chosen)
    without = [residual(columns, outputs, [c for c in nine if c != k]) for k in nine]
    assert sweep.costs() == pytest.approx([left - residual(columns, outputs, nine) for left in without], rel=1e-6)
    backward(sweep, 8)
    assert residual(columns, outputs, sweep.chosen) == pytest.approx(min(without))
    backward(sweep, 20)
    assert len(sweep.chosen) == 8


def test_dependent_columns_are_not_chosen() -> None:
    """Copies, sums and a zero column add nothing: the forward search stops at the rank."""
    rng = np.random.default_rng(0)
    base = rng.normal(size=(6, 100))
    columns = np.vstack([base, 2 * base[:3], base[:1] + base[1:2], np.zeros((1, 100))])
    for rule in ("omp", "ols"):
        sweep = sweep_of(columns, rng.normal(size=(2, 100)))
        forward(sweep, 11, rule)
        assert len(sweep.chosen) == 6
        assert np.linalg.matrix_rank(columns[sweep.chosen]) == 6
        replace_terms(sweep)
        assert np.linalg.matrix_rank(columns[sweep.chosen]) == 6


@pytest.mark.parametrize("seed", range(3))
def test_nearly_parallel_variables_do_not_spoil_the_table(seed: int) -> None:
    """Columns that pass one by one, and together leave nothing but rounding of each other (Berk 1977).

    The residual told must be that of the chosen columns: planes of the light field are compared by it.
    """
    r = 2 * torch.rand((4, 400), generator=torch.Generator().manual_seed(seed), dtype=torch.float64) - 1
    p, u = r[:2] / 1.5, (r[:2] + 0.03 * r[2:]) / 1.5
    rays = LightField(p, u, torch.zeros(400, dtype=torch.float64))
    features = monomials(rays.invariants(), invariant_exponents(5, dispersive=False))
    outputs = r[2:] / (1 + (p * p).sum(0)).sqrt() + p * torch.exp(-(r[2:] ** 2).sum(0))
    columns, wanted = vector_columns(features, rays).numpy(), outputs.reshape(1, -1).numpy()
    unit = columns / np.linalg.norm(columns, axis=1, keepdims=True)
    found = []
    for terms in (10, 20, 40):
        sweep = Sweep(*vector_gram(features, rays, outputs[None]), (wanted**2).sum(1))
        for choose in (lambda s, t: forward(s, t + t // 2), backward, lambda s, t: replace_terms(s)):
            choose(sweep, terms)
            exact = residual(unit, wanted, sweep.chosen)
            assert sweep.residual == pytest.approx(exact, rel=5e-3)
            # By QR, what is left of each column beside the others.
            inverse = np.linalg.inv(np.linalg.qr(unit[sweep.chosen].T).R)
            assert 1 / (inverse**2).sum(1).max() > 0.5 * SPANNED
        found.append(exact)
    assert found == sorted(found, reverse=True)


# ---- bases ----


def field(count: int = 300) -> LightField:
    g = torch.Generator().manual_seed(0)
    u = 2 * torch.rand((5, count), generator=g, dtype=torch.float64) - 1
    return LightField(u[:2], u[2:4], u[4])


@pytest.mark.parametrize("degree", [0, 1, 3, 7])
def test_exponents_are_complete_and_unique(degree: int) -> None:
    """n over k counts of the monomials up to a total degree; without dispersion no wavelength occurs."""
    for exponents in (invariant_exponents(degree, dispersive=False), raw_exponents(degree, dispersive=False)):
        variables = exponents.shape[1] - 1
        assert len(exponents) == len({tuple(e) for e in exponents}) == math.comb(degree + variables, variables)
        assert (exponents[:, -1] == 0).all() and exponents.sum(1).max() == degree
    raw = raw_exponents(degree)
    assert len(raw) == len({tuple(e) for e in raw}) == math.comb(degree + 5, 5)
    coloured = invariant_exponents(degree)
    assert len(coloured) == len({tuple(e) for e in coloured}) and coloured[:, :3].sum(1).max() == degree


def test_solve_is_weighted_least_squares_and_survives_dependence() -> None:
    rng = np.random.default_rng(0)
    columns, outputs, weights = rng.normal(size=(5, 80)), rng.normal(size=(2, 80)), rng.uniform(0.1, 1, 80)
    expected = np.linalg.lstsq((columns * weights).T, (outputs * weights).T, rcond=None)[0].T
    found = solve(*(torch.from_numpy(a) for a in (columns, outputs, weights))).numpy()
    np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-12)
    twice = torch.from_numpy(np.vstack([columns, columns[:1], np.zeros((1, 80))]))
    shared = solve(twice, torch.from_numpy(outputs))
    assert torch.isfinite(shared).all() and shared.abs().max() < 10
    best = np.linalg.lstsq(columns.T, outputs.T, rcond=None)[0].T @ columns
    np.testing.assert_allclose((shared @ twice).numpy(), best, rtol=0, atol=1e-9)


def test_forward_omp_is_the_same_pursuit_as_scikit_learns() -> None:
    rng = np.random.default_rng(5)
    columns = rng.normal(size=(400, 40)) @ (np.eye(40) + 0.3 * rng.normal(size=(40, 40)))
    output = columns[:, [2, 11, 17, 30]] @ np.array([3.0, -2.0, 1.5, 0.7]) + 0.01 * rng.normal(size=400)
    gram, moments = columns.T @ columns, columns.T @ output
    sweep = Sweep(gram, moments[:, None], np.array([output @ output]))
    forward(sweep, 6, "omp")
    lengths = np.linalg.norm(columns, axis=0)
    found = linear_model.orthogonal_mp_gram(gram / np.outer(lengths, lengths), moments / lengths, n_nonzero_coefs=6)
    assert sorted(sweep.chosen) == np.flatnonzero(found).tolist()


def test_joined_problems_choose_by_the_sum_of_their_residuals() -> None:
    columns, outputs = correlated(7), np.random.default_rng(8).normal(size=(2, 400))
    halves = [np.s_[:200], np.s_[200:]]
    parts = [(columns[:, half], outputs[:, half]) for half in halves]
    joint = Sweep.joined([sweep_of(*part) for part in parts])
    forward(joint, 6)
    replace_terms(joint)
    unit = [c / np.linalg.norm(c, axis=1, keepdims=True) for c, _ in parts]
    assert joint.residual == pytest.approx(
        sum(residual(u, o, joint.chosen) for u, (_, o) in zip(unit, parts, strict=True))
    )
    gains = joint.scores("ols")
    best = int(gains.argmax())
    after = sum(residual(u, o, [*joint.chosen, best]) for u, (_, o) in zip(unit, parts, strict=True))
    assert gains[best] == pytest.approx(joint.residual - after, rel=1e-6)
