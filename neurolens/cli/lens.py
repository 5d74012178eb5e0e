"""`neurolens lens FILE`: what a lens file holds, computed and drawn; many files as a table; rims by a rule."""

from __future__ import annotations

import math
import time
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from neurolens.base.errors import one_line, warned
from neurolens.base.files import library, sha256_of
from neurolens.base.find import CHARACTER, read_index
from neurolens.base.lensname import resolve
from neurolens.base.report import BULK, OPTIONAL, PART, Report
from neurolens.base.settings import changed, setting
from neurolens.cli import arguments as cli
from neurolens.optics.readers.any_format import lens_files, read_any
from neurolens.optics.setting.states import focus_mode_of, focus_of, set_lens

if TYPE_CHECKING:
    from neurolens.optics.analysis.breathing import Breath
    from neurolens.optics.setting.rims import Rim
    from neurolens.studies.describe import LensFacts, SurfaceRow

_SORTS = {"maker": "maker", "focal-length": "efl_mm", "speed": "f_number", "year": "year"}
_Sort = Literal["maker", "focal-length", "speed", "year", "cats-eye", "swirl", "bubbles", "softness", "flare"]


@dataclass(frozen=True, kw_only=True)
class Lens(cli.Figures):
    """Print what follows from a lens file: focal length, pupils, film plane, image circle, how much light gets through
    and what stops the rest, and what is doubtful about the file. The lens is focused at infinity, with its widest
    stop.

    Several files, or folders (of all formats that "neurolens convert" reads), are
    a table with one line for each lens, in milliseconds a lens; after the word "list" each of them is
    checked, too. --derive-rims computes the rim diameters that a patent does not print.

    Lengths are in mm along the axis, z = 0 at the front vertex, light travelling to +z; angles
    are from the axis in degrees; first-order data is for the d line (587.56 nm). Needs the extra
    "train" (torch)."""

    epilog = """\
examples:
  neurolens lens laikin_double_gauss_50
  neurolens lens brendel_tessar_100 --focal-length 50 --focus 1.5 --layout tessar.png
  neurolens lens ogawa_zoom_70_200 --zoom 135mm --json
  neurolens lens downloads/ --json
  neurolens lens list --sort swirl
  neurolens lens brendel_tessar_100 --derive-rims -o tessar.toml"""
    kept = "only a finished --layout picture is written"
    intermixed = True

    files: tuple[Path, ...] = setting(
        ..., 'lens files, names of lenses/, or folders; after the word "list" they are checked (default: those that '
        "ship)", positional=True, metavar="FILE", nargs="+",
    )  # fmt: skip
    state: cli.LensState = cli.lens_state()
    layout: Path | None = cli.plot_path(
        "draw the lens with rays from three field points: axis, 70% and edge of the film"
    )
    breathing: Path | None = cli.plot_path("draw field of view, focal length, magnification against the focus distance")
    sort: _Sort | None = setting(
        None, "order of several files; the last five are figures of bokeh and flare, the strongest first, which "
        "take seconds for a lens that is not of lenses/", common=True,
    )  # fmt: skip
    derive_rims: bool = setting(
        False, "compute the diameters from the f-number and the field, and print them beside those of the file",
        title="rims", common=True,
    )  # fmt: skip
    edge_pupil: float | None = setting(
        None, "share of the pupil's height that is kept at the edge of the field (default: 0.5)", within=(0.01, 1),
        unit="a share", metavar="SHARE", old=("vignetting",), title="rims",
    )  # fmt: skip
    half_field: float | None = setting(
        None, "edge of the field, in degrees from the axis (default: as the file states)", within=(0.01, 179),
        unit="an angle in degrees", metavar="DEG", title="rims",
    )  # fmt: skip
    out: Path | None = cli.output_path("OUT.toml", "write the lens with its derived rims", None, "rims")

    def run(self) -> int:
        """Print and draw the data of a lens, or the table of several, or derived rims."""
        checked = str(self.files[0]) == "list"
        several = checked or len(self.files) > 1 or self.files[0].is_dir()
        self._check_mode(several)
        if several:
            return self._list(self.files[1:] or (library() / "lenses",) if checked else self.files, checked)
        return self._derive(_file(self.files[0])) if self.derive_rims else self._describe(_file(self.files[0]))

    def _check_mode(self, several: bool) -> None:
        """Refuse the options of other modes."""
        rims = {"--derive-rims", "--edge-pupil", "--half-field", "--output"}
        if several:
            modes, allowed = "with one lens file", {"--sort"}
        elif self.derive_rims:
            modes, allowed = "with one lens file alone", rims
        else:
            modes, allowed = "with --derive-rims", {*changed(self.state), "--layout", "--breathing"}
        for option in changed(self):
            if option not in allowed | {"--csv", "--glass", "--json", "--quiet"}:
                where = 'with "list", a folder or several files' if option == "--sort" else modes
                self.refuse(option, "(given)", f"this option only {where}")

    def _describe(self, file: Path) -> int:
        """Print and draw one lens."""
        from neurolens.models.pairs import domain_of
        from neurolens.studies.describe import file_doubts, glass_table, lens_facts
        from neurolens.studies.plots import layout_profile

        began = time.perf_counter()
        with warned(file) as notes:
            tabled = read_any(file)
            lens = set_lens(tabled, shot := self.state.shot())
        focus, film_z = focus_of(lens, shot), float(lens.film_z_mm or 0.0)
        domain = domain_of(lens, focus_m=(focus, focus), film_z_mm=(film_z, film_z))
        facts = lens_facts(lens, domain)
        breathing: dict[str, list[Breath]] | None = None
        if self.layout is not None:
            from neurolens.optics.analysis.layout import lens_layout

            lens_layout(layout_profile(lens, domain), self.layout)
        if self.breathing is not None:
            from neurolens.optics.analysis.breathing import draw_breathing

            breathing = draw_breathing(lens, self.breathing)
        found = Described(
            file=str(file),
            facts=replace(facts, warnings=list(dict.fromkeys([*facts.warnings, *notes, *file_doubts(tabled)]))),
            zoom=self.state.given.zoom,
            focus_mode=focus_mode_of(lens, shot),
            derived=lens.derived,
            aperture=None if lens.aperture is None else lens.aperture.settings(),
            configurations=[State(c.name, c.efl_mm, c.object_distance_mm) for c in tabled.configurations],
            surfaces=glass_table(lens),
            layout=self.layout,
            breathing_plot=self.breathing,
            breathing=breathing,
            seconds=time.perf_counter() - began,
        )
        return self.answer(found)

    def _list(self, paths: tuple[Path, ...], checked: bool) -> int:
        """Print a table of lenses."""
        files = [file for path in paths for file in (lens_files(path) if path.is_dir() else [_file(path)])]
        return self.answer(ListedLenses(self._rows(files, checked), self.sort))

    def _rows(self, files: list[Path], checked: bool) -> list[dict[str, Any]]:
        """`studies.describe.library_row` of each lens, in the order of --sort; the library's index has some of them."""
        index = read_index() if checked and not self.glass else {}
        rows = {file: row for file in files if (row := kept_row(file, index))}
        left = [file for file in files if file not in rows]
        if left:
            from neurolens.studies.describe import library_row

            with self.progress().stage(f"{len(left)} lenses") as report:
                for done, file in enumerate(left, start=1):
                    rows[file] = library_row(file, checked, self.sort in CHARACTER)
                    report(done / len(left))
        found = [rows[file] for file in files]
        return found if self.sort is None else sorted(found, key=partial(_place, self.sort))

    def _derive(self, file: Path) -> int:
        """Print the table of rims; write the lens with derived rims only where -o asks for it."""
        from neurolens.optics.readers.lensfile import write_lens
        from neurolens.optics.setting.rims import RimRule, derive_rims, half_field_deg
        from neurolens.studies.describe import read_quietly

        lens = read_quietly(file)
        rule = RimRule(0.5 if self.edge_pupil is None else self.edge_pupil, half_field_deg=self.half_field)
        derived, rims = derive_rims(lens, rule)
        edge = self.half_field or half_field_deg(lens)
        found = DerivedRims(
            file=str(file), f_number=lens.f_number, vignetting=rule.vignetting, clear_edge=rule.clear_edge,
            half_field_deg=edge, rims=rims, output=self.out, name=lens.name,
            marked=lens.rims, stop_surface=lens.stop_index,
        )  # fmt: skip
        if self.out is not None:
            said = (
                "Rims are derived by neurolens lens --derive-rims: the stop from the f-number, the whole axial beam, "
                f"{found.kept} kept at {edge:.4g} degrees, a clear edge of {100 * rule.clear_edge:g}%."
            )
            write_lens(replace(derived, notes=f"{derived.notes} {said}".strip()), self.out)
        return self.answer(found)


@dataclass(frozen=True, kw_only=True)
class DerivedRims(Report):
    """Rims that follow from the f-number and the field, beside those of the file.

    Attributes:
        vignetting: share of the pupil's height that is kept at the edge of the field.
        clear_edge: share of a diameter that is left free around the beams.
        output: the lens file that was written, if one was asked for.
        marked: how the file marks its own rims.
    """

    file: str
    f_number: float
    vignetting: float
    clear_edge: float
    half_field_deg: float
    rims: list[Rim]
    output: Path | None
    name: str
    marked: str
    stop_surface: int

    @property
    def kept(self) -> str:
        """Return in words what is kept at the edge of the field."""
        return f"{100 * self.vignetting:g}% of the pupil's height"

    def text(self) -> str:
        """Return a row for each rim."""
        rows = []
        for rim in self.rims:
            note = "trimmed: limited by a neighbour" if rim.trimmed else ""
            share = f"{100 * (rim.derived_mm / rim.tabled_mm - 1):+.1f}%"
            cells = (f"{v:.3f}" for v in (rim.tabled_mm, rim.axis_mm, rim.field_mm, rim.derived_mm))
            rows.append((str(rim.surface), *cells, share, "stop" if rim.surface == self.stop_surface else note))
        head = (
            f"{self.name}\nRims for f/{self.f_number:g} and {self.half_field_deg:.4g} degrees half field, where "
            f"{self.kept} is kept; diameters in mm; those of the file are marked as {self.marked}."
        )
        header = ("surface", "in the file", "axial beam", "field", "derived", "change", "")
        tail = f"Written to {self.output}" if self.output else "Nothing is written without -o OUT.toml"
        return "\n\n".join([head, cli.table(header, rows), tail])


def _file(name: Path) -> Path:
    """The lens file that an argument names."""
    file = resolve(name, models=False, cameras=False).file
    assert file is not None  # only cameras without a lens have none
    return file


@dataclass(frozen=True, kw_only=True)
class Described(Report):
    """A lens as it is set: its figures, its table, and the drawings that were asked for."""

    file: str
    facts: LensFacts = field(metadata=PART)
    zoom: str | float | None
    focus_mode: str
    derived: str
    aperture: dict[str, Any] | None
    configurations: list[State]
    surfaces: list[SurfaceRow]
    layout: Path | None
    breathing_plot: Path | None
    breathing: dict[str, list[Breath]] | None = field(metadata=OPTIONAL)
    seconds: float

    def text(self) -> str:
        """Return a page of text: figures, light, the table, states and warnings."""
        facts = self.facts
        by = f", {facts.designer}" if facts.designer else ""
        parts = [f"{facts.name}{by}\n{facts.source}", _first_order(facts), self._light(), _surfaces(self.surfaces)]
        zooms = [c for c in self.configurations if c.object_distance_mm is None]
        nears = [c for c in self.configurations if c.object_distance_mm is not None]
        if zooms:
            states = ", ".join(f"{c.name} ({cli.number(c.efl_mm)} mm)" for c in zooms)
            parts.append(f"Zoom states (--zoom, also mm between them): {states}")
        if nears:
            states = ", ".join(f"{c.name} ({cli.number(c.object_distance_mm)} mm)" for c in nears)
            parts.append(f"Focus states (--zoom, and --focus between them): {states} to the object")
        if self.derived:
            parts.append(f"Derived: {self.derived}")
        parts += [f"Warning: {text}" for text in facts.warnings]
        plots = {"Layout": self.layout, "Focus breathing": self.breathing_plot}
        return "\n\n".join([*parts, *(f"{what} drawn in {file}" for what, file in plots.items() if file)])

    def _focusing(self) -> tuple[str, str]:
        reach_m = self.facts.groups_reach_m
        if reach_m is None:
            return "whole lens", "nothing in the file says that groups move"
        return (
            "by groups",
            f"to {reach_m:.3g} m from the film; nearer, and in models of one state, the whole lens moves",
        )

    def _light(self) -> str:
        facts = self.facts
        stated, anamorphic = facts.half_field_deg, facts.efl_x_mm is not None
        along, states = " along y" if anamorphic else "", "" if stated is None else f"; the file states {stated:g}"
        reached = facts.half_field_reached_deg, facts.half_field_reached_x_deg
        half, half_x = ("-" if v is None else f"{v:.2f} degrees" for v in reached)
        share_of = "of rays spread evenly over the film, and over a disc 5% wider than all that pass"
        rows = [
            ("image radius", f"{cli.number(facts.image_radius_mm)} mm", f"from {facts.image_radius_from}"),
            ("half field", half, f"reached at the edge of the film{along}{states}"),
            *((("", half_x, "along x"),) if anamorphic else ()),
            ("focusing", *self._focusing()),
            ("rays that pass", f"{100 * facts.passing_share:.1f}%", share_of),
            *(("", f"{100 * e.share:.1f}%", e.text) for e in facts.ended),
            (
                "T-stop",
                "-" if facts.t_stop is None else f"T{cli.number(facts.t_stop)}",
                "of all axial light, d line",
            ),
            ("coatings", facts.coatings or "-", "of the surfaces between glass and air"),
        ]
        if glasses := dict.fromkeys(s.absorbs_as for s in self.surfaces if s.absorbs_as):
            names = ", ".join(name.partition(":")[2] for name in glasses)
            rows.append(("absorption", "assumed", f"that of the nearest catalogue glasses: {names}"))
        if facts.white_rb:
            red, blue = facts.white_rb
            rows.append(("white card", f"R/G {red:.3f}, B/G {blue:.3f}", "on the axis at this stop, in daylight D65"))
        return _columns(rows)


@dataclass(frozen=True)
class State:
    """A state of the file: a zoom by its focal length, or a focus by its distance to the object."""

    name: str
    efl_mm: float | None
    object_distance_mm: float | None


def _first_order(facts: LensFacts) -> str:
    def mm(*values: float | None) -> str:
        return ", ".join(f"{cli.number(value, 6)} mm" for value in values)

    first, medium = facts.first, facts.object_medium
    focus = "infinity" if math.isinf(facts.focus_m) else f"{facts.focus_m:g} m"
    across = facts.efl_x_mm is not None
    rows = [
        ("focal length", mm(first.efl_mm), "in the y-z plane, as all that follows" if across else ""),
        *((("", mm(facts.efl_x_mm), "in the x-z plane"),) if across else ()),
        ("back focus", mm(first.back_focus_mm), "last vertex to rear focal point"),
        ("f-number", f"f/{cli.number(first.f_number)}", "focal length over entrance pupil"),
        ("working f-number", f"f/{cli.number(facts.working_f_number)}", "of the real marginal ray at this focus"),
        ("principal planes", mm(first.front_principal_z_mm, first.rear_principal_z_mm), "front H, rear H'"),
        ("entrance pupil", mm(first.entrance_pupil_z_mm), f"diameter {mm(first.entrance_pupil_diameter_mm)}"),
        ("exit pupil", mm(first.exit_pupil_z_mm), f"diameter {mm(first.exit_pupil_diameter_mm)}"),
        ("film plane", mm(facts.film_z_mm), f"focus at {focus}"),
        ("stop", f"surface {facts.stop_surface}", f"diameter {mm(facts.stop_diameter_mm)}"),
        ("refractions", str(facts.refractions), ""),
    ]
    if medium.n_d != 1:
        rows.append(("medium in front", f"n_d {medium.n_d:.5f}", medium.material or medium.glass or ""))
    if first.front_efl_mm != first.efl_mm:
        rows.append(("front focal", mm(first.front_efl_mm), "focal length of the object side, in its medium"))
    rows.append(("wavelength", *cli.first_order_light(facts.light)))
    return _columns(rows)


def _columns(rows: list[tuple[str, str, str]]) -> str:
    wide = max(len(value) for _, value, _ in rows)
    return "\n".join(f"{name:18}{value:{wide}}  {note}".rstrip() for name, value, note in rows)


def _surfaces(surfaces: list[SurfaceRow]) -> str:
    header = ["surface", "radius mm", "thickness mm", "diameter mm", "n_d", "V_d", "", ""]
    rows = []
    for s in surfaces:
        radius = "plane" if math.isinf(s.radius_mm) else f"{s.radius_mm:.4f}"
        glass = ("", "") if s.n_d == 1 else (f"{s.n_d:.4f}", "-" if s.V_d is None else f"{s.V_d:.2f}")
        name = "stop" if s.stop else s.glass or s.material or ""
        rows.append([str(s.surface), radius, f"{s.thickness_mm:.4f}", f"{s.diameter_mm:.4f}", *glass, name, s.words()])
    if not any(row[-1] for row in rows):
        header, rows = header[:-1], [row[:-1] for row in rows]
    return cli.table(header, rows)


def kept_row(file: Path, index: dict[str, dict[str, Any]]) -> dict[str, Any] | None:
    """Return a lens's row of the library's index; None for another lens, or where the file has changed."""
    entry = index.get(file.name)
    if entry is None or file.resolve().parent != (library() / "lenses").resolve() or entry["sha256"] != sha256_of(file):
        return None
    return {"lens": file.stem, "file": str(file), **entry["row"]}


def _place(sort: str, row: dict[str, Any]) -> tuple[Any, ...]:
    """Return the key by which rows are sorted; those without the value come last."""
    figure = CHARACTER[sort][0] if sort in CHARACTER else _SORTS[sort]
    value = ((row.get("character") or {}) if sort in CHARACTER else row).get(figure)
    if value in (None, ""):
        return (True, 0.0, row["lens"])
    strongest_first = -1 if sort in CHARACTER and sort != "cats-eye" else 1
    return (False, value.casefold() if isinstance(value, str) else strongest_first * value, row.get("efl_mm", 0.0))


@dataclass(frozen=True)
class ListedLenses(Report):
    """A row for each lens, as `studies.describe.library_row` makes it or the library's index has it."""

    lenses: list[dict[str, Any]]
    sort: str | None = field(metadata=BULK)

    def text(self) -> str:
        """Return the table; sorted by a character, it shows characters in place of other data."""
        by_character = self.sort in CHARACTER
        middle = [heading for _, heading in CHARACTER.values()]
        middle = middle if by_character else ["half field", "film mm", "refr.", "states"]
        header = ("lens", "name", "maker", "year", "EFL mm", "f/", *middle, "rims", "verdict")
        text = cli.table(header, [_cells(row, by_character, len(header)) for row in self.lenses], left=3)
        doubtful = [row for row in self.lenses if row["doubts"]]
        guess = "\n\n~ follows rims that the source does not state" if by_character and "~" in text else ""
        found = f"{guess}\n\n{len(self.lenses)} lenses, {len(doubtful)} of them doubtful or unreadable"
        lines = [f"  {row['lens']}: {doubt}" for row in doubtful for doubt in row["doubts"]]
        return text + found + (":\n" + "\n".join(lines) if lines else "")


def _cells(row: dict[str, Any], character: bool, count: int) -> list[str]:
    if "name" not in row:
        return [row["lens"], *["-"] * (count - 2), row["verdict"]]
    efl = cli.number(row["efl_mm"]) + ("" if row["efl_x_mm"] is None else f" / {cli.number(row['efl_x_mm'], 3)}")
    begin = [
        row["lens"],
        one_line(row["believed_to_be"] or row["name"], 40),
        one_line(row["maker"] or "-", 16),
        str(row["year"] or "-"),
        efl,
        cli.number(row["f_number"], 3),
    ]
    field = "-" if row["half_field_deg"] is None else f"{row['half_field_deg']:.4g}°"
    middle = [field, cli.number(row["image_radius_mm"]), *(str(row[key] or "-") for key in ("refractions", "states"))]
    if character:
        figures, guessed = row.get("character") or {}, row["rims"] in ("derived", "estimated")
        marked = [key for key in ("cats_eye", "swirl") if guessed and figures.get(key) is not None]
        middle = ["~" * (key in marked) + cli.number(figures.get(key), 3) for key, _ in CHARACTER.values()]
    return [*begin, *middle, row["rims"], row["verdict"]]
