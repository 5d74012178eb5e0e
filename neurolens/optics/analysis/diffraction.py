"""Point spread by diffraction, or by rays where diffraction no longer matters, on pixels of any size.

The field about an image point is U(x, y) = 1/lambda times the integral of sqrt(e) exp(i k (W + L x + M y)) dL dM over
the exit pupil (`exit_pupil`; Debye; Born and Wolf, section 8.8). Here it is summed over cells of the pupil, of which
those on the edge of a rim or a blade count by their open part, as two products of matrices. |U|^2 integrates to the
light that arrives, so that shares of it need no scale. A pixel takes the mean over its area.

Far out of focus the fringes are finer than pixels, and the grid would need too many cells for the place's own rays.
There the rays of the same pupil are counted by pixels (`Spread.by_rays`): the light of a cell fills a rectangle, of
which pixels have their shares. Where both are known, `Spread.differs` tells how much light they place in different
pixels: some 6% of white light on pixels of 3 um, where rays take over at f/2.8.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import lru_cache
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.ndimage import affine_transform  # type: ignore[import-untyped]

from neurolens.optics.analysis.bundles import Aim, Filled
from neurolens.optics.analysis.exit_pupil import (
    Array,
    Arrived,
    ExitPupil,
    arrived,
    fitted_pupil,
    open_shares,
    phasor,
    slopes,
    summed,
)
from neurolens.optics.analysis.fields import Scene

Field = NDArray[np.complex64]
_RAYS = 36  # rays along a side of the rectangle about what is lit
_WIDER = 1.1  # the rectangle over what is lit
# Cells along a side of the pupil: for each cycle of the field, besides for its edges, and at most.
_PER_CYCLE, _FEWEST, FINEST = 2.0, 24, 400
_RAYS_PER_PIXEL, _FEWEST_RAYS = 1.5, 16  # across the pupil, where rays are counted
_AT_ONCE = 2**17  # cells whose waves are summed in one go
_RINGS = 6  # radii of the Airy disc that a window has at least
_MOST_CELLS = 512  # of the pupil along a side, whose rays are counted


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


def cells_needed(pupil: ExitPupil, reach_mm: Array | float) -> tuple[int, int]:
    """Return the fewest cells along both sides of the pupil that resolve its diffraction, out to `reach_mm` on each."""
    cycles = 2 * pupil.half * (reach_mm + pupil.blurs_mm) / (pupil.wavelength_nm * 1e-6)
    across, down = (4 * math.ceil((_FEWEST + _PER_CYCLE * c) / 4) for c in cycles.tolist())
    return across, down


def _resolved_mm(pupil: ExitPupil) -> Array:
    """Return how far from the centre the finest grid resolves diffraction, the inverse of `cells_needed`."""
    cycles = (FINEST - _FEWEST) / _PER_CYCLE
    return np.asarray(cycles * pupil.wavelength_nm * 1e-6 / (2 * pupil.half) - pupil.blurs_mm)


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
    return np.mean([p.centre_mm for p in pupils], 0) if pupils else np.zeros(2)


def spread(pupils: Sequence[ExitPupil | None], weights: Array, pixel_mm: float, side: int) -> Spread:
    """Return the point spread of a place.

    Where the finest grid resolves the place's own rays and six Airy radii, but not the whole window, the pixels beyond
    what it resolves stay dark.

    Args:
        pupils: by wavelength; None is dark. weights: [C, W] of wavelengths in each channel.
        pixel_mm, side: pixels, and how many along a side.
    """
    every = [p for p in pupils if p is not None]
    centre = _centre(every)
    resolved = [float((_resolved_mm(p) - np.abs(p.centre_mm - centre)).min()) for p in every]
    unseen = max(math.ceil(side / 2 - min(resolved, default=0.0) / pixel_mm), 0)  # pixels on each side of the window
    reach = (side / 2 - unseen) * pixel_mm
    by_rays = unseen > 0 and reach < reach_of(every)
    needed = {k: cells_needed(p, reach + np.abs(p.centre_mm - centre)) for k, p in enumerate(pupils) if p is not None}
    lit = sorted(needed, key=lambda k: -max(needed[k]))
    some, weights = [p for k in lit if (p := pupils[k]) is not None], weights[:, lit]
    if not some:
        dark = np.zeros(len(weights))
        return Spread(np.zeros((len(weights), side, side)), centre, dark, dark, False, math.nan)
    blur = max(p.blur_mm for p in some)
    rays = min(max(_FEWEST_RAYS, 4 * math.ceil(_RAYS_PER_PIXEL * 2 * blur / pixel_mm / 4)), _MOST_CELLS)
    line = (np.arange(side) - (side - 1) / 2) * pixel_mm
    parts, done = list[tuple[Array, ...]](), 0
    while done < len(some):
        across, down = (rays, rays) if by_rays else np.max([needed[k] for k in lit[done:]], 0).tolist()
        group = some[done : done + max(1, _AT_ONCE // (across * down))]
        done += len(group)
        x, y = np.array([centre - p.centre_mm for p in group]).T[..., None] + line
        (share, weight), (cycles, light) = open_shares(group, (across, down)), waves_of(group, (across, down))
        area = np.prod([2 * p.half for p in group], 1) / (across * down)
        counted = spent = _by_rays(group, x, y, pixel_mm, light * share, rays) * area[:, None, None]
        if not by_rays:
            seen = slice(unseen, side - unseen)
            spent = by_pixel(group, x[:, seen], y[:, seen], pixel_mm, phasor(cycles, np.sqrt(light) * weight))
            spent = np.pad(spent, [(0, 0), (unseen, unseen), (unseen, unseen)])
        parts.append((counted, spent, *((s.sum((1, 2), dtype=np.float64) * area) for s in (light * share, share))))
    *images, total, solid = (np.concatenate(part) for part in zip(*parts, strict=True))
    energy = weights @ total
    by_hits, shown = (
        np.tensordot(weights, image, 1) / np.where(energy > 0, energy, 1.0)[:, None, None] for image in images
    )
    differs = math.nan if by_rays else float(np.abs(shown - by_hits).sum() / 2 / len(weights))
    return Spread(shown, centre, shown.sum((1, 2)), weights @ solid, by_rays, differs)


def stretched(images: Array, moves: Array) -> Array:
    """Return images [N, side, side] stretched about their middle.

    At an offset from it they have what the given images have at `moves` [2, 2] times that offset.
    """
    middle = np.full(2, (images.shape[-1] - 1) / 2)
    return np.maximum([affine_transform(image, moves, middle - moves @ middle) for image in images], 0)


def irradiance(pupil: ExitPupil, x_mm: Array, y_mm: Array, field: Field) -> Array:
    """Return the irradiance [Y, X] at places from the pupil's centre, for 1 at the lens, by its `cells_of`.

    Places lie evenly on lines.
    """
    return irradiances([pupil], x_mm[None], y_mm[None], field[None])[0].astype(np.float64)


def irradiances(pupils: Sequence[ExitPupil], x_mm: Array, y_mm: Array, fields: Field) -> NDArray[np.float32]:
    """Return what `irradiance` does, [W, Y, X], for pupils with places [W, X], [W, Y] and fields [W, *cells]."""
    wave, half = np.array([p.wavelength_nm * 1e-6 for p in pupils]), np.array([p.half for p in pupils])
    x, y = (size[:, None] * place for size, place in zip((half / wave[:, None]).T, (x_mm, y_mm), strict=True))
    found = _transformed(_transformed(fields, x).swapaxes(1, 2), y)
    scale = ((2 * half).prod(1) / math.prod(fields.shape[1:]) / wave) ** 2
    return np.asarray((found.real**2 + found.imag**2) * scale.astype(np.float32)[:, None, None])


def _transformed(fields: Field, cycles: Array) -> Field:
    """Return sums [W, X, N] of fields [W, cells, N] times waves that have so many cycles [W, X] on half the cells.

    Places and cells lie evenly about their middles, so that cosines and sines of a quarter of them serve all: times the
    parts of the fields that are even and odd about the middle.
    """
    count, places = fields.shape[1] // 2, cycles.shape[1]
    middle, line = cycles[:, [0, -1]].mean(1, keepdims=True), middles(2 * count)[count:]
    high, low = fields[:, count:], fields[:, :count][:, ::-1]
    turn = phasor(middle * line)[..., None]
    high, low = high * turn, low * turn.conj()
    turn = phasor((cycles - middle)[:, places // 2 :, None] * line)
    even = (turn.real.copy() @ np.add(high, low, order="C").view(np.float32)).view(np.complex64)
    odd = (turn.imag.copy() @ np.subtract(high, low, order="C").view(np.float32)).view(np.complex64) * np.complex64(1j)
    return np.concatenate([(even - odd)[:, ::-1][:, : places // 2], even + odd], 1)


def waves_of(pupils: Sequence[ExitPupil], cells: tuple[int, ...]) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return the wavefronts in waves and the light per area of cosines (mm^2) in cells, [W, *cells]."""
    figures = np.array([p.figures[..., :2] for p in pupils]).transpose(3, 0, 1, 2)
    figures[0] *= np.array([1e6 / p.wavelength_nm for p in pupils])[:, None, None]
    # Sums of waves have at most some 100 waves, of which float32 leaves 1e-5.
    cycles, light = summed(figures.astype(np.float32), tuple(map(middles, cells)))
    return cycles, np.maximum(light, 0)


def cells_of(pupil: ExitPupil, cells: tuple[int, ...]) -> Field:
    """Return the field [*cells] of the pupil's cells, each times its weight (`open_shares`)."""
    return open_shares([pupil], cells)[1][0] * pupil.field(tuple(map(middles, cells)))


def perfect_peak(pupil: ExitPupil, field: Field) -> float:
    """Return the irradiance in the middle of the image that the same pupil has without aberrations."""
    even, middle = pupil.perfect(), np.zeros(1)
    return float(irradiance(even, middle, middle, cells_of(even, field.shape))[0, 0])


def middles(cells: int) -> Array:
    """Return the middles of cells along a side of the pupil's box, between -1 and 1."""
    return (np.arange(cells) + 0.5) * 2 / cells - 1


def by_pixel(pupils: Sequence[ExitPupil], x_mm: Array, y_mm: Array, pixel_mm: float, fields: Field) -> Array:
    """Return the light [W, Y, X] on square pixels about places, as in `irradiances`, for 1 at the lens, in mm^2."""
    # The square of a field is as fine as lambda over the width of the pupil; two samples of that in each pixel.
    parts = max(math.ceil(4e6 * float(p.half.max()) * pixel_mm / p.wavelength_nm) for p in pupils)
    across, down = (_means(p.shape[1], parts) for p in (x_mm, y_mm))
    x, y = (
        p[:, [0, -1]].mean(1, keepdims=True) + (np.arange(n) - (n - 1) / 2) * pixel_mm / parts
        for p, n in ((x_mm, across.shape[1]), (y_mm, down.shape[1]))
    )
    return np.asarray(down @ irradiances(pupils, x, y, fields) @ across.T * pixel_mm**2, np.float64)


@lru_cache(maxsize=16)
def _means(count: int, parts: int) -> NDArray[np.float32]:
    """Return what samples weigh [count, N] in the means over pixels of so many parts; one more lies on either side."""
    every, pixels = count * parts, np.kron(np.eye(count), np.full(parts, 1 / parts))
    # Over a sample's width the mean is f + f'' / 24.
    means = sum(np.eye(every, every + 2, k) * share / 24 for k, share in enumerate((1, 22, 1)))
    return np.asarray(pixels @ means, np.float32)


def _by_rays(
    pupils: Sequence[ExitPupil], x_mm: Array, y_mm: Array, pixel_mm: float, light: Array, rays: int
) -> Array:  # fmt: skip
    """Return the light [W, Y, X] that rays bring to pixels, from that of cells [W, *cells], which are joined to `rays`.

    What meets the film from a cell fills a rectangle, of which each pixel has its share.
    """
    count, columns, rows = len(pupils), x_mm.shape[1], y_mm.shape[1]
    joined = [max(k for k in (1, 2, 4) if k == 1 or n // k >= rays) for n in light.shape[1:]]
    for axis, k in enumerate(joined, 1):
        light = np.add.reduce([light.take(range(n, light.shape[axis], k), axis) for n in range(k)])
    ends = summed(slopes(pupils).astype(np.float32), tuple(np.linspace(-1, 1, n + 1) for n in light.shape[1:]))
    ends = (ends - np.array([x_mm[:, 0], y_mm[:, 0]], np.float32).T[..., None, None]) / pixel_mm + 0.5
    # Integers hold no place that is kilometres aside, where the series of a pupil may end beyond its edges.
    ends = ends.clip(-1, np.array([columns, rows], np.float32)[:, None, None] + 0.5)
    one, other = (f(ends[:, :, :-1], ends[:, :, 1:]) for f in (np.minimum, np.maximum))
    low, high = np.minimum(one[..., :-1], one[..., 1:]), np.maximum(other[..., :-1], other[..., 1:])
    first = np.floor(low)
    # The share of the next pixel: cells are less than a pixel wide.
    after = ((high - first - 1) / np.maximum(high - low, 1e-6)).clip(0, 1)
    column, row = first.astype(np.intp).swapaxes(0, 1) + 1
    place = ((np.arange(count)[:, None, None] * (rows + 3) + row) * (columns + 3) + column).reshape(-1)
    found, (x, y) = np.zeros(count * (rows + 3) * (columns + 3)), after.swapaxes(0, 1)
    for step, share in ((0, (1 - x) * (1 - y)), (1, x * (1 - y)), (columns + 3, (1 - x) * y), (columns + 4, x * y)):
        found += np.bincount(place + step, (light * share).reshape(-1), len(found))
    return found.reshape(count, rows + 3, columns + 3)[:, 1 : rows + 1, 1 : columns + 1]
