"""Real rays for the check of a lens: the widest axial beam, the axial blur, the edge of the film and its light."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from neurolens.base import status as st
from neurolens.optics.aiming import aim_at_stop
from neurolens.optics.clearance import end_mm
from neurolens.optics.paraxial import first_order
from neurolens.optics.prescription import Lens
from neurolens.optics.pupils import camera_rays, pupil_plane_z_mm
from neurolens.optics.surfaces import Rays
from neurolens.optics.trace import trace

_FAN, _SPOT, _SEARCH = 1001, 64, 64
_PUPIL = 3.0  # paraxial exit pupils within which the pupil of every film point lies


def parallel_beam(lens: Lens, x: Tensor, y: Tensor) -> Rays:
    """Rays along the axis at heights x, y [N] (mm), in front of the lens."""
    reach = max(s.semi_diameter_mm for s in lens.surfaces)
    zero = torch.zeros_like(x)
    return Rays(x, y, zero - reach, zero, zero, zero + 1)


def axial_beam(lens: Lens) -> tuple[float, int | None]:
    """Half height (mm, along y) of the widest parallel beam that passes all rims, and the surface that ends it.

    The beam ends at the first height that does not pass; None where the whole front surface is used.
    """
    front = lens.surfaces[0]
    limit = min(front.semi_diameter_mm, end_mm(front))
    low, high = 0.0, limit
    blocker = None
    for _ in range(3):
        y = torch.linspace(low, high, _FAN, dtype=torch.float64)
        with torch.no_grad():
            status = trace(lens, parallel_beam(lens, torch.zeros_like(y), y), towards="film").status
        passed = int((status == st.PASSED).to(torch.int8).cumprod(0).sum())
        if passed == _FAN:
            return float(y[-1]), blocker
        if passed == 0:
            return float(y[0]), st.surface_of(int(status[0]))
        blocker = st.surface_of(int(status[passed]))
        low, high = float(y[passed - 1]), float(y[passed])
    return low, blocker


def axial_blur_mm(lens: Lens) -> float:
    """RMS radius of the image of an axial point at infinity, in the plane where it is smallest.

    Rays are even over the beam's cross-section; both coordinates count, so that an anamorphic lens out of step shows.
    """
    reach = min(lens.surfaces[0].semi_diameter_mm, 1.02 * axial_beam(lens)[0])
    side = torch.linspace(-reach, reach, 2 * _SPOT + 1, dtype=torch.float64)
    x, y = (t.reshape(-1) for t in torch.meshgrid(side, side[_SPOT:], indexing="ij"))
    inside = torch.hypot(x, y) <= reach
    x, y = x[inside], y[inside]
    with torch.no_grad():
        out = trace(lens, parallel_beam(lens, x, y), towards="film")
    passed = out.status == st.PASSED
    if not passed.any():
        return math.inf
    r = Rays(*(c[passed] for c in out.rays))
    # Position in the plane z is p + z q; the sum of squares is least where its derivative vanishes. Each ray of the
    # half plane stands for its mirror image too: the centroid is on the axis.
    weight = torch.where(y[passed] == 0, 1.0, 2.0)
    qx, qy = r.dx / r.dz, r.dy / r.dz
    px, py = r.x - r.z * qx, r.y - r.z * qy
    best = -(weight * (px * qx + py * qy)).sum() / (weight * (qx * qx + qy * qy)).sum()
    spread = (px + best * qx) ** 2 + (py + best * qy) ** 2
    return math.sqrt(float((weight * spread).sum() / weight.sum()))


def film_edge_mm(lens: Lens) -> float | None:
    """Radius of the film to be lit: the file's own, else the image of the half field; None where neither is stated."""
    if lens.image_radius_mm is not None:
        return lens.image_radius_mm
    if lens.half_field_deg is None:
        return None
    field = torch.tensor([math.radians(lens.half_field_deg)], dtype=torch.float64)
    bundle = aim_at_stop(lens, field, torch.zeros(1, 1, dtype=torch.float64))
    with torch.no_grad():
        out = trace(lens, bundle.rays, towards="film")
    if int(out.status[0]) == st.PASSED and bool(bundle.reached[0, 0]):
        r = out.rays
        return abs(float(r.x + (first_order(lens).rear_focal_z_mm - r.z) * r.dx / r.dz))
    if lens.half_field_deg < 60:
        return abs(first_order(lens).efl_mm) * math.tan(math.radians(lens.half_field_deg))
    return None


def corner_illumination(lens: Lens, radius_mm: float) -> float:
    """Light at a film radius relative to the middle, film at the focus for infinity (cos^4 and rims, d line).

    The corner of an anamorphic lens lies halfway between its planes of symmetry.
    """
    across = math.sqrt(0.5) if lens.anamorphic else 0.0
    middle, corner = _light(lens, 0.0, 0.0), _light(lens, radius_mm * math.sqrt(1 - across**2), radius_mm * across)
    return corner / middle if middle > 0 else 0.0


def _light(lens: Lens, x_mm: float, y_mm: float) -> float:
    """Film irradiance in a unit of its own: the passing rays' cos^4 integrated over the pupil's plane."""
    data = first_order(lens)
    plane, film_z = pupil_plane_z_mm(lens), data.rear_focal_z_mm
    rear = lens.surfaces[-1].semi_diameter_mm
    # Seen from the corner the pupil is distorted, but not beyond recognition.
    half = _PUPIL * data.exit_pupil_diameter_mm / 2 if plane == data.exit_pupil_z_mm else rear
    box = (-half, half, -half, half)
    total = 0.0
    for _ in range(2):  # the whole plane, then the box of what passed
        total, found = _look(lens, (x_mm, y_mm, film_z), plane, box)
        if found is None:
            return 0.0
        box = found
    return total


def _look(
    lens: Lens, film: tuple[float, float, float], plane: float, box: tuple[float, float, float, float]
) -> tuple[float, tuple[float, float, float, float] | None]:
    """The integral over a box of the plane, and the box, a step wider, of the points from which light comes."""
    du, dv = (box[1] - box[0]) / _SEARCH, (box[3] - box[2]) / _SEARCH
    steps = torch.arange(_SEARCH, dtype=torch.float64) + 0.5
    u, v = (t.reshape(-1) for t in torch.meshgrid(box[0] + du * steps, box[2] + dv * steps, indexing="ij"))
    start = camera_rays(torch.full_like(u, film[0]), torch.full_like(u, film[1]), film[2], u, v, plane)
    with torch.no_grad():
        passed = trace(lens, start).status == st.PASSED
    if not passed.any():
        return 0.0, None
    total = float((start.dz**4)[passed].sum()) * du * dv
    u, v = u[passed], v[passed]
    return total, (float(u.min()) - du, float(u.max()) + du, float(v.min()) - dv, float(v.max()) + dv)
