"""The benchmark of surrogates: records that are made once, failures that are rows, pages that say what was measured."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from lens_models import LENSES

from neurolens.base.errors import InputError
from neurolens.base.progress import Progress
from neurolens.cli import main
from neurolens.evaluate import methods as surrogate_bench
from neurolens.evaluate.experiment import DomainChoice, LensChoice
from neurolens.evaluate.methods import Bench, BenchSettings, Row, all_rows, chosen_rows, run_bench
from neurolens.evaluate.methods_page import lens_page, write_lens
from neurolens.surrogates.fit import ModelSettings
from neurolens.surrogates.pairs import PairSettings

pytestmark = pytest.mark.slow

SETTINGS = BenchSettings(
    DomainChoice(focus_m=(math.inf, math.inf), wavelength_nm=(400.0, 700.0)),
    PairSettings(2000, 1000, 2000),
    vignetting_rays=20_000,
    rounds=1,
    compile_exact=False,
)
ROWS = (
    Row("thick", "paraxial", ModelSettings("thick")),
    Row("ols-12", "ours", ModelSettings("ols", terms=12, degree=4)),
    Row("ols-24", "ours", ModelSettings("ols", terms=24, degree=5)),
    Row("refused", "published", ModelSettings("dense", degree=9, basis="raw"), "a paper"),
)


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[dict[str, Any]]]:
    folder = tmp_path_factory.mktemp("bench")
    with pytest.MonkeyPatch.context() as patch:
        real = surrogate_bench.fit_model

        def fit(prepared: Any, settings: ModelSettings, report: Any) -> Any:
            if settings.method == "dense":
                raise InputError("fit", "degree", 9, "less | fewer")
            return real(prepared, settings, report)

        patch.setattr(surrogate_bench, "fit_model", fit)
        return folder, run(folder, ROWS)


def run(
    folder: Path, rows: tuple[Row, ...], settings: BenchSettings = SETTINGS, **options: Any
) -> list[dict[str, Any]]:
    bench = Bench(LensChoice(LENSES / "cooke_triplet_50.toml"), settings, folder)
    return run_bench([bench], rows, progress=Progress(quiet=True), **options)["cooke_triplet_50"]


def test_a_lens_of_another_stop_is_another_lens(tmp_path: Path) -> None:
    """The hash of its glass is the same: the stop alone makes other records."""
    text = (LENSES / "cooke_triplet_50.toml").read_text(encoding="utf-8")
    marks = set()
    for name, stop in (("a", "diameter_mm = 7.6124"), ("b", "diameter_mm = 6.0")):
        (tmp_path / name).mkdir()
        file = tmp_path / name / "cooke_triplet_50.toml"
        file.write_text(text.replace("diameter_mm = 7.6124", stop), encoding="utf-8")
        bench = Bench(LensChoice(file), SETTINGS, tmp_path)
        marks.add((bench.lens.sha256, bench.fingerprint(ROWS[0])))
    assert len({glass for glass, _ in marks}) == 1 and len(marks) == 2


def by_method(records: list[dict[str, Any]]) -> dict[str, dict[str, Any]]:
    return {r["method"]: r for r in records}


def test_one_record_a_method_with_every_figure(made: tuple[Path, list[dict[str, Any]]]) -> None:
    folder, records = made
    found = by_method(records)
    assert found["thick"]["rms_um"] > 2 * found["ols-12"]["rms_um"] > 4 * found["ols-24"]["rms_um"] > 0
    for name in ("ols-12", "ols-24"):
        one = found[name]
        assert one == json.loads((folder / "records" / "cooke_triplet_50" / f"{name}.json").read_text())
        assert one["rms_um_at_21_6"] / one["rms_um"] == pytest.approx(21.6 / 18.2, rel=0.01)
        assert one["max_um"] >= one["p99_um"] >= one["rms_um"] and one["bytes"] > 1000
        assert one["ns_per_ray"]["min"] > 0 and one["speedup"] > 0 and one["exact"][0]["name"] == "exact eager"
        if one["speedup"] > 1:
            gain = one["exact"][0]["ns_per_ray"]["min"] - one["ns_per_ray"]["min"]
            assert one["break_even_rays"] * gain * 1e-9 == pytest.approx(one["fit_s"] + one["load_s"])
        else:
            assert one["break_even_rays"] == "never"


def test_a_method_that_fails_is_a_row_with_the_reason(made: tuple[Path, list[dict[str, Any]]]) -> None:
    refused = by_method(made[1])["refused"]
    assert "less | fewer" in refused["failed"] and refused["fingerprint"]
    rows = [line for line in lens_page("a", made[1], "").splitlines() if line.startswith("|")]
    assert len({line.count("|") for line in rows}) == 1  # one table, no cell that breaks it


def test_a_second_run_makes_nothing_again(made: tuple[Path, list[dict[str, Any]]]) -> None:
    folder, records = made
    files = sorted(f for f in folder.rglob("*") if f.is_file())
    before = [f.stat().st_mtime_ns for f in files]
    assert by_method(run(folder, ROWS)) == by_method(records)  # the refused one, too: its settings are the same
    assert [f.stat().st_mtime_ns for f in files] == before


def test_other_settings_and_lost_files_are_made_again(
    made: tuple[Path, list[dict[str, Any]]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    fitted: list[str] = []
    real = surrogate_bench.fit_model

    def fit(prepared: Any, settings: ModelSettings, report: Any) -> Any:
        fitted.append(settings.label)
        if settings.degree == 3:
            raise ZeroDivisionError("by accident")
        return real(prepared, settings, report)

    monkeypatch.setattr(surrogate_bench, "fit_model", fit)
    one = replace(ROWS[1], settings=replace(ROWS[1].settings, planes=False))
    untimed = replace(SETTINGS, rounds=0, pairs=PairSettings(500, 300, 500), vignetting_rays=2000)
    bench = Bench(LensChoice(LENSES / "cooke_triplet_50.toml"), untimed, tmp_path)  # one, so that rays are traced once

    def go(row: Row, **options: Any) -> list[dict[str, Any]]:
        return run_bench([bench], (row,), progress=Progress(quiet=True), **options)["cooke_triplet_50"]

    go(one)
    go(one)
    assert fitted == ["ols-12"]
    (tmp_path / "models" / "cooke_triplet_50" / "ols-12.onnx").unlink()
    go(one)
    go(one, again=True)
    (tmp_path / "records" / "cooke_triplet_50" / "ols-12.json").write_text("{")
    go(one)
    assert len(fitted) == 4
    accident = replace(one, settings=replace(one.settings, degree=3))
    assert go(accident)[0]["failed"] == "ZeroDivisionError: by accident"
    go(accident)
    assert len(fitted) == 6  # tried again


def test_stored_weights_are_rows_of_their_own(tmp_path: Path) -> None:
    network = ModelSettings("mlp", units=6, layers=1, steps=20)
    rows = (Row("net", "ours", network), Row("net-int8", "ours", network, weights="int8"))
    whole, small = run(tmp_path, rows, replace(SETTINGS, rounds=0))
    assert small["rms_um"] > 2 * whole["rms_um"] and small["bytes"] != whole["bytes"]
    assert small["fingerprint"] != whole["fingerprint"]


def test_a_lens_that_cannot_be_is_rows_too(tmp_path: Path) -> None:
    bench = Bench(LensChoice(tmp_path / "missing.toml"), SETTINGS, tmp_path)
    records = run_bench([bench], ROWS, progress=Progress(quiet=True))["missing"]
    assert all("missing.toml" in r["failed"] for r in records)
    write_lens("missing", records, "", tmp_path)
    assert not (tmp_path / "missing.png").exists()


def test_rows_by_name_group_and_method() -> None:
    names = [r.name for r in all_rows()]
    assert len(set(names)) == len(names)
    assert {"thin", "ols-64", "mlp-32x2"} <= set(names)
    assert {r.group for r in chosen_rows([])} == {"paraxial", "published", "ours"}
    assert [r.name for r in chosen_rows(["ols-64", "thin", "ols-64"])] == ["ols-64", "thin"]
    assert {r.settings.method for r in chosen_rows(["schrade"])} == {"schrade"}
    with pytest.raises(InputError, match="ols-64"):
        chosen_rows(["nonsense"])


@pytest.mark.parametrize(
    ("args", "words"),
    [
        (["nonsense"], ["LENS", "nonsense"]),
        (["cooke_triplet_50", "--methods", "nonsense"], ["--methods", "nonsense"]),
        (["cooke_triplet_50", str(LENSES / "cooke_triplet_50.toml")], ["names differ"]),
    ],
)
def test_bad_arguments_are_one_line(
    args: list[str], words: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["bench", "surrogates", *args, "--out", str(tmp_path / "out")]) == 2
    line = capsys.readouterr().err
    assert all(word in line for word in words) and line.count("\n") == 1
    assert not (tmp_path / "out").exists()


def test_the_command_leaves_tables_plots_and_its_configuration(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    command = ["bench", "surrogates", "cooke_triplet_50", "--methods", "thin", "ols-20", "--quick", "--rays", "2000"]
    assert main([*command, "--rounds", "0", "--out", str(tmp_path), "--quiet"]) == 0
    assert "| ols-20 | 1 |" in capsys.readouterr().out
    config = json.loads((tmp_path / "config.json").read_text())
    assert config["seed"] == 1 and config["settings"]["pairs"]["train"] == 2000 and config["versions"]["torch"]
    assert {f.name for f in tmp_path.glob("*.*")} == {
        "config.json",
        "summary.md",
        "cooke_triplet_50.md",
        "cooke_triplet_50.png",
    }
