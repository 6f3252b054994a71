// Why a request failed before anything came, and what to do: a browser itself tells a page nothing.

/** A sentence, or null where waiting may help. `origin`: that of the page. */
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
