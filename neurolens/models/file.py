"""The coefficients of a model file: compact JSON in an ONNX file's metadata, from which the model is built again.

An exported file is a complete ONNX model that any program runs. This package reads the card and the coefficients alone,
checks them, and builds the graph again, which onnxruntime, C, GLSL and numpy then run; it does so without torch.
Coefficients are float32; floats of the prescription and of the encoding are float64, exactly.
"""

import base64
import binascii
import json
import math
import zlib
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import MISSING, asdict, dataclass, fields, replace
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from neurolens.base import status as st
from neurolens.base.errors import InputError, ModelError
from neurolens.base.tomlfile import check_tree
from neurolens.graph.derive import derivative, with_derivatives
from neurolens.graph.interpret import evaluate
from neurolens.graph.onnx import Mixing, write_onnx
from neurolens.graph.program import RAY
from neurolens.models.assemble import ONNX, model_graph
from neurolens.models.axes import Axis, state_graph, weights
from neurolens.models.card import (
    MODEL_KEY,
    axes_of,
    card_in,
    check_card,
    default_state,
    read_metadata,
)  # fmt: skip
from neurolens.models.copied import copy_inputs, copy_nodes
from neurolens.models.cores import CORES, Core
from neurolens.models.fitted import Domain, Encoding, Gate, Scales
from neurolens.models.model import LensModel, mixed, with_one_angle
from neurolens.optics.lens.figures import figure_of
from neurolens.optics.lens.prescription import Coating, Lens, Surface

SCHEMA = 2
_MAX_TEXT = 16 * 2**20  # of the JSON; the largest models known take 100 kB
_MAX_DEPTH = 16  # of cores in cores
_MAX_CORES = 1000  # of one file
_MAX_ROWS = 20_000  # of any array: terms, or units of a layer
_MAX_DEGREE = 64  # of any term; settings allow half, and growth without limit stays far below
_MAX_RAYS = 1000  # of the card's reference; `export.reference_rays` gives 4 a status
_MAX_NODES = 256  # states of one model
# Limits of a model: terms and units, each of which is a row for every ray; numbers; and products of two terms that are
# terms, all of which a writer compares. The largest models that settings allow have 5,000, 1.9 and one million.
_MAX_WORK, _MAX_WEIGHTS, _MAX_PRODUCTS = 10_000, 2_000_000, 3_000_000
_MAX_SURFACES, _MAX_TERMS, _MAX_POWER = 500, 1000, 42  # of a prescription, as `optics.readers.lensfile` has them
_LENS = ("name", "source", "f_number", "image_radius_mm", "half_field_deg", "designer", "rims", "film_z_mm", "path")
_MOST = ("most_tilt_deg", "most_shift_mm")  # of a prescription, where the lens file states them
_NOWHERE = -1.0  # a film position in no domain, which replaces that of the call where the state is out of range
DERIVATIVES = {"film": RAY[:2], "pupil": RAY[2:]}
_DAMAGE = (ValueError, TypeError, KeyError, IndexError, ArithmeticError, AttributeError, AssertionError, RuntimeError)
# Every reference ray may err by this; in position and stop crossing by this for each mm of the focal length.
_OFF = 1e-5
_OFF_UM = 5e-3  # of an optical path: a hundredth of a wave


@dataclass(frozen=True)
class ModelFile:
    """A model that was read from its file.

    Attributes:
        path: the file.
        card: its card, as `models.export` writes it.
        nodes: a model for every node of the axes, in the order of `models.axes.product`, or one model without axes.
            Their coefficients are rounded to float32, and their lens is that of the first node.
    """

    path: Path
    card: dict[str, Any]
    nodes: tuple[LensModel, ...]

    @property
    def axes(self) -> tuple[Axis, ...]:
        """Return the state variables; none for a model of one state."""
        return axes_of(self.card)

    def at(self, state: Sequence[float] = ()) -> LensModel:
        """Return the model of one state. Raises InputError: too many values or too few, or one out of range."""
        return mixed(self.nodes, weights(self.axes, state)) if self.axes else self.nodes[0]


def read_model(path: str | Path) -> ModelFile:
    """Return the model of an exported file.

    Raises:
        ModelError: a file that is missing, too large, no exported model, or damaged; one without coefficients; one
            whose coefficients do not give the card's reference rays.
    """
    file = Path(path)
    metadata = read_metadata(file)
    card = card_in(file, metadata)
    check_card(file, card)
    again = "export it again (`neurolens train` fits the model and writes its file with them)"
    if MODEL_KEY not in metadata:
        raise ModelError(f"{file}: it holds no coefficients, from which its graph would be built: {again}")
    with np.errstate(all="ignore"), damage_said(file):
        data = json.loads(inflated(metadata[MODEL_KEY]))
        check_tree(data, "coefficients")
        if data["schema"] != SCHEMA:
            raise ModelError(f"{file}: coefficients: schema: got {data['schema']!r}, expected {SCHEMA}: {again}")
        model = ModelFile(file, card, _nodes(file, card, data))
        _check_reference(model)
    return model


@contextmanager
def damage_said(file: str | Path, what: str = "its coefficients are damaged") -> Iterator[None]:
    """Turn errors of reading damaged data into a ModelError."""
    try:
        yield
    except ModelError:
        raise
    except _DAMAGE as error:
        raise ModelError(f"{file}: {what} ({type(error).__name__}: {error})") from error


def _nodes(file: Path, card: Mapping[str, Any], data: Mapping[str, Any]) -> tuple[LensModel, ...]:
    states = card.get("states")
    domains = [node["domain"] for node in states["nodes"]] if states else [card["domain"]]
    parts = data["nodes"]
    if len(parts) != len(domains) or len(parts) > _MAX_NODES:
        raise ValueError(f"{len(parts)} nodes, expected {len(domains)}, at most {_MAX_NODES}")
    lens = unpacked_lens(data["lens"])
    if not states and lens.sha256 != card["lens"]["sha256"]:
        raise ModelError(f"{file}: its prescription is not that of its card")
    nodes = [
        LensModel(
            lens=lens,
            domain=Domain.from_dict(domain),
            encoding=_numbers(Encoding, part["encoding"]),
            scales=_numbers(Scales, data["scales"]),
            gates=tuple(Gate(int(surface), int(reason)) for surface, reason in data["gates"]),
            core=unpack(part["core"]),
            method=str(card["fit"]["method"]),
            settings=dict(card["fit"]["settings"]),
            fit_s=float(card["fit"]["seconds"]),
            direction="slope" if data["direction"] == "slope" else "angle",
            angle=float(data["angle"]),
        )
        for part, domain in zip(parts, domains, strict=True)
    ]
    check_size(nodes[0].core)
    if not 0 < nodes[0].angle <= math.pi:
        raise ValueError(f"angle: got {nodes[0].angle!r}, expected above 0, up to pi")
    return tuple(nodes)


def check_size(core: Any) -> None:
    """Refuse work beyond reason before a graph is made of a core.

    Raises:
        ValueError: more terms and units, numbers or products than the limits above.
    """
    rows = weights = products = 0
    left: list[Any] = [core]
    while left:
        value = left.pop()
        if isinstance(value, np.ndarray):
            exponents = value.dtype.kind == "i"
            rows += len(value) if exponents or value.ndim == 1 else 0  # terms, or units of a layer
            products += int(np.prod(value + 1, axis=-1).sum()) if exponents else 0
            weights += value.size
        elif isinstance(value, tuple):
            left += value
        elif isinstance(value, Core):
            left += [getattr(value, f.name) for f in fields(value)]  # type: ignore[arg-type]
    if rows > _MAX_WORK or weights > _MAX_WEIGHTS or products > _MAX_PRODUCTS:
        raise ValueError(
            f"{rows} terms and units, {weights} numbers and {products} products of terms, expected at most "
            f"{_MAX_WORK}, {_MAX_WEIGHTS} and {_MAX_PRODUCTS}"
        )


def _check_reference(model: ModelFile) -> None:
    """Compute the card's reference rays at every state that has some: they show whether a coefficient has changed."""
    states = model.card.get("states") or {}
    references = [
        (default_state(model.card), model.card.get("reference")),
        *((tuple(r["state"]), r) for r in states.get("reference", ())),
    ]
    for state, reference in references:
        with damage_said(model.path, "card: reference"):
            _check_rays(model, state, reference)


def _check_rays(model: ModelFile, state: Sequence[float], reference: Any) -> None:
    rays, status = np.array(reference["rays"], np.float64), np.array(reference["status"])
    if rays.shape != (5, len(status)) or len(status) > _MAX_RAYS:
        raise ValueError(f"rays of shape {rays.shape}, expected 5 rows, and at most {_MAX_RAYS} columns as of status")
    inputs = {
        "rays": rays,
        "film_z_mm": np.array(reference["film_z_mm"], np.float64).reshape(1, -1)[:, :1],
        "stop_radius_mm": np.full((1, 1), float(reference["stop_radius_mm"])),
    }
    outputs = evaluate(model.at(state).graph, inputs)
    same = np.broadcast_to(outputs["status"], (1, len(status)))[0] == status
    passed = status == st.PASSED
    if not same.all() or not passed.any():
        raise ModelError(f"{model.path}: reference rays: the status of {int((~same).sum())} is not that of its card")
    mm = _OFF * max(1.0, abs(float(model.card["lens"]["efl_mm"])))
    rounding = {"position_mm": mm, "direction": _OFF, "transmittance": _OFF, "stop_mm": mm, "path_um": _OFF_UM}
    try:  # the card says where float32 costs more
        stated = reference.get("rounding") or {}
        rounding = {name: max(least, float(stated.get(name, 0.0))) for name, least in rounding.items()}
        if not all(map(math.isfinite, rounding.values())):
            raise ValueError("not finite")
    except (AttributeError, TypeError, ValueError) as error:
        raise ValueError(f"rounding: {error}") from error
    position, direction, power, stop, path = rounding.values()
    allowed = {"scene_ray": [[position]] * 3 + [[direction]] * 3, "transmittance": [[power]], "stop_xy_mm": [[stop]]}
    if "path_um" in outputs:
        allowed["path_um"] = [[path]]
    for name, limit in allowed.items():
        wanted = np.atleast_2d(np.array(reference[name], np.float64))
        off = np.abs(np.broadcast_to(outputs[name], wanted.shape) - wanted)[:, passed]
        if not (off <= limit).all():  # NaN fails
            raise ModelError(
                f"{model.path}: reference rays: {name} is off by {off.max():.3g}: its coefficients are damaged"
            )


def onnx_of(
    nodes: Sequence[LensModel],
    axes: Sequence[Axis] = (),
    metadata: Mapping[str, str] | None = None,
    *,
    derivatives: bool = False,
) -> bytes:
    """Return the ONNX file of a model, whose inputs and outputs `export.export_onnx` describes.

    Args:
        nodes: one model, or one for every node of the axes. Numbers that are equal at all nodes are constants; the
            others follow the features of the state (`Axis.features`), which costs a few operations a call.
        derivatives: whether the derivatives of scene ray and path by film and pupil point are outputs, too.

    Raises:
        InputError: weights that float32 does not hold, and nodes whose graphs differ in more than numbers.
    """
    state = state_graph(axes) if axes else None
    if copy_inputs(nodes[0]):
        nodes, *state = copy_nodes(nodes[0])  # type: ignore[assignment]
    graphs = [model_graph(node, ONNX) for node in with_one_angle(nodes)]
    shapes = {}
    if derivatives:
        of = [name for name in ("scene_ray", "path_um") if name in graphs[0].outputs]
        graphs = [with_derivatives(graph, of, [("rays", k) for k in range(4)]) for graph in graphs]
        for g, name, (by, rows) in product(graphs, of, DERIVATIVES.items()):
            g.outputs[f"{name}_d_{by}"] = g.concat(*(g.outputs.pop(derivative(name, row)) for row in rows))
        shapes = {f"scene_ray_d_{by}": (2, 6) for by in DERIVATIVES}
    if state is None:
        return write_onnx(graphs, metadata or {}, shapes=shapes)
    g, transform = state
    g.outputs["film_z_mm"] = g.select(g.outputs.pop("inside"), g.input("film_z_mm", per_call=True), _NOWHERE)
    return write_onnx(graphs, metadata or {}, Mixing(g, transform), shapes)


def coefficients_text(nodes: Sequence[LensModel]) -> str:
    """Return the metadata entry of a model, or of the nodes of one of many states: deflated JSON in base64.

    Raises:
        InputError: a core that no file can hold.
    """
    nodes = with_one_angle(nodes)
    first = nodes[0]
    data = {
        "schema": SCHEMA,
        "lens": packed_lens(first.lens),
        "scales": asdict(first.scales),
        "gates": [[g.surface, g.reason] for g in first.gates],
        "direction": first.direction,
        "angle": first.angle,
        "nodes": [{"encoding": asdict(node.encoding), "core": pack(node.core)} for node in nodes],
    }
    return base64.b64encode(zlib.compress(json.dumps(data, separators=(",", ":")).encode(), 9)).decode()


def as_stored(nodes: Sequence[LensModel]) -> tuple[LensModel, ...]:
    """Return the models as their file will give them: with coefficients rounded to float32, and one angle for all."""
    return tuple(replace(node, core=unpack(pack(node.core))) for node in with_one_angle(nodes))


def inflated(text: str) -> bytes:
    """Return the JSON that `deflated` has compressed.

    Raises:
        ValueError: the text is damaged, or its JSON is too long.
    """
    unpacker = zlib.decompressobj()
    try:
        data = unpacker.decompress(base64.b64decode(text, validate=True), _MAX_TEXT)
    except (binascii.Error, zlib.error) as error:
        raise ValueError(str(error)) from error
    if unpacker.unconsumed_tail or not unpacker.eof:
        raise ValueError(f"more than {_MAX_TEXT} bytes, or cut short")
    return data


def pack(value: Any) -> Any:
    """Return arrays, tuples and cores as JSON holds them: floats in float32, integers in bytes.

    Raises:
        InputError: a core that no file can hold, or a term of a degree beyond it.
    """
    if isinstance(value, np.ndarray) and value.dtype.kind == "f":
        with np.errstate(over="ignore"):
            rounded = value.astype("<f4")
        if not np.isfinite(rounded).all():
            raise InputError("export", "weights", "(NaN or infinity)", "finite numbers, in float32 too")
        return {"f4": base64.b64encode(rounded.tobytes()).decode(), "shape": list(value.shape)}
    if isinstance(value, np.ndarray):
        if value.size and not (0 <= value.min() and value.sum(-1).max() <= _MAX_DEGREE):
            raise InputError("export", "exponents", "(a negative or larger one)", f"terms of degree 0 to {_MAX_DEGREE}")
        return {"u1": base64.b64encode(value.astype("u1").tobytes()).decode(), "shape": list(value.shape)}
    if isinstance(value, tuple):
        return [pack(v) for v in value]
    if isinstance(value, Core):
        names = {kind: name for name, kind in CORES.items()}
        if type(value) not in names:
            raise InputError("export", "core", type(value).__name__, f"one of {', '.join(CORES)}")
        parts = {f.name: pack(getattr(value, f.name)) for f in fields(value)}  # type: ignore[arg-type]
        return {"kind": names[type(value)], **parts}
    return value


def unpack(packed: Any) -> Any:
    """Return the inverse of `pack`. Raises ValueError, KeyError, TypeError: damaged, or larger than files may be."""
    return _unpacked(packed, 0, [_MAX_CORES])


def _unpacked(packed: Any, depth: int, left: list[int]) -> Any:
    if depth > _MAX_DEPTH:
        raise ValueError("cores nested too deep")
    if isinstance(packed, list):
        return tuple(_unpacked(v, depth + 1, left) for v in packed)
    if not isinstance(packed, dict):
        return packed
    if "kind" in packed:
        left[0] -= 1
        if left[0] < 0 or packed["kind"] not in CORES:
            raise ValueError(
                f"core {str(packed['kind'])[:40]!r}, expected one of {', '.join(CORES)}, at most {_MAX_CORES}"
            )
        kind = CORES[packed["kind"]]
        return kind(**{f.name: _unpacked(packed[f.name], depth + 1, left) for f in fields(kind) if f.name in packed})  # type: ignore[arg-type]
    if max(packed["shape"], default=0) > _MAX_ROWS:
        raise ValueError(f"an array of shape {packed['shape']}, expected at most {_MAX_ROWS} rows")
    form = "f4" if "f4" in packed else "u1"
    array = np.frombuffer(base64.b64decode(packed[form], validate=True), f"<{form}").reshape(packed["shape"])
    if form == "u1":
        # the writers that make terms of products would not end
        if array.size and int(array.sum(-1).max()) > _MAX_DEGREE:
            raise ValueError(f"a term of degree {int(array.sum(-1).max())}, expected at most {_MAX_DEGREE}")
        return array.astype(np.int64)
    if not np.isfinite(array).all():
        raise ValueError("coefficients that are NaN or infinite")
    return array.astype(np.float64)


def _numbers(kind: Any, packed: dict[str, Any]) -> Any:
    """Read a dataclass of numbers, some of them None."""
    return kind(**{key: None if value is None else float(value) for key, value in packed.items()})


def packed_lens(lens: Lens) -> dict[str, Any]:
    """Pack a prescription without its other states and notes; numbers stay as they are, infinity becomes a word."""
    rows = []
    for surface in lens.surfaces:
        row = {}
        for f in fields(surface):
            value = getattr(surface, f.name)
            if f.name != "figure" and (f.default is MISSING or value != f.default):
                row[f.name] = _plain(value)
        rows.append(row | _plain(surface.figure.record()))
    most = {k: _plain(value) for k in _MOST if (value := getattr(lens, k)) is not None}
    return {**{k: _plain(getattr(lens, k)) for k in _LENS}, **most, "path": Path(lens.path).name, "surfaces": rows}


def _plain(value: Any) -> Any:
    if isinstance(value, Coating):
        return [value.name, [list(layer) for layer in value.layers], value.origin]
    if isinstance(value, tuple):
        return [_plain(v) for v in value]
    if not isinstance(value, (str, bool, int, float, list, dict, type(None))):
        value = float(value)  # of torch
    if isinstance(value, float) and math.isinf(value):
        return "inf" if value > 0 else "-inf"
    return value


def unpacked_lens(packed: dict[str, Any]) -> Lens:
    """Return the lens of `packed_lens`. Raises ValueError, KeyError, TypeError: damaged, or larger than lenses are."""
    surfaces: list[Surface] = []
    if len(packed["surfaces"]) > _MAX_SURFACES:
        raise ValueError(f"{len(packed['surfaces'])} surfaces, expected at most {_MAX_SURFACES}")
    for row in packed["surfaces"]:
        values = {f.name: row[f.name] for f in fields(Surface) if f.name in row}
        for key in ("radius_mm", "thickness_mm", "diameter_mm"):
            values[key] = float(values[key])  # "inf" too
        long = any(len(v) > _MAX_TERMS for v in row.values() if isinstance(v, list))
        if long or any(not 0 <= p <= _MAX_POWER for p, _ in row.get("asphere", ())):
            raise ValueError(f"an asphere of more than {_MAX_TERMS} terms, or of powers beyond {_MAX_POWER}")
        values["figure"] = figure_of(row)
        if values.get("coating"):
            name, layers, *origin = values["coating"]
            values["coating"] = Coating(str(name), tuple(tuple(float(v) for v in layer) for layer in layers), *origin)
        surfaces.append(Surface(**values))
    most: dict[str, Any] = {k: float(packed[k]) for k in _MOST if k in packed}
    return Lens(surfaces=tuple(surfaces), **{k: packed[k] for k in _LENS}, **most)
