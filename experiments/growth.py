"""How time and memory grow: with surfaces, pixels, samples, lights, triangles and lenses.

Each point is a process of its own: its CPU seconds (one thread), and how far its resident memory rose above what the
imports take, children included. Lights and triangles are made, made ready and seen in one small picture; a tile is a
hundredth of its picture; the driver of a survey takes its answers from memory, as fast as it can (10,000 lenses are a
simulation: their fits run elsewhere). A slope is the power of the count over the last two points of tenfold or more.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import resource
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from experiments import lab
from experiments.lab import Row

_STEEP = 1.1  # a slope above it grows faster than the count
_FLAT = 0.15
_LEAST_S, _LEAST_MB = 0.02, 8.0  # below, a point says nothing of growth
_FILM = (36.0, 20.25)


@dataclass(frozen=True)
class Curve:
    """What is counted, how far, and what the growth should be at most: of time, and of memory."""

    name: str
    what: str
    counts: tuple[int, ...]
    probe: str
    time_power: float = 1.0
    memory_power: float = 1.0
    why: str = ""


def _decades(first: int, last: int) -> tuple[int, ...]:
    return tuple(10**k for k in range(first, last + 1))


CURVES = (
    Curve("surfaces", "exact rays, torch", (2, 8, 32, 100, 200), "traced"),
    Curve(
        "surfaces",
        "exact camera as C, made",
        (2, 8, 32, 100, 200),
        "compiled",
        time_power=1.5,
        why="three quarters are the C compiler's, which takes longer over one long function than in proportion",
    ),
    Curve(
        "surfaces",
        "survey of the lens, fit and all",
        (2, 8, 32, 100, 200),
        "surveyed",
        why="memory holds the crossings of a batch of 65,536 rays with every surface, 32 bytes each, and tests of them",
    ),
    Curve(
        "pixels",
        "whole picture, a sample",
        _decades(4, 8),
        "whole",
        why="memory holds the picture's sums, 90 bytes a pixel, or a hundredth of that by the tile",
    ),
    Curve("pixels", "a tile of a hundredth", _decades(4, 8), "tile"),
    Curve(
        "pixels",
        "tiles merged",
        _decades(4, 8),
        "merged",
        why="OpenEXR's writer takes whole channels, 50 bytes a pixel with those that are read",
    ),
    Curve("samples", "128 x 72 pixels", (1, 4, 16, 64, 256, 1024), "sampled", memory_power=0.0),
    Curve("lights", "points", _decades(0, 6), "points"),
    Curve(
        "lights",
        "spheres",
        _decades(0, 6),
        "spheres",
        why="beyond 1,000 lights reading their tables takes most of the time; rays find them by a tree",
    ),
    Curve("lights", "quads", _decades(0, 6), "quads"),
    Curve("triangles", "PLY file, Embree", _decades(2, 7), "triangles"),
    Curve("triangles", "PLY file, built-in tree", _decades(2, 7), "tree"),
    Curve("lenses", "driver of a survey", _decades(0, 4), "lenses"),
)
OPTIONS = [
    lab.option("--only", metavar="TEXT", default="", help="curves whose name holds this text, as lights"),
    lab.option("--most", metavar="N", type=float, default=math.inf, help="no counts above this one"),
    lab.out(),
]


def run(args: argparse.Namespace) -> None:
    """Measure all curves, write growth.md, growth.json and growth.png; curves that are left out are kept."""
    chosen = lab.chosen(CURVES, lambda c: f"{c.name}: {c.what}", args.only, "growth")
    kept = lab.kept_rows(args.out / "growth.json", "experiments growth", lambda r: (r["probe"], r["count"]), "rows")
    points = [(curve.probe, count) for curve in chosen for count in curve.counts if count <= args.most]
    for (probe, count), _ in lab.stages(points, lambda p: f"{p[0]} {p[1]:,}", args.quiet):
        try:
            kept[probe, count] = {"probe": probe, "count": count, **lab.in_child(measured, probe, count)}
        except lab.Unmeasured as error:
            kept[probe, count] = {"probe": probe, "count": count, "failed": str(error)[:300]}
        rows = [kept[c.probe, n] for c in CURVES for n in c.counts if (c.probe, n) in kept]
        found = [Found(c, [r for r in rows if r["probe"] == c.probe and "failed" not in r]) for c in CURVES]
        lab.write_results(args.out, "growth", _page(found, rows), {"rows": rows, "machine": lab.machine()})
    _draw(args.out / "growth.png", [f for f in found if f.rows])
    print((args.out / "growth.md").read_text())


def measured(probe: str, count: int) -> Row:
    """One point, in this process: CPU seconds, and MB above those of the imports."""
    from neurolens.base.errors import NeurolensWarning

    os.environ["XDG_CACHE_HOME"] = (place := tempfile.TemporaryDirectory(prefix="growth-")).name
    lab.warnings.simplefilter("ignore", NeurolensWarning)
    with place:
        steps = PROBES[probe](count, Path(place.name))
        next(steps)  # imports and what is no part of it
        before, began = resident_kb("VmRSS"), cpu_s()
        Path("/proc/self/clear_refs").write_text("5")
        for _ in steps:
            pass
        children = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss
        return {"seconds": cpu_s() - began, "mb": max(resident_kb("VmHWM") - before, children - before) / 1024}


def cpu_s() -> float:
    used = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(each.ru_utime + each.ru_stime for each in used)


def resident_kb(field: str) -> int:
    lines = Path("/proc/self/status").read_text().splitlines()
    return int(next(line for line in lines if line.startswith(field)).split()[1])


# ---- What is measured: generators that are ready at their first yield. -----------------------------------------------


def _lens(surfaces: int) -> Any:
    """Weak elements in a row that make a lens of 100 mm f/5, as long whatever their number."""
    from neurolens.optics.prescription import Lens, Surface
    from neurolens.readers.assemble import finish

    elements, rows = surfaces // 2, list[Surface]()
    for k in range(elements):
        if k == (elements + 1) // 2:
            rows.append(Surface(math.inf, 1.0, math.nan, stop=True))
        n, V_d = ((1.6, 55.0), (1.7, 35.0))[k % 2]
        radius = 2 * (n - 1) * 100 * elements
        rows += [Surface(radius, 20 / elements, 30.0, n, V_d), Surface(-radius, 10 / elements, 30.0)]
    if elements == 1:
        rows.append(Surface(math.inf, 1.0, math.nan, stop=True))
    return finish(Lens("growth", "made", tuple(rows), 5.0, half_field_deg=8.0, rims="derived"), film_given=False)


def traced(count: int, _: Path) -> Iterator[None]:
    import torch

    from experiments.trace_speed import film_rays, launched
    from neurolens.optics.trace import trace

    lens = _lens(count).at()
    rays, nm = launched(lens, film_rays(lens, 100_000), torch.float64)
    yield
    trace(lens, rays, nm)


def compiled(count: int, place: Path) -> Iterator[None]:
    from neurolens.base.progress import Progress
    from neurolens.cameras.build import Shot, make_camera
    from neurolens.commands.convert import write_checked

    write_checked(_lens(count), place / "lens.toml")
    yield
    make_camera(f"fused:{place / 'lens.toml'}", Shot(film_mm=(18.0, 10.125), focus_m=10.0), Progress(quiet=True))


def surveyed(count: int, place: Path) -> Iterator[None]:
    from neurolens.commands.convert import write_checked
    from neurolens.evaluate.survey import SurveySettings, Task, run_task

    write_checked(_lens(count), place / "lens.toml")
    task = Task("lens.toml", (place / "lens.toml").read_bytes(), SurveySettings(rays=5000))
    yield
    record = json.loads(run_task(task))
    assert record["fit"], record["reason"]


def _picture(pixels: int) -> tuple[int, int]:
    height = max(9, round(math.sqrt(pixels * 9 / 16)))
    return round(pixels / height), height


def _rendered(scene: Any, **more: Any) -> Any:
    from neurolens.cameras.build import Shot, make_camera
    from neurolens.render.renderer import render

    width, height = more.get("width", 16), more.get("height", 9)
    camera = make_camera("pinhole", Shot(film_mm=(36.0, 36.0 * height / width), focus_m=10.0))
    return render(scene, camera, threads=1, **more)


def _pixels(count: int, share: int = 1) -> Iterator[None]:
    from neurolens.render.scene import load_scene

    scene = load_scene(lab.SCENES / "grid.toml")
    width, height = _picture(count)
    rows = None if share == 1 else (0, max(1, height // share))
    yield
    _rendered(scene, width=width, height=height, samples=1, rows=rows)


def whole(count: int, _: Path) -> Iterator[None]:
    return _pixels(count)


def tile(count: int, _: Path) -> Iterator[None]:
    return _pixels(count, 100)


def merged(count: int, place: Path) -> Iterator[None]:
    from neurolens.cli import main

    (width, height), tiles = _picture(count), 4
    film = ("--film", f"36x{36 * height / width:.9f}", "--width", str(width), "--height", str(height))
    scene = ("render", str(lab.SCENES / "grid.toml"), "--camera", "pinhole", "-o", str(place / "a.exr"))
    for k in range(1, tiles + 1):
        options = ("--samples", "1", "--tile", f"{k}/{tiles}", "--quiet", "--threads", "1", "--json")
        assert _silent(lambda given: main(given), [*scene, *film, *options]) == 0
    yield
    parts = [str(file) for file in sorted(place.glob("a.tile-*.exr"))]
    assert _silent(lambda given: main(given), ["merge", *parts, "-o", str(place / "a.exr")]) == 0


def _silent(work: Callable[[list[str]], int], given: list[str]) -> int:
    import io
    from contextlib import redirect_stdout

    with redirect_stdout(io.StringIO()):
        return work(given)


def sampled(count: int, _: Path) -> Iterator[None]:
    from neurolens.render.scene import load_scene

    scene = load_scene(lab.SCENES / "grid.toml")
    yield
    _rendered(scene, width=128, height=72, samples=count)


def _lit(kind: str, count: int) -> Iterator[None]:
    """A floor below lights in a square of 20 m, 3 m above it, of all colours of a few lamps."""
    from neurolens.render.scene import scene_from_tables

    side = math.ceil(math.sqrt(count))
    glow = [[1.0, 0.8, 0.6], [0.6, 0.8, 1.0], [1.0, 1.0, 1.0]]
    size = 4.0 / side
    made: list[dict[str, Any]] = []
    for k in range(count):
        at, light = [20 * ((k % side + 0.5) / side - 0.5), 3.0, 20 * ((k // side + 0.5) / side - 0.5)], glow[k % 3]
        if kind == "points":
            made.append({"position_m": at, "intensity": light})
        elif kind == "spheres":
            made.append({"centre_m": at, "radius_m": size, "emission": light})
        else:
            edges = {"edge_u_m": [size, 0.0, 0.0], "edge_v_m": [0.0, 0.0, size]}
            made.append({"corner_m": at, **edges, "emission": light})
    white = {"white": {"kind": "diffuse", "reflectance": [0.8, 0.8, 0.8]}}
    floor = {"point_m": [0.0, 0.0, 0.0], "normal": [0.0, 1.0, 0.0], "material": "white"}
    view = {"position_m": [0.0, 8.0, 14.0], "look_at_m": [0.0, 0.0, 0.0], "focus_m": 16.0, "max_depth": 2}
    yield
    scene = scene_from_tables({"camera": view, "materials": white, "planes": [floor], kind: made}, "lights.toml")
    _rendered(scene, width=128, height=72, samples=4)


def points(count: int, _: Path) -> Iterator[None]:
    return _lit("points", count)


def spheres(count: int, _: Path) -> Iterator[None]:
    return _lit("spheres", count)


def quads(count: int, _: Path) -> Iterator[None]:
    return _lit("quads", count)


def triangles(count: int, place: Path) -> Iterator[None]:
    """A hilly ground of so many triangles, from a binary PLY file."""
    from neurolens.render.scene import load_scene

    side = round(math.sqrt(count / 2))
    x, z = (a.ravel() for a in np.meshgrid(np.linspace(-9, 9, side + 1), np.linspace(-9, 9, side + 1)))
    corners = np.stack([x, 0.4 * np.sin(2 * x) * np.cos(3 * z), z], axis=1).astype("<f4")
    first = (np.arange(side)[:, None] * (side + 1) + np.arange(side)).ravel()
    faces = np.zeros(2 * side**2, [("n", "u1"), ("v", "<i4", 3)])
    faces["n"] = 3
    faces["v"][0::2] = np.stack([first, first + side + 1, first + 1], axis=1)
    faces["v"][1::2] = np.stack([first + 1, first + side + 1, first + side + 2], axis=1)
    head = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(corners)}\n"
    head += "".join(f"property float {axis}\n" for axis in "xyz")
    head += f"element face {len(faces)}\nproperty list uchar int vertex_indices\nend_header\n"
    (place / "hills.ply").write_bytes(head.encode() + corners.tobytes() + faces.tobytes())
    lines = ["[camera]", "position_m = [0, 6, 14]", "look_at_m = [0, 0, 0]", "focus_m = 15", "max_depth = 3"]
    lines += ["[environment]", "colour = [1, 1, 1]", "[[meshes]]", "file = 'hills.ply'", "material = 'w'"]
    lines += ["[materials]", "w = { kind = 'diffuse', reflectance = [0.8, 0.8, 0.8] }"]
    (place / "scene.toml").write_text("\n".join(lines))
    del corners, faces, x, z, first
    yield
    _rendered(load_scene(place / "scene.toml"), width=128, height=72, samples=4)


def tree(count: int, place: Path) -> Iterator[None]:
    from neurolens.render import mesh

    def none() -> Any:
        raise ImportError

    mesh._library = none
    return triangles(count, place)


def lenses(count: int, place: Path) -> Iterator[None]:
    """The driver: tasks from files, records to files, the pages at the end; the answer is one lens's, renamed."""
    import shutil

    from neurolens.base.progress import Progress
    from neurolens.base.tasks import Here
    from neurolens.evaluate.survey import SurveySettings, Task, run_task
    from neurolens.evaluate.survey_run import survey
    from neurolens.readers.any_format import collection_of

    lens = lab.LENSES / "ogawa_zoom_70_200.toml"
    settings = SurveySettings(rays=2000)
    record = json.loads(run_task(Task(lens.name, lens.read_bytes(), settings)))
    (place / "lenses").mkdir()
    for k in range(count):
        shutil.copyfile(lens, place / "lenses" / f"{k:05d}.toml")

    def renamed(task: Task) -> bytes:
        return json.dumps(record | {"file": task.name, "fingerprint": task.fingerprint}).encode()

    class Renamed(Here):
        def submit(self, _: Any, /, *args: Any, **named: Any) -> Any:
            return super().submit(renamed, *args, **named)

    yield
    for _ in range(2):  # the second time all of them are known
        survey(collection_of(place / "lenses"), place / "out", settings, Renamed(), Progress(quiet=True))


PROBES: dict[str, Callable[[int, Path], Iterator[None]]] = {
    f.__name__: f
    for f in (traced, compiled, surveyed, whole, tile, merged, sampled, points, spheres, quads, triangles, tree, lenses)
}


# ---- The page. -------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Found:
    """A curve and its rows."""

    curve: Curve
    rows: list[Row]

    def slope(self, key: str, least: float) -> float | None:
        """Power of the count from the last point back to one of a tenth of it or less; None where too little grows."""
        known = [(row["count"], row[key]) for row in self.rows]
        if len(known) < 2 or known[-1][1] < least:
            return None
        x, y = known[-1]
        a, b = next(((p, q) for p, q in reversed(known) if p <= x / 10), known[0])
        return math.log(y / max(b, least)) / math.log(x / a)

    def told(self, key: str, least: float, power: float) -> str:
        """The slope in words."""
        slope = self.slope(key, least)
        if slope is None:
            return "too little to grow" if self.rows else "not measured"
        words = "flat" if slope < _FLAT else "slower than the count" if slope < 0.9 else "as the count"
        words = "faster than the count" if slope > _STEEP else words
        return f"{words} ({slope:.2f})" + (", MORE THAN IT MUST" if slope > power + 0.1 else "")


def _page(found: list[Found], rows: list[Row]) -> str:
    def cells(f: Found) -> list[str]:
        last = f.rows[-1] if f.rows else {"count": 0, "seconds": math.nan, "mb": math.nan}
        told = f.told("seconds", _LEAST_S, f.curve.time_power), f.told("mb", _LEAST_MB, f.curve.memory_power)
        return [f.curve.name, f.curve.what, f"{last['count']:,}", f"{last['seconds']:.3g}", told[0],
                f"{last['mb']:.0f}", told[1]]  # fmt: skip

    head = "against|what|up to|CPU s there|time grows|MB there|memory grows"
    every = lab.table(
        "what|count|CPU s|MB",
        [[r["probe"], f"{r['count']:,}", *_figures(r)] for r in rows],
    )
    failed = [f"{r['probe']} of {r['count']:,}: {r['failed']}" for r in rows if "failed" in r]
    return lab.page(
        "# How the cost grows", " ".join((__doc__ or "").split()), lab.machine_line(), "![growth](growth.png)",
        lab.table(head, [cells(f) for f in found]),
        "\n".join(f"- {c.name}, {c.what}: {c.why}" for c in CURVES if c.why),
        "Not measured: " + "; ".join(failed) if failed else "",
        "## All points", every,
    )  # fmt: skip


def _figures(row: Row) -> list[str]:
    return ["", "failed"] if "failed" in row else [f"{row['seconds']:.3g}", f"{row['mb']:.0f}"]


def _draw(file: Path, found: list[Found]) -> None:
    from matplotlib.ticker import LogLocator

    from neurolens.analysis.plot_style import FAINT, FIELD_COLOURS, drawing, plain_log_ticks

    names = list(dict.fromkeys(f.curve.name for f in found))
    with drawing(file, 3.1 * len(names), 6.2, "How the cost grows", "dashed: as the count") as figure:
        axes = figure.subplots(2, len(names), squeeze=False)
        for column, name in enumerate(names):
            for row, (key, unit, least) in enumerate((("seconds", "CPU seconds", 0.01), ("mb", "MB above imports", 1))):
                axis = axes[row][column]
                for k, f in enumerate(f for f in found if f.curve.name == name):
                    x, y = ([r[part] for r in f.rows] for part in ("count", key))
                    axis.plot(x, np.maximum(y, least), "o-", color=FIELD_COLOURS[k], ms=4, label=f.curve.what)
                    if y[-1] > 10 * least and x[-1] > x[0]:
                        axis.plot([x[-1] / 10, x[-1]], [y[-1] / 10, y[-1]], "--", color=FAINT, lw=0.8)
                axis.set(xscale="log", yscale="log", xlabel=name, ylabel=unit if not column else "")
                plain_log_ticks(axis.xaxis, axis.yaxis)
                if max(f.rows[-1]["count"] for f in found if f.curve.name == name) > 1e4:
                    axis.xaxis.set_major_locator(LogLocator(base=100))
                axis.grid(True)
                if not row:
                    axis.legend(fontsize=7.5)
