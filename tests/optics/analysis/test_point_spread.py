"""Point spread by diffraction: closed forms, sums of waves over exactly traced rays, energy, and rays out of focus."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from analysis_lenses import cartesian, grid, library
from path_difference import diffraction_image
from scipy.special import j1, jv
from test_bundles import PINHOLE, D, moved
from test_converged import hopkins

from neurolens.base.errors import InputError
from neurolens.optics.analysis.bundles import bundle
from neurolens.optics.analysis.diffraction import (
    by_pixel,
    cells_needed,
    cells_of,
    irradiance,
    perfect_peak,
    pupils,
    pupils_at,
    spread,
)
from neurolens.optics.analysis.exit_pupil import ExitPupil, _least, open_shares
from neurolens.optics.analysis.field_curves import illumination
from neurolens.optics.analysis.fields import Scene, on_plane
from neurolens.optics.analysis.psf import psf
from neurolens.optics.analysis.spots import diffraction_mtf, working_f_number
from neurolens.optics.lens.apertures import Aperture
from neurolens.optics.trace.rays import Rays, trace

ONE = np.ones((1, 1))


def pupil_of(scene: Scene, field_deg: float = 0.0) -> ExitPupil:
    [[[found]]] = pupils(scene, [field_deg], [D])
    assert found is not None
    return found


def line_through(pupil: ExitPupil, x_mm: np.ndarray, cells: int = 256) -> np.ndarray:
    """Irradiance along x through the middle, over the peak of the same pupil without aberrations."""
    field = cells_of(pupil, (cells, cells))
    return irradiance(pupil, x_mm, np.zeros(1), field)[0] / perfect_peak(pupil, field)


def test_a_perfect_lens_has_airys_disc() -> None:
    """(2 J1(v) / v)^2 with v = pi r / (lambda N), to the fourth dark ring."""
    given = cartesian(stop_mm=2.0)
    n = working_f_number(given, D)
    x = np.linspace(-4, 4, 161) * D * 1e-6 * n
    v = np.where(x == 0, 1.0, math.pi * x / (D * 1e-6 * n))
    wanted = np.where(x == 0, 1.0, (2 * j1(v) / v) ** 2)
    assert line_through(pupil_of(given), x) == pytest.approx(wanted, abs=5e-4)
    # Cells may be few in focus, for edges are found within them.
    pupil = pupil_of(given)
    for cells in (24, 64):
        area = 4 * pupil.half.prod() * open_shares([pupil], (cells, cells))[0].mean()
        assert area == pytest.approx(math.pi / (2 * n) ** 2, rel=1e-4)


def lommel(u: float, v: np.ndarray) -> np.ndarray:
    """Irradiance of a defocused circle over the peak in focus (Born and Wolf, 8.8.1): (2/u)^2 (U1^2 + U2^2), and the
    V functions outside the shadow, |u| < |v|."""
    found = []
    for one in np.abs(v):
        s = np.arange(60)
        if one < u:
            first, second = (((-1.0) ** s * (one / u) ** (n + 2 * s) * jv(n + 2 * s, one)).sum() for n in (0, 1))
            turn = (u + one * one / u) / 2
            found.append(
                (2 / u) ** 2 * (1 + first**2 + second**2 - 2 * first * math.cos(turn) - 2 * second * math.sin(turn))
            )
        else:
            both = (((-1.0) ** s * (u / one) ** (n + 2 * s) * jv(n + 2 * s, one)).sum() for n in (1, 2))
            found.append((2 / u) ** 2 * sum(value**2 for value in both))
    return np.array(found)


@pytest.mark.parametrize("waves", [1.0, 4.5])
def test_a_defocused_circle_is_lommels(waves: float) -> None:
    """u = 2 pi / lambda shift / (2 N)^2: at whole waves of defocus the middle is dark."""
    given = cartesian(stop_mm=1.0)
    n = working_f_number(given, D)
    pupil = pupil_of(moved(given, waves * 8 * D * 1e-6 * n * n))
    u = 4 * math.pi * waves
    v = np.linspace(0.2, 1.6 * u + 3, 60)
    assert line_through(pupil, v / math.pi * D * 1e-6 * n) == pytest.approx(lommel(u, v), abs=2e-3)
    assert lommel(u, np.array([1e-9]))[0] == pytest.approx((math.sin(u / 4) / (u / 4)) ** 2, abs=1e-12)


@pytest.mark.parametrize("waves", [0.0, 0.5])
def test_the_image_has_the_mtf_of_closed_forms(waves: float) -> None:
    given = cartesian(stop_mm=2.0)
    n = working_f_number(given, D)
    cut_off = 1e6 / (D * n)
    pupil = pupil_of(moved(given, waves * 8 * D * 1e-6 * n * n))
    x = np.linspace(-16e-6, 16e-6, 201) * D * n
    image = irradiance(pupil, x, x, cells_of(pupil, (192, 192)))
    f = np.array([0.1, 0.25, 0.5, 0.7]) * cut_off
    contrast = np.abs(np.exp(2j * np.pi * f[:, None] * x) @ image.sum(0)) / image.sum()
    assert contrast == pytest.approx(hopkins(f, waves, cut_off), abs=0.025)  # 2% of the light falls beside the window
    if waves == 0:
        assert hopkins(f, 0.0, cut_off) == pytest.approx(diffraction_mtf(f, D, n), abs=1e-4)


@pytest.mark.parametrize(
    ("f_number", "field", "focus_m"), [(5.6, 0.0, math.inf), (4.0, 14.0, math.inf), (8.0, 20.0, 1.5)]
)
def test_the_image_is_the_sum_of_waves_over_exact_rays(f_number: float, field: float, focus_m: float) -> None:
    """Strehl ratio and every pixel, against 30,000 traced rays with their optical paths; rims cut the last two."""
    given = library("laikin_double_gauss_50", f_number=f_number, focus_m=focus_m)
    found = psf(given, [field], [D])
    rays = bundle(given, [field], [D], grid(200))
    t, s = (
        float((rays.weight * v.nan_to_num()).sum() / rays.weight.sum()) for v in (rays.tangential_mm, rays.sagittal_mm)
    )
    pupil = pupil_of(given, field)
    half, points = found.half_width_um[0] / 1000, found.diffraction.shape[1]
    direct = diffraction_image(rays, (t, s), half, points)
    # The windows have their middles at two centroids, whose difference is below a twentieth of a pixel.
    assert found.diffraction[0] == pytest.approx(direct, abs=0.02 * direct.max())
    assert found.strehl[0] == pytest.approx(direct.max(), abs=5e-3)
    assert pupil.blur_mm < half


def test_aspheres_that_turn_rays_far_aside_beyond_their_rims_do_not_touch_the_wavefront() -> None:
    """On the axis the Strehl ratio is an integral over a fan of rays: W is that of -x over the sine of their slope."""
    given = library("fujifilm_fujinon_xf_16mm_f1_4_r_wr", focus_mode="best")
    height = torch.linspace(0.0, given.lens.surfaces[0].semi_diameter_mm, 4001, dtype=torch.float64)
    zero = torch.zeros_like(height)
    out = trace(given.lens, Rays(height, zero, zero - 50, zero, zero, zero + 1), D, towards="film", transmittance=True)
    met, lit = on_plane(out.rays, float(given.lens.film_z_mm or 0)), int((out.status == 0).sum())
    assert out.transmittance is not None and bool((out.status[:lit] == 0).all())
    x, sine, h, power = (c[1:lit].numpy() for c in (met.x, met.dx, height, out.transmittance))
    path = -np.concatenate([[0.0], np.cumsum((x[1:] + x[:-1]) / 2 * np.diff(sine))])
    field = np.sqrt(power * h * np.abs(np.gradient(sine) * sine) * np.gradient(h))  # of light per area of cosines
    strehl = np.abs((field * np.exp(2j * np.pi * path / (D * 1e-6))).sum() / field.sum()) ** 2
    assert line_through(pupil_of(given), np.linspace(-1e-3, 1e-3, 5)).max() == pytest.approx(strehl, abs=2e-3)
    assert strehl > 0.09


@pytest.mark.parametrize("lost", [0.0, 1e-9])
def test_fits_of_too_few_rays_are_the_smallest(lost: float) -> None:
    """Where rays do not tell the terms of a fit apart, exactly or nearly, the fit holds at the rays and stays small."""
    rng = np.random.default_rng(3)
    a = rng.normal(size=(200, 60))
    a[:, 59] = a[:, :59].mean(1) + lost * rng.normal(size=200)
    wanted = rng.normal(size=60)
    found = _least(a)(a @ wanted)
    assert np.abs(a @ (found - wanted)).max() < 1e-8
    assert np.abs(found).max() < 1.5 * np.abs(wanted).max()


def test_all_light_is_in_the_image() -> None:
    given = library("laikin_double_gauss_50", f_number=4.0)
    [[pupil]] = pupils_at(given, np.array([[12.0, 8.0]]), [D])
    [small, large] = (spread([pupil], ONE, 0.004, side) for side in (31, 121))
    assert small.inside[0] < large.inside[0] < 1
    assert large.inside[0] == pytest.approx(1, abs=3e-3)
    # A window wider than waves can be summed for has the same image in its middle: rays do not take over in focus.
    whole = spread([pupil], ONE, 0.004, 401)
    assert not whole.by_rays and whole.inside[0] == pytest.approx(1, abs=3e-3)
    assert whole.light[0, 140:-140, 140:-140] == pytest.approx(large.light[0], abs=0.01 * large.light.max())
    # Pixels tile: four small ones hold what a large one holds.
    x, near = np.arange(-6, 7)[None] * 0.004, np.arange(-13, 13)[None] * 0.002 + 0.001
    field = cells_of(pupil, (256, 256))[None]
    [fine] = by_pixel([pupil], near, near, 0.002, field)
    tiles = fine.reshape(13, 2, 13, 2).sum((1, 3))
    assert tiles == pytest.approx(by_pixel([pupil], x, x, 0.004, field)[0], rel=1e-2, abs=1e-4 * tiles.max())


def test_an_image_turns_with_its_place() -> None:
    given = library("laikin_double_gauss_50", f_number=4.0)
    right, down, left = (
        spread(p, ONE, 0.003, 33).light[0] for p in pupils_at(given, np.array([[15.0, 0], [0, 15.0], [-15, 0]]), [D])
    )
    assert left == pytest.approx(right[:, ::-1], abs=1e-4 * right.max())
    assert down == pytest.approx(right.T, abs=1e-4 * right.max())
    assert right == pytest.approx(right[::-1], abs=1e-4 * right.max())
    assert np.abs(right - right.T).max() > 0.05 * right.max()


def test_blades_stay_where_they_are_all_over_the_film() -> None:
    given = library("laikin_double_gauss_50", f_number=8.0)
    given = Scene(replace(given.lens, aperture=Aperture(blades=4)))
    for found in pupils_at(given, np.array([[9.0, 9.0], [0.0, 0.0]]), [D]):
        share = open_shares([found[0]], (64, 64))[0][0]  # a square on its corner
        assert share.mean() == pytest.approx(0.5 / 1.08**2, rel=0.03)
        assert share[2, 2] == share[-3, 2] == 0 and share[32, 32] == 1


def test_relative_illumination_is_that_of_the_analysis() -> None:
    """Which traces from the film: the rays of one object point come from other film points, hence f/4."""
    given = library("laikin_double_gauss_50", f_number=4.0)
    light = illumination(given, fields=4)
    places = np.stack([0 * light.height_mm, light.height_mm], 1)
    seen = np.array([spread(p, ONE, 0.01, 3).pupil[0] for p in pupils_at(given, places, [given.lens.reference_nm])])
    assert seen / seen[0] == pytest.approx(light.relative, rel=3e-3)
    assert seen[-1] < 0.9 * seen[0]


def test_rays_take_over_far_out_of_focus() -> None:
    """Where both are known, few pixels differ: the fewer, the larger pixels are against the fringes."""
    lens = library("laikin_double_gauss_50", f_number=2.8, focus_m=1.0).lens
    [[near], [far]] = (pupils_at(Scene(lens, d), np.array([[6.0, 4.0]]), [D])[0] for d in (1.02, 1.2))
    off = [spread([near], ONE, pixel, side) for pixel, side in ((0.003, 55), (0.01, 19), (0.03, 9))]
    assert [found.by_rays for found in off] == [False] * 3
    assert off[2].differs < 0.5 * off[1].differs < 0.5 * off[0].differs < 0.05
    found = spread([far], ONE, 0.01, 35)
    assert found.by_rays and math.isnan(found.differs)
    assert found.inside[0] == pytest.approx(1, abs=1e-6)
    fine = spread([far], ONE, 0.01 / 3, 105).light[0].reshape(35, 3, 35, 3).sum((1, 3))
    assert np.abs(fine - found.light[0]).sum() / 2 < 0.02


def test_twice_as_many_cells_give_the_same_image() -> None:
    given = library("nikon_zoom_14_24", f_number=4.0)
    [[pupil]] = pupils_at(given, np.array([[14.0, 8.0]]), [D])
    x = np.linspace(-0.03, 0.03, 61)
    images = [irradiance(pupil, x, x, cells_of(pupil, tuple(k * n for n in cells_needed(pupil, 0.03)))) for k in (1, 2)]
    assert images[0] == pytest.approx(images[1], abs=3e-3 * images[1].max())


@pytest.mark.parametrize(("wide", "share"), [(1e-9, 0.0), (1e9, 1.0)])
def test_a_pupil_whose_rims_cut_no_cell_is_closed_or_the_whole_box(wide: float, share: float) -> None:
    """Its image has no light then, or all that the box lets through."""
    pupil = pupil_of(library("laikin_double_gauss_50", f_number=4.0))
    pupil = replace(pupil, limits_mm=tuple(wide for _ in pupil.limits_mm))
    assert np.all(open_shares([pupil], (64, 64))[0] == share)
    found = spread([pupil], ONE, 0.003, 33)
    assert float(found.inside[0]) <= share and bool(found.pupil[0]) is bool(share)


def test_a_lens_without_symmetry_or_power_is_refused_and_a_dark_place_is_dark() -> None:
    given = library("laikin_double_gauss_50")
    [[dark]] = pupils_at(given, np.array([[300.0, 0.0]]), [D])
    assert dark is None
    found = spread([dark], ONE, 0.003, 5)
    assert not found.light.any() and found.pupil[0] == 0 and math.isnan(found.differs)
    with pytest.raises(InputError, match="a lens with power"):
        pupils_at(PINHOLE, np.zeros((1, 2)), [D])


# Optiland 0.6.3: HuygensPSF(optic, field, 0.546074, num_rays=160, image_size=80, pixel_pitch=0.00025), the surfaces of
# a lens file, with constant indices, without rims and with `float_by_stop_size`. Lens, f-number, film z and radius of
# the stop in mm; by field in degrees the peak, and the full widths at its half along the meridian and across it in um.
OPTILAND = [
    ("cooke_triplet_50", 8.0, 60.3096, 2.378874, {0.0: (0.9604, 4.451, 4.451), 12.203: (0.2434, 4.575, 15.133)}),
    ("brendel_tessar_100", 11.0, 119.3218, 3.720297, {0.0: (0.9853, 6.114, 6.114), 6.17: (0.8527, 6.135, 6.517)}),
    ("laikin_double_gauss_50", 5.6, 91.5979, 3.075592, {0.0: (0.9792, 3.108, 3.108), 8.715: (0.5200, 2.955, 4.731)}),
]


@pytest.mark.parametrize(("name", "f_number", "film_z_mm", "stop_mm", "fields"), OPTILAND)
def test_optiland_sums_huygens_wavelets_to_the_same_images(
    name: str, f_number: float, film_z_mm: float, stop_mm: float, fields: dict[float, tuple[float, ...]]
) -> None:
    """Its peaks are 0.5 to 3.2% lower, and its widths differ by 2.2% at most; most are 1% narrower.

    On the axis of the Tessar a perfect pupil of f/11 has the width 1.029 lambda N = 6.181 um, ours 6.182, Optiland's
    6.114; and the Strehl ratio of Optiland's own wavefront (`OPD`) is 0.994, ours 0.996.
    """
    lens = library(name, f_number=f_number).lens
    assert lens.stop_radius_mm == pytest.approx(stop_mm, rel=1e-5)
    given, line = Scene(replace(lens, film_z_mm=film_z_mm), rims=False), (np.arange(161) - 80) * 0.25e-3
    for [[pupil]], wanted in zip(pupils(given, [*fields], [546.074]), fields.values(), strict=True):
        assert pupil is not None
        field = cells_of(pupil, (256, 256))
        image = irradiance(pupil, line, line, field) / perfect_peak(pupil, field)
        row, column = np.unravel_index(image.argmax(), image.shape)
        widths = [0.25 * _full_width(image[:, column]), 0.25 * _full_width(image[row])]
        assert [image.max(), *widths] == pytest.approx(wanted, rel=0.035)


# Optiland 0.6.3, without its grid: |mean of exp(2 pi i W) over the pupil|^2 by 15 rings of its `OPD` on the
# axis, in focus, stopped down and out of focus. Lens, f-number, film z in mm, Strehl ratio.
@pytest.mark.parametrize(
    ("name", "f_number", "film_z_mm", "strehl"),
    [
        ("angenieux_double_gauss_100", 5.6, 182.5839, 0.91066),
        ("canon_gauss_35", 8.0, 47.9526, 0.94432),
        ("cooke_triplet_50", 11.0, 60.2270, 0.84035),
    ],
)
def test_strehl_ratios_are_those_of_optilands_wavefronts(
    name: str, f_number: float, film_z_mm: float, strehl: float
) -> None:
    lens = replace(library(name, f_number=f_number).lens, film_z_mm=film_z_mm)
    [[[pupil]]] = pupils(Scene(lens, rims=False), [0.0], [546.074])
    assert pupil is not None
    field, line = cells_of(pupil, (128, 128)), np.linspace(-1e-3, 1e-3, 3)
    assert irradiance(pupil, line, line, field)[1, 1] / perfect_peak(pupil, field) == pytest.approx(strehl, abs=1e-3)


def _full_width(values: np.ndarray) -> float:
    """Width in samples of the peak at half its height, between which values are linear."""
    half, middle = values.max() / 2, int(values.argmax())
    ends = []
    for side in (values[middle:], values[middle::-1]):
        k = int((side < half).argmax())
        ends.append(k - (half - side[k]) / (side[k - 1] - side[k]))
    return float(sum(ends))
