"""Surveys a collection of lens files: each is read, checked, fitted by default settings and measured, as one record.

A task is a file's name and its bytes, and its answer is bytes, too, the same on every machine. Whoever runs tasks
(processes here, workers elsewhere) needs no folder in common with whoever asks. Records are kept, so that a survey goes
on where it stopped. A page that sorts and filters by itself, CSV and JSON show them.
"""

import json
import math
import time
import warnings
from collections.abc import Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Executor
from contextlib import ExitStack
from dataclasses import asdict, dataclass
from hashlib import sha256
from pathlib import Path, PurePosixPath
from typing import Any

from neurolens import __version__
from neurolens.base.errors import (
    AssumedWarning,
    InputError,
    NeurolensError,
    NeurolensWarning,
    one_line,
)
from neurolens.base.files import (
    TemporaryFolder,
    atomic_path,
    fingerprint_of,
    read_bytes,
    read_kept,
    safe_name,
    write_json,
    write_kept,
)
from neurolens.base.html import html_parts
from neurolens.base.progress import Progress
from neurolens.base.report import Report, csv_text, plain
from neurolens.base.settings import LIGHT_NM
from neurolens.base.tasks import Failed, failure, run_each
from neurolens.cameras.model import load_model
from neurolens.models.fit import ModelSettings, prepare
from neurolens.models.fitted import Domain
from neurolens.models.pairs import PairSettings, make_pairs
from neurolens.models.terms import pinned_threads
from neurolens.optics.analysis.layout import thumbnail
from neurolens.optics.lens.prescription import Lens
from neurolens.optics.photographs.verify import verify
from neurolens.optics.readers.any_format import Collection, kind_of, read_any
from neurolens.optics.readers.glasses import more_glasses
from neurolens.optics.readers.source import MAX_BYTES, ReadOptions
from neurolens.optics.setting.check import check_lens
from neurolens.optics.setting.states import set_lens
from neurolens.studies.check import check_model
from neurolens.studies.describe import lens_row
from neurolens.studies.experiment import DomainChoice
from neurolens.studies.measure import CARD_KEYS, fit_and_measure, fresh_rays
from neurolens.studies.pages import DASH, Column, flat, table
from neurolens.studies.plots import layout_profile
from neurolens.studies.records import versions

SCHEMA = 1
# A lens that was read is "ok" or "doubtful"; a file that was not read is "refused", or has met a "fault" of neurolens.
VERDICTS = ("ok", "doubtful", "refused", "fault")
# What a fit should reach, on rays that it has not seen.
GOALS = {"direction_rms_deg": 0.004, "false_pass": 0.001, "false_block": 0.001}
_REASON = 600  # characters of a reason


@dataclass(frozen=True)
class SurveySettings:
    """Settings of a survey.

    Attributes:
        fit: whether lenses are fitted and measured, not only read and checked.
        terms: coefficients per vector output of the polynomials.
        rays: as many to fit as to measure; four times as many test what passes.
        seed: of the rays of the fit.
        half_field_deg: assumed, with a note, where a file gives neither rims nor field.
        verify: whether lenses are held against photographs.
    """

    fit: bool = True
    terms: int = 64
    rays: int = 30_000
    seed: int = 1
    half_field_deg: float = 15.0
    verify: bool = False


@dataclass(frozen=True)
class Task:
    """One file of a collection.

    Attributes:
        name: of the file in its folder, with "/" between parts.
        data: its bytes.
        glasses: names and bytes of further glass catalogues (.agf), whose glasses come before those that ship.
    """

    name: str
    data: bytes
    settings: SurveySettings = SurveySettings()
    glasses: tuple[tuple[str, bytes], ...] = ()

    @property
    def fingerprint(self) -> str:
        """Hash everything that decides the record."""
        files = [sha256(data).hexdigest() for data in (self.data, *(data for _, data in self.glasses))]
        return fingerprint_of([SCHEMA, __version__, self.name, asdict(self.settings), files])


def run_task(task: Task) -> bytes:
    """Make the record of one file as JSON (UTF-8), the same bytes for the same task; nothing in a file makes it raise.

    Its keys are file, fingerprint, verdict (see `VERDICTS`), reason (why a file was not read, or a lens not fitted) and
    notes (what its reader said). A lens that was read also has those of `describe.lens_row`, format, layout (SVG) and
    fit. The fit is None, or the errors of `CARD_KEYS` on fresh rays with film_radius_mm, passing, rays, promises,
    broken (promises of the card that did not hold) and reaches (whether it reaches `GOALS`).
    """
    record: dict[str, Any] = {"file": task.name, "fingerprint": task.fingerprint, "verdict": "refused", "reason": ""}
    with TemporaryFolder() as folder, ExitStack() as stack, warnings.catch_warnings(), pinned_threads():
        place = Path(folder)
        try:
            if task.glasses:
                stack.enter_context(more_glasses([_put(place / "glass", *glass) for glass in task.glasses]))
            _survey(task, _put(place / "lens", task.name, task.data), record)
        except Exception as error:
            record["verdict"] = record["verdict"] if isinstance(error, NeurolensError) else "fault"
            said = failure(error).reason.replace(f"{place}/lens/", "").replace(f"{place}/glass/", "")
            record["reason"] = one_line(said, _REASON)
    return json.dumps(plain(record), sort_keys=True, allow_nan=False).encode()


def _unread(name: str, verdict: str, reason: str) -> dict[str, Any]:
    """Make the record of a file that gave no task ("refused"), or whose task ended without a record ("fault")."""
    return {"file": name, "fingerprint": "", "verdict": verdict, "reason": one_line(reason, _REASON)}


def is_of(record: Mapping[str, Any], task: Task) -> bool:
    """Return whether a record is one of this task; a fault is none, so that it is tried again."""
    return record.get("fingerprint") == task.fingerprint and record["verdict"] in VERDICTS[:3]


def _put(folder: Path, name: str, data: bytes) -> Path:
    """Write a file of these bytes under its own name, whose suffix tells its format and which messages show."""
    folder.mkdir(exist_ok=True)
    file = folder / (PurePosixPath(name).name or "lens")
    file.write_bytes(data)
    return file


def _survey(task: Task, file: Path, record: dict[str, Any]) -> None:
    """Fill the record; an error ends this, and the entries so far stay."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", NeurolensWarning)
        lens, assumed = _read(file, task.settings)
    own = (w for w in caught if issubclass(w.category, NeurolensWarning))
    notes = {str(w.message).removeprefix(f"{file}: "): w.category for w in own}
    assumed += [note for note, kind in notes.items() if issubclass(kind, AssumedWarning)]
    record["notes"] = [note for note in notes if note not in assumed]
    record["format"] = kind_of(file)
    warnings.simplefilter("ignore", NeurolensWarning)
    record |= lens_row(lens, check_lens(lens))
    if assumed:
        record["verdict"], record["doubts"] = "doubtful", [*assumed, *record["doubts"]]
    record |= {"sha256": lens.sha256, "layout": None, "fit": None}
    if task.settings.verify:
        try:
            record["photographs"] = verify(lens).measured
        except InputError as error:
            record["notes"].append(f"no photographs: {error.field}: got {error.value}, expected {error.expected}")
    lens = set_lens(lens.with_aperture(None))
    domain = DomainChoice(focus_m=(math.inf, math.inf), wavelength_nm=LIGHT_NM).of(lens)
    if lens.half_field_deg is None and lens.image_radius_mm is None:
        film = f"a film radius of {domain.film_radius_mm:.4g} mm, where its light falls to 10%"
        record["notes"].append(f"neither field nor film is stated: taken to {film}")
    record["layout"] = thumbnail(layout_profile(lens, domain))
    if task.settings.fit:
        record["fit"] = _fit(lens, domain, task.settings, file.parent)


def _read(file: Path, settings: SurveySettings) -> tuple[Lens, list[str]]:
    """Read the lens of a file, and say what had to be assumed: a field, where neither it nor the rims are given."""
    try:
        return read_any(file), []
    except InputError as error:
        if error.field != "diameter":  # the field that `rims.with_derived_rims` misses
            raise
    half = settings.half_field_deg
    lens = read_any(file, ReadOptions(half_field_deg=half))
    return lens, [f"neither rims nor a field are given: a half field of {half:g} degrees is assumed for the rims"]


def _fit(lens: Lens, domain: Domain, settings: SurveySettings, folder: Path) -> dict[str, Any]:
    """Fit, export and measure, then measure again on rays of another seed, against the card's own promises."""
    pairs = make_pairs(lens, domain, PairSettings(settings.rays, settings.rays, settings.rays, settings.seed))
    count = 4 * settings.rays
    model = fit_and_measure(
        prepare(pairs), ModelSettings("ols", terms=settings.terms), folder, count, lambda *_: None,
        lambda: fresh_rays(lens, domain, pairs.held_out, count=count, seed=settings.seed + 1),
    )  # fmt: skip
    figures, promises = check_model(load_model(model.file), lens, rays=settings.rays)
    broken = [f"{p.key}: {p.measured:.3g}, promised {p.promised:.3g}" for p in promises if not p.holds]
    return {
        **{key: figures[key] for key in (*CARD_KEYS, "rms_um_at_21_6", "rays")},
        "film_radius_mm": domain.film_radius_mm,
        "coefficients": model.record["coefficients_per_vector"],
        "promises": len(promises),
        "broken": broken,
        "reaches": all(figures[key] is not None and figures[key] <= goal for key, goal in GOALS.items()),
    }


@dataclass(frozen=True, kw_only=True)
class Summary(Report):
    """How many files were read and fitted, and how good the fits are.

    Attributes:
        files, read: all files, and those that were read, doubtful or not.
        ok, doubtful, refused, fault: the files of each verdict.
        fitted: lenses with a fit. reach_goals: those whose fit reaches all of `GOALS`.
        promises_held: those whose fit holds all promises of its card.
        median: over the fits, of each goal's figure; a figure that is missing counts as the worst.
    """

    files: int
    read: int
    ok: int
    doubtful: int
    refused: int
    fault: int
    fitted: int
    reach_goals: int
    promises_held: int
    median: dict[str, float | None]

    def lines(self, others: Mapping[str, int]) -> list[str]:
        """Return sentences on the files that were read, refused and fitted, and on the errors of the fits.

        Args:
            others: the files that were not taken as lens files, by suffix.
        """
        lines = [f"{self.files} files: {self.read} read ({self.doubtful} of them doubtful), {self.refused} refused"]
        lines[0] += f", {self.fault} ended by a fault" if self.fault else ""
        if others:
            kinds = ", ".join(f"{count} {suffix}" for suffix, count in sorted(others.items()))
            lines.append(f"not taken as lens files: {kinds}")
        if self.fitted:
            goals = f"{GOALS['direction_rms_deg']:g} deg and {100 * GOALS['false_pass']:g}% false pass and block"
            lines.append(
                f"{self.fitted} fitted: {self.reach_goals} reach {goals}, {self.promises_held} hold all promises"
            )
            middle, angle = self.median, self.median["direction_rms_deg"]
            found = (middle[key] for key in ("false_pass", "false_block"))
            shares = [DASH if share is None else f"{100 * share:.2g}%" for share in found]
            turn = DASH if angle is None else f"{angle:.2g} deg"
            lines.append(f"medians: {turn}, false pass {shares[0]}, false block {shares[1]}")
        return lines


def summary_of(records: Sequence[Mapping[str, Any]]) -> Summary:
    """Count the records, and return shares and medians of the fits."""
    read = [r for r in records if r["verdict"] in VERDICTS[:2]]
    fits = [r["fit"] for r in read if r.get("fit")]
    counts = {verdict: sum(r["verdict"] == verdict for r in records) for verdict in VERDICTS}

    def median(key: str) -> float | None:
        values = sorted(math.inf if fit[key] is None else fit[key] for fit in fits)
        middle = values[(len(values) - 1) // 2] if values else math.inf
        return middle if math.isfinite(middle) else None

    return Summary(
        files=len(records),
        read=len(read),
        **counts,
        fitted=len(fits),
        reach_goals=sum(fit["reaches"] for fit in fits),
        promises_held=sum(not fit["broken"] for fit in fits),
        median={key: median(key) for key in GOALS},
    )


_KEPT_EVERY_S, _SHARE = 60.0, 20.0  # pages are written at most so often, and for at most 1/20 of the time
TIME_LIMIT_S = 1800.0  # for one file, far more than any lens takes


def survey(
    collection: Collection, out: Path, settings: SurveySettings, executor: Executor, progress: Progress, *,
    glasses: Sequence[tuple[str, bytes]] = (), again: bool = False,
) -> list[dict[str, Any]]:  # fmt: skip
    """Survey all files of a collection and return the records in the order of files; known records are kept.

    The executor (see `base.tasks`) runs a task for each file. The folder `out` gets records/ (one JSON for each file),
    survey.json, survey.csv and survey.html. Sections stay in their files: in memory a survey holds some tens of
    thousands of bytes for each lens.
    """
    (out / "records").mkdir(parents=True, exist_ok=True)
    found: dict[str, dict[str, Any]] = {}

    def task_of(name: str) -> Task | None:
        """Return the task of a file; where it cannot be read, its record is kept and there is none."""
        try:
            data = read_bytes(collection.folder / name, MAX_BYTES, "a lens file")
        except InputError as error:
            found[name] = _unread(name, "refused", f"{error.field}: got {error.value}, expected {error.expected}")
            return None
        return Task(name, data, settings, tuple(glasses))

    missing = []
    for name in collection.names:
        if (task := task_of(name)) is None:
            continue
        record = read_kept(_record_file(out, name))
        if again or record is None or not is_of(record, task):
            missing.append(name)
        else:
            found[name] = _without_layout(record)
    if found and missing:
        progress.note(f"{len(found)} of {len(collection.names)} files are done already")
    tasks = filter(None, map(task_of, missing))  # files are read one by one, when their turn comes

    def write() -> None:
        write_pages([found[name] for name in collection.names if name in found], collection, out, settings)

    written, spent = time.monotonic(), 0.0
    if missing:
        with progress.stage("survey") as report:
            for done, (task, data) in enumerate(run_each(executor, run_task, tasks), start=1):
                record = _unread(task.name, "fault", data.reason) if isinstance(data, Failed) else json.loads(data)
                write_kept(_record_file(out, task.name), record)
                found[task.name] = _without_layout(record)
                if record["reason"]:
                    progress.note(one_line(f"{task.name}: {record['verdict']}: {record['reason']}", 400))
                report(done / len(missing))
                if time.monotonic() - written > max(_KEPT_EVERY_S, _SHARE * spent):
                    began = time.monotonic()
                    write()
                    written = time.monotonic()
                    spent = written - began
    write()
    return [found[name] for name in collection.names]


def _record_file(out: Path, name: str) -> Path:
    return out / "records" / f"{safe_name(name)}.json"


def _without_layout(record: Mapping[str, Any]) -> dict[str, Any]:
    return {key: value for key, value in record.items() if key != "layout"}


COLUMNS = (
    Column("f (mm)", "efl_mm", digits=4, about="focal length of the table, first order"),
    Column("f-number", "f_number", about="of the stop, paraxial"),
    Column("half field (°)", "half_field_deg", about="as the file states it"),
    Column("refractions", "refractions"),
    Column("aspheres", "aspheres", about="surfaces that are no sphere, plane or cylinder"),
    Column("states", "states", about="zoom and focus states of the file; the table's own is fitted"),
    Column("distortion off (%)", "photographs.distortion_percent", about="residual of the distortion's shape "
           "beside photographs, of the image height (--verify)"),
    Column("light off (stops)", "photographs.light_widest_stops", about="the same of the light at the widest aperture"),
    Column("direction (°)", "fit.direction_rms_deg", about="angle between exact and modelled ray, root mean square "
           f"over fresh rays; goal {GOALS['direction_rms_deg']:g}"),
    Column("error (µm)", "fit.rms_um", about="distance on the film that the error makes, root mean square"),
    Column("false pass (%)", "fit.false_pass", 100, about="rays that the model passes and the lens does not; goal "
           f"{100 * GOALS['false_pass']:g}"),
    Column("false block (%)", "fit.false_block", 100, about="rays that the model blocks and the lens does not; goal "
           f"{100 * GOALS['false_block']:g}"),
)  # fmt: skip
_TEXTS = ("file", "verdict", "format", "name", "rims", "reason")
_LISTS = ("notes", "doubts")
_KINDS = {
    **dict.fromkeys(VERDICTS, ""),
    "unfitted": "read, but without a fit",
    "missed": "fitted, a goal missed",
    "broken": "a promise of the card not held",
}


def write_pages(
    records: Sequence[Mapping[str, Any]], collection: Collection, out: Path, settings: SurveySettings
) -> None:
    """Write survey.json, survey.csv and survey.html to a folder that holds the records with their sections."""
    summary = summary_of(records)
    head = {"folder": str(collection.folder), "settings": asdict(settings), "others": collection.others}
    write_json(out / "survey.json", {**head, "summary": summary.to_dict(), "versions": versions(), "lenses": records})
    pages: dict[str, Iterable[str]] = {"csv": [_csv(records)], "html": _page(records, collection, out, settings)}
    for name, parts in pages.items():
        # Names of files may be bytes that are no text.
        with (
            atomic_path(out / f"survey.{name}") as temporary,
            temporary.open("w", encoding="utf-8", errors="backslashreplace") as stream,
        ):
            stream.writelines(parts)


def _kinds(record: Mapping[str, Any]) -> list[str]:
    """Return the names of `_KINDS` that hold for a record."""
    fit, kinds = record.get("fit"), [str(record["verdict"])]
    if fit:
        kinds += ["missed"] * (not fit["reaches"]) + ["broken"] * bool(fit["broken"])
    elif record["verdict"] in VERDICTS[:2]:
        kinds.append("unfitted")
    return kinds


def _page(
    records: Sequence[Mapping[str, Any]], collection: Collection, out: Path, settings: SurveySettings
) -> Iterator[str]:
    """Yield the page in parts: a summary, then one row for each file with its section, figures and reasons."""
    kinds = [_kinds(r) for r in records]
    counts = {kind: sum(kind in each for each in kinds) for kind in _KINDS}

    def section(name: str) -> str:
        """Return the drawing of a file's record; records are read one by one."""
        return (read_kept(_record_file(out, name)) or {}).get("layout") or ""

    return html_parts(
        "survey.html",
        title=f"Survey of {collection.folder.name or collection.folder}",
        summary=summary_of(records).lines(collection.others),
        kinds=[{"name": kind, "about": about, "count": counts[kind]} for kind, about in _KINDS.items()],
        columns=table((), records, COLUMNS).columns,
        rows=(
            {"record": r, "kinds": each, "picture": section(r["file"]), "remarks": _remarks(r)}
            for r, each in zip(records, kinds, strict=True)
        ),
        about=flat({**asdict(settings), **versions()}),
    )


def _remarks(record: Mapping[str, Any]) -> list[str]:
    """Return why a file was refused, doubts, notes, and promises of the card that were not held, each once."""
    lines = [
        record["reason"],
        *record.get("doubts", ()),
        *record.get("notes", ()),
        *(f"promise not held: {b}" for b in (record.get("fit") or {}).get("broken", ())),
    ]
    return list(filter(None, dict.fromkeys(lines)))


def _csv(records: Sequence[Mapping[str, Any]]) -> str:
    """Return a row of CSV for each record: texts, then figures by their keys, then lists, with " | " between items."""
    inner = [{**(r.get("photographs") or {}), **(r.get("fit") or {})} for r in records]
    keys = sorted({key for found in inner for key, v in found.items() if not isinstance(v, list | dict)})
    plain = [c.key for c in COLUMNS if "." not in c.key]
    rows = []
    for r, found in zip(records, inner, strict=True):
        row = {key: r.get(key, "") for key in _TEXTS} | {key: r.get(key) for key in plain}
        lists = {key: r.get(key) or () for key in _LISTS} | {"broken": found.get("broken", ())}
        rows.append(row | {key: found.get(key) for key in keys} | {key: " | ".join(v) for key, v in lists.items()})
    return csv_text(rows)
