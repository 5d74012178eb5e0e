/* The light of one pass of a tile whose paths carry wavelengths with film points of their own.

   Python defines before this: LANES wavelengths of a path, BINS of the spectrum, SAMPLES at most of a pixel, the
   largest luminance BRIGHTEST of a sample, and the columns LUMINANCE2 and DROPPED of COLUMNS sums.

   Chance decides how many companions cross the edge of a pixel, and that is noise which a thin lens does not have. A
   control variate removes most of it: the light that the other samples of the hero's pixel predict. The prediction is
   divided among pixels in the shares that it has on average over all places in the hero's pixel; the residual goes to
   the pixel of the companion's film point. This leaves the mean as it is. Where dispersion is only lateral, all light
   is divided so, as an ST map does that is read between pixels. */

#include <math.h>
#include <stddef.h>

#define ALWAYS static inline __attribute__((always_inline))

typedef float Colour __attribute__((vector_size(16), aligned(4))); /* linear sRGB of the film, and its luminance */
typedef double Sum __attribute__((vector_size(32), aligned(8)));

typedef struct {
    Colour response[LANES], basis[LANES];
} Bin;

typedef struct {
    int width, height, lateral;
    float film_x, film_y; /* mm */
} Grid;

/* Where the light of a companion of each sample of a pixel goes. */
typedef struct {
    int target[SAMPLES], near[SAMPLES]; /* the cell of its film point; the first of four around it, -1 for none */
    float a[SAMPLES], b[SAMPLES]; /* shares of the next column and of the next row of the four */
} Arrivals;

ALWAYS int clipped(float value, int count)
{
    return value <= 0 ? 0 : value >= (float)(count - 1) ? count - 1 : (int)value;
}

ALWAYS void add(double *cell, Colour light)
{
    *(Sum *)cell += __builtin_convertvector(light, Sum);
}

/* x, y: film points of the heroes of a pixel; there_x, there_y: those of the companions. */
static void arrive(Arrivals *restrict to, const Grid *grid, int row, int column, size_t samples, int first, int cells,
    const float *restrict x, const float *restrict y, const float *restrict there_x, const float *restrict there_y)
{
    const int width = grid->width, height = grid->height;
    const float across_mm = (float)width / grid->film_x, down_mm = (float)height / grid->film_y;
    for (size_t s = 0; s < samples; s++) {
        const int to_column = clipped((0.5f - there_x[s] / grid->film_x) * (float)width, width);
        const int to_row = clipped((0.5f + there_y[s] / grid->film_y) * (float)height, height);
        const float right = (x[s] - there_x[s]) * across_mm, down = (there_y[s] - y[s]) * down_mm;
        const float whole_x = floorf(right), whole_y = floorf(down);
        const int near_column = column + (int)whole_x, near_row = row + (int)whole_y;
        const int target = to_row * width + to_column - first, near = near_row * width + near_column - first;
        const int inside = (near_column >= 0) & (near_row >= 0) & (near_column <= width - 2) & (near_row <= height - 2)
            & (near >= 0) & (near + width + 1 < cells);
        to->target[s] = (target >= 0) & (target < cells) ? target : row * width + column - first;
        to->near[s] = inside ? near : -1;
        to->a[s] = right - whole_x;
        to->b[s] = down - whole_y;
    }
}

/* pixels, samples: those of the tile, one after the other from `start` on in the picture; sums: [pixels, COLUMNS].
   value: [paths, LANES]; weight: [LANES, paths]; places: [LANES, 2, paths].
   spill: [cells, 4], of the picture's pixels from `first` on; all samples' companions are in it. */
void light_of_tile(
    size_t pixels, size_t samples, size_t start, size_t first, size_t cells, const Grid *grid, const Bin *table,
    const size_t *bins, const float *value, const float *weight, const float *places, double *sums, double *spill)
{
    const size_t count = pixels * samples;
    const int width = grid->width;
    for (size_t p = 0; p < pixels; p++) {
        const size_t begin = p * samples;
        const int row = (int)((start + p) / width), column = (int)((start + p) % width);
        Colour colour[SAMPLES], total = {0, 0, 0, 0};
        float radiance[LANES][SAMPLES], open = 0;
        Arrivals to;
        double *sum = sums + p * COLUMNS;
        Sum own = {0, 0, 0, 0};
        sum[LUMINANCE2] = sum[DROPPED] = 0;
        for (int lane = 0; lane < LANES; lane++)
            for (size_t s = 0; s < samples; s++) {
                radiance[lane][s] = value[(begin + s) * LANES + lane];
                open += weight[lane * count + begin + s];
            }
        for (size_t s = 0; s < samples; s++) {
            const Bin *bin = table + bins[begin + s];
            const Colour hero = bin->response[0] * radiance[0][s];
            Colour all = hero;
            for (int lane = 1; lane < LANES; lane++)
                all += bin->response[lane] * radiance[lane][s];
            if (fabsf(all[3]) <= BRIGHTEST) {
                colour[s] = all;
                total += all;
                own += __builtin_convertvector(hero, Sum);
                sum[LUMINANCE2] += (double)all[3] * all[3];
            } else {
                colour[s] = (Colour){0, 0, 0, 0};
                for (int lane = 0; lane < LANES; lane++)
                    radiance[lane][s] = 0;
                sum[DROPPED]++;
            }
        }
        for (int c = 0; c < 3; c++)
            sum[c] = own[c];
        const float scale = open > 0 && samples > 1 ? (float)samples / open / (float)(samples - 1) : 0;
        for (int lane = 1; lane < LANES; lane++) {
            const float *xy = places + begin, *there = xy + 2 * lane * count, *through = weight + lane * count + begin;
            arrive(&to, grid, row, column, samples, (int)first, (int)cells, xy, xy + count, there, there + count);
            for (size_t s = 0; s < samples; s++) {
                if (!(through[s] > 0))
                    continue;
                const Bin *bin = table + bins[begin + s];
                const Colour response = bin->response[lane];
                const float light = radiance[lane][s];
                float predicted = 0;
                if (to.near[s] >= 0) {
                    const Colour like = bin->basis[lane] * (total - colour[s]);
                    predicted = grid->lateral ? light : (like[0] + like[1] + like[2]) * (scale * through[s]);
                    double *cell = spill + 4 * (size_t)to.near[s];
                    const Colour right = response * (predicted * to.a[s]), left = response * predicted - right;
                    add(cell, left - left * to.b[s]);
                    add(cell + 4, right - right * to.b[s]);
                    add(cell + 4 * width, left * to.b[s]);
                    add(cell + 4 * (width + 1), right * to.b[s]);
                }
                add(spill + 4 * (size_t)to.target[s], response * (light - predicted));
            }
        }
    }
}
