"""`neurolens flare` on the command line."""

import json
from pathlib import Path

import numpy as np
import OpenEXR
import pytest

from neurolens.cli import main
from neurolens.render.pictures import read_exr, read_layers


def test_table_and_picture(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "flare.exr"
    assert main(["flare", "laikin_double_gauss_50", "--light", "15,8"]) == 0
    said = capsys.readouterr().out
    assert "66 pairs" in said and "g12-11" in said
    drawn = tmp_path / "path.svg"
    assert main(["flare", "laikin_double_gauss_50", "--light", "15,8", "--path", "g08-06", str(drawn)]) == 0
    assert drawn.read_text().startswith("<?xml")
    capsys.readouterr()
    small = ["--width", "48", "--samples", "4096", "--wavelengths", "3", "--layers", "2", "--json"]
    assert main(["flare", "laikin_double_gauss_50", "--light", "15,8,0.5/0.4/0.3", "-o", str(out), *small]) == 0
    told = json.loads(capsys.readouterr().out)
    rgb, metadata = read_exr(out)
    layers = read_layers(out)
    header = OpenEXR.File(str(out), header_only=True).header()
    assert header["lensModel"] == "Double Gauss 50 mm f/1.8" and round(header["effectiveFocalLength"], 3) == 49.637
    assert rgb.shape == (32, 48, 3) and rgb.sum() > 0
    assert metadata["flare"]["ghosts"] == told["ghosts"]
    top = [g["name"] for g in told["ghosts"][0][:2]]
    names = [f"{name}.{c}" for name in (*top, "rest") for c in "RGB"]
    assert set(layers) == set(names)
    np.testing.assert_allclose(sum(layers[f"{name}.R"] for name in (*top, "rest")), rgb[..., 0], rtol=1e-5, atol=1e-9)


def test_photons_paint_the_ghosts(tmp_path: Path) -> None:
    """The light of photons with two reflections at most is that of the ghosts, block by block, within its noise."""
    common = ["laikin_double_gauss_50", "--light", "12,5", "--width", "24", "--wavelengths", "2", "--quiet"]
    blocks = []
    for words in (["--samples", "65536"], ["--photons", "400000", "--reflections", "2", "--kernel", "0"]):
        out = tmp_path / "one.exr"
        assert main(["flare", *common, *words, "-o", str(out)]) == 0
        blocks.append(read_exr(out)[0][..., 1].reshape(2, 8, 3, 8).sum((1, 3)))
    np.testing.assert_allclose(blocks[1], blocks[0], rtol=0.12)


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--light", "180,0"], "within 90 degrees"),
        (["--light", "1"], "AZ,EL"),
        (["--light", "1,2,3/4"], "AZ,EL"),
        (["--light", "1,2,1,0"], "positive distance"),
        (["--light", "1,2", "--photons", "9", "--layers", "2", "-o", "x.exr"], "--layers"),
        (["--light", "0,0", "-o", "x.png"], ".exr"),
        (["--light", "0,0", "--coating", "velvet"], "velvet"),
        (["--light", "0,0", "--path", "g99-01", "x.png"], "g99-01"),
        (["--light", "0,0", "--path", "g08-06", "x.gif"], "--path"),
    ],
)
def test_bad_words(words: list[str], said: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["flare", "laikin_double_gauss_50", *words]) == 2
    assert said in capsys.readouterr().err
