"""The inverse of a surrogate: which camera ray crosses the stop here, and which one leaves as this scene ray.

A direct fit of the inverse map gives the first guess; Newton's method with the model's own Jacobian, limited so that it
never diverges, makes it the model's own ray to rounding. Whether that ray passes is the model's own answer, so that
both directions agree. Hanika and Dachsbacher 2014 introduced the iteration on the stop for polynomial lenses.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, NamedTuple

import torch
from torch import Tensor

from neurolens.base import status as st
from neurolens.frontsurface import meet_front
from neurolens.optics.surfaces import Rays
from neurolens.surrogates.cores import DIRECTION, POSITION, STOP
from neurolens.surrogates.domain import FilmRays
from neurolens.surrogates.inversion.derivatives import direction_slopes, field_slopes, slopes_of
from neurolens.surrogates.inversion.guess import Guess
from neurolens.surrogates.inversion.newton import Solved, determinant, limited_newton
from neurolens.surrogates.lightfield import LightField, angle_vector
from neurolens.surrogates.model import LensModel, Prediction

STEPS = 3
# A solution counts where its residual is below this: of the stop's radius; of the front's radius and in radians.
TOLERANCE = 1e-4
# Longest Newton step: of the radius of the pupil (and of the film).
LIMIT = 0.35


class StopRays(NamedTuple):
    """Camera rays through given stop points, [N].

    Attributes:
        rays: with the pupil points found.
        prediction: of the model for those rays. Its status is that of `neurolens.base.status`, NO_SOLUTION among them.
        density: |d stop / d pupil|: area on the stop per area on the pupil plane, the film point held. A stop point
            drawn with density q per mm^2 is a pupil point drawn with density q times this.
        residual: distance between the point asked for and where the ray crosses the stop, in stop radii.
    """

    rays: FilmRays
    prediction: Prediction
    density: Tensor
    residual: Tensor


class FilmSide(NamedTuple):
    """Camera rays that leave as given scene rays, [N].

    Attributes:
        rays: film points and pupil points found.
        prediction: of the model for those rays, NO_SOLUTION among its status.
        density: |d (film, pupil) / d (position, direction)|: mm^2 on the film times mm^2 on the pupil plane, per mm^2
            of (x, y) on the front surface and steradian.
        residual: distance from the scene ray asked for: of the front's radius, and in radians (both squared, summed).
    """

    rays: FilmRays
    prediction: Prediction
    density: Tensor
    residual: Tensor


@dataclass(frozen=True)
class InverseModel:
    """Both inverse maps of one model; see `fit.fit_inverse`.

    Attributes:
        stop: from the film point (in film radii) and the stop point (in stop radii) to the pupil point, centred and
            scaled as the model's.
        scene: from position and direction vector, scaled as the model's, to p and u.
        report: JSON-able: how it was fitted.
    """

    model: LensModel
    stop: Guess
    scene: Guess
    report: dict[str, Any] = field(default_factory=dict)

    def through_stop(
        self,
        film_x: Tensor,
        film_y: Tensor,
        film_z: Tensor,
        stop_x: Tensor,
        stop_y: Tensor,
        wavelength_nm: Tensor,
        stop_radius_mm: float | None = None,
        steps: int = STEPS,
    ) -> StopRays:
        """The rays from film points through stop points; all [N], mm and nm, in the dtype of the inputs.

        Raises:
            InputError: as `LensModel.predict`.
        """
        system = StopSystem(self.model, film_x, film_y, film_z, stop_x, stop_y, wavelength_nm)
        start = self.stop.to(film_x.dtype)(system.guess_field, system.guess_z)[0]
        return system.result(limited_newton(system, start, steps, LIMIT), stop_radius_mm)

    def from_scene(
        self,
        scene: Rays,
        film_z: Tensor,
        wavelength_nm: Tensor,
        stop_radius_mm: float | None = None,
        steps: int = STEPS,
    ) -> FilmSide:
        """The camera rays of light that comes along scene rays; all [N], in the dtype of the inputs.

        Args:
            scene: a point of the ray (mm, lens frame) before or on the front surface, and the unit direction of the
                camera ray: away from the lens, against the light. Light from a scene point S through a point X of the
                front surface has direction (S - X) / |S - X|.
            film_z: the film planes, mm.

        Raises:
            InputError: as `LensModel.predict`.
        """
        system = SceneSystem(self.model, scene, film_z, wavelength_nm)
        guess = self.scene.to(film_z.dtype)(system.target, torch.zeros_like(film_z))
        return system.result(limited_newton(system, guess.flatten(0, 1), steps, LIMIT), stop_radius_mm)


class StopSystem:
    """Two equations a ray: where the ray through a pupil point crosses the stop, less the point asked for.

    Unknowns are the pupil point, centred on the chief ray through the film point and scaled as the model's u.
    """

    def __init__(
        self, model: LensModel, film_x: Tensor, film_y: Tensor, film_z: Tensor, x: Tensor, y: Tensor, w_nm: Tensor
    ) -> None:
        self.model, e = model, model.encoding
        self.film, self.film_z, self.w_nm = torch.stack([film_x, film_y]), film_z, w_nm
        self.wanted = torch.stack([x, y]) / model.scales.stop_mm
        kind = film_x.dtype
        self.chief, self.scale = (torch.tensor(v, dtype=kind)[:, None] for v in (e.chiefs, e.pupil_scales_mm))
        by = field_slopes(e, film_z, w_nm)
        self.by_p, self.by_u = by.p_pupil * self.scale, by.u_pupil * self.scale
        self._slopes = slopes_of(model.core, kind, [STOP])

    @property
    def guess_field(self) -> LightField:
        w = self.model.encoding(self.rays(torch.zeros_like(self.film))).w
        return LightField(self.film / self.model.encoding.film_scale_mm, self.wanted, w)

    @property
    def guess_z(self) -> Tensor:
        """The film plane from -1 (nearest) to 1, 0 where there is one only."""
        near, far = self.model.domain.film_z_mm
        return (2 * self.film_z - near - far) / (far - near) if far > near else torch.zeros_like(self.film_z)

    def rays(self, u: Tensor) -> FilmRays:
        pupil = self.chief * self.film + self.scale * u
        return FilmRays(self.film[0], self.film[1], self.film_z, pupil[0], pupil[1], self.w_nm)

    def __call__(self, u: Tensor) -> tuple[Tensor, Tensor]:
        vectors, slopes = self._slopes(self.model.encoding(self.rays(u)))
        return vectors[0] - self.wanted, slopes[0, :, :2] * self.by_p + slopes[0, :, 2:4] * self.by_u

    def on_axis(self) -> Tensor:
        """[2, 2, N] the Jacobian on the axis, that of the first-order map."""
        none = torch.zeros_like(self.film_z)
        axis = FilmRays(none, none, self.film_z, none, none, self.w_nm)
        _, slopes = self._slopes(self.model.encoding(axis))
        return slopes[0, :, :2] * self.by_p + slopes[0, :, 2:4] * self.by_u

    def result(self, solved: Solved, stop_radius_mm: float | None) -> StopRays:
        rays = self.rays(solved.x)
        density = determinant(solved.jacobian).abs() * self.model.scales.stop_mm**2 / self.scale.prod()
        found = _judged(self.model, rays, solved.residual, stop_radius_mm)
        return StopRays(rays, found, density, solved.residual)


class SceneSystem:
    """Four equations a ray: position and direction vector of the ray of p and u, less those asked for.

    Unknowns are u, then p: directions follow p most and positions u, and the solver wants that order.
    """

    def __init__(self, model: LensModel, scene: Rays, film_z: Tensor, w_nm: Tensor) -> None:
        self.model, self.film_z, self.w_nm = model, film_z, w_nm
        flat = model.direction == "slope"
        point = meet_front(None if flat else model.lens.surfaces[0], *(c.detach().double().numpy() for c in scene))
        x, y = (torch.from_numpy(c).to(film_z.dtype) for c in point)
        d = scene[3:]
        v = torch.stack([d[0], d[1]]) / -d[2] if flat else angle_vector(*d)
        none = torch.zeros_like(film_z)
        w = model.encoding(FilmRays(none, none, film_z, none, none, w_nm)).w
        self.target = LightField(torch.stack([x, y]) / model.scales.position_mm, v, w)
        self._slopes = slopes_of(model.core, film_z.dtype, [POSITION, DIRECTION])

    def __call__(self, unknown: Tensor) -> tuple[Tensor, Tensor]:
        vectors, slopes = self._slopes(LightField(unknown[2:], unknown[:2], self.target.w))
        residual = torch.cat([vectors[0] - self.target.p, vectors[1] - self.target.u])
        return residual, torch.cat([slopes[:, :, 2:4], slopes[:, :, :2]], 2).flatten(0, 1)

    def on_axis(self) -> Tensor:
        """[4, 4, N] the Jacobian on the axis, that of the first-order map."""
        return self(torch.zeros((4, *self.film_z.shape), dtype=self.film_z.dtype))[1]

    def rays(self, unknown: Tensor) -> FilmRays:
        """Free space from the two planes to the film."""
        e = self.model.encoding
        chief, scale = (torch.tensor(v, dtype=unknown.dtype)[:, None] for v in (e.chiefs, e.pupil_scales_mm))
        p = unknown[2:] * e.film_scale_mm
        pupil = chief * p + scale * unknown[:2]
        film = pupil + (p - pupil) / self._along
        return FilmRays(film[0], film[1], self.film_z, pupil[0], pupil[1], self.w_nm)

    @property
    def _along(self) -> Tensor:
        e = self.model.encoding
        return (e.film_plane_z_mm - e.pupil_plane_z_mm) / (self.film_z - e.pupil_plane_z_mm)

    def result(self, solved: Solved, stop_radius_mm: float | None) -> FilmSide:
        rays = self.rays(solved.x)
        found = _judged(self.model, rays, solved.residual, stop_radius_mm)
        return FilmSide(rays, found, self._density(solved), solved.residual)

    def _density(self, solved: Solved) -> Tensor:
        e = self.model.encoding
        # From (p, u), scaled, to film and pupil points in mm: F = U + (P - U) / along, U = k P + S u.
        films = e.film_scale_mm**2 * torch.tensor(e.pupil_scales_mm, dtype=self.film_z.dtype).prod() / self._along**2
        # Area on the unit sphere per area of direction vectors: |d d / d v_x  x  d d / d v_y|.
        v = self.target.u
        identity = torch.eye(2, dtype=v.dtype)[:, :, None].expand(2, 2, v.shape[1])
        d = direction_slopes(v, identity, self.model.direction == "angle")
        sphere = torch.linalg.cross(d[:, 0].T, d[:, 1].T).norm(dim=1)
        return films / (determinant(solved.jacobian).abs() * self.model.scales.position_mm**2 * sphere)


def _judged(model: LensModel, rays: FilmRays, residual: Tensor, stop_radius_mm: float | None) -> Prediction:
    """The model's own answer for the rays found, and NO_SOLUTION where they are not what was asked for."""
    found = model.predict(rays, stop_radius_mm)
    status = torch.where(residual < TOLERANCE, found.status, st.NO_SOLUTION)
    return found._replace(status=status.to(torch.int32))
