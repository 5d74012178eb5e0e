"""What a lens, a stop and a film can be, wherever one is asked for: beyond, searches take minutes or find no light."""

from __future__ import annotations

F_NUMBER = 0.1, 10_000.0
FOCAL_MM = 1e-3, 1e6
FILM_MM = 1e-3, 1e4  # a side
WAVELENGTH_NM = 100.0, 20_000.0  # from lithography to thermal cameras
RANGE = "range"  # as a zoom position: all of them


def within(bounds: tuple[float, float], value: float) -> bool:
    """Whether a value lies between two bounds; NaN does not."""
    return bounds[0] <= value <= bounds[1]


def said(bounds: tuple[float, float]) -> str:
    """The bounds in words: "from 0.1 to 10000"."""
    return f"from {bounds[0]:g} to {bounds[1]:g}"
