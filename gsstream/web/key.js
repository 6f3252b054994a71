// Key packets: the whole state. Its layout says how many Gaussians each node holds, and the length unit of each one's
// position residual.

import { decodeAttributes } from "./attributes.js";
import { unpackParts } from "./bits.js";
import { PacketError, located } from "./errors.js";
import { ATTRIBUTES, FREE_GAUSSIANS, MAX_GAUSSIANS, MAX_GAUSSIANS_PER_BYTE, MAX_UNITS } from "./limits.js";
import { decodeMeta } from "./meta.js";
import { decodeSymbols, range } from "./symbols.js";

/** Decode the sections of a key packet of `size` bytes at `offset`: `{ scene, layout, meta }`. */
export function decodeKey(sections, size, offset) {
  const wanted = ["meta", "layout", ...ATTRIBUTES];
  const found = Object.fromEntries(sections.map((section) => [section.name, section]));
  if (sections.length !== wanted.length || wanted.some((name) => !found[name])) {
    throw new PacketError(`key packet: expected sections ${wanted}, got ${sections.map((s) => s.name)}`, offset);
  }
  const most = Math.min(MAX_GAUSSIANS, FREE_GAUSSIANS + MAX_GAUSSIANS_PER_BYTE * size);
  const meta = located(found.meta.offset, () => decodeMeta(found.meta.data));
  const layout = located(found.layout.offset, () => decodeLayout(found.layout.data, most));
  const scene = decodeAttributes(found, layout.unitOf.length);
  return { scene, layout, meta };
}

/**
 * Decode a layout that may announce at most `most` Gaussians and nodes.
 *
 * Returns `{ counts: Int32Array [M], unitOf: Uint8Array [N], units: Float32Array [H] }`.
 */
function decodeLayout(data, most) {
  if (data.length < 9) throw new PacketError("layout cut short");
  const view = new DataView(data.buffer, data.byteOffset, data.byteLength);
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
