/** The picture: clouds in 3-D, and what turns, sizes and colours them. */

import { type Cloud, type Palette, type Up, UPS, Viewer } from "@upcr/viewer";

import { button, choice, el } from "./dom.ts";
import type { Key } from "./keys.ts";
import { isDark, onTheme, turnTheme } from "./theme.ts";

const root = document.documentElement;
const still = matchMedia("(prefers-reduced-motion: reduce)");
const TURN = Math.PI / 24;

/** Colours that clouds have by turns. */
export const COLORS = 6;

function css(name: string): string {
  return getComputedStyle(root).getPropertyValue(name).trim();
}

export class Stage {
  readonly element = el("div", { id: "stage" });
  /** None where the browser has no WebGL. */
  readonly viewer: Viewer | null = null;
  /** Told the colour map as CSS has it, whenever it changes. */
  onGradient: (gradient: string) => void = () => {};
  /** Which colour each cloud has. */
  color: (cloud: number) => number = (cloud) => cloud % COLORS;

  readonly #trouble = el("p", { id: "trouble", role: "alert", hidden: true });
  readonly #size = el("input", { type: "range", min: 1, max: 8, step: 0.5, value: 2, id: "size" });
  readonly #count: number;

  /** @param label what is to be seen.
   *  @param near whether a first cloud that lies far from the second is brought to it. */
  constructor(clouds: readonly Cloud[], label: string, near: boolean, signal: AbortSignal) {
    this.#count = clouds.length;
    this.element.append(this.#trouble);
    try {
      this.viewer = new Viewer(this.element, clouds, () => still.matches, near);
      this.viewer.onTrouble = (message) => this.#tell(message);
      this.viewer.canvas.tabIndex = 0;
      this.viewer.canvas.setAttribute("role", "img");
      this.viewer.canvas.setAttribute("aria-label", `${label} in 3-D. Arrow keys turn, plus and minus zoom.`);
    } catch {
      this.#tell("This browser has no WebGL, or it is turned off: the clouds cannot be drawn. All else is here.");
    }
    this.#size.addEventListener("input", () => this.viewer?.setSize(Number(this.#size.value)));
    onTheme(() => this.paint(), signal);
  }

  /** For the end of a toolbar. */
  buttons(help: () => void): HTMLElement[] {
    return [
      button("Reset", () => this.viewer?.reset(), { title: "The whole of it, from where it was seen first (Home)" }),
      button("Theme", turnTheme, { title: "Light or dark (t)" }),
      button("?", help, { title: "Keys", "aria-label": "Keys" }),
    ];
  }

  /** How large points are, and what is up. */
  fields(): HTMLElement[] {
    const up = choice<Up>("Up", UPS.map((axis) => [axis, axis.replace("-", "−")] as const), "z", (value) => this.viewer?.setUp(value));
    return [
      el("div", { class: "field" }, el("label", { for: "size" }, "Point size"), this.#size),
      el("div", { class: "field" }, el("span", {}, "Up"), up.element),
    ];
  }

  keys(): Key[] {
    const orbit = (sideways: number, upwards: number) => () => this.viewer?.orbit(sideways * TURN, upwards * TURN);
    const zoom = (factor: number) => () => this.viewer?.zoom(factor);
    const size = (by: number) => () => {
      this.#size.valueAsNumber += by;
      this.#size.dispatchEvent(new Event("input"));
    };
    return [
      { shown: "← → ↑ ↓", about: "turn", acts: { ArrowLeft: orbit(-1, 0), ArrowRight: orbit(1, 0), ArrowUp: orbit(0, -1), ArrowDown: orbit(0, 1) } },
      { shown: "+ −", about: "zoom", acts: { "+": zoom(1.2), "=": zoom(1.2), "-": zoom(1 / 1.2) } },
      { shown: "Home", about: "the whole of it", acts: { Home: () => this.viewer?.reset() } },
      { shown: "[ ]", about: "smaller, larger points", acts: { "[": size(-0.5), "]": size(0.5) } },
    ];
  }

  /** Colours everything as the theme has it. */
  paint(): void {
    const palette: Palette = {
      background: css("--canvas"),
      clouds: Array.from({ length: this.#count }, (_, i) => css(`--cloud-${this.color(i)}`)),
      quiet: css("--quiet"),
      map: isDark() ? [0.32, 1] : [0, 0.88],
    };
    const gradient = this.viewer?.setPalette(palette);
    if (gradient) this.onGradient(gradient);
  }

  #tell(message: string | null): void {
    this.#trouble.textContent = message ?? "";
    this.#trouble.hidden = message === null;
  }
}
