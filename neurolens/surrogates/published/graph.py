"""The cores of the published methods as ONNX nodes; `neurolens.surrogates.onnx.cores` does all others."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from neurolens.surrogates.model import Core
from neurolens.surrogates.onnx.cores import CoreRows, Field, add_core
from neurolens.surrogates.onnx.graph import Graph
from neurolens.surrogates.onnx.monomials import add_polynomial, without_constants
from neurolens.surrogates.published.cores import Cells, OuterPupil
from neurolens.surrogates.published.neural import Averaged, Layers
from neurolens.surrogates.published.rtf import Meridian

Array = NDArray[np.float64]


def add_published(g: Graph, core: Core, field: Field, vector_scale: Array, gate_scale: float) -> CoreRows:
    """Append a core of a published method; arguments as in `add_core`.

    Raises:
        TypeError: a core that has no ONNX form.
    """
    write = _WRITERS.get(type(core))
    if write is None:
        raise TypeError(f"no ONNX form for a core of type {type(core).__name__}")
    return write(g, core, field, vector_scale, gate_scale)


def _cells(g: Graph, core: Cells, field: Field, vector_scale: Array, gate_scale: float) -> CoreRows:
    """Both halves for every ray, and a choice."""
    k = core.variable
    deciding = g.affine(field.weight[k : k + 1], field.squares, field.bias[k : k + 1])
    beyond = g.op("Greater", deciding, g.const(core.threshold))
    low, high = (add_core(g, half, field, vector_scale, gate_scale) for half in (core.low, core.high))

    def choose(low: str, high: str) -> str:
        return g.op("Where", beyond, high, low)

    return CoreRows(
        choose(low.position, high.position),
        choose(low.direction, high.direction),
        choose(low.stop, high.stop),
        choose(low.transmittance, high.transmittance),
        [choose(a, b) for a, b in zip(low.gates, high.gates, strict=True)],
    )


def _outer_pupil(g: Graph, core: OuterPupil, field: Field, vector_scale: Array, gate_scale: float) -> CoreRows:
    millimetres = float(vector_scale[0])
    rows = add_core(g, core.polynomial, field, vector_scale * np.array([1.0, 0.0, 1.0]) + [0, 1, 0], gate_scale)
    gates = []
    if core.inner is not None:
        along_p, along_u = (g.op("Mul", v, g.const(k)) for v, k in zip((field.p, field.u), core.inner, strict=True))
        gates.append(_beyond(g, g.op("Add", along_p, along_u), 1.0, gate_scale))
    if core.outer is not None:
        gates.append(_beyond(g, rows.position, core.outer / millimetres, gate_scale))
    unit = _from_tangents(g, rows.position, rows.direction, core.curvature / millimetres)
    return replace(rows, unit=unit, gates=gates)


def _square(g: Graph, vector: str, scale: float = 1.0) -> str:
    return g.op("MatMul", g.const([[scale, scale]]), g.op("Mul", vector, vector))


def _beyond(g: Graph, vector: str, inverse_radius: float, gate_scale: float) -> str:
    """gate_scale ((r / radius)^2 - 1), [1, N]."""
    excess = g.op("Sub", _square(g, vector, inverse_radius**2), g.const(1.0))
    return g.op("Mul", excess, g.const(gate_scale))


def _from_tangents(g: Graph, position: str, tangents: str, curvature: float) -> str:
    """Unit directions [3, N]; see `cores.from_tangents`."""
    square = _square(g, tangents)
    along = g.op("Sqrt", g.op("Relu", g.op("Sub", g.const(1.0), square)))
    scale = g.op("Reciprocal", g.op("Sqrt", g.op("Max", square, g.const(1.0))))
    tangents = g.op("Mul", tangents, scale)
    if curvature == 0:
        return g.concat(tangents, g.op("Neg", along))
    normal = g.op("Mul", position, g.const(curvature))
    s2 = g.op("Relu", g.op("Sub", g.const(1.0), _square(g, normal)))
    s = g.op("Sqrt", s2)
    (a, b), (cx, cy) = g.split(tangents, [1, 1]), g.split(normal, [1, 1])
    length2 = g.op("Add", s2, g.op("Mul", cx, cx))
    inverse = g.op("Reciprocal", g.op("Sqrt", g.op("Max", length2, g.const(1e-30))))
    # a ex + b ey + along n, with ex = (s, 0, cx) / l and ey = (-cx cy, l^2, s cy) / l.
    a, b = g.op("Mul", a, inverse), g.op("Mul", b, inverse)
    mixed = g.op("Sub", g.op("Mul", a, s), g.op("Mul", g.op("Mul", b, cx), cy))
    x = g.op("Add", mixed, g.op("Mul", along, cx))
    y = g.op("Add", g.op("Mul", b, length2), g.op("Mul", along, cy))
    turned = g.op("Add", g.op("Mul", a, cx), g.op("Mul", g.op("Mul", b, cy), s))
    return g.concat(x, y, g.op("Sub", turned, g.op("Mul", along, s)))


def _meridian(g: Graph, core: Meridian, field: Field, vector_scale: Array, gate_scale: float) -> CoreRows:
    """A ray-transfer function: turned into its meridian, mapped, turned back; see `rtf.Meridian`."""
    rho = _square(g, field.p)
    off = g.op("Greater", rho, g.const(0.0))
    radius = g.op("Sqrt", rho)
    y = g.split(g.op("Div", field.p, g.op("Where", off, radius, g.const(1.0))), [1, 1])
    y[1] = g.op("Where", off, y[1], g.const(1.0))  # on the axis: the y axis itself
    slope = g.op("Mul", field.u, g.const(core.slope))
    length = g.op("Reciprocal", g.op("Sqrt", g.op("Add", _square(g, slope), g.const(1.0))))
    first = [radius, g.op("Mul", g.concat(*_turn(g, slope, y)), length)]
    if field.dispersive:
        first.append(g.affine(field.weight[-1:], field.squares, field.bias[-1:]))
    weight = core.outputs.numpy().astype(np.float64).copy()
    weight[:2] *= vector_scale[0]
    exponents, weight = without_constants(core.exponents, weight, list(range(3 + field.dispersive)))
    position, direction, transmittance = g.split(add_polynomial(g, g.concat(*first), exponents, weight), [2, 3, 1])
    square = g.op("MatMul", g.const([[1.0, 1.0, 1.0]]), g.op("Mul", direction, direction))
    unit = g.op("Mul", direction, g.op("Reciprocal", g.op("Sqrt", square)))
    turned, dz = g.split(unit, [2, 1])
    unit = g.concat(_turn_back(g, turned, y), g.op("Neg", dz))
    crossing = g.op("Add", g.op("Mul", field.p, g.const(core.film)), g.op("Mul", field.u, g.const(core.pupil)))
    gate = _ellipse(g, core, radius, _turn(g, crossing, y), gate_scale)
    position = _turn_back(g, position, y)
    nothing = g.op("Mul", position, g.const(0.0))
    return CoreRows(position, position, nothing, transmittance, [gate], unit)


def _turn(g: Graph, v: str, y: list[str]) -> tuple[str, str]:
    a, b = g.split(v, [1, 1])
    across = g.op("Sub", g.op("Mul", a, y[1]), g.op("Mul", b, y[0]))
    return across, g.op("Add", g.op("Mul", a, y[0]), g.op("Mul", b, y[1]))


def _turn_back(g: Graph, v: str, y: list[str]) -> str:
    a, b = g.split(v, [1, 1])
    first = g.op("Add", g.op("Mul", a, y[1]), g.op("Mul", b, y[0]))
    return g.concat(first, g.op("Sub", g.op("Mul", b, y[1]), g.op("Mul", a, y[0])))


def _ellipse(g: Graph, core: Meridian, radius: str, crossing: tuple[str, str], gate_scale: float) -> str:
    """gate_scale times the test of the elliptic pass function, [1, N]."""
    base, bends = (t.numpy().astype(np.float64) for t in core.hinges())
    knots = core.knots[:-1].numpy().astype(np.float64)
    hinges = g.op("Relu", g.affine(np.ones((len(knots), 1)), radius, -knots))
    across, along, centre = g.split(g.affine(bends, hinges, base), [1, 1, 1])
    a, b = g.op("Div", crossing[0], across), g.op("Div", g.op("Sub", crossing[1], centre), along)
    square = g.op("Add", g.op("Mul", a, a), g.op("Mul", b, b))
    return g.op("Mul", g.op("Sub", square, g.const(1.0)), g.const(gate_scale))


def _averaged(g: Graph, core: Averaged, field: Field, vector_scale: Array, gate_scale: float) -> CoreRows:
    """Every network for every ray, and a choice of the ring's mean by rho."""
    first = [field.p, field.u]
    if field.dispersive:
        first.append(g.affine(field.weight[-1:], field.squares, field.bias[-1:]))
    inputs, rho = g.concat(*first), g.affine(field.weight[:1], field.squares, field.bias[:1])
    out = _ring(g, core.networks[0], inputs, 4 + field.dispersive)
    for edge, ring in zip(core.edges, core.networks[1:], strict=True):
        out = g.op("Where", g.op("Greater", rho, g.const(edge)), _ring(g, ring, inputs, 4 + field.dispersive), out)
    position, transmittance, direction, flag = g.split(out, [2, 1, 3, 1])
    position = g.op("Mul", position, g.const(vector_scale[0]))
    square = g.op("MatMul", g.const([[1.0, 1.0, 1.0]]), g.op("Mul", direction, direction))
    unit = g.op("Mul", direction, g.op("Reciprocal", g.op("Sqrt", square)))
    gate = g.op("Mul", g.op("Sub", g.const(0.5), flag), g.const(gate_scale))
    return CoreRows(position, position, g.op("Mul", position, g.const(0.0)), transmittance, [gate], unit)


def _ring(g: Graph, networks: tuple[Layers, ...], inputs: str, count: int) -> str:
    """[7, N] mean of networks on the first `count` inputs."""
    total = ""
    for layers in networks:
        h = inputs
        for k, (weight, bias) in enumerate(layers):
            w, b = (t.detach().numpy().astype(np.float64) for t in (weight, bias))
            if k == len(layers) - 1:
                h = g.affine(w / len(networks), h, b / len(networks))
            else:
                h = g.op("Relu", g.affine(w if k else w[:, :count], h, b))
        total = g.op("Add", total, h) if total else h
    return total


_WRITERS: dict[type, Callable[..., CoreRows]] = {
    OuterPupil: _outer_pupil,
    Cells: _cells,
    Meridian: _meridian,
    Averaged: _averaged,
}
