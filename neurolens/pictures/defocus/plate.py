"""Plates: a pinhole camera's pictures with depth, in layers, read from OpenEXR and ready to be met by rays.

Inverse depth is linear along the straight line that a ray draws in such a picture, and over every plane of the scene.
Two neighbouring pixels are joined where their step of inverse depth goes on as the surface does on either side; other
steps are edges of things.

A layer of a file is what has red, green, blue and depth under one name: R, G, B, Z of the picture itself, "behind.R"
and "behind.Z", or "ViewLayer.Combined.R" and "ViewLayer.Depth.Z" of Blender. In a deep file the first sample of each
pixel makes one layer, the second the next. The picture's own layer is the front; a ray takes whatever it meets first.

A camera that takes a plate traces rays only at nodes, a sixtieth of its film apart, through one set of pupil points.
Each channel has its own wavelengths, those that make its light from white surfaces, so that colours blur apart but have
no noise of their own.
"""

import ctypes
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import OpenEXR
from numpy.typing import NDArray

from neurolens.base.errors import InputError, warn
from neurolens.base.settings import LIGHT_NM
from neurolens.cameras.contract import RAYS_A_CALL, Camera, FloatArray
from neurolens.cameras.field import Frame
from neurolens.cameras.pose import FilmPose
from neurolens.cameras.sampling import axis_mm
from neurolens.pictures.defocus.deep import OPAQUE, deep_layers
from neurolens.pictures.render.colour import SRGB, ColourSpace, SpectralRange, conversion, converted
from neurolens.pictures.render.pictures import (
    COLOURS,
    check_size,
    decoded_channels,
    decoded_later_parts,
    header_of,
    metadata_of,
    read_colour_space,
)

NUMBERS = 5  # that a ray's line has: ax, ay, bx, by, weight
MIDDLE_NM = 550.0
_NODES, _PITCH = 64, 8  # cells along the longer side of the film, and their least size in pixels
FINEST = 4  # pixels a side of the smallest cells with bounds
_STEEPEST = 0.2  # of the inverse depth: a larger step to a neighbour is an edge
_LEVEL = 1e-4  # of the inverse depth: a smaller step is no edge
_SLOPES = 1.5
_MIXED = 4.0  # a step larger than so many of the steps beside it is an edge, where a pixel mixes both sides
Along = Literal["axis", "ray"]
_DEPTHS = ("Z", "Depth.Z", "Depth.V", "depth.Z", "depth.V")  # names of depth, after the name of a layer
_COMBINED = ("Combined.", "combined.")
_SKY_M = 1e9  # depth from which on there is sky
_LARGEST, _MOST_PIXELS = 16384, 1 << 26  # pixels a side of a picture, and in all
_SAME = 1e-3  # by which the shapes of plate and film may differ, relatively


@dataclass(frozen=True)
class PlatePinhole:
    """The pinhole that a plate was rendered through.

    Attributes:
        reach_px: pixels for a slope of 1, along x and y. centre_px: where the axis meets the plate.
        before_film_mm: distance of the hole before the film.
    """

    reach_px: tuple[float, float]
    centre_px: tuple[float, float]
    before_film_mm: float

    def lines(self, origin_m: FloatArray, direction: FloatArray) -> FloatArray:
        """Return rays [3, N] (camera frame) as lines [4, N] in the plate: x = ax + bx w, y = ay + by w, w in 1/m."""
        slope = direction[:2] / -direction[2]
        ahead = -origin_m[2] - np.float32(1e-3 * self.before_film_mm)
        offset = origin_m[:2] - slope * ahead
        scale = np.array([[self.reach_px[0]], [-self.reach_px[1]]], np.float32)
        vanishing = np.array(self.centre_px, np.float32)[:, None] + scale * slope
        return np.concatenate([vanishing, scale * offset])


class Layer:
    """One layer of a plate.

    Args:
        rgb: [H, W, 3] linear radiance. inverse_depth: [H, W] 1/m from the pinhole; 0 is the sky, and below 0 the layer
            has nothing.
    """

    def __init__(self, rgb: FloatArray, inverse_depth: FloatArray) -> None:
        w = _unmixed(inverse_depth.astype(np.float32))
        self.texel = np.ascontiguousarray(np.concatenate([rgb, w[..., None]], axis=2), np.float32)
        steps = [_lesser(np.abs(np.diff(w, axis=axis)), axis) for axis in (0, 1)]
        most = _STEEPEST * np.abs(w)
        self.jump = np.ascontiguousarray(np.minimum(_SLOPES * (steps[0] + steps[1]), most) + _LEVEL * np.abs(w))
        self.bounds = _pyramid(w)
        self.nearest = float(w.max())

    @property
    def size(self) -> tuple[int, int]:
        """Width and height in pixels."""
        return self.texel.shape[1], self.texel.shape[0]


class _Struct(ctypes.Structure):
    _fields_ = [  # noqa: RUF012
        *((name, ctypes.c_int) for name in ("width", "height", "levels")),
        *((name, ctypes.c_void_p) for name in ("texel", "jump", "bounds", "start")),
        ("nearest", ctypes.c_float),
    ]


@dataclass(frozen=True)
class Plate:
    """A plate: its layers, front first, its pinhole, and the size and colour space of the picture to take of it.

    `axis_px` is where that picture has the axis, None in its middle.
    """

    layers: list[Layer]
    pinhole: PlatePinhole
    size: tuple[int, int]
    space: ColourSpace = SRGB
    axis_px: tuple[float, float] | None = None

    @property
    def border_px(self) -> tuple[float, float]:
        """Return how far its first pixel lies beyond the first pixel of the picture: the overscan."""
        (x, y), (across, down) = self.pinhole.centre_px, self.axis_px or (self.size[0] / 2, self.size[1] / 2)
        return x - across, y - down

    def structs(self) -> Any:
        """Return the layers as an array of C's structures; it keeps the memory to which these point."""
        structs: Any = (_Struct * len(self.layers))()
        structs.kept = []
        for layer, struct in zip(self.layers, structs, strict=True):
            flat = np.concatenate([level.reshape(-1, 2) for level in layer.bounds])
            start = np.cumsum([0, *(level[..., 0].size for level in layer.bounds)])[:-1].astype(np.int64)
            structs.kept += [flat, start, layer]
            struct.width, struct.height = layer.size
            struct.levels, struct.nearest = len(layer.bounds), layer.nearest
            for name, array in (("texel", layer.texel), ("jump", layer.jump), ("bounds", flat), ("start", start)):
                setattr(struct, name, array.ctypes.data)
        return structs


def _lesser(step: FloatArray, axis: int) -> FloatArray:
    """Return the lesser of the steps to both neighbours along an axis; a border pixel has one."""
    padded = np.pad(step, [(int(a == axis), int(a == axis)) for a in (0, 1)], constant_values=np.inf)
    count = step.shape[axis] + 1
    return np.minimum(padded.take(range(count), axis), padded.take(range(1, count + 1), axis))


def _unmixed(w: FloatArray) -> FloatArray:
    """Return inverse depth in which pixels on an edge have that of its nearer side, not the mean of both sides."""
    found = w.copy()
    for axis in (0, 1):
        if w.shape[axis] < 5:
            continue
        far_before, before, here, after, far_after = (
            np.moveaxis(w, axis, 0)[k : w.shape[axis] - 4 + k] for k in range(5)
        )
        slopes = np.abs(before - far_before) + np.abs(far_after - after)
        edge = np.abs(after - before) > _MIXED * slopes + 0.02 * np.abs(here)
        mixed = edge & ((here - before) * (after - here) > 0) & (np.minimum(before, after) > 0)
        with np.errstate(divide="ignore", invalid="ignore"):  # renderers average depth, not its inverse
            share = (1 / here - 1 / before) / (1 / after - 1 / before)
        target = np.moveaxis(found, axis, 0)[2:-2]
        np.copyto(target, np.where(share > 0.5, after, before), where=mixed)
    return found


def _pyramid(w: FloatArray) -> list[FloatArray]:
    """Return least and largest values [h, w, 2] in cells of `FINEST` pixels a side, of twice that, up to one cell."""
    least = most = w
    levels, step = list[FloatArray](), FINEST
    while True:
        least, most = reduced(least, step, np.minimum), reduced(most, step, np.maximum)
        levels.append(np.ascontiguousarray(np.stack([least, most], axis=2)))
        if least.size == 1:
            return levels
        step = 2


def reduced(values: FloatArray, step: int, by: np.ufunc) -> FloatArray:
    """Reduce cells of `step` pixels a side to one value each, [h, w], by `np.add`, `np.minimum` or `np.maximum`."""
    for axis in (0, 1):
        values = by.reduceat(values, np.arange(0, values.shape[axis], step), axis=axis)
    return values


@dataclass(frozen=True)
class DepthSettings:
    """How the depth of a plate is to be understood.

    Attributes:
        channel: the channel of depth; "" finds it. scale_m: metres in its unit; None takes 1, and refuses what does not
            look like metres. along: whether depth is along the camera's axis or along each pixel's ray.
        from_film: whether depth counts from the film, as in pictures of `neurolens render`, or from the pinhole; None
            asks the file.
    """

    channel: str = ""
    scale_m: float | None = None
    along: Along = "axis"
    from_film: bool | None = None


def read_plate(
    path: Path, film_mm: tuple[float, float], frame: Frame, depth: DepthSettings, behind: Sequence[Path] = ()
) -> Plate:
    """Read a plate for a camera of such a film and frame (`cameras.field.frame_of`).

    The display window is the film; a larger data window is overscan. A picture of `neurolens render --camera pinhole`
    says itself what its pinhole and its film were: a larger film is overscan, too. For any other picture the pinhole is
    that of the camera's own frame, which `neurolens stmap` prints: its hole is the paraxial entrance pupil, its focal
    length the lens's paraxial size in the plane in focus.

    Args:
        behind: files of the same size that show what is behind the things of the plate.

    Raises:
        InputError: there is no depth, or depth is negative or only from 0 to 1; the shape is not the film's, or that of
            pixels not the lens's; the files have different sizes; another camera of ours than a pinhole took a picture.
    """
    header = header_of(path)
    (left, top), (last, bottom) = header["displayWindow"]
    size = int(last) - int(left) + 1, int(bottom) - int(top) + 1
    ours = _pinhole(path, metadata_of(path, header))
    plate_mm = film_mm if ours is None else ours["film_mm"]
    if not math.isclose(size[0] / size[1], plate_mm[0] / plate_mm[1], rel_tol=_SAME + 1 / min(size)):
        squeeze = frame.reach_mm[1] / frame.reach_mm[0]
        more = "" if abs(squeeze - 1) < _SAME else f", squeezed: pixels {squeeze:.3g} times as wide as high"
        expected = f"a picture of the film's shape, {plate_mm[0]:g} x {plate_mm[1]:g} mm{more}"
        raise InputError(path, "displayWindow", f"({size[0]} x {size[1]} pixels)", expected)
    reach, before = frame.reach_mm, frame.pupil_mm[1]
    if ours is not None:
        reach, before = (ours["efl_mm"], ours["efl_mm"]), ours["efl_mm"]
    per_mm = size[0] / plate_mm[0], size[1] / plate_mm[1]
    film_px = max(1, round(film_mm[0] * per_mm[0])), max(1, round(film_mm[1] * per_mm[1]))
    for pixels in (size, film_px):
        check_size(path, "displayWindow", f"({pixels[0]} x {pixels[1]} pixels)", pixels, _LARGEST, _MOST_PIXELS)
    shape, stated = reach[1] / reach[0] * per_mm[1] / per_mm[0], float(header.get("pixelAspectRatio", 1.0))
    if not math.isclose(stated, shape, rel_tol=0.2 + 1 / min(size)):  # 2, 1.8 or 1.33 are stated for what is far
        if stated != 1:  # what many programs write whatever they render; another number was meant
            raise InputError(path, "pixelAspectRatio", stated, f"{shape:.3g}, that of this lens's pixels on this film")
        warn(f"{path}: pixels count as {shape:.3g} times as wide as high, as the lens squeezes; the file says square")
    start = [int(v) for v in header["dataWindow"][0]]
    centre = size[0] / 2 + int(left) - start[0], size[1] / 2 + int(top) - start[1]
    pinhole = PlatePinhole((reach[0] * per_mm[0], reach[1] * per_mm[1]), centre, before)
    space = read_colour_space(path) or SRGB
    layers = list[Layer]()
    for file in (path, *behind):
        own = header if file == path else header_of(file)
        if not np.array_equal(own["dataWindow"], header["dataWindow"]):
            raise InputError(file, "dataWindow", f"({own['dataWindow']})".replace("\n", " "), "that of the plate")
        settings, colours = _pinhole(file, metadata_of(file, own)), read_colour_space(file) or SRGB
        from_film = settings is not None if depth.from_film is None else depth.from_film
        for rgb, metres in _layers(file, depth, several=file == path):
            w, cosine = _inverse_depth(file, metres, depth, pinhole, 1e-3 * before if from_film else 0.0)
            light = np.maximum(_finite(file, rgb), 0)
            light = light if colours is SRGB else converted(light, conversion(colours, SRGB)).astype(np.float32)
            if settings is not None and settings.get("vignetting", "both") in ("both", "natural"):
                light /= (cosine**4)[..., None]
            layers.append(Layer(light, w))
    return Plate(layers, pinhole, film_px, space)


def middle_m(path: Path, frame: Callable[[], Frame], depth: DepthSettings) -> float:
    """Return the distance from the film in metres of what the middle ninth of a plate shows, its median; inf is sky.

    `frame` gives that of the camera, where depth counts from its pinhole. Raises InputError as `read_plate`.
    """
    ours = _pinhole(path, metadata_of(path, header_of(path))) is not None
    nearest: NDArray[Any] = np.full((1, 1), np.inf)
    for _, metres in _layers(path, depth, several=True):
        there = np.isfinite(metres) & (metres != 0)
        nearest = np.minimum(nearest, np.where(there, metres * np.float32(depth.scale_m or 1.0), np.inf))
    height, width = nearest.shape
    middle = float(np.median(nearest[height // 3 : height - height // 3, width // 3 : width - width // 3]))
    from_film = ours if depth.from_film is None else depth.from_film
    return math.inf if middle >= _SKY_M else middle + (0.0 if from_film else 1e-3 * frame().pupil_mm[1])


def _pinhole(path: Path, metadata: Mapping[str, Any]) -> dict[str, Any] | None:
    """Return the settings of our pinhole, if it took the picture; raises InputError if another camera of ours did."""
    camera = metadata.get("camera")
    if not isinstance(camera, dict) or "camera" not in camera:
        return None
    if camera["camera"] != "pinhole":
        expected = "'pinhole': render --camera pinhole:LENS, for this picture has a lens's blur or projection already"
        raise InputError(path, "camera", camera["camera"], expected)
    film = camera.get("film_mm")
    lengths = [camera.get("efl_mm"), *(film if isinstance(film, list) and len(film) == 2 else [None])]
    return camera if all(isinstance(v, float | int) and 0 < v < math.inf for v in lengths) else None


def _layers(path: Path, depth: DepthSettings, several: bool) -> list[tuple[FloatArray, FloatArray]]:
    """Return the colours and depths of the layers of a file."""
    header = header_of(path)
    if header["type"] in (OpenEXR.deepscanline, OpenEXR.deeptile):
        return deep_layers(path, header)
    planes = _planes(path)
    found = list[tuple[str, str]]()
    for name in planes:
        prefix = name.removesuffix("R")
        if name != f"{prefix}R" or not {prefix + "G", prefix + "B"} <= planes.keys():
            continue
        root = next((prefix.removesuffix(end) for end in _COMBINED if prefix.endswith(end)), prefix)
        channel = next((root + end for end in _DEPTHS if root + end in planes), None)
        if depth.channel and not found:
            if depth.channel not in planes:
                raise InputError(path, "channel", depth.channel, f"one of: {', '.join(planes)}")
            channel = depth.channel
        if channel is not None:
            found.append((prefix, channel))
    if not found:
        expected = "R, G, B and a channel Z with the depth in metres; --depth names another"
        raise InputError(path, "channels", f"({', '.join(planes)[:200]})", expected)
    found.sort(key=lambda pair: (pair[0] != "", not pair[0].endswith(_COMBINED)))
    layers = []
    for prefix, channel in found if several else found[:1]:
        rgb, metres = np.stack([planes[prefix + c] for c in COLOURS], axis=2), planes[channel]
        if (alpha := planes.get(prefix + "A")) is not None:  # colours are premultiplied by it
            solid = alpha >= OPAQUE
            rgb = np.where(solid[..., None], rgb / np.where(solid, np.minimum(alpha, 1), 1)[..., None], 0)
            metres = np.where(solid, metres, np.float32(-np.inf))
        layers.append((rgb.astype(np.float32), metres))
    return layers


def _planes(path: Path) -> dict[str, FloatArray]:
    """Read the channels of all parts; of two with one name, the later one gets its part's name in front."""
    planes, _ = decoded_channels(path, path, "file")
    for title, channels in decoded_later_parts(path):
        for name, pixels in channels.items():
            planes[f"{title}.{name}" if name in planes else name] = np.asarray(pixels, np.float32)
    return planes


def _finite(path: Path, rgb: FloatArray) -> FloatArray:
    """Return colours in which NaN and infinity have become black, with a warning."""
    bad: NDArray[np.bool_] = np.asarray(~np.isfinite(rgb).all(axis=2))
    if bad.any():
        warn(f"{path}: {int(bad.sum())} of {bad.size} pixels are not finite; they are black")
        rgb = np.where(bad[..., None], np.float32(0), rgb)
    return rgb


def _inverse_depth(
    path: Path, metres: FloatArray, depth: DepthSettings, pinhole: PlatePinhole, pinhole_m: float
) -> tuple[FloatArray, FloatArray]:
    """Return inverse depth from the pinhole (1/m, below 0 where there is nothing), and the cosine of each pixel's ray.

    `pinhole_m`: how far before the place from which depth counts the pinhole lies.
    """
    height, width = metres.shape
    x, y = (
        (np.arange(n, dtype=np.float32) + 0.5 - c) / r
        for n, c, r in zip((width, height), pinhole.centre_px, pinhole.reach_px, strict=True)
    )
    cosine = (1 / np.sqrt(1 + x[None, :] ** 2 + y[:, None] ** 2)).astype(np.float32)
    nothing = np.isneginf(metres)
    z = metres * np.float32(depth.scale_m or 1.0)
    solid = np.isfinite(z) & (z != 0) & (np.abs(z) < _SKY_M)
    if missing := int(np.isnan(metres).sum()):
        if missing == z.size:
            raise InputError(path, "depth", "(not a number in any pixel)", "depth in metres")
        warn(f"{path}: the depth of {missing} of {z.size} pixels is not a number; they count as sky")
    if solid.any():
        least, most = float(z[solid].min()), float(z[solid].max())
        if least < 0:
            expected = "depth that grows away from the camera; --depth-scale -1 turns it"
            raise InputError(path, "depth", f"({least:g} m)", expected)
        if most <= 1 and depth.scale_m is None and not nothing.any():
            expected = "depth in metres; this looks like inverse or normalised depth (--depth-scale 1: it is none)"
            raise InputError(path, "depth", f"({least:g} to {most:g} m)", expected)
    z = np.where(solid, z * cosine if depth.along == "ray" else z, 1) - np.float32(pinhole_m)
    if (close := solid & (z <= 1e-3)).any():
        least = float(z[close].min())
        raise InputError(path, "depth", f"({least:g} m)", "metres from the pinhole on, over 0.001, not their inverse")
    w = np.divide(1, z, out=np.zeros_like(z), where=solid)
    return np.where(nothing, np.float32(-1), w).astype(np.float32), cosine


def channel_wavelengths(sample: FloatArray, low_nm: float, high_nm: float) -> FloatArray:
    """Draw wavelengths [3, N] of red, green and blue by uniform samples [N], by their share in the film's light."""
    light = SpectralRange(low_nm, high_nm)
    found = []
    for part in np.maximum(light.response * light.basis, 0):
        reached = np.concatenate([[0.0], np.cumsum(part, dtype=np.float64)])
        found.append(np.interp(sample, reached / reached[-1], light.edges_nm))
    return np.array(found, np.float32)


def turned(square: NDArray[Any], angle_rad: NDArray[Any]) -> FloatArray:
    """Return points [2, N] of the unit square whose places on the disk are turned by angles [N] (`concentric_disk`)."""
    a, b = 2.0 * square[0] - 1.0, 2.0 * square[1] - 1.0
    size = np.maximum(np.abs(a), np.abs(b))
    along = 2.0 - np.divide(a, size, out=np.zeros_like(a), where=size > 0) * (
        2.0 - np.divide(np.abs(b), size, out=np.zeros_like(a), where=size > 0)
    )
    # The place along the sides of the square, from 0 at +x over 2 at +y to 8.
    along = (np.where(b < 0, 8.0 - along, along) + angle_rad * (4.0 / math.pi)) % 8.0
    x, y = (np.clip(np.abs((along - by) % 8.0 - 4.0) - 2.0, -1.0, 1.0) for by in (0.0, 2.0))
    return np.stack([0.5 + 0.5 * size * x, 0.5 + 0.5 * size * y]).astype(np.float32)


def turns_pupil(camera: Camera) -> bool:
    """Tell whether a camera's pupil samples turn about the axis with the film point: those of all lenses do."""
    return camera.settings.get("camera") in ("exact", "model")


def axis_px(camera: Camera, size: tuple[int, int]) -> tuple[float, float]:
    """Return where a camera's picture of this size has the axis: away from its middle on a film that is moved."""
    (shift, rise), (width, height) = axis_mm(camera)[0], camera.film_mm
    return size[0] * (0.5 - shift / width), size[1] * (0.5 + rise / height)


class RayTable:
    """Rays of a camera at nodes of its film, as lines in a plate, for one set of pupil points.

    A pupil point is the same place in the lens for all film points.
    """

    def __init__(self, camera: Camera, plate: Plate, pupil: FloatArray, hue: FloatArray) -> None:
        self.camera, self.pinhole, self.size, self.pupil = camera, plate.pinhole, plate.size, pupil
        pitch = max(_PITCH, max(plate.size) / _NODES)
        self.cells = tuple(max(1, math.ceil(n / pitch)) for n in plate.size)
        self.turns = turns_pupil(camera)
        low, high = camera.wavelength_nm or LIGHT_NM
        if camera.dispersive and high > low:
            self.nm = channel_wavelengths(hue, max(low, LIGHT_NM[0]), min(high, LIGHT_NM[1]))[[1, 0, 2]]
        else:
            self.nm = np.full((1, pupil.shape[1]), min(max(MIDDLE_NM, low), high), np.float32)

    def row(self, j: int) -> FloatArray:
        """The rays of a row of nodes, [nodes across, samples, 16 or 8]: lines and weights of green, red and blue.

        Where green does not pass, the others have no weight either; where it passes, they have lines, too.
        """
        (across, down), (width, height) = self.cells, self.camera.film_mm
        channels, samples = self.nm.shape
        x = (0.5 - np.arange(across + 1) / across) * width
        film = np.empty((2, across + 1, samples, channels), np.float32)
        film[0], film[1] = x[:, None, None], (j / down - 0.5) * height
        shape = film.shape[1:]
        pupil = np.broadcast_to(self.pupil[:, None, :, None], (2, *shape)).reshape(2, -1)
        nm = np.broadcast_to(self.nm.T[None], shape).reshape(-1)
        lines = self._lines(film.reshape(2, -1), pupil, nm).reshape(*shape, NUMBERS)
        for k in range(1, channels):
            lines[..., k, :4] = np.where(lines[..., k, 4:] > 0, lines[..., k, :4], lines[..., 0, :4])
            lines[..., k, 4] *= lines[..., 0, 4] > 0
        found = np.zeros((*shape[:2], 16 if channels > 1 else 8), np.float32)
        found[..., : channels * NUMBERS] = lines.reshape(*shape[:2], -1)
        return found

    def at(self, place_px: NDArray[Any], pupil: FloatArray, nm: FloatArray) -> FloatArray:
        """Return lines and weights [N, 5] of the rays from film places [2, N] through pupil points [2, N]."""
        return self._lines(self.film_mm(place_px), pupil, nm)

    def film_mm(self, place_px: NDArray[Any]) -> FloatArray:
        """Return the film points [2, N] of film places [2, N], which a picture shows upright."""
        return ((place_px.T / self.size - 0.5) * self.camera.film_mm * (-1, 1)).T.astype(np.float32)

    def unturned(self, film_mm: FloatArray, pupil: FloatArray) -> FloatArray:
        """Return the samples that the camera takes to pupil points [2, N], seen from film points [2, N]."""
        if not self.turns:
            return pupil
        pose = FilmPose.in_settings(self.camera.settings)
        x, y = pose.axes[:2, :2] @ (film_mm - np.array(pose.moved_mm)[:, None])
        return turned(pupil, -np.arctan2(y, x))

    def _lines(self, film: FloatArray, pupil: FloatArray, nm: FloatArray) -> FloatArray:
        found = np.empty((len(nm), NUMBERS), np.float32)
        pupil = self.unturned(film, pupil)
        step = getattr(self.camera, "rays_a_call", RAYS_A_CALL)
        for first in range(0, len(nm), step):
            part = slice(first, first + step)
            rays = self.camera.sample(*(np.ascontiguousarray(v[..., part]) for v in (film, pupil, nm)))
            passed = (rays.status == 0) & (rays.direction[2] < 0)
            with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
                lines = self.pinhole.lines(rays.origin_m, rays.direction)
            passed &= np.isfinite(lines).all(axis=0)
            found[part, :4] = np.where(passed, lines, 0).T
            found[part, 4] = np.where(passed, rays.weight, 0)
        return found
