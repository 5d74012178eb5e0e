"""A whole camera as C: pupil outline, lens, weight and status of a block of rays after the other, in the first cache.

The same arithmetic as `pupil_outline.PupilOutline.sample` and `lens_film.LensFilm.sample`, around the function of a
lens that `graph.c` writes.
"""

from __future__ import annotations

import ctypes

from neurolens.graph.c import Signature, literal, write_c
from neurolens.graph.derive import derivative
from neurolens.graph.program import (
    FILM_X_Y,
    FILM_Z,
    RAY,
    SCENE_RAY,
    STATUS,
    STOP,
    STOP_RADIUS,
    TRANSMITTANCE,
    WAVELENGTH,
    Program,
)

BLOCK = 256  # rays: their numbers between the stages fit the first cache
_NAME = "lens"


class Setting(ctypes.Structure):
    """What does not change from ray to ray; the C text has the same structure.

    edges: [rows * segments, 16] floats: first vertex and edge (x, y, dx, dy) at a row, their steps to the next row, and
    the change of both from the first wavelength to the second. centres: [rows, 2] centre and its step.
    per_radius: 1 / film radius of the last row. wave_first, wave_scale: share = (1 / wavelength^2 - first) scale.
    per_distance: 1 / (film to pupil plane), 1/mm. scale: of the weight. film_z_mm, stop_radius_mm, film_z_m.
    """

    _fields_ = [
        ("edges", ctypes.c_void_p),
        ("centres", ctypes.c_void_p),
        ("rows", ctypes.c_int),
        ("segments", ctypes.c_int),
        *((name, ctypes.c_float) for name in ("per_radius", "wave_first", "wave_scale", "per_distance")),
        *((name, ctypes.c_float) for name in ("scale", "film_z_mm", "stop_radius_mm", "film_z_m")),
    ]


_TEXT = """
#define BLOCK {block}

/* Functions of their own: where they are put into their caller, what is known of their arguments is lost. */
#if defined(__GNUC__)
#define APART static __attribute__((noinline))
#else
#define APART static
#endif

typedef struct {{
    const float *edges, *centres;
    int rows, segments;
    float per_radius, wave_first, wave_scale, per_distance, scale, film_z_mm, stop_radius_mm, film_z_m;
}} setting;

typedef struct {{ float x, y, dx, dy; }} edge;

LENS_INLINE float up(float a, float b) {{ return a > b ? a : b; }}

/* Choices by bits: of choices between floats compilers make branches, and of these masked stores, which are slow. */
LENS_INLINE unsigned all_if(int truth) {{ return truth ? ~0u : 0u; }}

LENS_INLINE float kept(float x, unsigned mask, unsigned otherwise)
{{
    union {{ float f; unsigned u; }} a;
    a.f = x;
    a.u = (a.u & mask) | (otherwise & ~mask);
    return a.f;
}}

/* Points of the pupil for numbers u, v of the unit square, and the pupil's area, 0 where nothing passes. */
APART void pupil_points(
    int count, const setting *s, const float *LENS_RESTRICT fx, const float *LENS_RESTRICT fy,
    const float *LENS_RESTRICT u, const float *LENS_RESTRICT v, const float *LENS_RESTRICT wavelength,
    float *LENS_RESTRICT px, float *LENS_RESTRICT py, float *LENS_RESTRICT area)
{{
    float radius[BLOCK], step[BLOCK], along[BLOCK], size[BLOCK], share[BLOCK], centre[BLOCK];
    int row[BLOCK], cell[BLOCK];
    edge edges[BLOCK];
    const int last = s->rows - 1, segments = s->segments;
    for (int i = 0; i < count; i++) {{
        /* The row of the outline below the film point's radius; what lies beyond the end, and NaN, is on the axis. */
        const float r = lens_root(fx[i] * fx[i] + fy[i] * fy[i]);
        const float inner = 1.0f - r * s->per_radius;
        const float place = last * (1.0f - lens_root(inner >= 0.0f ? inner : 1.0f));
        const int below = (int)place;
        row[i] = below < last ? below : last;
        step[i] = place - row[i];
        radius[i] = r;
        /* Along the upper half of a concentric square, from 0 at +x over 2 at +y to 4 at -x. */
        const float a = u[i] * 2.0f - 1.0f, b = v[i] * 2.0f - 1.0f;
        const float height = b < 0.0f ? -b : b, width = a < 0.0f ? -a : a;
        size[i] = up(width, height);
        const float per_size = 1.0f / up(size[i], 1e-30f);
        const float way = (2.0f - a * per_size * (2.0f - height * per_size)) * (segments * 0.25f);
        const int first = way > 0.0f ? (int)way : 0;
        const int segment = first < segments - 1 ? first : segments - 1;
        along[i] = way - segment;
        cell[i] = row[i] * segments + segment;
        const float w = (1.0f / (wavelength[i] * wavelength[i]) - s->wave_first) * s->wave_scale;
        const float floor = w > 0.0f ? w : 0.0f;
        share[i] = floor < 1.0f ? floor : 1.0f;
    }}
    for (int i = 0; i < count; i++) {{
        const float *t = s->edges + 16 * (size_t)cell[i], *c = s->centres + 2 * row[i];
        float e[4];
        for (int k = 0; k < 4; k++)
            e[k] = (t[k] + step[i] * t[4 + k]) + share[i] * (t[8 + k] + step[i] * t[12 + k]);
        edges[i] = (edge){{ e[0], e[1], e[2], e[3] }};
        centre[i] = c[0] + step[i] * c[1];
    }}
    for (int i = 0; i < count; i++) {{
        const edge e = edges[i];
        const float r = radius[i], inside = (e.x * e.dy - e.y * e.dx) * segments;
        area[i] = 1.0f - r * s->per_radius >= 0.0f && inside > 0.0f ? inside : 0.0f;
        const float sign = v[i] * 2.0f - 1.0f < 0.0f ? -size[i] : size[i];
        const float x = (e.dx * along[i] + e.x) * size[i] + centre[i], y = (e.dy * along[i] + e.y) * sign;
        /* Turned to the azimuth of the film point. */
        const float axis = r == 0.0f ? 1.0f : 0.0f, per_radius = 1.0f / (r + axis);
        const float cos = fx[i] * per_radius + axis, sin = fy[i] * per_radius;
        px[i] = x * cos - y * sin;
        py[i] = x * sin + y * cos;
    }}
}}

/* Weights from the transmittance; metres in the camera's frame; what does not pass weighs nothing and looks ahead. */
APART void finish(
    int count, const setting *s, const float *LENS_RESTRICT fx, const float *LENS_RESTRICT fy,
    const float *LENS_RESTRICT px, const float *LENS_RESTRICT py, const float *LENS_RESTRICT area,
    float *LENS_RESTRICT x, float *LENS_RESTRICT y, float *LENS_RESTRICT z,
    float *LENS_RESTRICT dx, float *LENS_RESTRICT dy, float *LENS_RESTRICT dz,
    float *LENS_RESTRICT weight, int *LENS_RESTRICT status)
{{
    const float per_distance = s->per_distance, scale = s->scale, film_z_m = s->film_z_m;
    for (int i = 0; i < count; i++) {{
        const float tx = (px[i] - fx[i]) * per_distance, ty = (py[i] - fy[i]) * per_distance;
        const float cos2 = 1.0f / (1.0f + (tx * tx + ty * ty));
        const float w = up(weight[i], 0.0f) * area[i] * cos2 * cos2 * scale;
        /* Where a poor network decodes no direction, the ray is no ray. What is lost on its way may be NaN. */
        const float square = dx[i] * dx[i] + dy[i] * dy[i] + dz[i] * dz[i];
        const unsigned shown = all_if(area[i] > 0.0f);
        const unsigned unit = all_if(square >= {shortest}) & all_if(square <= {longest});
        const unsigned passed = shown & unit & all_if(status[i] == {passed});
        const unsigned lost = shown & all_if(status[i] != {passed});
        status[i] = (int)((passed & {passed}u) | (lost & (unsigned)status[i]) | (~passed & ~lost & {outside}u));
        weight[i] = kept(w, passed, 0u);
        x[i] = kept(x[i] * 1e-3f, passed, 0u);
        y[i] = kept(y[i] * 1e-3f, passed, 0u);
        z[i] = kept(z[i] * 1e-3f - film_z_m, passed, 0u);
        dx[i] = kept(dx[i], passed, 0u);
        dy[i] = kept(dy[i], passed, 0u);
        dz[i] = kept(dz[i], passed, 0xbf800000u); /* -1 */
    }}
}}

/* film, square, stop [2, count], the last or NULL; origin, direction [3, count]; moves: derivatives of both, metres,
   [2, 3, 2, count]. */
void neurolens_camera(
    size_t count, const setting *s, const float *film, const float *square, const float *wavelength,
    float *origin, float *direction, float *weight, int *status, float *stop, float *moves)
{{
    (void)moves;
    for (size_t at = 0; at < count; at += BLOCK) {{
        const int n = count - at < BLOCK ? (int)(count - at) : BLOCK;
        float px[BLOCK], py[BLOCK], area[BLOCK], unasked[2][BLOCK];
        float *stop_x = stop ? stop + at : unasked[0], *stop_y = stop ? stop + count + at : unasked[1];
        const float *fx = film + at, *fy = fx + count;
        float *x = origin + at, *y = x + count, *z = y + count;
        float *dx = direction + at, *dy = dx + count, *dz = dy + count;
        pupil_points(n, s, fx, fy, square + at, square + count + at, wavelength + at, px, py, area);
        lens_rays({call});
        finish(n, s, fx, fy, px, py, area, x, y, z, dx, dy, dz, weight + at, status + at);
{moves}    }}
}}
"""
# What does not pass is no ray that could move; most blocks have none of these.
_MOVES = """\
        int lost = 0;
        for (int i = 0; i < n; i++)
            lost |= status[at + i] != {passed};
        for (int k = 0; lost && k < 12; k++) {{
            float *m = moves + k * count + at;
            for (int i = 0; i < n; i++)
                m[i] = status[at + i] == {passed} ? m[i] : 0.0f;
        }}
"""
_ROOT = """
LENS_INLINE float lens_root(float x)
{
#ifdef __GNUC__
    return __builtin_sqrtf(x);
#else
    return sqrtf(x);
#endif
}
"""


def camera_source(program: Program, passed: int, outside: int, slack: float) -> str:
    """The C text of a camera whose lens is a program, with derivatives where the program has them.

    Args:
        passed, outside: the status of rays that pass, and of film points that nothing reaches.
        slack: how far the squared length of a direction may be from 1.
    """
    signature = Signature.of(program, _NAME)
    given = {
        RAY[0]: "fx", RAY[1]: "fy", RAY[2]: "px", RAY[3]: "py", WAVELENGTH: "wavelength + at",
        FILM_Z: "s->film_z_mm", STOP_RADIUS: "s->stop_radius_mm",
        **dict(zip(SCENE_RAY, ("x", "y", "z", "dx", "dy", "dz"), strict=True)),
        TRANSMITTANCE: "weight + at", STOP[0]: "stop_x", STOP[1]: "stop_y", STATUS: "status + at",
    }  # fmt: skip
    rows = [derivative(output, by) for output in SCENE_RAY for by in FILM_X_Y]
    given |= {row: f"moves + {k} * count + at" for k, row in enumerate(rows)}
    names = ("n", *(given[i] for i in (*signature.per_ray, *signature.per_call, *signature.outputs, STATUS)))
    moves = _MOVES.format(passed=passed) if rows[0] in signature.outputs else ""
    lengths = {"shortest": literal(1 - slack), "longest": literal(1 + slack)}
    body = _TEXT.format(block=BLOCK, passed=passed, outside=outside, call=", ".join(names), moves=moves, **lengths)
    return "#include <math.h>\n" + write_c(program, _NAME, ["A fused camera's lens."]) + _ROOT + body
