"""Messages of Protocol Buffers, read with suspicion: what another reader would take for something else is refused.

Other readers merge messages that stand twice where one belongs, and skip fields of an unexpected wire type. What was
checked here must be what they see. Format: the encoding guide of Protocol Buffers; groups are not known.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

Fields = dict[int, list[Any]]

MAX_FIELDS = 50_000  # of a message: a file of small ones would take a hundred times its size in memory
_VARINT, _DOUBLE, _BYTES, _FLOAT = 0, 1, 2, 5  # wire types


def fields_of(data: memoryview, fixed: frozenset[int] = frozenset()) -> Fields:
    """The fields of one message, by number; values are ints or bytes, in the order of the file.

    Raises ValueError: bytes that are no message, or a field of fixed width (a float) that is not among `fixed`.
    """
    found: Fields = {}
    if isinstance(data, int):
        raise ValueError("a number where a message should be")
    for count, (number, wire, value) in enumerate(walk(data)):
        if count >= MAX_FIELDS:
            raise ValueError(f"more than {MAX_FIELDS} fields in one message")
        if wire in (_DOUBLE, _FLOAT) and number not in fixed:
            raise ValueError(f"field {number}: a number of fixed width")
        found.setdefault(number, []).append(value)
    return found


def one(fields: Fields, number: int) -> Any:
    """The only value of a field. Raises ValueError: none, or several."""
    values = fields.get(number, [])
    if len(values) != 1:
        raise ValueError(f"field {number} stands {len(values)} times, expected once")
    return values[0]


def text(fields: Fields, number: int) -> str:
    """The text of a field, empty where there is none. Raises ValueError: something else than text."""
    return as_text(fields[number][-1]) if number in fields else ""


def as_text(value: Any) -> str:
    """The text that a value is. Raises ValueError: a number, or bytes that are no text."""
    if isinstance(value, int):
        raise ValueError("a number where a text should be")
    return bytes(value).decode("utf-8")


def integers(values: list[Any]) -> list[int]:
    """The integers of a repeated field, packed or one by one."""
    found: list[int] = []
    for chunk in values:
        if isinstance(chunk, int):
            found.append(chunk)
            continue
        at = 0
        while at < len(chunk):
            size, at = _varint(chunk, at)
            found.append(size)
    return found


def walk(data: memoryview) -> Iterator[tuple[int, int, Any]]:
    """Number, wire type and value of every field, in the order of the file; ValueError where it is no message."""
    at, end = 0, len(data)
    while at < end:
        key, at = _varint(data, at)
        number, wire = key >> 3, key & 7
        if number == 0:
            raise ValueError("field number 0")
        if wire == _VARINT:
            value, at = _varint(data, at)
            yield number, wire, value
            continue
        if wire == _BYTES:
            length, at = _varint(data, at)
        elif wire in (_DOUBLE, _FLOAT):
            length = 8 if wire == _DOUBLE else 4
        else:
            raise ValueError(f"wire type {wire}")
        if length > end - at:
            raise ValueError(f"{length} bytes announced where {end - at} are left")
        yield number, wire, data[at : at + length]
        at += length


def message(fields: Iterator[tuple[int, int, Any]]) -> bytes:
    """The bytes of a message of such fields: what `walk` takes apart."""
    return b"".join(_encoded(*field) for field in fields)


def _encoded(number: int, wire: int, value: Any) -> bytes:
    key = _as_varint(number << 3 | wire)
    if wire == _VARINT:
        return key + _as_varint(value)
    return key + (_as_varint(len(value)) if wire == _BYTES else b"") + bytes(value)


def _as_varint(value: int) -> bytes:
    found = bytearray()
    while value > 0x7F:
        found.append(value & 0x7F | 0x80)
        value >>= 7
    found.append(value)
    return bytes(found)


def _varint(data: memoryview, at: int) -> tuple[int, int]:
    value = shift = 0
    while True:
        if at >= len(data) or shift > 63:
            raise ValueError("a number without end")
        byte = data[at]
        value |= (byte & 0x7F) << shift
        at, shift = at + 1, shift + 7
        if byte < 0x80:
            return value, at
