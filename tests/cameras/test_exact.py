"""The exact lens and its models as cameras: exposure, focus, agreement; the same picture through every known pupil."""

import math
from dataclasses import replace
from functools import cache
from pathlib import Path

import lens_models
import numpy as np
import pytest
import torch
from camera_helpers import at, film_rays, jittered, traced
from shipped import whole

from neurolens.base import status as st
from neurolens.base.errors import InputError
from neurolens.cameras.build import make_camera
from neurolens.cameras.contract import Camera
from neurolens.cameras.exact import ExactCamera
from neurolens.cameras.model import OnnxCamera, load_model
from neurolens.graph.interpret import evaluate
from neurolens.optics.lens.paraxial import film_z_mm, first_order
from neurolens.optics.lens.shot import Runtime, Shot
from neurolens.optics.readers.lensfile import read_lens
from neurolens.optics.setting.pupils import pupil_plane_z_mm
from neurolens.optics.setting.states import set_lens
from neurolens.optics.trace.filmfit import FIT
from neurolens.optics.trace.tracegraph import exact_graph

FILM, LENSES = (36.0, 24.0), Path(__file__).parents[2] / "lenses"


@cache
def camera(kind: str, focus_m: float = 2.0, f_number: float | None = None) -> Camera:
    if kind == "exact":
        return lens_models.exact_camera(focus_m, f_number)
    return OnnxCamera(load_model(lens_models.exported(kind)), Shot(FILM, focus_m, f_number))


@pytest.mark.parametrize("focus_m", [math.inf, 1.0])
def test_model_and_exact_lens_send_the_same_rays(focus_m: float) -> None:
    rng = np.random.default_rng(3)
    count = 30_000
    film = ((rng.random((2, count)) - 0.5) * np.array([FILM]).T).astype(np.float32)
    square, wavelength = rng.random((2, count), np.float32), rng.uniform(400, 700, count).astype(np.float32)
    exact = camera("exact", focus_m).sample(film, square, wavelength)
    model = camera("invariants", focus_m).sample(film, square, wavelength)
    assert np.mean((exact.status == 0) != (model.status == 0)) < 0.02
    both = (exact.status == 0) & (model.status == 0)
    assert both.mean() > 0.5
    assert np.quantile(np.linalg.norm(exact.direction - model.direction, axis=0)[both], 0.99) < 5e-4
    assert np.quantile(np.linalg.norm(exact.origin_m - model.origin_m, axis=0)[both], 0.99) < 1e-4
    assert np.abs(exact.weight[both] / model.weight[both] - 1).max() < 0.02
    for rays in (exact, model):
        assert np.all(rays.weight[rays.status != 0] == 0) and np.all(rays.weight[rays.status == 0] > 0)
        assert rays.origin_m.dtype == rays.direction.dtype == rays.weight.dtype == np.float32
        assert rays.status.dtype == np.int32


@pytest.mark.parametrize("kind", ["exact", "invariants"])
@pytest.mark.parametrize("point", [(0.0, 0.0), (8.0, -5.0)])
def test_rays_of_a_film_point_meet_at_the_focus_distance(kind: str, point: tuple[float, float]) -> None:
    focus_m = 2.0
    square = jittered(48)[0]
    rays = camera(kind, focus_m, 8.0).sample(at(point, 48 * 48), square, np.full(48 * 48, 587.6, np.float32))
    passed = rays.status == 0
    along = (-focus_m - rays.origin_m[2]) / rays.direction[2]
    met = (rays.origin_m + along * rays.direction)[:2, passed]
    data = first_order(lens_models.lens())
    image = film_z_mm(lens_models.lens(), focus_m) - data.rear_principal_z_mm
    magnification = image / (1e3 * focus_m - image - (data.rear_principal_z_mm - data.front_principal_z_mm))
    spot_um = 1e6 * magnification * np.sqrt(np.mean(np.sum((met - met.mean(1, keepdims=True)) ** 2, axis=0)))
    assert spot_um < 15  # a blur of 3 pixels in 36 mm / 7000; an error of 1% in the focus gives 50 um at f/1.8
    assert np.all(np.abs(met.mean(1) * 1e3 * magnification + np.array(point)) < 0.02 * np.hypot(*point) + 1e-3)


@pytest.mark.parametrize("coating", ["bare", None])
@pytest.mark.parametrize("runtime", ["c", "onnxruntime"])
@pytest.mark.parametrize(
    "name, film_mm", [("laikin_double_gauss_50", FILM), *whole(("fujifilm_fujinon_xf_14mm_f2_8_r", (23.5, 15.6)))]
)
def test_rays_are_those_that_the_tracer_traces(
    name: str, film_mm: tuple[float, float], runtime: Runtime, coating: str | None
) -> None:
    """In float64, but for statuses, of which float32 decides a few at the very edges, and for the light of coated
    lenses, whose films are polynomials."""
    made = ExactCamera(lens_models.lens(name), Shot(film_mm, 2.0, runtime=runtime, coating=coating))
    film, square, nm = film_rays(made, 100_000)
    wanted, found = traced(made, film, square, nm), made.sample(film, square, nm)
    assert made.runtime == made.settings["runtime"] == runtime
    assert np.mean(found.status != traced(made, film, square, nm, torch.float32).status) < 1e-5
    assert np.mean(found.status != wanted.status) < 1e-4
    both = (found.status == st.PASSED) & (wanted.status == st.PASSED)
    assert both.mean() > 0.5
    assert np.abs(found.direction - wanted.direction)[:, both].max() < 3e-6
    assert np.abs(found.origin_m - wanted.origin_m)[:, both].max() < 2e-7
    coated = sum(s.coating is not None for s in made.lens.surfaces)
    assert (coated > 0) == (coating is None)
    np.testing.assert_allclose(found.weight[both], wanted.weight[both], rtol=2e-5 + FIT * coated)


def test_without_a_compiler_a_camera_runs_in_onnxruntime(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("CC", "/no/compiler")
    assert lens_models.exact_camera.__wrapped__(2.0, 8.0).runtime == "onnxruntime"
    with pytest.raises(InputError, match="CC: got '/no/compiler'"):
        ExactCamera(lens_models.lens(), Shot(FILM, 2.0, 8.0, runtime="c"), bounds=lens_models.domain().bounds)


def test_a_compiler_that_fails_leaves_a_camera_to_onnxruntime(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("CC", "false")
    made = lens_models.exact_camera.__wrapped__(2.0, 8.0)
    film, square = np.zeros((2, 3), np.float32), np.full((2, 3), 0.4, np.float32)
    few, rays = (take(film, square, np.full(3, 550, np.float32)) for take in (made.sample_few, made.sample))
    assert made.runtime == made.settings["runtime"] == "onnxruntime" and (rays.status == 0).all()
    np.testing.assert_allclose(few.direction, rays.direction, atol=1e-6)
    np.testing.assert_allclose(few.weight, rays.weight, rtol=1e-5)


def test_focus_that_no_film_plane_reaches() -> None:
    with pytest.raises(InputError, match="focus_m"):
        ExactCamera(lens_models.lens(), Shot(FILM, 0.1))


@pytest.mark.parametrize("name", ["schneider_anamorphic_31", *whole("cooke_anamorphic_42")])
def test_anamorphic_outlines_lose_no_light_between_the_azimuths_they_are_sought_at(name: str) -> None:
    """Rays through an outline half as wide again carry no more light than those through the outline itself."""
    lens = lens_models.lens(name)
    film_mm = (20.0, 15.0)
    exact = ExactCamera(lens, Shot(film_mm, 3.0))
    outline, side = exact.film.outline, 64
    wide = replace(outline, x=np.float32(1.5) * outline.x, y=np.float32(1.5) * outline.y)
    square = jittered(side)[0]
    beyond = np.abs(2 * square - 1).max(0) > 1 / 1.5
    for azimuth in (2.5, 17.0, 33.0, 36.87, 38.5, 62.5, 88.0):
        c, s = math.cos(math.radians(azimuth)), math.sin(math.radians(azimuth))
        edge = min(film_mm[0] / 2 / c, film_mm[1] / 2 / s)
        for share in (0.3, 0.85, 0.995):
            film = at((share * edge * c, share * edge * s), side * side)
            waves = np.full(side * side, 480, np.float32)
            points, area = wide.sample(film, square, waves)
            light = area * (exact.film.scene(film, points, waves).status == 0)
            assert light[beyond].sum() <= 0.005 * light.sum()


NMS = (
    math.nan,
    math.inf,
    -math.inf,
    0.0,
    -550.0,
    1e-30,
    50.0,
    200.0,
    399.9,
    400.0,
    550.0,
    700.0,
    700.1,
    1e3,
    1e5,
    3e38,
)


@pytest.mark.parametrize("name", ["laikin_double_gauss_50", *whole("canon_aspheric_50")])
def test_light_that_is_none_has_one_status_in_every_form_of_a_lens(name: str) -> None:
    """In onnxruntime, in C, and traced backwards: only wavelengths from 400 to 700 nm reach the scene."""
    made = make_camera(f"{LENSES}/{name}.toml", Shot(film_mm=(36.0, 24.0), focus_m=5.0, runtime="onnxruntime"))
    nm = np.array(NMS, np.float32)
    film, square = (np.tile(np.array(at, np.float32)[:, None], (1, nm.size)) for at in ((3.0, 2.0), (0.45, 0.52)))
    good = (nm >= 400) & (nm <= 700)
    for camera in (made, made.compiled()):
        out = camera.sample(film, square, nm)
        np.testing.assert_array_equal(out.status, np.where(good, st.PASSED, st.OUTSIDE_DOMAIN))
        assert (out.weight[good] > 0).all() and not out.weight[~good].any()
    point = np.tile(np.array([[-0.3], [-0.2], [-5.0]], np.float32), (1, nm.size))
    back = made.to_film(point, square, nm)
    np.testing.assert_array_equal(back.status, np.where(good, st.PASSED, st.OUTSIDE_DOMAIN))


@pytest.mark.parametrize("range_nm", [(150.0, 200.0), (2000.0, 3000.0)])
def test_a_camera_for_light_that_no_glass_is_stated_for_is_refused(range_nm: tuple[float, float]) -> None:
    with pytest.raises(InputError, match="wavelength_nm: got (150|3000).0, expected 300 to 2500 nm"):
        ExactCamera(read_lens(LENSES / "laikin_double_gauss_50.toml"), Shot(FILM, wavelength_nm=range_nm, focus_m=2.0))


@pytest.mark.parametrize("double", [False, True])
@pytest.mark.parametrize("stop_mm", [-5.0, math.nan, math.inf, 1e20])
def test_a_stop_without_a_radius_is_outside_the_domain(stop_mm: float, double: bool) -> None:
    """Its square is that of a radius, or infinite."""
    lens = set_lens(read_lens(LENSES / "laikin_double_gauss_50.toml"))
    graph = exact_graph(lens, pupil_plane_z_mm(lens), (400.0, 700.0), double=double)
    rays = np.array([[0.0, 0.0, 0.0, 0.0, 550.0]]).T
    for radius, status in ((float(lens.stop_radius_mm), st.PASSED), (stop_mm, st.OUTSIDE_DOMAIN)):
        call = {"film_z_mm": np.array([[lens.film_z_mm]]), "stop_radius_mm": np.array([[radius]])}
        assert evaluate(graph, {"rays": rays} | call)["status"] == status
