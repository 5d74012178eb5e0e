"""Rims from photographs: those of a lens with known rims are found again, and nothing cuts the beam of the axis."""

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from shipped import whole

from neurolens.base.errors import InputError
from neurolens.cli import main
from neurolens.optics.analysis.fields import Scene
from neurolens.optics.lens.paraxial import first_order
from neurolens.optics.lens.prescription import Lens
from neurolens.optics.photographs.profiles import FULL_FRAME_MM, Light, Profile
from neurolens.optics.photographs.rims import (
    FittedRims,
    Ring,
    fit_rims,
    open_light,
    with_fitted_rims,
    with_rims,
    with_ring,
)
from neurolens.optics.readers.lensfile import read_lens
from neurolens.optics.setting.rims import check_states
from neurolens.optics.setting.states import set_lens

ROOT = Path(__file__).parents[3]
SONNAR = ROOT / "tests" / "data" / "sonnar_55_derived_rims.toml"  # lenses/sony_sonnar_55.toml before its fit
F_NUMBERS = (1.8, 2.8, 4.0, 8.0)


@cache
def gauss() -> Lens:
    lens = read_lens(ROOT / "lenses" / "laikin_double_gauss_50.toml")
    return replace(lens, image_radius_mm=FULL_FRAME_MM)


def light_of(lens: Lens, height_mm: np.ndarray, f_number: float) -> np.ndarray:
    """The light over that of the axis."""
    placed = set_lens(lens)
    rims = np.array(placed.semi_diameters_mm)
    opened = open_light(placed, np.concatenate([[0.0], height_mm]), rims)
    rims[lens.stop_index] = set_lens(lens, f_number=f_number).stop_radius_mm
    light = opened.at(rims)
    return np.asarray(light[1:] / light[0])


def photographs_of(lens: Lens) -> Profile:
    """The light of a lens, fitted by the three terms that profiles have."""
    share = np.linspace(0.05, 1, 20)
    lights = []
    for f_number in F_NUMBERS:
        terms = np.stack([share**2, share**4, share**6], 1)
        k = np.linalg.lstsq(terms, light_of(lens, share * FULL_FRAME_MM, f_number) - 1, rcond=None)[0]
        lights.append(Light(50.0, f_number, 1000.0, (float(k[0]), float(k[1]), float(k[2]))))
    return Profile("Some", "50mm f/1.8", 1.0, 1.5, "rectilinear", (), (), (), tuple(lights))


def scaled(lens: Lens, front: float, rear: float) -> Lens:
    factor = np.where(np.arange(len(lens.surfaces)) < lens.stop_index, front, rear)
    factor[lens.stop_index] = 1.0
    return with_rims(lens, factor * np.array(lens.semi_diameters_mm))


def axis_light(lens: Lens) -> float:
    placed = set_lens(lens)
    rims = np.array(placed.semi_diameters_mm)
    return float(open_light(placed, np.zeros(1), rims).at(rims)[0])


@pytest.mark.parametrize(("front", "rear"), [(1.05, 0.95), *whole((0.95, 1.0), (1.0, 0.9))])
def test_rims_of_the_lens_that_was_photographed_are_found_again(front: float, rear: float) -> None:
    found = fit_rims(gauss(), photographs_of(scaled(gauss(), front, rear)))
    assert max(found.after_stops.values()) < max(0.05, max(found.before_stops.values()) / 5)
    assert axis_light(with_fitted_rims(gauss(), found)) == pytest.approx(axis_light(gauss()), rel=0.01)


def test_an_aperture_that_was_left_out_agrees_too() -> None:
    found = fit_rims(gauss(), photographs_of(scaled(gauss(), 0.95, 0.9)), unused=(2.8,))
    assert found.unused == (2.8,) and found.after_stops[2.8] < 0.1 < found.before_stops[2.8]


def test_a_ring_of_the_mount_is_found() -> None:
    """A ring in front cuts all fields as no scaled rim does."""
    ring = Ring(0, 0.4 * float(gauss().vertices_mm[-2]), 22.0)
    found = fit_rims(gauss(), photographs_of(with_ring(gauss(), ring)))
    assert [r.before for r in found.rings] == [0]
    assert np.mean(list(found.after_stops.values())) < np.mean(list(found.before_stops.values())) / 4


def test_light_that_no_rim_can_explain_does_not_cut_the_axis() -> None:
    profile = photographs_of(gauss())
    dark = tuple(row._replace(k=(-0.9, 0.0, 0.0)) for row in profile.light)
    found = fit_rims(gauss(), replace(profile, light=dark))
    assert axis_light(with_fitted_rims(gauss(), found)) == pytest.approx(axis_light(gauss()), rel=0.02)
    assert found.after_stops[8.0] > 0.3  # and this is said


def test_rims_that_would_collide_are_trimmed() -> None:
    """Elements that all but touch: rims that are found too wide for them make no file that is refused."""
    lens = gauss()
    rows = [replace(s, diameter_mm=0.9 * s.diameter_mm) for s in lens.surfaces]
    rows[1] = replace(rows[1], thickness_mm=0.02)
    close = replace(lens, surfaces=tuple(rows))
    wide = np.array([1.4 * s.semi_diameter_mm for s in rows])
    found = FittedRims(1.4, 1.4, (), wide, {8.0: 0.0}, {8.0: 0.0}, ())
    with pytest.raises(InputError, match="overlap"):
        check_states(with_rims(close, wide))
    check_states(with_fitted_rims(close, found))


@pytest.mark.parametrize(
    ("name", "ring"),
    [
        ("laikin_double_gauss_50", Ring(0, 12.0, 30.0)),
        ("sony_sonnar_55", Ring(14, 5.0, 30.0)),
        ("nikon_zoom_70_200", Ring(0, 30.0, 60.0)),
    ],
)
def test_a_wide_ring_changes_no_ray(name: str, ring: Ring, tmp_path: Path) -> None:
    lens = read_lens(ROOT / "lenses" / f"{name}.toml")
    ringed = with_ring(lens, ring)
    for zoom in [None, *(c.name for c in lens.configurations[-1:])]:
        one, other = (set_lens(x, zoom=zoom) for x in (lens, ringed))
        assert first_order(one).efl_mm == pytest.approx(first_order(other).efl_mm, rel=1e-12)
        fields = [1.0, 5.0]
        heights = [Scene(x).chief_rays(fields).height_mm.numpy() for x in (one, other)]
        np.testing.assert_allclose(*heights, rtol=1e-9)


def test_the_sonnar_goes_from_a_stop_in_the_corner_to_a_third(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("lensfunpy")
    written = tmp_path / "sonnar.toml"
    assert main(["rims", str(SONNAR), "-o", str(written)]) == 0
    assert "ring" in capsys.readouterr().out
    lens = read_lens(written)
    assert lens.rims == "photographs"
    from neurolens.optics.photographs.verify import verify

    (c,) = verify(lens).comparisons
    for curve in c.light_stops.values():
        assert abs(curve.measured[-1] - curve.computed[-1]) < 0.15
        assert curve.rms < 0.2


@pytest.mark.parametrize(
    ("options", "message"),
    [(["--profile", "Sigma 8mm f/3.5 EX DG circular fisheye"], "8 mm, of lensfun's"), (["-o", "lens.zmx"], ".toml")],
)
def test_what_cannot_be_fitted_is_one_line(
    options: list[str], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("lensfunpy")
    assert main(["rims", str(SONNAR), *options]) == 2
    error = capsys.readouterr().err
    assert message in error and error.count("\n") == 1
