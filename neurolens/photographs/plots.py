"""One picture of what photographs measured, as points, and what rays give, as lines."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from neurolens.analysis.plots import FIELD_COLOURS, INK, drawing
from neurolens.photographs.compare import Curve
from neurolens.photographs.verify import Verified

_MOST = 6  # apertures, or focal lengths, that are drawn


def plot_verified(found: Verified, path: Path, title: str) -> None:
    """Draw distortion, lateral colour and light over image height; of a zoom, some of its focal lengths."""
    head = f"points: photographs, lensfun's {found.profile} ({found.certainty}); lines: rays."
    subtitle = f"{head}\n{'; '.join(found.verdict)}"
    with drawing(path, 13.5, 5.2, title, subtitle) as figure:
        left, middle, right = figure.subplots(1, 3)
        for axes, label in (
            (left, "distortion, % of the height, mean removed"),
            (middle, "beside green, µm"),
            (right, "light beside the axis, stops"),
        ):
            axes.grid(True)
            axes.set(xlabel="image height, mm", ylabel=label)
        bent = [(c.focal_mm, c.distortion_percent) for c in found.comparisons if c.distortion_percent is not None]
        for colour, (focal, curve) in zip(FIELD_COLOURS, _spread(bent), strict=False):
            _both(left, curve, colour, f"{focal:g} mm")
        for name, colour in (("red", "#d55e00"), ("blue", "#0072b2")):
            fringes = [
                (c.focal_mm, getattr(c, f"{name}_um"))
                for c in found.comparisons
                if getattr(c, f"{name}_um") is not None
            ]
            for focal, curve in fringes[:1]:
                _both(middle, curve, colour, f"{name}, {focal:g} mm")
        lit = [c for c in found.comparisons if c.light_stops]
        if lit:
            for colour, f_number in zip(FIELD_COLOURS, _spread(sorted(lit[0].light_stops)), strict=False):
                _both(right, lit[0].light_stops[f_number], colour, f"f/{f_number:g}")
            right.set_title(f"{lit[0].focal_mm:g} mm", loc="right", fontsize=9, color=INK)
        for axes in (left, middle, right):
            if axes.lines:
                axes.legend()
            else:
                axes.text(0.5, 0.5, "not measured", ha="center", transform=axes.transAxes, color=INK)


def _both(axes: Any, curve: Curve, colour: str, label: str) -> None:
    axes.plot(curve.height_mm, curve.computed, color=colour, label=label)
    axes.plot(curve.height_mm, curve.measured, "o", color=colour, markersize=3.5)


def _spread(items: list[Any]) -> list[Any]:
    """At most `_MOST` of a list, evenly spread, both ends among them."""
    if len(items) <= _MOST:
        return items
    return [items[round(k * (len(items) - 1) / (_MOST - 1))] for k in range(_MOST)]
