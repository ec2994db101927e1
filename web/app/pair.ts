/** Two files to be chosen, dropped, swapped. */

import { button, count, el } from "@upcr/report/dom.ts";

const EMPTY = "choose or drop a file";
const ROLES = [["Source", "is moved"], ["Target", "stays"]] as const;

function size(bytes: number): string {
  return bytes < 1e6 ? `${count(Math.ceil(bytes / 1e3))} kB` : `${(bytes / 1e6).toFixed(1)} MB`;
}

export class Pair {
  readonly element: HTMLElement;
  /** Source becomes target. */
  readonly swap = button("Swap", () => this.#turn(), { disabled: true });
  /** Told when both are there, or one has changed since. */
  onBoth: () => void = () => {};

  readonly #files: [File | null, File | null] = [null, null];
  readonly #inputs: HTMLInputElement[] = [];
  readonly #names: HTMLElement[] = [];
  #held = false;

  constructor() {
    const slots = ROLES.map(([role, what], i) => {
      const input = el("input", { type: "file", class: "unseen", id: `file-${i}` });
      input.addEventListener("change", () => {
        const [file] = input.files ?? [];
        // The same file may be chosen again.
        input.value = "";
        if (file) this.#put(i, file);
      });
      const name = el("span", { class: "name quiet" }, EMPTY);
      this.#inputs.push(input);
      this.#names.push(name);
      return el("label", { class: "slot", for: `file-${i}` }, input,
        el("span", { class: `swatch cloud-${i}`, "aria-hidden": "true" }),
        el("span", {}, el("b", {}, role), el("span", { class: "quiet" }, ` ${what}`)), name);
    });
    slots.forEach((slot, i) => {
      slot.addEventListener("drop", (event) => {
        const files = [...(event.dataTransfer?.files ?? [])];
        // Two at once are a pair, wherever they fall.
        if (files.length !== 1 || !files[0]) return;
        event.preventDefault();
        event.stopPropagation();
        if (!this.#held) this.#put(i, files[0]);
      });
    });
    this.element = el("div", { class: "pair" }, ...slots);
  }

  get both(): readonly [File, File] | null {
    const [source, target] = this.#files;
    return source && target ? [source, target] : null;
  }

  /** Puts files where there is room, two as source and target; one beside two begins a new pair. */
  take(files: readonly File[]): void {
    const [first, second] = files;
    if (!first || this.#held) return;
    if (second) {
      this.#show(0, first);
      this.#put(1, second);
    } else {
      if (this.both) this.#clear();
      this.#put(this.#files[0] ? 1 : 0, first);
    }
  }

  /** Whether the files stay as they are for now. */
  hold(held: boolean): void {
    this.#held = held;
    for (const input of this.#inputs) input.disabled = held;
    this.#offer();
  }

  accept(extensions: readonly string[]): void {
    for (const input of this.#inputs) input.accept = extensions.map((e) => `.${e}`).join(",");
  }

  #put(index: number, file: File): void {
    this.#show(index, file);
    if (this.both) this.onBoth();
  }

  #show(index: number, file: File): void {
    this.#files[index] = file;
    this.#names[index]?.replaceChildren(el("bdi", {}, file.name), ` ${size(file.size)}`);
    this.#offer();
  }

  #offer(): void {
    this.swap.disabled = this.#held || !this.both;
  }

  #clear(): void {
    this.#files.fill(null);
    for (const name of this.#names) name.textContent = EMPTY;
    this.#offer();
  }

  #turn(): void {
    const { both } = this;
    if (both) [both[1], both[0]].forEach((file, i) => this.#show(i, file));
  }
}
