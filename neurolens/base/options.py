"""Fields of a settings dataclass as options of a command line: one declaration for Python, TOML and argparse::

    @dataclass(frozen=True)
    class Blur:
        radius_px: float = setting(3.0, "radius of the kernel", within=(0, 100), unit="pixels")
        only: tuple[str, ...] = setting((), "a layer that is blurred")

        def __post_init__(self) -> None:
            check_bounds(self, "blur")

    add_options(parser, Blur)  # --radius PX, --only NAME
    blur = from_options(Blur(), parser.parse_args())

The option of a field is its name without its unit, which becomes the placeholder of the value. `base.config` reads the
same fields from TOML; options that overrule a file's table are added `unset`, and `from_options` takes that table.
"""

from __future__ import annotations

import argparse
import re
from collections.abc import Callable, Collection, Sequence
from dataclasses import field, fields, is_dataclass, replace
from functools import partial
from numbers import Real
from pathlib import Path
from types import NoneType
from typing import Any, Literal, TypeVar, get_args, get_origin, get_type_hints

from neurolens.base.errors import InputError

T = TypeVar("T")
_UNIT = re.compile(r"(.+?)_(per_mm|px|mm|um|nm|m|deg|s)")
_PLACEHOLDERS = {int: "N", float: "X", str: "NAME", Path: "FILE"}


def setting(
    default: Any,
    about: str,
    *,
    within: tuple[float, float] | None = None,
    unit: str = "a number",
    option: str = "",
    old: Sequence[str] = (),
    metavar: str = "",
) -> Any:
    """A field of a settings dataclass that is also an option.

    Args:
        about: the help; `add_options` adds the default where the help does not mention one.
        within: the smallest and the largest value of a number. unit: what the number is, for messages.
        option: name of the option ("reflections") and of the parsed argument, where it is not the field's.
        old: earlier names, which still work and which help does not show.
        metavar: placeholder of the value in the help.
    """
    about_it = {"about": about, "within": within, "unit": unit, "option": option, "old": old, "metavar": metavar}
    return field(default=default, metadata=about_it)


def check_bounds(settings: Any, what: str) -> None:
    """Refuse numbers out of the bounds of their fields, for `__post_init__`; raises InputError about `what`."""
    hints = get_type_hints(type(settings))
    for f in fields(settings):
        value, bounds = getattr(settings, f.name), f.metadata.get("within")
        good = isinstance(value, Real) and not isinstance(value, bool) and bounds and bounds[0] <= value <= bounds[1]
        if bounds and value is not None and not good:
            raise InputError(what, f.name, value, _expected(_kind(hints[f.name])[0], bounds, f.metadata["unit"]))


def number(kind: Callable[[str], T], good: Callable[[T], bool], expected: str) -> Callable[[str], T]:
    """Type of an argument: the number of a text where it is `good`, which NaN never is."""

    def convert(text: str) -> T:
        try:
            value = kind(text)
            if good(value):
                return value
        except ValueError:
            pass
        raise argparse.ArgumentTypeError(f"got {text!r}, expected {expected}")

    return convert


def add_options(
    parser: argparse._ActionsContainer, cls: type, names: Collection[str] = (), *, unset: bool = False, **defaults: Any
) -> list[argparse.Action]:
    """Add the fields of `cls` that are declared by `setting` as options, also those of dataclasses inside it.

    Args:
        parser: a parser, or a group of its arguments.
        names: these fields alone. defaults: of this command, where they differ from those of the fields.
        unset: whether all options have the default None, which leaves a setting as it is (see `from_options`).
    """
    hints, actions = get_type_hints(cls), list[argparse.Action]()
    for f in (f for f in fields(cls) if f.metadata.get("about") is not None):
        if is_dataclass(inner := hints[f.name]) and isinstance(inner, type):
            actions += add_options(parser, inner, names, unset=unset, **defaults)
        elif not names or f.name in names:
            default = defaults.get(f.name, None if unset else f.default)
            actions.append(_add(parser, f.name, hints[f.name], default, **f.metadata))
    return actions


def from_options(settings: T, args: argparse.Namespace) -> T:
    """Settings with the values of the options of `add_options`; a field without option or value stays as it is.

    Raises:
        InputError: what the class refuses.
    """
    values: dict[str, Any] = {}
    hints = get_type_hints(type(settings))
    for f in (f for f in fields(settings) if f.metadata.get("about") is not None):  # type: ignore[arg-type]
        if is_dataclass(inner := hints[f.name]) and isinstance(inner, type):
            values[f.name] = from_options(getattr(settings, f.name), args)
        elif (value := getattr(args, _dest(f.name, f.metadata["option"]), None)) is not None:
            values[f.name] = tuple(value) if isinstance(value, list) else value
    return replace(settings, **values)  # type: ignore[type-var]


def _add(
    parser: argparse._ActionsContainer, name: str, hint: Any, default: Any, *, about: str,
    within: tuple[float, float] | None, unit: str, option: str, old: Sequence[str], metavar: str,
) -> argparse.Action:  # fmt: skip
    kind, many = _kind(hint)
    match = _UNIT.fullmatch(name)
    if "(default" not in about and not (default is None or default is False or default == ()):
        about += f" (default: {f'{default:g}' if isinstance(default, float) else default})"
    more: dict[str, Any] = {"dest": _dest(name, option), "help": about}
    more["default"] = list(default) if isinstance(default, tuple) else default
    if kind is bool:
        more["action"] = "store_true"
    elif get_origin(kind) is Literal:
        more["choices"] = get_args(kind)
    else:
        more["metavar"] = metavar or (match[2].upper() if match else _PLACEHOLDERS[kind])
        more["type"] = kind
        if within:
            good = partial(lambda low, high, value: low <= value <= high, *within)
            more["type"] = number(kind, good, _expected(kind, within, unit))
    if many:
        more["action"] = "append"
    action = parser.add_argument(_option(name, option), **more)
    parser._option_string_actions.update({f"--{word}": action for word in old})
    return action


def option_names(cls: type, names: Collection[str] = ()) -> dict[str, str]:
    """The options of `add_options` by the attribute of the parsed arguments."""
    every = [f for f in fields(cls) if f.metadata.get("about") is not None and (not names or f.name in names)]
    return {_dest(f.name, f.metadata["option"]): _option(f.name, f.metadata["option"]) for f in every}


def _option(name: str, option: str) -> str:
    match = _UNIT.fullmatch(name)
    return f"--{option or (match[1] if match else name).replace('_', '-')}"


def _dest(name: str, option: str) -> str:
    """The attribute of the parsed arguments."""
    return (option or name).replace("-", "_")


def _kind(hint: Any) -> tuple[Any, bool]:
    """The type of one value, the first of several, and whether the field takes many: of `int | None` int, of
    `tuple[str, ...]` str."""
    kinds = [kind for kind in get_args(hint) if kind is not NoneType]
    if get_origin(hint) is tuple and kinds[1:] == [Ellipsis]:
        return kinds[0], True
    return (kinds[0], False) if NoneType in get_args(hint) else (hint, False)


def _expected(kind: Any, within: tuple[float, float], unit: str) -> str:
    low, high = within
    return f"an integer from {low} to {high}" if kind is int else f"{unit} from {low:g} to {high:g}"
