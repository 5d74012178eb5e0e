"""The page as one file: its template, style, scripts and shaders, and the lenses as packed data.

Texts and files of lenses are one stream of printable characters, which `page/packed.js` unpacks: a fifth of gzip's. C,
GLSL and OSL of lenses say much the same with temporaries of other numbers. Counted from the line's own number most
lines of one are lines of the others; LZMA, unlike gzip, looks back far enough to find them.
"""

from __future__ import annotations

import json
import lzma
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from neurolens import __version__
from neurolens.analysis.layout import Layout, element_outline
from neurolens.base.errors import InputError
from neurolens.base.files import atomic_write_text
from neurolens.base.html import html, text_of
from neurolens.graph.c import Signature
from neurolens.graph.shading import TEMPORARY, urgent
from neurolens.view.shaders import Ghosts, call_of, shared_glsl

SCRIPTS = ("packed.js", "gl.js", "wgsl.js", "webgpu.js", "scene.js", "engine.js", "ghosts.js", "layout.js", "main.js")
SHADERS = ("random.glsl", "scene.glsl", "rays.glsl")
# A form's download that would carry the page beyond this, or beyond so much for each lens, is left out.
MOST_BYTES, MOST_A_LENS = 3_000_000, 40_000
_TOGETHER = 6  # lenses of a stream: each says less for those before, and takes longer to unpack
_AIR, _ARC = 1.01, 4  # a medium of a smaller index is drawn as air; of 65 points of an arc every fourth is drawn
_CONSTANT = re.compile(r"^const float ([A-Z][A-Z0-9_]*_(?:MM|NM)) = ", re.MULTILINE)
_FUNCTION = re.compile(r"^float ([a-z]\w*)\(([^)]*)\)$", re.MULTILINE)
# Of 91 characters two hold 13 bits; none ends an element of HTML, begins an entity or an escape.
CHARACTERS = "".join(chr(code) for code in range(33, 127) if chr(code) not in "&<\\")
FILTERS = [
    {"id": lzma.FILTER_LZMA1, "preset": 9 | lzma.PRESET_EXTREME, "dict_size": 1 << 22, "lc": 3, "lp": 0, "pb": 0}
]
_STEPS = re.compile(r"(?:^    float t\d+ = .*\n)+", re.M)
_UNTOLD = re.compile(r"\x01|\bt\d+-")  # what `_counted` could not give back
_GIVEN = {"zoom_mm": "zoom", "focus_m": "focus", "stop_radius_mm": "stop_radius"}


@dataclass(frozen=True)
class Form:
    """A lens as one of its models, or traced.

    Attributes:
        kind: "exact", "polynomial" or "network". method: of the model, as "ols-64".
        glsl: the text of `neurolens export --to glsl`. signature: of its function.
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
        """The call of the function for a shader, and an expression for each number of the lens."""
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
        squeeze: of an anamorphic picture across. f_numbers: (focal length in mm, f-number of the widest stop) by zoom.
        nearest_m: the nearest focus. section: from `section_svg`. path: from `shaders.path_glsl`. ghosts: of a lamp.
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
    ghosts: Ghosts | None = None


def write_page(
    out: Path, lenses: Sequence[ViewLens], kinds: Sequence[str], most_bytes: int | None = None
) -> dict[str, Any]:
    """Write the page with these `kinds` of downloads, "glsl" first.

    Where they do not fit, the last kinds are left out, in each kind first the files of exact lenses.

    Returns the size of the page, and which downloads it has and which are left out.

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
                return {
                    "bytes": len(text.encode()), "downloads": list(kinds[:count]), "left_out": [*of_exact, *left]
                }  # fmt: skip
    raise InputError(out, "bytes", len(text.encode()), f"at most {most_bytes}: fewer lenses")


def _without_exact(lenses: Sequence[ViewLens], kind: str) -> list[ViewLens]:
    """The lenses without such a file of their exact forms."""

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
    # Packed texts are of `CHARACTERS`, which end no element.
    elements.insert(0, {"key": "data", "text": packed(data), "bytes": len(data)})
    title = lenses[0].name if len(lenses) == 1 else "neurolens: lenses and their models"
    return html("view.html", title=title, streams=elements, scripts=SCRIPTS)


def _facts(lens: ViewLens, kinds: Sequence[str]) -> dict[str, Any]:
    """What the controls and the first picture of a lens need, which the page unpacks when the lens is chosen."""
    found = {k: v for k, v in asdict(lens).items() if k not in ("forms", "path", "section", "ghosts")}
    forms = []
    for f in lens.forms:
        files = [kind for kind in kinds if kind == "glsl" or kind in f.files]
        forms.append({"kind": f.kind, "method": f.method, **f.program(), "card": f.card, "files": files})
    ghosts = None if lens.ghosts is None else asdict(replace(lens.ghosts, functions=()))
    return found | {"forms": forms, "paths": lens.path is not None, "ghosts": ghosts}


def _parts(lenses: Sequence[ViewLens], kinds: Sequence[str]) -> Iterator[tuple[str, str | bytes]]:
    """Yield texts and files of lenses, first those that a picture needs: the page unpacks no further than it must."""
    for lens in lenses:
        yield f"{lens.key}/facts", json.dumps(_facts(lens, kinds), allow_nan=False).encode()
    for lens in lenses:
        text, outputs = lens.path or ("", ())
        yield f"{lens.key}/lens", json.dumps({"section": lens.section, "outputs": list(outputs)}).encode()
        for form in lens.forms:
            yield f"{lens.key}/{form.kind}/glsl", form.glsl
        yield f"{lens.key}/path", text
        if lens.ghosts is not None:
            yield f"{lens.key}/ghosts", json.dumps([asdict(ghost) for ghost in lens.ghosts.functions]).encode()
    for kind, lens in product(kinds, lenses):
        for form in lens.forms:
            if kind in form.files:
                data = form.files[kind]
                yield f"{lens.key}/{form.kind}/{kind}", data if kind == "onnx" else data.decode()


def section_svg(layout: Layout) -> dict[str, Any]:
    """The section of a lens (glass, rims, stop, film) as paths of SVG in mm, z to the right and heights upwards."""
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
    """A closed path, with every fourth point of an outline's arcs."""
    kept = np.concatenate([points[:65:_ARC], points[65:-65], points[-65::_ARC]])
    return "M" + "L".join(f"{z:.2f} {h:.2f}" for z, h in kept) + "Z"


def packed(data: bytes) -> str:
    """Bytes as LZMA (raw, lc 3, lp 0, pb 0) in `CHARACTERS`, 13 bits a pair, high bits and characters first."""
    bits = np.unpackbits(np.frombuffer(lzma.compress(data, lzma.FORMAT_RAW, filters=FILTERS), np.uint8))
    values = np.pad(bits, (0, -bits.size % 13)).reshape(-1, 13) @ (1 << np.arange(12, -1, -1))
    return np.array(list(CHARACTERS))[np.stack(np.divmod(values, len(CHARACTERS)), 1)].tobytes().decode("utf-32-le")


def packed_parts(parts: Iterable[tuple[str, str | bytes]]) -> tuple[str, list[tuple[str, int, int, int]]]:
    """The stream of named parts, and for each its name, place, bytes, and form: 0 as it is, 1 with temporaries counted,
    2 with steps in the order of their numbers, too, which `urgent` had moved."""
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
    """A text with each line's first temporary counted from that of the line before (1 is left out), others back from
    the first."""
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
