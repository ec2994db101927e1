export { UPS, Viewer } from "./viewer.ts";
export type { Cloud, Coloring, Distances, Palette, Side, Up } from "./viewer.ts";
export { IDENTITY, inverse, product, turnBetween } from "./geometry.ts";
export type { Rows, Triple } from "./geometry.ts";
