"""A lensfun profile: distortion as poly5 or ptlens, colour as poly3, light as pa, by focal length and aperture.

lensfun's formulae (lensfun.github.io/manual/latest/group__Lens.html), with r = 1 at half the short side of a film of
the profile's aspect ratio and the picture's diagonal, counted between the centres of the outer pixels: the lens's
picture shows at r (1 + k1 r^2 + k2 r^4), or a r^4 + b r^3 + c r^2 + (1 - a - b - c) r, what the corrected one shows at
r, and red at v r + c r^2 + b r^3 what the mean colour shows at r; light is 1 + k1 r^2 + k2 r^4 + k3 r^6, r = 1 in the
corner. What poly5 corrects is of the lens's pinhole. The form of ptlens fixes another scale, by which it is of a
pinhole of another focal length; and lensfun 0.3.4 computes it in fours of pixels, of which three are wrong by up to
`ROUNDED_PX`. So ptlens is taken where it is better by more.

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
ROUNDED_PX = 0.15  # of ptlens by lensfun
MOST_FRAMES = 9  # of an animation that a profile has
_ROUNDS = 30  # of Lawson's weights


class Entry(NamedTuple):
    """The profile of a lens at one focal length.

    Attributes:
        focal_mm, distance_m: of the pinhole, of what is in focus.
        model: of distortion: numbers by name. scale: by which the corrected picture is larger than the pinhole's.
        red, blue: v, c, b. light: (f-number, k1, k2, k3) by aperture.
        distortion_px, colour_px, light_share: the worst that the formulae leave.
    """

    focal_mm: float
    distance_m: float
    model: str
    distortion: dict[str, float]
    scale: float
    red: tuple[float, float, float]
    blue: tuple[float, float, float]
    light: tuple[tuple[float, float, float, float], ...]
    distortion_px: float
    colour_px: float
    light_share: float

    @property
    def corrected_mm(self) -> float:
        """Focal length of the pinhole that the corrected picture is of."""
        return self.focal_mm * self.scale


def entry_of(
    field: Field,
    camera: Any,
    focus_m: float,
    picture: tuple[int, int],
    film_mm: tuple[float, float],
    red_blue_nm: tuple[float, float],
    at_stop: Callable[[float | None], Any],
    model: str | None = None,
) -> Entry:
    """The entry of one state of a round lens.

    Args:
        at_stop: makes its camera at another f-number, None for the widest.
        model: of distortion, found where it is None.
    """
    pixel = film_mm[0] / picture[0]
    aspect = max(film_mm) / min(film_mm)
    corner = math.hypot(picture[0] - 1, picture[1] - 1) / 2 * pixel
    unit = corner / math.hypot(1, aspect)
    shown = film_radii(field, film_mm, 257)
    place = field.ideal(shown + 0j).real
    fits = {
        "poly5": _minimax(place / unit, shown / unit, (1, 3, 5), fixed=1.0),
        "ptlens": _minimax(place / unit, shown / unit, (1, 2, 3, 4), fixed=1.0),
    }
    left = {name: worst * unit / pixel + (name == "ptlens") * ROUNDED_PX for name, (_, worst) in fits.items()}
    model = model or min(left, key=lambda name: left[name])
    curve, scale = fits[model][0][1:], 1.0
    if model == "ptlens":
        curve, scale = _ptlens(curve)
    distortion = dict(zip(("k1", "k2") if model == "poly5" else ("a", "b", "c"), curve, strict=True))
    colours, worst = [], 0.0
    for nm in red_blue_nm:
        spectrum = spectrum_of(camera, only_nm=nm)
        traced = traced_light(camera, shown + 0j, spectrum, field.frame, field.target, focus_m)
        mean = field.picture(traced.place).real  # where the mean colour shows what this one shows
        (v, c, b), missed = _minimax(mean / unit, shown / unit, (1, 2, 3))
        worst = max(worst, missed * unit / pixel)
        colours.append((v, c, b))
    radius = np.concatenate([[0.0], film_radii(field, film_mm)])
    lights, share = _lights(field, camera, focus_m, radius, corner, at_stop)
    return Entry(
        field.frame.reach_mm[0], min(focus_m, FAR_M), model, distortion, scale, colours[0], colours[1], lights,
        left[model], worst, share,
    )  # fmt: skip


def _minimax(x: Array, y: Array, powers: Sequence[int], fixed: float | None = None) -> tuple[tuple[float, ...], float]:
    """Coefficients of a polynomial with the least worst distance from y, by Lawson's weights, and that distance.

    `fixed`: the first coefficient.
    """
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
        weight = weight * left + 1e-12
        weight /= weight.sum()
    return tuple(([] if fixed is None else [fixed]) + best.tolist()), least


def _ptlens(curve: tuple[float, ...]) -> tuple[tuple[float, ...], float]:
    """a, b, c of ptlens for r + A r^2 + B r^3 + C r^4, and the scale of its corrected picture over that of r.

    With r s in place of r the linear term is 1, too.
    """
    c, b, a = curve
    roots = np.roots([1, -1, -c, -b, -a])
    real = roots.real[np.abs(roots.imag) < 1e-9]
    s = float(real[np.abs(real - 1).argmin()])
    return (a / s**4, b / s**3, c / s**2), 1 / s


def _lights(
    field: Field,
    camera: Any,
    focus_m: float,
    radius: Array,
    corner: float,
    at_stop: Callable[[float | None], Any],
) -> tuple[tuple[tuple[float, float, float, float], ...], float]:
    """The light by aperture, the shot's own among them, and the worst share that the formula leaves.

    `radius`: mm, the axis first. `corner`: where r is 1.
    """
    own = float(camera.settings["lens_state"]["f_number"])
    cameras = {own: camera}
    for wanted in (None, *(f for k in STOPS if (f := float(f"{own * 2 ** (k / 2):.3g}")) < _SMALLEST)):
        made = at_stop(wanted)
        cameras.setdefault(round(float(made.settings["lens_state"]["f_number"]), 4), made)
    rows, worst = {}, 0.0
    for f_number, made in sorted(cameras.items()):
        light = traced_light(made, radius + 0j, field.spectrum, field.frame, field.target, focus_m).light
        k, left = falloff(light[1:] / light[0], radius[1:] / corner)
        rows[f"{f_number:.3g}"] = (f_number, *k)
        worst = max(worst, left)
    return tuple(rows.values()), worst
