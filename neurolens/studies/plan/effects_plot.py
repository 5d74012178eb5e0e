"""The figure of a plan: where in the picture the effects are that a camera needs."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from neurolens.optics.analysis.plots import drawing, plain_log_ticks
from neurolens.studies.plan.plan import Plan
from neurolens.studies.plan.probe import Effect
from neurolens.studies.plots import error_scale, log_norm

_A_ROW, _MAP_IN = 4, (2.1, 1.8)  # most maps in a row; width and height of a map in inches


def plot_effects(plan: Plan, path: Path, title: str) -> None:
    """Draw the map of each effect that a camera needs, or of all where it needs none, on one scale for each unit."""
    shown = [e for e in plan.effects if e.needed] or plan.effects
    units = [part for unit in ("px", "relative") if (part := [e for e in shown if e.unit == unit])]
    columns = min(_A_ROW, max(map(len, units)))
    heights = [_MAP_IN[1] * -(-len(part) // columns) for part in units]
    subtitle = f"f/{plan.asked.f_number:.3g}, focus {plan.asked.focus_m:g} m; 95% of the picture keeps these figures"
    with drawing(path, max(_MAP_IN[0] * columns + 1.0, 5.0), sum(heights) + 0.8, title, subtitle) as figure:
        parts = np.atleast_1d(figure.subfigures(len(units), 1, height_ratios=heights))
        for part, effects in zip(parts, units, strict=True):
            _maps(part, effects, columns, plan.probed.shot.film_mm)


def _maps(figure: Any, effects: Sequence[Effect], columns: int, film_mm: tuple[float, float]) -> None:
    """Draw effects of one unit, upright, with their colour bar: light that the lens takes is violet."""
    from matplotlib.colors import Normalize

    pixels, maps = effects[0].unit == "px", [e.film for e in effects]
    low, high = error_scale(map(np.abs, maps), 98)
    norm, colours = (log_norm(low, high), "magma") if pixels else (Normalize(-high, high), "PuOr_r")
    cells = figure.subplots(-(-len(effects) // columns), columns, squeeze=False)
    for axes in cells.ravel():
        axes.set_axis_off()
    for axes, effect, value in zip(cells.ravel(), effects, maps, strict=False):
        shown = np.maximum(value, low) if pixels else value
        picture = axes.imshow(shown, extent=(0, film_mm[0], 0, film_mm[1]), cmap=colours, norm=norm)
        worth = f"{effect.worth:.2g} px" if pixels else f"{100 * effect.worth:.2g}%"
        axes.set_title(f"{effect.name}, {worth}", fontsize=8)
    bar = figure.colorbar(picture, ax=cells[:, : len(maps)], extend="both", aspect=12 * len(cells), pad=0.015)
    bar.set_label("pixels" if pixels else "share of the light", fontsize=7)
    bar.ax.tick_params(labelsize=6.5)
    if pixels:
        plain_log_ticks(bar.ax.yaxis)
