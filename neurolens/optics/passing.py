"""Passing one surface: intersection, tests, refraction; the media between surfaces, start and loss of rays."""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor

from neurolens.base import status as st
from neurolens.base.errors import InputError
from neurolens.optics import glass, prescription
from neurolens.optics.glass import LINE_D_NM
from neurolens.optics.prescription import Lens, Surface
from neurolens.optics.shapes import intersect_shape, is_plain
from neurolens.optics.surfaces import (
    AIR,
    Counts,
    Hit,
    Labels,
    Medium,
    Mode,
    Rays,
    Survival,
    also,
    at_most,
    intersect_plane,
    intersect_sphere,
    medium,
    nearest_approach,
    positive,
    refract,
    times,
)


def media(lens: Lens, wavelength_nm: Tensor | float) -> list[Medium]:
    """Media from the scene to the film; media(...)[k] lies before surface k. The same object where it does not change.

    `wavelength_nm` is a number or a tensor [N]; a dispersive medium has the shape of the wavelength.
    """
    known: dict[Any, Medium] = {"air": AIR}
    found = []
    for s in lens.media:
        key = _medium_key(s)
        if key not in known:
            known[key] = medium(glass.index_of(s, wavelength_nm))
        found.append(known[key])
    return found


def absorption_per_mm(lens: Lens, wavelength_nm: Tensor | float) -> list[Any]:
    """Napierian absorption of the media from the scene to the film, in 1/mm; None where there is none."""
    # What the medium in front of the lens absorbs is a matter of the scene.
    return [None, *(glass.absorption_of(s, wavelength_nm) for s in lens.surfaces)]


def _medium_key(s: Surface | prescription.Medium) -> Any:
    if s.glass is None and s.V_d is None and not isinstance(s.n_d, Tensor) and s.n_d == 1:
        return "air"
    return (s.glass, None if s.glass else (id(s.n_d) if isinstance(s.n_d, Tensor) else float(s.n_d), s.V_d))


# How far the squared length of a direction may be from 1; float32 rounding is a thousandth of this.
UNIT_SLACK = 1e-3

# Rim radius over radius of curvature from which on a sphere's rim is tested by its depth.
DEEP = 0.25


def check_rays(rays: Rays, wavelength_nm: Tensor | float) -> None:
    """Raise InputError for components of unequal or wrong shape or dtype, and such wavelengths, or one not positive."""
    shape, dtype = rays.x.shape, rays.x.dtype
    if dtype not in (torch.float32, torch.float64):
        raise InputError("trace", "rays.x", f"({dtype})", "torch.float32 or torch.float64")
    for name, c in zip(Rays._fields, rays, strict=True):
        if c.shape != shape or c.dtype != dtype or c.ndim != 1:
            found = f"({tuple(c.shape)}, {c.dtype})"
            raise InputError("trace", f"rays.{name}", found, f"[N] like x: {tuple(shape)}, {dtype}")
    if isinstance(wavelength_nm, Tensor):
        if wavelength_nm.ndim and wavelength_nm.shape != shape:
            found = f"({tuple(wavelength_nm.shape)})"
            raise InputError("trace", "wavelength_nm", found, f"a number or a tensor {tuple(shape)}")
    elif not 0 < wavelength_nm < math.inf:
        raise InputError("trace", "wavelength_nm", wavelength_nm, "a positive number")


def sound_wavelength(
    lens: Lens, wavelength_nm: Tensor | float, dtype: torch.dtype
) -> tuple[Tensor | float, Tensor | None]:
    """Wavelengths in the precision of the rays, invalid ones replaced by the d line, and which are valid [N].

    A NaN in an index would reach the gradients of the prescription, and float64 would spread to float32 rays halfway.
    None where all are valid or, without dispersion, irrelevant.
    """
    if not isinstance(wavelength_nm, Tensor):
        return wavelength_nm, None
    sound = (wavelength_nm > 0) & (wavelength_nm < math.inf)
    return torch.where(sound, wavelength_nm, LINE_D_NM).to(dtype), sound if lens.dispersive else None


def start(rays: Rays, first: Medium, mode: Mode, otherwise: int, lit: Tensor | None = None) -> tuple[Rays, Survival]:
    """Rays with optical direction cosines, and the test that their directions are unit vectors.

    `lit` [N] boolean: the other rays are ended before they start.
    """
    length2 = torch.addcmul(torch.addcmul(rays.dx * rays.dx, rays.dy, rays.dy), rays.dz, rays.dz)
    sound = at_most((length2 - 1).abs(), UNIT_SLACK, spend=mode.spend)
    if lit is not None:
        sound = also(sound, lit)
    if mode.freeze:
        # A NaN input must not reach the gradients of the other rays.
        sound = sound & torch.isfinite(rays.x * rays.x + rays.y * rays.y + rays.z * rays.z)
    tests = Counts(sound, otherwise) if mode.spend else Labels(sound, otherwise)
    if mode.freeze:
        rays = along_axis(rays, tests, mode.sense, 0.0)
    if mode.sense > 0:
        # Light may start far away; near the lens float32 keeps points and directions consistent.
        rays = Rays(*nearest_approach(rays, 1.0), *rays[3:])
    return Rays(*rays[:3], *(times(d, first.n) for d in rays[3:])), tests


def unit(r: Rays, last: Medium) -> Rays:
    """Rays with unit directions, from optical direction cosines in a medium."""
    if not isinstance(last.n, Tensor) and last.n == 1:
        return r
    return Rays(*r[:3], *(d / last.n for d in r[3:]))


def meet(lens: Lens, k: int, r: Rays, before: Medium, entering: bool, mode: Mode, tests: Survival) -> Hit:
    """Meet surface k and test its rim, or the shape of the stop."""
    surface = lens.surfaces[k]
    plane = _is_plane(surface)
    if plane:
        hit = intersect_plane(r, mode)
    elif is_plain(surface):
        hit = intersect_sphere(r, surface.curvature, mode, before, entering)
    else:
        hit = intersect_shape(r, surface, mode, before)
    tests.require(hit.met, k, st.MISSED)
    if is_deep(surface):
        # By its depth: a point on the far half of the sphere may be near the axis, but there is no glass.
        depth = hit.z * surface.curvature
        tests.require(at_most(depth, 1 - math.sqrt(1 - rim_sine(surface) ** 2), spend=mode.spend), k, st.RIM)
    else:
        distance2 = (hit.x * hit.x).addcmul_(hit.y, hit.y)
        if plane:
            # A sphere's square root turns NaN and overflow into a miss; a plane would pass them.
            tests.end(distance2 < math.inf)
        tests.require(at_most(distance2, surface.semi_diameter_mm**2, spend=mode.spend), k, st.RIM)
    if lens.aperture is not None and surface.stop:
        tests.require(lens.aperture.inside(hit.x, hit.y, lens.stop_radius_mm), k, st.RIM)
    return hit


def bend(
    surface: Surface, k: int, r: Rays, hit: Hit, before: Medium, after: Medium, mode: Mode, tests: Survival
) -> tuple[Rays, Tensor, Tensor]:
    """Refract at surface k.

    Returns the rays after it, n' times their cosine of refraction, and its square before guarding: the margin by which
    they are not totally reflected.
    """
    if surface.focal_mm is not None:
        return _ideal(surface.focal_mm, r, hit), hit.q, hit.q2
    if before is after:
        return Rays(hit.x, hit.y, hit.z, r.dx, r.dy, r.dz), hit.q, hit.q2
    c = 0.0 if _is_plane(surface) else surface.curvature
    bent, q, q2 = refract(r, hit, c, mode, before, after)
    if isinstance(before.n, Tensor) or before.n != 1:
        # From air nothing is totally reflected.
        tests.require(positive(q2, spend=mode.spend), k, st.TOTAL_REFLECTION)
    return bent, q, q2


def _ideal(focal_mm: float, r: Rays, hit: Hit) -> Rays:
    """Rays in air behind an ideal thin lens: slopes change by -x / f and -y / f, so that points become points."""
    towards = r.dz.abs() / focal_mm
    dx, dy = r.dx - towards * hit.x, r.dy - towards * hit.y
    scale = torch.rsqrt(dx * dx + dy * dy + r.dz * r.dz)
    return Rays(hit.x, hit.y, hit.z, dx * scale, dy * scale, r.dz * scale)


def along_axis(r: Rays, tests: Survival, sense: int, z: Any) -> Rays:
    """The rays that go on; the others replaced by rays along the axis from z."""
    on_axis = (0.0, 0.0, z, 0.0, 0.0, float(sense))
    return Rays(*(tests.only(c, a) for a, c in zip(on_axis, r, strict=True)))


def unfolded(surface: Surface, hit: Hit) -> tuple[Tensor, Tensor]:
    """x and y of a meeting, [N] each, mm; on the far half of a deep sphere mirrored outwards at its equator.

    So the distance from the axis grows on beyond a deep rim, where it would fall again, and tells the half.
    """
    if not is_deep(surface):
        return hit.x, hit.y
    height = torch.hypot(hit.x, hit.y).clamp_min(1e-300)
    outwards = torch.where(hit.z * surface.curvature > 1, 2 * abs(surface.radius_mm) / height - 1, 1.0)
    return hit.x * outwards, hit.y * outwards


def is_deep(surface: Surface) -> bool:
    """Whether a sphere's depth at its rim tells heights as exactly as their squares do."""
    if isinstance(surface.radius_mm, Tensor) or not is_plain(surface):
        return False
    return DEEP < rim_sine(surface) <= 1


def rim_sine(surface: Surface) -> float:
    """Rim radius over radius of curvature."""
    return abs(surface.semi_diameter_mm * surface.curvature)


def _is_plane(surface: Surface) -> bool:
    return not isinstance(surface.radius_mm, Tensor) and math.isinf(surface.radius_mm) and is_plain(surface)
