"""A lens of another size: the same pictures on another film."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

from neurolens.base.errors import InputError
from neurolens.optics.prescription import Configuration, Lens, Surface


def scaled(lens: Lens, factor: float) -> Lens:
    """All lengths times `factor`; angles, indices and f-number stay.

    A grey filter keeps its density (its absorption per mm shrinks as it grows), a catalogue glass absorbs more when it
    is thicker, and coatings keep their layers.

    Raises:
        InputError: a factor that is not positive and finite.
    """
    if not 0 < factor < math.inf:
        raise InputError(lens.path, "factor", factor, "a positive number")

    def scale(value: Any) -> Any:
        return None if value is None else value * factor

    def gaps(pairs: tuple[tuple[int, Any], ...]) -> tuple[tuple[int, Any], ...]:
        return tuple((k, t * factor) for k, t in pairs)

    def surface(s: Surface) -> Surface:
        return replace(
            s,
            radius_mm=scale(s.radius_mm),
            thickness_mm=scale(s.thickness_mm),
            diameter_mm=s.diameter_mm * factor,
            asphere=tuple((p, a * factor ** (1 - p)) for p, a in s.asphere),
            absorption_per_mm=s.absorption_per_mm / factor,
        )

    def configuration(c: Configuration) -> Configuration:
        return replace(
            c,
            efl_mm=scale(c.efl_mm),
            thickness_mm=gaps(c.thickness_mm),
            stop_diameter_mm=scale(c.stop_diameter_mm),
            object_distance_mm=scale(c.object_distance_mm),
        )

    return replace(
        lens,
        surfaces=tuple(surface(s) for s in lens.surfaces),
        configurations=tuple(configuration(c) for c in lens.configurations),
        infinity_mm=gaps(lens.infinity_mm),
        image_radius_mm=scale(lens.image_radius_mm),
        film_z_mm=scale(lens.film_z_mm),
        stated_efl_mm=scale(lens.stated_efl_mm),
        stated_efl_x_mm=scale(lens.stated_efl_x_mm),
    )
