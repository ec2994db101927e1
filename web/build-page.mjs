// Builds the page that registers in the browser: one file, with script, worker, WebAssembly module and samples inside.
// `npm run page` writes it to target/web/index.html.
import { spawnSync } from "node:child_process";
import { mkdir, readFile, writeFile } from "node:fs/promises";
import { join } from "node:path";
import { brotliCompressSync, gzipSync } from "node:zlib";

import { bundle, licences, sha256, web } from "./bundle.mjs";

const root = join(web, "..");
const { CARGO_TARGET_DIR: target = join(root, "target") } = process.env;

/** @param {string} program
 *  @param {string[]} args
 *  @param {Record<string, string>} env */
function run(program, args, env = {}) {
  const { status, error } = spawnSync(program, args, { cwd: root, stdio: "inherit", env: { ...process.env, ...env } });
  if (error || status !== 0) throw error ?? new Error(`${program} ${args.join(" ")} ended with ${status}`);
}

run("cargo", ["build", "--locked", "--package", "upcr-web", "--profile", "web", "--target", "wasm32-unknown-unknown"],
  { CARGO_TARGET_WASM32_UNKNOWN_UNKNOWN_RUSTFLAGS: "-C target-feature=+simd128" });
run("cargo", ["run", "--quiet", "--release", "--locked", "--manifest-path", "web/bindgen/Cargo.toml", "--",
  join(target, "wasm32-unknown-unknown/web/upcr_web.wasm"), "web/app/module"], { CARGO_TARGET_DIR: join(target, "bindgen") });

/** @param {Buffer} bytes */
const packed = (bytes) => gzipSync(bytes, { level: 9 }).toString("base64");
/** @param {string} id
 *  @param {string | Buffer} text */
const held = (id, text) => `<script type="text/plain" id="${id}">${text}</script>\n`;

const script = await bundle("app/main.ts", await licences());
const worker = await bundle("app/worker.ts");
const module = await readFile(join(web, "app/module/upcr_web_bg.wasm"));
const samples = await Promise.all(["source.ply", "target.ply"].map(async (name) =>
  held(name, packed(await readFile(join(root, "samples", name))))));

// Nothing is fetched and nothing is sent, by the page or by its worker, which has the page's policy.
const html = `<!doctype html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<meta name="color-scheme" content="light dark">
<meta name="description" content="Registers two 3-D scans in the browser. The files stay on the machine.">
<meta http-equiv="Content-Security-Policy" content="default-src 'none'; script-src 'sha256-${sha256(script)}' 'wasm-unsafe-eval'; \
worker-src blob:; base-uri 'none'; form-action 'none'">
<title>UPCR: register two scans</title>
</head>
<body>
<noscript>Scans are registered by the page's own script, and scripts are turned off here.</noscript>
${held("module", packed(module))}${held("worker", worker)}${samples.join("")}<script>${script}</script>
</body>
</html>
`;
await mkdir(join(target, "web"), { recursive: true });
await writeFile(join(target, "web/index.html"), html);
const mb = (/** @type {number} */ bytes) => `${(bytes / 1e6).toFixed(2)} MB`;
console.log(`index.html: ${mb(html.length)}; compressed with gzip ${mb(gzipSync(html).length)}, with brotli ${mb(brotliCompressSync(html).length)};`
  + ` module ${mb(module.length)}`);
