// The page of a merge as its readers meet it: opened from a file, in a browser, without a network.
import assert from "node:assert/strict";
import { copyFileSync, mkdirSync, readFileSync, renameSync, writeFileSync } from "node:fs";
import { join } from "node:path";
import { before, test } from "node:test";
import { fileURLToPath } from "node:url";

import { build } from "esbuild";

import { difference, inBrowser, pixels, random, samples, scratch, settle, share, upcr } from "./tools.mjs";

const open = inBrowser();

const report = join(scratch, "merge.html");
/** @type {any} */
let told;

before(() => {
  // Scans of one object, and one of something else.
  const folder = join(scratch, "scans");
  upcr("synth", "--scene", "object", "--scans", "6", "--size", "160x120", "--seed", "4", "--out", folder);
  copyFileSync(join(samples, "source.ply"), join(folder, "stranger.ply"));
  told = JSON.parse(upcr("merge", folder, "-o", join(scratch, "model.ply"), "--report", report, "--json"));
});

/** The page with other words in it, as a merge of other scans would have them.
 *  @param {string} name
 *  @param {(page: any) => void} change */
function altered(name, change) {
  const html = readFileSync(report, "utf8");
  const [from, to] = [html.indexOf('id="page">') + 10, html.indexOf("</script>")];
  const page = JSON.parse(html.slice(from, to));
  change(page);
  const path = join(scratch, name);
  writeFileSync(path, html.slice(0, from) + JSON.stringify(page).replaceAll("<", "\\u003c") + html.slice(to));
  return path;
}

/** @param {import("playwright-core").Page} page */
const rows = (page) => page.locator(".sorted:visible tbody tr");

test("tells what became of all, and draws a node a scan and an edge a pair", async () => {
  const { page, wrong, close } = await open(report);
  const kept = told.pairs.filter((/** @type {any} */ pair) => pair.kept).length;
  const untrusted = told.pairs.filter((/** @type {any} */ pair) => pair.chi_sq === null).length;
  const placed = told.models.flat().length;
  assert.ok(placed >= 4 && told.left_out.length > 0, JSON.stringify(told.left_out));
  const headline = (await page.locator("h1").textContent()) ?? "";
  assert.ok(headline.startsWith(`${placed} of 7 scans in `) && headline.includes(`${told.left_out.length} left out`), headline);
  await page.getByText(`${told.pairs.length} pairs were registered: ${kept} kept,`).waitFor();

  assert.equal(await page.locator(".node").count(), 7);
  assert.equal(await page.locator(".node.out rect").count(), told.left_out.length);
  assert.equal(await page.locator(".edges .kept").count(), kept);
  assert.equal(await page.locator(".edges .untrusted").count(), 0);
  await page.locator("#untrusted").check();
  assert.equal(await page.locator(".edges .untrusted").count(), untrusted);
  assert.equal(await page.locator(".edges line").count(), told.pairs.length);
  assert.ok((await page.locator(".graph title").allTextContents()).some((text) => /^stranger\.ply\nleft out: no pair/.test(text)));
  const colors = await pixels(page);
  assert.ok(share(colors, "orange") + share(colors, "blue") > 0.005, "scans are coloured");
  assert.deepEqual(wrong, []);
  await close();
});

test("sorts and filters the pairs", async () => {
  const { page, wrong, close } = await open(report);
  assert.equal(await rows(page).count(), told.pairs.length);
  /** @param {number} column */
  const cells = (column) => page.locator(`.sorted:visible tbody tr > :nth-child(${column})`).allTextContents();
  const header = page.locator("th", { has: page.getByRole("button", { name: "Probability" }) }).first();
  await header.getByRole("button").click();
  assert.equal(await header.getAttribute("aria-sort"), "descending");
  const falling = (await cells(4)).map(Number);
  assert.deepEqual(falling, [...falling].sort((a, b) => b - a));
  assert.equal(new Set(falling).size, new Set(told.pairs.map((/** @type {any} */ pair) => pair.probability.toFixed(3))).size);
  await header.getByRole("button").click();
  assert.equal(await header.getAttribute("aria-sort"), "ascending");
  assert.deepEqual((await cells(4)).map(Number), falling.reverse());
  assert.equal(await page.locator('.sorted:visible th[aria-sort="ascending"], .sorted:visible th[aria-sort="descending"]').count(), 1);

  await page.getByRole("combobox", { name: "State" }).selectOption("untrusted");
  assert.deepEqual([...new Set(await cells(3))], ["not trusted"]);
  await page.getByRole("searchbox").fill("STRANGER");
  const strange = told.pairs.filter((/** @type {any} */ pair) => pair.chi_sq === null && [pair.source_name, pair.target_name].includes("stranger.ply"));
  assert.equal(await rows(page).count(), strange.length);
  await page.getByRole("button", { name: /^Scans \(/ }).click();
  assert.deepEqual(await cells(1), ["stranger.ply"]);
  assert.deepEqual(await cells(6), ["no pair with it is to be trusted"]);
  assert.deepEqual(wrong, []);
  await close();
});

test("what is chosen is seen alone, and its pose can be copied", async () => {
  const { page, wrong, close } = await open(report);
  const all = await pixels(page);
  await page.getByRole("button", { name: /^Scans \(/ }).click();
  const [scan] = told.models[0];
  await rows(page).filter({ hasText: scan.name }).click();
  await settle(page);
  assert.ok(difference(all, await pixels(page)) > 0.01, "one scan is not all");
  assert.equal(await page.locator('.node[aria-pressed="true"]').count(), 1);
  await page.locator("#copy").click();
  await page.getByText("copied", { exact: true }).waitFor();
  const copied = await page.evaluate(() => navigator.clipboard.readText());
  assert.deepEqual(copied.split(/\s+/).map(Number), scan.T_model_scan.flat());

  // A pair, from the graph: at the middle of an edge.
  await page.keyboard.press("Escape");
  await settle(page);
  assert.equal(difference(all, await pixels(page)), 0, "back to all");
  await page.getByRole("button", { name: /^Pairs \(/ }).click();
  await page.getByRole("combobox", { name: "State" }).selectOption("kept");
  await rows(page).first().getByRole("button").focus();
  await page.keyboard.press("Enter");
  await settle(page);
  const pair = await pixels(page);
  assert.ok(share(pair, "orange") > 0.005 && share(pair, "blue") > 0.005, "source and target have colours of their own");
  const model = page.getByRole("button", { name: "As in the model" });
  assert.equal(await model.getAttribute("aria-pressed"), "true");
  await page.getByText("Kept: the poses rest on it.").waitFor();

  // One that is not trusted lies as its own registration says.
  await page.getByRole("combobox", { name: "State" }).selectOption("untrusted");
  await page.getByRole("searchbox").fill("stranger");
  await rows(page).first().click();
  await settle(page);
  await page.getByText("as this pair’s registration lays them").waitFor();
  const laid = await pixels(page);
  assert.ok(share(laid, "orange") > 0.002 && share(laid, "blue") > 0.002);
  await page.getByRole("button", { name: "All scans" }).click();
  await settle(page);
  assert.equal(difference(all, await pixels(page)), 0);
  assert.deepEqual(wrong, []);
  await close();
});

test("a pair as it was registered is not where the model has it", async () => {
  // Dropped, as it is a hand's breadth off.
  const path = altered("dropped.html", ({ merge }) => {
    const pair = merge.pairs.find((/** @type {any} */ p) => p.kept);
    Object.assign(pair, { kept: false, chi_sq: 99 });
    pair.T_target_source[0][3] += 0.3;
  });
  const { page, wrong, close } = await open(path);
  await page.getByRole("combobox", { name: "State" }).selectOption("dropped");
  await rows(page).first().click();
  await page.getByText("Dropped: trusted as a pair").waitFor();
  await settle(page);
  const own = await pixels(page);
  await page.getByRole("button", { name: "As in the model" }).click();
  await settle(page);
  assert.ok(difference(own, await pixels(page)) > 0.01);
  await page.getByRole("button", { name: "As this pair says" }).click();
  await settle(page);
  assert.equal(difference(own, await pixels(page)), 0);
  assert.deepEqual(wrong, []);
  await close();
});

test("a pair that others speak against is named so", async () => {
  const path = altered("contradicted.html", ({ merge }) => {
    Object.assign(merge.pairs.find((/** @type {any} */ p) => p.kept), { kept: false, contradicted: true, chi_sq: null });
  });
  const { page, wrong, close } = await open(path);
  await page.getByRole("combobox", { name: "State" }).selectOption("dropped");
  await rows(page).first().click();
  await page.getByText("what it would lay on each other besides does not fit there").waitFor();
  assert.deepEqual(wrong, []);
  await close();
});

test("nodes do not meet, wherever the scans lie", async () => {
  const { outputFiles: [made] } = await build({
    entryPoints: [fileURLToPath(new URL("../report/merge/layout.ts", import.meta.url))], bundle: true, format: "esm", write: false,
  });
  const module = `data:text/javascript;base64,${Buffer.from(made?.contents ?? []).toString("base64")}`;
  /** @type {typeof import("../report/merge/layout.ts")} */
  const { flat, layout, pack } = await import(module);
  const next = random(5);
  /** @type {Record<string, () => [number, number, number]>} */
  const places = { "in one place": () => [1e6, 1e6, 1e6], "on a line": () => [next(), 0, 0], "anywhere": () => [next(), next(), 0.1 * next()] };
  for (const [what, place] of Object.entries(places)) {
    const nodes = Array.from({ length: 120 }, (_, i) => ({ model: i < 100 ? 0 : i < 110 ? 1 : null, center: place(), label: `${i}`, weight: i }));
    const { spots, radius } = layout(nodes, 600, 400);
    const apart = spots.flatMap((a, i) => spots.slice(0, i).map((b) => Math.hypot(a.x - b.x, a.y - b.y)));
    assert.ok(Math.min(...apart) > 1.6 * radius, `${what}: ${Math.min(...apart)} apart with radius ${radius}`);
    assert.ok(spots.every(({ x, y }) => x > 0 && x < 600 && y > 0 && y < 400), what);
  }
  // Seen along z, where the centres spread least, and not mirrored.
  const seen = flat([[0, 0, 0], [10, 0, 0.1], [0, 4, 0], [10, 4, -0.1]]);
  const [a, b, c] = seen;
  assert.ok(a && b && c && (b.x - a.x) * -(c.y - a.y) - -(b.y - a.y) * (c.x - a.x) > 39);
  const boxes = pack([9, 4, 1, 1], { x: 0, y: 0, width: 50, height: 30 });
  assert.deepEqual(boxes.map((box) => Math.round(box.width * box.height)), [900, 400, 100, 100]);
});

test("pointing and keys find scans and pairs in the graph", async () => {
  const { page, wrong, close } = await open(report);
  const pair = told.pairs.find((/** @type {any} */ p) => p.kept);
  const line = page.locator(".edges .kept").first();
  // Near its source, where fewer edges cross.
  const at = await line.evaluate((element) => {
    const [x1, y1, x2, y2] = ["x1", "y1", "x2", "y2"].map((name) => Number(element.getAttribute(name)));
    return [0.7 * (x1 ?? 0) + 0.3 * (x2 ?? 0), 0.7 * (y1 ?? 0) + 0.3 * (y2 ?? 0)];
  });
  const box = await page.locator(".graph").boundingBox();
  assert.ok(box && pair);
  await page.mouse.move(box.x + (at[0] ?? 0), box.y + (at[1] ?? 0));
  assert.match((await page.locator(".pointed").textContent()) ?? "", /→ .*: (kept|dropped), probability/);
  await page.mouse.down();
  await page.mouse.up();
  assert.equal(await page.locator('.node[aria-pressed="true"]').count(), 2);
  await page.keyboard.press("Escape");

  // One stop for the tabulator, and arrows from there.
  assert.equal(await page.locator('.node[tabindex="0"]').count(), 1);
  await page.locator('.node[tabindex="0"]').focus();
  const name = () => page.evaluate(() => document.activeElement?.getAttribute("aria-label"));
  const first = await name();
  for (const key of ["ArrowRight", "ArrowLeft", "ArrowUp", "ArrowDown"]) {
    await page.keyboard.press(key);
    if ((await name()) !== first) break;
  }
  assert.notEqual(await name(), first);
  assert.ok(await page.locator(".drawing.lit").count());
  await page.keyboard.press("Enter");
  assert.equal(await page.locator('.node[aria-pressed="true"]').getAttribute("aria-label"), await name());
  assert.deepEqual(wrong, []);
  await close();
});

test("hostile names are text", async () => {
  const bad = "\"><img src=x onerror=alert(1)><script>alert(2)<!--&amp;'.ply";
  const folder = join(scratch, "hostile");
  mkdirSync(folder);
  for (const name of ["a.xyz", "b.xyz"]) writeFileSync(join(folder, name), "1 2 3\n4 5 6\n7 8 9\n");
  renameSync(join(folder, "a.xyz"), join(folder, bad));
  const path = join(scratch, "hostile.html");
  upcr("merge", folder, "-o", join(scratch, "none.ply"), "--report", path);
  const { page, wrong, close } = await open(path);
  await page.getByRole("heading", { name: "None of 2 scans could be placed" }).waitFor();
  await page.getByRole("button", { name: /^Scans \(/ }).click();
  assert.equal(await rows(page).first().locator("bdi").textContent(), bad);
  await rows(page).first().click();
  assert.equal(await page.locator("aside h2 bdi").textContent(), bad);
  assert.ok((await page.locator(".node").first().getAttribute("aria-label"))?.startsWith(bad));
  assert.equal(await page.locator("img").count(), 0);
  assert.equal(await page.locator("script").count(), 1);
  assert.deepEqual(wrong, []);
  await close();
});

test("shows the files' own colours", async () => {
  const clouds = [0, 1].map((n) => {
    const lines = Array.from({ length: 3000 }, (_, i) => `${Math.sin(i) + n} ${Math.cos(1.3 * i)} ${i / 3000} 20 40 250`);
    const path = join(scratch, `blue-${n}.xyzrgb`);
    writeFileSync(path, lines.join("\n"));
    return path;
  });
  const path = join(scratch, "blue.html");
  upcr("merge", ...clouds, "-o", join(scratch, "blue.ply"), "--report", path);
  const { page, wrong, close } = await open(path);
  await page.getByRole("button", { name: /^Scans \(/ }).click();
  await rows(page).first().click();
  await settle(page);
  assert.ok(share(await pixels(page), "orange") > 0.005);
  await page.getByRole("button", { name: "The files’" }).click();
  await settle(page);
  const own = await pixels(page);
  assert.ok(share(own, "orange") < 0.001 && share(own, "blue") > 0.005);
  assert.deepEqual(wrong, []);
  await close();
});

test("a thousand scans and ten thousand pairs do not freeze it", async () => {
  const next = random(7);
  const path = altered("thousand.html", (page) => {
    const [like, place] = [page.scans.find((/** @type {any} */ s) => s.center), page.merge.places.find((/** @type {any} */ p) => p.state === "placed")];
    const pair = page.merge.pairs[0];
    for (let scan = page.scans.length; scan < 1000; scan += 1) {
      const center = [20 * Math.cos(scan / 60) + next(), 12 * Math.sin(scan / 40) + next(), next()];
      page.scans.push({ ...like, name: `scan-${scan}`, center, drawn: null });
      page.merge.places.push({ ...place, model: scan > 900 ? 1 + scan % 5 : 0 });
    }
    for (let n = page.merge.pairs.length; n < 10_000; n += 1) {
      const source = 20 + Math.floor(980 * next());
      const state = next();
      page.merge.pairs.push({
        ...pair, source, target: source - 1 - Math.floor(10 * next()), probability: next(), kept: state < 0.7, chi_sq: state < 0.75 ? 10 * next() : null,
        contradicted: state > 0.98,
      });
    }
  });
  const { page, wrong, close } = await open(path);
  assert.equal(await page.locator(".node").count(), 1000);
  assert.ok((await rows(page).count()) <= 200);
  await page.getByRole("button", { name: /more$/ }).click();
  assert.ok((await rows(page).count()) > 200);
  const took = await page.evaluate(async () => {
    const start = performance.now();
    for (const name of ["Fitness", "Source"]) {
      [...document.querySelectorAll("th button")].find((b) => b.textContent === name)?.dispatchEvent(new MouseEvent("click", { bubbles: true }));
    }
    document.querySelector(".sorted tbody tr")?.dispatchEvent(new MouseEvent("click", { bubbles: true }));
    return performance.now() - start;
  });
  console.log(`two sorts and a choice among 10,000 pairs: ${took.toFixed(0)} ms`);
  assert.ok(took < 5000, `${took} ms`);
  await page.locator("#model").selectOption({ index: 1 });
  await page.getByText(/^Model 2: /).last().waitFor();
  assert.deepEqual(wrong, []);
  await close();
});

test("is readable on a phone, light and dark, and without WebGL", async () => {
  const images = [];
  for (const colorScheme of /** @type {const} */ (["light", "dark"])) {
    const { page, wrong, close } = await open(report, {
      viewport: { width: 360, height: 740 }, hasTouch: true, isMobile: true, colorScheme,
    });
    const wide = await page.evaluate(() => document.documentElement.scrollWidth);
    assert.ok(wide <= 360, `nothing stands out: ${wide}`);
    const low = await page.evaluate(() => [...document.querySelectorAll("button, summary")]
      .filter((b) => b instanceof HTMLElement && b.offsetParent !== null && b.getBoundingClientRect().height < 40).map((b) => b.textContent));
    assert.deepEqual(low, [], "fingers hit the buttons");
    images.push(await pixels(page));
    assert.deepEqual(wrong, []);
    await close();
  }
  assert.ok(difference(images[0] ?? new Uint8Array(), images[1] ?? new Uint8Array()) > 0.5);
  const { page, close } = await open(report, {}, "HTMLCanvasElement.prototype.getContext = () => null");
  await page.getByText("has no WebGL").waitFor();
  await rows(page).first().click();
  await page.locator("aside").getByText("Probability").waitFor();
  await close();
});
