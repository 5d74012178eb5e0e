"""Lights of flare: lists over frames, those of scenes, highlights of pictures, against closed forms."""

import json
import math
from pathlib import Path

import numpy as np
import pytest

from neurolens.base.errors import InputError
from neurolens.cameras.build import make_camera
from neurolens.cameras.field import field_of
from neurolens.optics.lens.shot import Shot
from neurolens.optics.readers.lensfile import read_lens
from neurolens.pictures.flare.lights import (
    SUN,
    Light,
    SceneLights,
    highlights,
    keep,
    light_rays,
    patches,
    read_lights,
    with_disc,
)
from neurolens.pictures.render.scene import scene_from_tables, seen_from

CSV = """light,frame,azimuth_deg,elevation_deg,r,g,b,distance_m
sun,1,-20,5,1,0.5,0.25,
sun,5,20,5,1,0.5,0.25,
lamp,1,0,0,2,2,2,1
lamp,3,120,0,4,4,4,0.5
"""


def test_lists_hold_keys_and_both_kinds_say_the_same(tmp_path: Path) -> None:
    one, other = tmp_path / "lights.csv", tmp_path / "lights.json"
    one.write_text(CSV)
    names = CSV.splitlines()[0].split(",")
    rows = [dict(zip(names, line.split(","), strict=True)) for line in CSV.splitlines()[1:]]
    told = [{k: v if k == "light" else float(v) for k, v in row.items() if v} for row in rows]
    other.write_text(json.dumps(told))
    for tracks in (read_lights(one), read_lights(other)):
        sun, lamp = tracks
        assert sun.name == "sun" and sun.at(2) == Light(-10.0, 5.0, (1.0, 0.5, 0.25))
        assert sun.at(-100) == sun.at(1) and sun.at(99) == Light(20.0, 5.0, (1.0, 0.5, 0.25))
        assert lamp.at(2) == Light(60.0, 0.0, (3.0, 3.0, 3.0), 1 / 1.5)
        assert lamp.at(3) is None  # behind the lens
    one.write_text("light,frame,azimuth_deg,elevation_deg\na,1,350,2\na,2,359,2\n")  # it went round the camera
    assert read_lights(one)[0].at(1) == Light(-10.0, 2.0, (SUN,) * 3)
    one.write_text("azimuth_deg,elevation_deg\n1,2\n3,4\n")
    assert [track.at(0) for track in read_lights(one)] == [Light(*at, (SUN,) * 3) for at in ((1.0, 2.0), (3.0, 4.0))]
    one.write_text("azimuth_deg,elevation_deg,distance_m\n0.1rad,2 deg,6ft\n")
    lamp = read_lights(one)[0].at(0)
    assert (lamp.azimuth_deg, lamp.distance_m) == pytest.approx((math.degrees(0.1), 1.8288))
    one.write_text("azimuth_deg,elevation_deg,diameter_deg\n1,2,0.533\n3,4,0\n")
    sun, point = (track.at(0) for track in read_lights(one))
    assert sun.about["shape"] == pytest.approx([0.533, 0.533], abs=1e-3) and point.shape is None


@pytest.mark.parametrize(
    ("name", "text", "said"),
    [
        ("a.csv", "azimuth_deg,elevation_deg\n1,nan\n", "row 1, elevation_deg"),
        ("a.csv", "azimuth_deg\n1\n", "row 1, elevation_deg"),
        ("a.csv", "azimuth_deg,elevation_deg,colour\n1,2,3\n", "colour"),
        ("a.csv", "azimuth_deg,elevation_deg\n1,2,3\n", "row 1"),
        ("a.csv", "light,frame,azimuth_deg,elevation_deg\na,2,1,2\na,2,1,2\n", "after 2"),
        ("a.json", "{}", "list of objects"),
        ("a.json", "[" * 100_000, "CSV or JSON"),
        ("a.json", '[{"azimuth_deg": true, "elevation_deg": 0}]', "azimuth_deg"),
        ("a.json", '[{"azimuth_deg": 0, "elevation_deg": 0, "distance_m": 0}]', "distance_m"),
    ],
)
def test_bad_lists(tmp_path: Path, name: str, text: str, said: str) -> None:
    path = tmp_path / name
    path.write_text(text)
    with pytest.raises(InputError, match=said):
        read_lights(path)
    with pytest.raises(InputError, match="that exists"):
        read_lights(tmp_path / "none.csv")


def test_places_of_rays_move_without_a_jump() -> None:
    """Of a light that crosses the whole half space, each ray moves as far as the light does, about."""
    lens = read_lens(Path(__file__).parents[3] / "lenses/cooke_triplet_50.toml")
    turns = [Light(azimuth, 0.9 * azimuth) for azimuth in np.linspace(-89, 89, 400)]
    places = np.stack([light_rays(lens, light, 0, 64)[0][:3] for light in turns])
    moved = np.linalg.norm(np.diff(places, axis=0), axis=1)
    assert moved.max() < 0.05 * lens.surfaces[0].semi_diameter_mm


def scene(**tables: object) -> SceneLights:
    camera = {"position_m": [1.0, 2.0, 3.0], "look_at_m": [1.0, 2.0, -3.0], "focus_m": 5.0}
    made = scene_from_tables({"camera": camera, **tables})
    return SceneLights(made), made


def test_lights_of_a_scene_by_closed_forms() -> None:
    """Seen from (1, 2, 2.9), towards -z: a sphere 5 m ahead, a panel to the right, one that looks away, points."""
    quad = {"corner_m": [3.95, 1.95, -0.1], "edge_u_m": [0.0, 0.0, 0.1], "edge_v_m": [0.0, 0.1, 0.0]}
    panel = {**quad, "edge_u_m": quad["edge_v_m"], "edge_v_m": quad["edge_u_m"]}
    lights, made = scene(
        spheres=[{"centre_m": [1.0, 2.0, -2.1], "radius_m": 0.05, "emission": [3.0, 2.0, 1.0]}],
        quads=[{**quad, "emission": [4.0, 4.0, 4.0]}, {**panel, "emission": [4.0, 4.0, 4.0]}],
        points=[
            {"position_m": [1.0, 4.0, 0.9], "intensity": [1.0, 1.0, 1.0]},
            {"position_m": [1.0, 2.0, 9.0], "intensity": [1.0, 1.0, 1.0]},
        ],
    )
    panel_light, sphere, point = lights.seen(made, 100.0)
    solid = 2 * math.pi * (1 - math.sqrt(1 - (0.05 / 5) ** 2))
    assert sphere.rgb == pytest.approx([3 * solid, 2 * solid, solid], rel=2e-3)
    assert (sphere.azimuth_deg, sphere.elevation_deg) == pytest.approx((0, 0), abs=1e-2)
    assert sphere.distance_m == pytest.approx(5 - 2 / 3 * 0.05, abs=1e-3)  # the mean of what is seen of it
    far2 = 2.95**2 + 2.95**2
    assert panel_light.rgb == pytest.approx([4 * 0.01 * math.sqrt(0.5) / far2] * 3, rel=0.01)
    assert (panel_light.azimuth_deg, panel_light.elevation_deg) == pytest.approx((45, 0), abs=0.2)
    assert point.rgb == pytest.approx([1 / 8] * 3, rel=1e-3)
    assert (point.azimuth_deg, point.elevation_deg) == pytest.approx((0, 45), abs=1e-3)
    assert point.distance_m == pytest.approx(math.sqrt(8), rel=1e-5)


def test_rays_of_an_extended_light_come_from_all_of_it() -> None:
    """Their mean direction is that of its middle, and their variance a disc's: r^2 / 4 along each axis."""
    lens = read_lens(Path(__file__).parents[3] / "lenses/cooke_triplet_50.toml")
    light = Light(20.0, 10.0, (2.0, 1.0, 1.0))
    shifts = np.arange(16) / 16  # one for each wavelength
    found = [light_rays(lens, with_disc(light, 4.0), 0, 1024, shift) for shift in shifts]
    point, whole = light_rays(lens, light, 0, 1024, 0.3)
    rays = np.concatenate([rays for rays, _ in found], 1)
    assert rays.shape[1] == 16 * 1024 and np.mean([area for _, area in found]) == pytest.approx(whole, rel=1e-3)
    assert rays[3:].mean(1) == pytest.approx(point[3:, 0], abs=2e-3)  # a cell has 9e-3
    spread = np.linalg.norm(rays[3:] - rays[3:].mean(1)[:, None], axis=0)
    assert np.mean(spread**2) == pytest.approx(math.tan(math.radians(2)) ** 2 / 2, rel=0.05)


def test_lights_are_hidden_dim_and_follow_the_camera() -> None:
    light = {"centre_m": [1.0, 2.0, -2.1], "radius_m": 0.05, "emission": [1.0, 1.0, 1.0]}
    wall = {"min_m": [1.0, 0.0, 0.0], "max_m": [3.0, 4.0, 0.1], "material": "grey"}
    grey = {"grey": {"kind": "diffuse", "reflectance": [0.5, 0.5, 0.5]}}
    free, made = scene(spheres=[light])
    whole = free.seen(made, 100.0)[0].rgb[0]
    half, made = scene(spheres=[light], boxes=[wall], materials=grey)
    assert half.seen(made, 100.0)[0].rgb[0] == pytest.approx(whole / 2, rel=0.02)
    aside = seen_from(made, "scene", (2.0, 2.0, 3.0), (2.0, 2.0, -3.0))
    assert half.seen(aside, 100.0) == []
    assert half.seen(seen_from(made, "scene", None, (1.0, 2.0, 9.0)), 100.0) == []
    assert scene(environment={"colour": [1.0, 1.0, 1.0]})[0].seen(made, 100.0) == []


def test_white_balance_is_that_of_the_light() -> None:
    point = {"position_m": [1.0, 2.0, 0.9], "intensity": [1.0, 1.0, 1.0], "illuminant": "2900 K"}
    lights, made = scene(points=[point])
    (light,) = lights.seen(made, 100.0)
    assert light.rgb[0] > 2 * light.rgb[2]
    assert lights.balance("2900 K") @ light.rgb == pytest.approx([1 / 4] * 3, rel=1e-3)
    assert np.array_equal(lights.balance(None), np.eye(3))


def test_spots_shine_where_they_look() -> None:
    """2 m ahead of the front vertex: at the camera with all their intensity, 30 degrees beside it, and away."""
    spot = {"position_m": [1.0, 2.0, 0.9], "intensity": [8.0, 4.0, 2.0], "inner_deg": 10.0, "outer_deg": 20.0}
    at = [1.0, 2.0, 9.0], [1.0 + math.tan(math.radians(30)), 2.0, 1.9], [1.0, 2.0, -9.0]
    lights, made = scene(spots=[{**spot, "look_at_m": place} for place in at])
    (light,) = lights.seen(made, 100.0)
    assert light.rgb == pytest.approx([2.0, 1.0, 0.5], rel=1e-3)
    assert (light.azimuth_deg, light.elevation_deg, light.distance_m) == pytest.approx((0, 0, 2), abs=1e-3)


def test_the_sun_and_large_lights() -> None:
    """The sun has its direction, a disc's solid angle and size; a panel of 1 m at 1 m is one light of its energy, in
    patches that tile it."""
    sky = {"sun_elevation_deg": 30.0, "sun_azimuth_deg": 20.0, "white_kcd_per_m2": 20.0}
    lights, made = scene(sky=sky)
    (sun,) = lights.seen(made, 100.0)
    assert (sun.azimuth_deg, sun.elevation_deg, sun.distance_m) == pytest.approx((20, 30, math.inf), abs=0.02)
    # 133.1 klx outside the atmosphere, less what air and haze take.
    luminance = float(np.dot([0.2126, 0.7152, 0.0722], sun.rgb)) * 20.0
    assert 70 < luminance < 133
    quad = {"corner_m": [0.5, 1.5, 1.9], "edge_u_m": [1.0, 0.0, 0.0], "edge_v_m": [0.0, 1.0, 0.0]}
    lights, made = scene(quads=[{**quad, "emission": [1.0, 1.0, 1.0]}])
    assert sun.about["shape"] == pytest.approx([0.533, 0.533], abs=1e-3) and sun.shape.round
    (patch,) = patches(sun, 4.0)
    assert patch.round and patch.light.towards == pytest.approx(sun.towards, abs=1e-7)
    (panel,) = lights.seen(made, 100.0)
    found = [patch.light for patch in patches(panel, 1e-9, 8)]
    # The solid angle of a square of side 1 from 1 m before its middle: 4 asin(0.25 / 1.25).
    assert len(found) == 64 and panel.about["shape"] == pytest.approx([51.2, 51.2], abs=0.1)  # 2 sin 26.6 degrees
    for some in (found, [panel]):
        assert sum(light.rgb[1] for light in some) == pytest.approx(4 * math.asin(0.2), rel=3e-3)
    places = sorted(
        {(round(math.tan(math.radians(a.azimuth_deg)), 2), round(a.towards[1] / -a.towards[2], 2)) for a in found}
    )
    assert places[0] == pytest.approx((-0.4375, -0.4375), abs=0.01) and len(places) == 64


def test_lights_of_frames_neither_come_nor_go() -> None:
    """Thirteen lights that a camera passes, five of which are kept: other ones in other frames, yet none by a step."""
    lamps = [{"position_m": [-3.0 + 0.5 * k, 2.0, -1.0], "intensity": [1.0 + 0.1 * k] * 3} for k in range(12)]
    quad = {"corner_m": [0.5, 1.5, -4.0], "edge_u_m": [1.0, 0.0, 0.0], "edge_v_m": [0.0, 1.0, 0.0]}
    lights, made = scene(points=lamps, quads=[{**quad, "emission": [9.0, 9.0, 9.0]}])
    last, cast, steps = np.zeros(13), set[tuple[int, ...]](), 0.0
    for x in np.linspace(-3.0, 3.0, 601):
        every = lights.seen(seen_from(made, "scene", (x, 2.0, 3.0), (x, 2.0, -3.0)), 100.0)
        kept = {(k.azimuth_deg, k.distance_m): sum(k.rgb) for k in keep(every, 5, fade=True).lights}
        assert len(every) == 13 and len(kept) <= 5
        now = np.array([kept.get((k.azimuth_deg, k.distance_m), 0.0) for k in every])
        steps, last = max(steps, float(np.abs(now - last).max()) if last.any() else 0.0), now
        cast.add(tuple(np.flatnonzero(now)))
    assert len(cast) > 3 and steps < 0.1 * last.max()


def test_lights_fade_before_they_are_left_out() -> None:
    """Of three lights that change places in energy two are kept: each one's energy goes by no step."""
    last: dict[float, float] = {}
    steps = 2000
    for t in np.linspace(0, 2 * math.pi, steps):
        lights = [Light(10.0 * k, 0.0, (1 + 0.5 * math.sin(t + 2.1 * k),) * 3) for k in range(3)]
        found = keep(lights, 2, fade=True)
        now = {light.azimuth_deg: light.rgb[0] for light in found.lights}
        assert len(now) <= 2 and found.dropped == pytest.approx(1 - sum(now.values()) / sum(x.rgb[0] for x in lights))
        for k in (0.0, 10.0, 20.0):
            # A tenth of what a light that comes at once adds; the step of time is 0.003.
            assert not last or abs(now.get(k, 0.0) - last.get(k, 0.0)) < 30 * 2 * math.pi / steps
        last = now
    assert keep(lights, 3, fade=True).lights == keep(lights, 3).lights
    equal = [Light(10.0 * k, 0.0) for k in range(3)]
    assert len(keep(equal, 2, fade=True).lights) == 2
    assert keep([], 2, fade=True).dropped == 0


def test_highlights_by_closed_forms() -> None:
    """Of a pinhole 50 mm before the film: directions, solid angles and energy of painted regions."""
    film, size = (36.0, 24.0), (180, 120)
    field = field_of(
        make_camera("pinhole", Shot(film_mm=film, focus_m=math.inf, focal_length_mm=50.0)), math.inf, "equidistant"
    )
    picture = np.zeros((size[1], size[0], 3), np.float32)
    picture[60:62, 90:92] = 10.0  # four pixels about (0.2 mm, -0.2 mm)
    picture[10, 150] = (0.0, 30.0, 0.0)
    picture[11, 151] = (0.0, 30.0, 0.0)  # touches it at a corner
    picture[100, 20] = 1.9
    found = highlights(picture, field, film, 2.0, 9)
    assert found.of == len(found.lights) == 2 and found.dropped == 0
    middle, corner = found.lights
    assert middle.rgb == pytest.approx([10 * 4 * (0.2 / 50) ** 2] * 3, rel=1e-3)
    angle = math.degrees(math.atan(0.2 / 50))
    assert (middle.azimuth_deg, middle.elevation_deg) == pytest.approx((angle, -angle), abs=2e-3)
    x, y, z = (151 - 90) * 0.2, (60 - 11) * 0.2, 50.0
    to = math.sqrt(x * x + y * y + z * z)
    assert corner.rgb[1] == pytest.approx(2 * 30 * (to / z) ** 4 * 0.04 * z / to**3, rel=2e-3)  # the film has cos^4
    assert corner.rgb[0] == corner.rgb[2] == 0
    assert corner.azimuth_deg == pytest.approx(math.degrees(math.atan2(x, z)), abs=2e-2)
    assert corner.elevation_deg == pytest.approx(math.degrees(math.asin(y / to)), abs=2e-2)
    few = highlights(picture, field, film, 2.0, 1)
    assert few.lights == [middle] and few.dropped == pytest.approx(corner.rgb[1] / (3 * middle.rgb[0] + corner.rgb[1]))
    x, y = np.meshgrid(np.arange(60) - 29.5, np.arange(60) - 29.5)
    picture[30:90, 60:120] = (
        5 / (1 + (x**2 + y**2)[..., None] * (0.2 / 50) ** 2) ** 2
    )  # large: cells, whose energy is its own
    many = highlights(picture, field, film, 2.0, 10_000)
    assert many.of > 50
    whole = sum(light.rgb[0] for light in many.lights)
    a = 6.0 / 50  # half side over distance
    solid = 4 * math.asin(a * a / (1 + a * a))
    assert whole == pytest.approx(5 * solid, rel=2e-3)
    assert highlights(picture, field, film, 100.0, 9).lights == []
    picture[0, 0, 1] = np.nan
    with pytest.raises(InputError, match="1 with NaN"):
        highlights(picture, field, film, 2.0, 9)


def test_highlights_do_not_switch_on_at_once() -> None:
    """None at the threshold, whole from twice it on, and in between as near as its value is."""
    camera = make_camera("pinhole", Shot(film_mm=(36.0, 24.0), focus_m=math.inf, focal_length_mm=50.0))
    field = field_of(camera, math.inf, "equidistant")

    def energy(value: float) -> float:
        picture = np.zeros((12, 18, 3), np.float32)
        picture[4, 7] = (value, 0.5 * value, 0.0)
        return sum(light.rgb[0] for light in highlights(picture, field, (36.0, 24.0), 3.0, 9).lights)

    whole = energy(6.0) / 6.0
    assert whole > 0 and energy(60.0) == pytest.approx(60 * whole, rel=1e-6)
    assert energy(2.999) == energy(3.0) == 0
    assert energy(4.5) == pytest.approx(4.5 * 0.5 * whole, rel=1e-6)
