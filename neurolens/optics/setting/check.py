"""Checks a prescription against its source: every stated figure is recomputed, and any doubt is given its reason.

Dropped aspheres, swapped glasses and transposed digits mostly show: focal length or back focus move, the axis blurs,
elements cut each other, or no light reaches the edge of the field.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from neurolens.base import status as st
from neurolens.base.errors import InputError
from neurolens.optics.lens.paraxial import FirstOrder, first_order
from neurolens.optics.lens.prescription import Configuration, Lens
from neurolens.optics.setting.focusing import axial_rays, best_focus_z_mm
from neurolens.optics.setting.pupil_nodes import FilmLight
from neurolens.optics.setting.pupils import on_plane, pupil_plane_z_mm
from neurolens.optics.setting.rims import end_mm
from neurolens.optics.setting.states import in_state
from neurolens.optics.trace.aiming import aim_at_stop
from neurolens.optics.trace.arrays import follow
from neurolens.optics.trace.rays import plain_trace
from neurolens.optics.trace.shapes import sag_mm
from neurolens.optics.trace.surfaces import Rays

EFL_TOLERANCE = 0.02  # relative; patents round, and choose a spectral line
FOCUS_TOLERANCE = 0.02  # as a share of the focal length
F_NUMBER_TOLERANCE = 0.05
BEAM_TOLERANCE = 0.03
FIELD_TOLERANCE_DEG = 1.0
BLUR_LIMIT = 0.003  # RMS radius over focal length; a good lens has 0.0001 to 0.0005
SIMPLE = 2  # with at most so many refractions, blur is no sign of a mistake
DARK = 0.02  # illumination of the corner relative to the axis, below which the corner counts as dark
_TINY_MM = 1e-3


@dataclass(frozen=True)
class Check:
    """One figure of a lens, as computed and as stated.

    Attributes:
        quantity: name of the figure, with its unit.
        computed, stated: its values; None where unknown.
        doubt: a clause that tells why the figure casts doubt on the table; empty where it does not.
        state: the zoom or focus state of the file that it holds for; empty for the table itself.
    """

    quantity: str
    computed: float | None
    stated: float | None = None
    doubt: str = ""
    state: str = ""


def check_lens(lens: Lens) -> list[Check]:
    """Return all checks of a lens as read from its file, at the d line: first those of the table, then of its states.

    The quantities are focal length, back focus, f-number of the stop (paraxial) and of the axial beam (real rays
    through all rims), edge thickness, half field (of the outermost chief ray), axial blur, and illumination of the
    corner.
    """
    data = first_order(lens)
    # The table of a near object has its own film, not that of infinity: its blur is checked below, in its state.
    near = any(c.object_distance_mm is not None and not c.thickness_mm for c in lens.configurations)
    found = [*_first_order(lens, data, near=near), _beam(lens, data), _edges(lens), *_field(lens)]
    if data.efl_mm > 0:
        found += [] if near else [_blur(lens, data)]
        found += _corner(lens)
    for c in lens.configurations:
        # The f-number that the source states for this state. A state without one has the table's stop, and any will do.
        same = c.efl_mm is not None and c.efl_mm == lens.stated_efl_mm
        state = replace(in_state(lens, c), f_number=c.f_number or (lens.f_number if same else math.nan))
        try:
            data = first_order(state)
        except InputError as error:
            found.append(Check("focal length, mm", None, c.efl_mm, error.expected, c.name))
            continue
        checks = _focused(state, data, c) if c.object_distance_mm is not None else _first_order(state, data)
        field = () if c.object_distance_mm is not None or c.half_field_deg is None else _field(state)
        found += [replace(check, state=c.name) for check in (*checks, *field)]
    return found


def doubts(checks: list[Check]) -> list[str]:
    """Return the doubts as sentences without a full stop, prefixed by their state; those of the table stand once."""
    table = {c.doubt for c in checks if not c.state}
    found = [c for c in checks if c.doubt and not (c.state and c.doubt in table)]
    return [f"{c.state}: {c.doubt}" if c.state else c.doubt for c in found]


def verdict(checks: list[Check]) -> str:
    """Return "ok", or "doubtful" where any check casts doubt."""
    return "doubtful" if any(c.doubt for c in checks) else "ok"


def _first_order(lens: Lens, data: FirstOrder, *, near: bool = False) -> Iterator[Check]:
    yield _focal_length(lens, data.efl_mm, lens.stated_efl_mm)
    if lens.anamorphic:
        yield _focal_length(lens, first_order(lens, meridian="x").efl_mm, lens.stated_efl_x_mm, " (x-z plane)")
    yield _back_focus(lens, data.back_focus_mm, data.efl_mm, near=near)
    n, stated = data.f_number, lens.f_number
    off = math.isfinite(stated) and abs(n / stated - 1) > F_NUMBER_TOLERANCE
    doubt = f"the stop gives f/{n:.3g}, the source says f/{stated:.3g}" if off else ""
    yield Check("f-number", n, stated if math.isfinite(stated) else None, doubt)


def _focal_length(lens: Lens, efl: float, stated: float | None, plane: str = "") -> Check:
    doubt = ""
    if efl <= 0:
        doubt = "the focal length is negative: a diverging lens forms no picture on a film"
    elif stated is not None and abs(efl / stated - 1) > EFL_TOLERANCE:
        doubt = f"the focal length{plane} is {efl:.4g} mm, the source says {stated:.4g} mm"
    return Check(f"focal length{plane}, mm", efl, stated, doubt)


def _back_focus(lens: Lens, computed: float, efl: float, *, near: bool = False) -> Check:
    tabled, last = float(lens.surfaces[-1].thickness_mm), float(lens.vertices_mm[-2])
    film = f"the table's last thickness puts the film at z = {last + tabled:.2f} mm"
    inside = f"the image lies {-computed:.4g} mm in front of the last surface, where no film can be"
    wrong = not near and abs(computed - tabled) > FOCUS_TOLERANCE * efl  # the film of a near table is its own
    doubt = inside if computed < 0 else f"{film}, its focus is at {last + computed:.2f} mm" * wrong
    return Check("back focus, mm", computed, tabled, doubt * (efl > 0))


def _focused(lens: Lens, data: FirstOrder, c: Configuration) -> Iterator[Check]:
    """Check the image of an object at the state's distance against the tabled film."""
    image_z = data.image_z_mm(-(c.object_distance_mm or 0.0))
    if lens.stated_efl_mm is not None:
        yield _focal_length(lens, data.efl_mm, lens.stated_efl_mm)
    yield _back_focus(lens, image_z - float(lens.vertices_mm[-2]), data.efl_mm)


def _beam(lens: Lens, data: FirstOrder) -> Check:
    """Check whether the rims let the stop's axial beam through: its f-number against that of the widest real beam."""
    height, blocker = axial_beam(lens)
    n = abs(data.efl_mm) / (2 * height) if height > 0 else math.inf
    wrong = n > (1 + BEAM_TOLERANCE) * max(data.f_number, lens.f_number) and blocker not in (None, lens.stop_index)
    doubt = f"the rim of surface {blocker} limits the axial beam to f/{n:.3g}, the stop to f/{data.f_number:.3g}"
    return Check("f-number of the axial beam", n, None, doubt * wrong)


def _edges(lens: Lens) -> Check:
    """Check the thinnest edge of an element; each surface ends flat at its own rim."""
    edges = {
        k: float(a.thickness_mm) + sag_mm(b, b.semi_diameter_mm, 0.0) - sag_mm(a, a.semi_diameter_mm, 0.0)
        for k, (a, b) in enumerate(zip(lens.surfaces, lens.surfaces[1:], strict=False))
        if a.n_d != 1 and not a.figure.axis and not b.figure.axis
    }
    thin = [str(k) for k, edge in edges.items() if edge < -_TINY_MM]
    doubt = f"the edge of the element behind surface {', '.join(thin)} has a negative thickness" if thin else ""
    return Check("thinnest edge, mm", min(edges.values(), default=None), None, doubt)


def _field(lens: Lens) -> Iterator[Check]:
    """Check the last field whose chief ray passes; light may still come from beyond it, through the pupil's side."""
    stated = lens.half_field_deg
    if stated is None:
        return
    low, high, blocker = 0.0, min(stated + 1, 179.0), 0
    for _ in range(2):
        span = torch.deg2rad(torch.linspace(low, high, 33, dtype=torch.float64))
        reached, status = _through(lens, span, torch.zeros(len(span), 1, dtype=torch.float64))
        passed = int((reached & (status == st.PASSED)).to(torch.int8).cumprod(0).sum())
        if passed in (0, len(span)):
            low = high if passed else 0.0
            break
        blocker = int(status[passed]) if bool(reached[passed]) else 0
        low, high = math.degrees(float(span[passed - 1])), math.degrees(float(span[passed]))
    doubt = ""
    if low < stated - FIELD_TOLERANCE_DEG:
        heights = lens.stop_radius_mm * torch.linspace(-1, 1, 41, dtype=torch.float64)[None]
        reached, status = _through(lens, torch.tensor([math.radians(stated)], dtype=torch.float64), heights)
        if not bool((reached & (status == st.PASSED)).any()):
            why = st.describe(blocker) if blocker else "none beyond meets the middle of the stop"
            doubt = f"no light comes from {stated:.4g} degrees as stated: chief rays end at {low:.1f} ({why})"
    yield Check("half field of the last chief ray, degrees", min(low, stated), stated, doubt)


def _through(lens: Lens, field: Tensor, heights: Tensor) -> tuple[Tensor, Tensor]:
    """Return whether rays of fields [F] to heights [F, H] in the stop exist, and their status [F * H]."""
    bundle = aim_at_stop(lens, field, heights)
    return bundle.reached.reshape(-1), plain_trace(lens, bundle.rays, towards="film").status


def _blur(lens: Lens, data: FirstOrder) -> Check:
    """Check the RMS radius of the axial spot in its best focus, all rims open as tabled, over the focal length."""
    blur = axial_blur_mm(lens) / data.efl_mm
    doubt = ""
    if blur > BLUR_LIMIT and lens.refractions > SIMPLE:
        doubt = f"the image on the axis is blurred to {100 * blur:.2g}% of the focal length"
        if not any(s.figure.aspheric for s in lens.surfaces):
            doubt += " (are aspheres missing?)"
    return Check("axial blur, RMS over focal length", blur, None, doubt)


def _corner(lens: Lens) -> Iterator[Check]:
    edge = film_edge_mm(lens)
    if edge is None:
        return
    share = corner_illumination(lens, edge)
    doubt = f"the corner of the film gets {100 * share:.1f}% of the light of its middle" if share < DARK else ""
    yield Check("illumination of the corner", share, None, doubt)


_FAN = 1001
_PUPIL = 3.0  # the pupil of every film point lies within so many paraxial exit pupils


def axial_beam(lens: Lens) -> tuple[float, int | None]:
    """Return half the height (mm, along y) of the widest parallel beam that passes all rims, and what ends it.

    The beam ends at the first height whose ray does not pass, at the surface returned; None where the beam fills the
    whole front surface.
    """
    front, reach = lens.surfaces[0], max(s.semi_diameter_mm for s in lens.surfaces)
    low, high = 0.0, min(front.semi_diameter_mm, end_mm(front))
    zero, blocker = torch.zeros(_FAN, dtype=torch.float64), None
    for _ in range(3):
        y = torch.linspace(low, high, _FAN, dtype=torch.float64)
        status = plain_trace(lens, Rays(zero, y, zero - reach, zero, zero, zero + 1), towards="film").status
        passed = int((status == st.PASSED).to(torch.int8).cumprod(0).sum())
        if passed == _FAN:
            return float(y[-1]), blocker
        if passed == 0:
            return float(y[0]), st.surface_of(int(status[0]))
        blocker = st.surface_of(int(status[passed]))
        low, high = float(y[passed - 1]), float(y[passed])
    return low, blocker


def axial_blur_mm(lens: Lens) -> float:
    """Return the RMS radius (mm) of the image of an axial point at infinity, in the plane where it is smallest.

    Both coordinates count, because an anamorphic lens may have two foci. Where no ray passes it is inf.
    """
    out = follow(lens, axial_rays(lens, -math.inf), lens.reference_nm, "film")
    r = Rays(*(c[out.status == st.PASSED] for c in out.rays))
    if not len(r.x):
        return math.inf
    spot = on_plane(r, best_focus_z_mm(lens, math.inf, (lens.reference_nm, lens.reference_nm)))
    return math.sqrt(float((spot.x**2 + spot.y**2).mean()))


def film_edge_mm(lens: Lens) -> float | None:
    """The radius (mm) of film to be lit: the file's, or the image of its half field; None where neither is stated."""
    if lens.image_radius_mm is not None:
        return lens.image_radius_mm
    if lens.half_field_deg is None:
        return None
    field = torch.tensor([math.radians(lens.half_field_deg)], dtype=torch.float64)
    bundle = aim_at_stop(lens, field, torch.zeros(1, 1, dtype=torch.float64))
    out = plain_trace(lens, bundle.rays, towards="film")
    if int(out.status[0]) == st.PASSED and bool(bundle.reached[0, 0]):
        return abs(float(on_plane(out.rays, first_order(lens).rear_focal_z_mm).x))
    wide = lens.half_field_deg >= 60
    return None if wide else abs(first_order(lens).front_efl_mm) * math.tan(math.radians(lens.half_field_deg))


def corner_illumination(lens: Lens, radius_mm: float) -> float:
    """Return the light at a film radius relative to the middle, by cos^4 and rims, at the d line.

    The film is in focus for infinity. The corner of an anamorphic lens lies halfway between its planes of symmetry.
    """
    across = math.sqrt(0.5) if lens.anamorphic else 0.0
    x, y = (torch.tensor([0.0, radius_mm * share], dtype=torch.float64) for share in (math.sqrt(1 - across**2), across))
    data, plane = first_order(lens), pupil_plane_z_mm(lens)
    # Seen from the corner the pupil is distorted, but it stays within this.
    half = _PUPIL * data.exit_pupil_diameter_mm / 2
    half = half if plane == data.exit_pupil_z_mm else lens.surfaces[-1].semi_diameter_mm
    high = torch.full((2, 2), half, dtype=torch.float64)
    light = FilmLight(lens, (x, y), data.rear_focal_z_mm, plane, -high, high, torch.zeros_like(high))
    middle, corner = light.sums(0).tolist()
    return corner / middle if middle > 0 else 0.0
