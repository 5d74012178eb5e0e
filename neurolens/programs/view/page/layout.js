// The section of a lens, and the rays of a place of the picture through it.
const SVG = "http://www.w3.org/2000/svg", RAYS = 9;

class LayoutView {
  constructor(svg, engine) {
    Object.assign(this, { svg, engine });
  }

  async show(lens) {
    const { section, outputs } = jsonOf(lens, "lens");
    this.svg.replaceChildren();
    this.svg.toggleAttribute("hidden", !section.box);
    this.outputs = outputs;
    this.lens = lens;
    if (!section.box) return;
    const [x, y, width, height] = (this.box = section.box);
    this.svg.setAttribute("viewBox", `${x} ${y} ${width} ${height}`);
    this.line("axis", `M${x} 0H${x + width}`);
    for (const { path: d, n } of section.glass) this.line("glass", d).style.setProperty("--tone", Math.min(1, Math.max(0, (n - 1.45) / 0.45)));
    for (const part of ["rims", "stop", "film"]) this.line(part, section[part]);
  }

  line(kind, d) {
    const path = this.svg.appendChild(document.createElementNS(SVG, "path"));
    path.setAttribute("class", kind);
    path.setAttribute("d", d);
    return path;
  }

  /** Draw the rays of a film height (mm) at the setting of a side; returns how many of them pass. */
  async rays(height, side) {
    if (!this.outputs?.length || !this.box) return null;
    const { gpu } = this.engine, names = this.outputs, count = names.length + 1;
    const program = await this.engine.once(`${this.lens.key}/path`, () => gpu.program(`${partOf(this.lens, "path")}
      uniform float film_y, pupil_low, pupil_step, nm, film_z, stop_radius;
      out vec4 result;
      void main() {
        float v[${count}];
        int status;
        float pupil_y = pupil_low + pupil_step * floor(gl_FragCoord.y);
        lens_path(film_y, pupil_y, nm, film_z, stop_radius, ${names.map((_, i) => `v[${i}]`).join(", ")}, status);
        v[${count - 1}] = float(status);
        result = vec4(v[int(gl_FragCoord.x)]);
      }`));
    const v = side.values, tries = 96, target = this.engine.once(`${count}/path`, () => gpu.target(count, tries));
    const given = { film_y: height, pupil_low: -v.pupil_radius, pupil_step: (2 * v.pupil_radius) / (tries - 1),
      nm: v.wavelength_nm || 550, film_z: v.film_z, stop_radius: v.stop_radius };
    gpu.draw(program, given, target);
    const found = (await gpu.read(target)).filter((_, i) => i % 4 === 0);
    this.svg.querySelectorAll(".ray").forEach((ray) => ray.remove());
    const all = Array.from({ length: tries }, (_, k) => [...found.subarray(k * count, (k + 1) * count)]);
    const passing = all.filter((ray) => ray[count - 1] === 0);
    const chosen = passing.length <= RAYS ? passing : Array.from({ length: RAYS }, (_, k) => passing[Math.round((k * (passing.length - 1)) / (RAYS - 1))]);
    for (const ray of chosen) this.line("ray", this.polyline(ray, height, v.film_z));
    return chosen.length;
  }

  polyline(ray, height, film_z) {
    const count = ray.length - 3, [dy, dz] = ray.slice(count, count + 2);
    const points = [[film_z, height]];
    for (let k = 0; k < count; k += 2) points.push([ray[k], ray[k + 1]]);
    const [z, y] = points.at(-1), reach = 2 * this.box[2];
    points.push([z + reach * dz, y + reach * dy]);
    return "M" + points.map(([a, b]) => `${a.toFixed(3)} ${(-b).toFixed(3)}`).join("L");
  }
}
