"""A scene made ready for tracing: shapes to hit, and one row of properties a surface.

Every flat shape, box face, sphere and triangle is a surface with a number. What a path needs at a hit (normal, kind of
material, colours, patterns and pictures) is looked up by that number in flat tables, because a gather costs a
nanosecond a path. Row -1 is for rays without a hit.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass
from importlib.util import find_spec

import numpy as np
from numpy.typing import ArrayLike, NDArray

from neurolens.cameras.contract import FloatArray
from neurolens.pictures.render.colour import Index, Palette, SpectralRange
from neurolens.pictures.render.lights import (
    FlatLights,
    Lights,
    LightSamples,
    PointLights,
    SphereLights,
    SunLight,
    Surroundings,
)
from neurolens.pictures.render.materials import CoatTable
from neurolens.pictures.render.primitives import (
    MANY_SPHERES,
    AxisQuad,
    Box,
    Disc,
    IntArray,
    Mesh,
    Plane,
    Primitive,
    Quad,
    Rays,
    SphereClusters,
    Spheres,
    dot,
    triangle_planes,
)
from neurolens.pictures.render.scene import Scene
from neurolens.pictures.render.scenetables import BLACK, Emitter, Material, Texture

Frame = NDArray[np.float64]
_STEEPEST = 1e25  # the most pictures or cells a metre: times the farthest point it is still finite in float32
DIFFUSE, GLOSSY, MIRROR, GLASS, NOTHING = range(5)
_KINDS = {"diffuse": DIFFUSE, "glossy": GLOSSY, "mirror": MIRROR, "glass": GLASS}
_MANY_QUADS = 128  # above this number, a mesh is faster than testing one by one
_THROUGH, _PER_M = np.float32(1e-4), np.float32(1e-5)  # how far behind a surface a ray goes on: m, and share of its way
# the most surfaces that a ray passes on its way to a layer behind; most are backs of what it has entered
_SURFACES = 64


def _frame(origin: Frame, u: Frame, v: Frame, size: Sequence[float] = (1.0, 1.0)) -> Frame:
    """Return a frame [1, 2, 5]: coordinates in metres along u and v as affine functions of a point, and the size."""
    return np.array([[[*axis, -(origin @ axis), length] for axis, length in zip((u, v), size, strict=True)]])


def _plane_frame(point: Frame, normal: Frame) -> Frame:
    """Return the frame of a plane: it begins at a point and follows the scene's x axis, or z where that is steeper."""
    axis = np.eye(3)[2 if abs(normal[0]) > 0.9 else 0]
    u = axis - normal * (axis @ normal)
    u /= np.linalg.norm(u)
    return _frame(point, u, np.cross(normal, u))


def _triangle_frames(planes: Frame, uv: Frame) -> Frame:
    """Return texture coordinates [T, 3 corners, 2] of triangles as affine functions of a point, [T, 2, 5].

    Their unit is a picture. `planes` [T, 3, 4] come from `triangle_planes`; rows 1 and 2 are the weights of corners 1
    and 2.
    """
    step = uv[:, 1:] - uv[:, :1]  # [T, 2, 2]
    rows = np.einsum("tkc,tkj->tcj", step, planes[:, 1:])
    rows[:, :, 3] += uv[:, 0]
    return np.concatenate([rows, np.ones((len(uv), 2, 1))], axis=2)


class TextureTable:
    """The textures of a scene, looked up by surface.

    Args:
        textures: by name. images: linear RGB [H, W, 3] of those of kind "image".
        surfaces: for each run of surfaces their number, the name of their texture or None, and their frames [count, 2,
            5] or None.
        palette: takes the rows of their colours.
    """

    def __init__(
        self,
        textures: dict[str, Texture],
        images: dict[str, FloatArray],
        surfaces: Sequence[tuple[int, str | None, Frame | None]],
        palette: Palette,
        spectral: SpectralRange,
    ) -> None:
        self._textures = list(textures.items())
        self._images, self._palette = images, palette
        self._basis = spectral.rotated(spectral.basis.astype(np.float32))
        numbers = {name: k for k, name in enumerate(textures)}
        self._rows = [np.array([palette.colour(c) for c in t.colours or ()], np.intp) for t in textures.values()]
        total = sum(count for count, _, _ in surfaces)
        self._number, self._frames = np.full(total, -1), np.zeros((2, 4, total), np.float32)
        first = 0
        for count, name, frames in surfaces:
            if name is not None and frames is not None:
                texture, rows = textures[name], slice(first, first + count)
                cell = texture.cell_m
                size = texture.size_m or ((cell, cell) if cell else frames[0, :, 4])
                self._number[rows] = numbers[name]
                # In units of cells, or of pictures.
                scaled = np.clip(frames[:, :, :4] / np.array(size)[:, None], -_STEEPEST, _STEEPEST)
                self._frames[:, :, rows] = np.moveaxis(scaled, 0, -1)
            first += count
        self._used = bool(np.any(self._number >= 0))

    def apply(self, value: FloatArray, surface: Index, point: FloatArray, bins: Index) -> None:
        """Write the reflectance at points [3, N] into `value` [lanes, N] where surfaces [N] have a texture."""
        if not self._used:
            return
        number = self._number.take(surface)
        for k, (name, texture) in enumerate(self._textures):
            rows = np.flatnonzero(number == k)
            if not rows.size:
                continue
            at, frame = point.take(rows, axis=1), self._frames.take(surface[rows], axis=2)
            u, v = frame[:, 0] * at[0] + frame[:, 1] * at[1] + frame[:, 2] * at[2] + frame[:, 3]
            if texture.kind == "image":
                value[:, rows] = self._picture(self._images[name], u, v, bins[rows])
                continue
            if texture.kind == "checker":
                # 2e-4 of a cell is slack: a shape that begins on a cell's edge shows no speckle of rounding there.
                which = (np.floor(u + 2e-4).astype(np.intp) + np.floor(v + 2e-4).astype(np.intp)) & 1
            else:
                reach = np.float32(0.5 * (texture.line_m or 0) / (texture.cell_m or 1))
                on_line = (np.abs(u - np.rint(u)) <= reach) | (np.abs(v - np.rint(v)) <= reach)
                which = 1 - on_line.astype(np.intp)
            value[:, rows] = self._palette.look_up(self._rows[k].take(which), bins[rows])

    def _picture(self, image: FloatArray, u: FloatArray, v: FloatArray, bins: Index) -> FloatArray:
        """Look up the reflectance [lanes, N] of the texel at (u, v), in pictures from the lower left corner."""
        height, width = image.shape[:2]
        column = ((u - np.floor(u)) * width).astype(np.intp)
        row = ((1 - (v - np.floor(v))) * height).astype(np.intp)
        rgb = image[np.minimum(row, height - 1), np.minimum(column, width - 1)]
        return np.einsum("nc,lcn->ln", rgb, self._basis.take(bins, axis=-1))


@dataclass(frozen=True)
class Surfaces:
    """A run of surfaces that differ only in place: normals [count, 3], and `frames` [count, 2, 5] for textures."""

    normals: NDArray[np.float64]
    material: Material | None = None
    frames: NDArray[np.float64] | None = None
    emitter: Emitter | None = None  # what shines


def _unit(vector: ArrayLike) -> NDArray[np.float64]:
    return np.asarray(vector, np.float64) / np.linalg.norm(vector)


class Assembly:
    """All shapes of a scene, made from its tables: quads, discs, planes, rooms, boxes, spheres, meshes.

    Attributes:
        primitives: what rays can hit. surfaces: in order of their numbers. boxes: those whose faces are found after a
            hit.
        smooth: for each mesh with interpolated normals its first surface, its planes [T, 3, 4] and its corners' normals
            [T, 3, 3].
        first_sphere: number of the first sphere's surface.
    """

    def __init__(self, scene: Scene) -> None:
        self._scene, self._materials = scene, scene.settings.materials
        self.primitives: list[Primitive] = []
        self.surfaces: list[Surfaces] = []
        self.boxes: list[Box] = []
        self.smooth: list[tuple[int, FloatArray, FloatArray]] = []
        self._count = 0
        self._add_flat()
        self._add_boxes()
        self.first_sphere = self._count
        self._add_spheres()
        self._add_meshes()

    def _add(
        self,
        normals: NDArray[np.float64],
        material: str | None,
        frames: NDArray[np.float64] | None = None,
        emitter: Emitter | None = None,
    ) -> None:
        shining = emitter if emitter is not None and any(emitter.emission) else None
        made = None if material is None else self._materials[material]
        self.surfaces.append(Surfaces(normals, made, frames, shining))
        self._count += len(normals)

    def _add_flat(self) -> None:
        settings = self._scene.settings
        quads = np.array([(q.corner_m, q.edge_u_m, q.edge_v_m) for q in settings.quads], np.float64).reshape(-1, 3, 3)
        many = len(quads) > _MANY_QUADS and find_spec("embreex") is not None  # some machines have no wheel
        if many:
            self.primitives.append(Mesh.of_rectangles(self._count, quads + quads[:, :1] * [[[0], [1], [1]]]))
        for quad, (corner, u, v) in zip(settings.quads, quads, strict=True):
            normal, lengths = _unit(np.cross(u, v)), np.linalg.norm((u, v), axis=1)
            if not many:
                aligned = np.count_nonzero(u) == 1 and np.count_nonzero(v) == 1
                axis, first = int(np.argmax(np.abs(normal))), self._count
                shape = AxisQuad(first, corner, corner + u + v, axis) if aligned else Quad(first, corner, u, v)
                self.primitives.append(shape)
            # It begins at the corner and runs along the edges.
            frame = _frame(corner, u / lengths[0], v / lengths[1], lengths)
            self._add(normal[None], quad.material, frame, quad)
        for disc in settings.discs:
            centre, normal = np.array(disc.centre_m, np.float64), _unit(disc.normal)
            self.primitives.append(Disc(self._count, centre, normal, disc.radius_m))
            frame = _plane_frame(centre, normal)
            # It begins at the lower left corner of the square around the disc.
            frame[..., 3:] = np.stack([frame[..., 3] + disc.radius_m, np.full((1, 2), 2 * disc.radius_m)], axis=-1)
            self._add(normal[None], disc.material, frame, disc)
        for plane in settings.planes:
            point, normal = np.array(plane.point_m, np.float64), _unit(plane.normal)
            self.primitives.append(Plane(self._count, point, normal))
            self._add(normal[None], plane.material, _plane_frame(point, normal))

    def _add_boxes(self) -> None:
        rooms = [(room, room.walls(), True) for room in self._scene.settings.rooms]
        boxes = [(box, (box.material,) * 6, False) for box in self._scene.settings.boxes]
        for table, materials, inside in [*rooms, *boxes]:
            low, high = np.array(table.min_m, np.float64), np.array(table.max_m, np.float64)
            self.boxes.append(Box(self._count, low, high, inside))
            self.primitives.append(self.boxes[-1])
            for face, name in enumerate(materials):
                # From the lowest corner x or z across, y up; on floor and ceiling x and z.
                across, up = ((2, 1), (0, 2), (0, 1))[face // 2]
                normal = np.eye(3)[face // 2] * (1.0 if face % 2 else -1.0)
                self._add(normal[None], name, _frame(low, np.eye(3)[across], np.eye(3)[up]))

    def _add_spheres(self) -> None:
        if spheres := self._scene.settings.spheres:
            centres, radii = np.array([s.centre_m for s in spheres]), np.array([s.radius_m for s in spheres])
            make = SphereClusters if len(spheres) > MANY_SPHERES else Spheres
            self.primitives.append(make(self._count, centres, radii))
        for sphere in spheres:
            self._add(np.zeros((1, 3)), sphere.material, None, sphere)

    def _add_meshes(self) -> None:
        for mesh, triangles in zip(self._scene.settings.meshes, self._scene.triangles, strict=True):
            first = self._count
            corners = triangles.vertices[triangles.faces]
            self.primitives.append(Mesh(first, corners))
            planes = triangle_planes(corners)
            frames = None if triangles.uv is None else _triangle_frames(planes, triangles.uv[triangles.faces])
            self._add(planes[:, 0, :3], mesh.material, frames)
            if triangles.normals is not None:
                normals = triangles.normals[triangles.faces].astype(np.float32)
                self.smooth.append((first, planes.astype(np.float32), normals))


_shared: ContextVar[list[World] | None] = ContextVar("worlds", default=None)


@contextmanager
def shared_worlds() -> Iterator[None]:
    """Let `world_of` keep its worlds inside the block: one with a million lights takes half a minute to make."""
    token = _shared.set([])
    try:
        yield
    finally:
        _shared.reset(token)


def world_of(scene: Scene, spectral: SpectralRange, geometry: bool = False) -> World:
    """Return the world of a scene over a range; only for its `geometry`, over any range. `shared_worlds` keeps it."""
    worlds = _shared.get()
    for world in worlds or ():
        if world.scene is scene and (geometry or world.spectral.same(spectral)):
            return world
    world = World(scene, spectral)
    if worlds is not None:
        worlds.append(world)
    return world


class World:
    """A scene as the integrator uses it, with spectra over a range of wavelengths.

    Attributes:
        kind: [S] uint8, DIFFUSE to NOTHING. normal: [3, S]. light: [S] number of the light or -1.
        reflectance_row, specular_row, index_row, absorption_row, emission_row: [S] rows of `palette`, 0 for black.
        absorbs: whether any glass absorbs. alpha: [S] GGX width. coat: albedos of coats, in which `coat_row` [S] is a
            row.
        lights: for direct sampling. light_emission_row: [lights] their rows of `palette`. dark: whether no light comes
            from afar.
    """

    def __init__(self, scene: Scene, spectral: SpectralRange) -> None:
        self.palette = Palette(spectral, scene.illuminants, scene.reflectances)
        self.scene, self.spectral = scene, spectral
        assert self.palette.colour(BLACK) == 0
        assembly = Assembly(scene)
        self._primitives, self._boxes, self._smooth = assembly.primitives, assembly.boxes, assembly.smooth
        self._fill_tables(assembly.surfaces, spectral)
        self._fill_spheres(assembly.first_sphere)
        self._make_lights(assembly.surfaces)
        self.palette.freeze()
        self._shadow_casters = [p for p in self._primitives if not self._never_shades(p)]

    def _fill_tables(self, surfaces: list[Surfaces], spectral: SpectralRange) -> None:
        parts = [*surfaces, Surfaces(np.zeros((1, 3)))]
        materials, counts = [part.material for part in parts], [len(part.normals) for part in parts]
        colour, palette = self.palette.colour, self.palette

        def spread(values: list[int] | list[float], kind: type) -> NDArray:
            return np.repeat(np.array(values, kind), counts)

        self.normal = np.concatenate([part.normals for part in parts]).T.astype(np.float32)
        self.kind = spread([_KINDS[m.kind] if m else NOTHING for m in materials], np.uint8)
        shining = np.array([part.emitter is not None for part in parts])
        self.light = np.repeat(np.where(shining, np.cumsum(shining) - 1, -1), counts)
        self._thing = np.repeat(np.arange(len(parts)), counts)  # the thing, such as a mesh, of which a surface is part
        self.emission_row = spread([self._emission(part.emitter) for part in parts], np.intp)
        reflectances = [palette.reflectance((m and m.reflectance) or BLACK) for m in materials]
        self.reflectance_row = spread(reflectances, np.intp)
        self.specular_row = spread([colour((m and m.specular) or BLACK) for m in materials], np.intp)
        self.index_row = spread([palette.index(m.n_d, m.V_d) if m and m.n_d else 0 for m in materials], np.intp)
        absorbing = ((m and m.transmittance, m and m.transmittance_depth_m) for m in materials)
        self.absorption_row = spread([palette.absorption(t, d) if t and d else 0 for t, d in absorbing], np.intp)
        self.absorbs = bool(self.absorption_row.any())
        alphas = [m.roughness**2 if m and m.roughness else 1.0 for m in materials]
        self.alpha = spread(alphas, np.float32)
        used = sorted({alpha for alpha, m in zip(alphas, materials, strict=True) if m and m.kind == "glossy"})
        self.coat = CoatTable(used)
        self.coat_row = spread([used.index(alpha) if alpha in used else 0 for alpha in alphas], np.intp)
        named = [m.texture if m else None for m in materials]
        framed = [(n, t, part.frames) for n, t, part in zip(counts, named, parts, strict=True)]
        tables, images = self.scene.settings.textures, self.scene.images
        self.textures = TextureTable(tables, images, framed, palette, spectral)

    def _emission(self, emitter: Emitter | None) -> int:
        return 0 if emitter is None else self.palette.light(emitter.emission, emitter.illuminant)

    def _fill_spheres(self, first: int) -> None:
        """Set centre and 1 / radius of each sphere, 0 for other surfaces."""
        self._spheres = np.zeros((4, len(self.kind)), np.float32)
        for number, sphere in enumerate(self.scene.settings.spheres, first):
            self._spheres[:, number] = (*sphere.centre_m, 1 / sphere.radius_m)
        self._has_spheres = bool(self.scene.settings.spheres)
        self._solid, self._endless = self._spheres[3] > 0, np.zeros(len(self.kind), bool)
        self._solid[[box.first for box in self._boxes if not box.room]] = True
        endless = (s.first for s in self._primitives if type(s) is Plane or (isinstance(s, Box) and s.room))
        self._endless[list(endless)] = True

    def _make_lights(self, surfaces: list[Surfaces]) -> None:
        """Make all lights; those with a surface come in the order of `Assembly`: quads, discs, spheres."""
        settings = self.scene.settings
        quads = [quad for quad in settings.quads if any(quad.emission)]
        discs = [disc for disc in settings.discs if any(disc.emission)]
        spheres = [sphere for sphere in settings.spheres if any(sphere.emission)]
        points = [*settings.points, *settings.spots]
        self._sky = Surroundings(settings, self.scene.environment, self.palette)
        self._sun = SunLight(settings.sky)
        sizeless = PointLights(settings.points, settings.spots)
        groups = (FlatLights(quads, discs), SphereLights(spheres), sizeless, self._sun, self._sky)
        self.lights = Lights(groups, settings.camera.look_at_m)
        # A room that holds all of these casts no shadow: see `_never_shades`.
        self._shining_m = [np.array(point.position_m) for point in points]
        around = [(sphere.centre_m, sphere.radius_m) for sphere in spheres]
        around += [(disc.centre_m, disc.radius_m) for disc in discs]
        self._shining_m += [np.add(centre, side * radius) for centre, radius in around for side in (-1, 1)]
        for quad in quads:
            corners = quad.corner_m, quad.edge_u_m, quad.edge_v_m
            self._shining_m += [np.array(quad.corner_m), np.sum(corners, axis=0)]
        rows = [self._emission(part.emitter) for part in surfaces if part.emitter is not None]
        rows += [self.palette.light(point.intensity, point.illuminant) for point in points]
        if settings.sky is not None and self._sun.count:
            rows.append(self._sun.row(settings.sky, self.palette))
        # The sky's number is the last; its radiance depends on the direction.
        self._sky_number = len(rows) if self._sky.count else -1
        self._sun_number = len(rows) - 1 if self._sun.count else -1
        self.light_emission_row = np.array([*rows, 0], np.intp)
        self.dark = self._sky.dark and not self._sun.count

    def _never_shades(self, shape: Primitive) -> bool:
        """Return whether the shape blocks no shadow ray: a room that holds every light, since its walls let rays in."""
        if not isinstance(shape, Box) or not shape.room or self._sky.count or self._sun.count:
            return False
        return all(bool(np.all((p > shape.low) & (p < shape.high))) for p in self._shining_m)

    def nearest(self, rays: Rays) -> tuple[FloatArray, IntArray]:
        """Return the distance [N] in m (inf: none) and surface [N] that rays hit first (-1: none; a box: its first)."""
        count = rays.origin.shape[1]
        best, found = np.full(count, np.inf, np.float32), np.full(count, -1, np.int32)
        for shape in self._primitives:
            shape.nearer(rays, best, found)
        return best, found

    def behind(self, origin: FloatArray, direction: FloatArray, things: int) -> tuple[FloatArray, NDArray[np.bool_]]:
        """How far rays [3, N] go to just behind the first things that they meet, [N] m, and whether anything follows.

        What is met inside of balls and boxes does not count as another thing, nor does the back of a mesh whose front
        was met last. The sky follows, too. Nothing follows an infinite plane or the wall of a room: these have no edges
        past which a lens could see.
        """
        count = origin.shape[1]
        way, follows = np.zeros(count, np.float32), np.zeros(count, bool)
        met, depth, entered = np.zeros(count, int), np.zeros(count, int), np.full(count, -1)
        rows: Index = np.arange(count)
        for _ in range(_SURFACES):
            along, before = direction.take(rows, axis=1), way[rows]
            step, found = self.nearest(Rays.of(origin.take(rows, axis=1) + before * along, along))
            with np.errstate(invalid="ignore"):  # distances may be infinite
                at = origin.take(rows, axis=1) + (before + step) * along
                front = dot(self.normals(self.surfaces(found, at), at)[0], along) < 0
            own = ~front & (self._thing[found] == entered[rows])
            stops = (found < 0) | self._endless[found] | ((depth[rows] == 0) & ~own)
            follows[rows] = stops & (met[rows] == things)
            going = ~follows[rows] & (found >= 0) & ~self._endless[found]
            rows, step, found = rows[going], step[going], found[going]
            front, stops = front[going], stops[going]
            if not rows.size:
                break
            way[rows] += step * (1 + _PER_M) + _THROUGH
            met[rows] += stops
            depth[rows] = np.maximum(depth[rows] + np.where(front, 1, -1) * self._solid[found], 0)
            entered[rows] = np.where(front, self._thing[found], np.where(stops, -1, entered[rows]))
        return way, follows

    def visible(self, origin: FloatArray, direction: FloatArray, distance: FloatArray) -> NDArray[np.bool_]:
        """Return the visibility [N] of lights at `distance` [N] from origins [3, N]."""
        rays = Rays.of(origin, direction)
        best, found = distance * np.float32(1 - 1e-4), np.full(len(distance), -1, np.int32)
        for shape in self._shadow_casters:
            shape.nearer(rays, best, found)
        return found < 0

    def surfaces(self, found: IntArray, point: FloatArray) -> Index:
        """Return surface numbers [N], with the faces of boxes told apart."""
        surface = found.astype(np.intp)
        for box in self._boxes:
            rows = np.flatnonzero(found == box.first)
            if rows.size:
                surface[rows] = box.face(point.take(rows, axis=1))
        return surface

    def normals(self, surface: Index, point: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return outward geometric and shading normals [3, N] at points [3, N] of surfaces [N]."""
        normal = self.normal.take(surface, axis=1)
        if self._has_spheres:
            rows = np.flatnonzero(self._spheres[3].take(surface))
            number = surface[rows]
            local = point.take(rows, axis=1) - self._spheres[:3].take(number, axis=1)
            local *= self._spheres[3].take(number)
            normal[:, rows] = local
        shading = normal
        for first, planes, normals in self._smooth:
            rows = np.flatnonzero((surface >= first) & (surface < first + len(planes)))
            if rows.size:
                shading = normal.copy() if shading is normal else shading
                triangle = surface[rows] - first
                at = np.vstack([point.take(rows, axis=1), np.ones(len(rows), np.float32)])
                u, v = np.einsum("tij,jt->it", planes[triangle, 1:], at)
                blended = np.einsum("it,tij->jt", np.stack([1 - u - v, u, v]), normals[triangle])
                shading[:, rows] = blended / np.sqrt(np.maximum(np.sum(blended**2, axis=0), 1e-12))
        return normal, shading

    def reflectance(self, surface: Index, point: FloatArray, bins: Index) -> FloatArray:
        """Return the reflectance [lanes, N] of surfaces [N] at points [3, N] (m) and wavelength bins [N]."""
        value = self.palette.look_up(self.reflectance_row.take(surface), bins)
        self.textures.apply(value, surface, point, bins)
        return value

    def aimed_emission(self, aimed: LightSamples, rows: Index, bins: Index) -> FloatArray:
        """Return the emission [lanes, n] of the lights that some rows [n] aim at, at wavelength bins [n]."""
        light = aimed.light[rows]
        emitted = self.palette.look_up(self.light_emission_row.take(light), bins)
        if self._sky_number >= 0:
            far = np.flatnonzero(light == self._sky_number)
            emitted[:, far] = self._sky.radiance(aimed.direction.take(rows[far], axis=1), bins[far])
        return emitted

    def environment(self, direction: FloatArray, bins: Index, density: FloatArray | None = None) -> FloatArray:
        """Return the radiance [lanes, N] from infinitely far along directions [3, N].

        `density` [N] is that with which scattering chose the directions; with it each part is weighted against aiming
        at it.
        """
        light = self._sky.radiance(direction, bins)
        if self._sky_number >= 0 and density is not None:
            light /= self._rivals(self._sky_number, self._sky.far_pdf(direction), density)
        if self._sun_number >= 0:
            aimed = self._sun.far_pdf(direction)
            rows = np.flatnonzero(aimed)
            sun = self.palette.look_up(np.full(len(rows), self.light_emission_row[self._sun_number]), bins[rows])
            if density is not None:
                sun /= self._rivals(self._sun_number, aimed[rows], density[rows])
            light[:, rows] += sun
        return light

    def _rivals(self, light: int, pdf: FloatArray, density: FloatArray) -> FloatArray:
        """Return 1 over the weight [N] of scattering, by the power heuristic."""
        ratio = pdf * self.lights.probability[light] / density
        return 1 + ratio * ratio
