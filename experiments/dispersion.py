"""Noise and time of lenses that disperse: one wavelength a path, and four that share it, beside a thin lens.

Scenes through exact lenses as C, two with strong lateral colour, one wide open that vignettes and one with cylinders.
The thin lens carries four wavelengths on every path: it has no other. Variances are those of a pixel between seeds, at
equal samples. Writes dispersion.md and dispersion.json.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from typing import Any

import numpy as np

from experiments import lab
from experiments.plans import suited
from neurolens.cameras.build import make_camera
from neurolens.lens.shot import Shot
from neurolens.render.colour import SRGB
from neurolens.render.renderer import render
from neurolens.render.scene import Scene, load_scene

SCENES = ("garden", "room", "lights")
LENSES = {
    "laikin_double_gauss_50": 1.8, "horimoto_fisheye_16": 2.8, "tajima_retrofocus_24": 2.8, "merte_biotar_100": 1.4,
    "cooke_anamorphic_42": 2.4, "nikon_zoom_70_200": 2.8,
}  # fmt: skip
MODES = ("one", "auto")

OPTIONS = (
    lab.count("samples", 16, "of a pixel (default: 16)"), lab.count("seeds", 4, "for variances (default: 4)", 2),
    lab.count("width", 480, "of the picture, of which a quarter of the rows is rendered (default: 480)", 64),
    lab.ONLY, lab.out(),
)  # fmt: skip


def measured(scene: Scene, camera: Any, mode: Any, args: argparse.Namespace) -> dict[str, Any]:
    """Mean, variances between seeds of luminance and channels, and seconds of CPU a picture."""
    height = round(args.width * 9 / 16)
    rows, film = (height // 4, height // 2), replace(scene.settings.film, wavelengths=mode)
    options: dict[str, Any] = {"width": args.width, "height": height, "samples": args.samples, "threads": 1}
    render(scene, camera, **options | {"samples": 1}, rows=rows, film=film)  # compiles what it needs
    began, pictures = lab.cpu_s(), []
    for seed in range(args.seeds):
        found = render(scene, camera, **options, rows=rows, film=film, seed=seed)
        pictures.append(found.rgb.astype(np.float64))
    seconds = (lab.cpu_s() - began) / args.seeds
    rgb = np.stack(pictures)
    return {"mean": rgb.mean(axis=(0, 1, 2)), "seconds": seconds, "mode": found.stats["wavelengths"],
            "luminance": (rgb @ SRGB.to_xyz[1]).var(axis=0, ddof=1), "channels": rgb.var(axis=0, ddof=1)}  # fmt: skip


def case(scene_name: str, name: str, args: argparse.Namespace) -> lab.Row:
    """One lens before one scene: all modes over the thin lens."""
    lens = lab.lens_of(name)
    scene = suited(load_scene(lab.SCENES / f"{scene_name}.toml"), lens, LENSES[name])
    shot = scene.settings.camera
    asked = Shot(shot.film_mm, shot.focus_m, shot.f_number)
    path = lab.LENSES / f"{name}.toml"
    thin = measured(scene, make_camera(f"thin:{path}", asked), "auto", args)
    camera = make_camera(f"fused:{path}", asked)
    row: lab.Row = {"scene": scene_name, "lens": name, "f_number": shot.f_number, "thin_s": thin["seconds"]}
    each = {mode: measured(scene, camera, mode, args) for mode in MODES}
    for mode, found in each.items():
        row[mode] = {
            "median": float(np.median(found["luminance"]) / np.median(thin["luminance"])),
            "mean": float(found["luminance"].mean() / thin["luminance"].mean()),
            "channels": [float(v) for v in found["channels"].mean(axis=(0, 1)) / thin["channels"].mean(axis=(0, 1))],
            "seconds": found["seconds"], "mode": found["mode"],
        }  # fmt: skip
    one, several = (each[mode] for mode in MODES)
    row["means"] = [float(v) for v in several["mean"] / one["mean"] - 1]
    time = one["seconds"] / several["seconds"]
    row["gain"] = float(one["luminance"].mean() / several["luminance"].mean() * time)
    row["gain_channels"] = float(one["channels"].mean() / several["channels"].mean() * time)
    return row


_COLUMNS = lab.columns(
    ("scene", "scene"), ("lens", "lens"), ("f", "f_number", ".1f"),
    *((f"{text}: {what}", f"{mode}.{key}", ".2f") for mode, text in zip(MODES, ("one", "four"), strict=True)
      for what, key in (("median", "median"), ("mean", "mean"))),
    *((f"{text}: R, G, B", lambda r, m=mode: ", ".join(f"{v:.1f}" for v in r[m]["channels"]))
      for mode, text in zip(MODES, ("one", "four"), strict=True)),
    ("thin, s", "thin_s", ".1f"), ("one, s", "one.seconds", ".1f"), ("four, s", "auto.seconds", ".1f"),
    ("time to equal error: luminance", "gain", ".1f"), ("channels", "gain_channels", ".1f"),
)  # fmt: skip
_ABOUT = (
    "Variance of luminance over the thin lens's, ratio of medians and of means over pixels, and of the channels' "
    "means, for one wavelength a path and for four; seconds of CPU a picture; how many times less time four take to "
    "the same mean error."
)


def run(args: argparse.Namespace) -> None:
    """Measure and write."""
    lab.quiet_glasses()
    names = lab.chosen(list(LENSES), str, args.only, "dispersion")
    cases = [(scene, name) for scene in SCENES for name in names]
    rows = [case(scene, name, args) for scene, name in lab.counted(cases, "cases", args.quiet)]
    head = f"`python -m experiments dispersion`: {args.samples} samples, {args.seeds} seeds, {args.width} pixels wide; "
    parts = [head + lab.machine_line(), _ABOUT, lab.table(_COLUMNS, rows)]
    gains = [row["gain"] for row in rows], [row["gain_channels"] for row in rows]
    text = "Time to equal error: luminance {:.1f} to {:.1f} (median {:.1f}), channels {:.1f} to {:.1f} (median {:.1f})."
    parts.append(text.format(*(f(g) for g in gains for f in (min, max, np.median))))
    data = {"machine": lab.machine(), "rows": rows}
    print(lab.write_results(args.out, "dispersion", lab.page("# Lenses that disperse", *parts), data))
