"""Bias and variance of a Monte Carlo render, and what follows for the time that an error takes; errors on the film.

A progressive render adds passes of n samples, each with a seed of its own. Its squared error against the truth, mean
over the pixels, is then exactly bias^2 + V / K after K passes, with V the variance of one pass (within a pass, the
low-discrepancy samples do better than 1/N; passes are independent). With pictures I_i of the passes and two independent
halves R_1, R_2 of a reference, the products <I_i - R_1, I_j - R_2> have the mean bias^2 for i != j, and bias^2 + V for
i = j: the law taken to K = infinity, free of the reference's own noise. With a second camera's passes J_i that share
all random numbers, <I_i - J_i, I_j - J_j> for i != j has the mean bias^2 between the two, and most noise cancels first.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from copy import copy
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from neurolens.base.errors import InputError
from neurolens.cameras.contract import Camera, CameraRays, DifferentialCamera, FloatArray
from neurolens.cameras.lenscamera import LensFilm

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Estimate:
    """A value and its standard deviation, by the jackknife over the passes."""

    value: float
    sd: float

    @property
    def upper(self) -> float:
        """Two standard deviations above, at least 0: what a value that is not resolved stays below."""
        return max(self.value, 0.0) + 2 * self.sd

    @property
    def resolved(self) -> bool:
        return self.value > 2 * self.sd


@dataclass(frozen=True)
class Law:
    """Squared error over time: `first` within the first pass as measured, bias2 + variance * pass_s / t after it.

    Attributes:
        bias2, variance: bias^2, and the variance of one pass.
        pass_s: seconds of a pass.
        first: (seconds, squared error) of renders with fewer samples, in order of time; the pass itself ends them.
    """

    bias2: float
    variance: float
    pass_s: float
    first: tuple[tuple[float, float], ...] = ()

    def at(self, seconds: float) -> float:
        """The squared error after `seconds`; before the first render there is none: inf."""
        if seconds >= self.pass_s:
            return self.bias2 + self.variance * self.pass_s / seconds
        points = [*self.first, (self.pass_s, self.bias2 + self.variance)]
        if seconds < points[0][0]:
            return float("inf")
        return log_interpolate(seconds, points)


def log_interpolate(x: float, points: Sequence[tuple[float, float]]) -> float:
    """Linear between points in logarithms; x beyond the ends takes the end. All numbers above 0, x ascending."""
    logs = np.log(np.array(points, np.float64))
    return float(np.exp(np.interp(np.log(x), logs[:, 0], logs[:, 1])))


def weights(reference: ArrayLike, eps: float | None) -> Floats:
    """Weight of each value's squared error: 1 for the MSE (eps None), 1 / (R^2 + eps) for the relative MSE."""
    values = np.asarray(reference, np.float64)
    return np.ones_like(values) if eps is None else 1 / (values**2 + eps)


def squared_error(image: ArrayLike, halves: Sequence[ArrayLike], weight: ArrayLike) -> float:
    """Weighted mean of (I - R_1)(I - R_2): the squared error of `image`, without the reference's own noise.

    It may come out below 0 where the error is smaller than that noise.
    """
    one, two = (np.asarray(image, np.float64) - np.asarray(half, np.float64) for half in halves)
    return float(np.mean(np.asarray(weight) * one * two))


def reference_variance(halves: Sequence[ArrayLike], weight: ArrayLike) -> float:
    """Variance of the mean of two independent halves: a quarter of their mean squared difference."""
    difference = np.asarray(halves[0], np.float64) - np.asarray(halves[1], np.float64)
    return float(np.mean(np.asarray(weight) * difference**2)) / 4


def bias_and_variance(passes: ArrayLike, halves: Sequence[ArrayLike], weight: ArrayLike) -> tuple[Estimate, Estimate]:
    """bias^2 and the variance of one pass, from passes [K, ...] with seeds of their own; see the module.

    Raises:
        InputError: fewer than three passes, which leave no deviation.
    """
    rows = _rows(passes)
    root = np.sqrt(np.asarray(weight, np.float64)).ravel()
    one, two = ((rows - np.asarray(half, np.float64).ravel()) * root for half in halves)
    gram = one @ two.T / rows.shape[1]
    return _jackknife(gram, _apart), _jackknife(gram, lambda g: float(np.trace(g)) / len(g) - _apart(g))


def paired_bias(passes: ArrayLike, others: ArrayLike, weight: ArrayLike) -> Estimate:
    """bias^2 between two cameras whose passes [K, ...] share their random numbers, pass by pass.

    Raises:
        InputError: passes that do not pair, or fewer than three.
    """
    rows, against = _rows(passes), _rows(others)
    if rows.shape != against.shape:
        raise InputError("paired bias", "passes", f"({rows.shape})", f"those of the other camera, {against.shape}")
    difference = (rows - against) * np.sqrt(np.asarray(weight, np.float64)).ravel()
    return _jackknife(difference @ difference.T / rows.shape[1], _apart)


def crossover_s(exact: Law, other: Law) -> float:
    """Seconds after which `exact`, whose bias is 0, stays the more precise of two; inf where it never is.

    0 where `other` is never ahead. Within the first pass the laws are those measured, after it those of the module.
    """
    gain = exact.variance * exact.pass_s - other.variance * other.pass_s
    began = max(exact.pass_s, other.pass_s)
    if gain > 0 and gain > other.bias2 * began:
        return gain / other.bias2 if other.bias2 > 0 else float("inf")
    start = min([exact.pass_s, other.pass_s] + [law.first[0][0] for law in (exact, other) if law.first])
    times = np.geomspace(start, began, 512)
    ahead = [t for t in times if other.at(t) < exact.at(t)]
    return float(ahead[-1]) if ahead else 0.0


def _rows(passes: ArrayLike) -> Floats:
    values = np.asarray(passes, np.float64)
    if values.ndim < 2 or len(values) < 3:
        raise InputError("bias and variance", "passes", f"({len(np.atleast_1d(values))})", "at least three pictures")
    return values.reshape(len(values), -1)


def _apart(gram: Floats) -> float:
    count = len(gram)
    return float(gram.sum() - np.trace(gram)) / (count * (count - 1))


def _jackknife(gram: Floats, statistic: Callable[[Floats], float]) -> Estimate:
    """A statistic of the products of passes, and its deviation from leaving out one pass after the other (Tukey)."""
    count = len(gram)
    without = np.array([statistic(np.delete(np.delete(gram, k, 0), k, 1)) for k in range(count)])
    return Estimate(statistic(gram), float(np.sqrt((count - 1) * np.mean((without - without.mean()) ** 2))))


_BATCH = 8192
_SAME = 1e-6  # of the distance from film to pupil plane


@dataclass(frozen=True)
class FilmMap:
    """Film-space error of one camera, over the rays that pass it and the exact lens.

    `median_um`: [rows, columns] median over pupil and wavelengths, as the picture shows the film; NaN without a ray.
    """

    median_um: Floats
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
    same: Any = copy(exact)
    if abs(own.distance_mm / other.distance_mm - 1) <= _SAME:
        same.film = copy(own)
        same.film.outline = other.outline
    return same


def film_error_um(
    exact: DifferentialCamera,
    camera: Camera,
    film_mm: FloatArray,
    pupil: FloatArray,
    wavelength_nm: FloatArray,
    focus_m: float | None,
) -> Floats:
    """[N] film-space error in um of rays [2, N], [2, N], [N] as in `Camera.sample`; NaN where one does not pass.

    `focus_m`: distance from the film to the plane in focus; None is infinity.
    """
    vergence = 0.0 if focus_m is None else 1 / focus_m
    arrays = [np.ascontiguousarray(a) for a in (film_mm, pupil, wavelength_nm)]
    true, rays = exact.sample_differentials(*arrays), camera.sample(*arrays)
    step = _on_plane(rays, vergence) - _on_plane(true, vergence)
    (a, b), (c, d) = _differential(true, vergence)
    with np.errstate(divide="ignore", invalid="ignore"):
        area = a * d - b * c
        moved = np.hypot((d * step[0] - b * step[1]) / area, (a * step[1] - c * step[0]) / area)
    return np.where((true.status == 0) & (rays.status == 0), 1000 * moved, np.nan)


def _on_plane(rays: CameraRays, vergence: float) -> Floats:
    """[2, N] where rays meet the plane in focus, over its distance: no special case at infinity. NaN behind."""
    o, d = rays.origin_m.astype(np.float64), rays.direction.astype(np.float64)
    ahead = np.where(d[2] < 0, -d[2], np.nan)
    return np.asarray(o[:2] * vergence + d[:2] / ahead * (1 + o[2] * vergence))


def _differential(rays: CameraRays, vergence: float) -> Floats:
    """[2, 2, N] derivative of `_on_plane` (first index) by the film point's x and y (second), per mm."""
    assert rays.differentials is not None
    o, d = rays.origin_m.astype(np.float64), rays.direction.astype(np.float64)
    do, dd = (m.astype(np.float64) for m in (rays.differentials.origin_m, rays.differentials.direction))
    ahead = np.where(d[2] < 0, -d[2], np.nan)
    slope = d[:2] / ahead
    turn = (dd[:2] + slope[:, None] * dd[2]) / ahead  # of the slope
    return np.asarray(do[:2] * vergence + turn * (1 + o[2] * vergence) + slope[:, None] * do[2] * vergence)


def _medians(each: Floats) -> Floats:
    """Median of each row without its NaN; NaN where nothing else is there."""
    return np.array([np.median(kept) if (kept := row[np.isfinite(row)]).size else math.nan for row in each])
