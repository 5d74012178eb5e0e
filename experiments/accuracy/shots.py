"""Measure what fitting on one shot gains over the models that ship, which know every stop, focus and wavelength.

Typical shots of a lens: a portrait at f/2, a landscape at f/8, a close-up, lights at night. For each the error of the
shipped polynomial (64 terms or the most below) on it, and the smallest polynomial fitted on the shot alone that has no
more: coefficients, operations and nanoseconds of a ray of the whole camera as C. A minute of a core for each lens;
those that are in the table are kept. Writes shots.md, shots.json.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np

from experiments import lab
from experiments.pictures.plans import suited
from neurolens.base.progress import Report
from neurolens.cameras.lenscamera import Runtime
from neurolens.cameras.model import OnnxCamera, load_model
from neurolens.cameras.shaders.source import camera_program
from neurolens.models.terms import pinned_threads
from neurolens.optics.setting.focusing import near_limit_m
from neurolens.pictures.render.scene import load_scene
from neurolens.studies.plan import footprints as prints
from neurolens.studies.plan.candidates import shot_fits
from neurolens.studies.plan.costs import ns_a_ray
from neurolens.studies.plan.probe import COUNTED, LIGHT, Probe, probe

# All kinds: wide to long, f/1 to f/5.4, simple and not, from plastic, a zoom's default state.
LENSES = (
    "laikin_double_gauss_50", "canon_aspheric_50", "tajima_retrofocus_24", "sigler_telephoto_100", "phone_lens_6",
    "brendel_tessar_100", "canon_gauss_35", "petzval_portrait_100", "horimoto_fisheye_16", "nikon_zoom_70_200",
    "merte_biotar_100", "sony_sonnar_55",
)  # fmt: skip
SHIPPED_TERMS = 64
_NEAR = 1.05  # of the nearest focus of models
TERMS = range(4, SHIPPED_TERMS + 1)


@dataclass(frozen=True)
class Sitting:
    """A typical shot: its scene, stop (as far as the lens opens), and whether it is as near as the lens focuses."""

    name: str
    scene: str
    f_number: float
    near: bool = False


SITTINGS = (
    Sitting("portrait, f/2", "room", 2.0),
    Sitting("landscape, f/8", "garden", 8.0),
    Sitting("close-up, f/4", "room", 4.0, near=True),
    Sitting("night lights, open", "lights", 0.1),
)


@dataclass(frozen=True)
class Model:
    """A polynomial on a shot: counted errors, in um on the film and of light; operations and ns of its camera."""

    terms: int
    um: float
    light: float
    operations: int
    ns: float


def measure_lens(name: str, folder: Path, report: Report) -> dict[str, Any]:
    """All shots of a lens."""
    lens = lab.lens_of(name)
    shots = []
    terms = max(n for n in range(SHIPPED_TERMS + 1) if (lab.MODELS / f"{name}.ols-{n}.onnx").is_file())
    for number, sitting in enumerate(SITTINGS):
        near = _NEAR * near_limit_m(lens) if sitting.near else None
        scene = suited(load_scene(lab.SCENES / f"{sitting.scene}.toml"), lens, sitting.f_number, near)
        probed = probe(scene, lens)
        shipped = _measured(probed, lab.MODELS / f"{name}.ols-{terms}.onnx", terms)
        own = _smallest(probed, shipped, folder)
        facts = {"shot": sitting.name, "f_number": probed.asked.f_number, "focus_m": probed.asked.focus_m}
        shots.append(facts | {"shipped": asdict(shipped), "own": asdict(own)})
        report((number + 1) / len(SITTINGS))
    return {"lens": name, "shots": shots}


def _smallest(probed: Probe, shipped: Model, folder: Path) -> Model:
    """The smallest polynomial of the shot with errors no larger than the shipped one's, by halves; else the largest."""
    fit = shot_fits(probed, folder)
    low, high = 0, len(TERMS) - 1
    best = -1
    while low <= high:
        size = (low + high) // 2
        um, light = _errors(probed, _onnx(probed, fit(TERMS[size])))
        # Light that a plan takes for right is no reason for more terms.
        if um <= shipped.um and light <= max(shipped.light, LIGHT):
            best, high = size, size - 1
        else:
            low = size + 1
    return _measured(probed, fit(TERMS[best]), TERMS[best])


def _onnx(probed: Probe, file: Path, runtime: Runtime = "onnxruntime") -> OnnxCamera:
    return OnnxCamera(load_model(file), replace(probed.shot, runtime=runtime))


def _errors(probed: Probe, camera: OnnxCamera) -> tuple[float, float]:
    """Counted: of place and blur in um on the film, and of light."""
    seen = prints.footprints(camera, probed.places)
    apart = prints.distance_mm(probed.seen, seen, probed.places.share)
    light = np.abs(seen.light / np.maximum(probed.seen.light, 1e-30) - 1)
    um, dim = (float(np.percentile(np.where(np.isfinite(v), v, np.inf), COUNTED)) for v in (1e3 * apart, light))
    return um, dim


def _measured(probed: Probe, file: Path, terms: int) -> Model:
    camera = _onnx(probed, file)
    um, light = _errors(probed, camera)
    ns = ns_a_ray(_onnx(probed, file, "c"), probed.places)
    operations = sum(camera_program(camera.film, camera.lens_graph(), own_table=False).count().values())
    return Model(terms, um, light, operations, ns)


# ---- The page. -------------------------------------------------------------------------------------------------------

_HEAD = """\
# Models of one shot

The shipped polynomial of {terms} terms a vector (60 of the laikin), for all stops, focus and wavelengths, on typical
shots of 1920 pixels; and the smallest polynomial fitted to the shot alone whose error (95% of the picture, um on the
film) is no larger, and of light neither, or within 1%. Operations and nanoseconds are of a ray of the whole camera as C
on one thread: pupil, focus and decoding are in both. Made by `python -m experiments shots`."""
_COLUMNS = lab.columns(
    ("lens", "lens"), ("shot", "shot"), ("f/", "f_number", ".3g"), ("m", "focus_m", ".3g"),
    ("shipped um", "shipped.um", ".2g"), ("own um", "own.um", ".2g"), ("terms", "own.terms"),
    ("operations", lambda r: f"{r['shipped']['operations']} to {r['own']['operations']}"),
    ("share", lambda r: r["own"]["operations"] / r["shipped"]["operations"], ".2f"),
    ("ns", lambda r: f"{r['shipped']['ns']:.1f} to {r['own']['ns']:.1f}"),
)  # fmt: skip


def page(rows: Sequence[Mapping[str, Any]]) -> str:
    """The table."""
    shots = [{"lens": r["lens"]} | s for r in rows for s in r["shots"]]

    def middle(key: str) -> float | None:
        ratios = [s["own"][key] / s["shipped"][key] for s in shots]
        return median(ratios) if ratios else None

    goals = [
        lab.Goal("operations of the camera over the shipped model's, median", 0.5, middle("operations")),
        lab.Goal("coefficients, median", 0.5, middle("terms")),
        lab.Goal("nanoseconds, median", 0.5, middle("ns")),
    ]
    return lab.page(_HEAD.format(terms=SHIPPED_TERMS), lab.goal_table("goal", goals), lab.table(_COLUMNS, shots, "–"))


OPTIONS = (
    lab.ONLY,
    lab.AGAIN,
    lab.option("--models", metavar="DIR", type=Path, default=Path("runs/shots"), help="for them (default: runs/shots)"),
    lab.out(),
)


def run(args: argparse.Namespace) -> None:
    """Measure what is missing, and write the table after each lens."""
    lab.quiet_glasses()
    names = lab.chosen(LENSES, str, args.only, "shots")
    args.models.mkdir(parents=True, exist_ok=True)
    with pinned_threads():
        lab.resume(
            args, "shots", {name: name for name in names}, lambda name, report: measure_lens(name, args.models, report),
            lambda row: row["lens"], page, listed="lenses", again=args.restart, seconds=60.0, order=LENSES,
        )  # fmt: skip
