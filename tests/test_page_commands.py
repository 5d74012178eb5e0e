"""Commands of README and pages as printed: each can be parsed, and its files exist or are made by earlier lines."""

import re
import shlex
import subprocess
import sys
from collections.abc import Iterator
from contextlib import suppress
from importlib.util import find_spec
from pathlib import Path

import pytest

from experiments.__main__ import build_parser as experiments_parser
from neurolens.base import lensname
from neurolens.base.errors import NeurolensError
from neurolens.base.lensname import Named, split_kind
from neurolens.cli import build_parser, main

ROOT = Path(__file__).parents[1]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs" / "pages").rglob("*.md")), ROOT / "models" / "README.md"]
BLOCK = re.compile(r'^```(\w+)(?: title="([^"]+)")?\n(.*?)^```|^ {4}(\S[^\n]*)$|`([^`\n]+)`', re.MULTILINE | re.DOTALL)
PROGRAMS = re.compile(r"(neurolens|python -m experiments|make) (?=[a-z-])")
PARSER = build_parser()
WRITTEN = {
    "out",
    "output",
    "lens_file",
    "layout",
    "breathing",
    "fit",
    "plot",
    "csv",
}  # what options name that a command writes


def lines_of(page: Path) -> Iterator[tuple[str, bool]]:
    """The lines of shell blocks, indented lines, and commands in sentences, which may be a name alone (True)."""
    for language, title, block, indented, quoted in BLOCK.findall(page.read_text(encoding="utf-8")):
        if title:
            yield f": {title}", False
        elif language == "sh":
            yield from ((line, False) for line in block.replace("\\\n", " ").splitlines())
        elif not language:
            yield indented or quoted, bool(quoted)


def test_all_commands_of_the_readme_are_found() -> None:
    lines = [line for line, _ in lines_of(PAGES[0])]
    printed = [line.strip() for line in PAGES[0].read_text(encoding="utf-8").splitlines() if line.startswith("    ")]
    assert [line for line in printed if PROGRAMS.match(line) and line not in lines] == []
    assert sum(bool(PROGRAMS.match(line)) for line in lines) >= 12


def exists(path: Path, made: set[Path]) -> bool:
    return path.exists() or not made.isdisjoint({path, *path.parents})


def check(line: str, words: list[str], made: set[Path]) -> None:
    """Parse a command, look for what it reads, and note what it writes."""
    args = PARSER.parse_args(words)  # exits where it is none
    for name, value in vars(args).items():
        for each in value if isinstance(value, list | tuple) else [value]:
            file = Path(split_kind(each)[1]) if name == "camera" and isinstance(each, str) else each
            if isinstance(file, Path) and name not in WRITTEN and file.name not in {"list", *lensname.IDEAL}:
                named = name == "files" and not exists(file, made) and lensname.resolve(file, cameras=False)
                assert named or exists(file, made), f"{line}: nothing makes {file}"
    if (out := getattr(args, "output", None) or getattr(args, "out", None)) is not None:
        assert exists(out.parent, made) or "runs" in out.parts, f"{line}: no folder {out.parent}"
        tiles = [out.with_name(f"{out.stem}.tile-*{out.suffix}")] if getattr(args, "tile", None) else []
        made.update({out, out.with_suffix(".png"), *tiles})
    made.update(Path(value) for name in WRITTEN if (value := getattr(args, name, None)))


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.relative_to(ROOT).as_posix())
def test_commands_run_as_printed(page: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("lenses", "models", "experiments", "Makefile"):
        (tmp_path / name).symlink_to(ROOT / name)
    monkeypatch.chdir(tmp_path)
    made, variables = set[Path](), dict[str, str]()
    resolve = lensname.resolve

    def resolved(text: str, **taken: bool) -> Named:
        kind, file = split_kind(text)
        early = not Path(file).exists() and exists(Path(file), made)
        return Named(kind, Path(file)) if early else resolve(text, **taken)

    monkeypatch.setattr("neurolens.cli.arguments.resolve", resolved)
    for line, quoted in lines_of(page):
        for name, value in variables.items():
            line = line.replace(f"${name}", value)
        if named := re.findall(r"(?:^|; )(\w+)=([^;\s]+)", line):
            variables.update(named)
        elif not (program := PROGRAMS.match(line)):
            made |= {Path(word) for word in shlex.split(line, comments=True)} if not quoted else set()
        elif not re.search(r"\b[A-Z]{3,}\b|\.\.\.", line.partition(" #")[0]):
            words = shlex.split(line, comments=True)[len(program[1].split()) :]
            if program[1] == "make":
                assert re.search(rf"^{words[0]}:", Path("Makefile").read_text(), re.MULTILINE), line
            elif program[1] == "neurolens" and quoted and all(word.startswith("--") for word in words[1:]):
                assert words[0] in PARSER.format_help(), line  # the name of a command, or of its options
            elif program[1] == "neurolens":
                if quoted and page.name != "README.md":  # a sentence about files that the reader has
                    made.update(Path(word) for word in words)
                check(line, words, made)
            elif words != ["--help"]:
                with suppress(NeurolensError):  # packages that a measurement brings in an environment of its own
                    asked = experiments_parser(words).parse_args(words)
                    made |= {Path(asked.output)} if getattr(asked, "output", None) else set()


# The README's lines run, some in a smaller size, by a model or a simpler lens: what is printed, and what stands for it.
SMALLER = {
    "handover laikin_double_gauss_50": "handover laikin_double_gauss_50.ols-36",
    "flare canon_50mm_f1_2": "flare cooke_triplet_50",
    "projection laikin_double_gauss_50": "projection laikin_double_gauss_50.ols-36",
    "--width 3840": "--width 96",
    "--width 480 --samples 64": "--width 24 --samples 1",
    "--width 480 --film": "--width 24 --film",
    "-o flare.exr": "--width 24 --bins 3 --cell 64 -o flare.exr",
    "train --lens my_lens.toml": "train --lens my_lens.toml --rounds 0 --set 'model=[{method=\"ols\",terms=12}]'"
    " --set pairs.train=512 --set pairs.held_out=512 --set evaluation.vignetting_rays=2000",
    "-o charts": "spots mtf --field-points 0 15 --wavelengths 550 -o charts",
}
# Lines that this test leaves out, and why; `neurolens demo` takes 4 minutes, and is a name alone.
LEFT_OUT = {
    "neurolens blender build": "18 s for the shaders; tests/programs/blender/test_command.py runs it without them",
    "python -m experiments": "measurements of minutes to days; they are parsed above",
}


def printed_in(page: Path) -> list[str]:
    """The commands of a page, on lines of their own or in sentences, in their order."""
    found = []
    for line, quoted in lines_of(page):
        line = line.rpartition("&& ")[2].strip()
        if PROGRAMS.match(line) and not line.startswith("make") and not (quoted and len(line.split()) < 3):
            found.append(line)
    return found


def test_lines_of_the_readme_run_and_leave_nothing_that_lint_or_git_sees(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, no_plots: None
) -> None:
    for name in ("lenses", "models", "experiments", "pyproject.toml", ".gitignore"):
        (tmp_path / name).symlink_to(ROOT / name)
    before = set(tmp_path.iterdir())
    monkeypatch.chdir(tmp_path)
    ran, smaller, left_out = list[str](), set[str](), set[str]()
    for line in printed_in(PAGES[0]):
        if out := [start for start in LEFT_OUT if line.startswith(start)]:
            left_out.update(out)
            continue
        if "analyse" in line and find_spec("matplotlib") is None:
            continue
        for printed, small in SMALLER.items():
            if printed in line:
                smaller.add(printed)
                line = line.replace(printed, small)
        assert main([*shlex.split(line, comments=True)[1:], "--quiet"]) == 0, line
        ran.append(line.split()[1])
    assert len(ran) >= 6 and smaller == set(SMALLER) and left_out == set(LEFT_OUT)  # none that the README lost
    made = sorted(set(tmp_path.iterdir()) - before)
    assert made and list(tmp_path.glob("shot/*.blender.py"))
    names = [file.name + "/" * file.is_dir() for file in made]
    ignored = subprocess.run(["git", "-C", ROOT, "check-ignore", *names], capture_output=True, text=True)
    if ignored.returncode != 128:  # a checkout
        assert ignored.stdout.split() == names
    lint = [sys.executable, "-m", "ruff"]
    if find_spec("ruff") is not None:
        for words in (["check", "."], ["format", "--check", "."]):
            found = subprocess.run([*lint, *words, "--no-cache"], capture_output=True, text=True)
            assert found.returncode == 0, found.stdout
