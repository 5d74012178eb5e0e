"""Colour spaces against their standards, and what an EXR says of them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import OpenEXR
import pytest
from command_line import failure, run_json

from neurolens.render.colour import (
    ACESCG,
    BRADFORD,
    COLOUR_SPACES,
    SRGB,
    adaptation,
    balance,
    conversion,
    linear_to_srgb,
    srgb_to_linear,
    xyz_of,
)
from neurolens.render.pictures import read_exr, write_exr


def test_matrices_of_the_standards() -> None:
    # IEC 61966-2-1, rounded to 4 digits there.
    srgb = [[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]]
    assert SRGB.to_xyz == pytest.approx(np.array(srgb), abs=6e-5)
    # Academy S-2014-004, transformation from XYZ to ACEScg.
    from_xyz = [
        [1.6410233797, -0.3248032942, -0.2364246952],
        [-0.6636628587, 1.6153315917, 0.0167563477],
        [0.0117218943, -0.0082844420, 0.9883948585],
    ]
    assert np.linalg.inv(ACESCG.to_xyz) == pytest.approx(np.array(from_xyz), abs=1e-9)


def test_adaptation_of_the_academy_s_transforms() -> None:
    # ACES CTL, D60_2_D65_CAT: Bradford.
    published = [
        [0.987224, -0.00611327, 0.0159533],
        [-0.00759836, 1.00186, 0.00533002],
        [0.00307257, -0.00509595, 1.08168],
    ]
    d60, d65 = xyz_of(ACESCG.white), xyz_of(SRGB.white)
    assert adaptation(d60, d65) == pytest.approx(np.array(published), abs=5e-6)
    assert adaptation(d65, d60) @ adaptation(d60, d65) == pytest.approx(np.eye(3), abs=1e-12)
    assert adaptation(d60, d65) @ (3 * d60) == pytest.approx(3 * d65, abs=1e-12)
    assert BRADFORD.sum(axis=1) == pytest.approx(1, abs=2e-4)  # equal energy gives equal responses


def test_srgb_to_acescg_as_published_and_white_stays_white() -> None:
    matrix = conversion(SRGB, ACESCG)
    published = [[0.613097, 0.339523, 0.047379], [0.070194, 0.916354, 0.013452], [0.020616, 0.109570, 0.869815]]
    assert matrix == pytest.approx(np.array(published), abs=1.5e-6)
    assert matrix @ np.ones(3) == pytest.approx(np.ones(3), abs=1e-12)
    assert conversion(SRGB, SRGB) == pytest.approx(np.eye(3), abs=1e-12)
    assert conversion(ACESCG, SRGB) @ matrix == pytest.approx(np.eye(3), abs=1e-12)


@pytest.mark.parametrize("white", [(1.0, 1.0, 1.0), (1.9, 0.9, 0.25), (0.7, 1.0, 1.8)])
def test_balance_makes_a_colour_neutral_at_its_luminance(white: tuple[float, float, float]) -> None:
    luminance = SRGB.to_xyz[1] @ white
    assert balance(white) @ white == pytest.approx(np.full(3, luminance), rel=1e-12)
    assert balance(2 * np.array(white)) == pytest.approx(balance(white), abs=1e-12)


@pytest.mark.parametrize("half", [False, True])
@pytest.mark.parametrize("name", list(COLOUR_SPACES))
def test_the_exr_says_its_colour_space(name: str, half: bool, tmp_path: Path) -> None:
    space = COLOUR_SPACES[name]
    picture = np.random.default_rng(3).random((4, 6, 3), np.float32)
    picture[0, 0] = 1
    write_exr(tmp_path / "a.exr", picture, half=half, space=space)
    with OpenEXR.File(str(tmp_path / "a.exr")) as file:
        header = file.header()
        assert header["chromaticities"] == pytest.approx(space.chromaticities, abs=1e-7)
        assert header["colorInteropID"] == space.interop_id
        assert header["adoptedNeutral"] == pytest.approx(space.white, abs=1e-7)
    stored, _ = read_exr(tmp_path / "a.exr")
    assert stored[0, 0] == pytest.approx(np.ones(3), abs=1e-3 if half else 1e-6)
    back = stored @ conversion(space, SRGB).T
    assert back == pytest.approx(picture, abs=2e-3 if half else 1e-6)


def test_srgb_encoding_round_trip() -> None:
    linear = np.linspace(0, 1, 101)
    assert np.allclose(srgb_to_linear(linear_to_srgb(linear)), linear, atol=1e-6)
    assert linear_to_srgb(np.array([-1.0, np.nan, 9.0])) == pytest.approx([0, 0, 1], abs=1e-6)


def test_the_command_line_chooses_space_and_white(
    scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    white = 'illuminant = "3200 K"\n'
    scene.write_text(scene.read_text().partition("[materials]")[0] + white)
    out = tmp_path / "o.exr"
    base = ("render", scene, "--camera", "pinhole", "--efl", 400, "--samples", 64, "-o", out, "--quiet")
    data = run_json(capsys, *base, "--colour-space", "ACEScg", "--white-balance", "3200 K")
    assert data["white_balance"] == "3200 K"
    rgb, metadata = read_exr(out)
    assert metadata["colour"] == {"space": "ACEScg", "white_xy": [0.32168, 0.33767], "adaptation": "Bradford"}
    assert rgb.mean(axis=(0, 1)) == pytest.approx([1, 1, 1], abs=0.01)
    run_json(capsys, *base)
    warm = read_exr(out)[0].mean(axis=(0, 1))
    assert warm[0] > 1.3 and warm[2] < 0.5
    said = failure(capsys, *base, "--white-balance", "F99")
    assert "ball.toml: --white-balance: got 'F99', expected one of: D65, D50, A, E" in said
    scene.write_text('[film]\ncolour_space = "Rec2020"\n' + scene.read_text())
    assert "film.colour_space: got 'Rec2020', expected one of: 'sRGB', 'ACEScg'" in failure(capsys, *base)
