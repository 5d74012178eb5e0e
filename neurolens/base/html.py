"""Fills this package's templates: HTML and files of other programs. No text of a stranger's file can run as code.

Templates, styles and scripts are files of `templates/` and of `programs/view/page/`. A template puts one of these
styles or scripts into the page unescaped, by `text(name) | safe`. A link needs more than escaping: see `local_url`.
Every value of HTML and XML is escaped. Templates of other languages (NAME.jinja) take numbers as they are, and refuse
a text that no filter has quoted: `literal` for Python, USD and JSON, `line` for a line of Markdown or of a comment.
"""

import json
import re
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any
from urllib.parse import quote

from jinja2 import Environment, FileSystemLoader, StrictUndefined, pass_eval_context
from jinja2.filters import do_mark_safe

from neurolens.base.errors import one_line, without_controls

_FOLDERS = [Path(__file__).parents[1] / name for name in ("templates", "programs/view/page")]


def html(template: str, **values: Any) -> str:
    """Return the page that a template of this package makes of values."""
    return "".join(html_parts(template, **values))


def html_parts(template: str, **values: Any) -> Iterator[str]:
    """Yield the same page in parts, so that a generator's rows are never all in memory."""
    return _templates().get_template(template).generate(**values)


@cache
def _templates() -> Environment:
    environment = Environment(
        loader=FileSystemLoader(_FOLDERS), autoescape=_is_markup, undefined=StrictUndefined, trim_blocks=True,
        lstrip_blocks=True, keep_trailing_newline=True, finalize=_checked,
    )  # fmt: skip
    environment.filters["quoted"] = lambda svg: quote(svg, safe=" /:=(),;.")
    environment.filters["literal"] = lambda value, ascii=True: do_mark_safe(
        json.dumps(without_controls(value) if isinstance(value, str) else value, ensure_ascii=ascii)
    )
    environment.filters["line"] = lambda text: do_mark_safe(
        re.sub(r"([\\`*_|<\[])", r"\\\1", one_line(str(text), 1000))
    )
    environment.globals["text"] = text_of
    return environment


def _is_markup(name: str | None) -> bool:
    return not str(name).endswith(".jinja") or str(name).endswith(".xml.jinja")


@pass_eval_context
def _checked(context: Any, value: Any) -> Any:
    """Return the value of an expression; a text that could be read as code is refused."""
    if not context.autoescape and type(value) is str:  # `safe` makes another type of it
        raise TypeError(f"{value[:40]!r} needs a filter that quotes it")
    return without_controls(value) if type(value) is str else value


def text_of(name: str) -> str:
    """Return the text of a style, a script or a shader, for pages that need no other file."""
    return next(folder / name for folder in _FOLDERS if (folder / name).is_file()).read_text(encoding="utf-8")


def local_url(folder: Path, file: Any) -> str | None:
    """Return the relative URL of a file inside `folder`; None if it is missing or its resolved path lies outside."""
    if not file:
        return None
    root = folder.resolve()
    path = (root / str(file)).resolve()
    if not path.is_relative_to(root) or not path.is_file():
        return None
    return "./" + quote(path.relative_to(root).as_posix())  # "./", so that a name with a colon is not read as a scheme
