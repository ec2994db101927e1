/** The page: two scans in, how one lies on the other out, and nothing leaves the machine. */

import { Contents } from "@upcr/report/contents.ts";
import { adopt, button, el } from "@upcr/report/dom.ts";
import { decode, take } from "@upcr/report/embedded.ts";
import { type Report, showReport } from "@upcr/report/report.ts";
import { turnTheme } from "@upcr/report/theme.ts";
import reportStyle from "@upcr/report/style.css";

import { Cancelled, Engine } from "./engine.ts";
import type { Choices } from "./messages.ts";
import { Pair } from "./pair.ts";
import { saving } from "./save.ts";
import style from "./style.css";

adopt(reportStyle);
adopt(style);
const root = document.documentElement;

async function unpack(id: string): Promise<ArrayBuffer> {
  const stream = new Blob([decode(take(id))]).stream().pipeThrough(new DecompressionStream("gzip"));
  return new Response(stream).arrayBuffer();
}

/** Reads them once. */
const samples = (() => {
  let read: Promise<File[]> | null = null;
  return () => (read ??= Promise.all(["source.ply", "target.ply"].map(async (name) => new File([await unpack(name)], name))));
})();

// The form.

const select = (id: string, options: readonly (readonly [string, string])[]) =>
  el("select", { id }, ...options.map(([value, name]) => el("option", { value }, name)));
const method = select("method", [
  ["auto", "Automatic"], ["features", "Features"], ["upcr", "UPCR network"], ["consensus", "Consensus of matches"],
  ["fgr", "Fast Global Registration"], ["ransac", "RANSAC"], ["prior", "As they lie"],
]);
const refine = select("refine", [
  ["gicp", "Generalized ICP"], ["plane", "Point to plane"], ["point", "Point to point"], ["none", "None"],
]);
const voxel = el("input", { id: "voxel", type: "number", min: 0, step: "any", placeholder: "from the scans" });

function choices(): Choices {
  return {
    method: method.value, refine: refine.value,
    ...(voxel.value.trim() === "" ? {} : { voxel_size: voxel.valueAsNumber }),
  };
}

const pair = new Pair();
const go = button("Register", () => void run(), { class: "go", disabled: true });
const sample = button("Try the samples", () => void samples().then((files) => pair.take(files)));
const failed = el("p", { class: "failed", role: "alert", hidden: true });
const formats = el("p", { class: "quiet" });
const stage = el("span", { role: "status" });
const bar = el("progress", { max: 1, value: 0, "aria-label": "Progress" });
const working = el("div", { class: "working", hidden: true }, el("div", { class: "row" }, stage, el("span", { class: "gap" }),
  button("Cancel", () => engine?.cancel())), bar);
const form = el("main", { class: "form" },
  el("header", {},
    el("h1", {}, "UPCR"), el("span", { class: "gap" }), button("Theme", turnTheme, { title: "Light or dark" })),
  el("p", { class: "lead" }, "Drop two scans of the same thing: this page finds the rigid pose that lays the source on the target, and says whether it is to be trusted."),
  pair.element,
  el("div", { class: "row" }, go, pair.swap, sample),
  working, failed,
  el("p", { class: "private" }, el("b", {}, "Your files stay on this machine."),
    " The page carries the whole program and has no way to send anything: its own policy forbids every connection. It works without a network; save it, and it works from your disk."),
  el("details", {}, el("summary", {}, "Settings"),
    el("div", { class: "field" }, el("label", { for: "method" }, "First pose from"), method),
    el("div", { class: "field" }, el("label", { for: "refine" }, "Refinement"), refine),
    el("div", { class: "field" }, el("label", { for: "voxel" }, "Voxel size, in the scans’ unit"), voxel)),
  formats);
document.body.prepend(form);

// What is done.

let engine: Engine | null = null;
let report: Report | null = null;

function fail(error: unknown): void {
  failed.textContent = error instanceof Error ? error.message : String(error);
  failed.hidden = false;
}

function busy(is: boolean): void {
  working.hidden = !is;
  go.disabled = is || !pair.both || !engine;
  sample.disabled = is;
  pair.hold(is);
}

async function run(): Promise<void> {
  const { both } = pair;
  if (!both || !engine || !working.hidden) return;
  back();
  failed.hidden = true;
  stage.textContent = "";
  bar.removeAttribute("value");
  busy(true);
  try {
    const { words, blobs, ms } = await engine.register(...both, choices());
    show(words, blobs);
    // For whoever measures from outside.
    root.dataset["ms"] = String(ms);
  } catch (error) {
    if (!(error instanceof Cancelled)) fail(error);
  }
  busy(false);
  // The button that had the focus is gone.
  if (!report) go.focus();
}

function show(words: string, blobs: ReadonlyMap<string, Uint8Array<ArrayBuffer>>): void {
  const held = engine;
  if (!held) return;
  const contents = new Contents(JSON.parse(words), (name) => blobs.get(name) ?? new Uint8Array());
  form.hidden = true;
  report = showReport(document.body, contents, {
    toolbar: button("Files and settings", back, { title: "Back to what was registered, and how" }),
    beside: (chosen) => saving(held, contents.page, contents.page.clouds[0]?.name ?? "", chosen),
  });
  document.querySelector("canvas")?.focus();
}

function back(): void {
  if (!report) return;
  report.dispose();
  report = null;
  form.hidden = false;
  go.focus();
}

pair.onBoth = () => void run();

// Files may be dropped anywhere, and none is opened instead of the page.
const over = (is: boolean) => form.classList.toggle("over", is);
document.addEventListener("dragover", (event) => {
  event.preventDefault();
  over(true);
});
document.addEventListener("dragleave", (event) => over(event.relatedTarget !== null));
document.addEventListener("drop", (event) => {
  event.preventDefault();
  over(false);
  const files = [...(event.dataTransfer?.files ?? [])];
  if (!working.hidden || files.length === 0) return;
  back();
  failed.hidden = files.length <= 2;
  failed.textContent = failed.hidden ? "" : `Two scans make a pair: ${files.length} are too many.`;
  if (failed.hidden) pair.take(files);
});

async function load(): Promise<void> {
  const module = await WebAssembly.compile(await unpack("module"));
  const loading = new Engine(module, take("worker"));
  const { version, extensions } = await loading.start();
  loading.onProgress = (name, done) => {
    if (stage.textContent !== name) stage.textContent = name;
    // How long drawing takes is not known.
    if (name === "drawing") bar.removeAttribute("value");
    else bar.value = done;
  };
  pair.accept(extensions);
  formats.textContent = `UPCR ${version}. Reads ${extensions.join(", ")}.`;
  engine = loading;
  busy(false);
  if (pair.both) await run();
  root.dataset["ready"] = "";
}

load().catch((error: unknown) => {
  fail(error);
  formats.textContent = "This page needs WebAssembly with SIMD: Chrome 91, Firefox 113, Safari 16.4 or newer.";
});
