// Scripts as pages hold them: one each, with what they stand on, and fit to stand inside HTML.
import { createHash } from "node:crypto";
import { readFile } from "node:fs/promises";
import { fileURLToPath } from "node:url";

import { build } from "esbuild";

export const web = fileURLToPath(new URL(".", import.meta.url));

/** @param {string} entry
 *  @param {string} [banner] */
export async function bundle(entry, banner = "") {
  const { outputFiles: [made] } = await build({
    absWorkingDir: web,
    entryPoints: [entry],
    bundle: true,
    minify: true,
    format: "iife",
    target: "es2022",
    charset: "ascii",
    legalComments: "none",
    loader: { ".css": "text" },
    // Modules are handed over, never fetched from beside the script.
    define: { "import.meta.url": '""' },
    banner: { js: banner },
    write: false,
  });
  if (!made) throw new Error("nothing was built");
  const script = Buffer.from(made.contents);
  // Inside an HTML page a script ends at the first of these, whatever it means to JavaScript.
  for (const end of ["</script", "<!--", "\r"]) {
    if (script.includes(end)) throw new Error(`the bundle has ${JSON.stringify(end)}`);
  }
  return script;
}

/** Every page is a copy of the library, so its licence goes along. */
export async function licences() {
  const three = await readFile(new URL("node_modules/three/LICENSE", import.meta.url), "utf8");
  return `/* Contains three.js:\n${three.trim().replaceAll("\r", "")}\n*/`;
}

/** @param {Buffer} script */
export function sha256(script) {
  return createHash("sha256").update(script).digest("base64");
}
