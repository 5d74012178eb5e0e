"""Programs as compiled C by the very text that `neurolens export` writes, with any flags, to be tested and timed."""

import ctypes
from collections.abc import Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from neurolens.base.errors import InputError
from neurolens.base.files import TemporaryFolder
from neurolens.graph.c import Signature, in_double, literal, write_blocks, write_c, write_double
from neurolens.graph.compiler import FLAGS, compile_c
from neurolens.graph.program import Program
from neurolens.models.fitted import Domain, FilmRays
from neurolens.studies.speed import FUSED_BATCHES, Call, Candidate, Unavailable


class CompiledSource:
    """A program as a shared library in a temporary folder of its own.

    Args:
        double: whether it computes in double precision, which is not for programs with lookups.
        state: of a program with a mixture, its numbers.

    Raises:
        Unavailable: there is no compiler, or it fails; the message says how.
    """

    def __init__(
        self, program: Program, flags: tuple[str, ...] = FLAGS, double: bool = False, state: Sequence[float] = ()
    ) -> None:
        self.signature, self._real = Signature.of(program, "lens"), np.float64 if double else np.float32
        self._folder = TemporaryFolder()
        library = Path(self._folder.name) / "lens.so"
        blocks = bool(program.own_tables)  # functions with lookups: loops over arrays do these apart
        if double:
            text = write_double(program, "lens", ["A timed model."]) + in_double(self._wrapper(False, state))
        else:
            text = write_blocks(program, "lens") if blocks else write_c(program, "lens", ["A timed model."])
            text += self._wrapper(blocks, state)
        try:
            self.warnings = compile_c(text, library, flags)
        except InputError as error:
            raise Unavailable(str(error)) from error
        self._run = ctypes.CDLL(str(library)).neurolens_run
        self._run.argtypes, self._run.restype = [ctypes.c_size_t, ctypes.c_void_p], None

    def _wrapper(self, blocks: bool, state: Sequence[float]) -> str:
        """Write a function that takes all arguments as one array of pointers, for ctypes is slow for each argument."""
        s = self.signature
        if blocks:
            first = len(s.per_ray)
            call, out = ", ".join(f"*(const float *)a[{k}]" for k in range(first, len(s.inputs))), len(s.inputs)
            given = f"(const float *const *)a, call, lens_table, lens_table_cells, (float *const *)(a + {out})"
            body = f"const float call[] = {{{call}}}; lens(n, {given}, (int *)a[{out + len(s.outputs)}]);"
            return f"void neurolens_run(size_t n, void **a) {{ {body} }}\n"
        kinds = ["(const float *)a[{}]"] * len(s.per_ray) + ["*(const float *)a[{}]"] * len(s.per_call)
        kinds += ["*(const int *)a[{}]"] * (s.bands > 1) + ["(float *)a[{}]"] * len(s.outputs) + ["(int *)a[{}]"]
        arguments, made = [kind.format(i) for i, kind in enumerate(kinds)], ""
        if s.state:
            arguments.insert(len(s.inputs), "&state")
            numbers = ", ".join(literal(v) for v in state)
            made = f"static lens_state state; if (!state.inside) state = lens_at({numbers}); "  # once
        return f"void neurolens_run(size_t n, void **a) {{ {made}lens_rays(n, {', '.join(arguments)}); }}\n"

    def outputs(self, count: int) -> dict[str, NDArray[Any]]:
        """Return arrays for the results of `count` rays."""
        found: dict[str, NDArray[Any]] = {name: np.empty(count, self._real) for name in self.signature.outputs}
        return {**found, "status": np.empty(count, np.int32)}

    def prepared(self, inputs: Mapping[str, ArrayLike], out: Mapping[str, NDArray[Any]], band: int = 0) -> Call:
        """Return a call that computes rays into `out`; inputs go by name, arrays [N] or numbers, others are ignored."""
        s = self.signature
        count = len(out["status"])
        arrays = [np.ascontiguousarray(inputs[name], self._real) for name in (*s.per_ray, *s.per_call)]
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
        """Return the results of rays by name, the status among them."""
        out = self.outputs(len(np.asarray(inputs[self.signature.per_ray[0]])))
        self.prepared(inputs, out, band)()
        return out


def program_candidate(
    name: str, program: Program, domain: Domain, stop_radius_mm: float | None = None, flags: tuple[str, ...] = FLAGS,
    double: bool = False,
) -> Candidate:  # fmt: skip
    """Return a program of `models.source` as a candidate, which is compiled when the race prepares it.

    Args:
        stop_radius_mm: None takes the stop of the domain.
    """
    compiled = cache(lambda: CompiledSource(program, flags, double))

    @cache
    def room(count: int) -> dict[str, NDArray[Any]]:
        """Return memory for outputs, which one pass after another uses, as tracers and onnxruntime do with theirs."""
        return compiled().outputs(count)

    def prepare(rays: FilmRays) -> Call:
        names = ("film_x_mm", "film_y_mm", "film_z_mm", "pupil_x_mm", "pupil_y_mm", "wavelength_nm")
        columns: dict[str, Any] = {n: c.numpy().astype(np.float32) for n, c in zip(names, rays.columns(), strict=False)}
        columns["film_z_mm"] = columns["film_z_mm"][0]
        columns["stop_radius_mm"] = np.float32(domain.stop_radius_mm if stop_radius_mm is None else stop_radius_mm)
        return compiled().prepared(columns, room(len(rays)))

    return Candidate(name, prepare, FUSED_BATCHES)
