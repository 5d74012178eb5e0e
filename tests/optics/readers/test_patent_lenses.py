"""Two hundred tables of patents, read from Zemax files and traced, against ray-optics 0.9.8.

`tests/data/patent_lenses.tar.xz` holds them: the figures that move a ray, the patent, and what ray-optics computes from
the same file: focal length, back focus and film from the last surface at which the medium changes, focal length and
back focus of every configuration, and the image heights of the rays through the middle of the stop at three fields.
Files and answers are those of `python -m experiments collection`; the choice of two hundred that lie far apart was made
once, by experiments/collection_tables.py of the project's history.
"""

from __future__ import annotations

import json
import tarfile
import warnings
from pathlib import Path
from typing import Any

import pytest
from command_line import run_json
from shipped import WHOLE

from neurolens.base.errors import NeurolensWarning
from neurolens.optics.analysis.fields import Scene
from neurolens.optics.lens.paraxial import first_order
from neurolens.optics.lens.prescription import Lens
from neurolens.optics.readers.any_format import read_any

ARCHIVE = Path(__file__).parents[2] / "data" / "patent_lenses.tar.xz"
AGREE_MM, AGREE = 2e-6, 1e-9  # the file has micrometres to three digits; the rest is relative

with tarfile.open(ARCHIVE) as _archive:
    TEXTS = {entry.name: _archive.extractfile(entry).read() for entry in _archive}  # type: ignore[union-attr]
TABLES = json.loads(TEXTS.pop("expected.json"))["tables"]


def read(table: dict[str, Any], folder: Path) -> Lens:
    """The lens of a table; what its reader warns of is of no interest here."""
    file = folder / table["file"]
    file.write_bytes(TEXTS[table["file"]])
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", NeurolensWarning)
        return read_any(file)


@pytest.mark.parametrize(
    "table", TABLES if WHOLE else TABLES[::10], ids=lambda table: table["file"].removesuffix(".zmx")
)
def test_a_patent_reads_and_traces_as_in_ray_optics(table: dict[str, Any], tmp_path: Path) -> None:
    lens = read(table, tmp_path)
    assert lens.name == table["source"] and lens.reference_nm == pytest.approx(table["wavelength_nm"])
    last = max(k for k, s in enumerate(lens.surfaces) if s.n_d != lens.media[k].n_d)

    def figures(state: Lens) -> list[float]:
        data, z = first_order(state), state.vertices_mm
        return [data.efl_mm, data.rear_focal_z_mm - z[last], z[-1] - z[last]]

    assert figures(lens) == pytest.approx([table[f"{k}_mm"] for k in ("efl", "back", "film")], rel=AGREE, abs=AGREE_MM)
    states = [c for c in lens.configurations if c.name != "as filed"]  # the table itself, focused near
    zoomed = [figures(lens.with_gaps(dict(c.thickness_mm)))[:2] for c in states]
    assert len(zoomed) == len(table["states"])
    for state, expected in zip(zoomed, table["states"], strict=True):
        assert state == pytest.approx(expected, rel=AGREE, abs=AGREE_MM)
    heights = Scene(lens).chief_rays(table["fields_deg"], table["wavelength_nm"]).height_mm.tolist()
    assert heights == pytest.approx(table["heights_mm"], rel=AGREE, abs=AGREE_MM)


def test_a_folder_of_files_is_one_table(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Their first-order data in one command, and what kinds of lenses they are."""
    tables = TABLES if WHOLE else TABLES[5::20]
    for table in tables:
        (tmp_path / table["file"]).write_bytes(TEXTS[table["file"]])
    rows = run_json(capsys, "lens", tmp_path)["lenses"]
    assert {row["verdict"] for row in rows} == {"read"} and len(rows) == len({t["source"] for t in tables})
    expected = {Path(table["file"]).stem: table["efl_mm"] for table in tables}
    assert [row["efl_mm"] for row in rows] == pytest.approx([expected[row["lens"]] for row in rows], abs=AGREE_MM)
    if not WHOLE:
        return
    assert len(rows) == 200
    f_numbers, focal = [row["f_number"] for row in rows], [row["efl_mm"] for row in rows]
    assert min(f_numbers) < 0.96 and max(f_numbers) > 13
    assert min(focal) < 0 and min(f for f in focal if f > 0) < 5 and max(focal) > 1000
    assert max(table["fields_deg"][-1] for table in TABLES) > 100
    assert sum(row["aspheres"] > 0 for row in rows) > 100 and sum(row["states"] > 2 for row in rows) > 90
    assert min(row["refractions"] for row in rows) < 4 and max(row["refractions"] for row in rows) > 40
