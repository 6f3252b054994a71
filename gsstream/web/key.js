// Key packets: the whole state.

import { decodeAttributes } from "./attributes.js";
import { PacketError, located } from "./errors.js";
import { decodeLayout } from "./layout.js";
import { ATTRIBUTES, FREE_GAUSSIANS, MAX_GAUSSIANS, MAX_GAUSSIANS_PER_BYTE } from "./limits.js";
import { decodeMeta } from "./meta.js";

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
