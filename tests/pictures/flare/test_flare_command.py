"""`neurolens flare`: tables, layers, previews and colours, frames and scenes, and what it refuses."""

import json
import math
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import numpy as np
import OpenEXR
import pytest
from PIL import Image
from shipped import whole

from neurolens.cameras.build import make_camera
from neurolens.cameras.field import field_of
from neurolens.cli import flare as command, main
from neurolens.optics.lens.apertures import Aperture
from neurolens.optics.lens.designs import coated
from neurolens.optics.readers.lensfile import read_lens
from neurolens.optics.setting.states import set_lens
from neurolens.pictures import frames
from neurolens.pictures.flare.canvas import Raster
from neurolens.pictures.flare.diffraction import starburst_picture
from neurolens.pictures.flare.ghosts import GhostTracer
from neurolens.pictures.flare.job import FlareJob
from neurolens.pictures.flare.layers import flare_layers
from neurolens.pictures.flare.lights import Light, light_rays, with_disc
from neurolens.pictures.render.colour import ACESCG, COLOUR_SPACES, SRGB, conversion
from neurolens.pictures.render.pictures import read_colour_space, read_exr, read_layers, write_channels, write_exr
from neurolens.pictures.render.settings import FlareSettings
from tests.ghost_pictures import ghost_picture

COOKE = ["flare", "cooke_triplet_50", "--film", "36x24", "--width", "36", "--bins", "2"]


def layers_of(file: Path) -> dict[str, np.ndarray]:
    planes = read_layers(file)
    return {
        name[:-2]: np.stack([planes[f"{name[:-1]}{c}"] for c in "RGB"], -1) for name in planes if name.endswith("R")
    }


@pytest.fixture
def unmixed(monkeypatch: pytest.MonkeyPatch) -> None:
    """Colours as the light has them, before those that the space does not hold are mixed with grey."""
    monkeypatch.setattr(frames, "in_gamut", lambda colours, space: colours)


def test_table_and_picture(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "flare.exr"
    assert main(["flare", "laikin_double_gauss_50", "--light", "15,8"]) == 0
    said = capsys.readouterr().out
    assert "66 pairs" in said and "g12-11" in said
    drawn = tmp_path / "path.svg"
    assert main(["flare", "cooke_triplet_50", "--light", "15,8", "--path", "g05-03", str(drawn)]) == 0
    assert drawn.read_text().startswith("<?xml")
    capsys.readouterr()
    small = ["--width", "48", "--cell", "20", "--bins", "1", "--layers", "2", "--json"]
    assert main(["flare", "laikin_double_gauss_50", "--light", "15,8,0.5/0.4/0.3", "-o", str(out), *small]) == 0
    told = json.loads(capsys.readouterr().out)
    rgb, metadata = read_exr(out)
    layers = read_layers(out)
    header = OpenEXR.File(str(out), header_only=True).header()
    assert header["lensModel"] == "Double Gauss 50 mm f/1.8" and round(header["effectiveFocalLength"], 3) == 49.637
    assert rgb.shape == (32, 48, 3) and rgb.sum() > 0
    assert metadata["flare"]["ghosts"] == told["ghosts"]
    top = told["layers"]
    assert len(top) == 2
    names = [f"{name}.{c}" for name in ("ghosts", *top, "rest") for c in "RGB"]
    assert set(layers) == set(names)
    np.testing.assert_array_equal(layers["ghosts.R"], rgb[..., 0])
    np.testing.assert_allclose(sum(layers[f"{name}.R"] for name in (*top, "rest")), rgb[..., 0], rtol=1e-5, atol=1e-9)


@pytest.fixture(autouse=True, scope="module")
def seen_once() -> Iterator[None]:
    """The directions that a plate's film sees are sought once for a lens and its state: they take a second."""
    camera = cache(make_camera)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(command, "make_camera", lambda file, shot, _: camera(file, shot))
        patch.setattr(command, "field_of", cache(field_of))
        yield


def test_starburst_is_a_layer(tmp_path: Path) -> None:
    """What the module makes, added to the ghosts under its gain."""
    out = tmp_path / "star.exr"
    words = [
        "cooke_triplet_50",
        "--film",
        "36x24",
        "--light",
        "4,2,3",
        "--f-number",
        "11",
        "--blades",
        "5",
        "--width",
        "48",
    ]
    few = ["--bins", "2", "--cell", "20", "--quiet", "--starburst", "--gain", "starburst=2"]
    assert main(["flare", *words, *few, "-o", str(out)]) == 0
    layers, rgb = read_layers(out), read_exr(out)[0]
    lens = read_lens("lenses/cooke_triplet_50.toml").with_aperture(Aperture(blades=5))
    lens = set_lens(lens, f_number=11.0, focus_m=math.inf, focus_mode="best")
    lights = [Light(4.0, 2.0, (3.0, 3.0, 3.0))]
    alone = starburst_picture(FlareJob(lens, lights, Raster((36, 24), 48, 32), FlareSettings(bins=2)))
    np.testing.assert_allclose(layers["starburst.G"], 2 * alone[..., 1], rtol=1e-4, atol=1e-6 * alone.max())
    np.testing.assert_allclose(layers["ghosts.G"] + layers["starburst.G"], rgb[..., 1], rtol=1e-5)


SMALL = ["cooke_triplet_50", "--film", "36x24", "--width", "36", "--cell", "4", "--bins", "2", "--quiet"]


def test_frames_go_on_and_do_not_pop(tmp_path: Path) -> None:
    """A light that crosses: the energy changes evenly; frames that are there are kept, one that is not comes back."""
    lights, out = tmp_path / "lights.csv", tmp_path / "a.exr"
    lights.write_text("light,frame,azimuth_deg,elevation_deg\nsun,1,-3,14\nsun,3,3,14.2\n")
    words = ["flare", *SMALL, "--lights", str(lights), "--frames", "1:3", "--layers", "2", "-o", str(out)]
    assert main(words) == 0
    files = [tmp_path / f"a.{frame:04d}.exr" for frame in range(1, 4)]
    assert sorted(tmp_path.glob("*.exr")) == files
    energy = np.array([read_exr(file)[0][..., 1].sum() for file in files])
    assert np.abs(np.diff(energy)).max() < 0.1 * energy.mean()
    assert len({tuple(sorted(read_layers(file))) for file in files}) == 1
    kept, before = files[1].stat().st_mtime_ns, files[2].read_bytes()
    files[2].unlink()
    assert main(words) == 0
    assert files[1].stat().st_mtime_ns == kept and files[2].read_bytes() == before


@pytest.mark.usefixtures("unmixed")
def test_gains_and_tints(tmp_path: Path) -> None:
    """The gains of a ghost and of the layer multiply, and the layer stays the sum of its parts."""
    found = []
    gains = ["--gain", "g05-03=0.5", "--tint", "g05-03=1/0/2", "--gain", "ghosts=3"]
    for words in ([], gains):
        out = tmp_path / "a.exr"
        assert main(["flare", *SMALL, "--light", "-10,5", "--layers", "15", *words, "-o", str(out)]) == 0
        found.append(read_layers(out))
    plain, changed = found
    assert {"g05-03.R", "g04-03.R", "g05-01.G"} <= plain.keys() == changed.keys()
    for name, before in plain.items():
        if name.startswith(("g0", "rest")):
            factor = 1.5 * {"R": 1, "G": 0, "B": 2}[name[-1]] if name.startswith("g05-03") else 3.0
            np.testing.assert_allclose(changed[name], factor * before, rtol=1e-6)
    for c in "RGB":
        parts = sum(v for name, v in changed.items() if name.endswith(c) and not name.startswith("ghosts"))
        np.testing.assert_allclose(parts, changed[f"ghosts.{c}"], rtol=1e-5, atol=1e-9)


def test_highlights_are_where_the_lens_images_lights(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The direction of a highlight is that of the light whose image, traced exactly, lies in its pixel."""
    lens = set_lens(read_lens("lenses/cooke_triplet_50.toml"), focus_m=math.inf, f_number=8.0)
    light = Light(12.0, -6.0)
    rays, _ = light_rays(lens, light, 0, 4096)
    arrived = GhostTracer(lens, []).trace(rays, 550.0, direct=True)
    x, y = -arrived.film_xy_mm[0] @ arrived.power[0] / arrived.power[0].sum()
    plate, file = np.zeros((240, 360, 3), np.float32), tmp_path / "plate.0007.exr"
    plate[int(120 - 10 * y), int(180 + 10 * x)] = 50.0
    write_exr(file, plate)
    words = ["--image", str(tmp_path / "plate.####.exr"), "--f-number", "8", "--json"]
    assert main(["flare", *SMALL, *words, "--frames", "7:7", "-o", str(tmp_path / "a.exr")]) == 0
    (found,) = json.loads(capsys.readouterr().out)["lights"]
    pixel = math.degrees(0.1 / 50)
    assert found["azimuth_deg"] == pytest.approx(light.azimuth_deg, abs=0.8 * pixel)
    assert found["elevation_deg"] == pytest.approx(light.elevation_deg, abs=0.8 * pixel)
    write_channels(file, {c: np.full((24, 36), np.nan, np.float32) for c in "RGB"})
    assert main(["flare", *SMALL, "--image", str(file)]) == 2
    assert "finite" in capsys.readouterr().err


SCENE = """
points = [{ position_m = [-0.3, 1.3, 0.0], intensity = [2.0, 1.0, 0.5], illuminant = "2900 K" }]
[camera]
position_m = [0.0, 1.0, 2.0]
look_at_m = [0.0, 1.0, 0.0]
focus_m = 2.0
coating = "single-layer"
film_width_mm = 36.0
film_height_mm = 24.0
width = 36
height = 24
samples = 1
[film]
white_balance = "2900 K"
colour_space = "ACEScg"
[flare]
bins = 3
brightest = 2
"""


def test_a_scene_keeps_its_brightest_light_in_all_frames(tmp_path: Path) -> None:
    """A camera that passes two lamps has the light of the one that is much brighter, also beside the other."""
    scene, keys = tmp_path / "scene.toml", tmp_path / "camera.csv"
    lamp = "{ position_m = [-0.5, 1.0, 0.0], intensity = [2.0, 2.0, 2.0] }"
    text = SCENE.replace("points = [", f"points = [{lamp}, ").replace(', illuminant = "2900 K"', "")
    scene.write_text(text.replace("[2.0, 1.0, 0.5]", "[2.0, 0.0, 0.0]"))
    keys.write_text("frame,position,look-at\n1,-0.5/1/2,-0.5/1/0\n3,0.5/1/2,0.5/1/0\n")
    words = [*SMALL, "--lights", str(scene), "--frames", "1:3", "--key", str(keys), "--most", "1"]
    assert main(["flare", *words, "-o", str(tmp_path / "a.exr")]) == 0
    found = [read_exr(tmp_path / f"a.{k:04d}.exr")[1]["flare"]["lights"] for k in (1, 2, 3)]
    assert [len(lights) for lights in found] == [1, 1, 1]
    assert [lights[0]["rgb"][0] for lights in found] == pytest.approx([2 / 4] + [2 / 4.25, 2 / 5], rel=0.12)
    azimuths = [lights[0]["azimuth_deg"] for lights in found]
    assert azimuths[0] == pytest.approx(0.0, abs=0.01) and 0 > azimuths[1] > azimuths[2]


def test_renders_of_a_scene_have_its_flare(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The layers of a render are those of the command by the scene's lights and film, in the render's colours."""
    scene, out = tmp_path / "scene.toml", tmp_path / "a.exr"
    scene.write_text(SCENE.replace("[film]", "film_tilt_deg = 8.0\nfilm_rise_mm = 2.0\n[film]", 1))
    lens = "lenses/cooke_triplet_50.toml"
    assert main(["render", str(scene), "--camera", lens, "-o", str(out), "--layers", "beauty", "--quiet"]) == 0
    found = read_layers(out)
    assert len(found) == 12 and not read_exr(out)[0].any()
    words = ["--lights", str(scene), "--coating", "single-layer", "--focus", "2", "--bins", "3"]
    words += ["--film-tilt", "8", "--film-rise", "2"]
    words += ["--width", "36", "--colour-space", "ACEScg", "-o", str(out), "--quiet"]  # which holds these colours
    assert main(["flare", "cooke_triplet_50", "--film", "36x24", *words]) == 0
    ghosts = np.stack([found[f"ghosts.{c}"] for c in "RGB"], -1)
    plain = read_exr(out)[0]
    assert plain.any()
    # One matrix, the white balance's, takes all pixels.
    matrix, *_ = np.linalg.lstsq(plain.reshape(-1, 3).astype(float), ghosts.reshape(-1, 3), rcond=None)
    np.testing.assert_allclose(plain @ matrix, ghosts, atol=1e-4 * ghosts.max())
    scene.write_text(SCENE.replace('coating = "single-layer"\n', ""))  # a pinhole has no glass
    assert main(["render", str(scene), "--camera", "pinhole", "-o", str(out), "--layers", "beauty"]) == 0
    assert read_layers(out) == {} and "no flare: " in capsys.readouterr().err
    for table, said in (("bins = 0", "flare.bins"), ('without = ["x"]', "without"),
                        ("speed = 2", "flare.speed")):  # fmt: skip
        scene.write_text(SCENE.partition("[flare]")[0] + f"[flare]\n{table}\n")
        assert main(["render", str(scene), "--camera", lens, "-o", str(out), "--quiet"]) == 2
        assert said in capsys.readouterr().err


def test_ghosts_and_glare_are_all(tmp_path: Path) -> None:
    """Of the same seeds' photons; what scatters adds to the glare, and a share of the film is no share of the rest."""
    common = ["cooke_triplet_50", "--light", "12,5", "--width", "24", "--bins", "2", "--quiet"]
    # Bare, for of so many photons coated glass brings a few to the film, or none.
    common += ["--kernel", "0", "--photons", "300000", "--coating", "bare"]
    sums, found = [], {}
    for words in ([], ["--glare", "300000"], ["--glare", "300000", "--barrel", "0.5", "--sensor", "0.5", "--quick"]):
        out = tmp_path / "one.exr"
        assert main(["flare", *common, *words, "-o", str(out)]) == 0
        found = read_layers(out)
        assert set(found) == {f"{layer}.{c}" for layer in (["ghosts", "glare"] if words else ["ghosts"]) for c in "RGB"}
        sums.append((float(found["ghosts.G"].sum()), float(found["glare.G"].sum()) if words else 0.0))
    assert sum(sums[1]) == pytest.approx(sums[0][0], rel=0.02)
    assert 0 < sums[1][1] < 0.2 * sums[1][0]
    assert sums[2][1] > 2 * sums[1][1] and sums[2][0] == pytest.approx(sums[1][0], rel=0.1)


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--light", "180,0"], "within 90 degrees"),
        (["--light", "400,0"], "'400,0', expected angles within 90 degrees"),
        (["--light", "20m,0"], "AZ,EL"),
        (["--light", "1"], "AZ,EL"),
        (["--light", "1,2,1,0"], "positive distance"),
        (["--light", "0,0,1,0.001"], "outside the lens"),
        (["--light", "3,2,inf"], "from 0 to 1e+19"),
        (["--light", "3,2,0/0/1e20"], "from 0 to 1e+19"),
        (["--light", "3,2", "-o", "x.exr", "--gain", "ghosts=1e5", "--gain", "ghosts=1e5"], "from 0 to 1e+09"),
        (["--light", "0,0", "--coating", "s00"], "s00"),
        (["--light", "1,2", "--photons", "9", "--layers", "2", "-o", "x.exr"], "0 beside layers"),
        (["--light", "0,0", "--coating", "velvet"], "velvet"),
        (["--light", "1,2", "--reflections", "4"], "--photons or --glare"),
        (["--light", "0,0", "--key", "focus=1:2"], "--frames"),
        (["--light", "0,0", "--frames", "1:2"], "-o beside it"),
        (["--light", "0,0", "-o", "x.exr", "--gain", "s05=2"], "of this lens"),
        (["--light", "0,0", "-o", "x.exr", "--gain", "g01-00=2", "--photons", "9"], "single ghosts"),
        (["--lights", "none.csv"], "that exists"),
        (["--light", "0,0", "-o", "x.exr", "--width", "16384", "--film", "10x300", "--layers", "60"], "bytes"),
        (["--light", "0,0", "--path", "g99-01", "x.png"], "g99-01"),
        (["--light", "0,0", "--path", "g08-06", "x.gif"], "--path"),
    ],
)
def test_bad_words(words: list[str], said: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["flare", "laikin_double_gauss_50", *words]) == 2
    assert said in capsys.readouterr().err


def test_lights_have_the_units_that_people_type() -> None:
    assert command._light("20deg,-8 deg,3,4ft") == Light(20.0, -8.0, (3.0, 3.0, 3.0), 4 * 0.3048)


@pytest.mark.parametrize(
    ("option", "value"),
    [("--barrel", "1.1"), ("--haze", "nan"), ("--sensor", "0.95"), ("--glare", "-1"), ("--photons", "-1"),
     ("--photons", "1e9"), ("--photons", "2000000000")],
)  # fmt: skip
def test_numbers_have_bounds(option: str, value: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit, match="2"):
        main(["flare", "laikin_double_gauss_50", "--light", "0,0", option, value])
    assert option in capsys.readouterr().err


@pytest.mark.usefixtures("unmixed")
def test_layers_are_the_ghosts_with_the_greatest_peaks_on_the_film(tmp_path: Path) -> None:
    """Each ghost's own picture beside the layers, with the light of the sun that is meant."""
    out, raster = tmp_path / "flare.exr", Raster((36.0, 24.0), 36, 24)
    words = ["--light", "-10,5", "--coating", "quarter-wave", "--layers", "12", "-o", str(out)]
    assert main([*COOKE[:-2], *words]) == 0
    lens = set_lens(read_lens("lenses/cooke_triplet_50.toml"), focus_m=math.inf, focus_mode="best")
    tracer = GhostTracer(coated(lens, "quarter-wave"))
    sun = with_disc(Light(-10, 5, (math.pi,) * 3), 0.533)
    job = FlareJob(tracer.lens, [sun], raster, ghosts=tracer)
    each = ghost_picture(job, range(len(tracer.pairs)))
    order = np.argsort(-each.max((1, 2, 3)))
    found = layers_of(out)
    assert set(found) == {"ghosts", "rest", *(tracer.pairs[k].name for k in order[:12])}
    for k in order[:12]:
        np.testing.assert_allclose(found[tracer.pairs[k].name], each[k], rtol=1e-4, atol=1e-6 * each[k].max())
    assert found["rest"].max() < found["ghosts"].max() / 20
    np.testing.assert_allclose(found["rest"], each[order[12:]].sum(0), rtol=1e-3, atol=1e-4 * each.max())


def test_no_layer_is_black(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """More layers than ghosts that reach a small film, one of them with a gain of 0: the others alone, and no rest."""
    out = tmp_path / "flare.exr"
    few = ["--light", "25,12", "--film", "4x3", "--layers", "64", "--gain", "g05-03=0", "-o", str(out)]
    assert main([*COOKE, *few[:-2], "--layers", "0", "-o", str(out)]) == 0
    whole = read_exr(out)[0]
    assert main([*COOKE, *few]) == 0
    found = layers_of(out)
    assert "not 64" in capsys.readouterr().err
    assert 0 < len(found) - 1 < 14 and "rest" not in found and "g05-03" not in found
    assert all(layer.any() for layer in found.values())
    np.testing.assert_allclose(sum(v for name, v in found.items() if name != "ghosts"), whole, rtol=1e-4, atol=1e-9)


def test_a_light_is_a_sun_unless_its_irradiance_is_stated(tmp_path: Path) -> None:
    """The sun of a white card of radiance 1 has the irradiance pi; on the command line it has its disc, too."""
    lists, pictures = tmp_path / "lights.csv", []
    lists.write_text("azimuth_deg,elevation_deg,diameter_deg\n15,8,0.533\n")
    for k, words in enumerate((["--light", "15,8"], ["--light", f"15,8,{math.pi}"], ["--lights", str(lists)])):
        assert main([*COOKE, *words, "-o", str(tmp_path / f"{k}.exr")]) == 0
        pictures.append(read_exr(tmp_path / f"{k}.exr")[0])
    assert main([*COOKE, "--light", "15,8,1", "-o", str(tmp_path / "one.exr")]) == 0
    np.testing.assert_allclose(pictures[1], math.pi * read_exr(tmp_path / "one.exr")[0], rtol=1e-5)
    np.testing.assert_allclose(pictures[0], pictures[2], rtol=1e-5)
    assert pictures[0].sum() == pytest.approx(pictures[1].sum(), rel=1e-3)
    assert not np.allclose(pictures[0], pictures[1], rtol=0.01)


def test_the_preview_shows_the_flare(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """99% of the lit pixels are no brighter than 0.8, which sRGB encodes as 231, at any irradiance; or as stated."""
    stops = []
    for light in ("15,8,1", "15,8,0.01"):
        out = tmp_path / "flare.exr"
        assert main([*COOKE, "--light", light, "--width", "120", "-o", str(out), "--json"]) == 0
        told = json.loads(capsys.readouterr().out)
        shown = np.asarray(Image.open(tmp_path / "flare.png"))
        assert shown.shape == (80, 120, 3) and told["preview"] == [str(tmp_path / "flare.png")]
        lit = read_exr(out)[0].max(-1) > 0
        assert np.quantile(shown.max(-1)[lit], 0.99) == pytest.approx(231, abs=2)
        stops.append(told["exposure"])
    assert stops[1] - stops[0] == pytest.approx(math.log2(100), abs=0.02)
    assert main([*COOKE, "--light", "15,8,0.01", "--exposure", "-20", "-o", str(out)]) == 0
    assert not np.asarray(Image.open(tmp_path / "flare.png")).any()
    assert "-20 stops" in capsys.readouterr().out


def test_frames_share_one_exposure(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A light that fades by two stops fades in the previews, too, also where some frames are made later."""
    lights, out = tmp_path / "lights.csv", tmp_path / "a.exr"
    lights.write_text("light,frame,azimuth_deg,elevation_deg,r,g,b\nsun,1,5,3,1,1,1\nsun,2,5,3,0.25,0.25,0.25\n")
    words = [*COOKE, "--lights", str(lights), "--frames", "1:2", "-o", str(out), "--json"]
    assert main(words) == 0
    first = json.loads(capsys.readouterr().out)
    before = [np.asarray(Image.open(file)) for file in map(Path, first["preview"])]
    assert before[1].max() < 0.75 * before[0].max()
    (tmp_path / "a.0002.exr").unlink()
    assert main(words) == 0
    assert json.loads(capsys.readouterr().out)["exposure"] == first["exposure"]
    assert np.array_equal(np.asarray(Image.open(tmp_path / "a.0002.png")), before[1])


@pytest.mark.usefixtures("unmixed")
def test_colours_are_those_of_the_space_that_is_asked_for(tmp_path: Path) -> None:
    """ACEScg has the values that the definition of both spaces gives, in the picture and in its layers."""
    plain, other = tmp_path / "plain.exr", tmp_path / "aces.exr"
    words = [*COOKE, "--light", "15,8,1/0.5/0.1", "--layers", "2", "-o"]
    assert main([*words, str(plain)]) == 0
    assert main([*words, str(other), "--colour-space", "ACEScg"]) == 0
    # sRGB to ACEScg with Bradford's adaptation, as the Academy's CTL computes it.
    matrix = [[0.61309, 0.33953, 0.04737], [0.07020, 0.91635, 0.01345], [0.02062, 0.10957, 0.86981]]
    expected, found = layers_of(plain), layers_of(other)
    assert expected.keys() == found.keys() and len(found) == 4
    pairs = [(read_exr(plain)[0], read_exr(other)[0]), *((expected[n], found[n]) for n in found)]
    for picture, aces in pairs:
        np.testing.assert_allclose(aces, picture @ np.transpose(matrix), atol=3e-5 * picture.max())
    header = OpenEXR.File(str(other), header_only=True).header()
    assert header["chromaticities"] == pytest.approx(ACESCG.chromaticities, abs=1e-6)
    assert header["colorInteropID"] == ACESCG.interop_id
    assert read_exr(other)[1]["colour"]["space"] == "ACEScg"
    assert (read_colour_space(plain), read_colour_space(other)) == (SRGB, ACESCG)


def test_a_plate_says_its_colours(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """One highlight, written in both spaces: the same light, and flare in the space of the plate."""
    picture = np.zeros((24, 36, 3), np.float32)
    picture[8, 20] = 40.0, 20.0, 10.0
    found = []
    for space in (SRGB, ACESCG):
        plate, out = tmp_path / f"{space.name}.exr", tmp_path / "flare.exr"
        write_exr(plate, picture, space=space)
        assert main([*COOKE, "--image", str(plate), "-o", str(out), "--json"]) == 0
        (light,) = json.loads(capsys.readouterr().out)["lights"]
        assert read_colour_space(out) is space
        found.append([*light["rgb"], light["azimuth_deg"], *read_exr(out)[0].reshape(-1, 3).sum(0)])
    assert found[1][:4] == pytest.approx(found[0][:4], rel=1e-4)
    assert found[1][4:] == pytest.approx(conversion(SRGB, ACESCG) @ found[0][4:], rel=1e-3)
    # Without chromaticities the plate has the space that is asked for; those of another space are told.
    channels = {c: np.ascontiguousarray(read_exr(plate)[0][..., k]) for k, c in enumerate("RGB")}
    write_channels(plate, channels)
    assert main([*COOKE, "--image", str(plate), "--colour-space", "ACEScg", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["lights"][0]["rgb"] == pytest.approx(found[0][:3], rel=1e-4)
    write_channels(plate, channels, attributes={"chromaticities": (0.7, 0.3, 0.2, 0.7, 0.1, 0.1, 0.3, 0.3)})
    assert main([*COOKE, "--image", str(plate)]) == 0
    assert "neither sRGB nor ACEScg" in capsys.readouterr().err


def test_no_picture_replaces_what_it_is_made_from(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The preview beside OUT.exr would be the mask of the stop; OUT.exr itself would be the plate."""
    mask, plate = tmp_path / "stop.png", tmp_path / "plate.exr"
    Image.new("L", (8, 8), 255).save(mask)
    write_exr(plate, np.full((24, 36, 3), 3.0, np.float32))
    for words in (["--light", "5,3", "--aperture-mask", str(mask), "-o", str(mask.with_suffix(".exr"))],
                  ["--image", str(plate), "-o", str(plate)]):  # fmt: skip
        before = mask.read_bytes(), plate.read_bytes()
        assert main([*COOKE, *words]) == 2
        assert "another name" in capsys.readouterr().err
        assert (mask.read_bytes(), plate.read_bytes()) == before


@pytest.mark.parametrize("space", COLOUR_SPACES)
@pytest.mark.parametrize("colour", ["0/0/1", *whole("0/1/0", "1/0/0.2")])
def test_no_picture_is_negative(tmp_path: Path, space: str, colour: str, capsys: pytest.CaptureFixture[str]) -> None:
    """Flare of saturated lights: nothing below zero, the luminance of the light kept, the layers still its sums."""
    out = tmp_path / "led.exr"
    words = [
        "flare",
        "cooke_triplet_50",
        "--film",
        "36x24",
        "--light",
        f"15,8,{colour}",
        "--width",
        "48",
        "--cell",
        "16",
        "--coating",
        "bare",
    ]
    assert main([*words, "--bins", "4", "--layers", "2", "--colour-space", space, "-o", str(out)]) == 0
    said = capsys.readouterr().err
    rgb, layers = read_exr(out)[0], layers_of(out)
    assert min(picture.min() for picture in (rgb, *layers.values())) >= 0
    np.testing.assert_array_equal(layers["ghosts"], rgb)
    np.testing.assert_allclose(sum(v for name, v in layers.items() if name != "ghosts"), rgb, rtol=1e-5, atol=1e-7)
    lens = set_lens(read_lens("lenses/cooke_triplet_50.toml"), focus_m=math.inf, focus_mode="best", coating="bare")
    light = Light(15.0, 8.0, tuple(map(float, colour.split("/"))))
    job = FlareJob(lens, [light], Raster((36, 24), 48, 32), FlareSettings(bins=4, cell_px=16.0))
    raw = flare_layers(job)["ghosts"]
    assert raw.min() < 0
    to_y = COLOUR_SPACES[space].to_xyz[1]
    light_of = raw @ conversion(SRGB, COLOUR_SPACES[space]).T @ to_y
    bright = light_of > 0.01 * light_of.max()
    assert bright.mean() > 0.5
    np.testing.assert_allclose((rgb @ to_y)[bright], light_of[bright], rtol=1e-4)
    assert space == "ACEScg" or colour[0] == "1" or ("mixed with grey" in said and "ACEScg" in said)
