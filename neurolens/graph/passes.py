"""Passes over graphs: what outputs need, graphs of these outputs alone, graphs of one structure."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from typing import Any

from neurolens.graph.ir import Graph, Node, Value

# Any row of these needs all rows of their inputs, but of the rows that an affine adds.
_WHOLE = frozenset(("affine", "polynomial", "quadratic", "first_failure", "lookup"))


def _needed(graph: Graph, node: Node, rows: Collection[int]) -> Iterator[tuple[int, Collection[int]]]:
    """Numbers of the inputs that these rows of a node need, each with its rows needed, in the order of `rows`."""
    if node.kind == "take":
        yield node.inputs[0], [node.static[r] for r in rows]
    elif node.kind == "concat":
        start = 0
        for k in node.inputs:
            end = start + graph.nodes[k].rows
            if mine := [r - start for r in rows if start <= r < end]:
                yield k, mine
            start = end
    else:
        whole = len(node.inputs) - (node.kind == "affine" and node.static[1]) if node.kind in _WHOLE else 0
        for place, k in enumerate(node.inputs):
            yield k, range(graph.nodes[k].rows) if place < whole else rows


def live_rows(graph: Graph, outputs: Mapping[str, Value]) -> dict[int, set[int]]:
    """The rows of each node that the outputs need; a node that is not there is not needed."""
    needed: dict[int, set[int]] = {}

    def ask(number: int, rows: Iterable[int]) -> None:
        available = graph.nodes[number].rows
        needed.setdefault(number, set()).update(r if available > 1 else 0 for r in rows)

    for value in outputs.values():
        ask(value.number, range(value.rows))
    for number in range(len(graph.nodes) - 1, -1, -1):
        if number in needed:
            for k, rows in _needed(graph, graph.nodes[number], needed[number]):
                ask(k, rows)
    return needed


def pruned(graph: Graph, outputs: Mapping[str, Value] | None = None) -> Graph:
    """The graph of these outputs (or its own) alone: rows of matrices and polynomials that nothing needs are gone."""
    wanted = dict(graph.outputs if outputs is None else outputs)
    live = live_rows(graph, wanted)
    found = Graph()
    place: dict[int, Value] = {}  # a node's value among the new ones
    kept: dict[int, list[int]] = {}  # the old rows that it holds, in order

    def rows_of(number: int, rows: Collection[int]) -> Value:
        """New value of old rows; a single row stands for any."""
        known = kept[number]
        if graph.nodes[number].rows == 1:
            return place[number]
        return found.take(place[number], [known.index(r) for r in rows])

    for number, node in enumerate(graph.nodes):
        if number not in live:
            continue
        every, rows = list(range(node.rows)), sorted(live[number])
        if node.kind in ("input", "table"):
            place[number], kept[number] = found.like(node, ()), every
            continue
        kept[number] = rows
        inputs = [rows_of(k, wanted_rows) for k, wanted_rows in _needed(graph, node, rows)]
        if node.kind == "constant":
            place[number] = found.constant(node.arrays[0][rows], *node.static)
        elif node.kind == "take":
            place[number] = inputs[0]
        elif node.kind == "concat":
            place[number] = found.concat(*inputs)
        else:
            place[number] = _kept_rows(found, node, rows, inputs)
    found.outputs = {name: rows_of(v.number, range(v.rows)) for name, v in wanted.items()}
    return found


def _kept_rows(found: Graph, node: Node, rows: list[int], inputs: list[Value]) -> Value:
    """A node that computes, for these of its rows."""
    cut = {"affine": 0, "quadratic": 0, "between": 0, "polynomial": 1}.get(node.kind, len(node.arrays))
    arrays = [a if k < cut else a[rows] for k, a in enumerate(node.arrays)]
    by_row = node.kind in ("quadratic", "lookup")
    static = tuple(node.static[r] for r in rows) if by_row else node.static
    per_call = False if node.kind == "lookup" else None
    return found.add(node.kind, inputs, len(rows), arrays=arrays, static=static, per_call=per_call)


def same_structure(graphs: Sequence[Graph]) -> bool:
    """Whether graphs differ in their numbers only, so that one set of operations serves all of them."""

    def shape(graph: Graph) -> list[Any]:
        bare = []
        for n in graph.nodes:
            exponents = n.arrays[0].tobytes() if n.kind == "polynomial" else b""
            bare.append((n.kind, n.inputs, n.rows, n.name, n.static, [a.shape for a in n.arrays], exponents))
        return [bare, {name: v.number for name, v in graph.outputs.items()}]

    first = shape(graphs[0])
    return all(shape(g) == first for g in graphs[1:])
