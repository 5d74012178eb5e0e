"""Boundaries: rims, missed surfaces and total reflection, in lenses where rays really end in each way."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path

import pytest
import torch
from lens_models import gated

from neurolens.base import status as st
from neurolens.base.errors import InputError
from neurolens.optics.lensfile import read_lens
from neurolens.surrogates.domain import domain_of, sample_domain
from neurolens.surrogates.export import export_onnx
from neurolens.surrogates.fit import ModelSettings, fit_model, prepare
from neurolens.surrogates.gates import boundary_rays, choose_gates, gate_reach, gate_values
from neurolens.surrogates.model import Gate, LensModel
from neurolens.surrogates.pairs import PairSet, PairSettings, make_pairs, reached, trace_pairs

LENSES = Path(__file__).parents[2] / "lenses"


@cache
def fresh(name: str) -> PairSet:
    pairs = gated(name).pairs
    return trace_pairs(pairs.lens, sample_domain(pairs.domain, 50_000, 77), pairs.domain.pupil_z_mm)


def false_passes(model: LensModel, rays: PairSet) -> float:
    passes = model.predict(rays.inputs).status == st.PASSED
    return float((passes & (rays.status != st.PASSED)).sum() / passes.sum())


def false_blocks(model: LensModel, rays: PairSet) -> float:
    passes = rays.status == st.PASSED
    return float((passes & (model.predict(rays.inputs).status != st.PASSED)).sum() / passes.sum())


def test_gates_are_found_where_rays_are_lost() -> None:
    """A singlet's corner rays are totally reflected at its front; half a ball is missed and reflects."""
    assert gated("singlet").gates == (Gate(2, st.RIM), Gate(1, st.RIM), Gate(1, st.TOTAL_REFLECTION))
    assert gated("hemisphere").gates == (Gate(2, st.MISSED), Gate(1, st.TOTAL_REFLECTION))
    assert gated("singlet").lost_share == 0
    assert gated("hemisphere").lost_share < 1e-4  # a few meet the far half of the ball


def test_where_no_ray_is_lost_there_are_rims_alone() -> None:
    lens = read_lens(LENSES / "thorlabs_lb1471_biconvex_50.toml")
    domain = domain_of(lens, film_radius_mm=15.0)
    known = prepare(make_pairs(lens, domain, PairSettings(train=500, held_out=10, rim=500)))
    assert {gate.reason for gate in known.gates} == {st.RIM}
    assert len(known.pairs.edge) == 0
    assert boundary_rays(known.pairs, known.gates) is known.pairs.rim


@pytest.mark.slow
@pytest.mark.parametrize("name", ["singlet", "hemisphere"])
@pytest.mark.parametrize(
    ("settings", "most"),
    [
        (ModelSettings("ols", terms=60, planes=False), 0.005),
        (ModelSettings("dense", basis="raw", degree=4), 0.03),
        (ModelSettings("mlp", units=12, steps=15), 0.03),
        (ModelSettings("thick"), 0.06),
    ],
    ids=lambda v: v.label if isinstance(v, ModelSettings) else "",
)
def test_lost_rays_no_longer_pass(name: str, settings: ModelSettings, most: float) -> None:
    known = gated(name)
    rims = tuple(gate for gate in known.gates if gate.reason == st.RIM)
    model, before = fit_model(known, settings), fit_model(replace(known, gates=rims), settings)
    rays = fresh(name)
    assert false_passes(model, rays) < min(most, 0.6 * false_passes(before, rays))
    assert false_blocks(model, rays) < false_blocks(before, rays) + most


@pytest.mark.slow
def test_zones_have_the_gates_too() -> None:
    model = fit_model(gated("singlet"), ModelSettings("ols", terms=30, partitions=2, planes=False))
    assert false_passes(model, fresh("singlet")) < 0.006


def test_two_gates_for_one_reason_on_a_surface_are_refused(tmp_path: Path) -> None:
    model = fit_model(gated("singlet"), ModelSettings("thick"))
    for twice in ((Gate(1, st.RIM),) * 3, (Gate(0, st.RIM), *model.gates[1:])):
        with pytest.raises(InputError, match="gates"):
            export_onnx(replace(model, gates=twice), tmp_path / "m.onnx")


@pytest.mark.parametrize("name", ["singlet", "hemisphere"])
def test_edge_rays_are_lost_and_finite(name: str) -> None:
    pairs = gated(name).pairs
    edge = pairs.edge
    assert 100 < len(edge) <= 5000
    assert not ((edge.meets > 0) & (edge.refracts > 0)).all(0).any()
    surfaces = torch.stack([edge.cross_x, edge.cross_y, edge.meets, edge.refracts])
    assert torch.isfinite(surfaces).all()
    assert (surfaces[:, ~reached(edge)] == 0).all()
    # What it says of a ray that gets somewhere is what tracing says.
    again = trace_pairs(pairs.lens, edge.inputs, pairs.domain.pupil_z_mm)
    assert torch.equal(reached(edge), reached(again))
    assert torch.equal(edge.refracts[reached(edge)], again.refracts[reached(edge)])


def test_gate_values_say_what_stopped_each_ray() -> None:
    known, rays = gated("hemisphere"), fresh("hemisphere")
    values, arrives = gate_values(known.pairs.lens, known.gates, rays), gate_reach(known.gates, rays)
    assert torch.isfinite(values).all() and (values[~arrives] == 0).all()
    for gate, value in zip(known.gates, values, strict=True):
        # But for the few that meet the far half of the ball.
        assert (value[rays.status == gate.status] >= 0).double().mean() > 0.999
        assert (value[rays.status == st.PASSED] < 0).all()


def test_only_rays_that_refract_all_the_way_choose_rims() -> None:
    """A lost ray's crossings beyond the place where it ended are no crossings."""
    pairs = gated("hemisphere").pairs
    lost = pairs.edge.select(slice(0, 500))
    wild = replace(lost, cross_x=lost.cross_x + 1e6 * ~reached(lost))
    assert {g.reason for g in choose_gates(pairs.lens, wild)} <= {st.MISSED, st.TOTAL_REFLECTION}
