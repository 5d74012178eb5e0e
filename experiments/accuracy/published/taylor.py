"""Polynomial Optics (Hullin, Hanika, Heidrich 2012): Taylor polynomials of every element about the axis, composed.

A ray is its position and the transverse components of its unit direction in a plane; free space and refraction at a
surface are expanded about the axis in these four to a total degree, and a lens is their composition in truncated
polynomial arithmetic. Every element takes the axis to itself, so that evaluating its formulas on the polynomials of the
rays so far is that composition, and nothing below the degree is lost. No ray is traced and nothing is fitted. Variables
are the film position and the slope of the ray: a linear change of the paper's two-plane coordinates (film point and
pupil point), which changes no polynomial of a total degree; nor does taking the chief ray's part off the slope.

Rays pass where they cross the stop and the outer and inner pupil (the front and the rear surface) within their radii.

Left open by the paper and chosen here: the last element ends on the front surface itself, not on a plane; coefficients
are interpolated in 1 / lambda^2 between three wavelengths (their library's example: linearly between two); the
transmittance is that of the axial ray; conics and even aspheres are expanded like spheres, odd powers have no series.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from functools import lru_cache
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from experiments.accuracy.published.data import RawPolynomial, raw_polynomial
from neurolens.base.errors import InputError
from neurolens.models.fitted import Encoding
from neurolens.models.targets import scales_of
from neurolens.models.terms import ordered
from neurolens.optics.lens.glass import index_of
from neurolens.optics.lens.prescription import Lens, Surface
from neurolens.optics.trace.rays import trace
from neurolens.optics.trace.surfaces import Rays

# Coefficients [M] of `Truncated.exponents`: a power series in several variables, cut beyond a total degree.
Series = NDArray[np.float64]
# Wavelengths at which the lens is expanded, in w; coefficients are interpolated by the parabola through them.
NODES = (-1.0, 0.0, 1.0)


class Truncated:
    """Arithmetic of series in `variables` variables to a total `degree`.

    Attributes:
        exponents: [M, variables] int64, the constant first.
    """

    def __init__(self, variables: int, degree: int) -> None:
        rows = [e for e in itertools.product(range(degree + 1), repeat=variables) if sum(e) <= degree]
        self.exponents: NDArray[np.int64] = ordered(rows)
        self.degree = degree
        total = self.exponents.sum(1)
        left, right = np.nonzero(total[:, None] + total[None, :] <= degree)
        place = {tuple(map(int, e)): k for k, e in enumerate(self.exponents)}
        made = self.exponents[left] + self.exponents[right]
        self._left, self._right = left, right
        self._product = np.array([place[tuple(map(int, e))] for e in made])

    def variable(self, k: int, scale: float = 1.0) -> Series:
        """`scale` times variable k."""
        wanted = np.zeros(self.exponents.shape[1], dtype=np.int64)
        wanted[k] = 1
        return scale * (self.exponents == wanted).all(1).astype(np.float64)

    def constant(self, value: float) -> Series:
        return value * (self.exponents == 0).all(1).astype(np.float64)

    def times(self, a: Series, b: Series) -> Series:
        """The product, cut."""
        found = np.bincount(self._product, a[self._left] * b[self._right], len(self.exponents))
        return np.asarray(found, dtype=np.float64)

    def of(self, taylor: Sequence[float], a: Series) -> Series:
        """f(a) from the Taylor coefficients of f about a's constant, `degree` + 1 of them."""
        small = a.copy()
        small[0] = 0.0
        out = self.constant(taylor[-1])
        for coefficient in reversed(taylor[:-1]):
            out = self.times(out, small)
            out[0] += coefficient
        return out

    def power(self, a: Series, exponent: float) -> Series:
        """a to any power; the constant of `a` must be positive unless the exponent is a natural number.

        Raises:
            ValueError: no such series.
        """
        if exponent == int(exponent) and exponent >= 0:
            out = self.constant(1.0)
            for _ in range(int(exponent)):
                out = self.times(out, a)
            return out
        if not a[0] > 0:
            raise ValueError(f"no power series of a^{exponent} about {a[0]}")
        taylor = [a[0] ** exponent]
        for k in range(self.degree):
            taylor.append(taylor[-1] * (exponent - k) / ((k + 1) * a[0]))
        return self.of(taylor, a)


truncated = lru_cache(maxsize=8)(Truncated)  # made once


class RaySeries(NamedTuple):
    """Rays as series: position (mm) and transverse components of the unit direction."""

    x: Series
    y: Series
    dx: Series
    dy: Series


class Expanded(NamedTuple):
    """A lens at one wavelength: the ray on the front surface, and the crossing with the stop (mm)."""

    scene: RaySeries
    stop_x: Series
    stop_y: Series


def expand(lens: Lens, encoding: Encoding, wavelength_nm: float, degree: int) -> Expanded:
    """Camera rays through a lens as series in the four coordinates p, u of a light field.

    Raises:
        InputError: a surface that has no power series at its vertex.
    """
    t = truncated(4, degree)
    distance = encoding.film_plane_z_mm - encoding.pupil_plane_z_mm
    x, y = t.variable(0, encoding.film_scale_mm), t.variable(1, encoding.film_scale_mm)
    pupil_x, pupil_y = (t.variable(k, encoding.pupil_scale_mm) for k in (2, 3))
    slope_x, slope_y = ((pupil + (encoding.chief - 1) * c) / distance for pupil, c in ((pupil_x, x), (pupil_y, y)))
    along = t.power(t.constant(1.0) + _square(t, slope_x, slope_y), -0.5)
    ray = RaySeries(x, y, t.times(slope_x, along), t.times(slope_y, along))
    vertices, plane, stop = lens.vertices_mm, encoding.film_plane_z_mm, ray
    indices = [float(index_of(medium, wavelength_nm)) for medium in lens.media]
    for k in range(len(lens.surfaces) - 1, -1, -1):
        ray = propagate(t, ray, plane - float(vertices[k]))
        ray, height = refract(t, lens, k, ray, indices[k + 1], indices[k])
        if k == lens.stop_index:
            stop = ray
        if k:  # back to the plane of the vertex, but for the last surface met
            ray = propagate(t, ray, -height)
            plane = float(vertices[k])
    return Expanded(ray, stop.x, stop.y)


def _square(t: Truncated, a: Series, b: Series) -> Series:
    return t.times(a, a) + t.times(b, b)


def propagate(t: Truncated, ray: RaySeries, distance: float | Series) -> RaySeries:
    """Free space along the axis by a distance (mm, number or series) in the direction of travel."""
    tangent = t.power(t.constant(1.0) - _square(t, ray.dx, ray.dy), -0.5)
    if isinstance(distance, np.ndarray):
        tangent = t.times(tangent, distance)
    else:
        tangent = tangent * distance
    return ray._replace(x=ray.x + t.times(ray.dx, tangent), y=ray.y + t.times(ray.dy, tangent))


def refract(t: Truncated, lens: Lens, k: int, ray: RaySeries, before: float, after: float) -> tuple[RaySeries, Series]:
    """Surface k, met by camera rays in its vertex plane: the ray on the surface, and the surface's height there.

    The height (mm) counts in the direction of travel, from the scene's side negative sag.
    """
    surface = lens.surfaces[k]
    if surface.figure.axis is not None or any(power % 2 for power, _ in surface.figure.asphere):
        raise InputError(lens.path, f"surfaces[{k}]", "(cylinder or odd powers)", "a surface with a Taylor series")
    height, met = t.constant(0.0), ray
    for _ in range(t.degree // 2 + 1):  # each round makes two more degrees right
        met = propagate(t, ray, height)
        height, steepness = _sag(t, surface, _square(t, met.x, met.y))
    # The unit normal in the direction of travel: (-2 S' x, -2 S' y, 1) / length, for a height S(x^2 + y^2).
    pull = -2 * steepness
    r2 = _square(t, met.x, met.y)
    inverse = t.power(t.constant(1.0) + t.times(t.times(pull, pull), r2), -0.5)
    normal_x, normal_y = (t.times(t.times(pull, c), inverse) for c in (met.x, met.y))
    forward = t.power(t.constant(1.0) - _square(t, ray.dx, ray.dy), 0.5)
    cosine = t.times(ray.dx, normal_x) + t.times(ray.dy, normal_y) + t.times(forward, inverse)
    q_before = before * cosine
    q_after = t.power(t.times(q_before, q_before) + t.constant(after**2 - before**2), 0.5)
    bend = q_after - q_before
    bent = ((before * d + t.times(bend, n)) / after for d, n in ((ray.dx, normal_x), (ray.dy, normal_y)))
    return RaySeries(met.x, met.y, *bent), height


def _sag(t: Truncated, surface: Surface, r2: Series) -> tuple[Series, Series]:
    """Height in the direction of travel (towards the scene) at squared radii, and its derivative by them."""
    c, bend = float(surface.curvature), (1 + float(surface.figure.conic)) * float(surface.curvature) ** 2
    root = t.power(t.constant(1.0) - bend * r2, 0.5)
    sag = c * t.times(r2, t.power(t.constant(1.0) + root, -1.0))
    slope = c / 2 * t.power(root, -1.0)
    for power, a in surface.figure.asphere:
        sag = sag + float(a) * t.power(r2, power // 2)
        slope = slope + float(a) * (power // 2) * t.power(r2, power // 2 - 1)
    return -sag, -slope


def fit_taylor(lens: Lens, encoding: Encoding, degree: int) -> RawPolynomial:
    """The Taylor polynomial of a lens in the coordinates of an encoding; tangents are dx and dy themselves.

    Raises:
        InputError: a surface that has no power series at its vertex.
    """
    nodes = NODES if encoding.w_half else (0.0,)
    scale = scales_of(lens)
    tables = []
    for w in nodes:
        wavelength = 1000 / (encoding.w_middle + w * encoding.w_half) ** 0.5
        scene, stop_x, stop_y = expand(lens, encoding, wavelength, degree)
        axial = np.zeros_like(stop_x)
        axial[0] = _axial_transmittance(lens, encoding, wavelength)
        position, stop = np.array(scene[:2]) / scale.position_mm, np.array([stop_x, stop_y]) / scale.stop_mm
        tables.append(np.concatenate([position, scene[2:], stop, axial[None]]))  # [7, M]
    # Coefficients of 1, w, w^2 from the values at the nodes.
    powers = np.linalg.solve(np.vander(np.array(nodes), increasing=True), np.stack(tables).reshape(len(nodes), -1))
    rows = torch.from_numpy(np.concatenate(list(powers.reshape(len(nodes), 7, -1)), axis=1))  # [7, nodes * M]
    four = truncated(4, degree).exponents
    exponents = np.concatenate([np.pad(four, ((0, 0), (0, 1)), constant_values=i) for i in range(len(nodes))])
    used = (rows != 0).any(0)
    rows, exponents = rows[:, used], exponents[used.numpy()]
    return raw_polynomial(exponents, rows)


def _axial_transmittance(lens: Lens, encoding: Encoding, wavelength_nm: float) -> float:
    zero, one = torch.zeros(1, dtype=torch.float64), torch.ones(1, dtype=torch.float64)
    axis = Rays(zero, zero, zero + encoding.film_plane_z_mm, zero, zero, -one)
    power = trace(lens, axis, wavelength_nm, transmittance=True).transmittance
    assert power is not None
    return float(power[0])
