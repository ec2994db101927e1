/** Elements. Words become text nodes, never markup. */

type Child = Node | string | null;
type Attributes = Record<string, string | number | boolean>;

export function el<K extends keyof HTMLElementTagNameMap>(
  tag: K, attributes: Attributes = {}, ...children: readonly Child[]
): HTMLElementTagNameMap[K] {
  return furnish(document.createElement(tag), attributes, children);
}

/** As `el`, of a drawing. */
export function svg<K extends keyof SVGElementTagNameMap>(
  tag: K, attributes: Attributes = {}, ...children: readonly Child[]
): SVGElementTagNameMap[K] {
  return furnish(document.createElementNS("http://www.w3.org/2000/svg", tag), attributes, children);
}

function furnish<E extends Element>(element: E, attributes: Attributes, children: readonly Child[]): E {
  for (const [name, value] of Object.entries(attributes)) {
    if (value === true) element.setAttribute(name, "");
    else if (value !== false) element.setAttribute(name, String(value));
  }
  element.append(...children.filter((child) => child !== null));
  return element;
}

export function button(label: string, act: () => void, attributes: Attributes = {}): HTMLButtonElement {
  const made = el("button", { type: "button", ...attributes }, label);
  made.addEventListener("click", act);
  return made;
}

/** Buttons of which one is pressed. */
export function choice<T extends string>(
  label: string, options: readonly (readonly [T, string])[], first: T, chosen: (value: T) => void,
): { element: HTMLElement; choose: (value: T) => void; value: () => T } {
  let now = first;
  const buttons = options.map(([value, name]) => [value, button(name, () => choose(value))] as const);
  const show = () => buttons.forEach(([value, b]) => b.setAttribute("aria-pressed", String(value === now)));
  const choose = (value: T) => {
    now = value;
    show();
    chosen(value);
  };
  show();
  return {
    element: el("div", { class: "choice", role: "group", "aria-label": label }, ...buttons.map(([, b]) => b)),
    choose,
    value: () => now,
  };
}

/** Numbers with as many digits as say something; JSON has null for what is none. */
export function number(value: number | null): string {
  if (value === null) return "–";
  if (value === 0) return "0";
  return Math.abs(value) < 1e-4 ? value.toExponential(3) : value.toLocaleString("en", { maximumSignificantDigits: 4 });
}

/** Text with its lines of numbers short enough to be read, column below column. */
export function legible(text: string): string {
  const lines = text.split("\n").map((line) => line.split(" "));
  const isNumeric = (words: readonly string[]) => words.every((word) => word !== "" && Number.isFinite(Number(word)));
  const short = lines.map((words) => isNumeric(words)
    ? words.map((word) => Number(word).toFixed(Math.abs(Number(word)) < 1000 ? 6 : 3))
    : words);
  const width = Math.max(...short.filter((_, i) => isNumeric(lines[i] ?? [])).flat().map((word) => word.length));
  return short.map((words, i) => (isNumeric(lines[i] ?? []) ? words.map((word) => word.padStart(width)) : words).join(" ")).join("\n");
}

export function count(value: number): string {
  return value.toLocaleString("en");
}

export function section(title: string, ...children: readonly Child[]): HTMLElement {
  return el("section", {}, el("h2", {}, title), ...children);
}

export function table(rows: readonly (readonly [string, string])[]): HTMLElement {
  return el("table", {}, el("tbody", {}, ...rows.map(([name, value]) =>
    el("tr", {}, el("th", { scope: "row" }, name), el("td", {}, value)))));
}

/** Has the document styled so: the page's policy allows no style that is written into it. */
export function adopt(style: string): void {
  const sheet = new CSSStyleSheet();
  sheet.replaceSync(style);
  document.adoptedStyleSheets.push(sheet);
}
