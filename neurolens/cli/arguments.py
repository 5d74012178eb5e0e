"""Shared arguments of commands: numbers with range and unit, the state of a lens, help with examples."""

from __future__ import annotations

import argparse
import math
import re
import sys
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, nullcontext
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

from neurolens.base.bounds import WAVELENGTH_NM
from neurolens.base.errors import InputError, one_line
from neurolens.base.lensname import lens_id_of, resolve
from neurolens.base.options import add_options, from_options, number, option_names
from neurolens.base.records import program
from neurolens.lens.shot import LENS_SIZE, LENS_STATE, FocusMode, Shot, StopShape

if TYPE_CHECKING:
    from neurolens.lens.apertures import Aperture
    from neurolens.lens.prescription import Lens


class Help(argparse.RawDescriptionHelpFormatter):
    """Help whose texts are shown as they are written: line breaks stay, and % is a percent sign."""

    def _expand_help(self, action: argparse.Action) -> str:
        return self._get_help_string(action) or ""


class Parser(argparse.ArgumentParser):
    """A parser with one-line error messages, whose help keeps its line breaks.

    Attributes:
        intermixed: whether options may stand before and between the arguments of a list.
        renamed: words at the start of a command line, and the words that replaced them.
    """

    def __init__(self, **options: Any) -> None:
        options.setdefault("formatter_class", Help)
        # An abbreviation can become ambiguous when an option is added.
        super().__init__(allow_abbrev=False, **options)
        self._negative_number_matcher = re.compile(r"-\.?\d")  # no option: -12,3 is a value, as -12 is
        self.intermixed = False
        self.renamed: dict[tuple[str, ...], tuple[str, ...]] = {}

    def parse_known_args(self, args: Any = None, namespace: Any = None) -> Any:
        """Parse as argparse does; old names of commands work; an intermixed one reports unknown arguments itself."""
        args = sys.argv[1:] if args is None else list(args)
        for old, new in self.renamed.items():
            if tuple(args[: len(old)]) == old:
                args = [*new, *args[len(old) :]]
        if self.intermixed:
            self.intermixed = False  # argparse comes back here for its two passes
            try:
                found, rest = self.parse_known_intermixed_args(args, namespace)
            finally:
                self.intermixed = True
            if rest:
                self.error(f"unrecognized arguments: {' '.join(rest)}")
            return found, rest
        return super().parse_known_args(args, namespace)

    def error(self, message: str) -> NoReturn:
        self.exit(
            2, f"{self.prog}: {one_line(message, 1000)} (see {self.prog.replace('neurolens', program(), 1)} --help)\n"
        )


def positive(unit: str, *, infinite: bool = False) -> Callable[[str], float]:
    """Type of an argument that is a number above 0; "inf" only if `infinite`."""
    expected = f"{unit} above 0{', or inf' if infinite else ''}"
    return number(float, lambda value: value > 0 and (infinite or not math.isinf(value)), expected)


def between(low: float, high: float, unit: str) -> Callable[[str], float]:
    """Type of an argument that is a number from `low` to `high`."""
    return number(float, lambda value: low <= value <= high, f"{unit} from {low:g} to {high:g}")


def whole(least: int, most: int | None = None) -> Callable[[str], int]:
    """Type of an argument that is an integer from `least` to `most`."""
    span = f"from {least}" + ("" if most is None else f" to {most}")
    return number(int, lambda value: value >= least and (most is None or value <= most), f"an integer {span}")


def add_option(
    parser: argparse._ActionsContainer, *names: str, old: Sequence[str] = (), **options: Any
) -> argparse.Action:
    """Add an option as `add_argument` does; its `old` spellings still work, and neither help nor errors show them."""
    action = parser.add_argument(*names, **options)
    parser._option_string_actions.update(dict.fromkeys(old, action))
    return action


def add_output(parser: argparse._ActionsContainer, metavar: str, about: str, **options: Any) -> None:
    """Add -o and --output, the file or folder that a command writes."""
    options = {"dest": "out", "metavar": metavar, "type": Path, "help": about} | options
    add_option(parser, "-o", "--output", old=("--out",), **options)


def rms_error(text: str) -> tuple[str, float]:
    """Type of --within: the key of a model card's error, "rms_um" or "rms_px", and its bound."""
    match = re.fullmatch(r"([0-9.]{1,20}(?:e-?[0-9]{1,3})?)(um|px)", text)
    try:
        if match and 0 < float(match[1]) < 1e9:
            return f"rms_{match[2]}", float(match[1])
    except ValueError:
        pass
    raise argparse.ArgumentTypeError(f"got {text!r}, expected a number above 0 and its unit, as 1um or 0.1px")


def add_within(parser: argparse._ActionsContainer, about: str, **options: Any) -> None:
    """Add --within, an RMS error with its unit as `rms_error`, and its old spelling for each unit."""
    parser.add_argument("--within", metavar="ERROR", type=rms_error, help=about, **options)
    for unit in ("um", "px"):
        kind = partial(lambda unit, text: rms_error(text + unit), unit)
        parser.add_argument(f"--target-{unit}", dest="within", type=kind, help=argparse.SUPPRESS, **options)


def wavelengths_nm(text: str) -> tuple[float, ...]:
    """Type of --wavelengths: one or more in nm, with commas between them."""
    return tuple(between(*WAVELENGTH_NM, "wavelengths in nm")(word) for word in text.split(","))


SHOT_OPTIONS = (*LENS_SIZE, *LENS_STATE, "film_offset_mm", "vignetting")  # fields of a `Shot`, of `shot_of`
QUIET_HELP = "neither progress nor warnings on stderr"

CAMERAS_HELP = """\
cameras:
  LENS                         the lens of a file (.toml, .zmx, ..., see neurolens convert) or of a name in lenses/,
                               traced exactly, every ray through every surface
  MODEL.onnx                   an exported model of a lens
  fused:LENS, fused:MODEL.onnx the same, compiled by the system's C compiler: many times faster
  thick:LENS                   its principal planes and pupils: ideal imaging, no rims
  thin:LENS, pinhole:LENS      a thin lens, a point: the plane in focus has the lens's size
  thin, pinhole                the same of any focal length (--focal-length)
  fisheye-equidistant, fisheye-equisolid, fisheye-stereographic, fisheye-orthographic
                               points with these projections; --field sets the picture's circle"""


def add_camera(parser: argparse.ArgumentParser) -> None:
    """Add --camera, --film-offset and --vignetting."""
    add_lens(parser, "--camera", models=True, cameras=True)
    add_options(parser, Shot, ("film_offset_mm", "vignetting"), unset=True)


def add_lens_state(parser: argparse.ArgumentParser) -> None:
    """Add the options of a `Shot` that set a lens, and of the shape of its stop."""
    add_glass(parser)
    group = parser.add_argument_group("state of the lens")
    add_options(group.add_mutually_exclusive_group(), Shot, LENS_SIZE, unset=True)
    add_options(group, Shot, LENS_STATE, unset=True)
    add_options(parser.add_argument_group("shape of the stop"), StopShape)


def aperture_of(args: argparse.Namespace) -> Aperture | None:
    """The stop's shape by the arguments of `add_lens_state`; None if not given.

    Raises:
        InputError: shapes that exclude each other, a picture that cannot be read.
    """
    from neurolens.render.images import make_aperture

    return make_aperture(from_options(StopShape(), args))


def shot_of(args: argparse.Namespace, film_mm: tuple[float, float], **settings: Any) -> Shot:
    """The shot by the arguments of `add_lens_state` and `add_camera`, at infinity without --focus; `settings` are other
    fields.

    Raises:
        InputError: as `Shot` and `aperture_of`.
    """
    return from_options(Shot(film_mm, math.inf, aperture=aperture_of(args), **settings), args)


def state_of(args: argparse.Namespace, tabled: Lens) -> Lens:
    """The lens of a file in the state of the arguments of `add_lens_state`; raises InputError as `set_lens`."""
    from neurolens.setting.focusing import best_focused
    from neurolens.setting.states import set_lens

    mode: FocusMode = args.focus_mode or "best"
    lens = set_lens(tabled.with_aperture(aperture_of(args) or tabled.aperture),
        zoom=args.zoom, focal_length_mm=args.focal_length_mm, field_deg=args.field_deg, f_number=args.f_number,
        focus_m=args.focus_m, focus_mode=mode,
    )  # fmt: skip
    return best_focused(lens, focus_of(args, tabled, lens)) if mode == "internal" else lens


def focus_of(args: argparse.Namespace, tabled: Lens, lens: Lens) -> float:
    """Film to object in metres by the arguments of `add_lens_state` or the focus state they name, else inf.

    `tabled` is the lens of the file, `lens` its state.
    """
    if args.focus_m is not None:
        return float(args.focus_m)
    near = next((c.object_distance_mm for c in tabled.configurations if c.name == args.zoom), None)
    if near is None:
        return math.inf
    row = 1 if tabled.surfaces[0].stop else 0  # a stop's diameter follows the f-number, too
    scale = lens.surfaces[row].diameter_mm / tabled.surfaces[row].diameter_mm
    return float(near * scale + (lens.film_z_mm or lens.vertices_mm[-1])) / 1000


def given_options(args: argparse.Namespace) -> list[str]:
    """The options of `add_lens_state` that were given, for modes without a lens state."""
    options = option_names(Shot, (*LENS_SIZE, *LENS_STATE)) | option_names(StopShape)
    return [option for name, option in options.items() if getattr(args, name) is not None]


def add_exposure(parser: argparse._ActionsContainer, default: float | None = 0.0, about: str = "0") -> None:
    """Add --exposure; `about` describes the default."""
    parser.add_argument(
        "--exposure", metavar="STOPS", type=between(-40, 40, "stops"), default=default,
        help=f"stops by which the preview OUT.png is brighter; OUT.exr keeps the light as it is (default: {about})",
    )  # fmt: skip


def add_json(parser: argparse.ArgumentParser, quiet: bool = False) -> None:
    """Add --json, and --quiet before it where a command shows its progress."""
    if quiet:
        parser.add_argument("--quiet", action="store_true", help=QUIET_HELP)
    parser.add_argument(
        "--json", action="store_true", help="print one JSON object on stdout instead of the text; keys carry their unit"
    )


def add_lens(
    parser: argparse._ActionsContainer, name: str, also: str = "", *, models: bool = False, cameras: bool = False,
    **options: Any,
) -> None:  # fmt: skip
    """Add an argument that names a lens, as `resolve`; its value is a path, or with `cameras` the text of a `Named`.

    Args:
        also: what the help adds. models, cameras: what is taken besides lenses. options: of `add_argument`.
    """

    def named(text: str) -> Any:
        try:
            found = resolve(text, models=models, cameras=cameras)
            return str(found) if cameras else found.file
        except InputError as error:
            raise argparse.ArgumentTypeError(str(error)) from None

    taken = ", model (.onnx), or name of either" if models else ", or its name in lenses/"
    taken += ", fused: before it, thick:LENS, thin, pinhole or fisheye-PROJECTION" if cameras else ""
    options = {"metavar": "CAMERA" if cameras else "LENS", "help": f"lens file of any format{taken}{also}"} | options
    parser.add_argument(name, type=named, **options)


def check_ids(files: Sequence[Path], command: str, option: str) -> None:
    """Refuse lens files of one id, whose results would have one name; raises InputError."""
    ids = [lens_id_of(file) for file in files]
    if twice := sorted({name for name in ids if ids.count(name) > 1}):
        raise InputError(command, option, twice, "files whose names differ")


def add_glass(parser: argparse._ActionsContainer) -> None:
    """Add --glass, for `more_glasses`."""
    parser.add_argument(
        "--glass", metavar="FILE.agf", dest="glass_files", type=Path, action="append", default=[],
        help="glass catalogue of Zemax, whose glasses come before those that ship (repeatable)",
    )  # fmt: skip


def add_dask(parser: argparse._ActionsContainer) -> None:
    """Add --dask."""
    parser.add_argument(
        "--dask", metavar="ADDRESS",
        help="run on a Dask cluster: the address of its scheduler (tcp://HOST:8786), or local (processes of this "
        "machine), or local:N, which no other user can reach. What a task reads travels with it: workers need "
        "neurolens alone, and no folder in common. Whoever reaches a scheduler at tcp:// can run programs as you; "
        "tls:// takes keys",
    )  # fmt: skip


def more_glasses(args: object) -> AbstractContextManager[None]:
    """A block in which the catalogues of --glass are known; without any, nothing is imported."""
    files = getattr(args, "glass_files", ())
    if not files:
        return nullcontext()
    from neurolens.readers.glasses import more_glasses

    return more_glasses(files)


def check_folder(path: Path, option: str) -> None:
    """Refuse a file to write whose folder is missing, before the work; raises InputError."""
    if not path.parent.is_dir():
        raise InputError(path, option, str(path.parent), "a folder that exists")


def check_run_folder(path: Path, command: str | Path, option: str) -> None:
    """Refuse a file where a folder is to be made or filled; raises InputError."""
    if path.exists() and not path.is_dir():
        raise InputError(command, option, str(path), "a folder, not a file")


def check_suffix(path: Path, option: str, suffixes: tuple[str, ...]) -> None:
    """Refuse a file to write of another kind, before the work; raises InputError."""
    if path.suffix.lower() not in suffixes:
        expected = suffixes[0] if len(suffixes) == 1 else f"one of {', '.join(suffixes)}"
        raise InputError(path, option, path.suffix or "(no suffix)", expected)
