"""Measures models by zone, on rays that no fit has used, traced once through the exact lens; fits models, too.

A smaller stop changes no ray. It changes only which rays pass, and their crossings with the stop decide that.
"""

import math
import time
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from neurolens import __version__
from neurolens.base import status as st
from neurolens.base.files import atomic_path, fingerprint_of, read_kept, sha256_of, write_kept
from neurolens.base.progress import Report
from neurolens.cameras.model import OnnxLens, load_model
from neurolens.models.export import export_onnx
from neurolens.models.fit import NETWORKS, ModelSettings, Prepared, fit_model
from neurolens.models.fitted import Domain, FilmRays
from neurolens.models.model import Prediction
from neurolens.models.pairs import PairSet, join_pairs, passing_rays, sample_domain, trace_pairs
from neurolens.models.phase import path_errors
from neurolens.optics.lens.prescription import Lens
from neurolens.optics.trace.surfaces import Rays
from neurolens.studies.rays import (
    PIXELS_ACROSS,
    ZONES,
    EachRay,
    Predict,
    RayErrors,
    each_ray,
    false_shares,
)

# How many stops are closed, by the name of the state.
STOPS = {"full": 0, "2_stops": 2, "4_stops": 4}
# States whose zones a card contains.
ZONED = ("full", "2_stops")
# The fewest rays from which a zone has a figure.
LEAST_RAYS = 100
# An RMS that a few bad rays dominate, so that its relative standard deviation is above KNOWN, is measured on MORE times
# as many rays.
MORE, MOST, KNOWN = 8, 1_000_000, 0.08
_BATCH = 65536


@dataclass(frozen=True)
class FreshRays:
    """Test rays of the models of one lens and domain.

    Attributes:
        lens, domain: the exact lens at its widest stop, and the domain of the models.
        held_out: [M] rays that the lens passes.
        held_square: [M] their squared distance from the axis (mm^2) at the stop.
        drawn: [N] rays uniform over the film and pupil discs, blocked ones included.
        passes: [N] bool, at full aperture.
        stop_square: [N] squared distance from the axis (mm^2) at the stop.
    """

    lens: Lens
    domain: Domain
    held_out: PairSet
    held_square: Tensor
    drawn: FilmRays
    passes: Tensor
    stop_square: Tensor

    def stop_radius_mm(self, state: str) -> float:
        """Return the radius in mm of one of `STOPS`."""
        return self.domain.stop_radius_mm / math.sqrt(2) ** STOPS[state]


def fresh_rays(lens: Lens, domain: Domain, held_out: PairSet, *, count: int, seed: int) -> FreshRays:
    """Draw and trace `count` rays for the vignetting; `seed` must not be that of a fit's pairs."""
    parts = []
    for start in range(0, count, _BATCH):
        rays = sample_domain(domain, min(_BATCH, count - start), seed, start)
        exact = trace_pairs(lens, rays, domain.pupil_z_mm, power=False)
        parts.append((*rays.columns(), exact.status == st.PASSED, _stop_square(lens, exact)))
    *drawn, passes, square = (torch.cat(c) for c in zip(*parts, strict=True))
    return FreshRays(lens, domain, held_out, _stop_square(lens, held_out), FilmRays(*drawn), passes, square)


def with_more(fresh: FreshRays, seed: int) -> FreshRays:
    """Add passing rays until there are `MORE` times as many as before; at most `MOST` are added."""

    def without_crossings(pairs: PairSet) -> PairSet:
        """Return the rays without their data by surface, which take most of the memory."""
        by_surface = ("cross_x", "cross_y", "meets", "refracts")
        return replace(pairs, **{name: getattr(pairs, name)[:0].clone() for name in by_surface})

    lens, count = fresh.lens, len(fresh.held_out)
    sets, squares, wanted = [without_crossings(fresh.held_out)], [fresh.held_square], min((MORE - 1) * count, MOST)
    while wanted > 0:
        pairs = passing_rays(lens, fresh.domain, min(max(count, _BATCH), wanted), seed + len(sets))
        sets.append(without_crossings(pairs))
        squares.append(_stop_square(lens, pairs))
        wanted -= len(pairs)
    return replace(fresh, held_out=join_pairs(sets), held_square=torch.cat(squares))


def _stop_square(lens: Lens, pairs: PairSet) -> Tensor:
    return pairs.cross_x[lens.stop_index] ** 2 + pairs.cross_y[lens.stop_index] ** 2


@dataclass(frozen=True)
class Findings:
    """Errors of one model on `FreshRays`.

    Attributes:
        figures: those of `rays.RayErrors`, and false_pass and false_block at full aperture.
        stopped_down: false_pass and false_block of the states of `STOPS`, except the first.
        zones: by state of `ZONED` and zone: rms_um and direction_rms_deg of `rays` rays, false_pass and false_block of
            `passing` rays that the exact lens passes. None with fewer than `LEAST_RAYS`, or where an RMS is not known
            to `KNOWN`.
        each: errors ray by ray, for the rays of `held_out`.
    """

    figures: dict[str, float | None]
    stopped_down: dict[str, dict[str, float | None]]
    zones: dict[str, dict[str, dict[str, Any]]]
    each: EachRay

    def errors(self, keys: tuple[str, ...]) -> dict[str, Any]:
        """Return data for card and record: figures of `keys`, None if not finite, then `zones`."""
        plain = {key: finite(self.figures[key]) for key in keys}
        return {**plain, "stopped_down": self.stopped_down, "zones": self.zones}


def measure(fresh: FreshRays, predict: Predict) -> Findings:
    """Measure the errors of one model; `predict` is such as `onnx_predictor` gives."""
    each = each_ray(fresh.lens, fresh.domain, fresh.held_out, predict)
    model = {s: predict(fresh.drawn, fresh.stop_radius_mm(s)).status == st.PASSED for s in STOPS}
    exact = {s: fresh.passes & (fresh.stop_square <= fresh.stop_radius_mm(s) ** 2) for s in STOPS}
    shares = {s: false_shares(exact[s], model[s]) for s in STOPS}
    full = shares.pop("full")
    zones = {s: {z: _zone(fresh, each, s, z, exact[s], model[s]) for z in ZONES} for s in ZONED}
    return Findings({**asdict(RayErrors.over(fresh.lens, fresh.domain, each)), **full}, shares, zones, each)


def well_known(fresh: FreshRays, each: EachRay) -> bool:
    """Return whether the rays determine the errors over the film, and those of its zones, to `KNOWN`."""
    whole = (each.focus_um, each.infinity_um, each.direction_deg, each.position_um, each.transmittance)
    parts = [zone_of(fresh, each, s, z) for s in ZONED for z in ZONES]
    zones = [v for part in parts for v in (part.focus_um, part.direction_deg) if len(v) >= LEAST_RAYS]
    return all(rms_deviation(v) <= KNOWN for v in (*whole, *zones))


def rms_deviation(values: Tensor) -> float:
    """Return the relative standard deviation of the root mean square of values."""
    square = values * values
    mean = float(square.mean()) if len(values) > 1 else 0.0
    return float(square.std()) / (2 * mean * math.sqrt(len(values))) if mean > 0 else 0.0


def zone_of(fresh: FreshRays, each: EachRay, state: str, zone: str) -> EachRay:
    """Return the errors of the rays of one zone that pass in one state."""
    open_ = fresh.held_square <= fresh.stop_radius_mm(state) ** 2
    return each.select(_within(fresh.domain, fresh.held_out.inputs, zone) & open_)


def _within(domain: Domain, rays: FilmRays, zone: str) -> Tensor:
    low, high = ZONES[zone]
    place = torch.hypot(rays.film_x, rays.film_y) / domain.film_radius_mm
    return (place >= low) & ((place < high) | (high == 1.0))


def _zone(fresh: FreshRays, each: EachRay, state: str, zone: str, exact: Tensor, model: Tensor) -> dict[str, Any]:
    part = zone_of(fresh, each, state, zone)
    within = _within(fresh.domain, fresh.drawn, zone)
    passing, shares = int(exact[within].sum()), false_shares(exact[within], model[within])
    return {
        "rms_um": _rms(part.focus_um),
        "direction_rms_deg": _rms(part.direction_deg),
        "rays": len(part.inside),
        **(shares if passing >= LEAST_RAYS else dict.fromkeys(shares)),
        "passing": passing,
    }


def _rms(values: Tensor) -> float | None:
    """Return the RMS with four digits; None for too few rays, or if a few of them dominate."""
    if len(values) < LEAST_RAYS or rms_deviation(values) > KNOWN:
        return None
    return finite(float(f"{float(torch.sqrt((values * values).mean())):.4g}"))


def finite(value: float | None) -> float | None:
    """Return the value, or None where it is not finite."""
    return None if value is None or not math.isfinite(value) else value


# Keys of the ray and vignetting errors that a card promises and a record shows.
CARD_KEYS = tuple(
    "rms_um p99_um max_um rms_infinity_um rms_px direction_rms_deg position_rms_um transmittance_rms transmittance_max "
    "false_pass false_block".split()
)
# These are reported as poor: shares of false passes or blocks beyond this, an RMS error beyond so many pixels of 4000
# across.
POOR_SHARE, POOR_PX = 0.01, 1.0
# Added to the seed of the fit's rays, since the same seed would give the rays to which the rims were fitted.
FRESH = 104729


@dataclass(frozen=True)
class Measured:
    """One model: its settings, its exported file, its record for `results.json`."""

    settings: ModelSettings
    file: Path
    record: dict[str, Any]

    @property
    def error(self) -> float:
        """Return the film-equivalent RMS, or that of the angle where no ray is within 60 degrees."""
        found = self.record.get("rms_um")
        return float(found if found is not None else self.record.get("direction_rms_deg") or 1e9)


def onnx_predictor(model: OnnxLens) -> Predict:
    """Return an exported model as the function that `rays` and `vignetting` call."""

    def predict(rays: FilmRays, stop_radius_mm: float | None = None) -> Prediction:
        x, y, z, u, v, nm = (np.ascontiguousarray(c.numpy(), dtype=np.float32) for c in rays.columns())
        out = model.rays(np.stack([x, y]), np.stack([u, v]), nm, z, stop_radius_mm)
        scene, power, stop, status = (
            torch.from_numpy(a) for a in (out.scene_ray, out.transmittance, out.stop_xy_mm, out.status)
        )
        return Prediction(Rays(*scene), power, stop[0], stop[1], status)

    return predict


def shared_rays(prepared: Prepared, vignetting_rays: int) -> FreshRays:
    """Draw the test rays of all models of a lens and domain; many, since one bad ray in 10,000 may dominate."""
    pairs = prepared.pairs
    seed = pairs.settings.seed + FRESH
    return with_more(fresh_rays(pairs.lens, pairs.domain, pairs.held_out, count=vignetting_rays, seed=seed), seed)


def measure_on(rays: FreshRays, model: OnnxLens) -> dict[str, Any]:
    """Measure the errors of an exported model for its card; keys have units, and a value is None if not finite."""
    errors = measure(rays, onnx_predictor(model)).errors(CARD_KEYS)
    return {**errors, "poor": what_is_poor(errors), "rays": len(rays.held_out), "passing": int(rays.passes.sum())}


def what_is_poor(errors: Mapping[str, Any]) -> list[str]:
    """Return the errors of a model that are visible in a picture, as sentences for its card."""
    shares = {key: errors.get(key) or 0.0 for key in ("false_pass", "false_block")}
    poor = [f"{key.replace('_', ' ')} {100 * share:.2g}%" for key, share in shares.items() if share > POOR_SHARE]
    pixels = errors.get("rms_px") or 0.0
    return [*poor, f"RMS error {pixels:.2g} pixels of a picture {PIXELS_ACROSS} wide"] if pixels > POOR_PX else poor


def fit_and_measure(
    prepared: Prepared, settings: ModelSettings, folder: Path, vignetting_rays: int, report: Report,
    rays: Callable[[], FreshRays] | None = None,
) -> Measured:  # fmt: skip
    """Fit, export and measure one model, or take one of the same settings and version from the folder.

    Errors are of the exported float32 graph in onnxruntime. `rays`: `shared_rays`, where several models share them.
    """
    file, pairs = folder / f"{settings.label}.onnx", prepared.pairs
    made_of = (pairs.domain.to_dict(), asdict(pairs.settings), asdict(settings), vignetting_rays)
    fingerprint = fingerprint_of([__version__, pairs.lens.sha256, *made_of])
    if (record := known_record(file, fingerprint)) is not None:
        return Measured(settings, file, record)
    training = folder / f"{settings.label}.training.npz"  # left by a killed run
    model = fit_model(prepared, settings, report, checkpoint=training)
    on = rays() if rays else shared_rays(prepared, vignetting_rays)
    facts = {
        "name": settings.label, "family": settings.family, "variables": model.core.basis, "file": f"models/{file.name}",
        "coefficients_per_vector": None if settings.method in NETWORKS else model.core.coefficients_per_vector,
        "parameters": model.core.coefficients, "fit_s": model.fit_s,
    }  # fmt: skip
    record = export_measured(
        file,
        fingerprint,
        facts,
        lambda path, errors: export_onnx(model, path, errors),
        lambda m: measure_on(on, m) | path_errors(m.fitted, pairs.held_out.inputs),
    )
    training.unlink(missing_ok=True)
    return Measured(settings, file, record)


def export_measured(
    file: Path, fingerprint: str, facts: dict[str, Any], export: Callable[[Path, dict[str, Any]], object],
    errors_of: Callable[[OnnxLens], dict[str, Any]],
) -> dict[str, Any]:  # fmt: skip
    """Export a model, measure the exported file, and export it again with its errors; its record is kept beside it.

    Args:
        fingerprint: by which `known_record` recognises the record.
        facts: entries of the record besides the errors and what the file tells.
        export: writes the model with errors to a path.
    """
    with atomic_path(file) as unmeasured:  # a file without its errors never has the final name
        export(unmeasured, {})
        errors = errors_of(load_model(unmeasured))
        export(unmeasured, errors)
    record = {**facts, **errors, "bytes": file.stat().st_size, "load_s": seconds_to_load(file)}
    write_kept(file.with_suffix(".json"), {"fingerprint": fingerprint, "sha256": sha256_of(file), "record": record})
    return record


def seconds_to_load(file: Path) -> float:
    """Return the seconds that it takes to load a model."""
    start = time.perf_counter()
    load_model(file)
    return time.perf_counter() - start


def known_record(file: Path, fingerprint: str) -> dict[str, Any] | None:
    """Return the record of an earlier finished fit with the same settings, if its model file is unchanged."""
    data = read_kept(file.with_suffix(".json")) or {}
    if data.get("fingerprint") != fingerprint or not file.is_file() or data["sha256"] != sha256_of(file):
        return None
    return data["record"]
