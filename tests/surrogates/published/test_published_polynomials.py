"""Dense and sparse published polynomials: frame, choice of terms, tests of who passes, graphs."""

from __future__ import annotations

import itertools
from dataclasses import replace

import lens_models
import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as some

from neurolens.base import status as st
from neurolens.base.errors import InputError
from neurolens.evaluate.rays import ray_errors
from neurolens.graph.interpret import evaluate
from neurolens.graph.ir import Graph
from neurolens.surrogates.domain import sample_domain
from neurolens.surrogates.fit import ModelSettings, fit_model
from neurolens.surrogates.lightfield import fit_encoding
from neurolens.surrogates.pairs import trace_pairs
from neurolens.surrogates.published.data import (
    PARITY,
    RawData,
    from_tangents,
    parity_exponents,
    slope_encoding,
    to_tangents,
)
from neurolens.surrogates.published.polynomials import Pursuit

FAST = {
    "dense": ModelSettings("hanika", basis="raw", degree=3),
    "sparse": ModelSettings("schrade", basis="raw", degree=5, terms=12),
}


@given(some.floats(-0.9, 0.9), some.floats(-0.4, 0.4), some.floats(-1, 1), some.floats(-1, 1), some.floats(-0.99, 0.99))
def test_tangents_and_back_is_the_same_direction(x: float, y: float, a: float, b: float, c: float) -> None:
    # The normal of the sphere towards the scene, and any direction within 90 degrees of it.
    normal = torch.tensor([c * x, c * y, -((1 - (c * x) ** 2 - (c * y) ** 2) ** 0.5)], dtype=torch.float64)
    across = torch.linalg.cross(normal, torch.tensor([0.6, 0.0, 0.8], dtype=torch.float64))
    direction = normal + a * across + b * torch.linalg.cross(normal, across)
    direction = (direction / direction.norm())[:, None]
    position, g = torch.tensor([[x], [y]], dtype=torch.float64), Graph()
    tangents = to_tangents(position, list(direction), c)
    assert float(tangents.norm()) == pytest.approx(float(torch.linalg.cross(direction[:, 0], normal).norm()), abs=1e-12)
    g.outputs["d"] = from_tangents(g.input("position", 2), g.input("tangents", 2), c)
    back = evaluate(g, {"position": position, "tangents": tangents})["d"]
    torch.testing.assert_close(back, direction, rtol=0, atol=1e-12)


def test_raw_coordinates_are_position_and_slope() -> None:
    pairs = lens_models.prepared().pairs
    encoding = slope_encoding(lens_models.prepared().encoding, pairs.train)
    rays = pairs.train.inputs
    rise = (rays.pupil_x - rays.film_x) / (encoding.pupil_plane_z_mm - rays.film_z)
    u = encoding(rays).u[0]
    assert torch.allclose(u / rise, (u / rise)[0].expand_as(u), rtol=1e-9)


def test_lenses_with_cylinders_are_refused() -> None:
    prepared = lens_models.prepared()
    encoding = fit_encoding(prepared.pairs.domain, prepared.pairs.train, mirror=True)
    with pytest.raises(InputError, match="round about its axis"):
        RawData.of(replace(prepared, encoding=encoding))


def test_parity_splits_all_raw_terms() -> None:
    every = [parity_exponents(5, odd, dispersive=True) for odd in itertools.product((0, 1), repeat=2)]
    rows = {tuple(map(int, r)) for part in every for r in part}
    assert len(rows) == sum(map(len, every)) == 252  # binomial(5 + 5, 5)
    assert set(PARITY) == {(1, 0), (0, 1), (0, 0)}


def test_pursuit_finds_the_terms_that_made_the_target() -> None:
    generator = np.random.default_rng(0)
    x = generator.uniform(-1, 1, (2, 400))
    columns = np.array([x[0] ** i * x[1] ** j for i in range(6) for j in range(6)])
    made_of = [3, 10, 17, 22, 35]
    target = generator.uniform(1, 2, 5) @ columns[made_of]
    pursuit = Pursuit(columns, target)
    assert pursuit.run(5) == made_of
    assert pursuit.error() < 1e-16 * (target @ target)


def test_pursuit_adds_the_term_that_leaves_least_and_replacement_only_helps() -> None:
    generator = np.random.default_rng(1)
    columns = generator.normal(size=(14, 60)) + generator.normal(size=60)  # strongly correlated candidates
    target = generator.normal(size=60)

    def left(chosen: list[int]) -> float:
        fit, *_ = np.linalg.lstsq(columns[chosen].T, target, rcond=None)
        return float(((columns[chosen].T @ fit - target) ** 2).sum())

    greedy: list[int] = []
    for _ in range(4):
        greedy.append(min((k for k in range(14) if k not in greedy), key=lambda k: left([*greedy, k])))
    plain = Pursuit(columns, target)
    assert plain.run(4, passes=0) == sorted(greedy)
    assert plain.error() == pytest.approx(left(greedy), rel=1e-9)
    exchanged = Pursuit(columns, target)
    chosen = exchanged.run(4)
    assert exchanged.error() == pytest.approx(left(chosen), rel=1e-9)
    assert left(chosen) <= left(greedy) * (1 + 1e-12)
    # No single exchange helps any more.
    for k in chosen:
        rest = [c for c in chosen if c != k]
        assert min(left([*rest, c]) for c in range(14) if c not in rest) >= left(chosen) * (1 - 1e-6)


def test_more_terms_and_degrees_leave_less() -> None:
    prepared = lens_models.prepared()
    pairs = prepared.pairs

    def rms_deg(settings: ModelSettings) -> float:
        model = fit_model(prepared, settings)
        return ray_errors(pairs.lens, pairs.domain, pairs.held_out, model.predict).direction_rms_deg

    dense = [rms_deg(ModelSettings("hanika", basis="raw", degree=degree)) for degree in (1, 3, 5)]
    sparse = [rms_deg(ModelSettings("schrade", basis="raw", degree=5, terms=terms)) for terms in (4, 12, 32)]
    assert dense[0] > 2 * dense[1] > 4 * dense[2]
    assert sparse[0] > 2 * sparse[1] > 4 * sparse[2]


@pytest.mark.parametrize("label", FAST)
def test_pupil_tests_are_those_of_the_exact_rims(label: str) -> None:
    """The tests of the outer and the inner pupil stop a ray where it crosses those rims outside, bar their fit."""
    prepared = lens_models.prepared()
    pairs, lens = prepared.pairs, prepared.pairs.lens
    model = fit_model(prepared, FAST[label])
    last = len(lens.surfaces) - 1
    assert [g.surface for g in model.gates] == [last, 0]
    rays = trace_pairs(lens, sample_domain(pairs.domain, 4000, 3), pairs.domain.pupil_z_mm)
    _, scalars = model.core(model.encoding(rays.inputs))
    for gate, values in zip(model.gates, scalars[1:], strict=True):
        radius = lens.surfaces[gate.surface].semi_diameter_mm
        exact = (rays.cross_x[gate.surface] ** 2 + rays.cross_y[gate.surface] ** 2) / radius**2 - 1
        known = (rays.status == st.PASSED) | (rays.status % 4 == st.RIM)
        clear = known & (exact.abs() > 0.15)  # the inner pupil is a disc in the vertex's plane
        assert float(((values > 0) == (exact > 0))[clear].double().mean()) > 0.995
