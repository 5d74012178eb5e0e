"""Onion rings: against the exact trace of a lens with another asphere, and against the closed form of a thin lens."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from shipped import whole

from neurolens.base.errors import InputError
from neurolens.cameras.build import make_camera
from neurolens.cameras.exact import ExactCamera
from neurolens.graph.compiler import has_compiler
from neurolens.optics.lens.prescription import Lens
from neurolens.optics.lens.shot import Shot
from neurolens.optics.readers.any_format import read_any
from neurolens.optics.trace.aiming import without_rims
from neurolens.optics.trace.rays import trace
from neurolens.optics.trace.surfaces import Rays
from neurolens.pictures.defocus.kernels import Grooves, Kernel, aspheres, kernel_at, moves, own_plate, responses

ROOT = Path(__file__).parents[3]
N, FOCAL = 1.5, 50.0
PLANO = f"""\
schema = 1
name = "Plano-asphere"
f_number = 8
efl_mm = {FOCAL}
image_radius_mm = 3
rims = "source"
source = "this test"
surfaces = [
  {{ radius_mm = inf, thickness_mm = 0.2, diameter_mm = 6.25, n_d = {N}, stop = true }},
  {{ radius_mm = {-FOCAL * (N - 1)}, thickness_mm = {FOCAL}, diameter_mm = 7, conic = {-(N**2)} }},
]
"""  # on the side of the film a hyperboloid of this conic makes a parallel beam a point


def rays_of(place: np.ndarray, way: np.ndarray) -> Rays:
    return Rays(*map(torch.from_numpy, (*place, *(way / np.linalg.norm(way, axis=0)))))


def numbers(rays: Rays) -> np.ndarray:
    return np.stack([v.numpy() for v in rays])


def with_power(lens: Lens, k: int, power: int, more: float) -> Lens:
    terms = dict(lens.surfaces[k].figure.asphere)
    terms[power] = terms.get(power, 0.0) + more
    surface = replace(lens.surfaces[k], figure=replace(lens.surfaces[k].figure, asphere=tuple(sorted(terms.items()))))
    return replace(lens, surfaces=(*lens.surfaces[:k], surface, *lens.surfaces[k + 1 :]))


@pytest.mark.parametrize("number", [0, 1])
def test_light_moves_as_the_exact_trace_of_a_changed_asphere_moves_it(number: int) -> None:
    """A term a r^6 more on one surface: rays from a point through the same place of it, traced to the film."""
    camera = ExactCamera(read_any(ROOT / "lenses" / "canon_aspheric_50.toml"), Shot((12.0, 8.0), 2.0))
    lens, film_z, k = without_rims(camera.lens), float(camera.film.film_z_mm), aspheres(camera)[number]
    power, more, count = 6, 1e-12, 40
    film, square = np.tile([[3.0], [2.0]], (1, count)), np.random.default_rng(0).random((2, count))
    nm = np.full(count, 550.0)
    radius, *response = responses(camera, film, square, nm)[number]
    predicted = (
        np.array(response[:2]) * more * power * radius ** (power - 1) + np.array(response[2:]) * more * radius**power
    )
    pupil, _ = camera.film.outline.sample(*(v.astype(np.float32) for v in (film, square, nm)))
    way = np.stack([*(pupil - film), np.full(count, camera.film.outline.pupil_z_mm - film_z)])
    traced = trace(lens, rays_of(np.stack([*film, np.full(count, film_z)]), way), torch.from_numpy(nm), path=True)
    wanted, out = numbers(traced.path[-1 - k])[:2], numbers(traced.rays)
    point = out[:3] + 2000 * out[3:]  # of the scene, for each ray its own

    def shot(lens: Lens, aim: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Where a ray from the point meets the film and the surface."""
        way = np.stack([*(out[:2] + aim), out[2]]) - point
        there = trace(lens, rays_of(point + 0.9 * way, way), torch.from_numpy(nm), towards="film", path=True)
        end = numbers(there.rays)
        return end[:2] + (film_z - end[2]) / end[5] * end[3:5], numbers(there.path[k])[:2]

    changed, aim, step = with_power(lens, k, power, more), np.zeros((2, count)), 1e-4
    for _ in range(6):  # Newton's method: through the same place of the surface
        _, met = shot(changed, aim)
        slopes = np.stack([(shot(changed, aim + step * np.eye(2)[:, [i]])[1] - met) / step for i in (0, 1)], 1)
        aim = aim + np.linalg.solve(slopes.transpose(2, 0, 1), (wanted - met).T[..., None])[..., 0].T
    moved = shot(changed, aim)[0] - film
    assert np.abs(predicted - moved).max() < 0.005 * np.abs(moved).max()


@pytest.fixture
def plano(tmp_path: Path) -> Path:
    path = tmp_path / "plano.toml"
    path.write_text(PLANO, encoding="utf-8")
    return path


def test_a_groove_on_a_thin_lens_turns_light_like_a_prism(plano: Path) -> None:
    """By the slope times n - 1, over the distance to the film; towards the thicker glass."""
    camera = ExactCamera(read_any(plano), Shot((4.0, 3.0), math.inf))
    film, square = np.zeros((2, 200)), np.random.default_rng(1).random((2, 200))
    grooves = Grooves(10.0, 0.3)
    response = responses(camera, film, square, np.full(200, 587.56))
    height, slope = grooves.heights(response[0, 0])
    assert height.max() <= 1e-5 and slope.max() == pytest.approx(2 * math.pi * 1e-5 / 0.3, rel=0.01)
    np.testing.assert_allclose(
        np.hypot(*moves(response, grooves)), FOCAL * (N - 1) * np.abs(slope), rtol=0.03, atol=1e-6
    )


@pytest.mark.skipif(not has_compiler(), reason="kernels take a C compiler")
def test_a_disc_has_the_rings_of_a_zone_plate_and_its_energy(plano: Path) -> None:
    """Light of the pupil's radius r arrives at m r + f (n - 1) h'(r)."""
    camera, size = make_camera(f"fused:{plano}", Shot((4.0, 3.0), math.inf)), (1600, 1200)
    plate, grooves, near = own_plate(camera, size), Grooves(15.0, 0.5), 5.0
    place = size[0] / 2, size[1] / 2
    plain, ringed = (kernel_at(camera, plate, place, near, place, grooves=g) for g in (None, grooves))
    assert plain is not None and ringed is not None
    np.testing.assert_allclose(ringed.energy, plain.energy, rtol=0.003)
    radius = FOCAL / 8 / 2 * np.sqrt((np.arange(200_000) + 0.5) / 200_000)

    def found(kernel: Kernel) -> tuple[np.ndarray, np.ndarray]:
        """Distances from the axis in mm, and the light there."""
        green = kernel.light[..., 1] / kernel.light[..., 1].sum(dtype=np.float64)
        y, x = np.mgrid[: green.shape[0], : green.shape[1]] + 0.5 - np.array(place).reshape(2, 1, 1)[::-1]
        return np.hypot(x + kernel.corner_px[0], y + kernel.corner_px[1]) * camera.film_mm[0] / size[0], green

    away, light = found(plain)
    grown = radius * math.sqrt((light * away**2).sum() / (radius**2).mean())
    assert grown[-1] == pytest.approx(radius[-1] * FOCAL * near / 1000, rel=0.02)  # in focus behind the film
    edges = np.linspace(0, grown[-1], 40)
    shares = [np.histogram(v, edges, weights=w)[0] for v, w in ((away, light), found(ringed))]
    moved = grown + FOCAL * (N - 1) * grooves.heights(radius)[1]
    expected = [np.histogram(v, edges)[0] / len(radius) for v in (grown, moved)]
    change, meant = shares[1] - shares[0], expected[1] - expected[0]
    assert np.abs(meant).sum() > 0.1 and np.abs(change - meant).sum() < 0.15 * np.abs(meant).sum()


def test_lenses_without_aspheres_and_grooves_too_fine_are_refused() -> None:
    with pytest.raises(InputError, match="lens with aspheres"):
        aspheres(make_camera("thin", Shot((36.0, 24.0), 2.0)))
    with pytest.raises(InputError, match="lens with aspheres"):
        aspheres(ExactCamera(read_any(ROOT / "lenses" / "laikin_double_gauss_50.toml"), Shot((36.0, 24.0), 2.0)))


@pytest.mark.parametrize("away", [0.0, *whole(444.5)])
def test_grooves_finer_than_a_pixel_leave_no_checkerboard_but_rings_where_those_of_two_aspheres_beat(
    away: float,
) -> None:
    camera = make_camera("fused:canon_aspheric_50", Shot((36.0, 24.0), 2.0, f_number=1.2))
    plate = own_plate(camera, (2000, 1333))
    place, w = (1000.0, 666.5 - away), 1 / (6 - plate.pinhole.before_film_mm / 1000)
    kernel = kernel_at(camera, plate, place, w, place, colours=2, grooves=Grooves(60.0, 0.5))
    assert kernel is not None
    light = kernel.light[..., 1].astype(np.float64)
    height, width = light.shape
    cells = light[: height // 8 * 8, : width // 8 * 8].reshape(height // 8, 8, width // 8, 8).swapaxes(1, 2)
    lit = cells.min(axis=(2, 3)) > 0.3 * light[light > 0].mean()  # without the rim
    board = (cells * (-1.0) ** np.add.outer(np.arange(8), np.arange(8))).mean(axis=(2, 3))
    assert np.abs(board[lit] / cells.mean(axis=(2, 3))[lit]).max() < 0.01
    middle = light[height // 2 - 8 : height // 2 + 8, width // 2]
    assert away or middle.std() > 0.3 * middle.mean()  # without grooves 0.11
