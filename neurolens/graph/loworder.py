"""Derivatives of a lens's program as sparse polynomials of low order, for ray differentials.

A ray differential says how wide a pixel's footprint is, to choose the texels that it averages: a few percent do.
Carried through a surrogate, derivatives double its work; as polynomials of some ten terms each they are a few products.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations_with_replacement

import numpy as np
from numpy.typing import NDArray

from neurolens.base import status as st
from neurolens.graph.program import FILM_X_Y, RAY, SCENE_RAY, STATUS, WAVELENGTH, Expr, Program, derivative
from neurolens.graph.tangents import with_derivatives

Array = NDArray[np.float64]
_DEGREE, _DEGREE_WAVE = 4, 2  # of film and pupil point; of what may be multiplied by the wavelength's variable
_STOP, _MOST_TERMS = 0.005, 16  # error at which an output has enough, as a share of its group's; terms of an output
WORST = 0.03  # RMS error, as a share of a derivative, above which there is no such program
_FEWEST = 500  # rays that pass, to fit to
_ONE_WAVELENGTH = 1e-3  # relative spread of 1 / wavelength^2 below which it is one
_GROUPS = (SCENE_RAY[:3], SCENE_RAY[3:])  # point and direction: each has one scale
Monomial = tuple[int, ...]  # numbers of the variables in it, ascending


@dataclass(frozen=True)
class LowOrder:
    """A program with an output `derivative(output, input)` of all of `SCENE_RAY` by the film point.

    Attributes:
        error: RMS over the fitted rays of the error of a derivative (the point's or the direction's 3 x 2 matrix,
            Frobenius norm) over its size, the larger of the two. terms: of all outputs.
    """

    program: Program
    error: float
    terms: int


def with_low_order_derivatives(program: Program, samples: Mapping[str, NDArray[np.float32]]) -> LowOrder | None:
    """Fit the derivatives of a program by orthogonal matching pursuit, each until it is good enough.

    Args:
        program: of a lens, see `graph.program`.
        samples: its inputs, of rays that cover what it will be asked.

    Returns None where low orders do not do: a lens too strong, or too few rays that pass.
    """
    exact = with_derivatives(program, SCENE_RAY, FILM_X_Y).evaluate(samples)
    passed = np.broadcast_to(exact[STATUS] == st.PASSED, samples[RAY[0]].shape)
    if passed.sum() < _FEWEST:
        return None
    found = program.in_order_of_need()
    variables, inputs = _variables(found, samples, passed)
    monomials = _monomials(len(variables))
    one = np.ones(int(passed.sum()))
    columns = np.stack([np.prod([one, *(variables[k] for k in m)], axis=0) for m in monomials])
    powers: dict[Monomial, Expr] = {}
    terms = 0
    for group in _GROUPS:
        wanted = _matrices(exact, group, passed)
        enough = _STOP * float(np.sqrt(np.mean(np.square(wanted))))
        for name, row in zip(_names(group), wanted, strict=True):
            chosen, weights = _pursue(columns, row, enough)
            found.outputs[name] = _sum(found, [monomials[c] for c in chosen], weights, inputs, powers)
            terms += len(chosen)
    fitted = found.evaluate(samples)  # in float32, as it will be used
    error = max(_error(_matrices(fitted, g, passed), _matrices(exact, g, passed)) for g in _GROUPS)
    return LowOrder(found, error, terms) if error <= WORST else None


def _names(group: Sequence[str]) -> list[str]:
    return [derivative(output, by) for output in group for by in FILM_X_Y]


def _matrices(results: Mapping[str, NDArray[np.float32]], group: Sequence[str], passed: NDArray[np.bool_]) -> Array:
    """Derivatives [6, M] of a group's three outputs, of the rays that pass."""
    return np.stack([np.broadcast_to(results[name], passed.shape)[passed] for name in _names(group)]).astype(np.float64)


def _error(found: Array, wanted: Array) -> float:
    """RMS over rays of the relative error in the Frobenius norm."""
    size = np.maximum(np.linalg.norm(wanted, axis=0), 1e-30)
    return float(np.sqrt(np.mean((np.linalg.norm(found - wanted, axis=0) / size) ** 2)))


def _variables(
    program: Program, samples: Mapping[str, NDArray[np.float32]], passed: NDArray[np.bool_]
) -> tuple[list[Array], list[Expr]]:
    """Film and pupil point, and 1 / wavelength^2 from its mean where the program knows the wavelength."""
    values = [np.asarray(samples[name], np.float64)[passed] for name in RAY]
    inputs = [program.input(name) for name in RAY]
    if any(step.kind == "input" and step.name == WAVELENGTH for step in program.steps):
        wave = (1000 / np.asarray(samples[WAVELENGTH], np.float64)[passed]) ** 2
        if np.ptp(wave) > _ONE_WAVELENGTH * wave.mean():  # else a constant, which there is already
            values.append(wave - wave.mean())
            inverse = program.literal(1000.0) / program.input(WAVELENGTH)
            inputs.append(program.fma(inverse, inverse, -float(wave.mean())))
    return values, inputs


def _monomials(count: int) -> list[Monomial]:
    points = [m for n in range(_DEGREE + 1) for m in combinations_with_replacement(range(4), n)]
    return points + [(*m, 4) for m in points if len(m) <= _DEGREE_WAVE and count > 4]


def _pursue(columns: Array, wanted: Array, good: float) -> tuple[list[int], Array]:
    """Rows of `columns` [M, N] and their weights, whose sum comes within `good` (RMS) of `wanted` [N].

    A plain pursuit of a few dozen columns: those of `surrogates.fits` need torch, and a render with a model does not.
    """
    size = np.maximum(np.linalg.norm(columns, axis=1), 1e-30)
    chosen: list[int] = []
    weights, left = np.zeros(0), wanted
    while len(chosen) < _MOST_TERMS and np.sqrt(np.mean(left**2)) > good:
        gain = np.abs(columns @ left) / size
        gain[chosen] = 0
        chosen.append(int(gain.argmax()))
        part = columns[chosen] / size[chosen, None]
        weights = np.linalg.lstsq(part.T, wanted, rcond=None)[0] / size[chosen]
        left = wanted - weights @ columns[chosen]
    return chosen, weights


def _sum(
    program: Program,
    monomials: Sequence[Monomial],
    weights: Array,
    inputs: Sequence[Expr],
    powers: dict[Monomial, Expr],
) -> Expr:
    """Weighted sum of monomials; their products are shared between outputs."""

    def power(m: Monomial) -> Expr:
        if m not in powers:
            powers[m] = inputs[m[0]] if len(m) == 1 else power(m[:-1]) * inputs[m[-1]]
        return powers[m]

    total = program.literal(0.0)
    for m, weight in sorted(zip(monomials, weights, strict=True)):
        total = program.fma(power(m), float(weight), total) if m else total + float(weight)
    return total
