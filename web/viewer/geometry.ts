/** Poses and places in double precision, and what of a cloud the camera has to see. */

import { Matrix4, Quaternion, Vector3 } from "three";

export type Triple = readonly [number, number, number];
/** 4×4, row after row. */
export type Rows = readonly (readonly number[])[];

export const IDENTITY: Rows = [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]];

/** One motion after the other, the right one first. */
export function product(a: Rows, b: Rows): Rows {
  const at = (m: Rows, r: number, c: number) => m[r]?.[c] ?? 0;
  return [0, 1, 2, 3].map((r) => [0, 1, 2, 3].map((c) =>
    at(a, r, 0) * at(b, 0, c) + at(a, r, 1) * at(b, 1, c) + at(a, r, 2) * at(b, 2, c) + at(a, r, 3) * at(b, 3, c)));
}

/** The motion back. */
export function inverse(m: Rows): Rows {
  const at = (r: number, c: number) => m[r]?.[c] ?? 0;
  const rows = [0, 1, 2].map((r) => {
    const turned = [at(0, r), at(1, r), at(2, r)] as const;
    return [...turned, -(turned[0] * at(0, 3) + turned[1] * at(1, 3) + turned[2] * at(2, 3))];
  });
  return [...rows, [0, 0, 0, 1]];
}

/** Of a cloud, as the sphere that holds nearly all of it: a few stray points do not push the rest into the distance. */
export interface Ball {
  center: Vector3;
  radius: number;
}

/** Points that stand for all. */
export const SAMPLE = 20_000;
const HELD = 0.99;

/** The ball of points in random order, of which the first are a sample of all. */
export function ball(positions: Float32Array): Ball {
  const count = Math.min(positions.length / 3, SAMPLE);
  const columns = [0, 1, 2].map((k) => Float32Array.from({ length: count }, (_, i) => positions[3 * i + k] ?? 0).sort());
  const middle = (sorted: Float32Array) => {
    const [low, high] = [1 - HELD, HELD].map((share) => sorted[Math.floor(share * (count - 1))] ?? 0);
    return ((low ?? 0) + (high ?? 0)) / 2;
  };
  const center = new Vector3(...(columns.map(middle) as [number, number, number]));
  const distances = Float32Array.from({ length: count }, (_, i) =>
    center.distanceTo(new Vector3().fromArray(positions, 3 * i))).sort();
  return { center, radius: distances[Math.floor(HELD * (count - 1))] ?? 0 };
}

/** The ball about all of `balls`. */
export function union(balls: readonly Ball[]): Ball {
  const center = new Vector3();
  for (const b of balls) center.addScaledVector(b.center, 1 / balls.length);
  const radius = Math.max(...balls.map((b) => b.center.distanceTo(center) + b.radius));
  return { center, radius: radius > 0 ? radius : 1 };
}

/** A rigid motion of points that are told from an origin of their own. */
export interface Placement {
  rotation: Quaternion;
  translation: Vector3;
}

/** Where `pose` puts points that are told from `origin`, seen from `from`. Both may be large; their sum is not. */
export function place(pose: Rows, origin: Triple, from: Triple): Placement {
  const at = (r: number, c: number) => pose[r]?.[c] ?? 0;
  const m = new Matrix4().set(
    at(0, 0), at(0, 1), at(0, 2), 0, at(1, 0), at(1, 1), at(1, 2), 0, at(2, 0), at(2, 1), at(2, 2), 0, 0, 0, 0, 1,
  );
  const t = [0, 1, 2].map((r) =>
    at(r, 0) * origin[0] + at(r, 1) * origin[1] + at(r, 2) * origin[2] + at(r, 3) - (from[r] ?? 0));
  return { rotation: new Quaternion().setFromRotationMatrix(m), translation: new Vector3(...t) };
}

export function moved(b: Ball, by: Placement): Ball {
  return { center: b.center.clone().applyQuaternion(by.rotation).add(by.translation), radius: b.radius };
}

/** A share `s` of the way from `a` to `b`, on which the cloud's middle goes straight. */
export function between(a: Placement, b: Placement, middle: Vector3, s: number): Placement {
  const rotation = a.rotation.clone().slerp(b.rotation, s);
  const center = moved({ center: middle, radius: 0 }, a).center.lerp(moved({ center: middle, radius: 0 }, b).center, s);
  return { rotation, translation: center.sub(middle.clone().applyQuaternion(rotation)) };
}

/** Degrees from one pose's rotation to another's. */
export function turnBetween(a: Rows, b: Rows): number {
  const origin: Triple = [0, 0, 0];
  return (place(a, origin, origin).rotation.angleTo(place(b, origin, origin).rotation) * 180) / Math.PI;
}
