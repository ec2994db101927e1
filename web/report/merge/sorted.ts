/** A table of many rows: sorted by its headers, some hundred rows at a time. */

import { button, count, el } from "../dom.ts";

export interface Column<Row> {
  name: string;
  /** What the name means, for whoever points at it. */
  about: string;
  /** What it is sorted by; no number comes last. */
  key: (row: Row) => number | string;
  show: (row: Row) => string | Node;
  numeric: boolean;
}

/** Rows that are drawn, and that more are. */
const STEP = 200;

export class SortedTable<Row> {
  readonly element: HTMLElement;
  /** A row was chosen; its number among all. */
  onChosen: (index: number) => void = () => {};

  readonly #rows: readonly Row[];
  readonly #columns: readonly Column<Row>[];
  readonly #body = el("tbody");
  readonly #headers: HTMLElement[];
  readonly #told = el("span", { class: "quiet", role: "status" });
  readonly #more = button("", () => this.#showMore());
  #order: number[];
  #sorted: number;
  #falling = false;
  #kept: (row: Row) => boolean = () => true;
  #shown = STEP;
  #chosen: number | null = null;

  /** @param first the column it is sorted by. */
  constructor(label: string, rows: readonly Row[], columns: readonly Column<Row>[], first: number) {
    this.#rows = rows;
    this.#columns = columns;
    this.#order = rows.map((_, i) => i);
    this.#sorted = first;
    this.#headers = columns.map((column, i) => el("th", { scope: "col", class: column.numeric ? "numeric" : "" },
      button(column.name, () => this.#sort(i), { title: column.about })));
    this.#body.addEventListener("click", (event) => {
      const row = event.target instanceof Element ? event.target.closest("tr") : null;
      const index = row?.dataset["row"];
      // What is marked to be copied is not meant to be chosen.
      if (index !== undefined && getSelection()?.isCollapsed !== false) this.onChosen(Number(index));
    });
    this.element = el("div", { class: "sorted" },
      el("div", { class: "scrolls", tabindex: 0, role: "region", "aria-label": label },
        el("table", { class: "rows" }, el("thead", {}, el("tr", {}, ...this.#headers)), this.#body),
        el("p", { class: "row end" }, this.#told, this.#more)));
    this.#arrange();
  }

  filter(kept: (row: Row) => boolean): void {
    this.#kept = kept;
    this.#shown = STEP;
    this.#arrange();
  }

  /** Marks a row, and brings it into sight where it is drawn. */
  mark(index: number | null): void {
    this.#chosen = index;
    for (const row of this.#body.rows) this.#markRow(row);
    if (index !== null) this.#body.querySelector(`tr[data-row="${index}"]`)?.scrollIntoView({ block: "nearest" });
  }

  #sort(column: number): void {
    this.#falling = this.#sorted === column ? !this.#falling : this.#columns[column]?.numeric ?? false;
    this.#sorted = column;
    this.#arrange();
  }

  #arrange(): void {
    const column = this.#columns[this.#sorted];
    if (!column) return;
    const keys = this.#rows.map(column.key);
    const sign = this.#falling ? -1 : 1;
    const none = (key: number | string | undefined) => key === undefined || Number.isNaN(key);
    this.#order = this.#rows.flatMap((row, i) => (this.#kept(row) ? [i] : [])).sort((i, j) => {
      const [a, b] = [keys[i], keys[j]];
      if (none(a) || none(b)) return Number(none(a)) - Number(none(b)) || i - j;
      const by = typeof a === "number" && typeof b === "number" ? a - b : String(a) < String(b) ? -1 : String(a) > String(b) ? 1 : 0;
      return sign * by || i - j;
    });
    this.#headers.forEach((header, i) =>
      header.setAttribute("aria-sort", i === this.#sorted ? (this.#falling ? "descending" : "ascending") : "none"));
    this.#body.replaceChildren();
    this.#fill(0);
  }

  #showMore(): void {
    const from = this.#shown;
    this.#shown += STEP;
    this.#fill(from);
    // The button may be gone, and where it was there are rows now.
    this.#body.rows[from]?.querySelector("button")?.focus();
  }

  #fill(from: number): void {
    this.#body.append(...this.#order.slice(from, this.#shown).map((index) => this.#row(index)));
    const [all, shown] = [this.#order.length, Math.min(this.#shown, this.#order.length)];
    this.#told.textContent = all === 0 ? "None."
      : shown < all ? `${count(shown)} of ${count(all)} shown`
      : all < this.#rows.length ? `${count(all)} of ${count(this.#rows.length)}` : `${count(all)} in all`;
    this.#more.hidden = shown >= all;
    this.#more.textContent = `Show ${count(Math.min(STEP, all - shown))} more`;
  }

  #row(index: number): HTMLTableRowElement {
    const row = this.#rows[index];
    const made = el("tr", { "data-row": index });
    if (row !== undefined) {
      made.append(...this.#columns.map((column, i) => {
        const shown = column.show(row);
        const [tag, attributes] = i === 0 ? ["th", { scope: "row" }] as const : ["td", { class: column.numeric ? "numeric" : "" }] as const;
        // The click is the row's.
        return el(tag, attributes, i === 0 ? el("button", { type: "button", class: "plain" }, shown) : shown);
      }));
    }
    this.#markRow(made);
    return made;
  }

  #markRow(row: HTMLTableRowElement): void {
    const is = row.dataset["row"] === String(this.#chosen);
    row.classList.toggle("chosen", is);
    row.querySelector("button")?.setAttribute("aria-pressed", String(is));
  }
}
