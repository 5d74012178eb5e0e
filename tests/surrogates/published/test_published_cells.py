"""Cells of the light field (Zheng and Zheng 2017, both papers): grown polynomials and averaged networks."""

from __future__ import annotations

from dataclasses import replace

import lens_models
import numpy as np
import pytest
import torch
from torch import Tensor

from neurolens.base import status as st
from neurolens.base.errors import InputError
from neurolens.evaluate.rays import ray_errors
from neurolens.surrogates.cores import RawPolynomial
from neurolens.surrogates.domain import sample_domain
from neurolens.surrogates.fit import ModelSettings, fit_model
from neurolens.surrogates.lightfield import LightField
from neurolens.surrogates.model import LensModel
from neurolens.surrogates.pairs import trace_pairs
from neurolens.surrogates.published.adaptive import Cells, fit_adaptive
from neurolens.surrogates.published.data import RawData
from neurolens.surrogates.published.neural import Averaged, Layers

NETWORKS = ModelSettings("neurolens2017", basis="raw", units=16, layers=2, steps=60, partitions=2)


def rms_um(model: LensModel) -> float:
    pairs = lens_models.prepared().pairs
    return ray_errors(pairs.lens, pairs.domain, pairs.held_out, model.predict).rms_um


def leaves(core: RawPolynomial | Cells) -> list[RawPolynomial]:
    return [leaf for half in core.parts for leaf in leaves(half)] if isinstance(core, Cells) else [core]


def rays_of(count: int = 400) -> LightField:
    generator = torch.Generator().manual_seed(1)
    p, u = (torch.rand((2, count), generator=generator, dtype=torch.float64) - 0.5 for _ in range(2))
    return LightField(p, u, torch.zeros(count, dtype=torch.float64))


def test_cells_give_each_ray_the_polynomial_of_its_cell() -> None:
    data = RawData.of(lens_models.prepared())
    core = fit_adaptive(data, 6, 3)
    assert isinstance(core, Cells)
    assert len(leaves(core)) == 3
    field = rays_of()

    def by_hand(node: RawPolynomial | Cells, at: Tensor) -> Tensor:
        one = LightField(field.p[:, at], field.u[:, at], field.w[at])
        if isinstance(node, RawPolynomial):
            return node(one)[0]
        above = float(one.invariants()[node.variable]) > node.threshold
        return by_hand(node.parts[int(above)], at)

    vectors, _ = core(field)
    for k in range(0, 400, 13):
        assert torch.allclose(vectors[..., k : k + 1], by_hand(core, torch.tensor([k])), atol=1e-13)


def test_cells_and_terms_leave_less() -> None:
    few, more, cells = (
        fit_model(lens_models.prepared(), ModelSettings("zheng-adaptive", basis="raw", terms=terms, partitions=zones))
        for terms, zones in ((6, 1), (16, 1), (16, 2))
    )
    assert rms_um(few) > 2 * rms_um(more)
    assert rms_um(more) > 1.1 * rms_um(cells)


def test_growth_reaches_degrees_that_no_list_of_candidates_was_cut_at() -> None:
    prepared = lens_models.prepared()
    polynomial = fit_adaptive(RawData.of(prepared), 24, 1)
    assert isinstance(polynomial, RawPolynomial)
    used = polynomial.components[:2].reshape(4, -1) != 0
    assert int(polynomial.exponents[used.any(0)].sum(1).max()) >= 5


@pytest.mark.parametrize("method", ("zheng-adaptive", "neurolens2017"))
def test_more_cells_than_rays_allow_are_refused(method: str) -> None:
    settings = ModelSettings(method, basis="raw", terms=4, partitions=64)  # type: ignore[arg-type]
    with pytest.raises(InputError, match="partitions"):
        fit_model(lens_models.prepared(), settings)


def by_hand(layers: Layers, h: np.ndarray) -> np.ndarray:
    """[7, N] of one network."""
    for k, (weight, bias) in enumerate(layers):
        h = weight @ h + bias[:, None]
        h = h if k == len(layers) - 1 else np.maximum(h, 0)
    return h


def test_networks_are_averaged_and_chosen_by_film_radius() -> None:
    model = fit_model(lens_models.prepared(), NETWORKS)
    core = model.core
    assert isinstance(core, Averaged)
    assert [len(ring) for ring in core.networks] == [3, 3]
    assert len(core.edges) == 1
    field, edge = rays_of(), core.edges[0]
    inputs = torch.cat([field.p, field.u, field.w[None]]).numpy()
    ring = (field.invariants()[0].numpy() > edge).astype(int)
    assert set(ring) == {0, 1}
    means = np.stack([np.mean([by_hand(net, inputs) for net in nets], axis=0) for nets in core.networks])
    wanted = np.take_along_axis(means, ring[None, None], axis=0)[0]
    vectors, scalars = core(field)
    np.testing.assert_allclose(vectors[0], wanted[:2], atol=1e-12)
    np.testing.assert_allclose(scalars, [wanted[2], 0.5 - wanted[6]], atol=1e-12)
    # The seed makes the weights, and another seed others.
    again, other = (fit_model(lens_models.prepared(), replace(NETWORKS, seed=s)).core for s in (0, 1))
    assert isinstance(again, Averaged)
    assert isinstance(other, Averaged)
    assert np.array_equal(again.networks[1][2][0][0], core.networks[1][2][0][0])
    assert not np.array_equal(other.networks[1][2][0][0], core.networks[1][2][0][0])


def test_networks_learn_rays_and_who_passes() -> None:
    prepared = lens_models.prepared()
    short, longer = (
        fit_model(prepared, replace(NETWORKS, units=32, partitions=1, steps=steps)) for steps in (30, 1500)
    )
    assert rms_um(short) > 2 * rms_um(longer)
    pairs = prepared.pairs
    rays = trace_pairs(pairs.lens, sample_domain(pairs.domain, 8000, 9), pairs.domain.pupil_z_mm)
    right = (longer.predict(rays.inputs).status == st.PASSED) == (rays.status == st.PASSED)
    assert float(right.double().mean()) > 0.9
