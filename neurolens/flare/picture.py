"""Flare in a picture: lights, the light they send into the lens, the ghosts' light on the film, and a table of ghosts.

Rays go through a disc across the light's way that holds the whole front surface, at the places of a low-discrepancy
sequence that is the same every time: an animated light has no noise of its own. Values are those of a render: film
irradiance over the irradiance that a white card of radiance 1 makes on the axis.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from neurolens.base.errors import InputError
from neurolens.flare.ghosts import GhostTracer, Pair
from neurolens.flare.stack import Floats
from neurolens.optics.prescription import Lens
from neurolens.optics.sag import sag_mm
from neurolens.optics.trace import Rays, trace
from neurolens.render.spectrum import SpectralRange

RANKED = 4096  # rays that decide which ghosts are brightest
_AT_ONCE = 1 << 16  # rays of a call
_AXIS = 1 << 15  # rays of the exposure
_PLASTIC = 1.32471795724474602596  # of the R2 sequence (Roberts 2018): x^3 = x + 1


@dataclass(frozen=True)
class Light:
    """A light far away, or at a place.

    Attributes:
        azimuth_deg: to the right of the axis, seen by the camera; elevation_deg: above it.
        rgb: linear sRGB irradiance that it makes at the lens across its way: radiance times solid angle in sr.
        distance_m: from the front vertex; inf allowed.

    Raises:
        InputError: angles that do not come from the front (the light lies behind the lens), a distance that is not
            positive, an irradiance that is negative.
    """

    azimuth_deg: float
    elevation_deg: float
    rgb: tuple[float, float, float] = (1.0, 1.0, 1.0)
    distance_m: float = math.inf

    def __post_init__(self) -> None:
        if not (abs(self.elevation_deg) < 90 and math.isfinite(self.azimuth_deg) and self.towards[2] < 0):
            found = (self.azimuth_deg, self.elevation_deg)
            raise InputError("light", "azimuth, elevation", found, "angles within 90 degrees of the axis")
        if not self.distance_m > 0:
            raise InputError("light", "distance_m", self.distance_m, "a positive distance in metres, or inf")
        if not all(0 <= v < math.inf for v in self.rgb):
            raise InputError("light", "rgb", self.rgb, "three finite numbers of at least 0")

    @property
    def towards(self) -> NDArray[np.float64]:
        """Unit vector from the lens to the light, lens frame."""
        a, e = math.radians(self.azimuth_deg), math.radians(self.elevation_deg)
        return np.array([math.sin(a) * math.cos(e), math.sin(e), -math.cos(a) * math.cos(e)])


def light_rays(
    lens: Lens, light: Light, first: int, count: int, shift: float = 0.0, jitter: float = 0.0
) -> tuple[Floats, float]:
    """Rays number `first` and following of a light, [6, count] lens frame, and the area in mm^2 that all N share: the
    irradiance at the lens times area / N is the light of one of N rays.

    Args:
        shift: of the sequence, for each wavelength another. jitter: see `_disc`.
    """
    front = lens.surfaces[0]
    depth = float(sag_mm(front, front.semi_diameter_mm, 0.0))
    centre, radius = np.array([0.0, 0.0, depth / 2]), math.hypot(front.semi_diameter_mm, depth / 2)
    ahead = light.towards
    side = np.cross(ahead, [0.0, 1.0, 0.0] if abs(ahead[1]) < 0.9 else [1.0, 0.0, 0.0])
    side /= np.linalg.norm(side)
    up = np.cross(side, ahead)
    x, y = radius * _disc(first, count, shift, jitter)
    across = side[:, None] * x + up[:, None] * y
    target = centre[:, None] + across
    if math.isinf(light.distance_m):
        direction = np.broadcast_to(-ahead[:, None], target.shape)
    else:
        direction = target - (1000 * light.distance_m * ahead)[:, None]
        direction = direction / np.linalg.norm(direction, axis=0)
    return np.concatenate([target, direction]), math.pi * radius**2


def _disc(first: int, count: int, shift: float = 0.0, jitter: float = 0.0) -> NDArray[np.float64]:
    """Points [2, count] of the unit disc, of equal shares: the R2 sequence from a number on, shifted.

    `jitter` moves each by up to so much of the square's side: regular places make patterns in a picture.
    """
    n = np.arange(first, first + count) + 1.0
    moved = jitter * np.random.default_rng([first, int(shift * 2**32)]).random((2, count))
    u, v = (n / _PLASTIC + shift + moved[0]) % 1, (n / _PLASTIC**2 + 0.5 * shift + moved[1]) % 1
    return np.sqrt(u) * np.stack([np.cos(2 * math.pi * v), np.sin(2 * math.pi * v)])


def axis_irradiance(lens: Lens, wavelength_nm: float) -> float:
    """Irradiance at the film's centre from uniform surroundings of radiance 1, in sr: the integral of T cos."""
    film_z = lens.film_z_mm
    assert film_z is not None  # of a tracer's lens

    def share(sines: NDArray[np.float64]) -> NDArray[np.float64]:
        d = torch.from_numpy(np.stack([*sines, -np.sqrt(1 - (sines**2).sum(0))]))
        zero = torch.zeros_like(d[0])
        rays = Rays(zero, zero, zero + film_z, *d)
        found = trace(lens, rays, wavelength_nm, transmittance=True)
        assert found.transmittance is not None
        return torch.where(found.status == 0, found.transmittance, 0.0).numpy()

    coarse = _disc(0, _AXIS)
    widest = 1.0
    for _ in range(3):  # narrows to the cone that passes, and a little more
        lit = share(widest * coarse) > 0
        widest *= 1.02 * float(np.hypot(*coarse)[lit].max(initial=0.0)) if lit.any() else 0.3
    return math.pi * widest**2 * float(share(min(widest, 1.0) * coarse).mean())


@dataclass(frozen=True)
class Ghost:
    """One ghost of a light.

    Attributes:
        pair: its surfaces. energy: its light on the film's plane over that of the image of the same light.
        centre_mm: x, y of its mean on the film, lens frame, [2]. size_mm: root mean square distance from it.
        passed: share of the rays at the front disc that arrive.
    """

    pair: Pair
    energy: float
    centre_mm: tuple[float, float]
    size_mm: float
    passed: float


def ghost_table(tracer: GhostTracer, light: Light, wavelength_nm: float, count: int = RANKED) -> list[Ghost]:
    """The ghosts of a light at one wavelength that reach the film's plane at all, brightest first."""
    rays, _ = light_rays(tracer.lens, light, 0, count)
    found = tracer.trace(rays, wavelength_nm, direct=True)
    power = found.power.astype(np.float64)
    image = power[-1].sum()
    rows = []
    for pair, xy, share in zip(tracer.pairs, found.film_xy_mm, power, strict=False):
        if not share.sum() > 0:
            continue
        lit = share > 0
        weight, place = share[lit] / share.sum(), xy[:, lit].astype(np.float64)
        centre = place @ weight
        size = math.sqrt(float(((place - centre[:, None]) ** 2).sum(0) @ weight))
        energy = float(share.sum() / image) if image > 0 else math.inf
        rows.append(Ghost(pair, energy, (float(centre[0]), float(centre[1])), size, float(lit.mean())))
    return sorted(rows, key=lambda ghost: -ghost.energy)


@dataclass(frozen=True)
class Raster:
    """The film and its pixels: width and height in mm, and in pixels."""

    film_mm: tuple[float, float]
    width: int
    height: int


def ghost_picture(
    tracer: GhostTracer,
    lights: Sequence[Light],
    raster: Raster,
    *,
    wavelength_nm: tuple[float, float] = (400.0, 700.0),
    wavelengths: int = 15,
    samples: int = 1 << 18,
    layers: Sequence[int] | None = None,
    threads: int = 2,
    done: Callable[[float], None] = lambda share: None,
) -> Floats:
    """The ghosts of lights, [layers, H, W, 3] linear sRGB.

    Args:
        wavelengths: of equal shares of the range. samples: rays of each light and wavelength.
        layers: of each pair the layer that takes it; None puts all into one.
        done: told the share of the work that is done.
    """
    given = [0] * len(tracer.pairs) if layers is None else list(layers)
    count = max(given, default=0) + 1
    spectral = SpectralRange(*wavelength_nm, bins=wavelengths)
    pixel_mm = raster.film_mm[0] / raster.width
    exposure = axis_irradiance(tracer.lens, 0.5 * sum(wavelength_nm))
    tasks = [(light, k) for light in lights for k in range(wavelengths)]

    def one(task: tuple[Light, int]) -> tuple[Floats, NDArray[np.float64]]:
        light, k = task
        film = np.zeros((count, raster.height, raster.width), np.float32)
        area = 0.0
        for first in range(0, samples, _AT_ONCE):
            part = min(_AT_ONCE, samples - first)
            rays, area = light_rays(tracer.lens, light, first, part, k / wavelengths, samples**-0.5)
            tracer.splat(film, rays, float(spectral.centres_nm[k]), 1 / pixel_mm, given)
        colour = spectral.response[:, k] * spectral.spectrum(light.rgb)[k] / wavelengths
        return film, colour * (area / samples / (pixel_mm**2 * exposure))

    picture = np.zeros((count, raster.height, raster.width, 3), np.float32)
    with ThreadPoolExecutor(threads) as pool:
        for number, (film, colour) in enumerate(pool.map(one, tasks)):
            picture += film[..., None] * colour.astype(np.float32)
            done((number + 1) / len(tasks))
    return picture
