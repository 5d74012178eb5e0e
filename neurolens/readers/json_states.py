"""Zoom and focus states of a JSON prescription, each checked against the paraxial conjugates of its own table."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from neurolens.base.errors import InputError
from neurolens.base.tomlfile import reject_unknown
from neurolens.optics.lensfile import number, text
from neurolens.optics.prescription import Configuration, Lens
from neurolens.readers.assemble import check_states, first_order, moved
from neurolens.readers.source import warn

KEYS = (
    *("name", "efl_mm", "efl_y_mm", "efl_x_mm", "f_number", "object_distance_mm", "magnification"),
    *("thickness_overrides", "stop_diameter_mm", "interpolated_by_transcriber", "note"),
)
MAX_STATES = 200
DOUBTFUL = 0.05  # relative difference of a stated object distance from the paraxial one that is worth a warning


def read_states(lens: Lens, data: Mapping[str, Any]) -> Lens:
    """The lens with the states of the file.

    Raises:
        InputError: an unknown key, a surface that does not exist, a value out of range, a name given twice, surfaces
            that overlap in a state.
    """
    tables = _tables(data, lens.path)
    states: list[Configuration] = []
    for place, table in enumerate(tables):
        where = f"configuration {place}, "
        if not isinstance(table, Mapping):
            raise InputError(lens.path, f"configuration {place}", table, "an object with thickness_overrides")
        reject_unknown(lens.path, where, table, KEYS)
        name = text(table, "name", lens.path, where)
        if table.get("interpolated_by_transcriber"):
            warn(lens.path, f'configuration "{name}" is left out: interpolated by the transcriber, not from the source')
            continue
        if name in [c.name for c in states]:
            raise InputError(lens.path, f"{where}name", name, "a name that no other configuration has")
        states.append(_state(lens, table, name))
    whole = replace(lens, configurations=tuple(states))
    check_states(whole)
    return whole


def _tables(data: Mapping[str, Any], file: str) -> list[Any]:
    given = data.get("configurations")
    if isinstance(given, Mapping):
        reject_unknown(file, "configurations, ", given, ("configs",))
        given = given.get("configs")
    tables = [] if given is None else given
    if not isinstance(tables, list) or len(tables) > MAX_STATES:
        raise InputError(file, "configurations", given, f"null or a list of at most {MAX_STATES} states")
    return tables


def _state(lens: Lens, table: Mapping[str, Any], name: str) -> Configuration:
    """One state; what the source leaves open (focal length, object distance) follows from its thicknesses."""
    where = f'configuration "{name}", '
    given: dict[str, float | None] = {
        key: number(table, key, lens.path, where, above=0) if table.get(key) is not None else None
        for key in ("efl_mm", "efl_y_mm", "f_number", "stop_diameter_mm")
    }
    efl_y, distance = given.pop("efl_y_mm"), table.get("object_distance_mm")
    efl = given.pop("efl_mm") if given["efl_mm"] is not None else (given.pop("efl_mm"), efl_y)[1]
    state = Configuration(name, efl, _thickness(lens, table, where), **given)
    table_lens = moved(lens, state)
    paraxial_mm = _object_distance_mm(table_lens)
    if isinstance(distance, str):
        if not (math.isfinite(paraxial_mm) and paraxial_mm > 0):
            raise InputError(lens.path, f"{where}object_distance_mm", distance, "a distance in mm, or null")
        warn(lens.path, f"{where}object_distance_mm {distance!r}: {paraxial_mm:.6g} mm follows from the thicknesses")
        return replace(state, object_distance_mm=paraxial_mm)
    if distance is not None:
        stated = number(table, "object_distance_mm", lens.path, where, unit="mm", above=0)
        if not abs(paraxial_mm / stated - 1) <= DOUBTFUL:
            warn(lens.path, f"{where}object_distance_mm {stated:g} is stated; the thicknesses focus {paraxial_mm:.6g}")
        return replace(state, object_distance_mm=stated)
    return state if efl is not None else replace(state, efl_mm=first_order(table_lens).efl_mm)


def _object_distance_mm(lens: Lens) -> float:
    """Distance from the object in focus on the tabled film to the front vertex (Newton's x x' = -f^2)."""
    data = first_order(lens)
    beyond = float(lens.vertices_mm[-1]) - data.rear_focal_z_mm
    return data.efl_mm**2 / beyond - data.front_focal_z_mm if beyond else math.inf


def _thickness(lens: Lens, table: Mapping[str, Any], where: str) -> tuple[tuple[int, float], ...]:
    given = table.get("thickness_overrides", "(missing)")
    if not isinstance(given, Mapping):
        raise InputError(lens.path, f"{where}thickness_overrides", given, 'an object such as {"5": 26.15}')
    found = []
    for key in given:
        if not (key.isascii() and key.isdecimal() and len(key) < 5 and int(key) < len(lens.surfaces)):
            expected = f"a surface number from 0 to {len(lens.surfaces) - 1}"
            raise InputError(lens.path, f"{where}thickness_overrides", key, expected)
        value = number(given, key, lens.path, f"{where}thickness_overrides, surface ", unit="mm")
        found.append((int(key), value))
    return tuple(sorted(found))
