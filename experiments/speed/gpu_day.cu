// What `experiments gpu-day` puts behind a written program (a function `lens`, its kernel `lens_rays`): the same rays made
// by their number, used in place or stored, and the clock. nvcc compiles it for a GPU, a C++ compiler for the host, where
// kernels are loops. $words are filled in.
#include <chrono>

struct Place { float low[5], span[5]; int width, height, each; };  // of film, pupil and light; pixels of a frame

#if defined(__CUDACC__)
#define HERE static __device__
#else
#define HERE static inline
#endif

// Terms of a Kronecker sequence.
HERE float share(unsigned i, unsigned step) { return float((i * step) >> 8) * 5.9604645e-8f; }

// Ray k of a thread. In a frame a thread has a pixel; elsewhere rays are spread over the whole film.
HERE lens_ray made(const Place &p, $arguments unsigned thread, unsigned k)
{
    unsigned i = thread * unsigned(p.each) + k;
    float x = share(i, 2654435769u), y = share(i, 1640531527u);
    if (p.width > 0) {
        x = (float(thread % unsigned(p.width)) + x) / float(p.width);
        y = (float(thread / unsigned(p.width)) + y) / float(p.height);
    }
    float fx = p.low[0] + p.span[0] * x, fy = p.low[1] + p.span[1] * y;
    float a = p.low[2] + p.span[2] * share(i, 3430093283u), b = p.low[3] + p.span[3] * share(i, 2246822519u);
    float nm = p.low[4] + p.span[4] * share(i, 3266489917u);
    return lens($given);
}

HERE void in_place(const Place &p, $arguments float *out, unsigned thread)
{
    float sum = 0.0f;
    for (int k = 0; k < p.each; k++) {
        lens_ray ray = made(p, $passed thread, unsigned(k));
        sum += $sum + float(ray.status);
    }
    out[thread] = sum;
}

HERE void kept(const Place &p, $arguments float *out, unsigned long long rows, unsigned i)
{
    lens_ray ray = made(p, $passed i / unsigned(p.each), i % unsigned(p.each));
$stores
}

// Kinds of work: 0 rays read and stored, 1 made and used in place, 2 made and stored.
#if defined(__CUDACC__)
__global__ void in_place_kernel(Place p, $arguments float *out, int n)
{
    unsigned i = blockIdx.x * blockDim.x + threadIdx.x;
    if (i < unsigned(n)) in_place(p, $passed out, i);
}

__global__ void kept_kernel(Place p, $arguments float *out, int n)
{
    unsigned i = blockIdx.x * blockDim.x + threadIdx.x;
    if (i < unsigned(n)) kept(p, $passed out, n, i);
}

static void launch(int kind, const Place &p, const float *in, $arguments float *out, int n, int threads)
{
    int blocks = (n + threads - 1) / threads;
    if (kind == 0) lens_rays<<<blocks, threads>>>(in, call, $tables out, n);
    if (kind == 1) in_place_kernel<<<blocks, threads>>>(p, $passed out, n);
    if (kind == 2) kept_kernel<<<blocks, threads>>>(p, $passed out, n);
}

// Milliseconds of each repetition, by events of the device. Returns an error of CUDA, 0 for none.
extern "C" int timed(
    int kind, const Place *p, const float *in, $arguments float *out, int n, int threads, int repeats, float *ms)
{
    cudaEvent_t before, after;
    cudaEventCreate(&before);
    cudaEventCreate(&after);
    for (int r = -1; r < repeats; r++) {  // the first is not counted
        cudaEventRecord(before);
        launch(kind, *p, in, $passed out, n, threads);
        cudaEventRecord(after);
        int failed = cudaEventSynchronize(after);
        if (!failed) failed = cudaGetLastError();
        if (failed) return failed;
        if (r >= 0) cudaEventElapsedTime(ms + r, before, after);
    }
    cudaEventDestroy(before);
    cudaEventDestroy(after);
    return 0;
}

// Registers of a thread, bytes that they spill, and the threads that a multiprocessor holds, in parts of all it can.
extern "C" int facts(int kind, int threads, int *registers, int *spilled, float *occupancy)
{
    const void *kernel = kind == 0 ? (const void *)lens_rays : kind == 1 ? (const void *)in_place_kernel
                                                                         : (const void *)kept_kernel;
    cudaFuncAttributes about;
    int failed = cudaFuncGetAttributes(&about, kernel), blocks = 0, most = 1;
    if (!failed) failed = cudaOccupancyMaxActiveBlocksPerMultiprocessor(&blocks, kernel, threads, 0);
    if (!failed) failed = cudaDeviceGetAttribute(&most, cudaDevAttrMaxThreadsPerMultiProcessor, 0);
    *registers = about.numRegs;
    *spilled = int(about.localSizeBytes);
    *occupancy = float(blocks * threads) / float(most);
    return failed;
}
#else
extern "C" int timed(
    int kind, const Place *p, const float *in, $arguments float *out, int n, int threads, int repeats, float *ms)
{
    (void)threads;
    for (int r = 0; r < repeats; r++) {
        auto before = std::chrono::steady_clock::now();
        if (kind == 0) lens_rays(in, call, $tables out, n);
        for (int i = 0; kind == 1 && i < n; i++) in_place(*p, $passed out, unsigned(i));
        for (int i = 0; kind == 2 && i < n; i++) kept(*p, $passed out, n, unsigned(i));
        ms[r] = std::chrono::duration<float, std::milli>(std::chrono::steady_clock::now() - before).count();
    }
    return 0;
}

extern "C" int facts(int, int, int *, int *, float *) { return -1; }
#endif
