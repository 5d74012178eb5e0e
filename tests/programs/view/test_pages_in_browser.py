"""Every kind of page in a browser, with scripts in every text of a lens, model, file name and error: none of them runs.

Run by `make test-web`. A text runs when it sets window.__pwned, opens a dialog, asks for another file than the page, or
becomes an attribute that is a handler or a link whose address is a script.
"""

import json
import re
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import pytest
from report_results import full_results

from neurolens.cli import main
from neurolens.models.card import CARD_KEY
from neurolens.pictures.render.pictures import write_exr, write_png
from neurolens.studies.pages import write_report
from neurolens.studies.records import Results

ROOT = Path(__file__).parents[3]
RUN = "window.__pwned = 1"
ATTACKS = (
    f"<script>{RUN}</script>", f"</script><script>{RUN}</script>", f"--><script>{RUN}</script>",
    f"</title></style></textarea></select></svg><script>{RUN}</script>", f"<img src=x onerror='{RUN}'>",
    f"\"'><img src=x onerror=\"{RUN}\">", f"<svg onload='{RUN}'><a href='javascript:{RUN}'>x</a></svg>",
    f"javascript:{RUN}", f"' onmouseover='{RUN}' x='", f"<iframe srcdoc='<script>parent.{RUN}</script>'></iframe>",
    "&lt;script&gt;", "${window.__pwned = 1}", "{{ 7 * 7 }}",
)  # fmt: skip
ATTACK = " ".join(ATTACKS)
# Names of files hold no slash and at most 255 bytes.
NAMES = (f"<img src=x onerror='{RUN}'>", f"javascript:{RUN}", f"' onmouseover='{RUN}' x='", f'"><script>{RUN}')
HOW = """() => {
  const wrong = [];
  for (const one of document.querySelectorAll("*")) {
    for (const { name, value } of one.attributes) {
      if (name.startsWith("on") && value.includes("pwned")) wrong.push(`${one.tagName} ${name}`);
      if (/^(href|src|action|formaction|xlink:href|srcdoc|data)$/.test(name)
          && /^\\s*(javascript|vbscript|data:text)/i.test(value)) wrong.push(`${name}=${value}`);
    }
    if (one.tagName === "SCRIPT" && one.textContent.startsWith("window.__pwned")) wrong.push("a script");
  }
  return wrong;
}"""


def opened(browser: Any, file: Path, needs: str = "") -> str:
    """Open a page and do what a reader may; its text, once nothing has run."""
    page = browser.new_page()
    page.set_default_timeout(120_000)
    page.add_init_script("window.__pwned = 0")
    said: list[str] = []
    page.on("dialog", lambda d: (said.append(f"dialog {d.message}"), d.dismiss()))
    page.on("pageerror", lambda e: said.append(str(e)))
    page.on("request", lambda r: said.append(r.url) if not allowed(r.url, file) else None)
    page.goto(file.as_uri())
    if needs:
        page.evaluate(needs)
    page.evaluate("for (const one of document.querySelectorAll('details')) one.open = true")
    for one in page.locator("th, summary, input[type=search], [title]").all():
        if one.is_visible():
            one.hover(force=True)
    for head in page.locator("thead th").all():
        if head.is_visible():
            head.click(force=True)
    for box in page.locator("input[type=search], input[type=text], input:not([type])").all():
        box.fill(ATTACKS[0])
    page.wait_for_timeout(200)
    assert page.evaluate("window.__pwned") == 0
    assert page.evaluate(HOW) == []
    assert said == []
    text: str = page.evaluate("document.documentElement.textContent")
    page.close()
    return text


def allowed(url: str, file: Path) -> bool:
    """Whether a page may ask for this: itself, pictures beside it, what it holds."""
    return url == file.as_uri() or url.startswith(("data:image/", "blob:")) or (
        url.startswith(file.parent.as_uri()) and url.endswith(".png")
    )  # fmt: skip


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Lens files, one of which reads, one of which is refused, under hostile names; a model and a scene."""
    place = tmp_path_factory.mktemp("pages")
    text = (ROOT / "lenses" / "cooke_triplet_50.toml").read_text()
    for key in ("name", "source"):
        text = re.sub(rf"^{key} = .*$", lambda m: f"{key} = {json.dumps(ATTACK)}", text, flags=re.M)  # noqa: B023
    text = re.sub(r'^notes = """.*?"""$', lambda m: f"notes = {json.dumps(ATTACK)}", text, flags=re.M | re.S)
    text = text.replace("f_number = 5.0", f"f_number = 5.0\ndesigner = {json.dumps(ATTACK)}")
    text = text.replace('glass = "SK16", material = "SK16"', f"glass = {json.dumps(ATTACKS[4][:60])}")
    lenses = place / "lenses"
    lenses.mkdir()
    (lenses / "hostile.toml").write_text(text)
    (lenses / f"{NAMES[0]}.toml").write_text(text)
    (lenses / f"{NAMES[1]}.toml").write_text(f"schema = {json.dumps(ATTACK)}\n")
    (lenses / f"{NAMES[2]}.zmx").write_text(f"VERS 1\nNAME {ATTACKS[0]}\nSURF 0\n{ATTACKS[4]}\n")
    (lenses / f"{NAMES[3][:20]}.len").write_text("LEN NEW\n" + ATTACKS[4])
    return place


def card_with_scripts(folder: Path) -> Path:
    """A model whose card has scripts in its texts."""
    model = onnx.load(ROOT / "models" / "cooke_triplet_50.ols-64.onnx")
    (held,) = [p for p in model.metadata_props if p.key == CARD_KEY]
    card = json.loads(held.value)
    card["lens"] |= {"name": ATTACK, "source": ATTACK, "notes": ATTACK}
    card["fit"] |= {"method": ATTACKS[4]}
    card |= {"note": ATTACK, "licence": ATTACK}
    held.value = json.dumps(card)
    onnx.save(model, folder / "hostile.ols.onnx")
    return folder / "hostile.ols.onnx"


@pytest.mark.parametrize("attack", ATTACKS[:10])
def test_a_page_that_escapes_nothing_is_noticed(browser: Any, attack: str, tmp_path: Path) -> None:
    (tmp_path / "page.html").write_text(f"<p title=x data-y='{attack}'>{attack}</p><a href=\"{attack}\">link</a>")
    with pytest.raises(AssertionError):
        opened(browser, tmp_path / "page.html")


def test_library_and_the_pages_of_its_lenses(
    browser: Any, folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from experiments.__main__ import main as experiment
    from experiments.data import library_pages as library

    def draw(path: Path) -> None:
        write_png(path, np.full((20, 30, 3), 0.5))

    monkeypatch.setattr(library, "_drawings", lambda lens: [("layout", ATTACK, draw)])  # all take ten seconds a lens
    files = sorted((folder / "lenses").iterdir())
    assert experiment(["library", "-o", str(tmp_path / "out"), *map(str, files), "--quiet"]) == 1
    index = opened(browser, tmp_path / "out" / "index.html")
    assert ATTACKS[0] in index and "schema: got" in index
    pages = sorted(tmp_path.glob("out/*/index.html"))
    assert len(pages) == 2
    for page in pages:
        assert ATTACK in opened(browser, page)


def test_survey(browser: Any, folder: Path, tmp_path: Path) -> None:
    assert main(["survey", str(folder / "lenses"), "--no-fit", "-o", str(tmp_path / "out"), "--quiet"]) == 0
    text = opened(browser, tmp_path / "out" / "survey.html")
    assert NAMES[0] in text and ATTACKS[0] in text and "schema: got" in text


def test_report(browser: Any, tmp_path: Path) -> None:
    for name in ("pareto.png", "room.png"):
        write_png(tmp_path / name, np.full((20, 30, 3), 0.5))
    write_exr(tmp_path / "room & co.exr", np.full((20, 30, 3), 0.5))
    results: Any = full_results(ATTACK)
    results["command"] = ATTACK
    results["exact"][0]["name"] = results["models"][1]["name"] = results["images"][0]["scene"] = ATTACK
    results["settings"] |= {ATTACK: ATTACK}
    results["models"][0] |= {"family": ATTACK, "variables": ATTACK, "poor": [ATTACK], "file": f"models/{NAMES[1]}.onnx"}
    text = opened(browser, write_report(tmp_path, Results(**results)))
    assert text.count(ATTACK) > 12


def test_view(browser: Any, folder: Path, tmp_path: Path) -> None:
    lens = folder / "lenses" / "hostile.toml"
    shutil.copy(card_with_scripts(tmp_path), folder / "lenses" / "hostile.ols.onnx")
    words = [str(lens), str(folder / "lenses" / "hostile.ols.onnx"), str(folder / "lenses" / f"{NAMES[0]}.toml")]
    assert main(["view", *words, "--downloads", "glsl", "-o", str(tmp_path / "view.html"), "--json"]) == 0
    each = """async () => {
      await neurolens.ready;
      for (const lens of neurolens.shared.lenses) { neurolens.chooseLens(lens); await neurolens.show(); }
    }"""
    text = opened(browser, tmp_path / "view.html", each)
    assert ATTACKS[0] in text
