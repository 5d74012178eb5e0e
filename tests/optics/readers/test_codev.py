"""CODE V sequence files in the details of their definition: media, what sizes the stop, zooms, refusals by line."""

import math
import re
from pathlib import Path
from typing import Any

import pytest
from lens_formats import swapped as swapped_in
from shipped import singlet_mm

from neurolens.base.errors import AssumedWarning, InputError, NeurolensWarning
from neurolens.optics.lens import glass as catalogue
from neurolens.optics.lens.figures import Figure, Qcon
from neurolens.optics.lens.paraxial import first_order
from neurolens.optics.lens.prescription import Lens
from neurolens.optics.readers.codev import read_seq
from neurolens.optics.readers.forbes import qbfs_terms
from neurolens.optics.readers.source import ReadOptions

TEXT = """\
RDM;LEN       "VERSION: 11.2 SR1       LENS VERSION: 84       Creation Date: 28-May-2019"
TITLE 'A singlet; for a test!' ! that is a comment
EPD   10.0
DIM   M
WL    656.3 587.6 &
 486.1
REF   2; WTW 1 1 1
XAN   0.0 3.0
YAN   0.0 4.0
VUY   0.0 0.0
SO    0.0 0.1e14
S     50.0 5.0 NBK7_SCHOTT
  CIR 8
  STO
  CCY 0; THC 0
S     -50.0 45.0
  CIR 9 ; CIR EDG 9.5
SI    0.0 0.0
GO
"""


def swapped(old: str, new: str, text: str = TEXT) -> str:
    return swapped_in(old, new, text)


def read(text: str, tmp_path: Path, options: ReadOptions | None = None) -> Lens:
    path = tmp_path / "lens.seq"
    path.write_text(text)
    return read_seq(path, options)


@pytest.mark.parametrize("text", [TEXT, TEXT.lower(), TEXT.replace("\n", "\r\n")])
def test_singlet_by_the_lensmakers_formula(text: str, tmp_path: Path) -> None:
    lens = read(text, tmp_path)
    efl_mm, _ = singlet_mm(catalogue.find("N-BK7").n_d)
    assert first_order(lens).efl_mm == pytest.approx(efl_mm, rel=1e-12)
    assert lens.name.lower() == "a singlet; for a test!"
    # Angles in the x-z and the y-z plane: their tangents add as squares.
    tangent = math.hypot(math.tan(math.radians(3)), math.tan(math.radians(4)))
    assert lens.half_field_deg == pytest.approx(math.degrees(math.atan(tangent)), rel=1e-12)
    assert [s.diameter_mm for s in lens.surfaces] == pytest.approx([10.0, 18.0])
    assert lens.f_number == pytest.approx(efl_mm / 10)


@pytest.mark.parametrize(
    ("medium", "n_d", "V_d", "glass"),
    [
        ("517.642", 1.517, 64.2, None),
        ("517642", 1.517, 64.2, None),
        ("516800.641700", 1.5168, 64.17, None),
        ("516.64", 1.516, 64.0, None),  # as OpTaliX writes it
        ("003283", 2.003, 28.3, None),  # no glass has an index of 1.003
        ("1003300.282700", 2.0033, 28.27, None),
        ("1.5168:64.17", 1.5168, 64.17, None),
        ("1.5168 64.17", 1.5168, 64.17, None),
        ("1.5168", 1.5168, None, None),
        ("BK7_SCHOTT", None, None, "N-BK7"),
        ("'NSK16_SCHOTT'", None, None, "N-SK16"),
        ("SLAL8_OHARA", None, None, "S-LAL8"),
        ("N-BK7", None, None, "N-BK7"),
    ],
)
def test_media(medium: str, n_d: float | None, V_d: float | None, glass: str | None, tmp_path: Path) -> None:
    s = read(swapped("NBK7_SCHOTT", medium), tmp_path).surfaces[0]
    if glass is None:
        assert (s.n_d, s.V_d, s.glass) == (pytest.approx(n_d), V_d if V_d is None else pytest.approx(V_d), None)
    else:
        assert s.glass is not None and catalogue.find(s.glass).name == glass
        assert s.n_d == catalogue.find(glass).n_d


def test_private_glass_by_its_d_f_and_c_lines(tmp_path: Path) -> None:
    block = "PRV\n  PWL 656.3 587.6 546.1&\n 486.1\n  'MINE' 1.5143 1.5168 1.5187 1.5224\nEND\nSO "
    text = swapped("SO ", block, swapped("NBK7_SCHOTT", "'MINE'"))
    with pytest.warns(NeurolensWarning, match="PRV MINE: the glass is reduced"):
        s = read(text, tmp_path).surfaces[0]
    assert (s.n_d, s.material) == (1.5168, "MINE")
    assert s.V_d == pytest.approx(0.5168 / 0.0081)
    with pytest.raises(InputError, match="expected indices from the F line"):
        read(swapped("656.3 587.6 546.1", "630.0 587.6 546.1", text), tmp_path)


def test_a_private_glass_between_its_wavelengths_is_interpolated(tmp_path: Path) -> None:
    """Of N-BK7 every 50 nm, none of them a line: to less than the sixth decimal, which catalogues do not print."""
    bk7 = catalogue.find("N-BK7")
    waves = (700.0, 650.0, 600.0, 550.0, 500.0, 450.0)
    rows = f"PRV\n PWL {' '.join(map(str, waves))}\n MINE {' '.join(repr(bk7.index(nm)) for nm in waves)}\nEND\nSO "
    s = read(swapped("SO ", rows, swapped("NBK7_SCHOTT", "MINE")), tmp_path).surfaces[0]
    assert (s.n_d, s.V_d) == (pytest.approx(bk7.n_d, abs=1e-6), pytest.approx(bk7.V_d, abs=1e-2))


def test_a_private_glass_that_no_surface_uses_is_not_read(tmp_path: Path) -> None:
    block = "PRV\n PWL 550.0\n 'NOA61' LAU 2.36390625 0.0 0.025493134\nEND\nSO "
    assert read(swapped("SO ", block), tmp_path).surfaces == read(TEXT, tmp_path).surfaces
    with pytest.raises(InputError, match="PRV NOA61: got 'LAU', expected an index at each wavelength"):
        read(swapped("SO ", block, swapped("NBK7_SCHOTT", "NOA61")), tmp_path)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("GO\n", "SCA 2\nGO\n", "line 19, SCA: got '2', expected surfaces as they are: commands that edit"),
        ("GO\n", "FLY S1..2\nGO\n", "line 19, FLY: got 'S1..2', expected surfaces as they are"),
        ("-50.0 45.0", "-50.0 0\n HMY 0", "line 17, HMY: got '0', expected a thickness beside it: solves are not"),
        ("-50.0 45.0", "0 45.0\n UMY -0.1", "line 17, UMY: got '-0.1', expected a curvature beside it"),
        ("  CIR 8", "  CIR 8; ADY 3", "line 13, ADY: got 3.0, expected 0: .* decentred openings are not read"),
    ],
)
def test_what_a_file_asks_codev_to_do_is_refused(old: str, new: str, message: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=message):
        read(swapped(old, new), tmp_path)


def test_solves_that_a_file_has_carried_out_and_clear_openings_read(tmp_path: Path) -> None:
    text = swapped("-50.0 45.0", "-50.0 45.0\n UMY -0.1\n HMY 0", swapped("  CIR 8", "  CIR CLR 8; ADY 0"))
    assert read(text, tmp_path) == read(TEXT, tmp_path)


def test_radii_or_curvatures(tmp_path: Path) -> None:
    expected = read(TEXT, tmp_path)
    in_curvatures = swapped("S     -50.0", "S -0.02", swapped("S     50.0", "S 0.02", TEXT))
    assert read(swapped("RDM;LEN", "RDM N;LEN", in_curvatures), tmp_path) == expected
    with pytest.warns(NeurolensWarning, match="line 12: no RDM"):
        assert read(swapped("RDM;LEN", "LEN", in_curvatures), tmp_path) == expected
    by_name = swapped("S     50.0 5.0", "S 0 0", TEXT) + "RDY S1 50\nTHI S1 5\n"
    assert read(by_name, tmp_path) == expected


def test_what_is_left_out_is_told(tmp_path: Path) -> None:
    for old, new, message in (
        ("WL    656.3", "TEM 60\nWL    656.3", "not at 60"),
        ("VUY   0.0 0.0", "VUY   0.0 0.2", "vignetting factors"),
        ("SI    0.0", "SI    0.01", "image surface is curved"),
        ("XAN   0.0 3.0\nYAN   0.0 4.0", "YOB   0.0 4.0", "object height"),
    ):
        with pytest.warns(NeurolensWarning, match=message):
            read(swapped(old, new), tmp_path)


def test_units_and_defocus(tmp_path: Path) -> None:
    lens = read(TEXT, tmp_path)
    assert read(swapped("DIM   M", "DIM I"), tmp_path) == lens.scaled(25.4)
    assert read(swapped("SI    0.0 0.0", "SI 0.0 -0.5"), tmp_path).surfaces[-1].thickness_mm == 44.5
    focused = read(swapped("-50.0 45.0", "-50.0 0.0\n PIM"), tmp_path)
    assert focused.surfaces[-1].thickness_mm == pytest.approx(first_order(focused).back_focus_mm)
    bare = swapped("-50.0 45.0", "-50.0 0.0")
    assert read(swapped("GO", "PIM YES\nGO", bare), tmp_path) == focused
    assert read(swapped("GO", "PIM NO\nGO", bare), tmp_path).surfaces[-1].thickness_mm == 0.0


@pytest.mark.parametrize(
    ("block", "shape"),
    [
        ("CON; K -1", (50, -1, {}, None)),
        ("ASP; K -1.5; A 1e-5; B -2e-8; J 1e-30", (50, -1.5, {4: 1e-5, 6: -2e-8, 20: 1e-30}, None)),
        ("ASP\n CUF 0.0\n A 0.0", (50, 0, {}, None)),
        ("CYL", (50, 0, {}, "y")),
        ("YTO; K -1; CUX 0", (50, -1, {}, "y")),
        ("YTO; CUY 0; CUX 0.025", (40, 0, {}, "x")),
        ("XTO; RDY 0; RDX 40; K -2", (40, -2, {}, "x")),
        ("XDE 0.0; ADE 0.0", (50, 0, {}, None)),
        ("YTO; K -1; A 1e-6; CUX -0.025", (50, -1, {4: 1e-6}, "y", (-40, None))),
        ("XTO; RDX 40; K -2; B 1e-9", (40, -2, {6: 1e-9}, "x", (50, None))),
        ("AAS; RDX 40; KY -1; KX 2; AR 0; AP 0.5", (50, -1, {}, "y", (40, 2))),
        ("AAS; RDX 50; KY -1; KX -1", (50, -1, {}, None)),
        ("AAS; RDY 0; RDX 40; KX 2", (40, 2, {}, "x")),
        ("SPS ODD 10.0\n SCO K -1; SCC K 100\n SCO AR3 2e-3", (50, -1, {3: 2e-6}, None)),
        ("SPS QCN; SCO NRADIUS 10; SCO K -1; SCO QC4 0.5", (50, -1, {4: 5e-5}, None)),
    ],
)
def test_surface_types(block: str, shape: tuple[Any, ...], tmp_path: Path) -> None:
    s = read(swapped("  CIR 8", f"  {block}\n  CIR 8"), tmp_path).surfaces[0]
    wanted = shape if len(shape) > 4 else (*shape, None)
    f = s.figure
    found = pytest.approx(s.radius_mm), f.conic, pytest.approx(dict(f.powers)), f.axis, f.record().get("across")
    assert found == wanted


@pytest.mark.parametrize(("kind", "names"), [("QBF", "QB"), ("QCN", "QC")])
def test_q_types_are_the_sums_of_forbes(kind: str, names: str, tmp_path: Path) -> None:
    values = (2e-2, -3e-3, 4e-4)
    terms = "".join(f"; SCO {names}{4 + 2 * m} {a}" for m, a in enumerate(values))
    with pytest.warns(AssumedWarning, match=rf"lens\.seq: line 12: SPS {kind}: coefficient {names}n is taken"):
        s = read(swapped("  CIR 8", f"  SPS {kind} 9.0{terms}\n  CIR 8"), tmp_path).surfaces[0]
    q = Figure(asphere=qbfs_terms(values, 9.0, 1 / 50, 8.0)) if kind == "QBF" else Qcon(qcon=values, norm_mm=9.0)
    assert s.figure == q


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("DIM   M", "DIM   F", r"line 4, DIM: got 'F', expected M \(mm\)"),
        ("EPD   10.0", "NA    0.1", r"line 3, NA: got '0.1', expected EPD, FNO or NAO"),
        ("EPD   10.0", "NAO   0.1", r"numerical aperture of the object: got 0.1, expected.*a finite distance"),
        ("NBK7_SCHOTT", "NBK8_SCHOTT", r"line 12, glass: got 'NBK8'.*N-BK7"),
        ("NBK7_SCHOTT", "REFL", r"line 12, S: got 'REFL'.*no mirrors"),
        ("NBK7_SCHOTT", "0.5:60", r"index: got 0.5"),
        ("  STO", "  INT worn.int", r"line 14, INT: got 'worn.int', expected.*deformations"),
        ("  STO", "  GRT", r"line 14, GRT: got .*given.*no grating"),
        ("  STO", "  STO; XOD 3", r"line 14, XOD: got 3.0, expected 0"),
        ("  STO", "  STO; SPS QBF", r"NRADIUS of SPS QBF: got 0.0, expected a normalisation radius above 0"),
        ("  STO", "  STO; SPS XYP 9", r"line 14, SPS: got 'XYP', expected one of ODD, QBF, QCN"),
        ("  STO", "  STO; CIR OBS 2", r"CIR: got 'OBS'"),
        ("  STO", "  STO; MOD", r"line 14, MOD: got .*no ideal lens \(a module\)"),
        ("  STO", "  STO; RDY S7 3", r"RDY: got 'S7', expected a surface from S0 to S1"),
        ("SO    0.0 0.1e14\n", "", r"line 11, S: got \(here\), expected one object SO"),
        ("S     50.0 5.0", "S     50.0", r"line 12, S: got 'NBK7_SCHOTT', expected a finite number"),
        ("CIR 9 ;", "CIR 60 ;", r"surface 2 of the file, diameter_mm: got 120"),
        ("GO\n", "GO &\n", r"a line that continues"),
        ("GO\n", "ZOO THI S1 1 2\nGO\n", r"line 19, ZOO: got 'THI', expected the count"),
        ("GO\n", "ZOO 2\nZOO RDY S1 1 2\nGO\n", r"line 20, ZOO: got 'RDY'.*other zooms are not read"),
        ("GO\n", "ZOO 2\nZOO CIR S2 1 2\nGO\n", r"line 20, ZOO CIR: got .surface 2., expected the stop"),
    ],
)
def test_refusals(old: str, new: str, message: str, tmp_path: Path) -> None:
    text = swapped(old, new)
    with pytest.raises(InputError, match=message):
        read(text, tmp_path)


def test_zoom_positions(tmp_path: Path) -> None:
    zoom = """\
ZOO 2
ZOO TIT
TIT Z1 'far'
TIT Z2 'near'
ZOO THI SO 0.1e14 &
 300
ZOO THI S2
THI S2 Z1 45.0
THI S2 Z2 58.5
ZOO EPD 10 8
ZOO THC S2 100 100
ZOO VUY F1 0.1 0.2
"""
    far, near = read(swapped("GO\n", zoom + "GO\n"), tmp_path).configurations
    assert (far.name, far.object_distance_mm, far.stop_diameter_mm) == ("far", None, pytest.approx(10))
    assert (near.name, near.object_distance_mm, near.stop_diameter_mm) == ("near", 300.0, pytest.approx(8))
    assert dict(near.thickness_mm) == {1: 58.5}
    assert far.efl_mm is not None and math.isfinite(far.efl_mm)


@pytest.mark.parametrize("radius", ["1.0", "-1.0", "2.0"])
def test_a_bad_radius_gives_no_limit_that_the_field_keeps(radius: str, tmp_path: Path) -> None:
    text = swapped("  CIR 9 ; CIR EDG 9.5\n", "", swapped("  CIR 8\n  STO\n", ""))
    text = swapped("-50.0 45.0", f"{radius} 40.0", swapped("SI    0.0", "S 0 5\n  STO\nSI    0.0", text))
    text = swapped("S     50.0", f"S {radius}", text)
    try:
        read(text, tmp_path)
    except InputError as error:
        limit = re.search("at most ([-0-9.e+]+)", str(error))
        assert limit is None or 0 < float(limit[1].rstrip(",")) < 5
