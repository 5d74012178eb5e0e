"""The image of a lens's stop in its pupil, by film point: its centre and half widths, as short polynomials.

Where a lens is anamorphic, or its chief rays cross the pupil plane at places of high order, pupil points in units of
this image are all but those of the stop: what is left for `pupil_arcs` is little.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import reduce

import numpy as np
from numpy.typing import NDArray

from neurolens.graph.interpret import evaluate
from neurolens.graph.ir import Graph, Value

Array = NDArray[np.float64]
_RADII, _AZIMUTHS, _PLANES = 24, 7, 5  # where the image is sought: of the film, of a quadrant, film positions
_ROUNDS, _STEP, _FAR = 12, 0.02, 0.3  # of Newton's rule: its difference and longest step, in stop radii
_FOUND, _FEWEST = 0.01, 0.5  # stop radii beside the stop's middle; of film points that must have it
# Powers of the film radius squared, or of x and y squared together, by those of the film position.
_ROUND, _ANAMORPHIC = (9, 7, 5), (4, 2)


@dataclass(frozen=True)
class StopImage:
    """Centre and half widths of the stop's image.

    Attributes:
        unit_mm: that film points are scaled by. film_z_mm: middle and half range of film positions.
        exponents: [M, 2 or 3]: of the film radius squared, or of x and y squared, and of the film position.
        numbers: [4, M]: of the centre over the scaled film point, x and y (mm), and of the half widths over those of
            the stop.
    """

    unit_mm: float
    film_z_mm: tuple[float, float]
    exponents: NDArray[np.int64]
    numbers: Array

    def placed(self, film: Value, film_z: Value, point: Value) -> tuple[Value, Value]:
        """The pupil point [2] of a point in the image (mm at the stop), and the area of a unit of area there."""
        g, (middle, half) = film.graph, self.film_z_mm
        scaled = film * (1 / self.unit_mm)
        squares = g.square(scaled) if self.exponents.shape[1] == 2 else scaled * scaled
        place = (film_z - middle) * (1 / half)
        parts = [self.exponents[:, -1] == k for k in range(self.exponents[:, -1].max() + 1)]
        first, *others = (g.polynomial(self.exponents[p, :-1], self.numbers[:, p], squares) for p in parts[::-1])
        rows = reduce(lambda rows, part: rows * place + part, others, first)
        return scaled * rows[0:2] + rows[2:4] * point, rows[2] * rows[3]

    def before(self, lens: Graph) -> Graph:
        """The graph of the lens, of rays through points in the image in place of pupil points."""
        g = Graph()
        rays, film_z = g.input("rays", 5), g.input("film_z_mm", per_call=True)
        pupil, _ = self.placed(rays[0:2], film_z, rays[2:4])
        g.outputs = g.inline(lens, {"rays": g.concat(rays[0:2], pupil, rays[4]), "film_z_mm": film_z})
        return g


def stop_image(
    lens: Graph, film_radius_mm: float, film_z_mm: tuple[float, float], nanometres: float, stop_mm: float,
    anamorphic: bool,
) -> StopImage | None:  # fmt: skip
    """Of the graph of a lens, to whose stop rays are aimed by Newton's rule; None where few film points have one.

    Args:
        stop_mm: radius of the widest stop. anamorphic: symmetric about x and y alone.
    """
    low, high = film_z_mm
    planes = np.linspace(low, high, _PLANES if high > low else 1)
    azimuths = np.linspace(0, np.pi / 2, _AZIMUTHS if anamorphic else 1)
    radii = film_radius_mm * np.sqrt(np.linspace(0, 1, _RADII))
    radius, azimuth, z = (v.ravel() for v in np.meshgrid(radii, azimuths, planes))
    film = radius * np.stack([np.cos(azimuth), np.sin(azimuth)])

    def crossing(pupil: Array) -> Array:
        rays = np.concatenate([film, pupil, np.full((1, z.size), nanometres)])
        given = {"rays": rays, "film_z_mm": z[None], "stop_radius_mm": np.array([[stop_mm]])}
        return evaluate(lens, given)["stop_xy_mm"].astype(np.float64)

    pupil, nudge = np.zeros_like(film), _STEP * stop_mm
    with np.errstate(all="ignore"):  # rays that miss the lens
        for _ in range(_ROUNDS):
            sides = [crossing(pupil + way[:, None]) - crossing(pupil - way[:, None]) for way in np.eye(2) * nudge]
            inverse = 2 * nudge * _inverse(np.stack(sides, 1))
            left = crossing(pupil)
            pupil = pupil - np.einsum("ijn,jn->in", inverse, left).clip(-_FAR * stop_mm, _FAR * stop_mm)
        wide = np.abs(np.stack([inverse[0, 0], inverse[1, 1]]))
        found = (np.hypot(*left) < _FOUND * stop_mm) & np.isfinite(wide).all(0) & np.isfinite(pupil).all(0)
    if found.mean() < _FEWEST:
        return None
    if not anamorphic:  # what the image is longer than wide is left to the arcs
        wide = np.repeat(wide[1:], 2, axis=0)
    middle, half = (low + high) / 2, max((high - low) / 2, 1e-6)
    exponents = _exponents(anamorphic)
    x = film[:, found] / film_radius_mm
    squares = x * x if anamorphic else (x * x).sum(0)[None]
    variables = np.concatenate([squares, (z[None, found] - middle) / half])
    monomials = np.prod(variables[None] ** exponents[:, :, None], axis=1)
    rows = [
        (monomials * x[0], pupil[0, found]),
        (monomials * x[1], pupil[1, found]),
        *((monomials, w) for w in wide[:, found]),
    ]
    if not anamorphic:  # of points on +x
        rows[1] = rows[0]
    numbers = [np.linalg.lstsq(m.T, wanted, rcond=None)[0] for m, wanted in rows]
    return StopImage(film_radius_mm, (middle, half), exponents, np.stack(numbers))


def _inverse(columns: Array) -> Array:
    """[2, 2, N] of matrices [2, 2, N]."""
    (a, b), (c, d) = columns
    return np.stack([np.stack([d, -b]), np.stack([-c, a])]) / (a * d - b * c)


def _exponents(anamorphic: bool) -> NDArray[np.int64]:
    if not anamorphic:
        return np.array([(i, k) for k, powers in enumerate(_ROUND) for i in range(powers)], np.int64)
    found = [(i, j, k) for k, powers in enumerate(_ANAMORPHIC) for i in range(powers) for j in range(powers - i)]
    return np.array(found, np.int64)
