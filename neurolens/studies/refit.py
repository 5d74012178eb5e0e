"""Fits the transmittance of model files again, where the coatings or the glass of their lenses are others now."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch

from neurolens.models.axes import product
from neurolens.models.export import export_onnx, export_states
from neurolens.models.file import as_stored, read_model
from neurolens.models.fit import StateModel, StateSpace
from neurolens.models.model import LensModel
from neurolens.models.pairs import passing_rays
from neurolens.models.targets import TRANSMITTANCE_TERMS
from neurolens.models.transmittance import BATCH, refitted
from neurolens.optics.lens.prescription import Lens
from neurolens.studies.check import random_states
from neurolens.studies.measure import FRESH

_RAYS, _STATES = 6000, 4  # fresh rays of a state on which errors are measured, and states


def refit_transmittance(file: Path, lens: Lens | StateSpace, out: Path | None = None) -> dict[str, Any]:
    """Fit the transmittance of a model again and write its file; position, direction and gates stay to the bit.

    The card gets the lens with its coatings, and the errors of the transmittance on fresh rays; its other errors stay.

    Args:
        lens: the model's lens as it is now, or its states.
        out: the file to be written; None replaces the model's own.

    Returns the card's errors, and the number of coefficients as "parameters".

    Raises:
        ModelError, InputError: as `read_model` and `refitted`.
    """
    stored = read_model(file)
    errors = dict(stored.card["errors"])
    if isinstance(lens, Lens):
        models = refitted(stored.nodes, [lens], TRANSMITTANCE_TERMS)
        errors |= transmittance_errors(models)
        export_onnx(models[0], out or file, errors)
    else:
        space = StateSpace(lens.lens, stored.axes, lens.zoom, lens.f_number)
        lenses = [space.lens_at(state) for state in product(space.axes)]
        models = refitted(stored.nodes, lenses, TRANSMITTANCE_TERMS)
        whole = StateModel(space, tuple(models), stored.nodes[0].fit_s)
        seed = int(models[0].settings["rays_seed"]) + FRESH
        errors |= transmittance_errors([whole.at(*s) for s in random_states(space.axes, _STATES, seed)])
        export_states(whole, out or file, errors)
    return {**errors, "parameters": sum(model.core.coefficients for model in models)}


def transmittance_errors(models: Sequence[LensModel]) -> dict[str, float]:
    """Return the errors of the transmittance on rays that no fit has seen: RMS and largest, of the worst model."""
    rows = []
    for model in as_stored(models):
        seed = int(model.settings.get("rays_seed") or 0) + FRESH
        fresh = passing_rays(model.lens, model.domain, _RAYS, seed, batch=BATCH)
        with torch.no_grad():
            found = model.predict(fresh.inputs.to(torch.float32)).transmittance.double()
        off = (found - fresh.transmittance).abs()
        rows.append((float(off.square().mean().sqrt()), float(off.max())))
    rms, largest = (max(column) for column in zip(*rows, strict=True))
    return {"transmittance_rms": rms, "transmittance_max": largest}
