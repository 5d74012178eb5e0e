"""A lensfun profile: distortion as poly5, lateral colour as poly3, light as pa, by focal length and aperture.

lensfun's formulae (lensfun.github.io/manual/latest/group__Lens.html), with r = 1 at half the short side of a film of
the profile's aspect ratio and the picture's diagonal, counted between the centres of the outer pixels: the lens's
picture shows at r (1 + k1 r^2 + k2 r^4) what the corrected one shows at r, and red at v r + c r^2 + b r^3 what the mean
colour shows at r; light is 1 + k1 r^2 + k2 r^4 + k3 r^6, r = 1 in the corner. The size of the corrected picture is
fitted, too, for a fifth to a thirtieth of the distance that is left: it is that of a pinhole of another focal length.
lensfun's ptlens has one coefficient more, but version 0.3.4 computes it in fours of pixels, three of them wrong by up
to 0.14 pixels. Of wide lenses more is left: by poly5 0.67 and 0.56 pixels of 3840 on 20 mm lenses by Canon and Nikon
(f/2.8); ptlens would leave 0.45, and a term r^7, as in ACM, which 0.3.4 has not, 0.43 and 0.28.

Focal lengths are those of the pinhole, so that they tell a focus pull, too, for lensfun knows no breathing.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from neurolens.cameras.contract import Camera
from neurolens.cameras.field import Array, Complex, Field, spectrum_of, traced_light
from neurolens.handover.shot import FAR_M, Handed, falloff, film_points

TYPES = {"equidistant": "fisheye"}  # other names are ours
MOST_FRAMES = 9  # of an animation that a profile has
_SMALLER = 2, 4  # stops from the shot's aperture to others; the widest is one, too
_SMALLEST = 23.0
_ROUNDS = 30  # of Lawson's weights

AtStop = Callable[[float | None], Camera]


class Entry(NamedTuple):
    """The profile of a lens at one focal length.

    Attributes:
        focal_mm, distance_m: of the pinhole, of the plane in place. corrected_mm: of lensfun's corrected picture.
        distortion: k1, k2. red, blue: v, c, b. light: f-number, k1, k2, k3 by aperture.
        distortion_px, colour_px, light_share: the worst that the formulae leave.
    """

    focal_mm: float
    distance_m: float
    corrected_mm: float
    distortion: tuple[float, float]
    red: tuple[float, ...]
    blue: tuple[float, ...]
    light: tuple[tuple[float, ...], ...]
    distortion_px: float
    colour_px: float
    light_share: float


def entry_of(
    field: Field, camera: Camera, plane_m: float, shot: Handed, red_blue_nm: tuple[float, float], at_stop: AtStop
) -> Entry:
    """The entry of one state of a round lens; `at_stop` makes its camera at another f-number, None for the widest."""
    picture, pixel = shot.plates.picture, shot.plates.pixel_mm[0]
    film_mm = shot.film_mm(picture)
    corner = math.hypot(picture[0] - 1, picture[1] - 1) / 2 * pixel
    unit = corner / math.hypot(1, max(film_mm) / min(film_mm))
    points = film_points(field, film_mm, 257)
    (size, a, b), left = _minimax(field.ideal(points).real / unit, points.real / unit, (1, 3, 5))
    colours = []
    for nm in red_blue_nm:
        light = traced_light(camera, points, spectrum_of(camera, only_nm=nm), field.frame, field.target, plane_m)
        # Where the mean colour shows what this one shows.
        colours.append(_minimax(field.picture(light.place).real / unit, points.real / unit, (1, 2, 3)))
    lights, share = _lights(field, camera, plane_m, points[3::4], corner, at_stop)
    focal, px = field.frame.reach_mm[0], unit / pixel
    return Entry(
        focal, min(plane_m, FAR_M), focal * size, (a / size**3, b / size**5), colours[0][0], colours[1][0], lights,
        left * px, max(missed for _, missed in colours) * px, share,
    )  # fmt: skip


def _minimax(x: Array, y: Array, powers: Sequence[int]) -> tuple[tuple[float, ...], float]:
    """Coefficients of a polynomial with the least worst distance from y, by Lawson's weights, and that distance."""
    rows, weight = np.stack([x**p for p in powers], 1), np.ones(x.size)
    best, least = tuple[float, ...](), math.inf
    for _ in range(_ROUNDS):
        root = np.sqrt(weight)
        found = np.linalg.lstsq(rows * root[:, None], y * root, rcond=None)[0]
        left = np.abs(rows @ found - y)
        if left.max() < least:
            best, least = tuple(found.tolist()), float(left.max())
        weight = weight * left + 1e-12
        weight = weight / weight.sum()
    return best, least


def _lights(
    field: Field, camera: Camera, plane_m: float, points: Complex, corner: float, at_stop: AtStop
) -> tuple[tuple[tuple[float, ...], ...], float]:
    """The light by aperture, the shot's own among them, and the worst share that the formula leaves."""
    own = float(camera.settings["lens_state"]["f_number"])
    further = [f for k in _SMALLER if (f := float(f"{own * 2 ** (k / 2):.3g}")) < _SMALLEST]
    rows, worst, points = {}, 0.0, np.append(0j, points)
    for made in (at_stop(None), *map(at_stop, further), camera):
        light = traced_light(made, points, field.spectrum, field.frame, field.target, plane_m).light
        k, left = falloff(light[1:] / light[0], points.real[1:] / corner)
        f_number = float(made.settings["lens_state"]["f_number"])
        rows[f"{f_number:.3g}"] = (f_number, *k)
        worst = max(worst, left)
    return tuple(sorted(rows.values())), worst
