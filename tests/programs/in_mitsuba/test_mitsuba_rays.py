"""What needs no Mitsuba: film samples to rays, wavelengths for RGB, the errors without it or with an old LLVM."""

import sys
from types import SimpleNamespace

import numpy as np
import pytest

from neurolens.base.errors import NeurolensError, NeurolensWarning
from neurolens.cameras.contract import RAYS_A_CALL as BATCH
from neurolens.cameras.ideal import Pinhole, ThinLens
from neurolens.pictures.render.colour import ChannelWavelengths, SpectralRange
from neurolens.pictures.render.film import PixelGrid
from neurolens.programs.mitsuba import load_scene, sensor as library
from neurolens.programs.mitsuba.sensor import FilmRays, wavelength_samples

FILM = (30.0, 20.0)


def film_rays(**more: object) -> FilmRays:
    return FilmRays(Pinhole(50.0, FILM), PixelGrid(300, 200, FILM), **more)  # type: ignore[arg-type]


def ask(rays: FilmRays, points: list[tuple[float, float]]) -> np.ndarray:
    position = np.array(points, np.float32).T
    return rays.sample(position, np.full_like(position, 0.5), np.full(len(points), 550, np.float32)).direction


def test_the_picture_is_upright_and_not_mirrored() -> None:
    # Mitsuba's camera: x to the left of the picture, y up, z into the scene; film positions from the top left.
    middle, right, top = ask(film_rays(), [(0.5, 0.5), (1.0, 0.5), (0.5, 0.0)]).T
    np.testing.assert_allclose(middle, [0, 0, 1], atol=1e-6)
    np.testing.assert_allclose(right / right[2], [-15 / 50, 0, 1], atol=1e-6)
    np.testing.assert_allclose(top / top[2], [0, 10 / 50, 1], atol=1e-6)


def test_a_crop_window_is_the_part_of_the_film_that_it_says() -> None:
    part = film_rays(crop_offset=(0.25, 0.5), crop_size=(0.5, 0.25))
    whole = ask(film_rays(), [(0.25, 0.5), (0.75, 0.75), (0.5, 0.625)])
    np.testing.assert_allclose(ask(part, [(0, 0), (1, 1), (0.5, 0.5)]), whole, atol=1e-6)


def test_scene_units_scale_origins_alone() -> None:
    metres, millimetres = film_rays(), film_rays(units_per_m=1000.0)
    position = np.array([[0.2], [0.7]], np.float32)
    a, b = (r.sample(position, position, np.array([550.0], np.float32)) for r in (metres, millimetres))
    np.testing.assert_allclose(a.origin[:, 0], [0, 0, 0.05], atol=1e-7)  # the hole, 50 mm in front of the film
    np.testing.assert_allclose(b.origin, 1000 * a.origin)
    np.testing.assert_array_equal(a.direction, b.direction)


def test_batches_are_joined_where_they_were_cut() -> None:
    random = np.random.default_rng(0)
    position, aperture = random.random((2, 2, BATCH + 37), dtype=np.float32)
    rays = FilmRays(ThinLens(50, 2, 3, FILM), PixelGrid(300, 200, FILM))
    nm = np.full(BATCH + 37, 550, np.float32)
    whole, tail = rays.sample(position, aperture, nm), rays.sample(position[:, BATCH:], aperture[:, BATCH:], nm[BATCH:])
    for a, b in zip(whole, tail, strict=True):
        np.testing.assert_allclose(a[..., BATCH:], b, rtol=1e-5, atol=1e-7)


@pytest.mark.parametrize("limits", [(400, 700), (380, 780), (450, 650)])
def test_white_stays_white_and_colours_stay_themselves(limits: tuple[float, float]) -> None:
    # The mean over the wavelengths of what a ray is worth is 1 for each channel, and never negative.
    sample = ((np.arange(1 << 16) + 0.5) / (1 << 16)).astype(np.float32)
    nm, weights = ChannelWavelengths(*limits).draw(sample)
    assert nm.min() >= limits[0] and nm.max() <= limits[1]
    assert weights.min() >= 0
    np.testing.assert_allclose(weights.mean(axis=1), 1, atol=1e-5)
    # Red light is longer than green, green than blue.
    red, green, blue = (weights * nm).mean(axis=1)
    assert red > green > blue


def test_light_of_one_wavelength_is_grey() -> None:
    nm, weights = ChannelWavelengths(550, 550).draw(np.array([0, 0.5, 0.99], np.float32))
    np.testing.assert_array_equal(weights, 1)
    np.testing.assert_allclose(nm, 550)


def test_fringes_take_the_colour_of_our_film() -> None:
    # A white edge blurred in one third of the spectrum: the RGB weights show the colour that our spectral film shows,
    # to within what lies off the diagonal of its response.
    full = SpectralRange(400, 700)
    sample = ((np.arange(1 << 14) + 0.5) / (1 << 14)).astype(np.float32)
    for low, high in ((400, 500), (500, 600), (600, 700)):
        nm, weights = ChannelWavelengths(400, 700).draw(sample)
        seen = (weights * ((nm >= low) & (nm < high))).mean(axis=1)
        exact = full.film_rgb((full.centres_nm >= low) & (full.centres_nm < high))
        assert np.argmax(seen) == np.argmax(exact)
        assert np.abs(seen - exact).max() < 0.2


def test_wavelengths_of_a_pixel_are_spread_evenly() -> None:
    random = np.random.default_rng(1)
    position, aperture = random.random((2, 2, 1 << 12), dtype=np.float32)
    sample = wavelength_samples(position, aperture)
    assert 0 <= sample.min() and sample.max() < 1
    for count in (8, 16, 64):
        rows = np.sort(sample.reshape(-1, count), axis=1)
        gaps = np.diff(rows, axis=1, append=rows[:, :1] + 1)
        assert gaps.max() < 2.7 / count  # random numbers leave gaps of about ln(n) / n and far more


def test_a_wavefront_of_one_draws_uniform_numbers() -> None:
    random = np.random.default_rng(2)
    points = random.random((4096, 4, 1), dtype=np.float32)
    number = np.array([wavelength_samples(p[:2], p[2:])[0] for p in points])
    counts = np.histogram(number, 16, (0, 1))[0]
    assert ((counts - 256) ** 2 / 256).sum() < 40  # chi squared of 15 degrees of freedom, 0.9995
    for row in points[..., 0].T:
        assert abs(np.corrcoef(row, number)[0, 1]) < 0.06


def test_without_mitsuba_one_error_names_the_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "mitsuba", None)
    with pytest.raises(NeurolensError, match=r"pip install '\.\[mitsuba\]'"):
        load_scene("cornell-box")


@pytest.mark.parametrize("version", [(15, 0, 6), (-1, -1, -1)])
def test_an_llvm_too_old_is_named_with_the_variant_that_works(
    version: tuple[int, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    """LLVM 15 would end the process: the default variant becomes one that needs none; one asked for is refused."""
    taken: list[str] = []
    mi = SimpleNamespace(
        variant=lambda: None, variants=lambda: ["scalar_spectral", "llvm_ad_spectral"], set_variant=taken.append
    )
    dr = SimpleNamespace(detail=SimpleNamespace(llvm_version=lambda: version))
    monkeypatch.setattr(library, "libraries", lambda: (mi, dr))
    monkeypatch.setattr(library, "_compile", lambda variant: None)
    with pytest.warns(NeurolensWarning, match="LLVM.*19 works.*variant scalar_spectral needs none and is taken"):
        library.require_mitsuba()
    with pytest.raises(NeurolensError, match=r"variant llvm_ad_spectral: .*LLVM.*scalar_spectral needs none$"):
        library.require_mitsuba("llvm_ad_spectral")
    assert taken == ["scalar_spectral"]
