"""`neurolens lens FILE`: what a lens file holds, computed and drawn; many files as a table; rims by a rule."""

from __future__ import annotations

import math
import time
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Literal

from neurolens.base.errors import warned
from neurolens.base.files import library
from neurolens.base.lensname import resolve
from neurolens.base.settings import changed, setting
from neurolens.cli.arguments import (
    Answering,
    Glasses,
    LensState,
    check_folder,
    check_suffix,
    lens_state,
    output_path,
)  # fmt: skip
from neurolens.cli.lens_list import list_rows, list_text
from neurolens.cli.output import number, table

if TYPE_CHECKING:
    from neurolens.lens import prescription
    from neurolens.setting.rims import Rim

_LAYOUT_SUFFIXES = (".png", ".pdf", ".svg")
_Sort = Literal[
    "maker", "focal-length", "speed", "year", "cats-eye", "swirl", "bubbles", "softness", "flare"
]  # those of `cli.lens_list`


@dataclass(frozen=True, kw_only=True)
class Lens(Glasses, Answering):
    """Read a lens file strictly and print what follows from it: focal length, pupils, film plane,
    image circle, how much of the light gets through and what stops the rest, and anything
    doubtful about it. Several files, or folders (of all formats that "neurolens convert" reads), are
    a table with one line for each lens, in milliseconds a lens; after the word "list" each of them is
    checked, too. --derive-rims computes the rim diameters that a patent does not print.

    Lengths are in mm along the axis, z = 0 at the front vertex, light travelling to +z; angles
    are from the axis in degrees; first-order data is for the d line (587.56 nm). Needs the extra
    "train" (torch)."""

    about: ClassVar[str] = "first-order data, field and layout of a lens file"
    epilog: ClassVar[str] = """\
examples:
  neurolens lens laikin_double_gauss_50
  neurolens lens lenses/brendel_tessar_100.toml --focal-length 50 --focus 1.5 --layout tessar.png
  neurolens lens lenses/ogawa_zoom_70_200.toml --zoom 135mm --json
  neurolens lens downloads/ --json
  neurolens lens list --layouts lenses.png
  neurolens lens list --sort swirl
  neurolens lens lenses/brendel_tessar_100.toml --derive-rims -o tessar.toml"""
    kept: ClassVar[str] = "only a finished --layout picture is written"
    intermixed: ClassVar[bool] = True

    files: tuple[Path, ...] = setting(
        ..., 'lens files, names of lenses/, or folders; after the word "list" they are checked (default: those that '
        "ship)", positional=True, metavar="FILE", nargs="+",
    )  # fmt: skip
    state: LensState = lens_state()
    layout: Path | None = setting(
        None, "draw the lens with rays from three field points: axis, 70% and edge of the film (.png, .pdf, .svg)",
        metavar="OUT.png",
    )  # fmt: skip
    layouts: Path | None = setting(None, "of several files: draw all lenses in section on one sheet", metavar="OUT.png")
    sort: _Sort | None = setting(
        None, "of several files: the order; the last five are figures of bokeh and flare, the strongest first, which "
        "take seconds a lens that is not of lenses/",
    )  # fmt: skip
    derive_rims: bool = setting(
        False, "compute the diameters from the f-number and the field, and print them beside those of the file",
        title="rims",
    )  # fmt: skip
    edge_pupil: float | None = setting(
        None, "share of the pupil's height that is kept at the edge of the field (default: 0.5)", within=(0.01, 1),
        unit="a share", metavar="SHARE", old=("vignetting",), title="rims",
    )  # fmt: skip
    half_field: float | None = setting(
        None, "edge of the field, in degrees from the axis (default: as the file states)", within=(0.01, 179),
        unit="an angle in degrees", metavar="DEG", title="rims",
    )  # fmt: skip
    out: Path | None = output_path("OUT.toml", "write the lens with its derived rims", None, "rims")
    breathing: Path | None = setting(
        None, "draw field of view, focal length and magnification against the focus distance (.png, .pdf, .svg)",
        metavar="OUT.png",
    )  # fmt: skip

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
        anywhere = {"--glass", "--json"}
        if several:
            modes, allowed = "with one lens file", {"--layouts", "--sort"}
        elif self.derive_rims:
            modes, allowed = "with one lens file alone", {"--derive-rims", "--edge-pupil", "--half-field", "--output"}
        else:
            modes, allowed = "with --derive-rims", {*changed(self.state), "--layout", "--breathing"}
        for option in changed(self):
            if option not in allowed | anywhere:
                where = 'with "list", a folder or several files' if option in ("--layouts", "--sort") else modes
                self.refuse(option, "(given)", f"this option only {where}")

    def _describe(self, file: Path) -> int:
        """Print and draw one lens."""
        for option, path in (("--layout", self.layout), ("--breathing", self.breathing)):
            if path is not None:
                check_suffix(path, option, _LAYOUT_SUFFIXES)
        from neurolens.readers.any_format import read_any
        from neurolens.study.describe import file_doubts, glass_table, layout_profile, lens_facts
        from neurolens.surrogates.pairs import domain_of

        began = time.perf_counter()
        with warned(file) as notes:
            tabled = read_any(file)
        lens = self.state.set_lens(tabled)
        focus, film_z = self.state.focus_of(tabled, lens), float(lens.film_z_mm or 0.0)
        domain = domain_of(lens, focus_m=(focus, focus), film_z_mm=(film_z, film_z))
        facts = lens_facts(lens, domain)
        facts["warnings"] += notes + file_doubts(tabled)
        data = {
            "file": str(file),
            **facts,
            "zoom": self.state.zoom,
            "focus_mode": self.state.focus_mode or "best",
            "derived": lens.derived,
            "aperture": lens.aperture and lens.aperture.settings(),
            "configurations": [
                {"name": c.name, "efl_mm": c.efl_mm, "object_distance_mm": c.object_distance_mm}
                for c in tabled.configurations
            ],
            "surfaces": glass_table(lens),
            "layout": self.layout and str(self.layout),
            "breathing_plot": self.breathing and str(self.breathing),
        }
        if self.layout is not None:
            from neurolens.analysis.layout import lens_layout

            lens_layout(layout_profile(lens, domain), self.layout)
        if self.breathing is not None:
            from neurolens.analysis.breathing import draw_breathing

            figures = draw_breathing(lens, self.breathing)
            data["breathing"] = {name: [asdict(b) for b in breaths] for name, breaths in figures.items()}
        data["seconds"] = time.perf_counter() - began
        return self.answer(data, lambda: _lens_text(data))

    def _list(self, paths: tuple[Path, ...], checked: bool) -> int:
        """Print a table of lenses, and draw their sections."""
        from neurolens.readers.any_format import lens_files

        if self.layouts is not None:
            check_folder(self.layouts, "--layouts")
        files = [file for path in paths for file in (lens_files(path) if path.is_dir() else [_file(path)])]
        rows = list_rows(files, checked=checked, sort=self.sort, kept=not self.glass, quiet=self.json)
        if self.layouts is not None:
            from neurolens.analysis.layout import sheet
            from neurolens.study.describe import section

            sheet([section(Path(r["file"])) for r in rows if "name" in r], self.layouts)
        note = "" if self.layouts is None else f"\n\nSections drawn in {self.layouts}"
        data = {"lenses": rows, "layouts": self.layouts and str(self.layouts)}
        return self.answer(data, lambda: list_text(rows, self.sort) + note)

    def _derive(self, file: Path) -> int:
        """Print the table of rims; write the lens with derived rims only where -o asks for it."""
        from neurolens.readers.lensfile import write_lens
        from neurolens.setting.rims import RimRule, derive_rims, half_field_deg
        from neurolens.study.describe import read_quietly

        out, edge_pupil = self.out, self.edge_pupil
        if out is not None:
            check_folder(out, "--output")
        lens = read_quietly(file)
        rule = RimRule(0.5 if edge_pupil is None else edge_pupil, half_field_deg=self.half_field)
        derived, rims = derive_rims(lens, rule)
        field = self.half_field or half_field_deg(lens)
        if out is not None:
            said = (
                f"Rims are derived by neurolens lens --derive-rims: the stop from the f-number, the whole axial beam, "
                f"{100 * rule.vignetting:g}% of the pupil's height kept at {field:.4g} degrees, "
                f"a clear edge of {100 * rule.clear_edge:g}%."
            )
            write_lens(replace(derived, notes=f"{derived.notes} {said}".strip()), out)
        data = {
            "file": str(file),
            "f_number": lens.f_number,
            "vignetting": rule.vignetting,
            "clear_edge": rule.clear_edge,
            "half_field_deg": field,
            "rims": [vars(rim) for rim in rims],
            "output": out and str(out),
        }
        return self.answer(data, lambda: _rims_text(lens, data, rims))


def _file(name: Path) -> Path:
    """The lens file that an argument names."""
    file = resolve(name, models=False, cameras=False).file
    assert file is not None  # only cameras without a lens have none
    return file


def _lens_text(data: dict[str, Any]) -> str:
    """The page of text for the data that --json prints."""
    by = f", {data['designer']}" if data["designer"] else ""
    parts = [f"{data['name']}{by}\n{data['source']}", _first_order(data), _light(data), _surfaces(data["surfaces"])]
    if data["configurations"]:
        zoom = [f"{c['name']} ({number(c['efl_mm'])} mm)" for c in data["configurations"] if not _near(c)]
        near = [f"{c['name']} ({number(c['object_distance_mm'])} mm)" for c in data["configurations"] if _near(c)]
        parts += [f"Zoom states (--zoom, also mm between them): {', '.join(zoom)}"] if zoom else []
        parts += [f"Focus states (--zoom, or --focus-mode internal): {', '.join(near)} to the object"] if near else []
    if data["derived"]:
        parts.append(f"Derived: {data['derived']}")
    parts += [f"Warning: {text}" for text in data["warnings"]]
    if data["layout"]:
        parts.append(f"Layout drawn in {data['layout']}")
    if data["breathing_plot"]:
        parts.append(f"Focus breathing drawn in {data['breathing_plot']}")
    return "\n\n".join(parts)


def _near(configuration: dict[str, Any]) -> bool:
    return configuration["object_distance_mm"] is not None


def _first_order(data: dict[str, Any]) -> str:
    from neurolens.lens.film_plane import LINE_D_NM

    focus = "infinity" if math.isinf(data["focus_m"]) else f"{data['focus_m']:g} m"
    across = data["efl_x_mm"] is not None
    planes = f"{_mm(data['front_principal_z_mm'])}, {_mm(data['rear_principal_z_mm'])}"
    rows = [
        ("focal length", _mm(data["efl_mm"]), "in the y-z plane, as all that follows" if across else ""),
        *((("", _mm(data["efl_x_mm"]), "in the x-z plane"),) if across else ()),
        ("back focus", _mm(data["back_focus_mm"]), "last vertex to rear focal point"),
        ("f-number", f"f/{number(data['f_number'])}", "focal length over entrance pupil"),
        ("working f-number", f"f/{number(data['working_f_number'])}", "of the real marginal ray at this focus"),
        ("principal planes", planes, "front H, rear H'"),
        ("entrance pupil", _mm(data["entrance_pupil_z_mm"]), f"diameter {_mm(data['entrance_pupil_diameter_mm'])}"),
        ("exit pupil", _mm(data["exit_pupil_z_mm"]), f"diameter {_mm(data['exit_pupil_diameter_mm'])}"),
        ("film plane", _mm(data["film_z_mm"]), f"focus at {focus}"),
        ("stop", f"surface {data['stop_surface']}", f"diameter {_mm(data['stop_diameter_mm'])}"),
        ("refractions", str(data["refractions"]), ""),
    ]
    medium = data["object_medium"]
    if medium["n_d"] != 1:
        rows.append(("medium in front", f"n_d {medium['n_d']:.5f}", medium["material"] or medium["glass"] or ""))
    if data["front_efl_mm"] != data["efl_mm"]:
        rows.append(("front focal", _mm(data["front_efl_mm"]), "focal length of the object side, in its medium"))
    if data["wavelength_nm"] != LINE_D_NM:
        note = "of all this: the file's primary one, as its light does not hold the d line"
        rows.append(("wavelength", f"{data['wavelength_nm']:g} nm", note))
    return _columns(rows)


def _mm(value: float | None) -> str:
    return f"{number(value, 6)} mm"


def _light(data: dict[str, Any]) -> str:
    stated, anamorphic = data["half_field_deg"], data["efl_x_mm"] is not None
    along, states = " along y" if anamorphic else "", "" if stated is None else f"; the file states {stated:g}"
    share_of = "of rays uniform over the film and over the disc of all passing rays, 5% wider"
    reached = f"reached at the edge of the film{along}{states}"
    rows = [
        ("image radius", f"{number(data['image_radius_mm'])} mm", f"from {data['image_radius_from']}"),
        ("half field", _degrees(data["half_field_reached_deg"]), reached),
        *((("", _degrees(data["half_field_reached_x_deg"]), "along x"),) if anamorphic else ()),
        ("rays that pass", f"{100 * data['passing_share']:.1f}%", share_of),
        *(("", f"{100 * e['share']:.1f}%", e["text"]) for e in data["ended"]),
    ]
    return _columns(rows)


def _degrees(angle: float | None) -> str:
    return "-" if angle is None else f"{angle:.2f} degrees"


def _columns(rows: list[tuple[str, str, str]]) -> str:
    wide = max(len(value) for _, value, _ in rows)
    return "\n".join(f"{name:18}{value:{wide}}  {note}".rstrip() for name, value, note in rows)


def _surfaces(surfaces: list[dict[str, Any]]) -> str:
    header = ["surface", "radius mm", "thickness mm", "diameter mm", "n_d", "V_d", "", ""]
    rows = []
    for s in surfaces:
        radius = "plane" if math.isinf(s["radius_mm"]) else f"{s['radius_mm']:.4f}"
        glass = ("", "") if s["n_d"] == 1 else (f"{s['n_d']:.4f}", "-" if s["V_d"] is None else f"{s['V_d']:.2f}")
        name = "stop" if s["stop"] else s["glass"] or s["material"] or ""
        size = f"{s['thickness_mm']:.4f}", f"{s['diameter_mm']:.4f}"
        rows.append([str(s["surface"]), radius, *size, *glass, name, _surface_words(s)])
    if not any(row[-1] for row in rows):
        header, rows = header[:-1], [row[:-1] for row in rows]
    return table(header, rows)


def _surface_words(row: dict[str, Any]) -> str:
    """Properties of a row of `study.describe.glass_table` besides radius and glass; empty for a sphere."""
    powers = sorted(map(int, row["asphere"]))
    span = "" if not powers else f"asphere {powers[0]}" + (f"-{powers[-1]}" if len(powers) > 1 else "")
    (radius, conic), other = row["across"] or (None, None), "x" if row["cylinder"] == "y" else "y"
    words = [
        span,
        f"K {row['conic']:.4g}" if row["conic"] else "",
        f"cylinder {row['cylinder']}" if row["cylinder"] and not row["across"] else "",
        f"{'toroid' if conic is None else f'biconic K {conic:.4g}'}, {radius:.4f} mm along {other}" if radius else "",
        f"ideal lens, f {row['focal_mm']:.4g} mm" if row["focal_mm"] else "",
        f"coating {row['coating']['name']}" if row["coating"] else "",
        f"absorbs {row['absorption_per_mm']:.3g}/mm" if row["absorption_per_mm"] else "",
    ]
    return ", ".join(word for word in words if word)


def _rims_text(lens: prescription.Lens, data: dict[str, Any], rims: list[Rim]) -> str:
    rows = []
    for rim in rims:
        note = "stop" if lens.surfaces[rim.surface].stop else "trimmed: limited by a neighbour" if rim.trimmed else ""
        share = f"{100 * (rim.derived_mm / rim.tabled_mm - 1):+.1f}%"
        cells = (f"{v:.3f}" for v in (rim.tabled_mm, rim.axis_mm, rim.field_mm, rim.derived_mm))
        rows.append((str(rim.surface), *cells, share, note))
    head = (
        f"{lens.name}\nRims for f/{lens.f_number:g} and {data['half_field_deg']:.4g} degrees half field, where "
        f"{100 * data['vignetting']:g}% of the pupil's height is kept; diameters in mm; "
        f"those of the file are marked as {lens.rims}."
    )
    header = ("surface", "in the file", "axial beam", "field", "derived", "change", "")
    tail = f"\n\nWritten to {data['output']}" if data["output"] else "\n\nNothing is written without -o OUT.toml"
    return head + "\n\n" + table(header, rows) + tail
