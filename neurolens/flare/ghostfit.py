"""The fit of ghosts: rays of all directions and wavelengths, followed exactly, and polynomials to them."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from neurolens.base import status as st
from neurolens.base.errors import InputError
from neurolens.flare.ghostmodel import GhostModel, GhostPolynomial
from neurolens.flare.ghosts import GhostTracer, Pair, ghost_pairs
from neurolens.lens.glass import inverse_square_um
from neurolens.lens.prescription import Lens
from neurolens.surrogates.lightfield import LightField
from neurolens.surrogates.terms import (
    invariant_exponents,
    monomials,
    pinned_threads,
    raw_exponents,
    raw_variables,
    solve,
    vector_columns,
)
from neurolens.trace.rays import Rays
from neurolens.trace.sequence import follow, ghost

Array = NDArray[np.float64]
DEGREES = (3, 4, 5, 6, 7, 9)  # in the invariants; the first that is good enough
_MIRROR_DEGREES = (5, 7, 9, 11)  # in p and u, of lenses with cylinders
_SEARCH = 1 << 16  # rays that look for the light of each ghost
_DRAWS = 4  # samples at most, where few rays are useful
_MARGIN = 1.12  # factor of the disc in which the search finds the light
_FAR = 2.0  # film radii beyond which light counts little
_OPEN = 50.0  # factor of all diameters, with which rims stop nothing
_REACH = 1.25  # r / R up to which rays beyond rims are fitted
_BEYOND = 0.3  # weight of these
_RIMS, _UNEXPLAINED = 5, 1e-3  # rims besides the stop's; share of blocked rays that may remain without a rim
_LOST = 1e6  # coordinates of a ray that misses a surface


@dataclass(frozen=True)
class GhostSettings:
    """The light that ghosts are fitted for, and how finely.

    Attributes:
        angle_deg: largest angle between light and axis. wavelength_nm: range.
        film_radius_mm: light that falls beyond it does not count.
        keep: share of all ghosts' light that the kept ghosts carry. target_um: RMS error of each ghost on the film.
        rays: for the fit of a ghost; about half as many test it. seed: of the random numbers.
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
        """The sine of the largest angle."""
        return math.sin(math.radians(self.angle_deg))


@dataclass(frozen=True)
class Sample:
    """Rays of one ghost; numpy [.., N] float64.

    Attributes:
        p, u, w: variables of the polynomials. film: [2, N] mm. crossings: [S, 2, N] in units of each step's rim.
        whole: whether the ray meets all surfaces. power: [N], as if no rim stopped the ray.
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
        """The squared lengths [S, N] of the crossings."""
        return np.asarray((self.crossings**2).sum(1))


def fit_ghosts(lens: Lens, settings: GhostSettings, done: Callable[[float], None] = lambda share: None) -> GhostModel:
    """Fit the ghosts of a set lens.

    Args:
        done: is called with the share of the work that is done.

    Raises:
        InputError: the lens has a mask in its stop or no film, settings are out of range, or no ghost reaches the film.
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
    pairs, fits, rows = list[Pair](), list[GhostPolynomial](), list[dict[str, Any]]()
    with pinned_threads():
        for number, k in enumerate(kept):
            if (fitted := _fit(plain, every[k], *found[every[k]][1:], settings, rng)) is not None:
                pairs.append(every[k])
                fits.append(fitted[0])
                rows.append({"ghost": every[k].name, "energy": float(energy[k] / total), **fitted[1]})
            done((number + 1) / len(kept))
    if not fits:
        raise InputError("ghost fit", "rays", settings.rays, "more: of no ghost there are enough that serve")
    share = np.array([row["energy"] for row in rows])
    um = np.array([row["film_rms_um"] for row in rows])
    report = {
        "pairs": len(every),
        "film_radius_mm": settings.film_radius_mm,
        "kept": len(pairs),
        "kept_energy": float(share.sum()),
        "film_rms_um": float(np.sqrt((share * um**2).sum() / share.sum())),
        "energy_error": float(sum(r["energy"] * r["energy_error"] for r in rows) / share.sum()),
        "seconds": time.perf_counter() - began,
        "ghosts": rows,
    }
    radius = float(lens.stop_radius_mm)
    return GhostModel(lens, tuple(pairs), tuple(fits), settings.sine, settings.wavelength_nm, radius, report)


def _check(lens: Lens, settings: GhostSettings) -> None:
    if lens.aperture is not None and lens.aperture.mask is not None:
        raise InputError(lens.path, "aperture", "(a mask)", "a round stop or blades: fitted ghosts take no mask")
    bounds = {"angle_deg": (0.1, 89.0), "keep": (0.0, 1.0), "target_um": (1e-3, 1e6), "rays": (1000, 1e9)}
    for name, (least, most) in bounds.items():
        if not least <= getattr(settings, name) <= most:
            raise InputError("ghost fit", name, getattr(settings, name), f"from {least:g} to {most:g}")


def _rays(direction: Array, place: Array) -> Array:
    """Rays [6, N] from well before the front, with directions' x and y [2, N], to points [2, N] of the plane z = 0."""
    d = np.concatenate([direction, np.sqrt(1 - (direction**2).sum(0, keepdims=True))])
    return np.concatenate([np.concatenate([place, np.zeros((1, place.shape[1]))]) - 1000.0 * d, d])


def _drawn(lens: Lens, count: int, rng: np.random.Generator) -> tuple[Array, Array]:
    """Random p and u [2, N], each in the unit disc; with an axis of symmetry p lies along x, which stands for all."""
    r, turn = np.sqrt(rng.random(count)), 2 * np.pi * rng.random(count)
    length = np.sqrt(rng.random(count))
    about = 2 * np.pi * rng.random(count) if lens.anamorphic else np.zeros(count)
    return r * np.stack([np.cos(about), np.sin(about)]), length * np.stack([np.cos(turn), np.sin(turn)])


def _search(
    tracer: GhostTracer, every: Sequence[Pair], settings: GhostSettings, rng: np.random.Generator
) -> dict[Pair, tuple[float, Array, Array]]:
    """The light of every ghost on the film over all directions, and where it enters: chief and scale of u (mm)."""
    sine, front = settings.sine, tracer.lens.surfaces[0].semi_diameter_mm
    p, u = _drawn(tracer.lens, _SEARCH, rng)
    place = 1.3 * front * u
    cos = np.sqrt(1 - sine**2 * (p**2).sum(0))
    found = tracer.trace(_rays(sine * p, place).astype(np.float64), 0.5 * sum(settings.wavelength_nm))
    on_film = np.hypot(*np.moveaxis(found.film_xy_mm, 1, 0)) < settings.film_radius_mm
    known = {}
    for pair, power, here in zip(every, found.power, on_film, strict=True):
        lit = here & (power > 0)
        light = float((np.where(lit, power, 0) * cos).mean(dtype=np.float64))
        chief, scale = np.zeros(2), np.full(2, 1.3 * front)
        if lit.sum() >= 8:
            along, off = p[:, lit], place[:, lit]
            chief[:] = (off * along).sum(1) / np.maximum((along**2).sum(1), 1e-300)
            chief[1] = chief[1] if tracer.lens.anamorphic else chief[0]
            off = off - chief[:, None] * along
            wide = np.abs(off).max(1) if tracer.lens.anamorphic else np.ones(2)
            scale = (1 + 2 / math.sqrt(float(lit.sum()))) * float(np.hypot(*(off / wide[:, None])).max()) * wide
        known[pair] = light, chief, _MARGIN * scale
    return known


def sample(
    lens: Lens, pair: Pair, chief: Array, scale: Array, settings: GhostSettings, count: int, rng: np.random.Generator
) -> Sample:
    """Random rays of a ghost, by the scales of `GhostPolynomial`; no rim stops them."""
    p, u = _drawn(lens, count, rng)
    short, long = (float(inverse_square_um(v)) for v in settings.wavelength_nm)
    w = 2 * rng.random(count) - 1
    nm = 1000 / np.sqrt(0.5 * (short + long) + 0.5 * (short - long) * w)
    rays = Rays(*torch.from_numpy(_rays(settings.sine * p, chief[:, None] * p + scale[:, None] * u)))
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
    lens: Lens, pair: Pair, chief: Array, scale: Array, settings: GhostSettings, rng: np.random.Generator
) -> tuple[GhostPolynomial, dict[str, Any]] | None:
    """Fit a ghost with the lowest degree that is good enough; returns it and its errors on other rays, or None if too
    few rays are useful."""
    steps = [k for k, _ in ghost(len(lens.surfaces), *pair)]
    drawn, near, rims = list[Sample](), list[NDArray[np.int_]](), list[int]()
    while len(drawn) < _DRAWS and sum(map(len, near)) < settings.rays:
        more = sample(lens, pair, chief, scale, settings, 4 * settings.rays, rng)
        met = more.whole & (more.ratio.max(0) < _REACH**2)
        near.append(np.flatnonzero(met & (np.hypot(*more.film) < _FAR * settings.film_radius_mm)))
        rims = rims or _rims(more, steps, lens.stop_index)
        drawn.append(more)
    data = Sample(*(
        np.concatenate([getattr(some, f.name)[..., k] for some, k in zip(drawn, near, strict=True)], -1)
        for f in fields(Sample)
    ))  # fmt: skip
    use = np.arange(min(settings.rays, len(data.w)))
    weight = np.where(data.ratio[:, use].max(0) <= 1, 1.0, _BEYOND)
    weight /= 1 + (np.hypot(*data.film[:, use]) / settings.film_radius_mm) ** 4
    test = sample(lens, pair, chief, scale, settings, 2 * settings.rays, rng)
    fit, row = None, {}
    for degree in _MIRROR_DEGREES if lens.anamorphic else DEGREES:
        exponents = mirror_exponents(degree) if lens.anamorphic else invariant_exponents(degree)
        if 4 * len(exponents) > len(use) * (2 if lens.anamorphic else 1):
            break
        fit = solved(exponents, data, use, weight, rims, steps, chief, scale)
        row = _measured(fit, test, settings.film_radius_mm) | {"degree": degree, "rims": len(rims)}
        if row["film_rms_um"] <= settings.target_um:
            break
    return None if fit is None else (fit, row)


def _rims(data: Sample, steps: list[int], stop: int) -> list[int]:
    """The steps whose rims are tested: the stop's, and up to `_RIMS` others that block most of the rays."""
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
    chief: Array,
    scale: Array,
) -> GhostPolynomial:
    """Fit a ghost by least squares to rays number `use` with weights; `rims`: which of the `steps` have crossings."""
    field = LightField(*(torch.from_numpy(v[..., use]) for v in (data.p, data.u, data.w)))
    vectors = torch.from_numpy(np.concatenate([data.film[None], data.crossings[rims]])[..., use])
    given, weights = torch.from_numpy(data.power[None, use]), torch.from_numpy(weight)
    surfaces, count = tuple(steps[n] for n in rims), len(exponents)
    if exponents.shape[1] == 4:
        features = monomials(field.invariants(), exponents)
        ab = solve(vector_columns(features, field), vectors.flatten(1), weights.repeat(2)).numpy()
        power = solve(features, given, weights).numpy()[0]
        return GhostPolynomial(chief, scale, surfaces, exponents, ab.reshape(len(ab), 2, count), power)
    ab, power = np.zeros((len(vectors), 2, count)), np.zeros(count)
    features = monomials(raw_variables(field), exponents)
    odd = exponents[:, :2] + exponents[:, 2:4] & 1
    for axis in (0, 1):
        own = np.flatnonzero((odd == np.eye(2)[axis]).all(1))
        ab[:, axis, own] = solve(features[own], vectors[:, axis], weights).numpy()
    even = np.flatnonzero(~odd.any(1))
    power[even] = solve(features[even], given, weights).numpy()[0]
    return GhostPolynomial(chief, scale, surfaces, exponents, ab, power)


def mirror_exponents(degree: int) -> Any:
    """Exponents [M, 5] of p_x, p_y, u_x, u_y, w up to a total `degree` in the first four, and to lower degrees with w.

    They are not odd in both x and y, so that vectors and scalars allow a mirrored x and a mirrored y."""
    rows = raw_exponents(degree)
    reach = np.array([degree, degree - 4, degree - 8, degree - 10])
    low = rows[(rows[:, 4] < 4) & (rows[:, :4].sum(1) <= reach[rows[:, 4].clip(max=3)])]
    return low[((low[:, :2] + low[:, 2:4]) % 2).sum(1) < 2]


def _measured(fit: GhostPolynomial, test: Sample, film_radius: float) -> dict[str, float]:
    """Errors of the light on the film: RMS distance in um, shares that are wrong or missing, and that of the sum."""
    field = LightField(*(torch.from_numpy(v) for v in (test.p, test.u, test.w)))
    if fit.exponents.shape[1] == 4:
        features = monomials(field.invariants(), fit.exponents).numpy()
        vectors = np.einsum("vam,mn,acn->vcn", fit.ab, features, np.stack([test.p, test.u]), optimize=True)
    else:
        features = monomials(raw_variables(field), fit.exponents).numpy()
        vectors = np.einsum("vcm,mn->vcn", fit.ab, features, optimize=True)
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
