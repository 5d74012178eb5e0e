"""Nanoseconds a ghost ray: all ghosts of a lens as compiled steps, beside path by path in torch.

A ghost ray is one ray of one pair of surfaces at one wavelength, whether it arrives or is lost on the way; a light 12
degrees off the axis, the widest stop, one thread, float32, compiling not counted. Both ways run in turn in one process.
Writes flare_speed.md and flare_speed.json.
"""

from __future__ import annotations

import argparse
import math
import statistics
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass

import torch

from experiments import lab
from neurolens.base.progress import Progress
from neurolens.flare.ghosts import GhostTracer
from neurolens.flare.picture import Light, light_rays
from neurolens.optics.lensfile import read_lens
from neurolens.optics.sequence import follow, ghost
from neurolens.optics.trace import Rays

LENSES = ("laikin_double_gauss_50", "brendel_tessar_100", "ikemori_retrofocus_14", "ogawa_zoom_70_200", "phone_lens_6")
GOAL_NS = 57.0  # a tenth of what the public CPU tracer takes on one quiet core (10 surfaces, all pairs)
_RAYS, _NM, _PATHS = 2048, 550.0, 12  # of torch, a ghost takes as long as any other of as many surfaces

OPTIONS = [
    lab.option("--only", metavar="TEXT", default="", help="lenses whose name holds this text"),
    lab.count("rounds", 15, "default: 15"),
    lab.out(),
]


@dataclass(frozen=True)
class Row:
    """Times are ns a ghost ray, minimum and median; `arriving` is the share of ghost rays that reach the film's plane,
    `steps` how many surfaces a ghost passes, and `own_steps` those that it does not share with others."""

    lens: str
    surfaces: int
    ghosts: int
    arriving: float
    steps: float
    own_steps: float
    compiled_min: float
    compiled_median: float
    torch_min: float
    torch_median: float

    @property
    def gain(self) -> float:
        return self.torch_min / self.compiled_min


def run(args: argparse.Namespace) -> int:
    """Time the lenses, write the tables; 1 where the goal is missed."""
    lab.quiet_glasses()
    torch.set_num_threads(1)
    names = lab.chosen(LENSES, str, args.only, "lenses")
    progress, rows = Progress(quiet=args.quiet), []
    for name in names:
        with progress.stage(name) as report:
            rows.append(_row(name, args.rounds, report))
    main = [r.compiled_min for r in rows if r.lens == LENSES[0]]
    goal = lab.Goal(f"ns a ghost ray, {LENSES[0]}", GOAL_NS, main[0] if main else None)
    text = lab.page("# Ghosts", __doc__ or "", lab.table(_COLUMNS, rows), lab.goal_table("Goal", [goal]))
    told = {"machine": lab.machine(), "rounds": args.rounds, "rows": [asdict(r) for r in rows]}
    print(lab.write_results(args.out, "flare_speed", text, told))
    return int(bool(main) and main[0] > GOAL_NS)


def _row(name: str, rounds: int, report: Callable[[float], None]) -> Row:
    lens = read_lens(lab.LENSES / f"{name}.toml").at(focus_m=math.inf)
    tracer = GhostTracer(lens)
    rays, _ = light_rays(lens, Light(12.0, 0.0), 0, _RAYS)
    given = Rays(*torch.from_numpy(rays).float())
    paths = [ghost(len(lens.surfaces), *pair) for pair in tracer.pairs]
    some = paths[:: max(1, len(paths) // _PATHS)]

    def compiled() -> int:
        found = tracer.trace(rays, _NM)
        return int(found.worst.size)

    def by_path() -> int:
        for path in some:
            follow(lens, given, path, _NM)
        return len(some) * _RAYS

    times: dict[Callable[[], int], list[float]] = {compiled: [], by_path: []}
    for n in range(rounds + 1):
        for call, found in times.items():
            began = time.perf_counter()
            rays_done = call()
            if n:  # the first compiles, and warms caches
                found.append(1e9 * (time.perf_counter() - began) / rays_done)
        report(n / rounds)
    arriving = tracer.trace(rays, _NM).worst <= 1
    own = [len(lens.surfaces) - 1 - pair.first for pair in tracer.pairs]
    return Row(
        name,
        len(lens.surfaces),
        len(paths),
        float(arriving.mean()),
        statistics.mean(map(len, paths)),
        statistics.mean(own),
        min(times[compiled]),
        statistics.median(times[compiled]),
        min(times[by_path]),
        statistics.median(times[by_path]),
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
