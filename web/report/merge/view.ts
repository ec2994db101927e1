/** What of a merge is seen in 3-D: a model, a scan, or a pair as one of the two says that it lies. */

import { IDENTITY, type Cloud, product, inverse, type Rows } from "@upcr/viewer";

import { type Bytes, readCloud } from "../contents.ts";
import type { MergePage, Pair, Selection } from "./contents.ts";

/** How a pair is laid: as its own registration says, or as the model has it; a scan: by itself, or with those it is kept with. */
export type Laying = "own" | "model" | "alone" | "held";

/** A cloud a scan; without points where it has none. */
export function clouds(page: MergePage, bytes: Bytes): Cloud[] {
  return page.scans.map(({ drawn }, scan) =>
    drawn ? readCloud(drawn, scan, bytes) : { positions: new Float32Array(), origin: [0, 0, 0], colors: null });
}

function lies(page: MergePage, scan: number): Rows {
  const place = page.merge.places[scan];
  return place?.state === "placed" ? place.T_model_scan : IDENTITY;
}

/** Whether the poses of all say how the pair lies. */
export function isInOneModel(page: MergePage, pair: Pair): boolean {
  const [a, b] = [page.merge.places[pair.source], page.merge.places[pair.target]];
  return a?.state === "placed" && b?.state === "placed" && a.model === b.model;
}

/** Moves the source, from where the page has it, to where the pair's own registration lays it on the target. */
export function ownPose(page: MergePage, pair: Pair): Rows {
  return product(lies(page, pair.target), product(pair.T_target_source, inverse(lies(page, pair.source))));
}

/** Scans that kept pairs join to one. */
export function heldWith(page: MergePage, scan: number): number[] {
  return page.merge.pairs.flatMap((pair) =>
    !pair.kept ? [] : pair.source === scan ? [pair.target] : pair.target === scan ? [pair.source] : []);
}

/** Which scans are seen, and how each is moved from where the page has it. */
export function seen(page: MergePage, selection: Selection, laying: Laying, model: number): Map<number, Rows> {
  const found = new Map<number, Rows>();
  const show = (scan: number, pose: Rows = IDENTITY) => {
    if (page.scans[scan]?.drawn) found.set(scan, pose);
  };
  if (selection.kind === "scan") {
    show(selection.scan);
    if (laying === "held") for (const other of heldWith(page, selection.scan)) show(other);
  } else if (selection.kind === "pair") {
    const pair = page.merge.pairs[selection.pair];
    if (pair) {
      show(pair.target);
      show(pair.source, laying === "own" ? ownPose(page, pair) : IDENTITY);
    }
  } else {
    page.merge.places.forEach((place, scan) => {
      if (place.state === "placed" && place.model === model) show(scan);
    });
  }
  return found;
}
