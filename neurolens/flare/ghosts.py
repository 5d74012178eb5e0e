"""Ghosts: light that two surfaces reflect on its way to the film, traced exactly, all ghosts of a lens at once.

Ghosts share their paths: light that comes to surface j is reflected there once for all ghosts of j, and what travels
back to surface i is traced once for all ghosts that are reflected there or further to the front. Only the path from i
to the film belongs to a single ghost. So a lens of n surfaces takes n^3 / 3 steps for n^2 / 2 ghosts. The steps are
graphs (`flare.steps`), compiled once for a lens's kinds of surfaces, and `ghosts.c` loops over them; focus, zoom, stop
and wavelength are numbers of the call and need no compiling. `trace.sequence.follow` is the truth in float64 for one
path.
"""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from neurolens.base.errors import InputError
from neurolens.flare.stack import Floats, Stack, entering, reflects
from neurolens.flare.steps import LOST, STATE
from neurolens.graph.compiler import c_source
from neurolens.lens.designs import design
from neurolens.lens.prescription import Lens

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
        """Its name in layers and tables."""
        return f"g{self.second:02d}-{self.first:02d}"


def ghost_pairs(lens: Lens) -> tuple[Pair, ...]:
    """All ghosts of two reflections: pairs of surfaces that reflect."""
    at = [k for k in range(len(lens.surfaces)) if reflects(lens, k)]
    return tuple(Pair(i, j) for j in at for i in at if i < j)


def coated(lens: Lens, names: str) -> Lens:
    """The lens with a coating of `lens.designs` on each bare surface between glass and air.

    Args:
        names: a design, and for single surfaces others, which replace what they have: "three-layer,s07=bare".

    Raises:
        InputError: an unknown name; a surface that there is not; media that the design cannot match.
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
        """[P, 2, N]."""
        return self.rows[:, :2]

    @property
    def power(self) -> Floats:
        """[P, N], share of the ray's light, 0 where any rim stops it."""
        return self.rows[:, 2]

    @property
    def worst(self) -> Floats:
        """[P, N], the largest r^2 / R^2 at any rim on the way: at most 1 where the ray arrives."""
        return self.rows[:, 3]

    @property
    def sums(self) -> NDArray[np.float64]:
        """Light at the film's plane summed over rays, [P, 5]: power, power x, power y, power r^2 (mm, lens frame), and
        the number of rays that arrive."""
        x, y, power = np.moveaxis(self.rows[:, :3].astype(np.float64), 1, 0)
        x, y = (np.where(power > 0, v, 0.0) for v in (x, y))  # lost rays are nowhere
        return np.stack([power, power * x, power * y, power * (x * x + y * y), power > 0], 1).sum(2)


class GhostTracer:
    """Ghosts of a lens at its focus, zoom and stop, and the direct light, as compiled code in float32.

    Args:
        lens: its film must be placed (`set_lens`).
        pairs: the ghosts to follow; None takes all of two reflections.

    Attributes:
        pairs: the ghosts, in the order of the results. stack: the lens's compiled steps.

    Raises:
        InputError: no C compiler, or one that fails; a lens without film position; pairs that are no ghosts.
    """

    def __init__(self, lens: Lens, pairs: Sequence[Pair] | None = None) -> None:
        self.lens = lens
        self.pairs: tuple[Pair, ...] = ghost_pairs(lens) if pairs is None else tuple(pairs)
        count = len(lens.surfaces)
        for pair in self.pairs:
            if not (0 <= pair.first < pair.second < count and all(reflects(lens, k) for k in pair)):
                raise InputError(lens.path, "ghost", pair.name, "two surfaces that reflect, the first nearer the front")
        self.stack = Stack(lens, self._steps())
        self._call = self.stack.compiled(c_source("flare/ghosts.c", BLOCK=_BLOCK, LOST=LOST), "ghosts")
        whole, pointer = ctypes.c_int, ctypes.c_void_p
        self._call.argtypes = [ctypes.c_size_t, whole, whole, ctypes.c_float, ctypes.c_float, *[pointer] * 6]

    def trace(self, rays: Floats, wavelength_nm: float, *, direct: bool = False) -> GhostRays:
        """Follow light [6, N] (point in mm and unit direction towards the film, lens frame) along every ghost.

        Args:
            direct: whether the light that forms the image follows the ghosts, as if it were one more.
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

    def sums(self, rays: Floats, wavelength_nm: float, *, direct: bool = False) -> NDArray[np.float64]:
        """The light of every ghost summed over rays [6, N]: `GhostRays.sums`, [P, 5], of a block of rays at a time."""
        start = self.start(rays)
        blocks = (np.ascontiguousarray(start[:, k : k + _BLOCK]) for k in range(0, start.shape[1], _BLOCK))
        zero = np.zeros((len(self.pairs) + direct, 5))
        return sum((self.follow(block, wavelength_nm, direct=direct).sums for block in blocks), zero)

    def _steps(self) -> set[tuple[int, int]]:
        """Surfaces and actions that the ghosts need; each kind of surface takes a second to compile."""
        needed = {(k, 0) for k in range(len(self.lens.surfaces))}
        for first, second in self.pairs:
            needed |= {(second, 2), (first, 3)} | {(k, 1) for k in range(first + 1, second)}
        return needed
