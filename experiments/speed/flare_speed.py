"""Nanoseconds a ghost ray: all ghosts of a lens as compiled steps, beside path by path in torch.

A ghost ray is one ray of one pair of surfaces at one wavelength, whether it arrives or is lost on the way; a light 12
degrees off the axis, the widest stop, one thread, float32, compiling not counted. Both ways run in turn in one process,
by processor time, which other work on the machine lengthens little. Writes flare_speed.md and flare_speed.json.

With --flaresim, the public CPU tracer of that name (github.com/space55/blackhole-rt, folder flaresim, MIT) runs in turn
with ours on the first lens: its own flags (-O3 -march=native -ffast-math, link-time optimisation, OpenMP with one
thread), bare surfaces, all pairs, its three wavelengths, one light on a picture of 128 x 72 pixels, no bloom and no
blur. Of its runs counts what they take beyond a run of few rays: no reading and writing, but its splatting. It is built
with `cmake -B build flaresim && cmake --build build`, needs OpenEXR, and is never part of this project.
"""

from __future__ import annotations

import argparse
import math
import os
import re
import statistics
import subprocess
import tempfile
from pathlib import Path

import numpy as np
import torch

from experiments import lab
from neurolens.base.errors import InputError
from neurolens.base.progress import Progress
from neurolens.optics.lens.prescription import Lens
from neurolens.optics.trace.rays import Rays, follow, turning
from neurolens.pictures.flare.ghosts import GhostTracer
from neurolens.pictures.flare.lights import Light, light_rays
from neurolens.pictures.render.pictures import write_exr

LENSES = ("laikin_double_gauss_50", "brendel_tessar_100", "ikemori_retrofocus_14", "ogawa_zoom_70_200", "phone_lens_6")
GOAL_NS = 57.0  # a tenth of what the public CPU tracer was said to take on one quiet core (10 surfaces, all pairs)
_RAYS, _NM, _PATHS = 2048, 550.0, 12  # of torch, a ghost takes as long as any other of as many surfaces
_ANGLE_DEG, _GRID, _FEW = 12.0, 224, 16  # rays of flaresim across the front

OPTIONS = [
    lab.option("--only", metavar="TEXT", default="", help="lenses whose name holds this text"),
    lab.count("rounds", 15, "default: 15"),
    lab.option("--flaresim", metavar="BINARY", type=Path, help="the public tracer, built; left out where not given"),
    lab.out(),
]


def run(args: argparse.Namespace) -> int:
    """Time the lenses, write the tables; 1 where the goal is missed."""
    lab.quiet_glasses()
    torch.set_num_threads(1)
    names = lab.chosen(LENSES, str, args.only, "lenses")
    progress, rows = Progress(quiet=args.quiet), list[lab.Row]()
    for name in names:
        with progress.stage(name) as report:
            rows.append(_row(name, args.rounds, report))
    main = [r["compiled_min"] for r in rows if r["lens"] == LENSES[0]]
    goal = lab.Goal(f"ns a ghost ray, {LENSES[0]}", GOAL_NS, main[0] if main else None)
    beside = [] if args.flaresim is None else _beside(args.flaresim, max(3, args.rounds // 3), progress)
    other = "flaresim was not given (--flaresim): not measured beside ours."
    if beside:
        theirs, ours = beside
        goal_now = lab.Goal(f"times as fast as {theirs['tracer']}", 10.0, theirs["ns_min"] / ours["ns_min"], True)
        other = lab.page(lab.table(_PUBLIC, beside), lab.goal_table("Goal", [goal_now]))
    text = lab.page("# Ghosts", __doc__ or "", lab.table(_COLUMNS, rows), lab.goal_table("Goal", [goal]), other)
    data = {"machine": lab.machine(), "rounds": args.rounds, "rows": rows, "beside": beside}
    print(lab.write_results(args.out, "flare_speed", text, data))
    return int(bool(main) and main[0] > GOAL_NS)


def _row(name: str, rounds: int, report: lab.Report) -> lab.Row:
    """Times in ns a ghost ray; `arriving`: the share of ghost rays that reach the film; `steps`: surfaces that a
    ghost passes, `own_steps` of those that it does not share with other ghosts."""
    lens = lab.lens_of(name, focus_m=math.inf)
    tracer = GhostTracer(lens)
    rays, _ = light_rays(lens, Light(_ANGLE_DEG, 0.0), 0, _RAYS)
    start = Rays(*torch.from_numpy(rays).float())
    paths = [turning(len(lens.surfaces), pair.reflections) for pair in tracer.pairs]
    some = paths[:: max(1, len(paths) // _PATHS)]

    def by_path() -> int:
        for path in some:
            follow(lens, start, path, _NM)
        return len(some) * _RAYS

    times = lab.cpu_ns({"compiled": lambda: tracer.trace(rays, _NM).worst.size, "torch": by_path}, rounds, report)
    row: lab.Row = {"lens": name, "surfaces": len(lens.surfaces), "ghosts": len(paths)}
    row |= {"arriving": float((tracer.trace(rays, _NM).worst <= 1).mean()), "steps": statistics.mean(map(len, paths))}
    row["own_steps"] = statistics.mean(len(lens.surfaces) - 1 - pair.first for pair in tracer.pairs)
    for how, ns in times.items():
        row |= {f"{how}_min": min(ns), f"{how}_median": statistics.median(ns)}
    return row | {"gain": row["torch_min"] / row["compiled_min"]}


def _beside(binary: Path, rounds: int, progress: Progress) -> list[lab.Row]:
    """flaresim and our tracer on the first lens, in turn.

    Raises:
        InputError: no such program, or one that ends otherwise than flaresim does.
    """
    lens = lab.lens_of(LENSES[0], focus_m=math.inf)
    tracer = GhostTracer(lens)
    rays, _ = light_rays(lens, Light(_ANGLE_DEG, 0.0), 0, 1 << 15)
    arriving = float((tracer.trace(rays, _NM).worst <= 1).mean())
    theirs, ours = list[float](), list[float]()
    with progress.stage("flaresim") as report, tempfile.TemporaryDirectory() as folder:
        _write_inputs(lens, Path(folder))
        for n in range(rounds):
            few, many = (_flaresim(binary, Path(folder), grid) for grid in (_FEW, _GRID))
            seconds, count, hits = (a - b for a, b in zip(many, few, strict=True))
            theirs.append(1e9 * seconds / count)
            ours += lab.cpu_ns({"": lambda: tracer.trace(rays[:, :_RAYS], _NM).worst.size}, 20)[""]
            report((n + 1) / rounds)
    git = ["git", "-C", str(binary.resolve().parent), "log", "-1", "--format=%h of %cs"]
    version = subprocess.run(git, capture_output=True, text=True, check=False).stdout.strip() or "unknown"
    pairs = len(tracer.pairs)
    both = (f"flaresim ({version})", int(count), hits / count, theirs), ("ours", pairs * _RAYS, arriving, ours)
    return [
        {"tracer": name, "ghosts": pairs, "rays": rays, "arriving": share, "ns_min": min(ns)}
        | {"ns_median": statistics.median(ns)}
        for name, rays, share, ns in both
    ]


def _write_inputs(lens: Lens, folder: Path) -> None:
    """The lens and one light as flaresim reads them."""
    rows = []
    for s in lens.surfaces:
        shape = "stop" if s.stop else f"{0.0 if math.isinf(s.radius_mm) else s.radius_mm:g}"
        rows.append(f"  {shape} {s.thickness_mm:g} {s.n_d:g} {s.V_d or 0.0:g} {s.semi_diameter_mm:g} 0")
    head = f"name: {lens.name}\nfocal_length: {lens.stated_efl_mm:g}\n\nsurfaces:\n"
    (folder / "ours.lens").write_text(head + "\n".join(rows) + "\n")
    picture, half_deg = np.zeros((72, 128, 3)), 20.0
    picture[36, int(64 * (1 + math.tan(math.radians(_ANGLE_DEG)) / math.tan(math.radians(half_deg))))] = 100.0
    write_exr(folder / "light.exr", picture)
    settings = {"input": "light.exr", "output": "out.exr", "lens": "ours.lens", "fov": 2 * half_deg}
    settings |= {"min_ghost": 0, "downsample": 1, "ghost_normalize": 0, "ghost_blur": 0, "bloom_strength": 0}
    (folder / "flaresim.conf").write_text("".join(f"{key} = {value}\n" for key, value in settings.items()))


def _flaresim(binary: Path, folder: Path, grid: int) -> tuple[float, int, int]:
    """Processor seconds, ghost rays, and those that arrive, of a run.

    Raises:
        InputError: as `_beside`; not all pairs are traced.
    """
    import resource  # of POSIX

    began = resource.getrusage(resource.RUSAGE_CHILDREN).ru_utime
    try:
        command = [str(binary.resolve()), "flaresim.conf", "--rays", str(grid)]
        environment = {**os.environ, "OMP_NUM_THREADS": "1"}
        done = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, check=True)
        total = re.search(r"rendering total: .* \((\d+)/(\d+) rays", done.stdout)
    except (OSError, subprocess.CalledProcessError) as error:
        raise InputError(binary, "--flaresim", f"({error})", "the program of flaresim") from error
    if total is None:
        raise InputError(binary, "--flaresim", "(other output)", "the program of flaresim, which tells its rays")
    return resource.getrusage(resource.RUSAGE_CHILDREN).ru_utime - began, int(total[2]), int(total[1])


_PUBLIC = lab.columns(
    ("beside each other", "tracer"),
    ("ghosts", "ghosts"),
    ("ghost rays", "rays"),
    ("that arrive", "arriving", ".1%"),
    ("ns min", "ns_min", ".1f"),
    ("median", "ns_median", ".1f"),
)
_COLUMNS = lab.columns(
    ("lens", "lens"),
    ("surfaces", "surfaces"),
    ("ghosts", "ghosts"),
    ("surfaces on the way", "steps", ".1f"),
    ("of these its own", "own_steps", ".1f"),
    ("ghost rays that arrive", "arriving", ".1%"),
    ("compiled, ns min", "compiled_min", ".1f"),
    ("median", "compiled_median", ".1f"),
    ("torch, ns min", "torch_min", ".0f"),
    ("median", "torch_median", ".0f"),
    ("times as fast", "gain", ".0f"),
)
