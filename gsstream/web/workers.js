// Modules of the player beside the page's thread.

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
