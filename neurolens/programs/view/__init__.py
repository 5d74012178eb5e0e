"""A static page that runs lenses and their models: GLSL of their graphs in a path tracer for WebGPU or WebGL2.

It is one file: its template, style, scripts and shaders, and the lenses as packed data. Texts and files of lenses are
one stream of printable characters, which `page/packed.js` unpacks: a fifth of the size that gzip gives. C, GLSL and OSL
of lenses say much the same, but number their temporaries differently. When temporaries are counted from the line's own
number, most lines of one text are lines of the others, and LZMA, unlike gzip, looks back far enough to find them.

Functions of the page's shaders are written from graphs, too: the weights of rays, the blades, a thin lens, the
crossings of rays with the surfaces of a lens, and ghosts.
"""

import json
import lzma
import math
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from neurolens import __version__
from neurolens.base.errors import InputError
from neurolens.base.files import atomic_write_text
from neurolens.base.html import html, text_of
from neurolens.base.settings import LIGHT_NM
from neurolens.cameras.cameragraph import weight_graph
from neurolens.cameras.shaders.pupil import Blades
from neurolens.graph.c import Signature
from neurolens.graph.ir import Graph
from neurolens.graph.program import FILM_Z, STOP_RADIUS, WAVELENGTH, Program
from neurolens.graph.scalars import lower
from neurolens.graph.shading import TEMPORARY, urgent, write_glsl
from neurolens.optics.analysis.layout import Layout, element_outline
from neurolens.optics.lens.prescription import Lens
from neurolens.optics.trace.tracegraph import exact_graph
from neurolens.pictures.flare.ghosts import GhostTracer, entrances, ghost_graphs

SCRIPTS = ("packed.js", "gl.js", "wgsl.js", "webgpu.js", "scene.js", "engine.js", "ghosts.js", "layout.js", "main.js")
SHADERS = ("random.glsl", "scene.glsl", "rays.glsl")
# A download that would make the page larger than this, or larger than so much for each lens, is left out.
MOST_BYTES, MOST_A_LENS = 3_000_000, 40_000
_TOGETHER = 6  # lenses in a stream: with more of them each lens packs better, and takes longer to unpack
_AIR, _ARC = 1.01, 4  # a medium of a smaller index is drawn as air; of 65 points of an arc every fourth is drawn
_CONSTANT = re.compile(r"^const float ([A-Z][A-Z0-9_]*_(?:MM|NM)) = ", re.MULTILINE)
_FUNCTION = re.compile(r"^float ([a-z]\w*)\(([^)]*)\)$", re.MULTILINE)
# Two of 91 characters hold 13 bits; none of them ends an element of HTML or begins an entity or an escape.
CHARACTERS = "".join(chr(code) for code in range(33, 127) if chr(code) not in "&<\\")
FILTERS = [
    {"id": lzma.FILTER_LZMA1, "preset": 9 | lzma.PRESET_EXTREME, "dict_size": 1 << 22, "lc": 3, "lp": 0, "pb": 0}
]
_STEPS = re.compile(r"(?:^    float t\d+ = .*\n)+", re.M)
_UNTOLD = re.compile(r"\x01|\bt\d+-")  # what `_counted` could not give back
_GIVEN = {"zoom_mm": "zoom", "focus_m": "focus", "stop_radius_mm": "stop_radius"}
# What inputs and outputs of functions are called in the page's shaders.
_PLACES = {
    "film_x_mm": "film.x", "film_y_mm": "film.y", "pupil_x_mm": "pupil.x", "pupil_y_mm": "pupil.y",
    WAVELENGTH: "nm", FILM_Z: "film_z", STOP_RADIUS: "stop_radius", "x_mm": "p.x", "y_mm": "p.y", "z_mm": "p.z",
    "dx": "d.x", "dy": "d.y", "dz": "d.z", "transmittance": "through", "stop_x_mm": "at.x", "stop_y_mm": "at.y",
    **{name: name for name in ("distance_mm", "per_depth", "per_distance", "scale", "roundness", "weight", "inside")},
    **{name: name for name in ("half_cos", "half_sin", "edge_cos", "edge_sin")}, "count": "blades",
    "area_mm2": "area", "lens_status": "float(status)",
    **{f"seen_{k}": f"{'origin' if k < 3 else 'to'}.{'xyz'[k % 3]}" for k in range(6)},
}  # fmt: skip
_ENTERING = {"dx": "d.x", "dy": "d.y", "x_mm": "at.x", "y_mm": "at.y", WAVELENGTH: "nm", STOP_RADIUS: "stop_radius"}
_ARRIVING = ("arriving.x", "arriving.y", "arriving.z", "arriving.w")  # in the order of `program.ARRIVING`
_SINE = math.sin(math.radians(35.0))  # of the largest angle between the axis and a lamp whose ghosts are shown
_COMMENT = re.compile(r"/\*.*?\*/\s*", re.DOTALL)


@dataclass(frozen=True)
class Form:
    """A lens as one of its models, or as traced exactly.

    Attributes:
        kind: "exact", "polynomial" or "network". method: the model's, such as "ols-64".
        glsl: the text that `neurolens export --to glsl` writes. signature: of its function.
        card: the facts that the page shows: numbers of the domain and errors.
        files: other downloads, contents by kind ("c", "onnx", "osl").
    """

    kind: str
    method: str
    glsl: str
    signature: Signature
    card: Mapping[str, Any]
    files: Mapping[str, bytes] = field(default_factory=dict)

    def program(self) -> dict[str, Any]:
        """Return the call of the function in a shader, and an expression for each number of the lens."""
        own = self.signature.name
        values = {name.removeprefix(f"{own.upper()}_").lower(): name for name in _CONSTANT.findall(self.glsl)}
        for name, arguments in _FUNCTION.findall(self.glsl):
            given = [_GIVEN[a.split()[-1]] for a in arguments.split(",")]
            values[name.removeprefix(f"{own}_")] = f"{name}({', '.join(given)})"
        return {"name": own, "call": call_of(self.signature), "values": values, "state": list(self.signature.state)}


@dataclass(frozen=True)
class ViewLens:
    """A lens of the menu, named by `key`.

    Attributes:
        squeeze: by which an anamorphic lens compresses the picture across. f_numbers: (focal length in mm, f-number of
            the widest stop) by zoom.
        nearest_m: the nearest focus. section, path, ghosts (of a lamp): from `section_svg`, `path_glsl`, `ghosts_glsl`.
    """

    key: str
    name: str
    source: str
    efl_mm: float
    film_radius_mm: float
    squeeze: float
    f_numbers: Sequence[tuple[float, float]]
    nearest_m: float
    section: Mapping[str, Any]
    path: tuple[str, Sequence[str]] | None
    forms: Sequence[Form]
    ghosts: tuple[Mapping[str, Any], Sequence[Mapping[str, Any]]] | None = None


@dataclass(frozen=True)
class Page:
    """The size of a page, the downloads that it has, and those that were left out for its size."""

    bytes: int
    downloads: Sequence[str]
    left_out: Sequence[str]


def write_page(out: Path, lenses: Sequence[ViewLens], kinds: Sequence[str], most_bytes: int | None = None) -> Page:
    """Write the page with these `kinds` of downloads, "glsl" first.

    Where they do not fit, the last kinds are left out; in each kind files of exact lenses go first.

    Raises:
        InputError: there is no lens, or the lenses do not fit without any download.
    """
    if not lenses:
        raise InputError(out, "lenses", "(none)", "at least one lens")
    most_bytes = most_bytes or max(MOST_BYTES, MOST_A_LENS * len(lenses))
    for count in range(len(kinds), 0, -1):
        last, left = kinds[count - 1], list(kinds[count:])
        for given, of_exact in ((lenses, []), (_without_exact(lenses, last), [f"{last} of exact lenses"])):
            text = _page(given, kinds[:count])
            if len(text.encode()) <= most_bytes:
                atomic_write_text(out, text)
                return Page(len(text.encode()), kinds[:count], [*of_exact, *left])
    raise InputError(out, "bytes", len(text.encode()), f"at most {most_bytes}: fewer lenses")


def _without_exact(lenses: Sequence[ViewLens], kind: str) -> list[ViewLens]:
    """Return the lenses without the files of this kind that their exact forms have."""

    def forms(lens: ViewLens) -> list[Form]:
        files = [{k: v for k, v in f.files.items() if f.kind != "exact" or k != kind} for f in lens.forms]
        return [replace(f, files=own) for f, own in zip(lens.forms, files, strict=True)]

    return [replace(lens, forms=forms(lens)) for lens in lenses]


def _page(lenses: Sequence[ViewLens], kinds: Sequence[str]) -> str:
    elements, entries = list[dict[str, Any]](), []
    for first in range(0, len(lenses), _TOGETHER):
        group, key = lenses[first : first + _TOGETHER], f"lenses-{first}"
        text, index = packed_parts(_parts(group, kinds))
        elements.append({"key": key, "text": text, "bytes": 0})
        stream = key, index[-1][1] + index[-1][2]
        for lens in group:
            own = f"{lens.key}/"
            places = [(name.removeprefix(own), *place) for name, *place in index if name.startswith(own)]
            entries.append({"key": lens.key, "name": lens.name, "stream": stream, "parts": places})
    shared = {
        "version": __version__,
        "functions": {name: {"text": text, "call": call} for name, (text, call) in shared_glsl().items()},
        "shaders": {name.removesuffix(".glsl"): text_of(name) for name in SHADERS},
        "lenses": entries,
    }
    data = json.dumps(shared, allow_nan=False, separators=(",", ":")).encode()
    # Packed texts consist of `CHARACTERS`, which end no element.
    elements.insert(0, {"key": "data", "text": packed(data), "bytes": len(data)})
    title = lenses[0].name if len(lenses) == 1 else "neurolens: lenses and their models"
    return html("view.html", title=title, streams=elements, scripts=SCRIPTS)


def _facts(lens: ViewLens, kinds: Sequence[str]) -> dict[str, Any]:
    """Return what the controls and the first picture of a lens need; the page unpacks it when the lens is chosen."""
    found = {k: v for k, v in asdict(lens).items() if k not in ("forms", "path", "section", "ghosts")}
    forms = []
    for f in lens.forms:
        files = [kind for kind in kinds if kind == "glsl" or kind in f.files]
        forms.append({"kind": f.kind, "method": f.method, **f.program(), "card": f.card, "files": files})
    return found | {"forms": forms, "paths": lens.path is not None, "ghosts": lens.ghosts and lens.ghosts[0]}


def _parts(lenses: Sequence[ViewLens], kinds: Sequence[str]) -> Iterator[tuple[str, str | bytes]]:
    """Yield texts and files of lenses, those that a picture needs first: the page unpacks no further than it must."""
    for lens in lenses:
        yield f"{lens.key}/facts", json.dumps(_facts(lens, kinds), allow_nan=False).encode()
    for lens in lenses:
        text, outputs = lens.path or ("", ())
        yield f"{lens.key}/lens", json.dumps({"section": lens.section, "outputs": list(outputs)}).encode()
        for form in lens.forms:
            yield f"{lens.key}/{form.kind}/glsl", form.glsl
        yield f"{lens.key}/path", text
        if lens.ghosts is not None:
            yield f"{lens.key}/ghosts", json.dumps(lens.ghosts[1]).encode()
    for kind, lens in product(kinds, lenses):
        for form in lens.forms:
            if kind in form.files:
                data = form.files[kind]
                yield f"{lens.key}/{form.kind}/{kind}", data if kind == "onnx" else data.decode()


def section_svg(layout: Layout) -> dict[str, Any]:
    """Return the section of a lens (glass, rims, stop, film) as SVG paths in mm, z to the right and heights upwards."""
    glass = [
        {"path": _path(element_outline(front, back)), "n": round(front.n_after, 3)}
        for front, back in zip(layout.surfaces, layout.surfaces[1:], strict=False)
        if front.n_after >= _AIR
    ]
    high = max(s.semi_diameter_mm for s in layout.surfaces)
    rims, stop = "", ""
    for s in layout.surfaces:
        h, z = s.semi_diameter_mm, s.arc()[-1, 0]
        reach = max(h * 1.15, h + 0.16 * high) if s.stop else h + 0.035 * high
        ticks = "".join(f"M{z:.2f} {sign * h:.2f}V{sign * reach:.2f}" for sign in (-1, 1))
        rims, stop = (rims, stop + ticks) if s.stop else (rims + ticks, stop)
    film, half = layout.film_z_mm, layout.film_half_height_mm
    arcs = np.concatenate([s.arc()[:, 0] for s in layout.surfaces])
    z = float(arcs.min()) - 0.55 * high, max(film, float(arcs.max())) + 0.05 * high
    top = max(high * 1.2, 1.06 * half)
    return {
        "glass": glass, "rims": rims, "stop": stop, "film": f"M{film:.2f} {-half:.2f}V{half:.2f}",
        "box": [round(v, 2) for v in (z[0], -top, z[1] - z[0], 2 * top)],
    }  # fmt: skip


def _path(points: np.ndarray[Any, Any]) -> str:
    """Write a closed path, with every fourth point of an outline's arcs."""
    kept = np.concatenate([points[:65:_ARC], points[65:-65], points[-65::_ARC]])
    return "M" + "L".join(f"{z:.2f} {h:.2f}" for z, h in kept) + "Z"


def packed(data: bytes) -> str:
    """Write bytes as LZMA (raw, lc 3, lp 0, pb 0) in `CHARACTERS`, 13 bits a pair, high bits and characters first."""
    bits = np.unpackbits(np.frombuffer(lzma.compress(data, lzma.FORMAT_RAW, filters=FILTERS), np.uint8))
    values = np.pad(bits, (0, -bits.size % 13)).reshape(-1, 13) @ (1 << np.arange(12, -1, -1))
    return np.array(list(CHARACTERS))[np.stack(np.divmod(values, len(CHARACTERS)), 1)].tobytes().decode("utf-32-le")


def packed_parts(parts: Iterable[tuple[str, str | bytes]]) -> tuple[str, list[tuple[str, int, int, int]]]:
    """Pack named parts into a stream; also return the name, place, bytes and form of each.

    The form is 0 for a part as it is, 1 with temporaries counted, 2 with steps in the order of their numbers, too,
    which `urgent` had moved.
    """
    data, index = b"", []
    for name, part in parts:
        how = int(isinstance(part, str) and not _UNTOLD.search(part))
        if isinstance(part, str):
            in_turn = _STEPS.sub(lambda steps: "".join(sorted(steps[0].splitlines(True), key=_own)), part)
            if how and in_turn != part == _STEPS.sub(lambda steps: "".join(urgent(steps[0].splitlines(True))), in_turn):
                how, part = 2, in_turn
            part = (_counted(part) if how else part).encode()
        index.append((name, len(data), len(part), how))
        data += part
    return packed(data), index


def _own(line: str) -> int:
    return int(TEMPORARY.findall(line)[0])


def _counted(text: str) -> str:
    """Write a text so that the first temporary of each line counts from that of the line before (1 is left out).

    Other temporaries count back from the first.
    """
    before, lines = 0, []
    for line in text.split("\n"):
        numbers = [int(n) for n in TEMPORARY.findall(line)]
        if numbers:
            steps = [numbers[0] - before, *(numbers[0] - n for n in numbers[1:])]
            between, before = TEMPORARY.split(line)[::2], numbers[0]
            line = between[0] + "".join(
                f"\x01{'' if step == 1 else step}{text}" for step, text in zip(steps, between[1:], strict=True)
            )
        lines.append(line)
    return "\n".join(lines)


def call_of(signature: Signature) -> str:
    """Return the call of a lens's function with arguments as the page's shaders name them; a state is a uniform."""
    given = [_PLACES[name] for name in signature.inputs]
    found = [*(_PLACES[o] for o in signature.outputs), *["status"] * signature.status]
    return f"{signature.name}({', '.join([*given, *found])})"


def shared_glsl() -> dict[str, tuple[str, str]]:
    """Return functions that all lenses share, and their calls, by name.

    `weigh` gives the ray in the camera's frame and its weight, `opened` tells whether it passes the blades, and `thin`
    is a thin lens.
    """
    graphs = {"weigh": _weight_in_frame(), "opened": _blades_opened(), "thin": _thin_lens()}
    programs = {name: lower(graph) for name, graph in graphs.items()}
    return {name: (_text(p, name), call_of(Signature.of(p, name))) for name, p in programs.items()}


def _blades_opened() -> Graph:
    """Write a graph that is 1 where a crossing with the stop lies between the blades, else 0."""
    g = Graph()
    g.outputs["inside"] = Blades(g).opened(g.input("stop_xy_mm", 2) * (1.0 / g.input(STOP_RADIUS, per_call=True)))
    return g


def _weight_in_frame() -> Graph:
    """Write `cameragraph.weight_graph` with names of its own for outputs."""
    g = Graph()
    inputs = {"film_mm": 2, "pupil_mm": 2, "area_mm2": 1, "scene_ray": 6, "transmittance": 1, "lens_status": 1}
    given = {name: g.input(name, rows) for name, rows in inputs.items()}
    given |= {name: g.input(name, per_call=True) for name in ("per_distance", "scale", FILM_Z)}
    found = g.inline(weight_graph(), given)
    g.outputs["seen"] = found["ray"]  # another name than that of the lens's ray, which is an input
    g.outputs["weight"] = found["weight"]
    return g


def _thin_lens() -> Graph:
    """Write a thin lens with the contract of models.

    Pupil points are on the lens, `distance_mm` before the film. It also takes `per_depth`, 1 / f - 1 / distance (per
    mm): the ray goes on towards the point conjugate to the film point.
    """
    g = Graph()
    film, pupil = g.input("film_mm", 2), g.input("pupil_mm", 2)
    film_z, stop, distance, per_depth = (
        g.input(name, per_call=True) for name in (FILM_Z, STOP_RADIUS, "distance_mm", "per_depth")
    )
    way = g.concat(film * (-1.0 / distance) - pupil * per_depth, g.constant(-1.0))
    g.outputs["scene_ray"] = g.concat(pupil, film_z - distance, way * (1.0 / g.square(way).sqrt()))
    g.outputs["transmittance"] = g.constant(1.0)
    g.outputs["stop_xy_mm"] = pupil
    g.outputs["status"] = g.first_failure([(g.square(pupil), stop * stop)], [6]).whole()
    return g


def path_glsl(lens: Lens, pupil_z_mm: float, light_nm: tuple[float, float]) -> tuple[str, list[str]]:
    """Write `lens_path` for meridional rays (film and pupil points on the y axis); also return its outputs' names.

    These are z and y (mm) at each surface from the film on, the direction in front of the lens, and the status.
    """
    g = Graph()
    zero = g.constant(0.0)
    rays = g.concat(zero, g.input("film_y_mm"), zero, g.input("pupil_y_mm"), g.input(WAVELENGTH))
    found = g.inline(exact_graph(lens, pupil_z_mm, light_nm, path=True), {"rays": rays})
    g.outputs = {"path": found["path"], "dy": found["scene_ray"][4], "dz": found["scene_ray"][5]}
    g.outputs["status"] = found["status"]
    program = lower(g)
    return _text(program, "lens_path"), list(Signature.of(program, "lens_path").outputs)


def ghosts_glsl(lens: Lens, film_radius_mm: float, most: int) -> tuple[dict[str, Any], list[dict[str, Any]]]:
    """Write the brightest ghosts on the film of a lens, which must be placed; at most `most`.

    Returns facts of all of them, for p = direction / sine and stops up to `stop_radius_mm`; `light` is their share of
    the light of all ghosts. Then for each, brightest first, it returns its function, whose rays cross the plane z = 0
    at (x, y) = chief_mm p + scale_mm u.

    Raises:
        InputError: as `GhostTracer` and `ghost_graphs`.
    """
    every = entrances(GhostTracer(lens), _SINE, film_radius_mm, 0.5 * sum(LIGHT_NM))
    some, functions = every[:most], []
    for ghost, graph in zip(some, ghost_graphs(lens, [g.pair for g in some], LIGHT_NM), strict=True):
        name, program = f"ghost_{ghost.pair.name.replace('-', '_')}", lower(graph)
        given = [_ENTERING[i] for i in Signature.of(program, name).inputs]
        call = f"{name}({', '.join([*given, *_ARRIVING])})"
        places = {"chief_mm": ghost.chief_mm.tolist(), "scale_mm": ghost.scale_mm.tolist()}
        functions.append({"name": ghost.pair.name, "text": _text(program, name), "call": call, **places})
    light = sum(g.light for g in some) / max(sum(g.light for g in every), 1e-300)
    facts = {"sine": _SINE, "wavelength_nm": LIGHT_NM, "stop_radius_mm": float(lens.stop_radius_mm), "light": light}
    return facts, functions


def _text(program: Program, name: str) -> str:
    return _COMMENT.sub("", write_glsl(program, name, []))
