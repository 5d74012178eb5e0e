"""MkDocs: the page of commands, the list of modules, and the repository's files that pages link to.

Links in pages lead out of this folder as they do in the repository; here those files (tables, pictures, lens files)
become part of the site under repository/.
"""

import ast
import io
import os
import posixpath
import re
from contextlib import redirect_stdout, suppress
from pathlib import Path
from typing import Any

from mkdocs.structure.files import File, Files

ROOT = Path(__file__).resolve().parents[1]
PAGES = ROOT / "docs" / "pages"
HELD = "repository"
_LINK = re.compile(r"(\]\()([^)#\s:]+)(?=[)#])")
_PACKAGES = ("base", "graph", "modelfile", "optics", "readers", "analysis", "surrogates", "cameras", "render", "flare",
             "evaluate")  # fmt: skip


def on_files(files: Files, config: Any) -> Files:
    """Add what is made here and what pages link to."""
    files.append(File.generated(config, "reference/commands.md", content=_commands()))
    files.append(File.generated(config, "reference/api.md", content=_modules(files, config)))
    waiting, seen = list(PAGES.rglob("*.md")), set()
    while waiting:
        page = waiting.pop()
        for _, link in _LINK.findall(page.read_text(encoding="utf-8")):
            target = _target(page, link)
            if target and target not in seen:
                seen.add(target)
                source = f"{HELD}/{target.relative_to(ROOT).as_posix()}"
                files.append(File.generated(config, source, abs_src_path=str(target)))
                waiting += [target] if target.suffix == ".md" else []
    return files


def on_page_markdown(markdown: str, page: Any, config: Any, files: Files) -> str:
    """Links out of the pages, as the site has them; tables of the repository may link to what it leaves out."""
    source = page.file.src_uri
    held = source.startswith(f"{HELD}/")
    file = ROOT / source.removeprefix(f"{HELD}/") if held else PAGES / source

    def moved(match: re.Match[str]) -> str:
        target = _target(file, match[2])
        if target is None:
            return match[0]
        return match[1] + posixpath.relpath(f"{HELD}/{target.relative_to(ROOT).as_posix()}", posixpath.dirname(source))

    return _LINK.sub(moved, markdown)


def _target(page: Path, link: str) -> Path | None:
    """File of the repository outside the pages that a link leads to; a folder's is its README."""
    target = Path(os.path.normpath(page.parent / link))
    if target.is_dir():
        target = target / "README.md"
    inside = target.is_relative_to(PAGES) or not target.is_relative_to(ROOT)
    return None if inside or not target.is_file() else target


def _commands() -> str:
    """Help of every command."""
    os.environ["COLUMNS"] = "110"
    from neurolens.cli import main

    def told(*words: str) -> str:
        text = io.StringIO()
        with redirect_stdout(text), suppress(SystemExit):
            main([*words, "--help"])
        return re.sub(r"\x1b\[[0-9;]*m", "", text.getvalue())

    names = re.findall(r"^    ([a-z]+)\s", told(), re.MULTILINE)
    parts = ["# Commands", f"```text\n{told()}```"]
    parts += [f"## neurolens {name}\n\n```text\n{told(name)}```" for name in names]
    return "\n\n".join(parts) + "\n"


def _modules(files: Files, config: Any) -> str:
    """A page for each package, and the page that lists them: modules by the first line of their docstring."""
    lines = ["# API", "", "Modules by package; what is not listed there is private.", ""]
    for package in _PACKAGES:
        rows, bodies = [], []
        for path in sorted((ROOT / "neurolens" / package).glob("*.py")):
            said = ast.get_docstring(ast.parse(path.read_text(encoding="utf-8")))
            if path.stem == "__init__" or not said:
                continue
            name = f"neurolens.{package}.{path.stem}"
            rows.append(f"| [`{path.stem}`](api/{package}.md#{name}) | {said.splitlines()[0].replace('|', '/')} |")
            bodies.append(f"::: {name}")
        page = "\n\n".join([f"# neurolens.{package}", *bodies]) + "\n"
        files.append(File.generated(config, f"reference/api/{package}.md", content=page))
        lines += [f"## neurolens.{package}", "", "| module | |", "|---|---|", *rows, ""]
    return "\n".join(lines)
