"""The picture of a lens in section, which `analysis.plot_layout` draws."""

from neurolens.analysis.plot_layout import (
    arc,
    checked_rays,
    checked_surfaces,
    draw_film,
    draw_glass,
    draw_rays,
    draw_rims,
    element_outline,
    lens_layout,
    z_range,
)

__all__ = [
    "arc",
    "checked_rays",
    "checked_surfaces",
    "draw_film",
    "draw_glass",
    "draw_rays",
    "draw_rims",
    "element_outline",
    "lens_layout",
    "z_range",
]
