"""Tiles of a picture, rendered apart and put together: the picture that one run gives, bit for bit.

A tile is a band of whole rows, an OpenEXR file whose data window is the band and whose display window is the picture:
other programs show it in its place. Its metadata say what it was rendered from and with; tiles of other settings do
not go together.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from neurolens.base.errors import InputError
from neurolens.base.files import check_writable
from neurolens.cameras.contract import FloatArray
from neurolens.render.colour import COLOUR_SPACES, SRGB, conversion, converted
from neurolens.render.film import check_memory, difference
from neurolens.render.pictures import read_channels, read_metadata, standard_attributes, write_channels, write_png

_EXPECTED = 'a tile of "neurolens render --tile"'
# What a merged picture's statistics add up; the rest follows from these, or is the same in all tiles.
_COLOURS = ("R", "G", "B")
_BYTES_A_PIXEL = 50  # seven channels, those of the tile that is read, and what the writer packs
_MOST = 1e15  # of each of these
_SUMMED = ("seconds", "paths", "dropped_samples", "thread_seconds", "camera_thread_seconds")


def rows_of(height: int, tile: tuple[int, int]) -> tuple[int, int]:
    """First row of tile I of N, and the one after its last; InputError: more tiles than rows."""
    number, count = tile
    if count > height:
        raise InputError("neurolens render", "--tile", f"{number}/{count}", f"at most {height} tiles, one a row")
    return (number - 1) * height // count, number * height // count


def tile_path(out: Path, tile: tuple[int, int] | None) -> Path:
    """The file of a tile of the picture `out`, OUT.tile-03-of-16.exr; without a tile `out` itself."""
    if tile is None:
        return out
    number, count = tile
    return out.with_name(f"{out.stem}.tile-{number:0{len(str(count))}d}-of-{count}{out.suffix}")


def windows(width: int, height: int, rows: Sequence[int]) -> dict[str, Any]:
    """Header values that place a band of rows in a picture of width x height."""

    def box(first: int, last: int) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
        return np.array([0, first], np.int32), np.array([width - 1, last], np.int32)

    return {"dataWindow": box(rows[0], rows[1] - 1), "displayWindow": box(0, height - 1)}


@dataclass(frozen=True)
class Tile:
    """A tile in a file: tile `number` of `count`, its rows, first and the one after the last, and its metadata."""

    path: Path
    number: int
    count: int
    rows: tuple[int, int]
    metadata: dict[str, Any]

    @property
    def frame(self) -> int | None:
        """Number of its picture in a sequence."""
        frame: int | None = self.metadata["tile"]["frame"]
        return frame

    def settings(self) -> dict[str, Any]:
        """The settings that all tiles of one picture share."""
        metadata, render = self.metadata, self.metadata["render"]
        chosen = {name: render[name] for name in ("width", "height", "samples")}
        stored = {
            "half": metadata["tile"]["half"],
            "colour": metadata["colour"],
            "layers": sorted(metadata.get("layers", ())),
            "sensor": metadata.get("sensor"),
        }
        return {**metadata["tile"]["identity"], **chosen, **stored, "tiles": self.count}

    def channels(self) -> dict[str, FloatArray]:
        """Its channels [rows, width] by name, R, G and B among them; InputError: a file of other rows than it says."""
        found, _ = read_channels(self.path)
        shape = self.rows[1] - self.rows[0], self.metadata["render"]["width"]
        if not found.keys() >= set("RGB") or any(plane.shape != shape for plane in found.values()):
            raise InputError(self.path, "channels", "(other channels or rows than its metadata tell)", _EXPECTED)
        return found


def read_tile(path: Path) -> Tile:
    """A tile from its file, of which the pixels are read later.

    Raises:
        InputError: no OpenEXR file, none of ours, or one that an interrupted run left.
    """
    metadata = read_metadata(path)
    try:
        facts, render = metadata["tile"], metadata["render"]
        numbers = number, count, width, height = facts["number"], facts["of"], render["width"], render["height"]
        if any(type(n) is not int for n in numbers) or not 1 <= number <= count <= height or width < 1:
            raise ValueError(f"tile {number} of {count}")
        tile = Tile(path, number, count, rows_of(height, (number, count)), metadata)
        if tile.settings()["colour"]["space"] not in COLOUR_SPACES:
            raise ValueError("other metadata")
        if not all(0 <= render[name] <= _MOST for name in (*_SUMMED, "passed_fraction")):
            raise ValueError("other statistics")
        complete, done = bool(render["complete"]), float(render["samples_done"])
        _attributes(metadata, tile.frame)  # can be written
    except (KeyError, IndexError, TypeError, ValueError, AttributeError, ArithmeticError) as error:
        why = f"no {error}" if isinstance(error, KeyError) else str(error)
        raise InputError(path, "metadata", f"({why})", _EXPECTED) from None
    if not complete:
        raise InputError(path, "samples", done, f"{render['samples']}: it is not done; its command goes on")
    return tile


def check_together(tiles: Sequence[Tile]) -> None:
    """Raise InputError unless these are all the tiles of one picture, each once; it names what differs or lacks."""
    first = tiles[0]
    for other in tiles[1:]:
        if differs := difference(other.settings(), first.settings()):
            place, there, here = differs
            raise InputError(other.path, place, there, f"{here} as in {first.path}")
    paths: dict[int, Path] = {}
    for tile in tiles:
        if tile.number in paths:
            name = f"{tile.number} of {tile.count}"
            raise InputError(tile.path, "tile", name, f"each tile once: {paths[tile.number]} is that one, too")
        paths[tile.number] = tile.path
    if missing := [number for number in range(1, first.count + 1) if number not in paths]:
        of = "" if first.frame is None else f" of frame {first.frame}"
        shown = ", ".join(map(str, missing[:20])) + (", ..." if len(missing) > 20 else "")
        raise InputError("neurolens render --merge", f"tiles{of}", f"({shown} missing)", f"all {first.count}")


def merged(tiles: Sequence[Tile]) -> tuple[dict[str, NDArray[Any]], dict[str, Any]]:
    """Channels [H, W] as one run stores them, and its metadata, of all tiles of a picture.

    Times are summed over the tiles; the remaining metadata are those of one run.

    Raises:
        InputError: as `check_together`; a picture beyond memory.
    """
    check_together(tiles)
    first, *_ = tiles = sorted(tiles, key=lambda tile: tile.number)
    width, height = first.metadata["render"]["width"], first.metadata["render"]["height"]
    check_memory(width, height, _BYTES_A_PIXEL)
    half = first.metadata["tile"]["half"]
    channels: dict[str, NDArray[Any]] = {}
    for tile in tiles:
        planes = tile.channels()
        if not channels:
            kinds = {name: np.float16 if half and name in _COLOURS else np.float32 for name in planes}
            channels = {name: np.empty((height, width), kind) for name, kind in kinds.items()}
        if planes.keys() != channels.keys():
            raise InputError(tile.path, "channels", sorted(planes), f"{sorted(channels)} as in {first.path}")
        for name, plane in planes.items():
            channels[name][slice(*tile.rows)] = plane
    metadata = {key: value for key, value in first.metadata.items() if key != "tile"}
    metadata["render"] = _statistics([tile.metadata["render"] for tile in tiles])
    return channels, metadata


def _statistics(parts: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Statistics of a picture from those of its tiles."""
    sums = {name: sum(part[name] for part in parts) for name in _SUMMED}
    passed = sum(round(part["passed_fraction"] * part["paths"]) for part in parts)
    return {
        **{key: value for key, value in parts[0].items() if key != "rows"},
        **sums,
        "mpaths_per_s": sums["paths"] / max(sums["seconds"], 1e-12) * 1e-6,
        "passed_fraction": passed / max(sums["paths"], 1),
        "camera_fraction": sums["camera_thread_seconds"] / max(sums["thread_seconds"], 1e-12),
    }


def merge_tiles(paths: Iterable[Path], out: Path, exposure: float = 0.0) -> list[dict[str, Any]]:
    """Check all tiles, then write their picture, or one for each frame: OUT.0001.exr and so on.

    Returns:
        For each picture its file, preview, number of tiles and statistics.

    Raises:
        InputError: as `check_together`; an output that is one of the tiles. OSError: an output that cannot be written.
    """
    frames: dict[int | None, list[Tile]] = {}
    for path in paths:
        tile = read_tile(path)
        frames.setdefault(tile.frame, []).append(tile)
    digits = max(4, *(len(str(frame)) for frame in frames))
    outs = {}
    for frame, tiles in frames.items():
        check_together(tiles)
        number = "" if frame is None else f".{frame:0{digits}d}"
        outs[frame] = out.with_name(f"{out.stem}{number}{out.suffix}")
        for file in (outs[frame], outs[frame].with_suffix(".png")):
            if any(file.exists() and file.samefile(tile.path) for each in frames.values() for tile in each):
                raise InputError(file, "--output", file.name, "another name: it is one of the tiles")
            check_writable(file)
    return [write_picture(tiles, outs[frame], exposure) for frame, tiles in frames.items()]


def write_picture(tiles: Sequence[Tile], out: Path, exposure: float) -> dict[str, Any]:
    """Write the picture of all its tiles as one run writes it, and its preview; returns its file and statistics.

    Raises:
        InputError: as `merged`. OSError: it cannot be written.
    """
    channels, metadata = merged(tiles)
    space, render = COLOUR_SPACES[metadata["colour"]["space"]], metadata["render"]
    rgb = np.stack([channels[name].astype(np.float32) for name in _COLOURS], axis=-1)
    if space is not SRGB:
        rgb = converted(rgb, conversion(space, SRGB)).astype(np.float32)
    write_channels(out, channels, space, metadata, _attributes(metadata, tiles[0].frame))
    write_png(preview := out.with_suffix(".png"), rgb, exposure)
    return {"file": str(out), "preview": str(preview), "tiles": len(tiles), **render}


def _attributes(metadata: Mapping[str, Any], frame: int | None) -> dict[str, Any]:
    render = metadata["render"]
    return standard_attributes(metadata["camera"], render["width"], render["height"], frame)
