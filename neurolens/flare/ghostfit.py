"""Fitting ghosts: rays of all directions and wavelengths, followed exactly, and polynomials to them."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from neurolens.base import status as st
from neurolens.base.errors import InputError
from neurolens.flare.ghostmodel import GhostModel, GhostPolynomial
from neurolens.flare.ghosts import GhostTracer, Pair, ghost_pairs
from neurolens.optics.glass import inverse_square_um
from neurolens.optics.prescription import Lens
from neurolens.optics.sequence import follow, ghost
from neurolens.optics.trace import Rays
from neurolens.surrogates.bases import invariant_exponents, monomials, pinned_threads, solve, vector_columns
from neurolens.surrogates.lightfield import LightField

Array = NDArray[np.float64]
DEGREES = (3, 4, 5, 6, 7, 9)  # in the invariants; the first that is good enough
_SEARCH = 1 << 16  # rays that look for the light of each ghost
_MARGIN = 1.12  # of the disc in which they find it
_FAR = 2.0  # film radii: light beyond counts little
_OPEN = 50.0  # times the diameters of a lens whose rims stop nothing
_REACH = 1.25  # r / R to which rays beyond rims are fitted
_BEYOND = 0.3  # what they count
_RIMS, _UNEXPLAINED = 5, 1e-3
_LOST = 1e6  # where a ray that misses a surface would be


@dataclass(frozen=True)
class GhostSettings:
    """What is fitted, and how finely.

    Attributes:
        angle_deg: largest angle between light and axis. wavelength_nm: range.
        film_radius_mm: light that falls beyond does not count.
        keep: share of the ghosts' light that the kept ones carry. target_um: RMS on the film, of each ghost.
        rays: of a ghost, for its fit; half as many judge it. seed: of theirs.
    """

    angle_deg: float = 35.0
    wavelength_nm: tuple[float, float] = (400.0, 700.0)
    film_radius_mm: float = 21.64
    keep: float = 0.999
    target_um: float = 10.0
    rays: int = 8000
    seed: int = 0

    @property
    def sine(self) -> float:
        """Of the largest angle."""
        return math.sin(math.radians(self.angle_deg))


@dataclass(frozen=True)
class Sample:
    """Rays of one ghost; numpy [.., N] float64.

    Attributes:
        p, u, w: as the polynomials take them. film: [2, N] mm. crossings: [S, 2, N] in units of each step's rim.
        ratio: [S, N] their squared lengths; whole: whether the ray meets all surfaces. power: [N] whatever rims do.
    """

    p: Array
    u: Array
    w: Array
    film: Array
    crossings: Array
    whole: NDArray[np.bool_]
    power: Array

    @property
    def ratio(self) -> Array:
        return np.asarray((self.crossings**2).sum(1))


def fit_ghosts(lens: Lens, settings: GhostSettings, done: Callable[[float], None] = lambda share: None) -> GhostModel:
    """Fit the ghosts of a lens in its state.

    Args:
        done: told the share of the work that is done.

    Raises:
        InputError: a lens with cylinders, with a mask in its stop or without film; settings out of range; no ghost that
            reaches the film.
    """
    _check(lens, settings)
    began, plain, rng = time.perf_counter(), replace(lens, aperture=None), np.random.default_rng(settings.seed)
    every = ghost_pairs(plain)
    found = _search(GhostTracer(plain, every), every, settings, rng)
    energy = np.array([light for light, *_ in found.values()])
    total, order = float(energy.sum()), np.argsort(-energy, kind="stable")
    if not total > 0:
        raise InputError(lens.path, "ghosts", f"({len(found)} pairs)", "one whose light reaches the film")
    kept = order[: int(np.searchsorted(np.cumsum(energy[order]) / total, settings.keep)) + 1]
    pairs, fits, rows = tuple(every[k] for k in kept), [], []
    with pinned_threads():
        for number, (pair, k) in enumerate(zip(pairs, kept, strict=True)):
            fit, row = _fit(plain, pair, *found[pair][1:], settings, rng)
            fits.append(fit)
            rows.append({"ghost": pair.name, "energy": float(energy[k] / total), **row})
            done((number + 1) / len(pairs))
    share = np.array([row["energy"] for row in rows])
    um = np.array([row["film_rms_um"] for row in rows])
    report = {
        "pairs": len(every),
        "kept": len(pairs),
        "kept_energy": float(share.sum()),
        "film_rms_um": float(np.sqrt((share * um**2).sum() / share.sum())),
        "energy_error": float(sum(r["energy"] * r["energy_error"] for r in rows) / share.sum()),
        "seconds": time.perf_counter() - began,
        "ghosts": rows,
    }
    radius = float(lens.stop_radius_mm)
    return GhostModel(lens, pairs, tuple(fits), settings.sine, settings.wavelength_nm, radius, report)


def _check(lens: Lens, settings: GhostSettings) -> None:
    if any(s.cylinder for s in lens.surfaces):
        expected = "a lens with an axis of symmetry: of others ghosts are traced"
        raise InputError(lens.path, "cylinder", "(some)", expected)
    if lens.aperture is not None and lens.aperture.mask is not None:
        raise InputError(lens.path, "aperture", "(a mask)", "a round stop or blades: fitted ghosts take no mask")
    bounds = {"angle_deg": (0.1, 89.0), "keep": (0.0, 1.0), "target_um": (1e-3, 1e6), "rays": (1000, 1e9)}
    for name, (least, most) in bounds.items():
        if not least <= getattr(settings, name) <= most:
            raise InputError("ghost fit", name, getattr(settings, name), f"from {least:g} to {most:g}")


def _rays(direction: Array, place: Array) -> Array:
    """[6, N] through places [2, N] of the plane z = 0, from well before the front, of directions' x and y [2, N]."""
    d = np.concatenate([direction, np.sqrt(1 - (direction**2).sum(0, keepdims=True))])
    return np.concatenate([np.concatenate([place, np.zeros((1, place.shape[1]))]) - 1000.0 * d, d])


def _drawn(count: int, rng: np.random.Generator) -> tuple[Array, Array]:
    """p [2, N], of all lengths as the disc has them, along x, which by symmetry stands for all; u [2, N] of a disc."""
    r, turn = np.sqrt(rng.random(count)), 2 * np.pi * rng.random(count)
    length = np.sqrt(rng.random(count))
    return np.stack([r, np.zeros(count)]), length * np.stack([np.cos(turn), np.sin(turn)])


def _search(
    tracer: GhostTracer, every: Sequence[Pair], settings: GhostSettings, rng: np.random.Generator
) -> dict[Pair, tuple[float, float, float]]:
    """Of every ghost its light on the film, all directions alike, and chief and scale of u where it enters (mm)."""
    sine, front = settings.sine, tracer.lens.surfaces[0].semi_diameter_mm
    p, u = _drawn(_SEARCH, rng)
    place = 1.3 * front * u
    cos = np.sqrt(1 - (sine * p[0]) ** 2)
    found = tracer.trace(_rays(sine * p, place).astype(np.float64), 0.5 * sum(settings.wavelength_nm))
    on_film = np.hypot(*np.moveaxis(found.film_xy_mm, 1, 0)) < settings.film_radius_mm
    known = {}
    for pair, power, here in zip(every, found.power, on_film, strict=True):
        lit = here & (power > 0)
        light = float((np.where(lit, power, 0) * cos).mean(dtype=np.float64))
        chief, scale = 0.0, 1.3 * front
        if lit.sum() >= 8:
            chief = float((place[0, lit] * p[0, lit]).sum() / (p[0, lit] ** 2).sum())
            few = 1 + 2 / math.sqrt(float(lit.sum()))
            scale = few * float(np.hypot(place[0, lit] - chief * p[0, lit], place[1, lit]).max())
        known[pair] = light, chief, _MARGIN * scale
    return known


def sample(
    lens: Lens, pair: Pair, chief: float, scale: float, settings: GhostSettings, count: int, rng: np.random.Generator
) -> Sample:
    """Random rays of a ghost, by the scales of `GhostPolynomial`; rims stop none."""
    p, u = _drawn(count, rng)
    short, long = (float(inverse_square_um(v)) for v in settings.wavelength_nm)
    w = 2 * rng.random(count) - 1
    nm = 1000 / np.sqrt(0.5 * (short + long) + 0.5 * (short - long) * w)
    rays = Rays(*torch.from_numpy(_rays(settings.sine * p, chief * p + scale * u)))
    open_lens = replace(
        lens, surfaces=tuple(replace(s, diameter_mm=_OPEN * s.diameter_mm) for s in lens.surfaces), aperture=None
    )
    steps = ghost(len(lens.surfaces), *pair)
    out = follow(open_lens, rays, steps, torch.from_numpy(nm))
    assert lens.film_z_mm is not None
    way = (lens.film_z_mm - out.rays.z) / out.rays.dz
    film = torch.stack([out.rays.x + way * out.rays.dx, out.rays.y + way * out.rays.dy]).numpy()
    met = np.stack([torch.stack(point[:2]).numpy() for point in out.points])
    crossings = met / np.array([lens.surfaces[k].semi_diameter_mm for k, _ in steps])[:, None, None]
    whole = (out.status == st.PASSED).numpy() & np.isfinite(film).all(0)
    return Sample(p, u, w, np.where(whole, film, _LOST), np.where(whole, crossings, _LOST), whole, out.power.numpy())


def _fit(
    lens: Lens, pair: Pair, chief: float, scale: float, settings: GhostSettings, rng: np.random.Generator
) -> tuple[GhostPolynomial, dict[str, Any]]:
    """A ghost of the lowest degree that is good enough, and what was measured on rays held out."""
    steps = [k for k, _ in ghost(len(lens.surfaces), *pair)]
    data = sample(lens, pair, chief, scale, settings, 4 * settings.rays, rng)
    ratio = np.sqrt(data.ratio)
    near = data.whole & (ratio.max(0) < _REACH) & (np.hypot(*data.film) < _FAR * settings.film_radius_mm)
    rims = _rims(data, steps, lens.stop_index)
    use = np.flatnonzero(near)[: settings.rays]
    weight = np.where(ratio[:, use].max(0) <= 1, 1.0, _BEYOND)
    weight /= 1 + (np.hypot(*data.film[:, use]) / settings.film_radius_mm) ** 4
    test = sample(lens, pair, chief, scale, settings, 2 * settings.rays, rng)
    fit, row = None, {}
    for degree in DEGREES:
        exponents = invariant_exponents(degree)
        if 4 * len(exponents) > len(use):
            break
        fit = solved(exponents, data, use, weight, rims, steps, chief, scale)
        row = _measured(fit, test, settings.film_radius_mm) | {"degree": degree, "rims": len(rims)}
        if row["film_rms_um"] <= settings.target_um:
            break
    if fit is None:
        raise InputError("ghost fit", "rays", settings.rays, f"more: {pair.name} has only {len(use)} that serve")
    return fit, row


def _rims(data: Sample, steps: list[int], stop: int) -> list[int]:
    """Steps whose rims are tested: the stop's, and up to `_RIMS` that explain most of what is blocked, as far as it
    counts."""
    blocked = data.ratio[:, data.whole] > 1
    chosen = [n for n, k in enumerate(steps) if k == stop]
    left = blocked.any(0) & ~blocked[chosen].any(0)
    most = len(chosen) + _RIMS
    while left.sum() > _UNEXPLAINED * max(int((~blocked.any(0)).sum()), 1) and len(chosen) < most:
        best = int(blocked[:, left].sum(1).argmax())
        chosen.append(best)
        left &= ~blocked[best]
    return chosen


def solved(
    exponents: Any,
    data: Sample,
    use: Any,
    weight: Array,
    rims: list[int],
    steps: list[int],
    chief: float,
    scale: float,
) -> GhostPolynomial:
    """The ghost by least squares from rays number `use` with weights; `rims`: which of the `steps` have crossings."""
    field = LightField(*(torch.from_numpy(v[..., use]) for v in (data.p, data.u, data.w)))
    features, count = monomials(field.invariants(), exponents), len(exponents)
    vectors = torch.from_numpy(np.concatenate([data.film[None], data.crossings[rims]])[..., use])
    found = solve(vector_columns(features, field), vectors.flatten(1), torch.from_numpy(np.tile(weight, 2))).numpy()
    power = solve(features, torch.from_numpy(data.power[None, use]), torch.from_numpy(weight)).numpy()
    surfaces = tuple(steps[n] for n in rims)
    return GhostPolynomial(chief, scale, surfaces, exponents, found.reshape(len(found), 2, count), power[0])


def _measured(fit: GhostPolynomial, test: Sample, film_radius: float) -> dict[str, float]:
    """Of light on the film: RMS distance in um, shares that are wrongly there or missing, and the error of all."""
    field = LightField(*(torch.from_numpy(v) for v in (test.p, test.u, test.w)))
    features = monomials(field.invariants(), fit.exponents).numpy()
    vectors = np.einsum("vam,mn,acn->vcn", fit.ab, features, np.stack([test.p, test.u]), optimize=True)
    power, inside = np.maximum(fit.power @ features, 0), (test.u**2).sum(0) <= 1
    passes = inside & ((vectors[1:] ** 2).sum(1) <= 1).all(0) & (np.hypot(*vectors[0]) < film_radius)
    lit = test.whole & (test.ratio <= 1).all(0) & (np.hypot(*test.film) < film_radius)
    true, mine = np.where(lit, test.power, 0), np.where(passes, power, 0)
    both = np.where(lit, true, 0)
    off = ((vectors[0] - test.film) ** 2).sum(0)
    total = max(float(true.sum()), 1e-300)
    return {
        "film_rms_um": 1e3 * math.sqrt(float((off * both)[lit].sum()) / total),
        "false_light": float(mine[~lit].sum() / total),
        "lost_light": float(true[~passes].sum() / total),
        "energy_error": float(mine.sum() / total - 1),
    }
