"""Every plot of the report in one place. Matplotlib is imported when one is drawn, not before."""

from neurolens.analysis.layout import lens_layout
from neurolens.evaluate.plots.image import image_caption, side_by_side
from neurolens.evaluate.plots.light import illumination_plot
from neurolens.evaluate.plots.trade import error_against_coefficients_plot, pareto_plot

__all__ = [
    "error_against_coefficients_plot",
    "illumination_plot",
    "image_caption",
    "lens_layout",
    "pareto_plot",
    "side_by_side",
]
