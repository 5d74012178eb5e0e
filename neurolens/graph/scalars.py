"""Graphs as programs of float steps, one ray at a time, from which C, GLSL and OSL are written.

Several graphs of one structure (one for each of several fixed wavelengths) become one program with as many coefficient
tables. Polynomials take few products; sums of products are fused multiply-adds, numbers are folded.
"""

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from neurolens.base.errors import InputError
from neurolens.graph.ir import Exponents, Graph, Node, pruned, same_structure
from neurolens.graph.program import Expr, Program, row_names

Array = NDArray[np.float64]
# A truth as pairs (a, b): it holds where a <= b in all of them.
Tests = list[tuple[Expr, Expr]]
# The most weights of matrices: each becomes a step, for which compilers take minutes; onnxruntime takes larger ones.
MOST_WEIGHTS = 20_000
# tests up to which one choice waits for the next, which takes fewer operations than parts
_CHAIN = 16
_ROWS = 8  # of a matrix product at a time, on 16 registers; fewer would wait for one another


def lower(graphs: Graph | Sequence[Graph], fixed: Mapping[str, ArrayLike] | None = None) -> Program:
    """Write a graph, or several of one structure with a coefficient table each, as a program.

    Inputs and outputs are named row by row, see `program.row_names`. Inputs that nothing needs are left out.

    Args:
        fixed: numbers for inputs of the call, which are folded in.

    Raises:
        InputError: graphs that differ in more than numbers, or with more than `MOST_WEIGHTS`; numbers that float32
            cannot hold.
    """
    kept = [pruned(g) for g in ([graphs] if isinstance(graphs, Graph) else graphs)]
    if not same_structure(kept):
        raise InputError("export", "models", "(graphs that differ)", "models of one structure")
    weights = sum(node.arrays[0].size for node in kept[0].nodes if node.kind == "affine")
    if weights > MOST_WEIGHTS:
        raise InputError("export", "weights", weights, f"at most {MOST_WEIGHTS}: larger networks are for onnxruntime")
    return _Lowering(kept, fixed or {}).program


class _Lowering:
    def __init__(self, graphs: Sequence[Graph], fixed: Mapping[str, ArrayLike]) -> None:
        self.graphs, self.fixed = graphs, fixed
        self.program = Program(tables=len(graphs))
        self.rows: list[list[Any]] = []  # of every node: Expr, or Tests for truths
        for number, node in enumerate(graphs[0].nodes):
            given = [self.rows[k] for k in node.inputs]
            rule = _RULES.get(node.kind)
            if rule is not None:
                arrays = [np.stack([g.nodes[number].arrays[i] for g in graphs], -1) for i in range(len(node.arrays))]
                self.rows.append(rule(self, node, given, arrays))
            else:
                # A single row stands for any.
                operands = ([v[r if len(v) > 1 else 0] for v in given] for r in range(node.rows))
                self.rows.append([self._each(node.kind, *each) for each in operands])
        for name, value in graphs[0].outputs.items():
            rows = [self._number(v) for v in self.rows[value.number]]
            self.program.outputs.update(zip(row_names(name, len(rows)), rows, strict=True))

    def _number(self, value: Expr | Tests) -> Expr:
        """Return a truth as 1 or 0."""
        if isinstance(value, Expr):
            return value
        return self._choice(value, self.program.literal(1.0), self.program.literal(0.0))

    def _choice(self, tests: Tests, then: Expr, otherwise: Expr) -> Expr:
        for low, high in tests:
            then = self.program.select(low, high, then, otherwise)
        return then

    def _each(self, kind: str, *given: Any) -> Any:
        p = self.program
        if kind == "and":
            return [*self._tests(given[0]), *self._tests(given[1])]
        if kind == "le":
            return [(self._number(given[0]), self._number(given[1]))]
        if kind == "select":
            return self._choice(self._tests(given[0]), self._number(given[1]), self._number(given[2]))
        numbers = [self._number(v) for v in given]
        if kind == "add":
            return p.sum(*numbers)
        if kind == "tanh":
            return p.tanh(numbers[0])
        if kind == "abs":
            return p.op("max", numbers[0], -numbers[0])
        return numbers[0] if kind == "whole" else p.op(kind, *numbers)

    def _tests(self, truth: Expr | Tests) -> Tests:
        return [(self.program.literal(0.5), truth)] if isinstance(truth, Expr) else truth


def _input(at: _Lowering, node: Node, given: list[list[Expr]], arrays: list[Array]) -> list[Expr]:
    if node.name in at.fixed:
        return [at.program.literal(v) for v in np.atleast_1d(np.asarray(at.fixed[node.name], np.float64))]
    # An input without a use is no argument: steps are appended when something takes them.
    return [at.program.input(name, node.per_call) for name in row_names(node.name, node.rows)]


def _affine(at: _Lowering, node: Node, given: list[list[Expr]], arrays: list[Array]) -> list[Expr]:
    """Multiply by a matrix, in groups of rows whose sums fit the registers; a column serves all rows of a group."""
    p, x = at.program, given[0]
    moving, added = node.static
    found = [p.literal(bias) for bias in arrays[1]]
    if added:
        found = [total + row for total, row in zip(found, given[-1], strict=True)]
    if moving:
        for r, (base, change) in enumerate(zip(arrays[0], arrays[2], strict=True)):
            # The largest product comes last: it is rounded once, with the sum.
            for c in np.argsort(np.abs(base + change).max(-1), kind="stable"):
                found[r] = p.fma(x[c], _moved(p, given[1][0], base[c], change[c]), found[r])
        return found
    for rows in np.array_split(np.arange(node.rows), max(1, round(node.rows / _ROWS))):
        for c in range(len(x)):
            for r in rows:
                weight = p.literal(arrays[0][r, c])
                # A product times 1 and the sum are one operation.
                found[r] = p.sum(x[c], found[r]) if weight.is_literal(1) else p.fma(x[c], weight, found[r])
    return found


def _moved(p: Program, s: Expr, base: Array, change: Array) -> Expr:
    """Return base + s change, written with 1 - s, which is exact at infinity focus, where the two would cancel."""
    if not base.any():
        return s * p.literal(change)
    return p.fma(p.literal(1.0) - s, p.literal(-change), p.literal(base + change)) if change.any() else p.literal(base)


def _quadratic(at: _Lowering, node: Node, given: list[list[Expr]], arrays: list[Array]) -> list[Expr]:
    found = []
    for form, bias in zip(node.static, arrays[0], strict=True):
        total = at.program.literal(bias)
        for i, j in reversed(form):
            total = at.program.fma(given[0][i], given[0][j], total)
        found.append(total)
    return found


def _polynomial(at: _Lowering, node: Node, given: list[list[Expr]], arrays: list[Array]) -> list[Expr]:
    """Make each monomial once, by one multiplication, and use it at once in every row: few stay in registers."""
    p, variables = at.program, given[0]
    table = _collected(variables, node.arrays[0], arrays[1])
    rows = [p.literal(c) for c in table.pop((0,) * len(variables), np.zeros((node.rows, p.tables)))]
    made = {tuple(int(i == v) for i in range(len(variables))): value for v, value in enumerate(variables)}
    for e, factors in plan_monomials(list(table), len(variables)):
        if factors is not None:
            made[e] = made[factors[0]] * made[factors[1]]
        if e in table:
            rows = [
                p.fma(made[e], p.literal(c), row) if c.any() else row for c, row in zip(table[e], rows, strict=True)
            ]
    return rows


def _collected(variables: Sequence[Expr], exponents: Exponents, weight: Array) -> dict[tuple[int, ...], Array]:
    """Return the coefficients [R, T] of the monomials that occur; variables that are numbers are multiplied in."""
    numbers = {v: np.array(e.literal) for v, e in enumerate(variables) if e.literal is not None}
    table: dict[tuple[int, ...], Array] = {}
    for e, column in zip(exponents.tolist(), np.moveaxis(weight, 1, 0), strict=True):
        for v, number in numbers.items():
            if e[v]:
                column, e[v] = column * number ** e[v], 0
        if column.any():
            key = tuple(e)
            table[key] = table[key] + column if key in table else column
    return table


def _between(at: _Lowering, node: Node, given: list[list[Expr]], arrays: list[Array]) -> list[Tests]:
    p = at.program
    limits = [(p.literal(low), p.literal(high)) for low, high in arrays[0]]
    return [[(low, x), (x, high)] for x, (low, high) in zip(given[0], limits, strict=True)]


def _clip(at: _Lowering, node: Node, given: list[list[Expr]], arrays: list[Array]) -> list[Expr]:
    low, high = (at.program.literal(v) for v in arrays[0])
    return [at.program.op("min", at.program.op("max", x, low), high) for x in given[0]]


def _lookup(at: _Lowering, node: Node, given: list[list[Expr]], arrays: list[Array]) -> list[Expr]:
    table, name = at.graphs[0].nodes[node.inputs[0]], f"table_{node.inputs[0]}"
    if not table.arrays:
        name = table.name
    elif any((g.nodes[node.inputs[0]].arrays[0] != table.arrays[0]).any() for g in at.graphs):
        raise InputError("export", "models", "(tables of numbers that differ)", "one wavelength, or none fixed")
    else:
        at.program.own_tables[name] = table.arrays[0]
    columns = table.rows * len(given[1]) // len(given[2])
    return [at.program.lookup(name, columns, column, given[1], given[2]) for column in node.static]


def _first_failure(at: _Lowering, node: Node, given: list[list[Expr]], arrays: list[Array]) -> list[Expr]:
    tests = [(given[2 * k][0], given[2 * k + 1][0], float(code)) for k, code in enumerate(node.static)]
    return [_first_of(at.program, tests)]


def _first_of(p: Program, tests: list[tuple[Expr, Expr, float]]) -> Expr:
    """Return the code of the first test that fails.

    Many tests are cut into groups, so that none waits for the last: where all codes before a cut are above those behind
    it, the larger of two results is the first failure's.
    """
    status = p.literal(0.0)
    if not tests:
        return status
    codes = [code for *_, code in tests]
    ends = [k for k in range(1, len(tests)) if len(tests) > _CHAIN and min(codes[:k]) > max(codes[k:])]
    if not ends:
        low, high, code = tests[0]
        return p.select(low, high, _first_of(p, tests[1:]), code)
    for start, end in zip([0, *ends], [*ends, None], strict=True):
        status = p.op("max", status, _first_of(p, tests[start:end])) if start else _first_of(p, tests[:end])
    return status


_RULES: dict[str, Callable[[_Lowering, Node, list[Any], list[Array]], list[Any]]] = {
    "input": _input,
    "constant": lambda at, node, given, arrays: [at.program.literal(v) for v in arrays[0]],
    "take": lambda at, node, given, arrays: [given[0][r] for r in node.static],
    "concat": lambda at, node, given, arrays: [row for part in given for row in part],
    "clip": _clip,
    "affine": _affine,
    "quadratic": _quadratic,
    "polynomial": _polynomial,
    "series": lambda at, node, given, arrays: [at.program.horner(x, list(arrays[0])) for x in given[0]],
    "between": _between,
    "first_failure": _first_failure,
    "table": lambda at, node, given, arrays: [],
    "lookup": _lookup,
}


# ---- plans that make each monomial as the product of two others ----

Exponent = tuple[int, ...]
Pair = tuple[Exponent, Exponent]
Block = tuple[str, list[Exponent]]  # a name, and the monomials of its rows
Made = tuple[Exponent, Pair | None]  # a monomial and the two that it is the product of


def plan_monomials(wanted: Sequence[Exponent], variables: int) -> list[Made]:
    """Return an order in which every monomial is a variable (None) or the product of two before it.

    Factors that exist anyway are taken first, else those that add least. The order is depth first: the factors of a
    monomial were made just before it.
    """
    units = [tuple(int(i == v) for i in range(variables)) for v in range(variables)]
    factors: dict[Exponent, Pair] = {}
    known = {*units, *wanted}

    def resolve(e: Exponent) -> None:
        if sum(e) == 1 or e in factors:
            return
        _, _, left, right = min((sum(f not in known for f in {*pair}), sum(pair[1]), *pair) for pair in _splits(e))
        known.update((left, right))
        factors[e] = (left, right)
        resolve(left)
        resolve(right)

    for e in sorted(wanted, key=lambda e: (sum(e), e), reverse=True):
        resolve(e)
    return _depth_first([*units, *sorted(factors, key=lambda e: (sum(e), e))], factors, set(wanted))


def _splits(e: Exponent) -> Iterator[Pair]:
    """Yield all pairs of monomials whose product is e, the right one of no higher degree."""
    for right in product(*(range(k + 1) for k in e)):
        if 0 < sum(right) <= sum(e) // 2:
            yield tuple(a - b for a, b in zip(e, right, strict=True)), right


def _depth_first(nodes: list[Exponent], factors: dict[Exponent, Pair], wanted: set[Exponent]) -> list[Made]:
    """Order nodes with factors first; each node is followed by those that waited for it alone."""
    waiting: dict[Exponent, set[Exponent]] = {e: set(pair) for e, pair in factors.items()}
    order: list[Made] = []
    stack = [e for e in reversed(nodes) if e not in factors]
    while stack:
        e = stack.pop()
        order.append((e, factors.get(e)))
        for child in sorted((c for c, missing in waiting.items() if e in missing), reverse=True):
            waiting[child].discard(e)
            if not waiting[child]:
                del waiting[child]
                stack.append(child)
    return [(e, pair) for e, pair in order if pair is not None or e in wanted]


def level_of(e: Exponent) -> int:
    """Return the level of a monomial: 0 for a variable, 1 for degree 2, 2 for 3 to 4, 3 for 5 to 8 ..."""
    return (sum(e) - 1).bit_length()


def plan_products(exponents: list[Exponent], variables: int) -> dict[int, dict[Exponent, Pair]]:
    """Plan every monomial as a product of two of lower levels, greedily: {level: {monomial: (left, right)}}.

    Factors that are wanted anyway come first, then small right factors; factors that are missing are added.
    """
    wanted = {e for e in exponents if sum(e) > 1}
    parents: dict[Exponent, Pair] = {}
    # From the highest degree down, so that an added factor is still ahead in the loop.
    queue = sorted(wanted, key=lambda e: (sum(e), e))
    while queue:
        e = queue.pop()
        options = []
        for left, right in _splits(e):
            if level_of(left) < level_of(e):
                missing = sum(sum(part) > 1 and part not in wanted for part in {left, right})
                options.append((missing, level_of(right), sum(right), left, right))
        *_, left, right = min(options)
        parents[e] = (left, right)
        for part in (left, right):
            if sum(part) > 1 and part not in wanted:
                wanted.add(part)
                queue = sorted([*queue, part], key=lambda e: (sum(e), e))
    levels = sorted({level_of(e) for e in parents})
    return {n: {e: pair for e, pair in parents.items() if level_of(e) == n} for n in levels}


def by_block(blocks: Sequence[Block], pairs: dict[Exponent, Pair]) -> list[dict[Exponent, Pair]]:
    """Group products by the blocks in which their two factors lie."""
    home = {e: i for i, (_, known) in enumerate(blocks) for e in known}
    groups: dict[tuple[int, int], dict[Exponent, Pair]] = {}
    for e, (a, b) in sorted(pairs.items()):
        groups.setdefault((home[a], home[b]), {})[e] = (a, b)
    return list(groups.values())


def blocks_alone(blocks: Sequence[Block]) -> int:
    """Return how many blocks matrix products take one by one; the others are joined, where copying costs less."""
    copy_row, one_product = 0.27, 2.5  # ns a ray, measured in onnxruntime (12 outputs)
    best, alone = math.inf, 0
    for first in range(len(blocks)):
        rows = sum(len(known) for _, known in blocks[first:])
        cost = one_product * first + (copy_row * rows if first < len(blocks) - 1 else 0.0)
        if cost < best:
            best, alone = cost, first
    return alone
