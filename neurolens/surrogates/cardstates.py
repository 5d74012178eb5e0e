"""Cards of models of many states: the axes, and lens and domain at any state, mixed from their tables at the nodes.

Plain numbers as in the card, so that fitting and loading share one rule. What the graph uses as a square is mixed as a
square, what it uses as a reciprocal as a reciprocal: table and graph then agree to rounding.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from neurolens.base.errors import InputError
from neurolens.surrogates.axes import Axis, product, weights

Array = NDArray[np.float64]
STATE = "state"
_ROUNDED = 0.01  # of the source's own figures for the ends of a zoom
# 1 / distance (1/m) that counts as infinity.
_FAR = 1e-9


def axes_of(card: Mapping[str, Any]) -> tuple[Axis, ...]:
    """State axes of a card that `cardcheck` passed; none for a model of one state."""
    states = card.get("states")
    return tuple(Axis.from_dict(a) for a in states["axes"]) if states else ()


def default_state(card: Mapping[str, Any]) -> tuple[float, ...]:
    """The state whose lens and domain stand in the card itself."""
    states = card.get("states")
    return tuple(float(v) for v in states["default"]) if states else ()


def card_at(card: Mapping[str, Any], axes: Sequence[Axis], state: Sequence[float]) -> dict[str, Any]:
    """The card with lens and domain at a state.

    Raises:
        InputError: another number of values than axes, or one out of range.
    """
    nodes, w = card["states"]["nodes"], weights(axes, state)
    lens = mix_lens([n["lens"] for n in nodes], w)
    return {**card, "lens": lens, "domain": mix_domain([n["domain"] for n in nodes], w)}


def state_numbers(axes: Sequence[Axis], state: ArrayLike) -> tuple[float, ...]:
    """A state as given to a call, in range or not.

    Raises:
        InputError: another number of values than axes, or no numbers.
    """
    try:
        values = tuple(float(v) for v in np.atleast_1d(np.asarray(state, np.float64)))
    except (TypeError, ValueError):
        values = ()
    if not axes or len(values) != len(axes):
        expected = f"{len(axes)} numbers ({', '.join(a.name for a in axes) or 'a model of one state'})"
        raise InputError("OnnxLens.rays", "state", state, expected)
    return values


def state_for(
    path: Any, axes: Sequence[Axis], state: Sequence[float], zoom: str | float | None, focus_m: float
) -> tuple[float, ...]:
    """The state that a photographer asks for.

    Args:
        path: what an error names.
        axes, state: of the model, and where it stands.
        zoom: name of a state of the source, or a focal length in mm; None leaves it where it is.
        focus_m: distance from the film to the object, for internal focus.

    Raises:
        InputError: a zoom position or an internal focus that the model does not have.
    """
    values = dict(zip((a.name for a in axes), state, strict=True))
    for axis in axes:
        if axis.name == "zoom" and zoom is not None:
            values["zoom"] = _zoom(path, axis, zoom)
        elif axis.name == "focus":
            values["focus"] = min(max(1 / focus_m, axis.range[0]), axis.limits[1])
            if 1 / focus_m > axis.limits[1]:
                raise InputError(
                    path, "focus_m", focus_m, f"at least {1 / axis.range[1]:.4g} m, the model's near limit"
                )
    if zoom is not None and "zoom" not in values:
        raise InputError(path, "zoom", zoom, "left out: the model is of one zoom position")
    return tuple(values.values())


def _zoom(path: Any, axis: Axis, zoom: str | float) -> float:
    """Focal length in mm of a zoom position: its name in the source, or a number within the range."""
    low, high = axis.range
    named = dict(axis.stated)
    try:
        value = named[zoom] if isinstance(zoom, str) and zoom in named else float(zoom)
    except ValueError:
        value = float("nan")
    if not low * (1 - _ROUNDED) <= value <= high * (1 + _ROUNDED):
        expected = f"a focal length from {low:.5g} to {high:.5g} mm, or one of: {', '.join(named)}"
        raise InputError(path, "zoom", zoom, expected)
    return min(max(value, low), high)


def check_states(card: Mapping[str, Any], check_node: Any) -> None:
    """Check the table of states of a card; `check_node` raises what is wrong with a node's lens and domain.

    Raises:
        InputError, KeyError, TypeError, ValueError: what does not belong there.
    """
    states = card["states"]
    axes = axes_of(card)
    names = [a.name for a in axes]
    if not axes or len(set(names)) < len(names) or not set(names) <= {"zoom", "focus"}:
        raise InputError("card", "states.axes", names, "zoom, focus, or both")
    nodes = states["nodes"]
    count = len(product(axes))
    if not isinstance(nodes, list) or len(nodes) != count:
        raise InputError("card", "states.nodes", f"({len(nodes)})", f"a list of {count}")
    for node in nodes:
        check_node(node)
    weights(axes, [float(v) for v in states["default"]])
    for reference in states["reference"]:
        weights(axes, [float(v) for v in reference["state"]])
    mix_lens([n["lens"] for n in nodes], weights(axes, default_state(card)))
    mix_domain([n["domain"] for n in nodes], weights(axes, default_state(card)))


def mix_domain(nodes: Sequence[Mapping[str, Any]], weights: Array) -> dict[str, Any]:
    """The domain (as `surrogates.domain.Domain.to_dict` writes it) of a state whose nodes weigh `weights` [K].

    Wavelengths and the nearest object are those of the first node; the distances in focus are mixed as 1 / distance.
    """
    bounds = [n["bounds"] for n in nodes]
    known = _mixed_fields(nodes, weights, "film_z_mm", "pupil_z_mm", "stop_radius_mm")
    for key in ("film_radius_mm", "pupil_radius_mm"):
        known[key] = math.sqrt(_mixed([float(n[key]) ** 2 for n in nodes], weights))
    nearness = [_mixed([1 / float(n["focus_m"][i]) for n in nodes], weights) for i in (0, 1)]
    known["focus_m"] = [1 / v if v > _FAR else "inf" for v in nearness]
    table = _mixed_fields(bounds, weights, "low_mm", "high_mm", "half_mm", "disc_mm")
    table |= {k: known[k] for k in ("pupil_z_mm", "film_radius_mm")}
    return {**nodes[0], **known, "bounds": {**bounds[0], **table}}


def mix_lens(nodes: Sequence[Mapping[str, Any]], weights: Array) -> dict[str, Any]:
    """The card's table of the lens at a state.

    The power 1 / f, the front focal distance over f and the back focal plane are sums of products of the gaps: they
    are mixed, and the principal planes follow.
    """
    linear = _mixed_fields(nodes, weights, "f_number", "stop_radius_mm", "film_z_mm", "infinity_film_z_mm")
    efl, ratio = 1 / _mixed([1 / n["efl_mm"] for n in nodes], weights), float(nodes[0].get("index_ratio", 1.0))
    focal = [(n["front_principal_z_mm"] - ratio * n["efl_mm"]) / n["efl_mm"] for n in nodes]
    front = efl * _mixed(focal, weights) + ratio * efl
    pupils = [n.get("exit_pupil_z_mm", "inf") for n in nodes]
    return {
        **nodes[0],
        **linear,
        "efl_mm": efl,
        "front_principal_z_mm": front,
        "rear_principal_z_mm": linear["infinity_film_z_mm"] - efl,
        "exit_pupil_z_mm": "inf" if "inf" in pupils else _mixed(pupils, weights),
    }


def _mixed_fields(tables: Sequence[Mapping[str, Any]], weights: Array, *names: str) -> dict[str, Any]:
    return {name: _mixed([table[name] for table in tables], weights) for name in names}


def _mixed(values: Sequence[ArrayLike], weights: Array) -> Any:
    """Weighted sum of numbers or lists; exactly the value of a node whose weight is 1."""
    found = weights @ np.asarray(values, dtype=np.float64)
    return float(found) if found.ndim == 0 else found.tolist()
