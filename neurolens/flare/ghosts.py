"""Ghosts: light that two surfaces reflect on its way to the film, or four, traced exactly, all of a lens at once.

Pairs share their way: light that comes to surface j is reflected there once for all ghosts of j, and what travels back
to surface i once for all that are reflected there, too; only the last way, from i to the film, belongs to one ghost. So
a lens of n surfaces takes n^3 / 3 steps for n^2 / 2 ghosts, where each by itself would take n^3. With four reflections
the last way is where two more begin. The steps are graphs
(`flare.steps`), compiled once for a lens's kinds of surfaces; numbers of the call hold the rest, so that focus, zoom,
stop and wavelength need no compiling. `optics.sequence.follow` is the truth in float64 for one path.
"""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise
from string import Template
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from neurolens.base.errors import InputError
from neurolens.flare.stack import Floats, Stack, entering, reflects
from neurolens.flare.steps import LOST, STATE
from neurolens.optics.designs import design
from neurolens.optics.prescription import Lens

MOST_WAYS = 1 << 23
_BLOCK = 512  # rays whose states, 32 bytes each before every surface, fit the second cache


class Pair(NamedTuple):
    """A ghost: reflected at surface `second`, then at `first` < `second`; counted from 0 at the front."""

    first: int
    second: int

    @property
    def reflections(self) -> tuple[int, ...]:
        """The surfaces in the order in which light is reflected there."""
        return self.second, self.first

    @property
    def name(self) -> str:
        """Stable, for layers and tables."""
        return f"g{self.second:02d}-{self.first:02d}"


class Four(NamedTuple):
    """A ghost of four reflections, at these surfaces in this order: back, forward, back, forward."""

    first: int
    second: int
    third: int
    fourth: int

    @property
    def reflections(self) -> tuple[int, ...]:
        """As of `Pair`."""
        return tuple(self)

    @property
    def name(self) -> str:
        """Stable, for layers and tables."""
        return "g" + "-".join(f"{k:02d}" for k in self)


Way = Pair | Four


def ghost_pairs(lens: Lens) -> tuple[Pair, ...]:
    """All ghosts of two reflections: pairs of surfaces that reflect."""
    at = [k for k in range(len(lens.surfaces)) if reflects(lens, k)]
    return tuple(Pair(i, j) for j in at for i in at if i < j)


def coated(lens: Lens, names: str) -> Lens:
    """The lens with a coating of `optics.designs` on each bare surface between glass and air.

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
    """Where light of one wavelength arrives, by ghost.

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
        """[P, 5], as of `GhostSums`."""
        x, y, power = np.moveaxis(self.rows[:, :3].astype(np.float64), 1, 0)
        x, y = (np.where(power > 0, v, 0.0) for v in (x, y))  # lost rays are nowhere
        return np.stack([power, power * x, power * y, power * (x * x + y * y), power > 0], 1).sum(2)


class GhostSums(NamedTuple):
    """Light of ghosts at the film's plane, summed over rays.

    Attributes:
        sums: [P, 5], of power, power x, power y, power r^2 (mm, lens frame), and the number of rays that arrive.
        dropped: power of ways that were not followed on, which bounds what all ghosts beyond would have brought.
    """

    sums: NDArray[np.float64]
    dropped: float


def four_reflections(lens: Lens) -> NDArray[np.int32]:
    """Surfaces of all ghosts of four reflections, [P, 4], in the order of reflection.

    Raises:
        InputError: more ghosts than `MOST_WAYS`.
    """
    pairs = np.array([p.reflections for p in ghost_pairs(lens)], np.int32).reshape(-1, 2)
    if int((pairs[:, :1].T > pairs[:, 1:]).sum()) > MOST_WAYS:
        raise InputError(lens.path, "ghosts of four reflections", "(too many)", f"at most {MOST_WAYS}")
    again = [pairs[pairs[:, 0] > first] for _, first in pairs]
    before = np.repeat(pairs, [len(some) for some in again], 0)
    return np.concatenate([before, np.concatenate([*again, pairs[:0]])], 1)


class GhostTracer:
    """Ghosts of a lens at its focus, zoom and stop, and the direct light, as compiled code in float32.

    Args:
        lens: its film must be placed (`set_lens`).
        pairs: the ghosts to follow; None takes all of two reflections.

    Attributes:
        pairs: the ghosts, in the order of the results. stack: the lens's compiled steps.

    Raises:
        InputError: no C compiler, or one that fails; a lens without film position; ghosts that it has not.
    """

    def __init__(self, lens: Lens, pairs: Sequence[Way] | None = None) -> None:
        self.lens = lens
        self.pairs: tuple[Way, ...] = ghost_pairs(lens) if pairs is None else tuple(pairs)
        for way in self.pairs:
            turns = way.reflections
            sound = all(a < b if n % 2 else a > b for n, (a, b) in enumerate(pairwise(turns)))
            if not sound or not all(0 <= k < len(lens.surfaces) and reflects(lens, k) for k in turns):
                raise InputError(lens.path, "ghost", way.name, "surfaces that reflect, back and forward in turn")
        self.stack = Stack(lens, self._places())
        self._call = self.stack.compiled(Template(_DRIVER).substitute(BLOCK=_BLOCK, LOST=LOST), "ghosts")
        whole, real, pointer = ctypes.c_int, ctypes.c_float, ctypes.c_void_p
        self._call.argtypes = [ctypes.c_size_t, whole, whole, real, real, ctypes.c_double, *[pointer] * 7]
        self._call.restype = ctypes.c_double

    def trace(self, rays: Floats, wavelength_nm: float, *, direct: bool = False) -> GhostRays:
        """Follow light [6, N] (point in mm and unit direction towards the film, lens frame) along every ghost.

        Args:
            direct: whether the light that forms the image follows the ghosts, as if it were one more.
        """
        return self.follow(self.start(rays), wavelength_nm, direct=direct)

    def start(self, rays: Floats) -> Floats:
        """What `follow` takes of rays [6, N], at any wavelength."""
        return entering(rays)

    def follow(
        self,
        start: Floats,
        wavelength_nm: float,
        *,
        only: Sequence[Way] | None = None,
        direct: bool = False,
        reach: float = 1.0,
    ) -> GhostRays:
        """Follow rays of `start`.

        Args:
            only: these of the tracer's ghosts. direct: see `trace`.
            reach: rays are followed while some of their block have a worst of at most this; else theirs is `LOST`.
        """
        rows = self._rows(self.pairs if only is None else only, direct)
        out = np.zeros((len(rows), 4, start.shape[1]), np.float32)
        self._run(start, wavelength_nm, rows, out, reach=reach)
        return GhostRays(out)

    def follow_each(self, start: Floats, wavelengths_nm: Sequence[float], pair: Way, reach: float = 1.0) -> Floats:
        """Rays of `start` along one ghost at several wavelengths, [W, 4, N], rows as of `GhostRays`."""
        return np.concatenate([self.follow(start, nm, only=[pair], reach=reach).rows for nm in wavelengths_nm])

    def sums(
        self,
        start: Floats,
        wavelength_nm: float,
        ways: NDArray[np.int32] | None = None,
        *,
        direct: bool = False,
        least: float = 0.0,
    ) -> GhostSums:
        """The light of many ghosts at once, without that of single rays.

        Args:
            ways: [P, 4] surfaces that reflect (see `four_reflections`) as some of the tracer's ghosts do; None takes
                the tracer's ghosts. direct: see `trace`.
            least: ways on which less than this share of the light of a block of rays is left are not followed on.
        """
        rows = self._rows(self.pairs, direct) if ways is None else ways
        sums = np.zeros((len(rows), 5))
        return GhostSums(sums, self._run(start, wavelength_nm, rows, None, sums, least))

    @staticmethod
    def _rows(ways: Sequence[Way], direct: bool) -> NDArray[np.int32]:
        """[P, 4] surfaces that reflect, -1 behind them; the direct light has none."""
        turns = [way.reflections for way in ways] + [()] * direct
        return np.array([turn + (-1,) * (4 - len(turn)) for turn in turns], np.int32).reshape(-1, 4)

    def _run(
        self,
        start: Floats,
        wavelength_nm: float,
        ways: NDArray[np.int32],
        out: Floats | None,
        sums: NDArray[np.float64] | None = None,
        least: float = 0.0,
        reach: float = 1.0,
    ) -> float:
        surfaces, (numbers, shift) = len(self.lens.surfaces), self.stack.numbers(wavelength_nm)
        order = np.lexsort((-ways[:, 3], ways[:, 2], -ways[:, 1], ways[:, 0]))
        ends = np.stack([np.full(len(ways), -1), order], 1)
        rows = np.concatenate([ways[order], ends], 1).astype(np.int32)
        levels = 1 + int((ways[:, ::2] >= 0).sum(1).max(initial=0))
        room = np.empty(levels * (surfaces + 3) * STATE * _BLOCK, np.float32)
        arrays = (start, self.stack.functions, numbers, rows, room, out, sums)
        pointers = [None if a is None else a.ctypes.data for a in arrays]
        dropped: float = self._call(start.shape[1], surfaces, len(ways), shift, reach, least, *pointers)
        return dropped

    def _places(self) -> list[tuple[int, int]]:
        """Surfaces and actions that the ghosts need, in order; each kind of surface takes a second to compile."""
        needed = {(k, 0) for k in range(len(self.lens.surfaces))}
        for turns in {way.reflections[k : k + 2] for way in self.pairs for k in (0, 2)} - {()}:
            needed |= {(turns[0], 2), (turns[1], 3)} | {(k, 1) for k in range(turns[1] + 1, turns[0])}
        return sorted(needed)


# Ways to follow are rows of six numbers: up to four surfaces that reflect, -1 behind the last, and the way's own; they
# are in the order in which `sweep` meets them: later surfaces first on the way back. A way ends where no ray is left on
# it or, where its light is summed, where less than `least` is: nothing that comes of it can carry more.
_DRIVER = """
enum { BLOCK = $BLOCK, ROOM = BLOCK * STATE, ROW = 6, SUMS = 5 };

struct job {
    struct lens lens;
    size_t n, at, count;
    float shift, reach, *out;
    double least, dropped, *sums;
};

static int left_after(struct job *job, int k, int action, const float *from, float *to)
{
    const float *const power = to + (STATE - 2) * BLOCK, *const worst = power + BLOCK;
    int left = 0;
    go(job->lens, k, action, job->n, from, to, BLOCK);
    for (size_t i = 0; i < job->n; i++)
        left |= worst[i] <= job->reach;
    if (!left || !(job->least > 0.0)) return left;
    float part[16] = { 0.0f }, energy = 0.0f;
    for (size_t i = 0; i < BLOCK; i += 16)
        for (size_t k = 0; k < 16; k++)
            part[k] += i + k < job->n && worst[i + k] <= 1.0f ? power[i + k] : 0.0f;
    for (int i = 0; i < 16; i++)
        energy += part[i];
    if (energy >= job->least * job->n) return 1;
    job->dropped += energy;
    return 0;
}

/* Light of a way at the film: kept ray by ray, or its power, x, y, r^2 and number summed. */
static void arrive(struct job *job, const float *from, int way)
{
    if (!job->sums) {
        meet_film(job->n, from, BLOCK, job->shift, job->out + 4 * way * job->count + job->at, job->count);
        return;
    }
    float film[4 * BLOCK];
    double *const sums = job->sums + SUMS * (size_t)way;
    meet_film(job->n, from, BLOCK, job->shift, film, BLOCK);
    for (size_t i = 0; i < job->n; i++) {
        const double x = film[i], y = film[BLOCK + i], power = film[2 * BLOCK + i];
        if (!(power > 0.0)) continue;
        sums[0] += power;
        sums[1] += power * x;
        sums[2] += power * y;
        sums[3] += power * (x * x + y * y);
        sums[4] += 1.0;
    }
}

/* All ways of some rows, whose first 2 `level` reflections are the same, from `here`, before surface `first`. */
static void sweep(struct job *job, int first, float *here, const int *rows, int count, int level, float *room)
{
    const int surfaces = job->lens.surfaces, own = rows[2 * level] < 0 ? rows[ROW - 1] : -1;
    float *const ahead = room, *back = room + (surfaces + 1) * ROOM, *spare = back + ROOM, *const deeper = spare + ROOM;
    const int *const end = rows + count * ROW;
    if (own >= 0) rows += ROW;
    const int far = own >= 0 ? surfaces : end[2 * level - ROW];
    int reached = first;
    for (; reached < far; reached++) {
        float *const next = rows < end ? here + ROOM : here == back ? spare : back;
        if (!left_after(job, reached, 0, here, next)) break;
        here = next;
    }
    if (own >= 0 && reached == surfaces) arrive(job, here, own);
    while (rows < end && rows[2 * level] <= reached) {
        const int j = rows[2 * level];
        const int *of_j = rows;
        while (rows < end && rows[2 * level] == j)
            rows += ROW;
        int left = left_after(job, j, 2, ahead + j * ROOM, back);
        for (int i = j - 1; left && of_j < rows; i--) {
            const int *const of_i = of_j;
            while (of_j < rows && of_j[2 * level + 1] == i)
                of_j += ROW;
            const int more = of_i < of_j && of_j[2 * level + 2 - ROW] >= 0;
            float *const there = deeper + (more ? i + 1 : 0) * ROOM;
            if (of_i < of_j && left_after(job, i, 3, back, there))
                sweep(job, i + 1, there, of_i, (int)(of_j - of_i) / ROW, level + 1, deeper);
            left = of_j < rows && left_after(job, i, 1, back, spare);
            float *const other = back;
            back = spare;
            spare = other;
        }
    }
}

double ghosts(
    size_t count, int surfaces, int ways, float shift, float reach, double least, const float *start,
    const int *functions, const float *numbers, const int *rows, float *room, float *out, double *sums)
{
    struct job job = { { surfaces, functions, numbers }, 0, 0, count, shift, reach, out, least, 0.0, sums };
    for (; ways && job.at < count; job.at += BLOCK) {
        job.n = count - job.at < BLOCK ? count - job.at : BLOCK;
        for (int r = 0; r < STATE; r++)
            for (size_t i = 0; i < job.n; i++)
                room[r * BLOCK + i] = start[r * count + job.at + i];
        for (int p = 0; !sums && p < ways; p++)
            for (size_t i = 0; i < job.n; i++) {
                out[(4 * p + 2) * count + job.at + i] = 0.0f;
                out[(4 * p + 3) * count + job.at + i] = ${LOST}f;
            }
        sweep(&job, 0, room, rows, ways, 0, room);
    }
    return job.dropped;
}
"""
