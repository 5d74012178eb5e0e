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
_COLOURED = 2  # powers of x and y squared of what the centre of an anamorphic lens's moves by with the wavelength


@dataclass(frozen=True)
class StopImage:
    """Centre, half widths and shear of the stop's image.

    Attributes:
        unit_mm: that film points are scaled by. film_z_mm, wave: middle and half range of film positions and of
            (1000 / wavelength)^2.
        exponents: [M, 3 or 4]: of the film radius squared, or of x and y squared, of the film position and of the
            wavelength, which moves the centre alone.
        numbers: [4 or 5, M]: of the centre over the scaled film point, x and y (mm), of the half widths over those of
            the stop and, of an anamorphic lens, of its shear over the product of x and y.
    """

    unit_mm: float
    film_z_mm: tuple[float, float]
    wave: tuple[float, float]
    exponents: NDArray[np.int64]
    numbers: Array

    def placed(self, film: Value, film_z: Value, nanometres: Value, point: Value) -> tuple[Value, Value]:
        """The pupil point [2] of a point in the image (mm at the stop), and the area of a unit of area there."""
        g, (middle, half), (mean, reach) = film.graph, self.film_z_mm, self.wave
        scaled, anamorphic = film * (1 / self.unit_mm), len(self.numbers) > 4
        squares = scaled * scaled if anamorphic else g.square(scaled)
        place, inverse = (film_z - middle) * (1 / half), 1000.0 / nanometres

        def rows(coloured: bool, numbers: Array) -> Value:
            own = self.exponents[:, -1] == coloured
            powers, numbers = self.exponents[own], numbers[:, own]
            parts = [powers[:, -2] == k for k in range(powers[:, -2].max() + 1)]
            first, *others = (g.polynomial(powers[p, :-2], numbers[:, p], squares) for p in parts[::-1])
            return reduce(lambda total, part: total * place + part, others, first)

        found = rows(False, self.numbers)
        centre, wide, area = found[0:2], found[2:4], found[2] * found[3]
        if anamorphic:
            wave = inverse * inverse * (1 / reach) - mean / reach
            centre = centre + rows(True, self.numbers[:2]) * wave
            shear = found[4] * scaled[0] * scaled[1]
            point = point + g.concat(point[1], point[0]) * shear
            area = area * (1.0 - shear * shear)
        return scaled * centre + wide * point, area

    def before(self, lens: Graph) -> Graph:
        """The graph of the lens, of rays through points in the image in place of pupil points."""
        g = Graph()
        rays, film_z = g.input("rays", 5), g.input("film_z_mm", per_call=True)
        pupil, _ = self.placed(rays[0:2], film_z, rays[4], rays[2:4])
        g.outputs = g.inline(lens, {"rays": g.concat(rays[0:2], pupil, rays[4]), "film_z_mm": film_z})
        return g


def stop_image(
    lens: Graph, film_radius_mm: float, film_z_mm: tuple[float, float], wavelength_nm: tuple[float, float],
    stop_mm: float, anamorphic: bool,
) -> StopImage | None:  # fmt: skip
    """Of the graph of a lens, to whose stop rays are aimed by Newton's rule; None where few film points have one.

    Args:
        stop_mm: radius of the widest stop. anamorphic: symmetric about x and y alone.
    """
    low, high = film_z_mm
    planes = np.linspace(low, high, _PLANES if high > low else 1)
    azimuths = np.linspace(0, np.pi / 2, _AZIMUTHS if anamorphic else 1)
    radii, white = film_radius_mm * np.sqrt(np.linspace(0, 1, _RADII)), float(np.mean(wavelength_nm))
    colours = (white, *wavelength_nm) if anamorphic else (white,)
    radius, azimuth, z, nm = (v.ravel() for v in np.meshgrid(radii, azimuths, planes, colours))
    film = radius * np.stack([np.cos(azimuth), np.sin(azimuth)])

    def crossing(pupil: Array) -> Array:
        rays = np.concatenate([film, pupil, nm[None]])
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
        shear = (inverse[0, 1] / inverse[0, 0] + inverse[1, 0] / inverse[1, 1]) / 2
        found = (np.hypot(*left) < _FOUND * stop_mm) & np.isfinite(wide).all(0) & np.isfinite(pupil).all(0)
    if found.mean() < _FEWEST:
        return None
    if not anamorphic:  # what the image is longer than wide is left to the arcs
        wide = np.repeat(wide[1:], 2, axis=0)
    rows = film[:, found], z[found], nm[found], pupil[:, found], np.stack([*wide, shear])[:, found]
    return _fitted(*rows, film_radius_mm, film_z_mm, wavelength_nm, anamorphic)


def _fitted(
    film: Array, z: Array, nm: Array, centre: Array, shape: Array, unit_mm: float, film_z_mm: tuple[float, float],
    wavelength_nm: tuple[float, float], anamorphic: bool,
) -> StopImage:  # fmt: skip
    """Of film points [2, N]: the image's centre [2, N] (mm), and [3, N] half widths and shear."""
    (low, high), (long, short) = film_z_mm, ((1000 / w) ** 2 for w in reversed(wavelength_nm))
    middle, half = (low + high) / 2, max((high - low) / 2, 1e-6)
    mean, reach = (long + short) / 2, max((short - long) / 2, 1e-9)
    x, exponents = film / unit_mm, _exponents(anamorphic)
    squares = x * x if anamorphic else (x * x).sum(0)[None]
    variables = np.stack([*squares, (z - middle) / half, ((1000 / nm) ** 2 - mean) / reach])
    monomials = np.prod(variables ** exponents[:, :, None], axis=1)
    still = monomials * (exponents[:, -1] == 0)[:, None]
    # Points of a round lens are on +x.
    wanted = [(monomials * x[k], centre[k]) for k in ((0, 1) if anamorphic else (0, 0))]
    wanted += [(still, shape[0]), (still, shape[1])]
    if anamorphic:
        wanted.append((still * x[0] * x[1], shape[2]))
    numbers = [np.linalg.lstsq(rows.T, value, rcond=None)[0] for rows, value in wanted]
    return StopImage(unit_mm, (middle, half), (mean, reach), exponents, np.stack(numbers))


def _inverse(columns: Array) -> Array:
    """[2, 2, N] of matrices [2, 2, N]."""
    (a, b), (c, d) = columns
    return np.stack([np.stack([d, -b]), np.stack([-c, a])]) / (a * d - b * c)


def _exponents(anamorphic: bool) -> NDArray[np.int64]:
    if not anamorphic:
        return np.array([(i, k, 0) for k, powers in enumerate(_ROUND) for i in range(powers)], np.int64)
    found = [(i, j, k, 0) for k, powers in enumerate(_ANAMORPHIC) for i in range(powers) for j in range(powers - i)]
    found += [(i, j, 0, 1) for i in range(_COLOURED) for j in range(_COLOURED - i)]
    return np.array(found, np.int64)
