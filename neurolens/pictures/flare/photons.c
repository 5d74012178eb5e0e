/* Follows photons through a lens in sweeps: see `photons.py`. `stack.c` and the graphs of `pictures.flare.photons` stand before
   this text; Python defines BLOCK, CHANCES, NUMBERS, LEVELS and MOST_SCATTERS. A list of photons is rows of BLOCK
   numbers: the state, with the photon's weight as its power, then how often the photon was reflected and how often it
   scattered. `wait` has a list of photons for each surface, where the next sweep picks them up, and for the film. */
#include <math.h>
#include <stdint.h>

enum { POWER = STATE - 2, TIMES = STATE, SCATTERS, ROWS, LIST = ROWS * BLOCK, EVENT = 8 };
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

/* Append photon `i` of a list, with its position and direction there and with the other numbers given here. */
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
    int most, scatters;
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

/* Run a graph of `pictures.flare.photons` on the state in `first`, on `count` rows of `second` and on random numbers; it writes
   `outputs` rows of `room->event`. */
static void happen(
    void (*run)(size_t, const float *const *, const float *, float *const *), int n, const float *first,
    const float *second, int count, struct room *room, const float *numbers, int outputs)
{
    const float *in[2 * STATE + CHANCES];
    float *out[EVENT];
    for (int r = 0; r < STATE; r++)
        in[r] = first + r * BLOCK;
    for (int r = 0; r < count; r++)
        in[STATE + r] = second + r * BLOCK;
    for (int r = 0; r < CHANCES; r++)
        in[STATE + count + r] = room->chances + r * BLOCK;
    for (int r = 0; r < outputs; r++)
        out[r] = room->event + r * BLOCK;
    run(n, in, numbers, out);
}

/* Photons that scatter on their way to surface k wait at k for the next sweep or, if they turn round, at `next`. */
static void scatter_on_way(struct room *room, struct light *light, int k, int back, int n, int next)
{
    const float *const list = room->now, *const kind = room->event + (EVENT - 2) * BLOCK, *const turns = kind + BLOCK;
    draw(n, room->chances, &light->state);
    for (int i = 0; k == 0 && !back && i < n; i++) /* dust lies on the front surface alone: it scatters a photon once */
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

/* Let the photons of `room->now` meet surface k. Those that pass become the new list, whose length is returned; those
   that turn round wait at surface `next`. */
static int meet(struct lens lens, struct room *room, struct light *light, int k, int back, int n, int next)
{
    const float *const power = room->after + POWER * BLOCK, *const worst = power + BLOCK, *const list = room->now;
    const float *const kind = room->event + (EVENT - 2) * BLOCK, *const boosts = light->boost + LEVELS * (2 * k + back);
    const int reflects = lens.functions[ACTIONS * k + 2 + back] >= 0;
    int on = 0, turning = 0;
    go(lens, k, back, n, room->now, room->after, BLOCK);
    if (light->scatters) scatter_on_way(room, light, k, back, n, next);
    float *const turn = room->then;
    for (int i = 0; i < n; i++) {
        if (light->scatters && kind[i] > 0.5f) continue;
        const float weight = list[POWER * BLOCK + i], times = list[TIMES * BLOCK + i];
        const float scatters = list[SCATTERS * BLOCK + i];
        const float through = worst[i] <= 1.0f ? power[i] / weight : 0.0f;
        const float boost = !reflects ? 1.0f : boosts[times < LEVELS ? (int)times : LEVELS - 1];
        /* A photon passes with T / all and turns round with boost (1 - T) / all; its weight makes up for that. */
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

static inline ALWAYS void copy(const float *list, int i, float *to, int *count)
{
    append(list, i, list[POWER * BLOCK + i], list[TIMES * BLOCK + i], list[SCATTERS * BLOCK + i], to, count);
}

/* Append the photons that wait at surface k to the list of n photons; returns the new length. */
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

/* Photons that meet the film arrive, or it sends them back to the last surface. */
static void at_film(struct room *room, struct light *light, int last, int n, struct arrivals *to)
{
    float *const film = room->after, *const list = room->now;
    if (n) meet_film(n, list, BLOCK, light->film, film, BLOCK);
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
    size_t count, int surfaces, int most, int scatters, const float *shares, uint64_t seed,
    const float *start, const int *functions, const float *numbers, const float *boost, const float *scattering,
    float *rows, float *place, float *weight, int *reflections, int *scattered, int64_t *books)
{
    const struct lens lens = { surfaces, functions, numbers };
    struct room room;
    int waiting[2][4096] = { { 0 } };
    struct light light = { most, scatters, boost, scattering, shares, shares[FILM + 1], shares[FILM + 2], seed, books };
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
