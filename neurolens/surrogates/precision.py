"""Networks with weights stored in float16 or int8: what a smaller number format costs in error, and what it saves.

Only storage changes: every row of a weight matrix is scaled to its largest entry and rounded, and the graph turns it
back into float32 (Cast and Mul, or DequantizeLinear), which onnxruntime does once, on loading. It computes in float32:
its CPU provider has no tanh and no such matrix products in float16, and would insert the casts itself.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
import onnxruntime
from numpy.typing import NDArray
from onnx import ModelProto, NodeProto, TensorProto, checker, helper, numpy_helper

from neurolens.base.errors import InputError
from neurolens.modelfile import CARD_KEY, MODEL_KEY
from neurolens.surrogates.card import card_to_json
from neurolens.surrogates.export import write_file

Precision = Literal["float16", "int8"]

_INPUTS = ["rays", "film_z_mm", "stop_radius_mm"]
_OUTPUTS = ["scene_ray", "transmittance", "stop_xy_mm", "status"]
# Smaller matrices (sums of two squares, plane changes) are left as they are.
_LEAST_ENTRIES = 24


def store_weights(
    source: str | Path, target: str | Path, precision: Precision, errors: dict[str, Any] | None = None
) -> Path:
    """Write a version of an exported network whose weights are stored in `precision`; biases stay float32.

    The card of the new file says so, gives the reference rays that its own graph gives, and holds `errors`: those of
    the source no longer hold. Its coefficients beside the graph are left out.

    Args:
        source: a file that `export_onnx` made of a network.
        errors: held-out errors of the new file for its card, JSON-able.

    Returns the path.

    Raises:
        InputError: another precision, or a file without a network's layers.
        onnx.checker.ValidationError: a file that is no ONNX model.
    """
    if precision not in get_args(Precision):
        raise InputError("store_weights", "precision", precision, f"one of {', '.join(get_args(Precision))}")
    proto = ModelProto()
    proto.ParseFromString(Path(source).read_bytes())
    graph = proto.graph
    if not any(node.op_type == "Tanh" for node in graph.node) or [i.name for i in graph.input] != _INPUTS:
        raise InputError(source, "graph", "(no tanh layer, or other inputs)", "an exported network of a lens")
    heads: list[NodeProto] = []
    kept: list[TensorProto] = []
    weights = {n.input[0] for n in graph.node if n.op_type in ("Gemm", "MatMul")}
    for tensor in graph.initializer:
        value = numpy_helper.to_array(tensor)
        if tensor.name in weights and value.dtype == np.float32 and value.size >= _LEAST_ENTRIES:
            made, tensors = _stored(tensor.name, value, precision)
            heads += made
            kept += tensors
        else:
            kept.append(tensor)
    nodes = [*heads, *graph.node]
    del graph.node[:], graph.initializer[:]
    graph.node.extend(nodes)
    graph.initializer.extend(kept)
    checker.check_model(proto, full_check=True)
    _write_card(proto, precision, errors or {})
    return write_file(target, proto)


def _stored(name: str, value: NDArray[np.float32], precision: Precision) -> tuple[list[NodeProto], list[TensorProto]]:
    """Nodes that make the matrix `name` [M, K] from rounded numbers and one scale a row, and those constants."""
    most = np.abs(value).max(1)
    most = np.where(most > 0, most, 1).astype(np.float32)
    packed, scale = f"{name}_{precision}", f"{name}_scale"
    if precision == "int8":
        step = (most / 127).astype(np.float32)
        numbers = np.clip(np.round(value / step[:, None]), -127, 127).astype(np.int8)
        nodes = [helper.make_node("DequantizeLinear", [packed, scale], [name], name=f"{name}_dequantise", axis=0)]
        return nodes, [numpy_helper.from_array(numbers, packed), numpy_helper.from_array(step, scale)]
    half = (value / most[:, None]).astype(np.float16)
    nodes = [
        helper.make_node("Cast", [packed], [f"{name}_cast"], name=f"{name}_widen", to=TensorProto.FLOAT),
        helper.make_node("Mul", [f"{name}_cast", scale], [name], name=f"{name}_rescale"),
    ]
    return nodes, [numpy_helper.from_array(half, packed), numpy_helper.from_array(most[:, None], scale)]


def _write_card(proto: ModelProto, precision: Precision, errors: dict[str, Any]) -> None:
    """Reference rays as the new graph gives them; those whose status changes are left out."""
    metadata = {entry.key: entry.value for entry in proto.metadata_props}
    if CARD_KEY not in metadata:
        raise InputError("store_weights", "source", "(no card)", "a model exported by neurolens")
    card = json.loads(metadata.pop(CARD_KEY))
    metadata.pop(MODEL_KEY, None)
    reference = card["reference"]
    session = onnxruntime.InferenceSession(proto.SerializeToString(), providers=["CPUExecutionProvider"])
    feeds = (reference["rays"], reference["film_z_mm"][:1], [reference["stop_radius_mm"]])
    arrays = {name: np.asarray(feed, np.float32) for name, feed in zip(_INPUTS, feeds, strict=True)}
    scene, power, stop, status = session.run(_OUTPUTS, arrays)
    same = status == np.asarray(reference["status"])
    columns = {
        "rays": arrays["rays"],
        "film_z_mm": np.asarray(reference["film_z_mm"]),
        "scene_ray": scene,
        "transmittance": power,
        "stop_xy_mm": stop,
        "status": status,
    }
    card["reference"] = {**reference, **{name: column[..., same].tolist() for name, column in columns.items()}}
    card["fit"] = {**card["fit"], "precision": precision}
    card["errors"] = errors
    helper.set_model_props(proto, {**metadata, CARD_KEY: card_to_json(card)})
