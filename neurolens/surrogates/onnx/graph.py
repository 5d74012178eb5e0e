"""Writing ONNX graphs node by node: constants held once, names made up, rays on the last axis throughout."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from onnx import ModelProto, NodeProto, TensorProto, checker, helper, numpy_helper

from neurolens.base.errors import InputError

# Opset 17 and IR 8 are read by every onnxruntime since 1.12.
OPSET, IR_VERSION = 17, 8
FLOAT, INT32 = TensorProto.FLOAT, TensorProto.INT32


class Graph:
    """A graph under construction. Values are named by the strings that `op` returns."""

    def __init__(self) -> None:
        self.nodes: list[NodeProto] = []
        self.constants: dict[tuple[bytes, str, tuple[int, ...]], str] = {}
        self.tensors: list[TensorProto] = []
        self._made: dict[tuple[str, ...], str] = {}

    def op(self, kind: str, *inputs: str, out: str | None = None, **attributes: Any) -> str:
        """Append a node with one output and return its name."""
        name = out or f"{kind}_{len(self.nodes)}"
        self.nodes.append(helper.make_node(kind, list(inputs), [name], name=f"n{len(self.nodes)}", **attributes))
        return name

    def once(self, kind: str, *inputs: str) -> str:
        """As `op`, but the same node of the same inputs is appended once only."""
        key = (kind, *inputs)
        if key not in self._made:
            self._made[key] = self.op(kind, *inputs)
        return self._made[key]

    def several(self, kind: str, inputs: Sequence[str], outputs: Sequence[str], **attributes: Any) -> None:
        """Append a node with several outputs."""
        self.nodes.append(helper.make_node(kind, inputs, outputs, name=f"n{len(self.nodes)}", **attributes))

    def const(self, value: ArrayLike, dtype: type = np.float32) -> str:
        """A constant, float32 unless told; equal ones are stored once."""
        array: NDArray[Any] = np.ascontiguousarray(np.asarray(value, dtype=dtype))
        if array.dtype.kind == "f" and not np.isfinite(array).all():
            raise InputError("export", "weights", "(NaN or infinity)", "finite numbers, in float32 too")
        key = (array.tobytes(), array.dtype.str, array.shape)
        if key not in self.constants:
            self.constants[key] = f"c{len(self.constants)}"
            self.tensors.append(numpy_helper.from_array(array, self.constants[key]))
        return self.constants[key]

    def split(self, value: str, rows: Sequence[int]) -> list[str]:
        """Cut [sum(rows), ...] along the first axis."""
        if len(rows) == 1:
            return [value]
        names = [f"split_{len(self.nodes)}_{i}" for i in range(len(rows))]
        inputs = [value, self.const(rows, np.int64)]
        self.nodes.append(helper.make_node("Split", inputs, names, name=f"n{len(self.nodes)}", axis=0))
        return names

    def concat(self, *values: str, out: str | None = None) -> str:
        """Stack along the first axis."""
        return values[0] if len(values) == 1 and out is None else self.op("Concat", *values, axis=0, out=out)

    def reshape(self, value: str, shape: Sequence[int], out: str | None = None) -> str:
        """A view of another shape; -1 stands for the number of rays."""
        return self.op("Reshape", value, self.const(shape, np.int64), out=out)

    def affine(self, weight: np.ndarray, value: str, bias: np.ndarray | None = None) -> str:
        """weight [M, K] @ value [K, N] + bias [M]."""
        if bias is None or not np.any(bias):
            return self.op("MatMul", self.const(weight), value)
        return self.op("Gemm", self.const(weight), value, self.const(np.asarray(bias)[:, None]))

    def model(
        self,
        inputs: Sequence[tuple[str, Sequence[int | str]]],
        outputs: Sequence[tuple[str, int, Sequence[int | str]]],
        metadata: dict[str, str],
    ) -> ModelProto:
        """The checked model: float inputs (name, shape), outputs (name, type, shape), metadata strings."""
        graph = helper.make_graph(
            self.nodes,
            "neurolens",
            [helper.make_tensor_value_info(name, FLOAT, list(shape)) for name, shape in inputs],
            [helper.make_tensor_value_info(name, kind, list(shape)) for name, kind, shape in outputs],
            self.tensors,
        )
        model = helper.make_model(
            graph, opset_imports=[helper.make_opsetid("", OPSET)], ir_version=IR_VERSION, producer_name="neurolens"
        )
        helper.set_model_props(model, metadata)
        checker.check_model(model, full_check=True)
        return model
