/** What is told of a registration: verdict, figures, times, settings. */

import type { Page } from "./contents.ts";
import { count, el, number, section, table } from "./dom.ts";

export function verdict({ verdict: v, registration: r }: Page): HTMLElement | null {
  if (!v || !r) return null;
  const p = r.probability.toFixed(3);
  const bar = el("div", { class: "bar", role: "img", "aria-label": `probability ${p}, registered from ${v.threshold} on` }, el("i"), el("u"));
  const [fill, mark] = bar.children;
  if (fill instanceof HTMLElement) fill.style.width = `${100 * r.probability}%`;
  if (mark instanceof HTMLElement) mark.style.left = `${100 * v.threshold}%`;
  const points = [
    ...v.reasons.map(({ name, text }) => el("li", {}, el("code", {}, name), ` ${text}`)),
    ...(v.source_scale === null ? [] : [el("li", {}, `they fit once the source’s lengths are multiplied by ${number(v.source_scale)}`)]),
    ...v.free.map((text) => el("li", {}, text)),
  ];
  return el("section", { class: v.registered ? "verdict good" : "verdict bad" },
    el("h2", {}, v.registered ? "Registered" : "Not registered"),
    el("p", {}, "The pose is right with probability ", el("b", {}, p), "."),
    bar,
    points.length > 0 ? el("ul", {}, ...points) : el("p", { class: "quiet" }, "Nothing speaks against it."));
}

export function figures({ registration: r }: Page): HTMLElement | null {
  if (!r) return null;
  return section("Figures", table([
    ["Fitness", `${r.fitness.toFixed(4)}, ${count(r.num_inliers)} points`],
    ["RMSE of these", number(r.inlier_rmse)],
    ["Voxel size", number(r.voxel_size)],
    ["First pose from", r.method],
    ["Refinement", `${r.converged ? "converged" : "not converged"} after ${r.iterations} iterations`],
    ["Points used", r.points_used.map(count).join(", ")],
  ]));
}

function flat(value: Record<string, unknown>, before = ""): [string, string][] {
  return Object.entries(value).flatMap(([name, v]): [string, string][] => {
    if (typeof v === "object" && v !== null && !Array.isArray(v)) return flat(v as Record<string, unknown>, `${name}.`);
    return [[before + name, v === null ? "–" : typeof v === "string" ? v : JSON.stringify(v)]];
  });
}

export function details({ registration: r }: Page): HTMLElement | null {
  if (!r) return null;
  const times = Object.entries(r.timings_ms).map(([name, ms]): [string, string] => [name, `${ms.toFixed(1)} ms`]);
  return el("section", {},
    el("details", {}, el("summary", {}, `Timings: ${(r.timings_ms["total"] ?? 0).toFixed(1)} ms, reading not counted`), table(times)),
    el("details", {}, el("summary", {}, "Settings"), table(flat(r.settings))));
}
