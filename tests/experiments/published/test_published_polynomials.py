"""Published polynomials: frame, choice of terms, pupil tests; Taylor series against first order and traced rays."""

import math
from dataclasses import replace

import lens_models
import numpy as np
import pytest
import torch
from hypothesis import given, strategies as some

from experiments.accuracy.published import PublishedSettings, fit_any
from experiments.accuracy.published.data import RawData, from_tangents, to_tangents
from experiments.accuracy.published.polynomials import Pursuit
from experiments.accuracy.published.taylor import expand, truncated
from neurolens.base import status as st
from neurolens.base.errors import InputError
from neurolens.graph.interpret import evaluate, monomials
from neurolens.graph.ir import Graph
from neurolens.models.fitted import Encoding
from neurolens.models.pairs import sample_domain, trace_pairs
from neurolens.models.polynomial import ideal_map
from neurolens.models.targets import fit_encoding, scales_of
from neurolens.optics.lens.figures import Figure
from neurolens.optics.lens.glass import LINE_D_NM
from neurolens.optics.lens.prescription import Lens, Surface
from neurolens.optics.trace.rays import Rays, trace

FAST = {"dense": PublishedSettings("hanika", degree=3), "sparse": PublishedSettings("schrade", degree=5, terms=12)}


@given(some.floats(-0.9, 0.9), some.floats(-0.4, 0.4), some.floats(-1, 1), some.floats(-1, 1), some.floats(-0.99, 0.99))
def test_tangents_and_back_is_the_same_direction(x: float, y: float, a: float, b: float, c: float) -> None:
    # The normal of the sphere towards the scene, and any direction within 90 degrees of it.
    normal = torch.tensor([c * x, c * y, -((1 - (c * x) ** 2 - (c * y) ** 2) ** 0.5)], dtype=torch.float64)
    across = torch.linalg.cross(normal, torch.tensor([0.6, 0.0, 0.8], dtype=torch.float64))
    direction = normal + a * across + b * torch.linalg.cross(normal, across)
    direction = (direction / direction.norm())[:, None]
    position, g = torch.tensor([[x], [y]], dtype=torch.float64), Graph()
    tangents = to_tangents(position, list(direction), c)
    assert float(tangents.norm()) == pytest.approx(float(torch.linalg.cross(direction[:, 0], normal).norm()), abs=1e-12)
    g.outputs["d"] = from_tangents(g.input("position", 2), g.input("tangents", 2), c)
    back = evaluate(g, {"position": position, "tangents": tangents})["d"]
    torch.testing.assert_close(back, direction, rtol=0, atol=1e-12)


def test_lenses_with_cylinders_are_refused() -> None:
    prepared = lens_models.prepared()
    encoding = fit_encoding(prepared.pairs.domain, prepared.pairs.train, mirror=True)
    with pytest.raises(InputError, match="round about its axis"):
        RawData.of(replace(prepared, encoding=encoding))


def test_pursuit_adds_the_term_that_leaves_least_and_replacement_only_helps() -> None:
    generator = np.random.default_rng(1)
    columns = generator.normal(size=(14, 60)) + generator.normal(size=60)  # strongly correlated candidates
    target = generator.normal(size=60)

    def left(chosen: list[int]) -> float:
        fit, *_ = np.linalg.lstsq(columns[chosen].T, target, rcond=None)
        return float(((columns[chosen].T @ fit - target) ** 2).sum())

    greedy: list[int] = []
    for _ in range(4):
        greedy.append(min((k for k in range(14) if k not in greedy), key=lambda k: left([*greedy, k])))
    plain = Pursuit(columns, target)
    assert plain.run(4, passes=0) == sorted(greedy)
    assert plain.error() == pytest.approx(left(greedy), rel=1e-9)
    exchanged = Pursuit(columns, target)
    chosen = exchanged.run(4)
    assert exchanged.error() == pytest.approx(left(chosen), rel=1e-9)
    assert left(chosen) <= left(greedy) * (1 + 1e-12)
    # No single exchange helps any more.
    for k in chosen:
        rest = [c for c in chosen if c != k]
        assert min(left([*rest, c]) for c in range(14) if c not in rest) >= left(chosen) * (1 - 1e-6)


@pytest.mark.parametrize("label", FAST)
def test_pupil_tests_are_those_of_the_exact_rims(label: str) -> None:
    """The tests of the outer and the inner pupil stop a ray where it crosses those rims outside, bar their fit."""
    prepared = lens_models.prepared()
    pairs, lens = prepared.pairs, prepared.pairs.lens
    model = fit_any(prepared, FAST[label])
    last = len(lens.surfaces) - 1
    assert [g.surface for g in model.gates] == [last, 0]
    rays = trace_pairs(lens, sample_domain(pairs.domain, 4000, 3), pairs.domain.pupil_z_mm)
    _, scalars = model.core(model.encoding(rays.inputs))
    for gate, values in zip(model.gates, scalars[1:], strict=True):
        radius = lens.surfaces[gate.surface].semi_diameter_mm
        exact = (rays.cross_x[gate.surface] ** 2 + rays.cross_y[gate.surface] ** 2) / radius**2 - 1
        known = (rays.status == st.PASSED) | (rays.status % 4 == st.RIM)
        clear = known & (exact.abs() > 0.15)  # the inner pupil is a disc in the vertex's plane
        assert float(((values > 0) == (exact > 0))[clear].double().mean()) > 0.995


# Conic and even powers, and a stop between.
ASPHERIC = Lens(
    "aspheric",
    "made up",
    (
        Surface(21.0, 5.0, 24.0, 1.62, figure=Figure(conic=-0.8, asphere=((4, 2e-6), (6, 1e-9)))),
        Surface(-160.0, 3.0, 22.0),
        Surface(math.inf, 4.0, 10.0, stop=True),
        Surface(-30.0, 2.0, 16.0, 1.7),
        Surface(55.0, 40.0, 18.0, figure=Figure(conic=2.0)),
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
    surface = replace(ASPHERIC.surfaces[0], figure=replace(ASPHERIC.surfaces[0].figure, asphere=((3, 1e-5),)))
    lens = replace(ASPHERIC, surfaces=(surface, *ASPHERIC.surfaces[1:]))
    with pytest.raises(InputError, match="Taylor"):
        expand(lens, encoding_of(lens), LINE_D_NM, 3)
