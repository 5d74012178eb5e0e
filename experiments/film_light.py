"""Light on the film: its factors for four lenses, and a white card through the 14 mm fisheye four ways.

    python experiments/film_light.py

Writes film_light.json, film_light.png and white_card.png to experiments/results/.
"""

from __future__ import annotations

import json
import warnings
from pathlib import Path

import numpy as np

from neurolens.base.errors import NeurolensWarning
from neurolens.base.files import atomic_write_text
from neurolens.evaluate.plots.radiometry import film_light_picture, white_card_picture
from neurolens.optics.lensfile import read_lens
from neurolens.optics.radiometry import film_light

ROOT = Path(__file__).parents[1]
OUT = ROOT / "experiments" / "results"
LENSES = {
    "Double Gauss 50 mm f/1.8": ("laikin_double_gauss_50", 50.0, None),
    "Tessar 50 mm f/4": ("brendel_tessar_100", 50.0, 4.0),
    "Müller fisheye 14 mm f/4": ("muller_fisheye_100", 14.0, 4.0),
    "Takahashi retrofocus 18 mm f/2.8": ("takahashi_retrofocus_100", 18.0, 2.8),
}
CARD = "Müller fisheye 14 mm f/4"


def main() -> None:
    """Measure, write and draw."""
    warnings.simplefilter("ignore", NeurolensWarning)
    radius = np.linspace(0, 21.63, 64)
    lights = {
        name: film_light(read_lens(ROOT / "lenses" / f"{stem}.toml").at(focal_length_mm=mm, f_number=n), radius)
        for name, (stem, mm, n) in LENSES.items()
    }
    OUT.mkdir(parents=True, exist_ok=True)
    factors = ("relative", "natural", "aperture", "optical", "mechanical", "transmittance", "area_mm2")
    table = {
        name: {factor: np.round(getattr(light, factor), 6).tolist() for factor in factors}
        for name, light in lights.items()
    }
    atomic_write_text(OUT / "film_light.json", json.dumps({"film_radius_mm": radius.tolist(), "lenses": table}) + "\n")
    film_light_picture(lights, OUT / "film_light.png")
    white_card_picture(lights[CARD], (36.0, 24.0), f"White card, {CARD}", OUT / "white_card.png")


if __name__ == "__main__":
    main()
