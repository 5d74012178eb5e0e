"""Rays of a lens for programs that take any ray for any pixel: simulators, renderers, Gaussian splats, radiance fields.

    found = rays("laikin_double_gauss_50", (36.0, 24.0), width=240, to="newton", focus_m=1.5, f_number=1.8)
    found["camera_rays"]  # [160, 240, 16, 2, 3]: row, column, sample; origin and direction; x, y, z

The value of a pixel is the mean of weight times radiance over its samples. Film point, pupil point and wavelength of a
sample are one point of a Sobol' sequence, scrambled for each pixel by the seed, as in our renderer: one seed names the
same rays for every host. The axes and arrays of the hosts were read in the sources of Newton 1.8.0, gsplat 1.6.0,
3DGRUT at a37ef721 and Mitsuba 3.9.1.
"""

import argparse
import math
import operator
import os
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, fields
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from neurolens import __version__
from neurolens.base.errors import InputError
from neurolens.base.report import plain
from neurolens.base.settings import (
    FILM_MM,
    LARGEST_SEED,
    LIGHT_NM,
    WAVELENGTH_NM,
    check_bounds,
    said,
    setting,
    wavelengths_nm,
    whole,
    within,
)
from neurolens.cameras.build import film_of, make_camera
from neurolens.cameras.contract import RAYS_A_CALL, Camera, FloatArray
from neurolens.cameras.field import frame_of
from neurolens.cameras.sampling import focus_m
from neurolens.optics.lens.shot import Shot, check_film
from neurolens.pictures.render.colour import ChannelWavelengths
from neurolens.pictures.render.film import PixelGrid, check_memory
from neurolens.pictures.render.job import camera_axes
from neurolens.pictures.render.sampler import FILM, FIRST_BOUNCE, PUPIL, WAVELENGTH, Sampler
from neurolens.pictures.render.scene import CameraSettings
from neurolens.pictures.render.settings import size_by_shape

Arrays = dict[str, NDArray[Any]]
Vector = tuple[float, float, float]
USUAL_PX = 480  # width of a picture
BYTES_A_RAY = 44  # the most, with three weights
MOST_COMPACT_PX = 0.01  # how far rays in 16 bytes may be off
_PROBES, _FLATTEST = 4096, 0.17  # rays that measure this; their least cosine to the axis, that of 80 degrees


class Host(NamedTuple):
    """How a program takes rays.

    Attributes:
        axes: signs of its camera's axes along ours (right, up, backwards).
        arrays: its arrays of rays with their last dimensions; a single array has origin and direction in it.
        world: whether rays are in the world frame, else in the camera's.
        samples_first: whether samples are pictures of their own, [S, H, W], else [H, W, S].
        lost: length of the direction (along the axis) of rays that the lens stops; with 0 Newton sees black.
    """

    axes: tuple[int, int, int]
    arrays: Mapping[str, tuple[int, ...]] = {"origin": (3,), "direction": (3,)}  # noqa: RUF012
    world: bool = False
    samples_first: bool = False
    lost: float = 1.0

    def views(self, arrays: Arrays) -> Arrays:
        """Return views of the arrays as [H, W, S, ...], with rays under the names origin and direction."""
        found = dict(arrays)
        if self.samples_first:
            found = {name: np.moveaxis(a, 0, 2) if a.ndim > 2 else a for name, a in found.items()}
        rays = [found.pop(name) for name in self.arrays if name in found]
        if len(rays) == 1:
            both = rays[0].reshape(*rays[0].shape[:3], 2, 3)
            rays = [both[..., 0, :], both[..., 1, :]]
        return found | dict(zip(("origin", "direction"), rays, strict=False))


HOSTS = {
    "opengl": Host((1, 1, 1)),
    "opencv": Host((1, -1, -1)),
    "mitsuba": Host((-1, 1, -1)),
    "newton": Host((1, 1, 1), {"camera_rays": (2, 3)}, lost=0.0),
    "gsplat": Host((1, -1, -1), {"rays": (6,)}, world=True, samples_first=True),
    "3dgrut": Host((1, -1, -1), {"rays_ori": (3,), "rays_dir": (3,)}, samples_first=True),
}


def _place(text: str) -> Vector:
    """Read an option that is a point X,Y,Z."""
    try:
        x, y, z = map(float, text.split(","))
    except ValueError:
        raise argparse.ArgumentTypeError(f"got {text!r}, expected X,Y,Z, three numbers") from None
    return x, y, z


@dataclass(frozen=True, kw_only=True)
class RaySettings:
    """What `rays` takes besides a camera, its shot and the size of the picture; options of `neurolens rays`."""

    samples: int = setting(
        16, "samples of a pixel; powers of two are spread most evenly (default: 16)", within=(1, 1 << 16), common=True
    )
    to: Literal["opengl", "opencv", "mitsuba", "newton", "gsplat", "3dgrut"] = setting(
        "opengl", "who takes the rays: opengl and newton (x right, y up, the camera looks along -z), opencv and 3dgrut "
        "(x right, y down, along z), mitsuba (x left, y up, along z), gsplat (in the world) (default: opengl)",
        common=True,
    )  # fmt: skip
    weights: Literal["kept", "importance", "rgb"] = setting(
        "kept", "kept: one a ray; rgb: three a ray, for the colours that a host returns; importance: samples are drawn "
        "by their weight, all of a pixel count the same, and weight is a picture, by which that of the host is "
        "multiplied (default: kept)",
    )  # fmt: skip
    wavelengths: Sequence[float] | None = setting(
        None, "wavelengths that samples share, as 550 or 611,549,464 (default: 400 to 700 nm, more of what film sees)",
        kind=wavelengths_nm, metavar="NM",
    )  # fmt: skip
    seed: int = setting(0, "seed of the random numbers (default: 0)", kind=whole(0))
    compact: bool = setting(
        False, f"16 bytes a ray; refused where that moves rays by more than {MOST_COMPACT_PX:g} pixels"
    )
    origin: Literal["film", "pupil"] = setting(
        "film", "origin of the camera's frame: the centre of the film, or of the entrance pupil, where calibrated "
        "cameras have it (default: film)",
    )  # fmt: skip
    units_per_m: float = setting(
        1.0, "units of the scene that make a metre (default: 1; 1000 for a scene in millimetres)",
        option="units-per-m", metavar="N",
        within=(1e-9, 1e9), unit="scene units in a metre",
    )  # fmt: skip
    position_m: Vector | None = setting(
        None, "where the camera stands, in metres (default: 0,0,0)", option="position", kind=_place, metavar="X,Y,Z"
    )
    look_at_m: Vector | None = setting(
        None, "a point on its axis (default: it looks along -z)", option="look-at", kind=_place, metavar="X,Y,Z"
    )
    up: Vector = setting((0.0, 1.0, 0.0), "up in the world (default: 0,1,0)", kind=_place, metavar="X,Y,Z")

    def __post_init__(self) -> None:
        check_bounds(self, "rays")
        clean: dict[str, Any] = {"samples": _whole("samples", self.samples, 1), "seed": _whole("seed", self.seed, 0)}
        for name in ("position_m", "look_at_m", "up"):
            if (given := getattr(self, name)) is None and name != "up":
                continue
            clean[name] = _numbers(given)
            if len(clean[name]) != 3 or not all(map(math.isfinite, clean[name])):
                raise InputError("rays", name, given, "three numbers x, y, z")
        if self.wavelengths is not None:
            clean["wavelengths"] = waves = _numbers(self.wavelengths)
            if not waves or not all(within(WAVELENGTH_NM, nm) for nm in waves):
                raise InputError("rays", "wavelengths", self.wavelengths, f"one or more in nm, {said(WAVELENGTH_NM)}")
        for name, value in clean.items():
            object.__setattr__(self, name, value)
        if self.weights == "rgb" and self.wavelengths is not None:
            raise InputError("rays", "wavelengths", self.wavelengths, "left out: weights rgb are of all light")
        if self.compact and HOSTS[self.to].world:
            raise InputError("rays", "compact", f"(to {self.to})", "rays in the camera's frame")

    @property
    def light_nm(self) -> tuple[float, float]:
        """The shortest and the longest wavelength in nm."""
        return LIGHT_NM if self.wavelengths is None else (min(self.wavelengths), max(self.wavelengths))


def _whole(name: str, value: Any, least: int) -> int:
    """Return an integer of at least `least`; anything else is refused."""
    with suppress(TypeError):
        if least <= (number := operator.index(value)) <= LARGEST_SEED:
            return number
    raise InputError("rays", name, value, f"an integer from {least} to {LARGEST_SEED}")


def _numbers(values: Any) -> tuple[float, ...]:
    """Return the numbers of a sequence; none where it is no sequence of numbers."""
    try:
        return () if isinstance(values, str) else tuple(float(value) for value in values)
    except (TypeError, ValueError, OverflowError):
        return ()


def rays(
    camera: str | os.PathLike[str], film: tuple[float, float] | None = None, *, width: int | None = None,
    height: int | None = None, device: Any = None, **settings: Any,
) -> dict[str, Any]:  # fmt: skip
    """Return the rays of a picture through a lens, as `neurolens rays` writes them.

    Args:
        camera: a lens file, a model, the name of one, or another camera (`cameras.build.make_camera`). A lens or camera
            that is set, which `neurolens.rays` takes, too, brings its settings; those of the call win.
        film: its width and height in mm; None takes the format that the lens covers.
        width, height: of the picture in pixels, one or both; without either the width is 480.
        device: of torch; None gives arrays of numpy.
        settings: fields of `RaySettings`, and of `Shot` (f_number, zoom, ...; focus_m is infinity unless given).

    Returns: H rows from the top, W columns, S samples; by name

        - origin (scene units), direction (length 1): [H, W, S, 3]. newton: camera_rays [H, W, S, 2, 3]; gsplat: rays
          [S, H, W, 6]; 3dgrut: rays_ori, rays_dir [S, H, W, 3].
        - weight: [H, W, S] or [S, H, W]; with "rgb" three for each ray, with "importance" [H, W].
        - wavelength_nm: one for each ray.
        - to_world: [4, 4], from the host's camera frame to the world.

        With `compact`, in place of rays, origin_xy (int16) times origin_step, in the plane plane_z, and direction_xy
        (float32), whose z has the sign `ahead` (`from_compact`); weights and wavelengths are float16.

    Raises:
        InputError: a setting is unknown or out of its bounds, memory does not hold the rays; as `make_camera`.
        ModelError: the model cannot be trusted.
    """
    own, of_shot = ({f.name for f in fields(kind)} for kind in (RaySettings, Shot))
    for name in settings.keys() - own - of_shot:
        raise InputError("rays", name, settings[name], f"one of: {', '.join(sorted(own | of_shot))}")
    asked = RaySettings(**{name: settings.pop(name) for name in own & settings.keys()})
    width = USUAL_PX if width is None and height is None else width
    width, height = (
        None if pixels is None else _whole(name, pixels, 1) for name, pixels in (("width", width), ("height", height))
    )
    if film is None:
        film, _ = film_of(os.fspath(camera), **Shot.part(**settings).size)
    try:
        film = check_film(film)
    except (TypeError, InputError):
        raise InputError("rays", "film", film, f"a width and a height, each {said(FILM_MM)} mm") from None
    if device is not None:
        import torch

        try:
            torch.empty(0, device=device)
        except (TypeError, RuntimeError, AssertionError) as error:
            said_so = str(error).partition("\n")[0]
            raise InputError("rays", "device", str(device), f"a device that torch has here ({said_so})") from None
    grid = PixelGrid(*size_by_shape(film[0] / film[1], width, height), film)
    check_memory(grid.width, grid.height, BYTES_A_RAY * asked.samples)
    shot = Shot.part(**{"film_mm": film, "wavelength_nm": asked.light_nm} | settings)
    made = make_camera(os.fspath(camera), shot)
    found: dict[str, Any] = RayJob(made, grid, asked, focus_m(made, shot)).arrays()
    return found if device is None else {name: torch.from_numpy(a).to(device) for name, a in found.items()}


class RayJob:
    """The rays of a picture through a camera, made some ten thousand at a time.

    Attributes:
        to_world: [4, 4] from the host's camera frame to the world. passed: share of the rays that passed, known when
            all are made.
        compact_px: by how many pixels, in the plane in focus, rays of `compact` are off at most; else 0.

    Raises:
        InputError: rays of `compact` would be off by too much, or run sideways; the camera does not have the
            wavelengths.
    """

    def __init__(self, camera: Camera, grid: PixelGrid, settings: RaySettings, focus_m: float) -> None:
        self.camera, self.grid, self.settings, self.host = camera, grid, settings, HOSTS[settings.to]
        known = camera.wavelength_nm
        if settings.wavelengths is not None and known and not all(within(known, nm) for nm in settings.wavelengths):
            expected = f"{said(known)} nm, the light of {camera.name}"
            raise InputError("rays", "wavelengths", settings.wavelengths, expected)
        self._sampler, self._light = Sampler(settings.samples, settings.seed), ChannelWavelengths(*LIGHT_NM)
        position = settings.position_m or (0.0, 0.0, 0.0)
        look = settings.look_at_m or (*position[:2], position[2] - 1)
        pose = CameraSettings(position_m=position, look_at_m=look, up=settings.up, focus_m=1.0)
        self._axes, self._signs = camera_axes(pose), np.array(self.host.axes, np.float32)[:, None]
        self.to_world = np.eye(4, dtype=np.float32)
        self.to_world[:3, :3] = self._axes * self._signs.T
        self.to_world[:3, 3] = settings.units_per_m * np.array(position)
        pupil_m = frame_of(camera).pupil_mm[1] / 1e3 if settings.origin == "pupil" else 0.0
        self._shift = np.array([[0.0], [0.0], [pupil_m]], np.float32)
        self.passed, self.compact_px = 0.0, 0.0
        self._plane_z, self._step = self._rounding(focus_m) if settings.compact else (0.0, 1.0)

    @property
    def about(self) -> dict[str, Any]:
        """Return what a file of these rays says of itself."""
        said = {
            **{f.name: getattr(self.settings, f.name) for f in fields(self.settings)},
            "version": __version__,
            "width": self.grid.width,
            "height": self.grid.height,
            "passed": self.passed,
            "compact_px": self.compact_px,
            "to_world": self.to_world,
            "camera": self.camera.settings,
        }
        return dict(plain(said))

    def arrays(
        self, new: Callable[..., NDArray[Any]] = np.empty, report: Callable[[float], None] | None = None
    ) -> Arrays:
        """Make all rays, as `rays` returns them.

        `new` makes an array of a shape and a type; `report` is called with the share that is done.
        """
        asked, size, count = self.settings, (self.grid.height, self.grid.width), self.settings.samples
        shape = (count, *size) if self.host.samples_first else (*size, count)
        small: Any = np.float16 if asked.compact else np.float32
        made = {name: new((*shape, *last), np.float32) for name, last in self.host.arrays.items() if not asked.compact}
        if asked.compact:
            made = {name: new((*shape, 2), kind) for name, kind in _COMPACT.items()}
        weights = {"kept": shape, "rgb": (*shape, 3), "importance": size}
        made |= {"weight": new(weights[asked.weights], small), "wavelength_nm": new(shape, small)}
        views, pixels, passed = self.host.views(made), self.grid.width * self.grid.height, 0
        step = max(1, getattr(self.camera, "rays_a_call", RAYS_A_CALL) // count)
        for first in range(0, pixels, step):
            pixel = np.arange(first, min(first + step, pixels))
            part = self._part(pixel)
            passed += int(part.pop("passed"))
            for name, values in part.items():
                views[name][np.divmod(pixel, self.grid.width)] = values
            if report is not None:
                report((first + len(pixel)) / pixels)
        self.passed, made["to_world"] = passed / (pixels * count), self.to_world
        if asked.compact:
            place = self._signs[2, 0] * (self._plane_z + self._shift[2, 0])
            numbers = {"plane_z": asked.units_per_m * place, "origin_step": asked.units_per_m * self._step}
            made |= {k: np.array(v, np.float32) for k, v in (numbers | {"ahead": -self._signs[2, 0]}).items()}
        return made

    def _part(self, pixel: NDArray[np.intp]) -> Arrays:
        """Make the parts [n, S, ...] of all views for some pixels [n]; also return how many rays passed."""
        asked, count = self.settings, self.settings.samples
        owner = np.repeat(pixel, count)
        keys = self._sampler.keys(owner, np.tile(np.arange(count), len(pixel)))
        nm, colour = self._light.draw(self._sampler.draw(keys, WAVELENGTH))
        if asked.wavelengths is not None:
            share = self._sampler.draw(keys, WAVELENGTH) * len(asked.wavelengths)
            nm = np.array(asked.wavelengths, np.float32)[share.astype(np.intp)]
        nm = np.clip(nm, *(self.camera.wavelength_nm or (0, np.inf))).astype(np.float32)
        film = self.grid.film_points(owner, self._sampler.draw2(keys, FILM))
        found = self.camera.sample(film, self._sampler.draw2(keys, PUPIL), nm)
        passed = found.status == 0
        weight = np.where(passed, found.weight, np.float32(0))
        origin = np.where(passed, found.origin_m, np.float32(0))
        direction = np.where(passed, found.direction, np.array([[0], [0], [-self.host.lost]], np.float32))
        each = weight.reshape(len(pixel), count)
        if asked.weights == "importance":
            first = self._sampler.keys(pixel, np.zeros_like(pixel))
            chosen = resampled(each, self._sampler.draw(first, FIRST_BOUNCE))
            origin, direction, nm = origin[:, chosen], direction[:, chosen], nm[chosen]
        part = {"wavelength_nm": nm, "weight": weight if asked.weights == "kept" else (weight * colour).T}
        part |= self._compact(origin, direction) if asked.compact else self._placed(origin, direction)
        part = {name: values.reshape(len(pixel), count, *values.shape[1:]) for name, values in part.items()}
        if asked.weights == "importance":
            part["weight"] = each.mean(axis=1)
        return part | {"passed": passed.sum()}

    def _placed(self, origin: FloatArray, direction: FloatArray) -> Arrays:
        """Return rays [3, N] of our frame as [N, 3] of the host's."""
        origin = (origin + self._shift) * np.float32(self.settings.units_per_m)
        if self.host.world:
            return {"origin": (self._axes @ origin).T + self.to_world[:3, 3], "direction": (self._axes @ direction).T}
        return {"origin": (origin * self._signs).T, "direction": (direction * self._signs).T}

    def _compact(self, origin: FloatArray, direction: FloatArray) -> Arrays:
        """Return rays [3, N] of our frame as the arrays of `compact`."""
        steps = np.rint(_met(origin, direction, self._plane_z) / self._step)
        return {
            "origin_xy": (steps * self._signs[:2]).T.astype(np.int16),
            "direction_xy": (direction[:2] * self._signs[:2]).T,
        }

    def _rounding(self, focus_m: float) -> tuple[float, float]:
        """Return z of the plane where rays of `compact` start, and the step of their places there (m, in our frame).

        Rounding moves a ray sideways by up to a step over the root of 2, whatever its distance.
        """
        rng, light = np.random.default_rng(0), np.full(_PROBES, np.mean(self.settings.light_nm), np.float32)
        place, square = rng.random((2, _PROBES)), rng.random((2, _PROBES), np.float32)
        place[:, :4] = [[0, 0, 1, 1], [0, 1, 0, 1]]
        film = 0.999 * (place - 0.5) * np.array(self.grid.film_mm)[:, None]
        found = self.camera.sample(film.astype(np.float32), square, light)
        passed = found.status == 0
        if not (passed.any() and (-found.direction[2, passed] > _FLATTEST).all()):
            raise InputError("rays", "compact", True, "rays within 80 degrees of the axis: leave it out")
        plane_z = float(found.origin_m[2, passed].mean())
        widest = np.abs(_met(found.origin_m[:, passed], found.direction[:, passed], plane_z)).max()
        step = 2 * max(float(widest), 1e-3) / np.iinfo(np.int16).max  # for twice the reach that was found
        frame, pixels = frame_of(self.camera), (self.grid.width, self.grid.height)
        pixel = min(mm / n / reach for mm, n, reach in zip(self.grid.film_mm, pixels, frame.reach_mm, strict=True))
        self.compact_px = step / math.sqrt(2) / (pixel * (focus_m - frame.pupil_mm[0] / 1e3))
        if not self.compact_px <= MOST_COMPACT_PX:
            most = f"rays off by at most {MOST_COMPACT_PX:g} pixels, not {self.compact_px:.2g}: leave it out"
            raise InputError("rays", "compact", True, most)
        return plane_z, step


_COMPACT = {"origin_xy": np.int16, "direction_xy": np.float32}


def _met(origin: FloatArray, direction: FloatArray, plane_z: float) -> FloatArray:
    """Return x and y [2, N] where rays [3, N] that run towards -z meet a plane."""
    along = (origin[2] - np.float32(plane_z)) / -np.where(direction[2] < 0, direction[2], np.float32(-1))
    return origin[:2] + along * direction[:2]


def from_compact(arrays: Mapping[str, NDArray[Any]]) -> tuple[FloatArray, FloatArray]:
    """Return origins and directions [..., 3] float32 of the arrays of `compact`, in the host's camera frame."""
    point, way = arrays["origin_xy"] * np.float32(arrays["origin_step"]), arrays["direction_xy"]
    ahead = np.float32(arrays["ahead"]) * np.sqrt(1 - (way * way).sum(-1, keepdims=True))
    return np.concatenate([point, np.full_like(ahead, arrays["plane_z"])], -1), np.concatenate([way, ahead], -1)


def resampled(weight: FloatArray, start: FloatArray) -> NDArray[np.intp]:
    """Draw samples [n S] of rows of weights [n, S], in proportion to these; samples are numbered over all rows.

    The resampling is systematic, at places (k + start) / S of a row's sum, with a number `start` [n] in [0, 1) for each
    row. On average, the mean of any values over the drawn samples is that of weight times value over the mean weight. A
    row of zeros gives samples of its own.
    """
    (rows, count), row = weight.shape, np.arange(len(weight))[:, None]
    reached = np.cumsum(weight, axis=1, dtype=np.float64)
    reached /= np.maximum(reached[:, -1:], 1e-300)
    place = (np.arange(count) + start.astype(np.float64)[:, None]) / count
    found = np.searchsorted((reached + row).ravel(), (place + row).ravel(), side="right").reshape(rows, count)
    return np.clip(found, row * count, row * count + count - 1).ravel()
