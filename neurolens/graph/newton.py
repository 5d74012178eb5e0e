"""Newton's method in a graph, for many small systems at once, limited so that no start makes it diverge.

Plain Newton iterations of a fixed count, as published for lens polynomials, run away where a step leaves the data. Here
no step is longer than a limit, and a point that is worse than the best one so far is replaced by a shorter step from
the best one.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import reduce
from operator import mul

from neurolens.graph.derive import with_derivatives
from neurolens.graph.ir import Graph, Value

# A step that did not help is repeated at this share of its length.
SHORTER = 0.25
# The unknowns stay within this, each: scaled so that passing rays fill the unit disc.
REACH = 2.0
_HUGE = 3e38


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
    """x of columns x = b; not finite where the matrix is singular, or the leading block of its last unknowns is."""
    rows = _eliminated([*columns, b])
    x: list[Value] = []
    for k, row in enumerate(rows):
        left = row[-1]
        for factor, known in zip(row, x, strict=False):
            left = left - factor * known
        x.append(left / row[k])
    return b.graph.concat(*x)


def determinant(columns: Sequence[Value]) -> Value:
    """The determinant of the matrix with these columns."""
    pivots = [row[k] for k, row in enumerate(_eliminated(columns))]
    return reduce(mul, pivots)


def _eliminated(columns: Sequence[Value]) -> list[list[Value]]:
    """The rows of a matrix, to the right of whose diagonal the last unknowns are eliminated, the very last first."""
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
