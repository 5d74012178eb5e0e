"""Programs of float steps in another order and as C; low-order derivatives of graphs whose derivatives are known."""

import ctypes
from pathlib import Path

import numpy as np
import pytest

from neurolens.base import status as st
from neurolens.base.errors import InputError
from neurolens.graph.c import ROWS, write_c
from neurolens.graph.compiler import compile_c, has_compiler
from neurolens.graph.derive import derivative
from neurolens.graph.interpret import evaluate
from neurolens.graph.ir import Graph
from neurolens.graph.loworder import WORST, with_low_order_derivatives
from neurolens.graph.program import RAY, Program
from neurolens.graph.scalars import lower


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


def test_a_program_that_waits_does_its_rays_in_parts(tmp_path: Path) -> None:
    """Each ray as the function of one ray has it, to the bit, at any count; nothing behind the last is written."""
    p = Program()
    x, y, s = p.input("x"), p.input("y"), p.input("s", per_call=True)
    value, status = x, p.literal(0.0)
    for k in range(20):
        value = p.op("sqrt", p.fma(value, value, y * (k + 1.0))) / (value + s * s)
        status = p.select(p.fma(value, 0.01, x), 0.2 * k, status, k + 1.0)
    p.outputs = {"value": value, "early": x * s, "same": s * 2.0, "given": y, "three": p.literal(3.0), "status": status}
    assert p.waits() and not program().waits()
    parts, free = p.in_parts(10), p.same_for_all()
    assert sorted(k for part in parts for k in part) == sorted(
        k for k in p.live() if k not in free and p.steps[k].kind != "input"
    )
    made = {*free, x.argument, y.argument}
    for k in (k for part in parts for k in part):
        assert {a for a in p.steps[k].arguments if isinstance(a, int)} <= made
        made.add(k)
    text = write_c(p, "f", [])
    assert "f_part_1(number, waiting" in text and "f_part_0" not in write_c(program(), "f", [])
    if not has_compiler():
        pytest.skip("there is no C compiler")
    compile_c(text + _PARTS_CALL, tmp_path / "f.so")
    call = ctypes.CDLL(str(tmp_path / "f.so")).call
    for count in (0, 1, ROWS - 1, ROWS, ROWS + 1, 3 * ROWS + 17):
        given = np.random.default_rng(1).uniform(0.1, 4.0, (2, count + 1)).astype(np.float32)
        given[0, : count // 9] = np.nan
        found = np.full((2, 6, count + 1), -7.0, np.float32)
        call(ctypes.c_size_t(count), ctypes.c_float(1.1), *(ctypes.c_void_p(a.ctypes.data) for a in (*given, *found)))
        many, one = found
        np.testing.assert_array_equal(many[:, :count], one[:, :count])
        np.testing.assert_array_equal(many[:, count], -7.0)
        wanted = p.evaluate({"x": given[0], "y": given[1], "s": np.float32(1.1)})
        for row, name in zip(one, p.outputs, strict=True):
            np.testing.assert_allclose(row[:count], np.broadcast_to(wanted[name], count + 1)[:count], rtol=1e-6)
    assert len(np.unique(one[5, :count])) > 4  # rays fail at many places


_PARTS_CALL = """
void call(size_t n, float s, const float *x, const float *y, float *many, float *one)
{
    const size_t m = n + 1;
    int status[1000];
    f_rays(n, x, y, s, many, many + m, many + 2 * m, many + 3 * m, many + 4 * m, status);
    for (size_t i = 0; i < n; i++) {
        const f_ray r = f(x[i], y[i], s);
        many[5 * m + i] = (float)status[i];
        one[i] = r.value, one[m + i] = r.early, one[2 * m + i] = r.same, one[3 * m + i] = r.given;
        one[4 * m + i] = r.three, one[5 * m + i] = (float)r.status;
    }
}
"""


def test_the_first_failure_is_found_in_any_order_of_codes() -> None:
    """Codes of surfaces fall along the ray and those of one surface rise; a guard in front may have any."""
    rng = np.random.default_rng(2)
    for codes in (
        [53, 54, 49, 50, 51, 45, *range(40, 20, -1)],
        [1, 13, 14, 9, 10, 5, *range(40, 20, -1)],
        [3, 2, 1],
        [1, 2, 3],
        [7],
        [4, 4, 2, 2],
        [5, 9, 7, 3],
    ):
        g = Graph()
        x = g.input("x", len(codes))
        g.outputs["status"] = g.first_failure([(x[k], g.constant(0.8)) for k in range(len(codes))], codes)
        rows = rng.uniform(0.0, 1.0, (len(codes), 400)).astype(np.float32)
        rows[rng.uniform(size=rows.shape) < 0.02] = np.nan
        failed = ~(rows <= np.float32(0.8))
        wanted = np.where(failed.any(0), np.array(codes)[failed.argmax(0)], 0)
        found = lower(g)
        assert ("max" in found.count()) is (len(codes) > 16)  # many tests wait for no last one
        given = {f"x_{k}" if len(codes) > 1 else "x": row for k, row in enumerate(rows)}
        np.testing.assert_array_equal(found.evaluate(given)["status"], wanted)


_CALL = """
void call(size_t n, const float *x, float *held, float *tanh_x)
{ for (size_t i = 0; i < n; i++) { const f_ray r = f(x[i]); held[i] = r.held; tanh_x[i] = r.tanh; } }
"""


def test_clamp_has_a_number_above_0() -> None:
    p = Program()
    for limit in (p.input("y"), 0.0, -2.0):
        with pytest.raises(ValueError, match="above 0"):
            p.op("clamp", p.input("x"), limit)


COUNT = 2000
BY_X, BY_Y = (derivative("scene_ray", by) for by in RAY[:2])


def samples(count: int = COUNT, seed: int = 0) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(seed)
    rays = np.concatenate([rng.uniform(-10, 10, (4, count)), rng.uniform(400, 700, (1, count))])
    return {"rays": rays.astype(np.float32)}


def lens(bend: float = 0.0, lost_below_mm: float = -99.0) -> Graph:
    """x = fx px^2 / 100 + fx v, dx = fx + bend (fx / (fx + 10.5)), y and dy linear, the rest constant."""
    g = Graph()
    rays = g.input("rays", 5)
    fx, fy, px, v = rays[0], rays[1], rays[2], 1000.0 / rays[4]
    strong = fx * bend / (fx + 10.5)
    rows = (fx * px * px * 0.01 + fx * (v * v), fy * 3.0, g.constant(0.0), fx + strong, fy - fx, g.constant(-1.0))
    g.outputs["scene_ray"] = g.concat(*rows)
    g.outputs["status"] = g.select(g.constant(lost_below_mm) <= fx, float(st.PASSED), float(st.OUTSIDE_DOMAIN)).whole()
    return g


def test_a_lens_of_low_order_is_met() -> None:
    found = with_low_order_derivatives(lens(), samples())
    assert found is not None and found.error < 1e-5
    new = samples(seed=1)
    values, rays = evaluate(found.graph, new), new["rays"]
    v = (1000 / rays[4].astype(float)) ** 2
    np.testing.assert_allclose(values[BY_X][0], rays[2] ** 2 * 0.01 + v, rtol=2e-5)
    np.testing.assert_allclose(values[BY_X][4] + 0 * v, -1, rtol=1e-5)
    np.testing.assert_allclose(values[BY_Y][1] + 0 * v, 3, rtol=1e-5)
    for constant in (2, 5):
        assert not np.any(values[BY_X][constant])
    np.testing.assert_array_equal(values["scene_ray"], evaluate(lens(), new)["scene_ray"])
    # One constant or product each, three of x by fx; a greedy search may take one too many.
    assert found.terms <= 8
    assert sum(lower(found.graph).count().values()) <= sum(lower(lens()).count().values()) + 8


@pytest.mark.parametrize("nm", [403.0, 505.0, 550.0, 587.5618, 699.0])
def test_light_of_one_wavelength(nm: float) -> None:
    """Its variable is a constant to rounding, and must not pass for another."""
    for count in (1500, 1777, COUNT):
        some = samples()["rays"][:, :count].copy()
        some[4] = nm
        found = with_low_order_derivatives(lens(), {"rays": some})
        assert found is not None and found.error < 1e-5
        values = evaluate(found.graph, {"rays": some})[BY_X]
        np.testing.assert_allclose(values[0], some[2] ** 2 * 0.01 + (1000 / nm) ** 2, rtol=2e-5)
        np.testing.assert_allclose(values[3], 1, rtol=1e-5)


def test_a_stronger_lens_says_its_error_or_is_refused() -> None:
    found = with_low_order_derivatives(lens(bend=0.02), samples())
    assert found is not None and 1e-4 < found.error < WORST
    assert with_low_order_derivatives(lens(bend=1.0), samples()) is None


@pytest.mark.parametrize("count", [0, 100])
def test_too_few_rays_are_no_fit(count: int) -> None:
    assert with_low_order_derivatives(lens(), samples(count)) is None


def test_rays_that_do_not_pass_are_no_part_of_the_fit() -> None:
    """Those below 2 mm are lost: what is left of the strong term is gentle."""
    half, whole = (with_low_order_derivatives(lens(1.0, low), samples(8000)) for low in (2.0, -99.0))
    assert whole is None and half is not None
