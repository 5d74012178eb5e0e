"""Damage to files, seeded: texts, bytes, messages of Protocol Buffers, archives, headers of OpenEXR, chunks of PNG.

Every function takes the random numbers and the bytes of a good file, and returns those of a bad one. Formats that hold
lengths or checksums are taken apart and put together again, so that the damage reaches the code behind these.
"""

from __future__ import annotations

import base64
import io
import random
import re
import struct
import zipfile
import zlib
from contextlib import suppress
from typing import Any

Chance = random.Random

# Names of files that are none, or must not be read or written.
SPECIAL = ("fifo", "/dev/zero", ".", "missing", "", "a\0b", "\\udc00", "x" * 300, "../" * 2000, "../up")
_FLOATS = ("0", "-0.0", "-1", "inf", "-inf", "1e308", "-1e308", "1e-308", "1e-320", "1e15", "1e-15", "1e6", "1e-3", "3")
_NUMBERS = (
    *(*_FLOATS, *_FLOATS, *_FLOATS, "nan"),
    *("1_0", "0x10", "1" * 400, "1" * 5000, "0." + "1" * 20000, "1e999999", "2147483648", "18446744073709551616"),
    *('""', "[]", "{}", "true", "null", "[" * 3000 + "]" * 3000),
)
_SCRIPTS = ("<script>alert(1)</script>", "'\"><img src=x onerror=alert(1)>", "javascript:alert(1)", "=1+1", "@SUM(1)")
WORDS = (*_NUMBERS, *SPECIAL, *_SCRIPTS, *("\x1b[31m", "\u00e9", " " * 20000, "-" * 20000, "(" * 5000, "a/" * 5000))
_NUMBER = re.compile(rb"(?<![A-Za-z0-9_.])[-+]?[0-9]+(?:\.[0-9]+)?(?:e[-+]?[0-9]+)?")
_WORD = re.compile(rb"[A-Za-z_][A-Za-z0-9_.-]{0,60}")
_INTEGERS = (0, 1, -1, 2, 255, 65535, 2**31 - 1, -(2**31), 2**32 - 1, 2**40, 2**63 - 1, -(2**63), 2**64 - 1)
_REALS = (0.0, -1.0, 1e30, 1e-40, float("inf"), float("-inf"), float("nan"))


def damage(chance: Chance, name: str, data: bytes) -> bytes:
    """The content of a file, damaged as suits the format that its name and its first bytes show."""
    by_format = {b"\x76\x2f\x31\x01": damage_exr, b"\x89PNG": damage_png, b"PK\x03\x04": damage_archive}
    if chance.random() < 0.8:
        if data[:4] in by_format:
            return by_format[data[:4]](chance, data)
        if name.endswith(".onnx"):
            return damage_message(chance, data)
    text = b"\0" not in data or chance.random() < 0.2
    return (damage_text if text else damage_bytes)(chance, data)


def spoil(chance: Chance, data: bytes, checked: bool) -> bytes:
    """What a disk or a broken transfer leaves: a file that is cut, or a good one with bytes zeroed or a bit turned.

    Only what checksums cover is changed: pixels of OpenEXR that are deflated, chunks of PNG, members of archives; of
    files that are not `checked` nothing.
    """
    start = len(data)
    if data[:4] in (b"\x89PNG", b"PK\x03\x04"):
        start = 0
    elif data[:4] == b"\x76\x2f\x31\x01":
        start = 8
        while True:
            start = _attributes(data, start)[1]
            if not data[5] & 0x10 or not data[start]:  # one part, or no more parts
                break
    if not checked or start == len(data) or chance.random() < 0.4:
        return data[: chance.randrange(len(data))]
    at, span = chance.randrange(start, len(data)), chance.choice((1, 4, 40, 400, 4000))
    if chance.random() < 0.3:
        return data[:at] + bytes([data[at] ^ 1 << chance.randrange(8)]) + data[at + 1 :]
    return data[:at] + bytes(len(data[at : at + span])) + data[at + span :]


def damage_text(chance: Chance, data: bytes) -> bytes:
    """A text with one to three mistakes: numbers, words, lines, bytes."""
    for _ in range(chance.choice((1, 1, 1, 2, 3))):
        kind = chance.choice(("number", "number", "number", "number", "word", "other", "line", "bytes"))
        pattern = _NUMBER if kind == "number" else _WORD
        if kind in ("number", "word", "other") and (m := _somewhere(chance, pattern, data)):
            new = chance.choice(_NUMBERS if kind == "number" else WORDS).encode("utf-8", "surrogatepass")
            other = _somewhere(chance, pattern, data) if kind == "other" else None
            data = data[: m.start()] + (other[0] if other else new) + data[m.end() :]
        elif kind == "line":
            lines = data.splitlines(keepends=True) or [b""]
            k = chance.randrange(len(lines))
            many = max(2, min(1000, 10**7 // (1 + len(lines[k]))))  # JSON may be one long line
            lines[k : k + 1] = chance.choice(([], [lines[k]] * 2, [chance.choice(lines)], [lines[k]] * many))
            data = b"".join(lines)
        else:
            data = damage_bytes(chance, data)
    return data


def _somewhere(chance: Chance, pattern: re.Pattern[bytes], data: bytes) -> re.Match[bytes] | None:
    """What a pattern finds first from a place on: cheaper in a large file than a choice among all it finds."""
    return pattern.search(data, chance.randrange(len(data) + 1)) or pattern.search(data)


def damage_bytes(chance: Chance, data: bytes) -> bytes:
    """Bytes with one to three places changed, cut out, put in, repeated, or overwritten by a number that lies."""
    for _ in range(chance.choice((1, 1, 2, 3))):
        at = chance.randrange(len(data) + 1)
        if chance.random() < 0.4:
            lie = _number(chance)
            data = data[:at] + lie + data[at + len(lie) :]
            continue
        span = chance.choice((1, 1, 4, 4, 30))
        new = chance.choice(
            (b"", b"\0" * span, b"\xff" * span, b"\xed\xa0\x80", chance.randbytes(span), data[:at][-90:])
        )
        data = data[:at] + new + data[at + chance.choice((0, span, span, 10 * span)) :]
    return data[: chance.randrange(len(data) + 1)] if chance.random() < 0.1 else data


def _number(chance: Chance) -> bytes:
    """An extreme number of 1 to 8 bytes, as a length, a count, an index or a value of a binary file may be."""
    order = chance.choice("<<>")
    if chance.random() < 0.3:
        return struct.pack(order + chance.choice(("f", "d")), chance.choice(_REALS))
    size = chance.choice((1, 2, 4, 4, 4, 8))
    return (chance.choice(_INTEGERS) % 256**size).to_bytes(size, "little" if order == "<" else "big")


def damage_message(chance: Chance, data: bytes, depth: int = 0) -> bytes:
    """A message of Protocol Buffers with one field, at any depth, left out, repeated, emptied or changed.

    Coefficients, which are deflated JSON in base64, are damaged as JSON: checksums would refuse any other change.
    """
    from neurolens.graph.protobuf import message, walk

    with suppress(ValueError, zlib.error):
        text = zlib.decompress(base64.b64decode(data, validate=True))
        return base64.b64encode(zlib.compress(damage_text(chance, text)))

    try:
        fields = [(n, w, v if isinstance(v, int) else bytes(v)) for n, w, v in walk(memoryview(data))]
    except ValueError:
        fields = []
    if not fields:
        return (damage_text if data.isascii() else damage_bytes)(chance, data)
    k = chance.randrange(len(fields))
    long = [k for k, field in enumerate(fields) if not isinstance(field[2], int) and len(field[2]) > 99]
    if depth == 0 and long and chance.random() < 0.9:  # the card or the coefficients, not the version
        metadata = [k for k in long if fields[k][0] == 14]
        k = chance.choice(metadata if metadata and chance.random() < 0.9 else long)
    number, wire, value = fields[k]
    if isinstance(value, bytes) and wire == 2 and chance.random() < 0.85:
        new: list[tuple[int, int, Any]] = [(number, wire, damage_message(chance, value, depth + 1))]
    else:
        hostile: tuple[Any, ...] = (0, 1, 2**31, 2**62, 2**64 - 1)
        if isinstance(value, bytes):
            hostile = (b"", b"\0" * len(value), value * 2)
        changed: Any = chance.choice(hostile) if wire in (0, 2) else value
        new = chance.choice(([], [fields[k]] * 2, [chance.choice(fields)], [(number, wire, changed)]))
    return message(iter([*fields[:k], *new, *fields[k + 1 :]]))


def damage_archive(chance: Chance, data: bytes) -> bytes:
    """A zip file with a damaged member of right checksum, an entry more or less, or a directory that lies."""
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    kind = chance.choice(("member", "member", "member", "member", "name", "lost", "directory"))
    if kind == "directory":
        at = data.rfind(b"PK\x01\x02") if chance.random() < 0.5 else data.find(b"PK\x01\x02")
        return data[:at] + damage_bytes(chance, data[at:])
    name = chance.choice(sorted(members))
    if kind == "member":
        members[name] = damage(chance, name, members[name])
    elif kind == "lost":
        del members[name]
    else:
        members[chance.choice(("../up", "/up", "a/../../up", "C:\\up", "", "x" * 300, name + "/", "\x1b[31m"))] = b"x"
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", chance.choice((zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED))) as archive:
        for name, content in members.items():
            archive.writestr(name or "empty", content)
    return out.getvalue()


def damage_exr(chance: Chance, data: bytes) -> bytes:
    """An OpenEXR file of one part with an attribute whose value, type or length is changed, or that is lost or doubled.

    The offsets of the pixels stay right, so that a header that still reads is followed by the picture.
    """
    with suppress(ValueError, IndexError, struct.error):
        attributes, end = _attributes(data)
        changed = list(attributes)
        k = chance.randrange(len(changed))
        ours = [k for k, (name, *_) in enumerate(changed) if name == b"neurolens"]
        if ours and chance.random() < 0.5:
            (k,) = ours
        name, kind, value = changed[k]
        lie = None
        how = chance.choice(("value", "value", "value", "value", "type", "lost", "twice", "length", "name"))
        if how == "value":
            value = (damage_text if kind == b"string" else damage_bytes)(chance, value)
        elif how == "type":
            kind = chance.choice(attributes)[1]
        elif how == "length":
            lie = chance.choice(_INTEGERS) % 2**32
        elif how == "name":
            name = chance.choice((b"x" * 300, b"\xff", b"neurolens", b"dataWindow", b"chunkCount", b"tiles"))
        new = [(name, kind, value)]
        changed[k : k + 1] = {"lost": [], "twice": [*new, *new]}.get(how, new)
        header = data[:8] + b"".join(_attribute(*a, lie if a in new else None) for a in changed) + b"\0"
        table = struct.unpack_from("<Q", data, end)[0] - end
        offsets = struct.unpack_from(f"<{table // 8}Q", data, end)
        moved = struct.pack(f"<{table // 8}Q", *(o + len(header) - end for o in offsets))
        return header + moved + data[end + table :]
    return damage_bytes(chance, data)


def _attributes(data: bytes, at: int = 8) -> tuple[list[tuple[bytes, bytes, bytes]], int]:
    """Names, types and values of an OpenEXR header that begins at a place, and where it ends."""
    found = []
    while data[at]:
        name, _, rest = data[at : at + 600].partition(b"\0")
        kind = rest.partition(b"\0")[0]
        at += len(name) + len(kind) + 2
        size = struct.unpack_from("<I", data, at)[0]
        if at + 4 + size >= len(data):
            raise ValueError("a header beyond the end")
        found.append((name, kind, data[at + 4 : at + 4 + size]))
        at += 4 + size
    return found, at + 1


def _attribute(name: bytes, kind: bytes, value: bytes, length: int | None) -> bytes:
    return name + b"\0" + kind + b"\0" + struct.pack("<I", len(value) if length is None else length) + value


def damage_png(chance: Chance, data: bytes) -> bytes:
    """A PNG file with a chunk that is damaged, lost, doubled or new, and checksums that are right."""
    chunks, at = [], 8
    while at + 12 <= len(data):
        size = struct.unpack_from(">I", data, at)[0]
        chunks.append((data[at + 4 : at + 8], data[at + 8 : at + 8 + size]))
        at += 12 + size
    k = chance.randrange(len(chunks))
    kind, value = chunks[k]
    more = chance.choice((b"tRNS", b"PLTE", b"iCCP", b"gAMA", b"acTL", b"fcTL", b"zTXt", b"eXIf"))
    damaged, added = [(kind, damage_bytes(chance, value))], [(more, chance.randbytes(9)), (kind, value)]
    chunks[k : k + 1] = chance.choice((damaged, [], [(kind, value)] * 2, added))
    parts = [struct.pack(">I", len(v)) + name + v + struct.pack(">I", zlib.crc32(name + v)) for name, v in chunks]
    return data[:8] + b"".join(parts)
