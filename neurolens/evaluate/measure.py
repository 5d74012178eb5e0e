"""Fits, exports and measures the models of an experiment; a model already in the run folder is not fitted again."""

from __future__ import annotations

import hashlib
import json
import time
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from neurolens import __version__
from neurolens.base.files import atomic_write_text
from neurolens.base.progress import Report
from neurolens.cameras.model import OnnxLens, load_model
from neurolens.evaluate import fresh
from neurolens.evaluate.fresh import FreshRays, fresh_rays, with_more
from neurolens.evaluate.rays import PIXELS_ACROSS, ray_errors
from neurolens.optics.prescription import Lens
from neurolens.optics.surfaces import Rays
from neurolens.surrogates.domain import Domain, FilmRays
from neurolens.surrogates.export import export_onnx
from neurolens.surrogates.fit import NETWORKS, ModelSettings, Prepared, fit_model
from neurolens.surrogates.fits import checkpoint
from neurolens.surrogates.model import LensModel, Prediction
from neurolens.surrogates.pairs import PairSet

# Keys of the ray and vignetting errors that a model's card promises and its record shows.
CARD_KEYS = tuple(
    "rms_um p99_um max_um rms_infinity_um rms_px direction_rms_deg position_rms_um transmittance_rms transmittance_max "
    "false_pass false_block false_pass_near_rim false_block_near_rim".split()
)
# Worth a word: false passes or blocks beyond this share, an RMS error beyond so many pixels of 4000 across.
POOR_SHARE, POOR_PX = 0.01, 1.0
# Added to the seed of the fit's rays: the same seed would give the very rays that the rims were fitted to.
FRESH = 104729


@dataclass(frozen=True)
class Measured:
    """One model: its settings, the exported file, its record for `results.json`."""

    settings: ModelSettings
    file: Path
    record: dict[str, Any]


def onnx_predictor(model: OnnxLens) -> Any:
    """An exported model as `rays` and `vignetting` want it: film rays and a stop radius in, `Prediction` out."""

    def predict(rays: FilmRays, stop_radius_mm: float | None = None) -> Prediction:
        columns = [np.ascontiguousarray(c.numpy(), dtype=np.float32) for c in rays.columns()]
        film, pupil = np.stack(columns[0:2]), np.stack(columns[3:5])
        out = model.rays(film, pupil, columns[5], columns[2], stop_radius_mm)
        x, y, z, dx, dy, dz = torch.from_numpy(out.scene_ray)
        stop_x, stop_y = torch.from_numpy(out.stop_xy_mm)
        power, status = torch.from_numpy(out.transmittance), torch.from_numpy(out.status)
        return Prediction(Rays(x, y, z, dx, dy, dz), power, stop_x, stop_y, status)

    return predict


def measure_errors(
    model: OnnxLens, lens: Lens, domain: Domain, held_out: PairSet, vignetting_rays: int, seed: int
) -> dict[str, Any]:
    """Errors of an exported model on held-out rays, as a card holds them; keys with units, what is not finite as None.

    `seed` is of the rays that test the vignetting; it must not be that of the fit's pairs.
    """
    rays = fresh_rays(lens, domain, held_out, count=vignetting_rays, seed=seed)
    return measure_on(rays, model)


def shared_rays(prepared: Prepared, vignetting_rays: int) -> FreshRays:
    """The rays on which all models of one lens and domain are measured: many, for a card's errors are to be found
    again on others, and a few bad rays, one in ten thousand, may decide them.
    """
    pairs = prepared.pairs
    seed = pairs.settings.seed + FRESH
    rays = fresh_rays(pairs.lens, pairs.domain, pairs.held_out, count=vignetting_rays, seed=seed)
    return with_more(rays, seed)


def measure_on(rays: FreshRays, model: OnnxLens) -> dict[str, Any]:
    """The same on rays that several models share."""
    errors = fresh.measure(rays, onnx_predictor(model)).errors(CARD_KEYS)
    return {**errors, "poor": what_is_poor(errors), "rays": len(rays.held_out), "passing": int(rays.passes.sum())}


def what_is_poor(errors: Mapping[str, Any]) -> list[str]:
    """What of a model's errors shows in a picture, for its card and its maker: true promises that few would want."""
    said = [
        f"{key.replace('_', ' ')} {100 * errors[key]:.2g}%"
        for key in ("false_pass", "false_block")
        if (errors.get(key) or 0.0) > POOR_SHARE
    ]
    pixels = errors.get("rms_px") or 0.0
    return [*said, f"RMS error {pixels:.2g} pixels of a picture {PIXELS_ACROSS} wide"] if pixels > POOR_PX else said


def fit_and_measure(
    prepared: Prepared,
    settings: ModelSettings,
    folder: Path,
    vignetting_rays: int,
    report: Report,
    rays: Callable[[], FreshRays] | None = None,
) -> Measured:
    """Fit, export and measure one model, or take what the folder holds if it was made by the same settings and version.

    `rays`, where several models share them, gives `shared_rays(prepared, vignetting_rays)`.

    The errors are those of the exported float32 graph, in onnxruntime: what ships is what is measured.
    """
    file, note = folder / f"{settings.label}.onnx", folder / f"{settings.label}.json"
    fingerprint = _fingerprint(prepared, settings, vignetting_rays)
    known = known_record(note, file, fingerprint)
    if known is not None:
        return Measured(settings, file, known)
    training = folder / f"{settings.label}.training.npz"  # what a killed run left
    model = fit_model(prepared, settings, report, checkpoint=training, error_um=_error_um(prepared))
    export_onnx(model, file, errors={})
    on = rays() if rays else shared_rays(prepared, vignetting_rays)
    errors = measure_on(on, load_model(file))
    export_onnx(model, file, errors=errors)
    start = time.perf_counter()
    load_model(file)
    load_s = time.perf_counter() - start
    network = settings.method in NETWORKS
    record: dict[str, Any] = {
        "name": settings.label,
        "family": settings.family,
        "variables": settings.basis,
        "file": f"models/{file.name}",
        **errors,
        "coefficients_per_vector": None if network else model.core.coefficients_per_vector,
        "parameters": model.core.coefficients,
        "bytes": file.stat().st_size,
        "fit_s": model.fit_s,
        "load_s": load_s,
    }
    note_record(note, file, fingerprint, record)
    checkpoint.clear(training)
    return Measured(settings, file, record)


def _error_um(prepared: Prepared) -> Callable[[LensModel], float]:
    """Film-equivalent RMS of models, as their cards will give it."""
    pairs = prepared.pairs
    return lambda model: ray_errors(pairs.lens, pairs.domain, pairs.held_out, model.predict)["rms_um"]


def _fingerprint(prepared: Prepared, settings: ModelSettings, vignetting_rays: int) -> str:
    pairs = prepared.pairs
    asked = [
        __version__,
        pairs.lens.sha256,
        pairs.domain.to_dict(),
        asdict(pairs.settings),
        asdict(settings),
        vignetting_rays,
    ]
    return hashlib.sha256(json.dumps(asked, sort_keys=True).encode()).hexdigest()


def _sha256(file: Path) -> str:
    return hashlib.sha256(file.read_bytes()).hexdigest()


def note_record(note: Path, file: Path, fingerprint: str, record: dict[str, Any]) -> None:
    """Leave the record of a finished fit beside its model, for `known_record`."""
    made = {"fingerprint": fingerprint, "sha256": _sha256(file), "record": record}
    atomic_write_text(note, json.dumps(made, indent=1, allow_nan=False))


def known_record(note: Path, file: Path, fingerprint: str) -> dict[str, Any] | None:
    """The record of an earlier, finished fit of the very same settings, whose model is still as it was written."""
    try:
        data = json.loads(note.read_text(encoding="utf-8"))
        same = data["fingerprint"] == fingerprint and data["sha256"] == _sha256(file)
        return data["record"] if same else None
    except (OSError, ValueError, KeyError, TypeError):
        return None
