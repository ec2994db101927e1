// A browser that records what a page does wrong, the command line, and clouds to give it.
import { spawnSync } from "node:child_process";
import { mkdtempSync, rmSync, writeFileSync } from "node:fs";
import { tmpdir } from "node:os";
import { join } from "node:path";
import { after, before } from "node:test";
import { fileURLToPath, pathToFileURL } from "node:url";

import { chromium } from "playwright-core";
import { PNG } from "pngjs";

const root = fileURLToPath(new URL("../..", import.meta.url));
export const samples = join(root, "samples");
/** The page that registers, as `npm run page` builds it. */
export const built = join(process.env["CARGO_TARGET_DIR"] ?? join(root, "target"), "web/index.html");
export const scratch = mkdtempSync(join(tmpdir(), "upcr-web-"));

/** @returns {string} what `upcr` prints; exit status 3, no trustworthy pose, is an answer too
 *  @param {string[]} args */
export function upcr(...args) {
  const { UPCR = join(root, "target/release/upcr") } = process.env;
  const { status, stdout, stderr, error } = spawnSync(UPCR, args, { encoding: "utf8", maxBuffer: 1 << 26 });
  if (error || (status !== 0 && status !== 3)) throw error ?? new Error(stderr);
  return stdout;
}

/** Draws without a graphics card, on any machine. */
export async function launch() {
  return chromium.launch({
    executablePath: process.env["CHROMIUM"] ?? "/usr/bin/chromium",
    args: ["--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"],
  });
}

/** A browser for the tests of a file, and at their end none, and no scratch folder; `open` is the one below, in it. */
export function inBrowser() {
  /** @type {import("playwright-core").Browser} */
  let browser;
  before(async () => {
    browser = await launch();
  });
  after(async () => {
    await browser.close();
    rmSync(scratch, { recursive: true });
  });
  return (/** @type {string} */ path, options = {}, script = "") => open(browser, path, options, script);
}

/** Opens a page from its file, or from a server, and waits until it stands.
 *  @param {import("playwright-core").Browser} browser
 *  @param {string} path
 *  @param {import("playwright-core").BrowserContextOptions} options
 *  @param {string} script run in the page before its own */
export async function open(browser, path, options = {}, script = "") {
  const context = await browser.newContext({ viewport: { width: 1000, height: 700 }, reducedMotion: "reduce", ...options });
  await context.grantPermissions(["clipboard-read", "clipboard-write"]);
  const page = await context.newPage();
  /** @type {string[]} */
  const wrong = [];
  const url = path.startsWith("http:") ? path : pathToFileURL(path).href;
  page.on("console", (message) => {
    // What the driver says of tests that read pixels back is no fault of the page.
    if (["error", "warning"].includes(message.type()) && !message.text().includes("GPU stall")) wrong.push(message.text());
  });
  page.on("pageerror", (error) => wrong.push(String(error)));
  page.on("dialog", (dialog) => {
    wrong.push(`dialog: ${dialog.message()}`);
    void dialog.dismiss();
  });
  page.on("request", (request) => {
    // What a page makes itself comes from nowhere.
    if (request.url() !== url && !request.url().startsWith("blob:")) wrong.push(`request: ${request.url()}`);
  });
  if (script) await page.addInitScript(script);
  await page.goto(url);
  await page.waitForSelector("html[data-ready]", { timeout: 120_000 });
  await settle(page);
  return { page, wrong, close: () => context.close() };
}

/** Waits until what was asked for is drawn.
 *  @param {import("playwright-core").Page} page */
export async function settle(page) {
  await page.waitForTimeout(300);
  await page.evaluate(() => new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done))));
}

/** Red, green, blue of each pixel of the picture, as it is on the screen.
 *  @param {import("playwright-core").Page} page */
export async function pixels(page) {
  const { data } = PNG.sync.read(await page.locator("#stage").screenshot());
  return data.filter((_, i) => i % 4 !== 3);
}

/** The share of pixels that differ.
 *  @param {Uint8Array} a
 *  @param {Uint8Array} b */
export function difference(a, b) {
  if (a.length !== b.length) return 1;
  let differ = 0;
  for (let i = 0; i < a.length; i += 3) {
    if (Math.abs((a[i] ?? 0) - (b[i] ?? 0)) + Math.abs((a[i + 1] ?? 0) - (b[i + 1] ?? 0)) + Math.abs((a[i + 2] ?? 0) - (b[i + 2] ?? 0)) > 24) differ += 1;
  }
  return differ / (a.length / 3);
}

/** The share of pixels that are nearer to `color` than to grey or white.
 *  @param {Uint8Array} image
 *  @param {"orange" | "blue" | "yellow"} color */
export function share(image, color) {
  let held = 0;
  for (let i = 0; i < image.length; i += 3) {
    const [r, g, b] = [image[i] ?? 0, image[i + 1] ?? 0, image[i + 2] ?? 0];
    if (color === "orange" && r > b + 60 && r > g + 30) held += 1;
    if (color === "blue" && b > r + 50) held += 1;
    if (color === "yellow" && Math.min(r, g) > b + 60) held += 1;
  }
  return held / (image.length / 3);
}

/** A binary PLY of so many points.
 *  @param {string} name
 *  @param {number} count
 *  @param {(i: number) => [number, number, number]} point
 *  @param {string} comment */
export function ply(name, count, point, comment = "made by a test") {
  const header = `ply\nformat binary_little_endian 1.0\ncomment ${comment}\nelement vertex ${count}\n`
    + "property double x\nproperty double y\nproperty double z\nend_header\n";
  const points = new Float64Array(3 * count);
  for (let i = 0; i < count; i += 1) points.set(point(i), 3 * i);
  const path = join(scratch, name);
  writeFileSync(path, Buffer.concat([Buffer.from(header), Buffer.from(points.buffer)]));
  return path;
}

/** Numbers of [0, 1) that repeat.
 *  @param {number} seed */
export function random(seed) {
  let state = seed >>> 0;
  return () => {
    state = (Math.imul(state, 1_664_525) + 1_013_904_223) >>> 0;
    return state / 2 ** 32;
  };
}

/** Two scans of a square table: four poses explain them alike.
 *  @param {string} name
 *  @param {number} seed
 *  @param {[number, number, number]} at */
export function table(name, seed, at = [0, 0, 0]) {
  const next = random(seed);
  return ply(name, 6000, (i) => {
    const noise = () => 0.002 * (next() + next() - 1);
    const jitter = [noise(), noise(), noise()];
    let p = [next() - 0.5, next() - 0.5, 0.7];
    if (i >= 3000) {
      const [side, u, h] = [Math.floor(4 * next()), 0.08 * next() - 0.04, 0.7 * next()];
      const [sx, sy] = [next() < 0.5 ? -0.45 : 0.45, next() < 0.5 ? -0.45 : 0.45];
      p = [sx + ([-0.04, 0.04, u, u][side] ?? 0), sy + ([u, u, -0.04, 0.04][side] ?? 0), h];
    }
    return /** @type {[number, number, number]} */ (p.map((v, k) => v + (jitter[k] ?? 0) + (at[k] ?? 0)));
  });
}

