"""Error against time and against size, in one picture; colours of families, placement of labels."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from neurolens.analysis.plot_style import INK, drawing, plain_log_ticks
from neurolens.base.records import NOISY, noisy, pareto_front, time_of
from neurolens.study.advice import said_ns
from neurolens.study.pages import Record, number

# Names, Okabe and Ito's colours, and markers, which tell kinds apart without colours; black is the exact tracer's.
Kinds = Mapping[str, tuple[str, str, str]]
FAMILIES: Kinds = {
    "paraxial": ("paraxial", "#7f7f7f", "D"),
    "dense": ("dense", "#56b4e9", "s"),
    "omp": ("OMP", "#e69f00", "s"),
    "ols": ("orthogonal LS", "#0072b2", "o"),
    "adaptive": ("adaptive", "#009e73", "s"),
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


def family_colour(family: str | None) -> str:
    return FAMILIES.get(str(family), _OTHER)[1]


def trade_plot(
    title: str,
    records: Sequence[Record],
    exact: Sequence[Record],
    path: Path,
    kinds: Kinds = FAMILIES,
    kind: str = "family",
    use: str | None = None,
) -> bool:
    """Draw error against time (hollow: as C) and against size, logarithmic; returns whether there was anything to draw.

    Exact tracers, which have no error, are lines at their time. The staircase is the front that nothing betters. From a
    noisy time (`records.noisy`) a line leads to the median of its rounds. A ring marks what is advised, at the time
    that the advice states.

    Args:
        records: of models by `name`, with errors, ns_per_ray, fused_ns_per_ray, coefficients_per_vector, parameters.
            Those without an error, time or size are left out.
        exact: `records.ExactRecord`s.
        path: PNG, PDF or SVG to write.
        kinds: name, colour and marker of each value that `kind` has in the records.
        use: name of the model, or of the exact tracer, that is advised.
    """
    error = next((k for k in _ERRORS if any((number(r, k) or 0) > 0 for r in records)), None)
    if error is None:
        return False
    shown = [r for r in records if (number(r, error) or 0) > 0]
    times = [*_points(shown, "ns_per_ray.min", error), *_points(shown, "fused_ns_per_ray.min", error)]
    sizes = _points(shown, "coefficients_per_vector", error)
    sizes += [p for p in _points(shown, "parameters", error) if number(p[2], "coefficients_per_vector") is None]
    with drawing(path, 13.0, 5.8) as figure:
        left, right = figure.subplots(1, 2, sharey=True)
        _panel(left, times, "time per ray (ns, best of the rounds)", kinds, kind)
        _spread(left, shown, error)
        for one in exact:
            time = number(one, "ns_per_ray.min")
            if time:
                look = {"color": INK, "lw": 1.0, "ls": "--" if "compiled" in one["name"] else ":"}
                look |= {"color": CHOSEN, "lw": 2.0} if one["name"] == use else {}
                said = f"{one['name']} {said_ns(time_of(one))}" + ": use" * (one["name"] == use)
                left.axvline(time, label=said, **look)
        advised = [(x, number(r, error)) for r in shown if r["name"] == use and (x := number(time_of(r), "min"))]
        if advised:
            left.plot(*advised[0], "o", label=f"use {use}", **_RING)
        _panel(right, sizes, "coefficients of one vector output (networks: all weights)", kinds, kind)
        left.set_ylabel(_ERRORS[error])
        plain_log_ticks(left.yaxis)
        figure.suptitle(f"{title}: error against time and size", x=0.01, ha="left", fontweight="bold")
        found = [axes.get_legend_handles_labels() for axes in (left, right)]
        handles = {label: h for each in found for h, label in zip(*each, strict=True)}
        figure.legend(handles.values(), handles.keys(), loc="outside right upper")
        for axes, points in ((left, times), (right, sizes)):
            plain_log_ticks(axes.xaxis)
            axes.grid(True, which="major")
            if points:
                place_labels(axes, [p[:2] for p in points], [str(p[2]["name"]) for p in points])
    return True


def _spread(axes: Any, records: Sequence[Record], error: str) -> None:
    """Lines from noisy times to the medians of their rounds."""
    lines = [
        (number(record, error), timing["min"], timing["median"])
        for record in records
        for timing in (record.get("ns_per_ray"), record.get("fused_ns_per_ray"))
        if timing is not None and noisy(timing)
    ]
    noisy_lines(axes, lines)


def noisy_lines(axes: Any, lines: Sequence[tuple[Any, float, float]]) -> None:
    """Lines at heights from the least of a noisy time to its median."""
    if lines:
        label = f"noisy: to the median, over {NOISY:g} times the least"
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

    Greedy: each label takes the best of twelve places round its marker, in pixels, after the labels before it.
    """
    axes.figure.canvas.draw()  # the transform and text extents are known only after a layout pass
    renderer = axes.figure.canvas.get_renderer()
    pixels = [tuple(axes.transData.transform(point)) for point in points]
    frame = axes.get_window_extent(renderer)
    taken: list[tuple[float, float, float, float]] = []
    for (x, y), point, label in zip(pixels, points, labels, strict=True):
        note = axes.annotate(label, point, textcoords="offset pixels", xytext=(0, 0), fontsize=6.4, color="#333333")
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
