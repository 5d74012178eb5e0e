"""What share of the rays that a pupil sends pass the lens, method by method, beside the figures of the theses.

Rates are over lit film points; the dark share of the film, which costs nothing, stands apart. A pupil that is too small
loses light: the irradiance that it finds is compared with that through the whole rear rim.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from torch.quasirandom import SobolEngine

from neurolens.cameras.exact import ExactCamera
from neurolens.cameras.pupil_boxes import PupilTable
from neurolens.cameras.pupil_outline import PupilOutline
from neurolens.evaluate.benches.passage_cases import TABLE_5_3, Case
from neurolens.optics import pupil_methods as known
from neurolens.optics.lensfile import read_lens
from neurolens.optics.prescription import Lens
from neurolens.optics.pupils import pupil_bounds

FILM_MM = (36.0, 24.0)
OURS = "outlines (ours)"
METHODS = (
    "rear rim",
    "exit pupil",
    "Wu, two steps",
    "pixel disc",
    "pixel ellipse",
    "radial boxes",
    "radial ellipses",
    "interpolated boxes",
    OURS,
)
SAMPLES = 2**17

# Film and pupil samples [2, N] and wavelengths [N] to pupil points [2, N] and areas [N] (float32 or float64).
SampleFunction = Callable[[Any, Any, Any], tuple[Any, Any]]


@dataclass(frozen=True)
class Rate:
    """Of one method: share of the rays from lit film points that pass; irradiance found over the true one (mean over
    the film); search time in s; time of a sample in ns."""

    passed: float
    light: float
    search_s: float
    sample_ns: float


@dataclass(frozen=True)
class Passage:
    """Rates of a case by method; the lit radius, the dark share of the film, light that `OURS` is known to lose."""

    case: Case
    rates: dict[str, Rate]
    lit_radius_mm: float
    dark: float
    lost: float
    by_radius: dict[str, NDArray[np.float64]]


def camera_of(case: Case, folder: Path) -> ExactCamera:
    """The lens of a case, read from `folder`, on `FILM_MM`, focused at infinity."""
    lens = read_lens(folder / f"{case.lens}.toml").at(focal_length_mm=case.focal_length_mm, f_number=case.f_number)
    return ExactCamera(lens, film_mm=FILM_MM, focus_m=math.inf)


def measure(case: Case, folder: Path, samples: int = SAMPLES) -> Passage:
    """Rates of every method for a case, in light of 400 to 700 nm."""
    start = time.perf_counter()
    camera = camera_of(case, folder)
    lens = camera.lens
    found = time.perf_counter() - start
    outline = camera.film.outline
    film, square, wavelength = _samples(samples, 1, outline.film_radius_mm)
    rates, by_radius = {}, {}
    true = true_irradiance(camera, samples)
    for name, make in _pupils(lens, outline).items():
        start = time.perf_counter()
        plane, sample = make()
        search_s = found if name == OURS else time.perf_counter() - start
        passed, light = _irradiance(camera, _Pupil(plane, sample), film, square, wavelength)
        rates[name] = Rate(float(passed.mean()), light / true, search_s, _nanoseconds(sample, film, square, wavelength))
        by_radius[name] = _profile(np.hypot(*film), passed, outline.film_radius_mm)
    lost = lost_light(camera, film, square, wavelength)
    return Passage(case, rates, outline.film_radius_mm, 1 - film.shape[1] / samples, lost, by_radius)


def true_irradiance(camera: ExactCamera, samples: int) -> float:
    """Mean irradiance of the lit film through an axial disc 1.3 times that of all rays found on a grid, with four times
    the samples: what is known of the lens's pupil plays no part in it."""
    lens, radius = camera.lens, camera.film.outline.film_radius_mm
    disc = known.hull_disc(lens, radius)
    wide = replace(disc, along=1.3 * disc.along, across=1.3 * disc.across)
    total = count = 0.0
    for seed in range(4):
        film, square, wavelength = _samples(samples, seed + 10, radius)
        total += _irradiance(camera, wide, film, square, wavelength)[1] * film.shape[1]
        count += film.shape[1]
    return total / count


def _samples(samples: int, seed: int, lit_radius_mm: float) -> tuple[Any, Any, Any]:
    """Film points [2, n] of `FILM_MM` within the lit radius, squares [2, n] and wavelengths [n], float32."""
    draws = SobolEngine(5, scramble=True, seed=seed).draw(samples).numpy().T
    film = (draws[:2] - 0.5) * np.array(FILM_MM, np.float32)[:, None]
    lit = np.hypot(*film) <= lit_radius_mm
    return film[:, lit], draws[2:4, lit], 400 + 300 * draws[4, lit]


def lost_light(camera: ExactCamera, film: Any, square: Any, wavelength: Any, wider: float = 1.1) -> float:
    """Share of the light that passes outside the outlines, from rays through outlines so many times wider."""
    outline = camera.film.outline
    wide = replace(outline, x=outline.x * np.float32(wider), y=outline.y * np.float32(wider))
    points, area = wide.sample(film, square, wavelength)
    passed = camera.film.scene(film, points, wavelength).status == 0
    outside = np.abs(2 * square - 1).max(0) > 1 / wider
    return float((area * (passed & outside)).sum() / (area * passed).sum())


@dataclass(frozen=True)
class _Pupil:
    pupil_z_mm: float
    sample: SampleFunction


def _pupils(lens: Lens, outline: PupilOutline) -> dict[str, Callable[[], tuple[float, SampleFunction]]]:
    """How to make the pupil of each of `METHODS`: its plane and its samples."""
    end, film_z = outline.film_radius_mm, lens.film_z_mm
    assert film_z is not None

    def of(make: Callable[..., known.RadialPupil], *args: Any) -> Callable[[], tuple[float, SampleFunction]]:
        def made() -> tuple[float, SampleFunction]:
            pupil = make(lens, end, *args)
            return pupil.pupil_z_mm, pupil.sample

        return made

    def boxes() -> tuple[float, SampleFunction]:
        bounds = pupil_bounds(lens, end, (film_z, film_z), (400.0, 700.0))
        table = PupilTable.of(vars(bounds))
        return bounds.pupil_z_mm, lambda film, square, wavelength: table.sample(film, square)

    makers = (
        of(known.rear_rim),
        of(known.global_exit_pupil),
        of(known.wu_exit_pupil),
        of(known.pixel_pupils, "disc"),
        of(known.pixel_pupils, "ellipse"),
        of(known.radial_bounds, "box"),
        of(known.radial_bounds, "ellipse"),
        boxes,
        lambda: (outline.pupil_z_mm, outline.sample),
    )
    return dict(zip(METHODS, makers, strict=True))


def _irradiance(camera: ExactCamera, pupil: Any, film: Any, square: Any, wavelength: Any) -> tuple[Any, float]:
    """Which rays through a pupil's samples pass, bool [N], and the mean irradiance (T = 1, radiance 1)."""
    points, area = pupil.sample(film, square, wavelength)
    distance = camera.film.film_z_mm - pupil.pupil_z_mm
    slope = (points - film) / distance
    # The camera's own scene function takes points of its own plane: the same rays, followed there.
    own = film + slope * camera.film.distance_mm
    passed = camera.film.scene(film, own.astype(np.float32), wavelength).status == 0
    passed &= area > 0
    weight = passed * area / (distance * (1 + (slope * slope).sum(0))) ** 2
    return passed, float(weight.mean(dtype=np.float64))


def _nanoseconds(sample: SampleFunction, film: Any, square: Any, wavelength: Any, batch: int = 16384) -> float:
    """The least of several times of a sample in a batch."""
    part = slice(0, batch)
    film, square, wavelength = (np.ascontiguousarray(a[..., part]) for a in (film, square, wavelength))
    least = math.inf
    for _ in range(7):
        start = time.perf_counter()
        sample(film, square, wavelength)
        least = min(least, time.perf_counter() - start)
    return 1e9 * least / film.shape[1]


def _profile(radius: Any, passed: Any, end: float, bins: int = 24) -> NDArray[np.float64]:
    """Share that passes in equal intervals of the film radius."""
    place = np.minimum((radius / end * bins).astype(int), bins - 1)
    count = np.bincount(place, minlength=bins)
    return np.bincount(place, weights=passed, minlength=bins) / np.maximum(count, 1)


def pixel_rates(folder: Path, samples: int = SAMPLES) -> Iterator[tuple[float, float, float]]:
    """f-number, percent that passes from the pixel of Table 5.3 through the rear rim, and theirs; 36 x 27 mm film."""
    radius = math.hypot(128, 96) * 36 / 512
    r, angle = SobolEngine(2, scramble=True, seed=1).draw(samples).double().numpy().T
    r, angle = np.sqrt(r), 2 * math.pi * angle
    for f_number, theirs in TABLE_5_3.items():
        lens = read_lens(folder / "brendel_tessar_100.toml").at(focal_length_mm=50.0, f_number=f_number)
        rim = known.rear_rim(lens, radius)
        points = rim.along[0] * np.stack([r * np.cos(angle), r * np.sin(angle)])
        passed = known.passes_through(lens, rim.pupil_z_mm)(np.full(samples, radius), points)
        yield f_number, 100 * float(passed.mean()), theirs
