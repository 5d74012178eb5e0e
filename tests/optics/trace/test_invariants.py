"""What every lens keeps, whatever its surfaces: étendue and energy. Over the whole library, float64."""

import math
from dataclasses import replace

import pytest
import torch
from shipped import SOME, focused
from torch import Tensor

from experiments.accuracy.extreme_cases import from_film, from_scene, generator, unit
from neurolens.base import status as st
from neurolens.optics.lens import glass
from neurolens.optics.lens.designs import design
from neurolens.optics.lens.prescription import Lens, Surface
from neurolens.optics.trace.films import reflectance
from neurolens.optics.trace.rays import Rays, Towards, trace

FISHEYES = [name for name in SOME if "fisheye" in name]


def at_plane(r: Rays, z: float) -> tuple[Tensor, Tensor]:
    """Where lines cross a plane."""
    return r.x + (z - r.z) * r.dx / r.dz, r.y + (z - r.z) * r.dy / r.dz


# ---- étendue ----


def film_to_scene(lens: Lens, count: int, film: float = 1.0) -> tuple[list[Tensor], Rays]:
    """Passing camera rays whose x, y, dx, dy on the film are leaves, [x, y, dx, dy] and what leaves the lens."""
    found = from_film(lens, count, generator(), share=0.9, film=film)
    passed = trace(lens, found).status == st.PASSED
    assert passed.sum() > 20
    leaves = [c[passed].clone().requires_grad_() for c in (found.x, found.y, found.dx, found.dy)]
    x, y, dx, dy = leaves
    z = found.z[passed]
    out = trace(lens, Rays(x, y, z, dx, dy, -torch.sqrt(1 - dx * dx - dy * dy)))
    assert (out.status == st.PASSED).all()
    return leaves, out.rays


def determinant(outputs: tuple[Tensor, ...], leaves: list[Tensor]) -> Tensor:
    """[N] determinant of the derivatives of four outputs with respect to four inputs, ray by ray."""
    rows = [torch.stack(torch.autograd.grad(o.sum(), leaves, retain_graph=True)) for o in outputs]
    return torch.linalg.det(torch.stack(rows).permute(2, 0, 1))


@pytest.mark.parametrize("name", [name for name in SOME if name not in FISHEYES])
def test_etendue_between_film_and_front_plane(name: str) -> None:
    """d(x', y', dx', dy') / d(x, y, dx, dy) = 1 between planes in air (Winston 2005, 3.2)."""
    leaves, out = film_to_scene(focused(name), 300)
    kept = out.dz < -0.3  # near the plane itself its coordinates lose their digits
    found = determinant((*at_plane(out, 0.0), out.dx, out.dy), leaves)[kept]
    assert len(found) > 20
    assert (found - 1).abs().max() < 1e-9


@pytest.mark.parametrize("name", FISHEYES)
def test_etendue_on_the_front_of_a_fisheye(name: str) -> None:
    """Beyond 90 degrees no plane is crossed: dA cos dOmega on the front surface instead.

    dA = dx dy / |n_z|, cos = |d . n|, and dOmega by two directions perpendicular to the ray.
    """
    lens = focused(name)
    front = lens.surfaces[0]
    assert not front.figure.asphere and not front.figure.conic
    leaves, out = film_to_scene(lens, 1500, film=1.3)
    d = torch.stack(out[3:]).detach()
    u = torch.linalg.cross(d.T, torch.tensor([[0.6, -0.8, 0.0]]).double().expand(len(out.x), 3))
    u = u / u.norm(dim=1, keepdim=True)
    v = torch.linalg.cross(d.T, u)
    turns = [out.dx * w[:, 0] + out.dy * w[:, 1] + out.dz * w[:, 2] for w in (u, v)]
    normal = torch.stack([-out.x * front.curvature, -out.y * front.curvature, 1 - out.z * front.curvature]).detach()
    found = determinant((out.x, out.y, *turns), leaves) * (d * normal).sum(0) / normal[2]
    # dOmega on the film: d(dx) d(dy) / |dz|, and its cosine is |dz|.
    assert (found.abs() - 1).abs().max() < 1e-9
    if name.startswith(("shimizu", "isshiki")):
        assert out.dz.max() > 0.15  # 99 degrees


@pytest.mark.parametrize("name", ["laikin_double_gauss_50", "canon_aspheric_50", "schneider_anamorphic_31"])
def test_etendue_into_glass_counts_the_index(name: str) -> None:
    """Between a plane in the scene and one in the glass after a surface: coordinates n dx, n dy."""
    table = focused(name)
    inside = [k for k, s in enumerate(table.surfaces) if float(s.n_d) != 1 or s.glass]
    for k in (inside[0], inside[-1], *(k for k in inside if table.surfaces[k].figure.asphere)):
        cut = replace(table, surfaces=(*table.surfaces[:k], replace(table.surfaces[k], thickness_mm=5.0)))
        start = from_scene(cut, 200, generator(), slope=0.1, wide=0.5)
        passed = trace(cut, start, towards="film").status == st.PASSED
        assert passed.sum() > 10
        x, y, dx, dy = leaves = [c[passed].clone().requires_grad_() for c in (start.x, start.y, start.dx, start.dy)]
        out = trace(cut, Rays(x, y, start.z[passed], dx, dy, torch.sqrt(1 - dx * dx - dy * dy)), towards="film").rays
        n = float(glass.index_of(table.surfaces[k], glass.LINE_D_NM))
        found = determinant((*at_plane(out, float(cut.vertices_mm[-1])), n * out.dx, n * out.dy), leaves)
        assert (found - 1).abs().max() < 1e-9


# ---- energy ----


def rays_at(angles_deg: list[float], sense: int) -> Rays:
    a = torch.deg2rad(torch.tensor(angles_deg, dtype=torch.float64))
    zero = torch.zeros_like(a)
    return Rays(zero, zero, zero - 0.5 * sense, torch.sin(a), zero, sense * torch.cos(a))


def reflected(incidence: Tensor, n: float, m: float) -> Tensor:
    """Fresnel's reflectance of unpolarised light by sines and tangents (Born and Wolf, 1.5.2, 32), from n into m."""
    t = torch.asin(torch.sin(incidence) * n / m)
    s = torch.sin(incidence - t) / torch.sin(incidence + t)
    p = torch.tan(incidence - t) / torch.tan(incidence + t)
    return (s * s + p * p) / 2


@pytest.mark.parametrize("towards", ["film", "scene"])
def test_what_is_not_transmitted_is_reflected(towards: Towards) -> None:
    """T of one bare surface plus R by another formula is 1, up to grazing incidence and to the critical angle."""
    n = 1.62
    surface = Lens("surface", "", (Surface(math.inf, 1.0, 100.0, n, stop=True),), 1.0)
    angles = [1e-3, 10.0, 30.0, 38.0] if towards == "scene" else [1e-3, 10.0, 45.0, 58.3, 80.0, 89.9]
    out = trace(surface, rays_at(angles, 1 if towards == "film" else -1), towards=towards, transmittance=True)
    media = (1.0, n) if towards == "film" else (n, 1.0)
    expected = reflected(torch.deg2rad(torch.tensor(angles, dtype=torch.float64)), *media)
    torch.testing.assert_close(out.transmittance + expected, torch.ones_like(expected), rtol=0, atol=1e-11)


@pytest.mark.parametrize("name", ["quarter-wave", "v-coat", "broadband"])
def test_a_coating_takes_nothing(name: str) -> None:
    """T by the tracer plus R of the films by themselves is 1."""
    n, wavelength = 1.62, 520.0
    coating = design(name, 1.0, n)
    surface = Lens("surface", "", (Surface(math.inf, 1.0, 100.0, n, stop=True, coating=coating),), 1.0)
    angles = [0.0, 20.0, 50.0, 75.0]
    out = trace(surface, rays_at(angles, 1), wavelength, towards="film", transmittance=True)
    cosines = torch.cos(torch.deg2rad(torch.tensor(angles, dtype=torch.float64)))
    lost = reflectance(cosines, 1.0, n, coating.layers, wavelength)
    torch.testing.assert_close(out.transmittance + lost, torch.ones_like(cosines), rtol=0, atol=1e-12)


@pytest.mark.parametrize("name", SOME)
def test_a_lens_transmits_between_nothing_and_all_along_unit_directions(name: str) -> None:
    lens = focused(name)
    out = trace(lens, from_film(lens, 500, generator()), transmittance=True)
    passed = out.status == st.PASSED
    assert ((out.transmittance[passed] > 0) & (out.transmittance[passed] <= 1)).all()
    assert torch.isfinite(out.transmittance).all()
    lost = (out.status % 4 == st.MISSED) | (out.status % 4 == st.TOTAL_REFLECTION)
    assert (out.transmittance[lost & ~passed] == 0).all()
    for a, b in zip(unit(*out.rays[3:]), out.rays[3:], strict=True):
        assert (a - b).abs().max() < 1e-13
