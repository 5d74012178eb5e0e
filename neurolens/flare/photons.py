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
from string import Template
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from neurolens.base.errors import InputError
from neurolens.flare.scatter import CHANCES, NUMBERS, Scatter, film_scatter_graph, scatter_graph
from neurolens.flare.stack import Floats, Place, Stack, entering, reflects
from neurolens.flare.steps import STATE
from neurolens.optics.prescription import Lens

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
        self._scattering = self.scatter.numbers(lens)
        sizes = {"BLOCK": BLOCK, "CHANCES": CHANCES, "NUMBERS": len(NUMBERS), "LEVELS": LEVELS}
        driver = Template(_DRIVER).substitute(sizes, MOST=MOST_REFLECTIONS)
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


# Lists of photons are rows `BLOCK` long: the state, with the photon's weight as power, then how often it was reflected,
# and how often scattered. `wait` holds a list for each surface that the next sweep meets them at, and one for the film.
_DRIVER = """
#include <math.h>
#include <stdint.h>

enum { BLOCK = $BLOCK, POWER = STATE - 2, TIMES = STATE, SCATTERS, ROWS, LIST = ROWS * BLOCK, CHANCES = $CHANCES };
enum { NUMBERS = $NUMBERS, EVENT = 8, LEVELS = $LEVELS, MOST_SCATTERS = $MOST };
#if defined(__GNUC__)
#define ALWAYS __attribute__((always_inline))
#else
#define ALWAYS
#endif
enum { LEFT, STOPPED, ABSORBED, CUT };
enum { PASSED, VOLUME, WALL, NOWHERE };

static inline ALWAYS float chance(uint64_t *state)
{
    uint64_t z = *state += 0x9e3779b97f4a7c15u;
    z = (z ^ z >> 30) * 0xbf58476d1ce4e5b9u;
    z = (z ^ z >> 27) * 0x94d049bb133111ebu;
    return (float)((z ^ z >> 31) >> 40) * 0x1p-24f;
}

/* Append photon `i` of a list: where it is, and what else is to be known of it. */
static inline ALWAYS void append(
    const float *from, int i, float weight, float times, float scatters, float *list, int *count)
{
    for (int r = 0; r < POWER; r++)
        list[r * BLOCK + *count] = from[r * BLOCK + i];
    list[POWER * BLOCK + *count] = weight;
    list[(POWER + 1) * BLOCK + *count] = 0.0f;
    list[TIMES * BLOCK + *count] = times;
    list[SCATTERS * BLOCK + (*count)++] = scatters;
}

struct light {
    int most, scatters, plain; /* plain: no weights, no scattering */
    const float *boost, *number, *film;
    float barrel, sensor;
    uint64_t state;
    int64_t *books;
};

struct room {
    float *now, *then, *after, *turned, *wait[2];
    int *waiting[2];
    float drawn[BLOCK], through[BLOCK], weight[BLOCK], chances[CHANCES * BLOCK], event[EVENT * BLOCK];
};

static void draw(int n, float *chances, uint64_t *state)
{
    for (int i = 0; i < n; i++) {
        const float angle = 6.2831853f * chance(state);
        chances[i] = -logf(1.0f - chance(state));
        chances[BLOCK + i] = chance(state);
        chances[2 * BLOCK + i] = chance(state);
        chances[3 * BLOCK + i] = cosf(angle);
        chances[4 * BLOCK + i] = sinf(angle);
    }
}

/* What the `count` first rows of two lists and chances become; `event` has `given` rows. */
static void happen(
    void (*run)(size_t, const float *const *, const float *, float *const *), int n, const float *first,
    const float *second, int count, struct room *room, const float *numbers, int given)
{
    const float *in[2 * STATE + CHANCES];
    float *out[EVENT];
    for (int r = 0; r < STATE; r++)
        in[r] = first + r * BLOCK;
    for (int r = 0; r < count; r++)
        in[STATE + r] = second + r * BLOCK;
    for (int r = 0; r < CHANCES; r++)
        in[STATE + count + r] = room->chances + r * BLOCK;
    for (int r = 0; r < given; r++)
        out[r] = room->event + r * BLOCK;
    run(n, in, numbers, out);
}

/* Photons that scatter on their way to surface k wait there or, where they turn round, at `next`. */
static void scatter_on_way(struct room *room, struct light *light, int k, int back, int n, int next)
{
    const float *const list = room->now, *const kind = room->event + (EVENT - 2) * BLOCK, *const turns = kind + BLOCK;
    draw(n, room->chances, &light->state);
    for (int i = 0; k == 0 && !back && i < n; i++) /* dust lies in one layer */
        if (list[SCATTERS * BLOCK + i] > 0.0f) room->chances[i] = INFINITY;
    const float *const numbers = light->number + (2 * k + back) * NUMBERS;
    happen(run_scatter, n, list, room->after, STATE, room, numbers, EVENT);
    for (int i = 0; i < n; i++) {
        const int what = (int)kind[i], way = turns[i] > 0.5f ? !back : back, at = way == back ? k : next;
        const float times = list[TIMES * BLOCK + i], scatters = list[SCATTERS * BLOCK + i];
        if (what == PASSED) continue;
        if (what == NOWHERE || (what == WALL && !(chance(&light->state) < light->barrel)))
            light->books[STOPPED]++;
        else if (scatters >= MOST_SCATTERS)
            light->books[CUT]++;
        else if (at < 0)
            light->books[LEFT]++;
        else
            append(room->event, i, list[POWER * BLOCK + i], times, scatters + 1.0f, room->wait[way] + at * LIST,
                &room->waiting[way][at]);
    }
}

/* Photons of `room->now` at surface k: those that go through become the list, those that turn round wait at `next`. */
static inline ALWAYS int meet_as(
    struct lens lens, struct room *room, struct light *light, int k, int back, int n, int next, const int plain)
{
    const float *const power = room->after + POWER * BLOCK, *const worst = power + BLOCK, *const list = room->now;
    const float *const kind = room->event + (EVENT - 2) * BLOCK, *const boosts = light->boost + LEVELS * (2 * k + back);
    const int reflects = lens.functions[ACTIONS * k + 2 + back] >= 0;
    int on = 0, turning = 0;
    go(lens, k, back, n, room->now, room->after, BLOCK);
    if (!plain && light->scatters) scatter_on_way(room, light, k, back, n, next);
    float *const turn = room->then;
    for (int i = 0; i < n; i++) {
        if (!plain && light->scatters && kind[i] > 0.5f) continue;
        const float weight = plain ? 1.0f : list[POWER * BLOCK + i], times = list[TIMES * BLOCK + i];
        const float scatters = plain ? 0.0f : list[SCATTERS * BLOCK + i];
        const float through = worst[i] <= 1.0f ? power[i] / weight : 0.0f;
        const float boost = plain || !reflects ? 1.0f : boosts[times < LEVELS ? (int)times : LEVELS - 1];
        /* Instead of 1 - T, in all with T, light turns with boost (1 - T): the sum is `all`. */
        const float all = 1.0f + (boost - 1.0f) * (1.0f - through), drawn = chance(&light->state) * all;
        if (drawn < through) {
            append(room->after, i, weight * all, times, scatters, room->after, &on);
            continue;
        }
        room->drawn[turning] = (drawn - through) / boost;
        room->through[turning] = worst[i] <= 1.0f ? through : -1.0f;
        room->weight[turning] = weight * all / boost;
        append(room->now, i, 1.0f, times, scatters, turn, &turning);
    }
    if (reflects && turning)
        go(lens, k, 2 + back, turning, turn, room->turned, BLOCK);
    const float *const shared = room->turned + POWER * BLOCK, *const rim = shared + BLOCK;
    for (int i = 0; i < turning; i++) {
        const float times = turn[TIMES * BLOCK + i];
        if (reflects ? !(rim[i] <= 1.0f) : room->through[i] < 0.0f)
            light->books[STOPPED]++;
        else if (!reflects || !(room->drawn[i] < shared[i]))
            light->books[ABSORBED]++;
        else if (times >= light->most)
            light->books[CUT]++;
        else if (next < 0)
            light->books[LEFT]++;
        else
            append(room->turned, i, room->weight[i], times + 1.0f, turn[SCATTERS * BLOCK + i],
                room->wait[!back] + next * LIST, &room->waiting[!back][next]);
    }
    float *const other = room->now;
    room->now = room->after;
    room->after = other;
    return on;
}

static int meet(struct lens lens, struct room *room, struct light *light, int k, int back, int n, int next)
{
    return light->plain ? meet_as(lens, room, light, k, back, n, next, 1)
                        : meet_as(lens, room, light, k, back, n, next, 0);
}

static inline ALWAYS void copy(const float *list, int i, float *to, int *count)
{
    append(list, i, list[POWER * BLOCK + i], list[TIMES * BLOCK + i], list[SCATTERS * BLOCK + i], to, count);
}

/* The list and those that wait at a surface. */
static int joined(struct room *room, int back, int k, int n)
{
    for (int i = 0; i < room->waiting[back][k]; i++)
        copy(room->wait[back] + k * LIST, i, room->now, &n);
    room->waiting[back][k] = 0;
    return n;
}

struct arrivals {
    size_t count, number;
    float *place, *weight;
    int *reflections, *scatters;
};

/* Photons at the film: kept, or sent back to the last surface. */
static void at_film(struct room *room, struct light *light, int last, int n, struct arrivals *to)
{
    float *const film = room->after, *const list = room->now;
    if (n) meet_film(n, list, BLOCK, light->film[0], film, BLOCK);
    if (n && light->sensor > 0.0f) {
        draw(n, room->chances, &light->state);
        happen(run_film_scatter, n, list, film, 2, room, light->film, 6);
    }
    for (int i = 0; i < n; i++) {
        const float scatters = list[SCATTERS * BLOCK + i], times = list[TIMES * BLOCK + i];
        if (!(film[2 * BLOCK + i] > 0.0f)) {
            light->books[STOPPED]++;
        } else if (light->sensor > 0.0f && chance(&light->state) < light->sensor) {
            if (scatters >= MOST_SCATTERS)
                light->books[CUT]++;
            else
                append(room->event, i, list[POWER * BLOCK + i], times, scatters + 1.0f, room->wait[1] + last * LIST,
                    &room->waiting[1][last]);
        } else {
            const size_t at = to->number++;
            to->place[at] = film[i];
            to->place[to->count + at] = film[BLOCK + i];
            to->weight[at] = list[POWER * BLOCK + i];
            to->reflections[at] = (int)times;
            to->scatters[at] = (int)scatters;
        }
    }
}

size_t photons(
    size_t count, int surfaces, int most, int scatters, int plain, const float *shares, uint64_t seed,
    const float *start, const int *functions, const float *numbers, const float *boost, const float *scattering,
    float *rows, float *place, float *weight, int *reflections, int *scattered, int64_t *books)
{
    const struct lens lens = { surfaces, functions, numbers };
    struct room room;
    int waiting[2][4096] = { { 0 } };
    struct light light = { most, scatters, plain, boost, scattering, shares, shares[2], shares[3], seed, books };
    struct arrivals arrivals = { count, 0, place, weight, reflections, scattered };
    room.now = rows, room.then = rows + LIST, room.after = rows + 2 * LIST, room.turned = rows + 3 * LIST;
    room.wait[0] = rows + 4 * LIST, room.wait[1] = rows + (5 + surfaces) * LIST;
    room.waiting[0] = waiting[0], room.waiting[1] = waiting[1];
    for (size_t at = 0; at < count; at += BLOCK) {
        int n = (int)(count - at < BLOCK ? count - at : BLOCK), left = 1;
        for (int r = 0; r < STATE; r++)
            for (int i = 0; i < n; i++)
                room.now[r * BLOCK + i] = start[r * count + at + i];
        for (int i = 0; i < n; i++)
            room.now[TIMES * BLOCK + i] = room.now[SCATTERS * BLOCK + i] = 0.0f;
        while (left) {
            for (int k = 0; k < surfaces; k++) {
                n = joined(&room, 0, k, n);
                if (n) n = meet(lens, &room, &light, k, 0, n, k - 1);
            }
            n = joined(&room, 0, surfaces, n);
            at_film(&room, &light, surfaces - 1, n, &arrivals);
            n = 0;
            for (int k = surfaces - 1; k >= 0; k--) {
                n = joined(&room, 1, k, n);
                if (n) n = meet(lens, &room, &light, k, 1, n, k + 1);
            }
            books[LEFT] += n;
            n = left = 0;
            for (int k = 0; k <= surfaces; k++)
                left |= waiting[0][k] | waiting[1][k];
        }
    }
    return arrivals.number;
}
"""
