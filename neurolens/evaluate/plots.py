"""Plots of error against time and against coefficients; colours of families, placement of labels."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from neurolens.analysis.plot_style import FAINT, INK, drawing, plain_log_ticks
from neurolens.base.errors import InputError
from neurolens.evaluate.pages import Record, number
from neurolens.evaluate.records import pareto_front

# Names and colours (Okabe and Ito's), distinguishable by colour-blind readers; black is kept for the exact tracer.
FAMILIES = {
    "paraxial": ("paraxial", "#7f7f7f"),
    "dense": ("dense", "#56b4e9"),
    "omp": ("OMP", "#e69f00"),
    "ols": ("orthogonal LS", "#0072b2"),
    "adaptive": ("adaptive", "#009e73"),
    "mlp": ("MLP", "#d55e00"),
}
OTHER_COLOUR = "#cc79a7"
_VARIABLES = ("raw", "invariants")


def family_colour(family: str | None) -> str:
    return FAMILIES.get(str(family), ("", OTHER_COLOUR))[1]


def place_labels(axes: Any, points: Sequence[tuple[float, float]], labels: Sequence[str], **text: Any) -> None:
    """Write each label beside its point where it covers the fewest other points and labels.

    Greedy: each label takes the best of twelve places round its marker, in pixels, after the labels before it.
    """
    axes.figure.canvas.draw()  # the transform and text extents are known only after a layout pass
    renderer = axes.figure.canvas.get_renderer()
    pixels = [tuple(axes.transData.transform(point)) for point in points]
    frame = axes.get_window_extent(renderer)
    taken: list[tuple[float, float, float, float]] = []
    for (x, y), point, label in zip(pixels, points, labels, strict=True):
        note = axes.annotate(label, point, textcoords="offset pixels", xytext=(0, 0), **text)
        box = note.get_window_extent(renderer)
        best = min(
            _places(box.width, box.height),
            key=lambda d: _cost((x + d[0], y + d[1], box.width, box.height), pixels, taken, frame) + 0.002 * abs(d[1]),
        )
        note.set_position(best)
        note.set(ha="left", va="bottom")
        taken.append((x + best[0], y + best[1], box.width, box.height))


def _places(width: float, height: float) -> list[tuple[float, float]]:
    """Offsets in pixels from a point to the lower left corner of its label, nearest first."""
    places = []
    for gap in (9.0, 20.0):
        rows = (-height / 2, gap / 2, -height - gap / 2)
        places += [(gap, row) for row in rows] + [(-width - gap, row) for row in rows]
        places += [(-width / 2, gap), (-width / 2, -height - gap)]
    return places


def _cost(box: tuple[float, float, float, float], points: Sequence[Any], taken: Sequence[Any], frame: Any) -> float:
    """Cost of a label's place: markers covered, label area overlapped, and most of all leaving the axes."""
    x, y, w, h = box
    cost = sum(2.0 for px, py in points if x - 6 < px < x + w + 6 and y - 6 < py < y + h + 6)
    for x2, y2, w2, h2 in taken:
        across, along = min(x + w, x2 + w2) - max(x, x2), min(y + h, y2 + h2) - max(y, y2)
        cost += 3.0 * max(0.0, across + 3) * max(0.0, along + 1) / (w * h)
    if x < frame.x0 or y < frame.y0 or x + w > frame.x1 or y + h > frame.y1:
        cost += 100.0
    return cost


ERROR_LABELS = {
    "rms_um": "film-equivalent error, RMS (µm)",
    "p99_um": "film-equivalent error, 99th percentile (µm)",
    "max_um": "film-equivalent error, maximum (µm)",
    "rms_px": "film-equivalent error, RMS (pixels)",
    "direction_rms_deg": "direction error, RMS (degrees)",
    "position_rms_um": "position error, RMS (µm)",
}
_MARKERS = {"raw": "s", "invariants": "o"}
_BAND = 0.11  # share of the axes' height that the band of exact tracers takes, below the smallest error


def pareto_plot(
    records: Sequence[Record],
    path: str | Path,
    exact: Sequence[Record] = (),
    error: str = "rms_um",
    title: str = "Error against speed",
) -> Path:
    """Error against ns per ray, both logarithmic: a marker for each model, the Pareto front, the exact tracers.

    Models sit at the minimum of their time, with a whisker to the median. An exact tracer, without error, has no place
    on a log axis: it is shown in a band below, with a line up to show which models are faster. Numbers beside the
    markers are coefficients per vector output.

    Args:
        records: `records.Results.models`; those with no time or no error are left out, and their number is stated.
        path: PNG, PDF or SVG to write.
        exact: `records.ExactRecord`s; the reason is shown for one that is not available.
        error: the key on the y axis, of ERROR_LABELS.
    Raises:
        InputError: an error key not known; no model has both figures.
    """
    shown = _with_numbers(records, error, "ns_per_ray.min")
    points = [(_get(r, "ns_per_ray.min"), _get(r, error)) for r in shown]
    with drawing(path, 9.6, 5.8) as figure:
        axes = figure.add_subplot()
        axes.set(xscale="log", yscale="log", xlabel=_time_label([*shown, *exact]), ylabel=ERROR_LABELS[error])
        _plot_models(axes, shown, points)
        times = [t for t in map(_exact_time, exact) if t]
        _set_limits(axes, [p[0] for p in points] + times, [p[1] for p in points], room=2.2 if times else 1.0)
        _plot_front(axes, points, times)
        axes.grid(True, which="major")
        plain_log_ticks(axes.xaxis, axes.yaxis)
        _plot_exact(axes, exact)
        _finish(axes, title, len(records) - len(shown), "without a time or an error")
        counts = [number(r, "coefficients_per_vector") for r in shown]
        labels = [f"{n:.0f}" if n else str(r.get("name", "")) for n, r in zip(counts, shown, strict=True)]
        place_labels(axes, points, labels, fontsize=7.6, color="#333333")
    return Path(path)


def error_against_coefficients_plot(
    records: Sequence[Record],
    path: str | Path,
    error: str = "rms_um",
    title: str = "Error against coefficients",
) -> Path:
    """Error (log) against coefficients per vector output, a line for each family; models without such a count across.

    Args:
        records: `records.Results.models`; an MLP and the paraxial map count no coefficients: a dotted line each.
        path: PNG, PDF or SVG to write.
        error: the key on the y axis, of ERROR_LABELS.
    Raises:
        InputError: an error key not known; no model has an error.
    """
    shown = _with_numbers(records, error)
    counted = [r for r in shown if number(r, "coefficients_per_vector")]
    with drawing(path, 9.6, 5.4) as figure:
        axes = figure.add_subplot()
        axes.set(yscale="log", xlabel="coefficients per vector output (count)", ylabel=ERROR_LABELS[error])
        points = [(_get(r, "coefficients_per_vector"), _get(r, error)) for r in counted]
        _plot_models(axes, counted, points)
        axes.set_xlim(0, 1.05 * max([p[0] for p in points], default=1.0))
        _set_limits(axes, (), [_get(r, error) for r in shown], band=0.02)
        lines = [r for r in shown if not number(r, "coefficients_per_vector")]
        _plot_lines_across(axes, lines, error)
        axes.grid(True, which="major")
        plain_log_ticks(axes.yaxis)
        _finish(axes, title, len(records) - len(shown), "without an error")
    return Path(path)


def _get(record: Record, key: str) -> float:
    value = number(record, key)
    assert value is not None  # callers keep only records with this key
    return value


def _with_numbers(records: Sequence[Record], error: str, *keys: str) -> list[Record]:
    """The records with a positive number at `error` and at each of `keys`, as log axes require."""
    if error not in ERROR_LABELS:
        raise InputError("plot", "error", error, "one of " + ", ".join(ERROR_LABELS))
    kept = [r for r in records if all((number(r, key) or 0) > 0 for key in (error, *keys))]
    if not kept:
        raise InputError("plot", "models", f"({len(records)} models)", f"one with {', '.join((error, *keys))}")
    return kept


def _series(records: Sequence[Record]) -> list[tuple[str, str, list[int]]]:
    """(family, variables, indices) in the order of FAMILIES and _VARIABLES; unknown families come last."""
    found = {(str(r.get("family")), str(r.get("variables"))) for r in records}

    def rank(key: tuple[str, str]) -> tuple[Any, ...]:
        places = ((*known, name).index(name) for name, known in zip(key, (FAMILIES, _VARIABLES), strict=True))
        return *places, key

    def members(key: tuple[str, str]) -> list[int]:
        return [i for i, r in enumerate(records) if (str(r.get("family")), str(r.get("variables"))) == key]

    return [(*key, members(key)) for key in sorted(found, key=rank)]


def _plot_models(axes: Any, records: Sequence[Record], points: Sequence[tuple[float, float]]) -> None:
    """A faint line through each family's models, their markers, and a whisker from the least to the median time."""
    for family, variables, members in _series(records):
        colour = family_colour(family)
        line = sorted(points[i] for i in members)
        axes.plot(*zip(*line, strict=True), color=colour, lw=1, alpha=0.35, zorder=2)
        fill = colour if variables != "raw" else "white"
        name = FAMILIES.get(family, (family,))[0] + (f", {variables}" if variables in _VARIABLES else "")
        look = {"ms": 7, "mfc": fill, "mec": colour, "mew": 1.5, "ls": "none", "zorder": 3, "label": name}
        axes.plot(*zip(*line, strict=True), _MARKERS.get(variables, "D"), **look)
        for i in members:
            median = number(records[i], "ns_per_ray.median")
            if axes.get_xscale() == "log" and median:
                axes.plot([points[i][0], median], [points[i][1]] * 2, color=colour, lw=1.2, alpha=0.5, zorder=2)


def _plot_front(axes: Any, points: Sequence[tuple[float, float]], exact_times: Sequence[float]) -> None:
    """The Pareto front as a staircase. The fastest exact tracer, without error, ends it at its time."""
    fastest = [(min(exact_times), 0.0)] if exact_times else []
    every = [*points, *fastest]
    front = [every[i] for i in pareto_front(every)]
    if fastest:  # no place for zero on a log axis: the last step goes down into the band
        low, high = axes.get_ylim()
        front[-1] = (front[-1][0], low * (high / low) ** (_BAND / 2))
    axes.step(*zip(*front, strict=True), where="post", color=INK, lw=1.3, alpha=0.75, zorder=1.5, label="Pareto front")


def _set_limits(axes: Any, xs: Sequence[float], ys: Sequence[float], band: float = _BAND, room: float = 1.0) -> None:
    """Equal margins on log axes; `band` of the height stays free below the smallest y, `room` at the right."""
    if xs:
        pad = max((max(xs) / min(xs)) ** 0.09, 1.25)
        axes.set_xlim(min(xs) / pad, max(xs) * pad**room * room**0.5)
    span = max(max(ys) / min(ys), 10.0)
    axes.set_ylim(min(ys) / span ** ((band + 0.06) / (1 - band)), max(ys) * span**0.08)


def _exact_time(record: Record) -> float | None:
    return number(record, "ns_per_ray.min") if record.get("available", True) else None


def _plot_exact(axes: Any, exact: Sequence[Record]) -> None:
    """The band of tracers without error, a line up from each, and a shade where models are slower than the fastest."""
    if not exact:
        return
    from matplotlib.patches import Rectangle

    across = axes.get_xaxis_transform()  # x in data, y in shares of the axes
    axes.add_patch(Rectangle((0, 0), 1, _BAND, transform=axes.transAxes, fc="#eceef1", lw=0, zorder=0.5))
    missing = [str(r["name"]) + f": unavailable ({r.get('reason') or '–'})" for r in exact if not _exact_time(r)]
    words = "\n".join(["exact (no error)", *missing])
    axes.text(0.008, 0.82 * _BAND, words, transform=axes.transAxes, va="center", fontsize=8.2, color="#555b63")
    low, high = axes.get_ylim()
    for minor in (False, True):  # no ticks beside the band
        above = [t for t in axes.get_yticks(minor=minor) if low * (high / low) ** _BAND < t < high]
        axes.set_yticks(above, minor=minor)
    timed = sorted((t, str(r["name"])) for r in exact if (t := _exact_time(r)))
    if timed:
        axes.axvspan(timed[0][0], axes.get_xlim()[1], color="#000000", alpha=0.035, lw=0, zorder=0)
    for index, (time, name) in enumerate(timed):
        height = _BAND * (0.5 if len(timed) < 3 else (0.3, 0.7)[index % 2])
        axes.axvline(time, color=INK, lw=0.9, ls=(0, (4, 3)), alpha=0.55, zorder=1)
        axes.plot([time], [height], "*", ms=12, color=INK, transform=across, zorder=4, clip_on=False)
        # The fastest of two close tracers is labelled to its left, so that both stay readable.
        side = -1 if index == 0 and len(timed) > 1 and timed[1][0] < 2 * time else 1
        axes.annotate(
            f"{name} {time:.3g} ns", (time, height), xycoords=across, xytext=(9 * side, 0), fontsize=8.4,
            textcoords="offset points", va="center", ha="right" if side < 0 else "left", zorder=5,
        )  # fmt: skip


def _plot_lines_across(axes: Any, records: Sequence[Record], error: str) -> None:
    """Models that count no coefficients: a dotted line at their error with its name, offset for close lines."""
    low, high = axes.get_ylim()
    last, shift = 0.0, 0
    for record in sorted(records, key=lambda r: _get(r, error)):
        y, colour = _get(record, error), family_colour(record.get("family"))
        axes.axhline(y, color=colour, lw=1.3, ls=(0, (1, 2)), zorder=1.5)
        shift = (shift + 1) % 3 if y < last * (high / low) ** 0.045 else 0
        last = y
        axes.annotate(
            str(record.get("name", "")), (0, y), xycoords=axes.get_yaxis_transform(), xytext=(6 + 78 * shift, 0),
            textcoords="offset points", va="center", fontsize=8.2, color=colour, zorder=2.5,
            bbox={"fc": "white", "ec": "none", "pad": 1.2},
        )  # fmt: skip


def _time_label(records: Sequence[Record]) -> str:
    threads = {int(t) for r in records if (t := number(r, "ns_per_ray.threads"))}
    count = threads.pop() if len(threads) == 1 else 0
    stated = f"; {count} thread{'s' if count > 1 else ''}" if count else ""
    return f"time per ray (ns, least of the repeats; whisker to the median{stated})"


def _finish(axes: Any, title: str, left_out: int, why: str) -> None:
    axes.set_title(title, loc="left", fontweight="bold")
    axes.figure.legend(loc="outside right upper")
    if left_out:
        text = f"{left_out} model{'s' if left_out > 1 else ''} {why} not shown"
        axes.text(1, 1.012, text, transform=axes.transAxes, ha="right", fontsize=8, color=FAINT)
