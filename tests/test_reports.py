"""CSV tables hold the figures of the JSON; reports are dataclasses."""

import csv
import json
import math
import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from neurolens.base.report import BULK, PART, Report, csv_text, over, plain, tables_of
from neurolens.cli import main

ROOT = Path(__file__).parents[1]
GAUSS = "laikin_double_gauss_50"


def read(folder: Path) -> dict[str, list[dict[str, str]]]:
    """The rows of all tables of a folder by their names without the command's."""
    found = {}
    for file in folder.glob("*.csv"):
        with file.open(encoding="utf-8", newline="") as stream:
            found[file.stem.partition(".")[2]] = list(csv.DictReader(stream))
    return found


def figures(value: Any) -> list[float]:
    """All finite numbers within a value of JSON, sorted."""
    if isinstance(value, dict | list):
        parts = value.values() if isinstance(value, dict) else value
        return sorted(number for part in parts for number in figures(part))
    return [float(value)] if isinstance(value, int | float) and not isinstance(value, bool) else []


def numbers(rows: list[dict[str, str]]) -> list[float]:
    cells = [cell for row in rows for cell in row.values()]
    return sorted(float(c) for c in cells if re.fullmatch(r"-?[0-9][0-9.e+-]*", c) and math.isfinite(float(c)))


@pytest.fixture(scope="module")
def analysed(tmp_path_factory: pytest.TempPathFactory) -> tuple[dict[str, Any], dict[str, list[dict[str, str]]]]:
    """The JSON and the tables of all analyses of a lens."""
    folder, said = tmp_path_factory.mktemp("csv"), list[dict[str, Any]]()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("neurolens.cli.arguments.print_json", said.append)
        small = "--field-points 0 9.5 18 --wavelengths 587.5 486.1 --frequencies 10 40 --f-number 4".split()
        assert main(["analyse", GAUSS, *small, "--json", "--csv", str(folder)]) == 0
    return said[0], read(folder)


# By analysis: its table, the axes whose figures mark a row, and the figures over all of these.
TABLES = [
    ("spots.field-wavelength", ("field_deg", "wavelength_nm"), ("rms_by_wavelength_um", "spread.rms_by_wavelength_um")),
    ("spots.field-wavelength", ("field_deg",), ("rms_um", "geometric_um", "passed", "best_rms_um", "height_mm")),
    ("spots.field-shift", ("field_deg", "shift_mm"), ("through_focus_um",)),
    ("fans.field-wavelength-pupil", ("field_deg", "wavelength_nm", "pupil"), ("tangential_um", "sagittal_um")),
    ("colour.spectrum-zone", ("spectrum_nm", "zone"), ("focus_shift_mm",)),
    ("colour.field-line", ("field_deg", "line_nm"), ("lateral_um",)),
    ("curvature.field", ("field_deg",), ("height_mm", "tangential_mm", "sagittal_mm", "petzval_mm")),
    ("distortion.field", ("field_deg",), ("height_mm", "error_percent.rectilinear, f tan")),
    ("vignetting.field", ("field_deg",), ("relative", "unvignetted", "passed", "cos4", "spread.relative")),
    ("mtf.field-frequency", ("field_deg", "frequency_per_mm"), ("tangential", "sagittal", "spread.tangential")),
    ("mtf.field-frequency", ("frequency_per_mm",), ("diffraction_limit",)),
    ("mtf-height.field-frequency", ("field_deg", "frequency_per_mm"), ("tangential", "spread.sagittal")),
    ("seidel.surface-names", ("surface", "names"), ("surfaces",)),
    ("seidel.surface-names", ("names",), ("total",)),
    ("psf.field", ("field_deg",), ("half_width_um", "strehl", "pupil_points")),
]


@pytest.mark.parametrize(("table", "axes", "columns"), TABLES, ids=[f"{t[0]} {t[2][0]}" for t in TABLES])
def test_tables_of_analyses_have_the_figures_of_the_json(
    analysed: tuple[dict[str, Any], dict[str, list[dict[str, str]]]],
    table: str, axes: tuple[str, ...], columns: tuple[str, ...],
) -> None:  # fmt: skip
    data, rows = analysed[0][table.partition(".")[0]], analysed[1][table]
    marks = {
        axis: [str(v) for v in data.get(axis, range(len(data["surfaces"]) if "surfaces" in data else 0))]
        for axis in axes
    }
    for name in columns:
        key, _, inner = name.partition(".")
        values = data[key][inner] if inner else data[key]
        seen = set()
        for row in rows:
            at = tuple(marks[axis].index(row[axis]) for axis in axes)
            value: Any = values
            for k in at:
                value = value[k] if value is not None and k < len(value) else None
            assert row[name] == ("" if value is None else str(value)), (name, row)
            seen.add(at)
        assert len(seen) == math.prod(map(len, marks.values()))  # no case is left out


def test_every_analysis_has_its_figures_in_a_table(
    analysed: tuple[dict[str, Any], dict[str, list[dict[str, str]]]],
) -> None:
    """Beside arrays over axes: single figures stand in one row."""
    data, rows = analysed
    (once,) = rows[""]
    assert float(once["spots.airy_um"]) == data["spots"]["airy_um"]
    assert once["distortion.best"] == data["distortion"]["best"] and once["focus_m"] == "infinity"
    for what in ("spots", "colour", "curvature", "distortion", "vignetting", "mtf", "seidel", "psf"):
        arrays = [numbers(table) for name, table in rows.items() if name.startswith(f"{what}.")]
        single = [float(v) for k, v in once.items() if k.startswith(f"{what}.") and re.match(r"-?\d", v)]
        told = {number for table in arrays for number in table} | set(single)
        assert set(figures(data[what])) <= told, what


@pytest.mark.parametrize(
    "words",
    [
        ["lens", GAUSS, "--breathing", "b.png"], ["lens", "cooke_triplet_50", "brendel_tessar_100"],
        ["lens", "brendel_tessar_100", "--derive-rims"], ["models", "double_gauss"],
        ["evaluate", f"{GAUSS}.ols-36", "--rays", "1000"], ["verify", "sony_sonnar_55"], ["rims", "sony_sonnar_55"],
        ["projection", "thin", "--width", "96", "--film", "36x24", "--projection", "opencv", "--focal-length", "28.5"],
        ["flare", GAUSS, "--light", "10,5"],
    ],
    ids=lambda words: " ".join(words[:2]),
)  # fmt: skip
def test_tables_of_other_commands_have_all_figures_of_the_json(
    words: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    if words[0] in ("verify", "rims"):
        pytest.importorskip("lensfunpy", reason="no lensfunpy (pip install '.[photographs]')")
    if words[0] == "evaluate":
        words = [words[0], str(ROOT / "models" / f"{words[1]}.onnx"), *words[2:]]
    said: list[dict[str, Any]] = []
    monkeypatch.setattr("neurolens.cli.arguments.print_json", said.append)
    monkeypatch.chdir(tmp_path)
    assert main([*words, "--json", "--quiet", "--csv", "tables"]) == 0
    rows = [row for table in read(tmp_path / "tables").values() for row in table]
    assert figures(said[0]) and set(figures(said[0])) <= set(numbers(rows))


# A report of any kind


@dataclass(frozen=True)
class Inner(Report):
    height_mm: Any
    light: Any = field(metadata=over("height_mm"))


@dataclass(frozen=True)
class Outer(Report):
    name: str
    inner: Inner = field(metadata=PART)
    by_stop: dict[float, Inner] = field(metadata=over("f_number"))
    rays: Any = field(metadata=BULK)
    pair: tuple[float, float]


def test_a_report_is_json_and_tables_by_the_same_names() -> None:
    inner = Inner(np.array([0.0, 1.0]), np.array([0.5, math.nan]))
    found = Outer("=1+1\n", inner, {4.0: inner}, np.ones(9), (1 / 3, math.inf))
    whole = {"height_mm": [0.0, 1.0], "light": [0.5, None]}
    told = {"name": "=1+1\n", **whole, "by_stop": {"4.0": whole}, "pair": [1 / 3, "infinity"]}
    assert plain(found, full=False) == told
    assert plain(found) == {**told, "rays": [1.0] * 9} and json.dumps(plain(found), allow_nan=False)
    tables = tables_of(found, "x")
    light = [{"height_mm": 0.0, "light": 0.5}, {"height_mm": 1.0, "light": None}]
    assert tables == {
        "x": [{"name": "=1+1\n", "pair.0": 1 / 3, "pair.1": "infinity"}],
        "x.height": light,
        "x.by_stop": [{"f_number": 4.0}],
        "x.by_stop.height": [{"f_number": 4.0} | row for row in light],
    }
    assert csv_text(tables["x"]) == "name,pair.0,pair.1\n'=1+1 ,0.3333333333333333,infinity\n"  # no formula
    assert csv_text(tables["x.height"]).splitlines() == ["height_mm,light", "0.0,0.5", "1.0,"]


def test_untyped_answers_of_commands_only_become_fewer() -> None:
    """Lower the number with each answer that becomes a `Report`."""
    texts = [path.read_text(encoding="utf-8") for path in (ROOT / "neurolens" / "cli").glob("*.py")]
    assert sum(text.count("dict[str, Any]") for text in texts) <= 73
