"""Lights of known spectra and colour spaces: closed forms, chromaticities and matrices of the standards, mistakes."""

from pathlib import Path
from typing import Any

import numpy as np
import OpenEXR
import pytest
from command_line import failure, run_json
from render_helpers import FILM, WHITE, diffuse, scene

from neurolens.base.errors import InputError
from neurolens.cameras.ideal import Pinhole
from neurolens.pictures.render.colour import (
    ACESCG,
    BRADFORD,
    COLOUR_SPACES,
    SRGB,
    SpectralRange,
    adaptation,
    balance,
    conversion,
    illuminant,
    linear_to_srgb,
    planck,
    srgb_to_linear,
    table,
    xyz_of,
)
from neurolens.pictures.render.pictures import read_exr, write_exr
from neurolens.pictures.render.renderer import render
from neurolens.pictures.render.scene import load_scene
from neurolens.pictures.render.settings import FilmSettings

CAMERA = Pinhole(400.0, FILM)
# CIE 15:2018, tables T.3 and T.8.1; black bodies: Wyszecki and Stiles 1982, table 1(3.11), c2 = 0.014388 m K.
PUBLISHED = {
    "A": (0.44758, 0.40745),
    "D50": (0.34567, 0.35851),
    "D65": (0.31272, 0.32903),
    "E": (0.33333, 0.33333),
    "1500 K": (0.5857, 0.3931),
    "2000 K": (0.5267, 0.4133),
    "3000 K": (0.4369, 0.4041),
    "4000 K": (0.3805, 0.3768),
    "5000 K": (0.3451, 0.3516),
    "6500 K": (0.3135, 0.3237),
    "10000 K": (0.2806, 0.2883),
}


def chromaticity(xyz: np.ndarray) -> np.ndarray:
    return np.asarray(xyz[:2] / xyz.sum())


@pytest.mark.parametrize("name", PUBLISHED)
def test_chromaticities_of_the_cie(name: str) -> None:
    found = illuminant(name)
    assert found is not None
    values = np.interp(table("wavelength_nm"), *found)
    xyz = np.array([table(axis) @ values for axis in "xyz"])
    assert chromaticity(xyz) == pytest.approx(PUBLISHED[name], abs=1e-4)


@pytest.mark.parametrize(("limits", "tolerance"), [((380, 780), 8e-4), ((400, 700), 1.2e-3)])
@pytest.mark.parametrize("name", PUBLISHED)
def test_the_film_sees_those_chromaticities(name: str, limits: tuple[float, float], tolerance: float) -> None:
    # The film's response is bent a little so that surface colours come back exactly: the price is here.
    found = illuminant(name)
    assert found is not None
    light = SpectralRange(*limits).relative(*found)
    xyz = SRGB.to_xyz @ SpectralRange(*limits).film_rgb(light)
    assert xyz[1] == pytest.approx(1, abs=1e-9)
    assert chromaticity(xyz) == pytest.approx(PUBLISHED[name], abs=tolerance)


@pytest.mark.parametrize("kelvin", [1000.0, 2856.0, 6500.0, 20000.0])
def test_black_bodies_obey_wien_and_stefan_and_boltzmann(kelvin: float) -> None:
    nm = np.geomspace(10.0, 3e6, 200_001)
    radiance = planck(nm, kelvin)
    assert nm[np.argmax(radiance)] * 1e-9 * kelvin == pytest.approx(2.897771955e-3, rel=1e-4)
    # Integral of x^3 / (e^x - 1) is pi^4 / 15; the value at 560 nm is 1.
    integral = np.sum(0.5 * (radiance[1:] + radiance[:-1]) * np.diff(nm))
    x = 1.438776877e-2 / (560e-9 * kelvin)
    assert integral == pytest.approx(560 * np.pi**4 / 15 * np.expm1(x) / x**4, rel=1e-5)


def uniform(name: str, film: dict[str, Any] | None = None, **tables: Any) -> np.ndarray:
    made = scene(environment=WHITE | {"illuminant": name}, film=film or {}, **tables)
    return np.asarray(render(made, CAMERA, width=48, height=32, samples=64).rgb.mean(axis=(0, 1)))


@pytest.mark.parametrize("sampling", ["importance", "uniform"])
@pytest.mark.parametrize("name", ["A", "D50", "8000 K"])
def test_a_uniform_environment_has_luminance_1_and_is_white_once_balanced(name: str, sampling: str) -> None:
    film = {"wavelength_sampling": sampling}
    rgb = uniform(name, film)
    assert SRGB.to_xyz[1] @ rgb == pytest.approx(1, abs=5e-3)
    assert chromaticity(SRGB.to_xyz @ rgb) == pytest.approx(PUBLISHED.get(name, (0.2952, 0.3048)), abs=2e-3)
    assert uniform(name, film | {"white_balance": name}) == pytest.approx([1, 1, 1], abs=8e-3)


def test_lamps_and_walls_take_their_light_s_colour() -> None:
    lamp = {"corner_m": [-9, -9, -3], "edge_u_m": [18, 0, 0], "edge_v_m": [0, 18, 0], "emission": [2, 2, 2]}
    ball = {"centre_m": [0, 0, -3], "radius_m": 1, "emission": [2, 2, 2], "illuminant": "A"}
    seen = [
        render(scene(quads=[lamp | {"illuminant": "A"}]), CAMERA, width=48, height=32, samples=64),
        render(scene(spheres=[ball]), CAMERA, width=48, height=32, samples=64),
    ]
    expected = 2 * uniform("A")
    for picture in seen:
        assert picture.rgb.mean(axis=(0, 1)) == pytest.approx(expected, rel=0.02)
    wall = {"point_m": [0, 0, -1], "normal": [0, 0, 1], "material": "m"}
    lit = scene(environment=WHITE | {"illuminant": "A"}, materials={"m": diffuse(0.5, 0.5, 0.5)}, planes=[wall])
    picture = render(lit, CAMERA, width=48, height=32, samples=64, film=FilmSettings(white_balance="A"))
    assert picture.rgb.mean(axis=(0, 1)) == pytest.approx([0.5] * 3, abs=5e-3)


TRIPLE = [[380, 0], [439, 0], [440, 1], [441, 0], [539, 0], [540, 1], [541, 0], [609, 0], [610, 1], [611, 0], [780, 0]]


def test_a_measured_spectrum_of_lines(tmp_path: Path) -> None:
    # Three lines: the colour is the observer's, weighted by nothing else.
    seen = [np.interp((440, 540, 610), table("wavelength_nm"), table(axis)).sum() for axis in "xyz"]
    rows = "nm, power\n# a comment\n" + "\n".join(f"{nm}, {value}" for nm, value in TRIPLE)
    (tmp_path / "lamp.csv").write_text(rows)
    path = tmp_path / "s.toml"
    path.write_text(
        "[camera]\nposition_m = [0, 0, 0]\nlook_at_m = [0, 0, -1]\nfocus_m = 2\nwavelengths_nm = [380, 780]\n"
        '[illuminants.lamp]\nfile = "lamp.csv"\n[environment]\ncolour = [1, 1, 1]\nilluminant = "lamp"\n'
    )
    from_file = render(load_scene(path), CAMERA, width=48, height=32, samples=256).rgb.mean(axis=(0, 1))
    assert chromaticity(SRGB.to_xyz @ from_file) == pytest.approx(chromaticity(np.array(seen)), abs=4e-3)
    inline = uniform("lamp", illuminants={"lamp": {"spectrum": TRIPLE}})
    assert SRGB.to_xyz[1] @ inline == pytest.approx(1, abs=0.02)
    for unit in (1e-300, 1e300):
        scaled = [[nm, unit * value] for nm, value in TRIPLE]
        assert uniform("lamp", illuminants={"lamp": {"spectrum": scaled}}) == pytest.approx(inline, rel=1e-5)


@pytest.mark.parametrize(
    ("rows", "said"),
    [
        ([[400, 1]], r"lamp\.spectrum: got \(1 rows\), expected 2 to 10000"),
        ([[400, 1], [400, 1]], r"spectrum\[1\]: got 400.0.*increase"),
        ([[380, 1], [780, -1]], r"spectrum\[1\]: got -1.0.*0 or more"),
        ([[380, 0], [780, 0]], r"got \(all 0\)"),
        ([[450, 1], [780, 1]], r"illuminants\.lamp: got \(450 to 780 nm\)"),
        ([[300, 1], [350, 0], [780, 0]], "light between 400 and 700 nm"),
        ("nm,value\n400,1\n700,x\n", r"a\.csv: line 3: got '700,x', expected wavelength in nm, value"),
        ("400,1,2\n700,1,2\n", r"a\.csv: line 1"),
        ("", r"a\.csv: row: got \(0 rows\)"),
        ("400,nan\n700,1\n", r"a\.csv: row\[0\]: got nan"),
        ("1,1\n" * 300_000, "at most 1000000 bytes"),
    ],
)
def test_broken_spectra_are_named(rows: Any, said: str, tmp_path: Path) -> None:
    if isinstance(rows, str):
        (tmp_path / "a.csv").write_text(rows)
    given = {"file": str(tmp_path / "a.csv")} if isinstance(rows, str) else {"spectrum": rows}
    with pytest.raises(InputError, match=said):
        scene(illuminants={"lamp": given})


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
