"""Forbes's mild aspheres (Qbfs) as even powers of the height (G. W. Forbes, Opt. Express 15, 5218, 2007).

The strong ones are a figure of their own (`optics.lens.figures.Qcon`). With u the height over a normalisation radius
and x = u^2,

    sag = conic + u^2 (1 - u^2) / cos(slope of the conic) sum a_m Qbfs_m(x),

whose slopes along the normal are orthonormal. (Forbes starts from a sphere, whose cosine is sqrt(1 - c^2 r^2). That a
conic is meant shows in Thorlabs's ASL5040-UV, which is sharp only so.) The cosine is no polynomial: a polynomial as
close as `CLOSE_MM` up to the rim stands for it. Conics so steep that the lens model's powers do not come so close are
refused.
"""

import math
from collections.abc import Callable, Sequence
from decimal import Context, Decimal, localcontext

from numpy.polynomial import Polynomial
from numpy.polynomial.polynomial import polyval

from neurolens.optics.readers.source import MAX_POWER

# error of sag, in the unit of the heights: what is aimed at, and what is accepted for steep conics
CLOSE_MM, WORST_MM = 1e-11, 1e-9
_DIGITS = 80
_SAMPLES = 101
# of sag: how much rounding the coefficients to float64 may change; float32 carries what passes this
_ROUNDING_MM = 2e-8
Terms = tuple[tuple[int, float], ...]


def qbfs_terms(a: Sequence[float], radius: float, curvature: float, rim: float, conic: float = 0.0) -> Terms:
    """Return the powers of the height of a Qbfs departure from a conic, with their coefficients.

    Args:
        a: a_0, a_1, ... radius: normalisation radius. rim: height up to which the surface is used.

    Raises:
        ValueError: the conic is too steep, or float64 cannot hold the coefficients.
    """
    with localcontext(Context(prec=_DIGITS)):
        s2, k = (Decimal(curvature) * Decimal(radius)) ** 2, Decimal(conic)
        reach = (Decimal(rim) / Decimal(radius)) ** 2
        if (1 + k) * s2 * reach >= 1:
            raise ValueError("a rim inside the conic")

        def inverse_cosine(x: Decimal) -> Decimal:
            return ((1 - k * s2 * x) / (1 - (1 + k) * s2 * x)).sqrt()

        form = _polynomial(0, 1, -1) * _qbfs_sum(a)
        samples = [reach * k / (_SAMPLES - 1) for k in range(_SAMPLES)]
        exact = [polyval(x, form.coef) * inverse_cosine(x) for x in samples]
        for degree in range(MAX_POWER // 2 - max(len(a), 1)):
            found = form * _interpolated(inverse_cosine, reach, degree)
            off = max(abs(polyval(x, found.coef) - y) for x, y in zip(samples, exact, strict=True))
            if off <= Decimal(CLOSE_MM):
                break
        if off > Decimal(WORST_MM):
            raise ValueError(f"a conic that powers up to {MAX_POWER} follow to {WORST_MM:g}")
        return _powers(found.coef.tolist(), radius, rim)


def _qbfs_sum(a: Sequence[float]) -> Polynomial:
    """Return sum a_m Qbfs_m(x), by the recurrence of Forbes, Opt. Express 18, 19700 (2010), appendix A."""
    d = Decimal
    p = [_polynomial(2), _polynomial(6, -8)]
    q = [_polynomial(1), _polynomial(13, -16) / d(19).sqrt()]
    f, g, h = [d(2), d(19).sqrt() / 2], [d(-1) / 2], list[Decimal]()
    for m in range(2, len(a)):
        h.append(-d(m * (m - 1)) / (2 * f[m - 2]))
        g.append(-(1 + g[m - 2] * h[m - 2]) / f[m - 1])
        f.append((m * (m + 1) + 3 - g[m - 1] ** 2 - h[m - 2] ** 2).sqrt())
        p.append(_polynomial(2, -4) * p[m - 1] - p[m - 2])
        q.append((p[m] - q[m - 1] * g[m - 1] - q[m - 2] * h[m - 2]) / f[m])
    return sum((term * d(value) for value, term in zip(a, q, strict=False)), _polynomial(0))


def _interpolated(function: Callable[[Decimal], Decimal], reach: Decimal, degree: int) -> Polynomial:
    """Return the polynomial through a function of x in Chebyshev's points of [0, reach]."""
    nodes = [reach / 2 * (1 - Decimal(math.cos(math.pi * (k + 0.5) / (degree + 1)))) for k in range(degree + 1)]
    table = [function(x) for x in nodes]
    for order in range(1, degree + 1):  # Newton's divided differences
        for k in range(degree, order - 1, -1):
            table[k] = (table[k] - table[k - 1]) / (nodes[k] - nodes[k - order])
    found = _polynomial(table[-1])
    for x, value in zip(nodes[-2::-1], table[-2::-1], strict=True):
        found = _polynomial(-x, 1) * found + value
    return found


def _powers(in_x: Sequence[Decimal], radius: float, rim: float) -> Terms:
    """Return the powers of the height of a polynomial in x; ValueError where its terms cancel beyond float64."""
    terms = tuple((2 * k, float(c / Decimal(radius) ** (2 * k))) for k, c in enumerate(in_x) if c)
    if sum(abs(a) * rim**p for p, a in terms) * 2.0**-53 > _ROUNDING_MM:
        raise ValueError("fewer terms: powers of the height cancel in float64")
    return terms


def _polynomial(*coefficients: Decimal | int) -> Polynomial:
    return Polynomial([Decimal(c) for c in coefficients])
