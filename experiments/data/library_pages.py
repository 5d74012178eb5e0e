"""Pages of lenses, one for each, and an index that searches and sorts.

A page has the section, spots, MTF, distortion, vignetting, colour, breathing and bokeh at three points of the field,
the models with error and cost, the source and what is doubtful about it; the index has search, sorted by year, focal
length, speed, error and character. A lens whose page is there, from the same file by the same version, is kept.
"""

from __future__ import annotations

import argparse
import itertools
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

from neurolens.base.errors import InputError, NeurolensError
from neurolens.base.files import atomic_path, atomic_write_text, library, read_kept, safe_name, write_kept
from neurolens.base.find import CHARACTER, Entry, entries, said_of, words_of
from neurolens.base.lensname import lens_id_of
from neurolens.base.report import Report
from neurolens.cli.arguments import Reporting, lens, output_path

if TYPE_CHECKING:
    from neurolens.optics.lens.prescription import Lens

_SHOWN = {
    "layout": "Section", "spots": "Spots through focus", "mtf": "Geometric MTF",
    "mtf-height": "MTF against image height", "distortion": "Distortion", "vignetting": "Vignetting",
    "colour": "Colour",
}  # fmt: skip
_NO_FIELD = 0.2  # film radius over focal length at which a lens of unknown field is drawn
_COLOURS = 96  # in the palette of a picture


@dataclass(frozen=True, kw_only=True)
class Library(Reporting):
    """The lenses whose pages are written, and the folder."""

    called: ClassVar[str] = "experiments library"

    lenses: tuple[Path, ...] = lens((), " (default: all of lenses/)", positional=True, nargs="*")
    out: Path = output_path("FOLDER", "for the pages")

    def run(self) -> int:
        """Write the pages; 1 where a lens could not be shown."""
        from neurolens.optics.readers.any_format import lens_files

        folder = self.out
        files = self.lenses or lens_files(library() / "lenses")
        names = _page_names(files)
        folder.mkdir(parents=True, exist_ok=True)
        records = []
        with self.progress({"lenses": 12.0 * len(files)}).stage("lenses") as report:
            for k, file in enumerate(files):
                records.append(_record(file, folder / names[k]))
                report((k + 1) / len(files))
        atomic_write_text(folder / "index.html", _index(records))
        found = Pages(folder, sum(f.stat().st_size for f in folder.rglob("*") if f.is_file()), records)
        return self.answer(found, 1 if found.failed else 0)


@dataclass(frozen=True)
class Pages(Report):
    """The pages of a library, with a record of each lens."""

    folder: Path
    bytes: int
    lenses: list[dict[str, Any]]

    @property
    def failed(self) -> list[str]:
        """The lenses that could not be shown, with the reasons."""
        return [f"{record['lens']}: {record['fault']}" for record in self.lenses if "fault" in record]

    def text(self) -> str:
        """Return the index, its size, and what failed."""
        shown = len(self.lenses) - len(self.failed)
        return "\n".join([f"{shown} lenses, {self.bytes / 1e6:.1f} MB: {self.folder}/index.html", *self.failed])


OPTIONS = [Library.add_options]


def run(args: argparse.Namespace) -> int:
    """Write the pages; 1 where a lens could not be shown."""
    return Library.of(args).run()


def _page_names(files: Sequence[Path]) -> list[str]:
    """The folder of each file's page: the id of the lens, with a number if another file of the run has the same id."""
    names: list[str] = []
    for file in files:
        tries = (safe_name(f"{lens_id_of(file)}-{k}" if k > 1 else lens_id_of(file)) for k in itertools.count(1))
        taken = {"index.html", *(name.lower() for name in names)}  # many disks know no capitals
        names.append(next(name for name in tries if name.lower() not in taken))
    return names


def _record(file: Path, folder: Path) -> dict[str, Any]:
    """The row of a lens in the index. Its page is written to a folder, unless it is there already."""
    from neurolens import __version__
    from neurolens.studies.describe import read_quietly

    kept, named = folder / "record.json", {"lens": lens_id_of(file), "page": folder.name}
    try:
        lens = read_quietly(file)
        last = read_kept(kept)
        if last is not None and (last.get("sha256"), last.get("version")) == (lens.sha256, __version__):
            return last | named
        kept.parent.mkdir(parents=True, exist_ok=True)
        record = named | {"sha256": lens.sha256, "version": __version__} | _page(lens, file, kept.parent)
        write_kept(kept, record)
        return record
    except NeurolensError as error:
        return {"lens": file.stem, "page": None, "fault": str(error)}


def section_of(lens: Lens) -> Any:
    """The layout of a lens focused at infinity, with rays; an anamorphic one in y-z."""
    from neurolens.optics.analysis.fields import Scene
    from neurolens.optics.analysis.layout import layout_profile
    from neurolens.optics.lens.paraxial import first_order
    from neurolens.optics.setting.check import film_edge_mm
    from neurolens.optics.setting.pupils import image_radius_mm
    from neurolens.optics.setting.states import set_lens

    lens = set_lens(lens)
    edge = film_edge_mm(lens)
    if edge is None:
        no_field = _NO_FIELD * abs(first_order(lens).efl_mm)
        edge = no_field if lens.half_field_deg is None else image_radius_mm(lens)[0]
    return layout_profile(Scene(lens, math.inf, "y"), edge)


def _page(lens: Lens, file: Path, folder: Path) -> dict[str, Any]:
    """Draw a lens and write its page; returns what the index shows."""
    from neurolens.base.html import html
    from neurolens.cli.models import models_in
    from neurolens.optics.analysis.layout import thumbnail
    from neurolens.optics.readers.source import read_text
    from neurolens.optics.setting.check import check_lens
    from neurolens.studies import pages
    from neurolens.studies.describe import character_or_none, lens_row, rim_doubts

    row = lens_row(lens, check_lens(lens))
    figures, notes = [], []
    for name, title, draw in _drawings(lens):
        picture = folder / f"{name}.png"
        try:
            draw(picture)
        except InputError as error:
            notes.append(f"{title} is left out: {error}")
            continue
        _lessen(picture)
        figures.append({"file": picture.name, "title": title})
    models = [vars(m) for m in models_in(library() / "models") if m.lens == lens.lens_id]
    doubts = [*row["doubts"], *rim_doubts(lens), *notes]
    names = [Path(m["file"]).stem.removeprefix(f"{lens.lens_id}.") for m in models]
    page = html(
        "lens.html",
        title=lens.name,
        source=pages.flat({"designer": lens.designer or pages.DASH, "source": lens.source, "rims": lens.rims}),
        doubts=doubts,
        about=lens.notes,
        shown=pages.figures_of(folder, figures),
        models=pages.table(names, models, _model_columns()),
        file=read_text(file),
    )
    atomic_write_text(folder / "index.html", page)
    best = min((m["rms_um"] for m in models if m["rms_um"] is not None), default=None)
    keys = ("name", "year", "efl_mm", "f_number", "half_field_deg", "refractions", "states")
    times = [pages.number(m, "fused_ns_per_ray.min") or pages.number(m, "ns_per_ray.min") for m in models]
    fastest = min((t for t in times if t), default=None)
    more = {"ns": fastest, "designer": lens.designer, "rms_um": best, "doubts": doubts}
    more["character"], discs = character_or_none(lens)
    if discs is not None:
        more["discs"] = "discs.png"
        with atomic_path(folder / "discs.png") as part:
            part.write_bytes(discs)
    return {**{k: row[k] for k in keys}, **more, "layout": thumbnail(section_of(lens))}


def _drawings(lens: Lens) -> Iterator[tuple[str, str, Any]]:
    """Name and title of each drawing, and the function that draws it to a path."""
    from neurolens.cli.analyse import analysis_of
    from neurolens.optics.analysis.breathing import draw_breathing
    from neurolens.optics.analysis.fields import Scene
    from neurolens.optics.analysis.layout import state_text
    from neurolens.optics.analysis.spots import spots
    from neurolens.optics.setting.states import set_lens
    from neurolens.studies.describe import FIELDS, FOCUS

    scene = Scene(set_lens(lens, focus_m=math.inf, focus_mode="best"))

    def drawn(what: str) -> Any:
        def draw(path: Path) -> None:
            analysis = analysis_of(what)
            titles = () if what == "layout" else (lens.name, state_text(scene))
            analysis.draw(analysis.compute(scene), path, *titles)

        return draw

    def bokeh(path: Path) -> None:
        """Lights at infinity, the lens focused near; at three points of the field."""
        near = 1e-3 * FOCUS * abs(scene.first_order.efl_mm)
        edge = max(scene.default_fields())
        blurred = Scene(set_lens(lens, focus_m=near, focus_mode="best"))
        found = spots(blurred, [share * edge for share in FIELDS], rings=20, shift_mm=[0.0])
        analysis_of("spots").draw(replace(found, airy_um=math.nan), path, lens.name, f"focused at {near:.3g} m")

    yield from ((what, title, drawn(what)) for what, title in _SHOWN.items())
    yield "bokeh", "Bokeh: lights at infinity, the lens focused near", bokeh
    yield "breathing", "Breathing", lambda path: draw_breathing(lens, path)


def _lessen(picture: Path) -> None:
    """Reduce a picture to a palette, which takes a third of the bytes."""
    from PIL import Image

    with Image.open(picture) as image:
        small = image.convert("RGB").quantize(_COLOURS, dither=Image.Dither.NONE)
    with atomic_path(picture) as part:
        small.save(part, optimize=True)


def words_of_row(record: Mapping[str, Any]) -> str:
    """The words by which the page's search finds a lens: those of `neurolens find`, and its nicknames."""
    known = {entry.lens: entry for entry in entries()}
    entry = known.get(record["lens"]) or Entry.of(record["lens"], record)
    nicknames = words_of(" ".join(said_of(entry)))
    return " ".join(sorted({*entry.words, *nicknames}))


def _model_columns() -> tuple[Any, ...]:
    from neurolens.studies.pages import Column

    return (
        Column("RMS (µm)", "rms_um", about="film-equivalent, rays held out, whole domain"),
        Column("RMS (px)", "rms_px", about="of a picture 4000 pixels wide"),
        Column("direction (°)", "direction_rms_deg", about="root mean square"),
        Column("onnxruntime (ns)", "ns_per_ray.min", about="a ray, one core"),
        Column("as C (ns)", "fused_ns_per_ray.min", about="a ray, one core, compiled"),
        Column("kB", "bytes", 1e-3),
    )


def _index(records: Sequence[Mapping[str, Any]]) -> str:
    """All lenses in a table with thumbnails, which searches and sorts by itself."""
    from neurolens.base.html import html
    from neurolens.studies.pages import Column

    columns = (
        Column("year", "year", digits=4), Column("f (mm)", "efl_mm", digits=4), Column("f-number", "f_number"),
        Column("half field (°)", "half_field_deg"), Column("refractions", "refractions"), Column("states", "states"),
        Column("fastest model (ns)", "ns", about="a ray, one core, as C where that was timed"),
        Column("best model (µm)", "rms_um", about="film-equivalent RMS"),
        *(Column(heading, f"character.{figure}") for figure, heading in CHARACTER.values()),
    )  # fmt: skip
    missing = {"fault": "", "designer": "", "layout": "", "discs": "", "doubts": ()}
    rows = [{"name": r["lens"], **missing, **r, "words": words_of_row(r)} for r in records]
    return html("library.html", title="Lenses", records=rows, columns=columns)
