"""Light transport against closed forms and another renderer: lights, furnaces, absorption, the Cornell box."""

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from render_helpers import FLOOR, MATERIALS, WHITE, assert_aimed, on_floor, radiance, world

from neurolens.cameras.ideal import Pinhole
from neurolens.pictures.render.colour import SpectralRange
from neurolens.pictures.render.film import PixelGrid
from neurolens.pictures.render.integrator import Paths, trace
from neurolens.pictures.render.sampler import FILM, DirectionTable, Sampler, centres
from neurolens.pictures.render.scene import load_scene
from neurolens.pictures.render.world import World


@pytest.mark.parametrize(
    ("radius", "height", "aside"),
    [(0, 2.0, 0.0), (0, 1.0, 1.5), (0, 30.0, 40.0), (0.5, 2.0, 1.0), (0.01, 30.0, 40.0), (1e-3, 100.0, 0.0)],
)
def test_points_and_spheres_obey_the_inverse_square_law(radius: float, height: float, aside: float) -> None:
    at = [aside, height, 0]
    sphere = {"centre_m": at, "radius_m": radius, "emission": [7, 7, 7]}
    made = on_floor(**({"spheres": [sphere]} if radius else {"points": [{"position_m": at, "intensity": [3, 3, 3]}]}))
    values = radiance(made, [0, 1, 1], [0, 0, 0], samples=16384, max_depth=1)
    expected = 0.5 / math.pi * (7 * math.pi * radius**2 or 3) * height / math.hypot(height, aside) ** 3
    assert values.mean() == pytest.approx(expected, rel=5e-3) if radius else np.allclose(values, expected, rtol=3e-4)


@pytest.mark.parametrize("kind", ["points", "spheres"])
def test_the_shadow_of_a_ball_is_sharp_and_points_are_not_seen(kind: str) -> None:
    lamp = {"position_m": [0, 4, 0], "intensity": [9, 9, 9]}
    tiny = {"centre_m": [0, 4, 0], "radius_m": 0.01, "emission": [100, 100, 100]}
    ball = {"centre_m": [0, 2, 0], "radius_m": 0.5, "material": "grey"}
    lights = {"points": [lamp], "spheres": [ball]} if kind == "points" else {"spheres": [ball, tiny]}
    made = on_floor(**lights)
    edge, blur = 4 * math.tan(math.asin(0.25)), 0.01 if kind == "points" else 0.035
    assert not radiance(made, [0, 1, 3], [edge - blur, 0, 0], samples=256, max_depth=1).any()
    assert radiance(made, [0, 1, 3], [edge + blur, 0, 0], samples=256, max_depth=1).all()
    assert radiance(made, [0, 5, 0], [0, 4, 0.0], samples=64, max_depth=0).any() == (kind == "spheres")


def test_spot_falls_off_as_the_smoothstep_of_its_cosine() -> None:
    spot = {"position_m": [0, 2, 0], "look_at_m": [0, 0, 0], "intensity": [4, 4, 4], "inner_deg": 20, "outer_deg": 40}
    made = on_floor(spots=[spot])
    inner, outer = math.cos(math.radians(20)), math.cos(math.radians(40))
    for angle in (0.0, 19.0, 25.0, 30.0, 38.0, 41.0):
        cos = math.cos(math.radians(angle))
        t = min(max((cos - outer) / (inner - outer), 0), 1)
        expected = 0.5 / math.pi * 4 * t * t * (3 - 2 * t) * cos / (2 / cos) ** 2
        at = 2 * math.tan(math.radians(angle))
        values = radiance(made, [0, 1, 3], [at, 0, 0], samples=16, max_depth=1)
        assert np.allclose(values, expected, rtol=2e-3, atol=1e-6)


@pytest.mark.parametrize(("radius", "height"), [(0.5, 2.0), (3.0, 1.0)])
def test_disc_light_on_its_axis(radius: float, height: float) -> None:
    light = {"centre_m": [0, height, 0], "normal": [0, -1, 0], "radius_m": radius, "emission": [3, 3, 3]}
    made = on_floor(discs=[light])
    values = radiance(made, [0, 0.5, 1], [0, 0, 0], samples=16384, max_depth=1)
    # E = pi L sin^2 of the half angle that it fills.
    assert values.mean() == pytest.approx(0.5 * 3 * radius**2 / (radius**2 + height**2), rel=3e-3)
    above = radiance(made, [0, height + 1, 0.1], [0, height, 0.1], samples=16, max_depth=1)
    below = radiance(made, [0, height - 0.5, 0.1], [0, height, 0.1], samples=16, max_depth=1)
    assert not above.any() and np.allclose(below, 3)


def test_disc_reflects_and_ends_at_its_rim() -> None:
    disc = {"centre_m": [1, 0, -2], "normal": [0, 0, 1], "radius_m": 0.5, "material": "grey"}
    made = world(materials=MATERIALS, environment={"colour": [1, 1, 1]}, discs=[disc])
    for x, expected in ((1.0, 0.5), (1.49, 0.5), (1.51, 1.0), (0.49, 1.0)):
        values = radiance(made, [x, 0, 0], [x, 0, -2], samples=64, max_depth=1)
        assert np.allclose(values, expected, rtol=1e-3)


def test_direction_table_draws_what_it_says() -> None:
    random = np.random.default_rng(3)
    weights = random.random((8, 16)) + 0.1
    weights[2, 5], weights[6], weights[3, 2:9] = 30.0, 0.0, 0.0
    table = DirectionTable(weights, turn=0.7)
    square = random.random((2, 200_000), np.float32)
    direction, density = table.sample(square)
    assert np.allclose(np.sum(direction**2, axis=0), 1, atol=1e-5)
    # What is drawn has the density that is asked for, but for a few on the edges of cells.
    assert np.mean(np.isclose(table.pdf(direction), density, rtol=1e-4)) > 0.999 and density.min() > 0
    # The mean of 1 / density is the solid angle of all cells that weigh anything; of f / density, the integral of f.
    cosine = np.cos(np.linspace(0, np.pi, 9))
    solid = np.repeat((cosine[:-1] - cosine[1:])[:, None] * np.pi / 8, 16, axis=1)
    assert np.mean(1 / density) == pytest.approx(solid[weights > 0].sum(), rel=0.02)
    uniform = random.normal(size=(3, 400_000))
    uniform = (uniform / np.linalg.norm(uniform, axis=0)).astype(np.float32)
    assert 4 * np.pi * np.mean(table.pdf(uniform)) == pytest.approx(1, abs=0.03)
    assert centres(4, 8).shape == (3, 32)


@pytest.fixture(scope="module")
def panorama(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A dim gradient with a small bright window towards +x, and a red half towards -z on the left."""
    picture = np.full((32, 64, 3), 40, np.uint8)
    picture[:16] = 90
    picture[8:11, 46:50] = 255
    picture[:, :20, 1:] //= 3
    path = tmp_path_factory.mktemp("sky") / "panorama.png"
    Image.fromarray(picture).save(path)
    return path


@pytest.mark.parametrize("floor", ["grey", "plastic"])
def test_aiming_at_an_environment_changes_the_noise_and_not_the_mean(floor: str, panorama: Path) -> None:
    made = on_floor(
        environment={"file": str(panorama), "scale": 3.0, "rotate_y_deg": 30},
        planes=[FLOOR | {"material": floor}],
        spheres=[{"centre_m": [0.4, 0.3, 0], "radius_m": 0.3, "material": "plastic"}],
        quads=[{"corner_m": [-1, 1, -1], "edge_u_m": [0.5, 0, 0], "edge_v_m": [0, 0, 0.5], "emission": [1, 2, 3]}],
    )
    assert_aimed(made, [-0.2, 0, 0], 0.75)


def test_a_gradient_is_aimed_at_without_bias() -> None:
    around = {"zenith": [0.2, 0.4, 1.0], "horizon": [1.5, 1.2, 1.0], "ground": [0, 0, 0]}
    made = on_floor(environment=around)
    values = radiance(made, [0, 1, 3], [0, 0, 0], samples=16384, max_depth=1)
    # Irradiance of h + (z - h) cos over the upper half: pi (h + (z - h) 2 / 3), of each wavelength, so of their means.
    means = [radiance(made, [0, 1, 0], [0, y, 1], samples=4096, max_depth=0).mean() for y in (1.0, 1e9)]
    horizon, zenith = means
    assert values.mean() == pytest.approx(0.5 * (horizon + (zenith - horizon) * 2 / 3), rel=4e-3)


def test_an_environment_lies_where_it_is_said_to_lie(panorama: Path) -> None:
    turn = math.radians(30)
    for rotation, azimuth in ((0.0, (48 / 64 - 0.5) * 2 * math.pi), (30.0, (48 / 64 - 0.5) * 2 * math.pi - turn)):
        made = world(environment={"file": str(panorama), "rotate_y_deg": rotation})
        up = math.pi / 2 - 9.5 / 32 * math.pi
        window = [math.cos(up) * math.sin(azimuth), math.sin(up), -math.cos(up) * math.cos(azimuth)]
        assert np.allclose(radiance(made, [0, 0, 0], window, samples=64), 1, atol=1e-4)
        below = radiance(made, [0, 0, 0], [0, -1, 0.2], samples=64).mean()
        assert below < 0.1


def test_a_room_keeps_light_out_and_shines_by_what_is_inside(panorama: Path) -> None:
    room, far = {"min_m": [-1, -1, -1], "max_m": [1, 1, 1], "material": "grey"}, {"file": str(panorama)}
    inside, outside = ([{"position_m": [0, y, 0], "intensity": [1, 1, 1]}] for y in (0.9, 1.1))
    for lights in ({"points": inside}, {"points": outside}, {"environment": far}, {"environment": WHITE}):
        made = world(materials=MATERIALS, rooms=[room], **lights)
        values = radiance(made, [0, 0, 3], [0, -0.9, -0.9], samples=1024, max_depth=5)
        assert values.all() if lights == {"points": inside} else not values.any()


def test_square_light_over_a_floor() -> None:
    light = {"corner_m": [-0.5, 2, -0.5], "edge_u_m": [1, 0, 0], "edge_v_m": [0, 0, 1], "emission": [3, 3, 3]}
    made = on_floor(quads=[light])
    values = radiance(made, [0, 1, 4], [0, 0, 0], samples=16384, max_depth=1)
    # Form factor of a rectangle a x b at distance c over one corner, four of them around the point below the middle.
    x = y = 0.5 / 2.0
    part = x / math.hypot(1, x) * math.atan(y / math.hypot(1, x))
    factor = 4 * (part + y / math.hypot(1, y) * math.atan(x / math.hypot(1, y))) / (2 * math.pi)
    assert values.mean() == pytest.approx(0.5 * 3 * factor, rel=2e-3)


def test_back_of_a_square_light_is_dark() -> None:
    light = {"corner_m": [-0.5, 2, -0.5], "edge_u_m": [0, 0, 1], "edge_v_m": [1, 0, 0], "emission": [3, 3, 3]}
    made = on_floor(quads=[light])
    assert not radiance(made, [0, 1, 4], [0, 0, 0], max_depth=1).any()
    assert not radiance(made, [0, 1, 0.1], [0, 2, 0.1], max_depth=1).any()
    assert np.allclose(radiance(made, [0, 3, 0.1], [0, 2, 0.1], max_depth=1), 3)


@pytest.mark.parametrize("floor", ["grey", "plastic"])
def test_aiming_at_lights_changes_the_noise_and_not_the_mean(floor: str) -> None:
    lamps = [
        {"centre_m": [-0.4, 0.7, 0.2], "radius_m": 0.3, "emission": [2, 2, 2]},
        {"centre_m": [0.9, 0.8, 0.2], "radius_m": 0.2, "emission": [5, 3, 1]},
        {"centre_m": [0.2, 0.25, -0.6], "radius_m": 0.25, "material": "plastic"},
    ]
    panel = {"corner_m": [-0.5, 1.5, -0.5], "edge_u_m": [1, 0, 0], "edge_v_m": [0, 0, 1], "emission": [1, 2, 3]}
    plane = FLOOR | {"material": floor}
    # White surroundings are found by scattering alone, in both: their noise would hide that of the lamps.
    for around, noise, error in (({"environment": WHITE}, 1.0, 0.03), ({}, 0.3, 0.05)):
        made = on_floor(planes=[plane], spheres=lamps, quads=[panel], **around)
        assert_aimed(made, [0.1, 0, 0], noise, error)


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


SCENE = Path(__file__).parents[3] / "experiments" / "scenes" / "cornell.toml"
REFERENCE = np.loadtxt(Path(__file__).with_name("cornell_reference.csv"), delimiter=",")  # rows nm, 8 means
SAMPLES, PIXELS = 64, 32


@pytest.mark.parametrize("nm", [450.0, 550.0, 650.0])
def test_cornell_box_agrees_with_mitsuba(nm: float) -> None:
    scene = load_scene(SCENE)
    settings = scene.settings.camera
    world = World(scene, SpectralRange(nm, nm))
    sampler, count = Sampler(SAMPLES, 3), PIXELS * PIXELS * SAMPLES
    pixel, sample = np.divmod(np.arange(count), SAMPLES)
    keys = sampler.keys(pixel, sample)
    points = PixelGrid(PIXELS, PIXELS, (25.0, 25.0)).film_points(pixel, sampler.draw2(keys, FILM))
    rays = Pinhole(35.0, (25.0, 25.0)).sample(points, np.zeros_like(points), np.full(count, nm, np.float32))
    axes = np.diag(np.float32([-1, 1, -1]))  # the camera looks along +z, up is +y
    assert settings.up == (0, 1, 0) and settings.look_at_m[:2] == settings.position_m[:2]
    origin = axes @ rays.origin_m + np.float32(settings.position_m)[:, None]
    bins = np.zeros(count, np.intp)
    paths = Paths.of(origin, axes @ rays.direction, np.ones((1, count), np.float32), bins)
    found = trace(world, sampler, keys, paths, 40)

    (lamp,) = scene.settings.quads
    parts = found.reshape(8, PIXELS // 8, 8, PIXELS // 8, SAMPLES) / lamp.emission[0]
    means, pixels = parts.mean(axis=(1, 3, 4)), parts.mean(axis=4)
    # Of the mean of a part: the spread within pixels, an upper bound as samples are stratified.
    error = np.sqrt(parts.var(axis=4).mean(axis=(1, 3)) / (SAMPLES * pixels.shape[1] ** 2)) + 2e-3 * means
    expected = REFERENCE[REFERENCE[:, 0] == nm, 1:]
    assert expected.shape == (8, 8)
    assert np.abs((means - expected) / (error + 1e-6)).max() < 4.5
    # All but the rows that show the lamp, a tenth of a per cent of which outshines the noise of the rest.
    assert means[2:].mean() == pytest.approx(expected[2:].mean(), rel=0.005)
