"""Lenses that nobody would build but that could be built: random surfaces, clear of each other, for property tests."""

import math
from dataclasses import replace
from typing import Any

from hypothesis import strategies as hs

from neurolens.optics.prescription import Lens, Surface
from neurolens.optics.sag import sag_mm

RIM_MM = 10.0


def numbers(low: float, high: float) -> hs.SearchStrategy[float]:
    return hs.floats(low, high, allow_nan=False, width=64)


@hs.composite
def surfaces(draw: Any, cylinders: bool = True) -> Surface:
    """A surface of semi-diameter 6 to 10 mm, its radius from just above that to a plane; medium and gap come later."""
    rim = draw(numbers(6.0, RIM_MM))
    kind = draw(hs.sampled_from(["sphere", "sphere", "plane", "conic", "asphere"] + ["cylinder"] * cylinders))
    if kind == "plane":
        return Surface(math.inf, 0.0, 2 * rim)
    ratio = draw(hs.sampled_from([1.001, 1.05]) | numbers(1.2, 4.0) | numbers(4.0, 1e4))
    radius = draw(hs.sampled_from([1, -1])) * rim * ratio
    surface = Surface(radius, 0.0, 2 * rim)
    if kind == "sphere":
        return surface
    if kind == "cylinder":
        return replace(surface, cylinder=draw(hs.sampled_from(["x", "y"])))
    # 1 - (1 + K) (h / R)^2 stays positive to the rim.
    conic = draw(numbers(-4.0, 0.8 * (ratio * ratio - 1)).filter(lambda k: k < 20)) if ratio > 1.1 else -0.5
    surface = replace(surface, conic=conic)
    if kind == "conic":
        return surface
    powers = draw(hs.sets(hs.sampled_from([2, 3, 4, 5, 6, 8, 10]), min_size=1, max_size=3))
    share = {2: 0.02, 3: 0.02}
    terms = tuple((p, draw(numbers(-1, 1)) * share.get(p, 0.01) * rim / rim**p) for p in sorted(powers))
    return replace(surface, asphere=terms)


@hs.composite
def lenses(draw: Any, cylinders: bool = True) -> Lens:
    """One to four elements, some cemented, with a stop behind one of them, film not set."""
    rows: list[Surface] = []
    for _ in range(draw(hs.integers(1, 4))):
        for _ in range(draw(hs.integers(1, 2))):
            index = draw(numbers(1.35, 2.0) | hs.just(1.6) | hs.just(1.6 + 1e-6))
            rows.append(replace(draw(surfaces(cylinders)), n_d=index, V_d=draw(hs.just(None) | numbers(20, 80))))
        rows.append(draw(surfaces(cylinders)))
        if draw(hs.booleans()):
            rows.append(Surface(math.inf, 0.0, draw(numbers(4.0, 2 * RIM_MM))))
    stop = draw(hs.integers(0, len(rows) - 1))
    gaps = [
        gap_mm(a, b) + draw(numbers(0.0, 8.0)) for a, b in zip(rows, [*rows[1:], Surface(math.inf, 0, 1)], strict=True)
    ]
    made = (replace(s, thickness_mm=g, stop=k == stop) for k, (s, g) in enumerate(zip(rows, gaps, strict=True)))
    return Lens("random", "", tuple(made), 2.0)


def gap_mm(a: Surface, b: Surface) -> float:
    """The least distance of two vertices that keeps the surfaces clear of each other inside their rims."""
    rim = min(a.semi_diameter_mm, b.semi_diameter_mm)
    places = [rim * i / 16 for i in range(17)]
    points = [*((h, 0.0) for h in places), *((0.0, h) for h in places), *((0.7 * h, 0.7 * h) for h in places)]
    return max(0.0, *(sag_mm(a, *at) - sag_mm(b, *at) for at in points)) + 1e-3
