"""Longitudinal and lateral colour: focus against wavelength, image height against wavelength and field."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from neurolens.analysis.bundles import bundle
from neurolens.analysis.fields import DEFAULT_NM, Scene
from neurolens.analysis.patterns import points
from neurolens.analysis.results import Array, Result
from neurolens.base.errors import InputError
from neurolens.optics.paraxial import is_pinhole

LINE_G_NM = 435.8343  # mercury, the usual fourth line

# Share of the stop's radius that stands for the paraxial ray: its error grows with the square.
PARAXIAL = 1e-3
_ZONES = (PARAXIAL, 0.5**0.5, 1 - 1e-7)
_VISIBLE_NM = (380.0, 780.0)


@dataclass(frozen=True)
class Colour(Result):
    """Colour of a lens; the film's place counts as zero focus, shifts positive away from the lens.

    Attributes:
        spectrum_nm: [L], 380 to 780.
        zone: [3] shares of the stop's radius: paraxial, half of the area, edge.
        focus_shift_mm: [L, 3] where rays of each zone cross the axis; NaN where a rim blocks them.
        field_deg, height_mm: [F], of the chief ray of the first line.
        line_nm: [W]; the first is the reference.
        lateral_um: [F, W] image height less that of the reference.
    """

    spectrum_nm: Array
    zone: Array
    focus_shift_mm: Array
    field_deg: Array
    height_mm: Array
    line_nm: Array
    lateral_um: Array

    @property
    def focus_spread_mm(self) -> float:
        """Greatest less least paraxial focus over the spectrum, mm."""
        return float(np.ptp(self.focus_shift_mm[:, 0]))


def colour(
    scene: Scene,
    *,
    spectrum_nm: Sequence[float] | None = None,
    line_nm: Sequence[float] = (*DEFAULT_NM, LINE_G_NM),
    fields: int = 21,
) -> Colour:
    """Longitudinal colour on the axis by zones, and lateral colour of chief rays up to the edge of the field.

    Raises:
        InputError: a pinhole, which has no focus.
    """
    if is_pinhole(scene.lens):
        raise InputError(scene.lens.path, "surfaces", "(a pinhole)", "a lens with power")
    spectrum = np.linspace(*_VISIBLE_NM, 41) if spectrum_nm is None else np.asarray(spectrum_nm, dtype=np.float64)
    axial = bundle(scene.round, [0.0], spectrum.tolist(), points(list(_ZONES), [0.0] * 3))
    crossing = -(axial.tangential_mm / axial.slopes[0])[0].numpy()
    angles = np.linspace(0, scene.edge_deg(), fields)
    chief = bundle(scene.open, angles.tolist(), line_nm, points([0.0], [0.0]))
    # Tangential points grow with image height where the field's angle is positive.
    lateral = 1000 * chief.tangential_mm[..., 0].numpy()
    return Colour(
        spectrum, np.array(_ZONES), crossing, angles, chief.chief_height_mm.numpy(), np.array(line_nm), lateral
    )
