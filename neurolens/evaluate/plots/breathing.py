"""Focus breathing drawn: field of view, focal length and magnification against the focus distance."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path

from neurolens.base.errors import InputError
from neurolens.evaluate.plots.style import FIELD_COLOURS, new_figure, plain_log_ticks, save, style
from neurolens.optics.focusing import Breath, breathing, field_change, focus_states, nearest_focus_m
from neurolens.optics.paraxial import first_order
from neurolens.optics.prescription import Focus, Lens

_DASHES = ((0, ()), (0, (5, 2)), (0, (1.5, 1.5)))


def breathing_plot(ways: Mapping[str, Sequence[Breath]], path: str | Path, title: str = "Focus breathing") -> Path:
    """Three panels over one logarithmic axis of distance; one line for each way of focusing.

    Args:
        ways: name of the way ("film moves", "groups move") to its states. Infinity is left out: it has no place on the
            axis.
        path: PNG, PDF or SVG to write.

    Raises:
        InputError: a way with fewer than two finite distances.
    """
    if not ways:
        raise InputError("breathing plot", "ways", "(none)", "at least one way of focusing")
    with style():
        figure = new_figure(7.6, 7.4)
        panels = figure.subplots(3, 1, sharex=True)
        for number, (name, breaths) in enumerate(ways.items()):
            near = sorted((b for b in breaths if b.focus_m < 1e9), key=lambda b: b.focus_m)
            if len(near) < 2:
                raise InputError("breathing plot", name, f"({len(near)} distances)", "two finite distances or more")
            look = {
                "color": FIELD_COLOURS[number % len(FIELD_COLOURS)],
                "ls": _DASHES[number % len(_DASHES)],
                "lw": 1.8,
            }
            distance = [b.focus_m for b in near]
            change = f"{name} (picture grows by {100 * field_change(breaths):.1f}%)"
            panels[0].plot(distance, [b.field_deg for b in near], label=change, **look)
            panels[1].plot(distance, [b.efl_mm for b in near], **look)
            panels[2].plot(distance, [abs(b.magnification) for b in near], **look)
        panels[0].set_title(title, loc="left", fontweight="bold")
        panels[0].legend(loc="best")
        labels = ("field of view (degrees,\nacross the image circle)", "focal length (mm)", "magnification")
        for axes, label in zip(panels, labels, strict=True):
            axes.set_ylabel(label)
            axes.grid(True)
            axes.ticklabel_format(axis="y", useOffset=False)
        panels[2].set_xscale("log")
        panels[2].set_yscale("log")
        panels[2].set_xlabel("distance from object to film (m)")
        plain_log_ticks(panels[2].xaxis)
        plain_log_ticks(panels[2].yaxis)
        return save(figure, path)


def draw_breathing(lens: Lens, path: str | Path, count: int = 48) -> dict[str, list[Breath]]:
    """Compute and draw a lens's breathing from its nearest focus to a thousand focal lengths.

    Both ways of focusing are drawn where the lens file has focus states. Returns what is drawn, infinity first.
    """
    data = first_order(lens.at())
    nearest = 1.05 * (4 * abs(data.efl_mm) + data.rear_principal_z_mm - data.front_principal_z_mm) / 1000
    ways: dict[str, Focus] = {"film moves": "film"}
    if focus_states(lens):
        ways["groups move"] = "internal"
        nearest = max(nearest, 1.0001 * nearest_focus_m(lens))
    far = max(abs(data.efl_mm), 10 * nearest)
    distances = [nearest * (far / nearest) ** (k / (count - 1)) for k in range(count)]
    found = {name: breathing(lens, [math.inf, *distances], way) for name, way in ways.items()}
    breathing_plot(found, path, f"Focus breathing of {lens.name}")
    return found
