"""From the tables of a scene to shapes that rays can hit, and surfaces in the order of their numbers."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from neurolens.cameras.contract import FloatArray
from neurolens.render.checks import BLACK, Vector
from neurolens.render.embree import make_mesh
from neurolens.render.materialsettings import Material
from neurolens.render.mesh import triangle_planes
from neurolens.render.primitives import AxisQuad, Box, Disc, Plane, Primitive, Quad, is_axis_aligned
from neurolens.render.scenefile import Scene
from neurolens.render.spheres import Spheres
from neurolens.render.textures import box_frame, disc_frame, plane_frame, quad_frame, triangle_frames


@dataclass(frozen=True)
class Surfaces:
    """Surfaces in a row that differ only in where they are.

    Attributes:
        normals: [count, 3]. frames: [count, 2, 5] of textures. light: number of the light, -1 for none.
    """

    normals: NDArray[np.float64]
    material: Material | None
    frames: NDArray[np.float64] | None = None
    light: int = -1
    emission: Vector = BLACK
    illuminant: str = "D65"

    @property
    def count(self) -> int:
        """How many."""
        return len(self.normals)


@dataclass(frozen=True)
class SmoothMesh:
    """A mesh with interpolated normals: its first surface, planes [T, 3, 4] and corners' normals [T, 3, 3]."""

    first: int
    planes: FloatArray
    normals: FloatArray


class Assembly:
    """All shapes of a scene.

    Attributes:
        primitives: to hit. surfaces: in order of their numbers. boxes: whose faces are told apart after a hit.
        smooth: meshes with interpolated normals. first_sphere: number of the first sphere's surface.
    """

    def __init__(self, scene: Scene) -> None:
        self._scene, self._materials = scene, scene.settings.materials or {}
        self.primitives: list[Primitive] = []
        self.surfaces: list[Surfaces] = []
        self.boxes: list[Box] = []
        self.smooth: list[SmoothMesh] = []
        self._count, self._lights = 0, 0
        self._add_quads()
        self._add_discs()
        self._add_planes()
        self._add_boxes()
        self.first_sphere = self._count
        self._add_spheres()
        self._add_meshes()

    def _material(self, name: str | None) -> Material | None:
        return None if name is None else self._materials[name]

    def _add(self, surfaces: Surfaces) -> None:
        self.surfaces.append(surfaces)
        self._count += surfaces.count

    def _number(self, emission: Vector) -> int:
        """The next light's number, -1 for what does not emit; lights are numbered as `World` lists them."""
        if not any(emission):
            return -1
        self._lights += 1
        return self._lights - 1

    def _add_quads(self) -> None:
        for quad in self._scene.settings.quads:
            corner, u, v = (np.array(x, np.float64) for x in (quad.corner_m, quad.edge_u_m, quad.edge_v_m))
            normal = np.cross(u, v) / np.linalg.norm(np.cross(u, v))
            aligned = is_axis_aligned(u) and is_axis_aligned(v)
            axis, first = int(np.argmax(np.abs(normal))), self._count
            shape = AxisQuad(first, corner, corner + u + v, axis) if aligned else Quad(first, corner, u, v)
            self.primitives.append(shape)
            material, frame = self._material(quad.material), quad_frame(corner, u, v)
            light = self._number(quad.emission)
            self._add(Surfaces(normal[None], material, frame[None], light, quad.emission, quad.illuminant))

    def _add_discs(self) -> None:
        for disc in self._scene.settings.discs:
            centre, normal = np.array(disc.centre_m, np.float64), np.array(disc.normal) / np.linalg.norm(disc.normal)
            self.primitives.append(Disc(self._count, centre, normal, disc.radius_m))
            material, frame = self._material(disc.material), disc_frame(centre, normal, disc.radius_m)
            light = self._number(disc.emission)
            self._add(Surfaces(normal[None], material, frame[None], light, disc.emission, disc.illuminant))

    def _add_planes(self) -> None:
        for plane in self._scene.settings.planes:
            normal, point = np.array(plane.normal) / np.linalg.norm(plane.normal), np.array(plane.point_m, np.float64)
            self.primitives.append(Plane(self._count, point, normal))
            self._add(Surfaces(normal[None], self._material(plane.material), plane_frame(point, normal)[None]))

    def _add_boxes(self) -> None:
        rooms = [(room.min_m, room.max_m, room.walls(), True) for room in self._scene.settings.rooms]
        boxes = [(box.min_m, box.max_m, (box.material,) * 6, False) for box in self._scene.settings.boxes]
        for low_m, high_m, materials, inside in [*rooms, *boxes]:
            low, high = np.array(low_m, np.float64), np.array(high_m, np.float64)
            box = Box(self._count, low, high, inside)
            self.primitives.append(box)
            self.boxes.append(box)
            for face, name in enumerate(materials):
                normal = np.zeros((1, 3))
                normal[0, face // 2] = 1.0 if face % 2 else -1.0
                self._add(Surfaces(normal, self._material(name), box_frame(low, face // 2)[None]))

    def _add_spheres(self) -> None:
        spheres = self._scene.settings.spheres
        if not spheres:
            return
        centres, radii = np.array([s.centre_m for s in spheres]), np.array([s.radius_m for s in spheres])
        self.primitives.append(Spheres(self._count, centres, radii))
        for sphere in spheres:
            material, light = self._material(sphere.material), self._number(sphere.emission)
            self._add(Surfaces(np.zeros((1, 3)), material, None, light, sphere.emission, sphere.illuminant))

    def _add_meshes(self) -> None:
        for mesh, triangles in zip(self._scene.settings.meshes, self._scene.triangles, strict=True):
            first = self._count
            self.primitives.append(make_mesh(first, triangles.vertices, triangles.faces))
            planes = triangle_planes(triangles.vertices[triangles.faces])
            frames = None if triangles.uv is None else triangle_frames(planes, triangles.uv[triangles.faces])
            self._add(Surfaces(planes[:, 0, :3], self._material(mesh.material), frames))
            if triangles.normals is not None:
                corners = triangles.normals[triangles.faces].astype(np.float32)
                self.smooth.append(SmoothMesh(first, planes.astype(np.float32), corners))
