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
    except Exception as error:  # onnxruntime raises types of its own, without a common base
        raise ModelError(f"{path}: onnxruntime cannot load it ({_first_line(error)})") from error
    for what, expected, found in (("input", inputs, session.get_inputs()), ("output", outputs, session.get_outputs())):
        shapes = {v.name: (v.type, *(None if isinstance(d, str) else d for d in v.shape)) for v in found}
        if shapes != expected:
            raise ModelError(f"{path}: {what}s: got {shapes}, expected {expected} (None: the number of rays)")
    return session


def run_session(
    path: Path, session: Any, outputs: Sequence[str], feeds: Mapping[str, NDArray[np.float32]]
) -> list[NDArray[Any]]:
    """The outputs asked for.

    Raises:
        ModelError: onnxruntime cannot run the model `path`.
    """
    try:
        found: list[NDArray[Any]] = session.run(list(outputs), dict(feeds))
    except Exception as error:  # onnxruntime raises types of its own, without a common base
        raise ModelError(f"{path}: onnxruntime cannot run it ({_first_line(error)})") from error
    return found


def run_batches(
    path: Path,
    session: Any,
    outputs: Sequence[str],
    rays: tuple[str, NDArray[np.float32]],
    call: Mapping[str, float],
    batch: int,
) -> list[NDArray[Any]]:
    """The outputs for any number of rays.

    Args:
        rays: name of the input, and its columns [K, N]. call: the other inputs, a number each.
        batch: rays a call of onnxruntime.

    Raises:
        ModelError: as of `run_session`.
    """
    name, columns = rays
    numbers = {key: np.array([value], np.float32) for key, value in call.items()}
    parts = [
        run_session(path, session, outputs, {name: np.ascontiguousarray(columns[:, i : i + batch]), **numbers})
        for i in range(0, max(columns.shape[1], 1), batch)
    ]
    return [np.concatenate(of_one, -1) for of_one in zip(*parts, strict=True)]


def _first_line(error: Exception) -> str:
    return (str(error).splitlines() or [type(error).__name__])[0]
