/** What can be taken away of a registration. */

import type { Page } from "@upcr/report/contents.ts";
import { button, el, section } from "@upcr/report/dom.ts";

import type { Engine } from "./engine.ts";

/** Formats that a cloud can be written in, of those that people ask for. */
const FORMATS = ["ply", "pcd", "xyz", "las"] as const;

function download(name: string, content: BlobPart, type: string): void {
  const url = URL.createObjectURL(new Blob([content], { type }));
  el("a", { href: url, download: name }).click();
  // The browser has it once the click has been seen to.
  setTimeout(() => URL.revokeObjectURL(url), 10_000);
}

export function saving(engine: Engine, page: Page, source: string, chosen: () => number): HTMLElement {
  const stem = source.replace(/\.[^.]*$/, "") || "source";
  const said = el("p", { class: "quiet", role: "status" });
  const format = el("select", { "aria-label": "Format of the aligned cloud" }, ...FORMATS.map((f) => el("option", {}, f)));
  const buttons: HTMLButtonElement[] = [];

  /** @param make the file's content; buttons rest meanwhile. */
  const save = (label: string, name: () => string, type: string, make: () => BlobPart | Promise<BlobPart>) => {
    const made = button(label, () => {
      void (async () => {
        buttons.forEach((b) => (b.disabled = true));
        said.textContent = "";
        try {
          download(name(), await make(), type);
        } catch (error) {
          said.textContent = error instanceof Error ? error.message : String(error);
        }
        buttons.forEach((b) => (b.disabled = false));
      })();
    });
    buttons.push(made);
    return made;
  };
  const aligned = () => `${stem}_aligned.${format.value}`;
  return section("Save",
    el("div", { class: "row" },
      save("Aligned source", aligned, "application/octet-stream", () => engine.make({ kind: "aligned", pose: chosen(), name: aligned() })),
      format),
    el("div", { class: "row" },
      save("Pose", () => "T_target_source.txt", "text/plain", () => `${page.poses[chosen()]?.notations[0]?.text ?? ""}\n`),
      save("JSON", () => "registration.json", "application/json", () => `${JSON.stringify(page.registration, null, 2)}\n`),
      save("Report", () => `${stem}.html`, "text/html", () => engine.make({ kind: "report" }))),
    said,
    page.poses.length > 1 ? el("p", { class: "quiet" }, "Aligned source and pose are of the pose that is shown.") : null);
}
