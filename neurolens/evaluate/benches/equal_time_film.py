"""Film-space error of a camera, point by point: where its ray lands on the film, as the exact lens sees it.

Both cameras send the ray of one film point, pupil sample and wavelength. The two rays meet the plane in focus; the step
between the two points is taken back to the film by the exact lens's own differential of that ray (Igehy 1999), the
point on the pupil held. The result is how far the film point of the exact lens would have to move for its ray through
the same pupil point to end where the other camera's does. `evaluate.film_equivalent` defines the same error for models,
with the differential of the chief ray.
"""

from __future__ import annotations

import math
from copy import copy
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from neurolens.base.errors import InputError
from neurolens.cameras.contract import Camera, CameraRays, DifferentialCamera, FloatArray
from neurolens.cameras.lens_film import LensFilm

FloatArray64 = NDArray[np.float64]
_BATCH = 8192
_SAME = 1e-6  # of the distance from film to pupil plane


@dataclass(frozen=True)
class FilmMap:
    """Film-space error of one camera over the film.

    Attributes:
        median_um: [rows, columns] median over pupil and wavelengths, as the picture shows the film; NaN where no ray
            passes both cameras.
        p50_um, p99_um: over all rays that pass both.
    """

    median_um: FloatArray64
    p50_um: float
    p99_um: float


def film_map(
    exact: DifferentialCamera,
    camera: Camera,
    *,
    wavelengths_nm: tuple[float, float],
    columns: int = 32,
    rows: int = 18,
    samples: int = 64,
    seed: int = 0,
) -> FilmMap:
    """Error of `camera` against `exact` at the middles of columns x rows parts of the film.

    Args:
        exact: traced ray by ray, not compiled: it takes the pupil outline of a camera of the same lens.
        wavelengths_nm: range, drawn uniformly.
        samples: random pupil points (and wavelengths) a film point, the same for both cameras.

    Raises:
        InputError: cameras of different film or focus.
    """
    if exact.film_mm != camera.film_mm:
        raise InputError("film map", "film_mm", camera.film_mm, f"that of the exact camera, {exact.film_mm}")
    focus = exact.settings.get("focus_m")
    if camera.settings.get("focus_m") != focus:
        raise InputError("film map", "focus_m", camera.settings.get("focus_m"), f"that of the exact camera, {focus}")
    exact = on_pupil_of(exact, camera)
    across, down = np.meshgrid((np.arange(columns) + 0.5) / columns, (np.arange(rows) + 0.5) / rows)
    # The picture shows the film turned by 180 degrees: see render.film.PixelGrid.
    middles = np.stack([(0.5 - across) * exact.film_mm[0], (down - 0.5) * exact.film_mm[1]]).reshape(2, -1)
    film = np.repeat(middles, samples, axis=1).astype(np.float32)
    random = np.random.default_rng(seed).random((3, film.shape[1]), np.float32)
    low, high = wavelengths_nm
    pupil, light = random[:2], (low + (high - low) * random[2]).astype(np.float32)
    parts = [slice(k, k + _BATCH) for k in range(0, film.shape[1], _BATCH)]
    each = np.concatenate([film_error_um(exact, camera, film[:, p], pupil[:, p], light[p], focus) for p in parts])
    passed = each[np.isfinite(each)]
    p50, p99 = np.percentile(passed, (50, 99)) if passed.size else (math.nan, math.nan)
    return FilmMap(_medians(each.reshape(rows * columns, samples)).reshape(rows, columns), float(p50), float(p99))


def on_pupil_of(exact: DifferentialCamera, camera: Camera) -> DifferentialCamera:
    """`exact` with the pupil outline of `camera`, where both are of one lens: a pupil sample is then one pupil point.

    Each searches its own outline else, and rims that differ by a hair would count as an error of the rays.
    """
    own, other = getattr(exact, "film", None), getattr(camera, "film", None)
    if not (isinstance(own, LensFilm) and isinstance(other, LensFilm)):
        return exact
    if abs(own.distance_mm / other.distance_mm - 1) > _SAME:
        return exact
    turned: Any = copy(exact)
    turned.film = copy(own)
    turned.film.outline, turned.film.pupil = other.outline, other.pupil
    found: DifferentialCamera = turned
    return found


def film_error_um(
    exact: DifferentialCamera,
    camera: Camera,
    film_mm: FloatArray,
    pupil: FloatArray,
    wavelength_nm: FloatArray,
    focus_m: float | None,
) -> FloatArray64:
    """[N] film-space error in um of rays [2, N], [2, N], [N] as in `Camera.sample`; NaN where one does not pass.

    `focus_m`: distance from the film to the plane in focus; None is infinity.
    """
    vergence = 0.0 if focus_m is None else 1 / focus_m
    film_mm, pupil, wavelength_nm = (np.ascontiguousarray(a) for a in (film_mm, pupil, wavelength_nm))
    true = exact.sample_differentials(film_mm, pupil, wavelength_nm)
    found = camera.sample(film_mm, pupil, wavelength_nm)
    step = _on_plane(found, vergence) - _on_plane(true, vergence)
    (a, b), (c, d) = _differential(true, vergence)
    with np.errstate(divide="ignore", invalid="ignore"):
        area = a * d - b * c
        moved = np.hypot((d * step[0] - b * step[1]) / area, (a * step[1] - c * step[0]) / area)
    return np.where((true.status == 0) & (found.status == 0), 1000 * moved, np.nan)


def _on_plane(rays: CameraRays, vergence: float) -> FloatArray64:
    """[2, N] where rays meet the plane in focus, over its distance: no special case at infinity. NaN behind."""
    o, d = rays.origin_m.astype(np.float64), rays.direction.astype(np.float64)
    ahead = np.where(d[2] < 0, -d[2], np.nan)
    return np.asarray(o[:2] * vergence + d[:2] / ahead * (1 + o[2] * vergence))


def _differential(rays: CameraRays, vergence: float) -> FloatArray64:
    """[2, 2, N] derivative of `_on_plane` (first index) by the film point's x and y (second), per mm."""
    assert rays.differentials is not None
    o, d = rays.origin_m.astype(np.float64), rays.direction.astype(np.float64)
    do, dd = (m.astype(np.float64) for m in (rays.differentials.origin_m, rays.differentials.direction))
    ahead = np.where(d[2] < 0, -d[2], np.nan)
    slope = d[:2] / ahead
    turn = (dd[:2] + slope[:, None] * dd[2]) / ahead  # of the slope
    return np.asarray(do[:2] * vergence + turn * (1 + o[2] * vergence) + slope[:, None] * do[2] * vergence)


def _medians(each: FloatArray64) -> FloatArray64:
    """Median of each row without its NaN; NaN where nothing else is there."""
    return np.array([np.median(kept) if (kept := row[np.isfinite(row)]).size else math.nan for row in each])
