// Builds what the crate `upcr-report` holds: one script, and the hash by which a page lets it run and no other.
// `--check` compares instead of writing.
import { readFile, writeFile } from "node:fs/promises";
import { fileURLToPath } from "node:url";

import { bundle, licences, sha256 } from "./bundle.mjs";

const assets = new URL("../crates/upcr-report/assets/", import.meta.url);
const script = await bundle("report/main.ts", await licences());
const made = { "viewer.js": script, "viewer.sha256": Buffer.from(sha256(script)) };

for (const [name, bytes] of Object.entries(made)) {
  const path = new URL(name, assets);
  if (!process.argv.includes("--check")) {
    await writeFile(path, bytes);
  } else if (!bytes.equals(await readFile(path))) {
    throw new Error(`${fileURLToPath(path)} is not what its sources build: run \`npm run build\` in web/`);
  }
  console.log(`${name}: ${bytes.length} bytes`);
}
