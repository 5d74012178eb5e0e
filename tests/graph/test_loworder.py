"""Low-order derivatives against graphs whose derivatives are known."""

from __future__ import annotations

import numpy as np
import pytest

from neurolens.base import status as st
from neurolens.graph.derive import derivative
from neurolens.graph.interpret import evaluate
from neurolens.graph.ir import Graph
from neurolens.graph.loworder import WORST, with_low_order_derivatives
from neurolens.graph.program import RAY
from neurolens.graph.scalars import lower

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
