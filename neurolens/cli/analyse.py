"""`neurolens analyse LENS [WHAT ...]`: spots, MTF, distortion and other analyses as tables, JSON and pictures."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from textwrap import wrap
from typing import TYPE_CHECKING, Any, ClassVar, Literal, NamedTuple

from neurolens.base.errors import InputError, warned
from neurolens.base.settings import WAVELENGTH_NM, between, said, setting
from neurolens.cli.arguments import (
    Answering,
    Glasses,
    LensState,
    check_run_folder,
    lens,
    lens_state,
    output_path,
    wavelengths_nm,
)  # fmt: skip
from neurolens.cli.output import number, table

if TYPE_CHECKING:
    from neurolens.analysis.fields import Scene
    from neurolens.lens.prescription import Lens


WHATS = (
    "layout", "spots", "fans", "colour", "curvature", "distortion", "vignetting", "mtf", "mtf-height", "seidel", "psf",
)  # fmt: skip
_OF_FIELDS = ("spots", "fans", "mtf", "psf")  # take --field-points, and as mtf-height --wavelengths
_BULK = {  # left out of the JSON unless asked for: a number per ray or a pixel
    "layout": ("rays", "surfaces"),
    "spots": ("tangential_um", "sagittal_um", "slope_tangential", "slope_sagittal"),
    "psf": ("geometric", "diffraction"),
}


class Analysis(NamedTuple):
    """Computes a result of a scene, draws it (result, path, title, subtitle), and tells its figures as a table."""

    compute: Callable[..., Any]
    draw: Callable[..., None]
    table: Callable[[dict[str, Any]], str]


@dataclass(frozen=True, kw_only=True)
class Analyse(Glasses, Answering):
    """Trace a lens from the scene and analyse its image. WHAT is any of:

      layout      the section of the lens with rays
      spots       spot diagrams over field and focus, RMS and geometric radius, Airy disc
      fans        transverse aberration over the pupil, tangential and sagittal
      colour      longitudinal colour by zones, 380 to 780 nm, and lateral colour over the field
      curvature   field curvature and astigmatism, from close rays about the chief ray
      distortion  against f tan(theta), and for wide lenses against the projection that fits best
      vignetting  vignetting and relative illumination
      mtf         geometric MTF, tangential and sagittal, with the diffraction limit beside
      mtf-height  the same at 10, 20 and 40 cycles/mm against image height, as lens makers print it
      seidel      Seidel sums S1 to S5 and the colour sums C1 and C2, surface by surface
      psf         point spread, geometric and by diffraction

    Without WHAT all are shown. Rays fill the real stop, not a paraxial pupil; fields are angles
    from the axis in degrees, of the chief ray in the scene. The edge is that of the film, or the
    text says which; one that no chief ray reaches is a warning. Pupils are sampled finer and finer
    until two samplings agree to the digits that are printed; what does not settle has fewer.
    Needs the extra "train" (torch)."""

    about: ClassVar[str] = "spots, MTF, distortion and more of a lens file"
    epilog: ClassVar[str] = """\
examples:
  neurolens analyse lenses/laikin_double_gauss_50.toml
  neurolens analyse lenses/shimizu_fisheye_220.toml distortion vignetting -o pictures
  neurolens analyse lenses/brendel_tessar_100.toml spots mtf --f-number 5.6 --focus-mode best --json"""
    kept: ClassVar[str] = "finished pictures are kept"
    intermixed: ClassVar[bool] = True

    file: Path = lens(positional=True)
    what: tuple[str, ...] = setting((), "what to show (default: all)", positional=True, metavar="WHAT", nargs="*")
    state: LensState = lens_state()
    field_points: tuple[float, ...] | None = setting(
        None, "angles from the axis for spots, fans, mtf and psf (default: axis, 50%, 70%, 85% and edge of the field)",
        kind=between(0, 179, "degrees"), nargs="+", metavar="DEG", old=("fields",),
    )  # fmt: skip
    wavelengths: tuple[tuple[float, ...], ...] | None = setting(
        None, f"of spots, fans, the MTF and psf, {said(WAVELENGTH_NM)} nm, the reference first "
        "(default: d, F and C, or the file's own where its range lacks the d line)",
        kind=wavelengths_nm, nargs="+", metavar="NM",
    )  # fmt: skip
    frequencies: tuple[float, ...] | None = setting(
        None, "of mtf-height (default: 10 20 40)", kind=between(0, 1000, "cycles per mm"), nargs="+",
        metavar="PER_MM",
    )  # fmt: skip
    axis: Literal["x", "y"] = setting("y", "plane of the field, for anamorphic lenses (default: y)")
    out: Path | None = output_path("FOLDER", "draw a picture of each in this folder", None)
    format: Literal["png", "pdf", "svg"] = setting("png", "of the pictures (default: png)")
    full: bool = setting(False, "with --json: also every ray and every pixel")

    @property
    def waves_nm(self) -> list[float] | None:
        """The wavelengths that the command line names."""
        return None if self.wavelengths is None else [nm for some in self.wavelengths for nm in some]

    def run(self) -> int:
        """Print the requested analyses, and draw them if a folder is given."""
        if unknown := [w for w in self.what if w not in WHATS]:
            self.refuse("WHAT", unknown[0], f"any of: {', '.join(WHATS)}")
        if self.full and not self.json:
            self.refuse("--full", "(given)", "this option only with --json")
        if self.out is not None:
            check_run_folder(self.out, self.out, "--output")

        from neurolens.analysis.layout import state_text

        began = time.perf_counter()
        scene, doubts = self._scene()
        if self.out is not None:
            self.out.mkdir(parents=True, exist_ok=True)
        edge = scene.edge
        doubts += [edge.warning] if edge.warning else []
        results: dict[str, Any] = {}
        pictures, notes = {}, [f"derived: {scene.lens.derived}"] if scene.lens.derived else []
        for what in self.what or WHATS:
            try:
                results[what], picture = self._one(what, scene, doubts)
            except InputError as error:
                if self.what:
                    raise
                notes.append(f"{what} left out: {error}")
                continue
            if picture is not None:
                pictures[what] = str(picture)
        head = {"file": str(self.file), "name": scene.lens.name, "axis": scene.axis, "focus_m": scene.focus_m}
        more = {"pictures": pictures, "notes": notes, "warnings": doubts, "seconds": time.perf_counter() - began}
        bulk = {} if self.full else _BULK
        shown = {w: {k: v for k, v in d.items() if k not in bulk.get(w, ())} for w, d in results.items()}

        def text() -> str:
            widest = f"fields to {edge.field_deg:.2f}°, {edge.height_mm:.2f} mm: {edge.name}"
            parts = [
                f"{scene.lens.name}\n{state_text(scene)}\n{widest}",
                *(analysis_of(w).table(d) for w, d in results.items()),
            ]
            parts += [*(f"Note: {n}" for n in notes), *(f"Warning: {w}" for w in doubts)]
            if pictures:
                parts.append(f"{len(pictures)} pictures drawn in {self.out}")
            return "\n\n".join(parts)

        return self.answer({**head, "edge": edge.to_dict(), **shown, **more}, text)

    def _scene(self) -> tuple[Scene, list[str]]:
        """The lens with its object in its state, and warnings."""
        from neurolens.analysis.fields import Scene
        from neurolens.readers.any_format import read_any
        from neurolens.study.describe import file_doubts, rim_doubts

        with warned(self.file) as notes:  # glasses that contradict the catalogue, constant indices
            tabled = read_any(self.file)
        lens = self.state.set_lens(tabled)
        notes += rim_doubts(lens) + file_doubts(tabled, states=bool(self.state.zoom))
        scene = Scene(lens, self.state.focus_of(tabled, lens), self.axis)
        return scene, notes + _wavelength_warnings(lens, self.waves_nm or scene.waves_nm)

    def _one(self, what: str, scene: Scene, doubts: list[str]) -> tuple[dict[str, Any], Path | None]:
        """One analysis as plain data, and its picture where a folder is given; new warnings are added to `doubts`."""
        from neurolens.analysis.bundles import check_light
        from neurolens.analysis.layout import state_text

        analysis, options = analysis_of(what), dict[str, Any]()
        if what in _OF_FIELDS:
            options = {"field_deg": self.field_points, "wavelength_nm": self.waves_nm}
            dark = check_light(scene, self.field_points, (self.waves_nm or scene.waves_nm)[0])
            doubts += [d for d in dark if d not in doubts]
        elif what == "mtf-height":
            options = {"frequency_per_mm": self.frequencies, "wavelength_nm": self.waves_nm}
        result = analysis.compute(scene, **{k: v for k, v in options.items() if v is not None})
        data = result.to_dict()
        if self.out is None:
            return data, None
        across = f"_{self.axis}" if any(s.cylinder for s in scene.lens.surfaces) else ""
        path = self.out / f"{scene.lens.lens_id}_{what}{across}.{self.format}"
        warning = wrap(f"Warning: {scene.edge.warning}", _WRAP) if scene.edge.warning else []
        if what == "layout":
            analysis.draw(replace(result, subtitle="\n".join([result.subtitle, *warning])), path)
        else:
            analysis.draw(result, path, scene.lens.name, "\n".join([state_text(scene), *warning]))
        return data, path


def analysis_of(what: str) -> Analysis:
    """The analysis of a name; torch and matplotlib are imported here, not when the command line starts."""
    from neurolens.analysis import plots
    from neurolens.analysis.field_curves import colour, curvature, distortion, illumination, seidel
    from neurolens.analysis.layout import layout_profile, lens_layout
    from neurolens.analysis.spots import fans, mtf, mtf_over_height, psf, spots

    return {
        "layout": Analysis(layout_profile, lens_layout, _layout_text),
        "spots": Analysis(spots, plots.plot_spots, _spots_text),
        "fans": Analysis(fans, plots.plot_fans, _fans_text),
        "colour": Analysis(colour, plots.plot_colour, _colour_text),
        "curvature": Analysis(curvature, plots.plot_curvature, _curvature_text),
        "distortion": Analysis(distortion, plots.plot_distortion, _distortion_text),
        "vignetting": Analysis(illumination, plots.plot_vignetting, _vignetting_text),
        "mtf": Analysis(mtf, plots.plot_mtf, _mtf_text),
        "mtf-height": Analysis(mtf_over_height, plots.plot_mtf_over_height, partial(_mtf_text, over_height=True)),
        "seidel": Analysis(seidel, plots.plot_seidel, _seidel_text),
        "psf": Analysis(psf, plots.plot_psf, _psf_text),
    }[what]


def _wavelength_warnings(lens: Lens, wavelength_nm: Iterable[float]) -> list[str]:
    """Glasses of a lens that their source does not state at a wavelength in use."""
    from neurolens.lens.glass import glass_of

    waves, found = list(wavelength_nm), {}
    for name in {s.glass: None for s in lens.surfaces if s.glass is not None}:
        glass = glass_of(name)
        outside = ", ".join(f"{nm:g}" for nm in waves if not glass.covers(nm))
        if outside:
            low, high = (round(1000 * v) for v in glass.range_um)
            found[name] = f"the index of {glass} is stated for {low}-{high} nm: extrapolated at {outside} nm"
    if any(s.n_d != 1 and s.glass is None for s in lens.surfaces):
        far = ", ".join(f"{nm:g}" for nm in waves if not 365 <= nm <= 1014)
        if far:
            found[""] = f"glasses known by n_d and V_d alone are a guess at {far} nm, outside 365-1014 nm"
    return list(found.values())


_ROWS = 6  # of tables over the field
_WRAP = 90  # characters a line that the narrowest picture has room for
_MTF_PER_MM = (10, 20, 30, 40, 50)


def _layout_text(data: dict[str, Any]) -> str:
    counts: dict[str, int] = {}
    for ray in data["rays"]:
        counts[ray["label"]] = counts.get(ray["label"], 0) + 1
    rows = [(label, str(count)) for label, count in counts.items()]
    return f"Layout: {len(data['surfaces'])} surfaces\n" + table(("field", "rays drawn"), rows)


def _spots_text(data: dict[str, Any]) -> str:
    header = ("RMS µm", *_nanometres(data), "largest µm", "passed", "best focus mm", "RMS there")

    def cells(i: int) -> list[str]:
        off = {key: spread[i] for key, spread in data["spread"].items()}
        each = zip(data["rms_by_wavelength_um"][i], off["rms_by_wavelength_um"], strict=True)
        return [
            _three(data["rms_um"][i], off["rms_um"]),
            *(_three(*pair) for pair in each),
            _three(data["geometric_um"][i], 20 * off["geometric_um"]),
            _percent(data["passed"][i], off["passed"]),
            _fixed(data["best_shift_mm"][i], _digits(off["best_shift_mm"]) + 1),
            _three(data["best_rms_um"][i], off["best_rms_um"]),
        ]

    airy = f"Airy disc radius {number(data['airy_um'], 3)} µm at the working f/{number(data['working_f_number'], 3)}"
    head = f"Spots (radius from the centroid, all wavelengths; each by itself; {airy})"
    return _over_field(head, data, header, cells, range(len(data["field_deg"])))


def _fans_text(data: dict[str, Any]) -> str:
    header = [f"{name} {wave}" for name in ("tang.", "sag.") for wave in _nanometres(data)]

    def cells(i: int) -> list[str]:
        rows = [row for key in ("tangential_um", "sagittal_um") for row in data[key][i]]
        return [_three(max((abs(v) for v in row if not math.isnan(v)), default=math.nan)) for row in rows]

    head = "Ray fans (largest transverse aberration, µm)"
    return _over_field(head, data, header, cells, range(len(data["field_deg"])))


def _colour_text(data: dict[str, Any]) -> str:
    some = _some(len(data["spectrum_nm"]), 9)
    zones = ("paraxial", *(f"zone {z:.2f}" for z in data["zone"][1:]))
    first = [(f"{data['spectrum_nm'][i]:.0f} nm", *(_three(v) for v in data["focus_shift_mm"][i])) for i in some]
    head = "Lateral colour (height from that of the first line, µm)"
    lines = [f"{w:.0f} nm" for w in data["line_nm"]]
    lateral = _over_field(head, data, lines, lambda i: [_three(v) for v in data["lateral_um"][i]])
    return f"Longitudinal colour (focus from the film, mm)\n{table(('wavelength', *zones), first)}\n\n{lateral}"


def _curvature_text(data: dict[str, Any]) -> str:
    keys = ("tangential_mm", "sagittal_mm", "petzval_mm")
    head = f"Field curvature (focus from the film, mm; Petzval radius {number(data['petzval_radius_mm'])} mm)"
    header = ("tangential", "sagittal", "Petzval")
    return _over_field(head, data, header, lambda i: [_three(data[key][i]) for key in keys])


def _distortion_text(data: dict[str, Any]) -> str:
    names = list(data["error_percent"])
    head = (
        f"Distortion (%; {_fixed(data['edge_percent'], 2)}% at {data['edge']}, against {data['reference']}; "
        f"closest is {data['best']}; {number(data['scale_mm'])} mm per radian on the axis)"
    )
    header = [n.partition(",")[0] for n in names]
    return _over_field(head, data, header, lambda i: [_three(data["error_percent"][n][i]) for n in names])


def _vignetting_text(data: dict[str, Any]) -> str:
    keys = ("relative", "unvignetted", "passed", "cos4")
    header = ("illumination", "without rims", "rims pass", "cos^4")
    head = "Vignetting and relative illumination"
    settled = data["spread"]

    def cells(i: int) -> list[str]:
        return [_percent(data[key][i], settled[key][i] if key in settled else 0.0) for key in keys]

    return _over_field(head, data, header, cells)


def _mtf_text(data: dict[str, Any], over_height: bool = False) -> str:
    """The contrast at frequencies of `_MTF_PER_MM` for every field, or at all of them over the image height."""
    at = [k for k, f in enumerate(data["frequency_per_mm"]) if over_height or f in _MTF_PER_MM]
    name = "Geometric MTF" + " against image height" * over_height
    header = [f"{data['frequency_per_mm'][k]:g}/mm {d}" for k in at for d in "TS"]
    limit = ", ".join(_fixed(data["diffraction_limit"][k]) for k in at)
    waves = ", ".join(f"{w:.0f}" for w in data["wavelength_nm"])
    head = f"{name} ({waves} nm; T tangential, S sagittal; without diffraction, whose limit is {limit})"

    def cells(i: int) -> list[str]:
        both = ("tangential", "sagittal")
        return [_fixed(data[key][i][k], _digits(data["spread"][key][i][k])) for k in at for key in both]

    return _over_field(head, data, header, cells, None if over_height else range(len(data["field_deg"])))


def _seidel_text(data: dict[str, Any]) -> str:
    header = ("surface", *(name.replace(" colour", "") for name in data["names"]))
    rows = [(str(k), *(f"{round(v, 5) + 0.0:.5f}" for v in row)) for k, row in enumerate(data["surfaces"])]
    rows.append(("total", *(f"{round(v, 5) + 0.0:.5f}" for v in data["total"])))
    odd = data["odd_powers"]
    note = f"\nNot counted: the odd powers of surface {', '.join(map(str, odd))}" if odd else ""
    head = f"Seidel sums (mm, {data['wavelength_nm']:.0f} nm, image height {number(data['image_height_mm'])} mm)"
    return f"{head}\n" + table(header, rows) + note


def _psf_text(data: dict[str, Any]) -> str:
    off = data["spread"]
    rows = [
        (
            _angle(data, i),
            _three(data["half_width_um"][i], 20 * off["half_width_um"][i]),
            _fixed(data["strehl"][i], _digits(off["strehl"][i])),
        )
        for i in range(len(data["field_deg"]))
    ]
    head = f"Point spread ({data['wavelength_nm'][0]:.0f} nm; Strehl ratio '-' where aberrations rule out diffraction)"
    return f"{head}\n" + table(("field", "half width µm", "Strehl ratio"), rows)


def _over_field(
    head: str,
    data: dict[str, Any],
    header: Sequence[str],
    cells: Callable[[int], Sequence[str]],
    fields: Iterable[int] | None = None,
) -> str:
    """A table with a row per field: its angle, its height and `cells` of it; some fields where none are given."""
    chosen = _some(len(data["field_deg"])) if fields is None else fields
    rows = [(_angle(data, i), _fixed(data["height_mm"][i], 2), *cells(i)) for i in chosen]
    return f"{head}\n{table(('field', 'height mm', *header), rows)}"


def _angle(data: dict[str, Any], i: int) -> str:
    field = data["field_deg"][i]
    return "axis" if field == 0 else f"{field:.2f}°"


def _nanometres(data: dict[str, Any]) -> list[str]:
    return [f"{w:.0f} nm" for w in data["wavelength_nm"]]


def _some(count: int, rows: int = _ROWS) -> list[int]:
    """About so many of the indices below `count`, evenly spread, both ends among them."""
    steps = min(rows, count) - 1
    return [round(k * (count - 1) / steps) for k in range(steps + 1)] if steps > 0 else [0] * count


def _digits(spread: float) -> int:
    """Decimal places, from 1 to 3, of which two samplings that differ by `spread` differ by one of the last at most."""
    return 3 if spread <= 1e-3 else max(1, math.floor(-math.log10(spread)))


def _fixed(value: float, places: int = 3) -> str:
    return "-" if math.isnan(value) else f"{value + 0.0:.{places}f}"


def _percent(value: float, spread: float = 0.0) -> str:
    return "-" if math.isnan(value) else f"{100 * value:.{max(_digits(spread) - 2, 0)}f}%"


def _three(value: float, spread: float = 0.0) -> str:
    """Three digits, or fewer: two samplings that differ by `spread` of the value differ by one of the last at most."""
    if not 1e-6 <= abs(value) < math.inf:
        return number(0.0 if abs(value) < 1e-6 else value)  # rounding errors of a zero are 0
    units = math.ceil(math.log10(max(spread * abs(value), 1e-300)))
    digits = max(min(math.floor(math.log10(abs(value))) - units + 1, 3), 1)
    return number(float(f"{value:.{digits}g}"))
