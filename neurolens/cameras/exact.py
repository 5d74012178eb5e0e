"""The exact lens as a camera, run as its graph: every ray passes through every surface.

The same graph, step by step on arrays, serves the search for the outline of the light that passes the lens.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import asdict, replace
from functools import cache, cached_property, lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from neurolens.base import status as st
from neurolens.base.files import fingerprint_of, kept_in_cache, sha256_of
from neurolens.base.progress import Progress
from neurolens.base.settings import LIGHT_NM
from neurolens.cameras.cameragraph import LensGraph
from neurolens.cameras.contract import FloatArray
from neurolens.cameras.lenscamera import LensCamera
from neurolens.cameras.lensfilm import Array, LensScene, axial_light, film_slope
from neurolens.cameras.onnxlens import BATCH, LensRays, LensRun
from neurolens.cameras.pose import FilmPose, warn_beyond
from neurolens.cameras.pupil_outline import COARSE, FINE, PupilOutline, PupilTable, outline_of, wavelength_between
from neurolens.cameras.sampling import lens_state
from neurolens.graph.interpret import evaluate
from neurolens.graph.ir import Graph, pruned
from neurolens.models.assemble import SCALARS, Form
from neurolens.optics.lens.glass import LINE_D_NM, check_light, index_of
from neurolens.optics.lens.paraxial import PupilBounds, chief_reach_mm, first_order
from neurolens.optics.lens.prescription import Lens, Surface
from neurolens.optics.lens.shot import BY_LENSES, Shot
from neurolens.optics.setting.focusing import at_infinity, require_film
from neurolens.optics.setting.pupils import passes_at_any_azimuth, pupil_bounds, pupil_plane_z_mm
from neurolens.optics.setting.states import focus_mode_of, focus_of, set_lens
from neurolens.optics.trace.surfaces import Rays, media
from neurolens.optics.trace.tracegraph import exact_graph, light_limits

_TURNS = 8  # azimuths for the light on the axis, where the lens is not round


class ExactRun(LensRun):
    """Runs the graph of a lens that `set_lens` has placed, for light through points of a plane.

    It is evaluated on arrays, which takes as long as onnxruntime, without the time to open a session.
    """

    def __init__(self, lens: Lens, pupil_z_mm: float, wavelength_nm: tuple[float, float]) -> None:
        super().__init__(Path(lens.path))
        self.stop_index, self._graph = lens.stop_index, exact_graph(lens, pupil_z_mm, wavelength_nm)

    def graph(self, form: Form = SCALARS) -> Graph:
        """Return the graph, which is the same in every form."""
        return self._graph

    def run(self, rays: FloatArray, film_z_mm: ArrayLike, stop_radius_mm: float) -> LensRays:
        """Return the scene rays of columns [5, N] as `ray_columns` makes them."""
        found = self._evaluated(self._graph, rays, film_z_mm, stop_radius_mm)
        return LensRays(found["scene_ray"], found["transmittance"][0], found["stop_xy_mm"], found["status"][0])

    def status(self, rays: FloatArray, film_z_mm: float, stop_radius_mm: float) -> NDArray[np.int32]:
        """Return `run(...).status` alone, which takes less time, since nothing else is computed."""
        return np.asarray(self._evaluated(self._tests, rays, film_z_mm, stop_radius_mm)["status"][0], np.int32)

    @cached_property
    def _tests(self) -> Graph:
        return pruned(self._graph, {"status": self._graph.outputs["status"]})

    @staticmethod
    def _evaluated(
        graph: Graph, rays: FloatArray, film_z_mm: ArrayLike, stop_radius_mm: float
    ) -> dict[str, NDArray[Any]]:
        numbers = {"film_z_mm": film_z_mm, "stop_radius_mm": stop_radius_mm}
        call = {name: np.full((1, 1), value, np.float32) for name, value in numbers.items()}
        starts = range(0, max(rays.shape[1], 1), BATCH)
        parts = [evaluate(graph, {"rays": rays[:, at : at + BATCH]} | call) for at in starts]
        return {name: np.concatenate([part[name] for part in parts], axis=1) for name in parts[0]}


class ExactCamera(LensCamera):
    """A camera whose lens is the prescription itself.

    Args:
        lens: as its file has it, or in a zoom state.
        shot: the settings of the camera. The outline of a lens without known dispersion is that of the d line; its
            exposure is that of all light, which coatings colour.
        bounds: pupil bounds of a domain that holds this focus and stop; rays are then those of the domain's models for
            the same random numbers. None searches for them, over the whole film.
        progress: shows the search for the outline, where no run has kept it (`kept_outline`).

    Raises:
        InputError: a focus nearer than four focal lengths, a lens that no ray passes, light of no known index.
    """

    takes = frozenset({*LensCamera.takes, *BY_LENSES})

    def __init__(
        self, lens: Lens, shot: Shot, *, bounds: PupilBounds | None = None, progress: Progress | None = None
    ) -> None:
        given, shot = shot, shot.whole()
        self.film_mm, self.path, self.name = shot.film_mm, Path(lens.path), lens.name
        self.dispersive = lens.dispersive
        self.wavelength_nm = shot.wavelength_nm if self.dispersive else None
        self._light_nm = shot.wavelength_nm
        for nm in self._light_nm:
            check_light(lens, nm)
        self.lens = require_film(set_lens(lens, replace(shot, focus_m=given.focus_m)))
        shot = replace(shot, focus_m=focus_of(self.lens, given), focus_mode=focus_mode_of(self.lens, given))
        warn_beyond(self.path, self.lens, FilmPose.of(shot))
        film_z, tabled, stop_mm = self.lens.film_z_mm, at_infinity(self.lens), float(self.lens.stop_radius_mm)
        assert film_z is not None  # `set_lens` places the film
        plane = pupil_plane_z_mm(self.lens) if bounds is None else bounds.pupil_z_mm
        scene = LensScene(ExactRun(self.lens, plane, shot.wavelength_nm), float(film_z), stop_mm, self.lens.aperture)
        data = first_order(self.lens)
        about = {
            "camera": "exact",
            "lens": tabled.identity,
            "efl_mm": float(data.efl_mm),
            "f_number": float(data.f_number),
            "derived": self.lens.derived,
            "rims": lens.rims,
            "coatings": self.lens.coatings,
            "lens_state": state_of(self.lens, self._light_nm, float(first_order(tabled).efl_mm)),
        }
        self.place(self._outline(scene, plane, bounds, shot, progress), scene, shot, about, progress)

    @property
    def front(self) -> Surface:
        """Return the first surface of the lens."""
        return self.lens.surfaces[0]

    def _traced_back(
        self, position: NDArray[np.float64], direction: NDArray[np.float64], wavelength_nm: FloatArray
    ) -> tuple[NDArray[np.float64], FloatArray, NDArray[np.int32]]:
        import torch

        from neurolens.optics.trace.rays import plain_trace

        # Light starts a millimetre in front of the surface, which then lies ahead; rays that are not finite miss it.
        rays = np.nan_to_num(np.concatenate([position + direction, -direction]), posinf=0, neginf=0)
        *light, wavelength = (torch.from_numpy(np.ascontiguousarray(a)).float() for a in (*rays, wavelength_nm))
        done = plain_trace(self.lens, Rays(*light), wavelength, towards="film", transmittance=True)
        assert done.transmittance is not None
        x, y, z, dx, dy, dz, through = (c.double().numpy() for c in (*done.rays, done.transmittance))
        planes = (self.film.film_z_mm, self.film.outline.pupil_z_mm)
        places = np.concatenate([np.stack([x, y]) + (at - z) / dz * np.stack([dx, dy]) for at in planes])
        # The lens's graph takes light of the camera's range alone; so does this.
        low, high = light_limits(self.lens, self._light_nm)
        inside = (low <= wavelength_nm) & (wavelength_nm <= high)
        return places, through, np.where(inside, done.status.numpy(), st.OUTSIDE_DOMAIN).astype(np.int32)

    def lens_graph(self, form: Form = SCALARS) -> LensGraph:
        """Return the graph of the lens with its stop."""
        scene = self.film.scene
        return LensGraph(scene.lens.graph(form), scene.stop_radius_mm, scene.aperture, scene.stopped)

    def path_by_height(
        self, surfaces: list[int], film_mm: NDArray[Any], pupil_mm: NDArray[Any], wavelength_nm: NDArray[Any]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Trace rays of film points [2, N] through pupil points [2, N]: how do uneven surfaces change their paths?

        Returns:
            Optical direction cosines at the film [2, N]; and for each surface, [surfaces, 2, N], the distance of the
            ray from the axis and by how much its path grows if the surface is higher by 1.
        """
        import torch

        from neurolens.optics.trace.aiming import without_rims
        from neurolens.optics.trace.rays import trace

        lens, outline, waves = without_rims(self.lens), self.film.outline, torch.from_numpy(wavelength_nm.astype("f8"))
        film_z = np.full(waves.numel(), float(self.film.film_z_mm))
        index = [np.asarray(m.n) * np.ones(waves.numel()) for m in media(lens, waves)]
        way = np.stack([*(pupil_mm - film_mm), outline.pupil_z_mm - film_z])
        way /= np.sqrt((way**2).sum(axis=0))
        start = Rays(*map(torch.from_numpy, (*film_mm.astype(np.float64), film_z, *way)))
        path = [start, *trace(lens, start, waves, path=True).path]  # seen from the film: surface k is number -1 - k
        radius = [path[-1 - k].x.hypot(path[-1 - k].y).numpy() for k in surfaces]
        added = [index[k + 1] * path[-2 - k].dz.numpy() - index[k] * path[-1 - k].dz.numpy() for k in surfaces]
        return index[-1] * way[:2], np.stack([radius, added], 1)

    def _outline(
        self, scene: LensScene, pupil_z_mm: float, bounds: PupilBounds | None, shot: Shot, progress: Progress | None
    ) -> PupilOutline | None:
        """Return the outline of what passes the lens with a round stop, from the cache where an earlier run kept it."""
        lens, planes = replace(scene, aperture=None), (scene.film_z_mm, scene.film_z_mm)
        light = self._light_nm if self.dispersive else (LINE_D_NM, LINE_D_NM)
        covered = FilmPose.of(shot).covers_mm(self.film_mm, scene.film_z_mm - pupil_z_mm)
        # A lens that is not round takes a search at many azimuths, for one outline that fits none closely: so it is
        # coarser.
        detail, rows, points = (FINE, 17, 128) if self.lens.round else (COARSE, 13, 48)

        def passes(film: FloatArray, pupil: FloatArray, nm: float) -> NDArray[np.bool_]:
            if self.lens.round:
                return lens.passes(film, pupil, nm)
            # At most azimuths most points are dark. Traced as arrays, lost rays take no more work.
            radius, x, y = (c.astype(np.float64) for c in (film[0], *pupil))
            film_z = np.full_like(radius, scene.film_z_mm)
            return passes_at_any_azimuth(self.lens, radius, film_z, x, y, pupil_z_mm, nm, covered)

        def search() -> PupilOutline | None:
            with (progress or Progress(quiet=True)).stage(f"search the pupil of {self.name}") as report:
                corner = 1.0001 * math.hypot(*covered) / 2
                boxes = bounds or pupil_bounds(
                    self.lens, corner, planes, light, rows=rows, points=points, film_mm=covered
                )
                table = PupilTable.of(asdict(boxes))
                return outline_of(table, passes, light, detail, lambda share: report(0.2 + 0.8 * share))

        read = [pupil_z_mm, covered, detail, bounds and asdict(bounds)]
        return kept_outline(search_key(self.lens, light, detail.wavelengths, *read), search)


def state_of(lens: Lens, wavelength_nm: tuple[float, float], nominal_mm: float | None = None) -> dict[str, Any]:
    """Return the table `lens_state` of a lens placed by `set_lens`; `nominal_mm` is its focal length at infinity."""
    data, film_z = first_order(lens), lens.film_z_mm
    assert film_z is not None
    light = light_on_axis(lens, [float(np.clip(LINE_D_NM, *wavelength_nm))], wavelength_nm).item()
    slope = film_slope(data.f_number, data.rear_focal_z_mm, data.exit_pupil_z_mm, film_z)
    return lens_state(
        nominal_mm=nominal_mm,
        efl_mm=data.efl_mm,
        pinhole_mm=chief_reach_mm(lens),
        entrance_pupil_mm=film_z - data.entrance_pupil_z_mm,
        f_number=data.f_number,
        transmittance=light / slope**2,
        squeeze=abs(data.efl_mm / first_order(lens, meridian="x").efl_mm) if lens.anamorphic else 1.0,
    )


def light_on_axis(lens: Lens, at_nm: Sequence[float], wavelength_nm: tuple[float, float]) -> NDArray[np.float64]:
    """Return `axial_light` [N] of these wavelengths; 0 where nothing passes or the stop's shape is closed on the axis.

    Args:
        lens: placed by `set_lens`. wavelength_nm: the range in which the wavelengths lie.
    """
    film_z, plane_z = lens.film_z_mm, pupil_plane_z_mm(lens)
    assert film_z is not None
    graph, nm = _graph_of_matrices(replace(lens, aperture=None), wavelength_nm), np.asarray(at_nm, np.float64)
    call = {"film_z_mm": np.array([[film_z]]), "stop_radius_mm": np.array([[float(lens.stop_radius_mm)]])}

    def trace(pupil: Array) -> LensRays:
        rays = np.zeros((5, len(nm), pupil.shape[1]))
        rays[2:4], rays[4] = pupil[:, None], nm[:, None]
        found = evaluate(graph, {"rays": rays.reshape(5, -1)} | call)
        through = np.broadcast_to(found["transmittance"], (1, rays[0].size))[0]
        return LensRays(found["scene_ray"], through, found["stop_xy_mm"], found["status"][0])

    each = [first_order(lens, meridian=meridian) for meridian in ("y", *("x" * lens.anamorphic))]
    slope = max(abs(film_slope(d.f_number, d.rear_focal_z_mm, d.exit_pupil_z_mm, film_z)) for d in each)
    open_ = lens.aperture is None or lens.aperture.inside(np.zeros(1), np.zeros(1), 1.0)
    of_stop = float(lens.stop_radius_mm), st.blocked(lens.stop_index, st.RIM)
    return open_ * axial_light(trace, 1 if lens.round else _TURNS, slope, abs(film_z - plane_z), *of_stop)


@lru_cache(maxsize=16)  # a camera, its T-stop and its tint ask for the same
def _graph_of_matrices(lens: Lens, wavelength_nm: tuple[float, float]) -> Graph:
    """Return the graph in which coatings are matrices: their polynomials may miss 0.02% of the light a surface."""
    return exact_graph(lens, pupil_plane_z_mm(lens), wavelength_nm, double=True)


def placed_settings(lens: Lens, film_mm: tuple[float, float], focus_m: float) -> dict[str, Any]:
    """Return the part of an exact camera's settings that describes lens and film, for a lens placed by `set_lens`."""
    nominal = None if lens.infinity_mm else float(first_order(lens).efl_mm)
    return {
        "camera": "exact",
        "lens": lens.identity,
        "focus_m": None if math.isinf(focus_m) else focus_m,
        "film_mm": list(film_mm),
        "lens_state": state_of(lens, LIGHT_NM, nominal),
    }


_KEPT = 256  # outlines in the cache, of 100 kB or less each


def search_key(lens: Lens, wavelength_nm: tuple[float, float], shares: tuple[float, ...], *settings: Any) -> str:
    """Return a name for all that the search for an outline depends on.

    Args:
        lens: focused.
        wavelength_nm, shares: the range, and the shares of it at which rays are traced.
        settings: whatever else rules the search, as JSON takes it.
    """
    waves = {lens.reference_nm, *wavelength_nm, *(wavelength_between(wavelength_nm, share) for share in shares)}
    rows: list[Any] = [[float(index_of(lens.object_medium, w)) for w in sorted(waves)]]
    for s in lens.surfaces:
        numbers = (s.radius_mm, s.thickness_mm, s.diameter_mm, *(index_of(s, w) for w in sorted(waves)))
        rows.append([[float(v) for v in numbers], s.stop, s.figure.record(), s.placement.record()])
    return fingerprint_of([searching_code(), rows, float(lens.film_z_mm or 0), sorted(waves), *settings])


@cache
def searching_code() -> list[str]:
    """Hash the modules that trace and search, and name the library that computes."""
    package = Path(__file__).parents[1]
    rooms = ("optics/lens/", "optics/trace/", "optics/setting/", "graph/", "models/", "cameras/pupil_")
    files = [f"{file.name} {sha256_of(file)}" for room in rooms for file in sorted(package.glob(f"{room}*.py"))]
    return [*files, np.__version__]


def kept_outline(key: str, search: Callable[[], PupilOutline | None]) -> PupilOutline | None:
    """Return the outline of a key, from the cache, or else what `search` finds, which takes seconds."""

    def searched() -> dict[str, list[Any]]:
        outline = search()
        return {k: np.asarray(v).tolist() for k, v in asdict(outline).items()} if outline is not None else {}

    if not (found := kept_in_cache(f"{key}.outline", _KEPT, searched)):
        return None
    arrays: dict[str, Any] = {name: np.array(found.pop(name), np.float32) for name in ("centre", "x", "y")}
    return PupilOutline(wavelength_nm=tuple(found.pop("wavelength_nm")), **found, **arrays)
