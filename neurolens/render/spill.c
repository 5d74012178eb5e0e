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
#include <string.h>

typedef struct {
    float response[LANES][4]; /* of the film in linear sRGB, and of its luminance */
    float basis[LANES][4];
} Bin;

typedef struct {
    int width, height, lateral;
    float film_x, film_y; /* mm */
} Grid;

static int clipped(float value, int count)
{
    return value <= 0 ? 0 : value >= (float)(count - 1) ? count - 1 : (int)value;
}

static void add(double *cell, const float *light, float share)
{
    for (int c = 0; c < 4; c++)
        cell[c] += (double)(light[c] * share);
}

/* pixel, samples: those of the tile, one after the other from `start` on in the picture; sums: [pixels, COLUMNS].
   spill: [cells, 4], of the picture's pixels from `first` on; all samples' companions are in it. */
void light_of_tile(
    size_t pixels, size_t samples, size_t start, size_t first, size_t cells, const Grid *grid, const Bin *table,
    const size_t *bins, const float *value, const float *weight, const float *places, double *sums, double *spill)
{
    const size_t count = pixels * samples;
    const int width = grid->width, height = grid->height;
    const float across_mm = (float)width / grid->film_x, down_mm = (float)height / grid->film_y;
    for (size_t p = 0; p < pixels; p++) {
        float colour[SAMPLES][4], total[4] = {0, 0, 0, 0}, open = 0;
        double *sum = sums + p * COLUMNS;
        double own[4] = {0, 0, 0, 0};
        int kept[SAMPLES];
        sum[LUMINANCE2] = sum[DROPPED] = 0;
        for (size_t s = 0; s < samples; s++) {
            const size_t n = p * samples + s;
            const Bin *bin = table + bins[n];
            float hero[4];
            for (int c = 0; c < 4; c++)
                colour[s][c] = hero[c] = bin->response[0][c] * value[n];
            for (int lane = 1; lane < LANES; lane++)
                for (int c = 0; c < 4; c++)
                    colour[s][c] += bin->response[lane][c] * value[lane * count + n];
            for (int lane = 0; lane < LANES; lane++)
                open += weight[lane * count + n];
            kept[s] = fabsf(colour[s][3]) <= BRIGHTEST;
            if (!kept[s]) {
                sum[DROPPED]++;
                memset(colour[s], 0, sizeof colour[s]);
                continue;
            }
            for (int c = 0; c < 4; c++) {
                total[c] += colour[s][c];
                own[c] += hero[c];
            }
            sum[LUMINANCE2] += (double)colour[s][3] * colour[s][3];
        }
        memcpy(sum, own, 3 * sizeof(double));
        const float scale = open > 0 && samples > 1 ? (float)samples / open / (float)(samples - 1) : 0;
        const int row = (int)((start + p) / width), column = (int)((start + p) % width);
        for (size_t s = 0; s < samples; s++) {
            const size_t n = p * samples + s;
            const Bin *bin = table + bins[n];
            const float x = places[n], y = places[count + n];
            float others[3];
            for (int c = 0; c < 3; c++)
                others[c] = (total[c] - colour[s][c]) * scale;
            for (int lane = 1; lane < LANES; lane++) {
                const float through = weight[lane * count + n];
                if (!(through > 0))
                    continue;
                const float there_x = places[2 * lane * count + n], there_y = places[(2 * lane + 1) * count + n];
                const int to_column = clipped((0.5f - there_x / grid->film_x) * (float)width, width);
                const int to_row = clipped((0.5f + there_y / grid->film_y) * (float)height, height);
                const float right = (x - there_x) * across_mm, down = (there_y - y) * down_mm;
                const float whole_x = floorf(right), whole_y = floorf(down), a = right - whole_x, b = down - whole_y;
                const int near_column = column + (int)whole_x, near_row = row + (int)whole_y;
                const size_t target = (size_t)to_row * width + to_column - first;
                const size_t near = (size_t)near_row * width + near_column - first;
                const float radiance = kept[s] ? value[lane * count + n] : 0;
                const float *basis = bin->basis[lane];
                const int inside = near_column >= 0 && near_row >= 0 && near_column <= width - 2
                    && near_row <= height - 2 && near + width + 1 < cells;
                float predicted = 0, light[4];
                if (inside)
                    predicted = grid->lateral ? radiance
                        : (basis[0] * others[0] + basis[1] * others[1] + basis[2] * others[2]) * through;
                for (int c = 0; c < 4; c++)
                    light[c] = bin->response[lane][c] * (radiance - predicted);
                add(spill + 4 * (target < cells ? target : start + p - first), light, 1);
                if (!inside)
                    continue;
                for (int c = 0; c < 4; c++)
                    light[c] = bin->response[lane][c] * predicted;
                double *cell = spill + 4 * near;
                add(cell, light, (1 - a) * (1 - b));
                add(cell + 4, light, a * (1 - b));
                add(cell + 4 * width, light, (1 - a) * b);
                add(cell + 4 * (width + 1), light, a * b);
            }
        }
    }
}
