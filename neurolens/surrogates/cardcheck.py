"""The card of an exported model, checked on loading: everything that is read later is there and makes sense."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from functools import reduce
from typing import Any

import numpy as np
from numpy.typing import NDArray

from neurolens.base.errors import InputError, ModelError
from neurolens.surrogates.cardkeys import AVERAGED, POLARISED
from neurolens.surrogates.cardstates import check_states


def is_number(value: Any) -> bool:
    """Whether this is a number of JSON that a float holds."""
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        return False
    try:
        return math.isfinite(float(value))
    except OverflowError:  # an integer beyond every float
        return False


def _positive(value: Any) -> bool:
    """Whether a number and its reciprocal are above 0 in float32, too."""
    return is_number(value) and 1e-30 <= value <= 1e30


def _integer(value: Any, least: int, most: int) -> bool:
    return isinstance(value, int) and not isinstance(value, bool) and least <= value <= most


def _pair(value: Any, holds: Callable[[Any], bool]) -> bool:
    return isinstance(value, list) and len(value) == 2 and all(map(holds, value))


def _errors(value: Any, depth: int = 3) -> bool:
    """Figures by name, those of parts of the rays in tables of their own; lists are for readers."""
    return isinstance(value, dict) and all(
        v is None
        or isinstance(v, (bool, str, list))
        or (is_number(v) and v >= 0)
        or (depth > 0 and _errors(v, depth - 1))
        for v in value.values()
    )


Rule = tuple[Callable[[Any], bool], str]
NUMBER: Rule = (is_number, "a finite number")
POSITIVE: Rule = (_positive, "a finite number above 0")
TEXT: Rule = (lambda v: isinstance(v, str), "a text")
TABLE: Rule = (lambda v: isinstance(v, dict), "a table")
NUMBERS: Rule = (
    lambda v: isinstance(v, list) and len(v) >= 2 and all(map(is_number, v)),
    "a list of two or more finite numbers",
)
RISING: Rule = (lambda v: _pair(v, _positive) and v[0] <= v[1], "two numbers above 0, rising")

# Place in the card to what must be there. A table comes before what is in it.
_RULES: dict[str, Rule] = {
    "lens": TABLE,
    "lens.id": TEXT,
    "lens.name": TEXT,
    "lens.sha256": TEXT,
    "lens.dispersive": (lambda v: isinstance(v, bool), "true or false"),
    "lens.efl_mm": (lambda v: is_number(v) and v != 0, "a finite number other than 0"),
    "lens.f_number": POSITIVE,
    "lens.stop_radius_mm": POSITIVE,
    "lens.front_principal_z_mm": NUMBER,
    "lens.rear_principal_z_mm": NUMBER,
    "domain": TABLE,
    "domain.film_radius_mm": POSITIVE,
    "domain.film_z_mm": RISING,
    "domain.focus_m": (lambda v: _pair(v, lambda d: d == "inf" or _positive(d)), 'two distances above 0, or "inf"'),
    "domain.pupil_z_mm": NUMBER,
    "domain.pupil_radius_mm": POSITIVE,
    "domain.wavelength_nm": RISING,
    "domain.stop_radius_mm": POSITIVE,
    "domain.bounds": TABLE,
    "domain.bounds.pupil_z_mm": NUMBER,
    "domain.bounds.film_radius_mm": POSITIVE,
    "domain.bounds.disc_mm": POSITIVE,
    "domain.bounds.low_mm": NUMBERS,
    "domain.bounds.high_mm": NUMBERS,
    "domain.bounds.half_mm": NUMBERS,
    "fit": TABLE,
    "fit.method": TEXT,
    "fit.settings": TABLE,
    "errors": (_errors, "a table of figures from 0 up, of tables of such, of texts and lists"),
}
_OPTIONAL: dict[str, Rule] = {
    "transmittance": (lambda v: v in (POLARISED, AVERAGED), f'"{POLARISED}" or "{AVERAGED}"'),
    "lens.stop_surface": (lambda v: _integer(v, 0, 9999), "an integer"),
    "lens.index_ratio": POSITIVE,
    "domain.nearest_m": (lambda v: v is None or _positive(v), "a number above 0, or null"),
    "errors.poor": (lambda v: isinstance(v, list) and all(isinstance(t, str) for t in v), "a list of texts"),
    "fit.settings.rays_seed": (lambda v: v is None or _integer(v, -(2**53), 2**53), "an integer up to 2^53, or null"),
}


def check_card(file: Any, card: Mapping[str, Any]) -> None:
    """Check a card.

    Args:
        file: what an error names.

    Raises:
        ModelError: the first place that is missing or holds something else, and what belongs there.
    """
    _check_places(file, card, {**_RULES, **_OPTIONAL})
    if card.get("states") is None:
        return
    node_rules = {k: rule for k, rule in _RULES.items() if k.split(".")[0] in ("lens", "domain")}
    node_rules["lens.infinity_film_z_mm"] = node_rules["lens.film_z_mm"] = NUMBER
    try:
        check_states(card, lambda node: _check_places(f"{file}: card: states.nodes", node, node_rules))
    except (InputError, KeyError, TypeError, ValueError, ArithmeticError) as error:
        raise ModelError(f"{file}: card: states: {type(error).__name__}: {error}") from error


def tolerances(card: Mapping[str, Any], reference: Mapping[str, Any]) -> dict[str, float]:
    """How far reference rays may be off: ten times what float32 may cost, more where they say that it costs more.

    Position and stop crossing in mm, direction and transmittance; changed weights show.

    Raises:
        AttributeError, TypeError, ValueError: no finite numbers.
    """
    mm, rounding = 1e-5 * max(1.0, abs(float(card["lens"]["efl_mm"]))), reference.get("rounding") or {}
    least = {"position_mm": mm, "direction": 1e-5, "transmittance": 1e-5, "stop_mm": mm}
    found = {name: max(value, float(rounding.get(name, 0.0))) for name, value in least.items()}
    if not all(map(math.isfinite, found.values())):
        raise ValueError("not finite")
    return found


@np.errstate(over="ignore")
def pupil_rows(bounds: Mapping[str, Any]) -> NDArray[np.float32]:
    """[3, R] low, high, half of the boxes in a card's bounds.

    Raises:
        InputError: no three lists of equal length, or numbers that float32 cannot hold.
    """
    rows = np.array([bounds["low_mm"], bounds["high_mm"], bounds["half_mm"]], dtype=np.float32)
    if rows.ndim != 2 or rows.shape[1] < 2 or not np.isfinite(rows).all():
        raise InputError("pupil bounds", "low_mm, high_mm, half_mm", rows.shape, "three lists of finite numbers")
    return rows


def _check_places(file: Any, card: Mapping[str, Any], rules: Mapping[str, Rule]) -> None:
    for place, (holds, expected) in rules.items():
        *tables, last = place.split(".")
        # All tables but the last are there, for they have rules of their own.
        table = reduce(lambda found, key: found[key], tables, card)
        if place in _OPTIONAL and last not in table:
            continue
        if last not in table or not holds(table[last]):
            shown = repr(table[last])[:80] if last in table else "(missing)"
            raise ModelError(f"{file}: card: {place}: got {shown}, expected {expected}")
    try:
        pupil_rows(card["domain"]["bounds"])
    except (InputError, ValueError, OverflowError) as error:
        raise ModelError(f"{file}: card: domain.bounds: {error}") from error
