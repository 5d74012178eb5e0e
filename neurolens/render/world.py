"""A scene made ready for tracing: shapes to hit, and one row of properties a surface.

Every flat shape, box face, sphere and triangle is a surface with a number. What a path needs at a hit (normal, kind of
material, colours) is looked up by that number in flat tables, because a gather costs a nanosecond a path. Row -1 is
what a ray meets that meets nothing.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from neurolens.cameras.contract import FloatArray
from neurolens.render.checks import BLACK, Vector
from neurolens.render.lights import Lights
from neurolens.render.mesh import Mesh, vertex_normals
from neurolens.render.palette import Index, Palette
from neurolens.render.primitives import AxisQuad, Box, IntArray, Plane, Primitive, Quad, Rays, is_axis_aligned
from neurolens.render.scene import Environment, Material, Texture
from neurolens.render.scenefile import Scene
from neurolens.render.spectrum import SpectralRange
from neurolens.render.spheres import Spheres
from neurolens.render.textures import TextureTable, box_frame, plane_frame, quad_frame

DIFFUSE, GLOSSY, MIRROR, GLASS, NOTHING = range(5)
_KINDS = {"diffuse": DIFFUSE, "glossy": GLOSSY, "mirror": MIRROR, "glass": GLASS}


@dataclass
class _Surface:
    """Properties of one surface while the tables are being filled."""

    normal: tuple[float, ...]
    material: Material | None
    light: int = -1
    emission: Vector = BLACK
    illuminant: str = "D65"
    frame: NDArray[np.float64] | None = None


class World:
    """What the integrator sees of a scene over a range of wavelengths.

    Attributes:
        kind: [S] uint8, DIFFUSE to NOTHING. normal: [3, S]. light: [S] number of the light or -1.
        reflectance_row, specular_row, index_row, emission_row: [S] rows of `palette`. alpha: [S] GGX width.
        lights: for direct sampling. light_emission_row: [lights] their rows of `palette`. dark: no environment.
    """

    def __init__(self, scene: Scene, spectral: SpectralRange) -> None:
        self.palette = Palette(spectral, scene.illuminants)
        self.scene = scene
        settings = scene.settings
        quads = [q for q in settings.quads if any(q.emission)]
        spheres = [s for s in settings.spheres if any(s.emission)]
        self.lights = Lights(quads, spheres, settings.camera.look_at_m)
        self._primitives: list[Primitive] = []
        self._boxes: list[Box] = []
        self._has_spheres = bool(settings.spheres)
        self._smooth: list[tuple[Mesh, FloatArray]] = []
        surfaces: list[_Surface] = []
        self._add_flat(surfaces)
        self._add_boxes(surfaces)
        self._add_spheres(surfaces, len(quads))
        self._add_meshes(surfaces)
        self._fill_tables(surfaces, spectral)
        self._environment(settings.environment)
        self.palette.freeze()
        self._shadow_casters = [p for p in self._primitives if not self._never_shades(p)]

    def _material(self, name: str | None) -> Material | None:
        return None if name is None else (self.scene.settings.materials or {})[name]

    def _add_flat(self, surfaces: list[_Surface]) -> None:
        lights = 0
        for quad in self.scene.settings.quads:
            corner, u, v = (np.array(x, np.float64) for x in (quad.corner_m, quad.edge_u_m, quad.edge_v_m))
            normal = np.cross(u, v) / np.linalg.norm(np.cross(u, v))
            aligned = is_axis_aligned(u) and is_axis_aligned(v)
            axis = int(np.argmax(np.abs(normal)))
            first = len(surfaces)
            shape = AxisQuad(first, corner, corner + u + v, axis) if aligned else Quad(first, corner, u, v)
            self._primitives.append(shape)
            light = lights if any(quad.emission) else -1
            lights += light >= 0
            material = self._material(quad.material)
            frame = quad_frame(corner, u, v)
            surfaces.append(_Surface(tuple(normal), material, light, quad.emission, quad.illuminant, frame))
        for plane in self.scene.settings.planes:
            normal = np.array(plane.normal) / np.linalg.norm(plane.normal)
            point = np.array(plane.point_m, np.float64)
            self._primitives.append(Plane(len(surfaces), point, normal))
            material = self._material(plane.material)
            surfaces.append(_Surface(tuple(normal), material, frame=plane_frame(point, normal)))

    def _add_boxes(self, surfaces: list[_Surface]) -> None:
        rooms = [(room.min_m, room.max_m, room.walls(), True) for room in self.scene.settings.rooms]
        boxes = [(box.min_m, box.max_m, (box.material,) * 6, False) for box in self.scene.settings.boxes]
        for low_m, high_m, materials, inside in [*rooms, *boxes]:
            low, high = np.array(low_m, np.float64), np.array(high_m, np.float64)
            box = Box(len(surfaces), low, high, inside)
            self._primitives.append(box)
            self._boxes.append(box)
            for face, name in enumerate(materials):
                normal = np.zeros(3)
                normal[face // 2] = 1.0 if face % 2 else -1.0
                surfaces.append(_Surface(tuple(normal), self._material(name), frame=box_frame(low, face // 2)))

    def _add_spheres(self, surfaces: list[_Surface], lights: int) -> None:
        spheres, self._first_sphere = self.scene.settings.spheres, len(surfaces)
        if not spheres:
            return
        centres, radii = np.array([s.centre_m for s in spheres]), np.array([s.radius_m for s in spheres])
        self._primitives.append(Spheres(self._first_sphere, centres, radii))
        for sphere in spheres:
            light = lights if any(sphere.emission) else -1
            lights += light >= 0
            material = self._material(sphere.material)
            surfaces.append(_Surface((0, 0, 0), material, light, sphere.emission, sphere.illuminant))

    def _add_meshes(self, surfaces: list[_Surface]) -> None:
        for mesh, triangles in zip(self.scene.settings.meshes, self.scene.triangles, strict=True):
            shape = Mesh(len(surfaces), triangles.vertices, triangles.faces)
            self._primitives.append(shape)
            material = self._material(mesh.material)
            surfaces += [_Surface(tuple(normal), material) for normal in shape.planes[:, 0, :3]]
            if mesh.smooth:
                normals = vertex_normals(triangles.vertices, triangles.faces)[triangles.faces]
                self._smooth.append((shape, normals.astype(np.float32)))

    def _fill_tables(self, surfaces: list[_Surface], spectral: SpectralRange) -> None:
        """One row a surface, and the last one for nothing."""
        rows = [*surfaces, _Surface((0, 0, 0), None)]
        materials = [s.material for s in rows]
        colour, palette = self.palette.colour, self.palette
        self.normal = np.array([s.normal for s in rows], np.float32).T.copy()
        self.kind = np.array([_KINDS[m.kind] if m else NOTHING for m in materials], np.uint8)
        self.light = np.array([s.light for s in rows], np.intp)
        self.emission_row = np.array([palette.light(s.emission, s.illuminant) for s in rows], np.intp)
        emitters = sorted((s.light, k) for k, s in enumerate(rows) if s.light >= 0)
        self.light_emission_row = self.emission_row[[k for _, k in emitters]]
        self.reflectance_row = np.array([colour((m and m.reflectance) or BLACK) for m in materials], np.intp)
        self.specular_row = np.array([colour((m and m.specular) or BLACK) for m in materials], np.intp)
        self.index_row = np.array([palette.index(m.n_d, m.V_d) if m and m.n_d else 0 for m in materials], np.intp)
        self.alpha = np.array([m.roughness**2 if m and m.roughness else 1 for m in materials], np.float32)
        # Centre and 1 / radius of each sphere, 0 for other surfaces.
        self._spheres = np.zeros((4, len(rows)), np.float32)
        for number, sphere in enumerate(self.scene.settings.spheres, self._first_sphere):
            self._spheres[:, number] = (*sphere.centre_m, 1 / sphere.radius_m)
        named: dict[str, Texture] = self.scene.settings.textures or {}
        names = [m.texture if m else None for m in materials]
        self.textures = TextureTable(named, self.scene.images, names, [s.frame for s in rows], colour, spectral)

    def _environment(self, environment: Environment) -> None:
        colour = environment.colour
        bands = (environment.ground, environment.horizon, environment.zenith) if colour is None else (colour,) * 3
        self._bands = [self.palette.light(band or BLACK, environment.illuminant) for band in bands]
        self.dark = not any(any(band or BLACK) for band in bands)

    def _never_shades(self, shape: Primitive) -> bool:
        """Whether no shadow ray can be blocked: the walls of a room around every light, as walls let light in."""
        if not isinstance(shape, Box) or not shape.room:
            return False
        points: list[NDArray[np.float64]] = []
        for sphere in self.scene.settings.spheres:
            if any(sphere.emission):
                points += [np.add(sphere.centre_m, side * sphere.radius_m) for side in (-1, 1)]
        for quad in self.scene.settings.quads:
            if any(quad.emission):
                points += [np.array(quad.corner_m), np.sum([quad.corner_m, quad.edge_u_m, quad.edge_v_m], axis=0)]
        return all(bool(np.all((p > shape.low) & (p < shape.high))) for p in points)

    def nearest(self, rays: Rays) -> tuple[FloatArray, IntArray]:
        """Distance [N] in m (inf: none) and surface [N] that rays hit first; -1 for none, of a box its first face."""
        count = rays.origin.shape[1]
        best, found = np.full(count, np.inf, np.float32), np.full(count, -1, np.int32)
        for shape in self._primitives:
            shape.nearer(rays, best, found)
        return best, found

    def visible(self, origin: FloatArray, direction: FloatArray, distance: FloatArray) -> NDArray[np.bool_]:
        """Whether nothing stands on the way [N] from origins [3, N] to lights at `distance` [N]."""
        rays = Rays.of(origin, direction)
        best, found = distance * np.float32(1 - 1e-4), np.full(len(distance), -1, np.int32)
        for shape in self._shadow_casters:
            shape.nearer(rays, best, found)
        return found < 0

    def surfaces(self, found: IntArray, point: FloatArray) -> Index:
        """Surface numbers [N], the faces of boxes told apart."""
        surface = found.astype(np.intp)
        for box in self._boxes:
            rows = np.flatnonzero(found == box.first)
            if rows.size:
                surface[rows] = box.face(point.take(rows, axis=1))
        return surface

    def normals(self, surface: Index, point: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Outward geometric and shading normals [3, N] at points [3, N] of surfaces [N]."""
        normal = self.normal.take(surface, axis=1)
        if self._has_spheres:
            rows = np.flatnonzero(self._spheres[3].take(surface))
            number = surface[rows]
            local = point.take(rows, axis=1) - self._spheres[:3].take(number, axis=1)
            local *= self._spheres[3].take(number)
            normal[:, rows] = local
        shading = normal
        for mesh, corner_normals in self._smooth:
            rows = np.flatnonzero((surface >= mesh.first) & (surface < mesh.first + mesh.count))
            if rows.size:
                shading = normal.copy() if shading is normal else shading
                triangle = surface[rows] - mesh.first
                at = np.vstack([point.take(rows, axis=1), np.ones(len(rows), np.float32)])
                u, v = np.einsum("tij,jt->it", mesh.planes[triangle, 1:], at)
                weights = np.stack([1 - u - v, u, v])
                blended = np.einsum("it,tij->jt", weights, corner_normals[triangle])
                shading[:, rows] = blended / np.sqrt(np.sum(blended**2, axis=0))
        return normal, shading

    def reflectance(self, surface: Index, point: FloatArray, bins: Index) -> FloatArray:
        """Reflectance [..., N] at wavelength bins [N], textures included."""
        value = self.palette.look_up(self.reflectance_row.take(surface), bins)
        self.textures.apply(value, surface, point, bins, self.palette.look_up)
        return value

    def environment(self, direction: FloatArray, bins: Index) -> FloatArray:
        """Radiance [..., N] from infinitely far along directions [3, N]."""
        ground, horizon, zenith = self._bands
        height = direction[1]
        at_horizon = self.palette.look_up(np.full(len(bins), horizon), bins)
        if ground == horizon == zenith:
            return at_horizon
        beyond = self.palette.look_up(np.where(height > 0, zenith, ground), bins)
        return at_horizon + np.abs(height) * (beyond - at_horizon)
