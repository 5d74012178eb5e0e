"""Projections of other programs: from a direction to a pixel and back, with derivatives, and their fit to a lens.

Frame and pixels are OpenCV's: x right, y down, z towards the scene; the centre of the first pixel is 0, 0. With
x' = x / z, y' = y / z, r^2 = x'^2 + y'^2, t the angle to z, and the pixel c + (fx u, fy v):

    opencv          u = x' q + 2 p1 x' y' + p2 (r^2 + 2 x'^2), v alike; q = 1 + k1 r^2 + k2 r^4 + k3 r^6
    opencv-rational the same, q over 1 + k4 r^2 + k5 r^4 + k6 r^6
    kannala-brandt  (u, v) = d (x, y) / |(x, y)|, d = t (1 + k1 t^2 + k2 t^4 + k3 t^6 + k4 t^8): OpenCV's fisheye
    f-theta         the same with d = sum of a_i t^i in pixels, fy = 1, fx the c of NVIDIA's linear transformation
    table           the same with d in pixels, linear between equal steps of t
    two-axis        u = x' (1 + sum of a_ij x'^2i y'^2j), v = y' (1 + sum of b_ij ...), i + j from 1 to 3

A lens centred on its axis has p1 = p2 = 0 and its principal point in the picture's middle: neither is fitted. One
without cylinders has fx = fy. Sources: OpenCV, modules calib3d and fisheye; Kannala and Brandt 2006, IEEE PAMI 28(8);
NVIDIA, documentation of NCore, sensor models.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.optimize import least_squares  # type: ignore[import-untyped]
from torch import Tensor
from torch.func import jacfwd, jvp

from neurolens.base.errors import InputError

Array = NDArray[np.float64]

_TWO_AXIS = [(i, total - i) for total in (1, 2, 3) for i in range(total, -1, -1)]
NAMES = {
    "opencv": ("k1", "k2", "p1", "p2", "k3"),
    "opencv-rational": ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"),
    "kannala-brandt": ("k1", "k2", "k3", "k4"),
    "f-theta": ("a1", "a2", "a3", "a4", "a5"),
    "table": (),
    "two-axis": tuple(f"{axis}{i}{j}" for axis in "ab" for i, j in _TWO_AXIS),
}
PLANAR = ("opencv", "opencv-rational", "two-axis")
WIDEST_DEG = 85.0  # of what is divided by z
_FIXED = ("p1", "p2")
_TINY = 1e-24  # square of the sine below which the axis begins
_KNOTS = 1025  # of tables
_ON_AXIS = 1e-6  # rad
_NOT_FOLDED = 179.0, 89.9  # degrees to which a fold is looked for, about the lens and on the plane
_STEPS, _TRUST, _CONVERGED = 25, 0.5, 1e-14  # of Newton's method on the plane; its longest and shortest step
_MISSED_PX = 1e-3  # of a direction found for a pixel
_BINS = 5  # fields of a report


@dataclass(frozen=True)
class Projection:
    """A projection with its numbers.

    Attributes:
        kind: one of `NAMES`. size: of the picture in pixels.
        focal_px: fx, fy; 1, 1 where radii are in pixels (but see f-theta).
        coefficients: by the names of the kind; of a table, radii in pixels at equal steps of the angle.
        widest_rad: the picture ends at this angle; of a table, its last.
    """

    kind: str
    size: tuple[int, int]
    focal_px: tuple[float, float]
    coefficients: tuple[float, ...]
    widest_rad: float

    @property
    def centre_px(self) -> tuple[float, float]:
        """The principal point."""
        return (self.size[0] - 1) / 2, (self.size[1] - 1) / 2

    @property
    def named(self) -> dict[str, float]:
        """Coefficients by name; none of a table."""
        return dict(zip(NAMES[self.kind], self.coefficients, strict=False)) if self.kind != "table" else {}

    def project(self, direction: Tensor, numbers: Tensor | None = None) -> Tensor:
        """Pixels [..., 2] of directions [..., 3] of any length; as the formula goes on, also beyond the picture.

        NaN where a projection that divides by z sees nothing. `numbers`: fx, fy and the coefficients, instead of its
        own.
        """
        values = self.numbers.to(direction) if numbers is None else numbers
        x, y, z = direction.unbind(-1)
        if self.kind in PLANAR:
            ahead = z > 0
            x, y = (torch.where(ahead, v / torch.where(ahead, z, 1.0), math.nan) for v in (x, y))
            u, v = _bent(self.kind, values[2:], x, y)
        else:
            side = torch.sqrt(x * x + y * y + _TINY * (x * x + y * y + z * z))
            distance = self._distance(values[2:], torch.atan2(side, z)) / side
            u, v = distance * x, distance * y
        centre = torch.tensor(self.centre_px, dtype=u.dtype, device=u.device)
        return torch.stack([u, v], -1) * values[:2] + centre

    def jacobian(self, direction: Tensor) -> Tensor:
        """Derivatives [..., 2, 3] of `project` by the direction."""
        axes = torch.eye(3, dtype=direction.dtype, device=direction.device)
        columns = [jvp(self.project, (direction,), (axis.expand_as(direction),))[1] for axis in axes]
        return torch.stack(columns, -1)

    def unproject(self, pixel: Tensor) -> Tensor:
        """Unit directions [..., 3] of pixels [..., 2]; NaN where none leads there, or only one beyond a fold."""
        numbers = self.numbers.to(pixel)
        centre = torch.tensor(self.centre_px, dtype=pixel.dtype, device=pixel.device)
        u, v = ((pixel - centre) / numbers[:2]).unbind(-1)
        found = self._unbent(numbers[2:], u, v) if self.kind in PLANAR else self._by_angle(numbers[2:], u, v)
        found = found / torch.linalg.vector_norm(found, dim=-1, keepdim=True)
        missed = torch.linalg.vector_norm(self.project(found) - pixel, dim=-1, keepdim=True)
        least = max(_MISSED_PX, 64 * torch.finfo(pixel.dtype).eps * max(self.size))
        return torch.where(missed <= least, found, math.nan)

    @cached_property
    def numbers(self) -> Tensor:
        """fx, fy and the coefficients."""
        return torch.tensor([*self.focal_px, *self.coefficients], dtype=torch.float64)

    @cached_property
    def fold_rad(self) -> float:
        """Angle from which on radii shrink, of any azimuth tried; if they do not, the last that is tried."""
        end = self.widest_rad if self.kind == "table" else math.radians(_NOT_FOLDED[self.kind in PLANAR])
        angle = torch.linspace(0, end, 4 * _KNOTS, dtype=torch.float64)[:, None]
        turn = torch.linspace(0, math.pi / 2, 7, dtype=torch.float64)
        rays = [angle.sin() * turn.cos(), angle.sin() * turn.sin(), angle.cos().expand(-1, len(turn))]
        offset = self.project(torch.stack(rays, -1)) - torch.tensor(self.centre_px, dtype=torch.float64)
        rising = (torch.linalg.vector_norm(offset, dim=-1).diff(dim=0) > 0).all(1)
        return end if bool(rising.all()) else float(angle[int(rising.int().argmin()), 0])

    def _distance(self, coefficients: Tensor, angle: Tensor) -> Tensor:
        if self.kind == "table":
            place = angle * ((len(coefficients) - 1) / self.widest_rad)
            row = place.detach().clamp(0, len(coefficients) - 2).to(torch.int64)
            return coefficients[row] + (place - row) * (coefficients[row + 1] - coefficients[row])
        if self.kind == "f-theta":
            return angle * _series(coefficients, angle)
        return angle * (1 + angle * angle * _series(coefficients, angle * angle))

    def _by_angle(self, coefficients: Tensor, u: Tensor, v: Tensor) -> Tensor:
        """Directions of places on the film, by a table and Newton's method."""
        count = len(coefficients) if self.kind == "table" else _KNOTS
        knots = torch.linspace(0, self.fold_rad, count, dtype=u.dtype, device=u.device)
        radii = self._distance(coefficients, knots)
        distance = torch.sqrt(u * u + v * v + _TINY * radii[1] ** 2)  # a root has no slope at 0
        row = (torch.searchsorted(radii, distance.contiguous()) - 1).clamp(0, count - 2)
        angle = knots[row] + (distance - radii[row]) / (radii[row + 1] - radii[row]) * (knots[1] - knots[0])
        for _ in range(0 if self.kind == "table" else 3):
            value, slope = jvp(lambda t: self._distance(coefficients, t), (angle,), (torch.ones_like(angle),))[:2]
            angle = (angle + (distance - value) / slope).clamp(0, self.fold_rad)
        share = torch.sin(angle) / distance
        return torch.stack([u * share, v * share, torch.cos(angle)], -1)

    def _unbent(self, coefficients: Tensor, u: Tensor, v: Tensor) -> Tensor:
        """Directions of bent places on the plane, by Newton's method from those places, drawn in."""
        one, zero = torch.ones_like(u), torch.zeros_like(u)
        x, y = u, v
        for _ in range(_STEPS):

            def bent(x: Tensor, y: Tensor) -> tuple[Tensor, Tensor]:
                return _bent(self.kind, coefficients, x, y)

            (a, b), (ax, bx) = jvp(bent, (x, y), (one, zero))[:2]
            ay, by = jvp(bent, (x, y), (zero, one))[1]
            det = ax * by - ay * bx
            det = torch.where(det.abs() > 1e-12, det, 1.0)
            dx, dy = (by * (u - a) - ay * (v - b)) / det, (ax * (v - b) - bx * (u - a)) / det
            if not bool((dx.abs() + dy.abs() > _CONVERGED).any()):
                break
            short = (_TRUST / torch.sqrt((dx * dx + dy * dy).clamp_min(_TRUST**2))).nan_to_num(0.0)
            x, y = x + short * dx, y + short * dy
        folded = torch.sqrt(x * x + y * y) > math.tan(self.fold_rad)
        return torch.stack([torch.where(folded, math.nan, x), y, one], -1)


def _series(coefficients: Tensor, x: Tensor) -> Tensor:
    """A polynomial, lowest coefficient first."""
    value = torch.zeros_like(x)
    for c in reversed(coefficients.unbind(0)):
        value = value * x + c
    return value


def _bent(kind: str, c: Tensor, x: Tensor, y: Tensor) -> tuple[Tensor, Tensor]:
    """The images of points x', y' of the plane."""
    if kind == "two-axis":
        powers = [x ** (2 * i) * y ** (2 * j) for i, j in _TWO_AXIS]
        half = len(powers)
        u, v = (1 + sum(c[start + k] * p for k, p in enumerate(powers)) for start in (0, half))
        return x * u, y * v
    r2 = x * x + y * y
    k1, k2, p1, p2, k3 = c[:5]
    q = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    if kind == "opencv-rational":
        k4, k5, k6 = c[5:]
        q = q / (1 + r2 * (k4 + r2 * (k5 + r2 * k6)))
    return x * q + 2 * p1 * x * y + p2 * (r2 + 2 * x * x), y * q + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y


@dataclass(frozen=True)
class Residual:
    """The distances in pixels that a fitted projection leaves.

    Attributes:
        rms_px, worst_px: over all points. worst_at_deg: the field of the worst.
        by_field: (from, to) in degrees, RMS and worst, of equal parts of the field.
        field_deg: the widest angle of the points. fold_deg: from here on the projection turns back.
    """

    rms_px: float
    worst_px: float
    worst_at_deg: float
    by_field: tuple[tuple[float, float, float, float], ...]
    field_deg: float
    fold_deg: float

    @property
    def sound(self) -> bool:
        """Whether the projection goes on rising over the whole field."""
        return self.fold_deg > self.field_deg * (1 - 1e-9)


def fit(
    kind: str,
    direction: Array,
    pixel: Array,
    size: tuple[int, int],
    focal_px: tuple[float, float],
    source: str = "projection",
) -> Projection:
    """The projection of least mean squared distance of the pixels.

    Args:
        direction: [N, 3] unit vectors, and pixel [N, 2], where a lens shows them; spread evenly over the picture.
        size: of the picture. focal_px: paraxial fx and fy; equal: they stay equal.
        source: what errors name.

    Raises:
        InputError: a field too wide for this kind, fewer points than numbers, a table of a lens with two focal lengths.
    """
    ray, goal = (torch.from_numpy(np.ascontiguousarray(a, np.float64)) for a in (direction, pixel))
    angle = torch.atan2(torch.hypot(ray[:, 0], ray[:, 1]), ray[:, 2])
    widest = float(angle.max())
    if kind in PLANAR and math.degrees(widest) > WIDEST_DEG:
        expected = f"a field up to {WIDEST_DEG:g} degrees from the axis: --projection kannala-brandt, f-theta or table"
        raise InputError(source, f"--projection {kind}", f"({math.degrees(widest):.4g} degrees)", expected)
    if len(goal) < 2 * len(NAMES[kind]) + 2:
        raise InputError(source, "picture", f"({len(goal)} lit points)", "a picture that light reaches")
    round_ = focal_px[0] == focal_px[1]
    start = Projection(kind, size, focal_px, (0.0,) * len(NAMES[kind]), widest)
    if kind == "table":
        if not round_:
            raise InputError(source, "--projection table", "(a lens with cylinders)", "two-axis: it has two tables")
        return _tabled(start, angle, torch.linalg.vector_norm(goal - torch.tensor(start.centre_px), dim=-1))
    return _adjusted(start, ray, goal, round_)


def residual(projection: Projection, direction: Array, pixel: Array) -> Residual:
    """The residual of a projection at pixels [N, 2] of directions [N, 3] that it was not fitted to."""
    ray, goal = (torch.from_numpy(np.ascontiguousarray(a, np.float64)) for a in (direction, pixel))
    miss = torch.linalg.vector_norm(projection.project(ray) - goal, dim=-1)
    angle = torch.rad2deg(torch.atan2(torch.hypot(ray[:, 0], ray[:, 1]), ray[:, 2]))
    widest = float(angle.max())
    rows = []
    for k in range(_BINS):
        low, high = k * widest / _BINS, (k + 1) * widest / _BINS
        inside = miss[(angle >= low) & ((angle < high) | (k == _BINS - 1))]
        if len(inside):
            rows.append((low, high, float(inside.square().mean().sqrt()), float(inside.max())))
    worst = int(miss.argmax())
    return Residual(
        float(miss.square().mean().sqrt()), float(miss[worst]), float(angle[worst]), tuple(rows), widest,
        math.degrees(projection.fold_rad),
    )  # fmt: skip


def _tabled(start: Projection, angle: Tensor, radius: Tensor) -> Projection:
    """Radii at equal steps of the angle, between those of the points nearest on either side."""
    order = angle.argsort()
    a, r = angle[order].numpy(), radius[order].numpy()
    off = a > _ON_AXIS  # the ratio of both is nearly even about the axis
    knots = np.linspace(0, start.widest_rad, _KNOTS)
    ratio = np.interp(knots**2, a[off] ** 2, r[off] / a[off])
    return replace(start, focal_px=(1.0, 1.0), coefficients=tuple((ratio * knots).tolist()))


def _adjusted(start: Projection, ray: Tensor, goal: Tensor, round_: bool) -> Projection:
    """The projection whose numbers, found from the paraxial ones, have the least squares of distances."""
    theta = start.kind == "f-theta"
    first, tied = start.numbers.clone(), round_ and not theta
    if theta:
        first[:2], first[2] = torch.tensor([start.focal_px[0] / start.focal_px[1], 1.0]), start.focal_px[1]
    free = [k + 2 for k, name in enumerate(NAMES[start.kind]) if name not in _FIXED]
    free += ([] if theta and round_ else [0]) + ([] if theta or tied else [1])

    def numbers(x: Tensor) -> Tensor:
        whole = first.index_copy(0, torch.tensor(free), x)
        return torch.cat([whole[:1], whole[:1], whole[2:]]) if tied else whole

    def miss(x: Tensor) -> Tensor:
        return (start.project(ray, numbers(x)) - goal).reshape(-1)

    found = least_squares(
        lambda x: miss(torch.from_numpy(x)).numpy(), first[free].numpy(), lambda x: jacfwd(miss)(torch.from_numpy(x)),
        method="lm", x_scale="jac", xtol=1e-15, ftol=1e-15, gtol=1e-15,
    )  # fmt: skip
    fx, fy, *coefficients = numbers(torch.from_numpy(found.x)).tolist()
    return replace(start, focal_px=(fx, fy), coefficients=tuple(coefficients))


def inverse_polynomial(projection: Projection) -> tuple[float, ...]:
    """Coefficients b_1 to b_5 of the angle over the radius in pixels of an f-theta, NVIDIA's other direction."""
    angle = torch.linspace(0, min(projection.widest_rad, projection.fold_rad), _KNOTS, dtype=torch.float64)
    radius = angle * _series(projection.numbers[2:], angle)
    scale = radius.max()
    rows = torch.stack([(radius / scale) ** k for k in range(1, 6)], 1)
    found = torch.linalg.lstsq(rows, angle[:, None]).solution[:, 0]
    return tuple((found / torch.stack([scale**k for k in range(1, 6)])).tolist())
