/** The worker as the page sees it: one question at a time, each with its answer. */

import type { Asked, Choices, Told } from "./messages.ts";

type Answer<K extends Told["kind"]> = Extract<Told, { kind: K }>;

/** The reader has lost interest. */
export class Cancelled extends Error {}

export class Engine {
  onProgress: (stage: string, done: number) => void = () => {};

  readonly #module: WebAssembly.Module;
  readonly #script: string;
  #worker: Worker | null = null;
  #waiting: { resolve: (told: Told) => void; reject: (error: Error) => void } | null = null;

  /** @param script the worker's, as text. */
  constructor(module: WebAssembly.Module, script: string) {
    this.#module = module;
    this.#script = URL.createObjectURL(new Blob([script], { type: "text/javascript" }));
  }

  /** Starts the worker where none is. */
  start(): Promise<Answer<"loaded">> {
    const worker = new Worker(this.#script, { name: "upcr" });
    this.#worker = worker;
    worker.onmessage = ({ data }: MessageEvent<Told>) => {
      if (data.kind === "progress") this.onProgress(data.stage, data.done);
      else this.#settle(data);
    };
    worker.onerror = (event) => {
      event.preventDefault();
      this.#settle({ kind: "failed", message: event.message, broken: true });
    };
    return this.#ask({ kind: "load", module: this.#module }) as Promise<Answer<"loaded">>;
  }

  async register(source: File, target: File, choices: Choices): Promise<Answer<"registered">> {
    if (!this.#worker) await this.start();
    return this.#ask({ kind: "register", source, target, choices }) as Promise<Answer<"registered">>;
  }

  async make(asked: Extract<Asked, { kind: "aligned" | "report" }>): Promise<Answer<"made">["content"]> {
    return (await this.#ask(asked) as Answer<"made">).content;
  }

  /** Ends what is under way. */
  cancel(): void {
    this.#end();
    this.#waiting?.reject(new Cancelled());
    this.#waiting = null;
  }

  #ask(asked: Asked): Promise<Told> {
    const worker = this.#worker;
    if (!worker || this.#waiting) return Promise.reject(new Error("Something else is under way: wait until it is done."));
    return new Promise((resolve, reject) => {
      this.#waiting = { resolve, reject };
      worker.postMessage(asked);
    });
  }

  #settle(told: Told): void {
    const waiting = this.#waiting;
    this.#waiting = null;
    if (told.kind !== "failed") {
      waiting?.resolve(told);
      return;
    }
    if (told.broken) this.#end();
    waiting?.reject(new Error(told.broken ? `Out of memory, or a fault of this page: ${told.message}` : told.message));
  }

  #end(): void {
    this.#worker?.terminate();
    this.#worker = null;
  }
}
