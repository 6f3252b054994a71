// Key packets: the whole state. Its meta holds cameras, frame rate and background as JSON in a zstandard frame; its
// layout says how many Gaussians each node holds, and the length unit of each one's position residual.

import { decodeAttributes } from "./attributes.js";
import { viewOf } from "./container.js";
import { unpackParts } from "./bits.js";
import { PacketError, located } from "./errors.js";
import { ATTRIBUTES, FREE_GAUSSIANS, MAX_GAUSSIANS, MAX_GAUSSIANS_PER_BYTE, MAX_META, MAX_UNITS } from "./limits.js";
import { decodeSymbols, range } from "./symbols.js";
import { decompress } from "./vendor/fzstd.js";

/** `layers` decodes packets with layers, once who meets one has loaded layers.js. */
export const later = { layers: null };

/** Decode the sections of a key packet of `size` bytes at `offset`: `{ scene, layout, meta }`. */
export function decodeKey(found, size, offset) {
  const wanted = ["meta", "layout", ...ATTRIBUTES];
  const names = Object.keys(found);
  const layered = `${names}` === `layers,meta,${ATTRIBUTES},layout,rest`;
  if (!layered && (names.length !== wanted.length || wanted.some((name) => !found[name]))) {
    throw new PacketError(`key packet: expected sections ${wanted}, got ${names}`, offset);
  }
  const meta = located(found.meta.offset, () => decodeMeta(found.meta.data));
  const layout = located(found.layout.offset, () => decodeLayout(found.layout.data, mostGaussians(size)));
  const decode = layered ? later.layers : decodeAttributes;
  const scene = decode(found, layout.unitOf.length);
  return { scene, layout, meta };
}

/** How many Gaussians and nodes a key packet of so many bytes may announce. */
export function mostGaussians(size) {
  return Math.min(MAX_GAUSSIANS, FREE_GAUSSIANS + MAX_GAUSSIANS_PER_BYTE * size);
}

/**
 * Decode a layout that may announce at most `most` Gaussians and nodes.
 *
 * Returns `{ counts: Int32Array [M], unitOf: Uint8Array [N], units: Float32Array [H] }`.
 */
function decodeLayout(data, most) {
  if (data.length < 9) throw new PacketError("layout cut short");
  const view = viewOf(data);
  const number = view.getUint32(0, true);
  const nodes = view.getUint32(4, true);
  const kinds = data[8];
  if (number > most || nodes > most || kinds > MAX_UNITS) {
    throw new PacketError(
      `layout of ${number} Gaussians, ${nodes} nodes, ${kinds} units is beyond the limits: at most ${most} ` +
        `Gaussians and nodes in a packet of this size, ${MAX_UNITS} units`,
    );
  }
  if (data.length - 9 < 4 * kinds) throw new PacketError("units cut short");
  const units = Float32Array.from({ length: kinds }, (_, i) => view.getFloat32(9 + 4 * i, true));
  const [countBytes, unitBytes] = unpackParts(data.subarray(9 + 4 * kinds), 2);
  const counts = decodeSymbols(countBytes, nodes, 1);
  let sum = 0;
  let least = 0;
  for (const count of counts) {
    sum += count;
    least = Math.min(least, count);
  }
  if (least < 0 || (nodes > 0 && sum !== number)) {
    throw new PacketError(`layout: nodes hold ${sum} Gaussians, ${number} were announced`);
  }
  const unitOf = decodeUnits(unitBytes, number, kinds);
  if (number > 0 && nodes === 0) throw new PacketError(`layout: ${number} Gaussians in no node`);
  if (!units.every((unit) => Number.isFinite(unit) && unit > 0)) {
    throw new PacketError("layout: units must be finite and positive");
  }
  return { counts, unitOf, units };
}

/** [number] indices of units, each below `kinds`. */
export function decodeUnits(data, number, kinds) {
  const symbols = decodeSymbols(data, number, 1);
  if (number) {
    const [low, high] = range(symbols);
    if (low < 0 || high >= kinds) throw new PacketError(`layout: units ${low} to ${high} are named, ${kinds} given`);
  }
  return Uint8Array.from(symbols);
}

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

/** Whether a value is a similarity: a rotation row by row, an offset and a scale above 0, all of them finite. */
export function isWorld(value) {
  if (value === null || typeof value !== "object") return false;
  const { rotation, offset, scale } = value;
  const numbers = [rotation, offset].every((list) => Array.isArray(list) && list.every(Number.isFinite));
  if (!numbers || rotation.length !== 9 || offset.length !== 3 || !(Number.isFinite(scale) && scale > 0)) return false;
  const rows = [0, 3, 6].map((at) => rotation.slice(at, at + 3));
  const across = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
  const square = rows.every((a, i) => rows.every((b, k) => Math.abs(across(a, b) - (i === k)) <= 1e-6));
  const [[a, b, c], [d, e, f], [g, h, i]] = rows;
  return square && a * (e * i - f * h) - b * (d * i - f * g) + c * (d * h - e * g) > 0;
}
