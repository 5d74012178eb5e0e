"""Models (and the exact lens) as fused C on the clock, where a C compiler is at hand."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from threading import get_ident
from typing import Any

import numpy as np
from numpy.typing import NDArray

from neurolens.base.errors import ModelError
from neurolens.evaluate.benches.compiled_source import CompiledSource, find_compiler
from neurolens.evaluate.speed import Call, Candidate, Unavailable
from neurolens.graph.program import Program
from neurolens.surrogates.domain import Domain, FilmRays
from neurolens.surrogates.model import LensModel
from neurolens.surrogates.source import ALL, FREE, Fixed, Parts, fused_program
from neurolens.surrogates.stored import load_fitted

# Inputs and results of a batch lie in the second-level cache.
FUSED_BATCHES = (2048, 4096, 8192, 16384)


def program_candidate(name: str, program: Program, domain: Domain, stop_radius_mm: float | None = None) -> Candidate:
    """A program of `surrogates.fused`, compiled when the race prepares it.

    Args:
        stop_radius_mm: None takes the domain's.
    """
    compiled: list[CompiledSource] = []
    room: dict[tuple[int, int], dict[str, NDArray[Any]]] = {}

    def prepare(rays: FilmRays) -> Call:
        if not compiled:
            compiled.append(CompiledSource(program))
        source = compiled[0]
        names = ("film_x_mm", "film_y_mm", "film_z_mm", "pupil_x_mm", "pupil_y_mm", "wavelength_nm")
        columns: dict[str, Any] = {n: c.numpy().astype(np.float32) for n, c in zip(names, rays.columns(), strict=False)}
        columns["film_z_mm"] = columns["film_z_mm"][0]
        columns["stop_radius_mm"] = np.float32(domain.stop_radius_mm if stop_radius_mm is None else stop_radius_mm)
        count = len(rays)
        calls: dict[int, Call] = {}

        def call() -> None:
            # A thread writes where it wrote before, as tracers and onnxruntime do with the memory that they get back.
            thread = get_ident()
            if thread not in calls:
                if (thread, count) not in room:
                    room[thread, count] = source.outputs(count)
                calls[thread] = source.prepared(columns, room[thread, count])
            calls[thread]()

        return call

    return Candidate(name, prepare, FUSED_BATCHES)


def fused_candidate(
    name: str,
    model: LensModel | Sequence[LensModel] | Path,
    domain: Domain,
    *,
    parts: Parts = ALL,
    fixed: Fixed = FREE,
) -> Candidate | None:
    """A model, or that of an exported file, as compiled C; None where there is no compiler, or no form in C.

    Args:
        model: one, or one for each fixed wavelength (of which the first is timed).
    """
    try:
        find_compiler()
        found = load_fitted(model) if isinstance(model, Path) else model
        models = [found] if isinstance(found, LensModel) else found
        program = fused_program(models, parts, fixed)
    except (Unavailable, ModelError, TypeError):
        return None
    return program_candidate(name, program, domain, fixed.stop_radius_mm)
