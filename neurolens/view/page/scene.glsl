// What the camera looks at: ellipsoids, a floor, a chart or a white card. Metres, camera frame: it looks along -z.
uniform int scene;            // 0 night, 1 chart, 2 white card
uniform vec4 ball[MOST];      // centre and radius
uniform vec4 coat[MOST];      // colour; w: height over width, negative where the colour is its light
uniform int solids, balls;    // solids come first, then lamps
uniform float chart_z, chart_half, floor_y;
uniform vec4 key;             // lamp that lights the scene: centre and radius
uniform float key_power;       // its irradiance times square metres

const float FAR = 1e9;

struct Hit { float way; vec3 normal; vec3 colour; bool light; };

float meet(vec3 o, vec3 d, int i) {
    vec3 squash = vec3(1.0, 1.0 / abs(coat[i].w), 1.0);
    vec3 from = (o - ball[i].xyz) * squash, to = d * squash;
    float a = dot(to, to), b = dot(from, to);
    vec3 nearest = from - to * (b / a);  // to the centre: b^2 - a c cancels for small and distant balls
    float open = ball[i].w * ball[i].w - dot(nearest, nearest);
    if (open < 0.0) return FAR;
    float half_way = sqrt(open / a), way = -b / a - half_way;
    return way > 1e-4 ? way : FAR;
}

vec3 sky(vec3 d) { return mix(vec3(0.035, 0.03, 0.04), vec3(0.01, 0.016, 0.035), clamp(2.0 * d.y + 0.3, 0.0, 1.0)); }

// Lines, dots and a star on white; q in half heights of the picture.
vec3 chart(vec2 q) {
    vec2 cell = abs(fract(q / 0.25 + 0.5) - 0.5) * 0.25;
    float ink = min(cell.x, cell.y) < 0.003 ? 0.35 : 0.0;
    vec2 knot = (fract(q / 0.25) - 0.5) * 0.25;
    ink = dot(knot, knot) < DOT * DOT ? 1.0 : ink;
    float r = length(q);
    if (r < 0.115) ink = r < 0.11 && sin(36.0 * atan(q.y, q.x)) > 0.0 ? 1.0 : 0.0;
    return vec3(0.9 * (1.0 - ink));
}

Hit struck(vec3 o, vec3 d, int count) {
    Hit hit = Hit(FAR, vec3(0.0), vec3(0.0), true);
    int found = -1;
    for (int i = 0; i < count; i++) {
        float way = meet(o, d, i);
        if (way < hit.way) { hit.way = way; found = i; }
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
        hit = Hit(floor_way, vec3(0, 1, 0), vec3(mod(tile.x + tile.y, 2.0) < 0.5 ? 0.1 : 0.22), false);
    }
    return hit;
}
