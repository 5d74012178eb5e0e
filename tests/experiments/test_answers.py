"""The pages of results and the README: their figures are those of the committed measurements, their tables short."""

import json
import re
import statistics
from pathlib import Path

import pytest

from experiments import lab
from experiments.accuracy.surrogates import lens_page, summary_page
from experiments.data import answers
from experiments.data.make_models import errors_by_kind

ROOT = Path(__file__).parents[2]
README = (ROOT / "README.md").read_text(encoding="utf-8")
FEWEST = [
    *(ROOT / "docs" / "pages" / "results").glob("*.md"),
    ROOT / "docs" / "pages" / "results.md",
    ROOT / "README.md",
]


@pytest.mark.parametrize("make", answers.ANSWERS, ids=lambda make: make.__name__)
def test_a_page_is_what_its_measurements_say(make: answers.Callable[[], answers.Answer]) -> None:
    answer = make()
    page = answers.PAGES / "results" / f"{answer.name}.md"
    assert page.read_text(encoding="utf-8") == answer.page(), "python -m experiments answers"
    assert page.with_suffix(".png").is_file()
    assert len(answer.rows) <= 7 and len(re.findall(r"[.:;] ", answer.answer)) <= 2  # two sentences, one parted


def test_the_list_of_questions_is_what_the_pages_say() -> None:
    page = answers.PAGES / "results.md"
    text = page.read_text(encoding="utf-8")
    assert text == answers.index(text, [make() for make in answers.ANSWERS])


@pytest.mark.parametrize("page", FEWEST, ids=lambda page: page.name)
def test_tables_for_readers_are_small(page: Path) -> None:
    rows = [
        line.strip("| ").split(" | ") for line in page.read_text(encoding="utf-8").splitlines() if line.startswith("|")
    ]
    assert all(len(cells) <= 5 for cells in rows)
    assert [cell for cells in rows for cell in cells if len(cell.split()) > 12] == []


def test_figures_of_the_readme() -> None:
    assert len(README.splitlines()) <= 120
    times = answers.pictures().short.partition(" times")[0]
    assert f"a picture takes {times} times as long as through a thin lens" in README
    gains = {k: exact / model for k, (exact, model, _) in ((k, answers.as_c(k)) for k in (2, 7, 12, 33))}
    said = re.sub(r"\s+", " ", README)
    assert f"At 12 refractions it is {answers.short(gains[12])} times as fast as our exact lens" in said
    assert f"at 33 it is {answers.short(gains[33])} times as fast" in said
    hand = [answers.by_hand(k) / answers.as_c(k)[1] for k in (12, 33)]
    longer = f"takes {answers.short(hand[0])} and {answers.short(hand[1])} times as long as the model"
    assert f"A tracer written by hand for bare glass {longer}" in said
    # From 7 refractions on: half as fast again, the rule of `train` and `models`.
    assert gains[2] < 1.5 <= gains[7] and "pays from 7 refractions on" in README
    rows = json.loads((ROOT / "models" / "index.json").read_text(encoding="utf-8"))["models"]
    lenses = errors_by_kind(rows, "mlp-16x2")["round photographic lenses"]
    assert f"leave {statistics.median(lenses):.3f} um RMS on the film" in said
    assert f"(median of {len(lenses)} lenses, at most {max(lenses):.2f};" in said
    assert f"answers {['ten', 'eleven', 'twelve'][len(answers.ANSWERS) - 10]} questions" in said


LIMITS = {"neurolens2017-128x3": "not converged", **dict.fromkeys(("ray-lut-8", "ray-lut-32"), "judged on a CPU")}


def test_tables_of_methods_say_what_limits_a_figure_in_its_cell() -> None:
    """As the benchmark writes them today, and as they are committed."""
    records = [
        {"method": name, "lens": "any", "group": "published", "source": "", "failed": "not run", "rms_px": None}
        for name in (*LIMITS, "hanika-d5")
    ]
    folder = lab.RESULTS / "surrogates"
    pages = [lens_page("any", records, ""), summary_page({"any": records}, "")]
    for page in [*pages, *(file.read_text(encoding="utf-8") for file in sorted(folder.glob("*.md")))]:
        found = re.findall(r"\| ((?:neurolens2017-128x3|ray-lut-8|ray-lut-32|hanika-d5)[^|]*) (?=\|)", page)
        assert set(found) == {*(f"{name}, {limit}" for name, limit in LIMITS.items()), "hanika-d5"}
