"""The figure of an effect: a row a panel, a column per camera, their difference last; axes in millimetres of film."""

from __future__ import annotations

import io
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image as Pictures

from experiments import lab
from experiments.gallery.cameras import TITLES, luminance
from neurolens.analysis.plot_style import new_figure, style
from neurolens.base.errors import InputError
from neurolens.study.figures import rounded_up
from neurolens.study.image import Image, to_srgb

DPI = 100  # a picture of 360 pixels is 3.6 inches wide: one pixel of it, one of the figure
MOST_BYTES = 400_000
_LEFT, _GAP, _HEAD, _FOOT, _BAR, _LABEL = 0.52, 0.1, 0.62, 0.34, 0.98, 0.2  # inches


@dataclass(frozen=True)
class Row:
    """One panel's pictures.

    Attributes:
        label, window_mm: centre x and y as printed, width and height.
        pictures: column to linear RGB [H, W, 3]. exposure: factor on them.
        difference: [H, W] |surrogate - exact| in luminance, as a share of white, or None.
    """

    label: str
    window_mm: tuple[float, float, float, float]
    pictures: dict[str, Any]
    exposure: float
    difference: Image | None


def difference_of(surrogate: Any, exact: Any, exposure: float) -> Image:
    """|surrogate - exact| in luminance [H, W], as a share of the display's white."""
    return np.abs(luminance(surrogate) - luminance(exact)) * exposure


def exposure_of(exact: Any, stops: float | str) -> float:
    """The factor on linear RGB that `Panel.exposure` asks for."""
    if not isinstance(stops, str):
        return float(2.0**stops)
    brightest = float(np.percentile(luminance(exact), 99.5)) or float(luminance(exact).max())
    return 0.9 / brightest if brightest > 0 else 1.0


def draw(title: str, rows: Sequence[Row], path: Path) -> None:
    """Write the figure, its pictures denoised, as a JPEG of at most `MOST_BYTES`.

    Raises:
        InputError: no rows, or a figure that cannot be made so small.
    """
    if not rows:
        raise InputError("gallery figure", "rows", "(none)", "at least one panel")
    maps = [row.difference for row in rows if row.difference is not None]
    scale = rounded_up(max((float(np.percentile(m, 99.5)) for m in maps), default=1e-6))
    with style():
        figure, boxes, bar = _page(rows, bool(maps))
        figure.text(0.006, 1 - 0.08 / figure.get_figheight(), title, fontsize=12.5, fontweight="bold", va="top")
        shown = None
        for index, (row, places) in enumerate(zip(rows, boxes, strict=True)):
            for k, (column, place) in enumerate(zip([*row.pictures, "difference"], places, strict=False)):
                if column == "difference" and row.difference is None:
                    continue
                axes = figure.add_axes(place)
                x, y, width, height = row.window_mm
                extent = (x - width / 2, x + width / 2, y - height / 2, y + height / 2)
                look: dict[str, Any] = {"extent": extent, "interpolation": "nearest"}
                if column == "difference":
                    shown = axes.imshow(row.difference, cmap="magma", vmin=0, vmax=scale, **look)
                else:
                    axes.imshow(to_srgb(lab.denoised(row.pictures[column]), row.exposure), **look)
                _axes(axes, first=k == 0)
                if k == 0:
                    axes.set_title(row.label, loc="left", fontsize=8.6, pad=3)
                if index == 0:
                    name = TITLES.get(column, "|surrogate - exact|" if column == "difference" else column)
                    top = places[0][1] + places[0][3] + _LABEL / figure.get_figheight()
                    figure.text(place[0], top, name, fontsize=9.5, fontweight="bold", va="bottom")
        if shown is not None:
            colours = figure.colorbar(shown, cax=figure.add_axes(bar), format="%.1e")
            colours.set_label("share of white", fontsize=8)
            colours.ax.tick_params(labelsize=7)
            colours.outline.set_visible(False)
        _save_small(figure, path)


def _axes(axes: Any, first: bool) -> None:
    axes.tick_params(labelsize=6.5, length=2, pad=1.5)
    axes.locator_params(nbins=4)
    for spine in axes.spines.values():
        spine.set_visible(False)
    if first:
        axes.set_ylabel("film y (mm)", fontsize=7, labelpad=1)
        axes.set_xlabel("film x (mm)", fontsize=7, labelpad=1)
    else:
        axes.set_xticks([])
        axes.set_yticks([])


def _page(rows: Sequence[Row], maps: bool) -> tuple[Any, list[list[Any]], Any]:
    """A figure, boxes (left, bottom, width, height in shares) of every row's pictures, and that of the colour bar."""
    sizes = [next(iter(row.pictures.values())).shape[:2] for row in rows]
    columns = max(len(row.pictures) for row in rows) + maps
    wide = max(width for _, width in sizes) / DPI
    heights = [height / DPI for height, _ in sizes]
    page = (_LEFT + columns * (wide + _GAP) + (_BAR if maps else 0), _HEAD + sum(h + _FOOT + _LABEL for h in heights))
    figure = new_figure(*page)
    figure.set_layout_engine("none")

    def box(left: float, top: float, width: float, height: float) -> tuple[float, float, float, float]:
        return left / page[0], 1 - (top + height) / page[1], width / page[0], height / page[1]

    boxes, top = [], _HEAD
    for (_, across), tall in zip(sizes, heights, strict=True):
        boxes.append([box(_LEFT + k * (wide + _GAP), top, across / DPI, tall) for k in range(columns)])
        top += tall + _FOOT + _LABEL
    return figure, boxes, box(page[0] - _BAR + 0.08, _HEAD, 0.13, min(max(heights[0], 1.4), 2.6))


def _save_small(figure: Any, path: Path) -> None:
    """Write the figure as a JPEG that is small enough for the repository, its colours as sharp as its brightness."""
    drawn = io.BytesIO()
    figure.savefig(drawn, dpi=DPI, facecolor="white", format="png")
    picture = Pictures.open(drawn).convert("RGB")
    forms = ((picture, {"quality": quality, "subsampling": 0, "optimize": True}) for quality in (82, 76))
    lab.write_small(path, forms, MOST_BYTES)
