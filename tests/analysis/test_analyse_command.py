"""`neurolens analyse`: tables with units, JSON that parses, a picture of each with axes and legend, bad input."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from shipped import LENSES

from neurolens.analysis import layout, plot_style
from neurolens.cli import main
from neurolens.commands.analyse import WHATS

TESSAR = LENSES / "brendel_tessar_100.toml"
ANAMORPHIC = LENSES / "schneider_anamorphic_31.toml"


def run_json(capsys: pytest.CaptureFixture[str], *args: object) -> dict[str, Any]:
    assert main(["analyse", *map(str, args), "--json"]) == 0
    data: dict[str, Any] = json.loads(capsys.readouterr().out)
    return data


def test_everything_at_once(capsys: pytest.CaptureFixture[str]) -> None:
    data = run_json(capsys, TESSAR, "--f-number", 5.6)
    assert set(WHATS) <= set(data) and data["notes"] == []
    assert len(data["spots"]["rms_um"]) == 5 and "tangential_um" not in data["spots"]
    assert data["distortion"]["scale_mm"] == pytest.approx(100, rel=0.01)
    assert data["mtf"]["working_f_number"] == pytest.approx(5.6, rel=0.02)
    assert len(data["seidel"]["surfaces"]) == 8 and data["focus_m"] == "infinity"


def test_state_fields_and_wavelengths(capsys: pytest.CaptureFixture[str]) -> None:
    options = ("--focus", 2, "--fields", 0, 10, "--wavelengths", 587.5618, "--focusing", "best", "--full")
    data = run_json(capsys, TESSAR, "spots", *options)
    assert data["focus_m"] == 2 and data["spots"]["wavelength_nm"] == [587.5618]
    assert data["spots"]["field_deg"] == [0, 10] and len(data["spots"]["tangential_um"]) == 2
    # Best focus was asked for, at the d line: next to nothing is left to gain.
    assert abs(data["spots"]["best_shift_mm"][0]) < 0.02


@pytest.mark.parametrize("what", WHATS)
def test_text_and_picture_of_each(
    what: str, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    made: list[Any] = []
    new_figure = plot_style.new_figure
    for module in (plot_style, layout):
        monkeypatch.setattr(module, "new_figure", lambda *s: made.append(new_figure(*s)) or made[-1])
    assert main(["analyse", str(TESSAR), what, "-o", str(tmp_path / "pictures")]) == 0
    text = capsys.readouterr().out
    assert "1 pictures drawn" in text and len(text.splitlines()) > 4
    (path,) = (tmp_path / "pictures").iterdir()
    assert path.name == f"brendel_tessar_100_{what}.png"
    with Image.open(path) as opened:
        assert np.asarray(opened.convert("L")).std() > 5
    words = " ".join(t.get_text() for t in made[0].findobj(lambda a: hasattr(a, "get_text")))
    assert "Tessar" in words and any(unit in words for unit in ("(mm)", "(µm)", "(%)", "(cycles/mm)"))
    assert what in ("psf",) or made[0].legends or any(a.get_legend() for a in made[0].axes)


def test_an_anamorphic_lens_in_both_planes(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    scale = {}
    for axis in "xy":
        data = run_json(capsys, ANAMORPHIC, "distortion", "layout", "--axis", axis, "-o", tmp_path)
        scale[axis] = data["distortion"]["scale_mm"]
    assert 1.2 < max(scale.values()) / min(scale.values()) < 2.5
    assert len(list(tmp_path.iterdir())) == 4
    assert main(["analyse", str(ANAMORPHIC), "seidel"]) == 2
    assert "symmetric" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("args", "words"),
    [
        (["spot"], "spots, fans"),
        (["spots", "--full"], "only with --json"),
        (["mtf", "--fields", "-3"], "degrees from 0"),
        (["mtf", "--wavelengths", "0"], "wavelengths in nm from 300"),
        (["mtf", "-o", str(TESSAR)], "a folder"),
        (["mtf", "--zoom", "wide"], "zoom"),
    ],
)
def test_bad_input_is_one_line(args: list[str], words: str, capsys: pytest.CaptureFixture[str]) -> None:
    try:
        code = main(["analyse", str(TESSAR), *args])
    except SystemExit as exit_:
        code = int(exit_.code or 0)
    error = capsys.readouterr().err
    assert code == 2 and words in error and len(error.strip().splitlines()) == 1
