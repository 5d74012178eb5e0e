"""`neurolens analyse LENS [WHAT ...]`: what lens designers look at, as tables, JSON and pictures."""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from neurolens.base.errors import InputError
from neurolens.commands import analyse_text as text
from neurolens.commands.arguments import add_json, add_lens_state, aperture_of, between, focus_of
from neurolens.commands.output import print_json

if TYPE_CHECKING:
    from neurolens.analysis.fields import Scene

WHATS = (
    *("layout", "spots", "fans", "colour", "curvature", "distortion", "vignetting", "mtf", "seidel", "psf"),
)  # fmt: skip
_OF_FIELDS = ("spots", "fans", "mtf", "psf")  # take --fields and --wavelengths
_BULK = {  # left out of the JSON unless asked for: a number a ray or a pixel
    "layout": ("rays", "surfaces"),
    "spots": ("tangential_um", "sagittal_um", "slope_tangential", "slope_sagittal"),
    "psf": ("geometric", "diffraction"),
}

_DESCRIPTION = """\
Trace a lens from the scene and show what designers look at. WHAT is any of:

  layout      the section of the lens with rays
  spots       spot diagrams over field and focus, RMS and geometric radius, Airy disc
  fans        transverse aberration over the pupil, tangential and sagittal
  colour      longitudinal colour by zones, 380 to 780 nm, and lateral colour over the field
  curvature   field curvature and astigmatism, from close rays about the chief ray
  distortion  against f tan(theta), and for wide lenses against the projection that fits best
  vignetting  vignetting and relative illumination
  mtf         geometric MTF, tangential and sagittal, with the diffraction limit beside
  seidel      Seidel sums S1 to S5 and the colour sums C1 and C2, surface by surface
  psf         point spread, geometric and by diffraction

Without WHAT all are shown. Rays fill the real stop, whatever the pupils do; fields are angles
from the axis in degrees, of the chief ray in the scene. Needs the extra "train" (torch)."""
_EPILOG = """\
examples:
  neurolens analyse lenses/laikin_double_gauss_50.toml
  neurolens analyse lenses/shimizu_fisheye_220.toml distortion vignetting -o pictures
  neurolens analyse lenses/brendel_tessar_100.toml spots mtf --f-number 5.6 --focusing best --json"""


class _Analysis(NamedTuple):
    """How one WHAT is computed, drawn and printed."""

    compute: Callable[..., Any]
    draw: Callable[..., Path]
    table: Callable[[dict[str, Any]], str]


def add_parser(subparsers: Any) -> None:
    """Add the command to the command line."""
    parser = subparsers.add_parser(
        "analyse", help="spots, MTF, distortion and more of a lens file", description=_DESCRIPTION, epilog=_EPILOG
    )
    parser.add_argument("file", metavar="LENS", type=Path, help="lens file (lenses/*.toml)")
    parser.add_argument("what", metavar="WHAT", nargs="*", help="what to show (default: all)")
    add_lens_state(parser, {"efl": "as tabled", "f_number": "the tabled stop", "focus": "inf"})
    parser.add_argument(
        "--fields", metavar="DEG", nargs="+", type=between(0, 179, "degrees"),
        help="fields of spots, fans, mtf and psf (default: axis, 50%%, 70%%, 85%% and edge of the field)",
    )  # fmt: skip
    parser.add_argument(
        "--wavelengths", metavar="NM", nargs="+", type=between(300, 2500, "wavelengths in nm"),
        help="of spots, fans, mtf and psf, 300 to 2500 nm, the reference first (default: the lines d, F and C)",
    )  # fmt: skip
    parser.add_argument(
        "--axis", choices=("x", "y"), default="y", help="plane of the field, for anamorphic lenses (default: y)"
    )
    parser.add_argument("-o", "--output", metavar="FOLDER", type=Path, help="draw a picture of each in this folder")
    parser.add_argument("--format", choices=("png", "pdf", "svg"), default="png", help="of the pictures (default: png)")
    add_json(parser)
    parser.add_argument("--full", action="store_true", help="with --json: also every ray and every pixel")
    parser.intermixed = True
    parser.set_defaults(run=run, kept="pictures that are finished stay")


def run(args: argparse.Namespace) -> int:
    """Print the analyses asked for, and draw them where a folder is given."""
    unknown = [w for w in args.what if w not in WHATS]
    if unknown:
        raise InputError("neurolens analyse", "WHAT", unknown[0], f"any of: {', '.join(WHATS)}")
    if args.full and not args.json:
        raise InputError("neurolens analyse", "--full", "(given)", "this option only with --json")
    if args.output is not None:
        if args.output.exists() and not args.output.is_dir():
            raise InputError(args.output, "--output", str(args.output), "a folder")
        args.output.mkdir(parents=True, exist_ok=True)
    from neurolens.commands.analyse_notes import state_notes

    began = time.perf_counter()
    scene, doubts = scene_of(args)
    scene.check()
    found, pictures, notes = {}, {}, state_notes(scene.lens)
    for what in args.what or WHATS:
        try:
            found[what], picture = _one(what, scene, args)
        except InputError as error:
            if args.what:
                raise
            notes.append(f"{what} left out: {error}")
            continue
        if picture is not None:
            pictures[what] = str(picture)
    head = {"file": str(args.file), "name": scene.lens.name, "axis": scene.axis, "focus_m": scene.focus_m}
    more = {"pictures": pictures, "notes": notes, "warnings": doubts, "seconds": time.perf_counter() - began}
    if args.json:
        print_json({**head, **{w: _trimmed(w, d, args.full) for w, d in found.items()}, **more})
    else:
        parts = [f"{scene.lens.name}\n{_subtitle(scene)}", *(_analysis(w).table(d) for w, d in found.items())]
        parts += [*(f"Note: {n}" for n in notes), *(f"Warning: {w}" for w in doubts)]
        if pictures:
            parts.append(f"{len(pictures)} pictures drawn in {args.output}")
        print("\n\n".join(parts))
    return 0


def scene_of(args: argparse.Namespace) -> tuple[Scene, list[str]]:
    """The lens in the state that the arguments of `add_lens_state` ask for with its object, and what is doubtful."""
    from neurolens.analysis.fields import DEFAULT_NM, Scene
    from neurolens.commands.analyse_notes import read_told, table_warnings, wavelength_warnings

    tabled, told = read_told(args.file)
    lens = tabled.at(
        zoom=args.zoom,
        focal_length_mm=args.efl,
        field_deg=args.field,
        f_number=args.f_number,
        focus_m=args.focus,
        focus=args.focusing,
    ).with_aperture(aperture_of(args) or tabled.aperture)
    told += table_warnings(tabled, lens, args.zoom) + wavelength_warnings(lens, args.wavelengths or DEFAULT_NM)
    return Scene(lens, focus_of(args, tabled, lens), args.axis), told


def _one(what: str, scene: Scene, args: argparse.Namespace) -> tuple[dict[str, Any], Path | None]:
    """One analysis as plain data, and its picture where a folder is given."""
    from neurolens.analysis.bundles import check_light
    from neurolens.analysis.fields import DEFAULT_NM

    analysis = _analysis(what)
    options = {"field_deg": args.fields, "wavelength_nm": args.wavelengths}
    asked = {k: v for k, v in options.items() if v is not None} if what in _OF_FIELDS else {}
    if what in _OF_FIELDS:
        check_light(scene, args.fields, (args.wavelengths or DEFAULT_NM)[0])
    result = analysis.compute(scene, **asked)
    data = result if isinstance(result, dict) else result.to_dict()
    if args.output is None:
        return data, None
    across = f"_{args.axis}" if any(s.cylinder for s in scene.lens.surfaces) else ""
    path = args.output / f"{scene.lens.lens_id}_{what}{across}.{args.format}"
    if what == "layout":
        return data, analysis.draw(result, path)
    return data, analysis.draw(result, path, scene.lens.name, _subtitle(scene))


def _subtitle(scene: Scene) -> str:
    from neurolens.analysis.layout import state_text

    return state_text(scene)


def _trimmed(what: str, data: dict[str, Any], full: bool) -> dict[str, Any]:
    return data if full else {k: v for k, v in data.items() if k not in _BULK.get(what, ())}


def _analysis(what: str) -> _Analysis:
    """Looked up by name; torch and matplotlib are loaded here, not when the command line starts."""
    from neurolens.analysis import plots
    from neurolens.analysis.field_curves import colour, curvature, distortion, illumination
    from neurolens.analysis.layout import layout_profile, lens_layout
    from neurolens.analysis.seidel import seidel
    from neurolens.analysis.spots import fans, mtf, spots
    from neurolens.analysis.wavefront import psf

    return {
        "layout": _Analysis(layout_profile, lens_layout, text.layout),
        "spots": _Analysis(spots, plots.plot_spots, text.spots),
        "fans": _Analysis(fans, plots.plot_fans, text.fans),
        "colour": _Analysis(colour, plots.plot_colour, text.colour),
        "curvature": _Analysis(curvature, plots.plot_curvature, text.curvature),
        "distortion": _Analysis(distortion, plots.plot_distortion, text.distortion),
        "vignetting": _Analysis(illumination, plots.plot_vignetting, text.vignetting),
        "mtf": _Analysis(mtf, plots.plot_mtf, text.mtf),
        "seidel": _Analysis(seidel, plots.plot_seidel, text.seidel),
        "psf": _Analysis(psf, plots.plot_psf, text.psf),
    }[what]
