"""Measurements: goals that cannot be missed unseen, kept rows, promises, pupils, benches on known times."""

from pathlib import Path

import lens_models
import numpy as np
import pytest
from shipped import whole

from experiments import lab
from experiments.__main__ import main
from experiments.accuracy import pupils as passage
from experiments.accuracy.methods import Bench, BenchSettings
from experiments.accuracy.pupils import CASES
from experiments.accuracy.surrogates import chosen_rows
from experiments.speed.promises import Outcome, read_index, report_outcome
from neurolens.base import status as st
from neurolens.base.errors import InputError
from neurolens.graph.program import SCENE_RAY
from neurolens.graph.scalars import lower
from neurolens.models.pairs import PairSettings, sample_domain
from neurolens.optics.trace.tracegraph import exact_graph
from neurolens.studies.experiment import DomainChoice, EvaluationChoice, LensChoice


@pytest.mark.parametrize(
    ("command", "told"),
    [
        (["pupils", "--only", "nobody"], "--only"),
        (["copies", "--only", "nobody"], "--only"),
        (["vignetting", "--only", "nobody"], "--only"),
        (["equal-time", "--scene", "nowhere.toml"], "nowhere.toml"),
        (["models", "--list", "no.toml"], "no.toml"),
        (["gallery", "comma"], "did you mean 'coma'"),
        (["osl-noise", "--blender-python", "no-blender"], "no-blender"),
        (["surrogates", "cooke_triplet_50", "--methods", "nonsense"], "ols-64"),
        (["surrogates", "cooke_triplet_50", "lenses/cooke_triplet_50.toml"], "names differ"),
    ],
)
def test_what_is_not_there_is_one_line_and_leaves_no_folder(
    command: list[str], told: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main([*command, "--quiet", "--output", str(tmp_path / "out")]) == 2
    shown = capsys.readouterr().err.strip()
    assert told in shown and "\n" not in shown and not (tmp_path / "out").exists()


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


def measured(lens: str, f_number: float) -> lab.Row:
    case = next(c for c in CASES if (c.lens, c.f_number) == (lens, f_number))
    return passage.measure(case, SAMPLES)


@pytest.mark.parametrize(
    ("lens", "f_number", "goal"), [("muller_fisheye_100", 5.6, 0.97), *whole(("brendel_tessar_100", 4.0, 0.99))]
)
def test_ours_passes_most_and_loses_nothing(lens: str, f_number: float, goal: float) -> None:
    found = measured(lens, f_number)
    ours = found["rates"][passage.OURS]
    assert ours["passed"] >= goal
    assert ours["light"] == pytest.approx(1, abs=0.01) and found["lost"] < 1e-4
    assert all(r["passed"] < ours["passed"] for name, r in found["rates"].items() if name != passage.OURS)
    assert 0 <= found["dark"] < 0.1


def test_tessar_through_the_rear_rim_is_steinerts() -> None:
    row = measured("brendel_tessar_100", 4.0)
    for method in ("rear rim", "pixel disc"):
        assert 100 * row["rates"][method]["passed"] == pytest.approx(row["theirs_percent"][method], abs=3)


def test_the_exact_graph_of_rays_alone_gives_the_rays_of_the_whole() -> None:
    """The whole against the tracer: tests/optics/trace/test_tracegraph.py."""
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


def test_a_lens_of_another_stop_is_another_lens(tmp_path: Path) -> None:
    """The hash of its glass is the same: the stop alone makes other records."""
    text, marks = (lab.LENSES / "cooke_triplet_50.toml").read_text(encoding="utf-8"), []
    for name, stop in (("a", "diameter_mm = 7.6124"), ("b", "diameter_mm = 6.0")):
        file = tmp_path / f"{name}.toml"
        file.write_text(text.replace("diameter_mm = 7.6124", stop), encoding="utf-8")
        bench = Bench(LensChoice(file), BenchSettings(DomainChoice(), PairSettings(), EvaluationChoice()), tmp_path)
        marks.append((bench.lens.sha256, bench.fingerprint(chosen_rows([])[0])))
    assert marks[0][0] == marks[1][0] and marks[0][1] != marks[1][1]
