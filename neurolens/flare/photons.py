"""Photon-traced flare: light that is refracted or reflected by chance at every surface, with any number of reflections.

Keshmirian 2008: photons leave the lights, and each surface reflects one with the probability of its Fresnel or coating
reflectance; those that reach the film after reflections are its flare, smoothed by a kernel. Here they are aimed at the
front surface alone and weighted by the solid angle, and go through the compiled steps of `flare.stack` in sweeps: to
the film through all surfaces, back through all, with those that turn round kept at their surface for the next sweep. On
their way they may scatter (`flare.scatter`). No photon is lost to the books: what is cast arrives, leaves at the front,
ends at a rim, is absorbed, or is cut off.

Reflection may be chosen more often than it happens, by a boost b: with T the share that goes through, light turns round
with probability b (1 - T) / (T + b (1 - T)), and weights make up for it. b = 2 is Steinert's choice (2009, 5.3.2), who
lets light through with probability T^2, but for terms in (1 - T)^2. `PhotonTracer.turning` is less noisy: of the
surfaces ahead one is chosen, by its reflectance.
"""

from __future__ import annotations

import ctypes
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from neurolens.base.errors import InputError
from neurolens.flare.scatter import CHANCES, NUMBERS, film_scatter_graph, scatter_graph, scatter_numbers
from neurolens.flare.stack import Floats, Place, Stack, entering, reflects
from neurolens.flare.steps import STATE
from neurolens.graph.compiler import c_source
from neurolens.optics.prescription import Lens
from neurolens.render.flaresettings import Scatter

BLOCK = 4096  # photons under way: their states, 40 bytes at every surface, stay in the caches
MOST_REFLECTIONS = 1000  # and scatterings
LEVELS = 5  # boosts of light that was reflected never, once, ..., at least four times
_TURNS = 0.95  # share of light that turns round in a sweep where it is to
_BOOSTS = 1e-6, 1e6


class Photons(NamedTuple):
    """Photons that arrived at the film's plane, and the books of all that were cast.

    Attributes:
        film_xy_mm: [2, M] lens frame. weight: [M], 1 each where no boost is asked for.
        reflections, scattered: [M], how often each was reflected by surfaces, and scattered.
        cast, left, stopped, absorbed, cut: numbers of photons: all; out at the front; ended at rims, the barrel or the
            film's plane; by glass or by a total reflection that meets no surface; with more reflections than allowed.
    """

    film_xy_mm: Floats
    weight: Floats
    reflections: NDArray[np.int32]
    scattered: NDArray[np.int32]
    cast: int
    left: int
    stopped: int
    absorbed: int
    cut: int

    @property
    def glare(self) -> NDArray[np.bool_]:
        """[M]: those that scattered, or were reflected more than twice: neither image nor ghosts of two reflections."""
        return (self.scattered > 0) | (self.reflections > 2)


class PhotonTracer:
    """Photons through a lens at its focus, zoom and stop.

    Args:
        scatter: what scatters them; None lets nothing.

    Attributes:
        stack: the lens's compiled steps.

    Raises:
        InputError: as `GhostTracer`.
    """

    def __init__(self, lens: Lens, scatter: Scatter | None = None) -> None:
        every = range(len(lens.surfaces))
        places: list[Place] = [(k, way) for k in every for way in (0, 1)]
        places += [(k, way) for k in every for way in (2, 3) if reflects(lens, k)]
        self.lens, self.scatter, self.stack = lens, scatter or Scatter(), Stack(lens, places)
        self._scattering = scatter_numbers(self.scatter, lens)
        driver = c_source(
            "flare/photons.c", BLOCK=BLOCK, CHANCES=CHANCES, NUMBERS=len(NUMBERS), LEVELS=LEVELS,
            MOST_SCATTERS=MOST_REFLECTIONS,
        )  # fmt: skip
        graphs = {"scatter": scatter_graph(), "film_scatter": film_scatter_graph()}
        self._call = self.stack.compiled(driver, "photons", graphs)
        whole, pointer = ctypes.c_int, ctypes.c_void_p
        self._call.argtypes = [ctypes.c_size_t, whole, whole, whole, whole, pointer, ctypes.c_uint64, *[pointer] * 11]
        self._call.restype = ctypes.c_size_t

    def turning(self, wavelength_nm: float, times: int) -> NDArray[np.float64]:
        """Boosts by which light turns round so many `times` (up to `LEVELS` - 1), then as it does.

        Of the surfaces ahead each has a chance as its reflectance at normal incidence: paths of as many reflections
        have much the same weight.
        """
        share = self.stack.reflectance(wavelength_nm)
        found = np.ones((len(share), 2, LEVELS))
        for way, ahead in enumerate((share[::-1].cumsum()[::-1], share.cumsum())):
            turns = _TURNS * share / np.maximum(ahead, 1e-30)
            found[:, way, :times] = np.where(
                share > 0, turns / (1 - turns) * (1 - share) / np.maximum(share, 1e-30), 1
            )[:, None]
        return found.clip(*_BOOSTS)

    def trace(
        self,
        rays: Floats,
        wavelength_nm: float,
        *,
        most_reflections: int = 10,
        seed: int = 0,
        boost: float | NDArray[np.floating] = 1.0,
    ) -> Photons:
        """Cast a photon along each ray [6, N] (point in mm and unit direction towards the film, lens frame).

        Args:
            most_reflections: a photon that would be reflected once more is cut off. seed: of the chances.
            boost: how much more often light turns round than it is reflected, for all or [surfaces, 2, LEVELS]: on the
                way to the film and back, after no, one, ... reflections.

        Raises:
            InputError: as of `stack.entering`; reflections or boosts out of bounds.
        """
        if not 0 <= most_reflections <= MOST_REFLECTIONS:
            raise InputError("photons", "most_reflections", most_reflections, f"from 0 to {MOST_REFLECTIONS}")
        start, surfaces, scatter = entering(rays), len(self.lens.surfaces), self.scatter
        low, high = _BOOSTS
        boosts = np.ascontiguousarray(np.broadcast_to(boost, (surfaces, 2, LEVELS)), np.float32)
        if not ((boosts >= np.float32(low)) & (boosts <= high)).all():
            raise InputError("photons", "boost", float(boosts.min()), f"from {low:g} to {high:g}")
        numbers, shift = self.stack.numbers(wavelength_nm)
        count = start.shape[1]
        place, weight = np.empty((2, count), np.float32), np.empty(count, np.float32)
        reflections, scattered, books = np.empty(count, np.int32), np.empty(count, np.int32), np.zeros(4, np.int64)
        room = np.empty((2 * surfaces + 5) * (STATE + 2) * BLOCK, np.float32)
        shares = np.array([shift, scatter.mirror, scatter.barrel, scatter.sensor], np.float32)
        on_way = bool(scatter.barrel or scatter.dust or scatter.haze_per_mm)
        arrays = (start, self.stack.functions, numbers, boosts, self._scattering, room, place, weight, reflections)
        pointers = [a.ctypes.data for a in (*arrays, scattered, books)]
        plain = not scatter.on and bool((boosts == 1).all())
        arrived = self._call(count, surfaces, most_reflections, on_way, plain, shares.ctypes.data, seed, *pointers)
        told = (place[:, :arrived], weight[:arrived], reflections[:arrived], scattered[:arrived])
        return Photons(*told, count, *(int(v) for v in books))
