"""`neurolens analyse`: tables with units, JSON that parses, a picture of each with axes and legend, bad input.

And lenses or wishes at their limits: no light, no glass, doubtful tables, far wavelengths.
"""

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import shipped
from analysis_lenses import thin
from command_line import failure, run_json
from PIL import Image
from shipped import LENSES

from neurolens.cli import analyse, main
from neurolens.cli.analyse import WHATS
from neurolens.optics.analysis import plots
from neurolens.optics.analysis.plots import plot_psf, plot_spots
from neurolens.optics.analysis.psf import psf
from neurolens.optics.analysis.spots import mtf, spots
from neurolens.optics.readers.lensfile import write_lens

GAUSS = LENSES / "laikin_double_gauss_50.toml"
D = 587.5618
TESSAR = LENSES / "brendel_tessar_100.toml"
ANAMORPHIC = LENSES / "schneider_anamorphic_31.toml"


def test_state_fields_and_wavelengths(capsys: pytest.CaptureFixture[str]) -> None:
    options = ("--focus", 2, "--field-points", 0, 10, "--wavelengths", 587.5618, "--focusing", "best", "--full")
    data = run_json(capsys, "analyse", TESSAR, "spots", *options)
    assert data["focus_m"] == 2 and data["spots"]["wavelength_nm"] == [587.5618]
    assert data["spots"]["field_deg"] == [0, 10] and len(data["spots"]["tangential_um"]) == 2
    # Best focus was asked for, at the d line: next to nothing is left to gain.
    assert abs(data["spots"]["best_shift_mm"][0]) < 0.02


def test_every_analysis_as_text_picture_and_json(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    made, computed = list[Any](), dict[str, Any]()
    for key in ("figure.dpi", "savefig.dpi"):  # small pictures
        monkeypatch.setitem(plots._STYLE, key, 50)
    new_figure, usual = plots.new_figure, analyse.analysis_of
    monkeypatch.setattr(plots, "new_figure", lambda *s: made.append(new_figure(*s)) or made[-1])

    def once(what: str) -> analyse.Analysis:
        def compute(scene: Any, **options: Any) -> Any:
            if what not in computed:
                computed[what] = usual(what).compute(scene, **options)
            return computed[what]

        return usual(what)._replace(compute=compute)

    monkeypatch.setattr(analyse, "analysis_of", once)
    two = ("--f-number", "5.6", "--field-points", "0", "13")  # a row of a picture each
    assert main(["analyse", str(TESSAR), *two, "-o", str(tmp_path)]) == 0
    assert "11 pictures drawn" in capsys.readouterr().out
    assert {path.name for path in tmp_path.iterdir()} == {f"brendel_tessar_100_{what}.png" for what in WHATS}
    for path in tmp_path.iterdir():
        with Image.open(path) as opened:
            assert np.asarray(opened.convert("L")).std() > 5
    for figure, what in zip(made, WHATS, strict=True):
        words = " ".join(t.get_text() for t in figure.findobj(lambda a: hasattr(a, "get_text")))
        assert "Tessar" in words and any(unit in words for unit in ("(mm)", "(µm)", "(%)", "(cycles/mm)"))
        assert what == "psf" or figure.legends or any(a.get_legend() for a in figure.axes)
    data = run_json(capsys, "analyse", TESSAR, *two)
    assert set(WHATS) <= set(data) and data["notes"] == []
    assert len(data["spots"]["rms_um"]) == 2 and "tangential_um" not in data["spots"]
    assert data["distortion"]["scale_mm"] == pytest.approx(100, rel=0.01)
    assert data["mtf"]["working_f_number"] == pytest.approx(5.6, rel=0.02)
    assert len(data["seidel"]["surfaces"]) == 8 and data["focus_m"] == "infinity"


def test_an_anamorphic_lens_in_both_planes(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    scale = {}
    for axis, more in (("x", ()), ("y", ("layout", "-o", tmp_path))):
        data = run_json(capsys, "analyse", ANAMORPHIC, "distortion", "--axis", axis, *more)
        scale[axis] = data["distortion"]["scale_mm"]
    assert 1.2 < max(scale.values()) / min(scale.values()) < 2.5
    assert len(list(tmp_path.iterdir())) == 2
    assert main(["analyse", str(ANAMORPHIC), "seidel"]) == 2
    assert "symmetric" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("args", "words"),
    [
        (["spot"], "spots, fans"),
        (["spots", "--full"], "only with --json"),
        (["mtf", "--field-points", "-3"], "degrees from 0"),
        (["mtf", "-o", str(TESSAR)], "a folder"),
        (["mtf", "--zoom", "wide"], "zoom"),
        (["mtf-height", "--frequencies", "-5"], "cycles per mm from 0"),
        (["seidel", "--zoon", "3"], "neurolens analyse --help"),
        (["spots", "--wavelengths", "20001"], "from 100 to 20000"),
        (["spots", "--wavelengths", "99"], "from 100 to 20000"),
    ],
)
def test_bad_input_is_one_line(args: list[str], words: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert words in failure(capsys, "analyse", TESSAR, *args)


@pytest.fixture
def pinhole(tmp_path: Path) -> Path:
    path = tmp_path / "pinhole.toml"
    write_lens(replace(shipped.pinhole(50.0, 0.2, image_radius_mm=40.0), name="Pinhole", source="test"), path)
    return path


def test_a_stop_wider_than_the_rims(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The outermost ray that passes counts: with the stop three times as wide, the lens is as fast as its rims."""
    lens = LENSES / "thorlabs_lb1471_biconvex_50.toml"
    data = run_json(capsys, "analyse", lens, "spots", "psf", "--f-number", 1.0, "--field-points", 0, "-o", tmp_path)
    assert len(list(tmp_path.iterdir())) == 2
    assert data["spots"]["working_f_number"] == pytest.approx(49.1 / 25.4, rel=0.06)
    assert data["spots"]["airy_um"] == pytest.approx(1.22 * D / 1000 * data["spots"]["working_f_number"])


def test_no_light_is_one_error_or_a_gap(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    given = thin(0.0)
    rows = list(given.lens.surfaces)
    rows.insert(0, replace(rows[-1], stop=False, thickness_mm=10.0, diameter_mm=1e-4))
    dark = replace(given, lens=replace(given.lens, surfaces=tuple(rows), film_z_mm=given.film_z_mm + 10.0))
    # Through this hole passes the chief ray alone, and off the axis nothing.
    fields = [5.0]
    spot, image = spots(dark, fields), psf(dark, fields)
    assert math.isnan(spot.geometric_um[0]) and np.isnan(mtf(dark, fields).tangential).all()
    assert np.isnan(image.half_width_um).all() and image.pupil_points[0] == 0
    plot_spots(spot, tmp_path / "spots.png", "", "")
    plot_psf(image, tmp_path / "psf.png", "", "")
    assert "field 80: got (no light" in failure(capsys, "analyse", GAUSS, "spots", "--field-points", 0, 80)
    assert "expected at most 2" in failure(capsys, "analyse", GAUSS, "mtf", "--field-points", 80)


def test_a_pinhole_has_no_focus(pinhole: Path, capsys: pytest.CaptureFixture[str]) -> None:
    data = run_json(capsys, "analyse", pinhole)
    assert data["spots"]["working_f_number"] == pytest.approx(50 / 0.4)
    assert data["spots"]["geometric_um"][0] == pytest.approx(200, rel=1e-5)
    assert len(data["spots"]["rms_um"]) == len(data["mtf"]["field_deg"]) == 5  # where no fields are asked for
    assert data["spots"]["best_shift_mm"][0] is None
    assert not {"colour", "curvature", "psf", "seidel"} & set(data) and len(data["notes"]) == 4
    for what in ("colour", "curvature", "psf"):
        assert "a pinhole" in failure(capsys, "analyse", pinhole, what)


def test_far_wavelengths(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    acrylic = tmp_path / "acrylic.toml"
    text = (LENSES / "thorlabs_lb1471_biconvex_50.toml").read_text(encoding="utf-8")
    glass = 'n_d = 1.5168, V_d = 64.17, coating = "bare", material = "N-BK7"'
    assert glass in text
    acrylic.write_text(text.replace(glass, 'coating = "bare", glass = "PMMA"'), "utf-8")
    assert "got 2200.0, expected 380 to 1620 nm" in failure(
        capsys, "analyse", acrylic, "spots", "--wavelengths", 2200, "--quiet"
    )
    told = run_json(capsys, "analyse", acrylic, "spots", "--wavelengths", 390)["warnings"]
    assert any("PMMA" in w and "420-1620 nm: extrapolated at 390 nm" in w for w in told)
    told = run_json(capsys, "analyse", GAUSS, "spots", "--wavelengths", 2200)["warnings"]
    assert any("alone is stated for 365-1014 nm: extrapolated at 2200 nm" in w for w in told)
