"""What the cameras' tests share: cameras by name, samples of the unit square, mean film values."""

from functools import cache
from pathlib import Path
from typing import Any

import lens_models
import numpy as np
import torch
from film_light import FilmLight, film_light

from neurolens.base import status as st
from neurolens.cameras.build import make_camera
from neurolens.cameras.contract import CameraRays
from neurolens.cameras.exact import ExactCamera
from neurolens.cameras.model import OnnxCamera, load_model
from neurolens.cameras.reduced import Vignetted
from neurolens.optics.lens.shot import Shot
from neurolens.optics.setting.pupils import camera_rays as start
from neurolens.optics.trace.rays import trace

ROOT = Path(__file__).parents[2]
FILM = (36.0, 24.0)
GAUSS = ROOT / "lenses" / "laikin_double_gauss_50.toml"
FISHEYES = ("fisheye-equidistant", "fisheye-equisolid", "fisheye-stereographic", "fisheye-orthographic")
# Every kind of camera.
KINDS = ("pinhole", "thin", "thick", "exact", "polynomial", "network", *FISHEYES)
_MODELS = {"polynomial": "ols-60", "network": "mlp-16x2"}


@cache
def camera(kind: str, focus_m: float = 2.0, f_number: float | None = 4.0) -> Any:
    """A camera of a 50 mm lens (14 mm for a fisheye projection) on `FILM`."""
    if kind == "exact":
        return lens_models.exact_camera(focus_m, f_number)
    if kind in _MODELS:
        model = load_model(ROOT / "models" / f"{GAUSS.stem}.{_MODELS[kind]}.onnx")
        return OnnxCamera(model, Shot(FILM, focus_m, f_number, wavelength_nm=(400.0, 700.0)))
    return make_camera(f"thick:{GAUSS}" if kind == "thick" else kind, Shot(FILM, focus_m, f_number))


def traced(
    camera: ExactCamera, film: np.ndarray, square: np.ndarray, nm: np.ndarray, dtype: torch.dtype = torch.float64
) -> CameraRays:
    """The rays of an exact camera by the tracer and the formula of the contract, round stops alone."""
    (pupil, area), plane, z = camera.film.outline.sample(film, square, nm), camera.film.outline.pupil_z_mm, camera.film
    x, y, u, v, waves = (torch.from_numpy(np.ascontiguousarray(a)).to(dtype) for a in (*film, *pupil, nm))
    found = trace(camera.lens, start(x, y, z.film_z_mm, u, v, plane), waves, transmittance=True)
    ray, through = (t.numpy() for t in (torch.stack(list(found.rays)), found.transmittance))  # type: ignore[arg-type]
    low, high = camera.wavelength_nm or (0.0, np.inf)
    known = (area > 0) & (low / st.DOMAIN_SLACK <= nm) & (nm <= high * st.DOMAIN_SLACK)
    status = np.where(known, found.status.numpy(), st.OUTSIDE_DOMAIN)
    cos2 = 1 / (1 + np.square((pupil - film) / z.distance_mm).sum(0))
    weight = (status == st.PASSED) * through * area * np.square(cos2 / z.distance_mm) / z.exposure
    origin = 1e-3 * (ray[:3] - np.array([[0.0], [0.0], [z.film_z_mm]]))
    return CameraRays(origin, ray[3:], weight.astype(np.float32), status.astype(np.int32))


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
