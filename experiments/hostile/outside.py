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
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from experiments import lab
from neurolens.base import status as st
from neurolens.base.status import DOMAIN_SLACK
from neurolens.cameras.onnxlens import OnnxLens, load_model
from neurolens.optics.lens.glass import ANY_WAVELENGTH_NM

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
        _one_batch(model, rng, min(_BATCH, count - found.rays), found)
        if report:
            report(found.rays / count)
    return found


def _one_batch(model: OnnxLens, rng: np.random.Generator, n: int, found: Outcome) -> None:
    state, within = _state(model, rng)
    d = (model.at(*state) if within else model).card["domain"]
    radius, (near, far) = d["stop_radius_mm"], d["film_z_mm"]
    rays = _rays(rng, n, d)
    film_z = _number(rng, near + (far - near) * rng.uniform(), (near * 0.99, far * 1.01, -far, d["pupil_z_mm"]))
    stop = _number(rng, radius * rng.choice([0.1, 0.5, 1.0]), (-radius, 1.01 * radius))
    with np.errstate(all="ignore"):
        out = model.rays(rays[:2], rays[2:4], rays[4], film_z, stop, state or None)
        # One wavelength is a range, too: any where no glass disperses, though the domain then holds one.
        wavelengths = d["wavelength_nm"] if model.card["lens"]["dispersive"] else ANY_WAVELENGTH_NM
        surely_out, surely_in = _sides(d, rays.astype(np.float64), film_z, stop, *wavelengths)
        if not within:
            surely_out, surely_in = np.full(n, within is False), np.zeros(n, bool)
        passed = out.status == st.PASSED
        finite = np.isfinite(out.scene_ray).all(0) & np.isfinite(out.transmittance) & np.isfinite(out.stop_xy_mm).all(0)
        length = np.sqrt((out.scene_ray[3:].astype(np.float64) ** 2).sum(0))
    found.rays, found.inside, found.passed = found.rays + n, found.inside + surely_in.sum(), found.passed + passed.sum()
    for promise, bad in (
        (PASSES_OUTSIDE, surely_out & (out.status != st.OUTSIDE_DOMAIN)),
        (NOT_FINITE, passed & ~finite),
        (NOT_UNIT, passed & ~(np.abs(length - 1) < 1e-5)),
        (REFUSED_FINE, surely_in & (out.status == st.OUTSIDE_DOMAIN)),
    ):
        found.broken[promise] += int(bad.sum())


def _state(model: OnnxLens, rng: np.random.Generator) -> tuple[tuple[float, ...], bool | None]:
    """A state, six times in seven one of the model's, else any number; none for a model of one state.

    Returns also whether the state is one of the model's; None so close to the ends that rounding decides.
    """
    values, within = [], list[bool | None]([True])
    for low, high in (axis.limits for axis in model.axes):
        v = low + (high - low) * rng.uniform()
        if rng.uniform() < 1 / 7:
            v = float(rng.choice(np.array([0.9 * low - 1e-3, 1.1 * high, *_SPECIAL], np.float32)))
        give = 1e-3 * (high - low)
        values.append(v)
        within.append(True if low <= v <= high else None if low - give <= v <= high + give else False)  # NaN: False
    return tuple(values), False if False in within else None if None in within else True


def _number(rng: np.random.Generator, usual: float, others: tuple[float, ...]) -> float:
    """A number of a call: seven times in ten the usual one, else another or a special one, as float32."""
    strange = rng.choice(np.array([*others, *_SPECIAL], np.float32))
    return float(np.float32(usual if rng.uniform() < 0.7 else strange))


def _rays(rng: np.random.Generator, n: int, d: dict[str, Any]) -> Floats:
    """[5, n]: a third of any bits, a third near the domain's bounds, a third inside; special numbers among them."""
    bits = rng.integers(0, 2**32, (5, n), dtype=np.uint32).view(np.float32)
    low, high = d["wavelength_nm"]

    def ray(film: NDArray[np.float64], pupil: NDArray[np.float64], colour: NDArray[np.float64]) -> Floats:
        phi = rng.uniform(0, 2 * math.pi, (2, n))
        reach = np.stack([d["film_radius_mm"] * film, d["pupil_radius_mm"] * pupil])
        points = np.stack([reach * np.cos(phi), reach * np.sin(phi)], axis=1).reshape(4, n)
        return np.concatenate([points, (low + (high - low) * colour)[None]]).astype(np.float32)

    steps = [0.3, 0.999, 1.0, 1.0001, 1.001, 1.1, 3.0, 1e4]
    colours = [-2.0, -0.001, 0.0, 0.5, 1.0, 1.001, 30.0]
    close = ray(rng.choice(steps, n), rng.choice(steps, n), rng.choice(colours, n))
    inside = ray(np.sqrt(rng.uniform(0, 1, n)), np.sqrt(rng.uniform(0, 1, n)), rng.uniform(0, 1, n))
    rays = np.choose(rng.integers(0, 3, n), [bits, close, inside])
    return np.where(rng.uniform(size=rays.shape) < 0.01, rng.choice(_SPECIAL, rays.shape), rays).astype(np.float32)


def _sides(
    d: dict[str, Any], rays: NDArray[np.float64], film_z: float, stop: float, low: float, high: float
) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Rays surely outside the domain, and surely inside: between lie those that rounding decides."""
    near, far = d["film_z_mm"]
    sides = []
    for slack in (DOMAIN_SLACK * (1 + _ROUNDING), 1.0 - _ROUNDING):
        # abs: a bound of a negative z moves outwards too; compared so that NaN fails.
        ok = np.hypot(*rays[:2]) <= d["film_radius_mm"] * slack
        ok &= np.hypot(*rays[2:4]) <= d["pupil_radius_mm"] * slack
        give = abs(slack - 1) + _ROUNDING
        ok &= (near - give * abs(near) <= film_z) & (film_z <= far + give * abs(far))
        ok &= (stop >= 0) & (stop <= d["stop_radius_mm"] * slack)
        ok &= (rays[4] >= low / (1 + give)) & (rays[4] <= high * (1 + give))
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
