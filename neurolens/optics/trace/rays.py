"""The exact tracer, in either direction: the reference that surrogates are measured by.

Rays are separate tensors of shape [N], in float64 for truth or in float32 for speed. A ray that cannot go on gets a
status and stays finite. `follow` traces ghosts: they meet the same surfaces with the same tests, but may be reflected.
"""

import math
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, Literal, NamedTuple

import torch
from torch import Tensor
from torch.autograd import forward_ad

from neurolens.base import status as st
from neurolens.base.errors import InputError
from neurolens.base.tasks import keep_memory
from neurolens.optics.lens import glass
from neurolens.optics.lens.prescription import Lens, Surface
from neurolens.optics.trace.arithmetic import is_number, times
from neurolens.optics.trace.films import TensorPassage
from neurolens.optics.trace.shapes import is_deep, traced_curve
from neurolens.optics.trace.surfaces import (
    UNIT_SLACK,
    Hit,
    Medium,
    Rays,
    SurfaceStep,
    Test,
    Towards,
    cross,
    media,
    nearest_approach,
    radius2,
    rim_tests,
)
from neurolens.optics.trace.tensors import Survival, Tensors, at_most

# Rays per chunk: enough to hide the cost of calling an operator, few enough for a core's second-level cache.
CHUNK = 32768


class Crossing(NamedTuple):
    """The crossings of rays with one surface, each [N].

    Attributes:
        x, y: points, mm. Those on the far half of a sphere, beyond any rim, lie mirrored outwards (see `_unfolded`).
        meets: positive where the ray meets the surface: what stands under the square root for the meeting.
        refracts: positive where the ray is not totally reflected: what stands under the root of Snell's law.
    """

    x: Tensor
    y: Tensor
    meets: Tensor
    refracts: Tensor


class Traced(NamedTuple):
    """Holds the result of a trace.

    Attributes:
        rays: point on the last surface met (lens frame, mm) and unit direction after it. Rays that missed a surface or
            were totally reflected are replaced by finite rays along the axis; those that only a rim stops go on.
        status: [N] int32, see `neurolens.base.status`.
        transmittance: [N], share of unpolarised power that arrives, after surfaces and absorption; None unless
            requested.
        crossings: the `Crossing` of each recorded surface, by its index.
        path: the rays on and after every surface, in the order of travel; empty unless requested.
    """

    rays: Rays
    status: Tensor
    transmittance: Tensor | None
    crossings: dict[int, Crossing]
    path: tuple[Rays, ...] = ()


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
    """Trace rays through the whole lens, differentiably in rays, wavelength and prescription fields that are tensors.

    Args:
        lens: the prescription; the diameter of its stop is the opening that clips.
        rays: points and unit directions [N], lens frame, mm. Their dtype (float32 or float64) is that of the result. A
            direction that is not a unit vector counts as a miss of the first surface.
        wavelength_nm: a number, or a tensor [N]; None takes `Lens.reference_nm`. In a lens that disperses, rays of a
            tensor's wavelengths outside `glass.stated_nm`, or NaN, get the status of what is outside the domain.
        towards: "scene" for camera rays (-z), "film" for light from the scene (+z).
        transmittance: whether to follow the power of unpolarised light, with the polarisation that surfaces give to it.
        record: the surfaces whose crossings are wanted.
        path: whether the points on all surfaces and the directions after them are wanted.

    Raises:
        InputError: components of unequal shapes or dtypes or of another dtype, a wavelength of another shape or a
            number outside `glass.stated_nm`, an unknown `towards`, a surface to record that the lens does not have.
    """
    wavelength_nm = lens.reference_nm if wavelength_nm is None else wavelength_nm
    check_rays(lens, rays, wavelength_nm)
    if not torch.compiler.is_compiling():
        keep_memory()
    if towards not in ("scene", "film"):
        raise InputError("trace", "towards", towards, '"scene" or "film"')
    if any(not 0 <= k < len(lens.surfaces) for k in record):
        raise InputError("trace", "record", tuple(record), f"surfaces from 0 to {len(lens.surfaces) - 1}")
    needs_grad = any(_differentiated(v) for v in (*rays, wavelength_nm, *_parameters(lens)))
    chunk = partial(
        _trace_chunk, lens, towards=towards, transmittance=transmittance, record=record, path=path, freeze=needs_grad
    )
    count = rays.x.shape[0]
    if needs_grad or count <= CHUNK:
        return chunk(rays, wavelength_nm)
    parts = []
    for i in range(0, count, CHUNK):
        part = slice(i, i + CHUNK)
        lam = wavelength_nm[part] if isinstance(wavelength_nm, Tensor) and wavelength_nm.ndim else wavelength_nm
        parts.append(chunk(Rays(*(c[part] for c in rays)), lam))
    return _joined(parts)


plain_trace = torch.no_grad()(trace)  # without derivatives, for those who only read off where rays go


def optical_path(
    lens: Lens, points: Sequence[Rays], wavelength_nm: Tensor | float, towards: Towards = "film"
) -> Tensor:
    """Return the optical path [N] in mm along the `points` of rays: their start, then `Traced.path`, then any end."""
    length = torch.zeros_like(points[0].x)
    order = media(lens, wavelength_nm)[:: 1 if towards == "film" else -1]
    for medium, before, after in zip(order, points, points[1:], strict=False):
        # Along the ray, which is no distance: steps back to the stop inside an element count as negative.
        length = length + medium.n * sum((b - a) * d for a, b, d in zip(before[:3], after[:3], before[3:], strict=True))
    return length


def _joined(parts: Sequence[Any]) -> Any:
    """Join the results of several chunks."""
    first = parts[0]
    if isinstance(first, Tensor):
        return torch.cat(list(parts))
    if isinstance(first, dict):
        return {k: _joined([part[k] for part in parts]) for k in first}
    if isinstance(first, tuple):
        columns = [_joined(column) for column in zip(*parts, strict=True)]
        return type(first)(*columns) if hasattr(first, "_fields") else tuple(columns)
    return first


def _differentiated(value: Any) -> bool:
    """Test whether derivatives with respect to a value are followed, backwards or forwards."""
    if not isinstance(value, Tensor):
        return False
    return (value.requires_grad and torch.is_grad_enabled()) or forward_ad.unpack_dual(value).tangent is not None


def _parameters(lens: Lens) -> list[Any]:
    found: list[Any] = []
    for s in lens.surfaces:
        found += (s.radius_mm, s.thickness_mm, s.n_d, s.V_d, s.absorption_per_mm, s.figure.conic)
        found += (a for _, a in s.figure.powers)
        found += (figure for layer in (s.coating.layers if s.coating else ()) for figure in layer)
    return found


class Tracing:
    """Takes rays through a lens, surface by surface.

    Args:
        lens, rays, wavelength_nm: as for `trace`.
        sense: the direction of travel in which the rays start, +1 towards the film.
        entering: the surface that they meet first.
        guard: whether lost rays stay finite on the way.
        freeze: whether lost rays are put on the axis at once, for the sake of gradients.
    """

    def __init__(
        self, lens: Lens, rays: Rays, wavelength_nm: Any, sense: int, entering: int, guard: bool, freeze: bool = False
    ) -> None:
        self.lens, self.sense, self.freeze = lens, sense, freeze
        self.o = Tensors(guard or freeze, rays.x.dtype)
        self.wavelength_nm, lit = sound_wavelength(lens, wavelength_nm, rays.x.dtype)
        self.media = media(lens, self.wavelength_nm)  # media[k] lies in front of surface k, seen from the scene
        self.curves = [traced_curve(s) for s in lens.surfaces]
        self.medium = self.media[0 if sense > 0 else -1]
        self.vertex: Any = 0.0
        self._entering: int | None = entering
        self.tests, self.rays = self._start(rays, lit, entering)

    def _start(self, rays: Rays, lit: Tensor | None, entering: int) -> tuple[Survival, Rays]:
        """Return the rays with optical direction cosines, and the tests, which begin with that for unit directions."""
        o = self.o
        sound = at_most((o.dot(rays[3:], rays[3:]) - 1).abs(), UNIT_SLACK)
        if self.freeze:
            # A NaN in one ray must not reach the gradients of the others.
            sound = sound * torch.isfinite(rays.x * rays.x + rays.y * rays.y + rays.z * rays.z)
        if lit is None:
            tests = Survival(sound, st.blocked(entering, st.MISSED))
        else:
            tests = Survival(torch.ones_like(sound) * lit, st.OUTSIDE_DOMAIN)  # also of one wavelength for all rays
            tests.require([(0.5, sound)], entering, st.MISSED)
        if self.freeze:
            rays = tests.along_axis(rays, self.sense, 0.0)
        if self.sense > 0:
            # Light may start far away; near the lens, float32 keeps points and directions consistent.
            rays = Rays(*nearest_approach(o, rays, 1.0), *rays[3:])
        return tests, Rays(*rays[:3], *(times(d, self.medium.n) for d in rays[3:]))

    def cross(self, k: int, reflected: bool = False) -> tuple[Rays, SurfaceStep, tuple[Medium, Medium]]:
        """Go on to surface k and through it, or back from it where `reflected`.

        Returns:
            The rays before the surface, in its vertex frame, what it does to them, and the media as they meet them.
        """
        lens, surface = self.lens, self.lens.surfaces[k]
        vertex = lens.vertices_mm[k]
        # In the surface's own frame float32 keeps its precision.
        r, self.vertex = self.rays._replace(z=self.rays.z + (self.vertex - vertex)), vertex
        met_media = (self.media[k], self.media[k + 1]) if self.sense > 0 else (self.media[k + 1], self.media[k])
        crossed = cross(
            self.o, surface, self.curves[k], r, self.sense, *met_media,
            entering=k == self._entering, reflected=reflected, rim=self._rim(surface),
        )  # fmt: skip
        for tests, reason in crossed.tests:
            self.tests.require(tests, k, reason)
        if self.curves[k].flat:
            # A sphere's square root makes a miss of NaN and overflow; a plane would let them pass.
            self.tests.end(radius2(self.o, crossed.met))
        self.rays, self._entering = crossed.bent.rays, None
        self.medium = met_media[0 if reflected else 1]
        self.sense = -self.sense if reflected else self.sense
        # A lost ray goes on along the axis, where no overflow can reach the gradients of the others.
        if self.freeze:
            self.rays = self.tests.along_axis(self.rays, self.sense, 0.0)
        return r, crossed, met_media

    def _rim(self, surface: Surface) -> Callable[[Hit], list[Test]] | None:
        aperture, radius_mm = self.lens.aperture, surface.semi_diameter_mm
        if aperture is None or not surface.stop:
            return None
        outer = rim_tests(self.o, surface)
        return lambda met: [*outer(met), (0.5, aperture.inside(met.x, met.y, radius_mm).to(met.x.dtype))]

    def in_lens_frame(self) -> Rays:
        """Return the rays behind the last surface with unit directions."""
        r, n = self.rays._replace(z=self.rays.z + self.vertex), self.medium.n
        return r if is_number(n) and n == 1 else Rays(*r[:3], *(d / n for d in r[3:]))

    def leave(self) -> Rays:
        """Return the rays in the lens frame; those that did not go on run along the axis."""
        return self.tests.along_axis(self.in_lens_frame(), self.sense, self.vertex)


def _trace_chunk(
    lens: Lens,
    rays: Rays,
    wavelength_nm: Tensor | float,
    *,
    towards: Towards,
    transmittance: bool,
    record: Sequence[int],
    path: bool,
    freeze: bool,
) -> Traced:
    sense, order = (1, range(len(lens.surfaces))) if towards == "film" else (-1, range(len(lens.surfaces))[::-1])
    tracing = Tracing(lens, rays, wavelength_nm, sense, order[0], path or bool(record), freeze)
    power = TensorPassage(tracing.o, lens, tracing.wavelength_nm) if transmittance else None
    crossings: dict[int, Crossing] = {}
    passed: list[Rays] = []
    for k in order:
        r, (met, bent, _, own), (before, after) = tracing.cross(k)
        if power is not None:
            power.pass_surface(k, r, met, bent.q, (before, after), sense)
        if k in record:
            margins = times(met.q2, before.inverse_n2), times(bent.q2, after.inverse_n2)
            crossings[k] = Crossing(*_unfolded(lens.surfaces[k], own), *margins)
        if path:
            passed.append(tracing.in_lens_frame())
    arrived = None if power is None else tracing.tests.only(power.arrived(rays.x), 0.0)
    return Traced(tracing.leave(), tracing.tests.status(), arrived, crossings, tuple(passed))


def _unfolded(surface: Surface, met: Hit) -> tuple[Tensor, Tensor]:
    """Return x and y of a meeting, [N] each, mm, mirrored outwards at the equator on the far half of a deep sphere.

    The distance from the axis then grows on beyond a deep rim, where it would fall again, and so tells the halves
    apart.
    """
    if not is_deep(surface):
        return met.x, met.y
    height = torch.hypot(met.x, met.y).clamp_min(1e-300)
    outwards = torch.where(met.z * surface.curvature > 1, 2 * abs(surface.radius_mm) / height - 1, 1.0)
    return met.x * outwards, met.y * outwards


def check_rays(lens: Lens, rays: Rays, wavelength_nm: Tensor | float) -> None:
    """Check that the components of rays are float tensors [N] of one length and dtype, and the wavelengths fit them.

    Wavelengths of a tensor on a GPU are not held against the glasses, for the host would have to wait.

    Raises:
        InputError: they are not, or as `glass.check_light`.

    Warns:
        NeurolensWarning: as `glass.check_light`.
    """
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
        if wavelength_nm.device.type == "cpu" and not torch.compiler.is_compiling():
            low, high = glass.stated_nm(lens)
            known = wavelength_nm.detach()[(wavelength_nm >= low) & (wavelength_nm <= high)]  # other rays have a status
            for nm in torch.stack(known.aminmax()).tolist() if known.numel() else ():
                glass.check_light(lens, nm)
    elif not 0 < wavelength_nm < math.inf:
        raise InputError("trace", "wavelength_nm", wavelength_nm, "a positive number")
    else:
        glass.check_light(lens, wavelength_nm)


def sound_wavelength(
    lens: Lens, wavelength_nm: Tensor | float, dtype: torch.dtype
) -> tuple[Tensor | float, Tensor | None]:
    """The wavelengths in the precision of the rays, invalid ones replaced by the d line, and which are valid [N].

    A NaN in an index would reach the gradients of the prescription, and a float64 wavelength would turn float32 rays
    into float64 halfway. The second result is None where all are valid or, without dispersion, irrelevant.
    """
    if not isinstance(wavelength_nm, Tensor):
        return wavelength_nm, None
    low, high = glass.stated_nm(lens)
    sound = (wavelength_nm >= low / st.DOMAIN_SLACK) & (wavelength_nm <= high * st.DOMAIN_SLACK)
    return torch.where(sound, wavelength_nm, glass.LINE_D_NM).to(dtype), sound if lens.dispersive else None


# ---- ghosts: light that any sequence of surfaces refracts or reflects ----

Action = Literal["T", "R"]
Steps = Sequence[tuple[int, Action]]


class GhostTrace(NamedTuple):
    """Holds the result of following a sequence of surfaces.

    Attributes:
        rays: point on the last surface and unit direction after it, lens frame, mm; along the axis for lost rays.
        status: [N] int32 as in `trace`: the surface and the reason that ended a ray first.
        power: [N], the share of unpolarised power that the surfaces send on and the glass does not absorb.
        points: x, y, z of the meeting points at every step, lens frame, mm.
    """

    rays: Rays
    status: Tensor
    power: Tensor
    points: tuple[tuple[Tensor, Tensor, Tensor], ...]


def turning(count: int, reflections: Sequence[int]) -> list[tuple[int, Action]]:
    """Return the surfaces that light passes from the front to the film, each with "T" or, where it reflects, "R".

    Args:
        count: of surfaces.
        reflections: the surfaces that reflect, in the order in which light meets them.
    """
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
        steps: the surfaces in the order in which they are met, each with "T" (refracted) or "R" (reflected).
        wavelength_nm: number or [N]; None takes `Lens.reference_nm`.
        towards: "film" for light that enters at the front, "scene" for light that enters at the rear.
        polarised: whether to follow the polarisation that each surface gives to the light, or to average it there.

    Raises:
        InputError: what `trace` raises for rays and wavelengths; no steps, or a surface that does not exist or is not
            the next one in the direction of travel.
    """
    wavelength_nm = lens.reference_nm if wavelength_nm is None else wavelength_nm
    check_rays(lens, rays, wavelength_nm)
    _check(len(lens.surfaces), steps, towards)
    tracing = Tracing(lens, rays, wavelength_nm, 1 if towards == "film" else -1, steps[0][0], guard=True)
    passage = TensorPassage(tracing.o, lens, tracing.wavelength_nm, polarised)
    points = []
    for k, action in steps:
        sense, reflected = tracing.sense, action == "R"
        r, (met, bent, _, _), mediums = tracing.cross(k, reflected)
        points.append((met.x, met.y, met.z + tracing.vertex))
        passage.pass_surface(k, r, met, bent.q, mediums, sense, reflected)
    power = tracing.tests.only(passage.arrived(rays.x), 0.0)
    return GhostTrace(tracing.leave(), tracing.tests.status(), power, tuple(points))


def _check(count: int, steps: Steps, towards: Towards) -> None:
    """Raise InputError unless the surfaces follow one another as light meets them."""
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
