"""Settings as frozen dataclasses: one declaration for Python, for TOML files and for a command line::

    @dataclass(frozen=True)
    class Blur:
        radius_px: float = setting(3.0, "radius of the kernel", within=(0, 100), unit="pixels")
        only: tuple[str, ...] = setting((), "a layer that is blurred")

        def __post_init__(self) -> None:
            check_bounds(self, "blur")

    add_options(parser, Blur)  # --radius PX, --only NAME
    blur = from_options(Blur, parser.parse_args())
    blur = read_config(Blur, "blur.toml", overrides=["radius_px=2"])

Options: the option of a field is its name without its unit, which becomes the placeholder of the value. Those that
overrule a file's table are added `unset`: their default is None.

TOML: a nested dataclass is a table. The types of fields are bool, int, float (takes an integer, refuses NaN), str,
Path, Literal, Optional and other unions, tuple, and dict with text keys. A class checks its values in `__post_init__`
by `raise InputError("settings", field, value, expected)`; `from_dict` adds the file and the table.
"""

import argparse
import dataclasses
import math
import re
import types
import warnings
from collections.abc import Callable, Collection, Mapping, Sequence
from contextlib import suppress
from copy import deepcopy
from dataclasses import dataclass, field, fields, is_dataclass
from functools import cache
from numbers import Real
from pathlib import Path
from types import NoneType
from typing import Any, Literal, TypeVar, Union, cast, get_args, get_origin, get_type_hints

from neurolens.base.errors import InputError, NeurolensWarning
from neurolens.base.tomlfile import format_toml, parse_toml, read_toml, reject_unknown
from neurolens.base.units import WORTH, as_float, in_unit

T = TypeVar("T")
_hints: Callable[[Any], dict[str, Any]] = cache(get_type_hints)  # cached, for each call evaluates every annotation anew
# Bounds that every input keeps: beyond them searches take minutes or find no light.
F_NUMBER = 0.1, 10_000.0
FOCAL_MM = 1e-3, 1e6
FILM_MM = 1e-3, 1e4  # a side
WAVELENGTH_NM = 100.0, 20_000.0  # from lithography to thermal cameras
LIGHT_NM = 400.0, 700.0  # of scenes, films and lenses that name no other
EYE_NM = 380.0, 780.0  # what an eye sees at all
LARGEST_SEED = (1 << 63) - 1  # that generators of random numbers take
RANGE = "range"  # a zoom position that stands for all of them
_UNIT = re.compile(r"(.+?)_(per_mm|px|mm|um|nm|m|deg|s)")
_PLACEHOLDERS = {int: "N", float: "X", str: "NAME", Path: "FILE"}
_NAMES = {
    bool: "true or false",
    int: "an integer",
    float: "a number",
    str: "a text",
    Path: "a path",
    NoneType: '"none"',
}


def within(bounds: tuple[float, float], value: float) -> bool:
    """Return whether a value lies between two bounds; NaN does not."""
    return bounds[0] <= value <= bounds[1]


def said(bounds: tuple[float, float]) -> str:
    """Return the bounds in words: "from 0.1 to 10000"."""
    return f"from {bounds[0]:g} to {bounds[1]:g}"


@dataclass(frozen=True)
class Option:
    """The option of a command line that a field stands for.

    Attributes:
        about: the help; `add_options` adds the default where the help does not mention one, and texts for {}.
        within: the smallest and the largest value of a number; the largest may be inf. unit: what the number is, for
            messages.
        option: name of the option ("reflections") and of the parsed argument, where it is not the field's.
        short: a short name ("-o"). old: earlier names, which still work but are not in the help. A mapping gives for
            each name the function that converts the text of its value, or the value for which the name stands.
        metavar: placeholder of the value in the help.
        kind: converts the text of a value, where the type of the field does not.
        nargs: as argparse has it; without it a tuple is an option that may be repeated.
        positional: whether it is an argument without a name. apart: options with the same word exclude each other.
        title: that of its group of options in the help.
        last: above 0 for what help shows after all other options, in this order.
        common: whether it is among the options that the short help of a command shows.
        written: whether it is a path that a command writes.
        assumed: whether a command finds a value, and says so, where none is given.
    """

    about: str
    within: tuple[float, float] | None = None
    unit: str = "a number"
    option: str = ""
    short: str = ""
    old: Sequence[str] | Mapping[str, Any] = ()
    metavar: str | tuple[str, ...] = ""
    kind: Callable[[str], Any] | None = None
    nargs: int | str | None = None
    positional: bool = False
    apart: str = ""
    title: str = ""
    last: int = 0
    common: bool = False
    written: bool = False
    assumed: bool = False


def setting(default: Any, about: str, **details: Any) -> Any:
    """Declare a settings field that is also an option (`Option`); with `...` as its default it is required."""
    metadata = {"option": Option(about, **details)}
    return field(metadata=metadata) if default is ... else field(default=default, metadata=metadata)


def setting_of(cls: Any, name: str, default: Any = None) -> Any:
    """Declare a field that is the same option as a field of another class, with another default."""
    return field(default=default, metadata=cls.__dataclass_fields__[name].metadata)


def group(title: str, **more: Any) -> Any:
    """Declare a field that is a dataclass of options under a title in the help; `more` goes to `add_options`."""
    return field(metadata={"group": title, "more": more})


@dataclass(frozen=True)
class Rule:
    """What the values of a field have in common; a type that has it is `Annotated[kind, rule]`.

    Attributes:
        good: the test that a value must pass. expected: what a message says of good values.
        colour: whether values are colours, for which one number stands for a grey.
    """

    good: Callable[[Any], bool]
    expected: str
    colour: bool = False


def bounded(low: float, high: float, unit: str = "a number", kind: type = float) -> Rule:
    """Return the rule that a number lies from `low` to `high`."""

    def good(value: Any) -> bool:
        return isinstance(value, Real) and not isinstance(value, bool) and within((low, high), float(value))

    return Rule(good, _expected(kind, (low, high), unit))


@cache
def rules_of(cls: Any) -> dict[str, Rule]:
    """Return the rule of each field of a dataclass: from its bounds, from its list of texts, or from its type."""
    typed, rules = get_type_hints(cls, include_extras=True), dict[str, Rule]()
    for f in fields(cls):
        option, kind = f.metadata.get("option"), _kind(_hints(cls)[f.name])[0]
        notes = [note for k in (typed[f.name], *get_args(typed[f.name])) for note in getattr(k, "__metadata__", ())]
        if option and option.within:
            rules[f.name] = bounded(option.within[0], option.within[1], option.unit, kind)
        elif get_origin(kind) is Literal:
            rules[f.name] = Rule(get_args(kind).__contains__, f"one of: {', '.join(map(str, get_args(kind)))}")
        elif notes:
            rules[f.name] = notes[0]
    return rules


def check_bounds(settings: Any, what: str) -> None:
    """Refuse values that their fields' rules (`rules_of`) do not allow; None is allowed. Called in `__post_init__`.

    Raises:
        InputError: about `what`.
    """
    for name, rule in rules_of(type(settings)).items():  # type: ignore[arg-type]
        if (value := getattr(settings, name)) is not None and not rule.good(value):
            raise InputError(what, name, value, rule.expected)


def number(kind: Callable[[str], T], good: Callable[[T], bool], expected: str) -> Callable[[str], T]:
    """Make the type of an argument: a number for which `good` is true. NaN and numbers beyond any float are refused."""

    def convert(text: str) -> T:
        try:
            value: Any = as_float(text) if kind is float else kind(text)
            if good(value):
                return cast(T, value)
        except ValueError:
            pass
        raise argparse.ArgumentTypeError(f"got {text!r}, expected {expected}")

    return convert


def between(low: float, high: float, unit: str, kind: Callable[[str], Any] = float) -> Callable[[str], Any]:
    """Type of an argument that is a number from `low` to `high`."""
    return number(kind, lambda value: low <= value <= high, _expected(kind, (low, high), unit))


def whole(least: int, most: int = LARGEST_SEED) -> Callable[[str], int]:
    """Type of an argument that is an integer from `least` to `most`."""
    return between(least, most, "", int)


def wavelengths_nm(text: str) -> tuple[float, ...]:
    """Type of --wavelengths: one or more in nm, with commas between them."""
    return listed(between(*WAVELENGTH_NM, "wavelengths in nm"))(text)


def listed(kind: Callable[[str], T]) -> Callable[[str], tuple[T, ...]]:
    """Type of an argument of one or more values of a type, with commas between them."""
    return lambda text: tuple(kind(word) for word in text.split(","))


def positive(unit: str, *, infinite: bool = False) -> Callable[[str], float]:
    """Type of an argument that is a number above 0; "inf" only if `infinite`."""
    expected = f"{unit} above 0{', or inf' if infinite else ''}"
    return number(float, lambda value: value > 0 and (infinite or not math.isinf(value)), expected)


def _expected(kind: Any, bounds: tuple[float, float], unit: str) -> str:
    low, high = (f"{bound}" if kind is int else f"{bound:g}" for bound in bounds)
    return f"{'an integer' if kind is int else unit} from {low}" + ("" if math.isinf(bounds[1]) else f" to {high}")


def add_options(
    parser: argparse._ActionsContainer, cls: type, names: Collection[str] = (), *, unset: bool = False,
    texts: Mapping[str, str] | None = None, root: argparse._ActionsContainer | None = None, **defaults: Any,
) -> None:  # fmt: skip
    """Add the fields of `cls` that are declared by `setting` as options, also those of dataclasses inside it.

    Args:
        parser: a parser, or a group of its arguments.
        names: if any are given, only these fields. defaults: those of this command, where the fields have others.
        unset: whether all options have the default None.
        texts: for some fields, what replaces {} in their help, where otherwise nothing stands.
        root: the parser that gets the groups of arguments, where `parser` is a group.
    """
    hints, apart, texts = _hints(cls), dict[str, Any](), texts or {}
    for f in sorted(_options(cls), key=lambda f: getattr(f.metadata.get("option"), "last", 0)):
        option: Option | None = f.metadata.get("option")
        if option is None:
            place = titled(root or parser, f.metadata["group"]) or parser
            add_options(place, hints[f.name], root=root or parser, **f.metadata["more"])
        elif is_dataclass(hints[f.name]):
            add_options(parser, hints[f.name], names, unset=unset, texts=texts, **defaults)
        elif not names or f.name in names:
            place = titled(root or parser, option.title) or parser
            if option.apart:
                place = apart[option.apart] = apart.get(option.apart) or place.add_mutually_exclusive_group()
            default = defaults.get(f.name, None if unset else f.default)
            names_of, details = _details(f, option, hints[f.name], default, texts.get(f.name))
            action = place.add_argument(*names_of, **details)
            action.common = option.common  # type: ignore[attr-defined]  # of `cli.arguments.Parser.format_help`
            if not isinstance(option.old, Mapping):
                parser._option_string_actions.update({f"--{word}": action for word in option.old})
                continue
            for word, value in option.old.items():
                more = {"type": value} if callable(value) else {"action": "store_const", "const": value}
                parser.add_argument(
                    f"--{word}", dest=details["dest"], default=details["default"], help=argparse.SUPPRESS, **more
                )


def titled(parser: argparse._ActionsContainer, title: str) -> argparse._ActionsContainer | None:
    """Return the parser's group with this title, which is made once; None without a title."""
    named = (group for group in parser._action_groups if group.title == title)
    return (next(named, None) or parser.add_argument_group(title)) if title else None


def _details(
    f: Any, option: Option, hint: Any, default: Any, text: str | None
) -> tuple[tuple[str, ...], dict[str, Any]]:
    """Return the names and the other arguments for `add_argument`."""
    (kind, many), required = _kind(hint), default is dataclasses.MISSING
    about = option.about.replace("{}", text or "")
    if not (required or "default" in about or default is None or default is False or default == ()):
        about += f" (default: {f'{default:g}' if isinstance(default, float) else default})"
    details: dict[str, Any] = {"help": about}
    if not required:
        details["default"] = list(default) if isinstance(default, tuple) and many else default
    if kind is bool:
        details["action"] = "store_true"
    elif get_origin(kind) is Literal and option.kind is None:
        details["choices"] = get_args(kind)
    else:
        unit = _UNIT.fullmatch(f.name)
        details["metavar"] = option.metavar or (unit[2].upper() if unit else _PLACEHOLDERS[kind])
        bounds = None if option.kind else option.within
        details["type"] = between(*bounds, option.unit, kind) if bounds else option.kind or kind
        typed = unit_of(f.name) or str(option.metavar).lower()
        if typed == "f" or any(typed in worth for worth in WORTH):
            details["type"] = in_unit(typed, details["type"])
    if option.nargs is not None:
        details["nargs"] = option.nargs
    elif many:
        details["action"] = "append"
    if option.positional:
        return (f.name,), details
    details |= {"dest": _dest(f, option)} | ({"required": True} if required else {})
    return tuple(filter(None, (option.short, spelling(f, option)))), details


def from_options(cls: type[T], args: argparse.Namespace, names: Collection[str] = (), *, unset: bool = False) -> T:
    """Make settings from the options of `add_options`; options that were not added have their defaults.

    Args:
        names: as in `add_options`. unset: whether fields that were not given are None in the result.

    Raises:
        InputError: what the class refuses.
    """
    hints, values = _hints(cls), dict.fromkeys((f.name for f in fields(cls)) if unset else (), None)  # type: ignore[arg-type]
    for f in _options(cls):
        if is_dataclass(hints[f.name]):
            more = f.metadata.get("more", {"names": names})
            values[f.name] = from_options(hints[f.name], args, more.get("names", ()), unset=more.get("unset", unset))
        elif names and f.name not in names:
            continue
        elif (value := getattr(args, _dest(f, f.metadata["option"]), None)) is not None or unset:
            values[f.name] = tuple(value) if isinstance(value, list) else value
    return cls(**values)


def changed(settings: Any, *, unset: bool = False) -> dict[str, Any]:
    """Return the options whose values are not their defaults, by their spelling: {"--f-number": 4.0}.

    `unset`: whether every option's default is None, as in `add_options`.
    """
    found: dict[str, Any] = {}
    for f in _options(type(settings)):
        value = getattr(settings, f.name)
        if is_dataclass(value):
            found |= changed(value, unset=f.metadata.get("more", {}).get("unset", unset))
        elif value != (None if unset else f.default) and not f.metadata["option"].positional:
            found[spelling(f, f.metadata["option"])] = value
    return found


def with_changes(settings: T, changes: object) -> T:
    """Return settings with the values of `changes`, a mapping or an object, that are not None."""
    values = changes
    if not isinstance(values, Mapping):
        values = {f.name: getattr(changes, f.name, None) for f in fields(settings)}  # type: ignore[arg-type]
    return dataclasses.replace(settings, **{name: v for name, v in values.items() if v is not None})  # type: ignore[type-var]


def _options(cls: type) -> list[Any]:
    return [f for f in fields(cls) if {"option", "group"} & f.metadata.keys()]


def without_unit(name: str) -> str:
    """Return the name of a figure, "focus_m", without its unit: "focus"."""
    unit = _UNIT.fullmatch(name)
    return unit[1] if unit else name


def spelling(f: Any, option: Option) -> str:
    """Return how the option of a field is written: "--f-number"."""
    return f"--{option.option or without_unit(f.name).replace('_', '-')}"


def _dest(f: Any, option: Option) -> str:
    """Return the attribute of the parsed arguments that holds an option."""
    return f.name if option.positional else (option.option or f.name).replace("-", "_")


def _kind(hint: Any) -> tuple[Any, bool]:
    """Return the type of one value, and whether a field takes many: of `tuple[str, ...]` str and True.

    Of a union it is the first type that is not None.
    """
    kinds = [kind for kind in get_args(hint) if kind is not NoneType]
    if NoneType in get_args(hint):
        return _kind(kinds[0])
    return (kinds[0], True) if get_origin(hint) is tuple and kinds[1:] == [Ellipsis] else (hint, False)


def read_config(cls: type[T], path: str | Path, overrides: Sequence[str] = ()) -> T:
    """Return the settings of a TOML file, with overrides such as "fit.terms=40" applied on top.

    Raises:
        InputError: see `read_toml`, `apply_overrides` and `from_dict`; a mistake in an override names "--set".
    """
    data = apply_overrides(read_toml(path), overrides)
    try:
        return from_dict(cls, data, path)
    except InputError as error:
        if error.field in {text.partition("=")[0].strip() for text in overrides}:
            raise InputError("--set", error.field, error.value, error.expected) from None
        raise


def apply_overrides(data: Mapping[str, Any], overrides: Sequence[str]) -> dict[str, Any]:
    """Return a copy of `data` with each "dotted.key=value" set; in a list of tables, every table gets the value.

    Values are TOML; a bare word is a string.

    Raises:
        InputError: no "=", an empty key, broken TOML, or a key inside something that is not a table.
    """
    result = deepcopy(dict(data))
    for text in overrides:
        dotted, equals, value = (part.strip() for part in text.partition("="))
        keys = dotted.split(".")
        if not equals or not all(keys):
            raise InputError("--set", text, "(not of this form)", "key=value or table.key=value")
        tables: list[Any] = [result]
        for depth, key in enumerate(keys[:-1]):
            inner = [table.setdefault(key, {}) for table in tables]
            tables = [table for found in inner for table in (found if isinstance(found, list) else [found])]
            if not all(isinstance(table, dict) for table in tables):
                raise InputError("--set", dotted, f"({'.'.join(keys[: depth + 1])} is not a table)", "a key of a table")
        found = _override_value(dotted, value)
        for table in tables:
            table[keys[-1]] = deepcopy(found)
    return result


def _override_value(dotted: str, text: str) -> Any:
    try:
        parsed = parse_toml(f"value = {text}\n", "--set")
    except InputError:
        raise
    except (ValueError, RecursionError) as error:
        if text and text[0] not in "[{\"'" and "\n" not in text:
            return text
        raise InputError("--set", dotted, text, f"a TOML value ({error})") from None
    if set(parsed) != {"value"}:
        raise InputError("--set", dotted, text, "one TOML value")
    return parsed["value"]


def from_dict(cls: type[T], data: Mapping[str, Any], file: str | Path, prefix: str = "") -> T:
    """Return an instance of the dataclass `cls` from the tables of a TOML file.

    Keys of earlier versions that changed no ray, `cls.WITHOUT_EFFECT`, are skipped with a warning. A class may have a
    function `keys_read`, which first rewrites other spellings of values.

    Args:
        file: source of the data, for messages.
        prefix: dotted place of `data` in the file, "" for the top.

    Raises:
        InputError: an unknown key (with the known ones and the nearest), a missing key, a wrong type, or what
            `__post_init__` refuses.
    """
    known = {f.name: f for f in fields(cls) if f.init}  # type: ignore[arg-type]
    data = _with_new_names(known, getattr(cls, "keys_read", dict)(data), file, prefix)
    for name in set(data) & set(getattr(cls, "WITHOUT_EFFECT", ())):
        data = {key: value for key, value in data.items() if key != name}
        warnings.warn(f"{file}: {_join(prefix, name)} has no effect any more", NeurolensWarning, stacklevel=2)
    reject_unknown(file, prefix and f"{prefix}.", data, list(known))
    hints = _hints(cls)
    values: dict[str, Any] = {}
    for name, f in known.items():
        place = _join(prefix, name)
        if name in data:
            values[name] = _convert(_in_unit_of(name, data[name]), hints[name], file, place)
        elif f.default in (dataclasses.MISSING, ...) and f.default_factory is dataclasses.MISSING:
            raise InputError(file, place, "(missing)", _describe(hints[name]))
    try:
        return cls(**values)
    except InputError as error:
        raise InputError(file, _join(prefix, error.field), error.value, error.expected) from None


def _with_new_names(
    known: Mapping[str, dataclasses.Field[Any]], data: Mapping[str, Any], file: str | Path, prefix: str
) -> Mapping[str, Any]:
    """Return the data with keys that were renamed (the field's metadata `was`) under their new names."""
    for name, f in known.items():
        for old in [old for old in f.metadata.get("was", ()) if old in data]:
            values = [data[key] for key in (name, old) if data.get(key, "none") != "none"]
            if len(values) > 1:
                raise InputError(file, _join(prefix, old), data[old], f"left out beside {name}, its new name")
            rest = {key: value for key, value in data.items() if key not in (name, old)}
            data = {**rest, name: values[0] if values else "none"}
    return data


def _join(prefix: str, name: str) -> str:
    return f"{prefix}.{name}" if prefix else name


def unit_of(name: str) -> str:
    """Return the unit that a field's name ends with: "m" of focus_m, "f" of f_number; "" without one."""
    unit = _UNIT.fullmatch(name)
    return "f" if name == "f_number" else unit[2] if unit else ""


def _in_unit_of(name: str, value: Any) -> Any:
    """Convert texts with a unit ("6ft"), also in a list, to numbers in the unit of the field; keep other values."""
    if isinstance(value, list):
        return [_in_unit_of(name, item) for item in value]
    if isinstance(value, str) and (unit := unit_of(name)) and (plain := in_unit(unit, str)(value)) != value:
        with suppress(ValueError):  # two numbers
            return float(plain)
    return value


def _convert(value: Any, kind: Any, file: str | Path, place: str) -> Any:
    """Return `value` as the type `kind`, or raise an InputError."""
    origin, args = get_origin(kind), get_args(kind)
    if origin in (Union, types.UnionType):
        return _convert_union(value, args, file, place)
    if origin is dict and isinstance(value, Mapping):
        return {str(k): _convert(v, args[1], file, f"{place}.{k}") for k, v in value.items()}
    if origin is tuple and isinstance(value, list | tuple):
        kinds = (args[0],) * len(value) if Ellipsis in args else args
        if len(kinds) == len(value):
            return tuple(
                _convert(v, k, file, f"{place}[{i}]") for i, (v, k) in enumerate(zip(value, kinds, strict=True))
            )
    if is_dataclass(kind) and isinstance(kind, type) and isinstance(value, Mapping):
        return from_dict(kind, value, file, place)
    if origin is Literal and any(value == choice and type(value) is type(choice) for choice in args):
        return value
    scalar = _convert_scalar(value, kind)
    if scalar is None:
        raise InputError(file, place, value, _describe(kind))
    return scalar


def _convert_scalar(value: Any, kind: Any) -> Any:
    """Return `value` as bool, int, float, str or Path, else None. A bool is no number, nor is NaN."""
    if kind is float and isinstance(value, int | float) and not isinstance(value, bool):
        try:
            return None if math.isnan(value) else float(value)
        except OverflowError:
            return None
    if kind is int and isinstance(value, bool):
        return None
    if kind is Path and isinstance(value, str | Path):
        return Path(value)
    return value if kind in (bool, int, str) and isinstance(value, kind) else None


def _convert_union(value: Any, kinds: tuple[Any, ...], file: str | Path, place: str) -> Any:
    """Return the value as the first type that fits. The text "none" is None where that is allowed: TOML has no null."""
    if type(None) in kinds and (value is None or value == "none"):
        return None
    inner = [kind for kind in kinds if kind is not type(None)]
    if len(inner) == 1:
        return _convert(value, inner[0], file, place)  # keeps the precise message of a nested table
    for kind in inner:
        with suppress(InputError):
            return _convert(value, kind, file, place)
    raise InputError(file, place, value, " or ".join(_describe(kind) for kind in kinds))


def _describe(kind: Any) -> str:
    origin, args = get_origin(kind), get_args(kind)
    if origin in (Union, types.UnionType):
        return " or ".join(_describe(a) for a in args)
    if origin is Literal:
        return "one of: " + ", ".join(map(repr, args))
    if origin is tuple and Ellipsis not in args:
        return "a list of " + ", ".join(_describe(a) for a in args)
    if origin is tuple:
        return f"a list, each {_describe(args[0])}"
    if is_dataclass(kind):
        return "a table with " + ", ".join(f.name for f in fields(kind) if f.init)
    return "a table" if origin is dict else _NAMES.get(kind, str(kind))


def to_dict(config: Any) -> dict[str, Any]:
    """Return settings as plain tables and values, the form that `from_dict` takes; None becomes the text "none"."""

    def plain(value: Any) -> Any:
        if is_dataclass(value):
            return {f.name: plain(getattr(value, f.name)) for f in fields(value) if f.init}
        if isinstance(value, Mapping):
            return {key: plain(item) for key, item in value.items()}
        if isinstance(value, list | tuple):
            return [plain(item) for item in value]
        return "none" if value is None else str(value) if isinstance(value, Path) else value

    return plain(config)


def to_toml(config: Any) -> str:
    """Return the resolved settings as TOML, with every default; `read_config` gives the same settings back."""
    return format_toml(to_dict(config))
