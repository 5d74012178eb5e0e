"""Names of what a lens as a program is given and gives: millimetres and nanometres, lens frame."""

from __future__ import annotations

# Per ray.
RAY = ("film_x_mm", "film_y_mm", "pupil_x_mm", "pupil_y_mm")
FILM_X_Y = RAY[:2]
WAVELENGTH = "wavelength_nm"
# For a whole call.
FILM_Z, STOP_RADIUS = "film_z_mm", "stop_radius_mm"

SCENE_RAY = ("x_mm", "y_mm", "z_mm", "dx", "dy", "dz")
TRANSMITTANCE, STOP, STATUS = "transmittance", ("stop_x_mm", "stop_y_mm"), "status"


def is_per_call(name: str) -> bool:
    """Whether an input is one number for all rays of a call."""
    return name in (FILM_Z, STOP_RADIUS)


def derivative(output: str, by: str) -> str:
    """Name of the output that holds the derivative of one output by one input."""
    return f"{output}_by_{by}"
