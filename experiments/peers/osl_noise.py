"""Noise of pictures in Blender's Cycles with the dispersion of a lens and without, and what adaptive sampling takes.

A polynomial of a 50 mm double Gauss at f/1.8 as a shader, focused on 2 m, before a white sky and before meshes and
lamps at 1 to 5 m, most of them out of focus. Noise is the root of the mean squared difference from a picture of many
samples over pixels and channels, over the picture's mean; at 16 samples that of the worst channel and of the median
pixel, too. Cycles stops at a pixel when half of its samples agree with all within the noise threshold. Writes
osl_noise.md and osl_noise.json.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Mapping, Sequence
from functools import partial
from operator import itemgetter
from typing import Any

from experiments import lab
from experiments.peers import osl_speed
from neurolens.base.progress import Progress

ON, OFF = "dispersion", "one colour"
SAMPLES, DEFAULT = (4, 16, 64, 256), 0.01  # Blender's own noise threshold
SCENES = {"sky": "white sky", "open": "meshes out of focus"}
PATTERNS = {"TABULATED_SOBOL": "Tabulated Sobol", "AUTOMATIC": "Automatic"}
_EDGE = 8  # pixels at the picture's edge that do not count: one corner never ends

OPTIONS = [
    osl_speed.BLENDER,
    lab.count("seeds", 3, "of pictures (default: 3)"),
    lab.count("width", 60, "of the picture (default: 60)", 32),
    lab.count("reference", 4096, "samples of the pictures without noise (default: 4096)", 1024),
    lab.count("most", 1024, "samples that adaptive sampling may take (default: 1024)", 128),
    lab.out(),
]  # fmt: skip


def run(args: argparse.Namespace) -> int:
    """Render, write the table; 1 where a goal is missed."""
    from neurolens.cameras.shaders.blender_shader import shader_of

    python = osl_speed.checked_python(args.blender_python, "osl-noise")
    text = shader_of(osl_speed.SHADERS[osl_speed.POLYNOMIAL], quiet=args.quiet).text
    plan = {
        "scenes": list(SCENES), "patterns": list(PATTERNS), "size": (args.width, round(args.width * 2 / 3)),
        "edge": _EDGE, "samples": SAMPLES, "seeds": list(range(args.seeds)), "reference": args.reference,
        "thresholds": [DEFAULT], "most": args.most,
    }  # fmt: skip
    shaders = {OFF: osl_speed.one_colour(text), ON: text}
    cameras = [osl_speed.camera(name, shader) for name, shader in shaders.items()]
    with Progress(quiet=args.quiet).stage("noise in Blender") as report:
        found = osl_speed.in_blender(python, {"cameras": cameras, "scenes": {}, "noise": plan}, report)
    rows = found["noise"]
    met = goals(rows)
    data = {"machine": lab.machine(), "blender": found["blender"], "plan": plan, "rows": rows, "goals": met}
    print(lab.write_results(args.out, "osl_noise", _page(data), data))
    return int(any(g.verdict == "missed" for g in met))


def noise(row: Mapping[str, Any], samples: int) -> float:
    """The mean channel's."""
    channels: list[float] = row["noise"][str(samples)]
    return math.sqrt(sum(v * v for v in channels) / len(channels))


def goals(rows: Sequence[Mapping[str, Any]]) -> list[lab.Goal]:
    """The goals of either scene, in the worse pattern of samples."""
    pairs = [(a, b) for a in rows for b in rows if a["camera"] == ON and b["camera"] == OFF and _same(a, b)]
    met = []
    for scene, shown in SCENES.items():
        own = [pair for pair in pairs if pair[0]["scene"] == scene]
        if scene == "open":
            worst = max((noise(a, 16) / noise(b, 16), a["pattern"]) for a, b in own)
            text = f"{shown}: channel noise at 16 samples over that of one colour"
            met.append(lab.Goal(text, 1.5, worst[0], worst=PATTERNS[worst[1]]))
        worst = max((a[_taken(DEFAULT)] / b[_taken(DEFAULT)], a["pattern"]) for a, b in own)
        text = f"{shown}: adaptive samples at {DEFAULT:g} over those of one colour"
        met.append(lab.Goal(text, 1.3, worst[0], worst=PATTERNS[worst[1]]))
    return met


def _same(a: Mapping[str, Any], b: Mapping[str, Any]) -> bool:
    return (a["scene"], a["pattern"]) == (b["scene"], b["pattern"])


def _taken(threshold: float) -> str:
    return f"samples {threshold:.3g}"


def _page(data: Mapping[str, Any]) -> str:
    plan, thresholds = data["plan"], data["plan"]["thresholds"]
    columns = [
        lab.Column("scene", lambda r: SCENES[r["scene"]]),
        lab.Column("pattern", lambda r: PATTERNS[r["pattern"]]),
    ]
    columns.append(lab.Column("camera", "camera"))
    for n in SAMPLES:
        columns.append(lab.Column(f"{n} samples, %", partial(noise, samples=n), ".2f", 100))
    columns.append(lab.Column("worst channel at 16, %", lambda r: f"{100 * max(r['noise']['16']):.2f}"))
    columns.append(lab.Column("median pixel at 16, %", lambda r: f"{100 * r['median']['16']:.2f}"))
    for t in thresholds:
        columns.append(lab.Column(f"adaptive samples at {t:g}", itemgetter(_taken(t)), ".0f"))
        columns.append(lab.Column("noise then, %", itemgetter(f"noise {t:.3g}"), ".2f", 100))
    (width, height), seeds = plan["size"], len(plan["seeds"])
    about = f"{width} x {height} pixels without an edge of {_EDGE}, {seeds} seeds, box filter; reference of "
    about += f"{plan['reference']} samples, at most {plan['most']} for adaptive sampling; Blender {data['blender']}; "
    head = about + lab.machine_line()
    return lab.page("# Noise in Cycles", __doc__ or "", head, lab.table(columns, data["rows"]),
                    lab.goal_table("Goal", data["goals"]))  # fmt: skip
