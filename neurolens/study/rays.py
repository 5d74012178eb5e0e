"""Ray errors of a surrogate against the exact lens.

Rays are those of a domain that the exact lens passes, independent of the model's status (false blocks are counted by
`vignetting`). Film-equivalent error: the exact and the approximate ray meet the plane in focus, and the
distance between the two points is taken back to the film with the exact lens's local Jacobian at that film point.
It is given for rays within 60 degrees of the axis; beyond, only angles are given.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from neurolens.base import status as st
from neurolens.base.errors import InputError
from neurolens.lens.paraxial import first_order
from neurolens.lens.prescription import Lens
from neurolens.setting.pupils import camera_rays, image_radius_mm
from neurolens.surrogates.domain import FilmRays, focused_plane_z_mm, sample_domain
from neurolens.surrogates.model import Domain
from neurolens.surrogates.pairs import PairSet
from neurolens.trace.rays import trace
from neurolens.trace.surfaces import Rays

FIELD_LIMIT_DEG = 60.0
REFERENCE_RADIUS_MM = 21.6  # half the diagonal of 36 x 24 mm film: the common scale of lenses of different size
PIXELS_ACROSS = 4000


Predict = Callable[..., Any]
"""FilmRays and a stop radius in mm (None: the domain's) to what `LensModel.predict` gives."""


def frame_width_mm(radius_mm: float) -> float:
    """Width of the 3:2 frame inscribed in an image circle (36 mm for 21.63 mm)."""
    return 2 * radius_mm * 3 / math.sqrt(13)


def pixel_um(domain: Domain) -> float:
    """Default pixel pitch: the width of the 3:2 frame inscribed in the domain's film circle, over 4000."""
    return 1000 * frame_width_mm(domain.film_radius_mm) / PIXELS_ACROSS


@dataclass(frozen=True)
class RayErrors:
    """Errors over rays that the exact lens passes.

    Micrometres are NaN where all rays lie beyond 60 degrees. A NaN in a prediction makes its figures NaN; a ray that
    points away from the plane makes the micrometres infinite.

    Attributes:
        rms_um, p99_um, max_um: film-equivalent error on the plane in focus of each ray's film position.
        rms_infinity_um, p99_infinity_um, max_infinity_um: the same on the plane at infinity.
        rms_px, p99_px, max_px, pixel_um: in pixels, and their pitch.
        rms_um_at_21_6: rms_um after scaling the lens to an image radius of 21.6 mm.
        direction_rms_deg, direction_p99_deg, direction_max_deg: angle between the exact and the predicted direction.
        position_rms_um, position_p99_um: perpendicular distance from the predicted point to the exact ray.
        rays, share_beyond_60_deg: number of rays, and the share excluded from the micrometres.
    """

    rms_um: float
    p99_um: float
    max_um: float
    rms_infinity_um: float
    p99_infinity_um: float
    max_infinity_um: float
    rms_px: float
    p99_px: float
    max_px: float
    pixel_um: float
    rms_um_at_21_6: float
    direction_rms_deg: float
    direction_p99_deg: float
    direction_max_deg: float
    position_rms_um: float
    position_p99_um: float
    transmittance_rms: float
    transmittance_max: float
    rays: float
    share_beyond_60_deg: float

    @classmethod
    def over(cls, lens: Lens, domain: Domain, each: EachRay) -> RayErrors:
        """Summarise errors that are known ray by ray."""
        pitch, focus = pixel_um(domain), _spread(each.focus_um)
        position, transmittance = _spread(each.position_um), _spread(each.transmittance)
        return cls(
            *focus,
            *_spread(each.infinity_um),
            *(focus[0] / pitch, focus[1] / pitch, focus[2] / pitch, pitch),
            focus[0] * REFERENCE_RADIUS_MM / image_radius_mm(lens)[0],
            *_spread(each.direction_deg),
            *(position[0], position[1]),
            *(transmittance[0], transmittance[2]),
            float(len(each.inside)),
            float((~each.inside).double().mean()),
        )


def _spread(values: Tensor) -> tuple[float, float, float]:
    """RMS, 99th percentile, largest; NaN without values."""
    rms = float(torch.sqrt((values * values).mean()))
    return (rms, float(torch.quantile(values, 0.99)), float(values.max())) if len(values) else (rms, math.nan, math.nan)


def ray_errors(lens: Lens, domain: Domain, held_out: PairSet, predict: Predict) -> RayErrors:
    """Errors over rays that the exact lens passes.

    Args:
        lens: the exact lens, in the state (zoom, stop) that the model stands for.
        domain: of the model.
        held_out: rays uniform over the domain that the lens passes, not used in the fit.
        predict: the model.

    Raises:
        InputError: no rays, or rays that the exact lens blocks.
    """
    return RayErrors.over(lens, domain, each_ray(lens, domain, held_out, predict))


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


def each_ray(lens: Lens, domain: Domain, held_out: PairSet, predict: Predict) -> EachRay:
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
        # Of each ray itself, which passes: no one plane holds its chief ray.
        along_x, along_y, _ = _differences(lens, domain, inputs, vergence)
        along_x, along_y = along_x / _step_mm(domain), along_y / _step_mm(domain)
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
    zero, middle = torch.zeros_like(radius), pupil_middle(domain, radius)
    chief = replace(inputs, film_x=radius, film_y=zero, pupil_x=middle, pupil_y=zero)
    radial, tangential, found = _differences(lens, domain, chief, vergence)
    if not bool(found.all()):
        lost = ~found
        part, r = inputs.select(lost), radius[lost]
        safe = torch.where(r > 0, r, 1.0)
        u = torch.where(r > 0, (part.pupil_x * part.film_x + part.pupil_y * part.film_y) / safe, part.pupil_x)
        v = torch.where(r > 0, (part.pupil_y * part.film_x - part.pupil_x * part.film_y) / safe, part.pupil_y)
        turned = replace(part, film_x=r, film_y=zero[lost], pupil_x=u, pupil_y=v)
        radial[:, lost], tangential[:, lost], _ = _differences(lens, domain, turned, vergence[lost])
    length, step = torch.linalg.vector_norm, _step_mm(domain)
    return length(radial, dim=0) / step, length(tangential, dim=0) / step


def _step_mm(domain: Domain) -> float:
    return 2 * _STEP * domain.film_radius_mm


def _differences(lens: Lens, domain: Domain, inputs: FilmRays, vergence: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Central differences [2, N] of `plane_coordinates` over `_step_mm` of film_x and of film_y, the pupil point kept.

    Also [N], whether all four rays could be followed.
    """
    h = _STEP * domain.film_radius_mm
    steps = torch.tensor([[h, -h, 0, 0], [0, 0, h, -h]], dtype=torch.float64).repeat_interleave(len(inputs), 1)
    film_x, film_y, film_z, pupil_x, pupil_y, wavelength = (c.repeat(4) for c in inputs.columns())
    rays = camera_rays(film_x + steps[0], film_y + steps[1], film_z, pupil_x, pupil_y, domain.pupil_z_mm)
    with torch.no_grad():
        out = trace(lens, rays, wavelength)
    # Rays that only a rim stops go on; the others come back along the axis and would give a wrong derivative.
    lost = (out.status != st.PASSED) & (out.rays.dz == -1.0) & (out.rays.x == 0.0)
    points = plane_coordinates(out.rays, vergence.repeat(4)).reshape(2, 4, -1)
    return points[:, 0] - points[:, 1], points[:, 2] - points[:, 3], ~lost.reshape(4, -1).any(0)


def pupil_middle(domain: Domain, radius: Tensor) -> Tensor:
    """[N] middle of the passing rays on the pupil plane, along the film point's direction, mm; linear in the table."""
    low, high = (torch.tensor(v, dtype=radius.dtype) for v in (domain.bounds.low_mm, domain.bounds.high_mm))
    middle = torch.where(low <= high, (low + high) / 2, 0.0)
    place = (radius / domain.bounds.film_radius_mm * (len(middle) - 1)).clamp(0, len(middle) - 1)
    below = place.floor().long().clamp_max(len(middle) - 2)
    return torch.lerp(middle[below], middle[below + 1], place - below)
