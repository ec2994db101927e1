/** Text to be copied: as much of it as can be read, and all of it for the clipboard. */

import { button, el, legible } from "./dom.ts";

export class Copying {
  /** The button, and what came of it. */
  readonly row: readonly HTMLElement[];
  readonly text: HTMLElement;

  readonly #copied = el("span", { class: "quiet", role: "status" });
  #all = "";

  constructor(label: string) {
    this.text = el("pre", { tabindex: 0, "aria-label": label });
    this.row = [button("Copy", () => void this.#copy(), { id: "copy" }), this.#copied];
  }

  show(text: string): void {
    this.#all = text;
    this.text.textContent = legible(text);
    this.#copied.textContent = "";
  }

  async #copy(): Promise<void> {
    try {
      await navigator.clipboard.writeText(this.#all);
      this.#copied.textContent = "copied";
    } catch {
      // Some browsers give pages from files no clipboard: the text is selected, to be copied by hand.
      this.text.textContent = this.#all;
      getSelection()?.selectAllChildren(this.text);
      this.#copied.textContent = "selected: copy it with Ctrl+C";
    }
  }
}
