"""`neurolens convert FILE -o lens.toml`: a lens file of another program in the project's own format."""

from __future__ import annotations

import argparse
import math
import warnings
from contextlib import suppress
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from neurolens.base.errors import InputError, NeurolensWarning
from neurolens.base.files import atomic_path
from neurolens.cli.arguments import add_glass, add_json, add_output, between, check_folder, check_suffix, positive
from neurolens.cli.output import answer, number

if TYPE_CHECKING:
    from neurolens.lens.prescription import Lens

_DESCRIPTION = """\
Read a lens file of another program and write it as a lens file of neurolens (.toml).

Formats: Zemax (.zmx), CODE V (.seq), OSLO (.len, the simple ones), texts of the Optical Bench (.txt), FlareSim
(.lens), the TOML of the Blender add-on Physical Camera, plain tables of four
columns as in pbrt and appleseed (.dat, .txt), and JSON (our own, DeepLens, ISET). The content decides.
What changes rays and is not supported is an error that names the line; what was left out, computed,
assumed or doubtful is printed as a warning and kept in the notes of the new file. Rims that a file does
not give, and the check of the lens against its own statements, are traced: they need the extra "train" (torch)."""
_EPILOG = """\
examples:
  neurolens convert double_gauss.zmx -o lenses/double_gauss.toml
  neurolens convert wide.22mm.dat -o wide.toml --name "Wide angle 22 mm" --source "Smith p. 360"
  neurolens convert triplet.seq -o triplet.toml --half-field 20 --json"""


def add_parser(subparsers: Any) -> None:
    """Add the command to the command line."""
    parser = subparsers.add_parser(
        "convert", help="read a lens file of another program", description=_DESCRIPTION, epilog=_EPILOG
    )
    parser.add_argument("file", metavar="FILE", type=Path, help="lens file of another program")
    add_output(parser, "OUT.toml", "lens file to write", required=True)
    parser.add_argument("--force", action="store_true", help="replace an existing file")
    group = parser.add_argument_group("what the file does not say")
    group.add_argument(
        "--name", metavar="NAME", help="name of the lens (default: the title in the file, else its file name)"
    )
    group.add_argument("--source", help="where the figures come from (default: the file's name)")
    group.add_argument(
        "--f-number", metavar="N", type=positive("an f-number"),
        help="nominal f-number of a file without one (default: as the stop's diameter gives it)",
    )  # fmt: skip
    group.add_argument(
        "--stop", metavar="N",
        help="number in the file of the surface that is the stop (default: the one marked, else the limiting rim)",
    )  # fmt: skip
    group.add_argument("--units", choices=("mm", "cm", "in", "m"), help="unit of lengths (default: the file's own, mm)")
    group.add_argument(
        "--half-field", metavar="DEG", type=between(1e-3, 179.0, "degrees"),
        help="edge of the field from the axis, for rims that the file does not give (default: the file's own)",
    )  # fmt: skip
    group.add_argument(
        "--gap-before", action="store_true", help="plain table: thickness is that in front of each surface (Kolb 1995)"
    )
    group.add_argument("--semi-diameters", action="store_true", help="plain table: the last column holds rim radii")
    add_glass(parser)
    add_json(parser)
    parser.set_defaults(run=run, kept="only a finished lens file is written")


def run(args: argparse.Namespace) -> int:
    """Convert one file and print what was read."""
    check_suffix(args.out, "--output", (".toml",))
    check_folder(args.out, "--output")
    if args.out.exists() and not args.force:
        raise InputError(args.out, "--output", "(an existing file)", "a new file, or --force to replace it")
    from neurolens.readers.any_format import read_any
    from neurolens.readers.draft import ReadOptions

    options = ReadOptions(
        name=args.name, source=args.source, f_number=args.f_number, units=args.units, half_field_deg=args.half_field,
        stop=args.stop, gap_before=args.gap_before, semi_diameters=args.semi_diameters,
    )  # fmt: skip
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", NeurolensWarning)
        lens = read_any(args.file, options)
    told = [str(w.message).removeprefix(f"{args.file}: ") for w in caught if issubclass(w.category, NeurolensWarning)]
    read = list(dict.fromkeys(told))
    if read:  # the file keeps what its source had besides, and what was assumed
        lens = replace(lens, notes="\n".join(filter(None, (lens.notes, "As converted by neurolens:", *read))))
    write_checked(lens, args.out)
    notes = [*read, *_doubts(lens)]
    data = {"file": str(args.file), "output": str(args.out), **_summary(lens, notes)}
    return answer(args, data, lambda: _text(data))


def _doubts(lens: Lens) -> list[str]:
    """Contradictions between the lens and statements of its file, as sentences."""
    if find_spec("torch") is None:
        return ["the lens is not checked against its file's statements: that needs torch (pip install '.[train]')"]
    from neurolens.setting.check import check_lens, doubts

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", NeurolensWarning)
            return doubts(check_lens(lens))
    except InputError as error:
        return [f"the lens cannot be checked: {error.field}: expected {error.expected}"]


def write_checked(lens: Lens, path: Path) -> None:
    """Write a lens file, and keep it only if it reads back to the same lens.

    Raises:
        InputError: it does not; with the file to be written.
    """
    from neurolens.readers.lensfile import format_lens, read_lens

    with atomic_path(path) as temporary:
        temporary.write_text(format_lens(lens), encoding="utf-8")
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", NeurolensWarning)  # already reported by the reader of the other format
            try:
                back = read_lens(temporary)
            except InputError as error:
                raise InputError(path, error.field, error.value, error.expected) from None
        if replace(back, path=lens.path) != lens:
            raise InputError(path, "content", "(another lens when read back)", "the lens that was read")


def _summary(lens: Lens, told: list[str]) -> dict[str, Any]:
    """Figures of the lens for text and --json; mm."""
    from neurolens.lens import paraxial
    from neurolens.readers.assemble import first_order

    data, efl_mm = first_order(lens), {"x": math.inf, "y": math.inf}
    axis: Literal["x", "y"]
    for axis in ("x", "y"):
        with suppress(InputError):  # a cylinder has no power in one of its planes
            efl_mm[axis] = paraxial.first_order(lens, meridian=axis).efl_mm
    return {
        "name": lens.name,
        "source": lens.source,
        "surfaces": len(lens.surfaces),
        "stop_surface": lens.stop_index,
        "efl_mm": efl_mm["y"],
        "efl_x_mm": efl_mm["x"] if lens.anamorphic else None,
        "back_focus_mm": data.back_focus_mm,
        "film_gap_mm": float(lens.surfaces[-1].thickness_mm),
        "f_number": data.f_number,
        "stated_f_number": lens.f_number,
        "rims": lens.rims,
        "configurations": [c.name for c in lens.configurations],
        "warnings": told,
    }


def _text(data: dict[str, Any]) -> str:
    across = "" if data["efl_x_mm"] is None else f" (in y; {number(data['efl_x_mm'], 6)} mm in x)"
    lines = [
        data["name"],
        data["source"],
        f"surfaces      {data['surfaces']}, stop on {data['stop_surface']}; rims: {data['rims']}",
        f"focal length  {number(data['efl_mm'], 6)} mm{across}",
        f"back focus    {number(data['back_focus_mm'], 6)} mm; film tabled at {number(data['film_gap_mm'], 6)} mm",
        f"f-number      f/{number(data['f_number'])}, stated f/{number(data['stated_f_number'])}",
    ]
    if data["configurations"]:
        lines.append(f"states        {', '.join(data['configurations'])}")
    lines += [f"warning: {text}" for text in data["warnings"]]
    return "\n".join([*lines, f"written to {data['output']}"])
