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
