"""Derivatives of cores in exported graphs: columns of the Jacobian beside the values, from the same monomials.

Polynomials in the invariants get rows for their derivatives in the same matrix product; any other core is followed node
by node (`onnx_tangents`).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from neurolens.surrogates.cores import DIRECTION, POSITION, STOP, Core, InvariantPolynomial, MirrorPolynomial
from neurolens.surrogates.inversion.derivatives import polynomial_slopes
from neurolens.surrogates.lightfield import Encoding
from neurolens.surrogates.model import LensModel
from neurolens.surrogates.onnx.cores import CoreRows, Field, add_core
from neurolens.surrogates.onnx.graph import Graph
from neurolens.surrogates.onnx.light import DirectionSeries
from neurolens.surrogates.onnx.monomials import add_polynomial, without_constants
from neurolens.surrogates.onnx.series import add_horner, add_sag
from neurolens.surrogates.onnx.tangents import Tangents

Array = NDArray[np.float64]
# For each vector, the derivatives [2, N] by each input.
Columns = dict[int, list[str]]


@dataclass(frozen=True)
class Chain:
    """How p_x, p_y, u_x, u_y (scaled) change with some inputs: base + along * slope, [4, I] each.

    `along` names a [1] of the graph; "" where the slope is 0.
    """

    base: Array
    slope: Array
    along: str = ""

    @property
    def count(self) -> int:
        return self.base.shape[1]

    def matrix(self, g: Graph, base: Array, slope: Array) -> str:
        """A matrix that is linear in the chain, from its two parts."""
        if not self.along or not slope.any():
            return g.const(base)
        return g.op("Add", g.op("Mul", self.along, g.const(slope)), g.const(base))


def film_and_pupil(g: Graph, e: Encoding) -> Chain:
    """Inputs film x, y and pupil x, y in mm, as `field_slopes` has them."""
    gap = g.op("Sub", "film_z_mm", g.const([e.pupil_plane_z_mm]))
    along = g.op("Div", g.const([e.film_plane_z_mm - e.pupil_plane_z_mm]), gap)
    base, slope = np.zeros((4, 4)), np.zeros((4, 4))
    for i, (chief, scale) in enumerate(zip(e.chiefs, e.pupil_scales_mm, strict=True)):
        slope[i, i], slope[i, 2 + i], base[i, 2 + i] = 1 / e.film_scale_mm, -1 / e.film_scale_mm, 1 / e.film_scale_mm
        slope[2 + i, i], slope[2 + i, 2 + i], base[2 + i, 2 + i] = -chief / scale, chief / scale, (1 - chief) / scale
    return Chain(base, slope, along)


def add_core_slopes(
    g: Graph, core: Core, field: Field, scale: Array, gate_scale: float | None, chain: Chain, wanted: tuple[int, ...]
) -> tuple[CoreRows, Columns]:
    """Append a core as `add_core` does, with the derivatives of the vectors in `wanted` by the inputs of a chain.

    `gate_scale` None: nothing but the vectors in `wanted` is wanted; the other rows may be "".

    Raises:
        TypeError: a core without an ONNX form, or with an operator that has no derivative.
    """
    if isinstance(core, InvariantPolynomial | MirrorPolynomial):
        return _symmetric(g, core, field, scale, gate_scale, chain, wanted)
    start = len(g.nodes)
    rows = add_core(g, core, field, scale, gate_scale or 1.0)
    stop = len(g.nodes)
    names = (rows.position, rows.direction, rows.stop)
    columns: Columns = {v: [] for v in wanted}
    pu = g.concat(field.p, field.u)
    for i in range(chain.count):
        seeds = _seeds(g, field, pu, chain, i)
        tangents = Tangents(g, start, seeds, stop)
        for v in wanted:
            columns[v].append(tangents.of(names[v]))
    return rows, columns


def _seeds(g: Graph, field: Field, pu: str, chain: Chain, i: int) -> dict[str, str]:
    """Derivatives of p, u and the squares by input `i`."""
    unit = np.zeros((len(field.weight[0]), 4))
    unit[:4], unit[4:6] = np.eye(4), np.kron([[1.0, 1.0]], np.eye(2))  # rows p, u, p + u, v
    parts = [part[:, i : i + 1] for part in (chain.base, chain.slope)]
    column = chain.matrix(g, *(unit @ part for part in parts))  # of the planes, the same for every ray
    # squares = planes^2, and planes (but v) are unit @ (p, u).
    planes = g.op("MatMul", g.const(2 * unit), pu)
    four = chain.matrix(g, *parts)
    each = g.op("Add", g.op("Mul", pu, g.const(0.0)), four)
    p, u = g.split(each, [2, 2])
    return {field.p: p, field.u: u, field.squares: g.op("Mul", planes, column)}


def _symmetric(
    g: Graph,
    core: InvariantPolynomial | MirrorPolynomial,
    field: Field,
    scale: Array,
    gate_scale: float | None,
    chain: Chain,
    wanted: tuple[int, ...],
) -> tuple[CoreRows, Columns]:
    mirror = isinstance(core, MirrorPolynomial)
    count, wide = (6, 2) if mirror else (3, 1)  # invariants without w; rows of an A
    ab = np.asarray(core.ab.double().numpy()) * scale.reshape(3, *[1] * (core.ab.ndim - 1))
    given = (POSITION, DIRECTION, STOP) if gate_scale is not None else wanted
    ab = ab.reshape(3, 2 * wide, -1)  # rows A (x, y), B (x, y)
    scalars = np.asarray(core.scalars.double().numpy())
    scalars = scalars[:0] if gate_scale is None else np.concatenate([scalars[:1], gate_scale * scalars[1:]])
    values = np.concatenate([ab[list(given)].reshape(-1, ab.shape[-1]), scalars])
    exponents, slopes = polynomial_slopes(core.exponents, ab[list(wanted)].reshape(-1, ab.shape[-1]), range(count))
    slope_weights = slopes[1:].reshape(-1, len(exponents))
    weight = np.concatenate([np.pad(values, ((0, 0), (0, len(exponents) - values.shape[1]))), slope_weights])
    variables = list(range(count + field.dispersive))
    used, weight = without_constants(exponents, weight, variables)
    out = add_polynomial(g, g.affine(field.weight[variables], field.squares, field.bias[variables]), used, weight)
    sizes = [2 * wide] * len(given) + [1] * len(scalars) + [wide] * (2 * len(wanted) * count)
    rows = g.split(out, sizes)
    pairs = dict(zip(given, rows, strict=False))
    vectors = {v: _vector(g, field, *g.split(pair, [wide, wide])) for v, pair in pairs.items()}
    names = [vectors.get(v, "") for v in (POSITION, DIRECTION, STOP)]
    other = [*rows[len(given) : len(given) + len(scalars)], ""]
    known = CoreRows(names[0], names[1], names[2], other[0], other[1:-1])
    # Gain of each vector as an invariant grows, [2, N]: by invariant, then vector.
    slope_rows = rows[len(given) + len(scalars) :]
    gains = [_vector(g, field, a, b) for a, b in zip(slope_rows[::2], slope_rows[1::2], strict=True)]
    growth = _growth(g, g.concat(field.p, field.u), chain, mirror)
    columns: Columns = {}
    for place, v in enumerate(wanted):
        by_vector = gains[place :: len(wanted)]
        columns[v] = [_column(g, chain, i, pairs[v], by_vector, growth[i], mirror) for i in range(chain.count)]
    return known, columns


def _vector(g: Graph, field: Field, a: str, b: str) -> str:
    return g.op("Add", g.op("Mul", a, field.p), g.op("Mul", b, field.u))


def _growth(g: Graph, pu: str, chain: Chain, mirror: bool) -> list[dict[int, str]]:
    """For each input, the derivatives [1, N] of those invariants that change with it."""
    axes = ([0], [1]) if mirror else ([0, 1],)

    def rows(part: Array) -> Array:
        """[I, invariants, 4] that makes the derivatives from p_x, p_y, u_x, u_y."""
        found = np.zeros((chain.count, 3 * len(axes), 4))
        for block, chosen in enumerate(axes):
            for axis in chosen:
                dp, du = part[axis], part[2 + axis]
                found[:, 3 * block, axis] = 2 * dp
                found[:, 3 * block + 1, axis], found[:, 3 * block + 1, 2 + axis] = du, dp
                found[:, 3 * block + 2, 2 + axis] = 2 * du
        return found

    base, slope = rows(chain.base), rows(chain.slope)
    moving = (base != 0).any(2) | (slope != 0).any(2)
    names = g.split(g.op("MatMul", chain.matrix(g, base[moving], slope[moving]), pu), [1] * int(moving.sum()))
    found: list[dict[int, str]] = [{} for _ in range(chain.count)]
    for (i, k), name in zip(np.argwhere(moving), names, strict=True):
        found[i][int(k)] = name
    return found


def _column(g: Graph, chain: Chain, i: int, ab: str, gains: list[str], growth: dict[int, str], mirror: bool) -> str:
    """Derivative [2, N] of one vector by one input: A dp + B du, and what A and B change."""

    def direct(part: Array) -> Array:
        dp, du = part[:2, i], part[2:, i]
        return np.hstack([np.diag(dp), np.diag(du)]) if mirror else np.stack([dp, du], 1)

    total = ""
    for k, name in growth.items():
        product = g.op("Mul", gains[k], name)
        total = g.op("Add", total, product) if total else product
    return g.op("Gemm", chain.matrix(g, direct(chain.base), direct(chain.slope)), ab, total)


def add_ray_derivatives(g: Graph, model: LensModel, rows: CoreRows, columns: Columns, series: DirectionSeries) -> None:
    """Outputs scene_ray_d_film and scene_ray_d_pupil, [2, 6, N] each: by x and by y of the film and the pupil point."""
    position, direction = columns[POSITION], columns[DIRECTION]
    sag = _sag_slope(g, model, rows.position)
    q = rows.direction
    t = _sum2(g, q, q)
    if model.direction == "slope":
        # d = (q, -1) f with f = 1 / sqrt(1 + t); df = -f^3 / 2 dt.
        factor = g.op("Reciprocal", g.op("Sqrt", g.op("Add", t, g.const(1.0))))
        factor_slope = g.op("Mul", g.op("Mul", g.op("Mul", factor, factor), factor), g.const(-0.5))
        z_slope = g.op("Neg", factor_slope)
    else:
        factor = add_horner(g, t, series.sinc)
        factor_slope = add_horner(g, t, _derivative(series.sinc))
        z_slope = add_horner(g, t, _derivative(series.minus_cos))
    q_slope = g.op("Mul", q, factor_slope)
    rows_of = []
    two_q = g.op("Add", q, q)
    for dx, dq in zip(position, direction, strict=True):
        dt = _sum2(g, two_q, dq)
        turn = g.op("Add", g.op("Mul", dq, factor), g.op("Mul", q_slope, dt))
        rows_of.append([dx, _sum2(g, sag, dx), turn, g.op("Mul", z_slope, dt)])
    for name, pair in (("scene_ray_d_film", rows_of[:2]), ("scene_ray_d_pupil", rows_of[2:])):
        g.reshape(g.concat(*pair[0], *pair[1]), [2, 6, -1], out=name)


def _sum2(g: Graph, a: str, b: str) -> str:
    """Scalar product [1, N] of two vectors [2, N]."""
    return g.op("MatMul", g.const([[1.0, 1.0]]), g.op("Mul", a, b))


def _derivative(series: Array) -> Array:
    found = series[1:] * np.arange(1, len(series))
    return found if len(found) > 1 else np.append(found, 0.0)


def _sag_slope(g: Graph, model: LensModel, position: str) -> str:
    """Gradient [2, N] of the front surface's z at positions [2, N]: twice the position times dz / d(h^2)."""
    none = g.op("Mul", position, g.const(0.0))
    if model.direction == "slope":
        return none
    surface = model.lens.surfaces[0]
    start = len(g.nodes)
    z = add_sag(g, surface, position)
    h2 = next(node.output[0] for node in g.nodes[start:] if node.op_type == "MatMul")
    one = g.op("Add", g.op("Mul", h2, g.const(0.0)), g.const(1.0))
    slope = Tangents(g, start, {h2: one}, len(g.nodes) - 2).of(z)
    bent = g.const([[2.0 * (surface.cylinder != "y")], [2.0 * (surface.cylinder != "x")]])
    return g.op("Mul", g.op("Mul", position, bent), slope)
