"""The documentation: links lead somewhere, commands are commands, tables are complete, examples run, the site works.

`make docs` builds the site, then runs these tests with the examples (NEUROLENS_DOCS) and a browser (NEUROLENS_BROWSER).
"""

import dataclasses
import importlib.util
import os
import re
import subprocess
import sys
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, get_args, get_type_hints
from urllib.parse import unquote

import pytest
from shipped import WHOLE

from neurolens.optics.readers import lensfile
from neurolens.pictures.render.scene import SceneSettings
from neurolens.studies.experiment import Experiment

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs" / "pages"
REFERENCE = DOCS / "reference"
SITE = ROOT / "build" / "docs"
MADE = {REFERENCE / "commands.md", REFERENCE / "api"}  # when the site is built
PAGES = [ROOT / "README.md", *sorted(p for p in DOCS.rglob("*.md") if MADE.isdisjoint({p, p.parent}))]
HOW_TO = [page for page in sorted((DOCS / "how-to").glob("*.md")) if page.stem != "index"]
EXAMPLES = [
    *HOW_TO,
    DOCS / "first-hour.md",
    *(REFERENCE / f"{kind}-file.md" for kind in ("lens", "scene", "experiment")),
]
BLOCK = re.compile(r'^```(\w+)(?: title="([^"]+)")?\n(.*?)^```', re.MULTILINE | re.DOTALL)
NODE = "onnxruntime-node@1.30"
# What takes long in how-tos and is run by the first hour or by tests of the command: a block's commands
# from the first of these on run with NEUROLENS_WHOLE=1.
LONG = re.compile(
    r"^neurolens (?:analyse|train|plan|handover|rims|export [^\n]*--to osl)\b.*",
    re.MULTILINE | re.DOTALL,
)


def name_of(page: Path) -> str:
    return page.relative_to(ROOT).as_posix()


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_links_lead_to_files(page: Path) -> None:
    for link in re.findall(r"\]\(([^)#\s:]+)[)#]", page.read_text(encoding="utf-8")):
        target = Path(os.path.normpath(page.parent / link))
        assert target.exists() or not MADE.isdisjoint({target, target.parent}), link


def test_the_way_in_names_files_and_what_they_hold() -> None:
    """`FOLDER/FILE: NAME` of the page for those who change the package, from its folder or the repository's root."""
    text = (ROOT / "neurolens" / "README.md").read_text(encoding="utf-8")
    named = re.findall(r"`((?:[\w-]+/)+[\w.-]*)(?:: ([\w.]+))?`", re.sub(r"```.*?```", "", text, flags=re.DOTALL))
    assert len(named) > 200
    for file, name in named:
        found = next((f for f in (ROOT / "neurolens" / file, ROOT / file) if f.exists()), None)
        assert found is not None, file
        if name:
            code = found.read_text(encoding="utf-8")
            assert all(re.search(rf"\b{word}\b", code) for word in name.split(".")), f"{file}: {name}"
    headings = {
        re.sub(r"[^a-z ]", "", h.lower()).replace(" ", "-") for h in re.findall(r"^#+ (.*)", text, re.MULTILINE)
    }
    assert set(re.findall(r"\]\(#([\w-]+)\)", text)) <= headings


# A name, or the first of several, and a year; of texts, these are no papers.
AUTHORS = re.compile(r"\b([A-Z][a-z]+)(?:, [A-Z][a-z]+)*(?:,? and [A-Z][\w-]+| et al\.)?,? \(?((?:19|20)\d\d)[ab]?\b")
NO_PAPERS = {
    ("November", "2026"),
    ("Brendel", "1958"),
    ("Format", "1994"),
}  # dates, a patent, the PLY format in brackets


def test_every_paper_that_is_named_is_on_the_page_of_papers() -> None:
    """In pages, docstrings, comments and measured tables; the page names two more, which nothing is after."""
    listed = re.findall(r"^- .*(?:\n  .*)*", (DOCS / "papers.md").read_text(encoding="utf-8"), re.MULTILINE)
    texts = [p for f in ("neurolens", "experiments") for s in ("*.py", "*.md", "*.glsl") for p in (ROOT / f).rglob(s)]
    named = {
        (name, year, name_of(file))
        for file in {*PAGES, *texts} - {DOCS / "papers.md"}
        for name, year in AUTHORS.findall(re.sub(r"\s+(?:(?:#|//) )?", " ", file.read_text(encoding="utf-8")))
        if (name, year) not in NO_PAPERS
    }
    assert len({(name, year) for name, year, _ in named}) > 50  # the pattern still finds them
    missing = [one for one in named if not any(re.search(rf"\b{one[0]}\b.* {one[1]}", e, re.DOTALL) for e in listed)]
    assert not missing


def test_papers_are_linked_by_their_own_doi() -> None:
    page = (DOCS / "papers.md").read_text(encoding="utf-8")
    links = re.findall(r"\[(10\.\d{4,5}/[^\]\s]+)\]\(https://doi\.org/([^)\s]+)\)", page)
    assert len(links) == page.count("https://doi.org/") == len(set(links)) > 50
    assert all(unquote(target) == shown for shown, target in links)


Row = Mapping[str, str]


def rows_of(page: str) -> dict[str, dict[str, Row]]:
    """The tables of keys of a page: by heading, each key's row, whose cells are named by the head of the table."""
    found: dict[str, dict[str, Row]] = {}
    heading, head = "", []
    for line in (REFERENCE / page).read_text(encoding="utf-8").splitlines():
        if line.startswith("#"):
            heading, head = line.strip("#[] "), []
        elif line.startswith("|"):
            cells = [cell.strip() for cell in line.strip("|").split("|")]
            if not head:
                head = cells
            elif head[0] == "key":
                row = dict(zip(head, cells, strict=True))
                found.setdefault(heading, {}).update(dict.fromkeys(re.findall(r"`(\w+)`", cells[0]), row))
        else:
            head = []
    return found


def test_the_page_of_lens_files_has_every_key_that_the_reader_takes_and_no_other() -> None:
    rows = rows_of("lens-file.md")
    assert set(rows["Top level"]) == set(lensfile.LENS_KEYS) - {
        "moved",
        "coating",
        "configuration",
        "aperture",
        "measured",
    }
    surface = {
        key
        for place in ("Shape and place", "Place of the surface", "Medium behind the surface", "Coating of the surface")
        for key in rows[place]
    }
    assert surface == set(lensfile.SURFACE_KEYS)
    assert set(rows["moved"]) == set(lensfile.GROUP_KEYS)
    assert set(rows["configuration"]) == set(lensfile.CONFIGURATION_KEYS)
    assert set(rows["coating"]) == {"name", "layers"}
    assert set(rows["measured"]) == {*lensfile.MEASURED_TEXTS, *lensfile.MEASURED_NUMBERS}
    assert set(rows["aperture"]) == {"blades", "rotation_deg", "curvature"}
    medium = rows["Top level"]["object_medium"]["meaning"]
    assert all(f"`{key}`" in medium for key in lensfile.MEDIUM_KEYS)


def row_class(hint: Any) -> Any:
    """The settings class in a type such as `tuple[Quad, ...]` or `dict[str, Texture] | None`, else None."""
    if dataclasses.is_dataclass(hint):
        return hint
    return next((found for part in get_args(hint) if (found := row_class(part))), None)


HEADINGS = {"illuminants": "Illuminants and reflectances", "reflectances": "Illuminants and reflectances"}


@pytest.mark.parametrize("page, kind", [("scene-file.md", SceneSettings), ("experiment-file.md", Experiment)])
def test_pages_of_settings_have_every_key_and_its_default(page: str, kind: type) -> None:
    rows = rows_of(page)
    tables = {name: found for name, hint in get_type_hints(kind).items() if (found := row_class(hint))}
    top = {f.name for f in dataclasses.fields(kind)} - set(tables)
    assert set(rows.get("Top level", {})) == top
    assert set(rows) - {"Top level"} == {HEADINGS.get(name, name) for name in tables}
    for name, table in tables.items():
        listed = rows[HEADINGS.get(name, name)]
        fields = {f.name: f for f in dataclasses.fields(table) if f.init}
        assert set(listed) == set(fields), name
        for key, field in fields.items():
            check_default(f"{name}.{key}", listed[key].get("default"), field)


def check_default(key: str, told: str | None, field: Any) -> None:
    """A default that is one number, truth or text stands in its cell; a key without default is required."""
    value = field.default
    if told is None or told.startswith(("as ", "see ")) or "`" in told and field.name in ("width", "height"):
        return
    if value is dataclasses.MISSING and field.default_factory is dataclasses.MISSING:
        assert told.startswith("required"), key
    elif isinstance(value, bool):
        assert told == f"`{str(value).lower()}`", key
    elif isinstance(value, int | float):
        assert value in [float(number) for number in re.split(r"[, ]+", told)], key
    elif isinstance(value, str) and value:
        assert told == f'`"{value}"`', key


WEBGPU = "import wgpu; wgpu.gpu.request_adapter_sync()"


@pytest.mark.skipif("NEUROLENS_DOCS" not in os.environ, reason="examples take minutes: make docs runs them")
@pytest.mark.parametrize("page", EXAMPLES, ids=name_of)
def test_examples_run(page: Path, tmp_path: Path) -> None:
    """Blocks with a title are files, others run one after the other in a folder that has the library."""
    for folder in ("lenses", "models", "experiments"):
        (tmp_path / folder).symlink_to(ROOT / folder)
    blocks = BLOCK.findall(page.read_text(encoding="utf-8"))
    assert blocks
    if page.stem == "mitsuba" and "NEUROLENS_MITSUBA" not in os.environ:
        pytest.skip("Mitsuba was not run: NEUROLENS_MITSUBA is not set")
    path = os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]])
    left_out = ""
    for language, title, code in blocks:
        if "import wgpu" in code and subprocess.run([sys.executable, "-c", WEBGPU], capture_output=True).returncode:
            left_out = "WebGPU was not run: no wgpu (pip install '.[shading]'), or no adapter of Vulkan"
            continue
        if title:
            (tmp_path / title).write_text(code, encoding="utf-8")
        if page in HOW_TO and not WHOLE and language == "sh":
            code = LONG.sub("", code)
        command = {"sh": ["sh", "-ec", code], "python": [sys.executable, "-c", code]}.get(language)
        if language == "js":
            npm = f"command -v npm >/dev/null && npm install --silent --no-fund --ignore-scripts {NODE} || exit 77; "
            command = ["sh", "-ec", f"{npm} node {title}"]
        if language == "cpp" and (headers := os.environ.get("NEUROLENS_ORT_HEADERS")):  # its wheel has none
            capi = Path(importlib.util.find_spec("onnxruntime").origin).parent / "capi"
            link = f"ln -s {next(capi.glob('libonnxruntime.so.*'))} libonnxruntime.so.1"
            build = f"c++ -std=c++17 -I{headers} {title} libonnxruntime.so.1 -Wl,-rpath,. -o program"
            command = ["sh", "-ec", f"{link}; {build}; ./program"]
        if command:
            done = subprocess.run(
                command, cwd=tmp_path, env={**os.environ, "PATH": path}, capture_output=True, text=True
            )
            if done.returncode == 77:
                pytest.skip("JavaScript was not run: npm or its registry is not there")
            assert done.returncode == 0, f"{code}\n{done.stdout}\n{done.stderr}"
    if left_out:
        pytest.skip(left_out)


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    if not (executable := os.environ.get("NEUROLENS_BROWSER")):
        pytest.skip("no browser is named (NEUROLENS_BROWSER, see make docs)")
    api = pytest.importorskip("playwright.sync_api", reason="no playwright (pip install '.[web]')")
    with api.sync_playwright() as play:
        found = play.chromium.launch(executable_path=executable, args=["--no-sandbox"])
        yield found
        found.close()


def test_search_works_in_a_folder_opened_from_disk(browser: Any) -> None:
    page, requests, faults = browser.new_page(), [], []
    page.on("request", lambda r: requests.append(r.url))
    page.on("pageerror", lambda e: faults.append(str(e)))
    page.goto((SITE / "docs" / "pages" / "index.html").as_uri())
    page.keyboard.press("Control+k")
    page.keyboard.type("inner_deg")
    page.keyboard.press("Enter")
    page.wait_for_selector("#search-results li a")
    titles = page.eval_on_selector_all("#search-results li a", "links => links.map((a) => a.textContent)")
    assert any("Scene file" in title for title in titles), titles
    assert not faults and all(url.startswith(("file:", "data:")) for url in requests)


# Elements whose text is cut off or leaves the window, unless they, or what they stand in, scroll.
CUT_OFF = """() => ["pre", "table", "img", "dt.sig", "p", "li"]
    .flatMap((kind) => [...document.querySelectorAll(`article ${kind}`)]).filter((e) => {
        for (let a = e; a !== document.body; a = a.parentElement)
            if (["auto", "scroll"].includes(getComputedStyle(a).overflowX)) return false;
        const box = e.getBoundingClientRect();
        return box.right > innerWidth + 1 || box.left < -1 || e.scrollWidth > e.clientWidth + 1;
    }).map((e) => `${e.tagName}: ${e.textContent.slice(0, 60)}`)"""


@pytest.mark.parametrize("width", [1280, 390])
def test_nothing_is_cut_off(browser: Any, width: int) -> None:
    page = browser.new_page(viewport={"width": width, "height": 900})
    files = sorted(SITE.glob("docs/pages/**/*.html")) + sorted(SITE.glob("experiments/**/*.html"))
    assert len(files) > 50
    for file in files:
        page.goto(file.as_uri())
        assert page.evaluate("document.documentElement.scrollWidth") <= width, file
        assert page.evaluate(CUT_OFF) == [], file
