// Times of the decoder in WebAssembly in node. Usage: node tools/wasm_speed.mjs MODULE STREAM [ROUNDS]
//
// Prints JSON: for each frame the least milliseconds of processor time (of all threads of this process, compiling
// included) that the rounds took to decode it.

import { readFileSync } from "node:fs";

import { loadDecoder } from "../plugins/c_decoder/wasm/gss.mjs";

const [, , module, path, rounds = "7"] = process.argv;
const decoder = await loadDecoder(readFileSync(module));
const bytes = readFileSync(path);
const least = [];
for (let round = 0; round < Number(rounds); round += 1) {
  const stream = decoder.open(bytes);
  for (let i = 0; ; i += 1) {
    const before = process.cpuUsage();
    const decoded = stream.next();
    const used = process.cpuUsage(before);
    if (!decoded) break;
    least[i] = Math.min(least[i] ?? Infinity, (used.user + used.system) / 1000);
  }
  stream.close();
}
console.log(JSON.stringify(least));
