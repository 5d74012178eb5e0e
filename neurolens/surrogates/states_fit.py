"""Fitting models of many states: one support for all nodes, the same gates, coefficients of each node on its own rays.

The nodes' coefficients need not vary smoothly themselves, for a core is linear in them: what is mixed between nodes is
the functions. Measured on three zooms: between nodes the error is that at the nodes, and at most doubles.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace

import numpy as np

from neurolens.base.errors import InputError
from neurolens.surrogates import axes as ax
from neurolens.surrogates.bases import (
    Exponents,
    invariant_exponents,
    kept,
    monomials,
    pinned_threads,
    solve,
    vector_columns,
)
from neurolens.surrogates.cores import STOP
from neurolens.surrogates.fit import prepare
from neurolens.surrogates.fits.boundaries import invariant_core
from neurolens.surrogates.fits.selection import JointSweep, Sweep, forward, replace_terms
from neurolens.surrogates.model import Encoding, LensModel, Scales
from neurolens.surrogates.pairs import PairSettings, RayPairs, make_pairs, with_angle
from neurolens.surrogates.states import State, StateModel, StateSpace
from neurolens.surrogates.targets import Prepared, film_equivalent, fit_encoding, scales_of

# Nodes that choose the support and the gates; the others only fit coefficients.
_CHOOSERS = 7
_PASSES = 2  # of replacement


@dataclass(frozen=True)
class StateSettings:
    """How a model of many states is fitted: see `ModelSettings`; rays are those of each node."""

    terms: int = 64
    degree: int = 7
    rays: int = 20_000
    seed: int = 1
    name: str = ""

    @property
    def label(self) -> str:
        return self.name or f"states-{self.terms}"


def fit_states(
    space: StateSpace, settings: StateSettings | None = None, progress: Callable[[float], None] | None = None
) -> StateModel:
    """Fit a model of all states of a space.

    Args:
        progress: told the share done.

    Raises:
        InputError: what `pairs.make_pairs` refuses at a node; fewer than two terms.
    """
    settings, start = settings or StateSettings(), time.perf_counter()
    if space.lens.anamorphic:
        raise InputError(space.lens.path, "surfaces", "(cylinders)", "a lens that is round about its axis, for states")
    if not 2 <= settings.terms < settings.rays:
        raise InputError("fit", "terms", settings.terms, f"from 2 to fewer than the {settings.rays} rays of a node")
    states = ax.product(space.axes)
    with pinned_threads():
        choosers = sorted({round(float(k)) for k in np.linspace(0, len(states) - 1, _CHOOSERS)})
        known: dict[int, Prepared] = {}
        for done, k in enumerate(choosers):
            known[k] = prepare(_pairs(space, states[k], settings))
            if progress:
                progress(0.3 * (done + 1) / len(choosers))
        # Every gate that any node needs, in the order in which camera rays meet them.
        needed = {g for p in known.values() for g in p.gates}
        gates = tuple(sorted(needed, key=lambda g: (-g.surface, g.reason)))
        scales = common_encoding([d.encoding for d in known.values()])
        known = {k: replace(d, encoding=_scaled_like(scales, d.encoding)) for k, d in known.items()}
        stop_mm = max(d.pairs.lens.stop_radius_mm for d in known.values())
        exponents, columns = choose_jointly(list(known.values()), settings)
        nodes = []
        for k, state in enumerate(states):
            if k in known:
                data = replace(known.pop(k), gates=gates)
            else:
                pairs = _pairs(space, state, settings)
                data = Prepared(pairs, _scaled_like(scales, fit_encoding(pairs.domain, pairs.train)), gates)
            nodes.append(_fit_node(data, exponents, columns, stop_mm, settings))
            if progress:
                progress(0.4 + 0.6 * (k + 1) / len(states))
    return StateModel(space, tuple(nodes), time.perf_counter() - start)


def _pairs(space: StateSpace, state: State, settings: StateSettings) -> RayPairs:
    lens, domain = space.lens_at(state), space.domain_at(state)
    return make_pairs(lens, domain, PairSettings(settings.rays, 1, settings.rays, settings.seed))


def common_encoding(found: Sequence[Encoding]) -> Encoding:
    """Scales and chief ray for all nodes: the largest, and the mean.

    A node's own scales follow its domain, which need not be smooth in the state; nor would be the lens in them.
    """
    return replace(
        found[0],
        chief=sum(e.chief for e in found) / len(found),
        film_scale_mm=max(e.film_scale_mm for e in found),
        pupil_scale_mm=max(e.pupil_scale_mm for e in found),
    )


def _scaled_like(scales: Encoding, own: Encoding) -> Encoding:
    """The planes of a node with the scales of all."""
    return replace(scales, film_plane_z_mm=own.film_plane_z_mm, pupil_plane_z_mm=own.pupil_plane_z_mm)


def choose_jointly(data: Sequence[Prepared], settings: StateSettings) -> tuple[Exponents, list[int]]:
    """One support for all nodes: orthogonal least squares by the sum of the nodes' gains, then replacement.

    Returns the exponents [M, 4] kept and the columns of `bases.vector_columns` chosen among them (m p, then m u).
    """
    dispersive = data[0].encoding.dispersive
    exponents = invariant_exponents(settings.degree, dispersive=dispersive)
    sweeps = []
    for d in data:
        train = d.train
        outputs = film_equivalent(d.pairs.lens, d.pairs.domain, train.vectors)
        sweeps.append(Sweep.of_vectors(monomials(train.field.invariants(), exponents), train.field, outputs))
    joint = JointSweep(sweeps)
    forward(joint, settings.terms)
    replace_terms(joint, _PASSES)
    return kept(exponents, sorted(joint.chosen))


def _fit_node(
    data: Prepared, exponents: Exponents, columns: list[int], stop_mm: float, settings: StateSettings
) -> LensModel:
    """The model of one node; its stop crossing is in units of `stop_mm`, the same at every node."""
    pairs, train, scales = data.pairs, data.train, scales_of(data.pairs.lens)
    vectors = vector_columns(monomials(train.field.invariants(), exponents), train.field)[columns]
    core = invariant_core(data, exponents, columns, solve(vectors, train.vectors[:STOP].flatten(1)))
    core.ab[STOP] *= scales.stop_mm / stop_mm
    model = LensModel(
        lens=pairs.lens,
        domain=pairs.domain,
        encoding=data.encoding,
        scales=Scales(scales.position_mm, stop_mm),
        gates=data.gates,
        core=core,
        method=settings.label,
        settings={"method": "ols", **asdict(settings), "rays_seed": settings.seed},
    )
    return with_angle(model)
