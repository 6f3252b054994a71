// Loads and decodes a stream beside the page's thread. Its messages are those of stream.js.

// All modules at once: one that another one asks for would come a round trip later.
const MODULES = "stream decode packing source buffer walker download changes/motion changes/residual changes/rows symbols";
const MORE = "key meta attributes bits container history errors limits texels vendor/fzstd";

const begun = new Map();
const waiting = [];
let stream = null;

self.onmessage = ({ data }) => {
  if (data[0] === "open" && !stream) ahead(data[2]);
  if (stream) stream.hear(data);
  else waiting.push(data);
};

/** Ask for a manifest and its first segment at once: they need not wait until all modules are there. */
function ahead(url) {
  if (!new URL(url).pathname.endsWith(".json") || !/^http/.test(url)) return;
  const answer = fetch(url);
  begun.set(url, answer);
  const first = ({ segments: [{ file, joins }] }) => {
    const href = file && !joins?.length && new URL(file, url).href;
    if (href) begun.set(href, fetch(href));
  };
  answer.then((found) => found.clone().json()).then(first).catch(() => {});
}

const loaded = Promise.all([...MODULES.split(" "), ...MORE.split(" ")].map((name) => import(`./${name}.js`)));
loaded.then(([{ Stream }, , , , , , { settings }]) => {
  const plain = settings.fetch;
  settings.fetch = (url, init) => {
    const known = init.headers?.Range ? null : begun.get(url);
    begun.delete(url);
    return known ?? plain(url, init);
  };
  stream = new Stream((message, transfer) => self.postMessage(message, transfer ?? []), 80);
  for (const message of waiting) stream.hear(message);
});
