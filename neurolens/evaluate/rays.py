"""Ray errors of a surrogate against the exact lens, as defined once for the whole project.

Rays are those of a domain that the exact lens passes, whatever the model's own status says of them (false blocks are
counted by `vignetting`). Film-equivalent error: the exact and the approximate ray meet the plane in focus, and the
distance between the two points is taken back to the film with the exact lens's local Jacobian at that film point.
It is given for rays within 60 degrees of the axis; beyond, a plane is a poor target and only angles are given.
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
from neurolens.evaluate.film_equivalent import film_equivalent_mm, focused_vergence
from neurolens.optics.prescription import Lens
from neurolens.optics.pupils import camera_rays, image_radius_mm
from neurolens.optics.surfaces import Rays
from neurolens.optics.trace import trace
from neurolens.surrogates.domain import Domain, FilmRays, sample_domain
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
        held_out: rays uniform over the domain that the lens passes, none of them seen in the fit.
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
        rays, share_beyond_60_deg: how many rays, and the share of them that the micrometres leave out.
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
    """Share of the passing rays that the domain's pupil disc holds; the definition of the errors asks for 0.9999.

    Rays uniform over the film disc, wavelengths and film positions, and over a disc on the pupil plane that holds the
    whole rear surface seen from the film point, whatever the domain's bounds say.

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
