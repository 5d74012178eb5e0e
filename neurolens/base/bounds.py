"""Bounds that every input keeps: beyond them searches take minutes or find no light."""

from __future__ import annotations

F_NUMBER = 0.1, 10_000.0
FOCAL_MM = 1e-3, 1e6
FILM_MM = 1e-3, 1e4  # a side
WAVELENGTH_NM = 100.0, 20_000.0  # from lithography to thermal cameras
RANGE = "range"  # a zoom position that stands for all of them


def within(bounds: tuple[float, float], value: float) -> bool:
    """True for a value between two bounds, False for NaN."""
    return bounds[0] <= value <= bounds[1]


def said(bounds: tuple[float, float]) -> str:
    """The bounds in words: "from 0.1 to 10000"."""
    return f"from {bounds[0]:g} to {bounds[1]:g}"
