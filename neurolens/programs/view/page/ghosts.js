// Ghosts of one lamp far away: each ghost's function on a grid of the front, its cells drawn as areas that add up.
const GHOST_CELLS = 28, GHOST_NM = 3; // cells a side (within 1% of 64), and wavelengths, of each ghost

class GhostView {
  constructor(engine) {
    Object.assign(this, { engine, gpu: engine.gpu, nodes: engine.gpu.target(GHOST_NM * (GHOST_CELLS + 1), GHOST_CELLS + 1) });
    this.cells = this.gpu.program(GHOST_FRAGMENT, GHOST_VERTEX);
  }

  /** Programs of a lens's ghosts, brightest first; `made` is told of each, which takes a software GPU a moment. */
  async functions(lens) {
    return this.engine.once(`${lens.key}/ghosts`, () => jsonOf(lens, "ghosts"));
  }

  program(lens, ghost) {
    return this.engine.once(`${lens.key}/ghosts/${ghost.name}`, () => this.gpu.program(ghost.text + GHOST_NODES.replace("GHOST", ghost.call)));
  }

  /**
   * Draw the ghosts of a lamp into `this.film`: `this.dimmed` times it is the irradiance over that of a white card of
   * radiance 1 on the axis. Ghosts that stand there already are kept: a dimmer scales them, as light is linear.
   * `towards`: the lamp's direction in the camera's frame. `irradiance` at the lens, in sr: over that card's radiance.
   * `known`: how many of the brightest. Returns how many there are.
   */
  async draw(lens, side, towards, irradiance, width, height, known) {
    const { values } = side, { ghosts } = lens, all = await this.functions(lens);
    const { film_mm, stop_radius, wavelength_nm, light_nm, exposure } = values;
    const key = JSON.stringify([lens.key, width, towards, [...film_mm], stop_radius, wavelength_nm, light_nm, exposure]);
    if (this.film?.width !== width) {
      if (this.film) this.gpu.free(this.film);
      this.film = this.gpu.target(width, height, null, 1, !this.gpu.blends);
    }
    if (key !== this.kept?.key || known < this.kept.count || !this.kept.irradiance) {
      this.gpu.clear(this.film);
      this.kept = { key, irradiance, count: 0 };
    }
    this.dimmed = irradiance && irradiance / this.kept.irradiance;
    const d = towards.map((v) => -v), inside = Math.hypot(d[0], d[1]) <= ghosts.sine;
    const [low, high] = [0, 1].map((k) => (values.wavelength_nm ? values.wavelength_nm : k ? Math.min(values.light_nm[1], ghosts.wavelength_nm[1]) : Math.max(values.light_nm[0], ghosts.wavelength_nm[0])));
    for (const ghost of inside ? all.slice(this.kept.count, known) : []) {
      const given = { p: [d[0] / ghosts.sine, d[1] / ghosts.sine], d, chief: ghost.chief_mm, size: ghost.scale_mm, span_nm: [low, high],
        stop_radius: Math.min(values.stop_radius, ghosts.stop_radius_mm), film_mm: values.film_mm, one_colour: values.wavelength_nm ? 1 : 0,
        nodes: this.nodes, cell_light: (Math.abs(d[2]) * this.kept.irradiance * (2 / GHOST_CELLS) ** 2 * ghost.scale_mm[0] * ghost.scale_mm[1]) / 2 / values.exposure };
      this.gpu.draw(this.program(lens, ghost), given, this.nodes);
      this.gpu.draw(this.cells, given, this.film, null, 6 * GHOST_CELLS ** 2 * GHOST_NM, true);
    }
    this.kept.count = known;
    return inside ? all.length : 0;
  }
}

// Nodes of a grid over the square about the ghost's light, side by side for each wavelength.
const GHOST_NODES = `
uniform vec2 p, span_nm, chief, size;
uniform vec3 d;
uniform float stop_radius;
out vec4 arriving;
void main() {
  ivec2 node = ivec2(gl_FragCoord.xy);
  int band = node.x / ${GHOST_CELLS + 1};
  vec2 at = chief * p + size * (2.0 * vec2(ivec2(node.x - band * ${GHOST_CELLS + 1}, node.y)) / ${GHOST_CELLS}.0 - 1.0);
  float nm = mix(span_nm.x, span_nm.y, (float(band) + 0.5) / ${GHOST_NM}.0);
  GHOST;
}`;
// Each triangle of three nodes spreads its light evenly over its place on the film; rims cut it where worst is 1.
const GHOST_VERTEX = `
uniform highp sampler2D nodes;
uniform vec2 film_mm;
uniform float cell_light;
uniform int one_colour;
out float worst;
flat out vec3 light;
vec4 corner(int cell, int band, int which) {
  return texelFetch(nodes, ivec2(band * ${GHOST_CELLS + 1} + cell % ${GHOST_CELLS}, cell / ${GHOST_CELLS}) + ivec2(which & 1, which >> 1), 0);
}
void main() {
  int part = gl_VertexID / 3;
  int cell = (part >> 1) % ${GHOST_CELLS ** 2};
  int band = (part >> 1) / ${GHOST_CELLS ** 2};
  int first = 3 * (part & 1);
  vec4 a = corner(cell, band, first);
  vec4 b = corner(cell, band, 1);
  vec4 c = corner(cell, band, 2);
  float lit = float(a.w <= 1.0) + float(b.w <= 1.0) + float(c.w <= 1.0);
  float area = 0.5 * abs((b.x - a.x) * (c.y - a.y) - (c.x - a.x) * (b.y - a.y));
  int k = gl_VertexID % 3;
  int which = k == 0 ? first : k;
  vec4 own = corner(cell, band, which);
  worst = min(own.w, 4.0);
  float t = (float(band) + 0.5) / ${GHOST_NM}.0;
  vec3 colour = one_colour == 1 ? vec3(1.0) : vec3(3.0 * t * t, 6.0 * t * (1.0 - t), 3.0 * (1.0 - t) * (1.0 - t)) / vec3(0.9722222, 1.0555556, 0.9722222);
  light = lit > 0.0 ? colour * (cell_light * (a.z + b.z + c.z) / lit / max(area, 1e-7) / ${GHOST_NM}.0) : vec3(0.0);
  gl_Position = lit > 0.0 ? vec4(-2.0 * own.xy / film_mm, 0.0, 1.0) : vec4(2.0, 2.0, 2.0, 1.0);
}`;
const GHOST_FRAGMENT = `
in float worst;
flat in vec3 light;
out vec4 result;
void main() {
  if (worst > 1.0) { discard; }
  result = vec4(min(light, vec3(100.0)), 0.0);
}`;
