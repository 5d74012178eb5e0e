"""A lensfun profile: distortion as ptlens, lateral colour as poly3, light as pa, by focal length and aperture.

lensfun's formulae (lensfun.github.io/manual/latest/group__Lens.html): with r = 1 at half the short side, the lens's
picture shows at a r^4 + b r^3 + c r^2 + (1 - a - b - c) r what the corrected one shows at r, and red at v r + c r^2 +
b r^3 what the mean colour shows at r; light is 1 + k1 r^2 + k2 r^4 + k3 r^6, r = 1 in the corner. Pixels are counted
between the centres of the outer ones. The form of ptlens fixes the scale of the corrected picture: it is that of a
pinhole of another focal length, which is stated, and `scale` of lensfun's modifier takes it to the lens's own.

Focal lengths are those of the pinhole, so that they tell a focus pull, too, for lensfun knows no breathing.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

from neurolens.cameras.field import Field, spectrum_of, traced_light
from neurolens.handover.shot import FAR_M, Array, falloff, film_radii

# Of lenses, as lensfun has projections: circles of fisheyes are "fisheye" where they are equidistant.
TYPES = {"rectilinear": "rectilinear", "equidistant": "fisheye"} | {
    name: name for name in ("equisolid", "stereographic", "orthographic")
}
FULL_FRAME_MM = math.hypot(36, 24) / 2  # half the diagonal, of crop factor 1
STOPS = 2, 4  # by which the further apertures are smaller than the shot's; the widest is one, too
_SMALLEST = 23.0
MOST_FRAMES = 9  # of an animation that a profile has
_ROUNDS, _POWER = 30, 1.0  # of Lawson's weights, which lead to the least worst distance


class Entry(NamedTuple):
    """The profile of a lens at one focal length.

    Attributes:
        focal_mm, distance_m: of the pinhole, of what is in focus.
        distortion: a, b, c. scale: of the corrected picture for the pinhole's size.
        red, blue: v, c, b. light: (f-number, k1, k2, k3) by aperture.
        distortion_px, colour_px, light_share: the worst that the formulae leave.
    """

    focal_mm: float
    distance_m: float
    distortion: tuple[float, float, float]
    scale: float
    red: tuple[float, float, float]
    blue: tuple[float, float, float]
    light: tuple[tuple[float, float, float, float], ...]
    distortion_px: float
    colour_px: float
    light_share: float

    @property
    def corrected_mm(self) -> float:
        """Focal length of the pinhole that the corrected picture is of, at scale 1."""
        return self.focal_mm / self.scale


def entry_of(
    field: Field,
    camera: Any,
    focus_m: float,
    picture: tuple[int, int],
    film_mm: tuple[float, float],
    red_blue_nm: tuple[float, float],
    at_stop: Callable[[float | None], Any],
) -> Entry:
    """The entry of one state of a round lens; `at_stop` makes its camera at another f-number, None for the widest."""
    pixel = film_mm[0] / picture[0]
    unit = (min(picture) - 1) / 2 * pixel
    shown = film_radii(field, film_mm, 257)
    place = field.ideal(shown + 0j).real
    curve = _minimax(place / unit, shown / unit, (1, 2, 3, 4), fixed=1.0)
    distortion, scale = _ptlens(curve[1:])
    left = np.polynomial.polynomial.polyval(place / unit, [0, *curve]) - shown / unit
    colours, worst = [], 0.0
    for nm in red_blue_nm:
        spectrum = spectrum_of(camera, only_nm=nm)
        traced = traced_light(camera, shown + 0j, spectrum, field.frame, field.target, focus_m)
        mean = field.picture(traced.place).real  # where the mean colour shows what this one shows
        v, c, b = _minimax(mean / unit, shown / unit, (1, 2, 3))
        worst = max(worst, float(np.abs(mean * (v + mean / unit * (c + mean / unit * b)) - shown).max()))
        colours.append((v, c, b))
    lights, share = _lights(field, camera, focus_m, picture, pixel, at_stop)
    return Entry(
        field.frame.reach_mm[0], min(focus_m, FAR_M), distortion, scale, colours[0], colours[1], lights,
        float(np.abs(left).max()) * unit / pixel, worst / pixel, share,
    )  # fmt: skip


def _minimax(x: Array, y: Array, powers: Sequence[int], fixed: float | None = None) -> tuple[float, ...]:
    """Coefficients of a polynomial with the least worst distance from y, by Lawson's weights; `fixed`: the first."""
    rows = np.stack([x**p for p in powers], 1)
    start = 0 if fixed is None else 1
    goal = y if fixed is None else y - fixed * rows[:, 0]
    weight = np.ones_like(x)
    best, least = np.zeros(len(powers) - start), math.inf
    for _ in range(_ROUNDS):
        root = np.sqrt(weight)
        found = np.linalg.lstsq(rows[:, start:] * root[:, None], goal * root, rcond=None)[0]
        left = np.abs(rows[:, start:] @ found - goal)
        if left.max() < least:
            best, least = found, float(left.max())
        weight = weight * left**_POWER + 1e-12
        weight /= weight.sum()
    return tuple(([] if fixed is None else [fixed]) + best.tolist())


def _ptlens(curve: Sequence[float]) -> tuple[tuple[float, float, float], float]:
    """a, b, c and the scale s of ptlens for r + A r^2 + B r^3 + C r^4: with r s for r the linear term is 1, too."""
    c, b, a = curve
    roots = np.roots([1, -1, -c, -b, -a])
    real = roots.real[np.abs(roots.imag) < 1e-9]
    s = float(real[np.abs(real - 1).argmin()])
    return (a / s**4, b / s**3, c / s**2), s


def _lights(
    field: Field,
    camera: Any,
    focus_m: float,
    picture: tuple[int, int],
    pixel: float,
    at_stop: Callable[[float | None], Any],
) -> tuple[tuple[tuple[float, float, float, float], ...], float]:
    """The light by aperture, the shot's own among them, and the worst share that the formula leaves."""
    corner = math.hypot(picture[0] - 1, picture[1] - 1) / 2 * pixel
    radius = np.concatenate([[0.0], film_radii(field, (picture[0] * pixel, picture[1] * pixel))])
    own = float(camera.settings["lens_state"]["f_number"])
    cameras = {own: camera}
    for wanted in (None, *(f for k in STOPS if (f := float(f"{own * 2 ** (k / 2):.3g}")) < _SMALLEST)):
        made = at_stop(wanted)
        cameras.setdefault(round(float(made.settings["lens_state"]["f_number"]), 4), made)
    rows, worst = {}, 0.0
    for f_number, made in sorted(cameras.items()):
        light = traced_light(made, radius + 0j, field.spectrum, field.frame, field.target, focus_m).light
        k, left = falloff(light[1:] / light[0], radius[1:] / corner)
        rows[f"{f_number:.4g}"] = (f_number, *k)
        worst = max(worst, left)
    return tuple(rows.values()), worst
