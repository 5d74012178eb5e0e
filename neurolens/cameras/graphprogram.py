"""The graph of an exported model as a program of float steps, one ray at a time: what fused cameras are made of.

Rays lie on the last axis of everything in a graph (`surrogates.onnx.graph`), so a graph for one ray, its rows spelled
out, is the program. Truth values are 0 and 1. Only what `onnxfile.read_checked` has checked comes here; it needs no
torch and no onnx.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from neurolens.base.errors import InputError
from neurolens.graph.program import (
    FILM_Z,
    RAY,
    SCENE_RAY,
    STATUS,
    STOP,
    STOP_RADIUS,
    TRANSMITTANCE,
    WAVELENGTH,
    Expr,
    Program,
)
from neurolens.modelfile.onnxfile import constants_and_nodes
from neurolens.modelfile.shapes import Node
from neurolens.programs.tanh import add_tanh

# Objects are expressions, numbers constants.
Array = NDArray[Any]
_ROWS = 8  # of a product at a time, of 16 registers; fewer would wait for one another
MAX_STEPS = 200_000  # the largest models that ship take 3000; a compiler needs a minute for 20,000


def program_of(path: str | Path, data: bytes, state: Sequence[float] = ()) -> Program:
    """The program of a model: inputs and outputs are those of `graph.program`.

    Args:
        path: of the model, for errors. data: its bytes, as `read_checked` gives them.
        state: of a model of many states, the one wanted: it is folded into the numbers.

    Raises:
        InputError: an operator that has no such form, or a graph beyond `MAX_STEPS`.
    """
    constants, nodes = constants_and_nodes(data)
    program = Program()
    known: dict[str, Array] = dict(constants)
    known["rays"] = _column([program.input(name) for name in (*RAY, WAVELENGTH)])
    known["film_z_mm"] = _column([program.input(FILM_Z)])[0]
    known["stop_radius_mm"] = _column([program.input(STOP_RADIUS)])[0]
    known["state"] = np.array(state, np.float32)
    writer = _Writer(program)
    for node in nodes:
        given = [known[name] for name in node.inputs]
        if max(len(program.steps), *(a.size for a in given)) > MAX_STEPS:
            raise InputError(path, "graph", f"(more than {MAX_STEPS} steps)", "a smaller model for a fused camera")
        try:
            made = writer.made(path, node, given)
        except InputError:
            raise
        except (ValueError, IndexError, TypeError) as error:
            raise InputError(path, "graph", f"(operator {node.kind}: {error})", "one that works ray by ray") from error
        known.update(zip(node.outputs, made, strict=True))
    names = (*SCENE_RAY, TRANSMITTANCE, *STOP, STATUS)
    columns = [known[name].reshape(-1) for name in ("scene_ray", "transmittance", "stop_xy_mm", "status")]
    program.outputs.update(zip(names, np.concatenate(columns), strict=True))
    return program


def _column(values: Sequence[Expr]) -> Array:
    found = np.empty((len(values), 1), object)
    found[:, 0] = values
    return found


class _Writer:
    """Operators of ONNX as steps of a program; what is constant stays numbers."""

    def __init__(self, program: Program) -> None:
        self.program = program
        self.elementwise: dict[str, Callable[..., Expr]] = {
            "Add": self._add,
            "Sub": lambda a, b: a - b,
            "Mul": lambda a, b: a * b,
            "Div": lambda a, b: a / b,
            "Neg": lambda a: -a,
            "Reciprocal": lambda a: program.literal(1.0) / a,
            "Sqrt": lambda a: program.op("sqrt", a),
            "Relu": lambda a: program.op("max", a, 0.0),
            "Abs": lambda a: program.op("max", a, -a),
            "Tanh": lambda a: add_tanh(program, [a])[0],
            "Clip": lambda a, low, high: program.op("min", program.op("max", a, low), high),
            "LessOrEqual": lambda a, b: program.select(a, b, 1.0, 0.0),
            "GreaterOrEqual": lambda a, b: program.select(b, a, 1.0, 0.0),
            # NaN is greater than nothing, and nothing is greater than NaN.
            "Greater": lambda a, b: program.select(a, b, 0.0, program.select(b, a, 1.0, 0.0)),
            "Equal": lambda a, b: program.select(a, b, program.select(b, a, 1.0, 0.0), 0.0),
            "And": lambda a, b: a * b,
            "Where": lambda choice, a, b: program.select(1.0, choice, a, b),
            # To integers: only for the status, which is whole.
            "Cast": lambda a: a,
            "Identity": lambda a: a,
        }

    def made(self, path: str | Path, node: Node, given: list[Array]) -> list[Array]:
        """Outputs of a node."""
        kind, axis = node.kind, node.attributes.get("axis", 0)
        if kind == "Concat":
            return [np.concatenate([self._expressions(a) for a in given], axis)]
        if kind == "Gather":
            return [np.take(given[0], given[1].astype(np.intp), axis)]
        if kind == "Split":
            return np.split(given[0], np.cumsum(given[1].astype(np.intp))[:-1], axis)
        if kind == "Reshape":
            return [given[0].reshape([int(v) for v in given[1]])]
        if kind == "ReduceSum":
            axes = given[1] if len(given) > 1 else range(given[0].ndim)
            return [self._sum(given[0], [int(v) for v in axes], bool(node.attributes.get("keepdims", 1)))]
        if kind in ("MatMul", "Gemm"):
            return [self._product(*given)]
        if kind in ("Cast", "DequantizeLinear") and all(a.dtype != object for a in given):
            return [_constant(kind, axis, given)]
        if kind in ("Max", "Min"):
            whole = self._expressions(given[0])
            for other in given[1:]:
                whole = self._each(lambda a, b: self.program.op(kind.lower(), a, b), whole, other)
            return [whole]
        if kind not in self.elementwise:
            raise InputError(path, "operator", kind, "one that fused cameras know: use onnxruntime for this model")
        return [self._each(self.elementwise[kind], *given)]

    def _expressions(self, array: Array) -> Array:
        if array.dtype == object:
            return array
        found = np.empty(array.shape, object)
        for place, value in np.ndenumerate(array):
            found[place] = self.program.literal(float(value))
        return found

    def _each(self, operation: Callable[..., Expr], *given: Array) -> Array:
        _check_room(math.prod(np.broadcast_shapes(*(a.shape for a in given))))
        arrays = np.broadcast_arrays(*(self._expressions(a) for a in given))
        found = np.empty(arrays[0].shape, object)
        for place in np.ndindex(found.shape):
            found[place] = operation(*(a[place] for a in arrays))
        return found

    def _add(self, a: Expr, b: Expr) -> Expr:
        """A product and a sum are one operation."""
        for product, other in ((a, b), (b, a)):
            if isinstance(product.argument, int):
                step = self.program.steps[product.argument]
                if step.kind == "mul":
                    left, right = (Expr(self.program, x) for x in step.arguments)
                    return self.program.fma(left, right, other)
        return a + b

    def _sum(self, array: Array, axes: list[int], keepdims: bool) -> Array:
        found = self._expressions(array)
        for axis in sorted((range(array.ndim)[a] for a in axes), reverse=True):
            parts = np.split(found, found.shape[axis], axis)
            found = parts[0]
            for part in parts[1:]:
                found = self._each(self._add, found, part)
            found = found if keepdims else np.squeeze(found, axis)
        return found

    def _product(self, weight: Array, value: Array, bias: Array | None = None) -> Array:
        """weight [R, M] times value [M, 1], plus bias, by groups of rows whose sums fit the registers.

        Each of the M is spent on every row of a group at once.
        """
        _check_room(len(weight) * value.size)
        w, v = self._expressions(weight), self._expressions(value)
        total = np.empty((len(w), v.shape[1]), object)
        total[...] = self.program.literal(0.0)
        if bias is not None:
            total = np.array(np.broadcast_to(self._expressions(bias), total.shape))
        groups = max(1, round(len(w) / _ROWS))
        for rows in np.array_split(np.arange(len(w)), groups):
            for k in range(w.shape[1]):
                for row, column in itertools.product(rows, range(v.shape[1])):
                    total[row, column] = self.program.fma(w[row, k], v[k, column], total[row, column])
        return total


def _check_room(steps: int) -> None:
    """Before memory is taken: a few numbers can ask for as many steps as the product of their counts."""
    if steps > MAX_STEPS:
        raise ValueError(f"{steps} steps, expected at most {MAX_STEPS}")


def _constant(kind: str, axis: int, given: list[Array]) -> Array:
    """Rounded weights as they were: float16 to float32, or integers with one scale a row."""
    if kind == "Cast":
        return given[0].astype(np.float32)
    shape = [1] * given[0].ndim
    shape[axis] = -1
    step, zero = given[1].reshape(shape), given[2].reshape(shape) if len(given) > 2 else np.float32(0)
    found: Array = (given[0].astype(np.float32) - zero) * step
    return found
