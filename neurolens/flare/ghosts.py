"""Ghosts: light that two surfaces reflect on its way to the film, traced exactly, all pairs of a lens at once.

Pairs share their way: light that comes to surface j is reflected there once for all ghosts of j, and what travels back
to surface i once for all that are reflected there, too; only the last way, from i to the film, belongs to one ghost. So
a lens of n surfaces takes n^3 / 3 steps for n^2 / 2 ghosts, where each by itself would take n^3. The steps are graphs
(`flare.steps`), compiled once for a lens's kinds of surfaces; numbers of the call hold the rest, so that focus, zoom,
stop and wavelength need no compiling. `optics.sequence.follow` is the truth in float64 for one path.
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
from neurolens.optics.designs import design
from neurolens.optics.prescription import Lens

_BLOCK = 512  # rays whose states, 32 bytes each before every surface, fit the second cache
_NO_LAYERS = np.zeros(1, np.int32)


class Pair(NamedTuple):
    """A ghost: reflected at surface `second`, then at `first` < `second`; counted from 0 at the front."""

    first: int
    second: int

    @property
    def name(self) -> str:
        """Stable, for layers and tables."""
        return f"g{self.second:02d}-{self.first:02d}"


def ghost_pairs(lens: Lens, *, one_side: bool = False) -> tuple[Pair, ...]:
    """All ghosts of two reflections: pairs of surfaces that reflect.

    Args:
        one_side: only those whose both reflections lie on the same side of the stop (Hullin et al. 2011, section 4.1:
            the others cross the stop three times, and little of them gets through).
    """
    at = [k for k, s in enumerate(lens.surfaces) if reflects(lens, k)]
    pairs = [Pair(i, j) for j in at for i in at if i < j]
    return tuple(p for p in pairs if not one_side or (p.first > lens.stop_index) == (p.second > lens.stop_index))


def coated(lens: Lens, name: str) -> Lens:
    """The lens with a coating of `optics.designs` on each bare surface between glass and air.

    Raises:
        InputError: an unknown name; media that the design cannot match.
    """
    rows, before = [], 1.0
    for k, s in enumerate(lens.surfaces):
        bare = not (s.coating and s.coating.layers) and reflects(lens, k) and 1.0 in (before, float(s.n_d))
        coating = design(name, before, float(s.n_d), lens.path, f"surface {k}") if bare else s.coating
        rows.append(replace(s, coating=coating))
        before = float(s.n_d)
    return replace(lens, surfaces=tuple(rows))


class GhostRays(NamedTuple):
    """Where light of one wavelength arrives, by ghost.

    Attributes:
        film_xy_mm: [P, 2, N] lens frame. power: [P, N], share of the ray's light, 0 where any rim stops it.
        worst: [P, N], the largest r^2 / R^2 at any rim on the way: at most 1 where the ray arrives.
    """

    film_xy_mm: Floats
    power: Floats
    worst: Floats


class GhostTracer:
    """All ghosts of a lens at its focus, zoom and stop, and the direct light, as compiled code in float32.

    Args:
        lens: its film must be placed (`Lens.at`).
        pairs: the ghosts to follow; None takes all.

    Attributes:
        pairs: of the lens, in the order of the results. stack: its compiled steps.

    Raises:
        InputError: no C compiler, or one that fails; a lens without film position; pairs that it has not.
    """

    def __init__(self, lens: Lens, pairs: Sequence[Pair] | None = None) -> None:
        self.lens = lens
        known = ghost_pairs(lens)
        self.pairs = known if pairs is None else tuple(pairs)
        for pair in self.pairs:
            if pair not in known:
                raise InputError(lens.path, "ghost", pair.name, f"one of {len(known)} pairs of surfaces that reflect")
        self.stack = Stack(lens, self._places())
        driver = _DRIVER.format(block=_BLOCK, lost=LOST)
        self._call, pointer = self.stack.compiled(driver, "ghosts"), ctypes.c_void_p
        whole, real = ctypes.c_int, ctypes.c_float
        self._call.argtypes = [ctypes.c_size_t, whole, whole, whole, real, real, whole, whole, *[pointer] * 7]

    def trace(self, rays: Floats, wavelength_nm: float, *, direct: bool = False) -> GhostRays:
        """Follow light [6, N] (point in mm and unit direction towards the film, lens frame) along every pair.

        Args:
            direct: whether the light that forms the image follows the ghosts, as if it were one more.
        """
        out = np.zeros((len(self.pairs) + direct, 4, rays.shape[1]), np.float32)
        self._run(rays, wavelength_nm, direct, out)
        return GhostRays(out[:, :2], out[:, 2], out[:, 3])

    def splat(
        self, picture: Floats, rays: Floats, wavelength_nm: float, pixels_per_mm: float, layers: Sequence[int]
    ) -> None:
        """Add the power of rays to pictures [layers, H, W], upright (the film turned by 180 degrees) and centred.

        Args:
            layers: of each pair, the picture that takes it.
        """
        assert picture.flags.c_contiguous and picture.dtype == np.float32
        raster = pixels_per_mm, picture.shape[2], picture.shape[1]
        self._run(rays, wavelength_nm, False, picture, raster, np.array(layers, np.int32))

    def _run(
        self,
        rays: Floats,
        wavelength_nm: float,
        direct: bool,
        out: Floats,
        raster: tuple[float, int, int] = (0.0, 0, 0),
        layers: NDArray[np.int32] = _NO_LAYERS,
    ) -> None:
        start, surfaces = entering(rays), len(self.lens.surfaces)
        numbers, shift = self.stack.numbers(wavelength_nm)
        index = np.full((surfaces, surfaces), -1, np.int32)
        for number, pair in enumerate(self.pairs):
            index[pair.second, pair.first] = number
        room = np.empty((surfaces + 4) * STATE * _BLOCK, np.float32)
        pointers = [a.ctypes.data for a in (start, self.stack.functions, numbers, index, layers, room, out)]
        self._call(start.shape[1], surfaces, len(self.pairs), int(direct), shift, *raster, *pointers)

    def _places(self) -> list[tuple[int, int]]:
        """Surfaces and actions that the pairs need, in order; each kind of surface takes a second to compile."""
        needed = {(k, 0) for k in range(len(self.lens.surfaces))}
        for first, second in self.pairs:
            needed |= {(second, 2), (first, 3)} | {(k, 1) for k in range(first + 1, second)}
        return sorted(needed)


# A way ends where no ray is left on it. Ways: a pair each, then the direct light.
_DRIVER = """
enum {{ BLOCK = {block}, ROOM = BLOCK * STATE }};

struct film {{
    float shift, per_mm;
    int width, height;
    const int *layer;
    float *out;
}};

static int left_after(struct lens lens, int k, int action, size_t n, const float *from, float *to)
{{
    int left = 0;
    go(lens, k, action, n, from, to, BLOCK);
    for (size_t i = 0; i < n; i++)
        left |= to[(STATE - 1) * BLOCK + i] <= 1.0f;
    return left;
}}

/* Light of a way at the film: kept ray by ray, or shared among the four pixels around its place. */
static void arrive(size_t n, const float *from, struct film film, int way, size_t at, size_t count)
{{
    float kept[4 * BLOCK], *const x = kept, *const y = kept + BLOCK, *const power = kept + 2 * BLOCK;
    if (!film.width) {{
        meet_film(n, from, BLOCK, film.shift, film.out + 4 * way * count + at, count);
        return;
    }}
    meet_film(n, from, BLOCK, film.shift, kept, BLOCK);
    float *const picture = film.out + (size_t)film.layer[way] * film.width * film.height;
    for (size_t i = 0; i < n; i++) {{
        const float u = 0.5f * film.width - 0.5f - x[i] * film.per_mm;
        const float v = 0.5f * film.height - 0.5f + y[i] * film.per_mm;
        if (!(power[i] > 0.0f && u > -1.0f && v > -1.0f && u < film.width && v < film.height)) continue;
        const int left = (int)(u + 1.0f) - 1, top = (int)(v + 1.0f) - 1;
        const float right = u - left, below = v - top;
        for (int k = 0; k < 4; k++) {{
            const int px = left + (k & 1), py = top + (k >> 1);
            if (px >= 0 && py >= 0 && px < film.width && py < film.height)
                picture[(size_t)py * film.width + px] +=
                    power[i] * (k & 1 ? right : 1.0f - right) * (k >> 1 ? below : 1.0f - below);
        }}
    }}
}}

void ghosts(
    size_t count, int surfaces, int pairs, int direct, float shift, float per_mm, int width, int height,
    const float *start, const int *functions, const float *numbers, const int *index, const int *layer, float *room,
    float *out)
{{
    const struct lens lens = {{ surfaces, functions, numbers }};
    const struct film film = {{ shift, per_mm, width, height, layer, out }};
    for (size_t at = 0; at < count; at += BLOCK) {{
        const size_t n = count - at < BLOCK ? count - at : BLOCK;
        float *const ahead = room, *back = room + (surfaces + 1) * ROOM, *spare = back + ROOM, *again = spare + ROOM;
        for (int r = 0; r < STATE; r++)
            for (size_t i = 0; i < n; i++)
                ahead[r * BLOCK + i] = start[r * count + at + i];
        for (int p = 0; !width && p < pairs + direct; p++)
            for (size_t i = 0; i < n; i++) {{
                out[(4 * p + 2) * count + at + i] = 0.0f;
                out[(4 * p + 3) * count + at + i] = {lost}f;
            }}
        int reached = 0;
        while (reached < surfaces) {{
            float *const here = ahead + reached * ROOM;
            if (!left_after(lens, reached, 0, n, here, here + ROOM)) break;
            reached++;
        }}
        if (direct && reached == surfaces)
            arrive(n, ahead + surfaces * ROOM, film, pairs, at, count);
        for (int j = 1; j <= reached && j < surfaces; j++) {{
            const int *const wanted = index + j * surfaces;
            int lowest = j;
            for (int i = j - 1; i >= 0; i--)
                if (wanted[i] >= 0) lowest = i;
            int left = lowest < j && left_after(lens, j, 2, n, ahead + j * ROOM, back);
            for (int i = j - 1; left && i >= lowest; i--) {{
                float *from = spare, *to = again;
                if (wanted[i] >= 0 && left_after(lens, i, 3, n, back, spare)) {{
                    int k = i + 1;
                    for (; k < surfaces && left_after(lens, k, 0, n, from, to); k++) {{
                        float *const other = from;
                        from = to;
                        to = other;
                    }}
                    if (k == surfaces)
                        arrive(n, from, film, wanted[i], at, count);
                }}
                left = i > lowest && left_after(lens, i, 1, n, back, spare);
                float *const other = back;
                back = spare;
                spare = other;
            }}
        }}
    }}
}}
"""
