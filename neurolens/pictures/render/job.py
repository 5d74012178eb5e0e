"""One render: the wavelengths of its paths, a pass of a tile, the film developed into a picture, and its identity."""

import ctypes
import json
import math
import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass, fields, replace
from functools import cache
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from neurolens import __version__
from neurolens.base.errors import InputError, note
from neurolens.base.settings import LIGHT_NM
from neurolens.cameras.contract import RAYS_A_CALL, Camera, FloatArray
from neurolens.cameras.reduced import film_shift
from neurolens.graph.compiler import c_source, has_compiler, load_compiled
from neurolens.optics.lens.shot import Shot
from neurolens.pictures.render import film as columns
from neurolens.pictures.render.colour import (
    SRGB,
    Array,
    Index,
    SpectralRange,
    Spectrum,
    balance,
    converted,
    illuminant,
)
from neurolens.pictures.render.film import Film, PixelGrid, Spill, Tiling, digest
from neurolens.pictures.render.integrator import Paths, trace
from neurolens.pictures.render.lights import sun_spectrum, total_spectrum
from neurolens.pictures.render.sampler import FILM, PUPIL, WAVELENGTH, Sampler, centres
from neurolens.pictures.render.scene import CameraSettings, Scene
from neurolens.pictures.render.scenetables import Vector
from neurolens.pictures.render.settings import FilmSettings
from neurolens.pictures.render.world import world_of

Seconds = NDArray[np.float64]
# The largest luminance of a sample; sums of colours up to a million times as bright stay within float32.
_BRIGHTEST_SAMPLE = 1e30
LANES = 4  # wavelengths of a hero path
_FINE = 1024  # wavelengths at which the light of a scene is summed
_PROBES, _PROBED_WAVELENGTHS = 1024, 5
_LITTLE_PX = 0.05  # pixels; a smaller shift is hidden by the pixel filter, a box one pixel wide


class _Grid(ctypes.Structure):
    _fields_ = [  # noqa: RUF012
        *((name, ctypes.c_int) for name in ("width", "height", "lateral")),
        *((name, ctypes.c_float) for name in ("film_x", "film_y")),
    ]


@cache
def _light_of_tile(bins: int) -> Any:
    """Return the function of `spill.c`, compiled once."""
    known = {
        "LANES": LANES,
        "BINS": bins,
        "SAMPLES": columns.SAMPLES_A_PASS,
        "BRIGHTEST": f"{_BRIGHTEST_SAMPLE:g}f",
        **{name: getattr(columns, name) for name in ("LUMINANCE2", "DROPPED", "COLUMNS")},
    }
    call = load_compiled(c_source("pictures/render/spill.c", **known)).light_of_tile
    call.argtypes, call.restype = [*[ctypes.c_size_t] * 5, *[ctypes.c_void_p] * 8], None
    return call


class LensRays(NamedTuple):
    """Camera rays in the scene.

    Attributes:
        origin, direction: [3, N]. weight: [lanes, N].
        places: [lanes, 2, N] film points, where wavelengths have their own.
    """

    origin: FloatArray
    direction: FloatArray
    weight: FloatArray
    places: FloatArray | None = None


def camera_axes(settings: CameraSettings) -> FloatArray:
    """Return the rotation [3, 3] from camera to scene axes, with the columns right, up, backwards."""
    backwards = np.subtract(settings.position_m, settings.look_at_m)
    backwards = backwards / np.linalg.norm(backwards)
    right = np.cross(settings.up, backwards)
    right = right / np.linalg.norm(right)
    return np.column_stack([right, np.cross(backwards, right), backwards]).astype(np.float32)


class Job:
    """One render: a scene made ready for the workers, and the film.

    Attributes:
        scene, camera, grid, seed, max_depth, settings: as requested; `settings` are those of the film.
        mode: "one" wavelength a path, "hero" for several that share film points, or "companions", which have their own.
        balance: matrix [3, 3] on the film's linear sRGB that makes the light of the white balance neutral; where there
            is none, `neutral`. luminance_row: [3], of the film's sRGB after that.
        rows: of the part of the picture that is rendered, the first row and the one after the last.
        own: the pixels of these rows among those of the tiles, which may begin before them and end after them.
        film: see `Film`.
    """

    def __init__(
        self,
        scene: Scene,
        camera: Camera,
        grid: PixelGrid,
        samples: int,
        seed: int,
        max_depth: int,
        settings: FilmSettings,
        rows: tuple[int, int] | None = None,
    ) -> None:
        self.scene, self.camera, self.grid = scene, camera, grid
        self.seed, self.max_depth, self.settings = seed, max_depth, settings
        pose = scene.settings.camera
        self.mode = mode_for(camera, grid, pose.wavelength_nm, settings)
        self.spectral = spectral_range(scene, camera, settings, 1 if self.mode == "one" else LANES)
        self.world = world_of(scene, self.spectral)
        white = settings.white_balance if self.spectral.colours else None
        self.neutral, self.balance = white is None, np.eye(3)
        if white is not None:
            self.balance = balance(self.spectral.film_rgb(self.world.palette.illuminant(white)))
        self._response = self.spectral.rotated(self.spectral.response)  # [lanes, 3, bins]
        self.luminance_row = SRGB.to_xyz[1] @ self.balance
        tables = (self._response, self.spectral.rotated(self.spectral.basis))  # [lanes, 3, bins]
        table = np.stack(
            [np.concatenate([t, np.einsum("c,lcb->lb", self.luminance_row, t)[:, None]], 1) for t in tables]
        )
        self._bins = np.ascontiguousarray(table.transpose(3, 0, 1, 2), np.float32)  # in the order of `spill.c`
        tints = getattr(camera, "tints", None)
        light = None if tints is None else self.spectral.rotated(tints(self.spectral.centres_nm))
        self._tints: FloatArray | None = None
        if light is not None:
            self._tints = np.where(light[0] > 0, light / np.maximum(light[0], 1e-30), 0).astype(np.float32)
        self.sampler = Sampler(samples, seed)
        self._axes, self._position = camera_axes(pose), np.array(pose.position_m, np.float32)
        self.rows = rows or (0, grid.height)
        first, stop = (row * grid.width for row in self.rows)
        near = self._near = self._reach()  # samples at most so far from the job's rows have companions in them
        tiling = Tiling.of(grid.width * grid.height, samples)
        self.tiling = tiling.around(max(first - near, 0), min(stop + near, tiling.pixels))
        self.own = slice(first - self.tiling.start, stop - self.tiling.start)
        self.film = Film(self.tiling)

    def _reach(self) -> int:
        """Return the largest difference between the pixel numbers of a companion and of its hero."""
        if self.mode != "companions":
            return 0
        reach_mm = self.camera.companion_reach_mm  # type: ignore[attr-defined]
        sides = zip(reach_mm, (self.grid.width, self.grid.height), self.grid.film_mm, strict=True)
        columns, rows = (math.ceil(reach * count / length) + 1 for reach, count, length in sides)
        return rows * self.grid.width + columns

    def ready(self) -> None:
        """Compile what all workers run, before they are forked: each would compile it for itself."""
        several = self.mode == "companions"
        if several:
            _light_of_tile(self.spectral.bins)
        if ready := getattr(getattr(self.camera, "camera", self.camera), "ready", None):
            ready(self.spectral.lanes if several else 1)

    def picture_settings(self) -> dict[str, Any]:
        """Return the settings besides scene and camera that decide the picture, for its metadata and its checkpoint."""
        settings = asdict(self.settings)
        del settings["colour_space"]  # which concerns the file alone
        size = {"width": self.grid.width, "height": self.grid.height}
        return {**size, "seed": self.seed, "max_depth": self.max_depth, **settings}

    def render_tile(self, which: tuple[int, int]) -> tuple[NDArray[np.float64], Spill | None, Seconds]:
        """Render one pass of one tile.

        Returns the sums [pixels, columns], the light that belongs to other pixels, and the seconds [2] spent in the
        camera and in all.
        """
        began, (tile, part) = time.perf_counter(), which
        within = self.tiling.pixels_of(tile)
        step = self.tiling.step
        pixels = np.arange(within.start, within.stop) + self.tiling.start
        indices = np.arange(part * step, min((part + 1) * step, self.tiling.samples))
        pixel, sample = np.repeat(pixels, len(indices)), np.tile(indices, len(pixels))
        keys = self.sampler.keys(pixel, sample)
        hue = self.sampler.draw(keys, WAVELENGTH)
        place, side = self.sampler.draw2(keys, FILM), np.float32(math.sqrt(self.settings.fill_factor))
        film_mm = self.grid.film_points(pixel, place if side == 1 else 0.5 + side * (place - np.float32(0.5)))
        pupil = self.sampler.draw2(keys, PUPIL)

        called = time.perf_counter()
        lens = self._hero_rays(film_mm, pupil, hue)
        answered = time.perf_counter()

        bins, distance = self.spectral.bin_of(hue), np.full(len(hue), np.inf, np.float32)
        shared = None
        if lens.places is not None:
            shared = (lens.weight > 0).sum(axis=0, dtype=np.uint8).astype(np.float32)
        paths = Paths.of(lens.origin, lens.direction, lens.weight, bins, shared)
        value = trace(self.world, self.sampler, keys, paths, self.max_depth, first_distance=distance)
        sums = np.empty((len(pixels), columns.COLUMNS))
        spill = self._sum_light(sums, value, bins, lens, within)
        self._sum_depth(sums, lens.origin, lens.direction, distance)
        sums[:, columns.PASSED] = np.count_nonzero(lens.weight[0].reshape(len(pixels), -1), axis=1)
        return sums, spill, np.array([answered - called, time.perf_counter() - began])

    def _sum_light(
        self, sums: NDArray[np.float64], value: FloatArray, bins: Index, lens: LensRays, tile: slice
    ) -> Spill | None:
        """Add the colours and each sample's squared luminance to the sums; return companions' light, of any pixel.

        A path whose light is not finite, or too large for any sum, is counted and adds nothing: one alone would spoil
        its pixel, and with it the whole file.
        """
        if lens.places is not None:
            return self._spill(sums, value, bins, lens, tile)
        response = self._response.take(bins, axis=-1, mode="clip")
        light = np.einsum("lcn,ln->cn", response, np.ascontiguousarray(value))
        luminance = self.luminance_row.astype(np.float32) @ light
        dropped = ~(np.abs(luminance) <= _BRIGHTEST_SAMPLE)
        if dropped.any():
            light[:, dropped] = luminance[dropped] = 0
        shape = (len(sums), len(bins) // len(sums))
        sums[:, columns.DROPPED] = np.count_nonzero(dropped.reshape(shape), axis=1)
        sums[:, columns.LUMINANCE2] = np.square(luminance, dtype=np.float64).reshape(shape).sum(axis=1)
        sums[:, columns.RGB] = light.reshape(3, *shape).sum(axis=2).T
        return None

    def _spill(self, sums: NDArray[np.float64], value: FloatArray, bins: Index, lens: LensRays, tile: slice) -> Spill:
        """Add the tile's light to its sums (`spill.c`); return the companions' light at the pixels where it arrives."""
        start = tile.start + self.tiling.start
        first = max(start - self._near, 0)
        stop = min(start + len(sums) + self._near, self.grid.width * self.grid.height)
        spill, lateral = np.zeros((stop - first, 4)), bool(getattr(self.camera, "lateral", False))
        grid = _Grid(self.grid.width, self.grid.height, lateral, *self.grid.film_mm)
        arrays = [np.ascontiguousarray(a) for a in (self._bins, bins, value.T, lens.weight, lens.places)]
        size = len(sums), len(bins) // len(sums), start, first, len(spill)
        pointers = (a.ctypes.data for a in (*arrays, sums, spill))
        _light_of_tile(self.spectral.bins)(*size, ctypes.byref(grid), *pointers)
        return Spill(first, spill[:, :3])

    def _sum_depth(
        self, sums: NDArray[np.float64], origin: FloatArray, direction: FloatArray, distance: FloatArray
    ) -> None:
        """Add the distances, along the optical axis from the film's plane, of what camera rays hit first."""
        hit, shape = np.isfinite(distance), (len(sums), -1)
        away = -self._axes[:, 2]
        with np.errstate(over="ignore", invalid="ignore"):  # rays that do not pass have arbitrary values
            depth = away @ (origin - self._position[:, None])
            depth += distance * (away @ direction)
        hit &= np.isfinite(depth)
        sums[:, columns.DEPTH] = np.where(hit, depth, np.float32(0)).reshape(shape).sum(axis=1, dtype=np.float64)
        sums[:, columns.HITS] = np.count_nonzero(hit.reshape(shape), axis=1)

    def _hero_rays(self, film_mm: FloatArray, pupil: FloatArray, hue: FloatArray) -> LensRays:
        """Return rays of the hero wavelengths, with the weights of all lanes."""
        lanes = self.spectral.lanes
        nm = self._camera_wavelengths(hue, lanes if self._tints is None or self.mode == "companions" else 1)
        if self.mode == "companions":
            return self._camera_rays(film_mm, pupil, nm)
        hero = self._camera_rays(film_mm, pupil, nm[:1])
        weight = np.repeat(hero.weight, lanes, axis=0)
        if self._tints is not None:  # nothing but the tints depends on the wavelength
            weight *= self._tints.take(self.spectral.bin_of(hue), axis=-1)
        elif self.camera.dispersive or not getattr(self.camera, "achromatic", False):
            for lane in range(1, lanes):
                weight[lane] = self._camera_rays(film_mm, pupil, nm[lane : lane + 1]).weight
            weight *= hero.weight > 0  # no lane passes where the hero's ray does not
        weight /= lanes
        return hero._replace(weight=weight)

    def _camera_rays(self, film_mm: FloatArray, pupil: FloatArray, wavelength_nm: FloatArray) -> LensRays:
        """Return rays in the scene for wavelengths [lanes, N]; their weight is 0 where they do not pass."""
        at_once, parts = getattr(self.camera, "rays_a_call", RAYS_A_CALL), list[LensRays]()
        for start in range(0, film_mm.shape[1], at_once):
            part = slice(start, start + at_once)
            film, square, nm = (np.ascontiguousarray(x[:, part]) for x in (film_mm, pupil, wavelength_nm))
            if len(nm) == 1:
                rays, places = self.camera.sample(film, square, nm[0]), None
                weight = np.where(rays.status == 0, rays.weight, np.float32(0))[None]
            else:
                found = self.camera.sample_spectrum(film, square, nm)  # type: ignore[attr-defined]
                rays, weight, places = found.rays, found.weight, found.film_mm
            origin = self._axes @ rays.origin_m
            origin += self._position[:, None]
            parts.append(LensRays(origin, self._axes @ rays.direction, weight, places))
        if len(parts) == 1:
            return parts[0]
        each = zip(*parts, strict=True)
        joined: list[Any] = [None if some[0] is None else np.concatenate(some, axis=-1) for some in each]
        return LensRays(*joined)

    def _camera_wavelengths(self, hue: FloatArray, lanes: int) -> FloatArray:
        """Return wavelengths [lanes, N] for the camera; where it does not disperse, they are clipped to its range."""
        wavelengths = self.spectral.wavelengths_nm(hue, lanes)
        accepted = self.camera.wavelength_nm
        if accepted is not None:
            np.clip(wavelengths, accepted[0], accepted[1], out=wavelengths)
        return wavelengths


# What layers mean, for the metadata of a picture.
MEANING = {
    "samples": "samples in the pixel",
    "variance": "of the pixel's luminance (linear sRGB), from its samples as if they were independent; inf: below two",
    "depth": "channel Z: m along the optical axis from the film's plane to the first surface, mean; inf: none",
    "blocked": "share of the samples whose camera ray did not pass",
}


@dataclass(frozen=True)
class Layers:
    """Additional channels of a picture, [H, W] float32 each.

    Attributes:
        samples, depth, blocked: see `MEANING`; what is in focus is at depth `focus_m`.
        variance: of the pixel's mean luminance (of linear sRGB after the white balance): the variance of its samples
            over their number, as if they were independent. Low-discrepancy samples have less. Below two samples it is
            infinite.
    """

    samples: FloatArray
    variance: FloatArray
    depth: FloatArray
    blocked: FloatArray


def develop(job: Job) -> tuple[FloatArray, Layers]:
    """Make the job's rows of the picture, [H, W, 3] float32 linear sRGB, and their layers; workers may still run.

    Each tile is divided by the samples that it has so far.
    """
    tiling, grid = job.tiling, job.grid
    rgb = np.zeros((tiling.pixels, 3), np.float32)
    planes = np.zeros((4, tiling.pixels), np.float32)
    for first, stop in tiling.chunks():
        sums, done = job.film.copy(first, stop)
        part = tiling.pixels_of(first, stop)
        samples = np.repeat(tiling.samples_done(done), tiling.tile)[: len(sums)]
        colour = sums[:, columns.RGB] / np.maximum(samples, 1)[:, None]
        rgb[part] = colour if job.neutral else converted(colour, job.balance)
        planes[:, part] = _layers(job, sums, samples)
    shape = (job.rows[1] - job.rows[0], grid.width)
    return rgb[job.own].reshape(*shape, 3), Layers(*(plane[job.own].reshape(shape) for plane in planes))


def _layers(job: Job, sums: NDArray[np.float64], samples: NDArray[np.int64]) -> FloatArray:
    """Return samples, variance, depth and blocked share [4, n]; what float32 does not hold is infinite."""
    total = converted(sums[:, columns.RGB], job.luminance_row[None])[:, 0]
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        spread = np.maximum(sums[:, columns.LUMINANCE2] - total**2 / samples, 0) / (samples - 1)
        variance = np.where(samples > 1, spread / samples, np.inf)
        depth = np.where(sums[:, columns.HITS] > 0, sums[:, columns.DEPTH] / sums[:, columns.HITS], np.inf)
        blocked = np.where(samples > 0, 1 - sums[:, columns.PASSED] / samples, 0.0)
        return np.stack([samples, variance, depth, blocked]).astype(np.float32)


def spectral_range(scene: Scene, camera: Camera, film: FilmSettings, lanes: int = 1) -> SpectralRange:
    """Return the scene's wavelengths, in bins by importance; InputError where a dispersive camera lacks some."""
    settings = scene.settings.camera
    low, high = settings.wavelength_nm
    accepted = camera.wavelength_nm
    if camera.dispersive and accepted is not None and not (accepted[0] <= low and high <= accepted[1]):
        expected = f"within the {accepted[0]:g}-{accepted[1]:g} nm of camera {camera.name}"
        raise InputError("scene", "camera.wavelength_nm", settings.wavelength_nm, expected)
    light = expected_light(scene) if film.wavelength_sampling == "importance" else None
    return SpectralRange(low, high, light=light, lanes=lanes)


def expected_light(scene: Scene) -> Spectrum:
    """Estimate the spectrum (nm, radiance relative to D65) of a scene's light; surroundings count as all lamps."""
    fine = SpectralRange(*scene.settings.camera.wavelength_nm, _FINE)
    lamps: dict[str, Array] = {}  # sums of emission by illuminant
    for name, emission, area in _lamps(scene):
        lamps[name] = lamps.get(name, 0.0) + area * np.array(emission)
    around = scene.settings.environment
    bands = [b for b in (around.colour, around.zenith, around.horizon, around.ground) if b is not None]
    if scene.environment is not None:
        bands = list(scene.environment.mean(axis=0, dtype=np.float64))

    total = np.zeros(_FINE)
    for group in (lamps, {around.illuminant: np.sum(bands, axis=0)}):
        light = np.zeros(_FINE)
        for name, rgb in group.items():
            found = illuminant(name, scene.illuminants)
            assert found is not None  # names are checked where scenes are read
            light += fine.relative(*found) * fine.spectrum(rgb)
        if light.any():
            total += light / light.mean()
    if (sky := scene.settings.sky) is not None:
        upper = centres(32, 16)
        sources = [total_spectrum(sky, upper[:, upper[1] > 0]), *([sun_spectrum(sky)[:2]] if sky.sun else [])]
        for spectrum in sources:
            shine = fine.relative(*spectrum)
            total += shine / shine.mean()
    return fine.centres_nm, total if total.any() else np.ones(_FINE)


def _lamps(scene: Scene) -> Iterator[tuple[str, Vector, float]]:
    """Yield illuminant, emission and area of the lamps; those without size get the area that gives their flux."""
    settings = scene.settings
    for quad in settings.quads:
        yield quad.illuminant, quad.emission, float(np.linalg.norm(np.cross(quad.edge_u_m, quad.edge_v_m)))
    for disc in settings.discs:
        yield disc.illuminant, disc.emission, np.pi * disc.radius_m**2
    for sphere in settings.spheres:
        yield sphere.illuminant, sphere.emission, 4 * np.pi * sphere.radius_m**2
    for point in settings.points:
        yield point.illuminant, point.intensity, 4.0
    for spot in settings.spots:
        middle = np.radians(0.5 * (spot.inner_deg + spot.outer_deg))
        yield spot.illuminant, spot.intensity, 2 * (1 - float(np.cos(middle)))


def mode_for(
    camera: Camera, grid: PixelGrid, limits_nm: tuple[float, float], film: FilmSettings
) -> Literal["one", "hero", "companions"]:
    """Choose how paths carry wavelengths: see `Job`.

    A `Note` says so where one wavelength a path is all that can be had.

    Raises:
        InputError: the settings ask for "hero", and the camera disperses but cannot place companions in whole pixels,
            or there is no C compiler for the sums of their light.
    """
    if film.wavelengths == "one":
        return "one"
    shift = dispersion_px(camera, grid, limits_nm) if camera.dispersive else 0.0
    if shift <= _LITTLE_PX:
        return "hero"
    placed = film.fill_factor == 1 and getattr(camera, "companion_reach_mm", None) is not None
    if placed and has_compiler():
        return "companions"
    why = f"camera {camera.name} moves its picture by {shift:.2g} pixels with the wavelength"
    why = "there is no C compiler" if placed else why
    if film.wavelengths == "hero":
        raise InputError("render", "film.wavelengths", "hero", f"one: {why}")
    follows = "" if placed or film.fill_factor != 1 else ", which no polynomial follows"
    note(f"one wavelength a path, which is noisier: {why}{follows}")
    return "one"


def dispersion_px(camera: Camera, grid: PixelGrid, limits_nm: tuple[float, float]) -> float:
    """Return by how many pixels the camera's picture shifts with the wavelength.

    It is the RMS, over film and pupil, of the shift between the middle wavelength and the one of five that shifts most.
    """
    low, high = limits_nm
    random = np.random.default_rng(0)
    film = (random.random((2, _PROBES)) - 0.5) * np.array(grid.film_mm)[:, None]
    pupil = random.random((2, _PROBES, 1))
    step = grid.film_mm[0] / grid.width, grid.film_mm[1] / grid.height
    worst = 0.0
    for nm in np.linspace(low, high, _PROBED_WAVELENGTHS):
        shift = film_shift(camera, film, pupil, float(nm), 0.5 * (low + high), step) / np.array(step)[:, None]
        length = (shift**2).sum(axis=0)
        worst = max(worst, float(np.sqrt(np.nanmean(length))) if np.isfinite(length).any() else 0.0)
    return worst


# Settings of a camera that do not affect its rays: where it was read and notes.
_NO_MATTER = ("model", "notes")
_SCENES = ("film_mm", "wavelength_nm", "aperture", "clamp_f_number")  # of a shot's settings, those of its scene


def identity(job: Job) -> dict[str, Any]:
    """Everything that the sums of a film depend on, except the number of samples.

    The scene is its tables, textures and meshes; the camera its settings and its results for some rays.
    """
    scene, camera = job.scene, job.camera
    # These are given separately, and may differ from the scene's.
    asked: dict[str, Any] = {f.name: f.default for f in fields(Shot) if f.name not in _SCENES}
    common = replace(scene.settings.camera, width=1, height=1, samples=1, max_depth=1, **asked)
    bare = replace(scene, name="", settings=replace(scene.settings, camera=common, film=FilmSettings(), sensor=None))
    kept = {key: value for key, value in camera.settings.items() if key not in _NO_MATTER}
    identity = {
        "neurolens": __version__,
        "scene": digest(bare),
        "camera": {"name": camera.name, **kept, "rays": _rays(job)},
        "film_mm": list(job.grid.film_mm),
        **job.picture_settings(),
    }
    return json.loads(json.dumps(identity, default=str))


def _rays(job: Job) -> str:
    """Return a digest of the camera's rays of a fixed set of samples, of as many wavelengths as the job's."""
    camera, random = job.camera, np.random.default_rng(0)
    film = ((random.random((2, _PROBES)) - 0.5) * np.array(camera.film_mm)[:, None]).astype(np.float32)
    low, high = camera.wavelength_nm or LIGHT_NM
    nm = np.linspace(low, high, _PROBES).astype(np.float32)
    square = random.random((2, _PROBES), np.float32)
    if job.mode == "companions":
        rays = camera.sample_spectrum(film, square, np.tile(nm, (job.spectral.lanes, 1))).rays  # type: ignore[attr-defined]
    else:
        rays = camera.sample(film, square, nm)
    passed = rays.status == 0
    return digest([rays.status, *(np.where(passed, p, 0) for p in (rays.origin_m, rays.direction, rays.weight))])
