"""The command line: `neurolens COMMAND`, one module of `neurolens.cli` each.

Errors are one line and exit code 2, or 70 where neurolens itself is at fault.
"""

from __future__ import annotations

import argparse
import os
import signal
import sys
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from functools import partial
from typing import Any

from neurolens import __version__
from neurolens.base.errors import InputError, NeurolensError, NeurolensWarning, one_line, printable
from neurolens.base.tasks import handled
from neurolens.cli.arguments import Command, Help, Parser, more_glasses

# Packages of the extra that a base install lacks.
_TRAIN_PACKAGES = {"torch", "scipy", "onnx", "matplotlib", "flip_evaluator", "mpmath"}
_BROKEN_PIPE = 141  # 128 plus the signal's number, as shells report it
_FAULT, _TRACEBACK = 70, "NEUROLENS_TRACEBACK"  # EX_SOFTWARE of sysexits.h; the variable that asks for tracebacks
# Names that commands had: they still work.
_RENAMED: dict[tuple[str, ...], tuple[str, ...]] = {("merge",): ("render", "--merge"), ("trade",): ("plan", "--trade")}

_DESCRIPTION = "Any lens prescription as a fast camera model with a measured error."
_EPILOG = """\
examples:
  neurolens lens lenses/laikin_double_gauss_50.toml --layout layout.png
  neurolens convert lens.zmx -o lenses/lens.toml
  neurolens train experiments/quickstart.toml
  neurolens evaluate models/NAME.onnx
  neurolens export models/NAME.onnx --to c -o lens.h
  neurolens render experiments/scenes/room.toml --camera models/NAME.onnx -o room.exr

exit codes: 0 done, 1 a model breaks a promise or none has the error asked for, 2 bad input, 130 interrupted,
70 a fault of neurolens itself, or no memory.
Help of a command: neurolens COMMAND --help"""


def build_parser() -> Parser:
    """The whole command line.

    Commands are imported here, so that `main` handles an interrupt of the imports.
    """
    from neurolens.cli.analyse import Analyse
    from neurolens.cli.blender import Blender
    from neurolens.cli.bokeh import Bokeh
    from neurolens.cli.convert import Convert, Glass
    from neurolens.cli.defocus import Defocus
    from neurolens.cli.evaluate import Evaluate
    from neurolens.cli.export import Export
    from neurolens.cli.flare import Flare
    from neurolens.cli.handover import Handover
    from neurolens.cli.lens import Lens
    from neurolens.cli.mitsuba import Mitsuba
    from neurolens.cli.models import Models
    from neurolens.cli.photographs import Rims, Verify
    from neurolens.cli.plan import Plan
    from neurolens.cli.projection import Projection
    from neurolens.cli.render import Demo, Render
    from neurolens.cli.stmap import StMap
    from neurolens.cli.train import Survey, Train
    from neurolens.cli.view import View

    groups: dict[str, tuple[type[Command], ...]] = {
        "lenses": (Lens, Analyse, Verify, Rims, Convert, Glass, Survey, View),
        "camera models of a lens": (Train, Models, Evaluate),
        "pictures": (Demo, Plan, Render, Flare),
        "compositing and other programs": (Defocus, Bokeh, Handover, StMap, Projection, Export, Blender, Mitsuba),
    }
    parser = Parser(
        prog="neurolens", usage="neurolens COMMAND ...", description=_DESCRIPTION, epilog=_EPILOG,
        formatter_class=partial(Help, indent_increment=4),
    )  # fmt: skip
    parser.add_argument("--version", action="version", version=f"neurolens {__version__}")
    parser.renamed = _RENAMED
    subparsers = parser.add_subparsers(
        metavar="COMMAND", required=True, parser_class=Parser, prog="neurolens", help=argparse.SUPPRESS
    )
    for title, commands in groups.items():
        for command in commands:
            command.add_parser(subparsers)
        parser.add_argument_group(title)._group_actions += subparsers._choices_actions  # so that help lists them there
        subparsers._choices_actions = []
    return parser


def main(argv: Sequence[str] | None = None, build: Callable[[], Parser] = build_parser) -> int:
    """Run one command and return its exit code; a wrong command line exits with code 2 as argparse does.

    `build` makes the parser; its errors and interrupts are reported like the command's.
    """
    args, received = argparse.Namespace(kept="nothing was done"), list[int]()

    def interrupt(number: int) -> None:
        received.append(number)
        raise KeyboardInterrupt(number)

    try:
        with handled(interrupt):
            _check_words(sys.argv[1:] if argv is None else argv)
            args = build().parse_args(argv)
            with _plain_warnings(quiet=getattr(args, "quiet", False)), more_glasses(getattr(args, "glass", ())):
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


def _check_words(words: Sequence[str]) -> None:
    """Raise InputError for a word that no file of this system can have as its name."""
    for word in words:
        with suppress(UnicodeEncodeError):
            if b"\0" not in os.fsencode(word):
                continue
        raise InputError("command line", "argument", printable(word), "text without null characters that is whole")


def _failed(error: Exception) -> int:
    """Report an error in a line, and return the exit code."""
    if isinstance(error, NeurolensError):
        return _fail(str(error))
    if isinstance(error, BrokenPipeError):
        # The reader (head, less) has exited; avoid a second error when the interpreter flushes stdout.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return _BROKEN_PIPE
    if isinstance(error, OSError):
        # The error of a full disk names no file.
        place = "" if error.filename is None else f"{error.filename}: "
        return _fail(f"{place}{error.strerror or error}")
    return _fault(error)


def _fault(error: Exception) -> int:
    """Report what no command expects: a package or memory that is missing, or a fault of neurolens itself."""
    package = (getattr(error, "name", None) or "").partition(".")[0]
    if isinstance(error, ModuleNotFoundError) and package in _TRAIN_PACKAGES:
        return _fail(
            f"this needs {package}, which is not installed: pip install 'neurolens[train]', or '.[train]' in a checkout"
        )
    if os.environ.get(_TRACEBACK):
        import traceback

        traceback.print_exception(error)
    if isinstance(error, MemoryError):
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
                    print(f"neurolens: warning: {text}", file=sys.stderr)
                said.add(text)
            else:
                usual(message, category, *place, **more)

        warnings.showwarning = show
        warnings.simplefilter("always", NeurolensWarning)
        yield


if __name__ == "__main__":
    sys.exit(main())
