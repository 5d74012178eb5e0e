// The page: settings, what they show, keys and touch.
const $ = (id) => document.getElementById(id);
const shared = JSON.parse(textOf(new Unpacked($("data").textContent, +$("data").dataset.bytes).upTo()));
const NAMES = { exact: "exact", polynomial: "polynomial", network: "network", thin: "thin lens" };
const set = { lens: shared.lenses[0], scene: "night", view: "wipe", a: "", b: "", tool: "focus", wipe: 0.5, focus: 1, f_number: 1,
  zoom: 0, blades: 0, roundness: 0, rotation: 0, wavelength: 0, width: 480, most: 256, clicked: null, lamp: null, irradiance: 0.5 };
let engine, layout, ghosts, turn = 0, held = 0, busy = Promise.resolve(), begun = performance.now();
const log = (low, high, share) => low * (high / low) ** share;
const share = (low, high, value) => Math.log(value / low) / Math.log(high / low);

function framing() {
  const { lens } = set, h = (lens.film_radius_mm * 0.999) / Math.hypot(16 / 9 / lens.squeeze, 1);
  const f = Math.abs(lens.efl_mm), far = Math.max((0.28 * f) / h + f / 1000, lens.nearest_m * 1.05);
  return { far, unit: ((far - f / 1000) * h) / f };
}

const zoomEnds = () => { const z = set.lens.f_numbers.map(([mm]) => mm); return [Math.min(...z), Math.max(...z)]; };
const stopEnds = () => [wideOf(set.lens, set.zoom), 22 < 2 * set.lens.f_numbers[0][1] ? 45 : 22];
const focusEnds = () => [set.lens.nearest_m, Math.max(100 * set.lens.nearest_m, 50)];

/** The lens's own start: forms, focus on the subject, widest stop. */
function chooseLens(lens) {
  if (!lens.forms) Object.assign(lens, jsonOf(lens, "facts"));
  const kinds = lens.forms.map((f) => f.kind), best = ["polynomial", "network", "exact"].find((k) => kinds.includes(k));
  const last = kinds.includes("exact") && best !== "exact" ? "exact" : kinds.find((k) => k !== best) ?? "thin";
  Object.assign(set, { lens, a: kinds.includes(set.a) || set.a === "thin" ? set.a : best, clicked: null, lamp: null });
  if (!lens.ghosts && set.tool === "lamp") set.tool = "focus";
  $("lamp-tool").hidden = !lens.ghosts;
  if (!kinds.includes(set.b) && set.b !== "thin") set.b = last;
  [set.zoom] = zoomEnds();
  set.f_number = wideOf(lens, set.zoom);
  set.focus = framing().far;
  for (const id of ["a", "b"])
    $(id).replaceChildren(...[...lens.forms.map((f) => [f.kind, f.kind === "exact" ? "exact" : `${f.kind} (${f.method})`]), ["thin", "thin lens"]]
      .map(([value, text]) => new Option(text, value)));
  const [low, high] = zoomEnds();
  $("zoom-row").hidden = high - low < 1e-6 * high;
  $("about").textContent = `${lens.source}`;
}

/** Controls say what is set. */
function say() {
  const [near, far] = focusEnds(), [wide, small] = stopEnds(), [low, high] = zoomEnds();
  Object.assign($("focus"), { value: Number.isFinite(set.focus) ? Math.min(0.999, share(near, far, set.focus)) : 1 });
  $("stop").value = share(wide, small, set.f_number);
  $("zoom").value = high > low ? share(low, high, set.zoom) : 0;
  $("blades").value = set.blades || 2;
  $("light").value = set.wavelength || 395;
  for (const id of ["roundness", "wipe", "a", "b"]) $(id).value = set[id];
  $("lens").value = set.lens.key;
  for (const name of ["scene", "view", "tool"]) document.querySelector(`input[name=${name}][value=${set[name]}]`).checked = true;
  $("focus-said").value = Number.isFinite(set.focus) ? `${set.focus.toPrecision(3)} m` : "infinity";
  $("stop-said").value = `f/${set.f_number.toPrecision(2)}`;
  $("zoom-said").value = `${set.zoom.toFixed(0)} mm`;
  $("blades-said").value = set.blades || "round";
  $("roundness-said").value = `${Math.round(100 * set.roundness)} %`;
  $("light-said").value = set.wavelength ? `${set.wavelength} nm, in grey` : "white";
  $("lamp-row").hidden = set.tool !== "lamp";
  $("lamp").value = Math.log10(set.irradiance);
  $("lamp-said").value = `as ${set.irradiance.toPrecision(2)} sr of white`;
  $("lamp-mark").hidden = !set.lamp;
  if (set.lamp) Object.assign($("lamp-mark").style, { left: `${100 * set.lamp[0]}%`, top: `${100 * (1 - set.lamp[1])}%` });
  $("wipe-line").hidden = set.view !== "wipe";
  $("wipe-line").style.left = `${100 * set.wipe}%`;
  $("left-name").textContent = set.view === "difference" ? `|${NAMES[set.a]} − ${NAMES[set.b]}| × 1000` : NAMES[set.a];
  $("right-name").textContent = set.view === "wipe" ? NAMES[set.b] : "";
  $("cross").hidden = !set.clicked;
  if (set.clicked) Object.assign($("cross").style, { left: `${100 * set.clicked[0]}%`, top: `${100 * (1 - set.clicked[1])}%` });
  const form = engine.form(set.lens, set.a), files = form.kind === "thin" ? [] : form.files;
  $("downloads").replaceChildren(...files.map((kind) => Object.assign(document.createElement("button"),
    { type: "button", textContent: { glsl: "GLSL", c: "C", onnx: "ONNX", osl: "OSL" }[kind], title: `Download: ${NAMES[set.a]}`, onclick: () => download(kind) })));
  const can = form.kind === "thin" ? [] : ["glsl", "onnx", "c", "osl"].filter((kind) => kind !== "onnx" || form.kind !== "exact");
  const others = can.filter((kind) => !files.includes(kind));
  $("elsewhere").textContent = others.length ? `Not on this page: neurolens export ${form.kind === "exact" ? "LENS.toml" : "MODEL.onnx"} --to ${others.join("|")}` : "";
  facts();
}

/** The error of a form's card at this stop, nearest of those it was measured at. */
function errorAt(form) {
  const { errors, zones } = form.card, stops = 2 * Math.log2(set.f_number / wideOf(set.lens, set.zoom));
  const name = stops > 3 ? "4_stops" : stops > 1 ? "2_stops" : "full", zone = zones[name] ?? (stops > 1 ? zones["2_stops"] : zones.full);
  if (!zone) return { rms: errors.rms_um, where: "all stops" };
  const rays = Object.values(zone).filter((z) => z.rms_um !== undefined && z.rays);
  const sum = rays.reduce((s, z) => s + z.rays, 0);
  return { rms: Math.sqrt(rays.reduce((s, z) => s + z.rays * z.rms_um ** 2, 0) / sum), zone, where: zones[name] ? name.replace("_", " ").replace("full", "full stop") : "2 stops" };
}

function facts() {
  const rows = [];
  for (const side of set.view === "one" ? ["a"] : ["a", "b"]) {
    const form = engine.form(set.lens, set[side]), known = engine.sides[side]?.cost?.[`${set.lens.key}/${set[side]}`];
    const pixel_um = engine.sides.a?.values ? (1000 * engine.sides.a.values.film_mm[0]) / set.width : NaN;
    let text = form.kind === "exact" ? form.method : form.kind === "thin" ? "paraxial: no aberration, no rims" : "";
    if (form.card?.errors?.rms_um !== undefined) {
      const { rms, where } = errorAt(form), num = (v) => (v < 0.01 ? v.toExponential(1) : v.toPrecision(2));
      text = `RMS ${num(rms)} µm (${num(rms / pixel_um)} px) at ${where}; 99 % within ${num(form.card.errors.p99_um ?? NaN)} µm`;
    }
    rows.push([`${NAMES[form.kind]}: error on the film`, text]);
    rows.push([`${NAMES[form.kind]}: a ray by ${engine.gpu.name} on this GPU`, known ? `${known.toPrecision(3)} ns` : "not measured"]);
  }
  $("facts").replaceChildren(...rows.map(([name, value]) => {
    const row = document.createElement("div");
    row.append(Object.assign(document.createElement("dt"), { textContent: name }), Object.assign(document.createElement("dd"), { textContent: value }));
    return row;
  }));
}

/** Show the settings: the first sample is on the canvas when the promise is kept. Calls queue. */
function show() {
  const mine = ++turn;
  held++;
  begun = performance.now();
  say();
  busy = busy.then(async () => {
    if (mine !== turn) return;
    const { far, unit } = framing(), sides = set.view === "one" ? { a: set.a } : { a: set.a, b: set.b };
    await engine.prepare(set.lens, sides, set, sceneUniforms(set.scene, far, unit));
    await flare(far, unit, sides);
    pass();
    set.shown_ms = performance.now() - begun;
    facts();
    if (layout.lens !== set.lens) await layout.show(set.lens);
    if (set.clicked && set.tool === "rays") await rays();
  }).catch(fail).finally(() => held--);
  return busy;
}

/** The lamp and its ghosts: those that were drawn before at once, further ones with the next frames. */
async function flare(far, unit, sides) {
  ghosts.shown = 0;
  if (!set.lamp) return;
  const lamp = { towards: await engine.direction("a", set.lamp), irradiance: set.irradiance };
  await engine.prepare(set.lens, sides, set, sceneUniforms(set.scene, far, unit, lamp));
  const { width } = set, known = ghosts.known.get(set.lens) ?? 1;
  Object.assign(ghosts, { lamp, shown: known, all: await ghosts.draw(set.lens, engine.sides.a, lamp.towards, lamp.irradiance, width, (width * 9) / 16, known) });
}

/** One more ghost, until all are drawn. */
async function moreGhosts() {
  const { width } = set, { lamp, shown } = ghosts;
  if (!shown || shown >= ghosts.all) return;
  ghosts.shown = shown + 1;
  ghosts.known.set(set.lens, Math.max(ghosts.known.get(set.lens) ?? 1, shown + 1));
  await ghosts.draw(set.lens, engine.sides.a, lamp.towards, lamp.irradiance, width, (width * 9) / 16, shown + 1);
  paint();
}

/** One more sample of what is seen, and on the canvas. */
function pass() {
  sample();
  paint();
}

function sample() {
  const width = set.width, height = (width * 9) / 16, canvas = $("picture"), edge = Math.floor(set.wipe * width);
  if (canvas.width !== width) Object.assign(canvas, { width, height });
  if (set.view === "wipe") {
    engine.add("a", width, height, 0, edge);
    engine.add("b", width, height, edge, width);
  } else for (const side of set.view === "one" ? ["a"] : ["a", "b"]) engine.add(side, width, height);
}

function paint() {
  if (!engine.sides.a?.film) return;
  engine.paint(set.view, set.wipe, set.scene === "night" ? 1.8 : 1, ghosts.shown ? ghosts.film : null, ghosts.dimmed);
  const { samples } = engine.sides.a, { lens } = set;
  const flared = !set.lamp ? "" : ghosts.all ? `; ${ghosts.shown} of ${ghosts.all} ghosts, which have ${(100 * lens.ghosts.light).toFixed(1)} % of all ghosts' light, at infinite focus` : "; ghosts are drawn for lamps up to 35 degrees from the axis";
  $("said").textContent = `${samples} of ${set.most} samples a pixel${flared}`;
}

let done = null, issued = 0, passes = 1;
/** Samples while the GPU keeps up: none before it is done with the last ones, as many at a time as it takes in 25 ms. */
function frame(now) {
  requestAnimationFrame(frame);
  const side = engine.sides.a;
  if (held) return; // the sides are not all of one setting yet, or are timed
  if (done) {
    if (!done()) return;
    done = null;
    passes = now - issued < 20 ? Math.min(16, passes + 1) : now - issued > 40 ? Math.max(1, passes >> 1) : passes;
  }
  if (side?.film && ghosts.shown && ghosts.shown < ghosts.all) busy = busy.then(moreGhosts).catch(fail);
  if (!side?.film || set.still || side.samples >= set.most) return;
  for (let k = 0; k < passes && side.samples < set.most; k++) sample();
  paint();
  done = engine.gpu.fence();
  issued = now;
}

async function rays() {
  const [, film_h] = engine.sides.a.values.film_mm, [film_w] = engine.sides.a.values.film_mm;
  const [x, y] = set.clicked, height = Math.hypot((x - 0.5) * film_w, (y - 0.5) * film_h) * (y > 0.5 ? -1 : 1);
  const count = await layout.rays(height, engine.sides.a);
  $("layout-said").textContent = count === null ? (set.lens.f_numbers.length > 1 ? "The section shows one zoom position: no rays are drawn in it." : "No exact lens here: no rays can be drawn.")
    : `Image height ${Math.abs(height).toFixed(1)} mm: ${count ? "rays in the plane of axis and place, traced through every surface" : "no ray passes"}.`;
}

/** A click at a place of the picture, from its lower left. */
async function click(place) {
  set.clicked = place;
  if (set.tool === "rays") { say(); return rays(); }
  if (set.tool === "lamp") { set.lamp = place; set.clicked = null; return show(); }
  const side = set.view === "wipe" && place[0] > set.wipe ? "b" : "a";
  const far = await engine.distance(side, place), [near] = focusEnds();
  set.focus = Number.isFinite(far) ? Math.max(near, far) : Infinity;
  return show();
}

function download(kind) {
  const data = partOf(set.lens, `${set.a}/${kind}`);
  const link = Object.assign(document.createElement("a"), { href: URL.createObjectURL(new Blob([data])),
    download: `${set.lens.key}.${set.a}.${{ c: "h" }[kind] ?? kind}` });
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 1000);
}

function fail(error) {
  $("missing").textContent = error.message;
  $("missing").hidden = false;
  console.error(error);
}

function listen() {
  const on = (id, change) => $(id).addEventListener("input", () => { change($(id).value); show(); });
  on("lens", (key) => chooseLens(shared.lenses.find((l) => l.key === key)));
  on("a", (v) => (set.a = v));
  on("b", (v) => (set.b = v));
  on("wipe", (v) => (set.wipe = +v));
  on("focus", (v) => (set.focus = +v >= 1 ? Infinity : log(...focusEnds(), +v)));
  on("stop", (v) => (set.f_number = log(...stopEnds(), +v)));
  on("zoom", (v) => { set.zoom = log(...zoomEnds(), +v); set.f_number = Math.max(set.f_number, stopEnds()[0]); });
  on("blades", (v) => (set.blades = +v < 3 ? 0 : +v));
  on("roundness", (v) => (set.roundness = +v));
  on("light", (v) => (set.wavelength = +v < 400 ? 0 : +v));
  on("lamp", (v) => (set.irradiance = 10 ** +v));
  on("size", (v) => (set.width = +v));
  $("most").addEventListener("input", () => (set.most = +$("most").value));
  for (const name of ["scene", "view", "tool"])
    $(name).addEventListener("input", (event) => { set[name] = event.target.value; name === "tool" ? say() : show(); });
  $("measure").addEventListener("click", () => { measure(); });
  const place = (event) => {
    const box = $("frame").getBoundingClientRect();
    return [(event.clientX - box.left) / box.width, 1 - (event.clientY - box.top) / box.height].map((v) => Math.min(0.9999, Math.max(0, v)));
  };
  $("picture").addEventListener("click", (event) => click(place(event)));
  $("picture").addEventListener("pointermove", (event) => { if (set.tool === "lamp" && event.buttons) { event.preventDefault(); click(place(event)); } });
  const line = $("wipe-line");
  line.addEventListener("pointerdown", (event) => line.setPointerCapture(event.pointerId));
  line.addEventListener("pointermove", (event) => { if (line.hasPointerCapture(event.pointerId)) { [set.wipe] = place(event); show(); } });
  $("picture").addEventListener("keydown", (event) => {
    const step = event.shiftKey ? 0.1 : 0.02, lamp = set.tool === "lamp", at = (lamp ? set.lamp : set.clicked) ?? [0.5, 0.5];
    const moves = { ArrowLeft: [-step, 0], ArrowRight: [step, 0], ArrowUp: [0, step], ArrowDown: [0, -step] }[event.key];
    if (moves) {
      const to = at.map((v, k) => Math.min(0.9999, Math.max(0, v + moves[k])));
      if (lamp) click(to);
      else { set.clicked = to; say(); }
    }
    else if (event.key === "Enter") click(at);
    else if (event.key === "[" || event.key === "]") { set.wipe = Math.min(1, Math.max(0, set.wipe + (event.key === "[" ? -step : step))); show(); }
    else return;
    event.preventDefault();
  });
}

/** Time the forms that are seen. */
async function measure() {
  held++;
  for (const side of set.view === "one" ? ["a"] : ["a", "b"]) {
    const s = engine.sides[side], key = `${set.lens.key}/${set[side]}`;
    s.cost = { ...s.cost, [key]: await engine.cost(side) };
  }
  held--;
  facts();
}

async function begin() {
  $("version").textContent = shared.version;
  $("lens").replaceChildren(...shared.lenses.map((l) => new Option(l.name, l.key)));
  if (shared.lenses.length === 1) $("lens").disabled = true;
  try {
    const canvas = $("picture"), wanted = new URLSearchParams(location.search).get("gpu");
    engine = new Engine((wanted !== "webgl2" && (await WebGpu.made(canvas, fail))) || new Gpu(canvas), shared);
  } catch (error) {
    $("controls").inert = true;
    return fail(error);
  }
  layout = new LayoutView($("layout"), engine);
  ghosts = Object.assign(new GhostView(engine), { shown: 0, all: 0, known: new Map() });
  chooseLens(set.lens);
  listen();
  await show();
  requestAnimationFrame(frame);
}

// For tests and the curious.
window.neurolens = { set, show, pass, idle: () => busy, click, measure, framing, chooseLens, shared, sceneUniforms, ready: begin(), get engine() { return engine; }, get layout() { return layout; }, get ghosts() { return ghosts; } };
