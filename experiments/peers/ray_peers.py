"""Other people's tracers in the benchmark of lens rays (`rays`), which has the rules: an adapter each, in `PEERS`.

An adapter takes a `Task`, a lens and a batch of its rays, and returns two functions. The first, which is timed, traces
the rays; the second turns what the first returned into `Found`. An adapter makes what it can beforehand, off the clock,
and raises `Unavailable` where it cannot run, with the reason. The programs are no dependencies of this project:

    export PYTHONPATH=DIR PBRT_V3=...                             # a checkout of github.com/mmp/pbrt-v3
    pip install --target DIR --no-deps optiland==0.6.3 vtk numba llvmlite pandas seaborn tabulate
    pip install --target DIR --no-deps rayoptics==0.9.8 opticalglass anytree deprecation json-tricks parsimonious
    pip install --target DIR --no-deps regex transforms3d openpyxl et_xmlfile xlrd
    pip install --target DIR --no-deps --ignore-requires-python deeplens-core==2.5.6 einops tqdm
"""

from __future__ import annotations

import ctypes
import importlib
import importlib.util
import math
import os
import shutil
import sys
import tempfile
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache, partial
from pathlib import Path
from typing import Any, NamedTuple
from unittest import mock

import numpy as np
import torch
from numpy.typing import NDArray

from experiments.speed.tracer_race import Hand, by_figures, compiled
from neurolens.models.fitted import Domain, FilmRays
from neurolens.optics.lens import glass
from neurolens.optics.lens.prescription import Lens
from neurolens.studies.speed import Unavailable

Numbers = NDArray[np.float64]
WAVELENGTH_NM = glass.LINE_D_NM


@dataclass(frozen=True)
class Face:
    """A surface: z = c r^2 / (1 + sqrt(1 - (1 + conic) c^2 r^2)) + sum of even[k] r^(2 k + 2), all in mm.

    Attributes:
        radius: 1 / c, positive where the centre lies further along +z; infinite for a plane.
        gap: along the axis to the next surface, or behind the last one to the film. index: of the medium in there.
        rim: radius of the opening, beyond which rays are blocked. stop: whether it is the aperture stop.
    """

    radius: float
    conic: float
    even: tuple[float, ...]
    gap: float
    index: float
    rim: float
    stop: bool


@dataclass(frozen=True)
class Task:
    """A lens and rays. Frame: z from the scene to the film, front vertex at 0; mm; light goes from film to scene.

    Attributes:
        faces: from the scene to the film; the medium in front of the first is air, of index 1.
        film, pupil: [2, N] points on the planes at film_z and pupil_z, all float64.
        start, way: [3, N] the same rays as film points and unit vectors, whose z is negative.
        lens, domain: the same as objects of this project; others need them no more than the wavelength.
    """

    faces: tuple[Face, ...]
    film: Numbers
    pupil: Numbers
    film_z: float
    pupil_z: float
    start: Numbers
    way: Numbers
    lens: Lens
    domain: Domain

    def part(self, first: int, count: int) -> Task:
        """The same with some of the rays."""
        each = {name: getattr(self, name)[:, first : first + count] for name in ("film", "pupil", "start", "way")}
        return replace(self, **each)

    def turned(self) -> tuple[list[Face], Numbers, Numbers, Callable[[Numbers, Numbers], tuple[Numbers, Numbers]]]:
        """For tracers that follow light along +z: faces from the film on, starts and ways in a frame that is turned.

        Its z counts from the last vertex towards the scene. The function turns scene rays back.
        """
        rear = sum(f.gap for f in self.faces[:-1])
        next_ones = [*((f.gap, f.index) for f in self.faces[-2::-1]), (0.0, 1.0)]
        faces = [
            Face(-f.radius, f.conic, tuple(-a for a in f.even), gap, index, f.rim, f.stop)
            for f, (gap, index) in zip(self.faces[::-1], next_ones, strict=True)
        ]
        flip, offset = np.array([[1.0], [1.0], [-1.0]]), np.array([[0.0], [0.0], [rear]])
        return faces, (self.start - offset) * flip, self.way * flip, lambda p, d: (p * flip + offset, d * flip)


def table_of(lens: Lens) -> tuple[Face, ...]:
    """The surfaces of a lens with its indices at `WAVELENGTH_NM`.

    Raises:
        Unavailable: it has more than conics and even aspheres in air.
    """
    faces = []
    if float(glass.index_of(lens.media[0], WAVELENGTH_NM)) != 1:
        raise Unavailable("the lens is not in air")
    for s in lens.surfaces:
        terms = {p: float(a) for p, a in s.figure.asphere}
        if s.figure.axis or s.figure.power or any(p % 2 for p in terms):
            raise Unavailable("the lens has more than conics and even aspheres")
        even = tuple(terms.get(p, 0.0) for p in range(2, max(terms, default=0) + 1, 2))
        n, rim = float(glass.index_of(s, WAVELENGTH_NM)), s.semi_diameter_mm
        faces.append(Face(float(s.radius_mm), float(s.figure.conic), even, float(s.thickness_mm), n, rim, s.stop))
    return tuple(faces)


class Found(NamedTuple):
    """Scene rays: a point [3, N] on each, a unit vector [3, N] that points to the scene, and whether light passes."""

    point: NDArray[Any]
    way: NDArray[Any]
    passes: NDArray[np.bool_]


Prepared = tuple[Callable[[], Any], Callable[[Any], Found]]


class Peer(NamedTuple):
    """A tracer: its name, its precision, its adapter, batch sizes to choose from, most rays of a pass, whose it is."""

    name: str
    precision: str
    adapter: Callable[[Task], Prepared]
    batches: tuple[int, ...] = (4000, 10000, 20000)
    most: int = 20000
    family: str = "others"

    @property
    def key(self) -> str:
        return f"{self.name}, {self.precision}"


def package(name: str) -> Any:
    """A package, if it is here and can be imported."""
    try:
        return importlib.import_module(name)
    except Exception as error:  # a package of another platform or Python raises what it likes
        raise Unavailable(f"{name.partition('.')[0]} is not here: {error}"[:120].partition("\n")[0]) from error


# ---- A tracer that was written by hand. ------------------------------------------------------------------------------


def by_hand(task: Task, vectors: int) -> Prepared:
    """The tracer of `tracer_race`, spheres alone, with the power that arrives."""
    if any(f.even or f.conic for f in task.faces):
        raise Unavailable("it has spheres alone")
    lens = replace(task.lens, surfaces=tuple(by_figures(s) for s in task.lens.surfaces))
    made = _hand(lens, task.pupil_z, vectors)
    x, y = task.film
    columns = x, y, np.full_like(x, task.film_z), *task.pupil, np.full_like(x, WAVELENGTH_NM)
    rays = FilmRays(*(torch.from_numpy(np.ascontiguousarray(c)) for c in columns))
    call, out = made.prepared(rays, task.domain.stop_radius_mm)
    return call, lambda _: Found(np.stack(out[:3]), np.stack(out[3:6]), out[-1] == 0)


@cache
def _hand(lens: Lens, pupil_z: float, vectors: int) -> Hand:
    return Hand(lens, pupil_z, ("-DNOFAST", f"-DW={vectors}"))


# ---- Optiland (MIT licence). -----------------------------------------------------------------------------------------


# Optiland imports these to draw, which needs 150 MB.
_DRAWING = ("vtk", "vtk.util", "vtk.util.numpy_support")


def optiland(task: Task, backend: str, precision: str, device: str = "cpu") -> Prepared:
    """Optiland with constant indices and without records of each surface, which is its fastest way."""
    absent = "vtk" not in sys.modules and importlib.util.find_spec("vtk") is None
    stand_ins = {name: mock.MagicMock() for name in _DRAWING if absent}
    sys.modules.update(stand_ins)
    try:
        be, optics = package("optiland.backend"), package("optiland.optic")
        material, rays = package("optiland.materials").IdealMaterial, package("optiland.rays").RealRays
    finally:
        for name in stand_ins:
            del sys.modules[name]

    def settle() -> None:
        be.set_backend(backend)
        be.set_precision(precision)
        if backend == "torch":
            be.set_device(device)
            be.grad_mode.disable()

    settle()
    faces, start, way, back = task.turned()
    optic = optics.Optic()
    optic.surfaces.add(index=0, radius=be.inf, thickness=be.inf)
    for k, f in enumerate(faces):
        shape: dict[str, Any] = {"radius": f.radius, "conic": f.conic}
        shape |= {"surface_type": "even_asphere", "coefficients": list(f.even)} if f.even else {}
        glass_behind = material(f.index)
        optic.surfaces.add(
            index=k + 1, thickness=f.gap, material=glass_behind, is_stop=f.stop, aperture=2 * f.rim, **shape
        )
    numbers = [*start, *way, np.ones_like(start[0]), np.full_like(start[0], WAVELENGTH_NM / 1000)]
    columns: list[Any] = [np.ascontiguousarray(c, precision) for c in numbers]
    columns = [torch.from_numpy(c).to(device) for c in columns] if backend == "torch" else columns

    def call() -> Any:
        settle()
        traced = rays(*columns)
        optic.surfaces.trace(traced, skip=1, record=False)
        return traced

    def read(out: Any) -> Found:
        x, y, z, dx, dy, dz, light = (be.to_numpy(c) for c in (out.x, out.y, out.z, out.L, out.M, out.N, out.i))
        return Found(*back(np.stack([x, y, z]), np.stack([dx, dy, dz])), (light > 0) & np.isfinite(dx))

    return call, read


# ---- ray-optics (BSD licence). ---------------------------------------------------------------------------------------


def ray_optics(task: Task) -> Prepared:
    """ray-optics, which traces ray by ray in Python."""
    surface, profiles = package("rayoptics.elem.surface"), package("rayoptics.elem.profiles")
    trace, failed = package("rayoptics.raytr.raytrace").trace_raw, package("rayoptics.raytr.traceerror").TraceError
    faces, start, way, back = task.turned()
    level = np.identity(3)
    path: list[list[Any]] = [[None, None, (level, np.zeros(3)), 1.0, 1.0]]
    for f in faces:
        c = 1 / f.radius
        plain = profiles.Spherical(c=c) if not f.conic else profiles.Conic(c=c, cc=f.conic)
        shape = profiles.EvenPolynomial(c=c, cc=f.conic, coefs=list(f.even)) if f.even else plain
        met = surface.Surface(profile=shape, max_ap=f.rim, interact_mode="transmit")
        path.append([met, None, (level, np.array([0.0, 0.0, f.gap])), f.index, 1.0])
    rays = list(zip(np.ascontiguousarray(start.T), np.ascontiguousarray(way.T), strict=True))
    nothing = np.full(3, np.nan)

    def one(point: Any, direction: Any) -> tuple[Any, Any]:
        try:
            traced, _, _ = trace(
                iter(path), point, direction, WAVELENGTH_NM, intersect_obj=False, check_apertures=True,
                pt_inside_fuzz=0.0,
            )  # fmt: skip
        except failed:
            return nothing, nothing
        return traced[-1][0], traced[-1][1]

    def read(out: Any) -> Found:
        points, ways = (np.stack(c, 1) for c in zip(*out, strict=True))
        points[2] += sum(f.gap for f in faces)  # it counts from the surface itself
        return Found(*back(points, ways), np.isfinite(ways[0]))

    return lambda: [one(p, d) for p, d in rays], read


# ---- DeepLens (Apache licence). --------------------------------------------------------------------------------------

# DeepLens imports these for pictures and losses; tracing uses none, and torchvision's wheels need a torch with CUDA.
_UNUSED = ("torchvision", "torchvision.utils", "torchvision.models", "torchvision.transforms", "lpips")


def deeplens(task: Task, precision: str, device: str = "cpu") -> Prepared:
    """DeepLens, from the film to the scene as in its renderer."""
    with mock.patch.dict(sys.modules, {name: mock.MagicMock() for name in _UNUSED if "deeplens" not in sys.modules}):
        whole, shapes = package("deeplens"), package("deeplens.geometric_surface")
    dtype: torch.dtype = getattr(torch, precision)
    lens = whole.GeoLens(device=torch.device(device), dtype=dtype)
    for f in task.faces:
        gap, c = torch.tensor(f.gap, dtype=dtype), 1 / f.radius
        behind = f"{f.index!r}/1e15"  # index at the d line, and an Abbe number that leaves it constant
        if f.stop and f.index == 1:
            lens.surfaces.append(shapes.Aperture(f.rim, gap))
        elif f.even or f.conic:
            more = {"ai2": f.even[0] if f.even else None, "ai": list(f.even[1:])}
            lens.surfaces.append(shapes.Aspheric(f.rim, gap, c, f.conic, mat2=behind, **more))
        else:
            lens.surfaces.append(shapes.Spheric(c, f.rim, gap, behind))
    lens.aper_idx = [f.stop for f in task.faces].index(True)
    lens.astype(dtype)
    start, way = (torch.from_numpy(np.ascontiguousarray(a.T)).to(device, dtype) for a in (task.start, task.way))

    def call() -> Any:
        with torch.no_grad():
            return lens.trace(whole.Ray(start.clone(), way, WAVELENGTH_NM / 1000))[0]  # it writes into its rays

    return call, lambda out: Found(out.o.cpu().numpy().T, out.d.cpu().numpy().T, out.is_valid.cpu().numpy() > 0)


# ---- The realistic camera of pbrt (BSD licence). ---------------------------------------------------------------------

# Its own source, compiled where it lies, with a logger that stops where a check fails, as its own does; the camera is
# not focused, its film stays put.
_LOGGER = """#pragma once
#include <cstdlib>
#include <iostream>
#define CHECK(x) while (!(x)) std::abort(), std::cerr
#define DCHECK(x) while (false) std::cerr
#define LOG(x) std::cerr
#define VLOG(x) while (false) std::cerr
#define CHECK_NOTNULL(x) (x)
"""
_COMPARISONS = {"EQ": "==", "NE": "!=", "GE": ">=", "GT": ">", "LE": "<=", "LT": "<"}
_CAMERA = """
#include <array>
#include <functional>
#include <map>
#include <mutex>
#include <new>
#include <sstream>
#include <thread>
#define private public
#define protected public
#include "cameras/realistic.cpp"
#include "core/transform.cpp"
using namespace pbrt;
std::vector<std::function<void(StatsAccumulator &)>> *StatRegisterer::funcs;
extern "C" __attribute__((visibility("default"))) void run(size_t n, size_t faces, const float *lens, const float *in,
                                                           float *out)
{
    alignas(RealisticCamera) static char room[sizeof(RealisticCamera)];
    auto *camera = reinterpret_cast<RealisticCamera *>(room);
    auto *made = new (&camera->elementInterfaces) std::vector<RealisticCamera::LensElementInterface>();
    for (size_t k = 0; k < faces; ++k, lens += 4) made->push_back({lens[0], lens[1], lens[2], lens[3]});
    for (size_t i = 0; i < n; ++i, in += 6, out += 7) {
        Ray r;
        out[6] = camera->TraceLensesFromFilm(Ray(Point3f(in[0], in[1], in[2]), Vector3f(in[3], in[4], in[5])), &r);
        out[0] = r.o.x, out[1] = r.o.y, out[2] = r.o.z, out[3] = r.d.x, out[4] = r.d.y, out[5] = r.d.z;
    }
    made->~vector();
}
"""
_FLAGS = (
    "-std=gnu++14 -O3 -march=native -w -fvisibility=hidden -ffunction-sections -fdata-sections "
    "-Wl,--gc-sections -DPBRT_CONSTEXPR=constexpr -DPBRT_THREAD_LOCAL=thread_local -DPBRT_NOINLINE= "
    "-DPBRT_HAVE_ALLOCA_H -DPBRT_HAVE_HEX_FP_CONSTANTS -DPBRT_HAVE_POSIX_MEMALIGN -DPBRT_HAVE_CONSTEXPR"
)


@cache
def _pbrt() -> Any:
    """The compiled function `run` of `_CAMERA`."""
    source = Path(os.environ.get("PBRT_V3", "")) / "src"
    if "PBRT_V3" not in os.environ or not source.is_dir() or shutil.which("g++") is None:
        raise Unavailable("PBRT_V3 names no checkout of pbrt-v3, or g++ is not here")
    logger = _LOGGER
    for name, sign in _COMPARISONS.items():
        logger += f"#define CHECK_{name}(a, b) CHECK((a) {sign} (b))\n#define DCHECK_{name}(a, b) DCHECK(0)\n"
    with tempfile.TemporaryDirectory(prefix="neurolens-pbrt-") as folder:
        (Path(folder) / "glog").mkdir()
        (Path(folder) / "glog" / "logging.h").write_text(logger, encoding="utf-8")
        run = compiled([*_FLAGS.split(), *(f"-I{p}" for p in (folder, source, source / "core"))], _CAMERA)
    run.argtypes, run.restype = [ctypes.c_size_t, ctypes.c_size_t, *[ctypes.c_void_p] * 3], None
    return run


def pbrt(task: Task) -> Prepared:
    """`RealisticCamera::TraceLensesFromFilm` of pbrt-v3, lengths in mm."""
    if any(f.even or f.conic for f in task.faces):
        raise Unavailable("it has spheres alone")
    if any(math.isinf(f.radius) and not f.stop for f in task.faces):
        raise Unavailable("it takes each plane for a stop, which refracts nothing")
    run = _pbrt()
    to_film = task.film_z - sum(f.gap for f in task.faces[:-1])
    gaps = [*(f.gap for f in task.faces[:-1]), to_film]
    rows = [(0 if f.stop else f.radius, gap, f.index, f.rim) for f, gap in zip(task.faces, gaps, strict=True)]
    table, count = np.array(rows, np.float32), task.start.shape[1]
    # Its camera looks along +z, the film at 0.
    flip, offset = np.array([[1.0], [1.0], [-1.0]]), np.array([[0.0], [0.0], [task.film_z]])
    start, way = (task.start - offset) * flip, task.way * flip
    given = np.ascontiguousarray(np.concatenate([start, way]).T, np.float32)
    out = np.empty((count, 7), np.float32)
    pointers = [ctypes.c_void_p(a.ctypes.data) for a in (table, given, out)]

    def call(kept: Any = (table, given, out)) -> None:  # the function knows addresses alone
        run(count, len(rows), *pointers)

    return call, lambda _: Found(out[:, :3].T * flip + offset, out[:, 3:6].T * flip, out[:, 6] > 0)


PEERS = (
    *(
        Peer(f"by hand, AVX, {n} vectors", "float32", partial(by_hand, vectors=n), (4000, 20000), 100000)
        for n in (2, 3)
    ),
    *(
        Peer(f"Optiland, {backend}", precision, partial(optiland, backend=backend, precision=precision))
        for backend in ("numpy", "torch")
        for precision in ("float32", "float64")
    ),
    *(Peer("DeepLens", p, partial(deeplens, precision=p)) for p in ("float32", "float64")),
    Peer("pbrt-v3, realistic camera", "float32", pbrt, (4000, 20000), 100000),
    Peer("ray-optics", "float64", ray_optics, (500,), 500),
)
# What never runs here, and why.
ABSENT = {"Physical Camera (OSL)": "an OSL shader for Cycles, which hands out pixels and no rays"}
