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

import math
from collections.abc import Sequence
from functools import lru_cache
from weakref import WeakKeyDictionary

import numpy as np
import torch
from numpy.polynomial.polynomial import polyval
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

_RAYS = 24  # along a side of the box about what passes
_ABOUT = 2.0  # half sides of its first guess, in radii of the stop as the whole pupil has them
_GRID = np.stack(np.meshgrid(*[np.linspace(0, 1, _RAYS)] * 2)).reshape(2, 1, -1)
# A pupil fills an ellipse in its box. Its rays lie on two spirals there, which turn by half the golden angle from ray
# to ray, so that equal areas hold equally many. How far the ellipse leans is rounded to a few steps: pupils that lean
# alike share the matrix of their fit, which is kept.
_ELLIPSE, _LEANS, _FEW, _MANY = 0.96, 32, 256, 800
_ENOUGH = 240  # of the few rays: where rims shut out more, many are taken
_ROOM = 1.1  # the ellipse over what passes
_AT_ONCE = 16  # places whose rays are evaluated in one go
_FAR_UM = 1e30
# Graphs of models, and the same compiled where the machine has a compiler.
_KNOWN: WeakKeyDictionary[Phased, tuple[Graph, CompiledGraph | None]] = WeakKeyDictionary()
# Rays up to so many radii of stop and rims count: before they are led to the source (the second: may pass), and after.
_NEAR, _BEYOND = 1.2, 1.1
_RIM = 2.0  # a gate is (height / rim radius)^2 - 1; with this added it stands for a height and a rim of this radius
_ASTRAY = 0.05  # pupil radii from a ray on the focal plane to the other whose path is taken for its own
_NEWTON = 6  # steps from a direction to its point on the focal plane
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
        places_mm: [P, 2] x and y on the film; those beyond the model's film are dark, and those that have no image.

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


@lru_cache(maxsize=64)
def _spirals(count: int, correlation: float = 0.0) -> Array:
    """Return points [2, N] of an ellipse that touches the sides of its box, by the correlation of x and y."""
    turn = math.pi * (3 - math.sqrt(5)) / 2 * (np.arange(count // 2) + 0.5)
    half = _ELLIPSE * np.sqrt(turn / turn[-1]) * np.stack([np.cos(turn), np.sin(turn)])
    high, low = math.sqrt(1 + correlation) / 2, math.sqrt(1 - correlation) / 2
    return np.array([[high + low, high - low], [high - low, high + low]]) @ np.concatenate([half, -half], 1)


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
        if core not in _KNOWN:
            graph = _graph(model, core)
            _KNOWN[core] = graph, CompiledGraph.of(graph, {"film_z_mm": 0.0}) if has_compiler() else None
        self.graph, self.run = _KNOWN[core]

    def rays(self, point: Array, slope: Array, z_mm: float, nm: Array | float) -> dict[str, Array]:
        """Return what the model says of rays through points [2, N] of a plane, which rise by slopes [2, N]."""
        pupil = point + slope * (self.model.domain.pupil_z_mm - z_mm)
        some = [*np.broadcast_arrays(point, pupil), np.broadcast_to(nm, (1, pupil.shape[1]))]
        if self.run is None:
            found = evaluate(self.graph, {"rays": np.concatenate(some), "film_z_mm": np.full((1, 1), z_mm)})
            return {name: np.broadcast_to(a, (len(a), pupil.shape[1])) for name, a in found.items()}
        self.run.numbers[:], rows = z_mm, np.concatenate(some, dtype=np.float32)
        return {name: a.astype(np.float64) for name, a in self.run({"rays": rows}).items()}

    def pupils(self, place: Array, count: int = _FEW) -> list[list[ExitPupil | None]]:
        """Return the pupils of film places [2, P], by place and wavelength, from so many rays; None without light."""
        film_z, focal_z, stop_mm = self.scene.film_z_mm, self.core.focal_z_mm, self.scene.lens.stop_radius_mm
        chief, seen = self._chief(place)
        middle, half, lean, lit = self._box(place, chief)
        places, waves, points = place.shape[1], len(self.waves), [_spirals(count, c) for c in lean.tolist()]

        def each(values: Array) -> Array:
            return np.repeat(values, count, 1)  # of places, for their rays

        source = self._source(seen)
        cosines = each(middle) + each(half) * np.concatenate(points, 1)
        light = np.concatenate([cosines, _forwards(cosines)[None]])
        slope, back = light[:2] / light[2], self.model.domain.pupil_z_mm - focal_z
        point, axis = each(place + chief * (focal_z - film_z)), each(seen[3:])
        first = self.rays(point, slope, focal_z, self.waves[0])
        foot, leaves, _ = foot_of(self.core, first["ray"])
        source = None if source is None else each(source)
        way = axis if source is None else (source - foot) / np.linalg.norm(source - foot, axis=0)
        # `led` are the points where rays of the source cross the focal plane: rays that leave so much aside come from
        # so much beside. `even` are the points with s(P) = d, whose path counts. Where they lie far away, a point on
        # the way is taken, for the model knows no rays outside its pupil.
        met, left = np.split(self._point_of(np.concatenate([way, leaves], 1)), 2, 1)
        led, many = point + met - left, (np.tile(slope, waves), focal_z, np.repeat(self.waves, places * count))
        apart = (met - led) / self.model.domain.pupil_radius_mm
        even = led + (met - led) / np.maximum(1, np.hypot(*apart) / _ASTRAY)
        out, plane = self.rays(np.tile(led, waves), *many), self.rays(np.tile(even, waves), *many)
        ahead = np.concatenate([even - each(place), np.full((1, even.shape[1]), focal_z - film_z)])
        shift = -(light * ahead).sum(0) + (0 if source is None else (source * way).sum(0))
        (foot, _, _), (beside, leaves, _) = (foot_of(self.core, some["ray"]) for some in (out, plane))
        aside, along = np.tile(way - direction_at(self.core, even), waves), np.tile(way, waves)
        longer = (beside * aside + (beside - foot) * (leaves - along) / 2).sum(0)
        wave = plane["path_um"] / 1000 + np.tile(shift, waves) - longer
        # Far outside its widest stop a model may fold: rays from there come back into it. All wavelengths have rays in
        # the same directions, so that one design fits them all.
        wide = max(stop_mm, self.model.domain.stop_radius_mm / _BEYOND)
        passed = self._passes(out, np.tile(led + slope * back, waves), _BEYOND * wide, _BEYOND**2 - 1)
        near = self._passes(first, point + slope * back, _NEAR * wide, _NEAR**2 - 1)
        near &= (passed & np.isfinite(wave[0])).reshape(waves, -1).all(0)
        crossed, energy = self._across(foot, seen[3:], source)
        gates = np.stack([g := out.get("gates", np.zeros((0, foot.shape[1]))) + _RIM, 0 * g], 1)
        # The ellipse is a rim, too: beyond it polynomials may come back into the stop.
        rows = np.concatenate(
            [
                wave,
                out["power"] * energy,
                crossed,
                out["stop"],
                np.tile(_spirals(count), places * waves),
                gates.reshape(-1, foot.shape[1]),
            ]
        )
        limits = np.array([stop_mm, 0.99 * _ELLIPSE, *[_RIM] * len(gates)])
        found = list[list[ExitPupil | None]]()
        for k, shows in enumerate(near.reshape(places, count)):
            if lit[k] and shows.sum() < _ENOUGH and count == _FEW:
                found += self.pupils(place[:, k : k + 1], _MANY)
                continue
            made = lit[k] and fitted_waves(
                self.scene.lens.aperture, self.waves, (place[:, k], middle[:, k], half[:, k]), points[k], shows,
                rows.reshape(-1, waves, places, count)[:, :, k], limits,
            )  # fmt: skip
            # Where by the path a point's light covers more than the film, there is no image, and the path errs by far.
            known = made and all(p.blur_mm <= self.model.domain.film_radius_mm for p in made if p)
            found.append(made if made and known else [None] * waves)
        return found

    def _chief(self, place: Array) -> tuple[Array, Array]:
        """Return the slopes [2, P] of film places' rays through the middle of the stop, and their scene rays [6, P]."""
        radius = np.hypot(*place)
        along = np.where(radius > 0, place / np.where(radius > 0, radius, 1.0), np.array([[1.0], [0.0]]))
        ways, back = np.repeat(along, _SEARCH, 1), self.model.domain.pupil_z_mm - self.scene.film_z_mm
        every, ends = np.arange(len(radius)), np.outer([-1, 1], np.full(len(radius), self.model.domain.pupil_radius_mm))
        for _ in range(_ROUNDS):
            tried = np.linspace(ends[0], ends[1], _SEARCH, axis=-1)
            slope = (tried - radius[:, None]) / back
            steep = ways * slope.reshape(-1)
            out = self.rays(np.repeat(place, _SEARCH, 1), steep, self.scene.film_z_mm, self.waves[0])
            # Far outside the lens a model may fold, and say that rays meet the middle of the stop there.
            folded = (out.get("gates", np.zeros((1, 1))) > _NEAR**2 - 1).any(0) * self.model.domain.stop_radius_mm
            best = (np.abs((ways * out["stop"]).sum(0)) + folded).reshape(slope.shape).argmin(1)
            ends = tried[every, np.clip(best + [[-1], [1]], 0, _SEARCH - 1)]
        return along * slope[every, best], out["ray"].reshape(6, *slope.shape)[:, every, best]

    def _source(self, seen: Array) -> Array | None:
        """Return the object points [3, P] on chief rays [6, P], from the front focal point; None for distant ones."""
        back = np.concatenate([seen[:3], -seen[3:]])  # light travels to the film
        found = self.scene.object_points(Rays(*torch.from_numpy(back)))
        if found is None:
            return None
        return np.stack([c.numpy() for c in found]) - np.array([[0], [0], [self.core.front_z_mm]])

    def _box(self, place: Array, chief: Array) -> tuple[Array, Array, Array, NDArray[np.bool_]]:
        """Return boxes of cosines about the ellipses that hold the light, and which places have any.

        They are middles and half sides [2, P], and the correlation of x and y in the ellipses [P].
        """
        domain, lens, film_z = self.model.domain, self.scene.lens, self.scene.film_z_mm
        # A closed stop would lie between rays over the whole pupil of the domain.
        reach = _ABOUT * domain.pupil_radius_mm * lens.stop_radius_mm / domain.stop_radius_mm
        middle = place + chief * (domain.pupil_z_mm - film_z)
        low, high = (np.clip(middle + r, -domain.pupil_radius_mm, domain.pupil_radius_mm) for r in (-reach, reach))
        # Wavelengths take turns from ray to ray: through a closed stop their light leaves in different boxes.
        turns = np.add.outer(np.arange(_RAYS), np.arange(_RAYS)).reshape(-1) % len(self.waves)
        nm = np.tile(np.array(self.waves)[turns], place.shape[1])
        for _ in range(2):
            pupil = low[..., None] + (high - low)[..., None] * _GRID
            slope = (pupil - place[..., None]) / (domain.pupil_z_mm - film_z)
            rays = (np.repeat(place, _RAYS**2, 1), slope.reshape(2, -1), film_z, nm)
            lit = self._passes(self.rays(*rays), pupil.reshape(2, -1), lens.stop_radius_mm).reshape(pupil.shape[1:])
            step, count = (high - low) / (_RAYS - 1), np.maximum(lit.sum(1), 1)
            ends = np.where(lit, pupil, np.inf).min(-1) - step, np.where(lit, pupil, -np.inf).max(-1) + step
            low, high = (np.where(lit.any(1), end, 0.0) for end in ends)
        cosines = slope / np.sqrt(1 + (slope * slope).sum(0))
        middle = np.where(lit, cosines, 0.0).sum(-1) / count
        apart = np.where(lit, cosines - middle[..., None], 0.0)
        half = 2 * np.sqrt((apart * apart).sum(-1) / count).clip(1e-9)  # an ellipse has four times its variance
        x, y = apart / half[..., None]
        lean = np.rint((4 * (x * y).sum(-1) / count).clip(-0.9, 0.9) * _LEANS) / _LEANS
        reach = np.sqrt((x * x + y * y - 2 * lean[:, None] * x * y).max(1) / (1 - lean * lean))
        return middle, _ROOM * half * reach, lean, np.asarray(lit.any(1))

    def _passes(self, out: dict[str, Array], pupil: Array, stop_mm: float, gate: float = 0.0) -> NDArray[np.bool_]:
        """Return which rays [N] pass: only rays through the domain's pupil can, for a model knows no others."""
        return np.asarray(
            ((pupil * pupil).sum(0) <= (self.model.domain.pupil_radius_mm * DOMAIN_SLACK) ** 2)
            & ((out["stop"] ** 2).sum(0) <= stop_mm**2)
            & (out.get("gates", np.zeros((1, 1))) <= gate).all(0)
        )

    def _point_of(self, direction: Array) -> Array:
        """Return the points P [2, N] of the focal plane whose directions s(P) are these [3, N]."""
        sine, slopes = np.hypot(*direction[:2]), np.array(self.core.direction)
        angle, steep = np.arctan2(sine, -direction[2]), slopes * np.arange(1, 2 * len(slopes), 2)
        radius = angle / slopes[0]
        for _ in range(_NEWTON):
            square = radius * radius
            radius -= (radius * polyval(square, slopes) - angle) / polyval(square, steep)
        return direction[:2] * (radius / np.where(sine > 0, sine, 1.0))

    def _across(self, foot: Array, axis: Array, source: Array | None) -> tuple[Array, Array]:
        """Return places [2, N] on the planes across chief rays, and the energy per area of them, as `bundles.Aim`.

        `foot` [3, N], by wavelength, place and ray, and `source` [3, N / W] are counted from the front focal point;
        `axis` [3, P] are the chief rays.
        """
        beside = np.where(np.abs(axis[1]) < 0.9, np.array([[0.0], [1.0], [0.0]]), np.array([[1.0], [0.0], [0.0]]))
        first = np.cross(axis, beside, axis=0)
        across = np.stack([first, np.cross(axis, first, axis=0)]) / np.linalg.norm(first, axis=0)
        foot, energy = foot.reshape(3, len(self.waves), len(axis[0]), -1), np.array(1.0)
        if source is not None:
            source, axis = source.reshape(3, 1, len(axis[0]), -1), axis[:, None, :, None]
            way = source - foot
            foot = foot - way * ((axis * foot).sum(0) / (axis * way).sum(0))
            away = source - foot
            energy = ((axis * away).sum(0) / np.linalg.norm(away, axis=0) ** 3).reshape(-1)
        return np.einsum("cip,iwpn->cwpn", across, foot).reshape(2, -1), energy
