// The data files of LensVisualizer as one JSON list: node patent_lenses.mjs CLONE/src/lens-data OUT.json (npm install esbuild@0.25)
// Each file is bundled to plain JavaScript, for some compute their figures, and runs without access to anything.
import { buildSync } from "esbuild";
import { readdirSync, readFileSync, writeFileSync } from "node:fs";
import { join } from "node:path";
import { runInNewContext } from "node:vm";

const [folder, out] = process.argv.slice(2);
const files = readdirSync(folder, { recursive: true }).filter((name) => name.endsWith(".data.ts")).sort();
const lenses = files.map((file) => {
  const path = join(folder, file);
  const { text } = buildSync({ entryPoints: [path], bundle: true, write: false, format: "cjs" }).outputFiles[0];
  const module = { exports: {} };
  runInNewContext(text, { module, exports: module.exports });
  return { file, head: readFileSync(path, "utf8").split("const LENS_DATA")[0], ...module.exports.default };
});
writeFileSync(out, JSON.stringify(lenses));
console.log(`${lenses.length} lenses in ${out}`);
