"""What the cameras' tests share: cameras by name, samples of the unit square, mean film values."""

from copy import copy
from functools import cache
from pathlib import Path
from typing import Any

import lens_models
import numpy as np
import torch
from film_light import FilmLight, film_light

from neurolens.cameras.build import make_camera
from neurolens.cameras.model import OnnxCamera, load_model
from neurolens.cameras.reduced import Vignetted
from neurolens.lens.shot import Shot

ROOT = Path(__file__).parents[2]
FILM = (36.0, 24.0)
GAUSS = ROOT / "lenses" / "laikin_double_gauss_50.toml"
FISHEYES = ("fisheye-equidistant", "fisheye-equisolid", "fisheye-stereographic", "fisheye-orthographic")
# Every kind of camera.
KINDS = ("pinhole", "thin", "thick", "exact", "exact64", "polynomial", "network", *FISHEYES)
_MODELS = {"polynomial": "ols-60", "network": "mlp-16x2"}


@cache
def camera(kind: str, focus_m: float = 2.0, f_number: float | None = 4.0) -> Any:
    """A camera of a 50 mm lens (14 mm for a fisheye projection) on `FILM`."""
    if kind == "exact":
        return lens_models.exact_camera(focus_m, f_number)
    if kind == "exact64":  # the same outline, not searched again
        double = copy(camera("exact", focus_m, f_number))
        double._dtype, double.film = torch.float64, copy(double.film)
        double.film.scene = double._scene
        return double
    if kind in _MODELS:
        model = load_model(ROOT / "models" / f"{GAUSS.stem}.{_MODELS[kind]}.onnx")
        return OnnxCamera(model, Shot(FILM, focus_m, f_number, wavelength_nm=(400.0, 700.0)))
    return make_camera(f"thick:{GAUSS}" if kind == "thick" else kind, Shot(FILM, focus_m, f_number))


@cache
def tabled(kind: str) -> Vignetted:
    """The camera without vignetting."""
    return Vignetted(camera(kind))


RADII = np.array([0.0, 8.0, 16.0, 21.4])


@cache
def light() -> FilmLight:
    """Light of the exact lens at `RADII` and 550 nm, by an integral over the pupil's boundary that knows no camera."""
    return film_light(camera("exact").lens, RADII, wavelength_nm=550.0, directions=40)


def at(point: tuple[float, float], count: int) -> np.ndarray:
    return np.repeat(np.array(point, np.float32)[:, None], count, axis=1)


def jittered(side: int, seed: int = 1) -> tuple[np.ndarray, np.ndarray]:
    """Points [2, side^2] of the unit square, one in each cell, and wavelengths from 400 to 700 nm."""
    rng = np.random.default_rng(seed)
    cells = np.stack(np.meshgrid(np.arange(side), np.arange(side))).reshape(2, -1)
    square = np.minimum((cells + rng.random(cells.shape)) / side, 1 - 2.0**-24).astype(np.float32)
    return square, rng.permutation(np.linspace(400, 700, side * side)).astype(np.float32)


def film_value(camera: Any, point: tuple[float, float], side: int = 112, wavelength_nm: float | None = None) -> float:
    """Film value of white surroundings, over 400 to 700 nm or at one wavelength."""
    square, wavelength = jittered(side)
    if wavelength_nm is not None:
        wavelength[:] = wavelength_nm
    return float(camera.sample(at(point, side * side), square, wavelength).weight.mean(dtype=np.float64))


def film_rays(camera: Any, count: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Random film points, squares and wavelengths."""
    rng = np.random.default_rng(seed)
    film = ((rng.random((2, count)) - 0.5) * np.array([camera.film_mm]).T).astype(np.float32)
    return film, rng.random((2, count), np.float32), rng.uniform(400, 700, count).astype(np.float32)


def differences(camera: Any, film: np.ndarray, square: np.ndarray, wavelength: np.ndarray, step: float) -> np.ndarray:
    """Central differences [6, 2, N] of origin (m) and direction by the film point, per mm."""
    found = []
    for axis in (0, 1):
        ends = []
        for sign in (1, -1):
            moved = film.copy()
            moved[axis] += np.float32(sign * step)
            rays = camera.sample(moved, square, wavelength)
            ends.append(np.concatenate([rays.origin_m, rays.direction]).astype(np.float64))
        found.append((ends[0] - ends[1]) / (2 * step))
    return np.stack(found, axis=1)
