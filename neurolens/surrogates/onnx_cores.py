"""The cores of surrogates as ONNX nodes: monomials or tanh layers, then one matrix product for all outputs.

Rows are features or outputs, columns are rays. Every row of the products is scaled as the decoder wants it, so that
no pass over the rays is spent on scaling.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import NDArray

from neurolens.surrogates.cores import InvariantPolynomial, Network, Partitioned, RawPolynomial
from neurolens.surrogates.model import Core
from neurolens.surrogates.onnx_graph import Graph

Array = NDArray[np.float64]
Exponent = tuple[int, ...]


@dataclass(frozen=True)
class Field:
    """The light field in the graph.

    Attributes:
        p, u: [2, N] each.
        squares: [K, N], the invariants (rows rho, sigma, tau, w) are weight @ squares + bias.
        weight, bias: [4, K] and [4].
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
    """What a core gives: vectors [2, N] each, transmittance and gates [1, N] each."""

    position: str
    direction: str
    stop: str
    transmittance: str
    gates: list[str]


def add_core(g: Graph, core: Core, field: Field, vector_scale: Array, gate_scale: float) -> CoreRows:
    """Append a core.

    Args:
        vector_scale: [3], factors on position, direction and stop.
        gate_scale: factor on the gates.

    Raises:
        TypeError: a core that has no ONNX form.
    """
    if isinstance(core, InvariantPolynomial):
        return _invariant_polynomial(g, core, field, vector_scale, gate_scale)
    if isinstance(core, RawPolynomial):
        return _raw_polynomial(g, core, field, vector_scale, gate_scale)
    if isinstance(core, Network):
        return _network(g, core, field, vector_scale, gate_scale)
    if isinstance(core, Partitioned):
        return _partitioned(g, core, field, vector_scale, gate_scale)
    raise TypeError(f"no ONNX form for a core of type {type(core).__name__}")


def _numpy(tensor: object) -> Array:
    return np.asarray(tensor.detach().cpu().numpy(), dtype=np.float64)  # type: ignore[attr-defined]


def _scaled_scalars(scalars: Array, gate_scale: float) -> Array:
    return np.concatenate([scalars[:1], gate_scale * scalars[1:]])


def _invariant_polynomial(
    g: Graph, core: InvariantPolynomial, field: Field, vector_scale: Array, gate_scale: float
) -> CoreRows:
    ab = _numpy(core.ab) * vector_scale[:, None, None]  # [3, 2, M]
    weight = np.concatenate([ab[:, 0], ab[:, 1], _scaled_scalars(_numpy(core.scalars), gate_scale)])
    variables = [0, 1, 2, 3] if field.dispersive else [0, 1, 2]
    exponents, weight = _without_constants(core.exponents, weight, variables)
    first = g.affine(field.weight[variables], field.squares, field.bias[variables])
    return _ab_rows(g, add_polynomial(g, first, exponents, weight), field, len(weight))


def _network(g: Graph, core: Network, field: Field, vector_scale: Array, gate_scale: float) -> CoreRows:
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
    weight, bias = (np.array(_numpy(t)) for t in core.output)
    order = [0, 2, 4, 1, 3, 5, *range(6, len(weight))]  # A of the three vectors, then B
    factors = np.concatenate([np.tile(vector_scale, 2), [1.0], np.full(len(weight) - 7, gate_scale)])
    weight, bias = factors[:, None] * weight[order], factors * bias[order]
    return _ab_rows(g, g.affine(weight, h, bias), field, len(weight))


def _ab_rows(g: Graph, out: str, field: Field, count: int) -> CoreRows:
    """A p + B u for three vectors, from rows A, A, A, B, B, B, transmittance, gates."""
    rows = g.split(out, [1] * count)
    ab = rows[:6]
    # Vector by vector: products of two rows stay in the first-level cache, and nothing has to be taken apart later.
    vectors = [
        g.op("Add", g.op("Mul", a, field.p), g.op("Mul", b, field.u)) for a, b in zip(ab[:3], ab[3:], strict=True)
    ]
    return CoreRows(vectors[0], vectors[1], vectors[2], rows[6], rows[7:])


def _raw_polynomial(g: Graph, core: RawPolynomial, field: Field, vector_scale: Array, gate_scale: float) -> CoreRows:
    components = (_numpy(core.components) * vector_scale[:, None, None]).reshape(6, -1)
    weight = np.concatenate([components, _scaled_scalars(_numpy(core.scalars), gate_scale)])
    variables = [0, 1, 2, 3, 4] if field.dispersive else [0, 1, 2, 3]
    exponents, weight = _without_constants(core.exponents, weight, variables)
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


def _without_constants(
    exponents: NDArray[np.int64], weight: Array, variables: list[int]
) -> tuple[list[Exponent], Array]:
    """Drop monomials of a variable that is always 0 and those that no output uses."""
    dropped = [v for v in range(exponents.shape[1]) if v not in variables]
    used = (exponents[:, dropped] == 0).all(1) & (weight != 0).any(0)
    return [tuple(int(e) for e in row) for row in exponents[used][:, variables]], weight[:, used]


def add_polynomial(g: Graph, first: str, exponents: list[Exponent], weight: Array) -> str:
    """[M, N] = weight [M, K] @ monomials [K, N] of the variables in `first` [V, N].

    Monomials of degree 2, 3 to 4, 5 to 8 ... are each the product of two lower ones, gathered from the blocks where
    those lie.
    """
    variables = len(exponents[0])
    table = dict(zip(exponents, weight.T, strict=True))
    nothing = np.zeros(len(weight))
    units = [tuple(int(i == v) for i in range(variables)) for v in range(variables)]
    blocks = [(first, units)]
    for level, pairs in plan_products(exponents, variables).items():
        made = [_products(g, blocks, group) for group in _by_block(blocks, pairs)]
        if level == 1:
            # Degrees 1 and 2 are the factors of all that follows: together they need one gather, not two.
            names, lists = zip(*blocks, *made, strict=True)
            blocks = [(g.concat(*names), [e for known in lists for e in known])]
        else:
            blocks += made
    out = ""
    for name, known in _joined(g, blocks):
        block_weight = np.stack([table.get(e, nothing) for e in known], axis=1)
        if not out:
            out = g.affine(block_weight, name, table.get((0,) * variables, nothing))
        else:
            out = g.op("Gemm", g.const(block_weight), name, out)
    return out


Pair = tuple[Exponent, Exponent]
Block = tuple[str, list[Exponent]]


def _by_block(blocks: list[Block], pairs: dict[Exponent, Pair]) -> list[dict[Exponent, Pair]]:
    """Products grouped by the blocks in which their two factors lie."""
    home = {e: i for i, (_, known) in enumerate(blocks) for e in known}
    groups: dict[tuple[int, int], dict[Exponent, Pair]] = {}
    for e, (a, b) in sorted(pairs.items()):
        groups.setdefault((home[a], home[b]), {})[e] = (a, b)
    return list(groups.values())


def _joined(g: Graph, blocks: list[Block]) -> list[Block]:
    """Blocks as the matrix products take them: joined where copying them costs less than another product."""
    copy_row, product = 0.07, 1.2  # ns a ray, measured in onnxruntime (12 outputs)
    best, cut = math.inf, 0
    for first in range(len(blocks)):  # blocks before `first` stay alone, the others become one
        rows = sum(len(known) for _, known in blocks[first:])
        cost = product * first + (copy_row * rows if first < len(blocks) - 1 else 0.0)
        if cost < best:
            best, cut = cost, first
    names, lists = zip(*blocks[cut:], strict=True)
    return [*blocks[:cut], (g.concat(*names), [e for known in lists for e in known])]


def _products(g: Graph, blocks: list[Block], pairs: dict[Exponent, Pair]) -> Block:
    """One block of products whose left factors lie in one block, and whose right factors lie in one block."""
    factors = []
    for side in (0, 1):
        wanted = [pair[side] for pair in pairs.values()]
        name, known = next(block for block in blocks if wanted[0] in block[1])
        factors.append(g.op("Gather", name, g.const([known.index(e) for e in wanted], np.int64), axis=0))
    return g.op("Mul", *factors), list(pairs)


def _level(e: Exponent) -> int:
    """0 for a variable, 1 for degree 2, 2 for 3 to 4, 3 for 5 to 8 ..."""
    return (sum(e) - 1).bit_length()


def plan_products(exponents: list[Exponent], variables: int) -> dict[int, dict[Exponent, Pair]]:
    """How to build every monomial as a product of two of lower levels: {level: {monomial: (left, right)}}.

    Factors that are wanted anyway come first, then small right factors; what is still missing is added. Greedy.
    """
    wanted = {e for e in exponents if sum(e) > 1}
    parents: dict[Exponent, Pair] = {}
    # From the highest degree down, so that an added factor is still ahead in the loop.
    queue = sorted(wanted, key=lambda e: (sum(e), e))
    while queue:
        e = queue.pop()
        options = []
        for right in product(*(range(k + 1) for k in e)):
            left = tuple(x - y for x, y in zip(e, right, strict=True))
            if 0 < sum(right) <= sum(left) and _level(left) < _level(e):
                missing = sum(sum(part) > 1 and part not in wanted for part in {left, right})
                options.append((missing, _level(right), sum(right), left, right))
        *_, left, right = min(options)
        parents[e] = (left, right)
        for part in (left, right):
            if sum(part) > 1 and part not in wanted:
                wanted.add(part)
                queue = sorted([*queue, part], key=lambda e: (sum(e), e))
    levels = sorted({_level(e) for e in parents})
    return {n: {e: pair for e, pair in parents.items() if _level(e) == n} for n in levels}
