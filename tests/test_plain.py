"""The plain line: each command with nothing but what it is about gives its result, and says what it assumed."""

import math
import shlex
from argparse import _SubParsersAction
from pathlib import Path

import numpy as np
import pytest
from command_line import failure

from neurolens.base.errors import program
from neurolens.cli import build_parser, main
from neurolens.cli.defocus import Defocus
from neurolens.optics.lens.shot import FILMS, film_size, film_within
from neurolens.pictures.render.pictures import write_channels

ROOT = Path(__file__).parents[1]
COMMANDS = next(a for a in build_parser()._actions if isinstance(a, _SubParsersAction)).choices
MODEL, LENS = "laikin_double_gauss_50.ols-36", "cooke_triplet_50"
FULL = "--film 36x24 (fullframe, which the lens covers)"
TRIPLET = "--film 24.89x18.66 (super35, which the lens covers)"
# The line, smaller by its own options; what is said to be assumed; a file that is written.
TRIPLET_SEQ = """\
RDM
TITLE 'Triplet'
EPD 10
DIM M
WL 587.56
YAN 0 14
SO 0 1e20
S 22.01359 3.25896 SK16_SCHOTT
S -435.76044 6.00755
S -22.21328 0.99997 F2_SCHOTT
S 20.29192 4.75041
  STO
S 79.6836 2.95208 SK16_SCHOTT
S -18.39533 42.20778
SI 0 0
GO
"""
PLAIN: dict[str, tuple[str, str, str]] = {
    "find": ("petzval", "", ""),
    "lens": (LENS, "", ""),
    "analyse": (f"{LENS} distortion", "", ""),
    "glass": ("N-BK7", "", ""),
    "models": ("", "", ""),
    "convert": ("triplet.seq", "--output triplet.toml", "triplet.toml"),
    "view": (f"{LENS} --downloads glsl", "", "view.html"),
    "render": (
        f"scenes/room.toml --camera {MODEL} --width 8 --samples 1",
        "--output room-laikin_double_gauss_50_ols-36-render.exr",
        "room-laikin_double_gauss_50_ols-36-render.png",
    ),
    "flare": (
        f"{LENS} --bins 2",
        f"{TRIPLET}, --output {LENS}-flare.exr, --light 7.09,5.33, --quick",
        f"{LENS}-flare.png",
    ),
    "defocus": (
        f"plate.exr --lens {MODEL} --samples 8",
        "--film 36x18 (the shape of plate.exr within 36x24 (fullframe, which the lens covers)), "
        "--output plate-laikin_double_gauss_50_ols-36-defocus.exr, --focus 3.06 (what the middle of the plate shows)",
        "plate-laikin_double_gauss_50_ols-36-defocus.png",
    ),
    "bokeh": (f"{MODEL} --grid 1x1", f"{FULL}, --output laikin_double_gauss_50_ols-36-bokeh, --width 1920", ""),
    "stmap": (
        f"{MODEL} --width 48",
        f"{FULL}, --output laikin_double_gauss_50_ols-36-stmap",
        "laikin_double_gauss_50_ols-36-stmap.redistort.exr",
    ),
    "projection": (MODEL, f"{FULL}, --width 1920", ""),
    "handover": (
        f"{MODEL} --width 48",
        f"{FULL}, --output laikin_double_gauss_50_ols-36-handover",
        "laikin_double_gauss_50_ols-36-handover/README.md",
    ),
    "copies": (
        f"{LENS} --number 1",
        f"--output {LENS}-copies",
        f"{LENS}-copies/{LENS}-001.toml",
    ),
    "psf": (
        f"{LENS} --grid 1x1",
        f"{TRIPLET}, --output {LENS}-psf.npz, --pixel-um 4.15",
        f"{LENS}-psf.npz",
    ),
    "rays": (
        f"{MODEL} --samples 1",
        f"{FULL}, --output laikin_double_gauss_50_ols-36-rays.npz, --width 480",
        "laikin_double_gauss_50_ols-36-rays.npz",
    ),
    "export": (MODEL, "--output laikin_double_gauss_50_ols-36-export.h", "laikin_double_gauss_50_ols-36-export.h"),
    "demo": ("--width 8 --samples 1", "", "neurolens-demo/index.html"),
    "survey": ("patents --no-fit", "", "runs/survey/survey.html"),
    "evaluate": (f"{MODEL} --rays 1000", "", ""),
    "verify": ("sony_sonnar_55", "", ""),
}
# Why the plain line of the others is not run here.
ELSEWHERE = {
    "train": "it fits for a minute; runs of smaller settings are in tests/studies",
    "plan": "it takes ten seconds, which tests/studies/test_plan.py spends once",
    "rims": "it fits for ten seconds, which tests/optics/photographs spends once",
    "blender": "it compiles for minutes; tests/programs/blender runs it with small lenses",
    "mitsuba": "it takes a program from elsewhere",
}


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    return tmp_path


def plate(path: Path, depth: np.ndarray) -> Path:
    grey = np.full(depth.shape, 0.5, np.float32)
    write_channels(path, {**dict.fromkeys("RGB", grey), "Z": depth.astype(np.float32)}, None, {})
    return path


def test_every_command_has_a_plain_line() -> None:
    assert PLAIN.keys() | ELSEWHERE.keys() == set(COMMANDS) and not PLAIN.keys() & ELSEWHERE.keys()


@pytest.mark.parametrize("name", PLAIN)
def test_the_plain_line_works_and_says_what_it_assumed(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    words, assumed, written = PLAIN[name]
    Path("scenes").symlink_to(ROOT / "experiments" / "scenes")
    Path("triplet.seq").write_text(TRIPLET_SEQ)
    Path("patents").mkdir()
    Path("patents", "triplet.seq").write_text(TRIPLET_SEQ)
    plate(Path("plate.exr"), np.full((6, 12), 3.0))
    assert main([name, *words.split()]) == 0
    said = capsys.readouterr().err.splitlines()
    lines = [line for line in said if "assumed: " in line and "--distance" not in line]
    assert lines == ([f"neurolens: assumed: {assumed}"] if assumed else [])
    assert not written or Path(written).stat().st_size


ALONE = {"demo", "models", "view"}  # which do something without any word
ACTIONS = [["blender", "build"], ["blender", "add"]]


@pytest.mark.parametrize("words", [[name] for name in COMMANDS if name not in ALONE] + ACTIONS, ids=" ".join)
def test_a_command_alone_says_what_it_does_and_gives_an_example_that_runs(
    words: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    """Whose inputs ship or are made by the line itself."""
    with pytest.raises(SystemExit) as ended:
        main(words)
    about, example = capsys.readouterr().err.splitlines()
    assert ended.value.code == 2 and about.endswith(".") and 20 < len(about) < 250, about
    lines = example.removeprefix("Example: ").split(" && ")
    made = set[str]()
    for line in lines:
        _, *words_of_line = shlex.split(line.replace(program(), "neurolens"))
        args = vars(build_parser().parse_args(words_of_line))
        for name in ("scene", "file", "folder", "plate") if words != ["mitsuba"] else ():  # Mitsuba has its own scene
            for path in args[name] if isinstance(args.get(name), tuple | list) else [args.get(name)]:
                assert path is None or (ROOT / path).exists() or str(path) in made, line
        made.add(str(args.get("output")))
    assert lines[-1].replace(program(), "neurolens").startswith(f"neurolens {words[0]} ")


def test_view_alone_shows_six_lenses(monkeypatch: pytest.MonkeyPatch) -> None:
    """Whose page takes half a minute, without shaders for Cycles, which take an hour."""
    seen = []
    monkeypatch.setattr("neurolens.cli.view.View.run", lambda self: seen.append(self) or 0)
    assert main(["view"]) == 0
    assert len(seen[0].lenses) == 6 and all(file.is_file() for file in seen[0].lenses)
    assert seen[0].downloads == ("glsl", "onnx", "c")
    assert seen[0].told.startswith("assumed: --downloads glsl,onnx,c, LENS laikin_double_gauss_50, petzval_")


def test_quiet_says_nothing(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["export", MODEL, "--quiet"]) == 0
    assert capsys.readouterr().err == ""


@pytest.mark.parametrize("made", ["laikin_double_gauss_50_ols-36-export.h"])
def test_a_folder_of_that_name_is_not_written_over(made: str, capsys: pytest.CaptureFixture[str]) -> None:
    Path(made).mkdir()
    assert made in failure(capsys, "export", MODEL)


@pytest.mark.parametrize(
    ("radius_mm", "film"),
    [
        (21.6, (36, 24)), (21.64, (36, 24)), (14.2, (23.6, 15.7)), (13.66, (22.3, 14.9)), (10.815, (17.3, 13)),
        (27.35, (43.8, 32.9)), (15.57, (24.89, 18.66)), (3.5, (5.6, 4.2)), (1e6, (120, 96)),
    ],
)  # fmt: skip
def test_a_lens_covers_the_format_that_it_is_made_for(radius_mm: float, film: tuple[float, float]) -> None:
    """Full frame, APS-C of Fujifilm, Sony and of Canon, Four Thirds, 44 x 33 mm, Super 35, a phone."""
    assert film_within(radius_mm)[0] == film


@pytest.mark.parametrize("radius_mm", [1e-3, 0.5, 3.4])
def test_a_smaller_circle_gets_a_film_of_3_to_2_inside_it(radius_mm: float) -> None:
    (width, height), name = film_within(radius_mm)
    assert name == "" and np.hypot(width, height) / 2 == pytest.approx(radius_mm, rel=1e-2)
    assert width / height == pytest.approx(1.5, rel=1e-2)


def test_films_fall_in_size() -> None:
    """And each is within the circle of the one before, so that the largest that fits is the first that does."""
    sizes = [np.hypot(*film_size(name)) for name in FILMS]
    assert sizes == sorted(sizes, reverse=True)


@pytest.mark.parametrize(
    ("depth_m", "options", "focus_m", "said"),
    [
        (2.0, "--depth-from film", 2.0, "what the middle of the plate shows"),
        (2.0, "", 2.06, "what the middle of the plate shows"),  # and the pinhole lies 61 mm before the film
        (2000.0, "--depth-from film --depth-scale 0.001", 2.0, "what the middle of the plate shows"),
        (np.inf, "", math.inf, "what the middle of the plate shows"),
        (0.2, "--depth-scale 1", 0.7, "the nearest of the lens; what the middle of the plate shows is nearer"),
    ],
)
def test_a_plate_is_focused_on_its_middle(depth_m: float, options: str, focus_m: float, said: str) -> None:
    """Whatever is nearer or farther around it; and no nearer than the lens can."""
    depth = np.full((9, 18), 30.0)
    depth[3:6, 6:12] = depth_m
    words = ["defocus", str(plate(Path("a.exr"), depth)), "--lens", MODEL, *options.split()]
    made = COMMANDS["defocus"].parse_args(words[1:])
    found = Defocus.of(made)
    assert found.state.given.focus_m == pytest.approx(focus_m, abs=0.01) and f"({said})" in found.told


def test_a_second_run_says_that_it_writes_over_the_first(capsys: pytest.CaptureFixture[str]) -> None:
    for said in ("-rays.npz\n", "-rays.npz (written over)\n"):
        assert main(["rays", MODEL, "--samples", "1", "--width", "8"]) == 0
        assert said in capsys.readouterr().err
