"""Bias and variance of a Monte Carlo render, told apart, and what follows for the time that an error takes.

A progressive render adds passes of n samples, each with a seed of its own. Its squared error against the truth, mean
over the pixels, is then exactly bias^2 + V / K after K passes, with V the variance of one pass (within a pass, the
low-discrepancy samples do better than 1/N; passes are independent). With pictures I_i of the passes and two independent
halves R_1, R_2 of a reference, the products <I_i - R_1, I_j - R_2> have the mean bias^2 for i != j, and bias^2 + V for
i = j: the law taken to K = infinity, free of the reference's own noise. With a second camera's passes J_i that share
all random numbers, <I_i - J_i, I_j - J_j> for i != j has the mean bias^2 between the two, and most noise cancels first.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from neurolens.base.errors import InputError

FloatArray = NDArray[np.float64]


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


def weights(reference: ArrayLike, eps: float | None) -> FloatArray:
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
    """bias^2, and the variance of one pass, of passes [K, ...] with seeds of their own; see the module.

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


def _rows(passes: ArrayLike) -> FloatArray:
    values = np.asarray(passes, np.float64)
    if values.ndim < 2 or len(values) < 3:
        raise InputError("bias and variance", "passes", f"({len(np.atleast_1d(values))})", "at least three pictures")
    return values.reshape(len(values), -1)


def _apart(gram: FloatArray) -> float:
    """Mean of the products of different passes."""
    count = len(gram)
    return float(gram.sum() - np.trace(gram)) / (count * (count - 1))


def _jackknife(gram: FloatArray, statistic: Callable[[FloatArray], float]) -> Estimate:
    """A statistic of the products of passes, and its deviation from leaving out one pass after the other (Tukey)."""
    count = len(gram)
    without = np.array([statistic(np.delete(np.delete(gram, k, 0), k, 1)) for k in range(count)])
    return Estimate(statistic(gram), float(np.sqrt((count - 1) * np.mean((without - without.mean()) ** 2))))
