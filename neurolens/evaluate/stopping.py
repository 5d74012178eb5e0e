"""Models stopped down without a new fit, and their relative illumination beside the exact lens's."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from neurolens.cameras.model import load_model
from neurolens.evaluate.measure import FRESH, Measured, onnx_predictor
from neurolens.evaluate.vignetting import relative_illumination, stopped_down
from neurolens.optics.prescription import Lens
from neurolens.surrogates.domain import Domain

STOPS = (2, 4)
_RAYS, _POINTS = 65536, 4096  # a quarter of a second a model and stop


def stop_down(measured: Sequence[Measured], lens: Lens, domain: Domain, seed: int) -> dict[str, Any]:
    """Add `stopped_down` to the models' records: false passes and blocks at 2 and 4 stops closed, with the same fit.

    Args:
        seed: of the rays of the fit, so that these are others.

    Returns: data for `plots.illumination_plot`, full aperture: film_radius_mm, exact, models (name to list).
    """
    light: dict[str, Any] = {"film_radius_mm": [], "exact": [], "models": {}}
    for m in measured:
        predict = onnx_predictor(load_model(m.file))
        found = stopped_down(lens, domain, predict, stops=STOPS, count=_RAYS, seed=seed + FRESH)
        m.record["stopped_down"] = {
            name: {key: errors[key] for key in ("false_pass", "false_block")} for name, errors in found.items()
        }
        curves = relative_illumination(lens, domain, predict, points=_POINTS, seed=seed + FRESH)
        light["film_radius_mm"], light["exact"] = curves["film_radius_mm"], curves["exact"]
        light["models"][m.settings.label] = curves["model"]
    return light
