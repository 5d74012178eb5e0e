"""Path tracing of a batch: all paths advance together, one surface at a time.

At each surface the paths are sorted by kind of material, so that every kind (diffuse, glossy, mirror, glass) is one
contiguous slice, and paths that have ended drop off the end. Light is found in two ways, by aiming at a light and by
scattering into it, weighted by the power heuristic (Veach 1997). What mirrors and glass show is found by scattering
alone, what points and spots light by aiming alone.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from neurolens.cameras.contract import FloatArray
from neurolens.pictures.render import sampler as dims
from neurolens.pictures.render.colour import Index
from neurolens.pictures.render.materials import GlossyLobes, fresnel_dielectric, glass_direction
from neurolens.pictures.render.primitives import Rays, dot
from neurolens.pictures.render.sampler import PathKeys, Sampler, cosine_direction
from neurolens.pictures.render.world import GLASS, GLOSSY, MIRROR, NOTHING, World

_ONE_OVER_PI = np.float32(1 / np.pi)
_STEP_M = np.float32(1e-4)
SPECULAR = np.float32(np.inf)  # the density of a direction that is the only one


@dataclass
class Paths:
    """The paths of a batch that are still alive.

    Attributes:
        origin, direction: [3, N] of their rays. throughput: [lanes, N] of the wavelengths of a path, the hero first.
        bins: [N] the hero's wavelength bin.
        slot: [N] the path's place in the batch.
        density: [N] per solid angle with which the ray's direction was chosen.
        shared: [N] how many wavelengths share the path; 1 once glass has bent the hero away from the others.
    """

    origin: FloatArray
    direction: FloatArray
    throughput: FloatArray
    bins: Index
    slot: Index
    density: FloatArray
    shared: FloatArray

    @classmethod
    def of(
        cls,
        origin: FloatArray,
        direction: FloatArray,
        weight: FloatArray,
        bins: Index,
        shared: FloatArray | None = None,
    ) -> Paths:
        """Return the paths of camera rays of a weight [lanes, N]; without `shared`, all lanes share each."""
        count = weight.shape[-1]
        together = np.full(count, len(weight), np.float32) if shared is None else shared
        return cls(origin, direction, weight, bins, np.arange(count), np.full(count, SPECULAR), together)

    def take(self, rows: Index) -> Paths:
        """Return the paths of these rows."""
        vectors = (self.origin.take(rows, axis=1), self.direction.take(rows, axis=1))
        throughput, bins, slot = self.throughput.take(rows, axis=-1), self.bins.take(rows), self.slot.take(rows)
        return Paths(*vectors, throughput, bins, slot, self.density.take(rows), self.shared.take(rows))


def lit(value: FloatArray | NDArray[np.bool_]) -> Index:
    """Return the numbers of the paths for which any lane of [lanes, N] is not 0."""
    return np.flatnonzero(value.any(axis=0))


def deposit(radiance: FloatArray, slot: Index, value: FloatArray) -> None:
    """Add values [lanes, n] to the slots [n] of a batch's radiance [N, lanes], none of which occurs twice."""
    lanes = len(value)
    # The lanes of a slot move as one number: half the time of four.
    together = radiance.view(np.complex128 if lanes == 4 else f"V{4 * lanes}")[:, 0]
    found = together.take(slot)
    for part, light in zip(found.view(np.float32).reshape(-1, lanes).T, value, strict=True):
        part += light
    together[slot] = found


class Vertex:
    """Paths at the surfaces they have met.

    Args:
        surface: [N] numbers, sorted by kind. point: [3, N]. distance: [N] m, travelled since the last surface.
        ends: [kinds] where the slice of each kind ends.

    Attributes:
        facing: [3, N] true normals on the ray's side. shading: [3, N] interpolated normals, where the scene has such
            (`smooth`). outside: [N] whether the ray's side is the outside. rough: how many paths are diffuse or glossy.
    """

    def __init__(
        self, world: World, paths: Paths, surface: Index, point: FloatArray, distance: FloatArray, ends: Index
    ) -> None:
        self.world, self.paths, self._surface, self._point = world, paths, surface, point
        glossy, rough, mirror, glass = (int(end) for end in ends[:4])
        self.diffuse, self.glossy = slice(0, glossy), slice(glossy, rough)
        self.mirror, self.glass, self.rough = slice(rough, mirror), slice(mirror, glass), rough
        assert (GLOSSY, MIRROR, GLASS) == (1, 2, 3)

        normal, shading = world.normals(surface, point)
        self.smooth = shading is not normal
        self.outside = dot(normal, paths.direction) < 0
        sign = np.where(self.outside, np.float32(1), np.float32(-1))
        normal *= sign
        if self.smooth:
            shading *= sign
            # An interpolated normal that faces away from the ray is replaced by the true one.
            np.copyto(shading, normal, where=dot(shading, paths.direction) > -1e-3)
        self.facing, self.shading = normal, shading
        # How far (m) a ray steps off the surface: the rounding of a hit grows with the distance travelled.
        self._reach = distance * np.float32(1e-6)
        self._reach += _STEP_M

        self.base = world.reflectance(surface[:mirror], point[:, :mirror], paths.bins[:mirror])
        if rough > glossy:
            self.gloss = self._lobes(surface[self.glossy])
        if world.absorbs and glass > mirror:
            self._absorb(surface[self.glass], distance[self.glass])

    def _lobes(self, surface: Index) -> GlossyLobes:
        world, g = self.world, self.glossy
        coat = world.palette.look_up(world.specular_row.take(surface), self.paths.bins[g])
        table, row = world.coat, world.coat_row.take(surface)
        out = -self.paths.direction[:, g]
        return GlossyLobes(self.shading[:, g], out, self.base[:, g], coat, world.alpha.take(surface), table, row)

    def _absorb(self, surface: Index, distance: FloatArray) -> None:
        """Dim the paths that reach their glass from inside, by Beer and Lambert's law."""
        inside = np.flatnonzero(~self.outside[self.glass])
        rows = inside + self.glass.start
        absorbed = self.world.palette.look_up(self.world.absorption_row.take(surface[inside]), self.paths.bins[rows])
        absorbed *= -(distance[inside] + _STEP_M)  # the ray set out this far from where it entered
        self.paths.throughput[:, rows] *= np.exp(absorbed)

    def start(self, side: FloatArray | None = None) -> FloatArray:
        """Return origins [3, N] of rays that leave on the near side, or where `side` is negative on the far side."""
        return self._point + self.facing * (self._reach if side is None else self._reach * side)

    def evaluate(self, inward: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return scattering times cosine, and density, [rough] each, for directions [3, rough] towards light."""
        d, g = self.diffuse, self.glossy
        cosine = np.maximum(dot(self.shading[:, d], inward[:, d]), np.float32(0))
        cosine *= _ONE_OVER_PI
        value = self.base[:, d] * cosine
        if g.start == g.stop:
            return value, cosine
        shiny, density = self.gloss.evaluate(inward[:, g])
        return np.concatenate([value, shiny], axis=-1), np.concatenate([cosine, density])

    def index(self) -> FloatArray:
        """Return the refractive index of the glass paths."""
        rows = self.world.index_row.take(self._surface[self.glass])
        return self.world.palette.look_up(rows, self.paths.bins[self.glass])


def aim_at_lights(vertex: Vertex, sampler: Sampler, keys: PathKeys, first: int, radiance: FloatArray) -> None:
    """Add the light of one point on one light, unless something is between.

    Its weight allows for paths that are scattered into the light (multiple importance sampling).
    """
    rough, world, paths = vertex.rough, vertex.world, vertex.paths
    keys = keys.cut(0, rough)
    origin = vertex.start()[:, :rough]
    alone = world.lights.count == 1
    choice = np.zeros(rough, np.float32) if alone else sampler.draw(keys, first + dims.LIGHT_CHOICE)
    aimed = world.lights.sample(origin, choice, sampler.draw2(keys, first + dims.LIGHT))
    value, density = vertex.evaluate(aimed.direction)
    value *= aimed.scale
    if vertex.smooth:
        value *= dot(vertex.facing[:, :rough], aimed.direction) > 0
    rows = lit(value > 0)
    value, ratio = value.take(rows, axis=-1), density[rows] * aimed.inverse_pdf[rows]
    value /= 1 + ratio * ratio
    value *= world.aimed_emission(aimed, rows, paths.bins[rows])
    value *= paths.throughput.take(rows, axis=-1)
    value *= world.visible(origin.take(rows, axis=1), aimed.direction.take(rows, axis=1), aimed.distance[rows])
    deposit(radiance, paths.slot[rows], value)


def scatter(vertex: Vertex, sampler: Sampler, keys: PathKeys, first: int) -> Paths:
    """Send the paths on to the next surface; a throughput of 0 ends a path."""
    paths = vertex.paths
    direction, density = np.empty_like(paths.direction), np.full(len(paths.slot), SPECULAR)
    if vertex.rough:
        density[: vertex.rough] = _scatter_rough(vertex, sampler, keys, first, direction)
    if vertex.mirror.stop > vertex.mirror.start:
        m = vertex.mirror
        travel, normal = paths.direction[:, m], vertex.shading[:, m]
        direction[:, m] = travel - normal * (2 * dot(travel, normal))
        paths.throughput[:, m] *= vertex.base[:, m]
    side = None
    if vertex.glass.stop > vertex.glass.start:
        refracts = _scatter_glass(vertex, sampler, keys, first, direction)
        side = np.ones(len(paths.slot), np.float32)
        side[vertex.glass] -= 2 * refracts
    if vertex.smooth:
        # Interpolated normals can send a ray through the surface: it ends there.
        leaving = dot(direction, vertex.facing)
        paths.throughput *= (leaving if side is None else leaving * side) > 0
    return Paths(vertex.start(side), direction, paths.throughput, paths.bins, paths.slot, density, paths.shared)


def _scatter_rough(vertex: Vertex, sampler: Sampler, keys: PathKeys, first: int, direction: FloatArray) -> FloatArray:
    """Write the directions of the diffuse and glossy paths, update their throughput, return the densities."""
    d, g, paths = vertex.diffuse, vertex.glossy, vertex.paths
    square = sampler.draw2(keys.cut(0, vertex.rough), first + dims.SCATTER)
    direction[:, d], cosine = cosine_direction(vertex.shading[:, d], square[:, d])
    paths.throughput[:, d] *= vertex.base[:, d]
    cosine *= _ONE_OVER_PI
    if g.start == g.stop:
        return cosine
    lobe = sampler.draw(keys.cut(g.start, g.stop), first + dims.LOBE)
    direction[:, g] = vertex.gloss.sample(square[:, g], lobe)
    value, density = vertex.gloss.evaluate(direction[:, g])
    paths.throughput[:, g] *= value / density
    return np.concatenate([cosine, density])


def _scatter_glass(
    vertex: Vertex, sampler: Sampler, keys: PathKeys, first: int, direction: FloatArray
) -> NDArray[np.bool_]:
    """Write the directions of the glass paths, and return which of them refract.

    The hero is refracted by its index. Lanes of another index would go elsewhere: for them this path has density 0, and
    the balance heuristic gives the hero the weight of all of them.
    """
    g, index = vertex.glass, vertex.index()
    choice = sampler.draw(keys.cut(g.start, g.stop), first + dims.LOBE)
    travel, normal, outside = vertex.paths.direction[:, g], vertex.shading[:, g], vertex.outside[g]
    shared = vertex.paths.shared[g]
    alone = shared == 1
    cosine = np.clip(-dot(travel, normal), 0, 1)
    reflectance, _ = fresnel_dielectric(cosine, np.where(outside, index, 1 / index))
    chance = np.where(alone, reflectance[0], reflectance.mean(axis=0))
    direction[:, g], refracts = glass_direction(travel, normal, outside, index[0], choice, chance)
    factor = np.where(refracts, (1 - reflectance) / (1 - chance), reflectance / chance)
    part = refracts & ~alone & (index != index[0]).any(axis=0)
    factor[0] *= np.where(part, shared, np.float32(1))
    factor[1:] = np.where(alone | part, np.float32(0), factor[1:])
    vertex.paths.throughput[:, g] *= factor
    vertex.paths.shared[g] = np.where(part, np.float32(1), shared)
    return refracts


_ROULETTE_FROM = 2  # surfaces that a path meets before it can end by chance


def trace(
    world: World,
    sampler: Sampler,
    keys: PathKeys,
    paths: Paths,
    max_depth: int,
    *,
    aim: bool = True,
    first_distance: FloatArray | None = None,
) -> FloatArray:
    """Return weight times radiance [lanes, N] that arrives along camera rays, at the wavelengths of each path.

    Args:
        keys: for the random numbers of the paths.
        paths: those of the camera rays (m); of weight 0, they cost nothing.
        max_depth: number of surfaces along a path at which light is scattered.
        aim: whether to sample lights directly; without it the mean is the same, found by scattering alone.
        first_distance: [N], which gets the distance (m) to what camera rays hit first, inf for nothing; paths of
            weight 0 are left out.
    """
    radiance = np.zeros(paths.throughput.shape[::-1], np.float32)
    paths = paths.take(lit(paths.throughput))
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
            _add_environment(world, paths, found, aim, radiance)
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
    return radiance.T


def _add_environment(world: World, paths: Paths, found: NDArray[np.int32], aim: bool, radiance: FloatArray) -> None:
    if world.dark:
        return
    rows = np.flatnonzero(found < 0)
    if rows.size:
        density = paths.density[rows] if aim else None
        light = world.environment(paths.direction.take(rows, axis=1), paths.bins.take(rows), density)
        deposit(radiance, paths.slot[rows], paths.throughput.take(rows, axis=-1) * light)


def _add_emission(
    world: World, paths: Paths, surface: Index, point: FloatArray, distance: FloatArray, aim: bool, radiance: FloatArray
) -> None:
    """Add the light of paths that were scattered into a light.

    Its weight allows for paths that were aimed at the light (multiple importance sampling).
    """
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
    """Return the paths that meet something that scatters, sorted by kind of material."""
    kind = world.kind.take(surface)
    ends = np.cumsum(np.bincount(kind, minlength=NOTHING + 1))
    order = np.argsort(kind, kind="stable")[: ends[GLASS]]
    return Vertex(world, paths.take(order), surface[order], point.take(order, axis=1), distance[order], ends)


def _roulette(paths: Paths, sample: FloatArray) -> None:
    """End faint paths by chance; those that go on carry the light of those that end."""
    brightest = paths.throughput.max(axis=0) * paths.shared
    survival = np.clip(brightest, np.float32(0.05), np.float32(1))
    paths.throughput /= survival
    paths.throughput *= sample < survival
