"""`python -m experiments render`, and its tables: goals, seconds by camera and scene, cameras alone, stop shapes."""

from __future__ import annotations

import argparse
import csv
import io
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
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
from neurolens.analysis.plot_style import INK, new_figure, save, style
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

    def row(self, subject: Subject, scene: str, differentials: bool = False) -> Timed | None:
        """Of a camera in a scene, where it was timed."""
        for r in self.rows:
            if r.subject is subject and r.scene == scene and r.differentials == differentials and r.seconds:
                return r
        return None

    def ideal(self, kind: str, scene: str) -> Timed | None:
        """Of the pinhole or the thin lens."""
        return next((r for s in self.subjects if s.kind == kind and (r := self.row(s, scene))), None)


def goals(found: Found) -> list[lab.Goal]:
    """The goals of the issue, in every scene, for every kind of camera; the worst lens counts."""
    result = []

    def add(text: str, wanted: float, shares: dict[str, float | None]) -> None:
        known = {name: v for name, v in shares.items() if v is not None}
        worst = max(known, key=lambda name: known[name], default="")
        result.append(lab.Goal(text, wanted, known.get(worst), worst=worst))

    for kind in (*FUSED_MODELS, *GRAPHS):
        for scene in SCENES:
            text = f"{kind}: camera above the thin lens's, of the {scene} pinhole render"
            add(text, ABOVE_THIN, _of(found, kind, lambda s, scene=scene: _above_thin(found, s, scene)))  # type: ignore[misc]
    for kind in (EXACT_C, *FUSED_MODELS):
        text = f"{kind}: what differentials add to the camera, in the cheap render"
        add(text, MOVES, _of(found, kind, lambda s: _moves_share(found, s)))
    for kind in (EXACT_C, TORCH):
        text = f"{kind}: overhead a refraction, of the cheap pinhole render"
        add(text, PER_REFRACTION, _of(found, kind, lambda s: overhead(found, s, CHEAP)))
    return result


def _of(found: Found, kind: str, share: Callable[[Subject], float | None]) -> dict[str, float | None]:
    return {s.lens: share(s) for s in found.subjects if s.kind == kind}


def _above_thin(found: Found, subject: Subject, scene: str) -> float | None:
    """Seconds in the camera above those of the thin lens, over the pinhole's render."""
    row, thin, pinhole = found.row(subject, scene), found.ideal(THIN, scene), found.ideal(PINHOLE, scene)
    if row is None or thin is None or pinhole is None:
        return None
    return (min(row.camera_s) - min(thin.camera_s)) / min(pinhole.seconds)


def _moves_share(found: Found, subject: Subject) -> float | None:
    """Median over the rounds of the camera's seconds with differentials over those without, less 1."""
    row, more = found.row(subject, CHEAP), found.row(subject, CHEAP, True)
    if row is None or more is None:
        return None
    return median(with_ / without for with_, without in zip(more.camera_s, row.camera_s, strict=True)) - 1


def overhead(found: Found, subject: Subject, scene: str) -> float | None:
    """Time above the pinhole's over the pinhole's, per refraction; of an ideal camera as a whole."""
    row, pinhole = found.row(subject, scene), found.ideal(PINHOLE, scene)
    if row is None or pinhole is None:
        return None
    return (min(row.seconds) / min(pinhole.seconds) - 1) / max(subject.refractions or 1, 1)


def write(found: Found, out: Path) -> str:
    """Write README.md and render_times.csv into a folder; returns the page."""
    out.mkdir(parents=True, exist_ok=True)
    text = page(found)
    atomic_write_text(out / "README.md", text)
    atomic_write_text(out / "render_times.csv", _csv(found))
    return text


def page(found: Found) -> str:
    """All tables."""
    parts = ["# Render time by camera", "`python -m experiments render`"]
    parts.append(_NOTES.format(**vars(found.size), **SCENES, more=CHEAP_ROUNDS))
    parts.append(lab.machine_line(", one of them used"))
    aims = [[g.text, f"at most {_percent(g.wanted)}", _percent(g.measured), g.worst, g.verdict] for g in goals(found)]
    parts += ["## Goals", lab.table("goal|wanted|measured, worst lens|lens|", aims, "–")]
    timed = {r.scene for r in found.rows if r.seconds}
    if timed:
        parts.append("![Seconds over refractions](render_times.png)")
        parts += [f"## Seconds, {scene}\n\n{_scene_table(found, scene)}" for scene in SCENES if scene in timed]
    parts += ["## Cameras by themselves", _camera_table(found)]
    if found.shapes:
        parts += ["## Shapes of the stop", _shape_table(found.shapes)]
    return "\n\n".join(parts) + "\n"


def _percent(share: float | None) -> str | None:
    return None if share is None else f"{100 * share:.3g}%"


def _scene_table(found: Found, scene: str) -> str:
    """One row per lens, one column per kind: seconds, overhead a refraction, share of the camera."""
    kinds = (TORCH, EXACT_C, *GRAPHS, *FUSED_MODELS)
    rows = []
    for s in found.subjects:
        if s.kind in (PINHOLE, THIN, STOP):
            rows.append([s.kind, s.refractions, _cell(found, s, scene), *[None] * (len(kinds) - 1)])
    for lens, count in dict.fromkeys((s.lens, s.refractions) for s in found.subjects if s.kind in kinds):
        of = {s.kind: s for s in found.subjects if s.lens == lens}
        rows.append([lens, count, *(_cell(found, of[k], scene) if k in of else None for k in kinds)])
    head = "lens|refractions|" + "|".join(kinds)
    legend = (
        "Seconds (median); overhead over the pinhole per refraction; share of the camera. Ideal cameras stand in the"
    )
    return f"{legend}\nfirst column.\n\n{lab.table(head, rows, '–')}"


def _cell(found: Found, subject: Subject, scene: str) -> str | None:
    row = found.row(subject, scene)
    if row is None:
        return None
    share = min(row.camera_s) / min(row.seconds)
    over = "" if subject.kind == PINHOLE else f"; {_percent(overhead(found, subject, scene))}"
    return f"{min(row.seconds):.3f} ({median(row.seconds):.3f}){over}; {_percent(share)}"


def _camera_table(found: Found) -> str:
    rows = []
    for s in found.subjects:
        ns, moves = (None if v is None else f"{v:.3g}" for v in (s.ns, s.ns_moves))
        row, more = found.row(s, CHEAP), found.row(s, CHEAP, True)
        both = [None if r is None else f"{min(r.camera_s) / r.paths * 1e9:.3g}" for r in (row, more)]
        passed, made = None if row is None else _percent(row.passed), f"{s.made_s:.2g}"
        known = [s.name, s.refractions, ns, moves, *both, _percent(_moves_share(found, s))]
        known += [_percent(s.moves_error), passed, made]
        rows.append(known)
    head = (
        "camera|refractions|ns per ray, alone|with differentials|ns per ray in the cheap render|with differentials|"
        "differentials add|their error|rays that pass|made in s"
    )
    missing = [f"{s.name}: {s.reason}." for s in found.subjects if s.reason]
    return "\n\n".join([lab.table(head, rows, "–"), *missing])


def _shape_table(shapes: Sequence[Shape]) -> str:
    first = shapes[0]
    rows = [
        [s.name, _percent(s.area), _percent(s.passed / first.passed), _percent(min(s.seconds) / min(first.seconds))]
        for s in shapes
    ]
    note = "Biconvex lens, C, cheap scene. Passage and time over the round stop's, area over the disc's."
    return f"{note}\n\n{lab.table('stop|area|rays that pass|time', rows, '–')}"


def _csv(found: Found) -> str:
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(
        "scene lens refractions camera differentials seconds_min seconds_median camera_seconds_min passed paths "
        "threads rounds camera_alone_ns".split()
    )
    for r in found.rows:
        if r.seconds:
            s = r.subject
            alone = s.ns_moves if r.differentials else s.ns
            writer.writerow(
                [r.scene, s.lens, s.refractions, s.kind, int(r.differentials), f"{min(r.seconds):.5f}"]
                + [f"{median(r.seconds):.5f}", f"{min(r.camera_s):.5f}", f"{r.passed:.5f}", r.paths, 1]
                + [len(r.seconds), "" if alone is None else f"{alone:.2f}"]
            )
    return text.getvalue()


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
    scenes = [s for s in SCENES if found.ideal(PINHOLE, s)]
    if not scenes:
        return
    with style():
        figure = new_figure(4.4 * len(scenes) + 2.6, 4.6)
        for axes, scene in zip(figure.subplots(1, len(scenes), squeeze=False)[0], scenes, strict=True):
            for kind, (colour, marker, fill) in _LOOK.items():
                points = [
                    (s.refractions, min(r.seconds))
                    for s in found.subjects
                    if s.kind == kind and (r := found.row(s, scene)) is not None
                ]
                if points:
                    look = {"color": colour, "mfc": fill, "mec": colour, "ms": 5, "lw": 1.1}
                    axes.plot(*zip(*points, strict=True), marker=marker, label=kind, **look)
            for kind, (colour, dash) in _LINES.items():
                row = found.ideal(kind, scene)
                if row is not None:
                    axes.axhline(min(row.seconds), color=colour, ls=dash, lw=1.2, label=kind)
            axes.set(
                xlabel="refractions of the lens", ylabel="seconds a render", title=scene, xlim=(0, None), ylim=(0, None)
            )
            axes.grid(True)
        handles, labels = figure.axes[0].get_legend_handles_labels()
        figure.suptitle("Render time over refractions", x=0.01, ha="left", fontweight="bold")
        figure.legend(handles, labels, loc="outside right upper")
        save(figure, path)


ABOUT = """\
Render three scenes of rising cost through a pinhole, a thin lens, a stop without glass, and lenses of 2 to 40
refractions: traced exactly (torch, and compiled as C), through their polynomials and networks in onnxruntime
and compiled (12 minutes of one core; --quick: one). Needs the extra "train" (torch) and a C compiler; what
this machine cannot make is left out, and said. Writes README.md, render_times.csv and render_times.png."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of `python -m experiments render`."""
    parser.add_argument("--quick", action="store_true", help="three lenses in the cheap scene, one small round")
    lab.add_out(parser, lab.RESULTS / "render_times")


def run(args: argparse.Namespace) -> int:
    """Make the cameras, time them alone and in renders; the tables are written after each step."""
    lab.quiet_glasses()
    torch.set_num_threads(1)
    found = Found(bench.Size(64, 36, 16, 1) if args.quick else bench.Size())
    scenes = bench.load_scenes(lab.ROOT, args.quick)
    progress = Progress({"cameras": 25, "cameras alone": 5, "renders": 65, "stop shapes": 5}, quiet=args.quiet)
    with progress.stage("cameras") as report:
        found.subjects = bench.make_subjects(lab.ROOT, args.quick, report)
    with progress.stage("cameras alone") as report:
        bench.time_alone(found.subjects, report)
    write(found, args.out)
    with progress.stage("renders") as report:
        found.rows = bench.time_renders(found.subjects, scenes, found.size, report)
    write(found, args.out)
    with progress.stage("stop shapes") as report:
        found.shapes = bench.time_shapes(lab.ROOT, scenes["cheap"], found.size, report)
    draw(found, args.out / "render_times.png")
    print(write(found, args.out))
    return 0
