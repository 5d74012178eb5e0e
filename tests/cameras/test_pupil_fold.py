"""Pupils in which the image of the stop folds."""

import math

import numpy as np
import pytest

from neurolens.cameras.blades import Blades
from neurolens.cameras.pupil_arcs import PupilArcs
from neurolens.cameras.pupil_fold import fold_margins
from neurolens.cameras.pupil_fold_fit import _numbers
from neurolens.graph.interpret import evaluate
from neurolens.graph.ir import Graph

RIM = 12.0  # mm from the axis


def fold(peak: float) -> np.ndarray:
    """Eight numbers of a stop's place that rises to about a peak within 6 mm of the axis, in the widest radii."""
    b, c, d, e = 0.1, -0.012, -0.08, -0.001
    x = np.linspace(-10, 10, 2001)
    a = peak - float(np.max((b + c * x) * x / (1 + (d + e * x) * x)))
    return np.array([a, b, c, d, e, 0.006, 1e-5, 2e-6])


def arcs(eight: np.ndarray) -> PupilArcs:
    """With a rim of this radius, seen from both sides."""
    numbers = np.zeros((3, 8, 1))
    numbers[0, :, 0], numbers[1:, :4, 0] = eight, ((0.0, RIM, 2 * RIM, -1.0), (-RIM, 0.0, 2 * RIM, -1.0))
    return PupilArcs(10.0, 10.0, (50.0, 5.0), 8.0, (4.0, 2.0), numbers, np.zeros((1, 5), np.int64), (0, 1, -1))


def sampled(graph: Graph, share: float, side: int, **more: float) -> dict[str, np.ndarray]:
    """Samples at a film point, `side` squared of them; `more` is of the call."""
    square = (np.mgrid[:side, :side].reshape(2, -1) + 0.5) / side
    film, nanometres = np.tile([[4.0], [-3.0]], side * side), np.full((1, side * side), 550.0)
    call = {k: np.array([[v]]) for k, v in {"film_z_mm": 50.0, "stop_radius_mm": 8.0 * share, **more}.items()}
    return evaluate(graph, {"film_mm": film, "square": square, "wavelength_nm": nanometres, **call})


def margins(peak: float, pupil: np.ndarray, share: float) -> np.ndarray:
    return fold_margins(np.repeat(fold(peak)[:, None], pupil.shape[1], 1), *pupil, np.full(pupil.shape[1], share))[0]


@pytest.mark.parametrize("share", [1.0, 0.5, 0.2])
@pytest.mark.parametrize("peak", [2.0, 0.55, 0.5, 0.3, 0.1, -0.1, -0.3])
def test_samples_fill_what_a_fold_leaves_open(peak: float, share: float) -> None:
    """The stop's disc rises past the fold, touches it, or has it inside; where light has two parts both are met."""
    found = sampled(arcs(fold(peak)).graph, share, 320)
    turned = (found["pupil_mm"][0] + 1j * found["pupil_mm"][1]) * (0.8 + 0.6j)
    box = np.stack(np.meshgrid((np.arange(700) + 0.5) / 25 - 14, (np.arange(375) + 0.5) / 25)).reshape(2, -1)
    lit = (margins(peak, box, share) >= 0) & (np.hypot(*box) <= RIM)
    wanted, area = 2 * lit.sum() / 25**2, found["area_mm2"][0]
    inside = area > 0
    assert area[inside].sum() / area.size == pytest.approx(wanted, rel=0.006, abs=0.05)
    if not wanted:
        return
    pupil = np.stack([turned.real, turned.imag])[:, inside]
    assert margins(peak, pupil, share).min() > -1e-4
    assert np.hypot(*pupil).max() < RIM * 1.0001
    along, aside = found["at_stop"][:, inside]
    assert np.hypot(along, aside).max() < 1.0001


@pytest.mark.parametrize("share", [1.0, 0.7, 0.5, 0.4])
def test_ends_are_those_of_the_fold_where_the_stop_is_met_again_beyond_the_pole(share: float) -> None:
    """No sample is lost there, and ways through the stop are not taken for straight ones: blades draw nothing."""
    deep = arcs(np.array([-0.373, 0.0334, -0.0057, -0.0671, -0.0089, 0.006, 1e-5, 2e-6]))
    found = sampled(deep.graph, share, 40)
    assert (found["area_mm2"] > 0).all()
    corner = {f"{k}_{f.__name__}": float(f(math.pi / 6)) for k in ("half", "edge") for f in (math.cos, math.sin)}
    with_blades = sampled(deep.sampler(Blades), share, 40, count=6.0, roundness=0.0, **corner)
    for name in ("pupil_mm", "area_mm2"):
        np.testing.assert_array_equal(with_blades[name], found[name])


def test_slopes_of_margins_are_those_of_differences() -> None:
    rng, numbers = np.random.default_rng(4), fold(0.3)
    x, y, size = rng.uniform(-8, 6, 50), rng.uniform(-5, 5, 50), rng.uniform(0.2, 1, 50)
    within, slopes, scale = fold_margins(np.repeat(numbers[:, None], 50, 1), x, y, size)
    for k, slope in enumerate(slopes):
        changed = numbers.copy()
        changed[k] += (step := 1e-6 * (1 + abs(numbers[k])))
        after = fold_margins(np.repeat(changed[:, None], 50, 1), x, y, size)[0]
        assert slope is not None
        np.testing.assert_allclose((after - within) / step, slope / scale, rtol=1e-3, atol=1e-5 * np.abs(slope).max())


def test_numbers_are_found_of_rays_upright_or_upside_down() -> None:
    rng, wanted = np.random.default_rng(5), fold(0.3)
    x, y = pupil = np.stack([rng.uniform(-8, 5, 4000), rng.uniform(-3, 3, 4000)])
    a, b, c, d, e, f, g, h = wanted
    along, wide = (a + (b + c * x) * x) / (1 + (d + e * x) * x), np.sqrt(f + (g + h * x) * x)
    for side in (1.0, -1.0):
        found = _numbers(np.ones((1, x.size)), np.ones(1, bool), pupil, side * np.stack([along, y * wide]))
        np.testing.assert_allclose(found[:, 0], wanted, rtol=0.01, atol=1e-7)
