"""Errors of a surrogate against the exact lens: of its rays, of what it passes and blocks, and of its illumination.

Ray errors are over rays of a domain that the exact lens passes, whatever the model's status (false blocks are counted
by `false_shares`). For the film-equivalent error, the exact and the approximate ray meet the plane in focus, and the
distance between the two points is taken back to the film by the exact lens's local Jacobian at that film point. It is
given for rays within 60 degrees of the axis; beyond, only angles are given.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from neurolens.base import status as st
from neurolens.base.errors import InputError
from neurolens.models.fitted import Domain, FilmRays
from neurolens.models.pairs import PairSet, focused_plane_z_mm, sample_domain
from neurolens.optics.lens.paraxial import first_order
from neurolens.optics.lens.prescription import Lens
from neurolens.optics.setting.pupils import camera_rays, image_radius_mm
from neurolens.optics.trace.rays import plain_trace
from neurolens.optics.trace.surfaces import Rays

FIELD_LIMIT_DEG = 60.0
REFERENCE_RADIUS_MM = 21.6  # half the diagonal of 36 x 24 mm film: the common scale of lenses of different size
PIXELS_ACROSS = 4000


Predict = Callable[..., Any]
"""FilmRays and a stop radius in mm (None: the domain's) to what `LensModel.predict` gives."""


def frame_width_mm(radius_mm: float) -> float:
    """Return the width of the 3:2 frame inscribed in an image circle (36 mm for 21.63 mm)."""
    return 2 * radius_mm * 3 / math.sqrt(13)


def pixel_um(domain: Domain) -> float:
    """Return the default pixel pitch: the width of the 3:2 frame inscribed in the domain's film circle, over 4000."""
    return 1000 * frame_width_mm(domain.film_radius_mm) / PIXELS_ACROSS


@dataclass(frozen=True)
class RayErrors:
    """Errors over rays that the exact lens passes.

    Micrometres are NaN where all rays lie beyond 60 degrees. A NaN in a prediction makes its figures NaN; a ray that
    points away from the plane makes the micrometres infinite.

    Attributes:
        rms_um, p99_um, max_um: film-equivalent error on the plane in focus of each ray's film position.
        rms_infinity_um, p99_infinity_um, max_infinity_um: the same on the plane at infinity.
        rms_px, p99_px, max_px: in pixels. pixel_um: their pitch.
        rms_um_at_21_6: rms_um of the lens scaled to an image radius of 21.6 mm.
        direction_rms_deg, direction_p99_deg, direction_max_deg: angle between the exact and the predicted direction.
        position_rms_um, position_p99_um: perpendicular distance from the predicted point to the exact ray.
        rays: their number. share_beyond_60_deg: the share left out of the micrometres.
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
            *focus, *_spread(each.infinity_um),
            focus[0] / pitch, focus[1] / pitch, focus[2] / pitch, pitch,
            focus[0] * REFERENCE_RADIUS_MM / image_radius_mm(lens)[0],
            *_spread(each.direction_deg), position[0], position[1], transmittance[0], transmittance[2],
            float(len(each.inside)), float((~each.inside).double().mean()),
        )  # fmt: skip


def _spread(values: Tensor) -> tuple[float, float, float]:
    """Return RMS, 99th percentile and largest value; NaN without values."""
    rms = float(torch.sqrt((values * values).mean()))
    return (rms, float(torch.quantile(values, 0.99)), float(values.max())) if len(values) else (rms, math.nan, math.nan)


def ray_errors(lens: Lens, domain: Domain, held_out: PairSet, predict: Predict) -> RayErrors:
    """Measure errors over rays that the exact lens passes.

    Args:
        lens: the exact lens in the state (zoom, stop) that the model stands for.
        domain: the model's.
        held_out: rays uniform over the domain that the lens passes and no fit has used.
        predict: the model.

    Raises:
        InputError: there are no rays, or the exact lens blocks some.
    """
    return RayErrors.over(lens, domain, each_ray(lens, domain, held_out, predict))


@dataclass(frozen=True)
class EachRay:
    """The errors of N rays, ray by ray.

    Attributes:
        inside: [N] whether a ray is within 60 degrees of the axis; M rays are.
        focus_um, infinity_um: [M] film-equivalent error on the plane in focus and at infinity.
        direction_deg, position_um: [N].
        transmittance: [N] absolute error.
    """

    inside: Tensor
    focus_um: Tensor
    infinity_um: Tensor
    direction_deg: Tensor
    position_um: Tensor
    transmittance: Tensor

    def select(self, part: Tensor) -> EachRay:
        """Return the errors of the rays of a mask [N]."""
        kept = part[self.inside]
        rest = (self.direction_deg[part], self.position_um[part], self.transmittance[part])
        return EachRay(self.inside[part], self.focus_um[kept], self.infinity_um[kept], *rest)


def each_ray(lens: Lens, domain: Domain, held_out: PairSet, predict: Predict) -> EachRay:
    """Measure the error of every ray; arguments and errors raised are those of `ray_errors`."""
    if len(held_out) == 0 or bool((held_out.status != st.PASSED).any()):
        expected = "at least one ray, all passed by the exact lens"
        raise InputError("ray_errors", "held_out", f"({len(held_out)} rays)", expected)
    exact, inputs = held_out.scene, held_out.inputs
    predicted = predict(inputs)
    rays = Rays(*(c.to(torch.float64) for c in predicted.rays))
    inside = -exact.dz >= math.cos(math.radians(FIELD_LIMIT_DEG))
    kept = inputs.select(inside)
    pair = (Rays(*(c[inside] for c in exact)), Rays(*(c[inside] for c in rays)))
    vergence = focused_vergence(lens, kept.film_z)
    return EachRay(
        inside,
        1000 * _film_equivalent_mm(lens, domain, kept, *pair, vergence),
        1000 * _film_equivalent_mm(lens, domain, kept, *pair, torch.zeros_like(vergence)),
        angles_deg(exact, rays),
        1000 * _cross_length([p - e for p, e in zip(rays[:3], exact[:3], strict=True)], exact[3:]),
        (predicted.transmittance.to(torch.float64) - held_out.transmittance).abs(),
    )


def angles_deg(a: Rays, b: Rays) -> Tensor:
    """Return angles [N] between directions in degrees, by atan2(|a x b|, a.b): exact for small angles, unlike acos."""
    dot = a.dx * b.dx + a.dy * b.dy + a.dz * b.dz
    return torch.rad2deg(torch.atan2(_cross_length(a[3:], b[3:]), dot))


def _cross_length(a: Sequence[Tensor], b: Sequence[Tensor]) -> Tensor:
    """Return the length [N] of the cross products of vectors given by their components."""
    x, y, z = a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]
    return torch.sqrt(x * x + y * y + z * z)


# Central differences over this share of the film radius: truncation and float64 rounding both stay below 1e-6.
_STEP = 1e-4
# The least Jacobian that is used, as a share of the paraxial one.
_LEAST = 0.1


def focused_vergence(lens: Lens, film_z: Tensor) -> Tensor:
    """Return 1 / distance [N] (1/mm) from the front vertex to the plane in focus; 0 at infinity.

    Film planes closer to the lens than the focal plane focus nothing real; they count as infinity.
    """
    return -1.0 / focused_plane_z_mm(lens, film_z)


def _plane_coordinates(rays: Rays, vergence: Tensor) -> Tensor:
    """Return where rays meet the plane z = -1 / vergence, [2, N], over its distance; at infinity tan(angle).

    Rays that do not travel towards the plane give infinity.
    """
    forward = -rays.dz
    reach = (1 + rays.z * vergence) / torch.where(forward > 0, forward, torch.nan)
    points = torch.stack([rays.x * vergence + rays.dx * reach, rays.y * vergence + rays.dy * reach])
    # A NaN of the model stays NaN; only a ray that points backwards becomes infinite.
    return torch.where(forward <= 0, torch.inf, points)


def _film_equivalent_mm(
    lens: Lens, domain: Domain, inputs: FilmRays, exact: Rays, rays: Rays, vergence: Tensor
) -> Tensor:
    """Return the distance [N] on the film (mm) equivalent to the distance between two rays on an object plane."""
    dx, dy = _plane_coordinates(rays, vergence) - _plane_coordinates(exact, vergence)
    least = _LEAST / abs(first_order(lens).efl_mm)
    if lens.anamorphic:
        # By the ray itself, which passes, because its chief ray lies in no one plane.
        along_x, along_y, _ = _differences(lens, domain, inputs, vergence)
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
    """Return radial and tangential derivatives [N] of `_plane_coordinates` by film position, 1/mm, of the exact lens.

    They are central differences in float64 of the ray through the middle of the passing rays (a chief-like ray whose
    pupil point stays as the film point moves), at each ray's own film radius, film plane and wavelength. The lens is
    round, so that the two are the whole Jacobian. Where that ray cannot be followed, the ray's own pupil point, which
    passes, is taken.
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
    return torch.linalg.vector_norm(radial, dim=0), torch.linalg.vector_norm(tangential, dim=0)


def _differences(lens: Lens, domain: Domain, inputs: FilmRays, vergence: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return derivatives [2, N] of `_plane_coordinates` by film_x and by film_y, with the pupil point kept.

    They are central differences. Also returns whether all four rays [N] could be followed.
    """
    h = _STEP * domain.film_radius_mm
    steps = torch.tensor([[h, -h, 0, 0], [0, 0, h, -h]], dtype=torch.float64).repeat_interleave(len(inputs), 1)
    film_x, film_y, film_z, pupil_x, pupil_y, wavelength = (c.repeat(4) for c in inputs.columns())
    rays = camera_rays(film_x + steps[0], film_y + steps[1], film_z, pupil_x, pupil_y, domain.pupil_z_mm)
    out = plain_trace(lens, rays, wavelength)
    # Rays that only a rim stops go on; others are returned on the axis and would give a wrong derivative.
    lost = (out.status != st.PASSED) & (out.rays.dz == -1.0) & (out.rays.x == 0.0)
    points = _plane_coordinates(out.rays, vergence.repeat(4)).reshape(2, 4, -1)
    along_x, along_y = (points[:, ::2] - points[:, 1::2]).unbind(1)
    return along_x / (2 * h), along_y / (2 * h), ~lost.reshape(4, -1).any(0)


def pupil_middle(domain: Domain, radius: Tensor) -> Tensor:
    """Return the middle [N] (mm) of the passing rays on the pupil plane, for film points at [N] mm, along these."""
    low, high = (torch.tensor(v, dtype=radius.dtype) for v in (domain.bounds.low_mm, domain.bounds.high_mm))
    middle = torch.where(low <= high, (low + high) / 2, 0.0)
    place = (radius / domain.bounds.film_radius_mm * (len(middle) - 1)).clamp(0, len(middle) - 1)
    below = place.floor().long().clamp_max(len(middle) - 2)
    return torch.lerp(middle[below], middle[below + 1], place - below)


ZONES = {"centre": (0.0, 1 / 3), "mid": (1 / 3, 2 / 3), "edge": (2 / 3, 1.0)}  # shares of the film radius
SEED = 104729  # which no fit's rays are likely to have


def false_shares(exact_passes: Tensor, model_passes: Tensor) -> dict[str, float | None]:
    """Return false_pass and false_block from [N] booleans of rays uniform over lit film and pupil disc.

    False passes are rays that the model passes and the exact lens blocks, as a share of those that the model passes.
    False blocks are rays that the model blocks and the exact lens passes, as a share of those that the exact lens
    passes. None over no rays.
    """
    wrong_pass, wrong_block = model_passes & ~exact_passes, exact_passes & ~model_passes
    return {"false_pass": _share(wrong_pass, model_passes), "false_block": _share(wrong_block, exact_passes)}


def _share(part: Tensor, whole: Tensor) -> float | None:
    total = int(whole.sum())
    return int(part.sum()) / total if total else None


@dataclass(frozen=True)
class Illumination:
    """Light by film radius, as a share of the exact lens's on the axis.

    Attributes:
        film_radius_mm, exact, model: one value a radius.
        max_difference: between the two.
    """

    film_radius_mm: list[float]
    exact: list[float]
    model: list[float]
    max_difference: float


def relative_illumination(
    lens: Lens, domain: Domain, predict: Predict, *, points: int = 16384, rows: int = 17, seed: int = SEED
) -> Illumination:
    """Return film irradiance in uniform surroundings by film radius, for the exact lens and for the model.

    The weight of a ray is T cos^4(theta) / Z^2 over the pupil disc, with the transmittance T; wavelengths are uniform
    over the domain. Both curves are divided by the exact lens's value on the axis, so that a model that is darker
    everywhere shows. The film plane is the domain's nearest to the lens (its farthest focus), the stop the domain's.

    Args:
        points: rays for each film radius, with the same pupil points and wavelengths for all.
        rows: how many film radii.

    Raises:
        InputError: no ray passes on the axis.
    """
    radius = domain.stop_radius_mm
    stopped = lens.with_stop_radius(radius)
    sample = sample_domain(domain, points, seed)
    film_z = torch.full_like(sample.film_z, domain.film_z_mm[0])
    radii = [domain.film_radius_mm * i / (rows - 1) for i in range(rows)]
    sums: tuple[list[float], list[float]] = ([], [])
    for r in radii:
        rays = FilmRays(torch.full_like(film_z, r), torch.zeros_like(film_z), film_z, *sample.columns()[3:])
        start = camera_rays(rays.film_x, rays.film_y, film_z, rays.pupil_x, rays.pupil_y, domain.pupil_z_mm)
        traced = plain_trace(stopped, start, rays.wavelength_nm, transmittance=True)
        for values, out in zip(sums, (traced, predict(rays, radius)), strict=True):
            power = torch.where(out.status == st.PASSED, out.transmittance.to(torch.float64), 0.0)
            values.append(float((power * start.dz**4).sum()))  # one film plane and pupil plane: Z is the same for all
    axis, expected = sums[0][0], "a lens that illuminates the centre of the film"
    if not axis > 0:
        raise InputError(lens.path, "domain", "(no ray passes on the axis)", expected)
    exact, model = ([v / axis for v in values] for values in sums)
    return Illumination(radii, exact, model, max(abs(a - b) for a, b in zip(exact, model, strict=True)))
