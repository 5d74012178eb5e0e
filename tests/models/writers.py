"""Models in every form: torch in float32, ONNX by onnxruntime, C compiled, GLSL by a software OpenGL."""

import subprocess
import sys
import tempfile
from collections.abc import Mapping, Sequence
from functools import cache
from pathlib import Path

import lens_models
import numpy as np
import onnxruntime
import pytest
import torch
from numpy.typing import NDArray

from experiments.speed.compiled_source import CompiledSource
from neurolens.base.errors import InputError
from neurolens.graph.c import Signature, literal
from neurolens.graph.compiler import find_compiler
from neurolens.graph.program import SCENE_RAY, Program
from neurolens.graph.shading import write_glsl
from neurolens.models.fitted import FilmRays
from neurolens.models.model import LensModel
from neurolens.models.pairs import sample_domain
from neurolens.models.source import fused_program

COLUMNS = ("film_x_mm", "film_y_mm", "pupil_x_mm", "pupil_y_mm", "wavelength_nm")
Rows = dict[str, NDArray[np.float32]]  # by name, as `Program.evaluate` takes and gives them
RUNNER = Path(__file__).parents[2] / "experiments" / "speed" / "gl_compute.py"
HEADS = {"430": "#version 430\n", "310 es": "#version 310 es\nprecision highp float;\nprecision highp int;\n"}


def rays_of(model: LensModel, count: int, seed: int) -> Rows:
    """Rays of the domain, the first three from the axis."""
    s = sample_domain(model.domain, count, seed)
    columns = torch.stack([s.film_x, s.film_y, s.pupil_x, s.pupil_y, s.wavelength_nm]).float().numpy()
    columns[:2, :3] = 0
    return dict(zip(COLUMNS, columns, strict=True))


def written_rays(language: str, kind: str, rays: Mapping[str, object]) -> Rows:
    """Results of `lens_models.model(kind)` in a language for rays (COLUMNS), film_z_mm and stop_radius_mm."""
    if language == "c":
        return _compiled(kind).rays(rays)  # type: ignore[arg-type]
    if language == "glsl":
        return glsl_rays(program(kind), rays)
    if language == "torch":
        return _in_torch(kind, rays)
    feeds = {name: np.float32([rays[name]]) for name in ("film_z_mm", "stop_radius_mm")}
    names = ["scene_ray", "transmittance", "stop_xy_mm", "status"]
    scene, power, stop, status = _session(kind).run(
        names, {"rays": np.stack([rays[name] for name in COLUMNS]), **feeds}
    )
    assert [a.dtype for a in (scene, power, stop, status)] == [np.float32] * 3 + [np.int32]
    found = dict(zip(SCENE_RAY, scene, strict=True))
    return {**found, "transmittance": power, "stop_x_mm": stop[0], "stop_y_mm": stop[1], "status": status}


def _in_torch(kind: str, rays: Mapping[str, object]) -> Rows:
    """In float32."""
    columns = [torch.from_numpy(rays[name]) for name in COLUMNS]  # type: ignore[arg-type]
    plane = torch.full_like(columns[0], rays["film_z_mm"])  # type: ignore[arg-type]
    with torch.no_grad():
        inputs = FilmRays(*columns[:2], plane, *columns[2:])
        out = lens_models.model(kind).predict(inputs, float(np.float32(rays["stop_radius_mm"])))  # type: ignore[arg-type]
    columns = [*out.rays, out.transmittance, out.stop_x, out.stop_y, out.status]
    assert [c.dtype for c in columns] == [torch.float32] * 9 + [torch.int32]
    names = (*SCENE_RAY, "transmittance", "stop_x_mm", "stop_y_mm", "status")
    return dict(zip(names, (c.numpy() for c in columns), strict=True))


@cache
def _session(kind: str) -> onnxruntime.InferenceSession:
    return onnxruntime.InferenceSession(str(lens_models.exported(kind)), providers=["CPUExecutionProvider"])


@cache
def program(kind: str) -> Program:
    return fused_program([lens_models.model(kind)])


@cache
def _compiled(kind: str) -> CompiledSource:
    return compiled(program(kind))


def compiled(program: Program) -> CompiledSource:
    """Without optimisation, quick to compile; that -O3 gives the same is a test of its own."""
    try:
        find_compiler()
    except InputError as reason:
        pytest.skip(f"the C form is not compiled here: {reason}")
    return CompiledSource(program, ("-std=c99", "-O0", "-march=native", "-Wall", "-Wextra", "-Werror"))


def shader(program: Program, head: str, band: int = 0, state: Sequence[float] = ()) -> str:
    """A compute shader that runs the function on every column of buffer 0: rows in the order of the signature."""
    s = Signature.of(program, "lens")
    given = [f"rays[{k}u * n + i]" for k in range(len(s.inputs))] + ([str(band)] if s.bands > 1 else [])
    given += [f"lens_at({', '.join(map(literal, state))})"] if s.state else []
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


def glsl_rays(program: Program, rays: Mapping[str, object], band: int = 0, state: Sequence[float] = ()) -> Rows:
    """Results by name; skips where there is no software OpenGL."""
    s = Signature.of(program, "lens")
    count = len(rays["film_x_mm"])  # type: ignore[arg-type]
    with tempfile.TemporaryDirectory() as folder:
        text, given, out = (Path(folder) / name for name in ("lens.comp", "in.npy", "out.npy"))
        np.save(given, np.stack([np.broadcast_to(np.float32(rays[i]), count) for i in s.inputs]))
        text.write_text(shader(program, HEADS["430"], band, state))
        command = [sys.executable, RUNNER, text, given, out, str(len(s.outputs) + 1)]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        if done.returncode == 3:
            pytest.skip(f"the GLSL form is not run here: {done.stderr.strip()}")
        assert done.returncode == 0, done.stderr
        return dict(zip((*s.outputs, "status"), np.load(out), strict=True))
