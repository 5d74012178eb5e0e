"""Diffraction at the opening that a light has through the lens: its far field on the film, and the star that it makes.

The field on the film is U(x, y) = 1/lambda times the integral of sqrt(e) exp(i k (W + L x + M y)) dL dM over the
light's exit pupil (Debye; Born and Wolf, section 8.8). Here e is the light per area of direction cosines (L, M), and
|U|^2 sums to the light that arrives.

Near the centre the integral is summed over cells of the pupil. A picture is thousands of fringes wide, and pixels are
wider than fringes: farther out, at a distance u, the mean over a pixel follows from the pupil's outline. With n dl its
elements, |k u|^2 |U|^2 is the power spectrum of sqrt(e) n exp(i k W) dl (the divergence theorem), and the mean over a
pixel is that of pairs of elements less than about lambda / pixel apart. Between the streaks of straight edges this is
right to some 5e-5 of the streaks.

Out of focus u counts from where the rays of each element meet the film (Born and Wolf, section 8.9, the boundary
diffraction wave at short wavelengths). Elements are summed in three groups by the direction of n. A pixel has light
from the elements whose n lies along u, and no group holds both the near and the far edge of an image: so each group
needs only one u, that of the element whose n is closest to it. At another wavelength the phases and the fringes differ:
out of focus each of five parts of the range has its own spectrum, and at 400 and 700 nm rings 1 mm out of focus at f/8
are right to 5%.
"""

import ctypes
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import torch
from numpy.typing import NDArray

from neurolens.base.errors import InputError
from neurolens.base.tasks import in_order
from neurolens.cameras.contract import FloatArray
from neurolens.cameras.pose import UPRIGHT
from neurolens.graph.compiler import c_source, load_compiled
from neurolens.optics.lens.paraxial import first_order
from neurolens.pictures.flare.canvas import Raster, resampled, smear_of, smeared
from neurolens.pictures.flare.exit_pupil import CELLS, Array, ExitPupil, coverage, exit_pupil, image_moves, outline
from neurolens.pictures.flare.job import FlareJob
from neurolens.pictures.flare.lights import Light, patches
from neurolens.pictures.render.colour import in_gamut

_PER_CYCLE = 2.5  # cells a cycle of the field needs
_NEAR, _FAR = 2.0, 4.0  # pixels from the centre: between these the sum over cells gives way to the outline
_SPECTRUM = 4096  # samples a side of the outline's power spectrum
_PARTS = 8  # of the range of wavelengths, out of focus
_STARTS = 1 << 15  # elements of the outline at which pairs start
_PATCH_DEG = 8.0  # of a patch of an extended light: see `patches`
_FARTHEST_MM = 1e5  # exit pupils are no farther from the film: rays of a telecentric lens are parallel
_GROUPS, _SAMPLES = 3, 64  # of elements out of focus; how many of a group keep their places, for each of up to 8 lines


def cells_needed(pupil: ExitPupil, reach_mm: float) -> int:
    """Return the fewest cells across the pupil, a power of two, that `far_field` needs for points so far out."""
    cycles = 2 * float(pupil.half.max()) * (reach_mm + pupil.blur_mm) / (pupil.wavelength_nm * 1e-6)
    return max(64, 1 << math.ceil(math.log2(_PER_CYCLE * cycles + 1)))


def far_field(pupil: ExitPupil, lines: Sequence[Array], x_mm: Array, y_mm: Array) -> Array:
    """Return the irradiance [Y, X] on the film, for 1 at the lens, at x and y from the pupil's centre, by its cells.

    Args:
        lines: `outline` of the pupil at any wavelength.

    Raises:
        InputError: the points are so far out, or the aberrations so large, that the cells do not suffice.
    """
    wave = pupil.wavelength_nm * 1e-6
    farthest = max(float(np.abs(x_mm).max()), float(np.abs(y_mm).max()))
    cells = cells_needed(pupil, farthest)
    if cells > CELLS:
        raise InputError("diffraction", "x_mm, y_mm", farthest, f"fewer fringes: {CELLS} cells, not {cells}")
    cells = min(2 * cells, CELLS)
    share = (np.arange(cells) + 0.5) * 2 / cells - 1
    field = coverage(lines, cells) * pupil.field((share, share))
    size = 2 * pupil.half / cells
    ways = []
    for axis, place in ((0, x_mm), (1, y_mm)):
        cosine = pupil.half[axis] * share
        # Shares of cells are means over cells, whose transform is lower by a sinc.
        ways.append(
            size[axis] / np.sinc(size[axis] * np.maximum(np.abs(place) - pupil.blur_mm, 0) / wave)[:, None]
            * np.exp(2j * math.pi / wave * np.outer(place, cosine))
        )  # fmt: skip
    first, second, field = (m.astype(np.complex64) for m in (*ways, field.T))
    return np.asarray(np.abs(second @ field @ first.T / wave) ** 2)


@dataclass(frozen=True)
class Spectrum:
    """The power spectrum of an outline, |sum of sqrt(e) n exp(i k W) dl|^2 in mm^2, smoothed.

    Attributes:
        values: [G, N, N] the parts of G groups of elements, at multiples of `step` in y and x; 0 is at N // 2.
        step: cycles per unit of cosine.
        edges: [G] arrays [M, 4] of some elements of each group: x, y in mm from the centre where their rays meet the
            film, and n with length 1. With M = 0 all rays meet at the centre.
    """

    values: FloatArray
    step: float
    edges: Sequence[Array]

    def irradiance(self, x_mm: Array, y_mm: Array, wavelength_nm: float) -> Array:
        """Return the mean irradiance [Y, X] about points away from the image, for 1 at the lens."""
        total = np.zeros((len(y_mm), len(x_mm)), np.float32)
        for found, edges in zip(self.values, self.edges, strict=True):
            for axis, place in ((0, y_mm), (1, x_mm)):
                found = resampled(found, axis, place * (1e6 / wavelength_nm / self.step) + found.shape[axis] // 2)
            total += found / np.maximum(4 * math.pi**2 * _squares(edges, x_mm, y_mm), 1e-30)
        return np.maximum(total, 0)


def _squares(edges: Array, x_mm: Array, y_mm: Array) -> FloatArray:
    """Return |u|^2 [Y, X] of points, each from the element (`Spectrum.edges`) whose light it has."""
    found = np.empty((len(y_mm), len(x_mm)), np.float32)
    between = np.pad((np.diff(edges[:, :2], axis=0) ** 2).sum(1), 1, constant_values=np.inf)
    edges = np.column_stack([edges, np.minimum(between[1:], between[:-1]) if len(edges) else edges[:, :1]])
    given: list[Array] = [np.ascontiguousarray(a, np.float32) for a in (x_mm, y_mm, edges)]
    call = load_compiled(c_source("pictures/flare/diffraction.c")).squares
    call.argtypes, call.restype = [ctypes.c_int64] * 3 + [ctypes.c_void_p] * 4, None
    call(len(x_mm), len(y_mm), len(edges), *(a.ctypes.data for a in (*given, found)))
    return found


def outline_spectrum(
    pupil: ExitPupil,
    lines: Sequence[Array],
    shortest_nm: float,
    pixel_mm: float,
    reach_mm: float,
    part: tuple[int, int] = (0, 1),
) -> Spectrum:
    """Return the spectrum that serves film points up to `reach_mm` from the centre.

    It is smoothed as by pixels at the shortest wavelength (or by larger ones, if samples are too few): by the fourth
    power of sinc(x / 2), x in pixels, whose samples a pixel apart always have the same sum.

    Args:
        part: K and N, where N spectra are averaged and this is the K-th; each begins to pair elements at another place.
    """
    wave = shortest_nm * 1e-6
    pixel = max(pixel_mm, 8 * reach_mm / _SPECTRUM)
    reach = wave / pixel  # of pairs, in cosines
    samples = 2 * math.ceil(4 * reach_mm / pixel)
    place, normal = _elements(pupil, lines, 2 * reach / samples)
    field = pupil.field(place / pupil.half[:, None])
    # In focus, phases of neighbours are equal.
    focused = pupil.blur_mm < pixel / 8
    vector = normal * (np.abs(field) if focused else field)
    order = np.argsort(place[0], kind="stable")
    given = (place[:, order] / reach).copy(), np.ascontiguousarray(vector[:, order], np.complex64)
    every = math.ceil(len(order) * part[1] / _STARTS)
    some = np.arange(part[0] * every // part[1], len(order), every)
    rank = np.argsort(order)[some]
    call = load_compiled(c_source("pictures/flare/diffraction.c")).pairs
    call.argtypes, call.restype = [ctypes.c_int64] * 3 + [ctypes.c_void_p] * 4, None
    # A value spread over its nearest nine lags is lowered by the third power of a sinc.
    near = np.arange(-(samples // 4) - 2, samples // 4 + 3)  # samples of film points
    raised = (np.sinc(near / samples) ** -3).astype(np.float32)
    group = np.zeros(len(order), int) if focused else _groups(normal)
    values, edges = np.empty((group.max() + 1, len(near), len(near)), np.float32), []
    for k, own in enumerate(values):
        total = np.zeros((samples // 2 + 3, samples), np.complex64)  # by lags in x, which begin at -1
        starts = rank[group[some] == k].astype(np.int64)
        call(len(order), len(starts), samples, *(a.ctypes.data for a in (starts, *given, total)))
        opposite = -np.arange(samples)
        total[2] += total[0, opposite].conj()
        total[1] += total[1, opposite].conj()
        half = torch.fft.ifft(torch.from_numpy(total[1:-1]), norm="forward")[:, near]  # the last lag's window is 0
        power = torch.fft.irfft(half.T.contiguous(), samples, norm="forward")[:, near].numpy()
        np.multiply(power, raised * (len(order) / len(some)), out=own)
        own *= raised[:, None]
        kept = np.nonzero(group == k)[0]
        kept = kept[:: max(len(kept) // (_SAMPLES * min(len(lines), 8)), 1)][: 0 if focused else None]
        way = normal[:, kept] / np.hypot(*normal[:, kept])
        edges.append(np.concatenate([pupil.hits(place[:, kept] / pupil.half[:, None]), way]).T)
    return Spectrum(values, 1 / (2 * reach), edges)


def _groups(normal: Array) -> NDArray[np.int_]:
    """Group elements [N] by the direction of n; limits lie where elements are fewest, so not along an edge."""
    turn = np.arctan2(normal[1], normal[0]) * (_GROUPS / (2 * math.pi))
    fewest = np.histogram(turn % 1, 60, (0, 1))[0].argmin()
    found = np.floor(turn - (fewest + 0.5) / 60).astype(int) % _GROUPS
    return np.asarray(np.unique(found, return_inverse=True)[1])


def _elements(pupil: ExitPupil, lines: Sequence[Array], spacing: float) -> tuple[Array, Array]:
    """Cut outlines into elements, at most `spacing` long: cosines from the middle of the box, and n dl."""
    places, normals = [], []
    for line in lines:
        ends = np.append(line, line[:, :1], 1) * pupil.half[:, None]
        length = np.append(0.0, np.cumsum(np.hypot(*np.diff(ends))))
        at = np.linspace(0, length[-1], 3 + int(length[-1] / spacing))
        x, y = (np.interp(at, length, e) for e in ends)
        places.append(np.stack([x[1:] + x[:-1], y[1:] + y[:-1]]) / 2)
        normals.append(np.stack([np.diff(y), -np.diff(x)]))
    return np.concatenate(places, 1), np.concatenate(normals, 1)


def starburst_picture(job: FlareJob, done: Callable[[float], None] = lambda share: None) -> FloatArray:
    """Return the stars of lights, [H, W, 3] linear sRGB: the light that diffraction takes out of their images.

    The star of a point is 0 where rays make the image itself and at the pixels next to that, because a render has the
    light there. Energy is kept if the render's light is reduced by the sum of this layer on a film without edges. An
    extended light has the sum of its points' stars, also within its image. Diffracted light is assumed to pass the rear
    of the lens unhindered. A light whose rays do not reach the film has no star. On a turned film all of a star has the
    focus of its image. Fringes of one wavelength lie beyond the gamut of sRGB: see `in_gamut`. `done` is called with
    the share of the work.
    """
    if job.pose.turned:
        return _on_turned_film(job, done)
    raster, spectral = job.raster, job.spectral()
    picture = np.zeros((raster.height, raster.width, 3), np.float32)
    parts = [patch for light in job.lights for patch in patches(light, _PATCH_DEG)]
    for number, patch in enumerate(parts):
        colours = spectral.response * spectral.spectrum(patch.light.rgb) / (spectral.bins * job.exposure)
        moved = raster.per_mm * image_moves(job.lens, patch, float(spectral.centres_nm.mean())) * (-1, 1)
        smear = smear_of(patch.weights, patch.round, moved)
        kernel = np.ones((1, 1), np.float32) if smear is None else smear.kernel(max(raster.width, raster.height) // 2)
        height, width = (n + k - 1 for n, k in zip((raster.height, raster.width), kernel.shape, strict=True))
        canvas = np.zeros((height, width, 3), np.float32)
        around = Raster((width / raster.per_mm, height / raster.per_mm), width, height)
        for k, film in enumerate(_stars(job, patch.light, spectral.centres_nm, around)):
            canvas += film[..., None] * colours[:, k].astype(np.float32)
            done((number + (k + 1) / spectral.bins) / len(parts))
        picture += canvas if smear is None else smeared(canvas, kernel)
        done((number + 1) / len(parts))
    return in_gamut(picture)


def _on_turned_film(job: FlareJob, done: Callable[[float], None]) -> FloatArray:
    """Return the stars on a turned film: those of upright films through the images, seen from the exit pupil."""
    from scipy import ndimage  # type: ignore[import-untyped]

    raster, lens, turn, moved = job.raster, job.lens, job.pose.axes, job.pose.moved_mm
    assert lens.film_z_mm is not None
    back = min(abs(lens.film_z_mm - float(first_order(lens).exit_pupil_z_mm)), _FARTHEST_MM)
    across = (raster.width / 2 - 0.5 - np.arange(raster.width)) / raster.per_mm - moved[0]
    down = (np.arange(raster.height) + 0.5 - raster.height / 2) / raster.per_mm - moved[1]
    place = np.tensordot(turn[:, :2], np.stack(np.meshgrid(across, down)), 1)  # of pixels, from the film's middle
    picture = np.zeros((raster.height, raster.width, 3), np.float32)
    for number, light in enumerate(job.lights):
        image = exit_pupil(lens, light, 0.5 * sum(job.wavelength_nm))
        if image is None:
            continue
        slope = image.middle / math.sqrt(1 - float(image.middle @ image.middle))
        chief = back * np.append(slope, 1.0)  # from the middle of the pupil to the upright film
        pupil = np.append(image.centre_mm, 0.0) - chief
        rays = place - pupil[:, None, None]
        rays[2] = np.maximum(rays[2], 0.1 * back)  # the film of a short lens may reach its pupil, as in `covers_mm`
        depth = -back * float(turn[:, 2] @ pupil) / float(turn[:, 2] @ chief)  # of the image, from the pupil
        scale = depth / rays[2]
        spot = pupil[:2, None, None] + scale * rays[:2]  # where they meet the upright film through the image
        most = 2 * max(raster.width, raster.height)
        half = [min(math.ceil(float(np.abs(v).max()) * raster.per_mm) + 2, most) for v in spot]
        size = [2 * n / raster.per_mm for n in half]
        film = Raster((size[0], size[1]), 2 * half[0], 2 * half[1])
        there = replace(lens, film_z_mm=lens.film_z_mm - back + depth)
        upright = replace(job, lens=there, lights=[light], pose=UPRIGHT, raster=film, ghosts=None)
        flat = starburst_picture(upright) * (upright.exposure / job.exposure)
        at = half[1] - 0.5 + spot[1] * raster.per_mm, half[0] - 0.5 - spot[0] * raster.per_mm
        share = scale**2 * np.tensordot(turn[:, 2], rays, 1) / rays[2]  # of light: pixels stand aslant, and farther
        picture += np.stack([share * ndimage.map_coordinates(c, at, order=1) for c in np.moveaxis(flat, -1, 0)], -1)
        done((number + 1) / len(job.lights))
    return picture


def _stars(job: FlareJob, light: Light, wavelengths_nm: Array, raster: Raster) -> Iterator[FloatArray]:
    """Yield the star of a light at each wavelength: irradiance [H, W] for 1 at the lens; none if it is dark."""
    lens, moved = job.lens, job.pose.moved_mm
    middle = exit_pupil(lens, light, float(wavelengths_nm.mean()))
    lines = [] if middle is None else outline(middle)
    if middle is None or not lines:
        return
    pixel = 1 / raster.per_mm
    x = (raster.width / 2 - 0.5 - np.arange(raster.width)) * pixel - moved[0]
    y = (np.arange(raster.height) + 0.5 - raster.height / 2) * pixel - moved[1]
    reach = max(float(np.abs(p - c).max()) for p, c in zip((x, y), middle.centre_mm, strict=True))

    def one(nm: float, far: Spectrum) -> FloatArray:
        pupil = exit_pupil(lens, light, float(nm), middle)
        if pupil is None:
            return np.zeros((raster.height, raster.width), np.float32)
        return star(pupil, lines, far, x - pupil.centre_mm[0], y - pupil.centre_mm[1], pixel)

    parts = np.array_split(wavelengths_nm, 1 if middle.blur_mm < pixel / 8 else min(_PARTS, len(wavelengths_nm)))
    for number, part in enumerate(parts):
        # At the wavelength of their mean phase, which goes as 1 / wavelength.
        like = exit_pupil(lens, light, float(1 / np.mean(1 / part)), middle) or middle
        far = outline_spectrum(like, lines, float(part.min()), pixel, reach + pixel, (number, len(parts)))
        yield from in_order(job.threads, partial(one, far=far), part)


def star(pupil: ExitPupil, lines: Sequence[Array], far: Spectrum, x: Array, y: Array, pixel_mm: float) -> FloatArray:
    """Return the mean irradiance [Y, X] of pixels at x and y, mm from the pupil's centre, for 1 at the lens.

    It is 0 at the image itself and next to it.

    Args:
        lines, far: the outline and its spectrum, each at any wavelength.
    """
    found = far.irradiance(x, y, pupil.wavelength_nm)
    columns, rows = (np.nonzero(np.abs(p) < (_FAR + 0.5) * pixel_mm)[0] for p in (x, y))
    few = cells_needed(pupil, (_FAR + 1) * pixel_mm) <= CELLS
    if len(columns) and len(rows) and few and pupil.blur_mm < _NEAR * pixel_mm:
        # Two samples a fringe.
        parts = math.ceil(4 * pixel_mm * float(pupil.half.max()) / (pupil.wavelength_nm * 1e-6)) + 1
        within = ((np.arange(parts) + 0.5) / parts - 0.5) * pixel_mm
        fine = far_field(pupil, lines, *((p[k][:, None] + within).reshape(-1) for p, k in ((x, columns), (y, rows))))
        near = fine.reshape(len(rows), parts, len(columns), parts).mean((1, 3))
        out = np.clip((np.hypot(x[columns], y[rows][:, None]) / pixel_mm - _NEAR) / (_FAR - _NEAR), 0, 1)
        block = np.ix_(rows, columns)
        found[block] = near + out * out * (3 - 2 * out) * (found[block] - near)
    found[_image(pupil, x, y, pixel_mm)] = 0
    return found.astype(np.float32)


def _image(pupil: ExitPupil, x: Array, y: Array, pixel_mm: float) -> NDArray[np.bool_]:
    """Return which pixels [Y, X] rays meet, with those next to them."""
    reach = 1 + int(pupil.blur_mm / pixel_mm / 20)  # rays are farther apart in large images
    met = np.zeros((len(y) + 2 * reach, len(x) + 2 * reach), bool)
    columns, rows = (
        np.rint((hit - p[0]) * (1 if p[-1] >= p[0] else -1) / pixel_mm).astype(int) + reach
        for hit, p in zip(pupil.hits_mm, (x, y), strict=True)
    )
    within = (columns >= 0) & (columns < met.shape[1]) & (rows >= 0) & (rows < met.shape[0])
    met[rows[within], columns[within]] = True
    for _ in range(reach):
        met = met[:-2] | met[1:-1] | met[2:]
        met = met[:, :-2] | met[:, 1:-1] | met[:, 2:]
    return met
