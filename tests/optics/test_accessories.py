"""Filters, hoods and the pinhole of finite size, against geometry."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from shipped import tabled

from neurolens.base import status as st
from neurolens.base.errors import InputError
from neurolens.cameras.exact import ExactCamera
from neurolens.optics.accessories import pinhole, with_filter, with_hood
from neurolens.optics.lensfile import read_lens
from neurolens.optics.lenswriter import write_lens
from neurolens.optics.paraxial import first_order
from neurolens.optics.prescription import Configuration, Lens
from neurolens.optics.trace import Rays, trace

PLATE_MM, N_D = 3.0, 1.5168


@pytest.fixture(scope="module")
def lens() -> Lens:
    return tabled("laikin_double_gauss_50").at()


def axial_focus_mm(lens: Lens, object_z_mm: float = -math.inf, height: float = 1e-3) -> float:
    """z where a traced ray beside the axis meets it behind the lens."""
    start = -1.0
    slope = 0.0 if math.isinf(object_z_mm) else height / (start - object_z_mm)
    length = math.hypot(1, slope)
    ray = Rays(*(torch.tensor([v], dtype=torch.float64) for v in (height, 0, start, slope / length, 0, 1 / length)))
    out = trace(lens, ray, towards="film")
    assert int(out.status[0]) == 0
    return float(out.rays.z - out.rays.x * out.rays.dz / out.rays.dx)


def test_a_rear_filter_moves_the_image_and_the_film_back(lens: Lens) -> None:
    filtered = with_filter(lens, PLATE_MM, n_d=N_D, gap_mm=2.0, rear=True)
    shift = PLATE_MM * (1 - 1 / N_D)
    assert axial_focus_mm(filtered) - axial_focus_mm(lens) == pytest.approx(shift, abs=1e-6)
    assert filtered.film_z_mm - lens.film_z_mm == pytest.approx(shift, rel=1e-9)
    assert filtered.at().film_z_mm == pytest.approx(filtered.film_z_mm, abs=1e-9)
    assert first_order(filtered).efl_mm == pytest.approx(first_order(lens).efl_mm, rel=1e-12)


def test_a_front_filter_changes_nothing_at_infinity_and_brings_near_objects_nearer(lens: Lens) -> None:
    filtered = with_filter(lens, PLATE_MM, n_d=N_D, gap_mm=2.0)
    moved = PLATE_MM + 2.0
    assert filtered.film_z_mm == pytest.approx((lens.film_z_mm or 0) + moved, abs=1e-12)
    assert axial_focus_mm(filtered) - moved == pytest.approx(axial_focus_mm(lens), abs=1e-9)
    # The same object, 800 mm before the front vertex of the bare lens, seems t (1 - 1/n) nearer through the plate.
    seen = axial_focus_mm(filtered, -800 + moved) - moved
    assert seen == pytest.approx(axial_focus_mm(lens, -800 + PLATE_MM * (1 - 1 / N_D)), abs=1e-7)


def test_a_grey_filter_absorbs_by_beer_and_lambert(lens: Lens) -> None:
    ray = Rays(*(torch.tensor([v], dtype=torch.float64) for v in (0.0, 0.0, -1.0, 0.0, 0.0, 1.0)))
    clear, grey = (
        trace(with_filter(lens, 2.0, absorption_per_mm=a), ray, towards="film", transmittance=True).transmittance
        for a in (0.0, math.log(8) / 2)
    )
    assert float(grey / clear) == pytest.approx(1 / 8, rel=1e-12)


def test_filters_renumber_states(tmp_path: Path) -> None:
    zoom = tabled("ogawa_zoom_70_200")
    for filtered in (with_filter(zoom, 2.0), with_filter(zoom, 2.0, rear=True), with_hood(zoom, 10.0, 90.0)):
        for state in ("72mm", "135mm", 100.0):
            efl = first_order(zoom.at(zoom=state)).efl_mm
            assert first_order(filtered.at(zoom=state)).efl_mm == pytest.approx(efl, rel=1e-9)
        write_lens(filtered, tmp_path / "filtered.toml")
        assert replace(read_lens(tmp_path / "filtered.toml"), path=filtered.path) == filtered


@pytest.mark.parametrize("rear", [True, False])
def test_a_lens_with_a_filter_focuses_inside_as_before(rear: bool) -> None:
    for name in ("sony_sonnar_55", "tajima_retrofocus_24"):
        bare = tabled(name).at()
        filtered = with_filter(bare, 0.5, n_d=N_D, gap_mm=0.1 if rear else 3.0, rear=rear)
        near = filtered.at(focus_m=2.0, focus="internal")
        assert axial_focus_mm(near, near.film_z_mm - 2000, 1e-4) == pytest.approx(near.film_z_mm, abs=1e-5)


def test_default_filters_do_not_vignette(lens: Lens) -> None:
    wide = replace(lens, half_field_deg=23.5)
    angle = math.radians(23.5)
    x = torch.linspace(-30, 30, 4001, dtype=torch.float64)
    zero = torch.zeros_like(x)

    def passing(lens: Lens, front_mm: float) -> int:
        """Rays that pass, of a sheaf that crosses the plane of the bare front vertex at x."""
        shift = (front_mm + 1.0) * math.tan(angle)
        rays = Rays(x + shift, zero, zero - 1.0, zero - math.sin(angle), zero, zero + math.cos(angle))
        return int((trace(lens, rays, towards="film").status == 0).sum())

    bare = passing(wide, 0.0)
    thin = with_filter(wide, 1e-6, gap_mm=5.0)
    assert bare > 100
    assert passing(thin, 5.0) == bare
    small = with_filter(wide, 1e-6, gap_mm=5.0, diameter_mm=15.0)
    assert passing(small, 5.0) < bare


def test_a_hood_cuts_the_field_at_its_geometric_angle() -> None:
    """A hole 60 mm behind a ring of radius 20 sees 18.4 degrees, the hole's own radius more or less."""
    hooded = with_hood(pinhole(40.0, 0.05), 60.0, 40.0)
    angle = torch.linspace(0.0, 0.6, 6001, dtype=torch.float64)
    x, zero = 100.0 * torch.tan(angle), torch.zeros_like(angle)
    rays = Rays(x, zero, zero - 40.0, -torch.sin(angle), zero, torch.cos(angle))
    out = trace(hooded, rays, towards="film")
    limit = math.atan(20.0 / 60.0)
    assert float(angle[out.status == 0].max()) == pytest.approx(limit, abs=2e-4)
    assert set(out.status[angle > limit + 1e-3].tolist()) == {st.blocked(0, st.RIM)}


def test_accessories_that_cannot_be(lens: Lens) -> None:
    for options, expected in (
        ({"thickness_mm": 0.0}, "thickness_mm"),
        ({"thickness_mm": math.nan}, "thickness_mm"),
        ({"n_d": 0.5}, "filter, n_d: got 0.5, expected a refractive index"),
        ({"gap_mm": -1.0}, "filter, gap_mm: got -1.0"),
        ({"absorption_per_mm": math.inf}, "filter, absorption_per_mm: got inf"),
        ({"V_d": 0.0}, "filter, V_d: got 0.0"),
        ({"thickness_mm": "2"}, "thickness_mm: got '2'"),
        ({"n_d": "1.5"}, "filter, n_d: got '1.5'"),
        ({"gap_mm": None}, "filter, gap_mm: got None"),
        ({"diameter_mm": "wide"}, "diameter_mm: got 'wide'"),
        ({"diameter_mm": -3.0}, "diameter_mm"),
        ({"gap_mm": 80.0, "rear": True}, "room"),
    ):
        with pytest.raises(InputError, match=expected):
            with_filter(lens, **options)
    with pytest.raises(InputError, match="length_mm"):
        with_hood(lens, 0.0, 50.0)
    with pytest.raises(InputError, match="diameter_mm: got 'fifty'"):
        with_hood(lens, 10.0, "fifty")  # type: ignore[arg-type]
    near = Configuration("near", None, ((0, 5.817),), object_distance_mm=4.0)
    with pytest.raises(InputError, match="object_distance_mm"):
        with_hood(replace(lens, configurations=(near,)), 10.0, 90.0)


# --- The lens without glass


def test_a_pinhole_maps_tangents_and_knows_no_focus(tmp_path: Path) -> None:
    hole = pinhole(50.0, 0.25, image_radius_mm=20.0)
    data = first_order(hole)
    assert (data.efl_mm, data.f_number, data.exit_pupil_z_mm, data.entrance_pupil_z_mm) == (50.0, 100.0, 0.0, 0.0)
    for focus_m in (math.inf, 1.0, 0.01):
        for focus in ("paraxial", "best"):
            state = hole.at(focus_m=focus_m, focus=focus)  # type: ignore[arg-type]
            assert state.film_z_mm == 50.0
    assert hole.at(f_number=200).stop_radius_mm == 0.125
    assert first_order(hole.at(focal_length_mm=25)).efl_mm == pytest.approx(25, rel=1e-12)
    assert first_order(hole.at(field_deg=60)).efl_mm == pytest.approx(20 / math.tan(math.radians(30)), rel=1e-9)
    with pytest.raises(InputError, match="no focus states"):
        hole.at(focus="internal", focus_m=2.0)
    write_lens(replace(hole, source="a tin"), tmp_path / "hole.toml")
    assert first_order(read_lens(tmp_path / "hole.toml")).efl_mm == 50.0


def test_plates_before_and_behind_a_pinhole_shorten_its_distances() -> None:
    """The film, seen through a plate, lies t (1 - 1/n) nearer to the hole; the plate pushes it as much away."""
    hole = pinhole(50.0, 0.25, image_radius_mm=20.0)
    rear = with_filter(hole, PLATE_MM, n_d=N_D, gap_mm=1.0, rear=True)
    assert first_order(rear).efl_mm == pytest.approx(50.0, rel=1e-12)
    assert rear.at().film_z_mm == pytest.approx(50.0 + PLATE_MM * (1 - 1 / N_D), rel=1e-12)
    slope = 1e-4
    ray = Rays(*(torch.tensor([v], dtype=torch.float64) for v in (-slope, 0.0, -1.0, slope, 0.0, 1.0)))
    out = trace(rear, ray, towards="film").rays
    height = float(out.x + (rear.at().film_z_mm - out.z) * out.dx / out.dz)  # type: ignore[operator]
    assert height == pytest.approx(50.0 * slope, rel=1e-6)


@pytest.mark.parametrize("point", [(0.0, 0.0), (12.0, 5.0)])
def test_the_exact_camera_takes_a_pinhole(point: tuple[float, float]) -> None:
    """Its falloff is cos^4, and its rays leave from the hole, opposite to the film point."""
    hole = pinhole(30.0, 0.2, image_radius_mm=21.6)
    camera = ExactCamera(hole, film_mm=(36.0, 24.0), focus_m=math.inf, dtype="float64")
    rng = np.random.default_rng(0)
    film = np.repeat(np.array([point], np.float32).T, 20_000, axis=1)
    out = camera.sample(film, rng.random((2, 20_000), np.float32), np.full(20_000, 550, np.float32))
    cos2 = 1 / (1 + (point[0] ** 2 + point[1] ** 2) / 30**2)
    assert out.weight.mean() == pytest.approx(cos2**2, rel=0.01)
    assert (out.status == 0).mean() > 0.97
    passed = out.status == 0
    assert np.hypot(*out.origin_m[:2, passed]).max() <= 0.2001e-3
    slope = out.direction[:2, passed] / out.direction[2, passed]
    assert slope.mean(axis=1) == pytest.approx([point[0] / 30, point[1] / 30], abs=1e-3)


def test_shut_and_impossible_pinholes() -> None:
    for arguments in ((0.0, 1.0), (50.0, 0.0), (math.inf, 1.0), (50.0, math.nan)):
        with pytest.raises(InputError, match="pinhole"):
            pinhole(*arguments)
    assert first_order(pinhole(50, 1).with_stop_radius(0.0)).f_number == math.inf
