// The report as its readers meet it: opened from a file, in a browser, without a network.
import assert from "node:assert/strict";
import { readFileSync, statSync, writeFileSync } from "node:fs";
import { join } from "node:path";
import { test } from "node:test";

import { difference, inBrowser, pixels, ply, random, samples, scratch, settle, share, table, upcr } from "./tools.mjs";

const open = inBrowser();

const [source, target] = [join(samples, "source.ply"), join(samples, "target.ply")];

test("opens, draws, and shows before and after", async () => {
  const path = join(scratch, "sample.html");
  upcr("register", source, target, "--report", path);
  const { page, wrong, close } = await open(path);
  const shown = await pixels(page);
  assert.ok(share(shown, "orange") > 0.01 && share(shown, "blue") > 0.01, "both clouds are there");
  await page.keyboard.press(" ");
  await settle(page);
  const lying = await pixels(page);
  assert.ok(difference(shown, lying) > 0.02, "before differs from after");
  await page.getByRole("button", { name: "After" }).click();
  await settle(page);
  assert.equal(difference(shown, await pixels(page)), 0, "after is what it was");

  await page.getByRole("button", { name: "Side by side" }).click();
  await settle(page);
  assert.ok(difference(shown, await pixels(page)) > 0.02);
  await page.keyboard.press("s");
  await page.keyboard.press("r");
  await settle(page);
  const far = await pixels(page);
  assert.ok(share(far, "orange") < 0.001 && share(far, "yellow") > 0.001, "colours are distances");
  assert.ok(await page.locator("#legend").isVisible());
  await page.keyboard.press("r");
  await page.getByRole("checkbox").nth(0).uncheck();
  await settle(page);
  const alone = await pixels(page);
  assert.ok(share(alone, "orange") < 0.001 && share(alone, "blue") > 0.01, "the source is gone");
  assert.deepEqual(wrong, []);
  await close();
});

test("turns and zooms by keys and by pointer", async () => {
  const path = join(scratch, "keys.html");
  upcr("view", source, target, "--no-open", "--out", path);
  const { page, wrong, close } = await open(path);
  const first = await pixels(page);
  for (const key of ["ArrowLeft", "ArrowUp", "+", "]"]) {
    const earlier = await pixels(page);
    await page.keyboard.press(key);
    await settle(page);
    assert.ok(difference(earlier, await pixels(page)) > 0.005, key);
  }
  await page.keyboard.press("[");
  await page.keyboard.press("Home");
  await settle(page);
  assert.ok(difference(first, await pixels(page)) < 0.001, "Home shows the whole again");
  await page.mouse.move(300, 300);
  await page.mouse.down();
  await page.mouse.move(420, 330, { steps: 4 });
  await page.mouse.up();
  await page.mouse.wheel(0, -300);
  await settle(page);
  assert.ok(difference(first, await pixels(page)) > 0.01);
  await page.keyboard.press("?");
  assert.ok(await page.locator("#help").isVisible());
  await page.keyboard.press("Escape");
  assert.deepEqual(wrong, []);
  await close();
});

test("copies the pose that the JSON has, digit by digit", async () => {
  const path = join(scratch, "pose.html");
  const json = upcr("register", source, target, "--json", "--report", path);
  const rows = /"T_target_source": (\[[^a-z]*?\]\s*\])/.exec(json)?.[1] ?? "";
  const digits = rows.split(/[\s,[\]]+/).filter((word) => word !== "");
  assert.equal(digits.length, 16);
  const { page, wrong, close } = await open(path);
  const told = [];
  for (const index of [0, 1, 2, 3, 4, 5]) {
    await page.locator("#notation").selectOption({ index });
    await page.locator("#copy").click();
    await page.getByText("copied", { exact: true }).waitFor();
    told.push(await page.evaluate(() => navigator.clipboard.readText()));
  }
  assert.deepEqual(told[0]?.split(/\s+/), digits);
  assert.equal(new Set(told).size, 6);
  assert.deepEqual(JSON.parse(told[4] ?? "").matrix.split(/\s+/), digits);
  assert.deepEqual(told[5]?.split(/\s+/).map(Number), digits.map(Number));
  assert.deepEqual(wrong, []);
  await close();
});

test("shows the verdict, its reasons, and the alternatives that are clicked", async () => {
  const path = join(scratch, "table.html");
  // Far from each other, and from any origin: drawn all the same, and the pose keeps its digits.
  const [a, b] = [table("a.ply", 1, [500_000, 5_400_000, 300]), table("b.ply", 2)];
  const found = JSON.parse(upcr("register", a, b, "--json", "--report", path));
  assert.deepEqual(found.reasons, ["ambiguous"]);
  const { page, wrong, close } = await open(path);
  await page.getByRole("heading", { name: "Not registered" }).waitFor();
  await page.locator(".verdict").getByText("ambiguous").waitFor();
  const others = page.locator(".list button");
  assert.equal(await others.count(), 1 + found.alternatives.length);
  const first = await pixels(page);
  await others.nth(1).click();
  await settle(page);
  assert.ok(difference(first, await pixels(page)) > 0.005);
  await page.locator("#copy").click();
  await page.getByText("copied", { exact: true }).waitFor();
  const text = await page.evaluate(() => navigator.clipboard.readText());
  assert.deepEqual(text.split(/\s+/).map(Number), found.alternatives[0].T_target_source.flat());
  // Clicked with the mouse, a button does not keep the space bar for itself.
  await page.getByRole("button", { name: "After" }).click();
  await page.keyboard.press(" ");
  assert.equal(await page.getByRole("button", { name: "Before" }).getAttribute("aria-pressed"), "true");
  await page.keyboard.press(" ");
  await page.keyboard.press("0");
  await settle(page);
  assert.equal(difference(first, await pixels(page)), 0);
  assert.deepEqual(wrong, []);
  await close();
});

test("hostile names and comments are text", async () => {
  const path = join(scratch, "hostile.html");
  const comment = "</script><script>alert(3)</script><b>&lt;";
  const bad = `"><img src=x onerror=alert(1)><script>alert(2)<!--&amp;\u2028'.ply`;
  const cloud = ply(bad, 2000, (i) => [Math.sin(i), Math.cos(1.7 * i), i / 1000], comment);
  upcr("view", cloud, target, "--no-open", "--out", path);
  const { page, wrong, close } = await open(path);
  assert.ok((await page.locator("h1").textContent())?.includes(bad));
  assert.equal(await page.locator(".clouds details p").first().textContent(), comment);
  assert.equal(await page.locator("img, .clouds b").count(), 0);
  assert.ok((await page.title()).includes("<script>"));
  assert.deepEqual(wrong, []);
  await close();
});

test("shows the files' own colours, several clouds, and says what it leaves out", async () => {
  const path = join(scratch, "colors.html");
  /** @param {string} name @param {string} rest @param {number} shift */
  const cloud = (name, rest, shift) => {
    const lines = Array.from({ length: 3000 }, (_, i) => `${Math.sin(i) + shift} ${Math.cos(1.3 * i)} ${i / 3000}${rest}`);
    writeFileSync(join(scratch, name), [...lines, `nan 0 0${rest}`].join("\n"));
    return join(scratch, name);
  };
  const clouds = [cloud("a.xyzrgb", " 20 40 250", 0), cloud("b.xyzrgb", " 20 40 250", 2), cloud("c.xyz", "", 4)];
  upcr("view", ...clouds, "--no-open", "--out", path);
  const { page, wrong, close } = await open(path);
  assert.ok(share(await pixels(page), "orange") > 0.005);
  assert.equal(await page.getByText("1 point without finite coordinates").count(), 3);
  await page.getByRole("button", { name: "The files’" }).click();
  await settle(page);
  const own = await pixels(page);
  assert.ok(share(own, "orange") < 0.001 && share(own, "blue") > 0.01);
  assert.equal(await page.getByRole("checkbox").count(), 3);
  assert.deepEqual(wrong, []);
  await close();
});

test("a script that is not the page's own does not run", async () => {
  const path = join(scratch, "tampered.html");
  upcr("view", source, "--no-open", "--out", path);
  const tampered = readFileSync(path, "utf8").replace("<noscript>", "<script>document.title = 'owned'</script><noscript>");
  writeFileSync(path, tampered);
  const { page, wrong, close } = await open(path);
  assert.notEqual(await page.title(), "owned");
  assert.ok(wrong.some((message) => message.includes("Content Security Policy")));
  await close();
});

test("without WebGL it says so, and tells all else", async () => {
  const path = join(scratch, "plain.html");
  upcr("register", source, target, "--report", path);
  const { page, close } = await open(path, {}, "HTMLCanvasElement.prototype.getContext = () => null");
  await page.getByText("has no WebGL").waitFor();
  await page.getByRole("heading", { name: "Registered", exact: true }).waitFor();
  await page.keyboard.press(" ");
  await close();
});

test("a lost picture is told, and comes back", async () => {
  const path = join(scratch, "lost.html");
  upcr("view", source, "--no-open", "--out", path);
  const { page, close } = await open(path);
  const first = await pixels(page);
  await page.evaluate(() => {
    const extension = document.querySelector("canvas")?.getContext("webgl2")?.getExtension("WEBGL_lose_context");
    extension?.loseContext();
    setTimeout(() => extension?.restoreContext(), 600);
  });
  await page.getByText("gave up the picture").waitFor();
  await page.locator("#trouble").waitFor({ state: "hidden" });
  await settle(page);
  assert.ok(difference(first, await pixels(page)) < 0.001);
  await close();
});

test("is readable on a phone, light and dark", async () => {
  const path = join(scratch, "phone.html");
  upcr("register", source, target, "--report", path);
  const images = [];
  for (const colorScheme of /** @type {const} */ (["light", "dark"])) {
    const { page, wrong, close } = await open(path, {
      viewport: { width: 360, height: 740 }, hasTouch: true, isMobile: true, colorScheme,
    });
    const wide = await page.evaluate(() => document.documentElement.scrollWidth);
    assert.ok(wide <= 360, `nothing stands out: ${wide}`);
    const [stage, aside] = [await page.locator("#stage").boundingBox(), await page.locator("aside").boundingBox()];
    assert.ok(stage && aside && stage.height > 200 && aside.y >= stage.y + stage.height, "words are below the picture");
    const low = await page.evaluate(() => [...document.querySelectorAll("button")]
      .filter((b) => b.offsetParent !== null && b.getBoundingClientRect().height < 40).map((b) => b.textContent));
    assert.deepEqual(low, [], "fingers hit the buttons");
    images.push(await pixels(page));
    assert.deepEqual(wrong, []);
    await close();
  }
  assert.ok(difference(images[0] ?? new Uint8Array(), images[1] ?? new Uint8Array()) > 0.5);
});

test("a million points a cloud load, stay interactive, and more are thinned and told", async () => {
  const path = join(scratch, "large.html");
  const next = random(3);
  const hill = () => {
    const [u, v] = [10 * next(), 10 * next()];
    return /** @type {[number, number, number]} */ ([u, v, Math.sin(u) + 0.4 * Math.cos(3 * v + u)]);
  };
  const [a, b] = [ply("large-a.ply", 1_000_000, hill), ply("large-b.ply", 1_200_000, hill)];
  upcr("view", a, b, "--no-open", "--out", path);
  const start = performance.now();
  // Each frame ends with a fence, and none begins before that of the last has been passed.
  const { page, wrong, close } = await open(path, {}, `
    window.times = [];
    const { fenceSync } = WebGL2RenderingContext.prototype;
    WebGL2RenderingContext.prototype.fenceSync = function (...given) {
      window.times.push(performance.now());
      return fenceSync.apply(this, given);
    };`);
  const shown = await pixels(page);
  const loaded = performance.now() - start;
  await page.getByText("thinned for display to 1,000,000 of 1,200,000 points").waitFor();
  assert.ok(share(shown, "blue") > 0.02);

  // A drag, as long as it takes: how often the picture follows.
  await page.evaluate("times.length = 0");
  await page.mouse.move(300, 300);
  await page.mouse.down();
  const end = performance.now() + 4000;
  for (let i = 0; performance.now() < end; i += 1) {
    await page.mouse.move(300 + 100 * Math.sin(i / 8), 300 + 60 * Math.cos(i / 8));
    await page.waitForTimeout(15);
  }
  const times = /** @type {number[]} */ (await page.evaluate("times"));
  await page.mouse.up();
  const gaps = times.slice(1).map((t, i) => t - (times[i] ?? t)).sort((x, y) => x - y);
  const middle = gaps[Math.floor(gaps.length / 2)] ?? Infinity;
  console.log(`2 x 1,000,000 points: ${(statSync(path).size / 1e6).toFixed(1)} MB, on the screen after ${(loaded / 1000).toFixed(1)} s;`
    + ` while turned ${gaps.length} frames in 4 s, the median after ${middle.toFixed(0)} ms, the slowest after ${(gaps.at(-1) ?? 0).toFixed(0)} ms`);
  // The figures are for people. What is asserted holds without a graphics card, on a machine that is busy besides.
  assert.ok(loaded < 90_000, `loaded after ${loaded} ms`);
  assert.ok(middle < 1000, `a frame takes ${middle} ms`);
  assert.deepEqual(wrong, []);
  await close();
});
