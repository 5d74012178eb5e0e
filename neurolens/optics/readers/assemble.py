"""Completes what a file says differently from a lens, or leaves open: Forbes's aspheres, stop, f-number, film, rims.

Forbes's mild aspheres (Qbfs) become even powers of the height (G. W. Forbes, Opt. Express 15, 5218, 2007); the strong
ones are a figure of their own (`optics.lens.figures.Qcon`). With u the height over a normalisation radius and x = u^2,

    sag = conic + u^2 (1 - u^2) / cos(slope of the conic) sum a_m Qbfs_m(x),

whose slopes along the normal are orthonormal. (Forbes starts from a sphere, whose cosine is sqrt(1 - c^2 r^2). That a
conic is meant shows in Thorlabs's ASL5040-UV, which is sharp only so.) The cosine is no polynomial: a polynomial as
close as `CLOSE_MM` up to the rim stands for it. Conics so steep that the lens model's powers do not come so close are
refused.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from decimal import Context, Decimal, localcontext
from typing import TYPE_CHECKING

from numpy.polynomial import Polynomial
from numpy.polynomial.polynomial import polyval

from neurolens.base.errors import InputError
from neurolens.optics.lens import paraxial
from neurolens.optics.lens.paraxial import FirstOrder, system_of
from neurolens.optics.lens.prescription import Lens, Medium
from neurolens.optics.readers.source import MAX_INDEX, MAX_POWER, MAX_SURFACES, assume, warn
from neurolens.optics.setting.rims import check_figures, end_mm, narrowed_rims, with_derived_rims

if TYPE_CHECKING:
    from neurolens.optics.readers.draft import Draft

# A diameter that the file does not give, until `finish` has found it.
UNKNOWN = math.nan
NARROWER = 1e-4  # relative: smaller differences of stop diameters are rounding
_SHORTEST = 0.01  # focal length over the thickest glass, at least: of 391 lenses none is below 0.19
_SLIGHTLY = 0.1  # share of a rim's diameter
# f-number by the stop's diameter over the stated one: where radii were meant by diameters, and where all is right
_TWICE, _SAME = (0.4, 0.7), (0.7, 1.4)

# error of sag, in the unit of the heights: what is aimed at, and what is accepted for steep conics
CLOSE_MM, WORST_MM = 1e-11, 1e-9
_DIGITS = 80
_SAMPLES = 101
# of sag: how much rounding the coefficients to float64 may change; float32 carries what passes this
_ROUNDING_MM = 2e-8
Terms = tuple[tuple[int, float], ...]


def finish(
    lens: Lens, *, pupil_mm: float | None = None, film_given: bool = True, stop_limit_mm: float | None = None
) -> Lens:
    """Return the lens of a file's rows with what follows from them: its f-number or stop, and the back focus.

    Rims that the file does not give stay `UNKNOWN`; states and overlaps are for the caller (`with_rims`,
    `check_states`).

    Args:
        lens: rows as read; `UNKNOWN` for a diameter that is not given, NaN for an f-number that is not (it sizes the
            stop where neither pupil nor stop diameter is known).
        pupil_mm: diameter of the entrance pupil, where the file gives that; it rules over the stop's diameter.
        film_given: whether the last thickness is the file's; else it becomes the paraxial back focus.
        stop_limit_mm: diameter of the aperture that the file sets on the stop itself. It is taken, with a warning,
            where pupil or f-number ask for a wider stop.

    Raises:
        InputError: there is no row, or too many; no stop, or several; a figure is out of range; nothing sizes the stop;
            there is no image behind the lens.
    """
    _check_stop(lens)
    stop = lens.surfaces[lens.stop_index]
    stated = lens.f_number
    # First-order data needs an opening, whatever it is.
    trial = lens.with_stop_radius(1.0 if math.isnan(stop.diameter_mm) else stop.semi_diameter_mm)
    data = first_order(trial)
    thickest = max((s.thickness_mm for s in lens.surfaces[:-1] if s.n_d != 1), default=0.0)
    if abs(data.efl_mm) < _SHORTEST * thickest:
        expected = f"at least a hundredth of the thickest glass ({thickest:g}): are curvatures taken for radii or such?"
        raise InputError(lens.path, "focal length", data.efl_mm, expected)
    if pupil_mm is not None:
        trial = trial.with_stop_radius(trial.stop_radius_mm * pupil_mm / data.entrance_pupil_diameter_mm)
        stated = abs(data.efl_mm) / pupil_mm if math.isnan(stated) else stated
    elif math.isnan(stop.diameter_mm):
        if math.isnan(stated):
            raise InputError(lens.path, "stop", "(no diameter, no f-number)", "one of them: give --f-number")
        trial = trial.with_stop_radius(trial.stop_radius_mm * data.f_number / stated)
    wanted = 2 * trial.stop_radius_mm
    if smaller_stop(lens.path, wanted, stop_limit_mm) != wanted:
        trial = trial.with_stop_radius((stop_limit_mm or wanted) / 2)
        stated = first_order(trial).f_number
    if math.isnan(stated):
        stated = first_order(trial).f_number
        warn(lens.path, f"no f-number is stated; f/{stated:.4g} follows from the stop's diameter")
    if lens.surfaces[-1].n_d != 1:
        name = lens.surfaces[-1].material or "a medium"
        assume(lens.path, f"the film lies in {name} of index {lens.surfaces[-1].n_d:g}, as the last row says")
    rows = list(trial.surfaces)
    if not film_given:
        rows[-1] = replace(rows[-1], thickness_mm=data.back_focus_mm)
        if data.back_focus_mm <= 0:
            raise InputError(lens.path, "back focus", data.back_focus_mm, "a film behind the last surface")
    return replace(lens, surfaces=tuple(rows), f_number=float(stated))


def pupil_of(lens: Lens, object_na: float, distance: float) -> float:
    """Return the diameter of the entrance pupil at which a near object has this numerical aperture, else InputError."""
    sine = object_na / float(lens.object_medium.n_d)
    reach = distance + first_order(lens.with_stop_radius(1.0)).entrance_pupil_z_mm
    if not (sine < 1 and 0 < reach < math.inf):
        expected = "an aperture below the index in front, of an object at a finite distance"
        raise InputError(lens.path, "numerical aperture of the object", object_na, expected)
    return 2 * reach * sine / math.sqrt(1 - sine * sine)


def smaller_stop(file: str, wanted: float, limit: float | None, state: str = "") -> float:
    """Return the smaller diameter of the stop: by pupil or f-number, or by its own aperture, with a warning."""
    if limit is None or not limit < wanted * (1 - NARROWER):
        return wanted
    message = f"{state}pupil or f-number ask for a stop {wanted:.6g} wide, its own aperture is {limit:.6g}"
    warn(file, f"{message} (in the file's unit): the smaller is taken")
    return limit


def first_order(lens: Lens) -> FirstOrder:
    """Return the first-order data in the y-z plane; for a lens without power there, in the x-z plane.

    Raises InputError for a lens without power, one whose entrance pupil is a point or infinite, or a figure out of
    range.
    """
    _check_stop(lens)
    try:
        data = paraxial.first_order(lens, meridian="y")
    except InputError:
        if not lens.anamorphic:
            raise
        data = paraxial.first_order(lens, meridian="x")
    if not 0 < data.entrance_pupil_diameter_mm < math.inf:
        found = f"(seen from the scene {data.entrance_pupil_diameter_mm:g} mm wide)"
        raise InputError(lens.path, "stop", found, "a stop whose image in front of it has a size")
    return data


def check_rows(lens: Lens) -> None:
    """Raise InputError for no surface, too many, or a figure out of range; whether there is a stop is not checked."""
    rows, file = lens.surfaces, lens.path
    if not rows:
        raise InputError(file, "surfaces", "(none)", "at least one surface between object and image")
    if len(rows) > MAX_SURFACES:
        raise InputError(file, "surfaces", f"({len(rows)} of them)", f"at most {MAX_SURFACES}")
    index = f"a refractive index from 1 to {MAX_INDEX}"
    for k, s in enumerate(rows):
        if not 1 <= s.n_d <= MAX_INDEX:
            mirror = " (an index of -1 describes a mirror, and the lens model has none)" if s.n_d == -1 else ""
            raise InputError(file, f"surface {k}, index", s.n_d, index + mirror)
        if not abs(s.radius_mm) > 0:
            raise InputError(file, f"surface {k}, radius", s.radius_mm, "a number other than 0, or a plane")
        if not math.isfinite(s.thickness_mm):
            raise InputError(file, f"surface {k}, thickness", s.thickness_mm, "a finite length")
        for power in (p for p, _ in s.figure.powers if not 2 <= p <= MAX_POWER):
            raise InputError(file, f"surface {k}, asphere, power", power, f"a power from 2 to {MAX_POWER}")
    if not 1 <= lens.object_medium.n_d <= MAX_INDEX:
        raise InputError(file, "object, index", lens.object_medium.n_d, index)
    check_figures(rows, file)


def _check_stop(lens: Lens) -> None:
    check_rows(lens)
    stops = [k for k, s in enumerate(lens.surfaces) if s.stop]
    if len(stops) != 1:
        found = f"(on surface {', '.join(map(str, stops))})" if stops else "(none)"
        raise InputError(lens.path, "stop", found, "exactly one surface that is the aperture stop")


def with_stop(draft: Draft, wanted: str | None) -> Draft:
    """The draft with a stop: the surface wanted, the file's, or the surface whose rim limits the beam of the axis.

    Raises:
        InputError: there is no surface of that number.
    """
    names = [row.name or str(k) for k, row in enumerate(draft.rows)]
    if wanted is not None:
        if wanted not in names:
            raise InputError(draft.file, "--stop", wanted, f"the number of a surface in the file: {', '.join(names)}")
        k = names.index(wanted)
    elif any(row.surface.stop for row in draft.rows) or not draft.rows:
        return draft
    else:
        rows = tuple(row.surface for row in draft.rows)
        lens = Lens("", "", rows, math.nan, path=draft.file, object_medium=Medium(**draft.object_medium))
        check_rows(lens)
        heights = system_of(lens).march(1.0, 0.0).y  # of a beam that is 2 mm wide
        shares = [s.semi_diameter_mm / abs(y) if y else math.nan for s, y in zip(rows, heights, strict=True)]
        k = min(range(len(rows)), key=lambda k: math.inf if math.isnan(shares[k]) else shares[k])
        assume(draft.file, f"no stop is marked: surface {names[k]}, whose rim limits the beam of the axis, is taken")
    # Its rim stays, even where the file's f-number or pupil would make it wider.
    marked = (replace(row, surface=replace(row.surface, stop=i == k)) for i, row in enumerate(draft.rows))
    return replace(draft, rows=tuple(replace(row, aperture=row.aperture or row.surface.stop) for row in marked))


def stop_aperture(draft: Draft) -> float | None:
    """Return the diameter of the aperture that the file sets on the stop itself, in its unit."""
    stops = (row.surface.diameter_mm for row in draft.rows if row.surface.stop and row.aperture)
    return next((d for d in stops if not math.isnan(d)), None)


def with_likely_rims(lens: Lens, draft: Draft) -> Lens:
    """Return the lens with rims of half the width, where stop and spheres tell that diameters are meant as radii."""
    f_number = draft.f_number or draft.nominal
    if not any(s.stop for s in lens.surfaces):
        return lens  # `finish` reports it
    beyond = [k for k, s in enumerate(lens.surfaces) if s.semi_diameter_mm > end_mm(s) * (1 + 1e-6)]
    evidence = f"the rim of surface {beyond[0]} is wider than its sphere" if beyond else ""
    if f_number and not math.isnan(lens.stop_radius_mm):  # some files write 0 for none
        by_stop = first_order(lens).f_number
        if _SAME[0] <= by_stop / f_number <= _SAME[1]:
            return lens
        if _TWICE[0] <= by_stop / f_number < _TWICE[1]:
            evidence = f"the stop would give f/{by_stop:.3g}, the file says f/{f_number:.3g}"
    if not evidence:
        return lens
    assume(lens.path, f"rims are assumed to be half as wide as the format has them: {draft.in_file(evidence)}")
    rows = (replace(s, diameter_mm=s.diameter_mm / 2) for s in lens.surfaces)
    return replace(lens, surfaces=tuple(rows))


def with_rims(lens: Lens, in_file: Callable[[str], str] = str) -> Lens:
    """Return the lens with the rims that its file lacks, by rule (`neurolens.optics.setting.rims`), with a warning.

    In the warning `in_file` calls surfaces as the file does.
    """
    missing = [k for k, s in enumerate(lens.surfaces) if math.isnan(s.diameter_mm)]
    if not missing:
        return lens
    surfaces = in_file(f"surface {', '.join(map(str, missing))}")
    if not lens.half_field_deg and not lens.image_radius_mm and (filled := _as_beside(lens)) is not None:
        warn(lens.path, f"no rim is given for {surfaces}, nor a field: as wide as the wider rim of the same glass")
        return filled
    derived = with_derived_rims(lens)
    warn(lens.path, f"no rim is given for {surfaces}: derived from f-number and field")
    return derived


def _as_beside(lens: Lens) -> Lens | None:
    """The lens with missing rims as wide as those on the other side of the glass; None where some are not there."""
    rows = list(lens.surfaces)
    for k, s in enumerate(lens.surfaces):
        before, behind = rows[max(k - 1, 0) : k], lens.surfaces[k + 1 : k + 2] if s.n_d != 1 else ()
        ends = [*(end for end in before if end.n_d != 1), *behind]
        if math.isnan(s.diameter_mm):
            widest = max((end.diameter_mm for end in ends if not math.isnan(end.diameter_mm)), default=math.nan)
            rows[k] = replace(s, diameter_mm=min(widest, 2 * end_mm(s)))
    return None if any(math.isnan(row.diameter_mm) for row in rows) else replace(lens, surfaces=tuple(rows))


def narrowed(lens: Lens, draft: Draft) -> Lens:
    """Return the lens with rims no wider than their spheres and than where neighbours touch, in every state.

    A table whose rims are not `drawn` stays as it is where rims are much wider (`_SLIGHTLY`) than their spheres, or
    would have to be so narrow that they cut the beam of the axis: its figures are wrong.
    """
    found = narrowed_rims(lens)
    pairs = list(zip(lens.surfaces, found.surfaces, strict=True))
    if not draft.drawn:
        if any((1 - _SLIGHTLY) * s.semi_diameter_mm > end_mm(s) for s in lens.surfaces):
            return lens
        for state in (lens, *(lens.with_gaps(dict(c.thickness_mm)) for c in lens.configurations)):
            heights = system_of(state).march(1.0, 0.0).y
            beam = [abs(2 * lens.stop_radius_mm * y / (heights[lens.stop_index] or math.inf)) for y in heights]
            if any(
                b.diameter_mm < min((1 - _SLIGHTLY) * a.diameter_mm, need)
                for (a, b), need in zip(pairs, beam, strict=True)
            ):
                return lens
    widths = [(k, f"{a.diameter_mm:.4g} to {b.diameter_mm:.4g} mm") for k, (a, b) in enumerate(pairs) if a != b]
    changed = [f"{draft.in_file(f'surface {k}')} ({width})" for k, width in widths]
    if changed:  # no rim is wider than its sphere: where one is said to be, table or rims are in doubt
        say = assume if any(s.semi_diameter_mm > end_mm(s) * (1 + 1e-6) for s in lens.surfaces) else warn
        say(lens.path, f"rims narrowed to where spheres end or neighbours touch: {', '.join(changed)}")
    return found


def qbfs_terms(a: Sequence[float], radius: float, curvature: float, rim: float, conic: float = 0.0) -> Terms:
    """Return the powers of the height of a Qbfs departure from a conic, with their coefficients.

    Args:
        a: a_0, a_1, ... radius: normalisation radius. rim: height up to which the surface is used.

    Raises:
        ValueError: the conic is too steep, or float64 cannot hold the coefficients.
    """
    with localcontext(Context(prec=_DIGITS)):
        s2, k = (Decimal(curvature) * Decimal(radius)) ** 2, Decimal(conic)
        reach = (Decimal(rim) / Decimal(radius)) ** 2
        if (1 + k) * s2 * reach >= 1:
            raise ValueError("a rim inside the conic")

        def inverse_cosine(x: Decimal) -> Decimal:
            return ((1 - k * s2 * x) / (1 - (1 + k) * s2 * x)).sqrt()

        form = _polynomial(0, 1, -1) * _qbfs_sum(a)
        samples = [reach * k / (_SAMPLES - 1) for k in range(_SAMPLES)]
        exact = [polyval(x, form.coef) * inverse_cosine(x) for x in samples]
        for degree in range(MAX_POWER // 2 - max(len(a), 1)):
            found = form * _interpolated(inverse_cosine, reach, degree)
            off = max(abs(polyval(x, found.coef) - y) for x, y in zip(samples, exact, strict=True))
            if off <= Decimal(CLOSE_MM):
                break
        if off > Decimal(WORST_MM):
            raise ValueError(f"a conic that powers up to {MAX_POWER} follow to {WORST_MM:g}")
        return _powers(found.coef.tolist(), radius, rim)


def _qbfs_sum(a: Sequence[float]) -> Polynomial:
    """Return sum a_m Qbfs_m(x), by the recurrence of Forbes, Opt. Express 18, 19700 (2010), appendix A."""
    d = Decimal
    p = [_polynomial(2), _polynomial(6, -8)]
    q = [_polynomial(1), _polynomial(13, -16) / d(19).sqrt()]
    f, g, h = [d(2), d(19).sqrt() / 2], [d(-1) / 2], list[Decimal]()
    for m in range(2, len(a)):
        h.append(-d(m * (m - 1)) / (2 * f[m - 2]))
        g.append(-(1 + g[m - 2] * h[m - 2]) / f[m - 1])
        f.append((m * (m + 1) + 3 - g[m - 1] ** 2 - h[m - 2] ** 2).sqrt())
        p.append(_polynomial(2, -4) * p[m - 1] - p[m - 2])
        q.append((p[m] - q[m - 1] * g[m - 1] - q[m - 2] * h[m - 2]) / f[m])
    return sum((term * d(value) for value, term in zip(a, q, strict=False)), _polynomial(0))


def _interpolated(function: Callable[[Decimal], Decimal], reach: Decimal, degree: int) -> Polynomial:
    """Return the polynomial through a function of x in Chebyshev's points of [0, reach]."""
    nodes = [reach / 2 * (1 - Decimal(math.cos(math.pi * (k + 0.5) / (degree + 1)))) for k in range(degree + 1)]
    table = [function(x) for x in nodes]
    for order in range(1, degree + 1):  # Newton's divided differences
        for k in range(degree, order - 1, -1):
            table[k] = (table[k] - table[k - 1]) / (nodes[k] - nodes[k - order])
    found = _polynomial(table[-1])
    for x, value in zip(nodes[-2::-1], table[-2::-1], strict=True):
        found = _polynomial(-x, 1) * found + value
    return found


def _powers(in_x: Sequence[Decimal], radius: float, rim: float) -> Terms:
    """Return the powers of the height of a polynomial in x; ValueError where its terms cancel beyond float64."""
    terms = tuple((2 * k, float(c / Decimal(radius) ** (2 * k))) for k, c in enumerate(in_x) if c)
    if sum(abs(a) * rim**p for p, a in terms) * 2.0**-53 > _ROUNDING_MM:
        raise ValueError("fewer terms: powers of the height cancel in float64")
    return terms


def _polynomial(*coefficients: Decimal | int) -> Polynomial:
    return Polynomial([Decimal(c) for c in coefficients])
