"""How surfaces scatter: Lambert, a GGX coat over a Lambert base, mirror, smooth glass.

Reflectances are numbers [N], or [lanes, N] where paths carry several wavelengths; what is drawn then depends on the
lanes together, not on one of them, so that all give a path the same density. Directions are unit vectors [3, N] that
point away from the surface, normals lie on the side of the incoming ray.

Sources: Walter et al. 2007 (GGX); Heitz 2014 (Smith shadowing); Dupuy and Benyoub 2023, "Sampling visible GGX normals
with spherical caps"; Schlick 1994.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from neurolens.cameras.contract import FloatArray
from neurolens.render.lights import orthonormal
from neurolens.render.primitives import dot

_PI = np.float32(math.pi)


def cosine_direction(normal: FloatArray, square: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Directions [3, N] with density cos / pi about the normals, and their cosines [N].

    A normal plus a uniform point on the unit sphere has that distribution; no tangent frame is needed.
    """
    height = 1 - 2 * square[0]
    radius = np.sqrt(1 - height * height)
    angle = square[1] * (2 * _PI)
    direction = np.empty_like(normal)
    np.cos(angle, out=direction[0])
    np.sin(angle, out=direction[1])
    direction[:2] *= radius
    direction[2] = height
    direction += normal
    # The point opposite to the normal would give the zero vector.
    length2 = np.maximum(dot(direction, direction), np.float32(1e-12))
    direction /= np.sqrt(length2)
    return direction, np.maximum(dot(direction, normal), np.float32(1e-6))


def mirror_direction(direction: FloatArray, normal: FloatArray) -> FloatArray:
    """Reflection [3, N] of travel directions [3, N]."""
    result: FloatArray = direction - normal * (2 * dot(direction, normal))
    return result


def schlick(head_on: FloatArray, cosine: FloatArray) -> FloatArray:
    """Fresnel reflectance [N] by Schlick's approximation."""
    grazing = np.clip(1 - cosine, 0, 1)
    squared = grazing * grazing
    return head_on + (1 - head_on) * squared * squared * grazing


def glossy_evaluate(
    normal: FloatArray, out: FloatArray, inward: FloatArray, base: FloatArray, coat: FloatArray, alpha: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Scattering times cosine [..., N] of the glossy material, and the density [N] with which `glossy_sample` finds it.

    Args:
        out: towards the camera. inward: towards the light.
        base: diffuse reflectance. coat: Fresnel reflectance head on. alpha: GGX width, roughness squared.

    The base is dimmed by 1 - F on the way in and out, so that coat and base never reflect more than arrives.
    """
    cos_out = np.maximum(dot(normal, out), np.float32(1e-6))
    cos_in = dot(normal, inward)
    half = out + inward
    half /= np.sqrt(np.maximum(dot(half, half), np.float32(1e-12)))
    cos_half = dot(normal, half)
    alpha2 = alpha * alpha
    spread = cos_half * cos_half * (alpha2 - 1) + 1
    peak = alpha2 / (_PI * spread * spread)
    lambda_out, lambda_in = _smith(cos_out, alpha2), _smith(np.maximum(cos_in, np.float32(1e-6)), alpha2)

    fresnel = schlick(coat, dot(out, half))
    common = peak / (4 * cos_out)
    scattered = fresnel * common / (1 + lambda_out + lambda_in)
    enter = (1 - schlick(coat, cos_out)) * (1 - schlick(coat, cos_in))
    scattered += enter * base * cos_in / _PI
    choice = coat_probability(cos_out, base, coat)
    density = choice * common / (1 + lambda_out) + (1 - choice) * cos_in / _PI
    above = cos_in > 0
    return np.where(above, scattered, np.float32(0)), np.where(above, density, np.float32(1))


def _smith(cosine: FloatArray, alpha2: FloatArray) -> FloatArray:
    """Smith's Lambda [N] for GGX."""
    cos2 = cosine * cosine
    result: FloatArray = np.float32(0.5) * (np.sqrt(1 + alpha2 * (1 - cos2) / cos2) - 1)
    return result


def coat_probability(cos_out: FloatArray, base: FloatArray, coat: FloatArray) -> FloatArray:
    """Probability [N] of sampling the coat: its share of the light reflected in all lanes, at least 1/5."""
    base, coat = (a if a.ndim == 1 else a.mean(axis=0) for a in (base, coat))
    fresnel = schlick(coat, cos_out)
    share = fresnel / np.maximum(fresnel + (1 - fresnel) * base, np.float32(1e-6))
    return np.clip(share, np.float32(0.2), np.float32(1))


def glossy_sample(
    normal: FloatArray,
    out: FloatArray,
    base: FloatArray,
    coat: FloatArray,
    alpha: FloatArray,
    square: FloatArray,
    lobe: FloatArray,
) -> FloatArray:
    """Directions towards light [3, N]: off a visible GGX normal, or by cosine for the base."""
    diffuse, _ = cosine_direction(normal, square)
    tangent, bitangent = orthonormal(normal)
    local = np.stack([dot(tangent, out) * alpha, dot(bitangent, out) * alpha, np.maximum(dot(normal, out), 1e-6)])
    local /= np.sqrt(dot(local, local))
    angle = square[0] * (2 * _PI)
    height = (1 - square[1]) * (1 + local[2]) - local[2]
    radius = np.sqrt(np.clip(1 - height * height, 0, 1))
    local += np.stack([radius * np.cos(angle), radius * np.sin(angle), height])
    local[:2] *= alpha
    half = tangent * local[0] + bitangent * local[1] + normal * local[2]
    half /= np.sqrt(np.maximum(dot(half, half), np.float32(1e-12)))
    coated = half * (2 * dot(out, half)) - out
    chosen = lobe < coat_probability(np.maximum(dot(normal, out), np.float32(1e-6)), base, coat)
    return np.where(chosen, coated, diffuse)


def fresnel_dielectric(cos_in: FloatArray, relative_index: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Unpolarised reflectance [N] and refracted cosine [N] of a smooth surface.

    Args:
        cos_in: cosine of incidence, 0 to 1. relative_index: index beyond the surface over index before it.

    Total reflection gives reflectance 1 and cosine 0.
    """
    sin2 = (1 - cos_in * cos_in) / (relative_index * relative_index)
    cos_out = np.sqrt(np.maximum(1 - sin2, 0))
    s = (cos_in - relative_index * cos_out) / (cos_in + relative_index * cos_out)
    p = (relative_index * cos_in - cos_out) / (relative_index * cos_in + cos_out)
    reflectance = np.float32(0.5) * (s * s + p * p)
    return np.where(sin2 >= 1, np.float32(1), reflectance), cos_out


def glass_direction(
    direction: FloatArray,
    normal: FloatArray,
    outside: NDArray[np.bool_],
    index: FloatArray,
    choice: FloatArray,
    chance: FloatArray | None = None,
) -> tuple[FloatArray, NDArray[np.bool_]]:
    """Reflected or refracted travel directions [3, N], each chosen with its Fresnel probability, and which refract [N].

    Args:
        direction: of travel. outside: whether the ray comes from outside. index: of the glass. choice: in [0, 1).
        chance: probability of reflection to use instead of Fresnel's.

    The throughput stays: the factor n^2 of radiance inside glass cancels on the way out, and no light stands in glass.
    """
    relative = np.where(outside, index, 1 / index)
    cos_in = np.clip(-dot(direction, normal), 0, 1)
    reflectance, cos_out = fresnel_dielectric(cos_in, relative)
    refracts = choice >= (reflectance if chance is None else chance)
    along = np.where(refracts, 1 / relative, np.float32(1))
    across = np.where(refracts, cos_in / relative - cos_out, 2 * cos_in)
    result = direction * along + normal * across
    result /= np.sqrt(dot(result, result))
    return result, refracts
