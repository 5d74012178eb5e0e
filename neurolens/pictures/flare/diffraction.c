/* Light that the elements of an edge diffract: see `diffraction.py`.

   `pairs` adds up the products of each start element and every element after it, under Parzen's window, whose transform
   is the fourth power of a sinc. Elements are sorted by x, in units of the largest distance. Quadratic B-splines spread
   each product over the nearest nine lags. Of two opposite pairs only one is added, since the real part has both,
   and half of the product of an element with itself.

   `squares` computes |u|^2 for the element whose n is closest to u, less the largest difference that an element between
   it and its neighbour could make. */
#include <math.h>
#include <stdint.h>
#if defined(__GNUC__)
#define ALWAYS __attribute__((always_inline))
#else
#define ALWAYS
#endif

static inline ALWAYS float window(float t)
{
    return t < 0.5f ? 1.0f - 6.0f * t * t * (1.0f - t) : 2.0f * (1.0f - t) * (1.0f - t) * (1.0f - t);
}

static inline ALWAYS int64_t laid(float at, float *share)
{
    const float middle = floorf(at + 0.5f), t = at - middle;
    share[0] = 0.5f * (0.5f - t) * (0.5f - t);
    share[1] = 0.75f - t * t;
    share[2] = 0.5f * (0.5f + t) * (0.5f + t);
    return (int64_t)middle;
}

enum { BLOCK = 256 };

void squares(
    int64_t width, int64_t height, int64_t count, const float *x, const float *y, const float *edge, float *found)
{
    float q[BLOCK], r[BLOCK], least[BLOCK], of[BLOCK]; /* the smallest ratio is least / of */
    for (int64_t first = 0; first < width * height; first += BLOCK) {
        const int64_t some = width * height - first < BLOCK ? width * height - first : BLOCK;
        float *const result = found + first;
        for (int64_t i = 0; i < some; i++) {
            q[i] = x[(first + i) % width];
            r[i] = y[(first + i) / width];
            least[i] = of[i] = 1.0f;
            result[i] = q[i] * q[i] + r[i] * r[i];
        }
        for (const float *e = edge; e < edge + 5 * count; e += 5)
            for (int64_t i = 0; i < some; i++) {
                const float a = q[i] - e[0], b = r[i] - e[1], whole = a * a + b * b, aside = a * e[3] - b * e[2];
                const float square = aside * aside, most = 0.9f * whole, less = most < e[4] ? most : e[4];
                const int closer = square * of[i] < least[i] * whole;
                least[i] = closer ? square : least[i];
                of[i] = closer ? whole : of[i];
                result[i] = closer ? whole - (square < less ? square : less) : result[i];
            }
    }
}

void pairs(
    int64_t count, int64_t starts, int64_t side, const int64_t *start, const double *place, const float *vector,
    float *total)
{
    const double *const x = place, *const y = place + count;
    const float *const u = vector, *const v = vector + 2 * count;
    for (int64_t k = 0; k < starts; k++) {
        const int64_t i = start[k];
        const float a = u[2 * i], b = u[2 * i + 1], c = v[2 * i], d = v[2 * i + 1];
        for (int64_t j = i; j < count && x[j] - x[i] < 1.0; j++) {
            const float dx = (float)(x[j] - x[i]), dy = (float)(y[j] - y[i]);
            if (fabsf(dy) >= 1.0f || dx >= 1.0f)
                continue;
            const float weight = window(dx) * window(fabsf(dy)) * (i == j ? 0.5f : 1.0f);
            const float re = weight * (a * u[2 * j] + b * u[2 * j + 1] + c * v[2 * j] + d * v[2 * j + 1]);
            const float im = weight * (a * u[2 * j + 1] - b * u[2 * j] + c * v[2 * j + 1] - d * v[2 * j]);
            float across[3], along[3];
            const int64_t column = laid(0.5f * dx * side, across), row = laid(0.5f * dy * side, along) - 1;
            for (int q = 0; q < 3; q++) {
                const int64_t y = row + q < 0 ? row + q + side : row + q < side ? row + q : row + q - side;
                float *const at = total + 2 * (column * side + y);
                for (int p = 0; p < 3; p++) {
                    at[2 * p * side] += across[p] * along[q] * re;
                    at[2 * p * side + 1] += across[p] * along[q] * im;
                }
            }
        }
    }
}
