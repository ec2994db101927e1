// How long the sample pair takes in the browser, beside the binary: `npm run bench`.
import { rmSync } from "node:fs";
import { join } from "node:path";

import { built, launch, open, samples, scratch, upcr } from "./tests/tools.mjs";

const RUNS = 9;
const [source, target] = [join(samples, "source.ply"), join(samples, "target.ply")];

/** Registers as often with the binary, each time in a process of its own.
 *  @param {string} threads */
function native(threads) {
  return Array.from({ length: RUNS }, () =>
    /** @type {number} */ (JSON.parse(upcr("register", source, target, "--json", "--threads", threads)).timings_ms.total));
}

/** @param {readonly number[]} times */
function told(times) {
  const sorted = [...times].sort((a, b) => a - b);
  return `${sorted[0]?.toFixed(0)} to ${sorted.at(-1)?.toFixed(0)} ms, median ${sorted[sorted.length >> 1]?.toFixed(0)}`;
}

const browser = await launch();
/** @type {number[]} */
const first = [];
/** @type {number[]} */
const later = [];
for (let i = 0; i < RUNS; i += 1) {
  // A context of its own has nothing compiled.
  const { page, close } = await open(browser, built);
  for (const times of [first, later, later, later]) {
    await page.locator("#file-0").setInputFiles(source);
    if (times === first) await page.locator("#file-1").setInputFiles(target);
    await page.locator("canvas").waitFor();
    times.push(await page.evaluate(() => Number(document.documentElement.dataset["ms"])));
    await page.getByRole("button", { name: "Files and settings" }).click();
  }
  await close();
}
await browser.close();
rmSync(scratch, { recursive: true });
console.log(`binary, one thread:  ${told(native("1"))}`);
console.log(`binary, two threads: ${told(native("2"))}`);
console.log(`browser, first pair: ${told(first)}`);
console.log(`browser, later ones: ${told(later)}`);
