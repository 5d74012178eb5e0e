"""A plate as a lens would have photographed it: its pixels are gathered, its highlights spread as clean discs.

The picture gets the camera's blur, distortion, vignetting and colour fringes. The rays of a pixel lie between those of
the four nodes around it. What a ray meets is found in the plate's depth (`gather.c`). A pixel takes the number of
samples that is asked for where the light in its blur is uneven, and fewer where it is even or sharp. Samples are
weighted so that even light stays even: a pixel is the weighted mean of radiance, times the mean weight of the whole
pupil.

Highlights are pixels that are far brighter than their surroundings. Few of a pixel's samples would find them, which
makes noise. Their light above that of the surroundings is taken out of the plate and spread by the lens's own kernels;
points of a place and depth that are alike share one. It is left out at film pixels where something nearer hides the
point.
"""

import ctypes
import math
from collections import defaultdict
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cache
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from neurolens.base.errors import InputError, warn
from neurolens.base.progress import Progress
from neurolens.base.settings import LIGHT_NM
from neurolens.base.tasks import in_order
from neurolens.cameras.contract import Camera
from neurolens.cameras.field import WIDEST_DEG
from neurolens.graph.compiler import c_source, load_compiled
from neurolens.pictures.defocus.kernels import LARGEST, kernel_at, tint
from neurolens.pictures.defocus.plate import FINEST, NUMBERS, FloatArray, Plate, RayTable, axis_px, reduced
from neurolens.pictures.render.sampler import sobol

_SET = 512  # points of the pupil in a set
_FEW = 128  # of these, to measure blur
SAMPLES, _LEAST = 128, 8  # samples of a pixel: by default, and at least
# From this contrast of the light in its blur, and this radius of blur with the pixel itself, a pixel takes all samples:
# the error is in proportion to the contrast, and a small blur has few pixels to sample.
_FULL, _FULL_PX = 0.25, 2.0
_CLEAR = 0.01  # share of its inverse depth by which something must be nearer to hide a point
_SAID = 0.002  # a share of made-up light from which there is a warning
_EDGE, _TRIED = 9, 6  # points that are tried along each side of the film, and across a pupil that is dark in the middle
_WINDOW = 33  # pixels across the surroundings
# a highlight is so many times as bright as the geometric mean of its surroundings, and as their mean
_BRIGHTER, _ABOVE = 8.0, 3.0
_LEAST_PX = 1.5  # radius of blur: what is sharper has no noise
_PLACES = 32  # kernels along the longer side of the film
_FINE_PX, _FINE = 0.25, 0.03  # steps of the radius between two kernels: in pixels, and relative
_MOST_WORK = 4e9  # pixels of kernels in all
_SAME = 0.01  # share of inverse depth within which two layers show the same thing
_CELLS, _COLOURS = 24, 2


@dataclass(frozen=True)
class Gathered:
    """The picture that a camera takes of a plate.

    Attributes:
        rgb: [H, W, 3]. filled, beyond: shares of its light that the plate did not have: behind the edges of things, and
            outside of the plate.
        highlights: how many were spread as discs. lost: estimated share of the light of highlights that no layer shows,
            if there are as many behind edges as beside them.
    """

    rgb: FloatArray
    filled: float
    beyond: float
    highlights: int = 0
    lost: float = 0.0


class _Table(ctypes.Structure):
    _fields_ = [  # noqa: RUF012
        *((name, ctypes.c_int) for name in ("across", "down", "samples", "channels", "stride")),
        *((name, ctypes.c_float) for name in ("pitch_x", "pitch_y")),
        *((name, ctypes.c_void_p) for name in ("rays", "jitter")),
        ("above", ctypes.c_float),
    ]


@cache
def compiled() -> ctypes.CDLL:
    defined = {"NUMBERS": NUMBERS, "WEIGHT": NUMBERS - 1, "FINEST": FINEST.bit_length() - 1, "CLEAR": f"{_CLEAR}f"}
    library = load_compiled(c_source("pictures/defocus/gather.c", **defined))
    whole, pointer = ctypes.c_int, ctypes.c_void_p
    library.splat.argtypes = [pointer, whole, pointer, whole, pointer, *[whole] * 2, pointer, *[whole] * 2, pointer]
    library.splat.restype = ctypes.c_double
    library.gather.argtypes = [pointer, whole, _Table, whole, whole, whole, pointer, pointer]
    library.gather.restype = None
    return library


def _points(count: int, numbers: int) -> FloatArray:
    """Return points [numbers, count] spread evenly over the unit cube."""
    return ((sobol(count, numbers) + 2.0**31 / count) / 2.0**32).astype(np.float32)


def spread_over(camera: Camera, plate: Plate) -> NDArray[np.float64]:
    """Return the variance of the places at which rays of each node [rows, columns, 3] see a point.

    The last axis has the variance of a, twice the covariance of a and b, and the variance of b, each summed over x and
    y. The variance's root is the radius of an even disc over sqrt(2).
    """
    points, found = _points(_FEW, 3), []
    table = RayTable(camera, plate, points[:2], points[2])
    for j in range(table.cells[1] + 1):
        rays = table.row(j)[..., :NUMBERS].astype(np.float64)
        weight = rays[..., 4:] / np.maximum(rays[..., 4:].sum(axis=1, keepdims=True), 1e-30)
        a, b = (part - (weight * part).sum(axis=1, keepdims=True) for part in (rays[..., :2], rays[..., 2:4]))
        found.append(np.stack([(weight * term).sum(axis=(1, 2)) for term in (a * a, 2 * a * b, b * b)], axis=1))
    return np.stack(found)


def radius_px(spread: NDArray[np.float64], w: NDArray[Any]) -> NDArray[np.float64]:
    """Return the radii in pixels of the discs of things of inverse depth w."""
    a, ab, b = np.moveaxis(spread, -1, 0)
    return np.sqrt(np.maximum(2 * (a + (ab + b * w) * w), 0))


def _sizes(plate: Plate, spread: NDArray[np.float64], samples: int) -> NDArray[np.uint8]:
    """Return log2 of each pixel's number of samples [H, W], by the widest disc that reaches it and its light."""
    width, height = plate.size
    places = [np.minimum(np.arange(0, n, FINEST) + FINEST / 2, n - 1) for n in (height, width)]
    nodes = [
        np.minimum((p / n * (k - 1)).round().astype(int), k - 1)
        for p, n, k in zip(places, (height, width), spread.shape[:2], strict=True)
    ]
    here = spread[np.ix_(*nodes)]
    widest = np.zeros(here.shape[:2])
    for layer in plate.layers:
        low, high = np.zeros(widest.shape), np.full(widest.shape, max(layer.nearest, 0.0))
        for _ in range(2):
            reach = np.maximum(radius_px(here, low), radius_px(here, high))
            level = np.clip(np.ceil(np.log2(np.maximum(reach, 1) / FINEST)), 0, len(layer.bounds) - 1).astype(int)
            for k in np.unique(level):
                bounds = layer.bounds[k]
                cell = FINEST << int(k)
                rows, columns = (
                    np.clip(((p + border) / cell).astype(int), 0, n - 1)
                    for p, border, n in zip(places, plate.border_px[::-1], bounds.shape, strict=False)
                )
                least, most = _beside(bounds[..., 0], np.minimum), _beside(bounds[..., 1], np.maximum)
                inside = level == k
                low = np.where(inside, np.maximum(least[np.ix_(rows, columns)], 0), low)
                high = np.where(inside, np.maximum(most[np.ix_(rows, columns)], 0), high)
        widest = np.maximum(widest, np.maximum(radius_px(here, low), radius_px(here, high)))
    share = np.minimum(_contrast(plate, places, widest) / _FULL, 1) * np.minimum((widest + 0.5) / _FULL_PX, 1) ** 2
    wanted = np.ceil(np.log2(np.maximum(samples * share, _LEAST))).astype(np.uint8)
    return np.ascontiguousarray(wanted.repeat(FINEST, 0).repeat(FINEST, 1)[:height, :width])


def _contrast(plate: Plate, places: list[NDArray[np.float64]], reach: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the contrast of light in blurs: the standard deviation over the mean, of all layers.

    It is taken in squares [rows, columns] about `places` (rows, columns of the film) that a blur of the radii `reach`
    fills. Even light has no noise.
    """
    sums: Any = 0.0
    for layer in plate.layers:
        solid = layer.texel[..., 3] >= 0
        rgb = np.moveaxis(layer.texel[..., :3], 2, 0)
        planes = (solid, *rgb, np.square(rgb, dtype=np.float64).sum(axis=0))
        sums = sums + np.stack([reduced(np.where(solid, p, 0.0), FINEST, np.add) for p in planes], axis=2)
    sums = np.pad(sums, [(1, 0), (1, 0), (0, 0)]).cumsum(axis=0).cumsum(axis=1)
    middle = np.meshgrid(*places, indexing="ij")
    (top, left), (stop, right) = (
        [
            np.clip(by((v + border + side * (reach + 1)) / FINEST), low, n - 2 + low).astype(int)
            for v, border, n in zip(middle, plate.border_px[::-1], sums.shape, strict=False)
        ]
        for by, side, low in ((np.floor, -1, 0), (np.ceil, 1, 1))
    )
    count, *mean, square = np.moveaxis(sums[stop, right] - sums[top, right] - sums[stop, left] + sums[top, left], 2, 0)
    bright = np.square(mean).sum(axis=0)
    return np.sqrt(np.maximum(square * count / np.maximum(bright, 1e-30) - 1, 0))


def _beside(values: FloatArray, by: np.ufunc) -> FloatArray:
    """Return the least or largest value of each cell and its eight neighbours."""
    padded = np.pad(values, 1, mode="edge")
    rows = by(by(padded[:-2], padded[1:-1]), padded[2:])
    return by(by(rows[:, :-2], rows[:, 1:-1]), rows[:, 2:])


def gather(
    plate: Plate, camera: Camera, spread: NDArray[np.float64], samples: int = SAMPLES, threads: int = 1,
    report: Callable[[float], None] = lambda _: None,
) -> Gathered:  # fmt: skip
    """Take a camera's picture of a plate.

    Args:
        spread: what `spread_over` returns for this plate and camera.
        samples: of a pixel, a power of two.
    """
    width, height = plate.size
    points = _points(_SET, 5)
    jitter = np.ascontiguousarray(points[2:4].T)
    table = RayTable(camera, plate, points[:2], points[4])
    (across, down), structs, sizes = table.cells, plate.structs(), _sizes(plate, spread, samples)
    rgb = np.empty((height, width, 3), np.float32)
    lost = np.zeros(3)
    edges = [round(j * height / down) for j in range(down + 1)]

    def tasks() -> Iterator[tuple[int, FloatArray]]:
        before = table.row(0)
        for j in range(down):
            after = table.row(j + 1)
            yield j, np.stack([before, after])
            before = after

    def band(task: tuple[int, FloatArray]) -> NDArray[np.float64]:
        j, rays = task
        first, stop = edges[j], edges[j + 1]
        sums = np.empty((stop - first, width, 8), np.float32)
        struct = _Table(
            across + 1, 2, _SET, len(table.nm), rays.shape[3], width / across, height / down,
            rays.ctypes.data, jitter.ctypes.data, first - j * height / down,
        )  # fmt: skip
        part = sizes[first:stop]
        compiled().gather(structs, len(structs), struct, width, first, stop - first, part.ctypes.data, sums.ctypes.data)
        weights = rays[..., NUMBERS - 1 : len(table.nm) * NUMBERS : NUMBERS].mean(axis=2, dtype=np.float64)
        weights = weights[..., [1, 0, 2]] if len(table.nm) > 1 else weights
        x, share = (np.arange(width) + 0.5) / width * across, (np.arange(first, stop) + 0.5) / height * down - j
        above, below = (np.stack([np.interp(x, np.arange(across + 1), c) for c in row.T], 1) for row in weights)
        light = above + (below - above) * share[:, None, None]
        weight = sums[..., 3:6]
        rgb[first:stop] = light * np.divide(sums[..., :3], weight, out=np.zeros_like(weight), where=weight > 0)
        return sums[..., [4, 6, 7]].sum(axis=(0, 1), dtype=np.float64)

    for j, part in enumerate(in_order(threads, band, tasks()), 1):
        lost += part
        report(j / down)
    filled, beyond = lost[1:] / max(lost[0], 1e-30)
    return Gathered(rgb, float(filled), float(beyond))


@dataclass(frozen=True)
class Highlights:
    """Highlights that were taken out of a layer.

    Attributes:
        place_px: [N, 2] in pixels of the layer. inverse_depth: [N]. radius_px: [N] of their blur.
        side: [N] the sign of their blur, by the side of the plane in focus. light: [N, 3].
    """

    place_px: NDArray[np.float64]
    inverse_depth: FloatArray
    radius_px: NDArray[np.float64]
    side: NDArray[np.float64]
    light: FloatArray


def take_highlights(plate: Plate, number: int, spread: NDArray[np.float64]) -> Highlights:
    """Take the highlights out of a layer of a plate, which is changed; `spread` is `spread_over` of camera and plate.

    A highlight that a layer before it also shows, at the same place and depth, is taken out here and left to that
    layer.
    """
    layer, size = plate.layers[number], plate.size
    rgb, w = layer.texel[..., :3], layer.texel[..., 3]
    bright, there = rgb.max(axis=2), w >= 0
    # share of the surroundings where the layer has something
    part = np.maximum(_around(there.astype(np.float32)), 1e-9)
    log = np.log(np.maximum(bright, 1e-6 * max(float(bright.mean()), 1e-30)))
    geometric = np.exp(_around(np.where(there, log, 0)) / part)
    mean = _around(np.where(there, np.minimum(bright, _BRIGHTER * geometric), 0)) / part
    cap = np.maximum(_BRIGHTER * geometric, _ABOVE * mean)
    row, column = np.nonzero((bright > cap) & there)
    nodes = [
        np.clip(((v + 0.5 - border) / n * (k - 1)).round().astype(int), 0, k - 1)
        for v, border, n, k in zip((row, column), plate.border_px[::-1], size[::-1], spread.shape[:2], strict=True)
    ]
    radius = radius_px(spread[nodes[0], nodes[1]], w[row, column])
    _, ab, b = np.moveaxis(spread[nodes[0], nodes[1]], -1, 0)
    side = np.sign(ab + 2 * b * w[row, column])  # the sign of the growth of the squared radius with the inverse depth
    wide = (radius > _LEAST_PX) & (radius < LARGEST / 3)  # still larger discs have little noise
    order = np.flatnonzero(wide)[np.argsort(-(bright / cap)[row, column][wide])]  # brightest first
    some = np.sort(order[np.cumsum(math.pi * radius[order] ** 2) <= _MOST_WORK])  # as many as there is time for
    row, column, radius, side = row[some], column[some], radius[some], side[some]
    light = rgb[row, column] * (1 - cap[row, column] / bright[row, column])[:, None]
    rgb[row, column] -= light
    own = np.ones(len(row), bool)
    for other in plate.layers[:number]:
        own &= np.abs(other.texel[row, column, 3] - w[row, column]) > _SAME * w[row, column]
    row, column = row[own], column[own]
    place = np.stack([column, row], axis=1) + np.float64(0.5)
    return Highlights(place, w[row, column], radius[own], side[own], light[own])


def _around(values: NDArray[np.floating]) -> NDArray[np.float64]:
    """Return the mean of the window about each pixel; beyond the border the picture is continued."""
    found = values.astype(np.float64)
    for axis in (0, 1):
        found = np.pad(found, [(_WINDOW // 2 + 1, _WINDOW // 2) if a == axis else (0, 0) for a in (0, 1)], mode="edge")
        sums = np.moveaxis(np.cumsum(found, axis=axis, out=found), axis, 0)
        found = np.moveaxis((sums[_WINDOW:] - sums[:-_WINDOW]) / _WINDOW, 0, axis)
    return found


def spread_highlights(
    picture: FloatArray,
    found: Highlights,
    plate: Plate,
    camera: Camera,
    report: Callable[[float], None] = lambda _: None,
) -> float:
    """Add the light of highlights to a picture [H, W, 3].

    Returns the summed light that nearer things hide where no layer shows what is behind them.
    """
    (width, height), border = plate.size, np.array(plate.border_px)
    groups = defaultdict(list)
    cell = (found.place_px / (max(width, height) / _PLACES)).astype(int)
    radius, near = np.maximum(found.radius_px, 1e-3), 4.0 * _FINE_PX / _FINE
    step = np.where(radius < near / 4, radius / _FINE_PX, near + np.log(radius) / _FINE).round().astype(int)
    for k, key in enumerate(zip(*cell.T.tolist(), step.tolist(), found.side.tolist(), strict=True)):
        groups[key].append(k)
    structs, hidden = plate.structs(), 0.0
    for number, rows in enumerate(groups.values()):
        place, w = found.place_px[rows].mean(axis=0), float(found.inverse_depth[rows].mean())
        kernel = kernel_at(camera, plate, (place[0], place[1]), w, tuple(place - border), _CELLS, _COLOURS)
        if kernel is not None:
            points = np.empty((len(rows), 8), np.float32)
            points[:, :2], points[:, 2] = found.place_px[rows], found.inverse_depth[rows]
            points[:, 3:5] = kernel.corner_px + (found.place_px[rows] - place) @ kernel.film_by_plate.T
            points[:, 5:] = found.light[rows]
            sweep, light = np.ascontiguousarray(kernel.sweep, np.float32), np.ascontiguousarray(kernel.light)
            hidden += compiled().splat(
                structs, len(structs), points.ctypes.data, len(rows), light.ctypes.data, *light.shape[1::-1],
                sweep.ctypes.data, width, height, picture.ctypes.data,
            )  # fmt: skip
        report((number + 1) / len(groups))
    return hidden


def defocus(
    plate: Plate, camera: Camera, samples: int = SAMPLES, threads: int = 1, highlights: bool = True,
    progress: Progress | None = None,
) -> Gathered:  # fmt: skip
    """Take a camera's picture of a plate.

    Args:
        samples: of each pixel whose blur is uneven, 8 to 512; rounded up to a power of two.
        highlights: whether to spread pixels far brighter than their surroundings as discs, without noise.

    Warns:
        NeurolensWarning: some light of the picture lies behind the edges of things or outside of the plate.

    Raises:
        InputError: the camera sees 85 degrees from its axis or more; there is no C compiler.
    """
    progress = progress or Progress(quiet=True)
    check_field(camera)
    plate = replace(plate, axis_px=axis_px(camera, plate.size))
    spread = spread_over(camera, plate)
    taken = [take_highlights(plate, k, spread) for k in range(len(plate.layers)) if highlights]
    with progress.stage(f"blur by {camera.name}") as report:
        found = gather(plate, camera, spread, 1 << (samples - 1).bit_length(), threads, report)
    hidden = 0.0
    for some in taken:
        if len(some.radius_px):
            with progress.stage(f"spread {len(some.radius_px)} highlights") as report:
                # Edges hide as much light of highlights that a plate shows as they let through of those that it does
                # not show: the part of the pupil that they cover of one point is, on average, the part that they leave
                # open of a hidden one.
                hidden += spread_highlights(found.rgb, some, plate, camera, report)
    light = float(found.rgb.sum(dtype=np.float64))
    lost, number = max(hidden, 0) / max(light + hidden, 1e-30), sum(len(some.radius_px) for some in taken)
    _say(found := replace(found, highlights=number, lost=lost), len(plate.layers))
    return replace(found, rgb=np.maximum(found.rgb @ tint(camera).T.astype(np.float32), 0))


def _say(found: Gathered, layers: int) -> None:
    if max(found.filled, found.lost) > _SAID:
        more = "" if layers > 1 else "; layers behind (--behind, or a deep file) have it"
        lost = f", without highlights: if as many are hidden as are seen, {100 * found.lost:.1f}% of the light is lost"
        warn(f"{100 * found.filled:.1f}% of the light comes from behind edges, which the plate does not show: what is "
             f"beside them was put there{lost * (found.lost > 0)}{more}")  # fmt: skip
    if found.beyond > _SAID:
        warn(f"{100 * found.beyond:.1f}% of the light comes from beyond the plate's borders, whose pixels were "
             "repeated: render it with overscan")  # fmt: skip


def check_field(camera: Camera) -> None:
    """Refuse (InputError) a camera that a plate, which is a plane, cannot serve."""
    width, height = camera.film_mm
    side = np.linspace(-0.5, 0.5, _EDGE)
    film = np.stack(np.meshgrid(side * width, side * height), 0).reshape(2, -1).astype(np.float32)
    low, high = camera.wavelength_nm or LIGHT_NM
    nm = np.full(film.shape[1], min(max(550.0, low), high), np.float32)
    for x, y in ((0.5, 0.5), *product(np.linspace(0.1, 0.9, _TRIED), repeat=2)):  # a mask may be dark in the middle
        rays = camera.sample(film, np.tile(np.array([[x], [y]], np.float32), film.shape[1]), nm)
        if (passed := rays.status == 0).any():
            break
    if not passed.any():
        raise InputError(camera.name, "film", f"({width:g} x {height:g} mm)", "a film on which light arrives")
    widest = math.degrees(math.acos(float(np.clip((-rays.direction[2][passed]).min(), -1, 1))))
    if widest > WIDEST_DEG:
        expected = f"at most {WIDEST_DEG:g}: a plate is a plane, on which no wider field has room"
        raise InputError(camera.name, "half field, degrees", round(widest, 1), expected)
