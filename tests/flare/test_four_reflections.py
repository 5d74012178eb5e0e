"""Ghosts of four reflections against the exact path by path, a plate by hand, and the books of photons."""

import math
from dataclasses import replace

import numpy as np
import pytest

from neurolens.base.errors import InputError
from neurolens.flare import ghosts
from neurolens.flare.ghosts import Four, GhostTracer, Pair, coated, four_reflections, ghost_pairs
from neurolens.flare.layers import FlareSettings, flare_layers
from neurolens.flare.lights import Light, light_rays
from neurolens.flare.picture import LEFT, SOME, Raster, axis_irradiance, ghost_layout, ghost_table, with_four
from tests.flare.test_ghosts import exact, lens_of, plate


def test_a_plate_by_hand() -> None:
    lens, angle = plate(40.0), math.radians(10)
    (only,) = four_reflections(lens).tolist()
    tracer = GhostTracer(lens, [Four(*only)])
    assert tracer.pairs[0] == (1, 0, 1, 0) and tracer.pairs[0].name == "g01-00-01-00"
    ray = np.array([[0.0, 0, -1, math.sin(angle), 0, math.cos(angle)]]).T
    found = tracer.trace(ray, 550.0)
    inside, cos_t = math.tan(math.asin(math.sin(angle) / 1.5)), math.cos(math.asin(math.sin(angle) / 1.5))
    assert found.film_xy_mm[0, 0, 0] == pytest.approx(17 * math.tan(angle) + 20 * inside, abs=1e-5)
    r_s = ((math.cos(angle) - 1.5 * cos_t) / (math.cos(angle) + 1.5 * cos_t)) ** 2
    r_p = ((1.5 * math.cos(angle) - cos_t) / (1.5 * math.cos(angle) + cos_t)) ** 2
    r = (r_s + r_p) / 2
    assert found.power[0, 0] == pytest.approx(r**4 * (1 - r) ** 2, rel=2e-6)


def test_compiled_is_exact() -> None:
    """The strongest, and some of all: each like the float64 trace of its own path."""
    lens = coated(lens_of("laikin_double_gauss_50"), "single-layer")
    rays, _ = light_rays(lens, Light(7.0, -4.0), 0, 700)
    pairs, fours = GhostTracer(lens), four_reflections(lens)
    sums = pairs.sums(pairs.start(rays), 480.0, fours).sums
    chosen = [*np.argsort(-sums[:, 0])[:6], *range(0, len(fours), len(fours) // 5)]
    tracer = GhostTracer(lens, [Pair(0, 1), *(Four(*fours[k].tolist()) for k in dict.fromkeys(chosen))])
    found, arrived = tracer.trace(rays, 480.0), 0
    for way, (x, y, power, worst) in zip(tracer.pairs, found.rows, strict=True):
        place, expected, passed = exact(lens, rays, way, 480.0)
        both = (worst <= 1) & passed
        assert np.all(((worst <= 1) == passed) | (np.abs(worst - 1) < 1e-3))
        near = both & (np.hypot(*place) < 50)
        off = np.hypot(x[near] - place[0][near], y[near] - place[1][near])
        assert off.max(initial=0.0) < 2e-2 and (not near.any() or np.median(off) < 2e-3)
        np.testing.assert_allclose(power[both], expected[both], rtol=2e-3, atol=1e-12)
        arrived += int(both.sum())
    assert arrived > 300
    # The same way by way and summed.
    of_rays = found.power.sum(1, dtype=np.float64)
    rows = np.array([way.reflections for way in tracer.pairs[1:]], np.int32)
    np.testing.assert_allclose(tracer.sums(tracer.start(rays), 480.0, rows).sums[:, 0], of_rays[1:], rtol=1e-6)
    np.testing.assert_allclose(tracer.sums(tracer.start(rays), 480.0).sums[:, 0], of_rays, rtol=1e-6)


def test_what_is_dropped_is_bounded() -> None:
    lens = lens_of("laikin_double_gauss_50")
    rays, _ = light_rays(lens, Light(15.0, 8.0), 0, 700)  # a block, and part of one
    tracer, fours = GhostTracer(lens), four_reflections(lens)
    start = tracer.start(rays)
    whole = tracer.sums(start, 550.0, fours)
    assert whole.dropped == 0
    for least in (1e-4, 1e-7, 1e-9):
        some = tracer.sums(start, 550.0, fours, least=least)
        missing = whole.sums[:, 0] - some.sums[:, 0]
        assert missing.min() > -1e-12 and 0 < missing.sum() <= some.dropped
    assert missing.sum() < 1e-3 * whole.sums[:, 0].sum()


def test_the_strongest_are_chosen() -> None:
    lens, light = lens_of("brendel_tessar_100"), Light(15.0, 8.0)
    found = with_four(lens, [light])
    assert found.ways[: len(ghost_pairs(lens))] == ghost_pairs(lens) and 0 < found.left <= LEFT
    assert found.fours == len(four_reflections(lens)) > len(found.ways) - len(ghost_pairs(lens)) >= SOME
    rows = ghost_table(GhostTracer(lens, found.ways), light, 550.0)
    all_of = GhostTracer(lens, [Four(*row) for row in four_reflections(lens).tolist()])
    often = sum(ghost.energy for ghost in rows if len(ghost.pair.reflections) > 2)
    whole = sum(ghost.energy for ghost in ghost_table(all_of, light, 550.0))
    assert (1 - 3 * LEFT * sum(g.energy for g in rows) / whole) * whole < often <= whole * (1 + 1e-9)
    four = next(ghost.pair for ghost in rows if len(ghost.pair.reflections) > 2)
    assert four.name in ghost_layout(lens, four, light).rays[0].label


def test_a_picture_holds_their_light() -> None:
    """A film that holds every ghost of a plate: what four reflections add is their rays' power."""
    lens, raster, light = plate(40.0), Raster((90.0, 60.0), 90, 60), Light(5.0, 0.0, (1e6, 1e6, 1e6))
    settings = FlareSettings(wavelengths=1, threads=1)
    one, two = (
        flare_layers(lens, [light], raster, replace(settings, ghosts=ghosts, single=("g01-00",)))
        for ghosts in (None, GhostTracer(lens, with_four(lens, [light]).ways))
    )
    rays, area = light_rays(lens, light, 0, 1 << 14)
    power = GhostTracer(lens, [Four(1, 0, 1, 0)]).trace(rays, 550.0).power[0].mean(dtype=np.float64)
    expected = 1e6 * area * power / axis_irradiance(lens, 550.0)
    np.testing.assert_array_equal(one["g01-00"], two["g01-00"])
    assert not one["rest"].any()
    np.testing.assert_allclose(two["rest"][..., 1].sum(dtype=np.float64), expected, rtol=0.01)


def test_many_surfaces() -> None:
    """57 surfaces: two million ways, of which a stop leaves few."""
    lens = lens_of("panavision_anamorphic_zoom_21")
    tracer, fours = GhostTracer(lens, [Pair(0, 55), Pair(3, 4)]), four_reflections(lens)
    assert len(fours) > 1_900_000
    some = fours[(fours[:, 0] < 8) & (fours[:, 2] < 8)]
    rays, _ = light_rays(lens, Light(2.0, 1.0), 0, 64)
    found = tracer.sums(tracer.start(rays), 550.0, some)
    assert np.isfinite(found.sums).all() and found.sums[:, 0].min() >= 0


def test_refusals(monkeypatch: pytest.MonkeyPatch) -> None:
    for wrong in (Four(0, 1, 0, 1), Four(1, 0, 0, 1), Four(1, 0, 2, 0), Four(1, 0, 3, 0)):
        with pytest.raises(InputError, match="back and forward"):
            GhostTracer(plate(), [wrong])
    with pytest.raises(InputError, match="glare"):
        FlareSettings(ghosts=GhostTracer(plate(), [Four(1, 0, 1, 0)]), glare=100)
    monkeypatch.setattr(ghosts, "MOST_WAYS", 100)
    with pytest.raises(InputError, match="at most 100"):
        four_reflections(lens_of("brendel_tessar_100"))
