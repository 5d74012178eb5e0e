"""Models as GLSL: checked by glslang, run by a software OpenGL, and held against the float64 model."""

from __future__ import annotations

import shutil
import subprocess
import sys
from dataclasses import replace
from functools import cache
from pathlib import Path

import lens_models
import numpy as np
import pytest
import torch

from neurolens.base import status as st
from neurolens.graph.c import Signature
from neurolens.graph.glsl import write_glsl
from neurolens.graph.program import SCENE_RAY, Program
from neurolens.optics.paraxial import first_order
from neurolens.surrogates.assemble import ALL
from neurolens.surrogates.domain import sample_domain
from neurolens.surrogates.model import LensModel
from neurolens.surrogates.source import FREE, fused_program
from neurolens.surrogates.specialise import Fix, fixed_models

COUNT = 20_000
RUNNER = Path(__file__).parents[1] / "gl_compute.py"
HEADS = {"430": "#version 430\n", "310 es": "#version 310 es\nprecision highp float;\nprecision highp int;\n"}


def shader(program: Program, head: str, band: int = 0) -> str:
    """A compute shader that runs the function on every column of buffer 0: rows in the order of the signature."""
    s = Signature.of(program, "lens")
    given = [f"rays[{k}u * n + i]" for k in range(len(s.inputs))] + ([str(band)] if s.bands > 1 else [])
    given += [*(f"o[{k}]" for k in range(len(s.outputs))), "code"]
    return (
        head
        + "layout(local_size_x = 64) in;\n"
        + "layout(std430, binding = 0) readonly buffer A { float rays[]; };\n"
        + "layout(std430, binding = 1) writeonly buffer B { float found[]; };\n"
        + write_glsl(program, "lens", ["A model in a test."])
        + f"void main() {{\n    uint i = gl_GlobalInvocationID.x, n = uint(rays.length()) / {len(s.inputs)}u;\n"
        + f"    if (i >= n) return;\n    float o[{len(s.outputs)}]; int code;\n    lens({', '.join(given)});\n"
        + "".join(f"    found[{k}u * n + i] = o[{k}];\n" for k in range(len(s.outputs)))
        + f"    found[{len(s.outputs)}u * n + i] = float(code);\n}}\n"
    )


def run(program: Program, columns: dict[str, np.ndarray], tmp_path: Path, band: int = 0) -> dict[str, np.ndarray]:
    """Results by name; skips where there is no software OpenGL."""
    s = Signature.of(program, "lens")
    count = len(columns["film_x_mm"])
    np.save(tmp_path / "in.npy", np.stack([np.broadcast_to(np.float32(columns[i]), count) for i in s.inputs]))
    (tmp_path / "lens.comp").write_text(shader(program, HEADS["430"], band))
    files = [str(tmp_path / name) for name in ("lens.comp", "in.npy", "out.npy")]
    rows = len(s.outputs) + 1
    done = subprocess.run([sys.executable, str(RUNNER), *files, str(rows)], capture_output=True, text=True, check=False)
    if done.returncode == 3:
        pytest.skip(f"the GLSL form is not run here: {done.stderr.strip()}")
    assert done.returncode == 0, done.stderr
    return dict(zip((*s.outputs, "status"), np.load(tmp_path / "out.npy"), strict=True))


@cache
def programs() -> dict[str, tuple[Program, tuple[LensModel, ...], Fix]]:
    """Every kind of core, and one with tables for three wavelengths."""
    found = {}
    for kind in lens_models.KINDS:
        models = (lens_models.model(kind),)
        found[kind] = (fused_program(models), models, FREE)
    model = lens_models.model("invariants")
    fixed = Fix((), model.domain.film_z_mm[0], 0.6 * model.domain.stop_radius_mm)
    models = fixed_models(model, Fix((450.0, 550.0, 650.0), fixed.film_z_mm, fixed.stop_radius_mm))
    found["fixed"] = (fused_program(models, ALL, fixed), models, fixed)
    return found


@pytest.mark.parametrize("version", HEADS)
@pytest.mark.parametrize("kind", [*lens_models.KINDS, "fixed"])
def test_glslang_takes_it(kind: str, version: str, tmp_path: Path) -> None:
    validator = shutil.which("glslangValidator")
    if validator is None:
        pytest.skip("the GLSL form is not compiled here: no glslangValidator (Debian: glslang-tools)")
    text = shader(programs()[kind][0], HEADS[version])
    for name, body, good in (("good.comp", text, True), ("bad.comp", text.replace("out int status", ""), False)):
        (tmp_path / name).write_text(body)
        done = subprocess.run([validator, str(tmp_path / name)], capture_output=True, text=True, check=False)
        assert (done.returncode == 0) == good, done.stdout


@pytest.mark.parametrize("kind", [*lens_models.KINDS, "fixed"])
def test_software_opengl_agrees_with_the_model(kind: str, tmp_path: Path) -> None:
    program, models, fixed = programs()[kind]
    band = len(models) - 1
    model = models[band]
    d = model.domain
    s = sample_domain(d, COUNT, 3)
    s = replace(s, film_z=torch.full_like(s.film_z, d.film_z_mm[0]))
    names = ("film_x_mm", "film_y_mm", "film_z_mm", "pupil_x_mm", "pupil_y_mm", "wavelength_nm")
    columns = {n: c.float().numpy() for n, c in zip(names, s.columns()[:6], strict=True)}
    found = run(program, {**columns, "stop_radius_mm": np.float32(d.stop_radius_mm)}, tmp_path, band)
    with torch.no_grad():
        expected = model.predict(s)
    status = expected.status.numpy()
    assert np.mean(found["status"] != status) < 1e-3
    passed = (status == st.PASSED) & (found["status"] == st.PASSED)
    assert passed.mean() > 0.01
    scene = np.stack([found[name] for name in SCENE_RAY])
    point, direction = np.split(torch.stack(list(expected.rays)).numpy(), 2)
    efl_um = 1e3 * abs(first_order(model.lens).efl_mm)
    assert np.quantile(efl_um * np.linalg.norm(scene[3:] - direction, axis=0)[passed], 0.99) < 0.05
    assert np.quantile(np.linalg.norm(scene[:3] - point, axis=0)[passed], 0.99) < 2e-4
    assert np.abs(found["transmittance"] - expected.transmittance.numpy())[passed].max() < 2e-5
    # Where nothing rounds otherwise, C, GLSL and the numpy evaluation are one list of steps.
    same = program.evaluate({**columns, "film_z_mm": d.film_z_mm[0], "stop_radius_mm": d.stop_radius_mm}, band)
    assert np.abs(found["dx"] - same["dx"])[passed].max() < 3e-6
    outside = {**columns, "film_x_mm": columns["film_x_mm"] + 3 * np.float32(d.film_radius_mm)}
    away = run(program, {**outside, "stop_radius_mm": np.float32(d.stop_radius_mm)}, tmp_path, band)
    assert np.all(away["status"] == st.OUTSIDE_DOMAIN)
