"""A collection of lens files: each read, checked, fitted by default settings and measured, as one record.

A task is a file's name and its bytes, and its answer is bytes, too, the same on every machine: whoever runs tasks
(processes here, workers elsewhere) needs no folder in common with whoever asks.
"""

from __future__ import annotations

import json
import math
import traceback
import warnings
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import asdict, dataclass
from hashlib import sha256
from pathlib import Path, PurePosixPath
from typing import Any

from neurolens import __version__
from neurolens.analysis.layout import thumbnail
from neurolens.base.errors import AssumedWarning, InputError, NeurolensError, NeurolensWarning, one_line
from neurolens.base.files import TemporaryFolder, fingerprint_of
from neurolens.base.records import plain
from neurolens.cameras.model import load_model
from neurolens.lens.prescription import Lens
from neurolens.readers.any_format import kind_of, read_any
from neurolens.readers.draft import ReadOptions
from neurolens.readers.glasses import more_glasses
from neurolens.setting.check import check_lens
from neurolens.setting.states import set_lens
from neurolens.study.check import check_model
from neurolens.study.describe import layout_profile, lens_row
from neurolens.study.experiment import DomainChoice
from neurolens.study.measure import CARD_KEYS, fit_and_measure, fresh_rays
from neurolens.surrogates.fit import ModelSettings, prepare
from neurolens.surrogates.model import Domain
from neurolens.surrogates.pairs import PairSettings, make_pairs
from neurolens.surrogates.terms import pinned_threads

SCHEMA = 1
# What a lens that was read is: "ok", or "doubtful"; what was not: "refused" by name, or a "fault" of neurolens.
VERDICTS = ("ok", "doubtful", "refused", "fault")
# Goals of the fit, on rays that it has not seen.
GOALS = {"direction_rms_deg": 0.004, "false_pass": 0.001, "false_block": 0.001}
_REASON = 600  # characters
_WAVELENGTHS_NM = (400.0, 700.0)


@dataclass(frozen=True)
class SurveySettings:
    """How lenses are surveyed.

    Attributes:
        fit: whether lenses are fitted and measured, not only read and checked.
        terms: coefficients per vector output of the polynomials.
        rays: to fit, and to measure; four times as many test what passes.
        seed: of the rays of the fit.
        half_field_deg: assumed, with a note, where a file gives neither rims nor field.
    """

    fit: bool = True
    terms: int = 64
    rays: int = 30_000
    seed: int = 1
    half_field_deg: float = 15.0


@dataclass(frozen=True)
class Task:
    """One file of a collection.

    Attributes:
        name: of the file in its folder, with "/" between its parts.
        data: its bytes.
        glasses: names and bytes of further glass catalogues (.agf), which come before those that ship.
    """

    name: str
    data: bytes
    settings: SurveySettings = SurveySettings()
    glasses: tuple[tuple[str, bytes], ...] = ()

    @property
    def fingerprint(self) -> str:
        """Hash of all that decides the record."""
        files = [sha256(data).hexdigest() for data in (self.data, *(data for _, data in self.glasses))]
        return fingerprint_of([SCHEMA, __version__, self.name, asdict(self.settings), files])


def run_task(task: Task) -> bytes:
    """The record of one file as JSON (UTF-8), the same bytes for the same task; never raises for what is in the file.

    Keys: file, fingerprint, verdict (see `VERDICTS`), reason (of a file that was not read, or a lens not fitted), notes
    (what its reader said), and of a lens that was read those of `describe.lens_row`, format, layout (SVG) and fit:
    None, or the errors of `CARD_KEYS` on fresh rays with film_radius_mm, passing, rays, promises, broken (those of the
    card that did not hold) and reaches (whether `GOALS` are).
    """
    record: dict[str, Any] = {"file": task.name, "fingerprint": task.fingerprint, "verdict": "refused", "reason": ""}
    with TemporaryFolder() as folder, ExitStack() as stack:
        stack.enter_context(warnings.catch_warnings())
        stack.enter_context(pinned_threads())
        place = Path(folder)
        try:
            if task.glasses:
                stack.enter_context(more_glasses([_put(place / "glass", *glass) for glass in task.glasses]))
            _survey(task, _put(place / "lens", task.name, task.data), record)
        except Exception as error:
            known = isinstance(error, NeurolensError)
            record["verdict"] = record["verdict"] if known else "fault"
            record["reason"] = _reason(error).replace(f"{place}/lens/", "").replace(f"{place}/glass/", "")
    return json.dumps(plain(record), sort_keys=True, allow_nan=False).encode()


def unread_record(name: str, verdict: str, reason: str, fingerprint: str = "") -> bytes:
    """The record of a file of which no task could be made ("refused"), or whose task ended without one ("fault")."""
    record = {"file": name, "fingerprint": fingerprint, "verdict": verdict, "reason": one_line(reason, _REASON)}
    return json.dumps(record, sort_keys=True).encode()


def is_of(record: Mapping[str, Any], task: Task) -> bool:
    """Whether a record is one of this task. A fault is none: it is tried again."""
    return record.get("fingerprint") == task.fingerprint and record["verdict"] in VERDICTS[:3]


def _put(folder: Path, name: str, data: bytes) -> Path:
    """A file of these bytes under its own last name, by which formats are told and messages speak."""
    folder.mkdir(exist_ok=True)
    file = folder / (PurePosixPath(name).name or "lens")
    file.write_bytes(data)
    return file


def _reason(error: Exception) -> str:
    if isinstance(error, NeurolensError):
        return one_line(str(error), _REASON)
    frame = traceback.extract_tb(error.__traceback__)[-1]
    return one_line(f"{type(error).__name__}: {error} ({Path(frame.filename).name}:{frame.lineno})", _REASON)


def _survey(task: Task, file: Path, record: dict[str, Any]) -> None:
    """Fill the record; what was found before an error stays."""
    with warnings.catch_warnings(record=True) as heard:
        warnings.simplefilter("always", NeurolensWarning)
        lens, assumed = _read(file, task.settings)
    notes: dict[str, type[Warning]] = {
        str(w.message).removeprefix(f"{file}: "): w.category for w in heard if issubclass(w.category, NeurolensWarning)
    }
    assumed += [note for note, kind in notes.items() if issubclass(kind, AssumedWarning)]
    record["notes"] = [note for note in notes if note not in assumed]
    record["format"] = kind_of(file)
    warnings.simplefilter("ignore", NeurolensWarning)
    record |= lens_row(lens, check_lens(lens))
    if assumed:
        record["verdict"], record["doubts"] = "doubtful", [*assumed, *record["doubts"]]
    record |= {"sha256": lens.sha256, "layout": None, "fit": None}
    lens = set_lens(lens.with_aperture(None))
    domain = DomainChoice(focus_m=(math.inf, math.inf), wavelength_nm=_WAVELENGTHS_NM).of(lens)
    if lens.half_field_deg is None and lens.image_radius_mm is None:
        found = f"a film radius of {domain.film_radius_mm:.4g} mm, where its light falls to 10%"
        record["notes"].append(f"neither field nor film is stated: taken to {found}")
    record["layout"] = thumbnail(layout_profile(lens, domain))
    if task.settings.fit:
        record["fit"] = _fit(lens, domain, task.settings, file.parent)


def _read(file: Path, settings: SurveySettings) -> tuple[Lens, list[str]]:
    """The lens of a file, and what had to be assumed: a field, where neither it nor the rims are given."""
    try:
        return read_any(file), []
    except InputError as error:
        if error.field != "diameter":  # as `rims.with_derived_rims` names a missing field
            raise
    half = settings.half_field_deg
    lens = read_any(file, ReadOptions(half_field_deg=half))
    return lens, [f"neither rims nor a field are given: a half field of {half:g} degrees is assumed for the rims"]


def _fit(lens: Lens, domain: Domain, settings: SurveySettings, folder: Path) -> dict[str, Any]:
    """Fit, export and measure; then measure again on rays of another seed, against the card's own promises."""
    pairs = make_pairs(lens, domain, PairSettings(settings.rays, settings.rays, settings.rays, settings.seed))
    count, seed = 4 * settings.rays, settings.seed + 1

    def rays() -> Any:
        return fresh_rays(lens, domain, pairs.held_out, count=count, seed=seed)

    model = ModelSettings("ols", terms=settings.terms)
    made = fit_and_measure(prepare(pairs), model, folder, count, lambda *_: None, rays)
    figures, promises = check_model(load_model(made.file), lens, rays=settings.rays)
    found = {key: figures[key] for key in (*CARD_KEYS, "rms_um_at_21_6", "rays")}
    broken = [f"{p.key}: {p.measured:.3g}, promised {p.promised:.3g}" for p in promises if not p.holds]
    return {
        **found,
        "film_radius_mm": domain.film_radius_mm,
        "coefficients": made.record["coefficients_per_vector"],
        "promises": len(promises),
        "broken": broken,
        "reaches": reaches_goals(found),
    }


def reaches_goals(found: Mapping[str, Any]) -> bool:
    """Whether measured errors reach `GOALS`; one that is missing does not."""
    return all(found.get(key) is not None and found[key] <= goal for key, goal in GOALS.items())


def summary_of(records: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Counts over the records, and shares and medians of the fits."""
    read = [r for r in records if r["verdict"] in VERDICTS[:2]]
    fits = [r["fit"] for r in read if r.get("fit")]
    counts = {verdict: sum(r["verdict"] == verdict for r in records) for verdict in VERDICTS}

    def median(key: str) -> float | None:
        values = sorted(math.inf if fit[key] is None else fit[key] for fit in fits)
        middle = values[(len(values) - 1) // 2] if values else math.inf
        return middle if math.isfinite(middle) else None

    return {
        "files": len(records),
        "read": len(read),
        **counts,
        "fitted": len(fits),
        "reach_goals": sum(fit["reaches"] for fit in fits),
        "promises_held": sum(not fit["broken"] for fit in fits),
        "median": {key: median(key) for key in GOALS},
    }
