"""Grids of rays as areas on film: exact cover, closed forms of folds and rims, and that nothing is lost."""

import math
from dataclasses import replace

import numpy as np
import pytest
from shipped import whole

from neurolens.graph.interpret import evaluate
from neurolens.graph.ir import Graph
from neurolens.optics.lens.apertures import Aperture
from neurolens.optics.lens.designs import coated
from neurolens.optics.readers.lensfile import read_lens
from neurolens.optics.setting.states import set_lens
from neurolens.pictures.flare.canvas import Raster, draw_edges, edges_of
from neurolens.pictures.flare.ghosts import GhostTracer, ghost_pairs
from neurolens.pictures.flare.grids import REACH, grids_of
from neurolens.pictures.flare.job import FlareJob
from neurolens.pictures.flare.lights import Light, light_rays, rays_across
from neurolens.pictures.flare.steps import LOST, entering
from neurolens.pictures.render.colour import SRGB
from neurolens.pictures.render.settings import FlareSettings
from tests.ghost_pictures import ghost_picture
from tests.pictures.flare.test_ghosts import lens_of


def drawn(found: np.ndarray, columns: int, share: float, size: tuple[int, int] = (12, 10)) -> np.ndarray:
    """One channel [H, W]; places in pixels from the middle, x to the left."""
    picture = np.zeros((size[1], size[0], 3), np.float32)
    edges = edges_of(np.ascontiguousarray(found, np.float32), columns, size, 1.0)
    draw_edges(picture, range(size[1]), edges, np.array([len(edges)]), np.full((1, 3), share))
    return picture[..., 1].astype(np.float64)


def lattice(columns: int, rows: int, low: float = 0.0, high: float = 1.0) -> np.ndarray:
    u, v = np.meshgrid(np.linspace(low, high, columns + 1), np.linspace(low, high, rows + 1))
    return np.stack([u.ravel(), v.ravel()])


def rays(xy: np.ndarray, power: float = 1.0, worst: np.ndarray | None = None) -> np.ndarray:
    one = np.ones(xy.shape[1])
    return np.stack([*xy, power * one, 0 * one if worst is None else worst])


@pytest.mark.parametrize("turn", [0.0, 0.3, 2.0, 4.4])
def test_pixels_are_covered_by_their_area(turn: float) -> None:
    """A turned square, cell by cell or as one, against many points in it."""
    cos, sin = math.cos(turn), math.sin(turn)
    place = np.array([[cos, -sin], [sin, cos]]) @ (5 * lattice(1, 1) - 2.2) + 0.37
    whole = drawn(rays(place), 1, 25.0)
    fine = 0.01 * (np.arange(500) + 0.5) - 2.2
    x, y = np.array([[cos, -sin], [sin, cos]]) @ np.stack(np.meshgrid(fine, fine)).reshape(2, -1) + 0.37
    counted = np.histogram2d(y, -x, bins=(np.arange(11) - 5.0, np.arange(13) - 6.0))[0] * 1e-4
    np.testing.assert_allclose(whole, counted, atol=4e-3)
    np.testing.assert_allclose(whole.sum(), 25.0, rtol=1e-6)
    place = np.array([[cos, -sin], [sin, cos]]) @ (5 * lattice(7, 4) - 2.2) + 0.37
    np.testing.assert_allclose(drawn(rays(place), 7, 25 / 28), whole, atol=1e-5)


def test_cells_have_no_borders_where_density_changes_little() -> None:
    """Places x = u + u^2 / 4 have the density 1 / sqrt(1 + x), to 1.5%; cells of one density each are off by 8%."""
    u = lattice(8, 8, -1.0, 1.0)
    found = np.stack([24 * (u[0] + u[0] ** 2 / 4), 24 * u[1]])
    picture = drawn(rays(found), 8, 1.0, (60, 50))
    x = -(np.arange(60) - 29.5) / 24  # to the left
    density = (2 / 8 * 24) ** -2 / np.sqrt(np.maximum(1 + x, 0.01))
    inside = (x > -0.55) & (x < 0.9)  # the outermost cells know one side of their border alone
    assert picture[25][inside] == pytest.approx(density[inside], rel=0.015)
    assert picture.sum() == pytest.approx(64, rel=2e-4)  # slopes end at the middles of border pixels


def test_what_lies_off_the_film_changes_nothing_on_it() -> None:
    """A small film shows the middle of a large one: folded, stretched and cut cells at all borders."""
    rng = np.random.default_rng(4)
    for _ in range(20):
        place, worst = 9 * rng.standard_normal((2, 30)), rng.uniform(0, 2, 30)
        worst[rng.integers(30)] = LOST
        found = rays(place, 0.7, worst)
        large, small = (drawn(found, 5, 3.0, size) for size in ((200, 160), (12, 10)))
        np.testing.assert_allclose(small, large[75:85, 94:106], atol=1e-5 * large.max())
        assert large.min() >= 0


def test_rows_alone_are_those_of_the_whole() -> None:
    """Bit by bit, wherever a picture is cut into strips: cells on and off it, folds, cut cells and points."""
    rng = np.random.default_rng(5)
    place, worst = 9 * rng.standard_normal((2, 42)), rng.uniform(0, 1.5, 42)
    place[:, 14:17] = 0.3  # a cell without area
    edges = edges_of(rays(place, 0.7, worst).astype(np.float32), 6, (40, 30), 2.0)
    given = np.array([len(edges)]), np.array([[1.0, 0.5, -0.2]])
    whole, parts = np.zeros((2, 30, 40, 3), np.float32)
    draw_edges(whole, range(30), edges, *given)
    for rows in (range(7), range(7, 8), range(8, 30)):
        draw_edges(parts, rows, edges, *given)
    assert np.array_equal(whole, parts) and whole.any()


def test_a_fold_is_its_closed_form() -> None:
    """x = u^2 for u from -1 to 1: the light between two places is 2 (sqrt(b) - sqrt(a)), and all is there."""
    u, v = lattice(401, 3)
    place = np.stack([5.5 - 10 * (2 * u - 1) ** 2, 6 * v - 3])
    picture = drawn(rays(place, 2.0), 401, 1 / (401 * 3))
    along = np.sqrt(np.clip((np.arange(13) - 0.5) / 10, 0, 1))  # the fold is half a pixel from the border
    np.testing.assert_allclose(picture.sum(0), 2 * np.diff(along), atol=1e-4)
    assert picture.sum() == pytest.approx(2.0, rel=1e-6)


@pytest.mark.parametrize("cells", [8, 16, 64])
def test_a_rim_cuts_its_circle(cells: int) -> None:
    """The light of a disc: its area, with the square of the cells; and none outside it."""
    place = lattice(cells, cells, -4, 4)
    picture = drawn(rays(place, 1.0, (place**2).sum(0) / 9), cells, (8 / cells) ** 2)
    assert picture.sum() == pytest.approx(9 * math.pi, rel=2 / cells**2)
    y, x = np.mgrid[-4.5:5, -5.5:6]
    np.testing.assert_allclose(picture[np.hypot(x, y) < 2.2], 1.0, atol=1e-4)
    assert picture[np.hypot(x, y) > 3.8].max() < 1e-12


def test_points_and_what_is_no_place_at_all() -> None:
    """Cells that shrink to a point keep their light; light that arrives nowhere, or far away, is not drawn."""
    point = np.full((2, 9), 0.25)
    picture = drawn(rays(point), 2, 0.25)
    assert picture.sum() == pytest.approx(1.0) and np.count_nonzero(picture > 1e-12) <= 4
    for bad in (np.nan, np.inf, 1e20):
        place = lattice(2, 2)
        place[0, 4] = bad
        for worst in (None, np.repeat([0.0, LOST], [8, 1])):
            assert np.isfinite(drawn(rays(place, 1.0, worst), 2, 0.25)).all()
    assert not drawn(rays(lattice(2, 2), 1.0, np.full(9, LOST)), 2, 1.0).any()


CASES = {
    "open": lambda: set_lens(lens_of("laikin_double_gauss_50"), coating="bare"),
    "layers": lambda: set_lens(lens_of("laikin_double_gauss_50"), coating="multi-layer"),
    "blades": lambda: replace(
        set_lens(lens_of("laikin_double_gauss_50"), f_number=5.6), aperture=Aperture(blades=6, curvature=0.3)
    ),
    "phone": lambda: lens_of("phone_lens_6"),
}


@pytest.mark.parametrize(
    ("case", "distance_m"),
    [("blades", math.inf), ("layers", math.inf), ("open", 0.6), *whole(("open", math.inf), ("phone", math.inf))],
)
def test_ghosts_have_the_light_of_their_rays(case: str, distance_m: float) -> None:
    """Every ghost that counts: grid and low-discrepancy rays agree in the light that falls on the film.

    What many layers reflect changes threefold over a ghost, of which its fewest cells leave up to 4% wrong.
    """
    lens, light = CASES[case](), Light(11.0, -6.0, distance_m=distance_m)
    tracer = GhostTracer(lens)
    size = 6.0 if case == "phone" else 36.0
    half = size / 2, size / 3
    given, disc = light_rays(lens, light, 0, 1 << 15)
    found = tracer.trace(given, 550.0)
    on_film = (np.abs(found.film_xy_mm) < np.array(half)[:, None]).all(1)
    expected = disc * np.where(on_film, found.power, 0).mean(1, dtype=np.float64)
    noise = 2 * np.maximum((on_film & (found.power > 0)).sum(1), 1.0) ** -0.75  # of such a sequence
    grids = grids_of(tracer, light, 550.0, half, size / 60)
    for pair, wanted, off in zip(tracer.pairs, expected, noise, strict=True):
        if wanted < 2e-3 * expected.sum():
            continue
        grid = grids[pair]
        rows, area = rays_across(lens, light, grid.places)
        found = tracer.follow(entering(rows), 550.0, only=[pair], reach=REACH)
        edges = edges_of(found.rows[0], grid.columns, (96, 64), 96 / size)
        picture = np.zeros((64, 96, 3), np.float32)
        draw_edges(picture, range(64), edges, np.array([len(edges)]), np.full((1, 3), area * grid.cell))
        assert picture[..., 0].sum(dtype=np.float64) == pytest.approx(
            wanted, rel=(0.04 if case == "layers" else 0.01) + off
        )
    total = sum(w for p, w in zip(tracer.pairs, expected, strict=True) if p not in grids)
    assert total < 1e-3 * expected.sum()


def test_any_number_of_threads_and_layers_is_one_picture() -> None:
    lens, light = lens_of("cooke_triplet_50"), [Light(15.0, 8.0), Light(-4.0, 2.0, (0.1, 0.5, 0.2))]
    job = FlareJob(lens, light, Raster((36.0, 24.0), 48, 32), FlareSettings(bins=1), threads=1)
    one = ghost_picture(job)
    assert np.array_equal(ghost_picture(replace(job, threads=3)), one)
    several = ghost_picture(job, [k % 3 for k in range(15)])
    np.testing.assert_allclose(several.sum(0), one[0], rtol=1e-4, atol=1e-7)


@pytest.mark.parametrize("aperture", [Aperture(5, 20.0), Aperture(9, 3.0, 0.6), Aperture(3, curvature=1.0)])
def test_blades_have_a_rim(aperture: Aperture) -> None:
    """It is 1 where the opening ends, and has no jump there."""
    g, xy = Graph(), np.random.default_rng(1).uniform(-3, 3, (2, 4000))
    point, radius = g.input("xy", 2), g.input("radius", per_call=True)
    g.outputs["rim"], opened = aperture.rim(g, point, radius, LOST), aperture.opening(g, point, radius)
    g.outputs["open"] = g.select(opened, 1.0, 0.0)
    found = evaluate(g, {"xy": xy, "radius": np.array([[2.5]])})
    assert np.array_equal(found["rim"][0] <= 1, found["open"][0] > 0)
    near = evaluate(g, {"xy": xy + 1e-6, "radius": np.array([[2.5]])})
    assert np.abs(near["rim"] - found["rim"]).max() < 1e-5


@pytest.mark.parametrize(("u", "v"), [(1, 0), (0, 1), (1, 1), (-1, 1)])
def test_where_rays_are_lost_light_is_as_dense_as_beside(u: int, v: int) -> None:
    """Of an even light half of whose rays are lost: nowhere brighter, and lit to half a cell from the others."""
    place, (y, x) = lattice(9, 9, -4, 4), np.mgrid[:10, :10]
    lost = (u * x + v * y).ravel() > np.median(u * x + v * y)
    picture = drawn(rays(np.where(lost, np.nan, place), 1.0, np.where(lost, LOST, 0.0)), 9, (8 / 9) ** 2)
    assert picture.max() < 1 + 1e-5
    assert picture.sum() == pytest.approx(64 * np.mean(~lost), rel=0.02)


def test_a_ghost_that_a_rim_cuts_by_colour_has_no_bands() -> None:
    """The six blades at f/8 cut ghost g07-06 of the retrofocus lens across the whole film between 400 and 550 nm.

    The reference draws the ghost with all 60 wavelengths. Four wavelengths differ from it by 44% of the peak.
    """
    lens = lens_of("tajima_retrofocus_24", f_number=8.0).with_aperture(Aperture(blades=6))
    tracer = GhostTracer(lens, [pair for pair in GhostTracer(lens).pairs if pair.name == "g07-06"])
    job = FlareJob(lens, [Light(13.7, 10.0)], Raster((36.0, 24.0), 180, 120), ghosts=tracer)
    picture = ghost_picture(job)[0]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("neurolens.pictures.flare.layers.FEWEST", 60)
        fine = ghost_picture(job)[0]
    assert np.abs(picture - fine).max() < 0.05 * fine.max()
    assert np.abs(np.diff(picture[5], axis=0)).max() < 1.5 * np.abs(np.diff(fine[5], axis=0)).max()


@pytest.mark.parametrize(
    ("name", "coating"),
    [("cooke_triplet_50", "multi-layer"), *whole(*(("tajima_retrofocus_24", c) for c in ("bare", "multi-layer")))],
)
def test_a_picture_of_all_ghosts_has_no_bands(name: str, coating: str) -> None:
    """Ghosts that are seen beside the others get the wavelengths that they need; faint ones keep few.

    With four wavelengths for every ghost one pixel in twenty is off by 26% of its own value where the retrofocus is
    bare, and by 34% where a coating reflects other shares of light at the wavelengths that a traced one stands for.
    """
    lens = lens_of(name, f_number=8.0).with_aperture(Aperture(blades=6))
    lens = coated(lens, coating)
    job = FlareJob(lens, [Light(13.7, 10.0)], Raster((36.0, 24.0), 120, 80), FlareSettings(bins=4))
    picture = ghost_picture(job)[0]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("neurolens.pictures.flare.layers.FEWEST", 16)
        fine = ghost_picture(job)[0]
    assert np.quantile(np.abs(picture - fine).max(-1) / fine.max(-1).clip(1e-30), 0.95) < 0.1
    assert np.abs(picture.sum((0, 1)) / fine.sum((0, 1)) - 1).max() < 0.1  # each colour's light


def test_a_caustic_takes_no_light_from_beside_it() -> None:
    """A cell with a caustic in one half keeps the other half's density: no pixel has a negative luminance."""
    lens = read_lens("lenses/tajima_retrofocus_24.toml").with_aperture(Aperture(blades=6))
    lens = set_lens(lens, focus_m=40.0, f_number=2.8, focus_mode="best")
    tracer = GhostTracer(lens, [pair for pair in ghost_pairs(lens) if pair.name == "g11-06"])
    light = Light(13.7266, 10.0068, (2.57, 1.6, 0.67))
    job = FlareJob(lens, [light], Raster((36.0, 24.0), 640, 427), ghosts=tracer)
    luminance = ghost_picture(job)[0] @ SRGB.to_xyz[1]
    assert luminance.min() > -1e-6 * luminance.max()
