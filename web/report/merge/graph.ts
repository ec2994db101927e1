/** The graph: a node a scan, an edge a pair. */

import { button, count, el, svg } from "../dom.ts";
import { leftOut, type MergePage, type Pair, type PairState, type Selection, shortNames, stateOf, STATES } from "./contents.ts";
import { type Layout, layout, LINES, type Node } from "./layout.ts";

/** Pixels from an edge, and from a node's rim, within which it is meant: fingers are wide. */
const coarse = matchMedia("(pointer: coarse)");
const reach = () => (coarse.matches ? { edge: 12, node: 12 } : { edge: 7, node: 4 });
/** Milliseconds after which a window that was resized has its size. */
const SETTLED = 150;
/** Pairs of a scan with which kept edges are as thick as they may be. */
const FEW = 5;

type Words = globalThis.Node | string;

export class Graph {
  readonly element: HTMLElement;
  onSelect: (selection: Selection) => void = () => {};

  readonly #page: MergePage;
  readonly #color: (scan: number) => number;
  readonly #states: readonly PairState[];
  readonly #nodes: readonly Node[];
  readonly #short: readonly string[];
  readonly #drawing = svg("svg", { class: "graph", role: "group", "aria-label": "Graph of scans and pairs. Arrow keys go from scan to scan, Enter chooses one." });
  /** Lies below: thousands of edges are not drawn anew for what is pointed at. */
  readonly #ground = svg("svg", { class: "edges", "aria-hidden": "true" });
  readonly #lit = svg("g");
  readonly #pane: HTMLElement;
  readonly #pointed = el("p", { class: "pointed quiet", "aria-hidden": "true" });
  #layout: Layout | null = null;
  /** Pairs that are drawn, from the lowest to what lies on top. */
  #edges: number[] = [];
  #pointedAt: Selection | null = null;
  #marks: SVGGElement[] = [];
  /** Of models, where there are several. */
  #frames: SVGElement[] = [];
  #untrusted = false;
  #model: number | null = null;
  #selection: Selection = { kind: "all" };
  #focus = 0;
  #timer = 0;

  /** @param color of each scan, as it is seen now. */
  constructor(page: MergePage, color: (scan: number) => number, signal: AbortSignal) {
    this.#page = page;
    this.#color = color;
    const { places, pairs } = page.merge;
    this.#states = pairs.map(stateOf);
    this.#short = shortNames(page.scans.map((scan) => scan.name));
    this.#nodes = page.scans.map((scan, i) => {
      const place = places[i];
      const name = this.#short[i] ?? "";
      if (place?.state === "placed") return { model: place.model, center: scan.center, label: name, weight: place.pairs };
      return { model: null, center: null, label: name, weight: -1 };
    });
    const reasons = places.map(leftOut);
    if (reasons.filter((reason) => reason !== null).length <= LINES) {
      this.#nodes = this.#nodes.map((node, i) => (reasons[i] ? { ...node, weight: Infinity, label: `${node.label}: left out, ${reasons[i]}` } : node));
    }
    this.#pane = el("div", { class: "drawing" }, this.#ground, this.#drawing);
    const many = this.#states.filter((state) => state === "untrusted").length;
    const box = el("input", { type: "checkbox", id: "untrusted", disabled: many === 0 });
    box.addEventListener("change", () => {
      this.#untrusted = box.checked;
      this.#draw();
    });
    const sample = (state: PairState) => svg("svg", { class: "sample", width: 26, height: 8, "aria-hidden": "true" },
      svg("line", { class: `edge ${state}`, x1: 1, y1: 4, x2: 25, y2: 4, "stroke-width": 2 }));
    const told = (state: PairState) => `${STATES[state]} (${count(this.#states.filter((s) => s === state).length)})`;
    this.element = el("section", { class: "pane", "aria-label": "Graph" },
      el("div", { class: "toolbar" },
        el("span", { class: "key" }, sample("kept"), told("kept")),
        el("span", { class: "key" }, sample("dropped"), told("dropped")),
        el("label", { class: "key", for: "untrusted" }, box, sample("untrusted"), told("untrusted")),
        el("span", { class: "gap" }),
        button("All scans", () => this.onSelect({ kind: "all" }), { title: "Back to all of them (Esc)" })),
      this.#pane, this.#pointed);
    this.#drawing.addEventListener("pointermove", (event) => this.#point(event));
    this.#drawing.addEventListener("pointerleave", () => this.#light(null));
    this.#drawing.addEventListener("click", (event) => this.onSelect(this.#at(event) ?? { kind: "all" }));
    this.#drawing.addEventListener("keydown", (event) => this.#key(event));
    this.#drawing.addEventListener("focusin", (event) => {
      const scan = this.#marks.findIndex((mark) => mark === event.target);
      if (scan >= 0) this.#light({ kind: "scan", scan });
    });
    this.#drawing.addEventListener("focusout", () => this.#light(null));
    const resized = new ResizeObserver(() => {
      clearTimeout(this.#timer);
      this.#timer = window.setTimeout(() => this.#arrange(), this.#layout ? SETTLED : 0);
    });
    resized.observe(this.#pane);
    signal.addEventListener("abort", () => resized.disconnect());
  }

  /** Marks what is looked at. */
  select(selection: Selection): void {
    this.#selection = selection;
    this.#mark();
  }

  /** The others step back; null: none does. */
  showModel(model: number | null): void {
    this.#model = model;
    this.#mark();
  }

  #arrange(): void {
    const { clientWidth: width, clientHeight: height } = this.#pane;
    if (width === 0 || height === 0) return;
    for (const drawing of [this.#ground, this.#drawing]) drawing.setAttribute("viewBox", `0 0 ${width} ${height}`);
    this.#layout = layout(this.#nodes, width, height);
    this.#draw();
  }

  #pair(index: number): Pair | undefined {
    return this.#page.merge.pairs[index];
  }

  #draw(): void {
    const placed = this.#layout;
    if (!placed) return;
    const { pairs, places } = this.#page.merge;
    // Few edges are strong, and many let each other be seen.
    const strength = (state: PairState) => {
      const ends = (2 * this.#states.filter((s) => s === state).length) / Math.max(this.#nodes.length, 1);
      return Math.min(1, Math.max(0.22, FEW / Math.max(ends, 1)));
    };
    const strengths = { kept: strength("kept"), dropped: 1, untrusted: strength("untrusted") };
    // What asks for a look lies on top.
    const order: readonly PairState[] = this.#untrusted ? ["untrusted", "kept", "dropped"] : ["kept", "dropped"];
    this.#edges = order.flatMap((state) => pairs.flatMap((_, index) => (this.#states[index] === state ? [index] : [])));
    this.#ground.replaceChildren();
    for (const index of this.#edges) {
      const pair = pairs[index];
      const state = this.#states[index] ?? "untrusted";
      const sure = Math.min(Math.max(((pair?.probability ?? 0) - this.#page.threshold) / (1 - this.#page.threshold), 0), 1);
      this.#ground.append(...this.#line(index, state === "kept"
        ? { "stroke-width": (0.8 + 1.4 * sure * Math.sqrt(strengths.kept)).toFixed(2), "stroke-opacity": (strengths.kept * (0.35 + 0.5 * sure)).toFixed(3) }
        : { "stroke-width": 1.6, "stroke-opacity": strengths[state] }));
    }
    this.#marks = this.#nodes.map((node, scan) => {
      const spot = placed.spots[scan] ?? { x: 0, y: 0 };
      const r = placed.radius;
      const place = places[scan];
      const name = this.#page.scans[scan]?.name ?? "";
      const about = place?.state === "placed" ? `${count(place.pairs)} pairs hold it` : `left out: ${place ? leftOut(place) : ""}`;
      const mark = svg("g", {
        class: `node${node.model === null ? " out" : ""}`, role: "button", tabindex: scan === this.#focus ? 0 : -1,
        transform: `translate(${spot.x.toFixed(1)} ${spot.y.toFixed(1)})`, "aria-label": `${name}, ${about}`,
      }, svg("title", {}, `${name}\n${about}`),
        node.model === null ? svg("rect", { x: -0.8 * r, y: -0.8 * r, width: 1.6 * r, height: 1.6 * r }) : svg("circle", { r }));
      return mark;
    });
    const several = placed.models.length > 1;
    this.#frames = several ? placed.models.map((box) => svg("rect", {
      x: box.x + 3, y: box.y + 3, width: Math.max(box.width - 6, 1), height: Math.max(box.height - 6, 1), rx: 6,
    })) : [];
    const frames: SVGElement[] = [...this.#frames];
    const titles = placed.models.flatMap((box, m) => (several && box.width > 60
      ? [svg("text", { class: "label quietly", x: box.x + 10, y: box.y + 14 }, `model ${m + 1}`)] : []));
    if (placed.leftOut) {
      const { x, y, width } = placed.leftOut;
      frames.push(svg("line", { x1: x + 8, y1: y, x2: x + width - 8, y2: y }));
    }
    const labels = placed.labels.flatMap((label) => (label
      ? [svg("text", { class: "label", x: label.x.toFixed(1), y: label.y.toFixed(1), "text-anchor": label.anchor }, label.text)]
      : []));
    this.#drawing.replaceChildren(svg("g", { class: "frames" }, ...frames), this.#lit, svg("g", {}, ...this.#marks),
      svg("g", { "aria-hidden": "true" }, ...titles, ...labels));
    this.#mark();
  }

  #line(index: number, attributes: Record<string, string | number>): SVGLineElement[] {
    const pair = this.#pair(index);
    const [a, b] = [this.#layout?.spots[pair?.source ?? -1], this.#layout?.spots[pair?.target ?? -1]];
    return a && b ? [svg("line", {
      class: `edge ${this.#states[index] ?? ""}`, x1: a.x.toFixed(1), y1: a.y.toFixed(1), x2: b.x.toFixed(1), y2: b.y.toFixed(1), ...attributes,
    })] : [];
  }

  /** Whether a scan is one of those that are looked at. */
  #chosen(scan: number): boolean {
    const at = this.#selection;
    if (at.kind === "scan") return at.scan === scan;
    const pair = at.kind === "pair" ? this.#pair(at.pair) : undefined;
    return pair !== undefined && (pair.source === scan || pair.target === scan);
  }

  #mark(): void {
    this.#frames.forEach((frame, m) => frame.classList.toggle("seen", m === this.#model));
    this.#marks.forEach((mark, scan) => {
      const chosen = this.#chosen(scan);
      mark.setAttribute("aria-pressed", String(chosen));
      mark.children[1]?.setAttribute("class", `fill-${this.#color(scan)}`);
      mark.classList.toggle("back", this.#model !== null && this.#nodes[scan]?.model !== this.#model && !chosen);
    });
    this.#light(null);
  }

  /** The scan or the pair that the pointer means. */
  #at(event: MouseEvent): Selection | null {
    const placed = this.#layout;
    // A click by a key is where its node is.
    const mark = event.target instanceof Element ? event.target.closest(".node") : null;
    const scan = this.#marks.findIndex((m) => m === mark);
    if (scan >= 0) return { kind: "scan", scan };
    if (!placed) return null;
    const box = this.#drawing.getBoundingClientRect();
    const [x, y] = [event.clientX - box.left, event.clientY - box.top];
    const [near, distance] = closest(placed.spots.map((spot) => Math.hypot(spot.x - x, spot.y - y)));
    if (near >= 0 && distance <= placed.radius + reach().node) return { kind: "scan", scan: near };
    // Of edges that are as near, the one that lies on top.
    const [edge, off] = closest(this.#edges.map((pair) => {
      const held = this.#pair(pair);
      const [a, b] = [placed.spots[held?.source ?? -1], placed.spots[held?.target ?? -1]];
      return a && b ? toLine(x, y, a.x, a.y, b.x, b.y) : Infinity;
    }));
    const pair = this.#edges[edge];
    return pair !== undefined && off <= reach().edge ? { kind: "pair", pair } : null;
  }

  #point(event: PointerEvent): void {
    const at = this.#at(event);
    this.#drawing.classList.toggle("pointing", at !== null);
    if (JSON.stringify(at) !== JSON.stringify(this.#pointedAt)) this.#light(at);
  }

  /** Shows what belongs to what is pointed at; null: what belongs to what is chosen. */
  #light(at: Selection | null): void {
    this.#pointedAt = at;
    const lit = at ?? this.#selection;
    const edges = lit.kind === "pair" ? [lit.pair] : lit.kind === "all" ? [] : this.#edges.filter((index) => {
      const pair = this.#pair(index);
      return pair?.source === lit.scan || pair?.target === lit.scan;
    });
    const chosen = this.#selection.kind === "pair" ? this.#selection.pair : null;
    // A pair that is not drawn for itself is while it is looked at.
    this.#lit.replaceChildren(...[...edges, ...(chosen === null ? [] : [chosen])].flatMap((index) =>
      this.#line(index, { "stroke-width": index === chosen ? 3.5 : 2 })));
    const near = new Set(edges.flatMap((index) => {
      const pair = this.#pair(index);
      return pair ? [pair.source, pair.target] : [];
    }));
    if (lit.kind === "scan") near.add(lit.scan);
    this.#pane.classList.toggle("lit", lit.kind !== "all");
    this.#marks.forEach((mark, scan) => mark.classList.toggle("near", near.has(scan) || this.#chosen(scan)));
    this.#pointed.replaceChildren(...this.#words(at));
  }

  #words(at: Selection | null): Words[] {
    const name = (scan: number) => el("bdi", {}, this.#page.scans[scan]?.name ?? "");
    if (at?.kind === "scan") {
      const place = this.#page.merge.places[at.scan];
      return [name(at.scan), place?.state === "placed" ? `: ${count(place.pairs)} pairs hold it` : `: left out, ${place ? leftOut(place) : ""}`];
    }
    const pair = at?.kind === "pair" ? this.#pair(at.pair) : undefined;
    if (pair) return [name(pair.source), " → ", name(pair.target), `: ${STATES[stateOf(pair)]}, probability ${pair.probability.toFixed(3)}`];
    return ["Point at a scan or a pair; click to see it alone."];
  }

  #key(event: KeyboardEvent): void {
    const now = this.#marks.findIndex((mark) => mark === document.activeElement);
    const from = this.#layout?.spots[now];
    if (!from || event.ctrlKey || event.metaKey || event.altKey) return;
    if (event.key === "Enter" || event.key === " ") {
      event.preventDefault();
      this.onSelect({ kind: "scan", scan: now });
      return;
    }
    const ways: Record<string, readonly [number, number]> = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] };
    const way = ways[event.key];
    if (!way) return;
    event.preventDefault();
    // The nearest that way; what lies aside counts twice.
    const [next, off] = closest((this.#layout?.spots ?? []).map((spot) => {
      const [x, y] = [spot.x - from.x, spot.y - from.y];
      const along = x * way[0] + y * way[1];
      return along > 0.5 ? along + 2 * Math.abs(x * way[1] + y * way[0]) : Infinity;
    }));
    if (off === Infinity) return;
    this.#marks[now]?.setAttribute("tabindex", "-1");
    this.#focus = next;
    this.#marks[next]?.setAttribute("tabindex", "0");
    this.#marks[next]?.focus();
  }
}

/** Index and value of the least; of equal ones the last. */
function closest(values: readonly number[]): [number, number] {
  let [at, least] = [-1, Infinity];
  values.forEach((value, i) => {
    if (value <= least) [at, least] = [i, value];
  });
  return [at, least];
}

/** Distance of a point from a line between two. */
function toLine(x: number, y: number, ax: number, ay: number, bx: number, by: number): number {
  const [dx, dy] = [bx - ax, by - ay];
  const length = dx * dx + dy * dy;
  const t = length > 0 ? Math.min(Math.max(((x - ax) * dx + (y - ay) * dy) / length, 0), 1) : 0;
  return Math.hypot(x - ax - t * dx, y - ay - t * dy);
}
