/** What the page and its worker tell each other. */

/** As `Choices` of the crate `upcr-web`; what is not told is the library's default. */
export interface Choices {
  method?: string;
  refine?: string;
  voxel_size?: number;
}

export type Asked =
  | { kind: "load"; module: WebAssembly.Module }
  | { kind: "register"; source: File; target: File; choices: Choices }
  | { kind: "aligned"; pose: number; name: string }
  | { kind: "report" };

export type Told =
  | { kind: "loaded"; version: string; extensions: readonly string[] }
  | { kind: "progress"; stage: string; done: number }
  | { kind: "registered"; words: string; blobs: ReadonlyMap<string, Uint8Array<ArrayBuffer>>; ms: number }
  | { kind: "made"; content: Uint8Array<ArrayBuffer> | string }
  /** `broken`: the worker is good for nothing after that. */
  | { kind: "failed"; message: string; broken: boolean };
