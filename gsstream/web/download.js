// Bytes of a file from a web server, in order, through the ways in which servers and connections fail.

/** Why nothing comes, in one sentence for the viewer of the page. */
export class SourceError extends Error {
  constructor(message) {
    super(message);
    this.name = "SourceError";
  }
}

const RETRIES = 4;

/** How downloads are made; tests shorten the waiting. */
export const settings = { patience: 15_000, firstPause: 300, fetch: (...args) => globalThis.fetch(...args) };

/** Ask for bytes `start` to `end` (inclusive; null: to the end) of a file; `ranged` false asks for all of it. */
export async function request(url, { start = 0, end = null, ranged = true, signal } = {}) {
  const headers = ranged ? { Range: start < 0 ? `bytes=${start}` : `bytes=${start}-${end ?? ""}` } : {};
  const stall = new AbortController();
  signal?.addEventListener("abort", () => stall.abort(signal.reason), { once: true });
  return patient(settings.fetch(url, { headers, signal: stall.signal }), "The server does not answer.", stall);
}

/** What a promise comes to, or a SourceError with `words` when that takes too long; `stall` then ends it. */
function patient(promise, words, stall = null) {
  let timer;
  const stalled = new Promise((_, reject) => {
    timer = setTimeout(() => {
      reject(new SourceError(words));
      stall?.abort();
    }, settings.patience);
  });
  return Promise.race([promise, stalled]).finally(() => clearTimeout(timer));
}

/** The chunks of a response's body. A server that sends nothing for long counts as gone. */
async function* chunksOf(response, signal) {
  const reader = response.body.getReader();
  try {
    for (;;) {
      const { value, done } = await patient(reader.read(), "The server stopped sending.");
      if (signal?.aborted) throw signal.reason;
      if (done) return;
      yield value;
    }
  } finally {
    reader.cancel().catch(() => {});
  }
}

/**
 * Bytes `start` to `end` of a file as chunks, in order. `whole`: the file is just these bytes, so the first request
 * needs no range. A connection that breaks is taken up where it broke, a few times.
 *
 * A server that knows no ranges sends the whole file. `all` is `{ end }` for a caller who can use that: it then gets
 * everything up to that byte, and `all.sent` is true.
 *
 * Throws SourceError when the file is not there or the server stops for good.
 */
export async function* bytesOf(url, { start = 0, end = null, whole = false, all = null, signal } = {}) {
  let at = start;
  for (let failures = 0; ;) {
    try {
      const ranged = !(whole && at === start);
      const response = await request(url, { start: at, end, ranged, signal });
      if (all && ranged && response.status === 200 && at === start) {
        all.sent = true;
        start = at = 0;
        end = all.end;
      }
      const first = firstByte(response, url, ranged ? at : start);
      if (first === null) return;
      for await (const chunk of clipped(chunksOf(response, signal), first, at, end)) {
        at += chunk.length;
        failures = 0;
        yield chunk;
      }
      if (end === null || at > end) return;
      throw new SourceError("The file ends before it should.");
    } catch (error) {
      if (signal?.aborted || error.final) throw error;
      failures += 1;
      // Nothing came yet: there may be a reason for which waiting does not help.
      if (at === start) await forbidden(url, error);
      if (failures > RETRIES) throw new SourceError(`${sentence(error)} What was loaded until then is played.`);
      await new Promise((resolve) => setTimeout(resolve, settings.firstPause * 2 ** (failures - 1)));
      signal?.throwIfAborted();
    }
  }
}

/** Byte of the file at which a response begins; null when there is nothing from `at` on. Throws when it is an error. */
function firstByte(response, url, at) {
  if (response.status === 206) {
    const range = /^bytes (\d+)-/.exec(response.headers.get("Content-Range") ?? "");
    return range ? Number(range[1]) : at;
  }
  if (response.status === 200) return 0;
  if (response.status === 416) return null;
  throw refusal(response, url);
}

/** What an answer that is neither a file nor a part of one means. */
export function refusal({ status }, url) {
  const said =
    status === 401
      ? "This stream needs a token: add ?token=… to the address of the page."
      : `There is no stream at ${url}: the server answers ${status}. Look whether the address is right.`;
  return Object.assign(new SourceError(said), { final: status < 500 });
}

/** Chunks that begin at byte `first` of the file, without what lies before `at` or after `end`. */
async function* clipped(chunks, first, at, end) {
  let place = first;
  for await (const chunk of chunks) {
    const from = Math.max(0, at - place);
    const to = end === null ? chunk.length : Math.min(chunk.length, end + 1 - place);
    if (from < to) yield chunk.subarray(from, to);
    place += chunk.length;
    if (end !== null && place > end) return;
  }
}

/** All bytes of a file at once. Throws SourceError. */
export async function fileOf(url, { bytes = null, signal } = {}) {
  return joined(bytesOf(url, { end: bytes && bytes - 1, whole: true, signal }));
}

/** Chunks as one array. */
export async function joined(chunks) {
  const parts = [];
  for await (const chunk of chunks) parts.push(chunk);
  return new Uint8Array(await new Blob(parts).arrayBuffer());
}

/** Throw a final SourceError where a request for `url` failed for a reason that can be told and will not pass. */
export async function forbidden(url, error) {
  if (error instanceof SourceError || error.name === "PacketError") return;
  const reason = await reasonOf(url, settings.fetch);
  if (reason) throw Object.assign(new SourceError(reason), { final: true });
}

/**
 * Why a request failed before anything came, and what to do: a browser itself tells a page nothing. A sentence, or null
 * where waiting may help. `origin`: that of the page.
 */
export async function reasonOf(url, fetch, { origin = globalThis.origin, navigator = globalThis.navigator } = {}) {
  const address = new URL(url);
  if (navigator?.onLine === false) return "This device is offline. Connect it, and press play.";
  const local = /^(localhost|127\.|\[::1\])/.test(address.hostname);
  if (address.protocol === "http:" && origin?.startsWith("https:") && !local) {
    return `A page with https may not read ${url}. Serve the stream by https as well.`;
  }
  if (address.origin === origin) return null;
  try {
    // Without a look at the answer anybody may ask.
    await fetch(url, { mode: "no-cors", method: "HEAD" });
  } catch {
    return `There is no server at ${address.origin}, or it does not answer. Look whether the address is right.`;
  }
  return `${address.origin} does not let ${origin} read its files. Let it send Access-Control-Allow-Origin (CORS).`;
}

function sentence(error) {
  return error instanceof SourceError ? error.message : "The connection to the server is cut.";
}
