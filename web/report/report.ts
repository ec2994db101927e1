/** The report: a picture that can be turned, and all that is known about it beside. */

import type { Coloring, Side } from "@upcr/viewer";

import { cloudSection } from "./clouds.ts";
import type { Contents } from "./contents.ts";
import { choice, el, number, section } from "./dom.ts";
import { type Key, keyboard } from "./keys.ts";
import { Poses } from "./poses.ts";
import { Stage } from "./stage.ts";
import { details, figures, verdict } from "./words.ts";

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

/** Puts the report into `host`. */
export function showReport(host: HTMLElement, contents: Contents, additions: Additions = {}): Report {
  const { page } = contents;
  const gone = new AbortController();

  const stage = new Stage(page.clouds.map((_, i) => contents.cloud(i)), page.clouds.map((c) => c.name).join(", "), true, gone.signal);
  const { viewer } = stage;
  const tags = el("div", { class: "tags", "aria-hidden": "true", hidden: true }, el("span", {}, "Before"), el("span", {}, "After"));
  const legend = el("figure", { id: "legend", hidden: true });
  stage.element.append(tags);

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

  stage.onGradient = (gradient) => {
    ramp.style.background = gradient;
  };

  const poses = new Poses(page);
  poses.onChosen = (pose, name) => {
    announced.textContent = name;
    viewer?.setPose(pose.T_target_source);
    if (side.value() === "before" && layout.value() === "one") side.choose("after");
    else showDistances();
  };

  const digits = Array.from({ length: 9 }, (_, i) => String(i + 1));
  const keys: readonly Key[] = [
    { shown: "Space", about: "before, after", acts: { " ": () => registered && side.choose(side.value() === "before" ? "after" : "before") } },
    { shown: "s", about: "overlaid, side by side", acts: { s: () => registered && layout.choose(layout.value() === "one" ? "split" : "one") } },
    {
      shown: "r", about: "distances as colours, and back",
      acts: { r: () => page.distances && coloring.choose(coloring.value() === "distances" ? "clouds" : "distances") },
    },
    { shown: "0", about: "the pose found", acts: { 0: () => poses.choose(0) } },
    { shown: "1 … 9", about: "an alternative", acts: Object.fromEntries(digits.map((digit) => [digit, () => poses.choose(Number(digit))])) },
    ...stage.keys(),
  ];
  const help = keyboard(keys, gone.signal);

  const [source, target] = page.clouds;
  document.title = `UPCR: ${page.clouds.map((c) => c.name).join(registered ? " → " : ", ")}`;
  const shown = [
    el("main", { class: "report" },
      el("div", { id: "picture" },
        el("div", { class: "toolbar", role: "toolbar", "aria-label": "View" },
          registered ? side.element : null,
          registered ? layout.element : null,
          el("span", { class: "gap" }),
          ...stage.buttons(() => help.showModal()),
          additions.toolbar ?? null),
        stage.element, legend),
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
          ...stage.fields()),
        figures(page), details(page))),
    announced, help,
  ];
  host.prepend(...shown);

  stage.paint();
  if (registered) poses.choose(0);
  viewer?.setSide(side.value());
  showDistances();

  return {
    dispose() {
      gone.abort();
      viewer?.dispose();
      for (const element of shown) element.remove();
    },
  };
}
