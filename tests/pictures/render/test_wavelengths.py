"""Wavelengths drawn by importance, and four of them a path: exact densities, the same mean, less noise."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from render_helpers import FILM, WHITE, assert_same_mean, diffuse, scene
from shipped import whole

from neurolens.base.errors import InputError
from neurolens.cameras.build import make_camera
from neurolens.cameras.contract import CameraRays
from neurolens.cameras.ideal import Pinhole
from neurolens.optics.lens.shot import Shot
from neurolens.pictures.render.colour import SpectralRange, table
from neurolens.pictures.render.film import PixelGrid
from neurolens.pictures.render.job import dispersion_px, expected_light, mode_for, spectral_range
from neurolens.pictures.render.renderer import render
from neurolens.pictures.render.scene import Scene
from neurolens.pictures.render.settings import FilmSettings

FLAT = (table("wavelength_nm"), np.ones(81))
SPIKE = (np.array([400.0, 499.0, 500.0, 501.0, 700.0]), np.array([0.01, 0.01, 5.0, 0.01, 0.01]))
CAMERA = Pinhole(50.0, (36.0, 24.0))


@pytest.mark.parametrize("light", [FLAT, SPIKE], ids=["flat", "spike"])
def test_the_density_is_that_of_the_bins(light: tuple[np.ndarray, np.ndarray]) -> None:
    spectral = SpectralRange(400, 700, light=light)
    assert spectral.edges_nm[[0, -1]] == pytest.approx([400, 700], abs=0) and np.all(np.diff(spectral.edges_nm) > 0)
    sample = ((np.arange(256 * 64) + 0.5) / (256 * 64)).astype(np.float32)
    nm, bins = spectral.wavelengths_nm(sample)[0], spectral.bin_of(sample)
    assert np.all(np.diff(nm) > 0) and np.all(np.bincount(bins) == 64)
    assert np.all((nm >= spectral.edges_nm[bins] - 1e-3) & (nm <= spectral.edges_nm[bins + 1] + 1e-3))
    # Divided by the density, the mean of 1 is the length of the range.
    assert np.mean(np.diff(spectral.edges_nm)[bins]) * spectral.bins == pytest.approx(300, rel=1e-9)
    # A tenth of all wavelengths is spread evenly, so that no density is below a tenth of the uniform one.
    assert np.diff(spectral.edges_nm).max() <= 10.01 * 300 / 256


@pytest.mark.parametrize("light", [None, FLAT, SPIKE], ids=["even", "flat", "spike"])
@pytest.mark.parametrize("rgb", [(1, 1, 1), (0.9, 0.1, 0.05), (0, 1, 0), (0.2, 0.3, 0.7), (0, 0, 1)])
def test_colours_come_back_through_any_bins(rgb: tuple[float, float, float], light: Any) -> None:
    for limits in ((380, 780), (400, 700), (450, 650)):
        spectral = SpectralRange(*limits, light=light)
        spectrum = spectral.spectrum(rgb)
        assert spectrum.min() >= 0 and spectrum.max() <= 1 + 1e-6
        assert spectral.film_rgb(spectrum) == pytest.approx(rgb, abs=1e-5)


def test_upsampling_conserves_energy_and_reciprocates_over_the_cube() -> None:
    spectral = SpectralRange(380, 780)
    axis = np.linspace(0, 1, 9)
    cube = np.stack(np.meshgrid(axis, axis, axis), axis=-1).reshape(-1, 3)
    spectra = spectral.spectrum(cube)
    assert spectra.min() >= 0 and spectra.max() <= 1 + 1e-6 and np.allclose(spectra[-1], 1, atol=1e-6)
    assert np.allclose(spectra.astype(float) @ spectral.response.T / spectral.bins, cube, rtol=0, atol=1e-5)
    # Complementary colours are complementary at every wavelength.
    assert np.allclose(spectral.spectrum(cube) + spectral.spectrum(1 - cube), 1, rtol=0, atol=1e-6)


def test_the_light_of_a_scene() -> None:
    lamp = {"corner_m": [-1, -1, -3], "edge_u_m": [2, 0, 0], "edge_v_m": [0, 2, 0], "emission": [2, 2, 2]}
    nm, white = expected_light(scene(quads=[lamp]))
    assert white == pytest.approx(1, rel=1e-3) and nm[0] > 400 and nm[-1] < 700
    _, warm = expected_light(scene(quads=[lamp | {"illuminant": "A"}]))
    assert np.all(np.diff(warm[::64]) > 0)
    _, dark = expected_light(scene())
    assert np.all(dark == 1)
    one = expected_light(scene({"wavelengths_nm": [550, 550]}, environment=WHITE))
    assert spectral_range(scene({"wavelengths_nm": [550, 550]}), CAMERA, FilmSettings()).centres_nm[0] == 550
    assert np.all(np.isfinite(one[1]))


def test_cauchy_index_has_the_asked_abbe_number() -> None:
    lines = [SpectralRange(nm, nm).refractive_index(1.62, 36.4)[0] for nm in (587.5618, 486.1327, 656.2725)]
    assert lines[0] == pytest.approx(1.62, abs=1e-6)
    assert (lines[0] - 1) / (lines[1] - lines[2]) == pytest.approx(36.4, rel=1e-4)
    assert np.all(SpectralRange(400, 700).refractive_index(1.5, None) == np.float32(1.5))


SMALL: dict[str, Any] = {"width": 24, "height": 16, "threads": 1}
MATERIALS: dict[str, Any] = {
    "red": diffuse(0.8, 0.1, 0.05),
    "tiles": {"kind": "diffuse", "texture": "tiles"},
    "poster": {"kind": "diffuse", "texture": "poster"},
    "copper": {"kind": "glossy", "specular": [0.9, 0.5, 0.2], "roughness": 0.3, "reflectance": [0.02, 0.1, 0.4]},
    "mirror": {"kind": "mirror", "reflectance": [0.9, 0.7, 0.5]},
    "flint": {"kind": "glass", "n_d": 1.9, "V_d": 12.0},
    "plain": {"kind": "glass", "n_d": 1.5},
}
WALL = {"point_m": [0, 0, -3], "normal": [0, 0, 1], "material": "tiles"}
LAMP = {"corner_m": [-1, 1.5, -2], "edge_u_m": [2, 0, 0], "edge_v_m": [0, 0, 1], "emission": [5, 4, 2]}


def room(tmp_path: Path, material: str) -> Scene:
    pixels = np.random.default_rng(5).integers(0, 255, (8, 8, 3)).astype(np.uint8)
    Image.fromarray(pixels).save(tmp_path / "p.png")
    textures = {
        "tiles": {"kind": "checker", "colours": [[0.9, 0.2, 0.1], [0.1, 0.3, 0.9]], "cell_m": 0.2},
        "poster": {"kind": "image", "file": str(tmp_path / "p.png")},
    }
    return scene(
        {"look_at_m": [0, 0, 0]},
        environment={"colour": [0.2, 0.4, 0.8]},
        textures=textures,
        materials=MATERIALS,
        planes=[WALL],
        quads=[LAMP, {"corner_m": [-1, -1, -2], "edge_u_m": [2, 0, 0], "edge_v_m": [0, 0, 1], "material": "poster"}],
        spheres=[{"centre_m": [0, 0, -1.5], "radius_m": 0.9, "material": material}],
    )


def renders(
    made: Scene, camera: Any, mode: Any, seeds: int, wavelength_sampling: Any = "importance", **options: Any
) -> np.ndarray:
    film = FilmSettings(wavelengths=mode, wavelength_sampling=wavelength_sampling)
    options = SMALL | {"samples": 16, "max_depth": 5} | options
    return np.stack([render(made, camera, seed=seed, film=film, **options).rgb for seed in range(seeds)])


def colour_noise(pictures: np.ndarray) -> float:
    """Variance over seeds of R - G and B - G."""
    return float((pictures[..., [0, 2]] - pictures[..., 1:2]).var(axis=0).mean())


def test_importance_changes_the_noise_and_not_the_mean(tmp_path: Path) -> None:
    made = room(tmp_path, "copper")
    even, drawn = (renders(made, CAMERA, "one", 14, wavelength_sampling=s) for s in ("uniform", "importance"))
    assert_same_mean(even, drawn, 0.01)
    assert drawn.var(axis=0).mean() < 0.8 * even.var(axis=0).mean()


@pytest.mark.parametrize("material", ["red", "flint", *whole("copper", "mirror", "plain")])
def test_hero_paths_have_the_same_mean_and_less_colour_noise(material: str, tmp_path: Path) -> None:
    made, camera = room(tmp_path, material), Pinhole(40.0, FILM)
    one, hero = (renders(made, camera, mode, 12) for mode in ("one", "hero"))
    assert_same_mean(one, hero, 0.02)
    # Where dispersion parts them at every path, nothing is left to gain.
    assert colour_noise(hero) < (1.1 if material == "flint" else 0.4) * colour_noise(one)


def test_roulette_and_many_reflections_in_dispersive_glass_lose_nothing() -> None:
    # Everything is 1 in white light: glass that scatters wavelengths apart must give all of it back.
    spheres = [{"centre_m": [0, 0, -1.5], "radius_m": 0.9, "material": "flint"}]
    made = scene(environment=WHITE, materials={"flint": MATERIALS["flint"]}, spheres=spheres)
    for mode in ("one", "hero"):
        pictures = renders(made, Pinhole(400.0, FILM), mode, 1, width=48, height=32, samples=96, max_depth=200)
        assert pictures.mean(axis=(0, 1, 2)) == pytest.approx(np.ones(3), abs=8e-3)


class Prism(Pinhole):
    """Magnifies long wavelengths, by `shift` over 400 to 700 nm, and lets less of them pass."""

    dispersive, wavelength_nm, shift = True, (400.0, 700.0), 0.05

    def sample(self, film_mm: Any, pupil: Any, wavelength_nm: Any) -> CameraRays:
        off = (wavelength_nm - np.float32(550)) * np.float32(1 / 300)
        rays = super().sample(film_mm * (1 + np.float32(self.shift) * off), pupil, wavelength_nm)
        return replace(rays, weight=rays.weight * (1 - off))


def prism(shift: float) -> Prism:
    camera = Prism(40.0, FILM)
    camera.shift = shift
    return camera


@pytest.mark.parametrize("shift", [0.0, 1e-3, 0.05])
def test_dispersion_is_measured_in_pixels(shift: float) -> None:
    # RMS distance from the film's centre is sqrt((w^2 + h^2) / 12); half the shift on either side of the middle.
    expected = 0.5 * shift * np.sqrt((36**2 + 24**2) / 12) / (36 / 72)
    assert dispersion_px(prism(shift), PixelGrid(72, 48, FILM), (400, 700)) == pytest.approx(
        expected, rel=0.03, abs=2e-4
    )


def test_a_camera_that_disperses_gets_one_wavelength_a_path() -> None:
    made = scene(environment=WHITE)
    options: dict[str, Any] = {"width": 72, "height": 48, "samples": 1, "threads": 1}

    def mode(camera: Any, wavelengths: str = "auto") -> str:
        film = FilmSettings(wavelengths=wavelengths)  # type: ignore[arg-type]
        return str(render(made, camera, film=film, **options).stats.wavelengths)

    assert mode(Pinhole(40.0, FILM)) == "hero" and mode(Pinhole(40.0, FILM), "one") == "one"
    assert mode(prism(0.05)) == "one"
    assert mode(prism(1e-4)) == "hero"
    with pytest.raises(InputError, match=r"film\.wavelengths: got 'hero', expected one: camera.*pixels"):
        mode(prism(0.05), "hero")


def test_a_lens_that_disperses_less_than_a_pixel_shows() -> None:
    # Small enough a picture, and one ray serves all wavelengths; each lane still has the lens's transmittance for it.
    model = Path(__file__).parents[3] / "models" / "laikin_double_gauss_50.ols-60.onnx"
    camera = make_camera(model, Shot(FILM, 3.0, 2.8))
    assert camera.dispersive
    limits = (400.0, 700.0)
    assert mode_for(camera, PixelGrid(24, 16, FILM), limits, FilmSettings()) == "hero"
    assert mode_for(camera, PixelGrid(720, 480, FILM), limits, FilmSettings()) == "companions"
    ball = {"centre_m": [0, 0, -2], "radius_m": 0.4, "emission": [1, 2, 4], "illuminant": "A"}
    made = scene(environment=WHITE, spheres=[ball])
    one, hero = (renders(made, camera, mode, 8, samples=32) for mode in ("one", "hero"))
    assert_same_mean(one, hero, 0.01)
    assert colour_noise(hero) < 0.3 * colour_noise(one)
