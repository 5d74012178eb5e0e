"""Profiles: names read and matched; the formulae of distortion, colour and light as lensfun itself evaluates them."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from neurolens.base.errors import InputError
from neurolens.optics.photographs import profiles
from neurolens.optics.photographs.profiles import FAR_M, Profile, database, matches, name_of, profile_named, profiles_in

lensfunpy = pytest.importorskip("lensfunpy")


@pytest.mark.parametrize(
    ("text", "focal", "f_number", "words"),
    [
        ("Nikon AF-S Nikkor 28mm f/1.4E ED", (28, 28), 1.4, {"nikon", "af", "s", "e", "ed"}),
        ("Sigma 18-35mm F1.8 DC HSM | Art", (18, 35), 1.8, {"sigma", "dc", "hsm", "art"}),
        ("XF27mmF2.8", (27, 27), 2.8, {"xf"}),
        ("Zeiss Makro-Planar T* 2/100 ZF.2", (100, 100), 2.0, {"zeiss", "makro", "planar", "zf", "2"}),
        ("LUMIX G VARIO 35-100mm/F2.8", (35, 100), 2.8, {"lumix", "g", "vario"}),
        ("Minolta MD Rokkor 50mm 1:1.4", (50, 50), 1.4, {"minolta", "md"}),
        ("Pentax-DA 50-135mm F2.8ED[IF] SDM", (50, 135), 2.8, {"pentax", "da", "ed", "if", "sdm"}),
        ("Nikon AF Zoom-Nikkor 28-85mm f3.5-4.5", (28, 85), 3.5, {"nikon", "af"}),
    ],
)  # fmt: skip
def test_names_give_focal_lengths_aperture_and_words(
    text: str, focal: tuple[float, float], f_number: float, words: set[str]
) -> None:
    name = name_of(text)
    assert name is not None and name.focal_mm == focal and name.f_number == f_number and name.words == words


@pytest.mark.parametrize("text", ["", "Zoom lens", "a\0b", "1e309mm f/0", "-5mm"])
def test_other_texts_are_no_names_or_match_nothing(text: str) -> None:
    assert name_of(text) is None or not matches([text])


@pytest.mark.parametrize(
    ("text", "model", "certainty"),
    [
        ("Canon TS-E90mm f2.8L Macro", "Canon TS-E 90mm f/2.8", "likely"),
        ("Sony Sonnar T* FE 55mm F1.8 ZA", "FE 55mm f/1.8 ZA", "certain"),
        ("Canon EF50mm f1.4 USM", "Canon EF 50mm f/1.4 USM", "certain"),
        ("Nikon AF Nikkor 28mm f1.4D", "Nikon AF Nikkor 28mm f/1.4D", "certain"),
        # Another mount, another version: never certain.
        ("Canon RF50mm F1.2 L USM", "Canon EF 50mm f/1.2L USM", "not certain"),
        ("Canon EF300mm f2.8L IS USM", "Canon EF 300mm f/2.8L IS II USM", "not certain"),
    ],
)
def test_the_likeliest_profile_and_how_certain_it_is(text: str, model: str, certainty: str) -> None:
    best = matches([text])[0]
    assert best.profile.model == model
    assert best.certainty == certainty or (certainty == "not certain" and best.certainty != "certain")


def test_the_database_is_whole() -> None:
    found = database()
    assert len(found) > 1200 and sum(bool(p.light) for p in found) > 500
    assert all(p.crop > 0 and p.aspect > 0 and p.unit_mm > 0 for p in found)


WIDTH, HEIGHT = 3001, 2001  # pixels of 3:2, so that half the short side is 1000
MIDDLE = (HEIGHT // 2, WIDTH // 2)
FAR_PX = slice(400, 1500, 100)  # from the middle, to the right: lensfun's own middle is a fraction of a pixel off


def lensfun_s(model: str, f_number: float = 8.0) -> tuple[Profile, Any]:
    """A profile, and lensfun's own evaluation of it for a picture."""
    profile = profile_named(model)[0]
    lens = next(x for x in lensfunpy.Database().lenses if x.model == model)
    modifier = lensfunpy.Modifier(lens, lens.crop_factor, WIDTH, HEIGHT)
    modifier.initialize(lens.min_focal, f_number, FAR_M, scale=1.0, pixel_format=np.float32)
    return profile, modifier


@pytest.mark.parametrize("model", ["FE 55mm f/1.8 ZA", "Nikon AF Nikkor 28mm f/1.4D", "Canon EF 50mm f/1.4 USM"])
def test_distortion_is_that_of_lensfun(model: str) -> None:
    """lensfun says where in the photograph each pixel of the corrected picture lies."""
    profile, modifier = lensfun_s(model)
    measured = modifier.apply_geometry_distortion()[MIDDLE[0], MIDDLE[1] :, 0].astype(float)[FAR_PX] - MIDDLE[1]
    expected = measured / np.arange(WIDTH // 2 + 1)[FAR_PX]
    ours = profile.stretch(profile.distortion[0], measured / 1000 * profile.unit_mm)
    ratio = ours / expected
    np.testing.assert_allclose(ratio / ratio.mean(), 1, atol=1e-4)


@pytest.mark.parametrize("model", ["FE 55mm f/1.8 ZA", "Canon EF 50mm f/1.4 USM"])
def test_colour_is_that_of_lensfun(model: str) -> None:
    profile, modifier = lensfun_s(model)
    row = modifier.apply_subpixel_distortion()[MIDDLE[0], MIDDLE[1] :][FAR_PX, :, 0].astype(float)
    px = row[:, 1] - MIDDLE[1]
    for radial, column in ((profile.red[0], 0), (profile.blue[0], 2)):
        shift_um = (row[:, column] - row[:, 1]) * profile.unit_mm  # of a thousandth of half the short side
        np.testing.assert_allclose(profile.shift_um(radial, px / 1000 * profile.unit_mm), shift_um, atol=0.02)


@pytest.mark.parametrize("f_number", [1.8, 8.0])
def test_light_is_that_of_lensfun(f_number: float) -> None:
    profile, modifier = lensfun_s("FE 55mm f/1.8 ZA", f_number)
    picture = np.ones((HEIGHT, WIDTH, 3), np.float32)
    modifier.apply_color_modification(picture)  # brightens corners
    stops = -np.log2(picture[MIDDLE[0], MIDDLE[1] :, 0].astype(float))[FAR_PX]
    (light,) = (row for row in profile.light_at(55.0) if row.f_number == f_number)
    height_mm = np.arange(WIDTH // 2 + 1)[FAR_PX] / 1000 * profile.unit_mm
    np.testing.assert_allclose(profile.stops(light, height_mm), stops, atol=2e-3)


def test_a_name_that_lensfun_does_not_have_is_refused_with_near_ones() -> None:
    with pytest.raises(InputError, match="such as .*50mm"):
        profile_named("Canon EF 50mm f/1.2")


def test_without_the_package_one_line_says_how_to_get_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(profiles, "find_spec", lambda name: None)
    with pytest.raises(InputError, match=r"pip install '\.\[photographs\]'"):
        database.__wrapped__()


def test_a_damaged_database_is_refused(tmp_path: Path) -> None:
    file = tmp_path / "broken.xml"
    file.write_text("<lensdatabase><lens>", encoding="utf-8")
    with pytest.raises(InputError, match="broken.xml"):
        profiles_in(file)
