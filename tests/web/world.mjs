// What the browser player says of a stream's coordinates. Usage: node world.mjs META -> JSON on standard output.

import { readFileSync } from "node:fs";

import { poseInRecording, toRecording, worldOf } from "../../docs/examples/world.js";
import { viewsOf } from "../../gsstream/web/camera.js";
import { isWorld } from "../../gsstream/web/meta.js";

const { meta, points, candidates } = JSON.parse(readFileSync(process.argv[2], "utf8"));
const world = worldOf(meta);
console.log(
  JSON.stringify({
    points: points.map((point) => toRecording(world, point)),
    poses: viewsOf(meta).map((view) => poseInRecording(meta, view)),
    valid: candidates.map(isWorld),
  }),
);
