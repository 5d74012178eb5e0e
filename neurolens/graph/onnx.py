"""Graphs as ONNX: rays on the last axis, linear steps as matrix products, few passes over the rays.

Opset 17, float32. Constants are stored once; several graphs of one structure become one whose constants follow a state.
Values of the call have one column, or the shape [1] where they are one number.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from neurolens.base.errors import InputError
from neurolens.graph.ir import Graph, Node, pruned, same_structure
from neurolens.graph.protobuf import FLOAT, INT32, INT64, ML, model_proto, node_proto, tensor_proto, value_proto
from neurolens.graph.scalars import Block, Exponent, Pair, blocks_alone, by_block, plan_products

Array = NDArray[np.float64]
# Opset 17 and IR 8 are read by every onnxruntime since 1.12.
OPSET, IR_VERSION = 17, 8


@dataclass(frozen=True)
class Mixing:
    """How a state mixes the constants of the graphs of its nodes.

    Attributes:
        graph: of the call, from the input `state` to the output `features`. Its other outputs replace the inputs of the
            same names.
        transform: [K, nodes]: features @ transform are the weights of the nodes.
    """

    graph: Graph
    transform: Array


def write_onnx(
    graphs: Graph | Sequence[Graph],
    metadata: Mapping[str, str],
    mixing: Mixing | None = None,
    shapes: Mapping[str, Sequence[int]] | None = None,
) -> bytes:
    """Write a graph, or the graphs of a state's nodes, as an ONNX file.

    Args:
        metadata: entries of the file.
        mixing: how a state mixes several graphs.
        shapes: for some outputs, the axes into which their rows are cut. Outputs of one row have the shape [N].

    Raises:
        InputError: numbers that float32 cannot hold; graphs that differ in more than numbers.
    """
    # Twice: the first pass finds parts that can be taken from other values, and so leaves values without a use.
    kept = [pruned(pruned(g)) for g in ([graphs] if isinstance(graphs, Graph) else graphs)]
    if not same_structure(kept):
        raise InputError("export", "nodes", "(graphs that differ)", "models of one structure at every node")
    writer = _Writer(kept, mixing)
    body = writer.body(shapes or {})
    inputs = {n.name: n for g in ([mixing.graph] if mixing else []) + [kept[0]] for n in g.nodes if n.name}
    ordered = sorted(inputs.values(), key=lambda n: (n.per_call, n.name == "state"))
    given = [value_proto(n.name, FLOAT, _shape(n)) for n in ordered]
    results = [value_proto(*result) for result in writer.results]
    return model_proto(body, given, results, list(writer.tensors.values()), metadata, (IR_VERSION, OPSET))


def _shape(node: Node) -> list[int | str]:
    """Return the shape of an input or a table."""
    if node.kind == "table":
        return ["cells", node.rows]
    return [node.rows] if node.per_call else [node.rows, "N"]


@dataclass(frozen=True)
class _Linear:
    """weight [T, R, K] @ value + bias [T, R], not yet written: an affine of it folds the weight into its own matrix."""

    value: str
    weight: Array
    bias: Array


@dataclass(frozen=True)
class _Longer:
    """A value with further rows: sums of pairs of its rows stand before its own row `at`."""

    name: str
    at: int
    sums: int

    def place(self, row: int) -> int:
        return row if row < self.at else row + self.sums


class _Writer:
    """Writes graphs as nodes of ONNX. Values are named by strings; arrays have the graphs on their first axis, T."""

    def __init__(self, graphs: Sequence[Graph], mixing: Mixing | None = None, prefix: str = "") -> None:
        self.graphs, self.mixing, self.prefix = graphs, mixing, prefix
        self.nodes: list[tuple[Sequence[str], Sequence[str], bytes]] = []  # inputs, outputs, the node
        self.tensors: dict[str, bytes] = {}
        self.results: list[tuple[str, int, list[int | str]]] = []
        self.known: dict[int, str | _Linear | _Longer] = {}
        self.linear: dict[int, _Linear] = {}  # values that are known to be linear, written or not
        self.inputs: dict[str, str] = {}
        self._constants: dict[tuple[bytes, str, tuple[int, ...]], str] = {}
        self._moved: dict[tuple[bytes, tuple[int, ...]], tuple[str, Array, tuple[int, ...]]] = {}
        # tensors of squares of x_i and x_i + x_j, with their rows
        self._squares: dict[int, tuple[str, dict[tuple[int, int], int]]] = {}

    def body(self, shapes: Mapping[str, Sequence[int]]) -> list[bytes]:
        """Return all nodes that the results need, with the constants and results."""
        if self.mixing is not None:
            names = {n.name for n in self.mixing.graph.nodes if n.kind == "input"}
            self.inputs = {name: f"{name}_in_state" for name in names & set(self.mixing.graph.outputs)}
        graph = self.graphs[0]
        for number, node in enumerate(graph.nodes):
            self.known[number] = made = self._made(number, node)
            if isinstance(made, _Linear):
                self.linear[number] = made
        for name, value in graph.outputs.items():
            self._result(name, self.name(value.number), value.node, shapes.get(name))
        needed, nodes = {name for name, *_ in self.results}, list[bytes]()
        # without those that nothing needs: onnxruntime would run them
        for inputs, outputs, written in reversed([*self._state(), *self.nodes]):
            if needed.intersection(outputs):
                needed.update(inputs)
                nodes.append(written)
        self.tensors = {name: tensor for name, tensor in self.tensors.items() if name in needed}
        return nodes[::-1]

    def _made(self, number: int, node: Node) -> str | _Linear | _Longer:
        arrays = [np.stack([g.nodes[number].arrays[i] for g in self.graphs]) for i in range(len(node.arrays))]
        rule = _RULES.get(node.kind)
        if rule is not None:
            return rule(self, number, node, arrays)
        if node.kind in ("add", "sub", "mul") and (linear := self.shifted(node)):
            return linear
        return self.op(_SIMPLE[node.kind], *(self.name(k) for k in node.inputs))

    def _result(self, name: str, value: str, node: Node, shape: Sequence[int] | None) -> None:
        axes: list[int | str] = [*(shape or ([node.rows] if node.rows > 1 else [])), "N"]
        if len(axes) == 2:
            self.op("Identity", value, out=name)
        else:
            self.op("Reshape", value, self.const([*axes[:-1], -1], np.int64), out=name)
        self.results.append((name, INT32 if node.kind == "whole" else FLOAT, axes))

    def shifted(self, node: Node) -> _Linear | None:
        """Return the sum or product of a linear value and numbers; None for all else."""
        pair, kinds = [self.linear.get(k) for k in node.inputs], [self.graphs[0].nodes[k].kind for k in node.inputs]
        at = next((i for i in (0, 1) if pair[i] and kinds[1 - i] == "constant"), None)
        if at is None or (value := pair[at]) is None or node.rows != self.graphs[0].nodes[node.inputs[at]].rows:
            return None
        numbers = np.stack([g.nodes[node.inputs[1 - at]].arrays[0] for g in self.graphs])
        if node.kind == "mul":
            return _Linear(value.value, value.weight * numbers[:, :, None], value.bias * numbers)
        own, other = (-1.0 if node.kind == "sub" and i == 1 else 1.0 for i in (at, 1 - at))
        return _Linear(value.value, own * value.weight, own * value.bias + other * numbers)

    def name(self, number: int) -> str:
        """Return the tensor of a node's value."""
        value = self.known[number]
        if isinstance(value, _Linear):
            self.known[number] = value = self.affine(value.weight, value.value, value.bias)
        return (
            _take_rows(self, number, range(self.graphs[0].nodes[number].rows)) if isinstance(value, _Longer) else value
        )

    def op(self, kind: str, *inputs: str, out: str | None = None, domain: str = "", **attributes: int) -> str:
        """Append a node with one output and return its name."""
        name = out or f"{self.prefix}{kind}_{len(self.nodes)}"
        number = f"{self.prefix}n{len(self.nodes)}"
        self.nodes.append((inputs, [name], node_proto(kind, inputs, [name], number, domain, **attributes)))
        return name

    def const(self, value: ArrayLike, dtype: type = np.float32) -> str:
        """Return a constant of all graphs; equal ones are stored once."""
        with np.errstate(over="ignore"):
            array: NDArray[Any] = np.ascontiguousarray(np.asarray(value, dtype=dtype))
        if array.dtype.kind == "f" and not np.isfinite(array).all():
            raise InputError("export", "weights", "(NaN or infinity)", "finite numbers, in float32 too")
        key = (array.tobytes(), array.dtype.str, array.shape)
        if key not in self._constants:
            self._constants[key] = f"c{len(self._constants)}"
            self.tensors[self._constants[key]] = tensor_proto(array, self._constants[key])
        return self._constants[key]

    def numbers(self, stack: Array) -> str:
        """Return numbers [T, ...] of each graph: a constant where they agree, else a value that follows the state."""
        if len(stack) == 1 or (stack == stack[0]).all():
            return self.const(stack[0])
        assert self.mixing is not None
        rows = self.mixing.transform @ stack.reshape(len(stack), -1)
        key = (rows.tobytes(), stack.shape[1:])
        return self._moved.setdefault(key, (f"state_c{len(self._moved)}", rows, stack.shape[1:]))[0]

    def affine(self, weight: Array, value: str, bias: Array) -> str:
        """Write weight [T, R, K] @ value [K, N] + bias [T, R]."""
        if not np.any(bias):
            return self.op("MatMul", self.numbers(weight), value)
        return self.op("Gemm", self.numbers(weight), value, self.numbers(bias[:, :, None]))

    def split(self, value: str, sizes: Sequence[int]) -> list[str]:
        """Cut a value along its first axis."""
        if len(sizes) == 1:
            return [value]
        number = len(self.nodes)
        names = [f"{self.prefix}Split_{number}_{i}" for i in range(len(sizes))]
        inputs = [value, self.const(list(sizes), np.int64)]
        self.nodes.append((inputs, names, node_proto("Split", inputs, names, f"{self.prefix}n{number}", axis=0)))
        return names

    def rows(self, value: str, rows: Sequence[int]) -> str:
        """Copy rows of a value; Split takes twice as long."""
        return self.op("Gather", value, self.const(list(rows), np.int64), axis=0)

    def concat(self, names: Sequence[str]) -> str:
        return names[0] if len(names) == 1 else self.op("Concat", *names, axis=0)

    def _state(self) -> list[tuple[Sequence[str], Sequence[str], bytes]]:
        """Return the nodes that compute all values that follow the state.

        They are one matrix product, whose result is cut and shaped.
        """
        if self.mixing is None:
            return []
        if not self._moved and "features" in self.mixing.graph.outputs:
            outputs = {k: v for k, v in self.mixing.graph.outputs.items() if k != "features"}
            graph = pruned(self.mixing.graph, outputs)
        else:
            graph = pruned(self.mixing.graph)
        before = _Writer([graph], prefix="state_")
        before.tensors, before._constants = self.tensors, self._constants
        for number, node in enumerate(graph.nodes):
            before.known[number] = before._made(number, node)
        for name, value in graph.outputs.items():
            if name in self.inputs:
                before.op("Identity", before.name(value.number), out=self.inputs[name])
        if self._moved:
            rows = np.concatenate([rows for _, rows, _ in self._moved.values()], axis=1)
            features = before.op(
                "Reshape", before.name(graph.outputs["features"].number), before.const([1, -1], np.int64)
            )
            row = before.op("MatMul", features, before.const(rows))
            flat = before.op("Reshape", row, before.const([-1], np.int64))
            parts = before.split(flat, [math.prod(shape) for _, _, shape in self._moved.values()])
            for part, (name, _, shape) in zip(parts, self._moved.values(), strict=True):
                before.op("Reshape", part, before.const(list(shape), np.int64), out=name)
        return before.nodes


def _input(w: _Writer, number: int, node: Node, arrays: list[Array]) -> str:
    name = w.inputs.get(node.name, node.name)
    if node.per_call and node.rows > 1:  # as a column, like all values of the call
        return w.op("Reshape", name, w.const([-1, 1], np.int64))
    return name


def _take_rows(w: _Writer, source: int, rows: Sequence[int]) -> str:
    value = w.known[source]
    longer = value if isinstance(value, _Longer) else _Longer(w.name(source), w.graphs[0].nodes[source].rows, 0)
    return w.rows(longer.name, [longer.place(r) for r in rows])


def _concat(w: _Writer, number: int, node: Node, arrays: list[Array]) -> str:
    nodes = w.graphs[0].nodes
    of_rays = [k for k in node.inputs if not nodes[k].per_call]
    names = []
    for k in node.inputs:
        name = w.name(k)
        if of_rays and nodes[k].per_call and nodes[k].rows == nodes[of_rays[0]].rows == 1:  # repeated for every ray
            name = w.op("Clip", w.name(of_rays[0]), name, name)
        elif of_rays and nodes[k].per_call:
            zeros = w.const(np.zeros((nodes[k].rows, nodes[of_rays[0]].rows)))
            name = w.op("Add", w.op("MatMul", zeros, w.name(of_rays[0])), name)
        elif nodes[k].per_call and nodes[k].rows == 1:  # [1] becomes a part of a column
            name = w.op("Reshape", name, w.const([1, 1], np.int64))
        names.append(name)
    return w.concat(names)


def _affine(w: _Writer, number: int, node: Node, arrays: list[Array]) -> str | _Longer:
    weight, bias = arrays[:2]
    moving, added = node.static
    source = w.known[node.inputs[0]]
    if moving:
        # Sums of rows that a quadratic wants are further rows of the same product.
        sums = _mixed_pairs(w.graphs[0], number)
        at = 1 + max((max(pair) for pair in sums), default=0)
        base, change = (
            np.concatenate([m[:, :at], *(m[:, [i]] + m[:, [j]] for i, j in sums), m[:, at:]], 1)
            for m in (weight, arrays[2])
        )
        column = w.graphs[0].nodes[node.inputs[0]].kind == "constant"
        if column:  # is multiplied by the weights here, before state and call are known
            columns = np.stack([g.nodes[node.inputs[0]].arrays[0] for g in w.graphs])[:, :, None]
            base, change = base @ columns, change @ columns
        matrix = w.op("Add", w.op("Mul", w.name(node.inputs[1]), w.numbers(change)), w.numbers(base))
        if column:
            return matrix
        if added:
            return w.op("Gemm", matrix, w.name(node.inputs[0]), w.name(node.inputs[-1]))
        whole = w.op("MatMul", matrix, w.name(node.inputs[0]))
        if not sums:
            return whole
        longer = _Longer(whole, at, len(sums))
        w._squares[number] = (w.op("Mul", whole, whole), _places(longer, node.rows, sums))
        return longer
    if isinstance(source, _Linear):
        bias = bias + np.einsum("trk,tk->tr", weight, source.bias)
        weight, value = weight @ source.weight, source.value
    else:
        value = w.name(node.inputs[0])
    if added:
        if bias.any():
            raise ValueError("affine: numbers and rows to add: give the numbers to the rows")
        return w.op("Gemm", w.numbers(weight), value, w.name(node.inputs[-1]))
    return w.affine(weight, value, bias)


def _mixed_pairs(graph: Graph, number: int) -> list[tuple[int, int]]:
    """Return the pairs of different rows of a value that its quadratic forms multiply."""
    quadratics = (n for n in graph.nodes if n.kind == "quadratic" and n.inputs[0] == number)
    return sorted({p for n in quadratics for form in n.static for p in form if p[0] != p[1]})


def _quadratic(w: _Writer, number: int, node: Node, arrays: list[Array]) -> _Linear:
    """Write products by squares, x y = ((x + y)^2 - x^2 - y^2) / 2, so that one pass makes them all."""
    source = node.inputs[0]
    rows = w.graphs[0].nodes[source].rows
    if source not in w._squares:
        sums, name = _mixed_pairs(w.graphs[0], source), w.name(source)
        if sums:
            left, right = (_take_rows(w, source, [p[k] for p in sums]) for k in (0, 1))
            name = w.concat([name, w.op("Add", left, right)])
        w._squares[source] = (w.op("Mul", name, name), _places(_Longer(name, rows, len(sums)), rows, sums))
    squares, place = w._squares[source]
    matrix = np.zeros((node.rows, len(place)))
    for r, form in enumerate(node.static):
        for i, j in form:
            if i == j:
                matrix[r, place[i, i]] += 1
            else:
                matrix[r, place[i, j]] += 0.5
                matrix[r, [place[i, i], place[j, j]]] -= 0.5
    return _Linear(squares, np.repeat(matrix[None], len(w.graphs), 0), arrays[0])


def _places(longer: _Longer, rows: int, sums: Sequence[tuple[int, int]]) -> dict[tuple[int, int], int]:
    """Return where the squares of rows (i, i) and of sums of two rows (i, j) stand."""
    return {(i, i): longer.place(i) for i in range(rows)} | {pair: longer.at + k for k, pair in enumerate(sums)}


def _polynomial(w: _Writer, number: int, node: Node, arrays: list[Array]) -> str:
    """Write monomials of degree 2, of 3 to 4, of 5 to 8 ..., each a product of two from the blocks before."""
    exponents, weight = node.arrays[0], arrays[1]
    used = (weight != 0).any((0, 1))
    table = {tuple(e): weight[:, :, k] for e, k in zip(exponents[used].tolist(), np.flatnonzero(used), strict=True)}
    variables = exponents.shape[1]
    units = [tuple(int(i == v) for i in range(variables)) for v in range(variables)]
    blocks = [(w.name(node.inputs[0]), units)]
    for level, pairs in plan_products(list(table), variables).items():
        made = [_products(w, blocks, group) for group in by_block(blocks, pairs)]
        if level == 1:
            # Degrees 1 and 2 are the factors of all that follows: together they need one gather, not two.
            names, lists = zip(*blocks, *made, strict=True)
            blocks = [(w.concat(names), [e for known in lists for e in known])]
        else:
            blocks += made
    out, nothing = "", np.zeros(weight.shape[:2])
    alone = blocks_alone(blocks)
    names, lists = zip(*blocks[alone:], strict=True)
    for name, known in [*blocks[:alone], (w.concat(names), [e for each in lists for e in each])]:
        part = np.stack([table.get(e, nothing) for e in known], axis=2)
        if not out:
            out = w.affine(part, name, table.get((0,) * variables, nothing))
        else:
            out = w.op("Gemm", w.numbers(part), name, out)
    return out


def _series(w: _Writer, number: int, node: Node, arrays: list[Array]) -> str:
    """Write Horner's scheme; a leading 1 costs nothing."""
    t, coefficients = w.name(node.inputs[0]), arrays[0]
    value = t if (coefficients[:, -1] == 1).all() else w.op("Mul", t, w.numbers(coefficients[:, -1]))
    for k in range(coefficients.shape[1] - 2, -1, -1):
        if coefficients[:, k].any():
            value = w.op("Add", value, w.numbers(coefficients[:, k]))
        if k:
            value = w.op("Mul", value, t)
    return value


def _divided(w: _Writer, number: int, node: Node, arrays: list[Array]) -> str:
    above, below = node.inputs
    inverse = _is_constant(w, above, 1.0)
    return w.op("Reciprocal", w.name(below)) if inverse else w.op("Div", w.name(above), w.name(below))


def _larger(w: _Writer, number: int, node: Node, arrays: list[Array]) -> str:
    relu = _is_constant(w, node.inputs[1], 0.0)
    return w.op("Relu", w.name(node.inputs[0])) if relu else w.op("Max", *(w.name(k) for k in node.inputs))


def _is_constant(w: _Writer, number: int, value: float) -> bool:
    return all(g.nodes[number].kind == "constant" and (g.nodes[number].arrays[0] == value).all() for g in w.graphs)


def _clip(w: _Writer, number: int, node: Node, arrays: list[Array]) -> str:
    return w.op("Clip", w.name(node.inputs[0]), w.numbers(arrays[0][:, 0]), w.numbers(arrays[0][:, 1]))


def _between(w: _Writer, number: int, node: Node, arrays: list[Array]) -> str:
    """Write a test that is false for NaN, whatever Clip makes of that."""
    x, limits = w.name(node.inputs[0]), arrays[0]  # [T, R, 2]
    if node.rows == 1:
        low, high = (w.numbers(limits[:, 0, k]) for k in (0, 1))
        return w.op("Equal", x, w.op("Clip", x, low, high))
    low, high = (w.numbers(limits[:, :, k : k + 1]) for k in (0, 1))
    return w.op("And", w.op("GreaterOrEqual", x, low), w.op("LessOrEqual", x, high))


def _first_failure(w: _Writer, number: int, node: Node, arrays: list[Array]) -> str:
    status, tests = w.const(0.0), zip(node.inputs[::2], node.inputs[1::2], node.static, strict=True)
    for value, limit, code in reversed([*tests]):  # NaN fails
        status = w.op("Where", w.op("LessOrEqual", w.name(value), w.name(limit)), status, w.const(float(code)))
    return status


def _lookup(w: _Writer, number: int, node: Node, arrays: list[Array]) -> str:
    """Take columns one by one, so that rays are the last axis: to gather whole cells takes three times as long."""
    table, index, weights = (w.name(k) for k in node.inputs)
    nodes = [w.graphs[0].nodes[k] for k in node.inputs]
    (columns, indices, count), own = (n.rows for n in nodes), nodes[0].arrays
    groups, total = count // indices, ""
    # onnxruntime refuses an index beyond the table.
    if own:
        last = w.const(len(own[0]) - 1, np.int64)
    else:
        cells = w.op("Gather", w.op("Shape", table), w.const(1, np.int64))
        last = w.op("Sub", cells, w.const(1, np.int64))
    for k, weight in zip(w.split(index, [1] * indices), w.split(weights, [groups] * indices), strict=True):
        cell = w.op("Clip", w.op("Cast", k, to=INT64), w.const(0, np.int64), last)
        rows = w.op("ArrayFeatureExtractor", table, cell, domain=ML)
        parts = w.op("Reshape", rows, w.const([groups, columns // groups, -1], np.int64))
        product = w.op("Mul", parts, w.op("Reshape", weight, w.const([groups, 1, -1], np.int64)))
        # Summed by a product with ones: ReduceSum takes seven times as long.
        one = w.op("MatMul", w.const(np.ones((1, groups))), w.op("Reshape", product, w.const([groups, -1], np.int64)))
        total = w.op("Add", total, one) if total else one
    total = w.op("Reshape", total, w.const([columns // groups, -1], np.int64))
    whole_row = node.static == tuple(range(columns // groups))
    return total if whole_row else w.op("Gather", total, w.const(list(node.static), np.int64), axis=0)


def _table(w: _Writer, number: int, node: Node, arrays: list[Array]) -> str:
    """Write a table by columns."""
    return w.numbers(arrays[0].swapaxes(1, 2)) if arrays else w.op("Transpose", node.name)


_SIMPLE = {
    "add": "Add", "sub": "Sub", "mul": "Mul", "min": "Min", "neg": "Neg", "sqrt": "Sqrt", "tanh": "Tanh", "abs": "Abs",
    "floor": "Floor", "le": "LessOrEqual", "and": "And", "select": "Where",
}  # fmt: skip
_RULES: dict[str, Callable[[_Writer, int, Node, list[Array]], str | _Linear | _Longer]] = {
    "input": _input,
    "constant": lambda w, number, node, arrays: w.numbers(arrays[0] if node.rows == 1 else arrays[0][:, :, None]),
    "take": lambda w, number, node, arrays: _take_rows(w, node.inputs[0], node.static),
    "concat": _concat,
    "affine": _affine,
    "quadratic": _quadratic,
    "polynomial": _polynomial,
    "series": _series,
    "div": _divided,
    "max": _larger,
    "clip": _clip,
    "between": _between,
    "first_failure": _first_failure,
    "table": _table,
    "lookup": _lookup,
    "whole": lambda w, number, node, arrays: w.op("Cast", w.name(node.inputs[0]), to=INT32),
}


def _products(w: _Writer, blocks: list[Block], pairs: dict[Exponent, Pair]) -> Block:
    """Write one block of products: their left factors lie in one block, and so do their right factors."""
    factors = []
    for side in (0, 1):
        wanted = [pair[side] for pair in pairs.values()]
        name, known = next(block for block in blocks if wanted[0] in block[1])
        factors.append(w.op("Gather", name, w.const([known.index(e) for e in wanted], np.int64), axis=0))
    return w.op("Mul", *factors), list(pairs)
