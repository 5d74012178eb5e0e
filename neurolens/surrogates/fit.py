"""One interface to every surrogate: settings in, complete model out."""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path

from neurolens.base import status as st
from neurolens.base.errors import InputError, NeurolensWarning
from neurolens.surrogates.cores import Core, Refracted, Residual
from neurolens.surrogates.model import LensModel
from neurolens.surrogates.network import fit_network, training_s, with_boundary_terms
from neurolens.surrogates.pairs import FilmRays, RayPairs, draw_everywhere, join_pairs, trace_pairs
from neurolens.surrogates.polynomial import fit_mirror, fit_paraxial, fit_planes, fit_polynomial
from neurolens.surrogates.targets import (
    NETWORKS,
    PLANES_SEARCHED,
    POLYNOMIALS,
    ModelSettings,
    Prepared,
    choose_gates,
    explained,
    fit_encoding,
    grazes,
    index_series,
    inside_front,
    scales_of,
    with_angle,
    without_idle_gates,
)  # fmt: skip
from neurolens.surrogates.terms import pinned_threads
from neurolens.trace.rays import CHUNK

# Rays drawn over the domain to find what blocks anything: a share of 1e-4 is 20 of them.
_GATE_RAYS = 200_000


def prepare(pairs: RayPairs) -> Prepared:
    """Find the encoding, and the rims and discriminants that block anything in the domain.

    Warns:
        NeurolensWarning: more than one ray in 10,000 is lost in a way that no gate shows (beyond 90 degrees to a
            plane, or on the far half of a sphere).
    """
    seed = pairs.settings.seed + 1_000_003
    drawn, ended = draw_everywhere(pairs.domain, _GATE_RAYS, seed), []
    with pinned_threads():
        for start in range(0, len(drawn), CHUNK):  # crossings with many surfaces are large: of blocked rays alone
            some = FilmRays(*(c[start : start + CHUNK] for c in drawn.columns()))
            traced = trace_pairs(pairs.lens, some, pairs.domain.pupil_z_mm)
            ended.append(traced.select(traced.status != st.PASSED))
            del traced
    blocked = join_pairs(ended)
    del ended
    gates = choose_gates(pairs.lens, blocked, len(drawn))
    untold = (blocked.status % 4 != st.RIM) & ~explained(pairs.lens, gates, blocked)
    lost = float(untold.double().sum()) / len(drawn)
    if lost > 1e-4:
        warnings.warn(
            f"{pairs.lens.path}: {100 * lost:.2f}% of the domain's rays end by missing a surface or by total "
            "reflection in a way that no gate shows; the rims near by stand in for that boundary",
            NeurolensWarning,
            stacklevel=2,
        )
    return Prepared(pairs, fit_encoding(pairs.domain, pairs.train, mirror=pairs.lens.anamorphic), gates)


def fit_model(
    prepared: Prepared,
    settings: ModelSettings,
    progress: Callable[[float], object] = lambda share: None,
    *,
    checkpoint: Path | None = None,
) -> LensModel:
    """Fit one surrogate.

    Args:
        checkpoint: file in which the training of networks keeps its state, to go on from there after a kill (see
            `fit_network`). It stays when the fit has ended; `clear_training` removes it.

    Raises:
        InputError: an unknown method, or settings that the method refuses.
    """
    start = time.perf_counter()
    pairs, encoding = prepared.pairs, prepared.encoding
    with pinned_threads():
        shown, refracts = pairs, settings.method in POLYNOMIALS and grazes(pairs)
        if refracts:
            shown = replace(pairs, train=inside_front(pairs.lens, pairs.train))
        if settings.planes and settings.method in PLANES_SEARCHED:
            encoding = fit_planes(shown, encoding, settings.terms, settings.position_weight)
        core = _fit_core(replace(prepared, pairs=shown, encoding=encoding), settings, progress, checkpoint)
        if refracts:
            core = Refracted((core,), index_series(pairs.lens, encoding))
    fit_s = max(time.perf_counter() - start, training_s(checkpoint))
    model = as_model(replace(prepared, encoding=encoding), core, settings, fit_s)
    return without_idle_gates((model,), settings.idle_gates)[0] if settings.idle_gates else model


def as_model(prepared: Prepared, core: Core, settings: ModelSettings, fit_s: float) -> LensModel:
    """A complete model of a core that was fitted in `fit_s` seconds to the prepared pairs."""
    pairs = prepared.pairs
    model = LensModel(
        lens=pairs.lens,
        domain=pairs.domain,
        encoding=prepared.encoding,
        scales=scales_of(pairs.lens),
        gates=prepared.gates,
        core=core,
        method=settings.label,
        settings={**asdict(settings), "rays": len(pairs.train), "rays_seed": pairs.settings.seed},
        direction="slope" if settings.family == "paraxial" else "angle",
        fit_s=fit_s,
    )
    return with_angle(model)


def _fit_core(
    prepared: Prepared, settings: ModelSettings, progress: Callable[[float], object], checkpoint: Path | None
) -> Core:
    mirror = prepared.encoding.mirror
    if settings.method in ("thin", "thick") and not mirror:
        return fit_paraxial(prepared, settings.method)
    if settings.method not in (*POLYNOMIALS, *NETWORKS):
        methods = ("thin", "thick", *POLYNOMIALS, *NETWORKS)
        raise InputError("fit", "method", settings.method, f"one of {', '.join(methods)}")
    if mirror and settings.method != "mlp":
        return fit_mirror(prepared, settings.method, settings.terms, settings.degree)
    base = None
    if settings.method != "mlp":
        base = fit_polynomial(prepared, replace(settings, method="ols") if settings.method == "ols+mlp" else settings)
    if settings.method not in NETWORKS:
        assert base is not None
        return base
    network = fit_network(prepared, settings, base=base, checkpoint=checkpoint, progress=progress)
    return with_boundary_terms(prepared, network) if base is None else Residual((base, network))
