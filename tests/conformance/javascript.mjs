// A program of the conformance suite around the browser's decoder. Usage: node javascript.mjs STREAM

import { createHash } from "node:crypto";
import { readFileSync } from "node:fs";

import { KIND } from "../../gsstream/web/container.js";
import { decodePacket } from "../../gsstream/web/decode.js";
import { PacketError } from "../../gsstream/web/errors.js";
import "../../gsstream/web/changes/field.js";
import "../../gsstream/web/changes/light.js";
import "../../gsstream/web/layers.js";
import { PacketWalker } from "../../gsstream/web/walker.js";
import { sceneBytes } from "../web/scene-bytes.mjs";

const walker = new PacketWalker();
let state = null;
try {
  walker.push(new Uint8Array(readFileSync(process.argv[2])));
  for (let packet = walker.next(); packet; packet = walker.next()) {
    if (packet.header.kind === KIND.index) continue;
    state = decodePacket(state, packet.data, packet.offset);
    console.log(`${state.frame} ${createHash("sha256").update(sceneBytes(state)).digest("hex")}`);
  }
  walker.finish();
} catch (error) {
  if (!(error instanceof PacketError)) throw error;
  const known = JSON.parse(readFileSync(new URL("messages.json", import.meta.url)));
  const why = `refused ${error.message}`.replace(/ \(at byte \d+\)$/, "");
  const [, rules] = known.find(([words]) => new RegExp(words).test(why)) ?? [null, ["R-0.1-1"]];
  console.log(`refused ${error.message} ${rules.join(" ")}`);
  process.exitCode = 1;
}
