"""First-order surrogates: the thin and the thick lens that renderers use today, in the same form as the others.

Their rays follow the ideal (collinear) map of the prescription's focal length and principal planes; stop and rims are
fitted as quadratic forms, which is what first-order rim crossings are.
"""

from __future__ import annotations

from typing import Literal

import numpy as np
import torch
from torch import Tensor

from neurolens.optics.paraxial import first_order
from neurolens.optics.prescription import Lens
from neurolens.surrogates.cores import DIRECTION, POSITION, InvariantPolynomial
from neurolens.surrogates.fits.boundaries import FitData, fit_scalars, fit_stop
from neurolens.surrogates.lightfield import Encoding
from neurolens.surrogates.model import Gate
from neurolens.surrogates.pairs import RayPairs
from neurolens.surrogates.targets import scales_of

ParaxialMethod = Literal["thin", "thick"]


def ideal_map(lens: Lens, encoding: Encoding, method: ParaxialMethod) -> Tensor:
    """[2, 2]: position (scaled) and slope (dx / -dz) of the scene-side ray per unit of scaled p and u.

    The position is that in the plane of the front vertex. "thin" puts both principal planes at the rear one.
    """
    data = first_order(lens)
    rear = data.rear_principal_z_mm
    front = data.front_principal_z_mm if method == "thick" else rear
    rows = []
    for p, u in ((1.0, 0.0), (0.0, 1.0)):
        on_film = p * encoding.film_scale_mm
        on_pupil = u * encoding.pupil_scale_mm + encoding.chief * on_film
        rise = (on_pupil - on_film) / (encoding.pupil_plane_z_mm - encoding.film_plane_z_mm)  # dx / dz, film side
        height = on_film + rise * (rear - encoding.film_plane_z_mm)
        rise = rise + height / data.efl_mm  # light loses h / f on its way to the film; camera rays regain it
        rows.append([(height - rise * front) / scales_of(lens).position_mm, -rise])
    return torch.tensor(rows, dtype=torch.float64).T


def fit_paraxial(
    pairs: RayPairs, encoding: Encoding, gates: tuple[Gate, ...], method: ParaxialMethod
) -> InvariantPolynomial:
    """A model whose rays are first order; its direction vector is a slope (see `LensModel.direction`)."""
    exponents = np.array([[0, 0, 0, 0], [1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0]], dtype=np.int64)
    data = FitData(pairs, encoding, gates)
    ab = torch.zeros((3, 2, len(exponents)), dtype=torch.float64)
    ab[[POSITION, DIRECTION], :, 0] = ideal_map(pairs.lens, encoding, method)
    ab[2, :, 0] = fit_stop(data, exponents[:1])
    scalars = fit_scalars(data, exponents)
    return InvariantPolynomial(exponents, ab.numpy(), scalars.numpy())
