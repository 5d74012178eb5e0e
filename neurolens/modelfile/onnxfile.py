"""Reading exported models with suspicion: a file is checked before onnxruntime sees it.

It needs no onnx package. It refuses what a lens model never holds: operators that are not on the list, functions,
subgraphs, tensors in other files or of unreasonable size, numbers that are not finite. Format: onnx.proto3 of the ONNX
project; field numbers below are its.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from neurolens.base.errors import InputError, ModelError
from neurolens.base.files import read_bytes
from neurolens.base.tomlfile import parse_json
from neurolens.modelfile import CARD_KEY, CARD_KIND, CARD_SCHEMA, MAX_CARD
from neurolens.modelfile.protobuf import Fields, as_text, fields_of, integers, message, one, text, walk
from neurolens.modelfile.shapes import BROADCAST, ELEMENTWISE, RAYS, SHAPED, Node, Shape, check_shapes

MAX_BYTES = 64 * 2**20
OPERATORS = ELEMENTWISE | BROADCAST | frozenset(SHAPED)
# TensorProto.DataType: what models hold, and the numpy type of their raw bytes.
_TYPES: dict[int, str] = {1: "<f4", 3: "<i1", 6: "<i4", 7: "<i8", 10: "<f2"}
_CASTS = {1: "float32", 6: "int32", 7: "int64", 9: "bool"}  # never text, of 32 bytes a number
_EXTERNAL = 1  # TensorProto.DataLocation
_FLOATS = {"attribute": frozenset({2, 7}), "tensor": frozenset({4, 10})}  # fields of numbers of fixed width


def read_checked(path: str | Path) -> tuple[bytes, dict[str, Any]]:
    """Bytes and card of a model file.

    Raises:
        ModelError: as `read_metadata` and `card_in`, and of a file that holds something a lens model never does.
    """
    data, model, metadata = read_metadata(path)
    try:
        opsets = [text(fields_of(entry), 1) for entry in model.get(8, [])]
        _check_graph(fields_of(one(model, 7)), opsets, bool(model.get(25)))
    except ModelError as error:
        raise ModelError(f"{path}: {error}") from error
    except (ValueError, TypeError) as error:
        raise ModelError(f"{path}: truncated or damaged ({error})") from error
    return data, card_in(path, metadata)


def read_metadata(path: str | Path) -> tuple[bytes, Fields, dict[str, str]]:
    """Bytes, fields and metadata of a model file, of which nothing else is checked.

    Raises:
        ModelError: a file that is missing, too large, truncated, or no ONNX model.
    """
    file = Path(path)
    try:
        data = read_bytes(file, MAX_BYTES, "an exported lens model (.onnx)")
    except InputError as error:
        raise ModelError(str(error)) from None
    try:
        model = fields_of(memoryview(data))
        one(model, 7)  # the graph
        metadata = {text(entry, 1): text(entry, 2) for entry in map(fields_of, model.get(14, []))}
    except (ValueError, TypeError) as error:
        raise ModelError(f"{file}: truncated, or not an ONNX model ({error})") from error
    return data, model, metadata


def card_in(file: Any, metadata: dict[str, str], expected: str = CARD_KIND) -> dict[str, Any]:
    """The card in a file's metadata.

    Args:
        expected: its kind.

    Raises:
        ModelError: none, one of more than `MAX_CARD` characters, that is not strict JSON, or of another kind or schema.
    """
    if CARD_KEY not in metadata:
        raise ModelError(f"{file}: no card: its metadata has no {CARD_KEY!r}, so this is no model made by neurolens")
    if len(metadata[CARD_KEY]) > MAX_CARD:
        raise ModelError(f"{file}: card: {len(metadata[CARD_KEY])} characters, expected at most {MAX_CARD}")
    try:
        card = parse_json(metadata[CARD_KEY], "card")
    except (ValueError, RecursionError) as error:
        raise ModelError(f"{file}: the card is not strict JSON ({error})") from error
    kind = card.get("kind") if isinstance(card, dict) else None
    if kind != expected:
        raise ModelError(f"{file}: card: kind: got {kind!r}, expected {expected!r}")
    if card.get("schema") != CARD_SCHEMA:
        raise ModelError(f"{file}: card: schema: got {card.get('schema')!r}, expected {CARD_SCHEMA}")
    return card


def without_outputs(data: bytes, names: frozenset[str]) -> bytes:
    """The same model without some of its outputs, so that nothing is computed for them."""
    if not any(name.encode() in data for name in names):
        return data

    def kept(number: int, value: Any) -> bool:
        return not (number == 12 and text(fields_of(value), 1) in names)

    graph = message(f for f in walk(memoryview(one(fields_of(memoryview(data)), 7))) if kept(f[0], f[2]))
    return message((n, wire, graph if n == 7 else value) for n, wire, value in walk(memoryview(data)))


def constants_and_nodes(data: bytes) -> tuple[dict[str, NDArray[Any]], list[Node]]:
    """Constants by name, and nodes in order, of a model that `read_checked` gave."""
    graph = fields_of(one(fields_of(memoryview(data)), 7))
    constants = {}
    for tensor in (fields_of(t, _FLOATS["tensor"]) for t in graph.get(5, [])):
        constants[text(tensor, 8)] = _values(tensor).reshape(integers(tensor.get(1, [])))
    return constants, [_node(fields_of(node)) for node in graph.get(1, [])]


def _check_graph(graph: Fields, opsets: list[str], functions: bool) -> None:
    if functions or any(domain not in ("", "ai.onnx") for domain in opsets):
        raise ModelError(f"operator sets {opsets}, functions {functions}: expected the standard operators only")
    if graph.get(15):
        raise ModelError("sparse tensors, expected none")
    tensors = [fields_of(tensor, _FLOATS["tensor"]) for tensor in graph.get(5, [])]
    for tensor in tensors:
        _check_tensor(tensor)
    nodes = [_node(fields_of(node)) for node in graph.get(1, [])]
    inputs = [_shape_of_input(fields_of(value)) for value in graph.get(11, [])]
    constants = [(text(t, 8), tuple(integers(t.get(1, [])))) for t in tensors]
    try:
        check_shapes(nodes, inputs, constants, {text(t, 8): _values(t).tolist() for t in tensors if t.get(2) == [7]})
    except ValueError as error:
        raise ModelError(str(error)) from error


def _node(node: Fields) -> Node:
    kind, domain = text(node, 4), text(node, 7)
    if domain not in ("", "ai.onnx") or kind not in OPERATORS:
        raise ModelError(f"operator {domain + '.' if domain else ''}{kind}: expected one of {sorted(OPERATORS)}")
    attributes = [fields_of(attribute, _FLOATS["attribute"]) for attribute in node.get(5, [])]
    if any(set(a) & {5, 6, 10, 11, 22, 23} for a in attributes):  # tensors, graphs, sparse tensors
        raise ModelError(f"operator {kind}: an attribute holds a tensor or a graph, expected numbers only")
    if kind == "Transpose" and attributes:
        raise ModelError("operator Transpose: attributes, expected none: axes in reverse order")
    numbers = {text(a, 1): _signed(one(a, 3)) for a in attributes if 3 in a}
    if kind == "Cast" and numbers.get("to") not in _CASTS:
        raise ModelError(f"operator Cast: to type {numbers.get('to')}, expected {', '.join(_CASTS.values())}")
    inputs, outputs = ([as_text(name) for name in node.get(number, [])] for number in (1, 2))
    return Node(kind, numbers, inputs, outputs)


def _signed(value: int) -> int:
    return value - 2**64 if value >= 2**63 else value


def _shape_of_input(value: Fields) -> tuple[str, Shape]:
    """Name and shape of a ValueInfoProto; dimensions without a number are those of rays."""
    tensor = fields_of(one(fields_of(one(value, 2)), 1))
    dimensions = map(fields_of, fields_of(one(tensor, 2)).get(1, []))
    return text(value, 1), tuple(int(one(d, 1)) if 1 in d else RAYS for d in dimensions)


def _values(tensor: Fields) -> NDArray[Any]:
    """The numbers of a tensor: its raw bytes, or of float32 without any its float_data, packed or one by one."""
    kind, raw = int(one(tensor, 2)), tensor.get(9, [b""])[-1]
    if kind == 1 and not len(raw):
        raw = b"".join(tensor.get(4, []))  # refuses what is no bytes
    return np.frombuffer(raw, _TYPES[kind])


def _check_tensor(tensor: Fields) -> None:
    name = text(tensor, 8) or "(unnamed)"
    if tensor.get(13) or tensor.get(14, [0])[-1] == _EXTERNAL:
        raise ModelError(f"tensor {name}: its data lie in another file, expected them in the model")
    kind = int(tensor.get(2, [0])[-1])
    if kind not in _TYPES:
        raise ModelError(f"tensor {name}: data type {kind}, expected float32, float16 or integers")
    if kind in (3, 10) and tensor.get(5):  # the other way to hold them, which no writer of models takes
        raise ModelError(f"tensor {name}: data type {kind} as int32 numbers, expected its raw bytes")
    if kind in (1, 10):
        values = _values(tensor)
        if not np.isfinite(values).all():
            raise ModelError(f"tensor {name}: {int((~np.isfinite(values)).sum())} weights are NaN or infinite")
