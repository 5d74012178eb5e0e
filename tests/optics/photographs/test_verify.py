"""Lens files held against profiles: profiles made of a lens's own rays agree with it, and changes to it are seen."""

import math
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from shipped import whole

from neurolens.cli import main
from neurolens.optics.analysis.field_curves import illumination
from neurolens.optics.analysis.fields import Scene
from neurolens.optics.lens.prescription import Lens
from neurolens.optics.photographs.profiles import FULL_FRAME_MM, Light, Profile, Radial, profile_named
from neurolens.optics.photographs.rims import open_light
from neurolens.optics.photographs.verify import between, compare, names_of, verify
from neurolens.optics.readers.lensfile import read_lens
from neurolens.optics.setting.states import set_lens

ROOT = Path(__file__).parents[3]
SONNAR = ROOT / "tests" / "data" / "sonnar_55_derived_rims.toml"  # lenses/sony_sonnar_55.toml before its fit


@cache
def lens_of(name: str) -> Lens:
    return read_lens(ROOT / "lenses" / f"{name}.toml")


def own_profile(lens: Lens, focal_mm: float, f_numbers: tuple[float, ...] = ()) -> Profile:
    """A profile that somebody with perfect photographs of this lens would have fitted."""
    scene = Scene(set_lens(lens))
    tangent = np.linspace(0.01, 1.1 * FULL_FRAME_MM / scene.first_order.efl_mm, 60)
    height = scene.chief_rays(np.degrees(np.arctan(tangent))).height_mm.numpy()
    known = np.isfinite(height)
    ideal = tangent[known] * 1.02 * scene.first_order.efl_mm / 12  # in half short sides, to a scale that is not told
    factors = np.polynomial.polynomial.polyfit(ideal, height[known] / 12 / ideal, 8)
    lights = []
    for f_number in f_numbers:
        seen = illumination(Scene(set_lens(lens, f_number=f_number)), fields=13)
        r2 = (seen.height_mm / FULL_FRAME_MM) ** 2
        k = np.linalg.lstsq(np.stack([r2, r2**2, r2**3], 1), seen.relative - 1, rcond=None)[0]
        lights.append(Light(focal_mm, f_number, 1000.0, (float(k[0]), float(k[1]), float(k[2]))))
    distortion = (Radial(focal_mm, tuple(map(float, factors))),)
    return Profile(
        "Some", f"{focal_mm:g}mm f/{lens.f_number:g}", 1.0, 1.5, "rectilinear", distortion, (), (), tuple(lights)
    )


@pytest.mark.parametrize("name", ["laikin_double_gauss_50", "tajima_retrofocus_24"])
def test_a_profile_of_the_lens_itself_agrees(name: str) -> None:
    lens = lens_of(name)
    focal = float(Scene(set_lens(lens)).first_order.efl_mm)
    found = compare(lens, own_profile(lens, focal, (lens.f_number, 8.0)), focal)
    assert found.distortion_percent is not None and found.distortion_percent.rms < 0.005
    assert np.ptp(found.distortion_percent.measured) > 0.1  # there is something to agree with
    for curve in found.light_stops.values():
        assert curve.rms < 0.03  # three terms do not hold the lens's curve better


def test_aspheres_that_are_left_out_are_seen() -> None:
    """The residual is what the change does to the distortion."""
    lens = lens_of("sony_sonnar_55")
    focal = float(Scene(set_lens(lens)).first_order.efl_mm)
    plain = replace(lens, surfaces=tuple(replace(s, figure=replace(s.figure, asphere=())) for s in lens.surfaces))
    found = compare(plain, own_profile(lens, focal), focal).distortion_percent
    both = [Scene(set_lens(x)) for x in (lens, plain)]
    fields = both[0].fields_at(list(np.linspace(6, 20, 8)))
    ratio = np.divide(*(scene.chief_rays(fields).height_mm.numpy() for scene in both))
    assert found is not None and found.rms > 0.1
    assert found.rms == pytest.approx(100 * np.std(ratio), rel=0.35)  # the heights are others


@pytest.mark.parametrize(
    "name", ["horimoto_fisheye_16", "laikin_double_gauss_50", *whole("sony_sonnar_55", "phone_lens_6")]
)
def test_light_of_one_trace_is_that_of_a_trace_for_every_stop(name: str) -> None:
    """Beside `illumination`, which searches the outline of what is lit and integrates over it."""
    lens = lens_of(name)
    rims = np.array(set_lens(lens).semi_diameters_mm)
    for f_number, most in ((lens.f_number, 0.003), (8.0, 0.006)):
        stopped = set_lens(lens, f_number=f_number)
        seen = illumination(Scene(stopped), fields=5)
        opened = open_light(set_lens(lens), seen.height_mm, rims)
        radii = rims.copy()
        radii[lens.stop_index] = stopped.stop_radius_mm
        light = opened.at(radii)
        np.testing.assert_allclose(np.log2(light / light[0]), np.log2(seen.relative), atol=most)


def test_no_light_passes_a_closed_stop_or_a_film_point_beyond_all_rays() -> None:
    lens = set_lens(lens_of("laikin_double_gauss_50"))
    rims = np.array(lens.semi_diameters_mm)
    opened = open_light(lens, np.array([0.0, 500.0]), rims)
    assert opened.at(rims)[1] == 0 < opened.at(rims)[0]
    rims[lens.stop_index] = 0.0
    assert opened.at(rims).max() < 1e-20


def test_the_sonnar_against_photographs() -> None:
    """Distortion and colour agree; the rims that a rule derived let a stop too much light into the corner, those that
    are shipped a third at most, at every aperture."""
    pytest.importorskip("lensfunpy")
    found = verify(read_lens(SONNAR))
    assert found.profile == "Sony FE 55mm f/1.8 ZA" and found.certainty == "certain"
    assert found.distortion_percent < 0.1
    (c,) = found.comparisons
    assert c.blue_um is not None and abs(c.blue_um.measured[-1] - c.blue_um.computed[-1]) < 3
    widest = c.light_stops[1.8]
    assert widest.measured[-1] - widest.computed[-1] == pytest.approx(-0.9, abs=0.15)
    (c,) = verify(lens_of("sony_sonnar_55")).comparisons
    assert len(c.light_stops) > 10
    assert all(abs(curve.measured[-1] - curve.computed[-1]) < 0.15 for curve in c.light_stops.values())
    assert all(curve.rms < 0.2 for curve in c.light_stops.values())


def test_the_verdict_states_the_worst_beside_the_median() -> None:
    """The table of this zoom has 0.41 stops in the corner at 135 mm, and 0.11% RMS of distortion at 104 mm."""
    pytest.importorskip("lensfunpy")
    distortion, light = verify(lens_of("nikon_zoom_70_200")).verdict[:2]
    assert "roughly agree" in distortion and "median RMS 0.052, worst 0.11% of the image height at 104 mm" in distortion
    assert "roughly agree" in light and "median RMS 0.077, worst 0.41 stops at 135 mm" in light
    assert "within" not in distortion + light


@pytest.mark.parametrize(
    ("name", "options", "message"),
    [
        ("petzval_portrait_100", [], "a lens that lensfun measured, or --profile NAME"),
        ("sony_sonnar_55", ["--profile", "Sony 56mm f/1.8"], "one of lensfun's names"),
        ("sony_sonnar_55", ["--profile", "Nikon AF Nikkor 28mm f/1.4D"], "28 mm, of lensfun's"),
        ("cooke_anamorphic_42", [], "symmetric about its axis"),
        ("sony_sonnar_55", ["-o", "picture.gif"], "one of .png, .pdf, .svg"),
    ],
)
def test_what_cannot_be_compared_is_one_line(
    name: str, options: list[str], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("lensfunpy")
    assert main(["verify", str(ROOT / "lenses" / f"{name}.toml"), *options]) == 2
    error = capsys.readouterr().err
    assert message in error and error.count("\n") == 1


def test_light_alone_and_another_film(monkeypatch: pytest.MonkeyPatch) -> None:
    """A profile without distortion says so; one of a larger film is compared within the lens's image circle."""
    lens = replace(lens_of("laikin_double_gauss_50"), believed_to_be="Some 50mm f/1.8")
    whole = own_profile(lens, 50.0, (8.0,))
    from neurolens.optics.photographs import profiles

    monkeypatch.setattr(profiles, "database", lambda: (replace(whole, distortion=()),))
    found = verify(lens)
    assert math.isnan(found.distortion_percent) and "distortion was not measured" in found.verdict
    monkeypatch.setattr(profiles, "database", lambda: (replace(whole, crop=0.5),))
    (c,) = verify(lens).comparisons
    assert (
        c.distortion_percent is not None
        and c.distortion_percent.height_mm.max() <= (lens.image_radius_mm or math.inf) * 1.02
    )
    assert names_of(lens)[0] == "Some 50mm f/1.8"
    assert names_of(replace(lens, name="US 1,234,567 Example 1 (Some 50mm f/1.8)"))[-1] == "Some 50mm f/1.8"


def test_the_profile_of_the_film_that_a_lens_lights_and_one_that_another_contradicts(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A lens whose image circle is not stated is held against the largest film that it lights."""
    lens = replace(lens_of("laikin_double_gauss_50"), believed_to_be="Some 50mm f/1.8", image_radius_mm=None)
    whole, bent = own_profile(lens, 50.0), Radial(50.0, (0.9, 0.0, 0.1))
    three = (replace(whole, crop=0.3), whole, replace(whole, crop=1.5, distortion=(bent,)))
    from neurolens.optics.photographs import profiles

    monkeypatch.setattr(profiles, "database", lambda: three)
    found = verify(lens)
    assert found.crop == 1.0 and found.distortion_percent < 0.01
    assert "two cameras contradict each other" in found.verdict[0]


def test_a_fisheye_whose_profile_does_not_state_its_projection() -> None:
    """Equidistant, which is what photographs of the Canon 15 mm f/2.8 are compared with: a rectilinear picture of 180
    degrees would be infinite."""
    pytest.importorskip("lensfunpy")
    (canon,) = profile_named("Canon EF 15mm f/2.8 Fisheye")
    assert canon.projection == "fisheye"
    (plain,) = profile_named("Canon EF 50mm f/1.4 USM")[:1]
    assert plain.projection == "rectilinear"


def test_heights_that_fall_near_the_edge_end_a_curve() -> None:
    """Chief rays of one colour may turn back before those of another, as in a wide zoom; values end where they do."""
    known = np.array([*np.arange(1.0, 11.0), 9.5])
    found = between(np.array([2.5, 9.8, 10.5]), known, known**2)
    assert found[:2] == pytest.approx([6.25, 96.04]) and math.isnan(found[2])
    assert np.isnan(between(np.ones(3), known[::-1], known)).all()
