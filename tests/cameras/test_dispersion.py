"""Dispersion by film points: closed forms of a singlet and an achromat, and cameras that keep a part of it or none."""

from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from shipped import whole

from neurolens.base.errors import InputError
from neurolens.cameras.contract import CameraRays
from neurolens.cameras.exact import ExactCamera
from neurolens.cameras.ideal import Pinhole
from neurolens.cameras.reduced import ReducedDispersion, film_shift
from neurolens.cameras.sampling import stratified
from neurolens.optics.lens.prescription import LINE_D_NM
from neurolens.optics.lens.shot import Shot
from neurolens.optics.readers.lensfile import read_lens

ROOT = Path(__file__).parents[2]
FILM = (36.0, 24.0)
# Two with strong lateral colour, one with cylinders.
LENSES = {
    "laikin_double_gauss_50": (FILM, 1.8),
    "horimoto_fisheye_16": (FILM, 2.8),
    "cooke_anamorphic_42": ((20.6, 17.3), 2.4),
}
LINES_NM = (486.1327, 656.2725)  # F and C


@cache
def cameras(name: str) -> dict[str, Any]:
    """A lens with all of its dispersion, with a part of it, and without."""
    film, f_number = LENSES[name]
    full = ExactCamera(read_lens(ROOT / "lenses" / f"{name}.toml"), Shot(film, 2.0, f_number))
    return {"full": full} | {kind: ReducedDispersion(full, kind) for kind in ("lateral", "off")}  # type: ignore[arg-type]


def points(film_mm: tuple[float, float], count: int = 40, side: int = 16) -> tuple[np.ndarray, np.ndarray]:
    square = stratified(side, (500.0, 500.0))[0][:, None]
    film = (np.random.default_rng(3).random((2, count)) - 0.5) * np.array(film_mm)[:, None]
    return film, np.repeat(square, count, axis=1)


def shift_um(camera: Any, nm: float, count: int = 40) -> np.ndarray:
    film, square = points(camera.film_mm, count)
    return 1e3 * film_shift(camera, film, square, nm, LINE_D_NM, (0.03, 0.02))


class Growing(Pinhole):
    """A pinhole whose picture is larger for longer wavelengths."""

    dispersive, achromatic = True, False

    def sample(self, film_mm: Any, pupil: Any, wavelength_nm: Any) -> CameraRays:
        size = 1 + np.float32(2e-3) * (wavelength_nm - np.float32(LINE_D_NM)) / 100
        return super().sample((film_mm / size).astype(np.float32), pupil, wavelength_nm)


def test_the_shift_of_a_picture_that_grows_with_the_wavelength() -> None:
    film, _ = points(FILM)
    assert shift_um(Growing(40.0, FILM), LINE_D_NM + 100) == pytest.approx(2 * film, abs=0.1)
    assert np.abs(shift_um(Pinhole(40.0, FILM), 400.0)).max() == 0


def thin(tmp_path: Path, glasses: list[tuple[float, float, float, float]]) -> Any:
    """Thin lenses in contact (two radii, n_d, V_d of each) 20 mm behind a small stop, focused at infinity."""
    rows = ["{ radius_mm = inf, thickness_mm = 20.0, diameter_mm = 1.0, stop = true }"]
    for front, back, n, v in glasses:
        rows.append(f"{{ radius_mm = {front}, thickness_mm = 0.1, diameter_mm = 4.0, n_d = {n}, V_d = {v} }}")
        rows.append(f"{{ radius_mm = {back}, thickness_mm = 0.1, diameter_mm = 4.0 }}")
    rows[-1] = rows[-1].replace("thickness_mm = 0.1", "thickness_mm = 100.0")
    head = 'schema = 1\nname = "Thin"\ndesigner = "none"\nsource = "a test"\nrims = "source"\n'
    file = tmp_path / "thin.toml"
    file.write_text(f"{head}f_number = 100.0\nefl_mm = 100.0\nsurfaces = [\n{','.join(rows)}\n]\n")
    return ExactCamera(read_lens(file), Shot((12.0, 8.0), np.inf, focus_mode="paraxial"))


def test_lateral_colour_of_a_thin_lens_behind_its_stop_and_of_an_achromat(tmp_path: Path) -> None:
    # A chief ray of slope u crosses the lens at height 20 u and the film, one focal length f behind it, at
    # 20 u + f u - 20 u f / f(lambda): its height changes by -20 u (f / f(lambda) - 1) = -20 u (n - n_d) / (n_d - 1).
    singlet = thin(tmp_path, [(103.36, -103.36, 1.5168, 64.17)])
    film, _ = points(singlet.film_mm)
    between = shift_um(singlet, LINES_NM[0]) - shift_um(singlet, LINES_NM[1])
    u = film / 100.0
    assert between == pytest.approx(-1e3 * -20 * -u / 64.17, rel=0.03, abs=0.1)
    # Powers in the ratio of the Abbe numbers cancel it: phi_1 / V_1 + phi_2 / V_2 = 0.
    v1, v2 = 64.17, 36.37
    one, two = 100 * (v1 - v2) / v1, -100 * (v1 - v2) / v2
    glasses = [(2 * one * 0.5168, -2 * one * 0.5168, 1.5168, v1), (2 * two * 0.62004, -2 * two * 0.62004, 1.62004, v2)]
    left = shift_um(thin(tmp_path, glasses), LINES_NM[0]) - shift_um(thin(tmp_path, glasses), LINES_NM[1])
    assert np.abs(left).max() < 0.05 * np.abs(between).max()


@pytest.mark.parametrize("name", ["laikin_double_gauss_50", *whole("horimoto_fisheye_16", "cooke_anamorphic_42")])
def test_lateral_keeps_the_shift_of_the_picture_and_off_keeps_nothing(name: str) -> None:
    made = cameras(name)
    for nm in (410.0, 690.0):
        full, lateral, off = (shift_um(made[kind], nm) for kind in ("full", "lateral", "off"))
        lit = np.isfinite(full).all(axis=0) & np.isfinite(lateral).all(axis=0)
        assert lit.mean() > 0.7 and np.sqrt(np.mean(full[:, lit] ** 2)) > 0.5
        # What is left: the pupil grows with the wavelength, and the mean of a blur with it.
        assert np.sqrt(np.mean((full - lateral)[:, lit] ** 2)) < 0.05 * np.sqrt(np.mean(full[:, lit] ** 2)) + 0.3
        assert np.nanmax(np.abs(off)) == 0


@pytest.mark.parametrize("kind", ["lateral", "off"])
def test_white_is_one_on_the_axis_and_rays_are_those_of_one_wavelength(kind: str) -> None:
    made = cameras("laikin_double_gauss_50")
    count = 40_000
    square = np.random.default_rng(1).random((2, count), np.float32)
    axis, waves = np.zeros((2, count), np.float32), np.linspace(400, 700, count, dtype=np.float32)
    rays = made[kind].sample(axis, square, waves)
    assert rays.weight.mean(dtype=np.float64) == pytest.approx(1, abs=4e-3)
    for nm in (430.0, 640.0):  # the colour of glass and coatings stays
        light = np.full(count, nm, np.float32)
        kept, own = (made[k].sample(axis, square, light).weight.mean(dtype=np.float64) for k in (kind, "full"))
        assert kept == pytest.approx(own, rel=3e-3)
    line = made["full"].sample(axis, square, np.full(count, LINE_D_NM, np.float32))
    # The axis does not move with the wavelength.
    assert rays.direction == pytest.approx(line.direction, abs=1e-6)
    assert np.array_equal(rays.status, line.status)


def test_companions_share_the_ray_where_the_picture_moves_to() -> None:
    made = cameras("horimoto_fisheye_16")["lateral"]
    film, square = points(made.film_mm, 4000)[0], np.random.default_rng(4).random((2, 4000))
    waves = np.stack([np.full(4000, nm, np.float32) for nm in (450.0, 540.0, 690.0)])
    found = made.sample_spectrum(film.astype(np.float32), square.astype(np.float32), waves)
    passed = (found.weight > 0).all(axis=0)
    share = made.sample(film.astype(np.float32), square.astype(np.float32), waves[0]).weight / 3
    assert passed.mean() > 0.5 and found.weight[0, passed] == pytest.approx(share[passed], rel=1e-5)
    assert np.abs(found.film_mm - found.film_mm[0]).max() <= max(made.companion_reach_mm)
    for k in (1, 2):  # the companion's own ray there is the same
        own = made.sample(found.film_mm[k][:, passed], square[:, passed].astype(np.float32), waves[k, passed])
        away = np.abs(own.direction - found.rays.direction[:, passed]).max(axis=0)
        assert np.percentile(away, 99) < 2e-5


def test_light_that_is_traced_backwards_meets_the_moved_picture() -> None:
    made = cameras("laikin_double_gauss_50")
    random, count = np.random.default_rng(2), 3000
    point = np.stack([random.uniform(-0.4, 0.4, count), random.uniform(-0.3, 0.3, count), np.full(count, -1.95)])
    point, square = point.astype(np.float32), random.random((2, count), np.float32)
    waves = np.full(count, 440.0, np.float32)
    lateral, exact, still = (made[kind].to_film(point, square, waves) for kind in ("lateral", "full", "off"))
    lit = (lateral.weight > 0) & (exact.weight > 0)
    far = np.abs((still.film_mm - exact.film_mm)[:, lit].mean(axis=1))
    assert lit.mean() > 0.3
    assert np.abs((lateral.film_mm - exact.film_mm)[:, lit].mean(axis=1)).max() < max(0.3 * far.max(), 1e-3)


def test_cameras_without_colours_and_empty_or_dark_batches() -> None:
    still = ReducedDispersion(Pinhole(40.0, FILM), "lateral")
    assert not still.lateral and still.achromatic and still.companion_reach_mm is None
    made = cameras("laikin_double_gauss_50")["lateral"]
    empty = np.zeros((2, 0), np.float32)
    assert made.sample(empty, empty, np.zeros(0, np.float32)).weight.shape == (0,)
    assert made.sample_spectrum(empty, empty, np.zeros((4, 0), np.float32)).weight.shape == (4, 0)
    bad = np.array([np.nan, np.inf, -1.0, 0.0], np.float32)
    rays = made.sample(np.ones((2, 4), np.float32), np.full((2, 4), 0.5, np.float32), bad)
    assert np.isfinite(rays.direction).all() and np.isfinite(rays.weight).all()
    one = ReducedDispersion(cameras("laikin_double_gauss_50")["full"], "lateral", (589.0, 589.0))
    assert not one.lateral and one.achromatic
    dark = made.sample(
        np.zeros((2, 2), np.float32), np.full((2, 2), 0.5, np.float32), np.array([np.nan, 550], np.float32)
    )
    assert dark.weight[0] == 0 < dark.weight[1] and dark.status[0] != 0


def test_another_word_is_refused() -> None:
    with pytest.raises(InputError, match="dispersion"):
        replace(Shot(FILM, 2.0), dispersion="some")  # type: ignore[arg-type]
