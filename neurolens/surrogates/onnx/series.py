"""Short power series in place of functions that graphs have no cheap operator for; the front surface's sag."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from neurolens.optics.prescription import Surface
from neurolens.surrogates.onnx.graph import Graph

Array = NDArray[np.float64]

# A conic this weak is a series of few terms; a deeper one takes a square root.
_WEAK = 0.05


def fit_series(function: Callable[[Array], Array], upper: float, tolerance: float) -> Array:
    """Power series of the lowest degree that holds the tolerance on [0, upper] (Chebyshev interpolation)."""
    t = np.linspace(0, upper, 400)
    for degree in range(1, 16):
        fit = np.polynomial.Chebyshev.interpolate(function, degree, [0, upper])
        if np.abs(fit(t) - function(t)).max() < tolerance:
            break
    return np.asarray(fit.convert(kind=np.polynomial.Polynomial).coef, dtype=np.float64)


def add_horner(g: Graph, t: str, coefficients: Array) -> str:
    """Polynomial in t, lowest coefficient first. A leading 1 costs nothing."""
    *rest, lead = coefficients
    value = t if lead == 1 else g.op("Mul", t, g.const(lead))
    for i, c in enumerate(reversed(rest)):
        if c != 0:
            value = g.op("Add", value, g.const(c))
        if i < len(rest) - 1:
            value = g.op("Mul", value, t)
    return value


def add_sag(g: Graph, surface: Surface, position: str) -> str:
    """z [1, N] at positions [2, N], as `sag_mm`: a short series where the conic is weak, else its square root."""
    across = {None: [[1.0, 1.0]], "x": [[1.0, 0.0]], "y": [[0.0, 1.0]]}[surface.cylinder]
    h2 = g.op("MatMul", g.const(across), g.op("Mul", position, position))
    z = _add_conic(g, float(surface.curvature), float(surface.conic), surface.semi_diameter_mm, h2)
    if not surface.asphere:
        return z
    # In units of the rim, so that high powers stay within float32.
    reach = surface.semi_diameter_mm**2
    t = g.op("Mul", h2, g.const(1 / reach))
    powers = {p: float(a) * reach ** (p / 2) for p, a in surface.asphere}
    if all(p % 2 == 0 for p in powers):
        return g.op("Add", z, add_horner(g, t, np.array([powers.get(2 * k, 0.0) for k in range(max(powers) // 2 + 1)])))
    h = g.op("Sqrt", t)
    return g.op("Add", z, add_horner(g, h, np.array([powers.get(k, 0.0) for k in range(max(powers) + 1)])))


def _add_conic(g: Graph, c: float, conic: float, rim_mm: float, h2: str) -> str:
    bend = (1 + conic) * c * c
    reach = (1.3 * rim_mm) ** 2
    if abs(bend) * reach < _WEAK:
        return add_horner(g, h2, fit_series(lambda s: c * s / (1 + np.sqrt(1 - bend * s)), reach, 1e-6))
    # c h^2 / (1 + root) has no cancellation and no case for a paraboloid; a product with a reciprocal is two passes.
    root = g.op("Sqrt", g.op("Relu", g.op("Sub", g.const(1.0), g.op("Mul", h2, g.const(bend)))))
    if conic == 0:  # 1 - root over c: one pass fewer
        return g.op("Mul", g.op("Sub", g.const(1.0), root), g.const(1 / c))
    return g.op("Div", g.op("Mul", h2, g.const(c)), g.op("Add", root, g.const(1.0)))
