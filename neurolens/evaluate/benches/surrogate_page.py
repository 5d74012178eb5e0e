"""The benchmark of surrogates as pages: a table and a plot for each lens, and the median and worst lens by method."""

from __future__ import annotations

import math
import statistics
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from neurolens.base.files import atomic_write_text
from neurolens.evaluate.benches.surrogate_methods import GROUPS
from neurolens.evaluate.plots.surrogates import trade_plot
from neurolens.evaluate.records import number

Record = Mapping[str, Any]


@dataclass(frozen=True)
class Column:
    """A figure of a record: its heading, its key (dots go into nested tables), a factor and significant digits."""

    heading: str
    key: str
    factor: float = 1.0
    digits: int = 3

    def cell(self, record: Record) -> str:
        if record.get(self.key) == "never":
            return "never"
        value = number(record, self.key)
        return "–" if value is None else _digits(value * self.factor, self.digits)


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
# Of the overall page: figures where smaller is better, and one where larger is.
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
    head = ["method", *(c.heading for c in COLUMNS)]
    lines = ["| " + " | ".join(head) + " |", "|---" * len(head) + "|"]
    for record in _ordered(records):
        if record["failed"]:
            lines.append(f"| {record['method']} | failed: {_cell(record['failed'])} |" + " |" * (len(head) - 2))
        else:
            lines.append("| " + " | ".join([record["method"], *(c.cell(record) for c in COLUMNS)]) + " |")
    for exact in _exact(records):
        time = number(exact, "ns_per_ray.min")
        cells = ["–" if c.key != "ns_per_ray.min" or time is None else _digits(time, 3) for c in COLUMNS]
        lines.append("| " + " | ".join([exact["name"], *cells]) + " |")
    apart = [f"- {r['method']} has no graph: {r['not_exported']}" for r in records if r["not_exported"]]
    return "\n".join([f"# {name}", "", facts, "", *lines, *([""] if apart else []), *apart, ""])


def summary_page(found: Mapping[str, Sequence[Record]], facts: str) -> str:
    """Median and worst lens of every method, then lens by lens."""
    every = [r for records in found.values() for r in records]
    methods = {r["method"]: r for r in _ordered(every)}
    head = ["method", "lenses", *(c.heading for c in SUMMED)]
    lines = ["| " + " | ".join(head) + " |", "|---" * len(head) + "|"]
    for method in methods:
        rows = [r for r in every if r["method"] == method]
        good = [r for r in rows if not r["failed"]]
        count = f"{len(good)}" if len(good) == len(rows) else f"{len(good)} of {len(rows)}"
        lines.append("| " + " | ".join([method, count, *(_median_and_worst(c, good) for c in SUMMED)]) + " |")
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
    """Group by group, in each as given."""
    return sorted(records, key=lambda r: list(GROUPS).index(r["group"]))


def _exact(records: Sequence[Record]) -> list[Record]:
    """The exact tracers of the last race."""
    return next((list(r["exact"]) for r in records if r.get("exact")), [])


def _median_and_worst(column: Column, records: Sequence[Record]) -> str:
    values = [v for r in records if (v := number(r, column.key)) is not None]
    if not values:
        return "–"
    worst = _WORST.get(column.key, max)(values)
    median = statistics.median(values)
    return f"{_digits(column.factor * median, column.digits)}, {_digits(column.factor * worst, column.digits)}"


def _by_lens(found: Mapping[str, Sequence[Record]], methods: Sequence[str]) -> list[str]:
    """Every lens by every method, the worst of the first method first."""
    lines = ["| lens | " + " | ".join(methods) + " |", "|---" * (len(methods) + 1) + "|"]
    rows = {lens: {r["method"]: r for r in records if not r["failed"]} for lens, records in found.items()}

    def worst(lens: str) -> float:
        first = rows[lens].get(methods[0]) if methods else None
        return -((number(first, "direction_rms_deg") if first else None) or 0.0)

    for lens in sorted(rows, key=worst):
        cells = [" / ".join(c.cell(rows[lens][m]) for c in _OF_A_LENS) if m in rows[lens] else "–" for m in methods]
        lines.append("| " + " | ".join([lens, *cells]) + " |")
    return lines


def _digits(value: float, digits: int) -> str:
    if value and not 1e-4 <= abs(value) < 1e7:
        return f"{value:.{max(digits - 1, 1)}e}" if math.isfinite(value) else str(value)
    return f"{value:.{digits}g}" if abs(value) < 10**digits else f"{value:.0f}"


def _cell(text: str) -> str:
    return text.replace("|", "/")
