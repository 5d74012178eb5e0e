"""Fit, check on fresh rays and time the models that experiments/data/models.toml lists (`make models`).

Entry by entry the files are written, then the index (index.json for programs, README.md for people). Models of the same
settings and version are kept: an interrupted run resumes where it stopped.
Exit code 1 where a lens could not be done or a card does not hold.
"""

from __future__ import annotations

import argparse
import functools
import json
import os
import re
import statistics
import sys
import tempfile
import warnings
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from experiments import lab
from experiments.data.refit import refit_transmittance
from experiments.lab import Row
from experiments.speed.promises import read_index
from neurolens import __version__
from neurolens.base.errors import InputError, NeurolensError, NeurolensWarning
from neurolens.base.files import atomic_path, atomic_write_text, fingerprint_of, sha256_of, write_json
from neurolens.base.find import read_index as read_lenses
from neurolens.base.progress import Progress
from neurolens.base.settings import LIGHT_NM, RANGE, read_config
from neurolens.cameras.model import load_model
from neurolens.models.fit import NETWORKS, ModelSettings, prepare
from neurolens.models.fitted import Domain
from neurolens.models.pairs import PairSettings, make_pairs
from neurolens.models.targets import TRANSMITTANCE_TERMS
from neurolens.models.transmittance import MOST_W
from neurolens.optics.lens.glass import absorption_of
from neurolens.optics.lens.prescription import Lens
from neurolens.optics.readers.any_format import lens_files
from neurolens.optics.setting.pupils import image_radius_mm
from neurolens.studies.check import check_model, check_states
from neurolens.studies.experiment import DomainChoice, Experiment, LensChoice, check_names
from neurolens.studies.measure import Measured, fit_and_measure, shared_rays
from neurolens.studies.rays import REFERENCE_RADIUS_MM
from neurolens.studies.records import versions
from neurolens.studies.speed import EXACT, exact_c_candidate, model_candidate, model_candidates, race
from neurolens.studies.train import fit_and_measure_states, state_settings

_LIST = lab.ROOT / "experiments" / "data" / "models.toml"


def _default_models() -> tuple[ModelSettings, ...]:
    return ModelSettings("ols", terms=100), ModelSettings("mlp", units=32, steps=150)


@dataclass(frozen=True)
class Entry:
    """One lens in one state and the settings of its models.

    Attributes:
        best: keep the best polynomial and the best network only; else all.
        promise: whether the index promises a speed-up, to which `make bench` holds the models.
    """

    lens: LensChoice
    domain: DomainChoice = field(default_factory=DomainChoice)
    models: tuple[ModelSettings, ...] = field(default_factory=_default_models)
    best: bool = False
    promise: bool = True

    def __post_init__(self) -> None:
        check_names("lens", [self.state])
        check_names("models", [m.label for m in self.models])

    @property
    def state(self) -> str:
        """Name of the lens and its state, as model files carry it."""
        c = self.lens
        size = f"{c.focal_length_mm:g}mm" if c.focal_length_mm else ""
        parts = [c.file.stem, str(c.state or ""), size, RANGE if c.zoom == RANGE else ""]
        parts += ["internal"] if c.focus_mode == "internal" else []
        return "-".join(p for p in parts if p)

    def file(self, settings: ModelSettings) -> str:
        """Name of the file of a model."""
        return f"{self.state}.{settings.label}.onnx"


@dataclass(frozen=True)
class More:
    """Models that some lenses of a folder have besides those of all, by the names of their files."""

    lenses: tuple[str, ...]
    models: tuple[ModelSettings, ...]


@dataclass(frozen=True)
class WholeFolder:
    """Every lens file of a folder in its default state, unless an entry has it: best polynomial, best network.

    Attributes:
        certain: of lenses by name only those of this collection that certainly agree with photographs of the product,
            and those in `more`; `neurolens train` fits the others where somebody asks for them.
    """

    folder: Path
    certain: str = ""
    models: tuple[ModelSettings, ...] = field(default_factory=_default_models)
    more: More | None = None

    def entries(self, root: Path, named: Collection[str]) -> Iterator[Entry]:
        """The lenses of the folder that `named` does not have.

        Raises:
            InputError: a lens with more models that the folder does not have.
        """
        more, rows = self.more or More((), ()), read_lenses()

        def kept(file: Path) -> bool:
            collection, row = lab.of_collection(file), rows.get(file.name, {"row": {}})["row"]
            certain = collection == self.certain and row.get("match") == "certain"
            return certain or not collection or file.stem in more.lenses

        files = [file for file in lens_files(root / self.folder) if not self.certain or kept(file)]
        unknown = {*more.lenses} - {file.stem for file in files}
        if unknown:
            raise InputError("settings", "lenses.more.lenses", sorted(unknown), f"names of lens files of {self.folder}")
        for file in files:
            if file.stem not in named:
                models = self.models + (more.models if file.stem in more.lenses else ())
                yield Entry(LensChoice(file), models=models, best=True, promise=False)


@dataclass(frozen=True)
class Library:
    """All entries, the ray pairs of each, whether models are timed, and in how many rounds.

    Models that are not timed keep the times of those of their name before.
    """

    entry: tuple[Entry, ...] = ()
    lenses: WholeFolder | None = None
    pairs: PairSettings = field(default_factory=PairSettings)
    timed: bool = True
    rounds: int = 20

    def __post_init__(self) -> None:
        files = [e.file(m) for e in self.entry for m in e.models]
        twice = sorted({f for f in files if files.count(f) > 1})
        if not (files or self.lenses) or twice:
            raise InputError("settings", "entry", twice or "(none)", "at least one model, each of a file of its own")


def read_list(path: str | Path) -> Library:
    """The list of a file, with every lens of its folder as an entry; files lie relative to the list.

    Raises:
        InputError: as `settings.read_config`; no such folder of lenses; a file that two entries would write.
    """
    library, folder = read_config(Library, path), Path(path).parent
    entries = [replace(e, lens=replace(e.lens, file=folder / e.lens.file)) for e in library.entry]
    if library.lenses is not None:
        entries += library.lenses.entries(folder, {e.state for e in entries})
    return replace(library, entry=tuple(entries), lenses=None)


def chosen(library: Library, names: Sequence[str]) -> tuple[Entry, ...]:
    """The entries whose state starts with one of the names; all without names.

    Raises:
        InputError: a name that no entry has.
    """
    for name in names:
        if not any(e.state.startswith(name) for e in library.entry):
            known = ", ".join(dict.fromkeys(e.state for e in library.entry))
            raise InputError("experiments models", "LENS", name, f"the start of one of: {known}")
    return tuple(e for e in library.entry if not names or any(e.state.startswith(n) for n in names))


_HEAD = """# Models that ship

`python -m experiments models` made these models from experiments/data/models.toml. The 38 historical lenses, and
lenses of OpticsDatabase that photographs certainly confirm, have the best polynomial of at most 64 coefficients per
vector output; `neurolens train` fits any other lens in a minute. The historical lenses and 36 by name also have the
best network of two layers of 16 units, after 600 iterations. A few lenses have faster models, too. A model holds for
the whole lit film, the full aperture, focus from infinity to near, and all wavelengths for which the glasses are
known. It focuses by moving the whole lens, also where the lens file moves groups: `--focus-mode best` sets the exact
lens so.

- **Errors** are those of held-out rays (`neurolens.studies.rays`), in micrometres at an image radius of 21.6 mm.
  Every card was checked on fresh rays. `neurolens evaluate models/FILE` checks a model again.
- **T RMS** is the error of the transmittance of the coated lens, whose coatings the card names. `--transmittance`
  fits it again where coatings or glass are others now.
- **Times** are ns a ray on one core, in onnxruntime and as C compiled here, with stop, rims and transmittance. "–"
  was not timed. `--times` takes them again.
- **Speed-up** is that of the model as C over the exact coated lens as C, doing the same work in the same run.
  `make bench` holds the models of the first lenses to the speed-ups that the index promises."""


def _reference(key: str) -> Callable[[Row], Any]:
    """A figure at the reference radius, where a row has it."""
    return lambda r: r.get(f"{key}_at_21_6", r.get(key))


def _shares(row: Row) -> str:
    """False passes and blocks in percent."""
    return " / ".join("–" if (v := row[k]) is None else f"{100 * v:.3g}" for k in ("false_pass", "false_block"))


_COLUMNS = lab.columns(
    ("model", lambda r: r["file"] + (" (card does not hold)" if r.get("broken") else "")),
    ("RMS um", _reference("rms_um"), ".3g"),
    ("p99 um", _reference("p99_um"), ".3g"),
    ("direction deg", "direction_rms_deg", ".3g"),
    ("position um", _reference("position_rms_um"), ".3g"),
    ("T RMS", "transmittance_rms", ".3g"),
    ("false pass / block %", _shares),
    ("coefficients", lambda r: r["coefficients_per_vector"] or r["parameters"]),
    ("kB", "bytes", ".0f", 1e-3),
    ("ns per ray", "ns_per_ray.min", ".3g"),
    ("as C", "fused_ns_per_ray.min", ".3g"),
    ("speed-up", "speedup_as_c", ".3g"),
)


_NAMED = "lenses by name"
# Kinds of the other lenses besides round photographic ones, by words in their names.
_OTHERS = {"anamorphic lenses": "anamorphic", "single elements": "edmund|thorlabs"}


def errors_by_kind(rows: Sequence[Row], model: str) -> dict[str, list[float]]:
    """RMS errors (um on each lens's own film) of a model, by kind of lens; each lens once, as its file has it."""
    found: dict[str, list[float]] = {"round photographic lenses": [], **{kind: [] for kind in _OTHERS}, _NAMED: []}
    named = {file.stem for file in lab.LENSES.glob("*.toml")} - {file.stem for file in lab.historical()}
    for row in rows:
        if row["model"] == model and row["rms_um"] is not None and row["entry"] == Path(row["lens_file"]).stem:
            kinds = [_NAMED] if row["entry"] in named else []
            kinds += [kind for kind, words in _OTHERS.items() if re.search(words, row["entry"])]
            found[kinds[0] if kinds else "round photographic lenses"].append(row["rms_um"])
    return found


def _summary(rows: Sequence[Row], model: str) -> str:
    """One line a kind of lens: number, median and range."""
    kinds = ((k, v) for k, v in errors_by_kind(rows, model).items() if v)
    parts = [f"{len(v)} {k} {statistics.median(v):.3g} ({min(v):.3g} to {max(v):.3g})" for k, v in kinds]
    return f"RMS error of {model} on each lens's own film in um, median (range): {', '.join(parts)}." if parts else ""


def write_index(rows: Sequence[Row], left_out: Mapping[str, str], out: Path) -> None:
    """Write index.json and README.md; `left_out` gives the reason for each entry that has no models."""
    index = {"schema": 2, "command": "python -m experiments models", "versions": versions()}
    write_json(out / "index.json", index | {"models": list(rows), "left_out": dict(left_out)})
    reasons = "\n".join(f"- {state}: {reason}" for state, reason in left_out.items())
    parts = [line for model in ("mlp-16x2", "ols-64") if (line := _summary(rows, model))]
    parts += ["Not made:", reasons] if left_out else []
    atomic_write_text(out / "README.md", lab.page(_HEAD, lab.table(_COLUMNS, rows, "–"), *parts))


# The bench fails below this share of the speed-up measured here: machines and days differ, regressions differ more.
PROMISE = 0.8
_VIGNETTING_RAYS = 200_000
_KEPT = tuple(
    "rms_um p99_um direction_rms_deg position_rms_um transmittance_rms false_pass false_block "
    "coefficients_per_vector parameters bytes fit_s".split()
)


def make_models(
    library: Library, entries: Sequence[Entry], out: Path, progress: Progress, *, again: bool = False
) -> list[str]:
    """Make missing models of some entries; returns failures and promises that do not hold, as sentences.

    The index is complete at any time: rows are replaced one entry at a time, and rows of entries that the library no
    longer has are removed once the whole library is done.
    """
    known, left_out = _known(out)
    todo = [e for e in entries if again or not _stands(e, library.pairs, known, out)]
    for entry in todo:
        progress.plan({f"{entry.state}: {m.label}": 40.0 if m.method in NETWORKS else 10.0 for m in entry.models})
        progress.plan({f"{entry.state}: race": 60.0} if library.timed else {})
    for entry in todo:
        made, reason = list[Row](), ""
        try:
            made = make_entry(entry, library, out, progress)
        except NeurolensError as error:
            reason = " ".join(str(error).split())
        known, left_out = _known(out)  # anew: another process may have made other entries meanwhile
        left_out = {k: v for k, v in left_out.items() if k != entry.state} | ({entry.state: reason} if reason else {})
        _keep([*(row for row in known if row["entry"] != entry.state), *made], left_out, library, out, before=known)
    known, left_out = _known(out)
    states = {e.state for e in library.entry}
    if {e.state for e in entries} < states:
        states |= {*left_out, *(row["entry"] for row in known)}
    left_out = {state: reason for state, reason in left_out.items() if state in states}
    known = _keep([row for row in known if row["entry"] in states], left_out, library, out, before=known)
    broken = [f"{row['file']}: does not hold: {', '.join(row['broken'])}" for row in known if row.get("broken")]
    return [*(f"{state}: left out: {reason}" for state, reason in left_out.items()), *broken]


def _keep(
    rows: Sequence[Row], left_out: Mapping[str, str], library: Library, out: Path, before: Sequence[Row] = ()
) -> list[Row]:
    """Write the index in the order of the list, others last, and remove files that only rows from `before` have."""
    for file in {row["file"] for row in before} - {row["file"] for row in rows}:
        (out / file).unlink(missing_ok=True)
    place = {entry.state: i for i, entry in enumerate(library.entry)}
    rows = sorted(rows, key=lambda row: place.get(row["entry"], len(place)))
    write_index(rows, left_out, out)
    return rows


def _known(out: Path) -> tuple[list[Row], dict[str, str]]:
    """Rows and left-out entries of an existing index; empty for an unreadable one, which is replaced."""
    try:
        rows = [row for row in read_index(out) if row.keys() >= {*_KEPT, "entry", "ns_per_ray"}]
        left_out = json.loads((out / "index.json").read_text(encoding="utf-8")).get("left_out", {})
    except (InputError, OSError, ValueError):
        return [], {}
    return rows, dict(left_out)


def fingerprint(entry: Entry, pairs: PairSettings) -> str:
    """Hash of everything that decides the rays of the models of an entry; `transmittance_mark` covers their light.

    Settings count where they are not the default, so that a new setting changes no hash.

    Raises:
        InputError: a lens that cannot be read.
    """
    c, lens = entry.lens, entry.lens.read()
    glass = [lens.sha256, lens.stop_radius_mm, lens.image_radius_mm]
    zoom = RANGE if c.zoom == RANGE else None
    state = [*glass, c.focal_length_mm, c.state, c.f_number, zoom, c.focus_mode]
    plain, light = asdict(ModelSettings()), "transmittance_terms"
    models = [{k: v for k, v in asdict(m).items() if v != plain[k] and k != light} for m in entry.models]
    return fingerprint_of([__version__, state, asdict(entry.domain), models, entry.best, asdict(pairs)])


def _stands(entry: Entry, pairs: PairSettings, known: Sequence[Row], out: Path) -> bool:
    """Whether the models of an entry exist unchanged, made by the same settings and version."""
    mine = [row for row in known if row["entry"] == entry.state]
    try:
        mark = fingerprint(entry, pairs)
        return bool(mine) and all(
            r.get("fingerprint") == mark and r["sha256"] == sha256_of(out / r["file"]) for r in mine
        )
    except (NeurolensError, OSError):
        return False


def transmittance_mark(lens: Lens) -> str:
    """Hash of everything that decides the transmittance of a lens's models: coatings, glass, and how it is fitted."""
    light = np.linspace(*LIGHT_NM, 7)
    absorbed = [absorption_of(surface, light) for surface in lens.surfaces]
    glass = [None if a is None else np.round(np.broadcast_to(a, light.shape), 9).tolist() for a in absorbed]
    films = [s.coating and s.coating.layers for s in lens.surfaces]  # those that are assumed, too
    return fingerprint_of([lens.sha256, films, glass, TRANSMITTANCE_TERMS, MOST_W])


def refit(entries: Sequence[Entry], library: Library, out: Path, progress: Progress, *, again: bool) -> list[str]:
    """Fit the transmittance of the models that are there again, where the lens has other coatings or glass now.

    Returns: models that cannot be fitted so, as sentences.
    """
    failed = []
    progress.plan({f"{entry.state}: transmittance": 4.0 for entry in entries})
    for entry in entries:
        rows, left_out = _known(out)
        mine, lens = [row for row in rows if row["entry"] == entry.state], entry.lens.read()
        mark = transmittance_mark(lens)
        with warnings.catch_warnings(), progress.stage(f"{entry.state}: transmittance"):
            warnings.simplefilter("ignore", NeurolensWarning)
            for row in (row for row in mine if again or row.get("transmittance") != mark):
                file = out / row["file"]
                try:
                    found = refit_transmittance(file, _experiment(entry, library).states() if "axes" in row else lens)
                except NeurolensError as error:
                    failed.append(f"{row['file']}: to be made again: {error}")
                    continue
                row |= {key: found[key] for key in ("transmittance_rms", "parameters")}
                row |= {"sha256": sha256_of(file), "bytes": file.stat().st_size, "transmittance": mark}
        _keep(rows, left_out, library, out)
    return failed


def _experiment(entry: Entry, library: Library) -> Experiment:
    return Experiment(entry.state, entry.lens, entry.models, entry.domain, library.pairs)


def make_entry(entry: Entry, library: Library, out: Path, progress: Progress) -> list[Row]:
    """Fit, check and time the models of one lens; writes their files and returns their rows of the index."""
    make = _make_of_many_states if entry.lens.many_states else _make_of_one_state
    lens_file = Path(os.path.relpath(entry.lens.file.resolve(), lab.ROOT.resolve())).as_posix()
    mark = fingerprint(entry, library.pairs)
    common = {"entry": entry.state, "fingerprint": mark, "lens_file": lens_file}
    common["transmittance"] = transmittance_mark(entry.lens.read())
    return [{**row, **common} for row in make(entry, library, out, progress)]


def _make_of_one_state(entry: Entry, library: Library, out: Path, progress: Progress) -> list[Row]:
    with warnings.catch_warnings(), tempfile.TemporaryDirectory() as scratch:
        warnings.simplefilter("ignore", NeurolensWarning)
        lens = entry.lens.read()
        domain = entry.domain.of(lens)
        prepared = prepare(make_pairs(lens, domain, library.pairs))
        fresh = functools.cache(lambda: shared_rays(prepared, _VIGNETTING_RAYS))
        measured: list[Measured] = []
        for settings in entry.models:
            with progress.stage(f"{entry.state}: {settings.label}") as report:
                made = fit_and_measure(prepared, settings, Path(scratch), _VIGNETTING_RAYS, report, fresh)
                measured.append(made)
        measured = best_of_each_kind(measured) if entry.best else measured
        files = {m.settings.label: m.file for m in measured}
        times = _times(entry, library, lens, domain, files, progress) if library.timed else _times_before(entry, out)
        rows = [_row(entry, lens, domain, m) | times.get(m.settings.label, _UNTIMED) for m in measured]
        return [_shipped(row, m.file, out) for row, m in zip(rows, measured, strict=True)]


def _times(
    entry: Entry, library: Library, lens: Lens, domain: Domain, files: Mapping[str, Path], progress: Progress
) -> dict[str, Row]:
    """The times of models for the index, by their labels, from one race with the exact lens as C."""
    candidates = [exact_c_candidate(lens, domain), *model_candidates(files, domain)]
    with progress.stage(f"{entry.state}: race") as report:
        timed = race(candidates, domain, rounds=library.rounds, report=report)
    found = {}
    for label in files:
        speedup = timed.speedup(f"{label} fused", EXACT[1])
        found[label] = {
            "ns_per_ray": timed.timing(label),
            "fused_ns_per_ray": timed.timing(f"{label} fused"),
            "exact_c_ns_per_ray": timed.timing(EXACT[1]),
            "speedup_as_c": speedup["min"] if speedup else None,
            "promised_speedup": round(PROMISE * speedup["min"], 2) if speedup and entry.promise else None,
        }
    return found


_TIMES = "ns_per_ray fused_ns_per_ray exact_c_ns_per_ray speedup_as_c promised_speedup".split()
_UNTIMED: Row = dict.fromkeys(_TIMES)


def _times_before(entry: Entry, out: Path) -> dict[str, Row]:
    """The times of the models of an entry that are there, by their labels."""
    mine = (row for row in _known(out)[0] if row["entry"] == entry.state)
    return {row["model"]: {key: row.get(key) for key in _TIMES} for row in mine}


def time_models(library: Library, entries: Sequence[Entry], out: Path, progress: Progress) -> list[str]:
    """Time the models that stand again, entry by entry, and write the index; zooms of many states keep their times.

    Returns: entries that have no models of the present settings, as sentences.
    """
    missing = []
    timed = [e for e in entries if not e.lens.many_states]
    progress.plan({f"{e.state}: race": 20.0 for e in timed})
    for entry in timed:
        rows, left_out = _known(out)
        if not _stands(entry, library.pairs, rows, out):
            missing.append(f"{entry.state}: to be made first")
            continue
        mine = [row for row in rows if row["entry"] == entry.state]
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", NeurolensWarning)
            lens = entry.lens.read()
            files = {row["model"]: out / row["file"] for row in mine}
            times = _times(entry, library, lens, entry.domain.of(lens), files, progress)
        for row in mine:
            row |= times[row["model"]]
        _keep(rows, left_out, library, out)
    return missing


def best_of_each_kind(measured: Sequence[Measured]) -> list[Measured]:
    """The polynomial and the network of the smallest error."""
    kinds: dict[bool, Measured] = {}
    for m in sorted(measured, key=lambda m: m.error):
        kinds.setdefault(m.settings.method in NETWORKS, m)
    return [kinds[kind] for kind in (False, True) if kind in kinds]


def _row(entry: Entry, lens: Lens, domain: Domain, m: Measured) -> Row:
    """The row of a model in the index, without its times; its card is checked on fresh rays."""
    scale = REFERENCE_RADIUS_MM / image_radius_mm(lens)[0]
    widest = lens.with_stop_radius(domain.stop_radius_mm)
    broken = [p.key for p in check_model(load_model(m.file), widest)[1] if not p.holds]
    scaled = {f"{k}_at_21_6": None if m.record.get(k) is None else scale * m.record[k] for k in ("rms_um", "p99_um")}
    return {
        "file": entry.file(m.settings),
        "sha256": sha256_of(m.file),
        "lens": lens.name,
        "configuration": entry.lens.state,
        "efl_mm": entry.lens.focal_length_mm,
        "model": m.settings.label,
        "wavelength_nm": list(domain.wavelength_nm),
        "focus_m": ["inf" if f == float("inf") else f for f in domain.focus_m],
        **{k: m.record.get(k) for k in _KEPT},
        **scaled,
        "position_rms_um_at_21_6": scale * m.record["position_rms_um"],
        "broken": broken,
    }


_CHECKED = 4  # states at which a card is checked on fresh rays


def _make_of_many_states(entry: Entry, library: Library, out: Path, progress: Progress) -> list[Row]:
    """The rows of models of many states, whose figures are the worst over random states."""
    experiment, rows = _experiment(entry, library), []
    with warnings.catch_warnings(), tempfile.TemporaryDirectory() as scratch:
        warnings.simplefilter("ignore", NeurolensWarning)
        space = experiment.states()
        before = {label: times["ns_per_ray"] for label, times in _times_before(entry, out).items()}
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
                timed = race([candidate], domain, rounds=10).timing(m.label) if library.timed else before.get(m.label)
            row = {
                "file": f"{entry.state}.{settings.label}.onnx",
                "sha256": sha256_of(file),
                "lens": space.lens.name,
                "configuration": entry.lens.state,
                "efl_mm": None,
                "model": settings.label,
                "axes": [axis.to_dict() for axis in space.axes],
                "wavelength_nm": list(domain.wavelength_nm),
                **{key: record.get(key) for key in _KEPT},
                "rms_um_at_21_6": record.get("rms_um_at_21_6"),
                "broken": broken,
                "ns_per_ray": timed,
                **dict.fromkeys(("exact_c_ns_per_ray", "speedup_as_c", "promised_speedup")),
            }
            rows.append(_shipped(row, file, out))
    return rows


def _shipped(row: Row, file: Path, out: Path) -> Row:
    """The row of a model whose file has been copied to its place."""
    with atomic_path(out / row["file"]) as temporary:
        temporary.write_bytes(file.read_bytes())
    return row


OPTIONS = (
    lab.option("lenses", metavar="LENS", nargs="*", help="entries whose name starts so (default: all)"),
    lab.option("--list", metavar="FILE", type=Path, default=_LIST, help="list (default: experiments/data/models.toml)"),
    lab.option("--restart", old=("--again",), action="store_true", help="make the chosen entries again"),
    lab.option("--untimed", action="store_true", help="models keep the times of those of their name before"),
    lab.option(
        "--transmittance",
        action="store_true",
        help="only fit the transmittance again, after coatings or glass",
    ),
    lab.option("--times", action="store_true", help="only time the models that are there (on a quiet machine)"),
    lab.ROUNDS,
    lab.out(lab.MODELS, "folder"),
)


def run(args: argparse.Namespace) -> int:
    """Make what is missing; 1 where something failed."""
    library = replace(read_list(args.list), timed=not args.untimed, rounds=args.rounds or 20)
    args.out.mkdir(parents=True, exist_ok=True)
    entries = chosen(library, args.lenses)
    progress = Progress(quiet=args.quiet)
    if args.transmittance:
        failed = refit(entries, library, args.out, progress, again=args.restart)
    elif args.times:
        failed = time_models(library, entries, args.out, progress)
    else:
        failed = make_models(library, entries, args.out, progress, again=args.restart)
    print((args.out / "README.md").read_text(encoding="utf-8"))
    for line in failed:
        print(f"experiments: {line}", file=sys.stderr)
    return 1 if failed else 0
