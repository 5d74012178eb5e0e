"""Ghost paths: light that any sequence of surfaces refracts or reflects.

The surfaces and their tests are those of `trace`; in addition, light may be reflected.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal, NamedTuple

from torch import Tensor

from neurolens.base.errors import InputError
from neurolens.lens.prescription import Lens
from neurolens.trace.rays import Tracing, check_rays
from neurolens.trace.surfaces import Rays
from neurolens.trace.transmission import Passage

Action = Literal["T", "R"]
Towards = Literal["scene", "film"]
Steps = Sequence[tuple[int, Action]]


class GhostTrace(NamedTuple):
    """The result of following a sequence.

    Attributes:
        rays: point on the last surface and unit direction after it, lens frame, mm; along the axis for lost rays.
        status: [N] int32 as in `trace`: the surface and the reason that ended a ray first.
        power: [N], the share of unpolarised light that the surfaces send on and the glass does not absorb.
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
) -> GhostTrace:
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
    tracing = Tracing(lens, rays, wavelength_nm, 1 if towards == "film" else -1, steps[0][0], guard=True)
    passage = Passage(tracing.o, lens, tracing.wavelength_nm, polarised)
    points = []
    for k, action in steps:
        sense, reflected = tracing.sense, action == "R"
        r, (met, bent, _), mediums = tracing.cross(k, reflected)
        points.append((met.x, met.y, met.z + tracing.vertex))
        passage.pass_surface(k, r, met, bent.q, mediums, sense, reflected)
    power = tracing.tests.only(passage.arrived(rays.x), 0.0)
    return GhostTrace(tracing.leave(), tracing.tests.status(), power, tuple(points))


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
