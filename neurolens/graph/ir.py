"""A lens or a model as one graph: operators on rows of rays, written once and read by every evaluator and writer.

A value has R rows and one column a ray, or one for the whole call (a film position, a stop radius). `affine`,
`polynomial`, `quadratic` and `series` stay whole and are lowered late: to matrix products and few passes over the rays
for ONNX (`graph.onnx`), to fused multiply-adds for C and GLSL (`graph.scalars`). A new reader is one rule an operator:

    input, table, constant      named rows of the caller; a table of numbers, of the caller or its own; numbers
    take, concat                rows of a value; rows of several values below each other
    affine                      W x + b; W may be W0 + s W1 with s of the call, and rows may be added
    quadratic                   sums of products of two rows of x, plus constants
    polynomial                  W m with m the monomials of the rows of x
    series                      a polynomial in one row, lowest coefficient first
    add sub mul div max min     row by row; one row meets any number of rows
    neg sqrt tanh abs floor clip (clip between two numbers)
    lookup                      a weighted sum of parts of the rows of a table at some indices
    le between and select       truths: 1 where x <= y, and where low <= x <= high (0 for NaN); choice by a truth
    first_failure               the code of the first test that fails, 0 where none does
    whole                       a number as an integer
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]
Exponents = NDArray[np.int64]
# One row of a quadratic: the pairs of rows of x whose products are summed.
Form = tuple[tuple[int, int], ...]


@dataclass(frozen=True)
class Node:
    """One operation.

    Attributes:
        kind: an operator of the module's table. inputs: numbers of earlier nodes.
        rows: how many its value has. per_call: whether it is the same for all rays of a call.
        name: an input's.
        arrays: its numbers, float64 (exponents int64). static: what is neither a value nor a coefficient.
    """

    kind: str
    inputs: tuple[int, ...]
    rows: int
    per_call: bool
    name: str = ""
    arrays: tuple[NDArray[Any], ...] = ()
    static: tuple[Any, ...] = ()


@dataclass(frozen=True)
class Value:
    """R rows of a graph; arithmetic appends operations to it."""

    graph: Graph
    number: int

    @property
    def node(self) -> Node:
        return self.graph.nodes[self.number]

    @property
    def rows(self) -> int:
        return self.node.rows

    def __getitem__(self, rows: int | slice | list[int]) -> Value:
        every = range(self.rows)
        wanted = [every[rows]] if isinstance(rows, int) else list(every[rows]) if isinstance(rows, slice) else rows
        return self.graph.take(self, wanted)

    def __add__(self, other: Operand) -> Value:
        return self.graph.each("add", self, other)

    def __sub__(self, other: Operand) -> Value:
        return self.graph.each("sub", self, other)

    def __mul__(self, other: Operand) -> Value:
        return self.graph.each("mul", self, other)

    def __truediv__(self, other: Operand) -> Value:
        return self.graph.each("div", self, other)

    def __radd__(self, other: ArrayLike) -> Value:
        return self.graph.constant(other) + self

    def __rsub__(self, other: ArrayLike) -> Value:
        return self.graph.constant(other) - self

    def __rmul__(self, other: ArrayLike) -> Value:
        return self * other

    def __rtruediv__(self, other: ArrayLike) -> Value:
        return self.graph.constant(other) / self

    def __neg__(self) -> Value:
        return self.graph.each("neg", self)

    def sqrt(self) -> Value:
        return self.graph.each("sqrt", self)

    def tanh(self) -> Value:
        return self.graph.each("tanh", self)

    def abs(self) -> Value:
        return self.graph.each("abs", self)

    def floor(self) -> Value:
        return self.graph.each("floor", self)

    def maximum(self, other: Operand) -> Value:
        return self.graph.each("max", self, other)

    def minimum(self, other: Operand) -> Value:
        return self.graph.each("min", self, other)

    def clip(self, low: float, high: float) -> Value:
        return self.graph.add("clip", (self,), self.rows, arrays=(np.array([low, high]),))

    def whole(self) -> Value:
        return self.graph.each("whole", self)

    def __le__(self, other: Operand) -> Value:
        return self.graph.each("le", self, other)

    def __and__(self, other: Value) -> Value:
        return self.graph.each("and", self, other)

    def between(self, low: ArrayLike, high: ArrayLike) -> Value:
        """Return 1 where low <= value <= high, else 0, also for NaN; a bound is one number, or one a row."""
        limits = np.broadcast_to(np.stack([low, high]).T, (self.rows, 2)).astype(np.float64)
        return self.graph.add("between", (self,), self.rows, arrays=(limits,))


Operand = Value | ArrayLike
# Computed at once where all operands are numbers.
_FOLDED: dict[str, np.ufunc] = {"add": np.add, "sub": np.subtract, "mul": np.multiply, "neg": np.negative}


@dataclass(eq=False)
class Graph:
    """Nodes in order, and named results. Equal nodes are one."""

    nodes: list[Node] = field(default_factory=list)
    outputs: dict[str, Value] = field(default_factory=dict)
    _known: dict[tuple[Any, ...], int] = field(default_factory=dict, repr=False)

    def add(
        self,
        kind: str,
        inputs: Sequence[Value],
        rows: int,
        *,
        name: str = "",
        arrays: Sequence[NDArray[Any]] = (),
        static: tuple[Any, ...] = (),
        per_call: bool | None = None,
    ) -> Value:
        """Append a node of any kind. With `per_call` None it is the same for all rays if all its inputs are."""
        numbers = tuple(v.number for v in inputs)
        if kind == "and":
            for one, other in (inputs, inputs[::-1]):
                if one.rows <= other.rows and self._holds(one):
                    return other
        if per_call is None:
            per_call = all(self.nodes[k].per_call for k in numbers)
        key = (kind, numbers, rows, name, static, *((a.shape, a.tobytes()) for a in arrays))
        if key not in self._known:
            self._known[key] = len(self.nodes)
            self.nodes.append(Node(kind, numbers, rows, per_call, name, tuple(arrays), static))
        return Value(self, self._known[key])

    def _holds(self, truth: Value) -> bool:
        """Return whether a truth always holds, because it tests a number that lies between its limits."""
        if truth.node.kind != "between" or (tested := self.inputs_of(truth.number)[0].node).kind != "constant":
            return False
        low, high = truth.node.arrays[0].T
        return bool(((low <= tested.arrays[0]) & (tested.arrays[0] <= high)).all())

    def input(self, name: str, rows: int = 1, *, per_call: bool = False) -> Value:
        return self.add("input", (), rows, name=name, per_call=per_call)

    def table(self, name: str, columns: int) -> Value:
        """Add numbers [cells, columns] that the caller gives, for `lookup` alone."""
        return self.add("table", (), columns, name=name, per_call=True)

    def own_table(self, values: ArrayLike) -> Value:
        """Add numbers [cells, columns] of the graph itself, for `lookup` alone."""
        array = np.asarray(values, np.float64)
        return self.add("table", (), array.shape[1], arrays=(array,), per_call=True)

    def lookup(self, table: Value, index: Value, weights: Value) -> Value:
        """Interpolate: the sum of weight (i, g) times group g of the columns of a table, in the cell of index i.

        The index's fraction is cut off. An index beyond the table's ends, or NaN, takes some cell of the table, never
        anything outside it. There are as many groups, of equally many columns, as weights of each index; the weights
        of the first index come first.
        """
        rows = table.rows * index.rows // weights.rows
        return self.add("lookup", (table, index, weights), rows, static=tuple(range(rows)), per_call=False)

    def constant(self, value: ArrayLike, *label: str) -> Value:
        """Return numbers, one a row. Equal numbers with equal labels are one node."""
        array = np.atleast_1d(np.asarray(value, np.float64))
        return self.add("constant", (), len(array), arrays=(array,), static=label, per_call=True)

    def value(self, operand: Operand) -> Value:
        return operand if isinstance(operand, Value) else self.constant(operand)

    def each(self, kind: str, *operands: Operand) -> Value:
        """Append an operation row by row; a single row stands for as many as the others have."""
        values = [self.value(v) for v in operands]
        nodes = [self.nodes[v.number] for v in values]
        sizes = [node.rows for node in nodes]
        rows = max(sizes)
        if sizes.count(1) + sizes.count(rows) < len(sizes):
            raise ValueError(f"{kind} of {sizes} rows")
        if kind in _FOLDED and all(node.kind == "constant" for node in nodes):
            return self.constant(_FOLDED[kind](*(node.arrays[0] for node in nodes)))
        return self.add(kind, values, rows)

    def take(self, x: Value, rows: Sequence[int]) -> Value:
        if list(rows) == list(range(x.rows)):
            return x
        if x.node.kind == "concat":  # taken from the one part that holds all rows, or made of the parts themselves
            parts, ends = self.inputs_of(x.number), [0]
            for part in parts:
                if all(ends[-1] <= r < ends[-1] + part.rows for r in rows):
                    return self.take(part, [r - ends[-1] for r in rows])
                ends.append(ends[-1] + part.rows)
            if list(rows) == list(range(rows[0], rows[-1] + 1)) and {rows[0], rows[-1] + 1} <= {*ends}:
                return self.concat(*(part for part, start in zip(parts, ends, strict=False) if start in rows))
        if x.node.kind == "constant":
            return self.constant(x.node.arrays[0][list(rows)])
        if x.node.kind == "take":
            return self.take(Value(self, x.node.inputs[0]), [x.node.static[r] for r in rows])
        return self.add("take", (x,), len(rows), static=tuple(int(r) for r in rows))

    def split(self, x: Value, sizes: Iterable[int]) -> list[Value]:
        """Return parts of `x` of consecutive rows, of these sizes."""
        ends = np.cumsum([0, *sizes])
        return [x[int(a) : int(b)] for a, b in zip(ends, ends[1:], strict=False)]

    def concat(self, *parts: Value) -> Value:
        if len(parts) == 1:
            return parts[0]
        if all(p.node.kind == "constant" for p in parts):
            return self.constant(np.concatenate([p.node.arrays[0] for p in parts]))
        flat = [q for p in parts for q in (self.inputs_of(p.number) if p.node.kind == "concat" else [p])]
        return self.add("concat", flat, sum(p.rows for p in flat))

    def affine(
        self,
        weight: ArrayLike,
        x: Value,
        bias: ArrayLike | None = None,
        *,
        moving: tuple[Value, ArrayLike] | None = None,
        added: Value | None = None,
    ) -> Value:
        """Return weight [R, K] x + bias [R].

        Args:
            moving: (s, W1) with s one row of the call: the weight is then weight + s W1.
            added: R rows that are added.
        """
        w = np.asarray(weight, np.float64)
        b = np.zeros(len(w)) if bias is None else np.asarray(bias, np.float64)
        arrays, inputs = [w, b], [x]
        if moving is not None:
            arrays.append(np.asarray(moving[1], np.float64))
            inputs.append(moving[0])
        if added is not None:
            inputs.append(added)
        static = (moving is not None, added is not None)
        return self.add("affine", inputs, len(w), arrays=arrays, static=static)

    def quadratic(self, x: Value, forms: Sequence[Form], bias: ArrayLike | None = None) -> Value:
        """Return rows, of which row r is the sum of x_i x_j over the pairs (i, j) of form r, plus bias [R]."""
        b = np.zeros(len(forms)) if bias is None else np.asarray(bias, np.float64)
        return self.add("quadratic", (x,), len(forms), arrays=(b,), static=tuple(tuple(f) for f in forms))

    def square(self, x: Value) -> Value:
        """Return the squared length of x, one row."""
        return self.quadratic(x, [tuple((i, i) for i in range(x.rows))])

    def dot(self, a: Value, b: Value) -> Value:
        """Return the scalar product of a and b, one row."""
        if a == b:
            return self.square(a)
        return self.quadratic(self.concat(a, b), [tuple((k, a.rows + k) for k in range(a.rows))])

    def polynomial(self, exponents: Exponents, weight: ArrayLike, x: Value) -> Value:
        """Return weight [R, M] times the monomials of x [V rows], for exponents [M, V], whose rows are unique."""
        w = np.asarray(weight, np.float64)
        return self.add("polynomial", (x,), len(w), arrays=(np.asarray(exponents, np.int64), w))

    def series(self, x: Value, coefficients: ArrayLike) -> Value:
        numbers = np.asarray(coefficients, np.float64)
        numbers = np.append(numbers, 0.0) if len(numbers) == 1 else numbers  # readers begin with a slope
        return self.add("series", (x,), x.rows, arrays=(numbers,))

    def select(self, truth: Value, then: Operand, otherwise: Operand) -> Value:
        other = self.value(otherwise)
        if isinstance(then, Value) and then.node.kind == "select" and then.node.inputs[2] == other.number:
            inner, value, _ = self.inputs_of(then.number)
            return self.each("select", truth & inner, value, other)
        return self.each("select", truth, then, other)

    def first_failure(self, tests: Sequence[tuple[Value, Value]], codes: Sequence[int]) -> Value:
        """Return the code of the first test for which value <= limit is false, as for NaN; 0 where all are true."""
        flat = [v for pair in tests for v in pair]
        return self.add("first_failure", flat, 1, static=tuple(int(c) for c in codes))

    def like(self, node: Node, inputs: Sequence[Value]) -> Value:
        """Append the operation of any graph's node to these inputs, which may be numbers where its own were not."""
        if node.kind in _FOLDED:
            return self.each(node.kind, *inputs)
        if node.kind == "select":
            return self.select(*inputs)
        per_call = node.per_call if node.kind in ("input", "table", "constant", "lookup") else None
        return self.add(
            node.kind, inputs, node.rows, name=node.name, arrays=node.arrays, static=node.static, per_call=per_call
        )

    def inline(self, other: Graph, given: Mapping[str, Value]) -> dict[str, Value]:
        """Append another graph with these values as its inputs (others stay inputs); returns its outputs."""
        values: list[Value] = []
        for node in other.nodes:
            if node.kind in ("input", "table") and node.name in given:
                values.append(given[node.name])
                continue
            values.append(self.like(node, [values[k] for k in node.inputs]))
        return {name: values[v.number] for name, v in other.outputs.items()}

    def inputs_of(self, number: int) -> list[Value]:
        return [Value(self, k) for k in self.nodes[number].inputs]


# Any row of these needs all rows of their inputs, except the rows that an affine adds.
_WHOLE = frozenset(("affine", "polynomial", "quadratic", "first_failure", "lookup"))


def _needed(graph: Graph, node: Node, rows: Collection[int]) -> Iterator[tuple[int, Collection[int]]]:
    """Yield the numbers of the inputs that these rows of a node need, with the rows needed, in the order of `rows`."""
    if node.kind == "take":
        yield node.inputs[0], [node.static[r] for r in rows]
    elif node.kind == "concat":
        start = 0
        for k in node.inputs:
            end = start + graph.nodes[k].rows
            if mine := [r - start for r in rows if start <= r < end]:
                yield k, mine
            start = end
    else:
        whole = len(node.inputs) - (node.kind == "affine" and node.static[1]) if node.kind in _WHOLE else 0
        for place, k in enumerate(node.inputs):
            yield k, range(graph.nodes[k].rows) if place < whole else rows


def live_rows(graph: Graph, outputs: Mapping[str, Value]) -> dict[int, set[int]]:
    """Return the rows of each node that the outputs need; nodes that are not needed are missing."""
    needed: dict[int, set[int]] = {}

    def ask(number: int, rows: Collection[int]) -> None:
        if rows:  # a single row stands for any
            needed.setdefault(number, set()).update(rows if graph.nodes[number].rows > 1 else (0,))

    for value in outputs.values():
        ask(value.number, range(value.rows))
    for number in range(len(graph.nodes) - 1, -1, -1):
        if number in needed:
            for k, rows in _needed(graph, graph.nodes[number], needed[number]):
                ask(k, rows)
    return needed


def pruned(graph: Graph, outputs: Mapping[str, Value] | None = None) -> Graph:
    """Return the graph of these outputs alone (None: of its own).

    Rows of matrices and polynomials that nothing needs are left out.
    """
    wanted = dict(graph.outputs if outputs is None else outputs)
    live = live_rows(graph, wanted)
    new = Graph()
    place: dict[int, Value] = {}  # a node's value among the new ones
    kept: dict[int, list[int]] = {}  # the old rows that it holds, in order

    def rows_of(number: int, rows: Collection[int]) -> Value:
        """Return the new value of old rows; a single row stands for any."""
        known = kept[number]
        if graph.nodes[number].rows == 1:
            return place[number]
        return new.take(place[number], [known.index(r) for r in rows])

    for number, node in enumerate(graph.nodes):
        if number not in live:
            continue
        every, rows = list(range(node.rows)), sorted(live[number])
        if node.kind in ("input", "table"):
            place[number], kept[number] = new.like(node, ()), every
            continue
        kept[number] = rows
        inputs = [rows_of(k, wanted_rows) for k, wanted_rows in _needed(graph, node, rows)]
        if node.kind == "constant":
            place[number] = new.constant(node.arrays[0][rows], *node.static)
        elif node.kind == "take":
            place[number] = inputs[0]
        elif node.kind == "concat":
            place[number] = new.concat(*inputs)
        else:
            place[number] = _kept_rows(new, node, rows, inputs)
    new.outputs = {name: rows_of(v.number, range(v.rows)) for name, v in wanted.items()}
    return new


def _kept_rows(new: Graph, node: Node, rows: list[int], inputs: list[Value]) -> Value:
    """Append a node that computes some of a node's rows."""
    cut = {"affine": 0, "quadratic": 0, "between": 0, "polynomial": 1}.get(node.kind, len(node.arrays))
    arrays = [a if k < cut else a[rows] for k, a in enumerate(node.arrays)]
    static = tuple(node.static[r] for r in rows) if node.kind in ("quadratic", "lookup") else node.static
    per_call = False if node.kind == "lookup" else None
    return new.add(node.kind, inputs, len(rows), arrays=arrays, static=static, per_call=per_call)


def same_structure(graphs: Sequence[Graph]) -> bool:
    """Return whether graphs differ in their numbers alone, so that one set of operations serves all of them."""

    def shape(graph: Graph) -> list[Any]:
        bare = []
        for n in graph.nodes:
            exponents = n.arrays[0].tobytes() if n.kind == "polynomial" else b""
            bare.append((n.kind, n.inputs, n.rows, n.name, n.static, [a.shape for a in n.arrays], exponents))
        return [bare, {name: v.number for name, v in graph.outputs.items()}]

    first = shape(graphs[0])
    return all(shape(g) == first for g in graphs[1:])
