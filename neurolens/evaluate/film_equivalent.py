"""Film-equivalent error: how far apart on the film two scene-side rays would be, in the exact lens's own measure.

Both rays meet an object plane; the distance between the two points is taken back to the film with the exact lens's
local Jacobian at that film point (on the axis: the paraxial magnification). Points on a plane are given over its
distance, so that infinity is no special case.

Where distortion is so strong that the image folds, two film points see one object point, the Jacobian passes through
zero, and an error would count for as much as one likes: a mean of its squares does not exist, and no sample of rays
could confirm it on another. The Jacobian counts for at least a tenth of first order's there; imaging lenses, condensers
among them, stay above a fifth over their whole film.
"""

from __future__ import annotations

import torch
from torch import Tensor

from neurolens.base import status as st
from neurolens.optics.paraxial import first_order
from neurolens.optics.prescription import Lens
from neurolens.optics.pupils import camera_rays
from neurolens.optics.surfaces import Rays
from neurolens.optics.trace import trace
from neurolens.surrogates.domain import Domain, FilmRays, focused_plane_z_mm

# Central differences over this share of the film radius: truncation and float64 rounding both stay below 1e-6.
_STEP = 1e-4
# The least that a Jacobian counts for, of the paraxial one.
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
    # A NaN that the model itself gave stays NaN; only a ray that points backwards becomes infinite.
    return torch.where(forward <= 0, torch.inf, points)


def film_equivalent_mm(
    lens: Lens, domain: Domain, inputs: FilmRays, exact: Rays, rays: Rays, vergence: Tensor
) -> Tensor:
    """[N] distance on the film (mm) that the distance between two rays on an object plane stands for."""
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

    Also [N], whether all four went on.
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
