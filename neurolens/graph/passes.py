"""Passes over graphs: what outputs need, graphs of these outputs alone, graphs of one structure."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from neurolens.graph.ir import Graph, Node, Value


def live_rows(graph: Graph, outputs: Mapping[str, Value]) -> dict[int, set[int]]:
    """The rows of each node that the outputs need; a node that is not there is not needed."""
    needed: dict[int, set[int]] = {}

    def ask(number: int, rows: Iterable[int]) -> None:
        available = graph.nodes[number].rows
        needed.setdefault(number, set()).update(r if available > 1 else 0 for r in rows)

    for value in outputs.values():
        ask(value.number, range(value.rows))
    for number in range(len(graph.nodes) - 1, -1, -1):
        if number not in needed:
            continue
        node, rows = graph.nodes[number], needed[number]
        if node.kind == "take":
            ask(node.inputs[0], (node.static[r] for r in rows))
        elif node.kind == "concat":
            start = 0
            for k in node.inputs:
                end = start + graph.nodes[k].rows
                mine = [r - start for r in rows if start <= r < end]
                if mine:
                    ask(k, mine)
                start = end
        elif node.kind == "lookup":
            for k in node.inputs:
                ask(k, range(graph.nodes[k].rows))
        elif node.kind in ("affine", "polynomial", "quadratic", "first_failure"):
            for k in node.inputs[:1] if node.kind == "affine" else node.inputs:
                ask(k, range(graph.nodes[k].rows))
            if node.kind == "affine":
                moving, added = node.static
                if moving:
                    ask(node.inputs[1], [0])
                if added:
                    ask(node.inputs[-1], rows)
        else:
            for k in node.inputs:
                ask(k, rows)
    return needed


def pruned(graph: Graph, outputs: Mapping[str, Value] | None = None) -> Graph:
    """The graph of these outputs (or its own) alone: rows of matrices and polynomials that nothing needs are gone."""
    wanted = dict(graph.outputs if outputs is None else outputs)
    live = live_rows(graph, wanted)
    found = Graph()
    place: dict[int, Value] = {}  # a node's value among the new ones
    kept: dict[int, list[int]] = {}  # the old rows that it holds, in order

    def rows_of(number: int, rows: Sequence[int]) -> Value:
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
        if node.kind == "constant":
            place[number] = found.constant(node.arrays[0][rows])
        elif node.kind == "take":
            place[number] = rows_of(node.inputs[0], [node.static[r] for r in rows])
        elif node.kind == "concat":
            parts, start = [], 0
            for k in node.inputs:
                mine = [r - start for r in rows if start <= r < start + graph.nodes[k].rows]
                parts += [rows_of(k, mine)] if mine else []
                start += graph.nodes[k].rows
            place[number] = found.concat(*parts)
        else:
            place[number] = _kept_rows(found, graph, node, rows, rows_of)
    found.outputs = {name: rows_of(v.number, range(v.rows)) for name, v in wanted.items()}
    return found


def _kept_rows(found: Graph, graph: Graph, node: Node, rows: list[int], rows_of: Any) -> Value:
    """A node that computes, for these of its rows."""

    def whole(k: int) -> Value:
        value: Value = rows_of(k, range(graph.nodes[k].rows))
        return value

    if node.kind in ("affine", "quadratic", "polynomial"):
        added = node.kind == "affine" and node.static[1]
        inputs = [whole(k) for k in node.inputs[: -1 if added else None]]
        arrays = [a[rows] for a in node.arrays] if node.kind != "polynomial" else [node.arrays[0], node.arrays[1][rows]]
        static = node.static
        if added:
            inputs.append(rows_of(node.inputs[-1], rows))
        if node.kind == "quadratic":
            static = tuple(node.static[r] for r in rows)
        return found.add(node.kind, inputs, len(rows), arrays=arrays, static=static)
    if node.kind == "lookup":
        static = tuple(node.static[r] for r in rows)
        return found.add(node.kind, [whole(k) for k in node.inputs], len(rows), static=static, per_call=False)
    if node.kind == "first_failure":
        return found.add(node.kind, [whole(k) for k in node.inputs], 1, static=node.static)
    arrays = [a[rows] if node.kind == "between" else a for a in node.arrays]
    inputs = [rows_of(k, rows) for k in node.inputs]
    return found.add(node.kind, inputs, len(rows), arrays=arrays, static=node.static)


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
