"""Times of fused models as a page in Markdown and as JSON: the goals, the table, what it does not say."""

from __future__ import annotations

import json
import os
from collections.abc import Collection, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from neurolens.base.files import atomic_write_text
from neurolens.evaluate.benches.fused_speed import WAVELENGTH_NM, WITHIN_UM, Row
from neurolens.evaluate.benches.trace_speed_page import machine
from neurolens.graph.compiler import FLAGS

_NOTES = """\
One thread, float32, batches that fit the caches, {rounds} rounds in turn in one process (best; median in brackets).
Rays uniform over film and pupil disc of the domain, blocked ones included. "ray": film and pupil point in, position on
the front surface, direction and domain guard out. "whole": with stop, rims and transmittance.

- exact C: the exact trace as C from the same writer as the models, compiled alike
  ({flags}): the tracer to beat. Every surface is bare; "ray" tests no rim. Each
  surface waits for the one before it (a division and two roots in a row), which costs more than its operations.
- exact torch: the project's own tracer compiled by torch, rims tested in both kinds of work.
- onnxruntime, "ray": the part of the exported graph that gives position and direction, without the domain guard.
- Operations: float operations a ray, a fused multiply-add is one; in brackets, how many are divisions and square roots.
  A core with two 512-bit pipes does 32 a cycle. Bytes: what a ray reads and writes.
- Fixed: {wavelength:g} nm; film at the farthest focus, one stop down. These do less: one wavelength is no white light.

The exact tracer has no error and needs no fit: with few surfaces it is nearly as fast, and a fit takes seconds, in
which it traces hundreds of millions of rays."""


def write(rows: Sequence[Row], folder: Path, rounds: int) -> str:
    """Write fused_speed.md and fused_speed.json; returns the page."""
    folder.mkdir(parents=True, exist_ok=True)
    text = page(rows, rounds)
    data = {
        "machine": machine(),
        "rounds": rounds,
        "flags": FLAGS,
        "goals": goals(rows),
        "rows": [asdict(r) for r in rows],
    }
    atomic_write_text(folder / "fused_speed.json", json.dumps(data, indent=1, allow_nan=False) + "\n")
    atomic_write_text(folder / "fused_speed.md", text)
    return text


def earlier(folder: Path, names: Collection[str]) -> list[Row]:
    """Rows of other lenses than these that stand in a folder's fused_speed.json, if it was made on this machine."""
    try:
        data = json.loads((folder / "fused_speed.json").read_text(encoding="utf-8"))
        same = data["machine"] == machine() and list(data["flags"]) == list(FLAGS)
        return [Row(**row) for row in data["rows"] if same and row["lens"] not in names]
    except (OSError, ValueError, KeyError, TypeError):
        return []


def goals(rows: Sequence[Row]) -> list[dict[str, Any]]:
    """What is asked of the fastest model within 1 um, against the rows: goal, wanted, measured, at_most, holds."""
    found: list[dict[str, Any]] = []

    def goal(text: str, wanted: float, measured: float | None, *, at_most: bool) -> None:
        holds = None if measured is None else measured <= wanted if at_most else measured >= wanted
        found.append({"goal": text, "wanted": wanted, "measured": measured, "at_most": at_most, "holds": holds})

    for words, ending, work, wanted in (
        ("fused", _FUSED, "ray", 6.0),
        ("fused", _FUSED, "whole", 12.0),
        ("fused, one wavelength", _FOLDED, "ray", 4.0),
        ("fused, one wavelength", _FOLDED, "whole", 8.0),
        ("onnxruntime", _GRAPH, "ray", 20.0),
        ("onnxruntime", _GRAPH, "whole", 40.0),
    ):
        row = _fastest(rows, 12, work, ending)
        goal(f"ns per ray, 12 refractions, {words}, {work}", wanted, _ns(row), at_most=True)
    for exact in ("exact C", "exact torch"):
        for count, ending, work, wanted in (
            (12, _FUSED, "ray", 5.0),
            (33, _FUSED, "ray", 15.0),
            (12, _FUSED, "whole", 3.0),
            (33, _FUSED, "whole", 8.0),
            (12, _GRAPH, "ray", 1.5),
            (33, _GRAPH, "ray", 4.0),
            (12, _GRAPH, "whole", 1.5),
            (33, _GRAPH, "whole", 4.0),
        ):
            row = _fastest(rows, count, work, ending)
            kind = "onnxruntime" if ending == _GRAPH else "fused"
            ratio = None if row is None else row.speedup.get(exact)
            goal(f"times as fast as {exact}, {count} refractions, {kind}, {work}", wanted, ratio, at_most=False)
    return found


_FUSED, _FOLDED, _GRAPH = ", C", ", one wavelength", ", onnxruntime"


def _ns(row: Row | None) -> float | None:
    return float(row.ns["min"]) if row is not None and row.ns else None


def _fastest(rows: Sequence[Row], refractions: int, work: str, ending: str) -> Row | None:
    """The fastest model of one form within 1 um."""
    some = [r for r in rows if r.refractions == refractions and r.work == work and r.name.endswith(ending) and r.ns]
    some = [r for r in some if r.rms_um is not None and r.rms_um <= WITHIN_UM]
    return min(some, key=lambda r: r.ns["min"] if r.ns else 0.0, default=None)


def page(rows: Sequence[Row], rounds: int) -> str:
    """The whole page."""
    m = machine()
    parts = ["# Fused models against the exact lens", "`neurolens bench fused`"]
    parts.append(_NOTES.format(rounds=rounds, flags=" ".join(FLAGS), wavelength=WAVELENGTH_NM))
    parts.append(f"{m['processor']}, {m['cores']} cores; Python {m['python']}, torch {m['torch']}.{_busy(rows)}")
    parts += [_goal_table(rows), _table(rows)]
    return "\n\n".join(parts) + "\n"


def _busy(rows: Sequence[Row]) -> str:
    """On the load, where it was more than the machine has cores for."""
    most = max((r.load for r in rows if r.load is not None), default=0.0)
    if most <= (os.cpu_count() or 1):
        return ""
    return (
        f" Load average\nmeanwhile up to {most:.1f}: others were working too. Short passes fall between interruptions, "
        "so their best times\nhold; passes of the tracer compiled by torch, over 5 ms for many surfaces, do not: its "
        "times there are too long, and\nratios over it too high."
    )


def _goal_table(rows: Sequence[Row]) -> str:
    lines = ["| goal | wanted | measured | |", "|---|---|---|---|"]
    for g in goals(rows):
        verdict = "not measured" if g["holds"] is None else "reached" if g["holds"] else "missed"
        measured = "" if g["measured"] is None else f"{g['measured']:.3g}"
        bound = "at most" if g["at_most"] else "at least"
        lines.append(f"| {g['goal']} | {bound} {g['wanted']:g} | {measured} | {verdict} |")
    return "\n".join(lines)


def _table(rows: Sequence[Row]) -> str:
    head = (
        "lens|refractions|candidate|work|RMS um|coefficients|operations|bytes|ns per ray|over exact C|over exact torch"
    )
    lines = ["| " + head.replace("|", " | ") + " |", "|---" * 11 + "|"]
    for r in rows:
        ns = f"{r.ns['min']:.2f} ({r.ns['median']:.2f})" if r.ns else f"unavailable: {r.reason}"
        operations = "" if r.operations is None else f"{r.operations} ({r.roots})"
        ratios = [f"{r.speedup[k]:.2f}" if k in r.speedup else "" for k in ("exact C", "exact torch")]
        cells = [r.lens, r.refractions, r.name, r.work, "" if r.rms_um is None else f"{r.rms_um:.2g}"]
        cells += [r.coefficients or "", operations, r.bytes or "", ns, *ratios]
        lines.append("| " + " | ".join(map(str, cells)) + " |")
    return "\n".join(lines)
