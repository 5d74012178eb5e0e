"""A lens table held against a measured profile: distortion, lateral colour and light over image height.

What a profile leaves free is taken out: the scale of the picture (the central one, too: fits to photographs are loose
there), and the light on the axis. The distance of the photographs is not stated either: rays come from infinity.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline  # type: ignore[import-untyped]

from neurolens.analysis.bundles import bundle, points
from neurolens.analysis.field_curves import PROJECTIONS, RECTILINEAR
from neurolens.analysis.fields import Result, Scene
from neurolens.lens.paraxial import stop_radius_mm
from neurolens.lens.prescription import Lens
from neurolens.photographs.light import open_light
from neurolens.photographs.profiles import Light, Profile, Radial
from neurolens.setting.states import at_infinity, set_lens

Array = NDArray[np.float64]

_HEIGHTS, _FIELDS = 16, 26  # image heights that are compared, fields that are traced
_FEWEST = 4  # fields with chief rays
_INNER = 0.25  # share of half the diagonal from which shapes are compared
_OUTER_MM = 20.0  # of full frame, to which
_SIZES = np.linspace(0.97, 1.03, 13)  # of the picture, over that of crop factor and table
# Broad bands of a camera: those at which rays agree best with lensfun's lateral colour.
_BANDS_NM = {"red": (585.0, 600.0, 615.0), "green": (520.0, 540.0, 560.0), "blue": (465.0, 480.0, 495.0)}
IDEAL = {"equisolid": "equisolid, 2 f sin(theta/2)", "fisheye": "equidistant, f theta",
          "stereographic": "stereographic, 2 f tan(theta/2)", "orthographic": "orthographic, f sin"}  # fmt: skip
_STOP_SLACK = 1.03  # an aperture named in a profile counts as full where the lens's own is that near


@dataclass(frozen=True)
class Curve(Result):
    """One measured and one computed figure over image height; what the profile leaves free is taken out.

    Attributes:
        height_mm, measured, computed: [H], NaN beyond what either knows.
    """

    height_mm: Array
    measured: Array
    computed: Array

    @property
    def rms(self) -> float:
        """Root mean square of the difference; NaN where there is none."""
        off = self.measured - self.computed
        off = off[np.isfinite(off)]
        return float(np.sqrt(np.mean(off**2))) if len(off) else math.nan


@dataclass(frozen=True)
class Comparison(Result):
    """A lens, in one focal length, against one profile.

    Attributes:
        focal_mm: of the profile.
        distortion_percent: of the image height, mean removed. size: of the picture, for which it agrees best.
        red_um, blue_um: beside green.
        light_stops: by f-number, beside the axis.
    """

    focal_mm: float
    distortion_percent: Curve | None
    red_um: Curve | None
    blue_um: Curve | None
    light_stops: dict[float, Curve]
    size: float = 1.0


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


def stretch_of(lens: Lens, profile: Profile, height_mm: Array) -> Callable[[Array], Array]:
    """The image height over that of the profile's ideal projection, to a scale, as a function of image heights.

    It is NaN beyond the last height whose chief ray exists.
    """
    scene = Scene(lens)
    angle, real = _chief(scene, height_mm.max())
    ideal = PROJECTIONS[IDEAL.get(profile.projection, RECTILINEAR)](angle)
    return partial(_between, known_mm=real, values=real / ideal)


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
    if len(known_mm) < _FEWEST:
        return np.full_like(height_mm, math.nan)
    return np.asarray(CubicSpline(known_mm, values)(np.where(height_mm <= known_mm[-1], height_mm, math.nan)))


def _without_mean(values: Array, others: Array) -> Array:
    """Percent beside the mean over the heights at which both are known."""
    both = np.isfinite(values) & np.isfinite(others)
    return 100 * (values / values[both].mean() - 1) if both.any() else np.full_like(values, math.nan)


def distortion_curve(lens: Lens, profile: Profile, radial: Radial) -> tuple[Curve, float]:
    """The shape of the distortion, measured and computed, and the size of the picture for which both agree best.

    Crop factors are rounded, and a patent's example is seldom of the product's very focal length: heights are free by
    some percent.
    """
    height = heights_of(profile, lens)
    measured, known = profile.stretch(radial, height), stretch_of(lens, profile, height * max(_SIZES))
    found = []
    for size in _SIZES:
        ours = known(height * size)
        curve = Curve(height, _without_mean(measured, ours), _without_mean(ours, measured))
        found.append((-int(np.isfinite(ours).sum()), curve.rms, abs(size - 1), curve, float(size)))
    return min(found, key=lambda f: f[:3])[3:]


def shape_off(height_mm: Array, measured: Array, real_mm: Array, stretch: Array) -> Array:
    """The difference of `distortion_curve`, percent, by the stretch at the image heights of chief rays.

    NaN at heights that no chief ray reaches, and everywhere where too few do.
    """
    real_mm = np.where(np.isfinite(stretch), real_mm, math.nan)
    rising = int(np.argmin(np.diff(real_mm, append=-math.inf) > 0)) + 1
    if not real_mm[0] > 0:
        return np.full_like(height_mm, math.nan)
    ours = _between(np.outer(height_mm, _SIZES), real_mm[:rising], stretch[:rising])
    theirs = np.where(np.isfinite(ours), measured[:, None], math.nan)
    ours = np.where(np.isfinite(theirs), ours, math.nan)
    most = np.isfinite(ours).sum(axis=0)
    if most.max() < _FEWEST:
        return np.full_like(height_mm, math.nan)
    ours, theirs = (v[:, most == most.max()] for v in (ours, theirs))
    off = 100 * (theirs / np.nanmean(theirs, axis=0) - ours / np.nanmean(ours, axis=0))
    return np.asarray(off[:, np.argmin(np.nansum(off**2, axis=0))])


def colour_curves(lens: Lens, profile: Profile, radials: Mapping[str, Radial | None]) -> dict[str, Curve | None]:
    """How much farther from the axis red and blue lie than green, in um, over broad bands as a camera's."""
    height, scene = heights_of(profile, lens), Scene(lens)
    angle, _ = _chief(scene, float(height.max()))
    waves = [nm for band in _BANDS_NM.values() for nm in band]
    chief = bundle(scene.open, np.degrees(angle).tolist(), waves, points([0.0], [0.0]))
    beside = 1000 * chief.tangential_mm[..., 0].numpy()
    red, green, blue = (part.mean(axis=1) for part in np.split(beside, len(_BANDS_NM), axis=1))
    real = chief.chief_height_mm.numpy()
    found: dict[str, Curve | None] = {}
    for band, ours in (("red", red - green), ("blue", blue - green)):
        radial = radials[band]
        found[band] = radial and Curve(height, profile.shift_um(radial, height), _between(height, real, ours))
    return found


def stop_for(lens: Lens, f_number: float) -> float:
    """The radius of the stop at an f-number of a profile; that of the file where it is the lens's widest."""
    if f_number <= _STOP_SLACK * lens.f_number:
        return lens.stop_radius_mm
    return float(stop_radius_mm(at_infinity(lens), f_number))


def near_f8(f_numbers: Iterable[float]) -> float:
    """The aperture nearest to f/8, at which hardly any rim of a lens is seen."""
    return min(f_numbers, key=lambda f: abs(math.log(f / 8)))


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

    radial, red, blue = row(profile.distortion), row(profile.red), row(profile.blue)
    distortion, size = (None, 1.0) if radial is None else distortion_curve(placed, profile, radial)
    colours = colour_curves(placed, profile, {"red": red, "blue": blue}) if red or blue else {}
    light = light_curves(placed, profile, profile.light_at(focal_mm)) if profile.light else {}
    return Comparison(focal_mm, distortion, colours.get("red"), colours.get("blue"), light, size)
