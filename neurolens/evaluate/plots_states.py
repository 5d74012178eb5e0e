"""Error of models over a state: focal length of a zoom, or nearness of what internal focus focuses."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from neurolens.axes import Axis
from neurolens.evaluate.plots_style import FIELD_COLOURS, INK, new_figure, plain_log_ticks, save, style

_LABELS = {"zoom": "focal length (mm)", "focus": "1 / distance in focus (1/m)"}


def states_plot(
    models: Mapping[str, Sequence[Mapping[str, Any]]],
    axis: Axis,
    path: str | Path,
    *,
    fixed: Sequence[Mapping[str, Any]] = (),
    title: str = "One model of many states",
) -> Path:
    """Film-equivalent RMS over the first state axis, and false passes and blocks below it.

    Args:
        models: name to rows as of `state_errors.errors_at`.
        axis: the first axis.
        path: PNG, PDF or SVG to write.
        fixed: rows of models that were each fitted to one state, for comparison.
    """
    with style():
        figure = new_figure(7.2, 5.6)
        top, bottom = figure.subplots(2, 1, sharex=True, height_ratios=(3, 2))
        for number, (name, rows) in enumerate(models.items()):
            ordered = sorted(rows, key=lambda r: r[axis.name])
            x, colour = [r[axis.name] for r in ordered], FIELD_COLOURS[number % len(FIELD_COLOURS)]
            top.plot(x, [r["rms_um"] or float("nan") for r in ordered], "o-", ms=4, color=colour, label=name)
            for key, mark in (("false_pass", "^"), ("false_block", "v")):
                share = [100 * (r[key] or 0.0) for r in ordered]
                label = f"{name}: {key.replace('_', ' ')}"
                bottom.plot(x, share, mark, ms=4, color=colour, alpha=0.8, label=label)
        if fixed:
            x = [r[axis.name] for r in fixed]
            top.plot(x, [r["rms_um"] for r in fixed], "s", ms=5, mfc="none", color=INK, label="fitted to that state")
        for knot in axis.knots:
            top.axvline(knot, color=INK, lw=0.5, ls=":")
        if axis.name == "zoom":
            top.set_xscale("log")
            plain_log_ticks(bottom.xaxis)
        top.set_yscale("log")
        plain_log_ticks(top.yaxis)
        top.set_title(title, loc="left", fontweight="bold")
        top.set_ylabel("film-equivalent RMS (um)")
        bottom.set_ylabel("share of rays (%)")
        bottom.set_ylim(bottom=0)
        bottom.set_xlabel(_LABELS.get(axis.name, f"{axis.name} ({axis.unit})"))
        for axes in (top, bottom):
            axes.grid(True)
            axes.legend(loc="best", fontsize="small")
        return save(figure, path)
