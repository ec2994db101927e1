// Builds what the crate `upcr-report` holds: one script, and the hash by which a page lets it run and no other.
// `--check` compares instead of writing.
import { createHash } from "node:crypto";
import { readFile, writeFile } from "node:fs/promises";
import { fileURLToPath } from "node:url";

import { build } from "esbuild";

const web = fileURLToPath(new URL(".", import.meta.url));
const assets = new URL("../crates/upcr-report/assets/", import.meta.url);

const licence = await readFile(new URL("node_modules/three/LICENSE", import.meta.url), "utf8");
const { outputFiles: [bundle] } = await build({
  absWorkingDir: web,
  entryPoints: ["report/main.ts"],
  bundle: true,
  minify: true,
  format: "iife",
  target: "es2022",
  charset: "ascii",
  legalComments: "none",
  loader: { ".css": "text" },
  // Every page is a copy of the library, so its licence goes along.
  banner: { js: `/* Contains three.js:\n${licence.trim().replaceAll("\r", "")}\n*/` },
  write: false,
});
if (!bundle) throw new Error("nothing was built");
const script = Buffer.from(bundle.contents);
// Inside an HTML page a script ends at the first of these, whatever it means to JavaScript.
for (const end of ["</script", "<!--", "\r"]) {
  if (script.includes(end)) throw new Error(`the bundle has ${JSON.stringify(end)}`);
}
const made = { "viewer.js": script, "viewer.sha256": Buffer.from(createHash("sha256").update(script).digest("base64")) };

for (const [name, bytes] of Object.entries(made)) {
  const path = new URL(name, assets);
  if (!process.argv.includes("--check")) {
    await writeFile(path, bytes);
  } else if (!bytes.equals(await readFile(path))) {
    throw new Error(`${fileURLToPath(path)} is not what its sources build: run \`npm run build\` in web/`);
  }
  console.log(`${name}: ${bytes.length} bytes`);
}
