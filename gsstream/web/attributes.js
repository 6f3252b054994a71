// Whole Gaussians as integers: the attribute sections of a key packet, and the births of a delta packet.

import { PacketError, located } from "./errors.js";
import { MAX_BITS, MAX_CODE, WIDTHS } from "./limits.js";
import { decodePositions } from "./positions.js";
import { decodeSymbols } from "./symbols.js";

/**
 * Decode whole Gaussians: attribute -> Float32Array of `number` rows, all six attributes.
 *
 * `sections`: attribute -> `{ data, offset }`. Throws PacketError with the offset of the section.
 */
export function decodeAttributes(sections, number) {
  const out = {};
  for (const name of ["quats", "scales", "opacities", "sh0", "shN"]) {
    const { data, offset } = sections[name];
    const { codes, bits, width } = located(offset, () => decodeCodes(name, data, number));
    out[name] = name === "sh0" || name === "shN" ? fromLuma(codes, bits, width) : fromCodes(codes, bits);
    if (name === "scales") {
      const means = sections.means;
      out.means = located(means.offset, () => decodePositions(means.data, codes, bits, number));
    }
  }
  return out;
}

function decodeCodes(name, data, number) {
  if (data.length < 2) throw new PacketError(`${name} cut short`);
  const bits = (data[0] << 24) >> 24;
  const width = data[1];
  if (!WIDTHS[name].includes(width) || bits < 1 || bits > MAX_BITS) {
    throw new PacketError(`${name}: ${width} channels of ${bits} fractional bits cannot be`);
  }
  const payload = data.subarray(2);
  if (name === "quats") return { codes: unfoldQuats(decodeSymbols(payload, number, 5), bits), bits, width };
  const codes = decodeSymbols(payload, number, width);
  for (let i = 0; i < codes.length; i += 1) {
    if (codes[i] >= MAX_CODE || codes[i] <= -MAX_CODE) throw new PacketError(`${name}: code out of range`);
  }
  return { codes, bits, width };
}

/** [N, 4] codes of quaternions from [N, 5] symbols: the largest component is what the unit norm leaves for it. */
function unfoldQuats(symbols, bits) {
  const number = symbols.length / 5;
  const out = new Int32Array(4 * number);
  const one = 4 ** bits;
  for (let i = 0; i < number; i += 1) {
    const largest = symbols[5 * i];
    if (largest < 0 || largest > 3) {
      throw new PacketError("quats: the index of the largest component is outside 0 to 3");
    }
    let squares = 0;
    let most = 0;
    for (let k = 0, to = 0; k < 3; k += 1, to += 1) {
      if (to === largest) to += 1;
      const code = symbols[5 * i + 1 + k];
      if (code >= MAX_CODE || code <= -MAX_CODE) throw new PacketError("quats: code out of range");
      out[4 * i + to] = code;
      squares += code * code;
      most = Math.max(most, Math.abs(code));
    }
    // The root of an integer below 2^42 is never halfway between two integers, so both ways of rounding agree.
    const value = symbols[5 * i + 4] + Math.round(Math.sqrt(Math.max(one - squares, 0)));
    if (value < most || value <= 0 || value >= MAX_CODE) {
      throw new PacketError("quats: the largest component is not the largest, or out of range");
    }
    out[4 * i + largest] = value;
  }
  return out;
}

function fromCodes(codes, bits) {
  const out = new Float32Array(codes.length);
  const step = 2 ** -bits;
  for (let i = 0; i < codes.length; i += 1) out[i] = codes[i] * step;
  return out;
}

/** Colours from luma and two chroma channels; every sum is exact in float64 and rounded once. */
function fromLuma(codes, bits) {
  const out = new Float32Array(codes.length);
  const fine = 2 ** -bits;
  const coarse = 2 ** (1 - bits);
  for (let i = 0; i < codes.length; i += 3) {
    const orange = codes[i + 1] * coarse;
    const green = codes[i + 2] * coarse;
    const middle = codes[i] * fine - green / 2;
    const blue = middle - orange / 2;
    out[i] = blue + orange;
    out[i + 1] = green + middle;
    out[i + 2] = blue;
  }
  return out;
}
