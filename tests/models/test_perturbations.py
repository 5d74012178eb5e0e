"""Models of copies: their derivatives beside the exact tracer, their symmetry, and the round model, which stays."""

import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import onnxruntime
import pytest
import torch

from experiments.speed.compiled_source import CompiledSource
from neurolens.base.errors import InputError
from neurolens.cameras.model import OnnxCamera
from neurolens.cameras.onnxlens import load_model
from neurolens.cli import main
from neurolens.models import perturbations
from neurolens.models.copied import Copied, Perturbed, copy_inputs, copy_of
from neurolens.models.cores import DIRECTION, STOP
from neurolens.models.export import export_onnx
from neurolens.models.file import as_stored, read_model
from neurolens.models.fitted import FilmRays
from neurolens.models.model import LensModel
from neurolens.models.pairs import draw
from neurolens.models.perturbations import copy_errors, derivatives, exact_answers, steps_of, with_perturbations
from neurolens.models.source import at_wavelength, copies_program, fused_program
from neurolens.models.targets import film_equivalent
from neurolens.optics.lens.shot import Shot
from neurolens.optics.setting.copies import Off, Tolerances, draws_of, figure_names, perturbed
from neurolens.optics.setting.states import set_lens

MODELS = Path(__file__).parents[2] / "models"
FILE = MODELS / "laikin_double_gauss_50.ols-60.onnx"


@pytest.fixture(scope="module")
def round_model() -> LensModel:
    return read_model(FILE).at()


@pytest.fixture(scope="module")
def model(round_model: LensModel) -> LensModel:
    return with_perturbations(round_model)  # two CPU seconds


@pytest.fixture(scope="module")
def rays(round_model: LensModel) -> FilmRays:
    return draw(round_model.domain, 3000, seed=401)[0]


@pytest.fixture(scope="module")
def drawn(round_model: LensModel) -> Off:
    return next(draws_of(round_model.lens, Tolerances(), 1, 9))[0]


def turned(rays: FilmRays, turn: np.ndarray) -> FilmRays:
    pairs = ((rays.film_x, rays.film_y), (rays.pupil_x, rays.pupil_y))
    (fx, fy), (px, py) = (torch.tensor(turn) @ torch.stack(pair) for pair in pairs)
    return replace(rays, film_x=fx, film_y=fy, pupil_x=px, pupil_y=py)


def turn_of(angle: float, mirrored: bool) -> np.ndarray:
    c, s, m = math.cos(angle), math.sin(angle), -1.0 if mirrored else 1.0
    return np.array([[m * c, -s], [m * s, c]])


def test_derivatives_are_those_of_the_exact_tracer(model: LensModel, rays: FilmRays) -> None:
    """Each element by itself, along x, along y and askew: on the film, near and far, and at the stop."""
    lens, field = model.lens, model.encoding(rays)
    parts, off_stop = list[list[list[float]]](), list[float]()
    plain = model.core(field)[0]
    for name, step in (("decentre_mm", 2e-3), ("tilt_deg", 5e-3)):
        for element, way in ((0, (1, 0)), (2, (0, 1)), (4, (0.6, -0.8))):
            off = Off.none(lens)
            getattr(off, name)[element] = step * np.array(way)
            back = Off(*(-v for v in vars(off).values()))
            ahead, behind = (exact_answers(model, perturbed(lens, o), rays) for o in (off, back))
            exact = (ahead.vectors - behind.vectors) / 2
            found = copy_of(model, off).core(field)[0] - plain
            both = ahead.passed & behind.passed
            um = [film_equivalent(lens, model.domain, v[..., both]) for v in (found - exact, exact)]
            parts.append([[float(v[k].norm()) for k in (0, 1)] for v in um])
            off_stop.append(float((found - exact)[STOP][:, both].norm(dim=0).max()))
    left, whole = np.moveaxis(np.array(parts), 1, 0)  # [perturbation, near or far]
    assert (left < 0.1 * whole).all() and (np.linalg.norm(left, axis=0) < 0.02 * np.linalg.norm(whole, axis=0)).all()
    assert max(off_stop) < 1e-4  # of the stop's radius


def test_a_copy_errs_by_little_of_what_it_changes(model: LensModel) -> None:
    """All figures at once; who passes changes with the copy, too."""
    for off, lens in draws_of(model.lens, Tolerances(), 3, 2):
        errors = copy_errors(model, copy_of(model, off), lens)
        assert errors["change_um"] > 5 and errors["change_error_um"] < 0.03 * errors["change_um"]
        assert errors["rms_um"] < 0.7 and max(errors["false_pass"], errors["false_block"]) < 1e-3


def test_vignetting_shifts_with_the_copy(model: LensModel) -> None:
    """Rims that are far off block others than before: the copy tells most of them."""
    off = replace(Off.none(model.lens), decentre_mm=np.tile([0.3, 0.0], (5, 1)))
    rays = draw(model.domain, 20_000, seed=11)[0]
    copy, exact = copy_of(model, off), exact_answers(model, perturbed(model.lens, off), rays)
    before, after = (m.predict(rays).status == 0 for m in (model, copy))
    assert (before != exact.passed).sum() > 100
    assert (after != exact.passed).sum() < 0.2 * (before != exact.passed).sum()


def test_without_perturbations_rays_are_equal_to_the_bit(
    round_model: LensModel, model: LensModel, rays: FilmRays
) -> None:
    lens = round_model.lens
    for same in (model, copy_of(model, Off.none(lens))):
        found, wanted = same.predict(rays), round_model.predict(rays)
        rows = zip((*found.rays, *found[1:5]), (*wanted.rays, *wanted[1:5]), strict=True)
        assert all(torch.equal(a, b) for a, b in rows)
    counts = [fused_program([m]).count() for m in (model, round_model)]
    assert counts[0] == counts[1]


@pytest.mark.parametrize("mirrored", [False, True])
def test_a_copy_that_is_turned_gives_turned_rays(model: LensModel, rays: FilmRays, drawn: Off, mirrored: bool) -> None:
    """Turned or mirrored together, perturbation and ray give the turned ray; tilts are axial vectors."""
    turn = turn_of(0.7, mirrored)
    tilt = drawn.tilt_deg @ turn.T * (-1 if mirrored else 1)
    other = replace(drawn, decentre_mm=drawn.decentre_mm @ turn.T, tilt_deg=tilt)
    first, second = copy_of(model, drawn).predict(rays), copy_of(model, other).predict(turned(rays, turn))
    matrix = torch.tensor(turn)
    for a, b in ((0, 1), (3, 4)):
        wanted = matrix @ torch.stack([first.rays[a], first.rays[b]])
        np.testing.assert_allclose(torch.stack([second.rays[a], second.rays[b]]), wanted, atol=1e-11)
    assert torch.equal(first.status, second.status)


def test_a_tilted_sphere_is_a_decentred_one(round_model: LensModel, rays: FilmRays) -> None:
    """Of a concentric meniscus both spheres turn about a point of the axis: a tilt moves their common centre."""
    front, back = round_model.lens.surfaces[:2]
    concentric = replace(back, radius_mm=front.radius_mm - front.thickness_mm)
    model = replace(
        round_model, lens=replace(round_model.lens, surfaces=(front, concentric, *round_model.lens.surfaces[2:]))
    )
    bent, _ = steps_of(model.lens, Tolerances())
    found = derivatives(model, [bent[0], bent[5]], rays)
    centre_mm = front.radius_mm - front.thickness_mm / 2
    decentre, tilt = found.vectors[..., found.whole]
    scale = decentre.abs().amax((1, 2), keepdim=True) * math.radians(centre_mm)
    np.testing.assert_allclose(tilt / scale, math.radians(centre_mm) * decentre / scale, atol=2e-5)
    assert float(tilt[DIRECTION].abs().max()) > 1e-4


def test_a_copy_in_every_form(model: LensModel, rays: FilmRays, drawn: Off) -> None:
    """One wavelength, fewer gates, and C in float32 say what the copy says."""
    (copy,) = as_stored([copy_of(model, drawn)])
    assert isinstance(copy.core, Copied)
    one = replace(rays, wavelength_nm=torch.full_like(rays.wavelength_nm, 550.0))
    wanted, fixed = copy.predict(one), at_wavelength(copy, 550.0).predict(one)
    passed = wanted.status == 0
    for a, b in zip(wanted.rays, fixed.rays, strict=True):
        np.testing.assert_allclose(a[passed], b[passed], atol=1e-12)
    (set_first,) = as_stored([at_wavelength(model, 550.0)])
    assert isinstance(set_first.core, Perturbed)
    for a, b in zip(wanted.rays, copy_of(set_first, drawn).predict(one).rays, strict=True):
        np.testing.assert_allclose(a[passed], b[passed], atol=2e-5)
    kept = [0, 2, 3]
    assert torch.equal(copy.core.keep(kept)(copy.encoding(one))[1], copy.core(copy.encoding(one))[1][kept])
    film = one.select(slice(0, 500))
    columns = dict(
        zip(("film_x_mm", "film_y_mm", "pupil_x_mm", "pupil_y_mm", "wavelength_nm"), film.rows.numpy(), strict=True)
    )
    z = float(film.film_z[0])
    found = CompiledSource(fused_program([copy])).rays(
        {**columns, "film_z_mm": z, "stop_radius_mm": copy.domain.stop_radius_mm}
    )
    again = copy.predict(replace(film, film_z=torch.full_like(film.film_z, z)))
    np.testing.assert_array_equal(found["status"], again.status)
    for name, row in zip(("dx", "dy"), again.rays[3:5], strict=True):
        np.testing.assert_allclose(found[name], row, atol=2e-6)


def test_a_copy_is_focused_as_its_exact_lens(model: LensModel, tmp_path: Path) -> None:
    """Rays of one azimuth, which suffice for a round lens, had placed the film of such a copy 0.6 mm off."""
    off = Off.none(model.lens)
    off.decentre_mm[2] = -0.1, 0.14  # which leaves the paraxial focus where it is
    shot = Shot((36.0, 24.0), 5.0, f_number=2.8, focus_mode="best")
    film_mm = []
    for each in (Off.none(model.lens), off):
        file = export_onnx(copy_of(model, each), tmp_path / "copy.onnx")
        camera = OnnxCamera(load_model(file), shot)
        exact = set_lens(perturbed(model.lens, each), f_number=2.8, focus_m=5.0, focus_mode="best")
        film_mm.append((camera.film.film_z_mm, exact.film_z_mm))
    (plain, wanted), (found, moved) = film_mm
    assert found - plain == pytest.approx(moved - wanted, abs=0.005) and abs(plain - wanted) < 0.005


def test_what_is_off_is_an_input(model: LensModel, rays: FilmRays, drawn: Off, tmp_path: Path) -> None:
    """C and ONNX of one file make the copy of `copy_of`, and the lens itself; beyond a limit no ray passes."""
    (model,) = as_stored([model])
    assert isinstance(model.core, Perturbed)
    inputs, limits = copy_inputs(model), model.core.limits
    assert len(inputs) == 51 and inputs["decentre_y_mm_s02"] == pytest.approx(0.02)
    assert "radius_percent_s05" not in inputs and "thickness_mm_s12" not in inputs  # the stop, and the film's place
    names = figure_names(model.lens)
    moved = replace(Off.none(model.lens), tilt_deg=np.eye(5, 2, -3) * [1, 0])
    assert moved.figures[names.index("tilt_x_deg_s09")] == 1 and moved.figures.sum() == 1
    assert np.array_equal(Off.of(model.lens, drawn.figures).figures, drawn.figures)
    rows, stop, z = rays.rows.numpy().astype(np.float32), model.domain.stop_radius_mm, float(rays.film_z[0])
    columns: dict[str, Any] = dict(
        zip(("film_x_mm", "film_y_mm", "pupil_x_mm", "pupil_y_mm", "wavelength_nm"), rows, strict=True)
    ) | {"film_z_mm": z, "stop_radius_mm": stop}
    file = export_onnx(model, tmp_path / "copies.onnx")
    session = onnxruntime.InferenceSession(file, providers=["CPUExecutionProvider"])
    for off in (drawn, Off.none(model.lens)):
        wanted = copy_of(model, off).predict(replace(rays, film_z=torch.full_like(rays.film_z, z)))
        passed, state = (wanted.status == 0).numpy(), off.figures[limits != 0].astype(np.float32)
        program = CompiledSource(copies_program([model]), state=state.tolist()).rays(columns)
        call = {"rays": rows, "film_z_mm": [z], "stop_radius_mm": [stop], "state": state}
        ray, _, crossing, status = session.run(None, {k: np.asarray(v, np.float32) for k, v in call.items()})
        assert (program["status"] != wanted.status.numpy()).sum() <= 2 and (status != wanted.status.numpy()).sum() <= 2
        for k, name in ((0, "x_mm"), (1, "y_mm"), (3, "dx"), (4, "dy")):
            for found in (program[name], ray[k]):
                np.testing.assert_allclose(found[passed], wanted.rays[k][passed], atol=2e-5 if k < 3 else 2e-6)
        np.testing.assert_allclose(crossing[0, passed], wanted.stop_x[passed], atol=2e-5)
    state[0] = 1.01 * limits[0]
    call["state"] = state
    assert set(session.run(["status"], {k: np.asarray(v, np.float32) for k, v in call.items()})[0]) == {1}
    with pytest.raises(InputError, match="one at most"):
        copies_program([model, model])


def test_the_command_writes_models_of_copies(
    model: LensModel, rays: FilmRays, tmp_path: Path, capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    """A folder of models; from the one with derivatives the same copies come again, without a fit."""
    monkeypatch.setattr(perturbations, "with_perturbations", lambda fitted, limits: model)
    monkeypatch.setattr(perturbations, "_TIMES", (1, 5))
    words = ["copies", str(FILE), "--number", "1", "--seed", "9", "--json", "-o"]
    assert main([*words, str(tmp_path / "a")]) == 0
    data = json.loads(capsys.readouterr().out)
    assert len(data["elements"]) == 5
    ready = tmp_path / "a" / "laikin_double_gauss_50.ols-60-copies.onnx"
    errors = read_model(ready).card["errors"]
    assert errors["copies"]["decentre_mm"] == 5 * 0.02 and errors["copies"]["change_error_um"] < 1
    assert read_model(ready).card["copies"]["decentre_x_mm_s00"] == pytest.approx(5 * 0.02)
    assert main(["export", str(ready), "--to", "glsl", "-o", str(tmp_path / "a.glsl")]) == 0
    text = (tmp_path / "a.glsl").read_text()
    assert "_state laikin_double_gauss_50_at(float decentre_x_mm_s00, float decentre_y_mm_s00, " in text
    assert "radius_percent_s12 0.5" in " ".join(text.replace("*", " ").split())
    assert main([*words[:1], str(ready), *words[2:], str(tmp_path / "b")]) == 0
    (copy,), (again,) = ([p for p in (tmp_path / f).glob("*-001.onnx")] for f in "ab")
    first, second = read_model(copy), read_model(again)
    assert first.card["lens"]["name"].endswith(", copy 1") and first.card["errors"] == second.card["errors"]
    assert main(["evaluate", str(copy), "--rays", "1000"]) == 2
    assert "a copy's errors are on its card" in capsys.readouterr().err
    z, stop = float(rays.film_z[0]), first.at().domain.stop_radius_mm
    rows = rays.rows.numpy()
    found = load_model(copy).rays(rows[:2], rows[2:4], rows[4], z, stop)
    wanted = first.at().predict(replace(rays, film_z=torch.full_like(rays.film_z, z)))
    passed = (wanted.status == 0).numpy() & (found.status == 0)
    assert passed.sum() > 1000
    np.testing.assert_allclose(found.scene_ray[3:5, passed], torch.stack(wanted.rays[3:5])[:, passed], atol=2e-6)


def test_what_has_no_such_derivatives_is_refused(round_model: LensModel, model: LensModel, drawn: Off) -> None:
    with pytest.raises(InputError, match="one with derivatives"):
        copy_of(round_model, drawn)
    with pytest.raises(InputError, match="10 vectors and 39 figures"):
        copy_of(model, replace(drawn, index=drawn.index[1:]))
    network = read_model(MODELS / "brendel_tessar_100.mlp-16x2.onnx").at()
    with pytest.raises(InputError, match="a polynomial of a round lens"):
        with_perturbations(network)
    core = model.core
    assert isinstance(core, Perturbed)
    with pytest.raises(ValueError, match="begin with those of the round core"):
        replace(core, exponents=core.exponents[::-1])
