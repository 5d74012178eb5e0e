"""The section of a lens with rays to the film of a domain: plain data that `analysis.layout.lens_layout` draws."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from neurolens.analysis import layout
from neurolens.analysis.fields import Scene
from neurolens.analysis.layout import refractions
from neurolens.optics.prescription import Lens
from neurolens.surrogates.domain import Domain

__all__ = ["layout_profile", "refractions"]


def layout_profile(lens: Lens, domain: Domain) -> dict[str, Any]:
    """Section of a lens with meridional fans of rays to the axis, 70% and the edge of the domain's film, d line.

    Args:
        lens: placed by `Lens.at`; where it is not, the film is that of the domain's farthest focus.

    Returns: as `analysis.layout.layout_profile`.
    """
    if lens.film_z_mm is None:
        lens = replace(lens, film_z_mm=float(domain.film_z_mm[0]))
    return layout.layout_profile(Scene(lens, domain.focus_m[0]), domain.film_radius_mm)
