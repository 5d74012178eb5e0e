"""Which wavelengths paths carry: drawn by importance, one a path or four."""

from __future__ import annotations

import numpy as np

from neurolens.cameras.contract import Camera
from neurolens.errors import InputError
from neurolens.render.filmsettings import FilmSettings
from neurolens.render.illuminants import illuminant
from neurolens.render.scenefile import Scene
from neurolens.render.spectrum import FloatArray64, SpectralRange

_FINE = 1024  # wavelengths at which the light of a scene is summed up


def spectral_range(scene: Scene, camera: Camera, film: FilmSettings) -> SpectralRange:
    """The scene's wavelengths, which a camera that disperses must cover, in bins by their importance.

    Raises:
        InputError: it does not.
    """
    settings = scene.settings.camera
    low, high = settings.wavelengths_nm
    accepted = camera.wavelength_nm
    if camera.dispersive and accepted is not None and not (accepted[0] <= low and high <= accepted[1]):
        expected = f"within the {accepted[0]:g}-{accepted[1]:g} nm of camera {camera.name}"
        raise InputError("scene", "camera.wavelengths_nm", settings.wavelengths_nm, expected)
    light = expected_light(scene) if film.wavelength_sampling == "importance" else None
    return SpectralRange(low, high, light=light)


def expected_light(scene: Scene) -> tuple[FloatArray64, FloatArray64]:
    """Spectrum (nm, radiance relative to D65) of a scene's light: its lamps by their area, and as much environment."""
    fine = SpectralRange(*scene.settings.camera.wavelengths_nm, _FINE)

    def spectrum(rgb: tuple[float, float, float], name: str) -> FloatArray64:
        found = illuminant(name, scene.illuminants)
        assert found is not None  # names are checked where scenes are read
        return fine.relative(*found) * fine.spectrum(rgb)

    lamps, around = np.zeros(_FINE), np.zeros(_FINE)
    for quad in scene.settings.quads:
        area = float(np.linalg.norm(np.cross(quad.edge_u_m, quad.edge_v_m)))
        lamps += area * spectrum(quad.emission, quad.illuminant)
    for sphere in scene.settings.spheres:
        lamps += 4 * np.pi * sphere.radius_m**2 * spectrum(sphere.emission, sphere.illuminant)
    environment = scene.settings.environment
    for band in (environment.colour, environment.zenith, environment.horizon, environment.ground):
        if band is not None:
            around += spectrum(band, environment.illuminant)
    total = sum((light / light.mean() for light in (lamps, around) if light.any()), np.zeros(_FINE))
    return fine.centres_nm, total if total.any() else np.ones(_FINE)
