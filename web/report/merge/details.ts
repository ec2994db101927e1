/** What is known of the scan or the pair that is looked at; of all, where none is. */

import type { Rows } from "@upcr/viewer";

import { Copying } from "../copy.ts";
import { button, choice, count, el, number, section, table } from "../dom.ts";
import { DEGREES, deviation, leftOut, type MergePage, PROPOSALS, type Selection, sizes, stateOf } from "./contents.ts";
import { isInOneModel, type Laying } from "./view.ts";

const BECAME = {
  kept: "Kept: the poses rest on it.",
  dropped: "Dropped: trusted as a pair, but at odds with the other pairs.",
  untrusted: "Not trusted: nothing rests on it.",
} as const;
const CONTRADICTED = "Dropped: trusted as a pair, but what it would lay on each other besides does not fit there.";

export interface Actions {
  select: (selection: Selection) => void;
  lay: (laying: Laying) => void;
  pairsOf: (scan: number) => void;
}

/** How something is laid at first. */
export function firstLaying(page: MergePage, selection: Selection): Laying {
  if (selection.kind === "scan") return "alone";
  const pair = selection.kind === "pair" ? page.merge.pairs[selection.pair] : undefined;
  return pair && !pair.kept ? "own" : "model";
}

function pose(name: string, about: string, rows: Rows): HTMLElement {
  const copying = new Copying(name);
  copying.show(rows.map((row) => row.map(String).join(" ")).join("\n"));
  return section("Pose", el("p", { class: "quiet" }, about), copying.text, el("div", { class: "row" }, ...copying.row));
}

function ofPair(page: MergePage, index: number, actions: Actions): (Node | string)[] {
  const pair = page.merge.pairs[index];
  if (!pair) return [];
  const name = (scan: number, color: number) => {
    const made = button("", () => actions.select({ kind: "scan", scan }), { class: "plain", title: "See this scan" });
    made.append(el("span", { class: `swatch cloud-${color}`, "aria-hidden": "true" }), el("bdi", {}, page.scans[scan]?.name ?? ""));
    return made;
  };
  const state = stateOf(pair);
  const turn = deviation(pair, 0) * DEGREES;
  const shift = deviation(pair, 1);
  const laying = isInOneModel(page, pair)
    ? choice<Laying>("How the pair is laid", [["own", "As this pair says"], ["model", "As in the model"]], firstLaying(page, { kind: "pair", pair: index }), actions.lay).element
    : el("p", { class: "quiet" }, "In the picture they lie as this pair says.");
  return [
    el("header", {}, el("p", { class: "quiet" }, "Pair"), el("h2", { class: "pair" }, name(pair.source, 0), " → ", name(pair.target, 1)),
      el("p", { class: `became ${state}` }, pair.contradicted ? CONTRADICTED : BECAME[state]), laying),
    section("Figures", table([
      ["Probability", `${pair.probability.toFixed(3)}, trusted from ${page.threshold}`],
      ["Fitness", pair.fitness.toFixed(4)],
      ["May be off by", `${Number.isFinite(turn) ? number(turn) : "–"}°, ${Number.isFinite(shift) ? number(shift) : "–"}`],
      ["χ² of six", pair.chi_sq === null ? "–" : number(pair.chi_sq)],
      ["Proposed by", PROPOSALS[pair.proposal]],
    ]), pair.reasons.length > 0
      ? el("ul", {}, ...pair.reasons.map((reason) => el("li", {}, el("code", {}, reason), ` ${page.reasons[reason] ?? ""}`)))
      : el("p", { class: "quiet" }, "Nothing speaks against it.")),
    pose("The pair’s pose", "T_target_source: takes source coordinates to target coordinates. Copy gives all digits.", pair.T_target_source),
  ];
}

function ofScan(page: MergePage, scan: number, actions: Actions): (Node | string)[] {
  const [told, place] = [page.scans[scan], page.merge.places[scan]];
  if (!told || !place) return [];
  const registered = page.merge.pairs.filter((pair) => pair.source === scan || pair.target === scan).length;
  const laying = place.state === "placed"
    ? choice<Laying>("What is seen", [["alone", "By itself"], ["held", "With its kept pairs"]], "alone", actions.lay).element
    : null;
  const why = leftOut(place);
  return [
    el("header", {}, el("p", { class: "quiet" }, "Scan"), el("h2", {}, el("bdi", {}, told.name)),
      el("p", { class: why === null ? "" : "became dropped" }, place.state === "placed"
        ? `In model ${place.model + 1}, held by ${count(place.pairs)} ${place.pairs === 1 ? "pair" : "pairs"}; one of them at least is right with probability ${place.probability.toFixed(3)}.`
        : `Left out: ${why ?? ""}.`),
      el("div", { class: "row wrap" }, laying, registered > 0 ? button(`Its ${count(registered)} pairs`, () => actions.pairsOf(scan), { title: "Show them in the table" }) : null)),
    ...(place.state === "placed" ? [pose("The scan’s pose", "T_model_scan: takes the scan’s coordinates to the model’s. Copy gives all digits.", place.T_model_scan)] : []),
  ];
}

function ofAll(page: MergePage): (Node | string)[] {
  const shown = page.scans.reduce((sum, { drawn }) => sum + (drawn?.shown ?? 0), 0);
  const points = page.scans.reduce((sum, { drawn }) => sum + (drawn?.points ?? 0), 0);
  const [largest] = sizes(page.merge.places);
  return [
    el("header", {}, el("h2", {}, "All scans"),
      el("p", { class: "quiet" }, "Choose a scan or a pair, in the graph or in a table, to see it alone and why it was kept or not.")),
    section("Figures", table([
      ["Scans", count(page.scans.length)],
      ["In the largest model", count(largest ?? 0)],
      ["Voxel size", number(page.merge.voxel_size)],
      ["Pairs trusted from", String(page.threshold)],
      ["Covariances multiplied by", number(page.merge.inflation)],
      ["Points", shown < points ? `${count(shown)} of ${count(points)} drawn` : count(points)],
    ])),
  ];
}

export function details(page: MergePage, selection: Selection, actions: Actions): (Node | string)[] {
  if (selection.kind === "pair") return ofPair(page, selection.pair, actions);
  return selection.kind === "scan" ? ofScan(page, selection.scan, actions) : ofAll(page);
}
