"""How much light a rough coat reflects: tables by which the glossy material loses and gains nothing.

Light that a coat scatters once is not all that it reflects: the rest goes on from facet to facet. The tables hold the
albedo of one scattering by a GGX coat of Fresnel reflectance F = F0 + (1 - F0)(1 - cos)^5 (Schlick 1994), split as
F0 (S - T) + T into S, that of F = 1, and T, that of the power (Karis 2013). From them follow the light scattered more
than once (Kulla and Conty 2017) and what is left for the base underneath. In a white furnace
about 0.2% is lost or gained at most, at any roughness, seen from up to 87 degrees; some 2% closer to grazing.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from neurolens.cameras.contract import FloatArray

_NODES, _ENTRIES, _AROUND, _OUTWARDS = 48, 1024, 24, 128


def smith(cosine: Any, alpha2: Any) -> Any:
    """Smith's Lambda [N] for GGX (Heitz 2014)."""
    cos2 = cosine * cosine
    return np.float32(0.5) * (np.sqrt(1 + alpha2 * (1 - cos2) / cos2) - 1)


def fifth_power(cosine: FloatArray) -> FloatArray:
    """(1 - cos)^5 [N]."""
    grazing = np.clip(1 - cosine, 0, 1)
    squared = grazing * grazing
    result: FloatArray = squared * squared * grazing
    return result


def visible_normal(out: FloatArray, alpha: FloatArray, square: FloatArray) -> FloatArray:
    """Half vectors [3, N] in proportion to how much of their facets is seen from `out` [3, N], both about +z.

    Dupuy and Benyoub 2023, "Sampling visible GGX normals with spherical caps".
    """
    local = out.copy()
    local[:2] *= alpha
    local /= np.sqrt(local[0] * local[0] + local[1] * local[1] + local[2] * local[2])
    angle = square[0] * np.float32(2 * np.pi)
    height = (1 - square[1]) * (1 + local[2]) - local[2]
    radius = np.sqrt(np.clip(1 - height * height, 0, 1))
    local += np.stack([radius * np.cos(angle), radius * np.sin(angle), height])
    local[:2] *= alpha
    local /= np.sqrt(np.maximum(local[0] * local[0] + local[1] * local[1] + local[2] * local[2], np.float32(1e-12)))
    return local


class CoatTable:
    """S and T by cosine for some GGX widths.

    Args:
        alphas: the widths, one row each.
    """

    def __init__(self, alphas: Sequence[float]) -> None:
        cosine = (np.arange(_ENTRIES) + 0.5) / _ENTRIES
        rows = [[np.interp(cosine, *part) for part in _albedos(alpha)] for alpha in alphas]
        table = np.array(rows, np.float64).reshape(len(alphas), 2, _ENTRIES)
        means = 2 * np.mean(table * cosine, axis=-1)
        self._whole, self._power = (np.ascontiguousarray(table[:, k], np.float32).ravel() for k in (0, 1))
        self._mean_whole, self._mean_power = (means[:, k].astype(np.float32) for k in (0, 1))

    def at(self, row: NDArray[np.intp], cosine: FloatArray) -> tuple[FloatArray, FloatArray]:
        """S and T [N] for cosines [N] in 0 to 1."""
        place = row * _ENTRIES
        place += np.minimum(cosine * np.float32(_ENTRIES), np.float32(_ENTRIES - 1)).astype(np.intp)
        return self._whole.take(place), self._power.take(place)

    def means(self, row: NDArray[np.intp]) -> tuple[FloatArray, FloatArray]:
        """S and T [N] under light from everywhere: twice their integrals times the cosine."""
        return self._mean_whole.take(row), self._mean_power.take(row)


@cache
def _albedos(alpha: float) -> list[tuple[NDArray[np.float64], NDArray[np.float64]]]:
    """Cosines and S, cosines and T, by quadrature over visible normals, which the lobe is smooth in."""
    cosine = ((np.arange(_NODES) + 1) / _NODES) ** 2
    around, outwards = (np.arange(_AROUND) + 0.5) / _AROUND, (np.arange(_OUTWARDS) + 0.5) / _OUTWARDS
    # The tail of the lobe, from which light is lost, is a narrow strip at 1: nodes are dense there.
    u, v = (x.ravel() for x in np.meshgrid(around, 1 - (1 - outwards) ** 3))
    weight = np.repeat(3 * (1 - outwards) ** 2, _AROUND) / u.size
    cos_out = np.repeat(cosine, u.size)
    out = np.stack([np.sqrt(1 - cos_out**2), 0 * cos_out, cos_out])
    width = np.full(cos_out.size, alpha)
    half = visible_normal(out, width, np.stack([np.tile(u, _NODES), np.tile(v, _NODES)]))
    cos_half = np.sum(out * half, axis=0)
    cos_in = 2 * cos_half * half[2] - cos_out
    lambda_out, lambda_in = smith(cos_out, width**2), smith(np.maximum(cos_in, 1e-6), width**2)
    share = np.where(cos_in > 0, (1 + lambda_out) / (1 + lambda_out + lambda_in), 0)
    whole = share.reshape(_NODES, -1) @ weight
    power = (share * fifth_power(cos_half)).reshape(_NODES, -1) @ weight
    return [(cosine, whole), (cosine, power)]
