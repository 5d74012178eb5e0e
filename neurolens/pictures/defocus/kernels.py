"""The blur of points: where on the film the light of a scene point arrives, as a picture for each channel.

A point is named by its place in a plate and its inverse depth. Each point of the pupil sends its light to the film
point whose ray sees it there, found by Newton's method on the camera's own rays; cells of a grid of the pupil are drawn
as the areas that they cover. So a kernel has no noise, and cat's eyes, coma and colour fringes are the lens's.

Onion rings: grinding leaves concentric grooves on aspheres, which move the light within a blur disc. A groove raises
the surface along the axis by h(r). The path of a ray through it changes by W = h (n d_z - n' d'_z), with d and d' the
directions before and after the surface. By Fermat's principle, light of a point that passes the same place of the lens
arrives beside its old place on the film, displaced by the gradient of W over the direction cosines with which rays
leave that place. This is exact to first order in h. Diffraction by the grooves is left out, as by Joo et al. 2016
("Efficient ray tracing through aspheric lenses and imperfect bokeh synthesis"), who measured such rings.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from neurolens.base.errors import InputError
from neurolens.base.settings import LIGHT_NM
from neurolens.cameras.contract import Camera
from neurolens.cameras.field import frame_of
from neurolens.cameras.sampling import axis_mm
from neurolens.pictures.defocus.diffraction import MOST_PX, Diffraction, lens_of, on_upright, spreads
from neurolens.pictures.defocus.plate import (
    FloatArray,
    Plate,
    PlatePinhole,
    RayTable,
    axis_px,
    channel_wavelengths,
    turned,
)
from neurolens.pictures.flare.canvas import LOST, draw_edges, edges_of
from neurolens.pictures.render.colour import SpectralRange

Array = NDArray[np.float64]
_STEP_MM = 0.01  # of differences on the pupil's plane
GRID = 48  # cells of the pupil along a side
COLOURS = 5  # wavelengths in a channel
_STEPS = 5  # steps of Newton's method
_CLOSE = 0.01  # pixels by which a ray may miss the point
_FAR = 0.02  # share of the kernel's width: rays that miss by more have places that are not used
_SURE = 0.5  # where a smaller share of the light has rays that meet the point, the places of all rays count
LARGEST = 2048  # pixels a side of a kernel
_RIM = 0.99  # of a pupil's outline, where hardly a ray passes: places from here on are extrapolated
_MARGIN = 2  # dark pixels around a kernel
_A_GROOVE, _FINEST = 8, 1536  # cells for each groove of an asphere, and the most along a side
_FINER = 3  # an odd number of boxes along a pixel's side, which show grooves finer than a pixel
_LARGEST = 16384  # pixels a side of an atlas
_TINT, _TINT_PUPIL = 64, 8  # wavelengths of white light, and points along both sides of the pupil at each


@dataclass(frozen=True)
class Grooves:
    """Grooves whose height is H sin(2 pi r / spacing)."""

    height_nm: float
    spacing_mm: float

    def heights(self, radius_mm: Array) -> tuple[Array, Array]:
        """Return the heights in mm, and their derivatives by the radius."""
        turn, height = 2 * math.pi / self.spacing_mm, 1e-6 * self.height_nm
        return height * np.sin(turn * radius_mm), height * turn * np.cos(turn * radius_mm)


def aspheres(camera: Any) -> list[int]:
    """Return the surfaces of a camera's lens that are round aspheres. Raises InputError: there is none."""
    lens = getattr(camera, "lens", None)
    surfaces = lens.surfaces if lens is not None else ()
    found = [k for k, s in enumerate(surfaces) if s.figure.aspheric and not s.figure.axis]
    if not found:
        raise InputError(
            camera.name, "ring_height", "(no asphere)", "the file of a lens with aspheres, to have grooves"
        )
    return found


def responses(camera: Any, film_mm: NDArray[Any], square: NDArray[Any], nm: NDArray[Any]) -> Array:
    """Return how grooves move light: [aspheres, 5, N] for rays from film points [2, N] through pupil points [2, N].

    Pupil points are those of the unit square. The first of the five rows of an asphere is the distance (mm) from the
    axis at which the ray meets it. The next two tell how far (mm, in x and y) light moves on the film for a slope of 1
    of the surface there, the last two for a height of 1 mm.
    """
    surfaces = aspheres(camera)
    film_mm, pupil, _ = camera.film.start(*(v.astype(np.float32) for v in (film_mm, square, nm)))

    steps = _STEP_MM * np.array([[0, 0], [1, 0], [0, 1]])[..., None]
    (q, here), *moved = (camera.path_by_height(surfaces, film_mm, pupil + step, nm) for step in steps)
    (ax, ay), (bx, by) = (m[0] - q for m in moved)
    to_a, to_b = (m[1] - here for m in moved)
    gradient = np.stack([to_a * by - to_b * ay, to_b * ax - to_a * bx], 2) / (ax * by - ay * bx)
    return np.concatenate([here[:, :1], here[:, 1:] * gradient[:, 0], gradient[:, 1]], 1)


def moves(response: Array, grooves: Grooves) -> Array:
    """Return how far (mm, [2, N]) grooves on all aspheres move light on the film; `response` is of `responses`."""
    height, slope = grooves.heights(response[:, 0])
    return np.asarray((response[:, 1:3] * slope[:, None] + response[:, 3:] * height[:, None]).sum(axis=0))


@dataclass(frozen=True)
class Kernel:
    """The picture of a point.

    Attributes:
        light: [h, w, 3] share of the radiance of one square pixel of the plate that arrives at each pixel.
        corner_px: column and row, in the film, of its first pixel; whole numbers.
        film_by_plate: [2, 2] by how many pixels the point's picture moves on the film as the point moves in the plate.
        sweep: [2, 3] how fast the ray from a film pixel to the point moves in the plate as the point comes nearer
            (pixels by 1/m): a constant, and factors of column and row in the kernel.
    """

    light: FloatArray
    corner_px: tuple[int, int]
    film_by_plate: Array
    sweep: Array

    @property
    def middle_px(self) -> tuple[float, float]:
        """Return the place in the film of the green light's centroid."""
        green = self.light[..., 1].astype(np.float64)
        total = max(float(green.sum()), 1e-30)
        x, y = (float(green.sum(axis=a) @ (np.arange(green.shape[1 - a]) + 0.5)) / total for a in (0, 1))
        return self.corner_px[0] + x, self.corner_px[1] + y

    def centred(self, side: int, middle_px: tuple[float, float]) -> FloatArray:
        """Return the kernel on `side` pixels a side about the film place `middle_px`; each channel has the sum 1.

        Light for which there is no room is lost. The kernel moves by whole pixels.
        """
        found = np.zeros((side, side, 3), np.float32)
        x, y = (c - math.floor(m) + side // 2 for c, m in zip(self.corner_px, middle_px, strict=True))
        height, width = self.light.shape[:2]
        rows, columns = slice(max(0, -y), min(height, side - y)), slice(max(0, -x), min(width, side - x))
        part = self.light[rows, columns]
        found[y + rows.start :, x + columns.start :][: part.shape[0], : part.shape[1]] = part
        return np.asarray(found / np.maximum(self.energy, 1e-30), np.float32)

    def tinted(self, by: Array) -> Kernel:
        """Return the kernel of a white point, with the colour that the matrix of `tint` gives white light."""
        return replace(self, light=np.maximum(self.light @ by.T, 0).astype(np.float32))

    @property
    def energy(self) -> Array:
        """Return the light of red, green and blue."""
        return np.asarray(self.light.sum(axis=(0, 1), dtype=np.float64))


def kernel_at(
    camera: Camera, plate: Plate, place_px: tuple[float, float], inverse_depth: float, guess_px: tuple[float, float],
    cells: int = GRID, colours: int = COLOURS, wavelengths_nm: tuple[float, float, float] | None = None,
    grooves: Grooves | None = None,
) -> Kernel | None:  # fmt: skip
    """Return the kernel of a point of the plate, in pixels of the camera's picture; None where no light arrives.

    Args:
        guess_px: about where the film shows the point. cells: of the pupil's grid. colours: wavelengths in a channel.
        wavelengths_nm: one wavelength for red, green and blue each, in place of those that make white light.
        grooves: traces of grinding on the lens's aspheres, which make onion rings.

    Raises:
        InputError: the kernel has over 2048 pixels a side; the lens has no aspheres for grooves, or the grooves are too
            many.
    """
    pupil = _square(_RIM * _disk(np.linspace(-1, 1, cells + 1)))
    table = RayTable(camera, plate, pupil, np.zeros(pupil.shape[1], np.float32))
    if wavelengths_nm is not None:
        nm = np.array(wavelengths_nm, np.float32)[:, None]
    elif len(table.nm) > 1:
        low, high = (min(max(v, LIGHT_NM[0]), LIGHT_NM[1]) for v in camera.wavelength_nm or LIGHT_NM)
        hue = ((np.arange(colours) + 0.5) / colours).astype(np.float32)
        nm = channel_wavelengths(hue, low, high)
    else:
        nm = table.nm[:, :1]
    aimed = _aimed(table, place_px, inverse_depth, guess_px, nm.reshape(-1))
    aimed = aimed.on_grid(_edge(table, aimed.place, nm.reshape(-1)), cells)
    if grooves is not None:
        aimed = aimed.with_rings(table, nm.reshape(-1), grooves)
    lit = aimed.weight > 0
    if not lit.any():
        return None
    places = aimed.place[:, lit]
    least, most = places.min(axis=1), places.max(axis=1)
    corner = np.floor(least).astype(int) - _MARGIN
    width, height = (np.ceil(most).astype(int) + _MARGIN - corner).tolist()
    if max(width, height) > LARGEST:
        raise InputError("kernel", "size", f"({width} x {height} pixels)", f"at most {LARGEST} a side: blur less")
    # With one box a pixel, grooves finer than a pixel would leave a checkerboard.
    finer = _FINER if grooves is not None and _FINER * max(width, height) <= LARGEST else 1
    light = np.zeros((finer * height, finer * width, 3), np.float32)
    colour = np.eye(3) if len(nm) > 1 else np.ones((1, 3))
    for k in range(nm.size):
        aimed.draw(light, k, corner, colour[[k // nm.shape[1]]] / nm.shape[1], finer)
    light = np.maximum(_averaged(light, finer), 0)
    return Kernel(light, (int(corner[0]), int(corner[1])), aimed.film_by_plate, aimed.sweep(corner))


def _averaged(light: FloatArray, finer: int) -> FloatArray:
    """Average light to pixels `finer` times as wide, under a quadratic spline over three of them; the rim is dark."""
    for axis in (0, 1) if finer > 1 else ():
        for _ in range(2):
            light = np.mean([np.roll(light, k - finer // 2, axis) for k in range(finer)], axis=0)
        light = np.add.reduceat(light, np.arange(0, light.shape[axis], finer), axis)
    return light


def _disk(side: NDArray[Any]) -> Array:
    """Map a grid [2, N, N] over the square of -1 to 1 to the disk: x sqrt(1 - y^2 / 2), and the same in y.

    It is smooth; the map of `Camera.sample` has corners along the diagonals.
    """
    x, y = np.meshgrid(side, side)
    return np.stack([x * np.sqrt(1 - y**2 / 2), y * np.sqrt(1 - x**2 / 2)])


def _square(disk: Array) -> FloatArray:
    """Return the points [2, N] of the unit square that `Camera.sample` takes to these points of the disk."""
    (u, v), radius = disk.reshape(2, -1), np.hypot(*disk.reshape(2, -1))
    return turned(np.stack([0.5 + 0.5 * radius, np.full_like(radius, 0.5)]), np.arctan2(v, u))


def _between(values: NDArray[Any], at: NDArray[Any]) -> Array:
    """Interpolate values [..., cells + 1, cells + 1] at columns and rows `at` of their grids, linearly."""
    share = np.maximum(1 - np.abs(at[:, None] - np.arange(values.shape[-1])), 0)
    return np.asarray(share @ values @ share.T)


@dataclass(frozen=True)
class _Aimed:
    """Rays of a pupil's grid that see a point, at several wavelengths one after the other.

    Attributes: (for N rays, or after `on_grid` for rays [waves, cells + 1, cells + 1]) place: [2, ...] on the film in
    pixels. weight: [...]. slope: [2, ...], b of their lines. film_by_plate: [2, 2] the mean derivatives of the places
    by the point's place.
    """

    place: Array
    weight: Array
    slope: Array
    film_by_plate: Array

    def on_grid(self, edge: Array, cells: int) -> _Aimed:
        """Return the rays as grids, from `_RIM` extrapolated along the pupil's radii to the edge at each wavelength."""
        place, weight, slope = (
            v.reshape(*v.shape[:-1], len(edge), cells + 1, -1) for v in (self.place, self.weight, self.slope)
        )
        edge = edge[:, None, None]
        index, nearer = np.arange(cells + 1) - cells / 2, 1 - 2 / cells
        far, near = (np.hypot(*_disk(2 / cells * k * index)) for k in (1, nearer))
        within = _between(place, cells / 2 + nearer * index)
        solid = (weight > 0) & (_between(weight > 0, cells / 2 + nearer * index) > 1 - 1e-9) & (far > 0)
        more = (edge / _RIM - 1) * far / np.where(far > 0, far - near, 1) * (place - within)
        return _Aimed(place + np.where(solid, more, 0), weight * edge**2, slope, self.film_by_plate)

    def draw(self, light: FloatArray, number: int, corner: NDArray[np.int_], colour: Array, finer: int) -> None:
        """Add the light of a wavelength to a kernel's picture, by quarters of the pupil.

        Cells are cut along the grid's diagonal in each quarter. `finer` is how many of the picture's pixels a film
        pixel has along its side.
        """
        height, width = light.shape[:2]
        (x, y), weight = finer * (self.place[:, number] - corner[:, None, None]), self.weight[number]
        lit, cells = weight > 0, len(weight) - 1
        half, square = cells // 2, 1 - np.linspace(-1, 1, cells + 1) ** 2 / 2
        # A cell's share of the area of the disk.
        share = (square[:, None] + square - 1) / np.sqrt(square[:, None] * square) * (4 / math.pi / cells**2)
        # `edges_of` turns film points in mm into pixels, from the middle on; here a pixel is a mm.
        rows = np.stack(
            [np.where(lit, width / 2 - x, 0), np.where(lit, y - height / 2, 0), weight * share, np.where(lit, 0, LOST)]
        )
        halves = slice(0, half + 1), slice(half, cells + 1)
        for across, down in ((0, 0), (0, 1), (1, 0), (1, 1)):
            part = rows[:, halves[down], halves[across]][..., :: 1 if across == down else -1]
            edges = edges_of(np.ascontiguousarray(part.reshape(4, -1), np.float32), half, (width, height), 1.0)
            draw_edges(light, range(height), edges, np.array([len(edges)]), colour)

    def with_rings(self, table: RayTable, nm: FloatArray, grooves: Grooves) -> _Aimed:
        """Return the rays on a grid so fine that it shows the grooves, with places that these have moved."""
        cells, lit = self.weight.shape[1] - 1, self.weight > 0
        pupil, film = (
            np.tile(_square(_disk(np.linspace(-1, 1, cells + 1))), len(nm)),
            table.film_mm(self.place.reshape(2, -1)),
        )
        response = responses(table.camera, film, table.unturned(film, pupil), np.repeat(nm, lit[0].size))
        least = 2 * float(response[:, 0, lit.reshape(-1)].max(initial=0.0)) * _A_GROOVE / _FINEST
        if grooves.spacing_mm < least:
            raise InputError("kernel", "ring_spacing_mm", grooves.spacing_mm, f"at least {least:.2g} mm on this lens")
        fine = cells * max(1, math.ceil(least * _FINEST / grooves.spacing_mm / cells))
        place, weight, slope, whole, response = (
            _between(v, np.arange(fine + 1) * cells / fine)
            for v in (self.place, self.weight, self.slope, lit, response.reshape(-1, 5, *lit.shape))
        )
        moved_mm = moves(response.reshape(*response.shape[:2], -1), grooves).T
        moved = (moved_mm * table.size / table.camera.film_mm * (-1, 1)).T.reshape(place.shape)
        return _Aimed(place + moved, np.where(whole > 1 - 1e-9, weight, 0), slope, self.film_by_plate)

    def sweep(self, corner: NDArray[np.int_]) -> Array:
        """Fit `Kernel.sweep` by least squares to the rays that pass."""
        lit = self.weight > 0
        basis = np.stack([np.ones(int(lit.sum())), *(self.place[:, lit] - corner[:, None])], axis=1)
        return np.asarray(np.linalg.lstsq(basis, self.slope[:, lit].T, rcond=None)[0].T)


def _edge(table: RayTable, place: Array, nm: FloatArray) -> Array:
    """Return how far out in the pupil's outline the light reaches, as the radius of a disk, for each wavelength.

    An outline holds all rays that pass, and is a little larger. The light of points between `_RIM` and the outline, at
    golden steps of area, beside that of points at `_RIM` tells the disk's area. `place` is of `_aimed`.
    """
    off = table.pupil - np.float32(0.5)
    off = off[:, rim := np.abs(off).max(axis=0) > _RIM / 2 - 1e-6]
    share = (np.arange(off.shape[1]) * (math.sqrt(5) - 1) / 2) % 1
    pupil = 0.5 + np.concatenate([off, off * np.sqrt(1 + (1 / _RIM**2 - 1) * share)], axis=1).astype(np.float32)
    own = np.tile(place.reshape(2, len(nm), -1)[..., rim], 2).reshape(2, -1)
    weight = table.at(own, np.tile(pupil, len(nm)), np.repeat(nm, pupil.shape[1]))[:, 4]
    inner, outer = weight.reshape(len(nm), 2, -1).sum(axis=2, dtype=np.float64).T
    passing = np.divide(outer, inner, out=np.ones_like(inner), where=inner > outer)
    return np.asarray(np.sqrt(_RIM**2 + (1 - _RIM**2) * passing))


def _aimed(
    table: RayTable, target: tuple[float, float], w: float, guess: tuple[float, float], nm: FloatArray
) -> _Aimed:
    """Find the rays of all points of the pupil that see a point of the plate, at each of some wavelengths."""
    pupil, waves = np.tile(table.pupil, len(nm)), np.repeat(nm, table.pupil.shape[1])
    wanted, axes = np.array(target)[:, None], np.eye(2)[..., None]

    def seen(*places: Array) -> list[tuple[Array, Array, Array]]:
        """Return what rays from several places see, by one call of the camera, because there are few rays."""
        count = len(places)
        lines = table.at(np.concatenate(places, 1), np.tile(pupil, count), np.tile(waves, count)).astype(np.float64)
        return [(part[:2] + w * part[2:4], part[4], part[2:4]) for part in np.split(lines.T, count, axis=1)]

    place = np.repeat(np.array(guess, np.float64)[:, None], len(waves), axis=1)
    step = 0.01 * max(table.size)
    (at, weight, slope), *moved = seen(place, *(place + step * axis for axis in axes))
    good = (weight > 0) & (moved[0][1] > 0) & (moved[1][1] > 0)
    if not good.any():
        return _Aimed(place, np.zeros(len(waves)), slope, np.eye(2))
    film_by_plate = np.linalg.inv(np.stack([((m[0] - at) / step)[:, good].mean(axis=1) for m in moved], axis=1))
    for _ in range(_STEPS):
        off = wanted - at
        # Rays that do not pass do not tell where the point's light is: they move as the others do.
        off[:, weight <= 0] = off[:, weight > 0].mean(axis=1, keepdims=True) if (weight > 0).any() else 0.0
        place = place + film_by_plate @ off
        [(at, weight, slope)] = seen(place)
        if np.hypot(*(wanted - at))[weight > 0].max(initial=0.0) < _CLOSE:
            break
    # Each ray has its own area: near the end of the light the pupil's outline moves fast with the film point.
    around = seen(*(place + d * axis for d in (0.5, -0.5) for axis in axes))
    (xx, yx), (xy, yy) = (p[0] - q[0] for p, q in zip(around[:2], around[2:], strict=True))
    stretch = np.abs(xx * yy - xy * yx)
    known = np.all([found[1] > 0 for found in around], axis=0) & (stretch > 0)
    area = np.where(known, 1 / np.where(known, stretch, 1), abs(float(np.linalg.det(film_by_plate))))
    close = np.hypot(*(wanted - at)) < _FAR * max(1.0, float(np.ptp(place, axis=1).max()))
    light, kept = weight * area, np.where(close, weight, 0) * area
    # Where Newton's method leaves rays beside the point, their light goes where that of the others goes.
    share = kept.sum() / max(light.sum(), 1e-30)
    return _Aimed(place, kept / share if share > _SURE else light, slope, film_by_plate)


def tint(camera: Camera) -> NDArray[np.float64]:
    """Return the matrix [3, 3] by which a blurred picture gets the colour that the lens gives white light on the axis.

    The blur takes wavelengths from where red, green and blue respond positively, each by itself. The film's responses
    are negative elsewhere, and what a lens absorbs there counts, too, as does what it takes of the other two colours.
    """
    low, high = (min(max(v, LIGHT_NM[0]), LIGHT_NM[1]) for v in camera.wavelength_nm or LIGHT_NM)
    light = SpectralRange(low, max(low, high), _TINT)
    if not (light.colours and camera.dispersive):
        return np.eye(3)
    side = (np.arange(_TINT_PUPIL) + 0.5) / _TINT_PUPIL
    square = np.tile(np.stack(np.meshgrid(side, side)).reshape(2, -1), _TINT).astype(np.float32)
    nm = light.centres_nm.repeat(_TINT_PUPIL**2).astype(np.float32)
    film = np.zeros_like(square) + axis_mm(camera)[0][:, None].astype(np.float32)
    passed = camera.sample(film, square, nm).weight.reshape(_TINT, -1).mean(axis=1, dtype=np.float64)
    if not passed.all():
        return np.eye(3)
    alone = np.maximum(light.response * light.basis, 0)
    mixed = np.einsum("cn,kn,n->ck", light.response, light.basis, passed) / _TINT
    return np.asarray(mixed / (alone @ passed / alone.sum(axis=1)))


@dataclass(frozen=True)
class Cell:
    """One kernel of many.

    Attributes:
        field: -1 to 1 from left to right and from bottom to top of the film. distance_m: from the film.
        place_px: the film place that is its centre. kernel: None where no light arrives.
    """

    field: tuple[float, float]
    distance_m: float
    place_px: tuple[float, float]
    kernel: Kernel | None

    @property
    def width_px(self) -> int:
        """Return how many pixels a side, an odd number, hold the kernel about its place."""
        if self.kernel is None:
            return 1
        first = np.subtract(self.kernel.corner_px, np.floor(self.place_px))
        return 2 * int(np.abs([first, first + self.kernel.light.shape[1::-1] - 1]).max()) + 1

    def spread_by(self, waves: Diffraction) -> Cell:
        """Return the cell with the kernel after diffraction."""
        if self.kernel is None:
            return self
        own = waves.at(self.place_px)
        light, r = self.kernel.light, own.shape[-1] // 2
        shape = light.shape[0] + 2 * r, light.shape[1] + 2 * r
        spectrum = np.fft.rfft2(light, shape, (0, 1)) * np.fft.rfft2(own.transpose(1, 2, 0), shape, (0, 1))
        column, row = self.kernel.corner_px
        return self._with(np.fft.irfft2(spectrum, shape, (0, 1)), (column - r, row - r))

    def _with(self, light: Array, corner_px: tuple[int, int]) -> Cell:
        """Return the cell with another picture [h, w, 3] of its point."""
        assert self.kernel is not None
        lit: FloatArray = np.maximum(light, 0).astype(np.float32)
        return replace(self, kernel=replace(self.kernel, light=lit, corner_px=corner_px))


def diffracted(camera: Camera, size: tuple[int, int], cells: Sequence[Cell], waves: Diffraction) -> list[Cell]:
    """Return the kernels of one distance with diffraction.

    They are sums of waves over the pupils of their places. Where these would need too many points, or pixels, and on a
    turned film, whose kernels are sharper on one side, the kernels by rays are spread by their zone's diffraction.
    """
    widest, r = max(cell.width_px for cell in cells), waves.kernels.shape[-1] // 2
    summed = None
    if widest + 2 * _MARGIN <= MOST_PX and not camera.film.pose.turned:  # type: ignore[attr-defined]
        width, height = camera.film_mm
        places = [(cell.field[0] * width / 2, cell.field[1] * height / 2) for cell in cells]
        side, pixel_mm = min(widest + 2 * r, MOST_PX), camera.film_mm[0] / size[0]
        at = on_upright(camera, places)
        summed = spreads(lens_of(camera), cells[0].distance_m, at, waves.channels, pixel_mm, side)
    found = []
    for k, cell in enumerate(cells):
        if summed is None or cell.kernel is None or summed[k].by_rays or not summed[k].inside.all():
            found.append(cell.spread_by(waves))
            continue
        x, y = (math.floor(at) - side // 2 for at in cell.place_px)
        found.append(cell._with(summed[k].light.transpose(1, 2, 0) * cell.kernel.energy, (x, y)))
    return found


def own_plate(camera: Camera, size: tuple[int, int]) -> Plate:
    """Return an empty plate of the camera's own pinhole, that of `neurolens stmap`, with `size` pixels on its film.

    It moves with the film, so that a point is about where the film shows it.
    """
    frame, axis = frame_of(camera), axis_px(camera, size)
    per_mm = [n / mm for n, mm in zip(size, camera.film_mm, strict=True)]
    reach = frame.reach_mm[0] * per_mm[0], frame.reach_mm[1] * per_mm[1]
    return Plate([], PlatePinhole(reach, axis, frame.pupil_mm[1]), size, axis_px=axis)


def kernels_over(
    camera: Camera, size: tuple[int, int], distances_m: Sequence[float], fields: tuple[int, int],
    wavelengths_nm: tuple[float, float, float] | None = None, grooves: Grooves | None = None,
    report: Callable[[float], None] = lambda _: None,
) -> list[list[Cell]]:  # fmt: skip
    """Make the kernels of each distance, row by row from the top of the picture.

    Args:
        size: of the picture in pixels. distances_m: from the film, along the axis; inf is far.
        fields: how many columns and rows of places, in the middles of equal parts of the picture.
        wavelengths_nm, grooves: as for `kernel_at`.

    Raises:
        InputError: a distance lies within the lens; the kernels are too large for memory.
    """
    plate, found = own_plate(camera, size), []
    places = [
        ((i + 0.5) / fields[0] * size[0], (j + 0.5) / fields[1] * size[1])
        for j, i in itertools.product(range(fields[1]), range(fields[0]))
    ]
    least, white = plate.pinhole.before_film_mm / 1000, np.eye(3) if wavelengths_nm else tint(camera)
    for distance in distances_m:
        if not distance > least:
            raise InputError("kernels", "distance_m", distance, f"above {least:g}, the entrance pupil")
    for number, distance in enumerate(distances_m):
        ahead, cells = distance - least, list[Cell]()
        for place in places:
            kernel = kernel_at(camera, plate, place, 1 / ahead, place, wavelengths_nm=wavelengths_nm, grooves=grooves)
            kernel = kernel and kernel.tinted(white)
            field = 2 * place[0] / size[0] - 1, 1 - 2 * place[1] / size[1]
            cells.append(Cell(field, distance, place if kernel is None else kernel.middle_px, kernel))
            if max(fields) * (side := cells[-1].width_px) > _LARGEST:
                got = f"({fields[0] * side} x {fields[1] * side} pixels)"
                expected = f"at most {_LARGEST} pixels a side: fewer fields, or less blur"
                raise InputError("kernels", "size", got, expected)
            report((number + len(cells) / len(places)) / len(distances_m))
        found.append(cells)
    return found


def as_picture(cells: Sequence[Cell], columns: int, side: int) -> FloatArray:
    """Put the kernels of one distance into an atlas [rows side, columns side, 3]; each channel has the sum 1."""
    picture = np.zeros((len(cells) // columns * side, columns * side, 3), np.float32)
    for k, cell in enumerate(cells):
        j, i = divmod(k, columns)
        if cell.kernel is not None:
            picture[j * side :, i * side :][:side, :side] = cell.kernel.centred(side, cell.place_px)
    return picture


def as_preview(picture: FloatArray, side: int) -> FloatArray:
    """Scale the kernels of an atlas to equal brightness, to be looked at."""
    found = picture.copy()
    for j, i in itertools.product(range(0, len(found), side), range(0, found.shape[1], side)):
        part = found[j : j + side, i : i + side]
        part /= float(np.percentile(part[part > 0], 90)) if part.any() else 1.0
    return found
