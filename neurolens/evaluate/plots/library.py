"""Many lenses on one sheet: a small section each, to their own scales."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from neurolens.analysis.layout import (
    checked_rays,
    checked_surfaces,
    draw_film,
    draw_glass,
    draw_rays,
    draw_rims,
    z_range,
)
from neurolens.analysis.plot_style import FAINT, new_figure, save, style
from neurolens.base.errors import InputError

_COLUMNS = 6
_CELL_IN = (2.6, 2.0)  # width and height of one section with its title


def sheet(profiles: Sequence[Mapping[str, Any]], path: str | Path) -> Path:
    """Draw lenses in section, light from left to right, each as large as its cell allows, axes of equal scale.

    Args:
        profiles: as `analysis.layout.lens_layout` takes them, with title and subtitle.
        path: PNG, PDF or SVG to write.
    Raises:
        InputError: no lens at all.
    """
    if not profiles:
        raise InputError("lens sheet", "profiles", "(none)", "at least one lens")
    columns = min(_COLUMNS, len(profiles))
    rows = math.ceil(len(profiles) / columns)
    with style():
        figure = new_figure(_CELL_IN[0] * columns, _CELL_IN[1] * rows)
        for place, profile in enumerate(profiles):
            _cell(figure.add_subplot(rows, columns, place + 1), profile)
        return save(figure, path)


def _cell(axes: Any, profile: Mapping[str, Any]) -> None:
    surfaces = checked_surfaces(profile)
    height = max(float(s["semi_diameter_mm"]) for s in surfaces)
    z = z_range(profile, surfaces, height)
    top = max(height * 1.18, 1.06 * float(profile.get("film_half_height_mm") or 0))
    axes.set(xlim=z, ylim=(-top, top), aspect="equal")
    axes.axis("off")
    axes.plot(z, (0, 0), color=FAINT, lw=0.4, zorder=1)
    draw_glass(axes, surfaces)
    draw_rims(axes, surfaces, height)
    draw_film(axes, profile)
    draw_rays(axes, checked_rays(profile))
    for line in axes.lines:
        line.set_linewidth(0.6 * line.get_linewidth())
    for patch in axes.patches:
        patch.set_linewidth(0.5)
    axes.set_title(f"{profile.get('title', '')}\n{profile.get('subtitle', '')}", fontsize=6, loc="left")
