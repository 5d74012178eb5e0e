"""What `make bench` reads and promises; no model and no clock is needed for that."""

from __future__ import annotations

from pathlib import Path

import pytest

from experiments.__main__ import main
from experiments.promises import (
    Floor,
    Outcome,
    hold_to_promises,
    read_index,
    report_outcome,
    table_rows,
)
from neurolens.base.errors import InputError
from neurolens.evaluate.speed import Race

TIMES = {"exact eager": [200.0, 220.0], "exact compiled": [30.0, 33.0], "a.onnx": [15.0, 16.5], "b.onnx": [20.0, 22.0]}


def raced(times: dict[str, list[float]]) -> Race:
    return Race(times, dict.fromkeys(times, 4096), 1, 2)


def test_promises_kept_and_missed() -> None:
    rows = [{"file": "a.onnx", "promised_speedup": 1.9}, {"file": "b.onnx", "promised_speedup": 1.6}]
    outcome = Outcome()
    hold_to_promises(rows, raced(TIMES), outcome)
    assert outcome.checked == 2
    assert len(outcome.missed) == 1
    assert "b.onnx" in outcome.missed[0] and "1.6" in outcome.missed[0]


def test_a_model_without_a_promise_is_only_timed() -> None:
    outcome = Outcome()
    hold_to_promises([{"file": "a.onnx"}, {"file": "b.onnx", "promised_speedup": None}], raced(TIMES), outcome)
    assert (outcome.checked, outcome.missed, outcome.unchecked) == (0, [], [])


def test_without_the_compiled_tracer_promises_are_unchecked_and_say_why() -> None:
    times = {k: v for k, v in TIMES.items() if k != "exact compiled"}
    timed = Race(times, dict.fromkeys(times, 4096), 1, 2, {"exact compiled": "no C++ compiler"})
    outcome = Outcome()
    hold_to_promises([{"file": "a.onnx", "promised_speedup": 9.0}], timed, outcome)
    assert outcome.missed == [] and outcome.checked == 0
    assert "no C++ compiler" in outcome.unchecked[0]
    rows = table_rows("lens", timed)
    assert rows[-1]["reason"] == "no C++ compiler"
    assert rows[-1]["ns_per_ray"] is None


def test_the_table_holds_best_median_and_both_ratios() -> None:
    row = next(r for r in table_rows("lens", raced(TIMES)) if r["name"] == "a.onnx")
    assert row["ns_per_ray"] == {"min": 15.0, "median": 15.75, "threads": 1, "batch": 4096, "repeats": 2}
    assert row["speedup_over_compiled"] == {"min": 2.0, "median": 2.0}
    assert row["speedup_over_eager"]["min"] == pytest.approx(200 / 15)


@pytest.mark.parametrize(
    "text",
    [
        None,
        "",
        "{",
        "[]",
        '{"models": 3}',
        '{"models": [{"file": "a.onnx"}]}',
        '{"models": [3]}',
        '{"rows": []}',
        '{"models": [{"file": "../a.onnx", "lens_file": "a.toml"}]}',
    ],
)
def test_a_bad_index_is_one_clear_error(tmp_path: Path, text: str | None, capsys: pytest.CaptureFixture[str]) -> None:
    if text is not None:
        (tmp_path / "index.json").write_text(text)
    with pytest.raises(InputError, match="index.json"):
        read_index(tmp_path)
    assert main(["promises", "--models", str(tmp_path), "--out", str(tmp_path / "out")]) == 2
    shown = capsys.readouterr().err.strip()
    assert "index.json" in shown and "\n" not in shown
    assert not (tmp_path / "out").exists()


def test_a_speed_below_its_floor_fails() -> None:
    good, bad = Floor("tracer", 6.0, 6.1, "Mray/s"), Floor("render", 1.0, 0.9, "Mpath/s")
    unknown = Floor("compiled", 20.0, None, "Mray/s", "no C++ compiler")
    assert report_outcome(Outcome(floors=[good, unknown])) == 0
    assert report_outcome(Outcome(floors=[good, bad])) == 1
    assert [floor.verdict for floor in (good, bad, unknown)] == ["pass", "FAIL", "UNCHECKED"]
