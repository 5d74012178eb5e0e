"""Rays aimed at the stop go through the points asked for, at the field asked for, or say that none does."""

from __future__ import annotations

import math

import pytest
import torch
from shipped import tabled

from neurolens.optics.aiming import aim_at_stop, without_rims
from neurolens.optics.prescription import Lens, Surface
from neurolens.optics.trace import trace

INF = math.inf


@pytest.mark.parametrize(
    ("name", "half_field_deg"),
    [
        ("shimizu_fisheye_220", 110.0),  # beyond 90 degrees, the stop deep inside
        ("isshiki_fisheye_10", 110.0),
        ("nikon_zoom_14_24", 57.6),  # steep aspheres
        ("phone_lens_6", 32.2),  # the stop in front, inside the cap of an asphere
        ("cooke_triplet_50", 20.0),  # the stop is a surface of glass
        ("thorlabs_lb1471_biconvex_50", 20.0),  # the stop stands before all glass
        ("laikin_double_gauss_50", 23.0),
    ],
)
def test_rays_meet_their_points_of_the_stop_at_their_field(name: str, half_field_deg: float) -> None:
    lens = tabled(name)
    field = torch.deg2rad(torch.linspace(0, half_field_deg, 6, dtype=torch.float64))
    height = lens.stop_radius_mm * torch.linspace(-0.5, 0.5, 5, dtype=torch.float64).expand(6, 5)
    found = aim_at_stop(lens, field, height)
    assert found.reached.all()
    torch.testing.assert_close(found.field_rad, field[:, None].expand(6, 5), rtol=0, atol=1e-11)
    out = trace(without_rims(lens), found.rays, towards="film", record=[lens.stop_index])
    assert (out.status == 0).all()
    torch.testing.assert_close(out.crossings[lens.stop_index].x.reshape(6, 5), height, rtol=0, atol=1e-9)
    # The light comes from the positive side: it travels towards -x before the lens.
    assert (found.rays.dx[5:] < 0).all()


@pytest.mark.parametrize("axis", ["x", "y"])
def test_both_planes_of_an_anamorphic_lens(axis: str) -> None:
    lens = tabled("cooke_anamorphic_42")
    field = torch.deg2rad(torch.tensor([0.0, 5.0, 10.0], dtype=torch.float64))
    found = aim_at_stop(lens, field, torch.zeros(3, 1, dtype=torch.float64), axis=axis)  # type: ignore[arg-type]
    out = trace(lens, found.rays, towards="film", record=[lens.stop_index])
    stop, across = out.crossings[lens.stop_index], found.rays.dy if axis == "x" else found.rays.dx
    assert found.reached.all() and (out.status == 0).all()
    assert (across == 0).all()
    assert max(float(stop.x.abs().max()), float(stop.y.abs().max())) < 1e-9


def test_a_pinhole_of_no_thickness_is_aimed_at_straight() -> None:
    rows = (Surface(INF, 10.0, 1.0, stop=True), Surface(-50.0, 1.0, 60.0, 1.5), Surface(-49.0, 50.0, 60.0))
    field = torch.tensor([0.3], dtype=torch.float64)
    found = aim_at_stop(Lens("stop first", "", rows, 4.0), field, torch.tensor([[0.25]], dtype=torch.float64))
    assert float(found.field_rad) == pytest.approx(0.3, abs=1e-13)
    r = found.rays
    assert float(r.x - r.z * r.dx / r.dz) == pytest.approx(0.25, abs=1e-12)


def test_a_field_that_no_ray_reaches_gives_the_widest_that_is() -> None:
    """A flat window in front: no ray from inside leaves at more than 90 degrees."""
    rows = (Surface(INF, 5.0, 100.0, 1.5), Surface(INF, 10.0, 100.0), Surface(INF, 50.0, 2.0, stop=True))
    field = torch.deg2rad(torch.tensor([60.0, 100.0], dtype=torch.float64))
    found = aim_at_stop(Lens("window", "", rows, 4.0), field, torch.zeros(2, 1, dtype=torch.float64))
    assert found.reached[:, 0].tolist() == [True, False]
    assert math.degrees(float(found.field_rad[0])) == pytest.approx(60.0)
    assert 88.5 < math.degrees(float(found.field_rad[1])) < 90.0
