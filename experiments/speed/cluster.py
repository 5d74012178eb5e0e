"""Gains and costs of a Dask cluster: speed-up with workers of this machine, overhead a task, and 100,000 tasks.

Speed-up: the same survey and the same render by the plain command on one core, and on a cluster of one and of two
workers (processes of this machine, started for each run, which is in the time); results are compared bit for bit.
Overhead: tasks that do nothing, with payloads as large as those of a lens and of a tile of a 4K film, through a real
cluster of two workers; scheduler and driver are this process, whose CPU and memory are measured. 100,000 tasks, or more
workers than this machine has, are a simulation: each worker takes a task when it is free, is idle for a round trip
after it, and the driver, one core, needs its measured CPU time for each.
"""

from __future__ import annotations

import argparse
import heapq
import io
import json
import os
import random
import resource
import shutil
import statistics
import tempfile
import time
import warnings
from collections.abc import Iterator, Sequence
from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path

from experiments import lab
from experiments.lab import Row, cpu_s, resident_kb
from neurolens.base.cluster import Dask
from neurolens.base.tasks import Shared, run_each

_LENS, _TILE = (20_000, 12_000), (3_000, 6_000_000)  # bytes of a task, and of its answer
_COUNTS = {"lens": (100, 1000, 10_000), "tile": (100, 1000)}
_WORKERS = (1, 2, 16, 128, 1024)
_SURVEYED = ("cooke_triplet_50", "brendel_tessar_100", "laikin_double_gauss_50", "tronnier_double_gauss_100")
_LENS_S, _TILE_S = 10.0, 20.0  # of a core here: a lens by default settings, such a tile
_COPIES = 2
_FRAMES, _TILES_A_FRAME, _LENSES = 240, 32, 10_000  # a 4K frame of 64 samples is so many tiles of 2^24 paths
OPTIONS = [
    lab.option("--only", choices=("speed-up", "overhead"), help="measure one part, keep the other as it is"),
    lab.out(),
]


def run(args: argparse.Namespace) -> None:
    """Measure, simulate, write dask.md and dask.json."""
    warnings.simplefilter("ignore")
    file = args.out / "dask.json"
    kept = json.loads(file.read_text())["rows"] if args.only and file.exists() else []
    rows = [row for row in kept if row["part"] != args.only] if args.only else []
    if args.only != "overhead":
        rows += speed_up(args.quiet)
    if args.only != "speed-up":
        rows += [overhead(kind, count) for kind, counts in _COUNTS.items() for count in counts]
    simulated = list(simulations(rows))
    lab.write_results(args.out, "dask", _page(rows, simulated), {"rows": rows, "simulated": simulated})
    print((args.out / "dask.md").read_text())


# ---- Measured. -------------------------------------------------------------------------------------------------------


def speed_up(quiet: bool) -> list[Row]:
    """Wall seconds of a survey and of a render: plain, and on clusters of one and two workers."""
    with tempfile.TemporaryDirectory(prefix="cluster-") as name:
        folder = Path(name)
        (folder / "lenses").mkdir()
        for lens in _SURVEYED:
            for k in range(_COPIES):  # another name is another task
                shutil.copy(lab.LENSES / f"{lens}.toml", folder / "lenses" / f"{lens}-{k}.toml")
        survey = ("survey", str(folder / "lenses"), "--rays", "4000", "-o")
        picture = ("render", str(lab.SCENES / "room.toml"), "--camera", "thin", "--samples", "64", "--width", "384")
        rows = []
        for what, argv, plain in (
            (f"survey, {_COPIES * len(_SURVEYED)} lenses", survey, ("--jobs", "1")),
            ("render, 384 x 216, 64 samples", (*picture, "-o"), ("--threads", "1")),
        ):
            said: list[str] = []
            for k, more in enumerate((plain, ("--dask", "local:1"), ("--dask", "local:2"))):
                out = folder / (f"{what[:6]}{k}" + (".exr" if argv[0] == "render" else ""))
                began, cpu = time.perf_counter(), cpu_s()
                _quietly([*argv, str(out), *more, "--quiet"])
                seconds, cpu = time.perf_counter() - began, cpu_s() - cpu
                said.append(_result(out))
                how = "plain" if k == 0 else f"{k} worker" + "s" * (k > 1)
                rows.append({"part": "speed-up", "what": what, "how": how, "seconds": seconds,
                             "cpu_s": cpu, "load": os.getloadavg()[0], "same": said[-1] == said[0]})  # fmt: skip
        return rows


def _quietly(argv: Sequence[str]) -> None:
    from neurolens.cli import main

    with redirect_stdout(io.StringIO()), redirect_stderr(io.StringIO()) as said:
        code = main(list(argv))
    assert code == 0, said.getvalue()


def _result(out: Path) -> str:
    """The results of a run as text, without its times and names of folders."""
    if out.is_dir():
        files = sorted((out / "records").iterdir())
        return "".join(f"{file.name}{file.read_text()}" for file in files)
    from neurolens.pictures.render.pictures import read_channels

    planes, _ = read_channels(out)
    return "".join(key + planes[key].tobytes().hex() for key in sorted(planes))


def nothing(size: Shared, _: bytes) -> bytes:
    """The answer to a task that does nothing: so many bytes."""
    return bytes(int(size.data))


def overhead(kind: str, count: int) -> Row:
    """Tasks that do nothing: seconds, CPU seconds of this process (driver and scheduler), MB that they add."""
    task, answer = {"lens": _LENS, "tile": _TILE}[kind]
    began, cpu, before, done = 0.0, 0.0, 0, 0

    def tasks() -> Iterator[bytes]:
        nonlocal began, cpu, before
        for k in range(count + 20):
            if k == 20:  # the cluster has started
                began, cpu, before = time.perf_counter(), time.process_time(), resident_kb("VmRSS")
            yield random.Random(k).randbytes(task)

    with Dask("local:2") as executor:
        for _, came in run_each(executor, nothing, tasks(), Shared(str(answer).encode())):
            assert isinstance(came, bytes) and len(came) == answer
            done += 1
    wall, spent = time.perf_counter() - began, time.process_time() - cpu
    assert done == count + 20
    grown = max(0, resident_kb("VmHWM") - before) / 1024
    most = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    return {"part": "overhead", "what": kind, "count": count, "wall_ms": 1e3 * wall / count,
            "cpu_ms": 1e3 * spent / count, "mb": grown, "most_mb": most}  # fmt: skip


# ---- Simulated. ------------------------------------------------------------------------------------------------------


def simulated_s(tasks: Sequence[float], workers: int, driver_s: float, trip_s: float) -> float:
    """Seconds until all are done: each waits for a free worker, then for the driver, which sends one at a time."""
    free, driver = [0.0] * workers, 0.0
    end = 0.0
    for task in tasks:
        ready = heapq.heappop(free)
        driver = max(driver, ready) + driver_s
        done = driver + trip_s + task
        end = max(end, done)
        heapq.heappush(free, done)
    return end


def simulations(rows: Sequence[Row]) -> Iterator[Row]:
    """10,000 lenses, 240 frames of 4K, and 100,000 lenses, on many workers; tasks last as here, spread by a half."""
    costs = {kind: [row for row in rows if row.get("what") == kind][-1:] for kind in _COUNTS}
    if not all(costs.values()):
        return
    cases = (
        ("10,000 lenses", "lens", _LENSES, _LENS_S),
        ("4K film, 240 frames", "tile", _FRAMES * _TILES_A_FRAME, _TILE_S),
        ("100,000 lenses", "lens", 10 * _LENSES, _LENS_S),
    )
    for name, kind, count, seconds in cases:
        chance = random.Random(name)
        tasks = [seconds * chance.uniform(0.5, 1.5) for _ in range(count)]
        driver = costs[kind][0]["cpu_ms"] * 1e-3
        for workers in _WORKERS:
            took = simulated_s(tasks, workers, driver, 2 * driver)
            yield {"what": name, "tasks": count, "task_s": seconds, "workers": workers, "seconds": took,
                   "speed_up": sum(tasks) / took, "driver_s": count * driver}  # fmt: skip


# ---- The page. -------------------------------------------------------------------------------------------------------


def _page(rows: Sequence[Row], simulated: Sequence[Row]) -> str:
    plain = {row["what"]: row["seconds"] for row in rows if row.get("how") == "plain"}
    fast = [r | {"gain": plain[r["what"]] / r["seconds"]} for r in rows if r["part"] == "speed-up"]
    columns = lab.columns(
        ("what", "what"), ("how", "how"), ("wall s", "seconds", ".1f"), ("speed-up", "gain", ".2f"),
        ("CPU s of all processes", "cpu_s", ".1f"), ("load average", "load", ".1f"),
        ("same result", lambda r: "yes" if r["same"] else "NO"),
    )  # fmt: skip
    small = lab.columns(
        ("payload of a", "what"), ("tasks", "count", ","), ("wall ms a task", "wall_ms", ".2f"),
        ("CPU ms of driver and scheduler a task", "cpu_ms", ".2f"), ("MB above the start", "mb", ".0f"),
    )  # fmt: skip
    large = lab.columns(
        ("what", "what"), ("tasks", "tasks", ","), ("s a task", "task_s", ".1f"), ("workers", "workers", ","),
        ("hours", "seconds", ".2f", 1 / 3600), ("speed-up", "speed_up", ".1f"),
        ("CPU s of the driver", "driver_s", ".0f"),
    )  # fmt: skip
    return lab.page(
        "# Dask: speed-up and overhead", " ".join((__doc__ or "").split()), lab.machine_line(),
        "## Speed-up (measured)", lab.table(columns, fast, missing="not taken"),
        "## Tasks that do nothing (measured)", lab.table(small, [r for r in rows if r["part"] == "overhead"]),
        "## Many tasks and workers (simulated)", lab.table(large, simulated), _words(rows, simulated),
    )  # fmt: skip


def _words(rows: Sequence[Row], simulated: Sequence[Row]) -> str:
    """A paragraph on what grows with the number of tasks and workers."""
    lens = [row for row in rows if row.get("what") == "lens"]
    if len(lens) < 2 or not simulated:
        return ""
    ratio = lens[-1]["cpu_ms"] / statistics.median(row["cpu_ms"] for row in lens[:-1])
    words = "does not grow" if ratio < 1.2 else f"is {ratio:.1f} times that of fewer"
    limit = next(row for row in simulated if row["what"] == "10,000 lenses")
    busy = limit["task_s"] / (lens[-1]["cpu_ms"] * 1e-3)
    return (
        f"A task costs driver and scheduler {lens[-1]['cpu_ms']:.2g} ms of CPU, which {words} with their number: a "
        "cluster is sent no more tasks than it has workers, so that neither holds more. Workers wait for the driver "
        f"only beyond some {busy:,.0f} of them. A survey keeps some tens of kB a lens, a render the names of tiles."
    )
