"""Programs of float steps: put into another order, and their own functions, as C too."""

from __future__ import annotations

import ctypes
from pathlib import Path

import numpy as np
import pytest

from neurolens.base.errors import InputError
from neurolens.graph.c import write_c
from neurolens.graph.compiler import compile_c
from neurolens.graph.program import Program

X, Y = (v.ravel() for v in np.meshgrid(np.linspace(0.3, 2.0, 9), np.linspace(0.35, 1.9, 8)))


def program() -> Program:
    """Every kind of step."""
    p = Program()
    x, y = p.input("x"), p.input("y")
    p.outputs = {
        "sum": -(x + y) - y * 3.0,
        "ratio": p.fma(x, y, p.op("sqrt", x * y)) / (x + 1.0),
        "choice": p.select(x, y, x * x, y * 5.0),
        "largest": p.op("max", x * 2.0, p.op("min", y, x)),
        "held": p.op("clamp", x - y, 0.5) * y,
        "tanh": p.tanh(x * y),
        "constant": p.literal(4.0),
    }
    return p


def test_another_order_is_the_same_program() -> None:
    """Equal to the bit, and every step after those that it takes."""
    values, ordered = program().evaluate({"x": X, "y": Y}), program().in_order_of_need()
    found = ordered.evaluate({"x": X, "y": Y})
    assert all(np.array_equal(found[name], value) for name, value in values.items())
    assert ordered.count() == program().count()
    for k, step in enumerate(ordered.steps):
        assert all(a < k for a in step.arguments if isinstance(a, int))


def test_clamp_and_tanh_of_any_float_as_c_and_by_steps(tmp_path: Path) -> None:
    p = Program()
    x = p.input("x")
    p.outputs = {"held": p.op("clamp", x, 2.5), "tanh": p.tanh(x), "status": p.literal(0.0)}
    some = np.float32([0, 1e-40, 1e-20, 2.4999998, 2.5, 2.5000002, 9.02, 30, 3e38, np.inf, np.nan])
    given = np.concatenate([some, -some, np.linspace(-12, 12, 4001, dtype=np.float32)])
    wanted = p.evaluate({"x": given})
    number = ~np.isnan(given)
    np.testing.assert_array_equal(wanted["held"][number], np.clip(given[number], -2.5, 2.5))
    np.testing.assert_allclose(wanted["tanh"][number], np.tanh(given[number].astype(float)), rtol=5e-7, atol=0)
    assert np.array_equal(np.abs(wanted["held"][~number]), [2.5, 2.5])
    try:
        compile_c(write_c(p, "f", []) + _CALL, tmp_path / "f.so")
    except InputError as reason:
        pytest.skip(f"nothing is compiled here: {reason}")
    held, tanh = np.empty_like(given), np.empty_like(given)
    call = ctypes.CDLL(str(tmp_path / "f.so")).call
    call(ctypes.c_size_t(given.size), *(ctypes.c_void_p(a.ctypes.data) for a in (given, held, tanh)))
    assert np.array_equal(held[number], wanted["held"][number]) and np.array_equal(np.abs(held[~number]), [2.5, 2.5])
    np.testing.assert_allclose(tanh, wanted["tanh"], rtol=3e-7, atol=0)


_CALL = """
void call(size_t n, const float *x, float *held, float *tanh_x)
{ for (size_t i = 0; i < n; i++) { const f_ray r = f(x[i]); held[i] = r.held; tanh_x[i] = r.tanh; } }
"""


def test_clamp_has_a_number_above_0() -> None:
    p = Program()
    for limit in (p.input("y"), 0.0, -2.0):
        with pytest.raises(ValueError, match="above 0"):
            p.op("clamp", p.input("x"), limit)
