"""What is measured of each effect, by the name that its file gives: a number or more for every camera of a panel."""

from __future__ import annotations

from collections.abc import Callable

from neurolens.evaluate.gallery.measures import aberrations, bokeh, falloff, projection, sharpness
from neurolens.evaluate.gallery.measures.view import View

# A measure takes what one camera saw and gives numbers; their names carry the unit.
MEASURES: dict[str, Callable[[View], dict[str, float]]] = {
    "light_profile": aberrations.light_profile,
    "comet": aberrations.comet,
    "line_blur": aberrations.line_blur,
    "edge_blur": aberrations.edge_blur,
    "line_bow": aberrations.line_bow,
    "colour_blur": aberrations.colour_blur,
    "lateral_colour": aberrations.lateral_colour,
    "stop_shape": bokeh.stop_shape,
    "cats_eye": bokeh.cats_eye,
    "anamorphic": bokeh.anamorphic,
    "falloff": falloff.falloff,
    "against_post": falloff.against_post,
    "depth_of_field": sharpness.depth_of_field,
    "series": sharpness.series,
    "pinhole": sharpness.pinhole,
    "panorama": projection.panorama,
}
