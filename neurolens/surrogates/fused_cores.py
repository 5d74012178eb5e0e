"""The cores of surrogates as steps of a program (`expressions`): monomials or tanh layers, and sums of products.

Several cores of one form (one for each fixed wavelength) become one list of steps with as many coefficient tables.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from neurolens.surrogates.cores import InvariantPolynomial, MirrorPolynomial, Network, Partitioned, RawPolynomial
from neurolens.surrogates.expressions import Expr, Program
from neurolens.surrogates.fused_tanh import add_tanh
from neurolens.surrogates.model import Core

Array = NDArray[np.float64]
Exponent = tuple[int, ...]
Pair = tuple[Expr, Expr]
Made = tuple[Exponent, tuple[Exponent, Exponent] | None]  # a monomial and the two that it is the product of


@dataclass(frozen=True)
class Field:
    """The light field in a program: p and u (x, y), and w; `invariants` rho, sigma, tau, w."""

    p: Pair
    u: Pair
    w: Expr

    def invariants(self, program: Program) -> list[Expr]:
        (px, py), (ux, uy) = self.p, self.u
        return [
            program.fma(px, px, py * py),
            program.fma(px, ux, py * uy),
            program.fma(ux, ux, uy * uy),
            self.w,
        ]


@dataclass(frozen=True)
class Wanted:
    """What of a core's results is asked for: position, direction, stop (vectors); transmittance, gates (scalars)."""

    vectors: tuple[bool, bool, bool]
    scalars: tuple[bool, ...]


@dataclass(frozen=True)
class Results:
    """What a core gives: vectors (x, y) and scalars; None where not asked for."""

    vectors: list[Pair | None]
    scalars: list[Expr | None]


def add_core(program: Program, cores: Sequence[Core], field: Field, scale: Array, wanted: Wanted) -> Results:
    """Append cores of one form, a table each.

    Args:
        scale: [3], factors on position, direction and stop.

    Raises:
        TypeError: a core that has no form here.
    """
    write = WRITERS.get(type(cores[0]))
    if write is None:
        raise TypeError(f"no source for a core of type {type(cores[0]).__name__}")
    return write(program, cores, field, scale, wanted)


def _stack(cores: Sequence[Any], read: Callable[[Any], Any]) -> Array:
    """[..., K]: one array of every core, tables last."""
    return np.stack([np.asarray(read(core).detach().cpu().numpy(), dtype=np.float64) for core in cores], axis=-1)


def _vector_rows(program: Program, field: Field, rows: list[Expr | None], wanted: Wanted) -> list[Pair | None]:
    """A p + B u from rows A, B of each vector asked for."""
    found: list[Pair | None] = []
    for k, asked in enumerate(wanted.vectors):
        a, b = rows[2 * k], rows[2 * k + 1]
        if not asked or a is None or b is None:
            found.append(None)
            continue
        x, y = (program.fma(a, p, b * u) for p, u in zip(field.p, field.u, strict=True))
        found.append((x, y))
    return found


def _ab_weight(ab: Array, scalars: Array, scale: Array, wanted: Wanted) -> Array:
    """[6 + S, M, K] rows A, B of each vector, then scalars; rows not asked for are 0."""
    ab = ab * (scale * np.array(wanted.vectors))[:, None, None, None]
    return np.concatenate([ab.reshape(6, *ab.shape[2:]), scalars * np.array(wanted.scalars)[:, None, None]])


def _invariant_polynomial(
    program: Program, cores: Sequence[InvariantPolynomial], field: Field, scale: Array, wanted: Wanted
) -> Results:
    weight = _ab_weight(_stack(cores, lambda c: c.ab), _stack(cores, lambda c: c.scalars), scale, wanted)
    rows = add_polynomial(program, field.invariants(program), cores[0].exponents, weight)
    return Results(_vector_rows(program, field, list(rows[:6]), wanted), _asked(list(rows[6:]), wanted))


def _asked(rows: list[Expr], wanted: Wanted) -> list[Expr | None]:
    return [row if asked else None for row, asked in zip(rows, wanted.scalars, strict=True)]


def _mirror_polynomial(
    program: Program, cores: Sequence[MirrorPolynomial], field: Field, scale: Array, wanted: Wanted
) -> Results:
    """Rows A_x, A_y, B_x, B_y of each vector, then scalars."""
    ab = _stack(cores, lambda c: c.ab) * (scale * np.array(wanted.vectors))[:, None, None, None, None]
    scalars = _stack(cores, lambda c: c.scalars) * np.array(wanted.scalars)[:, None, None]
    variables = [c for p, u in zip(field.p, field.u, strict=True) for c in (p * p, p * u, u * u)]
    weight = np.concatenate([ab.reshape(12, *ab.shape[3:]), scalars])
    rows = add_polynomial(program, [*variables, field.w], cores[0].exponents, weight)
    vectors: list[Pair | None] = []
    for k, asked in enumerate(wanted.vectors):
        x, y = (program.fma(rows[4 * k + i], field.p[i], rows[4 * k + 2 + i] * field.u[i]) for i in (0, 1))
        vectors.append((x, y) if asked else None)
    return Results(vectors, _asked(rows[12:], wanted))


def _raw_polynomial(
    program: Program, cores: Sequence[RawPolynomial], field: Field, scale: Array, wanted: Wanted
) -> Results:
    components = _stack(cores, lambda c: c.components) * (scale * np.array(wanted.vectors))[:, None, None, None]
    scalars = _stack(cores, lambda c: c.scalars) * np.array(wanted.scalars)[:, None, None]
    weight = np.concatenate([components.reshape(6, *components.shape[2:]), scalars])
    rows = add_polynomial(program, [*field.p, *field.u, field.w], cores[0].exponents, weight)
    vectors: list[Pair | None] = [
        (rows[2 * k], rows[2 * k + 1]) if asked else None for k, asked in enumerate(wanted.vectors)
    ]
    return Results(vectors, _asked(list(rows[6:]), wanted))


def _network(program: Program, cores: Sequence[Network], field: Field, scale: Array, wanted: Wanted) -> Results:
    """The first layer takes the invariants themselves: shift and scale are folded into it."""
    shift, spread = _stack(cores, lambda c: c.shift), _stack(cores, lambda c: c.scale)
    values = field.invariants(program)
    for i in range(len(cores[0].hidden)):
        weight = _stack(cores, lambda c, i=i: c.hidden[i][0])  # type: ignore[misc]
        bias = _stack(cores, lambda c, i=i: c.hidden[i][1])  # type: ignore[misc]
        if i == 0:
            weight = weight * spread
            bias = bias - (weight * shift).sum(1)
        values = add_tanh(program, [_affine(program, w, values, b) for w, b in zip(weight, bias, strict=True)])
    weight, bias = _stack(cores, lambda c: c.output[0]), _stack(cores, lambda c: c.output[1])
    asked = np.concatenate([np.repeat(wanted.vectors, 2), wanted.scalars])
    factors = np.concatenate([np.repeat(scale, 2), np.ones(len(wanted.scalars))]) * asked
    rows = [
        _affine(program, f * w, values, f * b) if f else None for f, w, b in zip(factors, weight, bias, strict=True)
    ]
    return Results(_vector_rows(program, field, rows[:6], wanted), rows[6:])


def _affine(program: Program, weight: Array, values: Sequence[Expr], bias: Array) -> Expr:
    """weight [V, K] . values + bias [K]."""
    total = program.literal(bias)
    for w, value in zip(weight, values, strict=True):
        total = program.fma(value, program.literal(w), total)
    return total


def _partitioned(program: Program, cores: Sequence[Partitioned], field: Field, scale: Array, wanted: Wanted) -> Results:
    """Every zone's core for every ray, and a choice by rho."""
    rho = field.invariants(program)[0]
    chosen = add_core(program, [c.parts[0] for c in cores], field, scale, wanted)
    for k, edge in enumerate(cores[0].edges):
        outer = add_core(program, [c.parts[k + 1] for c in cores], field, scale, wanted)

        def choose(inner: Expr | None, beyond: Expr | None, edge: float = edge) -> Expr | None:
            return None if inner is None or beyond is None else program.select(rho, edge, inner, beyond)

        def pair(inner: Pair | None, beyond: Pair | None) -> Pair | None:
            if inner is None or beyond is None:
                return None
            x, y = (choose(a, b) for a, b in zip(inner, beyond, strict=True))
            return None if x is None or y is None else (x, y)

        chosen = Results(
            [pair(a, b) for a, b in zip(chosen.vectors, outer.vectors, strict=True)],
            [choose(a, b) for a, b in zip(chosen.scalars, outer.scalars, strict=True)],
        )
    return chosen


WRITERS: dict[type, Callable[..., Results]] = {
    InvariantPolynomial: _invariant_polynomial,
    MirrorPolynomial: _mirror_polynomial,
    RawPolynomial: _raw_polynomial,
    Network: _network,
    Partitioned: _partitioned,
}


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
