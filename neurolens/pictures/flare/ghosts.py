"""Ghosts: light that two surfaces reflect on its way to the film, traced exactly, all ghosts of a lens at once.

Ghosts share their paths. Light that comes to surface j is reflected there once for all ghosts of j, and what travels
back to surface i is traced once for all ghosts that are reflected there or further to the front; only the path from i
to the film belongs to a single ghost. So a lens of n surfaces takes n^3 / 3 steps for n^2 / 2 ghosts. The steps are
graphs (`pictures.flare.steps`), compiled once for a lens's kinds of surfaces, and `ghosts.c` loops over them. Focus,
zoom, stop and wavelength are numbers of the call, which need no compiling. `optics.trace.rays.follow` is the reference
in float64 for one path. For programs that draw ghosts on a GPU, `ghost_graphs` has each path as a graph of its own.
"""

import ctypes
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from neurolens.base.errors import InputError
from neurolens.base.status import PASSED
from neurolens.cameras.contract import FloatArray
from neurolens.cameras.pose import UPRIGHT, FilmPose
from neurolens.graph.compiler import c_source
from neurolens.graph.ir import Graph, Value
from neurolens.optics.analysis.fields import Scene
from neurolens.optics.analysis.layout import Layout, Line, layout_profile
from neurolens.optics.lens.glass import inverse_square_um
from neurolens.optics.lens.prescription import Lens
from neurolens.optics.trace.rays import Rays, follow, turning
from neurolens.pictures.flare.lights import Light, light_rays
from neurolens.pictures.flare.steps import CALL, LOST, STATE, Stack, entering, film_graph, reflects, step_graph

RANKED = 4096  # rays from which a table has a ghost's energy
_BLOCK = 512  # rays at a time: their states, 32 bytes before every surface, fit the second cache
Array = NDArray[np.float64]
_RAYS = 1 << 16  # rays that look for the light of each ghost
_FEWEST = 8  # the fewest of these that must reach the film for a ghost to be known
_WIDE = 1.3  # radius of the disc through which they enter, over the front's
_MARGIN = 1.12  # by which the disc in which they find light is enlarged
_DEGREE = 13  # degree, in the wavelength, of the numbers of a surface


class Pair(NamedTuple):
    """A ghost: light that is reflected at surface `second`, then at `first` < `second`, counted from 0 at the front."""

    first: int
    second: int

    @property
    def reflections(self) -> tuple[int, ...]:
        """The surfaces in the order in which light is reflected there."""
        return self.second, self.first

    @property
    def name(self) -> str:
        """The name in layers and tables, such as g07-03."""
        return f"g{self.second:02d}-{self.first:02d}"


def ghost_pairs(lens: Lens) -> tuple[Pair, ...]:
    """Return all ghosts of two reflections: pairs of surfaces that reflect."""
    at = [k for k in range(len(lens.surfaces)) if reflects(lens, k)]
    return tuple(Pair(i, j) for j in at for i in at if i < j)


class GhostRays(NamedTuple):
    """Rays of one wavelength that follow each ghost to the film.

    Attributes:
        rows: [P, 4, N] x and y on the film (mm), power and worst.
    """

    rows: FloatArray

    @property
    def film_xy_mm(self) -> FloatArray:
        """The film points [P, 2, N]."""
        return self.rows[:, :2]

    @property
    def power(self) -> FloatArray:
        """The share [P, N] of a ray's light that arrives; 0 where any rim stops the ray."""
        return self.rows[:, 2]

    @property
    def worst(self) -> FloatArray:
        """The largest r^2 / R^2 at any rim on the way, [P, N]: at most 1 where the ray arrives."""
        return self.rows[:, 3]


class GhostTracer:
    """Traces the ghosts of a set lens, and its direct light, by compiled code in float32.

    Args:
        lens: its film must be placed (`set_lens`).
        pairs: the ghosts to follow; None takes all of two reflections.
        pose: how the film stands.

    Attributes:
        pairs: the ghosts, in the order of the results. stack: the lens's compiled steps.

    Raises:
        InputError: there is no C compiler, or it fails; the lens has no film position; a pair is no ghost.
    """

    def __init__(self, lens: Lens, pairs: Sequence[Pair] | None = None, pose: FilmPose = UPRIGHT) -> None:
        self.lens = lens
        self.pairs: tuple[Pair, ...] = ghost_pairs(lens) if pairs is None else tuple(pairs)
        count = len(lens.surfaces)
        needed = {(k, 0) for k in range(count)}  # surfaces with actions, of which each kind takes a second to compile
        for pair in self.pairs:
            if not (0 <= pair.first < pair.second < count and all(reflects(lens, k) for k in pair)):
                raise InputError(lens.path, "ghost", pair.name, "two surfaces that reflect, the first nearer the front")
            needed |= {(pair.second, 2), (pair.first, 3)} | {(k, 1) for k in range(pair.first + 1, pair.second)}
        self.stack = Stack(lens, needed, pose)
        self._call = self.stack.compiled(c_source("pictures/flare/ghosts.c", BLOCK=_BLOCK, LOST=LOST), "ghosts", {})
        whole, pointer = ctypes.c_int, ctypes.c_void_p
        self._call.argtypes = [ctypes.c_size_t, whole, whole, ctypes.c_float, *[pointer] * 7]

    def trace(self, rays: FloatArray, wavelength_nm: float, *, direct: bool = False) -> GhostRays:
        """Follow light [6, N] (point in mm and unit direction towards the film, lens frame) along every ghost.

        Args:
            direct: whether the light that forms the image follows last, as if it were one more ghost.
        """
        return self.follow(entering(rays), wavelength_nm, direct=direct)

    def follow(
        self,
        start: FloatArray,
        wavelength_nm: float,
        *,
        only: Sequence[Pair] | None = None,
        direct: bool = False,
        reach: float = 1.0,
    ) -> GhostRays:
        """Follow rays such as `entering` gives.

        Args:
            only: some of the tracer's ghosts; None follows all. direct: see `trace`.
            reach: a block of rays is followed as long as `worst` of any of its rays is at most this; then all of them
                get `LOST`.
        """
        pairs, surfaces = self.pairs if only is None else tuple(only), len(self.lens.surfaces)
        # `ghosts.c` goes through the second surfaces from the front on, and through the first ones on the way back.
        rows = [(second, first, k) for k, (first, second) in enumerate(pairs)] + [(surfaces, 0, len(pairs))] * direct
        rows.sort(key=lambda row: (row[0], -row[1]))
        out = np.zeros((len(rows), 4, start.shape[1]), np.float32)
        numbers, film = self.stack.numbers(wavelength_nm)
        room = np.empty((surfaces + 5) * STATE * _BLOCK, np.float32)
        arrays = (start, self.stack.functions, numbers, film, np.array(rows, np.int32), room, out)
        self._call(start.shape[1], surfaces, len(rows), reach, *(a.ctypes.data for a in arrays))
        return GhostRays(out)

    def follow_each(
        self, start: FloatArray, wavelengths_nm: Sequence[float], pair: Pair, reach: float = 1.0
    ) -> FloatArray:
        """Follow rays of `entering` along one ghost at several wavelengths, [W, 4, N]; rows as in `GhostRays`."""
        return np.concatenate([self.follow(start, nm, only=[pair], reach=reach).rows for nm in wavelengths_nm])


@dataclass(frozen=True)
class Ghost:
    """One ghost of a light.

    Attributes:
        pair: its surfaces. energy: its light on the film's plane over that of the same light's image.
        centre_mm: the mean x, y of its light on the film. size_mm: the root mean square distance from
            there.
        passed: the share of the rays through the front disc that arrive.
    """

    pair: Pair
    energy: float
    centre_mm: tuple[float, float]
    size_mm: float
    passed: float


def ghost_table(tracer: GhostTracer, light: Light, wavelength_nm: float, count: int = RANKED) -> list[Ghost]:
    """List a light's ghosts that reach the film's plane, brightest first, at one wavelength, by `count` rays."""
    start, sums = entering(light_rays(tracer.lens, light, 0, count)[0]), np.zeros((len(tracer.pairs) + 1, 5))
    for k in range(0, count, _BLOCK):  # the rows of a block stay in the caches
        block = np.ascontiguousarray(start[:, k : k + _BLOCK])
        found = tracer.follow(block, wavelength_nm, direct=True).rows[:, :3].astype(np.float64)
        x, y, power = np.moveaxis(found, 1, 0)
        x, y = (np.where(power > 0, v, 0.0) for v in (x, y))  # lost rays have no place
        sums += np.stack([power, power * x, power * y, power * (x * x + y * y), power > 0], 1).sum(2)
    *of_ghosts, (of_image, *_) = sums.tolist()
    rows = []
    for pair, (power, *moments, lit) in zip(tracer.pairs, of_ghosts, strict=True):
        if power > 0:
            x, y, r2 = (moment / power for moment in moments)
            size = math.sqrt(max(r2 - x * x - y * y, 0.0))
            rows.append(Ghost(pair, power / of_image if of_image > 0 else math.inf, (x, y), size, lit / count))
    return sorted(rows, key=lambda ghost: -ghost.energy)


def ghost_layout(lens: Lens, pair: Pair, light: Light, lines: int = 9) -> Layout:
    """Draw the lens with rays of one ghost in the plane through the axis; they enter as far off it as `light`.

    At most `lines` rays are drawn, chosen evenly from those that arrive.

    Raises:
        InputError: no ray arrives.
    """
    front = lens.surfaces[0].semi_diameter_mm
    angle = math.acos(min(-float(light.towards[2]), 1.0))
    height = torch.linspace(-1.2 * front, 1.2 * front, 4001, dtype=torch.float64)
    zero, before, sine, cosine = torch.zeros_like(height), -0.4 * front, math.sin(angle), math.cos(angle)
    rays = Rays(zero, height - before * math.tan(angle), zero + before, zero, zero - sine, zero + cosine)
    path = follow(lens, rays, turning(len(lens.surfaces), pair.reflections))
    arriving = torch.nonzero(path.status == PASSED)[:, 0]
    if not len(arriving):
        expected = f"one of which light {math.degrees(angle):.3g} degrees off arrives"
        raise InputError(lens.path, "ghost", pair.name, expected)
    chosen = arriving[torch.linspace(0, len(arriving) - 1, min(lines, len(arriving))).long()]
    scene = Scene(lens, math.inf)
    way = (scene.film_z_mm - path.rays.z) / path.rays.dz
    points = [
        (rays.z, rays.y),
        *((z, y) for _, y, z in path.points),
        (path.rays.z + way * path.rays.dz, path.rays.y + way * path.rays.dy),
    ]
    label = f"{pair.name}, {len(arriving) / len(height):.0%} of the height"
    drawn = tuple(Line(np.array([[float(z[k]), float(y[k])] for z, y in points]), label, 0) for k in chosen)
    turns = ", then ".join(map(str, pair.reflections))
    subtitle = f"light {math.degrees(angle):.3g} degrees off the axis, reflected at surface {turns}"
    return replace(layout_profile(scene), rays=drawn, subtitle=subtitle)


@dataclass(frozen=True, eq=False)
class Entrance:
    """A ghost, and the disc through which its light enters the lens.

    The disc has the points chief_mm p + scale_mm u of the plane z = 0 (mm) with |u| < 1. Here p is the light's
    direction (x, y) over the sine of the widest angle. `light` is how much of the ghost's light is on the film.
    """

    pair: Pair
    light: float
    chief_mm: Array
    scale_mm: Array


def entrances(
    tracer: GhostTracer, sine: float, film_radius_mm: float, wavelength_nm: float, seed: int = 0
) -> list[Entrance]:
    """Find the ghosts whose light reaches the film, brightest first, and the disc through which each enters.

    Args:
        tracer: of a lens whose film is placed. sine: that of the largest angle between the axis and the light.
    """
    lens, rng = tracer.lens, np.random.default_rng(seed)
    p, u = _drawn(lens, rng)
    place = _WIDE * lens.surfaces[0].semi_diameter_mm * u
    d = np.concatenate([sine * p, np.sqrt(1 - sine**2 * (p**2).sum(0, keepdims=True))])
    before = np.concatenate([place, np.zeros((1, _RAYS))]) - 1000.0 * d
    rays = tracer.trace(np.concatenate([before, d]), wavelength_nm)
    on_film = np.hypot(*np.moveaxis(rays.film_xy_mm, 1, 0)) < film_radius_mm
    found = []
    for pair, power, here in zip(tracer.pairs, rays.power, on_film, strict=True):
        lit = here & (power > 0)
        if lit.sum() >= _FEWEST:
            light = float((np.where(lit, power, 0) * d[2]).mean(dtype=np.float64))
            found.append(Entrance(pair, light, *_disc(p[:, lit], place[:, lit], lens.anamorphic)))
    return sorted(found, key=lambda entrance: -entrance.light)


def _drawn(lens: Lens, rng: np.random.Generator) -> tuple[Array, Array]:
    """Draw random p and u [2, N] from unit discs; with an axis of symmetry all p lie along x, which stands for all."""
    r, turn = np.sqrt(rng.random(_RAYS)), 2 * np.pi * rng.random(_RAYS)
    length = np.sqrt(rng.random(_RAYS))
    about = 2 * np.pi * rng.random(_RAYS) if lens.anamorphic else np.zeros(_RAYS)
    return r * np.stack([np.cos(about), np.sin(about)]), length * np.stack([np.cos(turn), np.sin(turn)])


def _disc(along: Array, place: Array, anamorphic: bool) -> tuple[Array, Array]:
    """Return the chief and the scale [2] of a disc that holds points [2, N] of light of directions p [2, N]."""
    chief = (place * along).sum(1) / np.maximum((along**2).sum(1), 1e-300)
    chief[1] = chief[1] if anamorphic else chief[0]
    off = place - chief[:, None] * along
    wide = np.abs(off).max(1) if anamorphic else np.ones(2)
    scale = (1 + 2 / math.sqrt(off.shape[1])) * float(np.hypot(*(off / wide[:, None])).max()) * wide
    return chief, _MARGIN * scale


def ghost_graphs(lens: Lens, pairs: Sequence[Pair], wavelength_nm: tuple[float, float]) -> list[Graph]:
    """Write the exact path of each ghost as a graph, from `program.ENTERING` to `program.ARRIVING`.

    `entering` [5] is the light's unit direction towards the film (dx, dy), its point on the plane z = 0 (mm) and the
    wavelength. `stop_radius_mm`, of the call, is that of a round stop. `arriving` [4] is the film point (mm), the
    power, and the largest r^2 / R^2 at any rim.

    Args:
        lens: its film must be placed. wavelength_nm: the range in which indices and coatings hold.

    Raises:
        InputError: the lens has a mask in its stop.
    """
    if lens.aperture is not None and lens.aperture.mask is not None:
        raise InputError(lens.path, "aperture", "(a mask)", "a round stop: ghosts as graphs take no mask")
    count = len(lens.surfaces)
    stack = Stack(replace(lens, aperture=None), [(k, action) for k in range(count) for action in range(4)])
    short, long = (float(inverse_square_um(nm)) for nm in wavelength_nm)
    nodes = np.cos((np.arange(_DEGREE + 1) + 0.5) * math.pi / (_DEGREE + 1))
    at = [1000 / math.sqrt((short + long) / 2 + (short - long) / 2 * node) for node in nodes]
    numbers = np.stack([stack.numbers(nm)[0] for nm in at], -1).astype(np.float64)
    return [_graph(stack, pair, numbers, nodes, stack.numbers(at[0])[1], (short, long)) for pair in pairs]


def _graph(
    stack: Stack, pair: Pair, numbers: Array, nodes: Array, film: FloatArray, w_range: tuple[float, float]
) -> Graph:
    g, (first, second), (short, long) = Graph(), pair, w_range
    rays, radius = g.input("entering", 5), g.input("stop_radius_mm", per_call=True)
    inverse_um = 1000.0 / rays[4]
    w = (inverse_um * inverse_um - (short + long) / 2) * (2 / max(short - long, 1e-30))
    per_stop2 = 1.0 / (radius * radius)
    ahead = (1.0 - g.square(rays[0:2])).sqrt()
    state = g.concat(rays[2:4], g.constant(0.0), rays[0:2], -ahead, g.constant([1.0, 0.0]))
    steps = [*((k, 0) for k in range(second)), (second, 2), *((k, 1) for k in range(second - 1, first, -1)), (first, 3)]
    for k, action in [*steps, *((k, 0) for k in range(first + 1, len(stack.lens.surfaces)))]:
        step = step_graph(stack.kind(k, action))
        call: list[Value] = []
        for n in range(next(node.rows for node in step.nodes if node.name == "call")):
            values = numbers[k, action, n]
            if n == CALL.index("per_rim2") and stack.lens.surfaces[k].stop:
                call.append(per_stop2)
            elif np.ptp(values) > 0:
                call.append(g.series(w, np.polynomial.polynomial.polyfit(nodes, values, _DEGREE)))
            else:
                call.append(g.constant(float(values[0])))
        state = g.inline(step, {"state": state, "call": g.concat(*call)})["after"]
    g.outputs["arriving"] = g.inline(film_graph(), {"state": state, "call": g.constant(film)})["film"]
    return g
