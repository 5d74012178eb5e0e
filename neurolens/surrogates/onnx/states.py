"""ONNX graphs of models of many states: the graph of a node, whose constants follow the state.

The graph of every node is written by the same code. Constants that are equal at all nodes stay constants; all others
are rows of one small matrix product of the state's features (`neurolens.axes.Axis.features`), so that the state costs
a few operations a call and nothing a ray.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from onnx import NodeProto

from neurolens.axes import Axis
from neurolens.base.errors import InputError
from neurolens.base.files import atomic_path
from neurolens.modelfile import CARD_KEY
from neurolens.optics.focusing import at_infinity
from neurolens.optics.paraxial import first_order
from neurolens.surrogates.card import card_of, card_to_json, lens_facts, reference_rays
from neurolens.surrogates.model import LensModel
from neurolens.surrogates.onnx.export import INPUTS, OUTPUTS, add_model, check_gates, largest_angle
from neurolens.surrogates.onnx.graph import Graph
from neurolens.surrogates.onnx.light import DirectionSeries
from neurolens.surrogates.states.model import StateModel

STATE = "state"
# A film position that lies in no domain: where the state is out of range, this takes the place of the one asked for.
_NOWHERE = -1.0


def export_states(model: StateModel, path: str | Path, errors: dict[str, Any] | None = None) -> Path:
    """Write a model of many states with its card.

    As `export.export_onnx`, with one more input: state [A], a number for every axis, in its unit. A state out of range
    puts every ray outside the domain.

    Args:
        errors: held-out errors for the card, JSON-able.

    Raises:
        InputError: what `export.export_onnx` refuses, and nodes whose graphs differ in more than numbers.
    """
    check_gates(model.nodes[0])
    series = DirectionSeries(max(largest_angle(node, 8192) for node in model.nodes))
    graphs = []
    for node in model.nodes:
        graphs.append(_Recorder())
        add_model(graphs[-1], node, series)
    g = merged(graphs, model.axes)
    proto = g.model(
        [*INPUTS, (STATE, [len(model.axes)])], OUTPUTS, {CARD_KEY: card_to_json(state_card(model, errors or {}))}
    )
    target = Path(path)
    with atomic_path(target) as temporary:
        temporary.write_bytes(proto.SerializeToString())
    return target


def state_card(model: StateModel, errors: dict[str, Any]) -> dict[str, Any]:
    """The card of the model at its first state, with axes, nodes' lenses and domains, and more rays."""
    first = model.at(*model.first_state)
    card = card_of(first, errors)
    card["units"] = {**card["units"], STATE: [f"{a.name} {a.unit}" for a in model.axes]}
    card["states"] = {
        "axes": [a.to_dict() for a in model.axes],
        "default": list(model.first_state),
        "zoom": model.space.zoom,
        "f_number": model.space.f_number,
        "nodes": [{"lens": _lens_facts(node), "domain": node.domain.to_dict()} for node in model.nodes],
        "reference": [{"state": list(s), **reference_rays(model.at(*s), 8, 1)} for s in _between_nodes(model)],
    }
    return card


def _lens_facts(node: LensModel) -> dict[str, Any]:
    """The card's table of a node's lens; the f-number is that at infinity focus, as photographers count."""
    facts = lens_facts(node.lens, node.domain.film_z_mm[0])
    return {**facts, "f_number": float(first_order(at_infinity(node.lens)).f_number)}


def _between_nodes(model: StateModel) -> list[tuple[float, ...]]:
    """States at which a client may check itself: the far end, and two where no node is."""
    shares = ((0.31, 0.62), (0.77, 0.38))
    ends = [a.range for a in model.axes]
    inner = [tuple(lo + (hi - lo) * s for (lo, hi), s in zip(ends, share, strict=False)) for share in shares]
    return [tuple(hi for _, hi in ends), *(tuple(float(np.float32(v)) for v in s) for s in inner)]


class _Recorder(Graph):
    """A graph whose constants are named by the order in which they are asked for, none shared."""

    def __init__(self) -> None:
        super().__init__()
        self.values: list[NDArray[Any]] = []

    def const(self, value: ArrayLike, dtype: type = np.float32) -> str:
        """A constant, kept apart."""
        # In float64 until states are mixed; a number that float32 cannot hold is refused then.
        self.values.append(np.asarray(value, dtype=np.float64 if dtype is np.float32 else dtype))
        return f"c{len(self.values) - 1}"


def merged(graphs: Sequence[_Recorder], axes: Sequence[Axis]) -> Graph:
    """One graph of all nodes' graphs, with the input `state`.

    Raises:
        InputError: graphs that differ in their operators.
    """
    first = [n.SerializeToString() for n in graphs[0].nodes]
    if any([n.SerializeToString() for n in other.nodes] != first for other in graphs):
        raise InputError("export", "nodes", "(graphs that differ)", "models of one structure at every node")
    g = Graph()
    transform: NDArray[np.float64] = np.ones((1, 1))
    for axis in axes:
        transform = np.asarray(np.kron(transform, axis.to_features), dtype=np.float64)
    names: dict[str, str] = {}
    stacks: dict[bytes, tuple[NDArray[Any], tuple[int, ...], str]] = {}
    for i, values in enumerate(zip(*(g.values for g in graphs), strict=True)):
        if all(np.array_equal(v, values[0]) for v in values):
            names[f"c{i}"] = g.const(values[0], np.int64 if values[0].dtype.kind == "i" else np.float32)
            continue
        if values[0].dtype.kind == "i":
            raise InputError("export", "nodes", "(graphs that differ)", "models of one structure at every node")
        rows = transform @ np.stack([v.ravel() for v in values])
        key = rows.tobytes() + repr(values[0].shape).encode()
        names[f"c{i}"] = stacks.setdefault(key, (rows, values[0].shape, f"state_c{len(stacks)}"))[2]
    _add_constants(g, axes, list(stacks.values()))
    names["film_z_mm"] = _guarded_film(g, axes)
    for node in graphs[0].nodes:
        copy = NodeProto()
        copy.CopyFrom(node)
        copy.name = f"n{len(g.nodes)}"
        for k, name in enumerate(node.input):
            copy.input[k] = names.get(name, name)
        g.nodes.append(copy)
    return g


def _add_constants(g: Graph, axes: Sequence[Axis], stacks: list[tuple[NDArray[Any], tuple[int, ...], str]]) -> None:
    """What the state changes: all in one product, cut and shaped."""
    if not stacks:
        return
    row = g.op("MatMul", _features(g, axes), g.const(np.concatenate([rows for rows, _, _ in stacks], axis=1)))
    flat = g.reshape(row, [-1], out="state_row")
    sizes = [rows.shape[1] for rows, _, _ in stacks]
    parts = [flat]
    if len(stacks) > 1:
        parts = [f"state_part_{i}" for i in range(len(stacks))]
        g.nodes.append(_split(flat, g.const(sizes, np.int64), parts, len(g.nodes)))
    for part, (_, shape, name) in zip(parts, stacks, strict=True):
        g.reshape(part, shape, out=name)


def _split(value: str, sizes: str, parts: list[str], number: int) -> NodeProto:
    return NodeProto(op_type="Split", input=[value, sizes], output=parts, name=f"n{number}")


def _features(g: Graph, axes: Sequence[Axis]) -> str:
    """[1, K] features of the state, those of the last axis fastest."""
    values = [STATE]
    if len(axes) > 1:
        values = [f"state_{a.name}" for a in axes]
        g.nodes.append(_split(STATE, g.const([1] * len(axes), np.int64), values, len(g.nodes)))
    found = ""
    for axis, value in zip(axes, values, strict=True):
        own = _axis_features(g, axis, value)
        if not found:
            found = g.reshape(own, [1, -1], out=f"state_features_{axis.name}")
        else:
            column = g.reshape(found, [-1, 1], out=f"state_column_{axis.name}")
            row = g.reshape(own, [1, -1], out=f"state_row_{axis.name}")
            both = g.op("Mul", column, row, out=f"state_both_{axis.name}")
            found = g.reshape(both, [1, -1], out=f"state_features_{axis.name}")
    return found


def _axis_features(g: Graph, axis: Axis, value: str) -> str:
    """[K]: as `Axis.features`, T_j by their recurrence."""

    def op(kind: str, *inputs: str) -> str:
        return g.op(kind, *inputs, out=f"state_{axis.name}_{len(g.nodes)}")

    factor, offset = axis.pieces
    coordinate = op("Reciprocal", value) if axis.reciprocal else value
    t = op("Add", op("Mul", coordinate, g.const(factor)), g.const(offset))
    t = op("Clip", t, g.const(-1.0), g.const(1.0))
    chebyshev = [g.const(np.ones_like(factor)), t]
    twice = op("Add", t, t)
    for _ in range(2, axis.degree + 1):
        chebyshev.append(op("Sub", op("Mul", twice, chebyshev[-1]), chebyshev[-2]))
    shifted = [op("Add", c, g.const(-((-1.0) ** j))) for j, c in enumerate(chebyshev) if j > 0]
    return g.op("Concat", g.const([1.0]), *shifted, out=f"state_{axis.name}_all", axis=0)


def _guarded_film(g: Graph, axes: Sequence[Axis]) -> str:
    """film_z_mm [1], or a place in no domain where the state is out of range; comparisons that NaN fails."""
    low, high = (np.array(v) for v in zip(*(a.limits for a in axes), strict=True))
    below = g.op("LessOrEqual", STATE, g.const(high), out="state_below")
    above = g.op("GreaterOrEqual", STATE, g.const(low), out="state_above")
    inside = g.op("Cast", g.op("And", below, above, out="state_within"), out="state_number", to=1)
    if len(axes) > 1:
        inside = g.op("ReduceSum", inside, out="state_axes_within", keepdims=1)
    all_axes = g.op("Greater", inside, g.const([len(axes) - 0.5]), out="state_inside")
    return g.op("Where", all_axes, "film_z_mm", g.const([_NOWHERE]), out="state_film_z_mm")
