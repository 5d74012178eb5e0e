"""Bundles, spots, MTF, point spread, distortion and illumination: every ray where it was aimed; closed forms."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from analysis_lenses import INF, cartesian, grid, library, scene, thin
from path_difference import opd_mm
from shipped import pinhole, whole

from neurolens.base.errors import InputError
from neurolens.optics.analysis.bundles import bundle, hexapolar, points
from neurolens.optics.analysis.field_curves import distortion, illumination
from neurolens.optics.analysis.fields import Scene
from neurolens.optics.analysis.layout import layout_profile
from neurolens.optics.analysis.psf import psf
from neurolens.optics.analysis.spots import diffraction_mtf, fans, mtf, spots, working_f_number
from neurolens.optics.lens.apertures import Aperture
from neurolens.optics.lens.figures import Cylinder
from neurolens.optics.lens.prescription import Lens, Surface
from neurolens.optics.setting.pupils import camera_rays
from neurolens.optics.trace.rays import trace
from neurolens.optics.trace.surfaces import Rays

LENSES = ["laikin_double_gauss_50", "shimizu_fisheye_220", "ogawa_zoom_70_200", "phone_lens_6", "cooke_anamorphic_42"]


@pytest.mark.parametrize("focus_m", [2.0, *whole(INF)])
@pytest.mark.parametrize("name", LENSES)
def test_rays_meet_the_stop_where_they_were_aimed(name: str, focus_m: float) -> None:
    given = library(name, focus_m=focus_m)
    edge = given.edge.field_deg
    pattern = hexapolar(3)
    rays = bundle(given, [0.0, 0.6 * edge, edge], [587.5618, 486.1327], pattern)
    lens = given.lens
    flat = Rays(*(c.reshape(-1) for c in rays.start))
    waves = torch.tensor(rays.wavelength_nm, dtype=torch.float64)[None, :, None].expand(rays.status.shape).reshape(-1)
    at = trace(lens, flat, waves, towards="film", record=[lens.stop_index]).crossings[lens.stop_index]
    passed = rays.passed
    assert passed.double().mean() > 0.5
    x, y = (c.reshape(passed.shape) / lens.stop_radius_mm for c in (at.x, at.y))
    # The image lies on the negative side: tangential coordinates grow towards it.
    assert torch.where(passed, -y - pattern.tangential, 0.0).abs().max() < 1e-7
    assert torch.where(passed, x - pattern.sagittal, 0.0).abs().max() < 1e-7


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
    rows = [
        Surface(INF, 0.0, 10, stop=True),
        Surface(50.0, 0.0, 30, 1.5, figure=Cylinder(cylinder="y")),
        Surface(INF, 100.0, 30),
    ]
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
    field = [given.edge.field_deg]
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


D = 587.5618
PINHOLE = Scene(replace(pinhole(50.0, 0.2, image_radius_mm=40.0), film_z_mm=50.0))


def moved(given: Scene, shift_mm: float) -> Scene:
    return replace(given, lens=replace(given.lens, film_z_mm=given.film_z_mm + shift_mm))


def test_a_pinhole_falls_off_as_cos4_and_does_not_distort() -> None:
    light = illumination(PINHOLE, fields=6)
    assert light.relative == pytest.approx(light.cos4, rel=2e-3)
    assert (light.passed == 1).all()
    bent = distortion(PINHOLE)
    assert bent.reference == "rectilinear, f tan" and bent.scale_mm == pytest.approx(50)
    assert np.abs(bent.error_percent[bent.reference]).max() < 1e-6


def test_illumination_of_a_real_lens_is_what_the_film_sees() -> None:
    """Brute force: every ray from the film to the rear element, weighted by cos^4."""
    given = library("laikin_double_gauss_50")
    light = illumination(given, fields=4)
    lens, z = given.lens, float(given.lens.vertices_mm[len(given.lens.surfaces) - 1])
    line = torch.linspace(-1, 1, 400, dtype=torch.float64) * lens.surfaces[-1].semi_diameter_mm
    px, py = (t.reshape(-1) for t in torch.meshgrid(line, line, indexing="ij"))
    sums = []
    for height in light.height_mm:
        rays = camera_rays(torch.zeros_like(px), torch.full_like(px, -height), given.film_z_mm, px, py, z)
        sums.append(float((rays.dz**4 * (trace(lens, rays).status == 0)).sum()))
    assert light.relative == pytest.approx(np.array(sums) / sums[0], abs=1e-3)
    assert light.relative == pytest.approx(light.unvignetted * light.passed, rel=1e-9)


def test_distortion_names_the_projection_of_a_fisheye() -> None:
    found = distortion(library("mizuguchi_fisheye_10"))
    assert found.reference == found.best == "equisolid, 2 f sin(theta/2)"
    assert distortion(library("ogawa_zoom_70_200")).reference == "rectilinear, f tan"
    json.dumps(found.to_dict())


def test_a_defocused_perfect_spot_is_a_disc() -> None:
    """RMS radius of an even disc is its radius over the square root of two."""
    given = moved(cartesian(stop_mm=2.0), 0.5)
    found = spots(given, [0.0], [D], rings=24)
    assert found.geometric_um[0] == pytest.approx(1000 * 0.5 * 2.0 / 100, rel=2e-3)
    assert found.rms_um[0] == pytest.approx(found.geometric_um[0] / math.sqrt(2), rel=2e-3)
    assert found.best_shift_mm[0] == pytest.approx(-0.5, abs=1e-6) and found.best_rms_um[0] < 1e-3
    assert found.airy_um == pytest.approx(1.22 * D * 1e-3 * 25, rel=2e-3)


def test_mtf_of_a_defocused_perfect_spot() -> None:
    """An even disc of diameter d has the MTF |2 J1(pi f d) / (pi f d)|, past its zeros too."""
    given = moved(cartesian(stop_mm=2.0), 1.0)
    f = np.linspace(0, 120, 61)
    a = torch.as_tensor(np.pi * f * 2 * 2.0 / 100)
    wanted = torch.where(a > 0, 2 * torch.special.bessel_j1(a) / a, 1.0).abs().numpy()
    found, in_focus = (mtf(given, [0.0], [D], frequency_per_mm=f, shift_mm=shift) for shift in (0.0, -1.0))
    for contrast in (found.tangential[0], found.sagittal[0]):
        assert contrast == pytest.approx(wanted, abs=1e-3)
    assert in_focus.tangential[0] == pytest.approx(1, abs=1e-6)
    assert working_f_number(given, D) == pytest.approx(25, rel=2e-3)


def test_mtf_where_rims_cut_the_pupil_is_that_of_a_dense_grid() -> None:
    given, f = library("laikin_double_gauss_50"), [10.0, 30.0, 50.0]
    rays = bundle(given, [20.0], [D], grid(300))
    weight = (rays.weight / rays.weight.sum())[0, 0].numpy()
    found = mtf(given, [20.0], [D], frequency_per_mm=f)
    for contrast, place in ((found.tangential, rays.tangential_mm), (found.sagittal, rays.sagittal_mm)):
        wave = np.exp(2j * np.pi * np.array(f)[:, None] * np.nan_to_num(place[0, 0].numpy()))
        assert contrast[0] == pytest.approx(np.abs(wave @ weight), abs=1e-3)


def test_diffraction_limit() -> None:
    limit = diffraction_mtf(np.array([0.0, 100.0, 1e6 / D / 10, 1e9]), D, 10.0)
    assert limit[0] == 1 and limit[2:] == pytest.approx(0, abs=1e-9)
    # Half way to the cut-off: 2/pi (pi/3 - sqrt(3)/4).
    half = diffraction_mtf(np.array([1e6 / D / 20]), D, 10.0)
    assert half[0] == pytest.approx(2 / math.pi * (math.pi / 3 - math.sqrt(3) / 4))


def test_a_quarter_wave_of_defocus_leaves_a_strehl_ratio_of_81_percent() -> None:
    given = cartesian(stop_mm=2.0)
    shift = 8 * 0.25 * D * 1e-6 * working_f_number(given, D) ** 2  # W020 = shift / (8 N^2)
    found = psf(moved(given, shift), [0.0], [D])
    assert found.strehl[0] == pytest.approx((math.sin(math.pi / 4) / (math.pi / 4)) ** 2, abs=5e-3)
    waves = opd_mm(bundle(moved(given, shift), [0.0], [D], hexapolar(12))) / (D * 1e-6)
    assert float(waves.max() - waves.min()) == pytest.approx(0.25, rel=1e-2)


def test_large_aberrations_leave_the_geometric_image() -> None:
    found = psf(library("laikin_double_gauss_50"), [0.0])
    assert np.isnan(found.diffraction).all() and np.isnan(found.strehl).all()
    assert found.geometric.sum() == pytest.approx(1, abs=0.02)


def test_fans_are_odd_on_the_axis_and_meet_the_chief_ray() -> None:
    found = fans(thin(1.0), [0.0, 5.0], n=9)
    t, s = found.tangential_um, found.sagittal_um
    assert t[0] == pytest.approx(-t[0, :, ::-1], abs=1e-6) and t[0] == pytest.approx(s[0], abs=1e-6)
    assert t[:, 0, 4] == pytest.approx(0, abs=1e-6) and s[:, :, 4] == pytest.approx(0, abs=1e-6)
    # Undercorrected: rays from above the axis land below.
    assert t[0, 0, -1] < 0


def test_layout_rays_end_on_the_film_and_start_at_their_field() -> None:
    given = library("shimizu_fisheye_220")
    data = layout_profile(given)
    fields = {r.label: r.points for r in data.rays}
    assert len(fields) == 3 and all(p[-1, 0] == pytest.approx(given.film_z_mm) for p in fields.values())
    edge = fields[next(k for k in fields if k.startswith("edge"))]
    angle = math.degrees(math.atan2(edge[0, 1] - edge[1, 1], edge[1, 0] - edge[0, 0]))
    assert angle == pytest.approx(given.fields_at([data.film_half_height_mm])[0], abs=1e-6) and angle > 100
    assert len(data.rays) == 21
