/** The library, on a thread of its own: the page never waits for it. */

import { extensions, initSync, register, type Registered, version } from "./module/upcr_web.js";
import type { Asked, Told } from "./messages.ts";

const tell = (told: Told, transfer: Transferable[] = []) => self.postMessage(told, { transfer });

let registered: Registered | null = null;

const read = async (file: File) => new Uint8Array(await file.arrayBuffer());

function held(): Registered {
  if (!registered) throw new Error("nothing has been registered");
  return registered;
}

async function answer(asked: Asked): Promise<void> {
  switch (asked.kind) {
    case "load":
      initSync({ module: asked.module });
      tell({ kind: "loaded", version: version(), extensions: extensions() });
      break;
    case "register": {
      registered?.free();
      registered = null;
      tell({ kind: "progress", stage: "reading", done: 0 });
      const { source, target } = asked;
      const [a, b] = await Promise.all([read(source), read(target)]);
      const start = performance.now();
      registered = register(source.name, a, target.name, b, JSON.stringify(asked.choices),
        (stage: string, done: number) => tell({ kind: "progress", stage, done }));
      const ms = performance.now() - start;
      tell({ kind: "progress", stage: "drawing", done: 1 });
      const [words, ...named] = registered.contents() as [string, ...(string | Uint8Array<ArrayBuffer>)[]];
      const blobs = new Map<string, Uint8Array<ArrayBuffer>>();
      for (let i = 0; i + 1 < named.length; i += 2) blobs.set(named[i] as string, named[i + 1] as Uint8Array<ArrayBuffer>);
      tell({ kind: "registered", words, blobs, ms }, [...blobs.values()].map((bytes) => bytes.buffer));
      break;
    }
    case "aligned": {
      const content = held().aligned(asked.pose, asked.name) as Uint8Array<ArrayBuffer>;
      tell({ kind: "made", content }, [content.buffer]);
      break;
    }
    case "report":
      tell({ kind: "made", content: held().report() });
      break;
  }
}

self.onmessage = ({ data }: MessageEvent<Asked>) => {
  answer(data).catch((error: unknown) => {
    // What the library refuses is an Error; a fault of its own is told as text, or is the machine's.
    const refused = error instanceof Error && !(error instanceof WebAssembly.RuntimeError) && !(error instanceof RangeError);
    tell({ kind: "failed", message: error instanceof Error ? error.message : String(error), broken: !refused });
  });
};
