"""Graphs evaluated step by step on numpy arrays or torch tensors, in the precision of what they are given."""

import functools
import operator
from collections.abc import Callable, Mapping
from importlib import import_module
from typing import Any
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import NDArray

from neurolens.graph.ir import Exponents, Graph, Node

# torch tensors or numpy arrays, [R, N]; values of the call are [R, 1].
Rows = Any


def evaluate(graph: Graph, inputs: Mapping[str, Rows]) -> dict[str, Rows]:
    """Return the outputs of a graph, [R, N] each, or [R, 1] where they are the same for all rays.

    Args:
        inputs: by name, [R, N], or [R, 1] for inputs of the call; all numpy arrays or all torch tensors of one floating
            dtype. Torch follows its gradients. Tables [cells, columns] are read fastest where columns are contiguous.

    Raises:
        KeyError: an input that is missing.
    """
    space = _Space(next(iter(inputs.values()), None))
    known: dict[int, Rows] = {}
    with np.errstate(all="ignore"):
        for number, done in _plan(graph):
            node = graph.nodes[number]
            if node.name:
                known[number] = inputs[node.name]
            else:
                known[number] = _RULES[node.kind](space, node, [known[k] for k in node.inputs])
            for k in done:  # their memory serves the next
                del known[k]
    return {name: known[v.number] for name, v in graph.outputs.items()}


_Plan = list[tuple[int, list[int]]]
_PLANS: WeakKeyDictionary[Graph, tuple[tuple[int, ...], _Plan]] = WeakKeyDictionary()


def _plan(graph: Graph) -> _Plan:
    """Return the numbers of the nodes that the outputs need, in order.

    Each comes with the values that no later node needs.

    A plan is kept as long as its graph.
    """
    wanted = (len(graph.nodes), *(v.number for v in graph.outputs.values()))
    kept = _PLANS.get(graph)
    if kept is None or kept[0] != wanted:
        live = set(wanted[1:])
        for number in range(len(graph.nodes) - 1, -1, -1):  # nodes, not rows: an operation takes all of its inputs
            if number in live:
                live.update(graph.nodes[number].inputs)
        last = {k: number for number in sorted(live) for k in (number, *graph.nodes[number].inputs)}
        done: dict[int, list[int]] = {number: [] for number in sorted(live)}
        for k, number in last.items():
            if k not in wanted[1:]:
                done[number].append(k)
        kept = _PLANS[graph] = wanted, list(done.items())
    return kept[1]


class _Space:
    """The operations that numpy and torch write differently."""

    def __init__(self, like: Rows | None) -> None:
        self.torch = None if like is None or isinstance(like, np.ndarray) else import_module("torch")
        self.like = np.zeros((1, 1)) if like is None else like
        library: Any = self.torch or np
        self.sqrt, self.tanh, self.where, self.ones_like = library.sqrt, library.tanh, library.where, library.ones_like
        self.maximum, self.minimum, self.clip = library.maximum, library.minimum, library.clip
        self.floor, self.concat = library.floor, library.cat if self.torch else np.concatenate

    def numbers(self, array: NDArray[Any]) -> Rows:
        """Return coefficients in the precision and on the device of the rays."""
        if self.torch:
            return self.torch.as_tensor(array, dtype=self.like.dtype, device=self.like.device)
        return array.astype(self.like.dtype)

    def cast(self, x: Rows, whole: bool = False) -> Rows:
        """Return a truth or a status as numbers."""
        if self.torch:
            return x.to(self.torch.int32 if whole else self.like.dtype)
        return x.astype(np.int32 if whole else self.like.dtype)

    def broadcast(self, rows: list[Rows]) -> list[Rows]:
        """Repeat rows of the call for all rays, where other rows are of rays."""
        width = max(r.shape[1] for r in rows) if all(r.shape[1] for r in rows) else 0
        if self.torch:
            return [r.expand(r.shape[0], width) if r.shape[1] != width else r for r in rows]
        return [np.broadcast_to(r, (r.shape[0], width)) if r.shape[1] != width else r for r in rows]


def monomials(x: Rows, exponents: Exponents) -> Rows:
    """Return [M, N] products of powers of the rows of x [V, N], an array or a tensor, for exponents [M, V]."""
    space = _Space(x)
    powers = [space.ones_like(x)]
    for _ in range(int(exponents.max(initial=0))):
        powers.append(powers[-1] * x)
    # Products of the first variables, with which many monomials begin.
    known: dict[tuple[int, ...], Rows] = {}
    rows = []
    for exponent in exponents.tolist():
        row, begun = powers[0][:1], ()
        for v, e in enumerate(exponent):
            if e:
                before, begun = begun, tuple(exponent[: v + 1])
                if begun not in known:
                    known[begun] = row * powers[e][v : v + 1] if before else powers[e][v : v + 1]
                row = known[begun]
        rows.append(row)
    return space.concat(rows)


def _affine(space: _Space, node: Node, given: list[Rows]) -> Rows:
    moving, added = node.static
    total = space.numbers(node.arrays[0]) @ given[0]
    if moving:
        total = total + given[1] * (space.numbers(node.arrays[2]) @ given[0])
    total = total + space.numbers(node.arrays[1][:, None])
    return total + given[-1] if added else total


def _quadratic(space: _Space, node: Node, given: list[Rows]) -> Rows:
    x, rows = given[0], []
    for form, bias in zip(node.static, node.arrays[0], strict=True):
        total = functools.reduce(operator.add, (x[i : i + 1] * x[j : j + 1] for i, j in form))
        rows.append(total + float(bias) if bias else total)
    return space.concat(rows)


def _series(space: _Space, node: Node, given: list[Rows]) -> Rows:
    coefficients = [float(c) for c in node.arrays[0]]
    total = space.ones_like(given[0]) * coefficients[-1]
    for c in coefficients[-2::-1]:
        total = total * given[0] + c
    return total


def _lookup(space: _Space, node: Node, given: list[Rows]) -> Rows:
    table, indices, weights = given[0].T, given[1], given[2]
    count = len(weights) // len(indices)
    terms: list[Rows] = []
    for k, index in enumerate(indices):
        whole = index.long() if space.torch else index.astype(np.intp)
        found = table[:, space.clip(whole, 0, table.shape[1] - 1)] if space.torch else table.take(whole, 1, mode="clip")
        groups = found.reshape(count, len(table) // count, found.shape[1])[:, list(node.static)]
        terms += (w * group for w, group in zip(weights[k * count :], groups, strict=False))
    return functools.reduce(operator.add, terms)


def _between(space: _Space, node: Node, given: list[Rows]) -> Rows:
    low, high = (space.numbers(c[:, None]) for c in node.arrays[0].T)
    return space.cast((given[0] >= low) & (given[0] <= high))


def _first_failure(space: _Space, node: Node, given: list[Rows]) -> Rows:
    status = space.numbers(np.zeros((1, 1)))
    for k in range(len(node.static) - 1, -1, -1):
        fails = ~(given[2 * k] <= given[2 * k + 1])
        status = space.where(fails, space.numbers(np.array([[float(node.static[k])]])), status)
    return status


_RULES: dict[str, Callable[[_Space, Node, list[Rows]], Rows]] = {
    "add": lambda s, node, given: given[0] + given[1],
    "sub": lambda s, node, given: given[0] - given[1],
    "mul": lambda s, node, given: given[0] * given[1],
    "div": lambda s, node, given: given[0] / given[1],
    "neg": lambda s, node, given: -given[0],
    "abs": lambda s, node, given: abs(given[0]),
    "and": lambda s, node, given: given[0] * given[1],
    "sqrt": lambda s, node, given: s.sqrt(*given),
    "tanh": lambda s, node, given: s.tanh(*given),
    "floor": lambda s, node, given: s.floor(*given),
    "max": lambda s, node, given: s.maximum(*given),
    "min": lambda s, node, given: s.minimum(*given),
    "le": lambda s, node, given: s.cast(given[0] <= given[1]),
    "select": lambda s, node, given: s.where(given[0] > 0, *given[1:]),
    "whole": lambda s, node, given: s.cast(given[0], whole=True),
    "constant": lambda s, node, given: s.numbers(node.arrays[0][:, None]),
    "table": lambda s, node, given: s.numbers(node.arrays[0]),
    "take": lambda s, node, given: given[0][list(node.static)],
    "concat": lambda s, node, given: s.concat(s.broadcast(given)),
    "clip": lambda s, node, given: s.clip(given[0], *(float(v) for v in node.arrays[0])),
    "affine": _affine,
    "quadratic": _quadratic,
    "polynomial": lambda space, node, given: space.numbers(node.arrays[1]) @ monomials(given[0], node.arrays[0]),
    "series": _series,
    "lookup": _lookup,
    "between": _between,
    "first_failure": _first_failure,
}
