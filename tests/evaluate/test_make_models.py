"""The index of the models that ship: whole at any time, whatever interrupts the run. Nothing is fitted here."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from neurolens.config import from_dict
from neurolens.errors import InputError
from neurolens.evaluate import make_models
from neurolens.evaluate.bench import read_index
from neurolens.progress import Progress

TWO = {"entry": [{"lens": {"file": f"{name}.toml"}, "models": [{"terms": 6}]} for name in ("one", "two")]}


def row(file: str, rms_um: float) -> dict[str, Any]:
    figures = dict.fromkeys(make_models._KEPT, 1.0)
    timed = {"ns_per_ray": {"min": 20.0}, "speedup_over_compiled": 2.0}
    return {"file": file, "lens_file": "lenses/a.toml", **figures, **timed, "rms_um": rms_um}


@pytest.fixture
def broken(monkeypatch: pytest.MonkeyPatch) -> set[str]:
    """Lenses whose entry is interrupted; all others give one row a file."""
    broken: set[str] = set()

    def make_entry(entry: make_models.Entry, *_: object) -> list[dict[str, Any]]:
        if entry.state in broken:
            raise KeyboardInterrupt
        return [row(file, 2.0) for file in entry.files]

    monkeypatch.setattr(make_models, "make_entry", make_entry)
    return broken


def indexed(folder: Path) -> dict[str, float]:
    return {r["file"]: r["rms_um"] for r in read_index(folder)}


def test_an_interrupted_run_keeps_the_rows_of_the_others(tmp_path: Path, broken: set[str]) -> None:
    library = from_dict(make_models.Library, TWO, "test")
    make_models.write_index([row("two.ols-6.onnx", 9.0), row("gone.onnx", 9.0)], tmp_path)
    broken.add("two")
    with pytest.raises(KeyboardInterrupt):
        make_models.make_library(library, tmp_path, tmp_path, Progress(quiet=True))
    assert indexed(tmp_path) == {"two.ols-6.onnx": 9.0, "gone.onnx": 9.0, "one.ols-6.onnx": 2.0}
    broken.clear()
    make_models.make_library(library, tmp_path, tmp_path, Progress(quiet=True))
    assert list(indexed(tmp_path).items()) == [("one.ols-6.onnx", 2.0), ("two.ols-6.onnx", 2.0)]
    assert "gone" not in (tmp_path / "README.md").read_text()


def test_a_broken_index_is_made_anew(tmp_path: Path, broken: set[str]) -> None:
    (tmp_path / "index.json").write_text('{"models": [{"file": "two.ols-6.onnx", "lens_file": "a"}]}')
    make_models.make_library(from_dict(make_models.Library, TWO, "test"), tmp_path, tmp_path, Progress(quiet=True))
    assert len(indexed(tmp_path)) == 2


@pytest.mark.parametrize(
    "entry",
    [
        {"lens": {"file": "one.toml", "configuration": "../up"}},
        {"lens": {"file": "one.toml"}, "models": [{"name": "a/b"}]},
        {"lens": {"file": "one.toml"}, "models": [{"terms": 6}, {"terms": 6}]},
        {"lens": {"file": "one.toml"}, "models": []},
    ],
)
def test_names_that_are_no_file_names_are_refused(entry: dict[str, Any]) -> None:
    with pytest.raises(InputError, match="entry"):
        from_dict(make_models.Library, {"entry": [entry]}, "test")


def test_a_list_that_is_not_there_makes_no_folder(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    arguments = ["--experiment", str(tmp_path / "no.toml"), "--out", str(tmp_path / "models")]
    assert make_models.main(arguments) == 2
    assert "no.toml" in capsys.readouterr().err
    assert not (tmp_path / "models").exists()
