"""The exact tracer: every ray through every surface, in either direction, with the same code.

This is the truth that surrogates are measured against. Rays are separate tensors of shape [N] (a structure of
arrays); float64 for truth, float32 for speed. A ray that cannot go on carries a status and stays finite.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any, Literal, NamedTuple

import torch
from torch import Tensor

from neurolens import status as st
from neurolens.errors import InputError
from neurolens.optics import glass
from neurolens.optics.prescription import Lens, Surface
from neurolens.optics.surfaces import Hit, Rays, fresnel_transmittance, intersect_plane, intersect_sphere, refract

__all__ = ["CHUNK", "Crossing", "Rays", "Traced", "compile_trace", "trace"]

Towards = Literal["scene", "film"]

# Rays per chunk: long enough to hide the cost of calling an operator, short enough for a core's second-level cache.
CHUNK = 32768

# How far the squared length of a direction may be from 1; float32 rounding is a thousandth of this.
UNIT_SLACK = 1e-3


class Crossing(NamedTuple):
    """Where rays cross one surface, each [N]; mm, and the margins of Snell's and the sphere's square roots.

    `meets` is positive where the ray meets the surface, `refracts` where it is not totally reflected there.
    """

    x: Tensor
    y: Tensor
    meets: Tensor
    refracts: Tensor


class Traced(NamedTuple):
    """What tracing gives.

    Attributes:
        rays: point on the last surface met (lens frame, mm) and unit direction after it. Rays that missed a surface or
            were totally reflected are replaced by a finite ray along the axis; rays that only a rim stops go on, so
            that their crossings can be learnt from.
        status: [N] int32, see `neurolens.status`.
        transmittance: [N], product over surfaces of (Ts + Tp) / 2, or None when not asked for.
        crossings: surface index to `Crossing`, for the surfaces asked for.
    """

    rays: Rays
    status: Tensor
    transmittance: Tensor | None
    crossings: dict[int, Crossing]


def trace(
    lens: Lens,
    rays: Rays,
    wavelength_nm: Tensor | float = glass.LINE_D_NM,
    *,
    towards: Towards = "scene",
    transmittance: bool = False,
    record: Sequence[int] = (),
) -> Traced:
    """Trace rays through the whole lens.

    Args:
        lens: the prescription; its stop's diameter is the opening that clips.
        rays: points and unit directions [N], lens frame, mm. The dtype (float32 or float64) is that of the result.
        wavelength_nm: one number, or a tensor [N]; NaN and what is not positive pass no dispersive glass.
        towards: "scene" for camera rays (-z), "film" for light from the scene (+z).
        transmittance: whether to follow the Fresnel transmittance.
        record: surfaces whose crossings are wanted.

    Raises:
        InputError: components of unequal shapes or dtypes or of another dtype, a wavelength of another shape or a
            number that is not positive, an unknown `towards`, a surface to record that the lens does not have.

    A direction that is not a unit vector counts as a miss of the first surface.
    Differentiable with respect to rays, wavelength and prescription fields given as tensors.
    """
    _check(lens, rays, wavelength_nm, towards, record)
    if isinstance(wavelength_nm, Tensor):
        # In the precision of the rays, or a float64 wavelength would turn float32 rays into float64 halfway.
        wavelength_nm = torch.where(wavelength_nm > 0, wavelength_nm, math.nan).to(rays.x.dtype)
    needs_grad = torch.is_grad_enabled() and any(
        isinstance(v, Tensor) and v.requires_grad for v in (*rays, wavelength_nm, *_parameters(lens))
    )
    count = rays.x.shape[0]
    if needs_grad or count <= CHUNK:
        return _trace_chunk(lens, rays, wavelength_nm, towards, transmittance, tuple(record), needs_grad)
    parts = []
    for i in range(0, count, CHUNK):
        part = slice(i, i + CHUNK)
        lam = wavelength_nm[part] if isinstance(wavelength_nm, Tensor) and wavelength_nm.ndim else wavelength_nm
        chunk = Rays(*(c[part] for c in rays))
        parts.append(_trace_chunk(lens, chunk, lam, towards, transmittance, tuple(record), False))
    return Traced(
        Rays(*(torch.cat(c) for c in zip(*(p.rays for p in parts), strict=True))),
        torch.cat([p.status for p in parts]),
        torch.cat([p.transmittance for p in parts if p.transmittance is not None]) if transmittance else None,
        {k: Crossing(*(torch.cat(c) for c in zip(*(p.crossings[k] for p in parts), strict=True))) for k in record},
    )


def compile_trace(
    lens: Lens, *, towards: Towards = "scene", transmittance: bool = False, record: Sequence[int] = ()
) -> Callable[[Rays, Tensor], Traced]:
    """The same trace with the prescription folded in as constants, compiled by torch for chunks of one length.

    The result takes rays and wavelengths [N]; every new N compiles anew, so call it with chunks of one length.
    Without a C++ compiler the first call raises torch's own error; the eager `trace` needs none.
    """

    def run(rays: Rays, wavelength_nm: Tensor) -> Traced:
        return _trace_chunk(lens, rays, wavelength_nm, towards, transmittance, tuple(record), False)

    return torch.compile(run, dynamic=False)


def _parameters(lens: Lens) -> list[Any]:
    return [v for s in lens.surfaces for v in (s.radius_mm, s.thickness_mm, s.n_d)]


def _check(lens: Lens, rays: Rays, wavelength_nm: Tensor | float, towards: str, record: Sequence[int]) -> None:
    shape, dtype = rays.x.shape, rays.x.dtype
    if dtype not in (torch.float32, torch.float64):
        raise InputError("trace", "rays.x", f"({dtype})", "torch.float32 or torch.float64")
    for name, c in zip(Rays._fields, rays, strict=True):
        if c.shape != shape or c.dtype != dtype or c.ndim != 1:
            raise InputError(
                "trace", f"rays.{name}", f"({tuple(c.shape)}, {c.dtype})", f"[N] like x: {tuple(shape)}, {dtype}"
            )
    if isinstance(wavelength_nm, Tensor):
        if wavelength_nm.ndim and wavelength_nm.shape != shape:
            raise InputError(
                "trace", "wavelength_nm", f"({tuple(wavelength_nm.shape)})", f"a number or a tensor {tuple(shape)}"
            )
    elif not 0 < wavelength_nm < math.inf:
        raise InputError("trace", "wavelength_nm", wavelength_nm, "a positive number")
    if towards not in ("scene", "film"):
        raise InputError("trace", "towards", towards, '"scene" or "film"')
    if any(not 0 <= k < len(lens.surfaces) for k in record):
        raise InputError("trace", "record", tuple(record), f"surfaces from 0 to {len(lens.surfaces) - 1}")


def _trace_chunk(
    lens: Lens,
    rays: Rays,
    wavelength_nm: Tensor | float,
    towards: Towards,
    transmittance: bool,
    record: tuple[int, ...],
    freeze: bool,
) -> Traced:
    sense, order = (1, range(len(lens.surfaces))) if towards == "film" else (-1, range(len(lens.surfaces) - 1, -1, -1))
    vertices = lens.vertices_mm
    media = _indices(lens, wavelength_nm)  # media[k] lies before surface k as light travels to the film
    guard = freeze or bool(record)
    length2 = torch.addcmul(torch.addcmul(rays.dx * rays.dx, rays.dy, rays.dy), rays.dz, rays.dz)
    sound = (length2 - 1).abs() < UNIT_SLACK
    if freeze:
        # Not even a NaN that comes in may reach the gradients of the others.
        sound = sound & torch.isfinite(rays.x + rays.y + rays.z)
        rays = _along_axis(rays, sound, sense, 0.0)
    tests = _Tests(sound, st.blocked(order[0], st.MISSED))
    power = torch.ones_like(rays.x) if transmittance else None
    crossings: dict[int, Crossing] = {}
    r, vertex = rays, 0.0
    for position, k in enumerate(order):
        # Move to this surface's own frame, where float32 keeps its digits.
        r = r._replace(z=r.z + (vertex - vertices[k]))
        vertex = vertices[k]
        before, after = (media[k], media[k + 1]) if sense > 0 else (media[k + 1], media[k])
        hit, r, cos_t, cos2_t = _pass_surface(lens, k, r, (before, after), sense, position == 0, guard, tests)
        if power is not None and cos_t is not None:
            power = power * fresnel_transmittance(hit.cos_i, cos_t, before / after)
        if k in record:
            crossings[k] = Crossing(hit.x, hit.y, hit.discriminant, cos2_t)
        if freeze:
            # A lost ray goes on along the axis: no overflow there can reach the gradients of the others.
            r = _along_axis(r, tests.goes_on, sense, 0.0)
    r = _along_axis(r._replace(z=r.z + vertex), tests.goes_on, sense, vertex)
    if power is not None:
        power = torch.where(tests.goes_on, power, 0.0)
    return Traced(r, tests.status, power, crossings)


def _pass_surface(
    lens: Lens, k: int, r: Rays, media: tuple[Any, Any], sense: int, entering: bool, guard: bool, tests: _Tests
) -> tuple[Hit, Rays, Tensor | None, Tensor]:
    """Meet surface k, test its rim, refract.

    Returns the meeting point, the rays after it, their cosine of refraction (None where the medium does not change),
    and the margin by which they are not totally reflected.
    """
    surface = lens.surfaces[k]
    c = 0.0 if _is_plane(surface) else surface.curvature
    hit = intersect_plane(r, sense) if _is_plane(surface) else intersect_sphere(r, c, sense, entering, guard)
    tests.require(hit.met, k, st.MISSED)
    distance2 = torch.addcmul(hit.x * hit.x, hit.y, hit.y)
    tests.require(distance2 <= surface.semi_diameter_mm**2, k, st.RIM)
    if _is_plane(surface):
        # A sphere's square root turns NaN and overflow into a miss; a plane would let them go on.
        tests.goes_on = tests.goes_on & (distance2 < math.inf)
    before, after = media
    if before is after:
        return hit, Rays(hit.x, hit.y, hit.z, r.dx, r.dy, r.dz), None, hit.discriminant
    bent, cos_t, cos2_t = refract(r, hit, c, sense, before / after, guard)
    tests.require(cos2_t > 0, k, st.TOTAL_REFLECTION)
    return hit, bent, cos_t, cos2_t


class _Tests:
    """The tests at each surface (met, inside the rim, not totally reflected), in that order; first failure rules."""

    def __init__(self, sound: Tensor, otherwise: int) -> None:
        """Start with rays whose direction is `sound` [N]; the others have the status `otherwise`."""
        self.status = (~sound).to(torch.int32) * otherwise
        self.goes_on = sound

    def require(self, passed: Tensor, surface: int, reason: int) -> None:
        """Apply the next test. A rim alone lets a ray go on (its crossings are learnt from); the other two end it."""
        self.status = torch.where(passed | (self.status != 0), self.status, st.blocked(surface, reason))
        if reason != st.RIM:
            self.goes_on = self.goes_on & passed


def _along_axis(r: Rays, goes_on: Tensor, sense: int, z: Any) -> Rays:
    on_axis = (0.0, 0.0, z, 0.0, 0.0, float(sense))
    return Rays(*(torch.where(goes_on, c, a) for a, c in zip(on_axis, r, strict=True)))


def _is_plane(surface: Surface) -> bool:
    return not isinstance(surface.radius_mm, Tensor) and math.isinf(surface.radius_mm)


def _indices(lens: Lens, wavelength_nm: Tensor | float) -> list[Any]:
    """Index of the media from the scene (air) to the film; the same object where the medium does not change."""
    inverse = glass.inverse_square_um(wavelength_nm) if lens.dispersive else None
    known: dict[tuple[Any, float | None], Any] = {(1.0, None): 1.0}
    media: list[Any] = [known[1.0, None]]
    for s in lens.surfaces:
        key = (id(s.n_d) if isinstance(s.n_d, Tensor) else float(s.n_d), s.V_d)
        if key not in known:
            a, b = glass.cauchy_coefficients(s.n_d, s.V_d)
            known[key] = a if s.V_d is None else a + b * inverse
        media.append(known[key])
    return media
