"""Each aberration of the gallery is measured as theory has it, a surrogate shows it as the exact lens does, and a thin
lens does not.


The effects that tests of the analysis know from closed forms as well run with NEUROLENS_WHOLE=1.
"""

import math
from dataclasses import replace

import numpy as np
import pytest
from gallery_shots import measured, shot

from experiments.gallery.cameras import Shot, exact_camera
from experiments.gallery.measures import spot
from neurolens.analysis.field_curves import RECTILINEAR, distortion, seidel
from neurolens.analysis.fields import Scene
from neurolens.cameras.ideal import ThinLens
from neurolens.lens.glass import LINE_D_NM
from neurolens.lens.paraxial import first_order

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
