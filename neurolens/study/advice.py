"""Which camera to use: the one decision of `train`, `models`, `plan` and the README.

The exact lens has no error and needs no fit. A model is worth its error where it makes the whole work `SAVING` times as
fast; a plan, which measures the scene, takes it wherever the times differ by more than their accuracy. In a picture of
our renderer the camera is a small part of that work; elsewhere it may be all of it.
"""

from __future__ import annotations

import math
import shlex
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

from neurolens.base.files import library
from neurolens.base.records import error_of, noisy, program, reaches, time_of
from neurolens.base.settings import RANGE

C = TypeVar("C")
R = TypeVar("R", bound=Mapping[str, Any])

CLOSE_UM = 2.0  # a model within this RMS error counts as close: a quarter of a pixel of 36 mm at 4000 across
SAVING = 1.5
# Nanoseconds that a path takes besides its camera in the cheapest scene of experiments/results/render_times.
PATH_NS = 190.0
# Nanoseconds of a refraction of the exact lens as C, on the machine that timed models/. It was 2.1 there; since C works
# in parts, the exact lens takes 0.6 of its former time beside models (experiments/results/fused_speed).
REFRACTION_NS = 1.3


def recommended(
    cameras: Iterable[C], cost: Callable[[C], float], exact: C | None, rest: float = 0.0, saving: float = SAVING
) -> C | None:
    """The cheapest of the cameras that keep a budget, or the exact lens where that one does not save enough.

    Args:
        cost: gives the cost of a ray.
        exact: None where the exact lens cannot run.
        rest: cost of the rest of the work for each ray.
        saving: how many times as fast the whole work must be.
    """
    best = min(cameras, key=cost, default=None)
    if exact is None or best is None:
        return exact if best is None else best
    return best if saving * (cost(best) + rest) <= cost(exact) + rest else exact


def to_use(
    models: Sequence[R], most: float = CLOSE_UM, key: str = "rms_um", exact: R | None = None, rest: float = 0.0
) -> R | None:
    """The model to use, or the exact lens: see `recommended`. None without any.

    Models count that are within an error and not poor; ideal lenses (thin, thick) do not. If no model counts and the
    exact lens was not timed, the closest model is taken.

    Args:
        exact: record of the exact lens (`records.ExactRecord`).
        rest: nanoseconds of the rest of the work for each ray.
    """
    fits = [m for m in models if m.get("family") != "paraxial"]
    close = [m for m in fits if reaches(m, most, key) and not m.get("poor")]
    if exact is None and not any(time_of(m) for m in close):
        return min(close or fits, key=(lambda m: m.get("bytes") or math.inf) if close else error_of, default=None)
    return recommended(close, lambda m: time_of(m).get("min", math.inf), exact, rest)


def exact_of(records: Iterable[R]) -> R | None:
    """The fastest exact tracer that was timed."""
    timed = [r for r in records if time_of(r)]
    return min(timed, key=lambda r: time_of(r)["min"], default=None)


def expected_exact(refractions: int) -> dict[str, Any]:
    """A record of the exact lens as C, where it was not timed."""
    return {"name": "exact C, expected", "ns_per_ray": {"min": REFRACTION_NS * refractions}}


@dataclass(frozen=True)
class Advice:
    """The camera to use in one place: its name, the reason, and the command that uses it (empty: none is known)."""

    where: str
    name: str
    why: str
    command: str

    def __str__(self) -> str:
        return f"{self.where} use {self.name}: {self.why}."


def advice(results: Mapping[str, Any], folder: Path) -> list[Advice]:
    """The cameras of a run to use in our renderer and in other programs; empty for a run without models.

    Args:
        results: a table of the fields of `records.Results`.
        folder: of the run, which commands name.
    """
    models: Sequence[Mapping[str, Any]] = results["models"]
    exact, target = exact_of(results.get("exact") or ()), results.get("target")
    within = target["within_um"] if target else CLOSE_UM
    lens = folder / "lenses" / f"{Path(str(results.get('lens', {}).get('file') or 'lens')).stem}.toml"
    state = (results.get("settings") or {}).get("lens") or {}
    names = "focal_length_mm", "zoom", "f_number", "efl_mm", "configuration"  # the last two by their earlier names
    whole = all(state.get(k) in (None, "none", RANGE) for k in names)  # as its file has it
    advices = []
    for where, rest in (("In this renderer", PATH_NS), ("In other programs", 0.0)):
        best = to_use(models, within, exact=exact, rest=rest)
        if best is None or not (best is exact or best.get("file")):
            continue
        if exact is not None and best is exact:
            name, file, fused = "the exact lens", str(lens) if whole else "", " C" in exact["name"]
            why = _why_exact(exact, to_use(models, within), within, rest)
        else:
            name, file, fused = str(best["name"]), str(folder / best["file"]), bool(best.get("fused_ns_per_ray"))
            why = _why_model(best, exact, within)
        if rest:
            scene, camera = Path("experiments/scenes/room.toml"), f"{'fused:' if fused else ''}{file}"  # as C if it can
            words = [str(scene if scene.is_file() else library() / scene), "--camera", camera, "-o", "room.exr"]
            command = f"{program()} render {shlex.join(words)}"
        else:  # one model of many states is no function of a ray alone
            command = "" if best.get("states") else f"{program()} export {shlex.quote(file)} --to c -o lens.h"
        advices.append(Advice(where, name, why, command if file else ""))
    return advices


def _why_exact(exact: Mapping[str, Any], model: Mapping[str, Any] | None, within: float, rest: float) -> str:
    reason = f"{ns_text(time_of(exact))} a ray ({exact['name']}), without error"
    if model is None or not reaches(model, within) or model.get("poor"):
        return f"{reason}; no model is within {within:.3g} um"
    times = (time_of(exact)["min"] + rest) / (time_of(model).get("min", math.inf) + rest)
    whole = "a picture of even a cheap scene" if rest else "that"
    faster = f"with {model['name']} ({ns_text(time_of(model))}) {whole} is {times:.3g} times as fast"
    return f"{reason}; {faster}, and an error is worth it from {SAVING:g} on"


def _why_model(model: Mapping[str, Any], exact: Mapping[str, Any] | None, within: float) -> str:
    timing = time_of(model)
    reasons = [f"{'the fastest' if reaches(model, within) else 'the closest, as none is'} within {within:.3g} um"]
    if model.get("rms_um") is not None:
        reasons.append(f"error {model['rms_um']:.3g} um RMS")
    if timing:
        reasons.append(f"{ns_text(timing)} a ray {'as C' if model.get('fused_ns_per_ray') else 'in onnxruntime'}")
    if exact is not None and timing:
        reasons.append(f"{time_of(exact)['min'] / timing['min']:.2g} times as fast as the exact lens")
    return ", ".join(reasons)


def ns_text(timing: Mapping[str, Any]) -> str:
    """A time in words, with "~" before a noisy one."""
    return f"{'~' * noisy(timing)}{timing['min']:.3g} ns" if timing else "-"
