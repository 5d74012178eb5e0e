"""`neurolens convert` from outside: what it prints, what it writes, and what it leaves alone."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest
from command_line import failure
from lens_formats import WRITERS, CannotSay, plain
from shipped import PATHS

from neurolens.cli import main
from neurolens.optics.lensfile import read_lens
from neurolens.readers.any_format import read_any

TABLE = "# Singlet\n0 4.0 0 10\n50 5.0 1.5 20\n-50.0 0 1 20\n"


@pytest.fixture
def table(tmp_path: Path) -> Path:
    path = tmp_path / "singlet.dat"
    path.write_text(TABLE)
    return path


def test_json_has_units_in_its_keys(table: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["convert", str(table), "-o", str(tmp_path / "lens.toml"), "--units", "in", "--json"]) == 0
    captured = capsys.readouterr()
    data = json.loads(captured.out)
    assert captured.err == ""
    assert data["efl_mm"] == pytest.approx(25.4 / (0.5 * (2 / 50 - 0.5 * 5 / (1.5 * 2500))))
    assert data["efl_x_mm"] is None and data["configurations"] == [] and data["surfaces"] == 3
    assert any("no f-number is stated" in text for text in data["warnings"])


def test_a_file_that_is_there_stays_without_force(
    table: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "lens.toml"
    out.write_text("mine")
    assert "--force" in failure(capsys, "convert", table, "-o", out)
    assert out.read_text() == "mine"
    assert main(["convert", str(table), "-o", str(out), "--force"]) == 0
    assert read_lens(out).name == "Singlet"


def test_nothing_is_written_for_a_bad_file(table: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    table.write_text(TABLE + "1 2 3\n")
    assert "singlet.dat: line 5, row: got '1 2 3'" in failure(capsys, "convert", table, "-o", tmp_path / "lens.toml")
    assert list(tmp_path.iterdir()) == [table]


@pytest.mark.parametrize(
    ("args", "message"),
    [
        (("-o", "lens.json"), "--output: got '.json', expected .toml"),
        (("-o", "nowhere/lens.toml"), "a folder that exists"),
        ((), "required: -o"),
        (("-o", "lens.toml", "--f-number", "0"), "an f-number above 0"),
        (("-o", "lens.toml", "--units", "ell"), "invalid choice: 'ell'"),
        (("-o", "lens.toml", "--half-field", "200"), "from 0.001 to 179"),
    ],
)
def test_wrong_command_lines(
    args: tuple[str, ...],
    message: str,
    table: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(table.parent)
    assert message in failure(capsys, "convert", table, *args)


def test_options_for_tables_alone(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "lens.zmx"
    path.write_text(WRITERS[".zmx"](plain(read_lens(PATHS[0]))))
    assert "--gap-before" in failure(capsys, "convert", path, "-o", tmp_path / "lens.toml", "--gap-before")


@pytest.mark.parametrize("path", PATHS[::4], ids=lambda p: p.stem)
def test_round_trip(path: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Other program -> lens file -> the same lens, bit for bit."""
    lens = plain(read_lens(path))
    for suffix in (".zmx", ".seq", ".json"):
        foreign, out = tmp_path / f"lens{suffix}", tmp_path / f"{suffix[1:]}.toml"
        try:
            foreign.write_text(WRITERS[suffix](lens))
        except CannotSay:
            continue
        assert main(["convert", str(foreign), "-o", str(out)]) == 0
        assert replace(read_lens(out), path=str(foreign)) == read_any(foreign)
    assert "written to" in capsys.readouterr().out


def test_a_lens_file_of_our_own_is_read_too(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "lens.toml"
    assert main(["convert", str(PATHS[2]), "-o", str(out)]) == 0
    assert replace(read_lens(out), path=str(PATHS[2])) == read_lens(PATHS[2])
    capsys.readouterr()
    assert "--name and --source only" in failure(capsys, "convert", PATHS[2], "-o", out, "--force", "--units", "in")
    assert main(["convert", str(PATHS[2]), "-o", str(out), "--force", "--name", "mine"]) == 0
    assert read_lens(out).name == "mine"
