"""Small measurements: goals that cannot be missed unseen, kept rows, promises, pupils, render times."""

from __future__ import annotations

import math
from functools import cache, partial
from itertools import pairwise
from pathlib import Path

import pytest

from experiments import lab
from experiments import pupils as passage
from experiments.__main__ import main
from experiments.promises import Floor, Outcome, hold_to_promises, read_index, report_outcome, table_rows
from experiments.pupils import CASES, TABLE_5_3
from experiments.render_times import shapes
from neurolens.base.errors import InputError
from neurolens.evaluate.speed import Race


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


def test_goals_cannot_be_missed_unseen() -> None:
    made = [lab.Goal("a", 5.0, v, at_least=at_least) for at_least in (True, False) for v in (4.9, 5.0, 5.1, None)]
    reached, missed = "reached", "missed"
    assert [g.verdict for g in made] == [
        missed, reached, reached, "not measured", reached, reached, missed, "not measured",
    ]  # fmt: skip


def test_a_measurement_knows_no_other_options(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit, match="2"):
        main(["nonsense"])
    assert main(["pupils", "--only", "nobody", "--quiet"]) == 2
    assert "--only" in capsys.readouterr().err


def test_areas_of_the_shapes() -> None:
    area = {s.name: s.area for s in shapes()}
    assert area["5 edges"] == pytest.approx(5 / 2 * math.sin(2 * math.pi / 5) / math.pi)
    # Ten triangles between the centre, a point and an inner corner.
    assert area["star"] == pytest.approx(5 * 0.48 * math.sin(math.pi / 5) / math.pi, abs=0.003)
    assert area["round"] == 1 and 0.4 < area["heart"] < 0.6


TIMES = {"exact eager": [200.0, 220.0], "exact compiled": [30.0, 33.0], "a.onnx": [15.0, 16.5], "b.onnx": [20.0, 22.0]}


def raced(reason: str = "") -> Race:
    times = {k: v for k, v in TIMES.items() if not reason or k != "exact compiled"}
    return Race(times, dict.fromkeys(times, 4096), 1, 2, {"exact compiled": reason} if reason else {})


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
    rows = {r["name"]: r for r in table_rows("lens", timed)}
    assert rows["exact compiled"]["reason"] == (reason or None)
    assert (rows["exact compiled"]["ns_per_ray"] is None) == bool(reason)


BROKEN = ("", "{", "[]", '{"models": 3}', '{"models": [{"file": "a.onnx"}]}', '{"models": [3]}', '{"rows": []}')
ELSEWHERE = '{"models": [{"file": "../a.onnx", "lens_file": "a.toml"}]}'


@pytest.mark.parametrize("text", [None, *BROKEN, ELSEWHERE])
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


SAMPLES = 2**13


@cache
def measured(lens: str, f_number: float) -> lab.Row:
    case = next(c for c in CASES if (c.lens, c.f_number) == (lens, f_number))
    return passage.measure(case, SAMPLES)


@pytest.mark.parametrize(
    ("lens", "f_number", "goal"), [("muller_fisheye_100", 5.6, 0.97), ("brendel_tessar_100", 4.0, 0.99)]
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


def test_pixel_of_table_5_3() -> None:
    rows = list(passage.pixel_rates(SAMPLES))
    assert [n for n, _, _ in rows] == list(TABLE_5_3)
    # Once vignetting is past, the rate goes with the area of the stop.
    areas = [rate * n**2 for n, rate, _ in rows[1:6]]
    for area, later in pairwise(areas):
        assert later / area == pytest.approx(1, rel=0.1)
