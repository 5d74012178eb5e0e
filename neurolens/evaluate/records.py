"""The records of a run, as in `results.json`, with units in the keys.

Every key is optional but `name`: what was not measured is absent or null, never a made-up number. Shares
(`false_pass`, `camera_share`, ...) are fractions of 1. Errors are defined in surrogates.md, "Error, defined once".
As JSON has no infinity, focus at infinity is the text "infinity"; NaN is null.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, TypedDict

from neurolens.base.errors import InputError
from neurolens.base.files import atomic_write_text

SCHEMA_VERSION = 1
FAMILIES = ("paraxial", "dense", "omp", "ols", "adaptive", "mlp")
VARIABLES = ("raw", "invariants")


class Timing(TypedDict, total=False):
    """Nanoseconds per ray: best and median of the repeats, at a stated number of threads and rays per batch."""

    min: float
    median: float
    threads: int
    batch: int
    repeats: int


class ModelRecord(TypedDict, total=False):
    """One surrogate on held-out rays. `family` is of FAMILIES, `variables` of VARIABLES."""

    name: str
    family: str
    variables: str
    file: str  # the exported model, relative to the run folder
    rms_um: float | None  # film-equivalent error, focused plane, rays to 60 degrees from the axis
    p99_um: float | None
    max_um: float | None
    rms_infinity_um: float | None  # the same for the plane at infinity
    rms_px: float | None  # at pixel_um of the domain
    direction_rms_deg: float | None
    position_rms_um: float | None  # distance from the predicted point to the exact ray
    transmittance_rms: float | None
    transmittance_max: float | None
    false_pass: float | None  # passed by the model, blocked by the lens / passed by the model
    false_block: float | None  # blocked by the model, passed by the lens / passed by the lens
    false_pass_near_rim: float | None  # within 2% of a rim; false_block_near_rim likewise
    false_block_near_rim: float | None
    stopped_down: dict[str, dict[str, float | None]]  # "2_stops", "4_stops" closed, same fit: false_pass, false_block
    zones: dict[str, dict[str, dict[str, Any]]]  # "full", "2_stops" by zone of the film; see `measure.Findings`
    poor: list[str]  # errors that are visible in a picture
    coefficients_per_vector: int | None  # A and B terms both count; a raw basis: all scalars of the vector
    parameters: int | None  # of the whole model: coefficients or weights, rims included
    bytes: int | None
    fit_s: float | None
    load_s: float | None
    ns_per_ray: Timing | None
    speedup_over_compiled: float | None  # compiled exact / model, both minima of the same run
    break_even_rays: float | None
    note: str


class ExactRecord(TypedDict, total=False):
    """One exact tracer on the clock; `available` is false, with a `reason`, where it cannot run."""

    name: str
    ns_per_ray: Timing | None
    available: bool
    reason: str


class CameraRecord(TypedDict, total=False):
    """One render of one scene through one camera: exact, model, thin lens, pinhole."""

    name: str
    scene: str
    render_s: float | None
    camera_s: float | None  # spent inside the camera
    camera_share: float | None  # camera_s / render_s
    ns_per_ray: Timing | None  # of the camera alone
    samples: int
    width: int  # pixels, as height
    height: int
    threads: int


class ImageRecord(TypedDict, total=False):
    """One picture: files relative to the run folder, errors as of `image.compare` against exact renders."""

    name: str
    scene: str
    camera: str
    file_png: str
    file_exr: str
    samples: int
    flip: float | None
    rel_mse: float | None
    noise_floor_flip: float | None
    noise_floor_rel_mse: float | None
    flip_ratio: float | None
    pairs: int
    caption: str


class FigureRecord(TypedDict, total=False):
    """A plot for the report: `file` relative to the run folder."""

    file: str
    title: str
    caption: str
    wide: bool  # across the page, for renders side by side


class DomainGain(TypedDict, total=False):
    """What a domain taken from the scene gains: one row of `rows` for the whole lens, one for the scene.

    A row is a ModelRecord with `domain` (its name), film_radius_mm, f_number, wavelength_nm [low, high], focus_m.
    """

    scene: str
    text: str
    rows: list[dict[str, Any]]


class Results(TypedDict, total=False):
    """`results.json`. `lens` and `domain` are flat tables of figures with units in their keys."""

    schema_version: int
    title: str
    command: str
    lens: dict[str, Any]  # name, source, sha256, refractions, efl_mm, f_number, half_field_deg, image_radius_mm, ...
    domain: dict[
        str, Any
    ]  # film_radius_mm, wavelength_nm [low, high], focus_m, rays_train, rays_held_out, pixel_um, ...
    settings: dict[str, Any]  # the resolved configuration
    models: list[ModelRecord]
    exact: list[ExactRecord]
    cameras: list[CameraRecord]
    images: list[ImageRecord]
    image_settings: dict[str, Any]  # exposure, pixels_per_degree, eps, trim
    domain_gain: DomainGain | None
    figures: list[FigureRecord]
    versions: dict[str, str]
    seed: int
    started: str  # ISO 8601
    wall_s: float
    warnings: list[str]


_LISTS = ("models", "exact", "cameras", "images", "figures", "warnings")
_TABLES = ("lens", "domain", "settings", "domain_gain", "versions", "image_settings")


def check_results(results: Mapping[str, Any], file: str | Path = "results") -> None:
    """Raise an InputError unless `results` has the shape of `Results`: known keys, lists of named tables."""
    if not isinstance(results, Mapping):
        raise InputError(file, "top level", type(results).__name__, "a table")
    for key, value in results.items():
        if key not in Results.__annotations__:
            raise InputError(file, "key", key, "one of " + ", ".join(Results.__annotations__))
        if key in _LISTS and not isinstance(value, list | tuple):
            raise InputError(file, key, type(value).__name__, "a list")
        if key in _TABLES and value is not None and not isinstance(value, Mapping):
            raise InputError(file, key, type(value).__name__, "a table")
    for key in ("models", "exact", "cameras"):
        for index, row in enumerate(results.get(key, ())):
            if not isinstance(row, Mapping) or not isinstance(row.get("name"), str):
                raise InputError(file, f"{key} {index}, name", "(none)", "a table with a name")


def write_results(path: str | Path, results: Mapping[str, Any]) -> None:
    """Write `results.json` whole or not at all; see `plain`."""
    check_results(results, path)
    versioned = {"schema_version": SCHEMA_VERSION, **plain(results)}
    atomic_write_text(path, json.dumps(versioned, indent=1, allow_nan=False) + "\n")


def plain(value: Any) -> Any:
    """`value` with only what JSON knows: scalars and arrays of numpy and torch as numbers and lists, paths as text.

    Infinity is the text "infinity" or "-infinity", NaN is null.
    """
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    if hasattr(value, "tolist"):
        return plain(value.tolist())
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None if math.isnan(value) else "infinity" if value > 0 else "-infinity"
    return value if value is None or isinstance(value, bool | int | float | str) else str(value)


def markdown_table(header: Sequence[str], rows: Iterable[Sequence[Any]], missing: str = "") -> list[str]:
    """Lines of a table in Markdown; `missing` stands for cells that are None."""
    lines = [header, ["---"] * len(header), *([missing if c is None else str(c) for c in row] for row in rows)]
    return [f"| {' | '.join(line)} |" for line in lines]


def number(record: Mapping[str, Any], key: str) -> float | None:
    """Finite number at `key` of a record, or None; dots go into nested tables: "ns_per_ray.min"."""
    value: Any = record
    for part in key.split("."):
        value = value.get(part) if isinstance(value, Mapping) else None
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        return None
    return float(value)


def break_even_rays(
    fit_s: float | None, load_s: float | None, ns_exact: float | None, ns_model: float | None
) -> float | None:
    """Rays after which fitting and loading have paid for themselves against the compiled exact tracer.

    (fit_s + load_s) seconds / (ns_exact - ns_model) nanoseconds per ray, both timed in one run with the same threads.

    Returns:
        None where a figure is missing, or where the model is no faster than the exact tracer: it never pays.
    Raises:
        InputError: a negative time, or one that is not finite.
    """
    times = {"fit_s": fit_s, "load_s": load_s, "ns_exact": ns_exact, "ns_model": ns_model}
    for name, value in times.items():
        if value is not None and not (0 <= value < math.inf):
            raise InputError("break_even_rays", name, value, "a finite time, not negative")
    if fit_s is None or load_s is None or ns_exact is None or ns_model is None or ns_model >= ns_exact:
        return None
    return (fit_s + load_s) * 1e9 / (ns_exact - ns_model)


def pareto_front(points: Sequence[tuple[float, float]]) -> list[int]:
    """Indices of the points that no other betters, by rising first coordinate; smaller is better in both.

    A point is bettered by one that is at most equal in both coordinates and smaller in one. Points with a NaN are left
    out; equal points are all kept.
    """
    front: list[int] = []
    for i in sorted((i for i, p in enumerate(points) if not any(map(math.isnan, p))), key=lambda i: points[i]):
        if not front or points[i][1] < points[front[-1]][1] or points[i] == points[front[-1]]:
            front.append(i)
    return front
