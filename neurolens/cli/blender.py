"""`neurolens blender`: the extension for Blender, packed with lenses, and lenses of your own in it.

Shaders and facts of lenses are kept between runs, so that an interrupted `neurolens blender build` goes on where it
was. A kept file is named by what it is made from: the model or lens file, the zoom's state, and the code.
"""

import io
import math
import os
import time
from base64 import b64decode, b64encode
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, suppress
from dataclasses import asdict, dataclass, field, replace
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

import neurolens
from neurolens.base.errors import InputError, NeurolensError, warn
from neurolens.base.files import fingerprint_of, kept_in_cache, library as shipped, safe_name, sha256_of
from neurolens.base.lensname import is_model, lens_id_of, maker_of
from neurolens.base.report import BULK, Report
from neurolens.base.settings import RANGE, setting
from neurolens.base.tasks import Failed, Here, Processes, run_each
from neurolens.base.tomlfile import suggestion
from neurolens.cameras.build import ideal_as, make_camera
from neurolens.cameras.exact import ExactCamera
from neurolens.cameras.field import spectrum_of
from neurolens.cameras.shaders.blender_shader import shader_of
from neurolens.cli import arguments as cli
from neurolens.models.card import read_card
from neurolens.optics.lens.paraxial import first_order
from neurolens.optics.lens.prescription import Lens
from neurolens.optics.lens.shot import Shot
from neurolens.optics.readers.any_format import read_any
from neurolens.optics.readers.lensfile import read_lens
from neurolens.optics.setting.states import set_lens
from neurolens.programs.blender import Form, PackedLens, add_lens, check_takes, user_folders, write_pack

_KEPT = 4096  # kept files, of some 30 kB each, five for a lens
# of a thumbnail: size in inches and dots per inch, which make 256 pixels; its side over the glass's; its colours
_SIDE_IN, _DOTS, _MARGIN, _COLOURS = 2.56, 100, 1.08, 64
# of a field: shares of the picture's radius; nearest object in focal lengths
_RADII, _NEAR = (0.0, 0.35, 0.6, 0.8, 0.97), 20.0
Forms = dict[Path, Form]


@dataclass(frozen=True, kw_only=True)
class Blender(cli.Command):
    """Real lenses as cameras of Blender's Cycles (4.5 and later): an extension with a panel at the
    camera's data, where a lens is put on with one click and taken off with one."""

    epilog = "examples:\n  neurolens blender build --lens laikin_double_gauss_50 -o neurolens.zip"

    @classmethod
    def add_options(cls, parser: cli.Parser) -> None:
        """Add the command's actions to its parser."""
        actions = parser.add_subparsers(metavar="ACTION", required=True, parser_class=cli.Parser)
        Build.fill(actions.add_parser("build", help="pack the extension as a zip"))
        Add.fill(actions.add_parser("add", help="put a lens into the extension"))


@dataclass(frozen=True, kw_only=True)
class Build(cli.Reporting):
    """Pack the extension with a folder of models and with the lens files of the folder lenses/ beside it: of each
    lens the best polynomial, the best network and the exact lens, every surface traced.
    What cannot be a shader is left out, and named.

    Finished lenses are kept: a build that was stopped goes on where it was, and a second one is quick.

    Install it in Blender: Edit > Preferences > Get Extensions > Install from Disk."""

    kept = "no zip was written; finished shaders are kept for the next run"
    called = "neurolens blender build"
    epilog = Blender.epilog

    out: Path = cli.output_path("OUT.zip", "zip to write (default: neurolens.zip)", Path("neurolens.zip"))
    models: Path | None = setting(None, "folder of models (default: those that ship)", metavar="DIR")
    lens: tuple[str, ...] = setting(
        (), "only this lens, repeatable: LENS of LENS.ols-64.onnx or of LENS.toml (default: all)", metavar="LENS"
    )
    no_exact: bool = setting(False, "leave exact lenses out")
    jobs: int = setting(
        min(8, os.cpu_count() or 1),
        "processes that make shaders, each of a core and 0.5 GB (default: all cores, at most 8)", within=(1, 64),
    )  # fmt: skip

    def run(self) -> int:
        """Pack the extension."""
        folder = self.models or shipped() / "models"  # of the installation as it is now
        if not folder.is_dir():
            self.refuse("--models", str(folder), "a folder of models that exists")
        began, packed = time.perf_counter(), []
        lens_folder = folder.parent / "lenses"
        if lens_folder.is_dir():
            import torch  # noqa: F401 - traces the lenses; if it is missing, that is said before shaders are made
        places = list(library(folder, lens_folder, self.lens))
        if not places:
            self.refuse("--models", str(folder), "a folder with models (.onnx)")
        exact = [lens_file for _, lens_file in places if lens_file is not None and not self.no_exact]
        files = [*exact, *(file for models, _ in places for file in models)]  # those that take longest go first
        progress = self.progress()
        with progress.stage("shaders") as report:
            forms, left = forms_of(files, self.jobs, report)
        with progress.stage("thumbnails") as report:
            for models, lens_file in places:
                own = [f for f in (*models, lens_file) if f is not None and f in forms]
                if own:
                    lens = stated_lens(own[0], lens_folder) if lens_file is None else read_any(lens_file)
                    packed.append(packed_of(own, [forms[f] for f in own], lens=lens))
                report(len(packed) / len(places))
        for why in left.values():
            warn(f"left out: {why}")
        if not packed:
            self.refuse("--models", str(folder), "a folder with a model for a shader")
        write_pack(self.out, packed)
        shaders = {p.lens_id: [f.model or f.kind for f in p.forms] for p in packed}
        left_out, seconds = {file.name: why for file, why in left.items()}, time.perf_counter() - began
        return self.answer(Packed(self.out, self.out.stat().st_size, shaders, left_out, seconds))


@dataclass(frozen=True)
class Packed(Report):
    """A packed extension, with the shaders of each lens and the files that are left out."""

    file: Path
    bytes: int
    lenses: Mapping[str, Sequence[str]]
    left_out: Mapping[str, str]
    seconds: float

    def text(self) -> str:
        """Return the file and how much is in it."""
        count, shaders = len(self.lenses), sum(map(len, self.lenses.values()))
        return f"{self.file}: {count} lens{'es' * (count > 1)}, {shaders} shader{'s' * (shaders > 1)}"


@dataclass(frozen=True, kw_only=True)
class Add(cli.Reporting):
    """Put a model (.onnx) or a lens file of any format into the extension: into the user folder of an installed
    one (the newest Blender of this machine that has it), or into a zip. A form of a lens replaces the one
    that was there. In Blender, "Read Lenses Again" in the panel shows it."""

    kept = "nothing was added"
    called = "neurolens blender add"
    epilog = "examples:\n  neurolens blender add laikin_double_gauss_50.ols-36 --extension neurolens.zip"

    file: Path = cli.lens(models=True, positional=True)
    extension: Path | None = setting(
        None, "a packed extension, or a user folder of one", metavar="ZIP|DIR", old=("to",)
    )
    zoom: str | None = setting(
        None, "state of a zoom, by name or focal length in mm; range: a setting", metavar="STATE"
    )

    def run(self) -> int:
        """Add a lens."""
        to = self.extension or next(iter(user_folders()), None)
        if to is None:
            expected = "a zip or a folder: no Blender of this machine has the extension installed"
            self.refuse("--extension", "(missing)", expected)
        check_takes(to)
        lens = packed_of([self.file], [form_of(self.file, zoom=self.zoom, quiet=self.quiet)], zoom=self.zoom)
        add_lens(to, lens)
        return self.answer(Added(lens.lens_id, to, [f.model or f.kind for f in lens.forms], lens.name))


@dataclass(frozen=True)
class Added(Report):
    """A lens that was put into an extension; `name` is its name for people."""

    lens: str
    to: Path
    forms: Sequence[str]
    name: str = field(metadata=BULK)

    def text(self) -> str:
        """Say which lens, in which forms, the extension has now."""
        return f"{self.name} ({', '.join(self.forms)}) is in {self.to}"


def form_of(file: Path, *, zoom: str | None = None, quiet: bool = False) -> Form:
    """Return the shader of a model (.onnx) or of a lens file, with its facts, kept between runs; see `shader_of`.

    Raises:
        InputError: the lens cannot be a shader.
        ModelError: the model is broken.
    """
    return Form(**_kept(file, zoom, make=lambda: asdict(_made_form(file, zoom, quiet))))


def _made_form(file: Path, zoom: str | None, quiet: bool) -> Form:
    shader = shader_of(file, zoom=zoom, quiet=quiet)
    kind, model, error, poor = "exact", "", None, []
    if is_model(file):
        card = read_card(file)
        kind, model, error = kind_of(card), str(card["fit"]["method"]), float(card["errors"]["rms_um"])
        poor = list(card["errors"].get("poor") or ())
    state = None if zoom == RANGE else zoom
    notes = [*shader.notes] if state is None else [*shader.notes, f"The zoom stands at {state}"]
    if (squeeze := _squeeze(file, state)) != 1.0:
        axis, aspect = ("Y", squeeze) if squeeze > 1 else ("X", 1 / squeeze)
        side = "across" if squeeze > 1 else "in height"
        notes.append(f"The picture is squeezed {aspect:.3g} times {side}: an Aspect {axis} of {aspect:.3g} undoes it")
    return Form(
        kind, model, shader.text, error, shader.film_radius_mm, shader.f_number, shader.nearest_m, poor, notes
    )  # fmt: skip


def _kept(file: Path, *more: str | None, make: Callable[[], dict[str, Any]]) -> dict[str, Any]:
    """Return a table that is made from a file and from `more`: the one that an earlier run kept, or a new one.

    The new one is kept if it can be.
    """
    return kept_in_cache(f"{fingerprint_of([_code(), file.name, sha256_of(file), *more])}.form", _KEPT, make)


@cache
def _code() -> list[str]:
    """Return the checksums of all files of the package, and of what else changes shaders."""
    root = Path(neurolens.__file__).parent
    files = [f for f in sorted(root.rglob("*")) if f.is_file() and f.suffix != ".pyc"]
    return [*(f"{f.relative_to(root)} {sha256_of(f)}" for f in files), np.__version__, str(find_spec("torch") is None)]


def _squeeze(file: Path, zoom: str | None) -> float:
    """Return the squeeze of a file's lens, see `cameras.sampling.lens_state`."""
    if not is_model(file):
        return squeeze_of(set_lens(read_any(file), zoom=zoom))
    return float(
        make_camera(file, Shot((1.0, 1.0), math.inf, zoom=zoom, runtime="onnxruntime")).settings["lens_state"][
            "squeeze"
        ]
        or 1.0
    )


def squeeze_of(lens: Lens) -> float:
    """Return how many times an anamorphic lens squeezes its picture across; 1 for other lenses."""
    if not lens.anamorphic:
        return 1.0
    return abs(float(first_order(lens).efl_mm / first_order(lens, meridian="x").efl_mm))


def forms_of(
    files: Sequence[Path], jobs: int, report: Callable[[float], object],
    zooms: Mapping[Path, str | None] = MappingProxyType({}),
) -> tuple[Forms, dict[Path, str]]:  # fmt: skip
    """Make the forms of many files in `jobs` processes; return them, and why other files have none.

    Args:
        zooms: the `zoom` of `form_of`, for files that have one.

    Raises:
        NeurolensError: a process ended early, as where memory is short.
    """
    forms: Forms = {}
    left: dict[Path, str] = {}
    tasks = [(file, zooms.get(file)) for file in files]
    with Here() if jobs == 1 else Processes(jobs) as executor:
        for done, ((file, _), made) in enumerate(run_each(executor, _form_or_why, tasks), start=1):
            if isinstance(made, Failed):
                raise NeurolensError(f"{file}: {made.reason} ({jobs} jobs: where memory is short, try --jobs 1)")
            if isinstance(made, Form):
                forms[file] = made
            else:
                left[file] = made
            report(done / len(files))
    return forms, left


def _form_or_why(task: tuple[Path, str | None]) -> Form | str:
    """Return the form of a file and a zoom, or why the lens cannot be a shader."""
    file, zoom = task
    with ExitStack() as stack:
        if find_spec("torch") is not None:
            from neurolens.models.terms import pinned_threads

            stack.enter_context(pinned_threads())
        try:
            return form_of(file, zoom=zoom, quiet=True)
        except NeurolensError as error:
            return str(error)


def packed_of(
    files: Sequence[Path], forms: Sequence[Form], *, lens: Lens | None = None, zoom: str | None = None
) -> PackedLens:
    """Make a lens of the menu from files of one lens and their forms.

    Args:
        lens: its prescription, for the thumbnail, where it is at hand.
    """
    first, ranged = files[0], zoom == RANGE
    if is_model(first):
        card = read_card(first)
        facts, axes = card["lens"], [axis["name"] for axis in (card.get("states") or {}).get("axes", ())]
        ranged = zoom in (None, RANGE) and "zoom" in axes
        name, efl, f_number = facts["name"], facts["efl_mm"], facts["f_number"]
        source = str(facts.get("source") or "") if lens is None else lens.source  # the file may name it better by now
        name = f"{name}, any zoom" if ranged else name
    else:
        lens = set_lens(read_any(first), zoom=None if zoom == RANGE else zoom)
        data = first_order(lens)
        name, efl, f_number, source = lens.name, data.efl_mm, data.f_number, lens.source
    picture, table, own = None if lens is None else thumbnail(lens), None, dict[str, Any]()
    designer = facts.get("designer") if lens is None else lens.designer
    if lens is not None and find_spec("torch") is not None:
        name = f"{lens.believed_to_be}, any zoom" if lens.believed_to_be and ranged else lens.believed_to_be or name
        own = _kept(Path(lens.path), "character", str(float(efl)), make=lambda: _character(lens))
    if lens is not None and forms and not ranged:
        radius = min(form.film_radius_mm for form in forms)
        more = str(first_order(lens).efl_mm), str(radius)
        table = _kept(Path(lens.path), "field", *more, make=lambda: {"table": field_table(lens, radius)})["table"]
    return PackedLens(
        key_of(first), str(name), float(efl), float(f_number), source, picture, list(forms), table,
        maker_of(str(designer or "")), own.get("character"), b64decode(own["bokeh"]) if own.get("bokeh") else None,
    )  # fmt: skip


def _character(lens: Lens) -> dict[str, Any]:
    from neurolens.studies.describe import character_or_none

    figures, discs = character_or_none(lens)
    return {"character": figures, "bokeh": None if discs is None else b64encode(discs).decode()}


def stated_lens(model: Path, lenses: Path) -> Lens | None:
    """Return the lens behind a model, scaled and zoomed as the model is, or over its range; None without a file."""
    facts = read_card(model)["lens"]
    file = lenses / f"{safe_name(facts['id'])}.toml"
    if not file.is_file():
        return None
    lens, efl = read_lens(file), float(facts["efl_mm"])
    if math.isclose(first_order(lens).efl_mm, efl, rel_tol=1e-3):
        return lens
    return set_lens(lens, zoom=str(efl)) if lens.configurations else set_lens(lens, focal_length_mm=efl)


def field_table(lens: Lens, radius_mm: float) -> dict[str, Any] | None:
    """Return the field of a lens wide open, for `extension.library.Field`; None where it cannot be traced."""
    if find_spec("torch") is None:
        return None
    from neurolens.studies.plan import footprints as prints

    film, radii = (2 * radius_mm, 2 * radius_mm), radius_mm * np.array(_RADII)
    points = np.stack([radii, np.zeros_like(radii)])
    near = round(_NEAR * float(first_order(lens).efl_mm) / 1000, 6)
    rows: dict[str, list[Any]] = {"distortion_um": [], "blur_um": [], "light": []}
    with suppress(InputError):
        for focus in (math.inf, near):
            camera = ExactCamera(lens, Shot(film, focus, runtime="onnxruntime"))  # it takes few rays
            nm, share = spectrum_of(camera)
            share = share / share.sum()
            places = prints.places_of(camera, points, np.full(radii.size, focus), nm, share)
            if places.film_mm.shape[1] < radii.size:
                return None  # dark at the edge
            thin = ideal_as("thin:", camera.lens, Shot(film, focus))
            seen, ideal = (prints.footprints(c, places) for c in (camera, thin))
            rows["distortion_um"].append(1e3 * prints.effects_mm(seen, ideal, share)["distortion"])
            rows["blur_um"].append(1e3 * math.sqrt(2) * prints.blur_mm(seen, share))
            rows["light"].append(seen.light / seen.light[0])
        table = {name: [[float(f"{v:.4g}") for v in row] for row in both] for name, both in rows.items()}
        return {"radius_mm": [round(float(r), 4) for r in radii], "near_m": near, **table}
    return None


def key_of(file: Path) -> str:
    """Return the name of a lens in the menu's files: NAME of a model NAME.ols-64.onnx, or of a lens file NAME.toml."""
    return file.name.split(".")[0] if is_model(file) else lens_id_of(file)


def library(folder: Path, lenses: Path, chosen: Sequence[str]) -> Iterator[tuple[list[Path], Path | None]]:
    """Yield for every lens its best polynomial and best network among models, and its lens file, if it has one.

    A lens file without a model is a lens as well.

    Args:
        folder: of models.
        lenses: of lens files.
        chosen: names of lenses; all if empty.

    Raises:
        InputError: a name that no model and no lens file has.
    """
    known: dict[str, dict[str, tuple[float, Path]]] = {}
    modelled = set()
    for file in sorted(folder.glob("*.onnx")):
        card = read_card(file)
        modelled.add(card["lens"]["id"])
        kind, mine, error = kind_of(card), known.setdefault(key_of(file), {}), float(card["errors"]["rms_um"])
        if kind not in mine or error < mine[kind][0]:
            mine[kind] = error, file
    if known:  # a folder without a model is not the folder that was meant
        known |= {file.stem: {} for file in sorted(lenses.glob("*.toml")) if file.stem not in {*known, *modelled}}
    for name in chosen:
        if name not in known:
            near = suggestion(name, list(known))
            raise InputError("neurolens blender build", "--lens", name, f"a lens of {folder} or {lenses}{near}")
    for key, kinds in known.items():
        if not chosen or key in chosen:
            lens_file = lenses / f"{key}.toml"
            files = [kinds[kind][1] for kind in ("polynomial", "network") if kind in kinds]
            yield files, lens_file if lens_file.is_file() else None


def thumbnail(lens: Lens) -> bytes | None:
    """Draw the section of a lens as a PNG of 256 by 256 pixels; None where torch or matplotlib is missing."""
    if find_spec("torch") is None or find_spec("matplotlib") is None:
        return None
    from PIL import Image

    from neurolens.optics.analysis.fields import Scene
    from neurolens.optics.analysis.layout import draw_section, layout_profile
    from neurolens.optics.analysis.plots import new_figure, style

    with style():
        figure = new_figure(_SIDE_IN, _SIDE_IN)
        figure.set_layout_engine("none")
        axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))
        layout = layout_profile(Scene(set_lens(lens), axis="y"))
        layout = replace(layout, rays=tuple(ray for ray in layout.rays if ray.field != 1))  # of the axis and the edge
        draw_section(axes, layout, lw=0.5)
        # the glass fills the picture, for menus show it small
        arcs = np.concatenate([s.arc() for s in layout.surfaces])
        z, height = (arcs.min(0) + arcs.max(0)) / 2, np.ptp(arcs, 0)
        half = _MARGIN * max(height) / 2
        axes.set(xlim=(z[0] - half, z[0] + half), ylim=(-half, half))
        axes.set_axis_off()
        buffer = io.BytesIO()
        figure.savefig(buffer, format="png", dpi=_DOTS, facecolor="white", metadata={"Software": None})
    small = io.BytesIO()
    Image.open(buffer).convert("RGB").quantize(_COLOURS, dither=Image.Dither.NONE).save(small, "png", optimize=True)
    return small.getvalue()


def kind_of(card: Mapping[str, Any]) -> str:
    """Return whether a card's model is a "network" or a "polynomial"."""
    family = str(card["fit"]["settings"].get("method", card["fit"]["method"]))
    return "network" if family.startswith("mlp") else "polynomial"
