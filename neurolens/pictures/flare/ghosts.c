/* Follows rays along all ghosts of two reflections, a block of rays at a time. `stack.c` stands before this text.
   Python defines BLOCK and LOST. */
enum { ROOM = BLOCK * STATE };

struct ghost {
    int second, first, index; /* surfaces that reflect, in the order of light; number in the output */
};

struct job {
    struct lens lens;
    size_t n, at, count; /* rays of this block, number of its first ray, all rays */
    const float *film;
    float reach, *out;
};

/* Whether any ray is still within reach of all rims after a step at surface k. */
static int go_on(const struct job *job, int k, int action, const float *from, float *to)
{
    const float *const worst = to + (STATE - 1) * BLOCK;
    int left = 0;
    go(job->lens, k, action, job->n, from, to, BLOCK);
    for (size_t i = 0; i < job->n; i++)
        left |= worst[i] <= job->reach;
    return left;
}

static void arrive(const struct job *job, const float *from, int index)
{
    meet_film(job->n, from, BLOCK, job->film, job->out + 4 * index * job->count + job->at, job->count);
}

/* Follow rays from before surface k to the film; `here` and `next` are overwritten. */
static void to_film(const struct job *job, int k, float *here, float *next, int index)
{
    for (; k < job->lens.surfaces; k++) {
        if (!go_on(job, k, 0, here, next)) return;
        float *const other = here;
        here = next;
        next = other;
    }
    arrive(job, here, index);
}

/* Follow a block, whose rays are at the start of `room`, along all ghosts. These are sorted by rising `second`, then by
   falling `first`. A `second` behind the last surface stands for the light that is not reflected. */
static void sweep(const struct job *job, const struct ghost *ghost, int count, float *room)
{
    const int surfaces = job->lens.surfaces;
    const struct ghost *const end = ghost + count;
    float *const ahead = room, *back = ahead + (surfaces + 1) * ROOM, *spare = back + ROOM;
    float *const here = spare + ROOM, *const next = here + ROOM;
    int reached = 0; /* `ahead` has the rays before each surface up to this one */
    while (reached < end[-1].second && go_on(job, reached, 0, ahead + reached * ROOM, ahead + (reached + 1) * ROOM))
        reached++;
    while (ghost < end && ghost->second <= reached) {
        const int j = ghost->second;
        if (j == surfaces) {
            arrive(job, ahead + j * ROOM, ghost++->index);
            continue;
        }
        const struct ghost *of_j = ghost;
        while (ghost < end && ghost->second == j)
            ghost++;
        int left = go_on(job, j, 2, ahead + j * ROOM, back);
        for (int i = j - 1; left && of_j < ghost; i--) {
            for (; of_j < ghost && of_j->first == i; of_j++)
                if (go_on(job, i, 3, back, here)) to_film(job, i + 1, here, next, of_j->index);
            left = of_j < ghost && go_on(job, i, 1, back, spare);
            float *const other = back;
            back = spare;
            spare = other;
        }
    }
}

/* `start` has STATE rows of `count` rays, `room` is for (surfaces + 5) blocks, and `out` has four rows a ghost: x, y,
   power and worst. */
void ghosts(
    size_t count, int surfaces, int ghosts, float reach, const float *start, const int *functions, const float *numbers,
    const float *film, const struct ghost *ghost, float *room, float *out)
{
    struct job job = { { surfaces, functions, numbers }, 0, 0, count, film, reach, out };
    for (; ghosts && job.at < count; job.at += BLOCK) {
        job.n = count - job.at < BLOCK ? count - job.at : BLOCK;
        for (int r = 0; r < STATE; r++)
            for (size_t i = 0; i < job.n; i++)
                room[r * BLOCK + i] = start[r * count + job.at + i];
        for (int p = 0; p < ghosts; p++)
            for (size_t i = 0; i < job.n; i++) {
                out[(4 * p + 2) * count + job.at + i] = 0.0f;
                out[(4 * p + 3) * count + job.at + i] = (float)LOST;
            }
        sweep(&job, ghost, ghosts, room);
    }
}
