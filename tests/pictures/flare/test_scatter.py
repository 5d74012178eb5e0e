"""Light that scatters in a lens, and reflection chosen more often than it happens: closed forms, and nothing lost."""

import math

import numpy as np
import pytest
import torch

from neurolens.base.errors import InputError
from neurolens.base.status import PASSED
from neurolens.optics.lens.prescription import Lens, Surface
from neurolens.optics.readers.lensfile import read_lens
from neurolens.optics.setting.states import set_lens
from neurolens.optics.trace.rays import Rays, follow, turning
from neurolens.pictures.flare.canvas import Raster
from neurolens.pictures.flare.ghosts import GhostTracer, ghost_pairs
from neurolens.pictures.flare.job import FlareJob
from neurolens.pictures.flare.layers import _smoothed, photon_picture
from neurolens.pictures.flare.lights import Light, light_rays
from neurolens.pictures.flare.photons import LEVELS, Photons, PhotonTracer
from neurolens.pictures.render.colour import SRGB
from neurolens.pictures.render.settings import FlareSettings, Scatter
from tests.pictures.flare.test_ghosts import LENSES, lens_of

COUNT = 1 << 17


def two_planes(n: float, thickness_mm: float, radius_mm: float, to_film_mm: float = 10.0) -> Lens:
    """A medium between two planes of equal rims, the second the stop, and the film."""
    first = Surface(math.inf, thickness_mm, 2 * radius_mm, n)
    second = Surface(math.inf, to_film_mm, 2 * radius_mm, stop=True)
    return Lens("two planes", "", (first, second), 2.0, film_z_mm=thickness_mm + to_film_mm)


def beam(count: int = COUNT) -> np.ndarray:
    """Along the axis."""
    return np.repeat(np.array([[0.0, 0, -1, 0, 0, 1]]).T, count, 1)


def check_books(found: Photons, cut: int = 0) -> None:
    assert found.cast == found.reflections.size + found.left + found.stopped + found.absorbed + found.cut
    assert found.cut <= cut and found.weight.size == found.scattered.size == found.reflections.size


def agrees(number: int, share: float, cast: int) -> None:
    """Within four standard deviations of a binomial."""
    assert number == pytest.approx(cast * share, abs=4 * math.sqrt(cast * share * (1 - share)) + 1)


def test_an_empty_tube_is_lamberts() -> None:
    """Light that meets the wall once on its way to the far end: the form factor of a ring of a cylinder to its base,
    (H^2 + 2) / (2 sqrt(H^2 + 4)) - H / 2 at H radii from it. A white tube swallows nothing."""
    length, radius, albedo = 30.0, 10.0, 0.6
    lens = two_planes(1.0, length, radius, 1e-3)
    generator = np.random.default_rng(5)
    place, angle = radius * np.sqrt(generator.random(COUNT)), math.radians(35)
    turn = 2 * math.pi * generator.random(COUNT)
    still = np.ones(COUNT)
    rays = np.stack([place * np.cos(turn), place * np.sin(turn), 0 * still, math.sin(angle) * still, 0 * still,
                     math.cos(angle) * still])  # fmt: skip
    found = PhotonTracer(lens, Scatter(barrel=albedo, gloss=0.0)).trace(rays, 550.0)
    check_books(found)
    z = (np.sqrt(radius**2 - rays[1] ** 2) - rays[0]) / math.tan(angle)
    h = (length - z[z < length]) / radius
    expected = albedo * ((h * h + 2) / (2 * np.sqrt(h * h + 4)) - h / 2).sum() / COUNT
    agrees(int((found.scattered == 0).sum()), float((z >= length).mean()), COUNT)
    agrees(int((found.scattered == 1).sum()), expected, COUNT)
    for gloss in (0.0, 0.7):
        white = PhotonTracer(lens, Scatter(barrel=1.0, gloss=gloss)).trace(rays, 550.0)
        check_books(white)
        assert white.stopped <= 1e-4 * COUNT and (white.scattered > 0).any()


def test_a_stop_is_a_plate() -> None:
    """White, it sends back what it does not let through: a wide tube before a narrow stop keeps no light."""
    front = Surface(math.inf, 20.0, 30.0)
    lens = Lens("hole", "", (front, Surface(math.inf, 10.0, 10.0, stop=True)), 2.0, film_z_mm=30.0)
    rays, _ = light_rays(lens, Light(0.0, 0.0), 0, 1 << 14)
    found = PhotonTracer(lens, Scatter(barrel=1.0, gloss=0.0)).trace(rays, 550.0)
    check_books(found)
    direct = int((found.scattered == 0).sum())
    assert direct == (np.hypot(*rays[:2]) <= 5.0).sum()
    assert found.stopped <= 1e-4 * found.cast and found.left > 0.5 * (found.cast - direct)
    assert 0 < (found.scattered > 0).sum() < 0.2 * found.cast


def test_film_and_window_are_a_geometric_series() -> None:
    """Parallel planes: of T (1 - s) (s R)^m, light comes to the film after m reflections there."""
    share, lens = 0.3, two_planes(1.9, 4.0, 200.0)
    found = PhotonTracer(lens, Scatter(sensor=share, mirror=1.0)).trace(beam(), 550.0, most_reflections=100)
    check_books(found)
    r = (0.9 / 2.9) ** 2
    back, through = 2 * r / (1 + r), (1 - r) / (1 + r)
    for m in range(3):
        agrees(int((found.scattered == m).sum()), through * (1 - share) * (share * back) ** m, COUNT)
    agrees(found.reflections.size, through * (1 - share) / (1 - share * back), COUNT)
    # By Lambert's law what comes back lies round about, over twice the gap's way by tan: half of it within 45 degrees.
    diffuse = PhotonTracer(lens, Scatter(sensor=share, mirror=0.0)).trace(beam(), 550.0, most_reflections=100)
    check_books(diffuse)
    once = (diffuse.scattered == 1) & (diffuse.reflections == 1)
    assert 15 < np.median(np.hypot(*diffuse.film_xy_mm[:, once])) < 30


def test_dust_takes_its_share_and_turns_it_as_henyey_and_greenstein() -> None:
    share, g, gap = 0.2, 0.95, 10.0
    lens = two_planes(1.0, gap, 2000.0, gap)
    found = PhotonTracer(lens, Scatter(dust=share, dust_forward=g)).trace(beam(), 550.0)
    check_books(found)
    agrees(int((found.scattered == 0).sum()), 1 - share, COUNT)
    assert set(found.scattered) == {0, 1}
    off = np.hypot(*found.film_xy_mm[:, found.scattered == 1])
    for degrees in (2.0, 10.0, 45.0, 80.0):
        c = math.cos(math.radians(degrees))
        within = (1 - g * g) / (2 * g) * (1 / (1 - g) - 1 / math.sqrt(1 + g * g - 2 * g * c))
        agrees(int((off < 2 * gap * math.tan(math.radians(degrees))).sum()), share * within, COUNT)
    agrees(found.left, share * (1 - (1 - g * g) / (2 * g) * (1 / (1 - g) - 1 / math.sqrt(1 + g * g))), COUNT)


def test_haze_is_beers_law_and_single_scattering() -> None:
    """Unscattered exp(-mu d); scattered once, isotropically, and through: the integral of mu e^(-mu z) E2 / 2."""
    mu, d = 0.15, 6.0
    lens = two_planes(1.0000001, d, 3e4)
    scatter = Scatter(haze_per_mm=mu, haze_forward=0.0)
    found = PhotonTracer(lens, scatter).trace(beam(), 550.0)
    check_books(found)
    agrees(int((found.scattered == 0).sum()), math.exp(-mu * d), COUNT)
    c, z = (np.arange(2000) + 0.5) / 2000, d * (np.arange(2000) + 0.5) / 2000
    second = np.exp(-mu * (d - z)[:, None] / c).mean(1)
    once = d * (mu * np.exp(-mu * z) * second / 2).mean()
    agrees(int((found.scattered == 1).sum()), once, COUNT)
    # In glass: the same, times what its surfaces let through; none is absorbed.
    glass = PhotonTracer(two_planes(1.5, d, 100.0), scatter).trace(beam(), 550.0, most_reflections=100)
    check_books(glass, COUNT // 50)  # total reflection between planes goes on for long
    assert glass.absorbed == 0
    agrees(int((glass.scattered + glass.reflections == 0).sum()), 0.96**2 * math.exp(-mu * d), COUNT)


def _centre(xy: np.ndarray, weight: np.ndarray) -> tuple[np.ndarray, float]:
    """Mean place on a film 60 mm wide, and its standard deviation along an axis."""
    on = np.abs(xy).max(0) < 30
    mean = np.average(xy[:, on], 1, weight[on])
    return mean, math.sqrt(float(np.average((xy[:, on] - mean[:, None]) ** 2, 1, weight[on]).max()))


def _four_reflections(lens: Lens, rays: np.ndarray) -> float:
    """Mean power of rays [6, N] that arrives after exactly four reflections, path by path in float64."""
    start, count = Rays(*torch.from_numpy(rays)), len(lens.surfaces)
    turns = [pair.reflections for pair in ghost_pairs(lens)]
    paths = [(*before, *after) for before in turns for after in turns if after[0] > before[1]]
    found = [follow(lens, start, turning(count, path), 550.0) for path in paths]
    return sum(float(torch.where(f.status == PASSED, f.power, 0.0).mean()) for f in found)


def test_any_boost_gives_the_light_of_all_paths() -> None:
    """Of two and of four reflections: the sums over all pairs and over all paths of four, and the same places."""
    # Bare, for of so many photons coated glass reflects one twice and none four times without a boost.
    lens = set_lens(read_lens(LENSES / "cooke_triplet_50.toml"), focus_m=math.inf, coating="bare")
    light = Light(15.0, 8.0)
    rays, _ = light_rays(lens, light, 0, COUNT)
    ghosts = GhostTracer(lens)
    exact = ghosts.trace(rays[:, : 1 << 14], 550.0, direct=True)
    four = _four_reflections(lens, rays[:, :4096].astype(np.float64))
    twice = float(exact.power[:-1].sum(0).mean())
    lit = exact.power[:-1] > 0
    centre, spread = _centre(np.moveaxis(exact.film_xy_mm[:-1], 1, 0)[:, lit], exact.power[:-1][lit])
    tracer = PhotonTracer(lens)
    assert np.all(tracer.trace(rays, 550.0, seed=3).weight == 1)
    table = np.random.default_rng(1).uniform(1.5, 8, (len(lens.surfaces), 2, LEVELS))
    for boost in (1.0, 2.0, table, tracer.turning(550.0, 4)):
        found = tracer.trace(rays, 550.0, boost=boost, seed=7)
        check_books(found, COUNT)
        for times, expected in ((2, twice), (4, four)):
            weight = found.weight[found.reflections == times].astype(np.float64)
            error = math.sqrt((weight**2).sum()) / COUNT
            # Exact ghosts have an error, too, of a few thousand rays at even places.
            slack = 4 * math.hypot(error, (5e-3 if times == 4 else 2e-4) * expected)
            assert weight.sum() / COUNT == pytest.approx(expected, abs=slack)
        place, _ = _centre(found.film_xy_mm, found.weight * (found.reflections == 2))
        assert place == pytest.approx(centre, abs=4 * spread / math.sqrt((found.reflections == 2).sum()))
    # Of as many photons, the last way has less than half the noise of four reflections by chance.
    assert error / four < 0.5 / math.sqrt(four * COUNT)


def test_direct_highlights_have_the_light_that_passes() -> None:
    """Out of focus, on a film that holds it: what comes without reflections, over the exposure; in no other part."""
    lens, light = lens_of("laikin_double_gauss_50"), Light(6.0, 0.0, distance_m=1.0)
    raster = Raster((36.0, 24.0), 36, 24)
    job = FlareJob(lens, [light], raster, FlareSettings(bins=1))
    picture = photon_picture(job, "image", 1 << 15)
    rays, area = light_rays(lens, light, 0, 1 << 15)
    direct = float(GhostTracer(lens, []).trace(rays, 550.0, direct=True).power.mean())
    expected = area * direct / job.exposure
    noise = 4 / math.sqrt(direct * (1 << 15))
    assert picture[..., 1].sum() == pytest.approx(expected, rel=noise)
    flare = photon_picture(job, "flare", 1 << 15)
    assert flare.max() < 0.1 * picture.max()


def test_everything_at_once_loses_no_light() -> None:
    """A zoom with all of it, boosted: every photon ends in one book, and weights are finite."""
    lens = set_lens(read_lens(LENSES / "nikon_zoom_80_200.toml"), zoom="80", focus_m=math.inf)
    rays, _ = light_rays(lens, Light(12.0, -5.0), 0, 1 << 15)
    everything = Scatter(barrel=0.3, sensor=0.2, dust=0.1, haze_per_mm=0.01)
    found = PhotonTracer(lens, everything).trace(rays, 550.0, most_reflections=1000, boost=3.0)
    check_books(found, 1)
    assert np.isfinite(found.film_xy_mm).all() and np.isfinite(found.weight).all() and found.weight.min() > 0
    assert found.glare.any() and not found.glare[(found.reflections <= 2) & (found.scattered == 0)].any()
    same = PhotonTracer(lens, everything).trace(rays, 550.0, most_reflections=1000, boost=3.0)
    assert np.array_equal(found.film_xy_mm, same.film_xy_mm)
    none = PhotonTracer(lens, Scatter()).trace(rays, 550.0, seed=1)
    assert not none.scattered.any()


def test_kernels_take_more_noise_of_colour_than_of_luminance() -> None:
    """Photons of three colours on an even ground: blotches of colour are seen before those of grey."""
    number = np.random.default_rng(5).poisson(0.2, (96, 144, 3)).astype(np.float32)
    sums = np.stack([number.sum(2), number.sum(2)])
    found = _smoothed(number, sums, 3.0)
    luminance = found @ SRGB.to_xyz[1]
    assert (found / luminance[..., None]).std((0, 1)).max() < 0.5 * luminance.std() / luminance.mean()
    assert luminance.sum() == pytest.approx((number @ SRGB.to_xyz[1]).sum(), rel=1e-4)


def test_kernels_keep_light_and_edges_and_take_noise() -> None:
    """A dense square of photons on a thin ground, some of which weigh three times as much."""
    generator, shape = np.random.default_rng(4), (96, 144)
    mean = np.full(shape, 0.05)
    mean[30:60, 40:90] = 40.0
    number, heavy = generator.poisson(mean), generator.poisson(mean / 20)
    sums = np.stack([number + 3 * heavy, number + 9 * heavy]).astype(np.float32)
    picture = np.repeat(sums[0, ..., None], 3, 2)
    found = _smoothed(picture, sums, 3.0)
    assert found.sum() == pytest.approx(picture.sum(), rel=1e-5)
    inside, ground = found[35:55, 45:85], found[:18]
    assert inside.std() / inside.mean() < 0.1 and inside.mean() == pytest.approx(40 * 1.15, rel=0.03)
    assert ground.std() / ground.mean() < 0.35 and ground.mean() == pytest.approx(0.05 * 1.15, rel=0.2)
    assert found[45, 95:].max() < 0.02 * inside.mean()  # the narrowest kernel's edge
    alone = np.zeros((2, 9, 12), np.float32)
    assert not _smoothed(np.zeros((9, 12, 3), np.float32), alone, 40.0).any()


@pytest.mark.parametrize(
    ("name", "value"),
    [("barrel", -0.1), ("barrel", 1.1), ("sensor", 1.0), ("dust", math.nan), ("haze_per_mm", math.inf),
     ("haze_forward", 1.0), ("mirror", -1.0), ("gloss", 2.0)],
)  # fmt: skip
def test_refusals(name: str, value: float) -> None:
    with pytest.raises(InputError, match=name):
        Scatter(**{name: value})


def test_a_boost_is_positive() -> None:
    tracer = PhotonTracer(two_planes(1.5, 2.0, 10.0))
    for bad in (0.0, -1.0, math.nan, math.inf):
        with pytest.raises(InputError, match="boost"):
            tracer.trace(beam(4), 550.0, boost=bad)
