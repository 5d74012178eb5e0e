// One function of a lens stands above: lens(film, pupil, nm, ...). Rays only: what they meet is another program's, which
// is compiled once for all lenses. Like all shaders of the page, this is written in the part of GLSL that wgsl.js reads.
uniform int task;                 // 0 a sample of a picture, 1 which rays pass, 2 those of a point on the axis, 3 the middle ray
uniform vec2 film_mm, pixels;
uniform float pupil_z, per_distance, scale, wavelength_nm;
uniform vec2 light_nm;
uniform vec4 aim;                 // of tasks 1 and 2: low corner and size of the pupil's square
uniform ivec2 grid;               // film points a side, pupil points a side
uniform float blades, roundness, half_cos, half_sin, edge_cos, edge_sin;
uniform int sample_number, seed;
uniform highp sampler2D boxes;
uniform vec2 probe;
layout(location = 0) out vec4 start;  // x, y, z in metres, in the camera's frame, and the weight
layout(location = 1) out vec4 course; // direction, and the wavelength in nm

// Of the camera's five: an additive recurrence over the samples (Roberts 2018), shifted by pixel.
float even(float step_) { return fract(next() + fract(float(sample_number) * step_)); }

void main() {
    ivec2 at_pixel = ivec2(gl_FragCoord.xy);
    seed_of(at_pixel, uint(seed));
    vec2 film;
    vec2 pupil;
    float area = 1.0;
    float nm = wavelength_nm;
    if (task == 0 || task == 3) {
        vec2 spot = probe * pixels;
        if (task == 0) { spot = vec2(at_pixel) + vec2(even(0.8812714616), even(0.7766393891)); }
        film = (0.5 - spot / pixels) * film_mm;
        vec2 cells = vec2(textureSize(boxes, 0));
        vec4 box = texelFetch(boxes, ivec2(min(abs(film) / (0.5 * film_mm) * cells, cells - 1.0)), 0);
        vec2 u = vec2(0.5);
        if (task == 0) { u = vec2(even(0.6844301296), even(0.6031687407)); }
        pupil = (box.xy + box.zw * u) * (2.0 * step(vec2(0.0), film) - 1.0);
        area = box.z * box.w;
        float part = 0.5;
        if (nm <= 0.0 && task == 0) { part = even(0.5315553977); }
        if (nm <= 0.0) { nm = mix(light_nm.x, light_nm.y, part); }
    } else {
        ivec2 corner = at_pixel / grid.y;
        ivec2 point = at_pixel - corner * grid.y;
        film = task == 1 ? vec2(corner) / float(grid.x - 1) * 0.5 * film_mm : vec2(0.0);
        pupil = aim.xy + aim.zw * (vec2(point) + 0.5) / float(grid.y);
        area = aim.z * aim.w;
        float part = task == 1 ? 0.5 : fract(float(point.x + grid.y * point.y) * 0.6180339887);
        if (nm <= 0.0) { nm = mix(light_nm.x, light_nm.y, part); }
    }
    vec3 p;
    vec3 d;
    vec3 origin;
    vec3 to;
    vec2 at;
    float through;
    float weight;
    int status;
    LENS;
    WEIGH;
    if (task != 1 && blades > 2.5) {
        float inside;
        OPENED;
        weight *= inside;
    }
    start = vec4(origin, weight);
    course = vec4(to, nm);
}
