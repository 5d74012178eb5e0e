"""Error against seconds of a scene's cameras, and where their rays land on the film. Plain data in."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from neurolens.analysis.plot_style import heading
from neurolens.base.errors import InputError
from neurolens.evaluate.plots.style import (
    FAINT,
    INK,
    family_colour,
    new_figure,
    plain_log_ticks,
    save,
    style,
)

_MARKERS = "osD^vP"
_FUSED = "fused "


@dataclass(frozen=True)
class Panel:
    """One kind of error.

    Attributes:
        label: quantity and unit. curves: camera to (seconds [L], error [L]); what is not above 0 is left out.
        floor: what the reference itself is worth, with its `floor_name`. levels: camera to an error that more samples
            do not lower, drawn where it lies in view.
    """

    label: str
    curves: Mapping[str, tuple[Sequence[float], Sequence[float]]]
    floor: float
    floor_name: str
    levels: Mapping[str, float]


def error_over_time_plot(panels: Sequence[Panel], path: str | Path, title: str, subtitle: str) -> Path:
    """Panels side by side, log-log, one line a camera, with the reference's own noise and the biases.

    Raises:
        InputError: nothing to draw.
    """
    if not panels or not any(panel.curves for panel in panels):
        raise InputError("error over time", "panels", "(none)", "at least one panel with a curve")
    with style():
        figure = new_figure(3.5 * len(panels), 4.1)
        row = figure.subplots(1, len(panels), squeeze=False)[0]
        handles: dict[str, Any] = {}
        for axes, panel in zip(row, panels, strict=True):
            handles |= _draw(axes, panel)
        heading(figure, title, subtitle)
        figure.legend(handles.values(), handles.keys(), loc="outside lower center", ncols=len(handles))
        return save(figure, path)


def _draw(axes: Any, panel: Panel) -> dict[str, Any]:
    handles = {}
    for k, (name, (seconds, errors)) in enumerate(panel.curves.items()):
        t, e = np.asarray(seconds, np.float64), np.asarray(errors, np.float64)
        kept = np.isfinite(e) & (e > 0)
        look = {"color": _colour(name), "marker": _MARKERS[k % len(_MARKERS)], "ms": 4.2, "lw": 1.4}
        look |= {"ls": "--", "mfc": "white"} if name.startswith(_FUSED) else {}
        handles[name] = axes.plot(t[kept], e[kept], **look)[0]
    axes.set(xscale="log", yscale="log", xlabel="render time (s)", ylabel=panel.label)
    low = min(axes.get_ylim()[0], 0.7 * panel.floor) if panel.floor > 0 else axes.get_ylim()[0]
    axes.set_ylim(low, axes.get_ylim()[1])
    if panel.floor > 0:
        axes.axhline(panel.floor, color=FAINT, lw=1.2, ls="--")
        axes.annotate(
            panel.floor_name, (0.02, panel.floor), xycoords=("axes fraction", "data"), xytext=(0, 2),
            textcoords="offset points", fontsize=7.6, color=FAINT, va="bottom",
        )  # fmt: skip
    for name, level in panel.levels.items():
        if level > low:
            handles[f"bias of {name}"] = axes.axhline(level, color=_colour(name), lw=1.0, ls=":")
    axes.grid(True, which="major")
    plain_log_ticks(axes.xaxis)
    plain_log_ticks(axes.yaxis)
    return handles


def film_maps_plot(
    maps: Mapping[str, ArrayLike],
    film_mm: tuple[float, float],
    path: str | Path,
    title: str,
    subtitle: str,
    captions: Mapping[str, str] | None = None,
) -> Path:
    """Film-space errors over the film, as the picture shows it, each with its own colour bar: they differ too much.

    Args:
        maps: camera to [rows, columns] in um; NaN (no ray) stays white.
        film_mm: width and height.
        captions: below the name of a camera.
    Raises:
        InputError: no map.
    """
    if not maps:
        raise InputError("film maps", "maps", "(none)", "at least one map")
    columns = 2 if len(maps) in (2, 4) else min(len(maps), 3)
    rows = -(-len(maps) // columns)
    with style():
        figure = new_figure(4.0 * columns, 0.7 + 2.3 * rows)
        places = figure.subplots(rows, columns, squeeze=False).ravel()
        across, up = film_mm[0] / 2, film_mm[1] / 2
        for axes, (name, values) in zip(places, maps.items(), strict=False):
            shown = axes.imshow(np.asarray(values), cmap="magma", vmin=0, extent=(-across, across, -up, up))
            axes.set_title(f"{name}\n{(captions or {}).get(name, '')}", fontsize=9.5)
            axes.set(xlabel="across the picture (mm on the film)", ylabel="up (mm)")
            axes.xaxis.label.set_size(8.5)
            bar = figure.colorbar(shown, ax=axes, shrink=0.85)
            bar.set_label("median error (µm)", fontsize=8.5)
            bar.outline.set_visible(False)
        for axes in places[len(maps) :]:
            axes.set_axis_off()
        heading(figure, title, subtitle)
        return save(figure, path)


def _colour(name: str) -> str:
    """Black for the exact lens, else that of the family that a name begins with; a fused camera is drawn dashed."""
    kind = name.removeprefix(_FUSED)
    if kind == "exact":
        return INK
    return family_colour("paraxial" if kind.startswith("thin") else kind.split("-")[0])
