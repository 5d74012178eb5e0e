"""Forward-mode differentiation of graphs under construction: nodes that carry derivatives beside the values.

It serves whatever has no derivative of its own in `onnx_derivatives`: any core that the graph writer knows.
"""

from __future__ import annotations

from onnx import NodeProto

from neurolens.surrogates.onnx.graph import Graph

# Operators on which a derivative acts as the value does (of the first input; the others are constants).
_LINEAR = ("Identity", "Reshape", "Gather", "ReduceSum", "Neg")


class Tangents:
    """Derivatives of everything that the nodes from `start` on make, along one direction.

    Args:
        seeds: names of values with the names of their derivatives.

    A value that does not depend on the seeds has none.
    """

    def __init__(self, g: Graph, start: int, seeds: dict[str, str], stop: int | None = None) -> None:
        self.g = g
        self.known = dict(seeds)
        for node in g.nodes[start:stop]:
            if not set(node.output) & set(seeds) and any(name in self.known for name in node.input):
                self._follow(node)

    def of(self, name: str) -> str:
        """The derivative of a value; zeros where it has none."""
        return self.known.get(name) or self.g.op("Mul", name, self.g.const(0.0))

    def _follow(self, node: NodeProto) -> None:
        kind, inputs = node.op_type, list(node.input)
        if kind == "Split":
            attributes = {a.name: a.i for a in node.attribute}
            names = [f"{name}_d{len(self.g.nodes)}" for name in node.output]
            self.g.several("Split", [self.known[inputs[0]], inputs[1]], names, **attributes)
            self.known.update(zip(node.output, names, strict=True))
        elif kind in ("Greater", "GreaterOrEqual", "LessOrEqual", "Equal", "And", "Cast", "Clip"):
            return  # tests: piecewise constant
        else:
            self.known[node.output[0]] = self._slope(node, kind, inputs)

    def _slope(self, node: NodeProto, kind: str, inputs: list[str]) -> str:
        g, out = self.g, node.output[0]
        first = inputs[0]
        if kind in _LINEAR:
            attributes = {a.name: a.i for a in node.attribute}
            return g.op(kind, self.known[first], *inputs[1:], **attributes)
        if kind == "Concat":
            return g.concat(*(self.of(name) for name in inputs))
        if kind in ("Add", "Sub"):
            if all(name in self.known for name in inputs):
                return g.op(kind, *(self.known[name] for name in inputs))
            one = next(name for name in inputs if name in self.known)
            slope = self.known[one]
            return g.op("Neg", slope) if kind == "Sub" and one == inputs[1] else slope
        if kind in ("MatMul", "Gemm"):
            products = [g.op("MatMul", first, self.known[inputs[1]])] if inputs[1] in self.known else []
            products += [g.op("MatMul", self.known[first], inputs[1])] if first in self.known else []
            products += [self.known[name] for name in inputs[2:] if name in self.known]
            return self._sum(products)
        if kind == "Mul":
            if inputs[0] == inputs[1]:
                return g.op("Mul", g.op("Mul", first, g.const(2.0)), self.known[first])
            pairs = ((inputs[0], inputs[1]), (inputs[1], inputs[0]))
            return self._sum([g.op("Mul", self.known[a], b) for a, b in pairs if a in self.known])
        if kind == "Div":
            above = [self.known[first]] if first in self.known else []
            if inputs[1] in self.known:
                above.append(g.op("Neg", g.op("Mul", out, self.known[inputs[1]])))
            return g.op("Div", self._sum(above), inputs[1])
        if kind == "Where":
            zero = g.const(0.0)
            return g.op("Where", first, *(self.known.get(name, zero) for name in inputs[1:]))
        factor = self._factor(kind, first, out)
        return g.op("Mul", self.known[first], factor)

    def _factor(self, kind: str, x: str, out: str) -> str:
        """Derivative of a function of one value; `out` is the function's."""
        g, one = self.g, self.g.const(1.0)
        if kind == "Tanh":
            return g.once("Sub", one, g.once("Mul", out, out))
        if kind == "Sqrt":
            return g.once("Div", g.const(0.5), out)
        if kind == "Reciprocal":
            return g.once("Neg", g.once("Mul", out, out))
        if kind == "Relu":
            return g.once("Where", g.once("Greater", x, g.const(0.0)), one, g.const(0.0))
        if kind in ("Sin", "Cos"):
            other = g.once("Cos" if kind == "Sin" else "Sin", x)
            return other if kind == "Sin" else g.once("Neg", other)
        raise TypeError(f"no derivative of the operator {kind}")

    def _sum(self, names: list[str]) -> str:
        return names[0] if len(names) == 1 else self.g.op("Add", names[0], self._sum(names[1:]))
