"""The exact lens as a graph, from which C is written: the best that tracing can do, with which surrogates are compared.

The surfaces are those of the tracer (`surfaces`), and so is the power that arrives (`transmission`).
"""

from __future__ import annotations

from neurolens.base import status as st
from neurolens.graph.ir import Graph, Value
from neurolens.lens.prescription import Lens, Surface
from neurolens.trace.arithmetic import Graphs, is_number, times
from neurolens.trace.coatinggraph import GraphLosses
from neurolens.trace.shapes import figure_of
from neurolens.trace.surfaces import Met, Rays, Test, cross, media, radius2
from neurolens.trace.transmission import Passage

TRANSMITTANCE = (
    "Transmittance: of unpolarised light, with the polarisation that surfaces give to it, coatings and absorption."
)


def exact_graph(
    lens: Lens, pupil_z_mm: float, wavelength_nm: tuple[float, float], *, whole: bool = True, path: bool = False
) -> Graph:
    """Film and pupil points in, scene ray and status out: inputs and outputs are those of a model's graph.

    Args:
        pupil_z_mm: plane of the pupil points. wavelength_nm: range of the light, for coatings and absorption; a single
            wavelength fixes the indices.
        whole: with stop, rims and transmittance; else the ray alone, and whether it gets through.
        path: an output more, `path` [2 K]: z and y of the crossing with each surface, that next to the film first.
    """
    tracing = _Tracing(lens, pupil_z_mm, wavelength_nm, whole)
    if path:
        tracing.graph.outputs["path"] = tracing.graph.concat(*tracing.crossings)
    return tracing.graph


class _Tracing:
    def __init__(self, lens: Lens, pupil_z_mm: float, wavelength_nm: tuple[float, float], whole: bool) -> None:
        self.lens, self.whole = lens, whole
        self.graph = g = Graph()
        self.o = Graphs(g)
        rays, film_z = g.input("rays", 5), g.input("film_z_mm", per_call=True)
        stop_radius = g.input("stop_radius_mm", per_call=True) if whole else None
        self.stop_square = None if stop_radius is None else stop_radius * stop_radius
        single = wavelength_nm[0] == wavelength_nm[1]
        self.media = media(lens, wavelength_nm[0] if single else rays[4])
        self.power = Passage(self.o, lens, GraphLosses(lens, rays[4], wavelength_nm)) if whole else None
        self.tests: list[tuple[Test, int]] = []  # in the order in which rays meet them, with their codes
        self.at_stop = rays[0:2]
        self.crossings: list[Value] = []
        d = rays[2] - rays[0], rays[3] - rays[1], pupil_z_mm - film_z
        # Directions are multiplied by the index of the medium, see `surfaces`.
        scale = times(1.0 / self.o.dot(d, d).sqrt(), self.media[-1].n)
        self.rays = Rays(rays[0], rays[1], film_z, *(c * scale for c in d))
        self._through()

    def _through(self) -> None:
        g, lens = self.graph, self.lens
        last = len(lens.surfaces) - 1
        moving = {i for state in lens.configurations for i, _ in state.thickness_mm}
        for k in range(last, -1, -1):
            # Gaps as the lens has them: those that are equal stay so in every state of a zoom.
            gap = float(lens.surfaces[k].thickness_mm) if k < last else -float(lens.vertices_mm[k])
            # A gap that moves may happen to equal another number in one state alone: its label keeps the nodes apart.
            label = [f"gap {k}"] if k in moving else []
            step, z = g.constant(gap, *label), self.rays.z
            # Behind a plane z is the number 0, and a sum of two numbers would lose its label.
            self.rays = self.rays._replace(z=step if z.node.kind == "constant" else z + step)
            self._surface(k, lens.surfaces[k])
            self.crossings += [self.rays.z + float(lens.vertices_mm[k]), self.rays.y]
        n = self.media[0].n
        directions = self.rays[3:] if is_number(n) and n == 1 else [d * (1 / n) for d in self.rays[3:]]
        g.outputs["scene_ray"] = g.concat(*(g.value(v) for v in (*self.rays[:3], *directions)))
        if self.power is not None:
            g.outputs |= {"transmittance": self.power.arrived(self.rays.x), "stop_xy_mm": self.at_stop}
        tests, codes = zip(*self.tests, strict=True) if self.tests else ((), ())
        g.outputs["status"] = g.first_failure([(g.value(a), g.value(b)) for a, b in tests], codes).whole()

    def _surface(self, k: int, s: Surface) -> None:
        before, after = self.media[k + 1], self.media[k]
        r, figure = self.rays, figure_of(s, float)
        rim = self._opening if s.stop or not self.whole else None
        met, bent, tests = cross(self.o, s, figure, r, -1, before, after, rim=rim)
        self.tests += [(test, st.blocked(k, reason)) for some, reason in tests for test in some]
        if s.stop:
            self.at_stop = self.graph.concat(met.x, met.y)
        if self.power is not None:
            self.power.pass_surface(k, r, met, bent.q, (before, after), -1)
        self.rays = bent.rays

    def _opening(self, met: Met) -> list[Test]:
        """The test of the stop, whose radius is a number of the call; none where only the ray is wanted."""
        return [] if self.stop_square is None else [(radius2(self.o, met), self.stop_square)]
