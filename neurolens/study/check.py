"""Check of a model against the promises of its card, on fresh rays through the exact lens and the ONNX model."""

from __future__ import annotations

import math
import warnings
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from neurolens.base import status as st
from neurolens.base.errors import InputError, NeurolensWarning
from neurolens.base.files import library
from neurolens.cameras.model import OnnxLens
from neurolens.lens.paraxial import first_order
from neurolens.lens.prescription import Lens
from neurolens.readers.any_format import read_any
from neurolens.setting.states import set_lens
from neurolens.study.measure import (
    STOPS,
    ZONED,
    Findings,
    FreshRays,
    fresh_rays,
    measure,
    onnx_predictor,
    rms_deviation,
    well_known,
    with_more,
    zone_of,
)
from neurolens.study.rays import EachRay, ray_errors
from neurolens.study.vignetting import ZONES, false_shares
from neurolens.surrogates.axes import Axis
from neurolens.surrogates.model import Domain
from neurolens.surrogates.pairs import PairSettings, make_pairs
from neurolens.surrogates.states import State, StateSpace

# How much worse than promised a figure may be on other rays: standard deviations of the estimate from a sample of this
# size, at least a tenth, at most a half. A largest error has no such bound: more rays find larger ones.
SIGMAS, LEAST, MOST = 4.0, 0.10, 0.50
# The errors per ray from which a figure is computed.
_RMS = {
    "rms_um": "focus_um",
    "rms_infinity_um": "infinity_um",
    "rms_px": "focus_um",
    "direction_rms_deg": "direction_deg",
    "position_rms_um": "position_um",
    "transmittance_rms": "transmittance",
}
_P99 = {"p99_um": "focus_um"}
SHARES = ("false_pass", "false_block")
# Below this, float32 rounding dominates: half a nanometre, a microdegree.
_FLOOR = 5e-7
_FRESH = 7919  # added to the seed of the fit


@dataclass(frozen=True)
class Promise:
    """One figure of a card against fresh rays; `allowed` is the promise with its tolerance, None where it has none."""

    key: str
    promised: float
    measured: float | None
    allowed: float | None

    @property
    def holds(self) -> bool:
        if self.allowed is None:
            return True
        return self.measured is not None and self.measured <= self.allowed  # False for NaN


def check_model(
    model: OnnxLens, lens: Lens, *, rays: int = 30_000, seed: int | None = None
) -> tuple[dict[str, Any], list[Promise]]:
    """Measure a model on rays that it has not seen.

    Args:
        lens: the exact lens, as `lens_of_card` gives it.
        rays: rays that the lens passes, eight times as many where a few bad ones decide an error; four times as many
            test what passes and what is blocked.
        seed: None takes one that differs from the fit's.

    Returns the figures (those of `measure.Findings`, flat, with stopped_down, zones, rays and seed) and the promises of
        the card: over the whole film, stopped down ("2_stops.false_pass") and of zones ("full.edge.rms_um").

    Warns:
        NeurolensWarning: a seed that is the fit's own.
    """
    card, domain = model.card, Domain.from_dict(model.card["domain"])
    fitted = int(card["fit"]["settings"].get("rays_seed") or 0)
    seed = fitted + _FRESH if seed is None else seed
    if seed == fitted:
        warnings.warn(f"seed {seed} is that of the fit: these rays are not fresh", NeurolensWarning, stacklevel=2)
    pairs = make_pairs(lens, domain, PairSettings(train=1, held_out=rays, rim=1, seed=seed))
    fresh = fresh_rays(lens, domain, pairs.held_out, count=4 * rays, seed=seed)
    found = measure(fresh, onnx_predictor(model))
    if not well_known(fresh, found.each):
        fresh = with_more(fresh, seed + _FRESH)
        found = measure(fresh, onnx_predictor(model))
    figures = {**found.figures, "stopped_down": found.stopped_down, "zones": found.zones, "seed": seed}
    figures["rays"] = len(fresh.held_out)
    return figures, promises_of(card["errors"], fresh, found)


def promises_of(errors: Mapping[str, Any], fresh: FreshRays, found: Findings) -> list[Promise]:
    """The promises of a card's `errors` against what a model's `measure` found on fresh rays."""
    return [*_promises(errors, fresh, found), *_zone_promises(errors, fresh, found)]


def _promises(errors: Mapping[str, Any], fresh: FreshRays, found: Findings) -> Iterator[Promise]:
    """Promises over the whole film, full aperture and stopped down."""
    passing, promised_of = int(fresh.passes.sum()), _count(errors, "passing")
    for key, promised in _numbers(errors):
        measured = found.figures.get(key)
        if key in SHARES:
            yield share_promise(key, promised, measured, passing, promised_of)
        elif key in found.figures and key != "rays":
            yield _error(key, promised, measured, found.each, _count(errors, "rays"))
    for state, shares in _tables(errors.get("stopped_down")):
        for key, promised in _numbers(shares) if state in found.stopped_down else ():
            closed = 2 ** STOPS[state]  # factor by which fewer rays pass
            said = found.stopped_down[state].get(key)
            yield share_promise(f"{state}.{key}", promised, said, passing / closed, (promised_of or passing) / closed)


def _zone_promises(errors: Mapping[str, Any], fresh: FreshRays, found: Findings) -> Iterator[Promise]:
    """Promises of thirds of the film."""
    for state, zones in _tables(errors.get("zones")):
        for zone, promises in _tables(zones):
            if state not in ZONED or zone not in ZONES:
                continue
            measured, each = found.zones[state][zone], zone_of(fresh, found.each, state, zone)
            for key, promised in _numbers(promises):
                place, said = f"{state}.{zone}.{key}", measured.get(key)
                if said is None:
                    continue  # too few rays
                if key in SHARES:
                    yield share_promise(place, promised, said, measured["passing"], _count(promises, "passing"))
                elif key in _RMS:
                    yield _error(place, promised, said, each, _count(promises, "rays"))


def _tables(value: Any) -> Iterator[tuple[str, Mapping[str, Any]]]:
    for name, inner in value.items() if isinstance(value, Mapping) else ():
        if isinstance(inner, Mapping):
            yield name, inner


def _numbers(table: Mapping[str, Any]) -> Iterator[tuple[str, float]]:
    """The finite numbers of a table."""
    for key, value in table.items():
        if isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value):
            yield key, float(value)


def _count(table: Mapping[str, Any], key: str) -> float | None:
    return dict(_numbers(table)).get(key)


def _error(place: str, promised: float, measured: float | None, each: EachRay, promised_of: float | None) -> Promise:
    """A promised error against fresh rays, with a tolerance from their spread."""
    key = place.rpartition(".")[2]
    value = math.nan if measured is None else float(measured)
    if key not in _RMS and key not in _P99:
        return Promise(place, promised, value, None)
    values = getattr(each, (_RMS | _P99)[key])
    two = math.sqrt(1 + len(values) / (promised_of or len(values)))  # both figures are samples
    known = rms_deviation(values) if key in _RMS else _p99_deviation(values)
    tolerance = min(max(SIGMAS * two * known, LEAST), MOST)
    return Promise(place, promised, value, promised * (1 + tolerance) + _FLOOR)


def _p99_deviation(values: Tensor) -> float:
    """Relative standard deviation of the 99th percentile, from the quantile one deviation of its rank higher."""
    above = torch.quantile(values, min(1.0, 0.99 + math.sqrt(0.99 * 0.01 / len(values)))) if len(values) else None
    at = float(torch.quantile(values, 0.99)) if len(values) else 0.0
    return (float(above) - at) / at if above is not None and at > 0 else 0.0


def share_promise(
    place: str, promised: float, measured: float | None, rays: float, promised_of: float | None
) -> Promise:
    """A promised share of `promised_of` rays against one of `rays`.

    Both are counts of rare events, whose tails are longer than a normal law's: their square roots, which vary by half
    a count whatever the count is, are compared (Huffman 1984, Applied Statistics 33, 224). Where many were counted,
    this is `SIGMAS` standard deviations of the difference.
    """
    rays, other = max(rays, 1.0), max(promised_of or rays, 1.0)
    ratio = rays / other
    root = math.sqrt(ratio * (promised * other + 3 / 8)) + SIGMAS / 2 * math.sqrt(1 + ratio)
    allowed = min((root * root - 3 / 8) / rays, 1.0)
    return Promise(place, promised, None if measured is None else float(measured), allowed)


def lens_of_card(
    card: Mapping[str, Any], lens_file: str | Path | None = None, model_file: str | Path = "model"
) -> Lens:
    """The exact lens of a model, in the model's zoom state, size and stop.

    Args:
        lens_file: None looks for the card's lens id in lenses/: beside the model, beside its folder (a run keeps its
            lens there), of the working folder and of this project.

    Raises:
        InputError: no such file, or one whose prescription is not the card's in any zoom state.
    """
    wanted = card["lens"]
    path = Path(lens_file) if lens_file is not None else find_lens(str(wanted["id"]), Path(model_file))
    tabled = read_any(path)
    for lens in _states(tabled, float(wanted["efl_mm"])):
        if lens.sha256 == wanted["sha256"]:
            return lens.with_stop_radius(float(card["domain"]["stop_radius_mm"]))
    expected = f"the prescription of {model_file}: {wanted['name']}, sha256 {str(wanted['sha256'])[:12]}..."
    raise InputError(path, "sha256", f"({tabled.name}, {tabled.sha256[:12]}...)", expected)


def find_lens(lens_id: str, model_file: Path) -> Path:
    """The lens file of an id: in lenses/ beside the model or its folder, of the working folder, or of this project.

    Raises:
        InputError: no such file.
    """
    name, beside = f"{Path(lens_id).name}.toml", model_file.resolve().parent
    for root in (beside, beside.parent, Path("."), library()):
        if (root / "lenses" / name).is_file():
            return root / "lenses" / name
    raise InputError(model_file, "lens", lens_id, f"lenses/{name}, or a lens file given with --lens")


def _states(tabled: Lens, efl_mm: float) -> Iterator[Lens]:
    """The lens in every zoom state, as tabled and at the focal length of the card."""
    for configuration in (None, *(c.name for c in tabled.configurations)):
        lens = set_lens(tabled, zoom=configuration)
        yield lens
        # The card has the computed focal length; the requested one, needed bit by bit, had fewer digits.
        for digits in (9, 12, 15):
            asked = float(f"{efl_mm:.{digits}g}")
            if abs(first_order(lens).efl_mm / asked - 1) > 1e-12:
                yield set_lens(tabled, zoom=configuration, focal_length_mm=asked)


RAY_KEYS = (
    "rms_um", "rms_um_at_21_6", "p99_um", "max_um", "rms_infinity_um", "direction_rms_deg", "position_rms_um",
    "transmittance_rms",
)  # fmt: skip
# Relative tolerance of an error that is the worst of other states and other rays.
TOLERANCE = 0.25
_VIGNETTING = 4  # rays that test it, for every ray that passes


def random_states(axes: Sequence[Axis], count: int, seed: int) -> list[State]:
    """States uniform over the ranges, as float32 holds them: of every axis, one in each of `count` equal parts."""
    generator = np.random.default_rng(seed)
    columns = []
    for axis in axes:
        low, high = axis.range
        place = (generator.permutation(count) + generator.uniform(size=count)) / count
        columns.append([min(max(float(np.float32(low + (high - low) * p)), low), high) for p in place])
    return list(zip(*columns, strict=True))


def errors_at(model: OnnxLens, space: StateSpace, state: State, rays: int, seed: int) -> dict[str, Any]:
    """Figures of one state: `RAY_KEYS` of `rays.RayErrors`, `SHARES` of four times as many rays, the state by axis.

    What is not finite is None. `film_z_um`: how far the card's paraxial image is from the exact lens's film, um.
    """
    here, lens = model.at(*state), space.lens_at(state)
    domain, predict = Domain.from_dict(here.card["domain"]), onnx_predictor(here)
    # The stop is the card's: the graph guards its radius, and between nodes the last digits differ.
    lens = lens.with_stop_radius(domain.stop_radius_mm)
    pairs = make_pairs(lens, domain, PairSettings(train=1, held_out=rays, rim=1, seed=seed))
    ray = ray_errors(lens, domain, pairs.held_out, predict)
    fresh = fresh_rays(lens, domain, pairs.held_out, count=_VIGNETTING * rays, seed=seed)
    share = false_shares(fresh.passes, predict(fresh.drawn, domain.stop_radius_mm).status == st.PASSED)
    figures = {k: getattr(ray, k) for k in RAY_KEYS} | share
    assert lens.film_z_mm is not None
    return {
        **dict(zip((a.name for a in model.axes), state, strict=True)),
        **{k: None if v is None or not math.isfinite(v) else v for k, v in figures.items()},
        "film_z_um": 1000 * (here.card["lens"]["film_z_mm"] - lens.film_z_mm),
        "passing_share": float(fresh.passes.double().mean()),
    }


def card_errors(rows: Sequence[Mapping[str, Any]], rays: int) -> dict[str, Any]:
    """The errors for a card: the worst over the measured states, their median, and every state."""

    def over(how: Any) -> dict[str, float | None]:
        columns = {key: [r[key] for r in rows] for key in (*RAY_KEYS, *SHARES)}
        return {key: None if None in values else float(how(values)) for key, values in columns.items()}

    passing = _VIGNETTING * rays * float(np.mean([r["passing_share"] for r in rows]))
    return {
        **over(max),
        "median": over(np.median),
        "states": [dict(r) for r in rows],
        "rays": rays,
        "passing": int(passing),
    }


def space_of_card(
    card: Mapping[str, Any], axes: Sequence[Axis], lens_file: Path | None, model_file: Path
) -> StateSpace:
    """The exact lens of a model of many states.

    Raises:
        InputError: no such file, or one whose prescription is not the card's at its first state.
    """
    path = lens_file if lens_file is not None else find_lens(str(card["lens"]["id"]), model_file)
    states = card["states"]
    space = StateSpace(read_any(path).with_aperture(None), tuple(axes), states["zoom"], states["f_number"])
    found = space.lens_at([float(v) for v in states["default"]])
    if found.sha256 != card["lens"]["sha256"]:
        expected = f"the prescription of {model_file}: {card['lens']['name']}, {str(card['lens']['sha256'])[:12]}..."
        raise InputError(path, "sha256", f"({found.name}, {found.sha256[:12]}...)", expected)
    return space


def check_states(
    model: OnnxLens, space: StateSpace, *, rays: int = 10_000, seed: int | None = None, count: int = 6
) -> tuple[dict[str, Any], list[Promise]]:
    """Measure a model of many states at fresh random states, on fresh rays.

    Returns the worst figures (with `states`, `median`, `rays` and `seed`) and the promises of the card.
    """
    fitted = int(model.card["fit"]["settings"].get("rays_seed") or 0)
    seed = fitted + _FRESH if seed is None else seed
    rows = [errors_at(model, space, s, rays, seed) for s in random_states(model.axes, count, seed)]
    found, promises = card_errors(rows, rays), []
    errors = model.card["errors"]
    for key, promised in _numbers(errors):
        if key in SHARES:
            promises.append(share_promise(key, promised, found[key], found["passing"], _count(errors, "passing")))
        elif key in RAY_KEYS:
            allowed = None if key == "max_um" else promised * (1 + TOLERANCE) + _FLOOR
            promises.append(Promise(key, promised, found[key], allowed))
    return {**found, "seed": seed}, promises
