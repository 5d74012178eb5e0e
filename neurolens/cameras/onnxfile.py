"""Reading exported models with suspicion: a small protobuf reader that checks a file before onnxruntime sees it.

It needs no onnx package. It refuses what a lens model never holds: operators that are not on the list, functions,
subgraphs, tensors in other files, numbers that are not finite. Format: onnx.proto3 of the ONNX project; field numbers
below are its.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from neurolens.errors import ModelError
from neurolens.modelfile import CARD_KEY, CARD_KIND, CARD_SCHEMA

MAX_BYTES = 64 * 2**20
INPUT_ROWS = 16  # rows of an input: more than any has
MAX_ROWS = 20_000  # of any tensor inside; the largest polynomials known have a thousand terms
OPERATORS = frozenset(
    "Abs Add And Cast Clip Concat Cos DequantizeLinear Div Equal Gather Gemm Greater GreaterOrEqual Identity "
    "LessOrEqual MatMul Max Min Mul Neg Reciprocal ReduceSum Relu Reshape Sin Slice Split Sqrt Sub Tanh Where".split()
)
# TensorProto.DataType: what models hold, and the numpy type of their raw bytes.
_TYPES: dict[int, str] = {1: "<f4", 3: "<i1", 6: "<i4", 7: "<i8", 10: "<f2"}
_EXTERNAL = 1  # TensorProto.DataLocation

Fields = dict[int, list[Any]]


def read_checked(path: str | Path) -> tuple[bytes, dict[str, Any]]:
    """Bytes and card of a model file.

    Raises:
        ModelError: a file that is missing, too large, truncated, no ONNX model, without a card of this schema, or that
            holds something a lens model never does.
    """
    file = Path(path)
    if not file.is_file():
        raise ModelError(f"{file}: no such file, expected an exported lens model (.onnx)")
    size = file.stat().st_size
    if size > MAX_BYTES:
        raise ModelError(f"{file}: {size} bytes, expected at most {MAX_BYTES}")
    data = file.read_bytes()
    try:
        model = _fields(memoryview(data))
        graph = _one(model, 7)
        metadata = {_text(entry, 1): _text(entry, 2) for entry in map(_fields, model.get(14, []))}
        opsets = [_text(_fields(entry), 1) for entry in model.get(8, [])]
    except (ValueError, TypeError) as error:
        raise ModelError(f"{file}: truncated, or not an ONNX model ({error})") from error
    try:
        _check_graph(_fields(graph), opsets, bool(model.get(25)))
    except ModelError as error:
        raise ModelError(f"{file}: {error}") from error
    except (ValueError, TypeError) as error:
        raise ModelError(f"{file}: truncated or damaged ({error})") from error
    return data, _card(file, metadata)


def without_outputs(data: bytes, names: frozenset[str]) -> bytes:
    """The same model without some of its outputs, so that nothing is computed for them."""
    if not any(name.encode() in data for name in names):
        return data

    def kept(number: int, value: Any) -> bool:
        return not (number == 12 and isinstance(value, memoryview) and _text(_fields(value), 1) in names)

    def message(fields: Iterator[tuple[int, Any]]) -> bytes:
        return b"".join(_encoded(number, value) for number, value in fields)

    graph = message((n, v) for n, v in _walk(memoryview(_one(_fields(memoryview(data)), 7))) if kept(n, v))
    return message((n, graph if n == 7 else v) for n, v in _walk(memoryview(data)))


def _encoded(number: int, value: Any) -> bytes:
    """One field of a message: a number, or bytes."""
    if isinstance(value, int):
        return _as_varint(number << 3) + _as_varint(value)
    return _as_varint(number << 3 | 2) + _as_varint(len(value)) + bytes(value)


def _as_varint(value: int) -> bytes:
    found = bytearray()
    while value > 0x7F:
        found.append(value & 0x7F | 0x80)
        value >>= 7
    found.append(value)
    return bytes(found)


def _card(file: Path, metadata: dict[str, str]) -> dict[str, Any]:
    if CARD_KEY not in metadata:
        raise ModelError(f"{file}: no card: its metadata has no {CARD_KEY!r}, so this is no model made by neurolens")
    try:
        card = json.loads(metadata[CARD_KEY], parse_constant=_refuse_constant)
    except (ValueError, RecursionError) as error:
        raise ModelError(f"{file}: the card is not strict JSON ({error})") from error
    kind = card.get("kind") if isinstance(card, dict) else None
    if kind != CARD_KIND:
        raise ModelError(f"{file}: card: kind: got {kind!r}, expected {CARD_KIND!r}")
    if card.get("schema") != CARD_SCHEMA:
        raise ModelError(f"{file}: card: schema: got {card.get('schema')!r}, expected {CARD_SCHEMA}")
    return card


def _refuse_constant(name: str) -> Any:
    raise ValueError(f"{name} is no number of JSON")


def _check_graph(graph: Fields, opsets: list[str], functions: bool) -> None:
    if functions or any(domain not in ("", "ai.onnx") for domain in opsets):
        raise ModelError(f"operator sets {opsets}, functions {functions}: expected the standard operators only")
    if graph.get(15):
        raise ModelError("sparse tensors, expected none")
    for node in map(_fields, graph.get(1, [])):
        kind, domain = _text(node, 4), _text(node, 7)
        if domain not in ("", "ai.onnx") or kind not in OPERATORS:
            raise ModelError(f"operator {domain + '.' if domain else ''}{kind}: expected one of {sorted(OPERATORS)}")
        for attribute in map(_fields, node.get(5, [])):
            if set(attribute) & {5, 6, 10, 11, 22, 23}:  # tensors, graphs, sparse tensors
                raise ModelError(f"operator {kind}: an attribute holds a tensor or a graph, expected numbers only")
    for tensor in map(_fields, graph.get(5, [])):
        _check_tensor(tensor)
    _check_sizes(graph)


def _check_sizes(graph: Fields) -> None:
    """Refuse graphs whose tensors grow beyond reason, before any memory is taken for them.

    Tensors of a lens model are [rows, rays]. No operator of the list makes more rows than its largest input has, but
    Concat, which adds them up; a chain of those could ask for any amount from a file of a thousand bytes. Products
    with a matrix of the file have its rows, and parts of a Split their stated ones.
    """
    tensors = {_text(t, 8): t for t in map(_fields, graph.get(5, []))}
    first = {name: (_dimensions(t) or [1])[0] for name, t in tensors.items()}
    rows = {name: max(_dimensions(t), default=1) for name, t in tensors.items()}
    for node in map(_fields, graph.get(1, [])):
        kind = _text(node, 4)
        inputs, outputs = ([bytes(name).decode("utf-8") for name in node.get(n, [])] for n in (1, 2))
        sizes = [rows.get(name, INPUT_ROWS) for name in inputs]
        grown = sum(sizes) if kind == "Concat" else max(sizes, default=1)
        if kind in ("MatMul", "Gemm") and inputs and inputs[0] in first:
            grown = max(first[inputs[0]], *sizes[2:], 1)
        if grown > MAX_ROWS:
            raise ModelError(f"operator {kind} makes {grown} rows, expected at most {MAX_ROWS}")
        parts = _parts(tensors[inputs[1]]) if kind == "Split" and len(inputs) > 1 and inputs[1] in tensors else []
        for i, name in enumerate(outputs):
            rows[name] = parts[i] if len(parts) == len(outputs) and 0 < parts[i] <= grown else grown


def _parts(tensor: Fields) -> list[int]:
    """The numbers of an int64 tensor held as raw bytes; none for others."""
    raw = tensor.get(9, [b""])[-1]
    return [int(v) for v in np.frombuffer(raw, "<i8")] if not isinstance(raw, int) and len(raw) % 8 == 0 else []


def _dimensions(tensor: Fields) -> list[int]:
    """dims of a TensorProto, packed or one by one."""
    found: list[int] = []
    for chunk in tensor.get(1, []):
        if isinstance(chunk, int):
            found.append(chunk)
            continue
        at = 0
        while at < len(chunk):
            size, at = _varint(chunk, at)
            found.append(size)
    return found


def _check_tensor(tensor: Fields) -> None:
    name = _text(tensor, 8) or "(unnamed)"
    if tensor.get(13) or tensor.get(14, [0])[-1] == _EXTERNAL:
        raise ModelError(f"tensor {name}: its data lie in another file, expected them in the model")
    kind = int(tensor.get(2, [0])[-1])
    if kind not in _TYPES:
        raise ModelError(f"tensor {name}: data type {kind}, expected float32, float16 or integers")
    raw = tensor.get(9, [b""])[-1]
    if kind in (3, 10) and tensor.get(5):  # the other way to hold them, which no writer of models takes
        raise ModelError(f"tensor {name}: data type {kind} as int32 numbers, expected its raw bytes")
    if kind in (1, 10):
        packed = len(raw) or kind == 10
        values = np.frombuffer(raw, _TYPES[kind]) if packed else _floats(tensor.get(4, []))
        if not np.isfinite(values).all():
            raise ModelError(f"tensor {name}: {int((~np.isfinite(values)).sum())} weights are NaN or infinite")


def _floats(chunks: list[Any]) -> np.ndarray:
    """float_data, packed or one by one."""
    return np.frombuffer(b"".join(bytes(c) for c in chunks), "<f4")


def _one(fields: Fields, number: int) -> Any:
    if number not in fields:
        raise ValueError(f"field {number} is missing")
    return fields[number][-1]


def _text(fields: Fields, number: int) -> str:
    return bytes(fields[number][-1]).decode("utf-8") if number in fields else ""


def _fields(data: memoryview) -> Fields:
    """The fields of one protobuf message, by number; values are ints or bytes, in the order of the file.

    Raises:
        ValueError: bytes that are no message.
    """
    found: Fields = {}
    if isinstance(data, int):
        raise ValueError("a number where a message should be")
    for number, value in _walk(data):
        found.setdefault(number, []).append(value)
    return found


def _walk(data: memoryview) -> Iterator[tuple[int, Any]]:
    at, end = 0, len(data)
    while at < end:
        key, at = _varint(data, at)
        number, wire = key >> 3, key & 7
        if number == 0:
            raise ValueError("field number 0")
        if wire == 0:
            value, at = _varint(data, at)
            yield number, value
            continue
        if wire == 2:
            length, at = _varint(data, at)
        elif wire in (1, 5):
            length = 8 if wire == 1 else 4
        else:
            raise ValueError(f"wire type {wire}")
        if length > end - at:
            raise ValueError(f"{length} bytes announced where {end - at} are left")
        yield number, data[at : at + length]
        at += length


def _varint(data: memoryview, at: int) -> tuple[int, int]:
    value = shift = 0
    while True:
        if at >= len(data) or shift > 63:
            raise ValueError("a number without end")
        byte = data[at]
        value |= (byte & 0x7F) << shift
        at, shift = at + 1, shift + 7
        if byte < 0x80:
            return value, at
