"""Commands as calls from Python: values replace the words of a command line, an answer replaces what is printed.

The parser of a command reads both, so that a call takes what the command takes: names, units, defaults and errors.
"""

import argparse
import inspect
import keyword
import os
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, NoReturn, TypeVar

from neurolens.base.errors import InputError, one_line
from neurolens.base.tomlfile import reject_unknown
from neurolens.cli.arguments import Command, Parser, more_glasses, named_lens

C = TypeVar("C", bound=Command)


class Answer(dict[str, Any]):
    """What a command found: the object that --json prints, whose keys carry their unit.

    Attributes:
        text: what the command prints.
        code: its exit code, which is 1 where a promise is broken or a wish is not met.
    """

    def __init__(self, data: Mapping[str, Any], text: str, code: int) -> None:
        super().__init__(data)
        self.text, self.code = text, code

    def __repr__(self) -> str:
        return self.text

    @property
    def rgb(self) -> Any:
        """The OpenEXR picture that was written, linear [H, W, 3] float32; raises InputError without one."""
        from neurolens.pictures.render.pictures import read_exr

        for file in _files(self, ".exr"):
            return read_exr(file)[0]
        raise InputError("answer", "rgb", "(no picture)", "a command that writes an OpenEXR picture")

    def _repr_png_(self) -> bytes | None:
        """Return the first PNG that was written, which may lie beside an OpenEXR picture; notebooks show it."""
        shown = (file.with_suffix(".png") for file in _files(self, ".png", ".exr"))
        return next((file.read_bytes() for file in shown if file.is_file()), None)


def _files(value: Any, *suffixes: str) -> list[Path]:
    """Return the files of such kinds that an answer names."""
    if isinstance(value, Mapping | list):
        parts = value.values() if isinstance(value, Mapping) else value
        return [file for part in parts for file in _files(part, *suffixes)]
    return [Path(value)] if isinstance(value, str) and value.endswith(suffixes) else []


class _Parser(Parser):
    """A parser that raises what the command line would print."""

    def error(self, message: str) -> NoReturn:
        mistake = InputError(self.prog, "arguments", message, "")
        mistake.args = (f"{self.prog}: {one_line(message, 1000)}",)
        raise mistake


def parameters(cls: type[Command]) -> tuple[Parser, dict[str, argparse.Action]]:
    """Return the parser of a command for calls, and its arguments and options by their names in Python.

    A name is that of the option with its unit, as focus_m for --focus M; --for becomes for_. First come the arguments
    and then the option that names the lens: in a call these may stand without their names, as in nl.render(scene,
    lens).
    """
    parser = _Parser(prog=cls.called, add_help=False)
    cls.fill(parser)
    shown = (a for a in parser._actions if a.help != argparse.SUPPRESS and a.dest not in ("help", "json"))
    return parser, {a.dest + "_" * keyword.iskeyword(a.dest): a for a in sorted(shown, key=_keyed)}


def _keyed(action: argparse.Action) -> bool:
    """Test whether a value stands with its name."""
    of_lens = isinstance(action.type, partial) and action.type.func is named_lens
    return bool(action.option_strings) and not of_lens


def signature_of(cls: type[Command]) -> inspect.Signature:
    """Return the signature of a command as a call, annotated with what stands for values in its help."""
    kinds, found = (inspect.Parameter.POSITIONAL_OR_KEYWORD, inspect.Parameter.KEYWORD_ONLY), []
    for name, a in parameters(cls)[1].items():
        about = "bool" if a.nargs == 0 else a.metavar or "|".join(map(str, a.choices or ()))
        default = inspect.Parameter.empty if a.required and a.nargs != "*" else a.default
        found.append(inspect.Parameter(name, kinds[_keyed(a)], default=default, annotation=about))
    return inspect.Signature(found)


def command_of(cls: type[C], given: Sequence[Any], named: Mapping[str, Any]) -> C:
    """Return the command that the values of a call describe; None counts as not given.

    Raises:
        InputError: a name that the command does not have, or a value that it refuses.
    """
    parser, known = parameters(cls)
    reject_unknown(cls.called, "", named, list(known))
    bare = [name for name, action in known.items() if not _keyed(action)]
    if len(given) > len(bare) or named.keys() & set(bare[: len(given)]):
        raise InputError(cls.called, "arguments", f"({len(given)} without names)", f"{', '.join(bare)}, each once")
    values = dict(zip(bare, given, strict=False)) | dict(named)
    words = [(known[k].option_strings, _words(known[k], v)) for k, v in values.items() if v is not None]
    options, bare = ([w for named_by, ws in words if bool(named_by) is own for w in ws] for own in (True, False))
    parser.intermixed = False  # it would lose the "--" before the arguments, whose values may start with "-"
    return cls.of(parser.parse_args([*options, *(["--", *bare] if bare else [])]))


def call(cls: type[Any], given: Sequence[Any], named: Mapping[str, Any]) -> Answer:
    """Run a command with the values of a call; several answers, as of frames, become a list "pictures".

    Raises:
        InputError: as `command_of` and the command itself raise it.
        KeyboardInterrupt: the command was interrupted; stderr tells what it kept.
    """
    told = list[tuple[Mapping[str, Any], str]]()
    command = replace(command_of(cls, given, named), tell=lambda *answer: told.append(answer))
    with more_glasses(command.glass):
        code = command.run()
    if code >= 128:  # it ended by a signal
        raise KeyboardInterrupt
    data = told[0][0] if len(told) == 1 else {"pictures": [data for data, _ in told]}
    return Answer(data, "\n".join(text for _, text in told), code)


def _words(action: argparse.Action, value: Any) -> list[str]:
    """Return the words of a command line that give a parameter this value.

    A tuple is one value of several numbers, as a film's sides or a light's angles. Where an option takes several
    values, a list holds them, or a mapping holds those of KEY=VALUE.
    """
    between = next((mark for mark in "x/" if mark in str(action.metavar)), ",")

    def text(v: Any) -> str:  # numbers keep all their digits
        if isinstance(v, list | tuple):
            return between.join(map(text, v))
        return str(os.fspath(v) if isinstance(v, os.PathLike) else v)

    if isinstance(value, Mapping):
        value = [f"{k}={text(v)}" for k, v in value.items()]
    repeated = isinstance(action, argparse._AppendAction)
    texts = [text(v) for v in value] if isinstance(value, list) and (repeated or action.nargs) else [text(value)]
    option = action.option_strings[-1:]
    if action.nargs == 0 and texts[0] in ("True", "False"):  # anything else is refused as a value
        return [*option] * (texts[0] == "True")
    return [f"{option[0]}={word}" for word in texts] if option and not action.nargs else [*option, *texts]
