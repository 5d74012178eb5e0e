// Shaders in WGSL. The page's own and those of lenses are written once, in a part of GLSL each line of which has its like
// in WGSL: a declaration is of one number, what an if or a loop does stands in braces, "= a ? b : c;" ends a line,
// arguments keep their values, no uniform is a truth value, no variable has a uniform's name or a word reserved in WGSL.
const WORDS = { float: "f32", int: "i32", uint: "u32", vec2: "vec2f", vec3: "vec3f", vec4: "vec4f", ivec2: "vec2i",
  texelFetch: "textureLoad", textureSize: "textureDimensions", inversesqrt: "inverseSqrt", atan: "atan2" };
const LINES = [ // patterns of GLSL, where TYPE is any type, and what they become; types keep their words until all is done
  ["^#define .*|\\buniform [^;]+;", ""],
  ["\\w+_FMA\\(", "fma("],
  [" = (.+) \\? (.+) : (.+);$", " = select($3, $2, $1);"],
  ["^TYPE (\\w+);", "var<private> $2: $1;"],
  ["^const TYPE (\\w+)\\[\\d+\\] = \\w+\\[(\\d+)\\]\\(", "var<private> $2 = array<$1, $3>("],
  ["^const TYPE (\\w+) =", "const $2: $1 ="],
  ["\\bTYPE (\\w+)\\[\\d+\\] = \\w+\\[(\\d+)\\]\\(", "var $2 = array<$1, $3>("],
  ["\\bTYPE (\\w+)\\[(\\d+)\\];", "var $2: array<$1, $3>;"],
  ["\\bTYPE (t\\d+) =", "let $2: $1 ="],
  ["\\bTYPE (\\w+) =", "var $2: $1 ="],
  ["\\bTYPE (\\w+);", "var $2: $1;"],
];

const bare = (text) => text.replace(/\/\*[^]*?\*\/|\/\/.*/g, "");

/** The uniforms of shaders by name: textures with their binding, others with their place in a buffer, in numbers; its length. */
function uniformsOf(...texts) {
  const found = new Map();
  let end = 1, textures = 0; // the buffer begins with the height of a canvas, whose rows WebGPU counts from above, or 0
  for (const [, type, names] of bare(texts.join("\n")).matchAll(/\buniform (?:highp )?(\w+) ([^;]+);/g))
    for (const [, name, count] of names.matchAll(/(\w+)(?:\[(\d+)\])?/g)) {
      if (found.has(name)) continue;
      if (type === "sampler2D") found.set(name, { texture: ++textures });
      else {
        const size = +type.at(-1) || 1, step = count || size === 3 ? 4 : size, at = Math.ceil(end / step) * step;
        found.set(name, { type, size, count, at, step, whole: type.startsWith("i") });
        end = at + (count ? 4 * count : size);
      }
    }
  return { found, length: 4 * Math.ceil(end / 4) };
}

/**
 * Functions with results as arguments give a structure instead, from which calls take them. Their arguments that have
 * the name of a uniform get another, and so do the functions themselves: lenses are called as their files are.
 */
function withResults(text, typed, uniforms) {
  for (const [whole, name, list, body] of text.matchAll(/^void (\w+)\(([^)]*\bout [^)]*)\)\s*\{([^]*?)^\}/gm)) {
    const all = list.split(",").map((a) => a.trim()), results = all.filter((a) => a.startsWith("out ")), inputs = all.slice(0, -results.length);
    const last = (a) => a.split(" ").at(-1), names = results.map(last), taken = inputs.map(last).filter((n) => uniforms.has(n));
    const own = (code) => taken.reduce((t, n) => t.replace(new RegExp(`\\b${n}\\b`, "g"), `${n}_`), code);
    const call = new RegExp(`\\b${name}\\(((?:[^()]|\\([^()]*\\))*)\\);`, "g");
    text = text.replace(whole, () => `struct ${name}_ray { ${typed(results.join(", "))} }
fn ${name}_(${own(typed(inputs.join(", ")))}) -> ${name}_ray {
${results.map((a) => `    ${a.slice(4)};\n`).join("")}${own(body)}    return ${name}_ray(${names.join(", ")});
}`).replace(call, (_, given) => {
      const values = given.split(", "), places = values.splice(inputs.length);
      return `{ let ray = ${name}_(${values.join(", ")}); ${names.map((n, k) => `${places[k]} = ray.${n};`).join(" ")} }`;
    });
  }
  return text;
}

/** A shader of GLSL in WGSL, with its entry point; `uniforms` are those of its program. */
function wgslOf(glsl, uniforms, vertex) {
  const structs = [...glsl.matchAll(/^\s*struct (\w+)/gm)].map(([, name]) => name);
  const types = `(${["float", "int", "uint", "bool", "vec2", "vec3", "vec4", "ivec2", ...structs].join("|")})`;
  const pattern = (text) => new RegExp(text.replace("TYPE", types), "gm");
  const typed = (list) => list.replace(pattern("(?:in |out )?TYPE (\\w+)"), "$2: $1");
  const passed = { in: [], out: [] }; // from vertices to pixels, and results
  let text = bare(glsl).replace(/^\s*(?:layout\(.*\) )?(flat )?(in|out) (\w+) (\w+);/gm, (_, flat, way, type, name) => {
    passed[way].push({ name, type, place: `@location(${passed[way].length})${flat ? " @interpolate(flat)" : ""}` });
    return `\n${type} ${name};`;
  });
  text = text.replace(/(struct \w+ \{)([^}]*)\};/g, (_, head, fields) =>
    head + fields.replace(pattern("TYPE (\\w+)\\[(\\d+)\\];"), "$2: array<$1, $3>,").replace(pattern("TYPE (\\w+);"), "$2: $1,") + "}");
  text = withResults(text, typed, uniforms).replace(pattern("^\\s*(?:void|TYPE) (\\w+)\\(([^)]*)\\)\\s*\\{"),
    (_, type, name, list) => `\nfn ${name}(${typed(list)})${type ? ` -> ${type}` : ""} {`);
  for (const [from, to] of LINES) text = text.replace(pattern(from), to);
  const fields = ["rows_: f32"], bound = [];
  for (const [name, { type, texture, count }] of uniforms)
    if (texture) bound.push(`@group(0) @binding(${texture}) var ${name}: texture_2d<f32>;`);
    else {
      fields.push(`${name}: ${count ? `array<${type}, ${count}>` : type}`);
      text = text.replace(new RegExp(`(?<![.])\\b${name}\\b`, "g"), `uniforms_.${name}`);
    }
  const results = passed.out.map(({ name, type, place }) => `${place} ${name}: ${type}`), values = passed.out.map(({ name }) => name);
  const given = passed.in.map(({ name, type, place }) => `${place} ${name}_: ${type}`), known = passed.in.map(({ name }) => `${name} = ${name}_;`);
  if (vertex) {
    results.unshift("@builtin(position) position_: vec4f");
    values.unshift("vec4f(gl_Position.x, -gl_Position.y, gl_Position.zw)");
    given.unshift("@builtin(vertex_index) at_: u32");
    known.unshift("gl_VertexID = i32(at_);");
  } else {
    given.unshift("@builtin(position) at_: vec4f");
    known.unshift("gl_FragCoord = vec4f(at_.x, abs(uniforms_.rows_ - at_.y), at_.zw);");
  }
  return `struct Uniforms_ { ${fields.join(", ")} }
@group(0) @binding(0) var<uniform> uniforms_: Uniforms_;
${bound.join("\n")}
var<private> gl_FragCoord: vec4f;
var<private> gl_Position: vec4f;
var<private> gl_VertexID: i32;
${text}
struct Results_ { ${results.join(", ")} }
@${vertex ? "vertex" : "fragment"} fn entry_(${given.join(", ")}) -> Results_ {
  ${known.join("\n  ")}
  main();
  return Results_(${values.join(", ")});
}`.replace(/\b[a-z]\w*(?=[\s(),;>])/g, (word) => WORDS[word] ?? word);
}
