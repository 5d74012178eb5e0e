"""The command line: `neurolens COMMAND`, one module of `neurolens.cli` each.

Errors are one line and exit code 2, or 70 where neurolens itself is at fault.
"""

import argparse
import gc
import io
import os
import signal
import sys
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from functools import partial
from importlib import import_module
from typing import Any

import neurolens
from neurolens.base.errors import (
    InputError,
    NeurolensError,
    NeurolensWarning,
    Note,
    missing,
    one_line,
    out_of_memory,
    printable,
    reason,
)
from neurolens.base.tasks import handled
from neurolens.cli.arguments import Command, Help, Parser, more_glasses

_OBJECTS = 50_000  # made between two searches for garbage, which else take a twelfth of a command's time
_BROKEN_PIPE = 141  # 128 plus the signal's number, as shells report it
_FAULT, _TRACEBACK = 70, "NEUROLENS_TRACEBACK"  # EX_SOFTWARE of sysexits.h; the variable that asks for tracebacks
_RENAMED = {"merge": ("render", "--merge"), "trade": ("plan", "--explain")}  # names that commands had, which still work
# The commands under the titles of the help: module and class of each, and its line in the help.
_COMMANDS = {
    "lenses": {
        "find": ("find.Find", "lenses of the library by what photographers call them"),
        "lens": ("lens.Lens", "first-order data, field and layout of a lens file"),
        "analyse": ("analyse.Analyse", "spots, MTF, distortion and more of a lens file"),
        "verify": ("photographs.Verify", "hold a lens file against photographs of the product"),
        "rims": ("photographs.Rims", "fit the rims of a lens file to photographs of the product"),
        "convert": ("convert.Convert", "read a lens file of another program"),
        "copies": ("copies.Copies", "copies of a lens as made: decentred, tilted, radii and gaps off"),
        "glass": ("convert.Glass", "look glasses up by name or code"),
        "survey": ("train.Survey", "every lens file of a folder: read, checked, fitted, measured"),
        "view": ("view.View", "write a page that runs lenses and models in a browser"),
    },
    "camera models of a lens": {
        "train": ("train.Train", "fit, measure and render the models of an experiment"),
        "models": ("models.Models", "list models that are here, and the one to use"),
        "evaluate": ("models.Evaluate", "measure a model against the promises of its card"),
    },
    "pictures": {
        "demo": ("render.Demo", "one scene through a lens, its model, a thin lens and a pinhole"),
        "plan": ("plan.Plan", "what a scene asks of a lens, and the camera to use"),
        "render": ("render.Render", "a scene through a lens, a model, a thin lens or a pinhole"),
        "flare": ("flare.Flare", "ghosts of lights: a table, and a picture with layers"),
    },
    "compositing and other programs": {
        "defocus": ("defocus.Defocus", "the blur of a lens for a sharp picture with depth"),
        "bokeh": ("defocus.Bokeh", "kernels of a lens's blur over field and distance"),
        "psf": ("psf.PointSpread", "point spread of a lens by diffraction, over field, distance and f-number"),
        "handover": ("handover.Handover", "a lens as files for Nuke, Blender, USD, OpenTrackIO, lensfun, OpenCV"),
        "stmap": ("stmap.StMap", "ST maps, which undistort and redistort pictures of a lens"),
        "projection": ("stmap.Projection", "fit a lens with a projection of OpenCV, nerfstudio or NVIDIA"),
        "rays": ("rays.Rays", "rays of a lens as arrays: Newton, gsplat, 3DGRUT, Mitsuba, OpenGL, OpenCV"),
        "export": ("export.Export", "source code (C, shading languages) of a model; fix what a scene fixes"),
        "blender": ("blender.Blender", "the extension for Blender, and lenses in it"),
        "mitsuba": ("mitsuba.Mitsuba", "render a scene of Mitsuba 3 through a neurolens camera"),
    },
}

_DESCRIPTION = "Any lens prescription as a fast camera model with a measured error."
_EPILOG = """\
examples:
  neurolens find nikkor 50 1.2
  neurolens lens laikin_double_gauss_50 --layout layout.png
  neurolens render lights --camera canon_50mm_f1_2 --f-number 1.2 --width 480 --samples 64 -o first.exr
  neurolens train --lens laikin_double_gauss_50
  neurolens export laikin_double_gauss_50.ols-36 --to c -o gauss.h

A command alone, as "neurolens render", prints what it does and an example; neurolens COMMAND --help has its options.
Exit codes: 0 done; 1 a model breaks a promise, or no model reaches the error asked for; 2 bad input; 70 a fault of
neurolens itself, or no memory; 130 interrupted."""

# What `neurolens` alone prints: what to type first, for each of the three ways in.
_FIRST = """\
A first picture:      neurolens render lights --camera canon_50mm_f1_2 --f-number 1.2 --width 480 --samples 64
To find a lens:       neurolens find nikkor 50 1.2
To light or comp:     neurolens handover laikin_double_gauss_50 --film 36x20.25 --width 3840 --focus 2 -o shot/
To do research:       neurolens analyse laikin_double_gauss_50 -o gauss
To write a renderer:  neurolens export laikin_double_gauss_50.ols-36 --to c -o gauss.h
All commands:         neurolens --help    (in Python: import neurolens as nl; help(nl.lens))"""


def build_parser(first: str | None = None) -> Parser:
    """Return the whole command line; where its first word is known, only that command is imported."""
    parser = Parser(
        prog="neurolens", usage="neurolens COMMAND ...", description=_DESCRIPTION, epilog=_EPILOG,
        formatter_class=partial(Help, indent_increment=4),
    )  # fmt: skip
    parser.add_argument("--version", action="version", version=f"neurolens {neurolens.__version__}")
    parser.renamed = _RENAMED
    subparsers: Any = parser.add_subparsers(
        metavar="COMMAND", required=True, parser_class=Parser, prog="neurolens", help=argparse.SUPPRESS
    )
    for title, commands in _COMMANDS.items():
        for name, (place, about) in commands.items():
            own = subparsers.add_parser(name, help=about)
            if first is None or name in (first, *_RENAMED.get(first, ())):
                _class_at(place).fill(own)
        parser.add_argument_group(title)._group_actions += subparsers._choices_actions  # so that help lists them there
        subparsers._choices_actions = []
    return parser


def _class_at(place: str) -> type[Command]:
    module, _, name = place.partition(".")
    return getattr(import_module(f"{__name__}.{module}"), name)


def command(name: str) -> type[Command]:
    """Return the class of a command by its name."""
    return _class_at({k: place for commands in _COMMANDS.values() for k, (place, _) in commands.items()}[name])


def main(argv: Sequence[str] | None = None, build: Callable[[], Parser] | None = None) -> int:
    """Run one command and return its exit code; a wrong command line exits with code 2, as argparse does.

    `build` makes another parser than the usual one, whose errors and interrupts are reported in the same way.
    """
    _open_streams()
    if not hasattr(neurolens, "DISTRIBUTION"):  # its files are written over ours where both are installed
        return _fail(
            f"another project called neurolens is installed over this one ({neurolens.__file__}): "
            "pip uninstall neurolens, then install this one again"
        )
    if argv is None:  # a program of its own: packages and graphs are objects by the 100,000, of which few are garbage
        gc.set_threshold(_OBJECTS)
    words = sys.argv[1:] if argv is None else argv
    if not words and build is None:
        print(_FIRST)
        return 0
    args, received = argparse.Namespace(kept="nothing was done"), list[int]()

    def interrupt(number: int) -> None:
        received.append(number)
        raise KeyboardInterrupt(number)

    try:
        with handled(interrupt):
            _check_words(words)
            with _plain_warnings(quiet="--quiet" in words):
                args = (build() if build else build_parser(words[0] if words else "")).parse_args(words)
                with more_glasses(getattr(args, "glass", ())):
                    code: int = args.run(args)
        sys.stdout.flush()
        return code
    except (Exception, KeyboardInterrupt) as error:
        # A signal that comes while a package is imported can end in another error, which the package makes of it.
        if received or isinstance(error, KeyboardInterrupt):
            kept = [args.kept, *getattr(error, "__notes__", ())][-1]
            print(f"\nneurolens: interrupted; {printable(kept)}", file=sys.stderr)
            return 128 + (received[0] if received else signal.SIGINT)
        return _failed(error)


def _open_streams() -> None:
    """Let any text be written to stdout and stderr, and open those that the caller has closed on the null device.

    If they stayed closed, programs would print into the next file that is opened, such as a picture to write.
    """
    while (number := os.open(os.devnull, os.O_RDWR)) < 3:  # the lowest number that is free
        os.set_inheritable(number, True)
    os.close(number)
    for name in ("stdout", "stderr"):
        if (stream := getattr(sys, name)) is None:
            setattr(sys, name, open(os.devnull, "w", encoding="utf-8"))  # noqa: SIM115
        elif isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")


def _check_words(words: Sequence[str]) -> None:
    """Raise InputError for a word that no file of this system can have as its name."""
    for word in words:
        with suppress(UnicodeEncodeError):
            if b"\0" not in os.fsencode(word):
                continue
        raise InputError("command line", "argument", printable(word), "text without null characters that is whole")


def _failed(error: Exception) -> int:
    """Report an error in one line, and return the exit code."""
    if isinstance(error, NeurolensError):
        return _fail(str(error))
    if isinstance(error, BrokenPipeError):
        # The reader (head, less) has exited: avoid a second error when the interpreter flushes stdout.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return _BROKEN_PIPE
    if isinstance(error, OSError) or missing(error):
        return _fail(reason(error))
    return _fault(error)


def _fault(error: Exception) -> int:
    """Report what no command expects: lack of memory, or a fault of neurolens itself."""
    if os.environ.get(_TRACEBACK):
        import traceback

        traceback.print_exception(error)
    if out_of_memory(error):
        return _fail(f"not enough memory ({error})", _FAULT)
    found = f"{type(error).__name__}: {error}" if not isinstance(error, RecursionError) else "RecursionError"
    asked = f"please report this line, the command and its files, with {_TRACEBACK}=1 for details"
    return _fail(f"a fault of neurolens: {one_line(found, 300)}; {asked}", _FAULT)


def _fail(message: str, code: int = 2) -> int:
    print(f"neurolens: {one_line(message, 3000)}", file=sys.stderr)
    return code


@contextmanager
def _plain_warnings(quiet: bool) -> Iterator[None]:
    """Show each of the project's own warnings once, as one line without the place in the code; none if `quiet`."""
    with warnings.catch_warnings():
        usual, said = warnings.showwarning, set[str]()

        def show(message: Any, category: type[Warning], *place: Any, **more: Any) -> None:
            if issubclass(category, NeurolensWarning):
                text = one_line(str(message), 3000)
                if not quiet and text not in said:
                    print(f"neurolens: {'' if category is Note else 'warning: '}{text}", file=sys.stderr)
                said.add(text)
            else:
                usual(message, category, *place, **more)

        warnings.showwarning = show
        warnings.simplefilter("always", NeurolensWarning)
        yield


if __name__ == "__main__":
    sys.exit(main())
