"""The time to the first picture and to each change on the page of `neurolens view`, by software WebGL2 in a browser.

480 x 270 pixels, one sample, headless Chromium with SwiftShader (the extra "web"; Debian: chromium): the time from a
setting, the page at rest, to the first picture with it, and the processor's time that the GPU process of the browser
took for it (Linux), which other work on the machine changes little: SwiftShader spreads it over the cores. The library
is the page of all lenses with all downloads. Lamps: with every ghost drawn, once all of them are.
Writes view_speed.md and view_speed.json.
"""

from __future__ import annotations

import argparse
import os
import shutil
import statistics
import tempfile
from contextlib import suppress
from pathlib import Path
from typing import Any

from experiments import lab
from neurolens.base.errors import InputError
from neurolens.base.files import library
from neurolens.cli import main

FLAGS = ("--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader")
BROWSERS = ("chromium", "chromium-browser", "google-chrome")
OPTIONS = (
    lab.option("--lens", metavar="LENS", default="petzval_portrait_100", help="lens (default: petzval_portrait_100)"),
    lab.option("--flare", metavar="LENS", default="brendel_tessar_100", help="of ghosts (default: brendel_tessar_100)"),
    lab.count("repeats", 7, "of each change (default: 7)"),
    lab.out(),
)
FIRST_MS, CHANGE_MS = 3000, 200
_ONE = "Object.assign(neurolens.set, {still: true, view: 'one'})"
# Each change, `k` counting its repeats; the rest of the page stands as it was.
CHANGES = {
    "focus": "set.focus = 3 + 0.1 * k",
    "stop": "set.f_number = 4 + 0.2 * k",
    "blades": "set.blades = 5 + k % 8",
    "wavelength": "set.wavelength = 450 + 10 * k",
    "scene": "set.scene = ['chart', 'white', 'night'][k % 3]",
    "exact": "set.a = 'exact', set.focus = 4 + 0.1 * k",
    "network": "set.a = 'network', set.focus = 4 + 0.1 * k",
    "thin lens": "set.a = 'thin', set.focus = 4 + 0.1 * k",
    "wipe, polynomial and exact": "set.a = 'polynomial', set.view = 'wipe', set.focus = 5 + 0.1 * k",
}
# With a lamp and all of its ghosts.
LAMPS = {
    "lamp moved": "set.lamp = [0.5 + 0.02 * k, 0.6]",
    "lamp dimmed": "set.irradiance = 0.5 - 0.05 * k",
    "focus beside a lamp": "set.focus = 20 + k",
}
_ALL_GHOSTS = """new Promise((done) => {
  const look = () => {
    const { shown, all } = neurolens.ghosts;
    return shown && shown === all ? done(all) : setTimeout(look, 20);
  };
  neurolens.idle().then(look);
})"""


def run(args: argparse.Namespace) -> int:
    """Measure and write the table."""
    browser = next((found for name in BROWSERS if (found := shutil.which(name))), None)
    if browser is None:
        raise InputError("experiments view", "browser", "(none)", f"one of {', '.join(BROWSERS)}")
    from playwright.sync_api import sync_playwright

    with tempfile.TemporaryDirectory() as folder, sync_playwright() as play:
        files = [Path(folder) / f"{name}.html" for name in "alf"]
        every = [str(lens) for lens in sorted((library() / "lenses").glob("*.toml"))]
        for words, file in zip(([args.lens], every, [args.flare, "--ghosts"]), files, strict=True):
            main(["view", *words, *(["--downloads", "glsl"] if words is not every else []), "-o", str(file)])
        opened = play.chromium.launch(executable_path=browser, args=list(FLAGS))
        whole = f"first picture, library ({files[1].stat().st_size / 1e6:.2f} MB)"
        rows = [
            _first(opened, file, name, args.repeats) for file, name in ((files[0], "first picture"), (files[1], whole))
        ]
        page = _opened(opened, files[0])
        rows += [_change(page, name, script, args.repeats) for name, script in CHANGES.items()]
        page.close()
        page = _opened(opened, files[2])
        page.evaluate("(neurolens.set.tool = 'lamp', neurolens.click([0.5, 0.6]))")
        count = page.evaluate(_ALL_GHOSTS)
        rows += [_change(page, f"{name}, {count} ghosts", script, args.repeats) for name, script in LAMPS.items()]
        opened.close()
    kinds = ("least", "median", "processor", "wanted")
    columns = lab.columns(("change", "change"), *((f"{kind} ms", f"{kind}_ms", ".0f") for kind in kinds))
    load = f"Load at the end: {os.getloadavg()[0]:.1f} (one process of ours and the browser: 1 to 2)."
    parts = [__doc__ or "", f"{lab.machine_line()} {load}", lab.table(columns, rows, "–")]
    data = {"machine": lab.machine(), "lens": args.lens, "flare": args.flare, "rows": rows}
    print(lab.write_results(args.out, "view_speed", lab.page("# The page in software WebGL", *parts), data))
    return 0


def _opened(browser: Any, file: Path) -> Any:
    page = browser.new_page()
    page.goto(file.as_uri())
    page.evaluate(f"neurolens.ready.then(() => {_ONE})")
    return page


def _first(browser: Any, file: Path, name: str, repeats: int) -> dict[str, Any]:
    """The time from opening the file to the first picture, shaders compiled."""
    took = []
    for _ in range(min(repeats, 5)):
        page = browser.new_page()
        page.goto(file.as_uri())
        took.append(page.evaluate("neurolens.ready.then(() => performance.now())"))
        page.close()
    return _row(name, took, [], FIRST_MS)


def _change(page: Any, name: str, script: str, repeats: int) -> dict[str, Any]:
    """The time of each change after a first one, which compiles what the change needs and is not counted."""
    once = f"""async (k) => {{
      const {{ set, engine }} = neurolens;
      await new Promise((settled) => setTimeout(settled, 300));
      const start = performance.now();
      {script};
      await neurolens.show();
      for (const side of set.view === "one" ? ["a"] : ["a", "b"]) engine.gpu.read(engine.sides[side].film, 0, 0, 1, 1);
      return performance.now() - start;
    }}"""  # reading a pixel waits for the GPU
    page.evaluate(once, 0)
    took, spent = [], []
    for k in range(1, repeats + 1):
        before = _processor_ms()
        took.append(page.evaluate(once, k))
        spent.append(_processor_ms() - before)
    return _row(name, took, spent, CHANGE_MS)


def _processor_ms() -> float:
    """Processor time of every GPU process of a browser on this machine; 0 where /proc does not tell."""
    total = 0.0
    for place in Path("/proc").glob("[0-9]*"):
        with suppress(OSError):
            if b"--type=gpu-process" in (place / "cmdline").read_bytes():
                user, system = (place / "stat").read_text().rsplit(")", 1)[1].split()[11:13]
                total += (int(user) + int(system)) * 1000 / os.sysconf("SC_CLK_TCK")
    return total


def _row(name: str, took: list[float], spent: list[float], wanted: int) -> dict[str, Any]:
    found = {"change": name, "least_ms": min(took), "median_ms": statistics.median(took), "wanted_ms": wanted}
    return found | {"processor_ms": statistics.median(spent) if spent else None}
