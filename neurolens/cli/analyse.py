"""`neurolens analyse LENS [WHAT ...]`: spots, MTF, distortion and other analyses as tables, JSON and pictures."""

from __future__ import annotations

import math
import time
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from textwrap import wrap
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import numpy as np

from neurolens.base.errors import InputError, warned
from neurolens.base.report import PART, Report, some_of
from neurolens.base.settings import WAVELENGTH_NM, between, said, setting, wavelengths_nm, whole
from neurolens.cli import arguments as cli
from neurolens.optics.lens.glass import check_light
from neurolens.optics.readers.any_format import read_any
from neurolens.optics.setting.copies import Tolerances
from neurolens.optics.setting.states import focus_of, set_lens

if TYPE_CHECKING:
    from neurolens.optics.analysis.corners import Spread
    from neurolens.optics.analysis.field_curves import Colour, Curvature, Distortion, Illumination, Seidel
    from neurolens.optics.analysis.fields import FieldEdge, Scene
    from neurolens.optics.analysis.layout import Layout
    from neurolens.optics.analysis.psf import Psf
    from neurolens.optics.analysis.spots import Fans, Mtf, Spots


WHATS = (
    "layout", "spots", "fans", "colour", "curvature", "distortion", "vignetting", "mtf", "mtf-height", "seidel", "psf",
)  # fmt: skip
_OF_FIELDS = ("spots", "fans", "mtf", "psf")  # take --field-points, and as mtf-height --wavelengths


class Analysis(NamedTuple):
    """How a result of a scene is computed, drawn (result, path, title, subtitle), and told as a table."""

    compute: Callable[..., Any]
    draw: Callable[..., None]
    table: Callable[[Any], str]


@dataclass(frozen=True, kw_only=True)
class Analyse(cli.Figures):
    """Print every analysis of a lens as its file has it, focused at infinity, up to the edge of its film.

    Rays are traced from the scene. WHAT is any of:

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

    Without WHAT all are shown. Rays fill the real stop. Fields are angles of the chief ray in the scene, up to the edge
    of the film, or up to what the text says. Figures that do not settle as the pupil is sampled finer have fewer
    digits. Needs the extra "train" (torch)."""

    epilog = """\
examples:
  neurolens analyse laikin_double_gauss_50 -o charts
  neurolens analyse shimizu_fisheye_220 distortion vignetting -o pictures
  neurolens analyse laikin_double_gauss_50 --copies 200 --f-number 4 -o pictures
  neurolens analyse brendel_tessar_100 spots mtf --f-number 5.6 --focus-mode best --json"""
    kept = "finished pictures are kept"
    intermixed = True

    file: Path = cli.lens(positional=True)
    what: tuple[str, ...] = setting((), "what to show (default: all)", positional=True, metavar="WHAT", nargs="*")
    state: cli.LensState = cli.lens_state()
    field_points: tuple[float, ...] | None = setting(
        None, "angles from the axis for spots, fans, mtf and psf (default: axis, 50%, 70%, 85% and edge of the field)",
        kind=between(0, 179, "degrees"), nargs="+", metavar="DEG", old=("fields",), common=True,
    )  # fmt: skip
    wavelengths: tuple[tuple[float, ...], ...] | None = setting(
        None, f"wavelengths of spots, fans, the MTF and psf, {said(WAVELENGTH_NM)} nm, the reference first "
        "(default: d, F and C, or the file's own where its range lacks the d line)",
        kind=wavelengths_nm, nargs="+", metavar="NM", common=True,
    )  # fmt: skip
    frequencies: tuple[float, ...] | None = setting(
        None, "frequencies of mtf-height (default: 10 20 40)", kind=between(0, 1000, "cycles per mm"), nargs="+",
        metavar="PER_MM", common=True,
    )  # fmt: skip
    axis: Literal["x", "y"] = setting("y", "plane of the field, for anamorphic lenses (default: y)")
    copies: int | None = setting(
        None, "show how so many copies of the lens differ: MTF, spots and best focus in the middle and at 80% of the "
        "corners, drawn as by neurolens copies", kind=whole(2, 10_000), metavar="N",
    )  # fmt: skip
    seed: int = setting(0, "seed of the copies", kind=whole(0))
    tolerances: Path | None = setting(None, "tolerances of the copies, as of `neurolens copies`", metavar="FILE.toml")
    out: Path | None = cli.output_path("FOLDER", "draw a picture of each in this folder", None)
    format: Literal["png", "pdf", "svg"] = setting("png", "format of the pictures (default: png)")
    full: bool = setting(False, "with --json: also every ray and every pixel")

    @property
    def waves_nm(self) -> list[float] | None:
        """The wavelengths that the command line names."""
        return None if self.wavelengths is None else [nm for some in self.wavelengths for nm in some]

    def run(self) -> int:
        """Print the requested analyses, and draw them if a folder is given."""
        if unknown := [w for w in self.what if w not in WHATS]:
            self.refuse("WHAT", unknown[0], f"any of: {', '.join(WHATS)}")
        if not self.copies and (self.seed or self.tolerances):
            self.refuse("--seed, --tolerances", "(given)", "these options only with --copies")
        if self.full and not self.json:
            self.refuse("--full", "(given)", "this option only with --json")
        from neurolens.optics.analysis.layout import state_text

        began = time.perf_counter()
        scene, doubts = self._scene()
        if self.out is not None:
            self.out.mkdir(parents=True, exist_ok=True)
        doubts += [scene.edge.warning] if scene.edge.warning else []
        results: dict[str, Report] = {}
        pictures, notes = {}, [f"derived: {scene.lens.derived}"] if scene.lens.derived else []
        for what in (*(self.what or (() if self.copies else WHATS)), *(["copies"] if self.copies else [])):
            try:
                results[what], picture = self._one(what, scene, doubts)
            except InputError as error:
                if self.what:
                    raise
                notes.append(f"{what} left out: {error}")
                continue
            if picture is not None:
                pictures[what] = str(picture)
        found = Analysed(
            str(self.file), scene.lens.name, scene.axis, scene.focus_m, scene.edge, results, pictures, notes, doubts,
            time.perf_counter() - began, state_text(scene),
        )  # fmt: skip
        return self.answer(found, full=self.full)

    def _scene(self) -> tuple[Scene, list[str]]:
        """Return the lens with its object in its state, and warnings."""
        from neurolens.optics.analysis.fields import Scene
        from neurolens.studies.describe import file_doubts, rim_doubts

        with warned(self.file) as notes:  # such as glasses that contradict the catalogue, or constant indices
            tabled = read_any(self.file)
        lens = set_lens(tabled, shot := self.state.shot())
        scene = Scene(lens, focus_of(lens, shot), self.axis)
        with warned(self.file) as doubts:
            for nm in self.waves_nm or scene.waves_nm:
                check_light(lens, nm)
        return scene, [*notes, *rim_doubts(lens), *file_doubts(tabled, states=bool(self.state.given.zoom)), *doubts]

    def _one(self, what: str, scene: Scene, doubts: list[str]) -> tuple[Report, Path | None]:
        """Compute one analysis, and draw it where a folder is given; new warnings are added to `doubts`."""
        from neurolens.optics.analysis.bundles import check_light
        from neurolens.optics.analysis.layout import state_text

        analysis, options = analysis_of(what), dict[str, Any]()
        if what in _OF_FIELDS:
            options = {"field_deg": self.field_points, "wavelength_nm": self.waves_nm}
            dark = check_light(scene, self.field_points, (self.waves_nm or scene.waves_nm)[0])
            doubts += [d for d in dark if d not in doubts]
        elif what == "copies":
            limits = Tolerances.read(self.tolerances)
            options = {
                "limits": limits,
                "number": self.copies,
                "seed": self.seed,
                "wavelength_nm": self.waves_nm,
                "progress": self.progress(),
            }
        elif what == "mtf-height":
            options = {"frequency_per_mm": self.frequencies, "wavelength_nm": self.waves_nm}
        result = analysis.compute(scene, **{k: v for k, v in options.items() if v is not None})
        if self.out is None:
            return result, None
        across = f"_{self.axis}" if scene.lens.anamorphic else ""
        path = self.out / f"{scene.lens.lens_id}_{what}{across}.{self.format}"
        warning = wrap(f"Warning: {scene.edge.warning}", _WRAP) if scene.edge.warning else []
        if what == "layout":
            analysis.draw(replace(result, subtitle="\n".join([result.subtitle, *warning])), path)
        else:
            analysis.draw(result, path, scene.lens.name, "\n".join([state_text(scene), *warning]))
        return result, path


@dataclass(frozen=True)
class Analysed(Report):
    """The analyses of a lens by name, with the widest field that they go to."""

    file: str
    name: str
    axis: str
    focus_m: float
    edge: FieldEdge
    results: dict[str, Report] = field(metadata=PART)
    pictures: dict[str, str]
    notes: list[str]
    warnings: list[str]
    seconds: float
    state: str

    def text(self) -> str:
        """Return every analysis as a table."""
        edge, drawn = self.edge, f"{len(self.pictures)} pictures drawn in"
        widest = f"fields to {edge.field_deg:.2f}°, {edge.height_mm:.2f} mm: {edge.name}"
        folders = {str(Path(file).parent) for file in self.pictures.values()}
        return "\n\n".join([
            f"{self.name}\n{self.state}\n{widest}",
            *(analysis_of(what).table(found) for what, found in self.results.items()),
            *(f"Note: {note}" for note in self.notes),
            *(f"Warning: {warning}" for warning in self.warnings),
            *(f"{drawn} {folder}" for folder in folders),
        ])  # fmt: skip


def analysis_of(what: str) -> Analysis:
    """Return the analysis of a name; torch and matplotlib are imported here, not when the command line starts."""
    from neurolens.optics.analysis import plots
    from neurolens.optics.analysis.corners import spread
    from neurolens.optics.analysis.field_curves import colour, curvature, distortion, illumination, seidel
    from neurolens.optics.analysis.layout import layout_profile, lens_layout
    from neurolens.optics.analysis.psf import psf
    from neurolens.optics.analysis.spots import fans, mtf, mtf_over_height, spots

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
        "copies": Analysis(spread, plots.plot_spread, _spread_text),
    }[what]


_ROWS = 6  # rows of tables over the field
_WRAP = 90  # characters of a line that the narrowest picture has room for
_MTF_PER_MM = (10, 20, 30, 40, 50)


def _layout_text(found: Layout) -> str:
    rows = [(label, str(count)) for label, count in Counter(ray.label for ray in found.rays).items()]
    return f"Layout: {len(found.surfaces)} surfaces\n" + cli.table(("field", "rays drawn"), rows)


def _spots_text(found: Spots) -> str:
    off = found.spread
    of_waves = zip(found.rms_by_wavelength_um.T, off["rms_by_wavelength_um"].T, strict=True)
    places = [_digits(spread) + 1 for spread in off["best_shift_mm"]]
    columns = [
        ("RMS µm", _each(_three, found.rms_um, off["rms_um"])),
        *((nm, _each(_three, *both)) for nm, both in zip(_nanometres(found.wavelength_nm), of_waves, strict=True)),
        ("largest µm", _each(_three, found.geometric_um, [20 * spread for spread in off["geometric_um"]])),
        ("passed", _each(_percent, found.passed, off["passed"])),
        ("best focus mm", _each(_fixed, found.best_shift_mm, places)),
        ("RMS there", _each(_three, found.best_rms_um, off["best_rms_um"])),
    ]
    airy, working = cli.number(found.airy_um, 3), cli.number(found.working_f_number, 3)
    airy = f"Airy disc radius {airy} µm at the working f/{working}"
    head = f"Spots (radius from the centroid, all wavelengths; each by itself; {airy})"
    return _over_field(head, found, columns, every=True)


def _fans_text(found: Fans) -> str:
    def largest(row: Sequence[float]) -> str:
        return _three(max((abs(v) for v in row if not math.isnan(v)), default=math.nan))

    columns = [
        (f"{name} {nm}", _each(largest, values[:, w]))
        for name, values in (("tang.", found.tangential_um), ("sag.", found.sagittal_um))
        for w, nm in enumerate(_nanometres(found.wavelength_nm))
    ]
    return _over_field("Ray fans (largest transverse aberration, µm)", found, columns, every=True)


def _colour_text(found: Colour) -> str:
    some = some_of(range(len(found.spectrum_nm)), 9)
    zones = ("paraxial", *(f"zone {z:.2f}" for z in found.zone[1:]))
    first = [(f"{found.spectrum_nm[i]:.0f} nm", *_each(_three, found.focus_shift_mm[i])) for i in some]
    head = "Lateral colour (height from that of the first line, µm)"
    of_lines = zip(found.line_nm, found.lateral_um.T, strict=True)
    lateral = _over_field(head, found, [(f"{nm:.0f} nm", _each(_three, values)) for nm, values in of_lines])
    return f"Longitudinal colour (focus from the film, mm)\n{cli.table(('wavelength', *zones), first)}\n\n{lateral}"


def _curvature_text(found: Curvature) -> str:
    head = f"Field curvature (focus from the film, mm; Petzval radius {cli.number(found.petzval_radius_mm)} mm)"
    curves = {"tangential": found.tangential_mm, "sagittal": found.sagittal_mm, "Petzval": found.petzval_mm}
    return _over_field(head, found, [(name, _each(_three, values)) for name, values in curves.items()])


def _distortion_text(found: Distortion) -> str:
    head = (
        f"Distortion (%; {_fixed(found.edge_percent, 2)}% at {found.edge}, against {found.reference}; "
        f"closest is {found.best}; {cli.number(found.scale_mm)} mm per radian on the axis)"
    )
    columns = [(name.partition(",")[0], _each(_three, values)) for name, values in found.error_percent.items()]
    return _over_field(head, found, columns)


def _vignetting_text(found: Illumination) -> str:
    names = {"relative": "illumination", "unvignetted": "without rims", "passed": "rims pass", "cos4": "cos^4"}
    settled = [0.0] * len(found.field_deg)
    columns = [
        (name, _each(_percent, getattr(found, key), found.spread.get(key, settled))) for key, name in names.items()
    ]
    return _over_field("Vignetting and relative illumination", found, columns)


def _mtf_text(found: Mtf, over_height: bool = False) -> str:
    """Return the contrast at `_MTF_PER_MM` for every field, or at all frequencies over the image height."""
    at = [k for k, f in enumerate(found.frequency_per_mm) if over_height or f in _MTF_PER_MM]
    limit = ", ".join(_fixed(found.diffraction_limit[k]) for k in at)
    waves = ", ".join(f"{w:.0f}" for w in found.wavelength_nm)
    name = "Geometric MTF" + " against image height" * over_height
    head = f"{name} ({waves} nm; T tangential, S sagittal; without diffraction, whose limit is {limit})"
    columns = []
    for k in at:
        for key in ("tangential", "sagittal"):
            values, spreads = (each[key][:, k] for each in (vars(found), found.spread))
            heading = f"{found.frequency_per_mm[k]:g}/mm {key[0].upper()}"
            columns.append((heading, _each(_fixed, values, _each(_digits, spreads))))
    return _over_field(head, found, columns, every=not over_height)


def _seidel_text(found: Seidel) -> str:
    header = ("surface", *(name.replace(" colour", "") for name in found.names))
    rows = [
        *((str(k), *(f"{round(v, 5) + 0.0:.5f}" for v in row)) for k, row in enumerate(found.surfaces)),
        ("total", *(f"{round(v, 5) + 0.0:.5f}" for v in found.total)),
    ]
    odd = found.odd_powers
    note = f"\nNot counted: the odd powers of surface {', '.join(map(str, odd))}" if odd else ""
    head = f"Seidel sums (mm, {found.wavelength_nm:.0f} nm, image height {cli.number(found.image_height_mm)} mm)"
    return f"{head}\n" + cli.table(header, rows) + note


def _psf_text(found: Psf) -> str:
    off = found.spread
    columns = [
        ("picture ± µm", _each(_three, found.half_width_um, [20 * spread for spread in off["half_width_um"]])),
        ("Strehl ratio", _each(_fixed, found.strehl, _each(_digits, off["strehl"]))),
    ]
    head = f"Point spread ({found.wavelength_nm[0]:.0f} nm; Strehl ratio '-' where aberrations rule out diffraction)"
    return _over_field(head, found, columns, every=True)


def _spread_text(found: Spread) -> str:
    """Return a row for every place of the picture: the design's figure, and the 10%, 50% and 90% of the copies."""
    shares, last = (0.1, 0.5, 0.9), f"{found.frequency_per_mm[-1]:g}/mm"
    header = ("place", "RMS µm", "10%", "half", "90%", f"MTF {last} T", "S", "both, 10%", "half", "90%")
    rms, mtf = (np.quantile(v, shares, axis=0).T for v in (found.copy_rms_um, found.copy_contrast))
    rows = [
        (place, _three(found.rms_um[k]), *map(_three, rms[k]), _fixed(found.tangential[k, -1]),
         _fixed(found.sagittal[k, -1]), *map(_fixed, mtf[k]))
        for k, place in enumerate(found.place)
    ]  # fmt: skip
    turn = np.hypot(found.film_tilt_deg, found.film_swing_deg)
    (row, place), (x, y) = found.softest, np.abs([found.x_mm[1], found.y_mm[1]])
    return "\n".join([
        f"Copies ({len(found.copy)}, seed {found.seed}; as designed, and what 10%, half and 90% of them have at most; "
        f"corners at ±{x:.1f}, ±{y:.1f} mm of the picture)",
        cli.table(header, rows),
        f"focal plane turned by {_three(np.median(turn))}° (median), at most {_three(turn.max())}°; softest: copy "
        f"{found.copy[row]}, {found.place[place]}, {_fixed(found.copy_contrast[row, place])} at {last}",
    ])  # fmt: skip


def _each(form: Callable[..., Any], *values: Iterable[Any]) -> list[Any]:
    """Apply `form` to each value, or to the values of several lists that stand at one place."""
    return [form(*those) for those in zip(*values, strict=True)]


def _over_field(head: str, found: Any, columns: Sequence[tuple[str, list[str]]], every: bool = False) -> str:
    """Return a table with a row for some fields, or for `every` one: its angle, its height, then the cells."""
    places = range(len(found.field_deg))
    angles = ["axis" if field == 0 else f"{field:.2f}°" for field in found.field_deg]
    heights = [("height mm", _each(partial(_fixed, places=2), found.height_mm))] if hasattr(found, "height_mm") else []
    shown = [*heights, *columns]
    rows = [(angles[i], *(cells[i] for _, cells in shown)) for i in (places if every else some_of(places, _ROWS))]
    return f"{head}\n{cli.table(('field', *(heading for heading, _ in shown)), rows)}"


def _nanometres(waves: Iterable[float]) -> list[str]:
    return [f"{nm:.0f} nm" for nm in waves]


def _digits(spread: float) -> int:
    """Return decimal places, 1 to 3: two samplings that differ by `spread` differ by at most 1 in the last place."""
    return 3 if spread <= 1e-3 else max(1, math.floor(-math.log10(spread)))


def _fixed(value: float, places: int = 3) -> str:
    return "-" if math.isnan(value) else f"{value + 0.0:.{places}f}"


def _percent(value: float, spread: float = 0.0) -> str:
    return "-" if math.isnan(value) else f"{100 * value:.{max(_digits(spread) - 2, 0)}f}%"


def _three(value: float, spread: float = 0.0) -> str:
    """Write three digits, or fewer: samplings that differ by `spread` of the value differ by at most 1 in the last."""
    if not 1e-6 <= abs(value) < math.inf:
        return cli.number(0.0 if abs(value) < 1e-6 else value)  # a zero may come with rounding errors
    units = math.ceil(math.log10(max(spread * abs(value), 1e-300)))
    digits = max(min(math.floor(math.log10(abs(value))) - units + 1, 3), 1)
    return cli.number(float(f"{value:.{digits}g}"))
