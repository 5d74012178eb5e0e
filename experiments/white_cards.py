r"""White surroundings through the 14 mm fisheye at f/4, rendered four ways: flat, cos^4, effective aperture, both.

    python experiments/white_cards.py [--samples 64] [--threads 2]

Each card is what this renders, X being none, natural, optical or both:

    neurolens render experiments/scenes/white.toml --camera lenses/muller_fisheye_100.toml --efl 14 \
        --vignetting X -o X.exr

Means over rings of the pictures stand beside the integral over the pupil that knows nothing of cameras
(`neurolens.optics.radiometry`). Writes white_cards.md and white_cards.png to experiments/results/.
"""

from __future__ import annotations

import argparse
import math
import time
import warnings
from pathlib import Path

import numpy as np

from neurolens.base.errors import NeurolensWarning
from neurolens.base.files import atomic_write_text
from neurolens.cameras.build import Shot, make_camera
from neurolens.optics.lensfile import read_lens
from neurolens.optics.radiometry import film_light, white_card
from neurolens.render.pictures import write_png
from neurolens.render.renderer import render
from neurolens.render.scene import load_scene

ROOT = Path(__file__).parents[1]
OUT = ROOT / "experiments" / "results"
LENS, EFL_MM, F_NUMBER = ROOT / "lenses" / "muller_fisheye_100.toml", 14.0, 4.0
CARDS = {"none": "flat", "natural": "cos4", "optical": "aperture", "both": "both"}
LIT_MM = 18.83  # where the light of this lens ends
PLACES = {"centre": 0.0, "half the lit radius": 0.5, "nine tenths": 0.9, "98%": 0.98}


def main() -> None:
    """Render, compare and write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--samples", type=int, default=64)
    parser.add_argument("--threads", type=int, default=2)
    args = parser.parse_args()
    warnings.simplefilter("ignore", NeurolensWarning)
    scene = load_scene(ROOT / "experiments" / "scenes" / "white.toml")
    shot = scene.settings.camera
    film_mm = (shot.film_width_mm, shot.film_height_mm)
    radius = np.array(list(PLACES.values())) * LIT_MM
    light = film_light(read_lens(LENS).at(focal_length_mm=EFL_MM, f_number=F_NUMBER), radius)
    # As `white_card`, but through glass with its losses, which the effective aperture takes along.
    true = white_card(light) | {"aperture": light.relative / light.natural, "both": light.relative}
    cards, rows = [], []
    for vignetting, name in CARDS.items():
        start = time.perf_counter()
        camera = make_camera(LENS, Shot(film_mm, math.inf, F_NUMBER, EFL_MM, vignetting=vignetting))
        rgb = render(scene, camera, samples=args.samples, threads=args.threads).rgb
        found = rings(rgb.mean(2), film_mm, radius)
        cells = (f"{a:.3f} ({b:.3f})" for a, b in zip(found, true[name], strict=True))
        rows.append(f"| {name} | {vignetting} | {' | '.join(cells)} |")
        print(f"{rows[-1]}  {time.perf_counter() - start:.1f} s", flush=True)
        cards.append(rgb)
    OUT.mkdir(parents=True, exist_ok=True)
    atomic_write_text(OUT / "white_cards.md", page(rows))
    top, bottom = (np.concatenate(cards[i : i + 2], axis=1) for i in (0, 2))
    write_png(OUT / "white_cards.png", np.concatenate([top, bottom]).astype(np.float32), 0.0)


def rings(picture: np.ndarray, film_mm: tuple[float, float], radius_mm: np.ndarray) -> list[float]:
    """Mean of a picture [H, W] over rings a pixel and a half wide about its centre, and over the disc of 1 mm there."""
    height, width = picture.shape
    pixel = film_mm[0] / width
    x, y = (((np.arange(n) + 0.5) * pixel - n * pixel / 2) for n in (width, height))
    place = np.hypot(x, y[:, None])
    return [float(picture[np.abs(place - r) < (0.75 * pixel if r else 1.0)].mean()) for r in radius_mm]


def page(rows: list[str]) -> str:
    """The table as a page."""
    head = [
        "# White cards: vignetting switched off, in part or as a whole",
        "",
        f"`python experiments/white_cards.py`: Müller fisheye at {EFL_MM:g} mm, f/{F_NUMBER:g}, 36 x 24 mm film, lit",
        f"to {LIT_MM:g} mm; film value over rings of the rendered pictures. In brackets the integral over the pupil at",
        "the d line. Both is the product of cos4 and aperture, which takes the losses of the glass along.",
        "",
        f"| card | --vignetting | {' | '.join(PLACES)} |",
        f"|---|---|{'---|' * len(PLACES)}",
    ]
    return "\n".join([*head, *rows, "", "![Flat, cos4; aperture, both](white_cards.png)"]) + "\n"


if __name__ == "__main__":
    main()
