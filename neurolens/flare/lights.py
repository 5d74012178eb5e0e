"""The lights of flare: points and extended lights, over frames, in lists, and the rays that they send into the lens.

Rays go through a disc across the light's direction that holds the whole front surface, at the points of a
low-discrepancy sequence that is the same every time: an animated light has no noise of its own.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from neurolens.base.errors import InputError
from neurolens.base.files import read_rows
from neurolens.base.tomlfile import reject_unknown
from neurolens.lens.prescription import Lens
from neurolens.trace.shapes import sag_mm

Floats = NDArray[np.float32]
_PLASTIC = 1.32471795724474602596  # of the R2 sequence (Roberts 2018): x^3 = x + 1

SUN = math.pi  # irradiance by which the sun lights a white card across its way to radiance 1
MOST_LIGHTS = 10_000  # of a list, and of --most
# Columns of a list of lights: the default (NaN: none), least and most.
_COLUMNS: dict[str, tuple[float, float, float]] = {
    "frame": (0.0, -1e7, 1e7),
    "azimuth_deg": (math.nan, -360.0, 360.0),
    "elevation_deg": (math.nan, -90.0, 90.0),
    "r": (SUN, 0.0, 1e30),
    "g": (SUN, 0.0, 1e30),
    "b": (SUN, 0.0, 1e30),
    "diameter_deg": (0.0, 0.0, 90.0),
    "distance_m": (math.inf, 1e-6, math.inf),
    "visible": (1.0, 0.0, 1.0),
}
CELLS = 8  # along each side of an extended light
FADE = 8  # parts of a cell's side where patches of a light fade into each other


class Shape(NamedTuple):
    """The extent of a light that is not a point: `CELLS` x `CELLS` cells, and how much of its light each has.

    Attributes:
        corners: [CELLS + 1, CELLS + 1, 3] directions (lens frame) of the cells' corners.
        weights: [CELLS, CELLS] at least 0, of any sum.
        round: whether the light is the whole ellipse that fits into the cells.
    """

    corners: NDArray[np.float64]
    weights: NDArray[np.float64]
    round: bool


@dataclass(frozen=True)
class Light:
    """A light far away, or at a distance: a point, or one that has a shape.

    Attributes:
        azimuth_deg: to the right of the axis, seen by the camera; elevation_deg: above it.
        rgb: linear sRGB irradiance that it makes at the front vertex across its way: radiance times solid angle in sr.
        distance_m: from the front vertex; inf allowed.
        shape: of an extended light, whose middle the angles are; None for a point.

    Raises:
        InputError: angles that do not come from the front (the light lies behind the lens), a distance that is not
            positive, an irradiance that is negative.
    """

    azimuth_deg: float
    elevation_deg: float
    rgb: tuple[float, float, float] = (1.0, 1.0, 1.0)
    distance_m: float = math.inf
    shape: Shape | None = field(default=None, compare=False, repr=False)

    def __post_init__(self) -> None:
        if not (abs(self.elevation_deg) < 90 and math.isfinite(self.azimuth_deg) and self.towards[2] < 0):
            angles = (self.azimuth_deg, self.elevation_deg)
            raise InputError("light", "azimuth, elevation", angles, "angles within 90 degrees of the axis")
        if not self.distance_m > 0:
            raise InputError("light", "distance_m", self.distance_m, "a positive distance in metres, or inf")
        if not all(0 <= v < math.inf for v in self.rgb):
            raise InputError("light", "rgb", self.rgb, "three finite numbers of at least 0")

    @property
    def towards(self) -> NDArray[np.float64]:
        """Unit vector from the lens to the light, lens frame."""
        a, e = math.radians(self.azimuth_deg), math.radians(self.elevation_deg)
        return np.array([math.sin(a) * math.cos(e), math.sin(e), -math.cos(a) * math.cos(e)])

    @property
    def about(self) -> dict[str, Any]:
        """Its attributes for metadata; the shape is its size in degrees along both sides."""
        size = None if self.shape is None else np.degrees(_lengths(self.shape.corners)).round(4).tolist()
        return asdict(replace(self, shape=None)) | {"shape": size}


def light_towards(
    towards: NDArray[np.floating[Any]], rgb: Sequence[float], distance_m: float = math.inf, shape: Shape | None = None
) -> Light | None:
    """The light in a direction [3] of any length; None where that does not lie before the lens."""
    x, y, z = towards / np.linalg.norm(towards)
    r, g, b = (max(float(v), 0.0) for v in rgb)
    azimuth, elevation = math.degrees(math.atan2(x, -z)), math.degrees(math.asin(max(-1.0, min(1.0, y))))
    return Light(azimuth, elevation, (r, g, b), distance_m, shape) if z < -1e-6 else None


def flat_shape(towards: NDArray[np.floating[Any]], sides: NDArray[np.floating[Any]], round_: bool = False) -> Shape:
    """The parallelogram of two sides [2, 3] about a direction [3], or the ellipse in it, all of equal radiance."""
    at = np.linspace(-0.5, 0.5, CELLS + 1)
    corners = towards + at[:, None, None] * sides[0] + at[:, None] * sides[1]
    middle = (np.arange(CELLS) + 0.5) / CELLS - 0.5
    inside = middle[:, None] ** 2 + middle**2 < 0.25 if round_ else np.ones((CELLS, CELLS))
    return Shape(corners, inside.astype(np.float64), round_)


def with_disc(light: Light, diameter_deg: float) -> Light:
    """A light as a round disc of this diameter about its direction."""
    ahead, size = light.towards, 2 * math.tan(math.radians(diameter_deg) / 2)
    return replace(light, shape=flat_shape(ahead, size * sides_across(ahead), True)) if diameter_deg > 0 else light


class Patch(NamedTuple):
    """A part of a light, so small that its ghosts and star are those of its middle, smeared.

    Attributes:
        light: the point in its middle, with all of its light.
        sides: [2, 3], of the parallelogram of directions about it. weights: [N, M] light of its cells.
        round: whether it is the ellipse in the parallelogram.
    """

    light: Light
    sides: NDArray[np.float64]
    weights: NDArray[np.float64]
    round: bool


def patches(light: Light, most_deg: float, most: int = CELLS // 2) -> list[Patch]:
    """A light in patches of about so many degrees a side.

    Each patch fades smoothly into its neighbours, so that no seam is seen where their ghosts do not quite meet.

    Args:
        most: patches along a side, at most; `CELLS` makes a patch of each cell.
    """
    if light.shape is None:
        return [Patch(light, np.zeros((2, 3)), np.ones((1, 1)), False)]
    corners, weights, is_round = light.shape
    counts = [min(math.ceil(math.degrees(side) / most_deg + 1e-9), most) for side in _lengths(corners)]
    if 1 < max(counts) and most != CELLS:
        weights = weights.repeat(FADE, 0).repeat(FADE, 1)
        at, nodes = np.linspace(0, CELLS, len(weights) + 1), np.arange(CELLS + 1)
        for axis in (0, 1):
            corners = np.apply_along_axis(lambda v: np.interp(at, nodes, v), axis, corners)
    middles = 0.25 * (corners[1:, 1:] + corners[:-1, 1:] + corners[1:, :-1] + corners[:-1, :-1])
    parts = []
    for along in _shares(counts[0], len(weights)):
        for across in _shares(counts[1], len(weights)):
            own = weights * np.outer(along, across)
            middle = np.einsum("ij,ijk", own, middles)
            rgb = np.array(light.rgb) * (own.sum() / weights.sum())
            if own.any() and (part := light_towards(middle, rgb.tolist(), light.distance_m)):
                (top, below), (left, right) = ((v.nonzero()[0][0], v.nonzero()[0][-1] + 1) for v in (along, across))
                a, b, c, d = corners[top, left], corners[top, right], corners[below, left], corners[below, right]
                sides = np.stack([c + d - a - b, b + d - a - c]) / 2
                parts.append(Patch(part, sides, own[top:below, left:right], is_round and counts == [1, 1]))
    return parts


def _shares(count: int, cells: int) -> NDArray[np.float64]:
    """The share [count, cells] of each cell along a side that each of so many patches has: their sum is 1."""
    at = (np.arange(cells) + 0.5) * count / cells - 0.5
    far = np.abs(at.clip(0, count - 1) - np.arange(count)[:, None]).clip(0, 1)
    return 0.5 + 0.5 * np.cos(math.pi * far)


def _lengths(corners: NDArray[np.float64]) -> tuple[float, float]:
    """Lengths in radians of the middles of a shape's two kinds of sides."""
    half = CELLS // 2
    along, across = corners[-1, half] - corners[0, half], corners[half, -1] - corners[half, 0]
    return float(np.linalg.norm(along)), float(np.linalg.norm(across))


@dataclass(frozen=True)
class Track:
    """A light over frames.

    Attributes:
        name: of the light. keys: [K, 9] frame, azimuth and elevation in degrees, r, g, b, diameter in degrees,
            1 / distance in 1/m, share that shows; linear between keys, constant before the first and after the last.
    """

    name: str
    keys: NDArray[np.float64]

    def at(self, frame: float) -> Light | None:
        """The light at a frame; None while it stands behind the lens."""
        azimuth, elevation, r, g, b, diameter, near, shown = (
            float(np.interp(frame, self.keys[:, 0], c)) for c in self.keys.T[1:]
        )
        if math.cos(math.radians(azimuth)) <= 1e-6 or abs(elevation) >= 90:
            return None
        rgb = shown * r, shown * g, shown * b
        return with_disc(Light(azimuth, elevation, rgb, 1 / near if near else math.inf), diameter)


def read_lights(path: Path) -> list[Track]:
    """The lights of a list: CSV with a header, or JSON, a list of objects.

    Columns or keys are azimuth_deg, elevation_deg and, with their defaults, light (a name; without it each row is a
    light), frame (rows of one light are its keys, frames increasing), r, g, b (irradiance, `SUN`), distance_m (inf),
    diameter_deg (of a round light, 0; the sun has 0.53) and visible (the share of it that shows, 1).

    Raises:
        InputError: a column is unknown or missing, or a value is out of range, by file, row and column; no light, or
            more than `MOST_LIGHTS`.
    """
    rows, lights = read_rows(path, "a list of lights"), dict[str, list[list[float]]]()
    if not rows:
        raise InputError(path, "lights", "(none)", "at least one light")
    for number, row in enumerate(rows):
        place = f"row {number + 1}, "
        reject_unknown(path, place, row, ["light", *_COLUMNS])
        frame, *values, distance, shown = (_value(path, place, name, row.get(name)) for name in _COLUMNS)
        keys = lights.setdefault(str(row.get("light") or f"light {number + 1}"), [])
        if len(lights) > MOST_LIGHTS:
            raise InputError(path, "lights", f"(more than {MOST_LIGHTS})", f"at most {MOST_LIGHTS} lights in a list")
        if keys and not frame > keys[-1][0]:
            raise InputError(path, f"{place}frame", frame, f"a frame after {keys[-1][0]:g}, the light's key before")
        keys.append([frame, *values, 1 / distance, shown])
    return [Track(name, np.array(keys)) for name, keys in lights.items()]


def _value(path: Path, place: str, name: str, given: Any) -> float:
    default, least, most = _COLUMNS[name]
    if given in (None, "") and not math.isnan(default):
        return default
    try:
        value = math.nan if isinstance(given, bool) else float(given)
    except (TypeError, ValueError, OverflowError):
        value = math.nan
    if not least <= value <= most:
        raise InputError(path, f"{place}{name}", given, f"a number from {least:g} to {most:g}")
    return value


def light_rays(
    lens: Lens, light: Light, first: int, count: int, shift: float = 0.0, jitter: float = 0.0
) -> tuple[Floats, float]:
    """Rays of a light from number `first` on, [6, count] in the lens frame, and the area in mm^2 that all N rays share.

    Each of N rays carries the irradiance at the lens times area / N. The rays of a light far away are uniform across
    its direction, those of a near light in solid angle. An extended light divides its rays among points, one in each of
    its cells, by their light; `shift` moves the points.

    Args:
        shift: of the sequence, another for each wavelength. jitter: see `disc`.
    """
    if light.shape is None:
        return rays_across(lens, light, disc(first, count, shift, jitter))
    parts, rays, areas = patches(light, 1e-9, CELLS), list[Floats](), list[float]()
    shares = np.cumsum([sum(part.light.rgb) for part in parts])
    ends = np.rint(shares * (count / max(float(shares[-1]), 1e-300))).astype(int).tolist()
    for part, begin, end in zip(parts, [0, *ends], ends, strict=False):
        inside = np.array([shift % 1, shift / _PLASTIC % 1]) - 0.5
        point = light_towards(part.light.towards + inside @ part.sides, part.light.rgb, light.distance_m)
        some, area = rays_across(lens, point or part.light, disc(first + begin, end - begin, shift, jitter))
        rays.append(some)
        areas.append(area * (end - begin) / count)
    return np.concatenate(rays, 1), sum(areas)


def front_sphere(lens: Lens) -> tuple[NDArray[np.float64], float]:
    """Centre [3] (lens frame) and radius in mm of a sphere that holds the front surface."""
    front = lens.surfaces[0]
    depth = float(sag_mm(front, front.semi_diameter_mm, 0.0))
    return np.array([0.0, 0.0, depth / 2]), math.hypot(front.semi_diameter_mm, depth / 2)


def sides_across(ahead: NDArray[np.float64]) -> NDArray[np.float64]:
    """Two unit vectors [2, 3] across a direction before the lens, which turn smoothly while the direction moves (Duff
    et al. 2017, for one hemisphere)."""
    x, y, z = ahead
    return np.array([[1 - x * x / (1 - z), -x * y / (1 - z), x], [x * y / (1 - z), y * y / (1 - z) - 1, -y]])


def rays_across(lens: Lens, light: Light, place: NDArray[np.floating[Any]]) -> tuple[Floats, float]:
    """Rays [6, N] of a light through points [2, N] of the unit disc, which stands across its direction, and the area of
    the whole disc in mm^2: equal shares of the disc carry equal light; see `light_rays`.

    Points may also lie in the corners of the square about the disc.
    """
    centre, radius = front_sphere(lens)
    ahead = light.towards
    across = sides_across(ahead).T @ place
    if math.isinf(light.distance_m):
        target = centre[:, None] + radius * across
        return np.concatenate([target, np.broadcast_to(-ahead[:, None], target.shape)]), math.pi * radius**2
    source = 1000 * light.distance_m * ahead
    far = float(np.linalg.norm(source - centre))
    if not 1.01 * radius < far < math.inf:
        raise InputError(
            "light", "distance_m", light.distance_m, f"one beyond {radius / 1000:.3g} m, outside the lens, or inf"
        )
    # Uniform in solid angle over the cone that holds the sphere about the front surface.
    solid = 1 - math.sqrt(1 - (radius / far) ** 2)
    off = across * np.sqrt(solid * (2 - solid * (across**2).sum(0)))
    towards = (centre - source) / far
    off -= towards[:, None] * (towards @ off)
    cos = 1 - solid * (across**2).sum(0)
    sine = np.sqrt(np.maximum(1 - cos**2, 0)) / np.maximum(np.linalg.norm(off, axis=0), 1e-300)
    direction = towards[:, None] * cos + off * sine
    area = 2 * math.pi * solid * (1000 * light.distance_m) ** 2  # the irradiance is that at the front vertex
    return np.concatenate([source[:, None] + direction * (far - radius), direction]), area


def disc(first: int, count: int, shift: float = 0.0, jitter: float = 0.0) -> NDArray[np.float64]:
    """Points [2, count] of equal shares of the unit disc: the R2 sequence from a number on, shifted.

    `jitter` moves each point by up to so much of the square's side, because regular points make patterns in a picture.
    """
    n = np.arange(first, first + count) + 1.0
    moved = jitter * np.random.default_rng([first, int(shift * 2**32)]).random((2, count))
    u, v = (n / _PLASTIC + shift + moved[0]) % 1, (n / _PLASTIC**2 + 0.5 * shift + moved[1]) % 1
    return np.sqrt(u) * np.stack([np.cos(2 * math.pi * v), np.sin(2 * math.pi * v)])
