// Key packets: the whole state. Its meta holds cameras, frame rate and background as JSON in a zstandard frame; its
// layout says how many Gaussians each node holds, and the length unit of each one's position residual.

import { decodeAttributes } from "./attributes.js";
import { viewOf } from "./container.js";
import { unpackParts } from "./bits.js";
import { PacketError, located } from "./errors.js";
import { ATTRIBUTES, checkMemory, FREE_GAUSSIANS, MAX_GAUSSIANS, MAX_GAUSSIANS_PER_BYTE } from "./limits.js";
import { MAX_META, MAX_UNIT, MAX_UNITS } from "./limits.js";
import { parseMeta } from "./meta.js";
import { decodeSymbols, within } from "./symbols.js";
import { decompress } from "./vendor/fzstd.js";

/** What decodes the sections layers, field and light, by their names, once its module is loaded. */
export const later = {};

/**
 * Decode the sections of a key packet of `size` bytes at `offset`: `{ scene, layout, meta, rest }`, where `rest` is how
 * many values of shN a row has, also where there is no row.
 */
export function decodeKey(found, size, offset) {
  const wanted = ["meta", "layout", ...ATTRIBUTES];
  const names = Object.keys(found);
  const layered = `${names}` === `layers,meta,${ATTRIBUTES},layout,rest`;
  if (!layered && (names.length !== wanted.length || wanted.some((name) => !found[name]))) {
    throw new PacketError(`key packet: expected sections ${wanted}, got ${names}`, offset);
  }
  const meta = located(found.meta.offset, () => decodeMeta(found.meta.data));
  const layout = located(found.layout.offset, () => decodeLayout(found.layout.data, mostGaussians(size)));
  const rest = found.shN.data[1];
  located(offset, () => checkMemory(layout.unitOf.length, 14 + Math.min(45, rest ?? 0), offset + size));
  const decode = layered ? later.layers : decodeAttributes;
  const scene = decode(found, layout.unitOf.length);
  return { scene, layout, meta, rest };
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
  if (!units.every((unit) => unit > 0 && unit < MAX_UNIT)) {
    throw new PacketError(`layout: units: expected numbers above 0 and below ${MAX_UNIT}`);
  }
  return { counts, unitOf, units };
}

/** [number] indices of units, each below `kinds`. */
export function decodeUnits(data, number, kinds) {
  const message = `layout: a unit is named beyond the ${kinds} given`;
  return Uint8Array.from(within(decodeSymbols(data, number, 1), 0, kinds - 1, message));
}

/** Decode the meta section. What a player does not use (the recipe and its hash) is handed on unchecked. */
export function decodeMeta(data) {
  return parseMeta(inflate(data, MAX_META));
}

/** The content of one zstandard frame, whose announced size is checked against `limit` before it is allocated. */
export function inflate(data, limit) {
  const { size, at } = frameHead(data);
  if (size === null || size > limit) {
    throw new PacketError(`compressed part announces ${size} bytes; expected at most ${limit}`);
  }
  if (frameEnd(data, at) !== data.length) throw new PacketError("compressed part: expected one zstandard frame alone");
  let out;
  try {
    out = decompress(data, new Uint8Array(size));
  } catch (error) {
    throw new PacketError(`compressed part is damaged: ${error.message}`);
  }
  if (out.length !== size) throw new PacketError(`compressed part: expected ${size} bytes, got ${out.length}`);
  return out;
}

/** What a zstandard frame says of its content: bytes (null: nothing), and where its blocks begin. */
function frameHead(data) {
  if (data.length < 6 || data[0] !== 0x28 || data[1] !== 0xb5 || data[2] !== 0x2f || data[3] !== 0xfd) {
    throw new PacketError("not a zstandard frame");
  }
  const flags = data[4];
  const single = (flags >> 5) & 1;
  const kind = flags >> 6;
  const from = 6 - single + [0, 1, 2, 4][flags & 3];
  const bytes = kind === 0 ? single : 1 << kind;
  if (from + bytes > data.length) throw new PacketError("zstandard frame cut short");
  if (data.subarray(6 - single, from).some((byte) => byte)) throw new PacketError("zstandard frame with a dictionary");
  let size = 0;
  for (let i = bytes - 1; i >= 0; i -= 1) size = size * 256 + data[from + i];
  return { size: bytes ? size + 256 * (kind === 1) : null, at: from + bytes };
}

/** The byte behind a zstandard frame whose blocks begin at byte `at`, by the lengths of its blocks. */
function frameEnd(data, at) {
  for (let last = 0; !last && at + 3 <= data.length; ) {
    const head = data[at] | (data[at + 1] << 8) | (data[at + 2] << 16);
    last = head & 1;
    at += 3 + ((head >> 1) % 4 === 1 ? 1 : head >> 3);
  }
  return at + (data[4] & 4);
}
