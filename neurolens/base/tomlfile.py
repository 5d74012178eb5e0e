"""Reading and writing of TOML, with one error message per mistake."""

from __future__ import annotations

import json
import re
import tomllib
from collections.abc import Mapping, Sequence
from difflib import get_close_matches
from pathlib import Path
from typing import Any

from neurolens.base.errors import InputError

MAX_BYTES = 1_000_000
_BARE_KEY = re.compile(r"[A-Za-z0-9_-]+")


def read_toml(path: str | Path) -> dict[str, Any]:
    """The tables of a TOML file.

    Raises:
        InputError: no regular file, unreadable, larger than `MAX_BYTES`, not UTF-8, broken TOML, or empty.
    """
    path = Path(path)
    if not path.exists():
        raise InputError(path, "file", "(missing)", "a TOML file")
    if not path.is_file():
        raise InputError(path, "file", "(not a regular file)", "a TOML file")
    try:
        with path.open("rb") as file:
            raw = file.read(MAX_BYTES + 1)
    except OSError as error:
        raise InputError(path, "file", f"({error.strerror})", "a readable TOML file") from None
    if len(raw) > MAX_BYTES:
        raise InputError(path, "file", f"(more than {MAX_BYTES} bytes)", f"at most {MAX_BYTES} bytes")
    try:
        data = tomllib.loads(raw.decode("utf-8-sig"))
    except UnicodeDecodeError as error:
        raise InputError(path, "file", f"(byte {error.start} is not UTF-8)", "UTF-8 text") from None
    except (ValueError, RecursionError) as error:  # a number of 5000 digits is a plain ValueError
        raise InputError(path, "file", f"({error})", "valid TOML") from None
    if not data:
        raise InputError(path, "file", "(no keys)", "a TOML file with content")
    return data


def suggestion(word: str, known: Sequence[str]) -> str:
    """ "; did you mean ...?" for the nearest known key, else empty; a key that only lacks its unit counts as near."""
    near = [key for key in known if key.startswith(word + "_")] or get_close_matches(word, known, n=1)
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
    """One TOML value on one line; floats and texts come back bit for bit.

    Raises:
        TypeError: a value that TOML has no form for.
    """
    match value:
        case bool():
            return "true" if value else "false"
        case int() | float():
            return repr(value)
        case str():
            return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
        case Mapping():
            pairs = ", ".join(f"{format_key(k)} = {format_value(v)}" for k, v in value.items())
            return f"{{ {pairs} }}" if pairs else "{}"
        case list() | tuple():
            return "[" + ", ".join(format_value(v) for v in value) + "]"
    raise TypeError(f"TOML has no form for {type(value).__name__}")


def format_key(key: str) -> str:
    """A key, quoted only where it must be."""
    return key if _BARE_KEY.fullmatch(key) else format_value(key)


def format_toml(data: Mapping[str, Any], table: str = "") -> str:
    """A whole TOML text: plain values first, then each table under its heading."""
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
