"""Monotone interpolation of a few tabled values, in plain numbers."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Sequence


def monotone(x: Sequence[float], rows: Sequence[Sequence[float]], place: float) -> list[float]:
    """Values at a place between rows of values: exactly the row at its own place, linear between two rows.

    Piecewise cubic with the slopes of Fritsch and Butland (1984), "A method for constructing local monotone piecewise
    cubic interpolants": between two rows a value stays between theirs, so that no gap can turn negative on the way.

    Args:
        x: [R] ascending places. rows: [R][M] values. place: from x[0] to x[-1].

    Returns [M] values.
    """
    if len(x) == 1:
        return list(rows[0])
    i = min(max(bisect_right(x, place) - 1, 0), len(x) - 2)
    step = x[i + 1] - x[i]
    t = (place - x[i]) / step
    if t in (0, 1):
        return list(rows[i + int(t)])
    found = []
    for values in zip(*rows, strict=True):
        slope = _slopes(x, values)
        low, high = values[i], values[i + 1]
        bump = t * (1 - t) * ((1 - t) * (slope[i] * step - (high - low)) - t * (slope[i + 1] * step - (high - low)))
        found.append(low + t * (high - low) + bump)
    return found


def _slopes(x: Sequence[float], values: Sequence[float]) -> list[float]:
    """Slope at every place: a weighted harmonic mean of those beside it, 0 at a turning point."""
    steps = [b - a for a, b in zip(x, x[1:], strict=False)]
    secants = [(b - a) / h for a, b, h in zip(values, values[1:], steps, strict=False)]
    if len(secants) == 1:
        return secants * 2
    inner = []
    for h0, h1, d0, d1 in zip(steps, steps[1:], secants, secants[1:], strict=False):
        w0, w1 = 2 * h1 + h0, h1 + 2 * h0
        inner.append((w0 + w1) / (w0 / d0 + w1 / d1) if d0 * d1 > 0 else 0.0)
    return [_end(steps, secants), *inner, _end(steps[::-1], secants[::-1])]


def _end(steps: Sequence[float], secants: Sequence[float]) -> float:
    """Slope at an end: of the parabola through three values, kept within what stays monotone."""
    (h0, h1), (d0, d1) = steps[:2], secants[:2]
    slope = ((2 * h0 + h1) * d0 - h0 * d1) / (h0 + h1)
    if slope * d0 <= 0:
        return 0.0
    return 3 * d0 if d0 * d1 <= 0 and abs(slope) > 3 * abs(d0) else slope
