"""The table of a survey: a page that sorts and filters by itself, CSV and JSON."""

from __future__ import annotations

import csv
import io
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

from neurolens.base.errors import printable
from neurolens.base.files import atomic_path, write_json
from neurolens.base.html import html_parts
from neurolens.base.records import versions
from neurolens.study.pages import DASH, Column, flat, table
from neurolens.study.survey import GOALS, VERDICTS, SurveySettings, summary_of

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
    """The names of `_KINDS` that hold for a record."""
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
    """The page in parts: a summary, then one row a file with its section, figures and reasons."""
    of_records = [_kinds(r) for r in records]
    counts = {kind: sum(kind in kinds for kinds in of_records) for kind in _KINDS}
    rows = (
        {"record": r, "kinds": kinds, "picture": layout_of(r["file"]), "remarks": _remarks(r)}
        for r, kinds in zip(records, of_records, strict=True)
    )
    return html_parts(
        "survey.html",
        title=f"Survey of {collection.folder.name or collection.folder}",
        summary=summary_lines(records, collection.others),
        kinds=[{"name": kind, "about": about, "count": counts[kind]} for kind, about in _KINDS.items()],
        columns=table((), records, COLUMNS).columns,
        rows=rows,
        about=flat({**asdict(settings), **versions()}),
    )


def _remarks(record: Mapping[str, Any]) -> list[str]:
    """Why a file was refused, doubts, notes, and promises of the card that were not held; each once."""
    lines = [record["reason"], *record.get("doubts", ()), *record.get("notes", ())]
    lines += [f"promise not held: {b}" for b in (record.get("fit") or {}).get("broken", ())]
    return list(filter(None, dict.fromkeys(lines)))


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
