"""The harness that kills commands: one small command through all that it does."""

import sys
from pathlib import Path

import pytest

from experiments.__main__ import main


@pytest.mark.whole  # a command of its own
@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="it forks, and reads /proc")
def test_merging_survives_what_the_harness_does(tmp_path: Path) -> None:
    assert main(["survive", "--only", "merge", "--kills", "1", "--output", str(tmp_path)]) == 0
    row = (tmp_path / "survive.md").read_text().splitlines()[-1].split(" | ")
    same, whole = map(int, row[3].split(" of "))  # runs that ended; one that a kill came too late for is one, too
    assert row[:2] == ["| merge", "1"] and same == whole >= 1 and row[4] == "0 |"
