"""The flare of Keshmirian's thesis (2008) again: a point light 3.6 m before a Nikon 80-200 mm f/2.8 at 80 mm.

Ten million photons of 550 nm for each place of the light, with 10 reflections at most, and for one place with 2 and 5;
twenty million for three places. His photons left the light in a cone tuned by hand and 30 to 32% of them reached the
sensor, in 7867 to 9017 s, and twenty million in 12 to 15 hours (2008); ours are aimed at the sphere about the front
surface, so that their share is another: both are told. Compiling is not counted; processor seconds are those of all
threads. Writes photons.md and photons.json.
"""

from __future__ import annotations

import argparse
import math
import time
from concurrent.futures import ThreadPoolExecutor

import numpy as np

from experiments import lab
from neurolens.base.progress import Progress
from neurolens.pictures.flare.lights import Light, light_rays
from neurolens.pictures.flare.photons import PhotonTracer

LENS, ZOOM, DISTANCE_MM = "nikon_zoom_80_200", "80", 3600.0
# x, y of the light in mm, most reflections, and his time where he states it.
CASES = (
    (-600, 0, 10, "7867 s"),
    (-500, 33, 10, "8586 s"),
    (-300, 99, 10, "8943 s"),
    (-100, 165, 10, "9017 s"),
    (-400, 66, 2, ""),
    (-400, 66, 5, ""),
    (-400, 66, 10, ""),
)
TWICE = ((-400, 66), (450, 200), (300, 300))  # with twice the photons, in 12 to 15 h
FILM_MM, _AT_ONCE, _NM = (36.0, 24.0), 1 << 18, 550.0
GOAL_S = 10.0

OPTIONS = [
    lab.count("photons", 10_000_000, "of each case (default: 10 million)"),
    lab.count("threads", 2, "default: 2"),
    lab.out(),
]


def run(args: argparse.Namespace) -> int:
    """Trace the cases, write the tables; 1 where the goal is missed."""
    lens = lab.lens_of(LENS, zoom=ZOOM, focus_m=DISTANCE_MM / 1000, focus_mode="best")
    tracer, rows, progress = PhotonTracer(lens), list[lab.Row](), Progress(quiet=args.quiet)
    cases = [(*case, args.photons) for case in CASES] + [(*at, 10, "12 to 15 h", 2 * args.photons) for at in TWICE]
    for x, y, most, his, count in cases:
        with progress.stage(f"{x}, {y}, {most} reflections"):
            rows.append(_row(tracer, x, y, most, his, count, args.threads))
    slowest = max(r["seconds"] for r in rows if r["photons"] == args.photons)
    goal = lab.Goal(f"seconds for {args.photons:,} photons, {args.threads} threads", GOAL_S, slowest)
    text = lab.page("# Photons", __doc__ or "", lab.table(_COLUMNS, rows), lab.goal_table("Goal", [goal]))
    data = {"machine": lab.machine(), "photons": args.photons, "threads": args.threads, "rows": rows}
    print(lab.write_results(args.out, "photons", text, data))
    return int(goal.measured is not None and goal.measured > GOAL_S)


def light_at(x_mm: float, y_mm: float) -> Light:
    """His light: x to the right, y up, 3.6 m in front."""
    far = math.hypot(x_mm, y_mm, DISTANCE_MM)
    azimuth, elevation = math.atan2(x_mm, DISTANCE_MM), math.asin(y_mm / far)
    return Light(math.degrees(azimuth), math.degrees(elevation), distance_m=far / 1000)


def _row(tracer: PhotonTracer, x: int, y: int, most: int, his: str, count: int, threads: int) -> lab.Row:
    """Seconds, and shares of the photons cast: those on the film, of these after reflections, also by number."""
    light, half = light_at(x, y), np.array(FILM_MM)[:, None] / 2

    def part(first: int) -> np.ndarray:
        rays, _ = light_rays(tracer.lens, light, first, min(_AT_ONCE, count - first))
        found = tracer.trace(rays, _NM, most_reflections=most, seed=first)
        inside = (np.abs(found.film_xy_mm) <= half).all(0)
        return np.array(
            [*np.bincount(found.reflections[inside], minlength=12)[:12], found.stopped, found.left, found.cut]
        )

    part(count - 1)  # compiles
    began, worked = time.perf_counter(), time.process_time()
    with ThreadPoolExecutor(threads) as pool:
        books = np.sum(list(pool.map(part, range(0, count, _AT_ONCE))), 0) / count
    seconds, worked = time.perf_counter() - began, time.process_time() - worked
    by, (stopped, left, cut) = books[:12], books[12:]
    shares = {"film": by.sum(), "flare": by[1:].sum(), "two": by[2], "four": by[4], "more": by[5:].sum()}
    shares |= {"stopped": stopped, "left": left, "cut": cut}
    about = {"x_mm": x, "y_mm": y, "most": most, "photons": count, "his": his}
    about |= {"seconds": seconds, "processor_seconds": worked}
    return about | {name: float(share) for name, share in shares.items()}


_COLUMNS = lab.columns(
    ("light x mm", "x_mm"),
    ("y mm", "y_mm"),
    ("most reflections", "most"),
    ("photons", "photons", ",d"),
    ("seconds", "seconds", ".2f"),
    ("processor seconds", "processor_seconds", ".2f"),
    ("his time (2008)", "his"),
    ("on the film", "film", ".2%"),
    ("of all, as flare", "flare", ".3%"),
    ("two reflections", "two", ".3%"),
    ("four", "four", ".4%"),
    ("more", "more", ".5%"),
    ("end at rims", "stopped", ".1%"),
    ("leave at the front", "left", ".1%"),
    ("cut off", "cut", ".4%"),
)
