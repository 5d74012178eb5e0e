"""Files that people have, in small: ../shared/data/cases, whose texts state the right results and their sources.

Focal lengths are those of ray-optics 0.9.8 and of the files' own heads, unless a line says otherwise.
"""

import json
import math
import warnings
from pathlib import Path

import pytest
from test_tables_oslo import OSLO
from test_zemax import BODY, DUMMY, HEAD, TAIL, read, swapped

from neurolens.base.errors import InputError
from neurolens.cameras.build import make_camera
from neurolens.cli import main
from neurolens.optics.lens import glass as catalogue
from neurolens.optics.lens.paraxial import first_order
from neurolens.optics.lens.prescription import Lens
from neurolens.optics.lens.shot import Shot
from neurolens.optics.readers.any_format import read_any
from neurolens.optics.readers.source import ReadOptions
from neurolens.optics.setting.check import check_lens, doubts
from neurolens.optics.setting.states import set_lens
from neurolens.programs.psf import PsfTask

OTHERS = Path(__file__).parents[4] / "shared" / "data" / "cases" / "2026-11-28"
CASES = Path(__file__).parents[4] / "shared" / "data" / "cases"
needs_cases = pytest.mark.skipif(not CASES.exists(), reason="../shared/data/cases is not here")


def heard(path: Path, options: ReadOptions | None = None) -> tuple[Lens, str]:
    """The lens of a file, and all warnings in one text."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        lens = read_any(path, options)
    return lens, "\n".join(str(w.message) for w in caught)


@needs_cases
@pytest.mark.parametrize(
    ("name", "efl_mm", "back_mm", "said"),
    [
        ("00_reference_ok.zmx", 94.6861, 91.9145, ""),
        ("01_hypr.zmx", 94.6861, 91.9145, ""),
        ("02_dbdt.zmx", 94.6861, 91.9145, ""),
        ("03_auth_iwdp_rcmf.zmx", 94.6861, 91.9145, "left out, unknown or without effect on rays: AUTH, IWDP, RCMF"),
        ("06_object_in_water.zmx", 188.80, 187.18, ""),
        ("06_object_in_water.seq", 188.80, 187.18, ""),
        ("07_overlap_drawn_rims.zmx", 35.81, None, "surface 12 of the file (27.32 to 27.17 mm)"),
        ("09_glas_substitute.zmx", 94.6861, 91.9145, ""),
        ("10_unused_private_glass.seq", 37.50, 31.09, ""),
        ("11_xasphere_parm.zmx", 94.6861, 91.9145, "surface 1 of the file: an XASPHERE with its terms in PARM"),
        ("12_wavelength_1550.zmx", 1.4833, None, "D-ZK3M is assumed to be CDGM:D-ZK3"),
        ("14_oslo_premium.len", 4.5003, None, "BAF51 is taken as Schott:N-BAF51"),
    ],
)
def test_what_must_read(name: str, efl_mm: float, back_mm: float | None, said: str) -> None:
    lens, told = heard(CASES / name)
    data = first_order(lens)
    assert data.efl_mm == pytest.approx(efl_mm, rel=1e-4)
    assert back_mm is None or data.back_focus_mm == pytest.approx(back_mm, rel=1e-4)
    assert said in told if said else not told


@needs_cases
@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("15_decimal_comma.zmx", "decimal commas"),
        ("16_mold_glass.zmx", "L-TIM28, whose moulded variant.*--glass"),
        ("17_other_text.txt", r"format: got \(not known\)"),
    ],
)
def test_what_is_refused_says_why(name: str, message: str) -> None:
    with pytest.raises(InputError, match=message):
        read_any(CASES / name)


@needs_cases
def test_the_medium_in_front_is_in_the_oslo_file_too() -> None:
    lens, _ = heard(CASES / "06_object_in_water.len")
    bk7, water, front, back, gap = catalogue.find("N-BK7").n_d, 1.33306, 1 / 62.5, -1 / 133.3, 4.0
    first, second = (bk7 - water) * front, (1 - bk7) * back
    power = first + second - gap / bk7 * first * second  # Gullstrand's equation, the image in air
    assert first_order(lens).efl_mm == pytest.approx(1 / power, rel=1e-12)
    assert lens.object_medium.n_d == water


def test_wavelengths_of_zemax_files_are_kept(tmp_path: Path) -> None:
    """Those in use, the primary one first; data stand at that one where the d line is no light of the lens."""
    infrared = "WAVM 1 1.3 1\nWAVM 2 1.55 1\nWAVM 3 0.55 1\nPWAV 2\n"
    text = swapped("WAVM 1 5.875618E-1 1\nPWAV 1\n", infrared, swapped("FTYP 0 0 3 1", "FTYP 0 0 3 2"))
    lens = read(text, tmp_path)
    assert lens.wavelengths_nm == (1550.0, 1300.0)
    n = catalogue.find("N-BK7").index(1550.0)
    c, t = 0.02, 5.0
    assert first_order(lens).efl_mm == pytest.approx(1 / ((n - 1) * (2 * c - t * (n - 1) / n * c * c)), rel=1e-12)


def test_wavelengths_of_oslo_and_indices_at_them(tmp_path: Path) -> None:
    bk7 = catalogue.find("N-BK7")
    indices = " ".join(repr(bk7.index(nm)) for nm in (587.56, 486.13, 656.27))
    text = swapped("GLA  BK7", f"GLA  {indices}", OSLO).replace("END  3", "WV 0.58756 0.48613 0.65627\nEND  3")
    path = tmp_path / "lens.len"
    path.write_text(text)
    lens, told = heard(path)
    assert lens.wavelengths_nm == (587.56, 486.13, 656.27) and "the glass is reduced to n_d and V_d" in told
    assert lens.surfaces[0].n_d == pytest.approx(bk7.n_d, abs=1e-6)
    assert lens.surfaces[0].V_d == pytest.approx(bk7.V_d, abs=0.01)


WITHOUT_STOP = """\
MODE SEQ
UNIT MM
SURF 1
  CURV 0.02
  DISZ 5
  DIAM 8
  GLAS ___BLANK 1 0 1.5
SURF 2
  CURV -0.02
  DISZ 45
  DIAM 8
"""


def test_a_list_of_surfaces_alone_gets_object_and_film(tmp_path: Path) -> None:
    """Close-up lenses and telescopes of collections: no SURF 0, no image, an index without dispersion."""
    path = tmp_path / "lens.zmx"
    path.write_text(WITHOUT_STOP)
    lens, told = heard(path)
    n, c, t = 1.5, 0.02, 5.0
    assert first_order(lens).efl_mm == pytest.approx(1 / ((n - 1) * (2 * c - t * (n - 1) / n * c * c)), rel=1e-12)
    assert lens.surfaces[-1].thickness_mm == 45 and lens.stop_index == 0
    for words in ("there is no SURF 0", "the film is assumed", "no stop is marked: surface 1,"):
        assert words in told
    path.write_text(WITHOUT_STOP + "SURF 2AS\n  STOP\n  DISZ 40\n  DIAM 6\n")
    lens, told = heard(path)
    assert (lens.stop_index, lens.surfaces[-1].thickness_mm) == (2, 40) and "no stop" not in told


def test_glass_at_the_object_is_a_surface_of_the_lens(tmp_path: Path) -> None:
    """A file that begins with the lens itself at SURF 0, as eyepieces of one collection do."""
    path = tmp_path / "lens.zmx"
    path.write_text(WITHOUT_STOP.replace("SURF 1", "SURF 0").replace("SURF 2", "SURF 1"))
    lens, told = heard(path)
    assert len(lens.surfaces) == 2 and "surface 0 is one of glass: the object is assumed in front" in told
    alone = first_order(lens)
    path.write_text(path.read_text().replace("DISZ 45", "DISZ 0"))
    lens, told = heard(path)  # a curved surface behind glass is no image: it refracts, and the film is to be assumed
    assert first_order(lens).efl_mm == alone.efl_mm
    assert lens.surfaces[-1].thickness_mm == pytest.approx(alone.back_focus_mm, rel=1e-12)
    assert "the last surface is no image: the film is assumed at the paraxial focus" in told


def test_messages_number_surfaces_as_the_file_does(tmp_path: Path) -> None:
    """Behind a plane that was left out the rows are one less than the file's surfaces, and still called by these."""
    block = DUMMY.format(gap=1.0).replace("SURF 3", "SURF 1")
    body = BODY.replace("SURF 2", "SURF 3").replace("SURF 1", "SURF 2")
    text = HEAD + block + body.replace("DIAM 9 1", "DIAM 60 1") + TAIL.replace("SURF 3", "SURF 4")
    with pytest.raises(InputError, match=r"surface 3 of the file, diameter_mm: got 120.0"):
        read(text, tmp_path)


@pytest.mark.parametrize(("overlap_mm", "reads"), [(0.03, True), (1.0, False)])
def test_rims_that_overlap_slightly_are_narrowed(overlap_mm: float, reads: bool, tmp_path: Path) -> None:
    """A biconvex lens as thick as its rims touch, less a little: rims end where both spheres meet, or it is refused."""
    sag = 50 - (50**2 - 9**2) ** 0.5
    text = swapped("DIAM 8 1", "DIAM 9 1", swapped("ENPD 10", "FLOA"))
    text = swapped("DISZ 5.0", f"DISZ {2 * sag - overlap_mm!r}", text)
    if not reads:
        with pytest.raises(InputError, match="surface 1 of the file, thickness_mm: got .an overlap of"):
            read(text, tmp_path)
        return
    with pytest.warns(UserWarning, match="rims narrowed.*surface 2 of the file .18 to"):
        lens = read(text, tmp_path)
    meet = 50 - sag + overlap_mm / 2
    assert lens.surfaces[1].diameter_mm == pytest.approx(2 * (50**2 - meet**2) ** 0.5, abs=2e-3)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("GLAS N-BK7 0 0 1.5 4.0E+1", "GLAS ___BLANK 1 0 -1 0", r"surface 1 of the file, index: got -1.0.*a mirror"),
        ("CURV 2.0E-2", "CURV 0,02", r"CURV: got '0,02', expected a finite number, with a point: decimal commas"),
        ("  DIAM 9 1", "  SCBD 0 0 5 0\n  DIAM 9 1", r"SCBD: got '0 0 5 0', expected no tilt"),
    ],
)
def test_what_changes_rays_is_refused_with_the_reason(old: str, new: str, message: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=message):
        read(swapped(old, new), tmp_path)


@needs_cases
@pytest.mark.parametrize(
    ("name", "efl_mm", "said"),
    [
        ("f3_no_rdm_fno.seq", 98.102, "taken as radii: a sphere of that curvature would be smaller than the glass"),
        ("f4_primary_550.seq", 10.0340, "taken as curvatures"),
        ("f5_thickness_minus_25nm.zmx", 50.0206, "surface 3 of the file: a thickness of -2.54e-05 is taken as 0"),
        ("f6_no_cir.seq", 100.0308, "no rim is given for surface 2 of the file, nor a field"),
    ],
)
def test_sound_files_of_other_programs_read(name: str, efl_mm: float, said: str) -> None:
    """Focal lengths of f3 by Optiland, f6 by ray-optics; f5 is the Cooke triplet of 50 mm that came with Zemax."""
    lens, told = heard(OTHERS / name)
    assert first_order(lens).efl_mm == pytest.approx(efl_mm, rel=1e-5) and said in told


@needs_cases
@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("f1_sellmeier_beyond_range.zmx", "wavelength_nm: got 10600.0, expected 300 to 2500 nm"),
        ("f2_stale_glass_figures.zmx", "BASF1 with n_d 1.60738.*--glass.*line 148 gives SF6HT 1.713 and 53.8316"),
    ],
)
def test_glasses_that_are_not_known_are_not_guessed(name: str, message: str) -> None:
    with pytest.raises(InputError, match=message):
        read_any(OTHERS / name)


def test_first_order_data_say_their_wavelength_and_those_of_the_primary_one(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """f4 in small: focal length 10, back focus as the file's last thickness, at its primary wavelength of 550 nm."""
    path = tmp_path / "landscape.seq"
    path.write_text(
        "dim m\nso 0. 1.0e+10\ns 0. 1.664\nsto\ns -0.2 0.22 NBK7_SCHOTT\ns -0.387040626 10.150245\nsi 0 0\n"
        "epd 1.0\nwl 650 550 450\nref 2\nyim 0 3\n"
    )
    for command in (["convert", str(path), "-o", str(tmp_path / "lens.toml")], ["lens", str(path)]):
        assert main([*command, "--json"]) == 0
        data = json.loads(capsys.readouterr().out)
        assert data["wavelength_nm"] == pytest.approx(587.5618) and data["efl_mm"] == pytest.approx(10.0340, abs=5e-5)
        assert data["primary"] == pytest.approx({"wavelength_nm": 550.0, "efl_mm": 10.0, "back_focus_mm": 10.150245})
    assert main(["lens", str(tmp_path / "lens.toml")]) == 0
    assert "at the file's primary 550 nm: focal length 10 mm, back focus 10.1502 mm" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("glasses", "reads"),
    [
        ("XY-9 0 0 1.62 36.4", True),  # nothing speaks against it
        ("XY-9 0 0 1.62 36.4|N-BK7 0 0 1.5168 64.17", True),
        ("XY-9 0 0 1.62 36.4|N-BK7 0 0 1.5 40", True),  # what the program writes in the place of both
        ("XY-9 3 0 1.62 36.4|N-BK7 3 0 1.805 25.4", False),
        ("XY-9 3 0 1.62 36.4|XY-9 3 0 1.5168 64.2", False),
        ("N-BK7 3 0 1.805 25.4|XY-9 1 0 1.62 36.4", True),  # a model glass
        ("N-BK7 3 0 1.805 25.4", True),  # by its name
    ],
)
def test_figures_behind_unknown_names_are_believed_where_known_glasses_agree(
    glasses: str, reads: bool, tmp_path: Path
) -> None:
    first, *more = glasses.split("|")
    text = swapped("GLAS N-BK7 0 0 1.5 4.0E+1", f"GLAS {first}", HEAD + BODY)
    names = [f"SURF {k}\n  CURV 0.01\n  DISZ 2\n  GLAS {g}\n  DIAM 9 1\n" for k, g in enumerate(more, start=3)]
    end = f"SURF {len(names) + 3}\n  DISZ 45\n  DIAM 9 1\nSURF {len(names) + 4}\n  DISZ 0\n"
    path = tmp_path / "lens.zmx"
    path.write_text(text + "".join(names) + end)
    if not reads:
        with pytest.raises(InputError, match=r"GLAS: got 'XY-9 with n_d 1.62.*--glass: the figures behind names are"):
            read_any(path)
        return
    lens, _ = heard(path)
    assert {"XY-9": 1.62, "N-BK7": 1.5168}[first.split()[0]] == pytest.approx(lens.surfaces[0].n_d, abs=1e-4)


def test_the_numerical_aperture_of_a_near_object_sizes_the_stop(tmp_path: Path) -> None:
    """The stop is the first surface, 500 mm from the object: its radius is 500 tan(asin(0.01))."""
    lens, _ = heard_text(swapped("DISZ INFINITY", "DISZ 500", swapped("ENPD 10", "OBNA 0.01 0")), tmp_path)
    assert lens.stop_radius_mm == pytest.approx(500 * 0.01 / (1 - 0.01**2) ** 0.5, rel=1e-9)
    (state,) = lens.configurations
    assert state.object_distance_mm == 500 and (state.stop_diameter_mm or 2 * lens.stop_radius_mm) == pytest.approx(
        2 * lens.stop_radius_mm, rel=1e-9
    )


def test_the_working_f_number_is_that_at_the_image_of_a_near_object(tmp_path: Path) -> None:
    """The paraxial ray from the axial point to the edge of the stop, the first surface, leaves at a slope of 1/8."""
    zemax = swapped("DISZ INFINITY", "DISZ 500", swapped("ENPD 10", "FNUM 4 1"))
    codev = "RDM;LEN\nFNO 4\nYAN 0 5\nSO 0 500\nS 50 5 NBK7_SCHOTT\nSTO\nS -50 45\nCIR 9\nSI 0 0\n"
    (tmp_path / "lens.seq").write_text(codev)
    lens, told = heard(tmp_path / "lens.seq")
    assert "FNO 4 is taken as the f-number at the image of the near object" in told
    for made in (lens, heard_text(zemax, tmp_path)[0]):
        n, y = made.surfaces[0].n_d, made.stop_radius_mm
        slope = (y / 500 - y * (n - 1) / 50) / n
        y += 5 * slope
        assert n * slope - y * (n - 1) / 50 == pytest.approx(-1 / 8, rel=1e-12)
        assert made.f_number == pytest.approx(first_order(made).f_number)
        assert made.configurations[0].stop_diameter_mm is None  # that of the table


def test_the_film_of_a_near_object_is_judged_by_its_image(tmp_path: Path) -> None:
    """By Newton's formula: of an object x in front of the front focus, the image lies f^2 / x behind the rear one."""
    data = first_order(heard_text(HEAD + BODY + TAIL, tmp_path)[0])
    behind = data.efl_mm**2 / (120 - (data.efl_mm - data.front_principal_z_mm))
    for off, said in ((0.0, ""), (5.0, "as filed: the table's last thickness puts the film at")):
        text = swapped("DISZ 45.0", f"DISZ {data.back_focus_mm + behind + off}", HEAD + BODY + TAIL)
        lens, _ = heard_text(swapped("DISZ INFINITY", "DISZ 120", text), tmp_path)
        told = "\n".join(doubts(check_lens(lens)))
        assert told.startswith(said) and bool(told) == bool(said)


def test_a_film_in_front_of_the_last_surface_makes_no_picture(tmp_path: Path) -> None:
    """A rod of glass whose front focuses inside it: its image is as far in front of its end as the back focus says."""
    text = HEAD + BODY + TAIL
    for old, new in (("CURV 2.0E-2", "CURV 5.0E-2"), ("CURV -2.0E-2", "CURV -5.0E-2"), ("DISZ 5.0", "DISZ 100")):
        text = swapped(old, new, text)
    lens, _ = heard_text(text, tmp_path)
    curvature, n = 0.05, lens.surfaces[0].n_d
    power, left = (n - 1) * curvature, 1 - (n - 1) * curvature * 100 / n  # of an end; height at the second end
    behind = left / (power * (1 + left))
    assert behind < 0 < first_order(lens).efl_mm
    assert f"the image lies {-behind:.4g} mm in front of the last surface" in "\n".join(doubts(check_lens(lens)))
    with pytest.raises(
        InputError, match=r"film: got \(.* in front of the last surface\), expected an image behind the lens"
    ):
        make_camera(tmp_path / "lens.zmx", Shot((24.0, 16.0)))
    with pytest.raises(InputError, match=r"film: got \(.* in front of the last surface"):
        PsfTask(set_lens(lens), math.inf, ((0.0, 0.0),), ((550.0,),), 0.006, None)


def test_a_cylinder_is_afocal_in_one_plane(tmp_path: Path) -> None:
    text = swapped("TYPE STANDARD\n  CURV 2.0E-2", "TYPE TOROIDAL\n  CURV 2.0E-2", HEAD + BODY + TAIL)
    lens, _ = heard_text(swapped("CURV -2.0E-2", "CURV 0", text), tmp_path)
    assert first_order(lens).efl_mm == pytest.approx(50 / (lens.surfaces[0].n_d - 1))
    with pytest.raises(InputError, match=r"\(an afocal system in the x-z plane\)"):
        first_order(lens, meridian="x")


def heard_text(text: str, tmp_path: Path) -> tuple[Lens, str]:
    path = tmp_path / "lens.zmx"
    path.write_text(text)
    return heard(path)


@pytest.mark.parametrize(
    ("name", "n_d"),
    [("SSK4", 1.6177), ("LEXAN", 1.5855), ("Plexiglas", 1.4918), ("STYRON", 1.591), ("F_SILICA", 1.4585)],
)
def test_old_glasses_and_trade_names_are_known(name: str, n_d: float, tmp_path: Path) -> None:
    lens, _ = heard_text(swapped("GLAS N-BK7", f"GLAS {name}"), tmp_path)
    assert lens.surfaces[0].n_d == pytest.approx(n_d, abs=1e-3)


def test_an_archive_says_what_to_give_instead(tmp_path: Path) -> None:
    (tmp_path / "lens.zar").write_bytes(bytes(range(256)))
    with pytest.raises(InputError, match=r"of an archive of Zemax, give the .zmx that it holds"):
        read_any(tmp_path / "lens.zar")


def test_a_matrix_of_polarisation_moves_no_ray(tmp_path: Path) -> None:
    text = swapped("TYPE STANDARD\n  CURV -2", "TYPE JONESMAT\n  PARM 1 1\n  PARM 8 0.5\n  CURV -2")
    lens, told = heard_text(text, tmp_path)
    assert lens.surfaces == heard_text(swapped("MODE SEQ", "MODE SEQ"), tmp_path)[0].surfaces
    assert "JONESMAT is left out of transmittance" in told
