"""Ray differentials against finite differences, a thin lens's closed form, and bad input."""

from __future__ import annotations

import math

import pytest
import torch
from shipped import tabled
from torch import Tensor

from neurolens.base.errors import InputError
from neurolens.optics.paraxial import first_order
from neurolens.optics.prescription import Lens, Surface
from neurolens.optics.pupils import camera_rays
from neurolens.optics.surfaces import Rays
from neurolens.optics.trace import film_derivatives, trace, trace_differentials


def asphere() -> Lens:
    front = Surface(30.0, 6.0, 24.0, 1.6, conic=-0.6, asphere=((4, -1e-5), (6, 2e-8)))
    return Lens("asphere", "", (front, Surface(-80.0, 2.0, 24.0), Surface(math.inf, 40.0, 16.0, stop=True)), 2.0)


def lenses() -> dict[str, Lens]:
    names = ("laikin_double_gauss_50", "muller_fisheye_100")
    return {name: tabled(name) for name in names} | {"asphere": asphere()}


def film_rays(lens: Lens, fx: Tensor, fy: Tensor, px: Tensor, py: Tensor) -> tuple[Rays, Tensor]:
    """Camera rays towards points in the rear vertex plane, and their distances to these."""
    film_z, pupil_z = lens.at().film_z_mm, float(lens.vertices_mm[len(lens.surfaces) - 1])
    rays = camera_rays(fx, fy, film_z, px, py, pupil_z)
    return rays, torch.sqrt((px - fx) ** 2 + (py - fy) ** 2 + (film_z - pupil_z) ** 2)


@pytest.mark.parametrize("name", ["laikin_double_gauss_50", "muller_fisheye_100", "asphere"])
def test_equal_to_central_differences(name: str) -> None:
    lens = lenses()[name]
    g = torch.Generator().manual_seed(1)
    rear, f = lens.surfaces[-1].semi_diameter_mm, abs(first_order(lens).efl_mm)
    fx, fy, px, py = (torch.rand(400, generator=g, dtype=torch.float64) * 2 - 1 for _ in range(4))
    fx, fy, px, py = 0.3 * f * fx, 0.3 * f * fy, 0.5 * rear * px, 0.5 * rear * py
    rays, distance = film_rays(lens, fx, fy, px, py)
    out = trace_differentials(lens, rays, film_derivatives(rays, distance))
    passed = out.traced.status == 0
    assert passed.sum() > 100
    h = 1e-4
    for k, (ex, ey) in enumerate([(h, 0.0), (0.0, h)]):
        ahead, behind = (trace(lens, film_rays(lens, fx + s * ex, fy + s * ey, px, py)[0]) for s in (1, -1))
        ok = passed & (ahead.status == 0) & (behind.status == 0)
        for found, a, b in zip(out.derivatives[k], ahead.rays, behind.rays, strict=True):
            wanted = (a - b) / (2 * h)
            assert (found - wanted)[ok].abs().max() < 1e-7 * (1 + wanted[ok].abs().max())


def test_near_the_axis_of_a_focused_lens_the_direction_turns_by_one_over_the_focal_length() -> None:
    lens = tabled("laikin_double_gauss_50").at()
    zero = torch.zeros(1, dtype=torch.float64)
    rays, distance = film_rays(lens, zero, zero, zero, zero)
    dx, dy = trace_differentials(lens, rays, film_derivatives(rays, distance)).derivatives
    f = first_order(lens).efl_mm
    assert float(dx.dx) == pytest.approx(-1 / f, rel=1e-12) and float(dy.dy) == pytest.approx(-1 / f, rel=1e-12)
    assert abs(float(dx.dy)) < 1e-15 and abs(float(dx.dz)) < 1e-15


def test_directions_stay_unit_vectors_and_lost_rays_have_no_derivative() -> None:
    lens = asphere()
    g = torch.Generator().manual_seed(4)
    fx, fy, px, py = ((torch.rand(2000, generator=g, dtype=torch.float64) * 2 - 1) * 30 for _ in range(4))
    rays, distance = film_rays(lens, fx, fy, px, py)
    out = trace_differentials(lens, rays, film_derivatives(rays, distance))
    d = out.traced.rays
    lost = (d.x == 0) & (d.y == 0) & (out.traced.status != 0)  # replaced by a ray along the axis
    assert lost.any()
    for slope in out.derivatives:
        assert all(torch.isfinite(c).all() for c in slope)
        along = d.dx * slope.dx + d.dy * slope.dy + d.dz * slope.dz
        assert along[~lost].abs().max() < 1e-12
        assert all((c[lost] == 0).all() for c in slope)


def test_float32_gives_the_same_to_rounding() -> None:
    lens = tabled("laikin_double_gauss_50").at()
    points = [torch.linspace(-9, 9, 50, dtype=torch.float64) * k for k in (1.0, 0.5, 0.3, -0.4)]
    found = []
    for dtype in (torch.float64, torch.float32):
        rays, distance = film_rays(lens, *(p.to(dtype) for p in points))
        found.append(trace_differentials(lens, rays, film_derivatives(rays, distance)))
    ok = (found[0].traced.status == 0) & (found[1].traced.status == 0)
    for k in range(2):
        for a, b in zip(found[0].derivatives[k], found[1].derivatives[k], strict=True):
            assert (a - b.double())[ok].abs().max() < 2e-5 * (1 + a[ok].abs().max())


def test_no_derivatives_and_wrong_ones() -> None:
    lens = asphere()
    rays, _ = film_rays(lens, *(torch.zeros(3, dtype=torch.float64) for _ in range(4)))
    assert trace_differentials(lens, rays, ()).derivatives == ()
    with pytest.raises(InputError, match=r"derivatives\[0\].x"):
        trace_differentials(lens, rays, (Rays(*(c[:2] for c in rays)),))
    with pytest.raises(InputError, match="float32"):
        trace_differentials(lens, rays, (Rays(*(c.float() for c in rays)),))
