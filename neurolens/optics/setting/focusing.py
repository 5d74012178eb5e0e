"""Focuses a lens, by groups that move inside it or by its film, which goes to the plane of best focus.

Of internal focusing, a source lists a few states of the groups between infinity and the nearest focus, for every zoom
position. One parameter moves all gaps linearly from state to state (as a focus ring on straight cams would). It is
solved for the paraxial image of the object to lie on the film, which stays in place.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from neurolens.base.errors import InputError
from neurolens.optics.lens import paraxial
from neurolens.optics.lens.prescription import Configuration, Lens, Surface
from neurolens.optics.trace.arrays import follow
from neurolens.optics.trace.surfaces import Rays

Array = NDArray[np.float64]
_NEAR_LIMIT_FOCAL_LENGTHS, _NEAREST_OBJECT_FOCAL_LENGTHS = 14, 8


def monotone(x: Sequence[float], rows: Sequence[Sequence[float]], place: float) -> list[float]:
    """Interpolate between rows of values [R, M] at ascending places x [R], and return the values [M] at one place.

    Two rows are interpolated linearly, more by the piecewise cubic of Fritsch and Butland (1984), "A method for
    constructing local monotone piecewise cubic interpolants". A value then stays between those of its two neighbouring
    rows, so that no gap can turn negative; at a row's place it is the row's own.
    """
    from scipy.interpolate import PchipInterpolator  # type: ignore[import-untyped]

    known, own = np.unique(x, return_index=True)
    values = np.asarray(rows, np.float64)[own]
    at = min(int(np.searchsorted(known, place)), len(known) - 1)
    if len(known) == 1 or known[at] == place:
        return values[at].tolist()
    return PchipInterpolator(known, values)(place).tolist()


def require_film(lens: Lens) -> Lens:
    """Return a lens that is set; InputError if its film would not lie behind its last surface."""
    behind = float((lens.film_z_mm or 0.0) - lens.vertices_mm[len(lens.surfaces) - 1])
    if behind < 0:
        raise InputError(
            lens.path, "film", f"({-behind:.4g} mm in front of the last surface)", "an image behind the lens"
        )
    return lens


SAME_MM = 0.005  # gaps of two states that differ by less count as the same: sources give two decimals


def at_infinity(lens: Lens) -> Lens:
    """Return the lens with its groups at their places for infinity focus."""
    if not lens.infinity_mm:
        return lens
    return replace(lens.with_gaps(dict(lens.infinity_mm)), infinity_mm=())


def infinity_states(lens: Lens) -> list[Configuration]:
    """Return the zoom states of the source: those with the object at infinity."""
    return [c for c in lens.configurations if c.object_distance_mm is None]


def focus_states(lens: Lens) -> list[Configuration]:
    """Return the focus states of the source: those with an object at a distance."""
    return [c for c in lens.configurations if c.object_distance_mm is not None]


def zoom_state_of(lens: Lens, near: Configuration) -> Configuration | None:
    """Return the infinity state of the zoom position that a focus state belongs to; None where only the table fits.

    Of the file's states it is the one with the fewest different gaps, and of those the one with the smallest
    differences.
    """

    def unlikeness(base: Configuration) -> tuple[int, float]:
        gaps = gaps_mm(lens, base)
        differences = [abs(gaps[k] - t) for k, t in near.thickness_mm]
        return sum(d > SAME_MM for d in differences), sum(differences)

    return min(infinity_states(lens), key=unlikeness, default=None)


def gaps_mm(lens: Lens, *states: Configuration | None) -> dict[int, float]:
    """Return all thicknesses by surface index: the lens's own, replaced by those of the states in turn."""
    gaps = {k: s.thickness_mm for k, s in enumerate(lens.surfaces)}
    for state in states:
        gaps.update(() if state is None else state.thickness_mm)
    return gaps


def focus_path(lens: Lens) -> dict[int, list[float]]:
    """Return how much each gap changes while a lens focuses, by surface: 0 at infinity, then at each focus state.

    The lens is at infinity focus, in a state of its zoom or between two (the changes are then interpolated in log EFL).
    The last gap is the distance to the film.

    Raises:
        InputError: a file without focus states, or a lens that diverges.
    """
    if not focus_states(lens):
        raise InputError(lens.path, "focus_mode", "internal", '"best" or "paraxial": the file has no focus states')
    film = len(lens.surfaces) - 1
    moved = sorted({film, *(k for c in focus_states(lens) for k, _ in c.thickness_mm)})
    by_zoom: dict[Configuration | None, list[Configuration]] = {}
    for c in focus_states(lens):
        by_zoom.setdefault(zoom_state_of(lens, c), []).append(c)
    stages = min(len(found) for found in by_zoom.values())
    rows = []
    for base, found in by_zoom.items():
        start = gaps_mm(lens, base)
        near = sorted(found, key=lambda c: -(c.object_distance_mm or math.inf))[-stages:]
        ends = [gaps_mm(lens, base, c) for c in near]
        rows.append((_log_efl(lens.with_gaps(start)), [end[k] - start[k] for end in ends for k in moved]))
    rows.sort()
    place = _log_efl(lens)
    place = min(max(place, rows[0][0]), rows[-1][0])
    flat = monotone([r[0] for r in rows], [r[1] for r in rows], place)
    return {k: [0.0, *flat[n :: len(moved)]] for n, k in enumerate(moved)}


def _log_efl(lens: Lens) -> float:
    efl = paraxial.first_order(lens).efl_mm
    if not efl > 0:
        expected = 'a focal length above 0 where groups move; focus_mode "best" moves the whole lens'
        raise InputError(lens.path, "focal length", efl, expected)
    return math.log(efl)


def focused_inside(lens: Lens, focus_m: float | None, object_mm: float | None = None) -> Lens:
    """Return the lens focused by moving its groups.

    Args:
        lens: at infinity focus, or in a focus state of its file, which is kept where `focus_m` is None.
        focus_m: distance from object to film, m; None is infinity.
        object_mm: distance from the object to the front vertex, for a focus state that was chosen by its name.

    Raises:
        InputError: a file without focus states, or a distance below the nearest one, which the error names.
    """
    if focus_m is None and object_mm is not None:
        return replace(lens, film_z_mm=paraxial.image_z_mm(lens, -object_mm))
    from scipy.optimize import brentq  # type: ignore[import-untyped]

    lens = at_infinity(lens)
    path, place = _mover(lens)
    furthest = len(path[len(lens.surfaces) - 1]) - 1
    wanted = 0.0 if focus_m is None else 1 / (1000 * focus_m)
    nearest = _vergence(place(furthest))
    if not nearest > 0:
        raise InputError(lens.path, "focus_mode", "internal", "focus states that focus nearer than infinity")
    if wanted > nearest * (1 + 1e-9):
        limit = f"at least {_rounded_up(1 / nearest / 1000):g} m, the nearest focus of the source's states"
        raise InputError(lens.path, "focus_m", focus_m, limit)
    wanted, s = min(wanted, nearest), 0.0
    if wanted > max(_vergence(place(0.0)), 0.0):
        s = brentq(lambda s: _vergence(place(s)) - wanted, 0.0, furthest, xtol=1e-14)
    return replace(place(s), infinity_mm=tuple((k, lens.surfaces[k].thickness_mm) for k in path))


def _rounded_up(value: float) -> float:
    """Round a positive number up to four digits: a distance printed as the limit must be accepted."""
    step = 10.0 ** (math.floor(math.log10(value)) - 3)
    return math.ceil(value / step - 1e-9) * step


def nearest_focus_m(lens: Lens) -> float:
    """Return the nearest distance from object to film that internal focusing reaches."""
    path, place = _mover(at_infinity(lens))
    nearest = _vergence(place(len(path[len(lens.surfaces) - 1]) - 1))
    return 1 / nearest / 1000 if nearest else math.inf


def reached_inside(lens: Lens, focus_m: float) -> bool:
    """Return whether the groups of a lens move for a distance (m): its file has focus states that reach it."""
    reach_m = None if math.isinf(focus_m) else groups_reach_m(lens)
    return reach_m is not None and reach_m <= focus_m * (1 + 1e-9)


def groups_reach_m(lens: Lens) -> float | None:
    """Return how near (m, from the film) the groups of a lens focus; None where the lens moves as a whole."""
    reach_m = nearest_focus_m(lens) if focus_states(lens) else math.inf
    return reach_m if 0 < reach_m < math.inf else None


def near_limit_m(lens: Lens) -> float:
    """Return the default distance from the film to the nearest object in focus."""
    data = paraxial.first_order(lens)
    f, film_z = abs(data.efl_mm), data.rear_focal_z_mm
    separation = data.rear_principal_z_mm - data.front_principal_z_mm
    lengths = (_NEAR_LIMIT_FOCAL_LENGTHS * f, film_z + _NEAREST_OBJECT_FOCAL_LENGTHS * f, 6 * f + separation)
    return max(v for v in lengths if math.isfinite(v)) / 1000


def _mover(lens: Lens) -> tuple[dict[int, list[float]], Callable[[float], Lens]]:
    """Return the path of a lens at infinity focus, and a function that moves its groups along it, the film fixed.

    The function takes a place on the path, from 0 (infinity) to the number of focus states.
    """
    path, back_mm, film = focus_path(lens), paraxial.first_order(lens).back_focus_mm, len(lens.surfaces) - 1

    def place(s: float) -> Lens:
        added = {k: float(np.interp(s, range(len(steps)), steps)) for k, steps in path.items()}
        moved = lens.with_gaps({k: lens.surfaces[k].thickness_mm + v for k, v in added.items() if k != film})
        return replace(moved, film_z_mm=moved.vertices_mm[film] + back_mm + added[film])

    return path, place


def _vergence(lens: Lens) -> float:
    """Return 1 / distance (1/mm) from the film to the object in focus on it; 0 at infinity (Newton: x x' = -f f')."""
    data = paraxial.first_order(lens)
    assert lens.film_z_mm is not None
    extension = lens.film_z_mm - data.rear_focal_z_mm
    return float(extension / (data.efl_mm * data.front_efl_mm + extension * (lens.film_z_mm - data.front_focal_z_mm)))


_RINGS, _SPOKES = 512, 24
_RINGS_OF_SPOKES = 64  # spokes of rays where the opening is not round
_WIDER = 1.1  # the disc of rays over the paraxial entrance pupil, whose edge moves by aberrations of the pupil
_ROUNDS = 2  # the object's distance counts from the film, which moves: an error shrinks 100 times a round
_SPARE = 0.05  # share of a film range that is added at both ends
_NEAREST = 0.5  # share of the way from the last surface to the paraxial image: no film of a range lies nearer


def best_focus_z_mm(lens: Lens, focus_m: float = math.inf, wavelength_nm: tuple[float, float] | None = None) -> float:
    """Return the z (mm, lens frame) of the film with the least RMS spot of an axial point, for a range of light.

    Rays of the colours of `paraxial.colours` are spread evenly over the entrance pupil, and those that stop and rims
    let through count: so the focus of a lens with spherical aberration shifts as it is stopped down. The plane follows
    in closed form, since the spot's second moment is a parabola in z. With pure third-order spherical aberration it
    lies two thirds of the way from the paraxial to the marginal focus; for a lens with cylinders it is that of the
    whole spot. The film of a pinhole stays in place.

    Args:
        focus_m: distance of the axial point from the film, m.
        wavelength_nm: shortest and longest wavelength of the light; None takes `Lens.light_nm`.

    Raises:
        InputError: no ray passes, or focus nearer than four focal lengths.
    """
    focus_m = paraxial.distance_m(focus_m)
    film_z = _paraxial_film_z_mm(lens, focus_m)
    if paraxial.is_pinhole(lens):
        return film_z
    for _ in range(1 if math.isinf(focus_m) else _ROUNDS):
        film_z = float(_least_spot_mm(lens, film_z - 1000 * focus_m, wavelength_nm)[0])
    return film_z


def _least_spot_mm(
    lens: Lens, object_z_mm: float, wavelength_nm: tuple[float, float] | None, stops_mm: Sequence[float] | None = None
) -> NDArray[np.float64]:
    """Return film planes of an axial point's least spot, behind the stop as it is or round ones of some radii."""
    # Without dispersion all light behaves as one colour.
    one = (lens.reference_nm, lens.reference_nm)
    wavelengths, weights = paraxial.colours(wavelength_nm or lens.light_nm if lens.dispersive else one)
    along, across, at_stop = _moments(lens, object_z_mm, wavelengths)
    share = weights[None, :, None, None]
    if stops_mm is not None:  # rays at the edge of a stop count in part
        square = np.array(stops_mm)[:, None, None, None] ** 2
        ring = (_WIDER * lens.stop_radius_mm) ** 2 / along.shape[1]
        share = share * ((square - at_stop**2) / ring + 0.5).clip(0, 1)
    along, across = ((share * m).sum((1, 2, 3)) for m in (along, across))
    if not (across > 0).all():
        raise InputError(lens.path, "focus_mode", "best", "a lens that axial light passes and bends")
    return np.asarray(-along / across)


def best_focus_of_stops_mm(
    lens: Lens, focus_m: float, stops_mm: Sequence[float], wavelength_nm: tuple[float, float] | None = None
) -> NDArray[np.float64]:
    """Return `best_focus_z_mm` at several radii of a round stop, from one set of rays; raises what that raises."""
    widest = replace(lens, aperture=None).with_stop_radius(float(max(stops_mm)))
    whole = best_focus_z_mm(widest, focus_m, wavelength_nm)
    if paraxial.is_pinhole(lens):
        return np.full(len(stops_mm), whole)
    object_z = whole - 1000 * focus_m
    found = _least_spot_mm(widest, object_z, wavelength_nm, stops_mm)
    # The object keeps its distance from the film: where the film moves, the image moves by the square of its scale.
    data = paraxial.first_order(lens)
    scale = float(data.efl_mm / (data.front_focal_z_mm - object_z))
    return np.asarray(found + (found - whole) * scale**2)


def best_focused(lens: Lens, focus_m: float, wavelength_nm: tuple[float, float] | None = None) -> Lens:
    """Return a lens that `set_lens` has placed, by film or groups, with its film moved to `best_focus_z_mm`."""
    return replace(lens, film_z_mm=best_focus_z_mm(lens, focus_m, wavelength_nm))


_COVER, _COVER_AIR_MM = ("N-BK7", 1.5168, 64.17), 0.5  # glass, n_d, V_d; distance from the film


def with_cover_glass(
    lens: Lens, thickness_mm: float, focus_m: float, focus_mode: str, wavelength_nm: tuple[float, float]
) -> Lens:
    """Return a lens whose film is placed with a plane plate in front of the film, and the film in focus again.

    Where the plate stands before the film does not matter for rays. A plate of no thickness is not added.

    Raises:
        InputError: a plate that is thicker than the room behind the lens.
    """
    if not thickness_mm:
        return lens
    assert lens.film_z_mm is not None
    last, z_mm, (name, n_d, V_d) = lens.surfaces[-1], float(lens.vertices_mm[-2]), _COVER
    film_z = lens.film_z_mm + thickness_mm * (1 - float(last.n_d) / n_d)
    room = film_z - z_mm - _COVER_AIR_MM - thickness_mm
    if room <= 0:
        most = math.floor(100 * (thickness_mm + room * n_d / float(last.n_d))) / 100
        expected = f"at most {most:g} mm: the film lies {lens.film_z_mm - z_mm:.3g} mm behind the last surface"
        raise InputError(lens.path, "cover_glass_mm", thickness_mm, expected)
    wide = last.diameter_mm + 2 * (film_z - z_mm)  # wider than any ray to the film needs
    front = Surface(math.inf, thickness_mm, wide, n_d)
    front = replace(front, V_d=V_d, material=name, glass=name) if lens.dispersive else front
    back = Surface(math.inf, _COVER_AIR_MM, wide, last.n_d, last.V_d, last.material, glass=last.glass)
    place = len(lens.surfaces) - 1
    moved = tuple((k, room if k == place else gap) for k, gap in lens.infinity_mm)
    rows = lens.with_gaps({place: room}).surfaces
    derived = f"{lens.derived} A cover glass of {thickness_mm:g} mm was added.".strip()
    covered = replace(lens, surfaces=(*rows, front, back), infinity_mm=moved, film_z_mm=film_z, derived=derived)
    return covered if focus_mode == "paraxial" else best_focused(covered, focus_m, wavelength_nm)


def _paraxial_film_z_mm(lens: Lens, focus_m: float) -> float:
    """Return the z (mm) of the paraxial image; of a lens whose groups have moved to focus, that of its film."""
    if lens.infinity_mm and lens.film_z_mm is not None:
        return float(lens.film_z_mm)
    return paraxial.film_z_mm(lens, focus_m)


def film_range_mm(lens: Lens, focus_m: float, wavelength_nm: tuple[float, float]) -> tuple[float, float]:
    """Return the range of film planes that holds an axial point's paraxial image and its least spot in every case.

    Cases are all apertures and colours. The least spot of all rays together lies between those of each colour and
    meridian by itself. Arguments are those of `best_focus_z_mm`.
    """
    focus_m = paraxial.distance_m(focus_m)
    image = _paraxial_film_z_mm(lens, focus_m)
    if paraxial.is_pinhole(lens):
        return image, image
    colours = np.linspace(*wavelength_nm, paraxial.COLOURS if lens.dispersive else 1)
    low = high = image
    for _ in range(1 if math.isinf(focus_m) else _ROUNDS):
        # The rays within each ring are those that a smaller stop lets through.
        along, across = (m.cumsum(1) for m in _moments(lens, (low + high) / 2 - 1000 * focus_m, colours)[:2])
        seen = across > 0
        found = [image, *(-along[seen] / across[seen]).tolist()]
        low, high = min(found), max(found)
    spare, last = _SPARE * (high - low), float(lens.vertices_mm[len(lens.surfaces) - 1])
    return max(low - spare, last + _NEAREST * (image - last)), high + spare


def axial_rays(lens: Lens, object_z_mm: float) -> Rays:
    """The rays [rings * spokes] towards the film from a point of the axis, for equal areas of the entrance pupil.

    Where lens and opening are round, one spoke stands for all. The point may lie at -inf.
    """
    data = paraxial.first_order(lens)
    round_ = lens.round and lens.aperture is None
    rings, spokes = (_RINGS, 1) if round_ else (_RINGS_OF_SPOKES, _SPOKES)
    ring = np.sqrt((np.arange(rings) + 0.5) / rings)
    spoke = 2 * math.pi * (np.arange(spokes) + 0.5) / spokes
    widest = max(data.entrance_pupil_diameter_mm, paraxial.first_order(lens, meridian="x").entrance_pupil_diameter_mm)
    radius = _WIDER / 2 * widest * ring[:, None]
    x, y = (radius * np.cos(spoke)).reshape(-1), (radius * np.sin(spoke)).reshape(-1)
    # The rays start well in front of every lens, so that a front surface that bulges towards the scene is still ahead.
    front_mm = lens.surfaces[0].diameter_mm
    start = -max(10.0, front_mm if math.isfinite(front_mm) else 10.0)
    if math.isinf(object_z_mm):
        zero = np.zeros_like(x)
        return Rays(x, y, zero + start, zero, zero, zero + 1)
    depth = data.entrance_pupil_z_mm - object_z_mm
    length = np.sqrt(x * x + y * y + depth * depth) * math.copysign(1.0, depth)
    dx, dy, dz = x / length, y / length, depth / length
    t = (start - object_z_mm) / dz
    if object_z_mm > start:
        t = np.zeros_like(t)
    return Rays(dx * t, dy * t, object_z_mm + dz * t, dx, dy, dz)


def _moments(lens: Lens, object_z_mm: float, wavelength_nm: Array) -> tuple[Array, Array, Array]:
    """Return x0 tx + y0 ty and tx^2 + ty^2 of each ray [colours, rings, spokes], and how far out it meets the stop.

    A ray meets the plane z = 0 at (x0, y0) with the slopes (tx, ty). The sum of (x0 + z tx)^2 + (y0 + z ty)^2 over rays
    is least where z is minus the sum of the first result over that of the second. Both are 0 for a blocked ray. The
    last result is the ray's distance from the axis.
    """
    rays = axial_rays(lens, object_z_mm)
    count, colours = len(rays.x), len(wavelength_nm)
    out = follow(lens, Rays(*(np.tile(c, colours) for c in rays)), np.repeat(wavelength_nm, count), "film")
    r, passed = out.rays, out.status == 0
    shape = (colours, _RINGS, 1) if count == _RINGS else (colours, _RINGS_OF_SPOKES, _SPOKES)
    with np.errstate(all="ignore"):  # lost rays overflow and give NaN
        tx, ty = r.dx / r.dz, r.dy / r.dz
        along, across = (r.x - r.z * tx) * tx + (r.y - r.z * ty) * ty, tx * tx + ty * ty
        at_stop = np.nan_to_num(np.hypot(*out.at_stop))
    return (
        np.where(passed, along, 0.0).reshape(shape),
        np.where(passed, across, 0.0).reshape(shape),
        at_stop.reshape(shape),
    )
