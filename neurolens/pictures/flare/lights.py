"""The lights of flare and their rays: points and extended lights, over frames, from lists, scenes and pictures.

Rays go through a disc across the light's direction that covers the whole front surface, at the points of a
low-discrepancy sequence that is the same every time, so that an animated light has no noise of its own.

A scene's lights are its rectangles, discs, spheres, points, spots and the sun, as far as the lens's front vertex sees
them; a picture's are regions brighter than a threshold. The sky and other surroundings are no lights.
"""

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from neurolens.base.errors import InputError
from neurolens.base.files import read_rows
from neurolens.base.settings import unit_of
from neurolens.base.tomlfile import reject_unknown
from neurolens.base.units import as_float, in_unit
from neurolens.cameras.contract import FloatArray
from neurolens.cameras.field import Array, Field
from neurolens.optics.lens.prescription import Lens
from neurolens.optics.trace.shapes import sag_mm
from neurolens.pictures.flare.canvas import CELLS, FADE
from neurolens.pictures.render.colour import SpectralRange, balance
from neurolens.pictures.render.job import camera_axes
from neurolens.pictures.render.scene import Scene
from neurolens.pictures.render.scenetables import BRIGHTEST
from neurolens.pictures.render.world import World

_PLASTIC = 1.32471795724474602596  # ratio of the R2 sequence (Roberts 2018): x^3 = x + 1

SUN = math.pi  # irradiance by which the sun lights a white card across its way as radiance 1
MOST_LIGHTS = 10_000  # in a list, and for --most
_MOST = 10 * BRIGHTEST  # irradiance, above that of a hemisphere of a scene's brightest; float32 holds its pictures
# Columns of a list of lights: the default (NaN: none), the least and the largest value.
_COLUMNS: dict[str, tuple[float, float, float]] = {
    "frame": (0.0, -1e7, 1e7),
    "azimuth_deg": (math.nan, -360.0, 360.0),
    "elevation_deg": (math.nan, -90.0, 90.0),
    **dict.fromkeys("rgb", (SUN, 0.0, _MOST)),
    "diameter_deg": (0.0, 0.0, 90.0),
    "distance_m": (math.inf, 1e-6, math.inf),
    "visible": (1.0, 0.0, 1.0),
}
_CELL = 1 / 48  # of the picture's width: a larger highlight is cut into several lights
_FADES = 1.25  # lights fade below so many times the energy of the brightest light that is left out
_MOST_PIXELS, _AT_ONCE = 1 << 22, 1 << 18  # pixels above the threshold; pixels at a time, each of some 500 bytes
_DIMMEST = 0.02  # at less relative illumination a highlight's radiance is not known


class Shape(NamedTuple):
    """The extent of a light that is not a point: `CELLS` x `CELLS` cells, and how much of its light each cell has.

    Attributes:
        corners: [CELLS + 1, CELLS + 1, 3] directions (lens frame) of the corners of cells.
        weights: [CELLS, CELLS] at least 0, of any sum. round: whether the light fills just the ellipse in the cells.
    """

    corners: Array
    weights: Array
    round: bool


@dataclass(frozen=True)
class Light:
    """A light far away, or at a distance: a point, or one that has a shape.

    Attributes:
        azimuth_deg: to the right of the axis, seen by the camera. elevation_deg: above the axis.
        rgb: irradiance (linear sRGB) that it makes at the front vertex across its way: radiance times solid angle in
            sr.
        distance_m: from the front vertex; inf allowed. shape: that of an extended light; the angles are of its middle.

    Raises:
        InputError: the light lies behind the lens, the distance is not positive, or an irradiance is negative or
            beyond float32.
    """

    azimuth_deg: float
    elevation_deg: float
    rgb: tuple[float, float, float] = (1.0, 1.0, 1.0)
    distance_m: float = math.inf
    shape: Shape | None = field(default=None, compare=False, repr=False)

    def __post_init__(self) -> None:
        if not (abs(self.elevation_deg) < 90 and abs(self.azimuth_deg) < 90):
            angles = (self.azimuth_deg, self.elevation_deg)
            raise InputError("light", "azimuth, elevation", angles, "angles within 90 degrees of the axis")
        if not self.distance_m > 0:
            raise InputError("light", "distance_m", self.distance_m, "a positive distance in metres, or inf")
        if not all(0 <= v <= _MOST for v in self.rgb):
            raise InputError("light", "rgb", self.rgb, f"three numbers from 0 to {_MOST:g}")

    @property
    def towards(self) -> Array:
        """The unit vector from the lens to the light, lens frame."""
        a, e = math.radians(self.azimuth_deg), math.radians(self.elevation_deg)
        return np.array([math.sin(a) * math.cos(e), math.sin(e), -math.cos(a) * math.cos(e)])

    @property
    def about(self) -> dict[str, Any]:
        """Return its attributes for metadata; of the shape, the size in degrees along both sides."""
        size = None if self.shape is None else np.degrees(_lengths(self.shape.corners)).round(4).tolist()
        return asdict(replace(self, shape=None)) | {"shape": size}


def light_towards(
    towards: NDArray[np.floating[Any]], rgb: Sequence[float], distance_m: float = math.inf, shape: Shape | None = None
) -> Light | None:
    """Return the light in a direction [3] of any length; None where that does not lie before the lens."""
    x, y, z = towards / np.linalg.norm(towards)
    r, g, b = (max(float(v), 0.0) for v in rgb)
    azimuth, elevation = math.degrees(math.atan2(x, -z)), math.degrees(math.asin(max(-1.0, min(1.0, y))))
    return Light(azimuth, elevation, (r, g, b), distance_m, shape) if z < -1e-6 else None


def flat_shape(towards: NDArray[np.floating[Any]], sides: NDArray[np.floating[Any]], round_: bool = False) -> Shape:
    """Return a shape of even radiance about a direction [3]: a parallelogram of sides [2, 3] or the ellipse in it."""
    at = np.linspace(-0.5, 0.5, CELLS + 1)
    corners = towards + at[:, None, None] * sides[0] + at[:, None] * sides[1]
    return Shape(corners, _in_disc(CELLS) if round_ else np.ones((CELLS, CELLS)), round_)


def with_disc(light: Light, diameter_deg: float) -> Light:
    """Return a light as a round disc of this diameter about its direction."""
    ahead, size = light.towards, 2 * math.tan(math.radians(diameter_deg) / 2)
    return replace(light, shape=flat_shape(ahead, size * sides_across(ahead), True)) if diameter_deg > 0 else light


class Patch(NamedTuple):
    """A part of a light that is so small that its ghosts and star are those of its middle, smeared.

    Attributes:
        light: the point in its middle, with all of its light.
        sides: [2, 3] of the parallelogram of directions about it. weights: [N, M] light of its cells.
        round: whether only the ellipse in the parallelogram is lit.
    """

    light: Light
    sides: Array
    weights: Array
    round: bool


def patches(light: Light, most_deg: float, most: int = CELLS // 2) -> list[Patch]:
    """Cut a light into patches of about `most_deg` degrees a side.

    Each patch fades smoothly into its neighbours, so that no seam is seen where their ghosts do not quite meet.

    Args:
        most: the most patches along a side; `CELLS` makes a patch of each cell.
    """
    if light.shape is None:
        return [Patch(light, np.zeros((2, 3)), np.ones((1, 1)), False)]
    corners, weights, is_round = light.shape
    counts = [min(math.ceil(math.degrees(side) / most_deg + 1e-9), most) for side in _lengths(corners)]
    if 1 < max(counts) and most != CELLS:
        weights = _in_disc(FADE * CELLS) if is_round else weights.repeat(FADE, 0).repeat(FADE, 1)
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


def _in_disc(cells: int) -> Array:
    """Return the share of each cell [cells, cells] of a square that lies in its disc: whole cells would show steps."""
    at = (np.arange(4 * cells) + 0.5) / (4 * cells) - 0.5
    return np.asarray((at[:, None] ** 2 + at**2 < 0.25).reshape(cells, 4, cells, 4).mean((1, 3)))


def _shares(count: int, cells: int) -> Array:
    """Return the share [count, cells] that each of `count` patches along a side has of each cell; a cell's sum is 1."""
    at = (np.arange(cells) + 0.5) * count / cells - 0.5
    far = np.abs(at.clip(0, count - 1) - np.arange(count)[:, None]).clip(0, 1)
    return 0.5 + 0.5 * np.cos(math.pi * far)


def _lengths(corners: Array) -> tuple[float, float]:
    """Return the lengths in radians of a shape's two kinds of sides, along their middles."""
    along, across = (of[-1, CELLS // 2] - of[0, CELLS // 2] for of in (corners, corners.swapaxes(0, 1)))
    return float(np.linalg.norm(along)), float(np.linalg.norm(across))


@dataclass(frozen=True)
class Track:
    """A light over several frames.

    Attributes:
        name: the light's. keys: [K, 9] frame, azimuth and elevation in degrees, r, g, b, diameter in degrees, 1 /
            distance in 1/m, and the share that shows; linear between keys, constant before the first and after the
            last.
    """

    name: str
    keys: Array

    def at(self, frame: float) -> Light | None:
        """Return the light at a frame; None while it stands behind the lens."""
        azimuth, elevation, r, g, b, diameter, near, shown = (
            float(np.interp(frame, self.keys[:, 0], column)) for column in self.keys.T[1:]
        )
        if math.cos(math.radians(azimuth)) <= 1e-6 or abs(elevation) >= 90:
            return None
        rgb = shown * r, shown * g, shown * b
        return with_disc(Light(math.remainder(azimuth, 360), elevation, rgb, 1 / near if near else math.inf), diameter)


def read_lights(path: Path) -> list[Track]:
    """Read the lights of a list: CSV with a header, or JSON with a list of objects.

    Columns or keys are azimuth_deg, elevation_deg and, with their defaults, light (a name; without it each row is a
    light), frame (rows of one light are its keys, frames increasing), r, g, b (irradiance, `SUN`), distance_m (inf),
    diameter_deg (of a round light, 0; the sun has 0.53) and visible (the share of it that shows, 1).

    Raises:
        InputError: a column is unknown or missing, or a value is out of range (it names file, row and column); there is
            no light, or there are more than `MOST_LIGHTS`.
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
        value = math.nan if isinstance(given, bool) else as_float(in_unit(unit_of(name), str)(str(given)))
    except (TypeError, ValueError, OverflowError):
        value = math.nan
    if not least <= value <= most:
        raise InputError(path, f"{place}{name}", given, f"a number from {least:g} to {most:g}")
    return value


def light_rays(
    lens: Lens, light: Light, first: int, count: int, shift: float = 0.0, jitter: float = 0.0
) -> tuple[FloatArray, float]:
    """Return rays [6, count] of a light in the lens frame, and the area (mm^2) that all N rays together stand for.

    Each of N rays carries the irradiance at the lens times area / N. The rays of a light far away are uniform across
    its direction, those of a near light in solid angle. An extended light divides its rays among points, one in each of
    its cells, in proportion to their light.

    Args:
        first: number of the first ray in the sequence of all N.
        shift: shifts the sequence, and the points of an extended light, so that each wavelength has other rays.
        jitter: see `disc`.
    """
    if light.shape is None:
        return rays_across(lens, light, disc(first, count, shift, jitter))
    parts, rays, areas = patches(light, 1e-9, CELLS), list[FloatArray](), list[float]()
    shares = np.cumsum([sum(part.light.rgb) for part in parts])
    ends = np.rint(shares * (count / max(float(shares[-1]), 1e-300))).astype(int).tolist()
    for part, begin, end in zip(parts, [0, *ends], ends, strict=False):
        inside = np.array([shift % 1, shift / _PLASTIC % 1]) - 0.5
        point = light_towards(part.light.towards + inside @ part.sides, part.light.rgb, light.distance_m)
        some, area = rays_across(lens, point or part.light, disc(first + begin, end - begin, shift, jitter))
        rays.append(some)
        areas.append(area * (end - begin) / count)
    return np.concatenate(rays, 1), sum(areas)


def front_sphere(lens: Lens) -> tuple[Array, float]:
    """Return centre [3] (lens frame) and radius in mm of a sphere that holds the front surface."""
    front = lens.surfaces[0]
    depth = float(sag_mm(front, front.semi_diameter_mm, 0.0))
    return np.array([0.0, 0.0, depth / 2]), math.hypot(front.semi_diameter_mm, depth / 2)


def sides_across(ahead: Array) -> Array:
    """Return two unit vectors [2, 3] across a direction before the lens.

    They turn smoothly while the direction moves (Duff et al. 2017, for one hemisphere).
    """
    x, y, z = ahead
    return np.array([[1 - x * x / (1 - z), -x * y / (1 - z), x], [x * y / (1 - z), y * y / (1 - z) - 1, -y]])


def rays_across(lens: Lens, light: Light, place: NDArray[np.floating[Any]]) -> tuple[FloatArray, float]:
    """Return rays [6, N] of a light through points [2, N] of the unit disc, and the area in mm^2 of the whole disc.

    The disc stands across the light's direction. Equal shares of it carry equal light; see `light_rays`. Points may
    also lie in the corners of the square about the disc.
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
        expected = f"one beyond {radius / 1000:.3g} m, outside the lens, or inf"
        raise InputError("light", "distance_m", light.distance_m, expected)
    # Rays are uniform in solid angle over the cone that holds the sphere about the front surface.
    solid = 1 - math.sqrt(1 - (radius / far) ** 2)
    off = across * np.sqrt(solid * (2 - solid * (across**2).sum(0)))
    towards = (centre - source) / far
    off -= towards[:, None] * (towards @ off)
    cos = 1 - solid * (across**2).sum(0)
    sine = np.sqrt(np.maximum(1 - cos**2, 0)) / np.maximum(np.linalg.norm(off, axis=0), 1e-300)
    direction = towards[:, None] * cos + off * sine
    area = 2 * math.pi * solid * (1000 * light.distance_m) ** 2  # since the irradiance is that at the front vertex
    return np.concatenate([source[:, None] + direction * (far - radius), direction]), area


def disc(first: int, count: int, shift: float = 0.0, jitter: float = 0.0) -> Array:
    """Return points [2, count] of equal shares of the unit disc: the R2 sequence from number `first` on, shifted.

    `jitter` moves each point by up to this share of the square's side, because regular points make patterns in a
    picture.
    """
    n = np.arange(first, first + count) + 1.0
    moved = jitter * np.random.default_rng([first, int(shift * 2**32)]).random((2, count))
    u, v = (n / _PLASTIC + shift + moved[0]) % 1, (n / _PLASTIC**2 + 0.5 * shift + moved[1]) % 1
    return np.sqrt(u) * np.stack([np.cos(2 * math.pi * v), np.sin(2 * math.pi * v)])


class SceneLights:
    """The lights of a scene, as any camera in it sees them."""

    def __init__(self, scene: Scene) -> None:
        low, high = scene.settings.camera.wavelength_nm
        spectral = SpectralRange(low, high)
        self._world, self._spectral, every = World(scene, spectral), spectral, np.arange(spectral.bins)
        rows, palette = self._world.light_emission_row, self._world.palette
        each, self._colour = np.unique(rows, return_inverse=True)
        self._rgb = [spectral.film_rgb(palette.look_up(np.full_like(every, row), every)[0]) for row in each]

    def balance(self, illuminant: str | None) -> Array:
        """Return the matrix [3, 3] on linear sRGB that makes an illuminant neutral, as renders of the scene do."""
        if illuminant is None or not self._spectral.colours:
            return np.eye(3)
        return balance(self._spectral.film_rgb(self._world.palette.illuminant(illuminant)))

    def seen(self, scene: Scene, film_z_mm: float, most: int | None = None) -> list[Light]:
        """Return the lights before the lens of the camera of `scene`, which may stand anywhere in this scene.

        Args:
            film_z_mm: the lens's film; the front vertex lies as far before the film.
            most: how many lights to test, the strongest there if nothing hides them; None tests all.
        """
        pose = scene.settings.camera
        axes = camera_axes(pose).astype(np.float64)
        front = np.array(pose.position_m) - axes[:, 2] * film_z_mm / 1000
        middle, corner = ((2 * np.arange(CELLS + k) + 1 - k) / CELLS - 1 for k in (0, 1))
        place = np.concatenate([np.stack(np.meshgrid(a, a, indexing="ij")).reshape(2, -1) for a in (middle, corner)], 1)
        point = np.repeat(front[:, None], place.shape[1], 1).astype(np.float32)
        lights, own, found = self._world.lights, CELLS * CELLS, list[Light]()
        numbers = range(lights.count) if most is None else lights.strongest(tuple(front.tolist()), most)
        for number, (is_round, aimed) in zip(numbers, lights.each(numbers, point, place), strict=True):
            direction, distance, scale = (a[..., :own] for a in aimed)
            inside = (place[:, :own] ** 2).sum(0) < 1 if is_round else np.ones(own, bool)
            seen = np.where(inside & self._world.visible(point[:, :own], direction, distance), scale, 0).astype(float)
            shape = Shape(
                (axes.T @ aimed[0][:, own:]).T.reshape(CELLS + 1, CELLS + 1, 3), seen.reshape(CELLS, CELLS),
                is_round and bool(seen[inside].all()),
            )  # fmt: skip
            rgb = self._rgb[self._colour[number]] * (seen.sum() / inside.sum())
            if not rgb.any():
                continue
            mean = float(np.average(distance, weights=seen)) if np.isfinite(distance).all() else math.inf
            extended = np.ptp(shape.corners, axis=(0, 1)).any()  # a light without size is one direction
            towards = axes.T @ (direction @ seen)
            if light := light_towards(towards, rgb.tolist(), mean, shape if extended else None):
                found.append(light)
        return found


class KeptLights(NamedTuple):
    """The lights that are kept, brightest first, the number `of` all, and the share of the energy that is left out."""

    lights: list[Light]
    of: int
    dropped: float


def keep(lights: Sequence[Light], most: int, fade: bool = False) -> KeptLights:
    """Keep the lights of the most energy at the lens.

    Args:
        fade: whether lights fade as their energy nears that of the brightest light left out, so that over frames none
            comes or goes at once. Where all lights would be dark, none fades.
    """
    ordered = sorted(lights, key=lambda light: sum(light.rgb), reverse=True)
    kept = ordered[:most]
    cut = sum(ordered[most].rgb) if fade and len(ordered) > most else 0.0
    if 0 < cut < sum(ordered[0].rgb):
        shares = [min((sum(k.rgb) / cut - 1) / (_FADES - 1), 1.0) for k in kept]
        faded = ((k, s, *k.rgb) for k, s in zip(kept, shares, strict=True) if s > 0)
        kept = [replace(k, rgb=(s * r, s * g, s * b)) for k, s, r, g, b in faded]
    whole = sum(sum(k.rgb) for k in ordered)
    left = 1 - sum(sum(k.rgb) for k in kept) / max(whole, 1e-300) if len(kept) < len(ordered) else 0.0
    return KeptLights(kept, len(ordered), left)


def highlights(
    picture: FloatArray, field: Field, film_mm: tuple[float, float], threshold: float, most: int, fade: bool = False
) -> KeptLights:
    """Find the regions of a picture [H, W, 3] (linear; 1 is a white card of radiance 1) in which a colour is bright.

    A pixel is bright where one of its colours reaches the threshold. A region of connected pixels is a light far away
    with the region's radiance times solid angle; a large region is several lights. Radiance is the picture's value over
    the relative illumination. Pixels count in full from twice the threshold on, and less the nearer they are to it, so
    that over frames no light switches on at once.

    Args:
        field: that of the camera that took the picture. most, fade: as for `keep`.

    Raises:
        InputError: values are not finite; more than `_MOST_PIXELS` pixels reach the threshold.
    """
    if bad := int((~np.isfinite(picture)).any(-1).sum()):
        raise InputError("picture", "pixels", f"({bad} with NaN or infinity)", "finite values")
    height, width = picture.shape[:2]
    value = picture.max(-1)
    bright = value >= threshold
    if np.count_nonzero(bright) > _MOST_PIXELS:
        found = f"{threshold:g} ({np.count_nonzero(bright)} pixels)"
        raise InputError("picture", "threshold", found, f"one that at most {_MOST_PIXELS} pixels reach")
    row, column = np.nonzero(bright)
    region = _regions(bright, max(1, round(_CELL * width)))
    count = int(region.max(initial=-1)) + 1
    colour, moments = np.zeros((count, 3)), np.zeros((13, count))
    for start in range(0, row.size, _AT_ONCE):
        r, c, of = (a[start : start + _AT_ONCE] for a in (row, column, region))
        energy, towards, solid = _pixels(picture[r, c], r, c, field, film_mm, (height, width))
        energy *= np.minimum(value[r, c] / threshold - 1, 1)[:, None]
        squares = (towards[:, None] * towards).reshape(9, -1)
        each = (*energy.T, *(energy.sum(1) * t for t in (*towards, *squares, solid)))
        for sums, some in zip((*colour.T, *moments), each, strict=True):
            np.add.at(sums, of, some)  # in place: there may be as many regions as pixels
    middle, each = moments[:3], colour.sum(1)
    seen = np.flatnonzero((each > 0) & (middle[2] < -1e-6 * np.linalg.norm(middle, axis=0)))
    first = seen[np.argsort(-each[seen], kind="stable")][: most + 1]  # one more than are kept, to tell how lights fade
    shapes = [_spread_of(moments[:, k] / each[k]) for k in first]
    lights = [light_towards(middle[:, k], colour[k], shape=shape) for k, shape in zip(first, shapes, strict=True)]
    kept = keep([light for light in lights if light], most, fade).lights
    left = 1 - sum(sum(k.rgb) for k in kept) / float(each[seen].sum()) if len(seen) > most else 0.0
    return KeptLights(kept, len(seen), left)


def _spread_of(means: Array) -> Shape:
    """Return the parallelogram with a region's variances, from means [13] of directions, products and solid angles."""
    towards = means[:3] / np.linalg.norm(means[:3])
    across = sides_across(towards)
    variance = across @ (means[3:12].reshape(3, 3) - np.outer(means[:3], means[:3])) @ across.T
    pixel = means[12] / 12 * np.eye(2)  # a pixel's own variance is added to that of pixels' middles
    half = np.linalg.cholesky(variance + pixel)
    return flat_shape(towards, math.sqrt(12) * half.T @ across)


def _regions(bright: NDArray[np.bool_], cell: int) -> NDArray[np.intp]:
    """Number the connected regions of bright pixels, [N] row by row.

    A region larger than two cells has a number for each of its cells. Time and memory grow with the pixels alone, not
    with the regions.
    """
    from scipy import ndimage  # type: ignore[import-untyped]

    label, _ = ndimage.label(bright, np.ones((3, 3)))
    number, places = label[bright] - 1, np.nonzero(bright)
    low, high = np.full((2, int(label.max()) + 1), label.size), np.zeros((2, int(label.max()) + 1), np.intp)
    for least, most, place in zip(low, high, places, strict=True):
        np.minimum.at(least, number, place)
        np.maximum.at(most, number, place)
    large = (high - low).max(0) >= 2 * cell
    # The cell of each pixel, counted from its region's corner; a row has fewer cells than the picture has columns.
    row, column = (place - least[number] for place, least in zip(places, low, strict=True))
    part = np.where(large[number], row // cell * label.shape[1] + column // cell, 0)
    _, numbers = np.unique(number * np.int64(bright.size) + part, return_inverse=True)
    return np.asarray(numbers.reshape(-1), np.intp)


def _pixels(
    colour: FloatArray, row: NDArray[np.intp], column: NDArray[np.intp], field: Field, film_mm: tuple[float, float],
    size: tuple[int, int],
) -> tuple[Array, Array, Array]:  # fmt: skip
    """Return irradiance at the lens [N, 3], unit direction [3, N] (lens frame) and solid angle [N] of pixels.

    These follow from the directions of their corners.
    """
    x = (np.array([[0], [1], [1], [0]]) + column) * (film_mm[0] / size[1]) - film_mm[0] / 2
    y = film_mm[1] / 2 - (np.array([[0], [0], [1], [1]]) + row) * (film_mm[1] / size[0])
    corner = field.directions((x + 1j * y).reshape(-1)).reshape(3, 4, -1)
    corner[2] *= -1
    across, down = corner[:, 2] - corner[:, 0], corner[:, 3] - corner[:, 1]
    solid = np.linalg.norm(np.cross(across, down, axis=0), axis=0) / 2
    light = field.relative_light(x.mean(0) + 1j * y.mean(0))
    radiance = np.where(light[:, None] > _DIMMEST, np.maximum(colour, 0) / np.maximum(light, _DIMMEST)[:, None], 0)
    towards = corner.sum(1)
    return radiance * solid[:, None], towards / np.linalg.norm(towards, axis=0), solid
