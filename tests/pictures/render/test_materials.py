"""Scattering: energy, densities, Snell and Fresnel."""

import math

import numpy as np
import pytest

from neurolens.pictures.render.materials import (
    CoatTable,
    GlossyLobes,
    cosine_direction,
    fresnel_dielectric,
    glass_direction,
)

RANDOM = np.random.default_rng(7)
COUNT = 200_000


def repeated(vector: tuple[float, float, float], count: int = COUNT) -> np.ndarray:
    return np.repeat(np.float32(vector)[:, None], count, axis=1)


def full(value: float, count: int = COUNT) -> np.ndarray:
    return np.full(count, value, np.float32)


def glossy(normal: np.ndarray, out: np.ndarray, base: float, coat: float, alpha: float) -> GlossyLobes:
    count = normal.shape[1]
    base_coat = [full(value, count)[None] for value in (base, coat)]
    return GlossyLobes(normal, out, *base_coat, full(alpha, count), CoatTable([alpha]), np.zeros(count, np.intp))


def test_cosine_directions_have_the_moments_of_the_cosine_law() -> None:
    normal = np.float32([0.36, 0.48, -0.8])
    direction, cosine = cosine_direction(repeated(tuple(normal)), RANDOM.random((2, COUNT), np.float32))
    assert np.allclose(np.sum(direction**2, axis=0), 1, atol=1e-5)
    assert cosine.mean() == pytest.approx(2 / 3, abs=3e-3) and (cosine**2).mean() == pytest.approx(0.5, abs=3e-3)
    assert np.allclose(direction.mean(axis=1), 2 / 3 * normal, atol=4e-3)


@pytest.mark.parametrize("angle_deg", [0.0, 45.0, 80.0])
@pytest.mark.parametrize(("base", "coat", "roughness"), [(0.0, 0.9, 0.2), (0.8, 0.04, 0.5), (0.3, 0.2, 1.0)])
def test_glossy_sampling_and_evaluation_agree(angle_deg: float, base: float, coat: float, roughness: float) -> None:
    angle = math.radians(angle_deg)
    normal, out = repeated((0, 0, 1)), repeated((math.sin(angle), 0, math.cos(angle)))
    lobes = glossy(normal, out, base, coat, roughness**2)
    square, lobe = RANDOM.random((2, COUNT), np.float32), RANDOM.random(COUNT, np.float32)
    inward = lobes.sample(square, lobe)
    value, density = lobes.evaluate(inward)
    above = inward[2] > 0
    sampled = np.where(above, value / density, 0).mean()

    uniform = np.empty((3, COUNT), np.float32)
    u, v = RANDOM.random((2, COUNT), np.float32)
    uniform[2], side = u, np.sqrt(1 - u * u)
    uniform[0], uniform[1] = side * np.cos(2 * np.pi * v), side * np.sin(2 * np.pi * v)
    value, density = lobes.evaluate(uniform)
    error = float(5 * 2 * np.pi * value.std() / math.sqrt(COUNT))
    assert sampled == pytest.approx(float(2 * np.pi * value.mean()), abs=error + 2e-3)
    assert sampled <= 1.0 + 2e-3
    # The density integrates to the share of samples that stay above the surface.
    error = float(5 * 2 * np.pi * density.std() / math.sqrt(COUNT))
    assert 2 * np.pi * density.mean() == pytest.approx(above.mean(), abs=error + 2e-3)


def test_glossy_scattering_is_reciprocal() -> None:
    a, b = RANDOM.normal(size=(2, 3, 1000)).astype(np.float32)
    for v in (a, b):
        v[2] = np.abs(v[2]) + 0.05
        v /= np.linalg.norm(v, axis=0)
    normal = repeated((0, 0, 1), 1000)
    forth, back = (glossy(normal, x, 0.5, 0.1, 0.16).evaluate(y)[0] for x, y in ((a, b), (b, a)))
    assert np.allclose(forth / b[2], back / a[2], rtol=1e-3)


@pytest.mark.parametrize("degrees", [5, 45, 80])
def test_narrowest_highlight_is_as_dense_as_ggx_says_whatever_the_normal(degrees: float) -> None:
    # Tilted normals have rounding in all components; 1 - cos^2 of the half vector would drown in it.
    normal = unit(np.array([[0.3], [-0.8], [0.52]]))
    out = normal * math.cos(math.radians(degrees)) + unit(np.cross(normal, [[1], [0.2], [0.1]], axis=0)) * math.sin(
        math.radians(degrees)
    )
    alpha = 0.02**2
    lobes = glossy(np.repeat(np.float32(normal), 20_000, 1), np.repeat(np.float32(out), 20_000, 1), 0.0, 1.0, alpha)
    inward = lobes.sample(RANDOM.random((2, 20_000), np.float32), np.zeros(20_000, np.float32))
    value, density = lobes.evaluate(inward)
    assert np.all(np.isfinite(value / density))
    half = unit(np.float64(inward) + np.float32(out))
    tan2 = np.sum(np.cross(half, normal, axis=0) ** 2, axis=0) / np.sum(half * normal, axis=0) ** 2
    cos_out = math.cos(math.radians(degrees))
    peak = alpha**2 / (math.pi * np.sum(half * normal, axis=0) ** 4 * (alpha**2 + tan2) ** 2)
    expected = peak / (4 * cos_out) * 2 / (1 + math.sqrt(1 + (alpha * math.tan(math.radians(degrees))) ** 2))
    # Far out, where a millionth of the peak is left, the rest of the lobes shows.
    near = expected > 1e-4 * expected.max()
    assert near.mean() > 0.9 and np.all(np.abs(density / expected - 1)[near] < 5e-3)


def unit(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.linalg.norm(vectors, axis=0)


def test_fresnel_known_values() -> None:
    index = np.float32([1.5] * 3)
    cosines = np.float32([1.0, math.cos(math.atan(1.5)), 1e-4])
    reflectance, _ = fresnel_dielectric(cosines, index)
    assert reflectance[0] == pytest.approx(0.04, abs=1e-6)
    # At Brewster's angle only s reflects: ((1 - n^2) / (1 + n^2))^2 of it, half of the light.
    assert reflectance[1] == pytest.approx(0.5 * ((1 - 2.25) / (1 + 2.25)) ** 2, abs=1e-6)
    assert reflectance[2] == pytest.approx(1, abs=2e-3)
    critical = math.sqrt(1 - 1 / 1.5**2)
    inside, cos_out = fresnel_dielectric(np.float32([critical - 1e-3, critical + 1e-3]), 1 / index[:2])
    assert inside[0] == 1 and cos_out[0] == 0 and inside[1] < 1


@pytest.mark.parametrize("outside", [True, False])
def test_glass_bends_by_snell_and_splits_by_fresnel(outside: bool) -> None:
    angle = math.radians(35)
    travel, normal = repeated((math.sin(angle), 0, -math.cos(angle))), repeated((0, 0, 1))
    index = full(1.5)
    relative = 1.5 if outside else 1 / 1.5
    reflectance, _ = fresnel_dielectric(full(math.cos(angle)), full(relative))
    choice, outsides = RANDOM.random(COUNT, np.float32), np.full(COUNT, outside)
    direction, refracts = glass_direction(travel, normal, outsides, index, choice, reflectance)
    assert np.allclose(direction[0, refracts], math.sin(angle) / relative, atol=1e-6) and np.all(
        direction[2, refracts] < 0
    )
    assert np.allclose(direction[:, ~refracts].T, (math.sin(angle), 0, math.cos(angle)), atol=1e-6)
    assert np.mean(~refracts) == pytest.approx(float(reflectance[0]), abs=2e-3)


@pytest.mark.parametrize("roughness", [0.02, 0.1, 0.3, 0.6, 1.0])
@pytest.mark.parametrize(("base", "coat"), [(0.0, 1.0), (1.0, 0.04), (1.0, 0.5), (0.0, 0.5)])
def test_glossy_loses_and_gains_nothing(roughness: float, base: float, coat: float) -> None:
    # Light 1 from everywhere: a material that absorbs nothing reflects 1, a metal the less the more often it reflects.
    count = 40_000
    cosine = np.repeat(np.float32([0.05, 0.2, 0.5, 0.9, 1.0]), count)
    out = np.stack([np.sqrt(1 - cosine**2), 0 * cosine, cosine])
    lobes = glossy(repeated((0, 0, 1), 5 * count), out, base, coat, roughness**2)
    inward = lobes.sample(RANDOM.random((2, 5 * count), np.float32), RANDOM.random(5 * count, np.float32))
    value, density = lobes.evaluate(inward)
    each = (value / density).reshape(5, count)
    albedo, error = each.mean(axis=1), each.std(axis=1) / math.sqrt(count)
    if base or coat == 1:
        assert np.all(np.abs(albedo - 1) < 2e-3 + 4 * error)
    else:
        assert np.all(albedo < 1) and np.all(albedo > 0.5 * coat)


def test_albedo_of_a_coat_agrees_with_a_plain_integral() -> None:
    # F = 1, by quadrature over the hemisphere of D G2 / (4 cos_out) for width 0.5.
    alpha2, cos_out = 0.25, 0.6
    theta, phi = np.meshgrid((np.arange(600) + 0.5) * np.pi / 1200, (np.arange(600) + 0.5) * 2 * np.pi / 600)
    inward = np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)])
    half = inward + np.array([0.8, 0, cos_out])[:, None, None]
    half /= np.linalg.norm(half, axis=0)
    peak = alpha2 / (np.pi * (half[2] ** 2 * (alpha2 - 1) + 1) ** 2)

    def smith(c: np.ndarray | float) -> np.ndarray:
        return 0.5 * (np.sqrt(1 + alpha2 * (1 / np.square(c) - 1)) - 1)

    value = peak / (1 + smith(cos_out) + smith(inward[2])) / (4 * cos_out)
    expected = np.sum(value * np.sin(theta)) * (np.pi / 1200) * (2 * np.pi / 600)
    whole, power = CoatTable([0.5]).at(np.zeros(1, np.intp), np.float32([cos_out]))
    assert whole[0] == pytest.approx(expected, rel=2e-3) and 0 < power[0] < 0.2
