// The pictures of the guide, of the sample pair and of a table that looks alike from four sides: `npm run screenshots`.
import { rmSync } from "node:fs";
import { join } from "node:path";
import { fileURLToPath } from "node:url";

import { built, launch, open, samples, scratch, settle, table, upcr } from "./tests/tools.mjs";

const docs = fileURLToPath(new URL("../docs/guide/", import.meta.url));
const size = { width: 1100, height: 700 };
const phone = { viewport: { width: 390, height: 760 }, isMobile: true, hasTouch: true };
const browser = await launch();

/** @param {string} name
 *  @param {string} path
 *  @param {import("playwright-core").BrowserContextOptions} options
 *  @param {(page: import("playwright-core").Page) => Promise<void>} act */
async function shoot(name, path, options, act) {
  const { page, close } = await open(browser, path, { viewport: size, ...options });
  await act(page);
  await settle(page);
  await page.screenshot({ path: join(docs, name) });
  await close();
}

/** @param {readonly string[]} keys */
const press = (...keys) => async (/** @type {import("playwright-core").Page} */ page) => {
  for (const key of keys) await page.keyboard.press(key);
};

const sample = join(scratch, "sample.html");
process.chdir(samples);
upcr("register", "source.ply", "target.ply", "--report", sample);
await shoot("report.png", sample, {}, press("]"));
await shoot("report-distances.png", sample, { colorScheme: "dark" }, press("s", "r", "]"));

const twofold = join(scratch, "table.html");
const scans = [table("table-1.ply", 1), table("table-2.ply", 2)];
process.chdir(scratch);
upcr("register", ...scans.map((path) => path.slice(scratch.length + 1)), "--report", twofold);
await shoot("report-alternatives.png", twofold, {}, press("1", "]"));
await shoot("report-phone.png", sample, phone, press());

// Scans of a room, of which one is of another.
const room = join(scratch, "room");
upcr("synth", "--scene", "room", "--scans", "14", "--size", "320x240", "--seed", "5", "--out", room);
upcr("merge", room, join(samples, "source.ply"), "-o", join(scratch, "model.ply"), "--report", join(scratch, "merge.html"));
const wide = { viewport: { width: 1280, height: 800 } };
await shoot("merge.png", join(scratch, "merge.html"), wide, press("]"));
await shoot("merge-pair.png", join(scratch, "merge.html"), { ...wide, colorScheme: "dark" }, async (page) => {
  // What a camera sees has −y up.
  await page.getByText("Display").click();
  await page.getByRole("button", { name: "−y" }).click();
  await page.keyboard.press("Escape");
  await page.getByRole("row").filter({ hasText: "dropped" }).first().click();
});

await shoot("page.png", built, { viewport: { width: 1100, height: 560 } }, press());
/** @param {import("playwright-core").Page} page */
const registered = async (page) => {
  await page.getByRole("button", { name: "Try the samples" }).click();
  await page.locator("canvas").waitFor();
};
await shoot("page-registered.png", built, {}, async (page) => {
  await registered(page);
  await press("]")(page);
});
await shoot("page-phone.png", built, { ...phone, colorScheme: "dark" }, press());
await browser.close();
rmSync(scratch, { recursive: true });
