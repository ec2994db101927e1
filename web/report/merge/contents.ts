/** What a merge's page is about, and words for it. */

import type { Rows, Triple } from "@upcr/viewer";

import type { Drawn } from "../contents.ts";

export type Place =
  | { state: "placed"; model: number; T_model_scan: Rows; pairs: number; probability: number }
  | { state: "alone" }
  | { state: "unusable"; reason: string };

export interface Pair {
  source: number;
  target: number;
  proposal: "sequence" | "likeness" | "overlap";
  T_target_source: Rows;
  probability: number;
  /** Of the twist, rotation first; JSON has null for what is no number. */
  covariance: readonly (readonly (number | null)[])[];
  fitness: number;
  reasons: readonly string[];
  kept: boolean;
  /** It was trusted as a pair, and what it would lay on each other speaks against it. */
  contradicted: boolean;
  /** None: it was not trusted as a pair, or is contradicted. */
  chi_sq: number | null;
}

export interface Scan {
  name: string;
  /** Where its middle lies in its model. */
  center: Triple | null;
  /** Its points, where they lie in its model, or without one in its own frame. */
  drawn: Drawn | null;
}

export interface MergePage {
  version: string;
  scans: readonly Scan[];
  merge: { places: readonly Place[]; pairs: readonly Pair[]; voxel_size: number; inflation: number };
  /** Probability from which on a pair is trusted. */
  threshold: number;
  /** What the reasons against pairs say. */
  reasons: Readonly<Record<string, string>>;
}

/** What is looked at. */
export type Selection = { kind: "all" } | { kind: "scan"; scan: number } | { kind: "pair"; pair: number };

export type PairState = "dropped" | "kept" | "untrusted";
/** In words, from what asks for a look to what does not. */
export const STATES: Readonly<Record<PairState, string>> = { dropped: "dropped", kept: "kept", untrusted: "not trusted" };

export const PROPOSALS: Readonly<Record<Pair["proposal"], string>> = {
  sequence: "sequence", likeness: "likeness", overlap: "overlap",
};

export function stateOf(pair: Pair): PairState {
  if (pair.kept) return "kept";
  return pair.contradicted || pair.chi_sq !== null ? "dropped" : "untrusted";
}

/** Root of the trace of a diagonal block of the covariance: rad of the first, a length of the second. */
export function deviation(pair: Pair, block: 0 | 1): number {
  let trace = 0;
  for (let k = 3 * block; k < 3 * block + 3; k += 1) trace += pair.covariance[k]?.[k] ?? NaN;
  return Math.sqrt(trace);
}

export const DEGREES = 180 / Math.PI;

/** Why a scan has no place; null where it has one. */
export function leftOut(place: Place): string | null {
  if (place.state === "placed") return null;
  return place.state === "alone" ? "no pair with it is to be trusted" : place.reason;
}

/** How many scans each model has. */
export function sizes(places: readonly Place[]): number[] {
  const found: number[] = [];
  for (const place of places) {
    if (place.state !== "placed") continue;
    while (found.length <= place.model) found.push(0);
    found[place.model] = (found[place.model] ?? 0) + 1;
  }
  return found;
}

/** A colour of each scan, so that those of a kept pair differ wherever the colours suffice. */
export function colorsOf(count: number, pairs: readonly Pair[], colors: number): number[] {
  const beside: number[][] = Array.from({ length: count }, () => []);
  for (const { source, target } of pairs.filter((pair) => pair.kept)) {
    beside[source]?.push(target);
    beside[target]?.push(source);
  }
  const chosen: number[] = [];
  const used = new Array<number>(colors).fill(0);
  for (let scan = 0; scan < count; scan += 1) {
    const near = new Array<number>(colors).fill(0);
    for (const other of beside[scan] ?? []) {
      const color = chosen[other];
      if (color !== undefined) near[color] = (near[color] ?? 0) + 1;
    }
    let best = 0;
    for (let color = 1; color < colors; color += 1) {
      const [a, b] = [near[color] ?? 0, near[best] ?? 0];
      if (a < b || (a === b && (used[color] ?? 0) < (used[best] ?? 0))) best = color;
    }
    used[best] = (used[best] ?? 0) + 1;
    chosen.push(best);
  }
  return chosen;
}

/** Names short enough to stand in a drawing: without ends and beginnings that say nothing, where they still differ. */
export function shortNames(names: readonly string[]): string[] {
  const differ = (short: readonly string[]) => new Set(short).size === new Set(names).size;
  const bare = [/\.[^/\\]*$/, /\.[^./\\]*$/]
    .map((end) => names.map((name) => name.replace(end, "") || name))
    .find(differ) ?? [...names];
  // What nearly all begin with, but for digits: these count.
  const sorted = [...bare].sort();
  const [low, high] = [0.1, 0.9].map((share) => sorted[Math.floor(share * (sorted.length - 1))] ?? "");
  let common = 0;
  while (common < (low ?? "").length && (low ?? "")[common] === (high ?? "")[common]) common += 1;
  const prefix = (low ?? "").slice(0, common).replace(/\d+$/, "");
  const cut = bare.map((name) => (name.startsWith(prefix) && name.length > prefix.length ? name.slice(prefix.length) : name));
  const most = 14;
  return (names.length > 3 && differ(cut) ? cut : bare).map((name) =>
    name.length > most ? `${name.slice(0, 5)}…${name.slice(name.length - most + 6)}` : name);
}
