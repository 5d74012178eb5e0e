"""Seidel sums against closed forms of thin lenses (Welford 1986, 12.2), stop shifts, and exact rays."""

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from analysis_lenses import INF, cartesian, library, scene, slower, thin
from path_difference import opd_mm
from shipped import whole

from neurolens.base.errors import InputError
from neurolens.optics.analysis.bundles import bundle, points
from neurolens.optics.analysis.field_curves import colour, curvature, distortion, seidel
from neurolens.optics.analysis.fields import Scene
from neurolens.optics.lens.figures import Figure
from neurolens.optics.lens.glass import index_of
from neurolens.optics.lens.prescription import Lens, Surface
from neurolens.optics.trace.aiming import without_rims
from neurolens.optics.trace.rays import trace

D = 587.5618
ASPHERE = scene(
    [
        Surface(40.0, 6.0, 30, 1.6, 55.0, figure=Figure(conic=-0.7, asphere=((2, 1e-4), (4, 2e-6), (6, 1e-9)))),
        Surface(-90.0, 4.0, 30, 1.7, 30.0),
        Surface(-200.0, 3.0, 30, figure=Figure(conic=2.0)),
        Surface(INF, 5.0, 10, stop=True),
        Surface(-120.0, 3.0, 30, 1.5, 60.0, figure=Figure(asphere=((4, -3e-6),))),
        Surface(-60.0, 50.0, 30),
    ]
)
GENERAL = [library("laikin_double_gauss_50"), library("laikin_double_gauss_50", focus_m=0.8), ASPHERE]


@pytest.mark.parametrize("n", [1.5, 1.8])
@pytest.mark.parametrize("bending", [-2.0, -1.0, 0.0, 0.7, 1.0, 2.5])
def test_thin_lens_in_contact_with_the_stop(bending: float, n: float) -> None:
    y, height, power = 5.0, 10.0, 0.01
    found = seidel(thin(bending, y, n), image_height_mm=height)
    h = found.lagrange_mm
    assert abs(h) == pytest.approx(y * height / 100)
    conjugate = -1.0  # object at infinity
    shape = bending + 2 * (n * n - 1) / (n + 2) * conjugate
    bent = (n / (n - 1)) ** 2 + (n + 2) / (n * (n - 1) ** 2) * shape**2 - n / (n + 2) * conjugate**2
    s1 = y**4 * power**3 / 4 * bent
    s2 = -h * y**2 * power**2 / 2 * ((n + 1) / (n * (n - 1)) * bending + (2 * n + 1) / n * conjugate)
    wanted = [s1, s2, h * h * power, h * h * power / n, 0.0, y * y * power / 60.0, 0.0]
    assert found.total.tolist() == pytest.approx(wanted, rel=1e-9, abs=1e-12)


def test_stop_shift() -> None:
    """S2* = S2 + Q S1 and so on, Q the change of the chief ray's height over the marginal ray's (Welford 8.9)."""
    gap, height, y = 15.0, 10.0, 5.0
    before = seidel(thin(0.4, y), image_height_mm=height)
    # The same marginal ray meets the stop lower down; the chief ray meets the lens higher up.
    after = seidel(thin(0.4, y * (100 - gap) / 100, gap_mm=gap), image_height_mm=height)
    assert after.lagrange_mm == pytest.approx(before.lagrange_mm)
    s1, s2, s3, s4, s5, c1, c2 = before.total
    q = math.copysign(height * gap / (100 - gap) / y, before.lagrange_mm)
    wanted = [
        s1, s2 + q * s1, s3 + 2 * q * s2 + q**2 * s1, s4,
        s5 + q * (3 * s3 + s4) + 3 * q**2 * s2 + q**3 * s1, c1, c2 + q * c1,
    ]  # fmt: skip
    assert after.total.tolist() == pytest.approx(wanted, rel=1e-9, abs=1e-12)


def test_no_spherical_aberration_where_there_is_none() -> None:
    found = seidel(cartesian(), image_height_mm=1.0)
    assert found.total[0] == pytest.approx(0, abs=1e-15) and found.total[1] != 0


@pytest.mark.parametrize("given", [GENERAL[0], *whole(*GENERAL[1:])])
def test_spherical_aberration_of_real_rays(given: Scene) -> None:
    """Transverse aberration S1 / (2 u') and wavefront S1 / 8 at the edge of a small stop."""
    small = slower(given, 0.08)
    total, slope = seidel(small, image_height_mm=1.0).total, _slope(small)
    edge = bundle(small.open, [0.0], [D], points([1 - 1e-9], [0.0]))
    focus = _paraxial_shift(small)
    found = float(edge.at_shift(focus)[0])
    assert found == pytest.approx(-total[0] / (2 * slope), rel=0.02)
    waves = float(opd_mm(bundle(small, [0.0], [D], points([1.0 - 1e-7], [0.0])))) / (D * 1e-6)
    defocus = -focus * slope**2 / 2 / (D * 1e-6)
    assert waves - defocus == pytest.approx(total[0] / 8 / (D * 1e-6), rel=0.02, abs=1e-5)


@pytest.mark.parametrize("given", GENERAL)
def test_coma_of_real_rays(given: Scene) -> None:
    """Tangential coma 3 S2 / (2 u'), sagittal coma a third of it, at a small field and stop."""
    small = slower(given, 0.2)
    field = 1.0
    rays = bundle(small.open, [field], [D], points([-0.5, 0.5, 0, 0], [0, 0, -0.5, 0.5]))
    height, slope = float(rays.chief_height_mm[0]), _slope(small)
    s2 = seidel(small, image_height_mm=height).total[1]
    t = rays.tangential_mm[0, 0]
    tangential, sagittal = float(t[:2].mean()), float(t[2:].mean())
    assert tangential == pytest.approx(3 * sagittal, rel=0.1)
    assert abs(tangential) == pytest.approx(abs(3 * s2 / (2 * slope)) / 4, rel=0.1)


@pytest.mark.parametrize("given", GENERAL)
def test_field_curvature_of_real_rays(given: Scene) -> None:
    """Sagittal focus -(S3 + S4) / (2 u'^2), tangential -(3 S3 + S4) / (2 u'^2): three times as far from Petzval's."""
    small = slower(given, 0.05)
    found = curvature(small, edge_deg=1.0, fields=2)
    slope = _slope(small)
    total = seidel(small, image_height_mm=float(found.height_mm[1])).total
    sagittal, tangential, petzval = (
        float(c[1] - found.sagittal_mm[0]) for c in (found.sagittal_mm, found.tangential_mm, found.petzval_mm)
    )
    assert sagittal == pytest.approx(-(total[2] + total[3]) / (2 * slope**2), rel=5e-3)
    assert tangential == pytest.approx(-(3 * total[2] + total[3]) / (2 * slope**2), rel=5e-3)
    assert petzval == pytest.approx(-total[3] / (2 * slope**2), rel=1e-3)
    assert tangential - petzval == pytest.approx(3 * (sagittal - petzval), rel=2e-2)


@pytest.mark.parametrize("given", [GENERAL[0], ASPHERE])
def test_distortion_of_real_rays(given: Scene) -> None:
    found = distortion(given, edge_deg=2.0, fields=2)
    height = float(found.height_mm[1])
    s5 = seidel(given, image_height_mm=height).total[4]
    wanted = 100 * s5 / (2 * abs(_slope(given)) * height)
    assert found.error_percent["rectilinear, f tan"][1] == pytest.approx(wanted, rel=0.02)


@pytest.mark.parametrize("given", [GENERAL[0], *whole(*GENERAL[1:])])
def test_colour_of_real_rays(given: Scene) -> None:
    """Axial colour -C1 / u'^2 and lateral colour C2 / u', F less C, of glasses that disperse a thousandth as much."""
    rows = tuple(replace(s, V_d=s.V_d and 1000 * s.V_d) for s in given.lens.surfaces)
    given = replace(given, lens=replace(given.lens, surfaces=rows))
    found = colour(given, spectrum_nm=(486.1327, 656.2725), line_nm=(486.1327, 656.2725), fields=41)
    slope = _slope(given)
    axial = found.focus_shift_mm[0, 0] - found.focus_shift_mm[1, 0]
    c1 = seidel(given, image_height_mm=1.0).total[5]
    assert axial == pytest.approx(-c1 / slope**2, rel=5e-3)
    c2 = seidel(given, image_height_mm=float(found.height_mm[1])).total[6]
    assert -found.lateral_um[1, 1] / 1000 == pytest.approx(c2 / slope, rel=5e-3)


def test_an_achromat_has_two_colours_in_one_focus() -> None:
    """Powers in the ratio V1 : -V2, thin, in contact: C1 vanishes and so does the paraxial shift between F and C."""
    v1, v2, n1, n2, power = 64.2, 30.0, 1.5168, 1.7, 0.01
    p1, p2 = power * v1 / (v1 - v2), -power * v2 / (v1 - v2)
    c1 = p1 / (n1 - 1) / 2
    rows = [Surface(1 / c1, 0, 40, n1, v1), Surface(-1 / c1, 0, 40, n2, v2)]
    last = -c1 - p2 / (n2 - 1)
    rows += [Surface(1 / last, 0.0, 40), Surface(INF, 100, 10, stop=True)]
    given = scene(rows, 2.0)
    assert seidel(given, image_height_mm=1.0).total[5] == pytest.approx(0, abs=1e-15)
    found = colour(given, spectrum_nm=(486.1327, D, 656.2725), fields=2)
    assert found.focus_shift_mm[0, 0] == pytest.approx(found.focus_shift_mm[2, 0], abs=2e-4)
    assert abs(found.focus_shift_mm[1, 0]) == pytest.approx(0, abs=0.1)


def test_an_anamorphic_lens_is_refused() -> None:
    with pytest.raises(InputError, match="symmetric"):
        seidel(library("cooke_anamorphic_42"))


def test_odd_powers_are_named() -> None:
    rows = [
        Surface(INF, 0, 10, stop=True),
        Surface(50, 5, 20, 1.5, figure=Figure(asphere=((3, 1e-5),))),
        Surface(-50, 45, 20),
    ]
    assert seidel(scene(rows), image_height_mm=1.0).odd_powers == (1,)


def _slope(given: Scene) -> float:
    """Slope of the paraxial marginal ray at the film, positive."""
    close = bundle(given.open, [0.0], [D], points([1e-3], [0.0]))
    return abs(float(close.slopes[0])) / 1e-3


def _paraxial_shift(given: Scene) -> float:
    close = bundle(given.open, [0.0], [D], points([1e-2], [0.0]))
    return float(-close.tangential_mm / close.slopes[0])


@pytest.mark.parametrize(
    ("name", "oracle"),
    [("laikin_double_gauss_50", "laikin_double_gauss_50_f1.8"), ("ogawa_zoom_70_200", "ogawa_canon_70_200_us5537259")],
)
def test_scale_and_pupil_of_real_rays_are_the_oracle_s(name: str, oracle: str) -> None:
    """The focal length that rays see near the axis, and the entrance pupil at which chief rays aim."""
    path = Path(__file__).parents[4] / "shared" / "data" / "oracle" / f"{oracle}.json"
    if not path.exists():
        pytest.skip("../shared/data/oracle is not here")
    given, wanted = library(name), json.loads(path.read_text())["first_order"]
    assert distortion(given, edge_deg=1.0, fields=2).scale_mm == pytest.approx(wanted["efl"], rel=1e-6)
    chief = given.chief_rays([1e-3]).start
    assert float(chief.z - chief.y / chief.dy * chief.dz) == pytest.approx(wanted["enp_z"], rel=1e-6)


def test_coddington_along_the_chief_ray() -> None:
    """Close-ray foci of the double Gauss against Coddington's equations (Welford 5.6), up to the edge."""
    given = GENERAL[0]
    found = curvature(given, fields=4)
    for field, t, s in zip(found.field_deg[1:], found.tangential_mm[1:], found.sagittal_mm[1:], strict=True):
        assert (t, s) == pytest.approx(_coddington(given, float(field)), abs=2e-5)


def _coddington(given: Scene, field_deg: float) -> tuple[float, float]:
    """Tangential and sagittal focus from the film along the axis, for collimated light and spheres."""
    lens: Lens = given.lens
    start = given.chief_rays([field_deg]).start
    path = trace(without_rims(lens), start, towards="film", path=True).path
    before, n = start, 1.0
    vt = vs = 0.0  # n / distance to the focus, after the last surface
    for surface, z, after in zip(lens.surfaces, lens.vertices_mm, path, strict=False):
        n2 = float(index_of(surface, D))
        c = float(surface.curvature)
        length = math.dist([float(v) for v in before[:3]], [float(v) for v in after[:3]])
        vt, vs = (v / (1 - length * v / n) if v else 0.0 for v in (vt, vs))
        normal = np.array([-c * float(after.x), -c * float(after.y), 1 - c * (float(after.z) - float(z))])
        cos1, cos2 = (abs(float(np.dot(normal, [float(v) for v in r[3:]]))) for r in (before, after))
        power = c * (n2 * cos2 - n * cos1)
        vs = vs + power
        vt = (vt * cos1**2 + power) / cos2**2
        before, n = after, n2
    to_film = float((torch.as_tensor(given.film_z_mm) - before.z) / before.dz)
    return tuple((1 / v - to_film) * float(before.dz) for v in (vt, vs))  # type: ignore[return-value]
