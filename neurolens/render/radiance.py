"""Pictures of Radiance (.hdr): three mantissas and a shared exponent a pixel, RGBE.

A text header, an empty line, a line with the size, then rows of pixels, each row in one of two forms (Greg Ward,
"Real Pixels", Graphics Gems II, 1991; the Radiance reference manual, "Picture file format"):

old     4 bytes a pixel; a pixel 1, 1, 1, n repeats the one before it n times, or n * 256^k times where k such pixels
        stand before it
new     2, 2, width in two bytes, then the row of each of the four bytes by itself, as runs: n > 128 repeats the next
        byte n - 128 times, any other n is followed by n bytes

A mantissa m with the exponent e is m * 2^(e - 136), as Blender, OpenImageIO and OpenCV read it; e = 0 is black.
"""

from __future__ import annotations

import re
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from neurolens.cameras.contract import FloatArray

Bytes = NDArray[np.uint8]

_MAGIC = (b"#?RADIANCE", b"#?RGBE")
_FORMAT = "32-bit_rle_rgbe"
_SIZE = re.compile(rb"([-+])Y (\d{1,9}) ([-+])X (\d{1,9})")
_LONGEST_LINE, _MOST_LINES = 4096, 1000  # of the header
_NEW = range(8, 1 << 15)  # widths of rows in the new form
_REPEAT = b"\1\1\1"


def read_radiance(data: bytes, check: Callable[[int, int], None]) -> tuple[FloatArray, list[str]]:
    """Linear RGB [H, W, 3] of a Radiance picture, and what its header says that was not applied to it.

    Args:
        data: the file. check: refuses a width and height, before memory is taken.

    Raises:
        ValueError: no such picture, one in XYZE, one whose columns come first, or a damaged one.
    """
    (up, right), (width, height), place, ignored = _header(data)
    check(width, height)
    picture = np.empty((height, width, 3), np.float32)
    for row in range(height):
        line, place = _row(data, place, width)
        exponent = line[:, 3:].astype(np.int32)
        picture[row] = np.where(exponent > 0, np.ldexp(line[:, :3].astype(np.float32), exponent - 136), 0)
    return np.ascontiguousarray(picture[:: -1 if up == b"+" else 1, :: -1 if right == b"-" else 1]), ignored


def _header(data: bytes) -> tuple[tuple[bytes, bytes], tuple[int, int], int, list[str]]:
    """Signs of the axes y and x, width and height, the place of the first row, and settings that are not applied."""
    if not data.startswith(_MAGIC):
        raise ValueError("it does not begin with #?RADIANCE")
    place = 0
    ignored: list[str] = []
    for _ in range(_MOST_LINES):
        end = data.find(b"\n", place, place + _LONGEST_LINE)
        if end < 0:
            break
        line, place = data[place:end].strip(), end + 1
        if found := _SIZE.fullmatch(line):
            size = int(found[4]), int(found[2])
            if min(size) < 1:
                break
            return (found[1], found[3]), size, place, ignored
        name, _, value = line.decode("latin-1").partition("=")
        if name == "FORMAT" and value.strip() != _FORMAT:
            raise ValueError(f"its format is {value.strip()[:40]!r}, not {_FORMAT}")
        if name in ("EXPOSURE", "COLORCORR", "PRIMARIES"):
            ignored.append(f"{name}={value.strip()[:80]}")
    raise ValueError("its header has no line with its size, such as -Y 512 +X 1024")


def _row(data: bytes, place: int, width: int) -> tuple[Bytes, int]:
    """A row's bytes [width, 4], and the place of the next row."""
    start = data[place : place + 4]
    if width in _NEW and start[:2] == b"\2\2" and start[2:3] < b"\x80":
        if int.from_bytes(start[2:], "big") != width:
            raise ValueError("one of its rows has another width")
        return _new_row(data, place + 4, width)
    whole = np.frombuffer(data[place : place + 4 * width], np.uint8)
    if whole.size == 4 * width and not (whole.reshape(width, 4)[:, :3] == 1).all(axis=1).any():
        return whole.reshape(width, 4), place + 4 * width
    return _old_row(data, place, width)


def _new_row(data: bytes, place: int, width: int) -> tuple[Bytes, int]:
    planes = bytearray()
    for end in range(width, 5 * width, width):
        while len(planes) < end:
            count, value = data[place : place + 1], data[place + 1 : place + 2]
            if not value or count == b"\0":
                raise ValueError("it is cut short or damaged")
            length = count[0]
            if length > 128:
                planes += value * (length - 128)
                place += 2
            else:
                planes += data[place + 1 : place + 1 + length]
                place += 1 + length
        if len(planes) > end:
            raise ValueError("one of its runs is longer than its row")
    return np.frombuffer(planes, np.uint8).reshape(4, width).T, place


def _old_row(data: bytes, place: int, width: int) -> tuple[Bytes, int]:
    pixels, shift = bytearray(), 0
    while len(pixels) < 4 * width:
        pixel = data[place : place + 4]
        if len(pixel) < 4:
            raise ValueError("it is cut short")
        place += 4
        if pixel[:3] != _REPEAT:
            pixels += pixel
            shift = 0
            continue
        count = pixel[3] << shift
        if not pixels or shift > 24 or 4 * count > 4 * width - len(pixels):
            raise ValueError("one of its runs is longer than its row, or repeats nothing")
        pixels += pixels[-4:] * count
        shift += 8
    return np.frombuffer(pixels, np.uint8).reshape(width, 4), place
