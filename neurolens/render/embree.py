"""Triangle meshes through Embree, where its Python binding is installed: `pip install neurolens[embree]`.

Without it, the tree of `neurolens.render.mesh` does the same. Hits agree within the rounding of float32.
"""

from __future__ import annotations

from importlib import import_module
from typing import Any

import numpy as np
from numpy.typing import NDArray

from neurolens.cameras.contract import FloatArray
from neurolens.render.mesh import Mesh
from neurolens.render.primitives import NEAREST, IntArray, Primitive, Rays, slabs

_STEP = np.float32(1e-5)  # m by which a ray starts again that met the surface that it leaves


def make_mesh(first: int, vertices: NDArray[np.float64], faces: NDArray[np.int64]) -> Primitive:
    """Triangles to hit, through Embree if it is installed; arguments as for `Mesh`."""
    try:
        return EmbreeMesh(first, vertices, faces)
    except ImportError:
        return Mesh(first, vertices, faces)


def tracer() -> str:
    """What `make_mesh` makes meshes hit with: their hits differ by rounding."""
    try:
        _library()
    except ImportError:
        return "the built-in tree"
    return "Embree"


def _library() -> tuple[Any, Any]:
    """The parts of embreex; by name, as nothing is known of their types."""
    return import_module("embreex.mesh_construction"), import_module("embreex.rtcore_scene")


class EmbreeMesh:
    """Triangles in an Embree scene; triangle k is surface `first` + k.

    Args:
        first: number of the first triangle's surface.
        vertices: [V, 3] in metres.
        faces: [T, 3].

    Raises:
        ImportError: embreex is not installed.
    """

    def __init__(self, first: int, vertices: NDArray[np.float64], faces: NDArray[np.int64]) -> None:
        mesh_construction, rtcore_scene = _library()
        self.first, self.count = first, len(faces)
        corners = np.ascontiguousarray(vertices[faces], np.float32)
        # Robust: watertight at the edges that triangles share.
        self._scene = rtcore_scene.EmbreeScene(robust=True)
        self._triangles = mesh_construction.TriangleMesh(self._scene, corners)
        self._low, self._high = corners.min(axis=(0, 1)), corners.max(axis=(0, 1))

    def nearer(self, rays: Rays, best: FloatArray, found: IntArray) -> None:
        """See `Primitive`."""
        entry, exit_ = slabs(rays, self._low, self._high)
        np.minimum(exit_, best, out=exit_)
        np.maximum(entry, NEAREST, out=entry)
        # The box is flat where the mesh is: a hair of slack keeps what lies in it.
        ray = np.flatnonzero(entry * np.float32(1 - 1e-5) <= exit_)
        start = rays.origin.take(ray, axis=1)
        moved = np.zeros(len(ray), np.float32)
        while ray.size:
            direction = rays.direction.take(ray, axis=1)
            reach = np.minimum(best.take(ray) - moved, np.float32(1e30))
            hit = self._scene.run(
                np.ascontiguousarray(start.T), np.ascontiguousarray(direction.T), dists=reach, output=True
            )
            met = np.flatnonzero(hit["primID"] >= 0)
            distance = hit["tfar"][met] + moved[met]
            ok = (distance > NEAREST) & (distance < best[ray[met]])
            best[ray[met[ok]]] = distance[ok]
            found[ray[met[ok]]] = self.first + hit["primID"][met[ok]]
            again = met[distance <= NEAREST]
            ray, moved = ray[again], moved[again] + _STEP
            start = start.take(again, axis=1) + direction.take(again, axis=1) * _STEP
