"""Fits the transmittance of model files again, where the coatings or the glass of their lenses are others now."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch

from neurolens.base.errors import InputError
from neurolens.models.axes import product
from neurolens.models.export import export_onnx, export_states
from neurolens.models.file import as_stored, read_model
from neurolens.models.fit import StateModel, StateSpace
from neurolens.models.model import LensModel
from neurolens.models.pairs import passing_rays
from neurolens.models.targets import TRANSMITTANCE_TERMS
from neurolens.models.transmittance import with_transmittance
from neurolens.optics.lens.prescription import Lens
from neurolens.studies.check import random_states
from neurolens.studies.measure import FRESH

_RAYS, _STATES = 6000, 4  # fresh rays of a state on which errors are measured, and states
# Rays of a fit: in all, at least of each node, and traced at a time, for few more are needed than pass.
_FIT_RAYS, _FEWEST_RAYS, _BATCH = 8000, 2000, 5000


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
        fresh = passing_rays(model.lens, model.domain, _RAYS, seed, batch=_BATCH)
        with torch.no_grad():
            found = model.predict(fresh.inputs.to(torch.float32)).transmittance.double()
        off = (found - fresh.transmittance).abs()
        rows.append((float(off.square().mean().sqrt()), float(off.max())))
    rms, largest = (max(column) for column in zip(*rows, strict=True))
    return {"transmittance_rms": rms, "transmittance_max": largest}


def refitted(models: Sequence[LensModel], lenses: Sequence[Lens], most: int) -> list[LensModel]:
    """Return models with the transmittance of other lenses, which may differ in coatings and absorption alone.

    Position, direction, stop crossing and gates keep their coefficients to the bit.

    Args:
        models: one model, or the nodes of one of many states; files keep the lens of the first only.
        lenses: one for each model.
        most: terms of the transmittance, at most.

    Raises:
        InputError: a lens whose rays go another way.
    """
    if not _same_ways(models[0].lens, lenses[0]):
        expected = "the model's own but for coatings and absorption"
        raise InputError(lenses[0].path, "surfaces", f"(another lens than {models[0].lens.path})", expected)
    samples, found = [], []
    for model, lens in zip(models, lenses, strict=True):
        seed = int(model.settings.get("rays_seed") or 0)
        passing = passing_rays(lens, model.domain, max(_FIT_RAYS // len(models), _FEWEST_RAYS), seed, batch=_BATCH)
        samples.append((passing.inputs, passing.transmittance))
        found.append(replace(model, lens=lens, settings={**model.settings, "transmittance_terms": most}))
    return with_transmittance(found, samples, most)


def _same_ways(a: Lens, b: Lens) -> bool:
    """Test whether rays go the same ways through two lenses."""
    bare = (
        replace(x, surfaces=tuple(replace(s, coating=None, absorption_per_mm=0.0) for s in x.surfaces)) for x in (a, b)
    )
    return len({one.sha256 for one in bare}) == 1
