"""Flare on films that are turned and moved: every ray lands where its line meets the film; energy; focus; the star."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from neurolens.cameras.build import make_camera
from neurolens.cameras.pose import UPRIGHT, FilmPose
from neurolens.graph.compiler import has_compiler
from neurolens.graph.interpret import evaluate
from neurolens.optics.lens.prescription import Lens
from neurolens.optics.lens.shot import Shot
from neurolens.pictures.flare.canvas import Raster
from neurolens.pictures.flare.ghosts import GhostTracer, ghost_pairs
from neurolens.pictures.flare.job import FlareJob
from neurolens.pictures.flare.layers import flare_layers, photon_picture, sum_of
from neurolens.pictures.flare.lights import Light, light_rays
from neurolens.pictures.flare.photons import CHANCES, PhotonTracer, film_scatter_graph
from neurolens.pictures.flare.steps import STATE, film_numbers
from neurolens.pictures.render.settings import FlareSettings, Scatter

pytestmark = pytest.mark.skipif(not has_compiler(), reason="needs a C compiler")
FILE = Path(__file__).parents[3] / "lenses" / "laikin_double_gauss_50.toml"
POSE = FilmPose(math.radians(8), math.radians(-5), (3.0, -2.0))


@pytest.fixture(scope="module")
def lens() -> Lens:
    return make_camera(str(FILE), Shot((36.0, 24.0), 2.0, 4.0, runtime="onnxruntime")).lens  # type: ignore[attr-defined]


def test_every_ghost_lands_where_its_line_meets_the_turned_film(lens: Lens) -> None:
    """The line goes through the places on two upright films, 0.5 mm before and behind."""
    pairs = ghost_pairs(lens)[::9]
    rays, _ = light_rays(lens, Light(12.0, 6.0), 0, 2000)

    def on(film_z: float, pose: FilmPose = UPRIGHT) -> np.ndarray:
        traced = GhostTracer(replace(lens, film_z_mm=film_z), pairs, pose).trace(rays, 550.0, direct=True)
        return traced.rows.astype(np.float64)

    z = float(lens.film_z_mm or 0)
    near, far, found = on(z - 0.5), on(z + 0.5), on(z, POSE)
    lit = (near[:, 2] > 0) & (found[:, 2] > 0)
    assert lit.sum() > 500 and (lit == (near[:, 2] > 0)).mean() > 0.999
    start = np.stack([*np.moveaxis(near[:, :2], 1, 0)[:, lit], np.full(lit.sum(), -0.5)])
    way = np.stack([*np.moveaxis(far[:, :2], 1, 0)[:, lit], np.full(lit.sum(), 0.5)]) - start
    normal = POSE.axes[:, 2]
    place = start - way * (normal @ start) / (normal @ way)
    wanted = POSE.axes[:, :2].T @ place + np.array(POSE.moved_mm)[:, None]
    got, size = np.moveaxis(found[:, :2], 1, 0)[:, lit], np.hypot(*wanted) + np.hypot(*way[:2])
    assert (np.hypot(*(got - wanted)) / (1 + size)).max() < 3e-4  # floats of the two films, 1 mm apart
    np.testing.assert_array_equal(found[:, 2][lit], near[:, 2][lit])


def test_the_image_is_that_of_the_camera(lens: Lens) -> None:
    """The middle of a light's image, by compiled steps and by the camera's way from the scene to the film."""
    away = 2.0
    light = Light(9.0, 5.0, distance_m=away)
    rays, _ = light_rays(lens, light, 0, 20_000)
    found = GhostTracer(lens, [], POSE).trace(rays, 550.0, direct=True)
    lit = found.power[0] > 0
    turn = {"film_tilt_deg": 8.0, "film_swing_deg": -5.0, "film_shift_mm": 3.0, "film_rise_mm": -2.0}
    camera = make_camera(str(FILE), Shot((36.0, 24.0), 2.0, 4.0, runtime="onnxruntime", **turn))  # type: ignore[arg-type]
    # lights stand before the front vertex, cameras at the film; x of both to the right, z of the lens towards the film
    point = away * light.towards * [1, 1, 1] - [0, 0, float(lens.film_z_mm or 0) / 1e3]
    square = np.random.default_rng(1).random((2, 20_000), np.float32)
    nm = np.full(20_000, 550.0, np.float32)
    there = camera.to_film(np.repeat(point[:, None], 20_000, 1).astype(np.float32), square, nm)  # type: ignore[attr-defined]
    seen = there.weight > 0
    middles = (np.average(xy, axis=1, weights=w) for xy, w in (
        (found.film_xy_mm[0][:, lit], found.power[0][lit]), (there.film_mm[:, seen], there.weight[seen])))  # fmt: skip
    np.testing.assert_allclose(*middles, atol=5e-3)


def test_lights_in_focus_lie_on_a_tilted_plane(lens: Lens) -> None:
    """Scheimpflug: by 1 / a + 1 / b = 1 / f, film that lies z mm farther is sharp for 1 / a greater by 1000 z / b^2."""
    pose, film_m, depths, sharp = FilmPose(tilt=math.radians(8)), float(lens.film_z_mm or 0) / 1e3, [], []
    tracer, inverse = GhostTracer(lens, [], pose), np.linspace(0.1, 1.2, 56)  # 1 / m, from the film
    for elevation in (-8.0, -4.0, 0.0, 4.0, 8.0):
        spots, middles = [], []
        for m in inverse:
            light = Light(0.0, elevation, distance_m=(1 / m - film_m) / math.cos(math.radians(elevation)))
            found = tracer.trace(light_rays(lens, light, 0, 600)[0], 550.0, direct=True)
            xy = found.film_xy_mm[0][:, found.power[0] > 0].astype(np.float64)
            middles.append(xy.mean(1))
            spots.append(xy.var(1).sum())
        best = int(np.argmin(spots))
        sharp.append(inverse[best])
        depths.append(math.sin(pose.tilt) * middles[best][1])
    slope, middle = np.polyfit(depths, sharp, 1)
    assert middle == pytest.approx(0.5, abs=0.03) and slope == pytest.approx(1000 / 51.0**2, rel=0.05)


def test_pictures_keep_the_light(lens: Lens) -> None:
    """A wide film takes the same light however it stands; the exposure that values are divided by has its cosine."""
    light, raster = Light(5.0, 3.0), Raster((240.0, 160.0), 120, 80)
    pairs = [pair for pair in ghost_pairs(lens) if pair.name in ("g10-06", "g08-06")]
    sums = []
    for pose in (UPRIGHT, POSE):
        settings = FlareSettings(bins=3, photons=0, without=())
        job = FlareJob(lens, [light], raster, settings, ghosts=GhostTracer(lens, pairs, pose), pose=pose)
        sums.append([float(sum_of(flare_layers(job), raster).sum()), float(photon_picture(job, "image", 4000).sum())])
    cosine = POSE.axes[2, 2]
    assert np.array(sums[1]) * cosine == pytest.approx(np.array(sums[0]), rel=0.01)


def test_a_turned_film_sends_light_back_about_its_own_normal(lens: Lens) -> None:
    rng, count = np.random.default_rng(2), 500
    film, call = rng.uniform(-10, 10, (2, count)), np.append(film_numbers(30.0, POSE), 1.0)
    come = np.stack([*rng.uniform(-0.3, 0.3, (2, count)), np.ones(count)])
    come /= np.linalg.norm(come, axis=0)
    angle = rng.uniform(0, 2 * np.pi, count)
    chances = [rng.random(count), rng.random(count), rng.random(count), np.cos(angle), np.sin(angle)]
    assert len(chances) == CHANCES
    state = [np.zeros((3, count)), come * [[1], [1], [-1]], np.ones((2, count))]
    row = np.concatenate([*state, film, chances])
    assert row.shape[0] == STATE + 2 + CHANCES
    normal = -POSE.axes[:, 2]
    place = POSE.axes[:, :2] @ (film - np.array(POSE.moved_mm)[:, None]) + [[0], [0], [30.0]]
    for share, mean in ((1.0, None), (0.0, 2 / 3)):
        call[-1] = share
        event = evaluate(film_scatter_graph(), {"row": row, "call": call[:, None]})["event"]
        np.testing.assert_allclose(event[:3], place, atol=1e-5)
        if mean is None:
            np.testing.assert_allclose(event[3:], come - 2 * normal[:, None] * (normal @ come), atol=1e-6)
        else:
            assert (normal @ event[3:]).mean() == pytest.approx(mean, abs=0.03)  # Lambert's law
    books = PhotonTracer(lens, Scatter(sensor=0.3), POSE).trace(light_rays(lens, Light(3, 2), 0, 5000)[0], 550.0)
    assert books.cast == books.weight.size + books.left + books.stopped + books.absorbed + books.cut


def test_stars_move_with_the_film(lens: Lens) -> None:
    raster, light = Raster((12.0, 8.0), 60, 40), Light(0.0, 0.0)
    plain = FlareJob(lens, [light], raster, FlareSettings(bins=1, starburst=True, without=("ghosts",)))
    moved = replace(plain, pose=FilmPose(moved_mm=(2.0, -1.0)))  # ten pixels to the left, five up
    one, other = (flare_layers(job)["starburst"] for job in (plain, moved))
    inside = one[10:, 15:][:20, :20]
    np.testing.assert_allclose(other[5:][:20, 5:][:, :20], inside, rtol=0.05, atol=1e-3 * inside.max())


def test_a_star_falls_on_its_image_on_a_turned_film(lens: Lens) -> None:
    """It has the light of the upright one, and is that one on a film that is hardly turned."""
    raster, light = Raster((24.0, 16.0), 120, 80), Light(3.0, 2.0)
    plain = FlareJob(lens, [light], raster, FlareSettings(bins=1, starburst=True, without=("ghosts",)))
    jobs = plain, replace(plain, pose=FilmPose(1e-9)), replace(plain, pose=POSE)
    upright, hardly, turned = (flare_layers(job)["starburst"].sum(-1) for job in jobs)
    np.testing.assert_allclose(hardly, upright, atol=1e-4 * upright.max())
    found = GhostTracer(lens, [], POSE).trace(light_rays(lens, light, 0, 5000)[0], 550.0, direct=True)
    x, y = np.average(found.film_xy_mm[0], axis=1, weights=found.power[0]) * raster.per_mm
    rows, columns = np.indices(turned.shape)
    near = np.where(np.hypot(columns - (59.5 - x), rows - (39.5 + y)) < 10, turned, 0.0)
    assert turned.max() == near.max()
    middle = [(near * v).sum() / near.sum() for v in (columns, rows)]
    np.testing.assert_allclose(middle, [59.5 - x, 39.5 + y], atol=0.5)
    light_of = [float(p.sum()) * job.exposure for p, job in ((upright, jobs[0]), (turned, jobs[2]))]
    assert light_of[1] == pytest.approx(light_of[0], rel=0.05)
