"""Plans that make each monomial as the product of two others: in few blocks of rows, or in few products of one ray."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from itertools import product

Exponent = tuple[int, ...]
Pair = tuple[Exponent, Exponent]
Block = tuple[str, list[Exponent]]  # a name, and the monomials of its rows
Made = tuple[Exponent, Pair | None]  # a monomial and the two that it is the product of


def plan_monomials(wanted: Sequence[Exponent], variables: int) -> list[Made]:
    """An order in which every monomial is a variable (None) or the product of two before it.

    Factors that exist anyway are taken first, else those that add least. The order is depth first: the factors of a
    monomial were made just before it.
    """
    units = [tuple(int(i == v) for i in range(variables)) for v in range(variables)]
    factors: dict[Exponent, Pair] = {}
    known = {*units, *wanted}

    def resolve(e: Exponent) -> None:
        if sum(e) == 1 or e in factors:
            return
        _, _, left, right = min((sum(f not in known for f in {*pair}), sum(pair[1]), *pair) for pair in _splits(e))
        known.update((left, right))
        factors[e] = (left, right)
        resolve(left)
        resolve(right)

    for e in sorted(wanted, key=lambda e: (sum(e), e), reverse=True):
        resolve(e)
    return _depth_first([*units, *sorted(factors, key=lambda e: (sum(e), e))], factors, set(wanted))


def _splits(e: Exponent) -> Iterator[Pair]:
    """All pairs of monomials whose product is e, the right one of no higher degree."""
    for right in product(*(range(k + 1) for k in e)):
        if 0 < sum(right) <= sum(e) // 2:
            yield tuple(a - b for a, b in zip(e, right, strict=True)), right


def _depth_first(nodes: list[Exponent], factors: dict[Exponent, Pair], wanted: set[Exponent]) -> list[Made]:
    """Nodes in an order with factors first; each node is followed by those that waited for it alone."""
    waiting: dict[Exponent, set[Exponent]] = {e: set(pair) for e, pair in factors.items()}
    order: list[Made] = []
    stack = [e for e in reversed(nodes) if e not in factors]
    while stack:
        e = stack.pop()
        order.append((e, factors.get(e)))
        for child in sorted((c for c, missing in waiting.items() if e in missing), reverse=True):
            waiting[child].discard(e)
            if not waiting[child]:
                del waiting[child]
                stack.append(child)
    return [(e, pair) for e, pair in order if pair is not None or e in wanted]


def level_of(e: Exponent) -> int:
    """The level of a monomial: 0 for a variable, 1 for degree 2, 2 for 3 to 4, 3 for 5 to 8 ..."""
    return (sum(e) - 1).bit_length()


def plan_products(exponents: list[Exponent], variables: int) -> dict[int, dict[Exponent, Pair]]:
    """Every monomial as a product of two of lower levels: {level: {monomial: (left, right)}}; greedy.

    Factors that are wanted anyway come first, then small right factors; factors that are missing are added.
    """
    wanted = {e for e in exponents if sum(e) > 1}
    parents: dict[Exponent, Pair] = {}
    # From the highest degree down, so that an added factor is still ahead in the loop.
    queue = sorted(wanted, key=lambda e: (sum(e), e))
    while queue:
        e = queue.pop()
        options = []
        for left, right in _splits(e):
            if level_of(left) < level_of(e):
                missing = sum(sum(part) > 1 and part not in wanted for part in {left, right})
                options.append((missing, level_of(right), sum(right), left, right))
        *_, left, right = min(options)
        parents[e] = (left, right)
        for part in (left, right):
            if sum(part) > 1 and part not in wanted:
                wanted.add(part)
                queue = sorted([*queue, part], key=lambda e: (sum(e), e))
    levels = sorted({level_of(e) for e in parents})
    return {n: {e: pair for e, pair in parents.items() if level_of(e) == n} for n in levels}


def by_block(blocks: Sequence[Block], pairs: dict[Exponent, Pair]) -> list[dict[Exponent, Pair]]:
    """Products grouped by the blocks in which their two factors lie."""
    home = {e: i for i, (_, known) in enumerate(blocks) for e in known}
    groups: dict[tuple[int, int], dict[Exponent, Pair]] = {}
    for e, (a, b) in sorted(pairs.items()):
        groups.setdefault((home[a], home[b]), {})[e] = (a, b)
    return list(groups.values())


def blocks_alone(blocks: Sequence[Block]) -> int:
    """How many blocks matrix products take one by one; the others are joined, where copying costs less."""
    copy_row, one_product = 0.27, 2.5  # ns a ray, measured in onnxruntime (12 outputs)
    best, alone = math.inf, 0
    for first in range(len(blocks)):
        rows = sum(len(known) for _, known in blocks[first:])
        cost = one_product * first + (copy_row * rows if first < len(blocks) - 1 else 0.0)
        if cost < best:
            best, alone = cost, first
    return alone
