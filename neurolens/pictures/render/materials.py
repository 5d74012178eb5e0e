"""How surfaces scatter: Lambert, a GGX coat over a Lambert base, mirror, smooth glass.

Reflectances are [lanes, N], for the wavelengths of each path. What is drawn depends on all lanes together, so that all
give a path the same density. Directions are unit vectors [3, N] that point away from the surface; normals lie on the
side of the incoming ray.

Light that a coat scatters once is not all that it reflects: the rest goes on from facet to facet. Tables hold the
albedo of one scattering by a GGX coat of Fresnel reflectance F = F0 + (1 - F0)(1 - cos)^5 (Schlick 1994), split as F0
(S - T) + T. S is the albedo for F = 1, T the one for the power alone (Karis 2013). From them follow the light that is
scattered more than once (Kulla and Conty 2017) and what is left for the base underneath. In a white furnace at most
some 0.2% is lost or gained, at any roughness, seen from up to 87 degrees; some 2% closer to grazing.

Other sources: Walter et al. 2007 (GGX); Heitz 2014 (Smith shadowing).
"""

from collections.abc import Sequence
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from neurolens.cameras.contract import FloatArray
from neurolens.pictures.render.primitives import dot
from neurolens.pictures.render.sampler import cosine_direction, orthonormal

_PI = np.float32(np.pi)
_NODES, _ENTRIES, _AROUND, _OUTWARDS = 48, 1024, 24, 128


def smith(cosine: Any, alpha2: Any) -> Any:
    """Smith's Lambda [N] for GGX (Heitz 2014)."""
    cos2 = cosine * cosine
    return np.float32(0.5) * (np.sqrt(1 + alpha2 * (1 - cos2) / cos2) - 1)


def fifth_power(cosine: FloatArray) -> FloatArray:
    """Return (1 - cos)^5 [N]."""
    grazing = np.clip(1 - cosine, 0, 1)
    squared = grazing * grazing
    return squared * squared * grazing


def visible_normal(out: FloatArray, alpha: FloatArray, square: FloatArray) -> FloatArray:
    """Draw half vectors [3, N] in proportion to how much of their facets is seen from `out` [3, N], both about +z.

    Dupuy and Benyoub 2023, "Sampling visible GGX normals with spherical caps".
    """
    local = out.copy()
    local[:2] *= alpha
    local /= np.sqrt(dot(local, local))
    angle = square[0] * np.float32(2 * np.pi)
    height = (1 - square[1]) * (1 + local[2]) - local[2]
    radius = np.sqrt(np.clip(1 - height * height, 0, 1))
    local += np.stack([radius * np.cos(angle), radius * np.sin(angle), height])
    local[:2] *= alpha
    local /= np.sqrt(np.maximum(dot(local, local), np.float32(1e-12)))
    return local


class CoatTable:
    """S and T of the module, by cosine, for some GGX widths; one row each."""

    def __init__(self, alphas: Sequence[float]) -> None:
        cosine = (np.arange(_ENTRIES) + 0.5) / _ENTRIES
        rows = [[np.interp(cosine, *part) for part in _albedos(alpha)] for alpha in alphas]
        table = np.array(rows, np.float64).reshape(len(alphas), 2, _ENTRIES)
        means = 2 * np.mean(table * cosine, axis=-1)
        self._whole, self._power = (np.ascontiguousarray(table[:, k], np.float32).ravel() for k in (0, 1))
        self._mean_whole, self._mean_power = (means[:, k].astype(np.float32) for k in (0, 1))

    def at(self, row: NDArray[np.intp], cosine: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return S and T [N] for cosines [N] in 0 to 1."""
        place = row * _ENTRIES
        place += np.minimum(cosine * np.float32(_ENTRIES), np.float32(_ENTRIES - 1)).astype(np.intp)
        return self._whole.take(place), self._power.take(place)

    def means(self, row: NDArray[np.intp]) -> tuple[FloatArray, FloatArray]:
        """Return S and T [N] under light from everywhere: twice the integrals of each times the cosine."""
        return self._mean_whole.take(row), self._mean_power.take(row)


@cache
def _albedos(alpha: float) -> list[tuple[NDArray[np.float64], NDArray[np.float64]]]:
    """Return cosines and S, cosines and T, by quadrature over visible normals, in which the lobe is smooth."""
    cosine = ((np.arange(_NODES) + 1) / _NODES) ** 2
    around, outwards = (np.arange(_AROUND) + 0.5) / _AROUND, (np.arange(_OUTWARDS) + 0.5) / _OUTWARDS
    # The tail of the lobe, where light is lost, is a narrow strip at 1, where nodes are dense.
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
    return [(cosine, whole), (cosine, (share * fifth_power(cos_half)).reshape(_NODES, -1) @ weight)]


class GlossyLobes:
    """A GGX coat over a Lambert base, seen from one direction: how much it scatters, and directions to sample.

    Coat and base together reflect all light where nothing absorbs: the coat also scatters light from facet to facet
    (Kulla and Conty 2017), and the base gets what the coat's albedo leaves, on the way in and out (Kelemen and
    Szirmay-Kalos 2001). Both are lobes without direction.

    Args:
        normal, out: [3, N]; `out` points towards the camera.
        base: diffuse reflectance [lanes, N]. coat: Fresnel reflectance [lanes, N] at normal incidence. alpha: GGX width
            [N], the squared roughness. table, row: the coat's albedo, and which of its rows [N].
    """

    def __init__(
        self,
        normal: FloatArray,
        out: FloatArray,
        base: FloatArray,
        coat: FloatArray,
        alpha: FloatArray,
        table: CoatTable,
        row: NDArray[np.intp],
    ) -> None:
        self._normal, self._out, self._coat = normal, out, coat
        self._alpha, self._table, self._row = alpha, table, row
        self._cos_out = np.maximum(dot(normal, out), np.float32(1e-6))
        whole_mean, power_mean = table.means(row)
        left = np.maximum(1 - whole_mean, np.float32(1e-6))
        fresnel = coat + (1 - coat) / 21  # mean over all directions
        self._more = fresnel * fresnel * whole_mean / (1 - fresnel * left)
        mean = coat * (whole_mean - power_mean) + power_mean + left * self._more
        self._below = base / np.maximum(1 - mean, np.float32(1e-6))
        self._again = self._more / left

        whole, power = table.at(row, self._cos_out)
        self._left_out, once = 1 - whole, coat * (whole - power) + power
        self._through_out = np.maximum(1 - once - self._left_out * self._more, 0)
        rest = self._left_out * self._more + self._through_out * base
        once, rest = once.mean(axis=0), rest.mean(axis=0)
        # The coat is sampled with at least 1/5: highlights are narrow and bright.
        self._choice = np.clip(once / np.maximum(once + rest, np.float32(1e-6)), np.float32(0.2), np.float32(1))

    def evaluate(self, inward: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Scattering times cosine [lanes, N] towards light in directions [3, N], and the density of `sample` there."""
        cos_out, cos_in = self._cos_out, dot(self._normal, inward)
        half = self._out + inward
        half /= np.sqrt(np.maximum(dot(half, half), np.float32(1e-12)))
        cos_half = dot(self._normal, half)
        alpha2 = self._alpha * self._alpha
        # The squared sine comes from the cross product: 1 - cos^2 is lost in float32 where the lobe is narrow.
        x, y, z = (self._normal[j] * half[k] - self._normal[k] * half[j] for j, k in ((1, 2), (2, 0), (0, 1)))
        spread = cos_half * cos_half * alpha2 + (x * x + y * y + z * z)
        peak = alpha2 / (_PI * spread * spread)
        lambda_out, lambda_in = smith(cos_out, alpha2), smith(np.maximum(cos_in, np.float32(1e-6)), alpha2)
        common = peak / (4 * cos_out)
        power = fifth_power(dot(self._out, half))
        scattered = (self._coat + (1 - self._coat) * power) * (common / (1 + lambda_out + lambda_in))

        cosine = cos_in / _PI
        whole, power = self._table.at(self._row, np.clip(cos_in, 0, 1))
        through = np.maximum(1 - self._coat * (whole - power) - power - (1 - whole) * self._more, 0)
        even = self._below * self._through_out * through
        even += self._again * (self._left_out * (1 - whole))
        even *= cosine
        scattered += even
        density = self._choice * common / (1 + lambda_out) + (1 - self._choice) * cosine
        above = cos_in > 0
        return np.where(above, scattered, np.float32(0)), np.where(above, density, np.float32(1))

    def sample(self, square: FloatArray, lobe: FloatArray) -> FloatArray:
        """Draw directions towards light [3, N]: reflected by a visible GGX normal, or by cosine for the rest."""
        normal, out = self._normal, self._out
        diffuse, _ = cosine_direction(normal, square)
        tangent, bitangent = orthonormal(normal)
        local = np.stack([dot(tangent, out), dot(bitangent, out), np.maximum(dot(normal, out), np.float32(1e-6))])
        local = visible_normal(local, self._alpha, square)
        half = tangent * local[0] + bitangent * local[1] + normal * local[2]
        return np.where(lobe < self._choice, half * (2 * dot(out, half)) - out, diffuse)


def fresnel_dielectric(cos_in: FloatArray, relative_index: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return unpolarised reflectance [N] and refracted cosine [N] of a smooth surface; 1 and 0 at total reflection.

    `cos_in` is the cosine of incidence, 0 to 1; `relative_index` the index beyond the surface over that before it.
    """
    sin2 = (1 - cos_in * cos_in) / (relative_index * relative_index)
    cos_out = np.sqrt(np.maximum(1 - sin2, 0))
    s = (cos_in - relative_index * cos_out) / (cos_in + relative_index * cos_out)
    p = (relative_index * cos_in - cos_out) / (relative_index * cos_in + cos_out)
    return np.where(sin2 >= 1, np.float32(1), np.float32(0.5) * (s * s + p * p)), cos_out


def glass_direction(
    direction: FloatArray,
    normal: FloatArray,
    outside: NDArray[np.bool_],
    index: FloatArray,
    choice: FloatArray,
    chance: FloatArray,
) -> tuple[FloatArray, NDArray[np.bool_]]:
    """Return reflected or refracted travel directions [3, N], and which refract [N].

    Args:
        direction: of travel. outside: whether the ray comes from outside. index: the glass's.
        choice: numbers in [0, 1). chance: probability of reflection, 1 where it is total.

    The throughput stays as it is: the factor n^2 of radiance inside glass cancels on the way out, and no light is
    inside.
    """
    relative = np.where(outside, index, 1 / index)
    cos_in = np.clip(-dot(direction, normal), 0, 1)
    _, cos_out = fresnel_dielectric(cos_in, relative)
    refracts = choice >= chance
    along = np.where(refracts, 1 / relative, np.float32(1))
    across = np.where(refracts, cos_in / relative - cos_out, 2 * cos_in)
    result = direction * along + normal * across
    result /= np.sqrt(dot(result, result))
    return result, refracts
