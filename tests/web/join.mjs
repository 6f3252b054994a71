// Reach every frame of a segment through its join. Usage: node join.mjs PARTS NUMBER
//
// PARTS holds NUMBER packets, a key packet first, then the joins after each of the others, each part preceded by its
// length (u32). Prints for every join the SHA-256 of its state and of those that the packets behind it lead to.

import { createHash } from "node:crypto";
import { readFileSync } from "node:fs";

import { decodePacket } from "../../gsstream/web/decode.js";
import "../../gsstream/web/changes/field.js";
import "../../gsstream/web/changes/light.js";
import "../../gsstream/web/layers.js";
import { decodeJoin } from "../../gsstream/web/joins.js";
import { sceneBytes } from "./scene-bytes.mjs";

const [, , from, number] = process.argv;
const data = new Uint8Array(readFileSync(from));
const view = new DataView(data.buffer, data.byteOffset);
const parts = [];
for (let at = 0; at < data.length; at += 4 + view.getUint32(at, true))
  parts.push(data.subarray(at + 4, at + 4 + view.getUint32(at, true)));
const packets = parts.slice(0, number);
const digest = (state) => createHash("sha256").update(sceneBytes(state)).digest("hex");
// Straight through first, so that a difference there is not taken for one of the joins.
const straight = [];
let state = null;
for (const packet of packets) {
  state = decodePacket(state, packet);
  straight.push(digest(state));
}
const found = parts.slice(number).map((join, i) => {
  let joined = decodeJoin(decodePacket(null, packets[0]), join);
  const digests = [digest(joined)];
  for (const packet of packets.slice(i + 2)) {
    joined = decodePacket(joined, packet);
    digests.push(digest(joined));
  }
  if (digests.some((text, k) => text !== straight[i + 1 + k])) throw new Error(`join ${i + 1} leads elsewhere`);
  return digests;
});
console.log(JSON.stringify(found));
