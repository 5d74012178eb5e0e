"""A polynomial and a network as one piece of graph: the network's last product adds itself to the polynomial's."""

from __future__ import annotations

import numpy as np
import torch

from neurolens.surrogates.cores import InvariantPolynomial
from neurolens.surrogates.onnx_cores import (
    Array,
    CoreRows,
    Field,
    add_ab_rows,
    add_hidden,
    invariant_rows,
    output_rows,
)
from neurolens.surrogates.onnx_graph import Graph
from neurolens.surrogates.residual import Residual


def add_residual(g: Graph, core: Residual, field: Field, vector_scale: Array, gate_scale: float) -> CoreRows:
    """Append the core; arguments as of `onnx_cores.add_core`."""
    polynomial, network = core.parts
    weight, bias = output_rows(network, vector_scale, gate_scale)
    rows = invariant_rows(g, _with_constant(polynomial), field, vector_scale, gate_scale, bias)
    h = add_hidden(g, network, field)
    return add_ab_rows(g, g.op("Gemm", g.const(weight), h, rows), field, len(weight))


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
