"""Plain tables and OSLO files in the details of their definitions, and their refusals by line."""

from pathlib import Path

import pytest
from lens_formats import swapped
from shipped import singlet_mm

from neurolens.base.errors import AssumedWarning, InputError, NeurolensWarning
from neurolens.optics.lens import glass as catalogue
from neurolens.optics.lens.paraxial import first_order
from neurolens.optics.lens.prescription import Lens
from neurolens.optics.readers.oslo import read_len
from neurolens.optics.readers.source import ReadOptions
from neurolens.optics.readers.tables import read_table

# A biconvex singlet of R = 50 mm, 5 mm thick, n = 1.5, behind a stop: EFL by the lensmaker's formula.
TABLE = """\
# Singlet behind a stop
# radius  thickness  n  aperture

0       4.0   0     10
50      5.0   1.5   20   # the front
-50.0   0     1     20
"""
EFL_MM, BACK_MM = singlet_mm(1.5)

OSLO = """\
// OSLO 6.1 31567 0 0
LEN NEW "A singlet; // for a test" 49.15 3
EBR  5.0
ANG  5.0
DES  "OSLO"
UNI  1.0
SNO1 "made up"
AIR
TH   1.0e+20
AP   8.7e+18
NXT  // SRF 1
GLA  BK7
RD   50.0
TH   5.0
AP   8.0
AST
NXT
AIR ; RD -50.0
PY   0.0
AP CHK 9.0
NXT
AIR
CALLBACK 1
WV 0.58756 0.48613 0.65627
END  3
"""


def read(text: str, suffix: str, tmp_path: Path, options: ReadOptions | None = None) -> Lens:
    path = tmp_path / f"lens{suffix}"
    path.write_text(text)
    return read_len(path, options) if suffix == ".len" else read_table(path, options)


@pytest.mark.parametrize("count", ["", "3\n"])
def test_table_by_the_lensmakers_formula(count: str, tmp_path: Path) -> None:
    lens = read(count + TABLE, ".dat", tmp_path)
    data = first_order(lens)
    assert data.efl_mm == pytest.approx(EFL_MM, rel=1e-12)
    # A last thickness of 0 stands for the paraxial focus.
    assert lens.surfaces[-1].thickness_mm == pytest.approx(BACK_MM, rel=1e-12)
    assert (lens.name, lens.stop_index) == ("Singlet behind a stop", 0)
    assert lens.f_number == pytest.approx(EFL_MM / data.entrance_pupil_diameter_mm)
    assert lens.dispersive is False


def test_the_users_word_where_a_table_says_nothing(tmp_path: Path) -> None:
    given = ReadOptions(name="mine", source="a book", f_number=4.9, units="in")
    lens = read(TABLE, ".dat", tmp_path, given)
    assert (lens.name, lens.source, lens.f_number) == ("mine", "a book", 4.9)
    assert first_order(lens).efl_mm == pytest.approx(25.4 * EFL_MM)
    assert lens.surfaces[0].diameter_mm == pytest.approx(254)


def test_semi_diameters_and_gaps_in_front(tmp_path: Path) -> None:
    lens = read(TABLE, ".dat", tmp_path)
    rows = "0 0 0 5\n50 4.0 1.5 10\n-50 5.0 1 10\n"
    other = read(rows, ".txt", tmp_path, ReadOptions(gap_before=True, semi_diameters=True))
    assert other.surfaces == lens.surfaces


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("1.5   20", "1.5", r"line 5, row: got '50 5.0 1.5', expected 4 numbers"),
        ("1.5   20", "1.5 -20", r"line 5, diameter: got -20.0"),
        ("1.5   20", "0.9 20", r"line 5, index: got 0.9"),
        ("1.5   20", "0 20", r"stop: got \(rows at line 4, 5\)"),
        ("1.5   20", "nbk7 20", r"line 5, index: got 'nbk7'"),
        ("0       4.0", "7\n0       4.0", r"line 4, count: got 7, expected 3"),
        ("50      5.0", "50      -5.0", r"surface 1, thickness_mm: got -5.0"),
        ("1.5   20", "1.5 120", r"surface 1, diameter_mm: got 120"),
    ],
)
def test_table_refusals(old: str, new: str, message: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=message):
        read(swapped(old, new, TABLE), ".dat", tmp_path)


def test_the_film_lies_in_the_medium_of_the_last_row(tmp_path: Path) -> None:
    """The paraxial image of a singlet lies 1.2 times as far from R = -50 mm as n' u' = n u - y (n' - n) / R says."""
    with pytest.warns(AssumedWarning, match="the film lies in a medium of index 1.2"):
        lens = read(swapped("1     20", "1.2   20", TABLE), ".dat", tmp_path)
    u = -(0.5 / 50) / 1.5  # after the first surface, of a ray at height 1
    y = 1 + 5 * u
    after = (1.5 * u + y * (1.2 - 1.5) / 50) / 1.2
    assert first_order(lens).efl_mm == pytest.approx(-1 / after, rel=1e-12)
    assert lens.surfaces[-1].thickness_mm == pytest.approx(-y / after, rel=1e-12)


def test_oslo_by_the_lensmakers_formula(tmp_path: Path) -> None:
    lens = read(OSLO, ".len", tmp_path)
    efl_mm, back_mm = singlet_mm(catalogue.find("BK7").n_d)
    assert first_order(lens).efl_mm == pytest.approx(efl_mm, rel=1e-12)
    assert lens.surfaces[-1].thickness_mm == pytest.approx(back_mm)
    assert (lens.name, lens.notes, lens.half_field_deg) == ("A singlet; // for a test", "made up", 5.0)
    assert [s.diameter_mm for s in lens.surfaces] == pytest.approx([10.0, 18.0])
    assert read(swapped("UNI  1.0", "UNI  25.4", OSLO), ".len", tmp_path) == lens.scaled(25.4)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("UNI  1.0", "UNI  3.0", r"line 6, UNI: got 3.0"),
        ("EBR  5.0", "EBR  0", r"line 3, EBR"),
        ("EBR  5.0", "NA   0.1", r"line 3, NA: got '0.1', expected EBR, FNO or NAO"),
        ("EBR  5.0", "NAO  0.1", r"numerical aperture of the object: got 0.1, expected.*a finite distance"),
        ("GLA  BK7", "GLA  BK99", r"line 12, GLA: got 'BK99'"),
        ("GLA  BK7", "PK GLA -2", r"line 12, PK: got 'GLA -2', expected a figure: solves and pickups"),
        ("GLA  BK7", "GLA  REFL", r"no mirrors"),
        ("TH   5.0", "PY 0.0", r"PY: got \(on surface 1\), expected the last surface"),
        ("PY   0.0", "PU   -0.1", r"line 19, PU: got '-0.1', expected a figure"),
        ("AST\n", "AST; RCO\n", r"line 16, RCO: got \(here\), expected no return of the axes"),
        ("AST\n", "AST; TLA 5; BEN\n", r"line 16, BEN: got \(here\), expected no bend of the axes"),
        ("AST\n", "AST; TLA 5; DT -1\n", r"line 16, DT: got '-1', expected 1: decentres before tilts"),
        ("END  3", "END  7", r"line 25, END: got '7', expected 3"),
        ("END  3\n", "", r"END: got \(missing\)"),
        ("END  3\n", "END 3\nCFG NEW\n", r"line 26, CFG: got 'NEW', expected one configuration"),
        ("TH   5.0", "TH   x", r"line 14, TH: got 'x'"),
        ("AST\n", "AST; AS2 1e-6\n", r"line 16, AS2: got '1e-6', expected a sphere, a conic, or AD to AG"),
        ("AST\n", "AST; TLA 5; TOZ 2\n", r"line 16, TOZ: got '2', expected 0: pivots of tilts"),
        ("AST\n", "AST; LMO NSS\n", r"line 16, LMO: got 'NSS', expected no non-sequential part"),
        ("CALLBACK 1", "GTO 1; RD 30", r"line 23, GTO: got '1', expected surfaces as they are"),
        ("EBR  5.0", "NAP 0.1", r"line 3, NAP: got '0.1', expected EBR, FNO or NAO"),
    ],
)
def test_oslo_refusals(old: str, new: str, message: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=message):
        read(swapped(old, new, OSLO), ".len", tmp_path)


@pytest.mark.parametrize(
    ("changes", "index"),
    [
        ({"RD   50.0": "RDF 50.0", "TH   5.0": "THF 5.0", "GLA  BK7": "GLF BK7", "AIR ; RD": "AIF ; CVF -0.02; RD"}, 0),
        ({"GLA  BK7": "WV 0.58756 0.48613 0.65627\nGLA MOD MODEL1 1.6201 1.6272360458395 1.6169694895481"}, 1.6201),
        ({"GLA  BK7": "GLA MOD 1.6201 60.4"}, 1.6201),
        ({"GLA  BK7": "GLA 620604"}, 1.62),
        ({"ANG  5.0": "ANG  -5.0", "WV 0.58756 0.48613 0.65627": "WV 0.58756; WV2 0.48613; WV3 0.65627"}, 0),
    ],
)
def test_oslo_as_it_writes_fixed_figures_and_model_glasses(
    changes: dict[str, str], index: float, tmp_path: Path
) -> None:
    """The model glass is one of a file that OSLO 6.6 wrote, with V_d = 60.4."""
    text = OSLO
    for old, new in changes.items():
        text = swapped(old, new, text)
    lens = read(text, ".len", tmp_path)
    assert first_order(lens).efl_mm == pytest.approx(singlet_mm(index or catalogue.find("BK7").n_d)[0], rel=1e-12)
    assert lens.surfaces[0].V_d == pytest.approx(60.4 if index else catalogue.find("BK7").V_d, rel=1e-6)
    assert (lens.half_field_deg, lens.surfaces[0].thickness_mm) == (5.0, 5.0)
    assert lens.wavelengths_nm[0] == 587.56 and len(lens.wavelengths_nm) == 3


def test_the_image_of_oslo_is_where_its_thickness_says_and_plane(tmp_path: Path) -> None:
    text = swapped("PY   0.0", "TH 46.0", swapped("CALLBACK 1", "TH 0.25; RD -300", OSLO))
    with pytest.warns(NeurolensWarning, match="the image surface is curved; the film is taken as plane"):
        assert read(text, ".len", tmp_path).surfaces[-1].thickness_mm == 46.25


def test_the_beam_of_oslo_is_measured_at_surface_1(tmp_path: Path) -> None:
    """The paraxial ray from a near axial point to the height EBR on surface 1 meets the edge of the stop behind it."""
    text = swapped("TH   1.0e+20", "TH 500", swapped("AST\n", "", swapped("PY   0.0", "PY 0.0; AST", OSLO)))
    lens, n = read(swapped("AP CHK 9.0", "AP 9.0", text), ".len", tmp_path), catalogue.find("BK7").n_d
    behind = (5 / 500 - 5 * (n - 1) / 50) / n
    assert lens.surfaces[1].stop and lens.surfaces[1].semi_diameter_mm == pytest.approx(5 + 5 * behind, rel=1e-12)


def test_terms_beyond_those_of_oslo_bend_rays_too(tmp_path: Path) -> None:
    text = swapped("RD   50.0", "RD 50.0; CC -1; AD 1e-6; AG -1e-13; AH 2e-16; AI 0", OSLO)
    with pytest.warns(AssumedWarning, match=r"line 13: AH is taken as the coefficient of r\^12"):
        shape = read(text, ".len", tmp_path).surfaces[0].figure
    assert shape.conic == -1 and shape.asphere == ((4, 1e-6), (10, -1e-13), (12, 2e-16))


def test_a_glass_of_oslo_says_whose_it_is_taken_for(tmp_path: Path) -> None:
    with pytest.warns(NeurolensWarning, match=r"glass BK7 is taken as Schott:N-BK7 \(n_d 1.51680"):
        read(OSLO, ".len", tmp_path)
