"""The surfaces of a lens as compiled steps: which function each needs, and its numbers at a wavelength."""

from __future__ import annotations

import ctypes
from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from neurolens.base.errors import InputError
from neurolens.flare.steps import CALL, DEGREE, STATE, Action, Kind, film_graph, reflectance_fit, seen, step_graph
from neurolens.graph.c import Signature, write_c
from neurolens.graph.compiler import load_compiled
from neurolens.graph.ir import Graph
from neurolens.graph.scalars import lower
from neurolens.optics import glass
from neurolens.optics.prescription import Lens
from neurolens.optics.sag import same_medium
from neurolens.optics.shapes import is_plain

Floats = NDArray[np.float32]
WIDTH = len(CALL) + DEGREE + 1
# What a step may do, by its place: refract light that goes to the film (0) or back (1), reflect it (2, 3).
ACTIONS: tuple[tuple[Action, int], ...] = (("T", 1), ("T", -1), ("R", 1), ("R", -1))
Place = tuple[int, int]  # surface and action


class Stack:
    """A lens at its focus, zoom and stop.

    Args:
        lens: its film must be placed (`Lens.at`).
        places: the surfaces and actions that are needed; each kind of surface takes a moment to compile.

    Attributes:
        functions: [surfaces, actions] int32, the number of the compiled function, -1 where there is none.
        fit_error: the largest relative error of a coating's fitted reflectance so far; see `steps.reflectance_fit`.

    Raises:
        InputError: a lens without film position.
    """

    def __init__(self, lens: Lens, places: Iterable[Place]) -> None:
        if lens.film_z_mm is None:
            raise InputError(lens.path, "film_z_mm", None, "a focused lens (Lens.at)")
        self.lens, self.fit_error = lens, 0.0
        kinds = {place: self._kind(*place) for place in sorted(places)}
        self._kinds = tuple(dict.fromkeys(kinds.values()))
        self.functions = np.full((len(lens.surfaces), len(ACTIONS)), -1, np.int32)
        for place, kind in kinds.items():
            self.functions[place] = self._kinds.index(kind)

    def compiled(self, driver: str, name: str) -> ctypes._NamedFuncPointer:
        """A C function `name` of a text that goes through the steps: see `_HEAD` for what it finds.

        Raises:
            InputError: no C compiler, or one that fails.
        """
        text = ""
        for number, kind in enumerate(self._kinds):
            text += _function(step_graph(kind), f"step_{number}", f"run_{number}", "state", "after", "call")
        text += _function(film_graph(), "film", "run_film", "state", "film", "shift_mm")
        runs = ", ".join(f"run_{number}" for number in range(len(self._kinds)))
        head = _HEAD.format(runs=runs, state=STATE, width=WIDTH, actions=len(ACTIONS))
        call: ctypes._NamedFuncPointer = getattr(load_compiled(text + head + driver), name)
        call.restype = None
        return call

    def _kind(self, k: int, which: int) -> Kind:
        lens, s, (action, sense) = self.lens, self.lens.surfaces[k], ACTIONS[which]
        return Kind(
            action,
            None if is_plain(s) else seen(s, sense > 0),
            reflects(lens, k),
            bool(s.coating and s.coating.layers),
            any(t.glass is not None or t.absorption_per_mm for t in lens.surfaces),
            lens.aperture if s.stop else None,
        )

    def numbers(self, wavelength_nm: float) -> tuple[Floats, float]:
        """Numbers of the call [surfaces, actions, WIDTH] at a wavelength, and the last step's shift to the film."""
        lens, z = self.lens, [float(v) for v in self.lens.vertices_mm]
        n = [1.0, *(float(glass.index_of(s, wavelength_nm)) for s in lens.surfaces)]
        a = [0.0, *(float(glass.absorption_of(s, wavelength_nm) or 0.0) for s in lens.surfaces)]
        found = np.zeros((len(lens.surfaces), len(ACTIONS), WIDTH), np.float32)
        for k, s in enumerate(lens.surfaces):
            for which, (_, sense) in enumerate(ACTIONS):
                before, after = (k, k + 1) if sense > 0 else (k + 1, k)
                # The ray comes in the frame of the surface before; at the front and the rear in its own.
                gap = sense * (z[k] - z[k - sense]) if 0 <= k - sense < len(lens.surfaces) else 0.0
                curvature = -sense * float(s.curvature) if is_plain(s) else 0.0
                step = (n[after] - n[before]) * (n[after] + n[before])
                row = (gap, curvature, 1 / s.semi_diameter_mm**2, n[before], n[after], step, a[before])
                found[k, which, : len(CALL)] = row
                if s.coating and s.coating.layers:
                    fit, error = reflectance_fit(s.coating.layers, n[before], n[after], wavelength_nm, sense)
                    found[k, which, len(CALL) :] = fit
                    self.fit_error = max(self.fit_error, error)
        assert lens.film_z_mm is not None
        return found, float(lens.film_z_mm) - z[len(lens.surfaces) - 1]


def entering(rays: Floats) -> Floats:
    """States before the first surface: moved near the front vertex, mirrored."""
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
    return bool(coating and coating.layers) or not same_medium(lens.surfaces, k)


def _function(graph: Graph, name: str, run: str, taken: str, given: str, numbers: str) -> str:
    """A graph in C, and `run`: the same on pointers to rows, in the order of `flare.steps`."""
    program = lower(graph).in_order_of_need()
    s = Signature.of(program, name)

    def place(row: str, array: str, of: str) -> str:
        return f"{array}[{row.removeprefix(of + '_') if row != of else 0}]"

    arguments = [
        *(place(row, "in", taken) for row in s.per_ray),
        *(place(row, "call", numbers) for row in s.per_call),
        *(place(row, "out", given) for row in s.outputs),
    ]
    head = f"static void {run}(size_t n, const float *const *in, const float *call, float *const *out)"
    text = write_c(program, name, ["A step of flare."])
    return f"{text}\n{head}\n{{\n    (void)call;\n    {name}_rays(n, {', '.join(arguments)});\n}}\n"


# A driver calls `go`: the step of surface k on rows `stride` apart.
_HEAD = """
typedef void step(size_t, const float *const *, const float *, float *const *);
static step *const steps[] = {{ {runs} }};
enum {{ STATE = {state}, WIDTH = {width}, ACTIONS = {actions} }};

struct lens {{
    int surfaces;
    const int *functions;
    const float *numbers;
}};

static void go(struct lens lens, int k, int action, size_t n, const float *from, float *to, size_t stride)
{{
    const float *in[STATE];
    float *out[STATE];
    for (int r = 0; r < STATE; r++) {{
        in[r] = from + r * stride;
        out[r] = to + r * stride;
    }}
    const int at = ACTIONS * k + action;
    steps[lens.functions[at]](n, in, lens.numbers + at * WIDTH, out);
}}

/* x, y, power and worst of light that meets the film. */
static void meet_film(size_t n, const float *from, size_t stride, float shift, float *to, size_t apart)
{{
    const float *in[STATE];
    float *out[4];
    for (int r = 0; r < STATE; r++)
        in[r] = from + r * stride;
    for (int r = 0; r < 4; r++)
        out[r] = to + r * apart;
    run_film(n, in, &shift, out);
}}
"""
