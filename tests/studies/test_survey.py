"""A survey: the same record for the same task, reasons for what is not fitted, runs that go on, a page that parses."""

import csv
import io
import json
import os
import re
from pathlib import Path
from typing import Any

import pytest
from report_results import Page

from neurolens.base.progress import Progress
from neurolens.base.tasks import Here
from neurolens.optics.readers.any_format import collection_of
from neurolens.studies.survey import SurveySettings, Task, _csv, is_of, run_task, summary_of, survey

LENSES = Path(__file__).parents[2] / "lenses"
TRIPLET = (LENSES / "cooke_triplet_50.toml").read_bytes()
SMALL = SurveySettings(terms=12, rays=2000)
READ = SurveySettings(fit=False)
QUIET = Progress(quiet=True)


@pytest.fixture(scope="module")
def fitted() -> bytes:
    return run_task(Task("a/triplet.toml", TRIPLET, SMALL))


def test_record_of_a_lens_is_whole_and_the_same_bytes_again(fitted: bytes) -> None:
    record, fit = json.loads(fitted), json.loads(fitted)["fit"]
    assert fitted == run_task(Task("a/triplet.toml", TRIPLET, SMALL))
    assert (record["verdict"], record["reason"], record["format"]) == ("ok", "", "neurolens")
    assert record["efl_mm"] == pytest.approx(50.02, abs=0.01) and record["layout"].startswith("<svg")
    assert 0 < fit["direction_rms_deg"] < 0.05 and fit["coefficients"] == 12 and fit["promises"] > 10


def test_a_rim_wider_than_its_sphere_is_doubted_and_a_film_that_nothing_states_is_told() -> None:
    rows = ["stop 5 1 0 6.25 0", "50 5 1.5168 64.17 %g 1", "-50 47 1 0 12 0"]
    table = "# 3 surfaces, 1 glass element, f/4.0\nname: singlet\nfocal_length: 49.2\nsurfaces:\n" + "\n".join(rows)
    for rim, verdict in ((12.0, "ok"), (50.5, "doubtful")):
        record = json.loads(run_task(Task("s.lens", (table % rim).encode(), READ)))
        assert record["verdict"] == verdict and record["reason"] == ""
        assert any("rims narrowed" in doubt for doubt in record["doubts"]) == (verdict == "doubtful")
        assert any(re.match(r"neither field nor film is stated: .* film radius of \d", n) for n in record["notes"])


def test_a_task_is_known_by_all_that_decides_its_record(fitted: bytes) -> None:
    task = Task("a/triplet.toml", TRIPLET, SMALL)
    record = json.loads(fitted)
    assert is_of(record, task)
    others = (
        Task("a/triplet.toml", TRIPLET + b"\n", SMALL),
        Task("a/triplet.toml", TRIPLET, SurveySettings(terms=12, rays=2001)),
        Task("a/triplet.toml", TRIPLET, SMALL, (("x.agf", b"CC"),)),
    )
    assert not any(is_of(record, other) for other in others)


@pytest.mark.parametrize(
    ("name", "data", "said"),
    [
        ("empty.zmx", b"", "empty.zmx: file: got (empty)"),
        ("bits.len", bytes(range(256)), "bytes that are not text"),
        ("x.json", b"{}", "x.json"),
        ("cut.toml", TRIPLET[:700], "cut.toml"),
        ("../../up.seq", b"RDM;LEN\n", "up.seq"),
        ("twostops.dat", b"50 5 1.5 20\n0 1 0 9\n0 1 0 9\n-50 90 1 20\n", "exactly one row of index 0"),
    ],
)
def test_what_cannot_be_read_is_refused_with_its_reason(name: str, data: bytes, said: str) -> None:
    record = json.loads(run_task(Task(name, data, READ)))
    assert record["verdict"] == "refused" and said in record["reason"] and "/tmp" not in record["reason"]


def test_a_fault_is_a_record_and_is_tried_again(monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(*_: object) -> None:
        raise ZeroDivisionError("of a test")

    monkeypatch.setattr("neurolens.studies.survey.check_lens", broken)
    task = Task("t.toml", TRIPLET, READ)
    data = run_task(task)
    assert json.loads(data)["verdict"] == "fault"
    assert "ZeroDivisionError: of a test (test_survey.py:" in json.loads(data)["reason"]
    assert not is_of(json.loads(data), task)


def _folder(tmp_path: Path) -> Path:
    folder = tmp_path / "lenses"
    (folder / "in").mkdir(parents=True)
    (folder / "in" / "=triplet <b>.toml").write_bytes(TRIPLET)
    (folder / "no.zmx").write_text("no lens")
    (folder / "read.me").write_text("words")
    (folder / ".hidden.zmx").write_text("no")
    return folder


def test_a_survey_leaves_nothing_out_and_goes_on(tmp_path: Path) -> None:
    collection, out, asked = collection_of(_folder(tmp_path)), tmp_path / "out", list[str]()

    class Once(Here):
        """Is interrupted when it is to take its second task."""

        def submit(self, work: Any, /, *args: Any, **named: Any) -> Any:
            asked.append(args[0].name)
            if len(asked) == 2:
                raise KeyboardInterrupt
            return super().submit(work, *args, **named)

    assert collection.names == ("in/=triplet <b>.toml", "no.zmx")
    assert collection.others == {".me": 1, "(hidden)": 1}
    with pytest.raises(KeyboardInterrupt):
        survey(collection, out, READ, Once(), QUIET)
    records = survey(collection, out, READ, Once(), QUIET)
    assert asked == [*collection.names, collection.names[1]]  # the first is kept
    assert [r["verdict"] for r in records] == ["ok", "refused"] and "layout" not in records[0]
    page = Page((out / "survey.html").read_text(encoding="utf-8"))
    assert [row["data-kinds"] for row in page.rows] == ["ok unfitted", "refused"]
    assert [s[:20] for s in page.sources] == ["data:image/svg+xml,%"] and not page.links  # it needs no other file
    assert "triplet <b>" in page.text
    with (out / "survey.csv").open(newline="") as stream:
        assert [row["verdict"] for row in csv.DictReader(stream)] == ["ok", "refused"]
    data = json.loads((out / "survey.json").read_text())
    assert data["summary"]["files"] == 2 and data["lenses"][1]["reason"] == records[1]["reason"]


def test_no_cell_of_the_table_is_a_formula() -> None:
    """Spreadsheets run texts of cells that begin with these."""
    texts = ["=cmd|' /C calc'!A0", "+1", "-1", "@SUM(1)", "\t=1", "\r=1", "\n=1"]
    records = [{"file": t, "verdict": "refused", "name": t, "reason": t, "notes": [t], "efl_mm": -1.0} for t in texts]
    for row in csv.DictReader(io.StringIO(_csv(records), newline="")):
        assert [row[key][0] for key in ("file", "name", "reason", "notes")] == ["'"] * 4
        assert row["efl_mm"] == "-1.0" and row["verdict"] == "refused"


def test_names_that_are_no_text(tmp_path: Path) -> None:
    folder = tmp_path / "odd"
    folder.mkdir()
    try:
        Path(os.fsdecode(os.fsencode(folder) + b"/\xff\xfe.zmx")).write_text("VERS")
    except OSError:
        pytest.skip("this system takes names that are text alone")
    (record,) = survey(collection_of(folder), tmp_path / "out", READ, Here(), QUIET)
    assert record["verdict"] == "refused"
    for kind in ("html", "csv"):
        assert "\\udcff\\udcfe.zmx" in (tmp_path / "out" / f"survey.{kind}").read_text(encoding="utf-8")


def test_summary_counts_goals_and_takes_a_missing_figure_for_the_worst() -> None:
    good = {"direction_rms_deg": 1e-3, "false_pass": 0.0, "false_block": 1e-4, "reaches": True, "broken": []}
    bad = {**good, "direction_rms_deg": None, "reaches": False, "broken": ["x"]}
    records = [{"verdict": "ok", "fit": good}, {"verdict": "doubtful", "fit": bad}, {"verdict": "refused"}]
    found = summary_of(records)
    assert (found.read, found.refused, found.fitted, found.reach_goals, found.promises_held) == (2, 1, 2, 1, 1)
    assert summary_of(records[1:]).median["direction_rms_deg"] is None
