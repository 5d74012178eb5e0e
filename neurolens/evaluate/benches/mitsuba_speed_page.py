"""The page of `neurolens bench mitsuba`: speed beside Mitsuba, speed by scene, where the time goes, memory."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from neurolens.base.files import atomic_write_text
from neurolens.evaluate.benches.mitsuba_speed import Settings
from neurolens.evaluate.benches.mitsuba_speed_profile import STAGES
from neurolens.evaluate.records import plain

NAME = "render_speed"


@dataclass
class Found:
    """What was measured: rows of `mitsuba_speed.record`, of scenes and of memory; `missing`: what was not, and why."""

    settings: Settings
    versions: dict[str, str]
    rows: list[dict[str, Any]] = field(default_factory=list)
    scenes: list[dict[str, Any]] = field(default_factory=list)
    memory: list[dict[str, Any]] = field(default_factory=list)
    missing: list[str] = field(default_factory=list)


def page(found: Found) -> str:
    """The tables as Markdown."""
    s = found.settings
    versions = ", ".join(f"{name} {version}" for name, version in found.versions.items())
    parts = [
        "# Speed of the renderer",
        f"One run of `neurolens bench mitsuba` ({versions}); {s.threads} threads.",
    ]
    if found.rows:
        parts += [
            "## Beside Mitsuba 3",
            f"Its own Cornell box, {s.size} x {s.size} pixels, {s.samples} samples, at most seven surfaces, roulette "
            f"after two in all; {s.repeats} repeats in turn, compiling and warming up left out. Time: median, over "
            "that of our first row. Mean: of the picture's R, G and B; the lens sees another part of the box than the "
            "pinhole, and RGB paths mix colours otherwise than spectra. Noise: variance of a pixel's luminance over "
            "its square at these samples; our samples are low-discrepancy, those of Mitsuba's scene independent. A "
            "lens that disperses leaves a path one wavelength, in Mitsuba four times the same.",
            _speed_table(found.rows),
        ]
    if found.scenes:
        parts += [
            "## Scenes, and where the time goes",
            "Paths per second through a thin lens, four wavelengths a path, the scene's own depth; beside it the share "
            "of the time by what the code is for (profile of one worker).",
            _scene_table(found.scenes),
        ]
    if found.memory:
        parts += ["## Memory", _memory_text(found.memory), _memory_table(found.memory)]
    parts += [f"Not measured: {reason}" for reason in found.missing]
    return "\n\n".join(parts) + "\n"


def _table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    lines = [header, ["---"] * len(header), *rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def _speed_table(rows: list[dict[str, Any]]) -> str:
    header = ("renderer", "a path carries", "camera", "Mpath/s, fastest", "median", "time", "mean R G B", "noise")
    return _table(
        header,
        [
            (
                row["name"],
                row["carries"],
                row["camera"],
                f"{row['mpaths_per_s']:.3g}",
                f"{row['mpaths_per_s_median']:.3g}",
                f"{row['time_over_ours']:.2f}",
                " ".join(f"{v:.4f}" for v in row["mean_rgb"]),
                "–" if row["noise"] is None else f"{row['noise']:.2g}",
            )
            for row in rows
        ],
    )


def _scene_table(rows: list[dict[str, Any]]) -> str:
    header = ("scene", "surfaces a path", "Mpath/s, fastest", "median", *(f"{stage} %" for stage in STAGES))
    return _table(
        header,
        [
            (
                row["scene"],
                str(row["max_depth"]),
                f"{row['mpaths_per_s']:.3g}",
                f"{row['mpaths_per_s_median']:.3g}",
                *(f"{100 * row['shares'][stage]:.0f}" for stage in STAGES),
            )
            for row in rows
        ],
    )


def _memory_text(rows: list[dict[str, Any]]) -> str:
    """What grows with the picture, from the two largest at equal samples, and what does not."""
    small, large = sorted((r for r in rows if r["samples"] == rows[0]["samples"]), key=_pixels)[-2:]
    each = (large["growth_mb"] - small["growth_mb"]) * 1e6 / (_pixels(large) - _pixels(small))
    rest = large["growth_mb"] - each * _pixels(large) * 1e-6
    return (
        "Highest resident memory of one worker while it renders, less that before. It grows by "
        f"{each:.0f} bytes a pixel, the film; the paths under way take {rest:.0f} MB whatever the picture's size and "
        "samples."
    )


def _pixels(row: dict[str, Any]) -> int:
    return int(row["width"] * row["height"])


def _memory_table(rows: list[dict[str, Any]]) -> str:
    cells = [(f"{r['width']} x {r['height']}", str(r["samples"]), f"{r['growth_mb']:.0f}") for r in rows]
    return _table(("picture", "samples", "MB"), cells)


def write(found: Found, out: Path) -> str:
    """Write render_speed.md and .json into `out`; returns the page."""
    text = page(found)
    out.mkdir(parents=True, exist_ok=True)
    atomic_write_text(out / f"{NAME}.md", text)
    data = {k: getattr(found, k) for k in ("versions", "rows", "scenes", "memory", "missing")}
    data["settings"] = vars(found.settings)
    atomic_write_text(out / f"{NAME}.json", json.dumps(plain(data), indent=1, allow_nan=False) + "\n")
    return text
