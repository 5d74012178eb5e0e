"""What a model of many states says of its lens and domain at each: tables at the nodes, mixed at a state between.

Plain numbers as in the card, so that fitting and loading share one rule. What the graph uses as a square is mixed as a
square, what it uses as a reciprocal as a reciprocal: table and graph then agree to rounding.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]
# 1 / distance (1/m) that counts as infinity.
_FAR = 1e-9


def mix_domain(nodes: Sequence[Mapping[str, Any]], weights: Array) -> dict[str, Any]:
    """The domain (as `surrogates.domain.Domain.to_dict` writes it) of a state whose nodes weigh `weights` [K].

    Wavelengths and the nearest object are those of the first node; the distances in focus are mixed as 1 / distance.
    """

    def mixed(key: str) -> Any:
        return _mixed([n[key] for n in nodes], weights)

    def as_square(key: str) -> float:
        return math.sqrt(_mixed([float(n[key]) ** 2 for n in nodes], weights))

    bounds = [n["bounds"] for n in nodes]
    radius, plane = as_square("film_radius_mm"), mixed("pupil_z_mm")
    table = {k: _mixed([b[k] for b in bounds], weights) for k in ("low_mm", "high_mm", "half_mm", "disc_mm")}
    nearness = [_mixed([1 / float(n["focus_m"][i]) for n in nodes], weights) for i in (0, 1)]
    return {
        **nodes[0],
        "film_radius_mm": radius,
        "film_z_mm": mixed("film_z_mm"),
        "focus_m": [1 / v if v > _FAR else "inf" for v in nearness],
        "pupil_z_mm": plane,
        "pupil_radius_mm": as_square("pupil_radius_mm"),
        "stop_radius_mm": mixed("stop_radius_mm"),
        "bounds": {**bounds[0], **table, "pupil_z_mm": plane, "film_radius_mm": radius},
    }


def mix_lens(nodes: Sequence[Mapping[str, Any]], weights: Array) -> dict[str, Any]:
    """The card's table of the lens at a state.

    The power 1 / f, the front focal distance over f and the back focal plane are sums of products of the gaps: they
    are mixed, and the principal planes follow.
    """

    def of(value: Callable[[Mapping[str, Any]], Any]) -> Any:
        return _mixed([value(n) for n in nodes], weights)

    efl = 1 / of(lambda n: 1 / n["efl_mm"])
    focal = of(lambda n: n["infinity_film_z_mm"])
    front = efl * of(lambda n: (n["front_principal_z_mm"] - n["efl_mm"]) / n["efl_mm"]) + efl
    linear = {k: _mixed([n[k] for n in nodes], weights) for k in ("f_number", "stop_radius_mm", "film_z_mm")}
    pupils = [n.get("exit_pupil_z_mm", "inf") for n in nodes]
    return {
        **nodes[0],
        **linear,
        "efl_mm": efl,
        "infinity_film_z_mm": focal,
        "front_principal_z_mm": front,
        "rear_principal_z_mm": focal - efl,
        "exit_pupil_z_mm": "inf" if "inf" in pupils else _mixed(pupils, weights),
    }


def _mixed(values: Sequence[ArrayLike], weights: Array) -> Any:
    """Weighted sum of numbers or lists; exactly the value of a node whose weight is 1."""
    found = weights @ np.asarray(values, dtype=np.float64)
    return float(found) if found.ndim == 0 else found.tolist()
