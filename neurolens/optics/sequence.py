"""Light along any sequence of surfaces, reflected or refracted at each: the paths of ghosts.

The same surfaces, tests and refraction as in `trace`; in addition, light may be reflected.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal, NamedTuple

import torch
from torch import Tensor

from neurolens.base import status as st
from neurolens.base.errors import InputError
from neurolens.optics import coatings
from neurolens.optics.passing import (
    Mode,
    absorption_per_mm,
    along_axis,
    bend,
    check_rays,
    media,
    meet,
    sound_wavelength,
    start,
    unit,
)
from neurolens.optics.prescription import Lens, Surface
from neurolens.optics.surfaces import Hit, Medium, Rays, fresnel_transmittance, root, times
from neurolens.optics.transmission import Passage, normal_at, way_mm

Action = Literal["T", "R"]
Towards = Literal["scene", "film"]
Steps = Sequence[tuple[int, Action]]


class Followed(NamedTuple):
    """What following a sequence gives.

    Attributes:
        rays: point on the last surface and unit direction after it, lens frame, mm; along the axis for lost rays.
        status: [N] int32 as in `trace`: the surface and the reason that ended a ray first.
        power: [N], of unpolarised light, what surfaces transmit or reflect and glass does not absorb.
        points: x, y, z of the meeting points of every step, lens frame, mm.
    """

    rays: Rays
    status: Tensor
    power: Tensor
    points: tuple[tuple[Tensor, Tensor, Tensor], ...]


def ghost(count: int, first: int, second: int) -> list[tuple[int, Action]]:
    """The steps of the ghost that is reflected at surface `second`, then at `first` < `second`, of `count` surfaces.

    Raises:
        InputError: surfaces that do not exist or are in the wrong order.
    """
    if not 0 <= first < second < count:
        raise InputError("ghost", "first, second", (first, second), f"0 <= first < second < {count}")
    return turning(count, (second, first))


def turning(count: int, reflections: Sequence[int]) -> list[tuple[int, Action]]:
    """The steps of light from the front to the film of `count` surfaces, reflected at some of them in this order."""
    steps: list[tuple[int, Action]] = []
    at, sense = 0, 1
    for k in reflections:
        steps += [*((between, "T") for between in range(at, k, sense)), (k, "R")]
        at, sense = k - sense, -sense
    return [*steps, *((k, "T") for k in range(at, count))]


def follow(
    lens: Lens,
    rays: Rays,
    steps: Steps,
    wavelength_nm: Tensor | float | None = None,
    *,
    towards: Towards = "film",
    polarised: bool = False,
) -> Followed:
    """Follow light along a sequence of surfaces.

    Args:
        lens: the prescription; every rim and the stop are tested at every crossing.
        rays: points and unit directions [N], lens frame, mm; float32 or float64.
        steps: surfaces in the order in which they are met, "T" refracted or "R" reflected.
        wavelength_nm: number or [N]; None takes `Lens.reference_nm`.
        towards: "film" for light that enters at the front, "scene" for light that enters at the rear.
        polarised: whether to follow the polarisation that each surface gives to the light, or to average it there.

    Raises:
        InputError: as `trace` for rays and wavelengths; no steps, a surface that does not exist or is not the next one
            in the direction of travel.
    """
    wavelength_nm = lens.reference_nm if wavelength_nm is None else wavelength_nm
    check_rays(rays, wavelength_nm)
    _check(len(lens.surfaces), steps, towards)
    wavelength_nm, lit = sound_wavelength(lens, wavelength_nm, rays.x.dtype)
    glasses, vertices = media(lens, wavelength_nm), lens.vertices_mm
    absorption = absorption_per_mm(lens, wavelength_nm)
    mode = Mode(sense=1 if towards == "film" else -1, guard=True, freeze=False)
    after = glasses[0 if mode.sense > 0 else -1]
    r, tests = start(rays, after, mode, st.blocked(steps[0][0], st.MISSED), lit)
    power, vertex = torch.ones_like(r.x), 0.0
    passage = Passage(lens, wavelength_nm, r.x) if polarised else None
    points = []
    for position, (k, action) in enumerate(steps):
        r, vertex = r._replace(z=r.z + (vertex - vertices[k])), vertices[k]
        ahead = mode.sense > 0
        before, after = (glasses[k], glasses[k + 1]) if ahead else (glasses[k + 1], glasses[k])
        hit = meet(lens, k, r, before, position == 0, mode, tests)
        points.append((hit.x, hit.y, hit.z + vertex))
        surface, came, sense, met, q = lens.surfaces[k], r, mode.sense, (before, after), hit.q
        if action == "R":
            r, after, mode = _reflect(surface, r, hit, sense), before, mode._replace(sense=-sense)
        else:
            r, q, _ = bend(surface, k, r, hit, before, after, mode, tests)
        if passage is not None:
            passage.pass_surface(k, came, hit, q, met, sense, action == "R")
            continue
        power = power * _share(surface, hit, *met, sense, wavelength_nm, action)
        absorbed = absorption[k if ahead else k + 1]
        if absorbed is not None:
            power = power * torch.exp(-way_mm(came, hit, before) * absorbed)
    r = along_axis(unit(r._replace(z=r.z + vertex), after), tests, mode.sense, vertex)
    power = power if passage is None else passage.arrived()
    return Followed(r, tests.status(), tests.only(power, 0.0), tuple(points))


def backwards(steps: Steps) -> list[tuple[int, Action]]:
    """The steps of the same way from its end."""
    return list(reversed(steps))


def _reflect(surface: Surface, r: Rays, hit: Hit, sense: int) -> Rays:
    """The normal part of the direction turned round."""
    turn = -2 * sense * hit.q
    normal = normal_at(surface, hit)
    return Rays(hit.x, hit.y, hit.z, *(torch.addcmul(p, turn, n) for p, n in zip(r[3:], normal, strict=True)))


def _share(
    surface: Surface, hit: Hit, before: Medium, after: Medium, sense: int, wavelength_nm: Any, action: Action
) -> Tensor | float:
    """Unpolarised power that goes on, [N]: transmitted or reflected at one surface."""
    if surface.coating is not None and surface.coating.layers:
        share = coatings.reflectance if action == "R" else coatings.transmittance
        return share(times(hit.q, 1 / before.n), before.n, after.n, surface.coating.layers, wavelength_nm, sense)
    if before is after:
        return 0.0 if action == "R" else 1.0
    q2 = hit.q2 + (after.n - before.n) * (after.n + before.n)
    transmitted = fresnel_transmittance(hit.q, root(q2, True), before, after)
    return transmitted if action == "T" else torch.where(q2 > 0, 1 - transmitted, 1.0)


def _check(count: int, steps: Steps, towards: Towards) -> None:
    """Surfaces must follow one another as light meets them."""
    if not steps:
        raise InputError("sequence", "steps", "(none)", "at least one surface")
    if towards not in ("scene", "film"):
        raise InputError("sequence", "towards", towards, '"scene" or "film"')
    at, sense = (-1, 1) if towards == "film" else (count, -1)
    for n, (k, action) in enumerate(steps):
        if action not in ("T", "R"):
            raise InputError("sequence", f"step {n}", action, '"T" or "R"')
        if k != at + sense or not 0 <= k < count:
            raise InputError("sequence", f"step {n}", k, f"surface {at + sense}, of 0 to {count - 1}")
        at, sense = k, -sense if action == "R" else sense
