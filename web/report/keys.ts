/** What keys do, and the list that tells of it. */

import { el } from "./dom.ts";
import { turnTheme } from "./theme.ts";

export interface Key {
  /** As the list has it. */
  shown: string;
  about: string;
  /** What each does, by the name that the browser has for it. */
  acts: Readonly<Record<string, () => void>>;
}

/** Listens until `signal` ends it, and makes the list, which `?` opens. */
export function keyboard(keys: readonly Key[], signal: AbortSignal): HTMLDialogElement {
  const all: readonly Key[] = [
    ...keys,
    { shown: "t", about: "light, dark", acts: { t: turnTheme } },
    { shown: "?", about: "this list", acts: { "?": () => help.showModal() } },
  ];
  const help = el("dialog", { id: "help", "aria-label": "Keys" },
    el("h2", {}, "Keys"),
    el("table", {}, el("tbody", {}, ...all.map(({ shown, about }) =>
      el("tr", {}, el("th", { scope: "row" }, el("kbd", {}, shown)), el("td", {}, about))))),
    el("p", { class: "quiet" }, "Drag to turn, with the right button or two fingers to move; the wheel or a pinch zooms."),
    el("form", { method: "dialog" }, el("button", {}, "Close")));
  const acts: Record<string, () => void> = Object.assign({}, ...all.map((key) => key.acts));

  let pointedAt: HTMLElement | null = null;
  document.addEventListener("click", ({ detail, target: at }) => {
    // Keys click too, without a count.
    pointedAt = detail > 0 && at instanceof Element ? at.closest<HTMLElement>("button, summary") : null;
  }, { signal });
  document.addEventListener("keydown", (event) => {
    if (event.key === "Tab") pointedAt = null;
    if (event.defaultPrevented || event.ctrlKey || event.metaKey || event.altKey || help.open) return;
    const { target: at } = event;
    const element = at instanceof Element ? at : null;
    // What a focused control does with a key comes first.
    if (element?.matches("input, select, textarea")) return;
    if (event.key === " " && element?.matches("button, summary")) {
      if (element !== pointedAt) return;
      // A button that was clicked has the focus too, and whoever clicked it does not mean it any more.
      pointedAt.blur();
    }
    if (/^Arrow|^Home$/.test(event.key) && element?.closest("aside, pre, .scrolls")) return;
    const act = acts[event.key];
    if (!act) return;
    event.preventDefault();
    act();
  }, { signal });
  return help;
}
