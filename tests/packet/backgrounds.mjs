// Print the background of every frame of a stream, as the browser's decoder has it. Usage: node backgrounds.mjs STREAM

import { readFileSync } from "node:fs";

import { KIND } from "../../gsstream/web/container.js";
import { decodePacket } from "../../gsstream/web/decode.js";
import "../../gsstream/web/changes/light.js";
import { PacketWalker } from "../../gsstream/web/walker.js";

const walker = new PacketWalker();
walker.push(new Uint8Array(readFileSync(process.argv[2])));
let state = null;
for (let packet = walker.next(); packet; packet = walker.next()) {
  if (packet.header.kind === KIND.index) continue;
  state = decodePacket(state, packet.data, packet.offset);
  console.log([...(state.background ?? state.meta.background)].join(" "));
}
