"""A film that is turned and moved: its rays are the lens's own from points of it in space; white light; focus."""

import json
import math
import warnings
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from neurolens.base import status as st
from neurolens.base.errors import InputError, NeurolensWarning
from neurolens.cameras.build import make_camera
from neurolens.cameras.cameragraph import D_FILM
from neurolens.cameras.exact import ExactCamera
from neurolens.cameras.field import field_of
from neurolens.cameras.lensfilm import whole_camera
from neurolens.cameras.model import OnnxCamera, load_model
from neurolens.cameras.pose import FilmPose
from neurolens.cameras.reduced import ReducedDispersion, Vignetted
from neurolens.cameras.sampling import stratified
from neurolens.cli import main
from neurolens.cli.keys import frames_of
from neurolens.graph.compiler import has_compiler
from neurolens.graph.interpret import evaluate
from neurolens.graph.loworder import with_film_derivatives
from neurolens.models.file import packed_lens, unpacked_lens
from neurolens.optics.lens.shot import Shot
from neurolens.optics.readers.lensfile import read_lens
from neurolens.optics.setting.states import set_lens
from neurolens.optics.trace.rays import Rays, trace
from neurolens.pictures.frames import Frame, prepare
from neurolens.pictures.render.pictures import read_metadata

ROOT = Path(__file__).parents[2]
NAME = "laikin_double_gauss_50"
MODEL = f"{NAME}.ols-60"
# Largest angles of tilt-shift lenses, and a corner that the lens's image circle still covers.
SHOT = Shot((24.0, 16.0), 2.0, 4.0, film_tilt_deg=10.0, film_swing_deg=-8.0, film_shift_mm=5.0, film_rise_mm=-4.0,
            runtime="onnxruntime")  # fmt: skip
Array = NDArray[np.float64]


@pytest.fixture(scope="module")
def camera() -> ExactCamera:
    return ExactCamera(read_lens(ROOT / "lenses" / f"{NAME}.toml"), SHOT)


def samples(count: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    film = ((rng.random((2, count)) - 0.5) * [[23.9], [15.9]]).astype(np.float32)
    return film, rng.random((2, count), np.float32), np.full(count, 550.0, np.float32)


def axes() -> Array:
    """The film's x and y [3, 2]: turned by the tilt about x, then with it by the swing about y."""
    tilt, swing = math.radians(10), math.radians(-8)
    about_x = np.array([[1, 0, 0], [0, math.cos(tilt), -math.sin(tilt)], [0, math.sin(tilt), math.cos(tilt)]])
    about_y = np.array([[math.cos(swing), 0, -math.sin(swing)], [0, 1, 0], [math.sin(swing), 0, math.cos(swing)]])
    return (about_y @ about_x)[:, :2]


def in_space(camera: ExactCamera, film: NDArray[Any]) -> Array:
    """Points of the film [3, N] in the lens frame."""
    return np.array([[0], [0], [camera.film.film_z_mm]]) + axes() @ (film - np.array([[5.0], [-4.0]]))


def landed(camera: ExactCamera, origin_m: NDArray[Any], direction: NDArray[Any], nm: NDArray[Any]) -> Array:
    """Film points [2, N] of scene rays that are traced through the lens to the film."""
    start, way = 1e3 * origin_m.astype(np.float64), direction.astype(np.float64)
    start[2] += camera.film.film_z_mm
    rays = Rays(*map(torch.from_numpy, (*(start + 5 * way), *-way)))  # in front of the lens, towards it
    done = trace(camera.lens, rays, torch.from_numpy(nm.astype(np.float64)), towards="film")
    place, along = (np.stack([c.numpy() for c in part]) for part in (done.rays[:3], done.rays[3:]))
    across, normal = axes(), np.cross(*axes().T)
    place[2] -= camera.film.film_z_mm
    place -= along * (normal @ place) / (normal @ along)
    return across.T @ place + [[5.0], [-4.0]]


def test_rays_start_on_the_turned_film(camera: ExactCamera) -> None:
    """A camera ray followed back through the lens meets the film at its film point. Nearly all rays pass."""
    film, square, nm = samples(3000)
    rays = camera.sample(film, square, nm)
    ok = rays.status == st.PASSED
    assert ok.mean() > 0.98
    found = landed(camera, rays.origin_m[:, ok], rays.direction[:, ok], nm[ok])
    assert np.abs(found - film[:, ok]).max() < 2e-3  # float32 both ways


def test_a_shifted_film_sees_what_a_larger_one_sees() -> None:
    """Its film point is that of the larger film, less shift and rise; the light of the axis is the same unit."""
    lens, shot = read_lens(ROOT / "lenses" / f"{NAME}.toml"), Shot((24.0, 16.0), 2.0, 4.0, runtime="onnxruntime")
    moved = ExactCamera(lens, replace(shot, film_shift_mm=5.0, film_rise_mm=-4.0))
    larger = ExactCamera(lens, replace(shot, film_mm=(34.0, 24.0)))
    film, square, nm = samples(2000)
    film = np.round(film * 64) / 64  # so that 5 and 4 mm are taken off without rounding
    one = moved.sample(film, square, nm)
    two = larger.sample(film - np.array([[5], [-4]], np.float32), square, nm)
    assert (one.status == st.PASSED).mean() > 0.98
    for a, b in ((one.origin_m, two.origin_m), (one.direction, two.direction), (one.status, two.status)):
        np.testing.assert_array_equal(a, b)
    np.testing.assert_allclose(one.weight, two.weight, rtol=1e-6)
    # To the right and, for a negative rise, below: the middle of the picture looks there.
    middle = moved.sample(np.zeros((2, 1), np.float32), np.full((2, 1), 0.5, np.float32), nm[:1]).direction[:, 0]
    assert middle[0] > 0.05 and middle[1] < -0.05


def test_what_is_stated_about_the_axis_is_about_that_of_a_moved_film(camera: ExactCamera) -> None:
    """Light is 1 on the axis, in a part of the vignetting and in a field; lateral colour is odd about the axis."""
    camera = camera.compiled() if has_compiler() else camera
    film, square = np.repeat([[5.0], [-4.0]], 64**2, axis=1).astype(np.float32), stratified(64, (550, 550))[0]
    found = Vignetted(camera, "natural", (550, 550)).sample(film, square, np.full(64**2, 550, np.float32))
    assert found.weight.mean() == pytest.approx(1, abs=2e-3)
    field = field_of(camera, 2.0, spectrum=(np.array([550.0]), np.ones(1)))
    assert field.relative_light(np.array([-5 + 4j])) == pytest.approx(1, abs=1e-3)
    assert ReducedDispersion(camera, "lateral").settings["lateral_error_mm"] < 1e-3


@pytest.mark.parametrize("form", ["c", "model"])
def test_c_and_models_see_the_same(form: str, camera: ExactCamera) -> None:
    if form == "c" and not has_compiler():
        pytest.skip("needs a C compiler")
    film, square, nm = samples(2000)
    if form == "c":
        other, limit = camera.compiled(), 2e-5
    else:
        other, limit = make_camera(ROOT / "models" / f"{MODEL}.onnx", SHOT), 1e-3  # type: ignore[assignment]
    one, two = other.sample(film, square, nm), camera.sample(film, square, nm)
    both = (one.status == st.PASSED) & (two.status == st.PASSED)
    assert both.mean() > 0.95
    if form == "c":
        assert np.abs(one.direction - two.direction)[:, both].max() < limit
        assert np.abs(one.weight - two.weight)[both].max() < 1e-3 * two.weight.max()
    else:  # whose pupil is another one: the chief directions of film points agree
        assert np.abs(np.mean((one.direction - two.direction)[:, both], axis=1)).max() < limit


def test_white_light_by_its_integral(camera: ExactCamera) -> None:
    """Of a film point, E / E0 is the integral of T cos of the film's normal over the solid angle of what passes."""
    plane, normal = camera.film.outline.pupil_z_mm, np.cross(*axes().T)

    def integral(point: tuple[float, float]) -> float:
        side, fine = 22.0, 400
        u, v = np.meshgrid(*2 * [(2 * np.arange(fine) + 1) / fine * side - side])
        p = in_space(camera, np.array(point)[:, None])
        d = np.stack([u.ravel(), v.ravel(), np.full(u.size, plane)]) - p
        length = np.sqrt((d * d).sum(0))
        rays = Rays(*map(torch.from_numpy, (*np.broadcast_to(p, d.shape).copy(), *(d / length))))
        done = trace(camera.lens, rays, torch.full((u.size,), 550.0, dtype=torch.float64), transmittance=True)
        through = np.where(done.status.numpy() == 0, done.transmittance.numpy(), 0)  # type: ignore[union-attr]
        return float((through * -(normal @ d) * -d[2] / length**4).sum() * (2 * side / fine) ** 2)

    rng, count = np.random.default_rng(3), 40_000
    square, nm = rng.random((2, count), np.float32), np.full(count, 550.0, np.float32)
    spread = np.linspace(400, 700, count, dtype=np.float32)
    found, wanted = [], []
    for point in ((5.0, -4.0), (11.0, 7.0), (-11.5, 7.5)):  # the first is on the axis
        film = np.broadcast_to(np.float32(point)[:, None], square.shape).copy()
        found.append(camera.sample(film, square, nm).weight.mean())
        wanted.append(integral(point))
    white = camera.sample(np.broadcast_to(np.float32([[5.0], [-4.0]]), square.shape).copy(), square, spread)
    assert white.weight.mean() == pytest.approx(1, rel=5e-3)  # E0 is a mean over wavelengths, as glass has a colour
    assert np.array(found[1:]) / found[0] == pytest.approx(np.array(wanted[1:]) / wanted[0], rel=2e-3)


def test_what_is_in_focus_lies_on_a_tilted_plane(camera: ExactCamera) -> None:
    """Scheimpflug: 1 / distance goes with how far points of the film lie behind the axis's."""
    film = np.array([[5.0, 5.0, 5.0, 5.0, 1.0, 9.0], [-4.0, -8.0, 0.0, 4.0, -4.0, -4.0]])
    sharp, count = [], 2000
    for point in film.T:
        square = np.random.default_rng(5).random((2, count), np.float32)
        rays = camera.sample(
            np.repeat(point[:, None], count, 1).astype(np.float32), square, np.full(count, 550.0, np.float32)
        )
        ok = rays.status == 0
        o, d = (v[:, ok].astype(np.float64) for v in (rays.origin_m, rays.direction))
        m = np.linspace(0.1, 1.5, 1401)  # 1 / m
        spot = [np.var(o[:2] + d[:2] / -d[2] * (o[2] + 1 / k), axis=1).sum() * k * k for k in m]
        sharp.append(m[int(np.argmin(spot))])
    slope, middle = np.polyfit(in_space(camera, film)[2] - camera.film.film_z_mm, sharp, 1)
    assert middle == pytest.approx(0.5, abs=0.03)
    # 1/f = 1/a + 1/b: the film farther by z moves 1/a by -1000 z / b^2, b the image distance in mm (51.0)
    assert slope == pytest.approx(1000 / 51.0**2, rel=0.05)


def test_differentials_are_those_of_neighbouring_film_points(camera: ExactCamera) -> None:
    """With the point of the pupil held: by differences of exact rays from points of the film in space."""
    film, square, nm = samples(50)
    lens = camera.lens_graph()
    graph, numbers = whole_camera(
        camera.film, lens._replace(graph=with_film_derivatives(lens.graph)), ("pupil_mm", "plane_mm")
    )
    given: dict[str, Any] = {"film_mm": film, "square": square, "wavelength_nm": nm[None]}
    given = {k: v.astype(np.float64) for k, v in given.items()} | {k: np.array([[v]]) for k, v in numbers.items()}
    found = evaluate(graph, given | {"outline": camera.film.outline.table.astype(np.float64)})
    pupil = np.vstack([found["pupil_mm"], np.full(50, camera.film.outline.pupil_z_mm)])

    def rays(film: Array) -> Array:
        place = in_space(camera, film)
        plane = place + (pupil - place) * (camera.film.film_z_mm - place[2]) / (pupil[2] - place[2])
        call = {k: np.array([[v]]) for k, v in numbers.items() if k in ("film_z_mm", "stop_radius_mm")}
        return evaluate(lens.graph, {"rays": np.vstack([plane[:2], pupil[:2], nm]), **call})["scene_ray"]

    ok = found["status"][0] == st.PASSED
    assert ok.mean() > 0.9
    for k, step in enumerate(1e-4 * np.eye(2)[:, :, None]):
        slope = (rays(film + step) - rays(film - step)) / 2e-4 * np.array([[1e-3]] * 3 + [[1.0]] * 3)
        assert np.abs(found[D_FILM[k]] - slope)[:, ok].max() < 1e-5 * np.abs(slope[:, ok]).max()


def test_companions_take_the_same_scene_ray(camera: ExactCamera) -> None:
    """Light of another wavelength along the hero's scene ray lands where the companion is said to."""
    film, square, nm = samples(1000)
    waves = np.stack([nm, np.full_like(nm, 450)])
    found = camera.sample_spectrum(film, square, waves)
    lit = (found.weight > 0).all(axis=0)
    assert lit.mean() > 0.9
    places = landed(camera, found.rays.origin_m[:, lit], found.rays.direction[:, lit], waves[1, lit])
    wrong = np.hypot(*(places - found.film_mm[1][:, lit]))
    moved = np.hypot(*(found.film_mm[1] - film)[:, lit])
    assert np.sqrt(np.mean(wrong**2)) < 1e-3 < np.sqrt(np.mean(moved**2))


def test_light_from_the_scene_gives_the_same_picture(camera: ExactCamera) -> None:
    """A luminous wall sends the film as much light as its points find (`contract`, both directions)."""
    _, square, nm = samples(400_000)
    half = np.array([[1.0], [0.8]])  # more than what the film sees at 2 m
    wall = np.vstack([half * (2 * np.random.default_rng(1).random((2, nm.size)) - 1), np.full(nm.size, -2.0)])
    there = camera.to_film((wall + [[0.2], [-0.16], [0]]).astype(np.float32), square, nm)
    inside = (np.abs(there.film_mm) < [[12.0], [8.0]]).all(axis=0)
    light = np.where(inside, there.weight * -there.direction[2], 0).mean() * 4 * half.prod()
    film, square, nm = samples(50_000)
    seen = camera.sample(film, square, nm).weight.mean() * 24 * 16
    assert light == pytest.approx(seen, rel=0.01)
    some = np.flatnonzero(inside & (there.status == st.PASSED))[:1000]
    places = landed(camera, there.origin_m[:, some], there.direction[:, some], nm[:1].repeat(some.size))
    assert np.abs(places - there.film_mm[:, some]).max() < 2e-3


def test_scenes_keys_and_the_command_line_set_it(tmp_path: Path) -> None:
    scene = tmp_path / "tilted.toml"
    text = (ROOT / "experiments" / "scenes" / "grid.toml").read_text()
    scene.write_text(text.replace("[camera]", '[camera]\nfilm_tilt_deg = "0.1rad"\nfilm_rise_mm = "0.2cm"', 1))
    settings = prepare(Frame.of(scene, MODEL, runtime="onnxruntime"), tmp_path / "a.exr").camera.settings
    assert settings["film_tilt_deg"] == pytest.approx(math.degrees(0.1)) and settings["film_rise_mm"] == 2
    keyed = list(frames_of(range(1, 3), ["film-tilt=1:0,2:5deg", "film-shift=1:0,2:3"], {}, "render"))
    assert [(values["film_tilt_deg"], values["film_shift_mm"]) for *_, values in keyed] == [(0, 0), (5, 3)]
    words = ["render", str(scene), "--camera", MODEL, "--film-swing", "3", "--runtime", "onnxruntime", "--quiet"]
    small = ["--width", "16", "--samples", "1", "-o", str(tmp_path / "b.exr")]
    assert main([*words, *small]) == 0
    assert read_metadata(tmp_path / "b.exr")["camera"]["film_swing_deg"] == 3
    header = tmp_path / "camera.h"
    assert main(["export", MODEL, "--to", "c", "--whole-camera", "--film-tilt", "3", "-o", str(header), "--quiet"]) == 0


def test_cameras_without_a_film_to_turn_refuse_it() -> None:
    for name in ("thin", "pinhole", f"thick:{NAME}"):
        with pytest.raises(InputError, match="film_tilt_deg: .*left out"):
            make_camera(name, SHOT)


def stating(folder: Path, tilt_deg: float, shift_mm: float) -> Path:
    """The lens file of `NAME`, of a product that tilts and shifts so far."""
    text = (ROOT / "lenses" / f"{NAME}.toml").read_text(encoding="utf-8")
    file = folder / "shift.toml"
    file.write_text(f"most_tilt_deg = {tilt_deg}\nmost_shift_mm = {shift_mm}\n{text}", encoding="utf-8")
    return file


def test_a_film_beyond_the_mount_of_the_product_is_told_in_a_line_each(tmp_path: Path) -> None:
    """As the lens file states it, which a model's file holds; a lens that is scaled shifts as much farther."""
    lens = read_lens(ROOT / "lenses" / "nikon_pc_e_nikkor_24mm_f3_5d_ed.toml")
    assert (lens.most_tilt_deg, lens.most_shift_mm) == (8.5, 11.5)
    assert set_lens(lens, focal_length_mm=2 * 24.642).most_shift_mm == pytest.approx(23.0, rel=0.01)
    model = load_model(ROOT / "models" / f"{MODEL}.onnx")
    assert packed_lens(model.fitted.lens).keys().isdisjoint({"most_tilt_deg", "most_shift_mm"})

    def said(tilt_deg: float, shift_mm: float) -> list[str]:
        stated = read_lens(stating(tmp_path, tilt_deg, shift_mm))
        packed = json.loads(json.dumps(packed_lens(stated)))
        model.fitted = replace(model.fitted, lens=unpacked_lens(packed))  # type: ignore[misc]
        with warnings.catch_warnings(record=True) as told:
            warnings.simplefilter("always", NeurolensWarning)
            ExactCamera(stated, SHOT)
            OnnxCamera(model, SHOT)
        return [str(warning.message) for warning in told]

    assert said(12.81, 6.41) == []
    exact, modelled = np.array(said(2.0, 3.0)).reshape(2, 2).tolist()
    assert (
        "12.8 degrees of tilt are more than the 2 " in exact[0] and "6.4 mm of shift are more than the 3 " in exact[1]
    )
    assert modelled == [text.replace(str(tmp_path / "shift.toml"), str(model.path)) for text in exact]


def test_flare_tells_of_a_film_beyond_the_mount(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = stating(tmp_path, 2.0, 3.0)
    assert main(["flare", str(file), "--light", "10,5", "--film-tilt", "2.1", "--film-rise", "3", "--json"]) == 0
    (line,) = [line for line in capsys.readouterr().err.splitlines() if "warning" in line]
    assert f"{file}: 2.1 degrees of tilt are more than the 2 of the product" in line


def test_an_upright_film_is_no_pose_and_covers_itself() -> None:
    assert not FilmPose() and FilmPose().covers_mm((36.0, 24.0), 50.0) == (36.0, 24.0)
    assert FilmPose(moved_mm=(5.0, -4.0)).covers_mm((24.0, 16.0), 50.0) == (34.0, 24.0)
