// Play streams with the browser's decoder and say what came of them. Usage: node play.mjs STREAMS RESULTS
//
// STREAMS holds streams one after the other, each preceded by its length (u32). RESULTS gets a JSON list with an entry
// for each: the SHA-256 of the state after every packet, that of the first packet's first layer, the error that ended it, and how long it took.

import { createHash } from "node:crypto";
import { readFileSync, writeFileSync } from "node:fs";

import "../../gsstream/web/changes/field.js";
import "../../gsstream/web/changes/light.js";
import { KIND } from "../../gsstream/web/container.js";
import { decodePacket } from "../../gsstream/web/decode.js";
import { firstLayer } from "../../gsstream/web/layers.js";
import { PacketError } from "../../gsstream/web/errors.js";
import { PacketWalker } from "../../gsstream/web/walker.js";
import { sceneBytes } from "./scene-bytes.mjs";

const digest = (state) => createHash("sha256").update(sceneBytes(state)).digest("hex");

/** Push a stream in pieces, as a download would. */
function play(bytes, piece) {
  const walker = new PacketWalker();
  const digests = [];
  let state = null;
  let error = null;
  const started = performance.now();
  try {
    for (let at = 0; at < bytes.length || at === 0; at += piece) {
      walker.push(bytes.subarray(at, at + piece));
      for (let packet = walker.next(); packet; packet = walker.next()) {
        if (packet.header.kind === KIND.index) continue;
        state = decodePacket(state, packet.data, packet.offset);
        digests.push(digest(state));
      }
    }
    walker.finish();
  } catch (caught) {
    error = { message: caught.message, offset: caught.offset ?? null, expected: caught instanceof PacketError };
  }
  const first = firstLayer(bytes.subarray(16));
  const early = first && digest(first);
  return { digests, early, error, milliseconds: performance.now() - started };
}

/** Peak resident memory of this process alone: maxRSS counts the process that started it as well, from before exec. */
function peakMegabytes() {
  const line = readFileSync("/proc/self/status", "utf8").match(/^VmHWM:\s+(\d+) kB$/m);
  return Number(line[1]) / 1024;
}

const [, , from, to] = process.argv;
const data = new Uint8Array(readFileSync(from));
const view = new DataView(data.buffer);
const streams = [];
for (let at = 0; at < data.length;) {
  const size = view.getUint32(at, true);
  streams.push(play(data.subarray(at + 4, at + 4 + size), streams.length % 2 ? 1000 : 1 << 20));
  at += 4 + size;
}
writeFileSync(to, JSON.stringify({ streams, megabytes: peakMegabytes() }));
