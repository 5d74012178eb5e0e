"""Light transport against closed forms: furnaces, direct light, two ways to the same mean."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from render_helpers import FLOOR, MATERIALS, WHITE, radiance, world


def box_of_lights(half: float, emission: float) -> list[dict[str, Any]]:
    """Six squares that look inwards."""
    quads = []
    for axis in range(3):
        for side in (-1, 1):
            u, v = np.roll(np.eye(3), axis, axis=1)[[1, 2]] * 2 * half
            corner = -(u + v) / 2 + side * half * np.roll(np.eye(3), axis, axis=1)[0]
            if side > 0:
                u, v = v, u
            quads.append({"corner_m": corner.tolist(), "edge_u_m": u.tolist(), "edge_v_m": v.tolist()})
    return [q | {"material": "grey", "emission": [emission] * 3} for q in quads]


def coat(roughness: float, specular: float = 0.04) -> dict[str, Any]:
    """A coat over white, or white metal."""
    base = 1 if specular < 1 else 0
    return {"kind": "glossy", "specular": [specular] * 3, "roughness": roughness, "reflectance": [base] * 3}


COATS = [coat(roughness, specular) for roughness in (0.05, 0.3, 1.0) for specular in (0.04, 1)]


@pytest.mark.parametrize("material", [*(MATERIALS[name] for name in ("white", "mirror", "glass")), *COATS])
def test_what_absorbs_nothing_vanishes_in_uniform_light(material: dict[str, Any]) -> None:
    made = world(
        materials=MATERIALS | {"m": material},
        environment=WHITE,
        spheres=[{"centre_m": [0, 0, 0], "radius_m": 1, "material": "m"}],
        boxes=[{"min_m": [0.5, -2, -2], "max_m": [2, 2, 2], "material": "white"}],
    )
    for height in (0, 0.2, 0.95):
        values = radiance(made, [0, 0.3, 5], [0, height, 0], samples=8192, max_depth=300)
        # The directions that a smooth normal sends below the surface are the only loss.
        assert abs(values.mean() - 1) < 5e-3 + 4 * values.std() / math.sqrt(8192)


def test_closed_box_of_glowing_walls_reaches_the_geometric_sum() -> None:
    made = world(materials=MATERIALS, quads=box_of_lights(1.0, 0.75))
    values = radiance(made, [0.2, 0.1, 0], [0.3, -1, 0.4], samples=8192, max_depth=40)
    assert values.mean() == pytest.approx(0.75 / (1 - 0.5), rel=0.01)


def test_a_closed_furnace_of_all_kinds_reaches_the_light_of_its_lamp() -> None:
    # Everything in a closed white room reflects all light, and a lamp of emission 1 fills a wall: after enough
    # reflections there is 1 everywhere, in the glass too, as all that is seen is the lamp.
    lamp = {"corner_m": [-1, 1, -1], "edge_u_m": [2, 0, 0], "edge_v_m": [0, 0, 2], "emission": [1, 1, 1]}
    made = world(
        {"position_m": [0, 0, 0.9]},
        materials=MATERIALS | {"coat": coat(0.3)},
        rooms=[{"min_m": [-1, -1, -1], "max_m": [1, 1.001, 1], "material": "white", "floor": "coat"}],
        quads=[lamp],
        spheres=[{"centre_m": [0, -0.4, 0], "radius_m": 0.5, "material": "glass"}],
    )
    values = radiance(made, [0.1, 0, 0.9], [0, -0.5, 0], samples=4096, max_depth=200)
    assert abs(values.mean() - 1) < 4 * values.std() / 64 + 5e-3


def test_variance_falls_as_one_over_the_number_of_samples() -> None:
    # Of means over 512 pixels that share nothing; stratified dimensions make it fall faster.
    lamp = {"centre_m": [0.8, 1.2, 0], "radius_m": 0.3, "emission": [5, 5, 5]}
    walls = {"min_m": [-2, 0, -2], "max_m": [2, 3, 2], "material": "grey"}
    made = world(materials=MATERIALS, rooms=[walls], spheres=[lamp])
    counts, variances = [8, 32, 128], []
    for samples in counts:
        value = radiance(made, [0, 1, 1.5], [0, 0.4, 0.7], samples=samples, max_depth=5, pixels=512)
        variances.append(value.reshape(512, samples).mean(axis=1).var())
    slope = np.polyfit(np.log(counts), np.log(variances), 1)[0]
    assert -1.6 < slope < -0.93


@pytest.mark.parametrize("thickness_m", [2e-4, 1e-3, 0.1])
def test_a_thin_pane_absorbs_as_much_as_its_thickness_says(thickness_m: float) -> None:
    # Index near 1: nothing is reflected. Half of the light is left after the thickness.
    glass = {"kind": "glass", "n_d": 1.0001, "transmittance": [0.5] * 3, "transmittance_depth_m": thickness_m}
    made = world(
        materials={"g": glass},
        boxes=[{"min_m": [-1, -1, -thickness_m], "max_m": [1, 1, 0], "material": "g"}],
        environment={"colour": [1, 1, 1]},
    )
    assert np.allclose(radiance(made, [0, 0, 1], [0, 0, 0], samples=64), 0.5, rtol=0.01)


@pytest.mark.parametrize("lanes", [1, 4])
def test_glass_absorbs_by_beer_and_lambert(lanes: int) -> None:
    glass = {"kind": "glass", "n_d": 1.5, "transmittance": [0.5, 0.5, 0.5], "transmittance_depth_m": 0.1}
    slab = {"min_m": [-9, -9, -0.3], "max_m": [9, 9, 0], "material": "glass"}
    made = world(lanes=lanes, materials={"glass": glass}, boxes=[slab], environment=WHITE)
    # At a slant: with R at each face and A the share that is left of a crossing, T + R of the whole slab.
    sin = 0.6
    inner = math.sqrt(1 - (sin / 1.5) ** 2)
    left = 0.5 ** (0.3 / inner / 0.1)
    s = ((0.8 - 1.5 * inner) / (0.8 + 1.5 * inner)) ** 2
    p = ((1.5 * 0.8 - inner) / (1.5 * 0.8 + inner)) ** 2
    r = 0.5 * (s + p)
    through = (1 - r) ** 2 * left / (1 - (r * left) ** 2)
    back = r + (1 - r) ** 2 * r * left**2 / (1 - (r * left) ** 2)
    values = radiance(made, [0, 0, 1], [sin, 0, 0.2], samples=16384, max_depth=40, lanes=lanes)
    assert np.allclose(values.reshape(lanes, -1).mean(axis=1), through + back, rtol=0.02)


def test_absorption_is_coloured_as_the_transmittance_says() -> None:
    tint = [0.9, 0.5, 0.2]
    tables = {
        "materials": {"glass": {"kind": "glass", "n_d": 1.0001, "transmittance": tint, "transmittance_depth_m": 0.2}},
        "boxes": [{"min_m": [-9, -9, -0.2], "max_m": [9, 9, 0], "material": "glass"}],
    }
    seen = radiance(world(environment=WHITE, **tables), [0, 0, 1], [0, 0, 0], samples=1024, max_depth=10)
    colour = radiance(world(environment={"colour": tint}), [0, 0, 1], [0, 0, 0], samples=1024)
    assert np.allclose(seen, colour, rtol=2e-3)


def test_a_measured_reflectance_is_what_is_reflected() -> None:
    spectrum = [[400, 0.1], [500, 0.7], [600, 0.2], [700, 1.0]]
    made = world(
        materials={"m": {"kind": "diffuse", "reflectance": "paint"}},
        reflectances={"paint": {"spectrum": spectrum}},
        planes=[FLOOR | {"material": "m"}],
        environment=WHITE,
    )
    values = radiance(made, [0, 1, 1], [0, 0, 0], samples=1024, max_depth=1)
    nm = 400 + 300 * (np.arange(1024) // 4 + 0.5) / 256
    assert np.allclose(values, np.interp(nm, *np.transpose(spectrum)), atol=3e-3)


def test_light_is_seen_in_a_mirror_and_through_glass() -> None:
    panel = {"corner_m": [-9, 5, -9], "edge_u_m": [18, 0, 0], "edge_v_m": [0, 0, 18], "emission": [2, 2, 2]}
    mirror = world(materials=MATERIALS, planes=[FLOOR | {"material": "mirror"}], quads=[panel])
    assert np.allclose(radiance(mirror, [0, 1, 3], [0, 0, 2], max_depth=1), 2)
    slab = {"min_m": [-9, 1, -9], "max_m": [9, 2, 9], "material": "glass"}
    glass = world(materials=MATERIALS, boxes=[slab], quads=[panel])
    straight = radiance(glass, [0, 0, 0], [0, 1, 0], samples=4096, max_depth=30)
    # Two faces with all their reflections in between let (1 - R) / (1 + R) pass.
    reflectance = (0.6 / 2.6) ** 2
    assert straight.mean() == pytest.approx(2 * (1 - reflectance) / (1 + reflectance), rel=0.01)


def test_a_room_is_seen_from_behind_its_walls() -> None:
    room = {"min_m": [-1, -1, -1], "max_m": [1, 1, 1], "material": "grey"}
    lamp = {"corner_m": [-0.5, 0.9, -0.5], "edge_u_m": [1, 0, 0], "edge_v_m": [0, 0, 1], "emission": [3, 3, 3]}
    made = world(materials=MATERIALS, rooms=[room], quads=[lamp])
    outside = radiance(made, [0, 0, 3], [0, -0.2, -1], samples=16384, max_depth=2)
    inside = radiance(made, [0, -0.1, 1], [0, -0.2, -1], samples=16384, max_depth=2)
    assert outside.mean() == pytest.approx(inside.mean(), rel=0.01) and inside.mean() > 0.1
