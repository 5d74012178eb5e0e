"""`neurolens bench mitsuba`: speed of the renderer beside Mitsuba 3, by scene, and its memory."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path
from typing import Any

from neurolens.commands.arguments import whole

_DESCRIPTION = """\
Paths per second of the renderer beside the scalar and LLVM variants of Mitsuba 3, on Mitsuba's own
Cornell box, with its pinhole and through a lens model; then of our scenes, where their time goes, and
the memory that a render takes by picture size. Without the extra "mitsuba", our side alone.
Writes render_speed.md and render_speed.json."""
SCENES = ("cornell", "room", "lights", "grid")
MODEL = "laikin_double_gauss_50.ols-60.onnx"
SCENE_SAMPLES, SCENE_WIDTH = 16, 240
WIDTHS, MANY_SAMPLES = (256, 512, 1024, 2048), 64


def add_parser(kinds: Any) -> None:
    """Add the command to those of `neurolens bench`."""
    parser = kinds.add_parser("mitsuba", help="speed of the renderer beside Mitsuba 3", description=_DESCRIPTION)
    parser.add_argument("--size", metavar="PIXELS", type=whole(16, 2048), default=256, help="side (default: 256)")
    parser.add_argument("--samples", metavar="N", type=whole(1, 4096), default=16, help="a pixel (default: 16)")
    parser.add_argument("--repeats", metavar="N", type=whole(1, 100), default=5, help="default: 5")
    parser.add_argument("--threads", metavar="N", type=whole(1, 256), default=2, help="of all (default: 2)")
    parser.add_argument("--out", metavar="DIR", type=Path, help="folder for the tables (default: experiments/results)")
    parser.add_argument("--quiet", action="store_true", help="no progress on stderr")
    parser.set_defaults(run=run, kept="what was measured is in the table")


def run(args: argparse.Namespace) -> int:
    """Measure, writing the page after each part."""
    from neurolens.base.errors import NeurolensError
    from neurolens.base.progress import Progress
    from neurolens.evaluate.benches.mitsuba_speed import Settings
    from neurolens.evaluate.benches.mitsuba_speed_page import Found, page, write
    from neurolens.evaluate.project import project_root

    root = project_root()
    out = args.out or root / "experiments" / "results"
    settings = Settings(args.size, args.samples, args.threads, args.repeats)
    found = Found(settings, _versions())
    parts = {"beside Mitsuba": _beside, "scenes": _scenes, "memory": _memory}
    progress = Progress(dict(zip(parts, (120.0, 60.0, 40.0), strict=True)), quiet=args.quiet)
    for name, part in parts.items():
        with progress.stage(name) as report:
            try:
                part(root, found, report)
            except NeurolensError as error:
                found.missing.append(f"{name} ({error})")
        write(found, out)
    print(page(found))
    return 0


def _versions() -> dict[str, str]:
    from importlib.metadata import PackageNotFoundError, version

    known = {}
    for package in ("numpy", "mitsuba", "drjit", "embreex"):
        try:
            known[package] = version(package)
        except PackageNotFoundError:
            continue
    return known


def _beside(root: Path, found: Any, report: Callable[[float], None]) -> None:
    from neurolens.evaluate.benches.mitsuba_speed import measure, record, rows

    made = rows(root / "models" / MODEL, found.settings)
    measure(made, found.settings, report)
    found.rows = [record(row, found.settings, made[0]) for row in made]


def _scenes(root: Path, found: Any, report: Callable[[float], None]) -> None:
    """Each scene: timed with all threads, then profiled with one."""
    from neurolens.evaluate.benches.mitsuba_speed_profile import profile, thin_camera
    from neurolens.render.renderer import render
    from neurolens.render.scene import load_scene

    files = [file for name in SCENES if (file := root / "experiments" / "scenes" / f"{name}.toml").is_file()]
    repeats = min(found.settings.repeats, 5)
    for k, file in enumerate(files):
        scene = load_scene(file)
        camera = thin_camera(scene)
        height = round(SCENE_WIDTH * camera.film_mm[1] / camera.film_mm[0])
        speeds = []
        for seed in range(repeats):
            done = render(
                scene, camera, width=SCENE_WIDTH, height=height, samples=SCENE_SAMPLES,
                threads=found.settings.threads, seed=seed,
            )  # fmt: skip
            speeds.append(float(done.stats["mpaths_per_s"]))
            report((k + (seed + 1) / (repeats + 1)) / len(files))
        found.scenes.append(
            {
                "scene": file.stem,
                "max_depth": scene.settings.camera.max_depth,
                "mpaths_per_s": max(speeds),
                "mpaths_per_s_median": sorted(speeds)[len(speeds) // 2],
                "shares": profile(scene, camera, SCENE_WIDTH, height, SCENE_SAMPLES),
            }
        )


def _memory(root: Path, found: Any, report: Callable[[float], None]) -> None:
    from neurolens.evaluate.benches.mitsuba_speed_memory import memory_of

    scene = root / "experiments" / "scenes" / "room.toml"
    cases = [*((width, 1) for width in WIDTHS), (WIDTHS[0], MANY_SAMPLES)]
    for k, (width, samples) in enumerate(cases):
        found.memory.append(memory_of(scene, width, samples))
        report((k + 1) / len(cases))
