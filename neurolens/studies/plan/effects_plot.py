"""The figure of a plan's effects: what each is worth, and where in the picture those are that a camera needs."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from neurolens.optics.analysis.plots import drawing, plain_log_ticks
from neurolens.studies.plan.footprints import Array
from neurolens.studies.plan.plan import Plan
from neurolens.studies.plan.probe import LIGHT, Effect
from neurolens.studies.plots import CHOSEN, error_scale, family_colour, log_norm

_A_ROW, _BARS_IN, _MAP_IN = 4, 3.6, 1.5  # maps in a row; heights in inches
# Light that an effect takes is drawn dark, light that it adds orange, and none white.
_SIGNED = ("#10183a", "#4d6796", "#c9d1de", "#ffffff", "#f6cfae", "#e58a45", CHOSEN)
# By unit of effects: a factor on values, the sign after them, and the labels of bars and of maps.
_DRAWN = {
    "px": (1.0, " px", "worth (pixels); grey: left out", "pixels"),
    "relative": (100.0, "%", "worth (% of the light); grey: left out", "% of the light\n(dark: taken)"),
}


def plot_effects(plan: Plan, path: Path, title: str) -> None:
    """Draw effects as bars beside the budget, and maps of those that a camera needs, on one scale for each unit."""
    asked, shown = plan.asked, [e for e in plan.effects if math.isfinite(e.worth)]
    known = plan.probed.camera_maps
    drawn: dict[str, dict[str, Array]] = {}
    for e in shown:
        if e.needed:
            drawn.setdefault(e.unit, {})[e.name] = (known if e.name in known else plan.probed.maps)[e.name][1]
    heights = [_BARS_IN, *(_MAP_IN * -(-len(named) // _A_ROW) for named in drawn.values())]
    subtitle = f"f/{asked.f_number:.3g}, focus {asked.focus_m:g} m; 95% of the picture keeps these figures"
    with drawing(path, 9.5, sum(heights), title, subtitle) as figure:
        above, *below = np.atleast_1d(figure.subfigures(len(heights), 1, height_ratios=heights))
        for axes, unit, budget in zip(above.subplots(1, 2), _DRAWN, (plan.budget_px, LIGHT), strict=True):
            _bars(axes, [e for e in shown if e.unit == unit][::-1], unit, budget)
        for part, (unit, named) in zip(below, drawn.items(), strict=True):
            _maps(part, named, unit, asked.film_mm)


def _bars(axes: Any, effects: Sequence[Effect], unit: str, budget: float) -> None:
    factor, sign, label, _ = _DRAWN[unit]
    worths = [factor * e.worth for e in effects]
    least = max(min((w for w in worths if w > 0), default=1e-3) / 3, 1e-4)
    colours = [family_colour("ols") if e.needed else "#b8b8b8" for e in effects]
    axes.barh([e.name for e in effects], [max(w, least) for w in worths], color=colours, left=0)
    axes.set(xscale="log", xlabel=label)
    axes.set_xlim(left=least)
    if 0 < budget < math.inf:
        axes.axvline(factor * budget, color=CHOSEN, lw=1.2, label=f"budget {factor * budget:g}{sign}")
        axes.legend(loc="lower right", bbox_to_anchor=(1, 1), frameon=False)
    plain_log_ticks(axes.xaxis)


def _maps(figure: Any, maps: Mapping[str, Array], unit: str, film_mm: tuple[float, float]) -> None:
    """Draw maps of effects of one unit, upright, with their colour bar."""
    from matplotlib.colors import LinearSegmentedColormap, Normalize

    factor, _, _, label = _DRAWN[unit]
    cells = figure.subplots(-(-len(maps) // _A_ROW), _A_ROW, squeeze=False)
    low, high = error_scale([np.abs(factor * value) for value in maps.values()], 98)
    norm, colours = (log_norm(low, high), "magma") if unit == "px" else (
        Normalize(-high, high), LinearSegmentedColormap.from_list("signed", _SIGNED)
    )  # fmt: skip
    for axes in cells.ravel():
        axes.set_axis_off()
    for axes, (name, value) in zip(cells.ravel(), maps.items(), strict=False):
        shown = np.maximum(factor * value, low) if unit == "px" else factor * value
        picture = axes.imshow(shown, extent=(0, film_mm[0], 0, film_mm[1]), cmap=colours, norm=norm)
        axes.set_title(name, fontsize=8)
    bar = figure.colorbar(picture, ax=cells[:, : len(maps)], extend="both", aspect=12 * len(cells), pad=0.015)
    bar.ax.tick_params(labelsize=6.5)
    bar.set_label(label, fontsize=7)
    if unit == "px":
        plain_log_ticks(bar.ax.yaxis)
