"""Errors of models of many states: at random states, most of them no node, against the exact lens there."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from neurolens.base.errors import InputError
from neurolens.cameras.model import OnnxLens
from neurolens.evaluate.check import Promise, find_lens, share_promise
from neurolens.evaluate.measure import onnx_predictor
from neurolens.evaluate.rays import ray_errors
from neurolens.evaluate.vignetting import vignetting_errors
from neurolens.modelfile.axes import Axis
from neurolens.optics.lensfile import read_lens
from neurolens.surrogates.domain import Domain
from neurolens.surrogates.pairs import PairSettings, make_pairs
from neurolens.surrogates.states.model import State
from neurolens.surrogates.states.space import StateSpace

RAY_KEYS = (
    "rms_um", "rms_um_at_21_6", "p99_um", "max_um", "rms_infinity_um", "direction_rms_deg", "position_rms_um",
    "transmittance_rms",
)  # fmt: skip
SHARES = ("false_pass", "false_block")
# An error that is the worst of other states and other rays may be so much worse, relatively.
TOLERANCE = 0.25
_FLOOR = 5e-7
_VIGNETTING = 4  # rays that test it, for every ray that passes
_FRESH = 7919


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
    """Figures of one state: `RAY_KEYS` of `rays.ray_errors`, `SHARES` of four times as many rays, the state by axis.

    What is not finite is None. `film_z_um`: how far the card's first film plane is from the exact lens's, um.
    """
    here, lens = model.at(*state), space.lens_at(state)
    domain, predict = Domain.from_dict(here.card["domain"]), onnx_predictor(here)
    # The stop is the card's: the graph guards its radius, and between nodes the last digits differ.
    lens = lens.with_stop_radius(domain.stop_radius_mm)
    pairs = make_pairs(lens, domain, PairSettings(train=1, held_out=rays, rim=1, seed=seed))
    ray = ray_errors(lens, domain, pairs.held_out, predict)
    share = vignetting_errors(lens, domain, predict, count=_VIGNETTING * rays, seed=seed)
    figures = {**{k: ray[k] for k in RAY_KEYS}, **{k: share[k] for k in SHARES}}
    assert lens.film_z_mm is not None
    return {
        **dict(zip((a.name for a in model.axes), state, strict=True)),
        **{k: None if v is None or not math.isfinite(v) else v for k, v in figures.items()},
        "film_z_um": 1000 * (domain.film_z_mm[0] - lens.film_z_mm),
        "passing_share": share["passing_share"],
    }


def card_errors(rows: Sequence[Mapping[str, Any]], rays: int) -> dict[str, Any]:
    """What a card promises: the worst over the states measured, their median, and every state."""

    def over(key: str, how: Any) -> float | None:
        values = [r[key] for r in rows]
        return None if any(v is None for v in values) else float(how(values))

    keys = (*RAY_KEYS, *SHARES)
    passing = 0.0 if not rows else _VIGNETTING * rays * float(np.mean([r["passing_share"] for r in rows]))
    return {
        **{k: over(k, max) for k in keys},
        "median": {k: over(k, np.median) for k in keys},
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
    space = StateSpace(read_lens(path).with_aperture(None), tuple(axes), states["zoom"], states["f_number"])
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
    for key in (*RAY_KEYS, *SHARES):
        promised = errors.get(key)
        if isinstance(promised, bool) or not isinstance(promised, int | float):
            continue
        allowed = None if key == "max_um" else promised * (1 + TOLERANCE) + _FLOOR
        if key in SHARES:
            promises.append(share_promise(key, promised, found[key], found["passing"], errors.get("passing")))
            continue
        promises.append(Promise(key, float(promised), found[key], allowed))
    return {**found, "seed": seed}, promises
