/*
 * Double Gauss 50 mm f/1.8: dense-d4, written by neurolens 0.1.0.
 * Lens data: figures published in Laikin, Lens Design, 2nd ed. (1995), p. 77 (sha256 1739838b3cc1bc32).
 * Focal length 49.6367 mm, f/1.81, 12 refractions.
 * Lens frame: z along the optical axis, front vertex at z = 0, film at z > 0, x right and y up seen from behind
 * the camera; rays leave the film point towards the pupil point on the plane domain.pupil_z_mm; scene_ray is a
 * point on the front surface and a unit direction towards -z.
 * Domain: film radius 21.6 mm; film plane z 91.2918 to 95.9983 mm; pupil radius 34.417 mm on the plane z =
 * -17.2754 mm; stop radius up to 9.525 mm; wavelength 400 to 700 nm.
 * Errors on held-out rays, whole domain of the exported model: rms_um 1.
 * Units: mm, nm; directions are unit vectors, transmittance a share of the power of unpolarised light.
 * Transmittance: the polarisation that surfaces give to the light is followed.
 * Status: 0 passed; 1 outside the domain of the model or lens; 10 blocked by the rim of surface 1; 22 blocked by
 * the rim of surface 4; 26 blocked by the stop, surface 5; 30 blocked by the rim of surface 6; 46 blocked by the
 * rim of surface 10; 50 blocked by the rim of surface 11.
 * film_z_mm(focus_m, stop_radius_mm): film plane of the least RMS spot on the axis, stop radius 0.0625 to 1
 * times the widest, object to film from 0.7 m to infinity, beyond as at the end; within 0.54 um (measured).
 * film_z_paraxial_mm(focus_m): film plane of the paraxial image, object to film from 0.7 m to infinity, beyond
 * as at the end; within 0.0031 um (measured).
 *
 * laikin_double_gauss_50(...) takes one ray; laikin_double_gauss_50_rays(...) takes arrays, one value a ray, that must not overlap. It has no
 * branches: gcc -O3 -march=native (clang alike) makes vectors of it. Where a ray's operations wait for each other,
 * arrays go in blocks through several loops, whose numbers take some kilobytes of stack. Results mean something where status is 0. The
 * guard of the domain needs NaN: never compile this with -ffast-math or -ffinite-math-only.
 */
#ifndef LAIKIN_DOUBLE_GAUSS_50_H
#define LAIKIN_DOUBLE_GAUSS_50_H

#include <stddef.h>

#if defined(__FAST_MATH__) || (defined(__FINITE_MATH_ONLY__) && __FINITE_MATH_ONLY__)
#error "laikin_double_gauss_50: rays outside the domain are told by NaN; compile without -ffast-math and -ffinite-math-only"
#endif
#ifdef __cplusplus
#define LAIKIN_DOUBLE_GAUSS_50_RESTRICT __restrict
#else
#define LAIKIN_DOUBLE_GAUSS_50_RESTRICT restrict
#endif
#if defined(__GNUC__)
#define LAIKIN_DOUBLE_GAUSS_50_INLINE static inline __attribute__((always_inline, unused))
#define LAIKIN_DOUBLE_GAUSS_50_UNUSED __attribute__((unused))
#define LAIKIN_DOUBLE_GAUSS_50_PART static __attribute__((noinline, unused))
#define LAIKIN_DOUBLE_GAUSS_50_ALIGNED __attribute__((aligned(64)))
#else
#define LAIKIN_DOUBLE_GAUSS_50_PART static
#define LAIKIN_DOUBLE_GAUSS_50_ALIGNED
#define LAIKIN_DOUBLE_GAUSS_50_INLINE static inline
#define LAIKIN_DOUBLE_GAUSS_50_UNUSED
#endif
/* a b + c, rounded once where the machine can. */
#if defined(__GNUC__) && (defined(__FMA__) || defined(__FP_FAST_FMAF) || defined(__ARM_FEATURE_FMA))
#define LAIKIN_DOUBLE_GAUSS_50_FMA(a, b, c) __builtin_fmaf((a), (b), (c))
#else
#define LAIKIN_DOUBLE_GAUSS_50_FMA(a, b, c) ((a) * (b) + (c))
#endif

#define LAIKIN_DOUBLE_GAUSS_50_EFL_MM 49.6367188f
#define LAIKIN_DOUBLE_GAUSS_50_FILM_RADIUS_MM 21.6000004f
#define LAIKIN_DOUBLE_GAUSS_50_FILM_Z_MIN_MM 91.2917709f
#define LAIKIN_DOUBLE_GAUSS_50_FILM_Z_MAX_MM 95.9983063f
#define LAIKIN_DOUBLE_GAUSS_50_PUPIL_Z_MM (-17.2753983f)
#define LAIKIN_DOUBLE_GAUSS_50_PUPIL_RADIUS_MM 34.4170189f
#define LAIKIN_DOUBLE_GAUSS_50_STOP_RADIUS_MAX_MM 9.52499962f
#define LAIKIN_DOUBLE_GAUSS_50_WAVELENGTH_MIN_NM 400.0f
#define LAIKIN_DOUBLE_GAUSS_50_WAVELENGTH_MAX_NM 700.0f

LAIKIN_DOUBLE_GAUSS_50_INLINE float laikin_double_gauss_50_film_z_mm(float focus_m, float stop_radius_mm)
{
    float t1 = 1.0f / focus_m;
    float t2 = t1 / 1.42857146f;
    float t3 = t2 > 0.0f ? t2 : 0.0f;
    float t4 = t3 < 1.0f ? t3 : 1.0f;
    float t5 = t4 * 2.0f;
    float t6 = t5 - 1.0f;
    float t8 = stop_radius_mm / 9.52499962f;
    float t9 = t8 > 0.0625f ? t8 : 0.0625f;
    float t10 = t9 < 1.0f ? t9 : 1.0f;
    float t11 = t10 * 2.13333344f;
    float t12 = t11 - 1.13333333f;
    float t13 = t6 * t6;
    float t14 = t13 * t6;
    float t15 = t14 * t6;
    float t16 = t15 * t6;
    float t17 = t16 * t6;
    float t18 = t12 * t12;
    float t19 = t18 * t12;
    float t20 = t19 * t12;
    float t21 = t20 * t12;
    float t22 = t21 * t12;
    float t23 = t22 * t12;
    float t24 = t23 * t12;
    float t25 = t24 * t12;
    float t26 = t25 * t12;
    float t27 = t24 * t6;
    float t28 = t23 * t6;
    float t29 = t22 * t6;
    float t30 = t29 * t6;
    float t31 = t21 * t6;
    float t32 = t31 * t6;
    float t33 = t32 * t6;
    float t34 = t20 * t6;
    float t35 = t34 * t6;
    float t36 = t35 * t6;
    float t37 = t19 * t6;
    float t38 = t37 * t6;
    float t39 = t38 * t6;
    float t40 = t39 * t6;
    float t41 = t18 * t6;
    float t42 = t41 * t6;
    float t43 = t42 * t6;
    float t44 = t43 * t6;
    float t45 = t12 * t6;
    float t46 = t45 * t6;
    float t47 = t46 * t6;
    float t48 = t47 * t6;
    float t49 = t48 * t6;
    float t50 = 6.47697525e-05f * t17;
    float t51 = LAIKIN_DOUBLE_GAUSS_50_FMA((-1.61240405e-06f), t49, t50);
    float t52 = LAIKIN_DOUBLE_GAUSS_50_FMA(0.000154956855f, t16, t51);
    float t53 = LAIKIN_DOUBLE_GAUSS_50_FMA(2.81550856e-05f, t40, t52);
    float t54 = LAIKIN_DOUBLE_GAUSS_50_FMA((-2.54315228e-06f), t44, t53);
    float t55 = LAIKIN_DOUBLE_GAUSS_50_FMA((-4.50961197e-05f), t48, t54);
    float t56 = LAIKIN_DOUBLE_GAUSS_50_FMA(0.00124037627f, t15, t55);
    float t57 = LAIKIN_DOUBLE_GAUSS_50_FMA((-0.000133118214f), t33, t56);
    float t58 = LAIKIN_DOUBLE_GAUSS_50_FMA((-5.36353873e-05f), t36, t57);
    float t59 = LAIKIN_DOUBLE_GAUSS_50_FMA(0.000161096279f, t39, t58);
    float t60 = LAIKIN_DOUBLE_GAUSS_50_FMA((-2.27564851e-05f), t43, t59);
    float t61 = LAIKIN_DOUBLE_GAUSS_50_FMA((-0.000227712269f), t47, t60);
    float t62 = LAIKIN_DOUBLE_GAUSS_50_FMA(0.0123587614f, t14, t61);
    float t63 = LAIKIN_DOUBLE_GAUSS_50_FMA((-9.83518767e-05f), t30, t62);
    float t64 = LAIKIN_DOUBLE_GAUSS_50_FMA((-5.26496442e-05f), t32, t63);
    float t65 = LAIKIN_DOUBLE_GAUSS_50_FMA(0.00013006512f, t35, t64);
    float t66 = LAIKIN_DOUBLE_GAUSS_50_FMA(7.32733388e-05f, t38, t65);
    float t67 = LAIKIN_DOUBLE_GAUSS_50_FMA((-0.000797400484f), t42, t66);
    float t68 = LAIKIN_DOUBLE_GAUSS_50_FMA((-0.00183239067f), t46, t67);
    float t69 = LAIKIN_DOUBLE_GAUSS_50_FMA(0.13487272f, t13, t68);
    float t70 = LAIKIN_DOUBLE_GAUSS_50_FMA(0.000320796215f, t27, t69);
    float t71 = LAIKIN_DOUBLE_GAUSS_50_FMA((-2.66568895e-05f), t28, t70);
    float t72 = LAIKIN_DOUBLE_GAUSS_50_FMA((-0.000762348063f), t29, t71);
    float t73 = LAIKIN_DOUBLE_GAUSS_50_FMA((-0.000199782196f), t31, t72);
    float t74 = LAIKIN_DOUBLE_GAUSS_50_FMA((-3.05794711e-05f), t34, t73);
    float t75 = LAIKIN_DOUBLE_GAUSS_50_FMA((-0.000627895759f), t37, t74);
    float t76 = LAIKIN_DOUBLE_GAUSS_50_FMA((-0.0149063384f), t41, t75);
    float t77 = LAIKIN_DOUBLE_GAUSS_50_FMA((-0.0328611024f), t45, t76);
    float t78 = LAIKIN_DOUBLE_GAUSS_50_FMA(1.97945702f, t6, t77);
    float t79 = LAIKIN_DOUBLE_GAUSS_50_FMA(0.00646481896f, t26, t78);
    float t80 = LAIKIN_DOUBLE_GAUSS_50_FMA(0.00186839944f, t25, t79);
    float t81 = LAIKIN_DOUBLE_GAUSS_50_FMA((-0.0156693626f), t24, t80);
    float t82 = LAIKIN_DOUBLE_GAUSS_50_FMA((-0.00406377623f), t23, t81);
    float t83 = LAIKIN_DOUBLE_GAUSS_50_FMA(0.0144189028f, t22, t82);
    float t84 = LAIKIN_DOUBLE_GAUSS_50_FMA(0.00497182878f, t21, t83);
    float t85 = LAIKIN_DOUBLE_GAUSS_50_FMA(0.00256075733f, t20, t84);
    float t86 = LAIKIN_DOUBLE_GAUSS_50_FMA(0.0244667288f, t19, t85);
    float t87 = LAIKIN_DOUBLE_GAUSS_50_FMA((-0.0652428418f), t18, t86);
    float t88 = LAIKIN_DOUBLE_GAUSS_50_FMA((-0.211319074f), t12, t87);
    float t89 = 93.3817596f + t88;
    float t90 = t89 > 91.2917709f ? t89 : 91.2917709f;
    float t91 = t90 < 95.9983063f ? t90 : 95.9983063f;
    return t91;
}

LAIKIN_DOUBLE_GAUSS_50_INLINE float laikin_double_gauss_50_film_z_paraxial_mm(float focus_m)
{
    float t1 = 1.0f / focus_m;
    float t2 = t1 / 1.42857146f;
    float t3 = t2 > 0.0f ? t2 : 0.0f;
    float t4 = t3 < 1.0f ? t3 : 1.0f;
    float t5 = t4 * 2.0f;
    float t6 = t5 - 1.0f;
    float t7 = t6 * t6;
    float t8 = t7 * t6;
    float t9 = t8 * t6;
    float t10 = t9 * t6;
    float t11 = 0.000149248051f * t10;
    float t12 = LAIKIN_DOUBLE_GAUSS_50_FMA(0.00132761535f, t9, t11);
    float t13 = LAIKIN_DOUBLE_GAUSS_50_FMA(0.012527192f, t8, t12);
    float t14 = LAIKIN_DOUBLE_GAUSS_50_FMA(0.136173576f, t7, t13);
    float t15 = LAIKIN_DOUBLE_GAUSS_50_FMA(1.99920797f, t6, t14);
    float t16 = 93.5119019f + t15;
    float t17 = t16 > 91.2917709f ? t16 : 91.2917709f;
    float t18 = t17 < 95.9983063f ? t17 : 95.9983063f;
    return t18;
}

typedef struct {
    float x_mm;
    float y_mm;
    float z_mm;
    float dx;
    float dy;
    float dz;
    float transmittance;
    float stop_x_mm;
    float stop_y_mm;
    int status;
} laikin_double_gauss_50_ray;

LAIKIN_DOUBLE_GAUSS_50_INLINE laikin_double_gauss_50_ray laikin_double_gauss_50(
    float film_x_mm,
    float film_y_mm,
    float pupil_x_mm,
    float pupil_y_mm,
    float wavelength_nm,
    float film_z_mm,
    float stop_radius_mm)
{
    (void)film_x_mm;
    (void)film_y_mm;
    (void)pupil_x_mm;
    (void)pupil_y_mm;
    (void)wavelength_nm;
    (void)film_z_mm;
    (void)stop_radius_mm;
    laikin_double_gauss_50_ray ray;
    float t7 = film_y_mm * film_y_mm;
    float t8 = LAIKIN_DOUBLE_GAUSS_50_FMA(film_x_mm, film_x_mm, t7);
    float t9 = 91.2908554f <= film_z_mm ? 466.569336f : (-1.0f);
    float t10 = film_z_mm <= 95.9992599f ? t9 : (-1.0f);
    float t11 = 0.0f <= stop_radius_mm ? t10 : (-1.0f);
    float t12 = stop_radius_mm <= 9.52509499f ? t11 : (-1.0f);
    float t13 = pupil_y_mm * pupil_y_mm;
    float t14 = LAIKIN_DOUBLE_GAUSS_50_FMA(pupil_x_mm, pupil_x_mm, t13);
    float t15 = film_z_mm - (-17.2753983f);
    float t16 = 108.567169f / t15;
    float t17 = 689.312378f / wavelength_nm;
    float t18 = 1.0f - t16;
    float t19 = t18 * 0.046411939f;
    float t20 = pupil_x_mm * t19;
    float t21 = t16 * 0.046411939f;
    float t22 = LAIKIN_DOUBLE_GAUSS_50_FMA(film_x_mm, t21, t20);
    float t23 = pupil_y_mm * t19;
    float t24 = LAIKIN_DOUBLE_GAUSS_50_FMA(film_y_mm, t21, t23);
    float t25 = t16 * (-0.00485492405f);
    float t26 = film_x_mm * t25;
    float t27 = LAIKIN_DOUBLE_GAUSS_50_FMA(t18, (-0.00485492405f), 0.0304445289f);
    float t28 = LAIKIN_DOUBLE_GAUSS_50_FMA(pupil_x_mm, t27, t26);
    float t29 = film_y_mm * t25;
    float t30 = LAIKIN_DOUBLE_GAUSS_50_FMA(pupil_y_mm, t27, t29);
    float t31 = t24 * t24;
    float t32 = LAIKIN_DOUBLE_GAUSS_50_FMA(t22, t22, t31);
    float t33 = t24 * t30;
    float t34 = LAIKIN_DOUBLE_GAUSS_50_FMA(t22, t28, t33);
    float t35 = t30 * t30;
    float t36 = LAIKIN_DOUBLE_GAUSS_50_FMA(t28, t28, t35);
    float t37 = LAIKIN_DOUBLE_GAUSS_50_FMA(t17, t17, (-1.969697f));
    float t38 = LAIKIN_DOUBLE_GAUSS_50_FMA(t32, (-3.20951748f), (-11.8810434f));
    float t39 = LAIKIN_DOUBLE_GAUSS_50_FMA(t32, 0.00606309716f, (-0.435505629f));
    float t40 = LAIKIN_DOUBLE_GAUSS_50_FMA(t32, (-1.64955032f), 1.0237422f);
    float t41 = LAIKIN_DOUBLE_GAUSS_50_FMA(t32, 0.37717396f, 15.0265217f);
    float t42 = LAIKIN_DOUBLE_GAUSS_50_FMA(t32, (-0.00419616653f), 0.00218099426f);
    float t43 = LAIKIN_DOUBLE_GAUSS_50_FMA(t32, 0.291584492f, 10.3423262f);
    float t44 = LAIKIN_DOUBLE_GAUSS_50_FMA(t32, 0.473576605f, (-0.997200906f));
    float t45 = LAIKIN_DOUBLE_GAUSS_50_FMA(t32, 0.564224243f, (-1.00034797f));
    float t46 = LAIKIN_DOUBLE_GAUSS_50_FMA(t32, 0.464114994f, (-1.00017917f));
    float t47 = LAIKIN_DOUBLE_GAUSS_50_FMA(t32, 0.201046586f, (-0.99850291f));
    float t48 = LAIKIN_DOUBLE_GAUSS_50_FMA(t32, 0.226338848f, (-0.998343229f));
    float t49 = t32 * t32;
    float t50 = LAIKIN_DOUBLE_GAUSS_50_FMA(t49, (-0.43374306f), t38);
    float t51 = LAIKIN_DOUBLE_GAUSS_50_FMA(t49, (-0.000381737103f), t39);
    float t52 = LAIKIN_DOUBLE_GAUSS_50_FMA(t49, (-0.501358449f), t40);
    float t53 = LAIKIN_DOUBLE_GAUSS_50_FMA(t49, 0.0369910188f, t41);
    float t54 = LAIKIN_DOUBLE_GAUSS_50_FMA(t49, 0.00252348976f, t42);
    float t55 = LAIKIN_DOUBLE_GAUSS_50_FMA(t49, (-0.00119420351f), 0.499428213f);
    float t56 = LAIKIN_DOUBLE_GAUSS_50_FMA(t49, 0.011821242f, t44);
    float t57 = LAIKIN_DOUBLE_GAUSS_50_FMA(t49, (-0.0906037763f), t45);
    float t58 = LAIKIN_DOUBLE_GAUSS_50_FMA(t49, (-0.170106962f), t46);
    float t59 = LAIKIN_DOUBLE_GAUSS_50_FMA(t49, 0.172341689f, t47);
    float t60 = LAIKIN_DOUBLE_GAUSS_50_FMA(t49, 0.219247103f, t48);
    float t61 = t49 * t32;
    float t62 = LAIKIN_DOUBLE_GAUSS_50_FMA(t61, 0.00119546673f, t50);
    float t63 = LAIKIN_DOUBLE_GAUSS_50_FMA(t61, 0.000146020684f, t51);
    float t64 = LAIKIN_DOUBLE_GAUSS_50_FMA(t61, (-0.00647292286f), t53);
    float t65 = LAIKIN_DOUBLE_GAUSS_50_FMA(t61, (-0.000247066637f), t54);
    float t66 = LAIKIN_DOUBLE_GAUSS_50_FMA(t61, 0.0549243428f, t59);
    float t67 = t61 * t32;
    float t68 = LAIKIN_DOUBLE_GAUSS_50_FMA(t67, 0.00417835824f, t62);
    float t69 = LAIKIN_DOUBLE_GAUSS_50_FMA(t67, (-4.33599344e-05f), t63);
    float t70 = LAIKIN_DOUBLE_GAUSS_50_FMA(t67, (-0.11120034f), t52);
    float t71 = LAIKIN_DOUBLE_GAUSS_50_FMA(t67, 0.0314424373f, t64);
    float t72 = LAIKIN_DOUBLE_GAUSS_50_FMA(t67, 0.000578365929f, t65);
    float t73 = LAIKIN_DOUBLE_GAUSS_50_FMA(t67, 0.0307136811f, t43);
    float t74 = LAIKIN_DOUBLE_GAUSS_50_FMA(t67, 0.0652175024f, t60);
    float t75 = LAIKIN_DOUBLE_GAUSS_50_FMA(t34, (-1.21882808f), t68);
    float t76 = LAIKIN_DOUBLE_GAUSS_50_FMA(t34, 0.00309305219f, t69);
    float t77 = LAIKIN_DOUBLE_GAUSS_50_FMA(t34, 0.523116052f, t70);
    float t78 = LAIKIN_DOUBLE_GAUSS_50_FMA(t34, 0.842702925f, t71);
    float t79 = LAIKIN_DOUBLE_GAUSS_50_FMA(t34, (-0.000764448778f), t72);
    float t80 = LAIKIN_DOUBLE_GAUSS_50_FMA(t34, 0.435077339f, t73);
    float t81 = LAIKIN_DOUBLE_GAUSS_50_FMA(t34, 0.72624898f, t56);
    float t82 = LAIKIN_DOUBLE_GAUSS_50_FMA(t34, 0.866684556f, t57);
    float t83 = LAIKIN_DOUBLE_GAUSS_50_FMA(t34, 1.24958813f, t58);
    float t84 = LAIKIN_DOUBLE_GAUSS_50_FMA(t34, (-0.875239074f), t66);
    float t85 = LAIKIN_DOUBLE_GAUSS_50_FMA(t34, (-0.691227198f), t74);
    float t86 = t34 * t34;
    float t87 = LAIKIN_DOUBLE_GAUSS_50_FMA(t86, (-0.133955553f), t75);
    float t88 = LAIKIN_DOUBLE_GAUSS_50_FMA(t86, 0.00171046564f, t76);
    float t89 = LAIKIN_DOUBLE_GAUSS_50_FMA(t86, 0.0488928668f, t78);
    float t90 = LAIKIN_DOUBLE_GAUSS_50_FMA(t86, (-0.00203704042f), t79);
    float t91 = LAIKIN_DOUBLE_GAUSS_50_FMA(t86, 0.252218038f, t80);
    float t92 = LAIKIN_DOUBLE_GAUSS_50_FMA(t86, 0.0101626152f, t55);
    float t93 = LAIKIN_DOUBLE_GAUSS_50_FMA(t86, (-0.00948883407f), t81);
    float t94 = LAIKIN_DOUBLE_GAUSS_50_FMA(t86, (-0.0435878038f), t82);
    float t95 = LAIKIN_DOUBLE_GAUSS_50_FMA(t86, (-0.301171005f), t83);
    float t96 = LAIKIN_DOUBLE_GAUSS_50_FMA(t86, (-0.259712219f), t84);
    float t97 = t86 * t34;
    float t98 = LAIKIN_DOUBLE_GAUSS_50_FMA(t97, (-0.0361824632f), t87);
    float t99 = LAIKIN_DOUBLE_GAUSS_50_FMA(t97, 0.000110112473f, t88);
    float t100 = LAIKIN_DOUBLE_GAUSS_50_FMA(t97, 0.0397712588f, t89);
    float t101 = LAIKIN_DOUBLE_GAUSS_50_FMA(t97, 0.000559700595f, t90);
    float t102 = LAIKIN_DOUBLE_GAUSS_50_FMA(t97, 0.0375992917f, t91);
    float t103 = LAIKIN_DOUBLE_GAUSS_50_FMA(t97, 0.0403505862f, t95);
    float t104 = LAIKIN_DOUBLE_GAUSS_50_FMA(t97, (-0.0661599338f), t96);
    float t105 = t97 * t34;
    float t106 = LAIKIN_DOUBLE_GAUSS_50_FMA(t105, 0.00784042943f, t98);
    float t107 = LAIKIN_DOUBLE_GAUSS_50_FMA(t105, (-0.000303521927f), t99);
    float t108 = LAIKIN_DOUBLE_GAUSS_50_FMA(t105, (-0.0109335147f), t100);
    float t109 = LAIKIN_DOUBLE_GAUSS_50_FMA(t105, (-0.000267288968f), t101);
    float t110 = t97 * t32;
    float t111 = LAIKIN_DOUBLE_GAUSS_50_FMA(t110, 0.0388633162f, t106);
    float t112 = LAIKIN_DOUBLE_GAUSS_50_FMA(t110, 0.000440667907f, t107);
    float t113 = LAIKIN_DOUBLE_GAUSS_50_FMA(t110, (-0.0390472151f), t108);
    float t114 = LAIKIN_DOUBLE_GAUSS_50_FMA(t110, (-0.000937657722f), t109);
    float t115 = t86 * t32;
    float t116 = LAIKIN_DOUBLE_GAUSS_50_FMA(t115, (-0.152131543f), t111);
    float t117 = LAIKIN_DOUBLE_GAUSS_50_FMA(t115, (-0.00129711768f), t112);
    float t118 = LAIKIN_DOUBLE_GAUSS_50_FMA(t115, (-0.114989981f), t77);
    float t119 = LAIKIN_DOUBLE_GAUSS_50_FMA(t115, (-0.124441892f), t113);
    float t120 = LAIKIN_DOUBLE_GAUSS_50_FMA(t115, (-0.00313371234f), t114);
    float t121 = LAIKIN_DOUBLE_GAUSS_50_FMA(t115, 0.108795807f, t103);
    float t122 = LAIKIN_DOUBLE_GAUSS_50_FMA(t115, (-0.0991413072f), t104);
    float t123 = t115 * t32;
    float t124 = LAIKIN_DOUBLE_GAUSS_50_FMA(t123, 0.175181657f, t116);
    float t125 = LAIKIN_DOUBLE_GAUSS_50_FMA(t123, 0.00324938376f, t117);
    float t126 = LAIKIN_DOUBLE_GAUSS_50_FMA(t123, 0.0576481447f, t119);
    float t127 = LAIKIN_DOUBLE_GAUSS_50_FMA(t123, 0.000192379026f, t120);
    float t128 = LAIKIN_DOUBLE_GAUSS_50_FMA(t123, 0.0141451368f, t85);
    float t129 = t34 * t32;
    float t130 = LAIKIN_DOUBLE_GAUSS_50_FMA(t129, (-0.722762346f), t124);
    float t131 = LAIKIN_DOUBLE_GAUSS_50_FMA(t129, (-0.00139075692f), t125);
    float t132 = LAIKIN_DOUBLE_GAUSS_50_FMA(t129, 0.174151748f, t118);
    float t133 = LAIKIN_DOUBLE_GAUSS_50_FMA(t129, (-0.129708171f), t126);
    float t134 = LAIKIN_DOUBLE_GAUSS_50_FMA(t129, (-0.00278562377f), t127);
    float t135 = LAIKIN_DOUBLE_GAUSS_50_FMA(t129, (-0.179667592f), t94);
    float t136 = LAIKIN_DOUBLE_GAUSS_50_FMA(t129, (-0.54467088f), t121);
    float t137 = LAIKIN_DOUBLE_GAUSS_50_FMA(t129, (-0.278922021f), t122);
    float t138 = LAIKIN_DOUBLE_GAUSS_50_FMA(t129, (-0.317790478f), t128);
    float t139 = t129 * t32;
    float t140 = LAIKIN_DOUBLE_GAUSS_50_FMA(t139, (-0.0706497878f), t130);
    float t141 = LAIKIN_DOUBLE_GAUSS_50_FMA(t139, 0.000311404001f, t131);
    float t142 = LAIKIN_DOUBLE_GAUSS_50_FMA(t139, (-0.0572534055f), t133);
    float t143 = LAIKIN_DOUBLE_GAUSS_50_FMA(t139, (-0.00181781279f), t134);
    float t144 = LAIKIN_DOUBLE_GAUSS_50_FMA(t139, 0.0918659121f, t136);
    float t145 = t139 * t32;
    float t146 = LAIKIN_DOUBLE_GAUSS_50_FMA(t145, 0.0168556254f, t140);
    float t147 = LAIKIN_DOUBLE_GAUSS_50_FMA(t145, (-2.14918728e-05f), t141);
    float t148 = LAIKIN_DOUBLE_GAUSS_50_FMA(t145, 0.116741747f, t132);
    float t149 = LAIKIN_DOUBLE_GAUSS_50_FMA(t145, (-0.000346085115f), t142);
    float t150 = LAIKIN_DOUBLE_GAUSS_50_FMA(t145, 0.000590096693f, t143);
    float t151 = LAIKIN_DOUBLE_GAUSS_50_FMA(t145, (-0.0269088801f), t102);
    float t152 = LAIKIN_DOUBLE_GAUSS_50_FMA(t145, 0.0721038654f, t137);
    float t153 = LAIKIN_DOUBLE_GAUSS_50_FMA(t145, (-0.0772682503f), t138);
    float t154 = LAIKIN_DOUBLE_GAUSS_50_FMA(t36, 1.67363429f, t146);
    float t155 = LAIKIN_DOUBLE_GAUSS_50_FMA(t36, (-0.00042150286f), t147);
    float t156 = LAIKIN_DOUBLE_GAUSS_50_FMA(t36, (-0.831731081f), t149);
    float t157 = LAIKIN_DOUBLE_GAUSS_50_FMA(t36, (-0.00448373426f), t150);
    float t158 = LAIKIN_DOUBLE_GAUSS_50_FMA(t36, (-0.594571173f), t151);
    float t159 = LAIKIN_DOUBLE_GAUSS_50_FMA(t36, 0.261655241f, t93);
    float t160 = LAIKIN_DOUBLE_GAUSS_50_FMA(t36, 0.331985801f, t135);
    float t161 = LAIKIN_DOUBLE_GAUSS_50_FMA(t36, 0.801681459f, t144);
    float t162 = LAIKIN_DOUBLE_GAUSS_50_FMA(t36, 0.958400428f, t152);
    float t163 = LAIKIN_DOUBLE_GAUSS_50_FMA(t36, 0.500986457f, t153);
    float t164 = t36 * t36;
    float t165 = LAIKIN_DOUBLE_GAUSS_50_FMA(t164, 0.00386060611f, t154);
    float t166 = LAIKIN_DOUBLE_GAUSS_50_FMA(t164, 0.000208850382f, t155);
    float t167 = LAIKIN_DOUBLE_GAUSS_50_FMA(t164, 0.0296211764f, t148);
    float t168 = LAIKIN_DOUBLE_GAUSS_50_FMA(t164, 0.138861924f, t156);
    float t169 = LAIKIN_DOUBLE_GAUSS_50_FMA(t164, 0.00245518913f, t157);
    float t170 = LAIKIN_DOUBLE_GAUSS_50_FMA(t164, (-0.00240240153f), t92);
    float t171 = LAIKIN_DOUBLE_GAUSS_50_FMA(t164, 0.0179659761f, t160);
    float t172 = LAIKIN_DOUBLE_GAUSS_50_FMA(t164, (-0.0510863923f), t161);
    float t173 = LAIKIN_DOUBLE_GAUSS_50_FMA(t164, (-0.146117568f), t162);
    float t174 = LAIKIN_DOUBLE_GAUSS_50_FMA(t164, (-0.0153010897f), t163);
    float t175 = t164 * t36;
    float t176 = LAIKIN_DOUBLE_GAUSS_50_FMA(t175, (-0.00532061979f), t165);
    float t177 = LAIKIN_DOUBLE_GAUSS_50_FMA(t175, (-0.000238849709f), t166);
    float t178 = LAIKIN_DOUBLE_GAUSS_50_FMA(t175, (-0.0301461723f), t168);
    float t179 = LAIKIN_DOUBLE_GAUSS_50_FMA(t175, (-0.00034005678f), t169);
    float t180 = t175 * t36;
    float t181 = LAIKIN_DOUBLE_GAUSS_50_FMA(t180, 0.00751193007f, t176);
    float t182 = LAIKIN_DOUBLE_GAUSS_50_FMA(t180, 2.96563758e-06f, t177);
    float t183 = LAIKIN_DOUBLE_GAUSS_50_FMA(t180, 0.00524842413f, t178);
    float t184 = LAIKIN_DOUBLE_GAUSS_50_FMA(t180, 0.000164817786f, t179);
    float t185 = t175 * t34;
    float t186 = LAIKIN_DOUBLE_GAUSS_50_FMA(t185, 0.0183279235f, t181);
    float t187 = LAIKIN_DOUBLE_GAUSS_50_FMA(t185, 4.69362458e-05f, t182);
    float t188 = LAIKIN_DOUBLE_GAUSS_50_FMA(t185, (-0.0089979507f), t183);
    float t189 = LAIKIN_DOUBLE_GAUSS_50_FMA(t185, (-0.000315923506f), t184);
    float t190 = t175 * t32;
    float t191 = LAIKIN_DOUBLE_GAUSS_50_FMA(t190, 0.0106029082f, t186);
    float t192 = LAIKIN_DOUBLE_GAUSS_50_FMA(t190, (-8.86869457e-05f), t187);
    float t193 = LAIKIN_DOUBLE_GAUSS_50_FMA(t190, 0.00247916719f, t188);
    float t194 = LAIKIN_DOUBLE_GAUSS_50_FMA(t190, 0.000300292653f, t189);
    float t195 = t164 * t34;
    float t196 = LAIKIN_DOUBLE_GAUSS_50_FMA(t195, 0.0406259224f, t191);
    float t197 = LAIKIN_DOUBLE_GAUSS_50_FMA(t195, 0.000771674851f, t192);
    float t198 = LAIKIN_DOUBLE_GAUSS_50_FMA(t195, 0.0338593833f, t193);
    float t199 = LAIKIN_DOUBLE_GAUSS_50_FMA(t195, (-0.000538300199f), t194);
    float t200 = LAIKIN_DOUBLE_GAUSS_50_FMA(t195, (-0.0863832608f), t173);
    float t201 = t195 * t34;
    float t202 = LAIKIN_DOUBLE_GAUSS_50_FMA(t201, 0.0314683989f, t196);
    float t203 = LAIKIN_DOUBLE_GAUSS_50_FMA(t201, 0.0012483031f, t197);
    float t204 = LAIKIN_DOUBLE_GAUSS_50_FMA(t201, 0.0348736271f, t198);
    float t205 = LAIKIN_DOUBLE_GAUSS_50_FMA(t201, 0.000582819339f, t199);
    float t206 = t195 * t32;
    float t207 = LAIKIN_DOUBLE_GAUSS_50_FMA(t206, (-0.0705774352f), t202);
    float t208 = LAIKIN_DOUBLE_GAUSS_50_FMA(t206, (-0.000965462183f), t203);
    float t209 = LAIKIN_DOUBLE_GAUSS_50_FMA(t206, (-0.0398003869f), t204);
    float t210 = LAIKIN_DOUBLE_GAUSS_50_FMA(t206, (-0.000613221957f), t205);
    float t211 = t164 * t32;
    float t212 = LAIKIN_DOUBLE_GAUSS_50_FMA(t211, 0.00692391908f, t207);
    float t213 = LAIKIN_DOUBLE_GAUSS_50_FMA(t211, (-9.30089591e-05f), t208);
    float t214 = LAIKIN_DOUBLE_GAUSS_50_FMA(t211, 0.0117554553f, t209);
    float t215 = LAIKIN_DOUBLE_GAUSS_50_FMA(t211, 0.000465244433f, t210);
    float t216 = LAIKIN_DOUBLE_GAUSS_50_FMA(t211, 0.0310129598f, t200);
    float t217 = t211 * t32;
    float t218 = LAIKIN_DOUBLE_GAUSS_50_FMA(t217, (-0.0115503967f), t212);
    float t219 = LAIKIN_DOUBLE_GAUSS_50_FMA(t217, (-0.000544462877f), t213);
    float t220 = LAIKIN_DOUBLE_GAUSS_50_FMA(t217, 0.0111388303f, t214);
    float t221 = LAIKIN_DOUBLE_GAUSS_50_FMA(t217, 0.000787234283f, t215);
    float t222 = LAIKIN_DOUBLE_GAUSS_50_FMA(t217, 0.00632320996f, t174);
    float t223 = t36 * t34;
    float t224 = LAIKIN_DOUBLE_GAUSS_50_FMA(t223, 0.114864767f, t218);
    float t225 = LAIKIN_DOUBLE_GAUSS_50_FMA(t223, (-0.00268741697f), t219);
    float t226 = LAIKIN_DOUBLE_GAUSS_50_FMA(t223, (-0.149958178f), t167);
    float t227 = LAIKIN_DOUBLE_GAUSS_50_FMA(t223, (-0.201842636f), t220);
    float t228 = LAIKIN_DOUBLE_GAUSS_50_FMA(t223, 6.23516607e-05f, t221);
    float t229 = LAIKIN_DOUBLE_GAUSS_50_FMA(t223, (-0.167351291f), t158);
    float t230 = LAIKIN_DOUBLE_GAUSS_50_FMA(t223, (-0.0261443686f), t159);
    float t231 = LAIKIN_DOUBLE_GAUSS_50_FMA(t223, 0.0275130067f, t171);
    float t232 = LAIKIN_DOUBLE_GAUSS_50_FMA(t223, (-0.197268203f), t172);
    float t233 = LAIKIN_DOUBLE_GAUSS_50_FMA(t223, 0.522659004f, t216);
    float t234 = LAIKIN_DOUBLE_GAUSS_50_FMA(t223, 0.0745443255f, t222);
    float t235 = t223 * t34;
    float t236 = LAIKIN_DOUBLE_GAUSS_50_FMA(t235, (-0.0967399627f), t224);
    float t237 = LAIKIN_DOUBLE_GAUSS_50_FMA(t235, (-8.06444732e-05f), t225);
    float t238 = LAIKIN_DOUBLE_GAUSS_50_FMA(t235, 0.0291367937f, t227);
    float t239 = LAIKIN_DOUBLE_GAUSS_50_FMA(t235, 0.000223580384f, t228);
    float t240 = LAIKIN_DOUBLE_GAUSS_50_FMA(t235, 0.118954949f, t233);
    float t241 = t235 * t34;
    float t242 = LAIKIN_DOUBLE_GAUSS_50_FMA(t241, (-0.120642886f), t236);
    float t243 = LAIKIN_DOUBLE_GAUSS_50_FMA(t241, (-0.000873303332f), t237);
    float t244 = LAIKIN_DOUBLE_GAUSS_50_FMA(t241, (-0.0143971825f), t238);
    float t245 = LAIKIN_DOUBLE_GAUSS_50_FMA(t241, 0.00102274923f, t239);
    float t246 = t235 * t32;
    float t247 = LAIKIN_DOUBLE_GAUSS_50_FMA(t246, (-0.142935291f), t242);
    float t248 = LAIKIN_DOUBLE_GAUSS_50_FMA(t246, (-0.000747709011f), t243);
    float t249 = LAIKIN_DOUBLE_GAUSS_50_FMA(t246, (-0.0731592104f), t244);
    float t250 = LAIKIN_DOUBLE_GAUSS_50_FMA(t246, (-0.0013175942f), t245);
    float t251 = t223 * t32;
    float t252 = LAIKIN_DOUBLE_GAUSS_50_FMA(t251, (-0.199969113f), t247);
    float t253 = LAIKIN_DOUBLE_GAUSS_50_FMA(t251, (-0.0017519152f), t248);
    float t254 = LAIKIN_DOUBLE_GAUSS_50_FMA(t251, (-0.0370913818f), t249);
    float t255 = LAIKIN_DOUBLE_GAUSS_50_FMA(t251, 0.000448058243f, t250);
    float t256 = LAIKIN_DOUBLE_GAUSS_50_FMA(t251, 0.0609861203f, t232);
    float t257 = t251 * t32;
    float t258 = LAIKIN_DOUBLE_GAUSS_50_FMA(t257, (-0.0264435858f), t252);
    float t259 = LAIKIN_DOUBLE_GAUSS_50_FMA(t257, (-0.000515072723f), t253);
    float t260 = LAIKIN_DOUBLE_GAUSS_50_FMA(t257, (-0.0841266736f), t254);
    float t261 = LAIKIN_DOUBLE_GAUSS_50_FMA(t257, (-0.00250904774f), t255);
    float t262 = t36 * t32;
    float t263 = LAIKIN_DOUBLE_GAUSS_50_FMA(t262, 0.118226647f, t258);
    float t264 = LAIKIN_DOUBLE_GAUSS_50_FMA(t262, (-0.001126352f), t259);
    float t265 = LAIKIN_DOUBLE_GAUSS_50_FMA(t262, 0.0872766376f, t226);
    float t266 = LAIKIN_DOUBLE_GAUSS_50_FMA(t262, 0.0725111663f, t260);
    float t267 = LAIKIN_DOUBLE_GAUSS_50_FMA(t262, 0.00492677279f, t261);
    float t268 = LAIKIN_DOUBLE_GAUSS_50_FMA(t262, (-0.0712044612f), t229);
    float t269 = LAIKIN_DOUBLE_GAUSS_50_FMA(t262, (-0.00897908863f), t170);
    float t270 = LAIKIN_DOUBLE_GAUSS_50_FMA(t262, (-0.030234497f), t231);
    float t271 = LAIKIN_DOUBLE_GAUSS_50_FMA(t262, (-0.147897586f), t256);
    float t272 = LAIKIN_DOUBLE_GAUSS_50_FMA(t262, (-0.13855733f), t240);
    float t273 = t262 * t32;
    float t274 = LAIKIN_DOUBLE_GAUSS_50_FMA(t273, (-0.072908245f), t263);
    float t275 = LAIKIN_DOUBLE_GAUSS_50_FMA(t273, (-0.00124189584f), t264);
    float t276 = LAIKIN_DOUBLE_GAUSS_50_FMA(t273, (-0.0295316875f), t266);
    float t277 = LAIKIN_DOUBLE_GAUSS_50_FMA(t273, (-0.000315433979f), t267);
    float t278 = LAIKIN_DOUBLE_GAUSS_50_FMA(t273, 0.028885128f, t271);
    float t279 = LAIKIN_DOUBLE_GAUSS_50_FMA(t273, (-0.0727278292f), t272);
    float t280 = t273 * t32;
    float t281 = LAIKIN_DOUBLE_GAUSS_50_FMA(t280, 0.0345795192f, t274);
    float t282 = LAIKIN_DOUBLE_GAUSS_50_FMA(t280, 0.000451443717f, t275);
    float t283 = LAIKIN_DOUBLE_GAUSS_50_FMA(t280, 0.0503739156f, t276);
    float t284 = LAIKIN_DOUBLE_GAUSS_50_FMA(t280, 0.000747553597f, t277);
    float t285 = LAIKIN_DOUBLE_GAUSS_50_FMA(t37, (-0.198282063f), t281);
    float t286 = LAIKIN_DOUBLE_GAUSS_50_FMA(t37, (-0.000189588376f), t282);
    float t287 = LAIKIN_DOUBLE_GAUSS_50_FMA(t37, (-0.0961630419f), t265);
    float t288 = LAIKIN_DOUBLE_GAUSS_50_FMA(t37, 0.017893644f, t283);
    float t289 = LAIKIN_DOUBLE_GAUSS_50_FMA(t37, 0.000786604185f, t284);
    float t290 = LAIKIN_DOUBLE_GAUSS_50_FMA(t37, (-0.0649207532f), t268);
    float t291 = LAIKIN_DOUBLE_GAUSS_50_FMA(t37, (-0.0132562993f), t269);
    float t292 = t37 * t37;
    float t293 = LAIKIN_DOUBLE_GAUSS_50_FMA(t292, 0.0345843025f, t285);
    float t294 = LAIKIN_DOUBLE_GAUSS_50_FMA(t292, 0.000463770004f, t286);
    float t295 = LAIKIN_DOUBLE_GAUSS_50_FMA(t292, 0.0118425116f, t287);
    float t296 = LAIKIN_DOUBLE_GAUSS_50_FMA(t292, 0.0495838523f, t288);
    float t297 = LAIKIN_DOUBLE_GAUSS_50_FMA(t292, 0.00107831066f, t289);
    float t298 = LAIKIN_DOUBLE_GAUSS_50_FMA(t292, 0.0130494609f, t290);
    float t299 = LAIKIN_DOUBLE_GAUSS_50_FMA(t292, (-0.000358579942f), t291);
    float t300 = LAIKIN_DOUBLE_GAUSS_50_FMA(t292, 0.00127123506f, t279);
    float t301 = LAIKIN_DOUBLE_GAUSS_50_FMA(t292, 0.00112162938f, t234);
    float t302 = t37 * t36;
    float t303 = LAIKIN_DOUBLE_GAUSS_50_FMA(t302, 0.0273474343f, t293);
    float t304 = LAIKIN_DOUBLE_GAUSS_50_FMA(t302, 0.000362543971f, t294);
    float t305 = LAIKIN_DOUBLE_GAUSS_50_FMA(t302, 0.0188527014f, t295);
    float t306 = LAIKIN_DOUBLE_GAUSS_50_FMA(t302, 0.0122348182f, t296);
    float t307 = LAIKIN_DOUBLE_GAUSS_50_FMA(t302, 0.00020399662f, t297);
    float t308 = LAIKIN_DOUBLE_GAUSS_50_FMA(t302, 0.0139316935f, t298);
    float t309 = LAIKIN_DOUBLE_GAUSS_50_FMA(t302, (-0.0109953312f), t278);
    float t310 = LAIKIN_DOUBLE_GAUSS_50_FMA(t302, (-0.00609509926f), t300);
    float t311 = t302 * t36;
    float t312 = LAIKIN_DOUBLE_GAUSS_50_FMA(t311, 0.00945193507f, t303);
    float t313 = LAIKIN_DOUBLE_GAUSS_50_FMA(t311, 0.000104772269f, t304);
    float t314 = LAIKIN_DOUBLE_GAUSS_50_FMA(t311, 0.00757747097f, t306);
    float t315 = LAIKIN_DOUBLE_GAUSS_50_FMA(t311, 0.000155817354f, t307);
    float t316 = t302 * t34;
    float t317 = LAIKIN_DOUBLE_GAUSS_50_FMA(t316, 0.0280287247f, t312);
    float t318 = LAIKIN_DOUBLE_GAUSS_50_FMA(t316, 0.000257835316f, t313);
    float t319 = LAIKIN_DOUBLE_GAUSS_50_FMA(t316, 0.0225197934f, t314);
    float t320 = LAIKIN_DOUBLE_GAUSS_50_FMA(t316, 0.000534885621f, t315);
    float t321 = t302 * t32;
    float t322 = LAIKIN_DOUBLE_GAUSS_50_FMA(t321, 0.0188231152f, t317);
    float t323 = LAIKIN_DOUBLE_GAUSS_50_FMA(t321, (-4.57992428e-05f), t318);
    float t324 = LAIKIN_DOUBLE_GAUSS_50_FMA(t321, 0.00871290173f, t319);
    float t325 = LAIKIN_DOUBLE_GAUSS_50_FMA(t321, 0.000193049244f, t320);
    float t326 = t37 * t34;
    float t327 = LAIKIN_DOUBLE_GAUSS_50_FMA(t326, (-0.0161392223f), t322);
    float t328 = LAIKIN_DOUBLE_GAUSS_50_FMA(t326, 0.000176298854f, t323);
    float t329 = LAIKIN_DOUBLE_GAUSS_50_FMA(t326, 0.0225964785f, t324);
    float t330 = LAIKIN_DOUBLE_GAUSS_50_FMA(t326, 0.000739051437f, t325);
    float t331 = LAIKIN_DOUBLE_GAUSS_50_FMA(t326, (-0.0119640958f), t309);
    float t332 = LAIKIN_DOUBLE_GAUSS_50_FMA(t326, (-0.0153373368f), t310);
    float t333 = LAIKIN_DOUBLE_GAUSS_50_FMA(t326, (-0.0169312209f), t301);
    float t334 = t326 * t34;
    float t335 = LAIKIN_DOUBLE_GAUSS_50_FMA(t334, 0.0325447246f, t327);
    float t336 = LAIKIN_DOUBLE_GAUSS_50_FMA(t334, 0.000190284743f, t328);
    float t337 = LAIKIN_DOUBLE_GAUSS_50_FMA(t334, 0.0190648064f, t329);
    float t338 = LAIKIN_DOUBLE_GAUSS_50_FMA(t334, 0.000336428086f, t330);
    float t339 = t326 * t32;
    float t340 = LAIKIN_DOUBLE_GAUSS_50_FMA(t339, (-0.00966312084f), t335);
    float t341 = LAIKIN_DOUBLE_GAUSS_50_FMA(t339, (-6.46013868e-05f), t336);
    float t342 = LAIKIN_DOUBLE_GAUSS_50_FMA(t339, 0.039176818f, t305);
    float t343 = LAIKIN_DOUBLE_GAUSS_50_FMA(t339, 0.00462976471f, t337);
    float t344 = LAIKIN_DOUBLE_GAUSS_50_FMA(t339, (-0.000131883324f), t338);
    float t345 = LAIKIN_DOUBLE_GAUSS_50_FMA(t339, (-0.00849656481f), t270);
    float t346 = LAIKIN_DOUBLE_GAUSS_50_FMA(t339, (-0.0117276907f), t333);
    float t347 = t37 * t32;
    float t348 = LAIKIN_DOUBLE_GAUSS_50_FMA(t347, (-0.0878058001f), t340);
    float t349 = LAIKIN_DOUBLE_GAUSS_50_FMA(t347, 0.00017962938f, t341);
    float t350 = LAIKIN_DOUBLE_GAUSS_50_FMA(t347, (-0.0305996519f), t342);
    float t351 = LAIKIN_DOUBLE_GAUSS_50_FMA(t347, 0.0211633984f, t343);
    float t352 = LAIKIN_DOUBLE_GAUSS_50_FMA(t347, 0.000566613977f, t344);
    float t353 = LAIKIN_DOUBLE_GAUSS_50_FMA(t347, (-0.00523843709f), t331);
    float t354 = t347 * t32;
    float t355 = LAIKIN_DOUBLE_GAUSS_50_FMA(t354, (-0.0222363863f), t348);
    float t356 = LAIKIN_DOUBLE_GAUSS_50_FMA(t354, (-6.73927134e-05f), t349);
    float t357 = LAIKIN_DOUBLE_GAUSS_50_FMA(t354, (-0.0423203036f), t350);
    float t358 = LAIKIN_DOUBLE_GAUSS_50_FMA(t354, 0.0108882599f, t351);
    float t359 = LAIKIN_DOUBLE_GAUSS_50_FMA(t354, 0.000120552439f, t352);
    float t360 = LAIKIN_DOUBLE_GAUSS_50_FMA(t354, 0.0171158463f, t332);
    float t361 = LAIKIN_DOUBLE_GAUSS_50_FMA(t354, 0.027004268f, t346);
    float t364 = t358 * t28;
    float t365 = t358 * t30;
    float t366 = LAIKIN_DOUBLE_GAUSS_50_FMA(t355, t22, t364);
    float t367 = LAIKIN_DOUBLE_GAUSS_50_FMA(t355, t24, t365);
    float t370 = t359 * t28;
    float t371 = t359 * t30;
    float t372 = LAIKIN_DOUBLE_GAUSS_50_FMA(t356, t22, t370);
    float t373 = LAIKIN_DOUBLE_GAUSS_50_FMA(t356, t24, t371);
    float t376 = t308 * t28;
    float t377 = t308 * t30;
    float t378 = LAIKIN_DOUBLE_GAUSS_50_FMA(t357, t22, t376);
    float t379 = LAIKIN_DOUBLE_GAUSS_50_FMA(t357, t24, t377);
    float t380 = t367 * t367;
    float t381 = LAIKIN_DOUBLE_GAUSS_50_FMA(t366, t366, t380);
    float t382 = LAIKIN_DOUBLE_GAUSS_50_FMA(1.12005787e-18f, t381, (-1.54821834e-16f));
    float t383 = LAIKIN_DOUBLE_GAUSS_50_FMA(t382, t381, 9.9061937e-13f);
    float t384 = LAIKIN_DOUBLE_GAUSS_50_FMA(t383, t381, 1.38010559e-09f);
    float t385 = LAIKIN_DOUBLE_GAUSS_50_FMA(t384, t381, 3.23937638e-06f);
    float t386 = LAIKIN_DOUBLE_GAUSS_50_FMA(t385, t381, 0.0147919431f);
    float t387 = LAIKIN_DOUBLE_GAUSS_50_FMA(t386, t381, 3.745904e-07f);
    float t388 = t373 * t373;
    float t389 = LAIKIN_DOUBLE_GAUSS_50_FMA(t372, t372, t388);
    float t390 = LAIKIN_DOUBLE_GAUSS_50_FMA(0.00827207044f, t389, (-0.166661933f));
    float t391 = LAIKIN_DOUBLE_GAUSS_50_FMA(t390, t389, 0.99999994f);
    float t392 = t372 * t391;
    float t393 = t373 * t391;
    float t394 = LAIKIN_DOUBLE_GAUSS_50_FMA(0.00137867767f, t389, (-0.0416653492f));
    float t395 = LAIKIN_DOUBLE_GAUSS_50_FMA(t394, t389, 0.49999994f);
    float t396 = LAIKIN_DOUBLE_GAUSS_50_FMA(t395, t389, (-1.0f));
    float t397 = t379 * t379;
    float t398 = LAIKIN_DOUBLE_GAUSS_50_FMA(t378, t378, t397);
    float t399 = stop_radius_mm * stop_radius_mm;
    float t400 = t389 <= 0.206508055f ? 0.0f : 1.0f;
    float t401 = t361 <= 0.0f ? t400 : 10.0f;
    float t402 = t360 <= 0.0f ? t401 : 22.0f;
    float t403 = t398 <= t399 ? t402 : 26.0f;
    float t404 = t353 <= 0.0f ? t403 : 30.0f;
    float t405 = t345 <= 0.0f ? t404 : 46.0f;
    float t406 = t230 <= 0.0f ? t405 : 50.0f;
    float t407 = t8 <= t12 ? t406 : 1.0f;
    float t408 = t14 <= 1184.55493f ? t407 : 1.0f;
    float t409 = 399.996002f <= wavelength_nm ? t408 : 1.0f;
    float t410 = wavelength_nm <= 700.007019f ? t409 : 1.0f;
    ray.x_mm = t366;
    ray.y_mm = t367;
    ray.z_mm = t387;
    ray.dx = t392;
    ray.dy = t393;
    ray.dz = t396;
    ray.transmittance = t299;
    ray.stop_x_mm = t378;
    ray.stop_y_mm = t379;
    ray.status = (int)t410;
    return ray;
}

LAIKIN_DOUBLE_GAUSS_50_PART void laikin_double_gauss_50_part_0(
    size_t number,
    float (*LAIKIN_DOUBLE_GAUSS_50_RESTRICT waiting)[128],
    const float *LAIKIN_DOUBLE_GAUSS_50_RESTRICT film_x_mm,
    const float *LAIKIN_DOUBLE_GAUSS_50_RESTRICT film_y_mm,
    const float *LAIKIN_DOUBLE_GAUSS_50_RESTRICT pupil_x_mm,
    const float *LAIKIN_DOUBLE_GAUSS_50_RESTRICT pupil_y_mm,
    const float *LAIKIN_DOUBLE_GAUSS_50_RESTRICT wavelength_nm,
    float film_z_mm)
{
    (void)waiting;
    const float t15 = film_z_mm - (-17.2753983f);
    const float t16 = 108.567169f / t15;
    const float t18 = 1.0f - t16;
    const float t19 = t18 * 0.046411939f;
    const float t21 = t16 * 0.046411939f;
    const float t25 = t16 * (-0.00485492405f);
    const float t27 = LAIKIN_DOUBLE_GAUSS_50_FMA(t18, (-0.00485492405f), 0.0304445289f);
    for (size_t i = 0; i < number; i++) {
        const float t7 = film_y_mm[i] * film_y_mm[i];
        const float t8 = LAIKIN_DOUBLE_GAUSS_50_FMA(film_x_mm[i], film_x_mm[i], t7);
        const float t13 = pupil_y_mm[i] * pupil_y_mm[i];
        const float t14 = LAIKIN_DOUBLE_GAUSS_50_FMA(pupil_x_mm[i], pupil_x_mm[i], t13);
        const float t17 = 689.312378f / wavelength_nm[i];
        const float t20 = pupil_x_mm[i] * t19;
        const float t22 = LAIKIN_DOUBLE_GAUSS_50_FMA(film_x_mm[i], t21, t20);
        const float t23 = pupil_y_mm[i] * t19;
        const float t24 = LAIKIN_DOUBLE_GAUSS_50_FMA(film_y_mm[i], t21, t23);
        const float t26 = film_x_mm[i] * t25;
        const float t28 = LAIKIN_DOUBLE_GAUSS_50_FMA(pupil_x_mm[i], t27, t26);
        const float t29 = film_y_mm[i] * t25;
        const float t30 = LAIKIN_DOUBLE_GAUSS_50_FMA(pupil_y_mm[i], t27, t29);
        const float t31 = t24 * t24;
        const float t32 = LAIKIN_DOUBLE_GAUSS_50_FMA(t22, t22, t31);
        const float t33 = t24 * t30;
        const float t34 = LAIKIN_DOUBLE_GAUSS_50_FMA(t22, t28, t33);
        const float t35 = t30 * t30;
        const float t36 = LAIKIN_DOUBLE_GAUSS_50_FMA(t28, t28, t35);
        const float t37 = LAIKIN_DOUBLE_GAUSS_50_FMA(t17, t17, (-1.969697f));
        const float t38 = LAIKIN_DOUBLE_GAUSS_50_FMA(t32, (-3.20951748f), (-11.8810434f));
        const float t39 = LAIKIN_DOUBLE_GAUSS_50_FMA(t32, 0.00606309716f, (-0.435505629f));
        const float t40 = LAIKIN_DOUBLE_GAUSS_50_FMA(t32, (-1.64955032f), 1.0237422f);
        const float t41 = LAIKIN_DOUBLE_GAUSS_50_FMA(t32, 0.37717396f, 15.0265217f);
        const float t42 = LAIKIN_DOUBLE_GAUSS_50_FMA(t32, (-0.00419616653f), 0.00218099426f);
        const float t43 = LAIKIN_DOUBLE_GAUSS_50_FMA(t32, 0.291584492f, 10.3423262f);
        const float t44 = LAIKIN_DOUBLE_GAUSS_50_FMA(t32, 0.473576605f, (-0.997200906f));
        const float t45 = LAIKIN_DOUBLE_GAUSS_50_FMA(t32, 0.564224243f, (-1.00034797f));
        waiting[0][i] = t8;
        waiting[1][i] = t14;
        waiting[2][i] = t22;
        waiting[3][i] = t24;
        waiting[4][i] = t28;
        waiting[5][i] = t30;
        waiting[6][i] = t32;
        waiting[7][i] = t34;
        waiting[8][i] = t36;
        waiting[9][i] = t37;
        waiting[10][i] = t38;
        waiting[11][i] = t39;
        waiting[12][i] = t40;
        waiting[13][i] = t41;
        waiting[14][i] = t42;
        waiting[15][i] = t43;
        waiting[16][i] = t44;
        waiting[17][i] = t45;
    }
}

LAIKIN_DOUBLE_GAUSS_50_PART void laikin_double_gauss_50_part_1(
    size_t number,
    float (*LAIKIN_DOUBLE_GAUSS_50_RESTRICT waiting)[128])
{
    (void)waiting;
    for (size_t i = 0; i < number; i++) {
        const float t46 = LAIKIN_DOUBLE_GAUSS_50_FMA(waiting[6][i], 0.464114994f, (-1.00017917f));
        const float t47 = LAIKIN_DOUBLE_GAUSS_50_FMA(waiting[6][i], 0.201046586f, (-0.99850291f));
        const float t48 = LAIKIN_DOUBLE_GAUSS_50_FMA(waiting[6][i], 0.226338848f, (-0.998343229f));
        const float t49 = waiting[6][i] * waiting[6][i];
        const float t50 = LAIKIN_DOUBLE_GAUSS_50_FMA(t49, (-0.43374306f), waiting[10][i]);
        const float t51 = LAIKIN_DOUBLE_GAUSS_50_FMA(t49, (-0.000381737103f), waiting[11][i]);
        const float t52 = LAIKIN_DOUBLE_GAUSS_50_FMA(t49, (-0.501358449f), waiting[12][i]);
        const float t53 = LAIKIN_DOUBLE_GAUSS_50_FMA(t49, 0.0369910188f, waiting[13][i]);
        const float t54 = LAIKIN_DOUBLE_GAUSS_50_FMA(t49, 0.00252348976f, waiting[14][i]);
        const float t55 = LAIKIN_DOUBLE_GAUSS_50_FMA(t49, (-0.00119420351f), 0.499428213f);
        const float t56 = LAIKIN_DOUBLE_GAUSS_50_FMA(t49, 0.011821242f, waiting[16][i]);
        const float t57 = LAIKIN_DOUBLE_GAUSS_50_FMA(t49, (-0.0906037763f), waiting[17][i]);
        const float t58 = LAIKIN_DOUBLE_GAUSS_50_FMA(t49, (-0.170106962f), t46);
        const float t59 = LAIKIN_DOUBLE_GAUSS_50_FMA(t49, 0.172341689f, t47);
        const float t60 = LAIKIN_DOUBLE_GAUSS_50_FMA(t49, 0.219247103f, t48);
        const float t61 = t49 * waiting[6][i];
        const float t62 = LAIKIN_DOUBLE_GAUSS_50_FMA(t61, 0.00119546673f, t50);
        const float t63 = LAIKIN_DOUBLE_GAUSS_50_FMA(t61, 0.000146020684f, t51);
        const float t64 = LAIKIN_DOUBLE_GAUSS_50_FMA(t61, (-0.00647292286f), t53);
        const float t65 = LAIKIN_DOUBLE_GAUSS_50_FMA(t61, (-0.000247066637f), t54);
        const float t66 = LAIKIN_DOUBLE_GAUSS_50_FMA(t61, 0.0549243428f, t59);
        const float t67 = t61 * waiting[6][i];
        const float t68 = LAIKIN_DOUBLE_GAUSS_50_FMA(t67, 0.00417835824f, t62);
        const float t69 = LAIKIN_DOUBLE_GAUSS_50_FMA(t67, (-4.33599344e-05f), t63);
        const float t70 = LAIKIN_DOUBLE_GAUSS_50_FMA(t67, (-0.11120034f), t52);
        const float t71 = LAIKIN_DOUBLE_GAUSS_50_FMA(t67, 0.0314424373f, t64);
        const float t72 = LAIKIN_DOUBLE_GAUSS_50_FMA(t67, 0.000578365929f, t65);
        const float t73 = LAIKIN_DOUBLE_GAUSS_50_FMA(t67, 0.0307136811f, waiting[15][i]);
        waiting[17][i] = t55;
        waiting[16][i] = t56;
        waiting[15][i] = t57;
        waiting[14][i] = t58;
        waiting[13][i] = t60;
        waiting[12][i] = t66;
        waiting[11][i] = t67;
        waiting[10][i] = t68;
        waiting[18][i] = t69;
        waiting[19][i] = t70;
        waiting[20][i] = t71;
        waiting[21][i] = t72;
        waiting[22][i] = t73;
    }
}

LAIKIN_DOUBLE_GAUSS_50_PART void laikin_double_gauss_50_part_2(
    size_t number,
    float (*LAIKIN_DOUBLE_GAUSS_50_RESTRICT waiting)[128])
{
    (void)waiting;
    for (size_t i = 0; i < number; i++) {
        const float t74 = LAIKIN_DOUBLE_GAUSS_50_FMA(waiting[11][i], 0.0652175024f, waiting[13][i]);
        const float t75 = LAIKIN_DOUBLE_GAUSS_50_FMA(waiting[7][i], (-1.21882808f), waiting[10][i]);
        const float t76 = LAIKIN_DOUBLE_GAUSS_50_FMA(waiting[7][i], 0.00309305219f, waiting[18][i]);
        const float t77 = LAIKIN_DOUBLE_GAUSS_50_FMA(waiting[7][i], 0.523116052f, waiting[19][i]);
        const float t78 = LAIKIN_DOUBLE_GAUSS_50_FMA(waiting[7][i], 0.842702925f, waiting[20][i]);
        const float t79 = LAIKIN_DOUBLE_GAUSS_50_FMA(waiting[7][i], (-0.000764448778f), waiting[21][i]);
        const float t80 = LAIKIN_DOUBLE_GAUSS_50_FMA(waiting[7][i], 0.435077339f, waiting[22][i]);
        const float t81 = LAIKIN_DOUBLE_GAUSS_50_FMA(waiting[7][i], 0.72624898f, waiting[16][i]);
        const float t82 = LAIKIN_DOUBLE_GAUSS_50_FMA(waiting[7][i], 0.866684556f, waiting[15][i]);
        const float t83 = LAIKIN_DOUBLE_GAUSS_50_FMA(waiting[7][i], 1.24958813f, waiting[14][i]);
        const float t84 = LAIKIN_DOUBLE_GAUSS_50_FMA(waiting[7][i], (-0.875239074f), waiting[12][i]);
        const float t85 = LAIKIN_DOUBLE_GAUSS_50_FMA(waiting[7][i], (-0.691227198f), t74);
        const float t86 = waiting[7][i] * waiting[7][i];
        const float t87 = LAIKIN_DOUBLE_GAUSS_50_FMA(t86, (-0.133955553f), t75);
        const float t88 = LAIKIN_DOUBLE_GAUSS_50_FMA(t86, 0.00171046564f, t76);
        const float t89 = LAIKIN_DOUBLE_GAUSS_50_FMA(t86, 0.0488928668f, t78);
        const float t90 = LAIKIN_DOUBLE_GAUSS_50_FMA(t86, (-0.00203704042f), t79);
        const float t91 = LAIKIN_DOUBLE_GAUSS_50_FMA(t86, 0.252218038f, t80);
        const float t92 = LAIKIN_DOUBLE_GAUSS_50_FMA(t86, 0.0101626152f, waiting[17][i]);
        const float t93 = LAIKIN_DOUBLE_GAUSS_50_FMA(t86, (-0.00948883407f), t81);
        const float t94 = LAIKIN_DOUBLE_GAUSS_50_FMA(t86, (-0.0435878038f), t82);
        const float t95 = LAIKIN_DOUBLE_GAUSS_50_FMA(t86, (-0.301171005f), t83);
        const float t96 = LAIKIN_DOUBLE_GAUSS_50_FMA(t86, (-0.259712219f), t84);
        const float t97 = t86 * waiting[7][i];
        const float t98 = LAIKIN_DOUBLE_GAUSS_50_FMA(t97, (-0.0361824632f), t87);
        const float t99 = LAIKIN_DOUBLE_GAUSS_50_FMA(t97, 0.000110112473f, t88);
        const float t100 = LAIKIN_DOUBLE_GAUSS_50_FMA(t97, 0.0397712588f, t89);
        const float t101 = LAIKIN_DOUBLE_GAUSS_50_FMA(t97, 0.000559700595f, t90);
        waiting[22][i] = t77;
        waiting[21][i] = t85;
        waiting[20][i] = t86;
        waiting[19][i] = t91;
        waiting[18][i] = t92;
        waiting[10][i] = t93;
        waiting[11][i] = t94;
        waiting[12][i] = t95;
        waiting[13][i] = t96;
        waiting[14][i] = t97;
        waiting[15][i] = t98;
        waiting[16][i] = t99;
        waiting[17][i] = t100;
        waiting[23][i] = t101;
    }
}

LAIKIN_DOUBLE_GAUSS_50_PART void laikin_double_gauss_50_part_3(
    size_t number,
    float (*LAIKIN_DOUBLE_GAUSS_50_RESTRICT waiting)[128])
{
    (void)waiting;
    for (size_t i = 0; i < number; i++) {
        const float t102 = LAIKIN_DOUBLE_GAUSS_50_FMA(waiting[14][i], 0.0375992917f, waiting[19][i]);
        const float t103 = LAIKIN_DOUBLE_GAUSS_50_FMA(waiting[14][i], 0.0403505862f, waiting[12][i]);
        const float t104 = LAIKIN_DOUBLE_GAUSS_50_FMA(waiting[14][i], (-0.0661599338f), waiting[13][i]);
        const float t105 = waiting[14][i] * waiting[7][i];
        const float t106 = LAIKIN_DOUBLE_GAUSS_50_FMA(t105, 0.00784042943f, waiting[15][i]);
        const float t107 = LAIKIN_DOUBLE_GAUSS_50_FMA(t105, (-0.000303521927f), waiting[16][i]);
        const float t108 = LAIKIN_DOUBLE_GAUSS_50_FMA(t105, (-0.0109335147f), waiting[17][i]);
        const float t109 = LAIKIN_DOUBLE_GAUSS_50_FMA(t105, (-0.000267288968f), waiting[23][i]);
        const float t110 = waiting[14][i] * waiting[6][i];
        const float t111 = LAIKIN_DOUBLE_GAUSS_50_FMA(t110, 0.0388633162f, t106);
        const float t112 = LAIKIN_DOUBLE_GAUSS_50_FMA(t110, 0.000440667907f, t107);
        const float t113 = LAIKIN_DOUBLE_GAUSS_50_FMA(t110, (-0.0390472151f), t108);
        const float t114 = LAIKIN_DOUBLE_GAUSS_50_FMA(t110, (-0.000937657722f), t109);
        const float t115 = waiting[20][i] * waiting[6][i];
        const float t116 = LAIKIN_DOUBLE_GAUSS_50_FMA(t115, (-0.152131543f), t111);
        const float t117 = LAIKIN_DOUBLE_GAUSS_50_FMA(t115, (-0.00129711768f), t112);
        const float t118 = LAIKIN_DOUBLE_GAUSS_50_FMA(t115, (-0.114989981f), waiting[22][i]);
        const float t119 = LAIKIN_DOUBLE_GAUSS_50_FMA(t115, (-0.124441892f), t113);
        const float t120 = LAIKIN_DOUBLE_GAUSS_50_FMA(t115, (-0.00313371234f), t114);
        const float t121 = LAIKIN_DOUBLE_GAUSS_50_FMA(t115, 0.108795807f, t103);
        const float t122 = LAIKIN_DOUBLE_GAUSS_50_FMA(t115, (-0.0991413072f), t104);
        const float t123 = t115 * waiting[6][i];
        const float t124 = LAIKIN_DOUBLE_GAUSS_50_FMA(t123, 0.175181657f, t116);
        const float t125 = LAIKIN_DOUBLE_GAUSS_50_FMA(t123, 0.00324938376f, t117);
        const float t126 = LAIKIN_DOUBLE_GAUSS_50_FMA(t123, 0.0576481447f, t119);
        const float t127 = LAIKIN_DOUBLE_GAUSS_50_FMA(t123, 0.000192379026f, t120);
        const float t128 = LAIKIN_DOUBLE_GAUSS_50_FMA(t123, 0.0141451368f, waiting[21][i]);
        const float t129 = waiting[7][i] * waiting[6][i];
        waiting[23][i] = t102;
        waiting[17][i] = t118;
        waiting[16][i] = t121;
        waiting[15][i] = t122;
        waiting[14][i] = t124;
        waiting[13][i] = t125;
        waiting[12][i] = t126;
        waiting[19][i] = t127;
        waiting[20][i] = t128;
        waiting[21][i] = t129;
    }
}

LAIKIN_DOUBLE_GAUSS_50_PART void laikin_double_gauss_50_part_4(
    size_t number,
    float (*LAIKIN_DOUBLE_GAUSS_50_RESTRICT waiting)[128])
{
    (void)waiting;
    for (size_t i = 0; i < number; i++) {
        const float t130 = LAIKIN_DOUBLE_GAUSS_50_FMA(waiting[21][i], (-0.722762346f), waiting[14][i]);
        const float t131 = LAIKIN_DOUBLE_GAUSS_50_FMA(waiting[21][i], (-0.00139075692f), waiting[13][i]);
        const float t132 = LAIKIN_DOUBLE_GAUSS_50_FMA(waiting[21][i], 0.174151748f, waiting[17][i]);
        const float t133 = LAIKIN_DOUBLE_GAUSS_50_FMA(waiting[21][i], (-0.129708171f), waiting[12][i]);
        const float t134 = LAIKIN_DOUBLE_GAUSS_50_FMA(waiting[21][i], (-0.00278562377f), waiting[19][i]);
        const float t135 = LAIKIN_DOUBLE_GAUSS_50_FMA(waiting[21][i], (-0.179667592f), waiting[11][i]);
        const float t136 = LAIKIN_DOUBLE_GAUSS_50_FMA(waiting[21][i], (-0.54467088f), waiting[16][i]);
        const float t137 = LAIKIN_DOUBLE_GAUSS_50_FMA(waiting[21][i], (-0.278922021f), waiting[15][i]);
        const float t138 = LAIKIN_DOUBLE_GAUSS_50_FMA(waiting[21][i], (-0.317790478f), waiting[20][i]);
        const float t139 = waiting[21][i] * waiting[6][i];
        const float t140 = LAIKIN_DOUBLE_GAUSS_50_FMA(t139, (-0.0706497878f), t130);
        const float t141 = LAIKIN_DOUBLE_GAUSS_50_FMA(t139, 0.000311404001f, t131);
        const float t142 = LAIKIN_DOUBLE_GAUSS_50_FMA(t139, (-0.0572534055f), t133);
        const float t143 = LAIKIN_DOUBLE_GAUSS_50_FMA(t139, (-0.00181781279f), t134);
        const float t144 = LAIKIN_DOUBLE_GAUSS_50_FMA(t139, 0.0918659121f, t136);
        const float t145 = t139 * waiting[6][i];
        const float t146 = LAIKIN_DOUBLE_GAUSS_50_FMA(t145, 0.0168556254f, t140);
        const float t147 = LAIKIN_DOUBLE_GAUSS_50_FMA(t145, (-2.14918728e-05f), t141);
        const float t148 = LAIKIN_DOUBLE_GAUSS_50_FMA(t145, 0.116741747f, t132);
        const float t149 = LAIKIN_DOUBLE_GAUSS_50_FMA(t145, (-0.000346085115f), t142);
        const float t150 = LAIKIN_DOUBLE_GAUSS_50_FMA(t145, 0.000590096693f, t143);
        const float t151 = LAIKIN_DOUBLE_GAUSS_50_FMA(t145, (-0.0269088801f), waiting[23][i]);
        const float t152 = LAIKIN_DOUBLE_GAUSS_50_FMA(t145, 0.0721038654f, t137);
        const float t153 = LAIKIN_DOUBLE_GAUSS_50_FMA(t145, (-0.0772682503f), t138);
        const float t154 = LAIKIN_DOUBLE_GAUSS_50_FMA(waiting[8][i], 1.67363429f, t146);
        const float t155 = LAIKIN_DOUBLE_GAUSS_50_FMA(waiting[8][i], (-0.00042150286f), t147);
        const float t156 = LAIKIN_DOUBLE_GAUSS_50_FMA(waiting[8][i], (-0.831731081f), t149);
        const float t157 = LAIKIN_DOUBLE_GAUSS_50_FMA(waiting[8][i], (-0.00448373426f), t150);
        waiting[21][i] = t135;
        waiting[20][i] = t144;
        waiting[19][i] = t148;
        waiting[12][i] = t151;
        waiting[13][i] = t152;
        waiting[14][i] = t153;
        waiting[15][i] = t154;
        waiting[16][i] = t155;
        waiting[17][i] = t156;
        waiting[23][i] = t157;
    }
}

LAIKIN_DOUBLE_GAUSS_50_PART void laikin_double_gauss_50_part_5(
    size_t number,
    float (*LAIKIN_DOUBLE_GAUSS_50_RESTRICT waiting)[128])
{
    (void)waiting;
    for (size_t i = 0; i < number; i++) {
        const float t158 = LAIKIN_DOUBLE_GAUSS_50_FMA(waiting[8][i], (-0.594571173f), waiting[12][i]);
        const float t159 = LAIKIN_DOUBLE_GAUSS_50_FMA(waiting[8][i], 0.261655241f, waiting[10][i]);
        const float t160 = LAIKIN_DOUBLE_GAUSS_50_FMA(waiting[8][i], 0.331985801f, waiting[21][i]);
        const float t161 = LAIKIN_DOUBLE_GAUSS_50_FMA(waiting[8][i], 0.801681459f, waiting[20][i]);
        const float t162 = LAIKIN_DOUBLE_GAUSS_50_FMA(waiting[8][i], 0.958400428f, waiting[13][i]);
        const float t163 = LAIKIN_DOUBLE_GAUSS_50_FMA(waiting[8][i], 0.500986457f, waiting[14][i]);
        const float t164 = waiting[8][i] * waiting[8][i];
        const float t165 = LAIKIN_DOUBLE_GAUSS_50_FMA(t164, 0.00386060611f, waiting[15][i]);
        const float t166 = LAIKIN_DOUBLE_GAUSS_50_FMA(t164, 0.000208850382f, waiting[16][i]);
        const float t167 = LAIKIN_DOUBLE_GAUSS_50_FMA(t164, 0.0296211764f, waiting[19][i]);
        const float t168 = LAIKIN_DOUBLE_GAUSS_50_FMA(t164, 0.138861924f, waiting[17][i]);
        const float t169 = LAIKIN_DOUBLE_GAUSS_50_FMA(t164, 0.00245518913f, waiting[23][i]);
        const float t170 = LAIKIN_DOUBLE_GAUSS_50_FMA(t164, (-0.00240240153f), waiting[18][i]);
        const float t171 = LAIKIN_DOUBLE_GAUSS_50_FMA(t164, 0.0179659761f, t160);
        const float t172 = LAIKIN_DOUBLE_GAUSS_50_FMA(t164, (-0.0510863923f), t161);
        const float t173 = LAIKIN_DOUBLE_GAUSS_50_FMA(t164, (-0.146117568f), t162);
        const float t174 = LAIKIN_DOUBLE_GAUSS_50_FMA(t164, (-0.0153010897f), t163);
        const float t175 = t164 * waiting[8][i];
        const float t176 = LAIKIN_DOUBLE_GAUSS_50_FMA(t175, (-0.00532061979f), t165);
        const float t177 = LAIKIN_DOUBLE_GAUSS_50_FMA(t175, (-0.000238849709f), t166);
        const float t178 = LAIKIN_DOUBLE_GAUSS_50_FMA(t175, (-0.0301461723f), t168);
        const float t179 = LAIKIN_DOUBLE_GAUSS_50_FMA(t175, (-0.00034005678f), t169);
        const float t180 = t175 * waiting[8][i];
        const float t181 = LAIKIN_DOUBLE_GAUSS_50_FMA(t180, 0.00751193007f, t176);
        const float t182 = LAIKIN_DOUBLE_GAUSS_50_FMA(t180, 2.96563758e-06f, t177);
        const float t183 = LAIKIN_DOUBLE_GAUSS_50_FMA(t180, 0.00524842413f, t178);
        const float t184 = LAIKIN_DOUBLE_GAUSS_50_FMA(t180, 0.000164817786f, t179);
        const float t185 = t175 * waiting[7][i];
        waiting[23][i] = t158;
        waiting[17][i] = t159;
        waiting[16][i] = t164;
        waiting[15][i] = t167;
        waiting[14][i] = t170;
        waiting[13][i] = t171;
        waiting[12][i] = t172;
        waiting[19][i] = t173;
        waiting[20][i] = t174;
        waiting[21][i] = t175;
        waiting[10][i] = t181;
        waiting[18][i] = t182;
        waiting[11][i] = t183;
        waiting[22][i] = t184;
        waiting[24][i] = t185;
    }
}

LAIKIN_DOUBLE_GAUSS_50_PART void laikin_double_gauss_50_part_6(
    size_t number,
    float (*LAIKIN_DOUBLE_GAUSS_50_RESTRICT waiting)[128])
{
    (void)waiting;
    for (size_t i = 0; i < number; i++) {
        const float t186 = LAIKIN_DOUBLE_GAUSS_50_FMA(waiting[24][i], 0.0183279235f, waiting[10][i]);
        const float t187 = LAIKIN_DOUBLE_GAUSS_50_FMA(waiting[24][i], 4.69362458e-05f, waiting[18][i]);
        const float t188 = LAIKIN_DOUBLE_GAUSS_50_FMA(waiting[24][i], (-0.0089979507f), waiting[11][i]);
        const float t189 = LAIKIN_DOUBLE_GAUSS_50_FMA(waiting[24][i], (-0.000315923506f), waiting[22][i]);
        const float t190 = waiting[21][i] * waiting[6][i];
        const float t191 = LAIKIN_DOUBLE_GAUSS_50_FMA(t190, 0.0106029082f, t186);
        const float t192 = LAIKIN_DOUBLE_GAUSS_50_FMA(t190, (-8.86869457e-05f), t187);
        const float t193 = LAIKIN_DOUBLE_GAUSS_50_FMA(t190, 0.00247916719f, t188);
        const float t194 = LAIKIN_DOUBLE_GAUSS_50_FMA(t190, 0.000300292653f, t189);
        const float t195 = waiting[16][i] * waiting[7][i];
        const float t196 = LAIKIN_DOUBLE_GAUSS_50_FMA(t195, 0.0406259224f, t191);
        const float t197 = LAIKIN_DOUBLE_GAUSS_50_FMA(t195, 0.000771674851f, t192);
        const float t198 = LAIKIN_DOUBLE_GAUSS_50_FMA(t195, 0.0338593833f, t193);
        const float t199 = LAIKIN_DOUBLE_GAUSS_50_FMA(t195, (-0.000538300199f), t194);
        const float t200 = LAIKIN_DOUBLE_GAUSS_50_FMA(t195, (-0.0863832608f), waiting[19][i]);
        const float t201 = t195 * waiting[7][i];
        const float t202 = LAIKIN_DOUBLE_GAUSS_50_FMA(t201, 0.0314683989f, t196);
        const float t203 = LAIKIN_DOUBLE_GAUSS_50_FMA(t201, 0.0012483031f, t197);
        const float t204 = LAIKIN_DOUBLE_GAUSS_50_FMA(t201, 0.0348736271f, t198);
        const float t205 = LAIKIN_DOUBLE_GAUSS_50_FMA(t201, 0.000582819339f, t199);
        const float t206 = t195 * waiting[6][i];
        const float t207 = LAIKIN_DOUBLE_GAUSS_50_FMA(t206, (-0.0705774352f), t202);
        const float t208 = LAIKIN_DOUBLE_GAUSS_50_FMA(t206, (-0.000965462183f), t203);
        const float t209 = LAIKIN_DOUBLE_GAUSS_50_FMA(t206, (-0.0398003869f), t204);
        const float t210 = LAIKIN_DOUBLE_GAUSS_50_FMA(t206, (-0.000613221957f), t205);
        const float t211 = waiting[16][i] * waiting[6][i];
        const float t212 = LAIKIN_DOUBLE_GAUSS_50_FMA(t211, 0.00692391908f, t207);
        const float t213 = LAIKIN_DOUBLE_GAUSS_50_FMA(t211, (-9.30089591e-05f), t208);
        waiting[24][i] = t200;
        waiting[22][i] = t209;
        waiting[11][i] = t210;
        waiting[18][i] = t211;
        waiting[10][i] = t212;
        waiting[21][i] = t213;
    }
}

LAIKIN_DOUBLE_GAUSS_50_PART void laikin_double_gauss_50_part_7(
    size_t number,
    float (*LAIKIN_DOUBLE_GAUSS_50_RESTRICT waiting)[128])
{
    (void)waiting;
    for (size_t i = 0; i < number; i++) {
        const float t214 = LAIKIN_DOUBLE_GAUSS_50_FMA(waiting[18][i], 0.0117554553f, waiting[22][i]);
        const float t215 = LAIKIN_DOUBLE_GAUSS_50_FMA(waiting[18][i], 0.000465244433f, waiting[11][i]);
        const float t216 = LAIKIN_DOUBLE_GAUSS_50_FMA(waiting[18][i], 0.0310129598f, waiting[24][i]);
        const float t217 = waiting[18][i] * waiting[6][i];
        const float t218 = LAIKIN_DOUBLE_GAUSS_50_FMA(t217, (-0.0115503967f), waiting[10][i]);
        const float t219 = LAIKIN_DOUBLE_GAUSS_50_FMA(t217, (-0.000544462877f), waiting[21][i]);
        const float t220 = LAIKIN_DOUBLE_GAUSS_50_FMA(t217, 0.0111388303f, t214);
        const float t221 = LAIKIN_DOUBLE_GAUSS_50_FMA(t217, 0.000787234283f, t215);
        const float t222 = LAIKIN_DOUBLE_GAUSS_50_FMA(t217, 0.00632320996f, waiting[20][i]);
        const float t223 = waiting[8][i] * waiting[7][i];
        const float t224 = LAIKIN_DOUBLE_GAUSS_50_FMA(t223, 0.114864767f, t218);
        const float t225 = LAIKIN_DOUBLE_GAUSS_50_FMA(t223, (-0.00268741697f), t219);
        const float t226 = LAIKIN_DOUBLE_GAUSS_50_FMA(t223, (-0.149958178f), waiting[15][i]);
        const float t227 = LAIKIN_DOUBLE_GAUSS_50_FMA(t223, (-0.201842636f), t220);
        const float t228 = LAIKIN_DOUBLE_GAUSS_50_FMA(t223, 6.23516607e-05f, t221);
        const float t229 = LAIKIN_DOUBLE_GAUSS_50_FMA(t223, (-0.167351291f), waiting[23][i]);
        const float t230 = LAIKIN_DOUBLE_GAUSS_50_FMA(t223, (-0.0261443686f), waiting[17][i]);
        const float t231 = LAIKIN_DOUBLE_GAUSS_50_FMA(t223, 0.0275130067f, waiting[13][i]);
        const float t232 = LAIKIN_DOUBLE_GAUSS_50_FMA(t223, (-0.197268203f), waiting[12][i]);
        const float t233 = LAIKIN_DOUBLE_GAUSS_50_FMA(t223, 0.522659004f, t216);
        const float t234 = LAIKIN_DOUBLE_GAUSS_50_FMA(t223, 0.0745443255f, t222);
        const float t235 = t223 * waiting[7][i];
        const float t236 = LAIKIN_DOUBLE_GAUSS_50_FMA(t235, (-0.0967399627f), t224);
        const float t237 = LAIKIN_DOUBLE_GAUSS_50_FMA(t235, (-8.06444732e-05f), t225);
        const float t238 = LAIKIN_DOUBLE_GAUSS_50_FMA(t235, 0.0291367937f, t227);
        const float t239 = LAIKIN_DOUBLE_GAUSS_50_FMA(t235, 0.000223580384f, t228);
        const float t240 = LAIKIN_DOUBLE_GAUSS_50_FMA(t235, 0.118954949f, t233);
        const float t241 = t235 * waiting[7][i];
        waiting[21][i] = t223;
        waiting[10][i] = t226;
        waiting[18][i] = t229;
        waiting[11][i] = t230;
        waiting[22][i] = t231;
        waiting[24][i] = t232;
        waiting[20][i] = t234;
        waiting[12][i] = t235;
        waiting[13][i] = t236;
        waiting[15][i] = t237;
        waiting[17][i] = t238;
        waiting[23][i] = t239;
        waiting[19][i] = t240;
        waiting[16][i] = t241;
    }
}

LAIKIN_DOUBLE_GAUSS_50_PART void laikin_double_gauss_50_part_8(
    size_t number,
    float (*LAIKIN_DOUBLE_GAUSS_50_RESTRICT waiting)[128])
{
    (void)waiting;
    for (size_t i = 0; i < number; i++) {
        const float t242 = LAIKIN_DOUBLE_GAUSS_50_FMA(waiting[16][i], (-0.120642886f), waiting[13][i]);
        const float t243 = LAIKIN_DOUBLE_GAUSS_50_FMA(waiting[16][i], (-0.000873303332f), waiting[15][i]);
        const float t244 = LAIKIN_DOUBLE_GAUSS_50_FMA(waiting[16][i], (-0.0143971825f), waiting[17][i]);
        const float t245 = LAIKIN_DOUBLE_GAUSS_50_FMA(waiting[16][i], 0.00102274923f, waiting[23][i]);
        const float t246 = waiting[12][i] * waiting[6][i];
        const float t247 = LAIKIN_DOUBLE_GAUSS_50_FMA(t246, (-0.142935291f), t242);
        const float t248 = LAIKIN_DOUBLE_GAUSS_50_FMA(t246, (-0.000747709011f), t243);
        const float t249 = LAIKIN_DOUBLE_GAUSS_50_FMA(t246, (-0.0731592104f), t244);
        const float t250 = LAIKIN_DOUBLE_GAUSS_50_FMA(t246, (-0.0013175942f), t245);
        const float t251 = waiting[21][i] * waiting[6][i];
        const float t252 = LAIKIN_DOUBLE_GAUSS_50_FMA(t251, (-0.199969113f), t247);
        const float t253 = LAIKIN_DOUBLE_GAUSS_50_FMA(t251, (-0.0017519152f), t248);
        const float t254 = LAIKIN_DOUBLE_GAUSS_50_FMA(t251, (-0.0370913818f), t249);
        const float t255 = LAIKIN_DOUBLE_GAUSS_50_FMA(t251, 0.000448058243f, t250);
        const float t256 = LAIKIN_DOUBLE_GAUSS_50_FMA(t251, 0.0609861203f, waiting[24][i]);
        const float t257 = t251 * waiting[6][i];
        const float t258 = LAIKIN_DOUBLE_GAUSS_50_FMA(t257, (-0.0264435858f), t252);
        const float t259 = LAIKIN_DOUBLE_GAUSS_50_FMA(t257, (-0.000515072723f), t253);
        const float t260 = LAIKIN_DOUBLE_GAUSS_50_FMA(t257, (-0.0841266736f), t254);
        const float t261 = LAIKIN_DOUBLE_GAUSS_50_FMA(t257, (-0.00250904774f), t255);
        const float t262 = waiting[8][i] * waiting[6][i];
        const float t263 = LAIKIN_DOUBLE_GAUSS_50_FMA(t262, 0.118226647f, t258);
        const float t264 = LAIKIN_DOUBLE_GAUSS_50_FMA(t262, (-0.001126352f), t259);
        const float t265 = LAIKIN_DOUBLE_GAUSS_50_FMA(t262, 0.0872766376f, waiting[10][i]);
        const float t266 = LAIKIN_DOUBLE_GAUSS_50_FMA(t262, 0.0725111663f, t260);
        const float t267 = LAIKIN_DOUBLE_GAUSS_50_FMA(t262, 0.00492677279f, t261);
        const float t268 = LAIKIN_DOUBLE_GAUSS_50_FMA(t262, (-0.0712044612f), waiting[18][i]);
        waiting[16][i] = t256;
        waiting[23][i] = t262;
        waiting[17][i] = t263;
        waiting[15][i] = t264;
        waiting[13][i] = t265;
        waiting[12][i] = t266;
        waiting[24][i] = t267;
        waiting[18][i] = t268;
    }
}

LAIKIN_DOUBLE_GAUSS_50_PART void laikin_double_gauss_50_part_9(
    size_t number,
    float (*LAIKIN_DOUBLE_GAUSS_50_RESTRICT waiting)[128])
{
    (void)waiting;
    for (size_t i = 0; i < number; i++) {
        const float t269 = LAIKIN_DOUBLE_GAUSS_50_FMA(waiting[23][i], (-0.00897908863f), waiting[14][i]);
        const float t270 = LAIKIN_DOUBLE_GAUSS_50_FMA(waiting[23][i], (-0.030234497f), waiting[22][i]);
        const float t271 = LAIKIN_DOUBLE_GAUSS_50_FMA(waiting[23][i], (-0.147897586f), waiting[16][i]);
        const float t272 = LAIKIN_DOUBLE_GAUSS_50_FMA(waiting[23][i], (-0.13855733f), waiting[19][i]);
        const float t273 = waiting[23][i] * waiting[6][i];
        const float t274 = LAIKIN_DOUBLE_GAUSS_50_FMA(t273, (-0.072908245f), waiting[17][i]);
        const float t275 = LAIKIN_DOUBLE_GAUSS_50_FMA(t273, (-0.00124189584f), waiting[15][i]);
        const float t276 = LAIKIN_DOUBLE_GAUSS_50_FMA(t273, (-0.0295316875f), waiting[12][i]);
        const float t277 = LAIKIN_DOUBLE_GAUSS_50_FMA(t273, (-0.000315433979f), waiting[24][i]);
        const float t278 = LAIKIN_DOUBLE_GAUSS_50_FMA(t273, 0.028885128f, t271);
        const float t279 = LAIKIN_DOUBLE_GAUSS_50_FMA(t273, (-0.0727278292f), t272);
        const float t280 = t273 * waiting[6][i];
        const float t281 = LAIKIN_DOUBLE_GAUSS_50_FMA(t280, 0.0345795192f, t274);
        const float t282 = LAIKIN_DOUBLE_GAUSS_50_FMA(t280, 0.000451443717f, t275);
        const float t283 = LAIKIN_DOUBLE_GAUSS_50_FMA(t280, 0.0503739156f, t276);
        const float t284 = LAIKIN_DOUBLE_GAUSS_50_FMA(t280, 0.000747553597f, t277);
        const float t285 = LAIKIN_DOUBLE_GAUSS_50_FMA(waiting[9][i], (-0.198282063f), t281);
        const float t286 = LAIKIN_DOUBLE_GAUSS_50_FMA(waiting[9][i], (-0.000189588376f), t282);
        const float t287 = LAIKIN_DOUBLE_GAUSS_50_FMA(waiting[9][i], (-0.0961630419f), waiting[13][i]);
        const float t288 = LAIKIN_DOUBLE_GAUSS_50_FMA(waiting[9][i], 0.017893644f, t283);
        const float t289 = LAIKIN_DOUBLE_GAUSS_50_FMA(waiting[9][i], 0.000786604185f, t284);
        const float t290 = LAIKIN_DOUBLE_GAUSS_50_FMA(waiting[9][i], (-0.0649207532f), waiting[18][i]);
        const float t291 = LAIKIN_DOUBLE_GAUSS_50_FMA(waiting[9][i], (-0.0132562993f), t269);
        const float t292 = waiting[9][i] * waiting[9][i];
        const float t293 = LAIKIN_DOUBLE_GAUSS_50_FMA(t292, 0.0345843025f, t285);
        const float t294 = LAIKIN_DOUBLE_GAUSS_50_FMA(t292, 0.000463770004f, t286);
        const float t295 = LAIKIN_DOUBLE_GAUSS_50_FMA(t292, 0.0118425116f, t287);
        waiting[18][i] = t270;
        waiting[24][i] = t278;
        waiting[12][i] = t279;
        waiting[13][i] = t288;
        waiting[15][i] = t289;
        waiting[17][i] = t290;
        waiting[23][i] = t291;
        waiting[16][i] = t292;
        waiting[19][i] = t293;
        waiting[22][i] = t294;
        waiting[14][i] = t295;
    }
}

LAIKIN_DOUBLE_GAUSS_50_PART void laikin_double_gauss_50_part_10(
    size_t number,
    float (*LAIKIN_DOUBLE_GAUSS_50_RESTRICT waiting)[128],
    float *LAIKIN_DOUBLE_GAUSS_50_RESTRICT transmittance)
{
    (void)waiting;
    for (size_t i = 0; i < number; i++) {
        const float t296 = LAIKIN_DOUBLE_GAUSS_50_FMA(waiting[16][i], 0.0495838523f, waiting[13][i]);
        const float t297 = LAIKIN_DOUBLE_GAUSS_50_FMA(waiting[16][i], 0.00107831066f, waiting[15][i]);
        const float t298 = LAIKIN_DOUBLE_GAUSS_50_FMA(waiting[16][i], 0.0130494609f, waiting[17][i]);
        const float t299 = LAIKIN_DOUBLE_GAUSS_50_FMA(waiting[16][i], (-0.000358579942f), waiting[23][i]);
        const float t300 = LAIKIN_DOUBLE_GAUSS_50_FMA(waiting[16][i], 0.00127123506f, waiting[12][i]);
        const float t301 = LAIKIN_DOUBLE_GAUSS_50_FMA(waiting[16][i], 0.00112162938f, waiting[20][i]);
        const float t302 = waiting[9][i] * waiting[8][i];
        const float t303 = LAIKIN_DOUBLE_GAUSS_50_FMA(t302, 0.0273474343f, waiting[19][i]);
        const float t304 = LAIKIN_DOUBLE_GAUSS_50_FMA(t302, 0.000362543971f, waiting[22][i]);
        const float t305 = LAIKIN_DOUBLE_GAUSS_50_FMA(t302, 0.0188527014f, waiting[14][i]);
        const float t306 = LAIKIN_DOUBLE_GAUSS_50_FMA(t302, 0.0122348182f, t296);
        const float t307 = LAIKIN_DOUBLE_GAUSS_50_FMA(t302, 0.00020399662f, t297);
        const float t308 = LAIKIN_DOUBLE_GAUSS_50_FMA(t302, 0.0139316935f, t298);
        const float t309 = LAIKIN_DOUBLE_GAUSS_50_FMA(t302, (-0.0109953312f), waiting[24][i]);
        const float t310 = LAIKIN_DOUBLE_GAUSS_50_FMA(t302, (-0.00609509926f), t300);
        const float t311 = t302 * waiting[8][i];
        const float t312 = LAIKIN_DOUBLE_GAUSS_50_FMA(t311, 0.00945193507f, t303);
        const float t313 = LAIKIN_DOUBLE_GAUSS_50_FMA(t311, 0.000104772269f, t304);
        const float t314 = LAIKIN_DOUBLE_GAUSS_50_FMA(t311, 0.00757747097f, t306);
        const float t315 = LAIKIN_DOUBLE_GAUSS_50_FMA(t311, 0.000155817354f, t307);
        const float t316 = t302 * waiting[7][i];
        const float t317 = LAIKIN_DOUBLE_GAUSS_50_FMA(t316, 0.0280287247f, t312);
        const float t318 = LAIKIN_DOUBLE_GAUSS_50_FMA(t316, 0.000257835316f, t313);
        const float t319 = LAIKIN_DOUBLE_GAUSS_50_FMA(t316, 0.0225197934f, t314);
        const float t320 = LAIKIN_DOUBLE_GAUSS_50_FMA(t316, 0.000534885621f, t315);
        const float t321 = t302 * waiting[6][i];
        const float t322 = LAIKIN_DOUBLE_GAUSS_50_FMA(t321, 0.0188231152f, t317);
        transmittance[i] = t299;
        waiting[14][i] = t301;
        waiting[22][i] = t305;
        waiting[19][i] = t308;
        waiting[16][i] = t309;
        waiting[23][i] = t310;
        waiting[17][i] = t318;
        waiting[15][i] = t319;
        waiting[13][i] = t320;
        waiting[12][i] = t321;
        waiting[24][i] = t322;
    }
}

LAIKIN_DOUBLE_GAUSS_50_PART void laikin_double_gauss_50_part_11(
    size_t number,
    float (*LAIKIN_DOUBLE_GAUSS_50_RESTRICT waiting)[128])
{
    (void)waiting;
    for (size_t i = 0; i < number; i++) {
        const float t323 = LAIKIN_DOUBLE_GAUSS_50_FMA(waiting[12][i], (-4.57992428e-05f), waiting[17][i]);
        const float t324 = LAIKIN_DOUBLE_GAUSS_50_FMA(waiting[12][i], 0.00871290173f, waiting[15][i]);
        const float t325 = LAIKIN_DOUBLE_GAUSS_50_FMA(waiting[12][i], 0.000193049244f, waiting[13][i]);
        const float t326 = waiting[9][i] * waiting[7][i];
        const float t327 = LAIKIN_DOUBLE_GAUSS_50_FMA(t326, (-0.0161392223f), waiting[24][i]);
        const float t328 = LAIKIN_DOUBLE_GAUSS_50_FMA(t326, 0.000176298854f, t323);
        const float t329 = LAIKIN_DOUBLE_GAUSS_50_FMA(t326, 0.0225964785f, t324);
        const float t330 = LAIKIN_DOUBLE_GAUSS_50_FMA(t326, 0.000739051437f, t325);
        const float t331 = LAIKIN_DOUBLE_GAUSS_50_FMA(t326, (-0.0119640958f), waiting[16][i]);
        const float t332 = LAIKIN_DOUBLE_GAUSS_50_FMA(t326, (-0.0153373368f), waiting[23][i]);
        const float t333 = LAIKIN_DOUBLE_GAUSS_50_FMA(t326, (-0.0169312209f), waiting[14][i]);
        const float t334 = t326 * waiting[7][i];
        const float t335 = LAIKIN_DOUBLE_GAUSS_50_FMA(t334, 0.0325447246f, t327);
        const float t336 = LAIKIN_DOUBLE_GAUSS_50_FMA(t334, 0.000190284743f, t328);
        const float t337 = LAIKIN_DOUBLE_GAUSS_50_FMA(t334, 0.0190648064f, t329);
        const float t338 = LAIKIN_DOUBLE_GAUSS_50_FMA(t334, 0.000336428086f, t330);
        const float t339 = t326 * waiting[6][i];
        const float t340 = LAIKIN_DOUBLE_GAUSS_50_FMA(t339, (-0.00966312084f), t335);
        const float t341 = LAIKIN_DOUBLE_GAUSS_50_FMA(t339, (-6.46013868e-05f), t336);
        const float t342 = LAIKIN_DOUBLE_GAUSS_50_FMA(t339, 0.039176818f, waiting[22][i]);
        const float t343 = LAIKIN_DOUBLE_GAUSS_50_FMA(t339, 0.00462976471f, t337);
        const float t344 = LAIKIN_DOUBLE_GAUSS_50_FMA(t339, (-0.000131883324f), t338);
        const float t345 = LAIKIN_DOUBLE_GAUSS_50_FMA(t339, (-0.00849656481f), waiting[18][i]);
        const float t346 = LAIKIN_DOUBLE_GAUSS_50_FMA(t339, (-0.0117276907f), t333);
        const float t347 = waiting[9][i] * waiting[6][i];
        const float t348 = LAIKIN_DOUBLE_GAUSS_50_FMA(t347, (-0.0878058001f), t340);
        const float t349 = LAIKIN_DOUBLE_GAUSS_50_FMA(t347, 0.00017962938f, t341);
        waiting[24][i] = t331;
        waiting[12][i] = t332;
        waiting[13][i] = t342;
        waiting[15][i] = t343;
        waiting[17][i] = t344;
        waiting[23][i] = t345;
        waiting[16][i] = t346;
        waiting[22][i] = t347;
        waiting[14][i] = t348;
        waiting[18][i] = t349;
    }
}

LAIKIN_DOUBLE_GAUSS_50_PART void laikin_double_gauss_50_part_12(
    size_t number,
    float (*LAIKIN_DOUBLE_GAUSS_50_RESTRICT waiting)[128],
    float *LAIKIN_DOUBLE_GAUSS_50_RESTRICT x_mm,
    float *LAIKIN_DOUBLE_GAUSS_50_RESTRICT y_mm,
    float *LAIKIN_DOUBLE_GAUSS_50_RESTRICT stop_x_mm,
    float *LAIKIN_DOUBLE_GAUSS_50_RESTRICT stop_y_mm)
{
    (void)waiting;
    for (size_t i = 0; i < number; i++) {
        const float t350 = LAIKIN_DOUBLE_GAUSS_50_FMA(waiting[22][i], (-0.0305996519f), waiting[13][i]);
        const float t351 = LAIKIN_DOUBLE_GAUSS_50_FMA(waiting[22][i], 0.0211633984f, waiting[15][i]);
        const float t352 = LAIKIN_DOUBLE_GAUSS_50_FMA(waiting[22][i], 0.000566613977f, waiting[17][i]);
        const float t353 = LAIKIN_DOUBLE_GAUSS_50_FMA(waiting[22][i], (-0.00523843709f), waiting[24][i]);
        const float t354 = waiting[22][i] * waiting[6][i];
        const float t355 = LAIKIN_DOUBLE_GAUSS_50_FMA(t354, (-0.0222363863f), waiting[14][i]);
        const float t356 = LAIKIN_DOUBLE_GAUSS_50_FMA(t354, (-6.73927134e-05f), waiting[18][i]);
        const float t357 = LAIKIN_DOUBLE_GAUSS_50_FMA(t354, (-0.0423203036f), t350);
        const float t358 = LAIKIN_DOUBLE_GAUSS_50_FMA(t354, 0.0108882599f, t351);
        const float t359 = LAIKIN_DOUBLE_GAUSS_50_FMA(t354, 0.000120552439f, t352);
        const float t360 = LAIKIN_DOUBLE_GAUSS_50_FMA(t354, 0.0171158463f, waiting[12][i]);
        const float t361 = LAIKIN_DOUBLE_GAUSS_50_FMA(t354, 0.027004268f, waiting[16][i]);
        const float t364 = t358 * waiting[4][i];
        const float t365 = t358 * waiting[5][i];
        const float t366 = LAIKIN_DOUBLE_GAUSS_50_FMA(t355, waiting[2][i], t364);
        const float t367 = LAIKIN_DOUBLE_GAUSS_50_FMA(t355, waiting[3][i], t365);
        const float t370 = t359 * waiting[4][i];
        const float t371 = t359 * waiting[5][i];
        const float t372 = LAIKIN_DOUBLE_GAUSS_50_FMA(t356, waiting[2][i], t370);
        const float t373 = LAIKIN_DOUBLE_GAUSS_50_FMA(t356, waiting[3][i], t371);
        const float t376 = waiting[19][i] * waiting[4][i];
        const float t377 = waiting[19][i] * waiting[5][i];
        const float t378 = LAIKIN_DOUBLE_GAUSS_50_FMA(t357, waiting[2][i], t376);
        const float t379 = LAIKIN_DOUBLE_GAUSS_50_FMA(t357, waiting[3][i], t377);
        const float t380 = t367 * t367;
        const float t381 = LAIKIN_DOUBLE_GAUSS_50_FMA(t366, t366, t380);
        const float t382 = LAIKIN_DOUBLE_GAUSS_50_FMA(1.12005787e-18f, t381, (-1.54821834e-16f));
        x_mm[i] = t366;
        y_mm[i] = t367;
        stop_x_mm[i] = t378;
        stop_y_mm[i] = t379;
        waiting[18][i] = t353;
        waiting[14][i] = t360;
        waiting[22][i] = t361;
        waiting[16][i] = t372;
        waiting[17][i] = t373;
        waiting[15][i] = t378;
        waiting[13][i] = t379;
        waiting[12][i] = t381;
        waiting[24][i] = t382;
    }
}

LAIKIN_DOUBLE_GAUSS_50_PART void laikin_double_gauss_50_part_13(
    size_t number,
    float (*LAIKIN_DOUBLE_GAUSS_50_RESTRICT waiting)[128],
    const float *LAIKIN_DOUBLE_GAUSS_50_RESTRICT wavelength_nm,
    float film_z_mm,
    float stop_radius_mm,
    float *LAIKIN_DOUBLE_GAUSS_50_RESTRICT z_mm,
    float *LAIKIN_DOUBLE_GAUSS_50_RESTRICT dx,
    float *LAIKIN_DOUBLE_GAUSS_50_RESTRICT dy,
    float *LAIKIN_DOUBLE_GAUSS_50_RESTRICT dz,
    int *LAIKIN_DOUBLE_GAUSS_50_RESTRICT status)
{
    (void)waiting;
    const float t9 = 91.2908554f <= film_z_mm ? 466.569336f : (-1.0f);
    const float t10 = film_z_mm <= 95.9992599f ? t9 : (-1.0f);
    const float t11 = 0.0f <= stop_radius_mm ? t10 : (-1.0f);
    const float t12 = stop_radius_mm <= 9.52509499f ? t11 : (-1.0f);
    const float t399 = stop_radius_mm * stop_radius_mm;
    for (size_t i = 0; i < number; i++) {
        const float t383 = LAIKIN_DOUBLE_GAUSS_50_FMA(waiting[24][i], waiting[12][i], 9.9061937e-13f);
        const float t384 = LAIKIN_DOUBLE_GAUSS_50_FMA(t383, waiting[12][i], 1.38010559e-09f);
        const float t385 = LAIKIN_DOUBLE_GAUSS_50_FMA(t384, waiting[12][i], 3.23937638e-06f);
        const float t386 = LAIKIN_DOUBLE_GAUSS_50_FMA(t385, waiting[12][i], 0.0147919431f);
        const float t387 = LAIKIN_DOUBLE_GAUSS_50_FMA(t386, waiting[12][i], 3.745904e-07f);
        const float t388 = waiting[17][i] * waiting[17][i];
        const float t389 = LAIKIN_DOUBLE_GAUSS_50_FMA(waiting[16][i], waiting[16][i], t388);
        const float t400 = t389 <= 0.206508055f ? 0.0f : 1.0f;
        const float t401 = waiting[22][i] <= 0.0f ? t400 : 10.0f;
        const float t402 = waiting[14][i] <= 0.0f ? t401 : 22.0f;
        const float t390 = LAIKIN_DOUBLE_GAUSS_50_FMA(0.00827207044f, t389, (-0.166661933f));
        const float t391 = LAIKIN_DOUBLE_GAUSS_50_FMA(t390, t389, 0.99999994f);
        const float t392 = waiting[16][i] * t391;
        const float t393 = waiting[17][i] * t391;
        const float t394 = LAIKIN_DOUBLE_GAUSS_50_FMA(0.00137867767f, t389, (-0.0416653492f));
        const float t395 = LAIKIN_DOUBLE_GAUSS_50_FMA(t394, t389, 0.49999994f);
        const float t396 = LAIKIN_DOUBLE_GAUSS_50_FMA(t395, t389, (-1.0f));
        const float t397 = waiting[13][i] * waiting[13][i];
        const float t398 = LAIKIN_DOUBLE_GAUSS_50_FMA(waiting[15][i], waiting[15][i], t397);
        const float t403 = t398 <= t399 ? t402 : 26.0f;
        const float t404 = waiting[18][i] <= 0.0f ? t403 : 30.0f;
        const float t405 = waiting[23][i] <= 0.0f ? t404 : 46.0f;
        const float t406 = waiting[11][i] <= 0.0f ? t405 : 50.0f;
        const float t407 = waiting[0][i] <= t12 ? t406 : 1.0f;
        const float t408 = waiting[1][i] <= 1184.55493f ? t407 : 1.0f;
        const float t409 = 399.996002f <= wavelength_nm[i] ? t408 : 1.0f;
        const float t410 = wavelength_nm[i] <= 700.007019f ? t409 : 1.0f;
        z_mm[i] = t387;
        dx[i] = t392;
        dy[i] = t393;
        dz[i] = t396;
        status[i] = (int)t410;
    }
}

LAIKIN_DOUBLE_GAUSS_50_UNUSED static inline void laikin_double_gauss_50_rays(
    size_t count,
    const float *LAIKIN_DOUBLE_GAUSS_50_RESTRICT film_x_mm,
    const float *LAIKIN_DOUBLE_GAUSS_50_RESTRICT film_y_mm,
    const float *LAIKIN_DOUBLE_GAUSS_50_RESTRICT pupil_x_mm,
    const float *LAIKIN_DOUBLE_GAUSS_50_RESTRICT pupil_y_mm,
    const float *LAIKIN_DOUBLE_GAUSS_50_RESTRICT wavelength_nm,
    float film_z_mm,
    float stop_radius_mm,
    float *LAIKIN_DOUBLE_GAUSS_50_RESTRICT x_mm,
    float *LAIKIN_DOUBLE_GAUSS_50_RESTRICT y_mm,
    float *LAIKIN_DOUBLE_GAUSS_50_RESTRICT z_mm,
    float *LAIKIN_DOUBLE_GAUSS_50_RESTRICT dx,
    float *LAIKIN_DOUBLE_GAUSS_50_RESTRICT dy,
    float *LAIKIN_DOUBLE_GAUSS_50_RESTRICT dz,
    float *LAIKIN_DOUBLE_GAUSS_50_RESTRICT transmittance,
    float *LAIKIN_DOUBLE_GAUSS_50_RESTRICT stop_x_mm,
    float *LAIKIN_DOUBLE_GAUSS_50_RESTRICT stop_y_mm,
    int *LAIKIN_DOUBLE_GAUSS_50_RESTRICT status)
{
    LAIKIN_DOUBLE_GAUSS_50_ALIGNED float waiting[25][128];
    for (size_t at = 0; at < count; at += 128) {
        const size_t number = count - at < 128 ? count - at : 128;
        laikin_double_gauss_50_part_0(number, waiting, film_x_mm + at, film_y_mm + at, pupil_x_mm + at, pupil_y_mm + at, wavelength_nm + at, film_z_mm);
        laikin_double_gauss_50_part_1(number, waiting);
        laikin_double_gauss_50_part_2(number, waiting);
        laikin_double_gauss_50_part_3(number, waiting);
        laikin_double_gauss_50_part_4(number, waiting);
        laikin_double_gauss_50_part_5(number, waiting);
        laikin_double_gauss_50_part_6(number, waiting);
        laikin_double_gauss_50_part_7(number, waiting);
        laikin_double_gauss_50_part_8(number, waiting);
        laikin_double_gauss_50_part_9(number, waiting);
        laikin_double_gauss_50_part_10(number, waiting, transmittance + at);
        laikin_double_gauss_50_part_11(number, waiting);
        laikin_double_gauss_50_part_12(number, waiting, x_mm + at, y_mm + at, stop_x_mm + at, stop_y_mm + at);
        laikin_double_gauss_50_part_13(number, waiting, wavelength_nm + at, film_z_mm, stop_radius_mm, z_mm + at, dx + at, dy + at, dz + at, status + at);
    }
}

#endif
