"""Plots of a run: error against time and size, illumination, error over zoom and focus."""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from neurolens.base.errors import InputError
from neurolens.models.axes import Axis
from neurolens.models.fitted import Domain
from neurolens.optics.analysis import layout
from neurolens.optics.analysis.fields import Scene
from neurolens.optics.analysis.plots import FIELD_COLOURS, INK, drawing, plain_log_ticks
from neurolens.optics.lens.prescription import Lens
from neurolens.studies.pages import Record, ns_text, number
from neurolens.studies.rays import Illumination
from neurolens.studies.records import NOISY, noisy, pareto_front, time_of

# Names, Okabe and Ito's colours, and markers, which tell kinds apart without colours; black is the exact tracer's.
Kinds = Mapping[str, tuple[str, str, str]]
FAMILIES: Kinds = {
    "paraxial": ("paraxial", "#7f7f7f", "D"),
    "dense": ("dense", "#56b4e9", "s"),
    "omp": ("OMP", "#e69f00", "s"),
    "ols": ("orthogonal LS", "#0072b2", "o"),
    "mlp": ("MLP", "#d55e00", "^"),
}
_OTHER = ("other", "#cc79a7", "v")
_ERRORS = {
    "rms_um_at_21_6": "film-equivalent error, RMS (µm at 21.6 mm image radius)",
    "rms_um": "film-equivalent error, RMS (µm)",
    "direction_rms_deg": "direction error, RMS (degrees)",
}
CHOSEN = "#d55e00"
_RING = {"ms": 13, "mfc": "none", "mec": CHOSEN, "mew": 1.8, "ls": "none"}
_Point = tuple[float, float, Record, bool]  # time or size, error, the model, whether as C


def layout_profile(lens: Lens, domain: Domain) -> layout.Layout:
    """Return a lens's section with meridional fans of rays to the axis, 70% and the edge of the domain's film, d line.

    Args:
        lens: placed by `set_lens`; else the film is that of the domain's farthest focus.
    """
    if lens.film_z_mm is None:
        lens = replace(lens, film_z_mm=float(domain.film_z_mm[0]))
    return layout.layout_profile(Scene(lens, domain.focus_m[0]), domain.film_radius_mm)


def trade_plot(
    title: str, records: Sequence[Record], exact: Sequence[Record], path: Path, kinds: Kinds = FAMILIES,
    kind: str = "family", use: str | None = None,
) -> bool:  # fmt: skip
    """Draw error against time (hollow: as C) and below against size; returns whether any time is there to draw.

    Exact tracers, which have no error, are lines at their time. The staircase is the front that nothing betters. From a
    noisy time (`records.noisy`) a line leads to the median of its rounds. A ring marks the model that is advised, at
    the time that the advice states.

    Args:
        records: of models by `name`, with errors, ns_per_ray, fused_ns_per_ray, coefficients_per_vector, parameters.
            Those without an error, time or size are left out.
        exact: `records.ExactRecord`s.
        path: PNG, PDF or SVG to write.
        kinds: name, colour and marker of each value that `kind` has in the records.
        use: name of the advised model or exact tracer.
    """
    error = next((k for k in _ERRORS if any((number(r, k) or 0) > 0 for r in records)), None)
    if error is None:
        return False
    shown = [r for r in records if (number(r, error) or 0) > 0]
    times = [*_points(shown, "ns_per_ray.min", error), *_points(shown, "fused_ns_per_ray.min", error)]
    sizes = _points(shown, "coefficients_per_vector", error)
    sizes += [p for p in _points(shown, "parameters", error) if number(p[2], "coefficients_per_vector") is None]
    timings = [(number(r, error), r.get(key)) for r in shown for key in ("ns_per_ray", "fused_ns_per_ray")]
    if not times:
        return False
    with drawing(path, 9.0, 10.8) as figure:
        upper, lower = figure.subplots(2, 1, sharey=True)
        _panel(upper, times, "time per ray (ns, best of the rounds)", kinds, kind)
        _panel(lower, sizes, "coefficients of one vector output (networks: all weights)", kinds, kind)
        noisy_lines(upper, [(e, t["min"], t["median"]) for e, t in timings if t is not None and noisy(t)])
        for dashes, tracer in zip((":", "--", "-."), exact, strict=False):
            if time := number(tracer, "ns_per_ray.min"):
                look = {"color": INK, "lw": 1.0, "ls": dashes}
                look |= {"color": CHOSEN, "lw": 2.0} if tracer["name"] == use else {}
                label = f"{tracer['name']} {ns_text(time_of(tracer))}" + ": use" * (tracer["name"] == use)
                upper.axvline(time, label=label, **look)
        advised = [(x, number(r, error)) for r in shown if r["name"] == use and (x := number(time_of(r), "min"))]
        if advised:
            upper.plot(*advised[0], "o", label=f"use {use}", **_RING)
        figure.suptitle(f"{title}: error against time and size", x=0.01, ha="left", fontweight="bold")
        legends = [axes.get_legend_handles_labels() for axes in (upper, lower)]
        handles = {label: h for legend in legends for h, label in zip(*legend, strict=True)}
        figure.legend(handles.values(), handles.keys(), loc="outside lower center", ncols=2)
        for axes, points in ((upper, times), (lower, sizes)):
            axes.set_ylabel(_ERRORS[error])
            plain_log_ticks(axes.xaxis, axes.yaxis)
            axes.grid(True, which="major")
            if points:
                place_labels(axes, [p[:2] for p in points], [str(p[2]["name"]) for p in points])
    return True


def noisy_lines(axes: Any, lines: Sequence[tuple[Any, float, float]]) -> None:
    """Draw lines, at heights, from the least of a noisy time to its median."""
    if lines:
        label = f"to the median of a noisy time, over {NOISY:g} times its least"
        axes.hlines(*zip(*lines, strict=True), color=INK, lw=0.8, alpha=0.6, label=label)


def _points(records: Sequence[Record], key: str, error: str) -> list[_Point]:
    fused = key.startswith("fused")
    return [(x, number(r, error) or 0.0, r, fused) for r in records if (x := number(r, key) or 0.0) > 0]


def _panel(axes: Any, points: Sequence[_Point], label: str, kinds: Kinds, kind: str) -> None:
    axes.set(xscale="log", yscale="log", xlabel=label)
    for each in dict.fromkeys([*kinds, *(str(p[2].get(kind)) for p in points)]):
        name, colour, marker = kinds.get(each, _OTHER)
        for fused in (False, True):
            part = [p[:2] for p in points if str(p[2].get(kind)) == each and p[3] == fused]
            if part:
                look = {"mfc": "white" if fused else colour, "mec": colour, "ms": 6.5, "mew": 1.4, "ls": "none"}
                axes.plot(*zip(*part, strict=True), marker, label=name + ", as C" * fused, zorder=3, **look)
    if points:
        front = [points[i][:2] for i in pareto_front([p[:2] for p in points])]
        axes.step(*zip(*front, strict=True), where="post", color=INK, lw=1.2, alpha=0.7, label="Pareto front")


def place_labels(axes: Any, points: Sequence[tuple[float, float]], labels: Sequence[str]) -> None:
    """Write each label beside its point where it covers the fewest other points and labels.

    Labels are placed in order, each at the best of twenty-two places round its marker.
    """
    from matplotlib.transforms import Bbox

    axes.figure.canvas.draw()  # the transform and text extents are known only after a layout pass
    renderer = axes.figure.canvas.get_renderer()
    pixels, frame = axes.transData.transform(np.reshape(points, (-1, 2))), axes.get_window_extent(renderer)
    taken: list[Any] = []
    for at, point, label in zip(pixels, points, labels, strict=True):
        note = axes.annotate(label, point, textcoords="offset pixels", xytext=(0, 0), fontsize=7.5, color="#333333")
        extent = note.get_window_extent(renderer)

        def cost(corner: tuple[float, float], at: Any = at, extent: Any = extent) -> float:
            """Return how many markers and labels a label here would cover; staying within the axes counts most."""
            box = Bbox.from_bounds(at[0] + corner[0], at[1] + corner[1], extent.width, extent.height)
            covered = 2.0 * box.padded(6).count_contains(pixels)
            common = (Bbox.intersection(box.padded(3, 1), other) for other in taken)
            covered += sum(3.0 * b.width * b.height for b in common if b) / (box.width * box.height)
            outside = box.x0 < frame.x0 or box.y0 < frame.y0 or box.x1 > frame.x1 or box.y1 > frame.y1
            return float(covered + 100.0 * outside + 0.002 * abs(corner[1]))

        best = min(_corners(extent.width, extent.height), key=cost)
        note.set_position(best)
        note.set(ha="left", va="bottom")
        taken.append(Bbox.from_bounds(at[0] + best[0], at[1] + best[1], extent.width, extent.height))


def _corners(width: float, height: float) -> list[tuple[float, float]]:
    """Return offsets in pixels from a point to the lower left corner of its label, nearest first."""
    corners = []
    for gap in (9.0, 20.0):
        rows = (-height / 2, gap / 2, -height - gap / 2)
        corners += [(gap, row) for row in rows] + [(-width - gap, row) for row in rows]
        corners += [(-width / 2, gap), (-width / 2, -height - gap)]
    return corners


_DECADES = 3  # decades on a scale of errors


def error_scale(maps: Iterable[ArrayLike], counted: float) -> tuple[float, float]:
    """Return the ends of the logarithmic scale that maps of errors share, rounded up.

    It has three decades, up to the counted percentile of the map with the largest errors; the maximum would be a
    firefly's.
    """
    finite = [m[np.isfinite(m)] for m in map(np.asarray, maps)]
    high = rounded_up(max((float(np.percentile(m, counted)) for m in finite if m.size), default=0.0))
    return high / 10**_DECADES, high


def log_norm(low: float, high: float) -> Any:
    """Return matplotlib's logarithmic scale of colours."""
    from matplotlib.colors import LogNorm

    return LogNorm(low, high, clip=False)


def rounded_up(value: float) -> float:
    """Return the least of 1, 2 and 5 times powers of ten that is at least `value`; 1 for a value of 0 or less."""
    if value <= 0:
        return 1.0
    power = 10.0 ** math.floor(math.log10(value))
    return next(step * power for step in (1, 2, 5, 10) if step * power >= value * (1 - 1e-9))


def illumination_plot(
    curves: Mapping[str, Illumination], path: str | Path, title: str = "Relative illumination"
) -> Path:
    """Draw relative illumination over film radius: the exact lens as a line, models dashed on it, differences below.

    Args:
        curves: of models by name, all against the same exact lens.
        path: PNG, PDF or SVG to write.
    Raises:
        InputError: there is no model, or values are not finite.
    """
    if not curves or not all(np.isfinite([c.exact, c.model]).all() for c in curves.values()):
        raise InputError("illumination plot", "curves", f"({', '.join(curves) or 'none'})", "finite values of a model")
    first = next(iter(curves.values()))
    radius, exact = first.film_radius_mm, np.asarray(first.exact)
    with drawing(path, 7.6, 5.4) as figure:
        upper, lower = figure.subplots(2, 1, sharex=True, gridspec_kw={"height_ratios": (3, 1.2)})
        upper.plot(radius, exact, color=INK, lw=2.6, alpha=0.45, label="exact")
        for k, (name, curve) in enumerate(curves.items()):
            colour, values = FIELD_COLOURS[k % len(FIELD_COLOURS)], np.asarray(curve.model)
            upper.plot(radius, values, color=colour, lw=1.4, ls=(0, (4, 2 + k)), label=name)
            lower.plot(radius, 100 * (values - exact), color=colour, lw=1.4, marker=".", ms=4)
        upper.set_ylim(0, 1.04 * max(1.0, *first.exact, *(v for c in curves.values() for v in c.model)))
        upper.set_ylabel("illumination (share of the axis)")
        upper.set_title(title, loc="left", fontweight="bold")
        upper.legend(loc="lower left")
        lower.axhline(0, color=INK, lw=0.9)
        lower.set_ylabel("model - exact\n(% of the axis)")
        lower.set_xlabel("film radius (mm)")
        for axes in (upper, lower):
            axes.grid(True)
    return Path(path)


AXIS_LABELS = {"zoom": "focal length (mm)", "focus": "1 / distance in focus (1/m)"}


def states_plot(models: Mapping[str, Sequence[Mapping[str, Any]]], axis: Axis, path: Path) -> None:
    """Draw film-equivalent RMS over the first state axis, and false passes and blocks below it.

    Args:
        models: name to rows of `check.errors_at`.
        axis: the first axis.
        path: PNG, PDF or SVG to write.
    """
    with drawing(path, 7.2, 5.6) as figure:
        top, bottom = figure.subplots(2, 1, sharex=True, height_ratios=(3, 2))
        for k, (name, rows) in enumerate(models.items()):
            colour = FIELD_COLOURS[k % len(FIELD_COLOURS)]
            error_line(top, axis, rows, colour, name)
            for key, mark in (("false_pass", "^"), ("false_block", "v")):
                x, share = [r[axis.name] for r in rows], [100 * (r[key] or 0.0) for r in rows]
                bottom.plot(x, share, mark, ms=4, color=colour, alpha=0.8, label=f"{name}: {key.replace('_', ' ')}")
        error_axes(top, axis, [r["rms_um"] for rows in models.values() for r in rows])
        top.set_title("One model of many states", loc="left", fontweight="bold")
        top.set_ylabel("film-equivalent RMS (um)")
        top.legend(loc="best", fontsize="small")
        bottom.set_ylabel("share of rays (%)")
        bottom.set_ylim(0, max(0.02, *bottom.get_ylim()))
        bottom.set_xlabel(AXIS_LABELS.get(axis.name, f"{axis.name} ({axis.unit})"))
        bottom.grid(True)
        bottom.legend(loc="best", fontsize="small")


def error_line(axes: Any, axis: Axis, rows: Sequence[Mapping[str, Any]], colour: str, label: str) -> None:
    """Draw film-equivalent RMS of rows over a state axis, joined by lines where no other axis varies."""
    ordered = sorted(rows, key=lambda r: r[axis.name])
    several = any(set(r) & set(AXIS_LABELS) - {axis.name} for r in rows)
    y = [r["rms_um"] or float("nan") for r in ordered]
    axes.plot([r[axis.name] for r in ordered], y, "o" if several else "o-", ms=4, color=colour, label=label)


def error_axes(axes: Any, axis: Axis, errors: Sequence[float | None]) -> None:
    """Set logarithmic axes of errors over a state axis, with its nodes marked."""
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
