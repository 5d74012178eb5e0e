"""Spheres, all of a scene at once."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from neurolens.cameras.contract import FloatArray
from neurolens.render.primitives import NEAREST, IntArray, Rays, dot

_LARGE_M = 1000.0  # the rounding of float32 puts the surface of larger spheres behind the rays that leave it


class Spheres:
    """All spheres of a scene, hit from outside and inside.

    Most rays miss most spheres, so a cheap test rejects them: the discriminant r^2 - |f|^2 + (f . d)^2, with f from ray
    origin o to centre c, is a polynomial in products of (c, 1) with (d, o.d) and (o, |o|^2), that is, two small matrix
    products. It is loose by its rounding error; what it lets through is tested exactly, pair by pair.

    Args:
        first: surface number of the first sphere.
        centres: [S, 3] m. radii: [S] m.
    """

    def __init__(self, first: int, centres: NDArray[np.float64], radii: NDArray[np.float64]) -> None:
        self.first, self.count = first, len(radii)
        self._kind: type[np.floating[Any]] = np.float64 if radii.max() > _LARGE_M else np.float32
        self._centre: Any = centres.T.astype(self._kind)
        self._radius: Any = radii.astype(self._kind)
        # A hair of 2e-6 of the squared distances covers the rounding of the products.
        slack, ones = 2e-6, np.ones(self.count)
        constant = radii**2 - (1 - slack) * np.sum(centres**2, axis=1)
        self._along = np.column_stack([centres, -ones]).astype(np.float32)
        self._rest = np.column_stack([2 * centres, constant, (slack - 1) * ones]).astype(np.float32)
        # As many rays as keep the product so small that BLAS does not start threads of its own.
        self._rays_at_once = int(np.clip(200_000 // (5 * self.count), 64, 4096))

    def nearer(self, rays: Rays, best: FloatArray, found: IntArray) -> None:
        """See `Primitive`."""
        origin, direction = rays.origin, rays.direction
        right = np.empty((9, origin.shape[1]), np.float32)
        right[:3], right[3], right[4:7], right[7] = direction, dot(origin, direction), origin, 1
        right[8] = dot(origin, origin)
        for start in range(0, origin.shape[1], self._rays_at_once):
            part = slice(start, start + self._rays_at_once)
            loose = self._along @ right[:4, part]
            loose *= loose
            loose += self._rest @ right[4:, part]
            near = np.flatnonzero(loose > 0)
            if near.size:
                number, ray = np.divmod(near, loose.shape[1])
                ray += start
                self._meet(rays, best, found, number, ray)

    def _meet(
        self, rays: Rays, best: FloatArray, found: IntArray, number: NDArray[np.intp], ray: NDArray[np.intp]
    ) -> None:
        """Test pairs of spheres and rays.

        The discriminant comes from the distance between centre and ray, which stays exact in float32 for a small
        sphere far away (Haines et al. 2019, "Precision improvements for ray/sphere intersection").
        """
        direction: Any = rays.direction.take(ray, axis=1).astype(self._kind, copy=False)
        if self._kind is np.float64:
            direction /= np.sqrt(dot(direction, direction))
        to_centre = self._centre.take(number, axis=1) - rays.origin.take(ray, axis=1)
        radius = self._radius.take(number)
        middle = dot(to_centre, direction)
        direction *= middle
        direction -= to_centre
        half2 = radius * radius - dot(direction, direction)
        half = np.sqrt(np.maximum(half2, 0))
        distance = middle - half
        np.copyto(distance, middle + half, where=distance < NEAREST)
        hit = np.flatnonzero((half2 > 0) & (distance > NEAREST) & (distance < best.take(ray)))
        ray, distance = ray[hit], distance[hit].astype(np.float32, copy=False)
        np.minimum.at(best, ray, distance)
        won = distance == best.take(ray)
        found[ray[won]] = self.first + number[hit[won]]
