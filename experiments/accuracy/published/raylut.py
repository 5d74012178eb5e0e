"""A ray lookup table (Honsbrok et al. 2025, Ray-LUT): exact rays, traced once, and interpolation between them.

Of a lens that is round about its axis a camera ray is told by three numbers once it is turned into its meridian: how
far from the axis it crosses the film's plane, and where, across and along the meridian, it crosses the pupil's plane.
A regular grid over these holds the exact ray: position and transverse direction on the front surface, crossing with the
stop, transmittance. Rays between the nodes are interpolated linearly in each of the three.

The paper's axes and interpolation were not at hand, so that these are ours, and chosen for the table: the pupil point
is counted from the chief ray, so that no node lies far from light; across the meridian the table is folded, by mirror
symmetry; the planes are fixed to the glass, so that another film position needs no other table; between three
wavelengths stands the parabola in 1 / lambda^2. Beyond its ends the outermost cells go on. Nodes whose rays do not come
through take a polynomial of degree 5 through those that do. Who passes is tested as in the polynomial methods (stop,
inner and outer pupil).
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from experiments.accuracy.published.data import RawData
from experiments.accuracy.published.rtf import meridian_of, turn, turned_back
from neurolens.graph.interpret import monomials
from neurolens.graph.ir import Graph
from neurolens.models.cores import Core, CoreValues, Field, Units, stored_as
from neurolens.models.fitted import FilmRays
from neurolens.models.pairs import trace_pairs
from neurolens.models.targets import scales_of

Array = NDArray[np.float64]
_NODES_W = (-1.0, 0.0, 1.0)
_COLUMNS = 7  # position, direction, stop crossing (across and along the meridian each), transmittance
_BATCH = 16384
_FILL_DEGREE = 5


@stored_as("ray-table")
@dataclass(frozen=True, eq=False)
class RayTable(Core):
    """The core, without its tests of the pupils (`OuterPupil` has them).

    Attributes:
        table: [nodes, 7 W]: for each of W wavelengths the columns; nodes along the meridian run fastest, then those
            across it, then those of the film's radius.
        shape: nodes of film radius (0 to 1), across (0 to 1), along (-1 to 1).
    """

    table: Array
    shape: tuple[int, int, int]
    basis = "raw"

    def build(self, g: Graph, field: Field, units: Units) -> CoreValues:
        radius, y = meridian_of(field.p)
        across, along = turn(field.u, y)
        ends = np.array(self.shape) - 1.0
        place = g.affine(np.diag([*ends[:2], ends[2] / 2]), g.concat(radius, across.abs(), along), [0, 0, ends[2] / 2])
        cell = g.concat(*(place[k].clip(0.0, ends[k] - 1).floor() for k in range(3)))
        fraction = place - cell
        strides = (self.shape[1] * self.shape[2], self.shape[2], 1)
        first, table = g.affine(np.array([strides], float), cell), g.own_table(self.table)
        waves = g.constant(1.0)
        if self.table.shape[1] > _COLUMNS:  # the parabola through three nodes
            lagrange = np.array([[0, -0.5, 0.5], [1, 0, -1], [0, 0.5, 0.5]])
            w = field.colour() if field.dispersive else g.constant(0.0)
            waves = g.polynomial(np.arange(3)[:, None], lagrange, w)
        corners = list(itertools.product((0, 1), repeat=3))
        weights = []
        for corner in corners:
            a, b, c = (fraction[k] if high else 1.0 - fraction[k] for k, high in enumerate(corner))
            weights.append(waves * (a * b * c))
        found = g.lookup(table, first + np.array(corners) @ strides, g.concat(*weights))
        *pairs, transmittance = g.split(found, [2, 2, 2, 1])
        side = g.select(across <= 0.0, -1.0, 1.0)
        vectors = (
            turned_back(g.concat(v[0] * (side * unit), v[1] * unit), y)
            for v, unit in zip(pairs, units.vectors, strict=True)
        )
        return CoreValues(tuple(vectors), transmittance, None)  # type: ignore[arg-type]

    @property
    def coefficients(self) -> int:
        return int(self.table.size)

    @property
    def coefficients_per_vector(self) -> int:
        return 2 * self.table.size // _COLUMNS


def fit_table(data: RawData, nodes: int) -> RayTable:
    """The exact rays of a grid of `nodes` film radii, half as many and one points across, `nodes` along."""
    shape = (nodes, nodes // 2 + 1, nodes)
    axes = (np.linspace(0, 1, shape[0]), np.linspace(0, 1, shape[1]), np.linspace(-1, 1, shape[2]))
    grid = np.stack([c.reshape(-1) for c in np.meshgrid(*axes, indexing="ij")])
    waves = _NODES_W if data.dispersive else (0.0,)
    tables = [np.concatenate([_exact(data, grid[:, i : i + _BATCH], w) for i in range(0, grid.shape[1], _BATCH)])
              for w in waves]  # fmt: skip
    return RayTable(np.concatenate([_filled(grid, t) for t in tables], axis=1), shape)


def _exact(data: RawData, grid: Array, w: float) -> Array:
    """[N, 7] of nodes [3, N] at one wavelength, rays turned so that their meridian is the y axis; NaN: none."""
    e, lens = data.encoding, data.pairs.lens
    radius, across, along = torch.from_numpy(grid)
    p, zero = radius * e.film_scale_mm, torch.zeros_like(radius)
    wavelength = data.pairs.domain.wavelength_nm[0]
    if data.dispersive:
        wavelength = 1000 / (e.w_middle + w * e.w_half) ** 0.5
    pupil = across * e.pupil_scale_mm, e.chief * p + along * e.pupil_scale_mm
    rays = trace_pairs(
        lens, FilmRays(zero, p, zero + e.film_plane_z_mm, *pupil, zero + wavelength), data.pairs.domain.pupil_z_mm
    )
    scale, scene, k = scales_of(lens), rays.scene, lens.stop_index
    values = torch.stack([
        scene.x / scale.position_mm, scene.y / scale.position_mm, scene.dx, scene.dy,
        rays.cross_x[k] / scale.stop_mm, rays.cross_y[k] / scale.stop_mm, rays.transmittance,
    ])  # fmt: skip
    lost = (rays.meets <= 0).any(0) | (rays.refracts <= 0).any(0)
    return np.where(lost, np.nan, values).T


def _filled(grid: Array, table: Array) -> Array:
    """The table with a polynomial where it has no rays."""
    powers = [e for e in itertools.product(range(_FILL_DEGREE + 1), repeat=3) if sum(e) <= _FILL_DEGREE]
    known = np.isfinite(table.sum(1))
    if known.all():
        return table
    columns = monomials(grid, np.array(powers)).T
    found = np.linalg.lstsq(columns[known], table[known], rcond=None)[0]
    return np.where(known[:, None], table, columns @ found)
