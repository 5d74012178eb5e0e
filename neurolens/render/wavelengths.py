"""Which wavelengths paths carry: drawn by importance, one per path or four."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from neurolens.base.errors import InputError
from neurolens.cameras.contract import Camera, CameraRays, FloatArray
from neurolens.render.directions import centres
from neurolens.render.environment import sun_spectrum, total_spectrum
from neurolens.render.film import PixelGrid
from neurolens.render.film_settings import FilmSettings, WavelengthMode
from neurolens.render.illuminants import FloatArray64, Spectrum, illuminant
from neurolens.render.scene import Scene
from neurolens.render.scenetables import Vector
from neurolens.render.spectrum import SpectralRange

LANES = 4  # wavelengths of a hero path, and paths that share their random numbers
_FINE = 1024  # wavelengths at which the light of a scene is summed
_PROBES, _PROBED_WAVELENGTHS = 1024, 5
_LITTLE_PX = 0.05  # pixels; a smaller shift is hidden by the pixel filter, a box one pixel wide
_FARTHEST_M = 1e4


def spectral_range(scene: Scene, camera: Camera, film: FilmSettings, lanes: int = 1) -> SpectralRange:
    """The scene's wavelengths, in bins by their importance; InputError where a camera that disperses lacks some."""
    settings = scene.settings.camera
    low, high = settings.wavelengths_nm
    accepted = camera.wavelength_nm
    if camera.dispersive and accepted is not None and not (accepted[0] <= low and high <= accepted[1]):
        expected = f"within the {accepted[0]:g}-{accepted[1]:g} nm of camera {camera.name}"
        raise InputError("scene", "camera.wavelengths_nm", settings.wavelengths_nm, expected)
    light = expected_light(scene) if film.wavelength_sampling == "importance" else None
    return SpectralRange(low, high, light=light, lanes=lanes)


def expected_light(scene: Scene) -> Spectrum:
    """Spectrum (nm, radiance relative to D65) of a scene's light: lamps by area, the environment with equal weight."""
    fine = SpectralRange(*scene.settings.camera.wavelengths_nm, _FINE)
    lamps: dict[str, FloatArray64] = {}  # sums of emission by illuminant
    for name, emission, area in _lamps(scene):
        lamps[name] = lamps.get(name, 0.0) + area * np.array(emission)
    around = scene.settings.environment
    bands = [b for b in (around.colour, around.zenith, around.horizon, around.ground) if b is not None]
    if scene.environment is not None:
        bands = list(scene.environment.mean(axis=0, dtype=np.float64))

    total = np.zeros(_FINE)
    for group in (lamps, {around.illuminant: np.sum(bands, axis=0)}):
        light = np.zeros(_FINE)
        for name, rgb in group.items():
            found = illuminant(name, scene.illuminants)
            assert found is not None  # names are checked where scenes are read
            light += fine.relative(*found) * fine.spectrum(rgb)
        if light.any():
            total += light / light.mean()
    if (sky := scene.settings.sky) is not None:
        upper = centres(32, 16)
        sources = [total_spectrum(sky, upper[:, upper[1] > 0]), *([sun_spectrum(sky)[:2]] if sky.sun else [])]
        for spectrum in sources:
            shine = fine.relative(*spectrum)
            total += shine / shine.mean()
    return fine.centres_nm, total if total.any() else np.ones(_FINE)


def _lamps(scene: Scene) -> Iterator[tuple[str, Vector, float]]:
    """Illuminant, emission and area of the lamps; for those without size, the area that gives their flux."""
    settings = scene.settings
    for quad in settings.quads:
        yield quad.illuminant, quad.emission, float(np.linalg.norm(np.cross(quad.edge_u_m, quad.edge_v_m)))
    for disc in settings.discs:
        yield disc.illuminant, disc.emission, np.pi * disc.radius_m**2
    for sphere in settings.spheres:
        yield sphere.illuminant, sphere.emission, 4 * np.pi * sphere.radius_m**2
    for point in settings.points:
        yield point.illuminant, point.intensity, 4.0
    for spot in settings.spots:
        middle = np.radians(0.5 * (spot.inner_deg + spot.outer_deg))
        yield spot.illuminant, spot.intensity, 2 * (1 - float(np.cos(middle)))


def mode_for(camera: Camera, grid: PixelGrid, limits_nm: tuple[float, float], film: FilmSettings) -> WavelengthMode:
    """The mode that "auto" selects for a camera: "hero" where one ray serves all wavelengths, else "one".

    InputError: "hero" is asked for and the camera disperses.
    """
    if film.wavelengths in ("one", "lanes"):
        return film.wavelengths
    shift = dispersion_px(camera, grid, limits_nm) if camera.dispersive else 0.0
    if shift <= _LITTLE_PX:
        return "hero"
    if film.wavelengths == "hero":
        expected = f"one or lanes: camera {camera.name} moves its picture by {shift:.2g} pixels with the wavelength"
        raise InputError("render", "film.wavelengths", "hero", expected)
    return "one"


def dispersion_px(camera: Camera, grid: PixelGrid, limits_nm: tuple[float, float]) -> float:
    """How far the point in focus that a ray finds moves with the wavelength: RMS over film and pupil, in pixels.

    A pixel is what the point moves by when the film point moves by a pixel. The largest over five wavelengths against
    the middle one, of the rays that pass at both.
    """
    low, high = limits_nm
    random = np.random.default_rng(0)
    film = ((random.random((2, _PROBES)) - 0.5) * np.array(grid.film_mm)[:, None]).astype(np.float32)
    pupil = random.random((2, _PROBES), np.float32)
    focus = camera.settings.get("focus_m")
    reach = min(_FARTHEST_M if focus is None else float(focus), _FARTHEST_M)

    def found(nm: float, at: FloatArray) -> tuple[FloatArray64, NDArray[np.bool_]]:
        rays: CameraRays = camera.sample(at, pupil, np.full(_PROBES, nm, np.float32))
        point = rays.origin_m.astype(np.float64) + rays.direction.astype(np.float64) * reach
        return point, (rays.status == 0) & np.isfinite(point).all(axis=0)

    middle, passed = found(0.5 * (low + high), film)
    steps = []
    for axis, pixels in enumerate((grid.width, grid.height)):
        moved = film.copy()
        # Towards the middle, so that no point leaves the film.
        sign = np.where(film[axis] > 0, -1, 1)
        moved[axis] += sign * grid.film_mm[axis] / pixels
        point, also = found(0.5 * (low + high), moved)
        steps.append((point - middle) * sign)
        passed &= also
    worst = 0.0
    step = np.stack(steps, axis=-1).transpose(1, 0, 2)  # [N, 3, 2]
    for nm in np.linspace(low, high, _PROBED_WAVELENGTHS):
        point, also = found(float(nm), film)
        rows = np.flatnonzero(passed & also)
        if rows.size:
            shift = np.linalg.pinv(step[rows]) @ (point - middle).T[rows, :, None]
            worst = max(worst, float(np.sqrt(np.mean(np.sum(shift**2, axis=(1, 2))))))
    return worst
