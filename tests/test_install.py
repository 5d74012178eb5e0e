"""How `make` installs torch: small where no NVIDIA driver is, and its size said before it is spent; the wheel alone."""

import os
import re
import shutil
import subprocess
import sys
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


@pytest.mark.slow
def test_the_wheel_of_the_source_distribution_renders_the_first_picture_of_the_readme(tmp_path: Path) -> None:
    """Away from the checkout, without torch. `make release` also makes an environment for it, and checks its texts."""
    source, parts, away = tmp_path / "source", tmp_path / "wheel", tmp_path / "away"
    for folder in ("neurolens", "models", "experiments/scenes", "tests"):
        shutil.copytree(ROOT / folder, source / folder, ignore=shutil.ignore_patterns("__pycache__"))
    # A seventh of the lenses: hundreds are packed and unpacked in the same way.
    shutil.copytree(ROOT / "lenses", source / "lenses", ignore=shutil.ignore_patterns("[!c]*.toml", "[!c]*.svg"))
    for name in ("pyproject.toml", "MANIFEST.in", "README.md", "LICENSE", "CITATION.cff", "CHANGELOG.md"):
        shutil.copy(ROOT / name, source)
    away.mkdir()

    def python(code: str, cwd: Path, *path: Path) -> str:
        env = {**os.environ, "PYTHONPATH": os.pathsep.join(map(str, path)), "PYTHONDONTWRITEBYTECODE": "1"}
        done = subprocess.run(
            [sys.executable, "-c", code], cwd=cwd, capture_output=True, text=True, env=env, check=False
        )
        assert done.returncode == 0, done.stderr
        return done.stdout

    build = "from setuptools import build_meta as b; print(); print(b.build_{}({!r}))"
    made = python(build.format("sdist", str(tmp_path)), source).splitlines()[-1]
    shutil.unpack_archive(tmp_path / made, tmp_path / "unpacked")
    (unpacked,) = (tmp_path / "unpacked").iterdir()
    assert not (unpacked / "tests").exists() and (unpacked / "CITATION.cff").exists()
    wheel = python(build.format("wheel", str(tmp_path)), unpacked).splitlines()[-1]
    pip = [sys.executable, "-m", "pip", "install", "-q", "--no-deps", "--no-index", "--no-compile", "--target", parts]
    subprocess.run([*pip, tmp_path / wheel], check=True, capture_output=True)
    line = re.search(r"^    neurolens (render .*?)(?: +#.*)?$", (ROOT / "README.md").read_text(encoding="utf-8"), re.M)
    assert line is not None
    code = "import sys; sys.modules['torch'] = None; import neurolens; from neurolens.cli import main; "
    code += f"print(neurolens.__file__); sys.exit(main({[*line[1].split(), '--width', '24', '--samples', '1']!r}))"
    assert str(parts) in python(code, away, parts).splitlines()[0]
    assert (away / "first.png").stat().st_size > 0
