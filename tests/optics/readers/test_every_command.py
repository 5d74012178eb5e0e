"""Every command that takes a lens takes a file of any format, and knows the nearest name after a typing error.

A lens of the project, written in the formats of other programs, gives what its own file gives.
"""

import re
from dataclasses import replace
from pathlib import Path

import lens_formats
import numpy as np
import pytest
from command_line import failure, run_json

from neurolens.base.errors import InputError, NeurolensError
from neurolens.base.lensname import lens_id_of, resolve, split_kind
from neurolens.cameras.build import make_camera
from neurolens.cli import main
from neurolens.cli.plan import shipped_models
from neurolens.optics.lens.prescription import Lens
from neurolens.optics.lens.shot import Shot
from neurolens.optics.readers import any_format
from neurolens.optics.readers.any_format import read_any
from neurolens.optics.readers.lensfile import read_lens, write_lens
from neurolens.optics.readers.source import ReadOptions

LENSES = Path(__file__).parents[3] / "lenses"
SHOT = Shot((24.0, 16.0), 2.0, f_number=8.0)
# What each command needs besides the lens, whose place is {}; NAME: a file that need not exist.
COMMANDS = {
    "lens": "lens {}",
    "rims": "lens {} --derive-rims",
    "analyse": "analyse {} spots",
    "flare": "flare {} --light 5,3",
    "plan": "plan SCENE --lens {}",
    "trade": "plan SCENE --lens {} --explain",
    "stmap": "stmap {} --size 30x20 --film 24x16 -o NAME",
    "bokeh": "bokeh {} --width 30 --film 24x16 --distance inf --grid 1x1 -o NAME",
    "handover": "handover {} --size 30x20 --film 24x16 -o NAME",
    "projection": "projection {} --size 30x20 --film 24x16 --model opencv",
    "render": "render SCENE --camera {} -o NAME.exr",
    "render fused": "render SCENE --camera fused:{} -o NAME.exr",
    "render thick": "render SCENE --camera thick:{} -o NAME.exr",
    "export c": "export {} --to c -o NAME.h",
    "export osl": "export {} --to osl -o NAME.osl",
    "export camera": "export {} --to glsl --camera -o NAME.glsl",
    "blender": "blender add {} --to NAME",
    "view": "view {} -o NAME.html",
    "train": "train --lens {} -o NAME",
    "experiment": "train EXPERIMENT -o NAME",
    "evaluate": "evaluate MODEL --lens {}",
    "verify": "verify {} -o NAME.png",
    "fitted rims": "rims {} -o NAME.toml",
}


@pytest.fixture(scope="module")
def tessar() -> Lens:
    """A lens with media by index and Abbe number, which every format can say."""
    return lens_formats.plain(read_lens(LENSES / "brendel_tessar_100.toml"))


@pytest.fixture
def files(tessar: Lens, tmp_path: Path) -> dict[str, Path]:
    """The same lens in three formats; people's names have spaces, points and colons."""
    found = {kind: tmp_path / f"Tessar 100mm 1:4.5 (v2.0).{kind}" for kind in ("zmx", "txt")}
    found["zmx"].write_text(lens_formats.zmx(tessar))
    found["txt"].write_text(lens_formats.optical_bench(tessar))
    found["toml"] = tmp_path / "own.toml"
    write_lens(read_any(found["zmx"]), found["toml"])
    return found


def words(command: str, lens: Path | str, folder: Path, scene: Path) -> list[str]:
    experiment = folder / "experiment.toml"
    experiment.write_text(f'title = "x"\n[lens]\nfile = {str(lens)!r}\n[[model]]\nmethod = "ols"\nterms = 20\n')
    swaps = {"{}": str(lens), "NAME": str(folder / "out"), "SCENE": str(scene), "EXPERIMENT": str(experiment)}
    swaps["MODEL"] = str(LENSES.parent / "models" / "brendel_tessar_100.ols-64.onnx")
    return [re.sub("|".join(map(re.escape, swaps)), lambda m: swaps[m[0]], word) for word in COMMANDS[command].split()]


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_gives_a_foreign_file_to_its_reader(
    command: str, files: dict[str, Path], scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    def stop(path: Path | str, given: object) -> Lens:
        raise InputError(path, "read", "(by the reader of Zemax)", "no more")

    monkeypatch.setattr(any_format, "FORMATS", tuple(replace(f, read=stop) for f in any_format.FORMATS))
    (tmp_path / "out").mkdir(exist_ok=command == "blender")
    if command == "blender":
        monkeypatch.setattr("neurolens.programs.blender.check_takes", lambda to: None)
    assert main([*words(command, files["zmx"], tmp_path, scene)]) == 2
    assert "by the reader of Zemax" in capsys.readouterr().err


@pytest.mark.parametrize("command", [name for name in COMMANDS if name != "experiment"])
def test_every_command_suggests_the_nearest_name(
    command: str, scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    said = failure(capsys, *words(command, "cooke_tripplet_50", tmp_path, scene))
    assert "did you mean 'cooke_triplet_50'?" in said and "cooke_tripplet_50" in said


def test_figures_are_those_of_the_lens_s_own_file(files: dict[str, Path], capsys: pytest.CaptureFixture[str]) -> None:
    own, zemax, bench = (run_json(capsys, "lens", files[kind]) for kind in ("toml", "zmx", "txt"))
    for key in ("efl_mm", "back_focus_mm", "entrance_pupil_z_mm", "passing_share", "image_radius_mm", "surfaces"):
        assert zemax[key] == own[key], key
    assert bench["efl_mm"] == pytest.approx(own["efl_mm"], rel=1e-12)
    spots = [run_json(capsys, "analyse", files[kind], "spots", "--field-points", 0, 12) for kind in ("toml", "zmx")]
    for told in spots:
        del told["file"], told["seconds"], told["warnings"]
    assert spots[0] == spots[1]


@pytest.mark.parametrize("kind", ["", "thick:", "thin:", "pinhole:", "fused:"])
def test_cameras_of_a_foreign_file_send_the_same_rays(kind: str, files: dict[str, Path]) -> None:
    random = np.random.default_rng(3)
    inputs = random.uniform(-6, 6, (2, 64)), random.uniform(0, 1, (2, 64)), np.full(64, 550.0)
    inputs32 = [np.ascontiguousarray(a, np.float32) for a in inputs]
    rays = [make_camera(f"{kind}{files[name]}", SHOT).sample(*inputs32) for name in ("toml", "zmx")]
    for part in ("origin_m", "direction", "weight", "status"):
        np.testing.assert_array_equal(*(getattr(r, part) for r in rays))
    assert (rays[0].status == 0).any()


def test_what_a_name_means(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    shipped = resolve("cooke_triplet_50").file
    assert shipped == LENSES / "cooke_triplet_50.toml"
    assert str(resolve("laikin_double_gauss_50.mlp-16x2")).endswith("models/laikin_double_gauss_50.mlp-16x2.onnx")
    Path("cooke_triplet_50").mkdir()  # the folder of an earlier run is no lens
    assert resolve("cooke_triplet_50").file == shipped
    Path("cooke_triplet_50.d").write_text("a file comes first")
    assert resolve("fused:cooke_triplet_50.d") == ("", Path("cooke_triplet_50.d"))
    assert resolve("pinhole") == ("pinhole", None) and resolve("thin:cooke_triplet_50") == ("thin:", shipped)
    Path("1:2.8 lens.zmx").touch()
    assert split_kind("thick:1:2.8 lens.zmx") == ("thick:", "1:2.8 lens.zmx")
    assert resolve("1:2.8 lens.zmx") == ("", Path("1:2.8 lens.zmx"))
    Path("M.ONNX").touch()
    for text, more in (("M.ONNX", {"models": False}), ("thin:M.ONNX", {}), ("fused:M.ONNX", {"cameras": False})):
        with pytest.raises(InputError, match="a lens file of any format"):
            resolve(text, **more)
    for typed, meant in (
        ("pinhol", "pinhole"),
        ("1_2.8 lens.zmx", "1:2.8 lens.zmx"),
        ("fused:cooke_triplet.d", "cooke_triplet_50.d"),
    ):
        with pytest.raises(InputError, match=re.escape(f"did you mean {meant!r}")):
            resolve(typed)
    for text in ("", "/", "a\0b", "nowhere/x.zmx", "\ud800"):
        with pytest.raises((InputError, NeurolensError)):
            read_any(str(resolve(text)))


def test_a_plan_s_file_stands_for_its_camera_of_any_format(files: dict[str, Path], tmp_path: Path) -> None:
    plan = tmp_path / "plans" / "plan.toml"
    plan.parent.mkdir()
    plan.write_text(f'title = "x"\ncamera = "fused:../{files["zmx"].name}"\n')
    assert resolve(plan) == ("", files["zmx"]) and resolve(f"thin:{plan}") == ("thin:", files["zmx"])


def test_ids_are_names_of_files() -> None:
    assert lens_id_of("a/Canon EF50mm f/../F1.4 USM.zmx") == "F1_4_USM"
    assert lens_id_of("鏡頭 50.zmx") == "鏡頭_50" and lens_id_of("cooke_triplet_50.toml") == "cooke_triplet_50"
    assert lens_id_of("(!).zmx") == "lens" == lens_id_of("")


def test_shipped_models_are_those_of_the_same_figures(tmp_path: Path) -> None:
    for stem, zoom in (("cooke_triplet_50", None), ("ogawa_zoom_70_200", "135mm")):
        lens = read_lens(LENSES / f"{stem}.toml")
        assert shipped_models(lens, zoom)
    rows = lens.surfaces
    changed = replace(lens, surfaces=(replace(rows[0], radius_mm=rows[0].radius_mm * 1.01), *rows[1:]))
    assert not shipped_models(changed, "135mm")


def test_what_a_file_lacks_is_asked_of_convert(tessar: Lens, tmp_path: Path) -> None:
    file = tmp_path / "x.zmx"
    text = lens_formats.zmx(tessar)
    file.write_text(re.sub(r"(STOP\n(?:(?!SURF).*\n)*?)  DIAM.*\n", r"\1", text))  # a stop of no size, and no f-number
    with pytest.raises(InputError, match=r"neurolens convert FILE --f-number \.\.\. -o LENS\.toml"):
        read_any(file)
    with pytest.raises(InputError) as plain:
        read_any(file, ReadOptions())
    assert "convert" not in str(plain.value)
    assert read_any(file, ReadOptions(f_number=8.0)).f_number == 8


def test_one_file_is_warned_of_once_in_a_command(files: dict[str, Path], capsys: pytest.CaptureFixture[str]) -> None:
    text = files["zmx"].read_text().replace("MODE SEQ", "MODE SEQ\nQQQQ 1")
    files["zmx"].write_text(text)
    assert main(["export", str(files["zmx"]), "--to", "c", "--camera", "-o", str(files["toml"]) + ".h", "--json"]) == 0
    lines = [line for line in capsys.readouterr().err.splitlines() if "QQQQ" in line]
    assert len(lines) == 1
