"""Describes lenses: one in figures, a folder of them as a table, their sections, and their character in five numbers.

Character is that of a lens wide open. Its discs are those of lights at infinity while the lens is focused at 30 focal
lengths, where lenses on films of one size frame a subject alike: on the axis, at 0.6 and at 0.95 of the field.
Vignetting follows the rims: where the file's rims are derived or estimated, cat's eye and swirl are, too.
"""

import io
import math
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from numpy.typing import NDArray

from neurolens.base import status as st
from neurolens.base.errors import NeurolensError, warned
from neurolens.base.lensname import maker_of, year_of
from neurolens.base.report import PART, Report
from neurolens.base.settings import LIGHT_NM
from neurolens.cameras.exact import light_on_axis, state_of
from neurolens.models.fitted import Domain
from neurolens.models.pairs import sample_domain
from neurolens.optics.analysis.bundles import Filled
from neurolens.optics.analysis.fields import Array, Scene
from neurolens.optics.analysis.spots import spots, working_f_number
from neurolens.optics.lens.designs import coated
from neurolens.optics.lens.glass import glass_of
from neurolens.optics.lens.paraxial import FirstOrder, FirstOrderLight, first_order, light_of
from neurolens.optics.lens.prescription import Coating, Lens, Medium
from neurolens.optics.readers.any_format import read_any
from neurolens.optics.setting.check import Check, check_lens, doubts, verdict
from neurolens.optics.setting.focusing import at_infinity, groups_reach_m
from neurolens.optics.setting.pupils import camera_rays, image_radius_mm
from neurolens.optics.setting.states import set_lens, wider_than_stated
from neurolens.optics.trace.rays import plain_trace
from neurolens.pictures.flare.ghosts import GhostTracer, ghost_table
from neurolens.pictures.flare.lights import Light
from neurolens.pictures.render.colour import SpectralRange

_RAYS = 65536
_BINS = 60  # wavelengths of a white card
_NEGLIGIBLE = 1e-4  # a surface that blocks a smaller share of the rays is not listed


@dataclass(frozen=True)
class Ended:
    """The status that ends a share of the rays, and what it says."""

    status: int
    text: str
    share: float


@dataclass(frozen=True, kw_only=True)
class LensFacts(Report):
    """The figures of a lens that is placed, over a domain; for the d line unless stated otherwise.

    Attributes:
        first: first-order data; of an anamorphic lens those in the y-z plane.
        efl_x_mm: focal length in the x-z plane; None for a round lens.
        working_f_number: that of the real marginal ray (y-z); None where no ray passes.
        image_radius_from: how the radius is known.
        half_field_deg: as the file states it.
        half_field_reached_deg: mean angle of the rays that reach the edge of the domain's film (for an anamorphic lens
            along y); None where none does. half_field_reached_x_deg is None for a round lens, too.
        passing_share: share of rays uniform over the domain's film and pupil discs that pass.
        coatings: as `Lens.coatings`.
        groups_reach_m: how near (m, from the film) the lens focuses by its groups; None where it moves as a whole.
        t_stop: f-number of a lens without loss that puts as much light of the d line on the axis; None without light.
        white_rb: R/G and B/G (linear sRGB) of a white card on the axis in daylight D65; None without visible light.
        ended: what stops the other rays, largest share first.
        warnings: sentences.
    """

    name: str
    designer: str
    source: str
    rims: str
    sha256: str
    refractions: int
    first: FirstOrder = field(metadata=PART)
    efl_x_mm: float | None
    light: FirstOrderLight = field(metadata=PART)
    object_medium: Medium
    working_f_number: float | None
    film_z_mm: float
    focus_m: float
    stop_surface: int
    stop_diameter_mm: float
    image_radius_mm: float
    image_radius_from: str
    half_field_deg: float | None
    half_field_reached_deg: float | None
    half_field_reached_x_deg: float | None
    passing_share: float
    coatings: str
    groups_reach_m: float | None
    t_stop: float | None
    white_rb: tuple[float, float] | None
    ended: list[Ended]
    warnings: list[str]


def lens_facts(lens: Lens, domain: Domain) -> LensFacts:
    """Return the figures of a lens placed by `set_lens` over a domain."""
    squeezed = lens.anamorphic
    film_z = float(lens.film_z_mm if lens.film_z_mm is not None else domain.film_z_mm[0])
    radius, radius_from = image_radius_mm(lens)
    passing, ended = passing_share(lens, domain)
    working = working_f_number(Scene(lens, domain.focus_m[0]), lens.reference_nm)
    # A round lens has the same field along y; for it the mean over rays along x is used.
    reached = field_reached_deg(lens, domain, film_z, "y" if squeezed else "x")
    reached_x = field_reached_deg(lens, domain, film_z, "x") if squeezed else reached
    notes = warnings_of(lens, first_order(at_infinity(lens)).f_number, reached, math.isinf(domain.focus_m[0]))
    if reached is None or reached_x is None:
        where = " and ".join(axis for axis, deg in (("y", reached), ("x", reached_x)) if deg is None)
        along = f", along {where}" if squeezed else ""
        notes.append(f"no ray reaches the edge of the film ({domain.film_radius_mm:.4g} mm from the axis{along})")
    return LensFacts(
        name=lens.name,
        designer=lens.designer,
        source=lens.source,
        rims=lens.rims,
        sha256=lens.sha256,
        refractions=lens.refractions,
        first=first_order(lens),
        efl_x_mm=float(first_order(lens, meridian="x").efl_mm) if squeezed else None,
        light=light_of(lens),
        object_medium=lens.object_medium,
        working_f_number=None if math.isnan(working) else working,
        film_z_mm=film_z,
        focus_m=domain.focus_m[0],
        stop_surface=lens.stop_index,
        stop_diameter_mm=2 * lens.stop_radius_mm,
        image_radius_mm=radius,
        image_radius_from=radius_from,
        half_field_deg=lens.half_field_deg,
        half_field_reached_deg=reached,
        half_field_reached_x_deg=reached_x if squeezed else None,
        passing_share=passing,
        coatings=lens.coatings,
        groups_reach_m=groups_reach_m(lens),
        t_stop=state_of(lens, lens.light_nm)["t_stop"],
        white_rb=white_rb(lens),
        ended=ended,
        warnings=notes,
    )


def white_rb(lens: Lens) -> tuple[float, float] | None:
    """Return R/G and B/G of a white card on the axis in daylight D65, in linear sRGB, of a lens placed by `set_lens`.

    It is of all rays through the stop: the film sees a pupil that is wider in blue light than in red, and steep rays
    meet coatings that pass other colours. None where no ray passes, or the lens is made for other light.
    """
    if not lens.visible:
        return None
    light = SpectralRange(*LIGHT_NM, _BINS)
    red, green, blue = light.film_rgb(light_on_axis(lens, light.centres_nm.tolist(), LIGHT_NM))
    return (float(red / green), float(blue / green)) if green > 0 else None


_ROUND = {"conic": 0.0, "asphere": {}, "cylinder": None, "across": None, "focal_mm": None}
_PLACED = {"decentre_mm": "decentred by", "tilt_deg": "tilted by"}


@dataclass(frozen=True, kw_only=True)
class SurfaceRow:
    """A row of a prescription with all its figures.

    Attributes:
        n_d, V_d: the catalogue's where a glass rules.
        absorbs_as: the glass whose absorption is assumed.
        shape: the numbers of the figure; `asphere` is {power: coefficient}.
        figure: what the figure is, in words; empty for a sphere.
        placement: how it is moved (mm) and turned (degrees) away from the axis, as the keys of lens files say.
    """

    surface: int
    z_mm: float
    radius_mm: float
    thickness_mm: float
    diameter_mm: float
    stop: bool
    material: str | None
    glass: str | None
    n_d: float
    V_d: float | None
    absorbs_as: str | None
    absorption_per_mm: float | None
    shape: Mapping[str, Any] = field(metadata=PART)
    figure: str
    placement: Mapping[str, list[float]] = field(metadata=PART)
    coating: Coating | None

    def words(self) -> str:
        """Return what the surface is besides its radius and glass; empty for a sphere."""
        coating = self.coating
        words = [
            self.figure,
            *(
                f"{_PLACED[key]} {' '.join(f'{v:.3g}' for v in values)} {'mm' if key.endswith('mm') else 'degrees'}"
                for key, values in self.placement.items()
            ),
            f"coating {coating.name}" if coating is not None and coating.origin != "assumed" else "",
            f"absorbs {self.absorption_per_mm:.3g}/mm" if self.absorption_per_mm else "",
        ]
        return ", ".join(word for word in words if word)


def glass_table(lens: Lens) -> list[SurfaceRow]:
    """Return the prescription row by row."""
    rows = []
    for k, (s, z) in enumerate(zip(lens.surfaces, lens.vertices_mm[:-1], strict=True)):
        glass = None if s.glass is None else glass_of(s.glass)
        shape = s.figure.record()
        shape["asphere"] = {str(power): a for power, a in shape.get("asphere", ())}
        rows.append(SurfaceRow(
            surface=k, z_mm=float(z), radius_mm=float(s.radius_mm), thickness_mm=float(s.thickness_mm),
            diameter_mm=s.diameter_mm, stop=s.stop, material=s.material, glass=s.glass,
            n_d=float(s.n_d if glass is None else glass.n_d), V_d=s.V_d if glass is None else float(glass.V_d),
            absorbs_as=s.absorbs_as, absorption_per_mm=s.absorption_per_mm, shape=_ROUND | shape,
            figure=s.figure.words(), placement=s.placement.record(), coating=s.coating,
        ))  # fmt: skip
    return rows


def field_reached_deg(lens: Lens, domain: Domain, film_z: float, axis: Literal["x", "y"] = "x") -> float | None:
    """Return the mean angle to the axis (degrees) of rays from the film's edge to the scene; None where none passes.

    The edge is that on the x or the y axis of the film.
    """
    grid = torch.linspace(-domain.pupil_radius_mm, domain.pupil_radius_mm, 200, dtype=torch.float64)
    # half of it, for it is symmetric across
    u, v = (t.reshape(-1) for t in torch.meshgrid(grid, grid[100:], indexing="ij"))
    edge, zero = torch.full_like(u, domain.film_radius_mm), torch.zeros_like(u)
    film, pupil = ((edge, zero), (u, v)) if axis == "x" else ((zero, edge), (v, u))
    out = plain_trace(lens, camera_rays(*film, film_z, *pupil, domain.pupil_z_mm))
    passed = out.status == st.PASSED
    if not passed.any():
        return None
    angle = torch.atan2(torch.hypot(out.rays.dx, out.rays.dy), -out.rays.dz)[passed].mean()
    return math.degrees(float(angle))


def passing_share(lens: Lens, domain: Domain, seed: int = 5) -> tuple[float, list[Ended]]:
    """Return the share of a domain's rays that pass, and what ends the others, largest share first."""
    rays = sample_domain(domain, _RAYS, seed)
    start = camera_rays(rays.film_x, rays.film_y, rays.film_z, rays.pupil_x, rays.pupil_y, domain.pupil_z_mm)
    status = plain_trace(lens, start, rays.wavelength_nm).status
    codes, counts = (t.tolist() for t in torch.unique(status, return_counts=True))
    share = {int(code): count / _RAYS for code, count in zip(codes, counts, strict=True)}
    passed = share.pop(st.PASSED, 0.0)
    stop = st.blocked(lens.stop_index, st.RIM)
    ended = [
        Ended(code, "blocked by the stop" if code == stop else st.describe(code), part)
        for code, part in sorted(share.items(), key=lambda item: -item[1])
        if part >= _NEGLIGIBLE
    ]
    return passed, ended


def file_doubts(tabled: Lens, states: bool = True) -> list[str]:
    """Return doubts about a lens file as sentences, with or without those about its states. See also `warnings_of`."""
    # A stop that is smaller than stated is a choice, not a doubt.
    checks = [c for c in check_lens(tabled) if c.quantity != "f-number" or (c.computed or 0.0) > (c.stated or 0.0)]
    return doubts([c for c in checks if states or not c.state])


def rim_doubts(lens: Lens) -> list[str]:
    """Return a sentence about rims that are not the source's, if there are any."""
    return {
        "estimated": ["rim diameters are estimated, not the source's: vignetting is a guess"],
        "derived": ["rim diameters are derived by a rule, the source has none: vignetting follows that rule"],
    }.get(lens.rims, [])


def warnings_of(lens: Lens, f_number: float, reached_deg: float | None, far: bool) -> list[str]:
    """Return warnings about a lens as it is set, in sentences; `file_doubts` and the reader's warnings are of its file.

    Args:
        f_number: of the lens at infinity focus, as the source states it.
        reached_deg: half field that reaches the edge of the film.
        far: whether the lens is at infinity focus, for which its source states the field.
    """
    sentences = rim_doubts(lens) + wider_than_stated(lens, f_number)
    if far and lens.half_field_deg is not None and reached_deg is not None and reached_deg < lens.half_field_deg - 2:
        sentences.append(
            f"the edge of the film sees {reached_deg:.1f} degrees, the source says {lens.half_field_deg:.1f}"
        )
    return sentences


def read_quietly(path: Path) -> Lens:
    """Read a lens without warnings, which its check repeats."""
    with warned():
        return read_any(path)


def library_row(path: Path, checked: bool = True, characters: bool = False) -> dict[str, Any]:
    """Return a lens file as a row of a table.

    Returns: lens, file, notes (the warnings of its reader), `lens_row`, checked or not, and its character and T-stop
    (None unless asked for). A file that cannot be read has the verdict "unreadable", with the error as its doubt.
    """
    with warned(path) as notes:
        try:
            lens = read_any(path)
            row = {
                **lens_row(lens, check_lens(lens) if checked else None),
                "character": character_or_none(lens)[0] if characters else None,
                "t_stop": t_stop_of(lens) if characters else None,
            }
        except NeurolensError as error:
            row = {"verdict": "unreadable", "doubts": [str(error).removeprefix(f"{path}: ")]}
    return {"lens": path.stem, "file": str(path), **row, "notes": notes}


_STATED = (
    "name", "believed_to_be", "mount", "stated_efl_mm", "half_field_deg", "image_radius_mm", "refractions", "rims",
)  # fmt: skip


def lens_row(lens: Lens, checks: list[Check] | None) -> dict[str, Any]:
    """Return a lens, as read from its file, as a row of a table, with its `check_lens` or (None) without.

    Returns:
        name, believed_to_be, mount, maker, year, efl_mm and efl_x_mm computed (the latter only for an anamorphic lens),
        stated_efl_mm, back_focus_mm, f_number of the stop, half_field_deg as stated, image_radius_mm as stated,
        refractions, aspheres, cylinders, states (zoom or focus), match (how surely photographs are of this product),
        rims, verdict ("ok" or "doubtful"; without checks "read"), doubts, and checks: a list of {state, quantity,
        computed, stated, doubt}.
    """
    data, cylinders = first_order(lens), sum(s.figure.axis is not None for s in lens.surfaces)
    return {
        **{key: getattr(lens, key) for key in _STATED},
        "maker": maker_of(lens.designer),
        "year": year_of(lens.source),
        **{key: float(getattr(data, key)) for key in ("efl_mm", "back_focus_mm", "f_number")},
        "efl_x_mm": float(first_order(lens, meridian="x").efl_mm) if cylinders else None,
        "aspheres": sum(s.figure.aspheric for s in lens.surfaces),
        "cylinders": cylinders,
        "states": len(lens.configurations),
        "match": dict(lens.measured).get("match"),
        "verdict": "read" if checks is None else verdict(checks),
        "doubts": doubts(checks or []),
        "checks": [asdict(c) for c in checks or []],
    }


FOCUS, FIELDS = 30, (0.0, 0.6, 0.95)  # focal lengths at which a lens is focused; shares of the field's edge
_LEVEL = 3  # level of the pupil's nodes: some 12,000 rays for a disc
_POWER = 4  # power of the squared distance from the centre, by which the rim's light is weighted
_SEEN = 0.01  # of the image's radius: from this standard deviation on a disc shows its shape
# a disc at the field's edge that is larger, over that on the axis, is shaped by aberrations and not by rims
_UNCUT = 1.5
_HALF_DIAGONAL_MM = 21.6  # half the diagonal of a picture of 36 x 24 mm, to which spots are scaled
_GHOST_RAYS = 2000
_SIDE, _DISC = 32, 0.92  # pixels of a disc's picture; share of the side that the widest disc takes,
_WIDEST = 1.5  # where a disc counts as at most so many times as wide as that on the axis


@dataclass(frozen=True)
class Character(Report):
    """What a lens is known for. A figure that cannot be had is NaN.

    In the first three figures, discs that are small in the picture count less, in proportion: they count in full when
    their standard deviation on the axis is 1% of the image's radius or more.

    Attributes:
        cats_eye: area of the disc of a light far out of focus at 0.95 of the field, over that on the axis: 1 where no
            rim cuts it. NaN above 1.5, where aberrations shape the disc, as in condensers, which are no picture lenses.
        swirl: how much narrower the disc at 0.6 of the field is along the picture's radius than across it, compared
            with the axis: 1 less the ratio of the standard deviations of its light; 0 for a round disc. Field curvature
            and astigmatism make swirl, too.
        bubble: light near the rim of the disc on the axis behind the focus, over that of an even disc; light counts by
            the eighth power of its distance from the centre. It is 1 if even, up to 5 for a bright rim alone. The film
            is moved to where the deviation is 1% of the image's radius, so that discs of one size are compared; NaN
            where the sharpest disc is larger.
        softness_um: RMS radius of a white point on the axis at the best focus of a far light, in a picture of 43.2 mm
            across its corners.
        flare: light of all ghosts of two reflections on the film's plane, over that of the image, for a light at half
            the field; of bare glass, where the file states no coating, so that designs are compared.
    """

    cats_eye: float
    swirl: float
    bubble: float
    softness_um: float
    flare: float


@dataclass(frozen=True)
class Discs:
    """Rays of F fields: places on the film from their centre, and slopes there, tangential and sagittal [F, 2, P].

    `weight` [F, P] is their energy, also 0 on the outline; `passed` tells whether they reach the film.
    """

    place_mm: Array
    slope: Array
    weight: Array
    passed: NDArray[np.bool_]


def character(lens: Lens) -> tuple[Character, Discs]:
    """Return the character of a lens as its file has it, and its discs.

    Raises:
        InputError: the lens forms no image, or passes no light.
    """
    scene = Scene(set_lens(coated(lens, "stated"), focus_m=math.inf, focus_mode="best"))
    scene.require_power()
    edge = scene.edge.field_deg
    discs, radius = discs_of(lens, [share * edge for share in FIELDS]), scene.image_radius_mm
    softness = float(spots(scene, [0.0], rings=1, shift_mm=[0.0]).rms_um[0]) * _HALF_DIAGONAL_MM / radius
    flare = math.nan
    with suppress(NeurolensError):  # a lens whose ghosts cannot be traced has the other figures
        ghosts = ghost_table(GhostTracer(scene.lens), Light(0.0, edge / 2), scene.lens.reference_nm, _GHOST_RAYS)
        flare = sum(ghost.energy for ghost in ghosts) or math.nan
    flare = flare if flare < math.inf else math.nan  # no ray of that light was found
    return Character(cats_eye(discs, radius), swirl(discs, radius), bubble(discs, radius), softness, flare), discs


def character_or_none(lens: Lens) -> tuple[dict[str, float | None] | None, bytes | None]:
    """Return the figures of `character` with four digits (None for NaN), and the `picture` of its discs.

    Both are None for a lens whose character cannot be had.
    """
    try:
        found, discs = character(lens)
    except NeurolensError:
        return None, None
    figures = {k: None if math.isnan(v) else float(f"{v:.4g}") for k, v in found.to_dict().items()}
    return figures, picture(discs)


def t_stop_of(lens: Lens) -> float | None:
    """Return the T-stop at the d line of a lens as read from its file, with four digits; None where none is known."""
    try:
        placed = set_lens(lens)
        found = state_of(placed, placed.light_nm)["t_stop"]
    except NeurolensError:
        return None
    return found and float(f"{found:.4g}")


def discs_of(lens: Lens, field_deg: list[float]) -> Discs:
    """Trace the discs of lights at infinity in these fields, the axis first."""
    near = 1e-3 * FOCUS * abs(float(Scene(lens).first_order.efl_mm))
    scene = Scene(set_lens(lens, focus_m=near, focus_mode="best"))
    rays = Filled(scene, field_deg, scene.waves_nm[:1]).bundle(_LEVEL)
    weight = rays.weight[:, 0].numpy()
    both = (rays.tangential_mm, rays.sagittal_mm), rays.slopes
    place, slope = (np.nan_to_num(np.stack([c[:, 0].numpy() for c in pair], 1)) for pair in both)
    return Discs(place - _mean(place, weight), slope - _mean(slope, weight), weight, rays.passed[:, 0].numpy())


def _mean(values: Array, weight: Array) -> Array:
    """Return the mean [F, 2, 1] of values; NaN where there is no light."""
    with np.errstate(invalid="ignore"):
        return np.asarray((weight[:, None] * values).sum(2, keepdims=True) / weight.sum(1)[:, None, None])


def _seen(discs: Discs, image_radius_mm: float) -> float:
    """Return by which share, up to 1, the shapes of discs count. See `Character`."""
    return min(1.0, math.sqrt(_mean(discs.place_mm**2, discs.weight)[0].mean()) / (_SEEN * image_radius_mm))


def cats_eye(discs: Discs, image_radius_mm: float) -> float:
    """Compute `Character.cats_eye`. The disc of a light far out of focus has the shape of the rays' slopes."""
    areas = []
    for slope, outline in zip(discs.slope, discs.passed & (discs.weight == 0), strict=True):
        x, y = slope[:, outline]
        x, y = (c[np.argsort(np.arctan2(y, x))] for c in (x, y))
        areas.append(float(x @ np.roll(y, -1) - y @ np.roll(x, -1)) / 2)
    if not 0 < areas[-1] <= _UNCUT * areas[0]:
        return math.nan
    return 1 - (1 - areas[-1] / areas[0]) * _seen(discs, image_radius_mm)


def swirl(discs: Discs, image_radius_mm: float) -> float:
    """Compute `Character.swirl`."""
    radial, across = np.sqrt(_mean(discs.place_mm**2, discs.weight))[..., 0].T
    return float(1 - radial[1] / across[1] / (radial[0] / across[0])) * _seen(discs, image_radius_mm)


def bubble(discs: Discs, image_radius_mm: float) -> float:
    """Compute `Character.bubble`. As the film moves, a ray moves on it by its slope times that way."""
    place, slope = discs.place_mm, discs.slope
    squares = (place * place, place * slope, slope * slope)
    here, mixed, steep = (float(_mean(v, discs.weight)[0].mean()) for v in squares)
    root = mixed**2 - steep * (here - (_SEEN * image_radius_mm) ** 2)
    if not root >= 0:
        return math.nan
    moved = place[0] + (math.sqrt(root) - mixed) / steep * slope[0]  # the root behind the focus
    weight, r2 = discs.weight[0], np.where(discs.passed[0], (moved**2).sum(0), 0.0)
    share = r2 / r2.max()
    found = float((_POWER + 1) * (weight * share**_POWER).sum() / weight.sum())
    return 1 + (found - 1) * _seen(discs, image_radius_mm)


def picture(discs: Discs) -> bytes:
    """Draw the discs side by side as a grey PNG of 96 by 32 pixels, the film's radius upwards; wide ones are cut."""
    from PIL import Image

    radii = np.where(discs.passed, np.sqrt((discs.place_mm**2).sum(1)), 0.0).max(1)
    scale = _DISC * _SIDE / 2 / min(radii.max(), _WIDEST * radii[0])
    grey = np.zeros((len(radii), _SIDE, _SIDE))
    for disc, place, weight in zip(grey, discs.place_mm, discs.weight, strict=True):
        down, right = np.clip(_SIDE / 2 - 0.5 + scale * np.stack([-place[0], place[1]]), -2, _SIDE + 1)
        for row, column in ((0, 0), (0, 1), (1, 0), (1, 1)):  # a ray's light is shared by the four pixels about it
            y, x = np.floor(down).astype(int) + row, np.floor(right).astype(int) + column
            part = (1 - np.abs(y - down)) * (1 - np.abs(x - right)) * weight
            seen = (part > 0) & (np.minimum(y, x) >= 0) & (np.maximum(y, x) < _SIDE)
            np.add.at(disc, (y[seen], x[seen]), part[seen])
    even = discs.weight[0].sum() / (math.pi * (scale * radii[0]) ** 2)
    shade = 255 * np.clip(np.hstack(list(grey)) / (2 * even), 0, 1) ** (1 / 2.2)
    buffer = io.BytesIO()
    Image.fromarray(np.round(shade).astype(np.uint8)).save(buffer, "png", optimize=True)
    return buffer.getvalue()
