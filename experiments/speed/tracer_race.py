"""The exact lens as C beside a tracer written by hand, on the same rays.

The hand-written tracer (shared/data/reference_tracer, beside this project; without it only ours is timed) is C++ with
intrinsics for spheres: one to three vectors interleaved, with divisions and roots by estimates and Newton's steps, or
by the machine's own. It takes the mean of both polarisations at each surface; ours follows the polarisation, and is
timed with the mean, too, which is the same work, and in double precision. Glass is bare and clear, as in the other,
and goes by n_d and V_d; aspheres and cylinders of the longest lens are spheres here. Writes tracer_race.md and
tracer_race.json.
"""

from __future__ import annotations

import argparse
import ctypes
import math
import shutil
import subprocess
import tempfile
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from experiments import lab
from experiments.speed.compiled_source import CompiledSource, program_candidate
from experiments.speed.fused_speed import Case
from neurolens.graph.compiler import FLAGS, find_compiler
from neurolens.graph.scalars import lower
from neurolens.models.fitted import Domain, FilmRays
from neurolens.models.pairs import domain_of, sample_domain
from neurolens.optics.lens.figures import SPHERE
from neurolens.optics.lens.glass import LINE_C_NM, LINE_D_NM, LINE_F_NM, cauchy, index_of
from neurolens.optics.lens.prescription import Lens, Medium, Surface
from neurolens.optics.trace.tracegraph import exact_graph
from neurolens.studies.speed import FUSED_BATCHES, Call, Candidate, Unavailable

REFERENCE = lab.ROOT.parent / "shared" / "data" / "reference_tracer"
CASES = (
    Case("thorlabs_lb1471_biconvex_50.toml", None, math.inf),
    Case("laikin_double_gauss_50.toml", None, math.inf),
    Case("ogawa_zoom_70_200.toml", None, math.inf, configuration="72mm"),
    Case("canon_ef_70_200mm_f2_8l_is_ii_usm.toml", None, math.inf),
    Case("panavision_anamorphic_zoom_21.toml", None, math.inf),
)
EXACT, DOUBLE = "exact C", "exact C, double precision"
OURS = {EXACT: True, "exact C, mean of polarisations": False}
WAYS = {"Newton's steps": (), "the machine's roots": ("-DNOFAST",)}
VECTORS = (1, 2, 3)
_FLAGS = ("-std=c++17", "-O3", "-march=native")
_RUN = """
extern "C" void run(size_t n, float fz, float sr, void **a)
{
    float **f = (float **)a;
    hand<Lens>(n, f[0], f[1], f[2], f[3], f[4], fz, %sf, sr, f[5], f[6], f[7], f[8], f[9], f[10], f[11], f[12], f[13],
               (int *)a[14]);
}
"""


def by_figures(surface: Surface) -> Surface:
    """The surface as a bare sphere with its glass by n_d and V_d."""
    surface = replace(surface, figure=SPHERE, coating=None, absorbs_as=None)
    if surface.glass is None:
        return surface
    d, f, c = (float(index_of(surface, nm)) for nm in (LINE_D_NM, LINE_F_NM, LINE_C_NM))
    return replace(surface, glass=None, n_d=d, V_d=(d - 1) / (f - c))


def dispersion(medium: Surface | Medium) -> tuple[float, ...]:
    """A, B and C of Cauchy's formula."""
    n_d = float(medium.n_d)
    return tuple(map(float, cauchy(n_d, medium.V_d))) if medium.V_d and n_d != 1 else (n_d, 0.0, 0.0)


def prescription(lens: Lens) -> str:
    """The lens as the hand-written tracer takes it, from the film on."""
    surfaces, behind = lens.surfaces[::-1], [dispersion(m) for m in lens.media[-2::-1]]
    glasses = list(dict.fromkeys([(1.0, 0.0, 0.0), *behind]))
    rows: dict[str, Sequence[float]] = {
        "c": [float(s.curvature) for s in surfaces],
        "gap": [0.0, *(float(s.thickness_mm) for s in surfaces[1:])],
        "r2": [s.semi_diameter_mm**2 for s in surfaces],
        **dict(zip(("ma", "mb", "mc"), zip(*glasses, strict=True), strict=True)),
    }
    whole = {"stop": [int(s.stop) for s in surfaces], "id": range(len(surfaces))[::-1]}
    whole["med"] = [glasses.index(g) for g in behind]
    text = f"static constexpr int n = {len(surfaces)}, nm = {len(glasses)};\n"
    text += f"static constexpr float zlast = {float(lens.vertices_mm[len(surfaces) - 1]):.9e}f;\n"
    for name, row in rows.items():
        text += f"static constexpr float {name}[] = {{{', '.join(f'{np.float32(v):.9e}f' for v in row)}}};\n"
    for name, numbers in whole.items():
        text += f"static constexpr int {name}[] = {{{', '.join(map(str, numbers))}}};\n"
    return f"struct Lens {{\n{text}}};\n"


def has_avx512() -> bool:
    """Test whether Linux lists AVX-512 among the features of this processor."""
    file = Path("/proc/cpuinfo")
    return file.is_file() and "avx512f" in file.read_text(encoding="utf-8")


def compiled(flags: Sequence[str], text: str) -> Any:
    """The function `run` of a C++ text, by g++.

    Raises:
        Unavailable: g++ fails.
    """
    with tempfile.TemporaryDirectory(prefix="neurolens-peer-") as folder:
        command = ["g++", *flags, "-shared", "-fPIC", "-x", "c++", "-", "-o", f"{folder}/run.so"]
        done = subprocess.run(command, input=text, text=True, capture_output=True, check=False)
        if done.returncode:
            raise Unavailable(next((line for line in done.stderr.splitlines() if "error" in line), "g++ fails"))
        return ctypes.CDLL(f"{folder}/run.so").run


class Hand:
    """The hand-written tracer for a lens, compiled.

    Raises:
        Unavailable: it is not there, or not compiled here.
    """

    def __init__(self, lens: Lens, pupil_z_mm: float, options: Sequence[str]) -> None:
        if not (REFERENCE / "hand2.hpp").is_file() or shutil.which("g++") is None:
            raise Unavailable(f"{REFERENCE.name} and g++ are not both here")
        two, three = "fma(set1(L::mb[m]),u,", "fma(fma(set1(L::mc[m]),u,set1(L::mb[m])),u,"
        text = (REFERENCE / "hand2.hpp").read_text(encoding="utf-8").replace("#pragma once", "")
        text = text.replace(two, three) + prescription(lens) + _RUN % f"{pupil_z_mm:.9e}"
        avx2 = () if has_avx512() else ("-DUSE256", "-Dvsqrt1=vsqrt", "-Dvsqrt2=vsqrt")
        self.run = compiled([*_FLAGS, *avx2, *options], text)
        self.run.argtypes = [ctypes.c_size_t, ctypes.c_float, ctypes.c_float, ctypes.c_void_p]

    def prepared(self, rays: FilmRays, stop_radius_mm: float) -> tuple[Call, list[np.ndarray[Any, Any]]]:
        """A call that traces rays, and its results: point, direction, transmittance, crossing with the stop, status."""
        # It does whole sets of vectors, also behind the last ray.
        x, y, z, *rest = (np.pad(c.numpy().astype(np.float32), (0, 64), mode="edge") for c in rays.columns())
        status = np.empty(len(x), np.int32)
        arrays = [x, y, *rest[:3], *(np.empty_like(x) for _ in range(9)), status]
        pointers = (ctypes.c_void_p * len(arrays))(*(a.ctypes.data for a in arrays))

        def call(kept: Any = arrays) -> None:
            self.run(len(rays), float(z[0]), stop_radius_mm, pointers)

        return call, [a[: len(rays)] for a in arrays[5:]]


def measure(case: Case, rounds: int, report: lab.Report) -> list[lab.Row]:
    """Race ours and the hand-written tracer through one lens; of each, how many rays have another status than ours."""
    lens = case.lens()
    lens = replace(lens, surfaces=tuple(by_figures(s) for s in lens.surfaces))
    domain = domain_of(lens, film_radius_mm=case.film_radius_mm, focus_m=(math.inf, case.near_m))
    wide = domain.pupil_z_mm, domain.wavelength_nm
    programs = {name: lower(exact_graph(lens, *wide, polarised=polarised)) for name, polarised in OURS.items()}
    rays = sample_domain(domain, max(FUSED_BATCHES), seed=3)
    rays = replace(rays, film_z=rays.film_z * 0 + domain.film_z_mm[0])
    names = ("film_x_mm", "film_y_mm", "film_z_mm", "pupil_x_mm", "pupil_y_mm", "wavelength_nm")
    columns: dict[str, Any] = dict(zip(names, map(np.asarray, rays.columns()), strict=False))
    columns |= {"film_z_mm": domain.film_z_mm[0], "stop_radius_mm": domain.stop_radius_mm}
    ours = CompiledSource(programs[EXACT]).rays(columns)["status"]
    field, other = [program_candidate(name, p, domain) for name, p in programs.items()], dict.fromkeys(programs, 0)
    programs[DOUBLE] = lower(exact_graph(lens, *wide, double=True))
    field.append(program_candidate(DOUBLE, programs[DOUBLE], domain, double=True))
    other[DOUBLE] = int((CompiledSource(programs[DOUBLE], double=True).rays(columns)["status"] != ours).sum())
    for way, options in WAYS.items():
        for vectors in VECTORS:
            name = f"by hand, {vectors} vector{'s' * (vectors > 1)}, {way}"
            made = cache(lambda vectors=vectors, options=options: Hand(lens, wide[0], (*options, f"-DW={vectors}")))
            field.append(hand_candidate(name, made, domain))
            with suppress(Unavailable):
                run, out = made().prepared(rays, domain.stop_radius_mm)
                run()
                other[name] = int((out[-1] != ours).sum())
    about = {"file": case.file, "lens": lens.name, "refractions": lens.refractions}
    rows: dict[str, lab.Row] = {c.name: about | {"name": c.name, "other_statuses": other.get(c.name)} for c in field}
    for name, program in programs.items():
        rows[name] |= lab.operations_of(program)
    return lab.race_rows(rows, field, domain, rounds, lambda name: {EXACT: EXACT}, report)


def hand_candidate(name: str, made: Any, domain: Domain) -> Candidate:
    """The hand-written tracer in a race."""
    return Candidate(name, lambda rays: made().prepared(rays, domain.stop_radius_mm)[0], FUSED_BATCHES)


_COLUMNS = lab.columns(
    ("lens", "lens"), ("refractions", "refractions"), ("tracer", "name"), ("operations", "operations"),
    ("ns per ray", lab.times_of), ("other statuses", "other_statuses"),
    ("exact C takes, times this", f"speedup.{EXACT}", ".2f"),
)  # fmt: skip
_NOTES = """\
One thread, {wide}, float32, {rounds} rounds in turn in one process (best; median in brackets), each at its best batch.
Glass is bare and clear in both. Rays uniform over film and pupil disc of the domain, blocked ones included; of {rays}
of them those with another status than ours are counted (in double precision: of the same rays before they are
rounded). Ours by {compiler} {flags}."""
OPTIONS = (lab.ONLY, lab.ROUNDS, lab.out())


def run(args: argparse.Namespace) -> None:
    """Measure lens by lens; rows of other lenses from this machine are kept."""
    lab.quiet_glasses()
    flags, counts = " ".join(FLAGS), {"rounds": int(args.rounds or 20), "rays": max(FUSED_BATCHES)}

    def page(rows: Sequence[lab.Row]) -> str:
        compiler, wide = Path(find_compiler()).name, "AVX-512" if has_avx512() else "AVX2"
        notes = _NOTES.format(**counts, flags=flags, compiler=compiler, wide=wide)
        head = "# The exact lens as C beside a tracer written by hand", "`python -m experiments tracer`"
        return lab.page(*head, notes, lab.load_line(rows), lab.table(_COLUMNS, rows))

    lab.resume(
        args, "tracer_race", {c.file: c for c in lab.chosen(CASES, lambda c: c.file, args.only, "tracer")},
        lambda case, report: measure(case, counts["rounds"], report), lambda row: row["file"], page,
        facts={"machine": lab.machine(), "flags": flags}, about=lambda rows: counts, again=True,
        order=[case.file for case in CASES],
    )  # fmt: skip
