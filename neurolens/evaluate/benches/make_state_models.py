"""Models that ship of lenses in many states: whole zooms, internal focus."""

from __future__ import annotations

import hashlib
import tempfile
import warnings
from pathlib import Path
from typing import Any

from neurolens.base.errors import NeurolensWarning
from neurolens.base.files import atomic_path
from neurolens.base.progress import Progress
from neurolens.cameras.model import load_model
from neurolens.evaluate.benches.models_list import Entry, Library
from neurolens.evaluate.candidates import model_candidate
from neurolens.evaluate.experiment import Experiment
from neurolens.evaluate.speed import race
from neurolens.evaluate.state_errors import check_states
from neurolens.evaluate.train_states import fit_and_measure_states, state_settings
from neurolens.surrogates.domain import Domain

_CHECKED = 4  # states at which a card is checked on fresh rays


def make_state_entry(
    entry: Entry, library: Library, out: Path, progress: Progress, kept: tuple[str, ...]
) -> list[dict[str, Any]]:
    """Fit, check and time the models of one lens in many states; figures are the worst over states at random.

    Args:
        kept: figures of a record that the index has.
    """
    experiment = Experiment(entry.state, entry.lens, entry.models, entry.domain, library.pairs)
    rows = []
    with warnings.catch_warnings(), tempfile.TemporaryDirectory() as scratch:
        warnings.simplefilter("ignore", NeurolensWarning)
        space = experiment.states()
        for m in entry.models:
            settings = state_settings(m, library.pairs.train, library.pairs.seed)
            with progress.stage(f"{entry.state}: {m.label}") as report:
                record = fit_and_measure_states(space, settings, Path(scratch), report=report)
            file = Path(scratch) / f"{settings.label}.onnx"
            model = load_model(file)
            with progress.stage(f"{entry.state}: check and time"):
                broken = [p.key for p in check_states(model, space, count=_CHECKED)[1] if not p.holds]
                domain = Domain.from_dict(model.card["domain"])
                candidate = model_candidate(m.label, model, domain.stop_radius_mm)
                timed = race([candidate], domain, rounds=10).timing(m.label)
            name = f"{entry.state}.{settings.label}.onnx"
            rows.append(
                {
                    "file": name,
                    "sha256": hashlib.sha256(file.read_bytes()).hexdigest(),
                    "lens": space.lens.name,
                    "configuration": entry.lens.configuration,
                    "efl_mm": None,
                    "model": settings.label,
                    "axes": [axis.to_dict() for axis in space.axes],
                    "wavelength_nm": list(domain.wavelength_nm),
                    **{key: record.get(key) for key in kept},
                    "rms_um_at_21_6": record.get("rms_um_at_21_6"),
                    "broken": broken,
                    "ns_per_ray": timed,
                    "exact_compiled_ns_per_ray": None,
                    "speedup_over_compiled": None,
                    "promised_speedup": None,
                }
            )
            with atomic_path(out / name) as temporary:
                temporary.write_bytes(file.read_bytes())
    return rows
