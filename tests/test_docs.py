"""The documentation: its links lead somewhere, its commands are commands, its how-tos run (`make docs`)."""

import importlib.util
import os
import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

from neurolens.base.lensname import Named
from neurolens.cli import build_parser

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs" / "pages"
PAGES = [ROOT / "README.md", *sorted(DOCS.rglob("*.md"))]
HOW_TO = sorted((DOCS / "how-to").glob("*.md")) + [DOCS / "first-hour.md"]
BLOCK = re.compile(r'^```(\w+)(?: title="([^"]+)")?\n(.*?)^```', re.MULTILINE | re.DOTALL)
NODE = "onnxruntime-node@1.30"
MADE = {"reference/commands.md", "reference/api.md"}  # when the site is built


def name_of(page: Path) -> str:
    return page.relative_to(ROOT).as_posix()


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_links_lead_to_files(page: Path) -> None:
    made = [DOCS / made for made in MADE]
    for link in re.findall(r"\]\(([^)#\s:]+)[)#]", page.read_text(encoding="utf-8")):
        target = Path(os.path.normpath(page.parent / link))
        assert target in made or target.exists(), link


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_commands_are_commands(page: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    # Lenses and models of the pages need not be there.
    monkeypatch.setattr("neurolens.commands.arguments.resolve", lambda text, **taken: Named("", Path(text)))
    text = page.read_text(encoding="utf-8").replace("\\\n", " ")
    lines = re.findall(r"^(?: {4})?neurolens (?!COMMAND)(.*)$", text, re.MULTILINE)
    for line in lines:
        build_parser().parse_args(shlex.split(line, comments=True))  # exits where it is none


@pytest.mark.skipif("NEUROLENS_DOCS" not in os.environ, reason="how-tos take minutes: make docs runs them")
@pytest.mark.parametrize("page", HOW_TO, ids=name_of)
def test_how_tos_run(page: Path, tmp_path: Path) -> None:
    """Blocks with a title are files, others run one after the other in a folder that has the library."""
    for folder in ("lenses", "models", "experiments"):
        (tmp_path / folder).symlink_to(ROOT / folder)
    blocks = BLOCK.findall(page.read_text(encoding="utf-8"))
    assert blocks
    path = os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]])
    for language, title, code in blocks:
        if title:
            (tmp_path / title).write_text(code, encoding="utf-8")
        command = {"sh": ["sh", "-ec", code], "python": [sys.executable, "-c", code]}.get(language)
        if language == "js":
            npm = f"command -v npm >/dev/null && npm install --silent --no-fund --ignore-scripts {NODE} || exit 77; "
            command = ["sh", "-ec", f"{npm} node {title}"]
        if language == "cpp" and (headers := os.environ.get("NEUROLENS_ORT_HEADERS")):  # its wheel has none
            capi = Path(importlib.util.find_spec("onnxruntime").origin).parent / "capi"
            link = f"ln -s {next(capi.glob('libonnxruntime.so.*'))} libonnxruntime.so.1"
            build = f"c++ -std=c++17 -I{headers} {title} libonnxruntime.so.1 -Wl,-rpath,. -o program"
            command = ["sh", "-ec", f"{link}; {build}; ./program"]
        if command:
            done = subprocess.run(
                command, cwd=tmp_path, env={**os.environ, "PATH": path}, capture_output=True, text=True
            )
            if done.returncode == 77:
                pytest.skip("JavaScript was not run: npm or its registry is not there")
            assert done.returncode == 0, f"{code}\n{done.stdout}\n{done.stderr}"
