"""A lens prescription as frozen data: surfaces from the scene to the film, and the state of focus, zoom and stop."""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import accumulate, pairwise
from typing import Any, Literal, TypedDict

from neurolens.base.errors import InputError
from neurolens.base.lensname import lens_id_of
from neurolens.base.settings import LIGHT_NM
from neurolens.optics.lens.apertures import Aperture
from neurolens.optics.lens.figures import SPHERE, Figure
from neurolens.optics.lens.placement import CENTRED, Placement

LINE_D_NM = 587.5618  # helium, yellow: where first-order data stand


@dataclass(frozen=True)
class Coating:
    """Thin films on one surface.

    Attributes:
        name: of the design, for people and files.
        layers: (refractive index, thickness in nm), from the scene's side to the film's; films that disperse have
            their Abbe number, too, and the index is then n_d (dispersion as of glasses: `glass.index_at`).
        origin: who says so: the "source" of the lens, the "shot" (`Shot.coating`), or nobody: it is "assumed" by the
            year of the design.
    """

    name: str
    layers: tuple[tuple[float, ...], ...]
    origin: Literal["source", "shot", "assumed"] = "source"


@dataclass(frozen=True)
class Surface:
    """Describes one surface, in the lens frame, with lengths in mm.

    Attributes:
        radius_mm: radius of curvature, positive when its centre lies towards the film; `inf` for a plane.
        thickness_mm: distance along the axis to the next surface (of the last one, to the film as tabled).
        diameter_mm: full clear diameter inside the rim; of the opening, for the stop.
        n_d: refractive index, at 587.56 nm, of the medium after the surface.
        V_d: Abbe number of that medium; None for air, or where unknown (the index is then constant).
        material: name of the glass in the source, for people only.
        stop: whether this surface is the aperture stop.
        figure: the shape besides the radius (`optics.lens.figures`); by default that of a sphere or a plane.
        glass: name in the glass catalogue (`neurolens.optics.lens.glass`); its dispersion rules over n_d and V_d.
        absorbs_as: the catalogue glass whose absorption is assumed, of a glass that is known by n_d and V_d alone.
        absorption_per_mm: Napierian absorption of the medium after the surface at every wavelength (a grey filter),
            added to that of the glass.
        coating: the thin films on the surface, None where bare.
        placement: how the surface is moved and turned away from its place on the axis.
        followed_mm: distance from the axis from which on a figure continues smoothly instead of by its polynomial;
            only `aiming.without_rims` sets it, for questions that ignore rims (`shapes.followed_mm`).

    `radius_mm`, `thickness_mm`, `n_d` and the values of `figure` may be 0-d tensors where gradients with respect to
    them are wanted.
    """

    radius_mm: Any
    thickness_mm: Any
    diameter_mm: float
    n_d: Any = 1.0
    V_d: float | None = None
    material: str | None = None
    stop: bool = False
    figure: Figure = SPHERE
    glass: str | None = None
    absorbs_as: str | None = None
    absorption_per_mm: float = 0.0
    coating: Coating | None = None
    placement: Placement = CENTRED
    followed_mm: float = math.inf

    @property
    def curvature(self) -> Any:
        """1 / radius in 1/mm, 0 for a plane."""
        return 1.0 / self.radius_mm

    def vertex_curvature(self, meridian: str) -> Any:
        """Curvature at the vertex along "x" or "y" in 1/mm: 1 / radius + 2 A_2, and 0 where a cylinder is straight."""
        return self.figure.vertex_curvature(self.curvature, meridian)

    @property
    def semi_diameter_mm(self) -> float:
        return self.diameter_mm / 2

    @property
    def plain(self) -> bool:
        """Whether it is a sphere or plane about the lens's axis."""
        return self.figure.plain and not self.placement


@dataclass(frozen=True)
class Medium:
    """The medium in front of a lens, described by the fields with which `Surface` describes the medium after it."""

    n_d: Any = 1.0
    V_d: float | None = None
    material: str | None = None
    glass: str | None = None


class MediumFields(TypedDict, total=False):
    """What a file gives of a medium: some fields of `Medium` or of `Surface`."""

    n_d: float
    V_d: float | None
    material: str | None
    glass: str | None


@dataclass(frozen=True)
class Configuration:
    """A zoom or focus state of the source, with the thicknesses that replace those of the table, by surface index.

    A field that is None is not stated by the source, and the lens's own value holds. A focus state has an
    `object_distance_mm`, from the object to the front vertex; without one the object is at infinity.
    """

    name: str
    efl_mm: float | None
    thickness_mm: tuple[tuple[int, float], ...]
    half_field_deg: float | None = None
    f_number: float | None = None
    stop_diameter_mm: float | None = None
    object_distance_mm: float | None = None


@dataclass(frozen=True)
class Lens:
    """A prescription with the place of the film; immutable: `at` returns a new lens.

    Attributes:
        name, designer, source, notes: as stated in the lens file.
        believed_to_be: the product that the source's example is believed to be, or "".
        mount: the mounts that the product is made for, separated by commas, for people and searches only.
        most_tilt_deg, most_shift_mm: how far the product tilts and shifts to either side; None where that is not known.
        measured: what photographs of that product tell (`optics.photographs.verify`), as pairs of key and value.
        rims: where the rim diameters come from: the "source", somebody who "estimated" them, a rule that "derived"
            them, or "photographs".
        f_number: the nominal one, of the source; rays are traced with the stop's own diameter.
        stated_efl_mm: focal length as the source states it, to check the computed one against; None if not stated. For
            an anamorphic lens it is that in the y-z plane, and `stated_efl_x_mm` that in the x-z plane.
        image_radius_mm: radius of the image circle, None where only the field is known.
        half_field_deg: half field of view, None where unknown.
        film_z_mm: film plane in the lens frame; None until `at` has focused the lens, while the last thickness tells
            it.
        configurations: zoom and focus states of the source.
        path: the file it was read from, for error messages.
        aperture: shape of the stop's opening inside its rim, None where round.
        derived: tells what does not come from the source (such as a zoom between its states).
        infinity_mm: for the groups that `at` has moved to focus, their thicknesses at infinity focus, by surface index.
        object_medium: medium in front of the first surface. The medium behind the last surface, in which the film
            lies, is that of the last row of `surfaces`.
        wavelengths_nm: wavelengths that the source designs the lens for, its primary one first; empty if unknown.
    """

    name: str
    source: str
    surfaces: tuple[Surface, ...]
    f_number: float
    image_radius_mm: float | None = None
    half_field_deg: float | None = None
    designer: str = ""
    notes: str = ""
    believed_to_be: str = ""
    mount: str = ""
    most_tilt_deg: float | None = None
    most_shift_mm: float | None = None
    measured: tuple[tuple[str, Any], ...] = ()
    rims: str = "source"
    film_z_mm: float | None = None
    configurations: tuple[Configuration, ...] = ()
    path: str = "lens"
    stated_efl_mm: float | None = None
    stated_efl_x_mm: float | None = None
    aperture: Aperture | None = None
    derived: str = ""
    infinity_mm: tuple[tuple[int, Any], ...] = ()
    object_medium: Medium = Medium()
    wavelengths_nm: tuple[float, ...] = ()

    @property
    def media(self) -> tuple[Medium | Surface, ...]:
        """The media from the scene to the film, one more than the surfaces: media[k] lies in front of surface k."""
        return (self.object_medium, *self.surfaces)

    @property
    def visible(self) -> bool:
        """Whether the lens is for visible light: its source states a visible wavelength or range, or no wavelength.

        Files often name one wavelength, as 550 nm, or the d line rounded to 587.6 nm, and mean a lens for the eye.
        """
        low, high = LIGHT_NM
        given = self.wavelengths_nm
        return not given or any(low <= nm <= high for nm in given) or min(given) < LINE_D_NM < max(given)

    @property
    def reference_nm(self) -> float:
        """The wavelength of first-order data and analyses: the d line, or the source's primary one where its range
        does not hold the d line."""
        given = self.wavelengths_nm
        return LINE_D_NM if not given or min(given) <= LINE_D_NM <= max(given) else given[0]

    @property
    def light_nm(self) -> tuple[float, float]:
        """The range of wavelengths that the lens is made for: visible light, or the source's range for other light."""
        return LIGHT_NM if self.visible else (min(self.wavelengths_nm), max(self.wavelengths_nm))

    @property
    def vertices_mm(self) -> list[Any]:
        """The z of every surface's vertex, and last that of the film plane as tabled."""
        return list(accumulate((s.thickness_mm for s in self.surfaces), initial=0.0))

    @property
    def stop_index(self) -> int:
        return next(k for k, s in enumerate(self.surfaces) if s.stop)

    @property
    def stop_radius_mm(self) -> float:
        return self.surfaces[self.stop_index].semi_diameter_mm

    @property
    def semi_diameters_mm(self) -> list[float]:
        return [s.semi_diameter_mm for s in self.surfaces]

    @property
    def anamorphic(self) -> bool:
        """Whether any surface is a cylinder, toroid or biconic: the lens is then not round about its axis."""
        return any(s.figure.axis for s in self.surfaces)

    @property
    def decentred(self) -> list[int]:
        """The indices of the surfaces that are moved or turned away from the axis."""
        return [k for k, s in enumerate(self.surfaces) if s.placement]

    @property
    def round(self) -> bool:
        """Whether the lens is round about its axis."""
        return not self.anamorphic and not self.decentred

    @property
    def ideal(self) -> list[int]:
        """The indices of the surfaces that are ideal thin lenses."""
        return [k for k, s in enumerate(self.surfaces) if s.figure.power]

    def require_glass(self, what: str) -> None:
        """Raise InputError where the lens has ideal surfaces: `what` needs glass."""
        for k in self.ideal:
            expected = f"surfaces of glass: an ideal lens has no {what}"
            raise InputError(
                self.path, f"surface {k}, focal_mm", self.surfaces[k].figure.record()["focal_mm"], expected
            )

    def require_centred(self, what: str) -> None:
        """Raise InputError where surfaces are moved or turned away from the axis: `what` needs centred ones."""
        for k in self.decentred:
            (key, value), *_ = self.surfaces[k].placement.record().items()
            raise InputError(self.path, f"surface {k}, {key}", value, f"surfaces on the axis: {what} needs them")

    @property
    def dispersive(self) -> bool:
        """Whether the index of any glass is known to change with the wavelength."""
        return any(m.V_d is not None or m.glass is not None for m in self.media)

    @property
    def coatings(self) -> str:
        """The coatings of the surfaces between glass and air, by name from the scene on, and which are assumed."""
        rows = zip(self.media, self.surfaces, strict=False)
        at_air = (s for m, s in rows if float(m.n_d) != float(s.n_d) and 1.0 in (float(m.n_d), float(s.n_d)))
        names = (
            "bare" if c is None else f"{c.name} (assumed)" if c.origin == "assumed" else c.name
            for c in (s.coating for s in at_air)
        )
        return ", ".join(dict.fromkeys(names))

    @property
    def refractions(self) -> int:
        """Surfaces at which the medium changes: the stop and other surfaces in one medium do not count."""
        return sum(float(a.n_d) != float(b.n_d) for a, b in pairwise(self.media))

    @property
    def lens_id(self) -> str:
        """The name that models carry, of the lens's file."""
        return lens_id_of(self.path)

    @property
    def sha256(self) -> str:
        """Hash of the figures that decide where rays go (glass only: neither film nor stop opening nor texts).

        What is stated of coatings and absorption counts, too; what is assumed does not.
        """
        rows = [_figures(s) for s in self.surfaces]
        rows[-1][1] = None
        m = self.object_medium
        if m != Medium():
            rows.append([float(m.n_d), m.V_d, m.glass, *_terms(m)])
        return hashlib.sha256(json.dumps(rows).encode()).hexdigest()

    @property
    def identity(self) -> dict[str, str]:
        """Which lens this is, for the settings of cameras: id, name, designer, source and hash."""
        texts = {"id": self.lens_id, "name": self.name, "designer": self.designer, "source": self.source}
        return texts | {"sha256": self.sha256}

    def scaled(self, factor: float) -> Lens:
        """Return the lens with all lengths times `factor`; angles, indices and f-number stay.

        A grey filter keeps its density (as it grows, its absorption per mm shrinks), a thicker catalogue glass absorbs
        more, and coatings keep their layers.

        Raises:
            InputError: a factor that is not positive and finite.
        """
        if not 0 < factor < math.inf:
            raise InputError(self.path, "factor", factor, "a positive number")

        def lengths(table: Any, *names: str) -> dict[str, Any]:
            return {name: value * factor for name in names if (value := getattr(table, name)) is not None}

        def gaps(pairs: tuple[tuple[int, Any], ...]) -> tuple[tuple[int, Any], ...]:
            return tuple((k, t * factor) for k, t in pairs)

        surfaces = (
            replace(
                s,
                figure=s.figure.scaled(factor),
                placement=s.placement.scaled(factor),
                absorption_per_mm=s.absorption_per_mm / factor,
                **lengths(s, "radius_mm", "thickness_mm", "diameter_mm", "followed_mm"),
            )
            for s in self.surfaces
        )
        states = (
            replace(
                c,
                thickness_mm=gaps(c.thickness_mm),
                **lengths(c, "efl_mm", "stop_diameter_mm", "object_distance_mm"),
            )
            for c in self.configurations
        )
        stated = lengths(self, "image_radius_mm", "film_z_mm", "stated_efl_mm", "stated_efl_x_mm", "most_shift_mm")
        infinity = gaps(self.infinity_mm)
        return replace(self, surfaces=tuple(surfaces), configurations=tuple(states), infinity_mm=infinity, **stated)

    def half_field_in(self, state: Configuration) -> float | None:
        """Return the half field in a state: the state's own, else the lens's; None where an image circle gives it."""
        return state.half_field_deg or (self.half_field_deg if self.image_radius_mm is None else None)

    def with_stop_radius(self, radius_mm: float) -> Lens:
        """Return the same lens with another opening of the stop."""
        k = self.stop_index
        stop = replace(self.surfaces[k], diameter_mm=2 * radius_mm)
        return replace(self, surfaces=(*self.surfaces[:k], stop, *self.surfaces[k + 1 :]))

    def with_gaps(self, gaps_mm: Mapping[int, Any]) -> Lens:
        """Return the same lens with other thicknesses, by surface index."""
        rows = (replace(s, thickness_mm=gaps_mm.get(k, s.thickness_mm)) for k, s in enumerate(self.surfaces))
        return replace(self, surfaces=tuple(rows))

    def with_aperture(self, aperture: Aperture | None) -> Lens:
        """Return the same lens with blades or a mask in its stop; None is a round stop."""
        return replace(self, aperture=aperture)


def same_medium(surfaces: Sequence[Surface], k: int, in_front: Medium | None = None) -> bool:
    """Test whether the medium is the same before and behind surface k; before the first it is `in_front`, or air."""
    first = surfaces[k - 1] if k else in_front
    before = (first.n_d, first.V_d, first.glass) if first else (1.0, None, None)
    s = surfaces[k]
    return before == (s.n_d, s.V_d, s.glass) and not s.figure.power


def _terms(m: Surface | Medium) -> list[int]:
    """Return how many terms `glass.cauchy` has, where it makes the index of a medium; else nothing."""
    return [3] if m.V_d is not None and m.glass is None else []


def _figures(s: Surface) -> list[Any]:
    """List the figures of a surface that decide where rays go, for the hash; default values are left out."""
    radius = float(s.radius_mm)
    row = [
        abs(radius) if math.isinf(radius) else radius,
        float(s.thickness_mm),
        None if s.stop else float(s.diameter_mm),
        float(s.n_d),
        None if s.V_d is None else float(s.V_d),
        s.stop,
    ]
    stated = None if s.coating is None or s.coating.origin == "assumed" else s.coating
    more = {
        **s.figure.record(),
        **s.placement.record(),
        "glass": s.glass,
        "cauchy": _terms(s),
        "absorption_per_mm": float(s.absorption_per_mm),
        "coating": stated and [[float(v) for v in layer] for layer in stated.layers],
    }
    more = {key: value for key, value in more.items() if value}
    return [*row, more] if more else row
