"""Ray fans: transverse aberration over the pupil, along the meridional plane and across it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from neurolens.analysis.bundles import bundle
from neurolens.analysis.fields import DEFAULT_NM, Scene
from neurolens.analysis.patterns import fan
from neurolens.analysis.results import Array, Result


@dataclass(frozen=True)
class Fans(Result):
    """Fans of F fields, W wavelengths and n pupil points.

    Attributes:
        pupil: [n] share of the stop's radius, -1 to 1.
        tangential_um: [F, W, n], aberration in the meridional plane of the rays along it.
        sagittal_um: [F, W, n], aberration across the meridional plane of the rays along the other line.
            Both from the chief ray of the first wavelength; NaN where a rim blocks.
    """

    field_deg: Array
    wavelength_nm: Array
    height_mm: Array
    pupil: Array
    tangential_um: Array
    sagittal_um: Array


def fans(
    scene: Scene,
    field_deg: Sequence[float] | None = None,
    wavelength_nm: Sequence[float] = DEFAULT_NM,
    *,
    n: int = 65,
) -> Fans:
    """Ray fans of fields (`Scene.default_fields` if not given) with n points along each line of the stop."""
    pattern = fan(n)
    rays = bundle(scene, scene.default_fields() if field_deg is None else field_deg, wavelength_nm, pattern)
    return Fans(
        np.array(rays.field_deg),
        np.array(rays.wavelength_nm),
        rays.chief_height_mm.numpy(),
        pattern.tangential[:n].numpy(),
        1000 * rays.tangential_mm[..., :n].numpy(),
        1000 * rays.sagittal_mm[..., n:].numpy(),
    )
