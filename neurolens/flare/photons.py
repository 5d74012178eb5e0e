"""Flare by photons: light that each surface refracts or reflects by chance, with any number of reflections.

Photons leave the lights, and each surface reflects a photon with the probability of its Fresnel or coating reflectance.
The photons that reach the film after reflections are the flare, smoothed by a kernel (Keshmirian 2008). Here photons
are aimed at the front surface alone and weighted by the solid angle. They go through the compiled steps of
`flare.stack` in sweeps (`photons.c`): a sweep goes through all surfaces to the film, then back through all, and photons
that turn round wait at their surface for the next sweep. On their way they may scatter (`flare.scatter`). All photons
are accounted for: each one arrives, leaves at the front, ends at a rim, is absorbed, or is cut off.

A boost b makes reflection more frequent than it is: if T is the transmitted share, a photon turns round with the
probability b (1 - T) / (T + b (1 - T)), and its weight makes up for that. Steinert (2009, 5.3.2) transmits photons with
the probability T^2, which is b = 2 but for terms in (1 - T)^2. `PhotonTracer.turning` is less noisy: it chooses one of
the surfaces ahead by its reflectance.
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
from neurolens.lens.prescription import Lens
from neurolens.render.flaresettings import Scatter

BLOCK = 4096  # photons at a time: their states, 40 bytes at every surface, stay in the caches
MOST_REFLECTIONS = 1000  # and as many scattering events
LEVELS = 5  # boosts of light that was reflected never, once, ..., at least four times
_TURNS = 0.95  # share of the photons that turn round in one sweep under the boosts of `turning`
_BOOSTS = 1e-6, 1e6


class Photons(NamedTuple):
    """Photons that arrived at the film's plane, and what became of the others.

    Attributes:
        film_xy_mm: [2, M] in the lens frame. weight: [M], 1 each without a boost.
        reflections, scattered: [M], how often surfaces reflected each photon, and how often it scattered.
        cast: number of all photons. left: of those that left the lens at the front. stopped: of those that ended at
            rims, at the barrel or beside the film. absorbed: of those that glass absorbed, or that total reflection
            sent where no surface is. cut: of those that would have had more reflections than allowed.
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
        """[M] whether a photon is neither image nor ghost: it scattered, or was reflected more than twice."""
        return (self.scattered > 0) | (self.reflections > 2)


class PhotonTracer:
    """Photons through a lens at its focus, zoom and stop.

    Args:
        scatter: what scatters photons; None scatters nothing.

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
        """Boosts, [surfaces, 2, LEVELS], by which photons turn round `times` times (up to `LEVELS` - 1).

        The chance of each surface ahead is proportional to its reflectance at normal incidence, so that all paths with
        that number of reflections have about the same weight. After that, reflection is as frequent as it is.
        """
        share = self.stack.reflectance(wavelength_nm)
        boosts = np.ones((len(share), 2, LEVELS))
        for way, ahead in enumerate((share[::-1].cumsum()[::-1], share.cumsum())):
            turns = _TURNS * share / np.maximum(ahead, 1e-30)
            boosts[:, way, :times] = np.where(
                share > 0, turns / (1 - turns) * (1 - share) / np.maximum(share, 1e-30), 1
            )[:, None]
        return boosts.clip(*_BOOSTS)

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
            most_reflections: a photon that would be reflected once more is cut off. seed: of the random numbers.
            boost: how much more often photons turn round than reflectances say: one number, or [surfaces, 2, LEVELS]
                for the way to the film and back, after no, one, ... reflections.

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
        arrivals = (place[:, :arrived], weight[:arrived], reflections[:arrived], scattered[:arrived])
        return Photons(*arrivals, count, *(int(v) for v in books))
