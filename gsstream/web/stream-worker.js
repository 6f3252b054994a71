// Loads and decodes a stream beside the page's thread. Its messages are those of stream.js.

// All modules at once: one that another one asks for would come a round trip later.
const MODULES = "stream decode packing source buffer walker download changes/motion changes/residual changes/rows symbols";
const MORE = "key layers meta attributes bits container history errors limits texels vendor/fzstd";

const begun = new Map();
const waiting = [];
let stream = null;

self.onmessage = ({ data }) => {
  if (data[0] === "manifest") ahead(data[1], data[2]);
  else if (stream) stream.hear(data);
  else waiting.push(data);
};

/** Ask for the first segment of a manifest at once: it need not wait until all modules are there. */
function ahead(url, text) {
  begun.set(url, Promise.resolve(new Response(text)));
  try {
    const [{ file, joins }] = JSON.parse(text).segments;
    const href = file && !joins?.length && new URL(file, url).href;
    if (href) begun.set(href, fetch(href, { priority: "high" }));
  } catch {
    // Whatever it is, who opens it says what is wrong.
  }
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
}).catch((error) => {
  // A page hears of errors only, not of promises.
  setTimeout(() => { throw error; });
});
