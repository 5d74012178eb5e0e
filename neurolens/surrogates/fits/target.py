"""An error asked for: the first fit that reaches it, or a warning and the best."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Iterable
from dataclasses import replace

from neurolens.base.errors import NeurolensWarning
from neurolens.surrogates.model import LensModel
from neurolens.surrogates.pairs import RayPairs
from neurolens.surrogates.targets import film_equivalent, targets_of

# Terms of polynomials tried for an error asked for, fewest first.
TERMS_LADDER = (12, 16, 20, 28, 40, 64, 100)


def reach(models: Iterable[LensModel], target_um: float, error_um: Callable[[LensModel], float]) -> LensModel:
    """The first model whose film-equivalent RMS is at most `target_um`, else the best; what it reached in its settings.

    Args:
        models: at least one; fitted as they are asked for, so that none after the first that serves is.
        error_um: film-equivalent RMS of a model.

    Warns:
        NeurolensWarning: none reaches it.
    """
    found: list[tuple[float, LensModel]] = []
    for model in models:
        error = error_um(model)
        found.append((error if math.isfinite(error) else math.inf, model))
        if error <= target_um:
            break
    least, best = min(found, key=lambda pair: pair[0])
    if not least <= target_um:
        warnings.warn(
            f"{best.lens.path}: {best.method}: asked for {target_um:g} um, reached {least:.3g} um; this is the best of "
            "the fits tried",
            NeurolensWarning,
            stacklevel=3,
        )
    return replace(best, settings={**best.settings, "reached_um": least if math.isfinite(least) else None})


def first_order_um(pairs: RayPairs) -> Callable[[LensModel], float]:
    """Film-equivalent RMS of models to first order, in the nearest focused plane, over the rays held out."""

    def error(model: LensModel) -> float:
        targets = targets_of(pairs.lens, model.encoding, pairs.held_out)
        off = model.core(targets.field)[0] - targets.vectors
        return math.sqrt(float((film_equivalent(pairs.lens, pairs.domain, off)[0] ** 2).sum(0).mean()))

    return error
