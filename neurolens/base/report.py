"""The answer of a command: a dataclass, of which JSON (`plain`), a text and tables for CSV are made.

Its fields are the keys of the JSON and the columns of the tables, with units in their names::

    @dataclass(frozen=True)
    class Falloff(Report):
        name: str
        field_deg: Array
        wavelength_nm: Array
        light: Array = field(metadata=over("field_deg", "wavelength_nm"))

writes falloff.csv, with a row of what is said once, and falloff.field-wavelength.csv, with a row for each of both.
"""

import csv
import io
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, is_dataclass
from pathlib import Path
from typing import Any, TypeVar

from neurolens.base.errors import printable
from neurolens.base.files import atomic_write_text
from neurolens.base.settings import without_unit

T = TypeVar("T")
Rows = list[dict[str, Any]]  # of a table, by the names of its columns


@dataclass(frozen=True)
class Report:
    """The base class of the answers of commands."""

    def text(self) -> str:
        """Return what the command prints."""
        raise NotImplementedError

    def to_dict(self, full: bool = True) -> dict[str, Any]:
        """Return plain lists, numbers and strings by field name; NaN and infinities stay floats. See `plain`."""
        return plain(self, strict=False, full=full)


# Metadata of fields. A field in bulk holds a number for each ray or pixel: JSON has it where it is asked for, tables
# never. The keys of a part, which is a dataclass or a mapping, stand among those of the answer. An optional field has
# no key where it is None.
BULK, PART, OPTIONAL = {"bulk": True}, {"part": True}, {"optional": True}


def over(*axes: str) -> dict[str, Any]:
    """Return the metadata of a field that is an array over these axes, or a mapping of such arrays.

    An axis is another field of the dataclass, or a name under which rows are numbered. Where the field is a mapping
    whose keys are numbers, the keys are the axis. Without axes the field is a mapping whose keys name other fields:
    each array lies over the axes of the field that its key names.
    """
    return {"over": axes}


def plain(value: Any, strict: bool = True, full: bool = True) -> Any:
    """Return `value` in JSON's own types: scalars and arrays of numpy and torch become numbers and lists, paths text.

    A dataclass becomes a mapping of its fields; fields in bulk are in it only if `full` asks for them.

    Infinity becomes the text "infinity" or "-infinity" and NaN null; unless `strict` both stay floats. In a path that
    is no UTF-8, the bytes that are no letters become \\u and four digits.
    """
    if isinstance(value, Mapping):
        return {str(key): plain(item, strict, full) for key, item in value.items()}
    if is_dataclass(value):
        found: dict[str, Any] = {}
        for f in fields(value):
            item = getattr(value, f.name)
            if (full or "bulk" not in f.metadata) and not (item is None and "optional" in f.metadata):
                item = plain(item, strict, full)
                found |= item if "part" in f.metadata else {f.name: item}
        return found
    if hasattr(value, "tolist"):
        return plain(value.tolist(), strict)
    if isinstance(value, list | tuple):
        return [plain(item, strict, full) for item in value]
    if strict and isinstance(value, float) and not math.isfinite(value):
        return None if math.isnan(value) else "infinity" if value > 0 else "-infinity"
    if value is None or isinstance(value, bool | int | float):
        return value
    return str(value).encode("utf-8", "backslashreplace").decode()


def tables_of(answer: Any, name: str) -> dict[str, Rows]:
    """Return the tables of an answer, a dataclass or a mapping, by name; each case is a row.

    The table `name` has one row, with all single figures. Each list of records makes a table of its own; a table inside
    a record repeats the record's first figure in every row. Arrays over the same axes (`over`) make one table, in which
    arrays over fewer of these axes are repeated. Names within names are joined by a point; places in a list are
    numbers.
    """
    found: dict[str, Rows] = {name: [{}]}
    _add(answer, name, "", found)
    return {key: rows for key, rows in found.items() if any(rows)}


def _add(value: Any, name: str, prefix: str, found: dict[str, Rows]) -> None:
    told: Mapping[str, Any] = {} if isinstance(value, Mapping) else {f.name: f.metadata for f in fields(value)}
    whole = value if isinstance(value, Mapping) else {key: getattr(value, key) for key in told}
    axes = {axis for about in told.values() for axis in about.get("over", ())}
    for key, item in whole.items():
        about, table = told.get(key, {}), f"{name}.{prefix}{key}"
        if "bulk" in about or "optional" in about and item is None:
            continue
        if records := _records(item, about.get("over", ())):
            found[table] = []
            for marks, record in records:
                inside = tables_of(record, table)
                own = marks | inside.pop(table, [{}])[0]
                found[table].append(own)
                first = dict(list(own.items())[:1])
                for other, rows in inside.items():
                    found.setdefault(other, []).extend(first | row for row in rows)
        elif isinstance(item, Mapping) or is_dataclass(item):
            _add(item, name, prefix if "part" in about else f"{prefix}{key}.", found)
        elif key not in axes and "over" not in about:
            found[name][0] |= _flat(f"{prefix}{key}", item)
    if axes:
        found |= {f"{name}.{prefix}{key}": rows for key, rows in _over_axes(value).items()}


def _records(item: Any, axes: tuple[str, ...]) -> list[tuple[dict[str, Any], Any]]:
    """Return the records in a list, in lists of a list, or in a mapping whose keys are an axis.

    Each comes with the cells that say where it stood: the number of its list, or its key.
    """
    marked: list[tuple[dict[str, Any], Any]] = []
    if isinstance(item, Mapping):
        marked = [({axes[0]: key}, value) for key, value in item.items()] if axes else []
    elif isinstance(item, list | tuple) and item and all(isinstance(part, list) for part in item):
        marked = [({"number": k}, value) for k, part in enumerate(item) for value in part]
    elif isinstance(item, list | tuple):
        marked = [({}, value) for value in item]
    return marked if all(isinstance(value, Mapping) or is_dataclass(value) for _, value in marked) else []


def _flat(name: str, value: Any) -> dict[str, Any]:
    """Return the single figures inside a value, under names that begin with its own; a list of texts is one figure."""
    value = plain(value, full=False)
    if isinstance(value, list) and value and all(isinstance(v, str) for v in value):
        return {name: " | ".join(value)}
    if not isinstance(value, list | dict):
        return {name: value}
    found: dict[str, Any] = {}
    for key, item in value.items() if isinstance(value, dict) else enumerate(value):
        found |= _flat(f"{name}.{key}" if name else str(key), item)
    return found


def _over_axes(value: Any) -> dict[str, Rows]:
    """Return the tables of a dataclass's arrays over axes."""
    import numpy as np  # no command's help needs it

    own = {f.name: f.metadata["over"] for f in fields(value) if "over" in f.metadata}
    columns, keys = dict[str, tuple[tuple[str, ...], Any]](), dict[str, Any]()
    for name, axes in own.items():
        if _records(item := getattr(value, name), axes):
            continue
        each: Mapping[str, Any] = item if isinstance(item, Mapping) else {"": item}
        if axes and all(isinstance(key, float) for key in each):
            each, keys[axes[0]] = {"": list(item.values())}, list(item)
        columns |= {f"{name}.{k}" if k else name: (axes or own[k], np.asarray(v)) for k, v in each.items()}
    found: dict[str, Rows] = {}
    every = dict.fromkeys(axes for axes, _ in columns.values())
    for axes in [axes for axes in every if not any(set(axes) < set(others) for others in every)]:
        inside = {k: (a, v) for k, (a, v) in columns.items() if set(a) <= set(axes)}
        sides = {axis: max(v.shape[a.index(axis)] for a, v in inside.values() if axis in a) for axis in axes}
        marks = {
            axis: ((axis,), np.asarray(keys.get(axis, getattr(value, axis, range(side)))))
            for axis, side in sides.items()
        }
        cells = {k: _spread(a, v, sides).ravel().tolist() for k, (a, v) in (marks | inside).items()}
        rows = [dict(zip(cells, plain(row), strict=True)) for row in zip(*cells.values(), strict=True)]
        found["-".join(without_unit(axis) for axis in axes)] = rows
    return found


def _spread(axes: tuple[str, ...], values: Any, sides: Mapping[str, int]) -> Any:
    """Return an array repeated over all `sides`, NaN where it ends before them."""
    import numpy as np

    missing = [(0, sides[axis] - count) for axis, count in zip(axes, values.shape, strict=True)]
    if any(more for _, more in missing):
        values = np.pad(values, missing, constant_values=np.nan)
    shape = [sides[axis] if axis in axes else 1 for axis in sides]
    return np.broadcast_to(values.reshape(shape), tuple(sides.values()))


def some_of(items: Sequence[T], most: int) -> list[T]:
    """Return at most so many of some items (2 or more), evenly spread, with both ends among them."""
    steps = min(most, len(items)) - 1
    return [items[round(k * (len(items) - 1) / steps)] for k in range(steps + 1)] if steps > 0 else list(items)


def write_tables(folder: Path, answer: Any, name: str) -> None:
    """Write the tables of an answer to a folder, which is made, as CSV with all digits."""
    folder.mkdir(parents=True, exist_ok=True)
    for table, rows in tables_of(answer, name).items():
        atomic_write_text(folder / f"{table.replace(' ', '-')}.csv", csv_text(rows))


def csv_text(rows: Rows) -> str:
    """Return rows as CSV with a header; a cell that a row lacks, or that is None, is empty."""
    stream = io.StringIO()
    writer = csv.DictWriter(stream, list(dict.fromkeys(key for row in rows for key in row)), lineterminator="\n")
    writer.writeheader()
    writer.writerows({key: plain_cell(value) for key, value in row.items()} for row in rows)
    return stream.getvalue()


def plain_cell(value: Any) -> Any:
    """Return a cell whose text is one line and no formula of a spreadsheet, for names come from strangers' files.

    Source: OWASP, CSV Injection.
    """
    if not isinstance(value, str):
        return value
    text = printable(value.translate(dict.fromkeys(map(ord, "\t\r\n"), " ")))
    return f"'{text}" if text.lstrip().startswith(("=", "+", "-", "@")) and text != "-infinity" else text
