"""A scene as a lens sees it: the places in view, the lens's footprints there, and what each of its effects is worth.

A probe sends the chief rays of a grid of film points into the scene: what they meet, and how far off, are the places at
which cameras are held against the exact lens (`footprints`). An effect's worth is its part of the exact footprints in
pixels, where it is largest but for 5% of the picture.
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from neurolens.base.errors import InputError
from neurolens.cameras.build import Shot, ideal_as
from neurolens.cameras.exact import ExactCamera, FusedExactCamera
from neurolens.cameras.field import spectrum_of
from neurolens.evaluate import footprints as prints
from neurolens.evaluate.footprints import Array, Footprints, Places
from neurolens.evaluate.scenes import seen_depths_m
from neurolens.graph.compiler import has_compiler
from neurolens.optics.paraxial import first_order
from neurolens.optics.prescription import Lens
from neurolens.render.scene import Scene
from neurolens.surrogates.domain import Domain, domain_from_camera

COUNTED = 95.0  # percentile over the picture that a budget is held against
LIGHT = 0.01  # relative error of light that a plan allows beside its budget of place
_ACROSS = 16  # points of the probe along the longer side


@dataclass(frozen=True)
class Asked:
    """What a scene asks of its camera.

    Attributes:
        film_mm: width and height in use. pixel_mm: pitch. focus_m, f_number, wavelength_nm: of the shot; no wider
            than the lens opens. nearest_m, farthest_m: along the axis from the film; None where nothing is in view.
        distant: share of the picture that shows what has no distance. dark: share that the lens leaves dark.
    """

    film_mm: tuple[float, float]
    pixel_mm: float
    focus_m: float
    f_number: float
    wavelength_nm: tuple[float, float]
    nearest_m: float | None
    farthest_m: float | None
    distant: float
    dark: float


@dataclass(frozen=True)
class Effect:
    """An effect's worth: pixels (RMS of what it moves light by; `relative`: share of the light) at the counted
    percentile, its median over the picture, and whether the budget lets it be left out."""

    name: str
    worth: float
    median: float
    unit: Literal["px", "relative"]
    needed: bool


@dataclass(frozen=True)
class Probed:
    """A scene's places as the exact lens sees them: its camera, its footprints there, and those of a thin lens."""

    asked: Asked
    lens: Lens
    domain: Domain
    exact: ExactCamera | FusedExactCamera
    places: Places
    seen: Footprints
    thin_seen: Footprints


def probe(scene: Scene, lens: Lens, *, across: int = _ACROSS) -> Probed:
    """Look through the exact lens at a scene.

    Raises:
        InputError: a scene's camera that the lens cannot be; a picture that the lens leaves dark.
    """
    shot = scene.settings.camera
    film, widest = (shot.film_width_mm, shot.film_height_mm), first_order(lens).f_number
    f_number = max(shot.f_number or widest, widest)
    stopped, domain = domain_from_camera(
        lens, film_mm=film, focus_m=shot.focus_m, f_number=f_number, wavelength_nm=shot.wavelengths_nm
    )
    real: dict[str, Any] = {"film_mm": film, "focus_m": shot.focus_m, "f_number": f_number}
    exact = exact_camera(lens, {**real, "bounds": domain.bounds, "wavelength_nm": shot.wavelengths_nm})
    points = _grid(film, across)
    depth = seen_depths_m(scene, exact, points)
    nanometres, share = spectrum_of(exact, shot.wavelengths_nm)
    places = prints.places_of(exact, points, np.where(np.isnan(depth), np.inf, depth), nanometres, share / share.sum())
    if not places.film_mm.shape[1]:
        raise InputError(scene.name, "camera", lens.name, "a lens that lights some of this film")
    thin = ideal_as("thin:", exact.lens, Shot(film, shot.focus_m))
    met = depth[np.isfinite(depth)]
    asked = Asked(
        film, film[0] / shot.width, shot.focus_m, f_number, shot.wavelengths_nm,
        float(met.min()) if met.size else None, float(met.max()) if met.size else None,
        float(np.isinf(depth).mean()), 1 - places.film_mm.shape[1] / points.shape[1],
    )  # fmt: skip
    seen = [prints.footprints(c, places) for c in (exact, thin)]
    return Probed(asked, stopped, domain, exact, places, seen[0], seen[1])


def effects_of(found: Probed, budget_px: float) -> tuple[Effect, ...]:
    """What each effect is worth in this picture, the dearest first; see `footprints.effects_mm`.

    An Airy disc has no RMS radius: diffraction is worth the radius that holds half its light, 0.53 wavelengths times
    the f-number (Born and Wolf, 8.5.2).
    """
    pixel, share = found.asked.pixel_mm, found.places.share
    parts = {k: v / pixel for k, v in prints.effects_mm(found.seen, found.thin_seen, share).items()}
    middle = float((found.places.wavelength_nm * share).sum())
    parts["diffraction"] = np.full(1, 0.53 * 1e-6 * middle * found.asked.f_number / pixel)
    fall = found.seen.light / max(found.seen.light.max(), 1e-30)
    natural = found.thin_seen.light / max(found.thin_seen.light.max(), 1e-30)
    light = {"natural fall-off": np.abs(1 - natural), "vignetting": np.abs(1 - fall / np.maximum(natural, 1e-30))}
    effects = [_effect(k, v, "px", budget_px) for k, v in parts.items()]
    effects += [_effect(k, v, "relative", LIGHT) for k, v in light.items()]
    return tuple(sorted(effects, key=lambda e: (e.unit, -e.worth)))


def _effect(name: str, value: Array, unit: Literal["px", "relative"], budget: float) -> Effect:
    worth = float(np.percentile(value, COUNTED))
    return Effect(name, worth, float(np.median(value)), unit, worth > budget)


def exact_camera(lens: Lens, real: dict[str, Any]) -> ExactCamera | FusedExactCamera:
    """As C where a compiler is there and the lens has a form in C: coatings and absorbing glass have none."""
    with suppress(InputError):
        if has_compiler():
            return FusedExactCamera(lens, **real)
    return ExactCamera(lens, **real)


def _grid(film_mm: tuple[float, float], across: int) -> Array:
    """Centres of equal cells of the film, [2, N] mm."""
    longer = max(film_mm)
    counts = [max(round(across * side / longer), 1) for side in film_mm]
    x, y = (((np.arange(n) + 0.5) / n - 0.5) * side for n, side in zip(counts, film_mm, strict=True))
    return np.stack(np.meshgrid(x, y)).reshape(2, -1)
