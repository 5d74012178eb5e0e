"""Files and command lines of an attacker: one clear line each, in bounded time and memory (experiments/hostile)."""

import json
import os
import struct
import subprocess
import sys
import time
import zlib
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from io import BytesIO
from pathlib import Path

import numpy as np
import pytest
from command_line import failure

from experiments.hostile import fuzz
from neurolens import cli
from neurolens.base.errors import InputError
from neurolens.base.files import atomic_path, open_regular
from neurolens.base.settings import apply_overrides
from neurolens.base.tomlfile import read_toml
from neurolens.optics.lens import glass as catalogue
from neurolens.optics.readers.any_format import read_any
from neurolens.optics.readers.json_lens import image_and_field, read_json_lens
from neurolens.pictures.render import images, pictures
from neurolens.pictures.render.colour import illuminant, read_spectrum
from neurolens.pictures.render.mesh import read_file

ROOT = Path(__file__).parents[1]
SECONDS = 10  # each takes less than one, and took from ten to more than a hundred
TWICE = "{" + ",".join(f'"{k % 89_999}": 1' for k in range(90_000)) + "}"
LENS_JSON = '{"name": "a", "source": "b", "notes": %s, "surfaces": [{}]}'


@pytest.mark.whole  # python -m experiments fuzz; what it has found is in the tests below
@pytest.mark.slow
def test_40_hostile_cases_end_as_they_should(tmp_path: Path) -> None:
    """In a new process: cases are forks of it, and this one has grown large by other tests."""
    command = [sys.executable, "-m", "experiments", "fuzz", "--cases", "40", "--seed", "22", "--quiet"]
    found = subprocess.run([*command, "-o", tmp_path], capture_output=True, text=True, timeout=600, check=False)
    assert found.returncode == 0, found.stdout
    cases = json.loads((tmp_path / "fuzz" / "22-0-40.json").read_text())
    assert len(cases) == 40 and not any(case["faults"] for case in cases)
    assert len({case["kind"] for case in cases}) > 0.7 * len(fuzz.KINDS)
    assert {case["code"] for case in cases} >= {0, 2}
    assert "40 cases, 0 with faults" in (tmp_path / "fuzz.md").read_text()


def mesh(text: bytes) -> Callable[[Path], object]:
    def read(folder: Path) -> object:
        (folder / "a.obj").write_bytes(text)
        return read_file(folder / "scene.toml", "file", folder / "a.obj")

    return read


def lens(text: str, suffix: str) -> Callable[[Path], object]:
    def read(folder: Path) -> object:
        (folder / f"a{suffix}").write_text(text)
        return (read_toml if suffix == ".toml" else read_any)(folder / f"a{suffix}")

    return read


@pytest.mark.parametrize(
    "read",
    {
        "vertex of digits": mesh(b"v " + b"1" * 60_000 + b"x 0 0\n"),
        "face of digits": mesh(b"f " + b"1" * 60_000 + b"x 2 3\n"),
        "glass of spaces": lambda _: catalogue.same_name("Schott" + " " * 60_000 + "\n"),
        "glass in spaces": lambda _: catalogue.same_name("x" + " " * 60_000 + "(Schott"),
        "diameters": lens(LENS_JSON % ('"' + "diameter " * 100_000 + '"'), ".json"),
        "field of digits": lambda _: image_and_field({"field_or_image_circle": "1" * 900_000}, "a.json"),
        "many keys, one twice": lens(LENS_JSON % TWICE, ".json"),
        "key of many parts": lens("a" + ".a" * 400_000 + " = 1", ".toml"),
        "value of many parts": lambda _: apply_overrides({}, ["x={a" + ".a" * 60_000 + "=1}"]),
        "blank lines before OSLO": lens("\n" * 900_000 + "x", ".abc"),
        "kelvin of digits": lambda _: illuminant("1" * 900_000),
    }.values(),
)  # fmt: skip
def test_a_file_of_one_megabyte_is_read_or_refused_soon(read: Callable[[Path], object], tmp_path: Path) -> None:
    start = time.perf_counter()
    with suppress(InputError):
        read(tmp_path)
    assert time.perf_counter() - start < SECONDS


def fifo(path: Path) -> None:
    os.mkfifo(path)


def zero(path: Path) -> None:
    path.symlink_to("/dev/zero")


@pytest.mark.parametrize("special", [fifo, zero, Path.mkdir])
@pytest.mark.parametrize(
    "name", ["tile.png", "mask.png", "sky.exr", "lamp.csv", "tetra.obj", "tetra.ply", "scene.toml"]
)
def test_special_files_are_refused_not_waited_for(
    name: str, special: Callable[[Path], None], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for file in fuzz.SEEDS.iterdir():
        if file.name != name:
            (tmp_path / file.name).write_bytes(file.read_bytes())
    special(tmp_path / name)
    scene = tmp_path / "scene.toml"
    line = failure(capsys, "render", scene, "--camera", "thin", "-o", tmp_path / "a.exr", "--quiet")
    assert name in line and "not a regular file" in line


@pytest.mark.parametrize("special", [fifo, zero])
def test_special_models_and_lenses_are_refused(
    special: Callable[[Path], None], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for name, command in (
        ("a.onnx", "export --to c -o a.h"),
        ("a.zmx", "convert -o a.toml"),
        ("a.json", "convert -o a.toml"),
    ):
        special(tmp_path / name)
        assert "not a regular file" in failure(capsys, *command.split()[:1], tmp_path / name, *command.split()[1:])


def picture(kind: str, size: tuple[int, int] = (4, 4)) -> bytes:
    from PIL import Image

    out = BytesIO()
    Image.new("RGB", size).save(out, kind)
    return out.getvalue()


def test_pictures_are_of_few_formats_whatever_their_name(tmp_path: Path) -> None:
    """Of an EPS file Pillow would have Ghostscript make a picture."""
    for kind in ("EPS", "PDF", "GIF"):
        (tmp_path / "a.png").write_bytes(picture(kind))
        with pytest.raises(InputError, match="a readable picture, one of PNG, JPEG") as refused:
            images.read_picture(tmp_path / "scene.toml", "file", tmp_path / "a.png")
        assert "object at" not in str(refused.value)


def test_pictures_have_a_budget_together(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "a.png").write_bytes(picture("PNG", (40, 30)))
    files = {field: tmp_path / "a.png" for field in ("first", "second")}
    monkeypatch.setattr(images, "MOST_PIXELS", 2400)
    assert len(images.read_pictures(tmp_path / "scene.toml", files)) == 2
    monkeypatch.setattr(images, "MOST_PIXELS", 2399)
    with pytest.raises(InputError, match="second: .*at most 1199 pixels"):
        images.read_pictures(tmp_path / "scene.toml", files)
    layers = {f"layer{k}": np.zeros((8, 8)) for k in range(153)}
    pictures.write_exr(tmp_path / "a.exr", np.zeros((8, 8, 3)), layers=layers)
    assert len(pictures.read_layers(tmp_path / "a.exr")) == 153
    monkeypatch.setattr(pictures, "_MOST_VALUES", 64 * 156 - 1)
    with pytest.raises(InputError, match="9984 values in its channels"):
        pictures.read_layers(tmp_path / "a.exr")


@pytest.mark.parametrize(
    "chunk", [b"iCCP", b"tRNS", b"PLTE", b"pHYs", b"gAMA", b"cHRM", b"acTL", b"fcTL", b"zTXt", b"iTXt"]
)
@pytest.mark.parametrize("content", [b"", b"\0", b"\xff" * 4, b"x" * 40])
def test_damaged_chunks_of_a_png(chunk: bytes, content: bytes, tmp_path: Path) -> None:
    """Read or refused, whatever the decoder raises."""
    whole, said = picture("PNG"), chunk + content
    bad = struct.pack(">I", len(content)) + said + struct.pack(">I", zlib.crc32(said))
    (tmp_path / "a.png").write_bytes(whole[:33] + bad + whole[33:])
    with suppress(InputError):
        images.read_picture(tmp_path / "scene.toml", "file", tmp_path / "a.png")
    with suppress(InputError):
        images.read_mask(tmp_path / "a.png")


@pytest.mark.parametrize("name", ["a\0b", "\udfff\ud800", "a" * 300])
def test_names_that_no_file_can_have(name: str, tmp_path: Path) -> None:
    with pytest.raises(OSError):
        open_regular(tmp_path / name)
    for read in (read_toml, read_any, images.read_mask, pictures.read_exr, read_json_lens):
        with pytest.raises(InputError):
            read(tmp_path / name)
    with pytest.raises(InputError):
        read_spectrum(tmp_path / "scene.toml", "file", tmp_path / name)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("a = " + "[" * 3000 + "]" * 3000, "valid TOML"),
        ("a = " + "[" * 150 + "]" * 150, "nested too deep"),
        ("a = 1" + "0" * 30, "64 bits"),
        ("a = 1" + "0" * 5000, "valid TOML"),
        ('a = "\\u0000"', "zero byte"),
        ('"\\u0000" = 1', "zero byte"),
    ],
)
def test_trees_that_no_file_of_ours_has(text: str, words: str, tmp_path: Path) -> None:
    (tmp_path / "a.toml").write_text(text)
    with pytest.raises(InputError, match=words):
        read_toml(tmp_path / "a.toml")


def test_messages_are_one_line_whatever_the_value() -> None:
    deep: list[object] = []
    for _ in range(100_000):
        deep = [deep]
    for value in (deep, 10**5000, "\x1b[31m\n" * 100_000, ["x" * 100_000]):
        said = str(InputError("a.toml", "field" * 1000, value, "less"))
        assert len(said) < 2000 and said.isprintable() and "expected less" in said


@pytest.mark.parametrize(
    ("error", "words"),
    [
        (
            ZeroDivisionError("float\ndivision"),
            "a fault of neurolens: ZeroDivisionError: float division; please report",
        ),
        (RecursionError("deep"), "a fault of neurolens: RecursionError; please report"),
        (MemoryError("Unable to allocate 1 TiB"), "not enough memory (Unable to allocate 1 TiB)"),
        (
            ImportError("libtorch_cpu.so: failed to map segment from shared object"),
            "not enough memory (libtorch_cpu.so",
        ),
        (ImportError("a.so: failed to map segment: Operation not permitted"), "a fault of neurolens: ImportError"),
        (ModuleNotFoundError("No module named 'numpy'", name="numpy"), "a fault of neurolens: ModuleNotFoundError"),
    ],
)
def test_the_last_net(
    error: Exception, words: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def run(args: object) -> int:
        raise error

    def build() -> cli.Parser:
        parser = cli.Parser()
        parser.set_defaults(run=run, kept="")
        return parser

    assert cli.main([], build) == 70
    (line,) = capsys.readouterr().err.splitlines()
    assert words in line
    monkeypatch.setenv("NEUROLENS_TRACEBACK", "1")
    assert cli.main([], build) == 70 and "Traceback" in capsys.readouterr().err


def test_no_output_replaces_a_pipe_or_device(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A superuser may rename a file over both: a command that wrote to /dev/zero took the device away."""
    pipe = tmp_path / "out.toml"
    os.mkfifo(pipe)
    lens = ROOT / "experiments" / "fuzz_seeds" / "lens.zmx"
    assert "not a regular file" in failure(capsys, "convert", lens, "-o", pipe, "--force")
    assert pipe.is_fifo()
    with pytest.raises(OSError, match="not a regular file"), atomic_path(pipe):
        pass
    assert pipe.is_fifo() and list(tmp_path.iterdir()) == [pipe]


def test_what_the_fuzzer_broke_is_one_line_or_no_fault(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    seeds = ROOT / "experiments" / "fuzz_seeds"
    Path("f0.lens").write_text((seeds / "lens.lens").read_text(encoding="utf-8").replace("f/2.8", "f/0"))
    assert cli.main(["convert", "f0.lens", "-o", "lens.toml"]) == 0
    capfd.readouterr()

    assert cli.main(["analyse", "lens.toml", "seidel", "--blade-curvature", "0.5", "-o", "refused"]) == 2
    assert not Path("refused").exists()
    assert len(capfd.readouterr().err.splitlines()) == 1

    tag, other = (struct.pack("<HHIH", 277, 3, 1, samples) for samples in (3, 18761))  # samples of a pixel
    good = picture("TIFF")
    assert tag in good
    Path("scan.tif").write_bytes(good.replace(tag, other))
    with pytest.raises(InputError):
        images.read_pictures(Path("scene.toml"), {"textures.scan.file": Path("scan.tif")})
    assert capfd.readouterr().err == ""


@pytest.mark.parametrize("word", ["a\0b", "\udc00"])
def test_words_that_name_no_file_are_refused(word: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert "command line: argument" in failure(capsys, "survey", ".", "--no-fit", "-o", word)


def test_numbers_beyond_what_random_generators_take_are_refused(capsys: pytest.CaptureFixture[str]) -> None:
    model = ROOT / "models" / "laikin_double_gauss_50.ols-36.onnx"
    assert "--seed" in failure(capsys, "evaluate", model, "--seed", "1" * 300)


def test_a_light_too_far_for_millimetres_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    lights = tmp_path / "lights.json"
    lights.write_text('[{"azimuth_deg": -4.5, "elevation_deg": 2, "distance_m": 1e308}]')
    command = ("flare", "brendel_tessar_100", "--lights", lights, "--width", "24", "--bins", "2", "--quiet")
    assert "distance_m: got 1e+308" in failure(capsys, *command, "-o", tmp_path / "flare.exr")


def test_a_lens_without_light_on_its_axis_has_no_exposure() -> None:
    from neurolens.optics.setting.states import set_lens
    from neurolens.pictures.flare.job import axis_irradiance

    lens = set_lens(read_any(ROOT / "lenses" / "brendel_tessar_100.toml"))
    with pytest.raises(InputError, match="no ray passes on the axis"):
        axis_irradiance(replace(lens, film_z_mm=1e7), 550.0)
