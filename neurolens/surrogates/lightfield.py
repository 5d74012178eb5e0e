"""The light field in the coordinates that surrogates see: two planes fixed to the glass, centred and scaled.

A camera ray is its crossing p with a plane near the film and u with the pupil plane. Free space is linear, so another
film position only moves where the ray starts. For a rotationally symmetric lens every output vector is

    out = A(rho, sigma, tau, w) p + B(rho, sigma, tau, w) u,   rho = p.p,  sigma = p.u,  tau = u.u,

which holds the symmetry and the mirror symmetry exactly and has no singular point on the axis. A lens with cylinders
keeps its two planes of symmetry only: then x (and y likewise) of every vector is

    out_x = A_x(q) p_x + B_x(q) u_x,   q = p_x^2, p_x u_x, u_x^2, p_y^2, p_y u_y, u_y^2, w.
"""

from __future__ import annotations

from functools import reduce
from operator import add
from typing import NamedTuple

import torch
from torch import Tensor

from neurolens.optics.glass import inverse_square_um
from neurolens.surrogates.cores import MIRROR, ROUND
from neurolens.surrogates.model import Domain, Encoding
from neurolens.surrogates.pairs import PairSet


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
        rows = (*self.p, *self.u)
        sums = (reduce(add, (rows[i] * rows[j] for i, j in form)) for form in (MIRROR if mirror else ROUND))
        return torch.stack([*sums, self.w])


def fit_encoding(domain: Domain, passing: PairSet, *, mirror: bool = False) -> Encoding:
    """Centre and scale by the passing rays of a domain; `mirror`: x and y by themselves, for lenses with cylinders."""
    plain = Encoding(domain.film_z_mm[0], domain.pupil_z_mm, 0.0, 1.0, 1.0, 0.0, 0.0)
    p, u = plain.planes(passing.inputs)
    axes = [slice(0, 1), slice(1, 2)] if mirror else [slice(0, 2)]
    chiefs = [float((p[a] * u[a]).sum() / (p[a] * p[a]).sum()) for a in axes]
    scales = [float((u[a] - k * p[a]).norm(dim=0).max()) for a, k in zip(axes, chiefs, strict=True)]
    shortest, longest = (float(inverse_square_um(v)) for v in domain.wavelength_nm)
    return Encoding(
        film_plane_z_mm=plain.film_plane_z_mm,
        pupil_plane_z_mm=plain.pupil_plane_z_mm,
        chief=chiefs[0],
        film_scale_mm=float(p.norm(dim=0).max()),
        pupil_scale_mm=scales[0],
        w_middle=(shortest + longest) / 2,
        w_half=(shortest - longest) / 2,
        chief_y=chiefs[1] if mirror else None,
        pupil_scale_y_mm=scales[1] if mirror else None,
    )


def angle_vector(dx: Tensor, dy: Tensor, dz: Tensor) -> Tensor:
    """[2, N] v = theta (dx, dy) / |(dx, dy)| with theta from -z: smooth through 90 degrees, equivariant."""
    sine = torch.hypot(dx, dy)
    theta = torch.atan2(sine, -dz)
    # theta / sine tends to 1 on the axis; the guard also keeps the exact axis finite.
    ratio = torch.where(sine > 1e-12, theta / torch.where(sine > 1e-12, sine, 1.0), 1.0)
    return torch.stack([ratio * dx, ratio * dy])
