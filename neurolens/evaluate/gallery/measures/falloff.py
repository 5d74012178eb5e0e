"""Vignetting: how much light is left towards the film's corner, and where a post-process of the same corner differs."""

from __future__ import annotations

import math

import numpy as np

from neurolens.evaluate.gallery.measures.view import View
from neurolens.evaluate.gallery.vignettes import NEAR_CORNER, illumination, post_process, strength_for

_RADII = 13


def falloff(view: View) -> dict[str, float]:
    """Light half way to the film's corner and near it, over that in the middle.

    Option of the panel: edge_mm, a film radius that stands for the corner's, where the lens leaves corners dark.
    """
    corner = view.shot.panel.option("edge_mm", math.hypot(*view.shot.film_mm) / 2)
    middle, half, edge = illumination(view.camera, np.array([0.0, 0.5, NEAR_CORNER]) * corner)
    return {
        "light_half_way_percent": 100 * half / middle,
        "light_near_the_corner_percent": 100 * edge / middle,
    }


def against_post(view: View) -> dict[str, float]:
    """As `falloff`, and by how much a post-process of the same middle and corner is off in between, at worst."""
    corner = NEAR_CORNER * math.hypot(*view.shot.film_mm) / 2
    radii = np.linspace(0, corner, _RADII)
    curve = illumination(view.camera, radii)
    curve = curve / curve[0]
    off = curve - post_process(radii, strength_for(corner, curve[-1]))
    worst = int(np.argmax(np.abs(off)))
    return {
        "light_half_way_percent": 100 * float(np.interp(corner / NEAR_CORNER / 2, radii, curve)),
        "light_near_the_corner_percent": 100 * float(curve[-1]),
        "brighter_than_post_process_percent": 100 * float(off[worst]),
        "at_film_radius_mm": float(radii[worst]),
    }
