// The meta section of a key packet: cameras, frame rate and background as JSON in a zstandard frame.

import { PacketError } from "./errors.js";
import { MAX_META } from "./limits.js";
import { decompress } from "./vendor/fzstd.js";
import { isWorld } from "./world.js";

/** Decode the meta section. What a player does not use (the recipe and its hash) is handed on unchecked. */
export function decodeMeta(data) {
  let value;
  try {
    value = JSON.parse(new TextDecoder("utf-8", { fatal: true }).decode(inflate(data, MAX_META)));
  } catch (error) {
    if (error instanceof PacketError) throw error;
    throw new PacketError(`meta: not what was expected: ${error.message}`);
  }
  if (value === null || typeof value !== "object") throw new PacketError("meta: expected an object");
  const rigs = [value.train, value.test];
  if (!rigs.every(isRig) || !isColour(value.background) || !(Number(value.fps) > 0 && Number.isFinite(value.fps))) {
    throw new PacketError("meta: expected cameras by split, a background and a positive frame rate");
  }
  if ("world" in value && !isWorld(value.world)) {
    throw new PacketError("meta: world: expected a rotation, an offset and a scale above 0");
  }
  return value;
}

/** The content of one zstandard frame, whose announced size is checked against `limit` before it is allocated. */
export function inflate(data, limit) {
  const size = contentSize(data);
  if (size === null || size > limit) {
    throw new PacketError(`compressed part announces ${size} bytes; expected at most ${limit}`);
  }
  let out;
  try {
    out = decompress(data, new Uint8Array(size));
  } catch (error) {
    throw new PacketError(`compressed part is damaged: ${error.message}`);
  }
  if (out.length !== size) throw new PacketError(`compressed part: expected ${size} bytes, got ${out.length}`);
  return out;
}

function contentSize(data) {
  if (data.length < 6 || data[0] !== 0x28 || data[1] !== 0xb5 || data[2] !== 0x2f || data[3] !== 0xfd) {
    throw new PacketError("not a zstandard frame");
  }
  const flags = data[4];
  const single = (flags >> 5) & 1;
  const kind = flags >> 6;
  if (kind === 0 && !single) return null;
  const bytes = kind === 0 ? 1 : 1 << kind;
  const at = 6 - single + [0, 1, 2, 4][flags & 3];
  if (at + bytes > data.length) throw new PacketError("zstandard frame cut short");
  let size = 0;
  for (let i = bytes - 1; i >= 0; i -= 1) size = size * 256 + data[at + i];
  return kind === 1 ? size + 256 : size;
}

const isNumbers = (list, length) =>
  Array.isArray(list) && list.length === length && list.every((v) => typeof v === "number" && Number.isFinite(v));

function isColour(value) {
  return isNumbers(value, 3);
}

function isRig(rig) {
  if (rig === null || typeof rig !== "object" || !Array.isArray(rig.ids)) return false;
  const number = rig.ids.length;
  return (
    rig.ids.every((id) => typeof id === "string") &&
    [rig.width, rig.height].every((side) => Number.isInteger(side) && side >= 0 && side <= 1 << 16) &&
    Number.isFinite(rig.near) &&
    rig.near > 0 &&
    Array.isArray(rig.viewmats) &&
    rig.viewmats.length === number &&
    rig.viewmats.every((m) => isNumbers(m, 16)) &&
    Array.isArray(rig.Ks) &&
    rig.Ks.length === number &&
    rig.Ks.every((K) => isNumbers(K, 9))
  );
}
