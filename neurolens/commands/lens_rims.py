"""`neurolens lens FILE --derive-rims`: rim diameters from a rule, beside those of the file."""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from neurolens.base.errors import InputError
from neurolens.commands.arguments import between
from neurolens.commands.output import print_json, table

if TYPE_CHECKING:
    from neurolens.optics.prescription import Lens
    from neurolens.optics.rims import Rim, RimRule


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add --derive-rims and what goes with it."""
    rims = parser.add_argument_group("rims")
    rims.add_argument(
        "--derive-rims", action="store_true",
        help="compute the diameters from the f-number and the field, and print them beside those of the file",
    )  # fmt: skip
    rims.add_argument(
        "--vignetting", metavar="SHARE", type=between(0.01, 1, "a share"),
        help="share of the pupil's height that is kept at the edge of the field (default: 0.5)",
    )  # fmt: skip
    rims.add_argument(
        "--half-field", metavar="DEG", type=between(0.01, 179, "an angle in degrees"),
        help="edge of the field, in degrees from the axis (default: as the file states)",
    )  # fmt: skip
    rims.add_argument("-o", "--output", metavar="OUT.toml", type=Path, help="write the lens with its derived rims")


def run(args: argparse.Namespace) -> int:
    """Print the table of rims; write the lens with derived rims only where -o asks for it."""
    from neurolens.evaluate.library import read_quietly
    from neurolens.optics.lenswriter import write_lens
    from neurolens.optics.rims import RimRule, derive_rims, half_field_deg

    if args.output is not None and not args.output.parent.is_dir():
        raise InputError(args.output, "-o", str(args.output.parent), "a folder that exists")
    lens = read_quietly(args.file)
    rule = RimRule(vignetting=0.5 if args.vignetting is None else args.vignetting, half_field_deg=args.half_field)
    derived, rims = derive_rims(lens, rule)
    field = args.half_field or half_field_deg(lens)
    if args.output is not None:
        write_lens(replace(derived, notes=_notes(derived, rule, field)), args.output)
    data = {
        "file": str(args.file),
        "f_number": lens.f_number,
        "vignetting": rule.vignetting,
        "clear_edge": rule.clear_edge,
        "half_field_deg": field,
        "rims": [vars(rim) for rim in rims],
        "output": None if args.output is None else str(args.output),
    }
    if args.json:
        print_json(data)
    else:
        print(_text(lens, data, rims))
    return 0


def _notes(lens: Lens, rule: RimRule, field: float) -> str:
    """The lens's notes and how its rims came about."""
    said = (
        f"Rims are derived by neurolens lens --derive-rims: the stop from the f-number, the whole axial beam, "
        f"{100 * rule.vignetting:g}% of the pupil's height kept at {field:.4g} degrees, "
        f"a clear edge of {100 * rule.clear_edge:g}%."
    )
    return f"{lens.notes} {said}".strip()


def _text(lens: Lens, data: dict[str, Any], rims: list[Rim]) -> str:
    rows = []
    for rim in rims:
        note = (
            "stop" if lens.surfaces[rim.surface].stop else "trimmed: a neighbour is in the way" if rim.trimmed else ""
        )
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
