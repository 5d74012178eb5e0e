"""Where rims are ignored: aspheres continue smoothly, lose no ray that passes, and fields are reached beyond gaps."""

import math
from pathlib import Path

import pytest
import torch
from shipped import SOME, tabled

from neurolens.optics.lens.figures import Cylinder, Figure, Toroid
from neurolens.optics.lens.paraxial import first_order
from neurolens.optics.lens.prescription import Lens, Surface
from neurolens.optics.readers.lensfile import read_lens
from neurolens.optics.trace.aiming import aim_at_stop, between, bracket, without_rims
from neurolens.optics.trace.rays import trace
from neurolens.optics.trace.shapes import TURN
from neurolens.optics.trace.surfaces import Rays

INF = math.inf
FUJINON = Path(__file__).parents[2] / "data" / "fujinon_35.toml"  # four aspheres up to r^20
# A term in r^20 that is 0.1 mm at the rim of 5 mm, and 330 mm at 1.5 times the rim.
STEEP = Surface(40.0, 4.0, 10.0, 1.5, figure=Figure(asphere=((4, 1e-5), (20, 0.1 / 5.0**20))))


def curve(surface: Surface, height: torch.Tensor) -> torch.Tensor:
    """Depth of a surface without rims at heights, met by rays along the axis."""
    rows = (surface, Surface(INF, 50.0, 10.0, stop=True))
    lens = without_rims(Lens("test", "", rows, 4.0))
    zero = torch.zeros_like(height)
    out = trace(lens, Rays(zero, height, zero - 500, zero, zero, zero + 1), towards="film", path=True)
    assert out.path[0].y.tolist() == pytest.approx(height.tolist(), abs=1e-9)
    return out.path[0].z


@pytest.mark.parametrize(
    "surface",
    [
        STEEP,
        Surface(
            -8.0, 4.0, 14.0, 1.5, figure=Figure(conic=0.2, asphere=((3, 1e-4), (6, 1e-7)))
        ),  # its conic ends at 7.3 mm
        Surface(INF, 4.0, 10.0, 1.5, figure=Cylinder(asphere=((4, 1e-4),), cylinder="y")),
        Surface(40.0, 4.0, 10.0, 1.5, figure=Toroid(asphere=((12, 1e-10),), cylinder="y", across_mm=60.0)),
    ],
)
def test_aspheres_continue_with_slope_and_curvature_and_become_cones(surface: Surface) -> None:
    end = without_rims(Lens("", "", (surface,), 4.0)).surfaces[0].followed_mm
    rim = surface.semi_diameter_mm
    assert rim <= end <= 1.5 * rim
    step = 1e-3
    z = curve(surface, end + step * torch.arange(-3, 4, dtype=torch.float64))
    slope, bend = z.diff() / step, z.diff(n=2) / step**2
    # No step in slope or curvature: third derivatives times the steps between them are all that is left.
    assert float(slope.diff().abs().max()) < 1.5 * step * float(bend.abs().max())
    assert float(bend.diff().abs().max()) < 0.1 * float(bend.abs().max()) + 1e-4
    if surface.figure.across is None:
        far = curve(surface, torch.tensor([10.0, 10.1, 20.0, 20.1], dtype=torch.float64) * rim)
        slopes = (far[1] - far[0], far[3] - far[2])
        assert float(slopes[0]) == pytest.approx(float(slopes[1]), rel=1e-6)
        turned = math.atan(float(slopes[1]) / (0.1 * rim)) - math.atan(float(slope[2]))
        assert abs(turned) < 1.2 * TURN


def test_a_rim_where_the_conic_ends() -> None:
    surface = Surface(-5.0, 4.0, 10.0, 1.5, figure=Figure(asphere=((4, 1e-5),)))
    height = 5 * torch.tensor([0.0, 0.5, 0.9, 0.999], dtype=torch.float64)
    lens = Lens("", "", (surface, Surface(INF, 50.0, 1e3, stop=True)), 4.0)
    zero = torch.zeros_like(height)
    seen = trace(lens, Rays(zero, height, zero - 9, zero, zero, zero + 1), towards="film", path=True)
    assert (seen.status // 4 != 1).all()  # none ends at the first surface
    assert curve(surface, height).tolist() == pytest.approx(seen.path[0].z.tolist(), abs=1e-9)


def passing_rays(lens: Lens, count: int) -> Rays:
    """Rays from film points to the exit pupil, half as wide again, from which enough pass."""
    data, u = first_order(lens), torch.rand(3, count, generator=torch.Generator().manual_seed(7), dtype=torch.float64)
    film, pupil = data.rear_focal_z_mm, data.exit_pupil_z_mm
    edge = lens.image_radius_mm or abs(data.efl_mm) * math.tan(math.radians(min(lens.half_field_deg or 15.0, 50.0)))
    radius = 0.75 * data.exit_pupil_diameter_mm * torch.sqrt(u[1])
    x, zero = edge * u[0], torch.zeros(count, dtype=torch.float64)
    d = torch.stack(
        [radius * torch.cos(2 * math.pi * u[2]) - x, radius * torch.sin(2 * math.pi * u[2]), zero + pupil - film]
    )
    d = d * torch.sign(-d[2]) / d.norm(dim=0)  # camera rays travel towards -z, whichever side the exit pupil is on
    return Rays(x, zero, zero + film, *d)


@pytest.mark.parametrize("name", [*SOME, "fujinon_35"])
def test_no_ray_that_passes_with_rims_is_lost_without_them(name: str) -> None:
    lens = read_lens(FUJINON) if name == "fujinon_35" else tabled(name)
    rays = passing_rays(lens, 1000)
    seen, whole = trace(lens, rays), trace(without_rims(lens), rays)
    passed = seen.status == 0
    assert passed.sum() > 50 and (whole.status[passed] == 0).all()
    for a, b in zip(seen.rays, whole.rays, strict=True):
        assert float((a - b)[passed].abs().max()) < 1e-9


def test_a_bracket_is_the_first_beyond_gaps_on_either_slope() -> None:
    """The field 2 sin(angle), with rays missing from 0.2 to 0.6, from -pi/2 up to pi, where it falls again."""
    angle = torch.linspace(0, math.pi, 101, dtype=torch.float64)[None]
    for target, wanted in ((0.3, math.asin(0.15)), (1.5, math.asin(0.75))):
        ends = angle
        for _ in range(5):
            fine = between(ends) if ends is not angle else angle
            exists = (fine < 0.2) | (fine > 0.6)
            ends = bracket(fine, 2 * torch.sin(fine), exists, torch.tensor([target], dtype=torch.float64))
        assert float(ends[0, 1]) == pytest.approx(wanted, abs=1e-12)
    # 0.8 is met in the gap and, falling, at pi - asin(0.4); 3 nowhere: its neighbours are those of the top.
    falling = bracket(
        angle, 2 * torch.sin(angle), (angle < 0.2) | (angle > 0.6), torch.tensor([0.8], dtype=torch.float64)
    )
    assert float(falling[0, 0]) < math.pi - math.asin(0.4) < float(falling[0, 2])
    top = bracket(angle, 2 * torch.sin(angle), angle >= 0, torch.tensor([3.0], dtype=torch.float64))
    assert float(top[0, 0]) < math.pi / 2 < float(top[0, 2])


@pytest.mark.parametrize(("name", "widest"), [("isshiki_fisheye_10", 135.0), ("shimizu_fisheye_220", 110.0)])
def test_fisheyes_are_reached_behind_the_lens(name: str, widest: float) -> None:
    fields = torch.deg2rad(torch.tensor([0.0, 45.0, 89.9, 90.0, widest], dtype=torch.float64))
    found = aim_at_stop(tabled(name), fields, torch.zeros(5, 1, dtype=torch.float64))
    assert found.reached.all() and found.field_rad[:, 0].tolist() == pytest.approx(fields.tolist(), abs=1e-11)
