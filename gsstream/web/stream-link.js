// The page's end of a stream that is loaded and decoded elsewhere: in a worker, or in slices on this thread.

/** Milliseconds of decoding on the page's own thread, after which the page gets its turn. */
const SLICE = 8;
/** What is said where a module does not come. */
export const LOST = "A part of the player could not be loaded. Load the page again.";

/** Posts messages to a Stream (see stream.js) and hands what it says to `hear`. */
export class StreamLink {
  /**
   * `allowed` false decodes on this thread. `early`: `{ url, worker, said, failed }`, a worker that was started before
   * the modules of the player were there, what it was told to open and has said.
   */
  constructor(hear, { allowed = true, early = null } = {}) {
    this.hear = hear;
    /** What the worker was told, until it has proven that it runs. */
    this.sent = [];
    this.local = null;
    this.worker = allowed ? (early?.worker ?? startWorker("stream-worker.js")) : null;
    if (!this.worker || early?.failed) {
      this._here();
      return;
    }
    this.worker.onmessage = ({ data }) => {
      this.sent = null;
      this.hear(data);
    };
    this.worker.onerror = (event) => this._failed(event);
    for (const data of early?.said ?? []) this.worker.onmessage({ data });
  }

  post(...message) {
    this.sent?.push(message);
    if (this.stream) this.stream.hear(message);
    else if (!this.local) this.worker.postMessage(message);
  }

  dispose() {
    this.hear = () => {};
    this.worker?.terminate();
    this.stream?.close();
  }

  /** A worker that does not start (a strict policy of the page) is replaced by this thread. */
  _failed(event) {
    event.preventDefault();
    if (this.sent) this._here();
    else this.hear({ problem: `The player's worker failed: ${event.message}`, kind: "Error", ended: true });
  }

  _here() {
    this.worker?.terminate();
    this.worker = null;
    this.local ??= import("./stream.js").then(({ Stream }) => {
      this.stream = new Stream((message) => this.hear(message), SLICE);
      for (const message of this.sent) this.stream.hear(message);
      this.sent = null;
    }).catch(() => this.hear({ problem: LOST, kind: "Error", ended: true }));
  }
}

/** A module of the player as a Worker, or null where the page may have none. */
export function startWorker(name) {
  const url = new URL(name, import.meta.url);
  // The player may lie elsewhere; a worker must be the page's own, and one line that imports the module is.
  const own = url.origin === globalThis.location?.origin;
  const line = () => URL.createObjectURL(new Blob([`import ${JSON.stringify(url.href)};`], { type: "text/javascript" }));
  try {
    return new Worker(own ? url : line(), { type: "module" });
  } catch {
    return null;
  }
}
