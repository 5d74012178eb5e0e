"""Checks a model against the promises of its card, on fresh rays through the exact lens and the ONNX model."""

import math
import warnings
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from neurolens.base import status as st
from neurolens.base.errors import InputError, NeurolensWarning
from neurolens.base.files import library
from neurolens.cameras.model import OnnxLens
from neurolens.models.axes import Axis
from neurolens.models.fit import State, StateSpace
from neurolens.models.fitted import Domain
from neurolens.models.pairs import passing_rays
from neurolens.optics.lens.paraxial import first_order
from neurolens.optics.lens.prescription import Lens
from neurolens.optics.readers.any_format import read_any
from neurolens.optics.setting.states import set_lens
from neurolens.studies.measure import (
    STOPS,
    ZONED,
    Findings,
    FreshRays,
    finite,
    fresh_rays,
    measure,
    onnx_predictor,
    rms_deviation,
    well_known,
    with_more,
    zone_of,
)
from neurolens.studies.rays import ZONES, EachRay, false_shares, ray_errors

# How much worse than promised a figure may be on other rays: so many standard deviations of the estimate from a sample
# of this size, at least a tenth, at most a half. A largest error has no such bound: more rays find larger ones.
SIGMAS, LEAST, MOST = 4.0, 0.10, 0.50
# The errors per ray from which each figure is computed.
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
    """One figure of a card beside fresh rays; `allowed` is the promise with its tolerance, None where it has none."""

    key: str
    promised: float
    measured: float | None
    allowed: float | None
    holds: bool = field(init=False)

    def __post_init__(self) -> None:
        kept = self.allowed is None or (self.measured is not None and self.measured <= self.allowed)  # False for NaN
        object.__setattr__(self, "holds", kept)


def check_model(
    model: OnnxLens, lens: Lens, *, rays: int = 30_000, seed: int | None = None
) -> tuple[dict[str, Any], list[Promise]]:
    """Measure a model on rays that it has not seen.

    Args:
        lens: the exact lens, as `lens_of_card` gives it.
        rays: how many rays that the lens passes; eight times as many where a few bad rays decide an error. Four times
            as many test what passes and what is blocked.
        seed: None takes one that differs from the fit's.

    Returns the figures (those of `measure.Findings`, flat, with stopped_down, zones, rays and seed) and the card's
    promises: over the whole film, stopped down ("2_stops.false_pass") and by zone ("full.edge.rms_um").

    Warns:
        NeurolensWarning: the seed is the fit's own.
    """
    domain, seed = Domain.from_dict(model.card["domain"]), _fresh_seed(model, seed)
    fresh = fresh_rays(lens, domain, passing_rays(lens, domain, rays, seed), count=4 * rays, seed=seed)
    findings = measure(fresh, onnx_predictor(model))
    if not well_known(fresh, findings.each):
        fresh = with_more(fresh, seed + _FRESH)
        findings = measure(fresh, onnx_predictor(model))
    figures = {
        **findings.figures,
        "stopped_down": findings.stopped_down,
        "zones": findings.zones,
        "seed": seed,
        "rays": len(fresh.held_out),
    }
    return figures, promises_of(model.card["errors"], fresh, findings)


def _fresh_seed(model: OnnxLens, seed: int | None) -> int:
    fitted = int(model.card["fit"]["settings"].get("rays_seed") or 0)
    if seed == fitted:
        warnings.warn(f"seed {seed} is that of the fit: these rays are not fresh", NeurolensWarning, stacklevel=3)
    return fitted + _FRESH if seed is None else seed


def promises_of(errors: Mapping[str, Any], fresh: FreshRays, findings: Findings) -> list[Promise]:
    """Hold the promises in a card's `errors` against the findings of `measure` on fresh rays."""
    promises, passing, promised_of = [], int(fresh.passes.sum()), _numbers(errors).get("passing")
    for key, promised in _numbers(errors).items():
        if key in SHARES:
            promises.append(share_promise(key, promised, findings.figures[key], passing, promised_of))
        elif key in findings.figures and key != "rays":
            promises.append(_error(key, promised, findings.figures[key], findings.each, _numbers(errors).get("rays")))
    for state, shares in _tables(errors.get("stopped_down"), findings.stopped_down):
        closed = 2 ** STOPS[state]  # factor by which fewer rays pass
        counts = passing / closed, (promised_of or passing) / closed
        for key, promised in _numbers(shares).items():
            promises.append(share_promise(f"{state}.{key}", promised, findings.stopped_down[state].get(key), *counts))
    zones = [(s, z, p) for s, inner in _tables(errors.get("zones"), ZONED) for z, p in _tables(inner, ZONES)]
    for state, zone, table in zones:
        measured, each, numbers = (
            findings.zones[state][zone],
            zone_of(fresh, findings.each, state, zone),
            _numbers(table),
        )
        for key, promised in numbers.items():
            place, value = f"{state}.{zone}.{key}", measured.get(key)
            if value is None:
                continue  # too few rays
            if key in SHARES:
                promises.append(share_promise(place, promised, value, measured["passing"], numbers.get("passing")))
            elif key in _RMS:
                promises.append(_error(place, promised, value, each, numbers.get("rays")))
    return promises


def _tables(value: Any, names: Collection[str]) -> list[tuple[str, Mapping[str, Any]]]:
    """Return the tables of these names in a table."""
    items = value.items() if isinstance(value, Mapping) else ()
    return [(name, inner) for name, inner in items if name in names and isinstance(inner, Mapping)]


def _numbers(table: Mapping[str, Any]) -> dict[str, float]:
    """Return the finite numbers of a table."""
    numbers = {k: v for k, v in table.items() if isinstance(v, int | float) and not isinstance(v, bool)}
    return {key: float(value) for key, value in numbers.items() if math.isfinite(value)}


def _error(place: str, promised: float, measured: float | None, each: EachRay, promised_of: float | None) -> Promise:
    """Hold a promised error against fresh rays, with a tolerance from their spread."""
    key = place.rpartition(".")[2]
    value = math.nan if measured is None else float(measured)
    if key not in _RMS and key not in _P99:
        return Promise(place, promised, value, None)
    values = getattr(each, (_RMS | _P99)[key])
    two = math.sqrt(1 + len(values) / (promised_of or len(values)))  # both figures are samples
    deviation = rms_deviation(values) if key in _RMS else _p99_deviation(values)
    tolerance = min(max(SIGMAS * two * deviation, LEAST), MOST)
    return Promise(place, promised, value, promised * (1 + tolerance) + _FLOOR)


def _p99_deviation(values: Tensor) -> float:
    """Return the 99th percentile's relative standard deviation, from the quantile one deviation of its rank higher."""
    if not len(values):
        return 0.0
    higher = min(1.0, 0.99 + math.sqrt(0.99 * 0.01 / len(values)))
    at, above = (float(torch.quantile(values, q)) for q in (0.99, higher))
    return (above - at) / at if at > 0 else 0.0


def share_promise(
    place: str, promised: float, measured: float | None, rays: float, promised_of: float | None
) -> Promise:
    """Hold a promised share of `promised_of` rays against one of `rays`.

    Both are counts of rare events, whose tails are longer than a normal law's. So their square roots are compared,
    which vary by half a count whatever the count is (Huffman 1984, Applied Statistics 33, 224). Where many were
    counted, this is `SIGMAS` standard deviations of the difference.
    """
    rays, other = max(rays, 1.0), max(promised_of or rays, 1.0)
    ratio = rays / other
    root = math.sqrt(ratio * (promised * other + 3 / 8)) + SIGMAS / 2 * math.sqrt(1 + ratio)
    allowed = min((root * root - 3 / 8) / rays, 1.0)
    return Promise(place, promised, None if measured is None else float(measured), allowed)


def lens_of_card(
    card: Mapping[str, Any], lens_file: str | Path | None = None, model_file: str | Path = "model"
) -> Lens:
    """Return the exact lens of a model, in the model's zoom state, size and stop.

    Args:
        lens_file: None looks for the card's lens id in lenses/: beside the model, beside its folder (a run keeps its
            lens there), in the working folder, and in this project.

    Raises:
        InputError: there is no such file, or its prescription is the card's in no zoom state; or the model is of a copy
            of the lens, whose errors beside the exact copy are on its card.
    """
    if copy := card["fit"]["settings"].get("copy"):
        expected = "the model of a lens as designed: a copy's errors are on its card"
        raise InputError(model_file, "fit.settings.copy", copy, expected)
    path = Path(lens_file) if lens_file is not None else find_lens(str(card["lens"]["id"]), Path(model_file))
    tabled = read_any(path)
    for lens in _states(tabled, float(card["lens"]["efl_mm"])):
        if lens.sha256 == card["lens"]["sha256"]:
            return lens.with_stop_radius(float(card["domain"]["stop_radius_mm"]))
    raise _another_lens(tabled, card, path, model_file)


def _another_lens(lens: Lens, card: Mapping[str, Any], path: Path, model_file: str | Path) -> InputError:
    expected = f"the prescription of {model_file}: {card['lens']['name']}, sha256 {str(card['lens']['sha256'])[:12]}..."
    return InputError(path, "sha256", f"({lens.name}, {lens.sha256[:12]}...)", expected)


def find_lens(lens_id: str, model_file: Path) -> Path:
    """Find the lens file of an id: in lenses/ beside the model, its folder, the working folder or this project's.

    Raises:
        InputError: there is no such file.
    """
    name, beside = f"{Path(lens_id).name}.toml", model_file.resolve().parent
    for root in (beside, beside.parent, Path("."), library()):
        if (root / "lenses" / name).is_file():
            return root / "lenses" / name
    raise InputError(model_file, "lens", lens_id, f"lenses/{name}, or a lens file given with --lens")


def _states(tabled: Lens, efl_mm: float) -> Iterator[Lens]:
    """Yield the lens in every zoom state, as tabled and at the card's focal length."""
    for configuration in (None, *(c.name for c in tabled.configurations)):
        lens = set_lens(tabled, zoom=configuration)
        yield lens
        # The card has the computed focal length. The requested one, needed bit by bit, had fewer digits.
        for digits in (9, 12, 15):
            wanted = float(f"{efl_mm:.{digits}g}")
            if abs(first_order(lens).efl_mm / wanted - 1) > 1e-12:
                yield set_lens(tabled, zoom=configuration, focal_length_mm=wanted)


RAY_KEYS = (
    "rms_um", "rms_um_at_21_6", "p99_um", "max_um", "rms_infinity_um", "direction_rms_deg", "position_rms_um",
    "transmittance_rms",
)  # fmt: skip
# Relative tolerance of an error that is the worst over other states and other rays.
TOLERANCE = 0.25
_VIGNETTING = 4  # rays that test vignetting, for every ray that passes


def random_states(axes: Sequence[Axis], count: int, seed: int) -> list[State]:
    """Draw states uniform over the ranges, rounded to float32; each axis has one in each of `count` equal parts."""
    generator = np.random.default_rng(seed)
    columns = []
    for axis in axes:
        low, high = axis.range
        place = (generator.permutation(count) + generator.uniform(size=count)) / count
        columns.append([min(max(float(np.float32(low + (high - low) * p)), low), high) for p in place])
    return list(zip(*columns, strict=True))


def errors_at(model: OnnxLens, space: StateSpace, state: State, rays: int, seed: int) -> dict[str, Any]:
    """Measure one state: `RAY_KEYS` of `rays.RayErrors`, `SHARES` on four times as many rays, and the state by axis.

    What is not finite is None. `film_z_um` is how far the card's paraxial image is from the exact lens's film (um).
    """
    here, lens = model.at(*state), space.lens_at(state)
    domain, predict = Domain.from_dict(here.card["domain"]), onnx_predictor(here)
    # The stop is the card's, whose radius the graph tests: between nodes the last digits differ.
    lens = lens.with_stop_radius(domain.stop_radius_mm)
    passing = passing_rays(lens, domain, rays, seed)
    ray = ray_errors(lens, domain, passing, predict)
    fresh = fresh_rays(lens, domain, passing, count=_VIGNETTING * rays, seed=seed)
    share = false_shares(fresh.passes, predict(fresh.drawn, domain.stop_radius_mm).status == st.PASSED)
    assert lens.film_z_mm is not None
    return {
        **dict(zip((a.name for a in model.axes), state, strict=True)),
        **{key: finite(value) for key, value in ({k: getattr(ray, k) for k in RAY_KEYS} | share).items()},
        "film_z_um": 1000 * (here.card["lens"]["film_z_mm"] - lens.film_z_mm),
        "passing_share": float(fresh.passes.double().mean()),
    }


def card_errors(rows: Sequence[Mapping[str, Any]], rays: int) -> dict[str, Any]:
    """Return the errors for a card: the worst over the measured states, their median, and every state."""

    def over(how: Any) -> dict[str, float | None]:
        columns = {key: [r[key] for r in rows] for key in (*RAY_KEYS, *SHARES)}
        return {key: None if None in values else float(how(values)) for key, values in columns.items()}

    passing = int(_VIGNETTING * rays * float(np.mean([r["passing_share"] for r in rows])))
    return {**over(max), "median": over(np.median), "states": [*map(dict, rows)], "rays": rays, "passing": passing}


def space_of_card(
    card: Mapping[str, Any], axes: Sequence[Axis], lens_file: Path | None, model_file: Path
) -> StateSpace:
    """Return the exact lens of a model of many states.

    Raises:
        InputError: there is no such file, or its prescription is not the card's at the card's first state.
    """
    path = lens_file if lens_file is not None else find_lens(str(card["lens"]["id"]), model_file)
    states = card["states"]
    space = StateSpace(read_any(path).with_aperture(None), tuple(axes), states["zoom"], states["f_number"])
    lens = space.lens_at([float(v) for v in states["default"]])
    if lens.sha256 != card["lens"]["sha256"]:
        raise _another_lens(lens, card, path, model_file)
    return space


def check_states(
    model: OnnxLens, space: StateSpace, *, rays: int = 10_000, seed: int | None = None, count: int = 6
) -> tuple[dict[str, Any], list[Promise]]:
    """Measure a model of many states at fresh random states, on fresh rays.

    Returns the worst figures (with `states`, `median`, `rays` and `seed`) and the promises of the card.
    """
    seed = _fresh_seed(model, seed)
    rows = [errors_at(model, space, s, rays, seed) for s in random_states(model.axes, count, seed)]
    measured, promises, errors = card_errors(rows, rays), [], _numbers(model.card["errors"])
    for key, promised in errors.items():
        if key in SHARES:
            promises.append(share_promise(key, promised, measured[key], measured["passing"], errors.get("passing")))
        elif key in RAY_KEYS:
            allowed = None if key == "max_um" else promised * (1 + TOLERANCE) + _FLOOR
            promises.append(Promise(key, promised, measured[key], allowed))
    return {**measured, "seed": seed}, promises
