"""A sensor's pixels: contrast of edges by lens and pixel, statistics of photons, wells, mosaics; the same in tiles."""

import math
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from command_line import failure
from numpy.typing import NDArray

from neurolens.base.errors import InputError
from neurolens.base.settings import with_changes
from neurolens.cameras.build import make_camera
from neurolens.cameras.exact import ExactCamera
from neurolens.cli import main
from neurolens.optics.analysis.fields import Scene as Analysed
from neurolens.optics.analysis.spots import mtf, spots
from neurolens.optics.lens.shot import Shot
from neurolens.optics.readers.lensfile import read_lens
from neurolens.optics.setting.states import set_lens
from neurolens.pictures.frames import Frame, prepare, write_pictures
from neurolens.pictures.render.pictures import read_channels, read_metadata
from neurolens.pictures.render.renderer import render
from neurolens.pictures.render.scene import scene_from_tables
from neurolens.pictures.render.sensor import RAW, about, expose
from neurolens.pictures.render.settings import FilmSettings, SensorSettings

ROOT = Path(__file__).parents[3]
TRIPLET, SONNAR = ROOT / "lenses" / "cooke_triplet_50.toml", ROOT / "lenses" / "sony_sonnar_55.toml"
MODEL = ROOT / "models" / "laikin_double_gauss_50.ols-60.onnx"
NM, FOCUS_M, PITCH_MM, TILT = 587.56, 2.0, 0.01, 1 / 16
ACROSS, DOWN, BAND = 64, 1984, 64  # pixels; a band about the edge is rendered
STILL = SensorSettings(mosaic="none", noise="none", bits=16, black_level=0)


def edge(y_m: float) -> dict[str, Any]:
    """A bright card in the plane in focus, whose lower edge passes through a point of the y axis, slanted."""
    along = np.array([1, TILT, 0]) / math.hypot(1, TILT)
    up = np.array([-along[1], along[0], 0])
    corner = np.array([0, y_m, -FOCUS_M]) - 0.1 * along
    return {"corner_m": corner.tolist(), "edge_u_m": (0.2 * along).tolist(), "edge_v_m": (0.1 * up).tolist(),
            "emission": [1, 1, 1]}  # fmt: skip


@cache
def of_triplet(shot: Shot) -> ExactCamera:
    return ExactCamera(read_lens(TRIPLET), replace(shot, runtime="c"))


def contrast(picture: NDArray[Any], at: float, frequency: NDArray[Any]) -> NDArray[Any]:
    """MTF at frequencies in cycles a pixel by the method of ISO 12233, of an edge in a row near `at`.

    The edge's places in the columns are fitted by a line; pixels are averaged by their distance from it in quarters of
    a pixel; the transform of the derivative is divided by those of the quarters and of the difference.
    """
    half, flat, over = 26, 12, 4
    rows, columns = np.arange(int(at) - half, int(at) + half), np.arange(picture.shape[1]) + 0.5
    part = picture[rows]
    step = np.diff(part, axis=0) * np.hanning(len(part) - 1)[:, None]
    places = ((rows[:-1, None] + 1.0) * step).sum(0) / step.sum(0)
    slope, offset = np.polyfit(columns, places, 1)
    assert abs(abs(slope) - TILT) < 0.002
    away = (rows[:, None] + 0.5 - slope * columns - offset) / math.hypot(1, slope)
    lit = (np.abs(away) > flat) & (part > 0.5 * part.max())
    part = part / np.polyval(np.polyfit(away[lit], part[lit], 1), away)  # the lens darkens towards its edge
    number, reach = np.floor(away * over + 0.5).astype(int), (half - 4) * over
    inside = np.abs(number) <= reach
    spread = np.bincount(number[inside] + reach, part[inside]) / np.bincount(number[inside] + reach)
    x = (np.arange(-reach, reach) + 0.5) / over
    window = 0.5 + 0.5 * np.cos(math.pi * ((np.abs(x) - flat) / (half - 4 - flat)).clip(0, 1))
    found = np.abs(np.exp(-2j * math.pi * frequency[:, None] * x) @ (np.diff(spread) * window))
    return found / found[0] / np.sinc(frequency / over) ** 2


@pytest.mark.parametrize(
    ("height_mm", "fill", "glass_mm"), [(0.0, 1.0, 0.0), (3.5, 1.0, 0.0), (7.0, 1.0, 0.0), (3.5, 0.25, 2.0)]
)
def test_mtf_of_a_slanted_edge_is_that_of_the_lens_times_the_pixels(
    height_mm: float, fill: float, glass_mm: float
) -> None:
    film = (ACROSS * PITCH_MM, DOWN * PITCH_MM)
    shot = Shot(film, FOCUS_M, 5.6, wavelength_nm=(NM, NM), cover_glass_mm=glass_mm)
    camera = of_triplet(shot)
    lens = Analysed(camera.lens, FOCUS_M, "y")
    (field,) = lens.fields_at([height_mm])
    points = lens.object_points(lens.chief_rays([field]).start)
    assert points is not None
    y_m = float(points[1][0]) / 1000
    scene = scene_from_tables(
        {"camera": {"position_m": [0, 0, 0], "look_at_m": [0, 0, -1], "focus_m": FOCUS_M, "wavelength_nm": [NM, NM]},
         "quads": [edge(y_m)]}
    )  # fmt: skip
    at = DOWN / 2 - height_mm / PITCH_MM
    first = 32 * (round(at / 32) - 1)
    result = render(
        scene, camera, width=ACROSS, height=DOWN, samples=256, threads=1, max_depth=1,
        film=FilmSettings(wavelengths="one", fill_factor=fill), rows=(first, first + BAND),
    )  # fmt: skip
    rgb = result.rgb / result.rgb.max()
    frequency = np.arange(0, 0.51, 0.05)
    found = contrast(expose(rgb, STILL)[f"{RAW}.G"].astype(float), at - first, frequency)
    traced = mtf(lens, [field], [NM], frequency_per_mm=(frequency / PITCH_MM).tolist()).tangential[0]
    side = math.sqrt(fill) / math.hypot(1, TILT)
    pixel = np.sinc(frequency * side) * np.sinc(frequency * side * TILT)
    assert pixel[-1] < 0.95 * (1.0 if fill == 1 else 1.1) and traced[-1] < 0.9  # both blur
    np.testing.assert_allclose(found, traced * pixel, rtol=0, atol=0.01)


def flat(value: float, side: int = 400) -> NDArray[np.float32]:
    return np.full((side, side, 3), value, np.float32)


@pytest.mark.parametrize("electrons", [0.5, 20.0, 1000.0, 20_000.0])
def test_variance_is_photons_and_reading(electrons: float) -> None:
    settings = SensorSettings(mosaic="none", electrons=electrons, read_noise=5.0, bits=16)
    read, told = expose(flat(1.0), settings, seed=3), about(settings, 3)
    counted = np.stack([read[f"{RAW}.{c}"].astype(float) for c in "RGB"])
    counted = (counted - told["black_level"]) * told["electrons_per_number"]
    expected = electrons + 25 + told["electrons_per_number"] ** 2 / 12
    sure = 5 / math.sqrt(counted.size)  # standard deviations
    assert counted.mean() == pytest.approx(electrons, abs=sure * math.sqrt(expected))
    assert counted.var() == pytest.approx(expected, rel=sure * math.sqrt(2 + 1 / expected))
    noise = counted - counted.mean()
    for other in (noise[1], np.roll(noise[0], 1, 0), np.roll(noise[0], 1, 1)):  # colours, rows, columns
        assert abs((noise[0] * other).mean()) < 5 * expected / math.sqrt(noise[0].size)


def test_wells_fill_and_darkness_reads_the_black_level() -> None:
    settings = SensorSettings(electrons=1000.0, full_well=5000.0, read_noise=0.0, bits=12, black_level=100)
    for value in (50.0, 1e30):
        assert (expose(flat(value, 8), settings)[RAW] == 4095).all()
    for value in (0.0, -1.0):  # below 0: beyond the gamut of sRGB
        assert (expose(flat(value, 8), settings)[RAW] == 100).all()
    noisy = expose(flat(50.0), SensorSettings(electrons=1000.0, full_well=5000.0, read_noise=50.0, bits=12))[RAW]
    assert noisy.max() == 4095 and 3 < np.std(noisy[noisy < 4095])  # noise of reading comes behind the well
    half = expose(flat(2.5, 8), SensorSettings(electrons=1000.0, full_well=5000.0, noise="none", black_level=0))[RAW]
    assert np.abs(half - (2**14 - 1) / 2).max() <= 0.5


@pytest.mark.parametrize("mosaic", ["RGGB", "BGGR", "GRBG", "GBRG"])
def test_each_pixel_counts_its_colour(mosaic: Any) -> None:
    rgb = np.random.default_rng(0).random((7, 9, 3)).astype(np.float32)
    sensor = SensorSettings(mosaic=mosaic, noise="none")
    raw = expose(rgb, sensor)[RAW]
    every = expose(rgb, SensorSettings(mosaic="none", noise="none"))
    for row in range(7):
        for column in range(9):
            colour = mosaic[2 * (row % 2) + column % 2]
            assert raw[row, column] == every[f"{RAW}.{colour}"][row, column]
    assert np.array_equal(expose(rgb[3:], sensor, first_row=3)[RAW], raw[3:])


def test_noise_depends_on_seed_and_place_alone() -> None:
    rgb, sensor = flat(0.3, 40), SensorSettings()
    whole = expose(rgb, sensor, seed=5)[RAW]
    assert np.array_equal(
        np.concatenate([expose(rgb[:13], sensor, 5)[RAW], expose(rgb[13:], sensor, 5, 13)[RAW]]), whole
    )
    assert not np.array_equal(expose(rgb, sensor, seed=6)[RAW], whole)


def test_a_render_has_the_sensors_channels_for_any_threads(scene: Path, tmp_path: Path) -> None:
    """Tiles are compared in test_tiles."""
    words = ["render", str(scene), "--camera", "thin", "--samples", "4", "--quiet", "--seed", "2", "-o"]
    for threads in ("1", "2"):
        main([*words, str(tmp_path / f"{threads}.exr"), "--mosaic", "BGGR", "--threads", threads])
    main([*words, str(tmp_path / "plain.exr")])
    one, two, plain = (read_channels(tmp_path / f"{name}.exr")[0] for name in ("1", "2", "plain"))
    assert set(one) == {*plain, RAW} and all(np.array_equal(one[name], two[name]) for name in one)
    rgb = np.stack([plain[c] for c in "RGB"], -1)
    sensor = SensorSettings(mosaic="BGGR")
    assert np.array_equal(one[RAW], expose(rgb, sensor, seed=2)[RAW])
    assert read_metadata(tmp_path / "1.exr")["sensor"] == about(sensor, 2)
    table = scene.read_text() + '\n[sensor]\nmosaic = "BGGR"\nelectrons = 10.0\n'
    scene.write_text(table)
    main([*words, str(tmp_path / "3.exr"), "--electrons", "20000"])
    assert np.array_equal(read_channels(tmp_path / "3.exr")[0][RAW], one[RAW])


def test_flare_falls_on_the_sensor_too(scene: Path, tmp_path: Path) -> None:
    sensor = SensorSettings(noise="none")
    prepared = prepare(Frame.of(scene, "thin", sensor=sensor, samples=1), tmp_path / "o.exr")
    result, ghosts = prepared.render(1), np.random.default_rng(0).random((18, 32, 3)).astype(np.float32)
    write_pictures(prepared, result, {"ghosts": ghosts, "rest": ghosts}, preview=False)  # rest is a part of ghosts
    assert np.array_equal(read_channels(tmp_path / "o.exr")[0][RAW], expose(result.rgb + ghosts, sensor)[RAW])


def test_a_cover_glass_moves_the_image_back_and_stays_out_of_the_picture() -> None:
    lens = read_lens(TRIPLET)
    bare, plated = (set_lens(lens, Shot((36, 24), 2.0, 4.0, focus_mode="paraxial", cover_glass_mm=t)) for t in (0, 3))
    assert bare.film_z_mm is not None and plated.film_z_mm is not None
    assert plated.film_z_mm - bare.film_z_mm == pytest.approx(3 * (1 - 1 / 1.5168), rel=1e-6)
    best = set_lens(lens, Shot((36, 24), 2.0, 4.0, cover_glass_mm=3))
    assert spots(Analysed(best, 2.0), [0.0]).rms_um[0] < spots(Analysed(plated, 2.0), [0.0]).rms_um[0]
    assert "cover glass of 3 mm" in best.derived and len(best.surfaces) == len(lens.surfaces) + 2


@pytest.mark.parametrize(
    ("camera", "options", "said"),
    [
        ("thin", ("--mosaic", "XTRANS"), "invalid choice"),
        ("thin", ("--bits", "17"), "from 1 to 16"),
        ("thin", ("--read-noise", "nan"), "from 0"),
        ("thin", ("--full-well", "0"), "from 1"),
        ("thin", ("--bits", "8", "--black-level", "255"), "black_level: got 255, expected at most 254"),
        ("thin", ("--black-level", "16383"), "black_level: got 16383, expected at most 16382"),
        ("thin", ("--fill-factor", "0"), "from 0.01 to 1"),
        ("thin", ("--cover-glass", "2"), "cover_glass_mm: got 2.0, expected left out"),
        ("thin", ("--cover-glass", "-1"), "from 0 to 100"),
        (str(MODEL), ("--cover-glass", "2"), "cover_glass_mm: got 2.0, expected left out"),
        (str(SONNAR), ("--cover-glass", "6"), "expected at most 0.78"),
    ],
)
def test_bad_input_is_one_line(
    camera: str, options: tuple[str, ...], said: str, scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    line = failure(capsys, "render", scene, "--camera", camera, "-o", tmp_path / "o.exr", *options)
    assert said in line and not list(tmp_path.glob("o.*"))


@pytest.mark.parametrize(("bits", "black"), [(1, 0), (8, 8), (12, 128), (14, 512), (16, 512)])
def test_the_black_level_that_nobody_states_fits_the_bits(bits: int, black: int) -> None:
    sensor = SensorSettings(bits=bits, noise="none", mosaic="none", electrons=100.0, full_well=100.0)
    told = about(sensor, 0)
    assert told["black_level"] == black and told["white_level"] == 2**bits - 1
    assert [np.unique(expose(flat(v), sensor)["raw.G"]) for v in (0.0, 1.0)] == [black, told["white_level"]]


def test_pictures_that_are_none_are_refused() -> None:
    for bad in (np.full((4, 4, 3), np.nan, np.float32), np.zeros((4, 4), np.float32), np.zeros((0, 4, 3), np.float32)):
        with pytest.raises(InputError, match="sensor: picture"):
            expose(bad, SensorSettings())


def test_a_pixel_that_is_not_whole_takes_no_companions(scene: Path) -> None:
    """Their film points may lie between the parts that take light."""
    tables = {"camera": {"position_m": [0, 0, 1], "look_at_m": [0, 0, 0], "focus_m": 1.0}}
    camera = make_camera(MODEL, Shot((36.0, 24.0), 1.0))
    film = FilmSettings(fill_factor=0.5)
    sizes = {"width": 960, "height": 640, "samples": 1, "threads": 1, "rows": (0, 1)}
    assert render(scene_from_tables(tables), camera, film=film, **sizes).stats.wavelengths == "one"  # type: ignore[arg-type]
    with pytest.raises(InputError, match="film.wavelengths"):
        render(scene_from_tables(tables), camera, film=FilmSettings(wavelengths="hero", fill_factor=0.5), **sizes)  # type: ignore[arg-type]


def test_changes_by_name_leave_the_other_settings() -> None:
    film = FilmSettings(colour_space="ACEScg", fill_factor=0.5)
    assert with_changes(film, {"white_balance": "A"}) == replace(film, white_balance="A")
    assert with_changes(film, None) == film
    with pytest.raises(TypeError, match="whitebalance"):
        with_changes(film, {"whitebalance": "A"})
