/** The pairs and the scans as tables. */

import { choice, count, el, number } from "../dom.ts";
import { DEGREES, deviation, leftOut, type MergePage, type PairState, PROPOSALS, type Selection, stateOf, STATES } from "./contents.ts";
import { type Column, SortedTable } from "./sorted.ts";

export function named(text: string): HTMLElement {
  return el("bdi", { class: "name", title: text }, text);
}

export class Tables {
  readonly element: HTMLElement;
  onSelect: (selection: Selection) => void = () => {};

  readonly #which;
  readonly #pairs: SortedTable<number>;
  readonly #scans: SortedTable<number>;
  readonly #state: HTMLSelectElement;
  readonly #name: HTMLInputElement;
  readonly #page: MergePage;
  readonly #states: readonly PairState[];

  constructor(page: MergePage) {
    this.#page = page;
    const { pairs, places } = page.merge;
    this.#states = pairs.map(stateOf);
    const name = (scan: number) => page.scans[scan]?.name ?? "";
    const order = Object.keys(STATES) as PairState[];
    const pairOf = (i: number) => {
      const pair = pairs[i];
      if (!pair) throw new RangeError(`there is no pair ${i}`);
      return pair;
    };
    const state = (i: number) => this.#states[i] ?? "untrusted";
    const figure = (title: string, about: string, key: (i: number) => number, show: (value: number) => string): Column<number> =>
      ({ name: title, about, key, show: (i) => (Number.isFinite(key(i)) ? show(key(i)) : "–"), numeric: true });
    const numbers = pairs.map((_, i) => i);
    this.#pairs = new SortedTable("Pairs", numbers, [
      { name: "Source", about: "The scan that is moved", key: (i) => name(pairOf(i).source), show: (i) => named(name(pairOf(i).source)), numeric: false },
      { name: "Target", about: "The scan that stays", key: (i) => name(pairOf(i).target), show: (i) => named(name(pairOf(i).target)), numeric: false },
      {
        name: "State", about: "Kept: the poses rest on it. Dropped: trusted as a pair, and at odds with the others. Not trusted: its probability is too low",
        key: (i) => order.indexOf(state(i)), show: (i) => el("span", { class: `state ${state(i)}` }, STATES[state(i)]), numeric: false,
      },
      figure("Probability", "That the pose of the pair is right", (i) => pairOf(i).probability, (v) => v.toFixed(3)),
      figure("Fitness", "Share of the source’s points within one voxel of the target", (i) => pairOf(i).fitness, (v) => v.toFixed(3)),
      figure("± °", "Standard deviation of the rotation, in degrees, as the pair’s covariance has it", (i) => DEGREES * deviation(pairOf(i), 0), number),
      figure("± length", "Standard deviation of the translation, in the scans’ unit, as the pair’s covariance has it", (i) => deviation(pairOf(i), 1), number),
      figure("χ²", "Squared error against the poses of all, under its covariance; six degrees of freedom", (i) => pairOf(i).chi_sq ?? NaN, number),
      { name: "Proposed by", about: "Why these two were registered", key: (i) => PROPOSALS[pairOf(i).proposal], show: (i) => PROPOSALS[pairOf(i).proposal], numeric: false },
      {
        name: "Against it", about: "What speaks against the pose of the pair", key: (i) => pairOf(i).reasons.join(" "), numeric: false,
        show: (i) => el("span", { title: pairOf(i).reasons.map((reason) => page.reasons[reason] ?? reason).join("; ") }, pairOf(i).reasons.map((reason) => reason.replaceAll("_", " ")).join(", ") || "–"),
      },
    ], 2);
    const why = (scan: number) => {
      const place = places[scan];
      return place ? leftOut(place) : null;
    };
    const placed = (scan: number) => {
      const place = places[scan];
      return place?.state === "placed" ? place : null;
    };
    this.#scans = new SortedTable("Scans", page.scans.map((_, i) => i), [
      { name: "Scan", about: "Its file", key: name, show: (scan) => named(name(scan)), numeric: false },
      {
        name: "Model", about: "The model that it lies in", key: (scan) => placed(scan)?.model ?? -1,
        show: (scan) => {
          const model = placed(scan)?.model;
          return model === undefined ? el("span", { class: "state dropped" }, "left out") : `model ${model + 1}`;
        }, numeric: false,
      },
      figure("Kept pairs", "Pairs that hold it", (scan) => placed(scan)?.pairs ?? NaN, count),
      figure("Probability", "That one of these pairs at least is right", (scan) => placed(scan)?.probability ?? NaN, (v) => v.toFixed(3)),
      figure("Points", "In its file", (scan) => page.scans[scan]?.drawn?.points ?? NaN, count),
      { name: "Why it is left out", about: "Of scans without a model", key: (scan) => why(scan) ?? "", show: (scan) => why(scan) ?? "–", numeric: false },
    ], 1);
    this.#pairs.onChosen = (pair) => this.onSelect({ kind: "pair", pair });
    this.#scans.onChosen = (scan) => this.onSelect({ kind: "scan", scan });

    const many = (of: PairState) => this.#states.filter((s) => s === of).length;
    this.#state = el("select", { "aria-label": "State" }, el("option", { value: "" }, "all states"),
      ...order.map((s) => el("option", { value: s }, `${STATES[s]} (${count(many(s))})`)));
    this.#name = el("input", { type: "search", placeholder: "scan’s name", "aria-label": "Scan’s name has", size: 14 });
    this.#state.addEventListener("change", () => this.#filter());
    this.#name.addEventListener("input", () => this.#filter());
    const show = (value: "pairs" | "scans") => {
      this.#pairs.element.hidden = this.#state.hidden = value !== "pairs";
      this.#scans.element.hidden = value !== "scans";
    };
    this.#which = choice<"pairs" | "scans">("Table", [
      ["pairs", `Pairs (${count(pairs.length)})`], ["scans", `Scans (${count(page.scans.length)})`],
    ], "pairs", show);
    show("pairs");
    this.element = el("section", { class: "pane tables", "aria-label": "Tables" },
      el("div", { class: "toolbar" }, this.#which.element, el("span", { class: "gap" }), this.#state, this.#name),
      this.#pairs.element, this.#scans.element);
  }

  /** The pairs with that scan. */
  showPairsOf(scan: number): void {
    this.#state.value = "";
    this.#name.value = this.#page.scans[scan]?.name ?? "";
    this.#filter();
    this.#which.choose("pairs");
  }

  select(selection: Selection): void {
    this.#pairs.mark(selection.kind === "pair" ? selection.pair : null);
    this.#scans.mark(selection.kind === "scan" ? selection.scan : null);
  }

  #filter(): void {
    const wanted = this.#name.value.trim().toLowerCase();
    const state = this.#state.value;
    const has = this.#page.scans.map((scan) => scan.name.toLowerCase().includes(wanted));
    this.#scans.filter((scan) => has[scan] ?? false);
    this.#pairs.filter((i) => {
      const pair = this.#page.merge.pairs[i];
      return pair !== undefined && (state === "" || this.#states[i] === state) && ((has[pair.source] ?? false) || (has[pair.target] ?? false));
    });
  }
}
