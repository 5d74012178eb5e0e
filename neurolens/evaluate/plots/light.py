"""Relative illumination over the film, of the exact lens and of models. Plain data in, no tracer."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from neurolens.base.errors import InputError
from neurolens.evaluate.plots.style import FIELD_COLOURS, INK, new_figure, save, style


def illumination_plot(light: Mapping[str, Any], path: str | Path, title: str = "Relative illumination") -> Path:
    """Relative illumination against film radius: the exact lens as a line, models dashed on it, differences below.

    Args:
        light: film_radius_mm [N]; exact [N] and models (name to [N]), shares of the exact value on the axis.
        path: PNG, PDF or SVG to write.
    Raises:
        InputError: no radius, curves of another length, values that are not finite.
    """
    radius = np.asarray(light["film_radius_mm"], dtype=np.float64)
    exact = _curve("exact", light["exact"], radius)
    curves = {name: _curve(name, values, radius) for name, values in light["models"].items()}
    with style():
        figure = new_figure(7.6, 5.4)
        upper, lower = figure.subplots(2, 1, sharex=True, gridspec_kw={"height_ratios": (3, 1.2)})
        upper.plot(radius, exact, color=INK, lw=2.6, alpha=0.45, label="exact")
        for number, (name, values) in enumerate(curves.items()):
            colour = FIELD_COLOURS[number % len(FIELD_COLOURS)]
            upper.plot(radius, values, color=colour, lw=1.4, ls=(0, (4, 2 + number)), label=name)
            lower.plot(radius, 100 * (values - exact), color=colour, lw=1.4, marker=".", ms=4)
        upper.set_ylim(0, 1.04 * max(1.0, float(exact.max()), *(float(v.max()) for v in curves.values())))
        upper.set_ylabel("illumination (share of the axis)")
        upper.set_title(title, loc="left", fontweight="bold")
        upper.legend(loc="lower left")
        lower.axhline(0, color=INK, lw=0.9)
        lower.set_ylabel("model - exact\n(% of the axis)")
        lower.set_xlabel("film radius (mm)")
        for axes in (upper, lower):
            axes.grid(True)
        return save(figure, path)


def _curve(name: str, values: Any, radius: Any) -> Any:
    curve = np.asarray(values, dtype=np.float64)
    if radius.size == 0 or curve.shape != radius.shape or not np.isfinite(curve).all():
        raise InputError(
            "illumination plot", name, f"({curve.shape})", f"finite values, one a film radius, {radius.shape}"
        )
    return curve
