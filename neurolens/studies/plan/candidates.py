"""Cameras that may show a scene, each with its error against the exact lens and, where that matters, its time.

They are a pinhole, a thin and a thick lens, the exact lens, models that ship, and polynomials that are fitted to one
shot of a lens alone: to its film, stop, focus and light.
"""

import math
import warnings
from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal

import numpy as np

from neurolens.base.errors import InputError, ModelError, NeurolensWarning
from neurolens.base.report import BULK
from neurolens.cameras.build import as_c, ideal_as
from neurolens.cameras.contract import Camera
from neurolens.cameras.model import OnnxCamera, OnnxLens, load_model
from neurolens.cameras.reduced import Warped
from neurolens.graph.compiler import has_compiler
from neurolens.graph.scalars import lower
from neurolens.models.export import export_onnx
from neurolens.models.fit import fit_model, prepare
from neurolens.models.pairs import PairSettings, make_pairs
from neurolens.models.polynomial import fit_planes
from neurolens.models.targets import ModelSettings
from neurolens.studies.plan import footprints as prints
from neurolens.studies.plan.costs import noise, ns_a_ray
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
        noise: how many times as many paths as an even camera's its weights need for an equal error, see `costs`; with
            the area of its picture, relative to the one asked for.
        disperses: whether its picture depends on the wavelength.
        how: what else it needs, or how it was made.
        ns: least processor's nanoseconds of one of its rays; inf where it was not timed.
        seconds: on one thread, for the whole picture to the noise of the exact lens, by `ns`; see `plan.priced`.
        form, size: of models, "ols" or another method, and operations of a ray. A larger model is assumed to take no
            less time than a smaller one of its form.
        made: returns the camera whose rays are timed, which may compile it.
    """

    name: str
    camera: str
    error_px: float
    light_error: float
    noise: float
    disperses: bool = False
    how: str = ""
    ns: float = math.inf
    seconds: float = math.inf
    form: str = field(default="", metadata=BULK)
    size: int = field(default=0, metadata=BULK)
    made: Callable[[], Camera] | None = field(default=None, metadata=BULK, repr=False)

    @property
    def short(self) -> str:
        """Its name without that of the lens."""
        return self.name.rpartition(".")[2]

    def meets(self, budget_px: float) -> bool:
        """Return whether it meets a budget of error."""
        return self.error_px <= budget_px and self.light_error <= LIGHT


def candidates(
    probed: Probe, budget_px: float, target: Target, *, models: Sequence[Path] = (), folder: Path | None = None,
    explain: bool = False,
) -> tuple[Choice, ...]:  # fmt: skip
    """Try cameras until a budget can be decided; arguments as for `studies.plan.plan`.

    Nothing is fitted where a pinhole or an ideal lens, which takes less time, meets the budget, unless all are asked
    for. Only cameras that meet it are timed, and of models of one form the smallest and those of about its size.
    """
    with warnings.catch_warnings():  # of a film beyond the end of a model's range, which shows as error
        warnings.simplefilter("ignore", NeurolensWarning)
        ideal = list(_ideal(probed, target))
        tried = [*ideal, *_exact(probed, target), *_shipped(probed, models, target, budget_px, explain)]
        if folder is not None and (explain or not any(c.meets(budget_px) for c in ideal)):
            tried += _fitted(probed, folder, target, budget_px)
        holds = [c for c in tried if c.meets(budget_px)]
        least = {form: min(c.size for c in holds if c.form == form) for form in {c.form for c in holds}}
        asked = [explain or (c in holds and not c.size > _CLOSE * least[c.form] > 0) for c in tried]
        return tuple(timed(c, probed) if now else c for c, now in zip(tried, asked, strict=True))


def timed(choice: Choice, probed: Probe) -> Choice:
    """Return a camera with the time of its rays."""
    assert choice.made is not None
    return replace(choice, ns=ns_a_ray(choice.made(), probed.places))


def judged(
    probed: Probe, name: str, spec: str, camera: Camera, made: Callable[[], Camera] | None = None, *, how: str = "",
    area: float = 1.0, form: str = "", size: int = 0, beside: prints.Array | float = 0.0,
) -> Choice:  # fmt: skip
    """Hold a camera's footprints against the exact ones.

    `area` is that of its picture, relative to the one asked for; `beside` is light outside the lens's pupil.
    """
    wanted, share = probed.seen, probed.places.share
    seen = wanted if camera is probed.exact else prints.footprints(camera, probed.places)
    apart = prints.distance_mm(wanted, seen, share) / probed.asked.pixel_mm
    light = np.abs(seen.light / np.maximum(wanted.light, 1e-30) - 1) + beside
    error, dim = (float(np.percentile(np.where(np.isfinite(v), v, np.inf), COUNTED)) for v in (apart, light))
    paths, disperses = area * noise(seen.weight, share), camera.dispersive
    return Choice(name, spec, error, dim, paths, disperses, how, form=form, size=size, made=made or (lambda: camera))


def _ideal(probed: Probe, target: Target) -> Iterator[Choice]:
    """Yield pinhole, thin and thick lens, as they are and, where that is worth it, with their picture warped later.

    The thick lens is warped in place of the thin one; onnxruntime runs none of them.
    """
    for name in IDEAL if target in OURS else ():
        spec = f"{name}:{probed.lens.path}"
        with suppress(InputError):  # a lens with cylinders has no thick lens; maps lack half a sphere, or a dark film
            camera = as_c(ideal_as(f"{name}:", probed.exact.lens, probed.shot))
            plain = judged(probed, name, spec, camera)
            yield plain
            if name == "thin":
                continue
            maps = Warped(camera, probed.exact, probed.shot.focus_m)
            if maps.area < _MOST_OVERSCAN:
                how = f"its picture, of {maps.area:.3g} times the area, warped by the map of 'neurolens stmap'"
                yield judged(probed, f"{name}{MAPPED}", spec, maps, plain.made, how=how, area=maps.area)


def _exact(probed: Probe, target: Target) -> Iterator[Choice]:
    """Yield the exact lens, which has no error, where the target runs it."""
    if target == "render" or (target == "c" and probed.exact.runtime == "c"):
        yield judged(probed, EXACT, str(probed.lens.path), probed.exact)


def model_judged(
    probed: Probe, file: Path, target: Target, how: str = "", without: Collection[str] = ()
) -> Choice | None:
    """Judge a model in the form that the target runs.

    The result is None where the model's domain is not the shot's, it has no such form, or its form is one of `without`.
    Errors are those of onnxruntime: compilers take seconds, and C gives the same rays. They are measured within the
    outline of the exact lens's pupil, from the same points of it. Each camera's own outline would do less well: rows of
    samples do not reach an outline's rim, so that two outlines of one lens would differ by a percent of light and 0.2%
    of the blur. Light that a model passes outside the exact outline counts as an error of light.
    """
    compiled = target in OURS and has_compiler()
    with suppress(InputError, ModelError):
        model = load_model(file)
        form = model.card["fit"]["method"].partition("-")[0]
        if form in without or (target == "c" and not compiled):
            return None
        camera = OnnxCamera(model, replace(probed.shot, runtime="onnxruntime"), outline=probed.exact.film.outline)
        beside = prints.light_beside(camera, probed.places) / np.maximum(probed.seen.light, 1e-30)
        made = camera.compiled if compiled else None
        size = _operations(model)
        return judged(probed, file.stem, str(file), camera, made, how=how, form=form, size=size, beside=beside)
    return None


def _operations(model: OnnxLens) -> int:
    """Count the float operations of a ray of a model; 0 for networks that only onnxruntime runs."""
    with suppress(InputError):
        return sum(lower(model.graph()).count().values())
    return 0


def _shipped(probed: Probe, files: Sequence[Path], target: Target, budget_px: float, explain: bool) -> list[Choice]:
    """Judge the models that exist: of each form from the smallest up to the first that meets the budget."""
    tried: list[Choice] = []
    for file in sorted(files, key=lambda f: f.stat().st_size if f.is_file() else 0):
        done = {c.form for c in tried if not explain and c.meets(budget_px)}
        if choice := model_judged(probed, file, target, without=done):
            tried.append(choice)
    return tried


TERMS = (4, 6, 8, 12, 16, 22, 28, 36, 48, 64, 90)  # of polynomials that are fitted for a shot
# Gates that alone block a smaller share of the rays are left out: they darken no pixel by a thousandth.
_FIT = ModelSettings("ols", planes=False, elimination=False, idle_gates=5e-4)
# for lenses with cylinders: more candidates take ten times as long, for the same errors
_FIT_MIRROR = replace(_FIT, degree=5)
# With the first number of terms or more, planes are moved, to where a search for the second number finds them.
_MOVED_TERMS = 16, 22
_PAIRS = PairSettings(train=5000, held_out=1000, rim=5000)


def shot_fits(probed: Probe, folder: Path) -> Callable[[int], Path]:
    """Return a function that fits a polynomial of so many terms to one shot alone.

    It returns the model's file, in the folder.
    """
    lens = probed.lens.with_aperture(None)
    moved = plain = prepare(make_pairs(lens, probed.domain, _PAIRS))
    model = _FIT_MIRROR if lens.anamorphic else _FIT
    least, searched = _MOVED_TERMS
    if not lens.anamorphic:
        moved = replace(plain, encoding=fit_planes(plain.pairs, plain.encoding, searched, model.position_weight))
    folder.mkdir(parents=True, exist_ok=True)

    def fit(terms: int) -> Path:
        settings = replace(model, name=f"shot-ols-{terms}", terms=terms)
        file = folder / f"{probed.lens.lens_id}.{settings.label}.onnx"
        export_onnx(fit_model(moved if terms >= least else plain, settings), file, errors={})
        return file

    return fit


def _fitted(probed: Probe, folder: Path, target: Target, budget_px: float) -> Iterator[Choice]:
    """Fit polynomials for the shot alone, from the smallest up to the first that meets the budget.

    Errors do not always fall with the size: a small model may place its film better than a larger one.
    """
    fit = shot_fits(probed, folder)
    for terms in TERMS:
        if choice := model_judged(probed, fit(terms), target, FITTED):
            yield choice
            if choice.meets(budget_px):
                return
