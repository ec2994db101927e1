/** The page that the command line writes: all that it shows is in elements that nothing runs. */

import { decode, take } from "./embedded.ts";
import { type Bytes, Contents, type Page } from "./contents.ts";
import { adopt } from "./dom.ts";
import type { MergePage } from "./merge/contents.ts";
import { showMerge } from "./merge/merge.ts";
import { showReport } from "./report.ts";
import style from "./style.css";

adopt(style);
const told = JSON.parse(take("page")) as Page | MergePage;
const bytes: Bytes = (name) => decode(take(name));
if ("merge" in told) showMerge(document.body, told, bytes);
else showReport(document.body, new Contents(told, bytes));

/** Whoever looks from outside sees when the page stands. */
document.documentElement.dataset["ready"] = "";
