"""Fits of lenses whose rays leave the front surface at grazing angles: up to the front glass, then exact refraction.

Near grazing the direction outside turns as the square root of what is left to the grazing ray (see `cores.Refracted`).
Networks follow that themselves, and measured worse when their error was that inside the glass.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import torch

from neurolens.lens.glass import index_of
from neurolens.lens.prescription import Lens
from neurolens.surrogates.assemble import tilt_series
from neurolens.surrogates.cores import Array
from neurolens.surrogates.model import Encoding
from neurolens.surrogates.pairs import PairSet, RayPairs
from neurolens.trace.surfaces import entered

# Cosine of the flattest ray that leaves the front surface, below which a fit refracts there.
GRAZING = 0.3
_MOST_DEGREE, _INDEX = 8, 3e-8


def grazes(pairs: RayPairs) -> bool:
    """Whether any of the rays to fit leaves the front surface at a grazing angle, and models can refract there."""
    flattest = float(pairs.train.refracts[0].min()) if len(pairs.train) else 1.0
    return flattest < GRAZING**2 and tilt_series(pairs.lens.surfaces[0]) is not None


def inside_front(lens: Lens, pairs: PairSet) -> PairSet:
    """The same rays with the directions that they have inside the front glass; as they were where rays end before."""
    front, scene = lens.surfaces[0], pairs.scene
    n, outside = np.asarray(_index(lens, pairs.inputs.wavelength_nm.numpy())), torch.stack(scene[3:]).numpy()
    with np.errstate(all="ignore"):
        d, _ = entered(front, scene.x.numpy(), scene.y.numpy(), outside, n)
    d = np.where(np.isfinite(d).all(0), d, outside)
    return replace(pairs, scene=scene._replace(**dict(zip(("dx", "dy", "dz"), torch.from_numpy(d), strict=True))))


def _index(lens: Lens, wavelength_nm: Any) -> Any:
    """The index of the front glass over that of the medium in front of it."""
    return index_of(lens.surfaces[0], wavelength_nm) / index_of(lens.object_medium, wavelength_nm)


def index_series(lens: Lens, encoding: Encoding) -> Array:
    """[K] the relative index of the front glass as a power series in the encoding's w, to float32's last bit."""
    if not encoding.dispersive:
        return np.array([float(lens.surfaces[0].n_d) / float(lens.object_medium.n_d)])
    w = np.linspace(-1, 1, 200)
    n = np.array([float(_index(lens, 1000 / v**0.5)) for v in encoding.w_middle + encoding.w_half * w])
    for degree in range(_MOST_DEGREE + 1):
        series = np.polynomial.Polynomial.fit(w, n, degree, domain=[-1, 1])
        if np.abs(series(w) - n).max() < _INDEX:
            break
    return np.asarray(series.convert().coef)
