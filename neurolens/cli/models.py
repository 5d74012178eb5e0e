"""`neurolens models [LENS]`, the models that are here and which one to use; `neurolens evaluate MODEL`, a model against
the promises of its card."""

from __future__ import annotations

import json
import warnings
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from neurolens.base.errors import ModelError, NeurolensWarning
from neurolens.base.files import library
from neurolens.base.lensname import lens_id_of
from neurolens.base.records import program, reaches, time_of
from neurolens.base.settings import setting, whole
from neurolens.cli import arguments as cli
from neurolens.studies.pages import CLOSE_UM, Advice, advice, expected_exact, to_use

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
  neurolens models lenses/cooke_triplet_50.toml --within 0.1px --json"""

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
        of_lens = [m for m in rows if self.lens is None or _is_of(m, self.lens)]
        if not of_lens:
            known = ", ".join(sorted({m["lens"] for m in rows})) or "a model in one of these folders"
            looked = ", ".join(map(str, places)) or "models/, runs/*/models/"
            self.refuse("LENS", self.lens or "(none)", f"one of: {known} (looked in {looked})")
        key, most = self.within or ("rms_um", CLOSE_UM)
        listed = sorted(of_lens, key=lambda m: (m["one_focus"], m["lens"], m["film_radius_mm"], m["rms_um"] or 0.0))
        kept = [m for m in listed if self.within is None or reaches(m, most, key)]
        of_states: dict[tuple[Any, ...], list[dict[str, Any]]] = {}
        for model in kept:
            of_states.setdefault((model["lens"], round(model["efl_mm"], 3), *model["states"]), []).append(model)
        for alike in of_states.values():
            if best := to_use([m for m in alike if not m["one_focus"]] or alike, most, key):
                best["use"] = [vars(a) for a in _advice(best)]
        data = {"looked_in": [str(p) for p in places], "within": self.within, "models": kept}
        return self.answer(data, lambda: _text(self.within, listed, kept), 0 if kept else 1)


def _advice(model: dict[str, Any]) -> list[Advice]:
    """Compare the best model of a lens with the lens itself, whose time is expected from its refractions."""
    file, lens = Path(model["file"]), model["lens"]
    other = file.name.startswith(f"{lens}-")  # of a state or focal length other than the file's
    row = {**model, "name": file.stem, "file": f"{file.parent.name}/{file.name}"}
    results = {"models": [row], "exact": [expected_exact(model["refractions"])], "lens": {"file": f"{lens}.toml"}}
    return advice(results | {"settings": {"lens": {"zoom": file.stem if other else None}}}, file.parent.parent)


def _places() -> list[Path]:
    """Return the folders of models that exist, each once."""
    near = [Path("models"), *sorted(Path("runs").glob("*/models"))]
    shipped = library() / "models"
    found = [p for p in near if p.is_dir()]
    return found + [shipped] * (shipped.is_dir() and all(p.resolve() != shipped for p in found))


def models_in(folder: Path) -> Iterator[dict[str, Any]]:
    """Yield the facts of a folder's cards, with the times beside them; a file that is no model is left out."""
    from neurolens.models.card import read_card

    times = _times(folder / "index.json") | _times(folder.parent / "results.json")
    for file in sorted(folder.glob("*.onnx")):
        try:
            card = read_card(file)
            domain, errors = card["domain"], card["errors"]
            row = {
                "file": str(file),
                "lens": str(card["lens"]["id"]),
                "name": str(card["lens"]["name"]),
                "method": str(card["fit"]["method"]),
                "family": str(card["fit"]["settings"].get("method", "")).replace("thick", "thin"),
                "refractions": int(card["lens"]["refractions"]),
                "efl_mm": float(card["lens"]["efl_mm"]),
                "film_radius_mm": float(domain["film_radius_mm"]),
                "focus_m": list(domain["focus_m"]),
                "one_focus": domain["focus_m"][0] == domain["focus_m"][1],  # as `neurolens plan` makes them
                "states": [str(a["name"]) for a in (card.get("states") or {}).get("axes", ())],
                **{k: errors.get(k) for k in ("rms_um", "rms_px", "direction_rms_deg", "poor")},
                "bytes": file.stat().st_size,
            }
        except (ModelError, OSError, KeyError, TypeError, ValueError, AttributeError) as error:
            warnings.warn(f"{file}: left out: {error}", NeurolensWarning, stacklevel=2)
            continue
        known = times.get(file.name, {})
        yield row | {k: known.get(k) for k in ("ns_per_ray", "fused_ns_per_ray")}


def _times(file: Path) -> dict[str, dict[str, Any]]:
    """Return records of an index or of a run, by file name; none where there is no such file."""
    try:
        rows = json.loads(file.read_text(encoding="utf-8"))["models"]
        return {Path(row["file"]).name: row for row in rows}
    except (OSError, ValueError, KeyError, TypeError, RecursionError):
        return {}


def _is_of(model: dict[str, Any], asked: str) -> bool:
    if asked.endswith(".toml") or Path(asked).is_file():
        return bool(model["lens"] == lens_id_of(asked))
    return any(asked.casefold() in text.casefold() for text in (model["lens"], model["name"], Path(model["file"]).stem))


def _text(within: tuple[str, float] | None, listed: Sequence[dict[str, Any]], kept: Sequence[dict[str, Any]]) -> str:
    if not kept:
        best = min(listed, key=lambda m: m["rms_um"] if m["rms_um"] is not None else 1e9)
        assert within is not None
        key, most = within
        unit = key.removeprefix("rms_")
        more = f"{program()} train --lens {best['lens']} --within {most:g}{unit}"
        error = f"{cli.number(best['rms_um'], 3)} um" if best["rms_um"] is not None else "error not known"
        timing = f", {cli.number(time['min'], 3)} ns a ray" if (time := time_of(best)) else ""
        found = f"None of {len(listed)} models is within {most:g} {unit}; the closest is {best['file']}"
        return f"{found} ({error}{timing}).\nFit one: {more}"
    header = ("", "model", "film mm", "focus m", "RMS um", "pixels", "ns", "C ns", "")
    rows = [
        (
            "*" if "use" in m else "",
            m["file"],
            cli.number(m["film_radius_mm"], 3),
            " - ".join(cli.number(f, 3) for f in m["focus_m"]),
            cli.number(m["rms_um"], 3),
            cli.number(m["rms_px"], 2),
            *(cli.number((m[k] or {}).get("min"), 3) for k in ("ns_per_ray", "fused_ns_per_ray")),
            "; ".join(_remarks(m)),
        )
        for m in kept
    ]
    parts = [
        cli.table(header, rows, left=2),
        "* the best model; film: radius; pixels of 4000 across; ns a ray on one core, C: compiled",
    ]
    chosen = [m for m in kept if "use" in m]
    if len(chosen) == 1:
        parts += ["\n  ".join(filter(None, (str(Advice(**a)), a["command"]))) for a in chosen[0]["use"]]
    return "\n\n".join(parts)


def _remarks(model: dict[str, Any]) -> list[str]:
    """Return the remarks in the last column."""
    found = [f"poor: {', '.join(model['poor'])}"] if model["poor"] else []
    found += ["one focus"] * model["one_focus"]
    found += [f"in one: {', '.join(model['states'])}"] if model["states"] and not found else []
    return found


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
  neurolens evaluate models/laikin_double_gauss_50.ols-36.onnx
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
        None, "of the rays (default: one that differs from the fit's)", kind=whole(0), metavar="N"
    )

    def run(self) -> int:
        """Measure, compare, time; return 1 where a promise does not hold."""
        from neurolens.cameras.model import load_model
        from neurolens.studies.check import check_model, check_states, lens_of_card, space_of_card
        from neurolens.studies.speed import time_model

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
        holds = all(p.holds for p in promises)
        data = {
            "model": str(self.model),
            "lens": {"id": model.card["lens"]["id"], "name": lens.name, "file": lens.path},
            "method": model.card["fit"]["method"],
            **figures,
            "ns_per_ray": timing,
            "promises": [{**asdict(p), "holds": p.holds} for p in promises],
            "holds": holds,
            "poor": model.card["errors"].get("poor") or [],
        }
        return self.answer(data, lambda: _evaluation(data, promises), 0 if holds else 1)


def _evaluation(data: dict[str, Any], promises: list[Promise]) -> str:
    header: tuple[str, ...] = ("figure", "promised", "measured", "allowed", "")
    rows: list[tuple[str, ...]] = [
        (p.key, *map(cli.number, (p.promised, p.measured, p.allowed)), "" if p.holds else "does not hold")
        for p in promises
    ]
    if not rows:  # a card without promises
        figures = "rms_um", "p99_um", "max_um", "direction_rms_deg", "transmittance_rms", "false_pass", "false_block"
        header, rows = ("figure", "measured"), [(key, cli.number(data[key])) for key in figures]
    timing = data["ns_per_ray"]
    broken = [p.key for p in promises if not p.holds]
    verdict = "The card has no promises." if not promises else "All promises hold."
    if broken:
        verdict = f"Does not hold: {', '.join(broken)}."
    lens = data["lens"]
    parts = [
        f"{data['model']}: {data['method']} of {lens['name']} ({lens['file']})\n"
        f"{data['rays']} fresh rays, seed {data['seed']}",
        cli.table(header, rows),
        f"{timing['min']:.1f} ns per ray (median {timing['median']:.1f}) on one thread, batches of {timing['batch']}",
    ]
    parts += [f"Poor, as the card says: {', '.join(data['poor'])}."] if data["poor"] else []
    return "\n\n".join([*parts, verdict])
