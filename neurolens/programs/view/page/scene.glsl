// What the camera looks at: ellipsoids, a floor, a chart or a white card. Metres, camera frame: it looks along -z.
uniform int scene;            // 0 night, 1 chart, 2 white card
uniform vec4 ball[MOST];      // centre and radius
uniform vec4 coat[MOST];      // colour; w: height over width, negative where the colour is its light
uniform int person, solids, balls;  // first those of a person, then other solids, then lamps
uniform vec3 around[4];       // low and high corners of a box around the person, and of one around the lamps
uniform float chart_z, chart_half, floor_y;
uniform vec4 key;             // lamp that lights the scene: centre and radius
uniform float key_power;      // its irradiance times square metres
uniform highp sampler2D starts, courses, before;
uniform int sample_number, seed;
uniform int measures;         // 1: no picture, but how far away what is seen lies (m, along the axis)
uniform float wavelength_nm;
uniform vec2 light_nm;
out vec4 result;

const float FAR = 1e9;

struct Hit { float way; vec3 normal; vec3 colour; bool light; };

float way;  // of the ray from the camera

float meet(vec3 o, vec3 d, int i) {
    vec3 squash = vec3(1.0, 1.0 / abs(coat[i].w), 1.0);
    vec3 begin = (o - ball[i].xyz) * squash;
    vec3 to = d * squash;
    float a = dot(to, to);
    float b = dot(begin, to);
    vec3 nearest = begin - to * (b / a);  // to the centre: b^2 - a c cancels for small and distant balls
    float open = ball[i].w * ball[i].w - dot(nearest, nearest);
    if (open < 0.0) { return FAR; }
    float near = -b / a - sqrt(open / a);
    if (near > 1e-4) { return near; }
    return FAR;
}

vec3 sky(vec3 d) { return mix(vec3(0.035, 0.03, 0.04), vec3(0.01, 0.016, 0.035), clamp(2.0 * d.y + 0.3, 0.0, 1.0)); }

// Lines, dots and a star on white; q in half heights of the picture.
vec3 chart(vec2 q) {
    vec2 cell = abs(fract(q / 0.25 + 0.5) - 0.5) * 0.25;
    float ink = min(cell.x, cell.y) < 0.003 ? 0.35 : 0.0;
    vec2 knot = (fract(q / 0.25) - 0.5) * 0.25;
    if (dot(knot, knot) < DOT * DOT) { ink = 1.0; }
    float r = length(q);
    if (r < 0.115) { ink = float(r < 0.11 && sin(36.0 * atan(q.y, q.x)) > 0.0); }
    return vec3(0.9 * (1.0 - ink));
}

bool crosses(vec3 low, vec3 high, vec3 o, vec3 d) {
    vec3 a = (low - o) / d;
    vec3 b = (high - o) / d;
    vec3 first = min(a, b);
    vec3 last = max(a, b);
    return min(min(last.x, last.y), last.z) >= max(max(max(first.x, first.y), first.z), 0.0);
}

int first_of(vec3 o, vec3 d) {
    if (crosses(around[0], around[1], o, d)) { return 0; }
    return person;
}

Hit struck(vec3 o, vec3 d, bool lamps) {
    Hit hit = Hit(FAR, vec3(0.0), vec3(0.0), true);
    int found = -1;
    int count = solids;
    if (lamps && crosses(around[2], around[3], o, d)) { count = balls; }
    for (int i = first_of(o, d); i < count; i++) {
        float near = meet(o, d, i);
        if (near < hit.way) { hit.way = near; found = i; }
    }
    if (found >= 0) {
        hit.colour = coat[found].rgb;
        hit.light = coat[found].w < 0.0;
        float squash = 1.0 / abs(coat[found].w);
        hit.normal = normalize((o + d * hit.way - ball[found].xyz) * vec3(1.0, squash * squash, 1.0));
    }
    float floor_way = (floor_y - o.y) / d.y;
    if (scene == 0 && floor_way > 1e-4 && floor_way < hit.way) {
        vec2 tile = floor((o + d * floor_way).xz / 0.6);
        float grey = fract(0.5 * (tile.x + tile.y)) < 0.25 ? 0.1 : 0.22;
        hit = Hit(floor_way, vec3(0.0, 1.0, 0.0), vec3(grey), false);
    }
    return hit;
}

vec3 lit_by_key(vec3 x, vec3 normal) {
    float z = 2.0 * next() - 1.0;
    float turn = 6.2831853 * next();
    vec3 to = key.xyz + key.w * vec3(sqrt(1.0 - z * z) * vec2(cos(turn), sin(turn)), z) - x;
    float far2 = dot(to, to);
    float facing = dot(normal, to) * inversesqrt(far2);
    if (facing <= 0.0) { return vec3(0.0); }
    vec3 d = to * inversesqrt(far2);
    for (int i = first_of(x, d); i < solids; i++) {
        if (meet(x, d, i) < FAR) { return vec3(0.0); }
    }
    return vec3(1.0, 0.87, 0.72) * (key_power * facing / far2);
}

// Two bounces, in one loop: half the code to compile, and code that no ray needs is left out only by loops where a
// processor stands in for the GPU.
vec3 night(vec3 from_o, vec3 from_d) {
    vec3 o = from_o;
    vec3 d = from_d;
    vec3 sum = vec3(0.0);
    vec3 carried = vec3(1.0);
    for (int bounce = 0; bounce < 2; bounce++) {
        Hit hit = struck(o, d, bounce == 0);
        if (bounce == 0) { way = hit.way; }
        if (hit.way >= FAR) { return sum + carried * (sky(d) + 0.05 * float(bounce)); }
        if (hit.light) { return sum + carried * hit.colour; }
        o += d * hit.way + 1e-3 * hit.normal;
        carried *= hit.colour;
        sum += carried * lit_by_key(o, hit.normal);
        float z = 2.0 * next() - 1.0;
        float turn = 6.2831853 * next();
        d = normalize(hit.normal + 0.999 * vec3(sqrt(1.0 - z * z) * vec2(cos(turn), sin(turn)), z));
    }
    return sum;
}

vec3 radiance(vec3 o, vec3 d) {
    vec3 seen = vec3(1.0);
    for (int once = scene; once == 0; once++) { seen = night(o, d); }
    if (scene == 1) {
        way = (chart_z - o.z) / d.z;
        seen = way > 0.0 ? chart((o + d * way).xy / chart_half) : vec3(0.02);
    }
    return seen;
}

vec3 colour_of(float nm) {  // Bernstein's polynomials: never negative, mean 1 over the wavelengths
    if (wavelength_nm > 0.0) { return vec3(1.0); }
    float t = (nm - light_nm.x) / (light_nm.y - light_nm.x);
    return vec3(3.0 * t * t, 6.0 * t * (1.0 - t), 3.0 * (1.0 - t) * (1.0 - t));
}

void main() {
    ivec2 pixel = ivec2(gl_FragCoord.xy);
    vec4 start = texelFetch(starts, pixel, 0);
    vec4 course = texelFetch(courses, pixel, 0);
    seed_of(pixel, uint(seed) + uint(sample_number) * 0x85ebca6bu + 0x68bc21ebu);
    vec3 colour = vec3(0.0);
    way = FAR;
    if (start.w > 0.0 || measures == 1) { colour = radiance(start.xyz, course.xyz); }
    result = vec4(colour * colour_of(course.w) * start.w, float(start.w > 0.0));
    if (sample_number > 0) { result += texelFetch(before, pixel, 0); }
    if (measures == 1) { result = vec4(-(start.z + way * course.z)); }
}
