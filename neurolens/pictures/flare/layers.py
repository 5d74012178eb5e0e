"""Makes the layers of flare, which are added to a render of the same lens, film and focus.

Values are those of a render: film irradiance over the irradiance that a white card of radiance 1 makes on the axis.
Each maker makes one picture, and others, by name, that are parts of it. A layer that is switched off is absent.
"""

import math
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from neurolens.base.errors import InputError
from neurolens.base.files import Kept
from neurolens.base.progress import Progress, Report
from neurolens.base.tasks import in_order
from neurolens.cameras.contract import FloatArray
from neurolens.cameras.pose import FilmPose
from neurolens.optics.lens.glass import inverse_square_um
from neurolens.optics.lens.paraxial import first_order
from neurolens.optics.lens.prescription import Lens
from neurolens.pictures.flare import canvas
from neurolens.pictures.flare.canvas import Array, Raster, Smear
from neurolens.pictures.flare.diffraction import starburst_picture
from neurolens.pictures.flare.ghosts import GhostTracer, Pair, ghost_pairs
from neurolens.pictures.flare.grids import REACH, Grid, ghost_moves, grids_of
from neurolens.pictures.flare.job import FlareJob
from neurolens.pictures.flare.lights import Light, Patch, SceneLights, keep, light_rays, patches, rays_across
from neurolens.pictures.flare.photons import LEVELS, Photons, PhotonTracer
from neurolens.pictures.flare.steps import entering
from neurolens.pictures.render.colour import SRGB, in_gamut
from neurolens.pictures.render.film import check_memory, digest
from neurolens.pictures.render.scene import Scene
from neurolens.pictures.render.settings import LAYERS

_AT_ONCE = 1 << 16  # photons in a call
_ENOUGH = 200  # photons that a kernel gathers: a noise of 8%
_COLOURED = 3200  # photons that a kernel of colour gathers: eyes see its noise in wider areas
_KEEP_S = 30.0  # between two saved states of long work
_GOLDEN = 0.6180339887498949
_STRIP = 1 << 22  # bytes of a strip of a picture, which one thread draws
_ROOM = 1 << 26  # bytes of edges that wait to be drawn
_EDGES = 176  # bytes of a cell's edges
FEWEST = 4  # of wavelengths that stand for all
_KNOWN = 30  # wavelengths, at least, at which light is known: coatings reflect some colours ten times as much as others
_PATCH_DEG = 2.0  # side of a patch of an extended light: see `patches`
# patches along a side, at most; cells of a ghost along a side, which stay where patches are many
_PATCHES, _CELLS = (4, 6, 9), 48
_BEGUN, _SMEARED = 14_000, 0.45  # in the time of a cell: to begin a group of ghosts, and to smear a pixel
_MUCH, _TRIALS = 1e7, 6  # cells that take seconds; groups whose time is measured before such work
# shares: of a ghost's light that may come or go over a patch; of all light, below which a ghost is faint
_UNEVEN, _FAINT = 0.6, 5e-4
Layers = dict[str, FloatArray]
REST = "rest"


class _Task(NamedTuple):
    """A ghost of a light, at some wavelengths [K] with their colours [K, 3]."""

    light: Light
    pair: Pair
    grid: Grid
    wavelengths_nm: list[float]
    colours: Array

    @property
    def work(self) -> int:
        """The cells that are drawn."""
        return len(self.wavelengths_nm) * self.grid.columns * self.grid.rows


def _quietly(fraction: float, seconds_left: float | None = None) -> None:
    """Report nothing."""


def ghost_layers(job: FlareJob, layers: Sequence[int], done: Report = _quietly) -> Iterator[tuple[int, FloatArray]]:
    """Yield the number and the picture [H, W, 3] (linear sRGB) of each layer that has light.

    Each ghost is drawn as the areas of a grid of rays (`pictures.flare.canvas`). Where a ghost's colours hardly part,
    fewer wavelengths stand for all, each with the light of its neighbours.

    Args:
        layers: for each pair of the tracer, the layer that takes it. done: called with the share of the work that is
            done, and for long work with the seconds left, which a trial tells first.
    """
    tracer, raster, spectral = job.tracer, job.raster, job.spectral(job.finer, _KNOWN)
    layer = dict(zip(tracer.pairs, layers, strict=True))
    unit, nm = raster.per_mm**2 / job.exposure / spectral.bins, spectral.centres_nm
    groups: dict[tuple[int, int, Smear | None], list[_Task]] = {}
    for light in job.lights:
        for patch, pair, grid, moves in _parts(job, tracer, light, nm.tolist()):
            response = np.asarray(unit * spectral.response * spectral.spectrum(patch.light.rgb), np.float64).T
            smear = canvas.smear_of(patch.weights, patch.round, raster.per_mm * moves * (-1, 1))
            coarse = 1 if smear is None else smear.coarse
            grid = grid.coarser(coarse, _CELLS)
            task = _Task(patch.light, pair, grid, *_bands(nm, response, grid, job.finer * job.settings.bins))
            groups.setdefault((layer[pair], coarse, smear), []).append(task)
    ordered = [_Group(*key, tasks) for key, tasks in groups.items()]
    whole, expected = max(sum(group.work(raster) for group in ordered), 1.0), _expected_s(job, ordered)
    done(0.0, expected)
    began, worked, pictures = time.perf_counter(), 0.0, dict[int, FloatArray]()
    for number in sorted({group.layer for group in ordered}):
        pictures.clear()
        for group in (group for group in ordered if group.layer == number):
            picture = pictures.setdefault(group.coarse, np.zeros((*group.size(raster), 3), np.float32))
            for work in _add(job, group, picture):
                worked += work
                left, taken = 1 - worked / whole, time.perf_counter() - began
                done(1 - left, None if expected is None else left * (left * expected + taken))
        drawn = (canvas.enlarged(picture, k, raster.height, raster.width) for k, picture in pictures.items())
        yield number, sum(drawn, np.zeros((raster.height, raster.width, 3), np.float32))


class _Group(NamedTuple):
    """Ghosts of one layer that are smeared alike and drawn together, in pixels `coarse` times as wide."""

    layer: int
    coarse: int
    smear: Smear | None
    tasks: list[_Task]

    def size(self, raster: Raster) -> list[int]:
        """Return the rows and columns of its picture, with a border where that is to be enlarged."""
        return [n // self.coarse + 3 * (self.coarse > 1) for n in (raster.height, raster.width)]

    def work(self, raster: Raster) -> float:
        """Return about how long it takes, in units of a cell at one wavelength."""
        smeared = 0 if self.smear is None else _SMEARED * math.prod(self.size(raster))
        return _BEGUN + smeared + sum(task.work for task in self.tasks)


def _add(job: FlareJob, group: _Group, picture: FloatArray) -> Iterator[float]:
    """Add a group of ghosts to a picture of its size, ghost by ghost; yields the work done since the last one."""
    raster, kernel, drawing = job.raster, None, picture
    if group.smear is not None:
        kernel = group.smear.kernel(max(raster.width, raster.height) // 2, group.coarse)
        room = [n + k - 1 for n, k in zip(group.size(raster), kernel.shape, strict=True)]
        drawing = np.zeros((*room, 3), np.float32)
    yield from _draw(job.tracer, group.tasks, drawing, raster.per_mm / group.coarse, job.threads)
    if kernel is not None:
        picture += canvas.smeared(drawing, kernel) / np.float32(group.coarse**2)
    yield group.work(raster) - sum(task.work for task in group.tasks)


def _expected_s(job: FlareJob, groups: Sequence[_Group]) -> float | None:
    """Estimate the seconds that ghosts will take; None for little work.

    One ghost of each of a few groups, at equal steps of the work, is drawn for trial.
    """
    steps = np.cumsum([group.work(job.raster) for group in groups])
    if not groups or steps[-1] < _MUCH:
        return None
    pace = []
    for at in np.unique(np.searchsorted(steps, steps[-1] * (np.arange(_TRIALS) + 0.5) / _TRIALS)):
        began, group = time.perf_counter(), groups[at]._replace(tasks=groups[at].tasks[:1])
        work = sum(_add(job, group, np.zeros((*group.size(job.raster), 3), np.float32)))
        pace.append((time.perf_counter() - began) / work)
    return float(steps[-1] * np.median(pace))  # of the paces the median, for the first trial imports and compiles


def _parts(
    job: FlareJob, tracer: GhostTracer, light: Light, nm: Sequence[float]
) -> Iterator[tuple[Patch, Pair, Grid, Array]]:
    """Yield the patches of a light, and the ghosts of each with their grids and moves.

    A ghost that rims cut differently over a patch, so that much of its light comes or goes, has finer patches.
    """
    raster, middle_nm = job.raster, 0.5 * sum(job.wavelength_nm)
    half_mm, cell = (raster.film_mm[0] / 2, raster.height / raster.per_mm / 2), job.settings.cell_px / raster.per_mm
    efl, needs = abs(float(first_order(tracer.lens).efl_mm)), dict.fromkeys(tracer.pairs, _PATCHES[0])
    for most in _PATCHES:
        pairs = [pair for pair in tracer.pairs if needs[pair] == most]
        found, sums = list[tuple[Patch, Pair, Grid, Array]](), dict.fromkeys(pairs, np.zeros(2))
        for patch in patches(light, _PATCH_DEG * _PATCHES[0] / most, most) if pairs else ():
            size = 1.5 * float(np.abs(patch.sides).sum()) * efl
            around = half_mm[0] + size, half_mm[1] + size  # a smear may bring ghosts in from beside the film
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


def _draw(
    tracer: GhostTracer, tasks: Sequence[_Task], picture: FloatArray, per_mm: float, threads: int
) -> Iterator[float]:
    """Add ghosts to a picture with `per_mm` pixels per mm; yields the work done each time."""
    height, width, _ = picture.shape
    high = max(1, _STRIP // (32 * width))
    strips = [range(height)[k : k + high] for k in range(0, height, high)]

    def edges(task: _Task) -> tuple[list[Array], Array]:
        """Return the edges of each wavelength's cells, and the light of the cells."""
        rays, area = rays_across(tracer.lens, task.light, task.grid.places)
        rows = tracer.follow_each(entering(rays), task.wavelengths_nm, task.pair, REACH)
        each = [canvas.edges_of(of_one, task.grid.columns, (width, height), per_mm) for of_one in rows]
        return each, area * task.grid.cell * task.colours

    for batch in _batches(tasks):
        found, colours = zip(*in_order(threads, edges, batch), strict=True)
        each = [edges for of_ghost in found for edges in of_ghost]
        strip = partial(
            canvas.draw_edges, picture, edges=np.concatenate(each), counts=np.array(list(map(len, each))),
            light=np.concatenate(colours),
        )  # fmt: skip
        for _ in in_order(threads, strip, strips):
            pass
        yield sum(task.work for task in batch)


def _batches(tasks: Sequence[_Task]) -> Iterator[list[_Task]]:
    """Yield tasks in order: those of one light, as many at a time as have room for their edges."""
    batch, used = list[_Task](), 0
    for task in tasks:
        size = _EDGES * task.work
        if batch and (used + size > _ROOM or task.light is not batch[0].light):
            yield batch
            batch, used = [], 0
        batch.append(task)
        used += size
    if batch:
        yield batch


def _bands(nm: Array, response: Array, grid: Grid, most: int) -> tuple[list[float], Array]:
    """Choose at most `most` wavelengths that stand for all of `nm` [W] in a ghost.

    They come with colours [K, 3], from responses [W, 3].

    There are at most `most`.

    One wavelength is traced for each band. The other wavelengths of the band take its places on the film and have their
    own power, because a coating may reflect ten times as much at one end of a band as at the other. Ghosts with equally
    many bands share the traced wavelengths, unless a ghost is too dark at one of them to stand for its band.
    """
    count = min(max(grid.wavelengths, FEWEST), most)
    w = inverse_square_um(nm)  # glass spreads light about evenly in this
    at = (
        np.arange(count) if count == len(nm) else (count * (w[0] - w) / (1.000001 * (w[0] - w[-1]) + 1e-30)).astype(int)
    )
    nodes, level = zip(*(grid.spectrum or ((nm[0], 1.0),)), strict=True)
    power = np.interp(nm, nodes, np.maximum(level, 1e-3 * max(level) + 1e-30))
    traced, colours = list[float](), list[Array]()
    for band in (np.flatnonzero(at == k) for k in np.unique(at)):
        chosen = float(np.average(nm[band], weights=np.abs(response[band]).sum(1) + 1e-30))
        if 2 * np.interp(chosen, nm, power) < power[band].mean():
            bright = nm[band[2 * power[band] >= power[band].mean()]]
            chosen = float(bright[np.abs(bright - chosen).argmin()])
        traced.append(chosen)
        colours.append(power[band] @ response[band] / np.interp(chosen, nm, power))
    return traced, np.array(colours)


# Photons by what became of them. Those of "ghosts" and "glare" together are the flare.
PARTS: dict[str, Callable[[Photons], NDArray[np.bool_]]] = {
    "image": lambda photons: (photons.reflections == 0) & (photons.scattered == 0),
    "ghosts": lambda photons: (photons.reflections > 0) & ~photons.glare,
    "glare": lambda photons: photons.glare,
    "flare": lambda photons: (photons.reflections > 0) | (photons.scattered > 0),
}


def photon_picture(job: FlareJob, part: str, photons: int, done: Report = _quietly) -> FloatArray:
    """Return the photons of lights on the film as a picture, [H, W, 3] linear sRGB, by density estimation.

    Args:
        part: one of `PARTS`: photons that were reflected or scattered ("flare"), reflected twice at most ("ghosts"),
            reflected more often or scattered ("glare"), or neither ("image").
        photons: for each light and wavelength; few wavelengths are cut into more, which share their photons. done:
            called with the share of the work.
    """
    settings, raster, spectral = job.settings, job.raster, job.spectral(least=_KNOWN)
    photons = -(-photons * settings.bins // spectral.bins)
    lens, tracer, count = job.lens, PhotonTracer(job.lens, settings.scatter, job.pose), spectral.bins
    edges = (np.arange(raster.height + 1) - raster.height / 2, np.arange(raster.width + 1) - raster.width / 2)
    firsts = range(0, photons, _AT_ONCE)
    whole = [(number, light, k) for number, light in enumerate(job.lights) for k in range(count)]
    picture = np.zeros((raster.height, raster.width, 3), np.float32)
    sums = np.zeros((2, raster.height, raster.width), np.float32)
    same = lens, tracer.scatter, list(job.lights), raster, part, spectral.centres_nm, photons
    known = digest((*same, job.pose, settings.most_reflections, settings.seed))
    kept, begun = Kept(job.keep and kept_file(job.keep, part), known, _KEEP_S), 0
    if (state := kept.load()) is not None:
        done_before, arrays = state[0].get("done", -1), state[1]
        if done_before in range(len(whole) + 1) and [a.shape for a in arrays] == [picture.shape, sums.shape]:
            begun, (picture, sums) = done_before, arrays

    def one(task: tuple[int, Light, int, int]) -> tuple[FloatArray, float]:
        """Return the sums of weights and of their squares, [2, H, W], and the area of the light."""
        number, light, k, first = task
        shift = (k / count + settings.seed * _GOLDEN % 1) % 1
        rays, area = light_rays(lens, light, first, min(_AT_ONCE, photons - first), shift, photons**-0.5)
        # Each task has a seed of its own, the same for any number of threads.
        chances = ((settings.seed << 44) + (number * count + k) * photons + first) % (1 << 64)
        film = np.zeros((2, raster.height, raster.width), np.float32)
        nm = float(spectral.centres_nm[k])
        for xy, weight in _arrivals(tracer, part, rays, nm, settings.most_reflections, chances):
            x, y = xy * raster.per_mm
            for power in (1, 2):
                film[power - 1] += np.histogram2d(y, -x, bins=edges, weights=weight**power)[0]
        return film, area

    tasks = ((*of_light, first) for of_light in whole[begun:] for first in firsts)
    answers, steps, ready = in_order(job.threads, one, tasks), max(len(firsts) * (len(whole) - begun), 1), 0
    for number, (_, light, k) in enumerate(whole[begun:], begun + 1):
        film, area = np.zeros_like(sums), 0.0
        for _, (some, of_light) in zip(firsts, answers, strict=False):
            film, area, ready = film + some, of_light, ready + 1
            done(ready / steps)
        colour = spectral.response[:, k] * spectral.spectrum(light.rgb)[k] / count
        colour = colour * (area * raster.per_mm**2 / photons / job.exposure)
        picture += film[0, ..., None] * colour.astype(np.float32)
        sums += film * (np.abs(colour).max() ** np.array([1, 2], np.float32))[:, None, None]
        kept.save({"done": number}, (picture, sums))
    return _smoothed(picture, sums, settings.kernel_px) if settings.kernel_px > 0 else picture


def kept_file(picture: Path, part: str) -> Path:
    """Return the file of photons that interrupted work leaves beside a picture."""
    return picture.with_name(f"{picture.name}.{part}.part")


def _arrivals(
    tracer: PhotonTracer, part: str, rays: FloatArray, wavelength_nm: float, most_reflections: int, seed: int
) -> Iterator[tuple[FloatArray, FloatArray]]:
    """Yield places on the film [2, M] (mm) and weights [M] of the photons of a part."""
    # Surfaces reflect so little that photons are made to turn round. Those that scatter, and the image, are not.
    times = {"ghosts": (2,), "glare": (LEVELS - 1, 0), "flare": (2, 0)}.get(part, (0,))
    for turns in times[: 1 + tracer.scatter.on]:
        boost = tracer.turning(wavelength_nm, turns) if turns else 1.0
        photons = tracer.trace(rays, wavelength_nm, most_reflections=most_reflections, seed=seed, boost=boost)
        which = PARTS[part](photons)
        if len(times) > 1:
            which &= (photons.scattered > 0) == (turns == 0)
        # A film that sends light back is exposed by the light that it keeps.
        yield photons.film_xy_mm[:, which], photons.weight[which] / (1 - tracer.scatter.sensor)


def _smoothed(picture: FloatArray, sums: FloatArray, radius: float) -> FloatArray:
    """Smooth a picture [H, W, 3] of photons: its luminance by kernels of `radius` or more, its colour by wider ones."""
    wide = min(picture.shape[:2])
    bright = in_gamut(_spread_wide(picture, sums, radius, _ENOUGH, wide / 8))
    coloured = in_gamut(_spread_wide(picture, sums, radius, _COLOURED, wide / 2))
    luminance = [np.maximum(part @ SRGB.to_xyz[1].astype(np.float32), 1e-30)[..., None] for part in (bright, coloured)]
    return coloured * (luminance[0] / luminance[1])


def _spread_wide(picture: FloatArray, sums: FloatArray, radius: float, enough: int, widest: float) -> FloatArray:
    """Spread the light of a picture [H, W, 3] by kernels that keep its sum, mirrored at the edges.

    Each pixel takes the narrowest kernel of radius r, 2 r, ... that holds `enough` photons of equal weight. Photons of
    unequal weight must have no more noise than these; `sums` [2, H, W] of weights and of squares tell it. The step to
    the next kernel is soft, and none is much wider than `widest` pixels. The kernel is Epanechnikov's, 2 / pi (1 - r^2)
    in units of its radius.
    """
    total, left, last = np.zeros_like(picture), np.ones(picture.shape[:2], np.float32), False
    while not last:
        weight, square = np.moveaxis(canvas.spread(np.moveaxis(sums, 0, 2), radius), 2, 0)
        last = radius > widest
        # n photons of equal weight have a sum of squares of n times the kernel's mean square, 4 / (3 pi r^2).
        held = 0.75 * math.pi * radius**2 * weight**2 / np.maximum(square, 1e-30) / enough
        share = np.ones_like(left) if last else (held - 0.5).clip(0, 1)
        total += canvas.spread(picture * (left * share)[..., None], radius)
        left, radius = left * (1 - share), 2 * radius
    return total


def flare_layers(job: FlareJob, progress: Progress | None = None) -> Layers:
    """Make the layers that are switched on, by name, [H, W, 3] linear sRGB each; those of `MAKERS` sum to the flare.

    Raises:
        InputError: as the makers.
    """
    layers: Layers = {}
    progress = progress or Progress(quiet=True)
    for name, make in MAKERS.items():
        if job.settings.makes(name):
            with progress.stage(name) as report:
                made = make(job, report)
            for picture in made.values():
                picture *= np.array(job.settings.gain(name), np.float32)
            layers |= made
    return layers


class Choice(NamedTuple):
    """What is chosen once for the flare of all frames of a scene.

    Attributes:
        single: names of the ghosts that become layers.
        fade: whether lights fade where they leave the view (`keep`).
    """

    single: tuple[str, ...]
    fade: bool


Filmed = tuple[Scene, Lens, FilmPose]


def scene_choice(frames: Sequence[Filmed], raster: Raster, threads: int, *, fade: bool = False) -> Choice:
    """Choose the ghosts that `brightest` names in some frames of a scene that has the table [flare].

    Args:
        frames: the scene with its camera in the frame's place, the lens in its state, and how the film stands.
        fade: whether lights fade before they are left out, as in an animation.
    """
    sources = SceneLights(frames[0][0])
    return Choice(brightest([_scene_job(sources, frame, raster, threads, fade) for frame in frames]), fade)


def _scene_job(sources: SceneLights, filmed: Filmed, raster: Raster, threads: int, fade: bool) -> FlareJob:
    """Return the job of a scene's flare by the scene's own lights."""
    scene, lens, pose = filmed
    settings = scene.settings.flare
    assert settings is not None and lens.film_z_mm is not None
    lights = keep(sources.seen(scene, lens.film_z_mm), settings.most, fade).lights
    return FlareJob(lens, lights, raster, settings, scene.settings.camera.wavelength_nm, threads, pose=pose)


def scene_flare(
    filmed: Filmed, raster: Raster, white_balance: str | None, threads: int, progress: Progress,
    choice: Choice | None = None,
) -> Layers:  # fmt: skip
    """Make the layers of a scene that has the table [flare], by its own lights, for a lens whose film is placed.

    Args:
        choice: that of all frames; None chooses by this picture alone.

    Raises:
        InputError: as `flare_layers`.
    """
    choice, sources = choice or scene_choice([filmed], raster, threads), SceneLights(filmed[0])
    job = replace(_scene_job(sources, filmed, raster, threads, choice.fade), single=choice.single)
    matrix = sources.balance(white_balance).T.astype(np.float32)
    return {name: picture @ matrix for name, picture in flare_layers(job, progress).items()}


def sum_of(layers: Mapping[str, FloatArray], raster: Raster) -> FloatArray:
    """Return the whole flare, [H, W, 3]: the layers of `MAKERS`, without their parts."""
    none = np.zeros((raster.height, raster.width, 3), np.float32)
    return sum((layers[name] for name in MAKERS if name in layers), none)


def brightest(frames: Sequence[FlareJob], done: Report = _quietly) -> tuple[str, ...]:
    """Name the ghosts whose own pictures, with their gains, have the greatest values on the film in any frame.

    There are at most `settings.brightest` names, the brightest first. A ghost without light on the film is never named.
    """
    raster, count, peaks = frames[0].raster, frames[0].settings.brightest, dict[str, float]()
    if not count:
        return ()
    every = [job.tracer.pairs for job in frames]
    check_memory(raster.width, raster.height, 12 * (2 * min(count, max(map(len, every))) + 4))
    for number, (job, pairs) in enumerate(zip(frames, every, strict=True)):
        factors = _factors(job)
        report = partial(lambda begun, share, _=None: done((begun + share) / len(frames)), number)
        for k, picture in ghost_layers(job, range(len(pairs)), report):
            peak = float((picture.max(0).max(0) * factors[pairs[k]]).max())
            peaks[pairs[k].name] = max(peak, peaks.get(pairs[k].name, 0.0))
    return tuple(sorted((name for name in peaks if peaks[name] > 0), key=lambda name: -peaks[name])[:count])


def _ghosts(job: FlareJob, done: Report) -> Layers:
    if job.settings.photons:
        return {"ghosts": photon_picture(job, "ghosts" if job.settings.glare else "flare", job.settings.photons, done)}
    pairs, raster, factors = job.tracer.pairs, job.raster, _factors(job)
    # Ghosts of one layer with equal factors share a picture.
    keys = [(p.name if p.name in job.single else REST, factors[p]) for p in pairs]
    kinds = list(dict.fromkeys(keys))
    check_memory(raster.width, raster.height, 12 * (len(kinds) + len(job.single) + 4))
    parts = {name: np.zeros((raster.height, raster.width, 3), np.float32) for name in (*job.single, REST)}
    for number, picture in ghost_layers(job, [kinds.index(key) for key in keys], done):
        name, factor = kinds[number]
        parts[name] += picture * np.array(factor, np.float32)
    return {"ghosts": np.sum(list(parts.values()), 0), **(parts if job.single else {})}


def kept_beside(picture: Path) -> list[Path]:
    """Return the files of photons that interrupted work has left beside a picture."""
    return [path for part in PARTS if (path := kept_file(picture, part)).is_file()]


def _factors(job: FlareJob) -> dict[Pair, tuple[float, float, float]]:
    """Return the gain of each pair."""
    names = [pair.name for pair in ghost_pairs(job.lens)]
    for name in job.settings.gains:
        if name not in (*MAKERS, *names):
            expected = f"a layer ({', '.join(MAKERS)}) or a ghost ({[*names, 'g01-00'][0]}) of this lens"
            raise InputError("flare", "gain", name, expected)
    return {pair: job.settings.gain(pair.name) for pair in job.tracer.pairs}


MAKERS: dict[str, Callable[[FlareJob, Report], Layers]] = {
    "ghosts": _ghosts,
    "glare": lambda job, done: {"glare": photon_picture(job, "glare", job.settings.glare, done)},
    "starburst": lambda job, done: {"starburst": starburst_picture(job, done)},
}
assert tuple(MAKERS) == LAYERS
