"""Point spread by diffraction, or by rays where diffraction no longer matters, on pixels of any size.

The field about an image point is U(x, y) = 1/lambda times the integral of sqrt(e) exp(i k (W + L x + M y)) dL dM over
the exit pupil (`exit_pupil`; Debye; Born and Wolf, section 8.8). Here it is summed over square cells of the pupil, of
which those on the edge of a rim or a blade count by their open share, as two products of matrices. |U|^2 integrates to
the light that arrives, so that shares of it need no scale. A pixel takes the mean over its area.

Far out of focus the fringes are finer than pixels, and the grid would need too many cells. There the rays of the same
pupil are counted by pixels (`Spread.by_rays`). Where both are known, `Spread.differs` tells how much light they place
in different pixels: some 6% of white light on pixels of 3 um, where rays take over at f/2.8.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from neurolens.optics.analysis.bundles import Aim, Filled
from neurolens.optics.analysis.exit_pupil import Array, Arrived, ExitPupil, arrived, fitted_pupil, phasor
from neurolens.optics.analysis.fields import Scene

Field = NDArray[np.complex64]
_RAYS = 36  # rays along a side of the rectangle about what is lit
_WIDER = 1.1  # the rectangle over what is lit
_PER_CYCLE = 2.5  # cells a cycle of the field needs
_FEWEST, FINEST = 160, 512  # cells across the pupil: the edges need so many even in focus
_RINGS = 6  # radii of the Airy disc that a window has at least
_MOST_CELLS = 1024  # of the pupil along a side, whose rays are counted


class Spread(NamedTuple):
    """The point spread of one place.

    Attributes:
        light: [C, n, n] share of each channel's light in each pixel: rows along y of the film, columns along x.
        centre_mm: [2] film place in the middle of it: the mean of the rays of all wavelengths.
        inside: [C] share of the light within the pixels.
        pupil: [C] projected solid angle of the open pupil, weighted as the wavelengths; relative illumination is the
            ratio of two of these, without losses in glass.
        by_rays: whether rays were counted. differs: share of the light that rays place elsewhere than diffraction,
            NaN where only rays are known.
    """

    light: Array
    centre_mm: Array
    inside: Array
    pupil: Array
    by_rays: bool
    differs: float


def pupils(
    scene: Scene, field_deg: Sequence[float], wavelengths_nm: Sequence[float], turns: Sequence[Sequence[Array]] = ()
) -> list[list[list[ExitPupil | None]]]:
    """Return the exit pupils of object points, by field, turn and wavelength; None where no light arrives.

    All wavelengths have the object point from which the chief ray of the first one comes.

    Args:
        scene: a lens whose film is placed, with the distance of its object.
        turns: for each field some matrices [2, 2] that turn its rays on the film about the axis; one unturned if empty.

    Raises:
        InputError: the lens has no power: its rays meet nowhere.
    """
    scene.require_power()
    waves, found = tuple(wavelengths_nm), list[list[list[ExitPupil | None]]]()
    lens, filled = scene.traced, Filled(scene.round, field_deg, waves[:1])
    low, high = (c.numpy() for c in filled.box())
    share = np.linspace(-_WIDER, _WIDER, _RAYS)
    square = np.stack(np.meshgrid(share, share)).reshape(2, -1)
    for k in range(len(field_deg)):
        places = (low[k] + high[k])[:, None] / 2 + (high[k] - low[k])[:, None] / 2 * square
        aim = Aim(scene, filled.only([k]).chief, len(square[0]), waves)
        u, v = (torch.from_numpy(np.tile(p, len(waves))) for p in places)
        rays, energy = (
            arrived(lens, aim.rays(u, v), aim.wavelength),
            np.broadcast_to(np.asarray(aim.spread(u, v)), u.shape),
        )
        found.append([])
        for turn in turns[k] if turns else [np.eye(2)]:
            found[-1].append([])
            for w, nm in enumerate(waves):
                part = slice(w * len(square[0]), (w + 1) * len(square[0]))
                turned = (turn @ rays.cosines[:, part], turn @ rays.hits[:, part], turn @ rays.at[..., part])
                own = Arrived(*turned, rays.power[part], rays.exists[part], rays.limits_mm, rays.stop)
                dark = not filled.part.reach[k] > 0
                found[-1][-1].append(None if dark else fitted_pupil(lens.aperture, own, places, energy[part], nm))
    return found


def pupils_at(scene: Scene, places_mm: Array, wavelengths_nm: Sequence[float]) -> list[list[ExitPupil | None]]:
    """Return the exit pupils of the object points that are seen at film places, by place and wavelength.

    The chief ray of the first wavelength meets the film at the place. Places at one distance from the axis share rays.

    Args:
        scene: its lens must be round about the axis.
        places_mm: [P, 2] x and y on the film.

    Raises:
        InputError: the lens has no power.
    """
    height, number = np.unique(np.hypot(*places_mm.T).round(9), return_inverse=True)
    fields = np.array(scene.fields_at(height.tolist()))
    known = np.nonzero(np.isfinite(fields))[0]
    found: list[list[ExitPupil | None]] = [[None] * len(wavelengths_nm) for _ in places_mm]
    own = [np.nonzero(number == k)[0] for k in known]
    # An image lies on the negative side of y.
    ways = [[places_mm[p] * (1, -1) / height[k] if height[k] else (0, 1) for p in own[n]] for n, k in enumerate(known)]
    turns = [[np.array([[c, -s], [s, c]]) for s, c in some] for some in ways]
    for some, those in zip(own, pupils(scene, fields[known].tolist(), wavelengths_nm, turns), strict=True):
        for place, by_wave in zip(some, those, strict=True):
            found[place] = by_wave
    return found


def cells_needed(pupil: ExitPupil, reach_mm: float) -> int:
    """Return the fewest cells across the pupil that resolve its diffraction out to `reach_mm` from the centre."""
    cycles = 2 * float(pupil.half.max()) * (reach_mm + pupil.blur_mm) / (pupil.wavelength_nm * 1e-6)
    return max(_FEWEST, 16 * math.ceil(_PER_CYCLE * cycles / 16))


def reach_of(pupils: Sequence[ExitPupil | None]) -> float:
    """Return how far (mm) a window must reach from its centre to hold the rays and six Airy radii."""
    some = [p for p in pupils if p is not None]
    centre = _centre(some)
    return max(
        (
            float(np.hypot(*(p.hits_mm + (p.centre_mm - centre)[:, None])).max())
            + _RINGS * 0.61e-6 * p.wavelength_nm / float(p.half.max())
            for p in some
        ),
        default=0.0,
    )


def _centre(pupils: Sequence[ExitPupil]) -> Array:
    return np.mean([p.centre_mm + p.hits_mm.mean(1) for p in pupils], 0) if pupils else np.zeros(2)


def spread(pupils: Sequence[ExitPupil | None], weights: Array, pixel_mm: float, side: int) -> Spread:
    """Return the point spread of a place.

    Args:
        pupils: by wavelength; None is dark. weights: [C, W] of wavelengths in each channel.
        pixel_mm, side: pixels, and how many along a side.
    """
    some = [p for p in pupils if p is not None]
    centre, size = _centre(some), (len(weights), side, side)
    light, counted = np.zeros(size), np.zeros(size)
    energy, seen = np.zeros(len(weights)), np.zeros(len(weights))
    reach = side * pixel_mm / 2 * math.sqrt(2)
    needed = [0 if p is None else cells_needed(p, reach + math.dist(p.centre_mm, centre)) for p in pupils]
    by_rays = max(needed, default=0) > FINEST
    for p, factor, few in zip(pupils, weights.T, needed, strict=True):
        if p is None:
            continue
        off = centre - p.centre_mm
        x, y = (o + (np.arange(side) - (side - 1) / 2) * pixel_mm for o in off)
        cells = few if not by_rays else min(max(_FEWEST, 32 * math.ceil(p.blur_mm / pixel_mm / 4)), _MOST_CELLS)
        share = p.open_share(cells)
        rays, total, solid = _by_rays(p, x, y, pixel_mm, share)
        counted += factor[:, None, None] * rays
        energy += factor * total
        seen += factor * solid
        if not by_rays:
            light += factor[:, None, None] * by_pixel(p, x, y, pixel_mm, cells_of(p, cells, share))
    whole = np.where(energy > 0, energy, 1.0)[:, None, None]
    light, counted = light / whole, counted / whole
    differs = math.nan if by_rays or not some else float(np.abs(light - counted).sum() / 2 / len(weights))
    light = counted if by_rays else light
    return Spread(light, centre, light.sum((1, 2)), seen, by_rays, differs)


def irradiance(pupil: ExitPupil, x_mm: Array, y_mm: Array, field: Field) -> Array:
    """Return the irradiance [Y, X] at places from the pupil's centre, for 1 at the lens, by its `cells_of`."""
    wave, size = pupil.wavelength_nm * 1e-6, 2 * pupil.half / len(field)
    x, y = (
        phasor(np.outer(place, half / wave * middles(len(field))))
        for half, place in zip(pupil.half, (x_mm, y_mm), strict=True)
    )
    found = (x @ field @ y.T).T
    return np.asarray((found.real**2 + found.imag**2) * np.float32((size.prod() / wave) ** 2), np.float64)


def cells_of(pupil: ExitPupil, cells: int, open_share: Array | None = None) -> Field:
    """Return the field [cells, cells] of the pupil's cells, each times its open share."""
    share = pupil.open_share(cells) if open_share is None else open_share
    return np.asarray(share.astype(np.float32) * pupil.field((middles(cells),) * 2), np.complex64)


def perfect_peak(pupil: ExitPupil, field: Field) -> float:
    """Return the irradiance in the middle of the image that the same pupil has without aberrations."""
    total = float(np.abs(field).sum(dtype=np.float64) * np.prod(2 * pupil.half / len(field)))
    return (total / (pupil.wavelength_nm * 1e-6)) ** 2


def middles(cells: int) -> Array:
    """Return the middles of cells along a side of the pupil's box, between -1 and 1."""
    return (np.arange(cells) + 0.5) * 2 / cells - 1


def by_pixel(pupil: ExitPupil, x_mm: Array, y_mm: Array, pixel_mm: float, field: Field) -> Array:
    """Return the light [Y, X] on square pixels about places, for 1 at the lens, in mm^2."""
    # The square of a field is as fine as lambda over the width of the pupil; two samples of that in each pixel.
    parts = max(1, math.ceil(4 * float(pupil.half.max()) * pixel_mm / (pupil.wavelength_nm * 1e-6)))
    step = pixel_mm / parts
    x, y = (p[0] + (np.arange(-1, parts * len(p) + 1) - (parts - 1) / 2) * step for p in (x_mm, y_mm))
    fine = irradiance(pupil, x, y, field)
    for _ in range(2):  # the mean over a sample's width, f + f'' / 24
        fine = ((22 * fine[1:-1] + fine[:-2] + fine[2:]) / 24).T
    return np.asarray(fine.reshape(len(y_mm), parts, len(x_mm), parts).mean((1, 3)) * pixel_mm**2)


def _by_rays(
    pupil: ExitPupil, x_mm: Array, y_mm: Array, pixel_mm: float, open_share: Array
) -> tuple[Array, float, float]:
    """Return the light [Y, X] of rays by pixel, all light of the pupil (mm^2), and its open solid angle."""
    share = middles(len(open_share))
    area = float(np.prod(2 * pupil.half / len(share)))
    light = open_share * pupil.light((share, share)) * area
    column, row = (
        np.floor((hit - p[0]) / pixel_mm + 0.5).astype(int)
        for hit, p in zip(pupil.hits((share, share)), (x_mm, y_mm), strict=True)
    )
    met = (column >= 0) & (column < len(x_mm)) & (row >= 0) & (row < len(y_mm)) & (light > 0)
    found = np.bincount(row[met] * len(x_mm) + column[met], light[met], len(x_mm) * len(y_mm))
    return (
        np.asarray(found.reshape(len(y_mm), len(x_mm)), np.float64),
        float(light.sum()),
        float(open_share.sum()) * area,
    )
