"""Files of strangers, ../shared/data/cases/hostile: one clear line each, and nothing is written outside its place."""

import json
import os
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import onnx
import pytest
from command_line import failure
from lens_models import edited

from experiments.__main__ import main as experiment
from neurolens.cameras.onnxlens import load_model
from neurolens.cli import main
from neurolens.models.card import CARD_KEY
from neurolens.programs.blender import Form

HOSTILE = Path(__file__).parents[2] / "shared" / "data" / "cases" / "hostile"
ROOT = Path(__file__).parents[1]
GAUSS = ROOT / "models" / "laikin_double_gauss_50.ols-36.onnx"
FLARE = ("flare", "brendel_tessar_100", "--width", "64", "--wavelengths", "2", "--quiet")
TILES = ("148", "234", "473", "795", "869")
ZIPS = ("damaged", "deep", "enc", "kind", "var5", "varstr")

pytestmark = pytest.mark.skipif(not HOSTILE.exists(), reason="../shared/data/cases/hostile is not here")


@pytest.fixture(autouse=True)
def _there(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """A working folder with the cases, in which a failed command leaves nothing."""
    for file in HOSTILE.iterdir():
        shutil.copyfile(file, tmp_path / file.name)
    monkeypatch.chdir(tmp_path)
    yield
    assert not [path.name for path in tmp_path.rglob("*") if ".neurolens-" in path.name]


def lights(name: str, text: str) -> Callable[[], None]:
    return lambda: Path(name).write_text(text) and None


MANY = json.dumps([{"azimuth_deg": 1 + k / 50000, "elevation_deg": 0.5} for k in range(200_000)])
MERGE = ("render", "--merge", "-o", "o.exr")
RENDER = ("render", "mesh_pabs.toml", "--camera", "thin", "-o", "o.exr", "--samples", "1", "--width", "16", "--quiet")
ADD = ("blender", "add", GAUSS, "--to")
# Of each case the commands that are refused, by words of the message: what makes its file, the command.
REFUSED: dict[str, list[tuple[str, Callable[[], object] | None, tuple[object, ...]]]] = {
    "metaint.exr": [
        ("metaint.exr: neurolens: got 5, expected JSON text", None, (*FLARE, "--image", "metaint.exr")),
        ("metaint.exr: neurolens: got 5, expected JSON text", None, (*MERGE, "metaint.exr")),
    ],
    "pabs.ply": [("meshes[0].faces[0]: got [0, 1, 4294967295]", None, RENDER)],
    **{
        f"tile_{k}": [(f"tile_{k}_0.exr: metadata:", None, (*MERGE, f"tile_{k}_0.exr", f"tile_{k}_1.exr"))]
        for k in TILES
    },
    **{f"z_{kind}.zip": [("`neurolens blender build`", None, (*ADD, f"z_{kind}.zip"))] for kind in ZIPS},
    "fifo_blender": [
        ("not a regular file", lambda: os.mkfifo("f.zip"), (*ADD, "f.zip")),
        ("not a regular file", lambda: (os.mkdir("d"), os.mkfifo("d/lenses.json")), (*ADD, "d")),
    ],
    **{
        model: [("card: transmittance: got (missing)", None, ("blender", "add", model, "--to", "inner/folder"))]
        for model in ("trav.onnx", "longmethod.onnx")
    },
    "many_lights": [
        ("at most 10000 lights in a list", lights("many.json", MANY), (*FLARE, "--lights", "many.json")),
        ("at least one light", lights("empty.json", "[]"), (*FLARE, "--lights", "empty.json")),
        ("at least one light", lights("empty.csv", ""), (*FLARE, "--lights", "empty.csv")),
        ("at least one light", lights("head.csv", "azimuth_deg,elevation_deg\n"), (*FLARE, "--lights", "head.csv")),
    ],
}
OTHERS = ("fault.toml", "library_same_stem", "rings.exr")  # each has a test below


def test_every_case_is_a_test() -> None:
    cases = {file.name.removesuffix(".txt") for file in HOSTILE.glob("*.txt")}
    assert cases == {*REFUSED, *OTHERS}


@pytest.mark.parametrize("case", REFUSED)
def test_it_is_refused_in_one_line_and_writes_nothing(case: str, capsys: pytest.CaptureFixture[str]) -> None:
    for words, make, command in REFUSED[case]:
        if make is not None:
            make()
        before = {path: path.lstat().st_mtime_ns for path in Path().rglob("*")}
        assert words in failure(capsys, *command)
        assert {path: path.lstat().st_mtime_ns for path in Path().rglob("*")} == before


@pytest.mark.parametrize("case", ["trav.onnx", "longmethod.onnx"])
def test_a_models_method_is_part_of_a_safe_name(case: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """The card's text stands in the pack; its shader, whose pupil takes seconds to fit, is replaced.

    The cases are models of an earlier schema, which is refused, so a shipped model takes their method.
    """
    method = json.loads(next(e.value for e in onnx.load(case).metadata_props if e.key == CARD_KEY))["fit"]["method"]
    edited(GAUSS, Path(case), lambda card: card["fit"].update(method=method))

    def form_of(file: Path, **_: Any) -> Form:
        return Form("polynomial", load_model(file).card["fit"]["method"], "shader", 1.0, 21.6, 1.8, 0.7)

    monkeypatch.setattr("neurolens.cli.blender.form_of", form_of)
    before = set(Path().rglob("*"))
    assert main(["blender", "add", case, "--to", "inner/folder", "--quiet"]) == 0
    made = set(Path().rglob("*")) - before
    assert made and all(path.is_relative_to("inner") and len(path.name) < 120 for path in made)
    assert len([path for path in made if path.suffix == ".osl"]) == 1
    assert not [path for path in Path("..").glob("*/escaped")] and not Path("escaped").exists()


def test_a_refused_lens_is_text_in_the_librarys_index(capsys: pytest.CaptureFixture[str]) -> None:
    """All lenses are refused here: the page is there, with the reason. In a browser: tests/view."""
    assert experiment(["library", "-o", "new", "fault.toml", "--quiet"]) == 1
    text = Path("new/index.html").read_text()
    assert "schema: got" in capsys.readouterr().out and "schema: got" in text
    assert "<img" not in text and "<script>document.documentElement" not in text
