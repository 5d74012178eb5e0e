"""Status of a ray: passed, or the reason and the surface that ended it.

One integer per ray, the same codes for the exact tracer and for exported models:

    0                 passed
    1                 outside the domain of a model; for a lens, a wavelength for which none of its glasses is stated
    2                 no solution found (inverse maps of models only)
    4 (k + 1) + r     ended at surface k (0-based, counted from the scene), for reason r:
                      1 missed the surface, 2 blocked by its rim (or by the stop), 3 total reflection

At each surface the reasons are tested in that order; the first failure along the travel wins.
"""

# Relative slack of a domain's bounds: the rounding of float32 inputs, and no more.
DOMAIN_SLACK = 1.00001
PASSED = 0
OUTSIDE_DOMAIN = 1
NO_SOLUTION = 2
MISSED, RIM, TOTAL_REFLECTION = 1, 2, 3
_REASONS = {
    MISSED: "missed surface",
    RIM: "blocked by the rim of surface",
    TOTAL_REFLECTION: "total reflection at surface",
}


def blocked(surface: int, reason: int) -> int:
    """Return the status of a ray that ends at `surface` (0-based, from the scene): MISSED, RIM or TOTAL_REFLECTION."""
    return 4 * (surface + 1) + reason


def surface_of(status: int) -> int | None:
    """Return the surface that ended a ray of this status, or None where none did."""
    return status // 4 - 1 if status >= 4 else None


def describe(status: int) -> str:
    """Return the text of a status, for messages and tables."""
    if status == PASSED:
        return "passed"
    if status == OUTSIDE_DOMAIN:
        return "outside the domain of the model or lens"
    if status == NO_SOLUTION:
        return "no solution found"
    return f"{_REASONS[status % 4]} {status // 4 - 1}"
