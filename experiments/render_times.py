"""Render three scenes of rising cost through a pinhole, a thin lens, a stop without glass, and eight lenses.

The lenses, of 2 to 40 refractions, are traced exactly (torch, and compiled as C), through their polynomials and
networks in onnxruntime and compiled (12 minutes of one core; --quick: one). Needs the extra "train" (torch) and a C
compiler; what this machine cannot make is left out, and the page says so. The tables are those of Willi 2021
(multi-lens cameras in appleseed), 6.2 and 6.3. Writes README.md.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np
import torch

from experiments import lab
from experiments.lab import Report
from neurolens.base.errors import InputError
from neurolens.base.files import atomic_write_text
from neurolens.base.progress import Progress
from neurolens.cameras.build import FUSED, make_camera
from neurolens.cameras.contract import RAYS_A_CALL, Camera
from neurolens.lens.shot import Shot
from neurolens.render.renderer import render
from neurolens.render.scene import Scene, load_scene
from neurolens.render.settings import FilmSettings

PINHOLE, THIN, STOP = "pinhole", "thin lens", "stop only"
TORCH, EXACT_C = "exact, torch", "exact, C"
GRAPHS = ("polynomial, onnxruntime", "network, onnxruntime")
FUSED_MODELS = ("polynomial, C", "network, C")
KINDS = (TORCH, EXACT_C, *GRAPHS, *FUSED_MODELS)
_FILES = dict(zip((*GRAPHS, *FUSED_MODELS), ("ols-64", "mlp-16x2") * 2, strict=True))
# Scenes of rising cost: one bounce off a wall; small lights, three; meshes, gloss, glass, six.
CHEAP = "cheap"
SCENES = {CHEAP: "grid", "middle": "lights", "dear": "room"}
CHEAP_ROUNDS = 4  # times the rounds of the other scenes: there the camera counts most, and a render is short
# Refractions, name, file of lenses/, focal length in mm.
LENSES = (
    (2, "biconvex", "thorlabs_lb1471_biconvex_50", 49.83),
    (7, "Tessar (Brendel)", "brendel_tessar_100", 100.0),
    (10, "double Gauss (Tronnier)", "tronnier_double_gauss_100", 100.72),
    (14, "double Gauss (Angenieux)", "angenieux_double_gauss_100", 99.94),
    (18, "zoom (Itoh)", "itoh_zoom_100_146", 99.92),
    (25, "retrofocus (Ikemori)", "ikemori_retrofocus_14", 14.28),
    (33, "zoom (Ogawa)", "ogawa_zoom_70_200", 72.12),
    (40, "zoom 70-200 (Nikon)", "nikon_zoom_70_200", 71.5),
)
_QUICK = (2, 14, 40)
_FILM = (0.36, 0.2025)  # of the focal length
_FOCUS_M, _F_NUMBER = 5.0, 4.0
_ALONE_ROUNDS, _SLOW_S = 15, 0.1


@dataclass(frozen=True)
class Size:
    """The amount of rendering: pixels, samples per pixel, rounds."""

    width: int = 128
    height: int = 72
    samples: int = 16
    rounds: int = 5


@dataclass
class Subject:
    """A camera of the table; where it cannot be made, `camera` is None, and `reason` says why.

    Attributes:
        refractions: of the lens, None for an ideal camera. kind: one of `KINDS`, or an ideal camera.
        made_s: seconds to make it, compiling included.
        ns, ns_moves: nanoseconds of a ray without and with differentials, the camera alone, best of the rounds.
        moves_error: RMS error of differentials that are fitted.
    """

    lens: str
    refractions: int | None
    kind: str
    camera: Camera | None = None
    reason: str = ""
    made_s: float = 0.0
    ns: float | None = None
    ns_moves: float | None = None
    moves_error: float | None = None

    @property
    def name(self) -> str:
        return self.kind if self.lens == self.kind else f"{self.lens}, {self.kind}"


@dataclass
class Timed:
    """A camera in a scene: seconds of every round, in all and in the camera, and the share of rays that pass."""

    subject: Subject
    scene: str
    differentials: bool
    seconds: list[float] = field(default_factory=list)
    camera_s: list[float] = field(default_factory=list)
    passed: float = 0.0
    paths: int = 0


def make_subjects(quick: bool, report: Report) -> list[Subject]:
    """All cameras; one that this machine cannot make says why."""
    specs: list[tuple[Subject, str, float]] = [
        (Subject(PINHOLE, None, PINHOLE), "pinhole", 50.0),
        (Subject(THIN, None, THIN), "thin", 50.0),
        (Subject(STOP, 0, STOP), str(lab.ROOT / "experiments" / "lenses" / "stop_only_50.toml"), 50.0),
    ]
    for count, lens, stem, efl in LENSES:
        for kind in KINDS if not quick or count in _QUICK else ():
            file = lab.MODELS / f"{stem}.{_FILES[kind]}.onnx" if kind in _FILES else lab.LENSES / f"{stem}.toml"
            compiled = FUSED if kind in (EXACT_C, *FUSED_MODELS) else ""
            specs.append((Subject(lens, count, kind), f"{compiled}{file}", efl))
    for k, (subject, spec, efl) in enumerate(specs):
        began = time.perf_counter()
        try:
            subject.camera = make_camera(spec, shot(efl, spec))
            _differentials(subject.camera, 1)
            subject.moves_error = getattr(subject.camera, "differentials_error", None)
        except InputError as error:
            subject.reason = str(error).replace(f"{lab.ROOT}/", "")
        subject.made_s = time.perf_counter() - began
        report((k + 1) / len(specs))
    return [subject for subject, _, _ in specs]


def shot(efl: float, spec: str) -> Shot:
    """The settings of every camera."""
    f_number = None if spec == "pinhole" else _F_NUMBER
    return Shot((_FILM[0] * efl, _FILM[1] * efl), _FOCUS_M, f_number)


def _differentials(camera: Camera, count: int) -> Callable[[], object] | None:
    """A call that samples rays with differentials, run once; None for a camera without them."""
    call = partial(camera.sample_differentials, *_inputs(camera, count))  # type: ignore[attr-defined]
    try:
        call()
    except InputError:
        return None
    return call


def _inputs(camera: Camera, count: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The same random numbers for every camera: points over the film and the pupil's square, wavelengths."""
    rng = np.random.default_rng(1)
    film = (rng.random((2, count)) - 0.5) * np.array(camera.film_mm)[:, None]
    low, high = camera.wavelength_nm or (400.0, 700.0)
    wavelength = np.clip(rng.uniform(400, 700, count), low, high)
    return film.astype(np.float32), rng.random((2, count), np.float32), wavelength.astype(np.float32)


def time_alone(subjects: Sequence[Subject], report: Report) -> None:
    """Time every camera by itself, with and without differentials, in turn."""
    calls: list[tuple[Subject, str, int, Callable[[], object]]] = []
    for s in subjects:
        if s.camera is not None:
            count = getattr(s.camera, "rays_a_call", RAYS_A_CALL)
            calls.append((s, "ns", count, partial(s.camera.sample, *_inputs(s.camera, count))))
            moves = _differentials(s.camera, count)
            if moves is not None:
                calls.append((s, "ns_moves", count, moves))
    for k in range(_ALONE_ROUNDS):
        for s, what, count, call in calls:
            least: float | None = getattr(s, what)
            if least is None or least * count <= _SLOW_S * 1e9:  # one slow call is measured well enough
                began = time.perf_counter()
                call()
                ns = (time.perf_counter() - began) / count * 1e9
                setattr(s, what, ns if least is None else min(least, ns))
        report((k + 1) / _ALONE_ROUNDS)


def time_renders(subjects: Sequence[Subject], scenes: dict[str, Scene], size: Size, report: Report) -> list[Timed]:
    """Every camera in every scene; in the cheap one also with differentials, where they take no minute."""
    rows = []
    for cost in scenes:
        for s in subjects:
            if s.camera is not None:
                rows.append(Timed(s, cost, False))
                if cost == CHEAP and s.ns_moves is not None and s.kind not in {TORCH, *GRAPHS}:
                    rows.append(Timed(s, cost, True))  # right after, for their ratio
    rounds = {cost: size.rounds * (CHEAP_ROUNDS if cost == CHEAP else 1) for cost in scenes}
    for k in range(max(rounds.values())):
        for i, row in enumerate(rows):
            if k < rounds[row.scene]:
                assert row.subject.camera is not None
                stats = one_render(scenes[row.scene], row.subject.camera, size, row.differentials)
                row.seconds.append(stats["seconds"])
                row.camera_s.append(stats["camera_thread_seconds"])
                row.passed, row.paths = stats["passed_fraction"], int(stats["paths"])
            report((k + (i + 1) / len(rows)) / max(rounds.values()))
    return rows


def one_render(scene: Scene, camera: Camera, size: Size, differentials: bool = False) -> dict[str, float]:
    """Statistics of one render."""
    pixels: dict[str, Any] = {"width": size.width, "height": size.height, "samples": size.samples}
    shown = _WithDifferentials(camera) if differentials else camera
    return render(scene, shown, **pixels, seed=1, threads=1, film=FilmSettings(wavelengths="one")).stats


class _WithDifferentials:
    """A camera that computes the differentials of all its rays, which the renderer does not use, to time them."""

    def __init__(self, camera: Camera) -> None:
        self._camera = camera
        self.sample = camera.sample_differentials  # type: ignore[attr-defined]

    def __getattr__(self, name: str) -> Any:
        return getattr(self._camera, name)


# ---- The page. -------------------------------------------------------------------------------------------------------

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
class Results:
    """The results so far."""

    size: Size
    subjects: list[Subject] = field(default_factory=list)
    rows: list[Timed] = field(default_factory=list)

    def row(self, subject: Subject | str, scene: str, differentials: bool = False) -> Timed | None:
        """The times of a camera (of an ideal one by its kind) in a scene, if there are any."""
        for r in self.rows:
            if subject in (r.subject, r.subject.kind) and (r.scene, r.differentials) == (scene, differentials):
                return r if r.seconds else None
        return None

    def above_thin(self, subject: Subject, scene: str) -> float | None:
        """Seconds in the camera above those of the thin lens, over the pinhole's render."""
        if (row := self.row(subject, scene)) and (thin := self.row(THIN, scene)) and (hole := self.row(PINHOLE, scene)):
            return (min(row.camera_s) - min(thin.camera_s)) / min(hole.seconds)
        return None

    def moves_share(self, subject: Subject) -> float | None:
        """Median over the rounds of the camera's seconds with differentials over those without, less 1."""
        if (row := self.row(subject, CHEAP)) and (more := self.row(subject, CHEAP, True)):
            return median(with_ / without for with_, without in zip(more.camera_s, row.camera_s, strict=True)) - 1
        return None

    def overhead(self, subject: Subject, scene: str) -> float | None:
        """Time above the pinhole's over the pinhole's, per refraction; of an ideal camera as a whole."""
        if (row := self.row(subject, scene)) and (pinhole := self.row(PINHOLE, scene)):
            return (min(row.seconds) / min(pinhole.seconds) - 1) / max(subject.refractions or 1, 1)
        return None

    def ns_in_render(self, subject: Subject, differentials: bool = False) -> float | None:
        """Nanoseconds a ray in the cheap render."""
        row = self.row(subject, CHEAP, differentials)
        return None if row is None else min(row.camera_s) / row.paths * 1e9


def goals(results: Results) -> list[lab.Goal]:
    """The goals of every kind of camera in every scene; the worst lens counts."""

    def goal(kind: str, text: str, wanted: float, share: Callable[[Subject], float | None]) -> lab.Goal:
        known = {s.lens: v for s in results.subjects if s.kind == kind and (v := share(s)) is not None}
        worst = max(known, key=lambda name: known[name], default="")
        return lab.Goal(f"{kind}: {text}", wanted, known.get(worst), worst=worst)

    above, adds = "camera above the thin lens's, of the {} pinhole render", "what differentials add to the camera"
    made = [
        goal(kind, above.format(scene), ABOVE_THIN, partial(results.above_thin, scene=scene))
        for kind in (*FUSED_MODELS, *GRAPHS)
        for scene in SCENES
    ]
    made += [goal(k, f"{adds}, in the cheap render", MOVES, results.moves_share) for k in (EXACT_C, *FUSED_MODELS)]
    text, overhead = "overhead a refraction, of the cheap pinhole render", partial(results.overhead, scene=CHEAP)
    return made + [goal(kind, text, PER_REFRACTION, overhead) for kind in (EXACT_C, TORCH)]


def write(results: Results, out: Path) -> str:
    """Write README.md; returns the page."""
    out.mkdir(parents=True, exist_ok=True)
    text = page(results)
    atomic_write_text(out / "README.md", text)
    return text


def _percent(share: float | None) -> str | None:
    return None if share is None else f"{100 * share:.3g}%"


_GOALS = lab.columns(
    ("goal", "text"), ("wanted", lambda g: f"at most {_percent(g.wanted)}"),
    ("measured, worst lens", lambda g: _percent(g.measured)), ("lens", "worst"), ("", "verdict"),
)  # fmt: skip
_LEGEND = """\
Seconds (median); overhead over the pinhole per refraction; share of the camera. Ideal cameras stand in the
first column."""


def page(results: Results) -> str:
    """All tables."""
    timed = {r.scene for r in results.rows if r.seconds}
    parts = [f"## Seconds, {s}\n\n{_LEGEND}\n\n{_scene_table(results, s)}" for s in SCENES if s in timed]
    missing = [f"{s.name}: {s.reason}." for s in results.subjects if s.reason]
    return lab.page(
        "# Render time by camera",
        "`python -m experiments render`",
        _NOTES.format(**vars(results.size), **SCENES, more=CHEAP_ROUNDS),
        lab.machine_line(", one of them used"),
        "## Goals",
        lab.table(_GOALS, goals(results), "–"),
        *parts,
        "## Cameras by themselves",
        lab.table(_camera_columns(results), results.subjects, "–"),
        *missing,
    )


def _scene_table(results: Results, scene: str) -> str:
    """One row per lens, one column per kind: seconds, overhead a refraction, share of the camera."""

    def cell(kind: str, of: dict[str, Subject]) -> str | None:
        row = results.row(of[kind], scene) if kind in of else None
        if row is None:
            return None
        over = "" if kind == PINHOLE else f"; {_percent(results.overhead(of[kind], scene))}"
        share = _percent(min(row.camera_s) / min(row.seconds))
        return f"{lab.best_median(min(row.seconds), median(row.seconds), form='.3f')}{over}; {share}"

    rows = []
    for lens, count in dict.fromkeys((s.lens, s.refractions) for s in results.subjects):
        of = {s.kind: s for s in results.subjects if s.lens == lens}
        shown = (lens, *KINDS[1:]) if lens in (PINHOLE, THIN, STOP) else KINDS
        rows.append([lens, count, *(cell(kind, of) for kind in shown)])
    return lab.table(["lens", "refractions", *KINDS], rows, "–")


def _camera_columns(results: Results) -> tuple[lab.Column, ...]:
    return lab.columns(
        ("camera", "name"),
        ("refractions", "refractions"),
        ("ns per ray, alone", "ns", ".3g"),
        ("with differentials", "ns_moves", ".3g"),
        ("ns per ray in the cheap render", results.ns_in_render, ".3g"),
        ("with differentials", partial(results.ns_in_render, differentials=True), ".3g"),
        ("differentials add", lambda s: _percent(results.moves_share(s))),
        ("their error", lambda s: _percent(s.moves_error)),
        ("rays that pass", lambda s: _percent(row.passed) if (row := results.row(s, CHEAP)) else None),
        ("made in s", "made_s", ".2g"),
    )


OPTIONS = (
    lab.option("--quick", action="store_true", help="three lenses in the cheap scene, one small round"),
    lab.out(lab.RESULTS / "render_times"),
)


def run(args: argparse.Namespace) -> None:
    """Make the cameras, time them alone and in renders; the tables are written after each step."""
    lab.quiet_glasses()
    torch.set_num_threads(1)
    results = Results(Size(64, 36, 16, 1) if args.quick else Size())
    chosen = list(SCENES.items())[: 1 if args.quick else 3]
    scenes = {cost: load_scene(lab.SCENES / f"{name}.toml") for cost, name in chosen}
    progress = Progress({"cameras": 25, "cameras alone": 5, "renders": 65}, quiet=args.quiet)
    with progress.stage("cameras") as report:
        results.subjects = make_subjects(args.quick, report)
    with progress.stage("cameras alone") as report:
        time_alone(results.subjects, report)
    write(results, args.out)
    with progress.stage("renders") as report:
        results.rows = time_renders(results.subjects, scenes, results.size, report)
    write(results, args.out)
    print(write(results, args.out))
