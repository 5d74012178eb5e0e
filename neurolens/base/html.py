"""HTML from the templates of this package. Every value is escaped, so that no text of a stranger's file runs.

Templates, styles and scripts are files of `templates/` and of `view/page/`. A template puts a style or a script of
theirs into the page as it is, by `text(name) | safe`. A link needs more than escaping: see `local_url`.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any
from urllib.parse import quote

from jinja2 import Environment, FileSystemLoader, StrictUndefined

_FOLDERS = [Path(__file__).parents[1] / name for name in ("templates", "view/page")]


def html(template: str, **values: Any) -> str:
    """The page of a template of this package with values in it."""
    return "".join(html_parts(template, **values))


def html_parts(template: str, **values: Any) -> Iterator[str]:
    """The same page part by part, so that rows of a generator are never all in memory."""
    return _templates().get_template(template).generate(**values)


@cache
def _templates() -> Environment:
    environment = Environment(
        loader=FileSystemLoader(_FOLDERS), autoescape=True, undefined=StrictUndefined, trim_blocks=True,
        lstrip_blocks=True, keep_trailing_newline=True,
    )  # fmt: skip
    environment.filters["quoted"] = lambda svg: quote(svg, safe=" /:=(),;.")
    environment.globals["text"] = text_of
    return environment


def text_of(name: str) -> str:
    """A style, a script or a shader, for pages that need no other file."""
    return next(folder / name for folder in _FOLDERS if (folder / name).is_file()).read_text(encoding="utf-8")


def local_url(folder: Path, file: Any) -> str | None:
    """Relative URL of a file inside `folder`; None if it is missing or its resolved path lies outside."""
    if not file:
        return None
    root = folder.resolve()
    path = (root / str(file)).resolve()
    if not path.is_relative_to(root) or not path.is_file():
        return None
    return "./" + quote(path.relative_to(root).as_posix())  # "./", so that a name with a colon is not read as a scheme
