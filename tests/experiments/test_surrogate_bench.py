"""The benchmark of surrogates: records that are made once, with figures in the order that physics gives."""

import math
from pathlib import Path

import pytest
from command_line import failure
from lens_models import LENSES

from experiments.__main__ import main
from experiments.methods import Bench, BenchSettings, Row
from experiments.surrogates import chosen_rows
from neurolens.study.experiment import DomainChoice, EvaluationChoice, LensChoice
from neurolens.surrogates.fit import ModelSettings
from neurolens.surrogates.pairs import PairSettings

pytestmark = pytest.mark.slow

TRIPLET = "cooke_triplet_50"
SETTINGS = BenchSettings(
    DomainChoice(focus_m=(math.inf, math.inf), wavelength_nm=(400.0, 700.0)),
    PairSettings(500, 300, 500),
    EvaluationChoice(vignetting_rays=2000, rounds=0),
)
ROWS = (
    Row("thick", "paraxial", ModelSettings("thick")),
    Row("ols-12", "ours", ModelSettings("ols", terms=12, degree=4)),
    Row("ols-24", "ours", ModelSettings("ols", terms=24, degree=5)),
    Row("refused", "published", ModelSettings("dense", degree=9), "a paper"),
)


def bench_of(folder: Path, file: Path = LENSES / f"{TRIPLET}.toml", settings: BenchSettings = SETTINGS) -> Bench:
    return Bench(LensChoice(file), settings, folder)


def test_a_quick_run_has_a_row_of_every_method() -> None:
    quick = chosen_rows([], quick=True)
    assert len(quick) < 15 and {r.settings.method for r in quick} == {r.settings.method for r in chosen_rows([])}


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
