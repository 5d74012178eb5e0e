"""The exact lens as a camera, traced or compiled: every ray through every surface. The cameras that need torch.

Its pupil is the outline of what passes, or one of the literature's, widened until it holds that outline. Found at one
wavelength, some of them lose light (a paraxial exit pupil up to 12% of it; `python -m experiments pupils`): then
pictures would differ in brightness. Widened, they differ in the share of rays that pass, and in noise.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from typing import Any, Literal

import numpy as np
import torch
from numpy.typing import NDArray

from neurolens.base import status as st
from neurolens.base.errors import InputError
from neurolens.base.progress import Progress
from neurolens.cameras.contract import CameraRays, FilmPoints, FloatArray
from neurolens.cameras.front_aim import FrontAim, front_aim
from neurolens.cameras.fused import Compiled, FusedFilm
from neurolens.cameras.lens_film import LensFilm, LensGraph, SceneRays
from neurolens.cameras.lens_state import axial_transmittance, lens_state
from neurolens.cameras.outline_cache import kept_outline, search_key
from neurolens.cameras.pupil_boxes import PupilTable
from neurolens.cameras.pupil_outline import PupilOutline
from neurolens.cameras.pupil_search import COARSE, COARSE_TIGHT, FINE, Detail, outline_of
from neurolens.cameras.sampling import arrived, check_film, positive
from neurolens.optics import pupil_methods as known
from neurolens.optics.film_plane import PupilBounds
from neurolens.optics.focusing import best_focused
from neurolens.optics.glass import LINE_D_NM
from neurolens.optics.paraxial import chief_reach_mm, first_order
from neurolens.optics.prescription import Focus, Lens
from neurolens.optics.pupil_methods import RadialPupil
from neurolens.optics.pupils import camera_rays, passes_at_any_azimuth, pupil_bounds, pupil_plane_z_mm
from neurolens.optics.trace import Rays, film_derivatives, trace, trace_differentials
from neurolens.optics.tracegraph import exact_graph

OUTLINE = "outline"
_MAKERS: dict[str, Callable[[Lens, float], RadialPupil]] = {
    "rear-rim": known.rear_rim,
    "exit-pupil": known.global_exit_pupil,
    "wu": known.wu_exit_pupil,
    "pixel-disc": lambda lens, end: known.pixel_pupils(lens, end, "disc"),
    "pixel-ellipse": lambda lens, end: known.pixel_pupils(lens, end, "ellipse"),
    "boxes": lambda lens, end: known.radial_bounds(lens, end, "box"),
    "ellipses": lambda lens, end: known.radial_bounds(lens, end, "ellipse"),
}
PUPILS = (OUTLINE, *_MAKERS)

_HAIR = 1.001  # between the film radii at which a pupil is held against the outline
_BETWEEN = 4  # film radii of the outline between two of its rows


class ExactCamera:
    """A camera whose lens is the prescription itself.

    Args:
        lens: in the zoom state wanted.
        film_mm, focus_m, film_offset_mm: as of `build.Shot`. f_number: None keeps the lens's stop.
        wavelength_nm: range of the wavelengths; the d line stands in for a lens without known dispersion.
        dtype: precision of the trace.
        focus: how the lens is focused; see `Lens.at`. After "internal" the film, too, moves to the least spot.
        bounds: pupil bounds of a domain that holds this focus and stop; rays are then those of the domain's models for
            the same random numbers. None searches for them, over the whole film.
        pupil: how the pupil is sampled, one of `PUPILS`. All give the same picture in expectation; fewer
            rays pass through any but the outline, by which the others are widened where they would lose light.
        progress: shows the search for the outline, where it was not found before (`outline_cache`).

    Raises:
        InputError: a focus nearer than four focal lengths, a lens that no ray passes, an unknown pupil.
    """

    def __init__(
        self,
        lens: Lens,
        *,
        film_mm: tuple[float, float],
        focus_m: float,
        f_number: float | None = None,
        wavelength_nm: tuple[float, float] = (400.0, 700.0),
        dtype: Literal["float32", "float64"] = "float32",
        bounds: PupilBounds | None = None,
        focus: Focus = "best",
        pupil: str = OUTLINE,
        film_offset_mm: float = 0.0,
        progress: Progress | None = None,
    ) -> None:
        self._pid = os.getpid()
        self.film_mm = check_film(film_mm)
        self.focus_m = positive("focus_m", focus_m, infinite=True)
        self.name = lens.name
        self.dispersive = lens.dispersive
        self.wavelength_nm = wavelength_nm if self.dispersive else None
        self._range_nm = wavelength_nm
        used = wavelength_nm if self.dispersive else (LINE_D_NM, LINE_D_NM)
        self.lens = lens.at(f_number=f_number, focus_m=self.focus_m, focus=focus, wavelength_nm=used)
        if focus == "internal":
            self.lens = best_focused(self.lens, self.focus_m, used)
        film_z = self.lens.film_z_mm
        assert film_z is not None  # `at` places the film
        if film_offset_mm:
            film_z += film_offset_mm
            self.lens = replace(self.lens, film_z_mm=film_z)
        # A lens with cylinders is searched at many azimuths for one outline: coarser, for it fits none of them closely.
        detail = FINE if not self.lens.anamorphic else COARSE if bounds is None else COARSE_TIGHT
        self._film_z_mm, self._pupil_z_mm = film_z, pupil_plane_z_mm(self.lens) if bounds is None else bounds.pupil_z_mm
        self._dtype = torch.float32 if dtype == "float32" else torch.float64
        read = [dtype, self._pupil_z_mm, self.film_mm, detail, bounds and asdict(bounds)]
        key = search_key(self.lens, used, detail.wavelengths, *read)
        outline = kept_outline(key, lambda: self._outline(bounds, used, detail, progress))
        self.film = LensFilm(outline, float(film_z), used, self._scene)
        if pupil != OUTLINE:
            self.film.pupil = pupil_named(pupil, self.lens, self.film.outline, float(film_z))
        self._light_nm = used
        self._front: FrontAim | None = None
        data = first_order(self.lens)
        self.settings: dict[str, Any] = {
            "camera": "exact",
            "lens": lens.identity,
            "efl_mm": float(data.efl_mm),
            "f_number": float(data.f_number),
            "focus_m": None if math.isinf(self.focus_m) else self.focus_m,
            "film_mm": list(self.film_mm),
            "film_z_mm": float(film_z),
            "film_offset_mm": film_offset_mm,
            "stop_radius_mm": float(self.lens.stop_radius_mm),
            "focusing": focus,
            "derived": self.lens.derived,
            "rims": lens.rims,
            "aperture": self.lens.aperture and self.lens.aperture.settings(),
            "dtype": dtype,
            "pupil": pupil,
            "lens_state": state_of(self.lens, self._light_nm, float(first_order(lens).efl_mm)),
        }

    def sample(self, film_mm: FloatArray, pupil: FloatArray, wavelength_nm: FloatArray) -> CameraRays:
        """Rays for film points [2, N] in mm, pupil samples [2, N] in [0, 1) and wavelengths [N] in nm."""
        return self.film.sample(film_mm, pupil, wavelength_nm)

    def sample_differentials(self, film_mm: FloatArray, pupil: FloatArray, wavelength_nm: FloatArray) -> CameraRays:
        """As `sample`, with the differentials of the rays, carried through every surface."""
        return self.film.sample(film_mm, pupil, wavelength_nm, self._with_differentials)

    def natural(self, film_mm: FloatArray, pupil: FloatArray, wavelength_nm: FloatArray) -> FloatArray:
        """cos^4 of the angles between the axis and the rays of `sample` on the film's side."""
        return self.film.natural(film_mm, pupil, wavelength_nm)

    def to_film(self, point_m: FloatArray, pupil: FloatArray, wavelength_nm: FloatArray) -> FilmPoints:
        """Film points of scene points [3, N] in m, traced through points of the front surface chosen by `pupil`."""
        if self._front is None:
            self._front = front_aim(self.film, self.film_mm, self._light_nm, self.lens.surfaces[0])
        film_z = self.film.film_z_mm
        aim = self._front.aim(1e3 * point_m.astype(np.float64) + [[0], [0], [film_z]], pupil)
        # Light starts a millimetre before the surface, so that this is still ahead; nonsense misses it.
        rays = np.nan_to_num(np.concatenate([aim.position + aim.direction, -aim.direction]), posinf=0, neginf=0)
        with torch.no_grad():
            *light, wavelength = _tensors(self._dtype, *rays, wavelength_nm)
            done = trace(self.lens, Rays(*light), wavelength, towards="film", transmittance=True)
        assert done.transmittance is not None
        x, y, z, dx, dy, dz, through = (c.double().numpy() for c in (*done.rays, done.transmittance))
        origin = 1e-3 * (aim.position - [[0], [0], [film_z]])
        with np.errstate(all="ignore"):
            film = np.stack([x, y]) + (film_z - z) / dz * np.stack([dx, dy])
            weight = through * aim.area / (self.film.exposure * ((point_m - origin) ** 2).sum(0))
        status = np.where(aim.status == st.PASSED, done.status.numpy(), aim.status)
        return arrived(film, origin, point_m, weight, status, wavelength_nm)

    def lens_graph(self) -> LensGraph:
        """The lens as a graph."""
        graph = exact_graph(self.lens, self._pupil_z_mm, self._range_nm)
        stopped = st.blocked(self.lens.stop_index, st.RIM)
        return LensGraph(graph, float(self.lens.stop_radius_mm), self.lens.aperture, stopped)

    def for_worker(self) -> ExactCamera:
        """This camera, in a render worker. A forked process must not enter torch's thread pool: it never returns."""
        if os.getpid() != self._pid:
            torch.set_num_threads(1)
        return self

    def _outline(
        self, bounds: PupilBounds | None, wavelength_nm: tuple[float, float], detail: Detail, progress: Progress | None
    ) -> PupilOutline | None:
        progress = progress or Progress(quiet=True)
        with progress.stage(f"search the pupil of {self.name}") as report:
            if bounds is None:
                planes, corner = (self._film_z_mm, self._film_z_mm), 1.0001 * math.hypot(*self.film_mm) / 2
                rows, points = (13, 48) if self.lens.anamorphic else (17, 128)
                bounds = pupil_bounds(
                    self.lens, corner, planes, wavelength_nm, rows=rows, points=points, film_mm=self.film_mm
                )
            table = PupilTable.of(asdict(bounds))
            return outline_of(table, self._passes, wavelength_nm, detail, lambda share: report(0.2 + 0.8 * share))

    def _scene(self, film: FloatArray, pupil: FloatArray, wavelength_nm: FloatArray) -> SceneRays:
        fx, fy, px, py, wavelength = _tensors(self._dtype, *film, *pupil, wavelength_nm)
        rays = camera_rays(fx, fy, self._film_z_mm, px, py, self._pupil_z_mm)
        with torch.no_grad():
            done = trace(self.lens, rays, wavelength, transmittance=True)
        assert done.transmittance is not None
        scene = torch.stack(list(done.rays)).to(torch.float32).numpy()
        return SceneRays(scene, done.transmittance.to(torch.float32).numpy(), done.status.numpy())

    def _with_differentials(self, film: FloatArray, pupil: FloatArray, wavelength_nm: FloatArray) -> SceneRays:
        fx, fy, px, py, wavelength = _tensors(torch.float64, *film, *pupil, wavelength_nm)
        rays = camera_rays(fx, fy, self._film_z_mm, px, py, self._pupil_z_mm)
        gap = self._film_z_mm - self._pupil_z_mm
        distance = torch.sqrt((fx - px) ** 2 + (fy - py) ** 2 + gap * gap)
        moves = trace_differentials(self.lens, rays, film_derivatives(rays, distance), wavelength).derivatives
        d_film = torch.stack([torch.stack(list(m)) for m in moves], 1).to(torch.float32).numpy()
        return self._scene(film, pupil, wavelength_nm)._replace(d_film=d_film)

    def _passes(self, film: FloatArray, pupil: FloatArray, wavelength_nm: float) -> NDArray[np.bool_]:
        """Whether light passes from film points (r, 0) through pupil points; see `passes_at_any_azimuth`."""
        r, u, v = _tensors(self._dtype, film[0], *pupil)
        with torch.no_grad():
            film_z, pupil_z = self._film_z_mm, self._pupil_z_mm
            return passes_at_any_azimuth(self.lens, r, film_z, u, v, pupil_z, wavelength_nm, self.film_mm).numpy()


def _tensors(dtype: torch.dtype, *arrays: NDArray[Any]) -> list[torch.Tensor]:
    return [torch.from_numpy(np.ascontiguousarray(a)).to(dtype) for a in arrays]


class FusedExactCamera(Compiled, ExactCamera):
    """A prescription as a compiled camera: the rays of `ExactCamera` to rounding.

    Args and attributes are those of `ExactCamera`, whose `dtype` is float32 here; for differentials see `FusedFilm`.

    Raises:
        InputError: as `ExactCamera`; no C compiler.
    """

    def __init__(self, lens: Lens, **kwargs: Any) -> None:
        super().__init__(lens, **kwargs)
        self._fused = FusedFilm(self.film, self.lens_graph(), self.film_mm)
        self.settings |= {"runtime": "fused"}


def state_of(lens: Lens, wavelength_nm: tuple[float, float], nominal_mm: float | None = None) -> dict[str, Any]:
    """The table `lens_state` of a lens that `at` has placed; `nominal_mm` is its focal length at infinity."""
    data, film_z = first_order(lens), lens.film_z_mm
    assert film_z is not None

    def along_the_axis(film: FloatArray, _pupil: FloatArray, nanometres: FloatArray) -> SceneRays:
        x, y, light = (torch.from_numpy(a).double() for a in (*film, nanometres))
        ones = torch.ones_like(x)
        done = trace(lens, Rays(x, y, film_z * ones, 0 * x, 0 * x, -ones), light, transmittance=True)
        assert done.transmittance is not None
        return SceneRays(torch.stack(list(done.rays)).numpy(), done.transmittance.numpy(), done.status.numpy())

    with torch.no_grad():
        through = axial_transmittance(along_the_axis, wavelength_nm)
    return lens_state(
        nominal_mm=nominal_mm,
        efl_mm=data.efl_mm,
        pinhole_mm=chief_reach_mm(lens),
        entrance_pupil_mm=film_z - data.entrance_pupil_z_mm,
        f_number=data.f_number,
        transmittance=through,
        squeeze=abs(data.efl_mm / first_order(lens, meridian="x").efl_mm) if lens.anamorphic else 1.0,
    )


def placed_settings(lens: Lens, film_mm: tuple[float, float], focus_m: float) -> dict[str, Any]:
    """What the settings of an exact camera say of lens and film, of a lens that `at` has placed, without a camera."""
    nominal = None if lens.infinity_mm else float(first_order(lens).efl_mm)
    return {
        "camera": "exact",
        "lens": lens.identity,
        "focus_m": None if math.isinf(focus_m) else focus_m,
        "film_mm": list(film_mm),
        "lens_state": state_of(lens, (400.0, 700.0), nominal),
    }


@dataclass(frozen=True)
class HeldPupil:
    """A pupil on a plane of its own, sampled as the outline is, on the outline's plane.

    Attributes:
        pupil: what is sampled. film_z_mm, plane_z_mm: of the film, and of the plane that points are wanted on.
    """

    pupil: RadialPupil
    film_z_mm: float
    plane_z_mm: float

    def sample(
        self, film_mm: FloatArray, square: FloatArray, wavelength_nm: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """As `PupilOutline.sample`; every wavelength has the same pupil."""
        finite = np.isfinite(film_mm).all(0)
        film = np.where(finite, film_mm, np.float32(0)).astype(np.float64)
        points, area = self.pupil.sample(film, square.astype(np.float64))
        stretch = (self.film_z_mm - self.plane_z_mm) / (self.film_z_mm - self.pupil.pupil_z_mm)
        held = (film + stretch * (points - film)).astype(np.float32)
        return held, (area * stretch**2 * finite).astype(np.float32)


def pupil_named(name: str, lens: Lens, outline: PupilOutline, film_z_mm: float) -> HeldPupil:
    """One of `PUPILS` other than the outline, for a focused lens.

    Raises:
        InputError: an unknown name, or a paraxial exit pupil at infinity.
    """
    if name not in _MAKERS:
        raise InputError("camera", "pupil", name, f"one of: {', '.join(PUPILS)}")
    found = _MAKERS[name](lens, outline.film_radius_mm)
    return HeldPupil(_holding(found, outline, film_z_mm), film_z_mm, outline.pupil_z_mm)


def _holding(pupil: RadialPupil, outline: PupilOutline, film_z_mm: float) -> RadialPupil:
    """The pupil with each of its shapes enlarged about its centre until it holds the outline at its film radii."""
    radius, x, y = _corners(outline)
    stretch = (film_z_mm - pupil.pupil_z_mm) / (film_z_mm - outline.pupil_z_mm)
    x, y = radius[:, None] + stretch * (x - radius[:, None]), stretch * y
    count = pupil.centre.size
    place = radius / pupil.film_radius_mm * count
    centre, along, across = pupil.centre.copy(), pupil.along.copy(), pupil.across.copy()
    for row in range(count):
        # The ends of the interval belong to it, and their nearest radii of the outline on either side.
        inside = np.flatnonzero((place >= row) & (place <= row + 1))
        first, last = np.searchsorted(place, [row, row + 1])
        rows = np.unique(np.clip(np.concatenate([inside, [first - 1, last]]), 0, radius.size - 1))
        u, v = x[rows], np.abs(y[rows])
        if along[row] <= 0 or across[row] <= 0:  # no ray was found, where the outline holds some
            centre[row] = (u.max() + u.min()) / 2
            along[row], across[row] = max((u.max() - u.min()) / 2, 1e-9), max(float(v.max()), 1e-9)
        u, v = np.abs(u - centre[row]) / along[row], v / across[row]
        reach = np.maximum(u, v) if pupil.shape == "box" else np.hypot(u, v)
        scale = max(_HAIR * float(reach.max()), 1.0)
        along[row], across[row] = along[row] * scale, across[row] * scale
    return replace(pupil, centre=centre, along=along, across=across)


def _corners(outline: PupilOutline) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Film radii [R'] and corners x, y [R', V] of the outline there, all its wavelengths together."""
    last = outline.centre.size - 1
    place = np.linspace(0, last, last * _BETWEEN + 1)
    row = np.minimum(place.astype(int), last - 1)
    step = (place - row)[:, None, None]
    x, y = (c.transpose(1, 0, 2).astype(np.float64) for c in (outline.centre[None, :, None] + outline.x, outline.y))
    x, y = ((1 - step) * c[row] + step * c[row + 1] for c in (x, y))
    return outline.radii(place), x.reshape(place.size, -1), y.reshape(place.size, -1)
