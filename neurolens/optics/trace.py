"""The exact tracer, in either direction, and ray differentials: the reference for surrogates.

Rays are separate tensors of shape [N]; float64 for truth, float32 for speed. A ray that cannot go on carries a
status and stays finite.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from functools import cache
from typing import Any, Literal, NamedTuple

import torch
from torch import Tensor
from torch.autograd import forward_ad

from neurolens.base import status as st
from neurolens.base.errors import InputError
from neurolens.base.files import own_folder
from neurolens.optics import glass
from neurolens.optics.passing import (
    Mode,
    along_axis,
    bend,
    check_rays,
    media,
    meet,
    sound_wavelength,
    start,
    unfolded,
    unit,
)
from neurolens.optics.prescription import Lens
from neurolens.optics.shapes import start_of
from neurolens.optics.surfaces import Counts, Rays, times
from neurolens.optics.transmission import Passage

Towards = Literal["scene", "film"]

# Rays per chunk: long enough to hide the cost of calling an operator, short enough for a core's second-level cache.
CHUNK = 32768
# Of the rays that `passing` follows, the share below which those that are left are put together.
_FEWER = 0.8


class Crossing(NamedTuple):
    """Where rays cross one surface, each [N]; mm, and the margins of Snell's and the sphere's square roots.

    `meets` is positive where the ray meets the surface, `refracts` where it is not totally reflected there. Points on
    the far half of a sphere, beyond any rim, lie mirrored outwards (see `passing.unfolded`).
    """

    x: Tensor
    y: Tensor
    meets: Tensor
    refracts: Tensor


class Traced(NamedTuple):
    """What tracing gives.

    Attributes:
        rays: point on the last surface met (lens frame, mm) and unit direction after it. Rays that missed a surface or
            were totally reflected are replaced by a finite ray along the axis; those that only a rim stops go on.
        status: [N] int32, see `neurolens.base.status`.
        transmittance: [N], power of unpolarised light that arrives: of surfaces and absorption; None unless requested.
        crossings: surface index to `Crossing`, for the recorded surfaces.
        path: the rays on and after every surface, in the order of travel, or empty if not requested.
    """

    rays: Rays
    status: Tensor
    transmittance: Tensor | None
    crossings: dict[int, Crossing]
    path: tuple[Rays, ...] = ()


class _Wanted(NamedTuple):
    """What to follow besides the rays; see `trace`."""

    transmittance: bool
    record: tuple[int, ...]
    path: bool


def trace(
    lens: Lens,
    rays: Rays,
    wavelength_nm: Tensor | float | None = None,
    *,
    towards: Towards = "scene",
    transmittance: bool = False,
    record: Sequence[int] = (),
    path: bool = False,
) -> Traced:
    """Trace rays through the whole lens.

    Args:
        lens: the prescription; its stop's diameter is the opening that clips.
        rays: points and unit directions [N], lens frame, mm. The dtype (float32 or float64) is that of the result.
        wavelength_nm: one number, or a tensor [N], of which NaN and what is not positive pass no dispersive glass; None
            takes `Lens.reference_nm`.
        towards: "scene" for camera rays (-z), "film" for light from the scene (+z).
        transmittance: whether to follow the power of unpolarised light, with the polarisation that surfaces give to it.
        record: surfaces whose crossings are wanted.
        path: whether the points on all surfaces and the directions after them are wanted.

    Raises:
        InputError: components of unequal shapes or dtypes or of another dtype, a wavelength of another shape or a
            number that is not positive, an unknown `towards`, a surface to record that the lens
            does not have.

    A direction that is not a unit vector counts as a miss of the first surface.
    Differentiable with respect to rays, wavelength and prescription fields given as tensors.
    """
    wavelength_nm = lens.reference_nm if wavelength_nm is None else wavelength_nm
    check_rays(rays, wavelength_nm)
    if not torch.compiler.is_compiling():
        _keep_memory()
    if towards not in ("scene", "film"):
        raise InputError("trace", "towards", towards, '"scene" or "film"')
    if any(not 0 <= k < len(lens.surfaces) for k in record):
        raise InputError("trace", "record", tuple(record), f"surfaces from 0 to {len(lens.surfaces) - 1}")
    wanted = _Wanted(transmittance, tuple(record), path)
    needs_grad = any(_differentiated(v) for v in (*rays, wavelength_nm, *_parameters(lens)))
    count = rays.x.shape[0]
    if needs_grad or count <= CHUNK:
        return _trace_chunk(lens, rays, wavelength_nm, towards, wanted, needs_grad)
    whole = None
    for i in range(0, count, CHUNK):
        part = slice(i, i + CHUNK)
        lam = wavelength_nm[part] if isinstance(wavelength_nm, Tensor) and wavelength_nm.ndim else wavelength_nm
        chunk = Rays(*(c[part] for c in rays))
        traced = _trace_chunk(lens, chunk, lam, towards, wanted, False)
        # Written in place: keeping the chunks until the end would double the memory.
        whole = _room(traced, count) if whole is None else whole
        _fill(whole, traced, part)
    assert isinstance(whole, Traced)
    return whole


def passing(lens: Lens, rays: Rays, wavelength_nm: float, *, towards: Towards = "scene") -> Tensor:
    """Whether rays pass the whole lens, bool [N]: where the status of `trace` is 0, bit for bit.

    Rays that are lost are left out of the work on later surfaces. For questions of which most are answered by no.
    Arguments and errors are those of `trace`, with one wavelength.
    """
    check_rays(rays, wavelength_nm)
    _keep_memory()
    chunks = zip(*(c.split(CHUNK) for c in rays), strict=True)
    with torch.no_grad():
        return torch.cat([_passing_chunk(lens, Rays(*chunk), wavelength_nm, towards) for chunk in chunks])


def compile_trace(
    lens: Lens, *, towards: Towards = "scene", transmittance: bool = False
) -> Callable[[Rays, Tensor], Traced]:
    """The same trace with the prescription folded in as constants, compiled by torch for chunks of one length.

    The result takes rays and wavelengths [N]; every new N compiles anew, so call it with chunks of one length.
    Without a C++ compiler the first call raises torch's own error; the eager `trace` needs none.
    """

    def run(rays: Rays, wavelength_nm: Tensor) -> Traced:
        return _trace_chunk(lens, rays, wavelength_nm, towards, _Wanted(transmittance, (), False), False)

    for surface in lens.surfaces:
        # Read the catalogue now: compiled code cannot read files.
        glass.index_of(surface, glass.LINE_D_NM)
        glass.absorption_of(surface, glass.LINE_D_NM)
    return compile_tracing(run)


def compile_tracing(run: Callable[..., Any], fullgraph: bool = False) -> Callable[..., Any]:
    """`torch.compile` of a function that traces, for chunks of one length.

    What it may take for constant is marked here only: that imports the compiler, which takes longer than a camera
    needs to start. Torch keeps the machine code that it makes, and runs what it finds: by default in a folder that
    every user of the machine can create, so that its cache is moved into the user's own.
    """
    if "TORCHINDUCTOR_CACHE_DIR" not in os.environ:
        os.environ["TORCHINDUCTOR_CACHE_DIR"] = str(own_folder("torch"))
    torch.compiler.assume_constant_result(start_of)
    return torch.compile(run, dynamic=False, fullgraph=fullgraph)


@cache
def _keep_memory() -> None:
    """Make glibc keep the memory of chunks between operators, once a process: half the time of a trace otherwise.

    Freeing one block above 128 KiB raises the limit for return to the system to its size (mallopt(3),
    M_MMAP_THRESHOLD).
    """
    torch.empty(30 << 20, dtype=torch.uint8)


def _differentiated(value: Any) -> bool:
    """Whether derivatives with respect to a value are followed, backwards or forwards."""
    if not isinstance(value, Tensor):
        return False
    return (value.requires_grad and torch.is_grad_enabled()) or forward_ad.unpack_dual(value).tangent is not None


def _parameters(lens: Lens) -> list[Any]:
    found: list[Any] = []
    for s in lens.surfaces:
        found += (s.radius_mm, s.thickness_mm, s.n_d, s.V_d, s.conic, s.absorption_per_mm, *(a for _, a in s.asphere))
        found += (figure for layer in (s.coating.layers if s.coating else ()) for figure in layer)
    return found


def _way(lens: Lens, towards: Towards) -> tuple[int, range]:
    """The sense of travel along z, and the surfaces in the order in which light meets them."""
    last = len(lens.surfaces) - 1
    return (1, range(last + 1)) if towards == "film" else (-1, range(last, -1, -1))


def _trace_chunk(
    lens: Lens, rays: Rays, wavelength_nm: Tensor | float, towards: Towards, wanted: _Wanted, freeze: bool
) -> Traced:
    sense, order = _way(lens, towards)
    vertices = lens.vertices_mm
    wavelength_nm, lit = sound_wavelength(lens, wavelength_nm, rays.x.dtype)
    glasses = media(lens, wavelength_nm)  # glasses[k] lies before surface k as light travels to the film
    mode = Mode(sense, freeze or wanted.path or bool(wanted.record), freeze)
    r, tests = start(rays, glasses[0 if sense > 0 else -1], mode, st.blocked(order[0], st.MISSED), lit)
    power = Passage(lens, wavelength_nm, rays.x) if wanted.transmittance else None
    crossings: dict[int, Crossing] = {}
    path: list[Rays] = []
    vertex = 0.0
    for position, k in enumerate(order):
        # Move to this surface's frame, where float32 keeps its precision.
        r = r._replace(z=r.z + (vertex - vertices[k]))
        vertex = vertices[k]
        before, after = (glasses[k], glasses[k + 1]) if sense > 0 else (glasses[k + 1], glasses[k])
        hit = meet(lens, k, r, before, position == 0, mode, tests)
        bent, q, q2 = bend(lens.surfaces[k], k, r, hit, before, after, mode, tests)
        if power is not None:
            power.pass_surface(k, r, hit, q, (before, after), sense)
        if k in wanted.record:
            margins = times(hit.q2, before.inverse_n2), times(q2, after.inverse_n2)
            crossings[k] = Crossing(*unfolded(lens.surfaces[k], hit), *margins)
        # A lost ray goes on along the axis: no overflow there can reach the gradients of the others.
        r = along_axis(bent, tests, sense, 0.0) if freeze else bent
        if wanted.path:
            path.append(unit(r._replace(z=r.z + vertex), after))
    r = along_axis(unit(r._replace(z=r.z + vertex), after), tests, sense, vertex)
    arrived = None if power is None else tests.only(power.arrived(), 0.0)
    return Traced(r, tests.status(), arrived, crossings, tuple(path))


def _passing_chunk(lens: Lens, rays: Rays, wavelength_nm: float, towards: Towards) -> Tensor:
    sense, order = _way(lens, towards)
    vertices, glasses, mode = lens.vertices_mm, media(lens, wavelength_nm), Mode(sense, False, False)
    r, tests = start(rays, glasses[0 if sense > 0 else -1], mode, st.blocked(order[0], st.MISSED))
    left, vertex = torch.arange(len(rays.x)), 0.0
    for position, k in enumerate(order):
        r = r._replace(z=r.z + (vertex - vertices[k]))
        vertex = vertices[k]
        before, after = (glasses[k], glasses[k + 1]) if sense > 0 else (glasses[k + 1], glasses[k])
        hit = meet(lens, k, r, before, position == 0, mode, tests)
        r = bend(lens.surfaces[k], k, r, hit, before, after, mode, tests)[0]
        if float(tests.passed().sum()) < _FEWER * len(left):
            alive = torch.nonzero(tests.passed())[:, 0]
            r, left = Rays(*(c.index_select(0, alive) for c in r)), left.index_select(0, alive)
            tests = Counts(torch.ones_like(r.x), st.PASSED)
    passed = torch.zeros(len(rays.x), dtype=torch.bool)
    passed[left] = tests.passed() > 0
    return passed


def _room(part: Any, count: int) -> Any:
    """The same structure with room for `count` rays."""
    if isinstance(part, Tensor):
        return part.new_empty(count)
    if isinstance(part, dict):
        return {k: _room(v, count) for k, v in part.items()}
    if isinstance(part, tuple):
        rooms = [_room(v, count) for v in part]
        return type(part)(*rooms) if hasattr(part, "_fields") else tuple(rooms)
    return part


def _fill(whole: Any, part: Any, at: slice) -> None:
    if isinstance(part, Tensor):
        whole[at] = part
    elif isinstance(part, dict):
        for k, v in part.items():
            _fill(whole[k], v, at)
    elif isinstance(part, tuple):
        for a, b in zip(whole, part, strict=True):
            _fill(a, b, at)


class Differentials(NamedTuple):
    """A traced ray and its derivatives.

    Attributes:
        traced: as `trace` gives it.
        derivatives: for every parameter, the derivatives of the resulting ray: x, y, z (mm per unit of it) and
            direction, each [N]; 0 for rays that do not go on. Points move on the last surface.
    """

    traced: Traced
    derivatives: tuple[Rays, ...]


def trace_differentials(
    lens: Lens, rays: Rays, derivatives: Sequence[Rays], wavelength_nm: Tensor | float | None = None
) -> Differentials:
    """Trace camera rays together with their derivatives.

    Args:
        derivatives: of the rays with respect to some parameters, one `Rays` each (components [N]), such as those of
            `film_derivatives`; the rest as for `trace`.

    Raises:
        InputError: as `trace`, and a derivative whose components have not the shape and dtype of the rays.
    """
    for n, derivative in enumerate(derivatives):
        for name, c, r in zip(Rays._fields, derivative, rays, strict=True):
            if c.shape != r.shape or c.dtype != r.dtype:
                found, expected = (f"{tuple(t.shape)}, {t.dtype}" for t in (c, r))
                raise InputError("trace", f"derivatives[{n}].{name}", f"({found})", f"like the rays: {expected}")
    traced, carried = None, []
    for derivative in derivatives:
        with forward_ad.dual_level():
            pairs = zip(rays, derivative, strict=True)
            dual = Rays(*(forward_ad.make_dual(r.contiguous(), t.contiguous()) for r, t in pairs))
            out = trace(lens, dual, wavelength_nm)
            parts = [forward_ad.unpack_dual(c) for c in out.rays]
            moved = (torch.zeros_like(p.primal) if p.tangent is None else p.tangent for p in parts)
            # A lost ray was replaced by one along the axis, whose derivative is 0 already; others may carry NaN.
            carried.append(Rays(*(torch.nan_to_num(s, 0.0, 0.0, 0.0) for s in moved)))
            traced = out._replace(rays=Rays(*(p.primal for p in parts)))
    traced = trace(lens, rays, wavelength_nm) if traced is None else traced
    return Differentials(traced, tuple(carried))


def film_derivatives(rays: Rays, distance_mm: Tensor | float) -> tuple[Rays, Rays]:
    """Derivatives of camera rays with respect to the film point's x and y (mm), the pupil point held.

    Args:
        rays: from the film point towards the pupil point, unit directions, each [N].
        distance_mm: from film point to pupil point along the ray, positive, number or [N].

    With d = (P - F) / |P - F|, dd/dF_x = (d d_x - e_x) / |P - F|.
    """
    zero, one = torch.zeros_like(rays.x), torch.ones_like(rays.x)
    found = []
    for axis, along in enumerate((rays.dx, rays.dy)):
        e = [0.0, 0.0, 0.0]
        e[axis] = 1.0
        dx, dy, dz = ((c * along - k) / distance_mm for c, k in zip(rays[3:], e, strict=True))
        found.append(Rays(one * e[0], one * e[1], zero, dx, dy, dz))
    return found[0], found[1]
