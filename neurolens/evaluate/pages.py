"""Tables of records, in HTML and in Markdown, and the markup of a page without scripts that needs no network.

All markup is made by `html`, whose template is our own text, and which escapes every value that it puts in.
"""

from __future__ import annotations

import base64
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import quote

from markupsafe import Markup

from neurolens.evaluate.records import noisy

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
        """The figure as text, a dash for None, "~" before the least of a noisy timing; the word "never" stays."""
        if record.get(self.key) == "never":
            return "never"
        value, parent = number(record, self.key), self.key.removesuffix(".min")
        if value is None:
            return DASH
        mark = "~" if parent != self.key and noisy(record[parent]) else ""
        return mark + show(value * self.factor, self.digits, thousands)


def show(value: float, digits: int, thousands: str = "") -> str:
    """A number with significant digits, without an exponent if it is short; `thousands` separates a long one's."""
    if value == 0 or 1e-4 <= abs(value) < 10.0**digits:
        return f"{value:.{digits}g}"
    return f"{value:{thousands}.0f}" if 1 <= abs(value) < 1e7 else f"{value:.{digits - 1}e}"


def markdown_table(header: Sequence[str], rows: Iterable[Sequence[Any]], missing: str = "") -> list[str]:
    """Lines of a table in Markdown; `missing` stands for cells that are None."""
    lines = [header, ["---"] * len(header), *([missing if c is None else str(c) for c in row] for row in rows)]
    return [f"| {' | '.join(line)} |" for line in lines]


def html(template: str, *values: object) -> Markup:
    """A template with values in the places of its {}: markup that this function made as it is, anything else escaped,
    safe between tags and inside quoted attributes. A link needs more: see `local_url`."""
    return Markup(template).format(*values)  # noqa: S704 (templates are texts of this package)


def joined(template: str, values: Iterable[object], between: str = "") -> Markup:
    """A template for each value, one after the other."""
    return html(between).join(html(template, value) for value in values)


def section(heading: str, body: str) -> Markup:
    """A section with a heading; empty if it has no content."""
    return html("<section><h2>{}</h2>{}</section>", heading, body) if body else Markup()


def table(names: Sequence[str], records: Sequence[Record], columns: Iterable[Column]) -> Markup:
    """One row a record; a column that no record holds is left out, a figure that one record lacks is a dash."""
    columns = [c for c in columns if any(number(r, c.key) is not None for r in records)]
    if not records:
        return Markup()
    hover = [html(" title='{}'", c.about) if c.about else "" for c in columns]
    heads = (html("<th scope='col'{}>{}</th>", about, c.heading) for c, about in zip(columns, hover, strict=True))
    rows = []
    for name, record in zip(names, records, strict=True):
        cells = joined("<td>{}</td>", (c.cell(record, ",") for c in columns))
        rows.append(html("<tr><th scope='row'>{}</th>{}</tr>", name, cells))
    body = html("<thead><tr><th></th>{}</tr></thead><tbody>{}</tbody>", joined("{}", heads), joined("{}", rows))
    return html("<div class='scroll' tabindex='0'><table>{}</table></div>", body)


def sorting_heads(columns: Iterable[Column]) -> Markup:
    """Headings of numbers in a table that sorts by itself."""
    heads = (html("<th scope='col' data-kind='number' title='{}'>{}</th>", c.about, c.heading) for c in columns)
    return joined("{}", heads)


def sorting_cells(record: Record, columns: Iterable[Column]) -> Markup:
    """The cells of a record below `sorting_heads`."""
    values = ((number(record, c.key), c.cell(record)) for c in columns)
    return joined("{}", (html("<td data-v='{}'>{}</td>", "" if v is None else v, cell) for v, cell in values))


def drawing(svg: str) -> Markup:
    """A cell with a drawing as a picture, in which no script runs."""
    shown = html("<img src='data:image/svg+xml,{}' alt=''>", quote(svg, safe=" /:=(),;.")) if svg else ""
    return html("<td class='p' data-v=''>{}</td>", shown)


def legend(columns: Iterable[Column]) -> Markup:
    """What the headings of tables mean, folded."""
    meant = {c.heading: c.about for c in columns if c.about}
    return folded("What the words mean", facts(meant)) if meant else Markup()


def folded(summary: str, body: str) -> Markup:
    """A body that opens when its summary is clicked on."""
    return html("<details><summary>{}</summary>{}</details>", summary, body)


def facts(values: Mapping[str, Any]) -> Markup:
    """A table of settings as a definition list; nested tables with dotted names."""
    rows = (html("<dt>{}</dt><dd>{}</dd>", key, value) for key, value in _flat(values))
    return html("<dl>{}</dl>", joined("{}", rows))


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


def figure_grid(
    folder: Path, figures: Iterable[Mapping[str, Any]], small: bool = False, inside: bool = False
) -> Markup:
    """Pictures with title, caption and links; one whose file is not in `folder` leaves a line that says so.

    `inside`: PNG files as part of the page, which then needs no others.
    """
    shown = joined("{}", (_figure(folder, figure, inside) for figure in figures))
    return html("<div class='figures{}'>{}</div>", " small" if small else "", shown) if shown else Markup()


def _figure(folder: Path, figure: Mapping[str, Any], inside: bool) -> Markup:
    name, caption = str(figure.get("title") or ""), str(figure.get("caption") or "")
    links = {label: local_url(folder, file) for label, file in (figure.get("links") or {}).items()}
    files = joined("{}", (html("<a href='{}'>{}</a>", url, label) for label, url in links.items() if url), " · ")
    words = joined("{}", filter(None, (html("<b>{}</b>", name) if name else "", caption, files)), " ")
    url = local_url(folder, figure.get("file"))
    if url is None:
        return html("<p class='note'>Picture missing: {}</p>", figure.get("file"))
    if inside:
        data = base64.b64encode((folder / str(figure["file"])).read_bytes()).decode("ascii")
        picture = html("<img src='data:image/png;base64,{}' alt='{}'>", data, name or caption)
    else:
        picture = html("<a href='{}'><img src='{}' alt='{}' loading='lazy'></a>", url, url, name or caption)
    kind = html(" class='wide'") if figure.get("wide") else ""
    return html("<figure{}>{}<figcaption>{}</figcaption></figure>", kind, picture, words)


def local_url(folder: Path, file: Any) -> str | None:
    """Relative URL of a file inside `folder`; None if it is missing or its resolved path lies outside."""
    if not file:
        return None
    root = folder.resolve()
    path = (root / str(file)).resolve()
    if not path.is_relative_to(root) or not path.is_file():
        return None
    return "./" + quote(path.relative_to(root).as_posix())  # "./", so that a name with a colon is not read as a scheme


def page(title: str, body: str) -> Markup:
    """A whole document around `body`."""
    head = html("<meta charset='utf-8'><meta name='viewport' content='width=device-width, initial-scale=1'>")
    head += html("<title>{}</title><style>{}</style>", title, _CSS)
    return html("<!DOCTYPE html>\n<html lang='en'><head>{}</head><body>{}</body></html>\n", head, body)


_CSS = Markup("""
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
  margin-top: 1.4rem; } .use h2 { border: 0; margin: 0 0 .3rem; }
.use pre + h2 { margin-top: 1rem; } .use p { margin: .3rem 0; }
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
""")
