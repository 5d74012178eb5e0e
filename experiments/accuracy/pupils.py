"""The share of the rays of a pupil that pass the lens: pupils of the literature, and the outlines of our cameras.

On the lenses of the theses, beside their figures (half a minute). Writes passage.md and passage.json. With --shaders
the library's models as shaders in OSL instead, up to half a minute each: writes osl_passing.md and osl_passing.json
after each, and goes on with those that these have not; --only measures anew.
"""

from __future__ import annotations

import argparse
import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from torch.quasirandom import SobolEngine

from experiments import lab
from experiments.accuracy import pupil_methods as known
from neurolens.base.progress import Progress
from neurolens.cameras.exact import ExactCamera
from neurolens.cameras.pupil_outline import PupilOutline
from neurolens.cameras.shaders.blender_shader import lens_of
from neurolens.cameras.shaders.osl import osl_program
from neurolens.cameras.shaders.pupil_fit import light_lost
from neurolens.optics.lens.prescription import Lens
from neurolens.optics.lens.shot import Shot

# A camera ray costs Cycles a base, so much for each operation of its shader, and more for a division or a root. These
# times (ns) are fitted to the least times of the six lenses in experiments/results/osl_speed.md.
_SHADER_NS, _STEP_NS, _DEAR_NS, _DEAR = 90.66, 0.2295, 2.772, ("div", "sqrt")


@dataclass(frozen=True)
class Case:
    """A lens at one stop, and what the theses say of it (percent), by our names of the methods.

    Attributes:
        lens: stem of its file. focal_length_mm: that it is scaled to. f_number: of the stop.
        theirs: percent by method. source: where these stand, and of which lens if it is another.
    """

    lens: str
    focal_length_mm: float
    f_number: float
    theirs: dict[str, float] = field(default_factory=dict)
    source: str = ""


def _steinert(lens: str, mm: float, figures: dict[float, tuple[float, float]], name: str = "") -> list[Case]:
    source = f"Steinert 2009, Table 5.2{f', {name}' if name else ''}"
    return [Case(lens, mm, n, {"rear rim": a, "pixel disc": b}, source) for n, (a, b) in figures.items()]


KIMURA, KINGSLAKE = "Kimura wide angle 36 mm", "Kingslake telephoto 250 mm"
WILLI = "Willi 2021, Table 3.1"
GAUSS = {"rear rim": 36.9, "Wu, two steps": 92.2, "radial ellipses": 99.8}
FISHEYE = {"rear rim": 0.5, "Wu, two steps": 74.4, "pixel disc": 79.7, "radial ellipses": 88.7}
# Lit pixels only for the fisheye's global pupil, as the table gives them too.
CASES = (
    *_steinert("muller_fisheye_100", 14.0, {4.0: (43.2, 64.4), 5.6: (29.7, 76.2), 8.0: (16.9, 79.7)}),
    *_steinert("angenieux_retrofocus_35", 35.0, {2.8: (25.4, 84.5), 4.0: (13.1, 85.4), 5.6: (7.7, 85.7)}, KIMURA),
    *_steinert("brendel_tessar_100", 50.0, {2.8: (60.7, 81.6), 4.0: (34.2, 83.7), 5.6: (18.0, 83.7)}),
    *_steinert("sigler_telephoto_100", 250.0, {5.6: (22.4, 86.7), 8.0: (15.8, 86.2), 11.0: (10.7, 86.2)}, KINGSLAKE),
    Case("tronnier_double_gauss_100", 100.0, 4.0, GAUSS, f"{WILLI}, double Gauss 100 mm"),
    Case("mizuguchi_fisheye_10", 10.5, 8.0, FISHEYE, WILLI),
    Case("laikin_double_gauss_50", 50.0, 1.8),
    Case("laikin_double_gauss_50", 50.0, 8.0),
)
FILM_MM = (36.0, 24.0)
OURS = "outlines (ours)"
SAMPLES = 2**17

# Film and pupil samples [2, N] and wavelengths [N] to pupil points [2, N] and areas [N] (float32 or float64).
SampleFunction = Callable[[Any, Any, Any], tuple[Any, Any]]


def camera_of(case: Case) -> ExactCamera:
    """The lens of a case on `FILM_MM`, focused at infinity."""
    lens = lab.lens_of(case.lens, focal_length_mm=case.focal_length_mm, f_number=case.f_number)
    return ExactCamera(lens, Shot(FILM_MM, math.inf))


def measure(case: Case, samples: int = SAMPLES) -> lab.Row:
    """A case in light of 400 to 700 nm.

    Returns: the case; lit_radius_mm; dark, the share of the film; lost, the share of light that `OURS` is known to
        lose; and rates of every method: the share of the rays from lit film points that pass, light (irradiance found
        over the true one, mean over the film), search_s, and sample_ns of a sample.
    """
    start = time.perf_counter()
    camera = camera_of(case)
    found = time.perf_counter() - start
    outline = camera.film.outline
    film, square, wavelength = _samples(samples, 1, outline.film_radius_mm)
    rates = {}
    true = true_irradiance(camera, samples)
    for name, make in METHODS.items():
        start = time.perf_counter()
        pupil = make(camera.lens, outline)
        search_s = found if name == OURS else time.perf_counter() - start
        passed, light = _irradiance(camera, pupil, film, square, wavelength)
        sample_ns = _nanoseconds(pupil.sample, film, square, wavelength)
        rate = {"passed": float(passed.mean()), "light": light / true, "search_s": search_s, "sample_ns": sample_ns}
        rates[name] = rate
    about = {"lens": case.lens, "focal_length_mm": case.focal_length_mm, "f_number": case.f_number}
    about |= {"lit_radius_mm": outline.film_radius_mm, "dark": 1 - film.shape[1] / samples}
    lost = lost_light(camera, film, square, wavelength)
    return about | {"lost": lost, "theirs_percent": case.theirs, "source": case.source, "rates": rates}


def true_irradiance(camera: ExactCamera, samples: int) -> float:
    """Mean irradiance of the lit film through an axial disc 1.3 times that of all rays found on a grid, with four times
    the samples: independent of what is known of the lens's pupil."""
    lens, radius = camera.lens, camera.film.outline.film_radius_mm
    disc = known.hull_disc(lens, radius)
    wide = replace(disc, along=1.3 * disc.along, across=1.3 * disc.across)
    total = count = 0.0
    for seed in range(4):
        film, square, wavelength = _samples(samples, seed + 10, radius)
        total += _irradiance(camera, wide, film, square, wavelength)[1] * film.shape[1]
        count += film.shape[1]
    return total / count


def _samples(samples: int, seed: int, lit_radius_mm: float) -> tuple[Any, Any, Any]:
    """Film points [2, n] of `FILM_MM` within the lit radius, squares [2, n] and wavelengths [n], float32."""
    draws = SobolEngine(5, scramble=True, seed=seed).draw(samples).numpy().T
    film = (draws[:2] - 0.5) * np.array(FILM_MM, np.float32)[:, None]
    lit = np.hypot(*film) <= lit_radius_mm
    return film[:, lit], draws[2:4, lit], 400 + 300 * draws[4, lit]


def lost_light(camera: ExactCamera, film: Any, square: Any, wavelength: Any, wider: float = 1.1) -> float:
    """Share of the light that passes outside the outlines, from rays through outlines so many times wider."""
    outline = camera.film.outline
    wide = replace(outline, x=outline.x * np.float32(wider), y=outline.y * np.float32(wider))
    points, area = wide.sample(film, square, wavelength)
    passed = camera.film.scene(film, points, wavelength).status == 0
    outside = np.abs(2 * square - 1).max(0) > 1 / wider
    return float((area * (passed & outside)).sum() / (area * passed).sum())


def _searched(make: Callable[..., Any], *args: Any) -> Callable[[Lens, PupilOutline], Any]:
    return lambda lens, outline: make(lens, outline.film_radius_mm, *args)


# How the pupil of a lens on the axis is made; `OURS` is the outline that the camera has found.
METHODS: dict[str, Callable[[Lens, PupilOutline], Any]] = {
    "rear rim": _searched(known.rear_rim),
    "Wu, two steps": _searched(known.wu_exit_pupil),
    "pixel disc": _searched(known.pixel_pupils),
    "radial boxes": _searched(known.radial_bounds, "box"),
    "radial ellipses": _searched(known.radial_bounds, "ellipse"),
    OURS: lambda lens, outline: outline,
}


def _irradiance(camera: ExactCamera, pupil: Any, film: Any, square: Any, wavelength: Any) -> tuple[Any, float]:
    """Whether rays through a pupil's samples pass, bool [N], and the mean irradiance (T = 1, radiance 1)."""
    points, area = pupil.sample(film, square, wavelength)
    distance = camera.film.film_z_mm - pupil.pupil_z_mm
    slope = (points - film) / distance
    # The camera's own scene function takes points of its own plane: the same rays, followed there.
    own = film + slope * camera.film.distance_mm
    passed = camera.film.scene(film, own.astype(np.float32), wavelength).status == 0
    passed &= area > 0
    weight = passed * area / (distance * (1 + (slope * slope).sum(0))) ** 2
    return passed, float(weight.mean(dtype=np.float64))


def _nanoseconds(sample: SampleFunction, film: Any, square: Any, wavelength: Any, batch: int = 16384) -> float:
    part = slice(0, batch)
    film, square, wavelength = (np.ascontiguousarray(a[..., part]) for a in (film, square, wavelength))
    least = math.inf
    for _ in range(7):
        start = time.perf_counter()
        sample(film, square, wavelength)
        least = min(least, time.perf_counter() - start)
    return 1e9 * least / film.shape[1]


_INTRO = """\
# Share of rays that pass

`python -m experiments pupils`

{width:g} x {height:g} mm film, focus at infinity, 400 to 700 nm, {samples} rays per method.
Rates are percent of the rays sent from lit film points; the dark share of the film costs nothing and stands apart.
In brackets what the theses say of their lens. *Light* is the irradiance found through the pupil over that found
through a disc that is surely wide enough, in percent: below 100 the pupil is too small (its noise is about 0.2).
*Lost* is the share of the light that passes outside our outlines. *Search*: seconds, once a camera; *ns*: a sample.

What is counted: *radial boxes*, the samples of the whole box, as pbrt draws them; *radial ellipses*, those of the disc
inside it. A disc fills 78.5% of its box (pi / 4), so no box about a round pupil passes more: Willi's 99.8% (double
Gauss) and 88.7% (fisheye) for pbrt's bounds stand beside the ellipses, and 92.2 and 74.4% for Wu's pupil beside a disc.
What both lose besides is the step by which bounds are widened: 4.5% of the searched radius at 2000 samples.
"""


_METHODS = """\
rear rim: its disc, Steinert's and Willi's global pupil. Wu: one disc by a search in two steps. pixel disc: about 128
probe rays per pixel (Steinert). radial boxes: pbrt's bounds, 50 intervals of the film radius, 2000 samples each; radial
ellipses: the ellipses inside them. outlines (ours): `neurolens.cameras.pupil_outline`.
"""


def _name(row: lab.Row) -> str:
    return f"{row['lens'].rsplit('_', 1)[0].replace('_', ' ')} {row['focal_length_mm']:g} mm"


def _rate(method: str, row: lab.Row) -> str:
    theirs = row["theirs_percent"].get(method)
    return f"{100 * row['rates'][method]['passed']:.1f}" + (f" [{theirs:g}]" if theirs is not None else "")


_LENS = (("lens", _name), ("f/", "f_number", "g"))
_RATES = lab.columns(
    *_LENS,
    ("dark %", "dark", ".1f", 100),
    *((method, partial(_rate, method)) for method in METHODS),
    ("lost", "lost", ".0e"),
    ("search s", f"rates.{OURS}.search_s", ".2f"),
    ("ns", f"rates.{OURS}.sample_ns", ".0f"),
)
_LIGHT = lab.columns(*_LENS, *((method, f"rates.{method}.light", ".1f", 100) for method in METHODS))


def page(passages: Sequence[lab.Row], samples: int) -> str:
    """The whole page in Markdown."""
    width, height = FILM_MM
    sources = dict.fromkeys(f"- {_name(p)}: {p['source']}." for p in passages if p["source"])
    parts = [_INTRO.format(width=width, height=height, samples=samples), lab.table(_RATES, passages), _METHODS]
    parts += ["## Light found, percent", lab.table(_LIGHT, passages), "Figures in brackets:", "\n".join(sources)]
    return lab.page(*parts)


OPTIONS = (
    lab.count("rays", SAMPLES, "rays per method (default 131072)", 1000),
    lab.option("--shaders", action="store_true", help="the library's models as shaders in OSL"),
    lab.ONLY,
    lab.out(),
)


def run(args: argparse.Namespace) -> None:
    """Measure every case of the theses, or every shader."""
    if args.shaders:
        return shaders(args)
    lab.quiet_glasses()
    cases = lab.chosen(CASES, lambda case: case.lens, args.only, "pupils")
    done = [measure(case, args.rays) for case in lab.counted(cases, "pupils", args.quiet)]
    data = {"film_mm": FILM_MM, "samples": args.rays, "cases": done}
    print(lab.write_results(args.out, "passage", page(done, args.rays), data))


SHADERS = lab.columns(
    ("Model", "model"),
    ("Open", "open", ".3f"),
    ("2 stops down", "stopped_2", ".3f"),
    ("4 stops down", "stopped_4", ".3f"),
    ("Lost (per mille)", "lost_per_mille", ".2f"),
    ("Operations", "operations"),
    ("ns a ray that passes", "ns", ".0f"),
    ("CPU (s)", "cpu_s", ".1f"),
)
_SHADERS_TEXT = """\
By `python -m experiments pupils --shaders`: share of the samples that pass the lens, from film points that have light
at that stop, all over film, focus and wavelength; light that no sample has, in the worst zone of film and stop;
operations of a ray through a round stop; what they make a ray cost in Cycles under a white sky
(`cycles_ns`) for each that passes, the stop open; CPU to make the shader. The pupil of the biconvex lens
folds far off the axis: one wide disc holds it."""


def shaders(args: argparse.Namespace) -> None:
    """Share of the samples that pass, operations and CPU seconds of shaders of the library's models."""
    models = [file for kind in ("*.ols-64.onnx", "*-range.states-64.onnx") for file in lab.MODELS.glob(kind)]
    files = lab.chosen(sorted(models), lambda file: file.name, args.only, "pupils")
    lab.resume(
        args,
        "osl_passing",
        {file.stem: file for file in files},
        lambda file, report: shader_row(file),
        lambda row: row["model"],
        lambda rows: lab.page("# Samples of shaders in OSL that pass", _SHADERS_TEXT, lab.table(SHADERS, rows)),
        listed="rows",
        again=bool(args.only),
        maker="experiments pupils --shaders",
    )


def cycles_ns(kinds: Mapping[str, int]) -> float:
    """The nanoseconds of a ray of a shader in Cycles, from its operations."""
    return _SHADER_NS + _STEP_NS * sum(kinds.values()) + _DEAR_NS * sum(kinds.get(k, 0) for k in _DEAR)


def shader_row(file: Path) -> lab.Row:
    """The row of a model's shader, in its worst state."""
    begun = time.process_time()
    with Progress(quiet=True).stage(file.stem) as report:
        _, lens, _ = lens_of(file, None, report)
    shares = dict(zip(("open", "stopped_2", "stopped_4"), lens.passing().values(), strict=True))
    cpu, kinds = time.process_time() - begun, osl_program(lens, {"count": 0.0}).count()
    lost = max(light_lost(state, pupil) for state, pupil in lens.states())
    measured = {"operations": sum(kinds.values()), "ns": cycles_ns(kinds) / shares["open"], "cpu_s": cpu}
    return {"model": file.stem, **shares, "lost_per_mille": 1e3 * lost, **measured}
