// Limits of section 1.8 of docs/spec: what a reader checks before it allocates.

import { PacketError } from "./errors.js";

export const FORMAT_MAJOR = 2;
export const FORMAT_MINOR = 3;
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

/** A limit of this reader (section 1.8): bytes that a stream may take, and more for each of its own bytes. */
const FREE_MEMORY = 200e6;
const MEMORY_PER_BYTE = 1000;
/** What a number of a Gaussian takes while it is decoded. */
const PER_NUMBER = 12;

/** Refuse Gaussians that take far more memory than the `bytes` of the stream up to there can honestly hold. */
export function checkMemory(rows, numbers, bytes) {
  const wanted = PER_NUMBER * rows * numbers;
  if (wanted > FREE_MEMORY + MEMORY_PER_BYTE * bytes) {
    throw new PacketError(
      `${rows} Gaussians take ${Math.round(wanted / 1e6)} MB, more than a stream of ${bytes} bytes is trusted with`,
    );
  }
}
