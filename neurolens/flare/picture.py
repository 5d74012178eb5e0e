"""Flare in a picture: the light of ghosts and photons on the film, and a table of ghosts.

Values are those of a render: film irradiance over the irradiance that a white card of radiance 1 makes on the axis.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from pathlib import Path
from typing import TypeVar

import numpy as np
import torch
from numpy.typing import NDArray

from neurolens.analysis.fields import Scene
from neurolens.analysis.layout import Layout, Line, layout_profile
from neurolens.base.errors import InputError
from neurolens.base.kept import Kept
from neurolens.base.status import PASSED
from neurolens.flare.area import draw_edges, edges_of
from neurolens.flare.ghostmodel import GhostModel
from neurolens.flare.ghosts import GhostTracer, Pair
from neurolens.flare.grids import REACH, Grid, ghost_moves, grids_of
from neurolens.flare.lights import Light, disc, light_rays, patches, rays_across
from neurolens.flare.photons import LEVELS, Photons, PhotonTracer
from neurolens.flare.smear import Smear, enlarged, smear_of, smeared, spread
from neurolens.flare.stack import Floats
from neurolens.lens.glass import inverse_square_um
from neurolens.lens.paraxial import first_order
from neurolens.lens.prescription import Lens
from neurolens.render.checkpoint import digest
from neurolens.render.colour import SRGB, in_gamut
from neurolens.render.spectrum import SpectralRange
from neurolens.trace.rays import Rays, trace
from neurolens.trace.sequence import follow, turning

RANKED = 4096  # rays that decide which ghosts are brightest
_AT_ONCE = 1 << 16  # rays of a call
_ENOUGH = 200  # photons of a kernel: a noise of 8%
_COLOURED = 3200  # photons of a kernel of colour: eyes see its noise in wider areas
_WAIT_S = 0.5  # between two reports
_KEEP_S = 30.0  # between two states of long work
_AXIS = 1 << 15  # rays of the exposure
_GOLDEN = 0.6180339887498949
_STRIP = 1 << 22  # bytes of a canvas
_ROOM = 1 << 26  # bytes of edges that wait to be drawn
_EDGES = 176  # bytes, of a cell
FEWEST = 4  # wavelengths that stand for all
_PATCH_DEG = 2.0  # of an extended light: see `patches`

Doubles = NDArray[np.float64]
_Task = tuple[Light, Pair, Grid, list[float], Doubles]  # with wavelengths [K] and their colours [K, 3]
_T = TypeVar("_T")
_R = TypeVar("_R")


@lru_cache(maxsize=32)
def axis_irradiance(lens: Lens, wavelength_nm: float) -> float:
    """Irradiance at the film's centre from uniform surroundings of radiance 1, in sr: the integral of T cos."""
    film_z = lens.film_z_mm
    assert film_z is not None  # of a tracer's lens

    def share(sines: NDArray[np.float64]) -> NDArray[np.float64]:
        d = torch.from_numpy(np.stack([*sines, -np.sqrt(1 - (sines**2).sum(0))]))
        zero = torch.zeros_like(d[0])
        rays = Rays(zero, zero, zero + film_z, *d)
        found = trace(lens, rays, wavelength_nm, transmittance=True)
        assert found.transmittance is not None
        return torch.where(found.status == 0, found.transmittance, 0.0).numpy()

    coarse = disc(0, _AXIS)
    widest = 1.0
    for _ in range(3):  # narrows to the cone that passes, and a little more
        lit = share(widest * coarse) > 0
        widest *= 1.02 * float(np.hypot(*coarse)[lit].max(initial=0.0)) if lit.any() else 0.3
    return math.pi * widest**2 * float(share(min(widest, 1.0) * coarse).mean())


@dataclass(frozen=True)
class Ghost:
    """One ghost of a light.

    Attributes:
        pair: its surfaces. energy: its light on the film's plane over that of the image of the same light.
        centre_mm: x, y of its mean on the film, lens frame, [2]. size_mm: root mean square distance from it.
        passed: share of the rays at the front disc that arrive.
    """

    pair: Pair
    energy: float
    centre_mm: tuple[float, float]
    size_mm: float
    passed: float


def ghost_table(
    tracer: GhostTracer | GhostModel, light: Light, wavelength_nm: float, count: int = RANKED
) -> list[Ghost]:
    """The ghosts of a light at one wavelength that reach the film's plane at all, brightest first.

    Raises:
        InputError: of a model, a light or a wavelength that it is not made for.
    """
    rays, _ = light_rays(tracer.lens, light, 0, count)
    if isinstance(tracer, GhostModel):
        image = GhostTracer(tracer.lens, []).trace(rays, wavelength_nm, direct=True)
        sums = np.concatenate([tracer.trace(rays, wavelength_nm).sums, image.sums])
    else:
        sums = tracer.sums(rays, wavelength_nm, direct=True)
    of_image, rows = sums[-1, 0], []
    for way, (power, *moments, lit) in zip(tracer.pairs, sums.tolist(), strict=False):
        if power > 0:
            x, y, r2 = (moment / power for moment in moments)
            size = math.sqrt(max(r2 - x * x - y * y, 0.0))
            rows.append(Ghost(way, power / of_image if of_image > 0 else math.inf, (x, y), size, lit / count))
    return sorted(rows, key=lambda ghost: -ghost.energy)


def ghost_layout(lens: Lens, pair: Pair, light: Light, lines: int = 9) -> Layout:
    """The lens with rays of one ghost in the plane through the axis, of light as far off the axis as `light`.

    At most so many rays, evenly chosen of those that arrive.

    Raises:
        InputError: no ray arrives.
    """
    front = lens.surfaces[0].semi_diameter_mm
    off = math.acos(min(-float(light.towards[2]), 1.0))
    height = torch.linspace(-1.2 * front, 1.2 * front, 4001, dtype=torch.float64)
    zero, before = torch.zeros_like(height), -0.4 * front
    rays = Rays(zero, height + before * math.tan(-off), zero + before, zero, zero - math.sin(off), zero + math.cos(off))
    found = follow(lens, rays, turning(len(lens.surfaces), pair.reflections))
    arriving = torch.nonzero(found.status == PASSED)[:, 0]
    if not len(arriving):
        raise InputError(
            lens.path, "ghost", pair.name, f"one of which light {math.degrees(off):.3g} degrees off arrives"
        )
    chosen = arriving[torch.linspace(0, len(arriving) - 1, min(lines, len(arriving))).long()]
    scene = Scene(lens, math.inf)
    way = (scene.film_z_mm - found.rays.z) / found.rays.dz
    places = [(rays.z, rays.y), *((z, y) for _, y, z in found.points)]
    places.append((found.rays.z + way * found.rays.dz, found.rays.y + way * found.rays.dy))
    label = f"{pair.name}, {len(arriving) / len(height):.0%} of the height"
    drawn = tuple(Line(np.array([[float(z[k]), float(y[k])] for z, y in places]), label, 0) for k in chosen)
    turns = ", then ".join(map(str, pair.reflections))
    subtitle = f"light {math.degrees(off):.3g} degrees off the axis, reflected at surface {turns}"
    return replace(layout_profile(scene), rays=drawn, subtitle=subtitle)


@dataclass(frozen=True)
class Raster:
    """The film and its pixels: width and height in mm, and in pixels."""

    film_mm: tuple[float, float]
    width: int
    height: int

    @property
    def per_mm(self) -> float:
        return self.width / self.film_mm[0]


def ghost_picture(
    tracer: GhostTracer | GhostModel,
    lights: Sequence[Light],
    raster: Raster,
    *,
    wavelength_nm: tuple[float, float] = (400.0, 700.0),
    wavelengths: int = 60,
    cell_px: float = 8.0,
    layers: Sequence[int] | None = None,
    threads: int = 2,
    done: Callable[[float], None] = lambda share: None,
) -> Floats:
    """The ghosts of lights, [layers, H, W, 3] linear sRGB, as `ghost_layers` draws them.

    Args:
        layers: of each pair the layer that takes it; None puts all into one.
    """
    layers = [0] * len(tracer.pairs) if layers is None else layers
    picture = np.zeros((1 + max(layers, default=0), raster.height, raster.width, 3), np.float32)
    for number, drawn in ghost_layers(
        tracer, lights, raster, layers, wavelength_nm=wavelength_nm, wavelengths=wavelengths, cell_px=cell_px,
        threads=threads, done=done,
    ):  # fmt: skip
        picture[number] = drawn
    return picture


def ghost_layers(
    tracer: GhostTracer | GhostModel,
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
    """Number and picture [H, W, 3] linear sRGB of each layer that has light, one after the other.

    Each ghost is drawn as the areas of a grid of rays (`flare.area`).

    Args:
        wavelengths: of equal shares of the range, which fewer stand for where a ghost's colours part little. cell_px:
            size of a grid's cells on the film, about: see `grids_of`.
        layers: of each pair the layer that takes it.
        done: told the share of the work that is done.
    """
    lens, spectral = tracer.lens, SpectralRange(*wavelength_nm, bins=wavelengths)
    layer = dict(zip(tracer.pairs, layers, strict=True))
    middle = 0.5 * sum(wavelength_nm)
    unit = raster.per_mm**2 / axis_irradiance(lens, middle) / wavelengths
    half, nm = (raster.film_mm[0] / 2, raster.height / raster.per_mm / 2), spectral.centres_nm
    groups: dict[tuple[int, Smear | None], list[_Task]] = {}
    for patch in (part for light in lights for part in patches(light, _PATCH_DEG)):
        light, size = patch.light, 1.5 * float(np.abs(patch.sides).sum()) * abs(float(first_order(lens).efl_mm))
        around = half[0] + size, half[1] + size  # ghosts beside the film may reach it, smeared
        of_light = grids_of(tracer, light, middle, around, cell_px / raster.per_mm, nm.tolist())
        response = np.asarray(unit * spectral.response * spectral.spectrum(light.rgb), np.float64).T
        for pair, grid in of_light.items():
            moved = raster.per_mm * ghost_moves(tracer, patch, pair, grid, middle) * (-1, 1)
            task = light, pair, grid, *_bands(nm, response, grid)
            groups.setdefault((layer[pair], smear_of(patch, moved)), []).append(task)
    work = _Work(sum(map(len, groups.values())), done)
    for number in sorted({number for number, _ in groups}):
        picture = np.zeros((raster.height, raster.width, 3), np.float32)
        for (_, smear), tasks in ((key, tasks) for key, tasks in groups.items() if key[0] == number):
            if smear is None:
                _draw(tracer, tasks, picture, raster.per_mm, work, threads)
                continue
            coarse = smear.coarse
            kernel = smear.kernel(max(raster.width, raster.height) // 2, coarse)
            more = 3 * (coarse > 1) - 1
            room = [n // coarse + k + more for n, k in zip(picture.shape[:2], kernel.shape, strict=True)]
            canvas = np.zeros((*room, 3), np.float32)
            _draw(tracer, tasks, canvas, raster.per_mm / coarse, work, threads)
            found = smeared(canvas, kernel) / np.float32(coarse**2)
            picture += enlarged(found, coarse, raster.height, raster.width)
        yield number, picture


def _draw(
    tracer: GhostTracer | GhostModel, tasks: Sequence[_Task], canvas: Floats, per_mm: float, work: _Work, threads: int
) -> None:
    """Add ghosts to a picture of so many pixels per mm."""
    height, width, _ = canvas.shape
    high = max(1, _STRIP // (32 * width))
    strips = [range(height)[k : k + high] for k in range(0, height, high)]

    def edges(task: _Task) -> tuple[list[Doubles], Doubles]:
        """The edges of each wavelength's cells, and the light of the cells."""
        light, pair, grid, wavelengths_nm, colours = task
        if not work.step():
            return [], colours[:0]
        rays, area = rays_across(tracer.lens, light, grid.places)
        found = tracer.follow_each(tracer.start(rays), wavelengths_nm, pair, REACH)
        return [edges_of(of_one, grid.columns, (width, height), per_mm) for of_one in found], area * grid.cell * colours

    for batch in _batches(tasks):
        found = [found for _, found in work.results(edges, batch, threads)]
        each = [edges for of_ghost, _ in found for edges in of_ghost]
        drawn = np.concatenate(each), np.array(list(map(len, each))), np.concatenate([of for _, of in found])
        for _ in work.results(partial(_draw_rows, canvas, drawn), strips, threads):
            pass


def _draw_rows(canvas: Floats, drawn: tuple[Doubles, NDArray[np.int64], Doubles], rows: range) -> None:
    draw_edges(canvas, rows, *drawn)


def _batches(tasks: Sequence[_Task]) -> Iterator[list[_Task]]:
    """In order; of one light, and as many at a time as have room for their edges."""
    some, used = list[_Task](), 0
    for task in tasks:
        size = _EDGES * len(task[3]) * task[2].columns * task[2].rows
        if some and (used + size > _ROOM or task[0] is not some[0][0]):
            yield some
            some, used = [], 0
        some.append(task)
        used += size
    if some:
        yield some


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
    "image": lambda found: (found.reflections == 0) & (found.scattered == 0),
    "ghosts": lambda found: (found.reflections > 0) & ~found.glare,
    "glare": lambda found: found.glare,
    "flare": lambda found: (found.reflections > 0) | (found.scattered > 0),
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
        part: of `PARTS`: those that were reflected or scattered ("flare"), at most twice reflected alone ("ghosts"),
            more often or scattered ("glare"), or neither ("image").
        photons: of each light and wavelength. kernel_px: radius of the narrowest kernel: see `_smoothed`.
        keep: file that has what is done of long work, until that is whole; the same call goes on from it.
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
    if (known := kept.load()) is not None:
        first_task, (picture, sums) = known[0]["done"], known[1]
    work = _Work((len(tasks) - first_task) * len(firsts), done)

    def one(task: tuple[int, Light, int]) -> tuple[Floats, NDArray[np.float64]]:
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

    for _, (film, colour) in work.results(one, tasks[first_task:], threads):
        picture += film[0, ..., None] * colour.astype(np.float32)
        sums += film * (np.abs(colour).max() ** np.array([1, 2], np.float32))[:, None, None]
        first_task += 1
        kept.save({"done": first_task}, (picture, sums))
    return _smoothed(picture, sums, kernel_px) if kernel_px > 0 else picture


def _arrivals(
    tracer: PhotonTracer, part: str, rays: Floats, wavelength_nm: float, most_reflections: int, seed: int
) -> Iterator[tuple[Floats, Floats]]:
    """Places on the film [2, M] (mm) and weights [M] of photons of a part."""
    # Of glare, light that surfaces alone reflect turns round by choice, and what scatters goes as it does.
    for scatters in (False, True)[: 1 + tracer.scatter.on] if part == "glare" else (None,):
        boost = tracer.turning(wavelength_nm, LEVELS - 1) if scatters is False else 1.0
        found = tracer.trace(rays, wavelength_nm, most_reflections=most_reflections, seed=seed, boost=boost)
        which = PARTS[part](found)
        if scatters is not None:
            which &= (found.scattered > 0) == scatters
        # A film that sends light back is exposed by what it keeps.
        yield found.film_xy_mm[:, which], found.weight[which] / (1 - tracer.scatter.sensor)


class _Work:
    """Steps of work in threads: how many of them are done is told while they go on; they end soon when that fails."""

    def __init__(self, steps: int, done: Callable[[float], None]) -> None:
        self._steps, self._done, self._count, self._stopping = max(steps, 1), done, 0, False

    def step(self) -> bool:
        """Count a step; whether to go on."""
        self._count += 1
        return not self._stopping

    def results(self, one: Callable[[_T], _R], tasks: Sequence[_T], threads: int) -> Iterator[tuple[_T, _R]]:
        """Each task with its result, in order; so many at a time, and no more."""
        with ThreadPoolExecutor(threads) as pool:
            try:
                for begin in range(0, len(tasks), threads):
                    some = tasks[begin : begin + threads]
                    for task, future in zip(some, [pool.submit(one, task) for task in some], strict=True):
                        while not wait([future], _WAIT_S).done:
                            self._done(min(self._count / self._steps, 1.0))
                        yield task, future.result()
                    self._done(min(self._count / self._steps, 1.0))
            except BaseException:
                self._stopping = True
                raise


def _smoothed(picture: Floats, sums: Floats, radius: float) -> Floats:
    """Smooth a picture [H, W, 3] of photons: its luminance by kernels from `radius` on, its colour by wider kernels."""
    wide = min(picture.shape[:2])
    bright = in_gamut(_spread_wide(picture, sums, radius, _ENOUGH, wide / 8))
    coloured = in_gamut(_spread_wide(picture, sums, radius, _COLOURED, wide / 2))
    luminance = [np.maximum(part @ SRGB.to_xyz[1].astype(np.float32), 1e-30)[..., None] for part in (bright, coloured)]
    return coloured * (luminance[0] / luminance[1])


def _spread_wide(picture: Floats, sums: Floats, radius: float, enough: int, widest: float) -> Floats:
    """A picture [H, W, 3] whose pixels' light is spread by kernels that keep its sum, mirrored at the edges.

    Each by the narrowest kernel of radius r, 2 r, ... that holds `enough` photons of equal weight, or is as little
    noisy by their `sums` of weights and of squares, [2, H, W], with a soft step to the next; by none much wider than
    `widest`, in pixels. Epanechnikov's, 2 / pi (1 - r^2) in units of its radius.
    """
    found, left, last = np.zeros_like(picture), np.ones(picture.shape[:2], np.float32), False
    while not last:
        weight, square = np.moveaxis(spread(np.moveaxis(sums, 0, 2), radius), 2, 0)
        last = radius > widest
        # n photons of equal weight have a sum of squares of n times the kernel's mean square, 4 / (3 pi r^2).
        held = 0.75 * math.pi * radius**2 * weight**2 / np.maximum(square, 1e-30) / enough
        share = np.ones_like(left) if last else (held - 0.5).clip(0, 1)
        found += spread(picture * (left * share)[..., None], radius)
        left, radius = left * (1 - share), 2 * radius
    return found
