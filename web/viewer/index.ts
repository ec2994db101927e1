export { UPS, Viewer } from "./viewer.ts";
export type { Cloud, Coloring, Distances, Palette, Side, Up } from "./viewer.ts";
export { turnBetween } from "./geometry.ts";
export type { Rows, Triple } from "./geometry.ts";
