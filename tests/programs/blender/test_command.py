"""`neurolens blender build` and `add`: what goes into the zip; shaders stand in, for they take their time."""

from __future__ import annotations

import json
import shutil
import zipfile
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("onnxruntime", reason="neurolens is not installed in Blender's environment")

from neurolens.base.errors import InputError  # noqa: E402
from neurolens.cameras.shaders.blender_shader import Shader  # noqa: E402
from neurolens.cli import (
    blender as command,  # noqa: E402
    main,  # noqa: E402
)
from neurolens.optics.lens.paraxial import first_order  # noqa: E402

LENS = "laikin_double_gauss_50"
HUGE = "operations: got 20000"


_MADE: dict[tuple[Any, ...], Any] = {}


def once(make: Callable[..., Any]) -> Callable[..., Any]:
    """What is made of a lens, made once for all tests."""

    def made(lens: Any, *more: Any) -> Any:
        key = (make.__name__, lens.name, *more)
        if key not in _MADE:
            _MADE[key] = make(lens, *more)
        return _MADE[key]

    return made


@pytest.fixture
def place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder of three models and their lens file, and shaders that cost nothing."""
    for name in ("field_table", "thumbnail"):
        monkeypatch.setattr(command, name, once(getattr(command, name)))

    def written(file: Path, *, zoom: str | None = None, quiet: bool = False) -> Shader:
        if file.stem == "huge":
            raise InputError(file, "operations", 20000, "up to 12000")
        return Shader("camera", f"shader of {file.name}, {zoom}", 1, (), {}, 21.6, 1.8, 0.7)

    monkeypatch.setattr(command, "shader_of", written)
    monkeypatch.setattr(command, "Processes", ThreadPoolExecutor)  # which know the stand-in
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))  # what stands in must not stay
    for folder in ("models", "lenses"):
        (tmp_path / folder).mkdir()
    for model in (f"{LENS}.ols-36", f"{LENS}.ols-60", f"{LENS}.mlp-10x1"):
        shutil.copy(f"models/{model}.onnx", tmp_path / "models")
    shutil.copy(f"lenses/{LENS}.toml", tmp_path / "lenses")
    return tmp_path


def failed(capsys: pytest.CaptureFixture[str], *args: object) -> str:
    """The line of a command that must fail."""
    assert main(["blender", *map(str, args)]) == 2
    out, err = capsys.readouterr()
    assert not out and err.count("\n") == 1
    return err


def test_zip_holds_the_best_of_each_kind_and_takes_more(place: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = place / "n.zip"
    assert main(["blender", "build", "-o", str(out), "--models", str(place / "models"), "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["lenses"] == {LENS: ["ols-60", "mlp-10x1", "exact"]} and told["bytes"] == out.stat().st_size
    shutil.copy(place / "lenses" / f"{LENS}.toml", place / "own.toml")
    assert main(["blender", "add", str(place / "own.toml"), "--to", str(out), "--quiet"]) == 0
    with zipfile.ZipFile(out) as packed:
        names, facts = set(packed.namelist()), json.loads(packed.read("lenses.json"))
        picture = packed.read(f"thumbnails/{LENS}.png")
    assert {f"shaders/{LENS}.{form}.osl" for form in ("ols-60", "mlp-10x1", "exact")} < names
    assert {"__init__.py", "blender_manifest.toml", "shaders/own.exact.osl"} < names
    entry = next(e for e in facts["lenses"] if e["id"] == LENS)
    assert entry["maker"] == "Laikin" and 0.4 < entry["character"]["cats_eye"] < 0.7
    with zipfile.ZipFile(out) as packed:
        assert {packed.read(entry[name])[:4] for name in ("picture", "bokeh")} == {b"\x89PNG"}
        assert sum(len(packed.read(entry[name])) for name in ("picture", "bokeh")) < 16_000
    assert (entry["year"], entry["name"]) == (1995, "Double Gauss 50 mm f/1.8") and entry["efl_mm"] == pytest.approx(
        49.64, abs=0.01
    )
    polynomial, network, exact = entry["variants"]
    assert polynomial["kind"] == "polynomial" and polynomial["rms_um"] == pytest.approx(0.2775, abs=1e-3)
    assert network["kind"] == "network" and exact["rms_um"] is None and exact["nearest_m"] == 0.7
    assert picture.startswith(b"\x89PNG") and picture[16:24] == bytes([0, 0, 1, 0] * 2)


def test_lenses_that_cannot_be_shaders_are_left_out_and_said(place: Path, capsys: pytest.CaptureFixture[str]) -> None:
    shutil.copy(place / "models" / f"{LENS}.ols-36.onnx", place / "models" / "huge.ols-36.onnx")
    for form in ("lenses/huge.toml",):
        shutil.copy(place / "lenses" / f"{LENS}.toml", place / form)
    given = ["build", "-o", str(place / "n.zip"), "--models", str(place / "models")]
    shader_of = command.shader_of

    def only_files(file: Path, **options: object) -> Shader:
        return shader_of(place / "x.onnx" if file.suffix == ".onnx" else file, **options)

    command.shader_of = only_files  # undone with the fixture's
    assert main(["blender", *given, "--lens", "huge", "--json"]) == 0
    told, said = capsys.readouterr()
    assert json.loads(told)["lenses"] == {"huge": ["ols-36"]} and HUGE in said


def test_bad_input_is_one_line(
    place: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    models, out = place / "models", place / "n.zip"
    assert "--lens" in failed(capsys, "build", "-o", out, "--models", models, "--lens", "nothing")
    assert "a folder of models" in failed(capsys, "build", "-o", out, "--models", place / "none")
    assert ".zip" in failed(capsys, "build", "-o", place / "n.tar", "--models", models)
    assert "a folder with models" in failed(capsys, "build", "-o", out, "--models", place / "lenses")
    monkeypatch.setenv("BLENDER_USER_RESOURCES", str(place / "nobody"))
    assert "no Blender of this machine" in failed(capsys, "add", models / f"{LENS}.ols-36.onnx")
    with pytest.raises(SystemExit):
        main(["blender", "add", str(place / "no.onnx"), "--to", str(place / "user")])
    assert "(missing)" in capsys.readouterr().err
    (place / "a.txt").write_text("x")
    (place / "a.zip").write_text("no zip")
    with monkeypatch.context() as early:
        early.setattr(command, "form_of", lambda *given, **options: pytest.fail("no shader is to be made"))
        for to, expected in (("a.zip", "a zip of `neurolens blender build`"), ("a.txt", "or a folder")):
            assert expected in failed(capsys, "add", models / f"{LENS}.ols-36.onnx", "--to", place / to)
    assert "format" in failed(capsys, "add", place / "a.txt", "--to", place / "user")
    assert not out.exists() and not (place / "user").exists()


def test_a_squeezed_picture_is_said_of_its_lens(place: Path) -> None:
    name = "cooke_anamorphic_42"  # focal lengths of 42.47 and 21.47 mm
    for file in (f"models/{name}.mlp-16x2.onnx", f"lenses/{name}.toml"):
        [note] = command.form_of(Path(file)).notes
        assert "squeezed 1.98 times across" in note and "Aspect Y of 1.98" in note
    assert command.form_of(place / "models" / f"{LENS}.ols-36.onnx").notes == []


def test_models_of_one_state_have_the_section_of_that_state_and_ranges_their_name() -> None:
    for model, efl in (
        ("ogawa_zoom_70_200-135mm.ols-60", 134.95),
        ("muller_fisheye_100-14mm.ols-40", 14.0),
        ("nikon_zoom_70_200-range.states-64", 71.5),
    ):
        file = Path(f"models/{model}.onnx")
        lens = command.stated_lens(file, Path("lenses"))
        assert lens is not None and first_order(lens).efl_mm == pytest.approx(efl, rel=1e-3)
        packed = command.packed_of([file], [])
        assert packed.name.endswith(", any zoom") == ("range" in model)
    assert command.stated_lens(file, Path("models")) is None
