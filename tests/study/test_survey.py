"""A survey: the same record for the same task, reasons for what is not fitted, runs that go on, a page that parses."""

import csv
import io
import json
import os
import re
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import pytest

from neurolens.base.errors import InputError
from neurolens.base.progress import Progress
from neurolens.base.tasks import Here, Processes
from neurolens.cli import main
from neurolens.readers.any_format import collection_of
from neurolens.study import survey_page
from neurolens.study.survey import SurveySettings, Task, is_of, run_task, summary_of
from neurolens.study.survey_run import survey

LENSES = Path(__file__).parents[2] / "lenses"
TRIPLET = (LENSES / "cooke_triplet_50.toml").read_bytes()
SMALL = SurveySettings(terms=12, rays=2000)
READ = SurveySettings(fit=False)
QUIET = Progress(quiet=True)


@pytest.fixture(scope="module")
def fitted() -> bytes:
    return run_task(Task("a/triplet.toml", TRIPLET, SMALL))


def test_record_of_a_lens_is_whole_and_the_same_bytes_again(fitted: bytes) -> None:
    record = json.loads(fitted)
    assert fitted == run_task(Task("a/triplet.toml", TRIPLET, SMALL))
    assert (record["verdict"], record["reason"], record["format"]) == ("ok", "", "neurolens")
    assert record["efl_mm"] == pytest.approx(50.02, abs=0.01)
    fit = record["fit"]
    assert 0 < fit["direction_rms_deg"] < 0.05
    assert fit["coefficients"] == 12
    assert fit["promises"] > 10
    assert record["layout"].startswith("<svg")


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
    assert record["verdict"] == "refused"
    assert said in record["reason"]
    assert "/tmp" not in record["reason"]


def test_a_fault_is_a_record_and_is_tried_again(monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(*_: object) -> None:
        raise ZeroDivisionError("of a test")

    monkeypatch.setattr("neurolens.study.survey.check_lens", broken)
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


class Rows(HTMLParser):
    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []
        self.rows: list[dict[str, str | None]] = []
        self.links: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        if tag not in ("meta", "input", "br", "img"):
            self.open.append(tag)
        if tag == "tr" and "tbody" in self.open:
            self.rows.append(dict(attrs))
        self.links += [value or "" for name, value in attrs if name in ("src", "href")]

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag


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
    assert [r["verdict"] for r in records] == ["ok", "refused"]
    page = (out / "survey.html").read_text(encoding="utf-8")
    found = Rows()
    found.feed(page)
    assert [row["data-kinds"] for row in found.rows] == ["ok unfitted", "refused"]
    assert found.open == []
    assert [link[:20] for link in found.links] == ["data:image/svg+xml,%"]  # self-contained
    assert page.count("image/svg+xml,%3Csvg") == 1  # the section is in the record's file and in the page, not in memory
    assert "layout" not in records[0]
    assert "triplet &lt;b&gt;" in page
    with (out / "survey.csv").open(newline="") as stream:
        rows = list(csv.DictReader(stream))
    assert [row["verdict"] for row in rows] == ["ok", "refused"]
    data = json.loads((out / "survey.json").read_text())
    assert data["summary"]["files"] == 2
    assert data["lenses"][1]["reason"] == records[1]["reason"]


def test_no_cell_of_the_table_is_a_formula() -> None:
    """Spreadsheets run texts of cells that begin with these."""
    texts = ["=cmd|' /C calc'!A0", "+1", "-1", "@SUM(1)", "\t=1", "\r=1", "\n=1"]
    records = [{"file": t, "verdict": "refused", "name": t, "reason": t, "notes": [t], "efl_mm": -1.0} for t in texts]
    for row in csv.DictReader(io.StringIO(survey_page._csv(records), newline="")):
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


def test_a_file_that_takes_too_long_is_a_fault(tmp_path: Path) -> None:
    collection = collection_of(_folder(tmp_path))
    with Processes(2, limit_s=0.0) as executor:
        records = survey(collection, tmp_path / "out", READ, executor, QUIET)
    assert {r["verdict"] for r in records} == {"fault"}
    assert records[0]["reason"] == "took longer than 0 s"


def test_summary_counts_goals_and_takes_a_missing_figure_for_the_worst() -> None:
    good = {"direction_rms_deg": 1e-3, "false_pass": 0.0, "false_block": 1e-4, "reaches": True, "broken": []}
    bad = {**good, "direction_rms_deg": None, "reaches": False, "broken": ["x"]}
    records = [{"verdict": "ok", "fit": good}, {"verdict": "doubtful", "fit": bad}, {"verdict": "refused"}]
    found = summary_of(records)
    assert (found["read"], found["refused"], found["fitted"], found["reach_goals"]) == (2, 1, 2, 1)
    assert found["promises_held"] == 1
    assert summary_of(records[1:])["median"]["direction_rms_deg"] is None


def test_the_command_says_what_it_found(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = _folder(tmp_path)
    assert main(["survey", str(folder), "--no-fit", "--output", str(tmp_path / "o"), "--jobs", "1"]) == 0
    out, err = capsys.readouterr()
    assert "2 files: 1 read (0 of them doubtful), 1 refused" in out
    assert "1 .me" in out
    assert re.search(r"no\.zmx: refused: .*expected", err)
    assert main(["survey", str(tmp_path / "nowhere")]) == 2
    with pytest.raises(InputError, match="files of other kinds"):
        (tmp_path / "empty").mkdir()
        collection_of(tmp_path / "empty")
