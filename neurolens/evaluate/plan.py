"""The cheapest camera that shows a scene as the lens does, within a budget.

A camera's error is the distance of its footprints from the exact lens's in pixels, and of its light, at the places of a
scene that a `probe` finds; both count where they are largest but for 5% of the picture.

Cost is nanoseconds a ray that passes, measured on this machine with one thread: a camera that wastes samples is charged
for them.
"""

from __future__ import annotations

import math
import time
from collections.abc import Collection, Iterator, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from neurolens.base.errors import InputError, ModelError
from neurolens.base.progress import Report
from neurolens.cameras.build import Shot, ideal_as
from neurolens.cameras.contract import RAYS_A_CALL, Camera
from neurolens.cameras.exact import FusedExactCamera
from neurolens.cameras.fused import FusedCamera
from neurolens.cameras.model import OnnxCamera, load_model
from neurolens.cameras.pinhole import Pinhole
from neurolens.cameras.warped import WarpedPinhole
from neurolens.evaluate import footprints as prints
from neurolens.evaluate.footprints import Footprints, Places
from neurolens.evaluate.probe import COUNTED, LIGHT, Asked, Effect, Probed, effects_of, probe
from neurolens.graph.compiler import has_compiler
from neurolens.optics.prescription import Lens
from neurolens.render.scene import Scene
from neurolens.surrogates.export import export_onnx
from neurolens.surrogates.fit import fit_model, prepare
from neurolens.surrogates.pairs import PairSettings, make_pairs
from neurolens.surrogates.settings import ModelSettings

Target = Literal["render", "c", "onnx"]
TARGETS: tuple[Target, ...] = ("render", "c", "onnx")
_TERMS = (8, 16, 28, 48)  # of the polynomials that are fitted on the spot
_PAIRS = PairSettings(train=5000, held_out=1000, rim=5000)
_MOST_OVERSCAN = 4.0  # of a plane picture that is warped afterwards
_ROUNDS = 7


@dataclass(frozen=True)
class Choice:
    """A camera that was tried.

    Attributes:
        camera: as `--camera` takes it. error_px, light_error: at the counted percentile; inf where it has no light
            that the lens has. ns: a ray that passes, inf where it was not timed. passed: share of rays.
        how: what else it needs, or how it was made. within: whether it meets the budget of its plan.
    """

    name: str
    camera: str
    error_px: float
    light_error: float
    ns: float
    passed: float
    how: str = ""
    within: bool = False

    def meets(self, budget_px: float) -> bool:
        """Whether it may be used."""
        return self.error_px <= budget_px and self.light_error <= LIGHT


@dataclass(frozen=True)
class Plan:
    """What was asked, the effects in falling order of worth, every camera tried by rising cost, the one to use."""

    asked: Asked
    budget_px: float
    target: Target
    effects: tuple[Effect, ...]
    choices: tuple[Choice, ...]
    best: Choice | None
    probed: Probed

    def to_dict(self) -> dict[str, Any]:
        """JSON-able: what is above `probed`."""
        told = asdict(replace(self, probed=None))  # type: ignore[arg-type]
        del told["probed"]
        return told


def plan(
    scene: Scene, lens: Lens, budget_px: float, *, target: Target = "render", models: Sequence[Path] = (),
    folder: Path | None = None, explain: bool = False, afterwards: Collection[str] = (), report: Report | None = None,
) -> Plan:  # fmt: skip
    """The cheapest camera for a scene whose error stays within a budget.

    Args:
        lens: as its file has it. budget_px: error of place and blur in pixels of the scene's picture.
        target: what runs the camera: our renderer with all it has, compiled C, or onnxruntime.
        models: exported models of this lens to try. folder: where models fitted for the shot go; None fits none.
        explain: whether models beyond the budget are compiled and timed, too; else their time is infinite.
        afterwards: what compositing makes of the picture, see `probe`.

    Raises:
        InputError: a budget that is negative or no number; as `probe`.
    """
    if not budget_px >= 0:
        raise InputError("plan", "budget_px", budget_px, "0 or more pixels")
    found = probe(scene, lens, afterwards=afterwards)
    tried = candidates(found, (budget_px,), target, models=models, folder=folder, explain=explain, report=report)
    return decided(found, tried, budget_px, target)


def candidates(
    found: Probed, budgets_px: Sequence[float], target: Target, *, models: Sequence[Path] = (),
    folder: Path | None = None, explain: bool = False, report: Report | None = None,
) -> tuple[Choice, ...]:  # fmt: skip
    """Cameras with error and cost, enough to decide for each of some budgets; arguments as of `plan`."""
    say = report or (lambda done: None)
    say(0.3)
    # Infinity: all are timed, whatever their light.
    timed_px, least_px = math.inf if explain else max(budgets_px), min(budgets_px)
    tried = [*_ideal(found, target), *_exact(found, target)]
    for file in models:
        tried += _try_model(found, file, target, timed_px)
    say(0.6)
    if folder is not None:
        for choice in _fitted(found, target, folder, timed_px):
            tried.append(choice)
            say(0.8)
            known = math.isfinite(choice.ns)
            if choice.meets(least_px) or (known and any(c.meets(least_px) and c.ns < choice.ns for c in tried)):
                break  # larger ones cost more
    return tuple(tried)


def decided(found: Probed, tried: Sequence[Choice], budget_px: float, target: Target) -> Plan:
    """The plan for a budget, from candidates that serve it."""
    ranked = tuple(replace(c, within=c.meets(budget_px)) for c in sorted(tried, key=lambda c: c.ns))
    best = next((c for c in ranked if c.within), None)
    return Plan(found.asked, budget_px, target, effects_of(found, budget_px), ranked, best, found)


def _ideal(found: Probed, target: Target) -> Iterator[Choice]:
    """Pinhole, the same with its picture warped afterwards, thin and thick lens; they are their own source in C."""
    if target == "onnx":
        return
    path, shot = found.lens.path, Shot(found.asked.film_mm, found.asked.focus_m)
    for kind in ("pinhole:", "thin:", "thick:"):
        with suppress(InputError):  # no thick lens of cylinders
            camera = ideal_as(kind, found.exact.lens, shot)
            spec = f"{kind}{path}"
            yield _judged(found, kind.rstrip(":"), spec, camera)
            if isinstance(camera, Pinhole) and "distortion" not in found.asked.afterwards:
                warped = WarpedPinhole(camera, found.exact, found.asked.focus_m)
                if (area := warped.area) < _MOST_OVERSCAN:
                    how = f"then the ST map of 'neurolens stmap' over the picture, of {area:.3g} times the area"
                    choice = _judged(found, "pinhole + ST map", spec, warped, how=how, timed=False)
                    yield replace(choice, ns=area * _ns_a_ray(camera, found.places), passed=1.0)


def _exact(found: Probed, target: Target) -> Iterator[Choice]:
    """The exact lens, which has no error; as C where that runs."""
    compiled = isinstance(found.exact, FusedExactCamera)
    if target == "render" or (target == "c" and compiled):
        spec = f"{'fused:' if compiled else ''}{found.lens.path}"
        yield _judged(found, "exact", spec, found.exact, found.seen)


def _try_model(found: Probed, file: Path, target: Target, timed_px: float, how: str = "") -> Iterator[Choice]:
    """A model in the form that the target runs; none where its domain is not the shot's, or it has no such form.

    Errors are of onnxruntime: compilers take seconds, and C gives the same rays; it is timed up to an error of
    `timed_px`.
    """
    asked = found.asked
    real: dict[str, Any] = {"film_mm": asked.film_mm, "focus_m": asked.focus_m, "f_number": asked.f_number}
    real["wavelength_nm"] = asked.wavelength_nm
    compiled = target != "onnx" and has_compiler()
    with suppress(InputError, ModelError):
        model = load_model(file)
        spec = f"{'fused:' if compiled else ''}{file}"
        choice = _judged(found, file.stem, spec, OnnxCamera(model, **real), how=how, timed=not compiled)
        if compiled and (choice.meets(timed_px) or math.isinf(timed_px)):
            cost = _ns_a_ray(FusedCamera(model, **real), found.places) / max(choice.passed, 1e-9)
            choice = replace(choice, ns=cost)
        if compiled or target != "c":
            yield choice


def _fitted(found: Probed, target: Target, folder: Path, timed_px: float) -> Iterator[Choice]:
    """Polynomials fitted for the shot alone, of rising size."""
    prepared = prepare(make_pairs(found.lens, found.domain, _PAIRS))
    folder.mkdir(parents=True, exist_ok=True)
    for terms in _TERMS:
        settings = ModelSettings("ols", terms=terms, planes=False, elimination=False)
        file = folder / f"{Path(found.lens.path).stem}.shot-{settings.label}.onnx"
        export_onnx(fit_model(prepared, settings), file, errors={})
        yield from _try_model(found, file, target, timed_px, "fitted for this shot")


def _judged(
    found: Probed, name: str, spec: str, camera: Camera, seen: Footprints | None = None, how: str = "",
    timed: bool = True,
) -> Choice:  # fmt: skip
    """A camera's error against the exact footprints, and its cost."""
    share = found.places.share
    seen = prints.footprints(camera, found.places) if seen is None else seen
    apart = prints.distance_mm(found.wanted, seen, share) / found.asked.pixel_mm
    light = np.abs(seen.light / np.maximum(found.wanted.light, 1e-30) - 1)
    if "distortion" in found.asked.afterwards:  # the map corrects light, too
        light = np.where(seen.light > 0, 0.0, light)
    error, dim = (float(np.percentile(np.where(np.isfinite(v), v, np.inf), COUNTED)) for v in (apart, light))
    cost = _ns_a_ray(camera, found.places) / max(seen.passed, 1e-9) if timed else math.inf
    return Choice(name, spec, error, dim, cost, seen.passed, how)


def _ns_a_ray(camera: Camera, places: Places) -> float:
    """Least nanoseconds of some calls, over their rays."""
    rays = int(getattr(camera, "rays_a_call", RAYS_A_CALL))
    rng = np.random.default_rng(1)
    rows = rng.integers(0, places.film_mm.shape[1], rays)
    film, pupil = places.film_mm[:, rows].astype(np.float32), rng.random((2, rays), np.float32)
    waves = rng.choice(places.wavelength_nm, rays, p=places.share).astype(np.float32)
    best = math.inf
    for _ in range(_ROUNDS):
        began = time.perf_counter()
        camera.sample(film, pupil, waves)
        best = min(best, time.perf_counter() - began)
    return 1e9 * best / rays
