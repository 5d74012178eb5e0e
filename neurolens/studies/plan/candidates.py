"""Cameras that may show a scene, each with its error against the exact lens and, where that matters, its time.

They are a pinhole, a thin and a thick lens, the exact lens, models that ship, and polynomials that are fitted to one
shot of a lens alone: to its film, stop, focus and light.
"""

from __future__ import annotations

import bisect
import math
import warnings
from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import cache, partial
from pathlib import Path
from typing import Literal

import numpy as np

from neurolens.base.errors import InputError, ModelError, NeurolensWarning
from neurolens.base.progress import Report
from neurolens.base.records import noisy
from neurolens.base.report import OPTIONAL
from neurolens.cameras.build import as_c, ideal_as, with_dispersion
from neurolens.cameras.contract import Camera
from neurolens.cameras.model import OnnxCamera, OnnxLens, load_model
from neurolens.cameras.reduced import Warped
from neurolens.graph.compiler import has_compiler
from neurolens.graph.scalars import lower
from neurolens.models.export import export_onnx
from neurolens.models.fit import fit_model, prepare
from neurolens.models.pairs import PairSettings, make_pairs
from neurolens.models.polynomial import fit_planes
from neurolens.models.targets import ModelSettings, Prepared
from neurolens.studies.experiment import DomainChoice
from neurolens.studies.plan import footprints as prints
from neurolens.studies.plan.costs import ALONE, Work, noise, ns_a_ray
from neurolens.studies.plan.footprints import Footprints
from neurolens.studies.plan.probe import COUNTED, LIGHT, Probe

Target = Literal["render", "c", "onnx"]
EXACT = "exact"
OURS = ("render", "c")  # targets that run compiled C
IDEAL = ("pinhole", "thin", "thick")
MAPPED = " + ST map"  # follows the name of an ideal camera whose picture is warped afterwards
FITTED = "fitted for this shot"
_CLOSE = 1.3  # models of one form are timed up to so many times the operations of the smallest that holds
_MOST_OVERSCAN = 4.0  # times the area of the picture, of a plane picture that is warped afterwards


@dataclass(frozen=True)
class Choice:
    """A camera that was tried.

    Attributes:
        camera: the text that `--camera` or `export` takes.
        error_px, light_error: at the counted percentile; inf where it lacks light that the lens has.
        noise: how many times as many paths it needs for an equal error, see `costs`.
        disperses: whether its picture depends on the wavelength.
        how: what else it needs, or how it was made.
        settings: those of a model that was fitted for the shot.
        ns: least processor's nanoseconds of one of its rays; inf where it was not timed.
        spread: the median of its timed calls over the least.
        seconds: on one thread, for the whole picture to the noise of the exact lens, by `ns`; see `plan.priced`.
        camera_seconds: the camera's share of them.
    """

    name: str
    camera: str
    error_px: float
    light_error: float
    noise: float
    disperses: bool = False
    how: str = ""
    settings: ModelSettings | None = field(default=None, metadata=OPTIONAL)
    ns: float = math.inf
    spread: float = 1.0
    seconds: float = math.inf
    camera_seconds: float = math.inf

    @property
    def short(self) -> str:
        """Its name without that of the lens."""
        return self.name.rpartition(".")[2]

    @property
    def noisy(self) -> bool:
        """Whether its timing spreads too far to tell it from one that is a little shorter: see `records.noisy`."""
        return noisy({"min": 1.0, "median": self.spread})

    def meets(self, budget_px: float) -> bool:
        """Return whether it meets a budget of error."""
        return self.error_px <= budget_px and self.light_error <= LIGHT


def candidates(
    probed: Probe, budgets_px: Sequence[float], target: Target, *, models: Sequence[Path] = (),
    folder: Path | None = None, explain: bool = False, report: Report | None = None, work: Work = ALONE,
) -> tuple[Choice, ...]:  # fmt: skip
    """Try cameras until each of some budgets can be decided; arguments as for `studies.plan.plan`.

    `work` is that of the target's paths.
    """
    say = report or (lambda done, left=None: None)
    say(0.2)
    trial = Trial(probed, target, tuple(budgets_px), explain, work)
    with warnings.catch_warnings():  # of a film beyond the end of a model's range, which shows as error
        warnings.simplefilter("ignore", NeurolensWarning)
        tried = [*_ideal(trial), *_exact(trial), *_shipped(trial, models)]
        if folder is not None:
            tried += _fitted(trial, folder, tried, lambda done, left=None: say(0.2 + 0.6 * done))
        return tuple(_timed(trial, tried))


@dataclass(frozen=True)
class Judged:
    """A camera with its errors, and the function that makes the camera whose rays are timed, which may compile it.

    Attributes:
        form: of models, "ols" or another method.
        size: operations of a ray. Where form and size are given, a larger model is assumed to take no less time than a
            smaller one of the same form.
    """

    choice: Choice
    made: Callable[[], Camera]
    form: str = ""
    size: int = 0


@dataclass(frozen=True)
class Trial:
    """What cameras are tried for: scene, target, budgets, whether all are timed (`explain`), and a path's work."""

    probed: Probe
    target: Target
    budgets_px: tuple[float, ...] = ()
    explain: bool = False
    work: Work = ALONE

    def judged(
        self, name: str, spec: str, seen: Footprints, made: Callable[[], Camera], *, how: str = "", area: float = 1.0,
        disperses: bool = False, form: str = "", size: int = 0, beside: prints.Array | float = 0.0,
    ) -> Judged:  # fmt: skip
        """Hold a camera's footprints against the exact ones.

        `area` is that of its picture, relative to the one asked for; `beside` is light outside the lens's pupil.
        """
        probed, share = self.probed, self.probed.places.share
        apart = prints.distance_mm(probed.wanted, seen, share) / probed.asked.pixel_mm
        light = np.abs(seen.light / np.maximum(probed.wanted.light, 1e-30) - 1) + beside
        if "distortion" in probed.asked.afterwards:  # its map corrects light, too
            light = np.where(seen.light > 0, 0.0, light)
        error, dim = (float(np.percentile(np.where(np.isfinite(v), v, np.inf), COUNTED)) for v in (apart, light))
        times = area * noise(seen.weight, share) * self.work.noise[disperses]
        return Judged(Choice(name, spec, error, dim, times, disperses, how), made, form, size)

    def timed(self, judged: Judged) -> Choice:
        """Return a camera with the time of its rays."""
        timing = ns_a_ray(judged.made(), self.probed.places)
        spread = timing["median"] / timing["min"] if timing["min"] else 1.0
        return replace(judged.choice, ns=timing["min"], spread=spread)


def _ideal(trial: Trial) -> Iterator[Judged]:
    """Yield pinhole, thin and thick lens, as they are and, where the target has that, with their picture warped later.

    In our renderer and in C the thick lens takes the place of the thin one; onnxruntime runs none of them.
    """
    probed = trial.probed
    for name in IDEAL if trial.target in OURS else ():
        spec = f"{name}:{probed.lens.path}"
        with suppress(InputError):  # a lens with cylinders has no thick lens; maps lack half a sphere, or a dark film
            camera = as_c(ideal_as(f"{name}:", probed.exact.lens, probed.shot))
            made = lambda camera=camera: camera  # noqa: E731
            yield trial.judged(name, spec, prints.footprints(camera, probed.places), made)
            if name == "thin" or "distortion" in probed.asked.afterwards:
                continue
            maps = Warped(camera, probed.exact, probed.shot.focus_m)
            if maps.area < _MOST_OVERSCAN:
                how = f"then the ST map of 'neurolens stmap' over the picture, of {maps.area:.3g} times the area"
                seen = prints.footprints(maps, probed.places)
                yield trial.judged(f"{name}{MAPPED}", spec, seen, made, how=how, area=maps.area)


def _exact(trial: Trial) -> Iterator[Judged]:
    """Yield the exact lens, which has no error with all of its dispersion, where the target runs it."""
    probed, target = trial.probed, trial.target
    if target == "render" or (target == "c" and probed.exact.runtime == "c"):
        shown = with_dispersion(probed.exact, probed.shot)
        seen = probed.seen if shown is probed.exact else prints.footprints(shown, probed.places)
        yield trial.judged(EXACT, str(probed.lens.path), seen, lambda: shown, disperses=shown.dispersive)


def model_judged(trial: Trial, file: Path, how: str = "", without: Collection[str] = ()) -> Judged | None:
    """Judge a model in the form that the target runs.

    The result is None where the model's domain is not the shot's, it has no such form, or its form is one of `without`.
    Errors are those of onnxruntime: compilers take seconds, and C gives the same rays. They are measured within the
    outline of the exact lens's pupil, from the same points of it. Each camera's own outline would do less well: rows of
    samples do not reach an outline's rim, so that two outlines of one lens would differ by a percent of light and 0.2%
    of the blur. Light that a model passes outside the exact outline counts as an error of light.
    """
    compiled = trial.target in OURS and has_compiler()
    with suppress(InputError, ModelError):
        model, probed = load_model(file), trial.probed
        form = model.card["fit"]["method"].partition("-")[0]
        if form in without or (trial.target == "c" and not compiled):
            return None
        whole = OnnxCamera(model, replace(probed.shot, runtime="onnxruntime"), outline=probed.exact.film.outline)
        camera = with_dispersion(whole, probed.shot)
        beside = prints.light_beside(camera, probed.places) / np.maximum(probed.seen.light, 1e-30)
        return trial.judged(
            file.stem, str(file), prints.footprints(camera, probed.places),
            lambda: with_dispersion(whole.compiled(), probed.shot) if compiled else camera,
            how=how, disperses=camera.dispersive, form=form, size=_operations(model), beside=beside,
        )  # fmt: skip
    return None


def _operations(model: OnnxLens) -> int:
    """Count the float operations of a ray of a model; 0 for networks that only onnxruntime runs."""
    with suppress(InputError):
        return sum(lower(model.graph()).count().values())
    return 0


def _shipped(trial: Trial, files: Sequence[Path]) -> list[Judged]:
    """Judge the models that exist: of each form from the smallest up to the first that meets the smallest budget."""
    tried: list[Judged] = []
    for file in sorted(files, key=lambda f: f.stat().st_size if f.is_file() else 0):
        done = {j.form for j in tried if not trial.explain and j.choice.meets(min(trial.budgets_px))}
        if judged := model_judged(trial, file, without=done):
            tried.append(judged)
    return tried


def _timed(trial: Trial, tried: Sequence[Judged]) -> Iterator[Choice]:
    """Yield cameras with their time where it matters.

    It matters for those that meet a budget; of models of one form, for the smallest and those of about its size.
    """
    asked = {id(j) for j in tried if trial.explain}
    for budget_px in () if trial.explain else trial.budgets_px:
        holds = [j for j in tried if j.choice.meets(budget_px)]
        least = {form: min(j.size for j in holds if j.form == form) for form in {j.form for j in holds}}
        asked |= {id(j) for j in holds if not j.size > _CLOSE * least[j.form] > 0}
    for j in tried:
        yield trial.timed(j) if id(j) in asked else j.choice


TERMS = (2, 4, 6, 8, 12, 16, 22, 28, 36, 48, 64, 90)  # of polynomials that are fitted for a shot
# Gates that alone block a smaller share of the rays are left out: they darken no pixel by a thousandth.
_FIT = ModelSettings("ols", planes=False, elimination=False, idle_gates=5e-4)
# for lenses with cylinders: more candidates take ten times as long, for the same errors
_FIT_MIRROR = replace(_FIT, degree=5)
_MOVED_TERMS = 16, 22  # with the first number of terms or more, planes are searched: once, for the second number
PAIRS = PairSettings(train=5000, held_out=1000, rim=5000)


def shot_domain(probed: Probe) -> DomainChoice:
    """Return the domain of a probe as an experiment states it."""
    return DomainChoice(probed.domain.film_radius_mm, probed.domain.focus_m, probed.shot.wavelength_nm)


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


def _fitted(trial: Trial, folder: Path, tried: Sequence[Judged], say: Report) -> list[Judged]:
    """Fit polynomials for the shot alone: the smallest that meets each budget, and those tried on the way to it.

    Nothing is fitted where a pinhole or an ideal lens, which takes less time, meets a budget, unless all are asked for.
    """
    easy = [j.choice for j in tried if j.choice.name.startswith(IDEAL) and not trial.explain]
    # No fitted model has an error of 0.
    asked = [b for b in trial.budgets_px if (b > 0 or trial.explain) and not any(c.meets(b) for c in easy)]
    if not asked:
        return []
    fit, sizes = shot_fits(trial.probed, folder), shot_terms(trial.probed)

    found: dict[int, Judged | None] = {}

    def holds(budget_px: float, terms: int) -> bool:
        if terms not in found:
            file, settings = fit(terms)
            judged = model_judged(trial, file, FITTED)
            found[terms] = judged and replace(judged, choice=replace(judged.choice, settings=settings))
        judged = found[terms]
        return judged is not None and judged.choice.meets(budget_px)

    for k, budget_px in enumerate(asked):
        bisect.bisect_left(sizes, True, key=partial(holds, budget_px))
        say((k + 1) / len(asked))
    return [judged for judged in found.values() if judged]
