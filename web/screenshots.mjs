// The pictures of the guide, of the sample pair and of a table that looks alike from four sides: `npm run screenshots`.
import { rmSync } from "node:fs";
import { join } from "node:path";
import { fileURLToPath } from "node:url";

import { launch, open, samples, scratch, settle, table, upcr } from "./tests/tools.mjs";

const docs = fileURLToPath(new URL("../docs/guide/", import.meta.url));
const size = { width: 1100, height: 700 };
const browser = await launch();

/** @param {string} name
 *  @param {string} report
 *  @param {import("playwright-core").BrowserContextOptions} options
 *  @param {readonly string[]} keys */
async function shoot(name, report, options, keys) {
  const { page, close } = await open(browser, report, { viewport: size, ...options });
  for (const key of keys) await page.keyboard.press(key);
  await settle(page);
  await page.screenshot({ path: join(docs, name) });
  await close();
}

const sample = join(scratch, "sample.html");
process.chdir(samples);
upcr("register", "source.ply", "target.ply", "--report", sample);
await shoot("report.png", sample, {}, ["]"]);
await shoot("report-distances.png", sample, { colorScheme: "dark" }, ["s", "r", "]"]);

const twofold = join(scratch, "table.html");
const scans = [table("table-1.ply", 1), table("table-2.ply", 2)];
process.chdir(scratch);
upcr("register", ...scans.map((path) => path.slice(scratch.length + 1)), "--report", twofold);
await shoot("report-alternatives.png", twofold, {}, ["1", "]"]);
await shoot("report-phone.png", sample, { viewport: { width: 390, height: 760 }, isMobile: true, hasTouch: true }, []);
await browser.close();
rmSync(scratch, { recursive: true });
