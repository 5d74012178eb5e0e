"""Bundles of rays from the scene that fill the real stop, traced to the film.

Works for every lens whose chief rays exist: fisheyes, anamorphic lenses, stops between, before and behind the glass.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from neurolens.analysis.aim import Aim
from neurolens.analysis.fields import DEFAULT_NM, Scene, on_plane
from neurolens.analysis.patterns import Pattern, hexapolar
from neurolens.base import status as st
from neurolens.base.errors import InputError
from neurolens.optics.apertures import inside_on_tensors
from neurolens.optics.passing import media
from neurolens.optics.surfaces import Rays
from neurolens.optics.trace import trace


@dataclass(frozen=True)
class Bundle:
    """Rays of F fields, W wavelengths and P pupil points; tensors are [F, W, P], or [F] for the chief ray.

    Tangential coordinates, of the stop and of the film, grow towards the side on which the image lies (the negative
    side of the scene's `axis`); sagittal ones along the other transverse axis.

    Attributes:
        start: before the front surface, travelling to the film.
        film: on the film plane.
        tangential_mm, sagittal_mm: film points relative to the chief ray of the first wavelength.
        status: of the trace with all rims and the stop; rays that could not be aimed count as missing surface 0.
        weight: energy of each ray: beam area in mm^2 (distant object) or solid angle in sr; 0 where it is blocked.
        open_weight: the same as if nothing but the stop were in the way.
        path_mm: optical path from the wavefront (or object point) to the film.
        chief_height_mm: [F], image height of the chief ray of the first wavelength, positive.
    """

    scene: Scene
    field_deg: tuple[float, ...]
    wavelength_nm: tuple[float, ...]
    pattern: Pattern
    start: Rays
    film: Rays
    tangential_mm: Tensor
    sagittal_mm: Tensor
    status: Tensor
    weight: Tensor
    open_weight: Tensor
    path_mm: Tensor
    chief_height_mm: Tensor

    @property
    def passed(self) -> Tensor:
        return self.status == 0

    @property
    def slopes(self) -> tuple[Tensor, Tensor]:
        """Tangential and sagittal slope (mm per mm along +z) of the rays at the film, [F, W, P]."""
        x, y = self.film.dx / self.film.dz, self.film.dy / self.film.dz
        return (-x, y) if self.scene.axis == "x" else (-y, x)

    def at_shift(self, shift_mm: float) -> tuple[Tensor, Tensor]:
        """Tangential and sagittal points with the film moved by `shift_mm` away from the lens, [F, W, P]."""
        t, s = self.slopes
        return self.tangential_mm + shift_mm * t, self.sagittal_mm + shift_mm * s


def bundle(
    scene: Scene,
    field_deg: Sequence[float],
    wavelength_nm: Sequence[float] = DEFAULT_NM,
    pattern: Pattern | None = None,
) -> Bundle:
    """Aim and trace rays of several fields and wavelengths through the points of a pupil pattern.

    Args:
        scene: lens, object and meridional plane.
        field_deg: angles of the chief ray of the first wavelength, from 0 to below 180.
        wavelength_nm: the first is the reference; all share the object point (or direction) of its chief ray.
        pattern: hexapolar with 8 rings where not given.
    """
    pattern = pattern or hexapolar(8)
    fields, waves = tuple(float(f) for f in field_deg), tuple(float(w) for w in wavelength_nm)
    shape = (len(fields), len(waves), len(pattern.weight))
    chief = scene.chief_rays(fields, waves[0])
    aim = Aim(scene, chief, shape, waves)
    u, v, aimed, stretch = aim.at(pattern)
    start = aim.rays(u, v)
    film, status, path = _to_film(scene, start, aim.wavelength)
    status = torch.where(aimed, status, st.blocked(0, st.MISSED))
    area = pattern.weight.expand(shape).reshape(-1) * stretch
    area = torch.where(aimed & _inside_stop(scene, pattern).expand(shape).reshape(-1), area, 0.0)
    passed = status == 0
    x, y = (c.reshape(shape) for c in (film.x, film.y))
    x, y = x - chief.film.x[:, None, None], y - chief.film.y[:, None, None]
    t, s = (-x, y) if scene.axis == "x" else (-y, x)

    def shaped(value: Tensor, keep: Tensor = passed, other: float = math.nan) -> Tensor:
        return torch.where(keep, value, other).reshape(shape)

    return Bundle(
        scene, fields, waves, pattern,
        Rays(*(c.reshape(shape) for c in start)),
        Rays(*(shaped(c) for c in film)),
        shaped(t.reshape(-1)), shaped(s.reshape(-1)),
        status.reshape(shape), shaped(area, other=0.0), area.reshape(shape),
        shaped(aim.lead_mm(u, v) + path), chief.height_mm,
    )  # fmt: skip


def check_light(scene: Scene, field_deg: Sequence[float] | None, wavelength_nm: float) -> None:
    """Raise InputError for a field asked for from which no ray reaches the film, or a lens that passes none at all.

    Of the default fields (None) some may be dark.
    """
    fields = scene.default_fields() if field_deg is None else field_deg
    seen = bundle(scene, [0.0, *fields], [wavelength_nm], hexapolar(12)).passed.any(2).any(1).tolist()
    if not any(seen):
        raise InputError(scene.lens.path, "surfaces", "(no ray reaches the film)", "a lens that passes light")
    dark = [field for field, lit in zip(field_deg or (), seen[1:], strict=False) if not lit]
    if dark:
        edge = f"at most {scene.edge_deg():.4g} degrees, the edge of the image"
        raise InputError(scene.lens.path, f"field {dark[0]:g}", "(no light reaches the film)", edge)


def _to_film(scene: Scene, start: Rays, wavelength_nm: Tensor) -> tuple[Rays, Tensor, Tensor]:
    """Rays on the film, their status, and the optical path from their start to the film."""
    lens = scene.traced
    with torch.no_grad():
        out = trace(lens, start, wavelength_nm, towards="film", path=True)
    film = on_plane(out.rays, scene.film_z_mm)
    path = torch.zeros_like(start.x)
    indices = [m.n for m in media(lens, wavelength_nm)]
    points: list[Rays] = [start, *out.path, film]
    for n, before, after in zip(indices, points, points[1:], strict=False):
        # Along the ray, not the distance: steps back to the stop inside an element count as negative.
        gap = sum((b - a) * d for a, b, d in zip(before[:3], after[:3], before[3:], strict=True))
        path = path + n * gap
    return film, out.status, path


def _inside_stop(scene: Scene, pattern: Pattern) -> Tensor:
    """Whether the points of a pattern lie inside the blades or the mask of the stop, [P]."""
    t, s = pattern.tangential, pattern.sagittal
    if scene.lens.aperture is None:
        return torch.ones_like(t, dtype=torch.bool)
    x, y = (-t, s) if scene.axis == "x" else (s, -t)
    return inside_on_tensors(scene.lens.aperture, x, y, 1.0)
