"""`neurolens view`: one page in which lenses and their models run, for a browser."""

import re
import warnings
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from neurolens.base.errors import InputError, NeurolensError, NeurolensWarning
from neurolens.base.files import TemporaryFolder, library as shipped
from neurolens.base.lensname import is_model
from neurolens.base.progress import Progress
from neurolens.base.report import PART, Report
from neurolens.base.settings import LIGHT_NM, RANGE, setting, setting_of
from neurolens.cameras.onnxlens import load_model
from neurolens.cameras.shaders.lens_source import write_lens
from neurolens.cameras.shaders.source import model_extras
from neurolens.cli import arguments as cli
from neurolens.cli.blender import Build, forms_of, kind_of, library, squeeze_of
from neurolens.models.card import read_card
from neurolens.models.source import Written, export_source
from neurolens.optics.analysis.fields import Scene
from neurolens.optics.analysis.layout import layout_profile
from neurolens.optics.lens.paraxial import first_order
from neurolens.optics.lens.prescription import Lens
from neurolens.optics.lens.shot import Shot
from neurolens.optics.readers import lensfile
from neurolens.optics.readers.any_format import read_any
from neurolens.optics.setting.pupils import image_radius_mm, pupil_plane_z_mm
from neurolens.optics.setting.states import set_lens
from neurolens.programs.view import Form, Page, ViewLens, ghosts_glsl, path_glsl, section_svg, write_page

_DOWNLOADS = ("glsl", "onnx", "c", "osl")
_ERRORS = ("rms_um", "p99_um", "rms_infinity_um", "direction_rms_deg", "transmittance_rms", "false_pass", "false_block")
_NEAR_EFL = 10.0  # an exact lens's nearest focus in focal lengths
_SAME = 1e-3  # of the focal length: models and a lens file of one id may differ by this share
_GHOSTS = 24  # ghosts of a lens at most, the brightest
_SIX = (  # without any lens
    "laikin_double_gauss_50", "petzval_portrait_100", "cooke_triplet_50", "isshiki_fisheye_10", "phone_lens_6",
    "merte_biotar_100",
)  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class View(cli.Reporting):
    """Write one page that renders through lenses and their models in a browser, without server or network.

    The page traces lenses exactly, and runs models as GLSL, in a path tracer of WebGPU (or WebGL2). It shows them side
    by side or as their difference, at any focus, stop, blades and wavelength, with the layout, the rays of a pixel, the
    error, and what a ray costs there.

    LENS is a lens file of any format that `neurolens convert` reads, or a name of lenses/. MODEL is an exported model,
    which is shown with the lens of its name. Without any the page has six lenses, each with its best polynomial and its
    best network."""

    epilog = """\
examples:
  neurolens view -o view.html
  neurolens view petzval_portrait_100 laikin_double_gauss_50 -o two.html
  neurolens view my_lens.zmx runs/mine/models/ols-64.onnx -o mine.html
  neurolens view laikin_double_gauss_50 --ghosts -o flare.html"""
    kept = "nothing was written"
    alone = True

    lenses: tuple[Path, ...] = cli.lens((), models=True, positional=True, metavar="LENS|MODEL", nargs="*")
    out: Path = cli.output_path("FILE.html", "page (default: view.html)", Path("view.html"))
    downloads: Sequence[str] = setting(
        (), "files that the page offers, of glsl, onnx, c, osl (default: all; without a lens all but osl, which takes "
        "seconds a form, and a minute for a zoom, once). Where the page grows beyond 3 MB, or 40 kB a lens, the last "
        "are left out, those of exact lenses first", kind=cli.words_of(_DOWNLOADS, "glsl"), metavar="KINDS",
    )  # fmt: skip
    ghosts: bool = setting(
        False, "add a lamp that can be dragged and draws its ghosts, the 24 brightest of each LENS; needs a C compiler"
    )
    jobs: int = setting_of(Build, "jobs", Build.jobs)

    def assumed(self) -> Any:
        """Assume six lenses, in the forms that take less than a minute."""
        few = tuple(shipped() / "lenses" / f"{name}.toml" for name in _SIX)
        quick = tuple(kind for kind in _DOWNLOADS if kind != "osl")
        found = {"downloads": ("--downloads", lambda: (quick, ",".join(quick)))} if not self.lenses else {}
        return super().assumed() | found | {"lenses": ("LENS", lambda: (few, ", ".join(_SIX)))}

    def run(self) -> int:
        """Write the page."""
        entries = list(_named(self.lenses))
        for entry in entries:
            own = [kind_of(read_card(file)) for file in entry.models]
            if len(set(own)) < len(own):
                raise InputError("neurolens view", entry.key, f"({' and '.join(own)})", "one model of each kind")
        kinds, progress, made = (
            ["glsl", *(k for k in self.downloads or _DOWNLOADS if k != "glsl")],
            self.progress(),
            list[ViewLens](),
        )
        with TemporaryFolder() as place, warnings.catch_warnings():
            # The lens's own file has warned already.
            warnings.filterwarnings("ignore", re.escape(place), NeurolensWarning)
            entries = [_with_file(entry, Path(place) / str(number)) for number, entry in enumerate(entries)]
            shaders = _shaders(entries, self.jobs, progress) if "osl" in kinds else {}
            with progress.stage(f"{len(entries)} lenses") as report:
                for entry in entries:
                    made.append(_view_lens(entry, Path(place), kinds, shaders, self.ghosts))
                    report(len(made) / len(entries))
        return self.answer(Viewed(self.out, write_page(self.out, made, kinds), [lens.key for lens in made]))


@dataclass(frozen=True)
class Viewed(Report):
    """A page that was written."""

    file: Path
    page: Page = field(metadata=PART)
    lenses: Sequence[str]

    def text(self) -> str:
        """Return the page's file and size."""
        left = f"; left out for its size: {', '.join(self.page.left_out)}" if self.page.left_out else ""
        return f"{self.file}: {len(self.lenses)} lenses, {self.page.bytes / 1e6:.2f} MB{left}"


@dataclass(frozen=True)
class _Entry:
    """A lens with its models, in one state; `zoom` "range" is all of a zoom. `file` holds the lens for writers."""

    key: str
    models: Sequence[Path]
    lens: Lens | None
    zoom: str | None = None
    file: Path | None = None


def _with_file(entry: _Entry, folder: Path) -> _Entry:
    if entry.lens is None:
        return entry
    folder.mkdir()
    file = folder / f"{entry.lens.lens_id}.toml"
    lensfile.write_lens(entry.lens, file)
    return replace(entry, file=file)


def _shaders(entries: Sequence[_Entry], jobs: int, progress: Progress) -> Mapping[Path, str]:
    """Return the OSL of lens files and models; a warning names those that cannot be OSL, which are left out."""
    zooms = {e.file: e.zoom for e in entries if e.file is not None}
    files = [*zooms, *(model for entry in entries for model in entry.models)]
    with progress.stage("shaders") as report:
        forms, left = forms_of(files, min(jobs, len(files)), report, zooms)
    for file, why in left.items():
        warnings.warn(f"no OSL: {why.replace(str(file), file.name)}", NeurolensWarning, stacklevel=2)
    return {file: form.osl for file, form in forms.items()}


def _named(paths: Sequence[Path]) -> Iterator[_Entry]:
    """Yield lenses in the order of their first word; models join the lens of their id, and replace the library's."""
    lenses, models = dict[str, Lens | None](), dict[str, list[Path]]()
    for path in paths:
        if is_model(path):
            lens_id = str(read_card(path)["lens"]["id"])
            lenses.setdefault(lens_id, None)
            models.setdefault(lens_id, []).append(path)
        else:
            lens = read_any(path)
            lenses[lens.lens_id] = lens
    folder, ships = shipped() / "lenses", shipped() / "models"
    for lens_id, one in lenses.items():
        own = models.get(lens_id, [])
        # A lens of the library brings its models.
        ours = one is not None and Path(one.path).resolve().parent == folder.resolve()
        if ours and not own and any(ships.glob(f"{lens_id}.*.onnx")):
            ((own, _),) = library(ships, folder, [lens_id])
        yield _Entry(lens_id, own, one, RANGE if any(read_card(m).get("states") for m in own) else None)


def _view_lens(
    entry: _Entry, folder: Path, kinds: Sequence[str], shaders: Mapping[Path, str], with_ghosts: bool
) -> ViewLens:
    """Return a lens of the page.

    Raises:
        InputError: models of another state, or a lens without any model that the exact tracer's code cannot hold.
    """
    forms = [_model_form(file, folder, kinds, shaders.get(file)) for file in entry.models]
    section: dict[str, Any] = {}
    path, squeeze, ghosts = None, 1.0, None
    if entry.lens is not None and entry.file is not None:
        lens = set_lens(entry.lens) if entry.zoom == RANGE else set_lens(entry.lens, zoom=entry.zoom)
        try:
            forms.append(_exact_form(entry.zoom, entry.file, lens, kinds, shaders.get(entry.file)))
            path = path_glsl(lens, pupil_plane_z_mm(lens), LIGHT_NM) if entry.zoom != RANGE else None
        except NeurolensError:
            if not forms:
                raise  # a model of the lens stands in for it
        section, squeeze = section_svg(replace(layout_profile(Scene(lens, axis="y")), rays=())), squeeze_of(lens)
        ghosts = ghosts_glsl(lens, image_radius_mm(lens)[0], _GHOSTS) if with_ghosts else None
    best, focal_mm = forms[0], [float(f.card["efl_mm"]) for f in forms]
    if entry.zoom != RANGE and max(focal_mm) - min(focal_mm) > _SAME * abs(focal_mm[0]):
        raise InputError("neurolens view", f"{entry.key}: efl_mm", focal_mm, "models of this lens file, at one zoom")
    return ViewLens(
        entry.key, str(best.card["name"]), str(best.card["source"]), float(best.card["efl_mm"]),
        min(float(f.card["film_radius_mm"]) for f in forms), squeeze, best.card["f_numbers"],
        max(float(f.card["nearest_m"]) for f in forms), section, path, forms, ghosts,
    )  # fmt: skip


def _model_form(file: Path, folder: Path, kinds: Sequence[str], osl: str | None) -> Form:
    loaded = load_model(file)
    card, domain, errors = loaded.card, loaded.card["domain"], loaded.card["errors"]
    if any(axis.name != "zoom" for axis in loaded.axes):
        raise InputError(file, "states", [axis.name for axis in loaded.axes], "a zoom, or a model of one state")
    extras, notes = model_extras(loaded)
    written = [
        export_source(loaded.file.nodes, folder / f"model.{to}", to, card, extras=extras, notes=notes)
        for to in ("glsl", "c")
        if to in kinds
    ]
    states = [node["lens"] for node in card["states"]["nodes"]] if card.get("states") else [card["lens"]]
    facts = {
        **{key: card["lens"][key] for key in ("name", "source", "efl_mm")},
        "film_radius_mm": domain["film_radius_mm"],
        "nearest_m": domain["focus_m"][1],
        "f_numbers": [(float(lens["efl_mm"]), float(lens["f_number"])) for lens in states],
        "errors": {key: errors[key] for key in _ERRORS if isinstance(errors.get(key), (int, float))},
        "zones": errors.get("zones") or {},
        "poor": list(errors.get("poor") or ()),
    }
    return _form(kind_of(card), str(card["fit"]["method"]), written, facts, {"onnx": file.read_bytes()}, osl)


def _exact_form(zoom: str | None, file: Path, lens: Lens, kinds: Sequence[str], osl: str | None) -> Form:
    shot = Shot.part(zoom=zoom)
    written = [write_lens(file, file.with_suffix(f".{to}"), to, shot) for to in ("glsl", "c") if to in kinds]
    data = first_order(lens)
    facts = {
        "name": lens.name, "source": lens.source, "efl_mm": float(data.efl_mm),
        "film_radius_mm": image_radius_mm(lens)[0],
        "nearest_m": _NEAR_EFL * abs(float(data.efl_mm)) / 1000 * 1.05,
        "f_numbers": [(float(data.efl_mm), float(data.f_number))],
        "errors": {}, "zones": {}, "poor": [],
    }  # fmt: skip
    return _form("exact", "every surface traced", written, facts, {}, osl)


def _form(
    kind: str, method: str, written: Sequence[Written], facts: dict[str, Any], files: dict[str, bytes], osl: str | None
) -> Form:
    glsl, *others = written
    files |= {w.path.suffix.removeprefix("."): w.path.read_bytes() for w in others}
    files |= {} if osl is None else {"osl": osl.encode()}
    return Form(kind, method, glsl.path.read_text("utf-8"), glsl.signature, facts, files)
