/** The report: a picture that can be turned, and all that is known about it beside. */

import { type Coloring, type Palette, type Side, type Up, UPS, Viewer } from "@upcr/viewer";

import { cloudSection } from "./clouds.ts";
import type { Contents } from "./contents.ts";
import { button, choice, el, number, section } from "./dom.ts";
import { Poses } from "./poses.ts";
import { isDark, onTheme, turnTheme } from "./theme.ts";
import { details, figures, verdict } from "./words.ts";

const root = document.documentElement;
const still = matchMedia("(prefers-reduced-motion: reduce)");

const KEYS: readonly (readonly [string, string])[] = [
  ["Space", "before, after"], ["s", "overlaid, side by side"], ["r", "distances as colours, and back"],
  ["0", "the pose found"], ["1 … 9", "an alternative"], ["← → ↑ ↓", "turn"], ["+ −", "zoom"], ["Home", "the whole of it"],
  ["[ ]", "smaller, larger points"], ["t", "light, dark"], ["?", "this list"],
];

/** What whoever shows a report adds to it. */
export interface Additions {
  /** At the end of the toolbar. */
  toolbar?: Node;
  /** Below the poses: what can be done with the one that is shown, which `chosen` tells. */
  beside?: (chosen: () => number) => Node;
}

export interface Report {
  /** Takes the report away, and frees what it held. */
  dispose(): void;
}

function css(name: string): string {
  return getComputedStyle(root).getPropertyValue(name).trim();
}

/** Puts the report into `host`. */
export function showReport(host: HTMLElement, contents: Contents, additions: Additions = {}): Report {
  const { page } = contents;
  const gone = new AbortController();

  function palette(): Palette {
    return {
      background: css("--canvas"),
      clouds: page.clouds.map((_, i) => css(`--cloud-${i % 6}`)),
      quiet: css("--quiet"),
      map: isDark() ? [0.32, 1] : [0, 0.88],
    };
  }

  // The picture.

  const stage = el("div", { id: "stage" });
  const trouble = el("p", { id: "trouble", role: "alert", hidden: true });
  const tags = el("div", { class: "tags", "aria-hidden": "true", hidden: true }, el("span", {}, "Before"), el("span", {}, "After"));
  const legend = el("figure", { id: "legend", hidden: true });
  stage.append(trouble, tags);

  const clouds = page.clouds.map((_, i) => contents.cloud(i));
  let viewer: Viewer | null = null;
  try {
    viewer = new Viewer(stage, clouds, () => still.matches);
    viewer.onTrouble = tell;
    viewer.canvas.tabIndex = 0;
    viewer.canvas.setAttribute("role", "img");
    viewer.canvas.setAttribute("aria-label", `${page.clouds.map((c) => c.name).join(", ")} in 3-D. Arrow keys turn, plus and minus zoom.`);
  } catch {
    tell("This browser has no WebGL, or it is turned off: the clouds cannot be drawn. All else is here.");
  }

  function tell(message: string | null): void {
    trouble.textContent = message ?? "";
    trouble.hidden = message === null;
  }

  // What is shown.

  let range = page.distances?.range ?? 1;
  const registered = page.poses.length > 0;
  const announced = el("p", { class: "unseen", "aria-live": "polite" });

  const side = choice<Side>("Before or after", [["before", "Before"], ["after", "After"]], registered ? "after" : "before", (value) => {
    viewer?.setSide(value);
    if (layout.value() === "split") layout.choose("one");
    showDistances();
    announced.textContent = value === "before" ? "before registration" : "after registration";
  });
  const layout = choice<"one" | "split">("Panes", [["one", "Overlaid"], ["split", "Side by side"]], "one", (value) => {
    viewer?.setSplit(value === "split");
    tags.hidden = value !== "split";
    showDistances();
  });
  const colorings: (readonly [Coloring, string])[] = [["clouds", "By cloud"]];
  if (page.distances) colorings.push(["distances", "Distances"]);
  if (page.clouds.some((c) => c.colors)) colorings.push(["own", "The files’"]);
  const coloring = choice<Coloring>("Colours", colorings, "clouds", showDistances);

  function showDistances(): void {
    if (coloring.value() === "distances") {
      viewer?.setDistances(contents.distances(0), registered ? contents.distances(poses.chosen + 1) : null);
    }
    viewer?.setColoring(coloring.value(), range);
    legend.hidden = coloring.value() !== "distances";
    reach.textContent = `≥ ${number(range)}`;
  }

  const ramp = el("div", { class: "ramp" });
  const reach = el("span");
  if (page.distances) {
    const most = Math.log10(page.distances.reach);
    const slider = el("input", {
      type: "range", min: most - 3, max: most, step: 0.01, value: Math.log10(range), "aria-label": "Distance of the last colour",
    });
    slider.addEventListener("input", () => {
      range = 10 ** Number(slider.value);
      showDistances();
    });
    legend.append(
      ramp,
      el("div", { class: "ends" }, el("span", {}, "0"), reach),
      slider,
      el("figcaption", {}, `from each point of the ${registered ? "source" : "first cloud"} to the nearest of the ${registered ? "target" : "second"}, in the clouds’ unit`),
    );
  }

  const size = el("input", { type: "range", min: 1, max: 8, step: 0.5, value: 2, id: "size" });
  size.addEventListener("input", () => viewer?.setSize(Number(size.value)));
  const up = choice<Up>("Up", UPS.map((axis) => [axis, axis.replace("-", "−")] as const), "z", (value) => viewer?.setUp(value));

  function theme(): void {
    const gradient = viewer?.setPalette(palette());
    if (gradient) ramp.style.background = gradient;
  }
  onTheme(theme, gone.signal);

  const poses = new Poses(page);
  poses.onChosen = (pose, name) => {
    announced.textContent = name;
    viewer?.setPose(pose.T_target_source);
    if (side.value() === "before" && layout.value() === "one") side.choose("after");
    else showDistances();
  };

  const help = el("dialog", { id: "help", "aria-label": "Keys" },
    el("h2", {}, "Keys"),
    el("table", {}, el("tbody", {}, ...KEYS.map(([key, what]) => el("tr", {}, el("th", { scope: "row" }, el("kbd", {}, key)), el("td", {}, what))))),
    el("p", { class: "quiet" }, "Drag to turn, with the right button or two fingers to move; the wheel or a pinch zooms."),
    el("form", { method: "dialog" }, el("button", {}, "Close")));

  const [source, target] = page.clouds;
  document.title = `UPCR: ${page.clouds.map((c) => c.name).join(registered ? " → " : ", ")}`;
  const shown = [
    el("main", { class: "report" },
      el("div", { id: "picture" },
        el("div", { class: "toolbar", role: "toolbar", "aria-label": "View" },
          registered ? side.element : null,
          registered ? layout.element : null,
          el("span", { class: "gap" }),
          button("Reset", () => viewer?.reset(), { title: "The whole of it, from where it was seen first (Home)" }),
          button("Theme", turnTheme, { title: "Light or dark (t)" }),
          button("?", () => help.showModal(), { title: "Keys", "aria-label": "Keys" }),
          additions.toolbar ?? null),
        stage, legend),
      el("aside", { "aria-label": "Report" },
        el("header", {},
          el("p", { class: "quiet" }, `UPCR ${page.version}`),
          el("h1", {}, ...(registered && source && target
            ? [el("bdi", {}, source.name), " → ", el("bdi", {}, target.name)]
            : page.clouds.flatMap((c, i) => [i > 0 ? ", " : "", el("bdi", {}, c.name)])))),
        verdict(page), poses.alternatives, poses.section, additions.beside?.(() => poses.chosen) ?? null,
        cloudSection(page, viewer?.broughtFrom ?? null, (cloud, visible) => viewer?.setVisible(cloud, visible)),
        section("Display",
          colorings.length > 1 ? el("div", { class: "field" }, el("span", {}, "Colours"), coloring.element) : null,
          el("div", { class: "field" }, el("label", { for: "size" }, "Point size"), size),
          el("div", { class: "field" }, el("span", {}, "Up"), up.element)),
        figures(page), details(page))),
    announced, help,
  ];
  host.prepend(...shown);

  theme();
  if (registered) poses.choose(0);
  viewer?.setSide(side.value());
  showDistances();

  const step = (by: number) => {
    size.valueAsNumber += by;
    size.dispatchEvent(new Event("input"));
  };
  const TURN = Math.PI / 24;
  const keys: Record<string, () => void> = {
    " ": () => registered && side.choose(side.value() === "before" ? "after" : "before"),
    s: () => registered && layout.choose(layout.value() === "one" ? "split" : "one"),
    r: () => page.distances && coloring.choose(coloring.value() === "distances" ? "clouds" : "distances"),
    ArrowLeft: () => viewer?.orbit(-TURN, 0),
    ArrowRight: () => viewer?.orbit(TURN, 0),
    ArrowUp: () => viewer?.orbit(0, -TURN),
    ArrowDown: () => viewer?.orbit(0, TURN),
    "+": () => viewer?.zoom(1.2),
    "=": () => viewer?.zoom(1.2),
    "-": () => viewer?.zoom(1 / 1.2),
    Home: () => viewer?.reset(),
    "[": () => step(-0.5),
    "]": () => step(0.5),
    t: turnTheme,
    "?": () => help.showModal(),
  };

  let pointedAt: HTMLElement | null = null;
  document.addEventListener("click", ({ detail, target: at }) => {
    // Keys click too, without a count.
    pointedAt = detail > 0 && at instanceof Element ? at.closest<HTMLElement>("button, summary") : null;
  }, { signal: gone.signal });
  document.addEventListener("keydown", (event) => {
    if (event.key === "Tab") pointedAt = null;
    if (event.ctrlKey || event.metaKey || event.altKey || help.open) return;
    const { target: at } = event;
    const element = at instanceof Element ? at : null;
    // What a focused control does with a key comes first.
    if (element?.matches("input, select, textarea")) return;
    if (event.key === " " && element?.matches("button, summary")) {
      if (element !== pointedAt) return;
      // A button that was clicked has the focus too, and whoever clicked it does not mean it any more.
      pointedAt.blur();
    }
    if (/^Arrow|^Home$/.test(event.key) && element?.closest("aside, pre")) return;
    const digit = /^[0-9]$/.test(event.key) ? Number(event.key) : null;
    const act = digit === null ? keys[event.key] : () => poses.choose(digit);
    if (!act) return;
    event.preventDefault();
    act();
  }, { signal: gone.signal });

  return {
    dispose() {
      gone.abort();
      viewer?.dispose();
      for (const element of shown) element.remove();
    },
  };
}
