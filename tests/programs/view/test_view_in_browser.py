"""The page in a browser with software WebGL2 and WebGPU: its pictures against those of the renderer and of each other,
every control, no request.

Run by `make test-web`, which sets NEUROLENS_BROWSER to a Chromium, and NEUROLENS_ORT to the files of onnxruntime-web.
"""

import io
import os
import re
import shutil
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from neurolens.cameras.build import make_camera
from neurolens.cameras.onnxlens import load_model
from neurolens.cameras.shaders.source import model_extras
from neurolens.cli import main
from neurolens.models.source import export_source
from neurolens.optics.lens.shot import Shot
from neurolens.optics.readers.lensfile import read_lens
from neurolens.optics.setting.states import set_lens
from neurolens.pictures.flare.canvas import Raster
from neurolens.pictures.flare.ghosts import GhostTracer
from neurolens.pictures.flare.job import FlareJob
from neurolens.pictures.flare.lights import Light
from neurolens.pictures.render.renderer import render
from neurolens.pictures.render.scene import scene_from_tables
from neurolens.pictures.render.settings import FlareSettings
from tests.ghost_pictures import ghost_picture

ROOT = Path(__file__).parents[3]
LENS = "petzval_portrait_100"
ZOOM = "nikon_zoom_80_200"
WIDE, HIGH = 240, 135  # of compared pictures
NM = 550.0
GPUS = "webgl2", "webgpu"


@pytest.fixture(scope="module")
def page_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("view") / "view.html"
    words = [str(ROOT / "models" / f"{ZOOM}-range.states-64.onnx"), LENS, ZOOM]
    assert main(["view", *words, "--downloads", "glsl", "-o", str(out), "--json"]) == 0
    return out


class Opened:
    """A page with what it said and asked for."""

    def __init__(self, browser: Any, file: Path, gpu: str = "webgl2", **options: Any) -> None:
        self.page = browser.new_page(**options)
        self.said: list[str] = []
        self.asked: list[str] = []
        # Chromium tells that a test which read pixels back had to wait for drawing.
        self.page.on("console", lambda m: None if "GPU stall due to ReadPixels" in m.text else self.said.append(m.text))
        self.page.on("pageerror", lambda e: self.said.append(str(e)))
        self.page.on("request", lambda r: self.asked.append(r.url))
        self.address = f"{file.as_uri()}?gpu={gpu}"
        self.page.goto(self.address)
        self.page.evaluate("neurolens.ready")

    def set(self, **settings: Any) -> None:
        """Settings of the page's own object, and the first sample with them."""
        self.page.evaluate("s => { Object.assign(neurolens.set, s); return neurolens.show(); }", settings)

    def lens(self, key: str) -> None:
        self.page.evaluate(
            "k => { const n = neurolens; n.chooseLens(n.shared.lenses.find((l) => l.key === k)); return n.show(); }",
            key,
        )

    def picture(self, samples: int) -> np.ndarray:
        """[HIGH, WIDE] green of the left side, the first row on top."""
        script = """async (n) => {
          for (let k = 1; k < n; k++) neurolens.pass();
          return [...await neurolens.engine.picture("a")];
        }"""
        rows = np.array(self.page.evaluate(script, samples)).reshape(HIGH, WIDE, 4)
        return rows[::-1, :, 1]

    def number(self, script: str) -> Any:
        return self.page.evaluate(script)


@pytest.fixture(scope="module")
def opened(browser: Any, page_file: Path) -> Iterator[Opened]:
    found = Opened(browser, page_file)
    found.lens(LENS)
    found.set(still=True, view="one", a="polynomial", width=WIDE, wavelength=NM)
    yield found
    assert found.said == []
    assert found.asked == [found.address]


BALLS = """b => {
  const n = neurolens, empty = n.sceneUniforms("night", 1, 1), ball = new Float32Array(empty.ball.length);
  const coat = new Float32Array(empty.coat.length);
  const boxes = [0, 0, 0, 0, 0, 0, -1e3, -1e3, -1e3, 1e3, 1e3, 1e3];
  b.forEach((v, k) => { ball.set(v, 4 * k); coat.set([100, 100, 100, -1], 4 * k); });
  const around = { around: boxes, person: 0, solids: 0, balls: b.length };
  const scene = { ...empty, ...around, ball, coat, floor_y: -1e6, key_power: 0 };
  return n.engine.prepare(n.set.lens, { a: n.set.a }, n.set, scene).then(() => {
    n.pass();
    return n.engine.sides.a.values.film_mm;
  });
}"""


def ours(
    camera: str, film_mm: list[float], settings: dict[str, Any], tables: dict[str, Any], samples: int
) -> np.ndarray:
    """[HIGH, WIDE] of our renderer, in the same light; its pixels are square, those of an anamorphic page are not."""
    shot = Shot(tuple(film_mm), settings["focus"], settings["f_number"], wavelength_nm=(NM, NM), clamp_f_number=True)
    place = {"position_m": [0.0, 0.0, 0.0], "look_at_m": [0.0, 0.0, -1.0], "focus_m": settings["focus"]}
    sizes = {"film_width_mm": film_mm[0], "film_height_mm": film_mm[1], "wavelengths_nm": [NM, NM]}
    scene = scene_from_tables({"camera": {**place, **sizes}, **tables})
    height = round(WIDE * film_mm[1] / film_mm[0])
    result = render(scene, make_camera(camera, shot), width=WIDE, height=height, samples=samples, threads=1)
    edges = np.linspace(0, height, HIGH + 1)
    rows = np.clip(np.arange(1, height + 1) - edges[:, None], 0, 1)  # of each how much lies above an edge, from below
    share = np.diff(-rows, axis=0) * HIGH / height
    return share @ result.rgb[..., 1].astype(float)


OTHERS = "laikin_double_gauss_50", "isshiki_fisheye_10", "cooke_anamorphic_42"
CAMERAS = {"polynomial": str(ROOT / "models" / f"{LENS}.ols-64.onnx"), "exact": str(ROOT / "lenses" / f"{LENS}.toml")}


@pytest.mark.parametrize("kind", CAMERAS)
@pytest.mark.parametrize("f_number", [3.6, 8.0])
def test_white_card_darkens_as_in_our_renderer(opened: Opened, kind: str, f_number: float) -> None:
    settings = {"focus": 4.0, "f_number": f_number}
    opened.set(scene="white", a=kind, blades=0, **settings)
    found = opened.picture(64)
    film = opened.number("neurolens.engine.sides.a.values.film_mm")
    wanted = ours(CAMERAS[kind], film, settings, {"environment": {"colour": [1.0, 1.0, 1.0]}}, 16)
    blocks = [p.reshape(9, 15, 16, 15).mean((1, 3)) for p in (found, wanted)]
    middle = [b[4, 7:9].mean() for b in blocks]
    assert np.abs(blocks[0] / middle[0] - blocks[1] / middle[1]).max() < 0.01
    assert middle[0] == pytest.approx(1, abs=0.01)  # exposed as every camera: uniform light of radiance 1 gives 1


def spots(picture: np.ndarray, places: list[tuple[int, int]], half: int) -> list[tuple[float, float, float]]:
    """Centre (x, y) in pixels and area, that of a disc with the same second moments, of the light around each place."""
    found = []
    for x, y in places:
        part = picture[y - half : y + half + 1, x - half : x + half + 1]
        ys, xs = np.mgrid[y - half : y + half + 1, x - half : x + half + 1]
        part = np.where(part > 0.02 * part.max(), part, 0) / part[part > 0.02 * part.max()].sum()
        cx, cy = (part * xs).sum(), (part * ys).sum()
        moments = np.cov(np.stack([xs.ravel(), ys.ravel()]), aweights=part.ravel(), ddof=0)
        found.append((cx, cy, 4 * np.pi * np.sqrt(np.linalg.det(moments))))
    return found


@pytest.mark.parametrize("kind", CAMERAS)
@pytest.mark.parametrize(("far", "radius", "half"), [(4.0, 0.012, 5), (20.0, 0.12, 12)])
def test_small_lights_lie_and_spread_as_in_our_renderer(
    opened: Opened, kind: str, far: float, radius: float, half: int
) -> None:
    """In focus at 4 m, and as discs from 20 m."""
    settings = {"focus": 4.0, "f_number": 3.6}
    opened.set(scene="night", a=kind, blades=0, **settings)
    film = opened.number("neurolens.engine.sides.a.values.film_mm")
    per_pixel = far * film[0] / WIDE / 100.0  # about: the lens is one of 100 mm
    places = [(x, y) for x in (-85, -30, 30, 85) for y in (-40, 0, 40)]
    balls = [[x * per_pixel, y * per_pixel, -far, radius] for x, y in places]
    opened.page.evaluate(BALLS, balls)
    found = opened.picture(128)
    lights = [{"centre_m": b[:3], "radius_m": b[3], "emission": [100.0] * 3} for b in balls]
    dark = {"environment": {"colour": [0.0, 0.0, 0.0]}}
    wanted = ours(CAMERAS[kind], film, settings, {**dark, "spheres": lights}, 256)  # 64: noise moves one by 0.1 pixels
    near = [(round((WIDE - 1) / 2 + x * 1.03), round((HIGH - 1) / 2 - y * 1.03)) for x, y in places]
    pairs = list(zip(spots(found, near, half), spots(wanted, near, half), strict=True))
    assert max(np.hypot(a[0] - b[0], a[1] - b[1]) for a, b in pairs) < 0.1
    areas = np.array([[a[2], b[2]] for a, b in pairs])
    assert areas[:, 0].mean() == pytest.approx(areas[:, 1].mean(), rel=0.02)
    sky = 0.1  # brighter than it
    assert found[found > sky].sum() == pytest.approx(wanted[wanted > sky].sum(), rel=0.02)


@pytest.fixture(scope="module")
def others_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("view") / "others.html"
    assert main(["view", *OTHERS, "--downloads", "glsl", "-o", str(out), "--json"]) == 0
    return out


@pytest.fixture(scope="module")
def others(browser: Any, others_file: Path) -> Iterator[Opened]:
    found = Opened(browser, others_file)
    found.set(still=True, view="one", a="polynomial", width=WIDE, wavelength=NM)
    yield found
    assert found.said == []


@pytest.mark.parametrize(
    ("file", "forms"),
    [
        ("page_file", [(LENS, "exact"), (LENS, "polynomial"), (LENS, "network"), (LENS, "thin"), (ZOOM, "polynomial")]),
        ("others_file", [(key, "exact") for key in OTHERS]),
    ],
)
def test_webgpu_draws_what_webgl2_draws(
    browser: Any, file: str, forms: list[tuple[str, str]], request: pytest.FixtureRequest
) -> None:
    """Both run the same shaders and may round differently: a pixel may differ where a ray meets an edge."""
    pages = {}
    for gpu in ("WebGL2", "WebGPU"):
        pages[gpu] = Opened(browser, request.getfixturevalue(file), gpu.lower())
        pages[gpu].set(still=True, view="one", scene="night", width=WIDE, blades=6)
    for key, kind in forms:
        pictures, shown = [], []
        for opened in pages.values():
            opened.lens(key)
            opened.set(a=kind)
            pictures.append(opened.picture(4))
            png = opened.page.locator("#picture").screenshot()
            shown.append(np.array(Image.open(io.BytesIO(png)).convert("RGB"), float))
        assert pictures[0].std() > 0.1
        apart = np.abs(pictures[0] - pictures[1]) > 1e-4 * (1 + pictures[0])
        assert apart.mean() < 0.01, (key, kind)
        assert pictures[1].mean() == pytest.approx(pictures[0].mean(), rel=1e-3)
        assert (np.abs(shown[0] - shown[1]).max(-1) > 2).mean() < 0.01, (key, kind)
    for gpu, opened in pages.items():
        assert opened.number("neurolens.engine.gpu.name") == gpu
        assert f"by {gpu} on" in opened.page.locator("#facts").inner_text()
        assert opened.said == []


@pytest.mark.parametrize("key", OTHERS)
def test_other_lenses_too(others: Opened, key: str) -> None:
    """White cards, and lights behind the focus, of a rectilinear lens, a fisheye and an anamorphic lens."""
    others.lens(key)
    others.set(scene="white", a="polynomial", blades=0)
    settings = others.number("(({ focus, f_number }) => ({ focus, f_number }))(neurolens.set)")
    film = others.number("neurolens.engine.sides.a.values.film_mm")
    method = others.number("neurolens.set.lens.forms.find((f) => f.kind === 'polynomial').method")
    camera, shown = str(ROOT / "models" / f"{key}.{method}.onnx"), others.picture(64)
    wanted = ours(camera, film, settings, {"environment": {"colour": [1.0, 1.0, 1.0]}}, 16)
    blocks = [p.reshape(9, 15, 16, 15).mean((1, 3)) for p in (shown, wanted)]
    middle = [b[4, 7:9].mean() for b in blocks]
    assert np.abs(blocks[0] / middle[0] - blocks[1] / middle[1]).max() < 0.01

    near = [(x, y) for x in (30, 75, 165, 210) for y in (25, 67, 110)]
    far, directions = 3 * settings["focus"], []
    for x, y in near:
        script = f"neurolens.engine.direction('a', [{(x + 0.5) / WIDE}, {1 - (y + 0.5) / HIGH}])"
        directions.append(others.number(script))
    turn = np.arccos(np.dot(directions[4], directions[7]))  # of 90 pixels
    balls = [[*(far * np.array(d)), 3 * far * turn / 90] for d in directions]  # of three pixels
    others.set(scene="night")
    others.page.evaluate(BALLS, balls)
    found = others.picture(128)
    lights = [{"centre_m": b[:3], "radius_m": b[3], "emission": [100.0] * 3} for b in balls]
    wanted = ours(camera, film, settings, {"environment": {"colour": [0.0, 0.0, 0.0]}, "spheres": lights}, 64)
    pairs = list(zip(spots(found, near, 12), spots(wanted, near, 12), strict=True))
    assert max(np.hypot(a[0] - b[0], a[1] - b[1]) for a, b in pairs) < 0.1
    areas = np.array([[a[2], b[2]] for a, b in pairs])
    assert areas[:, 0].mean() == pytest.approx(areas[:, 1].mean(), rel=0.02)


@pytest.mark.parametrize("gpu", GPUS)
def test_a_lamp_is_dragged_and_its_ghosts_are_those_of_neurolens_flare(browser: Any, tmp_path: Path, gpu: str) -> None:
    lens = set_lens(read_lens(ROOT / "lenses" / "brendel_tessar_100.toml"), focus_m=np.inf)
    tracer = GhostTracer(lens)
    words = ["brendel_tessar_100", "--ghosts", "--downloads", "glsl"]
    assert main(["view", *words, "-o", str(tmp_path / "view.html"), "--json"]) == 0
    opened = Opened(browser, tmp_path / "view.html", gpu)
    opened.set(view="one", tool="lamp", width=WIDE, wavelength=NM, focus=np.inf, most=1)
    box = opened.page.locator("#picture").bounding_box()
    assert box is not None
    opened.page.mouse.move(box["x"] + 0.4 * box["width"], box["y"] + 0.4 * box["height"])
    opened.page.mouse.down()
    opened.page.mouse.move(box["x"] + 0.7 * box["width"], box["y"] + 0.3 * box["height"], steps=3)
    opened.page.mouse.up()
    drawn = f"neurolens.ghosts.shown === {len(tracer.pairs)} ? done() : setTimeout(look, 20)"
    opened.page.evaluate(f"new Promise((done) => {{ const look = () => {drawn}; look(); }})")
    assert opened.number("neurolens.set.lamp") == pytest.approx([0.7, 0.7], abs=0.01)
    found = opened.number("(async () => [...await neurolens.engine.gpu.read(neurolens.ghosts.film)])()")
    picture = np.array(found).reshape(HIGH, WIDE, 4)[::-1, :, 1]
    x, y, z = opened.number("neurolens.ghosts.lamp.towards")
    rgb = (opened.number("neurolens.set.irradiance"),) * 3
    light = Light(np.degrees(np.arctan2(x, -z)), np.degrees(np.arcsin(y)), rgb)
    raster = Raster(tuple(opened.number("neurolens.engine.sides.a.values.film_mm")), WIDE, HIGH)
    settings = FlareSettings(bins=1, cell_px=4)
    job = FlareJob(tracer.lens, [light], raster, settings, (NM - 1, NM + 1), ghosts=tracer, finer=1)
    wanted = ghost_picture(job)[0, ..., 1]
    assert picture.sum() == pytest.approx(wanted.sum(), rel=0.02)
    coarse = [p.reshape(27, 5, 48, 5).mean((1, 3)) for p in (picture, wanted)]
    assert np.abs(coarse[0] - coarse[1]).sum() < 0.1 * coarse[1].sum()
    opened.page.locator("#picture").press("ArrowLeft")
    opened.page.evaluate("neurolens.idle()")
    assert opened.number("neurolens.set.lamp[0]") == pytest.approx(0.68, abs=0.01)
    assert opened.said == []


@pytest.mark.parametrize("gpu", GPUS)
def test_every_control_changes_the_picture(browser: Any, page_file: Path, gpu: str) -> None:
    opened = Opened(browser, page_file, gpu)
    page = opened.page
    opened.set(still=True)
    page.select_option("#lens", LENS)
    last = page.locator("#picture").screenshot()
    moves: list[tuple[str, Any]] = [
        *((f"#{name}", None) for name in ("focus", "stop", "blades", "roundness", "light")),
        ("input[name=view][value=one]", True), ("#a", "exact"), ("#a", "thin"), ("#a", "network"),
        ("input[name=scene][value=chart]", True), ("input[name=scene][value=white]", True),
        ("input[name=scene][value=night]", True), ("input[name=view][value=difference]", True), ("#b", "thin"),
        ("input[name=view][value=wipe]", True), ("#wipe", None), ("#size", "960"), ("#lens", ZOOM), ("#zoom", None),
    ]  # fmt: skip
    for place, value in moves:
        if value is True:
            page.locator(place).check(force=True)
        elif value is None:
            page.locator(place).evaluate(
                "e => { e.value = +e.min + 0.7 * (e.max - e.min); e.dispatchEvent(new Event('input')); }"
            )
        else:
            page.select_option(place, value)
        page.evaluate("neurolens.idle()")
        now = page.locator("#picture").screenshot()
        assert now != last, place
        last = now
    assert opened.said == []
    assert opened.asked == [opened.address]


@pytest.mark.parametrize("gpu", GPUS)
def test_clicks_focus_and_draw_rays_by_mouse_and_by_keys(browser: Any, page_file: Path, gpu: str) -> None:
    opened = Opened(browser, page_file, gpu)
    page = opened.page
    opened.lens(LENS)
    opened.set(still=True, view="one", width=WIDE, scene="chart", tool="focus", focus=10.0, a="polynomial")
    page.locator("#picture").click(position={"x": 300, "y": 100})
    page.evaluate("neurolens.idle()")
    framing = opened.number("neurolens.framing()")
    assert opened.number("neurolens.set.focus") == pytest.approx(framing["far"], rel=1e-3)
    opened.set(tool="rays")
    page.locator("#picture").press("ArrowUp")
    page.locator("#picture").press("Enter")
    page.wait_for_selector("#layout .ray", state="attached")
    assert page.locator("#layout .ray").count() == 9
    page.locator("#picture").press("[")
    assert opened.number("neurolens.set.wipe") < 0.5
    opened.page.evaluate("neurolens.measure()")
    said = page.locator("#facts").inner_text()
    assert re.search(rf"a ray by {gpu} on this GPU\s+[\d.]+ ns", said, re.I)
    assert opened.said == []


def test_downloads_are_the_files(browser: Any, tmp_path: Path) -> None:
    """Of every form, as they are written without a page: byte for byte; C compiles."""
    assert main(["view", LENS, "-o", str(tmp_path / "view.html"), "--json"]) == 0
    opened = Opened(browser, tmp_path / "view.html")
    models = {kind: ROOT / "models" / f"{LENS}.{kind}.onnx" for kind in ("ols-64", "mlp-16x2")}
    wanted = {("exact", to): exported(ROOT / "lenses" / f"{LENS}.toml", to, tmp_path) for to in ("glsl", "c", "osl")}
    for form, file in zip(("polynomial", "network"), models.values(), strict=True):
        model = load_model(file)
        extras, notes = model_extras(model)
        for to in ("glsl", "c"):
            nodes, out = model.file.nodes, tmp_path / f"{form}.{to}"
            path = export_source(nodes, out, to, model.card, extras=extras, notes=notes).path
            wanted[form, to] = path.read_bytes()
        wanted |= {(form, "onnx"): file.read_bytes(), (form, "osl"): exported(file, "osl", tmp_path)}
    found = {}
    for form in ("polynomial", "network", "exact"):
        opened.set(a=form)
        for button in opened.page.locator("#downloads button").all():
            with opened.page.expect_download() as download:
                button.click()
            place = Path(download.value.path())
            assert download.value.suggested_filename.startswith(f"{LENS}.{form}.")
            found[form, button.inner_text().lower()] = place.read_bytes()
            if button.inner_text() == "C" and (compiler := shutil.which("cc")):
                flags = ["-std=c99", "-Wall", "-Wextra", "-Werror", "-fsyntax-only", "-x", "c"]
                subprocess.run([compiler, *flags, str(place)], check=True)
    assert found.keys() == wanted.keys()
    assert [key for key in found if found[key] != wanted[key]] == []
    assert opened.said == []


def exported(file: Path, to: str, folder: Path) -> bytes:
    out = folder / f"{file.stem}.{to}"
    assert main(["export", str(file), "--to", to, "-o", str(out), "--json"]) == 0
    return out.read_bytes()


def test_it_says_what_is_missing(browser: Any, page_file: Path) -> None:
    for lacking, word in (("getContext", "WebGL2"), ("getExtension", "EXT_color_buffer_float")):
        page = browser.new_page()
        owner = "HTMLCanvasElement" if lacking == "getContext" else "WebGL2RenderingContext"
        page.add_init_script(f"{owner}.prototype.{lacking} = () => null;")
        page.goto(f"{page_file.as_uri()}?gpu=webgl2")
        page.evaluate("neurolens.ready")
        assert word in page.locator("#missing").inner_text()
        page.close()


def test_a_page_that_loses_webgpu_goes_on_with_webgl2(browser: Any, page_file: Path) -> None:
    opened = Opened(browser, page_file, "webgpu")
    with opened.page.expect_navigation():
        opened.page.evaluate("void neurolens.engine.gpu.device.destroy()")
    opened.page.evaluate("neurolens.ready")
    assert opened.number("neurolens.engine.gpu.name") == "WebGL2" and opened.said == []


def test_a_phone_shows_everything_in_its_width(browser: Any, page_file: Path) -> None:
    opened = Opened(browser, page_file, viewport={"width": 360, "height": 740}, has_touch=True)
    assert opened.number("document.documentElement.scrollWidth") <= 360
    opened.page.locator("#picture").tap(position={"x": 200, "y": 60})
    opened.page.evaluate("neurolens.idle()")
    assert opened.number("neurolens.set.clicked") is not None
    assert opened.said == []


def test_models_give_the_same_rays_in_onnxruntime_web(browser: Any, tmp_path: Path) -> None:
    folder = os.environ.get("NEUROLENS_ORT")
    if not folder:
        pytest.skip("no onnxruntime-web is named (NEUROLENS_ORT, see make test-web)")
    page = browser.new_page()
    kinds = {".mjs": "text/javascript", ".wasm": "application/wasm", ".onnx": "application/octet-stream"}

    def serve(route: Any) -> None:
        name = route.request.url.rsplit("/", 1)[1].split("?")[0]
        file = ROOT / "models" / name if name.endswith(".onnx") else Path(folder) / name
        if file.is_file():
            route.fulfill(body=file.read_bytes(), content_type=kinds[file.suffix])
        else:
            route.fulfill(body="<!DOCTYPE html>", content_type="text/html")

    page.route("**/*", serve)
    page.goto("http://neurolens.test/")
    for method in ("ols-64", "mlp-16x2"):
        name = f"{LENS}.{method}.onnx"
        reference = load_model(ROOT / "models" / name).card["reference"]
        rays = np.array(reference["rays"], np.float32)
        script = """async ([name, rays, film, stop]) => {
          const ort = await import("http://neurolens.test/ort.wasm.min.mjs");
          ort.env.wasm.numThreads = 1;
          const session = await ort.InferenceSession.create("http://neurolens.test/" + name);
          const tensor = (data, shape) => new ort.Tensor("float32", Float32Array.from(data), shape);
          const count = rays.length / 5;
          const out = await session.run({ rays: tensor(rays, [5, count]), film_z_mm: tensor(film, [1]),
            stop_radius_mm: tensor([stop], [1]) });
          return Object.fromEntries(Object.entries(out).map(([k, v]) => [k, Array.from(v.data, Number)]));
        }"""
        film = reference["film_z_mm"]
        found = page.evaluate(script, [name, rays.ravel().tolist(), film[:1], reference["stop_radius_mm"]])
        status = np.array(reference["status"])
        assert found["status"] == status.tolist()
        passed = status == 0
        ray = np.array(found["scene_ray"]).reshape(6, -1)
        known = np.array(reference["scene_ray"])
        assert np.abs(ray - known)[:3, passed].max() < 4 * reference["rounding"]["position_mm"]
        assert np.abs(ray - known)[3:, passed].max() < 4 * reference["rounding"]["direction"]
