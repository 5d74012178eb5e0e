/* Calls the compiled steps of a lens, which stand before this text. Python defines STATE, WIDTH, ACTIONS and STEPS. */
typedef void step(size_t, const float *const *, const float *, float *const *);
static step *const steps[] = { STEPS };

struct lens {
    int surfaces;
    const int *functions;
    const float *numbers;
};

/* Take n rays through an action of surface k, from one list of rows to another; rows are `stride` numbers apart. */
static void go(struct lens lens, int k, int action, size_t n, const float *from, float *to, size_t stride)
{
    const float *in[STATE];
    float *out[STATE];
    for (int r = 0; r < STATE; r++) {
        in[r] = from + r * stride;
        out[r] = to + r * stride;
    }
    const int at = ACTIONS * k + action;
    steps[lens.functions[at]](n, in, lens.numbers + at * WIDTH, out);
}

/* Write x, y, power and worst of n rays where they meet the film; x and y are along the film. */
static void meet_film(size_t n, const float *from, size_t stride, const float *film, float *to, size_t apart)
{
    const float *in[STATE];
    float *out[4];
    for (int r = 0; r < STATE; r++)
        in[r] = from + r * stride;
    for (int r = 0; r < 4; r++)
        out[r] = to + r * apart;
    run_film(n, in, film, out);
}
