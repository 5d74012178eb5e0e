"""Sphinx: the site is made of the repository's own Markdown files, so that their links work in both.

What is generated: the help of every command, pages of the modules from their docstrings, and the menus, which list the
pages that an index page links to, in its order.
"""

import os
import re
import shutil
import sys
from contextlib import redirect_stdout, suppress
from io import StringIO
from pathlib import Path
from typing import Any

from pygments.lexers.special import TextLexer

ROOT = Path(__file__).resolve().parents[1]
PAGES = ROOT / "docs" / "pages"
ROOMS = ("base", "graph", "optics", "models", "cameras", "pictures", "programs", "studies")
sys.path.insert(0, str(ROOT))

project = html_title = "neurolens"
extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon"]
root_doc = "docs/pages/index"
include_patterns = ["docs/pages/**", "experiments/results/**", "models/README.md", "neurolens/README.md"]
exclude_patterns = [".venv*", ".git", "build", "runs"]
source_suffix = {".md": "markdown"}
myst_heading_anchors = 4
autodoc_default_options = {"members": True, "member-order": "bysource"}
default_role = "code"
napoleon_use_ivar = True  # attributes that a docstring lists are no second entry
suppress_warnings = ["ref.python"]  # classes of one name in two modules: a signature says which

html_theme = "pydata_sphinx_theme"
html_context = {"default_mode": "auto"}
html_theme_options = {"show_prev_next": False, "footer_start": [], "footer_end": []}
html_sidebars = {f"docs/pages/{page}": [] for page in ("first-hour", "explanation", "papers")}  # pages without a menu
html_extra_path = ["index.html"]  # leads to the first page
html_static_path = ["static"]
html_css_files = ["style.css"]
html_show_search_summary = False  # a page that is opened from disk may not read the others
html_copy_source = html_show_sourcelink = False


def setup(app: Any) -> None:
    """Connect what is generated to the build."""
    (PAGES / "reference" / "commands.md").write_text(_commands(), encoding="utf-8")
    _write_api(PAGES / "reference" / "api")
    app.add_lexer("csv", TextLexer)
    app.connect("source-read", _prepare)
    app.connect("autodoc-process-docstring", _to_restructured_text, priority=400)  # before napoleon's


def _commands() -> str:
    """The help of every command."""
    os.environ["COLUMNS"] = "100"
    from neurolens.cli import main

    def help_of(*words: str) -> str:
        text = StringIO()
        with redirect_stdout(text), suppress(SystemExit):
            main([*words, "--help-all" if words else "--help"])
        return re.sub(r"\x1b\[[0-9;]*m", "", text.getvalue())

    names = re.findall(r"^    ([a-z]+)\s", help_of(), re.MULTILINE)
    parts = ["# Commands", f"```text\n{help_of()}```"]
    parts += [f"## neurolens {name}\n\n```text\n{help_of(name)}```" for name in names]
    return "\n\n".join(parts) + "\n"


def _write_api(folder: Path) -> None:
    """One page a room, with the docstrings of its modules, and an index of these pages."""
    shutil.rmtree(folder, ignore_errors=True)  # modules that are gone
    folder.mkdir()
    index = ["# API", "Modules by room. What is not listed there is private."]
    for package in ROOMS:
        files = sorted((ROOT / "neurolens" / package).rglob("[!_]*.py"))
        parts = [file.relative_to(ROOT).with_suffix("").parts for file in files]
        names = [".".join(names) for names in parts if "extension" not in names]  # Blender loads that
        parts = [f"# neurolens.{package}", *(_module(name) for name in names)]
        (folder / f"{package}.md").write_text("\n\n".join(parts) + "\n", encoding="utf-8")
        index.append(f"- [neurolens.{package}]({package}.md)")
    (folder / "index.md").write_text("\n\n".join(index) + "\n", encoding="utf-8")


def _module(name: str) -> str:
    return f"## {name.split('.', 2)[2]}\n\n```{{eval-rst}}\n.. automodule:: {name}\n```"


def _prepare(app: Any, document: str, content: list[str]) -> None:
    """Index pages and that of results get the menu of what they link to, under their headings; pages outside docs/pages
    are in no menu; files show their name.

    Links to HTML pages stay links: Sphinx would take them for downloads, without what lies beside them.
    """
    content[0] = re.sub(r"\[([^]]+)\]\(([\w/]+\.html)\)", r'<a href="\2">\1</a>', content[0])
    content[0] = re.sub(
        r'^```(\w+) title="([^"]+)"$', r"```{code-block} \1\n:caption: \2\n", content[0], flags=re.MULTILINE
    )
    if not document.startswith("docs/pages/"):
        content[0] = f"---\norphan: true\n---\n{content[0]}"
    elif document.endswith(("/index", "/results")):
        own = "results/" if document.endswith("/results") else ""  # other pages that they name are in other menus
        for part in re.split(r"^## ", content[0], flags=re.MULTILINE):
            pages = dict.fromkeys(re.findall(rf"\]\(({own}[\w-]+(?:/index)?)\.md\)", part))
            head = "" if part.startswith("# ") else f":caption: {part.partition(chr(10))[0]}\n"
            if pages:
                content[0] += f"\n```{{toctree}}\n:hidden:\n:maxdepth: 2\n{head}\n" + "\n".join(pages) + "\n```\n"


def _to_restructured_text(app: Any, what: str, name: str, of: object, options: Any, lines: list[str]) -> None:
    """Docstrings are written as Markdown: indented blocks are code, and marks mean nothing outside backquotes."""
    text = re.sub(r":\n\n(?= {4})", "::\n\n", "\n".join(lines))
    parts = re.split(r"(`[^`\n]*`)", text)
    parts[::2] = [re.sub(r"([*|]|(?<=\w)_(?!\w))", r"\\\1", part) for part in parts[::2]]
    lines[:] = re.sub(r"(`[^`\n]*`)(?=\w)", r"\1\\ ", "".join(parts)).split("\n")
