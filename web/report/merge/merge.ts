/** The page of a merge: its models in 3-D, the graph of its pairs, both as tables, and all that is known of the one looked at. */

import type { Coloring } from "@upcr/viewer";

import type { Bytes } from "../contents.ts";
import { adopt, choice, count, el, number } from "../dom.ts";
import { keyboard } from "../keys.ts";
import { COLORS, Stage } from "../stage.ts";
import { colorsOf, type MergePage, type Selection, sizes, stateOf } from "./contents.ts";
import { details, firstLaying } from "./details.ts";
import { Graph } from "./graph.ts";
import style from "./merge.css";
import { Tables } from "./tables.ts";
import { clouds, type Laying, seen } from "./view.ts";

function plural(n: number, one: string, many: string): string {
  return `${count(n)} ${n === 1 ? one : many}`;
}

/** What became of all, in words. */
export function headline(page: MergePage): { title: string; whole: boolean; words: string } {
  const { places, pairs } = page.merge;
  const models = sizes(places);
  const placed = models.reduce((sum, n) => sum + n, 0);
  const out = places.length - placed;
  const kept = pairs.filter((pair) => pair.kept).length;
  const dropped = pairs.filter((pair) => stateOf(pair) === "dropped").length;
  const title = placed === 0 ? `None of ${plural(places.length, "scan", "scans")} could be placed`
    : `${out === 0 ? `All ${count(placed)}` : `${count(placed)} of ${count(places.length)}`} scans in ${models.length === 1 ? "one model" : `${count(models.length)} models`}${out > 0 ? `, ${count(out)} left out` : ""}`;
  const words = `${plural(pairs.length, "pair was", "pairs were")} registered: ${count(kept)} kept, ${count(dropped)} dropped for being at odds with the others, `
    + `${count(pairs.length - kept - dropped)} not trusted. Voxel size ${number(page.merge.voxel_size)}.`;
  return { title, whole: models.length === 1 && out === 0, words };
}

/** Puts the page into `host`. */
export function showMerge(host: HTMLElement, page: MergePage, bytes: Bytes): void {
  adopt(style);
  // It stays as long as the document does.
  const { signal } = new AbortController();
  const models = sizes(page.merge.places);
  const colors = colorsOf(page.scans.length, page.merge.pairs, COLORS);
  let selection: Selection = { kind: "all" };
  let laying: Laying = "model";
  let model = 0;

  const stage = new Stage(clouds(page, bytes), plural(page.scans.length, "scan", "scans"), false, signal);
  // A pair is as orange and blue as that of a registration.
  const color = (scan: number) => {
    const pair = selection.kind === "pair" ? page.merge.pairs[selection.pair] : undefined;
    return pair?.source === scan ? 0 : pair?.target === scan ? 1 : colors[scan] ?? 0;
  };
  stage.color = color;
  const caption = el("p", { id: "caption", role: "status" });
  stage.element.append(caption);

  const hasOwn = page.scans.some((scan) => scan.drawn?.colors);
  const coloring = choice<Coloring>("Colours", [["clouds", "By scan"], ["own", "The files’"]], "clouds", (value) => stage.viewer?.setColoring(value, 1));
  const which = el("select", { id: "model", "aria-label": "Model" }, ...models.map((n, m) =>
    el("option", { value: m }, `Model ${m + 1}: ${plural(n, "scan", "scans")}`)));
  which.addEventListener("change", () => {
    model = Number(which.value);
    select({ kind: "all" });
  });

  const graph = new Graph(page, color, signal);
  const tables = new Tables(page);
  const about = el("div");
  graph.onSelect = tables.onSelect = select;
  const lay = (value: Laying) => {
    laying = value;
    show();
  };

  function select(next: Selection): void {
    selection = next;
    laying = firstLaying(page, next);
    const first = next.kind === "scan" ? next.scan : next.kind === "pair" ? page.merge.pairs[next.pair]?.target : undefined;
    const place = page.merge.places[first ?? -1];
    if (place?.state === "placed") {
      model = place.model;
      which.value = String(model);
    }
    about.replaceChildren(...details(page, next, { select, lay, pairsOf: (scan) => tables.showPairsOf(scan) }));
    about.parentElement?.scrollTo(0, 0);
    graph.select(next);
    graph.showModel(models.length > 1 ? model : null);
    tables.select(next);
    stage.paint();
    show();
  }

  function show(): void {
    stage.viewer?.showOnly(seen(page, selection, laying, model));
    caption.replaceChildren(...told());
  }

  /** What is seen. */
  function told(): (Node | string)[] {
    const name = (scan: number) => el("span", { class: "swatched" },
      el("span", { class: `swatch cloud-${color(scan)}`, "aria-hidden": "true" }), el("bdi", {}, page.scans[scan]?.name ?? ""));
    if (selection.kind === "pair") {
      const pair = page.merge.pairs[selection.pair];
      return pair ? [name(pair.source), name(pair.target), laying === "own" ? "as this pair’s registration lays them" : "as the model has them"] : [];
    }
    if (selection.kind === "scan") {
      return [name(selection.scan), laying === "held" ? "with the scans of its kept pairs" : page.scans[selection.scan]?.drawn ? "by itself" : "cannot be drawn"];
    }
    return [models.length === 0 ? "No scan has a place. Choose a pair to see how it was laid." : `Model ${model + 1}: ${plural(models[model] ?? 0, "scan", "scans")}`];
  }

  const menu = el("details", { class: "menu" }, el("summary", {}, "Display"), el("div", {}, ...stage.fields()));
  document.addEventListener("pointerdown", ({ target }) => {
    if (target instanceof Node && !menu.contains(target)) menu.open = false;
  }, { signal });
  const escape = () => {
    if (menu.open) menu.open = false;
    else select({ kind: "all" });
  };
  const help = keyboard([
    { shown: "Esc", about: "all scans", acts: { Escape: escape } },
    ...stage.keys(),
  ], signal);
  const { title, whole, words } = headline(page);
  document.title = `UPCR: ${title}`;
  host.prepend(
    el("main", { class: "merge" },
      el("header", { class: `verdict ${whole ? "good" : "bad"}` },
        el("p", { class: "quiet" }, `UPCR ${page.version}`), el("h1", {}, title), el("p", {}, words)),
      el("div", { class: "upper" },
        el("div", { id: "picture" },
          el("div", { class: "toolbar", role: "toolbar", "aria-label": "View" },
            models.length > 1 ? which : null, hasOwn ? coloring.element : null,
            menu,
            el("span", { class: "gap" }), ...stage.buttons(() => help.showModal())),
          stage.element),
        graph.element),
      el("div", { class: "lower" },
        tables.element,
        el("aside", { "aria-label": "Details" }, about))),
    help);
  stage.paint();
  select(selection);
}
