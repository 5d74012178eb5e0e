"""Renders side by side with their error images, on one scale."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from neurolens.base.errors import InputError
from neurolens.evaluate.image import checked_image, to_srgb
from neurolens.evaluate.plots.style import new_figure, save, style

_Box = tuple[float, float, float, float]  # left, bottom, width, height in shares of the figure

_COLUMNS = 4  # more would leave each picture too small to judge


def side_by_side(
    images: Mapping[str, ArrayLike],
    error_maps: Mapping[str, ArrayLike],
    path: str | Path,
    captions: Mapping[str, str] | None = None,
    exposure: float = 1.0,
    error_label: str = "FLIP (0 to 1)",
    error_max: float | None = None,
    title: str = "",
) -> Path:
    """Renders in rows of four, each with its error image below; one colour bar serves all of them.

    Args:
        images: name to linear RGB [H, W, 3], shown with `exposure` through `image.to_srgb`; all of one shape.
        error_maps: name to error [H, W]; a name without one (the reference) keeps its place below for its caption.
        path: PNG, PDF or SVG to write.
        captions: name to one or two lines shown below its picture, for example `image_caption(...)`.
        error_label: quantity and unit beside the colour bar.
        error_max: top of the colour scale; by default the 99.5th percentile of all maps, rounded up.
    Raises:
        InputError: no image, shapes that differ, values that are not finite, a map without its image.
    """
    pictures = {name: checked_image(image, name) for name, image in images.items()}
    maps = {name: np.asarray(error, dtype=np.float64) for name, error in error_maps.items()}
    _check_shapes(pictures, maps)
    scale = error_max or _rounded_up(maps)
    height, width = next(iter(pictures.values())).shape[:2]
    with style():
        figure, places, bar_place = _page(len(pictures), height / width, bool(maps), title)
        shown = None
        for (name, picture), (top, below) in zip(pictures.items(), places, strict=True):
            axes = _picture_axes(figure, top)
            axes.imshow(to_srgb(picture, exposure), interpolation="nearest")
            axes.set_title(name, fontsize=10.5, fontweight="bold", pad=4)
            if name in maps:
                axes = _picture_axes(figure, below)
                shown = axes.imshow(maps[name], cmap="magma", vmin=0, vmax=scale, interpolation="nearest")
            _caption(axes, (captions or {}).get(name, ""))
        if shown is not None:
            bar = figure.colorbar(shown, cax=figure.add_axes(bar_place))
            bar.set_label(error_label)
            bar.outline.set_visible(False)
        return save(figure, path)


def image_caption(figures: Mapping[str, Any]) -> str:
    """Two lines from the result of `image.compare`: FLIP and relative MSE, each beside its noise floor."""
    parts = []
    for name, key in (("FLIP", "flip"), ("relMSE", "rel_mse")):
        value, floor = figures.get(key), figures.get(f"noise_floor_{key}")
        if value is not None:
            parts.append(f"{name} {value:.3g}" + ("" if floor is None else f" (noise {floor:.3g})"))
    return "\n".join(parts)


def _check_shapes(pictures: Mapping[str, Any], maps: Mapping[str, Any]) -> None:
    if not pictures:
        raise InputError("side by side", "images", "(none)", "at least one image")
    first = next(iter(pictures.values())).shape
    for name, picture in pictures.items():
        if picture.shape != first:
            raise InputError("side by side", f"image {name}", f"({picture.shape})", f"the shape of the first, {first}")
    for name, error in maps.items():
        if name not in pictures:
            raise InputError("side by side", "error map", name, "the name of an image: " + ", ".join(pictures))
        if error.shape != first[:2] or not np.isfinite(error).all():
            raise InputError("side by side", f"error map {name}", f"({error.shape})", f"finite values, {first[:2]}")


def _page(count: int, aspect: float, maps: bool, title: str) -> tuple[Any, list[tuple[_Box, _Box]], _Box]:
    """A figure, the (picture, error image) boxes of each of `count` pictures, and the box of the colour bar.

    Laid out in inches by hand: pictures keep their aspect and fill their width, which automatic layouts do not promise.
    """
    rows = math.ceil(count / _COLUMNS)
    columns = math.ceil(count / rows)
    wide = max(2.45, 7.6 / columns)
    tall, gap, name, words = wide * aspect, 0.12, 0.3, 0.46
    band = name + tall + (gap / 2 + tall if maps else 0) + words
    head, bar = (0.4 if title else 0.08), (0.95 if maps else gap)
    page = (gap + columns * (wide + gap) + bar, head + rows * band)
    figure = new_figure(*page)
    figure.set_layout_engine("none")
    if title:
        figure.text(gap / page[0], 1 - 0.12 / page[1], title, fontsize=12.5, fontweight="bold", va="top")

    def box(left: float, top: float, width: float, height: float) -> _Box:
        return left / page[0], 1 - (top + height) / page[1], width / page[0], height / page[1]

    places = []
    for index in range(count):
        left, top = gap + (index % columns) * (wide + gap), head + (index // columns) * band + name
        places.append((box(left, top, wide, tall), box(left, top + tall + gap / 2, wide, tall)))
    return figure, places, box(page[0] - bar + 0.08, head + name, 0.14, page[1] - head - name - words)


def _picture_axes(figure: Any, box: _Box) -> Any:
    axes = figure.add_axes(box)
    axes.set_axis_off()
    return axes


def _rounded_up(maps: Mapping[str, Any]) -> float:
    """99.5th percentile of all maps (not the maximum: fireflies), rounded up to 1, 2 or 5 times a power of ten."""
    if not maps:
        return 1.0
    value = float(np.percentile(np.concatenate([m.ravel() for m in maps.values()]), 99.5))
    if value <= 0:
        return 1.0
    power = 10.0 ** math.floor(math.log10(value))
    return next(step * power for step in (1, 2, 5, 10) if step * power >= value * (1 - 1e-9))


def _caption(axes: Any, text: str) -> None:
    axes.annotate(
        text, (0.5, 0), xycoords="axes fraction", xytext=(0, -5), textcoords="offset points", ha="center", va="top",
        fontsize=8.6, color="#444444",
    )  # fmt: skip
