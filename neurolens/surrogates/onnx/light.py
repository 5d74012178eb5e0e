"""The ends of an exported graph: from raw rays to the light field, and from vectors and tests to the named outputs."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from neurolens.base import status as st
from neurolens.modelfile import DOMAIN_SLACK
from neurolens.surrogates.domain import Domain
from neurolens.surrogates.lightfield import Encoding
from neurolens.surrogates.model import LensModel
from neurolens.surrogates.onnx.cores import CoreRows, Field
from neurolens.surrogates.onnx.graph import INT32, Graph
from neurolens.surrogates.onnx.series import add_horner, add_sag, fit_series

Array = NDArray[np.float64]

# Any positive float32 test times this exceeds every status code, so that clipping turns a failed test into its code.
TEST_SCALE = 1e30


def add_light_field(g: Graph, model: LensModel, rays: str = "rays") -> tuple[Field, str]:
    """The light field of `rays` [5, N], and whether each is inside the domain, bool [1, N]."""
    e, d = model.encoding, model.domain
    film_pupil, wavelength = g.split(rays, [4, 1])
    inside = _inside(g, d, film_pupil)
    low, high = model.wavelength_limits_nm
    if e.w_half:
        # v = 1000 / (lambda sqrt(half)), so that w = v^2 - middle / half.
        unit = 1000 / math.sqrt(e.w_half)
        v = g.op("Div", g.const(unit), wavelength)
        inside = g.op("And", inside, _between(g, v, unit / high, unit / low))
        film_pupil = g.concat(film_pupil, v)
    else:
        inside = g.op("And", inside, _between(g, wavelength, low, high))
    matrix = _plane_matrix(g, e)
    planes = g.op("MatMul", matrix, film_pupil)  # rows p, u, p + u, v
    squares = g.op("Mul", planes, planes)
    weight, bias = invariant_weights(e)
    p, u, *_ = g.split(planes, [2, 2, weight.shape[1] - 4])
    return Field(p, u, squares, weight, bias, e.w_half != 0), inside


def invariant_weights(e: Encoding) -> tuple[Array, Array]:
    """The invariants (with w, last) as weight @ squares + bias, of the squares of p, u, p + u and v.

    rho = p.p, tau = u.u, sigma = (|p + u|^2 - rho - tau) / 2: squares only, so that one pass makes them all.
    """
    pairs = np.array([[1, 0, 0], [-0.5, -0.5, 0.5], [0, 1, 0]])
    # With mirror symmetry the three of x, then of y; else both together.
    rows = np.concatenate([np.kron(pairs, axis) for axis in (([[1.0, 0.0], [0.0, 1.0]]) if e.mirror else [[1.0, 1.0]])])
    weight = np.zeros((len(rows) + 1, 7 if e.w_half else 6))
    weight[:-1, :6] = rows
    bias = np.zeros(len(weight))
    if e.w_half:
        weight[-1, 6], bias[-1] = 1, -e.w_middle / e.w_half
    return weight, bias


def _between(g: Graph, value: str, low: float, high: float) -> str:
    """Whether low <= value <= high; false for NaN, whatever Clip makes of it."""
    return g.op("Equal", value, g.op("Clip", value, g.const(low), g.const(high)))


def _plane_matrix(g: Graph, e: Encoding) -> str:
    """[7 or 6, 5 or 4] from rays to planes. It depends on the film position, so it is made in the graph."""

    def rows(along: float) -> Array:
        """p = u + (film - u) along, centred and scaled; columns film_x, film_y, pupil_x, pupil_y, v."""
        film, pupil = np.array([1.0, 0.0]), np.array([0.0, 1.0])
        p = along * film + (1 - along) * pupil
        matrix = np.zeros((6, 4))
        for axis, (chief, scale) in enumerate(zip(e.chiefs, e.pupil_scales_mm, strict=True)):
            u, scaled = (pupil - chief * p) / scale, p / e.film_scale_mm
            matrix[axis::2, axis::2] = np.stack([scaled, u, scaled + u])
        return np.asarray(np.pad(matrix, ((0, 1), (0, 1))) if e.w_half else matrix, dtype=np.float64)

    base, slope = rows(0.0), rows(1.0) - rows(0.0)
    if e.w_half:
        base[-1, -1] = 1
    gap = g.op("Sub", "film_z_mm", g.const([e.pupil_plane_z_mm]))
    along = g.op("Div", g.const([e.film_plane_z_mm - e.pupil_plane_z_mm]), gap)
    return g.op("Add", g.op("Mul", along, g.const(slope)), g.const(base))


def _inside(g: Graph, d: Domain, film_pupil: str) -> str:
    """Film point, pupil point, film position and stop inside the domain, bool [1, N]; comparisons that NaN fails."""
    square = g.reshape(g.op("Mul", film_pupil, film_pupil), [2, 2, -1])
    square = g.op("ReduceSum", square, g.const([1], np.int64), keepdims=0)
    limits = np.square([[d.film_radius_mm * DOMAIN_SLACK], [d.pupil_radius_mm * DOMAIN_SLACK]])
    within = g.split(g.op("LessOrEqual", square, g.const(limits)), [1, 1])
    near, far = d.film_z_mm
    call = g.op("LessOrEqual", "film_z_mm", g.const([far * DOMAIN_SLACK]))
    call = g.op("And", call, g.op("GreaterOrEqual", "film_z_mm", g.const([near / DOMAIN_SLACK])))
    call = g.op("And", call, g.op("GreaterOrEqual", "stop_radius_mm", g.const([0.0])))
    call = g.op("And", call, g.op("LessOrEqual", "stop_radius_mm", g.const([d.stop_radius_mm * DOMAIN_SLACK])))
    return g.op("And", g.op("And", within[0], within[1]), call)


def add_decoder(g: Graph, model: LensModel, rows: CoreRows, series: DirectionSeries) -> str:
    """Outputs scene_ray and stop_xy_mm; returns the stop crossing's squared radius [1, N]."""
    g.op("Identity", rows.stop, out="stop_xy_mm")
    # First-order models give the position in the plane of the front vertex.
    z = add_sag(g, model.lens.surfaces[0], rows.position) if model.direction == "angle" else _flat(g, rows.position)
    if rows.unit:
        g.concat(rows.position, z, rows.unit, out="scene_ray")
        return _square(g, rows.stop)
    t = _square(g, rows.direction)
    if model.direction == "slope":
        # (dx, dy) = slope / sqrt(1 + slope^2), dz = -1 / sqrt(1 + slope^2).
        factor = g.op("Reciprocal", g.op("Sqrt", g.op("Add", t, g.const(1.0))))
        dz = g.op("Neg", factor)
    else:
        factor, dz = add_horner(g, t, series.sinc), add_horner(g, t, series.minus_cos)
    g.concat(rows.position, z, g.op("Mul", rows.direction, factor), dz, out="scene_ray")
    return _square(g, rows.stop)


def _square(g: Graph, vector: str) -> str:
    """Squared length [1, N] of a vector [2, N]."""
    return g.op("MatMul", g.const([[1.0, 1.0]]), g.op("Mul", vector, vector))


def _flat(g: Graph, position: str) -> str:
    """Zeros [1, N], NaN where the position is."""
    return g.op("MatMul", g.const([[0.0, 0.0]]), position)


def add_status(g: Graph, model: LensModel, rows: CoreRows, stop_square: str, inside: str, out: str = "status") -> None:
    """Output `out`: the code of the first failed test along a camera ray, then the domain.

    Camera rays meet the last surface first, so the first failure is the largest code; of several tests at one surface
    it is the smallest.
    """
    limit = g.op("Mul", g.op("Mul", "stop_radius_mm", "stop_radius_mm"), g.const([TEST_SCALE]))
    over = g.op("Sub", g.op("Mul", stop_square, g.const(TEST_SCALE)), limit)
    tests = [(over, st.blocked(model.lens.stop_index, st.RIM))]
    tests += [(row, gate.status) for row, gate in zip(rows.gates, model.gates, strict=True)]
    failed: dict[int, str] = {}  # by surface
    for test, status in sorted(tests, key=lambda t: t[1]):
        code = g.op("Clip", test, g.const(0.0), g.const(float(status)))
        surface = status // 4
        if surface in failed:
            earlier = failed[surface]
            code = g.op("Where", g.op("Greater", earlier, g.const(0.0)), earlier, code)
        failed[surface] = code
    code = g.op("Max", *failed.values())
    code = g.op("Where", inside, code, g.const(float(st.OUTSIDE_DOMAIN)))
    g.reshape(g.op("Cast", code, to=INT32), [-1], out=out)


class DirectionSeries:
    """(v sinc|v|, -cos|v|) as polynomials in t = |kappa v|^2 to float32 precision, up to an angle.

    Attributes:
        kappa: factor on v that makes the polynomial of sinc monic, which saves a pass over the rays.
        sinc, minus_cos: coefficients, lowest first; kappa v times sinc(t) is the direction's x and y.
    """

    def __init__(self, angle: float) -> None:
        sinc = fit_series(lambda t: np.sinc(np.sqrt(t) / np.pi), angle**2, 3e-8 / max(angle, 0.1))
        self.minus_cos = fit_series(lambda t: -np.cos(np.sqrt(t)), angle**2, 3e-8)
        n = len(sinc) - 1
        self.kappa = math.copysign(abs(sinc[n]) ** (1 / (2 * n + 1)), sinc[n])
        self.sinc = sinc / self.kappa ** (2.0 * np.arange(n + 1) + 1)
        self.sinc[n] = 1.0
        self.minus_cos = self.minus_cos / self.kappa ** (2.0 * np.arange(len(self.minus_cos)))
