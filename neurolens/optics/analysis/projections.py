"""Projections of other programs: from a direction to a pixel, and their fit to a lens.

Frame and pixels are OpenCV's: x right, y down, z towards the scene; the centre of the first pixel is 0, 0. With
x' = x / z, y' = y / z, r^2 = x'^2 + y'^2, t the angle to z, and the pixel c + (fx u, fy v):

    opencv          u = x' q + 2 p1 x' y' + p2 (r^2 + 2 x'^2), v alike; q = 1 + k1 r^2 + k2 r^4 + k3 r^6
    opencv-rational the same, q over 1 + k4 r^2 + k5 r^4 + k6 r^6
    kannala-brandt  (u, v) = d (x, y) / |(x, y)|, d = t (1 + k1 t^2 + k2 t^4 + k3 t^6 + k4 t^8): OpenCV's fisheye
    f-theta         the same with d = sum of a_i t^i in pixels, fy = 1, fx the c of NVIDIA's linear transformation

A lens centred on its axis has p1 = p2 = 0 and its principal point on the axis, so that neither is fitted;
without cylinders it has fx = fy. All of these have one centre; `RayTable` has a ray of its own for every pixel.
Sources: OpenCV, modules calib3d and fisheye; Kannala and Brandt 2006, IEEE PAMI 28(8); NVIDIA, documentation of NCore,
sensor models; Schoeps et al. 2020, "Why Having 10,000 Parameters in Your Camera Model Is Better Than Twelve", CVPR.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import NdBSpline  # type: ignore[import-untyped]
from scipy.optimize import least_squares  # type: ignore[import-untyped]
from scipy.sparse import diags, eye, kron  # type: ignore[import-untyped]
from scipy.sparse.linalg import spsolve  # type: ignore[import-untyped]

from neurolens.base.errors import InputError

Array = NDArray[np.float64]

NAMES = {
    "opencv": ("k1", "k2", "p1", "p2", "k3"),
    "opencv-rational": ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"),
    "kannala-brandt": ("k1", "k2", "k3", "k4"),
    "f-theta": ("a1", "a2", "a3", "a4", "a5"),
}
PLANAR = ("opencv", "opencv-rational")
WIDEST_DEG = 85.0  # of projections that divide by z
_FIXED = ("p1", "p2")
_RATIO = ("k4", "k5", "k6")  # in the denominator
_REACH = (
    1.25  # over the widest angle's radius: so far a ratio has no pole, for programs show a margin beyond the picture
)
_ROUNDING = 1e-6  # imaginary part over size, below which a root counts as real
_TINY = 1e-24  # square of the sine: a smaller one is on the axis
_NOT_FOLDED = 179.0, 89.9  # degrees up to which a fold is looked for: about the lens, and on the plane
_ANGLES = 4097  # angles that are tried for it
_STEP = 1e-30  # of derivatives along the imaginary axis, which have no error of differences
_BINS = 5  # parts of the field in a report
_SMOOTH = 1e-9  # weight of a table's bending over that of its points: it continues the table where the picture is dark


@dataclass(frozen=True)
class Projection:
    """A projection of some kind, with its numbers.

    Attributes:
        kind: one of `NAMES`. size: of the picture in pixels.
        focal_px: fx, fy; for f-theta see the module.
        coefficients: in the order of the kind's names.
        widest_rad: the angle at which the picture ends.
        off_px: from the middle of the picture to the axis, which a shifted film has elsewhere.
    """

    kind: str
    size: tuple[int, int]
    focal_px: tuple[float, float]
    coefficients: tuple[float, ...]
    widest_rad: float
    off_px: tuple[float, float] = (0.0, 0.0)

    @property
    def centre_px(self) -> tuple[float, float]:
        """The principal point in pixels."""
        return (self.size[0] - 1) / 2 + self.off_px[0], (self.size[1] - 1) / 2 + self.off_px[1]

    @property
    def named(self) -> dict[str, float]:
        """Return the coefficients with their names, such as k1."""
        return dict(zip(NAMES[self.kind], self.coefficients, strict=True))

    @property
    def numbers(self) -> Array:
        """fx, fy and the coefficients, in one array."""
        return np.array([*self.focal_px, *self.coefficients])

    def project(self, direction: Array, numbers: NDArray[Any] | None = None) -> NDArray[Any]:
        """Return pixels [..., 2] of directions [..., 3] of any length; the formula also holds beyond the picture.

        They are NaN where a projection that divides by z sees nothing. `numbers` replaces its own fx, fy and
        coefficients; complex ones give complex pixels.
        """
        values = self.numbers if numbers is None else numbers
        x, y, z = np.moveaxis(np.asarray(direction, np.float64), -1, 0)
        if self.kind in PLANAR:
            x, y = (np.divide(v, z, out=np.full(z.shape, np.nan), where=z > 0) for v in (x, y))
            u, v = _bent(self.kind, values[2:], x, y)
        else:
            side = np.sqrt(x * x + y * y + _TINY * (x * x + y * y + z * z))
            distance = self._distance(values[2:], np.arctan2(side, z)) / side
            u, v = distance * x, distance * y
        return np.stack([u, v], -1) * values[:2] + self.centre_px

    @cached_property
    def fold_rad(self) -> float:
        """Return the angle from which on radii shrink, at any azimuth; if they never do, the last that is tried."""
        end = math.radians(_NOT_FOLDED[self.kind in PLANAR])
        angle = np.linspace(0, end, _ANGLES)[:, None]
        turn = np.linspace(0, math.pi / 2, 7)
        rays = [np.sin(angle) * np.cos(turn), np.sin(angle) * np.sin(turn), np.cos(angle) + 0 * turn]
        radius = np.linalg.norm(self.project(np.stack(rays, -1)) - self.centre_px, axis=-1)
        rising = (np.diff(radius, axis=0) > 0).all(axis=1)
        return end if rising.all() else float(angle[rising.argmin(), 0])

    @property
    def pole(self) -> bool:
        """Return whether a denominator is zero within the picture."""
        bottom = [self.named.get(name, 0.0) for name in _RATIO]
        return self.kind in PLANAR and has_pole(bottom, (_REACH * math.tan(self.widest_rad)) ** 2)

    @property
    def sharp_rad(self) -> Array:
        """Return the angles of the picture at which a denominator is least: rings that points on a grid may miss."""
        at = roots([self.named.get(name, 0.0) for name in _RATIO]).real if self.kind in PLANAR else np.zeros(0)
        angle = np.arctan(np.sqrt(at[at > 0]))
        return np.asarray(angle[angle <= self.widest_rad])

    def _distance(self, coefficients: NDArray[Any], angle: Array) -> Any:
        if self.kind == "f-theta":
            return angle * _series(coefficients, angle)
        return angle * (1 + angle * angle * _series(coefficients, angle * angle))


def _series(coefficients: NDArray[Any], x: Array) -> Any:
    """Return the value of a polynomial whose lowest coefficient comes first."""
    return np.polynomial.polynomial.polyval(x, coefficients)


def roots(bottom: Sequence[float]) -> NDArray[np.complex128]:
    """Return the x at which 1 + k x + l x^2 + ... is zero."""
    return np.asarray(np.roots([*reversed(bottom), 1.0]), np.complex128)


def along_radius(start: Any, goal: Any) -> tuple[Array, Any, Array]:
    """Return distances of places x + i y from the centre, the ways there, and how far out along these goals lie."""
    radius = np.abs(start)
    turn = start / np.where(radius > 0, radius, 1.0)
    return radius, turn, (goal * turn.conj()).real


def has_pole(bottom: Sequence[float], widest: float) -> bool:
    """Return whether 1 + k x + l x^2 + ... is zero for a real x from 0 to `widest`."""
    at = roots(bottom)
    # Rounding turns two real roots that are close into a pair with small imaginary parts.
    real = np.abs(at.imag) <= _ROUNDING * np.abs(at)
    return bool((real & (at.real > 0) & (at.real <= widest)).any())


def _bent(kind: str, c: NDArray[Any], x: Array, y: Array) -> tuple[Any, Any]:
    """Return the images of points x', y' of the plane."""
    r2 = x * x + y * y
    k1, k2, p1, p2, k3 = c[:5]
    q = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    if kind == "opencv-rational":
        k4, k5, k6 = c[5:]
        q = q / (1 + r2 * (k4 + r2 * (k5 + r2 * k6)))
    return x * q + 2 * p1 * x * y + p2 * (r2 + 2 * x * x), y * q + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y


@dataclass(frozen=True)
class Residual:
    """What a fitted projection leaves: distances in pixels.

    Attributes:
        rms_px, worst_px: over all points. worst: number of the point with the worst. worst_at_deg: its field.
        by_field: for equal parts of the field: from and to in degrees, RMS and worst.
        field_deg: the widest angle of the points. fold_deg: the angle from which on the projection turns back.
    """

    rms_px: float
    worst_px: float
    worst: int
    worst_at_deg: float
    by_field: tuple[tuple[float, float, float, float], ...]
    field_deg: float
    fold_deg: float

    @property
    def sound(self) -> bool:
        """Whether the projection rises over the whole field."""
        return self.fold_deg > self.field_deg * (1 - 1e-9)


def fit(
    kind: str | None,
    direction: Array,
    pixel: Array,
    size: tuple[int, int],
    focal_px: tuple[float, float],
    source: str = "projection",
    light: Array | None = None,
    off_px: tuple[float, float] = (0.0, 0.0),
) -> Projection:
    """Fit a projection with the least mean squared distance from pixels, weighted by their light.

    Args:
        kind: None takes OpenCV's planar one, or its fisheye where the field is too wide for a plane.
        direction: [N, 3] unit vectors. pixel: [N, 2] where a lens shows them; both spread evenly over the picture.
        size: of the picture. focal_px: paraxial fx and fy; where they are equal, they stay equal.
        source: what errors name.
        light: [N] that arrives; None weights all alike. At the rim of an image circle only some colours arrive, and
            from elsewhere.
        off_px: of the axis, as of `Projection`.

    Raises:
        InputError: the field is too wide for this kind, or there are fewer points than numbers.
    """
    widest = float(_angle(direction).max(initial=0))
    kind = kind or ("opencv" if math.degrees(widest) <= WIDEST_DEG else "kannala-brandt")
    if kind in PLANAR and math.degrees(widest) > WIDEST_DEG:
        expected = f"a field up to {WIDEST_DEG:g} degrees from the axis: --projection kannala-brandt or f-theta"
        raise InputError(source, f"--projection {kind}", f"({math.degrees(widest):.4g} degrees)", expected)
    if len(pixel) < 2 * len(NAMES[kind]) + 2:
        raise InputError(source, "picture", f"({len(pixel)} lit points)", "a picture that light reaches")
    start = Projection(kind, size, focal_px, (0.0,) * len(NAMES[kind]), widest, off_px)
    # A ratio with one term too many spends it on a pole beside a zero: terms of the denominator are dropped until no
    # pole is left.
    weight = np.ones((1, 1)) if light is None else np.sqrt(light)[:, None]
    for dropped in range(4 if kind == "opencv-rational" else 1):
        fixed = _RATIO[len(_RATIO) - dropped :]
        found = _adjusted(start, direction, pixel, weight, focal_px[0] == focal_px[1], fixed)
        if not found.pole:
            break
    return found


def _angle(direction: Array) -> Array:
    """Return angles to the axis in rad of directions [N, 3]."""
    return np.arctan2(np.hypot(direction[:, 0], direction[:, 1]), direction[:, 2])


def residual(projection: Projection, direction: Array, pixel: Array) -> Residual:
    """Return the residual of a projection at pixels [N, 2] of directions [N, 3] to which it was not fitted."""
    miss = np.linalg.norm(projection.project(direction) - pixel, axis=-1)
    angle = np.degrees(_angle(direction))
    widest = float(angle.max())
    rows = []
    for k in range(_BINS):
        low, high = k * widest / _BINS, (k + 1) * widest / _BINS
        inside = miss[(angle >= low) & ((angle < high) | (k == _BINS - 1))]
        if len(inside):
            rows.append((low, high, _rms(inside), float(inside.max())))
    worst = int(miss.argmax())
    fold = math.degrees(projection.fold_rad)
    return Residual(_rms(miss), float(miss[worst]), worst, float(angle[worst]), tuple(rows), widest, fold)


def _rms(values: Array) -> float:
    return math.sqrt(np.mean(values**2))


def _adjusted(
    start: Projection, direction: Array, pixel: Array, weight: Array, round_: bool, dropped: Sequence[str] = ()
) -> Projection:
    """Adjust the numbers of a projection from the paraxial ones to the least squares of distances; some stay 0."""
    theta = start.kind == "f-theta"
    first, tied = start.numbers, round_ and not theta
    if theta:
        first[:3] = start.focal_px[0] / start.focal_px[1], 1.0, start.focal_px[1]
    free = [k + 2 for k, name in enumerate(NAMES[start.kind]) if name not in (*_FIXED, *dropped)]
    free += ([] if theta and round_ else [0]) + ([] if theta or tied else [1])

    def numbers(x: NDArray[Any]) -> NDArray[Any]:
        whole = first.astype(x.dtype)
        whole[free] = x
        whole[1] = whole[0] if tied else whole[1]
        return whole

    def miss(x: NDArray[Any]) -> NDArray[Any]:
        return (weight * (start.project(direction, numbers(x)) - pixel)).reshape(-1)

    def slopes(x: Array) -> Array:
        return np.stack([miss(x + 1j * step).imag / _STEP for step in _STEP * np.eye(len(x))], axis=1)

    found = least_squares(miss, first[free], slopes, method="lm", x_scale="jac", xtol=1e-15, ftol=1e-15, gtol=1e-15)
    fx, fy, *coefficients = numbers(found.x).tolist()
    return replace(start, focal_px=(fx, fy), coefficients=tuple(coefficients))


def inverse_polynomial(projection: Projection) -> tuple[float, ...]:
    """Return b_1 to b_5 of NVIDIA's f-theta in the other direction: the angle by powers of the radius in pixels."""
    angle = np.linspace(0, min(projection.widest_rad, projection.fold_rad), _ANGLES)
    radius = angle * _series(projection.numbers[2:], angle)
    powers = radius.max() ** np.arange(1, 6)
    rows = radius[:, None] ** np.arange(1, 6) / powers
    return tuple((np.linalg.lstsq(rows, angle, rcond=None)[0] / powers).tolist())


@dataclass(frozen=True)
class RayTable:
    """A camera without a centre: rays of pixels, from control values by uniform cubic B-splines along both sides.

    It is the model "noncentral-generic" of Schoeps et al., who count pixels from the corner of the first one.

    Attributes:
        size: of the picture in pixels.
        first, last: column and row of the first and of the last pixel with rays.
        grid: [H, W, 6] control values of a point of the ray (m) and of its direction; the outermost lie beyond the
            picture.
    """

    size: tuple[int, int]
    first: tuple[int, int]
    last: tuple[int, int]
    grid: Array

    def __call__(self, pixel: Array) -> Array:
        """Return points (m) and unit directions [N, 6] of the rays of pixels [N, 2]."""
        rays = np.asarray(NdBSpline(self._knots, self.grid, 3)(self._place(pixel)))
        rays[:, 3:] /= np.linalg.norm(rays[:, 3:], axis=1, keepdims=True)
        return rays

    @property
    def _knots(self) -> tuple[Array, Array]:
        rows, columns = (np.arange(n + 4.0) - 2 for n in self.grid.shape[:2])
        return rows, columns

    def _place(self, pixel: Array) -> Array:
        """Return rows and columns of the grid at pixels."""
        first, end = np.array(self.first) - 0.5, np.array(self.last) + 0.5
        cells = np.array(self.grid.shape[1::-1]) - 3
        return np.ascontiguousarray((1 + cells * (pixel - first) / (end - first))[:, ::-1])

    def fitted(self, pixel: Array, rays: Array, weight: Array) -> RayTable:
        """Fit a table of this shape to rays [N, 6] of pixels by least squares of distances, with weights [N]."""
        height, width = self.grid.shape[:2]
        rows = NdBSpline.design_matrix(self._place(pixel), self._knots, 3)
        rows.resize(len(pixel), height * width)  # it would end with the last value that is used
        weighed = rows.multiply(weight[:, None]).T.tocsc()
        normal = weighed @ rows
        bend = [diags([1.0, -2.0, 1.0], [0, 1, 2], (n - 2, n)) for n in (height, width)]
        along = kron(bend[0].T @ bend[0], eye(width)) + kron(eye(height), bend[1].T @ bend[1])
        normal = normal + _SMOOTH * normal.diagonal().max() * along
        return replace(self, grid=spsolve(normal.tocsc(), weighed @ rays).reshape(height, width, 6))
