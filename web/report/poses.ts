/** The poses of a page: which one is shown, its numbers to copy, and the others to choose. */

import { turnBetween } from "@upcr/viewer";

import type { Page, Pose } from "./contents.ts";
import { Copying } from "./copy.ts";
import { button, el, section } from "./dom.ts";

export class Poses {
  /** The pose's numbers; none where the page has no pose. */
  readonly section: HTMLElement | null;
  /** The poses to choose; none where there is but one. */
  readonly alternatives: HTMLElement | null;
  /** Told when another pose is chosen. */
  onChosen: (pose: Pose, name: string) => void = () => {};

  readonly #page: Page;
  readonly #title = el("p", { class: "quiet" });
  readonly #copying = new Copying("The pose");
  readonly #about = el("p", { class: "quiet" });
  readonly #notation = el("select", { id: "notation", "aria-label": "Notation" });
  readonly #buttons: HTMLButtonElement[] = [];
  #chosen = 0;

  constructor(page: Page) {
    this.#page = page;
    const [first] = page.poses;
    this.#notation.append(...(first?.notations ?? []).map(({ name }) => el("option", {}, name)));
    this.#notation.addEventListener("change", () => this.#show());
    this.section = first ? section("Pose", this.#title,
      el("div", { class: "row" }, this.#notation, ...this.#copying.row),
      this.#copying.text, this.#about) : null;
    this.alternatives = first && page.poses.length > 1 ? this.#list(first) : null;
  }

  get chosen(): number {
    return this.#chosen;
  }

  /** Shows the pose of that number, where there is one. */
  choose(index: number): void {
    const pose = this.#page.poses[index];
    if (!pose) return;
    this.#chosen = index;
    this.#buttons.forEach((b, i) => b.setAttribute("aria-pressed", String(i === index)));
    this.#title.textContent = `${this.#name(index)}: takes source coordinates to target coordinates, y = R x + t.`;
    this.#show();
    this.onChosen(pose, this.#name(index));
  }

  #name(index: number): string {
    if (!this.#page.registration) return "The pose given";
    return index === 0 ? "The pose found" : `Alternative ${index}`;
  }

  get #told(): Pose["notations"][number] | undefined {
    return this.#page.poses[this.#chosen]?.notations[this.#notation.selectedIndex];
  }

  #show(): void {
    this.#copying.show(this.#told?.text ?? "");
    this.#about.textContent = `${this.#told?.about ?? ""} Copy gives all digits.`;
  }

  #list(found: Pose): HTMLElement {
    const about = (pose: Pose) => pose === found
      ? "what the verdict is about"
      : `turned by ${turnBetween(found.T_target_source, pose.T_target_source).toFixed(1)}° against it, with ${(pose.relative_score ?? 0).toFixed(3)} of its score`;
    this.#buttons.push(...this.#page.poses.map((pose, i) => {
      const made = button("", () => this.choose(i));
      made.append(el("kbd", { "aria-hidden": "true" }, String(i)), el("span", {}, el("b", {}, this.#name(i)), el("br"), about(pose)));
      return made;
    }));
    return section("Alternatives", el("p", { class: "quiet" }, "Other poses explain the clouds nearly as well. Choose one to see it."),
      el("div", { class: "list", role: "group", "aria-label": "Poses" }, ...this.#buttons));
  }
}
