"""The command line from outside: help, one line an error, JSON with units in its keys, files that are whole."""

import argparse
import json
import os
import re
import shlex
import shutil
import signal
import subprocess
import sys
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path

import pytest
from command_line import described, failure, run_json
from lens_models import edited
from shipped import whole

from neurolens.base.units import in_unit
from neurolens.cli import build_parser, main
from neurolens.cli.arguments import first_example, scene_file
from neurolens.cli.train import Train
from neurolens.models.card import read_card
from neurolens.pictures.render.pictures import read_exr

ROOT = Path(__file__).parents[1]
# A singlet, a fisheye, an asphere that is the stop, cylinders, a nearly telecentric lens; tests/optics has all.
DESCRIBED = (
    *("thorlabs_lb1471_biconvex_50", "brendel_tessar_100", "edmund_asphere_30"),
    *("isshiki_fisheye_10", "nikon_zoom_80_200"),
)
GAUSS, SINGLET, PHONE, ZOOM, TESSAR, TRIPLET = (
    ROOT / "lenses" / f"{name}.toml"
    for name in (
        *("laikin_double_gauss_50", "thorlabs_lb1471_biconvex_50", "phone_lens_6", "ogawa_zoom_70_200"),
        *("brendel_tessar_100", "cooke_triplet_50"),
    )
)
MODEL = ROOT / "models" / "cooke_triplet_50.ols-64.onnx"


def parsers(parser: argparse.ArgumentParser, name: str = "neurolens") -> Iterator[tuple[str, argparse.ArgumentParser]]:
    """The parser of every command and of its actions, by name."""
    yield name, parser
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            for word, child in action.choices.items():
                yield from parsers(child, f"{name} {word}")


COMMANDS = dict(parsers(build_parser()))


def options() -> Iterator[tuple[str, argparse.Action]]:
    """The options that help shows, each with its command."""
    for name, parser in COMMANDS.items():
        for action in parser._actions:
            if action.option_strings and action.help != argparse.SUPPRESS:
                yield name, action


# Files or folders; layers that `render` makes, or files that hold them.
BOTH = ("--output", "--behind")


def test_an_option_has_one_spelling_and_one_meaning_in_all_commands() -> None:
    spellings, kinds, commands = defaultdict(set), defaultdict(set), defaultdict(set)
    for name, action in options():
        (spelling,) = (s for s in action.option_strings if s.startswith("--"))
        spellings[action.dest].add(spelling)
        kinds[spelling].add((action.dest, action.metavar, action.nargs == 0))
        commands[spelling].add(name)
    assert {dest: found for dest, found in spellings.items() if len(found) > 1} == {}
    assert {o: found for o, found in kinds.items() if len(found) > 1 and o not in BOTH} == {}
    alike = {(o, f"{o}s") for o in commands if f"{o}s" in commands}
    assert {pair for pair in alike if commands[pair[0]] != commands[pair[1]]} == set()


def test_old_spellings_work_and_are_hidden(capsys: pytest.CaptureFixture[str]) -> None:
    parse = build_parser().parse_args
    for command, old, new in (
        ("train a.toml", "--out x", "-o x"),
        ("train --lens cooke_triplet_50", "--target-px 0.5 --no-race", "--within 0.5px --rounds 0"),
        ("analyse cooke_triplet_50", "--fields 0 9 --wavelengths 500 600", "--field-points 0 9 --wavelengths 500,600"),
        ("survey lenses", "--again", "--restart"),
        ("render a.toml -o a.exr --camera thin", "--layers beauty --wavelengths hero --configuration 70",
         "--channels beauty --wavelength-mode hero --zoom 70"),
        ("flare cooke_triplet_50 --light 5,3", "--out a.exr --preview --wavelengths 9", "-o a.exr --quick --bins 9"),
        ("stmap thin --width 9 --film 36x24", "--out a --channels-nm 600,500,400", "-o a --wavelengths 600,500,400"),
        ("export cooke_triplet_50 --to c -o a.h", "--camera", "--whole-camera"),
        ("flare cooke_triplet_50 --light 5,3", "--wavelengths 9", "--bins 9"),
        ("lens cooke_triplet_50 --derive-rims", "--vignetting 0.4", "--edge-pupil 0.4"),
    ):  # fmt: skip
        found, known = (vars(parse(f"{command} {words}".split())) for words in (old, new))
        for args in (found, known):
            if "field_points" in args:
                args["wavelengths"] = [nm for some in args["wavelengths"] for nm in some]
        assert found == known
        shown = COMMANDS[f"neurolens {command.split()[0]}"].format_help()
        for word in set(re.findall(r"--[a-z-]+", old)) - {"--wavelengths"}:
            assert not re.search(rf"{word}(?![\w-])", shown), word
    tiles = "a.tile-1-of-1.exr -o a.exr"
    assert parse(f"merge {tiles}".split()) == parse(f"render --merge {tiles}".split())
    assert parse("stmap thin --size 9x6 --film 36x24 -o a".split()).size == (9, 6)
    words = "a.toml --lens cooke_triplet_50".split()
    assert parse(["trade", *words]) == parse(["plan", *words, "--explain"])


# Bad input


@pytest.mark.parametrize(
    ("args", "words"),
    [
        (["lense"], ["lense", "lens"]),
        (["lens", "--focus", "2"], ["FILE"]),
        (["lens", "no.toml"], ["no.toml", "missing"]),
        (["lens", "\x1b[2J\u202eno.toml"], ["\\u001b[2J\\u202eno.toml", "missing"]),
        (["lens", GAUSS, "--focus", "near"], ["--focus", "near", "metres"]),
        (["lens", GAUSS, "--focus", "nan"], ["--focus", "metres"]),
        (["lens", GAUSS, "--focus", "0.1"], ["focus_m", "0.1", "four focal lengths"]),
        (["lens", GAUSS, "--efl", "inf"], ["--focal-length", "mm"]),
        (["lens", GAUSS, "--f-number", "-2"], ["--f-number", "from 0.1 to 10000"]),
        (["lens", GAUSS, "--zoom", "wide"], ["zoom", "wide", "none in this file"]),
        (["lens", ZOOM, "--zoom", "wide"], ["zoom", "wide", "72mm"]),
        (["lens", GAUSS, "--layout", "a.exr"], ["--layout", ".png"]),
        (["lens", GAUSS, "--layout", "/no/such/folder/a.png"], ["--layout", "folder"]),
        (["lens", GAUSS, "--foc", "1"], ["--foc 1; did you mean '--focus'?"]),
        (["lens", GAUSS, "--aperture", "2"], ["--aperture 2; did you mean '--f-number'?"]),  # as other programs say
        (["stmap", GAUSS, "--resolution", "64"], ["--resolution 64; did you mean '--width'?"]),
        (["render", "room"], ["--camera: got (missing)", "one scene and one camera"]),
        (["render", "room", GAUSS], ["SCENE: got '", "one scene and one camera"]),
        (["render", "rom"], ["'rom'", "lights", "did you mean 'room'?"]),
        (["render", "room", "--lens", "no_lens"], ["no_lens", "missing"]),  # --lens is --camera, and the other way
        (["plan", "room", "--camera", "no_lens"], ["no_lens", "missing"]),
        (["render", "room", "--tilt", "3"], ["did you mean '--film-tilt'?"]),
        (["evaluate", GAUSS], ["MODEL: got '", "an exported model (.onnx)"]),
        (["render", "room", "--fnumber=2"], ["--fnumber=2; did you mean '--f-number'?", "neurolens render --help"]),
        (["lens", GAUSS, "-o", "a.toml"], ["-o"]),
        (["lens", GAUSS, "--derive-rims", "--layout", "a.png"], ["--layout"]),
        (["lens", GAUSS, "lenses", "--efl", "20"], ["--focal-length", "one lens file"]),
        (["lens", GAUSS, "no_such_folder"], ["no_such_folder", "lens file"]),
        (["lens", "list", "--focus", "2", "--blades", "5", "--focal-length", "20"], ["--focus"]),
        (["lens", "list", "--focusing", "paraxial"], ["--focus-mode"]),
        (["lens", PHONE, "--edge-pupil", "0.4"], ["--edge-pupil"]),
        (["lens", PHONE, "--derive-rims", "--f-number", "8"], ["--f-number"]),
        (["lens", PHONE, "--efl", "1e300"], ["0.001 to 1e+06"]),
        (["train", "--quiet"], ["EXPERIMENT.toml", "--lens"]),
        (["train", "a.toml", "--lens", GAUSS], ["both"]),
        (["train", "--lens", "no.toml"], ["no.toml"]),
        (["train", "no.toml"], ["no.toml", "missing"]),
        (["train", "--lens", GAUSS, "--output", GAUSS], ["--output", "folder"]),
    ],
)
def test_a_mistake_is_one_line(args: list[object], words: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    line = failure(capsys, *args)
    assert line.startswith("neurolens") and all(word in line for word in words), line


@pytest.mark.parametrize(
    ("args", "words"),
    [
        (["--camera", "squid"], ["squid", "any format", ".onnx", "thin", "pinhole"]),
        (["--camera", "no.onnx"], ["no.onnx", "missing"]),
        (["--camera", "no.toml"], ["no.toml", "missing"]),
        (["--camera", "thin", "--samples", "0"], ["--samples", "from 1"]),
        (["--camera", "thin", "--seed", "x"], ["--seed", "integer"]),
        (["--camera", "thin", "--exposure", "1e9"], ["--exposure", "stops", "-40 to 40"]),
        (["--camera", "thin", "--focus", "0.1"], ["focus_m", "focal lengths"]),
        (["--camera", "thin", "--zoom", "72mm"], ["zoom", "lens file"]),
        (["--camera", "pinhole", "--blades", "5"], ["aperture", "lens files"]),
        (["--camera", "pinhole", "--film-offset", "1"], ["film_offset_mm"]),
        (["--camera", "thin", "--film", "36e6x24e6"], ["--film", "0.001 to 10000"]),
        (["--camera", "thin", "--blades", "2"], ["--blades", "from 3 to 100"]),
        (["--camera", "thin", "--blade-rotation", "10"], ["blades", "missing"]),
        (["--camera", "thin", "--aperture-mask", "no.png"], ["no.png", "a picture that exists"]),
        (["--camera", "thin", "--focusing", "internal"], ["focus", "lens files"]),
        (["--camera", "thin", "--efl", "50", "--field", "40"], ["--field", "not allowed"]),
        (["--camera", "thin", "--width", "32", "--height", "32"], ["shape of the film"]),
        (["--camera", "thin", "-o", "a.png"], ["--output", ".exr"]),
        (["--camera", "thin", "-o", "/no/such/folder/a.exr"], ["folder"]),
        ([], ["--camera"]),
    ],
)
def test_a_mistake_in_a_render_is_one_line_and_leaves_no_file(
    args: list[str], words: list[str], scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    line = failure(capsys, "render", scene, "-o", tmp_path / "a.exr", "--quiet", *args)
    assert all(word in line for word in words), line
    assert not list(tmp_path.glob("*.exr")) and not list(tmp_path.glob("*.png"))


# lens


def test_names_cannot_command_a_terminal(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file, text = tmp_path / "a.toml", SINGLET.read_text(encoding="utf-8")
    named = 'name = "A \\\\u001b]0;lens\\\\u0007\\\\u009b2J"'
    file.write_text(re.sub('name = ".*"', named, text, count=1), encoding="utf-8")
    for more in ((), ("--json",)):
        assert main(["lens", str(file), *more]) == 0
        out = capsys.readouterr().out
        assert not set(out) & set("\x1b\x07\x9b") and "\\u001b]0;lens\\u0007\\u009b2J" in out


@pytest.mark.parametrize("name", ["muller_fisheye_100", "cooke_anamorphic_42", *whole(*DESCRIBED)])
def test_lens_describes_a_lens(name: str) -> None:
    data = described(ROOT / "lenses" / f"{name}.toml")
    assert data["efl_mm"] > 0 and data["film_z_mm"] > 0 and data["image_radius_mm"] > 0
    assert data["f_number"] == pytest.approx(data["efl_mm"] / data["entrance_pupil_diameter_mm"])
    assert data["focus_mode"] == "best"  # at infinity, near the rear focal point
    assert data["film_z_mm"] == pytest.approx(data["rear_focal_z_mm"], abs=0.1 * data["efl_mm"])
    assert 0.2 < data["passing_share"] < 1
    blocked = sum(part["share"] for part in data["ended"])
    assert data["passing_share"] + blocked == pytest.approx(1, abs=3e-3)
    assert sum(s["stop"] for s in data["surfaces"]) == 1
    # In air the real marginal ray meets the sine condition to within the spherical aberration of these lenses.
    assert data["working_f_number"] == pytest.approx(data["f_number"], rel=0.12)
    assert data["focus_m"] == "infinity"


def test_lens_tells_once_what_its_reader_warns_of(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file, text = tmp_path / "a.toml", SINGLET.read_text(encoding="utf-8")
    file.write_text(text.replace("n_d = ", 'glass = "XY-9", n_d = '), encoding="utf-8")
    told = " ".join(run_json(capsys, "lens", file)["warnings"])
    assert told.count("glass: glass XY-9 is not in the catalogue") == 1 and str(file) not in told


def test_lens_list_is_a_table_of_a_folder(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A good lens, one with a slip of the pen, and a file that is no lens."""
    table = SINGLET.read_text()
    (tmp_path / "good.toml").write_text(table)
    (tmp_path / "slip.toml").write_text(table.replace("radius_mm =  50.6", "radius_mm =  60.5"))
    (tmp_path / "none.toml").write_text("schema = 1\n")
    data = run_json(capsys, "lens", "list", tmp_path)
    rows = {row["lens"]: row for row in data["lenses"]}
    assert [rows[name]["verdict"] for name in ("good", "slip", "none")] == ["ok", "doubtful", "unreadable"]
    assert rows["good"]["refractions"] == 2 and rows["good"]["efl_mm"] == pytest.approx(49.8, abs=0.1)
    assert any("the focal length is 54" in doubt for doubt in rows["slip"]["doubts"])
    assert rows["none"]["doubts"]
    assert main(["lens", "list", str(tmp_path)]) == 0
    text = capsys.readouterr().out
    assert "3 lenses, 2 of them doubtful" in text and "slip: the focal length is 54" in text


def test_lens_reads_many_files_of_any_format_unchecked(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A folder with another inside, a file and a name that ships: a line for each, in their order.

    The stated focal length that does not hold is for the check of "list"; what a reader warns of is told.
    """
    (tmp_path / "inner").mkdir()
    (tmp_path / "inner" / "slip.toml").write_text(SINGLET.read_text().replace("radius_mm =  50.6", "radius_mm =  60.5"))
    (tmp_path / "none.zmx").write_text("MODE SEQ\nSURF 0\n")
    shutil.copy(ROOT / "experiments" / "fuzz_seeds" / "lens.zmx", tmp_path / "some.ZMX")
    rows = run_json(capsys, "lens", tmp_path, TESSAR, "laikin_double_gauss_50")["lenses"]
    assert [row["lens"] for row in rows] == ["slip", "none", "some", TESSAR.stem, GAUSS.stem]
    assert [row["verdict"] for row in rows] == ["read", "unreadable", "read", "read", "read"]
    alone = run_json(capsys, "lens", GAUSS)
    assert [rows[-1][key] for key in ("efl_mm", "back_focus_mm")] == [alone[key] for key in ("efl_mm", "back_focus_mm")]
    assert rows[1]["doubts"] and not rows[0]["doubts"] and not rows[0]["checks"]
    assert any("no f-number is stated" in text for text in rows[2]["notes"]), rows[2]["notes"]
    assert main(["lens", str(tmp_path), "--glass", str(ROOT / "no.agf")]) == 2
    assert main(["lens", str(tmp_path)]) == 0
    text = capsys.readouterr().out
    assert "3 lenses, 1 of them doubtful or unreadable" in text and "none: " in text


def test_lens_derives_rims_and_writes_only_where_asked(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "tessar.toml"
    assert main(["lens", str(TESSAR), "--derive-rims"]) == 0
    assert "Nothing is written" in capsys.readouterr().out
    data = run_json(capsys, "lens", TESSAR, "--derive-rims", "--edge-pupil", "0.8", "--half-field", "20", "-o", out)
    assert data["vignetting"] == 0.8 and len(data["rims"]) == 8
    written = out.read_text()
    assert 'rims = "derived"' in written and "80% of the pupil" in written and "20 degrees" in written
    diameters = [row["diameter_mm"] for row in run_json(capsys, "lens", out)["surfaces"]]
    assert diameters == [rim["derived_mm"] for rim in data["rims"]]


def test_lens_state_is_applied(capsys: pytest.CaptureFixture[str]) -> None:
    # The Laikin double Gauss has 12 refractions and is a 50 mm lens that covers 24 x 36 mm.
    data = described(GAUSS)
    assert data["refractions"] == 12 and data["efl_mm"] == pytest.approx(49.64, abs=0.01)
    assert data["half_field_reached_deg"] == pytest.approx(23.5, abs=1.5)  # atan(21.6 / 49.64), and its distortion
    data = run_json(capsys, "lens", ZOOM, "--zoom", "135mm", "--f-number", "5.6", "--focus", "5")
    assert data["efl_mm"] == pytest.approx(135, rel=0.01)
    assert data["f_number"] == pytest.approx(5.6)
    assert data["film_z_mm"] > data["rear_focal_z_mm"]
    # The working f-number grows with the magnification, f / (5 m - f).
    assert data["working_f_number"] > 5.6
    assert run_json(capsys, "lens", GAUSS, "--efl", "35")["efl_mm"] == pytest.approx(35)


# render


@pytest.mark.parametrize("camera", ["thin", "pinhole", GAUSS], ids=["thin", "pinhole", "lens"])
def test_render_writes_the_picture_with_its_settings(
    camera: object, scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "ball.exr"
    data = run_json(capsys, "render", scene, "--camera", camera, "-o", out, "--samples", "16", "--quiet")
    picture, metadata = read_exr(out)
    assert picture.shape == (18, 32, 3)
    # Radiance 1 gives 1 in the middle of the film of every camera.
    assert picture[7:11, 14:18].mean() == pytest.approx(1, rel=0.15)
    assert (data["width"], data["height"], data["samples"]) == (32, 18, 16)
    assert metadata["render"]["samples"] == 16 and metadata["camera"] == data["camera"]
    assert metadata["camera"]["f_number"] == pytest.approx(4.0)
    assert Path(data["preview"]).read_bytes().startswith(b"\x89PNG")


def test_render_shapes_the_stop_by_the_command_line_over_the_scene(
    scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    bladed = scene.with_name("bladed.toml")
    bladed.write_text(scene.read_text().replace("[camera]", "[camera]\nblades = 6\nblade_rotation_deg = 15.0"))
    out = ("--camera", "thin", "-o", tmp_path / "a.exr", "--quiet", "--samples", "1")
    assert run_json(capsys, "render", bladed, *out)["camera"]["aperture"]["blades"] == 6
    shaped = run_json(capsys, "render", bladed, *out, "--blades", "5", "--blade-curvature", "0.5")
    assert shaped["camera"]["aperture"] == {"blades": 5, "rotation_deg": 0.0, "curvature": 0.5}


def test_a_camera_says_that_a_stop_is_wider_than_the_lens_has(
    scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The rims then vignette; a scene's f-number becomes the widest."""
    words = ["render", str(scene), "--camera", str(TRIPLET), "--samples", "1", "-o", str(tmp_path / "a.exr")]
    scene.write_text(scene.read_text().replace("f_number = 4.0", "f_number = 1.0"))
    for more, said in (("1", True), ("5", False), (None, False)):
        assert main([*words, *(["--f-number", more] if more else [])]) == 0
        assert ("the stop gives f/1, wider than the f/5 of the source" in capsys.readouterr().err) == said


@pytest.mark.parametrize("words", [["lens"], ["analyse", "seidel"]])
def test_a_stop_wider_than_the_lens_has_is_told_once(words: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    """f/4.8 is within the 5% by which sources round."""
    for number, times in ((1, 1), (4.8, 0)):
        assert main([words[0], str(TRIPLET), *words[1:], "--f-number", str(number)]) == 0
        said = "".join(capsys.readouterr())
        assert said.count("the stop gives f/1, wider than the f/5 of the source") == times


def test_a_width_alone_is_enough(scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Of 36 x 24 mm, 16 pixels across and 11 down are 3% off, and none are nearer."""
    common = ("render", scene, "--camera", "thin", "--film", "36x24", "--samples", 1, "--quiet")
    for size in (("--width", 16), ("--height", 3)):
        data = run_json(capsys, *common, *size, "-o", tmp_path / "a.exr")
    assert (data["width"], data["height"]) == (4, 3)


# Signals and missing packages


def test_an_interrupt_says_what_is_kept(
    scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupted(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("neurolens.pictures.frames.render", interrupted)
    assert main(["render", str(scene), "--camera", "thin", "-o", str(tmp_path / "a.exr"), "--quiet"]) == 130
    assert "no picture was written" in capsys.readouterr().err
    assert not list(tmp_path.glob("*.exr"))


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP])
def test_what_ends_a_training_says_what_is_kept(
    number: int, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Without a handler SIGTERM and SIGHUP would end this process."""
    before = signal.signal(number, signal.SIG_DFL)
    monkeypatch.setattr("neurolens.studies.train.run_experiment", lambda *_, **__: signal.raise_signal(number))
    try:
        code = main(["train", "--lens", str(GAUSS), "--output", str(tmp_path / "run"), "--quiet"])
    finally:
        signal.signal(number, before)
    assert code == 128 + number
    assert "interrupted; fitted models are kept in the run folder" in capsys.readouterr().err


@pytest.mark.skipif(not hasattr(os, "openpty"), reason="no terminals here")
def test_what_is_said_after_a_terminal_was_closed_goes_nowhere() -> None:
    ours, theirs = os.openpty()
    code = (
        "import fcntl, signal, sys, termios, time\n"
        "from neurolens.base.tasks import handled\n"
        "signal.signal(signal.SIGHUP, signal.SIG_DFL)\n"  # nohup's children ignore it
        "asked = []\n"
        "with handled(asked.append):\n"
        "    fcntl.ioctl(1, termios.TIOCSCTTY, 0)\n"
        "    print('ready', flush=True)\n"
        "    while not asked: time.sleep(0.01)\n"
        "print('saved', file=sys.stderr, flush=True)\n"
        "sys.exit(128 + asked[0])\n"
    )
    process = subprocess.Popen(
        [sys.executable, "-c", code], stdin=theirs, stdout=theirs, stderr=theirs, start_new_session=True, cwd=ROOT
    )
    os.close(theirs)
    assert os.read(ours, 100).startswith(b"ready")
    os.close(ours)
    assert process.wait(60) == 128 + signal.SIGHUP


@pytest.mark.parametrize("begin", ["from neurolens.cli import main; main()", "import neurolens.__main__"])
def test_an_interrupt_while_the_packages_are_read_is_one_line(begin: str) -> None:
    code = (
        "import sys\n"
        "class Interrupt:\n"
        "    def find_spec(self, name, *_):\n"
        "        if name == 'neurolens.cli.lens': raise KeyboardInterrupt\n"
        "sys.meta_path.insert(0, Interrupt())\n"
        f"{begin.replace('main()', 'sys.exit(main())')}"
    )
    found = python(code, "lens", "--help")
    assert (found.returncode, found.stdout) == (130, "")
    assert found.stderr.strip() == "neurolens: interrupted; nothing was done"


@pytest.mark.parametrize(
    ("when", "error"),
    [("neurolens.cli.lens", "ImportError('a C extension')"), ("numpy", "SystemError('error return')")],
)
def test_a_signal_that_a_package_turns_into_its_own_error_is_an_interrupt(when: str, error: str) -> None:
    """As C extensions do, whose start the signal ends: it was called a fault of neurolens."""
    code = (
        "import os, signal, sys\n"
        "class Terminated:\n"
        "    def find_spec(self, name, *_):\n"
        f"        if name == '{when}':\n"
        "            try: signal.raise_signal(signal.SIGTERM)\n"
        f"            except KeyboardInterrupt: raise {error}\n"
        "sys.meta_path.insert(0, Terminated())\n"
        "from neurolens.cli import main; sys.exit(main())"
    )
    found = python(code, "lens", "lenses/cooke_triplet_50.toml")
    assert (found.returncode, found.stdout) == (143, "")
    assert found.stderr.startswith("\nneurolens: interrupted; ") and found.stderr.count("\n") == 2


def python(code: str, *args: object) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-c", code, *map(str, args)]
    return subprocess.run(command, capture_output=True, text=True, cwd=ROOT, check=False)


WITHOUT_TORCH = (
    "import sys; sys.modules.update(dict.fromkeys(['torch', 'matplotlib', 'sklearn']))\n"
    "from neurolens.cli import main; sys.exit(main(sys.argv[1:]))"
)


def test_without_torch_glass_is_found_lenses_are_converted_c_and_maps_are_written(scene: Path, tmp_path: Path) -> None:
    """And the thin lens and a lens file render."""
    file = ROOT / "models" / "laikin_double_gauss_50.ols-36.onnx"
    (tmp_path / "a.dat").write_text("# 50 mm\n30 5 1.5 20\n0 5 0 10\n-30 45 1 20\n")
    commands = [
        ["glass", "N-BK7"],
        ["convert", str(tmp_path / "a.dat"), "-o", str(tmp_path / "a.toml")],
        ["export", str(file), "--to", "c", "-o", str(tmp_path / "a.h"), "--name", "gauss"],
        ["stmap", str(file), "--size", "32x18", "--film", "32x18", "-o", str(tmp_path / "a")],
        *(
            ["render", str(scene), "--camera", c, "-o", str(tmp_path / "a.exr"), "--quiet"]
            for c in ("thin", str(GAUSS))
        ),
    ]
    done = python(WITHOUT_TORCH.replace("main(sys.argv[1:])", f"[main(c) for c in {commands!r}] != [0] * 6"))
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "a.exr").exists()
    assert "needs torch" in done.stdout and (tmp_path / "a.toml").exists() and (tmp_path / "a.h").exists()


# As an import finds nothing where no extra is installed; the entries None of WITHOUT_TORCH make find_spec raise.
BASE_INSTALL = """
import importlib.machinery as machinery, sys
from neurolens.base.errors import EXTRAS
class Lean(machinery.PathFinder):
    @classmethod
    def find_spec(cls, name, path=None, target=None):
        return None if name.partition(".")[0] in EXTRAS else super().find_spec(name, path, target)
sys.meta_path[:] = [Lean if finder is machinery.PathFinder else finder for finder in sys.meta_path]
from neurolens.cli import main
if __name__ == "__main__": sys.exit(main(sys.argv[1:]))
"""


@pytest.mark.parametrize(
    ("command", "extra"),
    [
        ("blender build --lens laikin_double_gauss_50 -o a.zip", "train"),
        ("blender build --no-exact --jobs 1 --lens laikin_double_gauss_50 -o a.zip", "train"),
        ("lens laikin_double_gauss_50", "train"),
        ("verify nikon_zoom_70_200", "train"),
        ("mitsuba {root}/experiments/scenes/spheres.xml --camera petzval_portrait_100.ols-64 -o a.exr", "mitsuba"),
        ("render {root}/experiments/scenes/room.toml --camera {model} --width 8 --dask local -o a.exr", "dask"),
        ("train {root}/experiments/quickstart.toml -o runs", "train"),
        ("plan {root}/experiments/scenes/room.toml --lens laikin_double_gauss_50 --budget 1px", "train"),
    ],
)
def test_in_a_base_install_a_command_names_the_extra_that_it_needs(command: str, extra: str, tmp_path: Path) -> None:
    """In one line, before work: no shader is made first, and no missing package is called a fault."""
    words = command.format(root=ROOT, model=ROOT / "models" / "laikin_double_gauss_50.ols-36.onnx").split()
    (tmp_path / "base.py").write_text(BASE_INSTALL)
    done = subprocess.run(
        [sys.executable, "base.py", *words], cwd=tmp_path, capture_output=True, text=True, check=False,
        env={**os.environ, "PYTHONPATH": str(ROOT), "XDG_CACHE_HOME": str(tmp_path)},
    )  # fmt: skip
    assert done.returncode == 2 and f"pip install '.[{extra}" in done.stderr, done.stderr
    assert len(done.stderr.splitlines()) == 1 and not (tmp_path / "a.zip").exists(), done.stderr


def test_a_reader_that_leaves_is_no_error(scene: Path, tmp_path: Path) -> None:
    render = ["render", scene, "--camera", "thin", "-o", tmp_path / "a.exr", "--quiet"]
    command = [sys.executable, "-m", "neurolens", *render]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, cwd=ROOT) as process:
        assert process.stdout is not None and process.stderr is not None
        process.stdout.close()
        assert process.stderr.read() == ""
        assert process.wait() == 141


# A model that ships, of a triplet at f/2.7


def test_evaluate_confirms_a_card_on_fresh_rays(capsys: pytest.CaptureFixture[str]) -> None:
    data = run_json(capsys, "evaluate", MODEL, "--rays", 1000)
    assert data["holds"] and data["lens"]["id"] == TRIPLET.stem
    assert 0 < data["rms_um"] <= data["p99_um"] <= data["max_um"]
    assert data["direction_rms_deg"] > 0 and 0 <= data["false_pass"] < 0.02 and data["ns_per_ray"]["min"] > 0


def test_evaluate_exits_1_where_a_promise_does_not_hold(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    promising = edited(MODEL, tmp_path / "promising.onnx", lambda card: card["errors"].update(rms_um=1e-3))
    assert main(["evaluate", str(promising), "--rays", "1000"]) == 1
    assert "Does not hold: rms_um." in capsys.readouterr().out


def test_another_lens_and_a_file_that_is_no_model_are_refused(
    scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    line = failure(capsys, "evaluate", MODEL, "--lens", GAUSS)
    assert GAUSS.name in line and "sha256" in line
    broken = tmp_path / "broken.onnx"
    broken.write_bytes(b"not a model")
    assert "broken.onnx" in failure(capsys, "evaluate", broken)
    assert "broken.onnx" in failure(capsys, "render", scene, "--camera", broken, "-o", tmp_path / "a.exr", "--quiet")


def test_render_through_a_model_needs_no_torch_and_keeps_its_card(
    scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "model.exr"
    done = python(WITHOUT_TORCH, "render", scene, "--camera", MODEL, "--f-number", 8, "--samples", 16, "-o", out)
    assert done.returncode == 0, done.stderr
    picture, metadata = read_exr(out)
    assert picture[7:11, 14:18].mean() == pytest.approx(1, rel=0.15)
    assert TRIPLET.stem in json.dumps(metadata["camera"])
    # A scene that asks for more than the model's widest stop gets that one; the command line is refused.
    widest = read_card(MODEL)["lens"]["f_number"]
    wide = scene.with_name("wide.toml")
    wide.write_text(scene.read_text().replace("f_number = 4.0", "f_number = 1.0"))
    data = run_json(capsys, "render", wide, "--camera", MODEL, "-o", out, "--quiet")
    assert data["camera"]["f_number"] == pytest.approx(widest, rel=1e-3)
    for args, words in (
        (["--focus", "0.3"], ["focus", "0.3"]),
        (["--f-number", "1"], ["f_number", "1"]),
        (["--focal-length", "35"], ["focal_length_mm", "lens files"]),
    ):
        line = failure(capsys, "render", scene, "--camera", MODEL, "-o", out, "--quiet", *args)
        assert all(word in line for word in words), line


def test_values_take_the_units_that_people_type(capsys: pytest.CaptureFixture[str]) -> None:
    """Every option with a unit: what a shell passes, in the unit of the setting."""
    parse = build_parser().parse_args
    found = parse("render a.toml --camera thin -o a.exr --focus 6ft --focal-length 2in --f-number f/2".split())
    assert (found.focus_m, found.focal_length_mm, found.f_number) == (1.8288, 50.8, 2.0)
    assert parse("render a.toml --camera thin -o a.exr --width 3840x2160".split()).height == 2160
    for film, mm in (
        ("super35", (24.89, 18.66)),
        ("Super-35", (24.89, 18.66)),
        ("36mm x 2.4cm", (36.0, 24.0)),
        ("36*24", (36.0, 24.0)),
    ):
        assert parse(["flare", str(GAUSS), "--film", film]).film == mm
    assert parse(f"lens {GAUSS} --focus 200cm".split()).focus_m == 2.0
    found = parse(["lens", str(GAUSS), "--focus", "6'", "--f-number", "1:2.8"])
    assert (found.focus_m, found.f_number) == (1.8288, 2.8)
    assert [in_unit("m", float)(f"3 {mu}m") for mu in "\u00b5\u03bc"] == [3e-6, 3e-6]
    assert "6ft or inf, in metres" in failure(capsys, "lens", GAUSS, "--focus", "2kg")
    for film in ("superb", "35", "0x24"):
        said = failure(capsys, "flare", GAUSS, "--light", "1,1", "--film", film)
        assert f"got '{film}', expected the film's width x height in mm, as in 36x24" in said
    assert "the film sets the height" in failure(capsys, "flare", GAUSS, "--light", "1,1", "--width", "384x216")


def test_train_takes_the_name_of_a_lens(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    """As --lens; a name that is neither is told with the nearest lens."""
    seen: list[tuple[object, Path | None]] = []
    monkeypatch.setattr(Train, "_train", lambda self, file, out, _: seen.append((self.experiment, file)) or (file, {}))
    monkeypatch.setattr(Train, "answer", lambda *args: 0)
    assert main(["train", "cooke_triplet_50"]) == 0
    assert [(experiment, file.stem) for experiment, file in seen] == [(None, "cooke_triplet_50")]
    assert "cooke_triplet_50" in failure(capsys, "train", "cokoe_triplet_50")


# Help

PARSERS = next(a for a in build_parser()._actions if isinstance(a, argparse._SubParsersAction)).choices


@pytest.mark.parametrize("name", PARSERS)
def test_help_has_the_options_that_most_need_and_an_example_and_help_all_the_others(
    name: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    parser, said = PARSERS[name], {}
    for word in ("--help", "--help-all"):
        with pytest.raises(SystemExit) as ended:
            main([name, word])
        said[word] = capsys.readouterr().out
        assert ended.value.code == 0
    options = {a.option_strings[-1]: a for a in parser._actions if a.option_strings and a.help != argparse.SUPPRESS}
    shown = {o for o in options if re.search(rf"^  (-\w[^,]*, )?{o}\b", said["--help"], re.MULTILINE)} - {"--help"}
    assert len(shown) <= 10 and {o for o, a in options.items() if a.required} <= shown
    assert all(re.search(rf"^  (-\w[^,]*, )?{o}\b", said["--help-all"], re.MULTILINE) for o in options)
    assert len(said["--help"].splitlines()) <= 60
    if name not in ("blender", "demo"):
        example = first_example(parser.epilog)
        assert example.splitlines()[0] in said["--help"]
        monkeypatch.chdir(ROOT)
        program, *words = shlex.split(example.replace("\\\n", " ").rpartition("&& ")[2], comments=True)
        assert program == "neurolens" and build_parser().parse_args(words)


@pytest.mark.parametrize("name", ["find", "glass", "lens", "models"])
def test_the_example_of_the_help_runs(
    name: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(ROOT)  # they write nothing; those that write run in the README, in test_page_commands.py
    assert main(shlex.split(first_example(PARSERS[name].epilog))[1:]) == 0
    assert capsys.readouterr().out


def test_a_scene_that_ships_is_found_by_name_or_path_and_a_file_here_comes_first(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    shipped = ROOT / "experiments" / "scenes" / "room.toml"
    assert scene_file("room") == scene_file("experiments/scenes/room.toml") == shipped
    (tmp_path / "room").touch()
    assert scene_file("room") == Path("room") and scene_file("no-such.toml") == Path("no-such.toml")


def test_a_converted_lens_is_scaled_as_commands_scale_it(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """And is a product no more."""
    out = tmp_path / "long.toml"
    run_json(capsys, "convert", ROOT / "lenses/sony_sonnar_55.toml", "--focal-length", "85", "-o", out)
    own, scaled = described(out), run_json(capsys, "lens", ROOT / "lenses/sony_sonnar_55.toml", "--focal-length", "85")
    for key in ("efl_mm", "film_z_mm", "f_number", "t_stop", "image_radius_mm"):
        assert own[key] == pytest.approx(scaled[key], rel=1e-9)
    written = out.read_text(encoding="utf-8")
    assert "at 85 mm" in written and "believed_to_be" not in written and "[measured]" not in written
