"""Random numbers of every kind (any bits, NaN, infinities, denormals, rays just outside the domain) through a model.

A ray outside the domain never passes; one that passes is finite, and its direction is of unit length. Exit code 1 where
that is broken.
"""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Callable
from dataclasses import dataclass, field
from enum import Enum
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from experiments import lab
from neurolens.base import status as st
from neurolens.cameras.onnxlens import OnnxLens, load_model
from neurolens.surrogates.card import DOMAIN_SLACK
from neurolens.surrogates.model import ANY_WAVELENGTH_NM

_BATCH = 1 << 12  # of one film plane and stop
# Bounds are tested in float32, a few roundings of which may fall either side.
_ROUNDING = 2e-6
PASSES_OUTSIDE = "outside the domain, but of another status"
NOT_FINITE = "passed, but not finite"
NOT_UNIT = "passed, but its direction is not of unit length"
REFUSED_FINE = "well inside the domain, but outside by its status"
_SPECIAL = np.array(
    [np.nan, np.inf, -np.inf, 0.0, -0.0, 1e-45, -1e-45, 1.1754942e-38, 3.4028235e38, -3.4028235e38, 1e20, -1e20, 1e-20],
    np.float32,
)

Floats = NDArray[np.float32]


@dataclass
class Outcome:
    """Rays sent, those inside the domain, those that passed, and how many broke each promise."""

    rays: int = 0
    inside: int = 0
    passed: int = 0
    broken: dict[str, int] = field(
        default_factory=lambda: dict.fromkeys((PASSES_OUTSIDE, NOT_FINITE, NOT_UNIT, REFUSED_FINE), 0)
    )


def send(model: OnnxLens, count: int, seed: int = 1, report: Callable[[float], None] | None = None) -> Outcome:
    """Send `count` random rays of every kind, batch by batch, film plane and stop random too."""
    rng, found = np.random.default_rng(seed), Outcome()
    while found.rays < count:
        n = min(_BATCH, count - found.rays)
        _one_batch(model, rng, n, found)
        if report:
            report(found.rays / count)
    return found


def _one_batch(model: OnnxLens, rng: np.random.Generator, n: int, found: Outcome) -> None:
    state, place = _state(model, rng)
    d = (model.at(*state) if place is _Place.INSIDE else model).card["domain"]
    rays, film_z, stop = _rays(rng, n, d), _film_z(rng, d), _stop(rng, d)
    with np.errstate(all="ignore"):
        out = model.rays(rays[:2], rays[2:4], rays[4], float(film_z), float(stop), state or None)
        surely_out, surely_in = _sides(d, rays.astype(np.float64), float(film_z), float(stop), _wavelengths(model))
        if place is not _Place.INSIDE:
            surely_out, surely_in = np.full(n, place is _Place.OUTSIDE), np.zeros(n, bool)
        passed = out.status == st.PASSED
        finite = np.isfinite(out.scene_ray).all(0) & np.isfinite(out.transmittance) & np.isfinite(out.stop_xy_mm).all(0)
        length = np.sqrt((out.scene_ray[3:].astype(np.float64) ** 2).sum(0))
    found.rays += n
    found.inside += int(surely_in.sum())
    found.passed += int(passed.sum())
    for promise, bad in (
        (PASSES_OUTSIDE, surely_out & (out.status != st.OUTSIDE_DOMAIN)),
        (NOT_FINITE, passed & ~finite),
        (NOT_UNIT, passed & ~(np.abs(length - 1) < 1e-5)),
        (REFUSED_FINE, surely_in & (out.status == st.OUTSIDE_DOMAIN)),
    ):
        found.broken[promise] += int(bad.sum())


def _wavelengths(model: OnnxLens) -> tuple[float, float]:
    """Shortest and longest that the model takes: any where no glass disperses, though its domain then holds one."""
    low, high = model.card["domain"]["wavelength_nm"] if model.card["lens"]["dispersive"] else ANY_WAVELENGTH_NM
    return float(low), float(high)


class _Place(Enum):
    """Where a state lies: among the model's, beyond them, or so close to their ends that rounding decides."""

    INSIDE, OUTSIDE, BETWEEN = range(3)


def _state(model: OnnxLens, rng: np.random.Generator) -> tuple[tuple[float, ...], _Place]:
    """A state, six times in seven one of the model's, else any number; none for a model of one state."""
    values, places = [], []
    for low, high in (axis.limits for axis in model.axes):
        v = low + (high - low) * rng.uniform()
        if rng.uniform() < 1 / 7:
            v = float(rng.choice(np.array([0.9 * low - 1e-3, 1.1 * high, *_SPECIAL], np.float32)))
        give = 1e-3 * (high - low)
        beyond = not low - give <= v <= high + give  # NaN too
        values.append(v)
        places.append(_Place.OUTSIDE if beyond else _Place.INSIDE if low <= v <= high else _Place.BETWEEN)
    place = next((p for p in (_Place.OUTSIDE, _Place.BETWEEN) if p in places), _Place.INSIDE)
    return tuple(values), place


def _rays(rng: np.random.Generator, n: int, d: dict[str, Any]) -> Floats:
    """[5, n]: a third of any bits, a third near the domain's bounds, a third inside; special numbers among them."""
    bits = rng.integers(0, 2**32, (5, n), dtype=np.uint32).view(np.float32)
    low, high = d["wavelength_nm"]

    def disc(radius: float, reach: NDArray[np.float64]) -> NDArray[np.float64]:
        phi = rng.uniform(0, 2 * math.pi, n)
        return np.stack([np.cos(phi), np.sin(phi)]) * radius * reach

    def ray(film: NDArray[np.float64], pupil: NDArray[np.float64], colour: NDArray[np.float64]) -> Floats:
        points = np.concatenate([disc(d["film_radius_mm"], film), disc(d["pupil_radius_mm"], pupil)])
        return np.concatenate([points, (low + (high - low) * colour)[None]]).astype(np.float32)

    steps = [0.3, 0.999, 1.0, 1.0001, 1.001, 1.1, 3.0, 1e4]
    colours = [-2.0, -0.001, 0.0, 0.5, 1.0, 1.001, 30.0]
    close = ray(rng.choice(steps, n), rng.choice(steps, n), rng.choice(colours, n))
    inside = ray(np.sqrt(rng.uniform(0, 1, n)), np.sqrt(rng.uniform(0, 1, n)), rng.uniform(0, 1, n))
    which = rng.integers(0, 3, n)
    rays = np.where(which == 0, bits, np.where(which == 1, close, inside))
    spoilt = rng.uniform(size=rays.shape) < 0.01
    return np.asarray(np.where(spoilt, rng.choice(_SPECIAL, rays.shape), rays), np.float32)


def _film_z(rng: np.random.Generator, d: dict[str, Any]) -> np.float32:
    near, far = d["film_z_mm"]
    if rng.uniform() < 0.7:
        return np.float32(near + (far - near) * rng.uniform())
    other = [near * 0.99, far * 1.01, -far, d["pupil_z_mm"], *_SPECIAL]
    return np.float32(rng.choice(np.array(other, np.float32)))


def _stop(rng: np.random.Generator, d: dict[str, Any]) -> np.float32:
    radius = d["stop_radius_mm"]
    if rng.uniform() < 0.7:
        return np.float32(radius * rng.choice([0.1, 0.5, 1.0]))
    return np.float32(rng.choice(np.array([-radius, 1.01 * radius, *_SPECIAL], np.float32)))


def _sides(
    d: dict[str, Any], rays: NDArray[np.float64], film_z: float, stop: float, wavelengths_nm: tuple[float, float]
) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Rays surely outside the domain, and surely inside: between lie those that rounding decides."""
    near, far = d["film_z_mm"]
    low, high = wavelengths_nm
    sides = []
    for slack in (DOMAIN_SLACK * (1 + _ROUNDING), 1.0 - _ROUNDING):
        # abs: a bound of a negative z moves outwards too; compared so that NaN fails.
        ok = np.hypot(*rays[:2]) <= d["film_radius_mm"] * slack
        ok &= np.hypot(*rays[2:4]) <= d["pupil_radius_mm"] * slack
        give = abs(slack - 1) + _ROUNDING
        ok &= (near - give * abs(near) <= film_z) & (film_z <= far + give * abs(far))
        ok &= (stop >= 0) & (stop <= d["stop_radius_mm"] * slack)
        ok &= (rays[4] >= low / (1 + give)) & (rays[4] <= high * (1 + give))  # one wavelength is a range, too
        sides.append(ok)
    # An opening whose square leaves float32 stops every ray but that through its middle, by one status or another.
    return ~sides[0], sides[1] & (stop >= 1e-6 * d["stop_radius_mm"])


OPTIONS = (
    lab.option("models", metavar="MODEL", type=Path, nargs="+", help="exported models (.onnx)"),
    lab.count("rays", 10_000_000, "a model (default 10000000)", 1000),
    lab.count("seed", 1, "of the numbers (default 1)", 0),
    lab.QUIET,
)


def run(args: argparse.Namespace) -> int:
    """Send random numbers; 1 where a promise is broken."""
    broken = 0
    for path, report in lab.stages(args.models, lambda p: p.stem, args.quiet):
        found = send(load_model(path), args.rays, args.seed, report)
        print(f"{path}: {found.rays} rays, {found.inside} of them inside the domain, {found.passed} passed")
        for promise, count in found.broken.items():
            if count:
                broken += count
                print(f"experiments: {path}: {count} rays: {promise}", file=sys.stderr)
    return 1 if broken else 0
