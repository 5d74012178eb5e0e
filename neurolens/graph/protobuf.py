"""Protocol Buffers: messages read and written, with the few messages of ONNX that models need.

The package onnx takes half a second to load, and a model file needs little of it. Field numbers are those of
onnx.proto3 of the ONNX project; the format is that of the encoding guide of Protocol Buffers, without groups.
"""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any

from numpy.typing import NDArray

_VARINT, _DOUBLE, _BYTES, _FLOAT = 0, 1, 2, 5  # wire types
_INT_ATTRIBUTE = 2  # AttributeProto.AttributeType.INT
FLOAT, INT32, INT64 = 1, 6, 7  # TensorProto.DataType
ML = "ai.onnx.ml"  # the standard's second set of operators; version 1 is read by every onnxruntime
_DATA_TYPES = {"f": FLOAT, "4": INT32, "8": INT64}


def walk(data: memoryview) -> Iterator[tuple[int, int, Any]]:
    """Yield number, wire type and value of every field, in the order of the bytes.

    Raises:
        ValueError: the bytes are no message, or end within a field.
    """
    at, end = 0, len(data)
    while at < end:
        key, at = _varint(data, at)
        number, wire = key >> 3, key & 7
        if number == 0:
            raise ValueError("field number 0")
        if wire == _VARINT:
            value, at = _varint(data, at)
            yield number, wire, value
            continue
        if wire == _BYTES:
            length, at = _varint(data, at)
        elif wire in (_DOUBLE, _FLOAT):
            length = 8 if wire == _DOUBLE else 4
        else:
            raise ValueError(f"wire type {wire}")
        if length > end - at:
            raise ValueError(f"{length} bytes announced where {end - at} are left")
        yield number, wire, data[at : at + length]
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


def message(fields: Iterable[tuple[int, int, Any]]) -> bytes:
    """Return the bytes of a message of these fields: number, wire type and value, as `walk` yields them."""
    return b"".join(_encoded(*field) for field in fields)


def _encoded(number: int, wire: int, value: Any) -> bytes:
    key = _as_varint(number << 3 | wire)
    if wire == _VARINT:
        return key + _as_varint(value)
    return key + (_as_varint(len(value)) if wire == _BYTES else b"") + bytes(value)


def _as_varint(value: int) -> bytes:
    encoded = bytearray()
    while value > 0x7F:
        encoded.append(value & 0x7F | 0x80)
        value >>= 7
    encoded.append(value)
    return bytes(encoded)


def _message(*fields: tuple[int, int | str | bytes]) -> bytes:
    """Return a message of fields whose wire type follows from their values: whole numbers, texts, messages."""
    typed = (
        (n, _VARINT, v) if isinstance(v, int) else (n, _BYTES, v if isinstance(v, bytes) else v.encode())
        for n, v in fields
    )
    return message(typed)


def node_proto(
    kind: str, inputs: Sequence[str], outputs: Sequence[str], name: str, domain: str = "", **attributes: int
) -> bytes:
    """Return a node of a graph: an operator of ONNX, or of `domain`, with its whole-number attributes."""
    packed: list[tuple[int, int | str | bytes]] = [
        (5, _message((1, key), (3, value), (20, _INT_ATTRIBUTE))) for key, value in attributes.items()
    ]
    return _message(*((1, i) for i in inputs), *((2, o) for o in outputs), (3, name), (4, kind), *packed, (7, domain))


def tensor_proto(array: NDArray[Any], name: str) -> bytes:
    """Return a constant: float32, int32 or int64."""
    kind = _DATA_TYPES["f" if array.dtype.kind == "f" else str(array.dtype.itemsize)]
    raw = array.astype(array.dtype.newbyteorder("<")).tobytes()
    return _message(*((1, int(size)) for size in array.shape), (2, kind), (8, name), (9, raw))


def value_proto(name: str, kind: int, shape: Sequence[int | str]) -> bytes:
    """Return an input or an output of a graph; a dimension without a fixed size is a name."""
    dimensions = _message(*((1, _message((1 if isinstance(size, int) else 2, size))) for size in shape))
    return _message((1, name), (2, _message((1, _message((1, kind), (2, dimensions))))))


def model_proto(
    nodes: Sequence[bytes],
    inputs: Sequence[bytes],
    outputs: Sequence[bytes],
    constants: Sequence[bytes],
    metadata: Mapping[str, str],
    versions: tuple[int, int],
) -> bytes:
    """Return a whole model. `versions` are those of the format (IR) and of the operators (opset)."""
    repeated = ((1, nodes), (5, constants), (11, inputs), (12, outputs))
    graph = _message((2, "neurolens"), *((number, part) for number, parts in repeated for part in parts))
    entries = ((14, _message((1, key), (2, text))) for key, text in metadata.items())
    operators = [_message((1, ""), (2, versions[1]))]
    if any(ML.encode() in node for node in nodes):
        operators.append(_message((1, ML), (2, 1)))
    return _message((1, versions[0]), (2, "neurolens"), (7, graph), *((8, o) for o in operators), *entries)
