"""Small linear systems in graphs: two or four unknowns a ray, solved in closed form, as `newton.solve_small` does."""

from __future__ import annotations

import numpy as np

from neurolens.surrogates.onnx.graph import Graph

# Rows of a 2 x 2 matrix [1, N] each: a b / c d.
Block = tuple[str, str, str, str]


def square_length(g: Graph, vector: str) -> str:
    """[1, N] of a vector [K, N]."""
    return g.op("ReduceSum", g.op("Mul", vector, vector), g.const([0], np.int64), keepdims=1)


def absolute(g: Graph, value: str) -> str:
    return g.op("Abs", value)


def add_determinant(g: Graph, columns: list[str]) -> str:
    """[1, N] of the matrix whose columns are given, [2, N] or [4, N] each."""
    if len(columns) == 2:
        return _determinant(g, _block(g, columns))
    upper, right, lower, corner = _blocks(g, columns)
    schur, _ = _schur(g, upper, right, lower, corner)
    return g.op("Mul", _determinant(g, schur), _determinant(g, corner))


def add_solve(g: Graph, columns: list[str], b: str) -> str:
    """x [K, N] with columns x = b."""
    if len(columns) == 2:
        x = _solve(g, _block(g, columns), *g.split(b, [1, 1]))
        return g.concat(*x)
    upper, right, lower, corner = _blocks(g, columns)
    schur, carry = _schur(g, upper, right, lower, corner)
    b0, b1, b2, b3 = g.split(b, [1, 1, 1, 1])
    first = _solve(g, schur, *_minus(g, (b0, b1), _apply(g, carry, b2, b3)))
    last = _solve(g, corner, *_minus(g, (b2, b3), _apply(g, lower, *first)))
    return g.concat(*first, *last)


def _block(g: Graph, columns: list[str]) -> Block:
    (a, c), (b, d) = (g.split(column, [1, 1]) for column in columns)
    return a, b, c, d


def _blocks(g: Graph, columns: list[str]) -> tuple[Block, Block, Block, Block]:
    rows = [g.split(column, [1, 1, 1, 1]) for column in columns]

    def block(i: int, j: int) -> Block:
        return rows[j][i], rows[j + 1][i], rows[j][i + 1], rows[j + 1][i + 1]

    return block(0, 0), block(0, 2), block(2, 0), block(2, 2)


def _schur(g: Graph, upper: Block, right: Block, lower: Block, corner: Block) -> tuple[Block, Block]:
    """upper - right corner^-1 lower, and right corner^-1."""
    inverse = _inverse(g, corner)
    carry = _times(g, right, inverse)
    minus = _times(g, carry, lower)
    a, b, c, d = (g.op("Sub", x, y) for x, y in zip(upper, minus, strict=True))
    return (a, b, c, d), carry


def _determinant(g: Graph, m: Block) -> str:
    return g.op("Sub", g.op("Mul", m[0], m[3]), g.op("Mul", m[1], m[2]))


def _inverse(g: Graph, m: Block) -> Block:
    over = g.op("Reciprocal", _determinant(g, m))
    minus = g.op("Neg", over)
    return g.op("Mul", m[3], over), g.op("Mul", m[1], minus), g.op("Mul", m[2], minus), g.op("Mul", m[0], over)


def _times(g: Graph, m: Block, n: Block) -> Block:
    def dot(a: str, b: str, c: str, d: str) -> str:
        return g.op("Add", g.op("Mul", a, b), g.op("Mul", c, d))

    return (
        dot(m[0], n[0], m[1], n[2]),
        dot(m[0], n[1], m[1], n[3]),
        dot(m[2], n[0], m[3], n[2]),
        dot(m[2], n[1], m[3], n[3]),
    )


def _apply(g: Graph, m: Block, x: str, y: str) -> tuple[str, str]:
    return (
        g.op("Add", g.op("Mul", m[0], x), g.op("Mul", m[1], y)),
        g.op("Add", g.op("Mul", m[2], x), g.op("Mul", m[3], y)),
    )


def _solve(g: Graph, m: Block, x: str, y: str) -> tuple[str, str]:
    over = g.op("Reciprocal", _determinant(g, m))
    first = g.op("Sub", g.op("Mul", m[3], x), g.op("Mul", m[1], y))
    second = g.op("Sub", g.op("Mul", m[0], y), g.op("Mul", m[2], x))
    return g.op("Mul", first, over), g.op("Mul", second, over)


def _minus(g: Graph, a: tuple[str, str], b: tuple[str, str]) -> tuple[str, str]:
    return g.op("Sub", a[0], b[0]), g.op("Sub", a[1], b[1])
