"""Newton's method in a graph, for many small systems at once, limited so that no start makes it diverge.

Plain Newton iterations of a fixed count, as published for lens polynomials, run away where a step leaves the data. Here
no step is longer than a limit, and a point that is worse than the best one so far is replaced by a shorter step from
the best one.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from neurolens.graph.derive import with_derivatives
from neurolens.graph.ir import Graph, Value

# A step that did not help is repeated at this share of its length.
SHORTER = 0.25
# The unknowns stay within this, each: scaled so that passing rays fill the unit disc.
REACH = 2.0
_HUGE = 3e38

# Rows a b / c d of a 2 x 2 matrix.
Block = tuple[Value, Value, Value, Value]


def with_jacobian(system: Graph) -> Graph:
    """A system, of inputs `unknown` (and others) and output `residual`, with the columns of its Jacobian as outputs."""
    unknowns = next(node.rows for node in system.nodes if node.name == "unknown")
    return with_derivatives(system, ["residual"], [("unknown", k) for k in range(unknowns)])


@dataclass(frozen=True)
class Solved:
    """The result of an iteration.

    Attributes:
        last: unknowns after the last step, whose residual is not known yet.
        best: unknowns of the smallest residual before that. size: its squared length. None of zero steps.
    """

    last: Value
    best: Value | None
    size: Value | None

    def judged(self, size: Value) -> tuple[Value, Value]:
        """The best unknowns, and the squared length of their residual, from that of the last unknowns."""
        if self.best is None or self.size is None:
            return self.last, size
        g, better = size.graph, size <= self.size
        return g.select(better, self.last, self.best), g.select(better, size, self.size)


def limited_newton(system: Graph, given: Mapping[str, Value], start: Value, steps: int, limit: float) -> Solved:
    """Append so many steps from `start` (2 or 4 rows).

    Args:
        system: a graph from `unknown`, and the inputs `given`, to `residual`, of as many rows.
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
    """A step no longer than the limit, and none where it is not finite: a singular Jacobian gives no direction."""
    g, square = step.graph, step.graph.square(step)
    shorter = step * (limit / square.sqrt().maximum(limit))
    return g.select(square <= _HUGE, shorter, 0.0)


def solve(columns: Sequence[Value], b: Value) -> Value:
    """x of columns x = b, for 2 or 4 unknowns; not finite where the matrix is singular.

    Four are solved in blocks of two, the last two first out: their own block must not be singular.
    """
    g = b.graph
    if len(columns) == 2:
        return g.concat(*_solve(_block(columns, 0, 0), b[0], b[1]))
    lower, corner = _block(columns, 2, 0), _block(columns, 2, 2)
    schur, carry = _schur(columns)
    right = _apply(carry, b[2], b[3])
    first = _solve(schur, b[0] - right[0], b[1] - right[1])
    left = _apply(lower, *first)
    return g.concat(*first, *_solve(corner, b[2] - left[0], b[3] - left[1]))


def determinant(columns: Sequence[Value]) -> Value:
    """The determinant of the matrix with these columns, of 2 or 4 rows each."""
    if len(columns) == 2:
        return _determinant(_block(columns, 0, 0))
    return _determinant(_schur(columns)[0]) * _determinant(_block(columns, 2, 2))


def _block(columns: Sequence[Value], row: int, column: int) -> Block:
    left, right = columns[column], columns[column + 1]
    return left[row], right[row], left[row + 1], right[row + 1]


def _schur(columns: Sequence[Value]) -> tuple[Block, Block]:
    """upper - right corner^-1 lower, and right corner^-1, of the blocks upper, right / lower, corner."""
    a, b, c, d = corner = _block(columns, 2, 2)
    over = 1.0 / _determinant(corner)
    minus = -over
    carry = _times(_block(columns, 0, 2), (d * over, b * minus, c * minus, a * over))
    taken = _times(carry, _block(columns, 2, 0))
    p, q, r, s = (x - y for x, y in zip(_block(columns, 0, 0), taken, strict=True))
    return (p, q, r, s), carry


def _determinant(m: Block) -> Value:
    return m[0] * m[3] - m[1] * m[2]


def _times(m: Block, n: Block) -> Block:
    return (*_row(m[0], m[1], n), *_row(m[2], m[3], n))


def _row(a: Value, b: Value, n: Block) -> tuple[Value, Value]:
    return a * n[0] + b * n[2], a * n[1] + b * n[3]


def _apply(m: Block, x: Value, y: Value) -> tuple[Value, Value]:
    return m[0] * x + m[1] * y, m[2] * x + m[3] * y


def _solve(m: Block, x: Value, y: Value) -> tuple[Value, Value]:
    """Cramer's rule."""
    over = 1.0 / _determinant(m)
    return (m[3] * x - m[1] * y) * over, (m[0] * y - m[2] * x) * over
