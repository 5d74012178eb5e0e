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
from typing import TYPE_CHECKING, NamedTuple

from neurolens.graph.ir import Form

if TYPE_CHECKING:
    from torch import Tensor

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
