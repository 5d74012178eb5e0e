/* Evaluates fitted ghosts for rays of one direction. The monomials of a ray serve all wavelengths; the products of the
   coefficients of a wavelength with them are the inputs of the graphs of light. The graphs stand before this text;
   Python defines MOST, ROWS, TERMS and LIGHTS. */
enum { BLOCK = 256 };
typedef void step(size_t, const float *const *, const float *, float *const *);
static step *const terms_of[] = { TERMS }, *const light_of[] = { LIGHTS };

/* Multiply coefficients by monomials. */
static void product(int rows, int terms, const float *table, float term[][BLOCK], float row[][BLOCK])
{
    for (int r = 0; r < rows; r++) {
        float *const restrict sum = row[r];
        for (int i = 0; i < BLOCK; i++)
            sum[i] = 0.0f;
        for (int k = 0; k < terms; k++) {
            const float c = table[r * terms + k], *const restrict x = term[k];
            for (int i = 0; i < BLOCK; i++)
                sum[i] += c * x[i];
        }
    }
}

void ghosts(
    size_t count, int wavelengths, int rows, int terms, int monomials, int lights, const float *places,
    const float *call, const float *tables, float *out)
{
    static __thread float term[MOST][BLOCK], row[ROWS][BLOCK];
    for (size_t at = 0; at < count; at += BLOCK) {
        const size_t n = count - at < BLOCK ? count - at : BLOCK;
        const float *in[ROWS] = { places + at, places + count + at };
        float *to[MOST];
        for (int k = 0; k < terms; k++)
            to[k] = term[k];
        terms_of[monomials](n, in, call, to);
        for (int r = 0; r < rows; r++)
            in[2 + r] = row[r];
        for (int w = 0; w < wavelengths; w++) {
            product(rows, terms, tables + (size_t)w * rows * terms, term, row);
            for (int k = 0; k < 4; k++)
                to[k] = out + (4 * (size_t)w + k) * count + at;
            light_of[lights](n, in, call, to);
        }
    }
}
