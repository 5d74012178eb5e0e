"""Cameras written as shaders: their graph against the camera of the same model, and the text."""

import json
import math
import re
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from camera_helpers import FILM, GAUSS, ROOT
from shipped import whole

from neurolens.cameras.cameragraph import unit_disc
from neurolens.cameras.model import OnnxCamera
from neurolens.cameras.onnxlens import load_model
from neurolens.cameras.shaders import blender_shader as shaders, osl, pupil_fit, shader_lens
from neurolens.cameras.shaders.blender_shader import exact_lens
from neurolens.cameras.shaders.pupil import Blades, PupilCircles, passing_share
from neurolens.cameras.shaders.pupil_fit import fit_pupil
from neurolens.cameras.shaders.shader_lens import ShaderLens, light
from neurolens.cli import main
from neurolens.graph.interpret import evaluate
from neurolens.graph.ir import Graph, pruned
from neurolens.graph.loworder import low_tests
from neurolens.graph.scalars import lower
from neurolens.graph.shading import write_osl
from neurolens.models import fit
from neurolens.models.axes import Axis, product, weights
from neurolens.optics.lens.apertures import Aperture
from neurolens.optics.lens.paraxial import first_order
from neurolens.optics.lens.shot import Shot
from neurolens.optics.readers.lensfile import read_lens
from neurolens.optics.setting.focusing import focused_inside
from neurolens.optics.setting.pupils import pupil_plane_z_mm
from neurolens.optics.setting.states import set_lens
from neurolens.optics.trace.tracegraph import exact_graph

MODEL = ROOT / "models" / f"{GAUSS.stem}.ols-36.onnx"
FAR = 1e9


@cache
def lens() -> osl.OslLens:
    return osl.model_lens(load_model(MODEL), lambda share: None)


def written() -> osl.OslCamera:
    return lens().nodes[0]


@cache
def graph() -> Graph:
    return osl.osl_graph(written())


def inputs(film: np.ndarray, square: np.ndarray, **changed: float) -> dict[str, np.ndarray]:
    """Of the graph, for film points [2, N] in mm, as the shader's frame makes them."""
    call = {"f_number": 1.8, "asked_m": 2.0, "roundness": 0.0, "rotation": 0.0, "count": 0, "in_colour": 1, "shaded": 1}
    call |= {"as_lens": 0, "at_pupil": 0, "unit_m": 1, "warned": 0, "pixel_x": 1 / 360, "pixel_y": 1 / 240}
    call |= {"sensor_x_mm": FILM[0], "sensor_y_mm": FILM[1], "tilt": 0.0, "swing": 0.0} | changed
    half = math.pi / max(call["count"], 3)
    first = math.radians(call.pop("rotation")) + half
    call |= {
        "half_cos": math.cos(half),
        "half_sin": math.sin(half),
        "edge_cos": math.cos(first),
        "edge_sin": math.sin(first),
    }
    for name in ("tilt", "swing"):
        angle = math.radians(call.pop(name))
        call |= {f"{name}_sin": math.sin(angle), f"{name}_cos": math.cos(angle)}
    raster = 0.5 - film / np.array(FILM)[:, None]
    rows = {"raster_x": raster[:1], "raster_y": raster[1:], "first": square[:1], "second": square[1:]}
    return rows | {name: np.array([[float(value)]]) for name, value in call.items()}


def shot(film: tuple[float, float], count: int = 30_000, **changed: float) -> dict[str, np.ndarray]:
    square = np.random.default_rng(1).random((2, count))
    return evaluate(graph(), inputs(np.repeat(np.array(film)[:, None], count, 1), square, **changed))


def test_disc_is_filled_evenly() -> None:
    g = Graph()
    g.outputs["disc"] = unit_disc(g.input("square", 2))
    side = (np.arange(256) + 0.5) / 256
    square = np.stack(np.meshgrid(side, side)).reshape(2, -1)
    disc = evaluate(g, {"square": square})["disc"]
    radius = np.hypot(*disc)
    assert radius.max() <= 1 + 1e-7
    np.testing.assert_allclose([(radius <= r).mean() for r in (0.25, 0.5, 0.75)], [0.0625, 0.25, 0.5625], atol=1e-6)
    np.testing.assert_allclose([(disc[0] * disc[1]).mean(), (disc[0] ** 2 - disc[1] ** 2).mean()], 0, atol=1e-5)


@pytest.mark.parametrize("f_number, focus_m", [(1.8, 2.0), (4.0, math.inf), (11.0, 0.8)])
def test_light_of_film_points_is_that_of_the_camera_of_the_model(f_number: float, focus_m: float) -> None:
    camera = OnnxCamera(load_model(MODEL), Shot(FILM, focus_m, f_number))
    rng = np.random.default_rng(2)
    for point in ((0.0, 0.0), (8.0, -6.0), (-16.0, 9.0)):
        square = rng.random((2, 30_000)).astype(np.float32)
        film = np.repeat(np.array(point, np.float32)[:, None], square.shape[1], 1)
        nm = rng.uniform(400, 700, square.shape[1]).astype(np.float32)
        wanted = camera.sample(film, square, nm).weight.mean(dtype=np.float64)
        found = shot(point, f_number=f_number, asked_m=min(focus_m, FAR))["throughput"].mean()
        assert found == pytest.approx(wanted, rel=0.008)


def test_rays_are_those_of_the_model_in_the_frame_of_cycles() -> None:
    camera = OnnxCamera(load_model(MODEL), Shot(FILM, 2.0, 1.8))
    found = shot((10.0, 5.0), in_colour=0)
    passed = found["throughput"][0] > 0
    start, way = (found[name][:, passed].mean(1) for name in ("position", "direction"))
    rng = np.random.default_rng(3)
    film = np.repeat(np.array([[10.0], [5.0]], np.float32), 30_000, 1)
    rays = camera.sample(film, rng.random((2, 30_000)).astype(np.float32), np.full(30_000, 587.56, np.float32))
    lit = rays.weight > 0
    np.testing.assert_allclose(start * [1, 1, -1], rays.origin_m[:, lit].mean(1), atol=3e-4)
    np.testing.assert_allclose(way * [1, 1, -1], rays.direction[:, lit].mean(1), atol=2e-3)
    np.testing.assert_allclose(np.linalg.norm(found["direction"], axis=0), 1, atol=1e-4)


@pytest.mark.parametrize("f_number", [1.8, 4.0])
def test_a_turned_film_has_the_rays_and_the_light_of_the_camera_of_the_model(f_number: float) -> None:
    """As the camera's own film, about both axes: means of position, direction and weight of three film points."""
    camera = OnnxCamera(load_model(MODEL), Shot((24.0, 16.0), 2.0, f_number, film_tilt_deg=8.0, film_swing_deg=-5.0))
    rng, count = np.random.default_rng(6), 30_000
    plain = {"asked_m": 2.0, "f_number": f_number, "in_colour": 0}
    for point in ((0.0, 0.0), (9.0, -7.0), (-11.0, 5.0)):
        film, square = np.repeat(np.array(point)[:, None], count, 1), rng.random((2, count))
        nm = np.full(count, 587.56, np.float32)
        rays = camera.sample(film.astype(np.float32), square.astype(np.float32), nm)
        found = evaluate(graph(), inputs(film, square, tilt=8.0, swing=-5.0, **plain))
        lit, passed = rays.weight > 0, found["throughput"][0] > 0
        assert passed.mean() > 0.98
        assert found["throughput"].mean() == pytest.approx(rays.weight.mean(dtype=np.float64), rel=0.01)
        for name, wanted, within in (("position", rays.origin_m, 2e-4), ("direction", rays.direction, 1e-3)):
            means = found[name][:, passed].mean(1) * [1, 1, -1], wanted[:, lit].mean(1)
            np.testing.assert_allclose(*means, atol=within)
    upright = evaluate(graph(), inputs(film, square, **plain))["direction"]  # of the last point, which shows the turn
    assert np.abs(upright[:, passed].mean(1) * [1, 1, -1] - rays.direction[:, lit].mean(1)).max() > 3e-3


def test_fewer_terms_tell_which_rays_pass_and_move_none() -> None:
    plain, ours = written().lens.graph, written().graph
    given = osl._samples(written().lens, written().pupil, 60_000)
    wanted, found = evaluate(plain, given), evaluate(ours, given)
    np.testing.assert_array_equal(found["scene_ray"], wanted["scene_ray"])
    passed, told = (v["status"][0] == 0 for v in (wanted, found))
    assert (passed != told).mean() < 5e-3
    zone = (6 * np.hypot(*given["rays"][:2]) / written().pupil.film_radius_mm).astype(int)
    light = [np.bincount(zone, v["transmittance"][0] * p, 6) for v, p in ((wanted, passed), (found, told))]
    np.testing.assert_allclose(light[1], light[0], rtol=4e-3)
    counts = [sum(lower(pruned(g, {k: g.outputs[k] for k in wanted})).count().values()) for g in (plain, ours)]
    assert counts[1] < 0.7 * counts[0]


def test_an_exact_lens_keeps_its_tests() -> None:
    lens = read_lens(GAUSS)
    traced = exact_graph(lens, pupil_plane_z_mm(lens), (400.0, 700.0))
    assert low_tests([traced], [osl._samples(written().lens, written().pupil)]) is None


def zoom(name: str, axis: Axis) -> tuple[list[ShaderLens], list[tuple[np.ndarray, ShaderLens]]]:
    """A zoom at the nodes of a part of its range, and between them."""
    model = load_model(ROOT / "models" / f"{name}.onnx")
    between = [(weights([axis], s), osl.shader_lens(model.at(*s))) for s in osl.states_between([axis])]
    return [osl.shader_lens(model.at(*state)) for state in product([axis])], between


@pytest.fixture
def few_rays(monkeypatch: pytest.MonkeyPatch) -> None:
    """A quick fit of the pupil, where it is not the pupil that is tested."""
    monkeypatch.setattr(pupil_fit, "_RAYS", 3000)
    monkeypatch.setattr(shader_lens, "_RAYS", 4000)


@pytest.mark.slow
@pytest.mark.usefixtures("few_rays")
def test_zoom_is_an_input() -> None:
    file = ROOT / "models" / "nikon_zoom_80_200-range.states-64.onnx"
    axis = Axis("zoom", "mm", (95.0, 98.0), 1)
    nodes, between = zoom(file.stem, axis)
    made = osl.osl_lens(nodes, lambda share: None, (axis,), between)
    program = osl.osl_program(made)
    assert min(made.passing().values()) > 0.94
    rng = np.random.default_rng(8)
    film, square = np.repeat([[9.0], [-5.0]], 16_000, 1), rng.random((2, 16_000))
    for zoom_mm in (97.4,):
        given = inputs(film, square, f_number=4.0, asked_m=5.0, in_colour=0)
        rows = {name: value[0] for name, value in given.items()}
        found = program.evaluate(rows | {"zoom_mm": np.float32(zoom_mm)})
        camera = OnnxCamera(load_model(file).at(zoom_mm), Shot(FILM, 5.0, 4.0))
        rays = camera.sample(film.astype(np.float32), square.astype(np.float32), np.full(16_000, 587.56, np.float32))
        lit, passed = rays.weight > 0, found["throughput_0"] > 0
        assert passed.mean() > 0.5
        for name, wanted, within in (("position", rays.origin_m, 5e-4), ("direction", rays.direction, 1e-4)):
            mean = np.array([np.mean(found[f"{name}_{k}"][passed]) for k in range(3)]) * [1, 1, -1]
            np.testing.assert_allclose(mean, wanted[:, lit].mean(1), atol=within)
        assert np.mean(found["throughput_0"]) == pytest.approx(rays.weight.mean(dtype=np.float64), rel=0.02)


@pytest.mark.slow
@pytest.mark.usefixtures("few_rays")
def test_groups_of_a_lens_file_move_where_the_camera_is_focused(monkeypatch: pytest.MonkeyPatch) -> None:
    file = ROOT / "lenses" / "tajima_retrofocus_24.toml"
    monkeypatch.setattr(fit, "gap_axis", lambda axis, _: (replace(axis, knots=(2.4, axis.knots[-1]), degree=1), 0))
    _, made, _ = exact_lens(file, None, lambda share: None)  # of the near part of its range
    assert made.near_m == pytest.approx((0.3, 0.3), rel=1e-6)
    program, focus_m = osl.osl_program(made), 0.34
    square = np.random.default_rng(9).random((2, 3000))
    film = np.repeat([[7.0], [10.0]], 3000, 1)
    rows = inputs(film, square, f_number=4.0, asked_m=focus_m, in_colour=0)
    given = {name: value[0] if value.size > 1 else value.item() for name, value in rows.items()}
    found = program.evaluate(given)
    passed = found["throughput_0"] > 0
    assert passed.mean() > 0.5
    start, way = (np.array([found[f"{name}_{k}"][passed] for k in range(3)]) for name in ("position", "direction"))
    # All rays of a film point meet where the lens, its groups moved, has the point's image.
    lens = focused_inside(set_lens(read_lens(file)), focus_m)
    data = first_order(lens)
    away = (focus_m * 1e3 + data.front_principal_z_mm - lens.film_z_mm) / 1e3  # from the front principal plane
    plane = start + (focus_m - start[2]) / way[2] * way
    scale = np.linalg.norm(plane.mean(1)[:2]) / np.linalg.norm(film[:, 0] * 1e-3)
    first = away / ((lens.film_z_mm - data.rear_principal_z_mm) / 1e3)
    assert scale == pytest.approx(first, rel=0.03)  # its distortion
    assert np.sqrt(np.mean((plane - plane.mean(1)[:, None]) ** 2)) < 2e-4
    near = program.evaluate(given | {"asked_m": 0.28})
    assert not near["throughput_0"].any()


def test_range_of_a_zoom_whose_groups_focus_is_refused_in_one_line(tmp_path, capsys) -> None:
    out = tmp_path / "zoom.osl"
    file = ROOT / "lenses" / "nikon_zoom_70_200.toml"
    assert main(["export", str(file), "--to", "osl", "-o", str(out), "--zoom", "range"]) == 2
    told = capsys.readouterr().err.strip().splitlines()[-1]
    assert "nikon_zoom_70_200.toml" in told and "one focal length of the zoom: its groups move to focus" in told
    assert not out.exists()


@cache
def fitted(name: str) -> tuple[ShaderLens, PupilCircles]:
    if name == MODEL.stem:
        return written().lens, written().pupil
    model = load_model(ROOT / "models" / f"{name}.onnx")
    shown = osl.shader_lens(model)
    return shown, fit_pupil([shown], lambda share: None)[0]


def reach_of(lens: ShaderLens) -> float:
    """Half the side of a square on the pupil plane that holds what passes."""
    low, high, half = lens.table.rows
    return float(np.abs([low, high, half])[:, low <= high].max())


def test_at_least_95_percent_of_rays_pass() -> None:
    assert min(lens().passing().values()) >= 0.95


BICONVEX = "thorlabs_lb1471_biconvex_50.ols-64"  # far off its axis two parts of the pupil show one part of the stop


@pytest.mark.parametrize(
    "name, least",
    [
        ("muller_fisheye_100.ols-64", 0.95),
        ("minolta_135mm_f2_8_t4_5_stf.ols-64", 0.95),  # whose stop alone cuts rays
        pytest.param(BICONVEX, 0.27, marks=pytest.mark.slow),
        *whole(("cooke_anamorphic_42.ols-64", 0.92)),
    ],
)
def test_pupils_of_high_order_pass_and_keep_the_light(name: str, least: float) -> None:
    """Against samples all over a box on the pupil plane: light of film points on all sides, stop open and closed."""
    lens, pupil = fitted(name)
    rng, count, reach = np.random.default_rng(12), 100_000, reach_of(lens)
    assert (pupil.wide[2] > 0) == (name == BICONVEX)
    assert min(passing_share(lens, pupil).values()) >= least
    for share, turn, field in ((1.0, 0.5, 0.6), (1.0, 1.2, 0.6), (0.5, 0.3, 0.6), (0.5, 0.9, 0.9)):
        stop = share * lens.stop_radius_mm
        point = field * pupil.film_radius_mm * np.array([[math.cos(turn)], [math.sin(turn)]])
        film, z, nm = np.repeat(point, count, 1), float(np.mean(lens.film_z_mm)), np.full(count, 550.0)
        inputs = {"film_mm": film, "square": rng.random((2, count)), "wavelength_nm": nm[None]}
        inputs |= {"film_z_mm": np.array([[z]]), "stop_radius_mm": np.array([[stop]])}
        sample = evaluate(pupil.graph, inputs)
        passed = lens.status(film, sample["pupil_mm"], nm, z, stop) == 0
        area = float(np.mean(np.where(passed, sample["area_mm2"], 0.0)))
        box = rng.uniform(-reach, reach, (2, count))
        wanted = float(np.mean(lens.status(film, box, nm, z, stop) == 0)) * 4 * reach**2
        spread = wanted * math.sqrt(4 * reach**2 / wanted / count)  # of the box's mean
        spread += float(np.std(np.where(passed, sample["area_mm2"], 0.0))) / math.sqrt(count)
        assert area == pytest.approx(wanted, abs=4 * spread + 0.002 * wanted)


@pytest.mark.parametrize(
    "name",
    [
        MODEL.stem,
        pytest.param("muller_fisheye_100.ols-64", marks=pytest.mark.slow),
        pytest.param(BICONVEX, marks=pytest.mark.slow),
        *whole("cooke_anamorphic_42.ols-64"),
    ],
)
def test_pupils_lose_no_light_in_any_zone_of_the_film(name: str) -> None:
    """Random rays from all over the film through a box that holds the pupil, the stop open and half: all but 1 in 1000
    of those that pass could have been samples."""
    lens, pupil = fitted(name)
    for share in (1.0, 0.5):
        reach = (0.6 + 0.4 * share if name == BICONVEX else 0.4 + 0.6 * share) * reach_of(lens)
        counts, missed = (row.reshape(5, 4) for row in missed_by_zone(lens, pupil, reach, share))
        # All sides of a round lens are the same, of others those that mirrors bring together.
        counts, missed = (row + row[:, ::-1] if lens.anamorphic else row.sum(1) for row in (counts, missed))
        assert (counts > 2000).all()
        # Few rays tell about a zone near the axis: the bound allows for chance.
        assert (missed <= 1e-3 * counts + 3 * np.sqrt(1e-3 * counts)).all() and missed.sum() <= 5e-4 * counts.sum()


def missed_by_zone(
    lens: ShaderLens, pupil: PupilCircles, reach: float, share: float = 1.0
) -> tuple[np.ndarray, np.ndarray]:
    """Of random rays through a box, those that pass and those of them that no sample is: of five parts of the film's
    radius and of four of its half turn."""
    rng, count = np.random.default_rng(21), 400_000 if lens.anamorphic else 200_000
    stop = share * lens.stop_radius_mm
    radius, angle = np.sqrt(rng.random(count)), 2 * np.pi * rng.random(count)
    film = pupil.film_radius_mm * radius * np.stack([np.cos(angle), np.sin(angle)])
    point, z, nm = rng.uniform(-reach, reach, (2, count)), *(rng.uniform(*span, count) for span in (
        lens.film_z_mm, lens.wavelength_nm))  # fmt: skip
    passed = lens.status(film, point, nm, z, stop) == 0
    film, point = film[:, passed], point[:, passed]
    if not pupil.image.anamorphic:
        turn = np.exp(-1j * np.arctan2(film[1], film[0])) * (point[0] + 1j * point[1])
        film, point = np.stack([np.hypot(*film), 0 * film[0]]), np.stack([turn.real, turn.imag])
    inputs = {"film_mm": film, "pupil_mm": point, "stop_radius_mm": np.array([[stop]])}
    inputs |= {"film_z_mm": z[None, passed], "wavelength_nm": nm[None, passed]}
    missed = beyond_circles(pupil, inputs)
    zone = (radius * 5).astype(int) * 4 + (angle * 4 / np.pi).astype(int) % 4
    return np.bincount(zone[passed], minlength=20), np.bincount(zone[passed], missed, 20)


def beyond_circles(circles: PupilCircles, rays: dict[str, np.ndarray]) -> np.ndarray:
    """[N] whether rays through points of the pupil lie beyond circles, or have no point of the stop: by Newton's rule
    on the image, from where most of the image is a mere scaling."""
    image, pupil = circles.image, rays["pupil_mm"]
    inputs = {name: rays[name] for name in ("film_mm", "film_z_mm", "wavelength_nm")}
    point, size, left = np.zeros_like(pupil), image.stop_mm, np.arange(pupil.shape[1])
    for _ in range(12):  # of those that have not arrived
        rows = evaluate(image.graph, {name: row[:, left] for name, row in (inputs | {"point_mm": point}).items()})
        (a, c), (b, d) = (rows[f"pupil_mm_by_point_mm_{k}"].astype(float) for k in (0, 1))
        x, y = pupil[:, left] - rows["pupil_mm"]
        step = np.stack([d * x - b * y, a * y - c * x]) / (a * d - b * c)
        point[:, left] += np.clip(step, -0.3 * size, 0.3 * size)
        left = left[~(np.abs(step).max(0) < 1e-6 * size)]
    away = np.hypot(*(evaluate(image.graph, inputs | {"point_mm": point})["pupil_mm"] - pupil))
    within = evaluate(circles.checked, rays | {"point_mm": point})["within"]
    return (within < 0).any(0) | ~(away < 1e-3 * size)


@pytest.mark.usefixtures("few_rays")
def test_light_is_that_of_the_camera_where_rims_leave_half_a_pupil() -> None:
    file = ROOT / "models" / "ogawa_zoom_70_200-135mm.ols-60.onnx"
    made = osl.model_lens(load_model(file), lambda share: None)
    assert min(made.passing().values()) > 0.97
    again, rng = osl.osl_graph(made.nodes[0]), np.random.default_rng(11)
    camera = OnnxCamera(load_model(file), Shot(FILM, math.inf))
    for point in ((0.0, 0.0), (-16.0, 9.0)):
        square, film = rng.random((2, 30_000)).astype(np.float32), np.repeat(np.array(point)[:, None], 30_000, 1)
        nm = rng.uniform(400, 700, 30_000).astype(np.float32)
        wanted = camera.sample(film.astype(np.float32), square, nm).weight.mean(dtype=np.float64)
        found = evaluate(again, inputs(film, square, f_number=1.0, asked_m=FAR))["throughput"].mean()
        assert found == pytest.approx(wanted, rel=0.008)


def test_from_the_entrance_pupil_chief_rays_start_at_the_camera() -> None:
    found = shot((4.0, 0.0), f_number=100.0, at_pupil=1, in_colour=0)
    passed = found["throughput"][0] > 0
    start, way = (found[name][:, passed] for name in ("position", "direction"))
    across = start[0] - start[2] * way[0] / way[2]  # where rays cross the plane of the camera
    assert abs(across.mean()) < 5e-5


def test_lengths_are_in_units_of_the_scene() -> None:
    """A scene in centimetres: the same rays, their places and how these change in numbers 100 times as large."""
    metres, centimetres = (shot((4.0, -7.0), 1000, unit_m=unit) for unit in (1.0, 0.01))
    assert metres["throughput"].any()
    for name in osl.OUTPUTS:
        scale = 100 if name in ("position", "dPdx", "dPdy") else 1
        np.testing.assert_allclose(centimetres[name], scale * metres[name], rtol=1e-9, atol=1e-15)
    text = osl.write_camera(lens(), "gauss", [])[0]
    assert 'getattribute("cam:focal_distance", asked_m))\n        asked_m *= unit_m;' in text


def test_derivatives_on_a_turned_film_are_those_of_neighbouring_pixels() -> None:
    """The chief ray, by pixels half of one's size beside: at a small stop the pupil's own motion hardly counts."""
    rng, point = np.random.default_rng(4), np.array([[9.0], [-7.0]])
    square, pixel = rng.random((2, 2000)), 1 / 360
    given = {"f_number": 16.0, "in_colour": 0, "tilt": 20.0, "swing": -10.0, "pixel_x": pixel}
    ends = []
    for step in (-0.5, 0.0, 0.5):
        film = np.repeat(point - [[step * pixel * FILM[0]], [0.0]], 2000, 1)
        ends.append(evaluate(graph(), inputs(film, square, **given)))
    passed = np.all([end["throughput"][0] > 0 for end in ends], axis=0)
    wanted = (ends[2]["direction"] - ends[0]["direction"])[:, passed].mean(1)
    found = ends[1]["dDdx"][:, passed].mean(1)
    np.testing.assert_allclose(found, wanted, atol=0.02 * np.linalg.norm(wanted))
    upright = evaluate(graph(), inputs(film, square, **given | {"tilt": 0.0, "swing": 0.0}))["dDdx"]
    assert np.linalg.norm(upright[:, passed].mean(1) - wanted) > 0.03 * np.linalg.norm(wanted)


def test_derivatives_are_those_of_neighbouring_pixels() -> None:
    rng = np.random.default_rng(4)
    square, film = rng.random((2, 4000)), (rng.random((2, 4000)) - 0.5) * np.array([[28.0], [18.0]])
    found = evaluate(graph(), inputs(film, square, f_number=8.0, in_colour=0))
    wanted = {}
    for axis, pixel in (("x", 1 / 360), ("y", 1 / 240)):
        # The ray through the same point of the pupil: to first order the pupil's own motion cancels in the mean.
        film_step = np.array([[pixel * FILM[0]], [0.0]]) if axis == "x" else np.array([[0.0], [pixel * FILM[1]]])
        pupil = evaluate(written().pupil.graph, pupil_inputs(film, square))["pupil_mm"]
        ends = [lens_ray(film + sign * film_step, pupil) for sign in (-0.5, 0.5)]
        wanted[axis] = (ends[0] - ends[1]) * np.array([1, 1, -1])[:, None]
    passed = found["throughput"][0] > 0
    for axis, change in wanted.items():
        error = np.linalg.norm(found[f"dDd{axis}"] - change, axis=0) / np.linalg.norm(change, axis=0)
        assert np.sqrt(np.mean(error[passed] ** 2)) < 0.05


def pupil_inputs(film: np.ndarray, square: np.ndarray) -> dict[str, np.ndarray]:
    shot_lens = written().lens
    stop = written().lens.f_number * shot_lens.stop_radius_mm / 8.0
    z = film_z(2.0, stop)
    nm = np.full((1, film.shape[1]), 587.5618)
    return {
        "film_mm": film,
        "square": square,
        "film_z_mm": z,
        "stop_radius_mm": np.array([[stop]]),
        "wavelength_nm": nm,
    }


def film_z(focus_m: float, stop_mm: float) -> np.ndarray:
    share, vergence = stop_mm / written().lens.stop_radius_mm, written().nearest_m[0] / focus_m
    return np.array([[np.polynomial.polynomial.polyval2d(share, vergence, written().film[0])]])


def test_film_is_where_the_camera_of_the_model_has_it() -> None:
    for f_number, focus_m in ((1.8, math.inf), (2.8, 1.0), (5.6, 0.7), (11.0, 3.0)):
        camera = OnnxCamera(load_model(MODEL), Shot(FILM, focus_m, f_number))
        stop = camera.settings["stop_radius_mm"]
        assert float(film_z(focus_m, stop)[0, 0]) == pytest.approx(camera.film.film_z_mm, abs=2e-3)
    # The same distance from the entrance pupil, which stands before the film.
    behind = (float(film_z(1.5, 9.525)[0, 0]) - written().entrance_mm) / 1e3
    shares = np.array(written().nearest_m) / (1.5, 1.5 - behind)
    ways = [np.polynomial.polynomial.polyval2d(1.0, v, f) for v, f in zip(shares, written().film, strict=True)]
    assert ways[1] == pytest.approx(ways[0], abs=2e-4)


def lens_ray(film: np.ndarray, pupil: np.ndarray) -> np.ndarray:
    given = pupil_inputs(film, pupil)
    rays = np.concatenate([film, pupil, given["wavelength_nm"]])
    call = {name: given[name] for name in ("film_z_mm", "stop_radius_mm")}
    return evaluate(written().lens.graph, {"rays": rays, **call})["scene_ray"][3:]


def light_of(numbers: np.ndarray, in_colour: float = 1.0) -> dict[str, np.ndarray]:
    """Wavelength, colour and left numbers of random numbers [2, N]."""
    g = Graph()
    found = light((400.0, 700.0), g.input("numbers", 2), g.input("in_colour", per_call=True))
    g.outputs = dict(zip(("nanometres", "colour", "left"), found, strict=True))
    return evaluate(g, {"numbers": numbers, "in_colour": np.array([[in_colour]])})


def owen(whole: np.ndarray, bits: int, rng: np.random.Generator) -> np.ndarray:
    """Whole numbers whose bits are each flipped by chance that the higher ones choose (Owen 1995)."""
    out = np.zeros_like(whole)
    for k in range(bits - 1, -1, -1):
        above = whole >> (k + 1)
        out |= (((whole >> k) & 1) ^ rng.integers(0, 2, int(above.max()) + 1)[above]) << k
    return out


def pixel(count: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Random numbers [2, N] of a pixel's samples as Cycles has them, and which of these are in one of its halves.

    Sobol's second and third dimension (Joe and Kuo 2008), scrambled, the samples shuffled (Burley 2020); halves as of
    section 10.2.1 of Christensen et al. 2018.
    """
    rng, bits = np.random.default_rng(seed), 10
    index, numbers = owen(np.arange(count), count.bit_length() - 1, rng), []
    for order, polynomial, first in ((1, 0, [1]), (2, 1, [1, 3])):
        m = list(first)
        while len(m) < bits:
            new = m[-order] ^ (m[-order] << order)
            for k in range(1, order):
                new ^= (polynomial >> (order - 1 - k) & 1) * (m[-k] << k)
            m.append(new)
        point = np.zeros(count, int)
        for k, value in enumerate(m):
            point ^= ((index >> k) & 1) * (value << (bits - 1 - k))
        numbers.append((owen(point, bits, rng) + rng.random(count)) / (1 << bits))
    odd = [bin(k & 0xAAAA).count("1") % 2 == 1 for k in range(count)]
    return np.array(numbers), np.array(odd)


def test_colour_weights_are_white_and_never_negative() -> None:
    side = (np.arange(1024) + 0.5) / 1024
    fine = np.random.default_rng(1).random((2, 1 << 20)) / 1024
    colour = light_of(np.stack(np.meshgrid(side, side)).reshape(2, -1) + fine - 0.5 / 1024)["colour"]
    assert colour.min() >= 0
    np.testing.assert_allclose(colour.mean(1), 1, atol=1e-3)


@pytest.mark.parametrize("seed", range(4))
def test_few_samples_of_a_pixel_and_either_half_hold_the_spectrum_evenly(seed: int) -> None:
    numbers, half = pixel(64, seed)
    eighth = np.floor((light_of(numbers)["nanometres"][0] - 400) / 300 * 8)
    for start in range(0, 64, 16):
        for few in (half, ~half):
            assert sorted(eighth[start : start + 16][few[start : start + 16]]) == list(range(8))
    # Eighths by the high bits of one number are not even in a half: which is why the parts are not those.
    uneven = [np.ptp(np.histogram(n[0][h], 8, (0, 1))[0]) for n, h in (pixel(64, k) for k in range(20))]
    assert np.mean(uneven) > 1


def test_the_numbers_for_the_pupil_are_even_and_tell_nothing_about_the_wavelength() -> None:
    side = (np.arange(256) + 0.5) / 256
    numbers = np.stack(np.meshgrid(side, side)).reshape(2, -1) + 1e-4
    found = light_of(numbers)
    part = np.floor((found["nanometres"][0] - 400) / 300 * 16)
    cells = np.stack([part, *np.floor(found["left"] * 8)])
    counts = np.histogramdd(cells.T, (16, 8, 8), ((0, 16), (0, 8), (0, 8)))[0]
    np.testing.assert_array_equal(counts, numbers.shape[1] / counts.size)
    assert np.array_equal(light_of(numbers, 0.0)["left"], numbers)  # without dispersion all bits are the pupil's


def test_nothing_beyond_the_domain_unless_a_warning_is_asked_for() -> None:
    for changed, film in (({"asked_m": 0.3}, (0.0, 0.0)), ({}, (17.9, 13.0))):
        assert not shot(film, 100, **changed)["throughput"].any()
        told = shot(film, 100, warned=1, **changed)
        np.testing.assert_array_equal(told["throughput"], np.repeat([[1.0], [0.0], [1.0]], 100, 1))
    assert shot((0.0, 0.0), 100, warned=1)["throughput"].any()


@pytest.mark.parametrize("blades, roundness, rotation", [(5, 0.0, 20.0), (7, 0.4, 0.0), (16, 0.0, 5.0)])
def test_blades_are_those_of_apertures(blades: int, roundness: float, rotation: float) -> None:
    g = Graph()
    g.outputs["open"] = Blades(g).opened(g.input("stop_xy_mm", 2) * (1 / written().lens.stop_radius_mm))
    at_stop = np.random.default_rng(5).uniform(-1, 1, (2, 20_000)) * written().lens.stop_radius_mm
    at_stop = at_stop[:, np.hypot(*at_stop) <= written().lens.stop_radius_mm]
    given = inputs(at_stop, at_stop, count=blades, roundness=roundness, rotation=rotation, f_number=1.0)
    found = evaluate(g, given | {"stop_xy_mm": at_stop})["open"][0] > 0
    radius = written().lens.stop_radius_mm
    np.testing.assert_array_equal(found, Aperture(blades, rotation, roundness).inside(*at_stop, radius))


@pytest.mark.parametrize("blades, roundness, rotation", [(5, 0.0, 20.0), (6, 0.5, 0.0), (9, 0.0, 11.0)])
def test_samples_fill_the_blades(blades: int, roundness: float, rotation: float) -> None:
    shape = {"count": blades, "roundness": roundness, "rotation": rotation}
    aperture = Aperture(blades, rotation, roundness)
    for f_number in (1.8, 4.0, 8.0):
        # Against samples of the round stop of which the blades' are kept: light and its spread over the stop.
        found, kept = stop_light(f_number, **shape), stop_light(f_number)
        assert (found[1] > 0).mean() > 0.95 * (kept[1] > 0).mean()
        inside = aperture.inside(*kept[0], 1.0)
        assert found[1].mean() == pytest.approx(kept[1][inside].sum() / kept[1].size, rel=0.015)
        for moment in (lambda p: p[0] ** 2, lambda p: p[1] ** 2, lambda p: p[0] ** 3 - 3 * p[0] * p[1] ** 2):
            pair = [np.average(moment(p), weights=w) for p, w in (found, (kept[0][:, inside], kept[1][inside]))]
            assert pair[0] == pytest.approx(pair[1], abs=0.008)


@cache
def stop_light(f_number: float, **shape: float) -> tuple[np.ndarray, np.ndarray]:
    """Where rays from all over the film cross the stop, in units of its radius, and their weights."""
    rng = np.random.default_rng(7)
    film, square = (rng.random((2, 20_000)) - 0.5) * np.array([[30.0], [20.0]]), rng.random((2, 20_000))
    given = inputs(film, square, f_number=f_number, in_colour=0, **shape)
    stop = min(written().lens.f_number / f_number, 1.0) * written().lens.stop_radius_mm
    z = film_z(2.0, stop)
    call = {"film_z_mm": z, "stop_radius_mm": np.array([[stop]])}
    sampler = written().pupil.sampler(Blades, written().margin)
    nm = np.full((1, film.shape[1]), 587.5618)
    names = ("count", "roundness", "half_cos", "half_sin", "edge_cos", "edge_sin")
    own = {"film_mm": film, "square": square, "wavelength_nm": nm} | call | {name: given[name] for name in names}
    pupil = evaluate(sampler, own)
    rays = np.concatenate([film, pupil["pupil_mm"], nm])
    at_stop = evaluate(written().lens.graph, {"rays": rays, **call})["stop_xy_mm"] / stop
    return at_stop, evaluate(graph(), given)["throughput"][0]


def test_exposure_as_the_lens_falls_with_the_stop() -> None:
    wide, narrow = (shot((0.0, 0.0), as_lens=1, f_number=n)["throughput"].mean() for n in (2.8, 5.6))
    assert wide / narrow == pytest.approx(4, rel=0.03)
    assert 0.2 < wide < (1.81 / 2.8) ** 2  # glass takes some


def test_without_vignetting_the_corner_is_as_bright_as_the_middle() -> None:
    corner = shot((15.0, 9.0), shaded=0)["throughput"].mean()
    assert 0.93 < corner < 1.01


def test_the_text_is_osl() -> None:
    text, operations = osl.write_camera(lens(), "gauss", ["a comment */ that tries to end"])
    assert operations < 1600
    code = text.split("*/", 1)[1]
    assert not re.search(r"\d\.?(e[+-]\d+)?f\b", code) and "#include" not in code and "struct" not in code
    declared = re.findall(r"^    float (t\d+) = ", code, re.M)
    assert len(declared) == len(set(declared)) > 300
    for output in osl.OUTPUTS:
        assert re.search(rf"^    {output} = (point|vector|color)\(", code, re.M)
    known = {*declared, *re.findall(r"\b(\w+) = ", code)}
    used = set(re.findall(r"\bt\d+\b", code))
    assert used <= known


@pytest.mark.whole  # the longest program
def test_a_long_program_has_fewer_statements_than_the_compiler_takes() -> None:
    """10,000 in a block: its parser's stack. Of a lens of aspheres there are more steps."""
    g = Graph()
    x = g.input("raster_x", 1)
    for k in range(12_000):
        x = x * (1 + k / 7e4) + 1.0
    for output in osl.OUTPUTS:
        g.outputs[output] = g.concat(x, x, x)
    text = write_osl(lower(g), "long", [], [], "", osl.OUTPUTS)
    assert text.count(" = ") > 12_000 and text.count(";") < 1000


def test_command_line_writes_a_shader_and_refuses_what_is_its_input(tmp_path, monkeypatch, capsys) -> None:
    made = lens()
    monkeypatch.setattr(shaders, "model_lens", lambda *given, fixed: made)
    out = tmp_path / "lens.osl"
    assert main(["export", str(MODEL), "--to", "osl", "-o", str(out), "--name", "gauss", "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["function"] == "gauss" and told["inputs"][:2] == ["f_number", "focus_m"]
    assert min(told["passing"].values()) >= 0.95 and "shader gauss(" in out.read_text(encoding="utf-8")
    for wrong in (["--focus", "2"], ["--fix", "stop=4"], ["--camera"], ["--name", "color"], ["--name", "shader"]):
        other = tmp_path / "other.osl"
        assert main(["export", str(MODEL), "--to", "osl", "-o", str(other), *wrong]) == 2
        assert "neurolens" in capsys.readouterr().err and not other.exists()
    monkeypatch.setattr(shaders, "MAX_STEPS", 100)
    assert main(["export", str(MODEL), "--to", "osl", "-o", str(tmp_path / "long.osl")]) == 2
    said = capsys.readouterr().err.strip().splitlines()[-1]
    assert MODEL.name in said and "up to 100: a model of the lens is smaller" in said
    assert not (tmp_path / "long.osl").exists()
