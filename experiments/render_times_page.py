"""Render three scenes of rising cost through a pinhole, a thin lens, a stop without glass, and eight lenses.

The lenses, of 2 to 40 refractions, are traced exactly (torch, and compiled as C), through their polynomials and
networks in onnxruntime and compiled (12 minutes of one core; --quick: one). Needs the extra "train" (torch) and a C
compiler; what this machine cannot make is left out, and said. Writes README.md, render_times.csv and render_times.png.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from statistics import median

import torch

from experiments import lab
from experiments import render_times as bench
from experiments.render_times import (
    CHEAP,
    CHEAP_ROUNDS,
    EXACT_C,
    FUSED_MODELS,
    GRAPHS,
    PINHOLE,
    SCENES,
    STOP,
    THIN,
    TORCH,
    Shape,
    Size,
    Subject,
    Timed,
)
from neurolens.analysis.plot_style import INK, drawing
from neurolens.base.files import atomic_write_text
from neurolens.base.progress import Progress

ABOVE_THIN, MOVES, PER_REFRACTION = 0.05, 0.30, 0.10  # the goals, as shares


_NOTES = """\
Every camera sees the same 20 degrees at f/4, focused at 5 m, one wavelength per path, {width} x {height} pixels,
{samples} samples, one thread, {rounds} rounds of all cameras in turn ({more} times as many in the cheap scene);
seconds are the best round (the median in brackets), what differentials add is the median of the rounds' ratios.
`cheap` is a textured wall and one bounce ({cheap}.toml), `middle` small lights and three ({middle}.toml), `dear`
meshes, gloss, glass and six ({dear}.toml). "exact, torch" is the eager tracer, "exact, C" the same trace written as C
and compiled, with the pupil, weights and status around it in one call, as the models "C" are (`--camera fused:FILE`);
polynomials are `ols-64` of models/, networks `mlp-16x2`. Overhead is the time above the pinhole's, as a share of the
pinhole's render, per refraction. Camera is the share of a render's time that its camera takes. Blocked rays cost no
path: a lens that loses light renders faster for it. Differentials are computed and handed on; nothing uses them. Those
of compiled cameras are polynomials of low order, whose RMS error stands beside them."""


@dataclass
class Found:
    """What was measured so far."""

    size: Size
    subjects: list[Subject] = field(default_factory=list)
    rows: list[Timed] = field(default_factory=list)
    shapes: list[Shape] = field(default_factory=list)

    def row(self, subject: Subject | str, scene: str, differentials: bool = False) -> Timed | None:
        """Of a camera (an ideal one by its kind) in a scene, where it was timed."""
        for r in self.rows:
            if subject in (r.subject, r.subject.kind) and (r.scene, r.differentials) == (scene, differentials):
                return r if r.seconds else None
        return None

    def above_thin(self, subject: Subject, scene: str) -> float | None:
        """Seconds in the camera above those of the thin lens, over the pinhole's render."""
        row, thin, pinhole = (self.row(s, scene) for s in (subject, THIN, PINHOLE))
        if row is None or thin is None or pinhole is None:
            return None
        return (min(row.camera_s) - min(thin.camera_s)) / min(pinhole.seconds)

    def moves_share(self, subject: Subject) -> float | None:
        """Median over the rounds of the camera's seconds with differentials over those without, less 1."""
        row, more = self.row(subject, CHEAP), self.row(subject, CHEAP, True)
        if row is None or more is None:
            return None
        return median(with_ / without for with_, without in zip(more.camera_s, row.camera_s, strict=True)) - 1

    def overhead(self, subject: Subject, scene: str) -> float | None:
        """Time above the pinhole's over the pinhole's, per refraction; of an ideal camera as a whole."""
        row, pinhole = self.row(subject, scene), self.row(PINHOLE, scene)
        if row is None or pinhole is None:
            return None
        return (min(row.seconds) / min(pinhole.seconds) - 1) / max(subject.refractions or 1, 1)

    def ns_in_render(self, subject: Subject, differentials: bool = False) -> float | None:
        """Nanoseconds a ray in the cheap render."""
        row = self.row(subject, CHEAP, differentials)
        return None if row is None else min(row.camera_s) / row.paths * 1e9


def goals(found: Found) -> list[lab.Goal]:
    """The goals of the issue, in every scene, for every kind of camera; the worst lens counts."""

    def goal(kind: str, text: str, wanted: float, share: Callable[[Subject], float | None]) -> lab.Goal:
        known = {s.lens: v for s in found.subjects if s.kind == kind and (v := share(s)) is not None}
        worst = max(known, key=lambda name: known[name], default="")
        return lab.Goal(f"{kind}: {text}", wanted, known.get(worst), worst=worst)

    above = "camera above the thin lens's, of the {} pinhole render"
    return [
        *(
            goal(kind, above.format(scene), ABOVE_THIN, partial(found.above_thin, scene=scene))
            for kind in (*FUSED_MODELS, *GRAPHS)
            for scene in SCENES
        ),
        *(
            goal(kind, "what differentials add to the camera, in the cheap render", MOVES, found.moves_share)
            for kind in (EXACT_C, *FUSED_MODELS)
        ),
        *(
            goal(kind, "overhead a refraction, of the cheap pinhole render", PER_REFRACTION,
                 partial(found.overhead, scene=CHEAP))
            for kind in (EXACT_C, TORCH)
        ),
    ]  # fmt: skip


def write(found: Found, out: Path) -> str:
    """Write README.md and render_times.csv into a folder; returns the page."""
    out.mkdir(parents=True, exist_ok=True)
    text = page(found)
    atomic_write_text(out / "README.md", text)
    atomic_write_text(out / "render_times.csv", lab.csv_text(_CSV, [r for r in found.rows if r.seconds]))
    return text


def _percent(share: float | None) -> str | None:
    return None if share is None else f"{100 * share:.3g}%"


_GOALS = lab.columns(
    ("goal", "text"),
    ("wanted", lambda g: f"at most {_percent(g.wanted)}"),
    ("measured, worst lens", lambda g: _percent(g.measured)),
    ("lens", "worst"),
    ("", "verdict"),
)
_LEGEND = """\
Seconds (median); overhead over the pinhole per refraction; share of the camera. Ideal cameras stand in the
first column."""
_SHAPES_NOTE = "Biconvex lens, C, cheap scene. Passage and time over the round stop's, area over the disc's."


def page(found: Found) -> str:
    """All tables."""
    timed = {r.scene for r in found.rows if r.seconds}
    parts = [] if not timed else ["![Seconds over refractions](render_times.png)"]
    parts += [f"## Seconds, {s}\n\n{_LEGEND}\n\n{_scene_table(found, s)}" for s in SCENES if s in timed]
    missing = [f"{s.name}: {s.reason}." for s in found.subjects if s.reason]
    shapes = lab.table(_shape_columns(found.shapes[0]), found.shapes) if found.shapes else ""
    return lab.page(
        "# Render time by camera",
        "`python -m experiments render`",
        _NOTES.format(**vars(found.size), **SCENES, more=CHEAP_ROUNDS),
        lab.machine_line(", one of them used"),
        "## Goals",
        lab.table(_GOALS, goals(found), "–"),
        *parts,
        "## Cameras by themselves",
        lab.table(_camera_columns(found), found.subjects, "–"),
        *missing,
        f"## Shapes of the stop\n\n{_SHAPES_NOTE}\n\n{shapes}" if shapes else "",
    )


def _scene_table(found: Found, scene: str) -> str:
    """One row per lens, one column per kind: seconds, overhead a refraction, share of the camera."""
    kinds = (TORCH, EXACT_C, *GRAPHS, *FUSED_MODELS)

    def cell(kind: str, of: dict[str, Subject]) -> str | None:
        row = found.row(of[kind], scene) if kind in of else None
        if row is None:
            return None
        over = "" if kind == PINHOLE else f"; {_percent(found.overhead(of[kind], scene))}"
        share = _percent(min(row.camera_s) / min(row.seconds))
        return f"{lab.best_median(min(row.seconds), median(row.seconds), '.3f')}{over}; {share}"

    rows = []
    for lens, count in dict.fromkeys((s.lens, s.refractions) for s in found.subjects):
        of = {s.kind: s for s in found.subjects if s.lens == lens}
        shown = (lens, *kinds[1:]) if lens in (PINHOLE, THIN, STOP) else kinds
        rows.append([lens, count, *(cell(kind, of) for kind in shown)])
    return lab.table(["lens", "refractions", *kinds], rows, "–")


def _camera_columns(found: Found) -> tuple[lab.Column, ...]:
    def passed(subject: Subject) -> str | None:
        row = found.row(subject, CHEAP)
        return None if row is None else _percent(row.passed)

    return lab.columns(
        ("camera", "name"),
        ("refractions", "refractions"),
        ("ns per ray, alone", "ns", ".3g"),
        ("with differentials", "ns_moves", ".3g"),
        ("ns per ray in the cheap render", found.ns_in_render, ".3g"),
        ("with differentials", partial(found.ns_in_render, differentials=True), ".3g"),
        ("differentials add", lambda s: _percent(found.moves_share(s))),
        ("their error", lambda s: _percent(s.moves_error)),
        ("rays that pass", passed),
        ("made in s", "made_s", ".2g"),
    )


def _shape_columns(first: Shape) -> tuple[lab.Column, ...]:
    return lab.columns(
        ("stop", "name"),
        ("area", lambda s: _percent(s.area)),
        ("rays that pass", lambda s: _percent(s.passed / first.passed)),
        ("time", lambda s: _percent(min(s.seconds) / min(first.seconds))),
    )


_CSV = lab.columns(
    ("scene", "scene"),
    ("lens", "subject.lens"),
    ("refractions", "subject.refractions"),
    ("camera", "subject.kind"),
    ("differentials", lambda r: int(r.differentials)),
    ("seconds_min", lambda r: min(r.seconds), ".5f"),
    ("seconds_median", lambda r: median(r.seconds), ".5f"),
    ("camera_seconds_min", lambda r: min(r.camera_s), ".5f"),
    ("passed", "passed", ".5f"),
    ("paths", "paths"),
    ("threads", lambda r: 1),
    ("rounds", lambda r: len(r.seconds)),
    ("camera_alone_ns", lambda r: r.subject.ns_moves if r.differentials else r.subject.ns, ".2f"),
)
# Okabe and Ito's colours; what runs compiled is filled.


_LOOK = {
    TORCH: (INK, "s", "white"),
    EXACT_C: (INK, "s", INK),
    GRAPHS[0]: ("#0072b2", "o", "white"),
    FUSED_MODELS[0]: ("#0072b2", "o", "#0072b2"),
    GRAPHS[1]: ("#d55e00", "^", "white"),
    FUSED_MODELS[1]: ("#d55e00", "^", "#d55e00"),
}


_LINES = {THIN: ("#009e73", "--"), PINHOLE: ("#7f7f7f", ":")}


def draw(found: Found, path: Path) -> None:
    """Draw one panel for every scene that was rendered; nothing where none was."""
    scenes = [s for s in SCENES if found.row(PINHOLE, s)]
    if not scenes:
        return
    with drawing(path, 4.4 * len(scenes) + 2.6, 4.6) as figure:
        for axes, scene in zip(figure.subplots(1, len(scenes), squeeze=False)[0], scenes, strict=True):
            for kind, (colour, marker, fill) in _LOOK.items():
                timed = [(s.refractions, found.row(s, scene)) for s in found.subjects if s.kind == kind]
                points = [(count, min(row.seconds)) for count, row in timed if row is not None]
                if points:
                    look = {"color": colour, "mfc": fill, "mec": colour, "ms": 5, "lw": 1.1}
                    axes.plot(*zip(*points, strict=True), marker=marker, label=kind, **look)
            for kind, (colour, dash) in _LINES.items():
                row = found.row(kind, scene)
                if row is not None:
                    axes.axhline(min(row.seconds), color=colour, ls=dash, lw=1.2, label=kind)
            axes.set(xlabel="refractions of the lens", ylabel="seconds a render", title=scene)
            axes.set(xlim=(0, None), ylim=(0, None))
            axes.grid(True)
        handles, labels = figure.axes[0].get_legend_handles_labels()
        figure.suptitle("Render time over refractions", x=0.01, ha="left", fontweight="bold")
        figure.legend(handles, labels, loc="outside right upper")


OPTIONS = (
    lab.option("--quick", action="store_true", help="three lenses in the cheap scene, one small round"),
    lab.out(lab.RESULTS / "render_times"),
)


def run(args: argparse.Namespace) -> None:
    """Make the cameras, time them alone and in renders; the tables are written after each step."""
    lab.quiet_glasses()
    torch.set_num_threads(1)
    found = Found(Size(64, 36, 16, 1) if args.quick else Size())
    scenes = bench.load_scenes(args.quick)
    progress = Progress({"cameras": 25, "cameras alone": 5, "renders": 65, "stop shapes": 5}, quiet=args.quiet)
    with progress.stage("cameras") as report:
        found.subjects = bench.make_subjects(args.quick, report)
    with progress.stage("cameras alone") as report:
        bench.time_alone(found.subjects, report)
    write(found, args.out)
    with progress.stage("renders") as report:
        found.rows = bench.time_renders(found.subjects, scenes, found.size, report)
    write(found, args.out)
    with progress.stage("stop shapes") as report:
        found.shapes = bench.time_shapes(scenes["cheap"], found.size, report)
    draw(found, args.out / "render_times.png")
    print(write(found, args.out))
