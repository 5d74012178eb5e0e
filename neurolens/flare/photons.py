"""Photon-traced flare: light that is refracted or reflected by chance at every surface, with any number of reflections.

Keshmirian 2008: photons leave the lights, and each surface reflects one with the probability of its Fresnel or coating
reflectance; those that reach the film after reflections are its flare, smoothed by a kernel. Here they are aimed at the
front surface alone and weighted by the solid angle, and go through the compiled steps of `flare.stack` in sweeps: to
the film through all surfaces, back through all, with those that turn round kept at their surface for the next sweep. No
photon is lost to the books: what is cast arrives, leaves at the front, ends at a rim, is absorbed, or is cut off.
"""

from __future__ import annotations

import ctypes
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from neurolens.base.errors import InputError
from neurolens.flare.stack import Floats, Place, Stack, entering, reflects
from neurolens.flare.steps import STATE
from neurolens.optics.prescription import Lens

BLOCK = 4096  # photons under way: their states, 36 bytes at every surface, stay in the caches
MOST_REFLECTIONS = 1000


class Photons(NamedTuple):
    """Photons that arrived at the film's plane, and the books of all that were cast.

    Attributes:
        film_xy_mm: [2, M] lens frame. reflections: [M], of each that arrived.
        cast, left, stopped, absorbed, cut: numbers of photons: all; out at the front; ended at rims; by glass or by a
            total reflection that meets no surface; with more reflections than allowed.
    """

    film_xy_mm: Floats
    reflections: NDArray[np.int32]
    cast: int
    left: int
    stopped: int
    absorbed: int
    cut: int


class PhotonTracer:
    """Photons through a lens at its focus, zoom and stop.

    Raises:
        InputError: as `GhostTracer`.
    """

    def __init__(self, lens: Lens) -> None:
        every = range(len(lens.surfaces))
        places: list[Place] = [(k, way) for k in every for way in (0, 1)]
        places += [(k, way) for k in every for way in (2, 3) if reflects(lens, k)]
        self.lens, self._stack = lens, Stack(lens, places)
        self._call = self._stack.compiled(_DRIVER.replace("$BLOCK", str(BLOCK)), "photons")
        whole, real, pointer = ctypes.c_int, ctypes.c_float, ctypes.c_void_p
        self._call.argtypes = [ctypes.c_size_t, whole, whole, real, ctypes.c_uint64, *[pointer] * 7]
        self._call.restype = ctypes.c_size_t

    def trace(self, rays: Floats, wavelength_nm: float, *, most_reflections: int = 10, seed: int = 0) -> Photons:
        """Cast a photon along each ray [6, N] (point in mm and unit direction towards the film, lens frame).

        Args:
            most_reflections: a photon that would be reflected once more is cut off. seed: of the chances.
        """
        if not 0 <= most_reflections <= MOST_REFLECTIONS:
            raise InputError("photons", "most_reflections", most_reflections, f"from 0 to {MOST_REFLECTIONS}")
        start, surfaces = entering(rays), len(self.lens.surfaces)
        numbers, shift = self._stack.numbers(wavelength_nm)
        place = np.empty((2, start.shape[1]), np.float32)
        reflections, books = np.empty(start.shape[1], np.int32), np.zeros(4, np.int64)
        room = np.empty((2 * surfaces + 5) * (STATE + 1) * BLOCK, np.float32)
        arrays = (start, self._stack.functions, numbers, room, place, reflections, books)
        pointers = [a.ctypes.data for a in arrays]
        arrived = self._call(start.shape[1], surfaces, most_reflections, shift, seed, *pointers)
        return Photons(place[:, :arrived], reflections[:arrived], start.shape[1], *(int(v) for v in books))


# Lists of photons are rows `BLOCK` long: the state, and how often the photon was reflected. `wait` holds a list for
# each surface that the next sweep meets them at, and one for the film.
_DRIVER = """
#include <stdint.h>

enum { BLOCK = $BLOCK, ROWS = STATE + 1, LIST = ROWS * BLOCK };
#if defined(__GNUC__)
#define ALWAYS __attribute__((always_inline))
#else
#define ALWAYS
#endif
enum { LEFT, STOPPED, ABSORBED, CUT };

static inline ALWAYS float chance(uint64_t *state)
{
    uint64_t z = *state += 0x9e3779b97f4a7c15u;
    z = (z ^ z >> 30) * 0xbf58476d1ce4e5b9u;
    z = (z ^ z >> 27) * 0x94d049bb133111ebu;
    return (float)((z ^ z >> 31) >> 40) * 0x1p-24f;
}

/* Append photon `i` of a list, with all its light, reflected so many times. */
static inline ALWAYS void append(const float *from, int i, float reflections, float *list, int *count)
{
    for (int r = 0; r < STATE - 2; r++)
        list[r * BLOCK + *count] = from[r * BLOCK + i];
    list[(STATE - 2) * BLOCK + *count] = 1.0f;
    list[(STATE - 1) * BLOCK + *count] = 0.0f;
    list[STATE * BLOCK + (*count)++] = reflections;
}

struct room {
    float *now, *then, *after, *turned, *wait[2];
    int *waiting[2];
    float drawn[BLOCK], through[BLOCK];
};

/* Photons of `room->now` at surface k: those that go through become the list, those that turn round wait at `next`. */
static int meet(
    struct lens lens, struct room *room, int k, int back, int n, int next, int most, uint64_t *state, int64_t *books)
{
    const float *const power = room->after + (STATE - 2) * BLOCK, *const worst = power + BLOCK;
    int on = 0, turning = 0;
    go(lens, k, back, n, room->now, room->after, BLOCK);
    float *const turn = room->then;
    for (int i = 0; i < n; i++) {
        const float drawn = chance(state), through = worst[i] <= 1.0f ? power[i] : 0.0f;
        const float times = room->now[STATE * BLOCK + i];
        if (drawn < through) {
            append(room->after, i, times, room->after, &on);
            continue;
        }
        room->drawn[turning] = drawn;
        room->through[turning] = worst[i] <= 1.0f ? through : -1.0f;
        append(room->now, i, times, turn, &turning);
    }
    const int reflects = lens.functions[ACTIONS * k + 2 + back] >= 0;
    if (reflects && turning)
        go(lens, k, 2 + back, turning, turn, room->turned, BLOCK);
    const float *const shared = room->turned + (STATE - 2) * BLOCK, *const rim = shared + BLOCK;
    for (int i = 0; i < turning; i++) {
        const float times = turn[STATE * BLOCK + i];
        const float through = room->through[i] > 0.0f ? room->through[i] : 0.0f;
        if (reflects ? !(rim[i] <= 1.0f) : room->through[i] < 0.0f)
            books[STOPPED]++;
        else if (!reflects || !(room->drawn[i] < through + shared[i]))
            books[ABSORBED]++;
        else if (times >= most)
            books[CUT]++;
        else if (next < 0)
            books[LEFT]++;
        else
            append(room->turned, i, times + 1.0f, room->wait[!back] + next * LIST, &room->waiting[!back][next]);
    }
    float *const other = room->now;
    room->now = room->after;
    room->after = other;
    return on;
}

/* The list and those that wait at a surface. */
static int joined(struct room *room, int back, int k, int n)
{
    const float *const list = room->wait[back] + k * LIST;
    for (int i = 0; i < room->waiting[back][k]; i++)
        append(list, i, list[STATE * BLOCK + i], room->now, &n);
    room->waiting[back][k] = 0;
    return n;
}

size_t photons(
    size_t count, int surfaces, int most, float shift, uint64_t seed, const float *start, const int *functions,
    const float *numbers, float *rows, float *place, int *reflections, int64_t *books)
{
    const struct lens lens = { surfaces, functions, numbers };
    int waiting[2][4096] = { { 0 } };
    struct room room = { rows, rows + LIST, rows + 2 * LIST, rows + 3 * LIST,
        { rows + 4 * LIST, rows + (5 + surfaces) * LIST }, { waiting[0], waiting[1] }, { 0 }, { 0 } };
    size_t arrived = 0;
    uint64_t state = seed;
    for (size_t at = 0; at < count; at += BLOCK) {
        int n = (int)(count - at < BLOCK ? count - at : BLOCK), left = 1;
        for (int r = 0; r < STATE; r++)
            for (int i = 0; i < n; i++)
                room.now[r * BLOCK + i] = start[r * count + at + i];
        for (int i = 0; i < n; i++)
            room.now[STATE * BLOCK + i] = 0.0f;
        while (left) {
            for (int k = 0; k < surfaces; k++) {
                n = joined(&room, 0, k, n);
                if (n) n = meet(lens, &room, k, 0, n, k - 1, most, &state, books);
            }
            n = joined(&room, 0, surfaces, n);
            float *const film = room.after;
            if (n) meet_film(n, room.now, BLOCK, shift, film, BLOCK);
            for (int i = 0; i < n; i++) {
                if (!(film[2 * BLOCK + i] > 0.0f)) {
                    books[STOPPED]++;
                    continue;
                }
                place[arrived] = film[i];
                place[count + arrived] = film[BLOCK + i];
                reflections[arrived++] = (int)room.now[STATE * BLOCK + i];
            }
            n = 0;
            for (int k = surfaces - 1; k >= 0; k--) {
                n = joined(&room, 1, k, n);
                if (n) n = meet(lens, &room, k, 1, n, k + 1, most, &state, books);
            }
            books[LEFT] += n;
            n = left = 0;
            for (int k = 0; k <= surfaces; k++)
                left |= waiting[0][k];
        }
    }
    return arrived;
}
"""
