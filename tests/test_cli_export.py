"""`neurolens export` from outside: C, GLSL and ONNX of a model file, what a scene fixes, bad input in one line."""

from __future__ import annotations

import json
from pathlib import Path

import lens_models
import numpy as np
import pytest
from command_line import failure

from neurolens.cameras.model import load_model
from neurolens.cameras.onnxmaps import OnnxDerivatives, load_inverse
from neurolens.cli import main
from neurolens.modelfile import MODEL_KEY


@pytest.fixture(scope="module")
def file() -> Path:
    return lens_models.exported("invariants")


def test_c_and_glsl(file: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run = tmp_path / "run" / "models"
    run.mkdir(parents=True)
    (run / "one.onnx").write_bytes(file.read_bytes())
    header, shader = tmp_path / "a.h", tmp_path / "a.glsl"
    assert (
        main(["export", str(tmp_path / "run"), "--to", "c", "-o", str(header), "--only", "ray", "--name", "gauss"]) == 0
    )
    assert capsys.readouterr().out.strip() == str(header)
    text = header.read_text()
    assert "gauss_rays(" in text and "stop_radius_mm" not in text[text.index("#ifndef") :]
    fixes = ["--fix", "wavelengths=450,550", "--fix", "focus=1.5", "--fix", "f_number=4", "--json"]
    assert main(["export", str(file), "--to", "glsl", "-o", str(shader), *fixes]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["bands_nm"] == [450.0, 550.0] and told["operations_per_ray"] > 50 and "film_z_mm" not in told["inputs"]
    text = shader.read_text()
    assert "in int band" in text and "film_z_mm" not in text and "Fixed: film plane" in text


@pytest.mark.slow
def test_onnx_for_one_wavelength_promises_what_it_keeps(file: Path, tmp_path: Path) -> None:
    out = tmp_path / "laser.onnx"
    fixes = ["--fix", "wavelengths=550", "--fix", "focus=inf", "--fix", "stop=4"]
    assert main(["export", str(file), "--to", "onnx", "-o", str(out), *fixes]) == 0
    whole, fixed = load_model(file), load_model(out)
    assert fixed.card["domain"]["stop_radius_mm"] == 4.0
    assert 0 < fixed.card["errors"]["rms_um"] < 1000
    film, pupil = np.zeros((2, 3)), np.array([[0.0, 2.0, -3.0], [0.0, 1.0, 2.0]])
    film_z = fixed.film_z_mm[0]
    assert film_z == fixed.film_z_mm[1] < whole.card["lens"]["film_z_mm"]  # in best focus, before the paraxial image
    a, b = (m.rays(film, pupil, 550.0, film_z, stop_radius_mm=4.0) for m in (whole, fixed))
    assert np.abs(a.scene_ray[3:] - b.scene_ray[3:]).max() < 2e-6
    assert np.all(fixed.rays(film, pupil, 500.0).status == 1)
    again = tmp_path / "again.onnx"
    assert main(["export", str(out), "--to", "onnx", "-o", str(again)]) == 0
    assert load_model(again).card["errors"] == fixed.card["errors"]


@pytest.mark.slow
def test_derivatives_and_inverse_maps(file: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Rays through a stop point cross the stop there; the film's derivatives are those of small steps."""
    out = tmp_path / "lens.onnx"
    assert main(["export", str(file), "--to", "onnx", "-o", str(out), "--derivatives", "--inverse", "--json"]) == 0
    told = json.loads(capsys.readouterr().out)["inverse"]
    assert min(told["stop"]["converged"], told["scene"]["converged"]) >= 0.9999
    film, stop = np.array([[0.0, 3.0, -9.0], [0.0, 5.0, 1.0]]), np.array([[0.5, 1.0, -2.0], [0.0, 2.0, -1.0]])
    found = load_inverse(out).through_stop(film, stop, 550.0)
    assert found.status.tolist() == [0, 0, 0] and np.abs(found.stop_xy_mm - stop).max() < 1e-3
    model, pupil, step = load_model(out), found.rays[2:4], 0.02
    slope = OnnxDerivatives(model)(film, pupil, np.full(3, 550.0), model.card["lens"]["film_z_mm"], 4.0).d_film
    ahead, behind = (model.rays(film + [[h], [0]], pupil, 550.0).scene_ray for h in (step, -step))
    assert np.abs((ahead - behind)[3:] / (2 * step) - slope[3:, 0]).max() < 2e-5


def test_bad_input_is_one_line(file: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "a.h"
    old = tmp_path / "old.onnx"
    old.write_bytes(file.read_bytes().replace(MODEL_KEY.encode(), b"x" * len(MODEL_KEY)))
    bare = tmp_path / "bare.onnx"
    bare.write_bytes(file.read_bytes().replace(b'"refractions"', b'"reflections"'))
    base = ["export", file, "--to", "c", "-o", out]
    cases: list[tuple[list[object], list[str]]] = [
        ([*base, "--fix", "wavelengths=300"], ["400 to 700"]),
        ([*base, "--fix", "focus=0.1"], ["focus"]),
        ([*base, "--fix", "film_z=1"], ["film_z"]),
        ([*base, "--fix", "stop=50"], ["stop"]),
        ([*base, "--fix", "stop=nan"], ["--fix", "stop=nan"]),
        ([*base, "--fix", "colour=1"], ["--fix", "wavelengths"]),
        ([*base, "--fix", "stop=3", "--fix", "f_number=4"], ["both"]),
        ([*base, "--only", "stop"], ["--only", "ray"]),
        ([*base, "--name", "1 2"], ["name"]),
        (["export", file, "--to", "onnx", "-o", out, "--only", "ray"], ["--only"]),
        ([*base, "--inverse"], ["--inverse", "--to onnx"]),
        (["export", file, "--to", "onnx", "-o", out, "--fix", "wavelengths=450,550"], ["one wavelength"]),
        (["export", tmp_path / "no.onnx", "--to", "c", "-o", out], ["no.onnx", "missing"]),
        (["export", old, "--to", "c", "-o", out], ["old.onnx", "export it again"]),
        (["export", bare, "--to", "c", "-o", out], ["card", "refractions"]),
        (["export", tmp_path / "empty", "--to", "c", "-o", out], ["empty", "name its file"]),
        (["export", file, "--to", "c", "-o", tmp_path / "no" / "a.h"], ["a.h"]),
        (["export", file, "--to", "fortran", "-o", out], ["fortran"]),
        (["export", file, "--to", "c"], ["-o"]),
    ]
    (tmp_path / "empty").mkdir()
    for args, words in cases:
        line = failure(capsys, *args)
        assert all(word in line for word in words), (args, line)
    assert not out.exists()
