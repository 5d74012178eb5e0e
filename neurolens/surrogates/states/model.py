"""Surrogates of a lens in many states (zoom, internal focus): models of one structure at nodes, mixed between.

Every number of the model at a state is interpolated from the nodes (see `modelfile.axes`), so that the model at a state
is a plain `LensModel`, and everything that knows those knows this one. A core is linear in its numbers: its error at a
state is at most a small multiple (the Lebesgue constant) of the nodes' errors, plus that of interpolating the exact
lens itself.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, is_dataclass, replace
from typing import Any

import numpy as np

from neurolens.base.errors import InputError
from neurolens.modelfile import axes as ax
from neurolens.modelfile.states import mix_domain
from neurolens.surrogates.domain import Domain
from neurolens.surrogates.lightfield import Encoding
from neurolens.surrogates.model import LensModel
from neurolens.surrogates.states.space import StateSpace

State = tuple[float, ...]


@dataclass(frozen=True)
class StateModel:
    """Models at the nodes of one or more state axes.

    Attributes:
        space: the states, and the exact lens at each.
        nodes: one model a node, in the order of `modelfile.axes.product`; of one structure: they differ in numbers.
        fit_s: seconds that the whole fit took.
    """

    space: StateSpace
    nodes: tuple[LensModel, ...]
    fit_s: float = 0.0

    def __post_init__(self) -> None:
        count = len(ax.product(self.axes))
        if len(self.nodes) != count:
            raise InputError("state model", "nodes", f"({len(self.nodes)})", f"{count}, as many as the axes have")

    @property
    def axes(self) -> tuple[ax.Axis, ...]:
        """The state variables."""
        return self.space.axes

    @property
    def first_state(self) -> State:
        """The first end of every axis: what a model shows where no state is asked for."""
        return tuple(a.range[0] for a in self.axes)

    def at(self, *state: float) -> LensModel:
        """The model of one state.

        Raises:
            InputError: another number of values than axes, or one out of range.
        """
        w = ax.weights(self.axes, state)
        first = self.nodes[0]
        return replace(
            first,
            lens=self.space.lens_at(state),
            domain=Domain.from_dict(mix_domain([n.domain.to_dict() for n in self.nodes], w)),
            encoding=mix_encodings([n.encoding for n in self.nodes], w),
            core=mix([n.core for n in self.nodes], w),
            settings={**first.settings, "state": dict(zip((a.name for a in self.axes), state, strict=True))},
            fit_s=self.fit_s,
        )


def mix_encodings(encodings: Sequence[Encoding], weights: ax.Array) -> Encoding:
    """The encoding of a state: planes as they are, scales by their reciprocals, as the graph's matrices hold them."""

    def of(value: Callable[[Encoding], float]) -> float:
        return float(weights @ np.array([value(e) for e in encodings]))

    pupil_scale = 1 / of(lambda e: 1 / e.pupil_scale_mm)
    return replace(
        encodings[0],
        film_plane_z_mm=of(lambda e: e.film_plane_z_mm),
        pupil_plane_z_mm=of(lambda e: e.pupil_plane_z_mm),
        chief=pupil_scale * of(lambda e: e.chief / e.pupil_scale_mm),
        film_scale_mm=1 / of(lambda e: 1 / e.film_scale_mm),
        pupil_scale_mm=pupil_scale,
    )


def mix(values: Sequence[Any], weights: ax.Array) -> Any:
    """Weighted sum of float arrays wherever they stand in equal structures of dataclasses and tuples.

    Raises:
        InputError: structures that differ in anything but those numbers.
    """
    first = values[0]
    if isinstance(first, np.ndarray) and first.dtype.kind == "f":
        if any(v.shape != first.shape for v in values):
            raise InputError("state model", "nodes", [v.shape for v in values], "arrays of one shape")
        return np.einsum("k,k...->...", weights, np.stack(values))
    if is_dataclass(first) and not isinstance(first, type):
        names = [f.name for f in fields(first)]
        return replace(first, **{n: mix([getattr(v, n) for v in values], weights) for n in names})
    if isinstance(first, tuple):
        if any(len(v) != len(first) for v in values):
            raise InputError("state model", "nodes", [len(v) for v in values], "tuples of one length")
        return tuple(mix([v[i] for v in values], weights) for i in range(len(first)))
    if not all(np.array_equal(v, first) for v in values):
        raise InputError("state model", "nodes", f"({type(first).__name__})", "the same at every node")
    return first
