"""The graph of an exported model, read back from its file: what fused cameras are made of.

Rays lie on the last axis of everything in a file, so tensors for one ray, their numbers as rows, are the graph. Truth
values are 0 and 1. Only what `onnxfile.read_checked` has checked comes here; it needs no torch and no onnx.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import reduce
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from neurolens.base.errors import InputError
from neurolens.graph.interpret import evaluate
from neurolens.graph.ir import Graph, Value
from neurolens.modelfile.onnxfile import constants_and_nodes
from neurolens.modelfile.shapes import Node

Array = NDArray[Any]
# The largest model that ships takes 2900. Compilers take longer than in proportion: gcc 12 2.4 s for 1500 steps, 6 s
# for 2900, 19 s for 4700, 48 s for 7100.
MAX_STEPS = 8000
_TANH = 16  # steps, as `Program.tanh` writes it
_MAX_MOVED = 50 * MAX_STEPS  # numbers taken by operators: those that only move them make no steps, but cost time, too
_MAX_CONSTANT = 2_000_000  # numbers
_WHOLE = (6, 7)  # TensorProto.DataType of integers


@dataclass(frozen=True)
class _Tensor:
    """What depends on the ray or the call: at every place of its shape, a row of a value."""

    value: Value
    rows: Array

    @property
    def shape(self) -> tuple[int, ...]:
        return self.rows.shape

    @property
    def size(self) -> int:
        return self.rows.size

    def column(self) -> Value:
        """Rows of all places in order."""
        return self.value[self.rows.ravel().tolist()]

    def wide(self, shape: tuple[int, ...]) -> Value:
        """Rows of the places of a shape that this is broadcast to, or one row that stands for all."""
        rows = np.broadcast_to(self.rows, shape).ravel()
        return self.value[int(rows[0])] if (rows == rows[0]).all() else self.value[rows.tolist()]


def graph_of(path: str | Path, data: bytes, state: Sequence[float] = ()) -> Graph:
    """The graph of a model, with the inputs and outputs of a lens's graph.

    Args:
        path: of the model, for errors. data: its bytes, as `read_checked` gives them.
        state: of a model of many states, the one wanted: it is folded into the numbers.

    Raises:
        InputError: an operator that has no such form, or a graph of more than `MAX_STEPS`.
    """
    constants, nodes = constants_and_nodes(data)
    reader = _Reader()
    g = reader.graph
    known: dict[str, Array | _Tensor] = dict(constants)
    known["rays"] = _Tensor(g.input("rays", 5), np.arange(5)[:, None])
    for name in ("film_z_mm", "stop_radius_mm"):
        known[name] = _Tensor(g.input(name, per_call=True), np.zeros(1, int))
    known["state"] = np.array(state, np.float32)
    for node in nodes:
        given = [known[name] for name in node.inputs]
        try:
            made = reader.made(path, node, given)
        except InputError:
            raise
        except (ValueError, IndexError, TypeError) as error:
            raise InputError(path, "graph", f"(operator {node.kind}: {error})", "one that works ray by ray") from error
        known.update(zip(node.outputs, made, strict=True))
        reader.moved += sum(a.size for a in given if isinstance(a, _Tensor))
        if reader.steps > MAX_STEPS or reader.moved > _MAX_MOVED:
            raise InputError(path, "graph", f"(more than {MAX_STEPS} steps)", "a smaller model, or onnxruntime for it")
    for name in ("scene_ray", "transmittance", "stop_xy_mm", "status"):
        g.outputs[name] = reader.tensor(known[name]).column()
    return g


class _Reader:
    """Operators of ONNX appended to a graph; what is constant stays numbers.

    Attributes:
        steps: made so far, about as many as C will have. moved: numbers taken by operators.
    """

    def __init__(self) -> None:
        self.graph = Graph()
        self.steps = self.moved = 0

    def made(self, path: str | Path, node: Node, given: list[Array | _Tensor]) -> list[Array | _Tensor]:
        """Outputs of a node."""
        kind, axis = node.kind, node.attributes.get("axis", 0)
        first, places = given[0], _places(given[0])
        if kind == "Concat":
            return [self._concat(given, axis)]
        if kind == "Gather":
            return [_taken(first, np.take(places, _integers(given[1]), axis))]
        if kind == "Split":
            return [_taken(first, part) for part in np.split(places, np.cumsum(_integers(given[1]))[:-1], axis)]
        if kind == "Reshape":
            return [_taken(first, places.reshape(_integers(given[1])))]
        if kind == "ReduceSum":
            axes = _integers(given[1]) if len(given) > 1 else range(len(first.shape))
            return [self._sum(first, [int(v) for v in axes], bool(node.attributes.get("keepdims", 1)))]
        if kind in ("MatMul", "Gemm"):
            return [self._product(*given)]
        constants = _numbers(given)
        if kind in ("Cast", "DequantizeLinear") and constants is not None:
            return [_constant(kind, axis, constants)]
        if kind == "Cast":
            # To integers: only the status, which is whole.
            rule = Value.whole if node.attributes.get("to") in _WHOLE else _ELEMENTWISE["Identity"]
        elif kind in _ELEMENTWISE:
            rule = _ELEMENTWISE[kind]
        else:
            raise InputError(path, "operator", kind, "one that fused cameras know: use onnxruntime for this model")
        return [self._each(rule, *given, cost=_TANH if kind == "Tanh" else max(1, len(given) - 1))]

    def tensor(self, a: Array | _Tensor) -> _Tensor:
        if isinstance(a, _Tensor):
            return a
        _check_room(a.size)
        return _Tensor(self.graph.constant(a.ravel()), np.arange(a.size).reshape(a.shape))

    def _each(self, operation: Callable[..., Value], *given: Array | _Tensor, cost: int = 1) -> Array | _Tensor:
        shape = np.broadcast_shapes(*(a.shape for a in given))
        numbers = _numbers(given)
        _check_room(math.prod(shape), MAX_STEPS if numbers is None else _MAX_CONSTANT)
        if numbers is not None:
            return _folded(operation, shape, numbers)
        self.steps += cost * math.prod(shape)
        value = operation(*(self.tensor(a).wide(shape) for a in given))
        places = np.arange(math.prod(shape)) if value.rows > 1 else np.zeros(math.prod(shape), int)
        return _Tensor(value, places.reshape(shape))

    def _concat(self, given: list[Array | _Tensor], axis: int) -> Array | _Tensor:
        numbers = _numbers(given)
        if numbers is not None:
            return np.concatenate(numbers, axis)
        parts = [self.tensor(a) for a in given]
        ends = np.cumsum([0, *(p.size for p in parts)])
        places = [n + np.arange(p.size).reshape(p.shape) for n, p in zip(ends, parts, strict=False)]
        return _Tensor(self.graph.concat(*(p.column() for p in parts)), np.concatenate(places, axis))

    def _sum(self, array: Array | _Tensor, axes: list[int], keepdims: bool) -> Array | _Tensor:
        for axis in sorted((range(len(array.shape))[a] for a in axes), reverse=True):
            terms = [_taken(array, part) for part in np.split(_places(array), array.shape[axis], axis)]
            array = reduce(lambda a, b: self._each(Value.__add__, a, b), terms)
            array = array if keepdims else _taken(array, np.squeeze(_places(array), axis))
        return array

    def _product(self, weight: Array | _Tensor, x: Array | _Tensor, *bias: Array | _Tensor) -> Array | _Tensor:
        """weight [R, K] times x [K, 1], plus bias [R, 1] or [1, 1]."""
        rows, columns = weight.shape
        numbers = _numbers((weight, x, *bias))
        _check_room(rows * x.size, MAX_STEPS if numbers is None else _MAX_CONSTANT)
        if numbers is not None:
            return sum(numbers[2:], numbers[0].astype(np.float64) @ numbers[1])
        if x.shape != (columns, 1):
            raise ValueError(f"{weight.shape} times {x.shape}")
        self.steps += rows * columns
        places, vector = np.arange(rows)[:, None], self.tensor(x).column()
        start = bias[0] if bias else np.zeros((1, 1))
        if isinstance(weight, _Tensor):
            total = self.tensor(start).wide((rows, 1))
            for k in range(columns):
                total = _Tensor(weight.value, weight.rows[:, k]).column() * vector[k] + total
        elif isinstance(start, _Tensor):
            added = _Tensor(start.value, np.broadcast_to(start.rows, (rows, 1))).column()
            total = self.graph.affine(weight, vector, added=added)
        else:
            total = self.graph.affine(weight, vector, np.broadcast_to(start, (rows, 1))[:, 0])
        return _Tensor(total, places)


def _numbers(given: Sequence[Array | _Tensor]) -> list[Array] | None:
    """These arrays, where all are numbers."""
    found = [a for a in given if not isinstance(a, _Tensor)]
    return found if len(found) == len(given) else None


def _places(array: Array | _Tensor) -> Array:
    """Numbers of the places of an array, in its shape."""
    return np.arange(math.prod(array.shape)).reshape(array.shape)


def _taken(array: Array | _Tensor, places: Array) -> Array | _Tensor:
    """What stands at these places of an array."""
    if isinstance(array, _Tensor):
        return _Tensor(array.value, array.rows.ravel()[places])
    return array.ravel()[places]


def _integers(array: Array | _Tensor) -> NDArray[np.intp]:
    if isinstance(array, _Tensor):
        raise ValueError("places that depend on the ray")
    return array.astype(np.intp)


def _folded(operation: Callable[..., Value], shape: tuple[int, ...], given: Sequence[Array]) -> Array:
    """An operation on numbers, in float64."""
    g = Graph()
    names = [str(k) for k in range(len(given))]
    g.outputs["y"] = operation(*(g.input(name) for name in names))
    inputs = {n: np.broadcast_to(a, shape).reshape(1, -1).astype(np.float64) for n, a in zip(names, given, strict=True)}
    found: Array = np.broadcast_to(evaluate(g, inputs)["y"], (1, math.prod(shape))).reshape(shape)
    return found


def _check_room(steps: int, most: int = MAX_STEPS) -> None:
    """Before memory is taken: a few numbers can ask for as many steps as the product of their counts."""
    if steps > most:
        raise ValueError(f"{steps} steps, expected at most {most}")


def _constant(kind: str, axis: int, given: list[Array]) -> Array:
    """Rounded weights as they were: float16 to float32, or integers with one scale a row."""
    if kind == "Cast":
        return given[0].astype(np.float32)
    shape = [1] * given[0].ndim
    shape[axis] = -1
    step, zero = given[1].reshape(shape), given[2].reshape(shape) if len(given) > 2 else np.float32(0)
    found: Array = (given[0].astype(np.float32) - zero) * step
    return found


_ELEMENTWISE: dict[str, Callable[..., Value]] = {
    "Add": Value.__add__,
    "Sub": Value.__sub__,
    "Mul": Value.__mul__,
    "Div": Value.__truediv__,
    "Neg": Value.__neg__,
    "Reciprocal": lambda a: 1.0 / a,
    "Sqrt": Value.sqrt,
    "Relu": lambda a: a.maximum(0.0),
    "Abs": Value.abs,
    "Tanh": Value.tanh,
    "Clip": lambda a, low, high: a.maximum(low).minimum(high),
    "Max": lambda *values: reduce(Value.maximum, values),
    "Min": lambda *values: reduce(Value.minimum, values),
    "LessOrEqual": lambda a, b: a <= b,
    "GreaterOrEqual": lambda a, b: b <= a,
    # NaN is greater than nothing, and nothing is greater than NaN.
    "Greater": lambda a, b: a.graph.select(a <= b, 0.0, b <= a),
    "Equal": lambda a, b: (a <= b) & (b <= a),
    "And": lambda a, b: a & b,
    "Where": lambda choice, a, b: a.graph.select(choice, a, b),
    "Identity": lambda a: a,
}
