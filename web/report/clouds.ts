/** The clouds of a page: their names and sizes, what their files say, and how what is drawn differs from them. */

import type { CloudInfo, Page } from "./contents.ts";
import { count, el, number, section } from "./dom.ts";

/** So many comments of a file are shown at once. */
const FEW = 3;

function points(n: number): string {
  return `${count(n)} ${n === 1 ? "point" : "points"}`;
}

function comments(of: CloudInfo): HTMLElement | null {
  if (of.comments.length === 0) return null;
  return el("details", { class: "quiet", open: of.comments.length <= FEW },
    el("summary", {}, "What the file says of itself"), ...of.comments.map((text) => el("p", {}, el("bdi", {}, text))));
}

/** What of a cloud is not drawn. */
function missing(cloud: CloudInfo): string[] {
  const told = [];
  if (cloud.shown < cloud.points - cloud.left_out) {
    told.push(`: thinned for display to ${count(cloud.shown)} of ${points(cloud.points)}, by chance.`);
  }
  if (cloud.left_out > 0) {
    told.push(`: ${points(cloud.left_out)} without finite coordinates ${cloud.left_out === 1 ? "is" : "are"} left out.`);
  }
  return told;
}

/** @param broughtFrom how far the first cloud lies from where it is drawn before.
 *  @param show draws a cloud, or leaves it out. */
export function cloudSection(page: Page, broughtFrom: number | null, show: (cloud: number, visible: boolean) => void): HTMLElement {
  const notes = page.clouds.flatMap((cloud) => missing(cloud).map((text) => el("li", {}, el("bdi", {}, cloud.name), text)));
  if (broughtFrom !== null) {
    notes.push(el("li", {}, `The first two clouds lie ${number(broughtFrom)} apart; before, they are drawn nearer.`));
  }
  const roles = page.poses.length > 0 ? ["source", "target"] : [];
  return section("Clouds", el("ul", { class: "clouds" }, ...page.clouds.map((cloud, i) => {
    const box = el("input", { type: "checkbox", checked: true });
    box.addEventListener("change", () => show(i, box.checked));
    return el("li", {},
      el("label", {}, box, el("span", { class: `swatch cloud-${i % 6}`, "aria-hidden": "true" }),
        el("span", { class: "name" }, el("bdi", {}, cloud.name)),
        el("span", { class: "quiet" }, [...roles.slice(i, i + 1), points(cloud.points)].join(", "))),
      comments(cloud));
  })), el("ul", { class: "notes" }, ...notes));
}
