"""The command line on lens states, whole tables, doubtful lenses; C, GLSL and ONNX of a model file."""

import json
import math
import re
import warnings
from pathlib import Path
from typing import Any

import lens_models
import numpy as np
import pytest
from command_line import described, failure, run_json
from lens_models import edited

import neurolens as nl
from neurolens.base.errors import NeurolensWarning
from neurolens.cameras.build import make_camera
from neurolens.cli import main
from neurolens.cli.arguments import Parser
from neurolens.models.card import MODEL_KEY
from neurolens.optics.lens.shot import Shot
from neurolens.optics.readers.lensfile import read_lens
from neurolens.optics.setting.states import set_lens
from neurolens.pictures.render.pictures import read_exr, write_exr

LENSES = Path(__file__).parents[1] / "lenses"
GAUSS, _UNITS = LENSES / "laikin_double_gauss_50.toml", re.compile("_(m|mm|deg)$")
ANAMORPHIC, NIKON = LENSES / "cooke_anamorphic_42.toml", LENSES / "nikon_zoom_70_200.toml"
SINGLET, TAJIMA = LENSES / "thorlabs_lb1471_biconvex_50.toml", LENSES / "tajima_retrofocus_24.toml"
MODEL = LENSES.parent / "models" / "laikin_double_gauss_50.ols-28.onnx"
_NOWHERE = Path("/proc/q.exr")  # nobody, root neither, makes a file there


def test_a_focus_state_is_focused_at_its_object(capsys: pytest.CaptureFixture[str]) -> None:
    """207.03 mm before the front vertex, and the film so far behind it; farther as the lens is larger."""
    near = run_json(capsys, "lens", TAJIMA, "--zoom", "0.3m")
    assert near["focus_m"] == pytest.approx((207.03 + near["film_z_mm"]) / 1000)
    small = run_json(capsys, "lens", NIKON, "--zoom", "135mm near")
    assert small["focus_m"] == pytest.approx((750.55 + small["film_z_mm"]) / 1000)
    large = run_json(capsys, "lens", NIKON, "--zoom", "135mm near", "--efl", 200)
    assert large["focus_m"] / small["focus_m"] == pytest.approx(large["efl_mm"] / small["efl_mm"])


@pytest.mark.parametrize(
    ("file", "asked"),
    [
        (TAJIMA, {"zoom": "0.3m"}),
        (TAJIMA, {"zoom": "0.3m", "focus_m": 1.5, "focus_mode": "paraxial"}),
        (TAJIMA, {"focus_m": 2.0, "focus_mode": "internal", "f_number": 8.0}),
        (GAUSS, {"focal_length_mm": 100.0, "cover_glass_mm": 4.0}),
        (GAUSS, {"field_deg": 20.0, "focus_m": 3.0, "cover_glass_mm": 4.0, "f_number": 5.6}),
    ],
)
def test_a_lens_is_set_alike_for_cameras_commands_and_python(
    file: Path, asked: dict[str, Any], capsys: pytest.CaptureFixture[str]
) -> None:
    """The film stands at one place, by the settings of one shot; a plate that is added does not grow with the lens."""
    words = [word for k, v in asked.items() for word in (f"--{_UNITS.sub('', k).replace('_', '-')}", v)]
    told = run_json(capsys, "lens", file, *words)
    one, shot = nl.lens(file, **asked), Shot.part(film_mm=(12.0, 8.0), runtime="onnxruntime", **asked)
    cameras: list[Any] = [make_camera(f"thick:{file}", shot)]
    cameras += [make_camera(file, shot)] if len(asked) == 1 else []  # which searches its pupil
    for lens in (one.prescription, set_lens(read_lens(file), shot), *(c.lens for c in cameras[1:])):
        assert float(lens.film_z_mm) == pytest.approx(told["film_z_mm"], abs=1e-9)
        if "cover_glass_mm" in asked:
            assert lens.surfaces[-2].thickness_mm == 4.0
    told["focus_m"] = None if told["focus_m"] == "infinity" else told["focus_m"]
    for camera in cameras:
        assert camera.settings["film_z_mm"] == pytest.approx(told["film_z_mm"], abs=1e-9)
    assert {told["focus_m"], *(camera.settings["focus_m"] for camera in cameras)} == {
        None if math.isinf(one.focus_m) else one.focus_m
    }
    if asked.keys() == {"zoom"}:
        assert one.focus_m == pytest.approx((207.03 + told["film_z_mm"]) / 1000)


def test_an_anamorphic_lens_is_described_in_both_planes(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The source: 42.47 mm, and half of it across; the edge of the circle is lit along y, the picture is wider."""
    data = described(ANAMORPHIC)
    assert data["efl_mm"] == pytest.approx(42.47, abs=0.05) and data["efl_x_mm"] == pytest.approx(21.47, rel=0.01)
    assert data["half_field_reached_deg"] > 15
    dark = [w for w in data["warnings"] if "no ray reaches" in w]
    assert (data["half_field_reached_x_deg"] is None) == bool(dark) and all("along x" in w for w in dark)
    assert described(SINGLET)["efl_x_mm"] is None
    # As text, of a lens that is quick to describe.
    path = tmp_path / "cylinder.toml"
    path.write_text(SINGLET.read_text().replace("radius_mm =  50.6", 'cylinder = "y", radius_mm = 50.6'))
    assert main(["lens", str(path)]) == 0
    text = capsys.readouterr().out
    assert "in the x-z plane" in text and "cylinder y" in text


def test_breathing_is_no_other_f_number(capsys: pytest.CaptureFixture[str]) -> None:
    state = ("--zoom", "135mm", "--focus", "2", "--focusing", "internal")
    data = run_json(capsys, "lens", NIKON, *state)
    assert data["efl_mm"] < 130  # it does breathe
    assert not [w for w in data["warnings"] if "the stop gives" in w]


def test_the_surface_table_hides_nothing(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "coated.toml"
    material = 'n_d = 1.5168, V_d = 64.17, coating = "bare", material = "N-BK7"'
    more = 'coating = "quarter-wave", conic = -1.1, asphere = { 4 = 1e-7, 6 = 2e-10 }, absorption_per_mm = 0.01'
    assert material in (text := SINGLET.read_text())
    path.write_text(text.replace(material, f'glass = "N-BK7", {more}'))
    row = run_json(capsys, "lens", path)["surfaces"][1]
    assert (row["conic"], row["asphere"], row["glass"]) == (-1.1, {"4": 1e-7, "6": 2e-10}, "N-BK7")
    assert row["n_d"] == pytest.approx(1.5168, abs=1e-4) and row["V_d"] == pytest.approx(64.17, abs=0.02)
    (index, nanometres), *_ = row["coating"]["layers"]
    assert index * nanometres == pytest.approx(550 / 4, rel=0.1) and row["absorption_per_mm"] == 0.01
    assert main(["lens", str(path)]) == 0
    assert "asphere 4-6, conic -1.1, coating quarter-wave, absorbs 0.01/mm" in capsys.readouterr().out


# render


def test_a_place_that_cannot_be_written_is_found_before_the_render(
    scene: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("neurolens.pictures.frames.render", lambda *_, **__: pytest.fail("rendered for nothing"))
    line = failure(capsys, "render", scene, "--camera", "thin", "-o", _NOWHERE, "--quiet")
    assert str(_NOWHERE) in line and ".tmp" not in line
    with pytest.raises(OSError, match=str(_NOWHERE)) as refused:
        write_exr(_NOWHERE, np.zeros((2, 2, 3)))
    assert ".tmp" not in str(refused.value)


def test_the_picture_keeps_the_state_of_its_lens(
    scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "a.exr"
    state = ("--zoom", "100", "--focusing", "internal", "--focus", "2")
    run_json(capsys, "render", scene, "--camera", NIKON, "-o", out, "--quiet", *state)
    camera = read_exr(out)[1]["camera"]
    assert (camera["zoom"], camera["focus_mode"], camera["rims"]) == ("100", "internal", "derived")
    assert "100 mm" in camera["derived"]


def test_a_model_says_where_it_is_poor_dark_or_coarser_than_the_picture(
    scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    def spoil(card: dict[str, Any]) -> None:
        card["errors"] |= {"poor": ["false pass 2%"], "rms_um": 2000.0}
        card["domain"]["focus_m"] = ["inf", "inf"]

    model = edited(MODEL, tmp_path / "model.onnx", spoil)
    render = ("render", str(scene), "--camera", str(model), "-o", str(tmp_path / "a.exr"), "--samples", "1")
    assert main([*render, "--film", "60x40"]) == 0
    said = [line for line in capsys.readouterr().err.splitlines() if "warning" in line]
    assert [("poor" in s, "its corners stay dark" in s, "more than a pixel" in s) for s in said] == [
        (True, False, False), (False, True, False), (False, False, True),
    ]  # fmt: skip
    assert main([*render, "--film", "60x40", "--quiet"]) == 0
    assert capsys.readouterr().err == ""
    assert "within the model's domain, inf m" in failure(capsys, *render, "--focus", "0.2")


def test_warnings_are_lines_once_and_none_when_quiet(capsys: pytest.CaptureFixture[str]) -> None:
    def build() -> Parser:
        def run(_: object) -> int:
            for text in ("a\nb", "a\nb", "c"):
                warnings.warn(text, NeurolensWarning, stacklevel=2)
            return 0

        parser = Parser(prog="x")
        parser.add_argument("--quiet", action="store_true")
        parser.set_defaults(run=run, kept="")
        return parser

    for quiet, lines in (([], ["neurolens: warning: a b", "neurolens: warning: c"]), (["--quiet"], [])):
        assert main(quiet, build) == 0
        assert capsys.readouterr().err.splitlines() == lines


@pytest.fixture(scope="module")
def file() -> Path:
    return lens_models.exported("invariants")


def test_c_and_glsl(file: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    header, shader = tmp_path / "a.h", tmp_path / "a.glsl"
    assert main(["export", str(file), "--to", "c", "-o", str(header), "--only", "ray", "--name", "gauss"]) == 0
    assert capsys.readouterr().out.strip() == str(header)
    text = header.read_text()
    assert "gauss_rays(" in text and "stop_radius_mm" not in text[text.index("#ifndef") :]
    fixes = ["--fix", "wavelengths=450,550", "--fix", "focus=1.5", "--fix", "f_number=4", "--json"]
    assert main(["export", str(file), "--to", "glsl", "-o", str(shader), *fixes]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["bands_nm"] == [450.0, 550.0] and told["operations_per_ray"] > 50 and "film_z_mm" not in told["inputs"]
    text = shader.read_text()
    assert "in int band" in text and "film_z_mm" not in text and "Fixed: film plane" in text


def test_bad_input_is_one_line(file: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "a.h"
    old = tmp_path / "old.onnx"
    old.write_bytes(file.read_bytes().replace(MODEL_KEY.encode(), b"x" * len(MODEL_KEY)))
    bare = tmp_path / "bare.onnx"
    bare.write_bytes(file.read_bytes().replace(b'"refractions"', b'"reflections"'))
    base = ["export", file, "--to", "c", "-o", out]
    cases: list[tuple[list[object], list[str]]] = [
        ([*base, "--fix", "wavelengths=300"], ["400 to 700"]),
        ([*base, "--fix", "focus=0.1"], ["focus"]),
        ([*base, "--fix", "film_z=1"], ["film_z"]),
        ([*base, "--fix", "stop=50"], ["stop"]),
        ([*base, "--fix", "stop=nan"], ["--fix", "stop=nan"]),
        ([*base, "--fix", "colour=1"], ["--fix", "wavelengths"]),
        ([*base, "--fix", "stop=3", "--fix", "f_number=4"], ["both"]),
        ([*base, "--only", "stop"], ["--only", "ray"]),
        ([*base, "--name", "1 2"], ["name"]),
        (["export", file, "--to", "onnx", "-o", out, "--only", "ray"], ["--only"]),
        ([*base, "--inverse"], ["--inverse", "--to onnx"]),
        (["export", file, "--to", "onnx", "-o", out, "--fix", "wavelengths=450,550"], ["one wavelength"]),
        (["export", tmp_path / "no.onnx", "--to", "c", "-o", out], ["no.onnx", "missing"]),
        (["export", old, "--to", "c", "-o", out], ["old.onnx", "export it again"]),
        (["export", bare, "--to", "c", "-o", out], ["card", "refractions"]),
        (["export", file, "--to", "c", "-o", tmp_path / "no" / "a.h"], ["a.h"]),
        (["export", file, "--to", "fortran", "-o", out], ["fortran"]),
    ]
    for args, words in cases:
        line = failure(capsys, *args)
        assert all(word in line for word in words), (args, line)
    assert not out.exists()
