"""Deep OpenEXR files: the samples of each pixel as layers, read chunk by chunk.

The OpenEXR library gives deep pixels as one array for each pixel and channel: a file of full HD takes gigabytes, and
nothing tells how many samples there are before they are all in memory. Here the numbers of samples are read first, and
then never more than a chunk of samples at a time. The layout is that of "OpenEXR File Layout" (openexr.com): a chunk
has the place of its block, the sizes of its parts, the running sums of the samples of each row, and the samples, row by
row and channel by channel. Compressed bytes are differences to the byte before, with the even bytes of the block first.
"""

import re
import struct
import zlib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import OpenEXR
from numpy.typing import NDArray

from neurolens.base.errors import InputError, warn
from neurolens.base.files import read_bytes
from neurolens.cameras.contract import FloatArray
from neurolens.pictures.render.pictures import COLOURS, PIXEL_TYPES, check_size, whole_file

OPAQUE = 0.5  # opacity from which a sample hides what is behind it
_MOST_LAYERS = 8
# the most pixels: a side, of a file, of all its layers
_LARGEST, _MOST_PIXELS, _MOST_IN_LAYERS = 16384, 1 << 25, 1 << 26
_MOST_BYTES = 1 << 30  # the most bytes of a file
_MOST_SAMPLES, _MOST_IN_CHUNK = 1 << 27, 1 << 26  # the most samples of a file; the most bytes of a chunk's samples
_SEVERAL_PARTS = 0x10  # a flag in byte 5
_CHANNEL = re.compile(rb"([^\0]+)\0(.).{15}", re.DOTALL)  # name and type of a channel in a list of channels
Block = tuple[int, int, int, int]  # left, top, width, height


def deep_layers(path: Path, header: Mapping[str, Any]) -> list[tuple[FloatArray, FloatArray]]:
    """Read the opaque samples of a file's first part as layers of colours and depths.

    The first layer has the nearest sample of each pixel, the second the next one, and so on.

    Raises:
        InputError: the file is damaged, has no colours or no depth, has another compression, or too many samples.
    """
    first, last = header["dataWindow"]
    width, height = size = [int(b) - int(a) + 1 for a, b in zip(first, last, strict=True)]
    check_size(path, "dataWindow", str(path), size, _LARGEST, _MOST_PIXELS)
    data = read_bytes(path, _MOST_BYTES, "a deep OpenEXR file")
    layers = list[tuple[FloatArray, FloatArray]]()
    with whole_file(path, "file", path):
        channels, start = _channels(data)
        if not channels.keys() >= {*COLOURS, "Z"}:
            raise InputError(path, "channels", f"({', '.join(channels)[:200]})", "R, G, B and Z")
        for pixel, values in _rows(path, data, header, channels, start, (width, height)):
            alpha, z = values.get("A", np.ones_like(values["Z"])), values["Z"]
            kept = np.flatnonzero((alpha >= OPAQUE) & ~np.isnan(z) & ~np.isneginf(z))
            kept = kept[np.lexsort((z[kept], pixel[kept]))]
            starts = np.flatnonzero(np.diff(pixel[kept], prepend=-1))
            rank = np.arange(len(kept)) - np.repeat(starts, np.diff(starts, append=len(kept)))
            for k in range(min(int(rank.max(initial=0)) + 1, _MOST_LAYERS)):
                if k == len(layers):
                    if (k + 1) * width * height > _MOST_IN_LAYERS:
                        expected = f"at most {_MOST_IN_LAYERS} pixels in all layers"
                        raise InputError(path, "layers", f"({width} x {height} pixels in {k + 1} layers)", expected)
                    nothing = np.full(width * height, -np.inf if k else np.inf, np.float32)
                    layers.append((np.zeros((width * height, 3), np.float32), nothing))
                rows = kept[rank == k]
                layers[k][0][pixel[rows]] = np.stack([values[c][rows] for c in COLOURS], axis=1) / alpha[rows, None]
                layers[k][1][pixel[rows]] = z[rows]
    return [(rgb.reshape(height, width, 3), metres.reshape(height, width)) for rgb, metres in layers]


def _channels(data: bytes) -> tuple[dict[str, np.dtype[Any]], int]:
    """Read the channels of the first part, with their types, and where the places of its chunks begin."""
    found, at, parts = dict[str, np.dtype[Any]](), 8, 0
    while True:
        while data[at]:  # an attribute: its name, its type, its length, its value
            name, end = data[at : at + 9], data.index(0, data.index(0, at) + 1) + 1
            at = end + 4 + struct.unpack_from("<I", data, end)[0]
            if name == b"channels\0" and not found:
                listed = _CHANNEL.findall(data[end + 4 : at])
                found = {title.decode(): np.dtype(PIXEL_TYPES[kind[0]]) for title, kind in listed}
        at, parts = at + 1, parts + 1
        if not data[5] & _SEVERAL_PARTS:
            return found, at
        if not data[at]:
            if parts > 1:
                warn(f"of {parts} parts of a deep file the first alone is read")
            return found, at + 1


def _rows(
    path: Path,
    data: bytes,
    header: Mapping[str, Any],
    channels: Mapping[str, np.dtype[Any]],
    start: int,
    size: tuple[int, int],
) -> Iterator[tuple[NDArray[np.int64], dict[str, FloatArray]]]:
    """Yield the pixels and the values of all samples, one row of a chunk at a time."""
    method, each = header["compression"], sum(kind.itemsize for kind in channels.values())
    if method not in (OpenEXR.NO_COMPRESSION, OpenEXR.RLE_COMPRESSION, OpenEXR.ZIPS_COMPRESSION):
        raise InputError(path, "compression", f"({method})", "none, RLE or ZIPS, which deep files have")
    chunks, samples, seen = [], 0, np.zeros(size[::-1], bool)
    for place in np.frombuffer(data, "<u8", header["chunkCount"], start).tolist():
        block, at = _block(data, place + 4 * bool(data[5] & _SEVERAL_PARTS), header, size)
        table, packed, unpacked = struct.unpack_from("<3Q", data, at)
        here = np.s_[block[1] : block[1] + block[3], block[0] : block[0] + block[2]]
        if unpacked % each or at + 24 + table + packed > len(data) or seen[here].any():
            raise ValueError(f"a chunk of {table} and {packed} bytes at {place}")
        samples, seen[here] = samples + unpacked // each, True
        if samples > _MOST_SAMPLES or unpacked > _MOST_IN_CHUNK:
            expected = f"at most {_MOST_SAMPLES} in all, and {_MOST_IN_CHUNK} bytes in a chunk"
            raise InputError(path, "samples", f"({samples} or more, {unpacked} bytes in a chunk)", expected)
        chunks.append((block, at + 24, table, packed, unpacked))
    if not seen.all():
        raise ValueError(f"{int((~seen).sum())} pixels are in no chunk")
    for (left, top, wide, high), at, table, packed, unpacked in chunks:
        # At the border, too, the library writes the table of a tile as long as that of any other.
        full = header["tiles"].xSize * header["tiles"].ySize if "tiles" in header else wide * high
        listed = _unpacked(data[at : at + table], method, 4 * wide * high, 4 * full)
        sums = np.frombuffer(listed, "<i4", wide * high).reshape(high, wide).astype(np.int64)
        counts = np.diff(sums, axis=1, prepend=0)
        if counts.min() < 0 or each * int(sums[:, -1].sum()) != unpacked:
            raise ValueError(f"the numbers of samples at {at}")
        body, at = _unpacked(data[at + table : at + table + packed], method, unpacked), 0
        for y in range(high):
            pixel = np.repeat((top + y) * size[0] + left + np.arange(wide), counts[y])
            values = dict[str, FloatArray]()
            for name, kind in channels.items():
                if name in (*COLOURS, "Z", "A"):
                    values[name] = np.frombuffer(body, kind, len(pixel), at).astype(np.float32)
                at += kind.itemsize * len(pixel)
            yield pixel, values


def _block(data: bytes, at: int, header: Mapping[str, Any], size: tuple[int, int]) -> tuple[Block, int]:
    """Return the block of the picture that a chunk has, and where the sizes of its parts stand."""
    if header["type"] == OpenEXR.deepscanline:
        block, at = (0, struct.unpack_from("<i", data, at)[0] - int(header["dataWindow"][0][1]), size[0], 1), at + 4
    else:
        tile, (x, y, *level) = header["tiles"], struct.unpack_from("<4i", data, at)
        left, top, at = x * tile.xSize, y * tile.ySize, at + 16
        block = left, top, min(tile.xSize, size[0] - left), min(tile.ySize, size[1] - top)
        if any(level) or tile.xSize * tile.ySize > _MOST_PIXELS:
            raise ValueError("tiles of several sizes, or too large ones")
    if min(block[:2]) < 0 or min(block[2:]) < 1 or block[1] >= size[1]:
        raise ValueError(f"a chunk at {block[:2]}")
    return block, at


def _unpacked(data: bytes, method: Any, *sizes: int) -> bytes:
    """Unpack a part of a chunk to one of these sizes; it is stored as it is where that is shorter."""
    if method == OpenEXR.NO_COMPRESSION or len(data) == max(sizes):
        found = data
    else:
        coded = (_inflated if method == OpenEXR.ZIPS_COMPRESSION else _repeated)(data, max(sizes))
        steps = np.frombuffer(coded, np.uint8).copy()
        steps[1:] -= 128
        halves, mixed = np.split(np.cumsum(steps, dtype=np.uint8), [(len(steps) + 1) // 2]), np.empty_like(steps)
        mixed[0::2], mixed[1::2] = halves
        found = mixed.tobytes()
    if len(found) not in sizes:
        raise ValueError(f"{len(found)} bytes in place of {sizes[0]}")
    return found


def _inflated(data: bytes, most: int) -> bytes:
    reader = zlib.decompressobj()
    found = reader.decompress(data, most + 1)
    if not reader.eof:  # the checksum stands at the end
        raise ValueError("compressed data without an end")
    return found


def _repeated(data: bytes, most: int) -> bytes:
    """Unpack runs: after n < 0 come -n bytes as they are, after any other n one byte that stands n + 1 times."""
    found, at = bytearray(), 0
    while at < len(data) and len(found) <= most:
        count = data[at] - 256 if data[at] > 127 else data[at]
        found += data[at + 1 : at + 1 - count] if count < 0 else data[at + 1 : at + 2] * (count + 1)
        at += 1 - count if count < 0 else 2
    return bytes(found)
