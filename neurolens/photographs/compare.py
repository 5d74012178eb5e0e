"""A lens table held against a measured profile: distortion, lateral colour and light over image height.

What a profile leaves free is taken out: the scale of the picture (the central one, too: fits to photographs are loose
there), and the light on the axis. The distance of the photographs is not stated either: rays come from infinity.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from neurolens.analysis.field_curves import PROJECTIONS
from neurolens.analysis.fields import Result, Scene
from neurolens.lens.catalogue import nearest
from neurolens.lens.paraxial import stop_radius_mm
from neurolens.lens.prescription import Lens
from neurolens.photographs.light import open_light
from neurolens.photographs.profiles import Light, Profile, Radial
from neurolens.setting.states import at_infinity, set_lens

Array = NDArray[np.float64]

_HEIGHTS, _FIELDS = 16, 26  # image heights that are compared, fields that are traced
_INNER = 0.25  # share of half the diagonal from which shapes are compared
_OUTER_MM = 20.0  # of full frame, to which
_BANDS_NM = {
    "red": (590.0, 605.0, 620.0, 640.0),
    "green": (510.0, 530.0, 550.0, 570.0),
    "blue": (440.0, 455.0, 470.0, 490.0),
}
_IDEAL = {"equisolid": "equisolid, 2 f sin(theta/2)", "fisheye": "equidistant, f theta",
          "stereographic": "stereographic, 2 f tan(theta/2)", "orthographic": "orthographic, f sin"}  # fmt: skip
_NEAR_N_D, _NEAR_V_D = 0.002, 1.0  # within which a glass of the catalogue stands for two figures of a table
_STOP_SLACK = 1.03  # an aperture named in a profile counts as full where the lens's own is that near


@dataclass(frozen=True)
class Curve(Result):
    """One measured and one computed figure over image height; what the profile leaves free is taken out.

    Attributes:
        height_mm, measured, ours: [H], NaN beyond what either knows.
    """

    height_mm: Array
    measured: Array
    ours: Array

    @property
    def rms(self) -> float:
        """Root mean square of the difference; NaN where there is none."""
        off = self.measured - self.ours
        off = off[np.isfinite(off)]
        return float(np.sqrt(np.mean(off**2))) if len(off) else math.nan


@dataclass(frozen=True)
class Comparison(Result):
    """A lens, in one focal length, against one profile.

    Attributes:
        focal_mm: of the profile.
        distortion: percent of the image height, mean removed.
        red, blue: um of the image height beside green.
        light: by f-number, stops beside the axis.
    """

    focal_mm: float
    distortion: Curve | None
    red: Curve | None
    blue: Curve | None
    light: dict[float, Curve]


def heights_of(profile: Profile, lens: Lens) -> Array:
    """Image heights at which shapes are compared, within the profile's film and the lens's image circle."""
    half = profile.half_diagonal_mm
    end = min(_OUTER_MM / profile.crop, lens.image_radius_mm or math.inf)
    return np.linspace(_INNER * half, max(end, 1.01 * _INNER * half), _HEIGHTS)


def at_focal_length(lens: Lens, focal_mm: float) -> Lens:
    """The lens focused at infinity, a zoom at the focal length of a profile; its ends are rounded in names."""
    states = [c.efl_mm for c in lens.configurations if c.efl_mm and c.object_distance_mm is None]
    if len(states) > 1 and max(states) > 1.05 * min(states):
        low, high = min(states), max(states)
        return set_lens(lens, zoom=float(min(max(focal_mm, low), high)))
    return set_lens(lens)


def stretch_of(lens: Lens, profile: Profile, height_mm: Array) -> Array:
    """The image height over that of the profile's ideal projection, at image heights, to a scale."""
    scene = Scene(lens)
    angle, real = _chief(scene, height_mm.max())
    name = _IDEAL.get(profile.projection, next(iter(PROJECTIONS)))
    ideal = PROJECTIONS[name](angle)
    return _between(height_mm, real, real / ideal)


def _chief(scene: Scene, to_mm: float) -> tuple[Array, Array]:
    """Field angles in rad and the image heights of their chief rays, rising to beyond a height where there is one."""
    angle = math.atan(1.2 * to_mm / abs(scene.first_order.efl_mm))
    for edge in (angle, min(1.4 * angle, 1.8)):
        field = edge * np.linspace(0.02, 1, _FIELDS)
        height = scene.chief_rays(np.degrees(field)).height_mm.numpy()
        rising = int(np.argmin(np.diff(height, append=-math.inf) > 0)) + 1
        if height[rising - 1] >= to_mm:
            break
    return field[:rising], height[:rising]


def _between(height_mm: Array, known_mm: Array, values: Array) -> Array:
    """Values at heights between known ones; NaN beyond."""
    return np.asarray(CubicSpline(known_mm, values)(np.where(height_mm <= known_mm[-1], height_mm, math.nan)))


def _without_mean(values: Array, others: Array) -> Array:
    """Percent beside the mean over the heights at which both are known."""
    both = np.isfinite(values) & np.isfinite(others)
    return 100 * (values / values[both].mean() - 1) if both.any() else np.full_like(values, math.nan)


def distortion_curve(lens: Lens, profile: Profile, radial: Radial) -> Curve:
    """The shape of the distortion, measured and computed."""
    height = heights_of(profile, lens)
    measured, ours = profile.stretch(radial, height), stretch_of(lens, profile, height)
    return Curve(height, _without_mean(measured, ours), _without_mean(ours, measured))


def with_real_glasses(lens: Lens) -> Lens:
    """The lens with a glass of the catalogue where the table gives n_d and V_d of one.

    Two numbers leave the secondary spectrum open, on which the place of blue depends more than on anything else.
    """
    rows = [
        replace(s, glass=_glass_like(float(s.n_d), s.V_d)) if s.glass is None and s.V_d else s for s in lens.surfaces
    ]
    return replace(lens, surfaces=tuple(rows))


@cache
def _glass_like(n_d: float, V_d: float) -> str | None:
    found = nearest(n_d, V_d, 1)[0]
    near = abs(found.n_d - n_d) <= _NEAR_N_D and abs(found.V_d - V_d) <= _NEAR_V_D
    return str(found) if near else None


def colour_curve(lens: Lens, profile: Profile, radial: Radial, band: str) -> Curve:
    """How much farther from the axis a colour lies than green, in um, over broad bands as a camera's."""
    height, scene = heights_of(profile, lens), Scene(with_real_glasses(lens))
    angle, real = _chief(scene, float(height.max()))
    fields = np.degrees(angle)

    def mean(name: str) -> Array:
        return np.mean([scene.chief_rays(fields, nm).height_mm.numpy() for nm in _BANDS_NM[name]], axis=0)

    ours = _between(height, real, 1000 * (mean(band) - mean("green")))
    return Curve(height, profile.shift_um(radial, height), ours)


def stop_for(lens: Lens, f_number: float) -> float:
    """The radius of the stop at an f-number of a profile; that of the file where it is the lens's widest."""
    if f_number <= _STOP_SLACK * lens.f_number:
        return lens.stop_radius_mm
    return float(stop_radius_mm(at_infinity(lens), f_number))


def light_curves(lens: Lens, profile: Profile, lights: Sequence[Light]) -> dict[float, Curve]:
    """The light over image height by f-number, in stops beside the axis."""
    height = heights_of(profile, lens)
    rims = np.array(lens.semi_diameters_mm)
    found = open_light(lens, np.concatenate([[0.0], height]), rims)
    curves = {}
    for row in lights:
        rims[lens.stop_index] = stop_for(lens, row.f_number)
        with np.errstate(divide="ignore", invalid="ignore"):
            sums = found.at(rims)
            ours = np.log2(sums[1:] / sums[0])
        ours[~np.isfinite(ours)] = math.nan
        curves[row.f_number] = Curve(height, profile.stops(row, height), ours)
    return curves


def compare(lens: Lens, profile: Profile, focal_mm: float) -> Comparison:
    """Compare a lens with a profile at one of the profile's focal lengths."""
    placed = at_focal_length(lens, focal_mm)

    def row(rows: Sequence[Radial]) -> Radial | None:
        return next((r for r in rows if r.focal_mm == focal_mm), None)

    distortion, red, blue = row(profile.distortion), row(profile.red), row(profile.blue)
    return Comparison(
        focal_mm,
        None if distortion is None else distortion_curve(placed, profile, distortion),
        None if red is None else colour_curve(placed, profile, red, "red"),
        None if blue is None else colour_curve(placed, profile, blue, "blue"),
        light_curves(placed, profile, profile.light_at(focal_mm)) if profile.light else {},
    )
