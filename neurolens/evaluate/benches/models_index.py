"""The index of the models that ship: models/index.json for programs, models/README.md for people."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from neurolens.base.files import atomic_write_text
from neurolens.evaluate.train import versions

_HEAD = """# Models that ship

Made by `neurolens bench models` from experiments/models.toml: of every lens of lenses/ the best polynomial of at most
64 coefficients a vector output and the best network of two layers of 16 units, each fitted within half a minute,
over the whole lit film, full aperture, focus from infinity to near and all wavelengths for which the glasses are known;
of a few lenses also faster ones. Errors on held-out rays (`neurolens.evaluate.rays`), micrometres at an image radius of
21.6 mm; every card was checked on fresh rays. Times on one core in onnxruntime, with stop, rims and transmittance;
speed-up over the compiled exact tracer doing the same work in the same run. Check a model with
`neurolens evaluate models/FILE`; `make bench` holds those of the first lenses to the speed-ups that the index promises.

| model | RMS um | p99 um | direction deg | position um | T RMS | false pass / block % | coefficients | kB | ns per ray | speed-up |
|---|---|---|---|---|---|---|---|---|---|---|
"""  # noqa: E501


def write_index(rows: Sequence[Mapping[str, Any]], left_out: Mapping[str, str], out: Path) -> None:
    """Write both; `left_out` gives the reason for each entry that has no models."""
    index = {
        "schema": 2,
        "command": "neurolens bench models",
        "versions": versions(),
        "models": list(rows),
        "left_out": dict(left_out),
    }
    atomic_write_text(out / "index.json", json.dumps(index, indent=1, allow_nan=False) + "\n")
    lines = [_line(row) for row in rows]
    if left_out:
        lines += ["", "Not made:", "", *(f"- {state}: {reason}" for state, reason in left_out.items())]
    atomic_write_text(out / "README.md", _HEAD + "\n".join(lines) + "\n")


def _line(row: Mapping[str, Any]) -> str:
    um, p99, position = (
        row.get(f"{key}_at_21_6", row.get(key)) for key in ("rms_um", "p99_um", "position_rms_um")
    )  # fmt: skip
    cells = [
        row["file"] + (" (card does not hold)" if row.get("broken") else ""),
        _n(um),
        _n(p99),
        _n(row["direction_rms_deg"]),
        _n(position),
        _n(row["transmittance_rms"]),
        f"{_n(row['false_pass'], 100)} / {_n(row['false_block'], 100)}",
        str(row["coefficients_per_vector"] or row["parameters"]),
        f"{row['bytes'] / 1000:.0f}",
        _n((row["ns_per_ray"] or {}).get("min")),
        _n(row["speedup_over_compiled"]),
    ]
    return "| " + " | ".join(cells) + " |"


def _n(value: float | None, factor: float = 1.0) -> str:
    return "–" if value is None else f"{value * factor:.3g}"
