"""Derivatives of graphs: forward-mode differentiation, one rule an operator.

Work that values and derivatives share is done once (Griewank and Walther, "Evaluating Derivatives", 2008, chapter 3):
a polynomial's partial derivatives are further rows of the same polynomial, for they need (nearly) its monomials.

Newton's method solves many small systems at once, limited so that no start makes it diverge. Plain iterations of a
fixed count, as published for lens polynomials, run away where a step leaves the data. Here no step is longer than a
limit, and a point that is worse than the best one so far is replaced by a shorter step from the best one.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import reduce
from operator import mul

import numpy as np
from numpy.typing import NDArray

from neurolens.graph.ir import Exponents, Graph, Node, Value, pruned
from neurolens.graph.program import row_names

Array = NDArray[np.float64]
# A derivative along one direction; None where it is 0.
Moved = Value | None


def derivative(output: str, by: str) -> str:
    """Return the name of the output with the derivatives of an output by one row of an input (`program.row_names`)."""
    return f"{output}_by_{by}"


def with_derivatives(graph: Graph, outputs: Sequence[str], inputs: Sequence[tuple[str, int]]) -> Graph:
    """Add derivatives to a graph's outputs: of each output by each input row, with as many rows as the output.

    They are named by `derivative`. At a choice (select, max, min, clip) the derivative is that of the chosen value.

    Args:
        outputs: the outputs to differentiate. inputs: names and rows of the inputs to differentiate by.
    """
    g = Graph()
    values: dict[int, Value] = {}  # by the old graph's numbers
    known: list[dict[int, Value]] = [{} for _ in inputs]  # derivatives by the new graph's numbers, by direction
    chains: dict[int, tuple[int, Value]] = {}  # of a function of one value: that value, and the derivative by it
    names: dict[tuple[str, int], str] = {}
    for number, node in enumerate(graph.nodes):
        x = [values[k] for k in node.inputs]
        moves: list[list[Moved]] = [[direction.get(v.number) for v in x] for direction in known]
        rule = _RULES.get(node.kind, lambda node, y, x, d: None)  # truths and statuses are piecewise constant
        if node.kind == "polynomial" and any(d[0] is not None for d in moves):
            values[number], rule = _with_gradient(g, node, x[0])
        else:
            values[number] = g.like(node, x)
        y = values[number]
        if node.kind == "input":
            names |= {(node.name, row): name for row, name in enumerate(row_names(node.name, node.rows))}
        base = _base(node, x, moves, chains)
        if base is not None:
            factor = rule(node, y, x, _factors(x, moves, chains))
            if factor is None:
                continue
            chains[y.number] = base, factor
        for (name, row), direction, d in zip(inputs, known, moves, strict=True):
            if node.kind == "input" and node.name == name:
                direction[y.number] = g.constant(np.eye(node.rows)[row])
            elif any(v is not None for v in d):
                moved = rule(node, y, x, d) if base is None else _times(direction[base], chains[y.number][1])
                if moved is not None and not _is_zero(moved):
                    direction[y.number] = moved
    g.outputs = {name: values[v.number] for name, v in graph.outputs.items()}
    for place, direction in zip(inputs, known, strict=True):
        for output in outputs:
            value = g.outputs[output]
            g.outputs[derivative(output, names[place])] = direction.get(value.number) or value * 0.0
    return pruned(g)


def _factors(x: Sequence[Value], moves: Sequence[Sequence[Moved]], chains: dict[int, tuple[int, Value]]) -> list[Moved]:
    """Return the derivatives of an operation's values by the one value that they all depend on."""
    one = x[0].graph.constant(1.0)
    return [
        None if all(d[i] is None for d in moves) else chains[v.number][1] if v.number in chains else one
        for i, v in enumerate(x)
    ]


def _base(
    node: Node, x: Sequence[Value], moves: Sequence[Sequence[Moved]], chains: dict[int, tuple[int, Value]]
) -> int | None:
    """Return the one varying value that a row-by-row operation depends on, where it has as many rows; else None.

    The derivative by that value serves all directions.
    """
    moved = {v.number: v for i, v in enumerate(x) if any(d[i] is not None for d in moves)}
    bases = {chains[n][0] if n in chains else n for n in moved}
    same_rows = all(v.rows == node.rows for v in moved.values())
    return bases.pop() if node.kind in _BY_ROWS and len(bases) == 1 and same_rows else None


def _sum(terms: Sequence[Moved]) -> Moved:
    there = [t for t in terms if t is not None]
    return reduce(Value.__add__, there) if there else None


def _times(a: Moved, b: Value) -> Moved:
    if a is None or _is_one(b):
        return a
    if _is_one(a) and b.rows >= a.rows:
        return b
    column = _column(a) if b.rows == 1 and not b.node.per_call else None
    if column is None:
        return a * b
    base, moving = column
    return a.graph.affine(base, b, moving=moving)


def _column(value: Value) -> tuple[Array, tuple[Value, Array] | None] | None:
    """Return rows as columns if each is a number, or a number plus another times a value of the call; else None."""
    g, node, rows = value.graph, value.node, list(range(value.rows))
    if node.kind == "take":
        node, rows = g.nodes[node.inputs[0]], list(node.static)
    if len(rows) == 1:
        return None
    if node.kind == "constant":
        return node.arrays[0][rows, None], None
    source = g.nodes[node.inputs[0]] if node.inputs else node
    if node.kind != "affine" or node.static != (True, False) or source.kind != "constant" or node.arrays[1].any():
        return None
    base, change = (node.arrays[k][rows] @ source.arrays[0][:, None] for k in (0, 2))
    return base, (Value(g, node.inputs[1]), change)


def _is_one(value: Value) -> bool:
    return value.node.kind == "constant" and bool((value.node.arrays[0] == 1).all())


def _is_zero(value: Value) -> bool:
    """Return whether all rows are 0 for any rays: zero constants, and rows of zero matrices."""
    g, node, rows = value.graph, value.node, list(range(value.rows))
    if node.kind == "take":
        node, rows = g.nodes[node.inputs[0]], list(node.static)
    if node.kind == "constant":
        return not node.arrays[0][rows].any()
    return node.kind == "affine" and not node.static[1] and not any(a[rows].any() for a in node.arrays)


def _concat(node: Node, y: Value, x: Sequence[Value], d: Sequence[Moved]) -> Moved:
    g = y.graph
    return g.concat(*(g.constant(np.zeros(v.rows)) if m is None else m for v, m in zip(x, d, strict=True)))


def _affine(node: Node, y: Value, x: Sequence[Value], d: Sequence[Moved]) -> Moved:
    g, weight = y.graph, node.arrays[0]
    moving, added = node.static
    terms: list[Moved] = [d[-1]] if added else []
    if moving and d[1] is not None:
        terms.append(g.affine(node.arrays[2], x[0]) * d[1])
    if d[0] is not None:
        change = node.arrays[2] if moving else None
        if d[0].node.kind == "constant":  # a column of the matrix
            column = weight @ d[0].node.arrays[0]
            if change is None:
                terms.append(g.constant(column))
            else:
                moved = (x[1], (change @ d[0].node.arrays[0])[:, None])
                terms.append(g.affine(column[:, None], g.constant(1.0), moving=moved))
        else:
            terms.append(g.affine(weight, d[0], moving=None if change is None else (x[1], change)))
    return _sum(terms)


def _quadratic(node: Node, y: Value, x: Sequence[Value], d: Sequence[Moved]) -> Moved:
    """Differentiate sums of products: linear in x where the derivative of x is the same for all rays."""
    g, dx = y.graph, d[0]
    assert dx is not None
    column = _column(dx)
    if column is not None:
        base, moving = column
        change = moving and (moving[0], _linear(node, moving[1][:, 0]))
        return g.affine(_linear(node, base[:, 0]), x[0], moving=change)
    # All products x_i dx_j in one operation, then summed. The twos of squares serve all directions.
    pairs = sorted({pair for form in node.static for i, j in form for pair in ((i, j), (j, i))})
    left, right = (g.take(v, [pair[k] for pair in pairs]) for k, v in enumerate((x[0], dx)))
    products = left * [1.0 + (i == j) for i, j in pairs] * right
    return g.affine([[float(p in form or p[::-1] in form) for p in pairs] for form in node.static], products)


def _linear(node: Node, dx: Array) -> Array:
    """Return the derivative of a quadratic along dx [K], as a matrix [R, K] on x."""
    matrix = np.zeros((node.rows, len(dx)))
    for r, form in enumerate(node.static):
        for i, j in form:
            matrix[r, i] += dx[j]
            matrix[r, j] += dx[i]
    return matrix


def partial_derivatives(exponents: Exponents, weight: Array) -> tuple[Exponents, Array]:
    """Join a polynomial of exponents [M, V] and weights [R, M] with its partial derivatives.

    Returns exponents [M', V] that hold the monomials of all of them, and weights [1 + V, R, M']: the polynomial's,
    then those of each derivative.
    """
    place = {tuple(map(int, e)): i for i, e in enumerate(exponents)}
    used = [int(i) for i in np.flatnonzero(weight.any(0))]
    terms: list[tuple[int, int, int, int]] = []
    for v in range(exponents.shape[1]):
        for i in used:
            e = exponents[i]
            if e[v]:
                lower = tuple(int(k) - (j == v) for j, k in enumerate(e))
                terms.append((1 + v, i, place.setdefault(lower, len(place)), int(e[v])))
    out = np.zeros((1 + exponents.shape[1], len(weight), len(place)))
    out[0, :, : len(exponents)] = weight
    for row, source, target, factor in terms:
        out[row, :, target] += factor * weight[:, source]
    return np.array(list(place), dtype=np.int64).reshape(len(place), exponents.shape[1]), out


def _with_gradient(g: Graph, node: Node, x: Value) -> tuple[Value, Callable[..., Moved]]:
    exponents, weight = partial_derivatives(*node.arrays)
    value, *gradient = g.split(
        g.polynomial(exponents, weight.reshape(-1, len(exponents)), x), [node.rows] * len(weight)
    )

    def rule(node: Node, y: Value, x: Sequence[Value], d: Sequence[Moved]) -> Moved:
        dx = d[0]
        assert dx is not None
        return _sum([part * dx[v] for v, part in enumerate(gradient) if not _is_zero(dx[v])])

    return value, rule


def _series(node: Node, y: Value, x: Sequence[Value], d: Sequence[Moved]) -> Moved:
    return _times(d[0], y.graph.series(x[0], node.arrays[0][1:] * np.arange(1, len(node.arrays[0]))))


def _product(node: Node, y: Value, x: Sequence[Value], d: Sequence[Moved]) -> Moved:
    return _times(d[0], x[0] * 2.0) if x[0] == x[1] else _sum([_times(d[0], x[1]), _times(d[1], x[0])])


def _choice(truth: Value, then: Moved, otherwise: Moved) -> Moved:
    g = truth.graph
    return None if then is None and otherwise is None else g.select(truth, then or 0.0, otherwise or 0.0)


def _minus(d: Moved) -> Moved:
    return None if d is None else -d


Rule = Callable[[Node, Value, Sequence[Value], Sequence[Moved]], Moved]
_RULES: dict[str, Rule] = {
    "take": lambda node, y, x, d: None if d[0] is None else y.graph.take(d[0], node.static),
    "concat": _concat,
    "affine": _affine,
    "quadratic": _quadratic,
    "series": _series,
    # The cells of an index are constant: only the weights move.
    "lookup": lambda node, y, x, d: None if d[2] is None else y.graph.lookup(x[0], x[1], d[2])[list(node.static)],
    "add": lambda node, y, x, d: _sum(d),
    "sub": lambda node, y, x, d: _sum([d[0], _minus(d[1])]),
    "mul": _product,
    # One reciprocal serves all directions.
    "div": lambda node, y, x, d: _times(_sum([d[0], _minus(None if d[1] is None else y * d[1])]), 1.0 / x[1]),
    "neg": lambda node, y, x, d: _minus(d[0]),
    "sqrt": lambda node, y, x, d: _times(d[0], 0.5 / y),
    "tanh": lambda node, y, x, d: _times(d[0], 1.0 - y * y),
    "abs": lambda node, y, x, d: _choice(x[0] <= 0.0, _minus(d[0]), d[0]),
    "max": lambda node, y, x, d: _choice(x[0] <= x[1], d[1], d[0]),
    "min": lambda node, y, x, d: _choice(x[0] <= x[1], d[0], d[1]),
    "clip": lambda node, y, x, d: _choice(x[0].between(*node.arrays[0]), d[0], None),
    "select": lambda node, y, x, d: _choice(x[0], d[1], d[2]),
}
_BY_ROWS = frozenset(
    ("add", "sub", "mul", "div", "neg", "sqrt", "tanh", "abs", "max", "min", "clip", "select", "series")
)

# A step that did not help is tried again at this share of its length.
SHORTER = 0.25
# Each unknown stays within this: unknowns are scaled so that passing rays fill the unit disc.
REACH = 2.0
_HUGE = 3e38


def with_jacobian(system: Graph) -> Graph:
    """Add the columns of the Jacobian to the outputs of a system from `unknown` (and other inputs) to `residual`."""
    unknowns = next(node.rows for node in system.nodes if node.name == "unknown")
    return with_derivatives(system, ["residual"], [("unknown", k) for k in range(unknowns)])


@dataclass(frozen=True)
class Solved:
    """The result of `limited_newton`.

    Attributes:
        last: unknowns after the last step, whose residual is not known yet.
        best: of all unknowns before these, those of the smallest residual; None after no step.
        size: the squared length of that residual; None after no step.
    """

    last: Value
    best: Value | None
    size: Value | None

    def judged(self, size: Value) -> tuple[Value, Value]:
        """Return the unknowns with the least residual, and its squared length; `size` is that of the last unknowns."""
        if self.best is None or self.size is None:
            return self.last, size
        g, better = size.graph, size <= self.size
        return g.select(better, self.last, self.best), g.select(better, size, self.size)


def limited_newton(system: Graph, given: Mapping[str, Value], start: Value, steps: int, limit: float) -> Solved:
    """Append `steps` steps of Newton's method, from `start` (2 or 4 rows).

    Args:
        system: a graph with the inputs `unknown` and `given` and the output `residual`, which has as many rows as
            `unknown`.
        limit: the longest step, in units of the unknowns.
    """
    g, both = start.graph, with_jacobian(system)
    x, best, size, step = start.clip(-REACH, REACH), None, None, None
    for _ in range(steps):
        found = g.inline(both, {**given, "unknown": x})
        residual, *columns = (found[name] for name in both.outputs)
        square, newton = g.square(residual), _limited(solve(columns, residual), limit)
        if best is None or size is None or step is None:
            best, size, step = x, square, newton
        else:
            better = square <= size
            best = g.select(better, x, best)
            step = g.select(better, newton, step * SHORTER)
            size = g.select(better, square, size)
        x = (best - step).clip(-REACH, REACH)
    return Solved(x, best, size)


def _limited(step: Value, limit: float) -> Value:
    """Return a step no longer than the limit; none where it is not finite: a singular Jacobian gives no direction."""
    g, square = step.graph, step.graph.square(step)
    shorter = step * (limit / square.sqrt().maximum(limit))
    return g.select(square <= _HUGE, shorter, 0.0)


def solve(columns: Sequence[Value], b: Value) -> Value:
    """Solve columns x = b. Where the matrix or the block of its last unknowns is singular, x is not finite."""
    rows = _eliminated([*columns, b])
    x: list[Value] = []
    for k, row in enumerate(rows):
        left = row[-1]
        for factor, known in zip(row, x, strict=False):
            left = left - factor * known
        x.append(left / row[k])
    return b.graph.concat(*x)


def determinant(columns: Sequence[Value]) -> Value:
    """Return the determinant of the matrix with these columns."""
    return reduce(mul, [row[k] for k, row in enumerate(_eliminated(columns))])


def _eliminated(columns: Sequence[Value]) -> list[list[Value]]:
    """Return the rows of a matrix made lower triangular: the last unknown is eliminated first."""
    count = columns[0].rows
    rows = [[column[i] for column in columns] for i in range(count)]
    for k in range(count - 1, 0, -1):
        over = 1.0 / rows[k][k]
        for i in range(k):
            factor = rows[i][k] * over
            rows[i] = [
                x if k <= j < count else x - factor * y for j, (x, y) in enumerate(zip(rows[i], rows[k], strict=True))
            ]
    return rows
