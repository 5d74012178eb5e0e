"""Exit pupils of a model with optical path: what `optics.analysis.diffraction` makes of traced rays, without tracing.

The path of the model ends on the plane across s(P) through the front focal point F (`models.phase`). Light of an object
point S that meets the film in one direction passes near one point R of the scene side. So its path from S is that of
the plane wave of the direction d from R to S, and (S - F) . d.

By Fermat's principle the path hardly depends on which ray of that direction on the film is followed. That through the
point P with s(P) = d has the path that the model knows; it leaves in a direction d + e, and the ray that leaves in the
direction d passes R. So the path is too long by (R_P - R) . e / 2, which is small, and so are errors of the model's
rays in it. The path along the very ray of S would have the error of R in full, times d - s.
"""

from __future__ import annotations

from collections.abc import Sequence
from weakref import WeakKeyDictionary

import numpy as np
import torch
from numpy.typing import NDArray

from neurolens.base.errors import InputError
from neurolens.base.status import DOMAIN_SLACK
from neurolens.graph.compiled import CompiledGraph
from neurolens.graph.compiler import has_compiler
from neurolens.graph.interpret import evaluate
from neurolens.graph.ir import Graph
from neurolens.models.assemble import EXACT, DirectionSeries, light_field, scene_ray, units_of
from neurolens.models.cores import STOP, Array, Phased
from neurolens.models.model import LensModel
from neurolens.models.phase import direction_at, foot_of
from neurolens.optics.analysis.exit_pupil import ExitPupil, fitted_waves
from neurolens.optics.analysis.fields import Scene
from neurolens.optics.lens.prescription import Lens
from neurolens.optics.trace.surfaces import Rays

_RAYS = 28  # along a side of the box about what passes
_LINE = np.linspace(-1, 1, _RAYS)
_SQUARE = np.stack(np.meshgrid(_LINE, _LINE)).reshape(2, -1)
_ROOM = 1.1  # the box over what passes
_AT_ONCE = 4  # places whose rays are evaluated in one go
_FAR_UM = 1e30
# Graphs of models, and the same compiled where the machine has a compiler.
_KNOWN: WeakKeyDictionary[Phased, tuple[Graph, CompiledGraph | None]] = WeakKeyDictionary()
# Rays up to so many radii of stop and rims count: before they are led to the source (the second: may pass), and after.
_NEAR, _ASIDE, _BEYOND = 1.2, 1.04, 1.1
_RIM = 2.0  # a gate is (height / rim radius)^2 - 1; with this added it stands for a height and a rim of this radius
_ASTRAY = 0.05  # pupil radii from a ray on the focal plane to the other whose path is taken for its own
_NEWTON = 8  # steps from a direction to its point on the focal plane
_SEARCH, _ROUNDS = 65, 3  # points among which the chief ray is sought, and how often


def checked_path(model: LensModel, lens: Lens, wavelengths_nm: Sequence[float]) -> Phased:
    """Return the core that holds the model's optical path.

    Raises:
        InputError: a model without optical path; a film or a stop of its lens, or a wavelength, outside its domain.
    """
    domain = model.domain
    if not isinstance(model.core, Phased):
        expected = "a model with optical path (neurolens train --phase)"
        raise InputError(lens.path, "model", f"({model.method})", expected)
    limits = [
        ("film_z_mm", float(lens.film_z_mm or 0), domain.film_z_mm),
        ("stop_radius_mm", lens.stop_radius_mm, (0.0, domain.stop_radius_mm)),
        *(("wavelength_nm", nm, domain.wavelength_nm) for nm in wavelengths_nm if model.encoding.dispersive),
    ]
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
    found: list[list[ExitPupil | None]] = [[None] * len(wavelengths_nm) for _ in places_mm]
    [lit] = np.nonzero(np.hypot(*places_mm.T) <= model.domain.film_radius_mm * DOMAIN_SLACK)
    for k in range(0, len(lit), _AT_ONCE):
        some = lit[k : k + _AT_ONCE]
        with np.errstate(invalid="ignore"):  # rays far outside, which are left out, may not exist
            made = known.pupils(places_mm[some].T)
        for number, own in zip(some, made, strict=True):
            found[number] = own
    return found


def _forwards(cosines: Array) -> Array:
    """Return the third direction cosine [N] of light, which goes towards the film."""
    return np.asarray(np.sqrt(np.maximum(1 - (cosines * cosines).sum(0), 1e-6)))


def _graph(model: LensModel, core: Phased) -> Graph:
    """Return the graph that tells all of a ray, also outside the domain of its model."""
    g = Graph()
    field = light_field(g, model.encoding, g.input("rays", 5), g.input("film_z_mm", per_call=True))
    series = DirectionSeries.of(model, EXACT)
    values = core.build(g, field, units_of(model, series, EXACT))
    assert values.path_um is not None
    g.outputs = {
        "ray": scene_ray(model, values, series, EXACT), "power": values.transmittance,
        "stop": values.vectors[STOP], "path_um": values.path_um,
        "status": g.first_failure([(values.path_um, g.constant(_FAR_UM))], [1]).whole(),
    }  # fmt: skip
    if values.gates is not None:
        g.outputs["gates"] = values.gates
    return g


class _Known:
    """A model with its lens as it is set."""

    def __init__(self, model: LensModel, core: Phased, scene: Scene, wavelengths_nm: Sequence[float]) -> None:
        self.model, self.core, self.scene, self.waves = model, core, scene, wavelengths_nm
        self.front = np.array([0.0, 0.0, core.front_z_mm])
        if core not in _KNOWN:
            graph = _graph(model, core)
            _KNOWN[core] = graph, CompiledGraph.of(graph, {"film_z_mm": 0.0}) if has_compiler() else None
        self.graph, self.run = _KNOWN[core]

    def rays(self, point: Array, cosines: Array, z_mm: float, nm: Array | float) -> dict[str, Array]:
        """Return what the model says of rays through points [2, N] of a plane, by cosines [2, N] of light."""
        slope = cosines / _forwards(cosines)
        pupil = point + slope * (self.model.domain.pupil_z_mm - z_mm)
        rows = np.concatenate([*np.broadcast_arrays(point, pupil), np.broadcast_to(nm, (1, pupil.shape[1]))])
        if self.run is None:
            found = evaluate(self.graph, {"rays": rows, "film_z_mm": np.full((1, 1), z_mm)})
            return {name: np.broadcast_to(a, (len(a), pupil.shape[1])) for name, a in found.items()}
        self.run.numbers[:] = z_mm
        return {name: a.astype(np.float64) for name, a in self.run({"rays": rows.astype(np.float32)}).items()}

    def pupils(self, place: Array) -> list[list[ExitPupil | None]]:
        """Return the pupils of film places [2, P], by place and wavelength; None where no light arrives."""
        film_z, focal_z, stop_mm = self.scene.film_z_mm, self.core.focal_z_mm, self.scene.lens.stop_radius_mm
        chief, seen = self._chief(place)
        middle, half, lit = self._box(place)
        places, count, waves = place.shape[1], len(_SQUARE[0]), len(self.waves)

        def each(values: Array) -> Array:
            """Repeat values of places for their rays."""
            return np.repeat(values, count, 1)

        source = self._source(each(seen))
        cosines = each(middle) + each(half) * np.tile(_SQUARE, places)
        light = np.concatenate([cosines, _forwards(cosines)[None]])
        point, axis = each(place + chief * (focal_z - film_z)), each(seen[3:])
        out = self.rays(point, cosines, focal_z, self.waves[0])
        foot, leaves, _ = foot_of(self.core, out["ray"])
        way = axis if source is None else (source - foot) / np.linalg.norm(source - foot, axis=0)
        slope, back = light[:2] / light[2], self.model.domain.pupil_z_mm - focal_z
        # Far outside the stop a model may fold: rays from there come back into it.
        stop = out["stop"]  # of these rays, it is a rim, too: beyond it polynomials of the others may come back
        near = self._passes(out, point + slope * back, _NEAR * stop_mm, _NEAR**2 - 1)
        # Rays of the source, by cosines: where those that leave so much aside come from. Then those with s(P) = d, or
        # between both, where they come from far: rays outside its pupil are none that the model knows.
        even, many = self._point_of(way), (np.tile(cosines, waves), focal_z, np.repeat(self.waves, places * count))
        point = point + even - self._point_of(leaves)
        apart = (even - point) / self.model.domain.pupil_radius_mm
        even = point + (even - point) / np.maximum(1, np.hypot(*apart) / _ASTRAY)
        out, plane = self.rays(np.tile(point, waves), *many), self.rays(np.tile(even, waves), *many)
        ahead = np.concatenate([even - each(place), np.full((1, len(near)), focal_z - film_z)])
        shift = -(light * ahead).sum(0) + (0 if source is None else (source * way).sum(0))
        (foot, _, _), (beside, leaves, _) = (foot_of(self.core, some["ray"]) for some in (out, plane))
        aside, along = np.tile(way - direction_at(self.core, even), waves), np.tile(way, waves)
        longer = (beside * aside + (beside - foot) * (leaves - along) / 2).sum(0)
        wave = plane["path_um"] / 1000 + np.tile(shift, waves) - longer
        passed = self._passes(out, np.tile(point + slope * back, waves), _BEYOND * stop_mm, _BEYOND**2 - 1)
        # The wavelengths have rays in the same directions, so that one design fits them all.
        near &= (passed & np.isfinite(wave[0])).reshape(waves, -1).all(0)
        crossed, energy = self._across(foot, np.tile(axis, waves), None if source is None else np.tile(source, waves))
        gates = out.get("gates", np.zeros((0, foot.shape[1]))) + _RIM
        at = [*out["stop"], *np.tile(stop, waves), *np.stack([gates, 0 * gates], 1).reshape(-1, foot.shape[1])]
        rows = np.concatenate([wave, out["power"] * energy, crossed, at]).reshape(-1, waves, places, count)
        limits = np.array([stop_mm, _ASIDE * stop_mm, *[_RIM] * len(gates)])
        found = list[list[ExitPupil | None]]()
        for k, shows in enumerate(near.reshape(places, count)):
            aperture, box = self.scene.lens.aperture, (place[:, k], middle[:, k], half[:, k])
            made = fitted_waves(aperture, self.waves, box, _SQUARE, shows, rows[:, :, k], limits) if lit[k] else None
            found.append(made or [None] * waves)
        return found

    def _chief(self, place: Array) -> tuple[Array, Array]:
        """Return the slopes [2, P] of film places' rays through the middle of the stop, and their scene rays [6, P]."""
        radius = np.hypot(*place)
        along = np.where(radius > 0, place / np.where(radius > 0, radius, 1.0), np.array([[1.0], [0.0]]))
        back, every = self.model.domain.pupil_z_mm - self.scene.film_z_mm, np.arange(len(radius))
        high = np.full(len(radius), self.model.domain.pupil_radius_mm)
        low, ways = -high, np.repeat(along, _SEARCH, 1)
        for _ in range(_ROUNDS):
            tried = np.linspace(low, high, _SEARCH, axis=-1)
            slope = (tried - radius[:, None]) / back
            cosines = ways * (slope / np.sqrt(1 + slope * slope)).reshape(-1)
            out = self.rays(np.repeat(place, _SEARCH, 1), cosines, self.scene.film_z_mm, self.waves[0])
            best = np.abs((ways * out["stop"]).sum(0)).reshape(slope.shape).argmin(1)
            low, high = (tried[every, np.clip(best + k, 0, _SEARCH - 1)] for k in (-1, 1))
        return along * slope[every, best], out["ray"].reshape(6, *slope.shape)[:, every, best]

    def _source(self, seen: Array) -> Array | None:
        """Return the object points [3, P] on chief rays [6, P], from the front focal point; None for distant ones."""
        back = np.concatenate([seen[:3], -seen[3:]])  # light travels to the film
        found = self.scene.object_points(Rays(*torch.from_numpy(back)))
        return None if found is None else np.stack([c.numpy() for c in found]) - self.front[:, None]

    def _box(self, place: Array) -> tuple[Array, Array, NDArray[np.bool_]]:
        """Return middles and half sides [2, P] of boxes of cosines that hold the light, and which places have any."""
        domain, lens, film_z = self.model.domain, self.scene.lens, self.scene.film_z_mm
        low, high = (np.full(place.shape, sign * domain.pupil_radius_mm) for sign in (-1, 1))
        share = (np.stack(np.meshgrid(_LINE, _LINE)).reshape(2, 1, -1) + 1) / 2
        for _ in range(2):
            pupil = low[..., None] + (high - low)[..., None] * share
            slope = (pupil - place[..., None]) / (domain.pupil_z_mm - film_z)
            cosines = slope / np.sqrt(1 + (slope * slope).sum(0))
            rays = (np.repeat(place, share.shape[2], 1), cosines.reshape(2, -1), film_z, self.waves[0])
            lit = self._passes(self.rays(*rays), pupil.reshape(2, -1), lens.stop_radius_mm).reshape(pupil.shape[1:])
            seen, step = np.asarray(lit.any(1)), (high - low) / (_RAYS - 1)
            low, high = _ends(pupil, lit, seen)
            low, high = low - step, high + step
        # The edges lie between rays, half a step beyond the last that pass.
        first, last = _ends(cosines, lit, seen)
        return (first + last) / 2, _ROOM * (last - first) / 2 * (1 + 1 / (_RAYS - 3)), seen

    def _passes(self, out: dict[str, Array], pupil: Array, stop_mm: float, gate: float = 0.0) -> NDArray[np.bool_]:
        """Return which rays [N] pass: only rays through the domain's pupil can, for a model knows no others."""
        lit = (out["stop"] ** 2).sum(0) <= stop_mm**2
        lit &= (pupil * pupil).sum(0) <= (self.model.domain.pupil_radius_mm * DOMAIN_SLACK) ** 2
        return np.asarray(lit & (out.get("gates", np.zeros((1, 1))) <= gate).all(0))

    def _point_of(self, direction: Array) -> Array:
        """Return the points P [2, N] of the focal plane whose directions s(P) are these [3, N]."""
        sine = np.hypot(*direction[:2])
        angle, rise = np.arctan2(sine, -direction[2]), np.polynomial.Polynomial(self.core.direction)
        steep = rise.deriv()
        radius = angle / self.core.direction[0]
        for _ in range(_NEWTON):
            square = radius * radius
            risen = rise(square)
            radius -= (radius * risen - angle) / (risen + 2 * square * steep(square))
        return direction[:2] * (radius / np.where(sine > 0, sine, 1.0))

    def _across(self, foot: Array, axis: Array, source: Array | None) -> tuple[Array, Array | float]:
        """Return places [2, N] on the planes across chief rays, and the energy per area of them, as `bundles.Aim`.

        `foot` and `source` [3, N] are counted from the front focal point; `axis` [3, N] are the chief rays.
        """
        beside = np.where(np.abs(axis[1]) < 0.9, np.array([[0.0], [1.0], [0.0]]), np.array([[1.0], [0.0], [0.0]]))
        first = np.cross(axis, beside, axis=0)
        across = np.stack([first, np.cross(axis, first, axis=0)]) / np.linalg.norm(first, axis=0)
        if source is None:
            return (across * foot).sum(1), 1.0
        way = source - foot
        met = foot - way * ((axis * foot).sum(0) / (axis * way).sum(0))
        away = source - met
        return (across * met).sum(1), (axis * away).sum(0) / np.linalg.norm(away, axis=0) ** 3


def _ends(values: Array, lit: NDArray[np.bool_], seen: NDArray[np.bool_]) -> tuple[Array, Array]:
    """Return the least and largest values [2, P] of [2, P, N] that are lit [P, N]; 0 where none is seen."""
    ends = np.where(lit, values, np.inf).min(-1), np.where(lit, values, -np.inf).max(-1)
    return np.where(seen, ends[0], 0.0), np.where(seen, ends[1], 0.0)
