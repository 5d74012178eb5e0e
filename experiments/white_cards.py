"""Light on the film: its factors for four lenses, and a white card through the 14 mm fisheye four ways.

The four ways are flat, cos^4, effective aperture, and both. From the integral over the pupil that knows nothing of
cameras (`experiments.radiometry`), and as rendered, by this, X being none, natural, optical or both:

    neurolens render experiments/scenes/white.toml --camera lenses/muller_fisheye_100.toml --efl 14 --vignetting X

Writes film_light.json; white_cards.md and white_cards.png, where means over rings of the pictures stand beside the
integral.
"""

from __future__ import annotations

import argparse
import json
import math
from pathlib import Path
from typing import Any

import numpy as np

from experiments import lab
from experiments.radiometry import FilmLight, film_light, white_card
from neurolens.base.files import atomic_write_text
from neurolens.base.progress import Progress
from neurolens.cameras.build import Shot, make_camera
from neurolens.optics.lensfile import read_lens
from neurolens.render.pictures import write_png
from neurolens.render.renderer import render
from neurolens.render.scene import load_scene

LENSES = {
    "Double Gauss 50 mm f/1.8": ("laikin_double_gauss_50", 50.0, None),
    "Tessar 50 mm f/4": ("brendel_tessar_100", 50.0, 4.0),
    "Müller fisheye 14 mm f/4": ("muller_fisheye_100", 14.0, 4.0),
    "Takahashi retrofocus 18 mm f/2.8": ("takahashi_retrofocus_100", 18.0, 2.8),
}
CARD = "Müller fisheye 14 mm f/4"
FACTORS = ("relative", "natural", "aperture", "optical", "mechanical", "transmittance", "area_mm2")
WAYS = {"none": "flat", "natural": "cos4", "optical": "aperture", "both": "both"}  # --vignetting to `white_card`'s
LIT_MM = 18.74  # where the light of the card's lens ends, in best focus
PLACES = {"centre": 0.0, "half the lit radius": 0.5, "nine tenths": 0.9, "98%": 0.98}


def light_of(name: str, radius_mm: Any) -> FilmLight:
    """Of one of `LENSES`, its film where cameras place it: in best focus."""
    stem, mm, f_number = LENSES[name]
    lens = read_lens(lab.LENSES / f"{stem}.toml")
    return film_light(lens.at(focal_length_mm=mm, f_number=f_number, focus_m=math.inf, focus="best"), radius_mm)


def rendered(samples: int, threads: int, out: Path, report: lab.Report) -> str:
    """Render the card in all ways, write white_cards.md and white_cards.png; returns the page."""
    scene = load_scene(lab.SCENES / "white.toml")
    shot, (stem, efl_mm, f_number) = scene.settings.camera, LENSES[CARD]
    film_mm = (shot.film_width_mm, shot.film_height_mm)
    radius = np.array(list(PLACES.values())) * LIT_MM
    light = light_of(CARD, radius)
    # As `white_card`, but through glass with its losses, which the effective aperture takes along.
    true = white_card(light) | {"aperture": light.relative / light.natural, "both": light.relative}
    cards, rows = [], []
    for vignetting, name in WAYS.items():
        set_ = Shot(film_mm, math.inf, f_number, efl_mm, vignetting=vignetting)
        camera = make_camera(lab.LENSES / f"{stem}.toml", set_)
        cards.append(render(scene, camera, samples=samples, threads=threads).rgb)
        found = rings(cards[-1].mean(2), film_mm, radius)
        pairs = zip(found, true[name], strict=True)
        rows.append([name, vignetting, *(lab.best_median(a, b, ".3f") for a, b in pairs)])
        report(len(rows) / len(WAYS))
    top, bottom = (np.concatenate(cards[i : i + 2], axis=1) for i in (0, 2))
    write_png(out / "white_cards.png", np.concatenate([top, bottom]).astype(np.float32), 0.0)
    text = lab.page(
        "# White cards: vignetting switched off, in part or as a whole",
        f"`python -m experiments white-cards`: Müller fisheye at {efl_mm:g} mm, f/{f_number:g}, 36 x 24 mm film, lit\n"
        f"to {LIT_MM:g} mm; film value over rings of the rendered pictures. In brackets the integral over the pupil "
        "at\nthe d line. Both is the product of cos4 and aperture, which takes the losses of the glass along.",
        lab.table(["card", "--vignetting", *PLACES], rows),
        "![Flat, cos4; aperture, both](white_cards.png)",
    )
    atomic_write_text(out / "white_cards.md", text)
    return text


def rings(picture: np.ndarray, film_mm: tuple[float, float], radius_mm: np.ndarray) -> list[float]:
    """Mean of a picture [H, W] over rings a pixel and a half wide about its centre, and over the disc of 1 mm there."""
    height, width = picture.shape
    pixel = film_mm[0] / width
    x, y = (((np.arange(n) + 0.5) * pixel - n * pixel / 2) for n in (width, height))
    place = np.hypot(x, y[:, None])
    return [float(picture[np.abs(place - r) < (0.75 * pixel if r else 1.0)].mean()) for r in radius_mm]


OPTIONS = (
    lab.count("samples", 64, "a pixel of the cards (default 64)"),
    lab.count("threads", 2, "default 2"),
    lab.out(),
)


def run(args: argparse.Namespace) -> None:
    """Measure, render and write."""
    lab.quiet_glasses()
    radius, out = np.linspace(0, 21.63, 64), args.out
    lights = {name: light_of(name, radius) for name in LENSES}
    table = {n: {f: np.round(getattr(light, f), 6).tolist() for f in FACTORS} for n, light in lights.items()}
    out.mkdir(parents=True, exist_ok=True)
    atomic_write_text(out / "film_light.json", json.dumps({"film_radius_mm": radius.tolist(), "lenses": table}) + "\n")
    with Progress(quiet=args.quiet).stage("white cards") as report:
        print(rendered(args.samples, args.threads, out, report))
