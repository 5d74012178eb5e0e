"""Settings as frozen dataclasses, read strictly from TOML, with `--set fit.terms=40` on top.

A settings class is a plain frozen dataclass; nested dataclasses are TOML tables. Field types understood: bool, int,
float (takes an integer too, refuses NaN), str, Path, Literal, Optional and other unions, tuple, dict with text keys.
Checks of values belong in `__post_init__`, as `raise InputError("settings", field, value, expected)`: file and table
are added here.
"""

from __future__ import annotations

import dataclasses
import math
import types
from collections.abc import Mapping, Sequence
from copy import deepcopy
from pathlib import Path
from typing import Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

from neurolens.base.errors import InputError
from neurolens.base.tomlfile import format_toml, parse_toml, read_toml, reject_unknown

T = TypeVar("T")
_NAMES = {
    bool: "true or false",
    int: "an integer",
    float: "a number",
    str: "a text",
    Path: "a path",
    type(None): '"none"',
}


def read_config(cls: type[T], path: str | Path, overrides: Sequence[str] = ()) -> T:
    """The settings of a TOML file, with overrides such as "fit.terms=40" applied on top.

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
    """A copy of `data` with each "dotted.key=value" set. Values are TOML; a bare word is a string.

    Raises:
        InputError: no "=", an empty key, broken TOML, or a key inside something that is not a table.
    """
    result = deepcopy(dict(data))
    for text in overrides:
        dotted, equals, value = (part.strip() for part in text.partition("="))
        keys = dotted.split(".")
        if not equals or not all(keys):
            raise InputError("--set", text, "(not of this form)", "key=value or table.key=value")
        table: Any = result
        for depth, key in enumerate(keys[:-1]):
            table = table.setdefault(key, {})
            if not isinstance(table, dict):
                raise InputError("--set", dotted, f"({'.'.join(keys[: depth + 1])} is not a table)", "a key of a table")
        table[keys[-1]] = _override_value(dotted, value)
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
    """An instance of the dataclass `cls` from the tables of a TOML file.

    Args:
        file: source of the data, for messages.
        prefix: dotted place of `data` in the file, "" for the top.

    Raises:
        InputError: an unknown key (with the known ones and the nearest), a missing key, a wrong type, or what
            `__post_init__` refuses.
    """
    fields = {f.name: f for f in dataclasses.fields(cls) if f.init}  # type: ignore[arg-type]
    data = _with_new_names(fields, data, file, prefix)
    reject_unknown(file, prefix and f"{prefix}.", data, list(fields))
    hints = get_type_hints(cls)
    values: dict[str, Any] = {}
    for name, field in fields.items():
        place = _join(prefix, name)
        if name in data:
            values[name] = _convert(data[name], hints[name], file, place)
        elif field.default is dataclasses.MISSING and field.default_factory is dataclasses.MISSING:
            raise InputError(file, place, "(missing)", _describe(hints[name]))
    try:
        return cls(**values)
    except InputError as error:
        raise InputError(file, _join(prefix, error.field), error.value, error.expected) from None


def _with_new_names(
    fields: Mapping[str, dataclasses.Field[Any]], data: Mapping[str, Any], file: str | Path, prefix: str
) -> Mapping[str, Any]:
    """The data with keys that were renamed (the field's metadata `was`) under their new names."""
    for name, field in fields.items():
        for old in field.metadata.get("was", ()):
            if old not in data:
                continue
            values = [data[key] for key in (name, old) if data.get(key, "none") != "none"]
            if len(values) > 1:
                raise InputError(file, _join(prefix, old), data[old], f"left out beside {name}, its new name")
            rest = {key: value for key, value in data.items() if key not in (name, old)}
            data = {**rest, name: values[0] if values else "none"}
    return data


def _join(prefix: str, name: str) -> str:
    return f"{prefix}.{name}" if prefix else name


def _convert(value: Any, kind: Any, file: str | Path, place: str) -> Any:
    """`value` as the type `kind`, or an InputError."""
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
    if dataclasses.is_dataclass(kind) and isinstance(kind, type) and isinstance(value, Mapping):
        return from_dict(kind, value, file, place)
    if origin is Literal and any(value == choice and type(value) is type(choice) for choice in args):
        return value
    scalar = _convert_scalar(value, kind)
    if scalar is None:
        raise InputError(file, place, value, _describe(kind))
    return scalar


def _convert_scalar(value: Any, kind: Any) -> Any:
    """`value` as bool, int, float, str or Path; None where it is not one. A bool is no number, NaN neither."""
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
    """The first kind that fits; the text "none" is None where None is allowed, as TOML has no null."""
    if type(None) in kinds and (value is None or value == "none"):
        return None
    inner = [kind for kind in kinds if kind is not type(None)]
    if len(inner) == 1:
        return _convert(value, inner[0], file, place)  # keeps the precise message of a nested table
    for kind in inner:
        try:
            return _convert(value, kind, file, place)
        except InputError:
            continue
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
    if dataclasses.is_dataclass(kind):
        return "a table with " + ", ".join(f.name for f in dataclasses.fields(kind) if f.init)
    return "a table" if origin is dict else _NAMES.get(kind, str(kind))


def to_dict(config: Any) -> dict[str, Any]:
    """Settings as plain tables and values, the form that `from_dict` takes; None becomes the text "none"."""

    def plain(value: Any) -> Any:
        if dataclasses.is_dataclass(value):
            return {f.name: plain(getattr(value, f.name)) for f in dataclasses.fields(value) if f.init}
        if isinstance(value, Mapping):
            return {key: plain(item) for key, item in value.items()}
        if isinstance(value, list | tuple):
            return [plain(item) for item in value]
        return "none" if value is None else str(value) if isinstance(value, Path) else value

    return plain(config)


def to_toml(config: Any) -> str:
    """The resolved settings as TOML, every default written out; `read_config` gives the same settings back."""
    return format_toml(to_dict(config))
