"""Ray differentials of the exact lens: how the ray in the scene changes with the film point, exactly.

Derivatives are carried along through every surface (forward-mode differentiation of the tracer itself; Igehy 1999,
"Tracing Ray Differentials", gives the same quantities by hand). No neighbouring rays are traced, so that there is no
step to choose and no neighbour that a rim may stop.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor
from torch.autograd import forward_ad

from neurolens.base.errors import InputError
from neurolens.optics import glass
from neurolens.optics.prescription import Lens
from neurolens.optics.surfaces import Rays
from neurolens.optics.trace import Towards, Traced, trace


class Differentials(NamedTuple):
    """A traced ray and its derivatives.

    Attributes:
        traced: as `trace` gives it.
        derivatives: for every tangent, the derivatives of the resulting ray: x, y, z (mm per unit of the tangent) and
            direction, each [N]; 0 for rays that do not go on. Points move on the last surface.
    """

    traced: Traced
    derivatives: tuple[Rays, ...]


def trace_differentials(
    lens: Lens,
    rays: Rays,
    tangents: Sequence[Rays],
    wavelength_nm: Tensor | float = glass.LINE_D_NM,
    *,
    towards: Towards = "scene",
) -> Differentials:
    """Trace rays together with their derivatives.

    Args:
        lens, rays, wavelength_nm, towards: as for `trace`.
        tangents: derivatives of the rays with respect to some parameters, one `Rays` each (components [N]), such as
            those of `film_tangents`.

    Raises:
        InputError: as `trace`, and a tangent whose components have not the shape and dtype of the rays.
    """
    for n, tangent in enumerate(tangents):
        for name, c, r in zip(Rays._fields, tangent, rays, strict=True):
            if c.shape != r.shape or c.dtype != r.dtype:
                found = f"({tuple(c.shape)}, {c.dtype})"
                raise InputError("trace", f"tangents[{n}].{name}", found, f"like the rays: {tuple(r.shape)}, {r.dtype}")
    traced, derivatives = None, []
    for tangent in tangents:
        with forward_ad.dual_level():
            dual = Rays(
                *(forward_ad.make_dual(r.contiguous(), t.contiguous()) for r, t in zip(rays, tangent, strict=True))
            )
            out = trace(lens, dual, wavelength_nm, towards=towards)
            parts = [forward_ad.unpack_dual(c) for c in out.rays]
            slopes = (torch.zeros_like(p.primal) if p.tangent is None else p.tangent for p in parts)
            # A lost ray was replaced by one along the axis, whose derivative is 0 already; others may carry NaN.
            derivatives.append(Rays(*(torch.nan_to_num(s, 0.0, 0.0, 0.0) for s in slopes)))
            traced = out._replace(rays=Rays(*(p.primal for p in parts)))
    return Differentials(
        trace(lens, rays, wavelength_nm, towards=towards) if traced is None else traced, tuple(derivatives)
    )


def film_tangents(rays: Rays, distance_mm: Tensor | float) -> tuple[Rays, Rays]:
    """Derivatives of camera rays with respect to the film point's x and y (mm), the pupil point held.

    Args:
        rays: from the film point towards the pupil point, unit directions, each [N].
        distance_mm: from film point to pupil point along the ray, positive, number or [N].

    With d = (P - F) / |P - F|, dd/dF_x = (d d_x - e_x) / |P - F|.
    """
    zero, one = torch.zeros_like(rays.x), torch.ones_like(rays.x)
    found = []
    for axis, along in enumerate((rays.dx, rays.dy)):
        e = [0.0, 0.0, 0.0]
        e[axis] = 1.0
        dx, dy, dz = ((c * along - k) / distance_mm for c, k in zip(rays[3:], e, strict=True))
        found.append(Rays(one * e[0], one * e[1], zero, dx, dy, dz))
    return found[0], found[1]
