"""Blur for plates: closed forms of the thin lens, the exact lens's own rays, occlusion, layers, files, bad input."""

from __future__ import annotations

import itertools
import math
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from typing import cast

import numpy as np
import OpenEXR
import pytest
from shipped import whole

from neurolens.base.errors import InputError, NeurolensWarning
from neurolens.base.settings import LIGHT_NM
from neurolens.cameras.build import make_camera
from neurolens.cameras.contract import Camera, DifferentialCamera
from neurolens.cameras.field import field_of, frame_of
from neurolens.cameras.ideal import ThinLens
from neurolens.cameras.sampling import stratified
from neurolens.cli import main
from neurolens.graph.compiler import has_compiler
from neurolens.optics.lens.apertures import Aperture
from neurolens.optics.lens.shot import Shot
from neurolens.pictures.defocus.kernels import kernel_at, kernels_over, own_plate, tint
from neurolens.pictures.defocus.picture import (
    SAMPLES,
    _sizes,
    check_field,
    defocus,
    gather,
    spread_highlights,
    spread_over,
    take_highlights,
)
from neurolens.pictures.defocus.plate import DepthSettings, Layer, Plate, PlatePinhole, RayTable, read_plate
from neurolens.pictures.render.colour import SpectralRange
from neurolens.pictures.render.pictures import read_channels, read_exr, write_channels
from neurolens.pictures.render.renderer import render
from neurolens.pictures.render.sampler import sobol
from neurolens.pictures.render.scene import load_scene
from tests.command_line import failure, run_json

ROOT = Path(__file__).parents[3]
GAUSS = ROOT / "lenses" / "laikin_double_gauss_50.toml"
FILM, SIZE = (36.0, 20.25), (384, 216)
STRIP = (384, 72)  # for pictures whose rows are alike
FOCUS_M = 2.0
pytestmark = pytest.mark.skipif(not has_compiler(), reason="defocus takes a C compiler")


def thin(f_number: float = 1.4, focus_m: float = FOCUS_M, size: tuple[int, int] = SIZE) -> ThinLens:
    return ThinLens(50.0, f_number, focus_m, (FILM[0], FILM[0] * size[1] / size[0])).compiled()


def plate_of(camera: Camera, *layers: tuple[np.ndarray, np.ndarray], size: tuple[int, int] = SIZE) -> Plate:
    frame = frame_of(camera)
    per_mm = size[0] / camera.film_mm[0]
    reach = frame.reach_mm[0] * per_mm, frame.reach_mm[1] * per_mm
    pinhole = PlatePinhole(reach, (size[0] / 2, size[1] / 2), frame.pupil_mm[0])
    return Plate([Layer(rgb.astype(np.float32), np.asarray(w, np.float32)) for rgb, w in layers], pinhole, size)


def blurred(
    camera: Camera, rgb: np.ndarray, w: np.ndarray, highlights: bool = False, samples: int = 128, threads: int = 1
) -> np.ndarray:
    plate = plate_of(camera, (rgb, w), size=(w.shape[1], w.shape[0]))
    spread, taken = spread_over(camera, plate), None
    if highlights:
        taken = take_highlights(plate, 0, spread)
        assert len(taken.radius_px)
    found = gather(plate, camera, spread, samples, threads).rgb
    if taken is not None:
        spread_highlights(found, taken, plate, camera)
    return found


def rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.square(values, dtype=np.float64).mean()))


def flat(value: float, inverse_depth: float, size: tuple[int, int] = SIZE) -> tuple[np.ndarray, np.ndarray]:
    return np.full((size[1], size[0], 3), value), np.full((size[1], size[0]), inverse_depth)


def in_focus(camera: ThinLens) -> float:
    """The inverse depth from the lens of the plane in focus, 1/m."""
    return 1 / (camera.focus_m - camera.image_distance_mm / 1000)


def disc_px(camera: ThinLens, w: float, size: tuple[int, int] = SIZE) -> float:
    """The radius of the blur of a point, in pixels: similar triangles."""
    return camera.radius_mm * camera.image_distance_mm * abs(w - in_focus(camera)) / 1000 * size[0] / FILM[0]


def test_even_light_takes_the_falloff_of_the_thin_lens_and_nothing_else() -> None:
    camera = thin(11)
    found = blurred(camera, *flat(0.7, 0.2), samples=64)[..., 1]
    x = (np.arange(SIZE[0]) + 0.5) / SIZE[0] * FILM[0] - FILM[0] / 2
    falloff = 1 / (1 + (x / camera.image_distance_mm) ** 2) ** 2
    np.testing.assert_allclose(found[SIZE[1] // 2] / 0.7, falloff, rtol=1e-3)
    assert np.abs(np.diff(found[SIZE[1] // 2], 2)).max() < 1e-3  # without noise


def test_what_is_in_focus_stays_sharp() -> None:
    camera = thin()
    rgb, w = flat(0.0, in_focus(camera))
    rgb[:, ::2] = 1.0
    row = blurred(camera, rgb, w)[SIZE[1] // 2, 160:224, 1]
    # Read between pixels, a comb of one pixel keeps half of its contrast.
    assert row[::2].min() > 0.7 and row[1::2].max() < 0.3


def thin_disc(camera: ThinLens, w: float) -> tuple[float, float]:
    """The light of a point on the axis and its mean square radius in pixels, by quadrature.

    By similar triangles, and cos^4 of the ray from film point to pupil point over its mean for the plane in focus."""
    radius, v = camera.radius_mm, camera.image_distance_mm
    u = radius * np.sqrt((np.arange(4000) + 0.5) / 4000)
    x = u * v * (w - in_focus(camera)) / 1000  # in the lens frame, turned by 180 degrees
    weight = [1 / (1 + ((u - moved) / v) ** 2) ** 2 for moved in (x, 0 * x)]
    return weight[0].mean() / weight[1].mean(), np.average((x * SIZE[0] / FILM[0]) ** 2, weights=weight[0])


@pytest.mark.parametrize("w", [0.0, 2.0])
@pytest.mark.parametrize("side", [1, 21])  # a highlight, and a patch that is none
def test_a_bright_spot_becomes_the_disc_of_the_thin_lens(w: float, side: int) -> None:
    camera, highlight = thin(), side == 1
    rgb, depth = flat(0.0, w)
    half = side // 2
    rgb[108 - half : 109 + half, 192 - half : 193 + half] = 1e4 / side**2
    found = blurred(camera, rgb, depth, highlight, samples=512)[..., 1]
    y, x = np.mgrid[: SIZE[1], : SIZE[0]] + 0.5
    energy, moment = thin_disc(camera, w)
    total, away = found.sum(), np.hypot(x - 192.5, y - 108.5)
    assert total == pytest.approx(1e4 * energy, rel=0.003)
    assert (found * x).sum() / total == pytest.approx(192.5, abs=0.05)
    assert (found * y).sum() / total == pytest.approx(108.5, abs=0.05)
    # The spot's own size adds, and a pixel's: 1/6 of a square one, and as much of reading between pixels.
    expected = moment + (side**2 - 1) / 6 + (1 / 6 if highlight else 1 / 2)
    assert (found * away**2).sum() / total == pytest.approx(expected, rel=0.01, abs=0.1)
    if highlight:
        ring = (away > 1.5) & (away < 3)
        assert np.std(found[ring]) < 0.02 * np.mean(found[ring])  # without noise


def test_a_blurred_edge_lets_the_light_behind_it_through_as_the_part_of_the_disc_beside_it() -> None:
    """A black screen covers the left half, nearer than the white wall in focus: the share of the pupil beside it."""
    camera = thin()
    rgb, w = flat(1.0, in_focus(camera))
    rgb[:, :192], w[:, :192] = 0.0, 2.0
    found = blurred(camera, rgb, w)
    falloff = blurred(camera, *flat(1.0, in_focus(camera)))
    row = (found / falloff)[90:126, :, 1].mean(axis=0)
    radius = disc_px(camera, 2.0)
    away = np.clip((np.arange(SIZE[0]) + 0.5 - 192) / radius, -1, 1)
    share = (math.pi - np.arccos(away) + away * np.sqrt(1 - away**2)) / math.pi
    near = slice(192 - 2 * int(radius), 192 + 2 * int(radius))
    np.testing.assert_allclose(row[near], share[near], atol=0.03)


@pytest.mark.parametrize("post", [1.0, *whole(0.1)])
def test_blurred_edges_are_as_clean_as_the_samples_that_are_asked_for(post: float) -> None:
    """Posts nearer than what is in focus: every number of samples is taken, and the default has little noise."""
    camera = thin(size=STRIP)
    rgb, w = flat(0.5, in_focus(camera), STRIP)
    posts = np.arange(SIZE[0]) % 128 < 32
    rgb[:, posts], w[:, posts] = post, 2.0
    clean = blurred(camera, rgb, w, samples=512)
    noise = [rms(blurred(camera, rgb, w, samples=n) - clean) / rms(clean) for n in (16, SAMPLES, 256)]
    assert noise[1] < 0.007 and noise[0] > 1.3 * noise[1] and noise[1] > 1.3 * noise[2] > 0


def test_even_light_takes_few_samples() -> None:
    camera = thin()
    plate = plate_of(camera, flat(0.5, 2.0))
    assert _sizes(plate, spread_over(camera, plate), 512).max() == 3  # 8 samples


def test_a_sharp_screen_hides_the_blur_behind_it() -> None:
    camera = thin()
    rgb, w = flat(1.0, 0.0)
    rgb[:, :192], w[:, :192] = 0.0, in_focus(camera)
    row = blurred(camera, rgb, w)[SIZE[1] // 2, :, 1]
    assert row[:191].max() < 0.01 and row[194:220].min() > 0.9


def test_what_lies_behind_an_edge_comes_from_the_layer_behind() -> None:
    """A near screen before a wall that is red where the screen hides it: only the layer behind knows."""
    camera = thin()
    w_far = in_focus(camera)
    rgb, w = flat(1.0, w_far)
    rgb[:, :192], w[:, :192] = 0.0, 2.0
    hidden, far = flat(1.0, w_far)
    hidden[:, :192] = (1.0, 0.0, 0.0)
    one, two = plate_of(camera, (rgb, w)), plate_of(camera, (rgb, w), (hidden, far))
    alone, both = (gather(plate, camera, spread_over(camera, plate), 128) for plate in (one, two))
    assert alone.filled > 0.001 and both.filled < alone.filled / 20
    left = 192 - int(disc_px(camera, 2.0) / 2)
    assert alone.rgb[108, left, 1] > 0.15 and both.rgb[108, left, 1] < 0.02 < 0.15 < both.rgb[108, left, 0]


def test_the_light_of_hidden_highlights_is_counted_as_lost(recwarn: pytest.WarningsRecorder) -> None:
    """Posts before a far night full of lights: beside the same with the layer that the posts hide."""
    camera = thin(size=STRIP)
    rgb, w = flat(0.05, 0.0, STRIP)
    rgb[5::11, 3::13] = 20.0
    front, near = rgb.copy(), w.copy()
    posts = np.arange(SIZE[0]) % 64 < 32
    front[:, posts], near[:, posts] = 0.0, 2.0
    plates = (plate_of(camera, (front, near), *behind, size=STRIP) for behind in ((), ((rgb, w),)))
    one, two = (defocus(plate, camera, samples=32) for plate in plates)
    assert one.lost == pytest.approx(1 - one.rgb.sum() / two.rgb.sum(), rel=0.15) and one.lost > 0.05
    assert two.lost < 0.01 and f"{100 * one.lost:.1f}% of the light is lost" in str(recwarn[0].message)


def test_only_highlights_that_no_layer_shows_are_counted_as_lost() -> None:
    """Posts before a far night. The layer behind shows lights behind the lower halves of the posts, or a night without
    any: of the light of all, what is missing is as stated, or nothing is."""
    size = (384, 108)
    camera = thin(size=size)
    rgb, w = flat(0.05, 0.0, size)
    rgb[14::54, 3::13] = rgb[41::54, 10::13] = 20.0
    front, near = rgb.copy(), w.copy()
    posts = np.arange(SIZE[0]) % 64 < 32
    front[:, posts], near[:, posts] = 0.0, 2.0
    half, dark = w.copy(), flat(0.05, 0.0, size)
    half[: size[1] // 2] = -1.0
    behind = {"whole": (rgb, w), "half": (rgb, half), "dark": dark}
    found = {k: defocus(plate_of(camera, (front, near), v, size=size), camera, samples=8) for k, v in behind.items()}
    true = 1 - found["half"].rgb.sum() / found["whole"].rgb.sum()
    assert found["half"].lost == pytest.approx(true, rel=0.2) and true > 0.03
    assert found["dark"].lost < 1e-3


def test_planes_that_recede_have_no_edges() -> None:
    camera = thin()
    rgb, w = flat(1.0, 0.0)
    w[:] = np.linspace(0.05, 1.0, SIZE[1])[:, None]
    plate = plate_of(camera, (rgb, w))
    found = gather(plate, camera, spread_over(camera, plate), 64)
    assert found.filled < 1e-4


@pytest.fixture(scope="module")
def exact() -> Camera:
    return make_camera(f"fused:{GAUSS}", Shot(film_mm=FILM, focus_m=FOCUS_M, f_number=2.0))


def test_a_lens_moves_things_as_its_distortion_says_and_dims_them_as_its_pupil_does(exact: Camera) -> None:
    field = field_of(exact, FOCUS_M, "rectilinear", frame=frame_of(exact))
    rgb, depth = flat(0.0, 1 / (FOCUS_M - frame_of(exact).pupil_mm[0] / 1000))
    places = (320, 108), (360, 200)
    for i, j in places:
        rgb[j - 2 : j + 3, i - 2 : i + 3] = 1.0
    picture = blurred(exact, rgb, depth, samples=256)[..., 1]
    y, x = np.mgrid[: SIZE[1], : SIZE[0]] + 0.5
    for place in places:
        found = np.where(np.hypot(x - place[0], y - place[1]) < 40, picture, 0)
        centre = [(found * v).sum() / found.sum() for v in (x, y)]
        mm = complex(centre[0] - SIZE[0] / 2, SIZE[1] / 2 - centre[1]) * FILM[0] / SIZE[0]
        ideal = field.ideal(np.array([mm]))[0] * SIZE[0] / FILM[0]
        assert abs(ideal - complex(place[0] + 0.5 - SIZE[0] / 2, SIZE[1] / 2 - place[1] - 0.5)) < 0.1


@pytest.mark.parametrize("place", [(360.5, 197.5), *whole(((192.5, 108.5),))])
@pytest.mark.parametrize("w", [0.0, 2.0])
def test_kernels_have_the_light_that_the_camera_takes_from_the_point(
    exact: Camera, place: tuple[float, float], w: float
) -> None:
    """Against rays from the point through the front of the lens, traced the other way."""
    plate = plate_of(exact)
    kernel, pinhole = kernel_at(exact, plate, place, w, place), plate.pinhole
    assert kernel is not None
    rgb, depth = flat(0.0, w)
    row, column = int(place[1]), int(place[0])
    rgb[row - 10 : row + 11, column - 10 : column + 11] = 1.0
    gathered = blurred(exact, rgb, depth, samples=256)
    np.testing.assert_allclose(kernel.energy, gathered.sum(axis=(0, 1)) / 441, rtol=0.01)
    if w == 0:
        return
    z = 1 / w
    slope = (
        (place[0] - pinhole.centre_px[0]) / pinhole.reach_px[0],
        -(place[1] - pinhole.centre_px[1]) / pinhole.reach_px[1],
    )
    point = np.array([slope[0] * z, slope[1] * z, -z - pinhole.before_film_mm / 1000], np.float32)
    square, _ = stratified(300, (500.0, 600.0))
    count = square.shape[1]
    hit = cast(DifferentialCamera, exact).to_film(
        np.repeat(point[:, None], count, 1), square, np.full(count, 549.0, np.float32)
    )
    weight = hit.weight / hit.weight.sum()
    px = SIZE[0] / 2 - hit.film_mm[0] * SIZE[0] / FILM[0], SIZE[1] / 2 + hit.film_mm[1] * SIZE[0] / FILM[0]
    green = kernel.light[..., 1] / kernel.light[..., 1].sum()
    y, x = np.mgrid[: green.shape[0], : green.shape[1]] + 0.5
    for mine, theirs, corner in zip((x, y), px, kernel.corner_px, strict=True):
        mean, expected = (green * mine).sum() + corner, (weight * theirs).sum()
        assert mean == pytest.approx(expected, abs=0.1)
        spread = math.sqrt((green * (mine + corner - mean) ** 2).sum())
        assert spread == pytest.approx(math.sqrt((weight * (theirs - expected) ** 2).sum()), rel=0.02, abs=0.1)


@pytest.mark.parametrize(("up_mm", "w"), [(0.0, 1.3), *whole((12.0, 1.3), (0.0, 0.1), (12.0, 0.1))])
def test_kernels_of_white_points_have_the_light_that_passes_the_pupil_in_each_colour(up_mm: float, w: float) -> None:
    """Without Newton's method, areas or a pupil's grid: rays of all the film, pupil and light that see a square."""
    shot, count, side, (width, height) = (
        Shot((4.5, 30.0), 1.2, f_number=1.4, wavelength_nm=LIGHT_NM),
        1 << 20,
        48,
        (360, 2400),
    )
    camera = make_camera(str(ROOT / "lenses" / "leica_summilux_m_50mm_f1_4.toml"), shot)
    plate, place = own_plate(camera, (width, height)), (width / 2, height / 2 - up_mm * height / 30)
    kernel = kernel_at(camera, plate, place, w, place)
    assert kernel is not None
    points = (sobol(count, 5) + 0.5) / 2.0**32
    reach = np.array(kernel.light.shape[1::-1]) + 2 * side
    film = np.subtract(kernel.corner_px, side)[:, None] + reach[:, None] * points[:2]
    light = SpectralRange(*LIGHT_NM, 64)
    wave = (points[4] * 64).astype(int)
    pupil = points[2:4].astype(np.float32)
    rays = RayTable(camera, plate, pupil, np.zeros(count, np.float32)).at(film, pupil, light.centres_nm[wave])
    seen = (np.abs(rays[:, :2] + w * rays[:, 2:4] - place) < side / 2).all(axis=1) * rays[:, 4]
    white = light.response * light.basis.sum(axis=0)
    expected = (white[:, wave] * seen).mean(axis=1, dtype=np.float64) * reach.prod() / side**2
    np.testing.assert_allclose(kernel.tinted(tint(camera)).energy, expected, rtol=8e-3)
    assert kernel.tinted(tint(camera)).energy.sum() == pytest.approx(expected.sum(), rel=5e-3)


def test_a_point_on_the_axis_of_a_moved_film_has_the_disc_of_a_centred_one() -> None:
    """The pupil turns about the axis, wherever the film has its middle: 4 and 2 mm are 100 and 50 pixels."""
    shot, found = Shot((24.0, 16.0), 3.0, 4.0), list[np.ndarray]()
    for moved, at in ({}, (300.0, 200.0)), ({"film_shift_mm": 4.0, "film_rise_mm": -2.0}, (200.0, 150.0)):
        camera = make_camera(str(ROOT / "models" / "laikin_double_gauss_50.ols-36.onnx"), replace(shot, **moved))
        plate = own_plate(camera, (600, 400))
        assert plate.pinhole.centre_px == pytest.approx(at)
        kernel = kernel_at(camera, plate, at, 1.0, at)
        assert kernel is not None
        assert kernel.middle_px == pytest.approx(at, abs=0.01)
        found.append(kernel.light)
    np.testing.assert_allclose(found[1], found[0], atol=1e-3 * found[0].max())


def test_discs_have_the_corners_of_a_stop_of_three_blades() -> None:
    """Behind the focus a disc stands as the stop does: its first corner at 20 degrees, two thirds of a turn apart."""
    model, sizes = str(ROOT / "models" / "laikin_double_gauss_50.ols-36.onnx"), list[float]()
    for name in (model, "thin"):
        camera = make_camera(name, Shot((24.0, 16.0), 2.0, 2.8, aperture=Aperture(3, 20.0)))
        kernel = kernel_at(camera, own_plate(camera, (1200, 800)), (600.0, 400.0), 0.0, (600.0, 400.0))
        assert kernel is not None
        green = kernel.light[..., 1].astype(np.float64) / kernel.light[..., 1].sum()
        y, x = np.mgrid[: green.shape[0], : green.shape[1]]
        off = x - 1j * y - (green * (x - 1j * y)).sum()
        corners = (green * off**3).sum()  # of a triangle
        assert math.degrees(np.angle(corners)) / 3 == pytest.approx(20, abs=1)
        sizes.append(abs(corners) ** (1 / 3))
    assert sizes[0] == pytest.approx(sizes[1], rel=0.1)
    ring = np.ones((64, 64))
    ring[16:48, 16:48] = 0
    check_field(make_camera("thin", Shot((24.0, 16.0), 2.0, 2.8, aperture=Aperture(mask=ring))))  # dark in the middle


def test_a_moved_film_takes_the_highlights_at_its_edge() -> None:
    """The plate's pinhole is not moved: its light 16 mm right of the axis is 4 mm from the middle of the film."""
    camera = make_camera(
        str(ROOT / "models" / "laikin_double_gauss_50.ols-36.onnx"), Shot((24.0, 16.0), 1.0, 2.0, film_shift_mm=12.0)
    )
    size, rgb, w = (120, 80), np.zeros((80, 240, 3), np.float32), np.zeros((80, 240), np.float32)
    rgb[40, 200] = 1000.0
    frame = frame_of(camera)
    pinhole = PlatePinhole((frame.reach_mm[0] * 5, frame.reach_mm[1] * 5), (120.0, 40.0), frame.pupil_mm[1])
    found = defocus(Plate([Layer(rgb, w)], pinhole, size), camera, 8)
    assert found.highlights == 1 and 700 < found.rgb[..., 1].sum() < 1000  # less the lens's vignetting
    assert found.rgb[..., 1].sum(0).argmax() == pytest.approx(60 + 20, abs=4)


def test_the_middle_of_a_disc_on_the_axis_is_smooth() -> None:
    """The light in the middle five pixels continues the parabola about them, on the axis and one pixel beside it."""
    size = (3840, 2560)
    camera = make_camera("fused:leica_summilux_m_35mm_f1_4_asph_v1", Shot((36.0, 24.0), focus_m=0.7, f_number=1.4))
    for off in (0.0, 1.0):
        place = size[0] / 2 + off, size[1] / 2
        kernel = kernel_at(camera, plate_of(camera, size=size), place, 0.0, place)
        assert kernel is not None
        column, row = (int(m) - c for m, c in zip(place, kernel.corner_px, strict=True))
        part = kernel.light[row - 10 : row + 10, column - 10 : column + 10, 1].astype(np.float64)
        y, x = np.mgrid[-10:10, -10:10] + 0.5
        beside = np.hypot(x, y) > 5
        terms = np.stack([np.ones_like(x), x, y, x * x, y * y], 2)
        found = np.linalg.lstsq(terms[beside], part[beside], rcond=None)[0]
        assert np.abs(part / (terms @ found) - 1).max() < 0.02


def test_highlights_behind_something_near_are_hidden() -> None:
    camera = thin()
    rgb, w = flat(0.0, 0.0)
    rgb[108, 194] = 1e4
    w[:, :192] = in_focus(camera)
    found = blurred(camera, rgb, w, highlights=True)[..., 1]
    assert found[:, :191].max() < 1e-3 * found.max()
    away = -2.5 / disc_px(camera, 0.0)  # of the screen from the disc's centre, in its radii
    share = (math.pi - math.acos(away) + away * math.sqrt(1 - away**2)) / math.pi
    share = 1 - share if share < 0.5 else share
    free = blurred(camera, rgb, np.zeros_like(w), highlights=True)[..., 1]
    assert found.sum() / free.sum() == pytest.approx(share, abs=0.02)


def test_threads_and_empty_layers_change_nothing() -> None:
    camera = thin()
    random = np.random.default_rng(3)
    rgb, w = random.random((54, 96, 3)), np.where(random.random((54, 96)) < 0.5, 0.2, 0.9)
    one, three = (blurred(camera, rgb, w, samples=16, threads=n) for n in (1, 3))
    np.testing.assert_array_equal(one, three)
    assert np.isfinite(one).all() and one.min() >= 0


def plate_file(path: Path, depth: np.ndarray | None, more: dict[str, np.ndarray] | None = None) -> Path:
    planes = {c: np.full(SIZE[::-1], 0.5, np.float32) for c in "RGB"}
    planes |= {} if depth is None else {"Z": depth.astype(np.float32)}
    write_channels(path, planes | {k: v.astype(np.float32) for k, v in (more or {}).items()})
    return path


def command(plate: Path, out: Path, *more: str) -> list[str]:
    return ["defocus", str(plate), "--lens", "thin", "--film", "36x20.25", "--focus", "2", "-o", str(out), *more]


def test_the_command_writes_a_picture_with_its_camera(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    plate = plate_file(tmp_path / "plate.exr", np.full(SIZE[::-1], 3.0))
    data = run_json(capsys, *command(plate, tmp_path / "out.exr", "--samples", "16"))
    rgb, metadata = read_exr(tmp_path / "out.exr")
    assert rgb.shape == (SIZE[1], SIZE[0], 3) and rgb[108, 192] == pytest.approx([0.5] * 3, rel=0.01)
    assert metadata["camera"]["camera"] == "thin" and metadata["defocus"]["plate"] == "plate.exr"
    assert data["layers"] == 1 and (tmp_path / "out.png").is_file()
    run_json(capsys, *command(plate, tmp_path / "raw.exr", "--samples", "8", "--electrons", "1000", "--noise", "none"))
    planes, metadata = read_channels(tmp_path / "raw.exr")
    electrons = (planes["raw"] - metadata["sensor"]["black_level"]) * metadata["sensor"]["electrons_per_number"]
    np.testing.assert_allclose(electrons, 1000 * planes["G"], atol=2)
    write_channels(tmp_path / "blurred.exr", read_channels(plate)[0], None, metadata)  # blur of blur is no lens's
    assert "camera: got 'thin', expected 'pinhole'" in failure(
        capsys, *command(tmp_path / "blurred.exr", tmp_path / "twice.exr")
    )


def test_layers_of_a_file_are_found_by_their_names(tmp_path: Path) -> None:
    far = np.full(SIZE[::-1], 5.0)
    names = {f"ViewLayer.Combined.{c}": far * 0.1 for c in "RGBA"} | {"ViewLayer.Depth.Z": far}
    planes = {k: v.astype(np.float32) for k, v in names.items()}
    write_channels(tmp_path / "blender.exr", planes)
    frame = frame_of(thin())
    plate = read_plate(tmp_path / "blender.exr", FILM, frame, DepthSettings())
    assert len(plate.layers) == 1 and plate.layers[0].texel[0, 0, 3] == pytest.approx(0.2)
    path = plate_file(tmp_path / "two.exr", far / 2, more={f"behind.{c}": far for c in "RGBZ"})
    plate = read_plate(path, FILM, frame, DepthSettings(), [tmp_path / "blender.exr"])
    assert [layer.texel[0, 0, 3] for layer in plate.layers] == pytest.approx([0.4, 0.2, 0.2])


def test_depth_may_be_in_another_part(tmp_path: Path) -> None:
    """As compositing programs write it: colours in one part, depth in the next; a third repeats names."""
    full = np.full(SIZE[::-1], 0.5, np.float32)
    parts = [
        OpenEXR.Part({}, {c: full * k for c in names}, name)
        for name, names, k in (("rgb", "RGB", 1), ("depth", ["Z"], 8), ("far", "RGBZ", 20))
    ]
    OpenEXR.File(parts).write(str(tmp_path / "parts.exr"))
    front, behind = read_plate(tmp_path / "parts.exr", FILM, frame_of(thin()), DepthSettings()).layers
    assert front.texel[0, 0] == pytest.approx([0.5, 0.5, 0.5, 0.25])
    assert behind.texel[0, 0] == pytest.approx([10, 10, 10, 0.1])


def test_lights_that_two_layers_show_are_spread_once() -> None:
    """A layer behind is a whole picture without the things in front: it shows the lights beside them, too."""
    camera = thin()
    rgb, w = flat(0.0, 0.0)
    rgb[108, 194] = 1e4
    plate = plate_of(camera, (rgb, w), (rgb, w))
    lights = [len(take_highlights(plate, k, spread_over(camera, plate)).light) for k in (0, 1)]
    assert lights == [1, 0] and plate.layers[1].texel[108, 194, 0] < 1e4


def test_samples_of_a_deep_file_are_layers(tmp_path: Path) -> None:
    def samples(near: float, far: float) -> np.ndarray:
        cells = np.empty(SIZE[::-1], object)
        for j in range(SIZE[1]):
            for i in range(SIZE[0]):
                cells[j, i] = np.array([far, near][: 2 - (i < 192)], np.float32)
        return cells

    channels = {"R": samples(0.1, 0.9), "G": samples(0.1, 0.9), "B": samples(0.1, 0.9), "A": samples(1, 1)}
    channels["Z"] = samples(1.0, 4.0)
    header = {"compression": OpenEXR.ZIPS_COMPRESSION, "type": OpenEXR.deepscanline}
    OpenEXR.File(header, channels).write(str(tmp_path / "deep.exr"))
    front, behind = read_plate(tmp_path / "deep.exr", FILM, frame_of(thin()), DepthSettings()).layers
    assert front.texel[5, 200] == pytest.approx([0.1, 0.1, 0.1, 1.0]) and front.texel[5, 9, 3] == pytest.approx(0.25)
    assert behind.texel[5, 200] == pytest.approx([0.9, 0.9, 0.9, 0.25]) and behind.texel[5, 9, 3] < 0


def test_overscan_is_beyond_the_film(tmp_path: Path) -> None:
    """A plate with a border of 10 pixels, white outside the film: it is not seen where nothing blurs."""
    border = 10
    planes = {c: np.ones((SIZE[1] + 2 * border, SIZE[0] + 2 * border), np.float32) for c in "RGB"}
    for plane in planes.values():
        plane[border:-border, border:-border] = 0.0
    window = {"displayWindow": ((0, 0), (SIZE[0] - 1, SIZE[1] - 1))}
    window["dataWindow"] = ((-border, -border), (SIZE[0] + border - 1, SIZE[1] + border - 1))
    planes["Z"] = np.full(planes["R"].shape, FOCUS_M - thin().image_distance_mm / 1000, np.float32)
    as_arrays = {k: tuple(np.array(v, np.int32) for v in w) for k, w in window.items()}
    write_channels(tmp_path / "wide.exr", planes, attributes=as_arrays)
    plate = read_plate(tmp_path / "wide.exr", FILM, frame_of(thin()), DepthSettings())
    assert plate.size == SIZE and plate.layers[0].size == (SIZE[0] + 20, SIZE[1] + 20)
    camera = thin()
    found = gather(plate, camera, spread_over(camera, plate), 16)
    assert found.rgb[2:-2, 2:-2].max() < 1e-3 and found.beyond == 0


def test_highlights_of_overscan_lie_where_they_are_seen() -> None:
    """A light in the border, just off the film: its disc reaches the picture, as the closed form says."""
    camera, border = thin(), 20
    pinhole = plate_of(camera).pinhole
    pinhole = PlatePinhole(
        pinhole.reach_px, (pinhole.centre_px[0] + border, pinhole.centre_px[1] + border), pinhole.before_film_mm
    )
    rgb, w = flat(0.0, 2.0, (SIZE[0] + 2 * border, SIZE[1] + 2 * border))
    rgb[108 + border, border - 5] = 1e4  # 4.5 pixels from the edge
    rgb_before = rgb.copy()
    plate = replace(plate_of(camera, (rgb, w)), pinhole=pinhole)
    taken = take_highlights(plate, 0, spread_over(camera, plate))
    picture = np.zeros((SIZE[1], SIZE[0], 3), np.float32)
    spread_highlights(picture, taken, plate, camera)
    # The same light within a film that is as much larger.
    wide = ThinLens(50.0, 1.4, FOCUS_M, (FILM[0] * w.shape[1] / SIZE[0], FILM[1] * w.shape[0] / SIZE[1])).compiled()
    whole = blurred(wide, rgb_before, w, highlights=True)[border:-border, border:-border]
    np.testing.assert_allclose(picture, whole, atol=0.01 * whole.max())
    rows = np.flatnonzero(picture[..., 1].sum(axis=1) > 1)
    assert rows.mean() + 0.5 == pytest.approx(108.5, abs=0.6)


@pytest.mark.parametrize(
    ("depth", "more", "said"),
    [
        (None, [], "a channel Z with the depth"),
        (np.full(SIZE[::-1], -3.0), [], "--depth-scale -1"),
        (np.full(SIZE[::-1], np.nan), [], "not a number in any pixel"),
        (np.geomspace(1e-4, 3, SIZE[0] * SIZE[1]).reshape(SIZE[::-1]), [], "not their inverse"),
        (np.linspace(0, 1, SIZE[0] * SIZE[1]).reshape(SIZE[::-1]), [], "depth in metres"),
        (np.full(SIZE[::-1], 3.0), ["--depth", "W"], "one of: "),
        (np.full(SIZE[::-1], 3.0), ["--film", "36x36"], "a picture of the film's shape"),
        (np.full(SIZE[::-1], 3.0), ["--lens", "fisheye-equidistant", "--focal-length", "8"], "a plate is a plane"),
        (np.full(SIZE[::-1], 3.0), ["--depth-scale", "0"], "metres of a unit"),
        (None, ["--bits", "8", "--black-level", "255"], "black_level: got 255, expected at most 254"),
        (None, ["--black-level", "16383"], "black_level: got 16383, expected at most 16382"),
    ],
)
def test_bad_input_gets_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], depth: np.ndarray | None, more: list[str], said: str
) -> None:
    plate = plate_file(tmp_path / "plate.exr", depth)
    assert said in failure(capsys, *command(plate, tmp_path / "out.exr", *more))
    assert not (tmp_path / "out.exr").exists()


def test_an_atlas_has_kernels_of_sum_one_about_the_middles_of_its_cells(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    given = ["bokeh", GAUSS, "--width", 384, "--film", "36x20.25", "--focus", 2, "--f-number", 2]
    data = run_json(capsys, *given, "--distance", 1, "--distance", "inf", "--grid", "3x1", "-o", tmp_path / "a")
    side = data["kernel_px"]
    assert [Path(f).name for f in data["files"]] == ["a.1m.exr", "a.inf.exr"] and side % 2
    for file in data["files"]:
        picture, metadata = read_exr(file)
        assert picture.shape == (side, 3 * side, 3) and len(metadata["kernels"]) == 3
        cells = picture.reshape(side, 3, side, 3).swapaxes(0, 1)
        np.testing.assert_allclose(cells.sum(axis=(1, 2)), 1, rtol=1e-4)
        middle = (cells[..., 1].sum(axis=1) * (np.arange(side) + 0.5)).sum(axis=1)
        np.testing.assert_allclose(middle, side / 2, atol=0.6)
        # The lens is round; the middles of these cells lie on borders of pixels, and roundings choose the side.
        turned = [np.roll(cells[2][:, ::-1], k, axis=(0, 1)) for k in itertools.product((-1, 0, 1), repeat=2)]
        assert min(np.abs(cells[0] - other).max() for other in turned) < 0.02 * cells.max()
    light = [k["light"][1] for k in data["kernels"][:3]]
    assert light[0] == pytest.approx(light[2], rel=1e-3) and light[0] < 0.95 * light[1]


def test_distances_within_the_lens_are_refused_before_any_kernel() -> None:
    done = list[float]()
    with pytest.raises(InputError, match=r"distance_m: got 0\.01, expected above 0\.05"):
        kernels_over(thin(), SIZE, (2.0, 0.01), (1, 1), report=done.append)
    assert not done


def test_a_kernel_has_the_area_of_rays_traced_from_the_point(exact: Camera) -> None:
    """Pixels above half of the mean, against a histogram of camera rays that see a small patch there."""
    plate, place, w = plate_of(exact), (330.5, 150.5), 2.5
    kernel = kernel_at(exact, plate, place, w, place)
    assert kernel is not None
    height, width = kernel.light.shape[:2]
    random, count = np.random.default_rng(5), 1_500_000
    px = np.array(kernel.corner_px)[:, None] + np.array([[width], [height]]) * random.random((2, count))
    film = np.stack([-(px[0] / SIZE[0] - 0.5) * FILM[0], (px[1] / SIZE[1] - 0.5) * FILM[1]]).astype(np.float32)
    rays = exact.sample(film, random.random((2, count)).astype(np.float32), np.full(count, 549.0, np.float32))
    lines = plate.pinhole.lines(rays.origin_m, rays.direction)
    seen = np.hypot(lines[0] + w * lines[2] - place[0], lines[1] + w * lines[3] - place[1]) < 1.5
    weight = rays.weight * (seen & (rays.status == 0))
    cells = [(px[k] - kernel.corner_px[k]).astype(int) for k in (0, 1)]
    found = np.bincount(cells[1] * width + cells[0], weight, width * height).reshape(height, width)
    areas = [(image > 0.5 * image[image > 0].mean()).sum() for image in (kernel.light[..., 1], found)]
    assert areas[0] == pytest.approx(areas[1], rel=0.03)
    mine = kernel.light[..., 1] / kernel.light[..., 1].sum()
    assert np.abs(mine - found / found.sum()).sum() < 0.25  # a patch of 3 pixels softens the rim


def test_a_plate_of_our_own_says_its_pinhole_and_its_film(tmp_path: Path, scene: Path) -> None:
    """The same scene on a film twice as large is overscan: the same picture, and nothing from beyond it."""
    given = ["render", scene, "--camera", "pinhole", "--samples", "4", "--quiet"]
    assert main([*map(str, given), "--film", "36x20.25", "--width", "64", "-o", str(tmp_path / "a.exr")]) == 0
    assert main([*map(str, given), "--film", "72x40.5", "--width", "128", "-o", str(tmp_path / "b.exr")]) == 0
    camera = thin(1.0)
    plates = [read_plate(tmp_path / f"{name}.exr", FILM, frame_of(camera), DepthSettings()) for name in "ab"]
    assert [plate.size for plate in plates] == [(64, 36)] * 2 and plates[1].layers[0].size == (128, 72)
    assert plates[0].pinhole.before_film_mm == 50.0
    # Depth counts from the film, 50 mm behind the hole; the ball's front is 1.9 m from it, 0.4 m off the axis.
    assert 1 / plates[0].layers[0].texel[..., 3].max() == pytest.approx(2.0 - 0.1 - 0.05, abs=0.02)
    one, two = (gather(p, camera, spread_over(camera, p), 64) for p in plates)
    assert two.beyond == 0 and one.beyond > 0
    np.testing.assert_allclose(one.rgb[4:-4, 4:-4].mean(axis=(0, 1)), two.rgb[4:-4, 4:-4].mean(axis=(0, 1)), rtol=0.01)
    # The weight of the hole, cos^4, is taken out: what is left is the radiance of the white surroundings.
    np.testing.assert_allclose(plates[0].layers[0].texel[:6, :6, :3].mean(axis=(0, 1)), 1, rtol=0.03)


def test_highlights_before_and_behind_the_focus_have_their_own_kernels() -> None:
    """Two lights close together, as blurred as each other, one nearer and one farther than what is in focus."""
    camera = thin()
    rgb, w = flat(0.0, 0.0)
    reach = in_focus(camera) * 0.9
    rgb[108, 190], rgb[108, 194] = 1e4, 1e4
    w[108, 190], w[108, 194] = in_focus(camera) - reach, in_focus(camera) + reach
    found = blurred(camera, rgb, w, highlights=True)[..., 1]
    assert found.max() < 3 * 1e4 / (math.pi * disc_px(camera, in_focus(camera) - reach) ** 2)


def test_a_light_too_wide_for_a_kernel_stays_among_the_others() -> None:
    camera = thin(0.7)
    size = (96, 54)
    plate = plate_of(camera, flat(0.0, 400.0, size), size=size)
    layer = plate.layers[0]
    layer.texel[20, 40, :3] = 1e4
    assert not len(take_highlights(plate, 0, spread_over(camera, plate)).radius_px)
    assert layer.texel[20, 40, 0] == 1e4


def test_alpha_says_where_a_layer_has_nothing(tmp_path: Path) -> None:
    """A screen on a transparent film before a white wall; colours are premultiplied."""
    solid = np.zeros(SIZE[::-1], np.float32)
    solid[:, :192] = 0.8
    planes = {"R": 0.4 * solid, "G": 0.4 * solid, "B": 0.4 * solid, "A": solid, "Z": np.where(solid > 0, 1.0, 1e10)}
    far = {f"far.{c}": np.full(SIZE[::-1], 3.0 if c == "Z" else 1.0) for c in "RGBZ"}
    write_channels(tmp_path / "a.exr", {k: v.astype(np.float32) for k, v in (planes | far).items()})
    plate = read_plate(tmp_path / "a.exr", FILM, frame_of(thin()), DepthSettings())
    front = plate.layers[0].texel
    assert front[5, 9] == pytest.approx([0.4, 0.4, 0.4, 1.0]) and front[5, 300, 3] < 0
    camera = thin()
    alone, both = (
        gather(some, camera, spread_over(camera, some), 64).rgb[108, :, 1]
        for some in (replace(plate, layers=plate.layers[:1]), plate)
    )
    assert alone[300] == 0 and both[300] == pytest.approx(0.97, abs=0.04)
    assert alone[192] == pytest.approx(alone[60] / 2, rel=0.2)  # the edge fades into nothing


def test_pixels_that_a_plate_states_are_those_of_the_lens(tmp_path: Path) -> None:
    """A 2:1 plate through a round lens, and a square one through a lens that squeezes 2:1; 1.8 is near to that."""
    round_lens = frame_of(thin())
    squeezes = round_lens._replace(reach_mm=(round_lens.reach_mm[0] / 2, round_lens.reach_mm[1]))
    planes = {c: np.full(SIZE[::-1], 2.0, np.float32) for c in "RGBZ"}
    for stated, frame, said in ((2.0, round_lens, "1,"), (1.8, squeezes, ""), (1.5, squeezes, "2,")):
        write_channels(tmp_path / "a.exr", planes, attributes={"pixelAspectRatio": stated})
        with pytest.raises(InputError, match=f"pixelAspectRatio.*expected {said}") if said else nullcontext():
            read_plate(tmp_path / "a.exr", FILM, frame, DepthSettings())
    write_channels(tmp_path / "a.exr", planes)
    with pytest.warns(NeurolensWarning, match="2 times as wide"):
        read_plate(tmp_path / "a.exr", FILM, squeezes, DepthSettings())


@pytest.mark.parametrize("window", [(360000, 240000), (20000, 11250)])
def test_a_picture_larger_than_memory_is_refused_before_it_is_made(tmp_path: Path, window: tuple[int, int]) -> None:
    planes = {c: np.full((18, 32), 2.0, np.float32) for c in "RGBZ"}
    box = tuple(np.array(v, np.int32) for v in ((0, 0), (window[0] - 1, window[1] - 1)))
    data = tuple(np.array(v, np.int32) for v in ((0, 0), (31, 17)))
    write_channels(tmp_path / "a.exr", planes, attributes={"displayWindow": box, "dataWindow": data})
    with pytest.raises(InputError, match="pixels"):
        read_plate(tmp_path / "a.exr", (36.0, 36.0 * window[1] / window[0]), frame_of(thin()), DepthSettings())


def test_depth_below_a_metre_is_taken_where_its_unit_is_stated(tmp_path: Path) -> None:
    plate = plate_file(tmp_path / "macro.exr", np.linspace(300, 700, SIZE[0] * SIZE[1]).reshape(SIZE[::-1]))
    layer = read_plate(plate, FILM, frame_of(thin()), DepthSettings(scale_m=1e-3)).layers[0]
    assert layer.texel[0, 0, 3] == pytest.approx(1 / 0.3, rel=1e-3)


@pytest.mark.parametrize("colour", [(1.0, 1.0, 1.0), (0.9, 0.3, 0.1)])
def test_a_plain_wall_has_the_colour_that_a_path_tracer_gives_it(colour: tuple[float, ...], tmp_path: Path) -> None:
    """Through coated glass, whose films and absorption tint the picture; 1% off with three colours each by itself."""
    scene = "[camera]\nposition_m = [0, 0, 0]\nlook_at_m = [0, 0, -1]\nfocus_m = 5\n[environment]\ncolour = {}\n"
    (path := tmp_path / "wall.toml").write_text(scene.format(list(colour)))
    shot = Shot((1.8, 1.2), 5.0, f_number=1.4, wavelength_nm=(400.0, 700.0))
    camera = make_camera(str(ROOT / "lenses" / "leica_summilux_m_50mm_f1_4.toml"), shot)
    traced = render(load_scene(path), camera, width=12, height=8, samples=2048, threads=1).rgb.mean(axis=(0, 1))
    wall = plate_of(camera, (np.full((8, 12, 3), colour), np.full((8, 12), 0.3)), size=(12, 8))
    with pytest.warns(NeurolensWarning, match="overscan"):
        found = defocus(wall, camera).rgb.mean(axis=(0, 1))
    assert found == pytest.approx(traced, rel=3e-3)
