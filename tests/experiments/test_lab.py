"""What the measurements share: rows of an earlier run, tables."""

from __future__ import annotations

from pathlib import Path

import pytest

from experiments import lab
from experiments.__main__ import main
from neurolens.base.errors import InputError


def test_rows_of_an_earlier_run_are_kept_or_refused(tmp_path: Path) -> None:
    file = tmp_path / "rows.json"
    assert lab.kept_rows(file, "lenses", "lens", "a command") == {}
    file.write_text('{"lenses": [{"lens": "a", "n": 1}, {"lens": "b"}]}', encoding="utf-8")
    assert lab.kept_rows(file, "lenses", "lens", "a command") == {"a": {"lens": "a", "n": 1}, "b": {"lens": "b"}}
    for text in ("", "[]", "{}", '{"lenses": 3}', '{"lenses": [{"n": 1}]}', '{"lenses": ["a"]}'):
        file.write_text(text, encoding="utf-8")
        with pytest.raises(InputError, match=r"rows\.json: file: .*records of a command"):
            lab.kept_rows(file, "lenses", "lens", "a command")


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
