"""The parser, the class of a command, the options that commands share, and what they print: JSON, numbers, tables."""

from __future__ import annotations

import argparse
import inspect
import json
import math
import re
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass, field, fields, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, NoReturn, Self

from neurolens.base.errors import InputError, note, one_line, printable, program, warn
from neurolens.base.files import check_writable, library
from neurolens.base.lensname import lens_id_of, resolve, split_kind
from neurolens.base.progress import Progress
from neurolens.base.report import Report, plain, write_tables
from neurolens.base.settings import (
    add_options,
    from_options,
    group,
    setting,
    spelling,
    with_changes,
)
from neurolens.base.tomlfile import suggestion
from neurolens.base.units import as_float
from neurolens.graph.compiler import compiled_so_far
from neurolens.optics.lens.shot import BY_LENSES, Shot, StopShape, film_size

if TYPE_CHECKING:
    from neurolens.cameras.contract import Camera
    from neurolens.optics.lens.apertures import Aperture
    from neurolens.optics.lens.paraxial import FirstOrderLight

CAMERAS_HELP = """\
cameras:
  LENS                         the lens of a file (.toml, .zmx, ..., see neurolens convert) or of a name in lenses/,
                               traced exactly, every ray through every surface
  MODEL.onnx                   an exported model of a lens
  thick:LENS                   its principal planes and pupils: ideal imaging, no rims
  thin:LENS, pinhole:LENS      a thin lens, a point: the plane in focus has the lens's size
  thin, pinhole                the same of 50 mm and f/4, or of --focal-length and --f-number
  fisheye-equidistant, fisheye-equisolid, fisheye-stereographic, fisheye-orthographic
                               points with these projections, of 14 mm; --field sets the picture's circle"""
# The file names that an argument takes, by its placeholder in the help: --plot PNG takes .png, .pdf and .svg.
_SUFFIXES = {"png": (".png", ".pdf", ".svg"), "html": (".html", ".htm"), "npz": (".npz", ".safetensors", ".exr")}
_FEW = 10  # options; the help of more shows those that are marked as common


class WholeHelp(argparse.Action):
    """An option that prints the help with all options, and ends."""

    def __call__(self, parser: Any, *rest: Any) -> None:
        """Print the help of a `Parser`."""
        parser.whole = True
        parser.print_help()
        parser.exit()


def first_example(epilog: str) -> str:
    """Return the first command line under "examples:" at the end of a help, with its continuation lines."""
    found = re.search(r"examples:\n  ((?:.*\\\n)*.*)", epilog)
    return found[1] if found else ""


class Help(argparse.RawDescriptionHelpFormatter):
    """Shows texts of help as they are written: line breaks stay, and % is a percent sign."""

    def _expand_help(self, action: argparse.Action) -> str:
        return self._get_help_string(action) or ""


class Parser(argparse.ArgumentParser):
    """A parser with one-line error messages, whose help keeps its line breaks.

    Attributes:
        intermixed: whether options may stand before and between the arguments of a list.
        whole: whether help shows all options.
        alone: whether it has something to do without any word.
        renamed: words at the start of a command line, and the words that have replaced them.
    """

    def __init__(self, **options: Any) -> None:
        options.setdefault("formatter_class", Help)
        # Abbreviations are refused, because one may become ambiguous when an option is added.
        super().__init__(allow_abbrev=False, **options)
        self._negative_number_matcher = re.compile(r"-\.?\d")  # numbers are no options: -12,3 is a value, as -12 is
        self.intermixed: bool | None = False
        self.whole, self.alone = False, True
        self.renamed: Mapping[str, Sequence[str]] = {}

    def parse_known_args(self, args: Any = None, namespace: Any = None) -> Any:
        """Parse as argparse does, with old names of commands; an unknown option is refused, with the nearest."""
        args = sys.argv[1:] if args is None else list(args)
        args = [*self.renamed.get(args[0], args[:1]), *args[1:]] if args else args
        args = self._sizes(args)
        if not (args or self.alone):
            first = re.split(r"(?<=\.)\s", " ".join(self._in_short().split()))[0]
            example = re.sub(r" *\\\n *", " ", first_example(self.epilog or ""))
            self.exit(2, f"{first}\nExample: {re.sub('^neurolens|(?<=&& )neurolens', program(), example)}\n")
        if self.intermixed:
            alone, self.alone, self.intermixed = self.alone, True, None  # argparse comes back here for its two passes
            try:
                found, rest = self.parse_known_intermixed_args(args, namespace)
            finally:
                self.alone, self.intermixed = alone, True
        else:
            found, rest = super().parse_known_args(args, namespace)
        if rest and self.intermixed is not None:
            known = [key[2:] for key in self._option_string_actions if key.startswith("--")]
            near = suggestion(rest[0][2:].partition("=")[0], known).replace("'", "'--", 1)
            self.error(f"unrecognized arguments: {' '.join(rest)}{near * rest[0].startswith('--')}")
        return found, rest

    def _sizes(self, args: list[str]) -> list[str]:
        """Return the words of a command line, with "--width 3840x2160" turned into width and height."""
        for at, word in enumerate(args):
            words = word if word.startswith("--width=") else " ".join(args[at : at + 2])
            found = re.fullmatch(r"--width[= ](\d+) ?x ?(\d+)", words, re.IGNORECASE)
            if found is None or "--width" not in self._option_string_actions:  # or of a command within
                continue
            if "--height" not in self._option_string_actions:
                self.error(f"argument --width: got '{found[1]}x{found[2]}', expected a width: the film sets the height")
            args = [*args[:at], f"--width={found[1]}", f"--height={found[2]}", *args[at + 1 + (word != words) :]]
        return args

    def _in_short(self) -> str:  # the first paragraph of the description
        return re.split(":?\n\n", self.description or "")[0].rstrip(".") + "."

    def format_help(self) -> str:
        """Format the help. Where there are many options, it shows the common ones, unless --help-all asks for more."""
        options = [a for a in self._actions if a.option_strings and a.help != argparse.SUPPRESS]
        rare = [a for a in options if not (a.required or getattr(a, "common", True))]
        if self.whole or not rare or len(options) <= _FEW + 1:  # with --help itself
            return super().format_help()
        shown = [a for a in self._actions if a not in rare]
        formatter = self._get_formatter()
        formatter.add_usage(self.usage, shown, [])
        formatter.add_text(self._in_short())
        for part in self._action_groups:
            formatter.start_section(part.title)
            formatter.add_arguments([a for a in part._group_actions if a in shown])
            formatter.end_section()
        if example := first_example(self.epilog or ""):
            formatter.add_text(f"example:\n  {example}")
        formatter.add_text(f"All {len(options)} options, and more examples: {self.prog} --help-all")
        return formatter.format_help()

    def error(self, message: str) -> NoReturn:
        self.exit(
            2, f"{self.prog}: {one_line(message, 1000)} (see {self.prog.replace('neurolens', program(), 1)} --help)\n"
        )


@dataclass(frozen=True, kw_only=True)
class Command:
    """A command: its fields are arguments and options (`base.settings`), and its docstring is the text of its help.

    Paths to write are checked before it runs, by the placeholder of their option. OUT.exr is a file of this kind in a
    folder that exists; FOLDER and DIR are folders, which are made; other words are the start of a file's name.

    Attributes:
        called: the command as errors name it.
        epilog: the end of the help, whose first example the short help has, too.
        kept: tells what an interrupted command leaves (see also `keeps`).
        intermixed: whether options may stand before and between the arguments of a list.
        alone: whether it has something to do without any word; else it then says what it does, with that example.
    """

    called: ClassVar[str]
    epilog: ClassVar[str] = ""
    kept: ClassVar[str] = "nothing is written"
    intermixed: ClassVar[bool] = False
    alone: ClassVar[bool] = False
    told: str = field(default="", compare=False, repr=False)  # what was assumed, which a `Note` says with the answer

    def __init_subclass__(cls) -> None:
        """Name the command by its class."""
        cls.called = cls.__dict__.get("called", f"neurolens {cls.__name__.lower()}")

    def __post_init__(self) -> None:
        for f in fields(self):
            option, path = f.metadata.get("option"), getattr(self, f.name)
            if option is not None and isinstance(path, Path) and option.written:
                check_written(path, spelling(f, option), option.metavar)

    @classmethod
    def fill(cls, parser: Parser) -> None:
        """Give the command's parser the texts of its help, its arguments and its options."""
        parser.description, parser.epilog, parser.intermixed = inspect.getdoc(cls), cls.epilog, cls.intermixed
        cls.add_options(parser)
        if parser.add_help:  # a call has none
            parser.alone = cls.alone
            parser.add_argument("--help-all", action=WholeHelp, nargs=0, dest="help", help=argparse.SUPPRESS)
        parser.set_defaults(run=lambda args: cls.of(args).run(), kept=cls.kept)

    @classmethod
    def add_options(cls, parser: Parser) -> None:
        """Add the command's arguments and options to its parser."""
        add_options(parser, cls)

    @classmethod
    def of(cls, args: argparse.Namespace) -> Self:
        """Return the command that parsed arguments describe."""
        return from_options(cls, args).completed()

    def completed(self) -> Self:
        """Return the command with values that `assumed` finds for what is not given; its answer names them."""
        told, whole = list[str](), self
        for name, (option, found) in self.assumed().items():
            if name == "state" or getattr(self, name) in (None, (), False):  # a state: where it lacks something
                value, said = found()
                whole, told = replace(whole, **{name: value}), [*told, f"{option} {said}".rstrip()]
        return replace(whole, told=f"assumed: {', '.join(told)}") if told else whole

    def assumed(self) -> dict[str, tuple[str, Callable[[], tuple[Any, str]]]]:
        """Return, for each field that may be left out, its option, and a function that finds a value and its words."""
        found: dict[str, tuple[str, Callable[[], tuple[Any, str]]]]
        found = {"film": ("--film", self._film), "out": ("--output", self._output)}
        options = {f.name: f.metadata["option"] for f in fields(self) if "option" in f.metadata}
        return {name: how for name, how in found.items() if name in options and options[name].assumed}

    def _film(self) -> tuple[tuple[float, float], str]:
        """Return the film that the lens covers."""
        from neurolens.cameras.build import film_of

        film, name = film_of(self._inputs()[-1], **self._size())
        return film, f"{film[0]:g}x{film[1]:g} ({name + ', which' * bool(name) or 'what'} the lens covers)"

    def _size(self) -> dict[str, Any]:
        """Return what zooms or scales the lens."""
        return self.state.shot().size if hasattr(self, "state") else {}

    def _output(self, suffix: str | None = None) -> tuple[Path, str]:
        """Return a name in this folder: INPUT-LENS-COMMAND with a suffix, else that of the option's placeholder."""
        option = self.__dataclass_fields__["out"].metadata["option"]
        kind = f".{option.metavar.partition('.')[2]}".rstrip(".") if suffix is None else suffix
        names = [lens_id_of(split_kind(text)[1]) for text in self._inputs()]
        path = Path("-".join([*names, self.called.split()[-1]]) + kind)
        there = path.exists() if kind else any(path.parent.glob(f"{path.name}.*")) or path.exists()
        return path, f"{path}{' (written over)' * there}"

    def _inputs(self) -> list[str]:
        """Return what it reads first, as a scene, and then its lens."""
        values = {f.name: getattr(self, f.name) for f in fields(self) if "option" in f.metadata}
        options = {name: self.__dataclass_fields__[name].metadata["option"] for name in values}
        lenses = {n for n, o in options.items() if isinstance(o.kind, partial) and o.kind.func is named_lens}
        first = [name for name, option in options.items() if option.positional and name not in lenses]
        texts = [values[name] for name in (*first[:1], *sorted(lenses)[:1])]
        return [str(text[0] if isinstance(text, tuple) else text) for text in texts if text]

    def run(self) -> int:
        """Run the command and return its exit code."""
        raise NotImplementedError

    def refuse(self, option: str, value: object, expected: str) -> NoReturn:
        """Raise an InputError about an option."""
        raise InputError(self.called, option, value, expected)


@dataclass(frozen=True, kw_only=True)
class Reporting(Command):
    """A command that shows its progress and prints a text, or with --json one JSON object."""

    glass: tuple[Path, ...] = setting(
        (), "glass catalogue of Zemax, whose glasses come before those that ship (repeatable)", metavar="FILE.agf",
        last=1,
    )  # fmt: skip
    quiet: bool = setting(False, "neither progress nor warnings on stderr", last=2)
    json: bool = setting(False, "print one JSON object on stdout instead of the text; keys carry their unit", last=3)
    # Takes the answer where the command is called from Python (`cli.calls`), which prints nothing.
    tell: Callable[[Mapping[str, Any], str], None] | None = field(default=None, compare=False, repr=False)

    def answer(self, found: Report, code: int = 0, *, full: bool = False) -> int:
        """Print a report, as JSON if --json asks for it, else as text; returns the exit code.

        JSON has what a report has in bulk only where it is `full`.
        """
        for line in filter(None, (self.told, compiled_so_far())):
            note(line)
        if self.tell is not None:
            self.tell(plain(found, strict=False, full=full), found.text())
        elif self.json:
            print_json(plain(found, full=full))
        else:
            print(printable(found.text()))
        return code

    def progress(self, plan: Mapping[str, float] | None = None) -> Progress:
        """Return the command's progress; `plan` gives the expected seconds of stages."""
        return Progress(plan, quiet=self.quiet)


@dataclass(frozen=True, kw_only=True)
class Figures(Reporting):
    """A command whose answer is figures, which --csv writes as tables, too."""

    csv: Path | None = setting(
        None, "write the figures to this folder as CSV, a file for each table, a row a case; headings carry their unit",
        metavar="FOLDER", kind=Path, written=True, last=4, common=True,
    )  # fmt: skip

    def answer(self, found: Report, code: int = 0, *, full: bool = False) -> int:
        """Write the tables that are asked for, and print as any command; returns the exit code."""
        if self.csv is not None:
            write_tables(self.csv, found, self.called.split()[-1])
        return super().answer(found, code, full=full)


@contextmanager
def keeps(text: str) -> Iterator[None]:
    """Say what an interrupt inside the block leaves, in place of the command's `kept`."""
    try:
        yield
    except KeyboardInterrupt as error:
        error.add_note(text)
        raise


# Types of arguments


def amount(text: str, units: Mapping[str, str]) -> tuple[str, float]:
    """Read an argument that is a number and its unit, as 0.1px; `units` tells what each is called, with an example."""
    match = re.fullmatch(r"([0-9.]{1,20}(?:e[+-]?[0-9]{1,3})?)([a-z]+)", text)
    try:
        if match and match[2] in units and 0 <= (value := float(match[1])) < 1e12:
            return match[2], value
    except ValueError:
        pass
    raise argparse.ArgumentTypeError(f"got {text!r}, expected a number and its unit: {', '.join(units.values())}")


def rms_error(text: str) -> tuple[str, float]:
    """Read --within: the key of a model card's error, "rms_um" or "rms_px", and its bound."""
    unit, value = amount(text, {"um": "micrometres, as 1um", "px": "pixels, as 0.1px"})
    if not value:
        raise argparse.ArgumentTypeError(f"got {text!r}, expected a number above 0")
    return f"rms_{unit}", value


def words_of(choices: Sequence[str], least: str = "") -> Callable[[str], tuple[str, ...]]:
    """Return the type of an argument that lists some of `choices` with commas, each once; `least` must be there."""

    def convert(text: str) -> tuple[str, ...]:
        words = tuple(word.strip() for word in text.split(","))
        if set(words) <= set(choices) and len(set(words)) == len(words) and (not least or least in words):
            return words
        with_it = f", {least} among them" * bool(least)
        raise argparse.ArgumentTypeError(f"got {text!r}, expected some of {','.join(choices)}, each once{with_it}")

    return convert


def named_lens(models: bool, cameras: bool, text: str) -> Any:
    """Read an argument that names a lens as `resolve` does: a path, or with `cameras` the text of a `Named`."""
    try:
        found = resolve(text, models=models, cameras=cameras)
        return str(found) if cameras else found.file
    except InputError as error:
        raise argparse.ArgumentTypeError(str(error)) from None


def scene_file(text: str) -> Path:
    """Read an argument that names a scene file: its path, else its path in a checkout or its name, as it ships."""
    path, ours = Path(text), {file.stem: file for file in (library() / "experiments" / "scenes").glob("*.toml")}
    found = next((place for place in (path, library() / path) if place.is_file()), ours.get(text))
    if found is None and path.stem == text:
        names = f"{', '.join(sorted(ours))}{suggestion(text, list(ours))}"
        raise argparse.ArgumentTypeError(f"got {text!r}, expected a scene file (.toml), or one that ships: {names}")
    return found or path


def floats(text: str, between: str = ",") -> list[float]:
    """Return the numbers in a text; an empty list where a word is no number."""
    try:
        return [as_float(word) for word in text.split(between)]
    except ValueError:
        return []


# Options of several commands


def lens(default: Any = ..., also: str = "", *, models: bool = False, cameras: bool = False, **details: Any) -> Any:
    """Return an argument of the type `named_lens`; `also` is added to its help."""
    taken = ", model (.onnx), or name of either" if models else ", or its name in lenses/"
    taken += ", thick:LENS, thin, pinhole or fisheye-PROJECTION" if cameras else ""
    details = {"metavar": "CAMERA" if cameras else "LENS", "kind": partial(named_lens, models, cameras)} | details
    return setting(default, f"lens file of any format{taken}{also}", common=True, **details)


def output_path(metavar: str, about: str, default: Any = ..., title: str = "") -> Any:
    """Return -o and --output, the file or folder that a command writes; without a default the command names it."""
    if assumed := default is ...:
        default, about = None, f"{about} (default: named after the input, in this folder)"
    return setting(
        default, about, metavar=metavar, option="output", short="-o", old=("out",), kind=Path, title=title,
        written=True, common=True, assumed=assumed,
    )  # fmt: skip


def plot_path(about: str) -> Any:
    """Return an option that names the file of a plot."""
    return setting(None, f"{about} (.png, .pdf, .svg)", metavar="OUT.png", kind=Path, written=True, common=True)


def film(default: Any = ..., about: str = "size of the film in mm", title: str = "") -> Any:
    """Return --film, a film's width and height; without a default it is what the lens covers."""
    if assumed := default is ...:
        default, about = None, f"{about}, or its name, as super35 (default: what the lens covers, as 36x24)"
    return setting(
        default, about, option="film", kind=film_size, metavar="WxH", title=title, common=True, assumed=assumed
    )


def film_like(picture: Path, film_mm: tuple[float, float], said: str) -> tuple[tuple[float, float], str]:
    """Return the largest film of a picture's shape (EXR) within another film, and a sentence about it."""
    from neurolens.pictures.render.pictures import header_of

    (left, top), (last, bottom) = header_of(picture)["displayWindow"]
    return film_shaped(max(1, last - left + 1), max(1, bottom - top + 1), picture.name, film_mm, said)


def film_shaped(
    width: int, height: int, name: str, film_mm: tuple[float, float], said: str
) -> tuple[tuple[float, float], str]:
    """Return the largest film of the shape of a picture, of so many pixels, as `film_like`."""
    scale = min(film_mm[0] / width, film_mm[1] / height)
    film = float(f"{scale * width:.6g}"), float(f"{scale * height:.6g}")
    return film, f"{film[0]:g}x{film[1]:g} (the shape of {name} within {said})"


def within(about: str, default: Any = None, **details: Any) -> Any:
    """Return --within, an RMS error with its unit, of the type `rms_error`."""
    old = {f"target-{unit}": partial(lambda unit, text: rms_error(text + unit), unit) for unit in ("um", "px")}
    return setting(default, about, metavar="ERROR", kind=rms_error, old=old, **details)


def dask(title: str = "") -> Any:
    """Return --dask, the scheduler that spreads the work over machines."""
    return setting(
        None, "run on a Dask cluster: the address of its scheduler (tcp://HOST:8786), or local (processes of this "
        "machine), or local:N, which no other user can reach. What a task reads travels with it: workers need "
        "neurolens alone, and no folder in common. Whoever reaches a scheduler at tcp:// can run programs as you; "
        "tls:// takes keys", metavar="ADDRESS", title=title,
    )  # fmt: skip


def exposure(default: float | None = 0.0, said: str = "0", title: str = "") -> Any:
    """Return --exposure; `said` is what the help says of the default."""
    about = "stops by which the preview OUT.png is brighter; OUT.exr keeps the light as it is"
    return setting(default, f"{about} (default: {said})", within=(-40, 40), unit="stops", metavar="STOPS", title=title)


def threads(about: str = "threads") -> Any:
    """Return --threads."""
    return setting(2, f"{about} (default: 2)", within=(1, 256))


def more_glasses(files: Sequence[Path]) -> AbstractContextManager[None]:
    """Return a block in which the catalogues of --glass are known; without any, nothing is imported."""
    if not files:
        return nullcontext()
    from neurolens.optics.readers import glasses

    return glasses.more_glasses(files)


def camera(name: str, shot: Shot, progress: Progress) -> Camera:
    """Make the camera that an argument names; what it notes (as a film beyond the image circle) becomes a warning."""
    from neurolens.cameras.build import make_camera

    made = make_camera(name, shot, progress)
    for text in made.settings.get("notes", ()):
        warn(text)
    return made


@dataclass(frozen=True, kw_only=True)
class LensState:
    """Holds the options that set a lens or a camera: settings of a shot, and the shape of the stop."""

    given: Shot = setting(Shot.part(), "what the command line has of a shot")
    stop: StopShape = group("shape of the stop")

    def aperture(self) -> Aperture | None:
        """Return the stop's shape; None if it is not given.

        Raises:
            InputError: shapes that exclude each other, or a picture that cannot be read.
        """
        from neurolens.pictures.render.images import make_aperture

        return make_aperture(self.stop)

    def shot(self, film_mm: tuple[float, float] | None = None, **settings: Any) -> Shot:
        """Return what is given of a shot, with a camera's film and further `settings`; None counts as not given.

        Raises:
            InputError: what `Shot` and `aperture` raise.
        """
        return with_changes(self.given, {"aperture": self.aperture(), "film_mm": film_mm} | settings)

    def at(self, **settings: Any) -> Self:
        """Return the state with some settings of the shot replaced."""
        return replace(self, given=replace(self.given, **settings))


# Fields of `LensState` in a command: for a lens alone, and for any camera.
lens_state = partial(group, "state of the lens", names=BY_LENSES, unset=True)
camera_state = partial(group, "state of the lens", unset=True)


# Checks


def check_ids(files: Sequence[Path], command: str, option: str) -> None:
    """Raise InputError for lens files of one id, whose results would have the same name."""
    ids = [lens_id_of(file) for file in files]
    if twice := sorted({name for name in ids if ids.count(name) > 1}):
        raise InputError(command, option, twice, "files whose names differ")


def check_written(path: Path, option: str, metavar: str) -> None:
    """Refuse a path that does not fit the placeholder of its option (see `Command`), or where no file can be made.

    Raises:
        InputError: names the path and what it lacks.
        OSError: a file there cannot be replaced.
    """
    if metavar in ("FOLDER", "DIR"):
        there = next(p for p in (path, *path.absolute().parents) if p.exists())
        if not there.is_dir():
            raise InputError(path, option, str(there), "a folder, not a file")
        try:
            check_writable(there / "file")
        except OSError:
            raise InputError(path, option, str(there), "a folder that can be written") from None
        return
    kind = metavar.partition(".")[2]
    suffixes = _SUFFIXES.get(kind, (f".{kind}",))
    if kind and path.suffix.lower() not in suffixes:
        expected = suffixes[0] if len(suffixes) == 1 else f"one of {', '.join(suffixes)}"
        raise InputError(path, option, path.suffix or "(no suffix)", expected)
    if not path.parent.is_dir():
        raise InputError(path, option, str(path.parent), "a folder that exists")
    if not path.name:
        raise InputError(path, option, str(path), "the start of the files' names")
    check_writable(path if kind or metavar == "FILE" else path.with_name(f"{path.name}.file"))


# Output


def print_json(data: Mapping[str, Any]) -> None:
    """Print one JSON object, which is plain, on stdout."""
    ascii_only = not str(sys.stdout.encoding).lower().startswith("utf")
    print(printable(json.dumps(data, indent=1, allow_nan=False, ensure_ascii=ascii_only)))


def number(value: Any, digits: int = 4) -> str:
    """Write a number with significant digits (710, not 7.1e+02); "-" for None and NaN."""
    if value is None or isinstance(value, str):
        return value or "-"
    if isinstance(value, int):
        return str(value)
    if not math.isfinite(value):
        return "-" if math.isnan(value) else "infinity"
    text = f"{value + 0.0:.{digits}g}"  # turns -0 into 0
    return f"{float(text):.0f}" if "e+" in text and abs(value) < 1e6 else text


def first_order_light(light: FirstOrderLight) -> tuple[str, str]:
    """Return the wavelength of first-order data as text, and a note on the figures at the file's primary one."""
    note, primary = "of these figures", light.primary
    if primary is not None:
        efl, back = f"{number(primary.efl_mm, 6)} mm", f"{number(primary.back_focus_mm, 6)} mm"
        note += f"; at the file's primary {primary.wavelength_nm:g} nm: focal length {efl}, back focus {back}"
    return f"{light.wavelength_nm:.2f} nm", note


def table(header: Sequence[str], rows: Sequence[Sequence[str]], left: int = 1) -> str:
    """Lay out columns, two spaces apart: the first `left` flush left, the others flush right."""
    lines = [list(header), *(list(row) for row in rows)]
    widths = [max(len(line[k]) for line in lines) for k in range(len(header))]

    def row(cells: Sequence[str]) -> str:
        placed = (c.ljust(w) if k < left else c.rjust(w) for k, (c, w) in enumerate(zip(cells, widths, strict=True)))
        return "  ".join(placed).rstrip()

    return "\n".join(row(line) for line in lines)
