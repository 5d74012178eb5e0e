"""The tracer's speed and memory as a page in Markdown and as JSON."""

from __future__ import annotations

import json
import os
import platform
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy
import torch

from neurolens import __version__
from neurolens.base.files import atomic_write_text
from neurolens.evaluate.benches.trace_speed import goals

NOTES = """\
Rays made beforehand: film points over the image circle, aimed at the rear rim, 400 to 700 nm, a wavelength each;
blocked rays are traced like the others. Stop, every rim, total reflection and dispersion; no transmittance. Best and
median of {rounds} rounds in turn (A B .. B A), each the best of a few short samples; more threads than one share out
batches. A refraction is a surface at which the medium changes."""


@dataclass
class Found:
    """What has been measured so far.

    Attributes:
        rows: of `trace_speed.time_lens`.
        memory: of `trace_memory.memory_of`.
        missing: lenses without a file, and what could not be measured, in words.
    """

    rounds: int
    rows: list[dict[str, Any]] = field(default_factory=list)
    memory: list[dict[str, Any]] = field(default_factory=list)
    missing: list[str] = field(default_factory=list)


def write(found: Found, folder: Path) -> None:
    """Write trace_speed.md and trace_speed.json, each whole or not at all."""
    folder.mkdir(parents=True, exist_ok=True)
    data = {
        "machine": machine(),
        "rounds": found.rounds,
        "rows": found.rows,
        "memory": found.memory,
        "goals": [asdict(g) | {"verdict": g.verdict} for g in goals(found.rows)],
        "missing": found.missing,
    }
    atomic_write_text(folder / "trace_speed.json", json.dumps(data, indent=1) + "\n")
    atomic_write_text(folder / "trace_speed.md", page(found))


def page(found: Found) -> str:
    """The whole page."""
    parts = ["# The exact tracer", "`neurolens bench trace`", _conditions(found)]
    parts += [goal_table(found.rows), speed_table(found.rows)]
    if found.memory:
        parts.append(memory_table(found.memory))
    if found.missing:
        parts.append("Not measured: " + "; ".join(found.missing) + ".")
    return "\n\n".join(parts) + "\n"


def machine() -> dict[str, Any]:
    """Processor, cores and versions."""
    return {
        "processor": _processor(),
        "cores": os.cpu_count(),
        "python": platform.python_version(),
        "torch": torch.__version__,
        "numpy": numpy.__version__,
        "neurolens": __version__,
        "vectors": torch.backends.cpu.get_cpu_capability(),
    }


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        lines = []
    named = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return named[0] if named else platform.processor() or platform.machine()


def _conditions(found: Found) -> str:
    m = machine()
    loads = [v for row in found.rows for v in row["load"] if v is not None]
    busy = f" Load average meanwhile up to {max(loads):.1f}." if loads else ""
    return (
        NOTES.format(rounds=found.rounds)
        + f"\n\n{m['processor']}, {m['cores']} cores, {m['vectors']}; Python {m['python']}, torch {m['torch']}.{busy}"
    )


def goal_table(rows: Sequence[dict[str, Any]]) -> str:
    """The goals, and whether they are reached."""
    lines = ["| goal (12 refractions, float32, one thread) | wanted | measured | |", "|---|---|---|---|"]
    for g in goals(rows):
        bound = "at least" if g.at_least else "at most"
        measured = "" if g.measured is None else f"{g.measured:.3g}"
        lines.append(f"| {g.text} | {bound} {g.wanted:g} | {measured} | {g.verdict} |")
    return "\n".join(lines)


def speed_table(rows: Sequence[dict[str, Any]]) -> str:
    """One line a lens and thread count; Mray/s by the best time (by the median)."""
    kinds = [(kind, dtype) for dtype in ("float32", "float64") for kind in ("eager", "compiled")]
    kinds = [k for k in kinds if any((r["kind"], r["dtype"]) == k for r in rows)]
    columns = ["lens", "refractions", "aspheres", "cylinders", "threads", *(f"{k} {d}, Mray/s" for k, d in kinds), ""]
    lines = ["| " + " | ".join(columns) + " |", "|---" * len(columns) + "|"]
    groups: dict[tuple[Any, ...], dict[tuple[str, str], dict[str, Any]]] = {}
    for r in rows:
        key = (r["lens"], r["refractions"], r["aspheres"], r["cylinders"], r["threads"])
        groups.setdefault(key, {})[r["kind"], r["dtype"]] = r
    for key, cells in groups.items():
        ratios = [f"{k} {cells[k, d]['over_spheres']['min']:.2f}" for k, d in kinds if _ratio(cells.get((k, d)))]
        note = f"times as long as spheres: {', '.join(ratios)}" if ratios else ""
        shown = [_speed(cells.get(k)) for k in kinds]
        lines.append("| " + " | ".join([*map(str, key), *shown, note]) + " |")
    return "\n".join(lines)


def _ratio(row: dict[str, Any] | None) -> bool:
    return row is not None and row.get("over_spheres") is not None


def _speed(row: dict[str, Any] | None) -> str:
    if row is None or "ns_min" not in row:
        return row["reason"] or "" if row is not None else ""
    return f"{1000 / row['ns_min']:.2f} ({1000 / row['ns_median']:.2f})"


def memory_table(memory: Sequence[dict[str, Any]]) -> str:
    """Memory beyond rays and results."""
    lines = [
        "Memory of one call of `trace` (12 refractions, float32, one thread), each size in a process of its own:",
        "",
        "| rays | results, MB | growth of resident memory, MB | tracing itself, MB |",
        "|---|---|---|---|",
    ]
    for m in memory:
        lines.append(f"| {m['rays']:,} | {m['results_mb']:.1f} | {m['growth_mb']:.1f} | {m['working_mb']:.1f} |")
    return "\n".join(lines)
