"""Taylor polynomials of lenses against first-order optics, exactly traced rays and the order of their error."""

from __future__ import annotations

import math
from dataclasses import replace

import lens_models
import numpy as np
import pytest
import torch

from neurolens.base.errors import InputError
from neurolens.graph.interpret import monomials
from neurolens.optics.glass import LINE_D_NM
from neurolens.optics.prescription import Lens, Surface
from neurolens.optics.trace import Rays, trace
from neurolens.surrogates.fits.polynomial import ideal_map
from neurolens.surrogates.lightfield import Encoding
from neurolens.surrogates.published.taylor import expand, truncated
from neurolens.surrogates.targets import scales_of

# Conic and even powers, and a stop between.
ASPHERIC = Lens(
    "aspheric",
    "made up",
    (
        Surface(21.0, 5.0, 24.0, 1.62, conic=-0.8, asphere=((4, 2e-6), (6, 1e-9))),
        Surface(-160.0, 3.0, 22.0),
        Surface(math.inf, 4.0, 10.0, stop=True),
        Surface(-30.0, 2.0, 16.0, 1.7),
        Surface(55.0, 40.0, 18.0, conic=2.0),
    ),
    f_number=2.8,
)


def encoding_of(lens: Lens) -> Encoding:
    film = float(lens.vertices_mm[-1])
    return Encoding(film, float(lens.vertices_mm[-2]) - 5.0, 1.0, 6.0, 8.0, 0.0, 0.0)


def exact(lens: Lens, e: Encoding, p: torch.Tensor, u: torch.Tensor, wavelength_nm: float) -> torch.Tensor:
    """[6, N] x, y, dx, dy on the front surface and the crossing with the stop, of rays p, u [2, N]."""
    film = e.film_scale_mm * p
    pupil = film + e.pupil_scale_mm * u
    offset = torch.cat([pupil - film, torch.full_like(p[:1], e.pupil_plane_z_mm - e.film_plane_z_mm)])
    direction = offset / offset.norm(dim=0)
    k = lens.stop_index
    found = trace(
        lens, Rays(film[0], film[1], torch.full_like(p[0], e.film_plane_z_mm), *direction), wavelength_nm, record=[k]
    )
    crossing = found.crossings[k]
    return torch.stack([found.rays.x, found.rays.y, found.rays.dx, found.rays.dy, crossing.x, crossing.y])


def series_of(lens: Lens, e: Encoding, degree: int, wavelength_nm: float = LINE_D_NM) -> torch.Tensor:
    """[6, M] the same as series."""
    found = expand(lens, e, wavelength_nm, degree)
    return torch.from_numpy(np.stack([*found.scene, found.stop_x, found.stop_y]))


LENSES = pytest.mark.parametrize("lens", (lens_models.lens(), ASPHERIC), ids=("spheres", "aspheres"))


def test_truncated_arithmetic_is_that_of_polynomials() -> None:
    t = truncated(3, 4)
    generator = np.random.default_rng(2)
    a, b = generator.normal(size=(2, len(t.exponents)))
    a[0] = 1.7
    points = torch.from_numpy(generator.uniform(-1e-3, 1e-3, (3, 50)))
    features = monomials(points, t.exponents)

    def at(series: np.ndarray) -> torch.Tensor:
        return torch.from_numpy(series) @ features

    # What is cut is of degree 5 and more: 1e-15 times a few hundred.
    assert torch.allclose(at(t.times(a, b)), at(a) * at(b), rtol=0, atol=1e-12)
    assert torch.allclose(at(t.power(a, -0.5)), at(a) ** -0.5, rtol=0, atol=1e-11)
    assert np.allclose(t.times(a, t.power(a, -1.0)), t.constant(1.0), atol=1e-12)
    assert np.allclose(t.times(t.power(a, 0.5), t.power(a, 0.5)), a, atol=1e-12)
    assert np.allclose(t.power(b, 2), t.times(b, b))
    with pytest.raises(ValueError, match="no power series"):
        t.power(t.variable(0), 0.5)


@LENSES
def test_degree_one_is_first_order_optics(lens: Lens) -> None:
    e = encoding_of(lens)
    t, found = truncated(4, 1), series_of(lens, e, 1)
    by_variable = {tuple(map(int, x)): found[:, k] for k, x in enumerate(t.exponents)}
    wanted = ideal_map(lens, e, "thick")  # position in the vertex plane, and slope, by p and u
    for column, (p, u) in enumerate(((0, 2), (1, 3))):
        at = [by_variable[tuple(int(i == k) for i in range(4))] for k in (p, u)]
        position = torch.stack([a[column] for a in at]) / scales_of(lens).position_mm
        slope = torch.stack([a[2 + column] for a in at])
        assert torch.allclose(position, wanted[0], rtol=1e-10, atol=1e-12)
        assert torch.allclose(slope, wanted[1], rtol=1e-10, atol=1e-12)
    assert float(by_variable[(0, 0, 0, 0)].abs().max()) == 0


@LENSES
@pytest.mark.parametrize("wavelength_nm", (450.0, LINE_D_NM))
def test_first_and_third_order_are_those_of_traced_rays(lens: Lens, wavelength_nm: float) -> None:
    """Along a line through the axis every output is odd in the step: c1 h + c3 h^3 + ...; exact rays give c1 and c3."""
    e = encoding_of(lens)
    line = torch.randn((4, 5), generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    line = line / line.norm(dim=0)
    found, t = series_of(lens, e, 3, wavelength_nm), truncated(4, 3)
    part = {
        d: found[:, t.exponents.sum(1) == d] @ monomials(line, t.exponents[t.exponents.sum(1) == d]) for d in (1, 3)
    }
    steps = torch.linspace(0.02, 0.2, 12, dtype=torch.float64)
    odd = steps[:, None] ** torch.arange(1, 15, 2)
    values = torch.stack([exact(lens, e, h * line[:2], h * line[2:], wavelength_nm).flatten() for h in steps])
    traced = torch.linalg.lstsq(odd / steps[:, None], values / steps[:, None]).solution
    for row, degree in ((0, 1), (1, 3)):
        wanted = traced[row].reshape(6, -1)
        size = wanted.norm(dim=1, keepdim=True)
        assert float(((part[degree] - wanted) / size).abs().max()) < (1e-8 if degree == 1 else 1e-5)


@LENSES
@pytest.mark.parametrize("degree", (1, 3, 5, 7))
def test_error_falls_by_the_next_order(lens: Lens, degree: int) -> None:
    e = encoding_of(lens)
    rays = 2 * torch.rand((4, 64), generator=torch.Generator().manual_seed(4), dtype=torch.float64) - 1
    found, exponents = series_of(lens, e, degree), truncated(4, degree).exponents
    errors = []
    for h in (0.16, 0.08):
        p, u = h * rays[:2], h * rays[2:]
        errors.append((found @ monomials(h * rays, exponents) - exact(lens, e, p, u, LINE_D_NM)).norm(dim=1))
    order = torch.log2(errors[0] / errors[1])
    assert float(order.min()) > degree + 2 - 0.5
    assert float(order.max()) < degree + 2 + 0.7


def test_symmetry_is_exact() -> None:
    """Exchanging x and y exchanges the outputs; terms that mirror symmetry forbids are zero."""
    t, found = truncated(4, 5), series_of(lens_models.lens(), encoding_of(lens_models.lens()), 5)
    place = {tuple(map(int, x)): k for k, x in enumerate(t.exponents)}
    swapped = [place[(int(b), int(a), int(d), int(c))] for a, b, c, d in t.exponents]
    for x, y in ((0, 1), (2, 3), (4, 5)):
        assert torch.allclose(found[x], found[y][swapped], rtol=1e-12, atol=1e-15 * float(found[x].abs().max()))
        forbidden = torch.from_numpy((t.exponents[:, 0] + t.exponents[:, 2]) % 2 == 0)
        assert float(found[x][forbidden].abs().max()) == 0


def test_odd_aspheres_are_refused() -> None:
    surface = replace(ASPHERIC.surfaces[0], asphere=((3, 1e-5),))
    lens = replace(ASPHERIC, surfaces=(surface, *ASPHERIC.surfaces[1:]))
    with pytest.raises(InputError, match="Taylor"):
        expand(lens, encoding_of(lens), LINE_D_NM, 3)
