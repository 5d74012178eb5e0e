"""Operators of graphs: derivatives against central differences, one rule each; torch and C against numpy; Newton."""

import ctypes
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import onnx
import onnxruntime
import pytest
import torch

from neurolens.base.errors import InputError
from neurolens.graph.c import write_blocks, write_c
from neurolens.graph.compiler import compile_c
from neurolens.graph.derive import derivative, determinant, limited_newton, solve, with_derivatives
from neurolens.graph.interpret import evaluate
from neurolens.graph.ir import Graph, Value
from neurolens.graph.onnx import write_onnx
from neurolens.graph.program import row_names
from neurolens.graph.scalars import lower
from neurolens.graph.shading import write_glsl

Array = np.ndarray
RNG = np.random.default_rng(0)
W, CHANGE = RNG.normal(size=(2, 4, 3))
EXPONENTS = np.array([[0, 0, 0], [1, 0, 0], [2, 1, 0], [0, 3, 1], [0, 0, 2]])
COEFFICIENTS = RNG.normal(size=(2, len(EXPONENTS)))
FORMS = [((0, 0), (1, 1)), ((0, 2), (1, 1), (2, 1)), ((1, 2),)]

# Of x (3 rows, from 0.3 to 1.4, no two of a ray close), y (3 rows, likewise), and s of the call.
CASES: dict[str, Callable[[Graph, Value, Value, Value], Value]] = {
    "take": lambda g, x, y, s: x[[2, 0, 0]] * y,
    "take of whole parts": lambda g, x, y, s: (
        g.concat(x[1], y * y, x, s)[1:7] * g.concat(x, y)[2:5][[0, 1, 2, 2, 1, 0]]
    ),
    "concat": lambda g, x, y, s: g.concat(x[1], s, x * y),
    "affine": lambda g, x, y, s: g.affine(W, x * x, W[:, 0]),
    "affine of an input": lambda g, x, y, s: g.affine(W, x, W[:, 0]),
    "affine with a part that follows the call": lambda g, x, y, s: g.affine(W, x * y, moving=(s, CHANGE)),
    "affine of an input that follows the call": lambda g, x, y, s: g.affine(W, x, moving=(s * s, CHANGE)),
    "affine and added rows": lambda g, x, y, s: g.affine(W, y, added=g.affine(CHANGE, x * x)),
    "quadratic": lambda g, x, y, s: g.quadratic(x * y, FORMS, [1.0, 2.0, 3.0]),
    "quadratic of an input": lambda g, x, y, s: g.quadratic(x, FORMS),
    "quadratic with numbers": lambda g, x, y, s: (
        0.5 * (3.0 - g.quadratic(x, FORMS) * [1.0, 2.0, 3.0]) - 0.25 + g.square(x)
    ),
    "quadratic of what follows the call": lambda g, x, y, s: g.quadratic(g.affine(W, x, moving=(s, CHANGE)), FORMS),
    "polynomial": lambda g, x, y, s: g.polynomial(EXPONENTS, COEFFICIENTS, x * y),
    "series": lambda g, x, y, s: g.series(x * y, [1.0, -2.0, 0.5, 0.25]),
    "series of one": lambda g, x, y, s: g.series(x, [1.0, -2.0]),
    "series of a constant": lambda g, x, y, s: g.series(x * y, [0.75]) + x,
    "add": lambda g, x, y, s: x + y * x,
    "sub": lambda g, x, y, s: s - x * y,
    "mul": lambda g, x, y, s: x * y * s,
    "square": lambda g, x, y, s: x * x,
    "div": lambda g, x, y, s: x / (y + s),
    "neg": lambda g, x, y, s: -(x * y),
    "sqrt": lambda g, x, y, s: (x * y).sqrt(),
    "tanh": lambda g, x, y, s: (x - y).tanh(),
    "abs": lambda g, x, y, s: (x - y).abs(),
    "max": lambda g, x, y, s: (x * x).maximum(y * y),
    "min": lambda g, x, y, s: (x * x).minimum(y * y),
    "clip": lambda g, x, y, s: (x * y).clip(0.4, 0.9),
    "floor": lambda g, x, y, s: x.floor() * y + x,
    "lookup": lambda g, x, y, s: g.lookup(g.table("t", 6), x[0] * 3.0, g.concat(x[1], y[0] * s)) * x,
    "lookup at two indices": lambda g, x, y, s: g.lookup(g.table("t", 6), x[[0, 2]] * 3.0, g.concat(x, y[0] * s)),
    "lookup in the graph's own table": lambda g, x, y, s: g.lookup(g.own_table(W), y[1] * 2.0, x[1]) * y,
    "select": lambda g, x, y, s: g.select(x <= y, x * x, y * s),
    "select of a select": lambda g, x, y, s: g.select(x <= y, g.select(y.between(0.5, 1.2), x * y, 3.0), 3.0),
    "select by several": lambda g, x, y, s: g.select((x <= y) & x.between(0.5, 1.2), x * y, 3.0),
    "constant": lambda g, x, y, s: g.constant([1.0, 2.0]) + s * 0.0,
}


def graph_of(name: str) -> Graph:
    g = Graph()
    g.outputs["out"] = CASES[name](g, g.input("x", 3), g.input("y", 3), g.input("s", per_call=True))
    return g


def inputs(count: int = 400) -> dict[str, Array]:
    """Numbers apart from those at which choices change."""
    x, y = np.random.default_rng(1).uniform(0.3, 1.4, (2, 3, 8 * count))
    edges = [np.abs(x - y), np.abs(x * x - y * y), *(np.abs(x * y - e) for e in (0.4, 0.9))]
    edges += [np.abs(x - e) for e in (0.5, 1.2, 1 / 3, 2 / 3, 1, 4 / 3)]
    far = (np.min(edges, axis=0) > 2e-3).all(0)
    table = np.random.default_rng(2).normal(size=(5, 6))
    return {"x": x[:, far][:, :count], "y": y[:, far][:, :count], "s": np.array([[0.7]]), "t": table}


@pytest.mark.parametrize("name", CASES)
def test_derivatives_are_those_of_central_differences(name: str) -> None:
    graph, given, step = graph_of(name), inputs(), 1e-5
    directions = [("x", 0), ("x", 2), ("y", 1), ("s", 0)]
    found = evaluate(with_derivatives(graph, ["out"], directions), given)
    value = evaluate(graph, given)["out"]
    np.testing.assert_allclose(found["out"] + 0 * value, value, rtol=1e-14, atol=0)
    for by, row in directions:
        move = np.zeros((given[by].shape[0], 1))
        move[row] = step
        ahead, behind = (evaluate(graph, given | {by: given[by] + k * move})["out"] for k in (1, -1))
        slope = found[derivative("out", row_names(by, len(move))[row])]
        np.testing.assert_allclose(slope + 0 * value, (ahead - behind) / (2 * step) + 0 * value, rtol=0, atol=2e-8)


@pytest.mark.parametrize("name", CASES)
def test_torch_and_single_steps_give_what_numpy_gives(name: str) -> None:
    """In float64 torch to the last bits, and its gradients; the program in float32."""
    graph, given = graph_of(name), inputs()
    wanted = evaluate(graph, given)["out"]
    tensors = {k: torch.from_numpy(v).requires_grad_() for k, v in given.items()}
    found = evaluate(graph, tensors)["out"]
    np.testing.assert_allclose(found.detach().numpy(), wanted, rtol=1e-13, atol=1e-14)
    if found.requires_grad and found.shape[1] > 1:
        (slope,) = torch.autograd.grad(found.sum(), tensors["x"], allow_unused=True)
        by = [evaluate(with_derivatives(graph, ["out"], [("x", k)]), given) for k in range(3)]
        rows = [(d[derivative("out", f"x_{k}")] + 0 * wanted).sum(0) for k, d in enumerate(by)]
        np.testing.assert_allclose(0 * np.stack(rows) if slope is None else slope, np.stack(rows), rtol=0, atol=1e-12)
    rays = {k: v for k, v in given.items() if k != "t"}
    steps = {name: row for k, v in rays.items() for name, row in zip(row_names(k, len(v)), v, strict=True)}
    rows = list(lower(graph).evaluate(steps | {"t": given["t"]}).values())
    for row, value in zip(rows, wanted, strict=True):
        np.testing.assert_allclose(row + 0 * value, value, rtol=0, atol=2e-6 * (1 + np.abs(value).max()))


@pytest.mark.parametrize("name", CASES)
def test_onnxruntime_gives_what_numpy_gives(name: str) -> None:
    """For all rays, and one; every node that is written has a use."""
    graph = graph_of(name)
    data = write_onnx(graph, {})
    session = onnxruntime.InferenceSession(data)
    for count in (400, 1):
        given = inputs(count)
        known = {v.name: np.float32(given[v.name] if v.name != "s" else given["s"][0]) for v in session.get_inputs()}
        found, wanted = session.run(["out"], known)[0], evaluate(graph, given)["out"]
        rows = found.reshape(len(wanted), -1)
        np.testing.assert_allclose(rows, wanted + 0 * rows, rtol=0, atol=4e-6 * (1 + np.abs(wanted).max()))
    nodes = onnx.load_from_string(data).graph.node
    assert {name for node in nodes for name in node.output} - {name for node in nodes for name in node.input} == {"out"}


def test_status_and_truths_of_any_float_in_every_reader(tmp_path: Path) -> None:
    """NaN fails a test; the first failure wins; there is no derivative of a status."""
    g = Graph()
    x, s = g.input("x", 2), g.input("s", per_call=True)
    first = g.first_failure([(x[0], g.constant(1.0)), (x[0] + x[1], s * s)], [9, 5])
    g.outputs["status"] = g.select(x[1].between(-3.0, 3.0), first, 1.0).whole()
    some = np.float32([-9, -0.5, 0, 1, 1.0000001, 2, 3, 3.0000002, np.inf, -np.inf, np.nan])
    pairs = np.stack([v.ravel() for v in np.meshgrid(some, some)])
    with np.errstate(invalid="ignore"):
        bounds, inside = np.abs(pairs[1]) <= 3, pairs[0] + pairs[1] <= 1
    wanted = np.where(bounds, np.where(pairs[0] <= 1, np.where(inside, 0, 5), 9), 1)
    given = {"x": pairs, "s": np.ones((1, 1), np.float32)}
    found = evaluate(g, given)["status"]
    assert found.dtype == np.int32 and np.array_equal(found[0], wanted) and len(np.unique(wanted)) == 4
    assert np.array_equal(evaluate(g, {k: torch.from_numpy(v) for k, v in given.items()})["status"][0], wanted)
    program = lower(g)
    steps = {"x_0": pairs[0], "x_1": pairs[1], "s": np.float32(1)}
    assert np.array_equal(program.evaluate(steps)["status"], wanted)
    moved = evaluate(with_derivatives(g, ["status"], [("x", 0)]), given)
    assert np.array_equal(moved["status"][0], wanted) and not np.any(moved[derivative("status", "x_0")])
    try:
        compile_c(write_c(program, "f", []) + _CALL, tmp_path / "f.so")
    except InputError as reason:
        pytest.skip(f"nothing is compiled here: {reason}")
    status = np.empty(pairs.shape[1], np.int32)
    columns = [np.ascontiguousarray(a) for a in (*pairs, np.ones(pairs.shape[1], np.float32))]
    arrays = (ctypes.c_void_p(a.ctypes.data) for a in (*columns, status))
    ctypes.CDLL(str(tmp_path / "f.so")).call(ctypes.c_size_t(status.size), *arrays)
    assert np.array_equal(status, wanted)


_CALL = """
void call(size_t n, const float *x, const float *y, const float *s, int *status)
{ for (size_t i = 0; i < n; i++) { const f_ray r = f(x[i], y[i], s[i]); status[i] = r.status; } }
"""


def test_lookups_of_any_float_stay_inside_the_table(tmp_path: Path) -> None:
    """Interpolation by weights in every reader, in loops of C and one ray at a time; NaN takes some cell."""
    g = Graph()
    x, y = g.input("x"), g.input("y")
    g.outputs["out"] = g.lookup(g.table("t", 10), x * 2.0, g.concat(g.constant(1.0), y))[[4, 1]] + x * 0.0
    g.outputs["status"] = (y <= 0.5).whole()
    table = np.random.default_rng(0).normal(size=(7, 10)).astype(np.float32)
    some = np.float32([0, 0.49, 0.5, 3.2, 3.49, 3.5, 1e9, -1e9, np.inf, -np.inf, np.nan])
    x = np.concatenate([some, np.random.default_rng(1).uniform(0, 3.5, 1000).astype(np.float32)])
    y = np.random.default_rng(2).uniform(0, 1, x.size).astype(np.float32)
    known = np.isfinite(x)
    with np.errstate(invalid="ignore"):
        cell = np.clip(np.nan_to_num(2 * x), 0, 6).astype(int)
    wanted = (table[cell, :5] + y[:, None] * table[cell, 5:]).T[[4, 1]]
    given = {"x": x[None], "y": y[None], "t": table}
    program = lower(g)
    with np.errstate(invalid="ignore"):
        steps = program.evaluate({"x": x, "y": y, "t": table})
    found = [
        evaluate(g, given)["out"],
        evaluate(g, {k: torch.from_numpy(v) for k, v in given.items()})["out"].numpy(),
        np.stack([steps["out_0"], steps["out_1"]]),
        onnxruntime.InferenceSession(write_onnx(g, {})).run(["out"], given)[0],
    ]
    try:
        compile_c(write_blocks(program, "f") + write_c(program, "g", []) + _LOOKUP_CALL, tmp_path / "f.so")
    except InputError as reason:
        assert not shutil.which("cc"), reason
    else:
        library, padded = ctypes.CDLL(str(tmp_path / "f.so")), np.zeros((7, 2, 8), np.float32)
        padded[..., :5] = table.reshape(7, 2, 5)
        for name, cells in (("f", padded), ("call", table)):
            out, status = np.empty((2, x.size), np.float32), np.empty(x.size, np.int32)
            ins, outs = (np.array([a.ctypes.data for a in arrays], np.uintp) for arrays in ((x, y), (*out,)))
            given_, table_, found_, status_ = (ctypes.c_void_p(a.ctypes.data) for a in (ins, cells, outs, status))
            count = ctypes.c_size_t(x.size)
            getattr(library, name)(count, given_, None, table_, len(cells), found_, status_)
            assert np.array_equal(status, y <= 0.5)
            found.append(out)
    assert write_glsl(program, "h", []).count("texelFetch(t, ivec2(") == 4
    for values in found:
        np.testing.assert_allclose(values[:, known], wanted[:, known], rtol=0, atol=1e-6)
        assert values.shape == (2, x.size)


_LOOKUP_CALL = """
void call(
    size_t n, const float *const *in, const float *none, const float *t, int cells, float *const *out, int *status)
{
    (void)none;
    for (size_t i = 0; i < n; i++) {
        const g_ray ray = g(in[0][i], in[1][i], t, cells);
        out[0][i] = ray.out_0; out[1][i] = ray.out_1; status[i] = ray.status;
    }
}
"""


@pytest.mark.parametrize("k", [2, 4])
def test_small_systems_are_solved(k: int) -> None:
    rng = np.random.default_rng(0)
    a, x = rng.normal(size=(k, k, 100)) + 3 * np.eye(k)[:, :, None], rng.normal(size=(k, 100))
    g = Graph()
    columns = [g.input(f"c{j}", k) for j in range(k)]
    g.outputs = {"x": solve(columns, g.input("b", k)), "det": determinant(columns)}
    out = evaluate(g, {"b": np.einsum("ijn,jn->in", a, x)} | {f"c{j}": a[:, j] for j in range(k)})
    np.testing.assert_allclose(out["x"], x, atol=1e-9)
    np.testing.assert_allclose(out["det"][0], np.linalg.det(np.moveaxis(a, -1, 0)), rtol=1e-9)


def test_steps_are_limited_and_singular_points_stay() -> None:
    """x^3 = wanted: from 0 the Jacobian gives no direction; elsewhere steps get no longer than the limit."""
    system = Graph()
    x = system.input("unknown", 2)
    system.outputs["residual"] = x * x * x - system.input("wanted", 2)
    wanted = np.array([[1.0, 1.0, np.nan], [1.0, 1.0, 0.0]])
    start = np.array([[0.0, 0.3, 0.5], [0.0, 0.3, 0.5]])
    found = []
    for steps in (1, 20):
        g = Graph()
        solved = limited_newton(system, {"wanted": g.input("wanted", 2)}, g.input("start", 2), steps, 0.1)
        g.outputs["x"] = solved.last
        found.append(evaluate(g, {"wanted": wanted, "start": start})["x"])
    np.testing.assert_allclose(np.hypot(*(found[0] - start)), [0.0, 0.1, 0.0], atol=1e-15)
    np.testing.assert_allclose(found[1][:, :2], [[0.0, 1.0], [0.0, 1.0]], atol=1e-12)
