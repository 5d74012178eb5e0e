"""The cores of surrogates as steps of a program (`expressions`): monomials or tanh layers, and sums of products.

Several cores of one form (one for each fixed wavelength) become one list of steps with as many coefficient tables.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from neurolens.programs.expressions import Expr, Program
from neurolens.programs.tanh import add_tanh
from neurolens.surrogates.cores import InvariantPolynomial, MirrorPolynomial, Network, Partitioned, RawPolynomial
from neurolens.surrogates.model import Core
from neurolens.surrogates.residual import Residual
from neurolens.surrogates.source.monomials import add_polynomial

Array = NDArray[np.float64]
Pair = tuple[Expr, Expr]


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

    def mirror_invariants(self) -> list[Expr]:
        return [*(c for p, u in zip(self.p, self.u, strict=True) for c in (p * p, p * u, u * u)), self.w]


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
    weight = np.concatenate([ab.reshape(12, *ab.shape[3:]), scalars])
    rows = add_polynomial(program, field.mirror_invariants(), cores[0].exponents, weight)
    return Results(_mirror_vectors(program, field, list(rows[:12]), wanted), _asked(list(rows[12:]), wanted))


def _mirror_vectors(program: Program, field: Field, rows: list[Expr | None], wanted: Wanted) -> list[Pair | None]:
    """A p + B u from rows A_x, A_y, B_x, B_y of each vector asked for."""
    found: list[Pair | None] = []
    for k, asked in enumerate(wanted.vectors):
        ax, ay, bx, by = rows[4 * k : 4 * k + 4]
        if not asked or ax is None or ay is None or bx is None or by is None:
            found.append(None)
            continue
        (px, py), (ux, uy) = field.p, field.u
        found.append((program.fma(ax, px, bx * ux), program.fma(ay, py, by * uy)))
    return found


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
    mirror, n = cores[0].mirror, cores[0].ab_rows
    values = field.mirror_invariants() if mirror else field.invariants(program)
    for i in range(len(cores[0].hidden)):
        weight = _stack(cores, lambda c, i=i: c.hidden[i][0])  # type: ignore[misc]
        bias = _stack(cores, lambda c, i=i: c.hidden[i][1])  # type: ignore[misc]
        if i == 0:
            weight = weight * spread
            bias = bias - (weight * shift).sum(1)
        values = add_tanh(program, [_affine(program, w, values, b) for w, b in zip(weight, bias, strict=True)])
    weight, bias = _stack(cores, lambda c: c.output[0]), _stack(cores, lambda c: c.output[1])
    asked = np.concatenate([np.repeat(wanted.vectors, n // 3), wanted.scalars])
    factors = np.concatenate([np.repeat(scale, n // 3), np.ones(len(wanted.scalars))]) * asked
    rows = [
        _affine(program, f * w, values, f * b) if f else None for f, w, b in zip(factors, weight, bias, strict=True)
    ]
    if mirror:  # A, B of x and A, B of y of each vector; the mirror polynomial's are A of both, then B of both
        ab = [rows[4 * k + i] for k in range(3) for i in (0, 2, 1, 3)]
        return Results(_mirror_vectors(program, field, ab, wanted), rows[n:])
    return Results(_vector_rows(program, field, rows[:n], wanted), rows[n:])


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


def _residual(program: Program, cores: Sequence[Residual], field: Field, scale: Array, wanted: Wanted) -> Results:
    """Polynomial and network, added."""
    base, more = (add_core(program, [c.parts[k] for c in cores], field, scale, wanted) for k in (0, 1))
    vectors: list[Pair | None] = []
    for a, b in zip(base.vectors, more.vectors, strict=True):
        vectors.append(None if a is None or b is None else (a[0] + b[0], a[1] + b[1]))
    both = zip(base.scalars, more.scalars, strict=True)
    return Results(vectors, [None if a is None or b is None else a + b for a, b in both])


WRITERS: dict[type, Callable[..., Results]] = {
    InvariantPolynomial: _invariant_polynomial,
    MirrorPolynomial: _mirror_polynomial,
    RawPolynomial: _raw_polynomial,
    Network: _network,
    Partitioned: _partitioned,
    Residual: _residual,
}
