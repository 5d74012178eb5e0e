"""A tilted film: its rays are the lens's own from points of the film in space; white light; what is in focus."""

import math
from pathlib import Path

import numpy as np
import pytest
import torch

from neurolens.base import status as st
from neurolens.base.errors import InputError
from neurolens.cameras.build import make_camera
from neurolens.cameras.exact import ExactCamera
from neurolens.cli import main
from neurolens.cli.keys import frames_of
from neurolens.graph.compiler import has_compiler
from neurolens.optics.lens.shot import Shot
from neurolens.optics.readers.lensfile import read_lens
from neurolens.optics.trace.rays import Rays, trace
from neurolens.pictures.frames import Frame, prepare
from neurolens.pictures.render.pictures import read_metadata

ROOT, TILT = Path(__file__).parents[2], math.radians(5)
NAME = "laikin_double_gauss_50"
SHOT = Shot((36.0, 24.0), 2.0, 4.0, film_tilt_deg=5.0, runtime="onnxruntime")


@pytest.fixture(scope="module")
def camera() -> ExactCamera:
    return ExactCamera(read_lens(ROOT / "lenses" / f"{NAME}.toml"), SHOT)


def samples(count: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    film = ((rng.random((2, count)) - 0.5) * [[34.0], [23.0]]).astype(np.float32)
    return film, rng.random((2, count), np.float32), np.full(count, 550.0, np.float32)


def test_rays_start_on_the_turned_film(camera: ExactCamera) -> None:
    """A camera ray followed back through the lens meets the turned film at its film point."""
    film, square, nm = samples(3000)
    rays = camera.sample(film, square, nm)
    ok = rays.status == st.PASSED
    assert ok.mean() > 0.9
    z0 = camera.film.film_z_mm
    start, way = (v[:, ok].astype(np.float64) for v in (rays.origin_m * 1e3, rays.direction))
    start[2] += z0
    start, way = start + 5 * way, -way  # in front of the lens, towards it
    given = Rays(*map(torch.from_numpy, (*start, *way)))
    done = trace(camera.lens, given, torch.full((int(ok.sum()),), 550.0), towards="film")
    x, y, z, dx, dy, dz = (c.numpy() for c in done.rays)
    reach = (np.sin(TILT) * y - np.cos(TILT) * (z - z0)) / (np.cos(TILT) * dz - np.sin(TILT) * dy)
    found = np.stack([x + reach * dx, (y + reach * dy) / math.cos(TILT)])
    assert np.abs(found - film[:, ok]).max() < 2e-3  # float32 both ways


@pytest.mark.parametrize("form", ["c", "model"])
def test_c_and_models_see_the_same(form: str, camera: ExactCamera) -> None:
    if form == "c" and not has_compiler():
        pytest.skip("needs a C compiler")
    film, square, nm = samples(2000)
    if form == "c":
        other, limit = camera.compiled(), 2e-5
    else:
        other, limit = make_camera(ROOT / "models" / f"{NAME}.ols-60.onnx", SHOT), 1e-3  # type: ignore[assignment]
    one, two = other.sample(film, square, nm), camera.sample(film, square, nm)
    both = (one.status == st.PASSED) & (two.status == st.PASSED)
    assert both.mean() > 0.85
    if form == "c":
        assert np.abs(one.direction - two.direction)[:, both].max() < limit
        assert np.abs(one.weight - two.weight)[both].max() < 1e-3 * two.weight.max()
    else:  # whose pupil is another one: the chief directions of film points agree
        assert np.abs(np.mean((one.direction - two.direction)[:, both], axis=1)).max() < limit


def test_white_light_by_its_integral(camera: ExactCamera) -> None:
    """Of a film point, E / E0 is the integral of T cos of the film's normal over the solid angle of what passes."""
    z0, plane = camera.film.film_z_mm, camera.film.outline.pupil_z_mm

    def integral(x: float, y: float) -> float:
        side = 14.0 + 30 * math.sin(TILT)
        u, v = np.meshgrid(*2 * [(np.arange(400) + 0.5) / 200 * side - side])
        q = np.stack([u.ravel(), v.ravel(), np.full(u.size, plane)])
        p = np.array([x, y * math.cos(TILT), z0 + y * math.sin(TILT)])
        d = q - p[:, None]
        length = np.sqrt((d * d).sum(0))
        rays = Rays(*map(torch.from_numpy, (*np.broadcast_to(p[:, None], d.shape).copy(), *(d / length))))
        done = trace(camera.lens, rays, torch.full((u.size,), 550.0, dtype=torch.float64), transmittance=True)
        through = np.where(done.status.numpy() == 0, done.transmittance.numpy(), 0)  # type: ignore[union-attr]
        cosine = (d[1] * math.sin(TILT) - d[2] * math.cos(TILT)) / length
        return float((through * cosine * -d[2] / length**3).sum() * (side / 200) ** 2)

    rng, count = np.random.default_rng(3), 40_000
    square, nm = rng.random((2, count), np.float32), np.full(count, 550.0, np.float32)
    axis = integral(0.0, 0.0)
    for point in ((0.0, 0.0), (0.0, 11.0), (10.0, -9.0)):
        film = np.broadcast_to(np.float32(point)[:, None], square.shape).copy()
        found = camera.sample(film, square, nm).weight.mean()
        assert found == pytest.approx(integral(*point) / axis, rel=5e-3)


def test_what_is_in_focus_lies_on_a_tilted_plane(camera: ExactCamera) -> None:
    """Scheimpflug: 1 / distance goes with the place on the film."""
    ys, sharp, count = np.array([-8.0, -4.0, 0.0, 4.0, 8.0]), [], 2000
    for y in ys:
        film = np.broadcast_to(np.float32([[0], [y]]), (2, count)).copy()
        square = np.random.default_rng(5).random((2, count), np.float32)
        rays = camera.sample(film, square, np.full(count, 550.0, np.float32))
        ok = rays.status == 0
        o, d = (v[:, ok].astype(np.float64) for v in (rays.origin_m, rays.direction))
        m = np.linspace(0.2, 1.5, 2601)  # 1 / m
        spot = [np.var(o[:2] + d[:2] / -d[2] * (o[2] + 1 / k), axis=1).sum() * k * k for k in m]
        sharp.append(m[int(np.argmin(spot))])
    slope, middle = np.polyfit(ys, sharp, 1)
    assert middle == pytest.approx(0.5, abs=0.02)
    # 1/f = 1/a + 1/b: the film farther by y sin moves 1/a by -1000 y sin / b^2, b the image distance in mm (51.0)
    assert slope == pytest.approx(1000 * math.sin(TILT) / 51.0**2, rel=0.05)


def test_differentials_are_those_of_neighbouring_film_points(camera: ExactCamera) -> None:
    """Along rays of one pupil point: the point stays as the film point moves, where the outline does not."""
    film, _, nm = samples(200)
    middle = np.full_like(film, 0.5)  # the centre of the pupil
    moved = camera.sample_differentials(film * 0.3, middle, nm).differentials
    assert moved is not None
    upright = ExactCamera(camera.lens, Shot((36.0, 24.0), 2.0, 4.0, runtime="onnxruntime"))
    plain = upright.sample_differentials(film * 0.3, middle, nm).differentials
    assert plain is not None
    # To first order in the tilt, x keeps its step and y is shortened by cos: within the tilt's share of the slope.
    assert np.abs(moved.direction[:, 0] / plain.direction[:, 0] - 1)[0].max() < 0.05
    assert np.abs(moved.direction[:, 1] / plain.direction[:, 1] - 1)[1].max() < 0.05


def test_scenes_keys_and_the_command_line_set_it(tmp_path: Path) -> None:
    scene = tmp_path / "tilted.toml"
    text = (ROOT / "experiments" / "scenes" / "grid.toml").read_text()
    scene.write_text(text.replace("[camera]", '[camera]\nfilm_tilt_deg = "0.1rad"', 1))
    frame = Frame.of(scene, NAME, runtime="onnxruntime", focal_length_mm=50.0)
    assert prepare(frame, tmp_path / "a.exr").camera.settings["film_tilt_deg"] == pytest.approx(math.degrees(0.1))
    keyed = list(frames_of(range(1, 3), ["film-tilt=1:0,2:5deg"], {}, "render"))
    assert [values["film_tilt_deg"] for *_, values in keyed] == [0, 5]
    words = ["render", str(scene), "--camera", NAME, "--film-tilt", "3", "--runtime", "onnxruntime", "--quiet"]
    small = ["--width", "16", "--samples", "1", "-o", str(tmp_path / "b.exr")]
    assert main([*words, *small]) == 0
    assert read_metadata(tmp_path / "b.exr")["camera"]["film_tilt_deg"] == 3
    header = tmp_path / "camera.h"
    assert main(["export", NAME, "--to", "c", "--whole-camera", "--film-tilt", "3", "-o", str(header), "--quiet"]) == 0


def test_cameras_without_a_film_to_turn_refuse_it() -> None:
    for name in ("thin", "pinhole", f"thick:{NAME}"):
        with pytest.raises(InputError, match="film_tilt_deg: .*left out"):
            make_camera(name, SHOT)
