"""Tables of records, in HTML and in Markdown, and the markup of a page without scripts that needs no network."""

from __future__ import annotations

import base64
import html
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import quote

Record = Mapping[str, Any]
DASH = "–"


def number(record: Mapping[str, Any], key: str) -> float | None:
    """Finite number at `key` of a record, or None; dots go into nested tables: "ns_per_ray.min"."""
    value: Any = record
    for part in key.split("."):
        value = value.get(part) if isinstance(value, Mapping) else None
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        return None
    return float(value)


@dataclass(frozen=True)
class Column:
    """A figure of a record: its heading, its key (dots go into nested tables), a factor and significant digits.

    `about` says what it means, on hover and in the legend.
    """

    heading: str
    key: str
    factor: float = 1.0
    digits: int = 3
    about: str = ""

    def cell(self, record: Record, thousands: str = "") -> str:
        """The figure as text, a dash for None; the word "never" stays."""
        if record.get(self.key) == "never":
            return "never"
        value = number(record, self.key)
        return DASH if value is None else show(value * self.factor, self.digits, thousands)


def show(value: float, digits: int, thousands: str = "") -> str:
    """A number with significant digits, without an exponent if it is short; `thousands` separates a long one's."""
    if value == 0 or 1e-4 <= abs(value) < 10.0**digits:
        return f"{value:.{digits}g}"
    return f"{value:{thousands}.0f}" if 1 <= abs(value) < 1e7 else f"{value:.{digits - 1}e}"


def markdown_table(header: Sequence[str], rows: Iterable[Sequence[Any]], missing: str = "") -> list[str]:
    """Lines of a table in Markdown; `missing` stands for cells that are None."""
    lines = [header, ["---"] * len(header), *([missing if c is None else str(c) for c in row] for row in rows)]
    return [f"| {' | '.join(line)} |" for line in lines]


def text(value: Any) -> str:
    """`value` as escaped text, safe between tags and inside quoted attributes."""
    return html.escape(str(value), quote=True)


def section(heading: str, body: str) -> str:
    """A section with a heading; empty if it has no content."""
    return f"<section><h2>{text(heading)}</h2>{body}</section>" if body else ""


def table(names: Sequence[str], records: Sequence[Record], columns: Iterable[Column]) -> str:
    """One row a record; a column that no record holds is left out, a figure that one record lacks is a dash."""
    columns = [c for c in columns if any(number(r, c.key) is not None for r in records)]
    if not records:
        return ""
    hover = (f" title='{text(c.about)}'" if c.about else "" for c in columns)
    head = "".join(f"<th scope='col'{about}>{text(c.heading)}</th>" for c, about in zip(columns, hover, strict=True))
    rows = []
    for name, record in zip(names, records, strict=True):
        cells = "".join(f"<td>{c.cell(record, ',')}</td>" for c in columns)
        rows.append(f"<tr><th scope='row'>{text(name)}</th>{cells}</tr>")
    body = f"<thead><tr><th></th>{head}</tr></thead><tbody>{''.join(rows)}</tbody>"
    return f"<div class='scroll' tabindex='0'><table>{body}</table></div>"


def legend(columns: Iterable[Column]) -> str:
    """What the headings of tables mean, folded."""
    meant = {c.heading: c.about for c in columns if c.about}
    return f"<details><summary>What the words mean</summary>{facts(meant)}</details>" if meant else ""


def facts(values: Mapping[str, Any]) -> str:
    """A table of settings as a definition list; nested tables with dotted names."""
    rows = "".join(f"<dt>{text(key)}</dt><dd>{text(value)}</dd>" for key, value in _flat(values))
    return f"<dl>{rows}</dl>"


def _flat(values: Mapping[str, Any], prefix: str = "") -> list[tuple[str, str]]:
    rows: list[tuple[str, str]] = []
    for key, value in values.items():
        if isinstance(value, Mapping):
            rows += _flat(value, f"{prefix}{key}.")
        else:
            rows.append((f"{prefix}{key}", _plain(value)))
    return rows


def _plain(value: Any) -> str:
    if value is None or value != value:  # NaN differs from itself
        return DASH
    if isinstance(value, float):
        return f"{value:.6g}"
    if isinstance(value, list | tuple):
        return " to ".join(map(_plain, value)) if len(value) == 2 else ", ".join(map(_plain, value))
    return str(value)


def figure_grid(folder: Path, figures: Iterable[Mapping[str, Any]], small: bool = False, inside: bool = False) -> str:
    """Pictures with title, caption and links; one whose file is not in `folder` leaves a line that says so.

    `inside`: PNG files as part of the page, which then needs no others.
    """
    shown = "".join(_figure(folder, figure, inside) for figure in figures)
    return f"<div class='figures{' small' if small else ''}'>{shown}</div>" if shown else ""


def _figure(folder: Path, figure: Mapping[str, Any], inside: bool) -> str:
    name, caption = str(figure.get("title") or ""), str(figure.get("caption") or "")
    links = {label: local_url(folder, file) for label, file in (figure.get("links") or {}).items()}
    files = " · ".join(f"<a href='{url}'>{text(label)}</a>" for label, url in links.items() if url)
    words = " ".join(part for part in (f"<b>{text(name)}</b>" if name else "", text(caption), files) if part)
    url = local_url(folder, figure.get("file"))
    if url is None:
        return f"<p class='note'>Picture missing: {text(figure.get('file'))}</p>"
    if inside:
        data = base64.b64encode((folder / str(figure["file"])).read_bytes()).decode("ascii")
        picture = f"<img src='data:image/png;base64,{data}' alt='{text(name or caption)}'>"
    else:
        picture = f"<a href='{url}'><img src='{url}' alt='{text(name or caption)}' loading='lazy'></a>"
    kind = " class='wide'" if figure.get("wide") else ""
    return f"<figure{kind}>{picture}<figcaption>{words}</figcaption></figure>"


def local_url(folder: Path, file: Any) -> str | None:
    """Relative URL of a file inside `folder`; None if it is missing or its resolved path lies outside."""
    if not file:
        return None
    root = folder.resolve()
    path = (root / str(file)).resolve()
    if not path.is_relative_to(root) or not path.is_file():
        return None
    return "./" + quote(path.relative_to(root).as_posix())  # "./", so that a name with a colon is not read as a scheme


def page(title: str, body: str) -> str:
    """A whole document around `body`."""
    head = "<meta charset='utf-8'><meta name='viewport' content='width=device-width, initial-scale=1'>"
    head += f"<title>{text(title)}</title><style>{_CSS}</style>"
    return f"<!DOCTYPE html>\n<html lang='en'><head>{head}</head><body>{body}</body></html>\n"


_CSS = """
:root { color-scheme: light dark; --ink: #1b1f24; --dim: #5d6670; --line: #dfe3e8; --back: #fff; --card: #f5f7f9;
  --accent: #0062a3; --shade: #0004; --warn: #fff6e0; --warnline: #e0a800; }
@media (prefers-color-scheme: dark) { :root { --ink: #e4e8ec; --dim: #98a2ad; --line: #333a42; --back: #15181c;
  --card: #1e2329; --accent: #6cb8f0; --shade: #fff3; --warn: #2b2414; --warnline: #a07c10; } }
* { box-sizing: border-box; }
body { margin: 0 auto; max-width: 1320px; padding: 2rem 1.25rem 4rem; background: var(--back); color: var(--ink);
  font: 16px/1.5 system-ui, -apple-system, "Segoe UI", Roboto, "DejaVu Sans", sans-serif; }
h1 { font-size: 1.9rem; line-height: 1.2; margin: 0 0 .3rem; }
h2 { font-size: 1.25rem; margin: 2.6rem 0 .8rem; padding-bottom: .3rem; border-bottom: 1px solid var(--line); }
h3 { font-size: .95rem; margin: 0 0 .35rem; color: var(--dim); font-weight: 600; }
a { color: var(--accent); }
.lead, .note, figcaption { color: var(--dim); } .note { font-size: .85rem; max-width: 75ch; }
.warn { background: var(--warn); border-left: 4px solid var(--warnline); border-radius: 4px; padding: .1rem 1rem;
  margin-top: 1.6rem; } .warn h2 { border: 0; margin: .6rem 0 0; font-size: 1rem; } .warn ul { margin: .3rem 0 .8rem;
  padding-left: 1.2rem; }
.facts { display: grid; grid-template-columns: repeat(auto-fit, minmax(300px, 1fr)); gap: 1.4rem; }
dl { display: grid; grid-template-columns: auto 1fr; gap: .1rem .9rem; margin: 0; font-size: .88rem; }
dt { color: var(--dim); } dd { margin: 0; overflow-wrap: anywhere; font-variant-numeric: tabular-nums; }
details { margin-top: 1rem; } summary { cursor: pointer; color: var(--accent); margin-bottom: .5rem; }
.scroll { overflow-x: auto; scrollbar-width: auto; scrollbar-color: var(--dim) var(--card); padding-bottom: .2rem;
  background: linear-gradient(to right, var(--back), transparent 2rem) 0 0 / 3rem 100% no-repeat local,
    linear-gradient(to left, var(--back), transparent 2rem) 100% 0 / 3rem 100% no-repeat local,
    linear-gradient(to right, var(--shade), transparent) 0 0 / 1rem 100% no-repeat scroll,
    linear-gradient(to left, var(--shade), transparent) 100% 0 / 1rem 100% no-repeat scroll; }
.scroll::-webkit-scrollbar { height: 12px; } .scroll::-webkit-scrollbar-track { background: var(--card); }
.scroll::-webkit-scrollbar-thumb { background: var(--dim); border-radius: 6px; }
th[title] { text-decoration: underline dotted; text-underline-offset: 3px; cursor: help; }
.use { background: var(--card); border-left: 4px solid var(--accent); border-radius: 4px; padding: .6rem 1rem 1rem;
  margin-top: 1.4rem; } .use h2 { border: 0; margin: 0 0 .3rem; } .use p { margin: .3rem 0; }
pre { margin: .5rem 0 0; padding: .6rem .8rem; overflow-x: auto; background: var(--back); border-radius: 4px;
  border: 1px solid var(--line); font-size: .85rem; }
table { border-collapse: collapse; font-size: .84rem; font-variant-numeric: tabular-nums; }
th, td { padding: .32rem .6rem; text-align: right; border-bottom: 1px solid var(--line); white-space: nowrap; }
thead th { white-space: normal; vertical-align: bottom; color: var(--dim); font-weight: 600; min-width: 4.6rem; }
tbody th { text-align: left; font-weight: 500; position: sticky; left: 0; background: var(--back); }
th:first-child { text-align: left; } tbody tr:hover > * { background: var(--card); }
.figures { display: grid; grid-template-columns: repeat(auto-fit, minmax(min(100%, 520px), 1fr)); gap: 1.4rem;
  margin-bottom: 1.4rem; } .figures.small { grid-template-columns: repeat(auto-fill, minmax(min(100%, 340px), 1fr)); }
figure { margin: 0; } figure.wide { grid-column: 1 / -1; }
figure img { width: 100%; height: auto; display: block; border-radius: 6px; background: #fff;
  border: 1px solid var(--line); }
figcaption { font-size: .85rem; margin-top: .35rem; } figcaption b { color: var(--ink); }
.small img { image-rendering: auto; border: 0; }
@media print { body { max-width: none; } tbody th { position: static; } }
"""
