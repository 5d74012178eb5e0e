"""The light field: the coordinates of a ray that surrogates see, on two planes fixed to the glass, centred and scaled.

A camera ray is its crossing p with a plane near the film and u with the pupil plane. Free space is linear, so another
film position only moves where the ray starts. For a rotationally symmetric lens every output vector is

    out = A(rho, sigma, tau, w) p + B(rho, sigma, tau, w) u,   rho = p.p,  sigma = p.u,  tau = u.u,

which holds the symmetry and the mirror symmetry exactly and has no singular point on the axis. A lens with cylinders
keeps its two planes of symmetry only: then x (and y likewise) of every vector is

    out_x = A_x(q) p_x + B_x(q) u_x,   q = p_x^2, p_x u_x, u_x^2, p_y^2, p_y u_y, u_y^2, w.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import reduce
from operator import add
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from neurolens.graph.ir import Form
from neurolens.lens.glass import inverse_square_um

if TYPE_CHECKING:
    from torch import Tensor

    from neurolens.surrogates.domain import FilmRays

# Invariants as pairs of the rows p_x, p_y, u_x, u_y: rho, sigma, tau; of two mirrors those of x, then those of y.
ROUND: tuple[Form, ...] = (((0, 0), (1, 1)), ((0, 2), (1, 3)), ((2, 2), (3, 3)))
MIRROR: tuple[Form, ...] = tuple(((a, b),) for i in (0, 1) for a, b in ((i, i), (i, 2 + i), (2 + i, 2 + i)))


class LightField(NamedTuple):
    """Scaled coordinates of N rays: p and u [2, N] within about the unit disc, w [N] in [-1, 1]."""

    p: Tensor
    u: Tensor
    w: Tensor

    def __len__(self) -> int:
        """Rays."""
        return self.w.shape[0]

    def invariants(self, mirror: bool = False) -> Tensor:
        """[4, N]: rho, sigma, tau, w; of two mirrors [7, N]: p_x^2, p_x u_x, u_x^2, the same of y, w."""
        import torch

        rows = (*self.p, *self.u)
        sums = (reduce(add, (rows[i] * rows[j] for i, j in form)) for form in (MIRROR if mirror else ROUND))
        return torch.stack([*sums, self.w])


def angle_vector(dx: Tensor, dy: Tensor, dz: Tensor) -> Tensor:
    """[2, N] v = theta (dx, dy) / |(dx, dy)| with theta from -z: smooth through 90 degrees, equivariant."""
    import torch

    sine = torch.hypot(dx, dy)
    theta = torch.atan2(sine, -dz)
    # theta / sine tends to 1 on the axis; the guard also keeps the exact axis finite.
    ratio = torch.where(sine > 1e-12, theta / torch.where(sine > 1e-12, sine, 1.0), 1.0)
    return torch.stack([ratio * dx, ratio * dy])


@dataclass(frozen=True)
class Encoding:
    """From raw millimetres and nanometres to the light field.

    Attributes:
        film_plane_z_mm, pupil_plane_z_mm: the two planes (lens frame).
        chief: k of the chief ray's u = k p, subtracted so that u is centred on the passing rays.
        film_scale_mm, pupil_scale_mm: largest |p| and |u - k p| of the domain's passing rays.
        w_middle, w_half: w = (1 / lambda^2 - middle) / half in 1/um^2; the index is linear in 1 / lambda^2 (Cauchy).
            half is 0 for a lens without known dispersion, and then w = 0.
        chief_y, pupil_scale_y_mm: of y where the lens has cylinders, and then the two above are of x; None: of both.
    """

    film_plane_z_mm: float
    pupil_plane_z_mm: float
    chief: float
    film_scale_mm: float
    pupil_scale_mm: float
    w_middle: float
    w_half: float
    chief_y: float | None = None
    pupil_scale_y_mm: float | None = None

    @property
    def mirror(self) -> bool:
        """Whether the lens has two planes of symmetry instead of an axis."""
        return self.chief_y is not None

    @property
    def dispersive(self) -> bool:
        """Whether rays depend on the wavelength."""
        return self.w_half != 0

    @property
    def chiefs(self) -> tuple[float, float]:
        """k of x and of y."""
        return self.chief, self.chief if self.chief_y is None else self.chief_y

    @property
    def pupil_scales_mm(self) -> tuple[float, float]:
        """The pupil scales of x and of y, in mm."""
        return self.pupil_scale_mm, self.pupil_scale_mm if self.pupil_scale_y_mm is None else self.pupil_scale_y_mm

    def planes(self, rays: FilmRays) -> tuple[Tensor, Tensor]:
        """Crossings with the two planes in mm, [2, N] each."""
        import torch

        u = torch.stack([rays.pupil_x, rays.pupil_y])
        film = torch.stack([rays.film_x, rays.film_y])
        along = (self.film_plane_z_mm - self.pupil_plane_z_mm) / (rays.film_z - self.pupil_plane_z_mm)
        return u + (film - u) * along, u

    def __call__(self, rays: FilmRays) -> LightField:
        import torch

        p, u = self.planes(rays)
        u = torch.stack([(u[i] - self.chiefs[i] * p[i]) / self.pupil_scales_mm[i] for i in (0, 1)])
        w = torch.zeros_like(rays.wavelength_nm)
        if self.dispersive:
            w = (inverse_square_um(rays.wavelength_nm) - self.w_middle) / self.w_half
        return LightField(p / self.film_scale_mm, u, w)

    @staticmethod
    def mixed(encodings: Sequence[Encoding], weights: NDArray[np.float64]) -> Encoding:
        """The encoding of a state: planes are mixed as they are, scales by their reciprocals, as the graph has them."""

        def mean(value: Callable[[Encoding], float]) -> float:
            return float(weights @ np.array([value(e) for e in encodings]))

        pupil_scale = 1 / mean(lambda e: 1 / e.pupil_scale_mm)
        return replace(
            encodings[0],
            film_plane_z_mm=mean(lambda e: e.film_plane_z_mm),
            pupil_plane_z_mm=mean(lambda e: e.pupil_plane_z_mm),
            chief=pupil_scale * mean(lambda e: e.chief / e.pupil_scale_mm),
            film_scale_mm=1 / mean(lambda e: 1 / e.film_scale_mm),
            pupil_scale_mm=pupil_scale,
        )
