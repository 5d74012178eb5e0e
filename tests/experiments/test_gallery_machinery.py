"""The gallery's files, windows, widened lenses and cache, and one small effect from its file to the page."""

import json
from pathlib import Path

import pytest
from gallery_shots import ROOT, shipped, shot

from experiments.__main__ import main
from experiments.pictures.gallery.cameras import exact_camera, surrogate_camera
from experiments.pictures.gallery.run import MOST_BYTES, fingerprint_of
from experiments.pictures.gallery.settings import read_effect
from neurolens.base.errors import InputError

EFFECT = """\
title = "Small"
text = "A wall of squares."
source = "Nobody."
measure = "edge_blur"

[shot]
lens = "{root}/lenses/laikin_double_gauss_50.toml"
model = "{root}/models/laikin_double_gauss_50.ols-60.onnx"
scene = "{root}/experiments/gallery/scenes/chessboard.toml"
f_number = 4
width = 24
samples = 2
options = {{ x_mm = 10.0 }}

[[panel]]
label = "one"

[[panel]]
label = "two"
film_offset_mm = 0.5
window_mm = [8.0, 5.0, 9.0, 6.0]
"""


def written(folder: Path, old: str = "", new: str = "") -> Path:
    """The effect above as a file, with one thing in it exchanged."""
    path = folder / "small.toml"
    text = EFFECT.format(root=ROOT.as_posix())
    assert old in text
    path.write_text(text.replace(old, new) if old else text, encoding="utf-8")
    return path


def test_exact_and_surrogate_put_the_film_in_the_same_place_however_it_is_focused() -> None:
    taken = shot(
        "laikin_double_gauss_50", focus_m=2.0, f_number=4.0, focus_mode="best", film_offset_mm=0.3, model=".ols-60"
    )
    surrogate = shipped(taken)
    for make in (exact_camera, surrogate_camera):
        assert make(taken, surrogate).settings["film_z_mm"] == pytest.approx(taken.lens.film_z_mm, abs=1e-4)
    beyond = shot("laikin_double_gauss_50", focus_m=2.0, film_offset_mm=-3.0, model=".ols-60")
    with pytest.raises(InputError, match="film_offset_mm"):  # before the film of infinity
        surrogate_camera(beyond, shipped(beyond))


def test_an_effect_becomes_a_figure_numbers_and_a_page_and_is_not_done_twice(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path, out = written(tmp_path, '[[panel]]\nlabel = "one"\n', ""), tmp_path / "out"
    command = ["gallery", "--effects-in", str(tmp_path), "--output", str(out), "--threads", "1"]
    assert main(command) == 0 and "| two | middle (um) |" in capsys.readouterr().out
    first = json.loads((out / "small.json").read_text(encoding="utf-8"))
    assert (out / "small.jpg").stat().st_size <= MOST_BYTES
    for panel in first["panels"]:
        found = panel["measured"]["edge_um"]
        assert found["surrogate"] == pytest.approx(found["exact"], abs=1)
        assert panel["difference_mean"] < 0.02
        assert panel["surrogate"]["rms_um"] < 1
    # Out of focus the thin lens has a middle as unsharp as its edge.
    moved = first["panels"][0]["measured"]
    assert moved["edge_um"]["thin"] == pytest.approx(moved["middle_um"]["thin"], rel=0.01)
    assert (out / "README.md").is_file()

    made = (out / "small.jpg").stat().st_mtime_ns
    assert main(command) == 0
    assert "done by an earlier run" in capsys.readouterr().err
    assert (out / "small.jpg").stat().st_mtime_ns == made
    assert fingerprint_of(read_effect(path), 4) != first["fingerprint"] == fingerprint_of(read_effect(path), None)
    path.write_text(path.read_text(encoding="utf-8").replace('"two"', '"three"'), encoding="utf-8")
    assert fingerprint_of(read_effect(path), None) != first["fingerprint"]
