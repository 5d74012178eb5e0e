"""Path tracing of a batch: all paths advance together, one surface at a time.

At each surface the paths are sorted by kind of material, so that every kind is one contiguous slice and paths that have
ended drop off the end. Light is found in two ways, by aiming at a light and by scattering into it, weighted by the
power heuristic (Veach 1997); the environment and what mirrors and glass show are found by scattering alone.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from neurolens.cameras.contract import FloatArray
from neurolens.render import sampler as dims
from neurolens.render.palette import Index
from neurolens.render.primitives import Rays, dot
from neurolens.render.sampler import PathKeys, Sampler
from neurolens.render.scatter import SPECULAR, Paths, Vertex, aim_at_lights, deposit, lit, scatter
from neurolens.render.world import GLASS, NOTHING, World

_ROULETTE_FROM = 2  # surfaces that every path may reach before it can end by chance


def trace(
    world: World,
    sampler: Sampler,
    keys: PathKeys,
    origin: FloatArray,
    direction: FloatArray,
    weight: FloatArray,
    bins: Index,
    max_depth: int,
    *,
    aim: bool = True,
    first_distance: FloatArray | None = None,
) -> FloatArray:
    """Weight times radiance [N] that arrives along camera rays; [lanes, N] where paths carry several wavelengths.

    Args:
        keys: random numbers of the paths. origin, direction: [3, N], m.
        weight: [N] or [lanes, N]; paths of weight 0 cost nothing. bins: [N] wavelength bins, of the first lane.
        max_depth: number of surfaces along a path at which light is scattered.
        aim: sample lights directly; without it the mean is the same, found by scattering alone.
        first_distance: [N], where to write the distance in m to what camera rays hit first, inf for nothing; paths of
            weight 0 are left out.
    """
    radiance = np.zeros(weight.shape, np.float32)
    count = weight.shape[-1]
    density, alone = np.full(count, SPECULAR), np.zeros(count, np.bool_)
    paths = Paths(origin, direction, weight, bins, np.arange(count), density, alone).take(lit(weight))
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        for depth in range(max_depth + 1):
            if not paths.slot.size:
                break
            distance, found = world.nearest(Rays.of(paths.origin, paths.direction))
            if depth == 0 and first_distance is not None:
                first_distance[paths.slot] = distance
            point = paths.direction * distance
            point += paths.origin
            surface = world.surfaces(found, point)
            _add_environment(world, paths, found, radiance)
            _add_emission(world, paths, surface, point, distance, aim, radiance)
            if depth == max_depth:
                break
            vertex = _arrive(world, paths, surface, point, distance)
            alive = keys.take(vertex.paths.slot)
            first = dims.FIRST_BOUNCE + depth * dims.BOUNCE_DIMENSIONS
            if aim and vertex.rough and not world.lights.black:
                aim_at_lights(vertex, sampler, alive, first, radiance)
            paths = scatter(vertex, sampler, alive, first)
            if depth >= _ROULETTE_FROM:
                _roulette(paths, sampler.draw(alive, first + dims.ROULETTE))
            alive_rows = lit(paths.throughput)
            if alive_rows.size < paths.slot.size:
                paths = paths.take(alive_rows)
    return radiance


def _add_environment(world: World, paths: Paths, found: NDArray[np.int32], radiance: FloatArray) -> None:
    """Light from paths that leave the scene."""
    if world.dark:
        return
    rows = np.flatnonzero(found < 0)
    if rows.size:
        light = world.environment(paths.direction.take(rows, axis=1), paths.bins.take(rows))
        deposit(radiance, paths.slot[rows], paths.throughput.take(rows, axis=-1) * light)


def _add_emission(
    world: World,
    paths: Paths,
    surface: Index,
    point: FloatArray,
    distance: FloatArray,
    aim: bool,
    radiance: FloatArray,
) -> None:
    """Light from paths that run into a light, weighted against aiming at it."""
    if world.lights.black:
        return
    light = world.light.take(surface)
    rows = np.flatnonzero(light >= 0)
    if not rows.size:
        return
    normal, _ = world.normals(surface[rows], point.take(rows, axis=1))
    cosine = -dot(normal, paths.direction.take(rows, axis=1))
    front = np.flatnonzero(cosine > 0)  # the back of a light is dark
    rows, cosine = rows[front], cosine[front]
    emitted = world.palette.look_up(world.emission_row.take(surface[rows]), paths.bins[rows])
    emitted *= paths.throughput.take(rows, axis=-1)
    if aim:
        aimed = world.lights.pdf(light[rows], paths.origin.take(rows, axis=1), distance[rows], cosine)
        ratio = aimed / paths.density[rows]
        emitted /= 1 + ratio * ratio
    deposit(radiance, paths.slot[rows], emitted)


def _arrive(world: World, paths: Paths, surface: Index, point: FloatArray, distance: FloatArray) -> Vertex:
    """The paths that meet something that scatters, sorted by kind of material."""
    kind = world.kind.take(surface)
    ends = np.cumsum(np.bincount(kind, minlength=NOTHING + 1))
    order = np.argsort(kind, kind="stable")[: ends[GLASS]]
    return Vertex(world, paths.take(order), surface[order], point.take(order, axis=1), distance[order], ends)


def _roulette(paths: Paths, sample: FloatArray) -> None:
    """End faint paths by chance; those that go on carry the light of those that end."""
    brightest = paths.throughput
    if brightest.ndim == 2:
        brightest = brightest.max(axis=0) * np.where(paths.alone, np.float32(1), np.float32(len(brightest)))
    survival = np.clip(brightest, np.float32(0.05), np.float32(1))
    paths.throughput /= survival
    paths.throughput *= sample < survival
