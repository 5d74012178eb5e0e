"""Records of a run, read back as written, and the report: complete, offline, and safe against hostile names."""

import ast
import itertools
import json
import math
import random
import re
from pathlib import Path
from urllib.parse import unquote

import numpy as np
import pytest
from report_results import Page, full_results

from experiments.__main__ import main as experiment
from experiments.data import library_pages as library
from neurolens.base.errors import InputError
from neurolens.base.html import local_url
from neurolens.studies import records
from neurolens.studies.pages import write_report
from neurolens.studies.records import Results, break_even_rays, pareto_front


def test_break_even_is_where_the_total_times_meet() -> None:
    fit_s, load_s, ns_exact, ns_model = 8.0, 0.5, 48.0, 14.0
    rays = break_even_rays(fit_s, load_s, ns_exact, ns_model)
    assert rays is not None
    assert rays * ns_exact * 1e-9 == pytest.approx(fit_s + load_s + rays * ns_model * 1e-9, rel=1e-12)
    # It never pays, or a time is not known.
    for times in ((8, 0.5, 20, 20), (8, 0.5, 20, 30), (None, 0, 9, 1), (8, 0, None, 1), (8, 0, 9, None)):
        assert break_even_rays(*times) is None


def test_pareto_front_agrees_with_its_definition() -> None:
    points = [(10, 5.0), (12, 1.0), (11, 6.0), (20, 1.0), (30, 0.2), (12, 2.0), (math.nan, 0.0)]
    assert pareto_front(points) == [0, 1, 4] and pareto_front([]) == []
    assert pareto_front([(1, 1), (1, 1), (2, 1)]) == [0, 1]
    draw = random.Random(3)
    points = [(draw.randint(0, 12), draw.randint(0, 12)) for _ in range(120)]

    def bettered(p: tuple[int, int]) -> bool:
        return any(q[0] <= p[0] and q[1] <= p[1] and q != p for q in points)

    front = pareto_front(points)
    assert sorted(front) == [i for i, p in enumerate(points) if not bettered(p)]
    assert all(points[i][0] <= points[j][0] for i, j in itertools.pairwise(front))


def test_results_come_back_as_written(tmp_path: Path) -> None:
    path = tmp_path / "results.json"
    results = {
        "lens": {"name": "Tessar", "efl_mm": np.float32(50.0)},
        "models": [{"name": "a", "rms_um": math.nan, "ns_per_ray": {"min": np.float64(12.5), "threads": np.int64(1)}}],
        "domain": {"wavelength_nm": np.array([400.0, 700.0]), "focus_m": (2.0, math.inf)},
        "seed": 3,
    }
    records.write_results(path, Results(**results))
    text = path.read_text()
    assert "NaN" not in text and "Infinity" not in text  # which JSON does not know
    back = json.loads(text)
    assert back["lens"]["efl_mm"] == 50.0 and back["domain"]["wavelength_nm"] == [400.0, 700.0]
    assert back["models"] == [{"name": "a", "rms_um": None, "ns_per_ray": {"min": 12.5, "threads": 1}}]
    assert back["domain"]["focus_m"] == [2.0, "infinity"] and back["schema_version"] == records.SCHEMA_VERSION
    assert [p.name for p in tmp_path.iterdir()] == ["results.json"]


HOSTILE = "<script>alert('x')</script>\"&'"


@pytest.fixture
def run_dir(tmp_path: Path) -> Path:
    for name in ("pareto.png", "room.png", "room & co.exr"):
        (tmp_path / name).write_bytes(b"any")
    return tmp_path


def test_every_picture_and_link_exists_and_nothing_needs_the_network(run_dir: Path) -> None:
    path = write_report(run_dir, Results(**full_results()))
    page = Page(path.read_text(encoding="utf-8"))
    assert {unquote(s) for s in page.sources} == {"./pareto.png", "./room.png"}
    assert "./room%20%26%20co.exr" in page.links
    for target in (*page.sources, *page.links):
        assert (run_dir / unquote(target)).is_file(), target
    assert "script" not in page.tags and "link" not in page.tags
    assert "http" not in path.read_text(encoding="utf-8")


def test_hostile_names_are_only_text(run_dir: Path) -> None:
    path = write_report(run_dir, Results(**full_results(HOSTILE)))
    page = Page(path.read_text(encoding="utf-8"))
    assert "script" not in page.tags and "<script" not in path.read_text(encoding="utf-8")
    assert HOSTILE in page.text  # shown as written, so nothing was swallowed either
    (run_dir / "javascript:x").write_bytes(b"any")
    assert local_url(run_dir, "javascript:x") == "./javascript%3Ax"
    with pytest.raises(InputError, match="run folder"):
        write_report(run_dir / "absent", Results())


@pytest.mark.parametrize("file", ["../secret.png", "/etc/hostname", "javascript:alert(1)", "absent.png", "", "."])
def test_a_picture_outside_the_run_folder_is_not_shown(file: str, run_dir: Path) -> None:
    (run_dir.parent / "secret.png").write_bytes(b"any")
    results = {
        "figures": [{"file": file, "title": "a"}],
        "images": [{"camera": "c", "file_png": "room.png", "file_exr": file}],
    }
    page = Page(write_report(run_dir, Results(**results)).read_text(encoding="utf-8"))
    assert page.sources == ["./room.png"] and set(page.links) == {"./room.png"}
    assert "Picture missing" in page.text
    (run_dir.parent / "secret.png").unlink()


def test_no_text_of_a_lens_runs_or_links_in_the_pages_of_a_library(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The reason of a refused file ran as a script, a name with a colon was a scheme, one page overwrote another."""
    drawing = f"<svg xmlns='http://www.w3.org/2000/svg' onload='alert(1)'>{HOSTILE}</svg>"
    monkeypatch.setattr(
        library,
        "_page",
        lambda lens, file, folder: {
            "name": HOSTILE, "designer": HOSTILE, "doubts": [HOSTILE], "layout": drawing, "efl_mm": HOSTILE
        },
    )  # fmt: skip
    files = []
    for name in ("a/x", "b/x", "javascript:alert(1)", "index.html", "X", "<img src=y onerror=alert(2)>"):
        files.append(tmp_path / f"{name}.toml")
        files[-1].parent.mkdir(exist_ok=True)
        files[-1].write_bytes(Path("lenses/cooke_triplet_50.toml").read_bytes())
    bad = tmp_path / "bad.toml"
    bad.write_text('schema = 1\n"<img src=x onerror=alert(3)>" = 1\n')
    out = tmp_path / "new" / "pages"
    assert experiment(["library", "-o", str(out), *map(str, [*files, bad]), "--quiet"]) == 1
    page = Page((out / "index.html").read_text(encoding="utf-8"))
    assert page.tags.count("script") == 1 and HOSTILE in page.text and "onerror=alert(3)" in page.text
    assert [link.rpartition("/")[2] for link in page.links] == ["index.html"] * 6
    assert len(set(page.links)) == 6 and all(re.fullmatch(r"\./[\w.-]+/index\.html", link) for link in page.links)
    assert all((out / link).parent.joinpath("record.json").is_file() for link in page.links)
    assert all(source.startswith("data:image/svg+xml,%3Csvg") for source in page.sources)
    assert experiment(["library", "-o", str(tmp_path / "refused"), str(bad), "--quiet"]) == 1
    said = capsys.readouterr().out
    assert said.count("bad.toml") == 2 and "onerror=alert(3)" in (tmp_path / "refused/index.html").read_text()


def test_markup_is_made_by_templates_that_escape() -> None:
    """No module writes tags by itself, and templates leave unescaped what is a file of the package or packed data."""
    tag = re.compile(
        r"</(a|b|p|t[dhr]|h\d|li|pre|div|span|script|style|small|label|d[dlt]|ul|section|html)>|<br>|<img "
    )
    for file in Path("neurolens").rglob("*.py"):
        text = file.read_text(encoding="utf-8")
        for node in ast.walk(ast.parse(text)) if tag.search(text) else ():  # a comment or docstring may name a tag
            if isinstance(node, ast.Constant) and isinstance(node.value, str):
                assert not tag.search(node.value), f"{file}:{node.lineno}"
    templates = [
        file for folder in ("templates", "programs/view/page") for file in Path("neurolens", folder).glob("*.html")
    ]
    unescaped = {word for file in templates for word in re.findall(r"\{\{([^}]*)\|\s*safe\b", file.read_text())}
    assert len(templates) > 7
    assert all(re.fullmatch(r" (text\((\"[\w.]+\"|name)\)|part\.text) ", word) for word in unescaped), unescaped
    assert not any("autoescape" in file.read_text() for file in templates)
