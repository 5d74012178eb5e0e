"""Tiles rendered apart are the picture of one run, bit for bit; tiles that do not belong together are named."""

import json
import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import OpenEXR
import pytest
from command_line import failure, run_json
from PIL import Image
from shipped import whole

from neurolens.cli import main
from neurolens.pictures.render.pictures import METADATA_KEY, read_channels
from neurolens.pictures.render.renderer import rows_of, tile_path

FARM = Path(__file__).parents[3] / "experiments" / "farm"
Render = Callable[..., Path]
MODEL = str(Path(__file__).parents[3] / "models" / "laikin_double_gauss_50.ols-60.onnx")
# Other kinds of picture: 16 bits and another space, the white balance, light that crosses the edges of tiles, colour
# alone; 17 samples are two passes.
KINDS = {
    "plain": (),
    "ACEScg, half": ("--half", "--colour-space", "ACEScg", "--white-balance", "A"),
    "companions": ("--camera", MODEL, "--samples", "17"),
    "colour alone": ("--channels", "beauty"),
    "a sensor": ("--mosaic", "GBRG", "--fill-factor", "0.5"),
}


@pytest.fixture
def render(scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Render:
    """Renders to a name; batches are so small that tiles end within them."""
    monkeypatch.setattr("neurolens.pictures.render.film.BATCH", 177)
    monkeypatch.setattr("neurolens.pictures.render.job._LITTLE_PX", 0.0)  # pictures so small show no dispersion
    monkeypatch.chdir(tmp_path)

    def run(name: str, *options: object) -> Path:
        words = ["render", scene.name, "--camera", "thin", "--samples", 2, "-o", name, "--quiet", "--threads", 1]
        assert main([str(word) for word in (*words, *options)]) == 0
        capsys.readouterr()
        return tmp_path / name

    return run


def tiles_of(render: Render, count: int, *options: object, name: str = "a.exr") -> list[Path]:
    return [tile_path(render(name, "--tile", f"{k}/{count}", *options), (k, count)) for k in range(1, count + 1)]


def stored(path: Path) -> dict[str, bytes]:
    """The channels of a file, of their types, bit for bit."""
    with OpenEXR.File(str(path), separate_channels=True) as file:
        return {name: c.pixels.dtype.str.encode() + c.pixels.tobytes() for name, c in file.channels().items()}


def metadata(path: Path) -> dict[str, Any]:
    """Without what time does."""
    told = read_channels(path)[1]
    timed = {"seconds", "mpaths_per_s", "thread_seconds", "camera_thread_seconds", "camera_fraction"}
    return told | {"render": {key: value for key, value in told["render"].items() if key not in timed}}


@pytest.mark.parametrize(
    ("kind", "count"), [("companions", 3), ("plain", 1), *whole(*((kind, 3) for kind in KINDS), ("plain", 18))]
)
def test_merged_tiles_are_the_picture_of_one_run(
    kind: str, count: int, render: Render, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    options = KINDS[kind]
    one = render("one.exr", *options)
    tiles = tiles_of(render, count, *options)
    merged = tmp_path / "merged.exr"
    told = run_json(capsys, "render", "--merge", *reversed(tiles), "-o", merged)
    assert stored(merged) == stored(one) and len(stored(one)) >= 3
    assert metadata(merged) == metadata(one)
    assert told["pictures"][0]["paths"] == 32 * 18 * metadata(one)["render"]["samples"]
    headers = [OpenEXR.File(str(path), header_only=True).header() for path in (merged, one)]
    for header in headers:
        header.pop(METADATA_KEY)
    assert repr(headers[0]) == repr(headers[1])
    if "half" not in kind:
        pictures = [np.array(Image.open(path.with_suffix(".png"))) for path in (merged, one)]
        assert np.array_equal(*pictures)


def test_frames_in_tiles_become_a_picture_a_frame(
    render: Render, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    frames = ("--frames", "8:10:2", "--key", "focus=8:1,10:2")
    render("one.exr", *frames)
    for k in (1, 2):
        render("cut.exr", *frames, "--tile", f"{k}/2")
    tiles = sorted(tmp_path.glob("cut.*.tile-?-of-2.exr"))
    assert len(tiles) == 4
    told = run_json(capsys, "render", "--merge", *tiles, "-o", tmp_path / "cut.exr")
    assert [Path(picture["file"]).name for picture in told["pictures"]] == ["cut.0008.exr", "cut.0010.exr"]
    for number in ("0008", "0010"):
        assert stored(tmp_path / f"cut.{number}.exr") == stored(tmp_path / f"one.{number}.exr")
    before = tiles[0].stat().st_mtime_ns
    render("cut.exr", *frames, "--tile", "1/2")
    assert tiles[0].stat().st_mtime_ns == before
    assert "tiles of frame 10: got (2 missing), expected all 2" in failure(
        capsys, "render", "--merge", *tiles[:3], "-o", "x.exr"
    )


def test_a_tile_lies_in_its_place_for_other_programs(render: Render) -> None:
    for tile, rows in zip(tiles_of(render, 3), ((0, 6), (6, 12), (12, 18)), strict=True):
        header = OpenEXR.File(str(tile), header_only=True).header()
        assert np.array(header["dataWindow"]).tolist() == [[0, rows[0]], [31, rows[1] - 1]]
        assert np.array(header["displayWindow"]).tolist() == [[0, 0], [31, 17]]


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (("--seed", "7"), "seed: got 7, expected 0 as in"),
        (("--half",), "half: got True, expected False as in"),
        (("--focus", "3"), "camera.focus_m: got 3.0, expected"),
        (("--mosaic", "none"), "sensor"),
    ],
)
def test_tiles_of_other_settings_are_named(
    options: tuple[str, ...], said: str, render: Render, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    first, _ = tiles_of(render, 2)
    _, other = tiles_of(render, 2, *options, name="b.exr")
    line = failure(capsys, "render", "--merge", first, other, "-o", tmp_path / "m.exr")
    assert f"{other}: {said}" in line and not (tmp_path / "m.exr").exists()


def test_tiles_of_another_scene_or_cut_are_refused(
    render: Render, scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    first, second = tiles_of(render, 2)
    thirds = tiles_of(render, 3, name="c.exr")
    assert "tiles: got 3, expected 2 as in" in failure(capsys, "render", "--merge", first, thirds[1], "-o", "m.exr")
    scene.write_text(scene.read_text().replace("radius_m = 0.1", "radius_m = 0.12"))
    _, other = tiles_of(render, 2, name="d.exr")
    assert f"{other}: scene: got " in failure(capsys, "render", "--merge", first, other, "-o", "m.exr")
    assert "tiles: got (2 missing), expected all 2" in failure(capsys, "render", "--merge", first, "-o", "m.exr")
    copy = Path(shutil.copy(second, tmp_path / "copy.exr"))
    line = failure(capsys, "render", "--merge", first, second, copy, "-o", "m.exr")
    assert f"{copy}: tile: got '2 of 2', expected each tile once: {second} is that one, too" in line
    assert "it is one of the tiles" in failure(capsys, "render", "--merge", first, second, "-o", second)
    assert "metadata: got (no 'tile')" in failure(
        capsys, "render", "--merge", render("whole.exr"), first, "-o", "m.exr"
    )
    first.write_bytes(first.read_bytes()[:-200])
    assert "a whole OpenEXR file" in failure(capsys, "render", "--merge", first, second, "-o", "m.exr")
    assert not (tmp_path / "m.exr").exists()


CHANGES: dict[str, Any] = {
    "height": ("render", {"height": 10**9}),
    "width that is no integer": ("render", {"width": "96"}),
    "identity": ("tile", {"identity": 5}),
    "frame of no digits": ("tile", {"frame": ""}),
    "camera": ("camera", "thin"),
    "lens that is a list": ("camera", {"lens": [1]}),
    "name that is a table": ("camera", {"camera": {}}),
    "film beyond float32": ("camera", {"film_mm": [1e308, 24.0]}),
    "film of no height": ("camera", {"film_mm": [36.0, 0.0]}),
    "film of three numbers": ("camera", {"film_mm": [24.0, 1, 5]}),
    "film of one number": ("camera", {"film_mm": 24.0}),
    "space": ("colour", {"space": "mine"}),
    "layers that are numbers": ("layers", [1, "depth"]),
    "paths of 64 bits": ("render", {"paths": 2**63}),
    "seconds that are a text": ("render", {"seconds": "1"}),
    "no text": ("", None),
}


@pytest.fixture(scope="module")
def strange(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path, dict[str, Any], dict[str, Any]]:
    """Two tiles, and header and channels of the second."""
    folder = tmp_path_factory.mktemp("tiles")
    tiles = []
    for k in (1, 2):
        words = ["render", "experiments/scenes/room.toml", "--camera", "thin", "--samples", 1, "--width", 8]
        words += ["-o", folder / "a.exr", "--quiet", "--threads", 1, "--tile", f"{k}/2"]
        assert main([str(word) for word in words]) == 0
        tiles.append(tile_path(folder / "a.exr", (k, 2)))
    with OpenEXR.File(str(tiles[1]), separate_channels=True) as file:
        header, channels = dict(file.header()), {name: c.pixels.copy() for name, c in file.channels().items()}
    header.pop("channels")
    return *tiles, header, channels


@pytest.mark.parametrize("change", CHANGES.values(), ids=CHANGES)
@pytest.mark.filterwarnings("error")
def test_a_strangers_tile_is_refused_in_a_line(
    change: tuple[str, Any],
    strange: tuple[Path, Path, dict[str, Any], dict[str, Any]],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    first, second, header, channels = strange
    told, (place, value) = json.loads(header[METADATA_KEY]), change
    if isinstance(value, dict):
        told[place] |= value
    else:
        told[place] = value
    text = (told if place else value) if value is None else json.dumps(told if place else value)
    held = header | {METADATA_KEY: 5 if text is None else text}
    OpenEXR.File([OpenEXR.Part(held, channels)]).write(str(second))
    line = failure(capsys, "render", "--merge", first, second, "-o", tmp_path / "m.exr")
    assert f"{second}: " in line and not list(tmp_path.iterdir())


def test_a_tile_that_is_not_done_says_so(render: Render, capsys: pytest.CaptureFixture[str]) -> None:
    first, second = tiles_of(render, 2)
    with OpenEXR.File(str(second), separate_channels=True) as file:
        header, channels = dict(file.header()), {name: c.pixels.copy() for name, c in file.channels().items()}
    told = json.loads(header[METADATA_KEY])
    told["render"] |= {"complete": False, "samples_done": 1.5}
    header[METADATA_KEY] = json.dumps(told)
    header.pop("channels")
    OpenEXR.File([OpenEXR.Part(header, channels)]).write(str(second))
    assert "samples: got 1.5, expected 2" in failure(capsys, "render", "--merge", first, second, "-o", "m.exr")


def test_rows_cover_a_picture_once() -> None:
    for height, count in ((18, 1), (18, 18), (2160, 7), (1081, 64)):
        cuts = [rows_of(height, (k, count)) for k in range(1, count + 1)]
        assert [row for first, stop in cuts for row in range(first, stop)] == list(range(height))


@pytest.mark.parametrize("text", ["0/4", "5/4", "1", "a/2", "1/0", "-1/2", "1/2/3"])
def test_a_tile_that_is_none(text: str, scene: Path, capsys: pytest.CaptureFixture[str]) -> None:
    line = failure(capsys, "render", scene, "--camera", "thin", "-o", "a.exr", f"--tile={text}")
    assert "tile I of N" in line


def test_more_tiles_than_rows(render: Render, scene: Path, capsys: pytest.CaptureFixture[str]) -> None:
    line = failure(capsys, "render", scene, "--camera", "thin", "-o", "a.exr", "--tile", "1/19")
    assert "--tile: got '1/19', expected at most 18 tiles, one a row" in line


def test_a_tile_goes_on_from_its_checkpoint_and_not_from_another_tiles(
    render: Render, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    whole = tiles_of(render, 2, "--samples", "32", name="w.exr")
    half = tile_path(render("p.exr", "--tile", "1/2", "--samples", "16", "--keep-checkpoint"), (1, 2))
    part = half.with_name(half.name + ".part")
    other = tmp_path / "p.tile-2-of-2.exr.part"
    shutil.copy(part, other)
    assert stored(tile_path(render("p.exr", "--tile", "1/2", "--samples", "32"), (1, 2))) == stored(whole[0])
    with pytest.raises(AssertionError):
        render("p.exr", "--tile", "2/2", "--samples", "32")
    assert "rows: got [0, 9], expected [9, 18] as asked now" in capsys.readouterr().err


def test_the_slurm_script_parses() -> None:
    script = FARM / "render.sbatch"
    assert subprocess.run(["bash", "-n", script], capture_output=True).returncode == 0
    assert script.read_text().startswith("#!/usr/bin/env bash\n")


def test_the_openjd_template_is_valid() -> None:
    """Checked by the reference implementation, and its tasks counted."""
    model = pytest.importorskip("openjd.model", reason="openjd-model (extra dev) checks the template")
    import yaml

    template = model.decode_job_template(template=yaml.safe_load((FARM / "render.openjd.yaml").read_text()))
    given = {"Scene": "room.toml", "Camera": "thin", "Frames": "1-3", "Tiles": "4"}
    values = model.preprocess_job_parameters(
        job_template=template, job_parameter_values=given, job_template_dir=FARM, current_working_dir=FARM
    )
    job = model.create_job(job_template=template, job_parameter_values=values)
    counts = [len(model.StepParameterSpaceIterator(space=step.parameterSpace)) for step in job.steps]
    assert counts == [12, 3]
