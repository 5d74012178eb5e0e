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
from neurolens.flare.steps import CALL, DEGREE, LOST, STATE, Action, Kind, film_graph, reflectance_fit, seen, step_graph
from neurolens.graph.c import Signature, write_c
from neurolens.graph.compiler import load_compiled
from neurolens.graph.scalars import lower
from neurolens.optics import glass
from neurolens.optics.designs import design
from neurolens.optics.prescription import Lens, Surface
from neurolens.optics.shapes import is_plain

Floats = NDArray[np.float32]
_WIDTH = len(CALL) + DEGREE + 1
_BLOCK = 512  # rays whose states, 32 bytes each before every surface, fit the second cache
_NO_LAYERS = np.zeros(1, np.int32)
_ACTIONS: tuple[tuple[Action, int], ...] = (("T", 1), ("T", -1), ("R", 1), ("R", -1))


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


def reflects(lens: Lens, k: int) -> bool:
    """Whether surface k reflects any light: the medium changes there, or it is coated."""
    s = lens.surfaces[k]
    before = lens.surfaces[k - 1] if k else None
    return bool(s.coating and s.coating.layers) or _medium(before) != _medium(s)


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


def _medium(s: Surface | None) -> tuple[object, ...]:
    return (None, 1.0, None) if s is None else (s.glass, 1.0 if s.glass else float(s.n_d), s.V_d)


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
        pairs: of the lens, in the order of the results.
        fit_error: the largest relative error of a coating's fitted reflectance so far; see `steps.reflectance_fit`.

    Raises:
        InputError: no C compiler, or one that fails; a lens without film position; pairs that it has not.
    """

    def __init__(self, lens: Lens, pairs: Sequence[Pair] | None = None) -> None:
        if lens.film_z_mm is None:
            raise InputError(lens.path, "film_z_mm", None, "a focused lens (Lens.at)")
        self.lens, self.fit_error = lens, 0.0
        known = ghost_pairs(lens)
        self.pairs = known if pairs is None else tuple(pairs)
        for pair in self.pairs:
            if pair not in known:
                raise InputError(lens.path, "ghost", pair.name, f"one of {len(known)} pairs of surfaces that reflect")
        kinds = {place: self._kind(*place) for place in self._places()}
        wanted = tuple(dict.fromkeys(kinds.values()))
        self._functions = np.zeros((len(lens.surfaces), len(_ACTIONS)), np.int32)
        for (k, which), kind in kinds.items():
            self._functions[k, which] = wanted.index(kind)
        self._call = _compiled(wanted)

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
        start, surfaces = _entering(rays), len(self.lens.surfaces)
        numbers, shift = self._numbers(wavelength_nm)
        index = np.full((surfaces, surfaces), -1, np.int32)
        for number, pair in enumerate(self.pairs):
            index[pair.second, pair.first] = number
        room = np.empty((surfaces + 4) * STATE * _BLOCK, np.float32)
        pointers = [a.ctypes.data for a in (start, self._functions, numbers, index, layers, room, out)]
        self._call(start.shape[1], surfaces, len(self.pairs), int(direct), shift, *raster, *pointers)

    def _places(self) -> list[tuple[int, int]]:
        """Surfaces and actions that the pairs need, in order; each kind of surface takes a second to compile."""
        needed = {(k, 0) for k in range(len(self.lens.surfaces))}
        for first, second in self.pairs:
            needed |= {(second, 2), (first, 3)} | {(k, 1) for k in range(first + 1, second)}
        return sorted(needed)

    def _kind(self, k: int, which: int) -> Kind:
        lens, s, (action, sense) = self.lens, self.lens.surfaces[k], _ACTIONS[which]
        return Kind(
            action,
            None if is_plain(s) else seen(s, sense > 0),
            reflects(lens, k),
            bool(s.coating and s.coating.layers),
            any(t.glass is not None or t.absorption_per_mm for t in lens.surfaces),
            lens.aperture if s.stop else None,
        )

    def _numbers(self, wavelength_nm: float) -> tuple[Floats, float]:
        """Numbers of the call [surfaces, actions, _WIDTH] at a wavelength, and the last step's shift to the film."""
        lens, z = self.lens, [float(v) for v in self.lens.vertices_mm]
        n = [1.0, *(float(glass.index_of(s, wavelength_nm)) for s in lens.surfaces)]
        a = [0.0, *(float(glass.absorption_of(s, wavelength_nm) or 0.0) for s in lens.surfaces)]
        found = np.zeros((len(lens.surfaces), len(_ACTIONS), _WIDTH), np.float32)
        for k, s in enumerate(lens.surfaces):
            for which, (_, sense) in enumerate(_ACTIONS):
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


def _entering(rays: Floats) -> Floats:
    """States before the first surface: moved near the front vertex, mirrored."""
    given = np.asarray(rays, np.float64)
    if given.ndim != 2 or given.shape[0] != 6:
        raise InputError("ghosts", "rays", f"({given.shape})", "an array [6, N]")
    place, d = given[:3], given[3:]
    state = np.empty((STATE, given.shape[1]), np.float32)
    state[:3], state[3:6], state[6], state[7] = place - (place * d).sum(0) * d, d, 1, 0
    state[[2, 5]] *= -1
    return state


def _compiled(kinds: Sequence[Kind]) -> ctypes._NamedFuncPointer:
    """The function over blocks of rays for these kinds of steps."""
    text, runs = "", []
    for number, kind in enumerate(kinds):
        program = lower(step_graph(kind)).in_order_of_need()
        name = f"step_{number}"
        text += write_c(program, name, ["One surface."])
        text += _adapter(Signature.of(program, name), f"run_{number}", "state", "after", "call")
        runs.append(f"run_{number}")
    program = lower(film_graph()).in_order_of_need()
    text += write_c(program, "film", ["The film."])
    text += _adapter(Signature.of(program, "film"), "run_film", "state", "film", "shift_mm")
    call = load_compiled(
        text + _DRIVER.format(runs=", ".join(runs), block=_BLOCK, state=STATE, width=_WIDTH, lost=LOST)
    ).ghosts
    pointer = ctypes.c_void_p
    whole, real = ctypes.c_int, ctypes.c_float
    call.argtypes = [ctypes.c_size_t, whole, whole, whole, real, real, whole, whole, *[pointer] * 7]
    call.restype = None
    return call


def _adapter(s: Signature, name: str, taken: str, given: str, numbers: str) -> str:
    """A function of pointers to rows, in the order of `flare.steps`, for one that `write_c` has written."""

    def place(row: str, array: str, of: str) -> str:
        return f"{array}[{row.removeprefix(of + '_') if row != of else 0}]"

    arguments = [
        *(place(row, "in", taken) for row in s.per_ray),
        *(place(row, "call", numbers) for row in s.per_call),
        *(place(row, "out", given) for row in s.outputs),
    ]
    head = f"static void {name}(size_t n, const float *const *in, const float *call, float *const *out)"
    return f"\n{head}\n{{\n    (void)call;\n    {s.name}_rays(n, {', '.join(arguments)});\n}}\n"


# States are blocks of rows; `which` 0 to 3 are refraction towards the film and back, and reflection of light that goes
# to the film and back. A way ends where no ray is left on it.
_DRIVER = """
typedef void step(size_t, const float *const *, const float *, float *const *);
static step *const steps[] = {{ {runs} }};
enum {{ BLOCK = {block}, STATE = {state}, ROOM = BLOCK * STATE, WIDTH = {width} }};

struct film {{
    float shift, per_mm;
    int width, height;
    const int *layer;
    float *out;
}};

static int go(
    size_t n, const float *from, float *to, int k, int which, const int *functions, const float *numbers)
{{
    const float *in[STATE];
    float *out[STATE];
    for (int r = 0; r < STATE; r++) {{
        in[r] = from + r * BLOCK;
        out[r] = to + r * BLOCK;
    }}
    steps[functions[4 * k + which]](n, in, numbers + (4 * k + which) * WIDTH, out);
    int left = 0;
    for (size_t i = 0; i < n; i++)
        left |= out[STATE - 1][i] <= 1.0f;
    return left;
}}

/* Light of a way at the film: kept ray by ray, or shared among the four pixels around its place. */
static void arrive(size_t n, const float *from, struct film film, int way, size_t at, size_t count)
{{
    float kept[4 * BLOCK], *const out = film.width ? kept : film.out + 4 * way * count + at;
    const size_t row = film.width ? BLOCK : count;
    const float *in[STATE];
    float *rows[4];
    for (int r = 0; r < STATE; r++)
        in[r] = from + r * BLOCK;
    for (int r = 0; r < 4; r++)
        rows[r] = out + r * row;
    run_film(n, in, &film.shift, rows);
    if (!film.width) return;
    float *const picture = film.out + (size_t)film.layer[way] * film.width * film.height;
    for (size_t i = 0; i < n; i++) {{
        const float u = 0.5f * film.width - 0.5f - rows[0][i] * film.per_mm;
        const float v = 0.5f * film.height - 0.5f + rows[1][i] * film.per_mm;
        if (!(rows[2][i] > 0.0f && u > -1.0f && v > -1.0f && u < film.width && v < film.height)) continue;
        const int x = (int)(u + 1.0f) - 1, y = (int)(v + 1.0f) - 1;
        const float right = u - x, below = v - y;
        for (int k = 0; k < 4; k++) {{
            const int px = x + (k & 1), py = y + (k >> 1);
            if (px >= 0 && py >= 0 && px < film.width && py < film.height)
                picture[(size_t)py * film.width + px] +=
                    rows[2][i] * (k & 1 ? right : 1.0f - right) * (k >> 1 ? below : 1.0f - below);
        }}
    }}
}}

void ghosts(
    size_t count, int surfaces, int pairs, int direct, float shift, float per_mm, int width, int height,
    const float *start, const int *functions, const float *numbers, const int *index, const int *layer, float *room,
    float *out)
{{
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
            if (!go(n, here, here + ROOM, reached, 0, functions, numbers)) break;
            reached++;
        }}
        if (direct && reached == surfaces)
            arrive(n, ahead + surfaces * ROOM, film, pairs, at, count);
        for (int j = 1; j <= reached && j < surfaces; j++) {{
            const int *const wanted = index + j * surfaces;
            int lowest = j;
            for (int i = j - 1; i >= 0; i--)
                if (wanted[i] >= 0) lowest = i;
            int left = lowest < j && go(n, ahead + j * ROOM, back, j, 2, functions, numbers);
            for (int i = j - 1; left && i >= lowest; i--) {{
                if (wanted[i] >= 0 && go(n, back, spare, i, 3, functions, numbers)) {{
                    float *from = spare, *to = again;
                    int k = i + 1;
                    for (; k < surfaces && go(n, from, to, k, 0, functions, numbers); k++) {{
                        float *const other = from;
                        from = to;
                        to = other;
                    }}
                    if (k == surfaces)
                        arrive(n, from, film, wanted[i], at, count);
                }}
                left = i > lowest && go(n, back, spare, i, 1, functions, numbers);
                float *const other = back;
                back = spare;
                spare = other;
            }}
        }}
    }}
}}
"""
