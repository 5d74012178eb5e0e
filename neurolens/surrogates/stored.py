"""A fitted model inside its exported file: coefficients, encoding, gates and prescription as compact JSON.

The graph of an exported model is made to run. What it was made from stands beside it in the file's metadata, so that
other forms (source, one wavelength) can be written from the file alone. Coefficients are kept in float32, exactly;
floats of the prescription and the encoding in float64, exactly. Nothing is executed, sizes are bounded.
"""

from __future__ import annotations

import base64
import binascii
import json
import math
import zlib
from dataclasses import MISSING, asdict, fields
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from neurolens.base import status as st
from neurolens.base.errors import InputError, ModelError
from neurolens.base.tomlfile import check_tree
from neurolens.modelfile import MODEL_KEY, transmittance_of
from neurolens.modelfile.cardcheck import tolerances
from neurolens.modelfile.onnxfile import card_in, read_metadata
from neurolens.optics.prescription import Coating, Lens, Surface
from neurolens.surrogates.cores import (
    Core,
    InvariantPolynomial,
    MirrorPolynomial,
    Network,
    Partitioned,
    RawPolynomial,
    Refracted,
    Residual,
)
from neurolens.surrogates.domain import Domain, FilmRays
from neurolens.surrogates.lightfield import Encoding
from neurolens.surrogates.model import Gate, LensModel, Scales

SCHEMA = 1
# Cores by the name that files carry. Their fields are tensors, integer arrays, numbers, tuples and other cores.
CORES: dict[str, type] = {
    "invariants": InvariantPolynomial,
    "mirror": MirrorPolynomial,
    "raw": RawPolynomial,
    "network": Network,
    "partitioned": Partitioned,
    "residual": Residual,
    "refracted": Refracted,
}
_MAX_TEXT = 16 * 2**20  # of the JSON; the largest models known take 100 kB
_MAX_DEPTH = 16  # two a cut of cells
_MAX_ROWS = 20_000  # of any array: terms, or units of a layer
_MAX_DEGREE = 64  # of any term; settings allow half, and growth without limit stays far below
_MAX_RAYS = 1000  # of the card's reference; `card.reference_rays` gives 4 a status
_LENS = ("name", "source", "f_number", "image_radius_mm", "half_field_deg", "designer", "rims", "film_z_mm", "path")


def storable(core: Core) -> bool:
    """Whether a core, and every core in it, has a name in `CORES`."""
    parts = [*getattr(core, "parts", ()), *(v for v in vars(core).values() if isinstance(v, Core))]
    return type(core) in CORES.values() and all(storable(part) for part in parts)


def model_to_text(model: LensModel) -> str:
    """The metadata entry of a model: deflated JSON in base64. Raises InputError: a core that is not `storable`."""
    if not storable(model.core):
        raise InputError("export", "core", type(model.core).__name__, f"one of {', '.join(CORES)}")
    data = {
        "schema": SCHEMA,
        "lens": packed_lens(model.lens),
        "encoding": asdict(model.encoding),
        "scales": asdict(model.scales),
        "gates": [[g.surface, g.reason] for g in model.gates],
        "direction": model.direction,
        "core": pack(model.core),
    }
    return deflated(data)


def deflated(data: dict[str, Any]) -> str:
    """JSON as an entry of metadata."""
    text = json.dumps(data, separators=(",", ":")).encode()
    return base64.b64encode(zlib.compress(text, 9)).decode()


def load_fitted(path: str | Path) -> LensModel:
    """The model that an exported file was made from, coefficients rounded to float32.

    Its settings and fit time are the card's.

    Raises:
        ModelError: a file that is missing, too large, no exported model, made without its coefficients, damaged, or
            whose coefficients do not give the card's reference rays.
    """
    file = Path(path)
    _, _, metadata = read_metadata(file)
    card = card_in(file, metadata)
    if card.get("states"):
        raise ModelError(f"{file}: a model of many states (zoom, internal focus), expected one of one state")
    if MODEL_KEY not in metadata:
        raise ModelError(
            f"{file}: it holds no coefficients beside its graph: a model of many states, or one made by an "
            "earlier version, then export it again"
        )
    try:
        data = json.loads(inflated(metadata[MODEL_KEY]))
        check_tree(data, "coefficients")
        if data["schema"] != SCHEMA:
            raise ModelError(f"{file}: coefficients: schema: got {data['schema']!r}, expected {SCHEMA}")
        model = LensModel(
            lens=unpacked_lens(data["lens"]),
            domain=Domain.from_dict(card["domain"]),
            encoding=_numbers(Encoding, data["encoding"]),
            scales=_numbers(Scales, data["scales"]),
            gates=tuple(Gate(int(k), int(r)) for k, r in data["gates"]),
            core=unpack(data["core"]),
            method=str(card["fit"]["method"]),
            settings=dict(card["fit"]["settings"]),
            fit_s=float(card["fit"]["seconds"]),
            direction="slope" if data["direction"] == "slope" else "angle",
            transmittance=transmittance_of(card),
        )
        _check(file, model, card)
    except (ValueError, TypeError, KeyError, IndexError, RuntimeError, ArithmeticError, AttributeError) as error:
        if isinstance(error, ModelError):
            raise
        raise ModelError(f"{file}: its coefficients are damaged ({type(error).__name__}: {error})") from error
    return model


def inflated(text: str) -> bytes:
    """The JSON of `deflated`. Raises ValueError: damaged, or too long."""
    unpacker = zlib.decompressobj()
    try:
        found = unpacker.decompress(base64.b64decode(text, validate=True), _MAX_TEXT)
    except (binascii.Error, zlib.error) as error:
        raise ValueError(str(error)) from error
    if unpacker.unconsumed_tail or not unpacker.eof:
        raise ValueError(f"more than {_MAX_TEXT} bytes, or cut short")
    return found


def pack(value: Any) -> Any:
    """Arrays, tuples and cores as JSON has them: floats in float32, integers in bytes."""
    if isinstance(value, np.ndarray) and value.dtype.kind == "f":
        return {"f4": base64.b64encode(value.astype("<f4").tobytes()).decode(), "shape": list(value.shape)}
    if isinstance(value, np.ndarray):
        if value.size and not (0 <= value.min() and value.sum(-1).max() <= _MAX_DEGREE):
            raise InputError("export", "exponents", "(a negative or larger one)", f"terms of degree 0 to {_MAX_DEGREE}")
        return {"u1": base64.b64encode(value.astype("u1").tobytes()).decode(), "shape": list(value.shape)}
    if isinstance(value, tuple):
        return [pack(v) for v in value]
    names = {kind: name for name, kind in CORES.items()}
    if type(value) in names:
        return {"kind": names[type(value)], **{f.name: pack(getattr(value, f.name)) for f in fields(value)}}
    return value


def unpack(packed: Any, depth: int = 0) -> Any:
    """What `pack` packed."""
    if depth > _MAX_DEPTH:
        raise ValueError("cores nested too deep")
    if isinstance(packed, list):
        return tuple(unpack(v, depth + 1) for v in packed)
    if not isinstance(packed, dict):
        return packed
    if "kind" in packed:
        kind = CORES[packed["kind"]]
        return kind(**{f.name: unpack(packed[f.name], depth + 1) for f in fields(kind) if f.name in packed})
    if max(packed["shape"], default=0) > _MAX_ROWS:
        raise ValueError(f"an array of shape {packed['shape']}, expected at most {_MAX_ROWS} rows")
    form = "f4" if "f4" in packed else "u1"
    array = np.frombuffer(base64.b64decode(packed[form], validate=True), f"<{form}").reshape(packed["shape"])
    if form == "u1":
        if array.size and int(array.sum(-1).max()) > _MAX_DEGREE:  # whoever writes terms as products would not end
            raise ValueError(f"a term of degree {int(array.sum(-1).max())}, expected at most {_MAX_DEGREE}")
        return array.astype(np.int64)
    if not np.isfinite(array).all():
        raise ValueError("coefficients that are NaN or infinite")
    return array.astype(np.float64)


def _numbers(kind: Any, packed: dict[str, Any]) -> Any:
    """A dataclass of numbers, some of them None."""
    return kind(**{key: None if value is None else float(value) for key, value in packed.items()})


def packed_lens(lens: Lens) -> dict[str, Any]:
    """What stands in a prescription but for its other states and notes; numbers as they are, infinity as a word."""
    rows = []
    for surface in lens.surfaces:
        row = {}
        for f in fields(surface):
            value = getattr(surface, f.name)
            if f.default is MISSING or value != f.default:
                row[f.name] = _plain(value)
        rows.append(row)
    return {**{k: _plain(getattr(lens, k)) for k in _LENS}, "path": Path(lens.path).name, "surfaces": rows}


def _plain(value: Any) -> Any:
    if isinstance(value, Coating):
        return [value.name, [list(layer) for layer in value.layers]]
    if isinstance(value, tuple):
        return [_plain(v) for v in value]
    if isinstance(value, Tensor):
        value = float(value)
    if isinstance(value, float) and math.isinf(value):
        return "inf" if value > 0 else "-inf"
    return value


def unpacked_lens(packed: dict[str, Any]) -> Lens:
    """What `packed_lens` packed."""
    surfaces = []
    for row in packed["surfaces"]:
        known = {f.name: row[f.name] for f in fields(Surface) if f.name in row}
        for key in ("radius_mm", "thickness_mm", "diameter_mm"):
            known[key] = float(known[key])  # "inf" too
        if "asphere" in known:
            known["asphere"] = tuple((int(p), float(a)) for p, a in known["asphere"])
        if known.get("coating"):
            name, layers = known["coating"]
            known["coating"] = Coating(str(name), tuple(tuple(float(v) for v in layer) for layer in layers))
        surfaces.append(Surface(**known))
    return Lens(surfaces=tuple(surfaces), **{k: packed[k] for k in _LENS})


def _check(file: Path, model: LensModel, card: dict[str, Any]) -> None:
    """The lens is the card's, and the card's reference rays come out: a changed coefficient shows."""
    if model.lens.sha256 != card["lens"]["sha256"]:
        raise ModelError(f"{file}: its prescription is not that of its card")
    reference = card["reference"]
    if len(reference["status"]) > _MAX_RAYS or any(len(row) > _MAX_RAYS for row in reference["rays"]):
        raise ValueError(f"more than {_MAX_RAYS} reference rays")
    columns = torch.tensor(reference["rays"], dtype=torch.float64)
    film_z = torch.tensor(reference["film_z_mm"], dtype=torch.float64)
    with torch.no_grad():
        out = model.predict(FilmRays(columns[0], columns[1], film_z, *columns[2:]), reference["stop_radius_mm"])
    wanted = torch.tensor(reference["scene_ray"], dtype=torch.float64)
    passed = torch.tensor(reference["status"]) == 0
    off = (torch.stack(list(out.rays)) - wanted).abs()[:, passed]
    allowed = tolerances(card, reference)  # the coefficients are rounded to float32
    limit = torch.tensor([[allowed["position_mm"]]] * 3 + [[allowed["direction"]]] * 3, dtype=torch.float64)
    same = (out.status == torch.tensor(reference["status"])) | (out.status == st.OUTSIDE_DOMAIN)
    if not bool(same.all() and (off <= limit).all()):
        raise ModelError(f"{file}: its coefficients do not give the reference rays of its card: they are damaged")
