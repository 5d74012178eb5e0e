"""Times of the surrogates of one lens: all in one race with the exact tracer, in onnxruntime and as fused C."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from neurolens.base.progress import Report
from neurolens.cameras.model import load_model
from neurolens.evaluate.benches.fused import fused_candidate
from neurolens.evaluate.candidates import exact_candidates, model_candidate
from neurolens.evaluate.records import break_even_rays
from neurolens.evaluate.speed import Race, race
from neurolens.optics.prescription import Lens
from neurolens.surrogates.domain import Domain

EXACT = ("exact eager", "exact compiled")


def race_models(
    lens: Lens, domain: Domain, files: Mapping[str, Path], rounds: int, threads: int, compiled: bool, report: Report
) -> Race:
    """Race exported models, by name, and the exact tracer; "NAME fused" where a C compiler makes one."""
    candidates = exact_candidates(lens.with_stop_radius(domain.stop_radius_mm), domain, compiled=compiled)
    for name, file in files.items():
        candidates.append(model_candidate(name, load_model(file), domain.stop_radius_mm))
        fused = fused_candidate(f"{name} fused", file, domain) if threads == 1 else None
        if fused is not None:
            candidates.append(fused)
    return race(candidates, domain, rounds=rounds, threads=threads, report=report)


def times_of(record: Mapping[str, Any], timed: Race) -> dict[str, Any]:
    """Times of one model for its record, held against the fastest exact tracer of the same race.

    Returns: ns_per_ray, speedup (by the minima), break_even_rays (after which fitting and loading have paid; "never"
        where the exact tracer is as fast), the same with "fused_" before, and exact: the tracers' times.
    """
    name, found = record["method"], dict[str, Any]()
    best = EXACT[1] if EXACT[1] in timed.ns else EXACT[0]
    exact = timed.timing(best)
    for prefix, candidate in (("", name), ("fused_", f"{name} fused")):
        timing, ratio = timed.timing(candidate), timed.speedup(candidate, best)
        pays: float | str | None = None
        if exact and timing:
            pays = break_even_rays(record["fit_s"], record["load_s"], exact["min"], timing["min"]) or "never"
        found |= {
            f"{prefix}ns_per_ray": timing,
            f"{prefix}speedup": ratio["min"] if ratio else None,
            f"{prefix}break_even_rays": pays,
        }
    return {**found, "exact": [timed.record(n) for n in EXACT if n in timed.ns or n in timed.unavailable]}
