"""Rays that no fit has seen, traced once through the exact lens, and every model's errors on them, zone by zone.

Zones are thirds of the film radius (`vignetting.ZONES`), at full aperture and stopped down. A smaller stop changes no
ray, only which of them pass: the crossing with the stop, kept from the one exact trace, tells.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from neurolens.base import status as st
from neurolens.evaluate.rays import EachRay, each_ray, ray_figures
from neurolens.evaluate.vignetting import NEAR_RIM, ZONES, deciding_rim_ratio, false_shares
from neurolens.optics.prescription import Lens
from neurolens.surrogates.domain import Domain, FilmRays, sample_domain
from neurolens.surrogates.pairs import PairSet, PairSettings, join_pairs, make_pairs, trace_pairs

# Whole stops closed, by the name of the state.
STOPS = {"full": 0, "2_stops": 2, "4_stops": 4}
# States whose zones a card tells.
ZONED = ("full", "2_stops")
# Fewer rays than this say nothing of a zone.
LEAST_RAYS = 100
# A root mean square that a few bad rays decide is measured on more rays: so many times as many as asked for, where its
# relative standard deviation is above this.
MORE, MOST, KNOWN = 8, 1_000_000, 0.08
_BATCH = 65536

Predict = Callable[..., Any]
"""FilmRays and a stop radius in mm (None: the domain's) to what `LensModel.predict` gives."""


@dataclass(frozen=True)
class FreshRays:
    """What models of one lens and domain are measured on.

    Attributes:
        lens, domain: the exact lens at its widest stop, and the domain of the models.
        held_out: [M] rays that the lens passes.
        held_square: [M] their squared distance from the axis (mm^2) at the stop.
        drawn: [N] rays uniform over the film and pupil discs, blocked ones included.
        passes: [N] bool, at full aperture.
        stop_square: [N] squared distance from the axis (mm^2) at the stop.
        near: [N] bool, full aperture: within 2% of the radius of the rim that decides.
    """

    lens: Lens
    domain: Domain
    held_out: PairSet
    held_square: Tensor
    drawn: FilmRays
    passes: Tensor
    stop_square: Tensor
    near: Tensor

    def stop_radius_mm(self, state: str) -> float:
        """Of one of `STOPS`."""
        return self.domain.stop_radius_mm / math.sqrt(2) ** STOPS[state]


def fresh_rays(lens: Lens, domain: Domain, held_out: PairSet, *, count: int, seed: int) -> FreshRays:
    """Draw and trace `count` rays for the vignetting; `seed` must not be that of a fit's pairs."""
    drawn, kept = [], []
    for start in range(0, count, _BATCH):
        rays = sample_domain(domain, min(_BATCH, count - start), seed, start)
        exact = trace_pairs(lens, rays, domain.pupil_z_mm)
        near = (deciding_rim_ratio(lens, exact) - 1).abs() <= NEAR_RIM
        drawn.append(rays.columns())
        kept.append((exact.status == st.PASSED, _stop_square(lens, exact), near))
    columns = FilmRays(*(torch.cat(c) for c in zip(*drawn, strict=True)))
    return FreshRays(
        lens, domain, held_out, _stop_square(lens, held_out), columns, *(torch.cat(c) for c in zip(*kept, strict=True))
    )


def with_more(fresh: FreshRays, seed: int) -> FreshRays:
    """`MORE` times as many passing rays, those there among them; at most `MOST` are added."""
    lens, domain, count = fresh.lens, fresh.domain, len(fresh.held_out)
    sets, squares, wanted = [_without_crossings(fresh.held_out)], [fresh.held_square], min((MORE - 1) * count, MOST)
    while wanted > 0:
        part = PairSettings(train=1, held_out=min(count, wanted), rim=1, seed=seed + len(sets))
        pairs = make_pairs(lens, domain, part).held_out
        sets.append(_without_crossings(pairs))
        squares.append(_stop_square(lens, pairs))
        wanted -= len(pairs)
    return replace(fresh, held_out=join_pairs(sets), held_square=torch.cat(squares))


def _stop_square(lens: Lens, pairs: PairSet) -> Tensor:
    return pairs.cross_x[lens.stop_index] ** 2 + pairs.cross_y[lens.stop_index] ** 2


def _without_crossings(pairs: PairSet) -> PairSet:
    """The same rays without what is known of each surface, which is most of what they take."""
    names = ("cross_x", "cross_y", "meets", "refracts")
    return replace(pairs, **{name: getattr(pairs, name)[:0] for name in names})


@dataclass(frozen=True)
class Findings:
    """Errors of one model on `FreshRays`.

    Attributes:
        figures: those of `rays.ray_errors`, false_pass, false_block and both near rims at full aperture.
        stopped_down: false_pass and false_block of the states of `STOPS` but the first.
        zones: by state of `ZONED` and zone: rms_um, direction_rms_deg of `rays` rays, and false_pass, false_block of
            `passing` rays that the exact lens passes. None where fewer than `LEAST_RAYS` tell, or where an RMS is not
            known to `KNOWN`.
        each: errors ray by ray, of the rays of `held_out`.
    """

    figures: dict[str, float | None]
    stopped_down: dict[str, dict[str, float | None]]
    zones: dict[str, dict[str, dict[str, Any]]]
    each: EachRay

    def errors(self, keys: tuple[str, ...]) -> dict[str, Any]:
        """What a card and a record hold: figures of `keys`, what is not finite as None, then `zones`."""
        plain = {key: _finite(self.figures[key]) for key in keys}
        return {**plain, "stopped_down": self.stopped_down, "zones": self.zones}


def measure(fresh: FreshRays, predict: Predict) -> Findings:
    """Errors of one model; `predict` as `measure.onnx_predictor` gives it."""
    each = each_ray(fresh.lens, fresh.domain, fresh.held_out, predict)
    said = {s: predict(fresh.drawn, fresh.stop_radius_mm(s)).status == st.PASSED for s in STOPS}
    exact = {s: fresh.passes & (fresh.stop_square <= fresh.stop_radius_mm(s) ** 2) for s in STOPS}
    shares = {s: false_shares(exact[s], said[s]) for s in STOPS}
    near = false_shares(exact["full"][fresh.near], said["full"][fresh.near])
    full = {**shares.pop("full"), **{f"{key}_near_rim": value for key, value in near.items()}}
    zones = {s: {z: _zone(fresh, each, s, z, exact[s], said[s]) for z in ZONES} for s in ZONED}
    return Findings({**ray_figures(fresh.lens, fresh.domain, each), **full}, shares, zones, each)


def well_known(fresh: FreshRays, each: EachRay) -> bool:
    """Whether so many rays know the errors over the film and of its zones to `KNOWN`."""
    whole = (each.focus_um, each.infinity_um, each.direction_deg, each.position_um, each.transmittance)
    parts = [zone_of(fresh, each, s, z) for s in ZONED for z in ZONES]
    zones = [v for part in parts for v in (part.focus_um, part.direction_deg) if len(v) >= LEAST_RAYS]
    return all(rms_deviation(v) <= KNOWN for v in (*whole, *zones))


def rms_deviation(values: Tensor) -> float:
    """Relative standard deviation of a root mean square of so many values."""
    square = values * values
    mean = float(square.mean()) if len(values) > 1 else 0.0
    return float(square.std()) / (2 * mean * math.sqrt(len(values))) if mean > 0 else 0.0


def zone_of(fresh: FreshRays, each: EachRay, state: str, zone: str) -> EachRay:
    """Errors of the rays of one zone that pass in one state."""
    open_ = fresh.held_square <= fresh.stop_radius_mm(state) ** 2
    return each.select(_within(fresh.domain, fresh.held_out.inputs, zone) & open_)


def _within(domain: Domain, rays: FilmRays, zone: str) -> Tensor:
    low, high = ZONES[zone]
    place = torch.hypot(rays.film_x, rays.film_y) / domain.film_radius_mm
    return (place >= low) & ((place < high) | (high == 1.0))


def _zone(fresh: FreshRays, each: EachRay, state: str, zone: str, exact: Tensor, said: Tensor) -> dict[str, Any]:
    part = zone_of(fresh, each, state, zone)
    within = _within(fresh.domain, fresh.drawn, zone)
    found: dict[str, Any] = {
        "rms_um": _rms(part.focus_um),
        "direction_rms_deg": _rms(part.direction_deg),
        "rays": len(part.inside),
        **false_shares(exact[within], said[within]),
        "passing": int(exact[within].sum()),
    }
    if found["passing"] < LEAST_RAYS:
        found |= {"false_pass": None, "false_block": None}
    return found


def _rms(values: Tensor) -> float | None:
    """Four digits are more than so many rays can know; None where too few tell, or a few of them decide."""
    if len(values) < LEAST_RAYS or rms_deviation(values) > KNOWN:
        return None
    return _finite(float(f"{float(torch.sqrt((values * values).mean())):.4g}"))


def _finite(value: float | None) -> float | None:
    return None if value is None or not math.isfinite(value) else value
