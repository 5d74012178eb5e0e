"""Flare in a picture: the light of ghosts and of photons on the film.

Values are those of a render: film irradiance over the irradiance that a white card of radiance 1 makes on the axis.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from neurolens.base.files import Kept
from neurolens.flare.areas import Doubles, Floats, draw_edges, edges_of
from neurolens.flare.canvas import Raster, Smear, axis_irradiance, enlarged, smear_of, smeared, spread
from neurolens.flare.ghosts import GhostTracer, Pair
from neurolens.flare.grids import REACH, Grid, ghost_moves, grids_of
from neurolens.flare.lights import Light, Patch, light_rays, patches, rays_across
from neurolens.flare.photons import LEVELS, Photons, PhotonTracer
from neurolens.lens.glass import inverse_square_um
from neurolens.lens.paraxial import first_order
from neurolens.render.colour import SRGB, SpectralRange, in_gamut
from neurolens.render.film import digest

_AT_ONCE = 1 << 16  # photons of a call
_ENOUGH = 200  # photons of a kernel: a noise of 8%
_COLOURED = 3200  # photons of a kernel of colour: eyes see its noise in wider areas
_WAIT_S = 0.5  # between two reports
_KEEP_S = 30.0  # between two states of long work
_GOLDEN = 0.6180339887498949
_STRIP = 1 << 22  # bytes of a strip of the canvas, which one thread draws
_ROOM = 1 << 26  # bytes of edges that wait to be drawn
_EDGES = 176  # bytes of a cell's edges
FEWEST = 4  # wavelengths that stand for all
_PATCH_DEG = 2.0  # of an extended light: see `patches`
_PATCHES, _CELLS = (4, 6, 9), 48  # along a side, at most; cells of a ghost along a side, which many patches keep
_UNEVEN, _FAINT = 0.6, 5e-4  # share of its light that may come or go over a patch; share of all light, of a faint ghost

_T = TypeVar("_T")
_R = TypeVar("_R")


class _Task(NamedTuple):
    """A ghost of a light, at some wavelengths [K] with their colours [K, 3]."""

    light: Light
    pair: Pair
    grid: Grid
    wavelengths_nm: list[float]
    colours: Doubles


def ghost_picture(
    tracer: GhostTracer, lights: Sequence[Light], raster: Raster, *, layers: Sequence[int] | None = None, **options: Any
) -> Floats:
    """The ghosts of lights, [layers, H, W, 3] linear sRGB, with the options of `ghost_layers`.

    Args:
        layers: for each pair, the layer that takes it; None puts all into one.
    """
    layers = [0] * len(tracer.pairs) if layers is None else layers
    picture = np.zeros((1 + max(layers, default=0), raster.height, raster.width, 3), np.float32)
    for number, drawn in ghost_layers(tracer, lights, raster, layers, **options):
        picture[number] = drawn
    return picture


def ghost_layers(
    tracer: GhostTracer,
    lights: Sequence[Light],
    raster: Raster,
    layers: Sequence[int],
    *,
    wavelength_nm: tuple[float, float] = (400.0, 700.0),
    wavelengths: int = 60,
    cell_px: float = 8.0,
    threads: int = 2,
    done: Callable[[float], None] = lambda share: None,
) -> Iterator[tuple[int, Floats]]:
    """Yield the number and the picture [H, W, 3] (linear sRGB) of each layer that has light.

    Each ghost is drawn as the areas of a grid of rays (`flare.canvas`).

    Args:
        layers: for each pair, the layer that takes it.
        wavelengths: of equal shares of the range, which fewer stand for where a ghost's colours part little.
        cell_px: about the size of a grid's cells on the film: see `grids_of`.
        done: is called with the share of the work that is done.
    """
    lens, spectral = tracer.lens, SpectralRange(*wavelength_nm, bins=wavelengths)
    layer = dict(zip(tracer.pairs, layers, strict=True))
    middle = 0.5 * sum(wavelength_nm)
    unit = raster.per_mm**2 / axis_irradiance(lens, middle) / wavelengths
    half, nm = (raster.film_mm[0] / 2, raster.height / raster.per_mm / 2), spectral.centres_nm
    groups: dict[tuple[int, Smear | None], list[_Task]] = {}
    for light in lights:
        for patch, pair, grid, moves in _parts(tracer, light, nm.tolist(), middle, half, cell_px / raster.per_mm):
            response = np.asarray(unit * spectral.response * spectral.spectrum(patch.light.rgb), np.float64).T
            task = _Task(patch.light, pair, grid, *_bands(nm, response, grid))
            groups.setdefault((layer[pair], smear_of(patch, raster.per_mm * moves * (-1, 1))), []).append(task)
    work = _Work(sum(map(len, groups.values())), done, threads)
    for number in sorted({number for number, _ in groups}):
        picture = np.zeros((raster.height, raster.width, 3), np.float32)
        for (_, smear), tasks in ((key, tasks) for key, tasks in groups.items() if key[0] == number):
            if smear is None:
                _draw(tracer, tasks, picture, raster.per_mm, work)
                continue
            coarse = smear.coarse
            kernel = smear.kernel(max(raster.width, raster.height) // 2, coarse)
            more = 3 * (coarse > 1) - 1
            room = [n // coarse + k + more for n, k in zip(picture.shape[:2], kernel.shape, strict=True)]
            canvas = np.zeros((*room, 3), np.float32)
            _draw(tracer, tasks, canvas, raster.per_mm / coarse, work)
            picture += enlarged(smeared(canvas, kernel) / np.float32(coarse**2), coarse, raster.height, raster.width)
        yield number, picture


def _parts(
    tracer: GhostTracer, light: Light, nm: Sequence[float], middle_nm: float, half_mm: tuple[float, float], cell: float
) -> Iterator[tuple[Patch, Pair, Grid, Doubles]]:
    """The patches of a light, and the ghosts of each with their grids and moves. Patches are finer for a ghost much of
    whose light comes or goes over a patch, because rims cut it differently there."""
    efl, needs = abs(float(first_order(tracer.lens).efl_mm)), dict.fromkeys(tracer.pairs, _PATCHES[0])
    for most in _PATCHES:
        pairs = [pair for pair in tracer.pairs if needs[pair] == most]
        found, sums = list[tuple[Patch, Pair, Grid, Doubles]](), dict.fromkeys(pairs, np.zeros(2))
        for patch in patches(light, _PATCH_DEG * _PATCHES[0] / most, most) if pairs else ():
            size = 1.5 * float(np.abs(patch.sides).sum()) * efl
            around = half_mm[0] + size, half_mm[1] + size  # a smear may bring ghosts from beside the film
            for pair, grid in grids_of(tracer, patch.light, middle_nm, around, cell, nm, pairs).items():
                moves, lit = ghost_moves(tracer, patch, pair, grid, middle_nm)
                columns, rows = (min(n, max(n * _PATCHES[0] // most, _CELLS)) for n in (grid.columns, grid.rows))
                found.append((patch, pair, replace(grid, columns=columns, rows=rows), moves))
                sums[pair] = sums[pair] + lit
        if most == _PATCHES[0]:
            least = _FAINT * sum(whole for _, whole in sums.values())
            for pair, (changing, whole) in sums.items():
                enough = (n for n in _PATCHES if whole <= least or changing * most <= _UNEVEN * whole * n)
                needs[pair] = next(enough, _PATCHES[-1])
        yield from (part for part in found if needs[part[1]] == most)


def _draw(tracer: GhostTracer, tasks: Sequence[_Task], canvas: Floats, per_mm: float, work: _Work) -> None:
    """Add ghosts to a picture of so many pixels per mm."""
    height, width, _ = canvas.shape
    high = max(1, _STRIP // (32 * width))
    strips = [range(height)[k : k + high] for k in range(0, height, high)]

    def edges(task: _Task) -> tuple[list[Doubles], Doubles]:
        """The edges of each wavelength's cells, and the light of the cells."""
        if not work.step():
            return [], task.colours[:0]
        rays, area = rays_across(tracer.lens, task.light, task.grid.places)
        rows = tracer.follow_each(tracer.start(rays), task.wavelengths_nm, task.pair, REACH)
        each = [edges_of(of_one, task.grid.columns, (width, height), per_mm) for of_one in rows]
        return each, area * task.grid.cell * task.colours

    for batch in _batches(tasks):
        ghosts = [ghost for _, ghost in work.results(edges, batch)]
        each = [edges for of_ghost, _ in ghosts for edges in of_ghost]
        drawn = np.concatenate(each), np.array(list(map(len, each))), np.concatenate([light for _, light in ghosts])

        def strip(rows: range, drawn: tuple[Any, ...] = drawn) -> None:
            draw_edges(canvas, rows, *drawn)

        for _ in work.results(strip, strips):
            pass


def _batches(tasks: Sequence[_Task]) -> Iterator[list[_Task]]:
    """Tasks in order, of one light and as many at a time as have room for their edges."""
    batch, used = list[_Task](), 0
    for task in tasks:
        size = _EDGES * len(task.wavelengths_nm) * task.grid.columns * task.grid.rows
        if batch and (used + size > _ROOM or task.light is not batch[0].light):
            yield batch
            batch, used = [], 0
        batch.append(task)
        used += size
    if batch:
        yield batch


def _bands(nm: Doubles, response: Doubles, grid: Grid) -> tuple[list[float], Doubles]:
    """The wavelengths that stand for all of `nm` [W] in a ghost, and their colours [K, 3] for responses [W, 3].

    One wavelength is traced for each band. The others of the band have its places and their own power: a coating may
    reflect ten times as much at one end of a band as at the other. Ghosts with equally many bands share the wavelengths
    that are traced, unless a ghost is too dark at one of them to stand for its band.
    """
    count = min(max(grid.wavelengths, FEWEST), len(nm))
    w = inverse_square_um(nm)  # glass moves light about evenly with it
    at = np.arange(count) if count == len(nm) else (count * (w[0] - w) / (1.000001 * (w[0] - w[-1]))).astype(int)
    nodes, level = zip(*(grid.spectrum or ((nm[0], 1.0),)), strict=True)
    power = np.interp(nm, nodes, np.maximum(level, 1e-3 * max(level) + 1e-30))
    traced, colours = list[float](), list[Doubles]()
    for band in (np.flatnonzero(at == k) for k in np.unique(at)):
        chosen = float(np.average(nm[band], weights=np.abs(response[band]).sum(1) + 1e-30))
        if 2 * np.interp(chosen, nm, power) < power[band].mean():
            bright = nm[band[2 * power[band] >= power[band].mean()]]
            chosen = float(bright[np.abs(bright - chosen).argmin()])
        traced.append(chosen)
        colours.append(power[band] @ response[band] / np.interp(chosen, nm, power))
    return traced, np.array(colours)


# Photons by what became of them; those of "ghosts" and "glare" are the flare.
PARTS: dict[str, Callable[[Photons], NDArray[np.bool_]]] = {
    "image": lambda photons: (photons.reflections == 0) & (photons.scattered == 0),
    "ghosts": lambda photons: (photons.reflections > 0) & ~photons.glare,
    "glare": lambda photons: photons.glare,
    "flare": lambda photons: (photons.reflections > 0) | (photons.scattered > 0),
}


def photon_picture(
    tracer: PhotonTracer,
    lights: Sequence[Light],
    raster: Raster,
    *,
    part: str = "flare",
    wavelength_nm: tuple[float, float] = (400.0, 700.0),
    wavelengths: int = 15,
    photons: int = 1 << 20,
    most_reflections: int = 10,
    kernel_px: float = 3.0,
    seed: int = 0,
    threads: int = 2,
    keep: Path | None = None,
    done: Callable[[float], None] = lambda share: None,
) -> Floats:
    """The photons of lights on the film, [H, W, 3] linear sRGB, by density estimation.

    Args:
        part: one of `PARTS`: photons that were reflected or scattered ("flare"), reflected twice at most ("ghosts"),
            reflected more often or scattered ("glare"), or neither ("image").
        photons: of each light and wavelength. kernel_px: radius of the narrowest kernel: see `_smoothed`.
        keep: file that holds the state of long work until the work is whole; the same call goes on from it.
    """
    lens, spectral = tracer.lens, SpectralRange(*wavelength_nm, bins=wavelengths)
    exposure = axis_irradiance(lens, 0.5 * (spectral.low_nm + spectral.high_nm))
    edges = (np.arange(raster.height + 1) - raster.height / 2, np.arange(raster.width + 1) - raster.width / 2)
    firsts = range(0, photons, _AT_ONCE)
    tasks = [(number, light, k) for number, light in enumerate(lights) for k in range(wavelengths)]
    picture = np.zeros((raster.height, raster.width, 3), np.float32)
    sums = np.zeros((2, raster.height, raster.width), np.float32)
    same = lens, tracer.scatter, list(lights), raster, part, spectral.centres_nm, photons, most_reflections, seed
    kept, first_task = Kept(keep, digest(same), _KEEP_S), 0
    if (state := kept.load()) is not None:
        first_task, (picture, sums) = state[0]["done"], state[1]
    work = _Work((len(tasks) - first_task) * len(firsts), done, threads)

    def one(task: tuple[int, Light, int]) -> tuple[Floats, Doubles]:
        """Sums of weights and of their squares, [2, H, W], and the colour [3] of a weight of 1."""
        number, light, k = task
        film, area = np.zeros((2, raster.height, raster.width), np.float32), 0.0
        shift = (k / wavelengths + seed * _GOLDEN % 1) % 1
        for first in firsts:
            if not work.step():
                break
            rays, area = light_rays(lens, light, first, min(_AT_ONCE, photons - first), shift, photons**-0.5)
            # A seed of its own, the same for any number of threads.
            chances = ((seed << 44) + (number * wavelengths + k) * photons + first) % (1 << 64)
            for xy, weight in _arrivals(tracer, part, rays, float(spectral.centres_nm[k]), most_reflections, chances):
                x, y = xy * raster.per_mm
                for power in (1, 2):
                    film[power - 1] += np.histogram2d(y, -x, bins=edges, weights=weight**power)[0]
        colour = spectral.response[:, k] * spectral.spectrum(light.rgb)[k] / wavelengths
        return film, colour * (area * raster.per_mm**2 / photons / exposure)

    for _, (film, colour) in work.results(one, tasks[first_task:]):
        picture += film[0, ..., None] * colour.astype(np.float32)
        sums += film * (np.abs(colour).max() ** np.array([1, 2], np.float32))[:, None, None]
        first_task += 1
        kept.save({"done": first_task}, (picture, sums))
    return _smoothed(picture, sums, kernel_px) if kernel_px > 0 else picture


def _arrivals(
    tracer: PhotonTracer, part: str, rays: Floats, wavelength_nm: float, most_reflections: int, seed: int
) -> Iterator[tuple[Floats, Floats]]:
    """Places on the film [2, M] (mm) and weights [M] of the photons of a part."""
    # Glare that surfaces alone reflect turns round by choice; photons that scatter go as they would.
    for scatters in (False, True)[: 1 + tracer.scatter.on] if part == "glare" else (None,):
        boost = tracer.turning(wavelength_nm, LEVELS - 1) if scatters is False else 1.0
        photons = tracer.trace(rays, wavelength_nm, most_reflections=most_reflections, seed=seed, boost=boost)
        which = PARTS[part](photons)
        if scatters is not None:
            which &= (photons.scattered > 0) == scatters
        # A film that sends light back is exposed by what it keeps.
        yield photons.film_xy_mm[:, which], photons.weight[which] / (1 - tracer.scatter.sensor)


class _Work:
    """Steps of work in threads. While they go on, `done` is called with their share; where it raises, they end soon."""

    def __init__(self, steps: int, done: Callable[[float], None], threads: int) -> None:
        self._steps, self._done, self._threads = max(steps, 1), done, threads
        self._count, self._stopping = 0, False

    def step(self) -> bool:
        """Count a step; return whether to go on."""
        self._count += 1
        return not self._stopping

    def results(self, one: Callable[[_T], _R], tasks: Sequence[_T]) -> Iterator[tuple[_T, _R]]:
        """Yield each task with its result, in order; no more than one task a thread is under way."""
        with ThreadPoolExecutor(self._threads) as pool:
            try:
                for begin in range(0, len(tasks), self._threads):
                    batch = tasks[begin : begin + self._threads]
                    for task, future in zip(batch, [pool.submit(one, task) for task in batch], strict=True):
                        while not wait([future], _WAIT_S).done:
                            self._report()
                        yield task, future.result()
                    self._report()
            except BaseException:
                self._stopping = True
                raise

    def _report(self) -> None:
        self._done(min(self._count / self._steps, 1.0))


def _smoothed(picture: Floats, sums: Floats, radius: float) -> Floats:
    """Smooth a picture [H, W, 3] of photons: its luminance by kernels from `radius` on, its colour by wider kernels."""
    wide = min(picture.shape[:2])
    bright = in_gamut(_spread_wide(picture, sums, radius, _ENOUGH, wide / 8))
    coloured = in_gamut(_spread_wide(picture, sums, radius, _COLOURED, wide / 2))
    luminance = [np.maximum(part @ SRGB.to_xyz[1].astype(np.float32), 1e-30)[..., None] for part in (bright, coloured)]
    return coloured * (luminance[0] / luminance[1])


def _spread_wide(picture: Floats, sums: Floats, radius: float, enough: int, widest: float) -> Floats:
    """A picture [H, W, 3] whose pixels' light is spread by kernels that keep its sum, mirrored at the edges.

    Each pixel takes the narrowest kernel of radius r, 2 r, ... that holds `enough` photons of equal weight, or is as
    little noisy by their `sums` of weights and of squares, [2, H, W], with a soft step to the next, and none much wider
    than `widest`, in pixels. The kernel is Epanechnikov's, 2 / pi (1 - r^2) in units of its radius.
    """
    total, left, last = np.zeros_like(picture), np.ones(picture.shape[:2], np.float32), False
    while not last:
        weight, square = np.moveaxis(spread(np.moveaxis(sums, 0, 2), radius), 2, 0)
        last = radius > widest
        # n photons of equal weight have a sum of squares of n times the kernel's mean square, 4 / (3 pi r^2).
        held = 0.75 * math.pi * radius**2 * weight**2 / np.maximum(square, 1e-30) / enough
        share = np.ones_like(left) if last else (held - 0.5).clip(0, 1)
        total += spread(picture * (left * share)[..., None], radius)
        left, radius = left * (1 - share), 2 * radius
    return total
