/** What a report is about: words as JSON, and points, colours and distances as bytes. */

import type { Cloud, Distances, Rows, Triple } from "@upcr/viewer";

/** The notations of a pose, from the name shown to the text copied. */
export interface Pose {
  T_target_source: Rows;
  /** Against the pose found, of an alternative. */
  relative_score: number | null;
  notations: readonly { name: string; about: string; text: string }[];
}

/** How a cloud is drawn. */
export interface Drawn {
  /** In the file, and in this page. */
  points: number;
  shown: number;
  /** Without finite coordinates. */
  left_out: number;
  /** Corner of the box and length of a step: what the numbers in the page are told in. */
  origin: Triple;
  step: number;
  colors: boolean;
}

export interface CloudInfo extends Drawn {
  name: string;
  /** What the file says of itself. */
  comments: readonly string[];
}

export interface Registration {
  fitness: number;
  inlier_rmse: number | null;
  num_inliers: number;
  converged: boolean;
  iterations: number;
  probability: number;
  method: string;
  voxel_size: number;
  points_used: readonly [number, number];
  settings: Record<string, unknown>;
  timings_ms: Record<string, number>;
}

export interface Page {
  version: string;
  clouds: readonly CloudInfo[];
  /** The one found or given, and after it the alternatives. None: there is nothing but before. */
  poses: readonly Pose[];
  /** `distances-0` of the clouds as they lie, `distances-1` and so on of the poses. */
  distances: { reach: number; range: number } | null;
  verdict: {
    registered: boolean;
    threshold: number;
    reasons: readonly { name: string; text: string }[];
    free: readonly string[];
    source_scale: number | null;
  } | null;
  registration: Registration | null;
}

/** What the name stands for; asked for once each. */
export type Bytes = (name: string) => Uint8Array<ArrayBuffer>;

/** The points of the cloud of that number: three numbers of three bytes each, the lowest first. */
export function readCloud(drawn: Drawn, number: number, bytes: Bytes): Cloud {
  const packed = bytes(`points-${number}`);
  const positions = new Float32Array(packed.length / 3);
  for (let i = 0, at = 0; i < positions.length; i += 1, at += 3) {
    positions[i] = ((packed[at] ?? 0) | ((packed[at + 1] ?? 0) << 8) | ((packed[at + 2] ?? 0) << 16)) * drawn.step;
  }
  return { positions, origin: drawn.origin, colors: drawn.colors ? bytes(`colors-${number}`) : null };
}

export class Contents {
  readonly page: Page;
  readonly #bytes: Bytes;
  readonly #distances = new Map<number, Distances>();

  constructor(page: Page, bytes: Bytes) {
    this.page = page;
    this.#bytes = bytes;
  }

  /** Asked for once each. */
  cloud(index: number): Cloud {
    const info = this.page.clouds[index];
    if (!info) throw new RangeError(`there is no cloud ${index}`);
    return readCloud(info, index, this.#bytes);
  }

  /** Distances at pose `index`, of which 0 is where the clouds lie. */
  distances(index: number): Distances | null {
    if (!this.page.distances) return null;
    let held = this.#distances.get(index);
    if (!held) {
      const packed = this.#bytes(`distances-${index}`);
      const values = Uint16Array.from({ length: packed.length / 2 }, (_, i) => (packed[2 * i] ?? 0) | ((packed[2 * i + 1] ?? 0) << 8));
      held = { values, reach: this.page.distances.reach };
      this.#distances.set(index, held);
    }
    return held;
  }
}
