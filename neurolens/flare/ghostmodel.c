/* Evaluates fitted ghosts for rays of one direction. The monomials of a ray serve all wavelengths; the products of the
   coefficients of a wavelength with them are the inputs of the graphs of light. The graphs stand before this text;
   Python defines MOST, ROWS, TERMS and LIGHTS. */
enum { BLOCK = 256, LANES = 16 };
typedef float lanes __attribute__((vector_size(4 * LANES), aligned(4), may_alias));
typedef void step(size_t, const float *const *, const float *, float *const *);
static step *const terms_of[] = { TERMS }, *const light_of[] = { LIGHTS };

/* Multiply coefficients by monomials, four rows of so few rays at a time that their sums stay in registers. */
static void product(int rows, int terms, const float *table, float term[][BLOCK], float row[][BLOCK])
{
    for (int i = 0; i < BLOCK; i += LANES)
        for (int r = 0; r < rows; r += 4) {
            const float *const a = table + r * terms, *const b = a + (r + 1 < rows) * terms;
            const float *const c = b + (r + 2 < rows) * terms, *const d = c + (r + 3 < rows) * terms;
            lanes s = { 0.0f }, t = s, u = s, v = s;
            for (int k = 0; k < terms; k++) {
                const lanes x = *(const lanes *)&term[k][i];
                s += a[k] * x;
                t += b[k] * x;
                u += c[k] * x;
                v += d[k] * x;
            }
            *(lanes *)&row[r][i] = s;
            *(lanes *)&row[r + 1][i] = t;
            *(lanes *)&row[r + 2][i] = u;
            *(lanes *)&row[r + 3][i] = v;
        }
}

void ghosts(
    size_t count, int wavelengths, int rows, int terms, int monomials, int lights, const float *places,
    const float *call, const float *tables, float *out)
{
    static __thread float term[MOST][BLOCK], row[ROWS + 3][BLOCK];
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
