"""Whether the seconds that plans print are those of renders: whole pictures to equal noise, through three cameras.

Each scene is planned at its own size through a double Gauss; the exact lens, a model and a thick lens with an ST map
are then rendered whole with two seeds. The seconds of a render times its variance over the exact lens's are set beside
the plan's. Writes plan_times.md and plan_times.json.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from typing import Any

import numpy as np

from experiments import lab
from neurolens.cameras.build import as_c, ideal_as
from neurolens.cameras.contract import Camera
from neurolens.plan import plan as plans
from neurolens.plan.candidates import EXACT, camera_of
from neurolens.render.renderer import render
from neurolens.render.scene import Scene, load_scene

SCENES, LENS, MODEL, PLAIN = ("garden", "room", "lights"), "laikin_double_gauss_50", "ols-36", "thick + ST map"
_COUNTED = 95.0  # percentile of squared differences above which the rarest lights are left to chance

OPTIONS = (
    lab.count("samples", 16, "of a pixel (default: 16)"),
    lab.count("width", 640, "of the pictures (default: 640)", 64), lab.ONLY, lab.out(),
)  # fmt: skip


def rendered(scene: Scene, camera: Camera) -> tuple[float, float]:
    """Seconds of a thread and relative variance of a whole picture."""
    found = [render(scene, camera, threads=1, seed=seed) for seed in (3, 4)]
    one, two = (f.rgb.astype(np.float64) for f in found)
    apart = np.square(one - two).mean(axis=-1)
    variance = np.minimum(apart, np.percentile(apart, _COUNTED)).mean() / 2 / one.mean() ** 2
    return min(f.stats["thread_seconds"] for f in found), float(variance)


def case(name: str, args: argparse.Namespace) -> list[lab.Row]:
    """The cameras of one scene."""
    scene = load_scene(lab.SCENES / f"{name}.toml")
    shot = replace(scene.settings.camera, samples=args.samples, width=args.width, height=round(args.width * 9 / 16))
    film = shot.film_mm[0], shot.film_mm[0] * shot.height / shot.width
    scene = replace(scene, settings=replace(scene.settings, camera=replace(shot, film_mm=film)))
    models = [lab.MODELS / f"{LENS}.{MODEL}.onnx"]
    made = plans.plan(scene, lab.lens_of(LENS), 1e9, models=models, explain=True)
    rows: list[lab.Row] = []
    for choice in made.choices:
        if choice.name in (EXACT, PLAIN) or choice.name.endswith(MODEL):
            camera: Any = camera_of(made.probed, choice)
            area = getattr(camera, "area", 1.0)
            if choice.name == PLAIN:  # the map is applied afterwards, to a larger picture
                camera = as_c(ideal_as("thick:", made.probed.exact.lens, made.probed.asked.shot))
            render(scene, camera, threads=1, samples=1)  # compiles what it needs
            seconds, variance = rendered(scene, camera)
            rows.append({"scene": name, "camera": choice.name.rpartition(".")[2] or choice.name,
                         "planned": choice.seconds, "seconds": area * seconds, "variance": variance})  # fmt: skip
    (exact,) = (row for row in rows if row["camera"] == EXACT)
    for row in rows:
        row["measured"] = row["seconds"] * row["variance"] / exact["variance"]
        row["off"] = row["planned"] / row["measured"] - 1
        row["over"] = row["planned"] / exact["planned"] / (row["measured"] / exact["seconds"]) - 1
    return rows


_COLUMNS = lab.columns(
    ("scene", "scene"), ("camera", "camera"), ("plan, s", "planned", ".2f"), ("render, s", "seconds", ".2f"),
    ("variance", "variance", ".2e"), ("to the exact lens's noise, s", "measured", ".2f"),
    ("plan over that", "off", "+.0%"),
    ("relative to the exact lens", "over", "+.0%"),
)  # fmt: skip


def run(args: argparse.Namespace) -> None:
    """Plan, render and write."""
    lab.quiet_glasses()
    names = lab.chosen(list(SCENES), str, args.only, "plan-times")
    rows = [row for name in lab.counted(names, "scenes", args.quiet) for row in case(name, args)]
    head = f"`python -m experiments plan-times`: {LENS}, {args.samples} samples, {args.width} pixels wide; "
    page = lab.page("# Seconds of plans", head + lab.machine_line(), lab.table(_COLUMNS, rows))
    print(lab.write_results(args.out, "plan_times", page, {"machine": lab.machine(), "rows": rows}))
