"""Races as tables: rows with units in their keys, and the same in Markdown."""

from __future__ import annotations

import os
import platform
from collections.abc import Sequence
from typing import Any

import torch

from neurolens.evaluate.speed import Race

COMPILED, EAGER = "exact compiled", "exact eager"


def table_rows(state: str, timed: Race) -> list[dict[str, Any]]:
    """One row a candidate of a race.

    Returns: tables of lens (`state`), name, ns_per_ray, speedup_over_compiled and speedup_over_eager ({"min", "median"}
        as of `Race.speedup`; None where that tracer did not run), reason where unavailable, load of the machine.
        Where several exact tracers raced, each is held against those of its own kind.
    """
    rows: list[dict[str, Any]] = []
    for name in (*timed.ns, *timed.unavailable):
        own = name.rsplit(" ", 1)[0]
        compiled, eager = (n if n in timed.ns else f"{own} {n.split()[-1]}" for n in (COMPILED, EAGER))
        rows.append(
            {
                "lens": state,
                "name": name,
                "ns_per_ray": timed.timing(name),
                "speedup_over_compiled": timed.speedup(name, compiled),
                "speedup_over_eager": timed.speedup(name, eager),
                "reason": timed.unavailable.get(name),
                "load": [timed.load_before, timed.load_after],
            }
        )
    return rows


def markdown(title: str, notes: str, rows: Sequence[dict[str, Any]]) -> str:
    """A page with the rows as a table."""
    columns = "lens|candidate|ns per ray, best|median|Mray/s|batch|threads|over compiled|over eager".split("|")
    lines = ["| " + " | ".join(columns) + " |", "|---" * len(columns) + "|"]
    for row in rows:
        t = row["ns_per_ray"]
        if t is None:
            lines.append(f"| {row['lens']} | {row['name']} | unavailable: {row['reason']} | | | | | | |")
            continue
        figures = f"{t['min']:.1f} | {t['median']:.1f} | {1000 / t['min']:.1f} | {t['batch']} | {t['threads']}"
        ratios = " | ".join(_ratio(row[key]) for key in ("speedup_over_compiled", "speedup_over_eager"))
        lines.append(f"| {row['lens']} | {row['name']} | {figures} | {ratios} |")
    loads = [v for row in rows for v in row["load"] if v is not None]
    if loads:
        notes += f" Load average of the machine meanwhile: up to {max(loads):.1f} on {os.cpu_count()} cores."
    return f"# {title}\n\n{notes}\n\n" + "\n".join(lines) + "\n"


def _ratio(found: dict[str, float] | None) -> str:
    return "" if found is None else f"{found['min']:.2f} ({found['median']:.2f})"


def notes(threads: str, rounds: int) -> str:
    """What a reader must know of the conditions."""
    return (
        f"Rays uniform over film and pupil disc of each domain, blocked ones included; {threads}, {rounds} rounds in "
        "turn, each the best of a few short samples; float32 unless told. Exact tracer and models do the same work: "
        "film and pupil points in; scene ray, transmittance and status out, with stop, rims and dispersion; "
        "models add the crossing with the stop. Thin lens and pinhole give ray and weight. Ratios: by the best times "
        "(median within rounds), above 1 is faster. "
        f"Python {platform.python_version()}, torch {torch.__version__}, {platform.machine()}."
    )
