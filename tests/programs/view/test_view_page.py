"""The page without a browser: that it is whole, small and safe, its shaders compile, and what it takes from graphs."""

import base64
import json
import lzma
import re
import shutil
import subprocess
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

import neurolens.programs.view as pages
from neurolens.base.errors import InputError
from neurolens.base.html import text_of
from neurolens.base.settings import LIGHT_NM
from neurolens.cli import main
from neurolens.graph.interpret import evaluate
from neurolens.graph.ir import Graph
from neurolens.graph.shading import urgent
from neurolens.optics.lens.figures import Figure
from neurolens.optics.lens.prescription import Lens, Surface
from neurolens.optics.readers.lensfile import read_lens
from neurolens.optics.setting.pupils import pupil_plane_z_mm
from neurolens.optics.setting.states import set_lens
from neurolens.optics.trace.rays import trace
from neurolens.optics.trace.surfaces import Rays
from neurolens.optics.trace.tracegraph import exact_graph

ROOT = Path(__file__).parents[3]
LENS = "thorlabs_lb1471_biconvex_50"
GLSLANG, NODE = shutil.which("glslangValidator"), shutil.which("node")


@pytest.fixture(scope="module")
def view(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("view") / "view.html"
    assert main(["view", LENS, "--downloads", "glsl", "-o", str(out), "--json"]) == 0
    return out


def data_of(text: str) -> Any:
    """The page's JSON, with the facts of every lens."""
    size, letters = re.findall(r'id="data" data-bytes="(\d+)">([^<]*)<', text)[0]
    data = json.loads(unpacked(letters, int(size)))
    for lens in data["lenses"]:
        stream, length = lens["stream"]
        assert lens.keys() == {"key", "name", "stream", "parts"}  # all else waits in the stream until it is chosen
        whole = unpacked(re.findall(rf'id="{stream}">([^<]*)<', text)[0], length)
        ((start, count),) = [(start, count) for name, start, count, _ in lens["parts"] if name == "facts"]
        lens |= json.loads(whole[start : start + count])
    return data


def unpacked(letters: str, size: int) -> bytes:
    """By the library's own LZMA."""
    values = np.array([pages.CHARACTERS.index(c) for c in letters]).reshape(-1, 2) @ (91, 1)
    data = np.packbits((values[:, None] >> np.arange(12, -1, -1)) & 1).tobytes()
    return lzma.LZMADecompressor(lzma.FORMAT_RAW, filters=pages.FILTERS).decompress(data, size)


class Elements(HTMLParser):
    def __init__(self) -> None:
        super().__init__()
        self.found: list[tuple[str, dict[str, str | None]]] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.found.append((tag, dict(attrs)))


def test_it_fetches_nothing(view: Path) -> None:
    text = view.read_text(encoding="utf-8")
    elements = Elements()
    elements.feed(text)
    tags = {tag for tag, _ in elements.found}
    assert not tags & {"img", "iframe", "object", "embed", "video", "audio", "base"}
    assert all("src" not in given for _, given in elements.found)
    assert {given["href"] for _, given in elements.found if "href" in given} == {"data:,"}
    assert not re.search(r"@import|url\(|fetch\(|XMLHttpRequest|WebSocket|import\(|eval\(|new Function", text)
    policy = next(given["content"] for _, given in elements.found if "http-equiv" in given)
    assert policy is not None and policy.startswith("default-src 'none'")


@pytest.fixture(scope="module")
def written(view: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of the shaders in GLSL and WGSL, as the page's own script puts them together."""
    if not NODE:
        pytest.skip("no node")
    folder = tmp_path_factory.mktemp("shaders")
    text = view.read_text(encoding="utf-8")
    data = data_of(text)
    (stream,) = re.findall(r'id="lenses-0">([^<]*)<', text)
    scripts = "\n".join(
        text_of(name) for name in ("packed.js", "gl.js", "wgsl.js", "scene.js", "engine.js", "ghosts.js")
    )
    script = f"""{scripts}
const data = {json.dumps(data)}, fs = require("fs");
globalThis.document = {{ getElementById: () => ({{ textContent: {json.dumps(stream)} }}) }};
const write = (name, fragment, vertex = VERTEX) => {{
  fs.writeFileSync(`${{name}}.frag`, HEAD + fragment);
  fs.writeFileSync(`${{name}}.vert`, HEAD + vertex);
  const uniforms = uniformsOf(vertex, fragment).found;
  fs.writeFileSync(`${{name}}.wgsl`, wgslOf(fragment, uniforms, false));
  fs.writeFileSync(`${{name}}-vertices.wgsl`, wgslOf(vertex, uniforms, true));
}};
write("scene", sceneShader(data));
write("show", SHOW);
write("ghosts", GHOST_FRAGMENT, GHOST_VERTEX);
write("thin", raysShader(data, data.functions.thin.text, data.functions.thin.call));
const [lens] = data.lenses;
for (const form of lens.forms)
  write(form.kind, raysShader(data, partOf(lens, `${{form.kind}}/glsl`), form.call));
"""
    subprocess.run([str(NODE), "-e", script], check=True, cwd=folder, capture_output=True)
    return folder


@pytest.mark.skipif(not GLSLANG, reason="no glslangValidator")
def test_shaders_compile(written: Path) -> None:
    files = sorted([*written.glob("*.frag"), *written.glob("*.vert")])
    assert len(files) == 14
    done = subprocess.run([str(GLSLANG), *map(str, files)], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout


def test_shaders_compile_as_wgsl(written: Path) -> None:
    """By naga, the compiler of Firefox."""
    wgpu = pytest.importorskip("wgpu", reason="no wgpu (pip install '.[shading]')")
    try:
        device = wgpu.gpu.request_adapter_sync().request_device_sync()
    except RuntimeError as error:
        pytest.skip(f"no adapter of Vulkan: {error}")
    files = sorted(written.glob("*.wgsl"))
    assert len(files) == 14
    for file in files:
        device.create_shader_module(label=file.name, code=file.read_text())
    with pytest.raises(wgpu.GPUValidationError):
        device.create_shader_module(code=files[0].read_text().replace("main();", "main(1);"))


CODE = """\
/* t1 in µm, <b> & \\ */
    float t1 = 1.0f / x;
    float t12 = A_LENS_FMA(t1, (-0.5f), t1);
    float t13 = A_LENS_FMA(t1, t12, 2.0f);
    float t4 = t13 > t12 ? t13 : t1 - t12;
    return t13;
"""


@pytest.mark.skipif(not NODE, reason="no node")
def test_parts_are_unpacked_as_they_were() -> None:
    """Code, its steps in turn and as shaders have them, and texts that counting could not give back; bytes that nothing
    shortens."""
    steps = [f"    float t{k} = {said};\n" for k, said in enumerate(("x * y", "x * x", "t1 * t1", "t2 * t0"))]
    in_turn, shader = (f"float x = 1.0;\n{''.join(lines)}P = t3;\n" for lines in (steps, urgent(steps)))
    assert shader.index("t1 =") < shader.index("t0 =")
    noise = np.random.default_rng(0).integers(0, 256, 3000).astype(np.uint8).tobytes()
    parts = {"c": CODE, "bytes": noise, "none": "", "less": f"{CODE}t2-1 t1\n", "mark": f"{CODE}\x01\n"}
    parts |= {"again": noise + b"x", "in turn": in_turn, "shader": shader}
    text, index = pages.packed_parts(parts.items())
    assert len(text) < 1.25 * len(noise) + 900
    assert [how for *_, how in index] == [2, 0, 1, 0, 0, 0, 1, 2]
    script = f"""{text_of("packed.js")}
globalThis.document = {{ getElementById: () => ({{ textContent: {json.dumps(text)} }}) }};
const lens = {{ stream: ["a", {sum(index[-1][1:3])}], parts: {json.dumps(index)} }};
const found = lens.parts.map(([name]) => partOf(lens, name));
console.log(JSON.stringify(found.map((part) => Buffer.from(part).toString("base64"))));"""
    done = subprocess.run([str(NODE), "-e", script], check=True, capture_output=True)
    found = [base64.b64decode(part) for part in json.loads(done.stdout)]
    assert found == [part if isinstance(part, bytes) else part.encode() for part in parts.values()]


def test_a_page_that_grows_too_large_leaves_files_out(tmp_path: Path) -> None:
    """The last kind first, and of that the exact lens's."""
    exact = tiny_lens().forms[0]
    model = replace(exact, kind="network", files={"c": exact.files["c"][::-1]})
    lens, out = replace(tiny_lens(), forms=[model, exact]), tmp_path / "small.html"
    sizes, most = [], pages.MOST_BYTES
    for left in ([], ["c of exact lenses"], ["c"]):
        about = pages.write_page(out, [lens], ["glsl", "c"], most)
        assert (about.left_out, about.bytes) == (left, out.stat().st_size)
        forms = data_of(out.read_text(encoding="utf-8"))["lenses"][0]["forms"]
        assert ["c" in form["files"] for form in forms] == [left != ["c"], not left]
        sizes.append(most := about.bytes - 1)
    assert sizes == sorted(sizes, reverse=True)
    with pytest.raises(InputError, match="fewer lenses"):
        pages.write_page(tmp_path / "none.html", [lens], ["glsl"], 1000)
    assert not (tmp_path / "none.html").exists()
    with pytest.raises(InputError, match="at least one lens"):
        pages.write_page(out, [], ["glsl"])


def tiny_lens() -> pages.ViewLens:
    signature = pages.Signature("tiny", ("film_x_mm",), (), ("x_mm",))
    card = {"film_radius_mm": 20.0}
    noise = "".join(chr(33 + n) for n in np.random.default_rng(0).integers(0, 80, 3000)).replace("\\", "x")
    form = pages.Form("exact", "traced", "const float TINY_EFL_MM = 50.0f;\n", signature, card, {"c": noise.encode()})
    return pages.ViewLens(
        "tiny", 'A "lens" </script><b>', "a & b", 50.0, 20.0, 1.0, [(50.0, 2.0)], 1.0, {}, None, [form]
    )


def test_names_are_text_and_never_markup(tmp_path: Path) -> None:
    out = tmp_path / "view.html"
    pages.write_page(out, [tiny_lens(), replace(tiny_lens(), key="</script><i>")], ["glsl"])
    elements = Elements()
    elements.feed(out.read_text(encoding="utf-8"))
    assert not {"b", "i"} & {tag for tag, _ in elements.found}


def test_a_thin_lens_sends_rays_to_the_conjugate_point() -> None:
    rng = np.random.default_rng(3)
    film, pupil = rng.uniform(-15, 15, (2, 50)), rng.uniform(-8, 8, (2, 50))
    focal, distance = 50.0, 52.0
    call = {"film_z_mm": 80.0, "stop_radius_mm": 9.0, "distance_mm": distance, "per_depth": 1 / focal - 1 / distance}
    given = {"film_mm": film, "pupil_mm": pupil} | {k: np.array([[v]]) for k, v in call.items()}
    found = evaluate(pages._thin_lens(), given)
    x, y, z, dx, dy, dz = found["scene_ray"]
    away = 1 / (1 / focal - 1 / distance)  # in front of the lens, at z = 28
    at = np.stack([x, y]) + np.stack([dx, dy]) * ((28.0 - away) - z) / dz
    assert np.allclose(at, -film * away / distance, atol=1e-6)
    assert (found["status"][0] == np.where(np.hypot(*pupil) <= 9, 0, 6)).all()


def test_crossings_are_those_of_the_tracer() -> None:
    lens = set_lens(read_lens(ROOT / "lenses" / "cooke_triplet_50.toml"))
    plane, film_z = 20.0, float(lens.film_z_mm if lens.film_z_mm is not None else lens.vertices_mm[-1])
    y, v = np.linspace(-9, 9, 7), np.linspace(2, -2, 7)
    zero = np.zeros_like(y)
    rays = np.stack([zero, y, zero, v, zero + 550.0])
    graph: Graph = exact_graph(lens, plane, (400.0, 700.0), path=True)
    call = {"film_z_mm": np.array([[film_z]]), "stop_radius_mm": np.array([[float(lens.stop_radius_mm)]])}
    found = evaluate(graph, {"rays": rays, **call})["path"]
    way = np.stack([zero, v - y, zero + plane - film_z])
    way /= np.linalg.norm(way, axis=0)
    start = Rays(*(torch.tensor(a) for a in (zero, y, zero + film_z, *way)))
    path = trace(lens, start, towards="scene", wavelength_nm=550.0, path=True).path
    wanted = np.stack([c.numpy() for p in path for c in (p.z, p.y)])
    assert np.allclose(found, wanted[: len(found)], atol=2e-4)


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["no_such_lens"], "no_such_lens"),
        (["lenses/missing.toml"], "missing.toml"),
        ([LENS, "-o", "view.txt"], "--out"),
        ([LENS, "-o", "nowhere/view.html"], "nowhere"),
        ([LENS, "--downloads", "pdf"], "glsl"),
        ([f"models/{LENS}.ols-64.onnx", f"models/{LENS}.ols-64.onnx"], "one model of each kind"),
    ],
)
def test_bad_input_is_one_line_and_no_page(
    words: list[str], said: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "models").symlink_to(ROOT / "models")
    try:
        code = main(["view", *words])
    except SystemExit as error:
        code = int(str(error.code))
    assert code == 2
    error = capsys.readouterr().err.strip().splitlines()[-1]
    assert said in error
    assert not list(tmp_path.glob("*.html"))


def test_a_paraboloid_has_a_path() -> None:
    """The cosine of its slope holds no distance until the asphere's terms come: a constant, which no graph carries."""
    figure = Figure(conic=-1.0, asphere=((4, 1e-7),))
    rows = (Surface(30.0, 5.0, 16.0, 1.5, 60.0, figure=figure, stop=True), Surface(-200.0, 55.0, 16.0))
    lens = set_lens(Lens("paraboloid", "", rows, 4.0, half_field_deg=5.0))
    text, outputs = pages.path_glsl(lens, pupil_plane_z_mm(lens), LIGHT_NM)
    assert "lens_path" in text and len(outputs) > 4
