"""Reading and writing of TOML, with one error message per mistake."""

import json
import math
import re
import tomllib
from collections.abc import Mapping, Sequence
from difflib import get_close_matches
from pathlib import Path
from typing import Any

from neurolens.base.errors import InputError
from neurolens.base.files import read_bytes
from neurolens.base.units import as_float

MAX_BYTES = 1_000_000
_DEEPEST = 100  # tables in each other, or parts of a key
_BARE_KEY = re.compile(r"[A-Za-z0-9_-]+")


def read_toml(path: str | Path) -> dict[str, Any]:
    """Return the tables of a TOML file.

    Raises:
        InputError: no regular file, unreadable, larger than `MAX_BYTES`, not UTF-8, broken TOML, empty, or refused by
            `check_tree`.
    """
    path = Path(path)
    try:
        data = parse_toml(read_bytes(path, MAX_BYTES, "a TOML file").decode("utf-8-sig"), path)
    except UnicodeDecodeError as error:
        raise InputError(path, "file", f"(byte {error.start} is not UTF-8)", "UTF-8 text") from None
    except InputError:
        raise
    except (ValueError, RecursionError) as error:  # a number of 5000 digits is a plain ValueError
        raise InputError(path, "file", f"({error})", "valid TOML") from None
    if not data:
        raise InputError(path, "file", "(no keys)", "a TOML file with content")
    return data


def parse_toml(text: str, file: str | Path) -> dict[str, Any]:
    """Return the tables of a TOML text.

    Raises:
        ValueError, RecursionError: it is no TOML. InputError: refused by `check_tree`.
    """
    # The parser's time grows with the square of the parts of a dotted key.
    if any(piece.count(".") > _DEEPEST for piece in re.split(r"[=,{}\[\]\n]", text)):
        raise ValueError(f"a key of more than {_DEEPEST} parts")
    data = tomllib.loads(text, parse_float=as_float)
    check_tree(data, file)
    return data


def parse_json(text: str | bytes, file: str | Path) -> Any:
    """Return the values of a text of strict JSON: every number is finite, and no object has a key twice.

    Raises:
        ValueError, RecursionError: no JSON. InputError: refused by `check_tree`.
    """

    def finite(number: str) -> float:
        if not math.isfinite(value := float(number)):  # also the words NaN and Infinity
            raise ValueError(f"{number[:40]} is no finite number")
        return value

    def once(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
        found = dict[str, Any]()
        for key, value in pairs:
            if key in found:
                raise ValueError(f"the key {key[:40]!r} is given twice")
            found[key] = value
        return found

    data = json.loads(text, parse_float=finite, parse_constant=finite, object_pairs_hook=once)
    check_tree(data, file)
    return data


def check_tree(data: Any, file: str | Path) -> None:
    """Refuse data of TOML or JSON that no file of ours holds: it would fail later, where its place is not known.

    Raises:
        InputError: tables and lists more than 100 deep, integers of more than 64 bits, texts with zero bytes or halves
            of surrogate pairs.
    """
    level: list[tuple[str, Any]] = [("", data)]
    for _ in range(_DEEPEST):
        inner: list[tuple[str, Any]] = []
        for place, value in level:
            if isinstance(value, dict):
                inner += [(f"{place}.{key}"[-200:] if place else key[:200], item) for key, item in value.items()]
                texts = list(value)
            elif isinstance(value, list):
                inner += [(f"{place}[{k}]"[-200:], item) for k, item in enumerate(value)]
                continue
            else:
                texts = [value] if isinstance(value, str) else []
            if isinstance(value, int) and not -(2**63) <= value < 2**64:
                raise InputError(file, place, "(an integer of more than 64 bits)", "a number of at most 64")
            if any("\0" in t or not t.isascii() and any("\ud800" <= c <= "\udfff" for c in t) for t in texts):
                raise InputError(file, place or "file", "(a zero byte or half a letter)", "text")
        level = inner
    if level:
        raise InputError(file, level[0][0].partition(".")[0], "(nested too deep)", f"at most {_DEEPEST} tables")


_ELSEWHERE = {  # what other programs call a setting
    **dict.fromkeys(("fstop", "f_stop", "aperture", "t_stop", "iris"), "f_number"),
    **dict.fromkeys(("resolution", "res", "size", "resolution_x"), "width"),
    **dict.fromkeys(("focus_distance", "focal_distance", "distance"), "focus"), "spp": "samples",
    **dict.fromkeys(("sensor", "sensor_size", "sensor_width", "filmback"), "film"),
    **{move: f"film_{move}" for move in ("tilt", "swing", "shift", "rise")},
}  # fmt: skip


def suggestion(word: str, known: Sequence[str]) -> str:
    """Return "; did you mean ...?" with the nearest known key, or nothing; a key that only lacks its unit is near."""
    keys = {f"{key}_".replace("-", "_"): key for key in known}
    meant = [_ELSEWHERE.get(word.replace("-", "_"), word), word]
    near = [key for name in meant for at, key in keys.items() if at.startswith(f"{name}_")]
    near = near or get_close_matches(word, known, n=1)
    return f"; did you mean {near[0]!r}?" if near else ""


def reject_unknown(file: str | Path, where: str, data: Mapping[str, Any], known: Sequence[str]) -> None:
    """Raise an InputError for the first key of `data` that is not known, naming the known ones and the nearest.

    `where` goes in front of the key, with its separator: "fit." or "surface 3, ".
    """
    for key in data:
        if key not in known:
            expected = f"one of the known keys: {', '.join(known)}{suggestion(key, known)}"
            raise InputError(file, f"{where}{key}", "(unknown key)", expected)


def format_value(value: Any) -> str:
    """Return a TOML value on one line, from which floats and texts are read back bit for bit.

    Raises:
        TypeError: a value that TOML has no form for. InputError: a name whose bytes are no UTF-8.
    """
    match value:
        case bool():
            return "true" if value else "false"
        case int() | float():
            return repr(value)
        case str():
            if any("\ud800" <= c <= "\udfff" for c in value):  # TOML has no escape for them either
                raise InputError("TOML", "text", value, "UTF-8: rename the file or the folder")
            return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
        case Mapping():
            pairs = ", ".join(f"{format_key(k)} = {format_value(v)}" for k, v in value.items())
            return f"{{ {pairs} }}" if pairs else "{}"
        case list() | tuple():
            return "[" + ", ".join(format_value(v) for v in value) + "]"
    raise TypeError(f"TOML has no form for {type(value).__name__}")


def format_key(key: str) -> str:
    """Return a key, quoted only where it must be."""
    return key if _BARE_KEY.fullmatch(key) else format_value(key)


def format_toml(data: Mapping[str, Any], table: str = "") -> str:
    """Return a whole TOML text: plain values first, then each table under its heading."""
    plain = {k: v for k, v in data.items() if not isinstance(v, Mapping)}
    lines = [f"{format_key(k)} = {format_value(v)}\n" for k, v in plain.items()]
    for key, value in data.items():
        if key not in plain:
            name = f"{table}.{format_key(key)}" if table else format_key(key)
            body = format_toml(value, name)
            # A table that holds only tables needs no heading.
            only_tables = value and all(isinstance(v, Mapping) for v in value.values())
            lines.append(body if only_tables else f"\n[{name}]\n{body}")
    return "".join(lines)
