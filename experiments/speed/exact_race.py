"""The exact tracer of torch in races for speed: eager and compiled, with and without parts of its work."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import torch

from neurolens.models.model import Domain
from neurolens.models.pairs import FilmRays
from neurolens.optics.lens.prescription import Lens
from neurolens.optics.setting.pupils import camera_rays
from neurolens.optics.trace.rays import Traced, compile_tracing, trace
from neurolens.studies.speed import EAGER_BATCHES, Call, Candidate, Unavailable, eager_arguments

COMPILED = "exact compiled"
COMPILED_BATCHES = (16384,)  # each further size costs half a minute of compilation


def exact_candidates(
    lens: Lens, domain: Domain, *, transmittance: bool = True, build_rays: bool = True, compiled: bool = True,
    label: str = "exact",
) -> list[Candidate]:  # fmt: skip
    """The exact tracer in float32, eager and compiled: every surface, stop, rims and dispersion, status out.

    Args:
        transmittance: whether to follow it, as surrogates do.
        build_rays: start from film and pupil points, as surrogates do; else from camera rays made beforehand.
        compiled: whether to include the compiled one.
        label: names are "{label} eager" and "{label} compiled".
    """
    torch._dynamo.reset()  # torch limits the number of recompilations of a function

    def tracing(rays: Any, wavelength: Any) -> Traced:
        return trace(lens, rays, wavelength, transmittance=transmittance)

    def whole(fx: Any, fy: Any, fz: Any, px: Any, py: Any, wavelength: Any) -> Traced:
        return tracing(camera_rays(fx, fy, fz, px, py, domain.pupil_z_mm), wavelength)

    def arguments(rays: FilmRays) -> tuple[Any, ...]:
        fx, fy, fz, px, py, wavelength = values = eager_arguments(rays)
        return values if build_rays else (camera_rays(fx, fy, fz, px, py, domain.pupil_z_mm), wavelength)

    run: Callable[..., Traced] = whole if build_rays else tracing
    fast = compile_tracing(run, fullgraph=True) if compiled else run

    def prepare_compiled(rays: FilmRays) -> Call:
        call = partial(fast, *arguments(rays))
        try:
            call()
        except Exception as error:  # of many types: no compiler, a compiler that fails, an unsupported platform
            raise Unavailable(f"torch cannot compile here: {_reason(error)}") from error
        return call

    eager = Candidate(f"{label} eager", lambda rays: partial(run, *arguments(rays)), EAGER_BATCHES)
    return [eager, Candidate(f"{label} compiled", prepare_compiled, COMPILED_BATCHES)] if compiled else [eager]


def _reason(error: BaseException) -> str:
    # Torch wraps the reason: the innermost cause is the informative one.
    while error.__cause__ is not None:
        error = error.__cause__
    text = next((line.strip() for line in str(error).splitlines() if line.strip()), "")
    return f"{type(error).__name__}: {text}"[:200]
