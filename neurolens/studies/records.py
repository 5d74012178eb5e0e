"""The records of a run, as `results.json` has them. Their keys end in units; shares are fractions of 1.

What was not measured is absent or null, never a made-up number. For infinity and NaN see `base.report.plain`.
"""

import math
import platform
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, TypedDict

from neurolens.base.files import write_json
from neurolens.base.report import plain

SCHEMA_VERSION = 1
_PACKAGES = ("neurolens", "torch", "numpy", "onnxruntime", "onnx", "OpenEXR")
# A timing is noisy where the median of its rounds is more than this times the least: other work ran beside it.
NOISY = 1.1


class Timing(TypedDict, total=False):
    """Nanoseconds per ray: best and median of the repeats, at a stated number of threads and rays per batch."""

    min: float
    median: float
    threads: int
    batch: int
    repeats: int


class ExactRecord(TypedDict, total=False):
    """One exact tracer's timing; `available` is false, with a `reason`, where it cannot run."""

    name: str
    ns_per_ray: Timing | None
    available: bool
    reason: str


@dataclass(frozen=True, kw_only=True)
class Results:
    """The results of a run, as in `results.json`; parts that were not measured are empty.

    Attributes:
        lens, domain: flat tables of figures with units in their keys.
        models: a record each, with the keys name, family (of `plots.FAMILIES`), file relative to the run folder,
            `measure.CARD_KEYS`, stopped_down and zones (see `measure.Findings`), poor (errors that are visible in a
            picture), coefficients_per_vector (A and B terms both count), parameters (of the whole model, rims
            included), bytes, fit_s, load_s, ns_per_ray (`Timing`) in onnxruntime, fused_ns_per_ray as C, fused_speedup
            and break_even_rays (as C, against the exact lens as C), note.
        target: the record that `target_record` returns; None where no error was asked for.
        settings: the resolved configuration.
        exact: timed exact tracers.
        cameras: renders of a scene, each with name, scene, render_s, camera_s (inside the camera) and its share,
            ns_per_ray of the camera alone, samples, width and height in pixels, threads.
        images: a record each, with name, scene, camera, file_png and file_exr relative to the run folder, samples, and,
            except for the exact lens, `scenes.ImageErrors`.
        image_settings: `scenes.SETTINGS`.
        figures: a record each, with file relative to the run folder, title, caption; wide where it fills the page's
            width.
        started: ISO 8601.
    """

    title: str = ""
    command: str = ""
    lens: dict[str, Any] = field(default_factory=dict)
    domain: dict[str, Any] = field(default_factory=dict)
    settings: dict[str, Any] = field(default_factory=dict)
    models: Sequence[Mapping[str, Any]] = ()
    target: dict[str, Any] | None = None
    exact: Sequence[ExactRecord] = ()
    cameras: Sequence[dict[str, Any]] = ()
    images: Sequence[dict[str, Any]] = ()
    image_settings: dict[str, Any] | None = None
    figures: Sequence[dict[str, Any]] = ()
    versions: dict[str, str] = field(default_factory=dict)
    seed: int = 0
    started: str = ""
    wall_s: float | None = None
    warnings: Sequence[str] = ()


def versions() -> dict[str, str]:
    """Return the versions of the packages that a result depends on."""
    from importlib.metadata import PackageNotFoundError, version  # its import takes a third of the time of --help

    found = {"python": platform.python_version()}
    for name in _PACKAGES:
        with suppress(PackageNotFoundError):
            found[name] = version(name)
    return found


def noisy(timing: Mapping[str, Any] | None) -> bool:
    """True if the rounds of a timing spread too far (`NOISY`) to tell it from one that is a little shorter."""
    median = (timing or {}).get("median")
    return timing is not None and median is not None and median > NOISY * timing["min"]


def time_of(model: Mapping[str, Any]) -> Mapping[str, Any]:
    """Return the timing that tables, plots and advice use: as C where that was measured, else in onnxruntime."""
    return model.get("fused_ns_per_ray") or model.get("ns_per_ray") or {}


def write_results(path: str | Path, results: Results) -> None:
    """Write `results.json` whole or not at all; see `plain`."""
    write_json(path, {"schema_version": SCHEMA_VERSION, **plain(asdict(results))})


def break_even_rays(
    fit_s: float | None, load_s: float | None, ns_exact: float | None, ns_model: float | None
) -> float | None:
    """Return rays after which fitting and loading have paid for themselves against an exact tracer.

    (fit_s + load_s) seconds / (ns_exact - ns_model) nanoseconds per ray, both timed in one run with the same threads.
    None where a figure is missing, or where the model is no faster than the exact tracer: it never pays.
    """
    if fit_s is None or load_s is None or ns_exact is None or ns_model is None or ns_model >= ns_exact:
        return None
    return (fit_s + load_s) * 1e9 / (ns_exact - ns_model)


def reaches(record: Mapping[str, Any], most: float, key: str = "rms_um") -> bool:
    """Return whether a model's film-equivalent RMS, or its figure `key`, is at most `most`."""
    found = record.get(key)
    return found is not None and bool(found <= most)


def target_record(models: Sequence[Mapping[str, Any]], within_um: float) -> dict[str, Any]:
    """Return the error asked for, whether it was met, and the name and error of the closest model that was tried."""
    best = min(models, key=error_of)
    return {
        "within_um": within_um,
        "met": reaches(best, within_um),
        "model": best["name"],
        "rms_um": best.get("rms_um"),
    }


def error_of(record: Mapping[str, Any]) -> tuple[float, float]:
    """Return a sort key: the error in micrometres, or the angle where all rays lie beyond 60 degrees."""
    found = (record.get("rms_um"), record.get("direction_rms_deg"))
    return tuple(math.inf if v is None else v for v in found)  # type: ignore[return-value]


def pareto_front(points: Sequence[tuple[float, float]]) -> list[int]:
    """Return the indices of the points that no other point betters, by rising first coordinate; less is better in both.

    A point is bettered by one that is at most equal in both coordinates and smaller in one. Points with a NaN are left
    out; equal points are all kept.
    """
    front: list[int] = []
    for i in sorted((i for i, p in enumerate(points) if not any(map(math.isnan, p))), key=lambda i: points[i]):
        if not front or points[i][1] < points[front[-1]][1] or points[i] == points[front[-1]]:
            front.append(i)
    return front
