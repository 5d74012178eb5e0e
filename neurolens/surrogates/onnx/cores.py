"""The cores of surrogates as ONNX nodes: monomials or tanh layers, then one matrix product for all outputs.

Rows are features or outputs, columns are rays. Every row of the products is scaled as the decoder wants it, so that
no pass over the rays is spent on scaling.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from neurolens.surrogates.cores import InvariantPolynomial, MirrorPolynomial, Network, Partitioned, RawPolynomial
from neurolens.surrogates.model import Core
from neurolens.surrogates.onnx.graph import Graph
from neurolens.surrogates.onnx.monomials import add_polynomial, without_constants
from neurolens.surrogates.residual import Residual

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Field:
    """The light field in the graph.

    Attributes:
        p, u: [2, N] each.
        squares: [K, N], the invariants (rows rho, sigma, tau, w, or those of
            `LightField.mirror_invariants`) are weight @ squares + bias.
        weight, bias: [4 or 7, K] and [4 or 7].
        dispersive: whether w varies.
    """

    p: str
    u: str
    squares: str
    weight: Array
    bias: Array
    dispersive: bool


@dataclass(frozen=True)
class CoreRows:
    """What a core gives: vectors [2, N] each, transmittance and gates [1, N] each.

    `unit`: where a core gives it, the unit direction [3, N] itself, which then stands for `direction`.
    """

    position: str
    direction: str
    stop: str
    transmittance: str
    gates: list[str]
    unit: str = ""


def add_core(g: Graph, core: Core, field: Field, vector_scale: Array, gate_scale: float) -> CoreRows:
    """Append a core.

    Args:
        vector_scale: [3], factors on position, direction and stop.
        gate_scale: factor on the gates.

    Raises:
        TypeError: a core that has no ONNX form.
    """
    write = _WRITERS.get(type(core))
    if write is not None:
        return write(g, core, field, vector_scale, gate_scale)
    from neurolens.surrogates.published.graph import add_published  # published cores hold cores of this module

    return add_published(g, core, field, vector_scale, gate_scale)


def _numpy(tensor: object) -> Array:
    return np.asarray(tensor.detach().cpu().numpy(), dtype=np.float64)  # type: ignore[attr-defined]


def _scaled_scalars(scalars: Array, gate_scale: float) -> Array:
    return np.concatenate([scalars[:1], gate_scale * scalars[1:]])


def _invariant_polynomial(
    g: Graph, core: InvariantPolynomial, field: Field, vector_scale: Array, gate_scale: float
) -> CoreRows:
    return _ab_rows(g, _invariant_rows(g, core, field, vector_scale, gate_scale), field, 6 + len(core.scalars))


def _invariant_rows(
    g: Graph,
    core: InvariantPolynomial,
    field: Field,
    vector_scale: Array,
    gate_scale: float,
    constant: Array | None = None,
) -> str:
    """Rows A, A, A, B, B, B, transmittance, gates of a polynomial; `constant` is added to its term of degree 0."""
    ab = _numpy(core.ab) * vector_scale[:, None, None]  # [3, 2, M]
    weight = np.concatenate([ab[:, 0], ab[:, 1], _scaled_scalars(_numpy(core.scalars), gate_scale)])
    if constant is not None:
        weight = weight + np.outer(constant, (core.exponents == 0).all(1))
    variables = [0, 1, 2, 3] if field.dispersive else [0, 1, 2]
    exponents, weight = without_constants(core.exponents, weight, variables)
    first = g.affine(field.weight[variables], field.squares, field.bias[variables])
    return add_polynomial(g, first, exponents, weight)


def _mirror_polynomial(
    g: Graph, core: MirrorPolynomial, field: Field, vector_scale: Array, gate_scale: float
) -> CoreRows:
    ab = _numpy(core.ab) * vector_scale[:, None, None, None]  # [3, 2, 2, M]
    scalars = _scaled_scalars(_numpy(core.scalars), gate_scale)
    weight = np.concatenate([ab[:, 0].reshape(6, -1), ab[:, 1].reshape(6, -1), scalars])
    variables = list(range(7 if field.dispersive else 6))
    exponents, weight = without_constants(core.exponents, weight, variables)
    first = g.affine(field.weight[variables], field.squares, field.bias[variables])
    return _mirror_rows(g, add_polynomial(g, first, exponents, weight), field, len(weight))


def _mirror_rows(g: Graph, out: str, field: Field, count: int) -> CoreRows:
    """A p + B u for three vectors, x and y by themselves, from rows A (x, y) three times, B likewise, scalars."""
    return _vectors(g, g.split(out, [2] * 6 + [1] * (count - 12)), field)


def _network(g: Graph, core: Network, field: Field, vector_scale: Array, gate_scale: float) -> CoreRows:
    weight, bias = _output_rows(core, vector_scale, gate_scale)
    out = g.affine(weight, _hidden(g, core, field), bias)
    return (_mirror_rows if core.mirror else _ab_rows)(g, out, field, len(weight))


def _hidden(g: Graph, core: Network, field: Field) -> str:
    """The last tanh layer, [units, N]."""
    shift, scale = _numpy(core.shift), _numpy(core.scale)
    # The first layer takes the squares themselves: the invariants never exist in the graph.
    to_input = scale[:, None] * field.weight
    input_bias = scale * (field.bias - shift)
    h = field.squares
    for i, (w, b) in enumerate(core.hidden):
        weight, bias = _numpy(w), _numpy(b)
        if i == 0:
            weight, bias = weight @ to_input, bias + weight @ input_bias
        h = g.op("Tanh", g.affine(weight, h, bias))
    return h


def _output_rows(core: Network, vector_scale: Array, gate_scale: float) -> tuple[Array, Array]:
    """Weight [6 + S, units] and bias [6 + S] of a network's last layer, in the order of `_ab_rows`.

    12 + S rows in the order of `_mirror_rows` for a lens with cylinders.
    """
    weight, bias = (np.array(_numpy(t)) for t in core.output)
    n, axes = core.ab_rows, core.ab_rows // 6
    order = [*range(0, n, 2), *range(1, n, 2), *range(n, len(weight))]  # A of the three vectors, then B
    scale = np.repeat(vector_scale, axes)
    factors = np.concatenate([np.tile(scale, 2), [1.0], np.full(len(weight) - n - 1, gate_scale)])
    return factors[:, None] * weight[order], factors * bias[order]


def _ab_rows(g: Graph, out: str, field: Field, count: int) -> CoreRows:
    """A p + B u for three vectors, from rows A, A, A, B, B, B, transmittance, gates."""
    return _vectors(g, g.split(out, [1] * count), field)


def _vectors(g: Graph, rows: list[str], field: Field) -> CoreRows:
    # Vector by vector: products of two rows stay in the first-level cache, and nothing has to be taken apart later.
    vectors = [
        g.op("Add", g.op("Mul", a, field.p), g.op("Mul", b, field.u)) for a, b in zip(rows[:3], rows[3:6], strict=True)
    ]
    return CoreRows(vectors[0], vectors[1], vectors[2], rows[6], rows[7:])


def _raw_polynomial(g: Graph, core: RawPolynomial, field: Field, vector_scale: Array, gate_scale: float) -> CoreRows:
    components = (_numpy(core.components) * vector_scale[:, None, None]).reshape(6, -1)
    weight = np.concatenate([components, _scaled_scalars(_numpy(core.scalars), gate_scale)])
    variables = [0, 1, 2, 3, 4] if field.dispersive else [0, 1, 2, 3]
    exponents, weight = without_constants(core.exponents, weight, variables)
    first = [field.p, field.u]
    if field.dispersive:
        first.append(g.affine(field.weight[3:], field.squares, field.bias[3:]))
    out = add_polynomial(g, g.concat(*first), exponents, weight)
    parts = g.split(out, [2, 2, 2, *[1] * (len(weight) - 6)])
    return CoreRows(parts[0], parts[1], parts[2], parts[3], parts[4:])


def _partitioned(g: Graph, core: Partitioned, field: Field, vector_scale: Array, gate_scale: float) -> CoreRows:
    """Every zone's core for every ray, and a choice by rho."""
    rho = g.affine(field.weight[:1], field.squares, field.bias[:1])
    chosen = add_core(g, core.parts[0], field, vector_scale, gate_scale)
    for edge, part in zip(core.edges, core.parts[1:], strict=True):
        beyond = g.op("Greater", rho, g.const(edge))
        outer = add_core(g, part, field, vector_scale, gate_scale)

        def choose(new: str, old: str, beyond: str = beyond) -> str:
            return g.op("Where", beyond, new, old)

        chosen = CoreRows(
            choose(outer.position, chosen.position),
            choose(outer.direction, chosen.direction),
            choose(outer.stop, chosen.stop),
            choose(outer.transmittance, chosen.transmittance),
            [choose(a, b) for a, b in zip(outer.gates, chosen.gates, strict=True)],
        )
    return chosen


def _residual(g: Graph, core: Residual, field: Field, vector_scale: Array, gate_scale: float) -> CoreRows:
    """The network's last product adds itself to the polynomial's."""
    polynomial, network = core.parts
    weight, bias = _output_rows(network, vector_scale, gate_scale)
    rows = _invariant_rows(g, _with_constant(polynomial), field, vector_scale, gate_scale, bias)
    return _ab_rows(g, g.op("Gemm", g.const(weight), _hidden(g, network, field), rows), field, len(weight))


def _with_constant(core: InvariantPolynomial) -> InvariantPolynomial:
    """The same polynomial with the constant among its terms."""
    if (core.exponents == 0).all(1).any():
        return core
    nothing = torch.zeros((*core.ab.shape[:2], 1), dtype=core.ab.dtype)
    return InvariantPolynomial(
        np.concatenate([core.exponents, np.zeros((1, 4), np.int64)]),
        torch.cat([core.ab, nothing], 2),
        torch.cat([core.scalars, nothing.new_zeros(len(core.scalars), 1)], 1),
    )


_WRITERS: dict[type, Callable[..., CoreRows]] = {
    InvariantPolynomial: _invariant_polynomial,
    MirrorPolynomial: _mirror_polynomial,
    RawPolynomial: _raw_polynomial,
    Network: _network,
    Partitioned: _partitioned,
    Residual: _residual,
}
