"""The film: the film points of pixels, and the sums of every pixel, which grow by tiles and passes."""

from __future__ import annotations

import mmap
import os
import threading
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from neurolens.base.errors import InputError
from neurolens.base.kept import CHUNK_BYTES
from neurolens.cameras.contract import FloatArray

BATCH = 32768  # paths; fewer, and calling numpy costs more than computing; many more, and their state leaves the cache
SAMPLES_A_PASS = 16

# Columns of the sums: linear sRGB; squared luminance of independent samples; depth in m over the samples that hit
# something, and how many those are; samples whose camera ray passed; samples that were not finite and add no light.
RGB, LUMINANCE2, DEPTH, HITS, PASSED, DROPPED, COLUMNS = slice(0, 3), 3, 4, 5, 6, 7, 8
# Of a render in the main process: the sums, and at the end picture and layers, in the writer's order too.
BYTES_A_PIXEL = 8 * COLUMNS + 100
# Larger deviations from square pixels are taken as mistakes, unless no whole number comes nearer.
_ASPECT_TOLERANCE = 0.02


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
        """Film points [2, N] in mm of pixels [N], numbered row by row from the top left, and places [2, N] in them."""
        row, column = np.divmod(pixel, self.width)
        points = np.empty((2, len(pixel)), np.float32)
        across, down = (column + jitter[0]) / self.width, (row + jitter[1]) / self.height
        points[0] = (0.5 - across) * self.film_mm[0]
        points[1] = (down - 0.5) * self.film_mm[1]
        return points


def check_memory(width: int, height: int, bytes_a_pixel: int = BYTES_A_PIXEL) -> None:
    """Refuse (InputError) a picture that alone would fill the machine, before memory is allocated."""
    try:
        most = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    except (AttributeError, ValueError, OSError):
        return  # not known on this system
    if width * height * bytes_a_pixel > most:
        expected = f"at most {most // bytes_a_pixel} pixels: each takes {bytes_a_pixel} bytes, of {most / 1e9:.3g} GB"
        raise InputError("picture", "width x height", (width, height), expected)


@dataclass(frozen=True)
class Tiling:
    """How a render is cut: tiles of consecutive pixels, passes of consecutive samples.

    A function of the picture alone. What a worker holds at a time depends on a tile, not on the picture.

    Attributes:
        pixels, samples: of the picture. tile: pixels per tile. step: samples per pass; the last pass may have fewer.
        start: the picture's number of the first pixel, where these are the tiles of a part of it.
    """

    pixels: int
    samples: int
    tile: int
    step: int
    start: int = 0

    @classmethod
    def of(cls, pixels: int, samples: int) -> Tiling:
        """Tiles of about `BATCH` paths per pass."""
        step = min(samples, SAMPLES_A_PASS)
        return cls(pixels, samples, max(1, BATCH // step), step)

    def around(self, first: int, stop: int) -> Tiling:
        """The tiles that hold the pixels from `first` up to `stop`, whole: other batches might round differently."""
        start = first - first % self.tile
        return replace(self, pixels=min(-(-stop // self.tile) * self.tile, self.pixels) - start, start=start)

    @property
    def tiles(self) -> int:
        return -(-self.pixels // self.tile)

    @property
    def passes(self) -> int:
        return -(-self.samples // self.step)

    def pixels_of(self, first: int, stop: int | None = None) -> slice:
        """The pixels of a tile, or of the tiles from `first` up to `stop`, counted from `start`."""
        return slice(first * self.tile, min((first + 1 if stop is None else stop) * self.tile, self.pixels))

    def samples_done(self, done: NDArray[np.int64]) -> NDArray[np.int64]:
        """Samples a pixel after so many passes."""
        return np.minimum(done * self.step, self.samples)

    def chunks(self) -> Iterator[tuple[int, int]]:
        """First tile, and the one after the last, of parts of the picture."""
        tiles = max(1, CHUNK_BYTES // (8 * COLUMNS * self.tile))
        for first in range(0, self.tiles, tiles):
            yield first, min(first + tiles, self.tiles)


class Film:
    """The sums of the pixels, and which passes are in them; several threads may use one film.

    Attributes:
        sums: [pixels, COLUMNS] float64. done: [tiles] passes that are in the sums.
        seconds: [2] spent by all workers: in the camera, and in all.

    Raises:
        MemoryError: there is not enough memory for the sums.
    """

    def __init__(self, tiling: Tiling) -> None:
        self.tiling = tiling
        size = tiling.pixels * COLUMNS * 8
        try:
            # A shared mapping: forked workers, which do not use it, would else keep a second copy of each page.
            self.sums = np.frombuffer(mmap.mmap(-1, size), np.float64).reshape(-1, COLUMNS)
        except (OSError, OverflowError, ValueError):
            raise MemoryError(f"{size} bytes") from None
        self.done = np.zeros(tiling.tiles, np.int64)
        self.seconds = np.zeros(2)
        self._lock = threading.Lock()
        self._early: dict[tuple[int, int], NDArray[np.float64]] = {}
        self._missing = self._all_missing()

    def _all_missing(self) -> Iterator[tuple[int, int]]:
        for part in range(self.tiling.passes):
            for tile in range(self.tiling.tiles):
                if self.done[tile] <= part:  # else it was done before a checkpoint
                    yield tile, part

    def take(self) -> tuple[int, int] | None:
        """The next tile and pass to render, all tiles of one pass before the next pass; None: there is no more."""
        with self._lock:
            return next(self._missing, None)

    def stop(self) -> None:
        """Give out no more tiles."""
        with self._lock:
            self._missing = iter(())

    def add(self, tile: int, part: int, sums: NDArray[np.float64], seconds: NDArray[np.float64]) -> None:
        """Add the sums [pixels, COLUMNS] of a pass of a tile, and the seconds [2] that it took.

        A pass waits here for those before it: sums are always added in the same order, and so round the same.
        """
        with self._lock:
            self.seconds += seconds
            self._early[tile, part] = sums
            while (ready := self._early.pop((tile, int(self.done[tile])), None)) is not None:
                self.sums[self.tiling.pixels_of(tile)] += ready
                self.done[tile] += 1

    def copy(self, first: int, stop: int) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
        """Sums [n, COLUMNS] of the pixels, and passes, of the tiles from `first` up to `stop`, of one moment."""
        with self._lock:
            return self.sums[self.tiling.pixels_of(first, stop)].copy(), self.done[first:stop].copy()

    @property
    def fraction(self) -> float:
        """The share of the work that is done."""
        return float(self.done.sum()) / (self.tiling.tiles * self.tiling.passes)
