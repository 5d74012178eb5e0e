"""Bundles: every ray where it was aimed, whatever the lens; energy, paths and perfect foci."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from analysis_lenses import INF, cartesian, library, scene, thin

from neurolens.analysis.bundles import Pattern, bundle, fan, grid, hexapolar, points
from neurolens.analysis.fields import Scene
from neurolens.analysis.spots import working_f_number
from neurolens.analysis.wavefront import opd_mm
from neurolens.base.errors import InputError
from neurolens.optics.apertures import Aperture
from neurolens.optics.prescription import Lens, Surface
from neurolens.optics.surfaces import Rays
from neurolens.optics.trace import trace

LENSES = ["laikin_double_gauss_50", "shimizu_fisheye_220", "ogawa_zoom_70_200", "phone_lens_6", "cooke_anamorphic_42"]


@pytest.mark.parametrize("focus_m", [INF, 2.0])
@pytest.mark.parametrize("name", LENSES)
def test_rays_meet_the_stop_where_they_were_aimed(name: str, focus_m: float) -> None:
    given = library(name, focus_m=focus_m)
    edge = given.edge_deg()
    rays = bundle(given, [0.0, 0.6 * edge, edge], [587.5618, 486.1327], hexapolar(3))
    lens = given.lens
    flat = Rays(*(c.reshape(-1) for c in rays.start))
    waves = torch.tensor(rays.wavelength_nm, dtype=torch.float64)[None, :, None].expand(rays.status.shape).reshape(-1)
    at = trace(lens, flat, waves, towards="film", record=[lens.stop_index]).crossings[lens.stop_index]
    passed = rays.passed
    assert passed.double().mean() > 0.5
    x, y = (c.reshape(passed.shape) / lens.stop_radius_mm for c in (at.x, at.y))
    # The image lies on the negative side: tangential coordinates grow towards it.
    assert torch.where(passed, -y - rays.pattern.tangential, 0.0).abs().max() < 1e-7
    assert torch.where(passed, x - rays.pattern.sagittal, 0.0).abs().max() < 1e-7


@pytest.mark.parametrize("focus_m", [INF, 2.0])
def test_all_rays_of_a_field_come_from_one_object_point(focus_m: float) -> None:
    given = library("laikin_double_gauss_50", focus_m=focus_m)
    start = bundle(given, [15.0], pattern=hexapolar(3)).start
    if math.isinf(focus_m):
        assert torch.rad2deg(torch.atan2(-start.dy, start.dz)) == pytest.approx(15.0, abs=1e-9)
        return
    t = (given.object_z_mm - start.z) / start.dz
    x, y = start.x + t * start.dx, start.y + t * start.dy
    assert float(y.max() - y.min()) < 1e-8 and float(x.abs().max()) < 1e-8 and float(y.min()) > 400


@pytest.mark.parametrize("pattern", [hexapolar(3), hexapolar(9), grid(9), grid(40)])
def test_weights_are_shares_of_the_disc(pattern: Pattern) -> None:
    r2 = pattern.tangential**2 + pattern.sagittal**2
    assert float(pattern.weight.sum()) == pytest.approx(1) and float(r2.max()) <= 1
    # The mean of r^2 over a disc is a half.
    assert float((pattern.weight * r2).sum()) == pytest.approx(0.5, abs=0.6 / len(r2) ** 0.5)


def test_a_fan_holds_the_centre_and_both_edges() -> None:
    line = fan(5)
    assert line.tangential[:5].tolist() == pytest.approx([-1, -0.5, 0, 0.5, 1], abs=1e-6)
    assert line.sagittal[5:].tolist() == pytest.approx([-1, -0.5, 0, 0.5, 1], abs=1e-6)


def test_energy_is_the_area_of_the_beam() -> None:
    """A stop in front of everything takes pi r^2 cos(theta) out of collimated light."""
    given = cartesian(stop_mm=4.0)
    rays = bundle(given, [0.0, 1.0, 2.0], [587.5618], hexapolar(6))
    wanted = math.pi * 16 * torch.cos(torch.deg2rad(torch.tensor([0.0, 1.0, 2.0], dtype=torch.float64)))
    assert rays.weight.sum((1, 2)).tolist() == pytest.approx(wanted.tolist(), rel=1e-6)


def test_energy_is_the_solid_angle_from_a_near_point() -> None:
    given = scene([Surface(INF, 0.0, 20, stop=True), Surface(50, 4, 40, 1.5), Surface(-50, 50, 40)], focus_m=1.0)
    distance = -given.object_z_mm
    wanted = 2 * math.pi * (1 - distance / math.hypot(distance, 10))
    found = bundle(given, [0.0], [587.5618], hexapolar(10)).weight.sum()
    assert float(found) == pytest.approx(wanted, rel=1e-5)


def test_a_cartesian_lens_is_perfect_on_the_axis() -> None:
    """No spot, and all optical paths alike (Fermat), f/2.5."""
    given = cartesian(stop_mm=20.0)
    rays = bundle(given, [0.0], [587.5618], hexapolar(8))
    assert rays.passed.all()
    assert float(torch.hypot(rays.tangential_mm, rays.sagittal_mm).max()) < 1e-9
    assert float(rays.path_mm.max() - rays.path_mm.min()) < 1e-9
    assert float(opd_mm(rays).std()) < 1e-6 * 587.5618e-6


def test_a_cylinder_focuses_one_meridian_only() -> None:
    rows = [Surface(INF, 0.0, 10, stop=True), Surface(50.0, 0.0, 30, 1.5, cylinder="y"), Surface(INF, 100.0, 30)]
    lens = Lens("cylinder", "", tuple(rows), 10.0, half_field_deg=5.0, film_z_mm=100.0)
    along = bundle(Scene(lens, axis="y"), [0.0], [587.5618], points([0.1, 0.0], [0.0, 0.1]))
    assert along.tangential_mm[0, 0].tolist() == pytest.approx([0, 0], abs=1e-4)
    assert along.sagittal_mm[0, 0].tolist() == pytest.approx([0, 0.5], abs=1e-4)
    across = bundle(Scene(lens, axis="x"), [0.0], [587.5618], points([0.1, 0.0], [0.0, 0.1]))
    # Tangential is -x now: the image side.
    assert across.tangential_mm[0, 0].tolist() == pytest.approx([0.5, 0], abs=1e-4)
    assert across.sagittal_mm[0, 0].tolist() == pytest.approx([0, 0], abs=1e-4)


def test_rims_take_light_and_the_open_scene_shows_what_is_missing() -> None:
    given = library("laikin_double_gauss_50")
    field = [given.edge_deg()]
    seen, whole = bundle(given, field), bundle(given.open, field)
    assert 0.4 < float(seen.weight.sum() / whole.weight.sum()) < 0.8
    assert torch.equal(whole.weight > 0, whole.open_weight > 0) and (seen.status[~seen.passed] > 0).all()


def test_a_fisheye_is_filled_at_110_degrees() -> None:
    rays = bundle(library("shimizu_fisheye_220"), [110.0], pattern=hexapolar(5))
    assert (rays.open_weight > 0).all() and rays.passed.double().mean() > 0.4
    assert torch.rad2deg(torch.atan2(-rays.start.dy, rays.start.dz)) == pytest.approx(110.0, abs=1e-9)


def test_a_field_that_no_ray_reaches_is_blocked_not_raised() -> None:
    rays = bundle(thin(0.0), [120.0])
    assert not rays.passed.any() and float(rays.weight.sum()) == 0 and rays.tangential_mm.isnan().all()


def test_a_diverging_lens_forms_no_image() -> None:
    lens = Lens("d", "", (Surface(-50, 2, 20, 1.5), Surface(50, 5, 20), Surface(INF, 40, 5, stop=True)), 4.0)
    with pytest.raises(InputError, match="forms an image"):
        Scene(replace(lens, film_z_mm=50.0)).default_fields()


def test_blades_cut_the_bundle_and_count_as_the_stop() -> None:
    """A square stop lets 2 / pi of the circle's light through; no rim takes any of it on the axis."""
    given = library("laikin_double_gauss_50", f_number=8.0)
    square = replace(given, lens=given.lens.with_aperture(Aperture(blades=4)))
    cut, whole = (bundle(s, [0.0, 10.0], [587.5618], grid(99)) for s in (square, given))
    assert float(cut.weight[0].sum() / whole.weight[0].sum()) == pytest.approx(2 / math.pi, rel=0.01)
    assert float(cut.weight.sum() / cut.open_weight.sum()) == pytest.approx(1, rel=2e-3)
    assert working_f_number(square, 587.5618) == pytest.approx(working_f_number(given, 587.5618))
