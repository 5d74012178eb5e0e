"""Zemax files in the details of their definition: closed forms, what sizes the stop, states, and refusals by line."""

import math
import re
import warnings
from pathlib import Path
from typing import Any

import pytest
from lens_formats import swapped as swapped_in
from shipped import singlet_mm

from neurolens.base.errors import InputError, NeurolensWarning
from neurolens.optics.lens import glass as catalogue
from neurolens.optics.lens.figures import Ideal
from neurolens.optics.lens.paraxial import first_order
from neurolens.optics.lens.prescription import Lens
from neurolens.optics.readers.source import ReadOptions
from neurolens.optics.readers.zemax import read_zmx

HEAD = """\
VERS 140730 73 26155
MODE SEQ
NAME Singlet for a test
NOTE 0 made up
NOTE 4
UNIT MM X W X CM MR CPMM
ENPD 10
ENVD 2.0E+1 1 0
GCAT SCHOTT
FTYP 0 0 3 1 0 0 0
XFLN 0 0 3 9
YFLN 0 2.5 4 9
VDXN 0 0 0
WAVM 1 5.875618E-1 1
PWAV 1
SURF 0
  TYPE STANDARD
  CURV 0.0 0 0 0 0 ""
  DISZ INFINITY
  DIAM 0 0 0 0 1 ""
"""
BODY = """\
SURF 1
  STOP
  TYPE STANDARD
  CURV 2.0E-2 0 0 0 0 ""
  COAT AR
  HIDE 0 0 0 0 0 0 0 0 0 0
  SLAB 4
  DISZ 5.0
  GLAS N-BK7 0 0 1.5 4.0E+1 0 0 0 0 0 0
  DIAM 8 1 0 0 1 ""
SURF 2
  TYPE STANDARD
  CURV -2.0E-2 0 0 0 0 ""
  DISZ 45.0
  DIAM 9 1 0 0 1 ""
"""
TAIL = """\
SURF 3
  TYPE STANDARD
  CURV 0.0 0 0 0 0 ""
  DISZ 0
  DIAM 2.5 0 0 0 1 ""
BLNK a merit function
EFFL 0 1 0 0 0 0 0
TOL TOFF   0   0              0              0   0 0 0
MNUM 1 1
MOFF   0   1 "" 0 0 0 1 1 0 0.0 ""
"""


def swapped(old: str, new: str, text: str = HEAD + BODY + TAIL) -> str:
    return swapped_in(old, new, text)


def read(text: str, tmp_path: Path, options: ReadOptions | None = None, encoding: str = "utf-8") -> Lens:
    path = tmp_path / "lens.zmx"
    path.write_text(text, encoding=encoding)
    return read_zmx(path, options)


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16", "utf-16-le", "latin-1"])
def test_singlet_by_the_lensmakers_formula(encoding: str, tmp_path: Path) -> None:
    text = swapped("Singlet", "Einzellinse \u00d8 20")
    lens = read(text, tmp_path, encoding=encoding)
    efl_mm, back_mm = singlet_mm(catalogue.find("N-BK7").n_d)
    data = first_order(lens)
    assert data.efl_mm == pytest.approx(efl_mm, rel=1e-12)
    assert data.back_focus_mm == pytest.approx(back_mm, rel=1e-12)
    assert (lens.name, lens.notes) == ("Einzellinse \u00d8 20 for a test", "made up")
    assert lens.surfaces[0].glass == "N-BK7"
    # The third field point, not the unused fourth, by the tangents of its angles in two planes.
    tangent = math.hypot(math.tan(math.radians(3)), math.tan(math.radians(4)))
    assert lens.half_field_deg == pytest.approx(math.degrees(math.atan(tangent)), rel=1e-12)
    assert lens.rims == "source"
    # The pupil of the file rules over the diameter that it prints for the stop, which is the first surface.
    assert lens.surfaces[0].diameter_mm == pytest.approx(10)
    assert lens.f_number == pytest.approx(efl_mm / 10)


def test_the_corner_of_a_wide_field_by_its_tangents(tmp_path: Path) -> None:
    """A field of 40 degrees in both planes is the corner of a square: arctan(sqrt(2) tan 40) from the axis."""
    wide = swapped("XFLN 0 0 3 9\nYFLN 0 2.5 4 9", "XFLN 0 0 40 9\nYFLN 0 2.5 -40 9")
    assert read(wide, tmp_path).half_field_deg == pytest.approx(49.88, abs=0.005)
    fisheye = swapped("YFLN 0 2.5 4 9", "YFLN 0 2.5 110 9", swapped("XFLN 0 0 3 9", "XFLN 0 0 0 9"))
    assert read(fisheye, tmp_path).half_field_deg == 110


@pytest.mark.parametrize(
    ("name", "n_d", "V_d"), [("517642", 1.517, 64.2), ("BK7_SCHOTT", 1.5168, 64.17), ("S-BSL7_OHARA", 1.51633, 64.14)]
)
def test_codes_of_glasses_and_makers_behind_names(name: str, n_d: float, V_d: float, tmp_path: Path) -> None:
    front = read(swapped("GLAS N-BK7 0", f"GLAS {name} 0"), tmp_path).surfaces[0]
    assert (front.n_d, front.V_d) == (pytest.approx(n_d, abs=1e-5), pytest.approx(V_d, abs=0.01))


def test_an_ellipsis_ends_no_line(tmp_path: Path) -> None:
    """Windows' Latin-1 has it where Unicode has a control that ends lines."""
    path = tmp_path / "lens.zmx"
    path.write_bytes(swapped("made up", "more\x85 SURF 9", HEAD + BODY + TAIL).encode("latin-1"))
    assert read_zmx(path).surfaces == read(HEAD + BODY + TAIL, tmp_path).surfaces


def test_a_glass_of_no_catalogue_is_taken_by_the_figures_beside_it(tmp_path: Path) -> None:
    """But not by 1.5 and 40, which the program writes where it has none."""
    named = "GLAS N-BK7 0 0 1.5 4.0E+1"
    with pytest.warns(
        NeurolensWarning, match="line 29, GLAS: glass XY-9 is not in the catalogue.*n_d 1.62 and V_d 36.4"
    ):
        front = read(swapped(named, "GLAS XY-9 0 0 1.62 36.4"), tmp_path).surfaces[0]
    assert (front.n_d, front.V_d, front.glass, front.material) == (1.62, 36.4, None, "XY-9")
    with pytest.raises(InputError, match="line 29, GLAS"):
        read(swapped(named, "GLAS XY-9 0 0 1.5 4.0E+1"), tmp_path)


@pytest.mark.parametrize(
    ("aperture", "diameter_mm"), [("ENPD 4", 4.0), ("FNUM 5 0", None), ("FLOA", 16.0), ("FNUM 5 1", None)]
)
def test_what_sizes_the_stop(aperture: str, diameter_mm: float | None, tmp_path: Path) -> None:
    lens = read(swapped("ENPD 10", aperture), tmp_path)
    data = first_order(lens)
    expected = data.efl_mm / 5 if diameter_mm is None else diameter_mm
    assert lens.surfaces[0].diameter_mm == pytest.approx(expected)
    assert lens.f_number == pytest.approx(data.f_number)


def test_units_scale_every_length(tmp_path: Path) -> None:
    mm = read(HEAD + BODY + TAIL, tmp_path)
    inches = read(swapped("UNIT MM", "UNIT IN"), tmp_path)
    assert inches == mm.scaled(25.4)
    with pytest.raises(InputError, match="--units"):
        read(HEAD + BODY + TAIL, tmp_path, ReadOptions(units="cm"))
    assert read(swapped("UNIT MM X W X CM MR CPMM\n", ""), tmp_path, ReadOptions(units="in")) == inches


def test_a_film_in_the_hole_of_a_pinhole_is_refused(tmp_path: Path) -> None:
    hole = HEAD + 'SURF 1\n  STOP\n  CURV 0\n  DISZ 20\n  DIAM 0.1 1 0 0 1 ""\n' + TAIL.replace("SURF 3", "SURF 2")
    assert first_order(read(hole, tmp_path)).efl_mm == 20
    with pytest.raises(InputError, match=r"film: got \(in the hole of a pinhole\)"):
        read(hole.replace("DISZ 20", "DISZ 0"), tmp_path)


def test_an_image_under_water_is_no_file_cut_off(tmp_path: Path) -> None:
    """Programs repeat the medium of the image behind it."""
    glass = "GLAS ___BLANK 1 0 1.333 55.8"
    wet = swapped("DISZ 45.0", f"DISZ 45.0\n  {glass}")
    assert read(swapped("DISZ 0\n", f"DISZ 0\n  {glass}\n", wet), tmp_path) == read(wet, tmp_path)
    with pytest.raises(InputError, match="is the file cut off"):
        read(swapped("DISZ 0\n", "DISZ 0\n  GLAS N-BK7\n", wet), tmp_path)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("  COAT AR\n", "  COAT AR\n", "coatings that are named but not given"),
        ("2.0E+1 1 0", "3.0E+1 1 0", "not at 3.0E\\+1"),
        ("VDXN 0 0 0", "VDXN 0 0.1 0", "vignetting factors"),
        ('  DIAM 9 1 0 0 1 ""\n', '  DIAM 9 1 0 0 1 ""\n  SQAP 4 5\n', "SQAP"),
        ("SURF 3\n  TYPE STANDARD\n  CURV 0.0", "SURF 3\n  TYPE STANDARD\n  CURV 0.01", "image surface is curved"),
        ("SURF 3\n  TYPE STANDARD", "SURF 3\n  TYPE EVENASPH\n  PARM 2 1E-5", "image surface is curved"),
        ("DISZ 45.0", "DISZ 45.0\n  GLAS VACUUM", r"line \d+, GLAS: VACUUM is taken as air"),
    ],
)
def test_what_is_left_out_is_told(old: str, new: str, message: str, tmp_path: Path) -> None:
    with pytest.warns(NeurolensWarning, match=message):
        read(swapped(old, new), tmp_path)


@pytest.mark.parametrize(
    ("block", "shape"),
    [
        ("TYPE EVENASPH\n  CURV 0.02\n  CONI -1\n  PARM 1 1E-4\n  PARM 2 2E-6", (50, -1, {2: 1e-4, 4: 2e-6}, None)),
        ("TYPE ODDASPHE\n  CURV 0.02\n  PARM 1 0\n  PARM 3 1E-5\n  PARM 8 1E-12", (50, 0, {3: 1e-5, 8: 1e-12}, None)),
        ("TYPE TOROIDAL\n  CURV 0.02\n  PARM 1 0\n  XDAT 1 0 0 0 1\n  XDAT 2 100 0 0 1", (50, 0, {}, "y")),
        ("TYPE TOROIDAL\n  CURV 0.0\n  PARM 1 40", (40, 0, {}, "x")),
        ("TYPE TOROIDAL\n  CURV 0.025\n  PARM 1 40", (40, 0, {}, None)),
        ("TYPE XASPHERE\n  CURV 0.02\n  CONI -1\n  XDAT 1 2\n  XDAT 2 10\n  XDAT 4 2E-6", (50, -1, {4: 2e-10}, None)),
        ("TYPE XOSPHERE\n  CURV 0.02\n  XDAT 1 3\n  XDAT 2 10\n  XDAT 5 2E-6", (50, 0, {3: 2e-9}, None)),
        (
            "TYPE QED_TYPE\n  CURV 0.02\n  CONI -1\n  XDAT 1 1\n  XDAT 2 1\n  XDAT 3 10\n  XDAT 4 0.5",
            (50, -1, {4: 5e-5}, None),
        ),
        ("TYPE BICONICX\n  CURV 0.02\n  CONI -2\n  PARM 1 0\n  PARM 2 3", (50, -2, {}, "y")),
        ("TYPE BICONICX\n  CURV 0\n  PARM 1 40\n  PARM 2 -3", (40, -3, {}, "x")),
        ("TYPE BICONICX\n  CURV 0.025\n  CONI -1\n  PARM 1 40\n  PARM 2 -1", (40, -1, {}, None)),
        ("TYPE BICONICX\n  CURV 0.02\n  CONI -1\n  PARM 1 40\n  PARM 2 3", (50, -1, {}, "y", (40, 3))),
        (
            "TYPE TOROIDAL\n  CURV 0.02\n  CONI -1\n  PARM 1 -40\n  PARM 2 1E-4\n  PARM 8 2E-18",
            (50, -1, {2: 1e-4, 14: 2e-18}, "y", (-40, None)),
        ),
        ("TYPE TOROIDAL\n  CURV 0.0\n  PARM 1 40\n  PARM 3 1E-6", (math.inf, 0, {4: 1e-6}, "y", (40, None))),
        ("TYPE TOROIDAL\n  CURV 0.02\n  PARM 3 1E-6", (50, 0, {4: 1e-6}, "y")),
    ],
)
def test_surface_types(block: str, shape: tuple[Any, ...], tmp_path: Path) -> None:
    lens = read(swapped('TYPE STANDARD\n  CURV 2.0E-2 0 0 0 0 ""', block), tmp_path)
    s = lens.surfaces[0]
    wanted = shape if len(shape) > 4 else (*shape, None)
    f = s.figure
    found = pytest.approx(s.radius_mm), f.conic, pytest.approx(dict(f.powers)), f.axis, f.record().get("across")
    assert found == wanted


QED = """\
  TYPE QED_TYPE
  CURV 5.7560787627824225E-02
  CONI -0.67609120640407927
  XDAT 1 0
  XDAT 2 6
  XDAT 3 27
  XDAT 4 -8.148370167576E-01
  XDAT 5 -3.2311E-01
  XDAT 6 1.0591E-01
  XDAT 7 -5.058E-02
  XDAT 8 9.870E-03
  XDAT 9 -2.2E-03
  DISZ 29.85
  GLAS FusedSilica 0 0 0 0 0
  DIAM 22.86 1
SURF 2
  CURV 0
  DISZ 19.687453064998852
  DIAM 22.86 1
"""


def test_a_qbfs_asphere_on_a_conic_focuses_all_zones(tmp_path: Path) -> None:
    """Thorlabs ASL5040-UV, f/0.87: at the wavelength of its file its zones meet within a micrometre of its film."""
    body = "SURF 1\n  STOP\n" + QED
    lens = read(HEAD.replace("ENPD 10", "ENPD 45.7").replace("5.875618E-1", "0.405") + body + TAIL, tmp_path)
    assert lens.reference_nm == 405.0
    assert first_order(lens).efl_mm == pytest.approx(40.0, rel=0.01)
    s, n = lens.surfaces[0], catalogue.find("fused silica").index(405.0)
    terms = {p: float(a) for p, a in s.figure.powers}
    for h in (1.0, 6.0, 12.0, 18.0, 22.8):
        root = math.sqrt(1 - (1 + s.figure.conic) * (h / s.radius_mm) ** 2)
        z = h * h / s.radius_mm / (1 + root) + sum(a * h**p for p, a in terms.items())
        slope = math.atan(h / s.radius_mm / root + sum(p * a * h ** (p - 1) for p, a in terms.items()))
        u = slope - math.asin(math.sin(slope) / n)  # a ray parallel to the axis, refracted towards it
        at_rear = h - math.tan(u) * (s.thickness_mm - z)
        crossing = at_rear / math.tan(math.asin(n * math.sin(u)))
        assert crossing == pytest.approx(lens.surfaces[1].thickness_mm, abs=1e-3)


def test_a_paraxial_surface_is_an_ideal_lens(tmp_path: Path) -> None:
    front = 'TYPE STANDARD\n  CURV 2.0E-2 0 0 0 0 ""'
    text = swapped(front, "TYPE PARAXIAL\n  CURV 0.0\n  PARM 1 75\n  PARM 2 1").replace("GLAS N-BK7", "COMM N-BK7")
    lens = read(text.replace("CURV -2.0E-2", "CURV 0.0"), tmp_path)
    assert lens.surfaces[0].figure == Ideal(focal_mm=75) and first_order(lens).efl_mm == pytest.approx(75, rel=1e-14)
    with pytest.raises(InputError, match="surface 1 of the file, focal_mm: got 75.0, expected air on both sides"):
        read(swapped(front, "TYPE PARAXIAL\n  CURV 0.0\n  PARM 1 75"), tmp_path)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("MODE SEQ", "MODE NSC", r"line 2, MODE: got 'NSC'"),
        ("UNIT MM", "UNIT FURLONG", r"line 6, UNIT: got 'FURLONG', expected one of MM"),
        ("ENPD 10", "OBNA 0.5 1", r"line 7, OBNA: got '0.5 1', expected a numerical aperture, with flag 0"),
        ("ENPD 10", "OBNA 0.1 0", r"numerical aperture of the object: got 0.1, expected.*a finite distance"),
        ("CURV 2.0E-2", "CURV 2.0E+4", r"focal length: got [-0-9.e]+, expected at least a hundredth of the thickest"),
        ("GLAS N-BK7", "GLAS N-BK8", r"GLAS: got 'N-BK8', expected a glass.*N-BK7"),
        ("TYPE STANDARD\n  CURV -2", "TYPE PARAXIAL\n  CURV -2", r"PARAXIAL: got 0.0, expected PARM 1, a focal length"),
        ("TYPE STANDARD\n  CURV -2", "TYPE QT\n  XDAT 1 2\n  XDAT 2 1\n  XDAT 4 1\n  CURV -2", r"0 \(Qbfs\) or 1"),
        ("GLAS N-BK7", "GLAS MIRROR", r"line 29, GLAS: got 'MIRROR'.*no mirrors"),
        ("GLAS N-BK7 0 0 1.5 4.0E+1", "GLAS ___BLANK 1 0 0.5 60", r"index: got 0.5"),
        ("SURF 2", "SURF 4", r"SURF: got '4', expected surface 2"),
        ("TYPE STANDARD\n  CURV -2", "TYPE COORDBRK\n  PARM 7 12\n  CURV -2", r"PARM 7 of COORDBRK: got 12.0"),
        ("TYPE STANDARD\n  CURV -2", "TYPE XPOLYNOM\n  CURV -2", r"line 32, TYPE: got 'XPOLYNOM'"),
        ("TYPE STANDARD\n  CURV -2", "TYPE TOROIDAL\n  PARM 9 1E-5\n  CURV -2", r"PARM 9 of TOROIDAL"),
        ("TYPE STANDARD\n  CURV -2", "TYPE ODDASPHE\n  PARM 1 1E-3\n  CURV -2", r"PARM 1 of ODDASPHE"),
        ("  DIAM 9 1", "  OBSC 0 3 0\n  DIAM 9 1", r"line 35, OBSC: got .0 3 0., expected no obscuration"),
        ("  DIAM 9 1", "  CLAP 2 9 0\n  DIAM 9 1", r"CLAP: got '2 9', expected a round opening without a hole"),
        ("DIAM 9 1", "DIAM 60 1", r"surface 2 of the file, diameter_mm: got 120"),
        ("DISZ 45.0", "DISZ INFINITY", r"DISZ: got 'INFINITY'"),
        ("MNUM 1 1", "MNUM 1000 1", r"MNUM: got 1000"),
    ],
)
def test_refusals(old: str, new: str, message: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=message):
        read(swapped(old, new), tmp_path)


DUMMY = """\
SURF 3
  TYPE STANDARD
  CURV 0
  DISZ {gap}
  DIAM 0.1 0 0 0 1 ""
"""


def test_planes_that_cut_no_beam_are_left_out(tmp_path: Path) -> None:
    text = swapped("DISZ 45.0", "DISZ 40.0").replace(TAIL, DUMMY.format(gap=5.0) + TAIL.replace("SURF 3", "SURF 4"))
    with pytest.warns(NeurolensWarning, match="surface 3 of the file left out"):
        lens = read(text, tmp_path)
    assert [s.thickness_mm for s in lens.surfaces] == [5.0, 45.0]
    held = text.replace('DIAM 0.1 0 0 0 1 ""', 'DIAM 6 1 0 0 1 ""\n  CLAP 0 5 0')
    with pytest.warns(NeurolensWarning):
        lens = read(held, tmp_path)
    assert [s.diameter_mm for s in lens.surfaces][1:] == [18.0, 10.0]


def test_the_catalogues_of_the_file_decide_between_makers(tmp_path: Path) -> None:
    shared = next(g for g in catalogue.all_glasses() if len(catalogue.same_name(g.name)) > 1)
    for known in catalogue.same_name(shared.name):
        text = swapped("GCAT SCHOTT", f"GCAT NOBODY {known.maker.upper()}_2020")
        s = read(swapped("GLAS N-BK7", f"GLAS {shared.name.replace(' ', '')}", text), tmp_path).surfaces[0]
        assert s.n_d == known.n_d and s.glass is not None and catalogue.find(s.glass) is known


ZOOM = """\
MNUM 2 1
LTTL 0 1 "far" 0 0 0
LTTL 0 2 "near" 0 0 0
THIC 0 1 1.0E+10 0 0 0
THIC 0 2 300 0 0 0
THIC 2 1 45 0 0 0
THIC 2 2 58.5 0 0 0
FVDY 1 1 0 0 0 0
APER 0 1 10 0 0 0
APER 0 2 8 0 0 0
"""


def test_configurations(tmp_path: Path) -> None:
    text = HEAD + BODY + TAIL[: TAIL.index("MNUM")] + ZOOM
    far, near = read(text, tmp_path).configurations
    assert (far.name, far.object_distance_mm, far.stop_diameter_mm) == ("far", None, pytest.approx(10))
    assert (near.name, near.object_distance_mm, near.stop_diameter_mm) == ("near", 300.0, pytest.approx(8))
    assert dict(near.thickness_mm) == {1: 58.5}
    for old, new, message in (
        ("APER 0 2 8", "CRVT 1 2 0.03", r"CRVT: got \(unknown operand\)"),
        ("APER 0 2 8", "GLSS 1 2 0", r"GLSS"),
        ("APER 0 2 8", "SDIA 2 2 8", r"SDIA: got \(surface 2\), expected the stop"),
        ("THIC 2 2", "THIC 9 2", r"THIC: got '9 2'"),
        ("THIC 2 2", "THIC 2 7", r"THIC: got '2 7'"),
        ("THIC 2 2 58.5", "THIC 2 2 nan", r"THIC: got 'nan'"),
    ):
        with pytest.raises(InputError, match=message):
            read(swapped(old, new, text), tmp_path)


@pytest.mark.parametrize("solve", ["TCOM 1 50", "TOLE 1 50"])
def test_thickness_solves_are_carried_out_in_each_configuration(solve: str, tmp_path: Path) -> None:
    body = swapped("DISZ 45.0\n", f"DISZ 45.0\n  {solve}\n", BODY)
    zoom = "MNUM 2 1\nTHIC 1 1 5 0\nTHIC 1 2 7 0\n"
    one, two = read(HEAD + body + TAIL[: TAIL.index("MNUM")] + zoom, tmp_path).configurations
    assert dict(one.thickness_mm) == {0: 5.0, 1: 45.0} and dict(two.thickness_mm) == {0: 7.0, 1: 43.0}


def test_a_marginal_ray_solve_puts_the_film_in_focus(tmp_path: Path) -> None:
    lens = read(swapped("DISZ 45.0\n", "DISZ 0\n  MAZH 0 0\n"), tmp_path)
    assert lens.surfaces[-1].thickness_mm == pytest.approx(first_order(lens).back_focus_mm)


def test_a_near_object_becomes_a_focus_state(tmp_path: Path) -> None:
    lens = read(swapped("DISZ INFINITY", "DISZ 500"), tmp_path)
    assert [c.object_distance_mm for c in lens.configurations] == [500.0]


def test_rims_that_are_not_given_are_derived_for_the_field(tmp_path: Path) -> None:
    text = swapped('  DIAM 9 1 0 0 1 ""\n', "")
    lens = read(text, tmp_path)
    assert lens.rims == "derived" and 9 < lens.surfaces[1].diameter_mm < 12
    without = swapped("YFLN 0 2.5 4 9", "YFLN 0 0 0 0", swapped("XFLN 0 0 3 9", "XFLN 0 0 0 0", text))
    assert read(without, tmp_path).surfaces[1].diameter_mm == lens.surfaces[0].diameter_mm  # the rim of the same glass
    element = "SURF 3\n  CURV 0.001\n  DISZ 2\n  GLAS N-BK7\nSURF 4\n  CURV 0.0\n  DISZ 40\n"
    with pytest.raises(InputError, match=r"not given for surface 2, 3, 4 of the file.*--half-field"):
        read(swapped("SURF 3\n", element + "SURF 5\n", without), tmp_path)
    assert read(without, tmp_path, ReadOptions(half_field_deg=5.0)).surfaces == lens.surfaces
    assert math.isfinite(lens.surfaces[1].diameter_mm)


@pytest.mark.parametrize("sized", ["ENPD 25", "FNUM 2 0"])
def test_the_stop_s_own_aperture_clips_what_the_pupil_asks_for(sized: str, tmp_path: Path) -> None:
    text = swapped("ENPD 10", sized, swapped("  DIAM 8 1", "  FLAP 0 6.0 0\n  DIAM 8 1"))
    with pytest.warns(NeurolensWarning, match=r"ask for a stop 2[0-9.]+ wide, its own aperture is 12"):
        lens = read(text, tmp_path)
    assert lens.surfaces[0].diameter_mm == pytest.approx(12.0)
    assert lens.f_number == pytest.approx(first_order(lens).f_number)
    zoom = text[: text.index("MNUM")] + ZOOM.replace("APER 0 1 10", "APER 0 1 14")
    if sized.startswith("ENPD"):
        far, near = read(zoom, tmp_path).configurations
        assert (far.stop_diameter_mm, near.stop_diameter_mm) == (pytest.approx(12.0), pytest.approx(8.0))


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("TYPE STANDARD\n  CURV 2", "TYPE COORDBRK\n  CURV 2", r"line 24, CURV of COORDBRK"),
        ('TYPE STANDARD\n  CURV 2.0E-2 0 0 0 0 ""\n', "TYPE COORDBRK\n", r"line 28, GLAS of COORDBRK"),
    ],
)
def test_what_no_lens_has(old: str, new: str, message: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=message):
        read(swapped(old, new), tmp_path)


def test_a_coordinate_break_without_tilt_stands_in_its_medium(tmp_path: Path) -> None:
    plain = read(HEAD + BODY + TAIL, tmp_path)
    block = "SURF 2\n  TYPE COORDBRK\n  CURV 0\n  PARM 3 0\n  DISZ 2.0\n"
    text = swapped("DISZ 5.0", "DISZ 3.0").replace("SURF 3", "SURF 4").replace("SURF 2", block + "SURF 3")
    assert read(text, tmp_path).surfaces == plain.surfaces


@pytest.mark.parametrize(
    ("makers", "name", "taken", "why"),
    [
        ("GCAT SCHOTT", "SK16", "Schott:N-SK16", "that very name"),
        ("GCAT SCHOTT", "BK7", "Schott:N-BK7", "that very name"),
        ("GCAT OHARA", "SK16", "Hikari:SK16", r"names \(OHARA\)"),
        ("NOTE 0 none", "SK16", "Hikari:SK16", "names no maker"),
        ("NOTE 0 none", "N-BK7", "Schott:N-BK7", "names no maker"),
        ("GCAT SCHOTT", "N-BK7", "Schott:N-BK7", None),
    ],
)
def test_a_glass_that_could_be_another_is_named(
    makers: str, name: str, taken: str, why: str | None, tmp_path: Path
) -> None:
    text = swapped("GCAT SCHOTT", makers, swapped("GLAS N-BK7", f"GLAS {name}"))
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        found = read(text, tmp_path).surfaces[0].glass
    assert found is not None and str(catalogue.find(found)) == taken
    told = [str(w.message) for w in caught if "is taken as" in str(w.message)]
    assert len(told) == (why is not None)
    assert why is None or re.search(f"glass {name} is taken as {taken} .*{why}", told[0])
