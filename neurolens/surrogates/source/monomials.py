"""Polynomials as steps of a program: every monomial by one multiplication, spent at once on every output."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product

import numpy as np
from numpy.typing import NDArray

from neurolens.programs.expressions import Expr, Program

Array = NDArray[np.float64]
Exponent = tuple[int, ...]
Made = tuple[Exponent, tuple[Exponent, Exponent] | None]  # a monomial and the two that it is the product of


def add_polynomial(
    program: Program, variables: Sequence[Expr], exponents: NDArray[np.int64], weight: Array
) -> list[Expr]:
    """[R] rows: weight [R, M, K] times the monomials of `variables`, for exponents [M, V].

    Each monomial is made once, by one multiplication, and spent at once on every row, so that few stay in registers.
    """
    zero = [v.is_literal(0) for v in variables]
    table: dict[Exponent, Array] = {}
    for e, column in zip(exponents, np.moveaxis(weight, 1, 0), strict=True):
        if column.any() and not any(k and z for k, z in zip(e, zero, strict=True)):
            table[tuple(int(k) for k in e)] = column
    constant = (0,) * len(variables)
    rows = [program.literal(c) for c in table.pop(constant, np.zeros((len(weight), program.tables)))]
    made = {tuple(int(i == v) for i in range(len(variables))): value for v, value in enumerate(variables)}
    for e, factors in plan_monomials(list(table), len(variables)):
        if factors is not None:
            made[e] = made[factors[0]] * made[factors[1]]
        if e in table:
            rows = [
                program.fma(made[e], program.literal(c), row) if c.any() else row
                for c, row in zip(table[e], rows, strict=True)
            ]
    return rows


def plan_monomials(wanted: Sequence[Exponent], variables: int) -> list[Made]:
    """An order in which every monomial is a variable (None) or the product of two before it.

    Factors that exist anyway are taken first; where none do, the one that adds least. Depth first: what a monomial is
    made of was made just before.
    """
    units = [tuple(int(i == v) for i in range(variables)) for v in range(variables)]
    factors: dict[Exponent, tuple[Exponent, Exponent]] = {}
    known = {*units, *wanted}

    def resolve(e: Exponent) -> None:
        if sum(e) == 1 or e in factors:
            return
        options = []
        for right in product(*(range(k + 1) for k in e)):
            left = tuple(a - b for a, b in zip(e, right, strict=True))
            if 0 < sum(right) <= sum(left):
                options.append((sum(f not in known for f in {left, right}), sum(right), left, right))
        _, _, left, right = min(options)
        known.update((left, right))
        factors[e] = (left, right)
        resolve(left)
        resolve(right)

    for e in sorted(wanted, key=lambda e: (sum(e), e), reverse=True):
        resolve(e)
    return _depth_first([*units, *sorted(factors, key=lambda e: (sum(e), e))], factors, set(wanted))


def _depth_first(
    nodes: list[Exponent], factors: dict[Exponent, tuple[Exponent, Exponent]], wanted: set[Exponent]
) -> list[Made]:
    """Nodes after their factors; each is followed by those that it was the last factor of."""
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
