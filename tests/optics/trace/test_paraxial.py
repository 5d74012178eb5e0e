"""First-order data against formulas of text books and against exact rays near the axis."""

import math
import warnings
from dataclasses import replace

import numpy as np
import pytest
import torch
from shipped import SOME, tabled

from neurolens.base.errors import InputError
from neurolens.optics.lens import paraxial
from neurolens.optics.lens.paraxial import film_z_mm, first_order, stop_radius_mm
from neurolens.optics.lens.prescription import Lens, Surface
from neurolens.optics.setting.states import set_lens
from neurolens.optics.trace.rays import Rays, trace

INF = math.inf


def thick(r1: float, r2: float, t: float, n: float, gap: float = 0.0) -> Lens:
    """A single lens, its stop `gap` behind."""
    rows = (Surface(r1, t, 20, n), Surface(r2, gap, 20), Surface(INF, 50, 10, stop=True))
    return Lens("thick", "", rows, 4.0)


@pytest.mark.parametrize(
    ("r1", "r2", "t", "n"),
    [
        *((50, -50, 5, 1.5), (30, 60, 8, 1.9), (INF, -40, 3, 1.6), (40, INF, 3, 1.6), (-60, 45, 2, 1.7)),
        *((20, -20, 40, 1.5), (50, -80, 1e-3, 1.6), (50, -80, 1e-6, 1.6)),
    ],
)
def test_lensmaker_with_thickness(r1: float, r2: float, t: float, n: float) -> None:
    data = first_order(thick(r1, r2, t, n))
    power = (n - 1) * (1 / r1 - 1 / r2 + (n - 1) * t / (n * r1 * r2))
    assert data.efl_mm == pytest.approx(1 / power, rel=1e-12)
    # Principal planes from the vertices: -f (n - 1) t / (n R).
    assert data.front_principal_z_mm == pytest.approx(-(n - 1) * t / (n * r2) / power, abs=1e-10)
    assert data.rear_principal_z_mm - t == pytest.approx(-(n - 1) * t / (n * r1) / power, abs=1e-10)
    assert data.rear_focal_z_mm - data.rear_principal_z_mm == pytest.approx(data.efl_mm)


def test_pupils_of_a_stop_behind_a_thin_lens() -> None:
    """The entrance pupil is the stop seen through the lens (Gauss's equation); the exit pupil is the stop itself."""
    data = first_order(thick(50, -50, 1e-9, 1.5, gap=10.0))
    f = 50.0
    image = 1 / (1 / 10 - 1 / f)
    assert data.entrance_pupil_z_mm == pytest.approx(image, rel=1e-6)
    assert data.entrance_pupil_diameter_mm == pytest.approx(10 * image / 10, rel=1e-6)
    assert (data.exit_pupil_z_mm, data.exit_pupil_diameter_mm) == pytest.approx((10, 10), rel=1e-6)


def test_telecentric_stop() -> None:
    """A stop in the front focal plane: exit pupil at infinity; nothing divides by zero."""
    f = first_order(thick(INF, -40, 0.0, 1.5)).efl_mm
    rows = (Surface(INF, f, 8, stop=True), Surface(INF, 0.0, 20, 1.5), Surface(-40, 80, 20))
    data = first_order(Lens("telecentric", "", rows, 10.0))
    assert abs(data.exit_pupil_z_mm) > 1e12
    assert data.entrance_pupil_diameter_mm == 8


def test_an_afocal_system_has_no_focal_length() -> None:
    """A glass rod whose two ends share a focus: a telescope."""
    with pytest.raises(InputError, match="afocal"):
        first_order(thick(50, -50, 200, 2.0))


def near_axis(lens: Lens, z: float, towards: str, height: float = 1e-4) -> tuple[float, float]:
    """Where an exact ray from the axial point z crosses the axis again, and 1 / magnification of the slope.

    In the y-z plane, whose first-order data is that of an anamorphic lens where no meridian is named.
    """
    sense = 1.0 if towards == "film" else -1.0
    start = Rays(*(torch.tensor([v], dtype=torch.float64) for v in (0, 0, z, 0, height, sense)))
    length = math.hypot(height, 1.0)
    start = start._replace(dy=start.dy / length, dz=start.dz / length)
    out = trace(lens, start, towards=towards).rays  # type: ignore[arg-type]
    return float(out.z - out.y * out.dz / out.dy), float(out.dy / out.dz) / (height * sense)


@pytest.mark.parametrize("name", SOME)
@pytest.mark.parametrize("focus_m", [INF, 30.0, 3.0])
def test_exact_rays_near_the_axis_meet_in_focus(name: str, focus_m: float) -> None:
    """The object lies `focus_m` from the film, and the magnification is that of Newton's equation."""
    lens = set_lens(tabled(name), focus_m=focus_m)
    f = first_order(lens).efl_mm
    # The angle at the film is small enough that spherical aberration leaves no trace: that of an r^3 only falls with
    # the height, not with its square.
    cubic = any(power == 3 for s in lens.surfaces for power, _ in s.figure.asphere)
    found, slope = near_axis(lens, lens.film_z_mm, "scene", height=1e-9 if cubic else 1e-5)
    if math.isinf(focus_m):
        assert abs(found) > 1e5 * f
        return
    assert lens.film_z_mm - found == pytest.approx(1000 * focus_m, rel=1e-5)
    extension = lens.film_z_mm - first_order(lens).rear_focal_z_mm
    assert slope == pytest.approx(-extension / f, rel=1e-5)  # angular magnification is one over the lateral one


@pytest.mark.parametrize("name", SOME)
def test_pupils_are_conjugates_of_the_stop(name: str) -> None:
    """Exact rays near the axis through the stop's centre come from the entrance pupil and go to the exit pupil."""
    lens = tabled(name)
    data = first_order(lens)
    for towards, z in (("film", data.entrance_pupil_z_mm), ("scene", data.exit_pupil_z_mm)):
        sense = 1.0 if towards == "film" else -1.0
        back, slope = -sense * 500, 1e-5  # start outside the lens, on a line through the pupil's centre
        length = math.hypot(slope, 1.0)
        row = (0.0, back * slope * sense, z + back, 0.0, slope / length, sense / length)
        start = Rays(*(torch.tensor([v], dtype=torch.float64) for v in row))
        out = trace(lens, start, towards=towards, record=[lens.stop_index])  # type: ignore[arg-type]
        assert abs(float(out.crossings[lens.stop_index].y)) < 1e-8


@pytest.mark.parametrize("name", SOME)
def test_f_number_sets_the_entrance_pupil(name: str) -> None:
    lens = tabled(name)
    for n in (2.0, 8.0, 22.0):
        stopped = set_lens(lens, f_number=n, focus_m=5.0)
        data = first_order(stopped)
        assert data.f_number == pytest.approx(n, rel=1e-12)
        assert data.entrance_pupil_diameter_mm == pytest.approx(abs(data.efl_mm) / n, rel=1e-12)
        assert stopped.stop_radius_mm == pytest.approx(stop_radius_mm(lens, n), rel=1e-12)
        # Focusing leaves the stop as it is, and the hash of the glass too.
        assert set_lens(stopped, focus_m=3.0).stop_radius_mm == stopped.stop_radius_mm
        assert stopped.sha256 == lens.sha256


@pytest.mark.parametrize("name", SOME)
def test_scaling_scales_every_length(name: str) -> None:
    lens = set_lens(tabled(name), focus_m=8.0)
    small, data = lens.scaled(0.37), first_order(lens)
    for name, value in vars(first_order(small)).items():
        expected = getattr(data, name) * (1.0 if name == "f_number" else 0.37)
        assert value == pytest.approx(expected, rel=1e-12), name
    assert small.film_z_mm == pytest.approx(0.37 * (lens.film_z_mm or 0.0))
    assert film_z_mm(small, 8.0 * 0.37) == pytest.approx(small.film_z_mm, rel=1e-9)
    assert small.sha256 != lens.sha256 and small.half_field_deg == lens.half_field_deg


def test_nearer_than_four_focal_lengths_is_an_error_that_names_the_limit() -> None:
    lens = thick(50, -50, 5, 1.5)
    data = first_order(lens)
    nearest = (4 * data.efl_mm + data.rear_principal_z_mm - data.front_principal_z_mm) / 1000
    symmetric = set_lens(lens, focus_m=nearest * (1 + 1e-12))
    assert symmetric.film_z_mm == pytest.approx(data.rear_principal_z_mm + 2 * data.efl_mm, rel=1e-4)  # 1:1
    with pytest.raises(InputError, match=r"focus_m.*at least 0\.205 m"):
        set_lens(lens, focus_m=nearest * 0.999)


def test_far_objects_move_the_film_by_the_square_of_the_focal_length_over_their_distance() -> None:
    """To the last digits, where the difference of two nearly equal numbers would lose them."""
    lens = thick(50, -50, 5, 1.5)
    efl = first_order(lens).efl_mm
    at_infinity = film_z_mm(lens, math.inf)
    for focus_m in (1e4, 1e6):
        assert film_z_mm(lens, focus_m) - at_infinity == pytest.approx(efl**2 / (1000 * focus_m), rel=2e-5)


def test_a_diverging_lens_has_no_film_for_an_object_between_its_principal_planes() -> None:
    with pytest.raises(InputError, match="focus_m"):
        set_lens(thick(-50, 50, 60, 1.5), focus_m=1e-3)


def test_a_diverging_lens_cannot_be_scaled_to_a_positive_focal_length() -> None:
    with pytest.raises(InputError, match="focal_length_mm"):
        set_lens(thick(-50, 50, 5, 1.5), focal_length_mm=50.0)


def test_wavelength_shifts_the_focus() -> None:
    """A positive singlet focuses blue nearer, by f / V between the F and C lines."""
    rows = tuple(replace(s, V_d=64.17 if s.n_d > 1 else None) for s in thick(50, -50, 1e-6, 1.5168).surfaces)
    lens = Lens("singlet", "", rows, 4.0)
    blue, red = (first_order(lens, w).efl_mm for w in (486.1327, 656.2725))
    assert red - blue == pytest.approx(first_order(lens).efl_mm / 64.17, rel=0.01)


@pytest.mark.parametrize("focal_mm", [1e200, 1e308])
def test_wild_numbers_of_a_card_place_a_film_without_warnings(focal_mm: float) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        film = paraxial.film_z_of_planes_mm(np.float64(focal_mm), 0.0, 0.0, np.float64(1e306))
    assert not math.isfinite(film) or film >= focal_mm
