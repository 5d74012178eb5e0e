"""`neurolens models [LENS]`, the models that are here and which one to use; `neurolens evaluate MODEL`, a model against
the promises of its card."""

from __future__ import annotations

import json
import warnings
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from neurolens.base.errors import ModelError, NeurolensWarning, program
from neurolens.base.files import library
from neurolens.base.lensname import is_model, lens_id_of
from neurolens.base.report import OPTIONAL, PART, Report
from neurolens.base.settings import setting, whole
from neurolens.base.tomlfile import suggestion
from neurolens.cli import arguments as cli
from neurolens.studies.pages import CLOSE_UM, Advice, advice, expected_exact, to_use
from neurolens.studies.records import Timing, reaches, time_of

if TYPE_CHECKING:
    from neurolens.studies.check import Promise


@dataclass(frozen=True, kw_only=True)
class Models(cli.Figures):
    """List the exported models of all lenses, or of one: film circle, focus, film-equivalent RMS error on rays held
    out, and nanoseconds a ray in onnxruntime and as C where they were timed, on the machine that made them. The
    star is the best model of a lens: the fastest of those within 2 um (or --within) that their card does
    not call poor; where none is, the closest. Of one lens the last lines say whether to use that model or
    the lens itself, whose time is expected from its number of refractions. Models of one focus alone, such
    as those that "neurolens plan" fits for a shot, come last.

    Looked for in: models/ of the working folder and of the project (those that ship), and models/ of every
    run folder in runs/. Exit code 1 where there is none, or none within the error asked for."""

    epilog = """\
examples:
  neurolens models
  neurolens models double_gauss --within 0.5um
  neurolens models cooke_triplet_50 --within 0.1px --json"""
    alone = True

    lens: str | None = setting(
        None, "lens file, or part of a lens's name or id", positional=True, metavar="LENS", nargs="?"
    )
    within: tuple[str, float] | None = cli.within(
        "only models of at most this RMS error: 1um, or 0.1px of a picture 4000 pixels wide"
    )

    def run(self) -> int:
        """Print the models; return 1 where none is left."""
        places = _places()
        rows = [m for place in places for m in models_in(place)]
        of_lens = [m for m in rows if self.lens is None or m.is_of(self.lens)]
        if not of_lens:
            looked = ", ".join(map(str, places)) or "models/, runs/*/models/"
            near = suggestion(self.lens or "", sorted({m.lens for m in rows}))
            self.refuse("LENS", self.lens or "(none)", f"a lens with a model in {looked}{near}")
        key, most = self.within or ("rms_um", CLOSE_UM)
        listed = sorted(of_lens, key=lambda m: (m.one_focus, m.lens, m.film_radius_mm, m.rms_um or 0.0))
        kept = [m for m in listed if self.within is None or reaches(vars(m), most, key)]
        of_states: dict[tuple[Any, ...], list[Model]] = {}
        for model in kept:
            of_states.setdefault((model.lens, round(model.efl_mm, 3), *model.states), []).append(model)
        chosen = dict[str, list[Advice]]()
        for alike in of_states.values():
            several = [m for m in alike if not m.one_focus] or alike
            if best := to_use([{**vars(m), "model": m} for m in several], most, key):
                chosen[best["file"]] = _advice(best["model"])
        marked = [replace(m, use=chosen.get(m.file)) for m in kept]
        closest = None if kept else min(listed, key=lambda m: m.rms_um if m.rms_um is not None else 1e9)
        return self.answer(Listed(places, self.within, marked, len(listed), closest), code=0 if kept else 1)


@dataclass(frozen=True, kw_only=True)
class Model:
    """What the card of a model states, with its times where they were measured.

    Attributes:
        method, family: how it was fitted, and the kind of method.
        one_focus: whether it holds for one focus distance alone.
        states: the axes of a model of many states.
        poor: the errors that are visible in a picture.
        use: why it is the model to use, or the lens itself; None for the others.
    """

    file: str
    lens: str
    name: str
    method: str
    family: str
    refractions: int
    efl_mm: float
    film_radius_mm: float
    focus_m: list[float]
    one_focus: bool
    states: list[str]
    rms_um: float | None
    rms_px: float | None
    direction_rms_deg: float | None
    poor: list[str] | None
    bytes: int
    ns_per_ray: Mapping[str, Any] | None
    fused_ns_per_ray: Mapping[str, Any] | None
    use: list[Advice] | None = field(default=None, metadata=OPTIONAL)

    def is_of(self, asked: str) -> bool:
        """Test whether this is a model of a lens file, or of a lens that has this text in its name or id."""
        if asked.endswith(".toml") or Path(asked).is_file():
            return self.lens == lens_id_of(asked)
        return any(asked.casefold() in text.casefold() for text in (self.lens, self.name, Path(self.file).stem))

    def remarks(self) -> list[str]:
        """Return the remarks in the last column."""
        found = [f"poor: {', '.join(self.poor)}"] if self.poor else []
        found += ["one focus"] * self.one_focus
        return found + ([f"in one: {', '.join(self.states)}"] if self.states and not found else [])


def _advice(model: Model) -> list[Advice]:
    """Compare the best model of a lens with the lens itself, whose time is expected from its refractions."""
    file, lens = Path(model.file), model.lens
    other = file.name.startswith(f"{lens}-")  # of a state or focal length other than the file's
    row = {**vars(model), "name": file.stem, "file": f"{file.parent.name}/{file.name}"}
    results = {"models": [row], "exact": [expected_exact(model.refractions)], "lens": {"file": f"{lens}.toml"}}
    return advice(results | {"settings": {"lens": {"zoom": file.stem if other else None}}}, file.parent.parent)


def _places() -> list[Path]:
    """Return the folders of models that exist, each once."""
    near = [Path("models"), *sorted(Path("runs").glob("*/models"))]
    shipped = library() / "models"
    found = [p for p in near if p.is_dir()]
    return found + [shipped] * (shipped.is_dir() and all(p.resolve() != shipped for p in found))


def models_in(folder: Path) -> Iterator[Model]:
    """Yield the facts of a folder's cards, with the times beside them; a file that is no model is left out."""
    from neurolens.models.card import read_card

    times = _times(folder / "index.json") | _times(folder.parent / "results.json")
    for file in sorted(folder.glob("*.onnx")):
        try:
            card = read_card(file)
            domain, errors = card["domain"], card["errors"]
            known = times.get(file.name, {})
            model = Model(
                file=str(file),
                lens=str(card["lens"]["id"]),
                name=str(card["lens"]["name"]),
                method=str(card["fit"]["method"]),
                family=str(card["fit"]["settings"].get("method", "")).replace("thick", "thin"),
                refractions=int(card["lens"]["refractions"]),
                efl_mm=float(card["lens"]["efl_mm"]),
                film_radius_mm=float(domain["film_radius_mm"]),
                focus_m=list(domain["focus_m"]),
                one_focus=domain["focus_m"][0] == domain["focus_m"][1],  # as `neurolens plan` makes them
                states=[str(a["name"]) for a in (card.get("states") or {}).get("axes", ())],
                **{k: errors.get(k) for k in ("rms_um", "rms_px", "direction_rms_deg", "poor")},
                bytes=file.stat().st_size,
                **{k: known.get(k) for k in ("ns_per_ray", "fused_ns_per_ray")},
            )
        except (ModelError, OSError, KeyError, TypeError, ValueError, AttributeError) as error:
            warnings.warn(f"{file}: left out: {error}", NeurolensWarning, stacklevel=2)
            continue
        yield model


def _times(file: Path) -> dict[str, dict[str, Any]]:
    """Return records of an index or of a run, by file name; none where there is no such file."""
    try:
        return {Path(row["file"]).name: row for row in json.loads(file.read_text(encoding="utf-8"))["models"]}
    except (OSError, ValueError, KeyError, TypeError, RecursionError):
        return {}


@dataclass(frozen=True)
class Listed(Report):
    """The models that are here, or of one lens, within an error if one was asked for.

    Attributes:
        within: the key of the error and the most of it.
        found: how many models there are, with those that are not within.
        closest: the one with the smallest error, where none is within.
    """

    looked_in: list[Path]
    within: tuple[str, float] | None
    models: list[Model]
    found: int
    closest: Model | None = field(default=None, metadata=OPTIONAL)

    def text(self) -> str:
        """Return a row for each model, and of one lens what to use."""
        if self.closest is not None:
            return self._none(self.closest)
        header = ("", "model", "film mm", "focus m", "RMS um", "pixels", "ns", "C ns", "")
        rows = [
            (
                "*" if m.use is not None else "",
                m.file,
                cli.number(m.film_radius_mm, 3),
                " - ".join(cli.number(f, 3) for f in m.focus_m),
                cli.number(m.rms_um, 3),
                cli.number(m.rms_px, 2),
                *(cli.number((timing or {}).get("min"), 3) for timing in (m.ns_per_ray, m.fused_ns_per_ray)),
                "; ".join(m.remarks()),
            )
            for m in self.models
        ]
        parts = [
            cli.table(header, rows, left=2),
            "* the best model; film: radius; pixels of 4000 across; ns a ray on one core, C: compiled",
        ]
        chosen = [m.use for m in self.models if m.use is not None]
        if len(chosen) == 1:
            parts += ["\n  ".join(filter(None, (str(a), a.command))) for a in chosen[0]]
        return "\n\n".join(parts)

    def _none(self, best: Model) -> str:
        """Say that no model is within the error, and how to fit one."""
        assert self.within is not None
        key, most = self.within
        unit = key.removeprefix("rms_")
        more = f"{program()} train --lens {best.lens} --within {most:g}{unit}"
        error = f"{cli.number(best.rms_um, 3)} um" if best.rms_um is not None else "error not known"
        timing = f", {cli.number(time['min'], 3)} ns a ray" if (time := time_of(vars(best))) else ""
        found = f"None of {self.found} models is within {most:g} {unit}; the closest is {best.file}"
        return f"{found} ({error}{timing}).\nFit one: {more}"


@dataclass(frozen=True, kw_only=True)
class Evaluate(cli.Figures):
    """Measure an exported model on 30,000 fresh rays of its card's domain, traced through the exact lens in float64 and
    through the ONNX model in onnxruntime. Prints each figure beside the card's promise, of the whole film, stopped down
    ("2_stops.false_pass") and of its thirds by radius ("full.edge.rms_um"); exits with code 1 if one does not hold.
    Needs the extra "train" (torch).

    Micrometres are film-equivalent: the distance between the exact and the predicted ray on the plane in focus, taken
    back to the film. An error holds while it is above the promise by at most 4 standard deviations of its estimate from
    so many rays, at least 10% and at most 50%; a share by at most 4 of the root of its count; the figures of a model of
    many states, the worst of six random ones, by at most 25%. A largest error is only shown."""

    epilog = """\
examples:
  neurolens evaluate laikin_double_gauss_50.ols-36
  neurolens evaluate runs/quickstart/models/ols-60.onnx --rays 100000 --seed 5
  neurolens evaluate my.onnx --lens my_lens.toml --json

The lens file is looked for by the card's lens id: lenses/ beside the model and its folder, where a run
keeps its own; ./lenses; the project's."""

    model: Path = setting(
        ..., "exported model (.onnx), or the name of one", positional=True, metavar="MODEL",
        kind=partial(cli.named_lens, True, False),
    )  # fmt: skip
    lens: Path | None = cli.lens(None, " (default: found by the card's lens id)")
    rays: int = setting(
        30_000, "rays that the lens passes, eight times as many if a few bad ones dominate an error; "
        "four times as many test the vignetting (default: 30000)", within=(1000, 1_000_000),
    )  # fmt: skip
    seed: int | None = setting(
        None, "seed of the rays (default: one that differs from the fit's)", kind=whole(0), metavar="N"
    )

    def run(self) -> int:
        """Measure, compare, time; return 1 where a promise does not hold."""
        from neurolens.cameras.model import load_model
        from neurolens.studies.check import check_model, check_states, lens_of_card, space_of_card
        from neurolens.studies.speed import time_model

        if not is_model(self.model):
            self.refuse("MODEL", self.model, "an exported model (.onnx): neurolens train makes them of a lens")
        model = load_model(self.model)
        space = space_of_card(model.card, model.axes, self.lens, self.model) if model.axes else None
        lens = space.lens if space else lens_of_card(model.card, self.lens, self.model)
        progress = self.progress({"measure": 10, "time": 2})
        with progress.stage("measure"):
            if space is not None:
                figures, promises = check_states(model, space, rays=self.rays, seed=self.seed)
            else:
                figures, promises = check_model(model, lens, rays=self.rays, seed=self.seed)
        with progress.stage("time"):
            timing = time_model(model, self.model.stem, rounds=10)
        errors = model.card["errors"]
        found = Evaluation(
            model=self.model, lens=OfLens(model.card["lens"]["id"], lens.name, lens.path),
            method=model.card["fit"]["method"], figures=figures, ns_per_ray=timing, promises=promises,
            holds=all(p.holds for p in promises), poor=errors.get("poor") or [],
        )  # fmt: skip
        return self.answer(found, code=0 if found.holds else 1)


@dataclass(frozen=True)
class OfLens:
    """The lens of a model: its id, its name and its file."""

    id: str
    name: str
    file: str


@dataclass(frozen=True, kw_only=True)
class Evaluation(Report):
    """A model on fresh rays beside the promises of its card.

    Attributes:
        figures: as `check.check_model`, or for a model of many states `check.check_states`, returns them.
        poor: the errors that are visible in a picture, as the card says.
    """

    model: Path
    lens: OfLens
    method: str
    figures: Mapping[str, Any] = field(metadata=PART)
    ns_per_ray: Timing | None
    promises: list[Promise]
    holds: bool
    poor: list[str]

    def text(self) -> str:
        """Return a row for each promise, the time of a ray, and whether all hold."""
        header: tuple[str, ...] = ("figure", "promised", "measured", "allowed", "")
        rows: list[tuple[str, ...]] = [
            (p.key, *map(cli.number, (p.promised, p.measured, p.allowed)), "" if p.holds else "does not hold")
            for p in self.promises
        ]
        if not rows:  # a card without promises
            shown = "rms_um", "p99_um", "max_um", "direction_rms_deg", "transmittance_rms", "false_pass", "false_block"
            header, rows = ("figure", "measured"), [(key, cli.number(self.figures[key])) for key in shown]
        verdict = "All promises hold." if self.promises else "The card has no promises."
        if not self.holds:
            verdict = f"Does not hold: {', '.join(p.key for p in self.promises if not p.holds)}."
        lens, timing = self.lens, self.ns_per_ray
        parts = [
            f"{self.model}: {self.method} of {lens.name} ({lens.file})\n"
            f"{self.figures['rays']} fresh rays, seed {self.figures['seed']}",
            cli.table(header, rows),
        ]
        if timing is not None:
            median, batch = timing["median"], timing["batch"]
            parts.append(f"{timing['min']:.1f} ns per ray (median {median:.1f}) on one thread, batches of {batch}")
        parts += [f"Poor, as the card says: {', '.join(self.poor)}."] if self.poor else []
        return "\n\n".join([*parts, verdict])
