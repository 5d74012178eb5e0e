"""What `neurolens flare` writes where a user states nothing more: which ghosts are layers, preview, colours."""

import json
import math
from pathlib import Path

import numpy as np
import OpenEXR
import pytest
from PIL import Image

from neurolens.cli import main
from neurolens.flare.canvas import Raster
from neurolens.flare.ghosts import GhostTracer, coated
from neurolens.flare.lights import Light, with_disc
from neurolens.flare.picture import ghost_picture
from neurolens.readers.lensfile import read_lens
from neurolens.render.colour import ACESCG, SRGB, conversion
from neurolens.render.pictures import read_colour_space, read_exr, read_layers, write_channels, write_exr
from neurolens.setting.states import set_lens

GAUSS = ["flare", "laikin_double_gauss_50", "--light", "15,8", "--coating", "quarter-wave"]
SMALL = ["flare", "cooke_triplet_50", "--width", "36", "--bins", "2"]


def layers_of(file: Path) -> dict[str, np.ndarray]:
    planes = read_layers(file)
    return {
        name[:-2]: np.stack([planes[f"{name[:-1]}{c}"] for c in "RGB"], -1) for name in planes if name.endswith("R")
    }


def test_layers_are_the_ghosts_with_the_greatest_peaks_on_the_film(tmp_path: Path) -> None:
    """Of the README's case: each ghost's own picture beside the layers, with the light of the sun that is meant."""
    out, raster = tmp_path / "flare.exr", Raster((36.0, 24.0), 240, 160)
    assert main([*GAUSS, "--layers", "8", "--width", "240", "-o", str(out)]) == 0
    lens = set_lens(read_lens("lenses/laikin_double_gauss_50.toml"), focus_m=math.inf, focus_mode="best")
    tracer = GhostTracer(coated(lens, "quarter-wave"))
    sun = with_disc(Light(15, 8, (math.pi,) * 3), 0.533)
    each = ghost_picture(tracer, [sun], raster, layers=range(len(tracer.pairs)))
    order = np.argsort(-each.max((1, 2, 3)))
    found = layers_of(out)
    assert set(found) == {"ghosts", "rest", *(tracer.pairs[k].name for k in order[:8])}
    for k in order[:8]:
        np.testing.assert_allclose(found[tracer.pairs[k].name], each[k], rtol=1e-4, atol=1e-6 * each[k].max())
    assert found["rest"].max() < found["ghosts"].max() / 20
    np.testing.assert_allclose(found["rest"], each[order[8:]].sum(0), rtol=1e-3, atol=1e-4 * each.max())


def test_no_layer_is_black(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """More layers than ghosts that reach a small film, one of them with a gain of 0: the others alone, and no rest."""
    out = tmp_path / "flare.exr"
    few = ["--light", "25,12", "--film", "4x3", "--layers", "64", "--gain", "g05-03=0", "-o", str(out)]
    assert main([*SMALL, *few[:-2], "--layers", "0", "-o", str(out)]) == 0
    whole = read_exr(out)[0]
    assert main([*SMALL, *few]) == 0
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
        assert main([*SMALL, *words, "-o", str(tmp_path / f"{k}.exr")]) == 0
        pictures.append(read_exr(tmp_path / f"{k}.exr")[0])
    assert main([*SMALL, "--light", "15,8,1", "-o", str(tmp_path / "one.exr")]) == 0
    np.testing.assert_allclose(pictures[1], math.pi * read_exr(tmp_path / "one.exr")[0], rtol=1e-5)
    np.testing.assert_allclose(pictures[0], pictures[2], rtol=1e-5)
    assert pictures[0].sum() == pytest.approx(pictures[1].sum(), rel=1e-3)
    assert not np.allclose(pictures[0], pictures[1], rtol=0.01)


def test_the_preview_shows_the_flare(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """99% of the lit pixels are no brighter than 0.8, which sRGB encodes as 231, at any irradiance; or as stated."""
    stops = []
    for light in ("15,8,1", "15,8,0.01"):
        out = tmp_path / "flare.exr"
        assert main([*SMALL, "--light", light, "--width", "120", "-o", str(out), "--json"]) == 0
        told = json.loads(capsys.readouterr().out)
        shown = np.asarray(Image.open(tmp_path / "flare.png"))
        assert shown.shape == (80, 120, 3) and told["preview"] == [str(tmp_path / "flare.png")]
        lit = read_exr(out)[0].max(-1) > 0
        assert np.quantile(shown.max(-1)[lit], 0.99) == pytest.approx(231, abs=2)
        stops.append(told["exposure"])
    assert stops[1] - stops[0] == pytest.approx(math.log2(100), abs=0.02)
    assert main([*SMALL, "--light", "15,8,0.01", "--exposure", "-20", "-o", str(out)]) == 0
    assert not np.asarray(Image.open(tmp_path / "flare.png")).any()
    assert "-20 stops" in capsys.readouterr().out


def test_frames_share_one_exposure(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A light that fades by two stops fades in the previews, too, also where some frames are made later."""
    lights, out = tmp_path / "lights.csv", tmp_path / "a.exr"
    lights.write_text("light,frame,azimuth_deg,elevation_deg,r,g,b\nsun,1,5,3,1,1,1\nsun,2,5,3,0.25,0.25,0.25\n")
    words = [*SMALL, "--lights", str(lights), "--frames", "1:2", "-o", str(out), "--json"]
    assert main(words) == 0
    first = json.loads(capsys.readouterr().out)
    before = [np.asarray(Image.open(file)) for file in map(Path, first["preview"])]
    assert before[1].max() < 0.75 * before[0].max()
    (tmp_path / "a.0002.exr").unlink()
    assert main(words) == 0
    assert json.loads(capsys.readouterr().out)["exposure"] == first["exposure"]
    assert np.array_equal(np.asarray(Image.open(tmp_path / "a.0002.png")), before[1])


def test_colours_are_those_of_the_space_that_is_asked_for(tmp_path: Path) -> None:
    """ACEScg has the values that the definition of both spaces gives, in the picture and in its layers."""
    plain, other = tmp_path / "plain.exr", tmp_path / "aces.exr"
    words = [*SMALL, "--light", "15,8,1/0.5/0.1", "--layers", "2", "-o"]
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
        assert main([*SMALL, "--image", str(plate), "-o", str(out), "--json"]) == 0
        (light,) = json.loads(capsys.readouterr().out)["lights"]
        assert read_colour_space(out) is space
        found.append([*light["rgb"], light["azimuth_deg"], *read_exr(out)[0].reshape(-1, 3).sum(0)])
    assert found[1][:4] == pytest.approx(found[0][:4], rel=1e-4)
    assert found[1][4:] == pytest.approx(conversion(SRGB, ACESCG) @ found[0][4:], rel=1e-3)
    # Without chromaticities the plate has the space that is asked for; those of another space are told.
    channels = {c: np.ascontiguousarray(read_exr(plate)[0][..., k]) for k, c in enumerate("RGB")}
    write_channels(plate, channels)
    assert main([*SMALL, "--image", str(plate), "--colour-space", "ACEScg", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["lights"][0]["rgb"] == pytest.approx(found[0][:3], rel=1e-4)
    write_channels(plate, channels, attributes={"chromaticities": (0.7, 0.3, 0.2, 0.7, 0.1, 0.1, 0.3, 0.3)})
    assert main([*SMALL, "--image", str(plate)]) == 0
    assert "neither sRGB nor ACEScg" in capsys.readouterr().err


def test_no_picture_replaces_what_it_is_made_from(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The preview beside OUT.exr would be the mask of the stop; OUT.exr itself would be the plate."""
    mask, plate = tmp_path / "stop.png", tmp_path / "plate.exr"
    Image.new("L", (8, 8), 255).save(mask)
    write_exr(plate, np.full((24, 36, 3), 3.0, np.float32))
    for words in (["--light", "5,3", "--aperture-mask", str(mask), "-o", str(mask.with_suffix(".exr"))],
                  ["--image", str(plate), "-o", str(plate)]):  # fmt: skip
        before = mask.read_bytes(), plate.read_bytes()
        assert main([*SMALL, *words]) == 2
        assert "another name" in capsys.readouterr().err
        assert (mask.read_bytes(), plate.read_bytes()) == before
