"""Render three scenes of rising cost through a pinhole, a thin lens, a stop without glass, and eight lenses.

The lenses, of 2 to 40 refractions, are traced exactly, through their polynomials and networks, in
onnxruntime and as compiled C (12 minutes of one core; --quick: one). Needs the extra "train" (torch) and a C
compiler; what this machine cannot make is left out, and the page says so. The tables are those of Willi 2021
(multi-lens cameras in appleseed), 6.2 and 6.3. Writes README.md.
"""

from __future__ import annotations

import argparse
from collections import defaultdict
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from statistics import median
from typing import Any

import numpy as np
import torch

from experiments import lab
from experiments.lab import Report
from neurolens.base.errors import InputError
from neurolens.base.files import atomic_write_text
from neurolens.base.progress import Progress
from neurolens.cameras.build import make_camera
from neurolens.cameras.contract import Camera
from neurolens.optics.lens.shot import Runtime, Shot
from neurolens.pictures.render.renderer import render
from neurolens.pictures.render.scene import Scene, load_scene
from neurolens.pictures.render.settings import FilmSettings

PINHOLE, THIN, STOP = "pinhole", "thin lens", "stop only"
EXACT_GRAPH, EXACT_C = "exact, onnxruntime", "exact, C"
GRAPHS = ("polynomial, onnxruntime", "network, onnxruntime")
FUSED_MODELS = ("polynomial, C", "network, C")
KINDS = (EXACT_GRAPH, EXACT_C, *GRAPHS, *FUSED_MODELS)
_FILES = dict(zip((*GRAPHS, *FUSED_MODELS), ("ols-64", "mlp-16x2") * 2, strict=True))
# Scenes of rising cost: one bounce off a wall; small lights, three; meshes, gloss, glass, six.
CHEAP, MOVES = "cheap", "with differentials"
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
_SIZE = (128, 72, 16, 5)  # pixels, samples of each, rounds
_GREEN = np.full(1, 550, np.float32)


@dataclass
class Subject:
    """A camera of the table; where it cannot be made, `camera` is None, and `reason` says why.

    Attributes:
        refractions: of the lens, None for an ideal camera. kind: one of `KINDS`, or an ideal camera.
        seconds, camera_s: by scene, of every round: of a render, and of its camera alone; under `MOVES` of the cheap
            scene with differentials.
    """

    lens: str
    refractions: int | None
    kind: str
    camera: Camera | None = None
    reason: str = ""
    seconds: dict[str, list[float]] = field(default_factory=lambda: defaultdict(list))
    camera_s: dict[str, list[float]] = field(default_factory=lambda: defaultdict(list))


class _WithDifferentials:
    """A camera that computes the differentials of all its rays, which the renderer does not use, to time them."""

    def __init__(self, camera: Camera) -> None:
        self._camera = camera
        self.sample = camera.sample_differentials  # type: ignore[attr-defined]

    def __getattr__(self, name: str) -> Any:
        return getattr(self._camera, name)


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
            specs.append((Subject(lens, count, kind), str(file), efl))
    for k, (subject, spec, efl) in enumerate(specs):
        film, f_number = (_FILM[0] * efl, _FILM[1] * efl), None if spec == "pinhole" else _F_NUMBER
        try:
            runtime: Runtime = "c" if subject.kind in (EXACT_C, *FUSED_MODELS) else "onnxruntime"
            camera: Any = make_camera(spec, Shot(film, _FOCUS_M, f_number, runtime=runtime))
            subject.camera = camera
            if subject.kind in (EXACT_C, *FUSED_MODELS):  # fits its differentials here, not in every render
                camera.sample_differentials(*(np.full((n, 1), v, np.float32) for n, v in ((2, 0), (2, 0.5))), _GREEN)
        except InputError as error:
            subject.reason = str(error).replace(f"{lab.ROOT}/", "")
        report((k + 1) / len(specs))
    return [subject for subject, _, _ in specs]


def time_renders(subjects: Sequence[Subject], scenes: dict[str, Scene], size: dict[str, int], report: Report) -> None:
    """Every camera in every scene in turn; in the cheap one compiled cameras also with differentials."""
    runs: list[tuple[Subject, str, Any]] = []
    for cost in scenes:
        for s in subjects:
            runs += [(s, cost, s.camera)] if s.camera is not None else []
            if cost == CHEAP and s.camera is not None and s.kind in (EXACT_C, *FUSED_MODELS):
                runs.append((s, MOVES, _WithDifferentials(s.camera)))  # right after, for their ratio
    pixels: dict[str, Any] = {key: size[key] for key in ("width", "height", "samples")}
    rounds = {cost: size["rounds"] * (CHEAP_ROUNDS if cost in (CHEAP, MOVES) else 1) for _, cost, _ in runs}
    for k in range(-1, max(rounds.values())):  # the first round fits what the cameras need, and does not count
        for i, (s, cost, camera) in enumerate(runs):
            if k < rounds[cost]:
                shown, film = scenes.get(cost, scenes[CHEAP]), FilmSettings(wavelengths="one")
                few = pixels if k >= 0 else pixels | {"samples": 1}
                stats = render(shown, camera, **few, seed=1, threads=1, film=film).stats
                if k >= 0:
                    s.seconds[cost].append(stats.seconds)
                    s.camera_s[cost].append(stats.camera_thread_seconds)
            report((k + 1 + (i + 1) / len(runs)) / (max(rounds.values()) + 1))


# ---- The page. -------------------------------------------------------------------------------------------------------

ABOVE_THIN, MOST_MOVES, PER_REFRACTION = 0.05, 0.30, 0.10  # the goals, as shares
_NOTES = """\
Every camera sees the same 20 degrees at f/4, focused at 5 m, one wavelength per path, {width} x {height} pixels,
{samples} samples, one thread, {rounds} rounds of all cameras in turn ({more} times as many in the cheap scene);
seconds are the best round (the median in brackets), what differentials add is the median of the rounds' ratios.
`cheap` is a textured wall and one bounce ({cheap}.toml), `middle` small lights and three ({middle}.toml), `dear`
meshes, gloss, glass and six ({dear}.toml). Lenses and models run in onnxruntime and as compiled C (`--runtime`), each
with the pupil, weights and status around it in one call;
polynomials are `ols-64` of models/, networks `mlp-16x2`. Overhead is the time above the pinhole's, as a share of the
pinhole's render, per refraction. Camera is the share of a render's time that its camera takes. Blocked rays cost no
path: a lens that loses light renders faster for it. Differentials are computed and handed on; nothing uses them."""
_LEGEND = """\
Seconds (median); overhead over the pinhole per refraction; share of the camera. Ideal cameras stand in the
first column."""


def overhead(subject: Subject, pinhole: Subject, scene: str) -> float:
    """Time above the pinhole's over the pinhole's, per refraction; of an ideal camera as a whole."""
    times = min(subject.seconds[scene]) / min(pinhole.seconds[scene])
    return (times - 1) / max(subject.refractions or 1, 1)


def goals(subjects: Sequence[Subject]) -> list[lab.Goal]:
    """The goals of every kind of camera in every scene; the worst lens counts."""
    thin, hole = (next(s for s in subjects if s.kind == kind) for kind in (THIN, PINHOLE))

    def goal(kind: str, text: str, wanted: float, scene: str, share: Callable[[Subject], float]) -> lab.Goal:
        known = {s.lens: share(s) for s in subjects if s.kind == kind and s.seconds[scene]}
        worst = max(known, key=lambda name: known[name], default="")
        return lab.Goal(f"{kind}: {text}", wanted, known.get(worst), worst=worst)

    def above_thin(scene: str) -> Callable[[Subject], float]:
        return lambda s: (min(s.camera_s[scene]) - min(thin.camera_s[scene])) / min(hole.seconds[scene])

    def moves(s: Subject) -> float:
        return median(a / b for a, b in zip(s.camera_s[MOVES], s.camera_s[CHEAP], strict=True)) - 1

    above, adds = "camera above the thin lens's, of the {} pinhole render", "what differentials add to the camera"
    made = [
        goal(kind, above.format(scene), ABOVE_THIN, scene, above_thin(scene))
        for kind in (*FUSED_MODELS, *GRAPHS)
        for scene in SCENES
    ]
    made += [goal(k, f"{adds}, in the cheap render", MOST_MOVES, MOVES, moves) for k in (EXACT_C, *FUSED_MODELS)]
    text = "overhead a refraction, of the cheap pinhole render"
    share = partial(overhead, pinhole=hole, scene=CHEAP)
    return made + [goal(kind, text, PER_REFRACTION, CHEAP, share) for kind in (EXACT_C, EXACT_GRAPH)]


def _percent(share: float | None) -> str | None:
    return None if share is None else f"{100 * share:.3g}%"


_GOALS = lab.columns(
    ("goal", "text"), ("wanted", lambda g: f"at most {_percent(g.wanted)}"),
    ("measured, worst lens", lambda g: _percent(g.measured)), ("lens", "worst"), ("", "verdict"),
)  # fmt: skip


def scene_table(subjects: Sequence[Subject], scene: str) -> str:
    """One row per lens, one column per kind: seconds, overhead a refraction, share of the camera."""
    hole = next(s for s in subjects if s.kind == PINHOLE)

    def cell(s: Subject | None) -> str | None:
        if s is None or not s.seconds[scene]:
            return None
        over = "" if s is hole else f"; {_percent(overhead(s, hole, scene))}"
        share = _percent(min(s.camera_s[scene]) / min(s.seconds[scene]))
        times = lab.best_median(min(s.seconds[scene]), median(s.seconds[scene]), form=".3f")
        return f"{times}{over}; {share}"

    rows = []
    for lens, count in dict.fromkeys((s.lens, s.refractions) for s in subjects):
        of = {s.kind: s for s in subjects if s.lens == lens}
        shown = (lens, *KINDS[1:]) if lens in (PINHOLE, THIN, STOP) else KINDS
        rows.append([lens, count, *(cell(of.get(kind)) for kind in shown)])
    return lab.table(["lens", "refractions", *KINDS], rows, "–")


OPTIONS = (
    lab.option("--quick", action="store_true", help="three lenses in the cheap scene, one small round"),
    lab.out(lab.RESULTS / "render_times"),
)


def run(args: argparse.Namespace) -> None:
    """Make the cameras, time them in renders, write the page."""
    lab.quiet_glasses()
    torch.set_num_threads(1)
    names = dict(list(SCENES.items())[: 1 if args.quick else 3])
    scenes = {cost: load_scene(lab.SCENES / f"{name}.toml") for cost, name in names.items()}
    size = dict(zip(("width", "height", "samples", "rounds"), (64, 36, 16, 1) if args.quick else _SIZE, strict=True))
    progress = Progress({"cameras": 25, "renders": 65}, quiet=args.quiet)
    with progress.stage("cameras") as report:
        subjects = make_subjects(args.quick, report)
    with progress.stage("renders") as report:
        time_renders(subjects, scenes, size, report)
    text = lab.page(
        "# Render time by camera", "`python -m experiments render`",
        _NOTES.format(**size, **SCENES, more=CHEAP_ROUNDS), lab.machine_line(", one of them used"),
        "## Goals", lab.table(_GOALS, goals(subjects), "–"),
        *(f"## Seconds, {scene}\n\n{_LEGEND}\n\n{scene_table(subjects, scene)}" for scene in scenes),
        *(f"{s.lens}, {s.kind}: {s.reason}." for s in subjects if s.reason),
    )  # fmt: skip
    args.out.mkdir(parents=True, exist_ok=True)
    atomic_write_text(args.out / "README.md", text)
    print(text)
