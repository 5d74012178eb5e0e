"""The table of a survey: a page that sorts and filters by itself, CSV and JSON."""

from __future__ import annotations

import csv
import io
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

from markupsafe import Markup

from neurolens.base.errors import printable
from neurolens.base.files import atomic_path, write_json
from neurolens.evaluate.pages import (
    DASH,
    Column,
    drawing,
    facts,
    folded,
    html,
    joined,
    legend,
    number,
    page,
    sorting_cells,
    sorting_heads,
)
from neurolens.evaluate.records import versions
from neurolens.evaluate.survey import GOALS, VERDICTS, SurveySettings, summary_of

if TYPE_CHECKING:
    from neurolens.readers.any_format import Collection

COLUMNS = (
    Column("f (mm)", "efl_mm", digits=4, about="focal length of the table, first order"),
    Column("f-number", "f_number", about="of the stop, paraxial"),
    Column("half field (°)", "half_field_deg", about="as the file states it"),
    Column("refractions", "refractions"),
    Column("aspheres", "aspheres", about="surfaces that are no sphere, plane or cylinder"),
    Column("states", "states", about="zoom and focus states of the file; the table's own is fitted"),
    Column("direction (°)", "fit.direction_rms_deg", about="angle between exact and modelled ray, root mean square "
           f"over fresh rays; goal {GOALS['direction_rms_deg']:g}"),
    Column("error (µm)", "fit.rms_um", about="distance on the film that the error makes, root mean square"),
    Column("false pass (%)", "fit.false_pass", 100, about="rays that the model passes and the lens does not; goal "
           f"{100 * GOALS['false_pass']:g}"),
    Column("false block (%)", "fit.false_block", 100, about="rays that the model blocks and the lens does not; goal "
           f"{100 * GOALS['false_block']:g}"),
)  # fmt: skip
_TEXTS = ("file", "verdict", "format", "name", "rims", "reason")
_LISTS = ("notes", "doubts")
TABLE_STYLE = Markup("""<style>
.survey td.t { text-align: left; white-space: normal; min-width: 12rem; max-width: 34rem; overflow-wrap: anywhere; }
.survey tbody th { min-width: 11rem; max-width: 16rem; white-space: normal; overflow-wrap: anywhere; }
.survey tbody th small { color: var(--dim); display: block; }
.survey td.p { padding: 2px; background: #fff; color: #222; } .survey td.p img { display: block; }
.survey thead th { cursor: pointer; position: sticky; top: 0; background: var(--back); z-index: 2; }
.survey thead th[aria-sort=ascending]::after { content: " ▲"; }
.survey thead th[aria-sort=descending]::after { content: " ▼"; }
.survey thead th:not([data-kind]), .survey td.v, .survey td.v + td { text-align: left; }
.survey tr.refused, .survey tr.fault { color: var(--dim); } .survey .v { font-weight: 600; }
.tools { display: flex; gap: .8rem; flex-wrap: wrap; align-items: center; margin: 1rem 0; }
.tools input[type=search] { font: inherit; padding: .3rem .5rem; min-width: 18rem; }
body { max-width: 1800px; }
</style>""")
# Sorts by a heading (numbers as numbers, what is missing last), and shows rows that hold all words and a chosen kind.
TABLE_SCRIPT = Markup("""<script>
(() => {
  const table = document.querySelector('.survey table'), body = table.tBodies[0], rows = [...body.rows];
  const words = document.getElementById('words'), kinds = [...document.querySelectorAll('.kind')];
  const shown = document.getElementById('shown');
  const texts = new Map(rows.map(r => [r, r.textContent.toLowerCase()]));
  const filter = () => {
    const all = words.value.toLowerCase().split(/\\s+/).filter(Boolean);
    const on = new Set(kinds.filter(k => k.checked).map(k => k.value));
    let count = 0;
    for (const r of rows) {
      const seen = r.dataset.kinds.split(' ').some(k => on.has(k)) && all.every(w => texts.get(r).includes(w));
      r.hidden = !seen; count += seen;
    }
    shown.textContent = count + ' of ' + rows.length;
  };
  const key = (r, i) => r.cells[i].dataset.v ?? r.cells[i].textContent;
  [...table.tHead.rows[0].cells].forEach((head, i) => head.addEventListener('click', () => {
    const down = head.getAttribute('aria-sort') === 'ascending', sign = down ? -1 : 1;
    for (const h of table.tHead.rows[0].cells) h.removeAttribute('aria-sort');
    head.setAttribute('aria-sort', down ? 'descending' : 'ascending');
    const numeric = head.dataset.kind === 'number';
    const of = new Map(rows.map(r => [r, key(r, i)]));
    rows.sort((a, b) => {
      const x = of.get(a), y = of.get(b);
      if (x === '' || y === '') return (x === '') - (y === '');
      return sign * (numeric ? x - y : x.localeCompare(y));
    });
    body.append(...rows);
  }));
  words.addEventListener('input', filter); kinds.forEach(k => k.addEventListener('change', filter)); filter();
})();
</script>""")
_ROWS = Markup("<!--rows-->")  # where they come: no name or text holds it, as those are escaped
_KINDS = {
    **dict.fromkeys(VERDICTS, ""),
    "unfitted": "read, but without a fit",
    "missed": "fitted, a goal missed",
    "broken": "a promise of the card not held",
}


def write_pages(
    records: Sequence[Mapping[str, Any]],
    layout_of: Callable[[str], str],
    collection: Collection,
    out: Path,
    settings: SurveySettings,
) -> None:
    """Write survey.json, survey.csv and survey.html to a folder; a file's section, an SVG, is asked for one by one."""
    summary = summary_of(records)
    head = {"folder": str(collection.folder), "settings": asdict(settings), "others": collection.others}
    write_json(out / "survey.json", {**head, "summary": summary, "versions": versions(), "lenses": records})
    pages: dict[str, Iterable[str]] = {"csv": [_csv(records)]}
    pages["html"] = survey_page(records, layout_of, collection, settings)
    for name, parts in pages.items():
        # Names of files may be bytes that are no text.
        with (
            atomic_path(out / f"survey.{name}") as temporary,
            temporary.open("w", encoding="utf-8", errors="backslashreplace") as stream,
        ):
            stream.writelines(parts)


def summary_lines(records: Sequence[Mapping[str, Any]], others: Mapping[str, int]) -> list[str]:
    """How many were read, doubtful, refused and fitted, and what the fits reach, as sentences."""
    s = summary_of(records)
    lines = [f"{s['files']} files: {s['read']} read ({s['doubtful']} of them doubtful), {s['refused']} refused"]
    lines[0] += f", {s['fault']} ended by a fault" if s["fault"] else ""
    if others:
        kinds = ", ".join(f"{count} {suffix}" for suffix, count in sorted(others.items()))
        lines.append(f"not taken as lens files: {kinds}")
    if s["fitted"]:
        goals = f"{GOALS['direction_rms_deg']:g} deg and {100 * GOALS['false_pass']:g}% false pass and block"
        lines.append(f"{s['fitted']} fitted: {s['reach_goals']} reach {goals}, {s['promises_held']} hold all promises")
        m = s["median"]
        shares = [DASH if m[key] is None else f"{100 * m[key]:.2g}%" for key in ("false_pass", "false_block")]
        turn = DASH if m["direction_rms_deg"] is None else f"{m['direction_rms_deg']:.2g} deg"
        lines.append(f"medians: {turn}, false pass {shares[0]}, false block {shares[1]}")
    return lines


def _kinds(record: Mapping[str, Any]) -> list[str]:
    """Of `_KINDS`, those of a record."""
    fit, kinds = record.get("fit"), [str(record["verdict"])]
    if fit:
        kinds += ["missed"] * (not fit["reaches"]) + ["broken"] * bool(fit["broken"])
    elif record["verdict"] in VERDICTS[:2]:
        kinds.append("unfitted")
    return kinds


def survey_page(
    records: Sequence[Mapping[str, Any]],
    layout_of: Callable[[str], str],
    collection: Collection,
    settings: SurveySettings,
) -> Iterator[str]:
    """The page in parts: what was found in words, then one row a file with its section, figures and reasons."""
    columns = [c for c in COLUMNS if any(number(r, c.key) is not None for r in records)]
    counts = {kind: sum(kind in _kinds(r) for r in records) for kind in _KINDS}
    box = "<label title='{}'><input type='checkbox' class='kind' value='{}' checked> {} ({})</label>"
    boxes = [html(box, about, kind, kind, counts[kind]) for kind, about in _KINDS.items() if counts[kind]]
    about = folded("What was run", facts({**asdict(settings), **versions()}))
    title = f"Survey of {collection.folder.name or collection.folder}"
    top = html("<header><h1>{}</h1></header><ul>{}</ul>", title,
               joined("<li>{}</li>", summary_lines(records, collection.others)))  # fmt: skip
    heads = joined("<th scope='col'>{}</th>", ("file", "section", "verdict", "format")) + sorting_heads(columns)
    table = sorting_table(heads + html("<th scope='col'>what was found</th>"), _ROWS, joined("{}", boxes))
    whole = page(title, top + table + legend(columns) + about + TABLE_SCRIPT)
    before, _, after = whole.partition(_ROWS)
    yield before
    for r in records:
        yield _row(r, layout_of(r["file"]), columns)
    yield after


def sorting_table(heads: str, rows: str, boxes: str) -> Markup:
    """A table that searches and sorts by itself where `TABLE_SCRIPT` follows it; `boxes` choose kinds of its rows."""
    tools = html(
        "<div class='tools'><input id='words' type='search' placeholder='words that a row holds'>{}"
        "<span id='shown'></span></div>",
        boxes,
    )
    body = html("<thead><tr>{}</tr></thead><tbody>{}</tbody>", heads, rows)
    return TABLE_STYLE + tools + html("<div class='survey'><table>{}</table></div>", body)


def _row(record: Mapping[str, Any], picture: str, columns: Sequence[Column]) -> str:
    said = [record["reason"], *record.get("doubts", ()), *record.get("notes", ())]
    said += [f"promise not held: {b}" for b in (record.get("fit") or {}).get("broken", ())]
    listed = joined("{}", filter(None, dict.fromkeys(said)), "<br>")
    return html(
        "<tr class='{}' data-kinds='{}'><th scope='row'>{}<small>{}</small></th>{}<td class='v'>{}</td><td>{}</td>{}"
        "<td class='t'>{}</td></tr>",
        *(record["verdict"], " ".join(_kinds(record)), record["file"], record.get("name", ""), drawing(picture)),
        *(record["verdict"], record.get("format", ""), sorting_cells(record, columns), listed),
    )


def _csv(records: Sequence[Mapping[str, Any]]) -> str:
    """Texts, then the figures by their keys, then lists, their items parted by " | ", a row for each record."""
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    fits = sorted({key for r in records for key, v in (r.get("fit") or {}).items() if not isinstance(v, list | dict)})
    plain = [c.key for c in COLUMNS if not c.key.startswith("fit.")]
    writer.writerow([*_TEXTS, *plain, *fits, *_LISTS, "broken"])
    for r in records:
        fit = r.get("fit") or {}
        lists = [*(r.get(key) or () for key in _LISTS), fit.get("broken", ())]
        figures = [*(r.get(key) for key in plain), *(fit.get(key) for key in fits)]
        row = [*(r.get(key, "") for key in _TEXTS), *figures, *(" | ".join(items) for items in lists)]
        writer.writerow([_plain_cell(value) for value in row])
    return stream.getvalue()


def _plain_cell(value: Any) -> Any:
    """A cell whose text is one line and no formula of a spreadsheet: names and reasons are of strangers' files.

    Source: OWASP, CSV Injection.
    """
    if not isinstance(value, str):
        return value
    text = printable(value.translate(dict.fromkeys(map(ord, "\t\r\n"), " ")))
    return f"'{text}" if text.lstrip().startswith(("=", "+", "-", "@")) else text
