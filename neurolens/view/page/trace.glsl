// One function of a lens stands above: lens(film, pupil, nm, ...). Tasks share its one call.
uniform int task;                 // 0 picture, 1 aim: which rays pass, 2 exposure on the axis, 3 distance
uniform ivec4 window;             // first pixel and size of what is drawn
uniform vec2 film_mm, pixels;
uniform float pupil_z, per_distance, scale, wavelength_nm;
uniform vec2 light_nm;
uniform vec4 aim;                 // of tasks 1 and 2: low corner and size of the pupil's square
uniform ivec2 grid;               // film points a side, pupil points a side
uniform float blades, roundness, half_cos, half_sin, edge_cos, edge_sin;
uniform int sample_number, seed, depth_most;
uniform highp sampler2D boxes, before;
uniform vec2 probe;
out vec4 result;

uint mixed(uint x) {
    x ^= x >> 16; x *= 0x7feb352du; x ^= x >> 15; x *= 0x846ca68bu; x ^= x >> 16;
    return x;
}

uint state;  // of the random numbers of a pixel

float next() {
    state = mixed(state + 0x9e3779b9u);
    return float(state >> 8) / 16777216.0;
}

// Of the camera's five: an additive recurrence over the samples (Roberts 2018), shifted by pixel.
float even(float step_) { return fract(next() + fract(float(sample_number) * step_)); }

vec3 colour_of(float nm) {  // Bernstein's polynomials: never negative, mean 1 over the wavelengths
    if (wavelength_nm > 0.0) return vec3(1.0);
    float t = (nm - light_nm.x) / (light_nm.y - light_nm.x);
    return vec3(3.0 * t * t, 6.0 * t * (1.0 - t), 3.0 * (1.0 - t) * (1.0 - t));
}

vec3 lit_by_key(vec3 x, vec3 normal) {
    float z = 2.0 * next() - 1.0, turn = 6.2831853 * next();
    vec3 to = key.xyz + key.w * vec3(sqrt(1.0 - z * z) * vec2(cos(turn), sin(turn)), z) - x;
    float far2 = dot(to, to), facing = dot(normal, to) * inversesqrt(far2);
    if (facing <= 0.0) return vec3(0.0);
    vec3 d = to * inversesqrt(far2);
    for (int i = 0; i < solids; i++) if (meet(x + 1e-3 * normal, d, i) < FAR) return vec3(0.0);
    return vec3(1.0, 0.87, 0.72) * (key_power * facing / far2);
}

vec3 radiance(vec3 o, vec3 d, out float way) {
    way = FAR;
    if (scene == 2) return vec3(1.0);
    if (scene == 1) {
        way = (chart_z - o.z) / d.z;
        vec2 q = (o + d * way).xy / chart_half;
        return way > 0.0 ? chart(q) : vec3(0.02);
    }
    Hit hit = struck(o, d, balls);
    way = hit.way;
    if (way >= FAR) return sky(d);
    if (hit.light) return hit.colour;
    vec3 x = o + d * way, sum = hit.colour * lit_by_key(x, hit.normal);
    float z = 2.0 * next() - 1.0, turn = 6.2831853 * next();
    vec3 bounce = normalize(hit.normal + 0.999 * vec3(sqrt(1.0 - z * z) * vec2(cos(turn), sin(turn)), z));
    Hit second = struck(x + 1e-3 * hit.normal, bounce, solids);
    if (second.way >= FAR) return sum + hit.colour * (sky(bounce) + 0.05);
    vec3 y = x + bounce * second.way;
    return sum + hit.colour * second.colour * lit_by_key(y, second.normal);
}

void main() {
    ivec2 at_pixel = ivec2(gl_FragCoord.xy) - window.xy;
    state = mixed(uint(at_pixel.x) * 1973u + uint(at_pixel.y) * 9277u * 4099u + uint(seed));
    vec2 film, pupil;
    float area = 1.0, nm = wavelength_nm;
    if (task == 0 || task == 3) {
        vec2 spot = task == 0 ? vec2(at_pixel) + vec2(even(0.8812714616), even(0.7766393891)) : probe * pixels;
        film = (0.5 - spot / pixels) * film_mm;
        vec2 cells = vec2(textureSize(boxes, 0));
        vec4 box = texelFetch(boxes, ivec2(min(abs(film) / (0.5 * film_mm) * cells, cells - 1.0)), 0);
        vec2 u = task == 0 ? vec2(even(0.6844301296), even(0.6031687407)) : vec2(0.5);
        pupil = (box.xy + box.zw * u) * vec2(film.x < 0.0 ? -1.0 : 1.0, film.y < 0.0 ? -1.0 : 1.0);
        area = box.z * box.w;
        if (nm <= 0.0) nm = mix(light_nm.x, light_nm.y, task == 0 ? even(0.5315553977) : 0.5);
    } else {
        ivec2 corner = at_pixel / grid.y, point = at_pixel % grid.y;
        film = task == 1 ? vec2(corner) / float(grid.x - 1) * 0.5 * film_mm : vec2(0.0);
        pupil = aim.xy + aim.zw * (vec2(point) + 0.5) / float(grid.y);
        area = aim.z * aim.w;
        if (nm <= 0.0) nm = task == 1 ? 0.5 * (light_nm.x + light_nm.y)
            : mix(light_nm.x, light_nm.y, fract(float(point.x + grid.y * point.y) * 0.6180339887));
    }
    vec3 p, d, from, to;
    vec2 at;
    float through, weight;
    int status;
    LENS;
    WEIGH;
    if (task != 1 && blades > 2.5) {
        float inside;
        OPENED;
        weight *= inside;
    }
    if (task == 1 || task == 2) {
        result = vec4(status == 0 ? 1.0 : 0.0, weight, 0.0, 1.0);
        return;
    }
    vec3 colour = vec3(0.0);
    float way = FAR;
    state += uint(sample_number) * 0x85ebca6bu;
    if (weight > 0.0 || task == 3) colour = radiance(from, to, way);
    if (task == 3) {
        result = vec4(-(from.z + way * to.z), float(status), 0.0, 1.0);
        return;
    }
    result = vec4(colour * colour_of(nm) * weight, weight > 0.0 ? 1.0 : 0.0);
    if (sample_number > 0) result += texelFetch(before, ivec2(gl_FragCoord.xy), 0);
}
