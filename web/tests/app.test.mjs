// The page that registers, as its readers meet it: opened from a file or from a server, in a browser.
import assert from "node:assert/strict";
import { existsSync, readFileSync, writeFileSync } from "node:fs";
import { createServer } from "node:http";
import { join } from "node:path";
import { test } from "node:test";

import { built, difference, inBrowser, pixels, ply, random, samples, scratch, settle, share, table, upcr } from "./tools.mjs";

const open = inBrowser();

const [source, target] = [join(samples, "source.ply"), join(samples, "target.ply")];

/** Chooses both files, and waits for the answer.
 *  @param {import("playwright-core").Page} page
 *  @param {string} a
 *  @param {string} b */
async function register(page, a, b) {
  await page.locator("#file-0").setInputFiles(a);
  await page.locator("#file-1").setInputFiles(b);
  await page.locator("canvas").waitFor({ timeout: 120_000 });
  await settle(page);
}

/** The pose that the page copies, as 16 numbers; what it shows is that, rounded.
 *  @param {import("playwright-core").Page} page */
async function pose(page) {
  await page.locator("#copy").click();
  await page.getByText("copied", { exact: true }).waitFor();
  const numbers = (await page.evaluate(() => navigator.clipboard.readText())).split(/\s+/).map(Number);
  const shown = ((await page.locator("pre").textContent()) ?? "").trim().split(/\s+/).map(Number);
  assert.ok(farthest(shown, numbers) <= 5.1e-7);
  return numbers;
}

/** The same of the command line.
 *  @param {string[]} args
 *  @returns {number[]} */
function told(...args) {
  return JSON.parse(upcr("register", ...args, "--json")).T_target_source.flat();
}

/** @param {number[]} a
 *  @param {number[]} b */
function farthest(a, b) {
  assert.equal(a.length, 16);
  return Math.max(...a.map((v, i) => Math.abs(v - (b[i] ?? NaN))));
}

/** Of a binary PLY that has nothing but x, y, z in double precision.
 *  @param {string} path */
function coordinates(path) {
  const bytes = readFileSync(path);
  const start = bytes.indexOf("end_header\n") + "end_header\n".length;
  return Array.from({ length: (bytes.length - start) / 8 }, (_, i) => bytes.readDoubleLE(start + 8 * i));
}

/** Saves what the button gives.
 *  @param {import("playwright-core").Page} page
 *  @param {string} button */
async function save(page, button) {
  const coming = page.waitForEvent("download");
  await page.getByRole("button", { name: button, exact: true }).click();
  const download = await coming;
  const path = join(scratch, download.suggestedFilename());
  await download.saveAs(path);
  return path;
}

test("registers the samples as the command line does, and gives pose, aligned cloud and report away", async () => {
  const { page, wrong, close } = await open(built);
  await page.getByRole("button", { name: "Try the samples" }).click();
  await page.locator("canvas").waitFor();
  await settle(page);
  const shown = await pixels(page);
  assert.ok(share(shown, "orange") > 0.01 && share(shown, "blue") > 0.01, "both clouds are there");
  await page.getByRole("heading", { name: "Registered", exact: true }).waitFor();
  const found = await pose(page);
  assert.ok(farthest(found, told(source, target)) < 1e-4);
  await page.keyboard.press(" ");
  await settle(page);
  assert.ok(difference(shown, await pixels(page)) > 0.02, "before differs from after");

  const matrix = readFileSync(await save(page, "Pose"), "utf8");
  assert.deepEqual(matrix.trim().split(/\s+/).map(Number), found);
  const json = JSON.parse(readFileSync(await save(page, "JSON"), "utf8"));
  assert.deepEqual(json.T_target_source.flat(), found);
  for (const format of ["ply", "pcd", "xyz"]) {
    await page.getByLabel("Format of the aligned cloud").selectOption(format);
    const aligned = await save(page, "Aligned source");
    assert.ok(aligned.endsWith(`source_aligned.${format}`));
    assert.ok(farthest(told(aligned, target), [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]) < 2e-3, format);
  }
  const report = await open(await save(page, "Report"));
  assert.deepEqual(await pose(report.page), found);
  assert.deepEqual([...wrong, ...report.wrong], []);
  await report.close();
  await close();
});

test("registers a pair of the Stanford bunny as the command line does", async (context) => {
  const folder = join(process.env["UPCR_DATA"] ?? join(samples, "../../shared/data"), "stanford_bunny");
  if (!existsSync(folder)) {
    context.skip(`there is no ${folder}`);
    return;
  }
  const [a, b] = [join(folder, "bun000.ply"), join(folder, "bun045.ply")];
  const { page, wrong, close } = await open(built);
  await register(page, a, b);
  await page.getByRole("heading", { name: "Registered", exact: true }).waitFor();
  assert.ok(farthest(await pose(page), told(a, b)) < 1e-4);
  assert.deepEqual(wrong, []);
  await close();
});

test("goes by the settings, and swaps", async () => {
  const { page, wrong, close } = await open(built);
  await page.getByText("Settings").click();
  await page.getByLabel("First pose from").selectOption("features");
  await page.getByLabel("Refinement").selectOption("plane");
  await page.getByLabel("Voxel size").fill("0.003");
  const options = ["--method", "features", "--refine", "plane", "--voxel-size", "0.003"];
  await register(page, source, target);
  const found = await pose(page);
  assert.ok(farthest(found, told(source, target, ...options)) < 1e-4);
  assert.ok(farthest(found, told(source, target)) > 1e-6, "the settings matter");

  await page.getByRole("button", { name: "Files and settings" }).click();
  await page.getByRole("button", { name: "Swap" }).click();
  await page.getByRole("button", { name: "Register" }).click();
  await page.locator("canvas").waitFor();
  assert.equal(await page.locator("h1").first().textContent(), "target.ply → source.ply");
  assert.ok(farthest(await pose(page), told(target, source, ...options)) < 1e-4);
  assert.deepEqual(wrong, []);
  await close();
});

test("saves the alternative that is shown", async () => {
  const { page, wrong, close } = await open(built);
  await register(page, table("table-a.ply", 1), table("table-b.ply", 2));
  const found = await pose(page);
  await page.keyboard.press("1");
  const other = await pose(page);
  assert.ok(farthest(found, other) > 0.1);
  const matrix = await save(page, "Pose");
  assert.deepEqual(readFileSync(matrix, "utf8").trim().split(/\s+/).map(Number), other);
  const [aligned, byHand] = [await save(page, "Aligned source"), join(scratch, "by-hand.ply")];
  upcr("convert", join(scratch, "table-a.ply"), byHand, "--transform", matrix);
  const [saved, expected] = [aligned, byHand].map(coordinates);
  assert.equal(saved?.length, 18_000);
  assert.ok(saved?.every((v, i) => Math.abs(v - (expected?.[i] ?? NaN)) < 1e-12));
  assert.deepEqual(wrong, []);
  await close();
});

test("takes two files that are dropped anywhere", async () => {
  const { page, wrong, close } = await open(built);
  const files = [source, target].map((path) => readFileSync(path, "latin1"));
  const dropped = await page.evaluateHandle(([a, b]) => {
    const transfer = new DataTransfer();
    for (const [name, text] of [["a.ply", a], ["b.ply", b]]) {
      transfer.items.add(new File([Uint8Array.from(text ?? "", (c) => c.charCodeAt(0))], name ?? ""));
    }
    return transfer;
  }, files);
  await page.dispatchEvent("main", "dragover", { dataTransfer: dropped });
  await page.dispatchEvent("main", "drop", { dataTransfer: dropped });
  await page.locator("canvas").waitFor();
  assert.equal(await page.locator("h1").first().textContent(), "a.ply → b.ply");
  assert.deepEqual(wrong, []);
  await close();
});

test("tells what is wrong with a file, and goes on", async () => {
  const { page, wrong, close } = await open(built);
  const broken = join(scratch, "broken.ply");
  writeFileSync(broken, "ply\nformat ascii 1.0\nelement vertex 4000000000\nproperty float x\nproperty float y\nproperty float z\nend_header\n1 2 3\n");
  await page.locator("#file-0").setInputFiles(broken);
  await page.locator("#file-1").setInputFiles(target);
  await page.getByRole("alert").getByText("broken.ply: not a valid PLY file").waitFor();
  await page.getByLabel("Voxel size").evaluate((input) => {
    if (input instanceof HTMLInputElement) input.value = "-1";
  });
  await page.locator("#file-0").setInputFiles(source);
  await page.getByRole("alert").getByText("voxel_size").waitFor();
  await page.getByLabel("Voxel size").evaluate((input) => {
    if (input instanceof HTMLInputElement) input.value = "";
  });
  await page.getByRole("button", { name: "Register" }).click();
  await page.locator("canvas").waitFor();
  assert.deepEqual(wrong, []);
  await close();
});

test("hostile names and comments are text", async () => {
  const comment = "</script><script>alert(3)</script><b>&lt;";
  const bad = `"><img src=x onerror=alert(1)><script>alert(2)<!--&amp;\u2028'.ply`;
  const cloud = ply(bad, 2000, (i) => [Math.sin(i), Math.cos(1.7 * i), i / 1000], comment);
  const { page, wrong, close } = await open(built);
  await register(page, cloud, target);
  assert.ok((await page.locator("h1").first().textContent())?.includes(bad));
  assert.ok((await page.locator(".slot").first().textContent())?.includes(bad));
  assert.equal(await page.locator(".clouds details p").first().textContent(), comment);
  assert.equal(await page.locator("img, .clouds b").count(), 0);
  const report = await open(await save(page, "Report"));
  assert.ok((await report.page.locator("h1").textContent())?.includes(bad));
  assert.deepEqual([...wrong, ...report.wrong], []);
  await report.close();
  await close();
});

test("sends nothing: neither the page nor its worker can", async () => {
  const { page, wrong, close } = await open(built);
  for (const url of ["https://example.org/", "http://127.0.0.1:9/"]) {
    assert.equal(await page.evaluate((to) => fetch(to, { method: "POST", body: "scan", mode: "no-cors" }).then(() => "sent", () => "refused"), url), "refused");
  }
  // A worker of the same kind as the page's own.
  const said = await page.evaluate(() => new Promise((tell) => {
    const script = "fetch('https://example.org/').then(() => postMessage('sent'), () => postMessage('refused'))";
    const worker = new Worker(URL.createObjectURL(new Blob([script])));
    worker.onmessage = ({ data }) => tell(data);
  }));
  assert.equal(said, "refused");
  assert.ok(wrong.length >= 2 && wrong.every((message) => message.includes("Content Security Policy")), wrong.join("\n"));
  await close();
});

test("needs one request of a server", async () => {
  /** @type {(string | undefined)[]} */
  const asked = [];
  const server = createServer((request, response) => {
    asked.push(request.url);
    response.writeHead(200, { "content-type": "text/html" }).end(readFileSync(built));
  });
  await new Promise((listening) => server.listen(0, "127.0.0.1", () => listening(null)));
  const address = server.address();
  assert.ok(address && typeof address === "object");
  const { page, wrong, close } = await open(`http://127.0.0.1:${address.port}/`);
  await page.getByRole("button", { name: "Try the samples" }).click();
  await page.locator("canvas").waitFor();
  assert.deepEqual([asked, wrong], [["/"], []]);
  await close();
  server.close();
});

test("all can be done with the keyboard", async () => {
  const { page, wrong, close } = await open(built);
  /** @param {string} name */
  const tabTo = async (name) => {
    for (let i = 0; i < 40; i += 1) {
      await page.keyboard.press("Tab");
      const focused = await page.evaluate(() => document.activeElement?.textContent ?? "");
      if (focused === name) return;
    }
    assert.fail(`no way to ${name}`);
  };
  await tabTo("Try the samples");
  await page.keyboard.press("Enter");
  await page.locator("canvas").waitFor();
  await settle(page);
  const first = await pixels(page);
  await page.keyboard.press("ArrowLeft");
  await settle(page);
  assert.ok(difference(first, await pixels(page)) > 0.005, "the picture has the focus");
  await tabTo("Pose");
  const coming = page.waitForEvent("download");
  await page.keyboard.press("Enter");
  assert.equal((await coming).suggestedFilename(), "T_target_source.txt");
  await page.locator("body").press("Escape");
  await page.getByRole("button", { name: "Files and settings" }).focus();
  await page.keyboard.press("Enter");
  assert.equal(await page.evaluate(() => document.activeElement?.textContent), "Register");
  assert.deepEqual(wrong, []);
  await close();
});

test("is readable on a phone, light and dark", async () => {
  const backgrounds = [];
  for (const colorScheme of /** @type {const} */ (["light", "dark"])) {
    const { page, wrong, close } = await open(built, {
      viewport: { width: 360, height: 740 }, hasTouch: true, isMobile: true, colorScheme,
    });
    for (const act of [async () => {}, async () => {
      await page.getByRole("button", { name: "Try the samples" }).tap();
      await page.locator("canvas").waitFor();
      await settle(page);
    }]) {
      await act();
      assert.ok(await page.evaluate(() => document.documentElement.scrollWidth) <= 360, "nothing stands out");
      const low = await page.evaluate(() => [...document.querySelectorAll("button, .slot")]
        .filter((b) => b instanceof HTMLElement && b.offsetParent !== null && b.getBoundingClientRect().height < 40).map((b) => b.textContent));
      assert.deepEqual(low, [], "fingers hit the buttons");
    }
    backgrounds.push(await page.evaluate(() => getComputedStyle(document.body).backgroundColor));
    assert.deepEqual(wrong, []);
    await close();
  }
  assert.notEqual(backgrounds[0], backgrounds[1]);
});

/** Waits until the page has told that stage.
 *  @param {import("playwright-core").Page} page
 *  @param {string} stage */
async function reached(page, stage) {
  const late = performance.now() + 180_000;
  while (!await page.evaluate(`stages.includes(${JSON.stringify(stage)})`)) {
    assert.ok(performance.now() < late, `${stage} is not reached`);
    await page.waitForTimeout(20);
  }
}

test("a million points a scan: the page answers meanwhile, and can be told to stop", async () => {
  const next = random(5);
  /** @param {number} from */
  const hill = (from) => () => {
    const [u, v] = [from + 10 * next(), 10 * next()];
    return /** @type {[number, number, number]} */ ([u, v, Math.sin(u) + 0.4 * Math.cos(3 * v + u) + 0.02 * u * v]);
  };
  const scans = [ply("hill-a.ply", 1_000_000, hill(0)), ply("hill-b.ply", 1_000_000, hill(1))];
  const { page, wrong, close } = await open(built);
  await page.evaluate(`{
    window.slowest = 0;
    let last = performance.now();
    const watch = (now) => {
      window.slowest = Math.max(window.slowest, now - last);
      last = now;
      requestAnimationFrame(watch);
    };
    requestAnimationFrame(watch);
    window.stages = [];
    const status = document.querySelector(".working [role=status]");
    new MutationObserver(() => stages.push(status.textContent)).observe(status, { childList: true });
  }`);
  await page.locator("#file-0").setInputFiles(scans[0] ?? "");
  await page.locator("#file-1").setInputFiles(scans[1] ?? "");
  await reached(page, "preparing");
  await page.getByRole("button", { name: "Cancel" }).click();
  await page.getByRole("button", { name: "Register" }).waitFor();
  assert.ok(await page.getByRole("progressbar").isHidden());
  assert.equal(await page.locator("canvas").count(), 0);

  await page.evaluate("slowest = 0; stages.length = 0");
  const start = performance.now();
  await page.getByRole("button", { name: "Register" }).click();
  await reached(page, "drawing");
  const [slowest, stages] = /** @type {[number, string[]]} */ (await page.evaluate("[slowest, stages]"));
  await page.locator("canvas").waitFor({ timeout: 180_000 });
  await settle(page);
  const took = performance.now() - start;
  const passed = stages.filter((stage) => stage !== "");
  assert.deepEqual([...passed.slice(0, 3), ...passed.slice(-2)], ["reading", "preparing", "looking for poses", "verifying", "drawing"]);
  assert.ok(farthest(await pose(page), told(...scans)) < 1e-4);
  const first = await pixels(page);
  await page.mouse.move(300, 300);
  await page.mouse.down();
  await page.mouse.move(360, 320, { steps: 6 });
  await page.mouse.up();
  await settle(page);
  assert.ok(difference(first, await pixels(page)) > 0.005, "it turns");
  console.log(`2 x 1,000,000 points in the page: read, registered and shown after ${(took / 1000).toFixed(1)} s; the slowest frame meanwhile ${slowest.toFixed(0)} ms`);
  // The page has a thread of its own; it may have to wait for a processor, not for the registration.
  assert.ok(slowest < 2000, `a frame took ${slowest} ms`);
  assert.deepEqual(wrong, []);
  await close();
});
