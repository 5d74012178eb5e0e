"""Light of a grid of rays as areas: each cell of the pupil spreads its light evenly over its place on the film.

So the picture of a ghost has neither holes nor noise, and its sum is the ghost's light, however the map from pupil to
film stretches, folds or turns it (Hullin et al. 2011, section 4.2, spread light by the area of quads). Rims cut cells
where the largest r / R on the way is 1, taken to be linear in between. Pixels are covered exactly: an edge adds its
height, times the step of density across it, to the pixels that it passes, and sums along rows are the picture.
"""

from __future__ import annotations

import ctypes
from functools import cache

import numpy as np
from numpy.typing import NDArray

from neurolens.flare.stack import Floats
from neurolens.flare.steps import LOST
from neurolens.graph.compiler import load_compiled


class Canvas:
    """Light on a film of `width` x `height` pixels, centred and upright (the film turned by 180 degrees).

    Raises:
        InputError: no C compiler, or one that fails.
    """

    def __init__(self, width: int, height: int) -> None:
        self.width, self.height = width, height
        self._sums = np.zeros((height, width + 2))  # what each pixel's light differs by from that of the one before

    def add(self, found: Floats, columns: int, share: float, per_mm: float) -> None:
        """Add the light of a grid of rays.

        Args:
            found: [4, N] film x, y (mm), power, worst of the rays, row after row, each one ray longer than `columns`.
            share: light of a cell whose power is 1. per_mm: pixels.
        """
        rows = found.shape[1] // (columns + 1) - 1
        assert found.dtype == np.float32 and found.flags.c_contiguous and found.shape == (4, (rows + 1) * (columns + 1))
        steps = np.zeros((3, found.shape[1]))
        pointers = [a.ctypes.data for a in (found, steps, self._sums)]
        _compiled().cover(columns, rows, self.width, self.height, share, per_mm, *pointers)

    def onto(self, picture: Floats, colour: NDArray[np.float64]) -> None:
        """Add all light, times a colour [3], to a picture [H, W, 3], and be empty."""
        assert picture.dtype == np.float32 and picture.flags.c_contiguous
        assert picture.shape == (self.height, self.width, 3)
        given = np.ascontiguousarray(colour, np.float64)
        _compiled().settle(self.width, self.height, *(a.ctypes.data for a in (self._sums, given, picture)))


@cache
def _compiled() -> ctypes.CDLL:
    library = load_compiled(_TEXT.replace("$LOST", str(LOST)))
    whole, real, pointer = ctypes.c_int, ctypes.c_double, ctypes.c_void_p
    library.cover.argtypes = [whole, whole, whole, whole, real, real, pointer, pointer, pointer]
    library.settle.argtypes = [whole, whole, pointer, pointer, pointer]
    library.cover.restype = library.settle.restype = None
    return library


_TEXT = """
#include <math.h>
#include <stddef.h>

#define SMALL 1e-6 /* square pixels, whose light goes to its corners instead */
#define FAR 1e7 /* pixels */
#if defined(__GNUC__)
#define ALWAYS __attribute__((always_inline))
#else
#define ALWAYS
#endif

struct point { double x, y; };
struct canvas { int width, height; double *sums; };

static inline ALWAYS struct point between(struct point p, struct point q, double share)
{
    return (struct point){ p.x + share * (q.x - p.x), p.y + share * (q.y - p.y) };
}

/* One row's part of an edge, from x = a to b > a, `amount` high. With r(t) the mean of max(t - x, 0) along it, what it
   covers of pixel k is r(k + 1) - r(k). */
static inline ALWAYS void in_row(double *row, double a, double b, double amount)
{
    const int first = (int)a, last = (int)b;
    if (first == last) {
        const double right = amount * (0.5 * (a + b) - first);
        row[first] += amount - right;
        row[first + 1] += right;
        return;
    }
    const double half = 0.5 * amount / (b - a);
    double covered = 0.0, before = 0.0;
    for (int k = first; k <= last + 1; k++) {
        const double t = k + 1 - a, r = k + 1 <= b ? half * t * t : amount * (k + 1 - 0.5 * (a + b));
        row[k] += r - before - covered;
        covered = r - before;
        before = r;
    }
}

/* An edge that lies on the canvas: right of it the density is larger. */
static void line(struct canvas c, struct point p, struct point q, double density)
{
    const double slope = (q.x - p.x) / (q.y - p.y);
    double x = p.x, y = p.y;
    for (int k = (int)p.y; k < c.height && y < q.y; k++) {
        const double next = k + 1 < q.y ? k + 1 : q.y, end = k + 1 < q.y ? x + slope * (next - y) : q.x;
        double *const row = c.sums + (size_t)k * (c.width + 2);
        if (x < end) in_row(row, x, end, (next - y) * density);
        else in_row(row, end, x, (next - y) * density);
        x = end;
        y = next;
    }
}

/* Any edge: right of it, where y grows along it, the density is larger. Left of the canvas it counts at its border. */
static void edge(struct canvas c, struct point p, struct point q, double density)
{
    if (p.y > q.y) {
        const struct point other = p;
        p = q;
        q = other;
        density = -density;
    }
    if (!(density != 0.0 && p.y < q.y && p.y < c.height && q.y > 0.0)) return;
    const struct point from = p, to = q;
    const double high = q.y - p.y, wide = q.x - p.x;
    if (p.y < 0.0) p = (struct point){ from.x - from.y * wide / high, 0.0 };
    if (q.y > c.height) q = (struct point){ from.x + (c.height - from.y) * wide / high, c.height };
    for (int right = 0; right < 2; right++) {
        const double border = right ? c.width : 0.0;
        const int p_in = right ? p.x <= border : p.x >= 0.0, q_in = right ? q.x <= border : q.x >= 0.0;
        if (p_in && q_in) continue;
        const double y = from.y + (border - from.x) * high / wide;
        const struct point m = { border, p_in == q_in ? q.y : fmin(fmax(y, p.y), q.y) };
        const struct point out[2] = { { border, q_in ? p.y : m.y }, { border, q_in ? m.y : q.y } };
        if (p_in == q_in) {
            p.x = q.x = border;
        } else {
            if (!right && out[0].y < out[1].y) line(c, out[0], out[1], density);
            *(p_in ? &q : &p) = m;
        }
    }
    if (p.y < q.y && !(p.x >= c.width && q.x >= c.width)) line(c, p, q, density);
}

/* Light at a point, shared among the four pixels round it. */
static void dot(struct canvas c, struct point p, double light)
{
    const double u = p.x - 0.5, v = p.y - 0.5;
    if (!(u > -1.0 && v > -1.0 && u < c.width && v < c.height)) return;
    const int left = (int)floor(u), top = (int)floor(v);
    for (int k = 0; k < 4; k++) {
        const int x = left + (k & 1), y = top + (k >> 1);
        const double part = (k & 1 ? u - left : 1.0 - u + left) * (k >> 1 ? v - top : 1.0 - v + top) * light;
        if (x < 0 || y < 0 || x >= c.width || y >= c.height) continue;
        c.sums[(size_t)y * (c.width + 2) + x] += part;
        c.sums[(size_t)y * (c.width + 2) + x + 1] -= part;
    }
}

static inline ALWAYS double area_of(struct point a, struct point b, struct point c)
{
    return 0.5 * ((b.x - a.x) * (c.y - a.y) - (c.x - a.x) * (b.y - a.y));
}

/* Where ray o of the grid, which is lost, would have gone: as those beside it go on. Whether any tell. */
static int beyond(int columns, int rows, size_t o, const float *x, const float *y, const float *worst, double *to)
{
    const int wide = columns + 1, i = (int)(o % wide), j = (int)(o / wide);
    int told = 0;
    to[0] = to[1] = 0.0;
    for (int d = 0; d < 9; d++) {
        const int u = d % 3 - 1, v = d / 3 - 1, step = v * wide + u;
        if (i + 2 * u < 0 || j + 2 * v < 0 || i + 2 * u > columns || j + 2 * v > rows) continue;
        const size_t near = o + step, far = near + step;
        if (!(worst[near] < $LOST && worst[far] < $LOST)) continue;
        to[0] += 2.0 * x[near] - x[far];
        to[1] += 2.0 * y[near] - y[far];
        told++;
    }
    for (int k = 0; k < 2 && told; k++) to[k] /= told;
    return told > 0;
}

/* A triangle of which rims cut off some: `light` would be all of it. Half the way to a corner that is lost is lit. */
static void cut(struct canvas c, const struct point *corner, const double *power, const double *worst, double light)
{
    static const struct point unit[3] = { { 0.0, 0.0 }, { 1.0, 0.0 }, { 0.0, 1.0 } };
    struct point kept[4], pupil[4];
    double mean = 0.0, share = 0.0, area = 0.0;
    int n = 0, inside = 0;
    for (int k = 0; k < 3; k++) {
        const int l = (k + 1) % 3, in = worst[k] <= 1.0, on = worst[l] <= 1.0;
        if (in) {
            kept[n] = corner[k];
            pupil[n++] = unit[k];
            mean += power[k];
            inside++;
        }
        if (in == on) continue;
        const int lost = !(worst[k] < $LOST && worst[l] < $LOST);
        const double from = sqrt(fmax(worst[k], 0.0)), to = sqrt(fmax(worst[l], 0.0));
        const double f = lost ? 0.5 : (1.0 - from) / (to - from);
        kept[n] = between(corner[k], corner[l], f);
        pupil[n++] = between(unit[k], unit[l], f);
    }
    for (int k = 2; k < n; k++) {
        share += 2.0 * area_of(pupil[0], pupil[k - 1], pupil[k]);
        area += area_of(kept[0], kept[k - 1], kept[k]);
    }
    light *= share * mean / inside;
    for (int k = 0; k < n; k++) {
        if (fabs(area) > SMALL) edge(c, kept[k], kept[(k + 1) % n], -light / area);
        else dot(c, kept[k], light / n);
    }
}

/* Whole cells share edges, each of which is drawn once: `steps` are the steps of density across edges along rows, along
   columns and along diagonals. */
void cover(
    int columns, int rows, int width, int height, double share, double per_mm, const float *found, double *steps,
    double *sums)
{
    const struct canvas c = { width, height, sums };
    const size_t wide = columns + 1, all = wide * (rows + 1);
    const float *const x = found, *const y = x + all, *const power = y + all, *const worst = power + all;
    double *const level = steps, *const upright = level + all, *const slanted = upright + all;
#define ON_FILM(x, y) ((struct point){ 0.5 * width - per_mm * (x), 0.5 * height + per_mm * (y) })
#define PLACE(k) ON_FILM(x[k], y[k])
    for (int j = 0; j < rows; j++)
        for (int i = 0; i < columns; i++) {
            const size_t o = j * wide + i, at[2][3] = { { o, o + 1, o + wide + 1 }, { o, o + wide + 1, o + wide } };
            double light[2], area[2], density[2];
            for (int h = 0; h < 2; h++) {
                struct point corner[3];
                double p[3], w[3];
                int in = 0, near = 1;
                for (int k = 0; k < 3; k++) {
                    corner[k] = PLACE(at[h][k]);
                    p[k] = power[at[h][k]];
                    w[k] = worst[at[h][k]];
                    in += w[k] <= 1.0;
                    near &= !(w[k] < $LOST) || (fabs(corner[k].x) < FAR && fabs(corner[k].y) < FAR);
                }
                light[h] = share * (p[0] + p[1] + p[2]) / 6.0;
                area[h] = area_of(corner[0], corner[1], corner[2]);
                density[h] = in == 3 && near && fabs(area[h]) > SMALL ? -light[h] / area[h] : 0.0;
                for (int k = 0; k < 3 && in > 0 && in < 3; k++) {
                    const int next = (k + 1) % 3, kept = w[next] <= 1.0 ? next : (k + 2) % 3;
                    double to[2];
                    if (w[k] < $LOST) continue;
                    const int told = beyond(columns, rows, at[h][k], x, y, worst, to);
                    const struct point there = ON_FILM(to[0], to[1]);
                    corner[k] = told && fabs(there.x) < FAR && fabs(there.y) < FAR ? there : corner[kept];
                }
                if (in > 0 && in < 3 && near) cut(c, corner, p, w, 0.5 * share);
                for (int k = 0; k < 3 && in == 3 && near && density[h] == 0.0; k++)
                    dot(c, corner[k], light[h] / 3.0);
            }
            const double ratio = area[0] / area[1];
            if (density[0] != 0.0 && density[1] != 0.0 && ratio > 0.5 && ratio < 2.0) /* no fold: one cell */
                density[0] = density[1] = -(light[0] + light[1]) / (area[0] + area[1]);
            level[o] += density[0];
            upright[o + 1] += density[0];
            level[o + wide] -= density[1];
            upright[o] -= density[1];
            slanted[o] += density[1] - density[0];
        }
    for (int j = 0; j <= rows; j++)
        for (int i = 0; i <= columns; i++) {
            const size_t o = j * wide + i;
            if (level[o] != 0.0) edge(c, PLACE(o), PLACE(o + 1), level[o]);
            if (upright[o] != 0.0) edge(c, PLACE(o), PLACE(o + wide), upright[o]);
            if (slanted[o] != 0.0) edge(c, PLACE(o), PLACE(o + wide + 1), slanted[o]);
        }
}

void settle(int width, int height, double *sums, const double *colour, float *picture)
{
    for (int j = 0; j < height; j++) {
        double *const row = sums + (size_t)j * (width + 2);
        double light = 0.0;
        float *const pixel = picture + (size_t)j * width * 3;
        for (int i = 0; i < width; i++) {
            light += row[i];
            row[i] = 0.0;
            for (int k = 0; k < 3; k++)
                pixel[3 * i + k] += colour[k] * fmax(light, 0.0);
        }
        row[width] = row[width + 1] = 0.0;
    }
}
"""
