"""Measurements: goals that cannot be missed unseen, kept rows, promises, pupils, benches on known times."""

from dataclasses import replace
from functools import partial
from pathlib import Path

import lens_models
import numpy as np
import pytest
import torch
from shipped import whole

from experiments import lab
from experiments.__main__ import main
from experiments.fused_speed import ray_candidate
from experiments.promises import Outcome, hold_to_promises, read_index, report_outcome, times
from experiments.pupils import CASES, Case, measure
from experiments.render_times import FUSED_MODELS as MODELS
from neurolens.base import status as st
from neurolens.base.errors import InputError
from neurolens.cameras.model import load_model
from neurolens.graph.compiler import find_compiler
from neurolens.graph.program import SCENE_RAY
from neurolens.graph.scalars import lower
from neurolens.study.speed import Race, fused_candidate, program_candidate, race
from neurolens.surrogates.assemble import RAY_ONLY
from neurolens.surrogates.domain import sample_domain
from neurolens.surrogates.source import fused_program
from neurolens.trace.tracegraph import exact_graph

MODEL = MODELS[0]


def test_rows_of_an_earlier_run_are_kept_or_refused(tmp_path: Path) -> None:
    file = tmp_path / "rows.json"
    kept = partial(lab.kept_rows, file, "a command", lambda row: row["lens"], "lenses")
    assert kept() == {}
    file.write_text('{"lenses": [{"lens": "a", "n": 1}, {"lens": "b"}]}', encoding="utf-8")
    assert kept() == {"a": {"lens": "a", "n": 1}, "b": {"lens": "b"}}
    for text in ("", "[]", "{}", '{"lenses": 3}', '{"lenses": [{"n": 1}]}', '{"lenses": ["a"]}'):
        file.write_text(text, encoding="utf-8")
        with pytest.raises(InputError, match=r"rows\.json: file: .*rows of a command"):
            kept()


@pytest.mark.parametrize("name", ["inverse", "zoom", *whole("vignetting")])
def test_results_of_another_kind_are_not_written_over(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)  # one makes a folder of models first
    file = tmp_path / f"{name}.json"
    for text in ("half a fi", "3", '[{"lens": "other"}]'):
        file.write_text(text)
        assert main([name, "--quiet", "--output", str(tmp_path)]) == 2
        assert f"rows of experiments {name}" in capsys.readouterr().err and file.read_text() == text


@pytest.mark.parametrize(
    ("command", "told"),
    [
        (["pupils", "--only", "nobody"], "--only"),
        (["vignetting", "--only", "nobody"], "--only"),
        (["equal-time", "--scene", "nowhere.toml"], "nowhere.toml"),
        (["models", "--list", "no.toml"], "no.toml"),
        (["gallery", "comma"], "did you mean 'coma'"),
    ],
)
def test_what_is_not_there_is_one_line_and_leaves_no_folder(
    command: list[str], told: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main([*command, "--quiet", "--output", str(tmp_path / "out")]) == 2
    shown = capsys.readouterr().err.strip()
    assert told in shown and "\n" not in shown and not (tmp_path / "out").exists()


TIMES = {"exact eager": [200.0, 220.0], "exact compiled": [30.0, 33.0], "a.onnx": [15.0, 16.5], "b.onnx": [20.0, 22.0]}


def raced(reason: str = "") -> Race:
    times = {k: v for k, v in TIMES.items() if not reason or k != "exact compiled"}
    return Race(times, dict.fromkeys(times, 4096), {"exact compiled": reason} if reason else {})


@pytest.mark.parametrize(
    ("promised", "reason", "checked", "missed", "unchecked"),
    [
        ({"a.onnx": 1.9, "b.onnx": 1.6}, "", 2, ["b.onnx: 1.5 times the compiled exact tracer, promised 1.6"], []),
        ({"a.onnx": None}, "", 0, [], []),
        ({"a.onnx": 9.0}, "no C++ compiler", 0, [], ["a.onnx: no C++ compiler"]),
    ],
)
def test_promises_are_kept_missed_or_unchecked(
    promised: dict[str, float | None], reason: str, checked: int, missed: list[str], unchecked: list[str]
) -> None:
    outcome, timed = Outcome(), raced(reason)
    hold_to_promises([{"file": k, "promised_speedup": v} for k, v in promised.items()], timed, outcome)
    assert (outcome.checked, outcome.missed, outcome.unchecked) == (checked, missed, unchecked)
    assert f"| exact compiled | {'unavailable: ' + reason if reason else '30.0 (31.5)'} |" in times(timed)


BROKEN = ("", "{", "[]", '{"models": 3}', '{"models": [{"file": "a.onnx"}]}', '{"models": [3]}', '{"rows": []}')
ELSEWHERE = '{"models": [{"file": "../a.onnx", "lens_file": "a.toml"}]}'


@pytest.mark.parametrize("text", [None, *BROKEN, ELSEWHERE])
def test_a_bad_index_is_one_clear_error(tmp_path: Path, text: str | None, capsys: pytest.CaptureFixture[str]) -> None:
    if text is not None:
        (tmp_path / "index.json").write_text(text)
    with pytest.raises(InputError, match="index.json"):
        read_index(tmp_path)
    assert main(["promises", "--models", str(tmp_path)]) == 2
    shown = capsys.readouterr().err.strip()
    assert "index.json" in shown and "\n" not in shown


def test_a_speed_below_its_floor_fails() -> None:
    good, bad, unknown = (lab.Goal("speed", 1.0, v, at_least=True) for v in (1.1, 0.9, None))
    assert report_outcome(Outcome(floors=[good, unknown])) == 0
    assert report_outcome(Outcome(floors=[good, bad])) == 1


SAMPLES = 2**13


@pytest.mark.parametrize(
    ("case", "goal"), [(CASES[1], 0.97), *whole(*((case, 0.97) for case in CASES if case is not CASES[1]))]
)
def test_outlines_of_pupils_pass_most_and_lose_nothing(case: Case, goal: float) -> None:
    found = measure(case, SAMPLES, wider=1.3)
    assert found["passed"] >= goal and found["lost"] < 1e-4 and 0 <= found["dark"] < 0.3


def test_the_exact_graph_of_rays_alone_gives_the_rays_of_the_whole() -> None:
    """The whole against the tracer: tests/trace/test_tracegraph.py."""
    lens, domain = lens_models.lens(), lens_models.domain()
    s = sample_domain(domain, 20_000, 3)
    inputs = {f"{k}_mm": getattr(s, k).numpy() for k in ("film_x", "film_y", "pupil_x", "pupil_y")}
    inputs |= {"wavelength_nm": s.wavelength_nm.numpy(), "film_z_mm": domain.film_z_mm[0]}
    inputs |= {"stop_radius_mm": lens.stop_radius_mm}
    found, alone = (
        lower(exact_graph(lens, domain.pupil_z_mm, domain.wavelength_nm, whole=whole)).evaluate(inputs)
        for whole in (True, False)
    )
    passed = found["status"] == st.PASSED
    assert passed.mean() > 0.1 and len(np.unique(found["status"])) > 3 and "transmittance" not in alone
    assert all(np.array_equal(alone[name][passed], found[name][passed]) for name in SCENE_RAY)


def test_candidates_time_models_and_files() -> None:
    try:
        find_compiler()
    except InputError as reason:
        pytest.skip(f"the C form is not timed here: {reason}")
    model = lens_models.model("invariants")
    candidate = program_candidate("fused", fused_program([model], RAY_ONLY), model.domain)
    timing = race([candidate], model.domain, rounds=1).timing("fused")
    assert timing is not None and 0 < timing["min"] < 1e4
    assert fused_candidate("x", lens_models.exported("invariants"), model.domain) is not None


def test_the_part_of_a_graph_that_gives_rays_gives_the_same() -> None:
    file, domain = lens_models.exported("invariants"), lens_models.domain()
    rays = sample_domain(domain, 500, 3)
    rays = replace(rays, film_z=torch.full_like(rays.film_z, domain.film_z_mm[0]))
    (found,) = ray_candidate("ray", file).prepare(rays)()  # type: ignore[misc]
    columns = [c.numpy().astype(np.float32) for c in rays.columns()]
    whole = load_model(file).rays(np.stack(columns[0:2]), np.stack(columns[3:5]), columns[5], float(columns[2][0]))
    assert (whole.status == st.PASSED).sum() > 100 and np.abs(found - whole.scene_ray).max() < 1e-5
