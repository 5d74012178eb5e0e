"""The exact lens and its models as GLSL compute shaders of OpenGL 4.3: nanoseconds a ray, on a GPU where there is one.

Lenses of 2 to 56 refractions, the polynomials and networks that ship, from the one writer, float32, complete with stop,
rims and transmittance, in turn in one process. Two kinds of work: "stored", rays read from a buffer and results written
to one; "in place", as an integrator has them: rays made of their number, results added up. Then the rays that came back
are held against float64. No window, no package: libEGL by ctypes, the first device that has OpenGL 4.3; without a GPU
that is Mesa's software on one thread (then --rays 16384: short calls). Needs the extra "train" (torch). Writes gpu.md
and gpu.json.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import subprocess
import sys
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from experiments import lab
from experiments.speed import gl_compute
from neurolens.base import status as st
from neurolens.graph.c import Signature
from neurolens.graph.program import (
    FILM_Z,
    RAY,
    SCENE_RAY,
    STATUS,
    STOP,
    STOP_RADIUS,
    TRANSMITTANCE,
    WAVELENGTH,
    Program,
)
from neurolens.graph.scalars import lower
from neurolens.graph.shading import write_glsl
from neurolens.models.file import read_model
from neurolens.models.fitted import FilmRays
from neurolens.models.model import LensModel, Prediction
from neurolens.models.pairs import PairSet, sample_domain, trace_pairs
from neurolens.models.source import fused_program
from neurolens.optics.trace.surfaces import Rays
from neurolens.optics.trace.tracegraph import exact_graph
from neurolens.studies.rays import ray_errors

LENSES = {
    "thorlabs_lb1471_biconvex_50": ("ols-64", "mlp-16x2"),
    "laikin_double_gauss_50": ("ols-36", "ols-60", "mlp-10x1", "mlp-16x2"),
    "ogawa_zoom_70_200": ("ols-64", "mlp-16x2"),
    "panavision_anamorphic_zoom_21": ("ols-64", "mlp-16x2"),
}
EXACT, NOTHING = "exact", "no lens"
WORKS = ("stored", "in place")
OPTIONS = (
    lab.count("rays", 2**21, "of a timed call (default and most 2097152)", least=2**10, most=2**21),
    lab.count("rounds", 15, "rounds (default 15)"),
    lab.ONLY,
    lab.out(),
)
_CHECKED = 20_000
_EACH = 4  # rays of a thread in place
RESULTS = (*SCENE_RAY, TRANSMITTANCE, *STOP, STATUS)

_HEAD = """\
#version 430
layout(local_size_x = {group}) in;
layout(std430, binding = 0) readonly buffer A {{ float rays[]; }};
layout(std430, binding = 1) writeonly buffer B {{ float found[]; }};
layout(std430, binding = 2) readonly buffer C {{ float film_z, stop, film, pupil, shortest, span; }};
"""
_MAIN = {
    "stored": """
void main() {{
    uint i = gl_GlobalInvocationID.x, n = uint(rays.length()) / 5u;
    if (i >= n) return;
    float o[9]; int code;
    float fx = rays[i], fy = rays[n + i], px = rays[2u * n + i], py = rays[3u * n + i], nm = rays[4u * n + i];
    {call};
    for (uint k = 0u; k < 9u; k++) found[k * n + i] = o[k];
    found[9u * n + i] = float(code);
}}
""",
    # A Kronecker sequence of the ray's number in each dimension, within squares inside the discs.
    "in place": """
float share(uint i, uint step) {{ return float((i * step) >> 8u) * 5.9604645e-8; }}
void main() {{
    float sum = 0.0;
    for (uint k = 0u; k < {each}u; k++) {{
        uint i = gl_GlobalInvocationID.x * {each}u + k;
        float o[9]; int code;
        float fx = film * (share(i, 2654435769u) - 0.5), fy = film * (share(i, 1640531527u) - 0.5);
        float px = pupil * (share(i, 3430093283u) - 0.5), py = pupil * (share(i, 2246822519u) - 0.5);
        float nm = shortest + span * share(i, 3266489917u);
        {call};
        for (int k = 0; k < 9; k++) sum += o[k];
        sum += float(code);
    }}
    found[gl_GlobalInvocationID.x] = sum;
}}
""",
}
_NOWHERE = "o = float[9](fx, fy, px, py, nm, film_z, stop, fx, fy); code = 0"
_PLACES = {**dict(zip(RAY, ("fx", "fy", "px", "py"), strict=True)), WAVELENGTH: "nm", FILM_Z: "film_z"}


class Subject(NamedTuple):
    """A lens with its forms; the models share lens and domain."""

    name: str
    model: LensModel
    programs: dict[str, Program]


def subject_of(name: str) -> Subject:
    """A lens of `LENSES`: exact, and its models that ship."""
    models = {kind: read_model(lab.MODELS / f"{name}.{kind}.onnx").at() for kind in LENSES[name]}
    first = next(iter(models.values()))
    exact = lower(exact_graph(first.lens, first.domain.pupil_z_mm, first.domain.wavelength_nm))
    return Subject(name, first, {EXACT: exact, **{kind: fused_program([model]) for kind, model in models.items()}})


class Checked(NamedTuple):
    """Rays of a domain, and their exact answers in float64."""

    rays: FilmRays
    exact: PairSet

    @staticmethod
    def of(subject: Subject, film_z_mm: float | None = None) -> Checked:
        """Rays of a lens's domain, from a film plane there or from any one."""
        domain = subject.model.domain
        rays = on_one_plane(sample_domain(domain, _CHECKED, seed=5))
        rays = rays if film_z_mm is None else replace(rays, film_z=torch.full_like(rays.film_z, film_z_mm))
        return Checked(rays, trace_pairs(subject.model.lens, rays, domain.pupil_z_mm))

    def errors(self, subject: Subject, found: torch.Tensor) -> tuple[float, float]:
        """RMS in um over rays that pass here and in float64, and the share that passes or is blocked wrongly.

        Args:
            found: [10, N], the rows of `RESULTS`.
        """
        passed, truly = found[-1] == st.PASSED, self.exact.status == st.PASSED
        rows = found[:, passed & truly]
        told = Prediction(Rays(*rows[:6]), rows[6], rows[7], rows[8], rows[9].int())
        pairs = self.exact.select(passed & truly)
        known = ray_errors(subject.model.lens, subject.model.domain, pairs, lambda _: told)
        return known.rms_um, float((passed != truly).double().mean())


def shader(program: Program | None, work: str) -> str:
    """The text; no program: the work around a lens."""
    text, call = "", _NOWHERE
    if program is not None:
        s = Signature.of(program, "lens")
        given = [(_PLACES | {STOP_RADIUS: "stop"})[i] for i in s.inputs] + [f"o[{k}]" for k in range(9)] + ["code"]
        text, call = write_glsl(program, "lens", ["A lens that is timed."]), f"lens({', '.join(given)})"
    return _HEAD.format(group=gl_compute.GROUP) + text + _MAIN[work].format(call=call, each=_EACH)


def on_one_plane(rays: FilmRays) -> FilmRays:
    """Film points on the plane of the first: one call."""
    return replace(rays, film_z=rays.film_z[:1].expand(len(rays)).clone())


def columns_of(rays: FilmRays) -> NDArray[np.float32]:
    """[5, N]: film and pupil points, wavelength."""
    columns = (rays.film_x, rays.film_y, rays.pupil_x, rays.pupil_y, rays.wavelength_nm)
    return np.stack([c.numpy() for c in columns]).astype(np.float32)


class ShaderRace:
    """The folder of one race: its jobs, then what came back."""

    def __init__(self, folder: Path, rays: int) -> None:
        self.folder, self.count = folder, rays
        self.jobs: list[dict[str, Any]] = []
        self.checked: dict[str, Checked] = {}

    def add(self, subject: Subject) -> None:
        """The shaders of a lens in both kinds of work, and those whose results come back."""
        name, domain = subject.name, subject.model.domain
        checked, timed = Checked.of(subject), on_one_plane(sample_domain(domain, self.count, seed=5))
        self.checked[name] = checked
        film, pupil = (r * np.sqrt(2.0) for r in (domain.film_radius_mm, domain.pupil_radius_mm))
        low, high = domain.wavelength_nm
        call = [float(checked.rays.film_z[0]), domain.stop_radius_mm, film, pupil, low, high - low]
        arrays = {"call": np.array(call, np.float32), "checked": columns_of(checked.rays), "timed": columns_of(timed)}
        for what, array in arrays.items():
            np.save(self.folder / f"{name}.{what}.npy", array)
        for k, (form, program) in enumerate({NOTHING: None, **subject.programs}.items()):
            for work, each, size in ((WORKS[0], 1, len(RESULTS) * self.count), (WORKS[1], _EACH, self.count)):
                text = self.folder / f"{name}.{k}.{each}.comp"
                text.write_text(shader(program, work))
                job: dict[str, Any] = {"shader": text.name, "call": f"{name}.call.npy", "rays": f"{name}.timed.npy"}
                groups = -(-self.count // (each * gl_compute.GROUP))
                self.jobs.append(job | {"name": f"{name} {form} {work}", "groups": groups, "size": size})
                if program is not None and each == 1:
                    groups = -(-_CHECKED // gl_compute.GROUP)
                    job |= {"rays": f"{name}.checked.npy", "groups": groups, "size": len(RESULTS) * _CHECKED}
                    self.jobs.append(job | {"keep": f"{name}.{form}.npy"})

    def run(self, rounds: int) -> dict[str, Any]:
        """Run the race of `gl_compute` and return its results.

        Raises:
            Unmeasured: no OpenGL 4.3; the message says why.
        """
        (self.folder / "jobs.json").write_text(json.dumps(self.jobs))
        command = [sys.executable, gl_compute.__file__, str(self.folder), str(rounds)]
        one_thread = {"LP_NUM_THREADS": "1", **os.environ}  # Mesa's software alone knows the word
        done = subprocess.run(command, capture_output=True, text=True, check=False, env=one_thread)
        if done.returncode != 0:
            raise lab.Unmeasured(f"experiments gpu: {done.stderr.strip()[-500:]}")
        found: dict[str, Any] = json.loads((self.folder / "found.json").read_text())
        return found

    def errors(self, subject: Subject, form: str) -> tuple[float, float]:
        """The figures of `Checked` for a form."""
        found = np.load(self.folder / f"{subject.name}.{form}.npy").reshape(len(RESULTS), _CHECKED)
        return self.checked[subject.name].errors(subject, torch.from_numpy(found))


def rows_of(subject: Subject, raced: ShaderRace, found: dict[str, Any]) -> list[lab.Row]:
    """The table of a lens, the work around it first: `wrong` is the share of rays passed or blocked otherwise than in
    float64, `ns` least and median by work, `gain` the exact lens's least time over this one's."""
    rows, each = [], 1e9 / raced.count
    for form, program in {NOTHING: None, **subject.programs}.items():
        row: lab.Row = {"lens": subject.name, "refractions": subject.model.lens.refractions, "form": form}
        if program is not None:
            row |= lab.operations_of(program)
            row["rms_um"], row["wrong"] = raced.errors(subject, form)
        seconds = {work: found["seconds"][f"{subject.name} {form} {work}"] for work in WORKS}
        row["ns"] = {work: (each * min(some), each * statistics.median(some)) for work, some in seconds.items()}
        if form != NOTHING:
            exact = {work: min(found["seconds"][f"{subject.name} {EXACT} {work}"]) for work in WORKS}
            row["gain"] = {work: exact[work] / min(some) for work, some in seconds.items()}
        rows.append(row)
    return rows


_NOTES = """\
{renderer} (OpenGL {version}), {rays} rays a call, {rounds} rounds in turn in one process: best (median), and the best
of the exact lens over the best. float32, uniform over film and pupil discs of the domain, blocked rays included (in
place: over squares in them); film plane and stop are numbers of the call, nothing is folded away. "Stored": 20 bytes a
ray read, 40 written; "in place": none read, 4 for {each} rays written. "No lens" is the work around a lens, which is in
every figure. RMS um and wrong (passed or blocked wrongly, of the rays sent): {checked} rays that came back, against the
lens traced in float64.{load}"""
_COLUMNS = lab.columns(
    ("lens", "lens"), ("refractions", "refractions"), ("form", "form"),
    ("operations (roots)", lambda r: f"{r['operations']} ({r['roots']})" if r.get("operations") else None),
    ("RMS um", "rms_um", ".2g"), ("wrong %", "wrong", ".2g", 100),
    *(column for work in WORKS for column in (
        (f"{work}: ns a ray", lambda r, work=work: lab.best_median(*r["ns"][work], form=".3g")),
        ("exact over it", f"gain.{work}", ".2f"),
    )),
)  # fmt: skip


def run(args: argparse.Namespace) -> None:
    """Race all lenses in one process, hold what came back against float64, write the table."""
    lab.quiet_glasses()
    before = os.getloadavg()[0]
    with tempfile.TemporaryDirectory(prefix="neurolens-gpu-") as folder:
        raced = ShaderRace(Path(folder), args.rays)
        subjects = [subject_of(name) for name in lab.chosen(list(LENSES), str, args.only, "gpu")]
        for subject in subjects:
            raced.add(subject)
        result = raced.run(args.rounds)
        rows = [row for subject in subjects for row in rows_of(subject, raced, result)]
    about = {name: result[name] for name in ("renderer", "version")} | {"rays": args.rays, "rounds": args.rounds}
    about["load"] = load = max(before, os.getloadavg()[0])
    busy = f" Load average up to {load:.1f} meanwhile." if load > 1 else ""
    notes = _NOTES.format(**about | {"load": busy}, each=_EACH, checked=_CHECKED)
    parts = [f"`python -m experiments gpu --rays {args.rays}`", notes, lab.machine_line(), lab.table(_COLUMNS, rows)]
    text = lab.page("# Lenses as compute shaders", *parts)
    print(lab.write_results(args.out, "gpu", text, {"machine": lab.machine(), **about, "rows": rows}))
