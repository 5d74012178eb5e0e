"""The Python front: calls take what commands take and give what they give, and lenses as objects keep to optics."""

import inspect
import json
import math
import re
import runpy
import subprocess
import sys
from argparse import SUPPRESS, _SubParsersAction
from dataclasses import FrozenInstanceError
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tmm
from command_line import described, failure, run_json

import neurolens as nl
from neurolens.base.errors import InputError, NeurolensError, NeurolensWarning, Note
from neurolens.cameras.build import make_camera
from neurolens.cli import _FIRST, build_parser, command, main
from neurolens.cli.arguments import Reporting
from neurolens.cli.calls import signature_of
from neurolens.front import EXAMPLES
from neurolens.optics.lens.glass import LINE_D_NM, absorption_of, index_at, index_of
from neurolens.optics.lens.paraxial import first_order
from neurolens.optics.lens.shot import Shot
from neurolens.pictures.render import colour

ROOT = Path(__file__).parents[1]
GAUSS, MODEL = "laikin_double_gauss_50", "laikin_double_gauss_50.ols-36"
TRIPLET = "cooke_triplet_50"
COMMANDS = next(a for a in build_parser()._actions if isinstance(a, _SubParsersAction)).choices
CALLS = [name for name in COMMANDS if issubclass(command(name), Reporting)]
UNITS = "(_(mm|m|deg|nm|px|s|per_mm))?_?"  # at the end of a parameter; a word of Python has a further _
# Examples that take more than two seconds, or that stand on the page, too.
LONG = {"handover", "psf", "fit", "train", "plan", "verify", "bokeh", "analyse", "flare"}


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    (tmp_path / "experiments").symlink_to(ROOT / "experiments")
    monkeypatch.chdir(tmp_path)
    return tmp_path


# Commands and calls


@pytest.mark.parametrize("name", CALLS)
def test_a_call_has_the_options_of_its_command_and_their_defaults(name: str) -> None:
    shown = {a.dest: a for a in COMMANDS[name]._actions if a.help != SUPPRESS and a.dest not in ("help", "json")}
    found = signature_of(command(name)).parameters
    assert [p.rstrip("_") for p in found if p not in shown] in ([], ["for"])  # a word that Python keeps for itself
    assert len(found) == len(shown)
    for parameter, action in zip(sorted(found), sorted(shown.values(), key=lambda a: a.dest), strict=True):
        default = found[parameter].default
        assert default == (inspect.Parameter.empty if action.required and action.nargs != "*" else action.default)
        for option in action.option_strings[-1:]:
            assert re.fullmatch(option.removeprefix("--").replace("-", "_") + UNITS, parameter)


def test_a_call_answers_what_its_command_prints(capsys: pytest.CaptureFixture[str]) -> None:
    answer = nl.projection("thin", width=96, film=(36, 24), projection="opencv", focal_length_mm=28.5, output="a")
    assert capsys.readouterr().out == ""
    words = "projection thin --width 96 --film 36x24 --projection opencv --focal-length 28.5 -o a".split()
    assert run_json(capsys, *words) == json.loads(json.dumps(answer))
    assert main(words) == 0
    assert capsys.readouterr().out == f"{answer}\n" and answer.code == 0


def test_a_call_writes_what_its_command_writes(capsys: pytest.CaptureFixture[str]) -> None:
    answer = nl.render("experiments/scenes/room.toml", MODEL, width=16, samples=2, focus_m=2, output="a.exr")
    main(f"render experiments/scenes/room.toml --camera {MODEL} --width 16 --samples 2 --focus 2 -o b.exr".split())
    capsys.readouterr()
    assert answer.rgb.shape == (9, 16, 3) and answer.rgb.max() > 0
    assert Path("a.png").read_bytes() == Path("b.png").read_bytes() == answer._repr_png_()
    answer = nl.export(nl.load(MODEL), to="c", output="a.h", fix={"wavelengths": [550, 600], "f_number": 4})
    main(f"export {MODEL} --to c -o b.h --fix wavelengths=550,600 --fix f_number=4".split())
    assert Path("a.h").read_bytes() == Path("b.h").read_bytes()
    with pytest.raises(InputError, match="no picture"):
        _ = answer.rgb


@pytest.mark.parametrize(
    ("named", "words"),
    [
        ({"width": 0}, {"--width": "0"}),
        ({"width": 2.5}, {"--width": "2.5"}),
        ({"focus_m": math.nan}, {"--focus": "nan"}),
        ({"focus_m": [1, 2]}, {"--focus": "1,2"}),
        ({"film": (36,)}, {"--film": "36"}),
        ({"film": (36, -24)}, {"--film": "36x-24"}),
        ({"focal_length_mm": 50, "field_deg": 40}, {"--focal-length": "50", "--field": "40"}),
        ({"f_number": 0.01}, {"--f-number": "0.01"}),
        ({"f_number": 0.1}, {"--f-number": "0.1"}),  # wider than the model
        ({"focus_mode": "worst"}, {"--focus-mode": "worst"}),
        ({"output": Path("no/such/folder/a")}, {"--output": "no/such/folder/a"}),
        ({"aperture_mask": "no.png"}, {"--aperture-mask": "no.png"}),
    ],
)
def test_a_mistake_is_the_line_of_the_command(
    named: dict[str, Any], words: dict[str, str], capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(InputError) as caught:
        nl.stmap(MODEL, **{"width": 96, "film": (36, 24), "output": "a", "quiet": True} | named)
    given = {"--width": "96", "--film": "36x24", "--output": "a"} | words
    said = failure(capsys, "stmap", MODEL, "--quiet", *(f"{k}={v}" for k, v in given.items() if v))
    assert said.removeprefix("neurolens: ").partition(" (see ")[0] == str(caught.value)


def test_mistakes_that_only_a_call_can_make_are_one_line() -> None:
    for wrong, words in (
        (lambda: nl.stmap(MODEL, focus=2), "focus: got (unknown key)"),
        (lambda: nl.stmap(MODEL, focus=2), "did you mean 'focus_m'?"),
        (lambda: nl.stmap(MODEL, MODEL), "camera, each once"),
        (lambda: nl.stmap(MODEL, camera=MODEL), "camera, each once"),
        (lambda: nl.stmap(MODEL, lateral_colour="yes"), "--lateral-colour"),
        (lambda: nl.lens("laikin_duble_gauss_50"), "did you mean 'laikin_double_gauss_50'?"),
        (lambda: nl.lens(GAUSS, focus_m=0.1), "four focal lengths"),
        (lambda: nl.load(GAUSS), "an exported model (.onnx)"),
        (lambda: nl.verify(nl.lens(GAUSS, f_number=4)), "f_number: got (unknown key)"),
        (lambda: nl.fit(nl.lens(GAUSS, blades=5)), "blades"),
        (lambda: nl.train(lens=[nl.lens(GAUSS, f_number=4)]), "f_number: got (unknown key)"),
        (lambda: nl.lens(GAUSS).trace(np.zeros(6)), "an array (6, N)"),
        (lambda: nl.lens(GAUSS).trace(np.zeros((6, 3)), [500, 600]), "wavelength_nm"),
        (lambda: nl.lens("--help"), "LENS: --help"),
        (lambda: nl.analyse(GAUSS, ["--help"]), "WHAT: got '--help'"),
    ):
        with pytest.raises(ValueError, match=re.escape(words)) as caught:
            wrong()
        assert "\n" not in str(caught.value)


def test_an_interrupted_call_is_an_interrupt(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("neurolens.cli.export.Export.run", lambda self: 130)
    with pytest.raises(KeyboardInterrupt):
        nl.export(MODEL, to="c", output="a.h")


def test_several_answers_are_a_list(capsys: pytest.CaptureFixture[str]) -> None:
    picture = {"width": 8, "samples": 1, "output": "a.exr"}
    answer = nl.render("experiments/scenes/room.toml", "thin", frames="1:2", key="focus=1:1,2:3", **picture)
    assert [Path(one["file"]).name for one in answer["pictures"]] == ["a.0001.exr", "a.0002.exr"]


# Lenses, cameras and models


def test_the_figures_of_a_lens_are_those_of_its_command_and_of_its_rays() -> None:
    lens, said = nl.lens(GAUSS), described(ROOT / "lenses" / f"{GAUSS}.toml")
    assert lens.focal_length_mm == pytest.approx(said["efl_mm"], rel=1e-12)
    assert lens.f_number == pytest.approx(said["f_number"], rel=1e-12)
    # A ray close to the axis from infinity leaves with the slope -h / f.
    found = lens.trace(np.array([[0], [1e-3], [-20], [0], [0], [1.0]]), towards="film")
    assert -1e-3 * found.scene_ray[5] / found.scene_ray[4] == pytest.approx(lens.focal_length_mm, rel=1e-7)
    assert found.status == [0] and lens.trace(np.array([[0], [90], [-20], [0], [0], [1.0]])).status != [0]
    ray, many = np.array([[0], [5.0], [-20], [0], [0], [1.0]]), [450.0, 650.0]
    each = np.hstack([lens.trace(ray, nm, towards="film").scene_ray for nm in many])
    assert lens.trace(np.hstack([ray, ray]), many, towards="film").scene_ray == pytest.approx(each, abs=1e-12)
    assert np.ptp(each[1]) > 1e-3  # it disperses
    again = lens.trace([[0], [1e-3], [-20], [0], [0], [2.0]], towards="film")  # no unit vector
    assert again.status != [0]


def test_the_t_stop_of_bare_glass_follows_from_fresnels_reflectance() -> None:
    """At normal incidence, through a small stop; the glass of this singlet absorbs less than a percent."""
    lens = nl.lens("thorlabs_lb1471_biconvex_50").set(f_number=32)
    before, through = 1.0, 1.0
    for surface in lens.prescription.surfaces:
        after = float(index_of(surface, 550.0))
        before, through = after, through * (1 - ((before - after) / (before + after)) ** 2)
    assert through < 0.95
    assert lens.t_stop == pytest.approx(lens.f_number / math.sqrt(through), rel=0.01)


@pytest.mark.parametrize("coating", ["bare", "multi-layer"])
def test_a_coating_is_one_setting_of_python_commands_and_cameras(coating: str) -> None:
    """The T-stop and the white card by the matrices of the package tmm for each surface, and by what glass absorbs.

    The stop is so small that all rays are like the axial one. At each wavelength the film sees another exit pupil.
    """
    lens = nl.lens("brendel_tessar_100").set(coating=coating, f_number=64)
    tables = {k: colour.table(k) for k in ("wavelength_nm", "x", "y", "z", "d65")}
    inside = (tables["wavelength_nm"] >= 400) & (tables["wavelength_nm"] <= 700)

    def kept(nm: float) -> float:
        share, before = 1.0, 1.0
        for s in lens.prescription.surfaces:
            after = float(index_of(s, nm))
            films = [(index_at(n, *v, nm), d) for n, d, *v in (s.coating.layers if s.coating else ())]
            if before != after:
                indices, sizes = [before, *(n for n, _ in films), after], [math.inf, *(d for _, d in films), math.inf]
                share *= tmm.coh_tmm("s", indices, sizes, 0, nm)["T"]
            before = after
            # The axial ray crosses each glass along its thickness; what it absorbs is assumed.
            share *= math.exp(-s.thickness_mm * float(absorption_of(s, nm) or 0))
        return share

    told = lens.describe()
    assert lens.t_stop == pytest.approx(lens.f_number / math.sqrt(kept(LINE_D_NM)), rel=1e-4)
    assert (told["t_stop"], told["coatings"]) == (pytest.approx(lens.t_stop), coating)
    nm = tables["wavelength_nm"][inside]
    pupils, film_z = [first_order(lens.prescription, at) for at in nm], lens.prescription.film_z_mm
    seen = [(p.exit_pupil_diameter_mm / (p.exit_pupil_z_mm - film_z)) ** 2 for p in pupils]
    light = np.array([kept(at) for at in nm]) * seen * np.where((nm == 400) | (nm == 700), 0.5, 1)
    rgb, white = (
        np.linalg.solve(colour.SRGB.to_xyz, [(tables[k] * tables["d65"])[inside] @ one for k in "xyz"])
        for one in (light, np.where((nm == 400) | (nm == 700), 0.5, 1))
    )
    wanted = (rgb / white)[[0, 2]] * white[1] / rgb[1]
    assert told["white_rb"] == pytest.approx(wanted.tolist(), abs=5e-4)
    camera = make_camera(ROOT / "lenses/brendel_tessar_100.toml", Shot((12.0, 8.0), coating=coating, f_number=64))
    assert camera.settings["lens_state"]["t_stop"] == pytest.approx(lens.t_stop)
    assert camera.settings["coatings"] == coating


def test_set_makes_another_lens_and_leaves_the_first() -> None:
    lens = nl.lens(GAUSS)
    near = lens.set(f_number=4, focus_m=2).set(focal_length_mm=35)
    assert (near.f_number, near.focal_length_mm) == pytest.approx((4, 35), rel=1e-9)
    assert (near.focus_m, lens.focus_m, near.set(focus_m=None).focus_m) == (2, math.inf, math.inf)
    assert lens.f_number < 2 and "f/4, T" in repr(near) and "2 m" in repr(near)
    with pytest.raises(FrozenInstanceError):
        lens.settings = {}  # type: ignore[misc]


def test_a_stop_wider_than_the_lens_has_is_told() -> None:
    with pytest.warns(NeurolensWarning, match="the stop gives f/0.5, wider than the f/1.8 of the source"):
        nl.lens("laikin_double_gauss_50", f_number=0.5)


def test_a_lens_brings_its_settings_and_a_call_overrules_them() -> None:
    lens = nl.lens(GAUSS, f_number=8, focal_length_mm=35)
    own, other = lens.analyse("seidel"), nl.analyse(lens, ["seidel"], f_number=4)
    plain = nl.analyse(GAUSS, ["seidel"], f_number=8, focal_length_mm=35)
    assert own["seidel"] == plain["seidel"] != other["seidel"]
    assert other["seidel"] == lens.set(f_number=4).analyse("seidel")["seidel"]


def test_rays_have_the_settings_of_a_lens_or_camera_unless_the_call_has_its_own() -> None:
    film, small = (36, 24), {"width": 12, "samples": 2}
    lens = nl.lens(TRIPLET, focus_m=2, f_number=8)
    set_, plain = nl.rays(lens, film, **small), nl.rays(TRIPLET, film, focus_m=2, f_number=8, **small)
    own, far = nl.rays(lens, film, focus_m=5, **small), nl.rays(TRIPLET, film, focus_m=5, f_number=8, **small)
    for ours, theirs in ((set_, plain), (own, far)):
        np.testing.assert_array_equal(ours["direction"], theirs["direction"])
    assert (set_["direction"] != far["direction"]).any()
    assert (nl.rays(lens.set(blades=3), film, **small)["direction"] != set_["direction"]).any()
    tiny = {"focal_length_mm": 14, "samples": 1}  # a lens made so small covers a phone's film
    usual, said = nl.rays(TRIPLET, **tiny), nl.rays(TRIPLET, (5.6, 4.2), width=480, **tiny)
    np.testing.assert_array_equal(usual["direction"], said["direction"])
    camera = nl.camera(TRIPLET, film=(24, 16), focus_m=2, vignetting="none")
    ours, theirs = nl.rays(camera, **small), nl.rays(TRIPLET, (24, 16), focus_m=2, vignetting="none", **small)
    for name in ("direction", "weight"):
        np.testing.assert_array_equal(ours[name], theirs[name])


def test_a_camera_that_is_set_is_the_one_of_the_render() -> None:
    camera = nl.camera(nl.load(MODEL), film=(24, 16), focus_m=2, f_number=4)
    rays = camera.made.sample(*(np.zeros((2, 1), np.float32) + v for v in (0, 0.5)), np.full(1, 550, np.float32))
    assert rays.status == [0] and rays.direction[2] < -0.9
    answer = nl.render("experiments/scenes/room.toml", camera, width=8, samples=1, output="a.exr")
    settings = answer["camera"]
    assert (settings["film_mm"], settings["focus_m"], settings["f_number"]) == ([24, 16], 2, pytest.approx(4))


def test_notebooks_draw_lenses(folder: Path) -> None:
    lens = nl.lens("cooke_triplet_50")
    assert lens._repr_png_().startswith(b"\x89PNG") and "<img" in lens._repr_html_()
    lens.draw("a.svg")
    assert "<svg" in Path("a.svg").read_text(encoding="utf-8")
    with pytest.raises(InputError, match=r"\.png"):
        lens.draw("a.exr")


# The package


def run(code: str) -> str:
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_the_package_is_imported_at_once_and_its_names_when_they_are_asked_for() -> None:
    code = (
        "import time; a = time.process_time(); import neurolens as nl; took = time.process_time() - a; import sys\n"
        "assert not {'numpy', 'torch', 'argparse', 'onnxruntime'} & sys.modules.keys()\n"
        "nl.stmap, nl.lens; assert 'torch' not in sys.modules; print(took)"
    )
    assert min(float(run(code)) for _ in range(2)) < 0.05


def test_without_torch_a_lens_says_what_to_install_for_its_rays_and_models_run() -> None:
    code = (
        "import sys; sys.modules['torch'] = None; import neurolens as nl\n"
        f"print(nl.load({MODEL!r}).card['lens']['id'])\n"
        f"lens = nl.lens({GAUSS!r}).set(f_number=4); print(lens.t_stop > 4, lens._repr_png_(), lens._repr_html_())\n"
        "for run in (lambda: lens.trace([[0]] * 6), lens.analyse, lens.describe, lambda: lens.draw('a.png')):\n"
        "    try: run()\n"
        "    except Exception as error: print(type(error).__name__, error)"
    )
    said = run(code).splitlines()
    assert said[0] == GAUSS and said[1].startswith("True None <p>") and "<img" not in said[1] and len(said) == 6
    assert all(line.startswith("NeurolensError") and "[train]" in line for line in said[2:])


def test_every_name_has_an_example_that_its_help_shows() -> None:
    assert set(EXAMPLES) == set(nl.__all__) <= set(dir(nl))
    for name in nl.__all__:
        call = getattr(nl, name)
        assert EXAMPLES[name] in str(inspect.getdoc(call)) and f"neurolens.{name}(" in repr(call)
        inspect.signature(call)


@pytest.mark.parametrize(
    "name", [pytest.param(n, marks=[pytest.mark.whole, pytest.mark.slow] if n in LONG else []) for n in EXAMPLES]
)
def test_examples_run(name: str, folder: Path) -> None:
    if name == "verify":
        pytest.importorskip("lensfunpy", reason="no lensfunpy (pip install '.[photographs]')")
    if name == "defocus":
        view = f"pinhole:{GAUSS}"
        nl.render("experiments/scenes/room.toml", view, width=24, samples=1, film=(36, 24), output="plate.exr")
    (folder / "example.py").write_text(f"import neurolens as nl\nfound = {EXAMPLES[name]}\n", encoding="utf-8")
    assert runpy.run_path("example.py")["found"]


def test_the_page_of_python_runs(folder: Path) -> None:
    """Its first block goes from a name to a picture in twelve lines."""
    page = (ROOT / "docs" / "pages" / "how-to" / "python.md").read_text(encoding="utf-8")
    blocks = re.findall(r"^```python\n(.*?)^```", page, re.MULTILINE | re.DOTALL)
    assert len([line for line in blocks[0].splitlines() if line]) <= 12
    for block in blocks:
        (folder / "block.py").write_text(block.replace("width=160", "width=16"), encoding="utf-8")
        runpy.run_path("block.py")
    assert {"gauss.png", "room.exr", "room.png"} <= {file.name for file in folder.iterdir()}
    assert all(f"`nl.{name}`" in page for name in nl.__all__)


def test_neurolens_alone_says_what_to_type_first(capsys: pytest.CaptureFixture[str]) -> None:
    assert main([], None) == 0
    assert capsys.readouterr().out == f"{_FIRST}\n" and len(_FIRST.splitlines()) == 6
    for line in re.findall(r": +neurolens (.*)", _FIRST)[:5]:
        build_parser().parse_args(line.split())


def test_packages_that_are_missing_in_a_call_are_named(monkeypatch: pytest.MonkeyPatch) -> None:
    def run(self: Any) -> int:
        raise ModuleNotFoundError("No module named 'scipy'", name="scipy")

    monkeypatch.setattr("neurolens.cli.export.Export.run", run)
    with pytest.raises(NeurolensError, match="pip install"):
        nl.export(MODEL, to="c", output="a.h")


def test_notes_of_a_call_point_to_the_line_of_the_caller() -> None:
    with pytest.warns(Note) as said:
        nl.projection("double gauss 100 1.1", width=48)
    assert {w.filename for w in said} == {__file__} and any("assumed: --film" in str(w.message) for w in said)
