"""The gallery's page: every effect with its figure, its numbers and the command that makes them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from neurolens.base.files import atomic_write_text
from neurolens.evaluate.gallery.cameras import TITLES

_HEAD = """\
# What real lenses do

Small scenes after the figures of two theses (Steinert 2009, Willi 2021), each through the exact lens, a surrogate of it
and a thin lens of the same focal length and f-number; the last column is the difference of surrogate and exact in
luminance, the same random numbers in both. Below each figure stands what is measured of the effect. Axes are
millimetres of film, pictures upright. Made by `neurolens gallery`; one effect by the command beside it.
"""


def write_page(records: Sequence[Mapping[str, Any]], path: Path) -> None:
    """Write README.md of the records (see `run.run_effect`), whose figures lie beside it."""
    atomic_write_text(path, "\n".join([_HEAD, *(section(record) for record in records)]))


def section(record: Mapping[str, Any]) -> str:
    """One effect, in Markdown."""
    name = record["name"]
    return "\n".join(
        [
            f"## {record['title']}\n",
            f"{record['text'].strip()}\n",
            f"![{record['title']}]({name}.png)\n",
            table(record),
            f"\nAfter {record['source'].strip()} [experiments/gallery/{name}.toml]"
            f"(../../gallery/{name}.toml), `{record['command']}`.\n",
        ]
    )


def table(record: Mapping[str, Any]) -> str:
    """The measured numbers: a row a panel and quantity, a column a camera, and the surrogate's error."""
    panels = record["panels"]
    columns = list(dict.fromkeys(c for p in panels for found in p["measured"].values() for c in found))
    head = ["panel", "measured", *(TITLES.get(c, c) for c in columns)]
    lines = [f"| {' | '.join(head)} | RMS of the surrogate |", f"|{'---|' * (len(head) + 1)}"]
    for panel in panels:
        for k, (quantity, found) in enumerate(panel["measured"].items()):
            cells = [panel["label"] if k == 0 else "", quantity_name(quantity)]
            cells += [_number(found.get(c)) for c in columns] + [_error(panel["surrogate"]) if k == 0 else ""]
            lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines)


def quantity_name(key: str) -> str:
    """A key with its unit last, in words: "radius_um" is "radius (um)"."""
    for unit in ("um", "mm", "deg", "percent", "nm", "stops"):
        if key.endswith(f"_{unit}"):
            return f"{key[: -len(unit) - 1].replace('_', ' ')} ({'%' if unit == 'percent' else unit})"
    return key.replace("_", " ")


def _number(value: float | None) -> str:
    return "–" if value is None else f"{value:.3g}"


def _error(surrogate: Mapping[str, Any] | None) -> str:
    if surrogate is None:
        return "–"
    if surrogate["rms_um"] is not None:
        return f"{surrogate['rms_um']:.2g} um ({surrogate['name'].rpartition('.')[2]})"
    degrees = surrogate.get("direction_rms_deg")
    return "–" if degrees is None else f"{degrees:.2g} deg"
