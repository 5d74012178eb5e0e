"""Cameras that may show a scene, each with its error against the exact lens and, where that matters, its cost.

They are pinholes, thin and thick lenses, the exact lens, models that ship, and polynomials that are fitted only to one
shot of a lens: its film, stop, focus and light.
"""

from __future__ import annotations

import bisect
import math
import warnings
from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cache, partial
from pathlib import Path
from typing import Literal

import numpy as np

from neurolens.base.errors import InputError, ModelError, NeurolensWarning
from neurolens.base.lensname import IDEAL_OF, split_kind
from neurolens.base.progress import Report
from neurolens.base.records import Timing, noisy
from neurolens.cameras.build import as_c, ideal_as, with_dispersion
from neurolens.cameras.contract import Camera
from neurolens.cameras.model import OnnxCamera, OnnxLens, load_model
from neurolens.cameras.reduced import Warped
from neurolens.cameras.shaders.blender_shader import lens_of
from neurolens.graph.compiler import has_compiler
from neurolens.graph.scalars import lower
from neurolens.models.export import export_onnx
from neurolens.models.fit import fit_model, prepare
from neurolens.models.pairs import PairSettings, make_pairs
from neurolens.models.polynomial import fit_planes
from neurolens.models.targets import ModelSettings, Prepared
from neurolens.studies.experiment import DomainChoice
from neurolens.studies.plan import footprints as prints
from neurolens.studies.plan.costs import (
    ALONE,
    CYCLES_NS,
    GLSL_OPERATIONS,
    Work,
    glsl_operations,
    noise,
    ns_a_ray,
    shader_cost,
)
from neurolens.studies.plan.footprints import Footprints
from neurolens.studies.plan.probe import COUNTED, LIGHT, Probe

Target = Literal["render", "c", "onnx", "osl", "glsl"]
Cost = Callable[[], tuple[Timing, float]]  # of a ray; with it the noise
EXACT = "exact"
OURS = ("render", "c")  # targets that run compiled C
IDEAL = ("pinhole", "thin", "thick")
_MAPPED = " + ST map"  # follows the name of an ideal camera
FITTED = "fitted for this shot"
_CLOSE = 1.3  # models of one form are timed up to so many times the operations of the smallest that holds
_MOST_OVERSCAN = 4.0  # the most overscan of a plane picture that is warped afterwards


@dataclass(frozen=True)
class Choice:
    """A camera that was tried.

    Attributes:
        camera: the text that `--camera` or `export` takes.
        error_px, light_error: at the counted percentile; inf where it lacks light that the lens has.
        cost: what the camera takes on a path, in the plan's unit, times `noise`; inf where nobody asked for it.
        noise: how many times as many paths it needs for an equal error, see `costs`.
        how: what else it needs, or how it was made.
        within: whether it meets the budget of its plan.
        settings: those of a model that was fitted for the shot.
        spread: the median of its timed calls over the least (1 where cost is counted).
        disperses: whether its picture depends on the wavelength.
        seconds: on one thread, for the whole picture to the noise of the exact lens, by the least of the camera's timed
            calls (10^9 operations where no time is known). `more`: how much longer it is by their median.
        camera_seconds: the camera's share of them.
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
    spread: float = 1.0
    disperses: bool = False
    seconds: float = math.inf
    more: float = 0.0
    camera_seconds: float = 0.0

    @property
    def noisy(self) -> bool:
        """Whether its timing spreads too far to tell it from one that is a little shorter: see `records.noisy`."""
        return noisy({"min": 1.0, "median": self.spread})

    def meets(self, budget_px: float) -> bool:
        """Return whether it meets a budget of error."""
        return self.error_px <= budget_px and self.light_error <= LIGHT

    def whole(self, work: Work, denoised: bool = False) -> float:
        """Return the cost of a path, times the noise of its picture unless that is removed later."""
        return self.cost + work.rest[self.disperses] * (1.0 if denoised else self.noise)


def candidates(
    probed: Probe, budgets_px: Sequence[float], target: Target, *, models: Sequence[Path] = (),
    folder: Path | None = None, explain: bool = False, report: Report | None = None, work: Work = ALONE,
) -> tuple[Choice, ...]:  # fmt: skip
    """Try cameras until each of some budgets can be decided, with error and cost; arguments as for `studies.plan.plan`.

    `work` is that of the target's paths.
    """
    say = report or (lambda done, left=None: None)
    say(0.2)
    trial = Trial(probed, target, tuple(budgets_px), explain, work)
    with warnings.catch_warnings():  # of a film beyond the end of a model's range, which shows as error
        warnings.simplefilter("ignore", NeurolensWarning)
        tried = [*_ideal(trial), *_exact(trial), *_shipped(trial, models)]
        fitted = [] if folder is None else _fitted(trial, folder, tried, lambda done, left=None: say(0.2 + 0.6 * done))
        return tuple(_costed(trial, tried + fitted))


@dataclass(frozen=True)
class _Judged:
    """A camera with its errors, and the function that gives a ray's cost and noise.

    Attributes:
        form: for models, "ols" or another method.
        size: operations of a ray. Where form and size are given, a larger model is assumed to cost no less than a
            smaller one of the same form.
    """

    choice: Choice
    cost: Cost
    form: str = ""
    size: int = 0


@dataclass(frozen=True)
class Trial:
    """What cameras are tried for: scene, target, budgets, whether all need a cost (`explain`), and a path's work."""

    probed: Probe
    target: Target
    budgets_px: tuple[float, ...] = ()
    explain: bool = False
    work: Work = ALONE

    @property
    def share(self) -> prints.Array:
        """The share of the scene's light that each wavelength stands for."""
        return self.probed.places.share

    @property
    def by_size(self) -> bool:
        """Whether costs rise with size; shaders of models have pupils, and so noise, of their own."""
        return self.target != "osl" and not self.explain

    def judged(
        self, name: str, spec: str, seen: Footprints, cost: Cost, how: str = "", form: str = "", size: int = 0,
        beside: prints.Array | float = 0.0, disperses: bool = False,
    ) -> _Judged:  # fmt: skip
        """A camera's error against the exact footprints, without its cost; `beside` is light outside the lens's."""
        probed = self.probed
        apart = prints.distance_mm(probed.wanted, seen, self.share) / probed.asked.pixel_mm
        light = np.abs(seen.light / np.maximum(probed.wanted.light, 1e-30) - 1) + beside
        if "distortion" in probed.asked.afterwards:  # its map corrects light, too
            light = np.where(seen.light > 0, 0.0, light)
        error, dim = (float(np.percentile(np.where(np.isfinite(v), v, np.inf), COUNTED)) for v in (apart, light))
        times = noise(seen.weight, self.share) * self.work.noise[disperses]
        choice = Choice(name, spec, error, dim, math.inf, times, how, disperses=disperses)
        return _Judged(choice, cost, form, size)

    def costed(self, judged: _Judged) -> Choice:
        """Return a camera with its cost."""
        choice, (timing, weights) = judged.choice, judged.cost()
        times = weights * self.work.noise[choice.disperses]
        return replace(
            choice,
            cost=timing["min"] * (1.0 if self.probed.asked.denoised else times),
            noise=times,
            spread=timing["median"] / timing["min"] if timing["min"] else 1.0,
            # A shader that cannot focus so near shows nothing.
            error_px=choice.error_px if math.isfinite(times) else math.inf,
        )

    def timed(self, camera: Camera, seen: Footprints) -> tuple[Timing, float]:
        """Return the cost of a ray of a camera that runs here, by the clock, and the noise of its weights."""
        return ns_a_ray(camera, self.probed.places), noise(seen.weight, self.share)

    def counted(self, cost: float, seen: Footprints) -> tuple[Timing, float]:
        """Return a cost that is counted, and so has no spread."""
        return {"min": cost, "median": cost}, noise(seen.weight, self.share)

    def ideal(self, name: str, camera: Camera, seen: Footprints, area: float = 1.0) -> tuple[Timing, float]:
        """Return the cost of a camera without a lens, and its noise times `area`: a larger picture has more paths."""
        known = {"osl": CYCLES_NS, "glsl": GLSL_OPERATIONS}.get(self.target)
        timing, times = self.timed(camera, seen) if known is None else self.counted(known[name], seen)
        return timing, area * times

    def shader(self, file: str | Path) -> tuple[Timing, float]:
        """Return the cost of the shader of a model or a lens."""
        asked = self.probed.asked
        state = asked.zoom if str(file) == self.probed.lens.path else None  # a model has one state
        lens = lens_of(Path(file), state, lambda done, left=None: None)[1]
        ns, times = shader_cost(lens, self.probed.places, asked.shot.film_mm, asked.f_number, asked.shot.focus_m)
        return {"min": ns, "median": ns}, times


def camera_of(probed: Probe, choice: Choice) -> Camera:
    """Return the camera of a choice in our renderer, with the maps of its picture where it needs them.

    Raises:
        InputError, ModelError: as the camera's own class.
    """
    kind, path = split_kind(choice.camera)
    if choice.name == EXACT:
        return with_dispersion(probed.exact, probed.asked.shot)
    if kind in IDEAL_OF:
        flat = as_c(ideal_as(kind, probed.exact.lens, probed.asked.shot))
        mapped = choice.name.endswith(_MAPPED)
        return Warped(flat, probed.exact, probed.asked.shot.focus_m, tables=probed.exact_field) if mapped else flat
    model = OnnxCamera(load_model(path), probed.asked.shot)
    return with_dispersion(model, probed.asked.shot)


def _ideal(trial: Trial) -> Iterator[_Judged]:
    """Yield pinhole, thin and thick lens, as they are and, where the target has that, with their picture warped later.

    In C and GLSL they are their own source.
    """
    probed, shot = trial.probed, trial.probed.asked.shot
    for name in {"onnx": (), "osl": IDEAL[:2]}.get(trial.target, IDEAL):
        spec = f"{name}:{probed.lens.path}"
        with suppress(InputError):  # a lens with cylinders has no thick lens; maps lack half a sphere, or a dark film
            camera = as_c(ideal_as(f"{name}:", probed.exact.lens, shot))
            seen = prints.footprints(camera, probed.places)
            yield trial.judged(name, spec, seen, partial(trial.ideal, name, camera, seen))
            # In our renderer the thick lens takes the place of the thin one.
            if "distortion" in probed.asked.afterwards or (name == "thin" and trial.target in OURS):
                continue
            maps = Warped(camera, probed.exact, probed.asked.shot.focus_m)
            if maps.area < _MOST_OVERSCAN:
                how = f"then the ST map of 'neurolens stmap' over the picture, of {maps.area:.3g} times the area"
                cost = partial(trial.ideal, name, camera, seen, maps.area)
                yield trial.judged(f"{name}{_MAPPED}", spec, prints.footprints(maps, probed.places), cost, how)


def _exact(trial: Trial) -> Iterator[_Judged]:
    """Yield the exact lens, which has no error with all of its dispersion.

    It is taken as C where that runs, and as code where its surfaces have a form in that.
    """
    probed, target = trial.probed, trial.target
    shown = with_dispersion(probed.exact, probed.asked.shot)
    seen = probed.seen if shown is probed.exact else prints.footprints(shown, probed.places)
    exact, path, compiled = probed.exact, probed.lens.path, probed.exact.runtime == "c"
    cost: Cost = {
        "osl": lambda: trial.shader(path),
        "glsl": lambda: trial.counted(glsl_operations(exact), probed.seen),
    }.get(target, lambda: trial.timed(shown, seen))
    if target in ("render", "osl", "glsl") or (target == "c" and compiled):
        with suppress(InputError):  # the shader may be too large
            yield trial.judged(EXACT, str(path), seen, cost, disperses=shown.dispersive)


def _model(trial: Trial, file: Path, how: str = "", without: Collection[str] = ()) -> Iterator[_Judged]:
    """Yield a model in the form that the target runs.

    There is none where its domain is not the shot's, it has no such form, or its form is one of `without`. Errors are
    those of onnxruntime: compilers take seconds, and C and shaders give the same rays. They are measured within the
    outline of the exact lens's pupil, from the same points of it. Each camera's own outline would do less well: rows of
    samples do not reach an outline's rim, so that two outlines of one lens would differ by a percent of light and 0.2%
    of the blur. Light that a model passes outside the exact outline counts as an error of light.
    """
    target = trial.target
    compiled = target in OURS and has_compiler()
    with suppress(InputError, ModelError):
        model = load_model(file)
        form = model.card["fit"]["method"].partition("-")[0]
        if form in without or not (compiled or target != "c"):
            return
        shot = trial.probed.asked.shot
        whole = OnnxCamera(model, replace(shot, runtime="onnxruntime"), outline=trial.probed.exact.film.outline)
        camera = with_dispersion(whole, shot)
        seen = prints.footprints(camera, trial.probed.places)
        beside = prints.light_beside(camera, trial.probed.places) / np.maximum(trial.probed.seen.light, 1e-30)

        def cost() -> tuple[Timing, float]:
            if target == "osl":
                return trial.shader(file)
            if target == "glsl":
                return trial.counted(glsl_operations(whole), seen)
            return trial.timed(with_dispersion(whole.compiled(), shot) if compiled else camera, seen)

        size = _operations(model)
        yield trial.judged(file.stem, str(file), seen, cost, how, form, size, beside, camera.dispersive)


def _operations(model: OnnxLens) -> int:
    """Count the float operations of a ray of a model; 0 for networks that only onnxruntime runs."""
    with suppress(InputError):
        return sum(lower(model.graph()).count().values())
    return 0


def _shipped(trial: Trial, files: Sequence[Path]) -> list[_Judged]:
    """Judge the models that exist: of each form from the smallest up to the first that meets the smallest budget."""
    judged: list[_Judged] = []
    for file in sorted(files, key=lambda f: f.stat().st_size if f.is_file() else 0):
        done = {j.form for j in judged if trial.by_size and j.choice.meets(min(trial.budgets_px))}
        judged += _model(trial, file, without=done)
    return judged


def _costed(trial: Trial, tried: Sequence[_Judged]) -> Iterator[Choice]:
    """Yield cameras with their cost where it matters.

    It matters for those that meet a budget; of models of one form, for the smallest and those of about its size.
    """
    asked = {id(j) for j in tried} if trial.explain else set[int]()
    for budget_px in trial.budgets_px:
        holds = [j for j in tried if j.choice.meets(budget_px)]
        for j in holds:
            least = min(k.size for k in holds if k.form == j.form)
            if not (trial.by_size and j.size > _CLOSE * least > 0):
                asked.add(id(j))
    for j in tried:
        yield trial.costed(j) if id(j) in asked else j.choice


TERMS = (2, 4, 6, 8, 12, 16, 22, 28, 36, 48, 64, 90)  # of polynomials that are fitted for a shot
# Gates that alone block a smaller share of the rays are left out: they darken no pixel by a thousandth.
_FIT = ModelSettings("ols", planes=False, elimination=False, idle_gates=5e-4)
# for lenses with cylinders: more candidates take ten times as long, for the same errors
_FIT_MIRROR = replace(_FIT, degree=5)
_MOVED_TERMS = 16, 22  # with the first number of terms or more, planes are searched: once, for the second number
PAIRS = PairSettings(train=5000, held_out=1000, rim=5000)


def shot_domain(probed: Probe) -> DomainChoice:
    """Return the domain of a probe as an experiment states it."""
    return DomainChoice(probed.domain.film_radius_mm, probed.domain.focus_m, probed.asked.shot.wavelength_nm)


def shot_terms(probed: Probe) -> list[int]:
    """Return the sizes of polynomials that are tried for a shot; with cylinders they count terms of x and of y."""
    return [n for n in TERMS if n >= (4 if probed.lens.anamorphic else 2)]


def shot_fits(probed: Probe, folder: Path) -> Callable[[int], tuple[Path, ModelSettings]]:
    """Return a function that fits a polynomial of so many terms to one shot alone.

    It returns the model's file, in the folder, and its settings.
    """
    lens = probed.lens.with_aperture(None)
    plain, model = prepare(make_pairs(lens, probed.domain, PAIRS)), _FIT_MIRROR if lens.anamorphic else _FIT
    folder.mkdir(parents=True, exist_ok=True)

    @cache
    def moved() -> Prepared:  # planes for one size: a search takes a second, and other sizes agree on them
        return replace(plain, encoding=fit_planes(plain.pairs, plain.encoding, _MOVED_TERMS[1], model.position_weight))

    def fit(terms: int) -> tuple[Path, ModelSettings]:
        settings = replace(model, name=f"shot-ols-{terms}", terms=terms)
        file = folder / f"{probed.lens.lens_id}.{settings.label}.onnx"
        planes = terms >= _MOVED_TERMS[0] and not lens.anamorphic
        export_onnx(fit_model(moved() if planes else plain, settings), file, errors={})
        return file, replace(settings, planes=planes)  # as settings from which a training finds the same

    return fit


def _fitted(trial: Trial, folder: Path, tried: Sequence[_Judged], say: Report) -> list[_Judged]:
    """Fit polynomials for the shot alone: the smallest that meets each budget, and those tried on the way to it.

    Nothing is fitted where a pinhole or an ideal lens, which costs less, meets a budget, unless all are asked for.
    """
    probed = trial.probed
    easy = [j.choice for j in tried if j.choice.name.startswith(IDEAL) and not trial.explain]
    # No fitted model has an error of 0.
    asked = [b for b in trial.budgets_px if (b > 0 or trial.explain) and not any(c.meets(b) for c in easy)]
    if not asked:
        return []
    fit, sizes = shot_fits(probed, folder), shot_terms(probed)

    found: dict[int, list[_Judged]] = {}
    for k, budget_px in enumerate(asked):

        def holds(terms: int, budget_px: float = budget_px) -> bool:
            if terms not in found:
                file, settings = fit(terms)
                made = _model(trial, file, FITTED)
                found[terms] = [replace(j, choice=replace(j.choice, settings=settings)) for j in made]
            return any(j.choice.meets(budget_px) for j in found[terms])

        bisect.bisect_left(sizes, True, key=holds)
        say((k + 1) / len(asked))
    return [j for js in found.values() for j in js]
