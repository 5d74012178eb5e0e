"""Accessories: filters before and behind the lens, hoods; and the pinhole, a lens without glass.

Each adds a few rows to the table: surfaces are renumbered, by 2 behind a front filter, by 1 behind a hood.
"""

from __future__ import annotations

import math
from dataclasses import replace

from neurolens.base.errors import InputError
from neurolens.optics.prescription import Configuration, Lens, Surface
from neurolens.optics.sag import check_clearance, sag_mm

BK7_N_D, BK7_V_D = 1.5168, 64.17
_WIDEST_DEG = 75.0  # half field; for a wider one an unvignetting plate would be over four times as wide as its distance


def pinhole(film_distance_mm: float, radius_mm: float, *, image_radius_mm: float | None = None) -> Lens:
    """A lens without glass: a round hole of finite size in front of the film; lengths that are not positive are
    refused.

    Its focal length is the distance to the film, its f-number that over the diameter; focusing changes nothing.
    """
    _require("pinhole", film_distance_mm=film_distance_mm, radius_mm=radius_mm)
    hole = Surface(math.inf, film_distance_mm, 2 * radius_mm, stop=True)
    return Lens("pinhole", "", (hole,), film_distance_mm / (2 * radius_mm), image_radius_mm, path="pinhole")


def with_filter(
    lens: Lens,
    thickness_mm: float = 2.0,
    *,
    n_d: float = BK7_N_D,
    V_d: float | None = BK7_V_D,
    absorption_per_mm: float = 0.0,
    gap_mm: float = 3.0,
    diameter_mm: float | None = None,
    rear: bool = False,
) -> Lens:
    """The lens with a plane plate before its front surface, or behind its last one.

    A plate shifts what is seen through it by t (1 - 1/n): the film of a rear filter moves back by that,
    and an object before a front filter seems as much nearer.

    Args:
        absorption_per_mm: Napierian: the plate lets exp(-absorption thickness) through.
        gap_mm: air between the plate and the vertex of the surface beside it.
        diameter_mm: of the plate. None: a front plate is wide enough for the stated half field (to 75 degrees), a rear
            one for everything that leaves the last surface at up to 45 degrees.

    Raises:
        InputError: a value out of range, no room: a plate that would touch the lens, or the film.
    """
    _require(lens.path, thickness_mm=thickness_mm)
    for key, value, least, expected in (
        ("n_d", n_d, 1, "a refractive index from 1"),
        ("V_d", 1.0 if V_d is None else V_d, 1e-300, "an Abbe number above 0, or None"),
        ("absorption_per_mm", absorption_per_mm, 0, "a number of at least 0, in 1/mm"),
        ("gap_mm", gap_mm, 0, "a length of at least 0, in mm"),
    ):
        if not _is_number(value) or not least <= value < math.inf:
            raise InputError(lens.path, f"filter, {key}", value, expected)
    beside = lens.surfaces[-1 if rear else 0]
    if diameter_mm is None:
        field = 45.0 if rear else min(lens.half_field_deg or 45.0, _WIDEST_DEG)
        sag = sag_mm(beside, beside.semi_diameter_mm, 0.0)  # the rim may lie further away than the vertex
        reach = gap_mm + thickness_mm + max(-sag if rear else sag, 0.0)
        diameter_mm = beside.diameter_mm + 2 * reach * math.tan(math.radians(field))
    _require(lens.path, diameter_mm=diameter_mm)
    plate = Surface(
        math.inf, thickness_mm, diameter_mm, n_d, V_d, material="filter", absorption_per_mm=absorption_per_mm
    )
    behind = Surface(math.inf, gap_mm, diameter_mm)
    return _behind(lens, plate, behind, gap_mm) if rear else _before(lens, plate, behind)


def with_hood(lens: Lens, length_mm: float, diameter_mm: float) -> Lens:
    """The lens with a round hood: a ring `length_mm` before the front vertex that stops light beyond `diameter_mm`.

    Raises:
        InputError: a length that is not a positive number.
    """
    _require(lens.path, length_mm=length_mm, diameter_mm=diameter_mm)
    return _before(lens, Surface(math.inf, length_mm, diameter_mm))


def _require(where: str, **lengths_mm: float) -> None:
    for field, value in lengths_mm.items():
        if not _is_number(value) or not 0 < value < math.inf:
            raise InputError(where, field, value, "a finite number above 0, in mm")


def _is_number(value: object) -> bool:
    """Whether a value can be compared with numbers: a number, or a tensor with one."""
    return not isinstance(value, bool) and hasattr(value, "__float__")


def _before(lens: Lens, *rows: Surface) -> Lens:
    """Rows before the front surface; z = 0 moves to the first of them."""
    length = sum(row.thickness_mm for row in rows)

    def moved(c: Configuration) -> Configuration:
        away = c.object_distance_mm
        if away is not None and not away > length:
            raise InputError(lens.path, f'configuration "{c.name}", object_distance_mm', away, f"above {length:g} mm")
        return replace(
            c,
            thickness_mm=_renumbered(c.thickness_mm, len(rows)),
            object_distance_mm=None if away is None else away - length,
        )

    surfaces = (*rows, *lens.surfaces)
    check_clearance(surfaces, lens.path)
    return replace(
        lens,
        surfaces=surfaces,
        configurations=tuple(moved(c) for c in lens.configurations),
        infinity_mm=_renumbered(lens.infinity_mm, len(rows)),
        film_z_mm=None if lens.film_z_mm is None else lens.film_z_mm + length,
    )


def _behind(lens: Lens, plate: Surface, air: Surface, gap_mm: float) -> Lens:
    """A plate behind the last surface; every distance from there to the film becomes one behind the plate."""
    last = len(lens.surfaces) - 1
    taken = gap_mm + plate.thickness_mm / plate.n_d  # the rest of the distance to the film

    def moved(gaps: tuple[tuple[int, float], ...]) -> tuple[tuple[int, float], ...]:
        return tuple((k + 2, t - taken) if k == last else (k, t) for k, t in gaps)

    surfaces = (
        *lens.surfaces[:-1],
        replace(lens.surfaces[-1], thickness_mm=gap_mm),
        plate,
        replace(air, thickness_mm=lens.surfaces[-1].thickness_mm - taken),
    )
    changed = replace(
        lens,
        surfaces=surfaces,
        configurations=tuple(replace(c, thickness_mm=moved(c.thickness_mm)) for c in lens.configurations),
        infinity_mm=moved(lens.infinity_mm),
        film_z_mm=None if lens.film_z_mm is None else lens.film_z_mm + plate.thickness_mm * (1 - 1 / plate.n_d),
    )
    check_clearance(surfaces, lens.path)
    film = changed.vertices_mm[-1] if changed.film_z_mm is None else changed.film_z_mm
    if not film > changed.vertices_mm[-2]:
        raise InputError(lens.path, "filter", f"({gap_mm:g} mm + {plate.thickness_mm:g} mm)", "room before the film")
    return changed


def _renumbered(gaps: tuple[tuple[int, float], ...], by: int) -> tuple[tuple[int, float], ...]:
    return tuple((k + by, t) for k, t in gaps)
