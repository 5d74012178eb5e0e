"""Speeds that the project promises whatever model is used: the exact tracer's and the renderer's."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from neurolens.evaluate.candidates import exact_candidates
from neurolens.evaluate.speed import race
from neurolens.optics.lensfile import read_lens
from neurolens.render.bench import measure
from neurolens.surrogates.domain import domain_of

LENS, SCENE = "lenses/laikin_double_gauss_50.toml", "experiments/scenes/room.toml"
TRACER_MRAY_S = {"eager": 6.0, "compiled": 20.0}  # one core, float32, 12 refractions, stop, rims and dispersion
RENDER_MPATH_S = 1.0  # the room, depth 3, two cores


@dataclass(frozen=True)
class Floor:
    """One speed against its floor; `measured` is None, with a `reason`, where it could not be taken."""

    name: str
    floor: float
    measured: float | None
    unit: str
    reason: str = ""

    @property
    def verdict(self) -> str:
        if self.measured is None:
            return "UNCHECKED"
        return "pass" if self.measured >= self.floor else "FAIL"


def check_floors(root: Path, rounds: int = 20) -> list[Floor]:
    """Measure all of them; the best of the rounds counts, as a busy machine only ever slows.

    Args:
        root: the project's folder.

    Raises:
        InputError: the lens or the scene is not there.
    """
    lens = read_lens(root / LENS).at()
    domain = domain_of(lens)
    candidates = exact_candidates(lens, domain, transmittance=False, build_rays=False, label="trace")
    timed = race(candidates, domain, rounds=rounds)
    found = []
    for kind, floor in TRACER_MRAY_S.items():
        timing = timed.timing(f"trace {kind}")
        speed = None if timing is None else 1000 / timing["min"]
        reason = timed.unavailable.get(f"trace {kind}", "")
        found.append(Floor(f"exact tracer, {kind}, one core, float32", floor, speed, "Mray/s", reason))
    room = measure(root / SCENE, threads=2, depth=3)
    found.append(Floor("render of the room, two cores, depth 3", RENDER_MPATH_S, room["mpaths_per_s"], "Mpath/s"))
    return found


def floor_table(floors: Sequence[Floor]) -> str:
    """The floors as a table in Markdown."""
    lines = ["| what | measured | floor | unit | verdict |", "|---|---|---|---|---|"]
    for f in floors:
        shown = f"({f.reason})" if f.measured is None else f"{f.measured:.3g}"
        lines.append(f"| {f.name} | {shown} | {f.floor:g} | {f.unit} | {f.verdict} |")
    return "\n".join(lines) + "\n"
