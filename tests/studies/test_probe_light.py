"""A probe's results besides footprints: light and flare."""

import math
from typing import Any

import numpy as np
import pytest
import torch
from shipped import whole

from neurolens.cameras.build import make_camera
from neurolens.optics.analysis.fields import Scene as Fields
from neurolens.optics.lens.shot import Shot
from neurolens.optics.readers.lensfile import read_lens
from neurolens.optics.setting.pupils import camera_rays
from neurolens.optics.setting.states import set_lens
from neurolens.optics.trace.rays import Rays, trace
from neurolens.pictures.flare.canvas import Raster
from neurolens.pictures.flare.job import FlareJob
from neurolens.pictures.flare.layers import flare_layers
from neurolens.pictures.flare.lights import SceneLights
from neurolens.pictures.render.scene import scene_from_tables
from neurolens.pictures.render.settings import FlareSettings
from neurolens.studies.plan.probe import effect_maps, effects_of, probe, small_picture, stray_light

LENS = "lenses/cooke_triplet_50.toml"  # of glass that absorbs
GREYS = {name: {"kind": "diffuse", "reflectance": [value] * 3} for name, value in (("grey", 0.2), ("light", 0.8))}


def wall(distance_m: float = 4.0, camera: dict[str, Any] | None = None, **more: Any) -> Any:
    shot = {"position_m": [0.0, 0.0, 0.0], "look_at_m": [0.0, 0.0, -1.0], "focus_m": 3.0, "width": 96, "height": 54}
    plane = {"point_m": [0.0, 0.0, -distance_m], "normal": [0.0, 0.0, 1.0], "material": "grey"}
    tables = {"environment": {"colour": [1.0, 1.0, 1.0]}, "materials": GREYS, "planes": [plane]}
    return scene_from_tables({"camera": shot | (camera or {})} | tables | more)


def card(size_m: float, depth_m: float, corner_m: tuple[float, float], material: str = "grey") -> dict[str, Any]:
    sides = {"edge_u_m": [size_m, 0.0, 0.0], "edge_v_m": [0.0, size_m, 0.0]}
    return {"corner_m": [*corner_m, -depth_m], **sides, "material": material}


def test_narrow_light_has_no_colour_errors() -> None:
    line = {"spectrum": [[300.0, 0.0], [584.0, 0.0], [589.0, 1.0], [594.0, 0.0], [900.0, 0.0]]}
    sodium = wall(illuminants={"sodium": line}, environment={"colour": [1.0, 1.0, 1.0], "illuminant": "sodium"})
    lens = set_lens(read_lens(LENS), coating="bare")  # coated glass is nearly neutral
    found, white = (probe(s, lens, across=4) for s in (sodium, wall()))
    assert 583 <= found.asked.light_nm[0] < found.asked.light_nm[1] <= 595
    assert white.asked.light_nm[0] < 430 and white.asked.light_nm[1] > 660
    # Of one light the shares are those of the eye: its mean lies where V times the light is balanced.
    assert (found.places.wavelength_nm * found.places.share).sum() == pytest.approx(589, abs=0.3)
    for name in ("lateral colour", "longitudinal colour", "transmittance"):
        narrow, wide = (np.nanmax(effect_maps(f)[name][1]) for f in (found, white))
        assert narrow < 0.1 * wide, name


def test_transmittance_is_that_of_the_axis() -> None:
    found = probe(wall(), set_lens(read_lens(LENS)), across=1)  # one place, on the axis
    slope = torch.linspace(0, 0.12, 20_001, dtype=torch.float64)
    zero, through = torch.zeros_like(slope), []
    for nm in found.places.wavelength_nm:
        cone = Rays(zero, zero, zero + found.lens.film_z_mm, torch.sin(slope), zero, -torch.cos(slope))
        along = trace(found.lens, cone, float(nm), transmittance=True)
        # What one wavelength has of light goes with the square of its aperture, too: an integral over the cone.
        assert along.transmittance is not None
        through.append(float((along.transmittance * torch.sin(2 * slope))[along.status == 0].sum()))
    tint = np.array(through) / np.average(through, weights=found.places.share)
    expected = math.sqrt(np.average((tint - 1) ** 2, weights=found.places.share))
    assert effect_maps(found)["transmittance"][1][0, 0] == pytest.approx(expected, rel=0.05) and expected > 5e-4


def test_vignetting_darkens_the_corner_as_traced_rays_say() -> None:
    """Rays of the corner's film point through a grid of the pupil, with the rims and without them; the stop in both."""
    found = probe(wall(camera={"f_number": 1.8}), set_lens(read_lens("lenses/laikin_double_gauss_50.toml")), across=8)
    maps = effect_maps(found)
    (unit, taken), (_, fall) = maps["vignetting"], maps["natural fall-off"]
    x, y = (mm * (0.5 / n - 0.5) for mm, n in zip(found.shot.film_mm, taken.shape[::-1], strict=True))
    side = torch.linspace(-35, 35, 251, dtype=torch.float64)
    u, v = (a.reshape(-1) for a in torch.meshgrid(side, side, indexing="ij"))
    film = torch.full_like(u, x), torch.full_like(u, y), torch.full_like(u, found.lens.film_z_mm)
    rays = camera_rays(*film, u, v, found.domain.pupil_z_mm)
    whole, left = (
        float((rays.dz**4)[trace(lens, rays, 587.56).status == 0].sum())
        for lens in (Fields(found.lens, rims=False).traced, found.lens)
    )
    assert unit == "relative" and left / whole - 1 < -0.1
    assert taken[[0, 0, -1, -1], [0, -1, 0, -1]] == pytest.approx(left / whole - 1, abs=0.003)
    assert (taken <= 0).all() and taken[taken.shape[0] // 2, taken.shape[1] // 2] == pytest.approx(0, abs=1e-6)
    light = found.on_film(found.seen.light)
    axis = np.unravel_index(np.nanargmax((1 + fall) * (1 + taken)), light.shape)
    assert (1 + fall) * (1 + taken) == pytest.approx(light / light[axis], rel=1e-6) and (fall <= 0).all()
    worth = {e.name: e.worth for e in effects_of(found, 0.25, stray=False)}
    assert worth["vignetting"] > 0.05  # its size: what a camera without it gets wrong


def test_flare_is_that_of_the_layers() -> None:
    """It equals the layers at four times the pixels, grows with the light, and is none without a light."""
    bright = {"centre_m": [0.5, 0.3, -3.0], "radius_m": 0.03}
    scenes = [wall(spheres=[bright | {"emission": [e, e, e]}]) for e in (300.0, 600.0)]
    camera = make_camera(LENS, Shot((36.0, 20.25), 3.0))
    small = small_picture(wall(), camera)
    once, twice = (stray_light(s, camera, small) for s in scenes)
    for name in ("flare", "star-bursts"):
        assert twice[name].mean() == pytest.approx(2 * once[name].mean(), rel=1e-3) and once[name].mean() > 0
    lights = SceneLights(scenes[0]).seen(scenes[0], camera.lens.film_z_mm)
    job = FlareJob(camera.lens, lights, Raster((36.0, 20.25), 192, 108), FlareSettings())
    large = flare_layers(job)["ghosts"]
    expected = large.max(-1).reshape(27, 4, 48, 4).mean((1, 3)) / small.mean(-1)
    assert once["flare"].mean() == pytest.approx(expected.mean(), rel=0.03)
    assert np.corrcoef(once["flare"].ravel(), expected.ravel())[0, 1] > 0.9
    assert not any(v.any() for v in stray_light(wall(), camera, small).values())


EXTREMES: dict[str, dict[str, Any]] = {
    "distant": {"planes": []},
    "at the front glass": {"quads": [card(0.2, 0.0635, (-0.1, -0.1))]},  # 2 mm before it, 61.5 mm from the film
    "one pixel": {"camera": {"width": 1, "height": 1, "film_width_mm": 0.01, "film_height_mm": 0.01}},
    "dark": {"environment": {"colour": [0.0, 0.0, 0.0]}},
}


@pytest.mark.parametrize("name", [*(name for name in EXTREMES if name != "one pixel"), *whole("one pixel")])
def test_extremes_have_an_answer(name: str) -> None:
    found = probe(wall(**EXTREMES[name]), set_lens(read_lens(LENS)), across=3)
    effects = effects_of(found, 0.25)
    assert all(e.worth >= 0 for e in effects) and {"defocus", "flare"} <= {e.name for e in effects}
    assert (found.asked.nearest_m is None) == (found.asked.distant == 1.0) == (name == "distant")


def test_lights_beyond_number_are_bounded() -> None:
    """Only the lights that are strongest at the lens are used: a near one among weak ones is found."""
    place = np.random.default_rng(0).uniform([-9, -9, -60], [9, 9, -40], (10_000, 3))
    points = [{"position_m": [float(v) for v in p], "intensity": [1e-6] * 3} for p in place]
    points[6_789] = {"position_m": [0.2, 0.1, -2.0], "intensity": [5.0] * 3}
    scene = wall(100.0, points=points)
    seen = SceneLights(scene).seen(scene, 60.0, most=8)
    assert len(seen) <= 8 and max(a.rgb[0] for a in seen) == pytest.approx(5 / 2.01**2, rel=0.1)
