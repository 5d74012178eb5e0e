"""Veiling glare: how much contrast a lens takes from a chart, and what it costs to measure light that turns round.

Contrast (Keshmirian 2008, 2.1): flare of irradiance I0 on a chart of Imax and Imin leaves
K''/K' = (Imax + Imin) / (Imax + Imin + 2 I0). The chart is black in its middle (an image of 6 mm radius, Imin = 0) and
else of radiance 1: either as far as the picture goes, or everywhere ahead of the lens to 85 degrees, as in ISO 9358. I0
is measured within 5 mm of the middle by photons of 450, 550 and 650 nm, in three coatings by era: the lens alone, with
1% of its front dusty, with a barrel of 5%, with a film of 10% (half of it as a mirror). Errors are standard deviations.

Ways (Steinert 2009, 5.3.2): a light 15 and 8 degrees off the axis, its flare on 72 x 48 cells; for light of two and of
four reflections, variance times processor time of every way, and how many times less that is than of the photons'
roulette. All paths are followed for two reflections alone. Noise is relative to the sum of squares of the picture;
compiling is not counted.

One element (Steinert 2009, Fig. 6.5): a retrofocus lens of 25 mm at f/2.8, bare but for a single layer on both sides of
one element: what that does to the image of a light and to the sum of its ghosts. The picture: open and stopped down to
six blades (his Fig. 6.4), bare and coated (6.5), and light that scatters. Writes glare.md, glare.json, glare.jpg.
"""

from __future__ import annotations

import argparse
import math
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from experiments import lab
from neurolens.base.progress import Progress
from neurolens.flare.canvas import Raster, axis_irradiance
from neurolens.flare.ghosts import GhostTracer, coated, ghost_pairs, ghost_table
from neurolens.flare.layers import FlareJob, flare_layers, sum_of
from neurolens.flare.lights import Light, front_sphere, light_rays
from neurolens.flare.photons import LEVELS, Photons, PhotonTracer
from neurolens.flare.steps import Floats
from neurolens.lens.apertures import Aperture
from neurolens.lens.paraxial import first_order
from neurolens.lens.prescription import Lens
from neurolens.readers.lensfile import read_lens
from neurolens.render.settings import FlareSettings, Scatter
from neurolens.setting.states import set_lens

LENS, NM, HALF_MM = "laikin_double_gauss_50", 550.0, (18.0, 12.0)
COATINGS = ("bare", "single-layer", "multi-layer")
CONDITIONS = {
    "clean": Scatter(),
    "dust 1%": Scatter(dust=0.01),
    "barrel 5%": Scatter(barrel=0.05),
    "film 10%": Scatter(sensor=0.1),
}
_PATCH_MM, _WITHIN_MM, _WIDEST_DEG, _COLOURS = 6.0, 5.0, 85.0, (450.0, 550.0, 650.0)
_AT_ONCE = 1 << 16
_SHOWN = 1 << 23  # photons of a wavelength of a picture
_CELLS, _RUNS = (72, 48), 16

OPTIONS = [
    lab.count("photons", 4_000_000, "of each case (default: 4 million)"),
    lab.count("samples", 1 << 18, "photons of each run of the ways (default: 262144)"),
    lab.out(),
]


@dataclass(frozen=True)
class Contrast:
    """Veiling glare is I0 / Imax; kept is K''/K'."""

    coating: str
    condition: str
    surround: str
    veil: float
    error: float

    @property
    def kept(self) -> float:
        return 1 / (1 + 2 * self.veil)


@dataclass(frozen=True)
class Way:
    """`gain`: how many times less variance a second than photons by roulette; `noise` of one run."""

    light: str
    way: str
    seconds: float
    noise: float | None
    variance_time: float | None
    gain: float | None


def run(args: argparse.Namespace) -> int:
    """Measure, write the tables and the picture."""
    progress = Progress(quiet=args.quiet)
    lens = lab.lens_of(LENS, focus_m=math.inf)
    retrofocus = read_lens(lab.LENSES / "mori_retrofocus_100.toml")
    retrofocus = set_lens(retrofocus, focus_m=math.inf, focal_length_mm=25.0, f_number=2.8)
    with progress.stage("pictures"):
        _draw(lens, retrofocus, args)
    contrasts: list[Contrast] = []
    ways: list[Way] = []
    for name in COATINGS:
        with progress.stage(f"contrast, {name}"):
            contrasts += contrast_of(lens if name == "bare" else coated(lens, name), name, args.photons)
    for name in ("bare", "multi-layer"):
        with progress.stage(f"ways, {name}"):
            ways += ways_of(lens if name == "bare" else coated(lens, name), name, args.samples)
    elements = list(elements_of(retrofocus, "single-layer"))
    contrast = lab.table(_CONTRAST, contrasts)
    counts = f"{args.photons:,} photons a case of the contrast, {args.samples:,} a run of the ways."
    text = lab.page("# Glare", __doc__ or "", counts, "## Contrast", contrast, "## Ways", lab.table(_WAYS, ways))
    text = lab.page(text, "## One element", lab.table(_ELEMENTS, elements))
    data = {"machine": lab.machine(), "photons": args.photons, "ways": ways, "elements": elements}
    data["contrast"] = [vars(row) | {"kept": row.kept} for row in contrasts]
    print(lab.write_results(args.out, "glare", text, data))
    return 0


# ---- Contrast. -------------------------------------------------------------------------------------------------------


def contrast_of(lens: Lens, coating: str, count: int) -> Iterator[Contrast]:
    """The veil of every condition and surround."""
    efl, bright = float(first_order(lens).efl_mm), [axis_irradiance(lens, nm) for nm in _COLOURS]
    black = math.atan(_PATCH_MM / efl)
    frame = math.atan(math.hypot(*HALF_MM) / efl)
    for condition, scatter in CONDITIONS.items():
        tracer = PhotonTracer(lens, scatter)
        # What dust and haze take from the image, and the film sends back, the image lacks, too.
        lost = (1 - scatter.dust) * (1 - scatter.sensor)
        for surround, widest in (("the picture", frame), ("all ahead", math.radians(_WIDEST_DEG))):
            total, square = 0.0, 0.0
            for number, first in enumerate(range(0, count, _AT_ONCE)):
                n, colour = min(_AT_ONCE, count - first), number % len(_COLOURS)
                rays, flux = surround_rays(lens, widest, n, first)
                angle = np.arccos(rays[5])
                inside = (np.abs(rays[3:5] / rays[5]) * efl <= np.array(HALF_MM)[:, None]).all(0)
                rays = rays[:, (angle > black) & (inside | (surround != "the picture"))]
                flux /= bright[colour]
                for weight in _flare(tracer, rays, _COLOURS[colour], first):
                    total += flux * float(weight.sum())
                    square += flux**2 * float((weight.astype(np.float64) ** 2).sum())
            per = 1 / (count * math.pi * _WITHIN_MM**2 * lost)
            yield Contrast(coating, condition, surround, total * per, math.sqrt(square) * per)


def _flare(tracer: PhotonTracer, rays: Floats, nm: float, seed: int) -> Iterator[Floats]:
    """Weights of photons in the middle: first of those that surfaces alone reflect, then of those that scatter."""

    def middle(found: Photons, which: NDArray[np.bool_]) -> Floats:
        return found.weight[which & (np.hypot(*found.film_xy_mm) < _WITHIN_MM)]

    turned = tracer.trace(rays, nm, seed=seed, boost=tracer.turning(nm, 2))
    yield middle(turned, (turned.scattered == 0) & (turned.reflections > 0))
    if tracer.scatter.on:
        found = tracer.trace(rays, nm, seed=seed + 1)
        yield middle(found, found.scattered > 0)


def surround_rays(lens: Lens, widest: float, count: int, seed: int) -> tuple[Floats, float]:
    """Rays [6, count] of radiance 1 from all directions within an angle (rad) of the axis through the sphere about the
    front surface, and the light of all together, mm^2 sr."""
    chances = np.random.default_rng([seed, 17]).random((4, count))
    centre, radius = front_sphere(lens)
    cos = 1 - chances[0] * (1 - math.cos(widest))
    sin, turn = np.sqrt(1 - cos * cos), 2 * math.pi * chances[1]
    d = np.stack([sin * np.cos(turn), sin * np.sin(turn), cos])
    across = np.stack([cos * np.cos(turn), cos * np.sin(turn), -sin]), np.stack([-np.sin(turn), np.cos(turn), 0 * turn])
    place, way = radius * np.sqrt(chances[2]), 2 * math.pi * chances[3]
    target = place * (np.cos(way) * across[0] + np.sin(way) * across[1]) + centre[:, None]
    rays = np.concatenate([target, d]).astype(np.float32)
    return rays, 2 * math.pi * (1 - math.cos(widest)) * math.pi * radius**2


# ---- Pictures. -------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Element:
    """Ratios to the bare lens; `index` n_d of the element."""

    surface: int
    index: float
    image: float
    ghosts: float


def elements_of(lens: Lens, name: str) -> Iterator[Element]:
    """Every element alone in air, coated on both sides."""
    rays, _ = light_rays(lens, Light(12.0, 7.0), 0, 1 << 14)

    def energies(some: Lens) -> tuple[float, float]:
        power = GhostTracer(some).trace(rays, NM, direct=True).power.astype(np.float64)
        return float(power[-1].sum()), float(power[:-1].sum())

    bare, s = energies(lens), lens.surfaces
    for k in range(len(s) - 1):
        if s[k].n_d > 1 and s[k + 1].n_d == 1 and (k == 0 or s[k - 1].n_d == 1):
            found = energies(coated(lens, f"bare,s{k:02d}={name},s{k + 1:02d}={name}"))
            yield Element(k, float(s[k].n_d), *(a / b for a, b in zip(found, bare, strict=True)))


def _draw(gauss: Lens, retrofocus: Lens, args: argparse.Namespace) -> None:
    import matplotlib.pyplot as plt

    wide = lab.lens_of("canon_gauss_35", focus_m=math.inf, focal_length_mm=36.0, f_number=2.0)
    stopped = set_lens(wide, f_number=5.6).with_aperture(Aperture(blades=6))
    one = coated(retrofocus, "bare,s02=single-layer,s03=single-layer")
    rows: list[list[tuple[str, Lens, Scatter, Light]]] = [
        [
            ("36 mm f/2", wide, Scatter(), Light(22.0, 14.0)),
            ("f/5.6, six blades", stopped, Scatter(), Light(22.0, 14.0)),
            ("25 mm f/2.8, bare", retrofocus, Scatter(), Light(25.0, 15.0)),
            ("the second element coated", one, Scatter(), Light(25.0, 15.0)),
        ],
        [(f"glare alone: {name}", gauss, scatter, Light(10.0, 5.0)) for name, scatter in CONDITIONS.items()],
    ]
    raster = Raster((2 * HALF_MM[0], 2 * HALF_MM[1]), 480, 320)
    figure, axes = plt.subplots(2, 4, figsize=(16, 6), layout="constrained")
    for axes_row, row in zip(axes, rows, strict=True):
        pictures = []
        for _, lens, scatter, light in row:
            settings = FlareSettings(
                bins=9, glare=_SHOWN, scatter=scatter, kernel_px=8.0,
                without=("ghosts",) if row is rows[1] else (),
            )  # fmt: skip
            pictures.append(sum_of(flare_layers(FlareJob(lens, [light], raster, settings)), raster))
        # Pairs of the first row at one exposure; light in the second by its logarithm, over four decades.
        for number, (axis, (title, *_), picture) in enumerate(zip(axes_row, row, pictures, strict=True)):
            if row is rows[0]:
                white = max(float(np.quantile(p, 0.99)) for p in pictures[number // 2 * 2 :][:2])
                shown = (picture / white).clip(0, 1) ** (1 / 2.2)
            else:
                shown = (np.log10(picture / max(p.max() for p in pictures) + 1e-30) / 4 + 1).clip(0, 1)
            axis.imshow(shown, extent=(-HALF_MM[0], HALF_MM[0], -HALF_MM[1], HALF_MM[1]))
            axis.set_title(title, fontsize=8)
            axis.tick_params(labelsize=7)
    figure.supxlabel("mm on the film", fontsize=8)
    lab.write_figure(args.out / "glare.jpg", figure, 100)


# ---- Ways. -----------------------------------------------------------------------------------------------------------

Picture = NDArray[np.float64]
Sampler = Callable[[int, int], Picture]  # of a number of rays and a run


def ways_of(lens: Lens, coating: str, count: int) -> Iterator[Way]:
    """Variance times time of every way, for light of two reflections, then of four."""
    light, tracer = Light(15.0, 8.0), PhotonTracer(lens)

    def by_photons(boost: float | NDArray[np.float64], times: int) -> Sampler:
        def sample(n: int, number: int) -> Picture:
            rays, _ = light_rays(lens, light, 0, n, number * 0.618 % 1, 1.0)
            found = tracer.trace(rays, NM, seed=number * 7919, boost=boost)
            chosen = found.reflections == times
            return _cells(found.film_xy_mm[:, chosen], found.weight[chosen]) / n

        return sample

    def by_paths(ghosts: GhostTracer) -> Sampler:
        def sample(n: int, number: int) -> Picture:
            rays, _ = light_rays(lens, light, 0, n, number * 0.618 % 1, 1.0)
            found = ghosts.trace(rays, NM)
            lit = found.power > 0
            return _cells(np.moveaxis(found.film_xy_mm, 1, 0)[:, lit], found.power[lit]) / n

        return sample

    pairs = GhostTracer(lens)
    for times in (2, 4):
        turning = tracer.turning(NM, times)
        turning[:, :, times:] = 1e-3
        ways = {
            "photons, roulette": (by_photons(1.0, times), count),
            "photons, squared transmission": (by_photons(2.0, times), count),
            "photons, a surface ahead by its reflectance": (by_photons(turning, times), count),
        }
        best = ways["photons, a surface ahead by its reflectance"]
        if times == 2:
            best = ways["all paths"] = by_paths(pairs), max(1, count // 32)
            ways["photons, a surface ahead by its ghosts"] = (by_photons(_by_ghosts(pairs, tracer, light), 2), count)
        truth = np.mean([best[0](2 * best[1], 1000 + k) for k in range(2 * _RUNS)], 0)
        rows = [Way(f"{coating}, {times} reflections", name, *_race(*way, truth), None) for name, way in ways.items()]
        first = rows[0].variance_time
        for row in rows:
            yield replace(row, gain=first / row.variance_time if first and row.variance_time else None)


def _race(sample: Sampler, count: int, truth: Picture) -> tuple[float, float | None, float | None]:
    """Seconds of a run, its relative noise, its variance times its time; None where no light came."""
    sample(64, 0)
    seconds, pictures = [], []
    for number in range(1, _RUNS + 1):
        began = time.process_time()
        pictures.append(sample(count, number))
        seconds.append(time.process_time() - began)
    middle = float(np.median(seconds))
    error = float(np.var(pictures, 0, ddof=1).sum() / (truth**2).sum())
    return (middle, math.sqrt(error), error * middle) if error else (middle, None, None)


def _cells(xy: Floats, weight: Floats) -> Picture:
    bounds = [[-HALF_MM[1], HALF_MM[1]], [-HALF_MM[0], HALF_MM[0]]]
    return np.histogram2d(xy[1], -xy[0], bins=_CELLS[::-1], range=bounds, weights=weight)[0]


def _by_ghosts(ghosts: GhostTracer, tracer: PhotonTracer, light: Light) -> NDArray[np.float64]:
    """Boosts by what a trial says of the ghosts beyond each choice: energy over the root of the share that arrives."""
    count = len(tracer.lens.surfaces)
    value = np.zeros((count, count))
    for ghost in ghost_table(ghosts, light, NM, 1 << 14):
        value[ghost.pair] = ghost.energy / math.sqrt(ghost.passed)
    floor = 1e-4 * value.sum() / max(1, len(ghosts.pairs))
    for pair in ghost_pairs(tracer.lens):
        value[pair] += floor
    reflected = tracer.stack.reflectance(NM)
    odds = np.where(reflected > 0, (1 - reflected) / np.maximum(reflected, 1e-30), 0.0)
    boost = np.full((count, 2, LEVELS), 1e-3)
    # First among those that reflect first (the later in the pair), then among those that are left behind.
    for way, level, own in ((0, 0, value.sum(0)), (1, 1, value.sum(1))):
        ahead = own[::-1].cumsum()[::-1] if way == 0 else own.cumsum()
        share = np.where(own > 0, np.minimum(own / np.maximum(ahead, 1e-300), 0.98), 0)
        boost[:, way, level] = np.maximum(share / (1 - share) * odds, 1e-3)
    return boost


_CONTRAST = lab.columns(
    ("coating", "coating"),
    ("lens", "condition"),
    ("bright surround", "surround"),
    ("I0 / Imax", "veil", ".3%"),
    ("+-", "error", ".3%"),
    ("contrast kept K''/K'", "kept", ".3f"),
)
_ELEMENTS = lab.columns(
    ("first surface of the element", "surface"),
    ("n_d", "index"),
    ("image, of the bare lens's", "image", ".3f"),
    ("ghosts, of the bare lens's", "ghosts", ".3f"),
)
_WAYS = lab.columns(
    ("light", "light"),
    ("way", "way"),
    ("seconds a run", "seconds", ".3f"),
    ("noise of a run", "noise", ".3f"),
    ("variance x seconds", "variance_time", ".2e"),
    ("times better than roulette", "gain", ".1f"),
)
