"""The surfaces of a lens as compiled steps: the function that each surface needs, and its numbers at a wavelength."""

from __future__ import annotations

import ctypes
import hashlib
from collections.abc import Iterable, Mapping
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from neurolens.base.errors import InputError
from neurolens.flare.steps import (
    ACROSS,
    CALL,
    FIGURE,
    PLAIN,
    STATE,
    Action,
    Kind,
    Shape,
    figure_numbers,
    film_graph,
    reflectance_fit,
    step_graph,
)
from neurolens.graph.c import Signature, write_c
from neurolens.graph.compiler import c_source, load_compiled
from neurolens.graph.ir import Graph
from neurolens.graph.scalars import lower
from neurolens.lens import glass
from neurolens.lens.prescription import Lens
from neurolens.trace.sag import same_medium
from neurolens.trace.shapes import figure_of, is_plain

Floats = NDArray[np.float32]
# Actions of a step: refract light that travels to the film (0) or back (1), reflect such light (2, 3).
ACTIONS: tuple[tuple[Action, int], ...] = (("T", 1), ("T", -1), ("R", 1), ("R", -1))
Place = tuple[int, int]  # surface and action
NONE: Mapping[str, Graph] = {}
_MASKS: dict[str, Floats] = {}  # masks of stops, which compiled code points at as long as it is loaded


class Stack:
    """A lens at its focus, zoom and stop.

    Args:
        lens: its film must be placed (`set_lens`).
        places: the surfaces and actions that are needed; each kind of surface takes a moment to compile.

    Attributes:
        functions: [surfaces, actions] int32, the number of the compiled function, -1 where there is none.
        fit_error: the largest relative error of a coating's fitted reflectance so far; see `steps.reflectance_fit`.

    Raises:
        InputError: a lens without film position; one with ideal surfaces, which reflect nothing.
    """

    def __init__(self, lens: Lens, places: Iterable[Place]) -> None:
        if lens.film_z_mm is None:
            raise InputError(lens.path, "film_z_mm", None, "a focused lens (set_lens)")
        lens.require_glass("reflections, of which flare is made")
        self.lens, self.fit_error = lens, 0.0
        # All aspheres of a sort get the degree of the highest one, so that they share functions.
        self._figures = {k: figure_of(s, float) for k, s in enumerate(lens.surfaces) if not is_plain(s)}
        figures = self._figures.values()
        most = {even: max([0, *(len(f.terms) for f in figures if f.even == even)]) for even in (True, False)}
        self._terms = {k: most[f.even] if f.terms else 0 for k, f in self._figures.items()}
        self.width = PLAIN + len(FIGURE) + ACROSS + max(most.values())
        kinds = {place: self._kind(*place) for place in sorted(places)}
        self._kinds = tuple(dict.fromkeys(kinds.values()))
        self.functions = np.full((len(lens.surfaces), len(ACTIONS)), -1, np.int32)
        for place, kind in kinds.items():
            self.functions[place] = self._kinds.index(kind)

    def compiled(self, driver: str, name: str, more: Mapping[str, Graph] = NONE) -> ctypes._NamedFuncPointer:
        """The function `name` of a C text that calls the steps by `go` of `stack.c`.

        Args:
            driver: the text. more: graphs that it can call as run_NAME, with the input `row`, numbers `call` and the
                output `event`.

        Raises:
            InputError: no C compiler, or one that fails.
        """
        mask = self.lens.aperture.table if self.lens.aperture and self.lens.aperture.mask is not None else None
        key = "" if mask is None else hashlib.sha256(mask.tobytes()).hexdigest()
        text = "" if mask is None else c_source("flare/mask.c", MASK=key)
        for number, kind in enumerate(self._kinds):
            text += function_text(step_graph(kind), f"step_{number}", f"run_{number}", "state", "after", "call")
        text += function_text(film_graph(), "film", "run_film", "state", "film", "shift_mm")
        for called, graph in more.items():
            text += function_text(graph, called, f"run_{called}", "row", "event", "call")
        runs = ", ".join(f"run_{number}" for number in range(len(self._kinds)))
        head = c_source("flare/stack.c", STEPS=runs, STATE=STATE, WIDTH=self.width, ACTIONS=len(ACTIONS))
        library = load_compiled(text + head + driver)
        if mask is not None:
            kept = _MASKS.setdefault(key, mask)
            library.take_mask(ctypes.c_void_p(kept.ctypes.data), len(kept))
        call: ctypes._NamedFuncPointer = getattr(library, name)
        call.restype = None
        return call

    def _kind(self, k: int, which: int) -> Kind:
        lens, s, f = self.lens, self.lens.surfaces[k], self._figures.get(k)
        return Kind(
            ACTIONS[which][0],
            None if f is None else Shape(self._terms[k], f.even, f.steps, f.bent, bool(f.across), f.turned),
            reflects(lens, k),
            bool(s.coating and s.coating.layers),
            any(t.glass is not None or t.absorption_per_mm for t in lens.surfaces),
            lens.aperture if s.stop else None,
        )

    @lru_cache(maxsize=64)  # noqa: B019  it keeps a few stacks, which are small
    def numbers(self, wavelength_nm: float) -> tuple[Floats, float]:
        """Numbers of all steps at a wavelength, [surfaces, actions, width]; mm from the last surface to the film."""
        lens, z = self.lens, [float(v) for v in self.lens.vertices_mm]
        n = [float(glass.index_of(medium, wavelength_nm)) for medium in lens.media]
        a = [0.0, *(float(glass.absorption_of(s, wavelength_nm) or 0.0) for s in lens.surfaces)]
        found = np.zeros((len(lens.surfaces), len(ACTIONS), self.width), np.float32)
        for k, s in enumerate(lens.surfaces):
            for which, (_, sense) in enumerate(ACTIONS):
                before, after = (k, k + 1) if sense > 0 else (k + 1, k)
                # A ray arrives in the frame of the surface before; at the front and the rear in that of the surface.
                gap = sense * (z[k] - z[k - sense]) if 0 <= k - sense < len(lens.surfaces) else 0.0
                curvature = -sense * float(s.curvature)
                step = (n[after] - n[before]) * (n[after] + n[before])
                row = (gap, curvature, 1 / s.semi_diameter_mm**2, n[before], n[after], step, a[before])
                found[k, which, : len(CALL)] = row
                if k in self._figures:
                    figure = figure_numbers(self._figures[k], -sense)
                    found[k, which, PLAIN : PLAIN + len(figure)] = figure
                if s.coating and s.coating.layers and ACTIONS[which][0] == "R":
                    found[k, which, len(CALL) : PLAIN] = found[k, which - 2, len(CALL) : PLAIN]
                elif s.coating and s.coating.layers:
                    fit, error = reflectance_fit(s.coating.layers, n[before], n[after], wavelength_nm, sense)
                    found[k, which, len(CALL) : PLAIN] = fit
                    self.fit_error = max(self.fit_error, error)
        assert lens.film_z_mm is not None
        return found, float(lens.film_z_mm) - z[len(lens.surfaces) - 1]

    def reflectance(self, wavelength_nm: float) -> NDArray[np.float64]:
        """The reflectance of every surface at normal incidence, for light towards the film, [surfaces]."""
        numbers = self.numbers(wavelength_nm)[0][:, 0].astype(np.float64)
        n1, n2 = numbers[:, CALL.index("n_before")], numbers[:, CALL.index("n_after")]
        coated = [bool(s.coating and s.coating.layers) for s in self.lens.surfaces]
        return np.where(coated, numbers[:, len(CALL)].clip(1e-9, 1), ((n1 - n2) / (n1 + n2)) ** 2)


def entering(rays: Floats) -> Floats:
    """The states of rays [6, N] before the first surface: moved near the front vertex and mirrored, [STATE, N]."""
    given = np.asarray(rays, np.float64)
    if given.ndim != 2 or given.shape[0] != 6:
        raise InputError("flare", "rays", f"({given.shape})", "an array [6, N]")
    place, d = given[:3], given[3:]
    state = np.empty((STATE, given.shape[1]), np.float32)
    state[:3], state[3:6], state[6], state[7] = place - (place * d).sum(0) * d, d, 1, 0
    state[[2, 5]] *= -1
    return state


def reflects(lens: Lens, k: int) -> bool:
    """Whether surface k reflects any light: the medium changes there, or it is coated."""
    coating = lens.surfaces[k].coating
    return bool(coating and coating.layers) or not same_medium(lens.surfaces, k, lens.object_medium)


def function_text(graph: Graph, name: str, run: str, inputs: str, outputs: str, numbers: str) -> str:
    """The C text of a graph as a function `name`, and a function `run` that takes pointers to its rows.

    Args:
        inputs, outputs, numbers: the names of the graph's input rows, output rows and numbers of the call.
    """
    program = lower(graph).in_order_of_need()
    s = Signature.of(program, name)

    def place(row: str, array: str, of: str) -> str:
        return f"{array}[{row.removeprefix(of + '_') if row != of else 0}]"

    arguments = [
        *(place(row, "in", inputs) for row in s.per_ray),
        *(place(row, "call", numbers) for row in s.per_call),
        *(f"{table}, {table}_cells" for table in s.tables),
        *(place(row, "out", outputs) for row in s.outputs),
    ]
    head = f"static void {run}(size_t n, const float *const *in, const float *call, float *const *out)"
    text = write_c(program, name, ["A step of flare."])
    return f"{text}\n{head}\n{{\n    (void)call;\n    {name}_rays(n, {', '.join(arguments)});\n}}\n"
