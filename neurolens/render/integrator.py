"""Path tracing of a batch: all paths advance together, one surface at a time.

At each surface the paths are sorted by kind of material, so that every kind is one contiguous slice and paths that have
ended drop off the end. Light is found in two ways, by aiming at a light and by scattering into it, weighted by the power
heuristic (Veach 1997); the environment and what mirrors and glass show are found by scattering alone.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from neurolens.cameras.contract import FloatArray
from neurolens.render import sampler as dims
from neurolens.render.materials import (
    cosine_direction,
    glass_direction,
    glossy_evaluate,
    glossy_sample,
    mirror_direction,
)
from neurolens.render.primitives import Rays, dot
from neurolens.render.sampler import PathKeys, Sampler
from neurolens.render.world import DIFFUSE, GLASS, GLOSSY, MIRROR, NOTHING, World

Index = NDArray[np.intp]
_ONE_OVER_PI = np.float32(1 / np.pi)
_ROULETTE_FROM = 2  # surfaces that every path may reach before it can end by chance
_SPECULAR = np.float32(np.inf)  # density of a direction that has no choice


@dataclass
class Paths:
    """The paths still alive: rays [3, N], throughput [N], wavelength bin [N], place in the batch [N], and the density
    [N] per solid angle with which the ray's direction was chosen."""

    origin: FloatArray
    direction: FloatArray
    throughput: FloatArray
    bins: Index
    slot: Index
    density: FloatArray

    def take(self, rows: Index) -> Paths:
        """Some of the paths."""
        return Paths(
            self.origin.take(rows, axis=1),
            self.direction.take(rows, axis=1),
            self.throughput.take(rows),
            self.bins.take(rows),
            self.slot.take(rows),
            self.density.take(rows),
        )


@dataclass
class Hits:
    """Where paths meet surfaces: points [3, N], surfaces [N], normals [3, N] on the ray's side, and whether that side is
    the outside [N]. `facing` is the true normal, `shading` the interpolated one where the scene has such (`smooth`)."""

    point: FloatArray
    surface: Index
    facing: FloatArray
    shading: FloatArray
    outside: NDArray[np.bool_]
    reach: FloatArray  # how far to step off the surface, m
    smooth: bool

    def start(self, side: FloatArray | None = None) -> FloatArray:
        """Origins [3, N] of rays that leave on the near side, or where `side` is negative on the far side."""
        step = self.reach if side is None else self.reach * side
        return self.point + self.facing * step

    def cut(self, rows: slice) -> Hits:
        """The hits of consecutive paths, without a copy."""
        return Hits(
            self.point[:, rows],
            self.surface[rows],
            self.facing[:, rows],
            self.shading[:, rows],
            self.outside[rows],
            self.reach[rows],
            self.smooth,
        )


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
) -> FloatArray:
    """Weight times radiance [N] that arrives along camera rays.

    Args:
        keys: random numbers of the paths. origin, direction: [3, N], m. weight: [N], paths of weight 0 cost nothing.
        bins: [N] wavelength bins. max_depth: number of surfaces along a path at which light is scattered.
        aim: sample lights directly; without it the mean is the same, found by scattering alone.
    """
    radiance = np.zeros(len(weight), np.float32)
    slot = np.flatnonzero(weight)
    density = np.full(len(weight), _SPECULAR)
    paths = Paths(origin, direction, weight, bins, np.arange(len(weight)), density).take(slot)
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        for depth in range(max_depth + 1):
            if not paths.slot.size:
                break
            distance, found = world.nearest(Rays.of(paths.origin, paths.direction))
            point = paths.direction * distance
            point += paths.origin
            surface = world.surfaces(found, point)
            _add_environment(world, paths, found, radiance)
            _add_emission(world, paths, surface, point, distance, aim, radiance)
            if depth == max_depth:
                break
            kind = world.kind.take(surface)
            order = np.argsort(kind, kind="stable")
            ends = np.cumsum(np.bincount(kind, minlength=NOTHING + 1))
            order = order[: ends[GLASS]]
            paths = paths.take(order)
            hits = _hits(world, paths, surface.take(order), point.take(order, axis=1), distance.take(order))
            alive = keys.take(paths.slot)
            paths = _scatter(world, sampler, alive, paths, hits, ends, depth, aim, radiance)
    return radiance


def _add_environment(world: World, paths: Paths, found: NDArray[np.int32], radiance: FloatArray) -> None:
    """Light from paths that leave the scene."""
    if world.dark:
        return
    rows = np.flatnonzero(found < 0)
    if rows.size:
        light = world.environment(paths.direction.take(rows, axis=1), paths.bins.take(rows))
        radiance[paths.slot[rows]] += paths.throughput[rows] * light


def _add_emission(
    world: World, paths: Paths, surface: Index, point: FloatArray, distance: FloatArray, aim: bool, radiance: FloatArray
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
    emitted *= paths.throughput[rows]
    if aim:
        aimed = world.lights.pdf(light[rows], paths.origin.take(rows, axis=1), distance[rows], cosine)
        ratio = aimed / paths.density[rows]
        emitted /= 1 + ratio * ratio
    radiance[paths.slot[rows]] += emitted


def _hits(world: World, paths: Paths, surface: Index, point: FloatArray, distance: FloatArray) -> Hits:
    """The surfaces as seen by the paths."""
    normal, shading = world.normals(surface, point)
    smooth = shading is not normal
    outside = dot(normal, paths.direction) < 0
    sign = np.where(outside, np.float32(1), np.float32(-1))
    normal *= sign
    if smooth:
        shading *= sign
        # An interpolated normal that turns away from the ray is of no use: take the true one.
        np.copyto(shading, normal, where=dot(shading, paths.direction) > -1e-3)
    # Rounding of the hit grows with the distance travelled.
    reach = distance * np.float32(1e-6)
    reach += np.float32(1e-4)
    return Hits(point, surface, normal, shading, outside, reach, smooth)


def _scatter(
    world: World,
    sampler: Sampler,
    keys: PathKeys,
    paths: Paths,
    hits: Hits,
    ends: Index,
    depth: int,
    aim: bool,
    radiance: FloatArray,
) -> Paths:
    """Light aimed at from each surface, and the paths on their way to the next one."""
    first = dims.FIRST_BOUNCE + depth * dims.BOUNCE_DIMENSIONS
    start = dict(zip((GLOSSY, MIRROR, GLASS), ends[:3], strict=True))
    rough, total = int(ends[GLOSSY]), int(ends[GLASS])
    diffuse, glossy = slice(0, start[GLOSSY]), slice(start[GLOSSY], rough)
    mirror, glass = slice(rough, start[GLASS]), slice(start[GLASS], total)
    base = world.reflectance(hits.surface[: start[GLASS]], hits.point[:, : start[GLASS]], paths.bins[: start[GLASS]])
    out = -paths.direction
    coat = world.palette.look_up(world.specular_row.take(hits.surface[glossy]), paths.bins[glossy])
    alpha = world.alpha.take(hits.surface[glossy])

    def evaluate(inward: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Scattering times cosine and density for directions towards light of the diffuse and glossy paths."""
        cosine = np.maximum(dot(hits.shading[:, diffuse], inward[:, diffuse]), np.float32(0)) * _ONE_OVER_PI
        shiny, shiny_density = glossy_evaluate(
            hits.shading[:, glossy], out[:, glossy], inward[:, glossy], base[glossy], coat, alpha
        )
        return np.concatenate([base[diffuse] * cosine, shiny]), np.concatenate([cosine, shiny_density])

    if rough and aim and not world.lights.black:
        _add_direct(world, sampler, keys.cut(0, rough), first, paths, hits.cut(slice(0, rough)), evaluate, radiance)

    direction, density = np.empty_like(paths.direction), np.full(total, _SPECULAR)
    throughput, side = paths.throughput, None
    square = sampler.draw2(keys.cut(0, rough), first + dims.SCATTER) if rough else np.empty((2, 0), np.float32)
    if start[GLOSSY]:
        direction[:, diffuse], cosine = cosine_direction(hits.shading[:, diffuse], square[:, diffuse])
        density[diffuse] = cosine * _ONE_OVER_PI
        throughput[diffuse] *= base[diffuse]
    if rough > start[GLOSSY]:
        normal, lobe = hits.shading[:, glossy], sampler.draw(keys.cut(start[GLOSSY], rough), first + dims.LOBE)
        direction[:, glossy] = glossy_sample(normal, out[:, glossy], base[glossy], coat, alpha, square[:, glossy], lobe)
        value, density[glossy] = glossy_evaluate(
            normal, out[:, glossy], direction[:, glossy], base[glossy], coat, alpha
        )
        throughput[glossy] *= value / density[glossy]
    if start[GLASS] > rough:
        direction[:, mirror] = mirror_direction(paths.direction[:, mirror], hits.shading[:, mirror])
        throughput[mirror] *= base[mirror]
    if total > start[GLASS]:
        choice = sampler.draw(keys.cut(start[GLASS], total), first + dims.LOBE)
        index = world.palette.look_up(world.index_row.take(hits.surface[glass]), paths.bins[glass])
        direction[:, glass], refracts = glass_direction(
            paths.direction[:, glass], hits.shading[:, glass], hits.outside[glass], index, choice
        )
        side = np.ones(total, np.float32)
        side[glass] = np.where(refracts, np.float32(-1), np.float32(1))
    if hits.smooth:
        # Interpolated normals can send a ray through the surface: it ends there.
        leaving = dot(direction, hits.facing)
        throughput *= (leaving if side is None else leaving * side) > 0

    paths = Paths(hits.start(side), direction, throughput, paths.bins, paths.slot, density)
    if depth >= _ROULETTE_FROM:
        _roulette(sampler, keys, first, paths)
    dark = throughput == 0
    return paths.take(np.flatnonzero(~dark)) if dark.any() else paths


def _add_direct(
    world: World,
    sampler: Sampler,
    keys: PathKeys,
    first: int,
    paths: Paths,
    hits: Hits,
    evaluate: object,
    radiance: FloatArray,
) -> None:
    """Light from one chosen point on one light, where nothing stands in between, weighted against scattering into it."""
    origin = hits.start()
    if world.lights.count == 1:
        choice = np.zeros(len(hits.surface), np.float32)
    else:
        choice = sampler.draw(keys, first + dims.LIGHT_CHOICE)
    aimed = world.lights.sample(origin, choice, sampler.draw2(keys, first + dims.LIGHT))
    value, density = evaluate(aimed.direction)  # type: ignore[operator]
    value *= aimed.inverse_pdf
    if hits.smooth:
        value *= dot(hits.facing, aimed.direction) > 0
    rows = np.flatnonzero(value > 0)
    value, ratio = value[rows], density[rows] * aimed.inverse_pdf[rows]
    value /= 1 + ratio * ratio
    emission_row = world.light_emission_row.take(aimed.light[rows])
    value *= world.palette.look_up(emission_row, paths.bins[rows])
    value *= paths.throughput[rows]
    seen = world.visible(origin.take(rows, axis=1), aimed.direction.take(rows, axis=1), aimed.distance[rows])
    value *= seen
    radiance[paths.slot[rows]] += value


def _roulette(sampler: Sampler, keys: PathKeys, first: int, paths: Paths) -> None:
    """End faint paths by chance; those that go on carry the light of those that end."""
    survival = np.clip(paths.throughput, np.float32(0.05), np.float32(1))
    goes_on = sampler.draw(keys, first + dims.ROULETTE) < survival
    paths.throughput /= survival
    paths.throughput *= goes_on
