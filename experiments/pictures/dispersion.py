"""Noise and time of lenses that disperse, by wavelengths of a path and by what they keep, beside a thin lens.

Scenes through exact lenses as C, two with strong lateral colour, one wide open that vignettes and one with cylinders.
The thin lens carries four wavelengths on every path: it has no other. Variances are those of a pixel between seeds, at
equal samples. Writes dispersion.md and dispersion.json.
"""

from __future__ import annotations

import argparse
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from functools import partial
from multiprocessing import get_context
from typing import Any

import numpy as np

from experiments import lab
from experiments.pictures.plans import suited
from neurolens.cameras.build import make_camera
from neurolens.optics.lens.shot import Shot
from neurolens.pictures.render.colour import SRGB
from neurolens.pictures.render.renderer import render
from neurolens.pictures.render.scene import Scene, load_scene

SCENES = ("garden", "room", "lights")
LENSES = {
    "laikin_double_gauss_50": 1.8, "horimoto_fisheye_16": 2.8, "tajima_retrofocus_24": 2.8, "merte_biotar_100": 1.4,
    "cooke_anamorphic_42": 2.4, "nikon_zoom_70_200": 2.8,
}  # fmt: skip
# How many wavelengths a path carries, and the part of the dispersion that the camera has.
MODES: dict[str, tuple[Any, Any]] = {
    "one": ("one", "full"), "four": ("auto", "full"), "lateral": ("auto", "lateral"), "off": ("auto", "off"),
}  # fmt: skip

OPTIONS = (
    lab.count("samples", 16, "of a pixel (default: 16)"), lab.count("seeds", 4, "for variances (default: 4)", 2),
    lab.count("width", 480, "of the picture (default: 480)", 64),
    lab.count("workers", 1, "processes of a thread each (default: 1)"), lab.ONLY, lab.out(),
)  # fmt: skip


def measured(scene: Scene, camera: Any, mode: Any, args: argparse.Namespace) -> dict[str, Any]:
    """Mean, variances between seeds of luminance and channels, and seconds of CPU a picture."""
    height, film = round(args.width * 9 / 16), replace(scene.settings.film, wavelengths=mode)
    options: dict[str, Any] = {"width": args.width, "height": height, "samples": args.samples, "threads": 1}
    render(scene, camera, **options | {"samples": 1}, film=film)  # compiles what it needs
    pictures, seconds = [], []
    for seed in range(args.seeds):
        began = lab.cpu_s()
        found = render(scene, camera, **options, film=film, seed=seed)
        seconds.append(lab.cpu_s() - began)
        pictures.append(found.rgb.astype(np.float64))
    rgb = np.stack(pictures)
    return {"mean": rgb.mean(axis=(0, 1, 2)), "seconds": min(seconds), "mode": found.stats.wavelengths,
            "luminance": (rgb @ SRGB.to_xyz[1]).var(axis=0, ddof=1), "channels": rgb.var(axis=0, ddof=1)}  # fmt: skip


def case(names: tuple[str, str], args: argparse.Namespace) -> lab.Row:
    """One lens before one scene: all modes over the thin lens."""
    lab.quiet_glasses()
    scene_name, name = names
    lens = lab.lens_of(name)
    scene = suited(load_scene(lab.SCENES / f"{scene_name}.toml"), lens, LENSES[name])
    shot = scene.settings.camera
    asked = Shot(shot.film_mm, shot.focus_m, shot.f_number)
    path = lab.LENSES / f"{name}.toml"
    thin = measured(scene, make_camera(f"thin:{path}", asked), "auto", args)
    row: lab.Row = {"scene": scene_name, "lens": name, "f_number": shot.f_number, "thin_s": thin["seconds"]}
    each = {}
    for mode, (waves, kept) in MODES.items():
        each[mode] = measured(scene, make_camera(path, replace(asked, dispersion=kept)), waves, args)
    for mode, found in each.items():
        row[mode] = {
            "median": float(np.median(found["luminance"]) / np.median(thin["luminance"])),
            "mean": float(found["luminance"].mean() / thin["luminance"].mean()),
            "channels": [float(v) for v in found["channels"].mean(axis=(0, 1)) / thin["channels"].mean(axis=(0, 1))],
            "seconds": found["seconds"], "mode": found["mode"],
        }  # fmt: skip
    one, several = each["one"], each["four"]
    row["means"] = [float(v) for v in several["mean"] / one["mean"] - 1]
    for mode in ("four", "lateral"):
        time = one["seconds"] / each[mode]["seconds"]
        row[mode]["gain"] = float(one["luminance"].mean() / each[mode]["luminance"].mean() * time)
        row[mode]["gain_channels"] = float(one["channels"].mean() / each[mode]["channels"].mean() * time)
    return row


_COLUMNS = lab.columns(
    ("scene", "scene"), ("lens", "lens"), ("f", "f_number", ".1f"),
    *((f"{mode}: {what}", f"{mode}.{key}", ".2f") for mode in MODES
      for what, key in (("median", "median"), ("mean", "mean"))),
    *((f"{mode}: R, G, B", lambda r, m=mode: ", ".join(f"{v:.1f}" for v in r[m]["channels"])) for mode in MODES),
    ("thin, s", "thin_s", ".1f"), *((f"{mode}, s", f"{mode}.seconds", ".1f") for mode in MODES),
    *((f"{mode}: time to equal error, luminance", f"{mode}.gain", ".1f") for mode in ("four", "lateral")),
    *((f"{mode}: channels", f"{mode}.gain_channels", ".1f") for mode in ("four", "lateral")),
)  # fmt: skip
_ABOUT = (
    "Variance of luminance over the thin lens's, ratio of medians and of means over pixels, and of channels' means: "
    "for one wavelength a path, for four, and for four with lateral colour or none (`--dispersion lateral`, `off`: the "
    "same lens with all wavelengths at one film point). Seconds of CPU a picture, the least of all seeds; how many "
    "times less than one wavelength the modes take to the same mean error."
)


def _range(values: list[float]) -> str:
    return f"{min(values):.2g} to {max(values):.2g} (median {np.median(values):.2g})"


def run(args: argparse.Namespace) -> None:
    """Measure and write."""
    names = lab.chosen(list(LENSES), str, args.only, "dispersion")
    cases = [(scene, name) for scene in SCENES for name in names]
    with ProcessPoolExecutor(args.workers, mp_context=get_context("spawn")) as pool:
        asked = argparse.Namespace(**{name: getattr(args, name) for name in ("samples", "seeds", "width")})
        found = pool.map(partial(case, args=asked), cases)
        rows = [next(found) for _ in lab.counted(cases, "cases", args.quiet)]
    head = f"`python -m experiments dispersion`: {args.samples} samples, {args.seeds} seeds, {args.width} pixels wide, "
    head += f"{args.workers} pictures at a time; "
    parts = [head + lab.machine_line(), _ABOUT, lab.table(_COLUMNS, rows)]
    pairs = [(r["four"], r["off"]) for r in rows]
    light = _range([four["mean"] / off["mean"] for four, off in pairs])
    colours = _range([a / b for four, off in pairs for a, b in zip(four["channels"], off["channels"], strict=True)])
    time = _range([r["four"]["seconds"] / r["one"]["seconds"] for r in rows])
    told = [f"Four wavelengths a path have {light} times the luminance variance of the same lens without dispersion,"]
    told.append(f"and {colours} times in the channels; they take {time} times as long as one wavelength a path.")
    for mode in ("four", "lateral"):
        gains = [_range([row[mode][key] for row in rows]) for key in ("gain", "gain_channels")]
        told.append(f"Equal error takes {gains[0]} times less time in luminance with {mode}, {gains[1]} in channels.")
    parts.append(" ".join(told))
    data = {"machine": lab.machine(), "rows": rows}
    print(lab.write_results(args.out, "dispersion", lab.page("# Lenses that disperse", *parts), data))
