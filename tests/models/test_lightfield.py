"""The coordinates that surrogates see, what symmetry and free space promise of them, and their planes."""

import math
from dataclasses import replace
from functools import cache
from pathlib import Path

import pytest
import torch
from torch import Tensor

from neurolens.graph.interpret import evaluate
from neurolens.graph.ir import Graph
from neurolens.models.assemble import DirectionSeries
from neurolens.models.cores import angle_vector
from neurolens.models.fit import Prepared, prepare
from neurolens.models.fitted import Encoding, FilmRays
from neurolens.models.pairs import PairSettings, domain_of, make_pairs
from neurolens.models.polynomial import fit_planes, shifted
from neurolens.models.targets import targets_of
from neurolens.models.terms import invariant_exponents, monomials, solve, vector_columns
from neurolens.optics.readers.lensfile import read_lens

ENCODING = Encoding(50.0, 10.0, 0.3, 20.0, 7.0, 4.1, 2.1)


def some_rays(count: int = 500) -> FilmRays:
    g = torch.Generator().manual_seed(0)
    u = 2 * torch.rand((6, count), generator=g, dtype=torch.float64) - 1
    return FilmRays(20 * u[0], 20 * u[1], 52 + 2 * u[2], 7 * u[3], 7 * u[4], 550 + 150 * u[5])


def turn(v: Tensor, angle: float, mirror: bool) -> Tensor:
    c, s = math.cos(angle), math.sin(angle)
    x = -v[0] if mirror else v[0]
    return torch.stack([c * x - s * v[1], s * x + c * v[1]])


@pytest.mark.parametrize(("angle", "mirror"), [(0.3, False), (math.pi / 2, False), (-2.0, True), (0.0, True)])
def test_invariants_do_not_turn_and_vectors_do(angle: float, mirror: bool) -> None:
    rays = some_rays()
    film = turn(torch.stack([rays.film_x, rays.film_y]), angle, mirror)
    pupil = turn(torch.stack([rays.pupil_x, rays.pupil_y]), angle, mirror)
    turned = replace(rays, film_x=film[0], film_y=film[1], pupil_x=pupil[0], pupil_y=pupil[1])
    one, two = ENCODING(rays), ENCODING(turned)
    torch.testing.assert_close(one.invariants(), two.invariants(), rtol=0, atol=1e-13)
    torch.testing.assert_close(turn(one.p, angle, mirror), two.p, rtol=0, atol=1e-14)
    torch.testing.assert_close(turn(one.u, angle, mirror), two.u, rtol=0, atol=1e-14)


def test_the_start_may_move_along_the_ray() -> None:
    """Free space is linear: one ray, described from any film plane, is one light field."""
    rays = some_rays()
    for z in (45.0, 50.0, 80.0):
        k = (z - 10.0) / (rays.film_z - 10.0)
        moved = replace(
            rays,
            film_x=rays.pupil_x + k * (rays.film_x - rays.pupil_x),
            film_y=rays.pupil_y + k * (rays.film_y - rays.pupil_y),
            film_z=torch.full_like(rays.film_z, z),
        )
        for a, b in zip(ENCODING(rays), ENCODING(moved), strict=True):
            torch.testing.assert_close(a, b, rtol=0, atol=1e-13)


def directions(count: int = 2000, most_degrees: float = 125.0) -> Tensor:
    """[3, count] unit camera directions from the axis to `most_degrees`, the axis and tiny angles among them."""
    theta = torch.cat([torch.tensor([0.0, 1e-300, 1e-15, 1e-8, 1e-4]), torch.linspace(0, most_degrees, count - 5)])
    theta = torch.deg2rad(theta.double())
    phi = torch.linspace(0, 40, count, dtype=torch.float64)
    return torch.stack([theta.sin() * phi.cos(), theta.sin() * phi.sin(), -theta.cos()])


def decoded(series: DirectionSeries, vector: Tensor) -> Tensor:
    g = Graph()
    g.outputs["d"] = series.decode(g.input("v", 2))
    return evaluate(g, {"v": vector})["d"]


def test_directions_come_back_from_angle_vectors_and_from_slopes() -> None:
    d, near = directions(), directions(most_degrees=85.0)
    torch.testing.assert_close(decoded(DirectionSeries.exact(), angle_vector(*d)), d, rtol=0, atol=1e-13)
    torch.testing.assert_close(decoded(DirectionSeries(1.0), near[:2] / -near[2]), near, rtol=0, atol=1e-13)


@pytest.mark.parametrize("degrees", [1.0, 20.0, 60.0, 112.0])
def test_short_series_hold_directions_to_the_last_bit_of_float32(degrees: float) -> None:
    series = DirectionSeries.fitted(math.radians(degrees))
    d = directions(most_degrees=degrees)
    torch.testing.assert_close(decoded(series, series.kappa * angle_vector(*d)), d, rtol=0, atol=6e-8)


ROOT = Path(__file__).parents[2] / "lenses"


@cache
def prepared(stem: str = "angenieux_retrofocus_35") -> Prepared:
    """Focused from infinity to 1 m, so that the film planes of the rays differ."""
    lens = read_lens(ROOT / f"{stem}.toml")
    return prepare(make_pairs(lens, domain_of(lens, focus_m=(math.inf, 1.0)), PairSettings(4000, 4000, 4000)))


SHIFTS = [(0.0, 0.0), (-0.6, 0.2), (0.3, -0.2), (1.2, 0.5)]


@pytest.mark.parametrize("shift", SHIFTS)
def test_shifts_are_what_they_say(shift: tuple[float, float]) -> None:
    """q is along p - m u and the new u along u - k q, for every ray, whatever its film plane."""
    pairs, encoding = prepared().pairs, prepared().encoding
    old, new = encoding(pairs.train.inputs), shifted(encoding, pairs.train, shift)(pairs.train.inputs)
    q = old.p - shift[1] * old.u
    for got, wanted in ((new.p, q), (new.u, old.u - shift[0] * q)):
        scale = (got * wanted).sum() / (wanted * wanted).sum()
        assert abs(scale) > 0
        torch.testing.assert_close(got, scale * wanted, rtol=0, atol=1e-12)
        assert float(got.norm(dim=0).max()) == pytest.approx(1)


@pytest.mark.parametrize("shift", SHIFTS[1:])
def test_full_degree_fits_do_not_see_the_planes(shift: tuple[float, float]) -> None:
    """A linear change of variables: what all terms of a degree tell together stays the same."""
    pairs = prepared().pairs
    found = []
    for encoding in (prepared().encoding, shifted(prepared().encoding, pairs.train, shift)):
        targets = targets_of(pairs.lens, encoding, pairs.train)
        columns = vector_columns(monomials(targets.field.invariants(), invariant_exponents(2)), targets.field)
        found.append(solve(columns, targets.vectors[:2].flatten(1)) @ columns)
    torch.testing.assert_close(found[0], found[1], rtol=0, atol=1e-9)


def test_too_few_rays_for_a_trial_leave_the_planes_alone() -> None:
    pairs = replace(prepared().pairs, train=prepared().pairs.train.select(slice(0, 50)))
    assert fit_planes(pairs, prepared().encoding, 40, 2.0) is prepared().encoding


def test_lenses_with_cylinders_keep_their_planes() -> None:
    encoding = Encoding(50.0, 10.0, 0.3, 20.0, 7.0, 4.1, 2.1, chief_y=0.2, pupil_scale_y_mm=6.0)
    assert fit_planes(prepared().pairs, encoding, 40, 2.0) is encoding
