"""How `make` installs torch: small where no NVIDIA driver is, and its size said before it is spent."""

import os
import shutil
import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
# Stands for Python: makes an environment of itself, notes what pip is asked for, and reaches an index or does not.
STUB = """#!/bin/sh
case "$1 $2" in
"-m venv") mkdir -p "$3/bin"; cp "$0" "$3/bin/python" ;;
"-m pip") echo "pip $*" >> "$NOTES"; echo "pip runs" ;;
"-c import sys, urllib"*) exit "$REACHED" ;;
esac
"""
pytestmark = pytest.mark.skipif(
    shutil.which("make") is None or os.uname().sysname != "Linux", reason="no make, or not Linux"
)


@pytest.mark.parametrize(
    ("reached", "driver", "asked", "said"),
    [
        (True, False, True, "under 1 GB"),
        (False, False, False, "5.9 GB"),
        (True, True, False, "5.9 GB"),
    ],
    ids=["no driver", "index out of reach", "driver"],
)
def test_torch_is_small_without_a_driver_and_its_size_is_said_first(
    reached: bool, driver: bool, asked: bool, said: str, tmp_path: Path
) -> None:
    tools = tmp_path / "bin"
    tools.mkdir()
    for name in ("sh", "uname", "mkdir", "cp", "touch", "sleep", "du", "cut", "rm", "make"):
        (tools / name).symlink_to(str(shutil.which(name)))
    for name in ("python3", *(["nvidia-smi"] if driver else [])):
        (tools / name).write_text(STUB)
        (tools / name).chmod(0o755)
    for name in ("Makefile", "pyproject.toml", "constraints.txt"):
        shutil.copy(ROOT / name, tmp_path)
    done = subprocess.run(
        ["make", ".venv/.installed", f"PYTHON={tools / 'python3'}"], cwd=tmp_path, capture_output=True, text=True,
        check=False, env={"PATH": str(tools), "NOTES": str(tmp_path / "notes"), "REACHED": str(int(not reached))},
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    first, *others = (tmp_path / "notes").read_text().splitlines()
    assert first.endswith(" torch") and ("--extra-index-url https://download.pytorch.org/whl/cpu" in first) == asked
    assert others and not any("--extra-index-url" in line for line in others)
    assert said in done.stdout and done.stdout.index(said) < done.stdout.index("pip runs")
