"""Sizes and work of everything that a graph computes, before any memory or time is taken for it.

A file of a thousand bytes can ask for any amount: rows that double from node to node, or a column that meets a row. So
the shapes are followed node by node, for the most rays of one call.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

Shape = tuple[int, ...]

RAYS = 16_400  # of a call: `onnxlens.BATCH` with its padding
MAX_NUMBERS = 20_000 * RAYS  # of any tensor; the largest polynomials known have a thousand terms
MAX_ALIVE = 2 * MAX_NUMBERS  # of all computed tensors that a later node still needs
# Multiply-adds: of a ray (7,800 in the largest model that ships, 1.8 million in the widest network of settings),
# and of what does not depend on rays, most of which onnxruntime computes when it loads a model. A number that any other
# operator takes or makes costs as much as ten of them.
MAX_WORK, MAX_FIXED_WORK = 2_000_000, 100_000_000
_A_NUMBER = 10
MAX_RANK = 8
MAX_NODES = 10_000  # 136 in the largest model that ships

ELEMENTWISE = frozenset("Abs Cast Clip Cos DequantizeLinear Floor Identity Neg Reciprocal Relu Sin Sqrt Tanh".split())
BROADCAST = frozenset("Add And Div Equal Greater GreaterOrEqual LessOrEqual Max Min Mul Sub Where".split())


@dataclass(frozen=True)
class Node:
    """A node of a graph: its operator, its integer attributes, names of what it takes and makes."""

    kind: str
    attributes: Mapping[str, int]
    inputs: Sequence[str]
    outputs: Sequence[str]


def check_shapes(
    nodes: Sequence[Node],
    inputs: Sequence[tuple[str, Shape]],
    constants: Sequence[tuple[str, Shape]],
    integers: Mapping[str, Sequence[int]],
) -> None:
    """Refuse graphs whose tensors grow, or whose work grows, beyond reason.

    Args:
        inputs, constants: names and shapes; an input with a dimension of `RAYS` has a column a ray.
        integers: values of the constants that are integers, by name.

    Raises:
        ValueError: a tensor of more than `MAX_NUMBERS`, more than `MAX_ALIVE` at a time, more work than `MAX_WORK` a
            ray or `MAX_FIXED_WORK` besides, more nodes than `MAX_NODES`, shapes that do not fit, or that only running
            tells.
    """
    if len(nodes) > MAX_NODES:
        raise ValueError(f"{len(nodes)} operators, expected at most {MAX_NODES}")
    shapes: dict[str, Shape] = {}
    of_rays = {name for name, shape in inputs if RAYS in shape}
    left = {True: MAX_WORK * RAYS, False: MAX_FIXED_WORK}

    def add(name: str, shape: Shape, what: str) -> None:
        if name in shapes:
            raise ValueError(f"{name} is made twice")
        if len(shape) > MAX_RANK:
            raise ValueError(f"{what} has {len(shape)} dimensions, expected at most {MAX_RANK}")
        if min(shape, default=1) < 0 or math.prod(shape) > MAX_NUMBERS:
            raise ValueError(f"{what} has shape {shape} for {RAYS} rays, expected at most {MAX_NUMBERS} numbers")
        shapes[name] = shape

    for name, shape in (*inputs, *constants):
        add(name, shape, name)
    for node in nodes:
        try:
            given = [shapes[name] for name in node.inputs]
            made = _shapes(node, given, [integers.get(name) for name in node.inputs])
        except (KeyError, IndexError, ValueError, TypeError, ZeroDivisionError) as error:
            reason = f"{type(error).__name__}: {error}"
            raise ValueError(f"operator {node.kind}: its inputs do not fit ({reason})") from error
        if len(made) != len(node.outputs):
            raise ValueError(f"operator {node.kind}: {len(node.outputs)} outputs, expected {len(made)}")
        for name, shape in zip(node.outputs, made, strict=True):
            add(name, shape, f"operator {node.kind}")
        per_ray = not of_rays.isdisjoint(node.inputs)
        of_rays.update(node.outputs if per_ray else ())
        left[per_ray] -= _work(node, given, made)
        if left[per_ray] < 0:
            most = f"{MAX_WORK} multiply-adds a ray" if per_ray else f"{MAX_FIXED_WORK} multiply-adds without rays"
            raise ValueError(f"operator {node.kind}: too much work, expected at most {most}")
    _check_alive(nodes, shapes)


def _work(node: Node, given: list[Shape], made: list[Shape]) -> int:
    """Multiply-adds of a node."""
    if node.kind in ("MatMul", "Gemm"):
        return math.prod(made[0]) * given[0][1]
    return _A_NUMBER * max(math.prod(shape) for shape in (*given, *made))


def _check_alive(nodes: Sequence[Node], shapes: Mapping[str, Shape]) -> None:
    last = {name: i for i, node in enumerate(nodes) for name in node.inputs}
    computed: set[str] = set()
    alive = 0
    for i, node in enumerate(nodes):
        computed.update(node.outputs)
        alive += sum(math.prod(shapes[name]) for name in node.outputs)
        if alive > MAX_ALIVE:
            raise ValueError(f"operator {node.kind}: {alive} numbers at a time, expected at most {MAX_ALIVE}")
        # What no node takes is an output, or nothing: it goes at once, for outputs are few.
        done = {name for name in (*node.inputs, *node.outputs) if name in computed and last.get(name, i) <= i}
        alive -= sum(math.prod(shapes[name]) for name in done)


def _shapes(node: Node, given: list[Shape], constants: list[Any]) -> list[Shape]:
    """Shapes of the outputs; `constants` are the values of inputs that are constant integers, else None."""
    if node.kind in ELEMENTWISE:
        return [given[0]]
    if node.kind in BROADCAST:
        return [tuple(np.broadcast_shapes(*given))]
    return SHAPED[node.kind](node, given, constants)


def _product(node: Node, given: list[Shape], _: list[Any]) -> list[Shape]:
    (rows, inner), (other, columns) = given[:2]
    if inner != other or any(node.attributes.get(name) for name in ("transA", "transB")):
        raise ValueError(f"{given[0]} times {given[1]}")
    return [(rows, columns)]


def _concat(node: Node, given: list[Shape], _: list[Any]) -> list[Shape]:
    axis = _axis(node.attributes["axis"], given[0])
    rests = {(*shape[:axis], *shape[axis + 1 :]) for shape in given}
    if len(rests) > 1:
        raise ValueError(f"{given}")
    return [_with(given[0], axis, (sum(shape[axis] for shape in given),))]


def _gather(node: Node, given: list[Shape], _: list[Any]) -> list[Shape]:
    return [_with(given[0], _axis(node.attributes.get("axis", 0), given[0]), given[1])]


def _split(node: Node, given: list[Shape], constants: list[Any]) -> list[Shape]:
    axis = _axis(node.attributes.get("axis", 0), given[0])
    parts = constants[1]
    if sum(parts) != given[0][axis]:
        raise ValueError(f"parts {list(parts)} of {given[0]}")
    return [_with(given[0], axis, (int(part),)) for part in parts]


def _reduce(node: Node, given: list[Shape], constants: list[Any]) -> list[Shape]:
    axes = {_axis(a, given[0]) for a in constants[1]} if len(constants) > 1 else set(range(len(given[0])))
    if node.attributes.get("keepdims", 1):
        return [tuple(1 if k in axes else size for k, size in enumerate(given[0]))]
    return [tuple(size for k, size in enumerate(given[0]) if k not in axes)]


def _reshape(_: Node, given: list[Shape], constants: list[Any]) -> list[Shape]:
    count, shape = math.prod(given[0]), [int(v) for v in constants[1]]
    if -1 in shape:
        shape[shape.index(-1)] = count // -math.prod(shape)
    if min(shape, default=1) < 1 or math.prod(shape) != count:
        raise ValueError(f"{given[0]} as {list(constants[1])}")
    return [tuple(shape)]


def _transpose(_: Node, given: list[Shape], __: list[Any]) -> list[Shape]:
    return [given[0][::-1]]


SHAPED: dict[str, Callable[[Node, list[Shape], list[Any]], list[Shape]]] = {
    "MatMul": _product,
    "Gemm": _product,
    "Concat": _concat,
    "Gather": _gather,
    "Split": _split,
    "ReduceSum": _reduce,
    "Reshape": _reshape,
    "Transpose": _transpose,
}


def _axis(axis: int, shape: Shape) -> int:
    return range(len(shape))[axis]


def _with(shape: Shape, axis: int, sizes: Shape) -> Shape:
    return (*shape[:axis], *sizes, *shape[axis + 1 :])
