//// head
/*
${comment}
 *
 * ${name}(...) takes one ray; ${name}_rays(...) takes arrays, one value a ray, that must not overlap. It has no
 * branches: gcc -O3 -march=native (clang alike) makes vectors of it. Where a ray's operations wait for each other,
 * arrays go in blocks through several loops, whose numbers take some kilobytes of stack. Results mean something where status is 0. The
 * guard of the domain needs NaN: never compile this with -ffast-math or -ffinite-math-only.
 */
#ifndef ${guard}
#define ${guard}

#include <stddef.h>

#if defined(__FAST_MATH__) || (defined(__FINITE_MATH_ONLY__) && __FINITE_MATH_ONLY__)
#error "${name}: rays outside the domain are told by NaN; compile without -ffast-math and -ffinite-math-only"
#endif
#ifdef __cplusplus
#define ${macro}_RESTRICT __restrict
#else
#define ${macro}_RESTRICT restrict
#endif
#if defined(__GNUC__)
#define ${macro}_INLINE static inline __attribute__((always_inline, unused))
#define ${macro}_UNUSED __attribute__((unused))
#define ${macro}_PART static __attribute__((noinline, unused))
#define ${macro}_ALIGNED __attribute__((aligned(64)))
#else
#define ${macro}_PART static
#define ${macro}_ALIGNED
#define ${macro}_INLINE static inline
#define ${macro}_UNUSED
#endif
/* a b + c, rounded once where the machine can. */
#if defined(__GNUC__) && (defined(__FMA__) || defined(__FP_FAST_FMAF) || defined(__ARM_FEATURE_FMA))
#define ${macro}_FMA(a, b, c) __builtin_fmaf((a), (b), (c))
#else
#define ${macro}_FMA(a, b, c) ((a) * (b) + (c))
#endif
//// sqrt: sqrtf of the library sets errno, which keeps compilers from making vectors of it unless they are told not to care.

/* Square root: the machine's with -fno-math-errno, else by Newton's steps from the halved exponent, within an ulp. */
${macro}_INLINE float ${name}_sqrt(float x)
{
#ifdef __NO_MATH_ERRNO__
    return __builtin_sqrtf(x);
#else
    union { float f; unsigned u; } y;
    y.f = x;
    y.u = 0x5f375a86u - (y.u >> 1);
    float r = y.f;
    r = r * (1.5f - 0.5f * x * r * r);
    r = r * (1.5f - 0.5f * x * r * r);
    r = r * (1.5f - 0.5f * x * r * r);
    const float s = x * r;
    return s + 0.5f * r * (x - s * s);
#endif
}
//// clamp: as whole numbers, which order as the sizes of floats do: compilers make branches of two comparisons of floats.

${macro}_INLINE float ${name}_clamp(float x, float limit)
{
    union { float f; unsigned u; } a, b;
    a.f = x;
    b.f = limit;
    const unsigned sign = a.u & 0x80000000u, size = a.u & 0x7fffffffu;
    a.u = (size < b.u ? size : b.u) | sign;
    return a.f;
}
//// pick: by masks, of which compilers make vectors where the choice is the same for all rays.

${macro}_INLINE float ${name}_pick(float truth, float x, float y)
{
    union { float f; unsigned u; } a, b;
    const unsigned mask = 0u - (unsigned)(int)truth;
    a.f = x;
    b.f = y;
    a.u = (a.u & mask) | (b.u & ~mask);
    return a.f;
}
//// floor
#include <math.h>
//// lookup: a cell of a table, whatever the index is: NaN is above nothing.

${macro}_INLINE int ${name}_cell(float index, int cells)
{
    const float last = (float)(cells - 1);
    const float inside = index < last ? index : last;
    return (int)(inside > 0.0f ? inside : 0.0f);
}
//// state

/* One state: made once by ${name}_at, handed to every call. Out of its range every ray is outside the domain. */
typedef struct {
    int inside;
    float c[${count}];
} ${name}_state;

static const float ${name}_nodes[${size}] = {
    ${rows}};

${header}
{
${steps}
    const float feature[${features}] = {${made}};
    ${name}_state state;
    state.inside = ${inside} > 0.5f;
    for (int i = 0; i < ${count}; i++) {
        float sum = 0.0f;
        for (int k = 0; k < ${features}; k++) sum += ${name}_nodes[${features} * i + k] * feature[k];
        state.c[i] = sum;
    }
    return state;
}
//// blocks

void ${name}(
    size_t count, const float *const *in, const float *call, const float *table, int cells, float *const *out,
    int *status)
{
    float made[${made}][${block}], sums[${block}][${width}];
    ${known}
    for (size_t at = 0; at < count; at += ${block}) {
        const size_t n = count - at < ${block} ? count - at : ${block};
        ${name}_before_rays(n, ${first});
        for (size_t i = 0; i < n; i++) {
            ${cells}
            for (int c = 0; c < ${width}; c++)
                sums[i][c] = ${total};
        }
        for (int c = 0; c < ${columns}; c++)
            for (size_t i = 0; i < n; i++)
                made[${looked} + c][i] = sums[i][c];
        ${name}_after_rays(n, ${last}${out}, status + at);
    }
}
//// one_block

void ${name}(
    size_t count, const float *const *in, const float *call, const float *table, int cells, float *const *out,
    int *status)
{
    ${known}
    (void)call, (void)table, (void)cells;
    ${name}_each_rays(count, ${given});
}
//// functions

typedef struct {
${fields}
} ${name}_ray;

${macro}_INLINE ${name}_ray ${name}(
    ${one})
{
${unused}    ${name}_ray ray;
${body}
    return ray;
}
${parts}
${macro}_UNUSED static inline void ${name}_rays(
    ${many})
{
${loop}}

#endif
//// each_ray: the loop of whole rays.
    for (size_t i = 0; i < count; i++) {
        const ${name}_ray ray = ${name}(${values});
${stores}
    }
//// part: some steps of a block of rays; `waiting` has the numbers that wait between parts.

${macro}_PART void ${name}_part_${part}(
    ${arguments})
{
    (void)waiting;
${before}    for (size_t i = 0; i < number; i++) {
${lines}
    }
}
//// in_parts
    ${macro}_ALIGNED float waiting[${rows}][${macro}_ROWS];
    for (size_t at = 0; at < count; at += ${macro}_ROWS) {
        const size_t number = count - at < ${macro}_ROWS ? count - at : ${macro}_ROWS;
${calls}
    }
