"""Rays that no fit has seen, traced once through the exact lens, and every model's errors on them, zone by zone.

Zones are thirds of the film radius (`vignetting.ZONES`), at full aperture and stopped down. A smaller stop changes no
ray, only which of them pass: the crossing with the stop, kept from the one exact trace, tells.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from neurolens import status as st
from neurolens.evaluate.rays import EachRay, each_ray, ray_figures
from neurolens.evaluate.vignetting import NEAR_RIM, ZONES, deciding_rim_ratio, false_shares
from neurolens.optics.prescription import Lens
from neurolens.surrogates.domain import Domain, FilmRays, sample_domain
from neurolens.surrogates.pairs import PairSet, trace_pairs

# Whole stops closed, by the name of the state.
STOPS = {"full": 0, "2_stops": 2, "4_stops": 4}
# States whose zones a card tells.
ZONED = ("full", "2_stops")
# Fewer rays than this say nothing of a zone.
LEAST_RAYS = 100
_BATCH = 65536

Predict = Callable[..., Any]
"""FilmRays and a stop radius in mm (None: the domain's) to what `LensModel.predict` gives."""


@dataclass(frozen=True)
class FreshRays:
    """What models of one lens and domain are measured on.

    Attributes:
        lens, domain: the exact lens at its widest stop, and the domain of the models.
        held_out: rays that the lens passes.
        drawn: [N] rays uniform over the film and pupil discs, blocked ones included.
        passes: [N] bool, at full aperture.
        stop_square: [N] squared distance from the axis (mm^2) at the stop.
        near: [N] bool, full aperture: within 2% of the radius of the rim that decides.
    """

    lens: Lens
    domain: Domain
    held_out: PairSet
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
        square = exact.cross_x[lens.stop_index] ** 2 + exact.cross_y[lens.stop_index] ** 2
        near = (deciding_rim_ratio(lens, exact) - 1).abs() <= NEAR_RIM
        drawn.append(rays.columns())
        kept.append((exact.status == st.PASSED, square, near))
    columns = FilmRays(*(torch.cat(c) for c in zip(*drawn, strict=True)))
    return FreshRays(lens, domain, held_out, columns, *(torch.cat(c) for c in zip(*kept, strict=True)))


@dataclass(frozen=True)
class Findings:
    """Errors of one model on `FreshRays`.

    Attributes:
        figures: those of `rays.ray_errors`, false_pass, false_block and both near rims at full aperture.
        stopped_down: false_pass and false_block of the states of `STOPS` but the first.
        zones: by state of `ZONED` and zone: rms_um, direction_rms_deg of `rays` rays, and false_pass, false_block of
            `passing` rays that the exact lens passes. None where fewer than `LEAST_RAYS` tell.
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


def zone_of(fresh: FreshRays, each: EachRay, state: str, zone: str) -> EachRay:
    """Errors of the rays of one zone that pass in one state."""
    inputs, stop = fresh.held_out.inputs, fresh.lens.stop_index
    square = fresh.held_out.cross_x[stop] ** 2 + fresh.held_out.cross_y[stop] ** 2
    return each.select(_within(fresh.domain, inputs, zone) & (square <= fresh.stop_radius_mm(state) ** 2))


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
    """Four digits are more than so many rays can know."""
    if len(values) < LEAST_RAYS:
        return None
    return _finite(float(f"{float(torch.sqrt((values * values).mean())):.4g}"))


def _finite(value: float | None) -> float | None:
    return None if value is None or not math.isfinite(value) else value
