/** The page that the command line writes: all that it shows is in elements that nothing runs. */

import { decode, take } from "./embedded.ts";
import { Contents, type Page } from "./contents.ts";
import { adopt } from "./dom.ts";
import { showReport } from "./report.ts";
import style from "./style.css";

adopt(style);
showReport(document.body, new Contents(JSON.parse(take("page")) as Page, (name) => decode(take(name))));

/** Whoever looks from outside sees when the page stands. */
document.documentElement.dataset["ready"] = "";
