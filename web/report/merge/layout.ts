/** Where scans stand in a drawing of their pairs: as seen from where their centres spread most, moved apart where they would meet. */

import type { Triple } from "@upcr/viewer";

export interface Node {
  /** The model's number; none: left out. */
  model: number | null;
  /** In the model. */
  center: Triple | null;
  label: string;
  /** The more, the sooner it has a label. */
  weight: number;
}

export interface Spot {
  x: number;
  y: number;
}

export interface Label extends Spot {
  anchor: "start" | "middle" | "end";
  text: string;
}

export interface Box extends Spot {
  width: number;
  height: number;
}

export interface Layout {
  spots: Spot[];
  /** Of a node. */
  radius: number;
  /** None where there is no room. */
  labels: (Label | null)[];
  /** Of each model. */
  models: Box[];
  /** Of what is left out; none where nothing is. */
  leftOut: Box | null;
}

const MARGIN = 26;
/** Widest space between nodes, and narrowest. */
const WIDEST = 34;
const STRETCH = 1.5;
const ROUNDS = 250;
/** How strongly a node is drawn to where it lies. */
const PULL = 0.03;
/** Height of a line of letters, and width of a letter. */
const LINE = 14;
const LETTER = 7;
/** So many that are left out have a line each, with their reason. */
export const LINES = 4;
const CELL = 20;

/** Axes along which points spread, from the most to the least: eigenvectors of their covariance, by Jacobi's rotations. */
export function axes(points: readonly Triple[]): [Triple, Triple, Triple] {
  const mean = [0, 1, 2].map((k) => points.reduce((sum, p) => sum + (p[k] ?? 0), 0) / Math.max(points.length, 1));
  const at = (m: readonly number[], r: number, c: number) => m[3 * r + c] ?? 0;
  const a = new Array<number>(9).fill(0);
  for (const p of points) {
    for (let r = 0; r < 3; r += 1) {
      for (let c = 0; c < 3; c += 1) a[3 * r + c] = at(a, r, c) + ((p[r] ?? 0) - (mean[r] ?? 0)) * ((p[c] ?? 0) - (mean[c] ?? 0));
    }
  }
  const v = [1, 0, 0, 0, 1, 0, 0, 0, 1];
  for (let sweep = 0; sweep < 24; sweep += 1) {
    for (const [p, q] of [[0, 1], [0, 2], [1, 2]] as const) {
      const off = at(a, p, q);
      if (off === 0) continue;
      const theta = (at(a, q, q) - at(a, p, p)) / (2 * off);
      const t = (theta < 0 ? -1 : 1) / (Math.abs(theta) + Math.hypot(theta, 1));
      const cos = 1 / Math.hypot(t, 1);
      const sin = t * cos;
      const turn = (m: number[], i: number, j: number) => {
        const [x, y] = [m[i] ?? 0, m[j] ?? 0];
        m[i] = cos * x - sin * y;
        m[j] = sin * x + cos * y;
      };
      for (let k = 0; k < 3; k += 1) turn(a, 3 * k + p, 3 * k + q);
      for (let k = 0; k < 3; k += 1) turn(a, 3 * p + k, 3 * q + k);
      for (let k = 0; k < 3; k += 1) turn(v, 3 * k + p, 3 * k + q);
    }
  }
  const order = [0, 1, 2].sort((i, j) => at(a, j, j) - at(a, i, i));
  // Of the two signs, the one whose largest part is positive.
  const column = (i: number): Triple => {
    const c: [number, number, number] = [at(v, 0, i), at(v, 1, i), at(v, 2, i)];
    const largest = c.reduce((m, x) => (Math.abs(x) > Math.abs(m) + 1e-9 ? x : m), 0);
    return largest < 0 ? [-c[0], -c[1], -c[2]] : c;
  };
  const [first, last] = [column(order[0] ?? 0), column(order[2] ?? 2)];
  const [ax, ay, az] = last;
  const [bx, by, bz] = first;
  return [first, [ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx], last];
}

/** Points as seen along their least axis, the most one to the right; y is downwards. */
export function flat(points: readonly Triple[]): Spot[] {
  const [right, up] = axes(points);
  const along = (axis: Triple, p: Triple) => axis[0] * p[0] + axis[1] * p[1] + axis[2] * p[2];
  return points.map((p) => ({ x: along(right, p), y: -along(up, p) }));
}

/** Moves spots apart until they are `apart` from each other, none farther from where it was than that takes. */
export function relax(spots: readonly Spot[], apart: number, within: Box): Spot[] {
  const now = spots.map((s) => ({ ...s }));
  const key = (x: number, y: number) => Math.floor(x / apart) * 65_536 + Math.floor(y / apart);
  for (let round = 0; round < ROUNDS; round += 1) {
    const cells = new Map<number, number[]>();
    now.forEach((s, i) => {
      const cell = key(s.x, s.y);
      const held = cells.get(cell);
      if (held) held.push(i);
      else cells.set(cell, [i]);
    });
    let met = false;
    now.forEach((s, i) => {
      for (let dx = -1; dx <= 1; dx += 1) {
        for (let dy = -1; dy <= 1; dy += 1) {
          for (const j of cells.get(key(s.x + dx * apart, s.y + dy * apart)) ?? []) {
            const other = now[j];
            if (j <= i || !other) continue;
            let [x, y] = [other.x - s.x, other.y - s.y];
            let distance = Math.hypot(x, y);
            if (distance >= apart) continue;
            met = true;
            if (distance < 1e-6 * apart) {
              // In one place: each in a direction of its own.
              [x, y, distance] = [Math.cos(2.4 * j), Math.sin(2.4 * j), 1];
              const by = 0.25 * apart;
              s.x -= x * by; s.y -= y * by; other.x += x * by; other.y += y * by;
              continue;
            }
            const by = (0.5 * (apart - distance)) / distance;
            s.x -= x * by; s.y -= y * by; other.x += x * by; other.y += y * by;
          }
        }
      }
    });
    // The last rounds only move apart.
    const pull = round < 0.7 * ROUNDS ? PULL : 0;
    now.forEach((s, i) => {
      const home = spots[i] ?? s;
      s.x = Math.min(Math.max(s.x + pull * (home.x - s.x), within.x), within.x + within.width);
      s.y = Math.min(Math.max(s.y + pull * (home.y - s.y), within.y), within.y + within.height);
    });
    if (!met && round > 0) break;
  }
  return now;
}

/** Fills a box with boxes of these shares, the first the largest, each as square as can be: a squarified treemap
 *  (Bruls, Huizing and van Wijk 2000). */
export function pack(shares: readonly number[], within: Box): Box[] {
  const found: Box[] = [];
  let { x, y, width, height } = within;
  let left = shares.reduce((sum, share) => sum + share, 0);
  let from = 0;
  while (from < shares.length) {
    const [across, area] = [Math.min(width, height), (width * height) / left];
    // A row along the shorter edge grows while its worst box gets no longer by that.
    const worst = (to: number) => {
      const row = shares.slice(from, to).map((share) => share * area);
      const thick = row.reduce((sum, a) => sum + a, 0) / across;
      return Math.max(...row.map((a) => Math.max(a / thick / thick, (thick * thick) / a)));
    };
    let to = from + 1;
    while (to < shares.length && worst(to + 1) <= worst(to)) to += 1;
    const row = shares.slice(from, to);
    const all = row.reduce((sum, share) => sum + share, 0);
    const thick = (all * area) / across;
    let along = 0;
    for (const share of row) {
      const length = across * (share / all);
      found.push(width >= height
        ? { x, y: y + along, width: thick, height: length }
        : { x: x + along, y, width: length, height: thick });
      along += length;
    }
    if (width >= height) [x, width] = [x + thick, width - thick];
    else [y, height] = [y + thick, height - thick];
    left -= all;
    from = to;
  }
  return found;
}

export function layout(nodes: readonly Node[], width: number, height: number): Layout {
  const out = nodes.flatMap((node, i) => (node.model === null ? [i] : []));
  const models: number[][] = [];
  nodes.forEach((node, i) => {
    if (node.model === null) return;
    while (models.length <= node.model) models.push([]);
    models[node.model]?.push(i);
  });
  const spots: Spot[] = nodes.map(() => ({ x: 0, y: 0 }));

  // Those left out stand below: a line each, or many in a row.
  const lines = out.length <= LINES;
  let cell = CELL;
  const rows = () => Math.ceil(out.length / Math.max(1, Math.floor((width - 2 * 12) / cell)));
  while (!lines && rows() * cell > 0.3 * height && cell > 6) cell -= 1;
  const low = out.length === 0 ? 0 : lines ? out.length * 18 + 10 : rows() * cell + 10;
  const columns = Math.max(1, Math.floor((width - 2 * 12) / cell));
  out.forEach((scan, i) => {
    spots[scan] = lines
      ? { x: 16, y: height - low + 14 + 18 * i }
      : { x: 12 + cell * (0.5 + (i % columns)), y: height - low + 5 + cell * (0.5 + Math.floor(i / columns)) };
  });

  // Small ones have more than their share: a name takes as much room in them.
  const boxes = pack(models.map((held) => (held.length + 2) ** 0.8), { x: 0, y: 0, width, height: Math.max(height - low, 1) });
  let apart = WIDEST;
  models.forEach((held, m) => {
    const box = boxes[m];
    if (!box) return;
    const margin = Math.min(MARGIN, 0.2 * Math.min(box.width, box.height));
    const inner = { x: box.x + margin, y: box.y + margin, width: box.width - 2 * margin, height: box.height - 2 * margin };
    let seen = flat(held.map((i) => nodes[i]?.center ?? [0, 0, 0]));
    if (inner.height > inner.width) seen = seen.map(({ x, y }) => ({ x: -y, y: x }));
    const range = (values: readonly number[]) => [Math.min(...values), Math.max(...values)] as const;
    const [left, right] = range(seen.map((s) => s.x));
    const [top, bottom] = range(seen.map((s) => s.y));
    const scale = Math.min(inner.width / Math.max(right - left, 1e-300), inner.height / Math.max(bottom - top, 1e-300));
    const near = Math.min(WIDEST, 0.75 * Math.sqrt((inner.width * inner.height) / held.length));
    apart = Math.min(apart, near);
    // Room that is over makes a long model a little less flat.
    const stretch = (extent: number, room: number) => (extent > 0 ? scale * Math.min(STRETCH, room / (extent * scale)) : 0);
    const [sx, sy] = [stretch(right - left, inner.width), stretch(bottom - top, inner.height)];
    const fitted = seen.map((s) => ({
      x: inner.x + inner.width / 2 + (s.x - (left + right) / 2) * sx,
      y: inner.y + inner.height / 2 + (s.y - (top + bottom) / 2) * sy,
    }));
    relax(fitted, near, inner).forEach((spot, n) => {
      const i = held[n];
      if (i !== undefined) spots[i] = spot;
    });
  });
  const radius = Math.min(Math.max(0.3 * apart, 2.5), 7);
  const leftOut = out.length === 0 ? null : { x: 0, y: height - low, width, height: low };
  return { spots, radius, labels: labels(nodes, spots, radius, width, height, lines), models: boxes, leftOut };
}

/** Names beside their nodes, where they meet neither nodes nor other names. */
function labels(
  nodes: readonly Node[], spots: readonly Spot[], radius: number, width: number, height: number, lines: boolean,
): (Label | null)[] {
  const taken: Box[] = spots.map(({ x, y }) => ({ x: x - radius, y: y - radius, width: 2 * radius, height: 2 * radius }));
  const meets = (a: Box) => taken.some((b) =>
    a.x < b.x + b.width && b.x < a.x + a.width && a.y < b.y + b.height && b.y < a.y + a.height);
  const found: (Label | null)[] = nodes.map(() => null);
  const order = nodes.map((_, i) => i).sort((i, j) => (nodes[j]?.weight ?? 0) - (nodes[i]?.weight ?? 0) || i - j);
  for (const i of order) {
    const [node, spot] = [nodes[i], spots[i]];
    if (!node || !spot) continue;
    const gap = radius + 3;
    const { x, y } = spot;
    // Reasons may be long; their beginning says most.
    const room = Math.floor((width - x - gap - 4) / LETTER);
    const text = lines && node.model === null && node.label.length > room ? `${node.label.slice(0, Math.max(room - 1, 0))}…` : node.label;
    const wide = text.length * LETTER;
    const choices: readonly [Label["anchor"], number, number, number][] = [
      ["start", x + gap, y, x + gap], ["end", x - gap, y, x - gap - wide],
      ["middle", x, y - gap - 0.4 * LINE, x - wide / 2], ["middle", x, y + gap + 0.4 * LINE, x - wide / 2],
    ];
    for (const [anchor, at, line, left] of choices) {
      const box = { x: left - 2, y: line - LINE / 2, width: wide + 4, height: LINE };
      if (box.x < 0 || box.y < 0 || box.x + box.width > width || box.y + box.height > height || meets(box)) continue;
      taken.push(box);
      found[i] = { x: at, y: line, anchor, text };
      break;
    }
  }
  return found;
}
