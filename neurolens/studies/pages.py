"""Which camera to use; and the contents of pages: tables of records, settings, pictures, and a run's `report.html`.

`train`, `models`, `plan` and the README decide by the same rule. The exact lens has no error and needs no fit. A model
is worth its error where it makes the whole work `SAVING` times as fast; a plan, which measures the scene, takes it
wherever the times differ by more than their accuracy. In a picture of our renderer the camera is a small part of that
work; elsewhere it may be all of it.

Templates make HTML of these contents (`base.html`). The page of a run needs no script and no network. Its pictures are
files of the run folder, named relative to it, so that the folder can be moved or zipped; a picture or link is shown
only if its file lies inside the folder. Missing values are shown as a dash.
"""

from __future__ import annotations

import math
import shlex
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

from neurolens.base.errors import InputError, program
from neurolens.base.files import atomic_write_text, library
from neurolens.base.html import html, local_url
from neurolens.base.settings import RANGE
from neurolens.studies.records import NOISY, ExactRecord, Results, error_of, noisy, pareto_front, reaches, time_of

C = TypeVar("C")
R = TypeVar("R", bound=Mapping[str, Any])

CLOSE_UM = 2.0  # within this RMS error a model counts as close: a quarter of a pixel of 36 mm at 4000 across
SAVING = 1.5
# Nanoseconds that a path takes besides its camera, in the cheapest scene of experiments/results/render_times.
PATH_NS = 190.0
# Nanoseconds of a refraction of the exact lens as C, on the machine that timed models/. They were 2.1 there; since C
# works in parts, the exact lens takes 0.6 of its former time relative to models (experiments/results/fused_speed).
REFRACTION_NS = 1.3


def recommended(
    cameras: Iterable[C], cost: Callable[[C], float], exact: C | None, rest: float = 0.0, saving: float = SAVING
) -> C | None:
    """Return the cheapest of the cameras that keep a budget, or the exact lens where that camera does not save enough.

    Args:
        cost: returns the cost of a ray.
        exact: None where the exact lens cannot run.
        rest: cost of the rest of the work for each ray.
        saving: how many times as fast the whole work must be.
    """
    best = min(cameras, key=cost, default=None)
    if exact is None or best is None:
        return exact if best is None else best
    return best if saving * (cost(best) + rest) <= cost(exact) + rest else exact


def to_use(
    models: Sequence[R], most: float = CLOSE_UM, key: str = "rms_um", exact: R | None = None, rest: float = 0.0
) -> R | None:
    """Return the model to use, or the exact lens: see `recommended`. None if there is neither.

    Only models within an error that are not poor count; ideal lenses (thin, thick) do not. If no model counts and the
    exact lens was not timed, the closest model is taken.

    Args:
        exact: record of the exact lens (`records.ExactRecord`).
        rest: nanoseconds of the rest of the work for each ray.
    """
    fits = [m for m in models if m.get("family") != "paraxial"]
    close = [m for m in fits if reaches(m, most, key) and not m.get("poor")]
    if exact is None and not any(time_of(m) for m in close):
        return min(close or fits, key=(lambda m: m.get("bytes") or math.inf) if close else error_of, default=None)
    return recommended(close, lambda m: time_of(m).get("min", math.inf), exact, rest)


def exact_of(records: Iterable[R]) -> R | None:
    """Return the fastest exact tracer that was timed."""
    return min([r for r in records if time_of(r)], key=lambda r: time_of(r)["min"], default=None)


def expected_exact(refractions: int) -> ExactRecord:
    """Return a record of the exact lens as C for where it was not timed."""
    return {"name": "exact C, expected", "ns_per_ray": {"min": REFRACTION_NS * refractions}}


@dataclass(frozen=True)
class Advice:
    """The camera to use in one place: its name, the reason, and the command that uses it (empty if unknown)."""

    where: str
    name: str
    why: str
    command: str

    def __str__(self) -> str:
        return f"{self.where} use {self.name}: {self.why}."


def advice(results: Mapping[str, Any], folder: Path) -> list[Advice]:
    """Choose the cameras of a run to use in our renderer and in other programs; empty for a run without models.

    Args:
        results: a table of the fields of `records.Results`.
        folder: of the run, which commands name.
    """
    models: Sequence[Mapping[str, Any]] = results["models"]
    exact, target = exact_of(results.get("exact") or ()), results.get("target")
    within = target["within_um"] if target else CLOSE_UM
    lens = folder / "lenses" / f"{Path(str(results.get('lens', {}).get('file') or 'lens')).stem}.toml"
    state = (results.get("settings") or {}).get("lens") or {}
    # the last two are earlier names of settings
    names = "focal_length_mm", "zoom", "f_number", "efl_mm", "configuration"
    whole = all(state.get(k) in (None, "none", RANGE) for k in names)  # the lens is as its file has it
    advices = []
    for where, rest in (("In this renderer", PATH_NS), ("In other programs", 0.0)):
        best = to_use(models, within, exact=exact, rest=rest)
        if best is None or not (best is exact or best.get("file")):
            continue
        untimed = exact is None and not time_of(best) and not best.get("states")
        if best is exact or rest and untimed:
            name, file = "the exact lens", str(lens) if whole else ""
            why = "as C it takes a small part of a picture's time, without error"
            why = why if exact is None else _why_exact(exact, to_use(models, within), within, rest)
        else:
            name, file = str(best["name"]), str(folder / best["file"])
            why = _why_model(best, exact, within)
        if rest:
            scene = Path("experiments/scenes/room.toml")
            words = [str(scene if scene.is_file() else library() / scene), "--camera", file, "-o", "room.exr"]
            command = f"{program()} render {shlex.join(words)}"
        else:  # one model of many states is no function of a ray alone, so that it has no source
            command = "" if best.get("states") else f"{program()} export {shlex.quote(file)} --to c -o lens.h"
        advices.append(Advice(where, name, why, command if file else ""))
    return advices


def _why_exact(exact: Mapping[str, Any], model: Mapping[str, Any] | None, within: float, rest: float) -> str:
    reason = f"{ns_text(time_of(exact))} a ray ({exact['name']}), without error"
    if model is None or not reaches(model, within) or model.get("poor"):
        return f"{reason}; no model is within {within:.3g} um"
    times = (time_of(exact)["min"] + rest) / (time_of(model).get("min", math.inf) + rest)
    whole = "a picture of even a cheap scene" if rest else "that"
    faster = f"with {model['name']} ({ns_text(time_of(model))}) {whole} is {times:.3g} times as fast"
    return f"{reason}; {faster}, and an error is worth it from {SAVING:g} on"


def _why_model(model: Mapping[str, Any], exact: Mapping[str, Any] | None, within: float) -> str:
    timing = time_of(model)
    reasons = [f"{'the fastest' if reaches(model, within) else 'the closest, as none is'} within {within:.3g} um"]
    if model.get("rms_um") is not None:
        reasons.append(f"error {model['rms_um']:.3g} um RMS")
    if timing:
        reasons.append(f"{ns_text(timing)} a ray {'as C' if model.get('fused_ns_per_ray') else 'in onnxruntime'}")
    if exact is not None and timing:
        reasons.append(f"{time_of(exact)['min'] / timing['min']:.2g} times as fast as the exact lens")
    return ", ".join(reasons)


def ns_text(timing: Mapping[str, Any]) -> str:
    """Return a time in words, with "~" before a noisy one."""
    return f"{'~' * noisy(timing)}{show(timing['min'], 3, ',')} ns" if timing else "-"


Record = Mapping[str, Any]
DASH = "–"


class Table(NamedTuple):
    """Records as rows, each with a name, and the columns of their figures."""

    names: Sequence[str]
    records: Sequence[Record]
    columns: Sequence[Column]


class Figure(NamedTuple):
    """A picture of a page: its address (None where the file is missing), texts, and links by their labels."""

    source: str | None
    file: str
    title: str
    caption: str
    links: Mapping[str, str]
    wide: bool


def number(record: Mapping[str, Any], key: str) -> float | None:
    """Return the finite number at `key` of a record, or None; dots lead into nested tables: "ns_per_ray.min"."""
    value: Any = record
    for part in key.split("."):
        value = value.get(part) if isinstance(value, Mapping) else None
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        return None
    return float(value)


@dataclass(frozen=True)
class Column:
    """A column of a table: its heading, the key of its figure in a record, a factor and the significant digits.

    Dots in a key lead into nested tables. `about` explains the figure on hover and in the legend.
    """

    heading: str
    key: str
    factor: float = 1.0
    digits: int = 3
    about: str = ""

    def value(self, record: Record) -> float | None:
        """Return the figure, unscaled."""
        return number(record, self.key)

    def cell(self, record: Record, thousands: str = "") -> str:
        """Return the figure as text: a dash if it is missing, "~" before the minimum of a noisy timing."""
        if record.get(self.key) == "never":
            return "never"
        value, parent = number(record, self.key), self.key.removesuffix(".min")
        if value is None:
            return DASH
        mark = "~" if parent != self.key and noisy(record[parent]) else ""
        return mark + show(value * self.factor, self.digits, thousands)


def show(value: float, digits: int, thousands: str = "") -> str:
    """Write a number with significant digits. Short ones have no exponent; `thousands` divides long ones."""
    if value == 0 or 1e-4 <= abs(value) < 10.0**digits:
        return f"{value:.{digits}g}"
    return f"{value:{thousands}.0f}" if 1 <= abs(value) < 1e7 else f"{value:.{digits - 1}e}"


def table(names: Sequence[str], records: Sequence[Record], columns: Iterable[Column]) -> Table:
    """Make a table of records, without columns for which no record has a figure."""
    return Table(names, records, [c for c in columns if any(c.value(r) is not None for r in records)])


def flat(values: Mapping[str, Any], prefix: str = "") -> list[tuple[str, str]]:
    """Return a table of settings as names and texts; nested tables have dotted names."""
    rows: list[tuple[str, str]] = []
    for key, value in values.items():
        nested = isinstance(value, Mapping)
        rows += flat(value, f"{prefix}{key}.") if nested else [(f"{prefix}{key}", _plain(value))]
    return rows


def _plain(value: Any) -> str:
    if value is None or value != value:  # NaN, which differs from itself
        return DASH
    if isinstance(value, float):
        return f"{value:.6g}"
    if isinstance(value, list | tuple):
        return " to ".join(map(_plain, value)) if len(value) == 2 else ", ".join(map(_plain, value))
    return str(value)


def figures_of(folder: Path, figures: Iterable[Mapping[str, Any]]) -> list[Figure]:
    """Make figures of records with "file" and maybe "title", "caption", "links" and "wide".

    A picture or link whose file is not in `folder` has no address.
    """
    shown = []
    for figure in figures:
        url = local_url(folder, figure.get("file"))
        links = {label: local_url(folder, file) for label, file in (figure.get("links") or {}).items()}
        existing = {label: link for label, link in links.items() if link}
        file, title, caption = (str(figure.get(key) or "") for key in ("file", "title", "caption"))
        shown.append(Figure(url, file, title, caption, existing, bool(figure.get("wide"))))
    return shown


_MODEL_COLUMNS = (
    Column("error RMS (µm)", "rms_um", about="distance between exact and modelled ray on the plane in focus, "
           "taken back to the film; root mean square over rays that no fit saw"),
    Column("p99 (µm)", "p99_um", about="99% of those rays are closer than this"),
    Column("pixels RMS", "rms_px", digits=2, about="the RMS error in pixels of a picture 4000 wide"),
    Column("C (ns/ray)", "fused_ns_per_ray.min", about="nanoseconds a ray on one core as compiled C: "
           "in our renderer, or by neurolens export --to c"),
    Column("onnxruntime (ns/ray)", "ns_per_ray.min", about="the same as an ONNX graph, as most programs run models"),
    Column("C: × exact", "fused_speedup", about="how many times faster than the exact lens as C, in the same race"),
    Column("false pass (%)", "false_pass", 100, 2, "rays that the model passes and the lens does not"),
    Column("false block (%)", "false_block", 100, 2, "rays that the model blocks and the lens does not"),
    Column("coefficients", "coefficients_per_vector", digits=6, about="of one vector output of a polynomial"),
    Column("fit (s)", "fit_s", about="seconds of the clock, on the machine of the run"),
)  # fmt: skip
_MORE_COLUMNS = (
    Column("max (µm)", "max_um", about="largest error of a ray"),
    Column("RMS at infinity (µm)", "rms_infinity_um", about="error RMS where the plane in focus is at infinity"),
    Column("direction RMS (°)", "direction_rms_deg", digits=2, about="angle between exact and modelled ray"),
    Column("position RMS (µm)", "position_rms_um", about="distance of the modelled front point from the exact ray"),
    Column("transmittance RMS", "transmittance_rms", digits=2, about="error of the share of light that passes, 0 to 1"),
    Column("parameters", "parameters", digits=6, about="numbers of the whole model"),
    Column("size (kB)", "bytes", 1e-3, about="of the file"),
    Column("break-even (Mray)", "break_even_rays", 1e-6, about="million rays after which the fit has paid for itself"),
)
_STOPPED_COLUMNS = tuple(
    Column(f"{stops} stops closed: {what} (%)", f"stopped_down.{stops}_stops.{key}", 100, 2)
    for stops in (2, 4)
    for what, key in (("false pass", "false_pass"), ("false block", "false_block"))
)
_AXIS_COLUMNS = (Column("zoom (mm)", "zoom", digits=5), Column("focus (1/m)", "focus", digits=5))
_EXACT_COLUMNS = (
    Column("time min (ns/ray)", "ns_per_ray.min"),
    Column("median (ns/ray)", "ns_per_ray.median"),
)
_CAMERA_COLUMNS = (
    Column("render (s)", "render_s"),
    Column("in the camera (s)", "camera_s"),
    Column("camera's share (%)", "camera_share", 100),
    Column("camera alone (ns/ray)", "ns_per_ray.min"),
    Column("samples per pixel", "samples", digits=6),
    Column("width (px)", "width", digits=6),
    Column("height (px)", "height", digits=6),
    Column("threads", "threads"),
)
_IMAGE_COLUMNS = (
    Column("FLIP", "flip_paired", about="difference that an eye sees from the exact render of the same random numbers"),
    Column("of noise (%)", "paired_share", 100, about="that FLIP over the noise floor"),
    Column("noise floor", "noise_floor_flip", about="FLIP of two exact renders that differ by their noise alone"),
    Column("FLIP with noise", "flip", about="from an exact render of other random numbers"),
    Column("relative MSE", "rel_mse", about="mean squared difference over the square of the brightness"),
    Column("noise floor of it", "noise_floor_rel_mse", about="the same of two exact renders"),
    Column("pairs", "pairs", about="of renders compared"),
)


def write_report(run_dir: str | Path, results: Results) -> Path:
    """Write `report.html` into the run folder, which holds the pictures that the results name; return its path.

    Raises:
        InputError: there is no such folder.
    """
    folder = Path(run_dir)
    if not folder.is_dir():
        raise InputError(folder, "run folder", "(missing)", "a folder that exists")
    wall = None if results.wall_s is None else f"{results.wall_s:.0f} s in all"
    parts = {
        "Lens": results.lens,
        "Domain": results.domain,
        "Seed and versions": {"seed": results.seed, **results.versions},
        "Image comparison": results.image_settings or {},
    }
    page = html(
        "report.html",
        title=str(results.title or results.lens.get("name") or "neurolens run"),
        lead=[part for part in (results.command, results.started, wall) if part],
        advice=advice(asdict(results), folder),
        warnings=[*results.warnings, *(_exact_name(r) for r in results.exact if not r.get("available", True))],
        exact=table([_exact_name(r) for r in results.exact], results.exact, _EXACT_COLUMNS),
        trade=figures_of(folder, results.figures),
        cameras=table(_names(results.cameras, "name"), results.cameras, _CAMERA_COLUMNS),
        about=[(name, flat(values)) for name, values in parts.items()],
        settings=flat(results.settings or {}),
        **_models(results.models),
        **_pictures(folder, results.images),
    )
    atomic_write_text(folder / "report.html", page)
    return folder / "report.html"


def _names(records: Sequence[Record], last: str) -> list[str]:
    """Name each record by its scene, then its camera."""
    return [" · ".join(str(r[key]) for key in ("scene", last) if r.get(key)) for r in records]


def _exact_name(record: Record) -> str:
    lacks = "" if record.get("available", True) else f": unavailable ({record.get('reason') or 'no reason given'})"
    return f"{record.get('name')}{lacks}"


def _models(models: Sequence[Record]) -> dict[str, Any]:
    """Collect all models, by family as recorded; a star marks those on the Pareto front of error and time."""
    key = "rms_um" if any(number(m, "rms_um") is not None for m in models) else "direction_rms_deg"
    points = [tuple(math.nan if v is None else v for v in (number(time_of(m), "min"), number(m, key))) for m in models]
    front = set(pareto_front(points))  # type: ignore[arg-type]
    names = [("★ " if i in front else "") + str(m["name"]) for i, m in enumerate(models)]
    note = "★ no other model is both faster (as C where that was timed) and closer. ~ a noisy time: the median of its "
    note += f"rounds is more than {NOISY:g} times the least, which is shown. Point at a heading to see what it means."
    stopped = [m for m in models if m.get("stopped_down")]
    states = [(str(m["name"]), row) for m in models for row in m.get("states") or ()]
    columns = (*_MODEL_COLUMNS, *_MORE_COLUMNS)
    return {
        "models": table(names, models, _MODEL_COLUMNS),
        "model_notes": [note, *(f"{m['name']}: {m['note']}" for m in models if m.get("note"))] if models else [],
        "legend_columns": (*columns, *_IMAGE_COLUMNS) if models else (),
        "more": table(names, models, _MORE_COLUMNS),
        "states": table([n for n, _ in states], [r for _, r in states], (*_AXIS_COLUMNS, *columns)),
        "stopped": table([str(m["name"]) for m in stopped], stopped, _STOPPED_COLUMNS),
    }


def _pictures(folder: Path, records: Sequence[Record]) -> dict[str, Any]:
    """Collect pictures with their captions and files, and their errors beside the noise floor."""
    named = [(n or str(r.get("name", "")), r) for n, r in zip(_names(records, "camera"), records, strict=True)]
    figures = [
        {"file": png, "title": name, "caption": r.get("caption"), "links": {"EXR": r.get("file_exr"), "PNG": png}}
        for name, r in named
        if (png := r.get("file_png"))
    ]
    measured = [(n, r) for n, r in named if number(r, "flip") is not None or number(r, "rel_mse")]
    errors = table([n for n, _ in measured], [r for _, r in measured], _IMAGE_COLUMNS)
    return {"pictures": figures_of(folder, figures), "measured": errors}
