// Shaders in WGSL. The page's own and those of lenses are written once, in a part of GLSL of which each line has one of
// WGSL: one number with a value a declaration, braces around what an if or a loop does, "= a ? b : c;" as a whole
// line, uniforms of no truth values, arguments that stay as they are. Words that WGSL reserves are no names.
const WORDS = { float: "f32", int: "i32", uint: "u32", vec2: "vec2f", vec3: "vec3f", vec4: "vec4f", ivec2: "vec2i",
  texelFetch: "textureLoad", textureSize: "textureDimensions", inversesqrt: "inverseSqrt", atan: "atan2" };
const BUILT_IN = "var<private> gl_FragCoord: vec4f;\nvar<private> gl_Position: vec4f;\nvar<private> gl_VertexID: i32;\n";

const bare = (text) => text.replace(/\/\*[^]*?\*\/|\/\/.*/g, "");

/** The uniforms of shaders by name: textures with their number, others with their place in a buffer, in floats. */
function uniformsOf(...texts) {
  const found = new Map();
  let end = 1, textures = 0; // the buffer's first number is the canvas's height, 0 for other targets
  for (const [, type, names] of bare(texts.join("\n")).matchAll(/\buniform (?:highp )?(\w+) ([^;]+);/g))
    for (const [, name, count] of names.matchAll(/(\w+)(?:\[(\d+)\])?/g)) {
      if (found.has(name)) continue;
      if (type === "sampler2D") found.set(name, { texture: ++textures });
      else {
        const size = +type.at(-1) || 1, align = count ? 4 : [1, 2, 4, 4][size - 1], at = Math.ceil(end / align) * align;
        found.set(name, { type, size, count, at, whole: type[0] === "i" });
        end = at + (count ? 4 * count : size);
      }
    }
  return { found, length: Math.ceil(end / 4) * 4 };
}

/** A shader of GLSL in WGSL, with its entry point; `uniforms` of it and of the other shader of its program. */
function wgslOf(glsl, uniforms, vertex) {
  let text = bare(glsl).replace(/^#define .*/gm, "").replace(/\w+_FMA\(/g, "fma(").replace(/\buniform [^;]+;/g, "");
  const places = [], own = (name) => `${name}: ${uniforms.found.get(name).type}`;
  text = text.replace(/^\s*(?:layout\(.*\) )?(flat )?(in|out) (\w+) (\w+);/gm, (_, flat, way, type, name) => {
    places.push({ way, name, said: `@location(${places.filter((p) => p.way === way).length}) ${flat ? "@interpolate(flat) " : ""}${name}: ${type}` });
    return `var<private> ${name}: ${type};`;
  });
  const types = `(float|int|uint|bool|[ui]?vec[234]${[...text.matchAll(/struct (\w+)/g)].map(([, name]) => `|${name}`).join("")})`;
  const matched = (pattern, flags = "gm") => new RegExp(pattern.replaceAll("TYPE", types), flags);
  const typed = (list) => list.replace(matched("(?:in |out )?TYPE (\\w+)"), "$2: $1");
  text = text.replace(/(struct \w+ \{)([^}]*)\};/g, (_, head, fields) => head + fields.replace(matched("TYPE (\\w+)\\[(\\d+)\\];"), "$2: array<$1, $3>,").replace(matched("TYPE (\\w+);"), "$2: $1,") + "}");
  // The results of a function are a structure, of which its call takes them.
  for (const [whole, name, list, body] of text.matchAll(/^void (\w+)\(([^)]*\bout [^)]*)\)\s*\{([^]*?)^\}/gm)) {
    const given = list.split(",").map((a) => a.trim()), results = given.filter((a) => a.startsWith("out ")), names = results.map((a) => a.split(" ").at(-1));
    const inputs = given.slice(0, given.length - results.length);
    text = text.replace(whole, () => `struct ${name}_ray { ${typed(results.join(", "))} }
fn ${name}(${typed(inputs.join(", "))}) -> ${name}_ray {
${results.map((a) => `    ${a.slice(4)};\n`).join("")}${body}    return ${name}_ray(${names.join(", ")});
}`).replace(new RegExp(`\\b${name}\\(((?:[^()]|\\([^()]*\\))*)\\);`, "g"), (_, call) => {
      const places = call.split(", "), first = places.length - names.length;
      return `{ let ray = ${name}(${places.slice(0, first).join(", ")}); ${names.map((n, k) => `${places[first + k]} = ray.${n};`).join(" ")} }`;
    });
  }
  text = text.replace(matched("^\\s*(?:void|TYPE) (\\w+)\\(([^)]*)\\)\\s*\\{"), (_, type, name, list) => `\nfn ${name}(${typed(list)})${type ? ` -> ${type}` : ""} {`)
    .replace(/ = (.+) \? (.+) : (.+);$/gm, " = select($3, $2, $1);")
    .replace(matched("^TYPE (\\w+);"), "var<private> $2: $1;")
    .replace(matched("^const TYPE (\\w+)\\[\\d+\\] = \\w+\\[(\\d+)\\]\\("), "var<private> $2: array<$1, $3> = array<$1, $3>(")
    .replace(matched("^const TYPE (\\w+) ="), "const $2: $1 =")
    .replace(matched("\\bTYPE (\\w+)\\[\\d+\\] = \\w+\\[(\\d+)\\]\\("), "var $2 = array<$1, $3>(")
    .replace(matched("\\bTYPE (\\w+)\\[(\\d+)\\];"), "var $2: array<$1, $3>;")
    .replace(matched("\\bTYPE (t\\d+) ="), "let $2: $1 =")
    .replace(matched("\\bTYPE (\\w+) ="), "var $2: $1 =")
    .replace(matched("\\bTYPE (\\w+(?:, \\w+)*);"), (_, type, names) => names.split(", ").map((name) => `var ${name}: ${type};`).join(" "));
  const fields = [], numbers = [];
  let bound = "";
  for (const [name, { type, texture, count }] of uniforms.found)
    if (texture) bound += `@group(0) @binding(${texture}) var ${name}: texture_2d<f32>;\n`;
    else if (count) {
      fields.push(`${name}: array<${type}, ${count}>`);
      text = text.replace(new RegExp(`\\b${name}\\[`, "g"), `uniforms_.${name}[`);
    } else {
      fields.push(own(name));
      numbers.push(name);
      bound += `var<private> ${own(name)};\n`;
    }
  const lines = (way) => places.filter((p) => p.way === way), results = lines("out"), inputs = lines("in");
  const said = [...vertex ? ["@builtin(position) position: vec4f"] : [], ...results.map((p) => p.said)].join(", ");
  const values = [...vertex ? ["vec4f(gl_Position.x, -gl_Position.y, gl_Position.zw)"] : [], ...results.map((p) => p.name)].join(", ");
  const first = vertex ? "@builtin(vertex_index) index_: u32" : "@builtin(position) at_: vec4f";
  const known = vertex ? "gl_VertexID = i32(index_);" : "gl_FragCoord = vec4f(at_.x, abs(uniforms_.rows_ - at_.y), at_.zw);";
  text = `struct Uniforms_ { ${["rows_: f32", ...fields].join(", ")} }
@group(0) @binding(0) var<uniform> uniforms_: Uniforms_;
${bound}${BUILT_IN}${text}
struct Results_ { ${said} }
@${vertex ? "vertex" : "fragment"} fn entry_(${[first, ...inputs.map((p) => p.said.replace(`${p.name}:`, `given_${p.name}:`))].join(", ")}) -> Results_ {
  ${known}
  ${[...numbers.map((name) => `${name} = uniforms_.${name};`), ...inputs.map((p) => `${p.name} = given_${p.name};`)].join(" ")}
  main();
  return Results_(${values});
}`;
  return text.replace(/\b[a-zA-Z]\w*(?=[\s(),;>])/g, (word) => WORDS[word] ?? word);
}
