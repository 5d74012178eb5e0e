/* The light of a plate as a camera gathers it: see `pictures/defocus/picture.py`. Python defines NUMBERS, WEIGHT, FINEST
   and CLEAR.

   A ray of the camera is a straight line in the plate: at the inverse depth w (1/m, from the plate's eye) it is seen at
   x = ax + bx w, y = ay + by w. It meets what is nearest: the largest w at which the plate's own inverse depth reaches
   that of the ray. */
#include <math.h>
#include <stddef.h>
#include <stdint.h>
#include <string.h>

struct layer {
    int width, height, levels;
    const float *texel; /* [height, width, 4]: red, green, blue, inverse depth; below 0: there is nothing */
    const float *jump; /* [height, width]: steps of inverse depth to a neighbour that are no edge of a thing */
    const float *bounds; /* least and largest inverse depth of cells of 2^FINEST, twice that ... pixels, level by level */
    const int64_t *start; /* first cell of each level */
    float nearest; /* the largest inverse depth */
};
struct table { /* rays of film points, for each of `samples` points of the pupil */
    int across, down, samples, channels, stride; /* nodes, and what each has */
    float pitch_x, pitch_y; /* pixels */
    /* [nodes, samples, stride]: ax, ay, bx, by, weight of green, red, blue. Where green does not pass, none does. */
    const float *rays;
    const float *jitter; /* [samples, 2]: place within a pixel */
    float above; /* pixels from the first row of nodes to the first row of pixels */
};
struct line { float ax, ay, bx, by; };
enum { NOTHING, MET, HIDDEN };
#if defined(__GNUC__)
#define ALWAYS static inline __attribute__((always_inline))
#else
#define ALWAYS static inline
#endif

ALWAYS float lesser(float a, float b) { return a < b ? a : b; }
ALWAYS float larger(float a, float b) { return a > b ? a : b; }
ALWAYS int clamped(float v, int n) { return (int)lesser(larger(v, 0.0f), n - 1); }

ALWAYS float depth_at(const struct layer *p, int x, int y) { return p->texel[4 * ((size_t)y * p->width + x) + 3]; }

/* Narrow the range of inverse depth in which a line can meet a layer, by the bounds of the cells that it crosses. */
ALWAYS void narrow(const struct layer *p, struct line r, float *low, float *high)
{
    for (int turn = 0; turn < 6; turn++) {
        const float xa = r.ax + r.bx * *low, xb = r.ax + r.bx * *high, ya = r.ay + r.by * *low, yb = r.ay + r.by * *high;
        const int x0 = clamped(lesser(xa, xb), p->width), x1 = clamped(larger(xa, xb), p->width);
        const int y0 = clamped(lesser(ya, yb), p->height), y1 = clamped(larger(ya, yb), p->height);
        const int span = x1 - x0 > y1 - y0 ? x1 - x0 : y1 - y0;
        int level = 0;
        while (1 << (FINEST + level) < span && level < p->levels - 1) level++;
        const int shift = FINEST + level, wide = (p->width + (1 << shift) - 1) >> shift;
        /* The line crosses four of these cells at most. Where it crosses fewer, some count twice, which is faster than
           to ask how many there are. */
        const float *const cells = p->bounds + 2 * p->start[level];
        const float *const top = cells + 2 * (size_t)(y0 >> shift) * wide;
        const float *const end = cells + 2 * (size_t)(y1 >> shift) * wide;
        const int a = 2 * (x0 >> shift), b = 2 * (x1 >> shift);
        const float least = lesser(lesser(top[a], top[b]), lesser(end[a], end[b]));
        const float most = larger(larger(top[a + 1], top[b + 1]), larger(end[a + 1], end[b + 1]));
        const float before = *high - *low;
        *low = larger(*low, least);
        *high = lesser(*high, most);
        if (*high <= *low) *high = *low;
        if (span <= 1 || *high - *low > 0.8f * before) return;
    }
}

/* Whether two neighbours are parts of one surface. */
ALWAYS int joined(const struct layer *p, int x, int y, int u, int v)
{
    const float a = p->jump[(size_t)y * p->width + x], b = p->jump[(size_t)v * p->width + u];
    return fabsf(depth_at(p, x, y) - depth_at(p, u, v)) <= larger(a, b);
}

/* Follow a line from near to far, down to the inverse depth `low`. MET: `w` is the inverse depth of what it meets and `x`, `y` the pixel there. HIDDEN: it
   passes behind the edge of a thing and stays there; `x`, `y` is the last pixel that was seen, `w` its inverse depth. */
ALWAYS int follow(const struct layer *p, struct line r, float low, float *w, int *x, int *y)
{
    float high = p->nearest;
    narrow(p, r, &low, &high);
    const float length = (high - low) * larger(fabsf(r.bx), fabsf(r.by));
    const int steps = 1 + (int)lesser(length, 1e6f);
    int hidden = 0, u = clamped(r.ax + r.bx * high, p->width), v = clamped(r.ay + r.by * high, p->height);
    float before = high;
    *w = -1.0f;
    for (int k = 0; k <= steps; k++) {
        const float here = k < steps ? high - (high - low) * k / steps : low;
        const int i = clamped(r.ax + r.bx * here, p->width), j = clamped(r.ay + r.by * here, p->height);
        const float there = depth_at(p, i, j);
        if (there < here) {
            if (there >= 0.0f) {
                *w = there;
                *x = i;
                *y = j;
            }
            hidden = 0;
        } else if (!hidden) {
            /* Met from the front, on this pixel; or on the slope between it and the last one. */
            const int front_face = there <= before && i == clamped(r.ax + r.bx * there, p->width)
                && j == clamped(r.ay + r.by * there, p->height);
            if (k == 0 || front_face || joined(p, i, j, u, v)) {
                const float front = k ? before - depth_at(p, u, v) : 0.0f, back = there - here;
                *w = front > 0.0f && front + back > 0.0f ? before + (here - before) * front / (front + back) : here;
                if (there < *w) *w = there;
                *x = i;
                *y = j;
                return MET;
            }
            hidden = 1;
        }
        before = here;
        u = i;
        v = j;
    }
    return *w >= 0.0f ? HIDDEN : NOTHING;
}

/* What a layer shows in red, green and blue at a point of inverse depth w: for each, the pixels around the place that its
   own line, at `place` in `ray`, sees there, but those of other surfaces. `px`, `py` is the pixel that was met. There is a
   fourth value, which counts for nothing, because compilers make vectors of four. */
ALWAYS void colours(
    const struct layer *p, const float *ray, const int place[4], float w, int px, int py, float value[4])
{
    const size_t met = (size_t)py * p->width + px;
    const float reach = 1.5f * p->jump[met];
    float fx[4], fy[4], sum[4] = { 0.0f }, part[4] = { 0.0f };
    int column[2][4], row[2][4];
    for (int c = 0; c < 4; c++) {
        const float *const q = ray + place[c];
        const float s = q[0] + q[2] * w - 0.5f, t = q[1] + q[3] * w - 0.5f, left = floorf(s), top = floorf(t);
        fx[c] = s - left;
        fy[c] = t - top;
        for (int k = 0; k < 2; k++) {
            column[k][c] = clamped(left + k + 0.5f, p->width);
            row[k][c] = clamped(top + k + 0.5f, p->height);
        }
    }
    for (int k = 0; k < 4; k++)
        for (int c = 0; c < 4; c++) {
            const float *const texel = p->texel + 4 * ((size_t)row[k >> 1][c] * p->width + column[k & 1][c]);
            const float near = (k & 1 ? fx[c] : 1.0f - fx[c]) * (k >> 1 ? fy[c] : 1.0f - fy[c]);
            const float share = fabsf(texel[3] - w) <= reach ? near : 0.0f;
            sum[c] += share * texel[c];
            part[c] += share;
        }
    for (int c = 0; c < 4; c++) value[c] = part[c] > 0.05f ? sum[c] / part[c] : p->texel[4 * met + c];
}

/* The rays of a place on the film, of one point of the pupil: between those of the four nodes around it that pass. */
ALWAYS int between(const float *const corner[4], const float share[4], int stride, float *ray)
{
    float passing = 0.0f, part[4];
    for (int k = 0; k < 4; k++) passing += part[k] = corner[k][WEIGHT] > 0.0f ? share[k] : 0.0f;
    for (int first = 0; first < stride; first += 8)
        for (int n = first; n < first + 8; n++)
            ray[n] = part[0] * corner[0][n] + part[1] * corner[1][n] + part[2] * corner[2][n] + part[3] * corner[3][n];
    if (!(passing > 0.0f)) return 0;
    if (passing < 1.0f)
        for (int n = 0; n < stride; n++) ray[n] *= n % NUMBERS == WEIGHT ? 1.0f : 1.0f / passing;
    return 1;
}

/* Some rows of a film. `sizes`: binary logarithm of the number of samples of each pixel. `sums` [rows, width, 8]: light
   of red, green and blue, their weights, the weight of light that is filled in, and that from beyond the plate. */
void gather(
    const struct layer *layers, int count, struct table t, int width, int first, int rows, const uint8_t *sizes,
    float *sums)
{
    /* where red, green and blue begin in a ray */
    const int red = t.channels > 1 ? NUMBERS : 0, place[4] = { red, 0, 2 * red, 0 };
    static const uint8_t order[16] = { 0, 8, 2, 10, 12, 4, 14, 6, 3, 11, 1, 9, 15, 7, 13, 5 };
    const size_t node = (size_t)t.samples * t.stride;
    for (int y = 0; y < rows; y++)
        for (int x = 0; x < width; x++) {
            float *const sum = sums + 8 * ((size_t)y * width + x), ray[16];
            const int number = 1 << sizes[(size_t)y * width + x], blocks = t.samples / number;
            const uint32_t mixed = ((uint32_t)(x >> 2) * 0x9E3779B1u ^ (uint32_t)((first + y) >> 2) * 0x85EBCA77u) >> 7;
            const int from = (int)((order[4 * ((first + y) & 3) + (x & 3)] + mixed) % blocks) * number;
            memset(sum, 0, 8 * sizeof *sum);
            for (int s = from; s < from + number; s++) {
                const float gx = (x + t.jitter[2 * s]) / t.pitch_x, gy = (y + t.jitter[2 * s + 1] + t.above) / t.pitch_y;
                const int i = clamped(gx, t.across - 1), j = clamped(gy, t.down - 1);
                const float fx = gx - i, fy = gy - j, share[4] = {
                    (1 - fx) * (1 - fy), fx * (1 - fy), (1 - fx) * fy, fx * fy };
                const float *const here = t.rays + ((size_t)j * t.across + i) * node + (size_t)s * t.stride;
                const float *const below = here + t.across * node;
                const float *const corner[4] = { here, here + node, below, below + node };
                if (!between(corner, share, t.stride, ray)) continue;
                const struct line line = { ray[0], ray[1], ray[2], ray[3] };
                int met = NOTHING, px = 0, py = 0;
                const struct layer *p = layers;
                float w = -1.0f;
                for (int k = 0; k < count; k++) {
                    int at_x = 0, at_y = 0;
                    float found;
                    const int what = follow(layers + k, line, 0.0f, &found, &at_x, &at_y);
                    if (what == NOTHING || (what == HIDDEN && met != NOTHING) || (met == MET && found <= w)) continue;
                    met = what;
                    w = found;
                    px = at_x;
                    py = at_y;
                    p = layers + k;
                }
                float value[4] = { 0.0f };
                if (met == MET) colours(p, ray, place, w, px, py, value);
                else if (met == HIDDEN) memcpy(value, p->texel + 4 * ((size_t)py * p->width + px), sizeof value);
                for (int c = 0; c < 3; c++) {
                    sum[c] += ray[place[c] + WEIGHT] * value[c];
                    sum[3 + c] += ray[place[c] + WEIGHT];
                }
                const float sx = line.ax + line.bx * w, sy = line.ay + line.by * w;
                sum[6] += met == HIDDEN ? ray[WEIGHT] : 0.0f;
                sum[7] += sx < -0.5f || sy < -0.5f || sx > p->width + 0.5f || sy > p->height + 0.5f ? ray[WEIGHT] : 0.0f;
            }
        }
}

/* Add the light of points of a plate to a film. `points` [count, 8]: place in the plate, inverse depth, first column and
   row of the kernel in the film (not whole), and light of red, green and blue. `sweep`: see `kernels.Kernel`; columns and
   rows of it are those of the kernel. A film pixel from which something nearer hides the point takes none. The light that
   is hidden so where no layer shows what is behind, as far away as the point, is returned, the sum of all channels. */
double splat(
    const struct layer *layers, int layer_count, const float *points, int count, const float *kernel, int wide, int high,
    const float *sweep, int width, int height, float *film)
{
    double lost = 0.0;
    for (int n = 0; n < count; n++) {
        const float *const p = points + 8 * n, w = p[2], left = floorf(p[3]), top = floorf(p[4]);
        const float fx = p[3] - left, fy = p[4] - top, near = w * (1.0f + CLEAR) + 1e-6f;
        if (!(fabsf(left) < 1e8f && fabsf(top) < 1e8f)) continue;
        for (int j = 0; j <= high; j++) {
            const int y = (int)top + j;
            if (y < 0 || y >= height) continue;
            for (int i = 0; i <= wide; i++) {
                const int x = (int)left + i;
                if (x < 0 || x >= width) continue;
                float light[3] = { 0.0f };
                for (int k = 0; k < 4; k++) { /* the kernel's pixels that reach this one */
                    const int u = i - (k & 1), v = j - (k >> 1);
                    if (u < 0 || v < 0 || u >= wide || v >= high) continue;
                    const float share = (k & 1 ? fx : 1.0f - fx) * (k >> 1 ? fy : 1.0f - fy);
                    for (int c = 0; c < 3; c++) light[c] += share * kernel[3 * ((size_t)v * wide + u) + c];
                }
                if (!(light[0] + light[1] + light[2] > 0.0f)) continue;
                const float s = i + 0.5f - fx, t = j + 0.5f - fy;
                const float bx = sweep[0] + sweep[1] * s + sweep[2] * t, by = sweep[3] + sweep[4] * s + sweep[5] * t;
                const struct line line = { p[0] - bx * w, p[1] - by * w, bx, by };
                int hidden = 0, known = 0, at_x = 0, at_y = 0;
                for (int k = 0; k < layer_count && !hidden; k++) {
                    float found;
                    hidden = layers[k].nearest > near && follow(layers + k, line, near, &found, &at_x, &at_y) == MET;
                }
                for (int k = 0; k < layer_count && hidden; k++)
                    known |= depth_at(layers + k, at_x, at_y) >= 0.0f && depth_at(layers + k, at_x, at_y) <= near;
                for (int c = 0; c < 3; c++)
                    if (hidden) lost += known ? 0.0f : light[c] * p[5 + c];
                    else film[3 * ((size_t)y * width + x) + c] += light[c] * p[5 + c];
            }
        }
    }
    return lost;
}
