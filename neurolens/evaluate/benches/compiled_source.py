"""Written C headers compiled here by the system's compiler and called from Python, to time and to check them."""

from __future__ import annotations

import ctypes
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from neurolens.base.errors import InputError
from neurolens.evaluate.speed import Call, Unavailable
from neurolens.graph import compiler
from neurolens.graph.c import Signature, write_c
from neurolens.graph.compiler import FLAGS, compile_c
from neurolens.graph.program import Program

_NAME = "lens"


def find_compiler() -> str:
    """A C compiler: $CC, else cc, gcc or clang.

    Raises:
        Unavailable: none is there.
    """
    try:
        return compiler.find_compiler()
    except InputError as error:
        raise Unavailable("no C compiler (looked for $CC, cc, gcc, clang)") from error


class CompiledSource:
    """A program as a shared library in a temporary folder of its own.

    Raises:
        Unavailable: there is no compiler, or it fails; the message says how.
    """

    def __init__(self, program: Program, flags: tuple[str, ...] = FLAGS) -> None:
        self.signature = Signature.of(program, _NAME)
        self._folder = tempfile.TemporaryDirectory(prefix="neurolens-source-")
        folder = Path(self._folder.name)
        library = folder / "lens.so"
        text = write_c(program, _NAME, ["A model on the clock."]) + self._wrapper()
        find_compiler()
        try:
            self.warnings = compile_c(text, library, flags)
        except InputError as error:
            raise Unavailable(str(error)) from error
        self._run = ctypes.CDLL(str(library)).neurolens_run
        self._run.argtypes, self._run.restype = [ctypes.c_size_t, ctypes.c_void_p], None

    def _wrapper(self) -> str:
        """All arguments as one array of pointers: ctypes takes long over each argument."""
        s = self.signature
        kinds = ["(const float *)a[{}]"] * len(s.per_ray) + ["*(const float *)a[{}]"] * len(s.per_call)
        kinds += ["*(const int *)a[{}]"] * (s.bands > 1) + ["(float *)a[{}]"] * len(s.outputs) + ["(int *)a[{}]"]
        given = ", ".join(kind.format(i) for i, kind in enumerate(kinds))
        return f"void neurolens_run(size_t n, void **a) {{ {_NAME}_rays(n, {given}); }}\n"

    def outputs(self, count: int) -> dict[str, NDArray[Any]]:
        """Arrays for the results of so many rays."""
        found: dict[str, NDArray[Any]] = {name: np.empty(count, np.float32) for name in self.signature.outputs}
        return {**found, "status": np.empty(count, np.int32)}

    def prepared(self, inputs: Mapping[str, ArrayLike], out: Mapping[str, NDArray[Any]], band: int = 0) -> Call:
        """A call that computes rays into `out`; inputs by name, arrays [N] or numbers, others are passed over."""
        s = self.signature
        count = len(out["status"])
        arrays = [np.ascontiguousarray(inputs[name], np.float32) for name in (*s.per_ray, *s.per_call)]
        if any(a.shape != (count,) for a in arrays[: len(s.per_ray)]):
            raise ValueError("inputs and outputs of one length expected")
        arrays += [np.array([band], np.int32)] if s.bands > 1 else []
        arrays += [*(out[name] for name in s.outputs), out["status"]]
        pointers = (ctypes.c_void_p * len(arrays))(*(a.ctypes.data for a in arrays))
        run, size = self._run, ctypes.c_size_t(count)

        def call(kept: Any = arrays) -> None:
            run(size, pointers)

        return call

    def rays(self, inputs: Mapping[str, ArrayLike], band: int = 0) -> dict[str, NDArray[Any]]:
        """Results of rays, by name, status among them."""
        out = self.outputs(len(np.asarray(inputs[self.signature.per_ray[0]])))
        self.prepared(inputs, out, band)()
        return out
