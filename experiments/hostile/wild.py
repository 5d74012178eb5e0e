"""Wild numbers through the tracer and every language that a lens can be written in: one ray has one answer.

A third of the rays are ordinary; of the others each number is, three times in ten, any bits, a special number (NaN,
infinities, denormals, the largest), its own times a power of ten, or up to its range beyond it. The same rays go
through a model, the exact lens and a whole camera with derivatives as C, ONNX, Slang, CUDA, VEX, WGSL, HLSL and GLSL,
and through numpy with the roundings of the language. The exact lens and its camera also meet the tracer, which is no
graph: torch, surface by surface. A status that differs from numpy's is "at an edge" where numpy gives it to some ray
that is a few roundings of the inputs away; else it is wrong. A ray of the tracer is "elsewhere" where numpy's is more
than 1 um, 1 mrad or 0.1% of the light away, and those of rays a few roundings of the inputs from it, too; what the
polynomials of films may miss of the light is allowed besides, on each coated surface. Exit code 1
where one is wrong or elsewhere, or NaN or infinity passes, or a ray that is lost has weight. CUDA and VEX are compiled
as C++, Slang for the processor; the others are run by Mesa. Writes wild.md and wild.json.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
import torch

from experiments import lab
from experiments.languages import RUN, Given, Missing, Rows
from experiments.speed.compiled_source import CompiledSource
from neurolens.base import status as st
from neurolens.base.settings import LIGHT_NM
from neurolens.cameras.build import make_camera
from neurolens.cameras.model import load_model
from neurolens.cameras.shaders.lens_source import lens_program, pupil_planes_mm
from neurolens.cameras.shaders.source import camera_program
from neurolens.graph import program as arithmetic
from neurolens.graph.program import RAY, SCENE_RAY, STOP, Program
from neurolens.models.source import fused_program
from neurolens.optics.lens.prescription import Lens
from neurolens.optics.lens.shot import Shot
from neurolens.optics.setting.pupils import camera_rays
from neurolens.optics.trace.filmfit import FIT
from neurolens.optics.trace.rays import trace

LENS, MODEL = "laikin_double_gauss_50", "laikin_double_gauss_50.ols-36.onnx"
CHUNK = 1 << 17  # rays of one film plane and stop
TRACER = "tracer"
SPECIAL = np.array(
    [np.nan, np.inf, -np.inf, 3.4028235e38, -3.4028235e38, 1e-45, -1e-45, 1.2e-38, 1e20, 0.0, -0.0], np.float32
)
FLAGS = "-O1 -march=native -ffp-contract=off"
TWICE = ("vex", "wgsl", "hlsl", "glsl")  # a b + c is rounded twice
_AWAY = 1e-3  # mm and radians
_FAR_MM, _WIDEST_MM = 1e8, 1e15  # from where float32 steps over a whole lens; of a stop, whose square is a float32
_MOST = 500  # rays of a chunk that are looked at
_NEAR, _ROUNDINGS = 4096, 3e-6  # rays tried around one whose status differs, and how far they are
Ends = Mapping[str, tuple[float, float]]
Runner = Callable[[Mapping[str, Any]], Rows]


@dataclass
class Row:
    """The rays of a form in a language: `edge` and `wrong` statuses differ from numpy's, and so do rays `elsewhere`;
    `not_finite` rays pass."""

    form: str
    language: str
    rays: int = 0
    passed: int = 0
    edge: int = 0
    wrong: int = 0
    elsewhere: int = 0
    not_finite: int = 0
    lit: int = 0
    seconds: float = 0.0
    missing: str = ""


@dataclass
class Form:
    """A program, the range of each input, tables of the caller, runners besides those of shading languages, and
    how many surfaces of an exact lens have films."""

    program: Program
    ends: Ends
    per_call: tuple[str, ...] = ()
    tables: Rows = field(default_factory=dict)
    others: dict[str, Runner] = field(default_factory=dict)
    coated: int = 0


def forms() -> dict[str, Form]:
    """A model, the exact lens and a whole camera at f/2.8, 2 m."""
    model = load_model(lab.MODELS / MODEL)
    card, nodes = model.card["domain"], model.file.nodes
    reach = {"film": card["film_radius_mm"], "pupil": card["pupil_radius_mm"]}
    ends = {name: (-reach[name.split("_")[0]], reach[name.split("_")[0]]) for name in RAY}
    ends |= {"wavelength_nm": tuple(card["wavelength_nm"]), "film_z_mm": tuple(card["film_z_mm"])}
    ends |= {"stop_radius_mm": (0.0, card["stop_radius_mm"])}
    at_call = ("film_z_mm", "stop_radius_mm")
    fused, lens = fused_program(nodes), lab.lens_of(LENS)
    exact = lens_program([lens], (), pupil_planes_mm([lens], ()))

    def by_onnx(rays: Mapping[str, Any]) -> Rows:
        five = np.stack([rays[name] for name in (*RAY, "wavelength_nm")])
        out = model.rays(five[:2], five[2:4], five[4], *(float(rays[name]) for name in at_call))
        found = dict(zip(SCENE_RAY, out.scene_ray, strict=True))
        return found | {
            "transmittance": out.transmittance,
            **dict(zip(STOP, out.stop_xy_mm, strict=True)),
            "status": out.status,
        }

    shot = Shot((36.0, 24.0), focus_m=2.0, f_number=2.8, runtime="onnxruntime")
    camera: Any = make_camera(lab.MODELS / MODEL, shot)
    traced: Any = make_camera(lab.LENSES / f"{LENS}.toml", shot)
    whole = [camera_program(camera.film, camera.lens_graph(), derivatives=True, own_table=own) for own in (False, True)]
    exact_whole = camera_program(traced.film, traced.lens_graph(), own_table=False)

    def by(camera: Any) -> Runner:
        def sample(rays: Mapping[str, Any]) -> Rows:
            film, square = ([rays[a], rays[b]] for a, b in (("film_x_mm", "film_y_mm"), ("u", "v")))
            out = camera.sample(np.stack(film), np.stack(square), rays["wavelength_nm"])
            return {"x_m": out.origin_m[0], "dz": out.direction[2], "weight": out.weight, "status": out.status}

        return sample

    film = {"film_x_mm": (-18.0, 18.0), "film_y_mm": (-12.0, 12.0), "u": (0.0, 1.0), "v": (0.0, 1.0)}
    film |= {"wavelength_nm": tuple(card["wavelength_nm"])}
    return {
        "model": Form(fused, ends, at_call, others={"c": CompiledSource(fused).rays, "onnx": by_onnx}),
        "exact lens": Form(
            exact, ends, at_call,
            others={TRACER: tracer(lens, pupil_planes_mm([lens], ())[0]), "c": CompiledSource(exact).rays},
            coated=coated_surfaces(lens),
        ),
        "exact camera": Form(
            exact_whole, film, tables={"outline": np.asarray(traced.film.outline.table, np.float32)},
            others={"onnx": by(traced), "c": by(traced.compiled())},
        ),
        "whole camera": Form(
            whole[0], film, tables={"outline": np.asarray(camera.film.outline.table, np.float32)},
            others={"c": CompiledSource(whole[1]).rays, "onnx": by(camera)},
        ),
    }  # fmt: skip


def coated_surfaces(lens: Lens) -> int:
    return sum(s.coating is not None for s in lens.surfaces)


def tracer(lens: Lens, pupil_z_mm: float) -> Runner:
    """The exact lens traced by torch in float32; a stop has a radius, and a lens written for visible light no other."""

    def run(rays: Mapping[str, Any]) -> Rows:
        stop, nm = float(rays["stop_radius_mm"]), rays["wavelength_nm"]
        rows = [replace(s, diameter_mm=2 * stop) if s.stop else s for s in lens.surfaces]
        film = [torch.from_numpy(np.asarray(rays[name])) for name in RAY]
        film_z = torch.tensor(float(rays["film_z_mm"]), dtype=torch.float32)
        start = camera_rays(film[0], film[1], film_z, film[2], film[3], pupil_z_mm)
        done = trace(replace(lens, surfaces=tuple(rows)), start, torch.from_numpy(nm), transmittance=True)
        inside = (light[0] <= nm) & (nm <= light[1]) & (0 <= stop <= _WIDEST_MM)
        found = {name: np.asarray(value) for name, value in zip(SCENE_RAY, done.rays, strict=True)}
        return found | {
            "transmittance": np.asarray(done.transmittance),
            "status": np.where(inside, np.asarray(done.status), st.OUTSIDE_DOMAIN),
        }

    light = [LIGHT_NM[0] / st.DOMAIN_SLACK, LIGHT_NM[1] * st.DOMAIN_SLACK]
    return run


def wild(form: Form, count: int, rng: np.random.Generator) -> dict[str, Any]:
    """Rays of every kind; numbers of the call are one each, and one time in ten wild, for no ray passes then."""
    rays: dict[str, Any] = {}
    for name, (low, high) in form.ends.items():
        spread, whole = high - low, name in form.per_call
        n = 1 if whole else count
        beyond = 0.0 if whole else 0.02 * spread
        own = rng.uniform(low - beyond, high + beyond, n).astype(np.float32)
        with np.errstate(over="ignore"):
            kinds: Any = [
                rng.integers(0, 2**32, n, dtype=np.uint32).view(np.float32), rng.choice(SPECIAL, n),
                own * np.float32(10) ** rng.integers(-44, 38, n).astype(np.float32),
                np.float32(low + spread * rng.uniform(-1, 2, n)),
            ]  # fmt: skip
        odd = rng.random(n) < (0.1 if whole else 0.3 * (np.arange(n) >= n // 3))
        own = np.where(odd, np.choose(rng.integers(0, 4, n), kinds), own).astype(np.float32)
        rays[name] = own[0] if whole else own
    return rays | form.tables


def by_numpy(form: Form, rays: Mapping[str, Any], twice: bool) -> Rows:
    """The results of numpy, with two roundings of a b + c where a language has these."""

    def rounded(a: Any, b: Any, c: Any) -> Any:
        return (a * b).astype(np.float32) + c.astype(np.float32)

    with np.errstate(all="ignore"), mock.patch.dict(arithmetic._FOLDED, {"fma": rounded} if twice else {}):
        return form.program.evaluate(rays)


def glsl(form: Form, rays: Mapping[str, Any]) -> Rows:
    """By OpenGL in a process of its own; without tables."""
    if form.tables:
        raise Missing("the OpenGL runner has no textures")
    given = Given(form.program, rays)
    at, names = [f"rays[{k}u * n + i]" for k in range(len(given.rays))], given.names
    text = (
        "#version 430\nlayout(local_size_x = 64) in;\n"
        "layout(std430, binding = 0) readonly buffer A { float rays[]; };\n"
        "layout(std430, binding = 1) writeonly buffer B { float found[]; };\n" + given.text("glsl")
        + f"void main() {{\n    uint i = gl_GlobalInvocationID.x, n = uint(rays.length()) / {len(at)}u;\n"
        + f"    if (i >= n) return;\n{given.declared()}    lens({', '.join([*at, *(f'{o}_' for o in names)])});\n"
        + given.stored("found[{}u * n + i]", "{}_", "float({})") + "}\n"
    )  # fmt: skip
    with tempfile.TemporaryDirectory() as folder:
        shader, sent, out = (Path(folder) / name for name in ("lens.comp", "in.npy", "out.npy"))
        np.save(sent, given.rays)
        shader.write_text(text)
        command: list[Any] = [
            sys.executable,
            str(lab.ROOT / "experiments" / "speed" / "gl_compute.py"),
            shader,
            sent,
            out,
            str(len(names)),
        ]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        if done.returncode == 3:
            raise Missing(done.stderr.strip())
        assert done.returncode == 0, done.stderr
        return given.found(np.load(out))


def runners(form: Form) -> Iterator[tuple[str, Runner]]:
    yield from form.others.items()
    for name, run in RUN.items():
        yield name, lambda rays, run=run: run(Given(form.program, rays, flags=FLAGS))  # type: ignore[misc]
    yield "glsl", lambda rays: glsl(form, rays)


def nearby(form: Form, rays: Mapping[str, Any], i: int, twice: bool) -> Rows:
    """The results of numpy for rays a few roundings from ray i."""
    rng = np.random.default_rng(i)
    around = dict(rays)
    for name in form.ends:
        size = 10 ** rng.uniform(-2, 0, _NEAR) * _ROUNDINGS
        value = np.float64(rays[name] if name in form.per_call else rays[name][i])
        scale = max(abs(value), 1e-3 * max(map(abs, form.ends[name])))
        around[name] = np.float32(value + rng.uniform(-1, 1, _NEAR) * size * scale)
    return by_numpy(form, around, twice)


def judge(row: Row, form: Form, rays: Mapping[str, Any], found: Rows, numpys: Rows, twice: bool) -> None:
    """Count what is wrong with `found`, where numpy gave `numpys`."""
    status = np.asarray(found["status"]).astype(np.int64)
    wanted = np.broadcast_to(numpys["status"], status.shape).astype(np.int64)
    passed = status == st.PASSED
    row.rays += len(status)
    row.passed += int(passed.sum())
    results = np.stack([np.broadcast_to(v, status.shape) for k, v in found.items() if k != "status"])
    row.not_finite += int((passed & ~np.isfinite(results).all(0)).sum())
    if "weight" in found:
        row.lit += int((~passed & (np.asarray(found["weight"]) != 0)).sum())
    if row.language == TRACER:
        limits = {name: _AWAY * (1e-3 if name.endswith("_m") else 1.0) for name in found if name != "status"}
        limits |= {name: _AWAY + FIT * form.coated for name in ("transmittance", "weight") if name in limits}
        away = np.any([np.abs(found[name] - numpys[name]) > limit for name, limit in limits.items()], axis=0)
        for i in np.flatnonzero(away & passed & (wanted == st.PASSED)):
            near = nearby(form, rays, int(i), twice)
            spread = {name: near[name][near["status"] == st.PASSED] for name in limits}
            row.elsewhere += any(
                not v.min() - limits[name] <= found[name][i] <= v.max() + limits[name] for name, v in spread.items()
            )
    other = status != wanted
    if row.language == TRACER:
        # Such rays are lost, and where is a matter of rounding.
        far = np.any([~(np.abs(rays[name]) < _FAR_MM) for name in RAY if name in rays], axis=0)
        other &= ~far | passed | (wanted == st.PASSED)
    some, rest = np.split(np.flatnonzero(other), [_MOST])
    row.wrong += len(rest)  # no language has so many at edges
    for i in some:
        close = bool((nearby(form, rays, int(i), twice)["status"] == status[i]).any())
        row.edge += close
        row.wrong += not close
        if not close and row.wrong <= 3:
            at = {k: float(rays[k] if k in form.per_call else rays[k][i]) for k in form.ends}
            print(
                f"experiments: {row.form}, {row.language}: status {status[i]}, numpy's {wanted[i]}, at {at}",
                file=sys.stderr,
            )


def measure(name: str, form: Form, args: argparse.Namespace, report: Callable[[float], None]) -> list[Row]:
    """All languages side by side, chunk by chunk; slow ones get the first chunks alone."""
    languages = {key: run for key, run in runners(form) if args.only in key}
    rows = {key: Row(name, key) for key in languages}
    rng, chunks = np.random.default_rng(args.seed), -(-args.rays // CHUNK)
    for chunk in range(chunks):
        rays = wild(form, CHUNK, rng)
        wanted: dict[bool, Rows] = {}
        for key, run in languages.items():
            row, twice = rows[key], key in TWICE
            if row.missing or row.seconds > args.seconds:
                continue
            start = time.process_time() + _children()
            try:
                found = run(rays)
            except Missing as reason:
                row.missing = str(reason)
                continue
            row.seconds += time.process_time() + _children() - start
            if twice not in wanted:
                wanted[twice] = by_numpy(form, rays, twice)
            judge(row, form, rays, found, wanted[twice], twice)
        report((chunk + 1) / chunks)
    return list(rows.values())


def _children() -> float:
    import resource

    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def page(rows: list[Row]) -> str:
    shown = lab.columns(
        ("form", "form"), ("language", "language"), ("rays", "rays", ","), ("passed", "passed", ","),
        ("other status, at an edge", "edge"), ("other status, wrong", "wrong"), ("elsewhere", "elsewhere"),
        ("passed with NaN or infinity", "not_finite"),
        ("lost with weight", "lit"), ("CPU s", "seconds", ".0f"), ("", "missing"),
    )  # fmt: skip
    return lab.page(
        "# Wild numbers in every language",
        "`python -m experiments wild`",
        str(__doc__),
        lab.machine_line(),
        lab.table(shown, rows),
    )


OPTIONS = (
    lab.count("rays", 10_000_000, "through each language (default 10000000)"),
    lab.count("seconds", 300, "of the processor, after which a language gets no more rays (default 300)"),
    lab.count("seed", 1, "of the numbers (default 1)", 0),
    lab.option("--only", metavar="TEXT", default="", help="languages whose name holds this text"),
    lab.out(),
)


def run(args: argparse.Namespace) -> int:
    """Send wild numbers; 1 where a promise is broken."""
    rows: list[Row] = []
    for (name, form), report in lab.stages(forms().items(), lambda item: item[0], args.quiet, 300.0):
        rows += measure(name, form, args, report)
    print(lab.write_results(args.out, "wild", page(rows), {"machine": lab.machine(), "rows": rows}))
    return 1 if any(row.wrong + row.elsewhere + row.not_finite + row.lit for row in rows) else 0
