"""Relative illumination of models beside the exact lens's, for the plot of a run."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from neurolens.cameras.model import load_model
from neurolens.evaluate.measure import FRESH, Measured, onnx_predictor
from neurolens.evaluate.vignetting import relative_illumination
from neurolens.optics.prescription import Lens
from neurolens.surrogates.domain import Domain

_POINTS = 4096  # a quarter of a second a model


def illumination(measured: Sequence[Measured], lens: Lens, domain: Domain, seed: int) -> dict[str, Any]:
    """Curves at full aperture for `plots.illumination_plot`: film_radius_mm, exact, models (name to list).

    Args:
        seed: of the rays of the fit, so that these are others.
    """
    light: dict[str, Any] = {"film_radius_mm": [], "exact": [], "models": {}}
    for m in measured:
        predict = onnx_predictor(load_model(m.file))
        curves = relative_illumination(lens, domain, predict, points=_POINTS, seed=seed + FRESH)
        light["film_radius_mm"], light["exact"] = curves["film_radius_mm"], curves["exact"]
        light["models"][m.settings.label] = curves["model"]
    return light
