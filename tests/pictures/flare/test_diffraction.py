"""Diffraction at the stop and the rims against closed forms: Airy's disc, polygons, slits, defocus, energy."""

import math
from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest
import torch
from path_difference import opd_mm
from shipped import whole

from experiments.pictures.starburst import light_of, streaks
from neurolens.base.errors import InputError
from neurolens.optics.analysis.bundles import bundle, points as stop_points
from neurolens.optics.analysis.fields import Scene
from neurolens.optics.lens.apertures import Aperture
from neurolens.optics.lens.prescription import Lens
from neurolens.optics.trace.rays import Rays, trace
from neurolens.pictures.flare import diffraction as d, exit_pupil as p
from neurolens.pictures.flare.canvas import Raster
from neurolens.pictures.flare.job import FlareJob, axis_irradiance
from neurolens.pictures.flare.lights import Light, light_rays
from neurolens.pictures.render.settings import FlareSettings
from tests.pictures.flare.test_ghosts import lens_of, plate

AXIS, NM = Light(0.0, 0.0), 550.0
IN_FOCUS_MM = -0.032  # from the focus of the d line to that of 550 nm at f/8


def double_gauss(f_number: float, aperture: Aperture | None = None, shift_mm: float = 0.0) -> Lens:
    lens = lens_of("laikin_double_gauss_50", f_number=f_number)
    return replace(lens, aperture=aperture, film_z_mm=lens.film_z_mm + shift_mm)


@lru_cache(maxsize=32)
def made(f_number: float, aperture: Aperture | None = None, light: Light = AXIS, shift_mm: float = 0.0) -> tuple:
    pupil = p.exit_pupil(double_gauss(f_number, aperture, shift_mm), light, NM)
    assert pupil is not None
    return pupil, p.outline(pupil)


def polygon(corners: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Integral of exp(2 pi i (L x + M y)) over a polygon with corners [2, N], counterclockwise, by its edges: of each
    (n . q) / (2 pi i q^2) times the edge's own integral, a sinc.
    """
    total = np.zeros(np.broadcast(x, y).shape, complex)
    for a, b in zip(corners.T, np.roll(corners, -1, 1).T, strict=True):
        way, middle = b - a, (a + b) / 2
        line = np.sinc(way[0] * x + way[1] * y) * np.exp(2j * math.pi * (middle[0] * x + middle[1] * y))
        total += (way[1] * x - way[0] * y) * line
    return total / (2j * math.pi * (x * x + y * y))


def test_airy_disc() -> None:
    """First dark ring 0.6098 lambda / NA to 0.5%, 83.8% and 91.0% of the light within the first two."""
    pupil, lines = made(8.0, shift_mm=IN_FOCUS_MM)
    airy = 0.60983 * NM * 1e-6 * 2 * 8
    r = np.linspace(0.9, 1.1, 201) * airy
    for angle in (0.0, 0.7, 1.9):
        way = r * math.cos(angle), r * math.sin(angle)
        along = [d.far_field(pupil, lines, np.array([a]), np.array([b]))[0, 0] for a, b in zip(*way, strict=True)]
        assert r[int(np.argmin(along))] == pytest.approx(airy, rel=5e-3)
    x = (np.arange(301) - 150) * airy / 60
    image = d.far_field(pupil, lines, x, x) * (x[1] - x[0]) ** 2 / light_of(pupil, lines)
    far = np.hypot(x, x[:, None])
    assert image[far < airy].sum() == pytest.approx(0.838, abs=6e-3)
    assert image[far < 1.8311 * airy].sum() == pytest.approx(0.910, abs=6e-3)
    assert image.sum() < 1


def test_wavefront_is_the_path_of_rays() -> None:
    """W, had from the slopes of rays, against path lengths through the lens, 12 degrees off."""
    stop = [-0.9, -0.5, 0.2, 0.6, 0.95]
    rays = bundle(Scene(double_gauss(4.0)), [12.0], [NM], stop_points(stop, [0.0, 0.5, -0.7, 0.6, 0.1]))
    pupil, _ = made(4.0, None, Light(0.0, 12.0))
    cosines = np.stack([rays.film.dx[0, 0].numpy(), rays.film.dy[0, 0].numpy()])
    w, _ = pupil._at((cosines - pupil.middle[:, None]) / pupil.half[:, None], slice(2))
    chief = rays.film.y[0, 0, 0] + rays.tangential_mm[0, 0, 0]
    found = (pupil.centre_mm - [0, float(chief)]) @ cosines - opd_mm(rays)[0, 0].numpy()
    # Both are zero somewhere else.
    np.testing.assert_allclose(w - w.mean(), found - found.mean(), atol=1e-10)
    assert np.ptp(found) > NM * 1e-6 / 10


@pytest.mark.parametrize("light", [Light(-10.0, 5.0, distance_m=2.0), *whole(AXIS, Light(9.0, 12.0))])
def test_light_of_the_pupil_is_that_of_rays(light: Light) -> None:
    lens = double_gauss(1.8, Aperture(blades=7))
    rays, area = light_rays(lens, light, 0, 1 << 17)
    found = trace(lens, Rays(*torch.from_numpy(rays)), NM, towards="film", transmittance=True)
    assert found.transmittance is not None
    expected = area * float(torch.where(found.status == 0, found.transmittance, 0.0).mean())
    pupil = p.exit_pupil(lens, light, NM)
    assert pupil is not None
    assert light_of(pupil, p.outline(pupil)) == pytest.approx(expected, rel=3e-3)


@pytest.mark.parametrize(
    ("name", "light"), [("canon_50mm_f1_2", Light(10.1, 6.8)), ("sony_fe_14mm_f1_8_gm", Light(35.0, 15.0))]
)
def test_an_opening_has_one_edge(name: str, light: Light) -> None:
    """Beyond the rays the fitted places at the rims let light pass, which made bright dots a centimetre off."""
    pupil = p.exit_pupil(lens_of(name), light, NM)
    assert pupil is not None and len(p.outline(pupil)) == 1


def test_polygons_near_and_far() -> None:
    """Six blades: the field fringe by fringe; means over pixels 100 pixels out, on a streak, beside it, and between."""
    pupil, lines = made(16.0, Aperture(blades=6))
    angles = np.arange(6) * math.pi / 3
    corners = np.stack([np.cos(angles), np.sin(angles)]) / 32
    wave = NM * 1e-6
    scale = light_of(pupil, lines) / (1.5 * math.sqrt(3) / 32**2) / wave**2
    x = np.linspace(-0.08, 0.08, 64)
    expected = scale * np.abs(polygon(corners, x / wave, x[:, None] / wave)) ** 2
    found = d.far_field(pupil, lines, x, x)
    np.testing.assert_allclose(found, expected, atol=0.01 * expected.max())
    assert found.sum() == pytest.approx(expected.sum(), rel=2e-3)
    pixel = 0.0375
    far = d.outline_spectrum(pupil, lines, NM, pixel, 4.5)
    fine = (np.arange(240) + 0.5) / 30 - 4
    kernel = np.sinc(fine / 2) ** 4
    kernel = np.outer(kernel, kernel) / kernel.sum() ** 2
    streak = 0.0
    for angle, off in ((30, 0.0), (90, 0.0), (90, 2.0), (30, 12.0), (60, 0.0), (10, 0.0), (45, 0.0)):
        r = 100 * pixel
        px = r * math.cos(math.radians(angle)) - off * pixel * math.sin(math.radians(angle))
        py = r * math.sin(math.radians(angle)) + off * pixel * math.cos(math.radians(angle))
        q = [(p + fine * pixel) / wave for p in (px, py)]
        expected_mean = scale * (kernel * np.abs(polygon(corners, q[0], q[1][:, None])) ** 2).sum()
        mean = far.irradiance(np.array([px]), np.array([py]), NM)[0, 0]
        streak = expected_mean if angle == 30 and not off else streak
        assert mean == pytest.approx(expected_mean, rel=0.03, abs=6e-5 * streak)


@pytest.mark.parametrize(("blades", "expected"), [(5, 10), (6, 6), *whole((7, 14), (8, 8))])
def test_streaks(blades: int, expected: int) -> None:
    """2 n of an odd number of blades, n of an even one."""
    pupil, lines = made(16.0, Aperture(blades=blades, rotation_deg=7.0))
    x = (np.arange(161) - 80) * 0.0375
    film = d.star(pupil, lines, d.outline_spectrum(pupil, lines, NM, 0.0375, 3.1), x, x, 0.0375)
    assert streaks(film, 50, 70) == expected


def test_slit() -> None:
    """A mask of 3 to 1: dark lines at whole multiples of lambda / width on each axis."""
    mask = np.zeros((300, 300), bool)
    mask[120:180, 60:240] = True  # 0.6 of the diameter wide, 0.2 high
    pupil, lines = made(8.0, Aperture(mask=mask), shift_mm=-0.01)  # its pupil is narrower, and its best focus nearer
    fringe = NM * 1e-6 / np.array([0.6, 0.2]) * 8
    q = np.linspace(-3.3, 3.3, 67)
    found = d.far_field(pupil, lines, q * fringe[0], q * fringe[1])
    expected = np.outer(np.sinc(q), np.sinc(q)) ** 2
    np.testing.assert_allclose(found / found.max(), expected, atol=4e-3)
    assert found[33, [3, 13, 23, 43, 53, 63]].max() < 1e-4 * found.max()
    assert found.max() == pytest.approx(light_of(pupil, lines) / np.prod(fringe), rel=5e-3)


@pytest.mark.parametrize("waves", [0.5, *whole(0.25, 1.0, 1.5)])
def test_strehl_of_defocus(waves: float) -> None:
    """Defocus of W waves at the edge leaves sinc^2(W) of the peak."""
    pupil, lines = made(16.0)
    na = np.ptp(lines[0][0]) / 2 * pupil.half[0]
    shift = waves * NM * 1e-6 / (1 - math.sqrt(1 - na * na))
    peaks = []
    for moved in (0.0, shift, -shift):  # both sides, for the best focus of f/16 lies a little off
        pupil, lines = made(16.0, None, AXIS, moved)
        peaks.append(d.far_field(pupil, lines, np.zeros(1), np.zeros(1))[0, 0])
    assert (peaks[1] + peaks[2]) / 2 / peaks[0] == pytest.approx(np.sinc(waves) ** 2, abs=3e-3)


def test_large_aberrations_are_the_spot_of_rays() -> None:
    """0.3 mm out of focus at f/2.8 and 10 degrees: the shares of light within circles are those of rays."""
    light = Light(0.0, 10.0)
    pupil, lines = made(2.8, None, light, 0.3)
    assert pupil.blur_mm > 30 * NM * 1e-6 * 2.8
    x = np.linspace(-0.12, 0.12, 480)
    image = d.far_field(pupil, lines, x, x)
    share = image / image.sum()
    rays, _ = light_rays(double_gauss(2.8, None, 0.3), light, 0, 1 << 17)
    lens = double_gauss(2.8, None, 0.3)
    found = trace(lens, Rays(*torch.from_numpy(rays)), NM, towards="film", transmittance=True)
    lit = (found.status == 0).numpy()
    way = (lens.film_z_mm - found.rays.z) / found.rays.dz
    at = np.stack([(found.rays.x + way * found.rays.dx).numpy(), (found.rays.y + way * found.rays.dy).numpy()])[:, lit]
    assert found.transmittance is not None
    power, away = found.transmittance.numpy()[lit], np.hypot(*(at - pupil.centre_mm[:, None]))
    for radius in (0.02, 0.035, 0.05, 0.06):
        expected = power[away < radius].sum() / power.sum()
        assert share[np.hypot(x, x[:, None]) < radius].sum() == pytest.approx(expected, abs=0.02)


def test_cats_eye() -> None:
    """17 degrees off at f/1.8 rims cut the pupil: its pattern is that of its outline, wider across the narrow way."""
    pupil, lines = made(1.8, None, Light(0.0, 17.0))
    lengths = [np.ptp(lines[0][k]) * pupil.half[k] for k in (0, 1)]
    assert lengths[1] < 0.85 * lengths[0]
    figures = pupil.figures.copy()
    figures[..., 0] = 0
    flat = replace(pupil, figures=figures, hits_mm=np.zeros((2, 1)))
    wave = NM * 1e-6
    x = np.linspace(-4, 4, 41) * wave / max(lengths)
    found = d.far_field(flat, lines, x, x)
    expected = np.abs(polygon(lines[0] * pupil.half[:, None], x / wave + 1e-9, x[:, None] / wave + 1e-9)) ** 2
    np.testing.assert_allclose(found / found.max(), expected / expected.max(), atol=0.01)
    width = [np.interp(0.5, row[20:][::-1] / row[20], x[20:][::-1]) for row in (found[20], found[:, 20])]
    assert width[1] / width[0] == pytest.approx(lengths[0] / lengths[1], rel=0.15)


def test_no_seam_and_no_light_lost() -> None:
    """Layer, image and the tail beyond the frame (2 lambda N / (pi^2 r) of a round pupil) are all light.

    The layer falls as r^-3 through where the two ways of computing meet.
    """
    pupil, lines = made(16.0)
    pixel = 0.0375
    x = (np.arange(121) - 60) * pixel
    film = d.star(pupil, lines, d.outline_spectrum(pupil, lines, NM, pixel, 2.4), x, x, pixel)
    image = film == 0
    assert image.sum() in (9, 12, 16)
    fine = (np.arange(16) + 0.5) / 16 - 0.5
    inner = ((np.arange(-2, 3)[:, None] + fine) * pixel).reshape(-1)
    core = d.far_field(pupil, lines, inner, inner).reshape(5, 16, 5, 16).mean((1, 3))
    core = core[image[58:63, 58:63]].sum()
    whole = light_of(pupil, lines)
    angle = np.linspace(0, math.pi / 4, 100)
    tail = np.mean(2 * NM * 1e-6 * 16 / (math.pi**2 * 60.5 * pixel / np.cos(angle)))
    assert (film.sum() + core) * pixel**2 / whole + tail == pytest.approx(1, abs=2e-3)
    far = np.hypot(x, x[:, None]) / pixel
    rings = [(film * far**3)[(far >= k) & (far < k + 1)].mean() for k in range(3, 40)]
    np.testing.assert_allclose(rings, np.mean(rings[10:]), rtol=0.06)


@pytest.mark.parametrize(
    ("aperture", "light"), [(None, AXIS), (Aperture(blades=5), Light(0.0, 10.0)), *whole((Aperture(blades=6), AXIS))]
)
def test_star_out_of_focus(aperture: Aperture | None, light: Light) -> None:
    """1 mm out of focus at f/8: in rings, as bright as the sum over cells from the image on; no light is lost."""
    pupil, lines = made(8.0, aperture, light, 1.0)
    pixel, count = 0.015, 26
    assert pupil.blur_mm > 4 * pixel
    x = np.arange(-count, count + 1) * pixel
    within = (np.arange(10) + 0.5) / 10 - 0.5
    fine = (x[:, None] + within * pixel).reshape(-1)
    expected = d.far_field(pupil, lines, fine, fine).reshape(len(x), 10, len(x), 10).mean((1, 3))
    film = d.star(pupil, lines, d.outline_spectrum(pupil, lines, NM, pixel, fine[-1]), x, x, pixel)
    radii = np.hypot(x, x[:, None]) / pupil.blur_mm
    for low, high in ((1.2, 1.7), (1.7, 2.4), (2.4, 3.3), (3.3, 4.5), (4.5, 5.6)):
        ring = (film > 0) & (radii > low) & (radii < high)
        assert film[ring].sum() == pytest.approx(expected[ring].sum(), rel=0.03)
    tail = 2 * NM * 1e-6 * 8 / (math.pi**2 * fine[-1])
    whole = (film.sum() + expected[film == 0].sum()) * pixel**2 / light_of(pupil, lines)
    assert whole + tail == pytest.approx(1, abs=1.5e-3)
    if aperture is None:
        outside = film > 0
        assert np.abs(film - expected)[outside].sum() < 0.03 * expected[outside].sum()


@pytest.mark.parametrize(("shift_mm", "rel"), whole((0.0, 0.02), (1.0, 0.05)))
def test_ends_of_the_range(shift_mm: float, rel: float) -> None:
    """At 400 and 700 nm rings are as bright as the sum over cells at that wavelength, in focus and 1 mm out of it; in
    focus, far from the centre, as bright as Airy's: 2 F_number lambda / (pi^2 r^2) of the light beyond r."""
    lens, nm = double_gauss(8.0, None, shift_mm), np.linspace(400.0, 700.0, 7)
    pixel = 0.015
    raster = Raster((53 * pixel, 53 * pixel), 53, 53)
    stars = list(d._stars(FlareJob(lens, [], raster, threads=1), AXIS, nm, raster))
    x = np.arange(-26, 27) * pixel
    within = (np.arange(10) + 0.5) / 10 - 0.5
    fine = (x[:, None] + within * pixel).reshape(-1)
    far = np.hypot(x, x[:, None])
    middle = p.exit_pupil(lens, AXIS, 550.0)
    assert middle is not None and len(stars) == 7
    for k in (0, 6):
        pupil = p.exit_pupil(lens, AXIS, nm[k], middle)
        assert pupil is not None
        expected = d.far_field(pupil, p.outline(middle), fine, fine).reshape(53, 10, 53, 10).mean((1, 3))
        for low, high in ((0.08, 0.12), (0.12, 0.18), (0.18, 0.26), (0.26, 0.38)):
            ring = (stars[k] > 0) & (far > low) & (far < high)
            assert stars[k][ring].sum() == pytest.approx(expected[ring].sum(), rel=rel)
        if not shift_mm:
            ring = (far > 0.12) & (far < 0.36)
            beyond = 2 * 8.0 * nm[k] * 1e-6 / math.pi**2 * (1 / 0.12 - 1 / 0.36)
            assert stars[k][ring].sum() * pixel**2 / light_of(pupil, p.outline(middle)) == pytest.approx(
                beyond, rel=0.04
            )


def test_picture_is_in_units_of_a_white_card() -> None:
    """The layer's sum is the light of the star over the card's; nothing is negative at one wavelength's grey."""
    lens, raster = double_gauss(22.0, Aperture(blades=6)), Raster((12.0, 8.0), 96, 64)
    light, more = (Light(3.0, 1.0, (rgb,) * 3) for rgb in (0.5, 1.5))  # their layers add up
    picture = d.starburst_picture(FlareJob(lens, [light, more], raster, FlareSettings(bins=1), (NM, NM)))
    assert picture.shape == (64, 96, 3) and picture.min() >= 0
    pupil = p.exit_pupil(lens, light, NM)
    assert pupil is not None
    lines = p.outline(pupil)
    x = ((np.arange(96) + 0.5 - 48) / 8)[::-1]
    y = (np.arange(64) + 0.5 - 32) / 8
    far = d.outline_spectrum(pupil, lines, NM, 0.125, 9.0)
    film = d.star(pupil, lines, far, x - pupil.centre_mm[0], y - pupil.centre_mm[1], 0.125)
    np.testing.assert_allclose(picture[..., 1].sum(), 2 * film.sum() / axis_irradiance(lens, NM), rtol=2e-3)
    brightest = np.unravel_index(picture[..., 1].argmax(), (64, 96))
    # The light stands to the right and above.
    assert brightest[1] == pytest.approx(48 + 8 * 49.6 * math.tan(math.radians(3)), abs=3)
    assert brightest[0] == pytest.approx(32 - 8 * 49.6 * math.tan(math.radians(1)), abs=3)


def corner_mask() -> Aperture:
    """Open only at one side, which the rims hide from light that comes from above."""
    mask = np.zeros((64, 64), bool)
    mask[:2, 24:40] = True
    return Aperture(mask=mask)


@pytest.mark.parametrize(
    ("lens", "light", "lit"),
    [
        (lambda: double_gauss(45.0, Aperture(blades=9, curvature=1.0)), Light(5.0, 0.0), True),
        (lambda: lens_of("shimizu_fisheye_220"), Light(70.0, 20.0), True),
        (lambda: double_gauss(2.0), Light(80.0, 0.0), False),
        (lambda: double_gauss(1.8, corner_mask()), Light(0.0, 20.0), False),
        (plate, Light(5.0, 0.0), False),
        *whole(
            (lambda: lens_of("edmund_asphere_30"), Light(1.0, 1.0), True),
            (lambda: double_gauss(8.0, Aperture(blades=5)), Light(21.5, 0.0), True),  # off the frame
            (lambda: lens_of("schneider_anamorphic_31"), Light(5.0, 3.0), True),
        ),
    ],
)
def test_extremes(lens: Callable[[], Lens], light: Light, lit: bool) -> None:
    made_lens = lens()
    film = d.starburst_picture(
        FlareJob(made_lens, [light], Raster((36, 24), 96, 64), FlareSettings(bins=2), (380.0, 780.0))
    )
    assert np.isfinite(film).all() and bool(film.any()) == lit
    for nm in (380.0, 780.0) if lit else ():
        pupil = p.exit_pupil(made_lens, light, nm)
        assert pupil is not None and np.isfinite(pupil.figures).all()


def test_refusals_and_nothing_to_do() -> None:
    assert not d.starburst_picture(FlareJob(plate(), [], Raster((36, 24), 9, 6))).any()
    with pytest.raises(InputError, match="focused"):
        p.exit_pupil(replace(plate(), film_z_mm=None), AXIS, NM)
    pupil, lines = made(8.0)
    with pytest.raises(InputError, match="cells"):
        d.far_field(pupil, lines, np.array([20.0]), np.array([0.0]))
