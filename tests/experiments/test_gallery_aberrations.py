"""Each aberration of the gallery is measured as theory has it, a surrogate shows it as the exact lens does, and a thin
lens does not.


The effects that tests of the analysis know from closed forms as well run with NEUROLENS_WHOLE=1.
"""

import math
from dataclasses import replace

import numpy as np
import pytest
from gallery_shots import GALLERY, measured, shot

from experiments.pictures.gallery.cameras import Shot, View, Window, exact_camera, shot_of, thin_camera
from experiments.pictures.gallery.measures import light_profile, spot
from experiments.pictures.gallery.settings import read_effect
from neurolens.cameras.ideal import ThinLens
from neurolens.optics.analysis.field_curves import RECTILINEAR, curvature, distortion, seidel
from neurolens.optics.analysis.fields import Scene
from neurolens.optics.lens.glass import LINE_D_NM, index_of
from neurolens.optics.lens.paraxial import first_order
from neurolens.pictures.render.renderer import render
from neurolens.pictures.render.scene import load_scene

ALL = ("exact", "surrogate", "thin")


def scene_of(taken: Shot) -> Scene:
    """What the analysis package makes of a shot: an independent way from the scene to the film."""
    return Scene(taken.lens, focus_m=taken.focus_m, rims=False)


@pytest.mark.parametrize("offset_mm", [-2.0, 1.5])
def test_a_spot_out_of_focus_is_the_disc_of_a_thin_lens(offset_mm: float) -> None:
    camera = ThinLens(50.0, 8.0, 3.0, film_offset_mm=offset_mm)
    sharp = ThinLens(50.0, 8.0, 3.0).image_distance_mm
    # A uniform disc of radius R has a standard deviation of R / 2 along every axis; R by similar triangles.
    expected = 1000 * 3.125 * abs(offset_mm) / sharp / 2
    for place in ((0.0, 0.0), (8.0, -5.0)):
        assert spot(camera, place, 3.0).widths_um == pytest.approx((expected, expected), rel=0.01)
    assert max(spot(ThinLens(50.0, 2.0, 3.0), (8.0, 5.0), 3.0).widths_um) < 0.01


def test_spherical_aberration_of_a_closed_singlet_is_third_order() -> None:
    taken = shot("thorlabs_lb1471_biconvex_50", focus_m=2.0, f_number=11.0, wavelengths_nm=(LINE_D_NM, LINE_D_NM))
    sums = seidel(scene_of(taken), image_height_mm=1.0)
    # Transverse aberration e rho^3, e = S1 / (2 u'): over a uniform pupil its variance is e^2 / 4, half of it an axis.
    camera = exact_camera(taken, None)
    data = first_order(taken.lens)
    image_mm = taken.lens.film_z_mm - data.exit_pupil_z_mm  # type: ignore[operator]
    slope = data.exit_pupil_diameter_mm / 2 / image_mm
    expected = 1000 * abs(float(sums.total[0])) / (2 * slope) / (2 * math.sqrt(2))
    assert spot(camera, (0.0, 0.0), 2.0, LINE_D_NM).widths_um == pytest.approx((expected, expected), rel=0.05)


@pytest.mark.whole
def test_core_and_rim_of_a_light_change_places_through_focus() -> None:
    effect = read_effect(GALLERY / "spherical-aberration.toml")
    found = {}
    for panel in (effect.panel[0], effect.panel[-1]):
        taken = shot_of(panel, load_scene(panel.scene))
        for column, camera in (("exact", exact_camera(taken, None)), ("thin", thin_camera(taken, None))):
            whole = Window(camera, (0.0, 0.0, 32.0, 32.0))
            rgb = render(taken.scene, whole, width=32, height=32, samples=60, threads=1).rgb
            # The window is larger than the film of the panel: the profile's places must be those of the picture.
            larger = replace(taken, film_mm=(32.0, 32.0))
            found[panel.label, column] = light_profile(View(larger, camera, column, rgb))["core_over_rim"]
    assert found["focus 0.8 m", "exact"] < 0.85
    assert found["focus 1.4 m", "exact"] > 2
    # An even disc, but for the penumbra of a light that is no point and the noise of few samples.
    for focus in ("0.8", "1.4"):
        assert 0.8 < found[f"focus {focus} m", "thin"] < 1.5


# Small fields, where the third order rules.
COMETS = {
    "thorlabs_lb1471_biconvex_50": {"f_number": 8.0, "focus_m": 2.0},
    "laikin_double_gauss_127": {"f_number": 4.0, "focus_m": 4.0},
}


@pytest.mark.parametrize("lens", COMETS)
def test_comets_point_as_the_seidel_sum_says_and_as_the_surrogate_says(lens: str) -> None:
    taken = shot(lens, model=".mlp-16x2", **COMETS[lens])
    found = measured(replace(taken, panel=replace(taken.panel, options={"x_mm": 4.0})), "comet", ALL)
    tail = found["exact"]["tail_um"]
    # S2 above 0: the rim of the pupil meets the film farther from the axis than the chief ray.
    assert math.copysign(1, tail) == math.copysign(1, float(seidel(scene_of(taken), image_height_mm=4.0).total[1]))
    assert abs(tail) > 3
    assert found["surrogate"]["tail_um"] == pytest.approx(tail, rel=0.02, abs=0.2)
    assert abs(found["thin"]["tail_um"]) < 0.01


@pytest.mark.whole
def test_rims_and_spokes_are_sharp_where_close_rays_meet() -> None:
    # The square of a spot's width is a parabola in the film's place; its vertex is the focus of that meridian.
    widths = {}
    for offset in (-1.0, 0.0, 1.0):
        taken = shot("petzval_portrait_100", focus_m=3.0, f_number=16.0, film_offset_mm=offset, model=".mlp-16x2",
                     film_mm=(40.0, 20.0), options={"x_mm": 10.0})  # fmt: skip
        widths[offset] = found = measured(taken, "line_blur", ALL if offset == 1 else ("exact", "thin"))
        assert found["thin"]["rims_um"] == pytest.approx(found["thin"]["spokes_um"], abs=0.05)
    for name in ("rims_um", "spokes_um"):
        assert widths[1.0]["surrogate"][name] == pytest.approx(widths[1.0]["exact"][name], rel=0.01, abs=0.1)
    sharp = shot("petzval_portrait_100", focus_m=3.0, f_number=16.0)
    foci = curvature(scene_of(sharp), wavelength_nm=550.0, edge_deg=7.0)
    for name, focus_mm in (("rims_um", foci.tangential_mm), ("spokes_um", foci.sagittal_mm)):
        low, middle, high = (widths[o]["exact"][name] ** 2 for o in (-1.0, 0.0, 1.0))
        vertex = (low - high) / (2 * (low + high - 2 * middle))
        assert vertex == pytest.approx(float(np.interp(10.0, foci.height_mm, focus_mm)), abs=0.1)


@pytest.mark.whole
def test_the_field_of_a_singlet_is_curved_and_less_so_at_a_longer_focal_length() -> None:
    found = {}
    for focal in (50.0, 100.0):
        taken = shot("thorlabs_lb1471_biconvex_50", focus_m=2.0, f_number=8.0, focal_length_mm=focal, focus_mode="best",
                     options={"x_mm": 15.0, "y_mm": 10.0})  # fmt: skip
        found[focal] = measured(taken, "edge_blur", ("exact", "thin"))
    assert found[50.0]["exact"]["edge_over_middle"] > 2 * found[100.0]["exact"]["edge_over_middle"] > 10
    # The blur is that of a flat film before a curved image: it grows with h^2 / f, over the same f-number.
    assert found[50.0]["exact"]["edge_um"] / found[100.0]["exact"]["edge_um"] == pytest.approx(2, rel=0.15)
    assert found[50.0]["thin"]["edge_um"] < 0.01


def test_lines_bow_outward_behind_a_singlet_as_its_distortion_says() -> None:
    taken = shot("biconvex_rear_stop_50", focus_m=2.0, f_number=22.0, options={"x_mm": 6.0, "y_mm": 3.0})
    found = measured(taken, "line_bow", ("exact", "thin"))
    chief = distortion(scene_of(taken), wavelength_nm=550.0, edge_deg=12.0)
    radius = math.hypot(6.0, 3.0)
    # r (1 + k r^2): a line at y bends by k x^2 y over its half length x.
    k = float(np.interp(radius, chief.height_mm, chief.error_percent[RECTILINEAR])) / 100 / radius**2
    assert found["exact"]["bow_um"] == pytest.approx(1000 * k * 6.0**2 * 3.0, rel=0.05)
    assert found["exact"]["bow_um"] > 10
    assert abs(found["thin"]["bow_um"]) < 0.05


@pytest.mark.whole
def test_red_and_blue_fringes_change_sides_with_the_film() -> None:
    found = {}
    for offset in (-2.0, 2.0):
        taken = shot("thorlabs_lb1471_biconvex_50", focus_m=1.2, f_number=8.0, film_offset_mm=offset,
                     model=".mlp-16x2", wavelengths_nm=(450.0, 650.0))  # fmt: skip
        found[offset] = measured(taken, "colour_blur", ALL if offset < 0 else ("exact", "thin"))
        assert found[offset]["thin"]["red_minus_blue_um"] == 0
    shifts = [found[-2.0][column]["red_minus_blue_um"] for column in ("exact", "surrogate")]
    assert shifts[1] == pytest.approx(shifts[0], abs=0.7)
    # Foci lie s'^2 / f (n_blue - n_red) / (n - 1) apart; on a film beyond both, discs differ by that over the f-number.
    glass = taken.lens.surfaces[1]
    blue, line_d, red = (float(index_of(glass, nm)) for nm in (450.0, LINE_D_NM, 650.0))
    efl = first_order(taken.lens).efl_mm
    apart = (efl * 1150 / (1150 - efl)) ** 2 / efl * (blue - red) / (line_d - 1)
    radius_um = 1000 * apart / (2 * 8.0 * 1.045)
    for offset, sign in ((-2.0, 1), (2.0, -1)):
        expected = sign * radius_um / math.sqrt(2)
        assert found[offset]["exact"]["red_minus_blue_um"] == pytest.approx(expected, rel=0.1)


@pytest.mark.whole
def test_red_is_drawn_where_chief_rays_bring_it_at_the_edge_of_a_fisheye() -> None:
    taken = shot("horimoto_fisheye_16", focus_m=3.0, f_number=16.0, film_mm=(40.0, 6.0), model=".mlp-16x2",
                 options={"x_mm": 17.0, "y_mm": 0.0, "depth_m": 1.0}, wavelengths_nm=(450.0, 650.0))  # fmt: skip
    found = measured(taken, "lateral_colour", ALL)
    shift = found["exact"]["red_minus_blue_um"]
    assert found["surrogate"]["red_minus_blue_um"] == pytest.approx(shift, abs=1)
    assert found["thin"]["red_minus_blue_um"] == 0
    # The scene point that blue light of the film point comes from, seen in red by the chief rays of the other way.
    chief = scene_of(taken)
    angles = np.linspace(50.0, 75.0, 26)
    heights = [chief.chief_rays(angles, nm).height_mm.numpy() for nm in (450.0, 650.0)]
    field = np.interp(17.0, heights[0], angles)
    assert shift == pytest.approx(1000 * (np.interp(field, angles, heights[1]) - 17.0), abs=1)
    assert abs(shift) < 2  # the design brings 450 and 650 nm together; 520 nm lies 15 um farther in
