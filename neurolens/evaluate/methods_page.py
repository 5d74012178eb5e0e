"""The benchmark of surrogates as pages: a table and a plot for each lens, and the median and worst lens by method."""

from __future__ import annotations

import statistics
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from neurolens.analysis.plot_style import INK, new_figure, plain_log_ticks, save, style
from neurolens.base.files import atomic_write_text
from neurolens.evaluate.methods import GROUPS
from neurolens.evaluate.pages import DASH, Column, Record, markdown_table, number, show
from neurolens.evaluate.plots import place_labels
from neurolens.evaluate.records import pareto_front
from neurolens.surrogates.source import MOST_WEIGHTS

COLUMNS = (
    Column("RMS um", "rms_um_at_21_6"),
    Column("p99 um", "p99_um_at_21_6"),
    Column("max um", "max_um_at_21_6"),
    Column("RMS px", "rms_px"),
    Column("p99 px", "p99_px"),
    Column("max px", "max_px"),
    Column("direction deg", "direction_rms_deg"),
    Column("position um", "position_rms_um_at_21_6"),
    Column("T RMS", "transmittance_rms", digits=2),
    Column("false pass %", "false_pass", 100, 2),
    Column("2 stops", "stopped_down.2_stops.false_pass", 100, 2),
    Column("4 stops", "stopped_down.4_stops.false_pass", 100, 2),
    Column("false block %", "false_block", 100, 2),
    Column("2 stops", "stopped_down.2_stops.false_block", 100, 2),
    Column("4 stops", "stopped_down.4_stops.false_block", 100, 2),
    Column("coefficients", "coefficients_per_vector", digits=4),
    Column("all", "parameters", digits=6),
    Column("bytes", "bytes", digits=7),
    Column("fit s", "fit_s", digits=2),
    Column("ns/ray", "ns_per_ray.min"),
    Column("fused ns/ray", "fused_ns_per_ray.min"),
    Column("speed-up", "speedup", digits=2),
    Column("fused", "fused_speedup", digits=2),
    Column("break-even Mray", "break_even_rays", 1e-6, 2),
    Column("fused", "fused_break_even_rays", 1e-6, 2),
)
# Figures of the overall page; larger is better for the speed-ups, smaller for the others.
SUMMED = tuple(
    c for c in COLUMNS if c.key in
    "rms_um_at_21_6 direction_rms_deg position_rms_um_at_21_6 transmittance_rms false_pass false_block "
    "coefficients_per_vector fit_s ns_per_ray.min fused_ns_per_ray.min speedup fused_speedup".split()
)  # fmt: skip
_OF_A_LENS = tuple(
    Column(c.heading, c.key, c.factor, 2) for c in SUMMED if c.key in
    "rms_um_at_21_6 direction_rms_deg position_rms_um_at_21_6 transmittance_rms false_pass false_block".split()
)  # fmt: skip
_WORST: dict[str, Callable[[Sequence[float]], float]] = {"speedup": min, "fused_speedup": min}

NOTES = (
    "Errors on held-out rays at full aperture, as `neurolens.evaluate.rays` defines them, of the exported float32 "
    "graph (in float64 where a method has no graph). Micrometres are film-equivalent and at an image radius of 21.6 "
    "mm, the position's at the front surface likewise; pixels are the frame's width over 4000. False pass: blocked "
    "rays over rays that the model passes; false block: lost rays over rays that the lens passes. Coefficients: of "
    "one vector output (A and B, or all scalars of it); all: rims, stop and transmittance included, weights of "
    "networks. Times in float32, stop, rims and transmittance included; speed-ups over the fastest exact tracer "
    "doing the same work in the same race. Break-even: rays after which fitting and loading have paid for themselves "
    "against it."
)


def lens_page(name: str, records: Sequence[Record], facts: str) -> str:
    """The table of one lens, group by group."""
    rows = []
    for record in _ordered(records):
        cells = [c.cell(record) for c in COLUMNS] if not record["failed"] else [""] * len(COLUMNS)
        if record["failed"]:
            cells[0] = f"failed: {_cell(record['failed'])}"
        rows.append([record["method"], *cells])
    for exact in _exact(records):
        time = number(exact, "ns_per_ray.min")
        cells = [DASH if c.key != "ns_per_ray.min" or time is None else show(time, 3) for c in COLUMNS]
        rows.append([exact["name"], *cells])
    lines = markdown_table(["method", *(c.heading for c in COLUMNS)], rows)
    apart = [f"- {r['method']} has no graph: {r['not_exported']}" for r in records if r["not_exported"]]
    for record in records:
        time, weights = number(record, "ns_per_ray.min"), number(record, "parameters") or 0
        if time and number(record, "fused_ns_per_ray.min") is None and weights > MOST_WEIGHTS:
            apart.append(
                f"- {record['method']} is not written as C: so many weights are products of matrices by blocks of "
                f"rays, which onnxruntime does at {2 * weights / time:.0f} Gflop/s here."
            )
    return "\n".join([f"# {name}", "", facts, "", *lines, *([""] if apart else []), *apart, ""])


def summary_page(found: Mapping[str, Sequence[Record]], facts: str) -> str:
    """Median and worst lens of every method, then lens by lens."""
    every = [r for records in found.values() for r in records]
    methods = {r["method"]: r for r in _ordered(every)}
    cells = []
    for method in methods:
        rows = [r for r in every if r["method"] == method]
        good = [r for r in rows if not r["failed"]]
        count = f"{len(good)}" if len(good) == len(rows) else f"{len(good)} of {len(rows)}"
        cells.append([method, count, *(_median_and_worst(c, good) for c in SUMMED)])
    lines = markdown_table(["method", "lenses", *(c.heading for c in SUMMED)], cells)
    failures = [f"- {r['method']}, {r['lens']}: {_cell(r['failed'])}" for r in every if r["failed"]]
    sources = {r["method"]: r["source"] for r in methods.values() if r["source"]}
    parts = ["# Surrogates over lenses", "", facts, "", "Each cell: median, then worst lens.", "", *lines]
    figures = " / ".join(c.heading for c in _OF_A_LENS)
    parts += ["", "## By lens", "", f"{figures}.", "", *_by_lens(found, list(methods))]
    parts += ["", "## What failed", "", *failures] if failures else []
    parts += ["", "## Sources", "", *(f"- {m}: {s}" for m, s in sources.items())] if sources else []
    return "\n".join([*parts, ""])


def write_lens(name: str, records: Sequence[Record], facts: str, folder: Path) -> None:
    """NAME.md and, where a method has errors, NAME.png."""
    folder.mkdir(parents=True, exist_ok=True)
    text = lens_page(name, records, facts)
    if trade_plot(name, records, _exact(records), folder / f"{name}.png"):
        text += f"\n![Error against time and against coefficients]({name}.png)\n"
    atomic_write_text(folder / f"{name}.md", text)


def _ordered(records: Sequence[Record]) -> list[Record]:
    return sorted(records, key=lambda r: list(GROUPS).index(r["group"]))


def _exact(records: Sequence[Record]) -> list[Record]:
    """The exact tracers of the last race."""
    return next((list(r["exact"]) for r in records if r.get("exact")), [])


def _median_and_worst(column: Column, records: Sequence[Record]) -> str:
    values = [v for r in records if (v := number(r, column.key)) is not None]
    if not values:
        return DASH
    worst = _WORST.get(column.key, max)(values)
    median = statistics.median(values)
    return f"{show(column.factor * median, column.digits)}, {show(column.factor * worst, column.digits)}"


def _by_lens(found: Mapping[str, Sequence[Record]], methods: Sequence[str]) -> list[str]:
    """Every lens by every method, the worst of the first method first."""
    rows = {lens: {r["method"]: r for r in records if not r["failed"]} for lens, records in found.items()}

    def worst(lens: str) -> float:
        first = rows[lens].get(methods[0]) if methods else None
        return -((number(first, "direction_rms_deg") if first else None) or 0.0)

    def cell(record: Record | None) -> str:
        return DASH if record is None else " / ".join(c.cell(record) for c in _OF_A_LENS)

    lines = ([lens, *(cell(rows[lens].get(m)) for m in methods)] for lens in sorted(rows, key=worst))
    return markdown_table(["lens", *methods], lines)


def _cell(text: str) -> str:
    return text.replace("|", "/")


_LOOK = {  # Okabe and Ito's colours; marker shapes distinguish the groups without them
    "paraxial": ("#7f7f7f", "D"),
    "published": ("#e69f00", "s"),
    "ours": ("#0072b2", "o"),
    "ablations": ("#cc79a7", "^"),
}
_ERRORS = {
    "rms_um_at_21_6": "film-equivalent error, RMS (µm at 21.6 mm image radius)",
    "direction_rms_deg": "direction error, RMS (degrees)",
}


def trade_plot(name: str, records: Sequence[Record], exact: Sequence[Record], path: Path) -> bool:
    """Draw both panels, logarithmic; hollow markers are fused C. Returns whether there was anything to draw.

    Exact tracers, which have no error, are lines at their time. The staircase is the front that nothing betters.
    """
    error = next((k for k in _ERRORS if any((number(r, k) or 0) > 0 for r in records)), None)
    if error is None:
        return False
    shown = [r for r in records if (number(r, error) or 0) > 0]
    with style():
        figure = new_figure(13.0, 5.8)
        left, right = figure.subplots(1, 2, sharey=True)
        times = [*_points(shown, "ns_per_ray.min", error), *_points(shown, "fused_ns_per_ray.min", error)]
        _panel(left, times, "time per ray (ns, one thread, best of the rounds)")
        for one in exact:
            time = number(one, "ns_per_ray.min")
            if time:
                look = {"color": INK, "lw": 1.0, "ls": "--" if "compiled" in one["name"] else ":"}
                left.axvline(time, label=f"{one['name']} {time:.3g} ns", **look)
        sizes = _points(shown, "coefficients_per_vector", error)
        sizes += [p for p in _points(shown, "parameters", error) if number(p[2], "coefficients_per_vector") is None]
        _panel(right, sizes, "coefficients of one vector output (networks: all weights)")
        left.set_ylabel(_ERRORS[error])
        plain_log_ticks(left.yaxis)
        for axes in (left, right):
            plain_log_ticks(axes.xaxis)
            axes.grid(True, which="major")
        figure.suptitle(f"{name}: error against time and size", x=0.01, ha="left", fontweight="bold")
        handles = {
            label: h for axes in (left, right) for h, label in zip(*axes.get_legend_handles_labels(), strict=True)
        }
        figure.legend(handles.values(), handles.keys(), loc="outside right upper")
        for axes, points in ((left, times), (right, sizes)):
            if points:
                labels = [str(p[2]["method"]) for p in points]
                place_labels(axes, [p[:2] for p in points], labels, fontsize=6.4, color="#333333")
        save(figure, path)
    return True


def _points(records: Sequence[Record], key: str, error: str) -> list[tuple[float, float, Record, bool]]:
    fused = key.startswith("fused")
    return [(x, number(r, error) or 0.0, r, fused) for r in records if (x := number(r, key) or 0.0) > 0]


def _panel(axes: Any, points: Sequence[tuple[float, float, Record, bool]], label: str) -> None:
    axes.set(xscale="log", yscale="log", xlabel=label)
    for group, (colour, marker) in _LOOK.items():
        for fused in (False, True):
            part = [p[:2] for p in points if p[2]["group"] == group and p[3] == fused]
            if part:
                look = {"mfc": "white" if fused else colour, "mec": colour, "ms": 6.5, "mew": 1.4, "ls": "none"}
                said = GROUPS[group] + (", fused C" if fused else "")
                axes.plot(*zip(*part, strict=True), marker, label=said, zorder=3, **look)
    if points:
        front = [points[i][:2] for i in pareto_front([p[:2] for p in points])]
        axes.step(*zip(*front, strict=True), where="post", color=INK, lw=1.2, alpha=0.7, label="Pareto front")
