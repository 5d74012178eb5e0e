"""Low-order derivatives against programs whose derivatives are known."""

from __future__ import annotations

import numpy as np
import pytest

from neurolens.graph.loworder import WORST, with_low_order_derivatives
from neurolens.graph.program import RAY, SCENE_RAY, STATUS, WAVELENGTH, Program, derivative

COUNT = 2000


def samples(count: int = COUNT, seed: int = 0) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(seed)
    ray = {name: rng.uniform(-10, 10, count).astype(np.float32) for name in RAY}
    return ray | {WAVELENGTH: rng.uniform(400, 700, count).astype(np.float32)}


def lens(bend: float = 0.0, lost_below_mm: float = -99.0) -> Program:
    """x = fx px^2 / 100 + fx v, dx = fx + bend (fx / (fx + 10.5)), y and dy linear, the rest constant."""
    p = Program()
    fx, fy, px, _ = (p.input(name) for name in RAY)
    v = p.literal(1000.0) / p.input(WAVELENGTH)
    strong = fx * bend / (fx + 10.5) if bend else p.literal(0.0)
    outputs = (fx * px * px * 0.01 + fx * (v * v), fy * 3.0, p.literal(0.0), fx + strong, fy - fx, p.literal(-1.0))
    p.outputs = dict(zip(SCENE_RAY, outputs, strict=True))
    p.outputs[STATUS] = p.select(lost_below_mm, fx, 0.0, 5.0)
    return p


def test_a_lens_of_low_order_is_met() -> None:
    found = with_low_order_derivatives(lens(), samples())
    assert found is not None and found.error < 1e-5
    new = samples(seed=1)
    values = found.program.evaluate(new)
    v = (1000 / new[WAVELENGTH].astype(float)) ** 2
    np.testing.assert_allclose(values[derivative("x_mm", RAY[0])], new[RAY[2]] ** 2 * 0.01 + v, rtol=2e-5)
    np.testing.assert_allclose(values[derivative("dy", RAY[0])], -1, rtol=1e-5)
    np.testing.assert_allclose(values[derivative("y_mm", RAY[1])], 3, rtol=1e-5)
    for constant in ("z_mm", "dz"):
        assert not np.any(values[derivative(constant, RAY[0])])
    np.testing.assert_array_equal(values["x_mm"], lens().evaluate(new)["x_mm"])
    # One constant or product each, three of x by fx; a greedy search may take one too many.
    assert found.terms <= 8


@pytest.mark.parametrize("nm", [403.0, 505.0, 550.0, 587.5618, 699.0])
def test_light_of_one_wavelength(nm: float) -> None:
    """Its variable is a constant to rounding, and must not pass for another."""
    given = {name: values for name, values in samples().items() if name != WAVELENGTH}
    for count in (1500, 1777, COUNT):
        some = {name: values[:count] for name, values in given.items()}
        some[WAVELENGTH] = np.full(count, nm, np.float32)
        found = with_low_order_derivatives(lens(), some)
        assert found is not None and found.error < 1e-5
        values = found.program.evaluate(some)
        wanted = some[RAY[2]] ** 2 * 0.01 + (1000 / nm) ** 2
        np.testing.assert_allclose(values[derivative("x_mm", RAY[0])], wanted, rtol=2e-5)
        np.testing.assert_allclose(values[derivative("dx", RAY[0])], 1, rtol=1e-5)


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
