// Limits of section 1.8 of docs/spec: what a reader checks before it allocates.

import { PacketError } from "./errors.js";

export const FORMAT_MAJOR = 2;
export const FORMAT_MINOR = 4;
export const MAX_GAUSSIANS = 4_000_000;
export const FREE_GAUSSIANS = 1 << 16;
export const MAX_GAUSSIANS_PER_BYTE = 64;
export const MAX_BODY = 2 ** 30;
export const MAX_SECTIONS = 16;
export const MAX_META = 1 << 20;
export const MAX_UNITS = 64;
export const MAX_UNIT = 1e9;
export const MAX_CHANNELS = 64;
export const MAX_BINS = 1 << 14;
export const MAX_CODE = 1 << 20;
export const MAX_BITS = 20;

/** Attributes in the order used by every table and packet, and the widths each may have. */
export const ATTRIBUTES = ["means", "quats", "scales", "opacities", "sh0", "shN"];
export const WIDTHS = { means: [3], quats: [4], scales: [3], opacities: [1], sh0: [3], shN: [0, 9, 24, 45] };

/** Refuse Gaussians that take more than 200 MB and 1,000 bytes for each of the stream's `bytes` so far (section 1.8). */
export function checkMemory(rows, numbers, bytes) {
  const wanted = 12 * rows * numbers; // of each number while it is decoded
  if (wanted > 2e8 + 1000 * bytes) {
    const size = Math.round(wanted / 1e6);
    throw new PacketError(`${rows} Gaussians take ${size} MB, more than a stream of ${bytes} bytes is trusted with`);
  }
}
