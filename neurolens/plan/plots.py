"""Pictures of plans: effects beside their budget, maps of them, each camera's error over its time."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from neurolens.analysis.plots import INK, drawing, plain_log_ticks
from neurolens.plan.plan import Plan, front
from neurolens.study.plots import CHOSEN, error_scale, family_colour, log_norm, noisy_lines, place_labels

_COLUMNS = 4  # of maps
# Light that an effect takes is dark, light that it adds is orange; none is white.
_SIGNED = ("#10183a", "#4d6796", "#c9d1de", "#ffffff", "#f6cfae", "#e58a45", CHOSEN)
_TITLES = {"px": "pixels (logarithmic)", "relative": "% of the light\n(dark: taken, orange: added)"}


def plot_effects(plan: Plan, path: Path, title: str) -> None:
    """Draw effects as bars with the budget, the error of every timed camera against its time, and maps of the effects
    that a camera needs: those in pixels, then those of light, each with one scale."""
    asked = plan.asked
    shown = [e for e in plan.effects if e.needed and e.name in plan.probed.maps]
    groups = {unit: [e.name for e in shown if e.unit == unit] for unit in _TITLES}
    groups = {unit: names for unit, names in groups.items() if names}
    heights = [4.2, *(1.6 * -(-len(names) // _COLUMNS) + 0.15 for names in groups.values())]
    subtitle = f"f/{asked.f_number:.3g}, focus {asked.shot.focus_m:g} m; 95% of the picture keeps these figures"
    with drawing(path, 9.5, sum(heights), title, subtitle) as figure:
        if not groups:
            _bars_and_trade(plan, figure)
            return
        above, *below = figure.subfigures(len(heights), 1, height_ratios=heights)
        _bars_and_trade(plan, above)
        for part, (unit, names) in zip(below, groups.items(), strict=True):
            _maps(part, {name: plan.probed.maps[name][1] for name in names}, unit, asked.shot.film_mm)


def _maps(figure: Any, maps: Mapping[str, Any], unit: str, film_mm: tuple[float, float]) -> None:
    """Maps of effects of one unit, upright, in one scale of colours with its bar."""
    from matplotlib.colors import LinearSegmentedColormap, Normalize

    colours: Any = "magma"
    if unit == "px":
        low, high = error_scale(maps.values(), 98)
        norm = log_norm(low, high)
        maps = {name: np.maximum(value, low) for name, value in maps.items()}
    else:
        maps = {name: 100 * value for name, value in maps.items()}
        high = error_scale([np.abs(value) for value in maps.values()], 98)[1]
        norm, colours = Normalize(-high, high), LinearSegmentedColormap.from_list("signed", _SIGNED)
    cells = figure.subplots(-(-len(maps) // _COLUMNS), _COLUMNS, squeeze=False)
    for axes, (name, value) in zip(cells.ravel(), maps.items(), strict=False):
        extent = (0, film_mm[0], 0, film_mm[1])
        picture = axes.imshow(value, extent=extent, cmap=colours, norm=norm, interpolation="nearest")
        axes.set_title(name, fontsize=8)
        axes.set(xticks=[], yticks=[])
    for axes in cells.ravel()[len(maps) :]:
        axes.set_axis_off()
    bar = figure.colorbar(picture, ax=cells, extend="both", aspect=12 * len(cells), pad=0.015)
    bar.ax.tick_params(labelsize=6.5)
    bar.set_label(_TITLES[unit], fontsize=7)
    if unit == "px":
        plain_log_ticks(bar.ax.yaxis)


def _bars_and_trade(plan: Plan, figure: Any) -> None:
    wide = [e for e in plan.effects if e.unit == "px"][::-1]
    bars, trade = figure.subplots(1, 2, width_ratios=(1.0, 1.1))
    least = max(min((e.worth for e in wide if e.worth > 0), default=1e-3) / 3, 1e-4)
    colours = [family_colour("ols") if e.needed else "#b8b8b8" for e in wide]
    bars.barh([e.name for e in wide], [max(e.worth, least) for e in wide], color=colours, left=0)
    bars.set_xscale("log")
    bars.set_xlim(left=least)
    bars.set_xlabel("worth (pixels), grey: left out")
    _cameras(trade, plan)
    trade.set_xlabel(f"{plan.unit_s} of the {plan.what}, --for {plan.target}")
    if plan.budget_px > 0:
        bars.axvline(plan.budget_px, color=CHOSEN, lw=1.2)
    plain_log_ticks(bars.xaxis)


def _cameras(axes: Any, plan: Plan) -> None:
    """Errors of cameras over their least time, with their median: within the budget in colour, the chosen one with a
    ring. From a noisy time a line leads to the median of its repeats."""
    timed = [c for c in plan.choices if 0 < c.seconds < float("inf") and c.error_px < float("inf")]
    points = [(c.seconds, max(c.error_px, 1e-4)) for c in timed]
    axes.scatter(*np.reshape(points, (-1, 2)).T, c=["#0072b2" if c.within else "#b8b8b8" for c in timed], s=26)
    ring = {"s": 150, "fc": "none", "ec": CHOSEN, "lw": 1.8}
    for point in (p for p, c in zip(points, timed, strict=True) if c == plan.best):
        axes.scatter(*point, **ring)
    noisy_lines(axes, [(y, x, x + c.more) for (x, y), c in zip(points, timed, strict=True) if c.noisy])
    axes.set(xscale="log", yscale="log", ylabel="error (pixels; none is drawn at 0.0001)")
    place_labels(axes, points, [c.name.rpartition(".")[2] or c.name for c in timed])  # a model without its lens
    if plan.budget_px > 0:
        axes.axhline(plan.budget_px, color=CHOSEN, lw=1.2, label=f"budget {plan.budget_px:g} px; ring: chosen")
    if any(axes.get_legend_handles_labels()):
        axes.legend(loc="lower right", bbox_to_anchor=(1, 1), frameon=False, ncols=2)
    plain_log_ticks(axes.xaxis, axes.yaxis)


def plot_trade(plan: Plan, path: Path, title: str) -> None:
    """Error of every camera against its seconds, with the front of those that no other betters."""
    best = front(plan.choices)
    subtitle = f"--for {plan.target}; 95% of the picture keeps these errors"
    with drawing(path, 8.5, 5.0, title, subtitle) as figure:
        axes = figure.subplots()
        at = [c.seconds for c in best], [max(c.error_px, 1e-4) for c in best]
        axes.step(*at, where="post", color=INK, lw=1.2, alpha=0.7, label="no camera betters both")
        axes.set_xlabel(f"{plan.unit_s} of the {plan.what}, one thread, to equal noise")
        _cameras(axes, plan)
