"""The film: the film points of pixels, and the sums of every pixel, which grow by tiles and passes and can be kept.

A checkpoint (see `base.files`) holds the sums and the identity of the render: everything that the picture depends on,
as JSON that two renders can compare.
"""

from __future__ import annotations

import hashlib
import json
import mmap
import os
import threading
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, fields, is_dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from neurolens.base.errors import InputError
from neurolens.base.files import CHUNK_BYTES, fingerprint_of, read_arrays, write_arrays
from neurolens.cameras.contract import FloatArray

BATCH = 32768  # paths; with fewer, calling numpy costs more than computing; the state of many more leaves the cache
SAMPLES_A_PASS = 16

# Columns of the sums: linear sRGB; squared luminance of independent samples; depth in m over the samples that hit
# something, and how many those are; samples whose camera ray passed; samples that were not finite and add no light.
RGB, LUMINANCE2, DEPTH, HITS, PASSED, DROPPED, COLUMNS = slice(0, 3), 3, 4, 5, 6, 7, 8
# Of a render in the main process: the sums, and at the end picture and layers, once more in the writer's order.
BYTES_A_PIXEL = 8 * COLUMNS + 100
# Larger deviations from square pixels are taken as mistakes, unless no whole number comes nearer.
_ASPECT_TOLERANCE = 0.02
_NOTHING = "(nothing)"  # stands for a place that one of two identities lacks
_DIGITS = 16
_FORMAT = 4
_MOST_S = 1e10  # of a render, all threads together: 300 years
SPENT = ("seconds", "camera_thread_seconds", "thread_seconds")
_BRIGHTEST = 1e37  # the largest sum of a pixel, which float32 must hold after the white balance, too
_LONGEST = 80  # characters of a value in a message
_AGAIN = "or --restart to begin again"


@dataclass(frozen=True)
class PixelGrid:
    """A picture of width x height pixels on a film of `film_mm`.

    A lens throws its picture upside down and mirrored. The film is turned by 180 degrees on the way to the picture: the
    pixel at the top left is the film point at +x, -y in the lens frame.

    Raises:
        InputError: picture and film differ in shape.
    """

    width: int
    height: int
    film_mm: tuple[float, float]

    def __post_init__(self) -> None:
        for field in ("width", "height"):
            if getattr(self, field) < 1:
                raise InputError("picture", field, getattr(self, field), "an integer above 0")
        film = self.film_mm[0] / self.film_mm[1]
        nearest = round(self.width / film) == self.height or round(self.height * film) == self.width
        if not nearest and abs(self.width / self.height / film - 1) > _ASPECT_TOLERANCE:
            shape = f"{self.film_mm[0]:g} x {self.film_mm[1]:g} mm"
            raise InputError("picture", "width x height", (self.width, self.height), f"the shape of the film, {shape}")

    def film_points(self, pixel: NDArray[np.intp], jitter: FloatArray) -> FloatArray:
        """Return film points [2, N] (mm) of places [2, N] in pixels [N], numbered row by row from the top left."""
        row, column = np.divmod(pixel, self.width)
        points = np.empty((2, len(pixel)), np.float32)
        across, down = (column + jitter[0]) / self.width, (row + jitter[1]) / self.height
        points[0] = (0.5 - across) * self.film_mm[0]
        points[1] = (down - 0.5) * self.film_mm[1]
        return points


def check_memory(width: int, height: int, bytes_a_pixel: int = BYTES_A_PIXEL) -> None:
    """Refuse (InputError) a picture that alone would fill the machine's memory, before memory is taken."""
    try:
        most = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    except (AttributeError, ValueError, OSError):
        return  # not known on this system
    if width * height * bytes_a_pixel > most:
        expected = f"at most {most // bytes_a_pixel} pixels: each takes {bytes_a_pixel} bytes, of {most / 1e9:.3g} GB"
        raise InputError("picture", "width x height", (width, height), expected)


@dataclass(frozen=True)
class Tiling:
    """The cut of a render into tiles of consecutive pixels and passes of consecutive samples.

    The cut depends on the picture alone. What a worker holds at a time depends on a tile, not on the picture.

    Attributes:
        pixels, samples: of the picture. tile: pixels per tile. step: samples per pass; the last pass may have fewer.
        start: where these are the tiles of a part, the number of its first pixel in the whole picture.
    """

    pixels: int
    samples: int
    tile: int
    step: int
    start: int = 0

    @classmethod
    def of(cls, pixels: int, samples: int) -> Tiling:
        """Return tiles of about `BATCH` paths per pass."""
        step = min(samples, SAMPLES_A_PASS)
        return cls(pixels, samples, max(1, BATCH // step), step)

    def around(self, first: int, stop: int) -> Tiling:
        """Return the whole tiles that hold pixels `first` up to `stop`; other batches might round differently."""
        start = first - first % self.tile
        return replace(self, pixels=min(-(-stop // self.tile) * self.tile, self.pixels) - start, start=start)

    @property
    def tiles(self) -> int:
        return -(-self.pixels // self.tile)

    @property
    def passes(self) -> int:
        return -(-self.samples // self.step)

    def pixels_of(self, first: int, stop: int | None = None) -> slice:
        """Return the pixels of a tile, or of the tiles from `first` up to `stop`, counted from `start`."""
        return slice(first * self.tile, min((first + 1 if stop is None else stop) * self.tile, self.pixels))

    def samples_done(self, done: NDArray[np.int64]) -> NDArray[np.int64]:
        """Return the samples of a pixel after some passes."""
        return np.minimum(done * self.step, self.samples)

    def chunks(self) -> Iterator[tuple[int, int]]:
        """Yield parts of the picture as their first tile and the one after their last."""
        tiles = max(1, CHUNK_BYTES // (8 * COLUMNS * self.tile))
        for first in range(0, self.tiles, tiles):
            yield first, min(first + tiles, self.tiles)


class Spill(NamedTuple):
    """The light of companions in one pass of a tile, which may arrive at pixels other than those of its samples.

    Attributes:
        first: the number of the first pixel in the picture. sums: [K, 3] float64, the columns `RGB` of K pixels from
            there.
    """

    first: int
    sums: NDArray[np.float64]


class Film:
    """The sums of the pixels, and which passes are in them; several threads may use one film.

    Attributes:
        sums: [pixels, COLUMNS] float64. done: [tiles] how many passes of each are in the sums.
        seconds: [2] that all workers spent: in the camera, and in all.

    Raises:
        MemoryError: there is not enough memory for the sums.
    """

    def __init__(self, tiling: Tiling) -> None:
        self.tiling = tiling
        size = tiling.pixels * COLUMNS * 8
        try:
            # A shared mapping: forked workers do not use it, but would otherwise keep a second copy of each page.
            self.sums = np.frombuffer(mmap.mmap(-1, size), np.float64).reshape(-1, COLUMNS)
        except (OSError, OverflowError, ValueError):
            raise MemoryError(f"{size} bytes") from None
        self.done = np.zeros(tiling.tiles, np.int64)
        self.seconds = np.zeros(2)
        self._lock = threading.Lock()
        self._early: dict[tuple[int, int], tuple[NDArray[np.float64], Spill | None]] = {}
        self.begin()

    def begin(self) -> None:
        """Prepare to give out the tiles and passes that the sums lack, and to add them in the same order."""
        self._missing, self._order = self._all_missing(), self._all_missing()
        self._next = next(self._order, None)

    def _all_missing(self) -> Iterator[tuple[int, int]]:
        for part in range(self.tiling.passes):
            for tile in range(self.tiling.tiles):
                if self.done[tile] <= part:  # the others were done before a checkpoint
                    yield tile, part

    def take(self) -> tuple[int, int] | None:
        """The next tile and pass to render, all tiles of one pass before the next pass; None where no more is left."""
        with self._lock:
            return next(self._missing, None)

    def add(
        self, tile: int, part: int, sums: NDArray[np.float64], spill: Spill | None, seconds: NDArray[np.float64]
    ) -> None:
        """Add the sums [pixels, COLUMNS] of a pass of a tile, its spill, and the seconds [2] that it took.

        A tile waits here for all tiles before it: sums are always added in the same order, and so round the same.
        """
        with self._lock:
            self.seconds += seconds
            self._early[tile, part] = sums, spill
            while self._next is not None and self._next in self._early:
                self._put(self._next[0], *self._early.pop(self._next))
                self._next = next(self._order, None)

    def _put(self, tile: int, sums: NDArray[np.float64], spill: Spill | None) -> None:
        self.sums[self.tiling.pixels_of(tile)] += sums
        self.done[tile] += 1
        if spill is not None:
            here = spill.first - self.tiling.start
            there = self.sums[max(here, 0) : max(here + len(spill.sums), 0), RGB]
            there += spill.sums[max(-here, 0) :][: len(there)]

    def copy(self, first: int, stop: int) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
        """Return sums [n, COLUMNS] and passes of the tiles from `first` up to `stop`, as they are at one moment."""
        with self._lock:
            return self.sums[self.tiling.pixels_of(first, stop)].copy(), self.done[first:stop].copy()

    @property
    def fraction(self) -> float:
        """The share of the work that is done."""
        return float(self.done.sum()) / (self.tiling.tiles * self.tiling.passes)


def _leaves(tree: Any, place: str = "") -> dict[str, Any]:
    if not isinstance(tree, dict) or not tree:
        return {place: tree}
    found: dict[str, Any] = {}
    for key, value in tree.items():
        found |= _leaves(value, f"{place}.{key}" if place else str(key))
    return found


def difference(there: dict[str, Any], here: dict[str, Any]) -> tuple[str, Any, str] | None:
    """Find the first place where two identities differ, and what each has there, short for a message; None: nowhere."""
    found, wanted = _leaves(there), _leaves(here)
    for place in [*wanted, *found]:
        values = found.get(place, _NOTHING), wanted.get(place, _NOTHING)
        if json.dumps(values[0]) != json.dumps(values[1]):  # as text: NaN equals NaN
            shown = values[0] if len(repr(values[0])) <= _LONGEST else f"({_short(values[0])})"
            return place, shown, _short(values[1])
    return None


def digest(value: Any) -> str:
    """Return the hexadecimal digest of a value made of dataclasses, mappings, sequences, arrays and plain values."""
    return fingerprint_of([_plain(value)])[:_DIGITS]


def _plain(value: Any) -> Any:
    """Return the value for JSON, every part with its type, so that different values never give the same text."""
    if isinstance(value, np.ndarray):
        return [value.dtype.str, value.shape, hashlib.sha256(np.ascontiguousarray(value).data).hexdigest()]
    if isinstance(value, Mapping):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, (tuple, list)):
        return [_plain(item) for item in value]
    if is_dataclass(value):
        return [type(value).__name__, {field.name: _plain(getattr(value, field.name)) for field in fields(value)}]
    return f"{type(value).__name__} {value!r}"


def write_checkpoint(path: Path, film: Film, identity: dict[str, Any], spent: dict[str, float]) -> None:
    """Write the film's present sums and the seconds spent (by the names of `SPENT`); workers may go on meanwhile.

    Raises:
        OSError: it cannot be written; an older checkpoint is still there.
        InputError: an identity that no reader would take.
    """
    tiling, done = film.tiling, list[NDArray[np.int64]]()

    def sums() -> Iterator[NDArray[np.float64]]:
        for first, stop in tiling.chunks():
            part, passes = film.copy(first, stop)
            done.append(passes)
            yield part

    about = {"format": _FORMAT, "samples": tiling.samples, "tile": tiling.tile, "step": tiling.step}
    # in this order: writing the sums fills `done` with the passes of the same moments
    arrays = {"sums": (film.sums, sums()), "done": (film.done, done)}
    write_arrays(path, about | {"render": identity, "spent": spent}, arrays)


def read_checkpoint(path: Path, film: Film, identity: dict[str, Any]) -> dict[str, float]:
    """Resume from a checkpoint: fill an empty film and return the seconds spent.

    More samples than the checkpoint was made for can be added as long as no tile had a shortened last pass: any
    multiple of 16 samples can be raised to any number.

    Raises:
        InputError: the checkpoint is missing, incomplete, or of another render; the error names what differs.
    """
    try:
        with read_arrays(path, ("sums", "done")) as (about, read):
            if about["format"] != _FORMAT:
                raise InputError(path, "format", about["format"], str(_FORMAT))
            if differs := difference(about["render"], identity):
                place, there, here = differs
                raise InputError(path, place, there, f"{here} as asked now")
            _check_tiling(path, about, film.tiling)
            done = read("done", np.empty_like(film.done))
            _check_samples(path, about["samples"], film.tiling, done)
            sums = read("sums", film.sums)
            # No render has larger sums: samples that are not finite are dropped, and emission is bounded.
            for columns, most in (
                (sums[:, RGB], _BRIGHTEST),
                (sums, _BRIGHTEST**2),
            ):  # squares of luminance are largest
                if not (columns.min() >= -most and columns.max() <= most):
                    raise ValueError("impossible sums")
            film.done[:] = done
            film.begin()
            return {name: float(value) for name, value in about["spent"].items()}
    except InputError as error:
        raise InputError(path, error.field, error.value, f"{error.expected}, {_AGAIN}") from None
    except FileNotFoundError:
        raise InputError(path, "file", "(missing)", "a checkpoint of this render") from None
    except ValueError as error:
        raise InputError(path, "file", f"({error})", f"a whole checkpoint of a render, {_AGAIN}") from None


def _short(value: Any) -> str:
    text = "nothing" if value == _NOTHING else repr(value)
    return text if len(text) <= _LONGEST else f"{text[: _LONGEST - 3]}..."


def _check_tiling(path: Path, about: dict[str, Any], tiling: Tiling) -> None:
    """Check that tiles and passes are the same; they depend on the number of samples only below 16."""
    if not isinstance(about["samples"], int) or not 1 <= about["samples"] < 1 << 31:
        raise ValueError(f"{about['samples']} samples")
    spent = about["spent"]
    if set(spent) != set(SPENT) or not all(0 <= float(value) <= _MOST_S for value in spent.values()):
        raise ValueError("impossible times")
    if (about["tile"], about["step"]) != (tiling.tile, tiling.step):
        expected = f"{tiling.samples} as asked now: below {max(tiling.step, about['step'])} samples none can be added"
        raise InputError(path, "samples", about["samples"], f"{expected}; give the same")


def _check_samples(path: Path, samples: int, tiling: Tiling, done: NDArray[np.int64]) -> None:
    """Check that the passes of every tile are among the requested ones."""
    if done.min() < 0 or done.max() > -(-samples // tiling.step):
        raise ValueError("impossible numbers of passes")
    had, counts = np.minimum(done * tiling.step, samples), tiling.samples_done(done)
    if np.array_equal(had, counts):
        return
    most = int(had.max())
    if most > tiling.samples:
        raise InputError(path, "samples", most, f"{tiling.samples} at most, as asked now: ask for more")
    expected = f"a multiple of {tiling.step}, which alone can be raised to {tiling.samples}; give the same"
    raise InputError(path, "samples", samples, expected)
