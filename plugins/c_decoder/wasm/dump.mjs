// The conformance program of the decoder in WebAssembly. Usage: node dump.mjs MODULE STREAM [STREAM ...]
//
// MODULE is gss.wasm. Prints index and hash of every frame, and what ended a stream before its end. Of several streams the path comes first.

import { readFile } from "node:fs/promises";

import { loadDecoder } from "./gss.mjs";

const [module, ...paths] = process.argv.slice(2);
const decoder = await loadDecoder(await readFile(module));
for (const path of paths) {
  if (paths.length > 1) console.log(`file ${path}`);
  const stream = decoder.open(await readFile(path));
  while (stream.next()) console.log(`${stream.frame.frame} ${stream.hash()}`);
  if (stream.error) {
    console.log(`refused ${stream.error.message}`);
    process.exitCode = 1;
  }
  stream.close();
}
