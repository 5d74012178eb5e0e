"""The cheapest camera that shows a scene as the lens does, within a budget; the exact lens where that saves too little.

A camera's error is the distance of its footprints from the exact lens's in pixels, and of its light, at the places of a
scene that a `probe` finds; both count where they are largest but for 5% of the picture.

Cost is what a ray takes in the target named, times the noise of its weights: see `costs`. In C and onnxruntime that is
measured here, with one thread; of shaders it is counted.
"""

from __future__ import annotations

import math
import os
import warnings
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, Literal

import numpy as np

from neurolens.base.errors import InputError, ModelError, NeurolensWarning
from neurolens.base.lensname import IDEAL_OF, split_kind
from neurolens.base.progress import Report
from neurolens.base.records import Timing, noisy
from neurolens.base.settings import to_toml
from neurolens.base.tomlfile import format_toml
from neurolens.cameras.build import ideal_as
from neurolens.cameras.contract import Camera
from neurolens.cameras.model import OnnxCamera, OnnxLens, load_model
from neurolens.cameras.warped import Warped
from neurolens.graph.compiler import has_compiler
from neurolens.graph.scalars import lower
from neurolens.lens.prescription import Lens
from neurolens.plan import footprints as prints
from neurolens.plan.costs import (
    CYCLES_NS,
    GLSL_OPERATIONS,
    UNIT,
    glsl_operations,
    noise,
    ns_a_ray,
    rest_ns,
    shader_cost,
)
from neurolens.plan.footprints import Footprints
from neurolens.plan.probe import COUNTED, LIGHT, Asked, Effect, Probed, effects_of, probe
from neurolens.plan.shot_fits import PAIRS, shot_domain, shot_fits, shot_terms
from neurolens.render.scene import Scene
from neurolens.shaders.blender_shader import lens_of
from neurolens.study.advice import recommended
from neurolens.study.experiment import DomainChoice, EvaluationChoice, Experiment, LensChoice
from neurolens.surrogates.targets import ModelSettings

Target = Literal["render", "c", "onnx", "osl", "glsl"]
Cost = Callable[[], tuple[Timing, float]]  # of a ray, and noise
_OURS = ("render", "c")  # run compiled C
_EXACT, _IDEAL = "exact", ("pinhole", "thin", "thick")
_MAPPED = " + ST map"  # after the name of an ideal camera
_SHOT = "fitted for this shot"
_CLOSE = 1.3  # times the operations of the smallest model that holds, up to which others of its form are timed
_MOST_OVERSCAN = 4.0  # of a plane picture that is warped afterwards


@dataclass(frozen=True)
class Choice:
    """A camera that was tried.

    Attributes:
        camera: as `--camera` takes it, or what `export` takes. error_px, light_error: at the counted percentile; inf
            where it has no light that the lens has. cost: of a ray, in the plan's unit, times `noise`; inf where it was
            not asked for. noise: how many times the rays it needs for equal error, see `costs`.
        spread: how many times as long as the least the median of its timed calls took (1 where cost is counted).
        how: what else it needs, or how it was made. within: whether it meets the budget of its plan.
        settings: of a model that was fitted for the shot. flip: of its picture, where a budget of FLIP asked for it.
    """

    name: str
    camera: str
    error_px: float
    light_error: float
    cost: float
    noise: float
    how: str = ""
    within: bool = False
    settings: ModelSettings | None = None
    flip: float | None = None
    spread: float = 1.0

    @property
    def noisy(self) -> bool:
        """Whether the timing spreads too far to tell it from one that is a little shorter: see `records.noisy`."""
        return noisy({"min": 1.0, "median": self.spread})

    def meets(self, budget_px: float) -> bool:
        """Whether it may be used."""
        return self.error_px <= budget_px and self.light_error <= LIGHT


_SHOWN = "film_mm", "focus_m", "f_number", "wavelength_nm"  # settings of the shot in `Plan.to_dict`


@dataclass(frozen=True)
class Plan:
    """What was asked, the effects in falling order of worth, every camera tried by rising cost, the one to use.

    Attributes:
        budget_s, budget_flip: seconds, or FLIP difference, of a plan for those, whose `budget_px` is then the error of
            the best camera.
        unit: of costs: "ns" or, where no time is known, "operations". domain: of models that are fitted.
        rest: what a path takes besides its camera, in the same unit; 0 where the camera alone counts.
    """

    asked: Asked
    budget_px: float
    budget_s: float | None
    target: Target
    unit: str
    domain: DomainChoice
    effects: tuple[Effect, ...]
    choices: tuple[Choice, ...]
    best: Choice | None
    probed: Probed
    budget_flip: float | None = None
    rest: float = 0.0

    def to_dict(self) -> dict[str, Any]:
        """JSON-able: what is above `probed`."""
        told = asdict(replace(self, probed=None))  # type: ignore[arg-type]
        del told["probed"]
        shot = told["asked"].pop("shot")
        told["asked"] = {name: shot[name] for name in _SHOWN} | told["asked"]
        return told

    def to_toml(self, lens: Lens, folder: Path) -> str:
        """The text of a file in a folder that `render` and `export` take for the best camera, and `train` as the
        experiment that fits it, where it is a model of the shot. Paths in it are relative to the folder."""
        best = self.best
        assert best is not None
        kind, path = split_kind(best.camera)
        camera, title = f"{kind}{os.path.relpath(path, folder)}", f"{lens.name}: {best.name}"
        if best.settings is None:
            return format_toml({"title": title, "camera": camera})
        file, asked = Path(os.path.relpath(lens.path, folder)), self.asked
        choice = LensChoice(file, zoom=asked.zoom, f_number=asked.f_number)
        checks = EvaluationChoice(vignetting_rays=50_000, rounds=0, compile_exact=False)
        return to_toml(Experiment(title, choice, (best.settings,), self.domain, PAIRS, checks, camera=camera))


def plan(
    scene: Scene, lens: Lens, budget_px: float, *, target: Target = "render", models: Sequence[Path] = (),
    folder: Path | None = None, explain: bool = False, report: Report | None = None, **look: Any,
) -> Plan:  # fmt: skip
    """The cheapest camera for a scene whose error stays within a budget, or the exact lens where that one saves too
    little (`advice.recommended`). In our renderer the rest of the picture counts, too.

    Args:
        lens: as its file has it. budget_px: error of place and blur in pixels of the scene's picture.
        target: what runs the camera: our renderer with all it has, compiled C, onnxruntime, Blender's Cycles (osl), or
            a renderer in GLSL.
        models: exported models of this lens to try. folder: where models fitted for the shot go; None fits none.
        explain: whether cameras beyond the budget are compiled and timed, too; else their cost is infinite.
        look: further arguments of `probe`: zoom, and what is made of the picture later.

    Raises:
        InputError: a budget that is negative or no number; as `probe`.
    """
    if not budget_px >= 0:
        raise InputError("plan", "budget_px", budget_px, "0 or more pixels")
    found = probe(scene, lens, **look)
    rest = rest_of(scene, found, target)
    folder = folder if explain or not exact_suffices(found, rest) else None
    tried = candidates(found, (budget_px,), target, models=models, folder=folder, explain=explain, report=report)
    return decided(found, tried, budget_px, target, rest)


def rest_of(scene: Scene, found: Probed, target: Target) -> float:
    """What a path takes besides its camera: in our renderer by a small picture, in other targets 0."""
    return rest_ns(scene, found.exact) if target == "render" else 0.0


def exact_suffices(found: Probed, rest: float) -> bool:
    """Whether not even a camera that costs nothing would save enough, so that nothing needs to be fitted."""
    exact = ns_a_ray(found.exact, found.places)["min"] if rest else math.inf
    return recommended((0.0,), float, exact, rest) == exact


def candidates(
    found: Probed, budgets_px: Sequence[float], target: Target, *, models: Sequence[Path] = (),
    folder: Path | None = None, explain: bool = False, report: Report | None = None,
) -> tuple[Choice, ...]:  # fmt: skip
    """Cameras with error and cost, enough to decide for each of some budgets; arguments as of `plan`."""
    say = report or (lambda done, left=None: None)
    say(0.2)
    trial = _Trial(found, target, tuple(budgets_px), explain)
    tried = [*_ideal(trial), *_exact(trial)]
    # What one thread fits and the other looks at has nothing to do with each other. A film beyond the end of a model's
    # range is not told of: its error counts.
    with warnings.catch_warnings(), ThreadPoolExecutor(1) as other:
        warnings.simplefilter("ignore", NeurolensWarning)
        shipped = other.submit(_shipped, trial, models)
        if not explain:  # what the lens adds to the light
            other.submit(lambda: found.maps)
        fitted = [] if folder is None else _fitted(trial, folder, tried, lambda done, left=None: say(0.2 + 0.6 * done))
        tried += shipped.result() + fitted
        say(0.8)
        return tuple(_costed(trial, tried))


def best_of(within: Sequence[Choice], rest: float | None) -> Choice | None:
    """The camera to use of those within a budget; `rest` as of `decided`."""
    exact = next((c for c in within if c.name == _EXACT and math.isfinite(c.cost)), None)
    return recommended(within, lambda c: c.cost, None if rest is None else exact, rest or 0.0)


def decided(
    found: Probed, tried: Sequence[Choice], budget_px: float, target: Target, rest: float | None = None
) -> Plan:
    """The plan for a budget, from candidates that serve it.

    Args:
        rest: cost of a path besides its camera; None chooses the cheapest camera, whatever it saves.
    """
    ranked = tuple(replace(c, within=c.meets(budget_px)) for c in sorted(tried, key=lambda c: c.cost))
    best = best_of([c for c in ranked if c.within], rest)
    effects = effects_of(found, budget_px)
    return Plan(
        found.asked, budget_px, None, target, UNIT[target], shot_domain(found), effects, ranked, best, found,
        rest=rest or 0.0,
    )  # fmt: skip


@dataclass(frozen=True)
class _Judged:
    """A camera with its errors, and what tells the cost of a ray and its noise.

    Attributes:
        form: of models, "ols" or another method. size: operations of a ray. Where both are given, a model of more size
            is taken to cost no less than one of the same form.
    """

    choice: Choice
    cost: Cost
    form: str = ""
    size: int = 0


@dataclass(frozen=True)
class _Trial:
    """What cameras are tried for, and whether all are to have their cost."""

    found: Probed
    target: Target
    budgets_px: tuple[float, ...]
    explain: bool = False

    @property
    def share(self) -> prints.Array:
        """The share of the scene's light that each wavelength stands for."""
        return self.found.places.share

    @property
    def by_size(self) -> bool:
        """Whether costs rise with size; shaders of models have pupils and noise of their own."""
        return self.target != "osl" and not self.explain

    def judged(
        self, name: str, spec: str, seen: Footprints, cost: Cost, how: str = "", form: str = "", size: int = 0,
        beside: prints.Array | float = 0.0,
    ) -> _Judged:  # fmt: skip
        """A camera's error against the exact footprints, its cost not told yet; `beside`: light outside the lens's."""
        found = self.found
        apart = prints.distance_mm(found.wanted, seen, self.share) / found.asked.pixel_mm
        light = np.abs(seen.light / np.maximum(found.wanted.light, 1e-30) - 1) + beside
        if "distortion" in found.asked.afterwards:  # its map corrects light, too
            light = np.where(seen.light > 0, 0.0, light)
        error, dim = (float(np.percentile(np.where(np.isfinite(v), v, np.inf), COUNTED)) for v in (apart, light))
        choice = Choice(name, spec, error, dim, math.inf, noise(seen.weight, self.share), how)
        return _Judged(choice, cost, form, size)

    def costed(self, judged: _Judged) -> Choice:
        """A camera with its cost."""
        choice, (timing, times) = judged.choice, judged.cost()
        # A shader that does not focus so near shows nothing.
        return replace(
            choice,
            cost=timing["min"] * (1.0 if self.found.asked.denoised else times),
            noise=times,
            spread=timing["median"] / timing["min"] if timing["min"] else 1.0,
            error_px=choice.error_px if math.isfinite(times) else math.inf,
        )

    def timed(self, camera: Camera, seen: Footprints) -> tuple[Timing, float]:
        return ns_a_ray(camera, self.found.places), noise(seen.weight, self.share)

    def ideal(self, name: str, camera: Camera, seen: Footprints, area: float = 1.0) -> tuple[Timing, float]:
        """The cost of a camera without a lens, whose picture is so many times as large."""
        known = {"osl": CYCLES_NS, "glsl": GLSL_OPERATIONS}.get(self.target)
        if known is not None:
            return _counted(area * known[name]), noise(seen.weight, self.share)
        timing, times = self.timed(camera, seen)
        return {"min": area * timing["min"], "median": area * timing["median"]}, times

    def shader(self, file: str | Path) -> tuple[Timing, float]:
        """The cost of the shader of a model or a lens."""
        asked = self.found.asked
        state = asked.zoom if str(file) == self.found.lens.path else None  # models are of one
        lens = lens_of(Path(file), state, lambda done, left=None: None)[1]
        ns, times = shader_cost(lens, self.found.places, asked.shot.film_mm, asked.f_number, asked.shot.focus_m)
        return _counted(ns), times


def _counted(cost: float) -> Timing:
    """A cost that is no measurement, and so has no spread."""
    return {"min": cost, "median": cost}


def camera_of(found: Probed, choice: Choice) -> Camera:
    """The camera of a choice, in our renderer; with the maps of its picture, where it needs them.

    Raises:
        InputError, ModelError: as the cameras.
    """
    kind, path = split_kind(choice.camera)
    if choice.name == _EXACT:
        return found.exact
    if kind in IDEAL_OF:
        flat = ideal_as(kind, found.exact.lens, found.asked.shot)
        mapped = choice.name.endswith(_MAPPED)
        return Warped(flat, found.exact, found.asked.shot.focus_m, tables=found.exact_field) if mapped else flat
    return OnnxCamera(load_model(path), found.asked.shot, runtime="c" if kind else "onnxruntime")


def _ideal(trial: _Trial) -> Iterator[_Judged]:
    """Pinhole, thin and thick lens, as they are and with their picture warped afterwards, where the target has them.

    In C and GLSL they are their own source.
    """
    found, shot = trial.found, trial.found.asked.shot
    for name in {"onnx": (), "osl": _IDEAL[:2]}.get(trial.target, _IDEAL):
        spec = f"{name}:{found.lens.path}"
        with suppress(InputError):  # no thick lens of cylinders; no maps of half a sphere, or of a film that is dark
            camera = ideal_as(f"{name}:", found.exact.lens, shot)
            seen = prints.footprints(camera, found.places)
            yield trial.judged(name, spec, seen, partial(trial.ideal, name, camera, seen))
            if "distortion" in found.asked.afterwards:
                continue
            if name == "thin" and trial.target in _OURS:
                continue  # in our renderer the thick lens stands in its place
            maps = Warped(camera, found.exact, found.asked.shot.focus_m)
            if maps.area < _MOST_OVERSCAN:
                how = f"then the ST map of 'neurolens stmap' over the picture, of {maps.area:.3g} times the area"
                cost = partial(trial.ideal, name, camera, seen, maps.area)
                yield trial.judged(f"{name}{_MAPPED}", spec, prints.footprints(maps, found.places), cost, how)


def _exact(trial: _Trial) -> Iterator[_Judged]:
    """The exact lens, which has no error: as C where that runs, and as code where its surfaces have a form in it."""
    found, target = trial.found, trial.target
    exact, path, compiled = found.exact, found.lens.path, found.exact.runtime == "c"
    cost: Cost = {
        "osl": lambda: trial.shader(path),
        "glsl": lambda: (_counted(glsl_operations(exact)), noise(found.seen.weight, trial.share)),
    }.get(target, lambda: trial.timed(exact, found.seen))
    if target == "render" or (target != "onnx" and compiled) or target in ("osl", "glsl"):
        with suppress(InputError):  # a shader that is too large
            yield trial.judged(_EXACT, f"{'fused:' if compiled and target in _OURS else ''}{path}", found.seen, cost)


def _model(trial: _Trial, file: Path, how: str = "", without: Collection[str] = ()) -> Iterator[_Judged]:
    """A model in the form that the target runs; none where its domain is not the shot's, or it has no such form, or is
    of a form to do without.

    Errors are of onnxruntime: compilers take seconds, and C and shaders give the same rays. They are told within the
    outline of the exact lens's pupil, from the same points of it: rows of samples leave out the rim of what fills an
    outline, and two outlines of one lens would differ by a percent of light and 0.2% of the blur. What a model lets
    pass outside it counts as its light's error.
    """
    target = trial.target
    compiled = target in _OURS and has_compiler()
    with suppress(InputError, ModelError):
        model = load_model(file)
        form = model.card["fit"]["method"].partition("-")[0]
        if form in without or not (compiled or target != "c"):
            return
        camera = OnnxCamera(model, trial.found.asked.shot, outline=trial.found.exact.film.outline)
        seen = prints.footprints(camera, trial.found.places)
        beside = prints.light_beside(camera, trial.found.places) / np.maximum(trial.found.seen.light, 1e-30)

        def cost() -> tuple[Timing, float]:
            if target == "osl":
                return trial.shader(file)
            if target == "glsl":
                return _counted(glsl_operations(camera)), noise(seen.weight, trial.share)
            return trial.timed(camera.compiled() if compiled else camera, seen)

        spec = f"{'fused:' if compiled else ''}{file}"
        yield trial.judged(file.stem, spec, seen, cost, how, form, _operations(model), beside)


def _operations(model: OnnxLens) -> int:
    """The number of float operations that a ray of a model costs; 0 of networks that only onnxruntime runs."""
    with suppress(InputError):
        return sum(lower(model.graph()).count().values())
    return 0


def _shipped(trial: _Trial, files: Sequence[Path]) -> list[_Judged]:
    """Models that are there; of one form from the smallest on, up to one that holds the least budget."""
    found: list[_Judged] = []
    for file in sorted(files, key=lambda f: f.stat().st_size if f.is_file() else 0):
        done = {j.form for j in found if trial.by_size and j.choice.meets(min(trial.budgets_px))}
        found += _model(trial, file, without=done)
    return found


def _costed(trial: _Trial, tried: Sequence[_Judged]) -> Iterator[Choice]:
    """Cameras with their cost where it matters: of those that hold a budget, and of models of one form the smallest
    and what is about as small."""
    asked = {id(j) for j in tried} if trial.explain else set[int]()
    for budget_px in trial.budgets_px:
        holds = [j for j in tried if j.choice.meets(budget_px)]
        for j in holds:
            least = min(k.size for k in holds if k.form == j.form)
            if not (trial.by_size and j.size > _CLOSE * least > 0):
                asked.add(id(j))
    for j in tried:
        yield trial.costed(j) if id(j) in asked else j.choice


def model_choice(found: Probed, target: Target, file: Path, how: str, costed: bool) -> Choice | None:
    """A model in the form that the target runs; None where it has none, or its domain is not the shot's."""
    with warnings.catch_warnings():  # film beyond the end of its range: its error counts
        warnings.simplefilter("ignore", NeurolensWarning)
        trial = _Trial(found, target, ())
        judged = next(_model(trial, file, how), None)
        return None if judged is None else trial.costed(judged) if costed else judged.choice


def _fitted(trial: _Trial, folder: Path, tried: Sequence[_Judged], say: Report) -> list[_Judged]:
    """Polynomials fitted for the shot alone: the smallest that holds each budget, and those on the way to it.

    None where a camera without a lens does, in targets where it costs less than any, unless all is asked for.
    """
    found, ideal = trial.found, ("pinhole",) if trial.target in _OURS else ("pinhole", "thin")
    easy = [j.choice for j in tried if j.choice.name.startswith(ideal) and not trial.explain]
    # Nothing that is fitted has no error.
    asked = [b for b in trial.budgets_px if (b > 0 or trial.explain) and not any(c.meets(b) for c in easy)]
    if not asked:
        return []
    fit, sizes = shot_fits(found, folder), shot_terms(found)
    known: dict[int, list[_Judged]] = {}
    for k, budget_px in enumerate(asked):
        low, high = 0, len(sizes)  # sizes below `low` do not hold, those from `high` on do
        while low < high:
            errors = {n: j.choice.error_px for n, judged in known.items() for j in judged}
            size = _next_size(sizes, low, high, budget_px, errors)
            if size not in known:
                file, settings = fit(sizes[size])
                made = _model(trial, file, _SHOT)
                known[size] = [replace(j, choice=replace(j.choice, settings=settings)) for j in made]
            holds = any(j.choice.meets(budget_px) for j in known[size])
            low, high = (low, size) if holds else (size + 1, high)
            say((k + 1 - (high - low) / len(sizes)) / len(asked))
    return [j for js in known.values() for j in js]


def _next_size(sizes: Sequence[int], low: int, high: int, budget_px: float, errors: Mapping[int, float]) -> int:
    """The size to try next of those from `low` up to `high`: the least that holds if from what is known beside them
    errors fall with the square of the terms; where nothing is, the one in the middle."""
    ends = [n for n in (low - 1, high) if 0 < budget_px * errors.get(n, 0.0) < math.inf]
    if not ends:
        return (low + high) // 2
    near = min(ends, key=lambda n: abs(math.log(errors[n] / budget_px)))
    wanted = sizes[near] * math.sqrt(errors[near] / budget_px)
    return min(max(int(np.searchsorted(sizes, wanted)), low), high - 1)
