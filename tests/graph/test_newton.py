"""Small systems and Newton's steps in graphs."""

from __future__ import annotations

import numpy as np
import pytest

from neurolens.graph.interpret import evaluate
from neurolens.graph.ir import Graph
from neurolens.graph.newton import determinant, limited_newton, solve


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
