/** Light or dark: as the system has it, until the reader turns it. */

const root = document.documentElement;
const dark = matchMedia("(prefers-color-scheme: dark)");
const turned = new EventTarget();

export function isDark(): boolean {
  const told = root.dataset["theme"];
  return told ? told === "dark" : dark.matches;
}

export function turnTheme(): void {
  root.dataset["theme"] = isDark() ? "light" : "dark";
  turned.dispatchEvent(new Event("turn"));
}

/** Calls `act` after every change, until `signal` ends it. */
export function onTheme(act: () => void, signal: AbortSignal): void {
  dark.addEventListener("change", act, { signal });
  turned.addEventListener("turn", act, { signal });
}
