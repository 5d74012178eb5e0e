"""Sessions of onnxruntime with the inputs and outputs that are expected, and no others; errors are ours."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import onnxruntime
from numpy.typing import NDArray

from neurolens.base.errors import ModelError


def open_session(
    path: Path, data: bytes, threads: int, inputs: dict[str, tuple[Any, ...]], outputs: dict[str, tuple[Any, ...]]
) -> Any:
    """A session of onnxruntime on the CPU.

    Raises:
        ModelError: onnxruntime cannot load the bytes, or inputs or outputs are others than those expected: by name the
            type, then the dimensions, None for the number of rays.
    """
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = threads
    options.inter_op_num_threads = 1
    options.log_severity_level = 4  # what goes wrong is raised, not printed
    try:
        session = onnxruntime.InferenceSession(data, options, providers=["CPUExecutionProvider"])
        inside = [_shapes(session.get_inputs()), _shapes(session.get_outputs())]
    except Exception as error:  # onnxruntime raises types of its own, without a common base
        raise ModelError(f"{path}: onnxruntime cannot load it ({_first_line(error)})") from error
    for what, expected, shapes in zip(("input", "output"), (inputs, outputs), inside, strict=True):
        if shapes != expected:
            raise ModelError(f"{path}: {what}s: got {shapes}, expected {expected} (None: the number of rays)")
    return session


def _shapes(tensors: Any) -> dict[str, tuple[Any, ...]]:
    """Type and dimensions by name; a dimension that has a name is None. A name that is no UTF-8 raises an error."""
    return {v.name: (v.type, *(None if isinstance(d, str) else d for d in v.shape)) for v in tensors}


def joined(
    models: Sequence[Any], constants: Mapping[str, Any], outputs: Sequence[str], renamed: Mapping[str, str]
) -> bytes:
    """Models after one another as one: an input takes what an earlier one gives, or is given, under its name.

    Args:
        models: of the package onnx, or their bytes.
        constants: inputs that become numbers. outputs: wanted of all that the models give.
        renamed: what models give, where a later one takes it under another name.

    Raises:
        ModelError: models of several operator sets.
    """
    import onnx  # takes a quarter of a second
    from onnx import helper, numpy_helper

    parts = [onnx.load_from_string(m) if isinstance(m, bytes) else m for m in models]
    if len(versions := {tuple((o.domain, o.version) for o in part.opset_import) for part in parts}) > 1:
        raise ModelError(f"operator sets {sorted(versions)}: a camera needs a model of the one that neurolens writes")
    graph, known = onnx.GraphProto(name="camera"), dict[str, Any]()  # what is given: a name here, and its description
    for k, part in enumerate(parts):
        names = {"": ""}  # of the part: names here
        for value in part.graph.input:
            name, kind = value.name, value.type.tensor_type.elem_type
            if name not in known:
                known[name] = name, value
                if name in constants:
                    graph.initializer.append(numpy_helper.from_array(np.array(constants[name], np.float32), name))
                else:
                    graph.input.append(value)
            names[name], given = known[name]
            if given.type.tensor_type.elem_type != kind:
                graph.node.append(helper.make_node("Cast", [names[name]], [f"{k}_{name}_cast"], to=kind))
                names[name] = f"{k}_{name}_cast"
        for tensor in part.graph.initializer:
            names[tensor.name] = tensor.name = f"{k}_{tensor.name}"
            graph.initializer.append(tensor)
        for node in part.graph.node:
            names |= {name: f"{k}_{name}" for name in node.output}
            node.name, node.input[:], node.output[:] = (
                f"{k}_{node.name}",
                [names[i] for i in node.input],
                [names[o] for o in node.output],
            )
            graph.node.append(node)
        last = part is parts[-1]
        known |= {v.name if last else renamed.get(v.name, v.name): (names[v.name], v) for v in part.graph.output}
    for name in outputs:
        graph.node.append(helper.make_node("Identity", [known[name][0]], [name]))
        graph.output.append(known[name][1])
    whole = helper.make_model(graph, opset_imports=parts[0].opset_import, ir_version=parts[0].ir_version)
    return bytes(whole.SerializeToString())


def run_batches(
    path: Path,
    session: Any,
    outputs: Sequence[str],
    rays: Mapping[str, NDArray[np.float32]],
    call: Mapping[str, Any],
    batch: int,
) -> list[NDArray[Any]]:
    """The outputs for any number of rays, which are the last axis of all of them.

    Args:
        rays: inputs [K, N]. call: the other inputs, the same for all rays.
        batch: rays a call of onnxruntime, at most.

    Raises:
        ModelError: onnxruntime cannot run the model `path`.
    """
    count = next(iter(rays.values())).shape[1]
    numbers = {name: np.atleast_1d(np.asarray(value, np.float32)) for name, value in call.items()}
    # Calls of about the same size: few rays cost nearly as much as many.
    ends = np.linspace(0, count, max(1, -(-count // batch)) + 1).astype(int)
    parts = []
    for start, end in zip(ends[:-1], ends[1:], strict=True):
        feeds = {name: _padded(columns[:, start:end]) for name, columns in rays.items()} | numbers
        try:
            done = session.run(list(outputs), feeds)
        except Exception as error:  # onnxruntime raises types of its own, without a common base
            raise ModelError(f"{path}: onnxruntime cannot run it ({_first_line(error)})") from error
        parts.append([values[..., : end - start] for values in done])
    return parts[0] if len(parts) == 1 else [np.concatenate(of_one, -1) for of_one in zip(*parts, strict=True)]


def _padded(values: NDArray[np.float32]) -> NDArray[np.float32]:
    """The same columns [R, N] and further ones of zeros where N would make onnxruntime slow.

    Rows a power of two apart share cache lines, which makes matrix products a third slower.
    """
    rows, count = values.shape
    whole = np.zeros((rows, count + 16 if count % 1024 == 0 else count), np.float32)
    whole[:, :count] = values
    return whole


def _first_line(error: Exception) -> str:
    return (str(error).splitlines() or [type(error).__name__])[0]
