"""Cameras as source code: the rays of the camera itself, its constants, and an integrator of its own in C++."""

import re
import shutil
import subprocess
from dataclasses import replace
from pathlib import Path
from typing import Any

import lens_models
import numpy as np
import pytest
import torch
from camera_helpers import film_rays
from command_line import failure
from numpy.typing import ArrayLike, NDArray
from shipped import whole

from experiments.speed.compiled_source import CompiledSource
from neurolens.base import status as st
from neurolens.cameras.build import make_camera
from neurolens.cameras.exact import ExactCamera
from neurolens.cameras.model import OnnxCamera, load_model
from neurolens.cameras.shaders import lens_source
from neurolens.cameras.shaders.lens_source import lens_program, pupil_planes_mm
from neurolens.cameras.shaders.source import Focusing, camera_program, film_extras, model_extras, number_of
from neurolens.cli import main
from neurolens.graph.compiler import has_compiler
from neurolens.models.fit import gap_axis, zoom_axis
from neurolens.models.pairs import domain_of, sample_domain
from neurolens.optics.lens.paraxial import film_z_mm, first_order
from neurolens.optics.lens.shot import Shot
from neurolens.optics.readers.any_format import read_any
from neurolens.optics.readers.lensfile import read_lens
from neurolens.optics.setting import focusing
from neurolens.optics.setting.focusing import best_focus_of_stops_mm, best_focus_z_mm
from neurolens.optics.setting.pupils import camera_rays
from neurolens.optics.setting.states import set_lens
from neurolens.optics.trace.rays import trace
from neurolens.optics.trace.surfaces import Rays

ROOT = Path(__file__).parents[2]
LENS = ROOT / "lenses" / "laikin_double_gauss_50.toml"
FILM, FOCUS_M = (36.0, 24.0), 1.2


def camera(kind: str) -> ExactCamera | OnnxCamera:
    made = make_camera(
        LENS if kind == "exact" else lens_models.exported(kind), Shot(FILM, FOCUS_M, 4.0, runtime="onnxruntime")
    )
    assert isinstance(made, (ExactCamera, OnnxCamera))
    return made


@pytest.mark.parametrize("kind", ["exact", "invariants"])
def test_a_camera_as_source_gives_its_own_rays(kind: str) -> None:
    made = camera(kind)
    graph = made.lens_graph()
    program = camera_program(made.film, graph, derivatives=True)
    film, square, wavelength = film_rays(made, 4000)
    given = dict(zip(("film_x_mm", "film_y_mm", "u", "v", "wavelength_nm"), (*film, *square, wavelength), strict=True))
    found = program.evaluate(given)
    wanted = made.sample(film, square, wavelength)
    both = (found["status"] == st.PASSED) & (wanted.status == st.PASSED)
    assert both.mean() > 0.95 and (found["status"] != wanted.status).mean() < 1e-3
    rows = [found[name] for name in ("x_m", "y_m", "z_m", "dx", "dy", "dz")]
    assert np.abs(np.stack(rows) - [*wanted.origin_m, *wanted.direction])[:, both].max() < 5e-6
    np.testing.assert_allclose(found["weight"][both], wanted.weight[both], rtol=2e-4)
    assert not found["weight"][found["status"] != st.PASSED].any()
    pupil, area = made.film.outline.sample(film, square, wavelength)
    np.testing.assert_allclose([found["pupil_x_mm"], found["pupil_y_mm"]], pupil, atol=2e-4)
    np.testing.assert_allclose(found["area_mm2"], area, rtol=1e-3)
    if isinstance(made, ExactCamera):
        moves = made.sample_differentials(film, square, wavelength).differentials
        assert moves is not None
        slopes = np.stack([found[f"{row}_by_film_{by}_mm"] for row in ("dx", "dy", "dz") for by in "xy"])
        assert np.abs(slopes - moves.direction.reshape(6, -1))[:, both].max() < 1e-5


@pytest.mark.parametrize("name", ["laikin_double_gauss_50", *whole("phone_lens_6")])
def test_the_film_of_a_focus_and_stop_is_that_of_best_focus(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of an exact lens, within the error that is told; it rises as objects come nearer, and stays beyond the ends."""
    monkeypatch.setattr(focusing, "_RINGS", 96)  # rays of best focus, for the function as for what it is held to
    lens = set_lens(read_lens(LENS.with_name(f"{name}.toml")))
    near_m, widest = 12e-3 * float(first_order(lens).efl_mm), float(lens.stop_radius_mm)

    def best(focus_m: float, stops_mm: NDArray[np.float64]) -> NDArray[np.float64]:
        return best_focus_of_stops_mm(lens, focus_m, stops_mm)

    functions, lines = film_extras([Focusing(near_m, widest, lambda focus_m: film_z_mm(lens, focus_m), best)])
    told, told_paraxial = (float(re.findall(r"within (\S+) um", line)[0]) for line in lines)
    assert told < 1 and told_paraxial < 0.01

    def film(focus_m: ArrayLike, stop_mm: ArrayLike) -> NDArray[np.float32]:
        return functions["film_z_mm"].evaluate({"focus_m": focus_m, "stop_radius_mm": stop_mm})["film_z_mm"]

    for focus_m, share in ((np.inf, 1.0), (np.inf, 0.31), (3.1 * near_m, 0.77), (1.02 * near_m, 0.93), (near_m, 0.1)):
        found = float(film(focus_m, share * widest))
        assert 1e3 * abs(found - best_focus_z_mm(lens.with_stop_radius(share * widest), focus_m)) < 2 * told + 0.2
        paraxial = float(functions["film_z_paraxial_mm"].evaluate({"focus_m": focus_m})["film_z_mm"])
        assert 1e3 * abs(paraxial - film_z_mm(lens, focus_m)) < 2 * told_paraxial
    distances = near_m / np.linspace(1e-6, 1, 5000)
    for share in (0.07, 0.5, 1.0):
        z = film(distances, share * widest).astype(np.float64)
        assert np.diff(z).min() > -1e-4 and z[-1] > z[0] + 0.05 * (z[-1] - film_z_mm(lens, np.inf))
        ends = film([np.inf, 1e30, 1e9, -1.0, near_m, 0.5 * near_m, 0.0], share * widest)
        assert (ends[:4] == ends[0]).all() and (ends[4:] == ends[4]).all() and ends[4] > ends[0]
    assert film(2.0, 0.0) == film(2.0, widest / 16) and film(2.0, 3 * widest) == film(2.0, widest)


def test_the_film_of_a_model_is_where_its_camera_has_it() -> None:
    file = lens_models.exported("invariants")
    extras, (line, _) = model_extras(load_model(file))
    told = float(re.findall(r"within (\S+) um", line)[0])
    for focus_m, f_number in ((np.inf, None), (0.9, 8.0)):
        made = OnnxCamera(load_model(file), Shot(FILM, focus_m, f_number))
        given = {"focus_m": focus_m, "stop_radius_mm": made.settings["stop_radius_mm"]}
        found = float(extras.functions["film_z_mm"].evaluate(given)["film_z_mm"])
        assert 1e3 * abs(found - made.film.film_z_mm) < told + 1.0 < 3
    fixed, _ = model_extras(load_model(file), stop_mm=made.settings["stop_radius_mm"])
    alone = fixed.functions["film_z_mm"].evaluate({"focus_m": 0.9})["film_z_mm"]
    assert 1e3 * abs(float(alone) - made.film.film_z_mm) < 2
    assert not model_extras(load_model(file), film=False)[0].functions


def test_the_exact_lens_as_a_function(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As C, of rays all over its domain: those of the tracer."""
    header, shader = tmp_path / "a.h", tmp_path / "a.glsl"
    film, placed = lens_source._film, list[Any]()  # the best focus of all distances and stops is sought once
    monkeypatch.setattr(lens_source, "_film", lambda *given: (placed or placed.append(film(*given)) or placed)[0])
    assert main(["export", str(LENS), "--to", "c", "-o", str(header)]) == 0
    assert main(["export", str(LENS), "--to", "c-double", "-o", str(tmp_path / "d.h")]) == 0
    assert not re.search(r"\bfloat\b|\df\b|sqrtf|fmaf", (tmp_path / "d.h").read_text().split("*/", 1)[1])
    assert main(["export", str(LENS), "--to", "glsl", "-o", str(shader)]) == 0
    assert "const float LAIKIN_DOUBLE_GAUSS_50_PUPIL_Z_MM = (-17.27" in shader.read_text()
    size = ["--focal-length", "85", "--coating", "bare"]
    assert main(["export", str(LENS), "--to", "glsl", "-o", str(shader), *size]) == 0
    assert "_EFL_MM = 85.0" in shader.read_text() and "coating bare" in shader.read_text()
    assert main(["export", str(LENS), "--to", "glsl", "-o", str(shader), "--f-number", "4"]) == 2  # an argument
    text = header.read_text()
    domain = lens_models.domain()
    s = sample_domain(domain, 500, 0)
    columns = [c.float().numpy() for c in (s.film_x, s.film_y, s.pupil_x, s.pupil_y, s.wavelength_nm)]
    rays = "\n".join(" ".join(f"{v:.9g}" for v in row) for row in zip(*columns, strict=True))
    name = "laikin_double_gauss_50"
    program = (
        f'#include <stdio.h>\n#include "{header.name}"\nint main(void) {{ float a, b, c, d, w;\n'
        f'while (scanf("%f %f %f %f %f", &a, &b, &c, &d, &w) == 5) {{\n'
        f"const {name}_ray r = {name}(a, b, c, d, w, {name}_film_z_mm(2.0f, STOP), STOP);\n"
        f'printf("%.9g %.9g %.9g %.9g %.9g %d\\n", r.x_mm, r.y_mm, r.dx, r.dy, r.transmittance, r.status); }} }}\n'
    )
    program = program.replace("STOP", f"{name.upper()}_STOP_RADIUS_MAX_MM")
    assert "film_z_paraxial_mm(focus_m): film plane of the paraxial image" in text
    found = np.array(run_compiled("c", program, tmp_path, rays).split(), np.float64).reshape(-1, 6).T
    exact = ExactCamera(lens_models.lens(), Shot(FILM, 2.0), bounds=domain.bounds)
    scene = replace(exact.film.scene, film_z_mm=best_focus_z_mm(lens_models.lens(), 2.0))
    wanted = scene(np.stack(columns[:2]), np.stack(columns[2:4]), columns[4])
    passed = wanted.status == st.PASSED
    assert (found[5] == wanted.status).mean() > 0.998 and 50 < passed.sum() < 500
    assert np.abs(found[:2] - wanted.scene_ray[:2])[:, passed].max() < 5e-4
    assert np.abs(found[2:4] - wanted.scene_ray[3:5])[:, passed].max() < 5e-6
    np.testing.assert_allclose(found[4][passed], wanted.transmittance[passed], rtol=1e-4)


@pytest.mark.skipif(not has_compiler(), reason="no C compiler")
@pytest.mark.parametrize(
    "name",
    [
        "horimoto_fisheye_16",
        "sony_sonnar_55",
        "cooke_anamorphic_42",
        pytest.param("panavision_anamorphic_zoom_21", marks=pytest.mark.whole),
    ],
)
def test_the_exact_lens_in_double_precision_is_the_tracer(name: str) -> None:
    """A fisheye, aspheres, cylinders; cylinders and aspheres in 56 refractions."""
    lens = set_lens(read_any(ROOT / "lenses" / f"{name}.toml"))
    (plane,), domain = pupil_planes_mm([lens], ()), domain_of(lens)
    rays = sample_domain(domain, 5000, seed=3)
    columns = [*rays.columns()[:2], torch.full_like(rays.film_z, domain.film_z_mm[0]), *rays.columns()[3:5]]
    places = dict(zip(("film_x_mm", "film_y_mm", "film_z_mm", "pupil_x_mm", "pupil_y_mm"), columns, strict=True))
    given = {"wavelength_nm": rays.wavelength_nm, "film_z_mm": columns[2][0], "stop_radius_mm": lens.stop_radius_mm}
    source = CompiledSource(lens_program([lens], (), [plane], double=True), double=True)
    found = source.rays({key: np.asarray(value) for key, value in (places | given).items()})
    wanted = trace(lens, camera_rays(*columns, plane), rays.wavelength_nm, transmittance=True)
    passed = wanted.status.numpy() == st.PASSED
    assert passed.sum() > 1000 and np.array_equal(found["status"], wanted.status.numpy())
    assert wanted.transmittance is not None
    for key, value in zip(("x_mm", "y_mm", "z_mm", "dx", "dy", "dz"), wanted.rays, strict=True):
        assert np.abs(found[key] - value.numpy())[passed].max() < 1e-12
    # What absorption leaves by tanh, a rational function that errs by 2.1e-8 (`graph.program`).
    assert np.abs(found["transmittance"] - wanted.transmittance.numpy())[passed].max() < 2.1e-8


@pytest.mark.whole  # as of a model
def test_the_zoom_of_an_exact_lens_is_an_argument() -> None:
    """Between the source's positions: rays of the tracer through the lens zoomed there."""
    lens = read_lens(LENS.with_name("nikon_zoom_70_200.toml"))
    axis, error_mm = gap_axis(zoom_axis(lens), lambda zoom_mm: set_lens(lens, zoom=zoom_mm))
    assert error_mm < 1e-4
    nodes = [set_lens(lens, zoom=v) for v in axis.nodes]
    planes = pupil_planes_mm(nodes, (axis,))
    program, plane = lens_program(nodes, (axis,), planes), number_of((axis,), planes)
    names = ("film_x_mm", "film_y_mm", "pupil_x_mm", "pupil_y_mm", "wavelength_nm", "film_z_mm", "stop_radius_mm")
    for zoom_mm in (146.1, 80.3):
        at = set_lens(lens, zoom=zoom_mm)
        film_z, random = best_focus_z_mm(at, 5.0), np.random.default_rng(3)
        pupil_z = plane if isinstance(plane, float) else float(plane.evaluate({"zoom_mm": zoom_mm})["value"])
        film, pupil = random.uniform(-15, 15, (2, 400)), random.uniform(-16, 16, (2, 400))
        given = dict(zip(names, (*film, *pupil, 550.0, film_z, at.stop_radius_mm), strict=True))
        found = program.evaluate(given | {"zoom_mm": zoom_mm})
        way = np.stack([*(pupil - film), np.full(400, pupil_z - film_z)])
        way /= np.sqrt((way**2).sum(0))
        rays = Rays(*(torch.as_tensor(row) for row in (*film, np.full(400, film_z), *way)))
        out = trace(at, rays, 550.0, towards="scene")
        passed = out.status.numpy() == st.PASSED
        assert passed.sum() > 60 and (found["status"] != out.status.numpy()).mean() < 0.01
        passed &= found["status"] == st.PASSED
        x, dy = out.rays.x.numpy(), out.rays.dy.numpy()
        assert np.abs(found["x_mm"] - x)[passed].max() < 2e-3 and np.abs(found["dy"] - dy)[passed].max() < 2e-5
    assert program.evaluate(given | {"zoom_mm": 60.0})["status"].min() == st.OUTSIDE_DOMAIN


def run_compiled(language: str, source: str, folder: Path, given: str = "", *arguments: str) -> str:
    """What a program prints; skipped where there is no compiler."""
    compiler = shutil.which("c++" if language == "c++" else "cc")
    if compiler is None:
        pytest.skip("no compiler of C++ or C")
    flags = ["-O0", "-Wall", "-Wextra", "-Werror", "-x", language, "-", "-o", str(folder / "a.out"), "-lm"]
    done = subprocess.run([compiler, f"-I{folder}", *flags], input=source, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    command = [str(folder / "a.out"), *arguments]
    return subprocess.run(command, input=given.encode(), capture_output=True, check=True).stdout.decode("latin-1")


@pytest.mark.whole  # the rays of a written camera are above
def test_an_integrator_in_c_plus_plus_sees_what_the_camera_sees(tmp_path: Path) -> None:
    """Its picture of three spheres, pixel by pixel, against rays of the camera and the same spheres in numpy."""
    file, width, height, samples = lens_models.exported("invariants"), 48, 32, 4
    command = ["export", str(file), "--to", "c", "--camera", "--focus", str(FOCUS_M), "--name", "lens"]
    assert main([*command, "-o", str(tmp_path / "lens_camera.h")]) == 0
    source = (ROOT / "experiments" / "integrator.cpp").read_text()
    printed = run_compiled("c++", source, tmp_path, "", str(width), str(samples)).encode("latin-1")
    head = f"P6\n{width} {height}\n255\n".encode()
    assert printed.startswith(head)
    picture = np.frombuffer(printed[len(head) :], np.uint8).reshape(-1, 3).astype(int)
    made = make_camera(file, Shot(FILM, FOCUS_M))
    n = np.arange(width * height * samples)
    a, b, u, v = ((0.5 + n * 1.1673039782614187**-k) % 1.0 for k in (1, 2, 3, 4))
    pixel = n // samples
    film = np.stack([0.5 - (pixel % width + a) / width, (pixel // width + b) / height - 0.5]) * np.array([FILM]).T
    square = np.stack([u, v]).astype(np.float32)
    wanted = np.empty((width * height, 3))
    for channel, nm in enumerate((610.0, 550.0, 465.0)):
        rays = made.sample(film.astype(np.float32), square, np.full(n.size, nm, np.float32))
        seen = rays.weight * radiance(rays.origin_m, rays.direction, channel)
        wanted[:, channel] = 255 * np.sqrt(seen.reshape(-1, samples).mean(1)).clip(0, 1)
    difference = np.abs(picture - wanted)
    assert (difference < 1.5).mean() > 0.995 and picture.std() > 20 and difference.mean() < 0.6


def radiance(origin: NDArray[np.float32], direction: NDArray[np.float32], channel: int) -> NDArray[np.float64]:
    """That of the spheres of experiments/integrator.cpp."""
    text = (ROOT / "experiments" / "integrator.cpp").read_text()
    rows = re.findall(r"^    \{\{(.*?)\}, (\S+)f, \{(.*?)\}\}", text, re.MULTILINE)
    found, nearest = np.full(origin.shape[1], (0.35, 0.45, 0.6)[channel]), np.full(origin.shape[1], np.inf)
    assert len(rows) == 3
    for place, size, colour in rows:
        centre, tint = ([float(t.strip(" f")) for t in part.split(",")] for part in (place, colour))
        to, radius = origin - np.array(centre)[:, None], float(size)
        along = (to * direction).sum(0)
        d = along**2 - (to**2).sum(0) + radius**2
        t = -along - np.sqrt(d.clip(0))
        hit = (d > 0) & (t > 0) & (t < nearest)
        normal = (to + t * direction) / radius
        sun = (normal * np.array([[0.4], [0.7], [0.59]])).sum(0).clip(0)
        found, nearest = np.where(hit, tint[channel] * (0.25 + 0.75 * sun), found), np.where(hit, t, nearest)
    return found


ZOOM = ROOT / "models" / "nikon_zoom_80_200-range.states-64.onnx"
PLANES = ("efl_mm", "film_radius_mm", "film_z_min_mm", "film_z_max_mm", "pupil_z_mm", "pupil_radius_mm")


def test_the_state_of_a_zoom_is_an_argument(tmp_path: Path) -> None:
    """A model of a whole zoom as C: rays, planes and the film of a focus at any state are the model's own."""
    header = tmp_path / "zoom.h"
    assert main(["export", str(ZOOM), "--to", "c", "--name", "zoom", "-o", str(header)]) == 0
    text = header.read_text()
    assert "ZOOM_ZOOM_MIN_MM 80.0886" in text and "ZOOM_ZOOM_MAX_MM 200.30" in text
    assert "zoom_at(float zoom_mm)" in text and "film_z_mm(zoom_mm, focus_m, stop_radius_mm)" in text
    model, states = load_model(ZOOM), (80.0886, 93.7, 151.2, 200.307)
    given, wanted = [], []
    for state in states:
        at = model.at(state)
        random, domain = np.random.default_rng(int(state)), at.card["domain"]
        spread = np.sqrt(random.random((2, 300))) * [[domain["film_radius_mm"]], [0.7 * domain["pupil_radius_mm"]]]
        x, y = np.stack([np.cos(turn := 2 * np.pi * random.random((2, 300))), np.sin(turn)]) * spread
        rays = np.stack([x[0], y[0], x[1], y[1], random.uniform(400, 700, 300)]).astype(np.float32)
        film = np.float32(np.mean(domain["film_z_mm"]))
        given += [(state, film, *ray) for ray in rays.T]
        wanted.append(at.rays(rays[:2], rays[2:4], rays[4], float(film)))
    given += [(79.9, film, *rays.T[0]), (np.nan, film, *rays.T[0])]
    planes = ", ".join(f"zoom_{name}(s)" for name in PLANES)
    program = (
        f'#include <stdio.h>\n#include "{header.name}"\nint main(void) {{ float s, z, a, b, c, d, w;\n'
        'while (scanf("%f %f %f %f %f %f %f", &s, &z, &a, &b, &c, &d, &w) == 7) {\n'
        "const zoom_state state = zoom_at(s);\n"
        "const zoom_ray r = zoom(a, b, c, d, w, z, ZOOM_STOP_RADIUS_MAX_MM, &state);\n"
        'printf("%.9g %.9g %.9g %.9g %.9g %d", r.x_mm, r.y_mm, r.dx, r.dy, r.transmittance, r.status);\n'
        f'printf("{" %.9g" * len(PLANES)} %.9g\\n", {planes}, zoom_film_z_mm(s, 3.0f, 9.0f)); }} }}\n'
    )
    lines = "\n".join(" ".join(f"{v:.9g}" for v in row) for row in given)
    found = np.array(run_compiled("c", program, tmp_path, lines).split(), np.float64).reshape(len(given), -1).T
    assert (found[5, -2:] == st.OUTSIDE_DOMAIN).all()
    for k, (state, rays_of_state) in enumerate(zip(states, wanted, strict=True)):
        part, at = found[:, 300 * k : 300 * k + 300], model.at(state)
        passed = (part[5] == st.PASSED) & (rays_of_state.status == st.PASSED)
        assert (part[5] == rays_of_state.status).mean() > 0.99 and passed.sum() > 50
        assert np.abs(part[:2] - rays_of_state.scene_ray[:2])[:, passed].max() < 5e-4
        assert np.abs(part[2:4] - rays_of_state.scene_ray[3:5])[:, passed].max() < 5e-6
        np.testing.assert_allclose(part[4][passed], rays_of_state.transmittance[passed], atol=1e-4)
        lens, domain = at.card["lens"], at.card["domain"]
        known = [lens["efl_mm"], domain["film_radius_mm"], *domain["film_z_mm"], domain["pupil_z_mm"]]
        np.testing.assert_allclose(part[6:12, 0], [*known, domain["pupil_radius_mm"]], rtol=2e-6)
        f_number = lens["f_number"] * lens["stop_radius_mm"] / 9.0
        film_mm = OnnxCamera(model, Shot(FILM, 3.0, f_number, zoom=state)).film.film_z_mm
        assert abs(part[12, 0] - film_mm) < 4e-3


def test_states_of_a_zoom_are_chosen_when_a_camera_is_written(tmp_path: Path) -> None:
    out = tmp_path / "zoom.h"
    assert main(["export", str(ZOOM), "--to", "c", "--camera", "--zoom", "120", "-o", str(out)]) == 0
    (efl,) = re.findall(r"_EFL_MM (\S+)f\n", out.read_text())
    assert float(efl) == pytest.approx(120, rel=2e-3)


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--to", "onnx", "--camera"], "--to c, glsl ..."),
        (["--to", "c", "--camera", "--fix", "focus=2"], "without --fix"),
        (["--to", "c", "--derivatives"], "--to onnx"),
        (["--to", "c", "--focus", "2", "--film-tilt", "3"], "--film-tilt, --focus: got (without --whole-camera)"),
        (["--to", "c", "--camera", "--zoom", "20"], "zoom"),
        (["--to", "c", "--camera", "--name", "int"], "name"),
    ],
)
def test_what_does_not_go_together(
    words: list[str], said: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = lens_models.exported("invariants")
    assert said in failure(capsys, "export", str(file), *words, "-o", str(tmp_path / "a.h"))
    assert not (tmp_path / "a.h").exists()


def test_the_outline_of_a_camera_in_glsl_is_a_texture(tmp_path: Path) -> None:
    out = tmp_path / "a.glsl"
    assert main(["export", str(lens_models.exported("invariants")), "--to", "glsl", "--camera", "-o", str(out)]) == 0
    text = out.read_text()
    wide, high = (int(n) for n in re.findall(r"texel, (\d+) wide, (\d+) high", text)[0])
    table = np.fromfile(tmp_path / "a.glsl.outline.f32", "<f4").reshape(high, wide)
    assert "in highp sampler2D outline" in text and np.isfinite(table).all() and table.std() > 0
