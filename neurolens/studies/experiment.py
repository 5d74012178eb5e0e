"""The settings of an experiment: one TOML file per run, read by `base.settings`."""

import math
import os
import re
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, ClassVar, Literal

from neurolens.base.errors import InputError, NeurolensWarning
from neurolens.base.files import atomic_write_text
from neurolens.base.lensname import lens_id_of
from neurolens.base.progress import Report
from neurolens.base.settings import EYE_NM, RANGE, apply_overrides, from_dict, read_config, to_dict, to_toml
from neurolens.models.fit import ModelSettings, StateSpace, axes_of
from neurolens.models.fitted import Domain
from neurolens.models.pairs import PairSettings, domain_of
from neurolens.optics.lens.glass import glass_of
from neurolens.optics.lens.paraxial import first_order
from neurolens.optics.lens.prescription import Lens
from neurolens.optics.readers.any_format import OURS, kind_of, read_any
from neurolens.optics.readers.lensfile import write_lens
from neurolens.optics.setting.focusing import near_limit_m
from neurolens.optics.setting.states import set_lens
from neurolens.studies.rays import PIXELS_ACROSS, frame_width_mm

# Near limit where none is stated: 14 focal lengths from the film (0.7 m for a 50 mm lens); for a long lens of short
# focus, which has less room, the object 8 focal lengths before the front vertex.
# A film that is dark beyond this share of its radius counts as stated too large.
DARK_FROM = 0.9

_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]*")


def check_names(field: str, names: Sequence[str]) -> None:
    """Refuse, by an InputError, names that are not valid in file names."""
    for name in names:
        if not _NAME.fullmatch(name):
            expected = "a name of letters, digits, '.', '_' and '-', a letter or digit first"
            raise InputError("settings", field, name, expected)


@dataclass(frozen=True)
class LensChoice:
    """Which lens, and how it is set: scaled to a focal length, at a zoom state of its file, stopped down.

    Attributes:
        zoom: a state of the file by name, or a focal length in mm between its states; "range" asks for one model of all
            zoom positions between the file's states.
        focus_mode: "internal" asks for one model of internal focus from infinity to the near limit.
    """

    file: Path
    focal_length_mm: float | None = field(default=None, metadata={"was": ("efl_mm",)})
    zoom: str | float | None = field(default=None, metadata={"was": ("configuration",)})
    f_number: float | None = None
    focus_mode: Literal["film", "internal"] = field(default="film", metadata={"was": ("focusing",)})

    @property
    def many_states(self) -> bool:
        """Whether models are of many states of the lens."""
        return self.zoom == RANGE or self.focus_mode == "internal"

    @property
    def state(self) -> str | float | None:
        """Return the one zoom state of the models; None for the table's, and where models are of all states."""
        return None if self.zoom == RANGE else self.zoom

    def read(self) -> Lens:
        """Return the lens at infinity focus with a round stop; cameras apply blades outside the models.

        Raises:
            InputError: a length or f-number is not positive; as `read_any` and `set_lens`.
        """
        for name, value in (("lens.focal_length_mm", self.focal_length_mm), ("lens.f_number", self.f_number)):
            if value is not None and not value > 0:
                raise InputError("settings", name, value, "a positive number")
        lens = read_any(self.file).with_aperture(None)
        return set_lens(lens, focal_length_mm=self.focal_length_mm, zoom=self.state, f_number=self.f_number)


@dataclass(frozen=True)
class DomainChoice:
    """The domain of the models.

    Attributes:
        film_radius_mm: None takes the lit film.
        focus_m: two object distances from the film; every film position between theirs is in the domain. None takes
            infinity and `near_limit_m`.
        wavelength_nm: shortest and longest; None takes `wavelengths_nm`.
    """

    film_radius_mm: float | None = None
    focus_m: tuple[float, float] | None = None
    wavelength_nm: tuple[float, float] | None = None

    def of(self, lens: Lens) -> Domain:
        """Return the domain of a lens, with defaults from the lens.

        Raises:
            InputError: as `domain_of`; the lens's image is virtual, so that no film can lie there.

        Warns:
            NeurolensWarning: the outer part of the film is dark; a default film then ends there.
        """
        behind = first_order(lens).rear_focal_z_mm
        if not behind > lens.vertices_mm[len(lens.surfaces) - 1]:
            expected = "a lens whose focus at infinity lies behind its last surface"
            raise InputError(lens.path, "surfaces", f"(focus at z = {behind:.4g} mm)", expected)
        focus_m = self.focus_m or (math.inf, near_limit_m(lens))
        wavelengths = self.wavelength_nm or wavelengths_nm(lens)
        domain = domain_of(lens, film_radius_mm=self.film_radius_mm, focus_m=focus_m, wavelength_nm=wavelengths)
        lit_mm, film_mm, asked = domain.bounds.lit_radius_mm, domain.film_radius_mm, self.film_radius_mm is not None
        if lit_mm > DARK_FROM * film_mm:
            return domain
        text = f"{lens.path}: the film, {film_mm:.4g} mm in radius, is dark beyond {lit_mm:.4g} mm"
        warnings.warn(text if asked else f"{text}: models are of what is lit", NeurolensWarning, stacklevel=2)
        return domain if asked else domain_of(lens, film_radius_mm=lit_mm, focus_m=focus_m, wavelength_nm=wavelengths)


def wavelengths_nm(lens: Lens) -> tuple[float, float]:
    """Return `EYE_NM`, or the part for which all catalogue glasses of the lens are stated (at least 400-700 nm)."""
    low, high = EYE_NM
    for surface in lens.surfaces:
        if surface.glass is not None:
            shortest, longest = (1000 * v for v in glass_of(surface.glass).range_um)
            low, high = max(low, min(shortest, 400.0)), min(high, max(longest, 700.0))
    return low, high


@dataclass(frozen=True)
class TargetChoice:
    """The error wanted: models are fitted in turn until one keeps it (film-equivalent RMS on held-out rays).

    Attributes:
        um, px: the error in micrometres, or in pixels of a picture `pixels_across` wide on the 3:2 frame inscribed in
            the film circle of the models' domain (36 mm for a radius of 21.6 mm). One of the two is given.
    """

    um: float | None = None
    px: float | None = None
    pixels_across: int = PIXELS_ACROSS

    def __post_init__(self) -> None:
        for name, value in (("um", self.um), ("px", self.px), ("pixels_across", self.pixels_across)):
            if value is not None and not 0 < value < math.inf:
                raise InputError("settings", f"target.{name}", value, "a number above 0")
        if (self.um is None) == (self.px is None):
            raise InputError("settings", "target", "(both or neither)", "um or px")

    def within_um(self, film_radius_mm: float) -> float:
        """Return the error in micrometres on a film of this radius."""
        pitch_um = 1000 * frame_width_mm(film_radius_mm) / self.pixels_across
        return self.um if self.um is not None else (self.px or 0.0) * pitch_um


@dataclass(frozen=True)
class EvaluationChoice:
    """How models are measured: rays for false passes and blocks, and rounds of the race for speed, on one thread.

    With 0 rounds there is no race.
    """

    WITHOUT_EFFECT: ClassVar = ("compile_exact",)
    vignetting_rays: int = 200_000
    rounds: int = 15


@dataclass(frozen=True)
class RenderChoice:
    """The scenes to render through every camera.

    Attributes:
        scenes: scene files.
        models: names of the models that render; if empty, the best polynomial and the best network.
        width, height, samples: of each picture, whose shape must be that of the scenes' film.
        seeds: renders of each camera, at least 4, so that errors have a noise floor. Pictures are their mean.
        fused: whether lens and models run as C where a compiler is there. Pictures are the same, several times sooner.
        threads: workers.
    """

    scenes: tuple[Path, ...] = ()
    models: tuple[str, ...] = ()
    width: int = 320
    height: int = 180
    samples: int = 16
    seeds: int = 4
    fused: bool = True
    threads: int = 2

    def __post_init__(self) -> None:
        if self.seeds < 4:
            raise InputError("settings", "seeds", self.seeds, "at least 4 renders, for the noise floor")


@dataclass
class Pictures:
    """What a run has of its pictures, as records for `results.json`; `settings` are those of their errors."""

    images: list[dict[str, Any]] = field(default_factory=list)
    cameras: list[dict[str, Any]] = field(default_factory=list)
    figures: list[dict[str, Any]] = field(default_factory=list)
    settings: Mapping[str, float] | None = None


# Reads the scenes of a choice for a lens and a domain, and returns what renders them through models, by name, to a
# folder: `scenes.renders`. A run is handed it, so that training loads no renderer.
Renders = Callable[[RenderChoice, Lens, Domain], Callable[[Mapping[str, Path], Path, Report], Pictures]]


@dataclass(frozen=True)
class Experiment:
    """One resolved run: lens, domain, ray pairs, models, measurements and renders.

    Models are fitted in order; with a `target` only until one has its error.
    """

    WITHOUT_EFFECT: ClassVar = ("save_pairs",)
    title: str
    lens: LensChoice
    model: tuple[ModelSettings, ...]
    domain: DomainChoice = field(default_factory=DomainChoice)
    pairs: PairSettings = field(default_factory=PairSettings)
    evaluation: EvaluationChoice = field(default_factory=EvaluationChoice)
    render: RenderChoice = field(default_factory=RenderChoice)
    target: TargetChoice | None = None

    def __post_init__(self) -> None:
        labels = [m.label for m in self.model]
        check_names("model", labels)
        twice = sorted({n for n in labels if labels.count(n) > 1})
        if not labels or twice:
            raise InputError("settings", "model", labels, "at least one [[model]], and names that differ")
        unknown = [n for n in self.render.models if n not in labels]
        if unknown:
            raise InputError("settings", "render.models", unknown, f"names of models: {', '.join(labels)}")

    def states(self) -> StateSpace:
        """Return the state space of the models, if the lens has many states.

        Raises:
            InputError: the lens is rescaled, or the file lacks the states.
        """
        chosen, domain = self.lens, self.domain
        if chosen.focal_length_mm is not None:
            expected = "left out: many states are of the tabled size"
            raise InputError("settings", "lens.focal_length_mm", chosen.focal_length_mm, expected)
        lens = read_any(chosen.file).with_aperture(None)
        internal = chosen.focus_mode == "internal"
        return StateSpace(
            lens,
            axes_of(lens, zoom=chosen.zoom == RANGE, internal=internal, state=chosen.state),
            zoom=chosen.state,
            f_number=chosen.f_number,
            film_radius_mm=domain.film_radius_mm,
            focus_m=domain.focus_m or (lambda state: (math.inf, near_limit_m(state))),
            wavelength_nm=domain.wavelength_nm or wavelengths_nm(lens),
        )


def read_experiment(path: str | Path, overrides: Sequence[str] = ()) -> Experiment:
    """Read an experiment; files that it names lie relative to its own file.

    Raises:
        InputError: a mistake; names file, key, value and what was expected.
    """
    folder = Path(path).parent
    return _with_files(read_config(Experiment, path, overrides), lambda file: folder / file)


def _with_files(experiment: Experiment, moved: Callable[[Path], Path]) -> Experiment:
    return replace(
        experiment,
        lens=replace(experiment.lens, file=moved(experiment.lens.file)),
        render=replace(experiment.render, scenes=tuple(moved(s) for s in experiment.render.scenes)),
    )


def keep_inputs(experiment: Experiment, folder: Path) -> dict[str, Any]:
    """Write config.toml, and the lens in our format to lenses/ of a run folder, where `check.find_lens` looks.

    Returns the resolved settings, with files named relative to the folder.
    """

    def moved(path: Path) -> Path:
        place = path.parent.resolve() / path.name
        try:
            return Path(os.path.relpath(place, folder.resolve()))
        except ValueError:  # another drive
            return place

    resolved = _with_files(experiment, moved)
    atomic_write_text(folder / "config.toml", to_toml(resolved))
    source = experiment.lens.file
    kept = folder / "lenses" / f"{lens_id_of(source)}.toml"
    kept.parent.mkdir(parents=True, exist_ok=True)
    if kind_of(source) != OURS:
        write_lens(read_any(source), kept)
    elif not (kept.exists() and kept.samefile(source)):
        atomic_write_text(kept, source.read_text(encoding="utf-8-sig"))
    return to_dict(resolved)


# Models in the order of their time as C, tried where an error is asked for.
_LADDER: tuple[dict[str, str | int], ...] = (
    *({"method": "ols", "terms": terms} for terms in (12, 20, 28, 40, 64, 100)),
    {"method": "mlp", "units": 16},
    {"method": "mlp", "units": 32, "steps": 150},
)


def default_experiment(lens_file: str | Path, overrides: Sequence[str] = ()) -> Experiment:
    """Return the experiment of `neurolens train --lens FILE`: a polynomial and a network, no renders, a minute in all.

    With a target among the overrides, it is a ladder of models, fastest first, of which as many are fitted as it takes.
    """
    asked = any(text.partition("=")[0].strip().partition(".")[0] == "target" for text in overrides)
    tables = {
        "title": f"Models of {Path(lens_file).stem}",
        "lens": {"file": str(lens_file)},
        "model": list(_LADDER) if asked else [{"method": "ols", "terms": 64}, {"method": "mlp", "units": 16}],
        "evaluation": {"rounds": 8},
    }
    return from_dict(Experiment, apply_overrides(tables, overrides), "--set")
