"""Error of models over a state: focal length of a zoom, or nearness of what internal focus focuses."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from neurolens.evaluate.plots.style import FIELD_COLOURS, INK, new_figure, plain_log_ticks, save, style
from neurolens.modelfile.axes import Axis

_LABELS = {"zoom": "focal length (mm)", "focus": "1 / distance in focus (1/m)"}


def states_plot(
    models: Mapping[str, Sequence[Mapping[str, Any]]],
    axis: Axis,
    path: str | Path,
    *,
    title: str = "One model of many states",
) -> Path:
    """Film-equivalent RMS over the first state axis, and false passes and blocks below it.

    Args:
        models: name to rows as of `state_errors.errors_at`.
        axis: the first axis.
        path: PNG, PDF or SVG to write.
    """
    with style():
        figure = new_figure(7.2, 5.6)
        top, bottom = figure.subplots(2, 1, sharex=True, height_ratios=(3, 2))
        for number, (name, rows) in enumerate(models.items()):
            colour = FIELD_COLOURS[number % len(FIELD_COLOURS)]
            _error_line(top, axis, rows, colour, name)
            for key, mark in (("false_pass", "^"), ("false_block", "v")):
                x, share = [r[axis.name] for r in rows], [100 * (r[key] or 0.0) for r in rows]
                bottom.plot(x, share, mark, ms=4, color=colour, alpha=0.8, label=f"{name}: {key.replace('_', ' ')}")
        _error_axes(top, axis, [r["rms_um"] for rows in models.values() for r in rows])
        top.set_title(title, loc="left", fontweight="bold")
        top.set_ylabel("film-equivalent RMS (um)")
        top.legend(loc="best", fontsize="small")
        bottom.set_ylabel("share of rays (%)")
        bottom.set_ylim(0, max(0.02, *bottom.get_ylim()))
        bottom.set_xlabel(_LABELS.get(axis.name, f"{axis.name} ({axis.unit})"))
        bottom.grid(True)
        bottom.legend(loc="best", fontsize="small")
        return save(figure, path)


Panel = tuple[str, Axis, Sequence[Mapping[str, Any]], Sequence[Mapping[str, Any]]]


def panels_plot(panels: Sequence[Panel], path: str | Path) -> Path:
    """A panel for each model: its error over the first state axis, and those of models fitted to one state each.

    Args:
        panels: title, first axis, rows of the model, rows of the others.
        path: PNG, PDF or SVG to write.
    """
    columns = 2 if len(panels) > 1 else 1
    with style():
        rows = -(-len(panels) // columns)
        figure = new_figure(5.2 * columns, 3.0 * rows)
        places = figure.subplots(rows, columns, squeeze=False).ravel()
        for place, (title, axis, states, fixed) in zip(places, panels, strict=False):
            _error_line(place, axis, states, FIELD_COLOURS[0], "one model of all states")
            if fixed:
                x = [r[axis.name] for r in fixed]
                place.plot(x, [r["rms_um"] for r in fixed], "s", ms=5, mfc="none", color=INK, label="one state each")
            _error_axes(place, axis, [r["rms_um"] for r in (*states, *fixed)])
            place.set_title(title, loc="left", fontsize="medium")
            place.set_xlabel(_LABELS.get(axis.name, f"{axis.name} ({axis.unit})"))
            place.set_ylabel("RMS (um)")
            place.legend(loc="best", fontsize="small")
        for place in places[len(panels) :]:
            place.set_visible(False)
        return save(figure, path)


def _error_line(axes: Any, axis: Axis, rows: Sequence[Mapping[str, Any]], colour: str, label: str) -> None:
    ordered = sorted(rows, key=lambda r: r[axis.name])
    several = any(set(r) & set(_LABELS) - {axis.name} for r in rows)  # another axis varies too: no line
    y = [r["rms_um"] or float("nan") for r in ordered]
    axes.plot([r[axis.name] for r in ordered], y, "o" if several else "o-", ms=4, color=colour, label=label)


def _error_axes(axes: Any, axis: Axis, errors: Sequence[float | None]) -> None:
    for knot in axis.knots:
        axes.axvline(knot, color=INK, lw=0.5, ls=":")
    if axis.name == "zoom":
        axes.set_xscale("log")
        plain_log_ticks(axes.xaxis)
    axes.set_yscale("log")
    plain_log_ticks(axes.yaxis)
    known = [e for e in errors if e]
    if known:  # at least a decade, so that noise does not look like a trend
        axes.set_ylim(min(known) / 2, max(10 * min(known), 2 * max(known)))
    axes.grid(True)
