"""The character of a lens in five numbers, wide open, and a small picture of its bokeh.

Discs are those of lights at infinity while the lens is focused at 30 focal lengths: on the axis, at 0.6 and at 0.95 of
the field. Vignetting follows the rims: where the file's are derived or estimated, cat's eye and swirl are, too.
"""

from __future__ import annotations

import io
import math
from contextlib import suppress
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from neurolens.analysis.bundles import Filled
from neurolens.analysis.fields import Array, Result, Scene
from neurolens.analysis.spots import spots
from neurolens.base.errors import NeurolensError
from neurolens.flare.ghosts import GhostTracer, ghost_table
from neurolens.flare.lights import Light
from neurolens.lens.prescription import Lens
from neurolens.setting.states import set_lens

FOCUS, FIELDS = 30, (0.0, 0.6, 0.95)  # focal lengths; shares of the field's edge
_LEVEL = 3  # of the pupil's nodes: some 12,000 rays a disc
_POWER = 4  # of the squared distance from the centre that tells the rim's light
_HALF_DIAGONAL_MM = 21.6  # of a picture of 36 x 24 mm, to which spots are scaled
_RAYS = 2000  # of a ghost
_SIDE, _DISC = 32, 0.92  # pixels of a disc's picture; share of the side that the widest disc takes,
_WIDEST = 1.5  # which counts as no more than so many times that on the axis


@dataclass(frozen=True)
class Character(Result):
    """What a lens is known for; NaN where a figure cannot be had.

    Attributes:
        cats_eye: area of the disc of a light far out of focus at 0.95 of the field over that on the axis: 1 where no
            rim cuts it.
        swirl: how much narrower that disc is along the picture's radius than across it, compared with the axis: 1 less
            the ratio of the standard deviations of its light; 0 for a round one.
        bubble: light near the rim of the disc on the axis behind the focus over that of an even disc, where light
            counts by the eighth power of its distance from the centre: 1 if even, up to 5 for a bright rim alone.
        softness_um: RMS radius of a white point on the axis at the best focus, on a picture 43.2 mm across its corners.
        flare: light of all ghosts of two reflections on the film's plane over that of the image, of a light at half
            the field; glass without a coating in the file is bare.
    """

    cats_eye: float
    swirl: float
    bubble: float
    softness_um: float
    flare: float


@dataclass(frozen=True)
class Discs:
    """Rays of F fields, tangential and sagittal [F, 2, P] from their centre: places on the film, and slopes there.

    `weight` [F, P] is their energy, 0 on the outline, too; `passed` tells whether they reach the film.
    """

    place_mm: Array
    slope: Array
    weight: Array
    passed: NDArray[np.bool_]


def character(lens: Lens) -> tuple[Character, Discs]:
    """The character of a lens, as its file has it, and its discs.

    Raises:
        InputError: a lens that forms no image or passes no light.
    """
    scene = Scene(set_lens(lens, focus_m=math.inf, focus_mode="best"))
    scene.require_power()
    edge = scene.edge.field_deg
    discs = discs_of(lens, [share * edge for share in FIELDS])
    softness = float(spots(scene, [0.0], rings=1, shift_mm=[0.0]).rms_um[0]) * _HALF_DIAGONAL_MM / scene.image_radius_mm
    flare = math.nan
    with suppress(NeurolensError):  # a lens whose ghosts cannot be traced has the other figures
        ghosts = ghost_table(GhostTracer(scene.lens), Light(0.0, edge / 2), scene.lens.reference_nm, _RAYS)
        flare = sum(ghost.energy for ghost in ghosts) or math.nan
    flare = flare if flare < math.inf else math.nan  # no ray of that light was found
    return Character(cats_eye(discs), swirl(discs), bubble(discs), softness, flare), discs


def character_or_none(lens: Lens) -> tuple[dict[str, float | None] | None, bytes | None]:
    """The figures of `character` with four digits, None for NaN, and the `picture`; None twice where there are none."""
    try:
        found, discs = character(lens)
    except NeurolensError:
        return None, None
    figures = {k: None if math.isnan(v) else float(f"{v:.4g}") for k, v in found.to_dict().items()}
    return figures, picture(discs)


def discs_of(lens: Lens, field_deg: list[float]) -> Discs:
    """Discs of lights at infinity in these fields, the axis first."""
    near = 1e-3 * FOCUS * abs(float(Scene(lens).first_order.efl_mm))
    scene = Scene(set_lens(lens, focus_m=near, focus_mode="best"))
    rays = Filled(scene, field_deg, scene.waves_nm[:1]).bundle(_LEVEL)
    weight = rays.weight[:, 0].numpy()
    both = (rays.tangential_mm, rays.sagittal_mm), rays.slopes
    place, slope = (np.nan_to_num(np.stack([c[:, 0].numpy() for c in pair], 1)) for pair in both)
    return Discs(place - _mean(place, weight), slope - _mean(slope, weight), weight, rays.passed[:, 0].numpy())


def _mean(values: Array, weight: Array) -> Array:
    """The mean [F, 2, 1] of values; NaN where there is no light."""
    with np.errstate(invalid="ignore"):
        return np.asarray((weight[:, None] * values).sum(2, keepdims=True) / weight.sum(1)[:, None, None])


def cats_eye(discs: Discs) -> float:
    """See `Character`. The disc of a light far out of focus has the shape of the rays' slopes."""
    areas = []
    for slope, outline in zip(discs.slope, discs.passed & (discs.weight == 0), strict=True):
        x, y = slope[:, outline]
        x, y = (c[np.argsort(np.arctan2(y, x))] for c in (x, y))
        areas.append(float(x @ np.roll(y, -1) - y @ np.roll(x, -1)) / 2)
    return areas[-1] / areas[0] if areas[0] > 0 and areas[-1] > 0 else math.nan


def swirl(discs: Discs) -> float:
    """See `Character`."""
    radial, across = np.sqrt(_mean(discs.slope**2, discs.weight))[..., 0].T
    return float(1 - radial[-1] / across[-1] / (radial[0] / across[0]))


def bubble(discs: Discs) -> float:
    """See `Character`."""
    weight, r2 = discs.weight[0], np.where(discs.passed[0], (discs.place_mm[0] ** 2).sum(0), 0.0)
    share = r2 / r2.max()
    return float((_POWER + 1) * (weight * share**_POWER).sum() / weight.sum())


def picture(discs: Discs) -> bytes:
    """The discs side by side as a grey PNG of 96 by 32 pixels, the film's radius upwards; wide ones are cut."""
    from PIL import Image

    radii = np.where(discs.passed, np.sqrt((discs.place_mm**2).sum(1)), 0.0).max(1)
    scale = _DISC * _SIDE / 2 / min(radii.max(), _WIDEST * radii[0])
    grey = np.zeros((len(radii), _SIDE, _SIDE))
    for disc, place, weight in zip(grey, discs.place_mm, discs.weight, strict=True):
        down, right = np.clip(_SIDE / 2 - 0.5 + scale * np.stack([-place[0], place[1]]), -2, _SIDE + 1)
        for row, column in ((0, 0), (0, 1), (1, 0), (1, 1)):  # a ray's light goes to the four pixels about it
            y, x = np.floor(down).astype(int) + row, np.floor(right).astype(int) + column
            part = (1 - np.abs(y - down)) * (1 - np.abs(x - right)) * weight
            seen = (part > 0) & (np.minimum(y, x) >= 0) & (np.maximum(y, x) < _SIDE)
            np.add.at(disc, (y[seen], x[seen]), part[seen])
    even = discs.weight[0].sum() / (math.pi * (scale * radii[0]) ** 2)
    shade = 255 * np.clip(np.hstack(list(grey)) / (2 * even), 0, 1) ** (1 / 2.2)
    buffer = io.BytesIO()
    Image.fromarray(np.round(shade).astype(np.uint8)).save(buffer, "png", optimize=True)
    return buffer.getvalue()
