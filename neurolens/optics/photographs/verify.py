"""The verdict of photographs on a lens file: which profile, what differs over image height, and what that means.

What a profile leaves free is taken out: the scale of the picture (also that in the centre, where fits to photographs
are loose) and the light on the axis. The distance of the photographs is not stated either, and rays come from infinity.
"""

import math
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np
from scipy.interpolate import CubicSpline  # type: ignore[import-untyped]

from neurolens.base.errors import InputError
from neurolens.base.report import Report, over, some_of
from neurolens.optics.analysis.field_curves import PROJECTIONS, RECTILINEAR
from neurolens.optics.analysis.fields import Scene
from neurolens.optics.analysis.plots import FIELD_COLOURS, INK, drawing
from neurolens.optics.lens.paraxial import first_order
from neurolens.optics.lens.prescription import Lens
from neurolens.optics.photographs.profiles import Light, Match, Profile, Radial, matches, name_of, profile_named
from neurolens.optics.photographs.rims import Array, at_focal_length, near_f8, open_light, stop_for
from neurolens.optics.setting.pupils import image_radius_mm
from neurolens.optics.setting.states import at_infinity

# Residuals of the shape of distortion (percent) that half and nine tenths of sound tables keep, and with them those of
# light (stops, root mean square over heights): see experiments/results/photographs.md.
SOUND_PERCENT, DOUBTFUL_PERCENT = 0.1, 0.3
SOUND_STOPS = 0.15
_OTHER_FOCAL = 0.06  # a profile whose focal length differs by more, relatively, is another lens's
# Broad bands of a camera: those at which rays agree best with lensfun's lateral colour.
_BANDS_NM = {"red": (585.0, 600.0, 615.0), "green": (520.0, 540.0, 560.0), "blue": (465.0, 480.0, 495.0)}
_HEIGHTS, _FEWEST = 16, 4  # image heights that are compared; the fewest chief rays of a curve
_INNER = 0.25  # of half the diagonal: where the comparison of shapes begins
_OUTER_MM = 20.0  # in full frame: where it ends
_RAYS, _NEAR_RAD = 25, 1e-4  # chief rays of a lens; the angle in the stop of one that is as good as paraxial
# how much steeper than for the greatest height slopes in the stop may get; the steepest of all
_FARTHER, _STEEPEST = 1.4, 2.0
_SIZES = np.linspace(0.97, 1.03, 13)  # sizes of the picture that are tried, relative to crop factor and table
_IDEAL = {"equisolid": "equisolid, 2 f sin(theta/2)", "fisheye": "equidistant, f theta",
          "stereographic": "stereographic, 2 f tan(theta/2)", "orthographic": "orthographic, f sin"}  # fmt: skip
FREE = "free in a profile, and taken out: the scale, the light on the axis; unknown: the distance of the photographs"


@dataclass(frozen=True)
class Curve(Report):
    """One figure over image height, measured and computed; what the profile leaves free is taken out.

    Attributes:
        height_mm, measured, computed: [H]; NaN where one of both is not known.
    """

    height_mm: Array
    measured: Array = field(metadata=over("height_mm"))
    computed: Array = field(metadata=over("height_mm"))

    @property
    def rms(self) -> float:
        """The root mean square of the difference; NaN where there is none."""
        off = self.measured - self.computed
        off = off[np.isfinite(off)]
        return float(np.sqrt(np.mean(off**2))) if len(off) else math.nan

    @property
    def worst(self) -> float:
        """The largest difference."""
        return float(np.nanmax(np.abs(self.measured - self.computed)))


@dataclass(frozen=True)
class Comparison(Report):
    """A lens, at one focal length, beside one profile.

    Attributes:
        focal_mm: the profile's.
        distortion_percent: of the image height, with the mean removed.
        size: of the picture, with which distortions agree best.
        red_um, blue_um: distance from green.
        light_stops: by f-number, relative to the axis.
    """

    focal_mm: float
    distortion_percent: Curve | None
    red_um: Curve | None
    blue_um: Curve | None
    light_stops: dict[float, Curve] = field(metadata=over("f_number"))
    size: float = 1.0


def heights_of(profile: Profile, lens: Lens) -> Array:
    """Return image heights at which shapes are compared: on the profile's film and, if its file tells, the lens's."""
    half = profile.half_diagonal_mm
    told = lens.image_radius_mm is not None or lens.half_field_deg is not None
    end = min(_OUTER_MM / profile.crop, image_radius_mm(lens)[0] if told else math.inf)
    return np.linspace(_INNER * half, max(end, 1.01 * _INNER * half), _HEIGHTS)


def ideal_heights(profile: Profile, angle: Array) -> Array:
    """Return the heights, to a scale, of a profile's ideal picture at field angles in rad."""
    return PROJECTIONS[_IDEAL.get(profile.projection, RECTILINEAR)](angle)


def chief_angles(lens: Lens, height_mm: float, wavelengths_nm: Sequence[float]) -> tuple[Array, Array]:
    """Return field angles [R] (rad) and, by wavelength, image heights [W, R] of chief rays.

    The lens's film is placed. Rays rise to beyond `height_mm` where there are such rays.

    Raises:
        InputError: the lens has ideal surfaces.
    """
    lens.require_glass("verify")
    scene = Scene(lens)
    reach = float(scene.chief_rays_at([_NEAR_RAD]).height_mm[0]) / _NEAR_RAD
    steepest = min(_FARTHER * height_mm / abs(reach), _STEEPEST)
    stop = np.arctan(steepest * np.linspace(0.02, 1, _RAYS))
    found = [scene.chief_rays_at(stop, nm) for nm in wavelengths_nm]
    each = [(np.where(c.exists, c.field_rad, math.nan), c.height_mm.numpy()) for c in found]
    count = min(_rising(values) for both in each for values in both)
    if count < _FEWEST:
        return np.zeros(0), np.zeros((len(each), 0))
    angle = each[0][0][:count]
    return angle, np.array([CubicSpline(field[:count], height[:count])(angle) for field, height in each])


def _rising(height_mm: Array) -> int:
    """Return how many heights of chief rays rise from the axis on."""
    return int(np.argmin(np.diff(height_mm, append=-math.inf) > 0)) + 1 if height_mm[0] > 0 else 0


def between(height_mm: Array, known_mm: Array, values: Array) -> Array:
    """Interpolate values at heights, while the known heights rise; NaN beyond these, and where too few are known."""
    count = _rising(known_mm) if len(known_mm) else 0
    if count < _FEWEST:
        return np.full_like(height_mm, math.nan)
    known = np.where(height_mm <= known_mm[count - 1], height_mm, math.nan)
    return np.asarray(CubicSpline(known_mm[:count], values[:count])(known))


def shapes(height_mm: Array, measured: Array, real_mm: Array, stretch: Array) -> tuple[Array, Array, float]:
    """Return measured and computed shapes of the distortion, and the size of the picture with which they agree best.

    Shapes are percent relative to the mean of the heights at which both exist; NaN where no chief ray reaches. Crop
    factors are rounded, and a patent's example seldom has the product's very focal length, so the scale of heights is
    free within some percent.

    Args:
        measured: [H] the measured image height over that of the ideal picture, to a scale.
        real_mm, stretch: [R] image heights of chief rays, and the same ratio for these.
    """
    real_mm = np.where(np.isfinite(stretch), real_mm, math.nan)
    count = _rising(real_mm) if len(real_mm) else 0
    ours = between(np.outer(height_mm, _SIZES), real_mm[:count], stretch[:count])
    theirs = np.where(np.isfinite(ours), measured[:, None], math.nan)
    ours = np.where(np.isfinite(theirs), ours, math.nan)
    most = np.isfinite(ours).sum(axis=0)
    if most.max() < _FEWEST:
        return np.full_like(height_mm, math.nan), np.full_like(height_mm, math.nan), 1.0
    theirs, ours = (100 * (v / np.nanmean(v, axis=0) - 1) for v in (theirs, ours))
    off = np.nansum((theirs - ours) ** 2, axis=0) + np.where(most == most.max(), 1e-12 * np.abs(_SIZES - 1), math.inf)
    best = int(np.argmin(off))
    return theirs[:, best], ours[:, best], float(_SIZES[best])


def distortion_curve(lens: Lens, profile: Profile, radial: Radial) -> tuple[Curve, float]:
    """Return the shape of the distortion, measured and computed, and the picture's size with which they agree best."""
    height = heights_of(profile, lens)
    angle, (real,) = chief_angles(lens, float(height.max()), [lens.reference_nm])
    theirs, ours, size = shapes(height, profile.stretch(radial, height), real, real / ideal_heights(profile, angle))
    return Curve(height, theirs, ours), size


def colour_curves(lens: Lens, profile: Profile, radials: Mapping[str, Radial | None]) -> dict[str, Curve | None]:
    """Return how much farther from the axis red and blue lie than green (um), in broad bands as a camera's are."""
    height = heights_of(profile, lens)
    _, real = chief_angles(lens, float(height.max()), [nm for band in _BANDS_NM.values() for nm in band])
    red, green, blue = (np.mean(part, axis=0) for part in np.split(real, len(_BANDS_NM)))
    found: dict[str, Curve | None] = {}
    for band, ours in (("red", red - green), ("blue", blue - green)):
        radial = radials[band]
        found[band] = radial and Curve(height, profile.shift_um(radial, height), between(height, green, 1000 * ours))
    return found


def light_curves(lens: Lens, profile: Profile, lights: Sequence[Light]) -> dict[float, Curve]:
    """Return the light over image height by f-number, in stops relative to the axis."""
    height, stop = heights_of(profile, lens), lens.stop_index
    rims = np.array(lens.semi_diameters_mm)
    opened = open_light(lens, np.concatenate([[0.0], height]), rims)
    past_rims = np.min([opened.inside(k, radius) for k, radius in enumerate(rims) if k != stop], axis=0)
    curves = {}
    for row in lights:
        inside = np.minimum(past_rims, opened.inside(stop, stop_for(lens, row.f_number)))
        with np.errstate(divide="ignore", invalid="ignore"):
            sums = (inside * opened.light).sum(axis=(1, 2))
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
    light = light_curves(placed, profile, lights) if (lights := profile.light_at(focal_mm)) else {}
    return Comparison(focal_mm, distortion, colours.get("red"), colours.get("blue"), light, size)


@dataclass(frozen=True)
class Verified(Report):
    """A lens beside a profile.

    Attributes:
        profile: lensfun's name with the maker. certainty: of the match, in a word. also: other likely profiles.
        crop: that of the profile's camera.
        comparisons: by focal length of the profile.
        uncertainty_percent: of the profile's own distortion, by several cameras; NaN where one was measured.
        verdict: sentences.
    """

    profile: str
    certainty: str
    also: tuple[str, ...]
    crop: float
    comparisons: tuple[Comparison, ...]
    uncertainty_percent: float
    verdict: tuple[str, ...]

    @property
    def distortion_percent(self) -> float:
        """The median residual over focal lengths; NaN where distortion was not measured."""
        return _median(c.distortion_percent.rms for c in self.comparisons if c.distortion_percent is not None)

    def light_stops(self, *, widest: bool) -> float:
        """The median residual of light over focal lengths, at the widest aperture or at the one nearest to f/8."""
        each = []
        for c in (c for c in self.comparisons if c.light_stops):
            f_number = min(c.light_stops) if widest else near_f8(c.light_stops)
            each.append(c.light_stops[f_number].rms)
        return _median(each)

    def told(self, figure: str, unit: str) -> str:
        """Say in words the residual of "distortion", or of "light" at the widest aperture: its median and its worst.

        The median is over focal lengths. The worst is the largest RMS for distortion, and the largest value for light.
        """
        known = self.curves(figure)
        middle = f"median RMS {median(c.rms for _, c in known):.2g}"
        if figure == "distortion":
            focal, curve = max(known, key=lambda pair: pair[1].rms)
            return f"{middle}, worst {curve.rms:.2g}{unit} at {focal:g} mm"
        focal, curve = max(known, key=lambda pair: pair[1].worst)
        return f"{middle}, worst {curve.worst:.2g}{unit} at {focal:g} mm"

    def curves(self, figure: str) -> list[tuple[float, Curve]]:
        """Return focal lengths with their curves of that figure, where they are known."""
        if figure == "distortion":
            each = [(c.focal_mm, c.distortion_percent) for c in self.comparisons]
        else:
            each = [(c.focal_mm, c.light_stops[min(c.light_stops)]) for c in self.comparisons if c.light_stops]
        return [(mm, curve) for mm, curve in each if curve is not None and math.isfinite(curve.rms)]

    @property
    def measured(self) -> dict[str, str | float]:
        """The figures that a lens file and the cards of its models keep of the comparison."""
        figures = {
            "distortion_percent": self.distortion_percent,
            "light_widest_stops": self.light_stops(widest=True),
            "light_f8_stops": self.light_stops(widest=False),
        }
        kept = {key: round(value, 4) for key, value in figures.items() if math.isfinite(value)}
        return {"profile": self.profile, "match": self.certainty, **kept}


def _median(values: Iterable[float]) -> float:
    known = [v for v in values if math.isfinite(v)]
    return median(known) if known else math.nan


def names_of(lens: Lens) -> list[str]:
    """Return the names under which a lens is looked for.

    They are what it is believed to be, its own name, that of its file, and what stands in brackets in its own, as in
    "US 8,169,718 Example 4 (Nikon ...)".
    """
    stem = Path(lens.path).stem.replace("_", " ")
    names = lens.believed_to_be, f"{lens.designer} {lens.name}".strip(), stem, *re.findall(r"\(([^()]+)\)", lens.name)
    return [name for name in names if name]


def found_for(lens: Lens, wanted: str | None = None) -> tuple[Match, list[Profile], tuple[str, ...]]:
    """Find the profile for a lens, all profiles of that name, and the names of other likely ones.

    Raises:
        InputError: a lens with cylinders has two distortions; there is no profile, none of the name that is wanted, or
            none at a focal length of the lens.
    """
    lens.require_centred("a profile")
    if lens.anamorphic:
        raise InputError(lens.path, "cylinder", "(an anamorphic lens)", "a lens that is symmetric about its axis")
    if wanted is not None:
        same = _by_film(profile_named(wanted), lens)
        _check_focal_length(lens, same[0])
        return Match(same[0], 1.0), same, ()
    found = [m for m in matches(names_of(lens)) if m.certainty != "uncertain"]
    if not found:
        known = [name for name in names_of(lens) if name_of(name)]
        expected = "a lens that lensfun measured, or --profile NAME"
        raise InputError(lens.path, "name", known[0] if known else lens.name, expected)
    best = found[0]
    same = [m.profile for m in found if (m.profile.maker, m.profile.model) == (best.profile.maker, best.profile.model)]
    also = dict.fromkeys(m.profile.model for m in found if m.likeness == best.likeness and m.profile not in same)
    same = _by_film(same, lens)
    _check_focal_length(lens, same[0])
    return best, same, tuple(also)


def _by_film(profiles: Sequence[Profile], lens: Lens) -> list[Profile]:
    """Sort profiles by use: those of the largest film that the lens lights first, then those with light."""
    several = len({p.crop for p in profiles}) > 1
    radius = 1.1 * (image_radius_mm(at_infinity(lens))[0] if several else math.inf)
    return sorted(profiles, key=lambda p: (p.half_diagonal_mm > radius, p.crop, not p.light))


def verify(lens: Lens, profile: str | None = None) -> Verified:
    """Compare a lens of a file with the profile that its name finds, at every focal length of the profile.

    Raises:
        InputError: as `found_for`; the lens reaches none of the profile's focal lengths.
    """
    match, profiles, also = found_for(lens, profile)
    used = profiles[0]
    whole, missed = [], dict[float, InputError]()
    for focal in used.focal_mm:
        try:
            whole.append(compare(lens, used, focal))
        except InputError as error:  # the zoom has no such position between its states
            missed[focal] = error
    if not whole:
        raise next(iter(missed.values()))
    name = used.model if used.maker.split()[0].lower() in used.model.lower() else f"{used.maker} {used.model}"
    bare = Verified(name, match.certainty, also, used.crop, tuple(whole), _spread(profiles, lens), ())
    told = _said(bare, lens.rims == "photographs")
    if missed:
        told.append(f"not compared at {', '.join(f'{f:g}' for f in missed)} mm: {next(iter(missed.values()))}")
    return Verified(**{**vars(bare), "verdict": tuple(told)})


def _check_focal_length(lens: Lens, profile: Profile) -> None:
    """Raise InputError where no focal length of the profile is one of the lens."""
    efl = [
        float(first_order(at_infinity(lens)).efl_mm),
        *(c.efl_mm for c in lens.configurations if c.efl_mm and c.object_distance_mm is None),
    ]
    low, high = min(efl) * (1 - _OTHER_FOCAL), max(efl) * (1 + _OTHER_FOCAL)
    if not any(low <= focal <= high for focal in profile.focal_mm):
        expected = " or ".join(f"{focal:g} mm" for focal in profile.focal_mm[:4])
        raise InputError(lens.path, "efl_mm", f"{efl[0]:.4g}", f"{expected}, of lensfun's {profile.model}")


def _spread(profiles: Sequence[Profile], lens: Lens) -> float:
    """Return the RMS difference of distortion between the profiles of one lens, on the smaller film of two."""
    each = []
    first = profiles[0]
    for other in profiles[1:]:
        height = heights_of(max(first, other, key=lambda p: p.crop), lens)
        for a in first.distortion:
            for b in (b for b in other.distortion if b.focal_mm == a.focal_mm):
                ratio = first.stretch(a, height) / other.stretch(b, height)
                each.append(100 * float(np.nanstd(ratio)))
    return _median(each)


def _said(found: Verified, fitted: bool) -> list[str]:
    """Write the verdict in sentences; `fitted`: whether the rims are fitted to photographs already."""
    off, slack = found.distortion_percent, found.uncertainty_percent
    lines = []
    if math.isnan(off):
        lines.append("distortion was not measured")
    else:
        word = "contradict each other" if slack > DOUBTFUL_PERCENT else "differ"
        own = f" (two cameras {word} by {slack:.2g}%)" if math.isfinite(slack) else ""
        most = max(curve.rms for _, curve in found.curves("distortion"))
        sound = "agree" if most <= SOUND_PERCENT else "roughly agree" if off <= DOUBTFUL_PERCENT else "disagree"
        told = found.told("distortion", "% of the image height")
        lines.append(f"the figures {sound} with the photographs: distortion {told}{own}")
    lines.append(_said_of_light(found, fitted))
    if found.certainty != "certain":
        lines.append(f"the match of the names is only {found.certainty}")
    return lines


def _said_of_light(found: Verified, fitted: bool) -> str:
    closed, wide = found.light_stops(widest=False), found.light_stops(widest=True)
    if math.isnan(wide):
        return "light was not measured"
    if wide <= SOUND_STOPS:
        sound = "agree" if all(c.rms <= SOUND_STOPS for _, c in found.curves("light")) else "roughly agree"
        return f"the rims {sound} with the photographs: light wide open {found.told('light', ' stops')}"
    curves = [c.light_stops[min(c.light_stops)] for c in found.comparisons if c.light_stops]
    word = "darker" if _median(float(np.nanmean(c.measured - c.computed)) for c in curves) < 0 else "brighter"
    if closed > SOUND_STOPS:
        off = f"{found.told('light', ' stops')}; at f/8 by median RMS {closed:.2g}"
        return f"the real lens is {word} wide open, {off}: rims alone cannot explain that"
    cause = "more than rims can explain" if fitted else "its rims are others (see neurolens rims)"
    return f"the real lens is {word} wide open, {found.told('light', ' stops')}: {cause}"


_MOST = 6  # of apertures, or focal lengths, that are drawn


def plot_verified(found: Verified, path: Path, title: str) -> None:
    """Draw distortion, lateral colour and light over image height; of a zoom, some of its focal lengths."""
    head = f"points: photographs, lensfun's {found.profile} ({found.certainty}); lines: rays."
    subtitle = "\n".join((head, *found.verdict))
    with drawing(path, 9.8, 4.4, title, subtitle) as figure:
        left, middle, right = figure.subplots(1, 3)
        labels = "distortion less its mean, % of the height", "beside green, µm", "light beside the axis, stops"
        for axes, label in zip((left, middle, right), labels, strict=True):
            axes.grid(True)
            axes.set(xlabel="image height, mm", ylabel=label)
        bent = [(c.focal_mm, c.distortion_percent) for c in found.comparisons if c.distortion_percent is not None]
        for colour, (focal, curve) in zip(FIELD_COLOURS, some_of(bent, _MOST), strict=False):
            _both(left, curve, colour, f"{focal:g} mm")
        for name, colour in (("red", "#d55e00"), ("blue", "#0072b2")):
            curves = ((c.focal_mm, getattr(c, f"{name}_um")) for c in found.comparisons)
            fringes = [(focal, curve) for focal, curve in curves if curve is not None]
            for focal, curve in fringes[:1]:
                _both(middle, curve, colour, f"{name}, {focal:g} mm")
        lit = [c for c in found.comparisons if c.light_stops]
        if lit:
            for colour, f_number in zip(FIELD_COLOURS, some_of(sorted(lit[0].light_stops), _MOST), strict=False):
                _both(right, lit[0].light_stops[f_number], colour, f"f/{f_number:g}")
            right.set_title(f"{lit[0].focal_mm:g} mm", loc="right", fontsize=9, color=INK)
        for axes in (left, middle, right):
            if axes.lines:
                axes.legend()
            else:
                axes.text(0.5, 0.5, "not measured", ha="center", transform=axes.transAxes, color=INK)


def _both(axes: Any, curve: Curve, colour: str, label: str) -> None:
    axes.plot(curve.height_mm, curve.computed, color=colour, label=label)
    axes.plot(curve.height_mm, curve.measured, "o", color=colour, markersize=3.5)
