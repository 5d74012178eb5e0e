"""The share of the rays from a camera's pupil outlines that pass its lens, and the light that they leave out.

On lenses of the theses of Steinert (2009) and Willi (2021), some seconds. Writes passage.md and passage.json. With
--shaders the library's models as shaders in OSL instead, up to half a minute each: writes osl_passing.md and
osl_passing.json after each, and goes on with those that these have not; --only measures anew.
"""

from __future__ import annotations

import argparse
import math
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from torch.quasirandom import SobolEngine

from experiments import lab
from neurolens.base.progress import Progress
from neurolens.cameras.exact import ExactCamera
from neurolens.lens.shot import Shot
from neurolens.plan.costs import cycles_ns
from neurolens.shaders.blender_shader import lens_of
from neurolens.shaders.osl import osl_program
from neurolens.shaders.pupil_fit import light_lost

FILM_MM, SAMPLES = (36.0, 24.0), 2**17


class Case(NamedTuple):
    """A lens by the stem of its file, scaled to a focal length, at one stop."""

    lens: str
    focal_length_mm: float
    f_number: float


CASES = (
    *(Case("muller_fisheye_100", 14.0, n) for n in (4.0, 5.6, 8.0)),
    *(Case("angenieux_retrofocus_35", 35.0, n) for n in (2.8, 4.0, 5.6)),
    *(Case("brendel_tessar_100", 50.0, n) for n in (2.8, 4.0, 5.6)),
    *(Case("sigler_telephoto_100", 250.0, n) for n in (5.6, 8.0, 11.0)),
    Case("tronnier_double_gauss_100", 100.0, 4.0),
    Case("mizuguchi_fisheye_10", 10.5, 8.0),
    *(Case("laikin_double_gauss_50", 50.0, n) for n in (1.8, 8.0)),
)


def measure(case: Case, samples: int = SAMPLES, wider: float = 1.1) -> lab.Row:
    """A case in light of 400 to 700 nm, focused at infinity.

    Returns: the case; dark, the share of the film that no light reaches; passed, the share of the rays from lit film
        points that pass; lost, the share of the light that passes outside the outlines, from rays through outlines
        `wider` times as wide.
    """
    lens = lab.lens_of(case.lens, focal_length_mm=case.focal_length_mm, f_number=case.f_number)
    camera = ExactCamera(lens, Shot(FILM_MM, math.inf))
    outline = camera.film.outline
    draws = SobolEngine(5, scramble=True, seed=1).draw(samples).numpy().T
    film = (draws[:2] - 0.5) * np.array(FILM_MM, np.float32)[:, None]
    lit = np.hypot(*film) <= outline.film_radius_mm
    film, square, wavelength = film[:, lit], draws[2:4, lit], 400 + 300 * draws[4, lit]

    def passes(points: Any) -> Any:
        return camera.film.scene(film, points, wavelength).status == 0

    points, area = outline.sample(film, square, wavelength)
    passed = passes(points) & (area > 0)
    wide = replace(outline, x=outline.x * np.float32(wider), y=outline.y * np.float32(wider))
    beyond, wide_area = wide.sample(film, square, wavelength)
    light = wide_area * passes(beyond)
    outside = np.abs(2 * square - 1).max(0) > 1 / wider
    row = {**case._asdict(), "dark": 1 - film.shape[1] / samples, "passed": float(passed.mean())}
    return row | {"lost": float(light[outside].sum() / light.sum())}


_INTRO = """\
# Share of rays that pass

`python -m experiments pupils`

{0:g} x {1:g} mm film, focus at infinity, 400 to 700 nm, {samples} rays a lens. *Passed*: percent of the rays sent from
lit film points; the dark share of the film costs nothing and stands apart. *Lost*: the share of the light that passes
outside the outlines (`neurolens.cameras.pupil_outline`).
"""
_COLUMNS = lab.columns(
    ("lens", lambda r: f"{r['lens'].rsplit('_', 1)[0].replace('_', ' ')} {r['focal_length_mm']:g} mm"),
    ("f/", "f_number", "g"),
    ("dark %", "dark", ".1f", 100),
    ("passed %", "passed", ".1f", 100),
    ("lost", "lost", ".0e"),
)


def page(rows: Sequence[lab.Row], samples: int) -> str:
    """The whole page in Markdown."""
    return lab.page(_INTRO.format(*FILM_MM, samples=samples), lab.table(_COLUMNS, rows))


OPTIONS = (
    lab.count("rays", SAMPLES, "rays a lens (default 131072)", 1000),
    lab.option("--shaders", action="store_true", help="the library's models as shaders in OSL"),
    lab.ONLY,
    lab.out(),
)


def run(args: argparse.Namespace) -> None:
    """Measure every case, or every shader."""
    if args.shaders:
        return shaders(args)
    lab.quiet_glasses()
    cases = lab.chosen(CASES, lambda case: case.lens, args.only, "pupils")
    done = [measure(case, args.rays) for case in lab.counted(cases, "pupils", args.quiet)]
    data = {"film_mm": FILM_MM, "samples": args.rays, "cases": done}
    print(lab.write_results(args.out, "passage", page(done, args.rays), data))


SHADERS = lab.columns(
    ("Model", "model"),
    ("Open", "open", ".3f"),
    ("2 stops down", "stopped_2", ".3f"),
    ("4 stops down", "stopped_4", ".3f"),
    ("Lost (per mille)", "lost_per_mille", ".2f"),
    ("Operations", "operations"),
    ("ns a ray that passes", "ns", ".0f"),
    ("CPU (s)", "cpu_s", ".1f"),
)
_SHADERS_TEXT = """\
By `python -m experiments pupils --shaders`: share of the samples that pass the lens, from film points that have light
at that stop, all over film, focus and wavelength; light that no sample has, in the worst zone of film and stop;
operations of a ray through a round stop; what they make a ray cost in Cycles under a white sky (`plan/costs.py`)
for each that passes, the stop open; CPU to make the shader. The pupil of the biconvex lens folds far off the axis: one
wide disc holds it."""


def shaders(args: argparse.Namespace) -> None:
    """Share of the samples that pass, operations and CPU seconds of shaders of the library's models."""
    models = [file for kind in ("*.ols-64.onnx", "*-range.states-64.onnx") for file in lab.MODELS.glob(kind)]
    files = lab.chosen(sorted(models), lambda file: file.name, args.only, "pupils")
    lab.resume(
        args,
        "osl_passing",
        {file.stem: file for file in files},
        lambda file, report: shader_row(file),
        lambda row: row["model"],
        lambda rows: lab.page("# Samples of shaders in OSL that pass", _SHADERS_TEXT, lab.table(SHADERS, rows)),
        listed="rows",
        again=bool(args.only),
        maker="experiments pupils --shaders",
    )


def shader_row(file: Path) -> lab.Row:
    """The row of a model's shader, in its worst state."""
    begun = time.process_time()
    with Progress(quiet=True).stage(file.stem) as report:
        _, lens, _ = lens_of(file, None, report)
    shares = dict(zip(("open", "stopped_2", "stopped_4"), lens.passing().values(), strict=True))
    cpu, program = time.process_time() - begun, osl_program(lens, {"count": 0.0})
    lost = max(light_lost(state, pupil) for state, pupil in lens.states())
    measured = {"operations": sum(program.count().values()), "ns": cycles_ns(program) / shares["open"], "cpu_s": cpu}
    return {"model": file.stem, **shares, "lost_per_mille": 1e3 * lost, **measured}
