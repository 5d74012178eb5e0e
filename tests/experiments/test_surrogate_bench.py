"""The benchmark of surrogates: records that are made once, with figures in the order that physics gives."""

import json
import math
from pathlib import Path
from typing import Any

import pytest
from command_line import failure
from lens_models import LENSES

from experiments import methods as surrogate_bench
from experiments.__main__ import main
from experiments.methods import Bench, BenchSettings, Row, run_bench
from experiments.surrogates import chosen_rows
from neurolens.base.errors import InputError
from neurolens.base.progress import Progress
from neurolens.study.experiment import DomainChoice, EvaluationChoice, LensChoice
from neurolens.surrogates.fit import ModelSettings
from neurolens.surrogates.pairs import PairSettings

pytestmark = pytest.mark.slow

TRIPLET = "cooke_triplet_50"
SETTINGS = BenchSettings(
    DomainChoice(focus_m=(math.inf, math.inf), wavelength_nm=(400.0, 700.0)),
    PairSettings(500, 300, 500),
    EvaluationChoice(vignetting_rays=2000, rounds=0, compile_exact=False),
)
ROWS = (
    Row("thick", "paraxial", ModelSettings("thick")),
    Row("ols-12", "ours", ModelSettings("ols", terms=12, degree=4)),
    Row("ols-24", "ours", ModelSettings("ols", terms=24, degree=5)),
    Row("refused", "published", ModelSettings("dense", degree=9), "a paper"),
)


def bench_of(folder: Path, file: Path = LENSES / f"{TRIPLET}.toml", settings: BenchSettings = SETTINGS) -> Bench:
    return Bench(LensChoice(file), settings, folder)


def run(bench: Bench, *rows: Row, **options: Any) -> list[dict[str, Any]]:
    return next(run_bench([bench], rows, Progress(quiet=True), **options))[1]


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a command that ran twice."""
    folder, real, patch = tmp_path_factory.mktemp("bench"), surrogate_bench.fit_any, pytest.MonkeyPatch()

    def fit(prepared: Any, settings: ModelSettings, report: Any) -> Any:
        if settings.method == "dense":
            raise InputError("fit", "degree", 9, "less | fewer")
        return real(prepared, settings, report)

    command = ["surrogates", TRIPLET, "--quick", "--rays", "2000", "--rounds", "1", "--quiet"]
    with patch.context() as patched:
        patched.setattr(surrogate_bench, "fit_any", fit)
        patched.setattr("experiments.surrogates.chosen_rows", lambda names, quick: ROWS)
        assert main([*command, "--output", str(folder)]) == 0
        files = [f for name in ("records", "models") for f in (folder / name).rglob("*") if f.is_file()]
        before = {f: f.stat().st_mtime_ns for f in files}
        assert main([*command, "--output", str(folder)]) == 0
        # Nothing is made again, the refused one neither: its settings are the same.
        assert len(before) == 7 and {f: f.stat().st_mtime_ns for f in files} == before
    return folder


def records_of(folder: Path) -> dict[str, dict[str, Any]]:
    return {f.stem: json.loads(f.read_text()) for f in (folder / "records" / TRIPLET).iterdir()}


def test_a_quick_run_has_a_row_of_every_method() -> None:
    quick = chosen_rows([], quick=True)
    assert len(quick) < 15 and {r.settings.method for r in quick} == {r.settings.method for r in chosen_rows([])}


@pytest.mark.whole
def test_one_record_a_method_with_every_figure(made: Path) -> None:
    found = records_of(made)
    assert found["thick"]["rms_um"] > 2 * found["ols-12"]["rms_um"] > 4 * found["ols-24"]["rms_um"] > 0
    for one in (found["ols-12"], found["ols-24"]):
        assert one["rms_um_at_21_6"] / one["rms_um"] == pytest.approx(21.6 / 18.2, rel=0.01)
        assert one["max_um"] >= one["p99_um"] >= one["rms_um"] and one["bytes"] > 1000
        assert one["ns_per_ray"]["min"] > 0 and one["speedup"] > 0 and one["exact"][0]["name"] == "exact eager"
        if one["speedup"] > 1:
            gain = one["exact"][0]["ns_per_ray"]["min"] - one["ns_per_ray"]["min"]
            assert one["break_even_rays"] * gain * 1e-9 == pytest.approx(one["fit_s"] + one["load_s"])
        else:
            assert one["break_even_rays"] == "never"


def test_a_lens_of_another_stop_is_another_lens(tmp_path: Path) -> None:
    """The hash of its glass is the same: the stop alone makes other records."""
    text, benches = (LENSES / f"{TRIPLET}.toml").read_text(encoding="utf-8"), []
    for name, stop in (("a", "diameter_mm = 7.6124"), ("b", "diameter_mm = 6.0")):
        file = tmp_path / f"{name}.toml"
        file.write_text(text.replace("diameter_mm = 7.6124", stop), encoding="utf-8")
        benches.append(bench_of(tmp_path, file))
    assert benches[0].lens.sha256 == benches[1].lens.sha256
    assert benches[0].fingerprint(ROWS[0]) != benches[1].fingerprint(ROWS[0])


@pytest.mark.parametrize(
    ("args", "words"),
    [
        (["nonsense"], ["LENS", "nonsense"]),
        ([TRIPLET, "--methods", "nonsense"], ["--methods", "nonsense", "ols-64"]),
        ([TRIPLET, LENSES / f"{TRIPLET}.toml"], ["names differ"]),
    ],
)
def test_bad_arguments_are_one_line(
    args: list[object], words: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    line = failure(capsys, "surrogates", *args, "--output", tmp_path / "out", run=main)
    assert all(word in line for word in words) and not (tmp_path / "out").exists()
