"""What a photographer changes: zoom, size, f-number, focus; against traced rays, sources and closed forms."""

import math
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from shipped import NAMES, tabled, whole

from neurolens.base.errors import InputError
from neurolens.optics.analysis.breathing import breathing, field_change
from neurolens.optics.lens.glass import LINE_D_NM
from neurolens.optics.lens.paraxial import film_z_mm, first_order
from neurolens.optics.lens.prescription import Coating, Configuration, Lens, Surface
from neurolens.optics.lens.shot import Shot
from neurolens.optics.readers.lensfile import read_lens, write_lens
from neurolens.optics.setting.focusing import (
    axial_rays,
    best_focus_z_mm,
    film_range_mm,
    focus_states,
    focused_inside,
    infinity_states,
    nearest_focus_m,
)
from neurolens.optics.setting.rims import check_clearance
from neurolens.optics.setting.states import focus_mode_of, in_state, set_lens
from neurolens.optics.trace.rays import Rays, trace

ZOOMS = ("ogawa_zoom_70_200", "nikon_zoom_70_200", "nikon_zoom_14_24", "nikon_zoom_80_200", "itoh_zoom_100_146")
INTERNAL = ("nikon_zoom_70_200", "nikon_zoom_14_24", "sony_sonnar_55", "tajima_retrofocus_24")


def gaps(lens: Lens) -> list[float]:
    """All thicknesses but the last, which `at` leaves to the film."""
    return [float(s.thickness_mm) for s in lens.surfaces[:-1]]


def back_mm(lens: Lens) -> float:
    return lens.film_z_mm - float(lens.vertices_mm[-2])


def singlet(radius_mm: float = 100.0, stop_mm: float = 10.0) -> Lens:
    rows = (
        Surface(math.inf, 0.5, stop_mm, stop=True),
        Surface(radius_mm, 4.0, 60.0, 1.5168),
        Surface(-radius_mm, 97.0, 60.0),
    )
    return Lens("singlet", "", rows, 10.0, path="singlet.toml")


def magnification(lens: Lens, object_z_mm: float) -> float:
    """Of a traced ray through the centre of the stop, from a point just beside the axis."""
    height, pupil = 1e-4, first_order(lens)
    dx, dz = -height, pupil.entrance_pupil_z_mm - object_z_mm
    length = math.hypot(dx, dz)
    start = torch.tensor([(-20.0 - object_z_mm) / dz], dtype=torch.float64)
    x, z = height + dx * start, object_z_mm + dz * start
    ray = Rays(x, 0 * x, z, 0 * x + dx / length, 0 * x, 0 * x + dz / length)
    out = trace(lens, ray, towards="film").rays
    return float(out.x + (lens.film_z_mm - out.z) * out.dx / out.dz) / height


# --- Zoom


@pytest.mark.parametrize("name", ZOOMS)
def test_at_the_stated_focal_lengths_a_zoom_is_in_the_stated_states(name: str) -> None:
    lens = tabled(name)
    for state in infinity_states(lens):
        named = set_lens(lens, zoom=state.name)
        for asked in (state.efl_mm, first_order(named).efl_mm, f"{state.efl_mm}"):
            zoomed = set_lens(lens, zoom=asked)
            assert gaps(zoomed) == gaps(named)
            assert zoomed.film_z_mm == named.film_z_mm
            assert zoomed.stop_radius_mm == named.stop_radius_mm
            assert not zoomed.derived


@pytest.mark.parametrize("name", ZOOMS)
def test_between_the_states_a_zoom_has_the_focal_length_asked_for_and_no_collisions(name: str) -> None:
    lens = tabled(name)
    known = sorted(c.efl_mm for c in infinity_states(lens) if c.efl_mm)
    low, high = known[0] * 1.002, known[-1] * 0.998
    for share in (0.0, 0.15, 0.4, 0.7, 1.0):
        asked = low * (high / low) ** share
        zoomed = set_lens(lens, zoom=asked)
        assert first_order(zoomed).efl_mm == pytest.approx(asked, rel=1e-10)
        assert zoomed.film_z_mm == pytest.approx(first_order(zoomed).rear_focal_z_mm, abs=1e-9)
        check_clearance(zoomed.surfaces, name)
        assert "between" in zoomed.derived


def test_the_film_of_a_zoom_stays_where_the_states_have_it() -> None:
    """The rear group of Ogawa's zoom stands still, and so does the front one: total length and back focus hold."""
    lens = tabled("ogawa_zoom_70_200")
    states = [set_lens(lens, zoom=c.name) for c in lens.configurations]
    for asked in (80, 100, 120, 150, 180):
        zoomed = set_lens(lens, zoom=asked)
        assert min(map(back_mm, states)) - 1e-6 <= back_mm(zoomed) <= max(map(back_mm, states)) + 1e-6
        assert min(s.film_z_mm or 0 for s in states) - 1e-6 <= (zoomed.film_z_mm or 0) + 0.0
        assert (zoomed.film_z_mm or 0) <= max(s.film_z_mm or 0 for s in states) + 1e-6


def test_gaps_move_smoothly_through_a_state() -> None:
    lens = tabled("nikon_zoom_14_24")
    middle = set_lens(lens, zoom="18mm")
    efl = first_order(middle).efl_mm
    for sign in (-1, 1):
        beside = set_lens(lens, zoom=efl * (1 + sign * 1e-5))
        assert gaps(beside) == pytest.approx(gaps(middle), abs=1e-3)
        assert beside.stop_radius_mm == pytest.approx(middle.stop_radius_mm, abs=1e-3)


@pytest.mark.parametrize(
    ("name", "left_out", "within_mm"),
    [("nikon_zoom_14_24", "18mm", 0.25), ("nikon_zoom_14_24", "20mm", 0.03), ("ogawa_zoom_70_200", "135mm", 2.2)],
)
def test_a_state_is_predicted_from_the_others(name: str, left_out: str, within_mm: float) -> None:
    """Ogawa's three moving groups leave a freedom that two states say little of: millimetres, but focal length and
    image hold all the same."""
    lens = tabled(name)
    truth = set_lens(lens, zoom=left_out)
    fewer = replace(lens, configurations=tuple(c for c in lens.configurations if c.name != left_out))
    predicted = set_lens(fewer, zoom=first_order(truth).efl_mm)
    assert gaps(predicted) == pytest.approx(gaps(truth), abs=within_mm)


@pytest.mark.parametrize(
    ("name", "zoom", "expected"),
    [
        ("ogawa_zoom_70_200", 60.0, "from 72"),
        ("ogawa_zoom_70_200", 300.0, "to 194"),
        ("ogawa_zoom_70_200", math.nan, "focal length"),
        ("ogawa_zoom_70_200", "wide", "72mm, 135mm, 194mm"),
        ("laikin_double_gauss_50", 50.0, "two states"),
        ("laikin_double_gauss_50", "wide", "none in this file"),
    ],
)
def test_zoom_positions_that_are_none(name: str, zoom: str | float, expected: str) -> None:
    with pytest.raises(InputError, match=expected):
        set_lens(tabled(name), zoom=zoom)


def test_a_derived_position_says_so_in_its_file(tmp_path: Path) -> None:
    zoomed = set_lens(tabled("ogawa_zoom_70_200"), zoom=100)
    write_lens(zoomed, tmp_path / "zoomed.toml")
    assert zoomed.derived in read_lens(tmp_path / "zoomed.toml").notes


# --- Size


def test_size_by_focal_length_and_by_field() -> None:
    lens = tabled("laikin_double_gauss_50")
    assert first_order(set_lens(lens, focal_length_mm=35)).efl_mm == pytest.approx(35, rel=1e-12)
    small = set_lens(lens, field_deg=40)
    assert small.image_radius_mm == lens.image_radius_mm == 21.6
    # 21.6 = f tan(20 degrees) but for 3% of distortion, and twice the field is about half the focal length.
    assert first_order(small).efl_mm == pytest.approx(21.6 / math.tan(math.radians(20)), rel=0.05)


def test_the_edge_of_the_image_circle_sees_the_field_asked_for() -> None:
    """A ray traced from the scene at half the field, through the stop's centre, lands on the image circle's edge."""
    fisheye = set_lens(tabled("muller_fisheye_100"))
    lens = set_lens(replace(fisheye, image_radius_mm=21.6), field_deg=140)
    x = torch.linspace(-20, 60, 80001, dtype=torch.float64)
    angle = torch.tensor(math.radians(70), dtype=torch.float64)
    zero = torch.zeros_like(x)
    rays = Rays(x, zero, zero - 2, zero - torch.sin(angle), zero, zero + torch.cos(angle))
    out = trace(lens, rays, towards="film", record=[lens.stop_index])
    near_centre = out.crossings[lens.stop_index].x.abs() + 1e9 * (out.status != 0)
    k = int(near_centre.argmin())
    assert float(near_centre[k]) < 0.01
    r = out.rays
    height = float(r.x[k] + (lens.film_z_mm - r.z[k]) * r.dx[k] / r.dz[k])
    assert abs(height) == pytest.approx(21.6, rel=1e-3)


@pytest.mark.parametrize(
    ("state", "expected"),
    [
        ({"field_deg": 120.0}, "field_deg"),
        ({"field_deg": 400.0}, "field_deg"),
        ({"field_deg": 40.0, "focal_length_mm": 50.0}, "field_deg"),
        *(
            ({key: v}, key)
            for key in ("focal_length_mm", "field_deg", "f_number", "focus_m")
            for v in (0.0, -1.0, math.nan)
        ),
        ({"f_number": math.inf}, "f_number"),
        ({"focal_length_mm": math.inf}, "focal_length_mm"),
        ({"focus_mode": "manual"}, "focus_mode"),
        ({"focus_mode": "internal", "focus_m": 2.0}, "no focus states"),
    ],
)
def test_states_that_a_double_gauss_has_not(state: dict, expected: str) -> None:
    with pytest.raises(InputError, match=expected):
        set_lens(tabled("laikin_double_gauss_50"), **state)


# --- Stop


def test_the_stop_of_a_state_is_the_source_s_and_f_numbers_hold_at_every_zoom() -> None:
    lens = tabled("nikon_zoom_14_24")
    for state in infinity_states(lens):
        assert set_lens(lens, zoom=state.name).stop_radius_mm == state.stop_diameter_mm / 2
        assert first_order(set_lens(lens, zoom=state.name)).f_number == pytest.approx(2.91, rel=0.03)
        assert first_order(set_lens(lens, zoom=state.name, f_number=8)).f_number == pytest.approx(8, rel=1e-12)


def test_a_stop_wider_than_the_rims_is_allowed_and_they_vignette() -> None:
    lens = tabled("laikin_double_gauss_50")
    wide = set_lens(lens, f_number=0.9)
    assert first_order(wide).f_number == pytest.approx(0.9, rel=1e-12)
    rays = Rays(*map(torch.from_numpy, axial_rays(wide, -math.inf)))
    passed = trace(wide, rays, towards="film").status == 0
    assert 0 < float(passed.double().mean()) < 0.5


# --- Focus by moving the film


def test_pure_third_order_aberration_focuses_best_two_thirds_of_the_way() -> None:
    """d/db of the mean of (a r^3 + b r)^2 over the disc: b = -2a/3, with the marginal focus at b = -a.

    At f/10 fifth order is 1% of a singlet's aberration.
    """
    lens = singlet()
    paraxial = set_lens(lens).film_z_mm
    ray = Rays(*(torch.tensor([v], dtype=torch.float64) for v in (5.0, 0.0, -1.0, 0.0, 0.0, 1.0)))
    out = trace(lens, ray, towards="film").rays
    marginal = float(out.z - out.x * out.dz / out.dx)
    best = set_lens(lens, focus_mode="best").film_z_mm
    assert marginal < best < paraxial
    assert (best - paraxial) / (marginal - paraxial) == pytest.approx(2 / 3, abs=0.01)


@pytest.mark.parametrize(
    ("name", "focus_m"),
    [("phone_lens_6", math.inf), ("phone_lens_6", 1.5), ("laikin_double_gauss_50", 1.0),
     ("schneider_anamorphic_31", math.inf), ("cooke_anamorphic_42", math.inf), ("cooke_anamorphic_42", 1.5),
     ("panavision_anamorphic_zoom_21", 1.5)],
)  # fmt: skip
def test_best_focus_is_the_least_spot_of_two_hundred_films(name: str, focus_m: float) -> None:
    """Of other rays: a sunflower of points on a disc wider than the pupils of both meridians; films 1 um apart."""
    lens, count = tabled(name), 8000
    z = best_focus_z_mm(lens, focus_m, (LINE_D_NM, LINE_D_NM))
    data = [first_order(lens, meridian=m) for m in ("y", "x")]
    k = torch.arange(count, dtype=torch.float64) + 0.5
    radius = 0.65 * max(d.entrance_pupil_diameter_mm for d in data) * torch.sqrt(k / count)
    turn = k * math.pi * (3 - math.sqrt(5))
    x, y = radius * torch.cos(turn), radius * torch.sin(turn)
    source = data[0].entrance_pupil_z_mm - z + 1000 * focus_m  # to the entrance pupil
    far = math.isinf(focus_m)
    way = torch.stack([0 * x, 0 * x, 1 + 0 * x] if far else [x / source, y / source, 1 + 0 * x])
    ahead = 60.0 + data[0].entrance_pupil_z_mm
    start = torch.stack([x, y, data[0].entrance_pupil_z_mm + 0 * x]) - ahead * way
    out = trace(lens, Rays(*start, *(way / way.norm(dim=0))), towards="film")
    r = Rays(*(c[out.status == 0] for c in out.rays))
    assert len(r.x) > 2000
    films = z + torch.linspace(-0.1, 0.1, 201, dtype=torch.float64)[:, None] + 3e-4
    x, y = (c + (films - r.z) * d / r.dz for c, d in ((r.x, r.dx), (r.y, r.dy)))
    least = films[int((x * x + y * y).mean(1).argmin()), 0]
    assert float(least) == pytest.approx(z, abs=1e-3)


def test_best_focus_weighs_colours_as_the_eye_does() -> None:
    lens = set_lens(tabled("thorlabs_lb1471_biconvex_50"), f_number=16)
    blue, green, red = (best_focus_z_mm(lens, wavelength_nm=(nm, nm)) for nm in (450.0, 555.0, 650.0))
    assert blue < green < red
    assert best_focus_z_mm(lens) == pytest.approx(green, abs=0.05 * (red - blue))
    assert blue < best_focus_z_mm(lens, wavelength_nm=(400.0, 500.0)) < green
    near, far = (best_focus_z_mm(lens, wavelength_nm=(nm, nm)) for nm in (800.0, 1000.0))
    assert best_focus_z_mm(lens, wavelength_nm=(800.0, 1000.0)) == pytest.approx(
        (near + far) / 2, abs=0.1 * (far - near)
    )


@pytest.mark.parametrize(
    "name",
    [
        "schneider_anamorphic_31",
        "edmund_asphere_30",
        *whole("laikin_double_gauss_50", "nikon_zoom_70_200", "takahashi_retrofocus_100"),
    ],
)
@pytest.mark.parametrize("focus_m", [math.inf, 1.5])
def test_a_film_range_holds_best_focus_at_every_aperture_and_colour(name: str, focus_m: float) -> None:
    lens = tabled(name)
    internal = "nikon" in name
    lens = set_lens(lens, zoom=100.0, focus_m=focus_m, focus_mode="internal") if internal else lens
    low, high = film_range_mm(lens, focus_m, (400.0, 700.0))
    assert low < (lens.film_z_mm if internal else film_z_mm(lens, focus_m)) < high
    found = [
        best_focus_z_mm(lens.with_stop_radius(lens.stop_radius_mm * share), focus_m, light)
        for share in (1.0, 0.7, 0.1)
        for light in ((400.0, 700.0), (400.0, 400.0), (475.0, 475.0), (700.0, 700.0))
    ]
    assert low < min(found) and max(found) < high
    assert lens.anamorphic or high - low < 1.5 * (max(found) - min(found))  # and hardly more


def test_a_shut_stop_has_no_best_focus() -> None:
    with pytest.raises(InputError, match="best"):
        set_lens(tabled("brendel_tessar_100").with_stop_radius(0.0), focus_mode="best")


# --- Focus by moving groups


@pytest.mark.parametrize("name", INTERNAL)
def test_focused_inside_near_rays_from_the_object_meet_on_a_film_that_stands_still(name: str) -> None:
    for zoom in [c.name for c in infinity_states(tabled(name))]:
        infinity = set_lens(tabled(name), zoom=zoom)
        for focus_m in (20.0, 3.0, 1.001 * nearest_focus_m(infinity)):
            lens = focused_inside(infinity, focus_m).with_stop_radius(1e-3)
            start = Rays(*map(torch.from_numpy, axial_rays(lens, lens.film_z_mm - 1000 * focus_m)))
            out = trace(lens, start, towards="film")
            r = out.rays
            miss = torch.hypot(r.x + (lens.film_z_mm - r.z) * r.dx / r.dz, r.y + (lens.film_z_mm - r.z) * r.dy / r.dz)
            assert bool((out.status == 0).any())
            assert float(miss[out.status == 0].max()) < 1e-7
            if name != "tajima_retrofocus_24":  # whose groups all leave the film
                assert lens.film_z_mm == pytest.approx(infinity.film_z_mm, abs=0.02)
                assert back_mm(lens) == pytest.approx(back_mm(infinity), abs=1e-9)


@pytest.mark.parametrize(
    ("name", "state", "stated"),
    [
        ("sony_sonnar_55", "1.7m", -0.03333),
        ("nikon_zoom_70_200", "71mm near", -0.0868),
        ("nikon_zoom_70_200", "135mm near", -0.1583),
        ("nikon_zoom_70_200", "196mm near", -0.2332),
        ("nikon_zoom_14_24", "14mm 1:40", -0.025),
        ("nikon_zoom_14_24", "18mm 1:40", -0.025),
        ("nikon_zoom_14_24", "23mm 1:40", -0.025),
        ("nikon_zoom_14_24", "14mm near", -0.088),
        ("nikon_zoom_14_24", "23mm near", -0.135),
    ],
)
def test_magnifications_of_focus_states_are_those_the_source_states(name: str, state: str, stated: float) -> None:
    lens = set_lens(tabled(name), zoom=state)
    near = next(c for c in lens.configurations if c.name == state)
    assert magnification(lens, -near.object_distance_mm) == pytest.approx(stated, rel=0.006)
    data = first_order(in_state(tabled(name), near))
    paraxial = -data.efl_mm / (near.object_distance_mm + data.front_principal_z_mm - data.efl_mm)
    assert paraxial == pytest.approx(stated, rel=0.02)
    # The path from infinity passes through the state.
    focus_m = max((lens.film_z_mm + near.object_distance_mm) / 1000, nearest_focus_m(lens))
    again = set_lens(lens, focus_m=focus_m, focus_mode="internal")
    assert gaps(again) == pytest.approx(gaps(lens), abs=0.01)


def test_between_zoom_states_focusing_is_interpolated_too() -> None:
    lens = tabled("nikon_zoom_70_200")
    for asked in (90.0, 160.0):
        zoomed = set_lens(lens, zoom=asked)
        near = focused_inside(zoomed, 1.2)
        assert near.film_z_mm == pytest.approx(zoomed.film_z_mm, abs=0.02)
        assert near.derived
        check_clearance(near.surfaces, "near")
        # The front group, which zooms, stands where it stood.
        assert near.surfaces[4].thickness_mm == zoomed.surfaces[4].thickness_mm


def test_focusing_again_starts_from_infinity() -> None:
    lens = set_lens(tabled("sony_sonnar_55"))
    near = set_lens(lens, focus_m=1.8, focus_mode="internal")
    assert gaps(set_lens(near)) == gaps(lens)
    again, once = (set_lens(given, focus_m=4.0, focus_mode="internal") for given in (near, lens))
    assert gaps(again) == pytest.approx(gaps(once), abs=1e-12)
    assert gaps(set_lens(lens, focus_mode="internal")) == gaps(lens)
    by_name = set_lens(lens, zoom="1.7m")
    assert gaps(set_lens(by_name)) == gaps(lens)
    # f-numbers are those of infinity, wherever the groups stand.
    for closed in (set_lens(by_name, f_number=4), set_lens(near, f_number=4, focus_m=2, focus_mode="internal")):
        assert closed.stop_radius_mm == pytest.approx(set_lens(lens, f_number=4).stop_radius_mm, rel=1e-12)


def test_size_and_internal_focus_go_together() -> None:
    lens = tabled("sony_sonnar_55")
    twice = set_lens(lens, focal_length_mm=2 * first_order(lens).efl_mm, focus_m=4.0, focus_mode="internal")
    once = set_lens(lens, focus_m=2.0, focus_mode="internal")
    assert gaps(twice) == pytest.approx([2 * g for g in gaps(once)], rel=1e-9)


def test_nearer_than_the_nearest_is_an_error_that_names_it() -> None:
    lens = set_lens(tabled("sony_sonnar_55"))
    nearest = nearest_focus_m(lens)
    assert nearest == pytest.approx(1.71, abs=0.02)
    set_lens(lens, focus_m=nearest, focus_mode="internal")
    with pytest.raises(InputError, match=r"1\.71"):
        set_lens(lens, focus_m=0.99 * nearest, focus_mode="internal")
    with pytest.raises(InputError) as caught:
        set_lens(lens, focus_m=nearest * (1 - 1e-6), focus_mode="internal")
    limit = float(caught.value.expected.split()[2])
    assert nearest <= limit < 1.001 * nearest  # rounded up: what is printed is allowed
    set_lens(lens, focus_m=limit, focus_mode="internal")


def test_by_default_groups_move_where_the_file_says_how_and_the_lens_as_a_whole_elsewhere() -> None:
    lens = tabled("sony_fe_135mm_f1_8_gm")
    nearest = nearest_focus_m(set_lens(lens))
    for focus_m, mode in ((1.01 * nearest, "internal"), (0.99 * nearest, "best"), (math.inf, "best")):
        shot = Shot.part(focus_m=focus_m)
        asked = set_lens(lens, Shot.part(focus_m=focus_m, focus_mode=mode))  # type: ignore[arg-type]
        assert focus_mode_of(set_lens(lens), shot) == mode
        assert set_lens(lens, shot) == asked
    # "best" keeps its meaning, as the models that ship hold it: the groups stand as at infinity.
    whole = set_lens(lens, Shot.part(focus_m=1.01 * nearest, focus_mode="best"))
    assert gaps(whole) == gaps(set_lens(lens))
    # A near state that is named keeps its groups, and a file without states its film.
    near = next(c.name for c in lens.configurations if c.object_distance_mm)
    assert focus_mode_of(set_lens(lens, zoom=near), Shot.part(zoom=near, focus_m=2.0)) == "best"
    assert focus_mode_of(tabled("laikin_double_gauss_50"), Shot.part(focus_m=2.0)) == "best"


def test_groups_of_a_lens_that_diverges_are_refused() -> None:
    """As a damaged file has it: the way between focus states goes by the logarithm of the focal length."""
    rows = Surface(-50.0, 4.0, 20.0, 1.5), Surface(math.inf, 10.0, 20.0, stop=True)
    near = Configuration("near", None, ((1, 12.0),), object_distance_mm=900.0)
    lens = Lens("diverging", "a test", rows, 4.0, configurations=(near,))
    with pytest.raises(InputError, match="focal length: got -.*above 0 where groups move"):
        set_lens(lens, Shot.part(focus_m=2.0))


# --- Breathing


def test_a_thin_lens_breathes_by_its_extension() -> None:
    """Stop at the lens: the picture grows as the film moves away, by s'/f."""
    rows = (Surface(math.inf, 0.0, 5.0, stop=True), Surface(100.0, 1e-6, 60.0, 1.5), Surface(-100.0, 100.0, 60.0))
    lens = Lens("thin", "", rows, 20.0, image_radius_mm=20.0)
    found = breathing(lens, [math.inf, 1.0])
    f = first_order(lens).efl_mm
    image = (1000 - math.sqrt(1000 * (1000 - 4 * f))) / 2
    assert found[0].magnification == 0
    assert found[0].field_deg == pytest.approx(2 * math.degrees(math.atan(20 / f)), rel=1e-6)
    assert found[1].magnification == pytest.approx(-image / (1000 - image), rel=1e-5)
    assert field_change(found) == pytest.approx(image / f - 1, rel=1e-4)
    assert found[1].working_f_number == pytest.approx(image / 5.0, rel=1e-5)


def test_breathing_of_groups_that_move_inside_is_traced_magnification() -> None:
    lens = set_lens(tabled("nikon_zoom_70_200"), zoom="196mm")
    near = breathing(lens, [1.2], "internal")[0]
    state = focused_inside(lens, 1.2)
    assert near.magnification == pytest.approx(magnification(state, state.film_z_mm - 1200), rel=1e-6)
    film = breathing(lens, [math.inf, 1.2])
    inside = breathing(lens, [math.inf, 1.2], "internal")
    assert inside[1].efl_mm < inside[0].efl_mm == pytest.approx(film[1].efl_mm)
    assert field_change(inside) < field_change(film)
    with pytest.raises(InputError, match="focus_m"):
        breathing(lens, [])


def test_every_shipped_lens_with_states_reaches_all_of_them() -> None:
    for lens in map(tabled, NAMES):
        for state in lens.configurations:
            assert set_lens(lens, zoom=state.name).film_z_mm is not None
        for state in focus_states(lens):
            assert nearest_focus_m(set_lens(lens, zoom=state.name)) > 0


def test_a_named_state_does_not_depend_on_the_way_to_it() -> None:
    for name in ("nikon_zoom_14_24", "nikon_zoom_70_200", "ogawa_zoom_70_200", "itoh_zoom_100_146"):
        table = tabled(name)
        for state in table.configurations:
            for other in table.configurations:
                direct, round_about = (
                    set_lens(table, zoom=state.name),
                    set_lens(set_lens(table, zoom=other.name), zoom=state.name),
                )
                assert direct.half_field_deg == round_about.half_field_deg, (name, other.name, state.name)
                assert direct.f_number == round_about.f_number, (name, other.name, state.name)
                assert direct.vertices_mm == pytest.approx(round_about.vertices_mm, abs=1e-12)


def test_closing_the_stop_leaves_the_focus() -> None:
    lens = set_lens(tabled("laikin_double_gauss_50"), focus_m=1.0)
    closed = set_lens(lens, f_number=8)
    assert closed.film_z_mm == lens.film_z_mm and first_order(closed).f_number == pytest.approx(8)
    assert closed == set_lens(tabled("laikin_double_gauss_50"), focus_m=1.0, f_number=8)
    zoom = set_lens(tabled("nikon_zoom_70_200"), zoom="135mm", focus_m=2.0, focus_mode="internal")
    assert set_lens(zoom, f_number=8).vertices_mm == zoom.vertices_mm


def test_a_shut_stop_opens_again() -> None:
    shut = tabled("laikin_double_gauss_50").with_stop_radius(0.0)
    assert first_order(set_lens(shut, f_number=4)).f_number == pytest.approx(4)


@pytest.mark.parametrize("factor", [0.0, -1.0, math.nan, math.inf])
def test_sizes_that_are_none(factor: float) -> None:
    with pytest.raises(InputError, match="factor"):
        tabled("laikin_double_gauss_50").scaled(factor)


def test_equal_lenses_have_one_hash() -> None:
    lens = tabled("laikin_double_gauss_50")
    other = [
        replace(s, diameter_mm=int(s.diameter_mm) if s.diameter_mm == int(s.diameter_mm) else s.diameter_mm)
        for s in lens.surfaces
    ]
    other[lens.stop_index] = replace(other[lens.stop_index], radius_mm=-math.inf)
    assert replace(lens, surfaces=tuple(other)).sha256 == lens.sha256


def test_gradients_of_coatings_and_absorption() -> None:
    """Layers and absorption may be learnt too."""
    nm, grey = (torch.tensor(v, dtype=torch.float64, requires_grad=True) for v in (90.0, 0.01))
    film = Coating("c", ((1.38, nm),))  # type: ignore[arg-type]
    front = Surface(40.0, 5.0, 20.0, 1.6, coating=film, absorption_per_mm=grey)  # type: ignore[arg-type]
    lens = Lens("c", "", (front, Surface(math.inf, 30.0, 20.0, stop=True)), 2.0)
    y = torch.linspace(-5, 5, 5, dtype=torch.float64)
    out = trace(lens, Rays(0 * y, y, 0 * y - 5, 0 * y, 0 * y, 0 * y + 1), 550.0, towards="film", transmittance=True)
    found = torch.autograd.grad(out.transmittance.sum(), (nm, grey))
    assert float(found[0]) != 0 and float(found[1]) == pytest.approx(-float((out.transmittance * 5.0).sum()), rel=0.1)
