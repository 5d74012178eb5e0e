"""Ray errors of a surrogate against the exact lens.

Rays are those of a domain that the exact lens passes, independent of the model's status (false blocks are counted by
`vignetting`). Film-equivalent error: the exact and the approximate ray meet the plane in focus, and the
distance between the two points is taken back to the film with the exact lens's local Jacobian at that film point.
It is given for rays within 60 degrees of the axis; beyond, only angles are given.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor

from neurolens.base import status as st
from neurolens.base.errors import InputError
from neurolens.optics.paraxial import first_order
from neurolens.optics.prescription import Lens
from neurolens.optics.pupils import camera_rays, image_radius_mm
from neurolens.optics.surfaces import Rays
from neurolens.optics.trace import trace
from neurolens.surrogates.domain import Domain, FilmRays, focused_plane_z_mm, sample_domain
from neurolens.surrogates.pairs import PairSet

FIELD_LIMIT_DEG = 60.0
REFERENCE_RADIUS_MM = 21.6  # half the diagonal of 36 x 24 mm film: the common scale of lenses of different size
PIXELS_ACROSS = 4000


class Predicted(Protocol):
    """What `predict` gives for N rays: scene-side rays (lens frame, mm) and transmittance [N]."""

    @property
    def rays(self) -> Rays: ...
    @property
    def transmittance(self) -> Tensor: ...


def frame_width_mm(radius_mm: float) -> float:
    """Width of the 3:2 frame inscribed in an image circle (36 mm for 21.63 mm)."""
    return 2 * radius_mm * 3 / math.sqrt(13)


def pixel_um(domain: Domain) -> float:
    """Default pixel pitch: the width of the 3:2 frame inscribed in the domain's film circle, over 4000."""
    return 1000 * frame_width_mm(domain.film_radius_mm) / PIXELS_ACROSS


def ray_errors(
    lens: Lens,
    domain: Domain,
    held_out: PairSet,
    predict: Callable[[FilmRays], Predicted],
    *,
    pitch_um: float | None = None,
) -> dict[str, float]:
    """Errors over rays that the exact lens passes.

    Args:
        lens: the exact lens, in the state (zoom, stop) that the model stands for.
        domain: of the model.
        held_out: rays uniform over the domain that the lens passes, not used in the fit.
        predict: the model.
        pitch_um: pixel pitch; None takes `pixel_um`.

    Returns, all floats:
        rms_um, p99_um, max_um: film-equivalent error on the plane in focus of each ray's film position.
        rms_infinity_um, p99_infinity_um, max_infinity_um: the same on the plane at infinity.
        rms_px, p99_px, max_px, pixel_um: in pixels, and their pitch.
        rms_um_at_21_6: rms_um after scaling the lens to an image radius of 21.6 mm.
        direction_rms_deg, direction_p99_deg, direction_max_deg: angle between the exact and the predicted direction.
        position_rms_um, position_p99_um: perpendicular distance from the predicted point to the exact ray.
        transmittance_rms, transmittance_max.
        rays, share_beyond_60_deg: number of rays, and the share excluded from the micrometres.
        Micrometres are NaN where all rays lie beyond 60 degrees. A NaN in a prediction makes its figures NaN; a ray
        that points away from the plane makes the micrometres infinite.

    Raises:
        InputError: no rays, or rays that the exact lens blocks.
    """
    return ray_figures(lens, domain, each_ray(lens, domain, held_out, predict), pitch_um)


def ray_figures(lens: Lens, domain: Domain, each: EachRay, pitch_um: float | None = None) -> dict[str, float]:
    """What `ray_errors` returns, of errors ray by ray."""
    focus, infinity, inside = each.focus_um, each.infinity_um, each.inside
    pitch = pixel_um(domain) if pitch_um is None else pitch_um
    return {
        "rms_um": _rms(focus),
        "p99_um": _p99(focus),
        "max_um": _max(focus),
        "rms_infinity_um": _rms(infinity),
        "p99_infinity_um": _p99(infinity),
        "max_infinity_um": _max(infinity),
        "rms_px": _rms(focus) / pitch,
        "p99_px": _p99(focus) / pitch,
        "max_px": _max(focus) / pitch,
        "pixel_um": pitch,
        "rms_um_at_21_6": _rms(focus) * REFERENCE_RADIUS_MM / image_radius_mm(lens)[0],
        "direction_rms_deg": _rms(each.direction_deg),
        "direction_p99_deg": _p99(each.direction_deg),
        "direction_max_deg": _max(each.direction_deg),
        "position_rms_um": _rms(each.position_um),
        "position_p99_um": _p99(each.position_um),
        "transmittance_rms": _rms(each.transmittance),
        "transmittance_max": _max(each.transmittance),
        "rays": float(len(inside)),
        "share_beyond_60_deg": float((~inside).double().mean()),
    }


@dataclass(frozen=True)
class EachRay:
    """Errors of N rays, ray by ray.

    Attributes:
        inside: [N] bool, within 60 degrees of the axis; M of them.
        focus_um, infinity_um: [M] film-equivalent error on the plane in focus and at infinity.
        direction_deg, position_um: [N].
        transmittance: [N] absolute.
    """

    inside: Tensor
    focus_um: Tensor
    infinity_um: Tensor
    direction_deg: Tensor
    position_um: Tensor
    transmittance: Tensor

    def select(self, part: Tensor) -> EachRay:
        """The rays of a mask [N]."""
        kept = part[self.inside]
        rest = (self.direction_deg[part], self.position_um[part], self.transmittance[part])
        return EachRay(self.inside[part], self.focus_um[kept], self.infinity_um[kept], *rest)


def each_ray(lens: Lens, domain: Domain, held_out: PairSet, predict: Callable[[FilmRays], Predicted]) -> EachRay:
    """Errors of every ray; arguments and what they raise as `ray_errors`."""
    if len(held_out) == 0 or bool((held_out.status != st.PASSED).any()):
        raise InputError(
            "ray_errors", "held_out", f"({len(held_out)} rays)", "at least one ray, all passed by the exact lens"
        )
    exact, inputs = held_out.scene, held_out.inputs
    predicted = predict(inputs)
    rays = Rays(*(c.to(torch.float64) for c in predicted.rays))
    inside = -exact.dz >= math.cos(math.radians(FIELD_LIMIT_DEG))
    kept = inputs.select(inside)
    pair = (Rays(*(c[inside] for c in exact)), Rays(*(c[inside] for c in rays)))
    vergence = focused_vergence(lens, kept.film_z)
    return EachRay(
        inside,
        1000 * film_equivalent_mm(lens, domain, kept, *pair, vergence),
        1000 * film_equivalent_mm(lens, domain, kept, *pair, torch.zeros_like(vergence)),
        angles_deg(exact, rays),
        1000 * distance_to_ray(exact, rays),
        (predicted.transmittance.to(torch.float64) - held_out.transmittance).abs(),
    )


def angles_deg(a: Rays, b: Rays) -> Tensor:
    """[N] angle between directions in degrees, by atan2(|a x b|, a.b): exact for small angles, unlike acos."""
    cx, cy, cz = a.dy * b.dz - a.dz * b.dy, a.dz * b.dx - a.dx * b.dz, a.dx * b.dy - a.dy * b.dx
    dot = a.dx * b.dx + a.dy * b.dy + a.dz * b.dz
    return torch.rad2deg(torch.atan2(torch.sqrt(cx * cx + cy * cy + cz * cz), dot))


def distance_to_ray(exact: Rays, predicted: Rays) -> Tensor:
    """[N] perpendicular distance (mm) from the predicted points to the exact rays."""
    x, y, z = predicted.x - exact.x, predicted.y - exact.y, predicted.z - exact.z
    cx, cy, cz = y * exact.dz - z * exact.dy, z * exact.dx - x * exact.dz, x * exact.dy - y * exact.dx
    return torch.sqrt(cx * cx + cy * cy + cz * cz)


def pupil_disc_share(lens: Lens, domain: Domain, count: int = 400_000, seed: int = 7) -> float:
    """Share of the passing rays that the domain's pupil disc contains; the definition of the errors requires 0.9999.

    Rays uniform over the film disc, wavelengths and film positions, and over a disc on the pupil plane that holds the
    whole rear surface seen from the film point, independent of the domain's bounds.

    Raises:
        InputError: no ray passes.
    """
    rays = sample_domain(domain, count, seed)
    scaled = [c / domain.pupil_radius_mm for c in (rays.pupil_x, rays.pupil_y)]  # uniform in the unit disc
    rear = lens.surfaces[-1]
    vertex, c, size = float(lens.vertices_mm[len(lens.surfaces) - 1]), float(rear.curvature), rear.semi_diameter_mm
    edge = vertex + c * size**2 / (1 + math.sqrt(max(0.0, 1 - (c * size) ** 2)))
    # The rear surface lies between the planes of its vertex and of its edge: a disc round both projections.
    stretch = torch.stack([(rays.film_z - domain.pupil_z_mm) / (rays.film_z - z) for z in (vertex, edge)])
    along = (1 - stretch).mean(0)
    reach = size * stretch.abs().max(0).values
    reach = reach + torch.hypot(rays.film_x, rays.film_y) * (stretch[0] - stretch[1]).abs() / 2
    pupil_x, pupil_y = rays.film_x * along + reach * scaled[0], rays.film_y * along + reach * scaled[1]
    start = camera_rays(rays.film_x, rays.film_y, rays.film_z, pupil_x, pupil_y, domain.pupil_z_mm)
    with torch.no_grad():
        traced = trace(lens, start, rays.wavelength_nm)
    weight = torch.where(traced.status == st.PASSED, reach * reach, 0.0)  # the discs differ in size
    if not float(weight.sum()) > 0:
        raise InputError(lens.path, "domain", "(no ray passes)", "a domain that the lens can reach")
    held = torch.hypot(pupil_x, pupil_y) <= domain.pupil_radius_mm
    return min(1.0, float(weight[held].sum() / weight.sum()))


def _rms(values: Tensor) -> float:
    return float(torch.sqrt((values * values).mean()))


def _p99(values: Tensor) -> float:
    return float(torch.quantile(values, 0.99)) if len(values) else math.nan


def _max(values: Tensor) -> float:
    return float(values.max()) if len(values) else math.nan


# Central differences over this share of the film radius: truncation and float64 rounding both stay below 1e-6.
_STEP = 1e-4
# Lower bound of the Jacobian, as a share of the paraxial one.
_LEAST = 0.1


def focused_vergence(lens: Lens, film_z: Tensor) -> Tensor:
    """[N] 1 / distance (1/mm) from the front vertex to the plane in focus, 0 at infinity.

    Film planes closer to the lens than the focal plane focus nothing real; they count as infinity.
    """
    return -1.0 / focused_plane_z_mm(lens, film_z)


def plane_coordinates(rays: Rays, vergence: Tensor) -> Tensor:
    """[2, N] where rays meet the plane z = -1 / vergence, over the plane's distance; tan(angle) at infinity.

    Infinite for rays that do not travel towards the plane.
    """
    forward = -rays.dz
    reach = (1 + rays.z * vergence) / torch.where(forward > 0, forward, torch.nan)
    points = torch.stack([rays.x * vergence + rays.dx * reach, rays.y * vergence + rays.dy * reach])
    # A NaN of the model stays NaN; only a ray that points backwards becomes infinite.
    return torch.where(forward <= 0, torch.inf, points)


def film_equivalent_mm(
    lens: Lens, domain: Domain, inputs: FilmRays, exact: Rays, rays: Rays, vergence: Tensor
) -> Tensor:
    """[N] distance on the film (mm) equivalent to the distance between two rays on an object plane."""
    dx, dy = plane_coordinates(rays, vergence) - plane_coordinates(exact, vergence)
    least = _LEAST / abs(first_order(lens).efl_mm)
    if lens.anamorphic:
        along_x, along_y = _jacobian_columns(lens, domain, inputs, vergence)
        area = (along_x[0] * along_y[1] - along_x[1] * along_y[0]).abs()
        area = area.clamp_min(least / abs(first_order(lens, meridian="x").efl_mm))
        return torch.hypot((dx * along_y[1] - dy * along_y[0]) / area, (dy * along_x[0] - dx * along_x[1]) / area)
    radius = torch.hypot(inputs.film_x, inputs.film_y)
    centred = radius < 1e-12  # on the axis every direction is radial
    along_x = torch.where(centred, 1.0, inputs.film_x / torch.where(centred, 1.0, radius))
    along_y = torch.where(centred, 0.0, inputs.film_y / torch.where(centred, 1.0, radius))
    radial, tangential = (j.clamp_min(least) for j in local_jacobian(lens, domain, inputs, vergence))
    return torch.hypot((dx * along_x + dy * along_y) / radial, (dy * along_x - dx * along_y) / tangential)


def local_jacobian(lens: Lens, domain: Domain, inputs: FilmRays, vergence: Tensor) -> tuple[Tensor, Tensor]:
    """Radial and tangential derivative [N] of `plane_coordinates` by film position, 1/mm, of the exact lens.

    Central differences in float64 of the ray through the middle of the passing rays (a chief-like ray; the pupil point
    stays as the film point moves), at each ray's own film radius, film plane and wavelength. The lens is round, so
    that the two are the whole Jacobian. Where that ray cannot be followed, the ray's own pupil point, which passes,
    stands in.
    """
    radius = torch.hypot(inputs.film_x, inputs.film_y)
    middle, across = pupil_middle(domain, radius), torch.zeros_like(radius)
    jacobian, found = _differences(lens, domain, inputs, radius, middle, across, vergence)
    if not bool(found.all()):
        lost = ~found
        part, r = inputs.select(lost), radius[lost]
        safe = torch.where(r > 0, r, 1.0)
        u = torch.where(r > 0, (part.pupil_x * part.film_x + part.pupil_y * part.film_y) / safe, part.pupil_x)
        v = torch.where(r > 0, (part.pupil_y * part.film_x - part.pupil_x * part.film_y) / safe, part.pupil_y)
        jacobian[:, lost] = _differences(lens, domain, part, r, u, v, vergence[lost])[0]
    return jacobian[0], jacobian[1]


def _jacobian_columns(lens: Lens, domain: Domain, inputs: FilmRays, vergence: Tensor) -> tuple[Tensor, Tensor]:
    """Derivatives [2, N] of `plane_coordinates` by film_x and by film_y, 1/mm, of a lens with cylinders.

    Central differences of each ray itself, which passes: no one plane holds its chief ray.
    """
    h = _STEP * domain.film_radius_mm
    steps = torch.tensor([[h, -h, 0, 0], [0, 0, h, -h]], dtype=torch.float64).repeat_interleave(len(inputs), 1)
    film_x, film_y = inputs.film_x.repeat(4) + steps[0], inputs.film_y.repeat(4) + steps[1]
    film_z, pupil_x, pupil_y = (c.repeat(4) for c in (inputs.film_z, inputs.pupil_x, inputs.pupil_y))
    rays = camera_rays(film_x, film_y, film_z, pupil_x, pupil_y, domain.pupil_z_mm)
    with torch.no_grad():
        out = trace(lens, rays, inputs.wavelength_nm.repeat(4))
    points = plane_coordinates(out.rays, vergence.repeat(4)).reshape(2, 4, -1)
    return (points[:, 0] - points[:, 1]) / (2 * h), (points[:, 2] - points[:, 3]) / (2 * h)


def _differences(
    lens: Lens, domain: Domain, inputs: FilmRays, radius: Tensor, u: Tensor, v: Tensor, vergence: Tensor
) -> tuple[Tensor, Tensor]:
    """[2, N] radial and tangential derivative at film points (radius, 0) through pupil points (u, v), four rays each.

    Also [N], whether all four passed.
    """
    h = _STEP * domain.film_radius_mm
    zero = torch.zeros_like(radius)
    film_x = torch.cat([radius + h, radius - h, radius, radius])
    film_y = torch.cat([zero, zero, zero + h, zero - h])
    rays = camera_rays(film_x, film_y, inputs.film_z.repeat(4), u.repeat(4), v.repeat(4), domain.pupil_z_mm)
    with torch.no_grad():
        out = trace(lens, rays, inputs.wavelength_nm.repeat(4))
    # Rays that only a rim stops go on; the others come back along the axis and would give a wrong derivative.
    lost = (out.status != st.PASSED) & (out.rays.dz == -1.0) & (out.rays.x == 0.0)
    points = plane_coordinates(out.rays, vergence.repeat(4)).reshape(2, 4, -1)
    radial = torch.linalg.vector_norm(points[:, 0] - points[:, 1], dim=0) / (2 * h)
    tangential = torch.linalg.vector_norm(points[:, 2] - points[:, 3], dim=0) / (2 * h)
    return torch.stack([radial, tangential]), ~lost.reshape(4, -1).any(0)


def pupil_middle(domain: Domain, radius: Tensor) -> Tensor:
    """[N] middle of the passing rays on the pupil plane, along the film point's direction, mm; linear in the table."""
    low, high = (torch.tensor(v, dtype=radius.dtype) for v in (domain.bounds.low_mm, domain.bounds.high_mm))
    middle = torch.where(low <= high, (low + high) / 2, 0.0)
    place = (radius / domain.bounds.film_radius_mm * (len(middle) - 1)).clamp(0, len(middle) - 1)
    below = place.floor().long().clamp_max(len(middle) - 2)
    return torch.lerp(middle[below], middle[below + 1], place - below)
