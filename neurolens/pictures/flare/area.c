/* Turns the cells of a grid into edges (`edges`), and edges into a picture (`draw`): see `canvas.py`. Python defines
   LOST. */
#include <math.h>
#include <stddef.h>
#include <stdint.h>

#define SMALL 1e-6 /* square pixels: the light of a smaller triangle goes to its corners */
#define FAR 1e7 /* pixels: a triangle that reaches farther is not drawn */
#define EVEN 2.0 /* square pixels: a smaller half of a cell has one density */
#if defined(__GNUC__)
#define ALWAYS __attribute__((always_inline))
#else
#define ALWAYS
#endif

struct point { double x, y; };
/* Red, green, blue and an unused number, in one register. */
typedef double rgb __attribute__((vector_size(32), aligned(8)));
/* A linear density: its value at the picture's corner, and its growth per pixel to the right and down. */
struct plane { double level, right, down; };
/* To the right of an edge along which y grows the density is larger by `density`. An edge of two equal points is light
   at that point. */
struct edge { struct point p, q; struct plane density; };
struct canvas {
    int width, first, last;
    rgb *sums, *slopes, light; /* differences of each pixel from the one to its left, of the level and of the slope */
};

static inline ALWAYS struct point between(struct point p, struct point q, double share)
{
    return (struct point){ p.x + share * (q.x - p.x), p.y + share * (q.y - p.y) };
}

/* Add the part of an edge in one row, from x = a to b > a and `amount` high. If r(t) is the mean of max(t - x, 0) along
   the edge, it covers r(k + 1) - r(k) of pixel k. */
static inline ALWAYS void in_row(rgb *row, double a, double b, rgb amount)
{
    const int first = (int)a, last = (int)b;
    if (first == last) {
        const rgb right = amount * (0.5 * (a + b) - first);
        row[first] += amount - right;
        row[first + 1] += right;
        return;
    }
    const double half = 0.5 / (b - a);
    double covered = 0.0, before = 0.0;
    for (int k = first; k <= last + 1; k++) {
        const double t = k + 1 - a, r = k + 1 <= b ? half * t * t : k + 1 - 0.5 * (a + b);
        row[k] += amount * (r - before - covered);
        covered = r - before;
        before = r;
    }
}

/* Draw an edge between the left and the right border, with p above q, in the rows of the canvas. */
static void line(struct canvas c, struct point p, struct point q, struct plane density)
{
    if (!(p.y < q.y && p.y < c.last && q.y > c.first)) return;
    const double slope = (q.x - p.x) / (q.y - p.y);
    const rgb slope_light = density.right * c.light;
    const int sloped = density.right != 0.0, last = q.y < c.last ? (int)q.y : c.last - 1;
    int k = p.y > c.first ? (int)p.y : c.first;
    double y = p.y > k ? p.y : k, x = p.y > k ? p.x : p.x + slope * (k - p.y);
    rgb *row = c.sums + (size_t)(k - c.first) * (c.width + 3), *slopes = c.slopes + (row - c.sums);
    for (; k <= last; k++, row += c.width + 3, slopes += c.width + 3) {
        const rgb light = (density.level + density.down * (k + 0.5)) * c.light;
        const int ends = q.y <= k + 1;
        const double next = ends ? q.y : k + 1, end = ends ? q.x : p.x + slope * (k + 1 - p.y);
        const double a = x < end ? x : end, b = x < end ? end : x;
        in_row(row, a, b, (next - y) * light);
        if (sloped) in_row(slopes, a, b, (next - y) * slope_light);
        x = end;
        y = next;
    }
}

/* Draw any edge. The part of it to the left of the film is moved to the left border. */
static void draw_edge(struct canvas c, struct point p, struct point q, struct plane density)
{
    if (p.y > q.y) {
        const struct point other = p;
        p = q;
        q = other;
        density = (struct plane){ -density.level, -density.right, -density.down };
    }
    if (!(p.y < c.last && q.y > c.first && (p.x < c.width || q.x < c.width))) return;
    const struct point from = p;
    const double per_x = (q.y - p.y) / (q.x - p.x);
    for (int right = 0; right < 2; right++) {
        const double border = right ? c.width : 0.0;
        const int p_in = right ? p.x <= border : p.x >= 0.0, q_in = right ? q.x <= border : q.x >= 0.0;
        if (p_in && q_in) continue;
        const struct point top = { border, p.y }, below = { border, q.y };
        if (p_in == q_in) {
            p.x = q.x = border;
            continue;
        }
        const double y = from.y + (border - from.x) * per_x;
        const struct point m = { border, fmin(fmax(y, p.y), q.y) };
        if (!right && p_in) line(c, m, below, density);
        if (!right && q_in) line(c, top, m, density);
        *(p_in ? &q : &p) = m;
    }
    line(c, p, q, density);
}

/* Share the light at a point among the four pixels around it. */
static void dot(struct canvas c, struct point p, double light)
{
    const double u = p.x - 0.5, v = p.y - 0.5;
    if (!(u > -1.0 && v > c.first - 1.0 && u < c.width && v < c.last)) return;
    const int left = (int)floor(u), top = (int)floor(v);
    for (int k = 0; k < 4; k++) {
        const int x = left + (k & 1), y = top + (k >> 1);
        const double part = (k & 1 ? u - left : 1.0 - u + left) * (k >> 1 ? v - top : 1.0 - v + top) * light;
        if (x < 0 || y < c.first || x >= c.width || y >= c.last) continue;
        rgb *const at = c.sums + (size_t)(y - c.first) * (c.width + 3) + x;
        at[0] += part * c.light;
        at[1] -= part * c.light;
    }
}

/* Sum the differences along each row and add them to the picture; values that are 0 but for rounding become 0. */
static void settle(struct canvas c, float *picture)
{
    for (int j = 0; j < c.last - c.first; j++) {
        const rgb *const row = c.sums + (size_t)j * (c.width + 3), *const slopes = c.slopes + (row - c.sums);
        rgb level = { 0.0 }, slope = { 0.0 }, most = { 0.0 };
        float *pixel = picture + (size_t)j * c.width * 3;
        for (int i = 0; i < c.width; i++, pixel += 3) {
            level += row[i];
            slope += slopes[i];
            const rgb light = level + (i + 0.5) * slope;
            for (int k = 0; k < 3; k++) {
                const double size = fabs(level[k]);
                most[k] = size > most[k] ? size : most[k];
                pixel[k] += fabs(light[k]) > 1e-12 * most[k] ? light[k] : 0.0;
            }
        }
    }
}
/* Draw edges of several grids, `counts` of each, to rows of a picture; `sums` has zeros for these rows. */
void draw(
    int width, int first, int rows, int grids, const int64_t *counts, const struct edge *e,
    const rgb *light, rgb *sums, float *picture)
{
    struct canvas c = { width, first, first + rows, sums, sums + (size_t)rows * (width + 3), { 0.0 } };
    for (int k = 0; k < grids; k++) {
        c.light = light[k];
        for (const struct edge *const end = e + counts[k]; e < end; e++)
            if (e->p.x == e->q.x && e->p.y == e->q.y) dot(c, e->p, e->density.level);
            else draw_edge(c, e->p, e->q, e->density);
    }
    settle(c, picture);
}

static inline ALWAYS double area_of(struct point a, struct point b, struct point c)
{
    return 0.5 * ((b.x - a.x) * (c.y - a.y) - (c.x - a.x) * (b.y - a.y));
}

/* Where ray o of the grid, which is lost, would have met the film, extrapolated from its neighbours; returns whether
   there are any. */
static int beyond(int columns, int rows, size_t o, const float *x, const float *y, const float *worst, double *to)
{
    const int wide = columns + 1, i = (int)(o % wide), j = (int)(o / wide);
    int neighbours = 0;
    to[0] = to[1] = 0.0;
    for (int d = 0; d < 9; d++) {
        const int u = d % 3 - 1, v = d / 3 - 1, step = v * wide + u;
        if (i + 2 * u < 0 || j + 2 * v < 0 || i + 2 * u > columns || j + 2 * v > rows) continue;
        const size_t near = o + step, far = near + step;
        if (!(worst[near] < LOST && worst[far] < LOST)) continue;
        to[0] += 2.0 * x[near] - x[far];
        to[1] += 2.0 * y[near] - y[far];
        neighbours++;
    }
    for (int k = 0; k < 2 && neighbours; k++) to[k] /= neighbours;
    return neighbours > 0;
}

/* Append an edge, unless it lies along a row of pixels or its density is 0. */
static inline ALWAYS struct edge *step(struct edge *to, struct point p, struct point q, struct plane density)
{
    if (p.y != q.y && (density.level != 0.0 || density.right != 0.0 || density.down != 0.0))
        *to++ = (struct edge){ p, q, density };
    return to;
}

static inline ALWAYS void add(struct plane *to, struct plane more, double factor)
{
    to->level += factor * more.level;
    to->right += factor * more.right;
    to->down += factor * more.down;
}

/* Append the edges of a triangle that rims cut; `light` is the light of the whole triangle per power. Half of the side
   to a lost corner is lit. */
static struct edge *cut(
    struct edge *to, const struct point *corner, const double *power, const double *worst, double light)
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
        const int lost = !(worst[k] < LOST && worst[l] < LOST);
        const double here = sqrt(fmax(worst[k], 0.0)), there = sqrt(fmax(worst[l], 0.0));
        const double f = lost ? 0.5 : (1.0 - here) / (there - here);
        kept[n] = between(corner[k], corner[l], f);
        pupil[n++] = between(unit[k], unit[l], f);
    }
    for (int k = 2; k < n; k++) {
        share += 2.0 * area_of(pupil[0], pupil[k - 1], pupil[k]);
        area += area_of(kept[0], kept[k - 1], kept[k]);
    }
    light *= share * mean / inside;
    for (int k = 0; k < n; k++) {
        if (fabs(area) > SMALL) to = step(to, kept[k], kept[(k + 1) % n], (struct plane){ -light / area, 0.0, 0.0 });
        else *to++ = (struct edge){ kept[k], kept[k], { light / n, 0.0, 0.0 } };
    }
    return to;
}

/* Whether four points all lie more than a pixel beyond the same side of the film. */
static inline ALWAYS int apart(int width, int height, struct point p, struct point q, struct point r, struct point s)
{
    const double right = width + 1.0, below = height + 1.0;
    return (p.x < -1.0 && q.x < -1.0 && r.x < -1.0 && s.x < -1.0)
        || (p.y < -1.0 && q.y < -1.0 && r.y < -1.0 && s.y < -1.0)
        || (p.x > right && q.x > right && r.x > right && s.x > right)
        || (p.y > below && q.y > below && r.y > below && s.y > below);
}

/* Fit linear densities to the corners of both halves of a cell, with the mean density of each half. The density is
   constant where corners differ too much, as at folds and caustics, or where the cell is hardly a pixel. */
static void sloped(
    const struct point corner[2][3], const double value[2][3], const double *density, const double *area,
    struct plane *plane)
{
    double mean[2], off[2];
    int even[2];
    for (int h = 0; h < 2; h++) {
        plane[h] = (struct plane){ density[h], 0.0, 0.0 };
        mean[h] = (value[h][0] + value[h][1] + value[h][2]) / 3.0;
        off[h] = density[h] - mean[h];
        even[h] = fabs(area[h]) > EVEN;
        for (int k = 0; k < 3; k++)
            even[h] &= value[h][k] / density[h] > 0.5 && value[h][k] / density[h] < 2.0;
    }
    if (density[0] == density[1] && even[0] && even[1]) /* otherwise the half at a caustic would shift the other */
        off[0] = off[1] = density[0] - (mean[0] * area[0] + mean[1] * area[1]) / (area[0] + area[1]);
    for (int h = 0; h < 2; h++) {
        const struct point *const p = corner[h];
        const double *const v = value[h];
        if (!even[h]) continue;
        const double dx = p[1].x - p[0].x, dy = p[1].y - p[0].y, ex = p[2].x - p[0].x, ey = p[2].y - p[0].y;
        const double right = ((v[1] - v[0]) * ey - (v[2] - v[0]) * dy) / (2.0 * area[h]);
        const double down = ((v[2] - v[0]) * dx - (v[1] - v[0]) * ex) / (2.0 * area[h]);
        plane[h] = (struct plane){ v[0] + off[h] - right * p[0].x - down * p[0].y, right, down };
    }
}

/* Write the edges of a grid's cells and return their number. Whole cells share edges, so the steps of density across
   edges along rows, columns and diagonals are summed first. Cells beside the film are left out. `room` has [15, N]
   zeros. */
size_t edges(
    int columns, int rows, int width, int height, double per_mm, const float *found, double *room, struct edge *to)
{
    const size_t wide = columns + 1, all = wide * (rows + 1);
    const float *const x = found, *const y = x + all, *const power = y + all, *const worst = power + all;
    struct point *const place = (struct point *)room;
    struct plane *const level = (struct plane *)(room + 2 * all), *const upright = level + all;
    struct plane *const slanted = upright + all;
    double *const densities = room + 11 * all, *const sum = densities + 2 * all, *const number = sum + all;
    const struct edge *const from = to;
#define ON_FILM(x, y) ((struct point){ 0.5 * width - per_mm * (x), 0.5 * height + per_mm * (y) })
    for (size_t k = 0; k < all; k++)
        place[k] = ON_FILM(x[k], y[k]);
    for (int j = 0; j < rows; j++)
        for (int i = 0; i < columns; i++) {
            const size_t o = j * wide + i, at[2][3] = { { o, o + 1, o + wide + 1 }, { o, o + wide + 1, o + wide } };
            double light[2], area[2], density[2];
            const float w[4] = { worst[o], worst[o + 1], worst[o + wide], worst[o + wide + 1] };
            if (!(w[0] <= 1.0f || w[1] <= 1.0f || w[2] <= 1.0f || w[3] <= 1.0f)) continue;
            if (w[0] < LOST && w[1] < LOST && w[2] < LOST && w[3] < LOST
                && apart(width, height, place[o], place[o + 1], place[o + wide], place[o + wide + 1]))
                continue;
            for (int h = 0; h < 2; h++) {
                struct point corner[3];
                double p[3], w[3];
                int in = 0, near = 1;
                for (int k = 0; k < 3; k++) {
                    corner[k] = place[at[h][k]];
                    p[k] = power[at[h][k]];
                    w[k] = worst[at[h][k]];
                    in += w[k] <= 1.0;
                    near &= !(w[k] < LOST) || (fabs(corner[k].x) < FAR && fabs(corner[k].y) < FAR);
                }
                light[h] = (p[0] + p[1] + p[2]) / 6.0;
                area[h] = area_of(corner[0], corner[1], corner[2]);
                density[h] = in == 3 && near && fabs(area[h]) > SMALL ? -light[h] / area[h] : 0.0;
                for (int k = 0; k < 3 && in > 0 && in < 3; k++) {
                    const int next = (k + 1) % 3, kept = w[next] <= 1.0 ? next : (k + 2) % 3;
                    double ahead[2];
                    if (w[k] < LOST) continue;
                    const int known = beyond(columns, rows, at[h][k], x, y, worst, ahead);
                    const struct point there = ON_FILM(ahead[0], ahead[1]);
                    corner[k] = known && fabs(there.x) < FAR && fabs(there.y) < FAR ? there : corner[kept];
                }
                if (in > 0 && in < 3 && near) to = cut(to, corner, p, w, 0.5);
                for (int k = 0; k < 3 && in == 3 && near && density[h] == 0.0; k++)
                    *to++ = (struct edge){ corner[k], corner[k], { light[h] / 3.0, 0.0, 0.0 } };
            }
            const double ratio = area[0] / area[1];
            if (density[0] != 0.0 && density[1] != 0.0 && ratio > 0.5 && ratio < 2.0) /* no fold: halves are alike */
                density[0] = density[1] = -(light[0] + light[1]) / (area[0] + area[1]);
            for (int h = 0; h < 2; h++) {
                densities[2 * o + h] = density[h];
                for (int k = 0; k < 3 && density[h] != 0.0; k++) {
                    sum[at[h][k]] += density[h];
                    number[at[h][k]] += 1.0;
                }
            }
        }
    for (int j = 0; j < rows; j++)
        for (int i = 0; i < columns; i++) {
            const size_t o = j * wide + i, at[2][3] = { { o, o + 1, o + wide + 1 }, { o, o + wide + 1, o + wide } };
            const double *const density = densities + 2 * o;
            struct point corner[2][3];
            struct plane plane[2];
            double value[2][3], area[2];
            if (density[0] == 0.0 && density[1] == 0.0) continue;
            for (int h = 0; h < 2; h++) {
                for (int k = 0; k < 3; k++) {
                    corner[h][k] = place[at[h][k]];
                    value[h][k] = sum[at[h][k]] / fmax(number[at[h][k]], 1.0);
                }
                area[h] = area_of(corner[h][0], corner[h][1], corner[h][2]);
            }
            sloped(corner, value, density, area, plane);
            add(level + o, plane[0], 1.0);
            add(upright + o + 1, plane[0], 1.0);
            add(level + o + wide, plane[1], -1.0);
            add(upright + o, plane[1], -1.0);
            add(slanted + o, plane[1], 1.0);
            add(slanted + o, plane[0], -1.0);
        }
    for (int j = 0; j <= rows; j++)
        for (int i = 0; i <= columns; i++) {
            const size_t o = j * wide + i;
            const struct point p = place[o];
            if (i < columns) to = step(to, p, place[o + 1], level[o]);
            if (j < rows) to = step(to, p, place[o + wide], upright[o]);
            if (i < columns && j < rows) to = step(to, p, place[o + wide + 1], slanted[o]);
        }
    return (size_t)(to - from);
}
