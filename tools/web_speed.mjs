// Times of the browser's modules in node. Usage: node tools/web_speed.mjs STREAM [ROUNDS]
//
// Prints JSON: for each packet its kind, bytes, rows it changed, and milliseconds of decoding; and of sorting the last
// state by depth from the recording's cameras. Each in processor time of all threads of this process
// (compiling and collecting included), the median (`cpu`) and the least of the rounds, and the least wall time, to which
// other work on the machine only ever adds.

import { readFileSync } from "node:fs";

import "../gsstream/web/changes/field.js";
import "../gsstream/web/changes/light.js";
import "../gsstream/web/layers.js";
import { viewsOf } from "../gsstream/web/camera.js";
import { KIND, KIND_NAMES } from "../gsstream/web/container.js";
import { decodePacket } from "../gsstream/web/decode.js";
import "../gsstream/web/layers.js";
import { DepthSorter } from "../gsstream/web/sorting.js";
import { PacketWalker } from "../gsstream/web/walker.js";

const [, , path, rounds = "7"] = process.argv;
const walker = new PacketWalker();
walker.push(new Uint8Array(readFileSync(path)));
const packets = [];
for (let packet = walker.next(); packet; packet = walker.next()) if (packet.header.kind !== KIND.index) packets.push(packet);

/** Run something and note its processor and wall milliseconds. */
function timed(notes, work) {
  const [wall, cpu] = [performance.now(), process.cpuUsage()];
  work();
  const used = process.cpuUsage(cpu);
  notes.push({ wall: performance.now() - wall, cpu: (used.user + used.system) / 1000 });
}

const times = packets.map(() => []);
const rows = [];
let state = null;
for (let round = 0; round < Number(rounds); round += 1) {
  packets.forEach((packet, i) => {
    timed(times[i], () => {
      state = decodePacket(state, packet.data, packet.offset);
    });
    rows[i] = (state.change.moved ?? []).reduce((sum, part) => sum + part.rows.length, 0);
  });
}
const rounded = (value) => Math.round(value * 1000) / 1000;
const summary = (notes) => ({
  cpu: rounded(notes.map(({ cpu }) => cpu).sort((a, b) => a - b)[notes.length >> 1]),
  leastCpu: rounded(Math.min(...notes.map(({ cpu }) => cpu))),
  wall: rounded(Math.min(...notes.map(({ wall }) => wall))),
});

const sorter = new DepthSorter();
sorter.reset(state.number);
sorter.update(Uint32Array.from({ length: state.number }, (_, i) => i), state.scene.means);
const sorting = [];
for (let round = 0; round < 10; round += 1) {
  for (const { right, down, forward, eye, near } of viewsOf(state.meta)) {
    const axis = [...forward, -(forward[0] * eye[0] + forward[1] * eye[1] + forward[2] * eye[2])];
    timed(sorting, () => sorter.sort(axis, near));
  }
}
console.log(
  JSON.stringify({
    node: process.version,
    gaussians: state.number,
    packets: packets.map(({ header, data }, i) => ({
      frame: header.frame,
      kind: KIND_NAMES[header.kind],
      bytes: data.length,
      rows: rows[i],
      ...summary(times[i]),
    })),
    sort: summary(sorting),
  }),
);
