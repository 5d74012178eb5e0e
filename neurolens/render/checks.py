"""Checks of values in scene tables; the reader adds the file to the error."""

from __future__ import annotations

import math

from neurolens.base.errors import InputError

Vector = tuple[float, float, float]
BLACK: Vector = (0.0, 0.0, 0.0)
# Squares and products stay far from the limits of float32.
SMALLEST_M, FARTHEST_M = 1e-9, 1e9
BRIGHTEST = 1e18
MOST_DEG = 36000.0


def require(ok: bool, field: str, value: object, expected: str) -> None:
    if not ok:
        raise InputError("scene", field, value, expected)


def require_angle(field: str, value: float) -> None:
    require(abs(value) <= MOST_DEG, field, value, f"degrees, at most {MOST_DEG:g} either way")


def require_direction(field: str, value: Vector) -> None:
    ok = all(abs(x) <= FARTHEST_M for x in value) and length(value) >= SMALLEST_M
    require(ok, field, value, f"a direction, between {SMALLEST_M:g} and {FARTHEST_M:g} long")


def require_place(field: str, value: Vector) -> None:
    require(all(abs(x) <= FARTHEST_M for x in value), field, value, f"three numbers within {FARTHEST_M:g} m")


def require_size(field: str, value: float) -> None:
    require(SMALLEST_M <= value <= FARTHEST_M, field, value, f"a length from {SMALLEST_M:g} to {FARTHEST_M:g} m")


def require_positive(field: str, value: float) -> None:
    require(0 < value < math.inf, field, value, "a finite number above 0")


def require_reflectance(field: str, value: Vector) -> None:
    require(all(0 <= x <= 1 for x in value), field, value, "three numbers from 0 to 1")


def require_emission(field: str, value: Vector) -> None:
    require(all(0 <= x <= BRIGHTEST for x in value), field, value, f"three numbers from 0 to {BRIGHTEST:g}")


def length(vector: Vector) -> float:
    return math.sqrt(sum(x * x for x in vector))


def check_fields(item: object, what: str, needed: tuple[str, ...], optional: tuple[str, ...]) -> None:
    """Every needed field is there, and none that the kind does not know."""
    for field, value in vars(item).items():
        if field == "kind":
            continue
        require(value is not None or field not in needed, field, "(missing)", f"given for {what}")
        known = field in needed or field in optional
        require(value is None or known, field, value, f"left out: {what} has {', '.join(needed + optional)}")
