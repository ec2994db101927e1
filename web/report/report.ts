/** The report: a picture that can be turned, and all that is known about it beside. */

import { type Coloring, type Palette, type Side, turnBetween, type Up, UPS, Viewer } from "@upcr/viewer";

import type { Contents, Pose } from "./contents.ts";
import { button, choice, count, el, legible, number, section } from "./dom.ts";
import { isDark, onTheme, turnTheme } from "./theme.ts";
import { details, figures, verdict } from "./words.ts";

const root = document.documentElement;
const still = matchMedia("(prefers-reduced-motion: reduce)");

const KEYS: readonly (readonly [string, string])[] = [
  ["Space", "before, after"], ["s", "overlaid, side by side"], ["r", "distances as colours, and back"],
  ["0", "the pose found"], ["1 … 9", "an alternative"], ["← → ↑ ↓", "turn"], ["+ −", "zoom"], ["Home", "the whole of it"],
  ["[ ]", "smaller, larger points"], ["t", "light, dark"], ["?", "this list"],
];

/** So many comments of a file are shown at once. */
const FEW = 3;

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
  const notes = el("ul", { class: "notes" });
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

  let chosen = 0;
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
      viewer?.setDistances(contents.distances(0), registered ? contents.distances(chosen + 1) : null);
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

  // Poses.

  const poseTitle = el("p", { class: "quiet" });
  const poseText = el("pre", { tabindex: 0, "aria-label": "The pose" });
  const poseAbout = el("p", { class: "quiet" });
  const copied = el("span", { class: "quiet", role: "status" });
  const notation = el("select", { id: "notation", "aria-label": "Notation" });
  const others: HTMLButtonElement[] = [];

  function nameOf(index: number): string {
    if (!page.registration) return "The pose given";
    return index === 0 ? "The pose found" : `Alternative ${index}`;
  }

  function showNotation(): void {
    const told = page.poses[chosen]?.notations[notation.selectedIndex];
    poseText.textContent = legible(told?.text ?? "");
    poseAbout.textContent = `${told?.about ?? ""} Copy gives all digits.`;
    copied.textContent = "";
  }

  function choose(index: number): void {
    const pose = page.poses[index];
    if (!pose) return;
    chosen = index;
    others.forEach((b, i) => b.setAttribute("aria-pressed", String(i === index)));
    poseTitle.textContent = `${nameOf(index)}: takes source coordinates to target coordinates, y = R x + t.`;
    announced.textContent = nameOf(index);
    viewer?.setPose(pose.T_target_source);
    if (side.value() === "before" && layout.value() === "one") side.choose("after");
    else showDistances();
    showNotation();
  }

  async function copy(): Promise<void> {
    const text = page.poses[chosen]?.notations[notation.selectedIndex]?.text ?? "";
    try {
      await navigator.clipboard.writeText(text);
      copied.textContent = "copied";
    } catch {
      // Some browsers give pages from files no clipboard: the text is selected, to be copied by hand.
      poseText.textContent = text;
      getSelection()?.selectAllChildren(poseText);
      copied.textContent = "selected: copy it with Ctrl+C";
    }
  }

  function poseSection(): HTMLElement | null {
    const [first] = page.poses;
    if (!first) return null;
    notation.append(...first.notations.map(({ name }) => el("option", {}, name)));
    notation.addEventListener("change", showNotation);
    return section("Pose", poseTitle, el("div", { class: "row" }, notation, button("Copy", () => void copy(), { id: "copy" }), copied),
      poseText, poseAbout);
  }

  function alternatives(): HTMLElement | null {
    if (page.poses.length < 2) return null;
    const [found] = page.poses;
    const about = (pose: Pose, i: number) => i === 0 || !found
      ? "what the verdict is about"
      : `turned by ${turnBetween(found.T_target_source, pose.T_target_source).toFixed(1)}° against it, with ${(pose.relative_score ?? 0).toFixed(3)} of its score`;
    others.push(...page.poses.map((pose, i) => {
      const made = button("", () => choose(i));
      made.append(el("kbd", { "aria-hidden": "true" }, String(i)), el("span", {}, el("b", {}, nameOf(i)), el("br"), about(pose, i)));
      return made;
    }));
    return section("Alternatives", el("p", { class: "quiet" }, "Other poses explain the clouds nearly as well. Choose one to see it."),
      el("div", { class: "list", role: "group", "aria-label": "Poses" }, ...others));
  }

  // Clouds.

  function cloudList(): HTMLElement {
    return section("Clouds", el("ul", { class: "clouds" }, ...page.clouds.map((cloud, i) => {
      const box = el("input", { type: "checkbox", checked: true });
      box.addEventListener("change", () => viewer?.setVisible(i, box.checked));
      const role = page.verdict || registered ? ["source", "target"][i] ?? "" : "";
      const told = [role, `${count(cloud.points)} ${cloud.points === 1 ? "point" : "points"}`].filter((t) => t !== "").join(", ");
      return el("li", {}, el("label", {}, box, el("span", { class: `swatch cloud-${i % 6}`, "aria-hidden": "true" }),
        el("span", { class: "name" }, el("bdi", {}, cloud.name)), el("span", { class: "quiet" }, told)),
        cloud.comments.length === 0 ? null : el("details", { class: "quiet", open: cloud.comments.length <= FEW },
          el("summary", {}, "What the file says of itself"), ...cloud.comments.map((text) => el("p", {}, el("bdi", {}, text)))));
    })), notes);
  }

  for (const cloud of page.clouds) {
    if (cloud.shown < cloud.points - cloud.left_out) {
      notes.append(el("li", {}, el("bdi", {}, cloud.name), `: thinned for display to ${count(cloud.shown)} of ${count(cloud.points)} points, by chance.`));
    }
    if (cloud.left_out > 0) {
      notes.append(el("li", {}, el("bdi", {}, cloud.name), `: ${count(cloud.left_out)} ${cloud.left_out === 1 ? "point without finite coordinates is" : "points without finite coordinates are"} left out.`));
    }
  }
  if (viewer && viewer.broughtFrom !== null) {
    notes.append(el("li", {}, `The first two clouds lie ${number(viewer.broughtFrom)} apart; before, they are drawn nearer.`));
  }

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
        verdict(page), alternatives(), poseSection(), additions.beside?.(() => chosen) ?? null, cloudList(),
        section("Display",
          colorings.length > 1 ? el("div", { class: "field" }, el("span", {}, "Colours"), coloring.element) : null,
          el("div", { class: "field" }, el("label", { for: "size" }, "Point size"), size),
          el("div", { class: "field" }, el("span", {}, "Up"), up.element)),
        figures(page), details(page))),
    announced, help,
  ];
  host.prepend(...shown);

  theme();
  if (registered) choose(0);
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
    const act = digit === null ? keys[event.key] : () => choose(digit);
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
