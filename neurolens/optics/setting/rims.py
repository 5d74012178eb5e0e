"""Rims: checks that surfaces do not touch inside them, and a rule for the diameters of tables without any.

By the rule, the stop is as wide as the f-number asks. Every other rim lets through the whole beam of the axis; of a
field it lets through the rays whose height in the stop is within a share of the stop's radius, which falls linearly
from 1 on the axis to `vignetting` at the edge of the field. A clear edge is added. Where neighbours would touch inside
their rims, the rims are narrowed to the height where they meet. Rays are real ones of the d line, with the object at
infinity; of a zoom all states count.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from neurolens.base.errors import InputError
from neurolens.optics.lens.figures import SPHERE, Bound
from neurolens.optics.lens.paraxial import first_order, stop_radius_mm
from neurolens.optics.lens.prescription import Configuration, Lens, Surface, same_medium
from neurolens.optics.trace.shapes import sag_mm

TOUCH_MM = 1e-6  # patents often have elements in contact at the edge; only as much as rounding is forgiven
_FIELDS = 17  # from the axis to the edge; rims are usually widest for one of the two
_HEIGHTS = (-1.0, -0.75, -0.5, 0.0, 0.5, 0.75, 1.0)  # heights in the stop, as shares of what the rule lets through
_STEP_MM = 1e-3  # diameters are given to a micrometre
_STEPS = 64
_ROUNDS = 12  # at most: rims of aspheres settle in 2 to 4


def end_mm(surface: Surface) -> float:
    """Return the distance from the axis at which a surface's conic ends (a sphere's radius); inf where it goes on."""
    sections = [(float(surface.radius_mm), float(surface.figure.conic)), surface.figure.across or (math.inf, 0.0)]
    return min(abs(r) / math.sqrt(1 + (k or 0.0)) if (k or 0.0) > -1 else math.inf for r, k in sections)


def check_figures(surfaces: Sequence[Surface], file: str, state: str = "") -> None:
    """Raise for figures that no lens has, whose squares and inverses would overflow; a NaN counts as not yet known.

    Raises:
        InputError: the error names the file, the zoom state if there is one, the surface and the figure.
    """
    for k, s in enumerate(surfaces):
        if s.figure.power and any(t.n_d != 1 or t.glass for t in surfaces[max(k - 1, 0) : k + 1]):
            focal = s.figure.record()["focal_mm"]
            raise InputError(file, f"{state}surface {k}, focal_mm", focal, "air on both sides of an ideal lens")
        rim = min(s.semi_diameter_mm, 1e6)
        bounds: tuple[Bound, ...] = (
            ("radius_mm", abs(s.radius_mm), 1e-6, math.inf, ""),
            ("thickness_mm", abs(s.thickness_mm), 0.0, 1e6, ""),
            ("diameter_mm", s.diameter_mm, 1e-6, 1e6, ""),
            ("V_d", 100.0 if s.V_d in (None, math.inf) else s.V_d, 1.0, 1e4, ""),
            *s.figure.bounds(rim),
            ("absorption_per_mm", s.absorption_per_mm, 0.0, 1e6, ""),
        )
        for name, value, low, high, of in bounds:
            if value < low or value > high:
                expected = f"a size from {low:g} to {high:g}{of}"
                raise InputError(file, f"{state}surface {k}, {name}", float(value), expected)


def check_clearance(surfaces: Sequence[Surface], file: str, state: str = "") -> None:
    """Raise as `check_figures` does, and for rims wider than their sphere and neighbours that overlap inside theirs.

    The gap between two spheres is monotone from the axis outwards, so that the axis and the smaller of the two rims
    decide; other shapes are tested in between, too. A stop that bends nothing may lie inside an element next to it in
    the list; the surfaces on both sides of it must then be clear of each other.

    Raises:
        InputError: the error names the file, the zoom state if there is one, the surface and by how much.
    """
    check_figures(surfaces, file, state)
    for k, s in enumerate(surfaces):
        if s.semi_diameter_mm > end_mm(s):
            limit = f"at most {2 * end_mm(s):g} mm, where its {'conic' if s.figure.conic else 'sphere'} ends"
            raise InputError(file, f"{state}surface {k}, diameter_mm", s.diameter_mm, limit)
    for k, after, axis_gap_mm in neighbours(surfaces):
        if axis_gap_mm < -TOUCH_MM:
            expected = "at least 0, except beside a stop with the same medium before and behind it"
            raise InputError(file, f"{state}surface {k}, thickness_mm", axis_gap_mm, expected)
        gap_mm, height_mm = _narrowest(surfaces[k], surfaces[after], axis_gap_mm)
        if gap_mm < -TOUCH_MM:
            found = f"(an overlap of {-gap_mm:.4g} mm with surface {after}, {height_mm:.4g} mm from the axis)"
            raise InputError(file, f"{state}surface {k}, thickness_mm", found, "surfaces that are clear of each other")


def check_states(lens: Lens) -> None:
    """Raise for rims wider than their sphere and for surfaces that overlap, in the table and in each of its states."""
    check_clearance(lens.surfaces, lens.path)
    for c in lens.configurations:
        check_clearance(lens.with_gaps(dict(c.thickness_mm)).surfaces, lens.path, f'configuration "{c.name}", ')


def _narrowest(before: Surface, after: Surface, axis_gap_mm: float) -> tuple[float, float]:
    """The smallest gap (mm) between two surfaces inside the smaller of their rims, and its distance from the axis."""
    rim = min(before.semi_diameter_mm, after.semi_diameter_mm)
    steps = 1 if before.figure.plain and after.figure.plain else 32
    azimuths = [(1.0, 0.0), (0.0, 1.0)] if before.figure.axis or after.figure.axis else [(1.0, 0.0)]
    found = (axis_gap_mm, 0.0)
    with np.errstate(invalid="ignore", over="ignore"):  # of rims that are not known, and figures that no lens has
        h = rim * np.arange(1, steps + 1) / steps
        for cos, sin in azimuths:
            gap = axis_gap_mm + sag_mm(after, h * cos, h * sin) - sag_mm(before, h * cos, h * sin)
            k = int(np.argmin(np.where(np.isnan(gap), np.inf, gap)))
            found = min(found, (float(gap[k]), float(h[k])))
    return found


def neighbours(surfaces: Sequence[Surface]) -> Iterator[tuple[int, int, float]]:
    """Yield pairs of surfaces that may collide, with their vertices' distance, but no stop that bends nothing."""
    idle = [s.stop and same_medium(surfaces, k) for k, s in enumerate(surfaces)]
    for k in range(len(surfaces) - 1):
        if not idle[k] and not idle[k + 1]:
            yield k, k + 1, surfaces[k].thickness_mm
    for k in range(1, len(surfaces) - 1):
        if idle[k] and math.isinf(surfaces[k].radius_mm):
            yield k - 1, k + 1, surfaces[k - 1].thickness_mm + surfaces[k].thickness_mm


@dataclass(frozen=True)
class RimRule:
    """Holds the numbers of the rule by which rims are derived.

    Attributes:
        vignetting: the share of the stop's height that is kept at the edge of the field, above 0 and at most 1. The
            default is where computed and measured light of 99 primes, wide open, agree in the median
            (experiments/results/photographs.md).
        clear_edge: by how much a rim is wider than the rays need, as a share of its diameter.
        half_field_deg: edge of the field; None takes that of the lens or of its image circle.
    """

    vignetting: float = 0.5
    clear_edge: float = 0.01
    half_field_deg: float | None = None


@dataclass(frozen=True)
class Rim:
    """One row of the result of `derive_rims`; full diameters, in mm.

    Attributes:
        surface: its index.
        tabled_mm: the diameter of the lens as it was given.
        axis_mm, field_mm: what the beam of the axis and those of the field need, without the clear edge.
        derived_mm: the diameter taken.
        trimmed: whether a neighbour leaves less room than the rays need.
    """

    surface: int
    tabled_mm: float
    axis_mm: float
    field_mm: float
    derived_mm: float
    trimmed: bool = False


def derive_rims(lens: Lens, rule: RimRule | None = None) -> tuple[Lens, list[Rim]]:
    """The lens with derived stops and rims (`rims` is then "derived"), and how the rims compare with the old ones.

    Raises:
        InputError: a rule out of range, a lens without a stated field, a lens with cylinders, or a field that no ray
            through the middle of the stop reaches.
    """
    rule = rule or RimRule()
    if not 0 < rule.vignetting <= 1:
        raise InputError(lens.path, "vignetting", rule.vignetting, "a share of the pupil above 0 and at most 1")
    if not 0 <= rule.clear_edge < 1:
        raise InputError(lens.path, "clear edge", rule.clear_edge, "a share of the diameter from 0 to below 1")
    lens.require_centred("the rule of rims")
    if lens.anamorphic:
        raise InputError(lens.path, "cylinder", "(an anamorphic lens)", "a lens that is symmetric about its axis")
    states = list(_states(lens))
    axis, field = [0.0] * len(lens.surfaces), [0.0] * len(lens.surfaces)
    for state in states:
        on_axis, off_axis = _beams(state, rule, rule.half_field_deg or half_field_deg(state))
        axis, field = list(map(max, axis, on_axis)), list(map(max, field, off_axis))
    needed = [2 * max(pair) for pair in zip(axis, field, strict=True)]
    wide = [
        min(math.ceil(d * (1 + rule.clear_edge) / _STEP_MM) * _STEP_MM, _end_mm(s))
        for d, s in zip(needed, lens.surfaces, strict=True)
    ]
    wide[lens.stop_index] = 2 * states[0].stop_radius_mm
    fitted = _clear_of_neighbours(states, wide)
    rims = [
        Rim(k, s.diameter_mm, 2 * axis[k], 2 * field[k], fitted[k], trimmed=fitted[k] < needed[k] and not s.stop)
        for k, s in enumerate(lens.surfaces)
    ]
    surfaces = tuple(replace(s, diameter_mm=d) for s, d in zip(lens.surfaces, fitted, strict=True))
    configurations = tuple(
        replace(c, stop_diameter_mm=round(_stop_of(lens, c), 4)) if c.stop_diameter_mm or c.f_number else c
        for c in lens.configurations
    )
    return replace(lens, surfaces=surfaces, configurations=configurations, rims="derived"), rims


def narrowed_rims(lens: Lens) -> Lens:
    """Return the lens with its rims narrowed to where spheres end and where neighbours touch in any state.

    The stop keeps its rim. So do surfaces whose vertices lie in the wrong order: no width helps them, and
    `check_clearance` says so.
    """
    states = [lens, *(lens.with_gaps(dict(c.thickness_mm)) for c in lens.configurations)]
    ends = [s.diameter_mm if s.stop else min(s.diameter_mm, _end_mm(s)) for s in lens.surfaces]
    fitted = _clear_of_neighbours(states, ends)
    rows = (
        s if s.stop or d <= 0 or s.diameter_mm <= min(d + _STEP_MM, _end_mm(s)) else replace(s, diameter_mm=d)
        for s, d in zip(lens.surfaces, fitted, strict=True)
    )
    return replace(lens, surfaces=tuple(rows))


def with_derived_rims(lens: Lens) -> Lens:
    """Return the lens with a diameter wherever it has none (NaN), by the rule's defaults; given ones stay.

    Raises:
        InputError: what `derive_rims` raises, and where no field is stated.
    """
    missing = ", ".join(str(k) for k, s in enumerate(lens.surfaces) if math.isnan(s.diameter_mm))
    if lens.half_field_deg is None and lens.image_radius_mm is None:
        expected = "the clear diameter of every surface, or a field to derive rims for (half_field_deg, --half-field)"
        raise InputError(lens.path, "diameter", f"(not given for surface {missing})", expected)
    if math.isnan(lens.stop_radius_mm):
        lens = lens.with_stop_radius(stop_radius_mm(lens, lens.f_number))
    if not any(s.figure.powers and math.isnan(s.diameter_mm) for s in lens.surfaces):
        return replace(_filled(lens, derive_rims(lens)[0]), rims="derived")
    # Figures of aspheres hold little beyond a rim. So start from the rims of their vertex spheres, and repeat until the
    # rims stay.
    radii = (1 / c if (c := s.vertex_curvature("y")) else math.inf for s in lens.surfaces)
    figures = (s.figure if s.figure.power else SPHERE for s in lens.surfaces)
    rows = (replace(s, radius_mm=r, figure=f) for s, r, f in zip(lens.surfaces, radii, figures, strict=True))
    found = _filled(lens, derive_rims(replace(lens, surfaces=tuple(rows)))[0])
    for _ in range(_ROUNDS):
        before, found = found, _filled(lens, derive_rims(found)[0])
        if found == before:
            break
    return replace(found, rims="derived")


def _filled(lens: Lens, other: Lens) -> Lens:
    pairs = zip(lens.surfaces, other.surfaces, strict=True)
    rows = (replace(s, diameter_mm=o.diameter_mm) if math.isnan(s.diameter_mm) else s for s, o in pairs)
    return replace(lens, surfaces=tuple(rows))


def half_field_deg(lens: Lens) -> float:
    """Return the half field (degrees) of a lens: its own, or that of its image circle by r = f tan(field).

    Raises:
        InputError: neither is stated.
    """
    if lens.half_field_deg is not None:
        return lens.half_field_deg
    if lens.image_radius_mm is None:
        raise InputError(lens.path, "half_field_deg", "(not stated)", "the edge of the field, to derive rims for it")
    return math.degrees(math.atan(lens.image_radius_mm / abs(first_order(lens).front_efl_mm)))


def _states(lens: Lens) -> Iterator[Lens]:
    """Yield the table and every zoom state of the lens, each with the stop of its f-number."""
    yield lens.with_stop_radius(round(stop_radius_mm(lens, lens.f_number), 5))
    for c in lens.configurations:
        if c.object_distance_mm is None:
            yield _moved(lens, c).with_stop_radius(_stop_of(lens, c) / 2)


def _moved(lens: Lens, c: Configuration) -> Lens:
    """Return the table with the thicknesses, field and f-number of a state."""
    moved = lens.with_gaps(dict(c.thickness_mm))
    return replace(moved, half_field_deg=lens.half_field_in(c), f_number=c.f_number or lens.f_number)


def _stop_of(lens: Lens, c: Configuration) -> float:
    """Return the diameter of the stop in a state.

    A focus state has the stop of the zoom state with the same tabled stop; a state with neither f-number nor stop has
    that of the table.
    """
    if c.object_distance_mm is not None:
        same = [z for z in lens.configurations if z.object_distance_mm is None]
        twin = next((z for z in same if z.stop_diameter_mm == c.stop_diameter_mm), None)
        return _stop_of(lens, twin) if twin else 2 * stop_radius_mm(lens, lens.f_number)
    if c.f_number is None and c.stop_diameter_mm is None:
        return 2 * stop_radius_mm(lens, lens.f_number)  # one stop for all states
    state = _moved(lens, c)
    return 2 * stop_radius_mm(state, state.f_number)


def _beams(lens: Lens, rule: RimRule, field_deg: float) -> tuple[list[float], list[float]]:
    """Return the semi-diameters (mm) that the beams of the axis and of the field need at every surface."""
    import torch  # only rays need it; rims are narrowed without

    from neurolens.optics.trace.aiming import aim_at_stop, without_rims
    from neurolens.optics.trace.rays import plain_trace

    share = torch.linspace(0, 1, _FIELDS, dtype=torch.float64)
    kept = lens.stop_radius_mm * (1 - (1 - rule.vignetting) * share)
    heights = kept[:, None] * torch.tensor(_HEIGHTS, dtype=torch.float64)
    bundle = aim_at_stop(lens, share * math.radians(field_deg), heights)
    if not bundle.reached[:, len(_HEIGHTS) // 2].all():
        widest = math.degrees(float(bundle.field_rad[-1, len(_HEIGHTS) // 2]))
        expected = f"at most {widest:.3g}, where the chief ray ends"
        if not 0 < widest < field_deg:  # a chief ray that turns back sets no limit
            expected = "a field whose chief ray meets the middle of the stop: none does (a wrong radius or thickness?)"
        raise InputError(lens.path, "half_field_deg", field_deg, expected)
    every = range(len(lens.surfaces))
    traced = plain_trace(without_rims(lens), bundle.rays, towards="film", record=every)
    usable = bundle.reached & (traced.status == 0).reshape(heights.shape)
    at = torch.stack([traced.crossings[k].x.abs().reshape(heights.shape).where(usable, 0.0) for k in every])
    return at[:, 0].amax(1).tolist(), at[:, 1:].amax((1, 2)).tolist()


def _end_mm(surface: Surface) -> float:
    """Return the widest diameter of a surface, just inside where its conic ends."""
    return 2 * end_mm(surface) * (1 - 1e-9)


def _clear_of_neighbours(states: Sequence[Lens], diameters: Sequence[float]) -> list[float]:
    """Return diameters so narrowed that in no state neighbours overlap inside their rims; the stop keeps its own."""
    found = list(diameters)
    for state in states:
        for k, after, gap in neighbours(state.surfaces):
            smaller = min(found[k], found[after])
            room = _meeting_height(state.surfaces[k], state.surfaces[after], gap, smaller / 2)
            if 2 * room < smaller:
                trimmed = _which_to_trim(state.surfaces[k], state.surfaces[after], k, after, room)
                if state.stop_index in (k, after):  # a stop on glass keeps its size
                    trimmed = (after if k == state.stop_index else k,)
                for which in trimmed:
                    found[which] = min(found[which], math.floor(2 * room / _STEP_MM) * _STEP_MM)
    return [min(round(d, 4), _end_mm(s)) for d, s in zip(found, states[0].surfaces, strict=True)]


def _which_to_trim(before: Surface, after: Surface, k: int, k_after: int, h: float) -> tuple[int, ...]:
    """Choose, of two surfaces that meet at height h, the one that clears the other if it ends in a flat there."""

    def slope(s: Surface) -> float:
        return sag_mm(s, h, 0.0) - sag_mm(s, 0.99 * h, 0.0)

    if slope(after) >= 0:
        return (k,)
    return (k_after,) if slope(before) <= 0 else (k, k_after)


def _meeting_height(before: Surface, after: Surface, gap: float, limit: float) -> float:
    """Return the distance (mm) from the axis, at most `limit`, at which two surfaces first meet."""

    def clear(h: float) -> bool:
        return gap + sag_mm(after, h, 0.0) - sag_mm(before, h, 0.0) >= 0

    low = 0.0
    for i in range(1, _STEPS + 1):
        high = limit * i / _STEPS
        if not clear(high):
            for _ in range(60):
                middle = (low + high) / 2
                low, high = (middle, high) if clear(middle) else (low, middle)
            return low
        low = high
    return limit
