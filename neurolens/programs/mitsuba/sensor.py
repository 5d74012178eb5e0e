"""The Mitsuba sensor "neurolens": any camera of our contract, one numpy call per wavefront.

Mitsuba's camera looks along +z with y up and x to the left of the picture, ours along -z with x to the right: it is
half a turn about y. The origin is the centre of the film plane, as in our scenes.

In spectral variants a ray carries four wavelengths. Where the camera's rays hardly depend on the wavelength, as with
dispersion "off", they are Mitsuba's own four, each with its weight (hero wavelengths, Wilkie et al. 2014). A lens that
disperses, even "lateral", gives all four lanes the same wavelength.

A path of an RGB renderer carries three numbers, not a wavelength; a lens that disperses needs one. Each ray takes a
wavelength, drawn by the film's response, and its channel c is weighted by

    w_c(lambda) = response_c(lambda) B_c(lambda) / pdf(lambda).

It is the diagonal of what our film makes of light of the basis spectra B (Mallett and Yuksel 2019; `SpectralRange`),
without its few negative values (Mitsuba's scalar variants drop samples below 0) and scaled to a mean of 1. White stays
white, and any colour stays itself where the rays do not depend on the wavelength. The terms off the diagonal have mean
0; an RGB renderer cannot represent them, and colour fringes of saturated objects differ by them from a spectral render.

Weights are ours: a uniform environment of radiance 1 gives 1 on the axis, and falls off towards the edge as the lens
vignettes. Scalar variants ask for one ray at a time, which takes a model about a millisecond: they serve tests.
"""

import importlib
import math
import warnings
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from neurolens.base.errors import InputError, NeurolensError, NeurolensWarning, pip_install
from neurolens.base.settings import LIGHT_NM
from neurolens.cameras.build import make_camera
from neurolens.cameras.contract import RAYS_A_CALL, Camera, FloatArray
from neurolens.optics.lens.shot import Shot, StopShape
from neurolens.pictures.render.colour import ChannelWavelengths
from neurolens.pictures.render.film import PixelGrid
from neurolens.pictures.render.images import make_aperture
from neurolens.pictures.render.job import mode_for
from neurolens.pictures.render.sampler import hash32
from neurolens.pictures.render.settings import FilmSettings

PLUGIN = "neurolens"
FILM_WIDTH_MM = 36.0
_MIDDLE_NM = 550.0
_CLASSES: dict[str, type] = {}
DEFAULT_VARIANT, WITHOUT_LLVM = "llvm_ad_spectral", "scalar_spectral"
# LLVM 15 and 16, which Dr.Jit takes, abort the process on Mitsuba's kernels; 19 works.
_OLDEST_LLVM = 17
_TURNED = np.array([[-1], [1], [-1]], np.float32)  # half a turn about y


def libraries() -> tuple[Any, Any]:
    """Import the modules mitsuba and drjit, untyped: what Mitsuba has depends on its variant.

    Raises:
        NeurolensError: they are not installed.
    """
    try:
        return importlib.import_module("mitsuba"), importlib.import_module("drjit")
    except ImportError as error:
        raise NeurolensError(f"Mitsuba 3 cannot be imported ({error}): {pip_install('mitsuba')}") from None


def require_mitsuba(variant: str | None = None) -> Any:
    """Import the module mitsuba with a variant set: `variant`, else the current one, else llvm_ad_spectral.

    Warns:
        NeurolensWarning: LLVM is missing, or so old that compiled variants end the process. Where no variant was asked
            for, scalar_spectral is taken.

    Raises:
        NeurolensError: Mitsuba is not installed, or the compiler that the variant needs (LLVM, CUDA) is missing or too
            old.
        InputError: this Mitsuba does not have the variant, or the variant carries neither RGB nor plain spectra.
    """
    mi, dr = libraries()
    wanted = variant or mi.variant() or DEFAULT_VARIANT
    if wanted.startswith("llvm") and (doubt := _llvm_doubt(dr)):
        told = f"{doubt}; the variant {WITHOUT_LLVM} needs none"
        if variant or mi.variant():
            raise NeurolensError(f"mitsuba variant {wanted}: {told}")
        warnings.warn(f"{told} and is taken", NeurolensWarning, stacklevel=2)
        wanted = WITHOUT_LLVM
    known = [v for v in mi.variants() if v.endswith(("_rgb", "_spectral"))]
    if wanted not in known:
        raise InputError("mitsuba", "variant", wanted, f"one of: {', '.join(known)}")
    try:
        if mi.variant() != wanted:
            mi.set_variant(wanted)
        if not wanted.startswith("scalar"):
            _compile(wanted)
    except Exception as error:  # the library's exception types
        reason = " ".join(str(error).split())[:200]
        needed = "libLLVM" if wanted.startswith("llvm") else "CUDA"
        raise NeurolensError(f"mitsuba variant {wanted}: no {needed} ({reason}); a scalar variant needs none") from None
    return mi


def _llvm_doubt(dr: Any) -> str:
    """Say what is wrong with the LLVM that Dr.Jit loads; empty if nothing is."""
    version = dr.detail.llvm_version()
    if version[0] >= _OLDEST_LLVM:
        return ""
    found = (
        f"LLVM {'.'.join(map(str, version))} is too old for Mitsuba"
        if version[0] > 0
        else "Mitsuba found no LLVM that it takes"
    )
    return f"{found} (19 works; DRJIT_LIBLLVM_PATH names the library)"


@cache
def _compile(variant: str) -> None:
    """Compile one small kernel, since only then a missing LLVM is detected."""
    mi, dr = libraries()
    dr.eval(mi.Float(dr.arange(mi.UInt32, 2)) + 1)


def rows(*values: Any) -> FloatArray:
    """Evaluate values of the current variant, each one number or N, as rows [len(values), N] of float32."""
    return np.stack(np.broadcast_arrays(*(np.atleast_1d(np.asarray(value, np.float32)) for value in values)))


def number(values: FloatArray) -> Any:
    """Return numbers [N] as the variant's Float; in scalar variants N is 1."""
    mi, dr = libraries()

    return mi.Float(np.ascontiguousarray(values)) if dr.is_jit_v(mi.Float) else float(values[0])


def vector(kind: Any, values: FloatArray) -> Any:
    """Return numbers [D, N] as a vector, point, colour or spectrum `kind` of D parts."""
    return kind(*(number(row) for row in values))


def matrix(transform: Any) -> NDArray[np.float64]:
    """Return a transform of any variant as float64 [4, 4]."""
    return np.array(transform.matrix, np.float64).reshape(4, 4, -1)[..., 0]


class LocalRays(NamedTuple):
    """Rays in Mitsuba's camera frame: origin [3, N] in scene units, unit direction [3, N], weight [N], 0 if blocked."""

    origin: FloatArray
    direction: FloatArray
    weight: FloatArray


@dataclass(frozen=True)
class FilmRays:
    """Rays of a camera for samples of a Mitsuba film.

    Attributes:
        camera: of our contract. grid: the whole film, turned as our pictures are.
        crop_offset, crop_size: the part that samples in [0, 1)^2 cover, as shares of the film (x, y).
        units_per_m: scene units in a metre.
    """

    camera: Camera
    grid: PixelGrid
    crop_offset: tuple[float, float] = (0.0, 0.0)
    crop_size: tuple[float, float] = (1.0, 1.0)
    units_per_m: float = 1.0

    def sample(self, position: FloatArray, aperture: FloatArray, wavelength_nm: FloatArray) -> LocalRays:
        """Return rays for film positions [2, N] and aperture samples [2, N] in [0, 1), at wavelengths [N] in nm.

        Wavelengths outside the camera's range are clipped to it: Mitsuba draws from 360 to 830 nm, where the luminance
        outside 400 to 700 nm is a few thousandths of that of white light.
        """
        count = position.shape[1]
        origin, direction = np.empty((3, count), np.float32), np.empty((3, count), np.float32)
        weight = np.empty(count, np.float32)
        accepted = self.camera.wavelength_nm
        if accepted is not None:
            wavelength_nm = np.clip(wavelength_nm, *accepted)
        for start in range(0, count, RAYS_A_CALL):
            part = slice(start, start + RAYS_A_CALL)
            film = self._film_points(position[:, part])
            pupil = np.ascontiguousarray(aperture[:, part], np.float32)
            rays = self.camera.sample(film, pupil, np.ascontiguousarray(wavelength_nm[part], np.float32))
            passed = rays.status == 0
            weight[part] = np.where(passed, rays.weight, np.float32(0))
            # Blocked samples, too, need a valid ray for the intersection test.
            direction[:, part] = np.where(passed, rays.direction * _TURNED, [[0], [0], [1]])
            origin[:, part] = np.where(passed, rays.origin_m * _TURNED, np.float32(0))
        origin *= np.float32(self.units_per_m)
        return LocalRays(origin, direction, weight)

    def _film_points(self, position: FloatArray) -> FloatArray:
        size = np.array([self.grid.width, self.grid.height], np.float32)[:, None]
        offset, part = (np.array(x, np.float32)[:, None] for x in (self.crop_offset, self.crop_size))
        return self.grid.film_points(np.zeros(position.shape[1], np.intp), (position * part + offset) * size)


def wavelength_samples(position: FloatArray, aperture: FloatArray) -> FloatArray:
    """Return uniform numbers [N] in [0, 1) for a wavefront's wavelengths, from its points [2, N] on film and aperture.

    RGB variants of Mitsuba draw no such number. These go in steps of the golden ratio from a start that the first
    points decide. A pixel's samples follow each other in a wavefront, and numbers in a row are spread almost evenly,
    which saves most of the colour noise.
    """
    first = np.ascontiguousarray(np.concatenate([position[:, :1], aperture[:, :1]]), np.float32)
    start = np.zeros(1, np.uint32)
    for value in first.view(np.uint32):
        start = hash32(start + value)
    steps = np.arange(position.shape[1], dtype=np.uint32) * np.uint32(0x9E3779B9) + start
    return (steps >> np.uint32(8)).astype(np.float32) * np.float32(2.0**-24)


def register() -> type:
    """Make the plugin known to the current variant of Mitsuba, once; returns the sensor's class.

    Raises:
        NeurolensError: Mitsuba is missing. InputError: the variant carries neither RGB nor spectra.
    """
    mi = require_mitsuba()
    variant = str(mi.variant())
    if variant not in _CLASSES:
        methods = {"__init__": _initialise, "to_string": _to_string, "sample_ray": _sample_ray}
        made = type("LensSensor", (mi.Sensor,), methods | {"sample_ray_differential": _sample_ray_differential})
        mi.register_sensor(PLUGIN, lambda props: made(props))
        _CLASSES[variant] = made
    return _CLASSES[variant]


def _initialise(self: Any, props: Any, camera: Camera | None = None) -> None:
    """Construct the plugin.

    Parameters in a scene: camera (a model, a lens file, "thin" or "pinhole"), focus_m (default inf), f_number,
    focal_length_mm, zoom, film_width_mm (default 36), film_height_mm (default: by the picture's shape), blades,
    blade_rotation_deg, blade_curvature, aperture_mask, dispersion (default "full"), units_per_m (default 1), to_world
    (of the centre of the film plane, without scale), film, sampler. From Python `camera` may be an object, which has
    its own film size in mm.
    """
    libraries()[0].Sensor.__init__(self, props)
    film = self.film()
    (width, height), crop, offset = (tuple(map(int, of())) for of in (film.size, film.crop_size, film.crop_offset))
    if camera is None:
        camera = _camera_of(props, height / width)
    units = _number_of(props, "units_per_m", 1.0)
    if not 0 < units < math.inf:
        raise InputError(PLUGIN, "units_per_m", units, "a finite number above 0")
    turn = matrix(self.world_transform())[:3, :3]
    if not np.allclose(turn.T @ turn, np.eye(3), atol=1e-4):
        expected = "a rotation and a translation; set units_per_m for scenes in other units"
        raise InputError(PLUGIN, "to_world", turn.round(4).tolist(), expected)
    self.rays = FilmRays(
        camera,
        PixelGrid(width, height, camera.film_mm),
        (offset[0] / width, offset[1] / height),
        (crop[0] / width, crop[1] / height),
        units,
    )
    self.m_needs_sample_2 = self.m_needs_sample_3 = True
    self.achromatic = bool(getattr(camera, "achromatic", False))
    low, high = camera.wavelength_nm or LIGHT_NM
    low, high = max(low, LIGHT_NM[0]), min(high, LIGHT_NM[1])
    self.hero = mode_for(camera, self.rays.grid, (low, high), FilmSettings()) == "hero"
    self.channels = None if self.achromatic or not low < high else ChannelWavelengths(low, high)


def _camera_of(props: Any, shape: float) -> Camera:
    """Make the camera that a scene's parameters describe, for a picture of `shape`, its height over its width."""
    width_mm = _number_of(props, "film_width_mm", FILM_WIDTH_MM)
    height_mm = _number_of(props, "film_height_mm", width_mm * shape)
    name = props.get("camera", None)
    if not isinstance(name, str):
        raise InputError(PLUGIN, "camera", "(missing)", "a model (.onnx), a lens file (.toml), thin or pinhole")
    mask = props.get("aperture_mask", None)
    mask = Path(_found(mask)) if isinstance(mask, str) else mask
    blades, turned, curved = (props.get(k, None) for k in ("blades", "blade_rotation_deg", "blade_curvature"))
    size = props.get("focal_length_mm", props.get("efl_mm", None))
    more = {k: props.get(k) for k in ("f_number", "zoom", "dispersion") if props.get(k, None) is not None}
    shot = Shot(
        (width_mm, height_mm), _number_of(props, "focus_m", math.inf), focal_length_mm=size,
        aperture=make_aperture(StopShape(blades, turned, curved, mask)), **more,
    )  # fmt: skip
    return make_camera(_found(name), shot)


def _number_of(props: Any, name: str, default: float) -> float:
    value = props.get(name, default)
    try:
        return float(value)
    except (TypeError, ValueError):
        raise InputError(PLUGIN, name, value, "a number") from None


def _found(name: str) -> str:
    """Find the file of that name, relative to the working folder or to the XML scene."""
    return str(libraries()[0].file_resolver().resolve(name))


def _to_string(self: Any) -> str:
    return f"LensSensor[camera = {self.rays.camera.name}, film_mm = {list(self.rays.grid.film_mm)}]"


def _sample_ray(self: Any, time: Any, sample1: Any, sample2: Any, sample3: Any, active: Any = True) -> tuple[Any, Any]:
    mi, _ = libraries()
    ray, weight = _sample_ray_differential(self, time, sample1, sample2, sample3, active)
    return mi.Ray3f(ray), weight


def _sample_ray_differential(
    self: Any, time: Any, sample1: Any, sample2: Any, sample3: Any, active: Any = True
) -> tuple[Any, Any]:
    """Return the rays of one wavefront, without differentials: nothing in Mitsuba 3 filters textures by them."""
    mi, dr = libraries()
    samples = rows(sample2.x, sample2.y, sample3.x, sample3.y)
    position, aperture = samples[:2], samples[2:]
    ray = dr.zeros(mi.RayDifferential3f)
    if mi.is_spectral:
        if not self.hero:
            sample1 = number(wavelength_samples(position, aperture))
        wavelengths, worth = self.sample_wavelengths(dr.zeros(mi.SurfaceInteraction3f), sample1, active)
        if not self.hero:
            wavelengths, worth = type(wavelengths)(wavelengths[0]), mi.Spectrum(worth[0])
        local, weights = _lanes(self, position, aperture, rows(*wavelengths))
        ray.wavelengths, weight = wavelengths, worth * vector(mi.Spectrum, weights)
    else:
        local, weights = _channels(self, position, aperture)
        weight = vector(mi.Spectrum, weights)
    to_world = self.world_transform()
    ray.o = to_world @ vector(mi.Point3f, local.origin)
    ray.d = to_world @ vector(mi.Vector3f, local.direction)
    ray.time, ray.maxt, ray.has_differentials = time, dr.inf, False
    return ray, weight


def _lanes(
    self: Any, position: FloatArray, aperture: FloatArray, wavelength_nm: FloatArray
) -> tuple[LocalRays, FloatArray]:
    """Return rays of the first lane, and weights [4, N] of all lanes along them, at wavelengths [4, N]."""
    wavelength_nm = np.broadcast_to(wavelength_nm, (len(wavelength_nm), position.shape[1]))
    local = self.rays.sample(position, aperture, wavelength_nm[0])
    weights = np.tile(local.weight, (len(wavelength_nm), 1))
    if self.hero and not self.achromatic:
        for lane in range(1, len(weights)):
            weights[lane] = self.rays.sample(position, aperture, wavelength_nm[lane]).weight
        weights *= local.weight > 0  # no lane passes where the ray does not
    return local, weights


def _channels(self: Any, position: FloatArray, aperture: FloatArray) -> tuple[LocalRays, FloatArray]:
    """Return rays of one wavelength each, and weights [3, N] of R, G and B."""
    if self.channels is None:
        local = self.rays.sample(position, aperture, np.full(position.shape[1], _MIDDLE_NM, np.float32))
        return local, np.tile(local.weight, (3, 1))
    wavelength_nm, worth = self.channels.draw(wavelength_samples(position, aperture))
    local = self.rays.sample(position, aperture, wavelength_nm)
    return local, worth * local.weight
