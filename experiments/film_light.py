"""Light on the film: its factors for four lenses, and a white card through the 14 mm fisheye four ways.

    python experiments/film_light.py

Writes film_light.json, film_light.png and white_card.png to experiments/results/.
"""

from __future__ import annotations

import json
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from neurolens.analysis.plot_style import FIELD_COLOURS, INK, drawing
from neurolens.base.errors import NeurolensWarning
from neurolens.base.files import atomic_write_text
from neurolens.optics.lensfile import read_lens
from neurolens.optics.radiometry import FilmLight, film_light, white_card

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


_FACTORS = {
    "natural": "natural: mean cos⁴",
    "aperture": "area left by the stop",
    "optical": "left by the rims of glass",
    "mechanical": "left by hoods and rings",
    "transmittance": "transmittance",
}
_WAYS = {
    "flat": "every ray counts the same",
    "cos4": "cos⁴ only",
    "aperture": "effective aperture only",
    "both": "both: what the film sees",
}
_PIXELS = 360  # across the white card


def film_light_picture(lights: Mapping[str, FilmLight], path: Path) -> Path:
    """Relative illumination and its factors, each over its value on the axis, a column for every lens named."""
    with drawing(path, 3.3 * len(lights), 3.5) as figure:
        columns = figure.subplots(1, len(lights), sharey=True, squeeze=False)[0]
        for axes, (name, light) in zip(columns, lights.items(), strict=True):
            lit = light.irradiance > 0
            for (factor, label), colour in zip(_FACTORS.items(), FIELD_COLOURS, strict=False):
                values = getattr(light, factor)
                axes.plot(light.radius_mm[lit], values[lit] / values[0], color=colour, lw=1.4, label=label)
            axes.plot(light.radius_mm[lit], light.relative[lit], color=INK, lw=2.4, label="relative illumination")
            axes.set(xlabel="film radius (mm)", ylim=(0, 1.18), xlim=(0, light.radius_mm.max()))
            axes.set_title(name, loc="left")
            axes.grid(axis="y")
        columns[0].set_ylabel("over the axis")
        columns[0].legend(loc="lower left", fontsize=7.8)
    return Path(path)


def white_card_picture(light: FilmLight, film_mm: tuple[float, float], title: str, path: Path) -> Path:
    """A white card seen in four ways (`white_card`), grey linear in the light, with its fall along +x drawn over it."""
    width, height = film_mm
    y, x = np.mgrid[0 : round(_PIXELS * height / width), 0:_PIXELS]
    radius = np.hypot((x + 0.5) / _PIXELS * width - width / 2, (y + 0.5) / _PIXELS * width - height / 2)
    with drawing(path, 8.4, 6.6) as figure:
        for axes, (way, values) in zip(figure.subplots(2, 2).flat, white_card(light).items(), strict=True):
            picture = np.interp(radius, light.radius_mm, values, right=0)
            shown = axes.imshow(
                picture,
                cmap="gray",
                vmin=0,
                vmax=1.1,
                extent=(-width / 2, width / 2, -height / 2, height / 2),
                interpolation="nearest",
            )
            axes.set_title(_WAYS[way], loc="left")
            axes.set(xlabel="film x (mm)", ylabel="film y (mm)")
            for spine in axes.spines.values():
                spine.set_visible(False)
            _profile_on(axes, light.radius_mm, values, film_mm)
        bar = figure.colorbar(shown, ax=figure.axes, shrink=0.7)
        bar.set_label("irradiance over the axis")
        figure.suptitle(f"{title}\n", x=0.01, ha="left", fontweight="bold", fontsize=12)
        curve = "curve: irradiance along +x, 0 at the film's lower edge, 1 at its upper edge"
        figure.text(0.01, 0.945, curve, ha="left", fontsize=9, color=FIELD_COLOURS[3])
    return Path(path)


def _profile_on(axes: Any, radius: Any, values: Any, film_mm: tuple[float, float]) -> None:
    """The fall along the film's +x, drawn over the picture: its foot is the lower edge, 1 its upper edge."""
    width, height = film_mm
    inside = radius <= width / 2
    axes.plot(radius[inside], (values[inside] - 0.5) * height, color=FIELD_COLOURS[3], lw=1.6)
    axes.set(xlim=(-width / 2, width / 2), ylim=(-height / 2, height / 2 * 1.12))


if __name__ == "__main__":
    main()
