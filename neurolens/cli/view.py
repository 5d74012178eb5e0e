"""`neurolens view`: one page in which lenses and their models run, for a browser."""

from __future__ import annotations

import argparse
import os
import re
import warnings
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from neurolens.base.bounds import RANGE
from neurolens.base.errors import InputError, ModelError, NeurolensError, NeurolensWarning
from neurolens.base.files import TemporaryFolder
from neurolens.base.files import library as shipped
from neurolens.base.lensname import is_model
from neurolens.base.progress import Progress
from neurolens.cli.arguments import add_glass, add_json, add_lens, add_output, check_folder, check_suffix, whole
from neurolens.cli.output import answer

if TYPE_CHECKING:
    from neurolens.flare.ghostmodel import GhostModel
    from neurolens.lens.prescription import Lens
    from neurolens.surrogates.source import Written
    from neurolens.view.page import Form, ViewLens

_DESCRIPTION = """\
Write one page for a browser, which needs neither server nor network: lenses traced exactly and their
models as GLSL in a path tracer of WebGL2, side by side or as their difference, at any focus, stop,
blades and wavelength; their layout with the rays of a pixel, their error and what a ray costs there.

LENS is a lens file of any format that `neurolens convert` reads, or a name of lenses/; MODEL an exported
model, shown with the lens of its name; fitted ghosts (`neurolens flare --fit`) are drawn where a lamp
is dragged. Without any, every lens of lenses/ with the best polynomial and
the best network of models/."""
_EPILOG = """\
examples:
  neurolens view -o view.html
  neurolens view petzval_portrait_100 laikin_double_gauss_50 -o two.html
  neurolens view my_lens.zmx runs/mine/models/ols-64.onnx -o mine.html
  neurolens view laikin_double_gauss_50 ghosts.onnx -o flare.html"""
_NETWORK = "mlp"
_ERRORS = ("rms_um", "p99_um", "rms_infinity_um", "direction_rms_deg", "transmittance_rms", "false_pass", "false_block")
_LIGHT_NM = (400.0, 700.0)
_NEAR_EFL = 10.0  # of an exact lens: nearest focus in focal lengths
_SAME = 1e-3  # of the focal length: what models and lens file of one id may differ by
_DOWNLOADS = ("glsl", "onnx", "c", "osl")
_GHOSTS = 24  # of a lens at most: the brightest


@dataclass(frozen=True)
class _Entry:
    """A lens with its models, in one state; `zoom` "range" is all of a zoom.

    `file` is of the lens, where it has been written.
    """

    key: str
    models: Sequence[Path]
    lens: Lens | None
    zoom: str | None = None
    ghosts: GhostModel | None = None
    file: Path | None = None


def add_parser(subparsers: Any) -> None:
    """Add the command to the command line."""
    parser = subparsers.add_parser(
        "view", help="write a page that runs lenses and models in a browser", description=_DESCRIPTION, epilog=_EPILOG
    )
    add_lens(parser, "lenses", models=True, metavar="LENS|MODEL", nargs="*")
    add_output(parser, "FILE.html", "page (default: view.html)", default=Path("view.html"))
    parser.add_argument(
        "--downloads", metavar="KINDS", type=_kinds, default=_DOWNLOADS,
        help="of glsl, onnx, c, osl what the page brings as files of each form (default: all; osl takes seconds a "
        "form, a minute of a zoom, once); the last are left out where the page grows beyond 3 MB, exact lenses' first",
    )  # fmt: skip
    parser.add_argument(
        "--jobs", metavar="N", type=whole(1, 64), default=min(8, os.cpu_count() or 1),
        help="processes that write OSL, each of a core and 0.5 GB (default: all cores, at most 8)",
    )  # fmt: skip
    add_glass(parser)
    add_json(parser)
    parser.set_defaults(run=run, kept="nothing was written")


def _kinds(text: str) -> list[str]:
    words = text.split(",")
    if words[0] != "glsl" or len(set(words)) < len(words) or not set(words) <= set(_DOWNLOADS):
        raise argparse.ArgumentTypeError(
            f"got {text!r}, expected glsl, and of {', '.join(_DOWNLOADS[1:])} what is wanted"
        )
    return words


def run(args: argparse.Namespace) -> int:
    """Write the page."""
    check_suffix(args.out, "--output", (".html", ".htm"))
    check_folder(args.out, "--output")
    entries = list(_asked(args.lenses) if args.lenses else _library())
    for entry in entries:
        found = [_kind_of(_card(file)) for file in entry.models]
        if len(set(found)) < len(found):
            raise InputError("neurolens view", entry.key, f"({' and '.join(found)})", "one model of each kind")
    kinds, progress = args.downloads, Progress(quiet=args.json)
    made: list[ViewLens] = []
    with TemporaryFolder() as place, warnings.catch_warnings():
        warnings.filterwarnings("ignore", re.escape(place), NeurolensWarning)  # said of the lens's own file
        entries = [_with_file(entry, Path(place) / str(number)) for number, entry in enumerate(entries)]
        shaders = _shaders(entries, args.jobs, progress) if "osl" in kinds else {}
        with progress.stage(f"{len(entries)} lenses") as report:
            for entry in entries:
                made.append(_view_lens(entry, Path(place), kinds, shaders))
                report(len(made) / len(entries))
    from neurolens.view.page import write_page

    about = write_page(args.out, made, kinds)
    left = about["left_out"]
    data = {"file": str(args.out), **about, "lenses": [lens.key for lens in made]}
    more = f"; left out for its size: {', '.join(left)}" if left else ""
    return answer(args, data, lambda: f"{args.out}: {len(made)} lenses, {about['bytes'] / 1e6:.2f} MB{more}")


def _with_file(entry: _Entry, folder: Path) -> _Entry:
    from neurolens.readers.lenswriter import write_lens

    if entry.lens is None:
        return entry
    folder.mkdir()
    file = folder / f"{entry.lens.lens_id}.toml"
    write_lens(entry.lens, file)
    return replace(entry, file=file)


def _shaders(entries: Sequence[_Entry], jobs: int, progress: Progress) -> Mapping[Path, str]:
    """OSL of lens files and models; those that cannot be written so are told of and left out."""
    from neurolens.cli.blender_lenses import forms_of

    zooms = {e.file: e.zoom for e in entries if e.file is not None}
    files = [*zooms, *(model for entry in entries for model in entry.models)]
    with progress.stage("shaders") as report:
        forms, left = forms_of(files, min(jobs, len(files)), report, zooms)
    for file, why in left.items():
        warnings.warn(f"no OSL: {why.replace(str(file), file.name)}", NeurolensWarning, stacklevel=2)
    return {file: form.osl for file, form in forms.items()}


def _library() -> Iterator[_Entry]:
    """Every lens of lenses/ with its best models; zooms over their range where a model has it."""
    from neurolens.cli.blender_lenses import key_of, library
    from neurolens.readers.any_format import read_any

    root = shipped()
    for models, file in library(root / "models", root / "lenses", ()):
        base, _, state = key_of(models[0]).partition("-")
        if file is None:
            file = root / "lenses" / f"{base}.toml"
        zoom = RANGE if state == "range" else None
        if state and not zoom:
            continue  # a second model of a lens that is here already
        yield _Entry(key_of(models[0]), models, read_any(file) if file.is_file() else None, zoom)


def _asked(paths: Sequence[Path]) -> Iterator[_Entry]:
    """Lenses in the order of their first word; models join the lens of their id, in place of those of the library."""
    from neurolens.cli.blender_lenses import library
    from neurolens.readers.any_format import read_any

    root = shipped()
    lenses: dict[str, Lens | None] = {}
    models: dict[str, list[Path]] = {}
    brought: dict[str, list[Path]] = {}
    flares = {path: model for path in paths if is_model(path) and (model := _flare(path))}
    of: dict[str, GhostModel] = {}
    for path, model in flares.items():
        if of.setdefault(model.lens.lens_id, model) is not model:
            raise InputError("neurolens view", f"ghosts of {model.lens.lens_id}", str(path), "one file a lens")
    for path in paths:
        if path in flares:
            continue
        if is_model(path):
            lens_id = str(_card(path)["lens"]["id"])
            lenses.setdefault(lens_id, None)
            models.setdefault(lens_id, []).append(path)
            continue
        lens = read_any(path)
        lenses[lens.lens_id] = lens
        if path.resolve().parent == (root / "lenses").resolve():  # one of the library brings its models
            known = library(root / "models", root / "lenses", [path.stem]) if _has_models(root, path.stem) else ()
            brought[lens.lens_id] = [m for files, _ in known for m in files]
    if not of.keys() <= lenses.keys():
        lens_id = next(iter(of.keys() - lenses.keys()))
        raise InputError("neurolens view", f"ghosts of {lens_id}", "(no such lens)", "the lens beside its ghosts")
    for lens_id, own in lenses.items():
        found = models.get(lens_id) or brought.get(lens_id, [])
        zoom = RANGE if any(_card(m).get("states") for m in found) else None
        yield _Entry(lens_id, found, own, zoom, of.get(lens_id))


def _has_models(root: Path, key: str) -> bool:
    return any((root / "models").glob(f"{key}.*.onnx"))


def _flare(file: Path) -> GhostModel | None:
    """The ghosts of a file that holds such; others are refused or read elsewhere."""
    from neurolens.flare.ghostmodel import KIND, read_ghosts
    from neurolens.surrogates.metadata import card_in, read_metadata

    try:
        card_in(file, read_metadata(file), KIND)
    except ModelError:
        return None
    return read_ghosts(file)


def _card(file: Path) -> dict[str, Any]:
    from neurolens.surrogates.metadata import read_card

    return read_card(file)


def _kind_of(card: Mapping[str, Any]) -> str:
    family = str(card["fit"]["settings"].get("method", card["fit"]["method"]))
    return "network" if family.startswith(_NETWORK) else "polynomial"


def _view_lens(entry: _Entry, folder: Path, kinds: Sequence[str], shaders: Mapping[Path, str]) -> ViewLens:
    """A lens of the page.

    Raises:
        InputError: models of another state; a lens that the exact tracer's code cannot hold, without any model.
    """
    from neurolens.setting.states import set_lens
    from neurolens.view.page import ViewLens
    from neurolens.view.shaders import ghosts_glsl

    forms = [_model_form(file, folder, kinds, shaders.get(file)) for file in entry.models]
    drawn: dict[str, Any] = {}
    path = None
    if entry.lens is not None and entry.file is not None:
        lens = set_lens(entry.lens) if entry.zoom == RANGE else set_lens(entry.lens, zoom=entry.zoom)
        try:
            forms.append(_exact_form(entry, entry.file, lens, kinds, shaders.get(entry.file)))
            path = _path(lens) if entry.zoom != RANGE else None
        except NeurolensError:
            if not forms:
                raise  # a model of the lens stands in for it
        drawn = _section(lens)
    best, focal_mm = forms[0], [float(f.card["efl_mm"]) for f in forms]
    if entry.zoom != RANGE and max(focal_mm) - min(focal_mm) > _SAME * abs(focal_mm[0]):
        raise InputError("neurolens view", f"{entry.key}: efl_mm", focal_mm, "models of the lens file, in its state")
    return ViewLens(
        entry.key, str(best.card["name"]), str(best.card["source"]), float(best.card["efl_mm"]),
        min(float(f.card["film_radius_mm"]) for f in forms), _squeeze(entry), best.card["f_numbers"],
        max(float(f.card["nearest_m"]) for f in forms), drawn, path, forms,
        None if entry.ghosts is None else ghosts_glsl(entry.ghosts, _GHOSTS),
    )  # fmt: skip


def _squeeze(entry: _Entry) -> float:
    from neurolens.lens.paraxial import first_order
    from neurolens.setting.states import set_lens

    if entry.lens is None or not entry.lens.anamorphic:
        return 1.0
    lens = set_lens(entry.lens)
    return abs(float(first_order(lens).efl_mm / first_order(lens, meridian="x").efl_mm))


def _section(lens: Lens) -> dict[str, Any]:
    from neurolens.analysis.fields import Scene
    from neurolens.analysis.layout import layout_profile
    from neurolens.view.page import section_svg

    return section_svg(replace(layout_profile(Scene(lens, axis="y")), rays=()))


def _path(lens: Lens) -> tuple[str, Sequence[str]]:
    from neurolens.setting.pupils import pupil_plane_z_mm
    from neurolens.view.shaders import path_glsl

    return path_glsl(lens, pupil_plane_z_mm(lens), _LIGHT_NM)


def _model_form(file: Path, folder: Path, kinds: Sequence[str], osl: str | None) -> Form:
    from neurolens.cameras.onnxlens import load_model
    from neurolens.shaders.source import model_extras
    from neurolens.surrogates.source import export_source

    loaded = load_model(file)
    card, domain, errors = loaded.card, loaded.card["domain"], loaded.card["errors"]
    if any(axis.name != "zoom" for axis in loaded.axes):
        raise InputError(file, "states", [axis.name for axis in loaded.axes], "a zoom, or a model of one state")
    extras, notes = model_extras(loaded)
    written = {
        to: export_source(loaded.file.nodes, folder / f"model.{to}", to, card, extras=extras, notes=notes)
        for to in _written(kinds)
    }
    told = {
        **_facts(card["lens"]),
        "film_radius_mm": domain["film_radius_mm"],
        "nearest_m": domain["focus_m"][1],
        "f_numbers": [(float(n["efl_mm"]), float(n["f_number"])) for n in _lens_nodes(card)],
        "errors": {key: errors[key] for key in _ERRORS if isinstance(errors.get(key), (int, float))},
        "zones": errors.get("zones") or {},
        "poor": list(errors.get("poor") or ()),
    }
    return _form(_kind_of(card), str(card["fit"]["method"]), written, told, {"onnx": file.read_bytes()}, osl)


def _written(kinds: Sequence[str]) -> list[str]:
    """The languages that a form is written in."""
    return [kind for kind in ("glsl", "c") if kind in kinds]


def _lens_nodes(card: Mapping[str, Any]) -> list[Mapping[str, Any]]:
    """The lens's facts at each node of a zoom, else of the one state."""
    return [node["lens"] for node in card["states"]["nodes"]] if card.get("states") else [card["lens"]]


def _facts(lens: Mapping[str, Any]) -> dict[str, Any]:
    return {key: lens[key] for key in ("name", "source", "efl_mm")}


def _exact_form(entry: _Entry, file: Path, at: Lens, kinds: Sequence[str], osl: str | None) -> Form:
    from neurolens.cli.export_lens import write_lens
    from neurolens.lens.paraxial import first_order
    from neurolens.setting.pupils import image_radius_mm

    written = {
        to: write_lens(file, file.with_suffix(f".{to}"), to, zoom=entry.zoom, quiet=True) for to in _written(kinds)
    }
    data = first_order(at)
    told = {
        "name": at.name, "source": at.source, "efl_mm": float(data.efl_mm),
        "film_radius_mm": image_radius_mm(at)[0],
        "nearest_m": _NEAR_EFL * abs(float(data.efl_mm)) / 1000 * 1.05,
        "f_numbers": [(float(data.efl_mm), float(data.f_number))],
        "errors": {}, "zones": {}, "poor": [],
    }  # fmt: skip
    return _form("exact", "every surface traced", written, told, {}, osl)


def _form(
    kind: str, method: str, written: Mapping[str, Written], card: Mapping[str, Any], files: dict[str, bytes],
    osl: str | None,
) -> Form:  # fmt: skip
    from neurolens.view.page import Form

    glsl = written["glsl"]
    files |= {to: w.path.read_bytes() for to, w in written.items() if to != "glsl"}
    files |= {} if osl is None else {"osl": osl.encode()}
    return Form(kind, method, glsl.path.read_text("utf-8"), glsl.signature, card, files)
