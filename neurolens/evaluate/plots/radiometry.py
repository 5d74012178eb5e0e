"""Pictures of the light on the film: its factors against the film radius, and a white card seen four ways."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from neurolens.evaluate.plots.style import FIELD_COLOURS, INK, new_figure, save, style
from neurolens.optics.radiometry import FilmLight, white_card

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
    with style():
        figure = new_figure(3.3 * len(lights), 3.5)
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
        return save(figure, path)


def white_card_picture(light: FilmLight, film_mm: tuple[float, float], title: str, path: Path) -> Path:
    """A white card seen in four ways (`white_card`), grey linear in the light, with its fall along +x drawn over it."""
    width, height = film_mm
    y, x = np.mgrid[0 : round(_PIXELS * height / width), 0:_PIXELS]
    radius = np.hypot((x + 0.5) / _PIXELS * width - width / 2, (y + 0.5) / _PIXELS * width - height / 2)
    with style():
        figure = new_figure(8.4, 6.6)
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
        return save(figure, path)


def _profile_on(axes: Any, radius: Any, values: Any, film_mm: tuple[float, float]) -> None:
    """The fall along the film's +x, drawn over the picture: its foot is the lower edge, 1 its upper edge."""
    width, height = film_mm
    inside = radius <= width / 2
    axes.plot(radius[inside], (values[inside] - 0.5) * height, color=FIELD_COLOURS[3], lw=1.6)
    axes.set(xlim=(-width / 2, width / 2), ylim=(-height / 2, height / 2 * 1.12))
