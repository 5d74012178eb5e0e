"""Gradients by the adjoint of a program: beside differences, closed forms, 50 digits, and as written CUDA C++."""

from __future__ import annotations

import ctypes
import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path

import mpmath
import numpy as np
import pytest
import torch

from neurolens.graph.adjoint import INNER, OUTER, adjoint
from neurolens.graph.c import Signature
from neurolens.graph.program import RAY, Expr, Program
from neurolens.graph.shading import REGISTERS, Cuda
from neurolens.optics.lens.shot import Shot
from neurolens.programs.torch import LensCamera, step_by_step

ROOT = Path(__file__).parents[2]
POINTS = np.array([[0.3, -0.4, 1.7, 0.9, -2.5], [0.8, 0.5, -0.6, 1.9, 0.7]])


def program_of(formula: Callable[[Program, Expr, Expr], Expr]) -> Program:
    program = Program()
    program.outputs["value"] = formula(program, program.input("x"), program.input("y"))
    return program


def gradients(program: Program, points: np.ndarray, outer: float = 1.0, by: str = "xy") -> np.ndarray:
    """Of the value by each of these inputs, [len(by), N] in float64."""
    back = adjoint(program, ["value"], list(by))
    given = torch.from_numpy(np.vstack([points, np.full(points.shape[1], outer)]))
    found = step_by_step(back, ("x", "y", f"{OUTER}value"), {}, {})(given)
    return found[[list(back.outputs).index(f"{INNER}{name}") for name in by]].numpy()


FORMULAE: dict[str, tuple[Callable[[Program, Expr, Expr], Expr], Callable[[float, float], float]]] = {
    "sums": (lambda p, x, y: x + y - (-x) * 3.0, lambda x, y: x + y + 3 * x),
    "products": (lambda p, x, y: p.fma(x, y, x * x), lambda x, y: x * y + x * x),
    "quotients": (lambda p, x, y: (x + 4.0) / (y * y + 1.0), lambda x, y: (x + 4) / (y * y + 1)),
    "roots": (lambda p, x, y: p.op("sqrt", x * x + y * y), lambda x, y: mpmath.sqrt(x * x + y * y)),
    "floors": (lambda p, x, y: p.op("floor", x) * y, lambda x, y: mpmath.floor(x) * y),
    "largest": (lambda p, x, y: p.op("max", x * 2.0, y), lambda x, y: max(2 * x, y)),
    "least": (lambda p, x, y: p.op("min", x * 2.0, y), lambda x, y: min(2 * x, y)),
    "limits": (lambda p, x, y: p.op("clamp", x, 1.5) * y, lambda x, y: max(min(x, 1.5), -1.5) * y),
    "choices": (lambda p, x, y: p.select(x, y, x * x, y * x), lambda x, y: x * x if x <= y else y * x),
    "polynomials": (
        lambda p, x, y: p.horner(x, [1.0, y, 0.0, y * y, -2.0]) * x,
        lambda x, y: (1 + y * x + y * y * x**3 - 2 * x**4) * x,
    ),
    "tanh": (lambda p, x, y: p.tanh(x * y) * x, lambda x, y: mpmath.tanh(x * y) * x),
}


@pytest.mark.parametrize("name", FORMULAE)
def test_each_rule_has_the_slope_of_fifty_digits(name: str) -> None:
    formula, exact = FORMULAE[name]
    found = gradients(program_of(formula), POINTS, outer=1.3)
    with mpmath.workdps(50):
        wanted = [[1.3 * float(mpmath.diff(exact, tuple(p), n)) for n in ((1, 0), (0, 1))] for p in POINTS.T.tolist()]
    # tanh is a rational function within 2.1e-8, whose slope is taken as that of tanh
    np.testing.assert_allclose(found.T, wanted, rtol=1e-6 if name == "tanh" else 1e-13, atol=1e-14)
    for row, by in enumerate("xy"):  # the other is a number that does not move
        np.testing.assert_allclose(
            gradients(program_of(formula), POINTS, 1.3, by)[0], found[row], rtol=1e-13, atol=1e-14
        )


def test_the_middle_of_the_film_has_no_slope_of_its_radius() -> None:
    """The distance from the axis has no derivative there; a NaN would spoil the gradients of a whole picture."""
    radius = program_of(FORMULAE["roots"][0])
    assert not gradients(radius, np.zeros((2, 1))).any()
    camera = LensCamera(ROOT / "models" / "laikin_double_gauss_50.ols-36.onnx", Shot((36.0, 24.0), 2.0))
    film, square = torch.zeros(4, 2, requires_grad=True), torch.rand(4, 2, requires_grad=True)
    rays = camera(film, square)
    (rays.origin.sum() + rays.weight.sum()).backward()
    assert film.grad is not None and bool(torch.isfinite(film.grad).all()) and float(film.grad.abs().max()) < 1


def test_gradients_come_in_the_order_asked_for() -> None:
    """Inputs that a program does not take have none: a lens of unknown dispersion has no wavelength."""
    back = adjoint(program_of(lambda p, x, y: x * y + y), ["value"], ["y", "wavelength_nm", "x"])
    assert list(back.outputs) == ["by_y", "by_wavelength_nm", "by_x"]
    given = torch.tensor([[2.0], [3.0], [1.0]])
    assert step_by_step(back, ("x", "y", f"{OUTER}value"), {}, {})(given)[:, 0].tolist() == [3.0, 0.0, 3.0]


NETWORK, EXACT = "models/laikin_double_gauss_50.mlp-10x1.onnx", "lenses/laikin_double_gauss_50.toml"


def camera_program(spec: str = NETWORK) -> tuple[LensCamera, Program, dict[str, torch.Tensor]]:
    camera = LensCamera(ROOT / spec, Shot((36.0, 24.0), 2.0), dtype=torch.float64)
    lens = camera._lens
    tables = {"outline": torch.from_numpy(lens._tables["outline"].astype(np.float64))}
    return camera, lens.program, tables


@pytest.mark.parametrize("spec", [NETWORK, EXACT])
def test_a_camera_has_the_gradients_of_torch(spec: str) -> None:
    """Reverse mode of torch itself through the steps of the program, in float64; tanh within 1e-6."""
    camera, program, tables = camera_program(spec)
    numbers = {name: torch.tensor(v, dtype=torch.float64) for name, v in camera._lens._numbers.items()}
    rows = ("film_x_mm", "film_y_mm", "u", "v", "wavelength_nm")
    g = torch.Generator().manual_seed(3)
    low, span = torch.tensor([[-18.0, -12, 0, 0, 400]]).T, torch.tensor([[36.0, 24, 1, 1, 300]]).T
    given = (low + span * torch.rand(5, 3000, generator=g)).double().requires_grad_()
    found = dict(zip(program.outputs, step_by_step(program, rows, numbers, tables)(given), strict=True))
    names = [name for name in program.outputs if name != "status"]
    outer = torch.rand(len(names), 3000, generator=g, dtype=torch.float64) - 0.5
    (wanted,) = torch.autograd.grad(sum((found[n] * o).sum() for n, o in zip(names, outer, strict=True)), given)
    back = adjoint(program, names, rows)
    turned = step_by_step(back, (*rows, *(f"{OUTER}{n}" for n in names)), numbers, tables)
    by = dict(zip(back.outputs, turned(torch.cat([given.detach(), outer])), strict=True))
    passed = found["status"] == 0
    assert 0.5 < float(passed.double().mean()) < 1
    for k, row in enumerate(rows):
        gradient = by[f"{INNER}{row}"]
        assert not gradient[~passed].any()
        off = (gradient - wanted[k])[passed].abs() / wanted[k][passed].abs().mean()
        assert float(off.max()) < 1e-5


def test_gradients_cost_less_than_three_times_the_rays() -> None:
    """Operations of written code, the steps of the rays among them."""
    models = [f"models/laikin_double_gauss_50.{form}.onnx" for form in ("ols-36", "mlp-16x2")]
    for spec, most in ((models[0], 2.0), (models[1], 2.0), (EXACT, 2.2)):
        lens = camera_program(spec)[0]._lens
        rays = sum(lens.program.count().values())
        assert sum(lens.adjoint(by_light=False).count().values()) < most * rays
        assert sum(lens.adjoint(by_light=True).count().values()) < 2.6 * rays


def test_a_way_back_in_parts_keeps_little_and_finds_the_same() -> None:
    """A double Gauss: the same to rounding, less than half of the numbers kept, at most three times the operations."""
    camera, program, tables = camera_program(EXACT)
    numbers = {name: torch.tensor(v, dtype=torch.float64) for name, v in camera._lens._numbers.items()}
    rows = ("film_x_mm", "film_y_mm", "u", "v", "wavelength_nm")
    names = [name for name in program.outputs if name != "status"]
    whole, cut = (adjoint(program, names, rows[:4], registers) for registers in (0, REGISTERS))
    kept = {cut.steps[k].arguments[0] for k in cut.live() if cut.steps[k].kind == "kept"}
    assert 0 < len(kept) < whole.most_waiting() / 2 and "kept" not in whole.count()
    assert sum(cut.count().values()) < 3 * sum(program.count().values())
    g = torch.Generator().manual_seed(3)
    low, span = torch.tensor([[-18.0, -12, 0, 0, 400]]).T, torch.tensor([[36.0, 24, 1, 1, 300]]).T
    given = torch.cat([low + span * torch.rand(5, 500, generator=g), torch.rand(len(names), 500, generator=g) - 0.5])
    ways = (*rows, *(f"{OUTER}{n}" for n in names))
    found, wanted = (step_by_step(back, ways, numbers, tables)(given.double()) for back in (cut, whole))
    scale = wanted.abs().mean(1, keepdim=True).clamp_min(1e-300)
    assert list(cut.outputs) == list(whole.outputs) and float(((found - wanted) / scale).abs().max()) < 1e-9


@pytest.mark.skipif(not shutil.which("g++"), reason="no C++ compiler")
@pytest.mark.parametrize("spec", ["models/laikin_double_gauss_50.ols-36.onnx", "lenses/cooke_triplet_50.toml"])
def test_kernels_are_the_program_as_cplusplus(spec: str, tmp_path: Path) -> None:
    """The text that NVRTC compiles for a GPU, on the host: rays and gradients, those of an exact lens in parts."""
    camera, program, tables = camera_program(spec)
    back, outline = camera._lens.adjoint(by_light=False), np.ascontiguousarray(tables["outline"].float())
    cut = adjoint(program, [n for n in program.outputs if n != "status"], [*RAY[:2], "u", "v"], REGISTERS)
    assert ("kept" in cut.count()) is (spec == "lenses/cooke_triplet_50.toml")
    rng = np.random.default_rng(5)
    for number, (one, alike) in enumerate(((program, program), (cut, back))):
        s = Signature.of(one, "lens")
        rows = {name: rng.uniform(-1, 1, 500).astype(np.float32) for name in s.per_ray}
        rows |= {"film_x_mm": rng.uniform(-15, 15, 500), "film_y_mm": rng.uniform(-10, 10, 500)}
        rows |= {"u": rng.random(500), "v": rng.random(500), "wavelength_nm": rng.uniform(420, 680, 500)}
        given = np.stack([rows[name] for name in s.per_ray]).astype(np.float32)
        library = tmp_path / f"lens{number}.so"
        text = Cuda(one, "lens").kernel()
        command = ["g++", "-O1", "-shared", "-fPIC", "-Werror", "-x", "c++", "-", "-o", str(library)]
        subprocess.run(command, input=text, text=True, check=True)
        call = np.array([camera._lens._numbers[name] for name in s.per_call], np.float32)
        out = np.full((len(s.outputs) + 1, 500), np.nan, np.float32)
        pointers = [a.ctypes.data_as(ctypes.c_void_p) for a in (given, call, outline, out)]
        ctypes.CDLL(str(library)).lens_rays(*pointers[:3], ctypes.c_int(len(outline)), pointers[3], ctypes.c_int(500))
        wanted = alike.evaluate(rows | {k: v for k, v in camera._lens._numbers.items()} | {"outline": outline})
        np.testing.assert_array_equal(out[-1], wanted["status"])
        for name, found in zip(s.outputs, out, strict=False):
            scale = np.abs(wanted[name][out[-1] == 0]).mean()
            np.testing.assert_allclose(found[out[-1] == 0], wanted[name][out[-1] == 0], atol=2e-5 * scale, rtol=2e-4)
