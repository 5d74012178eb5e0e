"""Ghosts: light that two surfaces reflect on its way to the film, traced exactly, all ghosts of a lens at once.

Ghosts share their paths. Light that comes to surface j is reflected there once for all ghosts of j, and what travels
back to surface i is traced once for all ghosts that are reflected there or further to the front; only the path from i
to the film belongs to a single ghost. So a lens of n surfaces takes n^3 / 3 steps for n^2 / 2 ghosts. The steps are
graphs (`flare.steps`), compiled once for a lens's kinds of surfaces, and `ghosts.c` loops over them. Focus, zoom, stop
and wavelength are numbers of the call, which need no compiling. `trace.sequence.follow` is the truth in float64 for one
path.
"""

from __future__ import annotations

import ctypes
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from neurolens.analysis.fields import Scene
from neurolens.analysis.layout import Layout, Line, layout_profile
from neurolens.base.errors import InputError
from neurolens.base.status import PASSED
from neurolens.flare.lights import Light, light_rays
from neurolens.flare.steps import LOST, STATE, Floats, Stack, entering, reflects
from neurolens.graph.compiler import c_source
from neurolens.lens.designs import design
from neurolens.lens.prescription import Lens
from neurolens.trace.rays import Rays, follow, turning

RANKED = 4096  # rays behind a ghost's energy in a table
_BLOCK = 512  # rays whose states, 32 bytes each before every surface, fit the second cache


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
    """All ghosts of two reflections: pairs of surfaces that reflect."""
    at = [k for k in range(len(lens.surfaces)) if reflects(lens, k)]
    return tuple(Pair(i, j) for j in at for i in at if i < j)


def coated(lens: Lens, names: str) -> Lens:
    """The lens with a coating of `lens.designs` on each bare surface between glass and air.

    Args:
        names: a design, and others for single surfaces, which replace what these have: "three-layer,s07=bare".

    Raises:
        InputError: a design or surface is unknown, or a design cannot match the media.
    """
    single = {place: name for place, is_one, name in (word.partition("=") for word in names.split(",")) if is_one}
    rest = [word for word in names.split(",") if "=" not in word]
    known = [f"s{k:02d}" for k in range(len(lens.surfaces))]
    if len(rest) > 1 or not set(single) <= set(known):
        raise InputError(lens.path, "coating", names, f"one design, and others as {known[0]}=NAME to {known[-1]}=NAME")
    rows, before = [], float(lens.object_medium.n_d)
    for k, s in enumerate(lens.surfaces):
        bare = not (s.coating and s.coating.layers) and reflects(lens, k) and 1.0 in (before, float(s.n_d))
        name = single.get(known[k], rest[0] if bare and rest else None)
        coating = design(name, before, float(s.n_d), lens.path, f"surface {k}") if name is not None else s.coating
        rows.append(replace(s, coating=coating))
        before = float(s.n_d)
    return replace(lens, surfaces=tuple(rows))


class GhostRays(NamedTuple):
    """The rays of one wavelength that follow each ghost to the film.

    Attributes:
        rows: [P, 4, N] film x and y (mm, lens frame), power and worst.
    """

    rows: Floats

    @property
    def film_xy_mm(self) -> Floats:
        """Film points [P, 2, N]."""
        return self.rows[:, :2]

    @property
    def power(self) -> Floats:
        """The share [P, N] of the ray's light that arrives, 0 where any rim stops the ray."""
        return self.rows[:, 2]

    @property
    def worst(self) -> Floats:
        """The largest r^2 / R^2 at any rim on the way, [P, N]: at most 1 where the ray arrives."""
        return self.rows[:, 3]

    @property
    def sums(self) -> NDArray[np.float64]:
        """Light on the film's plane summed over rays, [P, 5]: power, power x, power y, power r^2 (mm, lens frame), and
        the number of rays that arrive."""
        x, y, power = np.moveaxis(self.rows[:, :3].astype(np.float64), 1, 0)
        x, y = (np.where(power > 0, v, 0.0) for v in (x, y))  # lost rays are nowhere
        return np.stack([power, power * x, power * y, power * (x * x + y * y), power > 0], 1).sum(2)


class GhostTracer:
    """Traces ghosts of a set lens, and the direct light, as compiled code in float32.

    Args:
        lens: its film must be placed (`set_lens`).
        pairs: the ghosts to follow; None takes all of two reflections.

    Attributes:
        pairs: the ghosts, in the order of the results. stack: the lens's compiled steps.

    Raises:
        InputError: there is no C compiler, or it fails; a lens without film position; pairs that are no ghosts.
    """

    def __init__(self, lens: Lens, pairs: Sequence[Pair] | None = None) -> None:
        self.lens = lens
        self.pairs: tuple[Pair, ...] = ghost_pairs(lens) if pairs is None else tuple(pairs)
        count = len(lens.surfaces)
        needed = {(k, 0) for k in range(count)}  # surfaces and actions; each kind takes a second to compile
        for pair in self.pairs:
            if not (0 <= pair.first < pair.second < count and all(reflects(lens, k) for k in pair)):
                raise InputError(lens.path, "ghost", pair.name, "two surfaces that reflect, the first nearer the front")
            needed |= {(pair.second, 2), (pair.first, 3)} | {(k, 1) for k in range(pair.first + 1, pair.second)}
        self.stack = Stack(lens, needed)
        self._call = self.stack.compiled(c_source("flare/ghosts.c", BLOCK=_BLOCK, LOST=LOST), "ghosts", {})
        whole, pointer = ctypes.c_int, ctypes.c_void_p
        self._call.argtypes = [ctypes.c_size_t, whole, whole, ctypes.c_float, ctypes.c_float, *[pointer] * 6]

    def trace(self, rays: Floats, wavelength_nm: float, *, direct: bool = False) -> GhostRays:
        """Follow light [6, N] (point in mm and unit direction towards the film, lens frame) along every ghost.

        Args:
            direct: whether the light that forms the image comes last, as if it were one more ghost.
        """
        return self.follow(self.start(rays), wavelength_nm, direct=direct)

    def start(self, rays: Floats) -> Floats:
        """The form in which `follow` takes rays [6, N], at any wavelength."""
        return entering(rays)

    def follow(
        self,
        start: Floats,
        wavelength_nm: float,
        *,
        only: Sequence[Pair] | None = None,
        direct: bool = False,
        reach: float = 1.0,
    ) -> GhostRays:
        """Follow rays in the form of `start`.

        Args:
            only: some of the tracer's ghosts; None follows all. direct: see `trace`.
            reach: a block of rays is followed while the `worst` of some of its rays is at most this; after that, theirs
                is `LOST`.
        """
        pairs, surfaces = self.pairs if only is None else tuple(only), len(self.lens.surfaces)
        # `ghosts.c` meets the second surfaces from the front, and the first ones on the way back.
        rows = [(second, first, k) for k, (first, second) in enumerate(pairs)] + [(surfaces, 0, len(pairs))] * direct
        rows.sort(key=lambda row: (row[0], -row[1]))
        out = np.zeros((len(rows), 4, start.shape[1]), np.float32)
        numbers, shift = self.stack.numbers(wavelength_nm)
        room = np.empty((surfaces + 5) * STATE * _BLOCK, np.float32)
        arrays = (start, self.stack.functions, numbers, np.array(rows, np.int32), room, out)
        pointers = [a.ctypes.data for a in arrays]
        self._call(start.shape[1], surfaces, len(rows), shift, reach, *pointers)
        return GhostRays(out)

    def follow_each(self, start: Floats, wavelengths_nm: Sequence[float], pair: Pair, reach: float = 1.0) -> Floats:
        """Rays in the form of `start` along one ghost at several wavelengths, [W, 4, N]: rows of `GhostRays`."""
        return np.concatenate([self.follow(start, nm, only=[pair], reach=reach).rows for nm in wavelengths_nm])

    def sums(self, rays: Floats, wavelength_nm: float) -> NDArray[np.float64]:
        """`GhostRays.sums` of rays [6, N] for every ghost, then for the image, [P + 1, 5], by blocks of rays."""
        start = self.start(rays)
        blocks = (np.ascontiguousarray(start[:, k : k + _BLOCK]) for k in range(0, start.shape[1], _BLOCK))
        zero = np.zeros((len(self.pairs) + 1, 5))
        return sum((self.follow(block, wavelength_nm, direct=True).sums for block in blocks), zero)


@dataclass(frozen=True)
class Ghost:
    """One ghost of a light.

    Attributes:
        pair: its surfaces. energy: its light on the film's plane over that of the image of the same light.
        centre_mm: the mean x, y of its light on the film, lens frame. size_mm: the root mean square distance from it.
        passed: the share of the rays at the front disc that arrive.
    """

    pair: Pair
    energy: float
    centre_mm: tuple[float, float]
    size_mm: float
    passed: float


def ghost_table(tracer: GhostTracer, light: Light, wavelength_nm: float, count: int = RANKED) -> list[Ghost]:
    """The ghosts of a light at one wavelength that reach the film's plane at all, brightest first, by `count` rays."""
    rays, _ = light_rays(tracer.lens, light, 0, count)
    *sums, (of_image, *_) = tracer.sums(rays, wavelength_nm).tolist()
    rows = []
    for pair, (power, *moments, lit) in zip(tracer.pairs, sums, strict=True):
        if power > 0:
            x, y, r2 = (moment / power for moment in moments)
            size = math.sqrt(max(r2 - x * x - y * y, 0.0))
            rows.append(Ghost(pair, power / of_image if of_image > 0 else math.inf, (x, y), size, lit / count))
    return sorted(rows, key=lambda ghost: -ghost.energy)


def ghost_layout(lens: Lens, pair: Pair, light: Light, lines: int = 9) -> Layout:
    """The lens with rays of one ghost in the plane through the axis, of light as far off the axis as `light`.

    At most so many rays are drawn, evenly chosen from those that arrive.

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
    points = [(rays.z, rays.y), *((z, y) for _, y, z in path.points)]
    points.append((path.rays.z + way * path.rays.dz, path.rays.y + way * path.rays.dy))
    label = f"{pair.name}, {len(arriving) / len(height):.0%} of the height"
    drawn = tuple(Line(np.array([[float(z[k]), float(y[k])] for z, y in points]), label, 0) for k in chosen)
    turns = ", then ".join(map(str, pair.reflections))
    subtitle = f"light {math.degrees(angle):.3g} degrees off the axis, reflected at surface {turns}"
    return replace(layout_profile(scene), rays=drawn, subtitle=subtitle)
