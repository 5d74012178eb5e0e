"""Exit pupils of a model with optical path: what `optics.analysis.diffraction` makes of traced rays, without tracing.

The path of the model ends on the plane across s(P) through the front focal point F (`models.phase`). Light of an object
point S that meets the film in one direction passes near one point R of the scene side. So its path from S is that of
the plane wave of the direction d from R to S, which the model has, and (S - F) . d.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray

from neurolens.base.errors import InputError
from neurolens.base.status import DOMAIN_SLACK
from neurolens.graph.interpret import evaluate
from neurolens.graph.ir import Graph
from neurolens.models.assemble import EXACT, DirectionSeries, light_field, scene_ray, units_of
from neurolens.models.cores import STOP, Array, Phased
from neurolens.models.model import LensModel
from neurolens.models.phase import direction_at, foot_of
from neurolens.optics.analysis.exit_pupil import Arrived, ExitPupil, fitted_pupil
from neurolens.optics.analysis.fields import Scene
from neurolens.optics.lens.prescription import Lens
from neurolens.optics.trace.surfaces import Rays

_RAYS = 32  # along a side of the rectangle about what passes
_WIDER = 1.1  # the rectangle over what passes
# Rays up to so many radii of stop and rims count: before they are led to the source (the second: may pass), and after.
_NEAR, _ASIDE, _BEYOND = 1.2, 1.04, 1.08
_RIM = 2.0  # a gate is (height / rim radius)^2 - 1; with this added it stands for a height and a rim of this radius
_NEWTON = 8  # steps from a direction to its point on the focal plane
_SEARCH, _ROUNDS = 65, 3  # points among which the chief ray is sought, and how often


def checked_path(model: LensModel, lens: Lens, wavelengths_nm: Sequence[float]) -> Phased:
    """Return what has the model's path.

    Raises:
        InputError: a model without optical path; a film or a stop of its lens, or a wavelength, outside its domain.
    """
    domain = model.domain
    if not isinstance(model.core, Phased):
        expected = "a model with optical path (neurolens train --phase)"
        raise InputError(lens.path, "model", f"({model.method})", expected)
    limits = [("film_z_mm", float(lens.film_z_mm or 0), domain.film_z_mm)]
    limits.append(("stop_radius_mm", lens.stop_radius_mm, (0.0, domain.stop_radius_mm)))
    limits += [("wavelength_nm", nm, domain.wavelength_nm) for nm in wavelengths_nm if model.encoding.dispersive]
    for name, value, (low, high) in limits:
        if not low / DOMAIN_SLACK <= value <= high * DOMAIN_SLACK:
            raise InputError(lens.path, name, value, f"{low:.6g} to {high:.6g}, the domain of the model")
    return model.core


def model_pupils(
    model: LensModel, scene: Scene, places_mm: Array, wavelengths_nm: Sequence[float]
) -> list[list[ExitPupil | None]]:
    """Return the exit pupils of the object points that are seen at film places, as `diffraction.pupils_at` does.

    Args:
        scene: the model's lens, stopped down and focused, with the distance of its object.
        places_mm: [P, 2] x and y on the film; those beyond the model's film are dark.

    Raises:
        InputError: as `checked_path`.
    """
    known = _Known(model, checked_path(model, scene.lens, wavelengths_nm), scene, wavelengths_nm)
    lit = np.hypot(*places_mm.T) <= model.domain.film_radius_mm * DOMAIN_SLACK
    dark: list[ExitPupil | None] = [None] * len(wavelengths_nm)
    return [known.pupils(place) if inside else dark for place, inside in zip(places_mm, lit, strict=True)]


def _forwards(cosines: Array) -> Array:
    """Return the third direction cosine [N] of light, which goes towards the film."""
    return np.asarray(np.sqrt(np.maximum(1 - (cosines * cosines).sum(0), 1e-6)))


class _Known:
    """A model whose graph tells all of a ray, also outside its domain."""

    def __init__(self, model: LensModel, core: Phased, scene: Scene, wavelengths_nm: Sequence[float]) -> None:
        self.model, self.core, self.scene, self.waves = model, core, scene, wavelengths_nm
        g, form = Graph(), EXACT
        field = light_field(g, model.encoding, g.input("rays", 5), g.input("film_z_mm", per_call=True))
        series = DirectionSeries.of(model, form)
        values = core.build(g, field, units_of(model, series, form))
        assert values.path_um is not None
        g.outputs = {
            "ray": scene_ray(model, values, series, form), "power": values.transmittance,
            "stop": values.vectors[STOP], "path_um": values.path_um,
        }  # fmt: skip
        if values.gates is not None:
            g.outputs["gates"] = values.gates
        self.graph, self.front = g, np.array([0.0, 0.0, core.front_z_mm])

    def rays(self, point: Array, cosines: Array, z_mm: float, nm: Array | float) -> dict[str, Array]:
        """Return what the model says of rays through points [2, N] of a plane, by cosines [2, N] of light."""
        slope = cosines / _forwards(cosines)
        pupil = point + slope * (self.model.domain.pupil_z_mm - z_mm)
        rows = np.concatenate([*np.broadcast_arrays(point, pupil), np.broadcast_to(nm, (1, pupil.shape[1]))])
        found = evaluate(self.graph, {"rays": rows, "film_z_mm": np.full((1, 1), z_mm)})
        return {name: np.broadcast_to(a, (len(a), pupil.shape[1])) for name, a in found.items()}

    def pupils(self, place: Array) -> list[ExitPupil | None]:
        """Return the pupils of a film place [2], by wavelength; None where no light arrives."""
        film_z, first = self.scene.film_z_mm, self.waves[0]
        chief, seen = self._chief(place)
        source = self._source(seen)
        point = (place + chief * (self.core.focal_z_mm - film_z))[:, None]
        box = self._box(place)
        if box is None:
            return [None] * len(self.waves)
        low, high = box
        share = np.linspace(-_WIDER, _WIDER, _RAYS)
        square = np.stack(np.meshgrid(share, share)).reshape(2, -1)
        cosines = (low + high)[:, None] / 2 + (high - low)[:, None] / 2 * square
        light = np.concatenate([cosines, _forwards(cosines)[None]])
        out = self.rays(point, cosines, self.core.focal_z_mm, first)
        foot, leaves, _ = foot_of(self.core, out["ray"])
        way = seen[3:] + 0 * leaves
        if source is not None:
            way = source - self.front[:, None] - foot
            way = way / np.linalg.norm(way, axis=0)
        slope, back = cosines / _forwards(cosines), self.model.domain.pupil_z_mm - self.core.focal_z_mm
        stop_mm = self.scene.lens.stop_radius_mm
        # Far outside the stop a model may fold: rays from there come back into it.
        stop = out["stop"]  # of these rays, it is a rim, too: beyond it polynomials of the others may come back
        near = self._passes(out, point + slope * back, _NEAR * stop_mm, _NEAR**2 - 1)
        # Rays of the source, by cosines: where those that leave so much aside come from.
        point = point + self._point_of(way) - self._point_of(leaves)
        aside = way - direction_at(self.core, point)
        count, waves = cosines.shape[1], np.repeat(self.waves, cosines.shape[1])
        points, ways = (np.tile(a, len(self.waves)) for a in (point, cosines))
        out = self.rays(points, ways, self.core.focal_z_mm, waves)
        ahead = np.concatenate([point - place[:, None], np.full((1, count), self.core.focal_z_mm - film_z)])
        shift = -(light * ahead).sum(0)
        if source is not None:
            shift = shift + ((source - self.front[:, None]) * way).sum(0)
        pupil = point + slope * back
        parts = [{name: a[:, w * count : (w + 1) * count] for name, a in out.items()} for w in range(len(self.waves))]
        for part in parts:  # the wavelengths have rays in the same directions, so that one design fits them all
            near &= self._passes(part, pupil, _BEYOND * stop_mm, _BEYOND**2 - 1)
        found = list[ExitPupil | None]()
        for nm, part in zip(self.waves, parts, strict=True):
            foot, _, _ = foot_of(self.core, part["ray"])
            places, energy = self._across(foot, seen[3:, 0], source)
            gates = part.get("gates", np.zeros((0, count))) + _RIM
            at = np.concatenate([part["stop"][None], stop[None], np.stack([gates, 0 * gates], 1)])
            limits = np.array([stop_mm, _ASIDE * stop_mm, *[_RIM] * len(gates)])
            wave = part["path_um"][0] / 1000 + shift - (foot * aside).sum(0)
            own = Arrived(cosines, place[:, None], at, part["power"][0], near, limits, 0, wave)
            like = found[0] if found else None
            found.append(fitted_pupil(self.scene.lens.aperture, own, places, energy, nm, like))
        return found

    def _chief(self, place: Array) -> tuple[Array, Array]:
        """Return the slope [2] of a film place's ray through the middle of the stop, and its scene ray [6, 1]."""
        radius = float(np.hypot(*place))
        along = place / radius if radius else np.array([1.0, 0.0])
        back, reach = self.model.domain.pupil_z_mm - self.scene.film_z_mm, self.model.domain.pupil_radius_mm
        low, high = -reach, reach
        for _ in range(_ROUNDS):
            tried = np.linspace(low, high, _SEARCH)
            slope = (tried - radius) / back
            out = self.rays(
                place[:, None], along[:, None] * slope / np.sqrt(1 + slope * slope), self.scene.film_z_mm, self.waves[0]
            )
            best = int(np.abs(along @ out["stop"]).argmin())
            low, high = tried[max(best - 1, 0)], tried[min(best + 1, _SEARCH - 1)]
        return along * slope[best], out["ray"][:, best : best + 1]

    def _source(self, seen: Array) -> Array | None:
        """Return the object point [3, 1] on a chief ray [6, 1]; None for a distant one."""
        back = np.concatenate([seen[:3], -seen[3:]])  # light travels to the film
        found = self.scene.object_points(Rays(*torch.from_numpy(back)))
        return None if found is None else np.stack([c.numpy() for c in found])

    def _box(self, place: Array) -> tuple[Array, Array] | None:
        """Return the lowest and highest cosines [2] of light that passes to a film place; None in the dark."""
        domain, lens, film_z = self.model.domain, self.scene.lens, self.scene.film_z_mm
        low, high = np.full(2, -domain.pupil_radius_mm), np.full(2, domain.pupil_radius_mm)
        for _ in range(2):
            share = np.linspace(0, 1, _RAYS)
            pupil = low[:, None] + (high - low)[:, None] * np.stack(np.meshgrid(share, share)).reshape(2, -1)
            slope = (pupil - place[:, None]) / (domain.pupil_z_mm - film_z)
            cosines = slope / np.sqrt(1 + (slope * slope).sum(0))
            out = self.rays(place[:, None], cosines, film_z, self.waves[0])
            lit = self._passes(out, pupil, lens.stop_radius_mm)
            if not lit.any():
                return None
            step = (high - low) / (_RAYS - 1)
            low, high = pupil[:, lit].min(1) - step, pupil[:, lit].max(1) + step
        return cosines[:, lit].min(1), cosines[:, lit].max(1)

    def _passes(self, out: dict[str, Array], pupil: Array, stop_mm: float, gate: float = 0.0) -> NDArray[np.bool_]:
        """Return which rays [N] pass, of those through the pupil of the domain, outside which a model says anything."""
        lit = (out["stop"] ** 2).sum(0) <= stop_mm**2
        lit &= (pupil * pupil).sum(0) <= (self.model.domain.pupil_radius_mm * DOMAIN_SLACK) ** 2
        return np.asarray(lit & (out.get("gates", np.zeros((1, 1))) <= gate).all(0))

    def _point_of(self, direction: Array) -> Array:
        """Return the points P [2, N] of the focal plane whose directions s(P) are these [3, N]."""
        sine = np.hypot(*direction[:2])
        angle, rise = np.arctan2(sine, -direction[2]), np.polynomial.Polynomial(self.core.direction)
        radius = angle / self.core.direction[0]
        for _ in range(_NEWTON):
            square = radius * radius
            radius -= (radius * rise(square) - angle) / (rise(square) + 2 * square * rise.deriv()(square))
        return direction[:2] * (radius / np.where(sine > 0, sine, 1.0))

    def _across(self, foot: Array, axis: Array, source: Array | None) -> tuple[Array, Array | float]:
        """Return places [2, N] on the plane across the chief ray, and the energy per area of it, as `bundles.Aim`."""
        first = np.cross(axis, [0.0, 1.0, 0.0] if abs(axis[1]) < 0.9 else [1.0, 0.0, 0.0])
        first /= np.linalg.norm(first)
        across = np.stack([first, np.cross(axis, first)])
        if source is None:
            return across @ foot, 1.0
        way = source - self.front[:, None] - foot
        met = foot - way * ((axis @ foot) / (axis @ way))
        away = source - self.front[:, None] - met
        return across @ met, (axis @ away) / np.linalg.norm(away, axis=0) ** 3
