"""The exact lens as a camera, traced by torch or compiled to C: every ray passes through every surface.

These are the only cameras that need torch. They sample the outline of the light that passes the lens.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import asdict
from functools import cache, cached_property
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from numpy.typing import NDArray

from neurolens.base import status as st
from neurolens.base.files import fingerprint_of, kept_in_cache, sha256_of
from neurolens.base.progress import Progress
from neurolens.cameras.cameragraph import D_FILM, METRES, LensGraph
from neurolens.cameras.companions import lanes_graph, shifted
from neurolens.cameras.contract import FloatArray
from neurolens.cameras.lenscamera import GraphRun, Kind, LensCamera, LensFilm, Runtime, SceneRays, axial_transmittance
from neurolens.cameras.pupil_outline import (
    COARSE,
    FINE,
    Detail,
    PupilOutline,
    PupilTable,
    outline_of,
    wavelength_between,
)
from neurolens.cameras.sampling import lens_state
from neurolens.graph.interpret import evaluate
from neurolens.graph.ir import Graph
from neurolens.graph.loworder import with_film_derivatives
from neurolens.lens.glass import LINE_D_NM, check_light, index_of
from neurolens.lens.paraxial import PupilBounds, chief_reach_mm, first_order
from neurolens.lens.prescription import Lens, Surface
from neurolens.lens.shot import Shot
from neurolens.setting.focusing import at_infinity
from neurolens.setting.pupils import camera_rays, passes_at_any_azimuth, pupil_bounds, pupil_plane_z_mm
from neurolens.setting.states import set_lens
from neurolens.surrogates.assemble import SCALARS, Form
from neurolens.trace.aiming import without_rims
from neurolens.trace.rays import Rays, trace
from neurolens.trace.surfaces import media
from neurolens.trace.tracegraph import exact_graph, light_limits


class ExactCamera(LensCamera):
    """A camera whose lens is the prescription itself.

    Args:
        lens: as its file has it, or in a zoom state.
        shot: the settings of the camera; the d line stands in for the light of a lens without known dispersion.
        dtype: precision of the trace.
        bounds: pupil bounds of a domain that holds this focus and stop; rays are then those of the domain's models for
            the same random numbers. None searches for them, over the whole film.
        progress: shows the search for the outline, where no run has kept it (`kept_outline`).
        runtime: what runs the camera. Only "trace" can compute in float64.

    Raises:
        InputError: a focus nearer than four focal lengths, a lens that no ray passes, light of no known index.
    """

    def __init__(
        self,
        lens: Lens,
        shot: Shot,
        *,
        dtype: Literal["float32", "float64"] = "float32",
        bounds: PupilBounds | None = None,
        progress: Progress | None = None,
        runtime: Runtime = "trace",
    ) -> None:
        self.film_mm, self.path, self.name = shot.film_mm, Path(lens.path), lens.name
        self.dispersive = lens.dispersive
        self.wavelength_nm = shot.wavelength_nm if self.dispersive else None
        self._range_nm = shot.wavelength_nm
        used = shot.wavelength_nm if self.dispersive else (LINE_D_NM, LINE_D_NM)
        for nm in used:
            check_light(lens, nm)
        self.lens = set_lens(lens, shot)
        film_z, tabled = self.lens.film_z_mm, at_infinity(self.lens)
        assert film_z is not None  # `set_lens` places the film
        # A lens with cylinders is searched at many azimuths for one outline: coarser, for it fits none of them closely.
        detail = COARSE if self.lens.anamorphic else FINE
        self._film_z_mm, self._pupil_z_mm = film_z, pupil_plane_z_mm(self.lens) if bounds is None else bounds.pupil_z_mm
        self._dtype = torch.float32 if dtype == "float32" else torch.float64
        read = [dtype, self._pupil_z_mm, self.film_mm, detail, bounds and asdict(bounds)]
        key = search_key(self.lens, used, detail.wavelengths, *read)
        outline = kept_outline(key, lambda: self._outline(bounds, used, detail, progress))
        self.film = LensFilm(outline, float(film_z), used, self._scene)
        self._light_nm = used
        data = first_order(self.lens)
        self.settings: dict[str, Any] = {
            "camera": "exact",
            "lens": tabled.identity,
            "efl_mm": float(data.efl_mm),
            "f_number": float(data.f_number),
            "focus_m": None if math.isinf(shot.focus_m) else shot.focus_m,
            "film_mm": list(self.film_mm),
            "film_z_mm": float(film_z),
            "film_offset_mm": shot.film_offset_mm,
            "stop_radius_mm": float(self.lens.stop_radius_mm),
            "focus_mode": shot.focus_mode,
            "zoom": shot.zoom,
            "derived": self.lens.derived,
            "rims": lens.rims,
            "aperture": self.lens.aperture and self.lens.aperture.settings(),
            "dtype": dtype,
            "lens_state": state_of(self.lens, self._light_nm, float(first_order(tabled).efl_mm)),
        }
        self.start(runtime)

    def _run(self, kind: Kind, companions: int = 0) -> GraphRun:
        if self.runtime != "trace":
            return super()._run(kind, companions)
        own: dict[Kind, GraphRun] = {"hero": self._hero, "companion": self._companion, "differentials": self._moved}
        return own.get(kind, self._traced)

    def _traced(self, rays: dict[str, FloatArray]) -> dict[str, NDArray[Any]]:
        return self.film.outputs(rays["film_mm"], rays["square"], rays["wavelength_nm"][0])

    def _moved(self, rays: dict[str, FloatArray]) -> dict[str, NDArray[Any]]:
        """Traced rays with the derivatives of the lens's graph, in float64."""
        found = self._traced(rays)
        through = np.concatenate([rays["film_mm"], found["pupil_mm"], rays["wavelength_nm"]]).astype(np.float64)
        call = {name: np.array([[value]]) for name, value in self._of_the_lens().items()}
        with np.errstate(all="ignore"):  # of rays that do not pass
            moved = evaluate(self._moves, {"rays": through} | call)
        d_film = np.stack([moved[name] for name in D_FILM], 1) * np.array(METRES)[:, None, None]
        return found | {"d_film": np.nan_to_num(d_film, posinf=0.0, neginf=0.0).astype(np.float32)}

    @cached_property
    def _moves(self) -> Graph:
        return with_film_derivatives(self.lens_graph().graph)

    def _hero(self, rays: dict[str, FloatArray]) -> dict[str, NDArray[Any]]:
        assert self._shift is not None
        found = self._traced(rays)
        return found | evaluate(lanes_graph(self._shift, len(rays["companion_nm"])), rays | found)

    def _companion(self, rays: dict[str, FloatArray]) -> dict[str, NDArray[Any]]:
        assert self._shift is not None
        g = Graph()
        g.outputs["there"] = shifted(g, self._shift)
        there = evaluate(g, rays)["there"]
        return {"status": self._scene(there[:2], there[2:], rays["companion_nm"][0]).status[None]}

    @property
    def front(self) -> Surface:
        """The first surface."""
        return self.lens.surfaces[0]

    def _traced_back(
        self, position: NDArray[np.float64], direction: NDArray[np.float64], wavelength_nm: FloatArray
    ) -> tuple[NDArray[np.float64], FloatArray, NDArray[np.int32]]:
        # Light starts a millimetre before the surface, so that it lies ahead; rays that are not finite miss it.
        rays = np.nan_to_num(np.concatenate([position + direction, -direction]), posinf=0, neginf=0)
        with torch.no_grad():
            *light, wavelength = _tensors(self._dtype, *rays, wavelength_nm)
            done = trace(self.lens, Rays(*light), wavelength, towards="film", transmittance=True)
        assert done.transmittance is not None
        x, y, z, dx, dy, dz, through = (c.double().numpy() for c in (*done.rays, done.transmittance))
        film = np.stack([x, y]) + (self.film.film_z_mm - z) / dz * np.stack([dx, dy])
        return film, through, self._in_its_light(done.status, wavelength_nm)

    def lens_graph(self, form: Form = SCALARS) -> LensGraph:
        """The graph of the lens with its stop; it has one form."""
        graph = exact_graph(self.lens, self._pupil_z_mm, self._range_nm)
        stopped = st.blocked(self.lens.stop_index, st.RIM)
        return LensGraph(graph, float(self.lens.stop_radius_mm), self.lens.aperture, stopped)

    def path_by_height(
        self, surfaces: list[int], film_mm: NDArray[Any], pupil_mm: NDArray[Any], wavelength_nm: NDArray[Any]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Rays of film points [2, N] through pupil points [2, N]: optical direction cosines at the film [2, N]; of each
        surface the distance from the axis and the path that a surface higher by 1 would add [surfaces, 2, N]."""
        lens, outline, waves = without_rims(self.lens), self.film.outline, torch.from_numpy(wavelength_nm.astype("f8"))
        film_z = np.full(waves.numel(), float(self.film.film_z_mm))
        index = [np.asarray(m.n) * np.ones(waves.numel()) for m in media(lens, waves)]
        way = np.stack([*(pupil_mm - film_mm), outline.pupil_z_mm - film_z])
        way /= np.sqrt((way**2).sum(axis=0))
        start = Rays(*map(torch.from_numpy, (*film_mm.astype(np.float64), film_z, *way)))
        path = [start, *trace(lens, start, waves, path=True).path]  # from the film: surface k is number -1 - k
        radius = [path[-1 - k].x.hypot(path[-1 - k].y).numpy() for k in surfaces]
        added = [index[k + 1] * path[-2 - k].dz.numpy() - index[k] * path[-1 - k].dz.numpy() for k in surfaces]
        return index[-1] * way[:2], np.stack([radius, added], 1)

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
        status = self._in_its_light(done.status, wavelength_nm)
        return SceneRays(scene, done.transmittance.to(torch.float32).numpy(), status)

    def _in_its_light(self, status: torch.Tensor, wavelength_nm: FloatArray) -> NDArray[np.int32]:
        """The status of traced rays, as the lens's graph has it: of no other light than that of the camera."""
        low, high = light_limits(self.lens, self._range_nm)
        inside = (low <= wavelength_nm) & (wavelength_nm <= high)
        return np.where(inside, status.numpy(), st.OUTSIDE_DOMAIN).astype(np.int32)

    def _passes(self, film: FloatArray, pupil: FloatArray, wavelength_nm: float) -> NDArray[np.bool_]:
        """Test whether light passes from film points (r, 0) through pupil points; see `passes_at_any_azimuth`."""
        r, u, v = _tensors(self._dtype, film[0], *pupil)
        with torch.no_grad():
            film_z, pupil_z = self._film_z_mm, self._pupil_z_mm
            return passes_at_any_azimuth(self.lens, r, film_z, u, v, pupil_z, wavelength_nm, self.film_mm).numpy()


def _tensors(dtype: torch.dtype, *arrays: NDArray[Any]) -> list[torch.Tensor]:
    return [torch.from_numpy(np.ascontiguousarray(a)).to(dtype) for a in arrays]


def state_of(lens: Lens, wavelength_nm: tuple[float, float], nominal_mm: float | None = None) -> dict[str, Any]:
    """The table `lens_state` of a lens that `set_lens` has placed; `nominal_mm` is its focal length at infinity."""
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
    """The settings of an exact camera that describe lens and film, for a lens that `set_lens` has placed."""
    nominal = None if lens.infinity_mm else float(first_order(lens).efl_mm)
    return {
        "camera": "exact",
        "lens": lens.identity,
        "focus_m": None if math.isinf(focus_m) else focus_m,
        "film_mm": list(film_mm),
        "lens_state": state_of(lens, (400.0, 700.0), nominal),
    }


_KEPT = 256  # outlines in the cache, of 100 kB or less


def search_key(lens: Lens, wavelength_nm: tuple[float, float], shares: tuple[float, ...], *settings: Any) -> str:
    """A name for all that the search for an outline reads.

    Args:
        lens: focused. wavelength_nm, shares: the range, and the shares of it at which rays are traced.
        settings: whatever else rules the search, as JSON takes it.
    """
    waves = {lens.reference_nm, *wavelength_nm, *(wavelength_between(wavelength_nm, share) for share in shares)}
    rows: list[Any] = [[float(index_of(lens.object_medium, w)) for w in sorted(waves)]]
    for s in lens.surfaces:
        numbers = (s.radius_mm, s.thickness_mm, s.diameter_mm, *(index_of(s, w) for w in sorted(waves)))
        rows.append([[float(v) for v in numbers], s.stop, s.figure.record()])
    return fingerprint_of([_code(), rows, float(lens.film_z_mm or 0), sorted(waves), *settings])


@cache
def _code() -> list[str]:
    """Hash the modules that trace and search, and torch's arithmetic on this machine."""
    package = Path(__file__).parents[1]
    found = (package.glob(pattern) for pattern in ("lens/*.py", "trace/*.py", "setting/*.py", "cameras/pupil_*.py"))
    files = [f"{file.name} {sha256_of(file)}" for folder in found for file in sorted(folder)]
    return [*files, torch.__version__, torch.backends.cpu.get_cpu_capability()]


def kept_outline(key: str, search: Callable[[], PupilOutline | None]) -> PupilOutline | None:
    """The outline of a key: from the cache, else what `search` finds, which takes seconds."""

    def searched() -> dict[str, Any]:
        outline = search()
        return {k: np.asarray(v).tolist() for k, v in asdict(outline).items()} if outline is not None else {}

    if not (found := kept_in_cache(f"{key}.outline", _KEPT, searched)):
        return None
    arrays: dict[str, Any] = {name: np.array(found.pop(name), np.float32) for name in ("centre", "x", "y")}
    return PupilOutline(wavelength_nm=tuple(found.pop("wavelength_nm")), **found, **arrays)
