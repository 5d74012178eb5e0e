"""Monomials as ONNX nodes: each the product of two lower ones, gathered in blocks; matrix products for all outputs."""

from __future__ import annotations

import math
from itertools import product

import numpy as np
from numpy.typing import NDArray

from neurolens.surrogates.onnx.graph import Graph

Array = NDArray[np.float64]
Exponent = tuple[int, ...]


def without_constants(
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
