"""Forbes's aspheres as even powers of the height, which the lens model has (G. W. Forbes, Opt. Express 15, 5218, 2007).

With u the height over a normalisation radius and x = u^2,
    Qcon: sag = conic + u^4 sum a_m Qcon_m(x), Jacobi's P_m^(0,4)(2 x - 1): exactly even powers;
    Qbfs: sag = conic + u^2 (1 - u^2) / cos(slope of the conic) sum a_m Qbfs_m(x), whose slopes along the normal are
    orthonormal (Forbes has a sphere, whose cosine is sqrt(1 - c^2 r^2); with a conic, Thorlabs's ASL5040-UV is sharp).
    The cosine is no polynomial: one as close as `CLOSE_MM` up to the rim stands for it. Conics so steep that the lens
    model's powers do not reach that are refused.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from decimal import Context, Decimal, localcontext

from neurolens.readers.source import MAX_POWER

CLOSE_MM, WORST_MM = 1e-11, 1e-9  # of sag, in the unit of the heights: what is aimed at, and what steep conics get
MAX_TERMS = MAX_POWER // 2 - 1  # of either kind, m from 0
_DIGITS = 80
_SAMPLES = 101
_ROUNDING = 1e-9  # sag that cancels in float64, where powers alternate
Terms = tuple[tuple[int, float], ...]


def qcon_terms(a: Sequence[float], radius: float, rim: float) -> Terms:
    """Powers of the height and their coefficients of a Qcon departure; ValueError where float64 cannot hold them.

    Args:
        a: a_0, a_1, ... radius: normalisation radius. rim: height up to which the surface is used.
    """
    found = [Decimal(0)] * (len(a) + 2)
    with localcontext(Context(prec=_DIGITS)):
        for m, value in enumerate(a):
            for k in range(m + 1):
                found[k + 2] += (-1) ** (m + k) * math.comb(m, k) * math.comb(m + k + 4, m) * Decimal(value)
        return _powers(found, radius, rim)


def qbfs_terms(a: Sequence[float], radius: float, curvature: float, rim: float, conic: float = 0.0) -> Terms:
    """The terms of a Qbfs departure from a conic, as of `qcon_terms`; ValueError where the conic is too steep."""
    with localcontext(Context(prec=_DIGITS)):
        s2, k, reach = (
            (Decimal(curvature) * Decimal(radius)) ** 2,
            Decimal(conic),
            (Decimal(rim) / Decimal(radius)) ** 2,
        )
        if (1 + k) * s2 * reach >= 1:
            raise ValueError("a rim inside the conic")

        def inverse_cosine(x: Decimal) -> Decimal:
            return ((1 - k * s2 * x) / (1 - (1 + k) * s2 * x)).sqrt()

        x_1mx = [Decimal(0), Decimal(1), Decimal(-1)]
        form = _product(x_1mx, _qbfs_sum(a))
        samples = [reach * k / (_SAMPLES - 1) for k in range(_SAMPLES)]
        exact = [_at(form, x) * inverse_cosine(x) for x in samples]
        for degree in range(0, MAX_POWER // 2 - len(form) + 2):
            found = _product(form, _interpolated(inverse_cosine, reach, degree))
            off = max(abs(_at(found, x) - y) for x, y in zip(samples, exact, strict=True))
            if off <= Decimal(CLOSE_MM):
                break
        if off > Decimal(WORST_MM):
            raise ValueError(f"a conic that powers up to {MAX_POWER} follow to {WORST_MM:g}")
        return _powers(found, radius, rim)


def _qbfs_sum(a: Sequence[float]) -> list[Decimal]:
    """sum a_m Qbfs_m(x) in powers of x, by the recurrence of Forbes, Opt. Express 18, 19700 (2010), appendix A."""
    d = Decimal
    total = [d(0)] * max(len(a), 1)
    p_before, p = [d(2)], [d(6), d(-8)]
    q_before, q = [d(1)], list[Decimal]()
    f, g, h = [d(2), d(19).sqrt() / 2], [d(-1) / 2], list[Decimal]()
    for m, value in enumerate(a):
        if m == 0:
            now = q_before
        else:
            if m > 1:
                h.append(-d(m * (m - 1)) / (2 * f[m - 2]))
                g.append(-(1 + g[m - 2] * h[m - 2]) / f[m - 1])
                f.append((m * (m + 1) + 3 - g[m - 1] ** 2 - h[m - 2] ** 2).sqrt())
                p_before, p = p, _sum(_product([d(2), d(-4)], p), p_before, -1)
            now = _sum(p, q if m > 1 else q_before, -g[m - 1])
            if m > 1:
                now = _sum(now, q_before, -h[m - 2])
                q_before = q
            now = [c / f[m] for c in now]
            q = now
        for k, c in enumerate(now):
            total[k] += Decimal(value) * c
    return total


def _interpolated(function: Callable[[Decimal], Decimal], reach: Decimal, degree: int) -> list[Decimal]:
    """Return the polynomial through a function of x in Chebyshev's points of [0, reach]."""
    nodes = [reach / 2 * (1 - Decimal(math.cos(math.pi * (k + 0.5) / (degree + 1)))) for k in range(degree + 1)]
    table = [function(x) for x in nodes]
    for order in range(1, degree + 1):  # Newton's divided differences
        for k in range(degree, order - 1, -1):
            table[k] = (table[k] - table[k - 1]) / (nodes[k] - nodes[k - order])
    found = [table[-1]]
    for k in range(degree - 1, -1, -1):
        found = _sum(_product([-nodes[k], Decimal(1)], found), [table[k]])
    return found


def _powers(in_x: Sequence[Decimal], radius: float, rim: float) -> Terms:
    """Powers of the height of a polynomial in x; ValueError where its terms cancel beyond what float64 holds."""
    terms = tuple((2 * k, float(c / Decimal(radius) ** (2 * k))) for k, c in enumerate(in_x) if c)
    if sum(abs(a) * rim**p for p, a in terms) * 2.0**-52 > _ROUNDING:
        raise ValueError("fewer terms: powers of the height cancel in float64")
    return terms


def _product(a: Sequence[Decimal], b: Sequence[Decimal]) -> list[Decimal]:
    found = [Decimal(0)] * (len(a) + len(b) - 1)
    for i, p in enumerate(a):
        for k, q in enumerate(b):
            found[i + k] += p * q
    return found


def _sum(a: Sequence[Decimal], b: Sequence[Decimal], factor: Decimal | int = 1) -> list[Decimal]:
    longer = [Decimal(0)] * max(len(a), len(b))
    for k, p in enumerate(a):
        longer[k] += p
    for k, q in enumerate(b):
        longer[k] += factor * q
    return longer


def _at(a: Sequence[Decimal], x: Decimal) -> Decimal:
    total = Decimal(0)
    for c in reversed(a):
        total = total * x + c
    return total
