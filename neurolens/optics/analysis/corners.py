"""Sharpness at points of the picture, of a lens and of its copies, and the plane of their best focus.

Camera rays leave each point through a grid on the pupil plane. In the scene they do not end in one point; the
derivatives of the lens as designed turn the differences into distances on the film, which are the spot. A copy is
focused as its lens is: its film moves by as much as its paraxial focus.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from neurolens.base.errors import InputError
from neurolens.base.progress import Progress
from neurolens.base.report import Report, over
from neurolens.optics.analysis.fields import Array, Scene
from neurolens.optics.lens.paraxial import first_order
from neurolens.optics.lens.prescription import Lens
from neurolens.optics.setting.copies import Tolerances, draws_of
from neurolens.optics.setting.pupils import camera_rays, pupil_bounds
from neurolens.optics.trace.arrays import follow
from neurolens.optics.trace.rays import plain_trace
from neurolens.optics.trace.surfaces import Rays

PER_MM = (20.0, 40.0)
PLACES = ("middle", "top left", "top right", "bottom left", "bottom right")  # of the picture
_SHARE, _SIDES = 0.8, (3.0, 2.0)  # where the corners lie: of the image's radius, in a picture with such sides
GRID, FINE = 20, 48  # pupil points a side: contrasts are within 0.004, and within 0.001, of those of more points
_WIDER, _ROWS, _POINTS = 1.05, 5, 96  # how the pupil is found
_STEP_MM = 1e-3  # of film points, for the derivatives


class Spot(NamedTuple):
    """The spots of P points of the film, R rays each.

    Attributes:
        off_mm, slope: [2, P, R] distances along x and y on the film, and how much they grow for each mm that the film
            is farther away.
        weight: [P, R] of the rays.
    """

    off_mm: Array
    slope: Array
    weight: Array


class Corners:
    """Traces a lens that is set, and its copies, from points of the film."""

    def __init__(
        self, scene: Scene, picture_mm: Array | None = None, wavelength_nm: Sequence[float] | None = None,
        grid: int = GRID,
    ) -> None:  # fmt: skip
        """Find the rays.

        Args:
            picture_mm: [P, 2] points of the picture, to the right and up from its middle; None takes `PLACES`.
            wavelength_nm: of the light, all alike; None takes `Scene.waves_nm`.
            grid: pupil points a side.

        Raises:
            InputError: a point from which no ray passes.
        """
        lens, self.scene = scene.lens, scene
        if picture_mm is None:
            side = _SHARE * scene.image_radius_mm * np.array(_SIDES) / math.hypot(*_SIDES)
            picture_mm = side * np.array([(0, 0), (-1, 1), (1, 1), (-1, -1), (1, -1)])
        self.picture_mm = np.asarray(picture_mm, np.float64)
        self.film_mm = -self.picture_mm.T  # the picture stands upside down on the film
        radius = np.hypot(*self.film_mm)
        waves, z = wavelength_nm or scene.waves_nm, scene.film_z_mm
        reach = max(float(radius.max()), 1e-3)
        bounds = pupil_bounds(lens, reach, (z, z), (min(waves), max(waves)), rows=_ROWS, points=_POINTS)
        self._plane = bounds.pupil_z_mm
        radii = np.linspace(0, reach, _ROWS)
        sides = [np.asarray(np.interp(radius, radii, v)) for v in (bounds.low_mm, bounds.high_mm, bounds.half_mm)]
        low, high, half = (side[:, None, None] for side in sides)
        line = ((np.arange(grid) + 0.5) / grid * 2 - 1) * _WIDER
        u, v = (low + high) / 2 + (high - low) / 2 * line[:, None], half * line
        u, v = (np.broadcast_to(a, (len(radius), grid, grid)).reshape(len(radius), -1) for a in (u, v))
        self.radial = np.where(radius > 0, self.film_mm / np.maximum(radius, 1e-300), [[0.0], [1.0]])
        c, s = np.where(radius > 0, self.radial, [[1.0], [0.0]]).reshape(2, -1, 1)
        self._pupil = (
            np.stack([c * u - s * v, s * u + c * v])[:, :, None].repeat(len(waves), 2).reshape(2, len(radius), -1)
        )
        self._waves = np.repeat(waves, u.shape[1])
        self._towards: Array | None = None
        self._inverse = np.eye(2)[None].repeat(len(radius), 0)
        self._light = self._transmittance()
        start = self._ends(lens)
        if not start.weight.any(1).all():
            dark = self.picture_mm[~start.weight.any(1)][0].tolist()
            raise InputError(lens.path, "picture", dark, "points from which rays pass the lens")
        if math.isinf(scene.focus_m):  # directions are seen on the plane across their mean
            mean = (start.off_mm * start.weight).sum(-1) / start.weight.sum(-1)
            self._towards = mean / np.linalg.norm(mean, axis=0)
        columns = []
        for step in np.eye(2)[:, :, None] * _STEP_MM:
            ahead, behind = (self._ends(lens, k * step) for k in (1, -1))
            both = ahead.weight * behind.weight
            columns.append(((ahead.off_mm - behind.off_mm) / (2 * _STEP_MM) * both).sum(-1) / both.sum(-1))
        self._inverse = np.linalg.inv(np.stack(columns, 1).transpose(2, 0, 1))

    def spots(self, lens: Lens) -> Spot:
        """Trace a copy of the lens, or the lens itself."""
        found = self._ends(lens)
        return found._replace(off_mm=-np.einsum("pij,jpr->ipr", self._inverse, found.off_mm))

    def _rays(self, film_z: float, moved_mm: Array | float = 0.0, shift: float = 0.0) -> Rays:
        x, y = self.film_mm + moved_mm
        x, y = (np.repeat(v, self._pupil.shape[2]) for v in (x, y))
        u, v = self._pupil.reshape(2, -1)
        return camera_rays(x, y, film_z, u, v, self._plane + shift)

    def _transmittance(self) -> Array:
        """Return what surfaces and glass let through [P, R] in the lens as designed, which a copy hardly changes."""
        rays = Rays(*map(torch.from_numpy, self._rays(self.scene.film_z_mm)))
        waves = torch.from_numpy(np.tile(self._waves, len(self.picture_mm)))
        found = plain_trace(self.scene.lens, rays, waves, transmittance=True).transmittance
        return np.asarray(found).reshape(self._pupil.shape[1:])

    def _ends(self, lens: Lens, moved_mm: Array | float = 0.0) -> Spot:
        """Return where camera rays end: at points of the object, or in directions across the mean ones."""
        shift = _focus_z_mm(lens) - _focus_z_mm(self.scene.lens)
        film_z, shape = self.scene.film_z_mm + shift, self._pupil.shape[1:]
        rays = self._rays(film_z, moved_mm, shift)
        found = follow(lens, rays, np.tile(self._waves, shape[0]))
        weight = np.where(found.status == 0, rays.dz**4, 0.0).reshape(shape) * self._light
        slope = np.stack([rays.dx, rays.dy]).reshape(2, *shape) / rays.dz.reshape(shape)
        return Spot(np.where(weight > 0, self._seen(found.rays, film_z, shape), 0.0), slope, weight)

    def _seen(self, rays: Rays, film_z: float, shape: tuple[int, ...]) -> Array:
        place, way = (np.stack(part).reshape(3, *shape) for part in (rays[:3], rays[3:]))
        if math.isfinite(self.scene.focus_m):
            along = (film_z - 1000 * self.scene.focus_m - place[2]) / way[2]
            return np.asarray((place + along * way)[:2])
        if self._towards is None:
            return way
        first = np.cross(self._towards, [[0.0], [1.0], [0.0]], axis=0)
        first /= np.linalg.norm(first, axis=0)
        second = np.cross(self._towards, first, axis=0)
        return np.einsum("kip,ipr->kpr", np.stack([first, second]), way)

    def contrast(self, spot: Spot, shift_mm: Array | float = 0.0, per_mm: Sequence[float] = PER_MM) -> Array:
        """Return the geometric MTF [2, P, K], tangential and sagittal, where the film is shifted by so much [P]."""
        x, y = spot.off_mm + np.reshape(shift_mm, (-1, 1)) * spot.slope
        (a, b), weight = self.radial[..., None], spot.weight / spot.weight.sum(-1, keepdims=True)
        lines = np.stack([a * x + b * y, a * y - b * x])
        return np.stack([np.abs((weight * np.exp(2j * np.pi * f * lines)).sum(-1)) for f in per_mm], -1)

    def sizes(self, spot: Spot) -> tuple[Array, Array]:
        """Return the RMS radius [P] of the spots in um, and the shift [P] of the film in mm where it is least."""
        weight = spot.weight / spot.weight.sum(-1, keepdims=True)
        q, m = (v - (weight * v).sum(-1, keepdims=True) for v in spot[:2])
        size, mixed, steep = ((weight * a * b).sum((0, 2)) for a, b in ((q, q), (q, m), (m, m)))
        return 1000 * np.sqrt(size), -mixed / steep


def _focus_z_mm(lens: Lens) -> float:
    data = first_order(lens)
    return float(data.rear_principal_z_mm + data.efl_mm)


@dataclass(frozen=True)
class Spread(Report):
    """How much N copies of a lens differ at P places of the picture, and the lens as designed.

    Attributes:
        x_mm, y_mm: [P] of the places, to the right and up from the middle of the picture.
        rms_um, tangential, sagittal: [P] and [P, K] of the lens as designed: RMS radius, geometric MTF.
        copy: [N] numbers, as `neurolens copies` counts.
        copy_rms_um, copy_tangential, copy_sagittal: [N, P] and [N, P, K] of the copies.
        copy_shift_mm: [N, P] by how much the copies' best focus is farther from the lens than the design's.
        film_tilt_deg, film_swing_deg: [N] of a film that follows the plane through these at the corners.
    """

    seed: int
    tolerances: Tolerances
    place: tuple[str, ...]
    frequency_per_mm: tuple[float, ...]
    x_mm: Array = field(metadata=over("place"))
    y_mm: Array = field(metadata=over("place"))
    rms_um: Array = field(metadata=over("place"))
    tangential: Array = field(metadata=over("place", "frequency_per_mm"))
    sagittal: Array = field(metadata=over("place", "frequency_per_mm"))
    copy: NDArray[np.int_]
    copy_rms_um: Array = field(metadata=over("copy", "place"))
    copy_tangential: Array = field(metadata=over("copy", "place", "frequency_per_mm"))
    copy_sagittal: Array = field(metadata=over("copy", "place", "frequency_per_mm"))
    copy_shift_mm: Array = field(metadata=over("copy", "place"))
    film_tilt_deg: Array = field(metadata=over("copy"))
    film_swing_deg: Array = field(metadata=over("copy"))

    @property
    def softest(self) -> tuple[int, int]:
        """Return which copy and which place, as rows of the arrays, have the least contrast at the last frequency."""
        row, place = np.unravel_index(np.argmin(self.copy_contrast), self.copy_contrast.shape)
        return int(row), int(place)

    @property
    def contrast(self) -> Array:
        """The mean of both directions at the last frequency, [P], of the design."""
        return np.asarray((self.tangential + self.sagittal)[:, -1] / 2)

    @property
    def copy_contrast(self) -> Array:
        """The mean of both directions at the last frequency, [N, P], of the copies."""
        return np.asarray((self.copy_tangential + self.copy_sagittal)[..., -1] / 2)


def spread(
    scene: Scene, limits: Tolerances, number: int, seed: int, *, wavelength_nm: Sequence[float] | None = None,
    progress: Progress | None = None,
) -> Spread:  # fmt: skip
    """Trace copies that are drawn as `neurolens copies` draws them.

    Raises:
        InputError: as `copies.copies_of` and `Corners`.
    """
    corners = Corners(scene, wavelength_nm=wavelength_nm)

    def rows() -> Iterator[tuple[Array, Array, Array]]:
        lenses = [scene.lens, *(lens for _, lens in draws_of(scene.lens, limits, number, seed))]
        with (progress or Progress(quiet=True)).stage("copies") as report:
            for k, lens in enumerate(lenses, 1):
                spot = corners.spots(lens)
                yield corners.contrast(spot), *corners.sizes(spot)
                report(k / len(lenses))

    mtf, rms, shift = (np.stack(each) for each in zip(*rows(), strict=True))
    off, (x, y) = shift[1:] - shift[0], corners.film_mm
    # The plane of least squares through the corners, which lie at +-x and +-y.
    tilt, swing = (np.degrees(np.arctan((off * v).sum(1) / (v * v).sum())) for v in (y, x))
    right, up = corners.picture_mm.T
    return Spread(
        seed, limits, PLACES, PER_MM, right, up, rms[0], mtf[0, 0], mtf[0, 1], np.arange(1, number + 1),
        rms[1:], mtf[1:, 0], mtf[1:, 1], off, tilt, swing,
    )  # fmt: skip
