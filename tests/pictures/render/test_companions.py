"""Several wavelengths on the path of a lens that disperses: the same scene ray, the same light, less noise."""

import math
from dataclasses import replace
from functools import cache
from pathlib import Path
from shutil import which
from typing import Any

import numpy as np
import pytest
import torch
from render_helpers import FILM, WHITE, scene
from shipped import whole

from neurolens.base import status as st
from neurolens.base.errors import InputError, Note
from neurolens.cameras.build import make_camera
from neurolens.cameras.exact import ExactCamera, light_on_axis
from neurolens.optics.lens.apertures import Aperture
from neurolens.optics.lens.shot import Shot
from neurolens.optics.readers.lensfile import read_lens
from neurolens.optics.setting.states import set_lens
from neurolens.optics.trace.rays import Rays, trace
from neurolens.pictures.render.film import PixelGrid
from neurolens.pictures.render.job import mode_for
from neurolens.pictures.render.renderer import RenderResult, Watch, render
from neurolens.pictures.render.settings import FilmSettings

ROOT = Path(__file__).parents[3]
MODEL = ROOT / "models" / "laikin_double_gauss_50.ols-60.onnx"
# Two with strong lateral colour, one wide open that vignettes, one with cylinders.
GAUSS = "laikin_double_gauss_50"
LENSES: dict[str, tuple[tuple[float, float], float]] = {
    GAUSS: (FILM, 1.8),
    "horimoto_fisheye_16": (FILM, 2.8),
    "merte_biotar_100": (FILM, 1.4),
    "cooke_anamorphic_42": ((20.6, 17.3), 2.4),
}
LARGE: dict[str, Any] = {"width": 120, "height": 80, "threads": 1}
WAYS: tuple[Any, ...] = ("auto", "one", "hero")
NARROW = {
    "sodium": {"spectrum": [[380, 0.0], [580, 0.0], [589, 1.0], [598, 0.0], [780, 0.0]]},
    "led": {"spectrum": [[380, 0.0], [430, 0.0], [452, 1.0], [478, 0.15], [560, 0.6], [620, 0.45], [720, 0.0]]},
}


@cache
def lens_camera(name: str) -> ExactCamera:
    film, f_number = LENSES[name]
    return ExactCamera(read_lens(ROOT / "lenses" / f"{name}.toml"), Shot(film, 2.0, f_number))


@cache
def compiled(camera: Any) -> Any:
    """The camera as C, where that can be compiled: a picture takes a tenth of the time."""
    return camera.compiled() if which("cc") else camera


@cache
def model_camera(vignetting: Any = "both") -> Any:
    return make_camera(MODEL, Shot(FILM, 2.0, 1.8, vignetting=vignetting))


def samples_of(camera: Any, count: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    random = np.random.default_rng(seed)
    film = (random.random((2, count)) - 0.5) * np.array(camera.film_mm)[:, None]
    waves = 400 + 300 * ((random.random(count) + np.arange(4)[:, None] / 4) % 1)
    return film.astype(np.float32), random.random((2, count), np.float32), waves.astype(np.float32)


@pytest.mark.parametrize("name", [GAUSS, *whole("cooke_anamorphic_42", "horimoto_fisheye_16", "merte_biotar_100")])
def test_companions_are_where_the_lens_brings_the_scene_ray(name: str) -> None:
    """The oracle traces the scene ray backwards, at the wavelength of each companion."""
    camera = lens_camera(name)
    film, square, waves = samples_of(camera, 4000)
    found = camera.sample_spectrum(film, square, waves)
    plain = camera.sample(film, square, waves[0])
    assert np.array_equal(found.rays.direction, plain.direction) and np.array_equal(found.film_mm[0], film)
    passed = np.flatnonzero(found.weight[0] > 0)
    position = 1e3 * plain.origin_m[:, passed].astype(np.float64)
    position[2] += camera.film.film_z_mm
    direction = plain.direction[:, passed].astype(np.float64)
    start = np.concatenate([position + direction, -direction])
    for k in range(1, 4):
        light = torch.from_numpy(waves[k, passed]).double()
        back = trace(camera.lens, Rays(*torch.from_numpy(start)), light, towards="film", transmittance=True)
        x, y, z, dx, dy, dz = (c.numpy() for c in back.rays)
        place = np.stack([x, y]) + (camera.film.film_z_mm - z) / dz * np.stack([dx, dy])
        on_film = (np.abs(place) < np.array(camera.film_mm)[:, None] / 2).all(axis=0)
        wanted, both = (back.status.numpy() == st.PASSED) & on_film, found.weight[k, passed] > 0
        assert np.mean(wanted != both) < 2e-3  # next to edges
        both &= wanted
        error = np.hypot(*(found.film_mm[k][:, passed] - place))[both]
        shift = np.hypot(*(film[:, passed] - place))[both]
        assert np.sqrt(np.mean(error**2)) < max(5e-4, 0.02 * np.sqrt(np.mean(shift**2)))
        assert np.quantile(error, 0.999) < 0.012


def shares(camera: Any, count: int = 20_000) -> tuple[np.ndarray, np.ndarray]:
    film, square, waves = samples_of(camera, count)
    found = camera.sample_spectrum(film, square, waves)
    return found.weight, camera.sample(film, square, waves[0]).weight


def test_wavelengths_share_a_ray_and_the_hero_must_pass() -> None:
    weight, alone = shares(model_camera())
    passed = weight > 0
    assert np.array_equal(passed[0], alone > 0) and not passed[:, ~passed[0]].any()
    assert weight[0] * passed.sum(axis=0) == pytest.approx(alone, rel=1e-5)
    # Transmittance alone parts those that pass.
    assert np.ptp(np.where(passed, weight, weight[:1]), axis=0).max() < 0.1 * weight.max()


def test_lenses_and_models_carry_companions_unless_asked_for_one() -> None:
    grid = PixelGrid(720, 480, FILM)
    exact, model = lens_camera("laikin_double_gauss_50"), model_camera()
    modes = {
        (c, w): mode_for(c, grid, (400.0, 700.0), FilmSettings(wavelengths=w)) for c in (exact, model) for w in WAYS
    }
    for made in (exact, model):
        assert [modes[made, w] for w in WAYS] == ["companions", "one", "companions"]


def test_one_wavelength_a_path_is_said(monkeypatch: pytest.MonkeyPatch) -> None:
    camera = lens_camera("laikin_double_gauss_50")
    monkeypatch.setattr(type(camera), "companion_reach_mm", None)  # as where no polynomial follows the shift
    grid, limits = PixelGrid(720, 480, FILM), (400.0, 700.0)
    with pytest.warns(Note, match="one wavelength a path, .* moves its picture by .* which no polynomial follows"):
        assert mode_for(camera, grid, limits, FilmSettings()) == "one"
    with pytest.raises(InputError, match="moves its picture"):
        mode_for(camera, grid, limits, FilmSettings(wavelengths="hero"))


def blocks(picture: np.ndarray) -> np.ndarray:
    """Mean colours of the middle and of the corners."""
    h, w = (n // 4 for n in picture.shape[:2])
    corners = [
        picture[rows, columns] for rows in (slice(h), slice(-h, None)) for columns in (slice(w), slice(-w, None))
    ]
    return np.stack([p.mean(axis=(0, 1)) for p in (picture[h:-h, w:-w], np.concatenate(corners))])


def in_modes(camera: Any, samples: int, light: str = "D65", modes: Any = ("one", "hero"), **tables: Any) -> Any:
    made = scene(environment=WHITE | {"illuminant": light}, illuminants=NARROW, **tables)
    made = replace(made, settings=replace(made.settings, camera=replace(made.settings.camera, film_mm=camera.film_mm)))
    size = LARGE | {"height": round(LARGE["width"] * camera.film_mm[1] / camera.film_mm[0])}
    found = [render(made, camera, samples=samples, film=FilmSettings(wavelengths=mode), **size) for mode in modes]
    assert [f.stats.wavelengths for f in found] == ["one", "companions"][-len(modes) :]
    return [f.rgb.astype(np.float64) for f in found]


# The first by its model in all that follow.
@pytest.mark.parametrize("name", ["horimoto_fisheye_16", *whole("merte_biotar_100", "cooke_anamorphic_42")])
def test_white_surroundings_look_the_same_in_the_middle_and_in_corners(name: str) -> None:
    one, several = in_modes(compiled(lens_camera(name)), 16)
    # From seed to seed a block's mean scatters by up to 0.2% in either mode.
    assert blocks(several) == pytest.approx(blocks(one), rel=4.5e-3)
    assert several.mean(axis=(0, 1)) == pytest.approx(one.mean(axis=(0, 1)), rel=1.5e-3)


# Noise allows 5e-3 at 64 samples, and 1e-3 at 2048.
@pytest.mark.parametrize(
    ("light", "samples", "error"),
    [("sodium", 64, 5e-3), *whole(*((light, 2048, 1e-3) for light in ("sodium", "led", "D65")))],
)
def test_light_of_a_line_or_of_a_lamp_is_conserved(light: str, samples: int, error: float) -> None:
    one, several = in_modes(compiled(model_camera()), samples, light)
    assert several.mean(axis=(0, 1)) == pytest.approx(one.mean(axis=(0, 1)), rel=error, abs=0.4 * error)


def test_without_vignetting_white_stays_white() -> None:
    (several,) = in_modes(model_camera("none"), 32, modes=["hero"])
    assert several @ [0.2126, 0.7152, 0.0722] == pytest.approx(np.ones(several.shape[:2]), abs=0.25)
    # The exposure counts all wavelengths alike, and the eye few of those that glass absorbs.
    lens, nm = set_lens(read_lens(ROOT / "lenses" / f"{GAUSS}.toml")), np.linspace(400, 700, 61)
    through, eye = light_on_axis(lens, nm.tolist(), (400.0, 700.0)), np.exp(-0.5 * ((nm - 559) / 42) ** 2)
    gain = np.average(through, weights=eye) / through.mean()
    assert 1 < gain < 1.015 and blocks(several) @ [0.2126, 0.7152, 0.0722] == pytest.approx([gain] * 2, abs=4e-3)


def test_glass_that_parts_the_wavelengths_loses_nothing() -> None:
    flint = {"kind": "glass", "n_d": 1.9, "V_d": 12.0}
    ball = {"centre_m": [0, 0, -1.0], "radius_m": 0.5, "material": "flint"}
    one, several = in_modes(compiled(model_camera()), 16, materials={"flint": flint}, spheres=[ball])
    assert several.mean(axis=(0, 1)) == pytest.approx(one.mean(axis=(0, 1)), rel=6e-3)


def edges() -> Any:
    """A checker in focus before surroundings that are coloured."""
    tiles = {"kind": "checker", "colours": [[0.9, 0.2, 0.1], [0.1, 0.3, 0.9]], "cell_m": 0.2}
    wall = {"point_m": [0, 0, -1], "normal": [0, 0.3, 1], "material": "tiles"}
    return scene(
        environment={"colour": [0.9, 0.8, 0.6]},
        textures={"tiles": tiles},
        materials={"tiles": {"kind": "diffuse", "texture": "tiles"}},
        planes=[wall],
    )


def pictures(mode: Any, samples: int, seeds: int) -> np.ndarray:
    film = FilmSettings(wavelengths=mode)
    made = edges()
    return np.stack(
        [render(made, compiled(model_camera()), samples=samples, film=film, seed=s, **LARGE).rgb for s in range(seeds)]
    )


def test_edges_stay_where_they_are_with_less_noise() -> None:
    one, several = (pictures(mode, 8, 5).astype(np.float64) for mode in ("one", "auto"))
    noise = [p.var(axis=0, ddof=1).mean(axis=(0, 1)) for p in (one, several)]
    assert (noise[1] < 0.6 * noise[0]).all(), noise[1] / noise[0]
    # Pixel by pixel, within the noise: no blur, no shift.
    apart = several.mean(axis=0) - one.mean(axis=0)
    expected = (one.var(axis=0, ddof=1) + several.var(axis=0, ddof=1)) / len(one)
    assert np.mean(apart**2) < 1.1 * np.mean(expected)


def same(one: RenderResult, other: RenderResult) -> bool:
    return np.array_equal(one.rgb, other.rgb) and np.array_equal(one.layers.variance, other.layers.variance)


def test_any_number_of_workers_and_an_interruption_give_the_same_picture(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr("neurolens.pictures.render.film.BATCH", 16 * 700)
    options: dict[str, Any] = LARGE | {"samples": 10}
    monkeypatch.setattr("neurolens.pictures.render.job._LITTLE_PX", 0.0)
    made, camera, part = edges(), compiled(model_camera()), tmp_path / "a.part"
    all_of_it = render(made, camera, **options)
    assert all_of_it.stats.wavelengths == "companions"
    assert same(render(made, camera, **options | {"threads": 3}), all_of_it)
    calls = iter([False])
    watch = Watch(checkpoint=part, stop=lambda: next(calls, True))
    first = render(made, camera, **options | {"threads": 2}, watch=watch)
    assert not first.stats.complete
    assert same(render(made, camera, watch=Watch(checkpoint=part), **options), all_of_it)
    rows = [render(made, camera, rows=rows, **options).rgb for rows in ((0, 27), (27, 28), (28, 80))]
    assert np.array_equal(np.concatenate(rows), all_of_it.rgb)


def test_one_pixel_one_line_and_no_light_end_well() -> None:
    camera = model_camera()
    square = make_camera(MODEL, Shot((4.0, 4.0), 2.0, 1.8))
    for lens, width, height in ((square, 1, 1), (camera, 3, 2), (camera, 240, 160)):
        for light in ((550, 550), (400, 700)):
            made = scene({"wavelengths_nm": list(light)}, environment=WHITE)
            found = render(made, lens, samples=2, threads=1, width=width, height=height)
            assert np.isfinite(found.rgb).all() and found.rgb.mean() > 0.2
    empty = camera.sample_spectrum(np.zeros((2, 0)), np.zeros((2, 0)), np.zeros((4, 0)))
    assert empty.weight.shape == (4, 0) and empty.film_mm.shape == (4, 2, 0)
    wild = np.array([[np.nan, np.inf, 1e30, 0.0, 0.0], [0.0, 0.0, 0.0, 0.0, 0.0]], np.float32)
    waves = np.full((4, 5), 550, np.float32)
    waves[:, 4], waves[2, 3] = np.nan, -1.0
    found = camera.sample_spectrum(wild, np.full((2, 5), 0.5, np.float32), waves)
    assert np.isfinite(found.weight).all() and not found.weight[:, :3].any() and not found.weight[:, 4].any()
    far = np.full((2, 3000), 17.0, np.float32) * [[1.0], [0.7]]  # near the end of the light, where many are lost
    found_far = camera.sample_spectrum(far, *samples_of(camera, 3000)[1:])
    lost = found_far.weight == 0
    assert lost.any() and (found_far.film_mm[:, 0][lost] == 17).all()
    assert found.weight[2, 3] == 0 and math.isclose(found.weight[0, 3], found.weight[1, 3], rel_tol=1e-4)


def test_compiled_cameras_have_the_same_companions() -> None:
    plain = model_camera()
    try:
        fused = plain.compiled()
    except Exception as error:
        pytest.skip(f"no C compiler: {error}")
    film, square, waves = samples_of(plain, 5000)
    one, other = (c.sample_spectrum(film, square, waves) for c in (plain, fused))
    assert np.mean((one.weight > 0) != (other.weight > 0)) < 1e-3
    both = (one.weight > 0) & (other.weight > 0)
    assert other.weight[both] == pytest.approx(one.weight[both], rel=1e-4)
    assert np.abs(one.film_mm - other.film_mm).transpose(0, 2, 1)[both].max() < 1e-5


def test_blue_light_that_is_totally_reflected_is_left_out(tmp_path: Path) -> None:
    # The rim's rays meet the dome from inside at the critical angle of the longest wavelengths that pass.
    file = tmp_path / "dome.toml"
    rows = "{ radius_mm = 10.0, thickness_mm = 5.0, diameter_mm = 11.6, n_d = 1.7847, V_d = 25.7 }"
    for thickness, stop in ((0.1, ""), (8.0, ", stop = true")):
        rows += f",\n  {{ radius_mm = inf, thickness_mm = {thickness}, diameter_mm = 11.6{stop} }}"
    head = 'schema = 1\nname = "Dome"\ndesigner = "none"\nsource = "a test"\nrims = "source"\n'
    file.write_text(f"{head}f_number = 1.2\nefl_mm = 12.9\nsurfaces = [\n  {rows}\n]\n")
    camera = ExactCamera(read_lens(file), Shot((6.0, 4.0), 0.3, focus_mode="paraxial"))
    film, square, waves = samples_of(camera, 8000)
    waves[0], waves[1] = 690, 410
    found = camera.sample_spectrum(film, square, waves)
    red_alone = (found.weight[0] > 0) & (found.weight[1] == 0)
    assert 0.02 < red_alone.mean() < 0.3
    weight, alone = shares(camera, 8000)  # what blue leaves, other wavelengths have
    assert weight.sum(axis=0).mean() == pytest.approx(alone.mean(), rel=0.01)


def test_all_visible_light_from_380_to_780_nm() -> None:
    lens = read_lens(ROOT / "lenses" / "laikin_double_gauss_50.toml")
    camera = ExactCamera(lens, Shot(FILM, 2.0, 1.8, wavelength_nm=(380.0, 780.0)))
    film, square, waves = samples_of(camera, 4000)
    waves = (380 + 400 * (waves - 400) / 300).astype(np.float32)
    found = camera.sample_spectrum(film, square, waves)
    alone = camera.sample(film, square, waves[0])
    assert found.weight.sum(axis=0).mean() == pytest.approx(alone.weight.mean(), rel=0.01)
    assert 0.02 < np.abs(found.film_mm - found.film_mm[0]).max() < 0.25  # lateral colour of tens of micrometres


@pytest.mark.parametrize("shape", [Aperture(mask=np.eye(7, dtype=bool)), *whole(Aperture(blades=5, rotation_deg=20.0))])
def test_shapes_of_the_stop_block_companions_as_they_block_heroes(shape: Aperture) -> None:
    """Summed over many rays, heroes and companions carry as much light as heroes alone, compiled or not."""
    plain = make_camera(MODEL, Shot(FILM, 2.0, 2.8, aperture=shape))
    for camera in (plain, plain.compiled()) if which("cc") else (plain,):  # type: ignore[attr-defined]
        weight, alone = shares(camera)
        assert 0.05 < np.mean(alone > 0) < 0.999
        assert weight.sum(axis=0).mean() == pytest.approx(alone.mean(), rel=0.015)
