"""Flare in a picture: lights, the light they send into the lens, the ghosts' light on the film, and a table of ghosts.

Rays go through a disc across the light's way that holds the whole front surface, at the places of a low-discrepancy
sequence that is the same every time: an animated light has no noise of its own. Values are those of a render: film
irradiance over the irradiance that a white card of radiance 1 makes on the axis.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray

from neurolens.analysis.fields import Scene
from neurolens.analysis.layout import Layout, Line, layout_profile
from neurolens.base.errors import InputError
from neurolens.base.status import PASSED
from neurolens.flare.ghosts import GhostTracer, Pair
from neurolens.flare.photons import PhotonTracer
from neurolens.flare.stack import Floats
from neurolens.optics.prescription import Lens
from neurolens.optics.sag import sag_mm
from neurolens.optics.sequence import follow, ghost
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
    irradiance at the lens times area / N is the light of one of N rays. All carry the same: they are uniform across the
    way of a light far away, and in solid angle from a near one.

    Args:
        shift: of the sequence, for each wavelength another. jitter: see `_disc`.
    """
    front = lens.surfaces[0]
    depth = float(sag_mm(front, front.semi_diameter_mm, 0.0))
    centre, radius = np.array([0.0, 0.0, depth / 2]), math.hypot(front.semi_diameter_mm, depth / 2)
    ahead = light.towards
    side = np.cross(ahead, [0.0, 1.0, 0.0] if abs(ahead[1]) < 0.9 else [1.0, 0.0, 0.0])
    side /= np.linalg.norm(side)
    across = np.stack([side, np.cross(side, ahead)], 1) @ _disc(first, count, shift, jitter)
    if math.isinf(light.distance_m):
        target = centre[:, None] + radius * across
        return np.concatenate([target, np.broadcast_to(-ahead[:, None], target.shape)]), math.pi * radius**2
    source = 1000 * light.distance_m * ahead
    far = float(np.linalg.norm(source - centre))
    if far <= 1.01 * radius:
        expected = f"a light outside the lens, beyond {radius / 1000:.3g} m"
        raise InputError("light", "distance_m", light.distance_m, expected)
    # Uniform in solid angle over the cone that holds the sphere about the front surface.
    solid = 1 - math.sqrt(1 - (radius / far) ** 2)
    off = across * np.sqrt(solid * (2 - solid * (across**2).sum(0)))
    towards = (centre - source) / far
    off -= towards[:, None] * (towards @ off)
    cos = 1 - solid * (across**2).sum(0)
    sine = np.sqrt(np.maximum(1 - cos**2, 0)) / np.maximum(np.linalg.norm(off, axis=0), 1e-300)
    direction = towards[:, None] * cos + off * sine
    return np.concatenate([source[:, None] + direction * (far - radius), direction]), 2 * math.pi * solid * far**2


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


def ghost_layout(lens: Lens, pair: Pair, light: Light, lines: int = 9) -> Layout:
    """The lens with rays of one ghost in the plane through the axis, of light as far off the axis as `light`.

    At most so many rays, evenly chosen of those that arrive.

    Raises:
        InputError: none does.
    """
    front = lens.surfaces[0].semi_diameter_mm
    off = math.acos(min(-float(light.towards[2]), 1.0))
    height = torch.linspace(-1.2 * front, 1.2 * front, 4001, dtype=torch.float64)
    zero, before = torch.zeros_like(height), -0.4 * front
    rays = Rays(zero, height + before * math.tan(-off), zero + before, zero, zero - math.sin(off), zero + math.cos(off))
    found = follow(lens, rays, ghost(len(lens.surfaces), *pair))
    arriving = torch.nonzero(found.status == PASSED)[:, 0]
    if not len(arriving):
        raise InputError(
            lens.path, "ghost", pair.name, f"one of which light {math.degrees(off):.3g} degrees off arrives"
        )
    chosen = arriving[torch.linspace(0, len(arriving) - 1, min(lines, len(arriving))).long()]
    scene = Scene(lens, math.inf)
    way = (scene.film_z_mm - found.rays.z) / found.rays.dz
    places = [(rays.z, rays.y), *((z, y) for _, y, z in found.points)]
    places.append((found.rays.z + way * found.rays.dz, found.rays.y + way * found.rays.dy))
    label = f"{pair.name}, {len(arriving) / len(height):.0%} of the height"
    drawn = tuple(Line(np.array([[float(z[k]), float(y[k])] for z, y in places]), label, 0) for k in chosen)
    subtitle = (
        f"light {math.degrees(off):.3g} degrees off the axis, reflected at surface {pair.second}, then {pair.first}"
    )
    return replace(layout_profile(scene), rays=drawn, subtitle=subtitle)


@dataclass(frozen=True)
class Raster:
    """The film and its pixels: width and height in mm, and in pixels."""

    film_mm: tuple[float, float]
    width: int
    height: int

    @property
    def per_mm(self) -> float:
        return self.width / self.film_mm[0]


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

    def splat(rays: Floats, nm: float, film: Floats, seed: int) -> None:
        tracer.splat(film, rays, nm, raster.per_mm, given)

    spectral = SpectralRange(*wavelength_nm, bins=wavelengths)
    return _picture(tracer.lens, lights, raster, spectral, samples, (count, threads), splat, done)


def photon_picture(
    tracer: PhotonTracer,
    lights: Sequence[Light],
    raster: Raster,
    *,
    wavelength_nm: tuple[float, float] = (400.0, 700.0),
    wavelengths: int = 15,
    photons: int = 1 << 20,
    most_reflections: int = 10,
    kernel_px: float = 3.0,
    threads: int = 2,
    done: Callable[[float], None] = lambda share: None,
) -> Floats:
    """The photons of lights that were reflected at least once, [H, W, 3] linear sRGB, by density estimation.

    Args:
        photons: of each light and wavelength. kernel_px: radius of the kernel (Epanechnikov's, 2 / pi (1 - r^2)).
    """

    def splat(rays: Floats, nm: float, film: Floats, seed: int) -> None:
        found = tracer.trace(rays, nm, most_reflections=most_reflections, seed=seed)
        x, y = found.film_xy_mm[:, found.reflections > 0] * raster.per_mm
        edges = (np.arange(raster.height + 1) - raster.height / 2, np.arange(raster.width + 1) - raster.width / 2)
        film[0] += np.histogram2d(y, -x, bins=edges)[0]

    spectral = SpectralRange(*wavelength_nm, bins=wavelengths)
    picture = _picture(tracer.lens, lights, raster, spectral, photons, (1, threads), splat, done)[0]
    return _smoothed(picture, kernel_px)


def _picture(
    lens: Lens,
    lights: Sequence[Light],
    raster: Raster,
    spectral: SpectralRange,
    samples: int,
    layers_threads: tuple[int, int],
    splat: Callable[[Floats, float, Floats, int], None],
    done: Callable[[float], None],
) -> Floats:
    """Film [layers, H, W, 3] of rays of every light and bin of the spectrum, which `splat` adds to [layers, H, W]."""
    (layers, threads), bins = layers_threads, spectral.bins
    exposure = axis_irradiance(lens, 0.5 * (spectral.low_nm + spectral.high_nm))
    tasks = [(number, light, k) for number, light in enumerate(lights) for k in range(bins)]

    def one(task: tuple[int, Light, int]) -> tuple[Floats, NDArray[np.float64]]:
        number, light, k = task
        film = np.zeros((layers, raster.height, raster.width), np.float32)
        area = 0.0
        for first in range(0, samples, _AT_ONCE):
            rays, area = light_rays(lens, light, first, min(_AT_ONCE, samples - first), k / bins, samples**-0.5)
            # A seed of its own, the same for any number of threads.
            splat(rays, float(spectral.centres_nm[k]), film, (number * bins + k) * samples + first)
        colour = spectral.response[:, k] * spectral.spectrum(light.rgb)[k] / bins
        return film, colour * (area * raster.per_mm**2 / samples / exposure)

    picture = np.zeros((layers, raster.height, raster.width, 3), np.float32)
    with ThreadPoolExecutor(threads) as pool:
        for number, (film, colour) in enumerate(pool.map(one, tasks)):
            picture += film[..., None] * colour.astype(np.float32)
            done((number + 1) / len(tasks))
    return picture


def _smoothed(picture: Floats, radius: float) -> Floats:
    """A picture [H, W, 3] under a kernel that keeps its sum; light goes over the edges as if dark surrounded it."""
    reach = math.ceil(radius)
    y, x = np.mgrid[-reach : reach + 1, -reach : reach + 1]
    kernel = np.maximum(1 - (x * x + y * y) / max(radius, 1e-9) ** 2, 0)
    kernel[reach, reach] = 1
    size = [n + 2 * reach for n in picture.shape[:2]]
    whole = np.fft.rfft2(picture, size, axes=(0, 1)) * np.fft.rfft2(kernel / kernel.sum(), size)[..., None]
    kept = np.fft.irfft2(whole, size, axes=(0, 1))[reach : size[0] - reach, reach : size[1] - reach]
    return np.maximum(kept, 0).astype(np.float32)
