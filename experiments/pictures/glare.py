"""Veiling glare: how much contrast a lens takes from a chart.

Contrast (Keshmirian 2008, 2.1): flare of irradiance I0 on a chart of Imax and Imin leaves
K''/K' = (Imax + Imin) / (Imax + Imin + 2 I0). The chart is black in its middle (an image of 6 mm radius, Imin = 0) and
else of radiance 1: either as far as the picture goes, or everywhere ahead of the lens to 85 degrees, as in ISO 9358. I0
is measured within 5 mm of the middle by photons of 450, 550 and 650 nm, in three coatings by era: the lens alone, with
1% of its front dusty, with a barrel of 5%, with a film of 10% (half of it as a mirror). Errors are standard deviations.
Writes glare.md and glare.json.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from experiments import lab
from neurolens.base.progress import Progress
from neurolens.cameras.contract import FloatArray
from neurolens.optics.lens.designs import coated
from neurolens.optics.lens.paraxial import first_order
from neurolens.optics.lens.prescription import Lens
from neurolens.pictures.flare.job import axis_irradiance
from neurolens.pictures.flare.lights import front_sphere
from neurolens.pictures.flare.photons import Photons, PhotonTracer
from neurolens.pictures.render.settings import Scatter

LENS, HALF_MM = "laikin_double_gauss_50", (18.0, 12.0)
COATINGS = ("bare", "single-layer", "multi-layer")
CONDITIONS = {
    "clean": Scatter(),
    "dust 1%": Scatter(dust=0.01),
    "barrel 5%": Scatter(barrel=0.05),
    "film 10%": Scatter(sensor=0.1),
}
_PATCH_MM, _WITHIN_MM, _WIDEST_DEG, _COLOURS = 6.0, 5.0, 85.0, (450.0, 550.0, 650.0)
_AT_ONCE = 1 << 16

OPTIONS = [lab.count("photons", 4_000_000, "of each case (default: 4 million)"), lab.out()]


def run(args: argparse.Namespace) -> int:
    """Measure, and write the table."""
    progress, lens = Progress(quiet=args.quiet), lab.lens_of(LENS, focus_m=math.inf)
    contrasts: list[lab.Row] = []
    for name in COATINGS:
        with progress.stage(f"contrast, {name}"):
            contrasts += contrast_of(lens if name == "bare" else coated(lens, name), name, args.photons)
    text = lab.page("# Glare", __doc__ or "", f"{args.photons:,} photons a case.", lab.table(_CONTRAST, contrasts))
    data = {"machine": lab.machine(), "photons": args.photons, "contrast": contrasts}
    print(lab.write_results(args.out, "glare", text, data))
    return 0


def contrast_of(lens: Lens, coating: str, count: int) -> Iterator[lab.Row]:
    """The veil I0 / Imax of every condition and surround, and the contrast K''/K' that it leaves."""
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
            veil, about = total * per, {"coating": coating, "condition": condition, "surround": surround}
            yield about | {"veil": veil, "error": math.sqrt(square) * per, "kept": 1 / (1 + 2 * veil)}


def _flare(tracer: PhotonTracer, rays: FloatArray, nm: float, seed: int) -> Iterator[FloatArray]:
    """Weights of photons in the middle: first of those that surfaces alone reflect, then of those that scatter."""

    def middle(found: Photons, which: NDArray[np.bool_]) -> FloatArray:
        return found.weight[which & (np.hypot(*found.film_xy_mm) < _WITHIN_MM)]

    turned = tracer.trace(rays, nm, seed=seed, boost=tracer.turning(nm, 2))
    yield middle(turned, (turned.scattered == 0) & (turned.reflections > 0))
    if tracer.scatter.on:
        found = tracer.trace(rays, nm, seed=seed + 1)
        yield middle(found, found.scattered > 0)


def surround_rays(lens: Lens, widest: float, count: int, seed: int) -> tuple[FloatArray, float]:
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


_CONTRAST = lab.columns(
    ("coating", "coating"),
    ("lens", "condition"),
    ("bright surround", "surround"),
    ("I0 / Imax", "veil", ".3%"),
    ("+-", "error", ".3%"),
    ("contrast kept K''/K'", "kept", ".3f"),
)
