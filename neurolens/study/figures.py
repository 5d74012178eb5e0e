"""Figures of renders and lenses: pictures beside their errors, light over the film, breathing, a sheet of lenses."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from neurolens.analysis.breathing import Breath, breathing, field_change
from neurolens.analysis.layout import Layout, draw_section
from neurolens.analysis.plot_style import FIELD_COLOURS, INK, drawing, plain_log_ticks
from neurolens.base.errors import InputError
from neurolens.lens.paraxial import first_order
from neurolens.lens.prescription import Lens
from neurolens.lens.shot import FocusMode
from neurolens.setting.focusing import focus_states, nearest_focus_m
from neurolens.setting.states import set_lens
from neurolens.study.image import ImageErrors, checked_image, to_srgb
from neurolens.study.vignetting import Illumination

_COLUMNS = 4  # with more, each picture would be too small


def side_by_side(
    images: Mapping[str, ArrayLike],
    error_maps: Mapping[str, ArrayLike],
    path: str | Path,
    captions: Mapping[str, str] | None = None,
    title: str = "",
) -> Path:
    """Renders in rows of four, each with its FLIP error image below; one colour bar serves all of them.

    Args:
        images: name to linear RGB [H, W, 3], shown through `image.to_srgb`; all of one shape.
        error_maps: name to error [H, W]; a name without one (the reference) keeps its place below for its caption.
            All share one logarithmic scale (`error_scale`), so that small errors show beside large ones.
        path: PNG, PDF or SVG to write.
        captions: name to one or two lines shown below its picture, for example `image_caption(...)`.
    Raises:
        InputError: no image, shapes that differ, values that are not finite, a map without its image.
    """
    pictures = {name: checked_image(image, name) for name, image in images.items()}
    maps = {name: np.asarray(error, dtype=np.float64) for name, error in error_maps.items()}
    _check_shapes(pictures, maps)
    low, high = error_scale(maps.values(), 99.5)
    height, width = next(iter(pictures.values())).shape[:2]
    rows, each = math.ceil(len(pictures) / _COLUMNS), 2 if maps else 1
    columns = math.ceil(len(pictures) / rows)
    wide = max(2.45, 7.6 / columns)
    with drawing(path, columns * wide + 1, rows * (each * wide * height / width + 1), title) as figure:
        figure.set_layout_engine("compressed", h_pad=0.06)  # for pictures, which keep their aspect
        grid = figure.subplots(each * rows, columns, squeeze=False)
        for axes in grid.flat:
            axes.set_axis_off()
        for k, (name, picture) in enumerate(pictures.items()):
            above, below = (grid[k // columns * each + i, k % columns] for i in (0, each - 1))
            above.imshow(to_srgb(picture), interpolation="nearest")
            above.set_title(name, fontsize=10.5, fontweight="bold", pad=4)
            if name in maps:
                look = {"cmap": "magma", "norm": log_norm(low, high), "interpolation": "nearest"}
                shown = below.imshow(np.maximum(maps[name], low), **look)
            _caption(below if name in maps else above, (captions or {}).get(name, ""))
        if maps:
            label = "FLIP difference, no unit: 0 none, 1 the most (logarithmic, one scale for all)"
            bar = figure.colorbar(shown, ax=grid, label=label, aspect=40, extend="both")
            bar.outline.set_visible(False)
            plain_log_ticks(bar.ax.yaxis)
    return Path(path)


def image_caption(errors: ImageErrors) -> str:
    """Two lines: FLIP with the same random numbers, and relative MSE with others, each beside its noise floor."""
    return (
        f"FLIP {errors.flip_paired:.3g} (noise {errors.noise_floor_flip:.3g})\n"
        f"relMSE {errors.rel_mse:.3g} (noise {errors.noise_floor_rel_mse:.3g})"
    )


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


_DECADES = 3  # of a scale of errors


def error_scale(maps: Iterable[ArrayLike], counted: float) -> tuple[float, float]:
    """Ends of the logarithmic scale that maps of errors share: three decades up to the counted percentile of the map
    with the largest errors (not the maximum: fireflies), rounded up."""
    known = [m[np.isfinite(m)] for m in map(np.asarray, maps)]
    high = rounded_up(max((float(np.percentile(m, counted)) for m in known if m.size), default=0.0))
    return high / 10**_DECADES, high


def log_norm(low: float, high: float) -> Any:
    """Matplotlib's logarithmic scale of colours."""
    from matplotlib.colors import LogNorm

    return LogNorm(low, high, clip=False)


def rounded_up(value: float) -> float:
    """1, 2 or 5 times a power of ten; 1 for nothing."""
    if value <= 0:
        return 1.0
    power = 10.0 ** math.floor(math.log10(value))
    return next(step * power for step in (1, 2, 5, 10) if step * power >= value * (1 - 1e-9))


def _caption(axes: Any, text: str) -> None:
    axes.annotate(
        text, (0.5, 0), xycoords="axes fraction", xytext=(0, -5), textcoords="offset points", ha="center", va="top",
        fontsize=8.6, color="#444444",
    )  # fmt: skip


def illumination_plot(
    curves: Mapping[str, Illumination], path: str | Path, title: str = "Relative illumination"
) -> Path:
    """Relative illumination against film radius: the exact lens as a line, models dashed on it, differences below.

    Args:
        curves: of models by name, all against the same exact lens.
        path: PNG, PDF or SVG to write.
    Raises:
        InputError: no model, values that are not finite.
    """
    if not curves or not all(np.isfinite([c.exact, c.model]).all() for c in curves.values()):
        raise InputError("illumination plot", "curves", f"({', '.join(curves) or 'none'})", "finite values of a model")
    first = next(iter(curves.values()))
    radius, exact = first.film_radius_mm, np.asarray(first.exact)
    models = {name: np.asarray(curve.model) for name, curve in curves.items()}
    with drawing(path, 7.6, 5.4) as figure:
        upper, lower = figure.subplots(2, 1, sharex=True, gridspec_kw={"height_ratios": (3, 1.2)})
        upper.plot(radius, exact, color=INK, lw=2.6, alpha=0.45, label="exact")
        for number, (name, values) in enumerate(models.items()):
            colour = FIELD_COLOURS[number % len(FIELD_COLOURS)]
            upper.plot(radius, values, color=colour, lw=1.4, ls=(0, (4, 2 + number)), label=name)
            lower.plot(radius, 100 * (values - exact), color=colour, lw=1.4, marker=".", ms=4)
        upper.set_ylim(0, 1.04 * max(1.0, float(exact.max()), *(float(v.max()) for v in models.values())))
        upper.set_ylabel("illumination (share of the axis)")
        upper.set_title(title, loc="left", fontweight="bold")
        upper.legend(loc="lower left")
        lower.axhline(0, color=INK, lw=0.9)
        lower.set_ylabel("model - exact\n(% of the axis)")
        lower.set_xlabel("film radius (mm)")
        for axes in (upper, lower):
            axes.grid(True)
    return Path(path)


_DASHES = ((0, ()), (0, (5, 2)))


def draw_breathing(lens: Lens, path: str | Path, count: int = 48) -> dict[str, list[Breath]]:
    """Compute and draw a lens's breathing from its nearest focus to a thousand focal lengths.

    Three panels over one logarithmic axis of distance, which has no place for infinity; a line for each way of
    focusing, both where the lens file has focus states. Returns what is drawn, infinity first.
    """
    data = first_order(set_lens(lens))
    nearest = 1.05 * (4 * abs(data.efl_mm) + data.rear_principal_z_mm - data.front_principal_z_mm) / 1000
    ways: dict[str, FocusMode] = {"film moves": "paraxial"}
    if focus_states(lens):
        ways["groups move"] = "internal"
        nearest = max(nearest, 1.0001 * nearest_focus_m(lens))
    far = max(abs(data.efl_mm), 10 * nearest)
    distances = [nearest * (far / nearest) ** (k / (count - 1)) for k in range(count)]
    found = {name: breathing(lens, [math.inf, *distances], way) for name, way in ways.items()}
    with drawing(path, 7.6, 7.4) as figure:
        panels = figure.subplots(3, 1, sharex=True)
        for (name, breaths), colour, dashes in zip(found.items(), FIELD_COLOURS, _DASHES, strict=False):
            look = {"label": f"{name} (picture grows by {100 * field_change(breaths):.1f}%)", "lw": 1.8}
            near = [(b.field_deg, b.efl_mm, abs(b.magnification)) for b in breaths[1:]]
            for axes, values in zip(panels, zip(*near, strict=True), strict=True):
                axes.plot(distances, values, color=colour, ls=dashes, **look)
        panels[0].set_title(f"Focus breathing of {lens.name}", loc="left", fontweight="bold")
        panels[0].legend(loc="best")
        labels = ("field of view (degrees,\nacross the image circle)", "focal length (mm)", "magnification")
        for axes, label in zip(panels, labels, strict=True):
            axes.set_ylabel(label)
            axes.grid(True)
            axes.ticklabel_format(axis="y", useOffset=False)
        panels[2].set(xscale="log", yscale="log", xlabel="distance from object to film (m)")
        plain_log_ticks(panels[2].xaxis, panels[2].yaxis)
    return found


_LIBRARY_COLUMNS = 6
_CELL_IN = (2.6, 2.0)  # width and height of one section with its title


def sheet(profiles: Sequence[Layout], path: str | Path) -> Path:
    """Draw lenses in section, light from left to right, each as large as its cell allows, axes of equal scale.

    Args:
        path: PNG, PDF or SVG to write.
    Raises:
        InputError: no lens at all.
    """
    if not profiles:
        raise InputError("lens sheet", "profiles", "(none)", "at least one lens")
    columns = min(_LIBRARY_COLUMNS, len(profiles))
    rows = math.ceil(len(profiles) / columns)
    with drawing(path, _CELL_IN[0] * columns, _CELL_IN[1] * rows) as figure:
        for place, profile in enumerate(profiles):
            _cell(figure.add_subplot(rows, columns, place + 1), profile)
    return Path(path)


def _cell(axes: Any, profile: Layout) -> None:
    axes.axis("off")
    draw_section(axes, profile, lw=0.4)
    for line in axes.lines:
        line.set_linewidth(0.6 * line.get_linewidth())
    for patch in axes.patches:
        patch.set_linewidth(0.5)
    axes.set_title(f"{profile.title}\n{profile.subtitle}", fontsize=6, loc="left")
