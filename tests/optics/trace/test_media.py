"""Lenses whose object or film lies in another medium than air, and lenses for other than visible light."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from neurolens.cameras.exact import search_key
from neurolens.graph.interpret import evaluate
from neurolens.optics.analysis.breathing import breathing
from neurolens.optics.lens.glass import LINE_D_NM, index_of
from neurolens.optics.lens.paraxial import chief_reach_mm, film_z_mm, first_order, image_z_mm
from neurolens.optics.lens.prescription import Lens, Medium, Surface
from neurolens.optics.readers.lensfile import read_lens, write_lens
from neurolens.optics.setting.focusing import axial_rays
from neurolens.optics.setting.states import set_lens
from neurolens.optics.trace.rays import trace
from neurolens.optics.trace.surfaces import Rays
from neurolens.optics.trace.tracegraph import exact_graph

WATER = Medium(n_d=1.33306, V_d=54.0, material="water")
INF = math.inf


def doublet(medium: Medium = WATER) -> Lens:
    """The cemented doublet of ../shared/data/cases/06_object_in_water.zmx."""
    rows = (
        Surface(1 / 0.016, 4.0, 14.0, glass="N-BK7", n_d=1.5168, V_d=64.17, stop=True),
        Surface(-1 / 0.022, 2.0, 14.0, glass="F2", n_d=1.62004, V_d=36.37),
        Surface(-1 / 0.0075, 98.5, 14.0),
    )
    return Lens("doublet", "closed form", rows, 8.0, object_medium=medium)


def one_surface(front: float = 1.333, behind: float = 1.7, radius: float = 20.0) -> Lens:
    """One refracting surface between two media, which is its own stop; the film lies in the second medium."""
    rows = (Surface(radius, 100.0, 4.0, n_d=behind, stop=True),)
    return Lens("eye", "closed form", rows, 10.0, object_medium=Medium(n_d=front))


def test_a_doublet_under_water_has_the_figures_of_an_independent_program() -> None:
    """The figures are those of ray-optics 0.9.8 for this file; in air the focal length is 94.686 mm."""
    data = first_order(doublet(), 587.6)
    assert data.efl_mm == pytest.approx(188.80, abs=0.005)
    assert data.back_focus_mm == pytest.approx(187.18, abs=0.005)
    assert first_order(doublet(Medium()), 587.6).efl_mm == pytest.approx(94.686, abs=5e-4)
    assert data.front_efl_mm == pytest.approx(data.efl_mm * index_of(WATER, 587.6), rel=1e-14)


@pytest.mark.parametrize(("front", "behind"), [(1.0, 1.7), (1.333, 1.7), (1.7, 1.0), (1.333, 1.333 * 1.2)])
def test_one_surface_between_two_media_images_as_in_closed_form(front: float, behind: float) -> None:
    """n' / s' = n / s + (n' - n) / R, and the principal planes lie in the vertex."""
    radius = 20.0 if behind > front else -20.0
    lens = one_surface(front, behind, radius)
    power = (behind - front) / radius
    data = first_order(lens)
    assert data.efl_mm == pytest.approx(behind / power, rel=1e-14)
    assert data.front_efl_mm == pytest.approx(front / power, rel=1e-14)
    assert (data.front_principal_z_mm, data.rear_principal_z_mm) == pytest.approx((0.0, 0.0), abs=1e-12)
    image = behind / (power - front / 1000.0)
    assert image_z_mm(lens, -1000.0) == pytest.approx(image, rel=1e-13)
    assert film_z_mm(lens, (1000.0 + image) / 1000) == pytest.approx(image, rel=1e-12)
    focused = set_lens(lens, focus_m=1.0)
    assert focused.film_z_mm is not None
    start = axial_rays(focused.with_stop_radius(1e-3), focused.film_z_mm - 1000.0)
    traced = trace(focused, Rays(*map(torch.from_numpy, start)), towards="film")
    r = traced.rays
    across = torch.hypot(r.x + (focused.film_z_mm - r.z) * r.dx / r.dz, r.y + (focused.film_z_mm - r.z) * r.dy / r.dz)
    assert float(across.max()) < 1e-9
    # The pupil lies in the vertex, so that chief rays cross it at a slope that the index changes.
    assert chief_reach_mm(focused) == pytest.approx(focused.film_z_mm * front / behind, rel=1e-12)
    working = breathing(replace(lens, half_field_deg=5.0), [1.0])[0].working_f_number
    assert working == pytest.approx(focused.film_z_mm / 4.0, rel=1e-12)


def test_the_nearest_focus_is_where_object_and_image_are_nearest_to_each_other() -> None:
    """The distance s + s' is least at (1 + sqrt(n / n'))^2 focal lengths of the image side."""
    lens = one_surface(1.333, 1.7)
    least = (1 + math.sqrt(1.333 / 1.7)) ** 2 * first_order(lens).efl_mm / 1000
    assert film_z_mm(lens, least * (1 + 1e-12)) > 0
    with pytest.raises(Exception, match=f"{least:.4g}"):
        film_z_mm(lens, least * (1 - 1e-6))


def test_a_flat_port_bends_rays_by_snells_law_both_ways() -> None:
    """A pinhole behind a plane of glass under water: sines are as the indices, and the way back is the same."""
    rows = (Surface(INF, 5.0, 80.0, n_d=1.5), Surface(INF, 1.0, 80.0), Surface(INF, 30.0, 2.0, stop=True))
    lens = Lens("port", "closed form", rows, 15.0, object_medium=WATER)
    angle = torch.linspace(-0.8, 0.8, 9, dtype=torch.float64)
    zero = torch.zeros_like(angle)
    film = Rays(
        -36 * torch.tan(angle) + 6 * torch.tan(angle), zero, zero + 36.0, torch.sin(angle), zero, -torch.cos(angle)
    )
    out = trace(lens, film, LINE_D_NM, towards="scene")
    assert bool((out.status == 0).all())
    np.testing.assert_allclose(out.rays.dx * WATER.n_d, torch.sin(angle), atol=1e-14)
    r = out.rays
    back = trace(lens, Rays(r.x, r.y, r.z, -r.dx, -r.dy, -r.dz), LINE_D_NM, towards="film").rays
    np.testing.assert_allclose(back.dx, -film.dx, atol=1e-14)
    at_film = back.x + (36.0 - back.z) * back.dx / back.dz
    np.testing.assert_allclose(at_film, film.x, atol=1e-12)
    data = first_order(lens)  # the port magnifies by the index of water, and lies 5 / 1.5 + 1 mm of air from the hole
    assert data.front_efl_mm == pytest.approx(30.0 * WATER.n_d, rel=1e-14)
    assert data.entrance_pupil_z_mm == pytest.approx(WATER.n_d * (5 / 1.5 + 1), rel=1e-14)


def test_the_graph_of_a_lens_under_water_is_the_tracer() -> None:
    """Film in glass and object in water, dispersive both, at the film's edge and both ends of the spectrum."""
    lens = doublet()
    rows = (*lens.surfaces[:2], replace(lens.surfaces[2], n_d=1.5, V_d=60.0))
    lens = set_lens(replace(lens, surfaces=rows))
    film_z = float(lens.film_z_mm or 0.0)
    rng = np.random.default_rng(1)
    film, pupil = rng.uniform(-8, 8, (2, 500)), rng.uniform(-7, 7, (2, 500))
    nm = rng.uniform(380.0, 780.0, 500)
    way = np.concatenate([pupil - film, np.full((1, 500), -film_z)])
    way /= np.linalg.norm(way, axis=0)
    rays = Rays(*(torch.from_numpy(np.ascontiguousarray(v)) for v in (*film, np.full(500, film_z), *way)))
    out = trace(lens, rays, torch.from_numpy(nm), transmittance=True)
    call = {"rays": np.concatenate([film, pupil, nm[None]]), "film_z_mm": np.array([film_z])}
    found = evaluate(exact_graph(lens, 0.0, (380.0, 780.0)), call | {"stop_radius_mm": np.array([lens.stop_radius_mm])})
    status = out.status.numpy()
    assert (found["status"] == status).all() and 0.2 < (status == 0).mean() < 0.9
    passed = status == 0
    np.testing.assert_allclose(found["scene_ray"][:, passed], np.stack(out.rays)[:, passed], atol=2e-6)


def test_the_file_keeps_media_and_wavelengths(tmp_path: Path) -> None:
    """A lens under water, its film in glass, for 1.55 um, comes back the same; its hash is another than in air."""
    lens = doublet()
    rows = (*lens.surfaces[:2], replace(lens.surfaces[2], n_d=1.5, V_d=60.0))
    lens = replace(lens, surfaces=rows, wavelengths_nm=(1550.0, 1300.0))
    write_lens(lens, tmp_path / "lens.toml")
    again = read_lens(tmp_path / "lens.toml")
    assert again.media == lens.media and again.wavelengths_nm == lens.wavelengths_nm
    assert again.sha256 == lens.sha256 != replace(lens, object_medium=Medium()).sha256


def test_a_kept_outline_of_the_lens_in_air_is_not_taken_under_water() -> None:
    keys = {
        search_key(set_lens(doublet(m)), (400.0, 700.0), (0.5,)) for m in (WATER, Medium(), replace(WATER, V_d=None))
    }
    assert len(keys) == 3


def test_first_order_data_stand_at_the_primary_wavelength_of_other_light() -> None:
    """The d line is the reference where the file's wavelengths hold it; focus follows the light of the file."""
    visible = replace(doublet(Medium()), wavelengths_nm=(546.1, 486.1, 656.3))
    infrared = replace(visible, wavelengths_nm=(1550.0, 1500.0, 1600.0))
    assert (visible.reference_nm, visible.light_nm) == (LINE_D_NM, (400.0, 700.0))
    assert (infrared.reference_nm, infrared.light_nm) == (1550.0, (1500.0, 1600.0))
    assert first_order(infrared) == first_order(visible, 1550.0) != first_order(visible)
    film = set_lens(infrared, focus_mode="best").film_z_mm
    assert film is not None
    assert film == pytest.approx(
        float(set_lens(visible, focus_mode="best", wavelength_nm=(1500.0, 1600.0)).film_z_mm or 0), rel=1e-5
    )
