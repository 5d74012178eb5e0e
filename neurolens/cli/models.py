"""`neurolens models [LENS]`: the models that are here, and which one to use."""

from __future__ import annotations

import json
import warnings
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

from neurolens.base.errors import ModelError, NeurolensWarning
from neurolens.base.files import library
from neurolens.base.lensname import lens_id_of
from neurolens.base.records import program, reaches, time_of
from neurolens.base.settings import setting
from neurolens.cli.arguments import Answering, within
from neurolens.cli.output import number, table
from neurolens.study.pages import CLOSE_UM, Advice, advice, expected_exact, to_use


@dataclass(frozen=True, kw_only=True)
class Models(Answering):
    """List exported models by lens: film circle, focus, film-equivalent RMS error on rays held out, and
    nanoseconds a ray in onnxruntime and as C where they were timed, on the machine that made them. The
    star is the best model of a lens: the fastest of those within 2 um (or --within) that their card does
    not call poor; where none is, the closest. Of one lens the last lines say whether to use that model or
    the lens itself, whose time is expected from its number of refractions. Models of one focus alone, such
    as those that "neurolens plan" fits for a shot, come last.

    Looked for in: models/ of the working folder and of the project (those that ship), and models/ of every
    run folder in runs/. Exit code 1 where there is none, or none within the error asked for."""

    about: ClassVar[str] = "list models that are here, and the one to use"
    epilog: ClassVar[str] = """\
examples:
  neurolens models
  neurolens models double_gauss --within 0.5um
  neurolens models lenses/cooke_triplet_50.toml --within 0.1px --json"""

    lens: str | None = setting(
        None, "lens file, or part of a lens's name or id", positional=True, metavar="LENS", nargs="?"
    )
    within: tuple[str, float] | None = within(
        "only models of at most this RMS error: 1um, or 0.1px of a picture 4000 pixels wide"
    )

    def run(self) -> int:
        """Print the models; 1 where none is left."""
        places = _places()
        rows = [m for place in places for m in models_in(place)]
        of_lens = [m for m in rows if self.lens is None or _is_of(m, self.lens)]
        if not of_lens:
            known = ", ".join(sorted({m["lens"] for m in rows})) or "a model in one of these folders"
            looked = ", ".join(map(str, places)) or "models/, runs/*/models/"
            self.refuse("LENS", self.lens or "(none)", f"one of: {known} (looked in {looked})")
        key, most = self.within or ("rms_um", CLOSE_UM)
        listed = sorted(of_lens, key=lambda m: (_of_a_shot(m), m["lens"], m["film_radius_mm"], m["rms_um"] or 0.0))
        kept = [m for m in listed if self.within is None or reaches(m, most, key)]
        for state in {_state(m) for m in listed}:
            alike = [m for m in kept if _state(m) == state]
            best = to_use([m for m in alike if not _of_a_shot(m)] or alike, most, key)
            if best:
                best["use"] = [vars(a) for a in _advice(best)]
        data = {"looked_in": [str(p) for p in places], "within": self.within, "models": kept}
        return self.answer(data, lambda: _text(self.within, listed, kept), 0 if kept else 1)


def _advice(model: dict[str, Any]) -> list[Advice]:
    """Advice between the best model of a lens and the lens itself, whose time is expected from its refractions."""
    file, lens = Path(model["file"]), model["lens"]
    other = file.name.startswith(f"{lens}-")  # of another state or focal length than the lens's file has
    row = {**model, "name": file.stem, "file": f"{file.parent.name}/{file.name}"}
    results = {"models": [row], "exact": [expected_exact(model["refractions"])], "lens": {"file": f"{lens}.toml"}}
    return advice(results | {"settings": {"lens": {"zoom": file.stem if other else None}}}, file.parent.parent)


def _places() -> list[Path]:
    """Folders of models that exist; the same one once."""
    near = [Path("models"), *sorted(Path("runs").glob("*/models"))]
    shipped = library() / "models"
    found = [p for p in near if p.is_dir()]
    return found + [shipped] * (shipped.is_dir() and all(p.resolve() != shipped for p in found))


def models_in(folder: Path) -> Iterator[dict[str, Any]]:
    """The facts of the cards in a folder, with the times beside them; a file that is no model is left out."""
    from neurolens.surrogates.card import read_card

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
    """Records of an index or of a run, by file name; none where there is no such file."""
    try:
        rows = json.loads(file.read_text(encoding="utf-8"))["models"]
        return {Path(row["file"]).name: row for row in rows}
    except (OSError, ValueError, KeyError, TypeError, RecursionError):
        return {}


def _state(model: dict[str, Any]) -> tuple[Any, ...]:
    """A key that models of the same state of a lens share."""
    return model["lens"], round(model["efl_mm"], 3), *model["states"]


def _of_a_shot(model: dict[str, Any]) -> bool:
    """True for a model of one focus alone, such as those that `neurolens plan` fits for a shot."""
    near, far = model["focus_m"]
    return bool(near == far)


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
        error = f"{number(best['rms_um'], 3)} um" if best["rms_um"] is not None else "error not known"
        timing = f", {number(time['min'], 3)} ns a ray" if (time := time_of(best)) else ""
        found = f"None of {len(listed)} models is within {most:g} {unit}; the closest is {best['file']}"
        return f"{found} ({error}{timing}).\nFit one: {more}"
    header = ("", "model", "film mm", "focus m", "RMS um", "pixels", "ns", "C ns", "")
    rows = [
        (
            "*" if "use" in m else "",
            m["file"],
            number(m["film_radius_mm"], 3),
            " - ".join(number(f, 3) for f in m["focus_m"]),
            number(m["rms_um"], 3),
            number(m["rms_px"], 2),
            *(number((m[k] or {}).get("min"), 3) for k in ("ns_per_ray", "fused_ns_per_ray")),
            "; ".join(_remarks(m)),
        )
        for m in kept
    ]
    parts = [
        table(header, rows, left=2),
        "* the best model; film: radius; pixels of 4000 across; ns a ray on one core, C: compiled",
    ]
    chosen = [m for m in kept if "use" in m]
    if len(chosen) == 1:
        parts += ["\n  ".join(filter(None, (str(Advice(**a)), a["command"]))) for a in chosen[0]["use"]]
    return "\n\n".join(parts)


def _remarks(model: dict[str, Any]) -> list[str]:
    """The remarks in the last column."""
    found = [f"poor: {', '.join(model['poor'])}"] if model["poor"] else []
    found += ["one focus"] * _of_a_shot(model)
    found += [f"in one: {', '.join(model['states'])}"] if model["states"] and not found else []
    return found
