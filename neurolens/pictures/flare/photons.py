"""Flare by photons: each surface refracts or reflects a photon by chance, and photons may scatter any number of times.

Photons leave the lights, and each surface reflects a photon with the probability of its Fresnel or coating reflectance.
The photons that reach the film after reflections are the flare, smoothed by a kernel (Keshmirian 2008). Here photons
are aimed at the front surface alone and weighted by the solid angle. They go through the compiled steps of
`pictures.flare.steps` in sweeps (`photons.c`): a sweep goes through all surfaces to the film, then back through all,
and photons that turn round wait at their surface for the next sweep. All photons are accounted for: each one arrives,
leaves at the front, ends at a rim, is absorbed, or is cut off.

A boost b makes reflection more frequent than it is. If T is the transmitted share, a photon turns round with the
probability b (1 - T) / (T + b (1 - T)), and its weight makes up for that. Steinert (2009, 5.3.2) transmits photons with
the probability T^2, which is b = 2 except for terms in (1 - T)^2. `PhotonTracer.turning` is less noisy: it chooses one
of the surfaces ahead by its reflectance.

Light scatters at the lens's tube and rings, on the film, at dust on the front surface and in hazy glass. These are
simple models that conserve energy, written as graphs of one event. Between two surfaces the lens sits in a tube as wide
as the wider rim; flat rings close the tube towards the rims, and the stop is a plate. Walls reflect by Lambert's law or
about the direction of a mirror. Haze and dust deflect light by the phase function of Henyey and Greenstein (1941).
"""

import ctypes
import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from neurolens.base.errors import InputError
from neurolens.cameras.contract import FloatArray
from neurolens.cameras.pose import UPRIGHT, FilmPose
from neurolens.graph.compiler import c_source
from neurolens.graph.ir import Graph, Value
from neurolens.optics.lens.prescription import Lens
from neurolens.optics.trace.shapes import sag_mm
from neurolens.pictures.flare.steps import FILM, LOST, STATE, Place, Stack, entering, reflects
from neurolens.pictures.render.settings import Scatter

BLOCK = 4096  # photons at a time: their states, 40 bytes at every surface, stay in the caches
MOST_REFLECTIONS = 1000  # also of scattering events
LEVELS = 5  # numbers of reflections that have a boost of their own: 0, 1, 2, 3, at least 4
_TURNS = 0.95  # share of photons that the boosts of `turning` make turn round in one sweep
_BOOSTS = 1e-6, 1e6
CHANCES = 5  # rows of random numbers: an exponential variate, two uniform ones, cosine and sine of a uniform angle
PASSED, VOLUME, WALL, NOWHERE = range(4)  # what happens to a photon: see `scatter_graph`
NUMBERS = (
    "shift_mm", "tube_mm", "ring_r2_mm2", "ring_z_mm", "per_rim2", "least_mm", "per_mm", "layer", "forward", "gloss",
)  # fmt: skip
_LOBE = 0.9  # mean cosine about the mirror's direction, 26 degrees, of light that a glossy wall reflects
_TINY, _NEAR = 1e-20, 1e-3
_FLAT = 1e-6  # of the cosine with the axis, so that no light stays between two surfaces for ever


class Photons(NamedTuple):
    """Photons that arrived at the film's plane, and how many others ended where.

    Attributes:
        film_xy_mm: [2, M] on the film. weight: [M], 1 each without a boost.
        reflections, scattered: [M] how often surfaces reflected each photon, and how often it scattered.
        cast: all photons. left: photons that left the lens at the front. stopped: photons that ended at rims, at the
            barrel or beside the film. absorbed: photons that glass absorbed, or that total reflection sent where no
            surface is. cut: photons that would have had more reflections than allowed.
    """

    film_xy_mm: FloatArray
    weight: FloatArray
    reflections: NDArray[np.int32]
    scattered: NDArray[np.int32]
    cast: int
    left: int
    stopped: int
    absorbed: int
    cut: int

    @property
    def glare(self) -> NDArray[np.bool_]:
        """Return whether photons [M] belong to neither image nor ghosts: scattered, or reflected more than twice."""
        return (self.scattered > 0) | (self.reflections > 2)


class PhotonTracer:
    """Traces photons through a set lens.

    Args:
        scatter: what scatters photons; with None nothing does. pose: how the film stands.

    Attributes:
        stack: the lens's compiled steps.

    Raises:
        InputError: as `GhostTracer`.
    """

    def __init__(self, lens: Lens, scatter: Scatter | None = None, pose: FilmPose = UPRIGHT) -> None:
        every = range(len(lens.surfaces))
        places: list[Place] = [(k, way) for k in every for way in (0, 1)]
        places += [(k, way) for k in every for way in (2, 3) if reflects(lens, k)]
        self.lens, self.scatter, self.stack = lens, scatter or Scatter(), Stack(lens, places, pose)
        self._scattering = scatter_numbers(self.scatter, lens)
        driver = c_source(
            "pictures/flare/photons.c", BLOCK=BLOCK, CHANCES=CHANCES, NUMBERS=len(NUMBERS), LEVELS=LEVELS,
            MOST_SCATTERS=MOST_REFLECTIONS, FILM=FILM,
        )  # fmt: skip
        graphs = {"scatter": scatter_graph(), "film_scatter": film_scatter_graph()}
        self._call = self.stack.compiled(driver, "photons", graphs)
        whole, pointer = ctypes.c_int, ctypes.c_void_p
        self._call.argtypes = [ctypes.c_size_t, whole, whole, whole, pointer, ctypes.c_uint64, *[pointer] * 11]
        self._call.restype = ctypes.c_size_t

    def turning(self, wavelength_nm: float, times: int) -> NDArray[np.float64]:
        """Return factors on reflectances [surfaces, 2, LEVELS] that make photons reflect `times` times, below `LEVELS`.

        Each surface ahead is chosen in proportion to its reflectance (a mean over angles of incidence), so that all
        paths with that number of reflections have about the same weight. Further ones are as frequent as in the lens.
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
        rays: FloatArray,
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
                for the ways to the film and back, after no, one, ... reflections.

        Raises:
            InputError: as `steps.entering`; reflections or boosts are out of bounds.
        """
        if not 0 <= most_reflections <= MOST_REFLECTIONS:
            raise InputError("photons", "most_reflections", most_reflections, f"from 0 to {MOST_REFLECTIONS}")
        start, surfaces, scatter = entering(rays), len(self.lens.surfaces), self.scatter
        low, high = _BOOSTS
        boosts = np.ascontiguousarray(np.broadcast_to(boost, (surfaces, 2, LEVELS)), np.float32)
        if not ((boosts >= np.float32(low)) & (boosts <= high)).all():
            raise InputError("photons", "boost", float(boosts.min()), f"from {low:g} to {high:g}")
        numbers, film = self.stack.numbers(wavelength_nm)
        count = start.shape[1]
        place, weight = np.empty((2, count), np.float32), np.empty(count, np.float32)
        reflections, scattered, books = np.empty(count, np.int32), np.empty(count, np.int32), np.zeros(4, np.int64)
        room = np.empty((2 * surfaces + 5) * (STATE + 2) * BLOCK, np.float32)
        shares = np.array([*film, scatter.mirror, scatter.barrel, scatter.sensor], np.float32)
        on_way = bool(scatter.barrel or scatter.dust or scatter.haze_per_mm)
        arrays = (start, self.stack.functions, numbers, boosts, self._scattering, room, place, weight, reflections)
        pointers = [a.ctypes.data for a in (*arrays, scattered, books)]
        arrived = self._call(count, surfaces, most_reflections, on_way, shares.ctypes.data, seed, *pointers)
        arrivals = (place[:, :arrived], weight[:arrived], reflections[:arrived], scattered[:arrived])
        return Photons(*arrivals, count, *(int(v) for v in books))


def scatter_numbers(scatter: Scatter, lens: Lens) -> NDArray[np.float32]:
    """Return the `NUMBERS` for the way to every surface, towards the film and back, [surfaces, 2, NUMBERS]."""
    z, rows = [float(v) for v in lens.vertices_mm], lens.surfaces
    numbers = np.zeros((len(rows), 2, len(NUMBERS)), np.float32)
    for k, s in enumerate(rows):
        r = s.semi_diameter_mm
        for way, sense in enumerate((1, -1)):
            last = k - sense
            inside = 0 <= last < len(rows)
            tube = max(r, rows[last].semi_diameter_mm) if inside else 0.0
            medium = rows[min(k, last)].n_d if inside else 1.0
            bends = s.n_d != lens.media[k].n_d
            dusty = -math.log1p(-min(scatter.dust, 1 - 1e-7)) if last < 0 else 0.0
            numbers[k, way] = (
                sense * (z[k] - z[last]) if inside else 0.0,
                tube,
                0.0 if s.stop else (r * (1 - 1e-4)) ** 2,
                -sense * float(sag_mm(s, r, 0.0)),
                1 / r**2 if bends else LOST,
                -_NEAR if inside else -LOST,
                scatter.haze_per_mm * (medium > 1),
                dusty,
                max(scatter.dust_forward if last < 0 else scatter.haze_forward, _NEAR),
                scatter.gloss,
            )
    return numbers


def scatter_graph() -> Graph:
    """Write the graph of what happens to a photon on its way to a surface.

    Its inputs are `row` and `call`. `row` is the state before [8], the state after refraction there [8] and random
    numbers [CHANCES]; `call` has the `NUMBERS`. Its output `event` has x, y, z and the direction in the frame of the
    next step, then what happens (`PASSED`, ...), and whether the photon then travels the other way. A photon that the
    surface refracts or totally reflects has met it; others meet the ring, the tube, or nothing.
    """
    g = Graph()
    row, call = g.input("row", 2 * STATE + CHANCES), g.input("call", len(NUMBERS), per_call=True)
    shift, tube, ring_r2, ring_z, per_rim2, least, per_mm, layer, forward, gloss = (call[k] for k in range(call.rows))
    zero, tiny, near = g.constant(0.0), g.constant(_TINY), g.constant(-_NEAR)
    free, choice, u, turn = row[2 * STATE], row[2 * STATE + 1], row[2 * STATE + 2], row[2 * STATE + 3 :]
    x, d, met = g.concat(row[0:2], row[2] + shift), row[3:6], row[STATE : STATE + 3]
    way = (met[2] - x[2]) / d[2]
    beyond = g.select(row[2 * STATE - 1] <= 1.0, 0.0, g.square(met[0:2]) * per_rim2)
    meets = (beyond <= 1.0) & (least <= way)
    # The tube, by the form of the root that divides by no small number; then the plane of the ring.
    along, out2 = g.dot(x[0:2], d[0:2]), g.square(x[0:2]) - tube * tube
    steep = g.square(d[0:2])
    root = (along * along - steep * out2).sqrt()
    to_tube = g.select(zero <= along, -out2 / (along + root), (root - along) / steep)
    to_ring = (ring_z - x[2]) / d[2]
    on_ring = to_ring <= to_tube
    to_wall = g.select(on_ring, to_ring, to_tube)
    wall = d * to_wall + x
    stops = (g.select(on_ring, ring_r2, 0.0) <= g.square(wall[0:2])) & (near <= to_wall) & (tiny <= tube)
    missed = g.select(stops, float(WALL), float(NOWHERE))
    surface, end = g.select(meets, float(PASSED), missed), g.select(meets, way, to_wall)
    volume = (surface <= float(WALL)) & (tiny <= per_mm + layer) & (free <= per_mm * end + layer)
    there = d * g.select(volume, g.select(tiny <= per_mm, (free / per_mm).minimum(end), end), end) + x
    normal = g.select(on_ring, g.constant([0.0, 0.0, 1.0]), wall * g.constant([-1.0, -1.0, 0.0]) / tube)
    glossy = choice <= gloss
    axis = g.select(volume, d, g.select(glossy, normal * (g.dot(d, normal) * -2.0) + d, normal))
    cosine = g.select(glossy, _greenstein(g.constant(_LOBE), u), u.sqrt())
    after = _about(g, axis, g.select(volume, _greenstein(forward, u), cosine), turn)
    inwards = normal * (g.dot(after, normal).minimum(0.0) * -2.0) + after
    after = g.select(volume, after, inwards)
    after = after / g.square(after).sqrt()
    back = zero <= after[2]
    z = g.select(back, -there[2], there[2] - shift)
    place = g.concat(there[0:2], z, after[0:2], -after[2].abs().maximum(_FLAT))
    g.outputs["event"] = g.concat(place, g.select(volume, float(VOLUME), surface), g.select(back, 1.0, 0.0))
    return g


def film_scatter_graph() -> Graph:
    """Write the graph of photons that the film sends back.

    Its inputs are `row` and `call`. `row` is the state behind the last surface [8], the point on the film [2] and
    random numbers [CHANCES]; `call` are the film's numbers, and the share that it reflects as a mirror. Its output
    `event` [6] is the position and direction in the frame of the last surface, which is not mirrored.
    """
    g = Graph()
    row, call = g.input("row", STATE + 2 + CHANCES), g.input("call", FILM + 1, per_call=True)
    choice, u, turn = row[STATE + 3], row[STATE + 4], row[STATE + 5 :]
    x, y, normal = (call[k : k + 3] * [1.0, 1.0, -1.0] for k in (1, 4, 7))
    film, come = row[STATE : STATE + 2] - call[10:12], row[3:6] * [1.0, 1.0, -1.0]
    aside = turn * (1.0 - u).maximum(0.0).sqrt()
    diffuse = x * aside[0] + y * aside[1] + normal * u.sqrt()
    mirrored = come - normal * (2.0 * g.dot(come, normal))
    direction = g.select(choice <= call[FILM], mirrored, diffuse)
    place = x * film[0] + y * film[1] + g.concat(g.constant([0.0, 0.0]), call[0])
    g.outputs["event"] = g.concat(place, direction[0:2], direction[2].minimum(-_FLAT))
    return g


def _greenstein(forward: Value, u: Value) -> Value:
    """Return a random cosine from a uniform u, for a mean cosine above 0 (inverse of Henyey and Greenstein 1941)."""
    square = forward * forward
    q = (1.0 - square) / (1.0 - forward + forward * u * 2.0)
    return ((square + 1.0 - q * q) / (forward * 2.0)).maximum(-1.0).minimum(1.0)


def _about(g: Graph, axis: Value, cosine: Value, turn: Value) -> Value:
    """Return the unit vector at an angle from an axis, turned about it, in the frame of Duff et al. (JCGT 6, 2017)."""
    x, y, z = axis[0], axis[1], axis[2]
    sign = g.select(g.constant(0.0) <= z, 1.0, -1.0)
    a = -1.0 / (sign + z)
    b = x * y * a
    first = g.concat(sign * x * x * a + 1.0, sign * b, -sign * x)
    second = g.concat(b, y * y * a + sign, -y)
    sine = (1.0 - cosine * cosine).maximum(0.0).sqrt()
    return first * (sine * turn[0]) + second * (sine * turn[1]) + axis * cosine
