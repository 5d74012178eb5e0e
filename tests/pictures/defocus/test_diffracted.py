"""`--diffraction` of `render`, `defocus`, `bokeh`: Airy's disc, even light, stars as of `flare`, tiles, turned films"""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from command_line import failure, run_json
from scipy.special import j0, j1

from neurolens.cameras.build import make_camera
from neurolens.cameras.contract import Camera
from neurolens.optics.analysis.diffraction import cells_of, middles, pupils_at
from neurolens.optics.analysis.fields import Scene
from neurolens.optics.analysis.spots import working_f_number
from neurolens.optics.lens.apertures import Aperture
from neurolens.optics.lens.shot import Shot
from neurolens.pictures.defocus import diffraction
from neurolens.pictures.defocus.diffraction import Diffraction, channels_of, on_upright
from neurolens.pictures.flare.diffraction import far_field
from neurolens.pictures.flare.exit_pupil import exit_pupil, outline
from neurolens.pictures.flare.lights import Light
from neurolens.pictures.render.pictures import read_channels, write_channels

LENS, NM = "laikin_double_gauss_50", 546.0


def camera(film_mm: float, f_number: float, aperture: Aperture | None = None, **more: float) -> Camera:
    film = (film_mm, film_mm)
    shot = Shot(film_mm=film, f_number=f_number, aperture=aperture, focus_m=math.inf, runtime="onnxruntime")
    return make_camera(LENS, replace(shot, **more))  # type: ignore[arg-type]


def test_a_point_becomes_airys_disc() -> None:
    """Light within a radius is 1 - J0^2 - J1^2 (Rayleigh); the light beyond the kernel is put back."""
    size, made = (60, 60), camera(0.12, 22.0)
    picture = np.zeros((*size, 3), np.float32)
    picture[30, 30] = 1
    found = Diffraction.of(made, size, (NM,) * 3)(picture)[..., 1]
    n = working_f_number(Scene(made.lens), NM)  # type: ignore[attr-defined]
    radii = np.array([0.008, 0.012, 0.02, 0.03])
    v = math.pi * radii / (NM * 1e-6 * n)
    within = np.array([_within(found, r / 0.002) for r in radii])
    assert within == pytest.approx(1 - j0(v) ** 2 - j1(v) ** 2, abs=0.015)


def _within(light: np.ndarray, radius_px: float) -> float:
    """Light within a radius of the middle of pixel 30, with the share of the pixels on its edge."""
    part = (np.arange(600) + 0.5) / 10 - 30.5
    inside = np.hypot(part[:, None], part) < radius_px
    return float((light * inside.reshape(60, 10, 60, 10).mean((1, 3))).sum())


def test_even_light_stays_even_and_light_is_kept() -> None:
    made = Diffraction.of(camera(3.0, 16.0, Aperture(blades=5)), (90, 90), (NM,) * 3)
    even = np.full((90, 90, 3), 0.7, np.float32)
    assert made(even) == pytest.approx(even, rel=3e-4)  # kernels of neighbouring zones differ a little
    dark = np.zeros((90, 90, 3), np.float32)
    r = made.kernels.shape[-1] // 2
    dark[r + 8 : -r - 8, r + 8 : -r - 8] = np.random.default_rng(1).random((74 - 2 * r, 74 - 2 * r, 3))
    assert made(dark).sum((0, 1)) == pytest.approx(dark.sum((0, 1)), rel=1e-5)


def test_films_that_stand_otherwise_have_the_kernels_of_what_they_see() -> None:
    """The upright film sees the same through the middle of the pupil at the places whose kernels are taken."""
    upright, film = camera(24.0, 4.0), np.array([[3.0, -8.0, 9.0], [7.0, -9.0, 2.0]])
    turned = camera(24.0, 4.0, film_tilt_deg=20.0, film_swing_deg=5.0, film_rise_mm=3.0)
    behind = -np.array(on_upright(turned, [(-x, -y) for x, y in film.T])).T
    middle, nm = np.full((2, 3), 0.5, np.float32), np.full(3, NM, np.float32)
    found, same, there = (
        made.sample(at.astype(np.float32), middle, nm).direction
        for made, at in ((turned, film), (upright, behind), (upright, film))
    )
    assert same == pytest.approx(found, abs=2e-3) and np.abs(there - found).max() > 0.05
    kernels = Diffraction.of(turned, (40, 40), (NM,) * 3).kernels
    assert kernels.sum((3, 4)) == pytest.approx(1)


def test_a_turned_film_cuts_the_waves_where_it_stands(monkeypatch: pytest.MonkeyPatch) -> None:
    """The middle of its picture, 9 mm off the axis, against waves summed on it, of a thing that is sharp there.

    The kernel of the upright film has 9% of its light in other pixels.
    """
    monkeypatch.setattr(diffraction, "_ZONES", (1, 1))
    pixel, turned = 0.0025, camera(24.0, 16.0, film_tilt_deg=20.0, film_swing_deg=8.0, film_rise_mm=-9.0)
    found = Diffraction.of(turned, (9600, 9600), (NM,) * 3).kernels[0, 0, 1]
    axes = turned.film.pose.axes[:, :2]  # type: ignore[attr-defined]
    lens, (x, y, depth) = turned.lens, axes @ [0.0, 9.0]  # type: ignore[attr-defined]
    there = replace(lens, film_z_mm=lens.film_z_mm + depth)
    sharp_m = (50.0**2 / depth + 2 * 50.0) / 1000
    [[pupil]] = pupils_at(Scene(there, sharp_m), np.array([[x, y]]), [NM])
    assert pupil is not None
    pupil = pupil.perfect()
    cosines = pupil.middle[:, None, None] + pupil.half[:, None, None] * np.stack(np.meshgrid(*[middles(96)] * 2)[::-1])
    waves = np.stack([*cosines, np.sqrt(1 - (cosines**2).sum(0))]).reshape(3, -1).T @ axes * (2e6 * math.pi / NM)
    field, line = cells_of(pupil, (96, 96)).reshape(-1), (np.arange(63) - 31) / 3 * pixel
    sums = np.exp(1j * np.outer(line, waves[:, 1])) * field @ np.exp(1j * np.outer(line, waves[:, 0])).T
    wanted = (np.abs(sums) ** 2).reshape(21, 3, 21, 3).mean((1, 3))[:, ::-1]
    middle = len(found) // 2 + np.arange(-10, 11)
    found = found[np.ix_(middle, middle)]
    assert 0.5 * np.abs(found / found.sum() - wanted / wanted.sum()).sum() < 0.015


def test_the_star_is_that_of_flare() -> None:
    """The same lens, seven blades: light by pixel, out to where streaks are 1e-4 of the middle."""
    pixel, side = 0.012, 61
    made = camera(pixel * 7 * side, 16.0, Aperture(blades=7))
    found = Diffraction.of(made, (7 * side, 7 * side), (NM,) * 3).kernels[1, 2, 1]
    pupil = exit_pupil(made.lens, Light(0.0, 0.0), NM)  # type: ignore[attr-defined]
    assert pupil is not None
    pupil = pupil.perfect()
    part, middle = 13, len(found) // 2
    line = (np.arange(-25 * part, 25 * part + 1) / part) * pixel
    fine = far_field(pupil, outline(pupil), line, line)
    whole = (np.arange(51) * part)[:, None] + np.arange(-(part // 2), part // 2 + 1)
    inner = whole[1:-1].reshape(-1)
    star = fine[np.ix_(inner, inner)].reshape(49, part, 49, part).mean((1, 3))
    ours = found[middle - 24 : middle + 25, middle - 24 : middle + 25]
    star, ours = star / star.sum(), ours / ours.sum()
    bright = star > 1e-4 * star.max()
    assert bright.sum() > 150
    assert np.abs(np.log(ours[bright] / star[bright])).mean() < 0.1
    assert 0.5 * np.abs(ours - star).sum() < 0.02


def test_commands_spread_light_and_say_so(
    tmp_path: Path, scene: Path, one_camera: None, capsys: pytest.CaptureFixture[str]
) -> None:
    """A small picture of small pixels at f/22: edges become soft, and the light stays."""
    words = ["render", scene, "--camera", LENS, "--film", "0.3x0.2", "--width", 30, "--f-number", 22, "--samples", 4]
    words += ["--threads", 1, "--quiet"]
    pictures = []
    for name, more in (("rays", ()), ("waves", ("--diffraction",))):
        run_json(capsys, *words, *more, "-o", tmp_path / f"{name}.exr")
        planes, about = read_channels(tmp_path / f"{name}.exr")
        assert about["diffraction"] is bool(more)
        pictures.append(planes["G"])
    rays, waves = pictures
    assert np.abs(np.diff(waves)).mean() < 0.5 * np.abs(np.diff(rays)).mean()
    assert waves.mean() == pytest.approx(rays.mean(), rel=0.1)
    run_json(capsys, *words, "--diffraction", "--tile", "2/2", "-o", tmp_path / "a.exr")
    [file] = tmp_path.glob("a.tile*.exr")
    tile, _ = read_channels(file)
    assert len(tile["G"]) == 10
    assert all(tile[name] == pytest.approx(plane[10:], rel=1e-4, abs=1e-6) for name, plane in planes.items())
    thin = ["thin" if word == LENS else word for word in words]
    assert "or a model of one" in failure(capsys, *thin, "--diffraction", "-o", tmp_path / "a.exr")


def test_kernels_of_bokeh_are_sums_of_waves_or_spread_rays(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """In focus at f/16 the first dark ring has its radius; far out of focus the disc keeps its size."""
    words = [
        "bokeh",
        LENS,
        "--film",
        "6x4",
        "--width",
        3000,
        "--focus",
        2,
        "--f-number",
        16,
        "--grid",
        "1x1",
        "--quiet",
    ]
    words += ["--wavelengths", "546,546,546", "--diffraction", "--quiet"]
    found = run_json(capsys, *words, "--distance", 2, "--distance", 0.5, "-o", tmp_path / "a")
    sharp, wide = (read_channels(Path(file))[0]["G"] for file in found["files"])
    middle = found["kernel_px"] // 2
    line = sharp[middle, middle:]
    working = working_f_number(Scene(make_camera(LENS, Shot(film_mm=(6, 4), f_number=16, focus_m=2.0)).lens, 2.0), NM)
    assert int(line[:9].argmin()) == pytest.approx(1.22 * NM * 1e-6 * working / 0.002, abs=1)
    assert sharp.sum() == pytest.approx(1, abs=0.01) and wide.sum() == pytest.approx(1, abs=1e-3)
    area = [np.count_nonzero(kernel > 0.3 * kernel.max()) for kernel in (sharp, wide)]
    assert area[1] > 100 * area[0]


def test_a_point_of_a_plate_becomes_airys_disc(
    tmp_path: Path, one_camera: None, capsys: pytest.CaptureFixture[str]
) -> None:
    """`defocus` keeps its light, and green within a radius is that of Airy's discs of its wavelengths."""
    size, pixel = 264, 0.003
    planes = {name: np.zeros((size, size), np.float32) for name in "RGB"} | {
        "Z": np.full((size, size), 1e4, np.float32)
    }
    for name in "RGB":
        planes[name][132, 132] = 1.0
    write_channels(tmp_path / "plate.exr", planes)
    words = ["defocus", tmp_path / "plate.exr", "--lens", LENS, "--film", f"{size * pixel}x{size * pixel}", "--quiet"]
    words += ["--focus", "inf", "--f-number", 22, "--samples", 64]
    found = {}
    for name, more in (("rays", ()), ("waves", ("--diffraction",))):
        run_json(capsys, *words, *more, "-o", tmp_path / f"{name}.exr")
        found[name] = read_channels(tmp_path / f"{name}.exr")[0]
    for name in "RGB":
        assert found["waves"][name].sum() == pytest.approx(found["rays"][name].sum(), rel=1e-3)
    made = camera(size * pixel, 22.0)
    n = working_f_number(Scene(made.lens), NM)  # type: ignore[attr-defined]
    light, rays = (found[name]["G"] / found[name]["G"].sum() for name in ("waves", "rays"))
    at = [float((rays.sum(k) * (np.arange(size) + 0.5)).sum()) for k in (1, 0)]
    part = (np.arange(10 * size) + 0.5) / 10
    away = np.hypot(part[:, None] - at[0], part - at[1])
    for radius in (0.015, 0.024, 0.036):  # from the first dark ring on, where pixels of 3 um blur little
        v = math.pi * radius / (np.array(channels_of("rgb", made.lens)["G"]) * 1e-6 * n)  # type: ignore[attr-defined]
        inside = (away < radius / pixel).reshape(size, 10, size, 10).mean((1, 3))
        assert (light * inside).sum() == pytest.approx((1 - j0(v) ** 2 - j1(v) ** 2).mean(), abs=0.01)
        assert (rays * inside).sum() == pytest.approx(1, abs=1e-3)
