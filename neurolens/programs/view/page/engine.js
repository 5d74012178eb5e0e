// Lenses on the GPU: what a setting comes to, where rays pass, pictures that add up.
const AIM_FILM = 5, AIM_PUPIL = 28, AXIS = 100; // points a side: of the film's quarter and pupil; of the exposure
const FREE_BENCH = 640;

/** A form's function for the shader of rays: its state, if any, is uniforms, four numbers each. */
function functionOf(text) {
  const packed = (_, n) => `state_c[${n >> 2}].${"xyzw"[n & 3]}`;
  const count = Number(text.match(/struct \w+_state \{[^}]*float c\[(\d+)\]/)?.[1] ?? 0);
  const own = text.match(/^#define .*$/m)[0] + text.slice(text.lastIndexOf("\nvoid ")).replace(/\s*in \w+_state state,/, "");
  const state = count ? `uniform vec4 state_c[${(count + 3) >> 2}];\nuniform int state_inside;\n` : "";
  return { count, text: state + own.replace(/state\.c\[(\d+)\]/g, packed).replace("!state.inside", "state_inside == 0") };
}

/** The shader of rays with the function of a lens. */
function raysShader({ shaders, functions: { weigh, opened } }, text, call) {
  const given = "uniform float film_z, stop_radius, distance_mm, per_depth;\n";
  const rays = shaders.rays.replace("LENS", call).replace("WEIGH", weigh.call).replace("OPENED", opened.call);
  return given + functionOf(text).text + weigh.text + opened.text + shaders.random + rays;
}

/** The shader of what they meet. */
function sceneShader({ shaders }) {
  return shaders.random + shaders.scene.replaceAll("MOST", MOST_BALLS).replaceAll("DOT", DOT);
}

class Engine {
  constructor(gpu, shared) {
    this.gpu = gpu;
    this.shared = shared;
    this.made = new Map(); // programs, texts and numbers by lens and form
    this.scene = gpu.program(sceneShader(shared));
    this.show = gpu.program(SHOW);
    this.sides = {};
  }

  form(lens, kind) {
    return kind === "thin" ? { kind, method: "paraxial" } : lens.forms.find((f) => f.kind === kind);
  }

  async text(lens, kind) {
    return this.once(`${lens.key}/${kind}/text`, () => partOf(lens, `${kind}/glsl`));
  }

  /** The program of a form's rays, compiled when it is first asked for. */
  async program(lens, kind) {
    const key = kind === "thin" ? "thin" : `${lens.key}/${kind}/program`;
    return this.once(key, async () => {
      const { thin } = this.shared.functions, text = kind === "thin" ? thin.text : await this.text(lens, kind);
      return this.gpu.program(raysShader(this.shared, text, kind === "thin" ? thin.call : this.form(lens, kind).call));
    });
  }

  once(key, make) {
    if (!this.made.has(key)) this.made.set(key, make());
    return this.made.get(key);
  }

  /** Numbers of a form at a setting, and those of its state. */
  async numbers(lens, kind, set) {
    const form = this.form(lens, kind), names = Object.keys(form.values);
    const made = await this.once(`${lens.key}/${kind}/numbers`, async () => {
      const text = await this.text(lens, kind), { count } = functionOf(text);
      const values = names.map((name, i) => `if (i == ${i}) { v = ${form.values[name]}; }`).join("\n");
      const state = count ? `${form.name}_state s = ${form.name}_at(zoom);
        if (i == ${names.length}) { v = float(s.inside); }
        if (i > ${names.length}) { v = s.c[i - ${names.length + 1}]; }` : "";
      const program = this.gpu.program(`${text.slice(0, text.lastIndexOf("\nvoid "))}
        uniform float zoom, focus, stop_share;
        out vec4 result;
        void main() {
          float v = 0.0;
          float stop_radius = stop_share * ${form.values.stop_radius_max_mm};
          int i = int(gl_FragCoord.x);
          ${values}
          ${state}
          result = vec4(v);
        }`);
      return { program, count, target: this.gpu.target(names.length + (count ? 1 + count : 0), 1) };
    });
    const share = Math.min(1, wideOf(lens, set.zoom) / set.f_number);
    this.gpu.draw(made.program, { zoom: set.zoom, focus: Math.min(set.focus, 1e7), stop_share: share }, made.target);
    const found = (await this.gpu.read(made.target)).filter((_, i) => i % 4 === 0);
    const numbers = Object.fromEntries(names.map((name, i) => [name, found[i]]));
    const state_c = new Float32Array(((made.count + 3) >> 2) * 4);
    state_c.set(found.subarray(names.length + 1));
    return { ...numbers, stop_radius: share * numbers.stop_radius_max_mm, state_c, state_inside: +(found[names.length] ?? 1) };
  }

  /** All that the shader of rays takes, but for samples: film, focus, pupil and exposure of one form. */
  async setting(lens, kind, set) {
    const reference = lens.forms.find((f) => f.kind === "polynomial") ?? lens.forms[0];
    const placed = await this.numbers(lens, reference.kind, set);
    const height = (2 * lens.film_radius_mm * 0.999) / Math.hypot(16 / 9 / lens.squeeze, 1);
    const film_mm = [(height * 16) / 9 / lens.squeeze, height];
    const light_nm = [Math.max(400, placed.wavelength_min_nm ?? 400), Math.min(700, placed.wavelength_max_nm ?? 700)];
    const film_z = placed.film_z_mm ?? placed.film_z_infinity_mm;
    const turn = Math.PI / Math.max(set.blades, 3), first = (set.rotation * Math.PI) / 180 + turn;
    const values = {
      film_mm, film_z, light_nm, wavelength_nm: set.wavelength, blades: set.blades, roundness: set.roundness,
      half_cos: Math.cos(turn), half_sin: Math.sin(turn), edge_cos: Math.cos(first), edge_sin: Math.sin(first),
      distance_mm: 1, per_depth: 0, state_c: new Float32Array(4), state_inside: 1, efl_mm: placed.efl_mm,
    };
    if (kind === "thin") {
      const f = placed.efl_mm, far = Math.max(1000 * Math.min(set.focus, 1e7), 4.0001 * f);
      const distance = (2 * f * far) / (far + Math.sqrt(far * (far - 4 * f))); // of D, f: see film_z_mm, without cancelling
      const radius = f / (2 * set.f_number);
      Object.assign(values, { distance_mm: distance, per_depth: 1 / f - 1 / distance, stop_radius: radius,
        pupil_z: film_z - distance, pupil_radius: radius });
    } else {
      const own = kind === reference.kind ? placed : await this.numbers(lens, kind, set);
      Object.assign(values, { stop_radius: own.stop_radius, pupil_z: own.pupil_z_mm, pupil_radius: own.pupil_radius_mm,
        state_c: own.state_c, state_inside: own.state_inside });
    }
    return { ...values, per_distance: 1 / (film_z - values.pupil_z) };
  }

  /** Rectangles of the pupil that hold the rays that pass, over a quarter of the film: [cells x cells] of low and size. */
  async boxes(lens, kind, values) {
    const radius = values.pupil_radius, cells = AIM_FILM - 1;
    if (kind === "thin") return new Float32Array(4 * cells * cells).map((_, i) => radius * (i % 4 < 2 ? -1 : 2));
    const side = AIM_FILM * AIM_PUPIL, target = this.once("aim", () => this.gpu.target(side, side, null, 2));
    const aim = [-radius, -radius, 2 * radius, 2 * radius], step = (2 * radius) / AIM_PUPIL;
    this.run(await this.program(lens, kind), { ...values, task: 1, aim, grid: [AIM_FILM, AIM_PUPIL] }, target);
    const passed = await this.gpu.read(target), spans = [];
    for (let n = 0; n < AIM_FILM * AIM_FILM; n++) {
      const [cx, cy] = [n % AIM_FILM, Math.floor(n / AIM_FILM)].map((v) => v * AIM_PUPIL);
      const span = [Infinity, Infinity, -Infinity, -Infinity];
      for (let y = 0; y < AIM_PUPIL; y++)
        for (let x = 0; x < AIM_PUPIL; x++)
          if (passed[4 * ((cy + y) * side + cx + x) + 3] > 0) {
            span[0] = Math.min(span[0], x); span[1] = Math.min(span[1], y);
            span[2] = Math.max(span[2], x); span[3] = Math.max(span[3], y);
          }
      spans.push(span);
    }
    const found = new Float32Array(4 * cells * cells);
    for (let n = 0; n < cells * cells; n++) {
      const corner = (n % cells) + AIM_FILM * Math.floor(n / cells);
      const four = [0, 1, AIM_FILM, AIM_FILM + 1].map((k) => spans[corner + k]);
      const low = [0, 1].map((k) => Math.max(-0.5, Math.min(...four.map((s) => s[k])) - 1));
      const high = [2, 3].map((k) => Math.min(AIM_PUPIL - 0.5, Math.max(...four.map((s) => s[k])) + 1));
      const lit = high[0] >= low[0];
      const at = lit ? low.map((v) => (v + 0.5) * step - radius) : [-radius, -radius];
      const size = lit ? [0, 1].map((k) => (high[k] - low[k]) * step) : [2 * radius, 2 * radius];
      found.set([...at, ...size], 4 * n);
    }
    return found;
  }

  /** Where rays pass and the exposure on the axis, of a form. */
  async aimed(lens, kind, values) {
    const program = await this.program(lens, kind), boxes = await this.boxes(lens, kind, values);
    const axis = this.once("axis", () => this.gpu.target(AXIS, AXIS, null, 2));
    const task = { ...values, scale: values.per_distance ** 2, task: 2, aim: [...boxes.subarray(0, 4)], grid: [1, AXIS] };
    this.run(program, task, axis);
    const weights = await this.gpu.read(axis);
    let exposure = 0;
    for (let i = 3; i < weights.length; i += 4) exposure += weights[i] / (AXIS * AXIS);
    return { boxes, exposure };
  }

  /**
   * Make sides show forms at a setting: `kinds` by side. All forms but the thin lens are exposed as the exact one, if it
   * is seen, and send their rays through its pupil, so that their pictures differ by what they are.
   */
  async prepare(lens, kinds, set, scene) {
    const made = {}, cells = AIM_FILM - 1;
    const { focus, f_number, zoom, blades, roundness, rotation, wavelength } = set;
    const key = JSON.stringify([lens.key, kinds, String(focus), f_number, zoom, blades, roundness, rotation, wavelength]);
    if (key === this.prepared) {
      for (const side of Object.keys(kinds)) Object.assign(this.sides[side], { values: { ...this.sides[side].values, ...scene }, samples: 0 });
      return;
    }
    this.prepared = null;
    const first = (a, b) => (b[1] === "exact") - (a[1] === "exact");
    for (const [side, kind] of Object.entries(kinds).sort(first)) {
      const values = await this.setting(lens, kind, set), plane = kind === "thin" ? kind : values.pupil_z.toFixed(2);
      made[plane] ??= await this.aimed(lens, kind, values);
      const { boxes, exposure } = made[plane], known = this.sides[side] ?? {};
      if (known.boxes) this.gpu.free(known.boxes);
      Object.assign(values, { scale: values.per_distance ** 2 / exposure, exposure });
      this.sides[side] = { ...known, kind, program: await this.program(lens, kind), values: { ...values, ...scene },
        boxes: this.gpu.target(cells, cells, boxes), samples: 0 };
    }
    this.prepared = key;
  }

  run(program, values, target, window = null) {
    const given = { pixels: [1, 1], probe: [0, 0], aim: [0, 0, 1, 1], grid: [1, 1], boxes: null, sample_number: 0, seed: 0,
      scale: 1, ...values };
    this.gpu.draw(program, given, target, window);
  }

  /** Rays into what they meet. */
  meet(values, rays, target, window = null) {
    const [starts, courses] = rays.textures.map((texture) => ({ texture }));
    this.gpu.draw(this.scene, { before: null, sample_number: 0, seed: 0, measures: 0, ...values, starts, courses }, target, window);
  }

  /** Rays of a picture's size, of all sides. */
  rays(width, height) {
    if (this.held?.width !== width || this.held.height !== height) {
      if (this.held) this.gpu.free(this.held);
      this.held = this.gpu.target(width, height, null, 2);
    }
    return this.held;
  }

  /** Add a sample to each pixel of a side between the columns `from` and `to`. */
  add(side, width, height, from = 0, to = width) {
    const s = this.sides[side];
    if (s.film?.width !== width || s.film?.height !== height) {
      for (const t of [s.film, s.spare]) if (t) this.gpu.free(t);
      Object.assign(s, { film: this.gpu.target(width, height), spare: this.gpu.target(width, height), samples: 0 });
    }
    const given = { ...s.values, task: 0, pixels: [width, height], boxes: s.boxes, before: s.film, sample_number: s.samples, seed: 1 };
    const rays = this.rays(width, height), window = [from, 0, to - from, height];
    if (to > from) {
      this.run(s.program, given, rays, window);
      this.meet(given, rays, s.spare, window);
    }
    [s.film, s.spare] = [s.spare, s.film];
    s.samples++;
  }

  /** Mean of the samples of a side: RGB and the share of rays that pass, rows from below. */
  async picture(side) {
    const { film, samples } = this.sides[side];
    return (await this.gpu.read(film)).map((v) => v / samples);
  }

  /** Distance (m, from the film along the axis) of what a place of the picture shows; Infinity for the sky. */
  async distance(side, place) {
    const s = this.sides[side], target = this.once("probe", () => this.gpu.target(1, 1)), ray = this.once("ray", () => this.gpu.target(1, 1, null, 2));
    this.run(s.program, { ...s.values, task: 3, probe: place, boxes: s.boxes }, ray);
    this.meet({ ...s.values, measures: 1 }, ray, target);
    const [far] = await this.gpu.read(target);
    return far > 0 && far < 1e6 ? far : Infinity;
  }

  /** The direction, in the camera's frame, that a place of the picture looks in. */
  async direction(side, place) {
    const s = this.sides[side], ray = this.once("ray", () => this.gpu.target(1, 1, null, 2));
    this.run(s.program, { ...s.values, task: 3, probe: place, boxes: s.boxes }, ray);
    return [...(await this.gpu.read(ray, 0, 0, 1, 1, 1)).subarray(0, 3)];
  }

  /** Nanoseconds a ray of a side's lens: its function and weight, no scene; the least of some runs. */
  async cost(side) {
    const s = this.sides[side], target = this.once("bench", () => this.gpu.target(FREE_BENCH, FREE_BENCH, null, 2));
    const given = { ...s.values, task: 2, scale: s.values.per_distance ** 2, aim: [0, 0, 1, 1], grid: [1, FREE_BENCH] };
    let best = Infinity, repeats = 1;
    for (let turn = 0; turn < 6; turn++) {
      const start = performance.now();
      for (let k = 0; k < repeats; k++) this.run(s.program, given, target);
      await this.gpu.read(target, 0, 0, 1, 1); // waits for the GPU
      const took = performance.now() - start;
      if (turn) best = Math.min(best, took / repeats);
      if (took < 30) repeats = Math.min(64, repeats * 4);
    }
    return (best * 1e6) / FREE_BENCH ** 2;
  }

  /** Show sides on the canvas: `view` is "one", "wipe" or "difference"; `dimmed` times the ghosts are added to both. */
  paint(view, wipe, gain, ghosts = null, dimmed = 1) {
    const { a, b } = this.sides, other = b?.film ? b : a;
    this.gpu.draw(this.show, { a: a.film, b: other.film, counts: [a.samples, other.samples],
      view: ["one", "wipe", "difference"].indexOf(view), wipe, gain, ghosts, flared: ghosts ? dimmed : 0 }, null);
  }
}

const SHOW = `
uniform sampler2D a, b, ghosts;
uniform vec2 counts;
uniform int view;
uniform float wipe, gain, flared;
out vec4 result;
vec3 mapped(vec3 light) {
  vec3 x = clamp(light, vec3(0.0), vec3(1.0));
  return mix(12.92 * x, 1.055 * pow(x, vec3(1.0 / 2.4)) - 0.055, step(vec3(0.0031308), x));
}
void main() {
  ivec2 at = ivec2(gl_FragCoord.xy);
  vec3 left = texelFetch(a, at, 0).rgb / counts.x;
  vec3 right = texelFetch(b, at, 0).rgb / counts.y;
  float edge = floor(wipe * float(textureSize(a, 0).x));
  vec3 seen = view == 1 && float(at.x) >= edge ? right : left;
  if (flared > 0.0) { seen += flared * texelFetch(ghosts, at, 0).rgb; }
  if (gain > 1.0) { seen = 1.0 - exp(-gain * seen); } // of the night, lights keep their colour
  if (view == 2) { seen = 1000.0 * abs(left - right); }
  result = vec4(mapped(seen), 1.0);
}`;

/** The widest f-number at a zoom position. */
function wideOf(lens, zoom) {
  const nodes = [...lens.f_numbers].sort((p, q) => p[0] - q[0]);
  if (nodes.length === 1) return nodes[0][1];
  const k = Math.min(nodes.length - 2, Math.max(0, nodes.findIndex(([z]) => z > zoom) - 1));
  const share = Math.min(1, Math.max(0, (zoom - nodes[k][0]) / (nodes[k + 1][0] - nodes[k][0])));
  return nodes[k][1] + share * (nodes[k + 1][1] - nodes[k][1]);
}
