"""Whether the seconds that plans print are those of renders, whether two plans agree, and what a plan takes itself.

Each scene is planned through a double Gauss; the exact lens, a model and a thick lens with an ST map are then rendered
whole with two seeds. The seconds of a render times its variance over the exact lens's are set beside the plan's. Then
small pictures are planned twice, as `neurolens plan` does by default. All seconds are of the processor, for
the clock counts other work, too. Writes plan_times.md and plan_times.json.
"""

from __future__ import annotations

import argparse
import os
import time
from dataclasses import replace
from typing import Any

import numpy as np

from experiments import lab
from experiments.pictures.plans import camera_of
from neurolens.cameras.build import as_c, ideal_as
from neurolens.cameras.contract import Camera
from neurolens.pictures.render.renderer import render
from neurolens.pictures.render.scene import Scene, load_scene
from neurolens.studies.plan import plan as plans
from neurolens.studies.plan.candidates import EXACT

SCENES, LENS, MODEL, PLAIN = ("garden", "room", "lights"), "laikin_double_gauss_50", "ols-36", "thick + ST map"
_COUNTED = 95.0  # percentile of squared differences above which the rarest lights are left to chance

SIZES = (96, 16), (640, 16)  # width and samples of small pictures; `plans` has large ones

OPTIONS = (
    lab.count("samples", 16, "of a pixel (default: 16)"),
    lab.count("width", 640, "of the pictures (default: 640)", 64), lab.ONLY, lab.out(),
)  # fmt: skip


def rendered(scene: Scene, camera: Camera) -> tuple[float, float]:
    """Seconds of a thread and relative variance of a whole picture."""
    found, seconds = [], []
    for seed in (3, 4):
        began = time.process_time()
        found.append(render(scene, camera, threads=1, seed=seed).rgb.astype(np.float64))
        seconds.append(time.process_time() - began)
    one, two = found
    apart = np.square(one - two).mean(axis=-1)
    variance = np.minimum(apart, np.percentile(apart, _COUNTED)).mean() / 2 / one.mean() ** 2
    return min(seconds), float(variance)


def sized(name: str, width: int, samples: int) -> Scene:
    """A scene at another size, of 16 to 9."""
    scene = load_scene(lab.SCENES / f"{name}.toml")
    shot = replace(scene.settings.camera, samples=samples, width=width, height=round(width * 9 / 16))
    film = shot.film_mm[0], shot.film_mm[0] * shot.height / shot.width
    return replace(scene, settings=replace(scene.settings, camera=replace(shot, film_mm=film)))


def twice(name: str, width: int, samples: int) -> lab.Row:
    """Two plans of a picture: the camera and its price, and what the first took."""
    row: lab.Row = {"scene": name, "width": width, "samples": samples}
    for run in (1, 2):
        lens, began, clock = lab.lens_of(LENS), os.times(), time.perf_counter()
        made = plans.plan(sized(name, width, samples), lens, models=sorted(lab.MODELS.glob(f"{LENS}.*.onnx")))
        took = sum(os.times()[:4]) - sum(began[:4])
        assert made.best is not None
        row |= {f"camera_{run}": made.best.name, f"price_{run}": made.best.seconds, f"plan_{run}": took}
        row |= {f"clock_{run}": time.perf_counter() - clock}
    row["share"] = row["plan_1"] / row["price_1"]
    row["apart"] = max(row["price_1"], row["price_2"]) / min(row["price_1"], row["price_2"]) - 1
    return row


def case(name: str, args: argparse.Namespace) -> list[lab.Row]:
    """The cameras of one scene."""
    scene = sized(name, args.width, args.samples)
    models = [lab.MODELS / f"{LENS}.{MODEL}.onnx"]
    made = plans.plan(scene, lab.lens_of(LENS), 1e9, models=models, explain=True)
    rows: list[lab.Row] = []
    for choice in made.choices:
        if choice.name in (EXACT, PLAIN) or choice.name.endswith(MODEL):
            camera: Any = camera_of(choice, made.probed, None)
            area = getattr(camera, "area", 1.0)
            if choice.name == PLAIN:  # the map is applied afterwards, to a larger picture
                camera = as_c(ideal_as("thick:", made.probed.exact.lens, made.probed.shot))
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
_TWICE = lab.columns(
    ("scene", "scene"), ("width", "width"), ("samples", "samples"), ("camera", "camera_1"),
    ("picture, s", "price_1", ".3g"), ("again", "price_2", ".3g"), ("apart", "apart", ".0%"),
    ("plan, s", "plan_1", ".2g"), ("again", "plan_2", ".2g"), ("by the clock", "clock_1", ".2g"),
    ("plan over picture", "share", ".2g"),
)  # fmt: skip


def run(args: argparse.Namespace) -> None:
    """Plan, render and write."""
    lab.quiet_glasses()
    names = lab.chosen(list(SCENES), str, args.only, "plan-times")
    rows = [row for name in lab.counted(names, "scenes", args.quiet) for row in case(name, args)]
    head = f"`python -m experiments plan-times`: {LENS}, {args.samples} samples, {args.width} pixels wide; "
    pairs = [twice(name, *size) for size in SIZES for name in names]
    load = f"; {os.getloadavg()[0]:.0f} programs ran at the end of it."
    page = lab.page(
        "# Seconds of plans", head + lab.machine_line().removesuffix(".") + load, lab.table(_COLUMNS, rows),
        "Two plans of each picture, at 0.25 px; the first compiles and fits what the second finds ready:",
        lab.table(_TWICE, pairs),
    )  # fmt: skip
    print(lab.write_results(args.out, "plan_times", page, {"machine": lab.machine(), "rows": rows, "twice": pairs}))
