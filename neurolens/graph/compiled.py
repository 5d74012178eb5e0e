"""Graphs that run as compiled C on arrays of rays."""

import ctypes
from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from neurolens.base.errors import InputError
from neurolens.graph.c import Signature, write_blocks
from neurolens.graph.compiler import load_compiled
from neurolens.graph.ir import Graph
from neurolens.graph.program import Program, row_names
from neurolens.graph.scalars import lower

FloatArray = NDArray[np.float32]
# Programs of more steps are not compiled. gcc 12 takes 48 s for 7100 steps in one loop, and its time grows faster than
# their number; in parts (`PartWriter`) 20 s for 18,000: the gradients of an exact lens of 56 refractions.
MAX_STEPS, MAX_STEPS_IN_PARTS = 12_000, 24_000


class CompiledGraph:
    """Runs a program as a compiled function.

    Args:
        program: what is compiled, with a status.
        rows: how many rows each result has, which the program gives one by one.
        numbers: inputs of a whole call.
        table: that lookups read; without one the program has none.

    Attributes:
        numbers: inputs of a whole call, in their order; they may be changed.
        rows: rows and kind of each result.
    """

    def __init__(
        self, program: Program, rows: Mapping[str, int], numbers: dict[str, float], table: FloatArray | None = None
    ) -> None:
        most = MAX_STEPS_IN_PARTS if program.waits() else MAX_STEPS
        if len(program.steps) > most:
            raise InputError("compiled camera", "steps", len(program.steps), f"up to {most} for a compiler")
        self.rows = {name: (count, np.int32 if name == "status" else np.float32) for name, count in rows.items()}
        self._signature = s = Signature.of(program, "camera")
        self.numbers = np.array([numbers[name] for name in s.per_call], np.float32)
        self._table = np.zeros((1, 1, 8), np.float32) if table is None else table
        self._call = load_compiled(write_blocks(program, "camera")).camera
        pointer = ctypes.c_void_p
        self._call.argtypes = [ctypes.c_size_t, pointer, pointer, pointer, ctypes.c_int, pointer, pointer]
        self._call.restype = None

    @classmethod
    def of(cls, graph: Graph, numbers: dict[str, float], table: FloatArray | None = None) -> Self:
        """Compile the program of a graph."""
        rows = {name: value.rows for name, value in graph.outputs.items()}
        return cls(lower(graph).in_order_of_need(), rows, numbers, table)

    def __call__(
        self, rays: dict[str, FloatArray], into: Mapping[str, FloatArray] | None = None
    ) -> dict[str, NDArray[Any]]:
        """Return the results [R, N] for inputs [R, N]; those in `into` are written there."""
        found = self.room(next(iter(rays.values())).shape[1], into or {})
        self.prepared(rays, found)()
        return found

    def room(self, count: int, given: Mapping[str, NDArray[Any]] = MappingProxyType({})) -> dict[str, NDArray[Any]]:
        """Return arrays [R, count] for the results, the given ones among them."""
        missing = {name: shape for name, shape in self.rows.items() if name not in given}
        return {**given, **{name: np.empty((rows, count), kind) for name, (rows, kind) in missing.items()}}

    def prepared(self, rays: Mapping[str, FloatArray], found: Mapping[str, NDArray[Any]]) -> Callable[[], object]:
        """Return a call that computes the results of rays into their arrays, all of which stay in place until then."""
        places: dict[str, int] = {}
        for name, array in (*rays.items(), *found.items()):
            address, step = array.ctypes.data, array.strides[0]
            places |= {row: address + k * step for k, row in enumerate(row_names(name, len(array)))}
        given, out = (
            np.array([places[r] for r in rows], np.uintp) for rows in (self._signature.per_ray, self._signature.outputs)
        )
        count, table = next(iter(rays.values())).shape[1], self._table

        def call(kept: Any = (rays, found)) -> None:
            numbers, cells = self.numbers.ctypes.data, len(table)
            self._call(count, given.ctypes.data, numbers, table.ctypes.data, cells, out.ctypes.data, places["status"])

        return call
