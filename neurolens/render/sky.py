"""The clear sky and its sun.

Luminance and chromaticity of the sky are those of Preetham, Shirley and Smits 1999, "A practical analytic model for
daylight" (appendix A.2). With theta from the zenith, gamma from the sun, turbidity T, sun at theta_s:

    F(theta, gamma) = (1 + A e^(B / cos theta)) (1 + C e^(D gamma) + E cos^2 gamma)            Perez et al. 1993
    v(theta, gamma) = v_zenith F(theta, gamma) / F(0, theta_s)                                 for v = Y, x, y

with A to E linear in T. From chromaticity to spectrum: CIE daylight, S0 + M1 S1 + M2 S2 (CIE 15, and for
M1 and M2 Wyszecki and Stiles 1982).

The sun is a disc of 0.533 degrees with the spectrum of a black body at 5778 K and 133.1 klx outside the atmosphere
(ASTM E490), dimmed by air and haze (the same paper, appendix A.1) along the air mass of Kasten 1966,
m = 1 / (cos + 0.15 (93.885 - degrees)^-1.253): by exp(-0.008735 lambda^-4.08 m) for molecules and by
exp(-beta lambda^-1.3 m), beta = 0.04608 T - 0.04586, for haze, lambda in um. Ozone, water
vapour and mixed gases, a few per cent of the visible light, are left out.
"""

from __future__ import annotations

import math
from functools import cache
from importlib import resources

import numpy as np
from numpy.typing import NDArray

from neurolens.cameras.contract import FloatArray
from neurolens.render.illuminants import planck
from neurolens.render.lightsettings import Sky
from neurolens.render.spectrum import FloatArray64, table

SUN_RADIUS_RAD = math.radians(0.533 / 2)
_SUN_K, _SUN_LUX = 5778.0, 133.1e3

# Slope and offset in T of A, B, C, D, E.
_PEREZ = {
    "Y": ((0.1787, -1.4630), (-0.3554, 0.4275), (-0.0227, 5.3251), (0.1206, -2.5771), (-0.0670, 0.3703)),
    "x": ((-0.0193, -0.2592), (-0.0665, 0.0008), (-0.0004, 0.2125), (-0.0641, -0.8989), (-0.0033, 0.0452)),
    "y": ((-0.0167, -0.2608), (-0.0950, 0.0092), (-0.0079, 0.2102), (-0.0441, -1.6537), (-0.0109, 0.0529)),
}
# Rows T^2, T, 1; columns theta_s^3, theta_s^2, theta_s, 1.
_ZENITH = {
    "x": (
        (0.00166, -0.00375, 0.00209, 0.0),
        (-0.02903, 0.06377, -0.03202, 0.00394),
        (0.11693, -0.21196, 0.06052, 0.25886),
    ),
    "y": (
        (0.00275, -0.00610, 0.00317, 0.0),
        (-0.04214, 0.08970, -0.04153, 0.00516),
        (0.15346, -0.26756, 0.06670, 0.26688),
    ),
}


@cache
def daylight_table() -> tuple[FloatArray64, FloatArray64]:
    """Wavelengths [41] in nm, and the CIE's components S0, S1, S2 of daylight [3, 41] there (CIE 15:2018)."""
    text = resources.files("neurolens.render").joinpath("data/daylight.csv").read_text(encoding="utf-8")
    rows = np.array([line.split(",") for line in text.splitlines()[1:]], np.float64).T
    return rows[0], rows[1:]


def daylight_weights(x: FloatArray64, y: FloatArray64) -> FloatArray64:
    """Weights 1, M1, M2 [3, N] of S0, S1, S2 of daylight of chromaticities (x, y)."""
    below = 0.0241 + 0.2562 * x - 0.7341 * y
    m1 = (-1.3515 - 1.7703 * x + 5.9114 * y) / below
    m2 = (0.0300 - 31.4424 * x + 30.0717 * y) / below
    return np.stack([np.ones_like(m1), m1, m2])


def sun_direction(sky: Sky) -> FloatArray64:
    """Unit vector [3] towards the sun's middle."""
    up, around = math.radians(sky.sun_elevation_deg), math.radians(sky.sun_azimuth_deg)
    return np.array([math.cos(up) * math.sin(around), math.sin(up), -math.cos(up) * math.cos(around)])


def zenith(sky: Sky) -> dict[str, float]:
    """Luminance Y in kcd/m^2 and chromaticity x, y of the zenith."""
    sun, t = math.radians(90 - sky.sun_elevation_deg), sky.turbidity
    chi = (4 / 9 - t / 120) * (math.pi - 2 * sun)
    found = {"Y": (4.0453 * t - 4.9710) * math.tan(chi) - 0.2155 * t + 2.4192}
    powers = np.array([sun**3, sun**2, sun, 1.0])
    for name, matrix in _ZENITH.items():
        found[name] = float(np.array([t * t, t, 1.0]) @ np.array(matrix) @ powers)
    return found


def sky_colour(sky: Sky, direction: FloatArray) -> tuple[FloatArray64, FloatArray64, FloatArray64]:
    """Luminance [N] in kcd/m^2 and chromaticity x, y [N] in unit directions [3, N]; the horizon's colour below it."""
    height = np.maximum(direction[1].astype(np.float64), 1e-4)
    towards = np.clip(sun_direction(sky) @ direction.astype(np.float64), -1, 1)
    sun_height = math.sin(math.radians(sky.sun_elevation_deg))
    from_sun, at_zenith = np.arccos(towards), math.acos(sun_height)
    found = []
    for name, value in zenith(sky).items():
        a, b, c, d, e = (slope * sky.turbidity + offset for slope, offset in _PEREZ[name])
        seen = (1 + a * np.exp(b / height)) * (1 + c * np.exp(d * from_sun) + e * towards * towards)
        up = (1 + a * math.exp(b)) * (1 + c * math.exp(d * at_zenith) + e * sun_height**2)
        found.append(value * seen / up)
    luminance, x, y = found
    return np.where(direction[1] >= 0, luminance, 0.0), x, y


def sun_spectrum(sky: Sky) -> tuple[FloatArray64, FloatArray64, float]:
    """Wavelengths in nm, the sun's relative radiance there, and the luminance of its disc in kcd/m^2."""
    nm = table("wavelength_nm")
    outside = planck(nm, _SUN_K)
    zenith_deg = 90 - sky.sun_elevation_deg
    mass = 1 / (math.cos(math.radians(zenith_deg)) + 0.15 * (93.885 - zenith_deg) ** -1.253)
    um, beta = nm * 1e-3, 0.04608 * sky.turbidity - 0.04586
    inside = outside * np.exp(-mass * (0.008735 * um**-4.08 + beta * um**-1.3))
    left = float(np.sum(inside * table("y")) / np.sum(outside * table("y")))
    solid = 2 * math.pi * (1 - math.cos(SUN_RADIUS_RAD))
    return nm, inside, left * _SUN_LUX / solid * 1e-3


def total_spectrum(sky: Sky, direction: FloatArray) -> tuple[FloatArray64, NDArray[np.float64]]:
    """Wavelengths in nm and the spectrum of the sky's light, the mean over directions [3, N]."""
    luminance, x, y = sky_colour(sky, direction)
    nm, components = daylight_table()
    weights = daylight_weights(x, y)
    at = np.interp(nm, table("wavelength_nm"), table("y"))
    spectra = weights / (weights.T @ (components @ at)) * luminance
    return nm, np.asarray(np.maximum(spectra.mean(axis=1) @ components, 0))
