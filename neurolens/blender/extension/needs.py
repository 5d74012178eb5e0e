"""The camera that a shot needs: a pinhole, Cycles' own depth of field, a model of the lens, or the lens itself.

The answer follows from the facts that the extension ships (the lens's errors by field and the error of each shader) and
from the circles of confusion of a thin lens at the depths in view. Plain Python, without Blender.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from .library import LensFacts, Setting, error_px, refusals

PINHOLE, THIN = "pinhole", "depth of field"
_ORDER = ("polynomial", "network", "exact")  # by cost in Cycles


@dataclass(frozen=True)
class Advice:
    """The camera to use (`PINHOLE`, `THIN`, a variant's kind, or "" if none keeps the tolerance), and two reasons."""

    use: str
    why: tuple[str, str]


def needs(lens: LensFacts, setting: Setting, depths_m: Sequence[float], f_number: float, tolerance_px: float) -> Advice:
    """The cheapest camera whose picture stays within a tolerance of the lens's.

    Args:
        depths_m: along the view of what the picture shows, inf where it shows nothing; none: all distant.
        f_number: of the shot; a lens that does not open so wide stays as wide as it opens.
    """
    pixel_um = 1e3 * setting.sensor_mm[0] / setting.pixels
    f_number = max(f_number, lens.f_number)
    corner = math.hypot(*setting.sensor_mm) / 2
    focus = setting.focus_m if setting.focus_m is not None else math.inf
    defocus = max((confusion_mm(lens.efl_mm, f_number, focus, d) for d in depths_m or (math.inf,)), default=0.0)
    defocus *= 1e3 / pixel_um
    if lens.field is None:
        moved = blurred = None
        worth = "what the lens itself adds is not known: pack it with its lens file"
    else:
        moved = lens.field.at(lens.field.distortion_um, corner, focus) / pixel_um
        # Of all aberrations none shrinks less than the aperture does.
        blurred = lens.field.at(lens.field.blur_um, corner, focus) / pixel_um * lens.f_number / f_number
        dark = 1 - lens.field.at(lens.field.light, corner, focus)
        worth = f"distortion up to {_px(moved)} px, aberrations {_px(blurred)} px, corners {100 * dark:.0f}% darker"
    asked = f"At f/{f_number:.3g} depths in view are blurred by up to {_px(defocus)} px; {worth}."
    if moved is not None and blurred is not None and max(moved, blurred) <= tolerance_px:
        if defocus <= tolerance_px:
            return Advice(PINHOLE, ("Use Blender's camera without depth of field.", asked))
        return Advice(THIN, ("Use Blender's camera with its own depth of field.", asked))
    errors: list[tuple[float, str]] = []
    for kind in _ORDER:
        variant = lens.variants.get(kind)
        if variant is None or refusals(variant, setting):
            continue
        error = error_px(variant, setting) or 0.0
        if error <= tolerance_px:
            told = "traces every surface" if kind == "exact" else f"is right to {error:.2g} px"
            return Advice(kind, (f"Use this lens, form {kind}: it {told}, within {tolerance_px:g} px.", asked))
        errors.append((error, kind))
    best = ": none takes this sensor and focus"
    if errors:
        best = f"; the best is {min(errors)[1]} with {min(errors)[0]:.2g} px"
    return Advice("", (f"No form of this lens keeps {tolerance_px:g} px{best}.", asked))


def _px(value: float) -> str:
    return f"{value:.2g}" if value >= 1e-3 else "0"


def confusion_mm(efl_mm: float, f_number: float, focus_m: float, depth_m: float) -> float:
    """Diameter of a thin lens's circle of confusion on the film; focus and depth from the film, inf allowed."""

    def image(distance_m: float) -> float:
        total = 1e3 * distance_m
        if math.isinf(total):
            return efl_mm
        if total <= 4 * efl_mm:
            return 2 * efl_mm  # nearer than any film can be: as at life size
        return (total - math.sqrt(total * (total - 4 * efl_mm))) / 2

    film, there = image(focus_m), image(depth_m)
    return efl_mm / f_number * abs(film - there) / there
